"""Perturbations: named, seeded changes of the plant, the initial state, the sensor, the actuator and external forces.

The level is the size of a change. U is uniform in [-level, level], and N is normal with standard deviation `level`,
both drawn independently for every number. The draws of a perturbation do not depend on other perturbations.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.loop.run import Loop, Push
from drake_diff.model.model import Model
from drake_diff.model.parameters import list_parameters
from drake_diff.model.tangent import tangent_space
from drake_diff.pages.scene import moving_bodies

Random = np.random.Generator
Levels = Mapping[str, Sequence[float]]


@dataclass(frozen=True, eq=False)
class Setup:
    """The setup of a run: the plant and its parameters by name, the initial state, the loop, and the duration."""

    model: Model
    x0: Array
    loop: Loop
    duration: float  # [s]
    parameters: Mapping[str, Array]


@dataclass(frozen=True)
class Perturbation:
    """A kind of perturbation, with the unit of its levels, the default levels, and its meaning."""

    name: str
    unit: str
    levels: tuple[float, ...]
    meaning: str
    apply: Callable[[Setup, float, Random], Setup]
    quantity: str = ""  # quantity whose parameters are scaled, if any

    def applies_to(self, model: Model) -> bool:
        """Return whether the perturbation changes anything in `model`."""
        if self.quantity:
            return bool(parameters_of(model, self.quantity))
        if self.name in ("contact_approximation", "time_step"):
            pairs = model.contract.contact.collision_pairs
            return model.can_rebuild and (pairs > 0 or self.name == "time_step")
        return model.nu > 0 or self.name in ("initial_state", "push")

    def with_unit(self, level: float) -> str:
        """Format a level with its unit."""
        return f"{level:g}" + ("" if self.unit == "1" else f" {self.unit}")


def perturbation_for(name: str, model: Model | None = None) -> Perturbation:
    """Return the perturbation `name`. Raises UnknownNameError, or InputError if it does not apply to `model`."""
    if name not in PERTURBATIONS:
        raise UnknownNameError("perturbation", got=name, known=PERTURBATIONS)
    if model is not None and not PERTURBATIONS[name].applies_to(model):
        raise InputError("perturbation", got=name, expected=f"a perturbation that applies to {model.name}")
    return PERTURBATIONS[name]


def perturbed(setup: Setup, levels: Mapping[str, float], seed: int) -> Setup:
    """Apply the perturbations in `levels`, in the order of PERTURBATIONS. Raises UnknownNameError, InputError."""
    for name, level in levels.items():
        perturbation_for(name, setup.model)
        if not (np.isfinite(level) and level >= 0):
            raise InputError(f"level of {name}", got=level, expected="a number of at least 0")
    for name, kind in PERTURBATIONS.items():
        if levels.get(name, 0) > 0:
            setup = kind.apply(setup, levels[name], np.random.default_rng([seed, zlib.crc32(name.encode())]))
    return setup


def levels_named(model: Model, perturbations: Levels | Sequence[str] | None) -> dict[str, tuple[float, ...]]:
    """Return levels by name, in increasing order. Raises UnknownNameError, or InputError for invalid levels."""
    if perturbations is None:
        return {name: kind.levels for name, kind in PERTURBATIONS.items() if kind.applies_to(model)}
    if not isinstance(perturbations, Mapping):
        perturbations = {name: perturbation_for(name).levels for name in perturbations}
    for name, values in perturbations.items():
        perturbation_for(name, model)
        if not len(values) or not all(np.isfinite(v) and v > 0 for v in values):
            raise InputError(f"levels of {name}", got=values, expected="numbers above 0")
    return {name: tuple(sorted(values)) for name, values in perturbations.items()}


def parameters_of(model: Model, quantity: str) -> dict[str, Array]:
    """Return the nonzero parameters of a quantity, for bodies and joints but not for single geometries."""
    parameters = {p.name: p.value for p in list_parameters(model) if p.kind.quantity == quantity and "/" not in p.name}
    moving = {body.name() for body in moving_bodies(model.plant)}
    any_body = quantity not in ("inertia", "mass")
    return {
        name: value
        for name, value in parameters.items()
        if np.any(value) and (any_body or name.rsplit(".", 1)[0].rsplit("::", 1)[-1] in moving)
    }


def _scaled(quantity: str) -> Callable[[Setup, float, Random], Setup]:
    def apply(setup: Setup, level: float, random: Random) -> Setup:
        if level >= 1:
            raise InputError(f"level of {quantity}", got=level, expected="a fraction of the value, less than 1")
        values = {
            name: setup.parameters.get(name, value) * (1 + random.uniform(-level, level))
            for name, value in parameters_of(setup.model, quantity).items()
        }
        return replace(setup, parameters={**setup.parameters, **values})

    return apply


def _initial_state(setup: Setup, level: float, random: Random) -> Setup:
    space = tangent_space(setup.model)
    x0 = space.plus(setup.x0, level * random.standard_normal(space.size))
    if not np.all(np.isfinite(x0)):
        raise InputError("level of initial_state", got=level, expected="a level at which every start is finite")
    return replace(setup, x0=x0)


def _time_step(setup: Setup, level: float, random: Random) -> Setup:
    parts = _whole("time_step", level)
    loop = replace(setup.loop, substeps=setup.loop.substeps * parts)
    return replace(setup, model=setup.model.at_time_step(setup.model.time_step / parts), loop=loop)


def _contact(setup: Setup, level: float, random: Random) -> Setup:
    approximation = setup.model.contract.contact.approximation
    other = random.choice([name for name in ("sap", "similar", "lagged") if name != approximation])
    return replace(setup, model=setup.model.with_contact(str(other)))


def _push(setup: Setup, level: float, random: Random) -> Setup:
    names = [body.name() for body in moving_bodies(setup.model.plant)]
    angle = random.uniform(0, 2 * np.pi)
    impulse = level * np.array([np.cos(angle), np.sin(angle), 0.0])
    push = Push(str(random.choice(names)), impulse, float(random.uniform(0, 0.75) * setup.duration))
    return replace(setup, loop=replace(setup.loop, pushes=(*setup.loop.pushes, push)))


def _around(
    component: str, change: Callable[[Any, float, Random, Model], dict[str, Any]]
) -> Callable[[Setup, float, Random], Setup]:
    """Return a perturbation of the loop's sensor or actuator."""

    def apply(setup: Setup, level: float, random: Random) -> Setup:
        old = getattr(setup.loop, component)
        new = replace(old, **change(old, level, random, setup.model))
        return replace(setup, loop=replace(setup.loop, **{component: new}))

    return apply


def _whole(name: str, level: float) -> int:
    if round(level) != level or level < 1:
        raise InputError(f"level of {name}", got=level, expected="a whole number")
    return round(level)


SHARES = (0.02, 0.05, 0.1, 0.2, 0.4)
SENSED = (0.003, 0.01, 0.03, 0.1)
PERTURBATIONS: Mapping[str, Perturbation] = {kind.name: kind for kind in (
    Perturbation("initial_state", "q, v", (0.01, 0.03, 0.1, 0.3), "each coordinate of the start + N", _initial_state),
    Perturbation("mass", "1", SHARES, "each body's mass (1 + U)", _scaled("mass"), "mass"),
    Perturbation("inertia", "1", SHARES, "each body's moments of inertia (1 + U)", _scaled("inertia"), "inertia"),
    Perturbation("friction", "1", SHARES, "each body's friction (1 + U)", _scaled("friction"), "friction"),
    Perturbation("stiffness", "1", SHARES, "each body's contact stiffness (1 + U)", _scaled("stiffness"), "stiffness"),
    Perturbation("damping", "1", SHARES, "each joint's damping (1 + U)", _scaled("damping"), "damping"),
    Perturbation("time_step", "1", (2, 4), "each step of the plant cut into this many", _time_step),
    Perturbation("contact_approximation", "1", (1,), "another of sap, similar and lagged", _contact),
    Perturbation("gravity", "1", (0.01, 0.03, 0.1), "gravity (1 + U)", _scaled("gravity"), "gravity"),
    Perturbation(
        "actuator_strength", "1", SHARES, "each input (1 + U)",
        _around("actuator", lambda actuator, level, random, model:
                {"strength": np.asarray(actuator.strength) * (1 + random.uniform(-level, level, model.nu))}),
    ),
    Perturbation("push", "N s", (0.03, 0.1, 0.3, 1.0), "a horizontal blow to a body before 3/4 of the time", _push),
    Perturbation(
        "sensor_noise", "q, v", SENSED, "each measured coordinate + N",
        _around("sensor", lambda sensor, level, random, model: {"noise": np.hypot(sensor.noise, level)}),
    ),
    Perturbation(
        "sensor_bias", "q, v", SENSED, "each measured coordinate + U, constant over a trial",
        _around("sensor", lambda sensor, level, random, model:
                {"bias": sensor.bias + random.uniform(-level, level, tangent_space(model).size)}),
    ),
    Perturbation(
        "latency", "steps", (1, 2, 4, 8), "measurements arrive this many controller steps late",
        _around("sensor", lambda sensor, level, random, model: {"delay": sensor.delay + _whole("latency", level)}),
    ),
    Perturbation(
        "actuator_delay", "steps", (1, 2, 4, 8), "commands arrive this many controller steps late",
        _around("actuator", lambda actuator, level, random, model:
                {"delay": actuator.delay + _whole("actuator_delay", level)}),
    ),
    Perturbation(
        "dropped_frames", "1", (0.1, 0.3, 0.6), "this part of the measurements is lost",
        _around("sensor", lambda sensor, level, random, model:
                {"dropout": 1 - (1 - sensor.dropout) * (1 - level)}),
    ),
)}  # fmt: skip

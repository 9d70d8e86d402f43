"""What physics keeps along a replay: the energy of free motion, momentum, contact within its cone, limits."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied
from drake_diff.model.plant import FLOATING, bodies, joints
from drake_diff.model.step import set_state
from drake_diff.motion.rollout import Rollout, drift, smooth_mean
from drake_diff.record.parts import Metric, measured

ON_THE_PLANT = "in the open-loop replay on the discrete plant"


NAMES = {
    "free-motion energy drift": "J",
    "free-motion energy oscillation": "J",
    "linear momentum error": "N s",
    "angular momentum error": "N m s",
    "penetration": "m",
    "limit violation": "",  # the positions' own
    "friction-cone excess": "N",
}


def invariants_of(vector: ParameterVector, motion: Rollout | None, unit: str, missing: str) -> Iterator[Metric]:
    """Each invariant along the replay; null with a reason where it does not apply, `missing` where there is none.

    `vector` has the parameters' values that the motion is of, `unit` is that of the positions.
    """
    if motion is None:
        for name, own in NAMES.items():
            yield measured(name, ON_THE_PLANT, np.inf, own or unit, reason=missing)
        return
    free = _free_steps(vector.model, motion)
    yield from _energy(motion, free)
    yield from _momentum(vector, motion, free)
    yield _worst("penetration", f"largest overlap of two geometries {ON_THE_PLANT}", "m", motion, motion.penetration)
    yield _worst(
        "limit violation",
        f"largest excess over a joint limit, or of a quaternion's norm over 1, {ON_THE_PLANT}",
        unit,
        motion,
        motion.constraint_violation,
        reason="the plant has constraints (couplers, balls, welds), whose violation pydrake does not tell",
    )
    yield _friction_cone(vector, motion)


def _worst(name: str, definition: str, unit: str, motion: Rollout, values: Array, reason: str = "not finite") -> Metric:
    worst = int(np.argmax(values))
    when = float(motion.times[worst])
    return measured(name, definition, float(values[worst]), unit, reason=reason, t_s=when)


def _free_steps(model: Model, motion: Rollout) -> int:
    """How many steps from the start there is neither contact nor a joint limit in the way."""
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    positions = motion.xs[:, : model.nq]
    beyond = np.any((positions <= lower) | (positions >= upper), axis=1)
    held = np.array([bool(c) for c in motion.contacts]) | beyond[1:]  # a limit is implicit: it acts before it is met
    return int(np.argmax(held)) if held.any() else len(held)


def _energy(motion: Rollout, free: int) -> Iterator[Metric]:
    """Of the first, free part: what neither actuators nor damping explain, drift apart from oscillation."""
    error = motion.energy_error[: free + 1]
    part = f"over the {free} steps from the start without contact, {ON_THE_PLANT}"
    names = list(NAMES)[:2]
    definitions = (
        f"lasting part of the energy that neither actuators nor damping explain, {part}",
        f"largest distance of that energy from its drift line, {part}",
    )
    lasting, swing = float("inf"), float("inf")
    if free > 0:
        lasting = drift(error)
        swing = float(np.abs(error - smooth_mean(error) - lasting * np.linspace(-0.5, 0.5, len(error))).max())
    for name, definition, value in zip(names, definitions, (lasting, swing), strict=True):
        yield measured(name, definition, value, "J", reason="there is contact, or a limit, from the first step on")


def _momentum(vector: ParameterVector, motion: Rollout, free: int) -> Iterator[Metric]:
    """Of a system that nothing holds to the world: momentum less what gravity gave, and spin about the mass centre."""
    definitions = {
        "linear momentum error": "largest change of the linear momentum beyond gravity's, in free motion",
        "angular momentum error": "largest change of the angular momentum about the centre of mass, in free motion",
    }
    reason = _why_not_conserved(vector.model, free)
    values = (np.inf, np.inf)
    if not reason:
        with applied(vector) as model:
            values = _momentum_errors(model, motion, free)
    for (name, definition), value in zip(definitions.items(), values, strict=True):
        yield measured(name, definition, value, NAMES[name], reason=reason or "not finite")


def _why_not_conserved(model: Model, free: int) -> str:
    """Why momentum is not conserved in this model; empty where it is."""
    for joint in joints(model.plant):
        holds = model.plant.IsAnchored(joint.parent_body()) and not model.plant.IsAnchored(joint.child_body())
        if holds and joint.type_name() not in FLOATING:
            return f"{joint.name()} holds the model to the world, which takes up momentum"
        if joint.type_name() in FLOATING and np.any(np.asarray(joint.default_damping_vector()) != 0):
            return f"{joint.name()} is damped, which takes momentum away"
    return "" if free > 0 else "there is contact, or a limit, from the first step on"


def _momentum_errors(model: Model, motion: Rollout, free: int) -> tuple[float, float]:
    plant, context = model.plant, model.double.context
    linear, angular = [], []
    moving = [body for body in bodies(plant) if not plant.IsAnchored(body)]
    masses = np.array([body.get_mass(context) for body in moving])
    for x in motion.xs[: free + 1]:
        set_state(model.double, x)
        centres = [plant.EvalBodyPoseInWorld(context, b) @ b.CalcCenterOfMassInBodyFrame(context) for b in moving]
        centre = masses @ np.array(centres) / masses.sum()
        momentum = plant.CalcSpatialMomentumInWorldAboutPoint(context, centre)
        linear.append(np.asarray(momentum.translational()))
        angular.append(np.asarray(momentum.rotational()))
    pull = masses.sum() * np.asarray(plant.gravity_field().gravity_vector())
    change = np.array(linear) - linear[0] - motion.times[: free + 1, None] * pull
    return float(np.abs(change).max()), float(np.abs(np.array(angular) - angular[0]).max())


def _friction_by_body(model: Model) -> dict[str, float]:
    """The coefficient of each body that has one for all its geometries."""
    found: dict[str, set[Any]] = {}
    for geometry in model.contract.geometries:
        found.setdefault(geometry.body, set()).add(geometry.friction)
    return {body: values.pop() for body, values in found.items() if len(values) == 1}


def _combined(a: float | None, b: float | None) -> float | None:
    """Drake's coefficient for two bodies, 2 a b / (a + b); None where one is not known."""
    if a is None or b is None:
        return None
    return 2 * a * b / (a + b) if a + b else 0.0


def _friction_cone(vector: ParameterVector, motion: Rollout) -> Metric:
    """By how much a tangential contact force is larger than friction allows."""
    name, definition = "friction-cone excess", f"largest |f_t| - mu f_n of a contact's force {ON_THE_PLANT}"
    if any(parameter.name.endswith(".friction") for parameter in vector.parameters):
        return measured(name, definition, np.inf, "N", reason="friction is a parameter here, not the contract's")
    known, worst, when = _friction_by_body(vector.model), -np.inf, 0.0
    for time, contacts in zip(motion.times, motion.contacts, strict=False):
        for contact in contacts:
            mu = _combined(known.get(contact.body_a), known.get(contact.body_b))
            if mu is None:
                pair = f"{contact.body_a} and {contact.body_b}"
                return measured(name, definition, np.inf, "N", reason=f"the friction between {pair} is not one number")
            push = float(contact.force @ contact.normal)
            excess = float(np.linalg.norm(contact.force - push * contact.normal)) - mu * push
            if excess > worst:
                worst, when = excess, float(time)
    return measured(name, definition, worst, "N", reason="nothing touches", t_s=when)

"""Load engines by name, for the whole plant or for its independent coordinates. Engines are imported on demand."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array
from drake_diff.engines.interface import Engine, EngineContract, EulerEngine, float_rows
from drake_diff.exceptions import InputError, MissingDependencyError, ModelError, UnknownNameError
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.model import Model
from drake_diff.model.repairs import JointCoupling

SAFE_PATH = "PYTHONSAFEPATH"
ENGINES = {
    "numpy": ("engines.closed_form", "NumpyEngine"),
    "drake": ("engines.drake", "DrakeEngine"),
    "mujoco": ("engines.mujoco", "MujocoEngine"),
    "mjx": ("engines.mjx", "MjxEngine"),
    "pinocchio": ("engines.pinocchio", "PinocchioEngine"),
    "casadi": ("engines.casadi", "CasadiEngine"),
    "newton": ("engines.newton", "NewtonEngine"),
    "pybullet": ("engines.bullet", "PybulletEngine"),
    "sapien": ("engines.physx", "SapienEngine"),
}
# Other tools that are not supported as engines, with the reason.
ELSEWHERE = {
    "isaaclab": "it needs its own Python environment: run drake-diff export-model, record there, and compare the file",
    "isaacsim": "it requires a licence to be accepted: run drake-diff export-model, record there, and compare the file",
    "gazebo": "it has no Python package: run drake-diff export-model, record there, and compare the file",
    "control": "python-control has no multibody dynamics: it checks linearizations, their poles and LQR gains",
    "opencv": "it works on images and has no dynamics",
    "gtsam": "it estimates from measurements and has no dynamics",
}


def load_engine(name: str, model: Any, **options: Any) -> Engine:
    """Build `model` in another simulator, in Drake's coordinates.

    Args:
        name: "numpy", "drake", "mujoco", "mjx", "pinocchio", "casadi", "newton", "pybullet" or "sapien".
        model: The `Model`. "numpy" also takes a form of `engines.closed_form`.
        **options: "drake" takes `contact` ("sap", "similar", "lagged") and `method` (of `differentiate_step`). "mujoco"
            and "mjx" take `path`, a custom MJCF file. "mujoco" takes `time_step` [s] if it differs from the model's.
            A form of `engines.closed_form` requires `time_step`.

    Returns:
        An `Engine` with the step, Jacobians, energy, mass matrix and contract of the model in that simulator.

    Raises:
        UnknownNameError: There is no engine of that name. The message lists the known names.
        MissingDependencyError: The engine is not installed. The message states how to install it.
        ModelError: The engine does not support this model. The message names the element.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> hand = dd.engines.load_engine("numpy", model)
        >>> print(round(hand.energy([np.pi, 0.0]) - hand.energy([0.0, 0.0]), 2))
        9.81
    """
    if name in ELSEWHERE:
        raise MissingDependencyError(f"{name} is not an engine here: {ELSEWHERE[name]}")
    if name not in ENGINES:
        raise UnknownNameError("engine", got=name, known=ENGINES)
    module, kind = ENGINES[name]
    if isinstance(model, Model) and model.coupling is not None and name != "drake":
        if name not in TAKEN:
            raise ModelError(f'{name} does not support reduced mimic joints: use {", ".join(TAKEN)}, or mimic="fix"')
        return ReducedEngine(load_engine(name, model.whole, **options), model)
    with _safe_children():
        engine: Engine = getattr(import_module(f"drake_diff.{module}"), kind)(model, **options)
    return engine


@contextmanager
def _safe_children() -> Iterator[None]:
    """Prevent `python -c` child processes, such as glfw's for MuJoCo, from importing from the working directory."""
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


def load_spec(spec: str, model: Model) -> Engine:
    """Load an engine by name, or Drake by "drake:CONTACT" or "drake:CONTACT:METHOD", as in drake:lagged:implicit."""
    name, *chosen = spec.split(":")
    if chosen and (name != "drake" or len(chosen) > 2):
        raise InputError("engine", got=spec, expected="a name, drake:CONTACT or drake:CONTACT:METHOD")
    return load_engine(name, model, **dict(zip(("contact", "method"), chosen, strict=False)))


TAKEN = ("drake", "pinocchio", "casadi")  # engines that support a model with reduced coordinates


class ReducedEngine(EulerEngine):
    """An engine in independent coordinates. `whole` is the engine on `model.whole`, an `EulerEngine` of its plant.

    With v = E v_own, the force for an acceleration a_own is E' times the force for E a_own in the whole plant.
    """

    def __init__(self, whole: Any, model: Model):
        if model.coupling is None:
            raise ModelError("an engine of reduced coordinates: expected a model with mimic joints that are reduced")
        self.whole = whole
        self.model, self.coupling = model, model.coupling
        self.name, self.version, self.method = whole.name, whole.version, whole.method
        self.coordinates, self.time_step, self.status = coordinates_of(model), model.time_step, "ok"
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self.damping = self.coupling.forces(self.coupling.ratio_v * whole.damping)
        self.actuation, self.limits = self.coupling.forces(whole.actuation), whole.limits

    def energy(self, x: ArrayLike) -> float:
        return float(self.whole.energy(self.coupling.state(self._state(x)[0])))

    def mass_matrix(self, q: ArrayLike) -> Array:
        E = self.coupling.spread
        return np.asarray(E.T @ self.whole.mass_matrix(self.coupling.positions(self._positions(q))) @ E)

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        q, v = self._motion(q, v)
        force = self.whole.bias(self.coupling.positions(q), self.coupling.velocities(v))
        return np.asarray(self.coupling.forces(force))

    def _needed_derivative(self, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        E, coupling = self.coupling.spread, self.coupling
        whole = coupling.positions(q), coupling.velocities(v), coupling.velocities(a)
        by_motion, by_v = self.whole._needed_derivative(*whole)
        return E.T @ by_motion @ E, E.T @ by_v @ E

    @property
    def contract(self) -> EngineContract:
        return reduced_contract(self.whole.contract, self.model)


def reduced_contract(contract: EngineContract, model: Model) -> EngineContract:
    """Reduce a contract to independent coordinates. Followers add to M(q), bias and damping of their leaders."""
    coupling: JointCoupling | None = model.coupling
    if coupling is None:
        return contract
    damping, (lower, upper) = coupling.forces(coupling.ratio_v * contract.damping), model.position_limits
    by_velocity = [contract.by_velocity[j] for j in coupling.own_v]
    for i, k in coordinates_of(model).single:
        reduced = {"damping": float(damping[k]), "lower": float(lower[i]), "upper": float(upper[i])}
        by_velocity[k] = replace(by_velocity[k], **reduced)
    joints = {joint.name: joint for joint in by_velocity}
    return replace(
        contract,
        joints=tuple(joints.values()),
        native_order=tuple(name for name in contract.native_order if name in joints),
        actuation=float_rows(coupling.spread.T @ np.array(contract.actuation).reshape(len(coupling.of_v), -1)),
    )

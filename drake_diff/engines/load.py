"""Engines by name, imported only when they are asked for."""

from importlib import import_module
from typing import Any

from drake_diff.engines.interface import Engine
from drake_diff.engines.reduced import TAKEN, ReducedEngine
from drake_diff.exceptions import InputError, MissingDependencyError, ModelError, UnknownNameError
from drake_diff.model.model import Model

ENGINES = {
    "numpy": ("engines.closed_form", "NumpyEngine"),
    "drake": ("engines.drake", "DrakeEngine"),
    "mujoco": ("engines.mujoco.engine", "MujocoEngine"),
    "mjx": ("engines.mujoco.mjx", "MjxEngine"),
    "pinocchio": ("engines.pinocchio", "PinocchioEngine"),
    "casadi": ("engines.casadi", "CasadiEngine"),
    "newton": ("engines.newton", "NewtonEngine"),
    "pybullet": ("engines.bullet", "PybulletEngine"),
    "sapien": ("engines.physx", "SapienEngine"),
}
# Tools that people ask for and that are no engine here, and why.
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
        model: the `Model`; "numpy" also takes a form of `engines.closed_form`.
        **options: "drake" takes `contact` ("sap", "similar", "lagged") and `method` (of `differentiate_step`);
            "mujoco" and "mjx" take `path`, an MJCF file of your own; "mujoco" takes `time_step` [s], another than the
            model's; such a form needs it.

    Returns:
        An `Engine`: step, Jacobians, energy, mass matrix and contract of the model in that simulator.

    Raises:
        UnknownNameError: there is no engine of that name; the message lists those there are.
        MissingDependencyError: the engine is not installed; the message says how to install it.
        ModelError: the engine cannot have this model; the message names the element.

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
            raise ModelError(
                f'{name} does not take mimic joints that are reduced: {", ".join(TAKEN)} do, or mimic="fix"'
            )
        return ReducedEngine(load_engine(name, model.whole, **options), model)
    engine: Engine = getattr(import_module(f"drake_diff.{module}"), kind)(model, **options)
    return engine


def load_spec(spec: str, model: Model) -> Engine:
    """The engine of a name, or Drake's "drake:CONTACT" or "drake:CONTACT:METHOD", as in drake:lagged:implicit."""
    name, *chosen = spec.split(":")
    if chosen and (name != "drake" or len(chosen) > 2):
        raise InputError("engine", got=spec, expected="a name, drake:CONTACT or drake:CONTACT:METHOD")
    return load_engine(name, model, **dict(zip(("contact", "method"), chosen, strict=False)))

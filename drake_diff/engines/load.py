"""Engines by name, imported only when asked for."""

from importlib import import_module
from typing import Any

from drake_diff.engines.interface import Engine
from drake_diff.exceptions import InputError, MissingDependencyError, UnknownNameError
from drake_diff.model.model import Model

ENGINES = {
    "numpy": ("engines.numpy", "NumpyEngine"),
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
    "isaaclab": "it needs an environment of its own: drake-diff export-model, then compare what it recorded",
    "isaacsim": "it stands behind a licence prompt: drake-diff export-model, then compare what it recorded",
    "gazebo": "it has no Python package: drake-diff export-model, then compare what it recorded",
    "control": "python-control has no multibody dynamics: it checks linearizations, their poles and LQR gains",
    "opencv": "it has no part in dynamics: it works on images",
    "gtsam": "it has no part in dynamics: it estimates from measurements",
}


def load_spec(spec: str, model: Model) -> Engine:
    """The engine of a name, or Drake's "drake:CONTACT" or "drake:CONTACT:METHOD", as in drake:lagged:implicit."""
    name, *chosen = spec.split(":")
    if chosen and (name != "drake" or len(chosen) > 2):
        raise InputError("engine", got=spec, expected="a name, drake:CONTACT or drake:CONTACT:METHOD")
    return load_engine(name, model, **dict(zip(("contact", "method"), chosen, strict=False)))


def load_engine(name: str, model: Any, **options: Any) -> Engine:
    """The engine `name`, one of ENGINES, on `model`, a Model or for numpy also a ClosedForm.

    Options: contact and method of drake, path (an MJCF of your own) of mujoco and mjx, time_step [s] of a ClosedForm.
    Raises MissingDependencyError, with what to install, where the engine is not there, and ModelError, naming the
    element, where it cannot have the model.
    """
    if name in ELSEWHERE:
        raise MissingDependencyError(f"{name} is no engine here: {ELSEWHERE[name]}")
    if name not in ENGINES:
        raise UnknownNameError("engine", got=name, known=ENGINES)
    module, kind = ENGINES[name]
    engine: Engine = getattr(import_module(f"drake_diff.{module}"), kind)(model, **options)
    return engine

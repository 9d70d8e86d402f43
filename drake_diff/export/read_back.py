"""A model file that was written, read again: whether it says what the plant does."""

import warnings
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from drake_diff.comparison.result import LAWS
from drake_diff.engines.contract_match import match_contracts
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.interface import Engine, EngineContract, limit
from drake_diff.engines.load import load_engine
from drake_diff.engines.mujoco.mjcf import mjcf
from drake_diff.engines.urdf import urdf
from drake_diff.exceptions import DrakeDiffError, ModelWarning
from drake_diff.export.sdf import collision_name, sdf
from drake_diff.mechanics.description import Description
from drake_diff.model.model import Model, load_model

SUFFIX = {"urdf": ".urdf", "sdf": ".sdf", "mjcf": ".xml"}


def written(form: str, description: Description, time_step: float) -> str:
    """The text of a urdf, sdf or mjcf."""
    if form == "urdf":
        return urdf(description)
    return sdf(description, time_step) if form == "sdf" else mjcf(description, time_step)


def named_in(form: str, geometry: str) -> str:
    """The name that a geometry has in a file."""
    return collision_name(geometry) if form == "sdf" else geometry


def complaints(form: str, model: Model, text: str) -> list[str]:
    """What of `model` the file `text` does not say, by each reader: Drake, and of MJCF MuJoCo where it is installed.

    Drake reads no springs in MJCF: of a model with springs only MuJoCo reads it, or nobody does, which is a complaint.
    """
    reference = DrakeEngine(model)
    springs = any(link.stiffness for link in reference.description.links)
    readers = ["drake"] if form != "mjcf" or not springs else []
    readers += ["mujoco"] if form == "mjcf" and find_spec("mujoco") else []
    found = [] if readers else ["MuJoCo is not installed, and Drake reads no springs in MJCF"]
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"model{SUFFIX[form]}"
        path.write_text(text)
        for reader in readers:
            try:
                lines = match_contracts(_Named(model, form), _read(reader, model, path))
            except DrakeDiffError as error:
                found.append(f"{reader} cannot read it: {error}")
            else:
                wrong = (line for line in lines if line.verdict == "different" and line.quantity not in LAWS)
                found += [f"read by {reader}, {line.quantity}: {line.detail}" for line in wrong]
    return found


def _read(reader: str, model: Model, path: Path) -> Engine:
    if reader == "mujoco":
        return load_engine("mujoco", model, path=path)
    gravity = model.plant.gravity_field().gravity_vector()  # which Drake reads of no format
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # of what is other engines' alone
        return _Unlimited(load_model(path, time_step=model.time_step, gravity=gravity))


class _Named(DrakeEngine):
    """The plant, its inputs named as the format names them."""

    def __init__(self, model: Model, form: str):
        super().__init__(model)
        self.form = form

    @property
    def contract(self) -> EngineContract:
        own = super().contract
        return replace(own, inputs=self.description.actuated) if self.form == "sdf" else own


class _Unlimited(DrakeEngine):
    """What was read, without the limits that stand for none."""

    @property
    def contract(self) -> EngineContract:
        own = super().contract
        joints = [replace(j, lower=limit(j.lower), upper=limit(j.upper)) for j in own.joints]
        return replace(own, joints=tuple(joints), effort_limits=tuple(limit(x) for x in own.effort_limits))

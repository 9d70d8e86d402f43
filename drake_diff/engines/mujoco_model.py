"""MuJoCo models: compiled from the MJCF that is generated from Drake's plant, or from the user's own."""

from pathlib import Path
from typing import Any

import numpy as np

from drake_diff.engines.description import Description
from drake_diff.engines.mjcf import mjcf
from drake_diff.engines.mujoco_contract import check_known, pair_index, resting_stiffness
from drake_diff.exceptions import MissingDependencyError, ModelError

try:
    import mujoco
except ImportError as error:
    raise MissingDependencyError("this engine needs MuJoCo: pip install 'drake-diff[engines]'") from error

__all__ = ["generated", "mujoco", "mujoco_model"]


def mujoco_model(description: Description, time_step: float, path: str | Path | None) -> tuple[str, Any]:
    """The MJCF, generated or read from `path`, and its MjModel; ModelError for what the contract has no line for."""
    text = generated(description, time_step) if path is None else Path(path).read_text()
    model = _compile(text) if path is None else _read(path)
    flags = mujoco.mjtDisableBit
    check_known(model, int(flags.mjDSBL_WARMSTART | flags.mjDSBL_EULERDAMP))
    return text, model


def generated(description: Description, time_step: float) -> str:
    """The MJCF whose contacts have Drake's stiffness where they rest: see `mujoco_contract.resting_stiffness`."""
    bare = _compile(mjcf(description, time_step))
    solref = {}
    for pair in description.pairs:
        i = pair_index(bare, pair.names)
        if i >= 0 and pair.stiffness:
            s = pair.stiffness / resting_stiffness(bare, i)
            solref[pair.names] = (-s, -2 * float(np.sqrt(s)))  # critical, where nothing else holds the pair
    return mjcf(description, time_step, solref)


def _compile(text: str) -> Any:
    try:
        return mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise ModelError(f"MuJoCo cannot take this model: {error}") from error


def _read(path: str | Path) -> Any:
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ModelError(f"MuJoCo cannot read {path}: {error}") from error

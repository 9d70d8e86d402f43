"""plan.npz: the solver's states and inputs, exact to the bit, which a run is replayed from."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.files import write_whole
from drake_diff.exceptions import ArtifactError
from drake_diff.optimize.solution import Solution

PLAN = "plan.npz"
ARRAYS = ("xs", "us", "us_mid", "u_final", "mesh", "parameters", "free_horizon")
REQUIRED = ("xs", "us", "parameters")


@dataclass(frozen=True, eq=False)
class PlanArrays:
    """The arrays of a plan, as in `Solution`; None where the plan has no such array."""

    xs: Array
    us: Array
    us_mid: Array | None
    u_final: Array | None
    mesh: Array | None
    parameters: Array
    free_horizon: float | None


def write_plan(path: Path, solution: Solution) -> None:
    """Write the arrays of `solution`: the same ones give the same bytes."""
    given: dict[str, Any] = {"xs": solution.xs, "us": solution.us, "parameters": solution.vector.values}
    given |= {name: getattr(solution, name) for name in ("us_mid", "u_final", "mesh", "free_horizon")}
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(v, dtype=float) for name, v in sorted(given.items()) if v is not None}
    np.savez(buffer, **arrays)
    write_whole(path, buffer.getvalue())


def read_plan(path: Path) -> PlanArrays:
    """The arrays in `path`. ArtifactError where it is missing or not such a file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            unknown, missing = set(file.files) - set(ARRAYS), set(REQUIRED) - set(file.files)
            if unknown or missing:
                raise ArtifactError(f"{path}: unknown arrays {sorted(unknown)}, missing {sorted(missing)}")
            found = {name: frozen(file[name]) for name in file.files}
    except ArtifactError:
        raise
    except Exception as error:  # NumPy's reader fails in many ways on what is no such file
        raise ArtifactError(f"{path} is not a plan: {type(error).__name__}: {error}") from error
    horizon = found.get("free_horizon")
    return PlanArrays(
        xs=found["xs"],
        us=found["us"],
        us_mid=found.get("us_mid"),
        u_final=found.get("u_final"),
        mesh=found.get("mesh"),
        parameters=found["parameters"],
        free_horizon=None if horizon is None else float(horizon),
    )

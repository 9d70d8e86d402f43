"""Read the numbers of a trace back, bit for bit as they were written."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff.exceptions import ArtifactError
from drake_diff.logs.read import McapLog, read_mcap

CHANNELS = {"/state", "/input", "/planned/state", "/planned/input", "/planned/plan", "/diagnostics"}


@dataclass(frozen=True, eq=False)
class Trace:
    """The numbers of a trace, bit for bit as they were written; arrays are read-only.

    `xs` (N+1, nx) under `us` (N, nu) is the open-loop motion of the discrete plant, without rows where it could not
    be taken; `planned_xs` (N+1, nx), `planned_us` (N or N+1, nu) and `planned_us_mid` (N, nu) are the solver's.
    """

    times: Array  # (N+1,) [s]
    xs: Array
    us: Array
    planned_xs: Array
    planned_us: Array
    planned_us_mid: Array | None  # inputs at the midpoints, where the scheme has them
    scheme: str
    horizon: float  # [s]
    horizon_is_free: bool
    parameters: Array  # (np,) values of the problem's parameters
    diagnostics: dict[str, Array]  # (N+1,) each, by the name of a field of drake_diff.Diagnostics
    metadata: dict[str, str]
    attachments: dict[str, bytes]

    @property
    def plan(self) -> dict[str, Any]:
        """The fields of a `Solution` that hold its numbers: `Solution(problem, method, ..., **trace.plan)`."""
        count = max(len(self.planned_xs) - 1, 0)
        final = self.planned_us[count] if len(self.planned_us) > count else None
        return {
            "xs": self.planned_xs,
            "us": self.planned_us[:count],
            "scheme": self.scheme,
            "us_mid": self.planned_us_mid,
            "u_final": final,
            "free_horizon": self.horizon if self.horizon_is_free else None,
            "parameters": self.parameters,
        }


def read_trace(path: str | Path) -> Trace:
    """The numbers in a trace. ArtifactError where the file is damaged or lacks a channel."""
    log = read_mcap(path)
    missing = CHANNELS - set(log.messages)
    if missing:
        raise ArtifactError(f"{path}: no channel {', '.join(sorted(missing))}")
    plan = log.arrays("/planned/plan")
    if len(plan["horizon"]) != 1:
        raise ArtifactError(f"{path}: expected one message of /planned/plan, got {len(plan['horizon'])}")
    planned = log.arrays("/planned/state")
    return Trace(
        times=frozen(planned["time"]),
        xs=_states(log.arrays("/state")),
        us=frozen(log.arrays("/input")["u"]),
        planned_xs=_states(planned),
        planned_us=frozen(log.arrays("/planned/input")["u"]),
        planned_us_mid=_middles(log),
        scheme=str(plan["scheme"][0]),
        horizon=float(plan["horizon"][0]),
        horizon_is_free=bool(plan["horizon_is_free"][0]),
        parameters=frozen(plan["parameters"][0]),
        diagnostics={name: frozen(values) for name, values in log.arrays("/diagnostics").items()},
        metadata=log.metadata.get("run", {}),
        attachments=log.attachments,
    )


def _states(columns: dict[str, Any]) -> Array:
    return frozen(np.hstack([columns["q"], columns["v"]]))


def _middles(log: McapLog) -> Array | None:
    topic = "/planned/input_mid"
    return frozen(log.arrays(topic)["u"]) if topic in log.messages else None

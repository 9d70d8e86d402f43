"""trace.mcap: the plant's motion and the plan in simulated time, and how the plan was found; written, and read back.

Tables that have no simulated time are logged at 1 ms per row: wall time would make no two files alike.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.values import ShowsItsRepr
from drake_diff.certificates.certificate import Certificate
from drake_diff.exceptions import ArtifactError
from drake_diff.logs.channels import (
    TYPES,
    MessageType,
    Shown,
    input_channel,
    motion_channels,
    nanoseconds,
    state_channel,
)
from drake_diff.logs.mcap_file import Channel, McapLog, read_mcap, write_mcap
from drake_diff.model.parameters import applied
from drake_diff.motion.rollout import CONTINUOUS
from drake_diff.runs.fields import canonical
from drake_diff.runs.measurement import Measurement, gradient_norms

ROW_PERIOD = 1_000_000  # [ns] of log time per row of a table
CONFIGURATION = "configuration.json"
MEDIA_TYPES = {".urdf": "application/xml", ".sdf": "application/xml", ".xml": "application/xml"}
# What `read_trace` needs; a trace has more channels than these.
CHANNELS = {"/state", "/input", "/planned/state", "/planned/input", "/planned/plan", "/diagnostics"}


def write_trace(path: Path, m: Measurement, attachments: Mapping[str, tuple[str, bytes]]) -> None:
    """Write the trace of a measurement; `attachments` are name: (media type, data).

    The configuration and the model file are attached beside them. The frames are those of the plant with the
    solution's parameters.
    """
    solution = m.solution
    problem = solution.problem
    configuration = {
        "method": solution.method,
        "solver": solution.solver,
        "scheme": solution.scheme,
        "num_steps": problem.num_steps,
        "time_step_s": problem.time_step,
        # A number that is not finite is text here, as JSON has none.
        "options": json.loads(json.dumps(solution.options, default=str), parse_constant=str),
    }
    files = {CONFIGURATION: ("application/json", canonical(configuration).encode()), **attachments}
    if problem.moved is not None and problem.moved.source is not None:
        source = problem.moved.source
        files[source.name] = (MEDIA_TYPES.get(source.suffix, "application/octet-stream"), source.read_bytes())
    metadata = {
        "status": solution.status.value,
        "method": solution.method,
        "model": problem.name,
        "time_axis": "simulated; tables: 1 ms per row",
        "motion": _told_of_motion(m),
        "verdict_rests_on": m.shown[1],
    }
    shown = Shown(problem.model, solution.time_step, m.xs, m.motion) if problem.has_model else None
    # The solver's tables and the plan are made before the parameters are applied: its replays use the plant too.
    channels = [*_solver_channels(m), *_plan_channels(m), _event_channel(m)]
    with applied(solution.vector) if shown else nullcontext():
        write_mcap(path, [*(motion_channels(shown) if shown else _no_motion(m)), *channels], metadata, files)


def _told_of_motion(m: Measurement) -> str:
    if m.motion is None:
        return "missing: it could not be stepped"
    continuous = m.solution.problem.motion == CONTINUOUS
    return "in continuous time, integrated apart, open loop" if continuous else "the discrete plant, open loop"


def _no_motion(m: Measurement) -> Iterator[Channel]:
    """The channels of a motion on the plant, empty: plain dynamics have no plant."""
    nothing = np.zeros((0, len(m.positions)))
    yield state_channel("/state", nothing[:, 0], nothing, m.positions, m.velocities)
    yield input_channel("/input", nothing[:, 0], nothing, m.inputs)
    kind = TYPES["Diagnostics"]
    yield Channel("/diagnostics", kind.cls, [], {"units": kind.units})


def _plan_channels(m: Measurement) -> Iterator[Channel]:
    """All that a Solution's numbers are made of: states, inputs at knots and midpoints, horizon, parameters."""
    solution, times = m.solution, m.solution.times
    inputs = solution.inputs_at_knots
    yield state_channel("/planned/state", times, solution.xs, m.positions, m.velocities)
    yield input_channel("/planned/input", times[: len(inputs)], inputs, m.inputs)
    if solution.us_mid is not None:
        yield input_channel("/planned/input_mid", (times[:-1] + times[1:]) / 2, solution.us_mid, m.inputs)
    kind, vector = TYPES["Plan"], solution.vector
    plan = kind.cls(
        scheme=solution.scheme,
        num_steps=len(solution.us),
        horizon=solution.horizon,
        horizon_is_free=solution.free_horizon is not None,
        parameters=vector.values.tolist(),
        mesh=[] if solution.mesh is None else solution.mesh.tolist(),
    )
    units = [p.unit for p in vector.parameters for _ in p.value]
    metadata = {
        "units": {**kind.units, "parameters": dict(zip(vector.names, units, strict=True))},
        "names": {"parameters": list(vector.names)},
    }
    yield Channel("/planned/plan", kind.cls, [(0, plan)], metadata)


def _solver_channels(m: Measurement) -> Iterator[Channel]:
    """The solver's own table, a row per certificate, the gradient's norm at each step, a row per replay."""
    solution = m.solution
    kind = TYPES["SolverIteration"]
    yield _table("/solver/iterations", kind, [_fields(kind, row) for row in solution.iterations], "iteration")
    checks = [_gradient_check(c) for c in solution.certificates]
    yield _table("/gradient/check", TYPES["GradientCheck"], checks, "certificate")
    kind = TYPES["GradientNorm"]
    norms = [np.full(len(m.times), np.nan) if n is None else n for n in gradient_norms(solution)]
    known = any(np.any(np.isfinite(n)) for n in norms)
    by_knot = enumerate(zip(*norms, strict=True)) if known else ()
    rows = [
        (nanoseconds(float(m.times[k])), kind.cls(step=k, final_state=end, lagrangian=slope))
        for k, (end, slope) in by_knot
    ]
    yield Channel("/gradient/norm", kind.cls, rows, {"units": kind.units})
    kind = TYPES["Replay"]
    yield _table("/replays", kind, [_fields(kind, replay) for replay in m.replays], "replay")


def _fields(kind: MessageType, value: Any) -> Any:
    """The message of a value that has an attribute for each of its fields."""
    return kind.cls(**{field.name: getattr(value, field.name) for field in kind.cls.DESCRIPTOR.fields})


def _table(topic: str, kind: MessageType, rows: Sequence[Any], row: str) -> Channel:
    timed = [(rank * ROW_PERIOD, message) for rank, message in enumerate(rows)]
    return Channel(topic, kind.cls, timed, {"units": kind.units, "time_axis": f"1 ms per {row}"})


def _gradient_check(c: Certificate) -> Any:
    worst = c.worst if c.codes.size else None  # a derivative by nothing has no entry
    derivative, difference = c.derivative.ravel(), c.difference.ravel()
    lengths = float(np.linalg.norm(derivative) * np.linalg.norm(difference))
    return TYPES["GradientCheck"].cls(
        subject=c.subject,
        method=c.method,
        verdict=c.verdict,
        entries=int(c.codes.size),
        agreeing=c.count("agree"),
        cosine=float(derivative @ difference) / lengths if lengths else float("nan"),
        worst_row=worst.row if worst else "",
        worst_column=worst.column if worst else "",
        worst_derivative=worst.derivative if worst else float("nan"),
        worst_difference=worst.difference if worst else float("nan"),
        worst_tolerance=worst.tolerance if worst else float("nan"),
        mode_changes=[str(change) for change in c.mode_changes],
    )


def _event_channel(m: Measurement) -> Channel:
    """The events and failures of the record: what is before the motion at 0 s, failures at its end."""
    kind = TYPES["Event"]
    before = [event for event in m.events if event.kind != "failure"]
    rows = [kind.cls(time=event.t_s or 0.0, kind=event.kind, message=event.message) for event in before]
    end = float(m.solution.times[-1])
    for f in m.failures:
        rows.append(kind.cls(time=end, kind="failure", failure_label=f.label, code=f.code, message=f.message))
    return Channel("/events", kind.cls, [(nanoseconds(row.time), row) for row in rows], {"units": kind.units})


@dataclass(frozen=True, eq=False, repr=False)
class Trace(ShowsItsRepr):
    """The numbers of a trace; arrays are read-only.

    `xs` (N+1, nx) under `us` (N, nu) is the open-loop motion of the discrete plant, without rows where it could not
    be taken; `planned_xs` (N+1, nx), `planned_us` (N or N+1, nu) and `planned_us_mid` (N, nu) are the solver's.

    Example:
        >>> from drake_diff.runs import read_trace
        >>> trace = read_trace("artifacts/pendulum_swing_up/trace.mcap")
        >>> sorted(trace.attachments), float(trace.diagnostics["max_penetration"].max())
        (['configuration.json', 'pendulum.urdf', 'record.json'], 0.0)
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
    mesh: Array | None  # (N+1,) the knots as fractions of the horizon, where it was refined
    diagnostics: dict[str, Array]  # (N+1,) each, by the name of a field of drake_diff.Diagnostics
    metadata: dict[str, str]
    attachments: dict[str, bytes]

    def __repr__(self) -> str:
        counts = f"{len(self.planned_xs)} planned states, {len(self.xs)} of the motion, {self.us.shape[1]} inputs"
        files = ", ".join(self.attachments)
        return f"Trace of {self.metadata.get('model', '?')}: {counts}, {self.horizon:g} s\n  {files}"

    @property
    def plan(self) -> dict[str, Any]:
        """The fields of a `Solution` that hold its numbers: `Solution(problem, method, ..., **trace.plan)`."""
        count = max(len(self.planned_xs) - 1, 0)
        return {
            "xs": self.planned_xs,
            "us": self.planned_us[:count],
            "scheme": self.scheme,
            "us_mid": self.planned_us_mid,
            "u_final": self.planned_us[count] if len(self.planned_us) > count else None,
            "mesh": self.mesh,
            "free_horizon": self.horizon if self.horizon_is_free else None,
            "parameters": self.parameters,
        }


def read_trace(path: str | Path) -> Trace:
    """Read the numbers of a trace back, bit for bit as they were written.

    Args:
        path: A trace.mcap that `save` wrote.

    Returns:
        A `Trace`.

    Raises:
        ArtifactError: The file is damaged or lacks a channel.

    Example:
        >>> from drake_diff.runs import read_trace
        >>> trace = read_trace("artifacts/pendulum_swing_up/trace.mcap")
        >>> trace.xs.shape, trace.us.shape, float(trace.times[-1])
        ((41, 2), (40, 1), 0.8)
    """
    log = read_mcap(path, links=False)
    missing = CHANNELS - set(log.messages)
    if missing:
        raise ArtifactError(f"{path}: no channel {', '.join(sorted(missing))}")
    plan = log.arrays("/planned/plan")
    if len(plan["horizon"]) != 1:
        raise ArtifactError(f"{path}: expected one message of /planned/plan, got {len(plan['horizon'])}")
    try:
        return _trace(log, plan)
    except (LookupError, ValueError) as error:
        raise ArtifactError(f"{path}: its channels do not fit together: {error}") from error


def _trace(log: McapLog, plan: dict[str, Any]) -> Trace:
    planned, middles = log.arrays("/planned/state"), "/planned/input_mid"
    return Trace(
        times=frozen(planned["time"]),
        xs=_states(log.arrays("/state")),
        us=frozen(log.arrays("/input")["u"]),
        planned_xs=_states(planned),
        planned_us=frozen(log.arrays("/planned/input")["u"]),
        planned_us_mid=frozen(log.arrays(middles)["u"]) if middles in log.messages else None,
        scheme=str(plan["scheme"][0]),
        horizon=float(plan["horizon"][0]),
        horizon_is_free=bool(plan["horizon_is_free"][0]),
        parameters=frozen(plan["parameters"][0]),
        mesh=frozen(plan["mesh"][0]) if len(plan["mesh"][0]) else None,
        diagnostics={name: frozen(values) for name, values in log.arrays("/diagnostics").items()},
        metadata=log.metadata.get("run", {}),
        attachments=log.attachments,
    )


def _states(columns: dict[str, Any]) -> Array:
    return frozen(np.hstack([columns["q"], columns["v"]]))

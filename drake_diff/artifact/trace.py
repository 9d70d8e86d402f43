"""The channels of trace.mcap that tell how a solution was found: plan, iterations, gradients, replays, events.

Those that have no simulated time are logged at 1 ms per row: wall time would make no two files alike.

What is in trace.mcap: the motion on the discrete plant and the plan, in simulated time.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff.certificates.certificate import Certificate
from drake_diff.logs.channels import Shown, input_channel, motion_channels, nanoseconds, state_channel
from drake_diff.logs.messages import TYPES, MessageType
from drake_diff.logs.write import Channel, write_mcap
from drake_diff.model.parameters import applied
from drake_diff.optimize.solution import Solution
from drake_diff.record.solve import EvidenceRecord

ROW_PERIOD = 1_000_000  # [ns] of log time per row of a table


def plan_channels(solution: Solution, shown: Shown) -> Iterator[Channel]:
    """All that a Solution's numbers are made of: states, inputs at knots and midpoints, horizon, parameters."""
    inputs = solution.inputs_at_knots
    yield state_channel(shown, "/planned/state", solution.xs)
    yield input_channel(shown, "/planned/input", shown.times(len(inputs)), inputs)
    if solution.us_mid is not None:
        middles = np.asarray(solution.time_step * (np.arange(len(solution.us_mid)) + 0.5), dtype=float)
        yield input_channel(shown, "/planned/input_mid", middles, solution.us_mid)
    kind, vector = TYPES["Plan"], solution.vector
    plan = kind.cls(
        scheme=solution.scheme,
        num_steps=len(solution.us),
        horizon=solution.horizon,
        horizon_is_free=solution.free_horizon is not None,
        parameters=vector.values.tolist(),
    )
    units = [p.unit for p in vector.parameters for _ in p.value]
    metadata = {
        "units": {**kind.units, "parameters": dict(zip(vector.names, units, strict=True))},
        "names": {"parameters": list(vector.names)},
    }
    yield Channel("/planned/plan", kind.cls, [(0, plan)], metadata)


def solver_channels(solution: Solution, shown: Shown) -> Iterator[Channel]:
    """The solver's own table, a row per certificate, the gradient's norm at each step, a row per replay."""
    kind = TYPES["SolverIteration"]
    yield _table("/solver/iterations", kind, [_fields(kind, row) for row in solution.iterations], "iteration")
    checks = [_gradient_check(c) for c in solution.certificates]
    yield _table("/gradient/check", TYPES["GradientCheck"], checks, "certificate")
    kind = TYPES["GradientNorm"]
    norms = [] if solution.gradient_norms is None else solution.gradient_norms.tolist()
    rows = [
        (nanoseconds(t), kind.cls(step=k, norm=norm))
        for k, (t, norm) in enumerate(zip(shown.times(len(norms)), norms, strict=True))
    ]
    yield Channel("/gradient/norm", kind.cls, rows, {"units": kind.units})
    kind = TYPES["Replay"]
    yield _table("/replays", kind, [_fields(kind, replay) for replay in solution.replays], "replay")


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


def event_channel(solution: Solution, shown: Shown, attachments: Mapping[str, tuple[str, bytes]]) -> Channel:
    """Contact made and broken along the motion, how the solve ended, and the failures as the record labels them."""
    kind, end = TYPES["Event"], shown.time_step * (len(solution.xs) - 1)
    events = list(_contact_events(shown))
    events.append(kind.cls(time=end, kind="status", code=solution.status.value, message=solution.message))
    record = json.loads(attachments[EvidenceRecord.FILE][1]) if EvidenceRecord.FILE in attachments else {"failures": []}
    for failure in record["failures"]:
        label, code, message = failure["label"], failure["code"], failure["message"]
        events.append(kind.cls(time=end, kind="failure", failure_label=label, code=code, message=message))
    return Channel("/events", kind.cls, [(nanoseconds(e.time), e) for e in events], {"units": kind.units})


def _contact_events(shown: Shown) -> Iterator[Any]:
    before: set[tuple[str, str]] = set()
    contacts = () if shown.motion is None else shown.motion.contacts
    for t, of_step in zip(shown.times(len(contacts)), contacts, strict=True):
        touching = {(c.body_a, c.body_b) for c in of_step}
        for code, pairs in (("contact_made", touching - before), ("contact_broken", before - touching)):
            for a, b in sorted(pairs):
                yield TYPES["Event"].cls(time=t, kind="contact", code=code, message=f"{a} on {b}")
        before = touching


CONFIGURATION = "configuration.json"
MEDIA_TYPES = {".urdf": "application/xml", ".sdf": "application/xml", ".xml": "application/xml"}


def write_trace(path: Path, solution: Solution, attachments: Mapping[str, tuple[str, bytes]]) -> None:
    """Write the trace of `solution`; `attachments` are name: (media type, data).

    The configuration and the model file are attached beside them. The frames are those of the plant with the
    solution's parameters.
    """
    model, motion = solution.problem.model, solution.replay
    files = {CONFIGURATION: ("application/json", _configuration(solution)), **attachments}
    if model.source is not None:
        media_type = MEDIA_TYPES.get(model.source.suffix, "application/octet-stream")
        files[model.source.name] = (media_type, model.source.read_bytes())
    metadata = {
        "status": solution.status.value,
        "method": solution.method,
        "model": model.name,
        "time_axis": "simulated; tables: 1 ms per row",
        "motion": "missing: it could not be stepped" if motion is None else "the discrete plant, open loop",
    }
    shown = Shown(model, solution.time_step, solution.xs, motion)
    channels = [*solver_channels(solution, shown), *plan_channels(solution, shown)]  # its replays use the plant too
    channels.append(event_channel(solution, shown, attachments))
    with applied(solution.vector):
        write_mcap(path, [*motion_channels(shown), *channels], metadata, files)


def _configuration(solution: Solution) -> bytes:
    """How it was solved, as JSON; a number that is not finite as text."""
    fields = {
        "method": solution.method,
        "solver": solution.solver,
        "scheme": solution.scheme,
        "num_steps": solution.problem.num_steps,
        "time_step_s": solution.problem.model.time_step,
        "options": json.loads(json.dumps(solution.options, default=str), parse_constant=str),
    }
    return (json.dumps(fields, sort_keys=True, indent=2, allow_nan=False) + "\n").encode()

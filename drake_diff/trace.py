"""What is in trace.mcap: the motion on the discrete plant and the plan, in simulated time."""

import json
from collections.abc import Mapping
from pathlib import Path

from drake_diff.mcap_log import write_mcap
from drake_diff.parameters import applied
from drake_diff.solution import Solution
from drake_diff.trace_motion import Shown, motion_channels
from drake_diff.trace_solve import event_channel, plan_channels, solver_channels

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

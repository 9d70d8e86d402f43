"""All that a loop saw and did in one trial, as trace.mcap."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff.loop.closed_loop import OK
from drake_diff.loop.trial import Trial
from drake_diff.mcap_log import Channel, write_mcap
from drake_diff.mcap_messages import TYPES
from drake_diff.trace_motion import Shown, input_channel, motion_channels, nanoseconds, state_channel


def write_trial_trace(path: Path, shown: Shown, trial: Trial) -> None:
    """Write the trace of `trial`, whose motion and plan are `shown`. Latencies differ each time and are apart."""
    metadata = {
        "model": shown.model.name,
        "time_axis": "simulated",
        "perturbation": json.dumps(dict(trial.levels), sort_keys=True),
        "label": trial.label or "success",
    }
    write_mcap(path, list(_channels(shown, trial)), metadata, {})


def _channels(shown: Shown, trial: Trial) -> Iterator[Channel]:
    """The true motion and the plan, then what the loop saw, took it for, commanded and applied, and what happened."""
    yield from motion_channels(shown)
    yield state_channel(shown, "/planned/state", shown.planned_xs)
    run = trial.outcome.run
    seen = ~np.isnan(run.observations).any(axis=1)
    yield state_channel(shown, "/observation", run.observations[seen], run.times[seen])
    yield state_channel(shown, "/estimate", run.estimates, run.times)
    yield input_channel(shown, "/command", run.times, run.commands)
    yield input_channel(shown, "/applied", run.times, run.applied)
    kind = TYPES["Event"]
    statuses = [
        kind.cls(time=t, kind="controller", code=OK if status == OK else "other", message=status)
        for t, status in zip(run.times.tolist(), run.controller_status, strict=True)
    ]
    yield _events("/controller/status", statuses)
    events = [kind.cls(time=e.t, kind=e.kind, message=e.message) for e in run.events]
    end = shown.time_step * (len(shown.xs) - 1)
    if trial.label is not None:
        last = kind.cls(time=end, kind="failure", failure_label=trial.label, code=trial.label, message=trial.reason)
        events.append(last)
    yield _events("/events", events)


def _events(topic: str, events: Sequence[Any]) -> Channel:
    kind = TYPES["Event"]
    ordered = sorted(((nanoseconds(e.time), e) for e in events), key=lambda row: row[0])
    return Channel(topic, kind.cls, ordered, {"units": kind.units})

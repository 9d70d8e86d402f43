"""One trial on disk: what it was, a trace of all that the loop saw and did, a replay beside the plan, its latencies."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.files import make_folder, write_whole
from drake_diff.logs.channels import TYPES, Shown, input_channel, motion_channels, nanoseconds, state_channel
from drake_diff.logs.mcap_file import Channel, write_mcap
from drake_diff.loop.run import OK
from drake_diff.model.parameters import applied, select
from drake_diff.runs.fields import canonical, finite
from drake_diff.runs.plan_record import EventEvidence, TrialEvidence
from drake_diff.trials.perturbation import Setup, perturbed
from drake_diff.trials.trial import Task, Trial

TRIAL, TRACE, REPLAY, LATENCIES = "trial.json", "trace.mcap", "replay.html", "latencies.json"
FURTHEST = 1e6  # m and rad: what runs away further is drawn here; the trace has it as it was


def write_trial(folder: Path, task: Task, trial: Trial, run: str | None) -> None:
    """Write trial.json, trace.mcap, replay.html and latencies.json of `trial` into `folder`.

    `run` is the run directory that its plan is from, if there is one. The same trial gives the same bytes, but for the
    latencies.
    """
    from drake_diff.pages.meshcat import write_replay
    from drake_diff.pages.scene import BLUE, scene_of

    make_folder(folder)
    evidence = trial_evidence(task, trial, run)
    write_whole(folder / TRIAL, canonical(evidence.model_dump(mode="json")).encode())
    latencies = {"budget_s": trial.outcome.run.latency_budget, "latencies_s": trial.outcome.run.latencies.tolist()}
    write_whole(folder / LATENCIES, canonical(latencies).encode())
    setup, motion = perturbed(task.setup, trial.levels, trial.seed), trial.outcome.run.motion
    planned = planned_states(task, setup)
    with applied(select(setup.model, setup.parameters)) as model:
        write_trial_trace(folder / TRACE, Shown(model, model.time_step, planned, motion), trial)
        xs, ghost = (np.clip(states, -FURTHEST, FURTHEST) for states in (motion.xs, planned))
        xs = xs if len(xs) > 1 else np.repeat(xs, 2, axis=0)  # it broke off at once
        times = np.asarray(model.time_step * np.arange(len(xs)), dtype=float)
        contacts = motion.contacts if len(motion.contacts) == len(xs) - 1 else ()
        scene = scene_of(model, times, xs, us=motion.us, contacts=contacts, ghosts={"plan": (ghost[: len(xs)], BLUE)})
        far = f", drawn up to {FURTHEST:g} only" if np.any(np.abs(motion.xs) > FURTHEST) else ""
        title = f"{evidence.perturbation} {evidence.level:g}: {trial.label or 'success'}{far}"
        write_replay(folder / REPLAY, scene, title=title)


def planned_states(task: Task, setup: Setup) -> Array:
    """(n+1, nx) of the plan at each step of the plant of `setup`."""
    finer = round(task.model.time_step / setup.model.time_step)
    return np.asarray(task.plan.sample(task.parts * finer)[0])


def trial_evidence(task: Task, trial: Trial, run: str | None) -> TrialEvidence:
    """What trial.json says."""
    (name, level), *_ = trial.levels.items()
    setup = perturbed(task.setup, trial.levels, trial.seed)
    return TrialEvidence(
        run=run,
        controller=task.controller_name,
        perturbation=name,
        level=level,
        seed=trial.seed,
        reason=trial.reason,
        **result_of(trial),
        plant_time_step_s=setup.model.time_step,
        controller_period_s=setup.loop.substeps * setup.model.time_step,
        parameters={key: np.asarray(value).tolist() for key, value in setup.parameters.items()},
        start=setup.x0.tolist(),
        events=[EventEvidence(t_s=e.t, kind=e.kind, message=e.message) for e in trial.outcome.run.events],
    )


def result_of(trial: Trial) -> dict[str, Any]:
    """What became of a trial, in JSON's types; no displacement where the run broke off or it is not finite."""
    outcome = trial.outcome
    return {
        "success": outcome.success,
        "label": trial.label,
        "goal_error": finite(outcome.goal_error),
        "displacement": None if outcome.run.ended else finite(float(np.linalg.norm(outcome.displacement))),
        "failures": list(outcome.failures),
        "ended": outcome.run.ended,
    }


def write_trial_trace(path: Path, shown: Shown, trial: Trial) -> None:
    """Write the trace of `trial`; `shown` has its motion and plan. Latencies differ each time and are not in it."""
    metadata = {
        "model": shown.model.name,
        "time_axis": "simulated",
        "perturbation": json.dumps(dict(trial.levels), sort_keys=True),
        "label": trial.label or "success",
    }
    run, contract = trial.outcome.run, shown.model.contract
    states, planned = (contract.positions, contract.velocities), shown.planned_xs
    seen = ~np.isnan(run.observations).any(axis=1)
    kind = TYPES["Event"]
    statuses = [
        kind.cls(time=t, kind="controller", code=OK if status == OK else "other", message=status)
        for t, status in zip(run.times.tolist(), run.controller_status, strict=True)
    ]
    events = [kind.cls(time=e.t, kind=e.kind, message=e.message) for e in run.events]
    end = shown.time_step * (len(shown.xs) - 1)
    if trial.label is not None:
        last = kind.cls(time=end, kind="failure", failure_label=trial.label, code=trial.label, message=trial.reason)
        events.append(last)
    channels = [
        *motion_channels(shown),
        state_channel("/planned/state", shown.times(len(planned)), planned, *states),
        state_channel("/observation", run.times[seen], run.observations[seen], *states),
        state_channel("/estimate", run.times, run.estimates, *states),
        input_channel("/command", run.times, run.commands, contract.inputs),
        input_channel("/applied", run.times, run.applied, contract.inputs),
        _events("/controller/status", statuses),
        _events("/events", events),
    ]
    write_mcap(path, channels, metadata, {})


def _events(topic: str, events: Sequence[Any]) -> Channel:
    kind = TYPES["Event"]
    ordered = sorted(((nanoseconds(e.time), e) for e in events), key=lambda row: row[0])
    return Channel(topic, kind.cls, ordered, {"units": kind.units})

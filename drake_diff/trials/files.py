"""Write robustness results: the record, a page, a row for each trial, and a directory for each of the worst trials.

A saved trial consists of its description, a trace of all signals in the loop, a replay together with the plan, and its
latencies.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.files import make_folder, read_plain, write_whole
from drake_diff._base.statistics import ENOUGH
from drake_diff.exceptions import ArtifactError
from drake_diff.logs.channels import TYPES, Shown, motion_channels, state_channel
from drake_diff.logs.mcap_file import write_mcap
from drake_diff.loop.files import FURTHEST, latency_times, loop_channels, loop_evidence, loop_plots
from drake_diff.loop.run import Hold, Loop
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, select
from drake_diff.pages.html import Line, Plot, page_again, page_data, write_page
from drake_diff.runs.differences import Reproduced
from drake_diff.runs.directory import load_plan_record, name_of, written_whole
from drake_diff.runs.fields import DataBoundary, DataUse, Event, WallClock, canonical, evidence, read_fields
from drake_diff.runs.plan_record import (
    LoopEvidence,
    Nominal,
    PlanRecord,
    RobustnessSection,
    RunEvidence,
    TrialEvidence,
)
from drake_diff.runs.provenance import header
from drake_diff.trials.perturbation import Setup, perturbed
from drake_diff.trials.run import Robustness, agrees, sentence_of, sized, weakest_of
from drake_diff.trials.trial import Task, Trial, result_of

PAGE, TEMPLATE, TABLE = "robustness.html", "robustness.html.j2", "trials.csv"
PLAIN = Loop()


def save_robustness(result: Robustness, directory: str | Path, run: str | Path | None = None) -> PlanRecord:
    """Write the directory of a robustness result: the report, a row for each trial, and the worst trials in full.

    robustness.html is the report, and trials.csv has a row for each trial. For each perturbation, worst/NAME_LEVEL/
    contains the worst trial at the lowest level with a failure (without a failure, the trial furthest from the goal):
    trial.json, trace.mcap, replay.html, latencies.json. The files are written to a temporary directory, which replaces
    `directory` at the end. The same trials give the same bytes, except for wall-clock times.

    Args:
        result: The result of `robustness`.
        directory: The output directory. It is created, and replaces an earlier run.
        run: The run directory of the plan, if there is one, from which the trials can be run again.

    Returns:
        The record, as in record.json.

    Raises:
        InputError: `directory` contains files that are not from a run.
        ArtifactError: There is no record in `run`.
        WriteError: The disk is full or does not permit writing.

    Example:
        >>> from tempfile import mkdtemp
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.02)
        >>> cost = dd.QuadraticCost(R=[[1.0]])
        >>> problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=cost)
        >>> result = dd.robustness(dd.solve(problem, method="shooting"), {"mass": [0.05]}, trials=2)
        >>> from drake_diff.trials import save_robustness
        >>> save_robustness(result, mkdtemp()).verdict
        'pass'
    """
    with written_whole(directory) as folder:
        return write_robustness(result, folder, run)


def write_robustness(result: Robustness, folder: Path, run: str | Path | None) -> PlanRecord:
    """Write the files of `save_robustness` to `folder`, which comes from `written_whole`."""
    task, name = result.task, name_of(folder)
    source = None if run is None else RunEvidence(path=str(run), record_sha256=load_plan_record(run).record_sha256)
    sentence = "the trials are still being written, or writing them was killed or failed"
    _record(name, task.model, "incomplete", sentence).begin(folder)
    record = _record(
        name,
        task.model,
        "pass" if result.success else "fail",
        result.sentence,
        run=source,
        trials=result.trials,
        seed=result.seed,
        loop=_loop(task),
        nominal=evidence(Nominal, task.nominal, ended=task.nominal.run.ended),
        perturbations=list(result.perturbations),
    )
    sections = {"data": _data(result, source), "wall_clock": _times(result, record.wall_clock)}
    record = record.model_copy(update=sections)
    for perturbation in result.perturbations:
        worst = result.worst(perturbation.name).worst
        write_trial(folder / perturbation.worst, task, worst, str(run) if run and _is_repeatable(task) else None)
    write_whole(folder / TABLE, _table(result).encode())
    data, facts = robustness_data(result), _page_facts(folder, record)
    write_page(folder / PAGE, TEMPLATE, data=data, **facts)
    return record.write(folder)


def _is_repeatable(task: Task) -> bool:
    """Return whether a trial can be run again from trial.json alone, which requires a loop without custom parts."""
    loop, named = task.loop, ("sensor", "actuator", "fallback", "substeps")
    plain_loop = all(repr(getattr(loop, name)) == repr(getattr(PLAIN, name)) for name in named)
    return plain_loop and isinstance(task.controller, str) and type(loop.estimator) is Hold and not loop.pushes


def _data(result: Robustness, run: RunEvidence | None) -> DataBoundary:
    plan = DataUse(name="plan", what="given as it is" if run is None else run.path,
                   sha256=None if run is None else run.record_sha256)  # fmt: skip
    trials = DataUse(name="trials", what=f"{result.trials} of each level, drawn from the seed {result.seed}")
    statement = "the plan was made before, without these trials; nothing was fitted to them"
    return DataBoundary(statement=statement, seen=[plan], judged_on=[trials], held_out=[trials.name])


def _record(name: str, model: Model, verdict: Any, sentence: str, **trials: Any) -> PlanRecord:
    states, inputs = list(model.state_names), list(model.input_names)
    section = RobustnessSection(state_names=states, input_names=inputs, **trials)
    return PlanRecord(verdict=verdict, sentence=sentence, robustness=section, **header(name, model))


def _loop(task: Task) -> LoopEvidence:
    return loop_evidence(task.loop, task.controller_name, task.model, len(task.us), task.judged_by)


def _times(result: Robustness, clock: WallClock) -> WallClock:
    runs = [result.task.nominal.run, *(c.worst.outcome.run for c in result.cells)]
    budget = _loop(result.task).latency_budget_s
    return clock.model_copy(update=latency_times([run.latencies for run in runs], budget))


def _table(result: Robustness) -> str:
    """Return the table with a row for each trial, from which the rates are computed."""
    text = io.StringIO(newline="")
    rows = csv.writer(text, lineterminator="\n")
    ends = [f"last {name}" for name in result.task.model.state_names]
    rows.writerow(["perturbation", "level", "seed", "success", "label", "reason", "goal_error", *ends])
    for c in result.cells:
        for e in c.endings:
            judgement = [int(e.label is None), e.label or "", e.reason, e.goal_error]
            rows.writerow([c.perturbation, c.level, e.seed, *judgement, *map(float, e.last)])
    return text.getvalue()


def _page_facts(folder: Path, record: PlanRecord) -> dict[str, Any]:
    """Return the data of the page without plots: the record, and the worst trial of the weakest perturbation."""
    section: Any = record.robustness
    worst = weakest_of(section.perturbations).worst
    trial: Any = read_fields(folder / worst / TRIAL)
    reason = trial["reason"] or "it succeeds, but it ends furthest from the goal of all trials"
    much = sized(trial["perturbation"], trial["level"])
    return {
        "record": record.content(),
        "view": read_plain(folder / worst / REPLAY).decode(errors="replace"),
        "caption": f"The worst trial of {trial['perturbation']} {much}, with the plan as a ghost: {reason}.",
        "enough": ENOUGH,
        "agrees": agrees,
    }


def reproduce(folder: Path, record: PlanRecord, models: Path | None) -> Reproduced:
    """Write the sentence and pages of a robustness record again, with the plots and motions of those in `folder`."""
    from drake_diff.pages.meshcat import replay_again

    section, files = record.robustness, dict[str, bytes]()
    if section is None or section.nominal is None:
        raise ArtifactError(f"{record.FILE}: expected trials and an unperturbed run")
    for p in section.perturbations:
        name = f"{p.worst}/{REPLAY}"
        if name not in record.files or f"{p.worst}/{TRIAL}" not in record.files:
            raise ArtifactError(f"{record.FILE}: the files of the worst trial of {p.name} are not listed")
        page, trial = read_plain(folder / name).decode(errors="replace"), read_fields(folder / p.worst / TRIAL)
        title = f"{trial['perturbation']} {trial['level']:g}: {trial['label'] or 'success'}"
        files[name] = replay_again(page, title + FAR * (f"{title}{FAR}</title>" in page))
    if PAGE in record.files:
        files[PAGE] = page_again(folder / PAGE, TEMPLATE, **_page_facts(folder, record))
    trial = read_fields(folder / weakest_of(section.perturbations).worst / TRIAL)
    sentence = {"sentence": sentence_of(section.nominal, section.perturbations, trial["reason"])}
    names = (f"{p.worst}/{name}" for p in section.perturbations for name in (TRIAL, TRACE, REPLAY, LATENCIES))
    return Reproduced(sentence, files, written=(PAGE, TABLE, *names), recorded={"sentence": record.sentence})


def robustness_data(result: Robustness) -> dict[str, Any]:
    """Return the plots of the page, see `page_data`."""
    task = result.task
    plots = list(_trial_plots(task, result.worst(result.weakest).worst))
    for name in result.names:
        plots += _level_plots(result, name)
    return page_data(task.model.time_step * len(task.us), plots)


def _trial_plots(task: Task, trial: Trial) -> Iterator[Plot]:
    """Yield plots of a trial: actual, measured, estimated and planned coordinates, inputs, controller status."""
    run, setup = trial.outcome.run, perturbed(task.setup, trial.levels, trial.seed)
    planned = planned_states(task, setup)
    planned_us = np.repeat(task.us, (len(planned) - 1) // len(task.us), axis=0)
    yield from loop_plots(run, len(planned), (planned, planned_us), task.plan.problem.bounds, task.plan.scale)


def _level_plots(result: Robustness, name: str) -> Iterator[Plot]:
    """Yield plots of a perturbation over its levels: success, displacement, and the last state of every trial."""
    task, cells = result.task, result.of(name)
    levels = [c.level for c in cells]
    axis_options: dict[str, Any] = {"axis": "level", "levels": True, "marks": "both", "place": name}
    rates = [
        Line("rate", [c.rate.value for c in cells]),
        Line("95 %, lower", [c.rate.lower for c in cells], dashed=True),
        Line("upper", [c.rate.upper for c in cells], dashed=True),
    ]
    yield Plot("success", "1", levels, rates, band=True, range=[-0.03, 1.03], **axis_options)
    moved = [Line("measured", [c.displacement for c in cells])]
    known = any(c.predicted is not None for c in cells)
    moved += [Line("predicted", [c.predicted for c in cells], dashed=True)] if known else []
    note = "" if known else "no gradient predicts it"
    yield Plot("displacement of the last state", "q, v", levels, moved, log=True, note=note, **axis_options)
    # Last states in the two coordinates that spread most relative to the scale, one colour per level and for the plan.
    ends = [*(np.array([e.last for e in c.endings]) for c in cells), task.xs[-1:]]
    spread = np.ptp(np.vstack(ends), axis=0) / task.plan.scale
    i, j = sorted(np.argsort(-spread, kind="stable")[:2])
    across = np.concatenate([end[:, i] for end in ends])
    order = np.argsort(across, kind="stable")
    which = np.repeat(np.arange(len(ends)), [len(end) for end in ends])[order]
    up = np.concatenate([end[:, j] for end in ends])[order]
    labels, names = [*(f"level {level:g}" for level in levels), "the plan's"], task.model.state_names
    contract = task.model.contract
    units = [c.unit for c in (*contract.positions, *contract.velocities)]
    series = [Line(label, np.where(which == k, up, np.nan)) for k, label in enumerate(labels)]
    title = f"last {names[j]} over {names[i]}"
    yield Plot(title, units[j], across[order], series, axis=f"{names[i]} [{units[i]}]", marks="points", place=name)


TRIAL, TRACE, REPLAY, LATENCIES = "trial.json", "trace.mcap", "replay.html", "latencies.json"
FAR = f", drawn up to {FURTHEST:g} only"  # title of a page with a clipped motion


def write_trial(folder: Path, task: Task, trial: Trial, run: str | None) -> None:
    """Write trial.json, trace.mcap, replay.html and latencies.json of `trial` to `folder`.

    `run` is the run directory of its plan, if there is one. The same trial gives the same bytes, except for latencies.
    """
    from drake_diff.pages.meshcat import write_replay
    from drake_diff.pages.scene import BLUE, scene_of

    make_folder(folder)
    ((name, level),), loop_run = trial.levels.items(), trial.outcome.run
    setup, motion = perturbed(task.setup, trial.levels, trial.seed), loop_run.motion
    record = TrialEvidence(
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
        events=[Event.model_validate({"t_s": e.t, "kind": e.kind, "message": e.message}) for e in loop_run.events],
    )
    latencies = {"budget_s": loop_run.latency_budget, "latencies_s": loop_run.latencies.tolist()}
    write_whole(folder / TRIAL, canonical(record.model_dump(mode="json")).encode())
    write_whole(folder / LATENCIES, canonical(latencies).encode())
    planned = planned_states(task, setup)
    with applied(select(setup.model, setup.parameters)) as model:
        _write_trace(folder / TRACE, Shown(model, model.time_step, planned, motion), trial)
        xs, ghost = (np.clip(states, -FURTHEST, FURTHEST) for states in (motion.xs, planned))
        xs = xs if len(xs) > 1 else np.repeat(xs, 2, axis=0)  # the run stopped before its first step
        times = np.asarray(model.time_step * np.arange(len(xs)), dtype=float)
        contacts = motion.contacts if len(motion.contacts) == len(xs) - 1 else ()
        scene = scene_of(model, times, xs, us=motion.us, contacts=contacts, ghosts={"plan": (ghost[: len(xs)], BLUE)})
        far = FAR * bool(np.any(np.abs(motion.xs) > FURTHEST))
        write_replay(folder / REPLAY, scene, title=f"{name} {level:g}: {trial.label or 'success'}{far}")


def planned_states(task: Task, setup: Setup) -> Array:
    """Return the states (n+1, nx) of the plan at each step of the plant of `setup`."""
    finer = round(task.model.time_step / setup.model.time_step)
    return np.asarray(task.plan.sample(task.parts * finer)[0])


def _write_trace(path: Path, shown: Shown, trial: Trial) -> None:
    """Write the trace of the trial and the plan in `shown`, without latencies, as these differ in each run."""
    run, event, planned = trial.outcome.run, TYPES["Event"].cls, shown.planned_xs
    contract = shown.model.contract
    events = [event(time=e.t, kind=e.kind, message=e.message) for e in run.events]
    if trial.label is not None:
        code, end = trial.label, shown.time_step * (len(shown.xs) - 1)
        events.append(event(time=end, kind="failure", failure_label=code, code=code, message=trial.reason))
    channels = [
        *motion_channels(shown),
        state_channel("/planned/state", shown.times(len(planned)), planned, contract.positions, contract.velocities),
        *loop_channels(run, events),
    ]
    metadata = {
        "model": shown.model.name,
        "time_axis": "simulated",
        "perturbation": json.dumps(dict(trial.levels), sort_keys=True),
        "label": trial.label or "success",
    }
    write_mcap(path, channels, metadata, {})

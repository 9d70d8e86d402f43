"""Robustness saved: its record, a page, a row for each trial, and the worst trials as artifacts of their own."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.files import write_whole
from drake_diff.loop.parts import Hold
from drake_diff.loop.run import Loop
from drake_diff.model.model import Model
from drake_diff.runs.directory import name_of, written_whole
from drake_diff.runs.fields import DataBoundary, DataUse, EvaluationPanel, finite
from drake_diff.runs.plan_record import (
    CellEvidence,
    LoopEvidence,
    Nominal,
    PerturbationEvidence,
    PlanRecord,
    RobustnessSection,
    RunEvidence,
)
from drake_diff.runs.provenance import embodiment_of, model_input, provenance_of, written_now
from drake_diff.runs.read import load_plan_record
from drake_diff.runs.sealed import WallClock
from drake_diff.trials.perturbation import perturbation_named
from drake_diff.trials.run import Cell, Robustness
from drake_diff.trials.trial import Task
from drake_diff.trials.trial_files import REPLAY, write_trial

LATENCY = "latency"  # the perturbation whose levels are steps of the controller
PAGE, TABLE, WORST = "robustness.html", "trials.csv", "worst"
PLAIN = Loop()


def save_robustness(result: Robustness, directory: str | Path, run: str | Path | None = None) -> PlanRecord:
    """Write the directory of a robustness result: report, every trial's row, and the worst trials in full.

    robustness.html is the report, trials.csv has a row for each trial, and worst/NAME_LEVEL/ has, for each
    perturbation, the worst trial at the lowest level where one fails (without a failure, the one furthest from the
    goal): trial.json, trace.mcap, replay.html, latencies.json. All of it is written beside `directory`, and takes its
    place at the end. The same trials give the same bytes, but for wall-clock times.

    Args:
        result: what `robustness` returned.
        directory: where to write; it is created, and an earlier run there is replaced.
        run: the run directory that the plan is from, if there is one: its trials can then be run again from it.

    Returns:
        The record, as in record.json.

    Raises:
        InputError: `directory` holds what no run wrote.
        ArtifactError: there is no record in `run`.
        WriteError: the disk is full, or does not let a file be written.

    Example:
        >>> from tempfile import mkdtemp
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.02)
        >>> cost = dd.QuadraticCost(R=[[1.0]])
        >>> problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=cost)
        >>> result = dd.robustness(dd.solve(problem, method="shooting"), {"mass": [0.05]}, trials=2)
        >>> dd.trials.save_robustness(result, mkdtemp()).verdict
        'pass'
    """
    with written_whole(directory) as folder:
        return write_robustness(result, folder, run)


def write_robustness(result: Robustness, folder: Path, run: str | Path | None) -> PlanRecord:
    """Write what `save_robustness` does into `folder`, which `written_whole` gave."""
    from drake_diff.trials.page import write_robustness_page  # loads the page templates: not needed before

    task = result.task
    source = None if run is None else RunEvidence(path=str(run), record_sha256=load_plan_record(run).record_sha256)
    sentence = "the trials are still being written, or that was killed or broke off"
    _record(name_of(folder), task.model, "incomplete", sentence).begin(folder)
    record = record_of(result, name_of(folder), source)
    # A trial can be run again from what trial.json says where nothing in the loop is a user's own.
    loop, named = task.loop, ("sensor", "actuator", "fallback", "substeps")
    plain = all(repr(getattr(loop, name)) == repr(getattr(PLAIN, name)) for name in named)
    plain = plain and isinstance(task.controller, str) and type(loop.estimator) is Hold and not loop.pushes
    again = str(run) if run is not None and plain else None
    for name in result.names:
        write_trial(folder / _place(result.worst(name)), task, result.worst(name).worst, again)
    write_whole(folder / TABLE, _table(result).encode())
    write_robustness_page(folder / PAGE, result, record, folder / _place(result.worst(result.weakest)) / REPLAY)
    return record.write(folder)


def record_of(result: Robustness, name: str, run: RunEvidence | None = None) -> PlanRecord:
    """The record of `result`, but for the files."""
    task, nominal = result.task, result.task.nominal
    record = _record(
        name,
        task.model,
        "pass" if result.success else "fail",
        result.sentence,
        run=run,
        trials=result.trials,
        seed=result.seed,
        loop=_loop(task),
        nominal=Nominal(
            success=nominal.success,
            failures=list(nominal.failures),
            goal_error=finite(nominal.goal_error),
            ended=nominal.run.ended,
        ),
        perturbations=[
            PerturbationEvidence(
                name=name,
                unit=perturbation_named(name).unit,
                meaning=perturbation_named(name).meaning,
                margin=result.margins[name],
                cells=[_cell(c) for c in result.of(name)],
                worst=_place(result.worst(name)),
            )
            for name in result.names
        ],
    )
    found = {"panel": _panel(result), "data": _data(result, run), "wall_clock": _times(result)}
    return record.model_copy(update=found)


def _panel(result: Robustness) -> EvaluationPanel:
    """Every level of every perturbation, and the latencies among them."""
    units = {name: perturbation_named(name).unit for name in result.names}
    period = result.task.loop.substeps * result.task.model.time_step
    late = [0.0, *(c.level * period for name in result.names if name == LATENCY for c in result.of(name))]
    statement = f"the plan under the controller {result.task.controller_name}, each level by itself, seed {result.seed}"
    return EvaluationPanel(
        statement=statement,
        cases=[],
        perturbations=[f"{c.perturbation} {c.level:g} {units[c.perturbation]}, {c.rate.trials} trials"
                       for name in result.names for c in result.of(name)],
        latencies_s=[float(value) for value in late],
    ).hashed()  # fmt: skip


def _data(result: Robustness, run: RunEvidence | None) -> DataBoundary:
    plan = DataUse(name="plan", what="given as it is" if run is None else run.path,
                   sha256=None if run is None else run.record_sha256)  # fmt: skip
    trials = DataUse(name="trials", what=f"{result.trials} of each level, drawn from the seed {result.seed}")
    statement = "the plan was made before, without these trials; nothing was fitted to them"
    return DataBoundary(statement=statement, seen=[plan], judged_on=[trials], held_out=[trials.name])


def _record(name: str, model: Model, verdict: Any, sentence: str, **trials: Any) -> PlanRecord:
    states, inputs = list(model.state_names), list(model.input_names)
    return PlanRecord(
        name=name,
        verdict=verdict,
        sentence=sentence,
        model=model_input(model),
        embodiment=embodiment_of(model.contract),
        provenance=provenance_of(),
        wall_clock=WallClock(written_utc=written_now()),
        robustness=RobustnessSection(state_names=states, input_names=inputs, **trials),
    )


def _place(cell: Cell) -> str:
    return f"{WORST}/{cell.perturbation}_{cell.level:g}"


def _cell(c: Cell) -> CellEvidence:
    return CellEvidence(
        level=c.level,
        successes=c.rate.successes,
        trials=c.rate.trials,
        rate=c.rate.value,
        lower_95=c.rate.lower,
        upper_95=c.rate.upper,
        distinct=len({e.last.tobytes() for e in c.endings}),
        labels=dict(c.labels),
        controller_errors=dict(c.controller_errors),
        goal_error_median=finite(c.goal_error),
        goal_error_worst=finite(c.worst_goal_error),
        displacement=c.displacement,
        predicted=c.predicted,
        ratio=c.ratio,
    )


def _loop(task: Task) -> LoopEvidence:
    loop, period = task.loop, task.loop.substeps * task.model.time_step
    sensor, actuator = loop.sensor, loop.actuator
    seen = {n: getattr(sensor, n) for n in ("noise", "bias", "delay", "every", "dropout")}
    done = {n: getattr(actuator, n) for n in ("delay", "every", "lower", "upper", "strength", "lag")}
    return LoopEvidence(
        controller=task.controller_name,
        period_s=period,
        steps=len(task.us),
        judged_by=task.judged_by,
        sensor={key: _numbers(value) for key, value in seen.items()},
        estimator=type(loop.estimator).__name__,
        actuator={key: _numbers(value) for key, value in done.items()},
        fallback=None if loop.fallback is None else loop.fallback.mode,
        latency_budget_s=period if loop.latency_budget is None else loop.latency_budget,
        latency_budget_is="the controller's period" if loop.latency_budget is None else "stated",
    )


def _numbers(value: ArrayLike) -> float | list[float | None] | None:
    """A number or a list of them; null for no limit."""
    if np.ndim(value) == 0:
        return finite(float(np.asarray(value)))
    return [finite(float(v)) for v in np.asarray(value, dtype=float)]


def _times(result: Robustness) -> WallClock:
    runs = [result.task.nominal.run, *(c.worst.outcome.run for c in result.cells)]
    taken = np.concatenate([run.latencies for run in runs])
    if not len(taken):
        return WallClock(written_utc=written_now())
    budget = _loop(result.task).latency_budget_s
    return WallClock(
        written_utc=written_now(),
        latency_median_s=float(np.median(taken)),
        latency_99_percent_s=float(np.quantile(taken, 0.99)),
        latency_largest_s=float(np.max(taken)),
        late=int(np.sum(taken > budget)),
        controller_steps=len(taken),
    )


def _table(result: Robustness) -> str:
    """A row for each trial: all that the rates are made of."""
    text = io.StringIO(newline="")
    rows = csv.writer(text, lineterminator="\n")
    ends = [f"last {name}" for name in result.task.model.state_names]
    rows.writerow(["perturbation", "level", "seed", "success", "label", "reason", "goal_error", *ends])
    for c in result.cells:
        for e in c.endings:
            told = [int(e.label is None), e.label or "", e.reason, e.goal_error]
            rows.writerow([c.perturbation, c.level, e.seed, *told, *map(float, e.last)])
    return text.getvalue()

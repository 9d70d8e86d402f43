"""The trials of a plan as one page that opens from a disk: the verdict, every rate and margin, the worst trials."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.statistics import ENOUGH
from drake_diff.pages.html import Line, Plot, page_data, write_page
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.trials.perturbation import perturbed
from drake_diff.trials.run import Robustness, agrees, sized
from drake_diff.trials.trial import Task, Trial
from drake_diff.trials.trial_files import planned_states

MOST_PLOTS = 12  # of coordinates; those that end furthest from the plan


def write_robustness_page(path: Path, result: Robustness, record: PlanRecord, replay: Path) -> None:
    """Write the page of `result` with its `record` and `replay`, the page of the weakest point's worst trial."""
    trial = result.worst(result.weakest).worst
    ((name, level),) = trial.levels.items()
    told = trial.reason or "it succeeds, and of all trials it ends furthest from the goal"
    write_page(
        path,
        "robustness.html.j2",
        record=record.model_dump(mode="json"),
        data=robustness_data(result),
        view=replay.read_text(encoding="utf-8"),
        model=result.task.model.name,
        caption=f"The worst trial of {name} {sized(name, level)}, with the plan as a ghost: {told}.",
        enough=ENOUGH,
        agrees=agrees,
    )


def robustness_data(result: Robustness) -> dict[str, Any]:
    """What the page draws; see `page_data`."""
    task = result.task
    plots = list(_trial_plots(task, result.worst(result.weakest).worst))
    for name in result.names:
        plots += _level_plots(result, name)
    return page_data(task.model.time_step * len(task.us), plots)


def _trial_plots(task: Task, trial: Trial) -> Iterator[Plot]:
    """Of one trial: each coordinate as it was, seen, estimated and planned; the inputs; the controller's status."""
    run, model, problem = trial.outcome.run, task.model, task.plan.problem
    setup = perturbed(task.setup, trial.levels, trial.seed)
    planned = planned_states(task, setup)
    count = len(planned)
    times = setup.model.time_step * np.arange(count)

    def held(rows: Array) -> Array:
        """Rows of the controller's steps as rows of the plant's."""
        return _padded(np.repeat(rows, setup.loop.substeps, axis=0), count)

    true, seen, taken = _padded(run.motion.xs, count), held(run.observations), held(run.estimates)
    apart = np.nanmax(np.abs(true - planned), axis=0) / task.plan.scale
    units = [c.unit for c in (*model.contract.positions, *model.contract.velocities)]
    for i in sorted(np.argsort(-apart, kind="stable")[:MOST_PLOTS]):
        lines = [
            Line("true", true[:, i]),
            Line("observed", seen[:, i], held=True),
            Line("estimated", taken[:, i], held=True),
            Line("plan", planned[:, i], dashed=True),
        ]
        limits = (problem.bounds.x_lower[i], problem.bounds.x_upper[i])
        yield Plot(model.state_names[i], units[i], times, lines, limits=limits, group="States")
    planned_us = _padded(np.repeat(task.us, (count - 1) // len(task.us), axis=0), count)
    commands, applied = held(run.commands), held(run.applied)
    for i, c in enumerate(model.contract.inputs):
        lines = [
            Line("command", commands[:, i], held=True),
            Line("applied", applied[:, i], held=True),
            Line("plan", planned_us[:, i], dashed=True, held=True),
        ]
        limits = (problem.bounds.u_lower[i], problem.bounds.u_upper[i])
        yield Plot(f"input {c.name}", c.unit, times, lines, limits=limits, percent=True, group="Inputs")
    others = list(dict.fromkeys(status for status in run.controller_status if status != "ok"))
    events = [f"{e.t:.4g} s: {e.message}" for e in run.events]
    note = "; ".join([*others[:3], *events[:6]]) or "nothing happened"
    ok = held(np.array([[float(status == "ok")] for status in run.controller_status]).reshape(-1, 1))
    status = [Line("status", ok[:, 0], held=True)]
    yield Plot("controller status", "1: ok", times, status, range=[-0.1, 1.1], note=note, group="Inputs")


def _padded(rows: Array, count: int) -> Array:
    """`rows` (n, m) as (count, m): NaN below, but a held row lasts to the end where only one is missing."""
    rows = np.vstack([rows, rows[-1:]]) if len(rows) == count - 1 else rows[:count]
    return np.vstack([rows, np.full((count - len(rows), rows.shape[1]), np.nan)])


def _level_plots(result: Robustness, name: str) -> Iterator[Plot]:
    """Of one perturbation, over its levels: success, displacement, and where every trial ends."""
    task, cells = result.task, result.of(name)
    levels = [c.level for c in cells]
    place: dict[str, Any] = {"axis": "level", "levels": True, "marks": "both", "place": name}
    rates = [
        Line("rate", [c.rate.value for c in cells]),
        Line("95 %, lower", [c.rate.lower for c in cells], dashed=True),
        Line("upper", [c.rate.upper for c in cells], dashed=True),
    ]
    yield Plot("success", "1", levels, rates, band=True, range=[-0.03, 1.03], **place)
    moved = [Line("measured", [c.displacement for c in cells])]
    known = any(c.predicted is not None for c in cells)
    moved += [Line("predicted", [c.predicted for c in cells], dashed=True)] if known else []
    note = "" if known else "no gradient predicts it"
    yield Plot("displacement of the last state", "q, v", levels, moved, log=True, note=note, **place)
    # Last states in the two coordinates that spread most for what is tolerated, a colour for each level and the plan.
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

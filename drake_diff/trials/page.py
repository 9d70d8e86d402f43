"""The trials of a plan as one page that opens from a disk: the verdict, every rate and margin, the worst trials."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.statistics import ENOUGH
from drake_diff.pages.html import write_page
from drake_diff.pages.plots import Line, Plot, page_data
from drake_diff.record.robustness import RobustnessRecord
from drake_diff.trials.perturbation import perturbed
from drake_diff.trials.run import Robustness, agrees, sized
from drake_diff.trials.trial import Task, Trial
from drake_diff.trials.trial_files import planned_states

MOST_PLOTS = 12  # of coordinates; those that end furthest from the plan


def write_robustness_page(path: Path, result: Robustness, record: RobustnessRecord, replay: Path) -> None:
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
    trial, task = result.worst(result.weakest).worst, result.task
    found = [*_states(task, trial), *_inputs(task, trial), _status(task, trial)]
    for name in result.names:
        found += _levels(result, name)
    return page_data(task.model.time_step * len(task.us), found)


def _levels(result: Robustness, name: str) -> Iterable[Plot]:
    cells = result.of(name)
    levels = [c.level for c in cells]
    place: dict[str, Any] = {"axis": "level", "levels": True, "marks": "both", "place": name}
    rates = [
        Line("rate", [c.rate.value for c in cells]),
        Line("95 %, lower", [c.rate.lower for c in cells], dashed=True),
        Line("upper", [c.rate.upper for c in cells], dashed=True),
    ]
    yield Plot("success", "1", levels, rates, band=True, range=[-0.03, 1.03], **place)
    moved = [Line("measured", [_number(c.displacement) for c in cells])]
    known = any(c.predicted is not None for c in cells)
    moved += [Line("predicted", [_number(c.predicted) for c in cells], dashed=True)] if known else []
    note = "" if known else "no gradient tells of it"
    yield Plot("displacement of the last state", "q, v", levels, moved, log=True, note=note, **place)
    yield _last_states(result, name)


def _last_states(result: Robustness, name: str) -> Plot:
    """Every trial's last state in the two coordinates that spread most for what is tolerated, each level and the plan's
    own end in a colour.
    """
    task, cells = result.task, result.of(name)
    ends = [*(np.array([e.last for e in c.endings]) for c in cells), task.xs[-1:]]
    spread = np.ptp(np.vstack(ends), axis=0) / task.plan.scale
    i, j = sorted(np.argsort(-spread, kind="stable")[:2])
    across = np.concatenate([end[:, i] for end in ends])
    order = np.argsort(across, kind="stable")
    level = np.repeat(np.arange(len(ends)), [len(end) for end in ends])[order]
    up = np.concatenate([end[:, j] for end in ends])[order]
    labels = [*(f"{c.level:g}" for c in cells), "the plan's"]
    series = [Line(label, np.where(level == k, up, np.nan)) for k, label in enumerate(labels)]
    names = task.model.state_names
    place = {"axis": names[i], "marks": "points", "place": name}
    return Plot(f"last {names[j]} over {names[i]}", "by level", across[order], series, **place)


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _times(task: Task, trial: Trial) -> tuple[Array, int, Array]:
    """Those of every step of the trial's plant, the steps in one of the controller's, and the plan at them."""
    setup = perturbed(task.setup, trial.levels, trial.seed)
    planned = planned_states(task, setup)
    times = np.asarray(setup.model.time_step * np.arange(len(planned)), dtype=float)
    return times, setup.loop.substeps, planned


def _states(task: Task, trial: Trial) -> Iterable[Plot]:
    """Truth, observation, estimate and plan of each coordinate."""
    run, model = trial.outcome.run, task.model
    times, every, planned = _times(task, trial)
    true = _padded(run.motion.xs, len(times))
    seen, taken = (_padded(np.repeat(rows, every, axis=0), len(times)) for rows in (run.observations, run.estimates))
    apart = np.nanmax(np.abs(true - planned), axis=0) / task.plan.scale
    units = [c.unit for c in (*model.contract.positions, *model.contract.velocities)]
    for i in sorted(np.argsort(-apart, kind="stable")[:MOST_PLOTS]):
        lines = [
            Line("true", true[:, i]),
            Line("observed", seen[:, i], held=True),
            Line("estimated", taken[:, i], held=True),
            Line("plan", planned[:, i], dashed=True),
        ]
        bounds = (task.plan.problem.bounds.x_lower[i], task.plan.problem.bounds.x_upper[i])
        yield Plot(model.state_names[i], units[i], times, lines, limits=bounds)


def _inputs(task: Task, trial: Trial) -> Iterable[Plot]:
    run, bounds = trial.outcome.run, task.plan.problem.bounds
    times, every, _ = _times(task, trial)
    rows = [_padded(np.repeat(u, every, axis=0), len(times)) for u in (run.commands, run.applied)]
    planned = _padded(np.repeat(task.us, (len(times) - 1) // len(task.us), axis=0), len(times))
    for i, c in enumerate(task.model.contract.inputs):
        lines = [Line(name, u[:, i], held=True) for name, u in zip(("command", "applied"), rows, strict=True)]
        limits = (bounds.u_lower[i], bounds.u_upper[i])
        yield Plot(
            f"input {c.name}",
            c.unit,
            times,
            [*lines, Line("plan", planned[:, i], dashed=True, held=True)],
            limits=limits,
        )


def _status(task: Task, trial: Trial) -> Plot:
    run = trial.outcome.run
    times, every, _ = _times(task, trial)
    ok = np.array([[float(status == "ok")] for status in run.controller_status]).reshape(-1, 1)
    others = list(dict.fromkeys(s for s in run.controller_status if s != "ok"))
    events = [f"{e.t:.4g} s: {e.message}" for e in run.events]
    note = "; ".join([*others[:3], *events[:6]]) or "nothing happened"
    values = _padded(np.repeat(ok, every, axis=0), len(times))[:, 0]
    return Plot("controller status", "1: ok", times, [Line("status", values, held=True)], range=[-0.1, 1.1], note=note)


def _padded(rows: Array, count: int) -> Array:
    """`rows` (n, m) as (count, m), NaN below; a held row that is one short lasts to the end."""
    rows = np.vstack([rows, rows[-1:]]) if len(rows) == count - 1 else rows[:count]
    return np.vstack([rows, np.full((count - len(rows), rows.shape[1]), np.nan)])

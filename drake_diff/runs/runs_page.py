"""Two runs on one page: both plans in one replay and in the same plots, and a table of what differs between them."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydrake.geometry import Rgba

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ArtifactError
from drake_diff.pages.html import Line, Plot, page_data, write_page
from drake_diff.pages.meshcat import write_replay
from drake_diff.pages.scene import Poses, Scene, longest_path
from drake_diff.runs.listing import compare_runs
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.read import load_plan_record
from drake_diff.runs.rerun import TRACE
from drake_diff.runs.trace import read_trace
from drake_diff.runs.view import PLAN, scene_of_run

SECOND = Rgba(0.85, 0.4, 0.05, 0.45)  # near the colour of its lines


@dataclass(frozen=True, eq=False)
class _Curve:
    """A column of a plan: its unit, values at `times`, and limits."""

    unit: str
    times: Array
    values: Array
    limits: tuple[float | None, float | None]


def write_runs_page(path: Path, a: str | Path, b: str | Path, *, models: str | Path | None = None) -> None:
    """Write the page that compares the plans of the runs in the directories `a` and `b`; `models` as in `verify`.

    Raises:
        ArtifactError: One of them has no record or no trace that can be read.
    """
    found, folders = compare_runs(a, b), (Path(a), Path(b))
    records = [load_plan_record(folder) for folder in folders]
    names = [record.name for record in records]
    if names[0] == names[1]:
        names = [str(folder) for folder in folders]
    states, inputs = zip(*(_curves(r, folder) for r, folder in zip(records, folders, strict=True)), strict=True)
    plots = [*_plots("Positions and velocities", names, states), *_plots("Inputs", names, inputs, held=True)]
    ends = [float(max(c.times[-1] for c in one.values())) for one in states]
    view, caption = _replay(folders, names, models)
    runs = [
        {"name": n, "verdict": r.verdict, "sentence": r.sentence, "duration_s": end}
        for n, r, end in zip(names, records, ends, strict=True)
    ]
    record = {"runs": runs, **asdict(found), "sentence": _sentence(names, states)}
    data = page_data(max(ends), plots)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_page(path, "compare_runs.html.j2", record=record, data=data, view=view, caption=caption)


def _curves(record: PlanRecord, folder: Path) -> tuple[dict[str, _Curve], dict[str, _Curve]]:
    """The states and the inputs of a run's plan, by name."""
    trace = read_trace(folder / TRACE)
    problem: dict[str, Any] = dict(record.problem)
    if not len(trace.times):
        raise ArtifactError(f"{folder / TRACE} has no plan")
    states = {
        v.name: _Curve(v.unit, trace.times, trace.planned_xs[:, i], (problem["x_lower"][i], problem["x_upper"][i]))
        for i, v in enumerate(record.observation.variables)
    }
    times = trace.times[: len(trace.planned_us)]
    inputs = {
        c.name: _Curve(c.unit, times, trace.planned_us[:, i], (c.lower, c.upper))
        for i, c in enumerate(record.action.commands)
    }
    return states, inputs


def _plots(group: str, names: Sequence[str], both: Sequence[dict[str, _Curve]], held: bool = False) -> Iterator[Plot]:
    """A plot for each column of either run; their limits where they are the same."""
    for title in dict.fromkeys([*both[0], *both[1]]):
        curves = [one.get(title) for one in both]
        known = [c for c in curves if c is not None]
        times = np.unique(np.concatenate([c.times for c in known]))
        lines = [
            Line(name, np.full(len(times), np.nan) if c is None else _at(times, c, held), held=held)
            for name, c in zip(names, curves, strict=True)
        ]
        limits = known[0].limits if all(c.limits == known[0].limits for c in known) else (None, None)
        odd = len({c.unit for c in known}) > 1
        unit = " and ".join(dict.fromkeys(c.unit for c in known))
        heading = f"input {title}" if held else title
        yield Plot(heading, unit, times, lines, limits=limits, percent=held and not odd, group=group)


def _at(times: Array, curve: _Curve, held: bool) -> Array:
    """A curve at other times: along straight lines between its knots, or held from each; NaN after its end."""
    if held:
        found = curve.values[np.searchsorted(curve.times, times, side="right") - 1]
    else:
        found = np.interp(times, curve.times, curve.values)
    return np.where(times > curve.times[-1], np.nan, found)


def _sentence(names: Sequence[str], states: Sequence[dict[str, _Curve]]) -> str:
    """Where the plans are furthest apart, of the states that both have and as a part of what the first one moves."""
    shared = [name for name in states[0] if name in states[1]]
    worst, told = -1.0, "the two plans have no state in common"
    for name in shared:
        one, other = states[0][name], states[1][name]
        times = np.unique(np.concatenate([one.times, other.times]))
        gap = np.abs(_at(times, one, False) - _at(times, other, False))
        if not np.any(np.isfinite(gap)):
            continue
        k = int(np.nanargmax(gap))
        part = float(gap[k] / max(float(np.nanmax(np.abs(np.append(one.values, other.values)))), 1e-12))
        if part > worst:
            worst = part
            told = f"the plans are furthest apart in {name}: by {gap[k]:.4g} {one.unit} at {times[k]:.4g} s"
    return f"{names[0]} and {names[1]}: {told}" if worst else f"{names[0]} and {names[1]} have the same plan"


def _replay(folders: Sequence[Path], names: Sequence[str], models: str | Path | None) -> tuple[str, str]:
    """The page with both plans, and what is seen in it; "" and why where one has none."""
    try:
        scenes = [scene_of_run(folder, models=models) for folder in folders]
    except ArtifactError as error:
        return "", str(error)
    with TemporaryDirectory() as folder:
        page = Path(folder) / "replay.html"
        write_replay(page, _together(*scenes), title=f"{names[0]} and {names[1]}")
        view = page.read_text(encoding="utf-8")
    first, second = names
    seen = f"The plans of both runs, {first} in its own colours and {second} in orange. The one that ends first waits"
    return view, seen


def _together(first: Scene, second: Scene) -> Scene:
    """Both plans at the same times; the one that ends first waits. No contact forces: those are of the motions."""
    end = max(float(first.times[-1]), float(second.times[-1]))
    step = min(float(np.min(np.diff(scene.times))) for scene in (first, second))
    times = np.linspace(0.0, end, max(2, round(end / step) + 1))
    poses = dict(_resampled(first, times))
    poses |= {f"second.{path}": found for path, found in _resampled(second, times).items()}
    others = tuple(replace(d, body=f"second.{d.body}", colour=SECOND) for d in second.shapes if d.body)
    trail = longest_path(_resampled(first, times))
    marks = tuple(mark for mark in (*first.marks, *second.marks) if not mark.body)
    shapes = (*first.shapes, *others)
    return Scene(shapes=shapes, times=times, poses=poses, ghosts=(), contacts=(), trail=trail, marks=marks)


def _resampled(scene: Scene, times: Array) -> Poses:
    """The poses of a run's plan, which is a ghost where the motion is another, at the nearest of its times."""
    poses = next((ghost.poses for ghost in scene.ghosts if ghost.name == PLAN), scene.poses)
    middles = (scene.times[:-1] + scene.times[1:]) / 2
    nearest = np.searchsorted(middles, times)
    return {path: [found[k] for k in nearest] for path, found in poses.items()}

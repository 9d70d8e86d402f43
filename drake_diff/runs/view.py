"""List runs, serve a run in Meshcat, compare two runs, and write a page with both plans."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams, Rgba

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ArtifactError, ModelError
from drake_diff.logs.mcap_file import read_mcap
from drake_diff.model.parameters import applied
from drake_diff.optimize.live import scene_of_plan
from drake_diff.pages.html import Line, Plot, page_data, write_page
from drake_diff.pages.meshcat import draw, write_replay
from drake_diff.pages.scene import Poses, Scene, longest_path
from drake_diff.runs.differences import READ, differences, is_near, is_number
from drake_diff.runs.directory import is_partial, load_plan_record, load_record, record_path
from drake_diff.runs.other_records import TRIALS, ComparisonRecord, is_trial_file
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.rebuild import TRACE
from drake_diff.runs.save import REPLAY
from drake_diff.runs.trace import read_trace
from drake_diff.runs.verify import recalled

PLAN, WITHOUT = "plan", "without_feedback"  # names of ghosts
OPEN_LOOP = "open loop"
LOOPBACK = "127.0.0.1"
UNDER_FEEDBACK = "the moving robot shows the plan, which it follows under feedback; blue: the robot without feedback"
CONFIGURATION = ("problem", "contract", "model", "inputs", "solver")
# Entries of the configuration that are results of the solve.
RESULTS = ("status", "message", "solver_message", "notes", "plant", "feedback", "iterations")
NO_CHOICE = tuple(f"solver.{name}" for name in RESULTS)


@dataclass(frozen=True)
class RunLine:
    """One directory according to its unverified record; `verdict` is "unreadable" if the record cannot be read.

    `verdict` is "incomplete" for a run that was not moved to its place. `kind` is the subject of the record, such as
    "plan", "comparison" or "trial". Only a solve has a status, and only a solve and a trial of a panel have a cost. The
    name of a trial is that of its cell.

    Example:
        >>> from drake_diff.runs import list_runs
        >>> line = next(line for line in list_runs("artifacts") if line.name == "pendulum_swing_up")
        >>> line.kind, line.status, line.model
        ('plan', 'converged', 'pendulum')
    """

    directory: Path
    name: str
    kind: str
    verdict: str
    status: str
    cost: float | None
    model: str
    written_utc: str


@dataclass(frozen=True)
class ChangedEntry:
    """One entry that differs between two records; None stands for a missing entry."""

    key: str
    a: Any
    b: Any


@dataclass(frozen=True)
class RunComparison:
    """The differences between two solves.

    Attributes:
        configuration: Differing entries of the configuration.
        versions: Differing packages and commits.
        metrics: Metrics and invariants with a different value or verdict.
        refused: Metrics that cannot be compared because their definitions, units or directions differ.

    Example:
        >>> from drake_diff.runs import compare_runs
        >>> run = "artifacts/pendulum_swing_up"
        >>> compare_runs(run, run).comparable
        True
    """

    configuration: tuple[ChangedEntry, ...]
    versions: tuple[ChangedEntry, ...]
    metrics: tuple[ChangedEntry, ...]
    refused: tuple[str, ...]

    @property
    def comparable(self) -> bool:
        """Whether every metric could be compared."""
        return not self.refused

    def __str__(self) -> str:
        counts = f"versions: {len(self.versions)}, metrics: {len(self.metrics)}, not compared: {len(self.refused)}"
        return f"configuration: {len(self.configuration)} entries differ; {counts}"


def list_runs(directory: str | Path) -> list[RunLine]:
    """List the directories in `directory` that have a record, sorted by name, without verifying them.

    Args:
        directory: The parent directory of the runs. For the directory of a panel, its trials are listed.

    Returns:
        A `RunLine` for each directory or trial.

    Raises:
        ArtifactError: There is no such directory.

    Example:
        >>> from drake_diff.runs import list_runs
        >>> {line.name: line.verdict for line in list_runs("artifacts")}["pendulum_swing_up"]
        'pass'
    """
    folder = Path(directory)
    if not folder.is_dir():
        raise ArtifactError(f"{folder}: expected a directory of runs, got no directory")
    trials = folder / TRIALS
    files = trials.iterdir() if trials.is_dir() else folder.iterdir() if folder.name == TRIALS else ()
    paths = [*(path for path in folder.iterdir() if path.is_dir()), *(path for path in files if is_trial_file(path))]
    return [_line(path) for path in sorted(paths) if record_path(path) or is_partial(path)]


def _line(path: Path) -> RunLine:
    if record_path(path) is None:
        return RunLine(path, path.name, "", "incomplete", "", None, "", "")
    try:
        record = load_record(path)
    except ArtifactError:
        return RunLine(path, path.name, "", "unreadable", "", None, "", "")
    cost, status, model = None, "-", record.model.file.path if record.model.file else ""
    if isinstance(record, PlanRecord) and record.subject in ("plan", "phases", "closed_loop"):
        cost = next((m.value for m in record.metrics if m.name == "cost"), None)
        status = record.solver.status if record.solver else "-"
        model = str(record.contract.get("name", ""))
    verdict, name = "incomplete" if is_partial(path) else record.verdict, path.name
    if isinstance(record, ComparisonRecord) and record.trial is not None:
        name, given = record.name, record.trial.result.get("cost")
        cost = float(given) if isinstance(given, (int, float)) else None
    return RunLine(path, name, record.subject, verdict, status, cost, model, record.wall_clock.written_utc)


def compare_runs(a: str | Path, b: str | Path) -> RunComparison:
    """Compare the records of two solves: configuration, versions, metrics.

    Args:
        a: The directory of the first run.
        b: The directory of the second one.

    Returns:
        A `RunComparison`.

    Raises:
        ArtifactError: One of them has no readable record.

    Example:
        >>> from drake_diff.runs import compare_runs
        >>> run = "artifacts/pendulum_swing_up"
        >>> print(compare_runs(run, run))
        configuration: 0 entries differ; versions: 0, metrics: 0, not compared: 0
    """
    first, second = load_plan_record(a), load_plan_record(b)
    ours = {m.name: m for m in (*first.metrics, *first.invariants)}
    theirs = {m.name: m for m in (*second.metrics, *second.invariants)}
    result, refused = [], []
    for name in dict.fromkeys([*ours, *theirs]):
        if name not in ours or name not in theirs:
            refused.append(f"{name}: only {'the first' if name in ours else 'the second'} run has it")
            continue
        item, other = ours[name], theirs[name]
        keys = ("definition", "unit", "direction")
        odd = next((key for key in keys if getattr(item, key) != getattr(other, key)), None)
        if odd is not None:
            refused.append(f"{name}: its {odd} differs: {getattr(item, odd)!r} and {getattr(other, odd)!r}")
            continue
        if (item.value, item.verdict) != (other.value, other.verdict):
            result.append(ChangedEntry(f"{name} [{item.unit}]", item.value, other.value))
        if item.tolerance != other.tolerance:  # some tolerances depend on the motion
            result.append(ChangedEntry(f"tolerance of {name} [{item.unit}]", item.tolerance, other.tolerance))
    return RunComparison(
        configuration=_differences(first, second, CONFIGURATION, NO_CHOICE),
        versions=_differences(first, second, ("schema_version", "provenance"), ("provenance.command",)),
        metrics=tuple(result),
        refused=tuple(refused),
    )


def _differences(
    first: PlanRecord, second: PlanRecord, sections: tuple[str, ...], apart: tuple[str, ...]
) -> tuple[ChangedEntry, ...]:
    item, other = first.model_dump(mode="json"), second.model_dump(mode="json")
    result = differences({s: item[s] for s in sections}, {s: other[s] for s in sections})
    return tuple(
        ChangedEntry(key, was, now)
        for key, was, now in result
        if not (key.startswith(apart) or (is_number(was) and is_number(now) and is_near(was, now, *READ)))
    )


def serve(directory: str | Path, *, models: str | Path | None = None) -> tuple[Meshcat, tuple[str, ...]]:
    """Show a run in a Meshcat server for browsers on this machine; return the server, which must be kept, and remarks.

    Raises ArtifactError if the run is damaged, has no motion, or its model cannot be rebuilt. `models`: see `verify`.
    """
    scene = scene_of_run(directory, models=models)
    meshcat = Meshcat(MeshcatParams(host=LOOPBACK, show_stats_plot=False))
    draw(meshcat, scene)
    return meshcat, (UNDER_FEEDBACK,) if any(ghost.name == WITHOUT for ghost in scene.ghosts) else ()


def scene_of_run(directory: str | Path, *, models: str | Path | None = None) -> Scene:
    """Return the scene of a run directory; the model's source file is only needed if it names other files.

    A child process reads the run first. Raises ArtifactError if that process fails.
    """
    folder = Path(directory)
    if not load_plan_record(folder).contract:
        raise ArtifactError(f"{folder} is a run of plain dynamics: there is no body to draw")
    try:
        with recalled(folder, models=models) as solution, applied(solution.vector):
            scene = scene_of_plan(solution, solution.replay)
            rests_on = read_trace(folder / TRACE).metadata.get("verdict_rests_on", OPEN_LOOP)
            if rests_on.startswith(OPEN_LOOP) or not scene.ghosts:
                return scene
            (plan,), trail = scene.ghosts, scene_of_plan(solution, None).trail
            without = replace(plan, name=WITHOUT, poses=scene.poses, framed=False)
            return replace(scene, poses=plan.poses, ghosts=(without,), trail=trail, contacts=(), thrusts=())
    except ModelError as error:
        raise ArtifactError(f"{folder}: {error}. {REPLAY} in it shows the motion without the model") from error


SECOND = Rgba(0.85, 0.4, 0.05, 0.45)  # similar to the colour of its lines


@dataclass(frozen=True, eq=False)
class _Curve:
    """A column of a plan: its unit, values at `times`, and limits; `held` is true for an input."""

    unit: str
    times: Array
    values: Array
    limits: tuple[float | None, float | None]
    held: bool

    def sample(self, times: Array) -> Array:
        """Interpolate the values at other times, linearly or as a step function; NaN after the end."""
        if self.held:
            result = self.values[np.searchsorted(self.times, times, side="right") - 1]
        else:
            result = np.interp(times, self.times, self.values)
        return np.where(times > self.times[-1], np.nan, result)


def write_runs_page(path: Path, a: str | Path, b: str | Path, *, models: str | Path | None = None) -> None:
    """Write a page that compares the plans of the runs in the directories `a` and `b`; for `models` see `verify`.

    Raises:
        ArtifactError: One of them has no readable record or trace.
    """
    result, folders = compare_runs(a, b), (Path(a), Path(b))
    records = [load_plan_record(folder) for folder in folders]
    names = [record.name for record in records]
    if names[0] == names[1]:
        names = [str(folder) for folder in folders]
    curves = [_curves(record, folder) for record, folder in zip(records, folders, strict=True)]
    ends = [float(max(c.times[-1] for c in by_name.values())) for by_name in curves]
    view, caption = _replay(folders, names, models)
    runs = [
        {"name": n, "verdict": r.verdict, "sentence": r.sentence, "duration_s": end}
        for n, r, end in zip(names, records, ends, strict=True)
    ]
    record = {"runs": runs, **asdict(result), "sentence": _sentence(names, curves)}
    data = page_data(max(ends), [*_plots(names, curves)])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_page(path, "compare_runs.html.j2", record=record, data=data, view=view, caption=caption)


def _curves(record: PlanRecord, folder: Path) -> dict[str, _Curve]:
    """Return the states and the inputs of a run's plan, by name."""
    log, p, curves = read_mcap(folder / TRACE, links=False), dict[str, Any](record.problem), dict[str, _Curve]()
    if not log.messages.get("/planned/state"):
        raise ArtifactError(f"{folder / TRACE} has no plan")
    for topic, symbols, kind in (("/planned/state", "qv", "x"), ("/planned/input", "u", "u")):
        columns, metadata = log.arrays(topic), log.channel_metadata[topic]
        values = np.hstack([columns[symbol] for symbol in symbols])
        pairs = [(name, metadata["units"][symbol][name]) for symbol in symbols for name in metadata["names"][symbol]]
        limits = list(zip(p[f"{kind}_lower"], p[f"{kind}_upper"], strict=True))
        for i, (name, unit) in enumerate(pairs):
            title = f"input {name}" if kind == "u" else name
            curves[title] = _Curve(unit, columns["time"], values[:, i], limits[i], kind == "u")
    return curves


def _plots(names: Sequence[str], both: Sequence[dict[str, _Curve]]) -> Iterator[Plot]:
    """Yield a plot for each column of either run, first the states, with limits if they agree."""
    for title in sorted(both[0] | both[1], key=lambda title: (both[0] | both[1])[title].held):
        known = [by_name[title] for by_name in both if title in by_name]
        held, times = known[0].held, np.unique(np.concatenate([c.times for c in known]))
        lines = []
        for name, by_name in zip(names, both, strict=True):
            values = by_name[title].sample(times) if title in by_name else np.full(len(times), np.nan)
            lines.append(Line(name, values, held=held))
        limits = known[0].limits if all(c.limits == known[0].limits for c in known) else (None, None)
        odd = len({c.unit for c in known}) > 1
        unit = " and ".join(dict.fromkeys(c.unit for c in known))
        group = "Inputs" if held else "Positions and velocities"
        yield Plot(title, unit, times, lines, limits=limits, percent=held and not odd, group=group)


def _sentence(names: Sequence[str], both: Sequence[dict[str, _Curve]]) -> str:
    """State where the plans are furthest apart, in their common states and relative to the states' largest value."""
    worst, sentence = -1.0, "the two plans have no state in common"
    for name in (name for name, c in both[0].items() if name in both[1] and not c.held):
        item, other = both[0][name], both[1][name]
        times = np.unique(np.concatenate([item.times, other.times]))
        gap = np.abs(item.sample(times) - other.sample(times))
        if not np.any(np.isfinite(gap)):
            continue
        k = int(np.nanargmax(gap))
        fraction = float(gap[k] / max(float(np.nanmax(np.abs(np.append(item.values, other.values)))), 1e-12))
        if fraction > worst:
            worst = fraction
            sentence = f"the plans are furthest apart in {name}: by {gap[k]:.4g} {item.unit} at {times[k]:.4g} s"
    return f"{names[0]} and {names[1]}: {sentence}" if worst else f"{names[0]} and {names[1]} have the same plan"


def _replay(folders: Sequence[Path], names: Sequence[str], models: str | Path | None) -> tuple[str, str]:
    """Return the page with both plans and its caption, or "" and the reason if one plan cannot be drawn."""
    try:
        scenes = [scene_of_run(folder, models=models) for folder in folders]
    except ArtifactError as error:
        return "", str(error)
    with TemporaryDirectory() as folder:
        page = Path(folder) / "replay.html"
        write_replay(page, _together(*scenes), title=f"{names[0]} and {names[1]}")
        view = page.read_text(encoding="utf-8")
    first, second = names
    seen = (
        f"The plans of both runs, {first} in its own colours and {second} in orange; the shorter plan stays at its end"
    )
    return view, seen


def _together(first: Scene, second: Scene) -> Scene:
    """Merge both plans on common times; the shorter one stays at its end. Contact forces are of motions, so omitted."""
    end = max(float(first.times[-1]), float(second.times[-1]))
    step = min(float(np.min(np.diff(scene.times))) for scene in (first, second))
    times = np.linspace(0.0, end, max(2, round(end / step) + 1))
    poses = dict(_resampled(first, times))
    poses |= {f"second.{path}": result for path, result in _resampled(second, times).items()}
    others = tuple(replace(d, body=f"second.{d.body}", colour=SECOND) for d in second.shapes if d.body)
    trail = longest_path(_resampled(first, times))
    marks = tuple(mark for mark in (*first.marks, *second.marks) if not mark.body)
    shapes = (*first.shapes, *others)
    return Scene(shapes=shapes, times=times, poses=poses, ghosts=(), contacts=(), trail=trail, marks=marks)


def _resampled(scene: Scene, times: Array) -> Poses:
    """Return the poses of a run's plan at the nearest of its times; the plan is a ghost if the motion differs."""
    poses = next((ghost.poses for ghost in scene.ghosts if ghost.name == PLAN), scene.poses)
    middles = (scene.times[:-1] + scene.times[1:]) / 2
    nearest = np.searchsorted(middles, times)
    return {path: [result[k] for k in nearest] for path, result in poses.items()}

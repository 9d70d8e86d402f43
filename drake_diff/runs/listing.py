"""Directories side by side: a line for each of them, and what differs between two solves."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drake_diff.exceptions import ArtifactError
from drake_diff.runs.differences import READ, differences, is_near, is_number
from drake_diff.runs.directory import is_partial
from drake_diff.runs.other_records import TRIALS, ComparisonRecord, is_trial_file
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.read import load_plan_record, load_record, record_path

CONFIGURATION = ("problem", "contract", "model", "inputs", "solver", "action", "observation")
# What nobody chose, of the configuration: where a file was, what the solver said.
NO_CHOICE = ("contract.source", "solver.status", "solver.message", "solver.solver_message", "solver.iterations")


@dataclass(frozen=True)
class RunLine:
    """One directory: what its record says, unverified; `verdict` is "unreadable" where it says nothing.

    It is "incomplete" of what was not moved to its place, whatever it says. `kind` is what the record is of, as "plan",
    "comparison" or "trial"; only a solve has a status, and only a solve and a trial of a panel a cost. A trial is
    called by its cell.

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
    """One entry that differs between two records; None stands for an entry that is not there."""

    key: str
    a: Any
    b: Any


@dataclass(frozen=True)
class RunComparison:
    """What differs between two solves.

    Attributes:
        configuration: Entries of what was asked that differ.
        versions: Packages and commits that differ.
        metrics: Metrics and invariants whose value or verdict differs.
        refused: Metrics that cannot be compared, as they are defined in other words, units or tolerances.

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
        counts = f"versions: {len(self.versions)}; metrics: {len(self.metrics)}; not compared: {len(self.refused)}"
        return f"configuration: {len(self.configuration)} entries differ; {counts}"


def list_runs(directory: str | Path) -> list[RunLine]:
    """List the directories in `directory` that have a record, by name, without verifying them.

    Args:
        directory: Where the directories are. Of a panel's own directory its trials are listed.

    Returns:
        A `RunLine` for each.

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
    if isinstance(record, PlanRecord) and record.subject in ("plan", "phases"):
        cost = next((m.value for m in record.metrics if m.name == "cost"), None)
        status = record.solver.status if record.solver else "-"
        model = str(record.contract.get("name", ""))
    verdict, name = "incomplete" if is_partial(path) else record.verdict, path.name
    if isinstance(record, ComparisonRecord) and record.trial is not None:
        name, given = record.name, record.trial.result.get("cost")
        cost = float(given) if isinstance(given, (int, float)) else None
    return RunLine(path, name, record.subject, verdict, status, cost, model, record.wall_clock.written_utc)


def compare_runs(a: str | Path, b: str | Path) -> RunComparison:
    """Compare what the records of two solves say: configuration, versions, metrics.

    Args:
        a: The directory of the first run.
        b: The directory of the second one.

    Returns:
        A `RunComparison`.

    Raises:
        ArtifactError: One of them has no record that can be read.

    Example:
        >>> from drake_diff.runs import compare_runs
        >>> run = "artifacts/pendulum_swing_up"
        >>> print(compare_runs(run, run))
        configuration: 0 entries differ; versions: 0; metrics: 0; not compared: 0
    """
    first, second = load_plan_record(a), load_plan_record(b)
    ours = {m.name: m for m in (*first.metrics, *first.invariants)}
    theirs = {m.name: m for m in (*second.metrics, *second.invariants)}
    found, refused = [], []
    for name in dict.fromkeys([*ours, *theirs]):
        if name not in ours or name not in theirs:
            refused.append(f"{name}: only {'the first' if name in ours else 'the second'} run has it")
            continue
        one, other = ours[name], theirs[name]
        keys = ("definition", "unit", "direction")
        odd = next((key for key in keys if getattr(one, key) != getattr(other, key)), None)
        if odd is not None:
            refused.append(f"{name}: its {odd} differs: {getattr(one, odd)!r} and {getattr(other, odd)!r}")
            continue
        if (one.value, one.verdict) != (other.value, other.verdict):
            found.append(ChangedEntry(f"{name} [{one.unit}]", one.value, other.value))
        if one.tolerance != other.tolerance:  # some follow from the motion
            found.append(ChangedEntry(f"tolerance of {name} [{one.unit}]", one.tolerance, other.tolerance))
    return RunComparison(
        configuration=_differences(first, second, CONFIGURATION, NO_CHOICE),
        versions=_differences(first, second, ("schema_version", "provenance"), ("provenance.command",)),
        metrics=tuple(found),
        refused=tuple(refused),
    )


def _differences(
    first: PlanRecord, second: PlanRecord, sections: tuple[str, ...], apart: tuple[str, ...]
) -> tuple[ChangedEntry, ...]:
    one, other = first.model_dump(mode="json"), second.model_dump(mode="json")
    found = differences({s: one[s] for s in sections}, {s: other[s] for s in sections})
    return tuple(
        ChangedEntry(key, was, now)
        for key, was, now in found
        if not (key.startswith(apart) or (is_number(was) and is_number(now) and is_near(was, now, *READ)))
    )

"""Run directories side by side: a line for each, and what differs between two."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drake_diff.artifact.verify import differences
from drake_diff.exceptions import ArtifactError
from drake_diff.record.read import kind_of
from drake_diff.record.sealed import SealedRecord
from drake_diff.record.solve import EvidenceRecord

CONFIGURATION = ("problem", "contract", "model", "inputs", "solver", "action", "observation")
# Of the configuration, what is no choice: where a file was, what the solver said.
NO_CHOICE = ("contract.source", "solver.status", "solver.message", "solver.solver_message", "solver.iterations")


@dataclass(frozen=True)
class RunLine:
    """One directory: what its record says, unverified; `verdict` is "unreadable" where it says nothing.

    `kind` is "solve", "comparison", "robustness" or "certification"; only a solve has a status and a cost.
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
class Difference:
    """One entry of the records that differs; None is an entry that is not there."""

    key: str
    a: Any
    b: Any


@dataclass(frozen=True)
class RunComparison:
    """What differs between two runs; metrics whose definitions differ are not compared, `refused` says which."""

    configuration: tuple[Difference, ...]
    versions: tuple[Difference, ...]
    metrics: tuple[Difference, ...]
    refused: tuple[str, ...]

    @property
    def comparable(self) -> bool:
        return not self.refused


def list_runs(directory: str | Path) -> list[RunLine]:
    """A line for each directory in `directory` that has a record, by name. ArtifactError where there is no such one."""
    folder = Path(directory)
    if not folder.is_dir():
        raise ArtifactError(f"{folder}: expected a directory of runs, got no directory")
    return [_line(path, kind) for path in sorted(folder.iterdir()) if (kind := kind_of(path))]


def _line(path: Path, kind: type[SealedRecord]) -> RunLine:
    try:
        record = kind.read(path)
    except ArtifactError:
        return RunLine(path, path.name, kind.FILE.removesuffix(".json"), "unreadable", "", None, "", "")
    cost, status, model = None, "-", record.model.file.path if record.model.file else ""
    if isinstance(record, EvidenceRecord):
        cost = next((m.value for m in record.metrics if m.name == "cost"), None)
        status = record.solver.status if record.solver else "-"
        model = str(record.contract.get("name", ""))
    return RunLine(path, path.name, record.kind, record.verdict, status, cost, model, record.wall_clock.written_utc)


def compare_runs(a: str | Path, b: str | Path) -> RunComparison:
    """What differs between two run directories. ArtifactError where one has no readable record."""
    first, second = EvidenceRecord.read(a), EvidenceRecord.read(b)
    metrics, refused = _metrics(first, second)
    return RunComparison(
        configuration=_differences(first, second, CONFIGURATION, NO_CHOICE),
        versions=_differences(first, second, ("schema_version", "provenance"), ("provenance.command",)),
        metrics=metrics,
        refused=refused,
    )


def _differences(
    first: EvidenceRecord, second: EvidenceRecord, sections: tuple[str, ...], apart: tuple[str, ...]
) -> tuple[Difference, ...]:
    one, other = first.model_dump(mode="json"), second.model_dump(mode="json")
    found = differences({s: one[s] for s in sections}, {s: other[s] for s in sections})
    return tuple(Difference(*entry) for entry in found if not entry[0].startswith(apart))


def _metrics(first: EvidenceRecord, second: EvidenceRecord) -> tuple[tuple[Difference, ...], tuple[str, ...]]:
    """Every metric of the two; a definition is its words, its unit, its direction and its tolerance."""
    ours = {m.name: m for m in (*first.metrics, *first.invariants)}
    theirs = {m.name: m for m in (*second.metrics, *second.invariants)}
    found, refused = [], []
    for name in dict.fromkeys([*ours, *theirs]):
        a, b = ours.get(name), theirs.get(name)
        if a is None or b is None:
            refused.append(f"{name}: only {'the first' if b is None else 'the second'} run has it")
            continue
        keys = ("definition", "unit", "direction", "tolerance")
        other = [key for key in keys if getattr(a, key) != getattr(b, key)]
        if other:
            was, now = getattr(a, other[0]), getattr(b, other[0])
            refused.append(f"{name}: its {other[0]} differs: {was!r} and {now!r}")
        elif a.value != b.value or a.verdict != b.verdict:
            found.append(Difference(f"{name} [{a.unit}]", a.value, b.value))
    return tuple(found), tuple(refused)

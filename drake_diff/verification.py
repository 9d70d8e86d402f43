"""What `verify` found: which file is damaged, which number no longer holds, and what could not be run again."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from drake_diff.exceptions import ArtifactError
from drake_diff.record import EvidenceRecord, ReplayEvidence
from drake_diff.record_parts import Metric

# How far a number computed again may be from the recorded one, of it or of its tolerance: BLAS and libm round
# differently from machine to machine; and where both are next to nothing.
RELATIVE, ABSOLUTE = 1e-6, 1e-9


@dataclass(frozen=True)
class Comparison:
    """A recorded number and the same computed again; `holds` where they are no further apart than `allowed`."""

    name: str
    recorded: float | None
    again: float | None
    unit: str
    allowed: float
    holds: bool
    file: str = "record.json"

    def __str__(self) -> str:
        words = f"{self.name}: recorded {_shown(self.recorded)} {self.unit}, again {_shown(self.again)}"
        return words if self.holds else f"{words}, allowed {self.allowed:.2g} apart"


@dataclass(frozen=True)
class Verification:
    """The verdict on a run directory: "holds", "broken", or "undecided" where something could not be run again.

    That it holds says that the record is true, not that the run was a success: that is `record.verdict`.
    """

    directory: Path
    record: EvidenceRecord | None
    problems: tuple[str, ...] = ()  # each names the file
    comparisons: tuple[Comparison, ...] = ()
    not_rerun: tuple[str, ...] = ()
    undecided: tuple[str, ...] = ()  # what of `not_rerun` the record's verdict rests on
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> Literal["holds", "broken", "undecided"]:
        if self.problems or not all(c.holds for c in self.comparisons):
            return "broken"
        return "undecided" if self.undecided else "holds"

    @property
    def holds(self) -> bool:
        return self.verdict == "holds"

    @property
    def complaints(self) -> tuple[str, ...]:
        """A sentence for each thing that does not hold."""
        broken = tuple(f"{c.file}: {c}" for c in self.comparisons if not c.holds)
        return self.problems + broken

    def require(self) -> "Verification":
        """This verification where it holds; ArtifactError, with what does not, where it does not."""
        if not self.holds:
            raise ArtifactError(f"{self.directory}: {self}")
        return self

    def __str__(self) -> str:
        if self.verdict == "holds":
            return f"holds: {len(self.comparisons)} numbers are the recorded ones"
        return f"{self.verdict}: " + "; ".join(self.complaints or self.undecided)


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.9g}"


def compare_metrics(recorded: Sequence[Metric], again: Sequence[Metric], skip: Sequence[str]) -> Iterator[Comparison]:
    """Every recorded metric but those in `skip` with the one of its name."""
    found = {metric.name: metric for metric in again}
    for metric in recorded:
        other = found.get(metric.name)
        if metric.name in skip:
            continue
        if other is None or (other.definition, other.unit) != (metric.definition, metric.unit):
            name = f"{metric.name} (defined otherwise in this version)"
            yield Comparison(name, metric.value, None, metric.unit, 0.0, False)
            continue
        compared = compare_numbers(metric.name, metric.value, other.value, metric.unit, metric.tolerance or 0.0)
        if compared.holds and other.tolerance != metric.tolerance:
            name = f"the tolerance of {metric.name}"
            yield Comparison(name, metric.tolerance, other.tolerance, metric.unit, 0.0, False)
        yield compared


def compare_numbers(
    name: str, recorded: float | None, again: float | None, unit: str, scale: float = 0.0
) -> Comparison:
    """Two numbers; none and none are the same. `scale` is that of the differences that do not matter."""
    allowed = RELATIVE * max(abs(recorded or 0.0), scale) + ABSOLUTE
    holds = recorded is None and again is None
    if recorded is not None and again is not None:
        holds = abs(recorded - again) <= allowed
    return Comparison(name, recorded, again, unit, allowed, holds)


def compare_replays(
    recorded: Sequence[ReplayEvidence], again: Sequence[ReplayEvidence], judged: bool
) -> Iterator[Comparison]:
    """Every replay with the one of its variant and control; `judged` compares whether it holds too."""
    found = {(r.variant, r.control): r for r in again}
    if len(found) != len(recorded):
        yield compare_numbers("number of replays", len(recorded), len(found), "1")
    for replay in recorded:
        name = f"replay {replay.variant}, {replay.control}"
        other = found.get((replay.variant, replay.control))
        if other is None:
            yield Comparison(name, 1.0, None, "1", 0.0, False)
            continue
        for key, unit in (("goal_error", ""), ("bound_violation", ""), ("energy_error_J", "J"), ("penetration_m", "m")):
            yield compare_numbers(f"{name}: {key}", getattr(replay, key), getattr(other, key), unit)
        if judged:
            yield compare_numbers(f"{name}: holds", float(replay.holds), float(other.holds), "1")


def differences(recorded: Any, again: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(key, recorded, again) wherever two JSON values differ; numbers by more than rounding."""
    if isinstance(recorded, dict) and isinstance(again, dict):
        for key in sorted(recorded.keys() | again.keys()):
            yield from differences(recorded.get(key), again.get(key), f"{path}.{key}" if path else key)
    elif isinstance(recorded, list) and isinstance(again, list) and len(recorded) == len(again):
        for i, (a, b) in enumerate(zip(recorded, again, strict=True)):
            yield from differences(a, b, f"{path}[{i}]")
    elif _is_number(recorded) and _is_number(again):
        if not math.isclose(recorded, again, rel_tol=ABSOLUTE, abs_tol=ABSOLUTE):
            yield path, recorded, again
    elif recorded != again:
        yield path, recorded, again


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)

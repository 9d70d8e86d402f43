"""`verify`: is a directory what was written, and do its numbers come out again? `recalled` takes a run up again."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.artifact.measurement import Measurement, measure, replay_evidence
from drake_diff.artifact.rerun import PLAN, read_plan, rebuilt, resolve
from drake_diff.artifact.save import TRACE
from drake_diff.artifact.sections import unknown_functions
from drake_diff.artifact.trace import Trace, read_trace
from drake_diff.exceptions import ArtifactError, ModelError
from drake_diff.optimize.solution import Solution
from drake_diff.record.certification import CertificationRecord, CertifiedState, certify_model
from drake_diff.record.parts import Metric
from drake_diff.record.provenance import provenance_of
from drake_diff.record.read import KINDS, kind_of
from drake_diff.record.sealed import SealedRecord, canonical, own_sha256, read_fields, reproducible
from drake_diff.record.solve import EvidenceRecord, ReplayEvidence

# How far a number computed again may be from the recorded one, of it or of its tolerance: BLAS and libm round
# differently from machine to machine; and where both are next to nothing.
RELATIVE, ABSOLUTE = 1e-6, 1e-9
CERTIFICATES = "not run again: the gradient certificates"
R = TypeVar("R", bound=SealedRecord)
NOT_TAKEN = "the numbers were not taken again"
NOT_RERUN = {"comparison": "the engines", "robustness": "the trials"}


@dataclass(frozen=True)
class Recomputed:
    """A recorded number and the same computed again; `holds` where they are no further apart than `allowed`."""

    name: str
    recorded: float | None
    again: float | None
    unit: str
    allowed: float
    holds: bool
    file: str = EvidenceRecord.FILE

    def __str__(self) -> str:
        words = f"{self.name}: recorded {_shown(self.recorded)} {self.unit}, again {_shown(self.again)}"
        return words if self.holds else f"{words}, allowed {self.allowed:.2g} apart"


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.9g}"


@dataclass(frozen=True, repr=False)
class Verification(ShowsItsRepr):
    """What `verify` found in a directory.

    `verdict` is "holds" where every file is as it was written and every number came out again; "intact" where every
    file is as it was written and no number was taken again; "undecided" where what the record's verdict rests on could
    not be run again; "broken" where something is not what it was.

    That a record holds says that it is true, not that the run was a success: that is `record.verdict`.

    Attributes:
        directory: What was verified.
        record: The record in it; None where it cannot be read.
        problems: A sentence for each file that is not as it was written, and for what does not fit together.
        comparisons: Every recorded number beside the one that was computed again.
        not_rerun: What was not run again.
        undecided: What of it the record's verdict rests on.
        notes: Versions that differ from those of the record.

    Example:
        >>> found = dd.verify("artifacts/pendulum_swing_up").require()
        >>> found.comparisons[2].name, found.comparisons[2].holds
        ('goal error', True)
    """

    directory: Path
    record: SealedRecord | None
    problems: tuple[str, ...] = ()  # each names the file
    comparisons: tuple[Recomputed, ...] = ()
    not_rerun: tuple[str, ...] = ()
    undecided: tuple[str, ...] = ()  # what of `not_rerun` the record's verdict rests on
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> Literal["holds", "intact", "undecided", "broken"]:
        """What can be said of the directory as a whole."""
        if self.problems or not all(c.holds for c in self.comparisons):
            return "broken"
        if self.undecided:
            return "undecided"
        return "holds" if self.comparisons else "intact"

    @property
    def holds(self) -> bool:
        """Whether the verdict is "holds"."""
        return self.verdict == "holds"

    @property
    def complaints(self) -> tuple[str, ...]:
        """A sentence for each thing that does not hold."""
        broken = tuple(f"{c.file}: {c}" for c in self.comparisons if not c.holds)
        return self.problems + broken

    @property
    def sentence(self) -> str:
        """What the verdict rests on."""
        held = sum(c.holds for c in self.comparisons)
        if self.verdict == "holds":
            return f"{held} numbers are the recorded ones"
        if self.verdict == "intact":
            return f"the files are as they were written; {NOT_TAKEN}"
        return "; ".join(self.complaints or self.undecided)

    def require(self) -> "Verification":
        """This verification where it holds; ArtifactError, with what does not, where it does not."""
        if not self.holds:
            raise ArtifactError(f"{self.directory}: {self}")
        return self

    def __str__(self) -> str:
        return f"{self.verdict}: {self.sentence}"

    def __repr__(self) -> str:
        lines = [f"Verification of {self.directory}: {self.verdict}", *(self.complaints or (self.sentence,))]
        return "\n  ".join(dict.fromkeys((*lines, *self.not_rerun, *self.notes)))


def verify(directory: str | Path) -> Verification:
    """Check a directory's schema, hashes and files, then run it again from them and compare every number.

    Any flipped byte, edited number, missing or extra file is found, and the message names the file. A solve is replayed
    and measured again, a certification certified again. Comparisons and robustness trials are not run again: their
    verdict is at best "intact". What cannot be run again (a model that came from a diagram, constraints that are a
    user's functions) makes the verdict "undecided".

    Args:
        directory: What `save`, `save_comparison`, `save_robustness` or `certify_model` wrote.

    Returns:
        A `Verification`, with a complaint for each thing that does not hold.

    Raises:
        ArtifactError: There is no such directory.

    Example:
        >>> found = dd.verify("artifacts/pendulum_swing_up")
        >>> found.verdict, found.complaints
        ('holds', ())
    """
    folder = Path(directory)
    if not folder.is_dir():
        raise ArtifactError(f"{folder}: expected a directory that drake_diff wrote, got no directory")
    kind = kind_of(folder)
    if kind is None:
        names = ", ".join(known.FILE for known in KINDS)
        return Verification(folder, None, problems=(f"there is no record: none of {names}",))
    try:
        record, problems = _read_checked(folder, kind)
    except ArtifactError as error:
        return Verification(folder, None, problems=(str(error),), not_rerun=("not run again: there is no record",))
    if problems:
        return Verification(folder, record, problems, not_rerun=("not run again: it is damaged",))
    if record.state == "incomplete" or (isinstance(record, EvidenceRecord) and record.solver is None):
        why = f"not run again: {record.sentence}"
        return Verification(folder, record, not_rerun=(why,), undecided=(why,))
    try:
        if isinstance(record, EvidenceRecord):
            return _solve_again(folder, record)
        if isinstance(record, CertificationRecord):
            return _certify_again(folder, record)
    except ModelError as error:
        why = f"not run again: {error}"
        return Verification(folder, record, not_rerun=(why,), undecided=(why,), notes=_other_versions(record))
    except ArtifactError as error:
        problems, notes = (str(error),), _other_versions(record)
        return Verification(folder, record, problems, not_rerun=("not run again",), notes=notes)
    return Verification(folder, record, not_rerun=(f"not run again: {NOT_RERUN[record.kind]}",))


@contextmanager
def recalled(directory: str | Path) -> Iterator[Solution]:
    """The solution in a run directory, its model rebuilt from there, for as long as the block runs.

    ArtifactError where there is none, it is damaged or it did not end; ModelError where it cannot be built again.
    """
    folder = Path(directory)
    record, problems = _read_checked(folder, EvidenceRecord)
    _refuse(folder, problems)
    _refuse(folder, () if record.solver is not None else (f"it has no plan: {record.sentence}",))
    plan, trace = read_plan(folder / PLAN), read_trace(folder / TRACE)
    with rebuilt(record.model, record.contract.get("source"), trace.attachments) as model:
        _refuse(folder, (*_odd_trace(trace, plan, record), *_odd_contract(record, model.contract.to_dict())))
        yield resolve(record, model, plan)


def _refuse(folder: Path, problems: Sequence[str]) -> None:
    if problems:
        raise ArtifactError(f"{folder}: {problems[0]}")


def _read_checked(folder: Path, kind: type[R]) -> tuple[R, tuple[str, ...]]:
    """The record in `folder`, and what of it and of the files beside it is damaged."""
    try:
        fields, problems = read_fields(folder / kind.FILE), []
        record = kind.parse(folder / kind.FILE, fields)
        if canonical(fields).encode() != (folder / kind.FILE).read_bytes():
            problems.append(f"{kind.FILE}: its bytes are not those that drake_diff writes for its content")
        if own_sha256(fields) != fields.get("record_sha256"):
            problems.append(f"{kind.FILE}: its content does not match its record_sha256: something in it was changed")
    except RecursionError as error:
        raise ArtifactError(f"{kind.FILE}: nested too deep") from error
    return record, (*problems, *_damage_of_files(folder, record))


def _damage_of_files(folder: Path, record: SealedRecord) -> Iterator[str]:
    """Whether the directory holds the recorded files, as they were, and no others. Nothing outside it is opened."""
    paths = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_symlink() or not p.is_dir()}
    paths.pop(record.FILE, None)
    for name in sorted(record.files.keys() - paths.keys()):
        yield f"{name}: missing, {record.FILE} lists it"
    for name, path in sorted(paths.items()):
        described = record.files.get(name)
        if path.is_symlink() or not path.is_file():
            yield f"{name}: a link, or not a plain file"
        elif described is None:
            yield f"{name}: {record.FILE} does not list it"
        else:
            data = path.read_bytes()
            if (described.path, described.bytes, described.sha256) != (name, len(data), sha256(data).hexdigest()):
                yield f"{name}: its {len(data)} bytes are not those that {record.FILE} describes"


def _solve_again(folder: Path, record: EvidenceRecord) -> Verification:
    costs, constraints = unknown_functions(record)
    plan, trace = read_plan(folder / PLAN), read_trace(folder / TRACE)
    problems = list(_odd_trace(trace, plan, record))
    with rebuilt(record.model, record.contract.get("source"), trace.attachments) as model:
        problems += _odd_contract(record, model.contract.to_dict())
        again = measure(resolve(record, model, plan))
        skip = ["cost"] * bool(costs) + ["constraint violation"] * bool(constraints)
        invariants = compare_metrics(record.invariants, again.invariants, ())
        comparisons = [
            *compare_metrics(record.metrics, again.metrics, skip),
            *(replace(found, name=f"invariant {found.name}") for found in invariants),
            *compare_replays(record.replays, [replay_evidence(r) for r in again.replays], not constraints),
            _compare_motion(trace.xs, again),
        ]
    undecided = tuple(f"not run again: constraint {name} is a user's function" for name in constraints)
    not_rerun = (*(f"not run again: {cost} is a user's function" for cost in costs), *undecided, CERTIFICATES)
    told = (not_rerun, undecided, _other_versions(record))
    return Verification(folder, record, tuple(problems), tuple(comparisons), *told)


def _certify_again(folder: Path, record: CertificationRecord) -> Verification:
    """The same states from the same seed, each certified again."""
    with rebuilt(record.model, record.contract.get("source"), None) as model:
        problems = _odd_contract(record, model.contract.to_dict())
        again = certify_model(
            model, states=len(record.states), seed=record.seed, parameters=record.parameters, method=record.method
        )
    comparisons: list[Recomputed] = []
    for i, (was, now) in enumerate(zip(record.states, again.states, strict=True)):
        found = differences(_what_is_certified(was), _what_is_certified(now), f"states[{i}]")
        problems += [f"{record.FILE}: {key}: recorded {old}, again {new}" for key, old, new in found]
        largest = compare_numbers(f"state {i}: largest entry", was.largest, now.largest, "")
        comparisons.append(replace(largest, file=record.FILE))
    return Verification(folder, record, tuple(problems), tuple(comparisons), notes=_other_versions(record))


def _what_is_certified(state: CertifiedState) -> dict[str, Any]:
    """The state and its certificate, but for what is only told in words and may round to other digits."""
    found = state.model_dump(mode="json", exclude={"refusal", "largest", "mode_changes"})
    if found["gradient"] is not None:
        del found["gradient"]["worst"]
    return found


def compare_metrics(recorded: Sequence[Metric], again: Sequence[Metric], skip: Sequence[str]) -> Iterator[Recomputed]:
    """Every recorded metric but those in `skip` with the one of its name."""
    found = {metric.name: metric for metric in again}
    for metric in recorded:
        other = found.get(metric.name)
        if metric.name in skip:
            continue
        if other is None or (other.definition, other.unit) != (metric.definition, metric.unit):
            name = f"{metric.name} (defined otherwise in this version)"
            yield Recomputed(name, metric.value, None, metric.unit, 0.0, False)
            continue
        compared = compare_numbers(metric.name, metric.value, other.value, metric.unit, metric.tolerance or 0.0)
        if compared.holds and other.tolerance != metric.tolerance:
            name = f"the tolerance of {metric.name}"
            yield Recomputed(name, metric.tolerance, other.tolerance, metric.unit, 0.0, False)
        yield compared


def compare_numbers(
    name: str, recorded: float | None, again: float | None, unit: str, scale: float = 0.0
) -> Recomputed:
    """Two numbers; none and none are the same. `scale` is that of the differences that do not matter."""
    allowed = RELATIVE * max(abs(recorded or 0.0), scale) + ABSOLUTE
    holds = recorded is None and again is None
    if recorded is not None and again is not None:
        holds = abs(recorded - again) <= allowed
    return Recomputed(name, recorded, again, unit, allowed, holds)


def compare_replays(
    recorded: Sequence[ReplayEvidence], again: Sequence[ReplayEvidence], judged: bool
) -> Iterator[Recomputed]:
    """Every replay with the one of its variant and control; `judged` compares whether it holds too."""
    found = {(r.variant, r.control): r for r in again}
    if len(found) != len(recorded):
        yield compare_numbers("number of replays", len(recorded), len(found), "1")
    for replay in recorded:
        name = f"replay {replay.variant}, {replay.control}"
        other = found.get((replay.variant, replay.control))
        if other is None:
            yield Recomputed(name, 1.0, None, "1", 0.0, False)
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


def _compare_motion(recorded: Array, again: Measurement) -> Recomputed:
    """The motion in the trace with the plant's own."""
    motion, name = again.motion, "/state, its largest distance from the motion run again"
    unit = again.state_unit
    if motion is None:
        found = compare_numbers(name, float(len(recorded)), 0.0, unit)
    elif recorded.shape != motion.xs.shape:
        found = compare_numbers(name, 0.0, None, unit)
    else:
        distance, scale = np.abs(recorded - motion.xs).max(), np.abs(motion.xs).max()
        found = compare_numbers(name, 0.0, float(distance), unit, scale=float(scale))
    return replace(found, file=TRACE)


def _odd_trace(trace: Trace, plan: dict[str, Any], record: EvidenceRecord) -> Iterator[str]:
    """What in the trace is not what record.json and plan.npz have."""
    if trace.attachments.get(record.FILE) != reproducible(record.model_dump(mode="json")).encode():
        yield f"{TRACE}: the record that it carries is not {record.FILE}"
    inputs = np.vstack([plan["us"], plan["u_final"]]) if "u_final" in plan else plan["us"]
    for topic, recorded, planned in (("state", trace.planned_xs, plan["xs"]), ("input", trace.planned_us, inputs)):
        if not np.array_equal(recorded, planned, equal_nan=True):
            yield f"{TRACE}: /planned/{topic} is not what {PLAN} has"


def _odd_contract(record: EvidenceRecord | CertificationRecord, again: dict[str, Any]) -> list[str]:
    """Where the rebuilt model is another than the recorded contract; where the file was, and notes, do not matter."""
    apart = ("source", "notes")
    old, new = ({key: value for key, value in c.items() if key not in apart} for c in (record.contract, again))
    told = f"{record.FILE}: contract"
    return [f"{told}, {key}: recorded {was}, the model has {now}" for key, was, now in differences(old, new)]


def _other_versions(record: SealedRecord) -> tuple[str, ...]:
    was, now = record.provenance.packages, provenance_of().packages
    names = [n for n in ("drake", "drake-diff", "numpy", "casadi") if was.get(n) != now.get(n)]
    return tuple(f"recorded with {name} {was.get(name)}, run again with {now.get(name)}" for name in names)

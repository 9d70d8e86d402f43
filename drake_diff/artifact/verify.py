"""A run again from its directory alone: the model, the problem and the plan, measured by what measured them first.

The model is built from the file that trace.mcap carries, in a folder of its own. One that names other files (meshes) is
built where it stood, and only if it and all of them are still what the record says: the artifact has their hashes, not
their bytes.

What `verify` found: which file is damaged, which number no longer holds, and what could not be run again.

`verify`: is a run directory what was written, and do its numbers come out again? `recalled` takes it up again.
"""

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.artifact.measures import invariants_of, metrics_of, replay_evidence, units_of
from drake_diff.artifact.plan_file import PLAN, PlanArrays, read_plan
from drake_diff.artifact.save import TRACE
from drake_diff.artifact.sections import rebuild_problem, unknown_functions
from drake_diff.artifact.trace_read import read_trace
from drake_diff.exceptions import ArtifactError, InputError, ModelError, ModelWarning
from drake_diff.model.load_file import FORMATS
from drake_diff.model.model import Model, load_model
from drake_diff.optimize.solution import Solution, Status
from drake_diff.record.parts import Metric
from drake_diff.record.provenance import file_evidence, named_files, provenance_of
from drake_diff.record.read import RECORD, parse_record, read_fields
from drake_diff.record.run_record import EvidenceRecord, ReplayEvidence, canonical, own_sha256, reproducible


@contextmanager
def rebuilt(record: EvidenceRecord, attachments: dict[str, bytes]) -> Iterator[Model]:
    """The model of a record, for as long as the block runs; `attachments` are the trace's.

    Raises ModelError, saying why, where it cannot be built again, ArtifactError where the artifact is damaged.
    """
    given = record.inputs.model
    if given.file is None or given.options is None:
        raise ModelError("the model is a user's own diagram, which no artifact can hold")
    if given.named:
        yield _load(_source_if_unchanged(record), given.options)
        return
    name, data = given.file.path, attachments.get(given.file.path)
    if data is None or sha256(data).hexdigest() != given.file.sha256:
        raise ArtifactError(f"trace.mcap: it does not carry the model file {name} that record.json describes")
    if Path(name).name != name or not name.endswith(FORMATS):
        raise ArtifactError(f"record.json: {name!r} is no name of a model file")
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(data)
        if named_files(path):
            raise ArtifactError(f"record.json: it does not list the files that {name} names")
        yield _load(path, given.options)


def _source_if_unchanged(record: EvidenceRecord) -> Path:
    """The model file where it stood; ModelError where it or a file that it names is not the recorded one."""
    given, source = record.inputs.model, Path(str(record.contract.get("source", "")))
    why = f"the model names other files, and {source} is not"
    if given.file is None or not (source.name.endswith(FORMATS) and source.is_file()):
        raise ModelError(f"{why} there")
    if file_evidence(source, given.file.path) != given.file:
        raise ModelError(f"{why} what it was")
    changed = [was.path for was in given.named if was not in named_files(source)]
    if changed:
        raise ModelError(f"the model names {changed[0]}, which is not what it was")
    return source


def _load(path: Path, options: dict[str, Any]) -> Model:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ModelWarning)  # said when the model was loaded first
            return load_model(path, **options)
    except (InputError, TypeError) as error:
        raise ArtifactError(f"record.json: the model's options are none: {error}") from error


def resolve(record: EvidenceRecord, model: Model, plan: PlanArrays) -> Solution:
    """The solution of a record, to be measured again. ArtifactError where plan and problem do not go together."""
    solver = record.solver
    if solver is None:
        raise ArtifactError("record.json: it has no solver")
    count = record.problem.get("num_steps")
    if plan.us.shape != (count, model.nu) or plan.xs.shape != (len(plan.us) + 1, model.nx):
        got = f"xs {plan.xs.shape}, us {plan.us.shape}"
        raise ArtifactError(f"{PLAN}: expected {count} steps of {model.nx} states and {model.nu} inputs, got {got}")
    try:
        return Solution(
            problem=rebuild_problem(record, model, plan.us),
            method=solver.method,
            solver=solver.solver,
            status=Status(solver.status),
            message=solver.message,
            xs=plan.xs,
            us=plan.us,
            scheme=solver.scheme,
            us_mid=plan.us_mid,
            u_final=plan.u_final,
            free_horizon=plan.free_horizon,
            parameters=plan.parameters,
        )
    except (InputError, ValueError, KeyError, TypeError) as error:
        raise ArtifactError(f"record.json: its problem is none: {error}") from error


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


CERTIFICATES = "gradient certificates are not computed again"


def verify(directory: str | Path) -> Verification:
    """Check a run directory's schema, hashes and files, then run it again from them alone and compare every number.

    Any flipped byte, edited number, missing or extra file is found, and the message names the file. What cannot be run
    again (a model that came from a diagram, constraints that are a user's functions) makes the verdict "undecided".
    Raises ArtifactError where there is no such directory.
    """
    folder = Path(directory)
    if not folder.is_dir():
        raise ArtifactError(f"{folder}: expected a run directory that drake_diff wrote, got no directory")
    try:
        fields = read_fields(folder / RECORD)
        record = parse_record(folder / RECORD, fields)
        problems = (*_damage_of_record(folder, fields), *_damage_of_files(folder, record))
    except (ArtifactError, RecursionError) as error:
        words = str(error) if isinstance(error, ArtifactError) else f"{RECORD}: nested too deep"
        return Verification(folder, None, problems=(words,), not_rerun=("everything: there is no record",))
    if problems:
        return Verification(folder, record, problems, not_rerun=("everything: what is damaged is not run",))
    if record.state == "incomplete" or record.solver is None:
        why = f"not re-run: {record.sentence}"
        return Verification(folder, record, not_rerun=(why,), undecided=(why,))
    return _run_again(folder, record, fields)


@contextmanager
def recalled(directory: str | Path) -> Iterator[Solution]:
    """The solution in a run directory, its model rebuilt from there, for as long as the block runs.

    ArtifactError where there is none, it is damaged or it did not end; ModelError where it cannot be built again.
    """
    folder = Path(directory)
    fields = read_fields(folder / RECORD)
    record = parse_record(folder / RECORD, fields)
    _refuse(folder, (*_damage_of_record(folder, fields), *_damage_of_files(folder, record)))
    _refuse(folder, () if record.solver is not None else (f"it has no plan: {record.sentence}",))
    plan, trace = read_plan(folder / PLAN), read_trace(folder / TRACE)
    with rebuilt(record, trace.attachments) as model:
        _refuse(folder, (*_odd_trace(trace, plan, fields), *_odd_contract(record, model.contract.to_dict())))
        yield resolve(record, model, plan)


def _refuse(folder: Path, problems: Sequence[str]) -> None:
    if problems:
        raise ArtifactError(f"{folder}: {problems[0]}")


def _damage_of_record(folder: Path, fields: dict[str, Any]) -> Iterator[str]:
    """Whether record.json is, byte for byte, what its content and its own hash say."""
    if canonical(fields).encode() != (folder / RECORD).read_bytes():
        yield f"{RECORD}: its bytes are not those that drake_diff writes for its content"
    if own_sha256(fields) != fields.get("record_sha256"):
        yield f"{RECORD}: its content is not that of its record_sha256: something in it was changed"


def _damage_of_files(folder: Path, record: EvidenceRecord) -> Iterator[str]:
    """Whether the directory holds the recorded files, as they were, and no others. Nothing outside it is opened."""
    paths = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_symlink() or not p.is_dir()}
    paths.pop(RECORD, None)
    for name in sorted(record.files.keys() - paths.keys()):
        yield f"{name}: missing, {RECORD} lists it"
    for name, path in sorted(paths.items()):
        described = record.files.get(name)
        if path.is_symlink() or not path.is_file():
            yield f"{name}: a link or no plain file"
        elif described is None:
            yield f"{name}: {RECORD} does not list it"
        else:
            data = path.read_bytes()
            if (described.path, described.bytes, described.sha256) != (name, len(data), sha256(data).hexdigest()):
                yield f"{name}: its {len(data)} bytes are not those that {RECORD} describes"


def _run_again(folder: Path, record: EvidenceRecord, fields: dict[str, Any]) -> Verification:
    costs, constraints = unknown_functions(record)
    notes = tuple(_other_versions(record))
    try:
        plan, trace = read_plan(folder / PLAN), read_trace(folder / TRACE)
        problems = list(_odd_trace(trace, plan, fields))
        with rebuilt(record, trace.attachments) as model:
            problems += _odd_contract(record, model.contract.to_dict())
            solution = resolve(record, model, plan)
            comparisons = (
                *_compare(record, solution, costs, constraints),
                _compare_motion(trace.xs, solution),
            )
    except ModelError as error:
        why = f"not re-run: {error}"
        return Verification(folder, record, not_rerun=(why,), undecided=(why,), notes=notes)
    except ArtifactError as error:
        return Verification(folder, record, problems=(str(error),), not_rerun=("everything",), notes=notes)
    undecided = tuple(f"not re-run: constraint {name} is a user's function" for name in constraints)
    not_rerun = (*(f"not re-run: {cost} is a user's function" for cost in costs), *undecided, CERTIFICATES)
    return Verification(folder, record, tuple(problems), comparisons, not_rerun, undecided, notes)


def _compare(
    record: EvidenceRecord, solution: Solution, costs: list[str], constraints: list[str]
) -> Iterator[Comparison]:
    skip = ["cost"] * bool(costs) + ["constraint violation"] * bool(constraints)
    yield from compare_metrics(record.metrics, metrics_of(solution), skip)
    for found in compare_metrics(record.invariants, invariants_of(solution), ()):
        yield replace(found, name=f"invariant {found.name}")
    yield from compare_replays(record.replays, [replay_evidence(r) for r in solution.replays], not constraints)


def _compare_motion(recorded: Array, solution: Solution) -> Comparison:
    """The motion in the trace with the plant's own."""
    motion = solution.replay
    name, unit = "/state, its largest distance from the motion run again", units_of(solution, "positions", "velocities")
    if motion is None:
        found = compare_numbers(name, float(len(recorded)), 0.0, unit)
    elif recorded.shape != motion.xs.shape:
        found = compare_numbers(name, 0.0, None, unit)
    else:
        distance, scale = np.abs(recorded - motion.xs).max(), np.abs(motion.xs).max()
        found = compare_numbers(name, 0.0, float(distance), unit, scale=float(scale))
    return replace(found, file=TRACE)


def _odd_trace(trace: Any, plan: PlanArrays, fields: dict[str, Any]) -> Iterator[str]:
    """What in the trace is not what record.json and plan.npz have."""
    if trace.attachments.get(RECORD) != reproducible(fields).encode():
        yield f"{TRACE}: the record that it carries is not {RECORD}"
    inputs = plan.us if plan.u_final is None else np.vstack([plan.us, plan.u_final])
    for topic, recorded, planned in (("state", trace.planned_xs, plan.xs), ("input", trace.planned_us, inputs)):
        if not np.array_equal(recorded, planned, equal_nan=True):
            yield f"{TRACE}: /planned/{topic} is not what {PLAN} has"


def _odd_contract(record: EvidenceRecord, again: dict[str, Any]) -> list[str]:
    """Where the rebuilt model is another than the recorded contract; where the file was, and notes, do not matter."""
    apart = ("source", "notes")
    recorded, rebuilt_now = (
        {key: value for key, value in contract.items() if key not in apart} for contract in (record.contract, again)
    )
    return [
        f"{RECORD}: contract, {key}: recorded {was}, the model has {now}"
        for key, was, now in differences(recorded, rebuilt_now)
    ]


def _other_versions(record: EvidenceRecord) -> Iterator[str]:
    now = provenance_of().packages
    for name in ("drake", "drake-diff", "numpy", "casadi"):
        was = record.provenance.packages.get(name)
        if was != now.get(name):
            yield f"recorded with {name} {was}, run again with {now.get(name)}"

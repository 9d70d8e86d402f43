"""`verify`: is a run directory what was written, and do its numbers come out again? `recalled` takes it up again."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff.arrays import Array
from drake_diff.evidence import TRACE
from drake_diff.exceptions import ArtifactError, ModelError
from drake_diff.invariants import invariants_of
from drake_diff.metrics import metrics_of, replay_evidence, units_of
from drake_diff.plan_file import PLAN, PlanArrays, read_plan
from drake_diff.problem_record import unknown_functions
from drake_diff.provenance import provenance_of
from drake_diff.record import EvidenceRecord, canonical, own_sha256, reproducible
from drake_diff.record_file import RECORD, parse_record, read_fields
from drake_diff.rerun import rebuilt, resolve
from drake_diff.solution import Solution
from drake_diff.trace_read import read_trace
from drake_diff.verification import (
    Comparison,
    Verification,
    compare_metrics,
    compare_numbers,
    compare_replays,
    differences,
)

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

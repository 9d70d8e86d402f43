"""Read the record of a directory, whichever kind it is; those of version 2 of the schema are converted."""

import json
import os
from collections.abc import Mapping
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from drake_diff.exceptions import ArtifactError
from drake_diff.runs.other_records import ComparisonRecord, FitRecord, is_trial_file
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.sealed import SCHEMA_VERSION, SealedRecord, read_fields

# The kinds of version 2, by the file that their record was in, and the section that their own fields are in now.
FILES = {
    "record.json": "solve",
    "phases.json": "phases",
    "certification.json": "certification",
    "rollout.json": "rollout",
    "robustness.json": "robustness",
    "identification.json": "identification",
    "comparison.json": "comparison",
    "panel.json": "panel",
}
KINDS_OF_2 = {
    "solve": "plan",
    **dict.fromkeys(("phases", "certification", "rollout", "robustness"), "plan"),
    "identification": "fit",
    **dict.fromkeys(("comparison", "panel", "trial"), "comparison"),
}
SECTIONS = {
    "phases": ("horizon_s", "counts_steps", "search", "initial_guess", "cost", "phases", "links", "chain"),
    "certification": ("seed", "method", "parameters", "states"),
    "rollout": (
        "x0", "us", "loss", "columns", "derivative", "verdicts", "certificate", "truth", "no_truth",
    ),
    "robustness": ("run", "state_names", "input_names", "trials", "seed", "loop", "nominal", "perturbations"),
    "panel": ("panel", "trials", "errors", "ranked_by", "ranking"),
    "trial": ("id", "cell", "inputs", "result", "panel"),
}  # fmt: skip
DROPPED = ("evaluations", "elsewhere")  # a second measurement, which is a test now, and what replays say now
RENAMED = {"panel": "conditions"}  # within the sections of a panel and of a trial
FIXED_CONTACTS = {"HeldSpeeds": "FixedSpeeds", "HeldPlaces": "FixedPositions", "HeldForce": "FixedForce"}  # constraints


def upgraded(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a record of version 2 by the names of version 3; the version that wrote them stays."""
    kind = fields.get("kind")
    names = SECTIONS.get(str(kind), ())
    moved = {name: fields[name] for name in names if name in fields}
    result = {key: value for key, value in fields.items() if key not in moved and key not in DROPPED}
    if kind in ("panel", "trial"):
        moved = {RENAMED.get(name, name): value for name, value in moved.items()}
    if names:
        result[str(kind)] = moved
    problem = result.get("problem")
    if isinstance(problem, Mapping) and "held" in problem:
        result["problem"] = _with_fixed_contacts(problem)
    return {**result, "kind": KINDS_OF_2.get(str(kind), kind)}


def _with_fixed_contacts(problem: Mapping[str, Any]) -> dict[str, Any]:
    """The problem of a phase whose points the world held, by the names of version 3."""
    constraints = [
        {**c, "quantity": c["quantity"] and {FIXED_CONTACTS.get(kind, kind): v for kind, v in c["quantity"].items()}}
        for c in problem["constraints"]
    ]
    others = {key: value for key, value in problem.items() if key != "held"}
    return {**others, "constraints": constraints, "fixed_contacts": problem["held"]}


KINDS: dict[str, type[SealedRecord]] = {kind.KIND: kind for kind in (PlanRecord, FitRecord, ComparisonRecord)}


def record_path(directory: str | Path) -> Path | None:
    """The file of the record in `directory`, or of one trial; None where there is none.

    What has that name need not be a plain file: reading it says so.
    """
    if is_trial_file(Path(directory)):
        return Path(directory)
    return next((Path(directory) / name for name in FILES if os.path.lexists(Path(directory) / name)), None)


def load_record(directory: str | Path) -> SealedRecord:
    """Read the record in a directory that a solve, a fit, a comparison, trials or a certification wrote.

    It is read, not verified: see `verify`. A record of version 2 of the schema is converted.

    Args:
        directory: The directory that holds record.json; or trials/ID.json of a panel.

    Returns:
        A `PlanRecord`, `FitRecord` or `ComparisonRecord`.

    Raises:
        ArtifactError: There is no such record, or it does not follow its schema.

    Example:
        >>> record = dd.load_record("artifacts/pendulum_swing_up")
        >>> record.kind, record.verdict, record.solver.method
        ('plan', 'pass', 'shooting')
    """
    path = record_path(directory)
    if path is None:
        raise ArtifactError(f"{directory}: no such record; expected a directory with {SealedRecord.FILE}")
    return parse_record(path, read_fields(path))


def load_plan_record(directory: str | Path) -> PlanRecord:
    """The record in `directory`; ArtifactError where it is not that of a solve."""
    record = load_record(directory)
    if not isinstance(record, PlanRecord) or record.subject != "plan":
        raise ArtifactError(f"{directory}: expected the record of a solve, got one of a {record.subject}")
    return record


def parse_record(path: Path, fields: Mapping[str, Any]) -> SealedRecord:
    """The record with these fields, read from `path`; of a later minor version without what is not known here."""
    version, major = fields.get("schema_version"), SCHEMA_VERSION.split(".")[0]
    if not isinstance(version, str) or version.split(".")[0] not in ("2", major):
        raise ArtifactError(f"{path}: schema_version {version!r}; this drake_diff reads 2.x.y and {major}.x.y")
    known = json.loads(json.dumps(upgraded(fields) if version.startswith("2.") else fields))
    kind = KINDS.get(str(known.get("kind")))
    if kind is None:
        raise ArtifactError(f"{path}: kind {fields.get('kind')!r}; expected one of {', '.join(KINDS)}")
    try:
        return kind.model_validate(known)
    except ValidationError as error:
        unknown = [entry["loc"] for entry in error.errors() if entry["type"] == "extra_forbidden"]
    for *parents, name in unknown if version != SCHEMA_VERSION else ():
        del reduce(getitem, parents, known)[name]
    try:
        return kind.model_validate(known)
    except ValidationError as error:
        raise ArtifactError(f"{path} does not follow schema {SCHEMA_VERSION}: {error}") from error

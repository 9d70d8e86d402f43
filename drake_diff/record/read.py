"""The JSON Schema of record.json: a file of the package, a copy of which is in every run directory.

Read record.json: of this schema's major version, also where a later minor one has fields that are not known here.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from drake_diff.exceptions import ArtifactError
from drake_diff.record.run_record import SCHEMA_VERSION, EvidenceRecord

SCHEMA_FILE = "record.schema.json"
PATH = Path(__file__).parent.parent / "schema" / SCHEMA_FILE


def published_schema() -> bytes:
    """The schema as the package has it."""
    return PATH.read_bytes()


def generated_schema() -> bytes:
    """The schema as pydantic makes it from `EvidenceRecord`; a test holds the two equal."""
    return (json.dumps(EvidenceRecord.model_json_schema(), sort_keys=True, indent=2) + "\n").encode()


RECORD = "record.json"


def load_record(directory: str | Path) -> EvidenceRecord:
    """The record in a run directory. ArtifactError where there is none or it does not hold to the schema.

    It is read, not verified: see `verify`.
    """
    path = Path(directory) / RECORD
    return parse_record(path, read_fields(path))


def read_fields(path: Path) -> dict[str, Any]:
    """The JSON object in `path` as it stands there; ArtifactError where it is none."""
    try:
        fields = json.loads(path.read_bytes().decode("utf-8"), parse_constant=_refuse)
    except FileNotFoundError as error:
        raise ArtifactError(f"{path}: no such record; expected a run directory that drake_diff wrote") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ArtifactError(f"{path} is no JSON: {type(error).__name__}: {error}") from error
    if not isinstance(fields, dict):
        raise ArtifactError(f"{path}: expected a JSON object, got {type(fields).__name__}")
    return fields


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number of JSON")


def parse_record(path: Path, fields: Mapping[str, Any]) -> EvidenceRecord:
    """The record with these fields; ArtifactError, naming `path`, where they do not hold to the schema."""
    version = fields.get("schema_version")
    if not isinstance(version, str) or version.split(".")[0] != SCHEMA_VERSION.split(".")[0]:
        major = SCHEMA_VERSION.split(".")[0]
        raise ArtifactError(f"{path}: schema_version {version!r}; this drake_diff reads {major}.x.y")
    known = json.loads(json.dumps(fields))
    try:
        return EvidenceRecord.model_validate(known)
    except ValidationError as error:
        if version != SCHEMA_VERSION:  # another minor version: what it has more is left out
            _drop(known, error)
        try:
            return EvidenceRecord.model_validate(known)
        except ValidationError as remaining:
            raise ArtifactError(f"{path} is no record of schema {SCHEMA_VERSION}: {remaining}") from remaining


def _drop(fields: Any, error: ValidationError) -> None:
    """Remove the fields that the schema does not have."""
    for found in error.errors():
        if found["type"] == "extra_forbidden":
            part = fields
            for key in found["loc"][:-1]:
                part = part[key]
            del part[found["loc"][-1]]

"""The JSON Schema of record.json: a file of the package, a copy of which is in every run directory."""

import json
from pathlib import Path

from drake_diff.record import EvidenceRecord

SCHEMA_FILE = "record.schema.json"
PATH = Path(__file__).parent / "schema" / SCHEMA_FILE


def published_schema() -> bytes:
    """The schema as the package has it."""
    return PATH.read_bytes()


def generated_schema() -> bytes:
    """The schema as pydantic makes it from `EvidenceRecord`; a test holds the two equal."""
    return (json.dumps(EvidenceRecord.model_json_schema(), sort_keys=True, indent=2) + "\n").encode()

"""What all records have in common: verdict, provenance, the files of their directory, their hash.

A record is canonical JSON, record.json, beside the files that it describes and a copy of its JSON Schema. It is written
when a run begins, as "incomplete", and again, last of all files, when everything that it names is there.
"""

import json
import os
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field

from drake_diff._base.files import MOST_TEXT, json_of, make_folder, read_plain, write_whole
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import ArtifactError
from drake_diff.runs.fields import DataBoundary, Embodiment, Fields, FileEvidence, ModelInput, Provenance, canonical
from drake_diff.runs.provenance import file_evidence

# A new major one where a field goes or changes its meaning, a minor one where one is added.
SCHEMA_VERSION = "3.0.0"
# How others are read, word for word in every published schema.
READING = (
    f"This is version {SCHEMA_VERSION}. An earlier minor version of the same major one is read with what it lacks "
    "empty or null, which says that it was not recorded. A later minor version is read without the fields that are not "
    "known here. Records of version 2 are converted. Another major version is refused by name."
)
SCHEMAS = Path(__file__).parent.parent / "schema"
MOST_NAMES = 5  # of files, in a printed record
APART = ("wall_clock", "files", "record_sha256")  # of what is the same, byte for byte, in every run
Passed = Literal["pass", "fail", "incomplete"]


class WallClock(Fields):
    """What differs from run to run: everything else in a record is the same, byte for byte."""

    written_utc: str
    duration_s: float | None = None
    latency_median_s: float | None = None  # of a controller, in the unperturbed run and the worst trials
    latency_99_percent_s: float | None = None
    latency_largest_s: float | None = None
    late: int | None = None
    controller_steps: int | None = None
    seconds_per_step: dict[str, float | None] = Field(default_factory=dict)  # by engine
    seconds_per_jacobian: dict[str, float | None] = Field(default_factory=dict)


class SealedRecord(ShowsItsRepr, Fields):
    """The base of every record. "incomplete" is what a run that is under way, or was killed, says of itself.

    `files` are all others of the directory, by their path in it. `record_sha256` is the hash of this record's canonical
    JSON (sorted keys, indented by 2) with `record_sha256` empty.
    """

    FILE: ClassVar[str] = "record.json"
    SCHEMA_FILE: ClassVar[str] = "record.schema.json"
    KIND: ClassVar[str]

    schema_version: str = SCHEMA_VERSION
    kind: str
    name: str
    verdict: Passed
    sentence: str
    model: ModelInput
    embodiment: Embodiment | None = None  # null: of no robot, or of one in each phase
    data: DataBoundary | None = None  # null: nothing was fitted to data or judged on them
    provenance: Provenance
    wall_clock: WallClock
    files: dict[str, FileEvidence] = Field(default_factory=dict)
    record_sha256: str = ""

    @property
    def subject(self) -> str:
        """What the record is of: its kind, or the name of its section."""
        return self.kind

    @property
    def state(self) -> Literal["incomplete", "complete"]:
        """Whether the run has ended, well or not."""
        return "incomplete" if self.verdict == "incomplete" else "complete"

    @classmethod
    def published_schema(cls) -> bytes:
        """The JSON Schema as the package has it."""
        return (SCHEMAS / f"{cls.KIND}.schema.json").read_bytes()

    @classmethod
    def generated_schema(cls) -> bytes:
        """The JSON Schema as pydantic makes it from the class; a test holds it equal to the published one."""
        schema = {**_untitled(cls.model_json_schema()), "$comment": READING}
        return (json.dumps(schema, sort_keys=True, indent=2) + "\n").encode()

    def to_json(self) -> str:
        """The record as canonical JSON: the same record gives the same bytes."""
        return canonical(self.model_dump(mode="json"))

    def sealed(self) -> Self:
        """This record with its own hash."""
        return self.model_copy(update={"record_sha256": own_sha256(self.model_dump(mode="json"))})

    def begin(self, directory: Path) -> None:
        """Write this record of a run that is under way."""
        make_folder(directory)
        write_whole(directory / self.FILE, self.sealed().to_json().encode())

    def write(self, directory: Path) -> Self:
        """Write the schema and then this record, with the hash of every other file in `directory` and its own."""
        make_folder(directory)
        write_whole(directory / self.SCHEMA_FILE, self.published_schema())
        record = self.model_copy(update={"files": files_below(directory, self.FILE)}).sealed()
        write_whole(directory / self.FILE, record.to_json().encode())
        return record

    def facts(self) -> dict[str, str]:
        """A few lines about the record, for a reader; each kind adds its own."""
        names = sorted(self.files)
        more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
        made = f"{self.wall_clock.written_utc} with Drake {self.provenance.packages.get('drake', '?')}"
        return {"made": made, "files": ", ".join(names[:MOST_NAMES]) + more}

    def __str__(self) -> str:
        return f"{self.name}: {self.verdict}, {self.sentence}"

    def __repr__(self) -> str:
        lines = [f"{type(self).__name__} {self.name}: {self.verdict}", self.sentence]
        return "\n  ".join(lines + [f"{key}: {value}" for key, value in self.facts().items()])


def _untitled(schema: Any) -> Any:
    """A JSON Schema without the titles that pydantic makes of names."""
    if isinstance(schema, list):
        return [_untitled(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    return {key: _untitled(item) for key, item in schema.items() if key != "title" or not isinstance(item, str)}


def own_sha256(fields: Mapping[str, Any]) -> str:
    """The hash that belongs into `record_sha256` of a record with these fields."""
    return sha256(canonical({**fields, "record_sha256": ""}).encode()).hexdigest()


def reproducible(fields: Mapping[str, Any]) -> str:
    """The canonical JSON of a record's fields without wall-clock facts and hashes: what trace.mcap carries."""
    return canonical({key: value for key, value in fields.items() if key not in APART})


def files_below(directory: Path, but: str) -> dict[str, FileEvidence]:
    """Size and hash of every plain file below `directory` except `but`, by its path there; links are left out."""
    paths = {p.relative_to(directory).as_posix(): p for p in directory.rglob("*") if p.is_file() and not p.is_symlink()}
    return {name: file_evidence(path, name) for name, path in sorted(paths.items()) if name != but}


def read_fields(path: Path) -> dict[str, Any]:
    """The JSON object in `path` as it stands there; ArtifactError where it is none."""
    if not os.path.lexists(path):
        raise ArtifactError(f"{path}: no such record; expected a directory that drake_diff wrote")
    try:
        fields = json_of(read_plain(path, MOST_TEXT))
    except ValueError as error:
        raise ArtifactError(f"{path} is not JSON: {type(error).__name__}: {error}") from error
    if not isinstance(fields, dict):
        raise ArtifactError(f"{path}: expected a JSON object, got {type(fields).__name__}")
    return fields

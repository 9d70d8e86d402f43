"""What all records have in common: verdict, provenance, the files of their directory, a hash of their own.

A record is canonical JSON beside the files that it describes, and a copy of its JSON Schema lies with them. It is
written when a run begins, as "incomplete", and again, last of all files, when everything that it names is there.
"""

import json
import os
from collections.abc import Mapping
from functools import reduce
from hashlib import sha256
from operator import getitem
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, ValidationError

from drake_diff._base.files import make_folder, write_whole
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff._base.untrusted import MOST_TEXT, json_of, read_plain
from drake_diff.exceptions import ArtifactError
from drake_diff.record.parts import DataBoundary, Embodiment, FileEvidence, ModelInput, Part, Provenance
from drake_diff.record.provenance import file_evidence

# A new major one where a field goes or changes its meaning, a minor one where one is added.
SCHEMA_VERSION = "2.4.0"
# How others are read, word for word in every published schema.
READING = (
    f"This is version {SCHEMA_VERSION}. An earlier minor version of the same major one is read with what it lacks "
    "empty or null, which says that it was not recorded. A later minor version is read without the fields that are not "
    "known here. Another major version is refused by name."
)
SCHEMAS = Path(__file__).parent.parent / "schema"
MOST_NAMES = 5  # of files, in a printed record
APART = ("wall_clock", "files", "record_sha256")  # of what is the same, byte for byte, in every run
Passed = Literal["pass", "fail", "incomplete"]


class WallClock(Part):
    """What differs from run to run: everything else in a record is the same, byte for byte."""

    written_utc: str
    duration_s: float | None = None


class SealedRecord(ShowsItsRepr, Part):
    """The base of every record. "incomplete" is what a run that is under way, or was killed, says of itself.

    `files` are all others of the directory, by their path in it. `record_sha256` is the hash of this record's canonical
    JSON (sorted keys, indented by 2) with `record_sha256` empty.
    """

    FILE: ClassVar[str]  # the record's own name in its directory

    schema_version: str = SCHEMA_VERSION
    kind: str
    name: str
    verdict: Passed
    sentence: str
    model: ModelInput
    embodiment: Embodiment | None = None  # null: of no robot, of one in each phase, or of before 2.3 (solves: 2.2)
    data: DataBoundary | None = None  # null: nothing was fitted to data or judged on them, or the same
    provenance: Provenance
    wall_clock: WallClock
    files: dict[str, FileEvidence] = Field(default_factory=dict)
    record_sha256: str = ""

    @property
    def state(self) -> Literal["incomplete", "complete"]:
        """Whether the run has ended, well or not."""
        return "incomplete" if self.verdict == "incomplete" else "complete"

    @classmethod
    def schema_file(cls) -> str:
        """The name of the JSON Schema: in the package, and of the copy in every directory."""
        return cls.FILE.replace(".json", ".schema.json")

    @classmethod
    def published_schema(cls) -> bytes:
        """The JSON Schema as the package has it."""
        return (SCHEMAS / cls.schema_file()).read_bytes()

    @classmethod
    def generated_schema(cls) -> bytes:
        """The JSON Schema as pydantic makes it from the class; a test holds it equal to the published one."""
        schema = {**cls.model_json_schema(), "$comment": READING}
        return (json.dumps(schema, sort_keys=True, indent=2) + "\n").encode()

    @classmethod
    def read(cls, directory: str | Path) -> Self:
        """The record in `directory`, not verified. ArtifactError where there is none or it breaks its schema."""
        path = Path(directory) / cls.FILE
        return cls.parse(path, read_fields(path))

    @classmethod
    def parse(cls, path: Path, fields: Mapping[str, Any]) -> Self:
        """The record with these fields, read from `path`; of a later minor version without what is not known here."""
        version = fields.get("schema_version")
        major = SCHEMA_VERSION.split(".")[0]
        if not isinstance(version, str) or version.split(".")[0] != major:
            raise ArtifactError(f"{path}: schema_version {version!r}; this drake_diff reads {major}.x.y")
        known = json.loads(json.dumps(fields))
        try:
            return cls.model_validate(known)
        except ValidationError as error:
            unknown = [entry["loc"] for entry in error.errors() if entry["type"] == "extra_forbidden"]
        for *part, name in unknown if version != SCHEMA_VERSION else ():
            del reduce(getitem, part, known)[name]
        try:
            return cls.model_validate(known)
        except ValidationError as error:
            raise ArtifactError(f"{path} does not follow schema {SCHEMA_VERSION}: {error}") from error

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
        write_whole(directory / self.schema_file(), self.published_schema())
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


def canonical(fields: Mapping[str, Any]) -> str:
    """JSON with sorted keys: the same fields give the same text."""
    return json.dumps(fields, sort_keys=True, indent=2, allow_nan=False) + "\n"


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

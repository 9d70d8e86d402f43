"""The base class of all records, and their fields: numbers with units and verdicts, files, and failures.

A record is a canonical JSON file, record.json, in the directory of the files that it describes and of a copy of its
JSON Schema. It is written as "incomplete" when a run begins, and again after all files that it names. Its numbers are
never NaN or infinite; missing numbers are null.
"""

import json
import math
import os
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, model_validator

from drake_diff._base.files import MOST_TEXT, json_of, make_folder, read_plain, write_whole
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import ArtifactError

# The major version changes if a field is removed or changes its meaning, and the minor version if a field is added.
SCHEMA_VERSION = "4.1.0"
# The rules for reading other versions, which every published schema contains.
READING = (
    f"This is version {SCHEMA_VERSION}. An earlier minor version of the same major one is read with what it lacks "
    "empty or null, which says that it was not recorded. A later minor version is read without the fields that are not "
    "known here. Records of versions 2 and 3 are converted. Another major version is refused by name."
)
SCHEMAS = Path(__file__).parent.parent / "schema"
MOST_NAMES = 6  # largest number of files in a printed record
BUNDLE = "model"  # the folder of a run directory with the files that the model file names
APART = ("wall_clock", "files", "record_sha256")  # fields that differ between runs that are otherwise byte-identical
Passed = Literal["pass", "fail", "incomplete"]
NOTHING_SOLVED = "nothing was solved"
Label = Literal["perception_error", "state_error", "planning_error", "control_error", "evaluation_error"]
Table = dict[str, JsonValue]


def _finite(table: Any) -> Any:
    """Return `table` unchanged; raise ValueError if it contains a NaN or infinite number."""
    if isinstance(table, float) and table - table != 0:
        raise ValueError("expected finite numbers, with null for a missing one")
    for item in table.values() if isinstance(table, dict) else table if isinstance(table, list) else ():
        _finite(item)
    return table


FiniteTable = Annotated[Table, AfterValidator(_finite)]


def canonical(fields: Mapping[str, Any]) -> str:
    """Return the fields as JSON with sorted keys; the same fields give the same text."""
    return json.dumps(fields, sort_keys=True, indent=2, allow_nan=False) + "\n"


class Fields(BaseModel):
    """The base class of all fields: unknown fields, NaN and infinity are forbidden."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


Section = TypeVar("Section", bound=Fields)


def evidence(kind: type[Section], value: object, **given: Any) -> Section:
    """Build a section of a record from the attributes of `value` and from `given`; non-finite numbers become null."""
    return kind(**{name: plain(getattr(value, name)) for name in kind.model_fields if name not in given}, **given)


def finite(value: float) -> float | None:
    """Return `value`, or None if it is not finite."""
    return float(value) if math.isfinite(value) else None


def plain(value: Any) -> Any:
    """Convert a number, or nested lists of numbers, to JSON; non-finite numbers become null."""
    if isinstance(value, (float, np.floating)):
        return finite(float(value))
    return [plain(item) for item in value] if isinstance(value, (tuple, list, np.ndarray)) else value


class Metric(Fields):
    """Something measured on the plant after the solve; with a tolerance it decides, without one it informs.

    `verdict` is "pass" only where `value` keeps `tolerance`, and "info" where there is none; a value of null (there is
    no finite one, and `reason` says why) passes nothing. `t_s` is where along the motion it is at its worst.
    """

    name: str
    definition: str
    unit: str
    value: float | None
    reason: str | None = None
    tolerance: float | None = None
    direction: Literal["at_most", "at_least", "info"] = "info"
    verdict: Literal["pass", "fail", "undecided", "info"] = "info"
    t_s: float | None = None

    @model_validator(mode="after")
    def _is_consistent(self) -> "Metric":
        if self.value is None and not self.reason:
            raise ValueError(f"metric {self.name}: a value of null: expected a reason")
        if (self.tolerance is None) != (self.direction == "info") or (self.tolerance is None) != (
            self.verdict == "info"
        ):
            raise ValueError(f'metric {self.name}: expected a tolerance, or "info" as direction and verdict')
        if self.verdict == "pass" and not self.keeps(self.value):
            raise ValueError(f'metric {self.name}: "pass", but {self.value} violates the tolerance {self.tolerance}')
        if self.verdict == "fail" and self.keeps(self.value):
            raise ValueError(f'metric {self.name}: "fail", but {self.value} satisfies the tolerance {self.tolerance}')
        return self

    def keeps(self, value: float | None) -> bool:
        """Return whether `value` satisfies the tolerance; False if either is missing."""
        if value is None or self.tolerance is None:
            return False
        return value <= self.tolerance if self.direction == "at_most" else value >= self.tolerance


class FileEvidence(Fields):
    """A file of the run directory, or one the run was made from; `reason` says why it has no size and hash."""

    path: str
    bytes: int | None
    sha256: str | None
    reason: str | None = None


class Failure(Fields):
    """Why a run is no success: a case under one of the five labels, and what found it."""

    label: Label
    code: str
    message: str
    t_s: float | None = None  # time along the motion, if the failure has one
    detected_by: str
    evidence: str | None = None  # the section of the record that shows the failure


class Event(Fields):
    """Something that happened; `t_s` [s] is simulated time, null for what happens before or after the motion.

    "fallback", "recovery", "push" and "late" are of a closed loop; no solver here reports a "recovery" yet.
    """

    t_s: float | None
    kind: Literal[
        "solver_started",
        "solver_ended",
        "contact_made",
        "contact_broken",
        "saturation_begins",
        "saturation_ends",
        "fallback",
        "recovery",
        "push",
        "late",
        "failure",
    ]
    message: str


class Certified(Fields):
    """One certificate: what was compared, where the derivative came from, and the entry that is worst."""

    subject: str
    method: str
    verdict: str
    entries: int
    counts: dict[str, int]
    worst: str | None
    power: float  # the smallest relative error that the differences detect in every entry
    told: str  # note on the source of the differences


class Provenance(Fields):
    """With what the run was made.

    `model_file` is where the model file was, and `model_packages` are the folders that `load_model` was given.
    """

    python: str
    platform: str
    packages: dict[str, str]
    git: dict[str, str | bool] | None
    command: list[str]
    model_file: str | None = None
    model_packages: dict[str, str] = Field(default_factory=dict)


class ModelInput(Fields):
    """What the model was made from, and how; no `file` and no `options` where it is a user's own diagram.

    `named` are the files that the model file names (meshes, included models) and their licences, by the name that they
    have in it. Those whose name is neither that of a mesh nor of a robot file are not read. The content of one is in
    the directory, called model/SHA256, or in the directory above that of a phase.
    """

    file: FileEvidence | None
    named: list[FileEvidence] = Field(default_factory=list)
    options: FiniteTable | None


class DataUse(Fields):
    """Data that a run used: what it is, and the hash of its bytes, null where it has none of its own."""

    name: str
    what: str
    sha256: str | None = None


class DataBoundary(Fields):
    """Which data a run saw while it searched, and on which it was judged; `statement` says it in words.

    `held_out` are the names of what it was judged on and did not see. What has the name or the bytes of data that was
    seen is not held out: a record that says so is refused.
    """

    statement: str
    seen: list[DataUse]
    judged_on: list[DataUse]
    held_out: list[str] = Field(default_factory=list)

    @model_validator(mode="after")
    def _holds_out_only_what_was_not_seen(self) -> "DataBoundary":
        names, hashes = {use.name for use in self.seen}, {use.sha256 for use in self.seen if use.sha256}
        new = [use.name for use in self.judged_on if use.name not in names and use.sha256 not in hashes]
        wrong = [name for name in self.held_out if name not in new]
        if wrong:
            raise ValueError(f"held_out: {', '.join(wrong)} is in `seen`, or is not in `judged_on`")
        return self


class Inputs(Fields):
    """What the run started from, besides `problem`, which holds the initial state.

    `search` are the arguments of `solve`, so that it can be called again; null where they are not known.
    """

    initial_guess: str = NOTHING_SOLVED
    initial_guess_sha256: str | None = None  # SHA-256 of the bytes of xs (N+1, nx), then us (N, nu), as doubles
    seed: int | None = None
    search: FiniteTable | None = None


class Solver(Fields):
    """What solved the problem, and how it says it ended.

    `plant` is where the plan is to hold, "steps" or "continuous", and `feedback` what it needs there: null where it
    holds open loop. Both are null of a run that was not measured.
    """

    method: str
    solver: str
    scheme: str
    status: str
    message: str
    solver_message: str
    notes: list[str] = Field(default_factory=list)
    plant: str | None = None
    feedback: str | None = None
    options: FiniteTable
    iterations: int


class ParameterEvidence(Fields):
    """One entry of the parameter vector: where it started, what was found, where its derivative came from."""

    name: str
    unit: str
    derivative_source: str
    start: float
    value: float
    optimized: bool
    lower: float | None
    upper: float | None


class GradientColumn(Fields):
    """A variable by which the motion is differentiated, and the method that gives its column of derivatives."""

    name: str
    unit: str
    source: str


class GradientEvidence(Fields):
    """The gradient along the motion, by knot, how stationary the plan is, and how far it agrees with differences.

    `final_state_norms` are |d x_N / d x_k|, the largest singular value through the plant's steps after knot k.
    `lagrangian_norms` are |d L / d x_k|, in the cost's unit per the state's: L is the cost plus multipliers times the
    goal, bounds and constraints that the plan lies on, and x_k changes all later states. `stationarity` is the largest
    |d L / d z| of an optimized variable that no bound holds, over the largest sum of magnitudes of its terms: 0 at an
    optimum; multipliers are by least squares, not the solver's. `solver_tolerance` is relative, of Drake's contact
    solver, and null without one. The final loss is the first of the record's metrics.
    """

    columns: list[GradientColumn] = Field(default_factory=list)
    smoothing: str = "none"
    regularization: str = "none"
    solver_tolerance: float | None = None
    horizon_s: float | None = None
    final_state_norms: list[float | None] = Field(default_factory=list)  # null for a non-finite norm
    lagrangian_norms: list[float | None] = Field(default_factory=list)  # null for a non-finite norm
    stationarity: float | None = None
    reason: str | None = None  # reason for missing norms or stationarity
    certificates: list[Certified] = Field(default_factory=list)


class ReplayEvidence(Fields):
    """One replay of the plan on the plant; a measure is None where the motion could not be taken."""

    variant: str
    control: str
    time_step_s: float
    contact_approximation: str
    goal_error: float | None  # largest error, in the state's units
    bound_violation: float | None  # largest violation, in the state's units
    energy_error_J: float | None
    penetration_m: float | None
    holds: bool
    failures: list[str]


class WallClock(Fields):
    """What differs from run to run: everything else in a record is the same, byte for byte."""

    written_utc: str
    duration_s: float | None = None
    latency_median_s: float | None = None  # latency of a controller in the unperturbed run and the worst trials
    latency_99_percent_s: float | None = None
    latency_largest_s: float | None = None
    late: int | None = None
    controller_steps: int | None = None
    seconds_per_step: dict[str, float | None] = Field(default_factory=dict)  # by engine
    seconds_per_jacobian: dict[str, float | None] = Field(default_factory=dict)


class SealedRecord(ShowsItsRepr, Fields):
    """The base class of every record; "incomplete" is the verdict of a run that is in progress or was killed.

    `files` are all other files of the directory, by their path in it. `record_sha256` is the hash of this record's
    canonical JSON (sorted keys, indented by 2) with an empty `record_sha256`.
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
    data: DataBoundary | None = None  # null: no data were used for fitting or evaluation
    provenance: Provenance
    wall_clock: WallClock
    files: dict[str, FileEvidence] = Field(default_factory=dict)
    record_sha256: str = ""

    @property
    def subject(self) -> str:
        """The record's kind, or the name of its section."""
        return self.kind

    @property
    def file_names(self) -> list[str]:
        """The names of the other files in the directory; the model's files, named by hashes, are only counted."""
        sizes = [file.bytes or 0 for name, file in self.files.items() if name.startswith(f"{BUNDLE}/")]
        names = sorted(name for name in self.files if not name.startswith(f"{BUNDLE}/"))
        size = f"{sum(sizes) / 1e6:.2g} MB in {BUNDLE}/" if sizes else ""
        return names + [f"{len(sizes)} files that the model names, {size}"] * bool(sizes)

    @property
    def state(self) -> Literal["incomplete", "complete"]:
        """Whether the run has ended, with success or failure."""
        return "incomplete" if self.verdict == "incomplete" else "complete"

    def is_before(self, *version: int) -> bool:
        """Return whether an earlier schema version wrote the record; the first numbers of the version are given."""
        return tuple(map(int, self.schema_version.split(".")[: len(version)])) < version

    @classmethod
    def published_schema(cls) -> bytes:
        """Return the JSON Schema in the package."""
        return (SCHEMAS / f"{cls.KIND}.schema.json").read_bytes()

    @classmethod
    def generated_schema(cls) -> bytes:
        """Return the JSON Schema that pydantic generates from the class; a test compares it with the published one."""
        schema = {**_untitled(cls.model_json_schema()), "$comment": READING}
        return (json.dumps(schema, sort_keys=True, indent=2) + "\n").encode()

    def content(self) -> dict[str, Any]:
        """Return the fields as JSON values, in the order in which they are written."""
        fields: dict[str, Any] = json.loads(self.to_json())
        return fields

    def to_json(self) -> str:
        """Return the record as canonical JSON; the same record gives the same bytes."""
        return canonical(self.model_dump(mode="json"))

    def sealed(self) -> Self:
        """Return this record with its own hash."""
        return self.model_copy(update={"record_sha256": own_sha256(self.model_dump(mode="json"))})

    def begin(self, directory: Path) -> None:
        """Write this record at the start of a run."""
        make_folder(directory)
        write_whole(directory / self.FILE, self.sealed().to_json().encode())

    def write(self, directory: Path) -> Self:
        """Write the schema, then this record with its own hash and the hash of every other file in `directory`."""
        make_folder(directory)
        write_whole(directory / self.SCHEMA_FILE, self.published_schema())
        record = self.model_copy(update={"files": files_below(directory, self.FILE)}).sealed()
        write_whole(directory / self.FILE, record.to_json().encode())
        return record

    def facts(self) -> dict[str, str]:
        """Return a few lines about the record for printing; subclasses add their own."""
        names = self.file_names
        more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
        made = f"{self.wall_clock.written_utc} with Drake {self.provenance.packages.get('drake', '?')}"
        return {"made": made, "files": ", ".join(names[:MOST_NAMES]) + more}

    def __str__(self) -> str:
        return f"{self.name}: {self.verdict}, {self.sentence}"

    def __repr__(self) -> str:
        lines = [f"{type(self).__name__} {self.name}: {self.verdict}", self.sentence]
        return "\n  ".join(lines + [f"{key}: {value}" for key, value in self.facts().items()])


def _untitled(schema: Any) -> Any:
    """Remove the titles that pydantic generates from names in a JSON Schema."""
    if isinstance(schema, list):
        return [_untitled(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    return {key: _untitled(item) for key, item in schema.items() if key != "title" or not isinstance(item, str)}


def own_sha256(fields: Mapping[str, Any]) -> str:
    """Return the `record_sha256` of a record with these fields."""
    return sha256(canonical({**fields, "record_sha256": ""}).encode()).hexdigest()


def reproducible(fields: Mapping[str, Any]) -> str:
    """Return the canonical JSON of a record's fields without wall clock, files and hash; trace.mcap contains it."""
    return canonical({key: value for key, value in fields.items() if key not in APART})


def files_below(directory: Path, but: str) -> dict[str, FileEvidence]:
    """Return the size and hash of every regular file below `directory` except `but`, by relative path; skip links."""
    paths = {p.relative_to(directory).as_posix(): p for p in directory.rglob("*") if p.is_file() and not p.is_symlink()}
    return {name: file_evidence(path, name) for name, path in sorted(paths.items()) if name != but}


def read_fields(path: Path) -> dict[str, Any]:
    """Read the JSON object in `path`; raise ArtifactError if there is none."""
    if not os.path.lexists(path):
        raise ArtifactError(f"{path}: no such record; expected a directory that drake_diff wrote")
    try:
        fields = json_of(read_plain(path, MOST_TEXT))
    except ValueError as error:
        raise ArtifactError(f"{path} is not JSON: {type(error).__name__}: {error}") from error
    if not isinstance(fields, dict):
        raise ArtifactError(f"{path}: expected a JSON object, got {type(fields).__name__}")
    return fields


def file_evidence(path: Path, name: str) -> FileEvidence:
    """Return the size and hash of the file at `path`, under its `name` in the record."""
    data = path.read_bytes()
    return FileEvidence(path=name, bytes=len(data), sha256=sha256(data).hexdigest())

"""Run directories: records of every kind are read, and directories are written atomically.

A run is written to a temporary folder next to its final directory, and moved there at the end:

    run                          a finished run
    run.partial-4711-0f3a9c21    a run that is in progress, was killed or failed: process ID, and a random part
    .run.lock                    locked while a process writes `run`

An earlier run at `run` stays complete until it is replaced. If the file system can exchange two names, `run` exists at
every moment. Otherwise the earlier run is called run.replaced-... for a moment. Records of versions 2 and 3 of the
schema are converted.
"""

import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from drake_diff._base.files import (
    MOST_READ,
    MOST_TEXT,
    TooManyFilesError,
    exchange,
    files_in,
    locked,
    make_folder,
    move,
    read_plain,
    remove_folder,
    sha256_of,
    sync_folder,
    take_mode,
)
from drake_diff.exceptions import ArtifactError, InputError, WriteError
from drake_diff.runs.fields import SCHEMA_VERSION, FileEvidence, SealedRecord, canonical, own_sha256, read_fields
from drake_diff.runs.other_records import ComparisonRecord, FitRecord, is_trial_file
from drake_diff.runs.plan_record import PlanRecord

# Version 2: the kind of record in each file, the present kind, and the present section of the fields of each kind.
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
DROPPED = ("evaluations", "elsewhere")  # a second measurement, and what the replays contain now
ARGUMENTS = ("method", "initial_guess", "max_iterations", "time_limit", "seed", "restarts")  # of `solve`
RENAMED = {"panel": "conditions"}  # fields in the sections of a panel and of a trial
READ_VERSIONS = ("2", "3", SCHEMA_VERSION.split(".")[0])
FIXED_CONTACTS = {"HeldSpeeds": "FixedSpeeds", "HeldPlaces": "FixedPositions", "HeldForce": "FixedForce"}  # constraints


def upgraded(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the fields of a version 2 record to the names of version 3; `schema_version` is unchanged."""
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
    """Convert the problem of a phase with fixed contacts to the names of version 3."""
    constraints = [
        {**c, "quantity": c["quantity"] and {FIXED_CONTACTS.get(kind, kind): v for kind, v in c["quantity"].items()}}
        for c in problem["constraints"]
    ]
    others = {key: value for key, value in problem.items() if key != "held"}
    return {**others, "constraints": constraints, "fixed_contacts": problem["held"]}


KINDS: dict[str, type[SealedRecord]] = {kind.KIND: kind for kind in (PlanRecord, FitRecord, ComparisonRecord)}


def record_path(directory: str | Path) -> Path | None:
    """Return the path of the record in `directory`, or of a trial's record, or None if it does not exist.

    The path may not be a regular file. Reading it raises an error then.
    """
    if is_trial_file(Path(directory)):
        return Path(directory)
    return next((Path(directory) / name for name in FILES if os.path.lexists(Path(directory) / name)), None)


def load_record(directory: str | Path) -> SealedRecord:
    """Read the record in a directory that a solve, a fit, a comparison, trials or a certification wrote.

    The record is not verified; see `verify`. A record of version 2 or 3 of the schema is converted.

    Args:
        directory: The directory with record.json, or trials/ID.json of a panel.

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
    """Return the record in `directory`; raise ArtifactError if it is not the record of a solve."""
    record = load_record(directory)
    if not isinstance(record, PlanRecord) or record.subject != "plan":
        raise ArtifactError(f"{directory}: expected the record of a solve, got one of a {record.subject}")
    return record


def options_of_search(fields: dict[str, Any]) -> None:
    """Move the arguments of `solve` that have become options to `options`, in a record of an earlier version."""
    for section in (fields.get("inputs"), fields.get("phases")):
        search = section.get("search") if isinstance(section, dict) else None
        if isinstance(search, dict) and "options" not in search:
            options = {name: search.pop(name) for name in [*search] if name not in ARGUMENTS}
            search["options"] = options


def parse_record(path: Path, fields: Mapping[str, Any]) -> SealedRecord:
    """Parse the fields of a record read from `path`; unknown fields of a later minor version are removed."""
    version = fields.get("schema_version")
    if not isinstance(version, str) or version.split(".")[0] not in READ_VERSIONS:
        raise ArtifactError(f"{path}: schema_version {version!r}; this drake_diff reads {', '.join(READ_VERSIONS)}.x.y")
    known = json.loads(json.dumps(upgraded(fields) if version.startswith("2.") else fields))
    if version.startswith(("2.", "3.0.")):
        options_of_search(known)
    gradient = known.get("gradient")
    if isinstance(gradient, dict) and isinstance(gradient.get("stationarity"), dict):  # before version 4
        quantities = {"stationarity": "stationarity", "solver_tolerance": "solver_tolerance", "horizon": "horizon_s"}
        gradient |= {new: (gradient.pop(old, None) or {}).get("value") for old, new in quantities.items()}
        known["data"] = None  # earlier versions derived it from the other sections
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


def read_checked(path: Path) -> tuple[SealedRecord, tuple[str, ...]]:
    """Return the record in a file, and the problems of the record and of the other files in its directory.

    Raises TooManyFilesError if the record has no problem, and its directory has too many files to check them.
    """
    problems = []
    try:
        fields = read_fields(path)
        record = parse_record(path, fields)
        if canonical(fields).encode() != read_plain(path, MOST_TEXT):
            problems.append(f"{path.name}: its bytes differ from those that drake_diff writes for this content")
        if fields.get("schema_version") == SCHEMA_VERSION and fields != record.model_dump(mode="json"):
            problems.append(f"{path.name}: a field is missing or has another type than drake_diff writes")
        if own_sha256(fields) != fields.get("record_sha256"):
            problems.append(f"{path.name}: its content does not match its record_sha256: the file was changed")
    except RecursionError as error:
        raise ArtifactError(f"{path.name}: nested too deep") from error
    if record.subject != "trial":
        try:
            problems += _damage_of_files(path, record)
        except TooManyFilesError:
            if not problems:
                raise
    return record, tuple(problems)


def _damage_of_files(path_of_record: Path, record: SealedRecord) -> Iterator[str]:
    """Yield the missing, changed and additional files of a directory. Files outside the directory are never opened."""
    paths, read, lister = files_in(path_of_record.parent), 0, path_of_record.name
    paths.pop(lister, None)
    for name in sorted(record.files.keys() - paths.keys()):
        yield f"{name}: the file is listed in {lister} but missing"
    for name, path in sorted(paths.items()):
        described = record.files.get(name)
        if not path.is_file(follow_symlinks=False):
            yield f"{name}: a link, or not a regular file"
        elif described is None:
            yield f"{name}: the file is not listed in {lister}"
        else:
            size, result = path.stat(follow_symlinks=False).st_size, ""
            if size == described.bytes:  # a file of another size is not read
                read += size
                if read > MOST_READ:
                    yield f"{name}: the files up to this one have more than {MOST_READ} bytes"
                    return
                size, result = sha256_of(Path(path.path))
            if described != FileEvidence(path=name, bytes=size, sha256=result):
                yield f"{name}: the content ({size} bytes) differs from the one listed in {lister}"


PARTIAL = re.compile(r"(?P<name>.+)\.(partial|replaced)-\d+-[0-9a-f]{8}")
EXPECTED = "a new or empty directory, or one with only the files of a run"


@contextmanager
def written_whole(directory: str | Path) -> Iterator[Path]:
    """Yield a new folder to write to, which replaces `directory` if the block succeeds.

    If the block fails, the folder remains next to `directory`, and a WriteError, or a note of another error, contains
    its path. An earlier run in `directory` is replaced. The record's name is `name_of` the folder.

    Raises:
        InputError: `directory` cannot be replaced: it is not a directory, or contains files that no run wrote.
        ArtifactError: Another run is being written to `directory`.
        WriteError: `directory` cannot be written, for example because the disk is full.
    """
    target = Path(directory).resolve()
    check_place(target)
    with writing(target):
        partial = partial_of(target)
        make_folder(partial)
        try:
            yield partial
            old = _put(partial, target)
        except BaseException as error:
            with suppress(OSError):
                partial.rmdir()  # succeeds only if nothing was written
            if partial.is_dir() and isinstance(error, WriteError):
                raise _with_files_in(f"{error}; the files written so far are in {partial}", partial) from error
            if partial.is_dir():
                error.add_note(f"the files written so far are in {partial}")
            raise
        _clear(old, target)


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Lock the directory `target` for writing during the block; raise ArtifactError if it is locked already.

    The parent folders are created. If the block raises, those that are still empty are removed.
    """
    new = [folder for folder in target.parents if not folder.exists()]
    make_folder(target.parent)
    try:
        with locked(target.with_name(f".{target.name}.lock")) as held:
            if not held:
                raise ArtifactError(f"{target}: another run is being written there; choose another directory, or wait")
            yield
    except BaseException:
        with suppress(OSError):  # a folder is not empty
            for folder in new:
                folder.rmdir()
        raise


def check_place(target: Path) -> None:
    """Raise InputError if a run cannot take the absolute path `target`: no directory, or one with other files."""
    if target.is_dir():
        if os.path.ismount(target) or Path.cwd().is_relative_to(target):
            got = f"{target}, a mount point or the working directory"
            raise InputError("directory", got=got, expected="a directory that can be replaced, such as one below it")
        other = next(_others(target), None)
        if other is not None:
            raise InputError("directory", got=f"{target}, which contains {other.name!r}", expected=EXPECTED)
    elif os.path.lexists(target):
        raise InputError("directory", got=f"{target}, which is not a directory", expected=EXPECTED)


def move_into_place(partial: Path, target: Path) -> None:
    """Move the written folder `partial` to `target`, then remove the run that it replaces."""
    _clear(_put(partial, target), target)


def _put(partial: Path, target: Path) -> Path | None:
    """Move `partial` to `target`; return the new path of the run that it replaces, or None if there was no run."""
    for folder, _, _ in os.walk(partial):
        sync_folder(Path(folder))
    check_place(target)  # checked again, since a run may take hours
    if target.is_dir():
        take_mode(partial, target)
        if is_taken(target):
            return _exchanged(partial, target)
    move(partial, target)
    return None


def _exchanged(partial: Path, target: Path) -> Path:
    if exchange(partial, target):
        return partial
    replaced = _replaced(partial)
    move(target, replaced)
    try:
        move(partial, target)
    except WriteError:
        move(replaced, target)
        raise
    return replaced


def _replaced(partial: Path) -> Path:
    """Return a new name for the run that `partial` replaces."""
    return partial.with_name(partial.name.replace(".partial-", ".replaced-"))


def _clear(old: Path | None, target: Path) -> None:
    """Flush the folder of `target` to the disk, and remove the `old` run."""
    try:
        sync_folder(target.parent)
        if old is not None:
            replaced = _replaced(old)
            move(old, replaced)
            old = replaced
            remove_folder(replaced)
    except WriteError as error:
        left = "" if old is None else f", and the replaced run is in {old}"
        raise _with_files_in(f"{error}; the run is in {target}{left}", target) from error


def _with_files_in(message: str, folder: Path) -> WriteError:
    error = WriteError(message)
    error.kept = folder
    return error


def is_taken(directory: Path) -> bool:
    """Return whether `directory` contains anything."""
    return directory.is_dir() and any(directory.iterdir())


def partial_of(target: Path) -> Path:
    """Return a new name next to `target` for a temporary folder."""
    return target.with_name(f"{target.name}.partial-{os.getpid()}-{secrets.token_hex(4)}")


def name_of(folder: Path) -> str:
    """Return the name of the run in `folder`, which is that of its final directory."""
    name = folder.resolve().name
    result = PARTIAL.fullmatch(name)
    return name if result is None else result["name"]


def is_partial(folder: Path) -> bool:
    """Return whether `folder` has the name of a run that was not moved to its place, or that was replaced."""
    return PARTIAL.fullmatch(folder.resolve().name) is not None


def _others(folder: Path) -> Iterator[Path]:
    """Yield the paths in `folder` that its run did not write; all of them if it has no record of a run."""
    local = set(_written(folder))
    folders = {parent for path in local for parent in path.parents}
    for top, inner, files in os.walk(folder):
        yield from (Path(top, name) for name in files if Path(top, name) not in local)
        yield from (Path(top, name) for name in inner if Path(top, name) not in folders)


def _written(folder: Path) -> Iterator[Path]:
    """Yield the records in `folder` and the files that they list."""
    for name in FILES:
        if (folder / name).is_symlink() or not (folder / name).is_file():
            continue
        with suppress(ArtifactError, ValueError):  # a file that is not a record lists no files
            fields: dict[str, Any] = read_fields(folder / name)
            if own_sha256(fields) == fields.get("record_sha256"):
                yield folder / name
                yield from (folder / str(listed) for listed in fields.get("files", {}))

"""A directory written whole: beside its place under a name of its own, and moved there at the end.

    run                          a run that ended
    run.partial-4711-0f3a9c21    one that is under way, or that was killed or failed: process 4711, and a random part
    .run.lock                    locked for as long as somebody writes `run`

What was at `run` is there, whole, until the moment in which the new one is; where the file system can exchange two
names, no moment is without either. Else the old one is called run.replaced-... for that moment.
"""

import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from drake_diff._base.files import exchange, locked, make_folder, move, remove_folder, sync_folder, take_mode
from drake_diff.exceptions import ArtifactError, InputError, WriteError
from drake_diff.runs.read import FILES
from drake_diff.runs.sealed import own_sha256, read_fields

PARTIAL = re.compile(r"(?P<name>.+)\.(partial|replaced)-\d+-[0-9a-f]{8}")
EXPECTED = "a new or empty directory, or one that a run wrote and nobody added to"


@contextmanager
def written_whole(directory: str | Path) -> Iterator[Path]:
    """A new folder to write to, which takes the place of `directory` when the block has ended well.

    Else it stays beside `directory`, and a WriteError, or a note of another error, says where. What is in `directory`
    is replaced where a run wrote it; the record of a run is named by `name_of` the folder.

    Raises:
        InputError: `directory` cannot be replaced: it is no directory, or holds what no run wrote.
        ArtifactError: Somebody else is writing `directory`.
        WriteError: The disk is full, or does not let it be written.
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
                partial.rmdir()  # where nothing was written
            if partial.is_dir() and isinstance(error, WriteError):
                raise _kept(f"{error}; what was written is in {partial}", partial) from error
            if partial.is_dir():
                error.add_note(f"what was written is in {partial}")
            raise
        _clear(old, target)


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """While nobody else writes the directory `target`; ArtifactError where somebody does.

    The folders that it is to be in are made; where the block raises, those that are still empty are not left.
    """
    new = [folder for folder in target.parents if not folder.exists()]
    make_folder(target.parent)
    try:
        with locked(target.with_name(f".{target.name}.lock")) as held:
            if not held:
                raise ArtifactError(f"{target}: another run is being written there; choose another directory, or wait")
            yield
    except BaseException:
        with suppress(OSError):  # one has something in it
            for folder in new:
                folder.rmdir()
        raise


def check_place(target: Path) -> None:
    """InputError where `target`, a whole path, is not for a run to take: it is no directory, or has others' files."""
    if target.is_dir():
        if os.path.ismount(target) or Path.cwd().is_relative_to(target):
            got = f"{target}, which is mounted there, or is where this process works"
            raise InputError("directory", got=got, expected="one that another can take the place of: one below it")
        other = next(_others(target), None)
        if other is not None:
            raise InputError("directory", got=f"{target}, which holds {other.name!r}", expected=EXPECTED)
    elif os.path.lexists(target):
        raise InputError("directory", got=f"{target}, which is no directory", expected=EXPECTED)


def move_into_place(partial: Path, target: Path) -> None:
    """Move the written folder `partial` to `target`; the run that was there is removed after that."""
    _clear(_put(partial, target), target)


def _put(partial: Path, target: Path) -> Path | None:
    """Move `partial` to `target`; where the run is now that was there, None where none was."""
    for folder, _, _ in os.walk(partial):
        sync_folder(Path(folder))
    check_place(target)  # a run may take hours
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
    """Another name for what lost its place to the run that `partial` was."""
    return partial.with_name(partial.name.replace(".partial-", ".replaced-"))


def _clear(old: Path | None, target: Path) -> None:
    """Put onto the disk that `target` is in its place, and remove the `old` run."""
    try:
        sync_folder(target.parent)
        if old is not None:
            replaced = _replaced(old)
            move(old, replaced)
            old = replaced
            remove_folder(replaced)
    except WriteError as error:
        left = "" if old is None else f", and the one before in {old}"
        raise _kept(f"{error}; the run is in {target}{left}", target) from error


def _kept(message: str, folder: Path) -> WriteError:
    error = WriteError(message)
    error.kept = folder
    return error


def is_taken(directory: Path) -> bool:
    """Whether there is anything in `directory`."""
    return directory.is_dir() and any(directory.iterdir())


def partial_of(target: Path) -> Path:
    """A new name beside `target`, for what is written there first."""
    return target.with_name(f"{target.name}.partial-{os.getpid()}-{secrets.token_hex(4)}")


def name_of(folder: Path) -> str:
    """The name of the run in `folder`: that of the directory whose place it takes."""
    name = folder.resolve().name
    result = PARTIAL.fullmatch(name)
    return name if result is None else result["name"]


def is_partial(folder: Path) -> bool:
    """Whether `folder` has the name of a run that did not take its place, or that lost it."""
    return PARTIAL.fullmatch(folder.resolve().name) is not None


def _others(folder: Path) -> Iterator[Path]:
    """What is in `folder` that the run there did not write; of one without the record of a run, everything."""
    local = set(_written(folder))
    folders = {parent for path in local for parent in path.parents}
    for top, inner, files in os.walk(folder):
        yield from (Path(top, name) for name in files if Path(top, name) not in local)
        yield from (Path(top, name) for name in inner if Path(top, name) not in folders)


def _written(folder: Path) -> Iterator[Path]:
    """The files that the records in `folder` list, and these records."""
    for name in FILES:
        if (folder / name).is_symlink() or not (folder / name).is_file():
            continue
        with suppress(ArtifactError, ValueError):  # what is no record of ours lists nothing
            fields: dict[str, Any] = read_fields(folder / name)
            if own_sha256(fields) == fields.get("record_sha256"):
                yield folder / name
                yield from (folder / str(listed) for listed in fields.get("files", {}))

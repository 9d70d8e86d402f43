"""All that is written to a disk: files and folders, whole or not at all, moved into place, and locks.

What is written is on the disk before it is moved: a power cut leaves the old or the new, as the death of the process.
Where the disk refuses, a WriteError says what could not be done to which file. `record.directory` writes whole folders.
"""

import ctypes
import errno
import fcntl
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from io import BufferedIOBase, FileIO
from pathlib import Path
from typing import Any

from drake_diff.exceptions import WriteError

AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of Linux' renameat2, which Python's os has not
CANNOT_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.EXDEV, errno.EOPNOTSUPP)


@contextmanager
def doing(what: str, path: Path) -> Iterator[None]:
    """A WriteError, "cannot {what} {path}", where the disk refuses."""
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        raise WriteError(f"cannot {what} {path}: {error.strerror or error}") from error


class _WrittenThrough(BufferedIOBase):
    """Hands every write to the operating system at once: what was written survives the death of the process."""

    def __init__(self, path: Path):
        self.path, self.file = path, FileIO(path, "wb")

    def write(self, data: Any) -> int:
        """Write all of `data`; the system may take less at a time."""
        whole = memoryview(data).cast("B")
        left = whole
        with doing("write", self.path):
            while left:
                left = left[self.file.write(left) :]
        return len(whole)

    def tell(self) -> int:
        """How many bytes were written."""
        return self.file.tell()

    def fileno(self) -> int:
        """The number that the system knows it by."""
        return self.file.fileno()

    def close(self) -> None:
        """Nothing is left to write."""
        self.file.close()
        super().close()


@contextmanager
def whole_file(path: Path) -> Iterator[BufferedIOBase]:
    """A file to write to, beside `path` as `path`.partial, moved into place when all went well and removed when not.

    A process that is killed leaves the partial file, with all that was written.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        with doing("write", partial):
            file = _WrittenThrough(partial)
        with file:
            yield file
            with doing("write", partial):
                os.fsync(file.fileno())
        move(partial, path)
    except BaseException:
        with suppress(OSError):  # what cannot be removed is named as partial
            partial.unlink(missing_ok=True)
        raise


def write_whole(path: Path, data: bytes) -> None:
    """Write `data` aside, onto the disk, and move it into place: `path` is never half written."""
    with whole_file(path) as file:
        file.write(data)


def make_folder(path: Path) -> None:
    """Make the folder `path`, and those that it is to be in."""
    with doing("make", path):
        for folder in (path, *path.parents):
            if folder.is_dir():
                break
        missing = [p for p in (*reversed(path.parents), path) if p != folder and p.is_relative_to(folder)]
        for folder_to_make in missing:
            folder_to_make.mkdir(exist_ok=True)
            sync_folder(folder_to_make.parent)


def sync_folder(path: Path) -> None:
    """Put the names in the folder `path` onto the disk."""
    with doing("write", path):
        number = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def move(source: Path, target: Path) -> None:
    """Give the file or folder `source` the name `target`: in place of the file, or the empty folder, that has it."""
    with doing("write", target):
        os.replace(source, target)


def exchange(one: Path, other: Path) -> bool:
    """Give each of two folders the other's name at once; False, and nothing is done, where the file system cannot."""
    function = _renameat2()
    with doing("write", other):
        if function is None:
            return False
        if function(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE) == 0:
            return True
        number = ctypes.get_errno()
        if number in CANNOT_EXCHANGE:
            return False
        raise OSError(number, os.strerror(number))


@cache
def _renameat2() -> Any:
    """The function of the C library, None where it has none (macOS, musl before 1.2.6)."""
    function = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if function is not None:
        function.argtypes = (ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint)
    return function


def take_mode(folder: Path, of: Path) -> None:
    """Give `folder` the permissions of another."""
    with doing("write", folder):
        folder.chmod(stat.S_IMODE(of.stat().st_mode))


def remove_folder(path: Path) -> None:
    """Remove the folder `path` with all that is in it."""
    with doing("remove", path):
        shutil.rmtree(path)


@contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Whether the lock file `path` could be had, which nobody else has then until the block ends, or the process.

    However the process ends, nothing stays locked: a file that a killed one leaves is taken over by the next.
    """
    number = _open_locked(path)
    if number is None:
        yield False
        return
    try:
        yield True
    finally:
        with suppress(OSError):  # nobody waits for a lock, and a file that stays is no lock
            os.unlink(path)
        os.close(number)


def _open_locked(path: Path) -> int | None:
    while True:
        with doing("write", path):
            number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            try:
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.path.samestat(os.fstat(number), os.stat(path)):
                    return number
            except BlockingIOError:
                os.close(number)
                return None
            except FileNotFoundError:
                pass  # who had it removed it between our open and our lock: once more, with a new one
            except BaseException:
                os.close(number)
                raise
            os.close(number)

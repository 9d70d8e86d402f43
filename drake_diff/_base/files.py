"""Disk access: atomic writes of files and folders, locks, and reading with limits.

Data is synchronized to the disk before it is moved into place. A power cut or the death of the process therefore leaves
either the old or the new file. A failed write raises WriteError. `record.directory` writes whole folders.

Untrusted files are read with limits: only regular files, no links, and at most a given number of bytes. The sizes that
a file declares (an archive's index, an array's header) are checked before anything is unpacked.
"""

import ctypes
import errno
import fcntl
import io
import json
import math
import os
import re
import shutil
import stat
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from io import BufferedIOBase, FileIO
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff.exceptions import ArtifactError, WriteError

AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of Linux' renameat2, which is not in Python's os
CANNOT_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.EXDEV, errno.EOPNOTSUPP)


@contextmanager
def doing(what: str, path: Path) -> Iterator[None]:
    """Turn an OSError in the block into a WriteError, "cannot {what} {path}"."""
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        raise WriteError(f"cannot {what} {path}: {error.strerror or error}") from error


class _WrittenThrough(BufferedIOBase):
    """A file whose writes go to the operating system at once, so that they survive the death of the process."""

    def __init__(self, path: Path):
        self.path, self.file = path, FileIO(path, "wb")

    def write(self, data: Any) -> int:
        """Write all of `data`, in several calls if the system accepts less at a time."""
        whole = memoryview(data).cast("B")
        left = whole
        with doing("write", self.path):
            while left:
                left = left[self.file.write(left) :]
        return len(whole)

    def tell(self) -> int:
        """Return the number of written bytes."""
        return self.file.tell()

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self.file.fileno()

    def close(self) -> None:
        """Close the file; there is no buffer to flush."""
        self.file.close()
        super().close()


@contextmanager
def whole_file(path: Path) -> Iterator[BufferedIOBase]:
    """Yield a file `path`.partial to write to, which is moved to `path` on success and removed on failure.

    A process that is killed leaves the partial file with all that it wrote.
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
        with suppress(OSError):  # a file that cannot be removed has .partial in its name
            partial.unlink(missing_ok=True)
        raise


def write_whole(path: Path, data: bytes) -> None:
    """Write `data` to a temporary file and move it to `path`, so that `path` is never incomplete."""
    with whole_file(path) as file:
        file.write(data)


def make_folder(path: Path) -> None:
    """Make the folder `path` and its missing parents."""
    with doing("make", path):
        for folder in (path, *path.parents):
            if folder.is_dir():
                break
        missing = [p for p in (*reversed(path.parents), path) if p != folder and p.is_relative_to(folder)]
        for folder_to_make in missing:
            folder_to_make.mkdir(exist_ok=True)
            sync_folder(folder_to_make.parent)


def sync_folder(path: Path) -> None:
    """Synchronize the entries of the folder `path` to the disk."""
    with doing("write", path):
        number = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def move(source: Path, target: Path) -> None:
    """Rename the file or folder `source` to `target`, replacing a file or an empty folder of that name."""
    with doing("write", target):
        os.replace(source, target)


def exchange(first: Path, other: Path) -> bool:
    """Swap the names of two folders atomically, or return False if the file system does not support it."""
    function = _renameat2()
    with doing("write", other):
        if function is None:
            return False
        if function(AT_FDCWD, os.fsencode(first), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE) == 0:
            return True
        number = ctypes.get_errno()
        if number in CANNOT_EXCHANGE:
            return False
        raise OSError(number, os.strerror(number))


@cache
def _renameat2() -> Any:
    """Return the function of the C library, or None if it is missing (macOS, musl before 1.2.6)."""
    function = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if function is not None:
        function.argtypes = (ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint)
    return function


def take_mode(folder: Path, other: Path) -> None:
    """Give `folder` the permissions of the folder `other`."""
    with doing("write", folder):
        folder.chmod(stat.S_IMODE(other.stat().st_mode))


def remove_folder(path: Path) -> None:
    """Remove the folder `path` with its contents."""
    with doing("remove", path):
        shutil.rmtree(path)


@contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Yield whether this process got the lock on the file `path`, which it holds until the block or the process ends.

    The end of a process always releases its lock. The next process takes over the file that a killed process left.
    """
    number = _open_locked(path)
    if number is None:
        yield False
        return
    try:
        yield True
    finally:
        with suppress(OSError):  # no process waits for a lock, and a remaining file does not lock
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
                pass  # the previous owner removed the file between our open and our lock, so try again
            except BaseException:
                os.close(number)
                raise
            os.close(number)


MIB, GIB = 2**20, 2**30
MOST_TEXT = 32 * MIB  # of a JSON record
MOST_VALUES = 1_000_000  # in a record; as Python objects they take about 100 times the memory of their text
DEEPEST = 64  # nesting depth of a record; the package's own records have 10
MOST_ARRAYS = 256 * MIB  # of an unpacked .npz file: a million steps of 30 numbers
MOST_MEMBERS = 100  # of an .npz file
MOST_FILE = GIB  # of any file
MOST_FILES = 10_000  # in a directory and its subdirectories
MOST_READ = 4 * GIB  # of all these files together; a sparse file occupies no disk space but takes as long to read
SURROGATE = re.compile("[\ud800-\udfff]")


class TooManyFilesError(ArtifactError):
    """A directory has more files than are checked, which does not say that one of them is damaged."""


@contextmanager
def plain_file(path: Path, most: int = MOST_FILE, *, links: bool = False) -> Iterator[io.BufferedReader]:
    """Open the file at `path`; raise ArtifactError if it is not a regular file, over `most` bytes, or unreadable.

    Links are followed only with `links`, for a path that the user gave and not a record. FIFOs and devices never block
    the call.
    """
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
    try:
        kind = (path.stat() if links else path.lstat()).st_mode
        if not stat.S_ISREG(kind):
            raise ArtifactError(f"{path}: expected a plain file, got {_kind(kind)}")
        number = os.open(path, flags | (0 if links else getattr(os, "O_NOFOLLOW", 0)))
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise ArtifactError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    with os.fdopen(number, "rb") as file:
        state = os.fstat(number)
        if not stat.S_ISREG(state.st_mode):  # replaced after the first check
            raise ArtifactError(f"{path}: expected a plain file, got {_kind(state.st_mode)}")
        if state.st_size > most:
            raise ArtifactError(f"{path}: expected at most {most} bytes, got {state.st_size}")
        yield file


def _kind(mode: int) -> str:
    kinds = {stat.S_IFLNK: "a link", stat.S_IFDIR: "a directory", stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def read_plain(path: Path, most: int = MOST_FILE, *, links: bool = False) -> bytes:
    """Return the bytes of a regular file; see `plain_file`."""
    with plain_file(path, most, links=links) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1)  # Python allocates the requested size
    if len(data) != size:
        raise ArtifactError(f"{path}: the file changed while it was read")
    return data


def sha256_of(path: Path, most: int = MOST_FILE) -> tuple[int, str]:
    """Return the size in bytes and the hash of a regular file, which is read in pieces to limit memory."""
    digest, count = sha256(), 0
    with plain_file(path, most) as file:
        while piece := file.read(MIB):
            digest.update(piece)
            count += len(piece)
            if count > most:
                raise ArtifactError(f"{path}: expected at most {most} bytes, got more")
    return count, digest.hexdigest()


def files_in(folder: Path) -> dict[str, os.DirEntry[str]]:
    """Return all entries below a folder that are not folders, by their paths in it, without following links.

    Raises TooManyFilesError if there are more than `MOST_FILES`, and ArtifactError if a folder cannot be read.
    """
    entries_by_path: dict[str, os.DirEntry[str]] = {}
    waiting, seen = [(folder, "")], 0
    while waiting:
        location, before = waiting.pop()
        try:
            with os.scandir(location) as entries:
                for entry in entries:
                    seen += 1
                    if seen > MOST_FILES:
                        raise TooManyFilesError(f"{folder}: expected at most {MOST_FILES} files, got more")
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append((Path(entry.path), f"{before}{entry.name}/"))
                    else:
                        entries_by_path[before + entry.name] = entry
        except OSError as error:
            raise ArtifactError(f"{location}: cannot be read: {error.strerror}") from error
    return entries_by_path


def json_of(data: bytes) -> Any:
    """Parse JSON text in UTF-8; raise ValueError if it is invalid, too large, too deep, or has non-finite numbers."""
    values = sum(data.count(mark) for mark in (b",", b"[", b"{"))
    if values > MOST_VALUES:
        raise ValueError(f"expected at most {MOST_VALUES} values, got more")
    try:
        document = json.loads(data.decode("utf-8"), parse_constant=_refuse, parse_float=_finite)
    except RecursionError as error:
        raise ValueError(f"expected at most {DEEPEST} levels of nested lists and objects") from error
    level = [document]
    for _ in range(DEEPEST):
        inner: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                inner += value.keys()
                inner += value.values()
            elif isinstance(value, list):
                inner += value
            elif isinstance(value, str) and SURROGATE.search(value):
                raise ValueError("a string is not valid Unicode: it contains an unpaired surrogate")
        if not inner:
            return document
        level = inner
    raise ValueError(f"expected at most {DEEPEST} levels of nested lists and objects")


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not a number in JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is beyond the range of 64-bit numbers")
    return value


def arrays_of(path: Path, most: int = MOST_ARRAYS, only: Collection[str] | None = None) -> dict[str, Array]:
    """Return the float64 arrays of an .npz file, read-only, by name; raise ArtifactError if it is invalid or too large.

    Headers are read first, and only the declared sizes are unpacked. Arrays not in `only` are not read.
    """
    data = read_plain(path, most)
    try:
        if data.count(b"PK\x01\x02") > MOST_MEMBERS:  # zipfile takes 1 GB of memory for a million members
            raise ValueError(f"expected at most {MOST_MEMBERS} arrays, got more")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len({m.filename for m in members}) < len(members):
                raise ValueError(f"expected distinct names of arrays, got duplicates in {len(members)}")
            whole = sum(member.file_size for member in members)
            if whole > most:
                raise ValueError(f"expected at most {most} bytes after decompression, got {whole}")
            named = {m.filename.removesuffix(".npy"): m for m in members}
            return {name: _array(archive, m) for name, m in named.items() if only is None or name in only}
    except ArtifactError:
        raise
    except Exception as error:  # zipfile and NumPy raise many errors for invalid files
        raise ArtifactError(f"{path} is not a NumPy .npz file: {type(error).__name__}: {error}") from error


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Array:
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # the others unpack without a limit
        raise ValueError(f"{member.filename}: expected a stored or deflated array, got another compression method")
    with archive.open(member) as packed:
        data = packed.read(member.file_size + 1)  # read() alone would unpack more than the index declares
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"{member.filename}: expected a header of version 1.0 or 2.0, got {version}")
    shape, by_columns, dtype = read(file)
    if dtype != np.dtype("<f8"):
        raise ValueError(f"{member.filename}: expected 64-bit floating-point numbers, got {dtype}")
    count = len(data) - file.tell()
    if any(n < 0 for n in shape) or 8 * math.prod(shape) != count:
        raise ValueError(f"{member.filename}: {count} bytes do not match an array of shape {shape}")
    numbers = np.frombuffer(data, dtype="<f8", offset=file.tell())
    return frozen(numbers.reshape(shape, order="F" if by_columns else "C"))

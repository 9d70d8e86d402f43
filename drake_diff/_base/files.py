"""Write a file whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path
from typing import Any


class _WrittenThrough(BufferedWriter):
    """Hands every write to the operating system at once: what was written survives the death of the process."""

    def write(self, data: Any) -> int:
        count = super().write(data)
        self.flush()
        return count


@contextmanager
def whole_file(path: Path) -> Iterator[BufferedWriter]:
    """A file to write to, beside `path` as `path`.partial, moved into place when all went well and removed when not.

    A process that is killed leaves the partial file, with all that was written.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        with _WrittenThrough(partial.open("wb", buffering=0)) as file:
            yield file
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: Path, data: bytes) -> None:
    """Write `data` aside, onto the disk, and move it into place: `path` is never half written."""
    with whole_file(path) as file:
        file.write(data)

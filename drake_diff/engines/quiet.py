"""Greetings that libraries print from C, left out; all else that they print is passed on."""

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_lines(*greetings: str) -> Iterator[None]:
    """Lines on stdout and stderr that begin with one of `greetings` are left out, the others come when it ends."""
    with _filtered(1, greetings), _filtered(2, greetings):
        yield


@contextmanager
def _filtered(stream: int, greetings: tuple[str, ...]) -> Iterator[None]:
    """Of one file descriptor."""
    _flush()
    kept = os.dup(stream)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), stream)
        try:
            yield
        finally:
            _flush()
            os.dup2(kept, stream)
            os.close(kept)
            file.seek(0)
            for line in file.read().splitlines(keepends=True):
                if not line.startswith(tuple(g.encode() for g in greetings)):
                    os.write(stream, line)


def _flush() -> None:
    sys.stdout.flush()
    sys.stderr.flush()

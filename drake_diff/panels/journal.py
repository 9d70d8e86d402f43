"""The journal of a panel: a line for each finished trial, on the disk before its worker gets the next.

The first line says what the panel is. Each line carries a hash of itself and of the first line, so that a changed line
and a line of another panel are noticed.
"""

import fcntl
import json
import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO

from drake_diff.exceptions import ArtifactError
from drake_diff.panels.trial_row import Row

JOURNAL = "trials.jsonl"


class Journal:
    """An open journal; `rows` are those of the finished trials, by id."""

    def __init__(self, path: Path, file: BinaryIO, panel: Mapping[str, Any], known: Collection[str]):
        self.path, self.file = path, file
        self.head = _line({"panel": panel}, b"")
        self.rows = self._read(panel, known)

    def add(self, trial: str, row: Row) -> None:
        """Write the row of a finished trial to the disk."""
        self._write(_line({"id": trial, "row": row}, self.head))
        self.rows[trial] = row

    def _write(self, line: bytes) -> None:
        self.file.write(line)
        self.file.flush()
        os.fsync(self.file.fileno())

    def _read(self, panel: Mapping[str, Any], known: Collection[str]) -> dict[str, Row]:
        """Read all whole lines and cut off the rest: a line that a killed process left half written."""
        whole = self.file.read().rpartition(b"\n")
        lines = whole[0].split(b"\n") if whole[1] else []
        self.file.seek(len(whole[0]) + len(whole[1]))
        self.file.truncate()
        if not lines:
            self._write(self.head)
            return {}
        self._check_panel(_read_line(self.path, 1, lines[0], b""), panel)
        rows: dict[str, Row] = {}
        for number, line in enumerate(lines[1:], 2):
            found = _read_line(self.path, number, line, self.head)
            if found["id"] not in known or found["id"] in rows:
                raise ArtifactError(f"{self.path}, line {number}: trial {found['id']} is unknown or stands there twice")
            rows[found["id"]] = found["row"]
        return rows

    def _check_panel(self, found: Mapping[str, Any], panel: Mapping[str, Any]) -> None:
        old = found.get("panel", {})
        for key in sorted({*old, *panel}):
            if old.get(key) != panel.get(key):
                raise ArtifactError(
                    f"{self.path} is the journal of another panel: {key}: expected {panel.get(key)}, "
                    f"got {old.get(key)}; choose another directory, or remove this one to start over"
                )


@contextmanager
def journal(directory: Path, panel: Mapping[str, Any], known: Collection[str]) -> Iterator[Journal]:
    """Open the journal in `directory` of the panel that `panel` describes, with the trials `known`.

    ArtifactError where it is another panel's, where a whole line is damaged, or where another process has it open.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / JOURNAL
    with open(path, "a+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ArtifactError(f"{path}: another process is at work on this panel") from error
        file.seek(0)
        yield Journal(path, file, panel, known)


def _line(content: Mapping[str, Any], head: bytes) -> bytes:
    return _json({**content, "sha256": sha256(head + _json(content)).hexdigest()}) + b"\n"


def _json(content: Mapping[str, Any]) -> bytes:
    """Keys keep their order: a row's is that of the table's columns."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


def _read_line(path: Path, number: int, line: bytes, head: bytes) -> dict[str, Any]:
    """What `line` says; ArtifactError where it is not as it was written."""
    try:
        content: dict[str, Any] = json.loads(line)
        content.pop("sha256")
        if _line(content, head) == line + b"\n":
            return content
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ArtifactError(f"{path}, line {number} is damaged: {type(error).__name__}: {error}") from error
    raise ArtifactError(f"{path}, line {number} is damaged or another panel's: its hash does not fit")

"""What a panel writes: a journal with a line for each finished trial, and at the end a table and a summary by cell.

The first line of the journal says what the panel is. Each line carries a hash of itself and of the first line, so that
a changed line and a line of another panel are noticed.
"""

import csv
import fcntl
import io
import json
import os
import statistics
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO

from drake_diff._base.files import doing, make_folder, write_whole
from drake_diff._base.statistics import success_rate
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import ArtifactError, InputError
from drake_diff.pages.html import page_data, write_page
from drake_diff.panels.panel_file import PanelTrial, Row, canonical, cell_name
from drake_diff.runs.directory import is_taken
from drake_diff.runs.fields import ModelInput
from drake_diff.runs.other_records import TRIALS, ComparisonRecord, PanelSection, trial_record
from drake_diff.runs.provenance import provenance_of, written_now
from drake_diff.runs.sealed import WallClock

JOURNAL, TABLE, SUMMARY, PAGE = "trials.jsonl", "table.csv", "summary.json", "panel.html"
RANKED = ("place", "name", "apart", "trials", "errors", "success", "numbers")  # of a cell in the record of a panel
SHOWN_CELLS = 8  # in a repr
COST = "cost"  # the number that ranks where nothing is judged, and among equals: less is better


class Journal:
    """The rows of the finished trials, by id, each a line on the disk before the next trial is counted."""

    def __init__(self, path: Path, file: BinaryIO, panel: Mapping[str, Any]):
        self.path, self.file, self.rows = path, file, dict[str, Row]()
        self.head = _line({"panel": panel}, b"")
        data = file.read()
        whole = data[: data.rfind(b"\n") + 1]  # a killed process leaves a line half written: it is cut off
        file.seek(len(whole))
        file.truncate()
        if not whole:
            self._write(self.head)
            return
        old, self.rows = read_journal(path, whole)
        for key in sorted({*old, *panel}):
            if old.get(key) != panel.get(key):
                raise ArtifactError(
                    f"{path} is the journal of another panel: {key}: expected {panel.get(key)}, got {old.get(key)}; "
                    "choose another directory, or remove this one to start over"
                )

    def add(self, trial: str, row: Row) -> None:
        """Write the row of a finished trial to the disk."""
        self._write(_line({"id": trial, "row": row}, self.head))
        self.rows[trial] = row

    def _write(self, line: bytes) -> None:
        with doing("write", self.path):
            self.file.write(line)
            self.file.flush()
            os.fsync(self.file.fileno())


@contextmanager
def journal(directory: Path, panel: Mapping[str, Any]) -> Iterator[Journal]:
    """Open the journal in `directory` of the panel that `panel` describes.

    ArtifactError where it is another panel's, where a whole line is damaged, or where another process has it open;
    InputError where the directory holds other things, and no journal.
    """
    path = directory / JOURNAL
    if not path.exists() and is_taken(directory):
        expected = "a new or empty directory, or one in which a panel was begun"
        raise InputError("out", got=f"{directory}, which holds {next(directory.iterdir()).name!r}", expected=expected)
    make_folder(directory)
    with open(path, "a+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ArtifactError(f"{path}: another process is at work on this panel") from error
        file.seek(0)
        yield Journal(path, file, panel)


def read_journal(path: Path, data: bytes) -> tuple[dict[str, Any], dict[str, Row]]:
    """What the panel is, and the rows by trial, of the bytes of a journal of whole lines.

    ArtifactError where a line is damaged, half written, or of a trial that stands there twice.
    """
    *lines, rest = data.split(b"\n")
    if rest or not lines:
        raise ArtifactError(f"{path}: its last line is half written")
    panel, rows, head = _read_line(path, 1, lines[0], b"").get("panel"), {}, lines[0] + b"\n"
    for number, line in enumerate(lines[1:], 2):
        content = _read_line(path, number, line, head)
        if not isinstance(content.get("row"), dict) or content.get("id") in rows:
            raise ArtifactError(f"{path}, line {number}: expected a row, of each trial once")
        rows[str(content["id"])] = content["row"]
    if not isinstance(panel, dict):
        raise ArtifactError(f"{path}, line 1: expected what the panel is")
    return panel, rows


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


@dataclass(frozen=True, eq=False)
class PanelTable(ShowsItsRepr):
    """What `run_panel` found.

    `rows` has a row for each trial, in the panel's order: its cell, id, repeat and seed, then what its function
    returned. `summary` has the counts, means and success rates of each cell. They are what `table.csv` and
    `summary.json` in `directory` hold.
    """

    directory: Path
    rows: tuple[Row, ...]
    summary: dict[str, Any]

    @property
    def errors(self) -> int:
        """How many trials ended in an error."""
        return int(self.summary["errors"])

    def __repr__(self) -> str:
        cells = self.summary["cells"]
        lines = [f"{len(self.rows)} trials in {len(cells)} cells, {self.errors} errors, in {self.directory}"]
        for cell in cells[:SHOWN_CELLS]:
            figures = [f"success {cell['success']['rate']:.3g}"] if "success" in cell else []
            figures += [f"{name} {numbers['mean']:.4g}" for name, numbers in cell["numbers"].items()]
            lines.append(f"  {cell_name(cell['cell'])}: {', '.join(figures) or 'no numbers'}")
        if len(cells) > SHOWN_CELLS:
            lines.append(f"  and {len(cells) - SHOWN_CELLS} more cells")
        return "\n".join(lines)


def write_table(
    directory: Path, trials: Sequence[PanelTrial], results: Mapping[str, Row], made: Mapping[str, Any]
) -> PanelTable:
    """Write `table.csv`, `summary.json`, a record of each trial and the ranking of all `trials` into `directory`.

    `made` says what the panel is.
    """
    cells: dict[bytes, list[PanelTrial]] = {}
    for trial in trials:
        cells.setdefault(canonical(trial.cell), []).append(trial)
    judged = any(isinstance(row.get("success"), bool) for row in results.values())
    rows = tuple(
        {"id": t.id, **t.cell, "repeat": t.fields["repeat"], "seed": t.fields["seed"], **results[t.id]} for t in trials
    )
    summary = {
        "panel": dict(made),
        "trials": len(trials),
        "errors": sum("error" in row for row in results.values()),
        "cells": [_cell(group[0].cell, [results[t.id] for t in group], judged) for group in cells.values()],
    }
    write_whole(directory / TABLE, _csv(rows, {name for row in results.values() for name in row}))
    text = json.dumps(summary, indent=1, allow_nan=False, ensure_ascii=False)
    write_whole(directory / SUMMARY, text.encode() + b"\n")
    (directory / TRIALS).mkdir(exist_ok=True)
    for trial in trials:
        record = trial_record(trial.id, trial.name, trial.cell, trial.fields, results[trial.id], made)
        write_whole(directory / TRIALS / f"{trial.id}.json", record.to_json().encode())
    write_ranking(directory / PAGE, summary)
    return PanelTable(directory, rows, summary)


def begun_record(directory: Path, trials: int, made: Mapping[str, Any]) -> ComparisonRecord:
    """The record while trials are missing."""
    return ComparisonRecord(
        name=directory.name,
        verdict="incomplete",
        sentence="the panel has started and not finished: it is still running, or it was killed",
        panel=PanelSection(conditions=dict(made), trials=trials, errors=None),
        model=ModelInput(file=None, options=None),
        provenance=provenance_of(),
        wall_clock=WallClock(written_utc=written_now()),
    )


def ended_record(begun: ComparisonRecord, table: PanelTable, seconds: float) -> ComparisonRecord:
    """The record at the end; `seconds` is how long this call of the panel took."""
    by, rows = ranked(table.summary)
    ranking = [{key: row[key] for key in RANKED if key in row} for row in rows]
    results = {"errors": table.errors, "ranked_by": by, "ranking": ranking}
    if begun.panel is None:
        raise ArtifactError(f"{begun.name}: expected the record of a panel")
    return begun.model_copy(
        update={
            "verdict": "fail" if table.errors else "pass",
            "sentence": f"{rows[0]['name']} is the best of {len(rows)} cells, by {by}; {table.errors} errors",
            "panel": begun.panel.model_copy(update=results),
            "wall_clock": WallClock(written_utc=written_now(), duration_s=seconds),
        }
    )


def ranked(summary: Mapping[str, Any]) -> tuple[str, list[dict[str, Any]]]:
    """By what the cells of `summary` are ranked, and a row for each, the best first.

    Cells with a success rate are ranked by the lower end of its 95 % interval, equals by the mean cost; others by the
    mean cost. A trial that ended in an error is no success, and has no cost: of cells without rates those with fewer
    errors come first. `apart` says whether the interval of a cell lies below that of the best; None without rates.
    """
    cells = summary["cells"]
    judged = all("success" in cell for cell in cells)

    def key(cell: Mapping[str, Any]) -> tuple[float, ...]:
        cost = cell["numbers"].get(COST, {}).get("mean", float("inf"))
        rate = cell["success"]["low"] if judged else 0.0
        return (-rate, 0.0 if judged else cell["errors"], cost)

    ordered = sorted(cells, key=key)  # equals stay in the panel's order
    rows: list[dict[str, Any]] = []
    for i, cell in enumerate(ordered):
        rank = i + 1 if not rows or key(ordered[i - 1]) != key(cell) else rows[-1]["place"]
        apart = cell["success"]["high"] < ordered[0]["success"]["low"] if judged else None
        rows.append({"place": rank, "name": cell_name(cell["cell"]), "apart": apart, **cell})
    if judged:
        return "the lower end of the 95 % interval of the success rate, then the mean cost", rows
    if any(COST in cell["numbers"] for cell in cells):
        return "the fewest errors, then the mean cost; no trial says whether it is a success", rows
    return "the fewest errors; no trial says whether it is a success, or has a cost", rows


def write_ranking(path: Path, summary: Mapping[str, Any]) -> None:
    """Write the page of a panel's `summary`."""
    by, rows = ranked(summary)
    errors = summary["errors"]
    record = {
        "name": path.parent.name,
        "verdict": "fail" if errors else "pass",
        "sentence": f"{rows[0]['name']} is the best of {len(rows)} cells, by {by}",
        "provenance": provenance_of().model_dump(mode="json"),
        **summary,
    }
    write_page(path, "panel.html.j2", record=record, data=page_data(0.0, []), rows=rows)


def _csv(rows: Sequence[Row], answered: set[str]) -> bytes:
    """RFC 4180: the cells' columns before the function's, each in the order in which it first appears; error last."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    ours = [name for name in names if name not in answered and name not in ("repeat", "seed")]
    theirs = [name for name in names if name in answered and name != "error"]
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    columns = [*ours, "repeat", "seed", *theirs, "error"]
    writer.writerow(columns)
    writer.writerows([_text(row.get(name)) for name in columns] for row in rows)
    return text.getvalue().encode()


def _text(value: Any) -> str:
    """A value in a field: nothing for null, words as they are, everything else as in JSON."""
    return "" if value is None else value if isinstance(value, str) else canonical(value).decode()


def _cell(cell: dict[str, Any], rows: Sequence[Row], judged: bool) -> dict[str, Any]:
    """One cell: a trial that ended in an error is no success."""
    numbers: dict[str, list[float]] = {}
    for row in rows:
        for name, value in row.items():
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                numbers.setdefault(name, []).append(float(value))
    summary: dict[str, Any] = {"cell": cell, "trials": len(rows), "errors": sum("error" in row for row in rows)}
    if judged:
        successes = sum(row.get("success") is True for row in rows)
        rate = success_rate(successes, len(rows))
        summary["success"] = {"count": successes, "rate": rate.value, "low": rate.lower, "high": rate.upper}
    summary["numbers"] = {
        name: {
            "count": len(values),
            "mean": statistics.mean(values),  # its sums are exact and rounded once
            "std": statistics.stdev(values) if len(values) > 1 else None,
            "min": min(values),
            "max": max(values),
        }
        for name, values in numbers.items()
    }
    return summary

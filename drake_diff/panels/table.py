"""What a panel found: a row for each trial and a summary of each cell, the same bytes whichever worker did what."""

import csv
import io
import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drake_diff._base.files import write_whole
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff._base.statistics import success_rate
from drake_diff.panels.panel_file import PanelTrial, canonical, cell_name
from drake_diff.panels.trial_row import Row

TABLE, SUMMARY = "table.csv", "summary.json"
SHOWN_CELLS = 8  # in a repr


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
            told = [f"success {cell['success']['rate']:.3g}"] if "success" in cell else []
            told += [f"{name} {numbers['mean']:.4g}" for name, numbers in cell["numbers"].items()]
            lines.append(f"  {cell_name(cell['cell'])}: {', '.join(told) or 'no numbers'}")
        if len(cells) > SHOWN_CELLS:
            lines.append(f"  and {len(cells) - SHOWN_CELLS} more cells")
        return "\n".join(lines)


def write_table(
    directory: Path, trials: Sequence[PanelTrial], found: Mapping[str, Row], made: Mapping[str, Any]
) -> PanelTable:
    """Write `table.csv` and `summary.json` of all `trials` into `directory`; `made` says what the panel is."""
    rows = tuple(
        {"id": t.id, **t.cell, "repeat": t.fields["repeat"], "seed": t.fields["seed"], **found[t.id]} for t in trials
    )
    summary = {"panel": dict(made), **_summary(trials, found)}
    write_whole(directory / TABLE, _csv(rows, {name for row in found.values() for name in row}))
    text = json.dumps(summary, indent=1, allow_nan=False, ensure_ascii=False)
    write_whole(directory / SUMMARY, text.encode() + b"\n")
    return PanelTable(directory, rows, summary)


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


def _summary(trials: Sequence[PanelTrial], found: Mapping[str, Row]) -> dict[str, Any]:
    cells: dict[bytes, list[PanelTrial]] = {}
    for trial in trials:
        cells.setdefault(canonical(trial.cell), []).append(trial)
    judged = any(isinstance(row.get("success"), bool) for row in found.values())
    return {
        "trials": len(trials),
        "errors": sum("error" in row for row in found.values()),
        "cells": [_cell(group[0].cell, [found[t.id] for t in group], judged) for group in cells.values()],
    }


def _cell(cell: dict[str, Any], rows: Sequence[Row], judged: bool) -> dict[str, Any]:
    """One cell: a trial that ended in an error is no success."""
    names = dict.fromkeys(name for row in rows for name, value in row.items() if _is_number(value))
    summary: dict[str, Any] = {"cell": cell, "trials": len(rows), "errors": sum("error" in row for row in rows)}
    if judged:
        successes = sum(row.get("success") is True for row in rows)
        rate = success_rate(successes, len(rows))
        summary["success"] = {"count": successes, "rate": rate.value, "low": rate.lower, "high": rate.upper}
    numbers = {name: _numbers([row[name] for row in rows if _is_number(row.get(name))]) for name in names}
    return {**summary, "numbers": numbers}


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _numbers(values: Sequence[float]) -> dict[str, Any]:
    """The sample standard deviation of one value is null; sums are exact and rounded once."""
    floats = [float(value) for value in values]
    return {
        "count": len(floats),
        "mean": statistics.mean(floats),
        "std": statistics.stdev(floats) if len(floats) > 1 else None,
        "min": min(floats),
        "max": max(floats),
    }

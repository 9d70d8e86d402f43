"""The file of a panel, its trials, and its results.

The results are a record of each finished trial, from which a later run can resume, and at the end the table, summary
and ranking of all records. The file is TOML with these fields:

evaluate = "trials.py:balance"   # a file in the same directory, or "package.module:function"
seed = 0
seeds = 20                       # trials of each cell

[axes]                           # every combination of the values is a cell
method = ["ilqr", "shooting"]
level = [0.0, 0.1]

[fixed]                          # equal in all trials
model = "models/pendulum.urdf"

[[cells]]                        # an additional cell
method = "none"
"""

import csv
import io
import json
import statistics
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from hashlib import sha256
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from drake_diff._base.files import MOST_TEXT, make_folder, read_plain, write_whole
from drake_diff._base.statistics import success_rate
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import ArtifactError, InputError
from drake_diff.pages.html import page_data, write_page
from drake_diff.runs.differences import Reproduced
from drake_diff.runs.directory import is_taken, load_record, read_checked, writing
from drake_diff.runs.fields import FiniteTable, SealedRecord, read_fields
from drake_diff.runs.other_records import TRIALS, ComparisonRecord, PanelSection, TrialSection, trial_record
from drake_diff.runs.provenance import header

# Names of the fields that drake_diff adds to each trial, which axes, cells and fixed values cannot use.
OURS = ("id", "repeat", "seed")
Row = dict[str, Any]  # result of a trial, in JSON's types


class Panel(BaseModel):
    """The content of a panel file."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    evaluate: Annotated[str, Field(pattern=r"^[^:]+:[A-Za-z_]\w*$")]
    seed: Annotated[int, Field(ge=0)] = 0
    seeds: Annotated[int, Field(ge=1)] = 1
    axes: Annotated[FiniteTable, Field(default_factory=dict)]
    fixed: Annotated[FiniteTable, Field(default_factory=dict)]
    cells: Annotated[list[FiniteTable], Field(default_factory=list)]

    @field_validator("axes")
    @classmethod
    def _are_lists(cls, axes: FiniteTable) -> FiniteTable:
        for name, values in axes.items():
            if not isinstance(values, list) or not values:
                raise ValueError(f"axis {name}: expected a list of at least one value, got {values!r}")
        return axes

    @model_validator(mode="after")
    def _names_are_told_apart(self) -> "Panel":
        if not self.axes and not self.cells:
            raise ValueError("expected at least one axis or one of [[cells]], got neither")
        for name in {*self.axes, *(name for cell in self.cells for name in cell)} & {*self.fixed, *OURS}:
            why = "it is in [fixed], or drake_diff sets it for each trial"
            raise ValueError(f"axes and cells: {name} cannot be used: {why}")
        for name in self.fixed.keys() & set(OURS):
            raise ValueError(f"fixed: {name} cannot be used: drake_diff sets it for each trial")
        return self

    @property
    def sha256(self) -> str:
        """The hash of the file's content, independent of comments and of the order of its tables."""
        return sha256(canonical(self.model_dump())).hexdigest()


@dataclass(frozen=True)
class PanelTrial:
    """A trial of a panel: its `cell` (its values on the axes) and `fields`, the arguments of its function.

    `fields` are the cell, the fixed values, `repeat` (its number within the cell, from 0) and a `seed` of 53 bits. The
    seed is drawn from the panel's seed and all other fields, so that a new value on an axis does not change other
    trials. `id` is the start of the SHA-256 of the fields.
    """

    cell: dict[str, Any]
    fields: dict[str, Any]
    id: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "id", sha256(canonical(self.fields)).hexdigest()[:16])

    @property
    def name(self) -> str:
        """The readable name, such as `method=ilqr level=0.1 repeat=3`."""
        return f"{cell_name(self.cell)} repeat={self.fields['repeat']}"


def canonical(value: Any) -> bytes:
    """Convert a value to canonical JSON: sorted keys, no spaces, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def cell_name(cell: dict[str, Any]) -> str:
    """Format a cell in one line."""
    return " ".join(f"{k}={v if isinstance(v, str) else canonical(v).decode()}" for k, v in cell.items())


def load_panel(path: Path) -> Panel:
    """Read the panel in the TOML file at `path`. Raises InputError with all invalid entries."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(str(path), got=f"{type(error).__name__}: {error}", expected="a panel in TOML") from error
    try:
        return Panel.model_validate(document)
    except ValidationError as error:
        issues = [(".".join(map(str, issue["loc"])) or "panel", issue["msg"]) for issue in error.errors()]
        wrong = "; ".join(f"{location}: {message.removeprefix('Value error, ')}" for location, message in issues)
        raise InputError(str(path), got=wrong, expected=f"the fields {', '.join(Panel.model_fields)}") from error


def expand(panel: Panel) -> tuple[PanelTrial, ...]:
    """Return all trials: the axes' combinations (last axis fastest), then the cells, each `panel.seeds` times."""
    axes: dict[str, Any] = panel.axes
    combinations = product(*axes.values()) if axes else ()
    cells = [*(dict(zip(axes, values, strict=True)) for values in combinations), *panel.cells]
    trials: dict[str, PanelTrial] = {}
    for cell, repeat in product(cells, range(panel.seeds)):
        fields = {**panel.fixed, **cell, "repeat": repeat}
        words = np.frombuffer(sha256(canonical(fields)).digest(), "<u4")
        state = np.random.SeedSequence([panel.seed, *words.tolist()]).generate_state(1, np.uint64)
        trial = PanelTrial(cell, {**fields, "seed": int(state[0]) >> 11})
        if trial.id in trials:
            raise InputError("axes and cells", got=f"{cell_name(cell)} twice", expected="each cell once")
        trials[trial.id] = trial
    return tuple(trials.values())


TABLE, SUMMARY, PAGE = "table.csv", "summary.json", "panel.html"
STATED = ("panel", "verdict", "sentence")  # fields of a panel's record that follow from its table
RANKED = ("place", "name", "apart", "trials", "errors", "success", "numbers")  # fields of a cell in a panel's record
SHOWN_CELLS = 8  # number of cells in a repr
COST = "cost"  # the number that ranks cells without success rates or with equal rates; less is better


class Finished:
    """The rows of the finished trials by id, each saved in the record of its trial."""

    def __init__(self, directory: Path, conditions: Mapping[str, Any]):
        self.folder, self.conditions = directory / TRIALS, dict(conditions)
        make_folder(self.folder)
        for partial in self.folder.glob("*.partial"):  # incomplete records of a killed process
            partial.unlink()
        self.rows = {path.stem: self._read(path) for path in sorted(self.folder.iterdir())}

    def add(self, trial: PanelTrial, row: Row) -> None:
        """Write the record of a finished trial to disk."""
        record = trial_record(trial.id, trial.name, trial.cell, trial.fields, row, self.conditions)
        write_whole(self.folder / f"{trial.id}.json", record.to_json().encode())
        self.rows[trial.id] = row

    def _read(self, path: Path) -> Row:
        trial, problems = _read_trial(path)
        if trial.conditions != self.conditions:
            problems = (*problems, "the trial belongs to another panel; remove its record")
        if problems:
            raise ArtifactError(f"{path}: {problems[0]}")
        return trial.result


@contextmanager
def finished_trials(directory: Path, begun: ComparisonRecord, conditions: Mapping[str, Any]) -> Iterator[Finished]:
    """Lock `directory` for the duration of the block, and yield the trials that an earlier run finished in it.

    Raises ArtifactError if the directory belongs to another panel, a record is damaged, or another process writes
    there. Raises InputError if the directory contains files that are not from a panel.
    """
    with writing(directory.resolve()):
        if is_taken(directory):
            _check_same_panel(directory, conditions)
        begun.begin(directory)
        yield Finished(directory, conditions)


def _check_same_panel(directory: Path, conditions: Mapping[str, Any]) -> None:
    record = None
    with suppress(ArtifactError):  # a directory without a panel's record raises an error below
        record = load_record(directory)
    if not isinstance(record, ComparisonRecord) or record.panel is None:
        expected = "a new or empty directory, or the directory of an unfinished panel"
        raise InputError("out", got=f"{directory} with {next(directory.iterdir()).name!r}", expected=expected)
    old = record.panel.conditions
    for key in sorted({*old, *conditions}):
        if old.get(key) != conditions.get(key):
            differs = f"{key}: expected {conditions.get(key)}, got {old.get(key)}"
            advice = "choose another directory, or remove this one to start over"
            raise ArtifactError(f"{directory} belongs to another panel: {differs}; {advice}")


def _read_trial(path: Path) -> tuple[TrialSection, tuple[str, ...]]:
    """Return the record of a trial, and its problems: damage, or values that do not match the inputs."""
    record, problems = read_checked(path)
    trial = record.trial if isinstance(record, ComparisonRecord) else None
    if trial is None:
        raise ArtifactError(f"{path}: expected the record of a trial")
    if not problems and not _follows(path, record, trial):
        problems = (f"{path.name}: it differs from the record that the panel writes for these inputs and this result",)
    return trial, problems


def _follows(path: Path, record: SealedRecord, trial: TrialSection) -> bool:
    """Return whether the whole record of a trial follows from its inputs, its result and the panel's conditions."""
    if not trial.cell.items() <= trial.inputs.items() or not {"repeat", "seed"} <= trial.inputs.keys():
        return False
    made = PanelTrial(trial.cell, trial.inputs)
    same_name = sorted(made.name.split()) == sorted(record.name.split())  # records sort the names of a cell
    if not (same_name and path.stem == made.id and {"python", "platform"} <= trial.conditions.keys()):
        return False
    again = trial_record(made.id, record.name, trial.cell, trial.inputs, trial.result, trial.conditions)
    written, wanted = record.model_dump(mode="json"), again.model_dump(mode="json")
    return all(written[name] == wanted[name] for name in wanted.keys() - {"schema_version", "record_sha256"})


@dataclass(frozen=True, eq=False)
class PanelTable(ShowsItsRepr):
    """The result of `run_panel`.

    `rows` has a row for each trial, in the panel's order: its cell, id, repeat and seed, then the values that its
    function returned. `summary` contains the counts, means and success rates of each cell. They are equal to the
    contents of `table.csv` and `summary.json` in `directory`.
    """

    directory: Path
    rows: tuple[Row, ...]
    summary: dict[str, Any]

    @property
    def errors(self) -> int:
        """The number of trials with an error."""
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
    """Write `table.csv` and `summary.json` for all `trials`. `made` contains the conditions of the panel."""
    results = {name: dict(sorted(row.items())) for name, row in results.items()}  # in the order of trial records
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
    return PanelTable(directory, rows, summary)


def begun_record(directory: Path, trials: int, made: Mapping[str, Any]) -> ComparisonRecord:
    """Return the record of an unfinished panel."""
    return ComparisonRecord(
        verdict="incomplete",
        sentence="the panel has started and not finished: it is still running, or it was killed",
        panel=PanelSection(conditions=dict(made), trials=trials, errors=None),
        **header(directory.name),
    )


def ended_record(begun: ComparisonRecord, table: PanelTable, seconds: float) -> ComparisonRecord:
    """Return the record of a finished panel. `seconds` is the duration of this call."""
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
            "wall_clock": header(begun.name, seconds=seconds)["wall_clock"],
        }
    )


def ranked(summary: Mapping[str, Any]) -> tuple[str, list[dict[str, Any]]]:
    """Return the criterion by which the cells of `summary` are ranked, and a row for each cell, the best first.

    Cells with success rates are ranked by the lower end of the 95 % interval, then by the mean cost. Cells without
    success rates are ranked by the number of errors, then by the mean cost. A trial with an error is not a success and
    has no cost. `apart` is whether the interval of a cell is below that of the best cell, or None without rates.
    """
    cells = summary["cells"]
    judged = all("success" in cell for cell in cells)

    def key(cell: Mapping[str, Any]) -> tuple[float, float]:
        cost = cell["numbers"].get(COST, {}).get("mean", float("inf"))
        return (-cell["success"]["low"] if judged else cell["errors"], cost)

    ordered = sorted(cells, key=key)  # equal cells keep the panel's order
    keys = [key(cell) for cell in ordered]
    rows = [
        {
            "place": keys.index(key(cell)) + 1,
            "name": cell_name(cell["cell"]),
            "apart": cell["success"]["high"] < ordered[0]["success"]["low"] if judged else None,
            **cell,
        }
        for cell in ordered
    ]
    if judged:
        return "the lower end of the 95 % interval of the success rate, then the mean cost", rows
    if any(COST in cell["numbers"] for cell in cells):
        return "the fewest errors, then the mean cost; no trial says whether it is a success", rows
    return "the fewest errors; no trial says whether it is a success, or has a cost", rows


def write_ranking(path: Path, summary: Mapping[str, Any], record: ComparisonRecord) -> None:
    """Write the page of a panel's `summary` and its `record`."""
    by, rows = ranked(summary)
    stated = record.model_dump(mode="json", include={"name", "verdict", "provenance"})
    stated = json.loads(canonical(stated))  # in the order of the record's file
    shown = {**stated, "sentence": f"{rows[0]['name']} is the best of {len(rows)} cells, by {by}", **summary}
    write_page(path, "panel.html.j2", record=shown, data=page_data(0.0, []), rows=rows)


def _csv(rows: Sequence[Row], answered: set[str]) -> bytes:
    """Format rows by RFC 4180: columns of cells, then of the function, in order of first appearance, then error."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    given = [name for name in names if name not in {*answered, "repeat", "seed"}]
    columns = [*given, "repeat", "seed", *(name for name in names if name in answered - {"error"}), "error"]
    text = io.StringIO(newline="")
    csv.writer(text).writerows([columns, *([_text(row.get(name)) for name in columns] for row in rows)])
    return text.getvalue().encode()


def _text(value: Any) -> str:
    """Format a value for a field: "" for None, strings unchanged, other values as JSON."""
    return "" if value is None else value if isinstance(value, str) else canonical(value).decode()


def _cell(cell: dict[str, Any], rows: Sequence[Row], judged: bool) -> dict[str, Any]:
    """Summarize one cell. A trial with an error does not count as a success."""
    numbers: dict[str, list[float]] = {}
    for name, value in (item for row in rows for item in row.items()):
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            numbers.setdefault(name, []).append(float(value))
    summary: dict[str, Any] = {"cell": cell, "trials": len(rows), "errors": sum("error" in row for row in rows)}
    if judged:
        rate = success_rate(sum(row.get("success") is True for row in rows), len(rows))
        summary["success"] = {"count": rate.successes, "rate": rate.value, "low": rate.lower, "high": rate.upper}
    summary["numbers"] = {
        name: {
            "count": len(values),
            "mean": statistics.mean(values),  # the sum is exact, and rounded once
            "std": statistics.stdev(values) if len(values) > 1 else None,
            "min": min(values),
            "max": max(values),
        }
        for name, values in numbers.items()
    }
    return summary


def reproduce(folder: Path, record: ComparisonRecord, models: Path | None) -> Reproduced:
    """Write the page again, and report differences of a panel's directory or of a trial's record at `folder`."""
    if record.trial is not None:
        return Reproduced({}, {}, problems=tuple(_odd_trial(folder)))
    with TemporaryDirectory() as location:
        problems = _odd_panel(folder, record, Path(location))
        files = {path.name: path.read_bytes() for path in Path(location).glob(PAGE)}
    trials = (name for name in record.files if name.startswith(f"{TRIALS}/"))
    return Reproduced({}, files, problems=tuple(problems), written=(TABLE, SUMMARY, PAGE, *trials))


def _odd_trial(path: Path) -> Iterator[str]:
    """Yield problems of a trial: values that do not match its inputs, or the panel's record and table if present."""
    trial, problems = _read_trial(path)
    yield from problems
    panel = path.parent.parent
    if not (panel / TABLE).exists():
        return
    row, record = _read_table(panel / TABLE).get(trial.id, {}), load_record(panel)
    conditions = record.panel.conditions if isinstance(record, ComparisonRecord) and record.panel is not None else {}
    if trial.conditions != conditions or any(row.get(name) != _text(value) for name, value in trial.result.items()):
        yield f"{path.name}: its result or its panel differs from {TABLE}"


def _odd_panel(folder: Path, record: ComparisonRecord, again: Path) -> list[str]:
    """Return differences of a panel's table, summary and record from those computed again from its trials.

    The new files, including the page, are written to the folder `again`.
    """
    if record.panel is None:
        raise ArtifactError(f"{record.FILE}: expected the record of a panel")
    panel, table, summary = record.panel.conditions, _read_table(folder / TABLE), read_fields(folder / SUMMARY)
    listed = {Path(name).stem for name in record.files if name.startswith(f"{TRIALS}/")}
    result = [f"{TABLE} and {TRIALS}: only one of them has trial {name}" for name in sorted(listed ^ table.keys())]
    if result:
        return result
    # Records have sorted names. The summary has the names of a cell in the panel's order.
    ordered = {canonical(entry["cell"]): entry["cell"] for entry in summary.get("cells") or ()}
    trials, rows = [], {}
    for name in table:
        item, problems = _read_trial(folder / TRIALS / f"{name}.json")
        result += [*problems, *([f"{name}.json: from another panel"] if item.conditions != panel else [])]
        trials.append(PanelTrial(ordered.get(canonical(item.cell), item.cell), item.inputs))
        rows[name] = item.result
    if result:
        return result
    made = write_table(again, trials, rows, panel)
    write_ranking(again / PAGE, made.summary, record)
    files = _read_table(again / TABLE), read_fields(again / SUMMARY)
    for name, old, new in zip((TABLE, SUMMARY), (table, summary), files, strict=True):
        result += [f"{name}: it differs from the file recomputed from {TRIALS}"] * (old != new)
    begun = record.panel.model_copy(update={"trials": len(trials)})
    ended = ended_record(record.model_copy(update={"panel": begun}), made, 0.0)
    wrong = [name for name in STATED if getattr(ended, name) != getattr(record, name)]
    return [*result, *(f"{record.FILE}: {name} differs from the value recomputed from the table" for name in wrong)]


def _read_table(path: Path) -> dict[str, dict[str, str]]:
    """Return the rows of a table by trial id. Raises ArtifactError if the file is not a table of trials."""
    data = read_plain(path, MOST_TEXT)
    most = csv.field_size_limit(len(data) + 1)
    try:
        rows = {row["id"]: row for row in csv.DictReader(io.StringIO(data.decode(), newline=""), strict=True)}
    except (UnicodeDecodeError, KeyError, csv.Error) as error:
        raise ArtifactError(f"{TABLE}: not a table of trials: {type(error).__name__}: {error}") from error
    finally:
        csv.field_size_limit(most)
    if any(not name.isalnum() for name in rows):  # ids are used in paths
        raise ArtifactError(f"{TABLE}: expected ids of trials, got other names")
    return rows

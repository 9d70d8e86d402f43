"""A panel: its file, the trials that it stands for, and what it writes.

That is a record of each finished trial, which a later run goes on from, and at the end the table, summary and ranking
that are made of these records. The file is TOML, and may say:

evaluate = "trials.py:balance"   # a file beside this one, or "package.module:function"
seed = 0
seeds = 20                       # trials of each cell

[axes]                           # every combination of their values is a cell
method = ["ilqr", "shooting"]
level = [0.0, 0.1]

[fixed]                          # the same in all trials
model = "models/pendulum.urdf"

[[cells]]                        # one more cell
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

# Names of what drake_diff itself gives each trial; an axis, cell or fixed value cannot have them.
OURS = ("id", "repeat", "seed")
Row = dict[str, Any]  # what came of a trial, in JSON's types


class Panel(BaseModel):
    """What a panel file says."""

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
            why = "it is in [fixed], or drake_diff gives it to each trial"
            raise ValueError(f"axes and cells: {name} cannot be used: {why}")
        for name in self.fixed.keys() & set(OURS):
            raise ValueError(f"fixed: {name} cannot be used: drake_diff gives it to each trial")
        return self

    @property
    def sha256(self) -> str:
        """The hash of what the file says; comments and the order of its tables do not change it."""
        return sha256(canonical(self.model_dump())).hexdigest()


@dataclass(frozen=True)
class PanelTrial:
    """One trial of a panel: its `cell` (its values on the axes) and `fields`, all that its function is given.

    `fields` are the cell, the fixed values, `repeat` (its number within the cell, from 0) and its own `seed` of 53
    bits, drawn from the panel's seed and all other fields, so that a new value on an axis changes no other trial.
    `id` is the start of the SHA-256 of the fields.
    """

    cell: dict[str, Any]
    fields: dict[str, Any]
    id: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "id", sha256(canonical(self.fields)).hexdigest()[:16])

    @property
    def name(self) -> str:
        """As people read it: `method=ilqr level=0.1 repeat=3`."""
        return f"{cell_name(self.cell)} repeat={self.fields['repeat']}"


def canonical(value: Any) -> bytes:
    """The same value always gives the same JSON: sorted keys, no spaces, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def cell_name(cell: dict[str, Any]) -> str:
    """A cell in one line."""
    return " ".join(f"{k}={v if isinstance(v, str) else canonical(v).decode()}" for k, v in cell.items())


def load_panel(path: Path) -> Panel:
    """The panel in the TOML file at `path`; InputError names every wrong entry."""
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
    """Every trial: the axes' combinations (the last axis fastest), then the cells, each `panel.seeds` times."""
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
STATED = ("panel", "verdict", "sentence")  # of the record of a panel, by its table
RANKED = ("place", "name", "apart", "trials", "errors", "success", "numbers")  # of a cell in the record of a panel
SHOWN_CELLS = 8  # in a repr
COST = "cost"  # the number that ranks where nothing is judged, and among equals: less is better


class Finished:
    """The rows of the finished trials, by id, each in the record of its trial on the disk."""

    def __init__(self, directory: Path, conditions: Mapping[str, Any]):
        self.folder, self.conditions = directory / TRIALS, dict(conditions)
        make_folder(self.folder)
        for partial in self.folder.glob("*.partial"):  # a killed process leaves a record half written
            partial.unlink()
        self.rows = {path.stem: self._read(path) for path in sorted(self.folder.iterdir())}

    def add(self, trial: PanelTrial, row: Row) -> None:
        """Write the record of a finished trial to the disk."""
        record = trial_record(trial.id, trial.name, trial.cell, trial.fields, row, self.conditions)
        write_whole(self.folder / f"{trial.id}.json", record.to_json().encode())
        self.rows[trial.id] = row

    def _read(self, path: Path) -> Row:
        trial, problems = _read_trial(path)
        if trial.conditions != self.conditions:
            problems = (*problems, "it belongs to another panel; remove it")
        if problems:
            raise ArtifactError(f"{path}: {problems[0]}")
        return trial.result


@contextmanager
def finished_trials(directory: Path, begun: ComparisonRecord, conditions: Mapping[str, Any]) -> Iterator[Finished]:
    """What an earlier run of the panel finished in `directory`, in which nobody else writes while the block runs.

    ArtifactError where the directory is another panel's, where a record is damaged, or where another process writes
    there; InputError where the directory holds what no panel wrote.
    """
    with writing(directory.resolve()):
        if is_taken(directory):
            _check_same_panel(directory, conditions)
        begun.begin(directory)
        yield Finished(directory, conditions)


def _check_same_panel(directory: Path, conditions: Mapping[str, Any]) -> None:
    record = None
    with suppress(ArtifactError):  # what has no record of a panel is refused below
        record = load_record(directory)
    if not isinstance(record, ComparisonRecord) or record.panel is None:
        expected = "a new or empty directory, or the directory of an unfinished panel"
        raise InputError("out", got=f"{directory}, which holds {next(directory.iterdir()).name!r}", expected=expected)
    old = record.panel.conditions
    for key in sorted({*old, *conditions}):
        if old.get(key) != conditions.get(key):
            differs = f"{key}: expected {conditions.get(key)}, got {old.get(key)}"
            advice = "choose another directory, or remove this one to start over"
            raise ArtifactError(f"{directory} is of another panel: {differs}; {advice}")


def _read_trial(path: Path) -> tuple[TrialSection, tuple[str, ...]]:
    """The record of a trial, and what in it is damaged or does not fit its inputs."""
    record, problems = read_checked(path)
    trial = record.trial if isinstance(record, ComparisonRecord) else None
    if trial is None:
        raise ArtifactError(f"{path}: expected the record of a trial")
    if not problems and not _follows(path, record, trial):
        problems = (f"{path.name}: it is not what the panel writes of these inputs and this result",)
    return trial, problems


def _follows(path: Path, record: SealedRecord, trial: TrialSection) -> bool:
    """Whether all of a trial's record follows from its inputs, its result and the panel's conditions."""
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
    """Write `table.csv`, `summary.json` and the ranking of all `trials`; `made` says what the panel is."""
    results = {name: dict(sorted(row.items())) for name, row in results.items()}  # as in the records of trials
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
    """The record while trials are missing."""
    return ComparisonRecord(
        verdict="incomplete",
        sentence="the panel has started and not finished: it is still running, or it was killed",
        panel=PanelSection(conditions=dict(made), trials=trials, errors=None),
        **header(directory.name),
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
            "wall_clock": header(begun.name, seconds=seconds)["wall_clock"],
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

    def key(cell: Mapping[str, Any]) -> tuple[float, float]:
        cost = cell["numbers"].get(COST, {}).get("mean", float("inf"))
        return (-cell["success"]["low"] if judged else cell["errors"], cost)

    ordered = sorted(cells, key=key)  # equals stay in the panel's order
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
    stated = json.loads(canonical(stated))  # in the order in which the record is written
    shown = {**stated, "sentence": f"{rows[0]['name']} is the best of {len(rows)} cells, by {by}", **summary}
    write_page(path, "panel.html.j2", record=shown, data=page_data(0.0, []), rows=rows)


def _csv(rows: Sequence[Row], answered: set[str]) -> bytes:
    """RFC 4180: the cells' columns before the function's, each in the order in which it first appears; error last."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    given = [name for name in names if name not in {*answered, "repeat", "seed"}]
    columns = [*given, "repeat", "seed", *(name for name in names if name in answered - {"error"}), "error"]
    text = io.StringIO(newline="")
    csv.writer(text).writerows([columns, *([_text(row.get(name)) for name in columns] for row in rows)])
    return text.getvalue().encode()


def _text(value: Any) -> str:
    """A value in a field: nothing for null, words as they are, everything else as in JSON."""
    return "" if value is None else value if isinstance(value, str) else canonical(value).decode()


def _cell(cell: dict[str, Any], rows: Sequence[Row], judged: bool) -> dict[str, Any]:
    """One cell: a trial that ended in an error is no success."""
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
            "mean": statistics.mean(values),  # its sums are exact and rounded once
            "std": statistics.stdev(values) if len(values) > 1 else None,
            "min": min(values),
            "max": max(values),
        }
        for name, values in numbers.items()
    }
    return summary


def reproduce(folder: Path, record: ComparisonRecord, models: Path | None) -> Reproduced:
    """What of a panel's directory, or of the record of one trial at `folder`, does not follow from the trials."""
    if record.trial is not None:
        return Reproduced({}, {}, problems=tuple(_odd_trial(folder)))
    with TemporaryDirectory() as location:
        problems = _odd_panel(folder, record, Path(location))
        files = {path.name: path.read_bytes() for path in Path(location).glob(PAGE)}
    trials = (name for name in record.files if name.startswith(f"{TRIALS}/"))
    return Reproduced({}, files, problems=tuple(problems), written=(TABLE, SUMMARY, PAGE, *trials))


def _odd_trial(path: Path) -> Iterator[str]:
    """What of a trial does not fit its inputs, or the panel's record and table where they are beside it."""
    trial, problems = _read_trial(path)
    yield from problems
    panel = path.parent.parent
    if not (panel / TABLE).exists():
        return
    row, record = _read_table(panel / TABLE).get(trial.id, {}), load_record(panel)
    conditions = record.panel.conditions if isinstance(record, ComparisonRecord) and record.panel is not None else {}
    if trial.conditions != conditions or any(row.get(name) != _text(value) for name, value in trial.result.items()):
        yield f"{path.name}: its result or its panel is not that of {TABLE}"


def _odd_panel(folder: Path, record: ComparisonRecord, again: Path) -> list[str]:
    """What of the table, the summary and the record of a panel does not come out of the records of its trials again.

    They are made in the folder `again`, and the page with them.
    """
    if record.panel is None:
        raise ArtifactError(f"{record.FILE}: expected the record of a panel")
    panel, table, summary = record.panel.conditions, _read_table(folder / TABLE), read_fields(folder / SUMMARY)
    listed = {Path(name).stem for name in record.files if name.startswith(f"{TRIALS}/")}
    result = [f"{TABLE} and {TRIALS}: only one of them has trial {name}" for name in sorted(listed ^ table.keys())]
    if result:
        return result
    # Records sort names; the summary has those of a cell in the panel's order.
    ordered = {canonical(entry["cell"]): entry["cell"] for entry in summary.get("cells") or ()}
    trials, rows = [], {}
    for name in table:
        item, problems = _read_trial(folder / TRIALS / f"{name}.json")
        result += [*problems, *([f"{name}.json: it is of another panel"] if item.conditions != panel else [])]
        trials.append(PanelTrial(ordered.get(canonical(item.cell), item.cell), item.inputs))
        rows[name] = item.result
    if result:
        return result
    made = write_table(again, trials, rows, panel)
    write_ranking(again / PAGE, made.summary, record)
    files = _read_table(again / TABLE), read_fields(again / SUMMARY)
    for name, old, new in zip((TABLE, SUMMARY), (table, summary), files, strict=True):
        result += [f"{name}: it does not come out of {TRIALS} again"] * (old != new)
    begun = record.panel.model_copy(update={"trials": len(trials)})
    ended = ended_record(record.model_copy(update={"panel": begun}), made, 0.0)
    wrong = [name for name in STATED if getattr(ended, name) != getattr(record, name)]
    return [*result, *(f"{record.FILE}: {name} is not what the table says" for name in wrong)]


def _read_table(path: Path) -> dict[str, dict[str, str]]:
    """The rows of a table by the id of their trial; ArtifactError where it is none."""
    data = read_plain(path, MOST_TEXT)
    most = csv.field_size_limit(len(data) + 1)
    try:
        rows = {row["id"]: row for row in csv.DictReader(io.StringIO(data.decode(), newline=""), strict=True)}
    except (UnicodeDecodeError, KeyError, csv.Error) as error:
        raise ArtifactError(f"{TABLE}: not a table of trials: {type(error).__name__}: {error}") from error
    finally:
        csv.field_size_limit(most)
    if any(not name.isalnum() for name in rows):  # it becomes a path
        raise ArtifactError(f"{TABLE}: expected ids of trials, got other names")
    return rows

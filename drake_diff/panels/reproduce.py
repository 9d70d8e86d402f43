"""What of a panel's directory follows from its journal, made again from the journal; no trial is evaluated again."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from drake_diff._base.files import MOST_TEXT, read_plain
from drake_diff.exceptions import ArtifactError
from drake_diff.panels.panel_file import PanelTrial, canonical
from drake_diff.panels.results import JOURNAL, SUMMARY, TABLE, ended_record, read_journal, write_table
from drake_diff.runs.other_records import TRIALS, ComparisonRecord, TrialSection
from drake_diff.runs.read import parse_record
from drake_diff.runs.reproduce import Reproduced
from drake_diff.runs.sealed import read_fields

SAID = ("panel", "verdict", "sentence")  # of the record, by the table


def reproduce(folder: Path, record: ComparisonRecord, models: Path | None) -> Reproduced:
    """What of a panel's directory, or of the record of one trial at `folder`, does not follow from the journal."""
    problems = [*_odd_panel(folder, record)] if record.trial is None else [*_odd_trial(folder, record.trial)]
    return Reproduced({}, {}, problems=tuple(problems))


def _odd_trial(path: Path, record: TrialSection) -> Iterator[str]:
    """What of the record of one trial does not fit its inputs, and the panel's journal where that is beside it."""
    expected = PanelTrial(record.cell, record.inputs).id
    if record.id != expected or path.stem != expected:
        yield f"{path.name}: id {record.id}, but its inputs are those of trial {expected}"
    wrong = [name for name, value in record.cell.items() if record.inputs.get(name) != value]
    if wrong:
        yield f"{path.name}: {', '.join(wrong)} of its cell is not that of its inputs"
    journal = path.parent.parent / JOURNAL
    if journal.exists():
        panel, rows = read_journal(journal, read_plain(journal))
        if record.id not in rows:
            yield f"{path.name}: {JOURNAL} does not have this trial"
        elif (rows[record.id], panel) != (record.result, record.conditions):
            yield f"{path.name}: its result or its panel is not that of {JOURNAL}"


def _odd_panel(folder: Path, record: ComparisonRecord) -> list[str]:
    """What of the table, the summary, the records of trials and of the panel does not come out of the journal again."""
    panel, rows = read_journal(folder / JOURNAL, read_plain(folder / JOURNAL))
    trials, cells = [], _cells(folder / SUMMARY)
    result: list[str] = []
    for name in _ids(read_plain(folder / TABLE, MOST_TEXT)):
        path = folder / TRIALS / f"{name}.json"
        parsed = parse_record(path, read_fields(path))
        item = parsed.trial if isinstance(parsed, ComparisonRecord) else None
        if item is None:
            raise ArtifactError(f"{path}: expected the record of a trial")
        result += _odd_trial(path, item)
        trials.append(PanelTrial(cells.get(canonical(item.cell), item.cell), item.inputs))
    missing = sorted({trial.id for trial in trials} ^ rows.keys())
    if result or missing:
        return [*result, *(f"{TABLE} and {JOURNAL}: only one of them has trial {name}" for name in missing)]
    with TemporaryDirectory() as location:
        again = Path(location)
        table = write_table(again, trials, rows, panel)
        for name in (TABLE, SUMMARY, *(f"{TRIALS}/{trial.id}.json" for trial in trials)):
            if (again / name).read_bytes() != read_plain(folder / name):
                result.append(f"{name}: it does not come out of {JOURNAL} again")
    if record.panel is None:
        raise ArtifactError(f"{record.FILE}: expected the record of a panel")
    begun = record.panel.model_copy(update={"conditions": panel, "trials": len(trials)})
    made = ended_record(record.model_copy(update={"panel": begun}), table, 0.0)
    wrong = [name for name in SAID if getattr(made, name) != getattr(record, name)]
    return [*result, *(f"{record.FILE}: {name} is not what the table says" for name in wrong)]


def _cells(path: Path) -> dict[bytes, dict[str, Any]]:
    """The cells of a summary with their names in the panel's order, which records sort, by their canonical JSON."""
    listed = read_fields(path).get("cells")
    cells = [entry.get("cell") for entry in listed if isinstance(entry, dict)] if isinstance(listed, list) else []
    return {canonical(cell): cell for cell in cells if isinstance(cell, dict)}


def _ids(table: bytes) -> list[str]:
    most = csv.field_size_limit(len(table) + 1)
    try:
        rows = list(csv.reader(io.StringIO(table.decode(), newline="")))
        column = rows[0].index("id")
        names = [row[column] for row in rows[1:]]
    except (UnicodeDecodeError, ValueError, IndexError, csv.Error) as error:
        raise ArtifactError(f"{TABLE}: not a table of trials: {type(error).__name__}: {error}") from error
    finally:
        csv.field_size_limit(most)
    if any(not name.isalnum() for name in names):  # it becomes a path
        raise ArtifactError(f"{TABLE}: expected ids of trials, got other names")
    return names

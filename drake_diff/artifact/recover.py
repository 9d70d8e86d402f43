"""Complete a run that was killed, failed or interrupted, from the directory that it left beside its place."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

from drake_diff._base.files import remove_folder
from drake_diff.artifact.again import RECOVERED
from drake_diff.artifact.measurement import measure
from drake_diff.artifact.rerun import ANYWHERE, PLAN, read_plan, rebuilt, resolve, rows_of
from drake_diff.artifact.save import record_of, write_files
from drake_diff.artifact.sections import unknown_functions
from drake_diff.exceptions import ArtifactError, InputError
from drake_diff.record.directory import is_partial, is_taken, name_of, place, writing, written_whole
from drake_diff.record.read import load_record
from drake_diff.record.sealed import SealedRecord, files_below
from drake_diff.record.solve import EvidenceRecord


def recover(directory: str | Path, out: str | Path | None = None) -> SealedRecord:
    """Complete a run from the directory NAME.partial-... that it left, as far as that can be done.

    What was written whole takes its place. Of a solve whose plan is there, the plan is measured again and all files are
    written. Its search is not made again, by `verify` either: whoever ran it had not told all that it came to.

    Args:
        directory: What the run left.
        out: Where the run is to be; NAME where not given. No run is replaced.

    Returns:
        The record.

    Raises:
        InputError: `directory` is no such directory, or `out` is not empty.
        ArtifactError: There is nothing in it that could be completed, or the run is still being written.
        ModelError: The model's file is not what it was.
        WriteError: The disk is full, or does not let a file be written.

    Example:
        >>> from tempfile import mkdtemp
        >>> from drake_diff.artifact import recover
        >>> recover(mkdtemp())
        Traceback (most recent call last):
        drake_diff.exceptions.InputError: RUN: expected a directory NAME.partial-... that a run left, got ...
    """
    folder = Path(directory).resolve()
    if not folder.is_dir() or not is_partial(folder):
        beside = sorted(p.name for p in folder.parent.glob(f"{folder.name}.*") if p.is_dir() and is_partial(p))
        got = f"{folder}" + (f", beside which are {', '.join(beside)}" if beside else "")
        raise InputError("RUN", got=got, expected="a directory NAME.partial-... that a run left")
    own = folder.with_name(name_of(folder))
    target = own if out is None else Path(out).resolve()
    with nullcontext() if target == own else writing(own):
        if is_taken(target):
            expected = "a new or empty directory, as no run is replaced: --out names another"
            raise InputError("OUT", got=str(target), expected=expected)
        record = load_record(folder)
        if record.state == "complete" and files_below(folder, record.FILE) == record.files:
            with writing(target):
                place(folder, target)
            return record
        if not isinstance(record, EvidenceRecord) or record.solver is None or not (folder / PLAN).is_file():
            raise ArtifactError(f"{folder}: there is no plan of a solve in it: run it again; {record.sentence}")
        made = _measured(folder, record, target)
        remove_folder(folder)
    return made


def _measured(folder: Path, record: EvidenceRecord, target: Path) -> EvidenceRecord:
    """The plan in `folder` measured, and written to `target`."""
    costs, constraints = unknown_functions(record)
    if costs or constraints:
        names = ", ".join((*costs, *constraints))
        told = f"{names}: a user's function, which no directory holds; start the script again from the plan in {PLAN}"
        raise ArtifactError(f"{folder}: {told}")
    plan = read_plan(folder / PLAN, partial=True)
    source = record.contract.get("source")
    with rebuilt(record.model, source, None, ANYWHERE) as model, written_whole(target) as whole:
        measurement = measure(resolve(record, model, plan).told(iterations=rows_of(plan)))
        made = _with_the_search(record_of(measurement, whole), record)
        write_files(whole, measurement, made)
        return made.write(whole)


def _with_the_search(made: EvidenceRecord, record: EvidenceRecord) -> EvidenceRecord:
    """With what `record` says of the search, which only who ran it knew."""
    told: dict[str, Any] = {
        "sentence": f"{made.sentence}; {RECOVERED}",
        "solver": record.solver,
        "data": record.data,
        "inputs": record.inputs.model_copy(update={"search": None}),
        "wall_clock": made.wall_clock.model_copy(update={"duration_s": record.wall_clock.duration_s}),
    }
    if made.gradient is not None and record.gradient is not None:
        known = {name: getattr(record.gradient, name) for name in ("columns", "certificates")}
        told["gradient"] = made.gradient.model_copy(update=known)
    return made.model_copy(update=told)

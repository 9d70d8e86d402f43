"""Reproduction of a saved comparison: its recordings are compared again, and their causes are searched again.

The search for a cause ends when a step would reduce the sum of squares by at most 1e-5, in units of the noise. So a
search with other steps, as on a machine with other rounding, ends within sqrt(1e-5) of a standard deviation, which is
0.0016 of half a 95 % interval.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff.comparison.files import MOTION, PAGE, REPLAY, TRACE, hash_of_arrays, made_of_record, row_of
from drake_diff.comparison.recordings import Recording, place_of, read_arrays
from drake_diff.comparison.result import slug
from drake_diff.comparison.side_by_side import compare_recordings
from drake_diff.exceptions import DrakeDiffError
from drake_diff.identification.explain import explain
from drake_diff.logs.mcap_file import read_mcap
from drake_diff.model.model import Model
from drake_diff.runs.differences import ABSOLUTE, NUMBER, Reproduced, is_near
from drake_diff.runs.fields import plain
from drake_diff.runs.other_records import CauseEvidence, ComparisonRecord
from drake_diff.runs.provenance import contract_of, model_input
from drake_diff.runs.rebuild import rebuilt
from drake_diff.runs.reproduce import as_given

SAME_VALUE = 2e-3  # tolerance in units of half the interval (see above)
SAME_DIGIT = 1.01  # tolerance in units of the last digit in a text: a number between two may be rounded to either
ENDED = "The search was ended after"  # in a cause's sentence: its search reached the processor time limit
LOST = "the search for its cause was not repeated: its recording is not in the directory"
WRITTEN = (TRACE, REPLAY, PAGE)
NEVER = (  # the parts that are not checked
    "model and recordings: they define the task, and no check can tell whether the robot moved as recorded",
    "all but the recordings, plots, scenes and frames: the engines were not run again",
)


def reproduce(folder: Path, record: ComparisonRecord, models: Path | None) -> Reproduced:
    """Recompute the rows and causes of a record's recordings from the directory alone; engines are not run.

    Raises ArtifactError if the directory does not match the record, ModelError if the model cannot be rebuilt. `models`
    is as in `rebuilt`.
    """
    pages = made_of_record(folder, record)
    functions = [(e.engine, e.function.name) for e in record.engines if e.function is not None]
    unchecked = [f"{e}: a user's function ({name}), whose code is not in the record" for e, name in functions]
    if not record.recordings:
        unchecked += [f"{e.engine}: {LOST}" for e in record.engines if e.cause is not None]
        return replace(pages, unchecked=tuple(unchecked))
    carried = "" if record.model.file is None else record.model.file.path
    written = (carried, *WRITTEN, *(r.path for r in record.recordings))
    problems, undecided, unchecked = [*_odd_recordings(record)], list[str](), [*NEVER, *unchecked]
    if problems:
        return Reproduced({}, {}, problems=tuple(problems), written=written)
    given = [read_arrays(folder / r.path, r.name, r.version, r.facts) for r in record.recordings]
    with rebuilt(folder, record, models) as model:
        compared = compare_recordings(model, given)
        rows = [e for e in record.engines if not e.jacobians]
        names = [[e.engine for e in engines] for engines in (rows, compared.engines)]
        if names[0] != names[1]:
            problems.append(f"{record.FILE}: its recordings are {names[0]}, but the repeated comparison has {names[1]}")
            return Reproduced({}, {}, problems=tuple(problems), written=written)
        problems += _odd_files(folder, record, compared.recordings)
        uses = () if record.data is None else record.data.judged_on
        motion = next((use.sha256 for use in uses if use.name == MOTION), None)
        is_same_motion = motion == hash_of_arrays(compared.x0, compared.us)
        if not is_same_motion:
            unchecked.append("engines[...].final_gap of recordings: the motion starts from another state")
        fields, engines = _of_the_model(record, model), list[dict[str, Any]]()
        for row, now, recording in zip(rows, compared.engines, compared.recordings, strict=True):
            cause = None
            if row.cause is not None:
                cause, doubts = as_recorded(row.engine, row.cause, cause_of(model, recording))
                undecided += doubts
            made = row_of(now, cause)
            made = made if is_same_motion else made.model_copy(update={"final_gap": row.final_gap})
            engines.append({"name": row.engine, **made.model_dump(mode="json")})
    dumped = record.model_dump(mode="json")
    content = [{"name": row.engine, **row.model_dump(mode="json")} for row in rows]
    return Reproduced(
        {**fields, **pages.fields, "engines": engines},
        pages.files,
        problems=tuple(problems),
        undecided=tuple(undecided),
        unchecked=tuple(unchecked),
        written=written,
        recorded={**{key: dumped[key] for key in (*fields, *pages.fields)}, "engines": content},
    )


def _odd_recordings(record: ComparisonRecord) -> Iterator[str]:
    """Yield the problems with recordings that cannot occur in a record from drake_diff."""
    names = [r.name for r in record.recordings]
    for i, r in enumerate(record.recordings):
        if r.path != place_of(i) or r.path not in record.files:
            yield f"{record.FILE}: the path of recording {r.name} is not the one that drake_diff writes"
    for e in record.engines:
        if e.cause is not None and (e.jacobians or names.count(e.engine) != 1):
            yield f"{record.FILE}: {e.engine} has a cause, but does not name exactly one recording in the directory"


def _of_the_model(record: ComparisonRecord, model: Model) -> dict[str, Any]:
    """Return the record's fields about the model, recomputed for the model in the directory."""
    changed: dict[str, Any] = {
        "model": model_input(model),
        "contract": contract_of(model),
        "time_step_s": model.time_step,
        "state_names": list(model.state_names),
        "input_names": list(model.input_names),
    }
    fields = as_given(record.model_copy(update=changed), record).model_dump(mode="json")
    return {key: fields[key] for key in changed}


def _odd_files(folder: Path, record: ComparisonRecord, given: Sequence[Recording]) -> Iterator[str]:
    """Yield the contradictions of other files and of data hashes with the recordings in the directory."""
    used = {(use.name, use.sha256) for use in record.data.judged_on} if record.data is not None else set()
    log = read_mcap(folder / TRACE, links=False)
    places = [i for i, e in enumerate(record.engines) if not e.jacobians]
    for i, recording in zip(places, given, strict=True):
        stored = next(r for r in record.recordings if r.name == recording.name)
        if len(recording.times) != stored.samples:
            yield f"{stored.path}: {len(recording.times)} samples, but {record.FILE} has {stored.samples}"
        times = recording.times - recording.times[0]
        if (recording.name, hash_of_arrays(times, recording.xs, recording.us)) not in used:
            yield f"{stored.path}: the recording differs from the compared one in {record.FILE}"
        motion = log.arrays(f"/{slug(i, recording.name)}/state")
        if not np.array_equal(np.hstack([motion["q"], motion["v"]]), recording.xs):
            yield f"{TRACE}: the motion of {recording.name} differs from {stored.path}"


def as_recorded(name: str, recorded: CauseEvidence, repeated: CauseEvidence) -> tuple[CauseEvidence, list[str]]:
    """Return the recorded cause if the repeated one agrees within SAME_VALUE, else the repeated one; and doubts.

    A result is in doubt if a search reached its processor time limit, as no run reproduces that.
    """
    if recorded == repeated or _is_same(recorded, repeated):
        return recorded, []
    if ENDED in recorded.sentence or ENDED in repeated.sentence:
        why = "a search that reached its limit of processor time is not reproducible"
        return recorded, [f"{name}: recorded {recorded.sentence!r}, recomputed {repeated.sentence!r}: {why}"]
    return repeated, []


def _is_same(recorded: CauseEvidence, repeated: CauseEvidence) -> bool:
    """Return whether words agree exactly, values and intervals within SAME_VALUE, and numbers in texts to rounding."""
    for name in ("names", "alternatives", "explained"):
        if getattr(recorded, name) != getattr(repeated, name):
            return False
    tables = (recorded.values, repeated.values, recorded.intervals, repeated.intervals)
    if any(table.keys() != repeated.intervals.keys() for table in tables):
        return False
    for name, intervals in repeated.intervals.items():
        numbers = (recorded.values.get(name, []), repeated.values.get(name, []), recorded.intervals[name], intervals)
        for old, new, old_ends, ends in zip_longest(*numbers):
            pairs = [(old, new), *zip_longest(old_ends or [], ends or [])]
            known = [end for end in ends or [] if end is not None]
            least = SAME_VALUE * abs(known[1] - known[0]) / 2 if len(known) == 2 else 0.0
            if not all(_is_near(a, b, least) for a, b in pairs):
                return False
    texts = recorded.sentence, repeated.sentence
    if NUMBER.split(texts[0]) != NUMBER.split(texts[1]):
        return False
    digits = zip(*(map(float, NUMBER.findall(text)) for text in texts), strict=True)
    return all(a == b or abs(a - b) <= SAME_DIGIT * _fourth_digit(max(abs(a), abs(b))) for a, b in digits)


def _is_near(a: float | None, b: float | None, least: float) -> bool:
    return a is b if a is None or b is None else is_near(a, b, absolute=ABSOLUTE + least)


def _fourth_digit(value: float) -> float:
    return float(10.0 ** (math.floor(math.log10(value)) - 3))


def cause_of(model: Model, recording: Recording) -> CauseEvidence:
    """Find the smallest change of the model that explains a recording, or say why none was searched for.

    Args:
        model: The model.
        recording: A motion of the model.

    Returns:
        Names, values and 95 % intervals of the changed quantities, and a sentence.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> log = dd.Recording("lab", "1", [0.0, 0.01], [[1.0, 0.0], [0.99, -0.1]], [[0.0]])
        >>> from drake_diff.identification import cause_of
        >>> cause_of(model, log).sentence[:38]
        'No cause was looked for: recording lab'
    """
    try:
        explanation = explain(model, recording)
    except DrakeDiffError as error:
        sentence = f"No cause was looked for: {error}"
        return CauseEvidence(names=[], values={}, intervals={}, alternatives=[], explained=False, sentence=sentence)
    return CauseEvidence(
        names=list(explanation.names),
        values={name: plain(np.atleast_1d(value)) for name, value in explanation.values.items()},
        intervals={name: plain(np.atleast_2d(ends)) for name, ends in explanation.intervals.items()},
        alternatives=[list(names) for names in explanation.alternatives],
        explained=explanation.explained,
        sentence=explanation.sentence,
    )

"""The recordings of a comparison compared with Drake's steps once more, and their causes looked for again.

A cause is found by a search that ends where its last step would gain no more than 1e-5 of the squares, in units of the
noise. So a search that takes other steps, as on a machine that rounds otherwise, ends within sqrt(1e-5) of a standard
deviation, 0.0016 of half a 95 % interval.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.untrusted import read_plain
from drake_diff.artifact.again import contract_as, model_as
from drake_diff.artifact.differences import ABSOLUTE, NUMBER, Compared, compare_fields, is_near, leaves
from drake_diff.artifact.rerun import rebuilt
from drake_diff.comparison.files import MOTION, PAGE, REPLAY, TRACE, hash_of_arrays, row_of
from drake_diff.comparison.recordings import Recording, place_of, read_arrays
from drake_diff.comparison.result import slug
from drake_diff.comparison.side_by_side import compare_recordings
from drake_diff.identification.cause import cause_of
from drake_diff.logs.mcap_file import read_mcap
from drake_diff.model.model import Model
from drake_diff.record.comparison import CauseEvidence, ComparisonRecord, Numbers
from drake_diff.record.embodiment import embodiment_of
from drake_diff.record.provenance import model_input

SAME_VALUE = 2e-3  # of half the interval: see above
SAME_DIGIT = 1.01  # of the last digit in a text: a number that lies between two is rounded to either
ENDED = "The search was ended after"  # in the sentence of a cause: by the limit of processor time, which no run repeats
WRITTEN = (TRACE, REPLAY, PAGE)
NEVER = (  # what is not checked
    "model and recordings: they are what was asked, and whether a robot moved so is for who recorded it",
    "all but the recordings, and the sentence of the whole, pages and frames: the engines were not run again",
)


@dataclass
class RecordingsAgain:
    """What came out of the recordings of a comparison."""

    compared: Compared
    problems: list[str] = field(default_factory=list)
    undecided: list[str] = field(default_factory=list)
    unchecked: list[str] = field(default_factory=list)


def recordings_again(folder: Path, record: ComparisonRecord, models: Path | None) -> RecordingsAgain:
    """The rows and causes of a record's recordings beside the same made again from the directory alone.

    ArtifactError where the directory does not have what the record says; ModelError where the model cannot be rebuilt,
    `models` as in `rebuilt`.
    """
    again = RecordingsAgain(Compared(record.FILE), [*_odd_recordings(record)])
    if again.problems:
        return again
    given = [read_arrays(folder / r.path, r.name, r.version, r.facts) for r in record.recordings]
    carried = "" if record.model.file is None else record.model.file.path
    attachments = {carried: read_plain(folder / carried)} if carried in record.files else None
    with rebuilt(record.model, record.contract.get("source"), attachments, models) as model:
        _compare_model(again.compared, record, model)
        found = compare_recordings(model, given)
        rows = [e for e in record.engines if not e.jacobians]
        names = [[e.engine for e in each] for each in (rows, found.engines)]
        if names[0] != names[1]:
            again.compared.differ("engines, the recordings among them", *names)
            return again
        again.problems += _odd_files(folder, record, found.recordings)
        known = _motion_hash(record) == hash_of_arrays(found.x0, found.us)
        if not known:
            again.unchecked.append("engines[...].final_gap of recordings: the motion began elsewhere")
        for row, now in zip(rows, found.engines, strict=True):
            spared = {"cause"} if known else {"cause", "final_gap"}
            both = [{row.engine: e.model_dump(mode="json", exclude=spared)} for e in (row, row_of(now, None))]
            compare_fields(again.compared, {"engines": both[0]}, {"engines": both[1]})
        for row, recording in zip(rows, found.recordings, strict=True):
            if row.cause is not None:
                compare_causes(again, row.engine, row.cause, cause_of(model, recording))
    return again


def _odd_recordings(record: ComparisonRecord) -> Iterator[str]:
    """What cannot be so in what drake_diff writes."""
    names = [r.name for r in record.recordings]
    for i, r in enumerate(record.recordings):
        if r.path != place_of(i) or r.path not in record.files:
            yield f"{record.FILE}: recording {r.name} is not where drake_diff keeps it"
    for e in record.engines:
        if e.cause is not None and (e.jacobians or names.count(e.engine) != 1):
            yield f"{record.FILE}: {e.engine} has a cause, and is not one recording in the directory"


def _compare_model(compared: Compared, record: ComparisonRecord, model: Model) -> None:
    """What the record says of the model beside the same of the model in the directory."""
    again: dict[str, Any] = {
        "model": model_as(model_input(model), record.model),
        "contract": contract_as(model.contract.to_dict(), record.contract),
        "embodiment": embodiment_of(model.contract),
        "time_step_s": model.time_step,
        "state_names": list(model.state_names),
        "input_names": list(model.input_names),
    }
    both = (record, record.model_copy(update=again))
    compare_fields(compared, *({key: each.model_dump(mode="json")[key] for key in again} for each in both))


def _odd_files(folder: Path, record: ComparisonRecord, given: Sequence[Recording]) -> Iterator[str]:
    """What in the other files, or of the hashes of data, is not of the recordings in the directory."""
    used = {(use.name, use.sha256) for use in record.data.judged_on} if record.data is not None else set()
    log, page = read_mcap(folder / TRACE, links=False), unescape(read_plain(folder / PAGE).decode())
    places = [i for i, e in enumerate(record.engines) if not e.jacobians]
    for i, recording in zip(places, given, strict=True):
        kept = next(r for r in record.recordings if r.name == recording.name)
        if len(recording.times) != kept.samples:
            yield f"{kept.path}: {len(recording.times)} samples, and {record.FILE} says {kept.samples}"
        times = recording.times - recording.times[0]
        if (recording.name, hash_of_arrays(times, recording.xs, recording.us)) not in used:
            yield f"{kept.path}: it is not the recording that {record.FILE} says was compared"
        motion = log.arrays(f"/{slug(i, recording.name)}/state")
        if not np.array_equal(np.hstack([motion["q"], motion["v"]]), recording.xs):
            yield f"{TRACE}: the motion of {recording.name} is not that in {kept.path}"
        cause = record.engines[i].cause
        if cause is not None and cause.sentence not in page:
            yield f"{PAGE}: it does not say what {record.FILE} says of the cause of {recording.name}"


def _motion_hash(record: ComparisonRecord) -> str | None:
    uses = () if record.data is None else record.data.judged_on
    return next((use.sha256 for use in uses if use.name == MOTION), None)


def compare_causes(again: RecordingsAgain, name: str, told: CauseEvidence, found: CauseEvidence) -> None:
    """A recorded cause beside the one that was found again: words exactly, numbers within SAME_VALUE."""
    key, compared = f"engines.{name}.cause", Compared(again.compared.file)
    compared.count = sum(1 for _ in leaves(found.model_dump(mode="json")))
    for part in ("names", "alternatives", "explained"):
        old, new = getattr(told, part), getattr(found, part)
        if old != new:
            compared.differ(f"{key}.{part}", old, new)
    for part in ("values", "intervals"):
        old, new = getattr(told, part), getattr(found, part)
        if old.keys() != new.keys():
            compared.differ(f"{key}.{part}", sorted(old), sorted(new))
            continue
        for quantity in sorted(new):
            allowed = _is_same(old[quantity], new[quantity], found.intervals.get(quantity, []))
            if old[quantity] != new[quantity]:
                compared.differ(f"{key}.{part}.{quantity}", old[quantity], new[quantity], allowed=allowed)
    if told.sentence != found.sentence:
        near = _is_same_sentence(told.sentence, found.sentence)
        compared.differ(f"{key}.sentence", told.sentence, found.sentence, allowed=near)
    again.compared.count += compared.count
    for d in compared.differing:
        if not d.allowed and (ENDED in told.sentence or ENDED in found.sentence):
            again.undecided.append(f"{d}: a search that its limit of processor time ends is not repeated")
        else:
            again.compared.differing.append(d)


def _is_same(told: Any, found: Any, intervals: Sequence[Numbers]) -> bool:
    """Whether the numbers of a value, or both ends of each interval, are those found again."""
    if len(told) != len(found) or len(found) != len(intervals):
        return False
    for old, new, ends in zip(told, found, intervals, strict=True):
        low, high = (None, None) if len(ends) != 2 else ends
        least = 0.0 if low is None or high is None else SAME_VALUE * abs(high - low) / 2
        pairs = zip(old, new, strict=True) if isinstance(old, list) and isinstance(new, list) else ((old, new),)
        for a, b in pairs:
            if a is None or b is None:
                if a is not b:
                    return False
            elif not is_near(a, b, absolute=ABSOLUTE + least):
                return False
    return True


def _is_same_sentence(told: str, found: str) -> bool:
    """Whether two sentences have the same words, and numbers that are the same but for the fourth digit's rounding."""
    if NUMBER.split(told) != NUMBER.split(found):
        return False
    pairs = [(float(a), float(b)) for a, b in zip(NUMBER.findall(told), NUMBER.findall(found), strict=True)]
    return all(a == b or abs(a - b) <= SAME_DIGIT * _fourth_digit(max(abs(a), abs(b))) for a, b in pairs)


def _fourth_digit(value: float) -> float:
    return float(10.0 ** (math.floor(math.log10(value)) - 3))

"""Make the directory of a solve again, from what its record and its plan say was asked, to be compared with it.

The search is run again too, as `solve` was called. Where its plan comes out to the last bit, everything but the wall
clock and the machine that made the record is there again. On a machine that rounds otherwise the search may take other
steps to the same end: then the recorded plan is measured, and what the search tells of itself is compared apart.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.model.model import Model
from drake_diff.optimize.solution import Solution, Status
from drake_diff.runs.cross_check import NOT_INSTALLED, SIMULATORS, cross_check
from drake_diff.runs.fields import ModelInput
from drake_diff.runs.measurement import measure
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.rerun import PLAN, plan_fields, resolve, solve_again
from drake_diff.runs.save import RECOVERED, REPLAY, REPORT, record_of, write_files
from drake_diff.runs.sections import COSTS, unknown_functions

# What a record says of itself and of where it was made: nothing can make it again.
GIVEN = ("name", "provenance", "wall_clock")
# What the search tells of itself: it rests on the search, and not on the plan that it found alone.
SEARCHED = ("data", "events", "failures", "gradient", "inputs", "sentence", "solver", "verdict")
SEARCH_TOPICS = ("/solver/", "/gradient/", "/events", "/replays")
# What a constraint that is a user's function decides, beside the search.
CONSTRAINED = ("metrics[constraint violation]", "problem.constraints", "problem.couplings")
JUDGED = ("holds", "failures")  # of each replay
SAME_PLAN = 1e-6  # of the largest number of its array: plans that are no further apart are the same
OF_RECOVERED = (
    "the run was recovered from one that was killed or failed, so whether a search ends at this plan, and what it told "
    "of itself, cannot be judged"
)
NOT_REPEATED = {
    Status.TIME_LIMIT: "how far a search gets within its time limit is another on every run",
    Status.INTERRUPTED: "the search was interrupted, at no moment that could be found again",
}


@dataclass(frozen=True)
class Again:
    """The files of a run made again: the record's fields, and the bytes of the others by name.

    `apart` is how far the plan of the search is from the recorded one, relative, 0 where they are the same to the last
    bit; `unrepeated` says why the search was not run again, and `missing` which keys of the record rest on that.
    `unchecked` are parts of the record that could not be measured on this machine, and stand as they are recorded.
    `problems` are contradictions between the files of the directory, `undecided` what cannot be judged, `written` the
    files that drake_diff writes there. `recorded` are the fields to compare with, where not all are compared.
    """

    fields: dict[str, Any]
    files: dict[str, bytes]
    apart: float = 0.0
    unrepeated: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    undecided: tuple[str, ...] = ()
    written: tuple[str, ...] = ()
    recorded: dict[str, Any] | None = None


def why_not_repeated(record: PlanRecord) -> tuple[str, ...]:
    """Why the search of a record cannot be run again; nothing where it can."""
    costs, constraints = unknown_functions(record)
    found = [f"{cost} is a user's function" for cost in costs]
    found += [f"constraint {name} is a user's function" for name in constraints]
    if record.inputs.search is None:
        recovered = record.sentence.endswith(RECOVERED)
        found.append(OF_RECOVERED if recovered else "the record does not say what solve was called with")
    status = None if record.solver is None else Status(record.solver.status)
    return (*found, *([NOT_REPEATED[status]] if status in NOT_REPEATED else []))


def made_again(record: PlanRecord, model: Model, plan: dict[str, Array]) -> Again:
    """The run of `record` and `plan` on `model`, once more. ArtifactError where they do not go together."""
    told = resolve(record, model, plan)
    unrepeated = why_not_repeated(record)
    if unrepeated:
        return _without_the_search(told, record, unrepeated)
    found = solve_again(record, model, plan)
    apart = apart_from(found, told)
    if apart == 0:
        return _written(found, record, 0.0)
    if apart == np.inf or (found.method, found.scheme, found.solver) != (told.method, told.scheme, told.solver):
        ended = f"run again, it ends by {found.method} ({found.scheme}) in {len(found.us)} intervals at another plan"
        return _without_the_search(told, record, (ended,))
    return _written(replace(found, **plan_fields(plan)), record, apart)


def apart_from(found: Solution, told: Solution) -> float:
    """How far two plans are apart, relative to the largest number of each array; inf where their shapes differ."""
    return _apart(found, told) if _shapes(found) == _shapes(told) else float("inf")


def _shapes(solution: Solution) -> list[Any]:
    return [np.shape(value) for value in _arrays(solution).values()]


def _arrays(solution: Solution) -> dict[str, Any]:
    names = ("xs", "us", "us_mid", "u_final", "mesh", "free_horizon")
    return {**{name: getattr(solution, name) for name in names}, "parameters": solution.vector.values}


def _apart(found: Solution, told: Solution) -> float:
    """How far two plans of the same shapes are apart, each array relative to its largest number; 0 to the last bit."""
    largest = 0.0
    for one, other in zip(_arrays(found).values(), _arrays(told).values(), strict=True):
        if one is None or np.array_equal(one, other, equal_nan=True):
            continue
        a, b = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
        with np.errstate(all="ignore"):
            distance = np.nanmax(np.abs(a - b)) / max(float(np.nanmax(np.abs(b))), 1e-300)
        same_gaps = np.array_equal(np.isfinite(a), np.isfinite(b))
        largest = max(largest, float(distance) if same_gaps else np.inf, np.finfo(float).tiny)
    return largest


def _written(solution: Solution, record: PlanRecord, apart: float) -> Again:
    """All files of `solution`, made in a folder of their own."""
    engines = None if record.solver is None else record.solver.options.get("cross_check")
    if isinstance(engines, list):
        solution = cross_check(solution, [str(name) for name in engines])
    with TemporaryDirectory() as folder:
        place, measurement = Path(folder), measure(solution)
        again, unchecked = _but_for_simulators(_as_given(record_of(measurement, place), record), record)
        write_files(place, measurement, again)
        files = {path.name: path.read_bytes() for path in place.iterdir()}
    return Again(again.model_dump(mode="json"), files, apart, unchecked=unchecked)


def _but_for_simulators(again: PlanRecord, record: PlanRecord) -> tuple[PlanRecord, tuple[str, ...]]:
    """With what `record` says of simulators that are not installed here, or were not there, and which these are."""

    def by_plant(rows: Sequence[Any]) -> dict[str, list[Any]]:
        return {name: [r for r in rows if r.variant.startswith(f"in {name}")] for name in SIMULATORS}

    here, there = by_plant(again.replays), by_plant(record.replays)
    rows, unchecked = list(again.replays), list[str]()
    for name in SIMULATORS:
        lacking = [
            side
            for side in (here, there)
            if any(r.failures[0].startswith(NOT_INSTALLED) for r in side[name] if r.failures)
        ]
        if len(lacking) == 1:
            rows = [r for r in rows if r not in here[name]] + there[name]
            where = "was not installed where the record was made" if lacking[0] is there else "is not installed here"
            unchecked.append(f"replays in {name}, which {where}")
    if not unchecked:
        return again, ()
    return again.model_copy(update={"replays": rows, "panel": record.panel}), tuple(unchecked)


def _as_given(again: PlanRecord, record: PlanRecord) -> PlanRecord:
    """With what nothing can make again as `record` says it."""
    contract, model = contract_as(again.contract, record.contract), model_as(again.model, record.model)
    given = {name: getattr(record, name) for name in (*GIVEN, "files", "record_sha256")}
    return again.model_copy(update={**given, "contract": contract, "model": model})


def model_as(again: ModelInput, recorded: ModelInput) -> ModelInput:
    """The input of a model that was loaded again, with the folders of its packages as they were given."""
    if again.options is None or recorded.options is None or "packages" not in recorded.options:
        return again
    return again.model_copy(update={"options": {**again.options, "packages": recorded.options["packages"]}})


def contract_as(again: Mapping[str, Any], recorded: Mapping[str, Any]) -> dict[str, Any]:
    """The contract of a model that was loaded again, with its file where it was; its notes name that place too."""
    source, was = str(again.get("source")), recorded.get("source")
    return {**again, "source": was, "notes": [str(note).replace(source, str(was)) for note in again["notes"]]}


def _without_the_search(told: Solution, record: PlanRecord, unrepeated: tuple[str, ...]) -> Again:
    """What can be made of the plan alone; what rests on the search is left out of the comparison."""
    again = _written(told, record, 0.0)
    costs, constraints = unknown_functions(record)
    missing = [*SEARCHED]
    missing += [f"replays[{i}].{key}" for i in range(len(record.replays) if constraints else 0) for key in JUDGED]
    if costs:
        missing += ["metrics[cost]", *(f"problem.{name}" for name in COSTS)]
    if constraints:
        missing += CONSTRAINED
    files = {name: data for name, data in again.files.items() if name not in (PLAN, REPLAY, REPORT)}
    return replace(again, files=files, unrepeated=unrepeated, missing=tuple(missing))


def is_below(key: str, sections: Sequence[str]) -> bool:
    """Whether a key of a record is one of `sections`, or in one."""
    return any(key == part or key.startswith((f"{part}.", f"{part}[")) for part in sections)

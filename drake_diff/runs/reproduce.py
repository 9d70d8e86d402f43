"""Reproduce a run directory from its plan and the inputs in its record, to compare the two.

The search is repeated too, with the recorded arguments of `solve`. If its plan is bitwise equal, everything except the
wall clock and the machine data is reproduced. On a machine that rounds differently the search may take other steps to
the same optimum. Then the recorded plan is measured, and the claims about the search are compared separately.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.optimize.phased import PhasedSolution
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.replay import OPEN_LOOP
from drake_diff.optimize.solution import Solution, Status
from drake_diff.runs.certificates import certify_model
from drake_diff.runs.cross_check import NOT_INSTALLED, SIMULATORS, cross_check
from drake_diff.runs.differences import Reproduced, is_near
from drake_diff.runs.directory import read_checked
from drake_diff.runs.fields import SealedRecord, finite, read_fields, reproducible
from drake_diff.runs.plan_record import CertificationSection, PhasesSection, PlanRecord
from drake_diff.runs.rebuild import (
    OPTIONAL,
    PLAN,
    REQUIRED,
    TRACE,
    phase_records,
    read_plan,
    rebuilt,
    recorded_solution,
    search_of,
    solve_again,
)
from drake_diff.runs.save import RECOVERED, REPLAY, REPORT, phases_in, write_measured
from drake_diff.runs.sections import COSTS, numbers_of, unknown_functions
from drake_diff.runs.trace import read_trace

# Fields about the record itself and its machine, which cannot be reproduced.
AnyRecord = TypeVar("AnyRecord", bound=SealedRecord)
GIVEN = ("name", "provenance", "wall_clock")
# Keys that depend on the search, and not only on the plan that it found, of a record and of one in phases.
SEARCHED = (
    *("events", "failures", "gradient", "inputs", "sentence", "solver", "verdict"),
    *("phases.search", "phases.initial_guess", "phases.phases"),
)
SEARCH_TOPICS = ("/solver/", "/gradient/", "/events", "/replays")
# Keys that depend on constraints that are a user's functions, in addition to the search.
CONSTRAINED = ("metrics[constraint violation]", "problem.constraints", "problem.couplings")
JUDGED = ("holds", "failures")  # of each replay
OFFSETS_SINCE = 4  # the first schema version whose replays under TVLQR have offsets for finer steps
SAME_PLAN = 1e-6  # relative to the largest number of each array: plans within this distance count as equal
OF_RECOVERED = (
    "the run was recovered from one that was killed or failed, so that the end of its search and the search's own "
    "statements cannot be checked"
)
ROUNDED = 1e-12  # relative and absolute rounding error of the same sum on another machine
GIVEN_BY_USER = (
    "problem, model and inputs.search: they define the task, and a record of an easier task can be equally true"
)
# By subject, the modules in higher-level packages whose function `reproduce` reproduces the directory.
REPRODUCED_BY = {
    "fit": "drake_diff.identification.files",
    "comparison": "drake_diff.identification.recorded_causes",
    "panel": "drake_diff.panels.results",
    "robustness": "drake_diff.trials.files",
    "trial": "drake_diff.panels.results",
    "closed_loop": "drake_diff.loop.files",
}
NOT_REPEATED = {
    Status.TIME_LIMIT: "the result of a search that reached its time limit differs on every run",
    Status.INTERRUPTED: "the search was interrupted at a moment that cannot be repeated",
}


def reproduce(folder: Path, record: SealedRecord, models: Path | None) -> Reproduced | None:
    """Reproduce a directory from its inputs, or return None if nothing can be reproduced; `models` is as in `rebuilt`.

    Raises ArtifactError if its files contradict each other, and ModelError if its model cannot be rebuilt.
    """
    if record.subject in REPRODUCED_BY:
        made: Reproduced | None = import_module(REPRODUCED_BY[record.subject]).reproduce(folder, record, models)
        return made
    if not isinstance(record, PlanRecord):
        return None
    if record.certification is not None:
        return _certified(folder, record, record.certification, models)
    return _solved(folder, record, models) if record.subject in ("plan", "phases") else None


def _solved(folder: Path, record: PlanRecord, models: Path | None) -> Reproduced:
    """Reproduce a solve in one or several phases, and repeat its search if possible."""
    problems = tuple(contradictions(folder, record))
    if problems and record.phases is not None:  # no problem in phases can be built from contradictory files
        return Reproduced({}, {}, problems=problems, written=tuple(record.files))
    return replace(_run_again(folder, record, models), problems=problems)


def _run_again(folder: Path, record: PlanRecord, models: Path | None) -> Reproduced:
    records = {inner.relative_to(folder): phase for inner, phase in phase_records(folder, record)}
    records[Path()] = record
    with recorded_solution(folder, record, models) as recorded:
        reasons = why_not_repeated(record, records.values())
        if reasons:
            return _without_the_search(recorded, folder, records, reasons)
        solution = solve_again(record, recorded, read_plan(folder / PLAN) if record.phases is None else {})
        apart = max(_distance(s, r) for s, r in zip(solution.phases, recorded.phases, strict=True))
        if apart == 0:
            return _written(solution, folder, records, apart)
        ways = [(s.method, s.scheme, s.solver) for s in (solution, recorded)]
        if apart == np.inf or ways[0] != ways[1]:
            was, now = (f"{s.method} ({s.scheme}, {s.solver}) in {len(s.us)} intervals" for s in (recorded, solution))
            return _without_the_search(recorded, folder, records, (f"recorded by {was}, this version uses {now}",))
        return _written(_with_plan(solution, recorded), folder, records, apart)


def contradictions(folder: Path, record: PlanRecord) -> Iterator[str]:
    """Yield the contradictions between the files of a run."""
    phases = phase_records(folder, record)
    for inner, phase in phases:
        plan = read_plan(inner / PLAN)
        name = "" if record.phases is None else f"{inner.name}: "
        problems = () if record.phases is None else read_checked(inner / phase.FILE)[1]
        yield from (f"{name}{line}" for line in (*problems, *odd_trace(inner, plan, phase)))
    if record.phases is not None:
        plans = [read_plan(inner / PLAN)["xs"] for inner, _ in phases]
        yield from _odd_phases(record.phases, [phase for _, phase in phases], plans)


def _certified(folder: Path, record: PlanRecord, section: CertificationSection, models: Path | None) -> Reproduced:
    """Sample the same states from the same seed, and certify each of them again."""
    carried = record.model.file.path if record.model.file is not None else ""
    asked = {name: getattr(section, name) for name in ("seed", "parameters", "method")}
    with rebuilt(folder, record, models) as model:
        made = as_given(certify_model(model, states=len(section.states), **asked), record)
    return Reproduced(made.model_dump(mode="json"), {}, written=(carried,))


def odd_trace(folder: Path, plan: Mapping[str, Any], record: PlanRecord) -> Iterator[str]:
    """Yield the contradictions between the trace and record.json or plan.npz."""
    trace = read_trace(folder / TRACE)
    if trace.attachments.get(record.FILE) != reproducible(read_fields(folder / record.FILE)).encode():
        yield f"{TRACE}: the attached record differs from {record.FILE}"
    inputs = np.vstack([plan["us"], plan["u_final"]]) if "u_final" in plan else plan["us"]
    for topic, recorded, planned in (("state", trace.planned_xs, plan["xs"]), ("input", trace.planned_us, inputs)):
        if not np.array_equal(recorded, planned, equal_nan=True):
            yield f"{TRACE}: /planned/{topic} differs from {PLAN}"


def why_not_repeated(record: PlanRecord, records: Iterable[PlanRecord]) -> tuple[str, ...]:
    """Return the reasons why a search cannot be repeated, if any; `records` are the record and those of its phases."""
    functions = [unknown_functions(inner) for inner in records]
    reasons = [f"{cost} is a user's function" for costs, _ in functions for cost in costs]
    reasons += [f"constraint {name} is a user's function" for _, constraints in functions for name in constraints]
    if search_of(record) is None:
        recovered = record.sentence.endswith(RECOVERED)
        reasons.append(OF_RECOVERED if recovered else "the record does not have the arguments of solve")
    reasons += [f"the reset {name} is a user's function" for name in _unknown_resets(record)]
    if record.phases is not None and record.phases.initial_guess is not None:
        reasons.append("the search began from an initial guess that is not in the directory")
    status = None if record.solver is None else Status(record.solver.status)
    return (*reasons, *([NOT_REPEATED[status]] if status in NOT_REPEATED else []))


def _unknown_resets(record: PlanRecord) -> list[str]:
    return [] if record.phases is None else [link.told for link in record.phases.links if link.reset is None]


def _with_plan(solution: Solution, recorded: Solution) -> Solution:
    """Return the result of a search with the recorded plan."""
    if isinstance(solution, PhasedSolution):
        phases = tuple(_with_plan(s, r) for s, r in zip(solution.phases, recorded.phases, strict=True))
        return replace(solution, phases=phases, xs=recorded.xs, us=recorded.us)
    return replace(solution, **{name: getattr(recorded, name) for name in (*REQUIRED, *OPTIONAL)})


def _distance(solution: Solution, other: Solution) -> float:
    """Return the largest relative distance of the arrays of two plans, or inf if their shapes differ."""
    names, largest = ("xs", "us", "us_mid", "u_final", "mesh", "free_horizon"), 0.0
    pairs = [(getattr(solution, name), getattr(other, name)) for name in names]
    for first, second in (*pairs, (solution.vector.values, other.vector.values)):
        if np.shape(first) != np.shape(second):
            return np.inf
        if first is None or np.array_equal(first, second, equal_nan=True):
            continue
        a, b = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
        with np.errstate(all="ignore"):
            distance = np.nanmax(np.abs(a - b)) / max(float(np.nanmax(np.abs(b))), 1e-300)
        same_gaps = np.array_equal(np.isfinite(a), np.isfinite(b))
        largest = max(largest, float(distance) if same_gaps else np.inf, np.finfo(float).tiny)
    return largest


def _written(solution: Solution, folder: Path, records: Mapping[Path, PlanRecord], apart: float) -> Reproduced:
    """Write the files of `solution` to a temporary folder and read them; `records` are those in `folder` by path."""
    solver, unchecked = records[Path()].solver, list[str]()
    engines = None if solver is None else solver.options.get("cross_check")
    if isinstance(engines, list):
        solution = cross_check(solution, [str(name) for name in engines])
    with TemporaryDirectory() as made:
        location = Path(made)

        def amend(again: PlanRecord, made: Path) -> tuple[PlanRecord, dict[str, Any]]:
            inner = made.relative_to(location)
            recorded = records[inner]
            again, lacking = _but_for_simulators(as_given(again, recorded), recorded)
            unchecked.extend(lacking)
            if recorded.is_before(OFFSETS_SINCE):
                then = {metric.name: metric.tolerance for metric in recorded.metrics}  # some tolerances were absolute
                shared = [metric for metric in again.metrics if metric.name in then]
                metrics = [metric.model_copy(update={"tolerance": then[metric.name]}) for metric in shared]
                replays = _open_loop_alone(again.replays, recorded.replays)
                again = again.model_copy(update={"replays": replays, "metrics": metrics})
                unchecked.append(f"replays under TVLQR, which had no offsets in version {recorded.schema_version}")
                return again, again.content()
            return again, as_written(again.content(), read_fields(folder / inner / PlanRecord.FILE))

        fields: dict[str, Any] = {}
        if _unknown_resets(records[Path()]):  # the link between two phases is a function that is not stored
            for inner, phase in phases_in(location, solution):
                write_measured(phase, inner, amend)
        else:
            fields = write_measured(solution, location, amend).model_dump(mode="json")
        paths = [path for path in location.rglob("*") if path.is_file()]
        files = {path.relative_to(location).as_posix(): path.read_bytes() for path in paths}
    for name in (PlanRecord.FILE, PlanRecord.SCHEMA_FILE):
        files.pop(name, None)
    return Reproduced(fields, files, apart, unchecked=(GIVEN_BY_USER, *unchecked), written=tuple(files))


def _but_for_simulators(again: PlanRecord, record: PlanRecord) -> tuple[PlanRecord, tuple[str, ...]]:
    """Copy the replays of simulators that were or are not installed from `record`, and name these simulators."""
    unchecked = list[str]()
    for name in SIMULATORS:
        sides = [[r for r in side.replays if r.variant.startswith(f"in {name}")] for side in (again, record)]
        here, there = (any(r.failures[0].startswith(NOT_INSTALLED) for r in rows if r.failures) for rows in sides)
        if here != there:
            others = [r for r in again.replays if r not in sides[0]]
            again = again.model_copy(update={"replays": [*others, *sides[1]]})
            where = "was not installed where the record was made" if there else "is not installed on this machine"
            unchecked.append(f"replays in {name}, which {where}")
    return again, tuple(unchecked)


def _open_loop_alone(again: Sequence[Any], recorded: Sequence[Any]) -> list[Any]:
    """Return the new open-loop replays and the recorded replays under feedback."""
    taken = {r.variant: r for r in again if r.control == OPEN_LOOP}
    return [taken.get(r.variant, r) if r.control == OPEN_LOOP else r for r in recorded]


def as_given(again: AnyRecord, record: AnyRecord) -> AnyRecord:
    """Return `again` with the fields that cannot be reproduced copied from `record`."""
    given = {name: getattr(record, name) for name in GIVEN}
    if not record.is_before(OFFSETS_SINCE):  # an earlier minor version only lacks fields
        given["schema_version"] = record.schema_version
    if record.is_before(4, 1):  # such a record lists fewer files, which `rebuilt` has checked
        given |= {"model": record.model, "contract": _contract_with_paths(again, record)}
    made = again.model_copy(update=given)
    if not (isinstance(made, PlanRecord) and isinstance(record, PlanRecord) and made.phases and record.phases):
        return made
    links = [  # records of 2.x lack the values of an impact
        link.model_copy(update={"reset": was.reset}) if was.reset == {"impact": {}} else link
        for link, was in zip(made.phases.links, record.phases.links, strict=True)
    ]
    return made.model_copy(update={"phases": made.phases.model_copy(update={"links": links})})


def _contract_with_paths(made: SealedRecord, record: SealedRecord) -> dict[str, Any]:
    """Return the contract in `made`; before version 4.1 it and its notes contain the model file's path."""
    again, recorded = (side.model_dump().get("contract") or {} for side in (made, record))
    source = recorded.get("source")
    if not again or source is None:
        return again
    name = Path(source).name
    paths = re.compile(rf"{re.escape(source)}|[^\s'\"(]*/{re.escape(name)}")
    notes = [paths.sub(lambda _: name, str(note)) for note in recorded["notes"]]
    return {**again, "source": source, "notes": recorded["notes"] if notes == again["notes"] else again["notes"]}


def as_written(fields: Any, recorded: Any) -> Any:
    """Remove the empty fields that the version of the recorded fields does not have."""
    if not (isinstance(fields, dict) and isinstance(recorded, dict)):
        return fields
    known = {key: value for key, value in fields.items() if key in recorded or value not in (None, [], {}, "")}
    return {key: as_written(value, recorded.get(key)) for key, value in known.items()}


def _without_the_search(
    recorded: Solution, folder: Path, records: Mapping[Path, PlanRecord], unrepeated: tuple[str, ...]
) -> Reproduced:
    """Reproduce a directory from its plan alone, without the parts that depend on the search."""
    again = _written(recorded, folder, records, 0.0)
    missing = [*SEARCHED]
    for record in records.values():
        costs, constraints = unknown_functions(record)
        if costs:
            missing += ["metrics[cost]", "metrics[cost error]", "phases.cost", *(f"problem.{name}" for name in COSTS)]
        if constraints:
            missing += [*CONSTRAINED, *(f"replays[{i}].{key}" for i in range(len(record.replays)) for key in JUDGED)]
        if record.phases is not None:
            missing += [f"phases.links[{i}].certificate" for i in range(len(record.phases.links))]
    files = {n: data for n, data in again.files.items() if Path(n).name not in (PLAN, REPLAY, REPORT)}
    return replace(again, files=files, unrepeated=unrepeated, missing=tuple(missing))


def is_below(key: str, sections: Sequence[str]) -> bool:
    """Return whether a key of a record is one of `sections`, or below one of them."""
    return any(key == section or key.startswith((f"{section}.", f"{section}[")) for section in sections)


def _turned(record: PlanRecord, x: Array, wanted: Array) -> Array:
    """Return x (nx,) with quaternions of the norms and signs in `wanted`; the orientations are unchanged."""
    contract: dict[str, Any] = dict(record.contract)
    turned, positions = np.array(x), contract.get("positions", ())
    for i in (i for i, position in enumerate(positions) if position["name"].endswith("_qw")):
        q, wanted_q = turned[i : i + 4], wanted[i : i + 4]
        if not np.isnan(wanted_q).any():
            q *= np.copysign(np.linalg.norm(wanted_q) / np.linalg.norm(q), q @ wanted_q)
    return turned


def odd_metrics(record: PlanRecord, plan: dict[str, Array]) -> Iterator[str]:
    """Yield the metrics that contradict the plan, as far as that can be checked without the dynamics."""
    p: dict[str, Any] = dict(record.problem)
    metrics = {metric.name: metric.value for metric in record.metrics}
    xs = plan["xs"]
    goal, start = numbers_of(p["x_goal"], np.nan), numbers_of(p["x0"], np.nan)
    start[np.array(p["initial_state_free"], dtype=bool)] = np.nan
    end = _turned(record, xs[-1], goal)
    for name, x, wanted in (("goal error", end, goal), ("initial state error", xs[0], start)):
        recorded, again = metrics.get(name), finite(float(np.max(np.abs(x - wanted)[~np.isnan(wanted)], initial=0.0)))
        if (recorded is None) != (again is None) or abs((recorded or 0.0) - (again or 0.0)) > ROUNDED * max(
            1.0, again or 0.0
        ):
            yield f"{record.FILE}: metrics[{name}] is {recorded}, but the plan gives {again}"
    us = np.vstack([plan[name] for name in ("us", "us_mid", "u_final") if name in plan])
    later = xs[1:] if np.all(np.isfinite(start)) else xs
    beyond = [numbers_of(p["u_lower"], -np.inf) - us, us - numbers_of(p["u_upper"], np.inf)]
    beyond += [numbers_of(p["x_lower"], -np.inf) - later, later - numbers_of(p["x_upper"], np.inf)]
    least = max(float(np.max(excess, initial=0.0)) for excess in beyond)
    recorded = metrics.get("bound violation")
    if recorded is not None and not recorded >= least - ROUNDED:  # the plan does not contain the midpoint states
        yield f"{record.FILE}: metrics[bound violation] is {recorded}, but the plan gives at least {least:.6g}"


def _odd_phases(section: PhasesSection, records: Sequence[PlanRecord], plans: Sequence[Array]) -> Iterator[str]:
    """Yield contradictions between the record of all phases, those of its phases, and their plans, without dynamics."""
    file, count, links = PlanRecord.FILE, len(records), [(link.before, link.after) for link in section.links]
    if links not in ([(i, i + 1) for i in range(count - 1)], [(i, (i + 1) % count) for i in range(count)]):
        yield f"{file}: phases.links is {links}, which is not a chain of {count} phases"
        return
    for phase, inner in zip(section.phases, records, strict=True):
        metrics = {metric.name: metric.value for metric in inner.metrics}
        expected = (inner.solver and inner.solver.status, metrics.get("cost"), metrics.get("horizon"))
        if (phase.status, phase.cost, phase.duration) != expected:
            yield f"{file}: status, cost and duration of {phase.name} differ from {expected} in {phase.directory}"
    total, duration = (sum(getattr(p, name) or 0.0 for p in section.phases) for name in ("cost", "duration"))
    lower, upper = section.horizon_s or (0.0, np.finfo(float).max)
    converged = all(phase.status == "converged" for phase in section.phases)
    slack = FEASIBILITY_TOLERANCE * duration
    if converged and not lower - slack <= duration <= upper + slack:
        yield f"{file}: phases.horizon_s is {section.horizon_s}, but the phases take {duration!r} s"
    if section.cost is not None and not is_near(section.cost, total, ROUNDED, ROUNDED):
        yield f"{file}: phases.cost is {section.cost!r}, but the phases cost {total!r}"
    for i, link in enumerate(section.links):
        before, after = plans[link.before][-1], plans[link.after][0]
        if not link.reset or "impact" in link.reset:
            continue
        matrix: Any = link.reset.get("matrix")
        reset = np.array(matrix["rows"], dtype=float) if isinstance(matrix, dict) else np.eye(len(before))
        recorded = numbers_of(link.errors, np.nan)
        errors = np.abs(after - reset @ before)
        if not np.allclose(recorded, errors, rtol=ROUNDED, atol=ROUNDED, equal_nan=True):
            yield f"{file}: phases.links[{i}].errors is {link.errors}, but the plans give {errors.tolist()}"

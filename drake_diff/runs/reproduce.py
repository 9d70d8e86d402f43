"""Reproduce a directory from what its record and its plan say was asked, to be compared with it.

A search is run again too, as `solve` was called. Where its plan comes out to the last bit, everything but the wall
clock and the machine that made the record is there again. On a machine that rounds otherwise the search may take other
steps to the same end: then the recorded plan is measured, and what the search tells of itself is compared apart.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.files import read_plain
from drake_diff.exceptions import ArtifactError, DrakeDiffError, ModelError
from drake_diff.model.model import Model
from drake_diff.optimize.options import Options
from drake_diff.optimize.phased import PhasedSolution
from drake_diff.optimize.problem.fixed_contacts import FixedContacts, Impact
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.solution import Search, Solution, Status
from drake_diff.optimize.solve import solve
from drake_diff.runs.certificates import certify_model
from drake_diff.runs.cross_check import NOT_INSTALLED, SIMULATORS, cross_check
from drake_diff.runs.differences import Reproduced, is_near
from drake_diff.runs.directory import load_plan_record
from drake_diff.runs.fields import ModelInput, SealedRecord, finite, read_fields, reproducible
from drake_diff.runs.measurement import measure
from drake_diff.runs.plan_record import CertificationSection, PhasesSection, PlanRecord
from drake_diff.runs.rebuild import PLAN, REMOVED, TRACE, plan_fields, read_plan, rebuilt, resolve, solve_again
from drake_diff.runs.save import (
    FILES,
    RECOVERED,
    REPLAY,
    REPORT,
    directory_of,
    record_of,
    record_of_phases,
    write_files,
)
from drake_diff.runs.sections import COSTS, unknown_functions
from drake_diff.runs.trace import Trace, read_trace

# What a record says of itself and of where it was made: nothing can make it again.
GIVEN = ("name", "provenance", "wall_clock")
# What the search tells of itself: it rests on the search, and not on the plan that it found alone.
SEARCHED = ("events", "failures", "gradient", "inputs", "sentence", "solver", "verdict")
SEARCH_TOPICS = ("/solver/", "/gradient/", "/events", "/replays")
# What a constraint that is a user's function decides, beside the search.
CONSTRAINED = ("metrics[constraint violation]", "problem.constraints", "problem.couplings")
JUDGED = ("holds", "failures")  # of each replay
# Keys of a solve in phases that rest on its search, beside SEARCHED.
SEARCHED_IN_PHASES = ("phases.search", "phases.initial_guess")
SAME_PLAN = 1e-6  # of the largest number of its array: plans that are no further apart are the same
OF_RECOVERED = (
    "the run was recovered from one that was killed or failed, so whether a search ends at this plan, and what it told "
    "of itself, cannot be judged"
)
ROUNDED = 1e-12  # of a number, and absolute: what the same sum may differ by on another machine
GIVEN_BY_USER = (
    "problem, model and inputs.search: they are what was asked; a record that asks for less can be just as true"
)
GIVEN_IN_PHASES = "in each phase's record problem and model, and here links and search: they are what was asked"
# The modules of packages above this one whose function `reproduce` makes such a directory again.
REPRODUCED_BY = {
    "fit": "drake_diff.identification.files",
    "comparison": "drake_diff.identification.recorded_causes",
    "panel": "drake_diff.panels.results",
    "trial": "drake_diff.panels.results",
}
NOT_REPEATED = {
    Status.TIME_LIMIT: "how far a search gets within its time limit is another on every run",
    Status.INTERRUPTED: "the search was interrupted, at no moment that could be found again",
}


def reproduce(folder: Path, record: SealedRecord, models: Path | None) -> Reproduced | None:
    """What of a directory comes out of its inputs again, `models` as in `rebuilt`; None where nothing does.

    ArtifactError where what is in it does not go together, ModelError where its model cannot be built again.
    """
    if record.subject in REPRODUCED_BY:
        made: Reproduced | None = import_module(REPRODUCED_BY[record.subject]).reproduce(folder, record, models)
        return made
    if not isinstance(record, PlanRecord):
        return None
    if record.certification is not None:
        return _certified(folder, record, record.certification, models)
    if record.phases is not None:
        return _in_phases(folder, record, record.phases, models)
    return _solved(folder, record, models) if record.subject == "plan" else None


def _solved(folder: Path, record: PlanRecord, models: Path | None) -> Reproduced:
    plan, trace = read_plan(folder / PLAN), read_trace(folder / TRACE)
    with rebuilt(record.model, record.contract.get("source"), trace.attachments, models) as model:
        made = _run_again(record, model, plan)
    problems = tuple(odd_trace(folder, trace, plan, record))
    return replace(made, problems=problems, unchecked=(GIVEN_BY_USER, *made.unchecked), written=FILES)


def _certified(folder: Path, record: PlanRecord, section: CertificationSection, models: Path | None) -> Reproduced:
    """The same states from the same seed, each certified again."""
    carried = record.model.file.path if record.model.file is not None else ""
    attachments = {carried: read_plain(folder / carried)} if carried in record.files else None
    asked = {name: getattr(section, name) for name in ("seed", "parameters", "method")}
    with rebuilt(record.model, record.contract.get("source"), attachments, models) as model:
        made = _as_given(certify_model(model, states=len(section.states), **asked), record)
    return Reproduced(made.model_dump(mode="json"), {}, written=(carried,))


def odd_trace(folder: Path, trace: Trace, plan: Mapping[str, Any], record: PlanRecord) -> Iterator[str]:
    """What in the trace is not what record.json and plan.npz have."""
    if trace.attachments.get(record.FILE) != reproducible(read_fields(folder / record.FILE)).encode():
        yield f"{TRACE}: the record that it carries is not {record.FILE}"
    inputs = np.vstack([plan["us"], plan["u_final"]]) if "u_final" in plan else plan["us"]
    for topic, recorded, planned in (("state", trace.planned_xs, plan["xs"]), ("input", trace.planned_us, inputs)):
        if not np.array_equal(recorded, planned, equal_nan=True):
            yield f"{TRACE}: /planned/{topic} is not what {PLAN} has"


def why_not_repeated(record: PlanRecord) -> tuple[str, ...]:
    """Why the search of a record cannot be run again; nothing where it can."""
    costs, constraints = unknown_functions(record)
    reasons = [f"{cost} is a user's function" for cost in costs]
    reasons += [f"constraint {name} is a user's function" for name in constraints]
    if record.inputs.search is None:
        recovered = record.sentence.endswith(RECOVERED)
        reasons.append(OF_RECOVERED if recovered else "the record does not say what solve was called with")
    status = None if record.solver is None else Status(record.solver.status)
    return (*reasons, *([NOT_REPEATED[status]] if status in NOT_REPEATED else []))


def _run_again(record: PlanRecord, model: Model, plan: dict[str, Array]) -> Reproduced:
    """The run of `record` and `plan` on `model`. ArtifactError where they do not go together."""
    recorded = resolve(record, model, plan)
    unrepeated = why_not_repeated(record)
    if unrepeated:
        return _without_the_search(recorded, record, unrepeated)
    solution = solve_again(record, model, plan)
    apart = _distance(solution, recorded)
    if apart == 0:
        return _written(solution, record, 0.0)
    ways = [(s.method, s.scheme, s.solver) for s in (solution, recorded)]
    if apart == np.inf or ways[0] != ways[1]:
        recorded_by, solved_by = (
            f"{s.method} ({s.scheme}, {s.solver}) in {len(s.us)} intervals" for s in (recorded, solution)
        )
        return _without_the_search(recorded, record, (f"recorded by {recorded_by}, this version takes {solved_by}",))
    return _written(replace(solution, **plan_fields(plan)), record, apart)


def _distance(solution: Solution, other: Solution) -> float:
    """Between two plans: the largest of each array, relative to its largest number; inf where their shapes differ."""
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


def _written(solution: Solution, record: PlanRecord, apart: float) -> Reproduced:
    """All files of `solution`, made in a folder of their own."""
    engines = None if record.solver is None else record.solver.options.get("cross_check")
    if isinstance(engines, list):
        solution = cross_check(solution, [str(name) for name in engines])
    with TemporaryDirectory() as folder:
        location, measurement = Path(folder), measure(solution)
        again, unchecked = _but_for_simulators(_as_given(record_of(measurement, location), record), record)
        write_files(location, measurement, again)
        files = {path.name: path.read_bytes() for path in location.iterdir()}
    return Reproduced(again.model_dump(mode="json"), files, apart, unchecked=unchecked)


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
    return again.model_copy(update={"replays": rows}), tuple(unchecked)


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
    if not again:  # each phase has its own
        return {}
    source, was = str(again.get("source")), recorded.get("source")
    return {**again, "source": was, "notes": [str(note).replace(source, str(was)) for note in again["notes"]]}


def _without_the_search(recorded: Solution, record: PlanRecord, unrepeated: tuple[str, ...]) -> Reproduced:
    """What can be made of the plan alone; what rests on the search is left out of the comparison."""
    again = _written(recorded, record, 0.0)
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
    return any(key == section or key.startswith((f"{section}.", f"{section}[")) for section in sections)


def odd_metrics(record: PlanRecord, plan: dict[str, Array]) -> Iterator[str]:
    """Where the metrics of a record are not those of its plan, as far as that can be told without the dynamics."""
    p: dict[str, Any] = dict(record.problem)
    metrics = {metric.name: metric.value for metric in record.metrics}
    xs = plan["xs"]

    def numbers(name: str, missing: float) -> Array:
        return np.array([missing if v is None else v for v in p[name]], dtype=float)

    goal, start = numbers("x_goal", np.nan), numbers("x0", np.nan)
    start[np.array(p["initial_state_free"], dtype=bool)] = np.nan
    for name, x, wanted in (("goal error", xs[-1], goal), ("initial state error", xs[0], start)):
        recorded, again = metrics.get(name), finite(float(np.max(np.abs(x - wanted)[~np.isnan(wanted)], initial=0.0)))
        if (recorded is None) != (again is None) or abs((recorded or 0.0) - (again or 0.0)) > ROUNDED * max(
            1.0, again or 0.0
        ):
            yield f"{record.FILE}: metrics[{name}] is {recorded}, and the plan's is {again}"
    inputs = [plan[name].reshape(-1, plan["us"].shape[1]) for name in ("us", "us_mid", "u_final") if name in plan]
    us, later = np.vstack(inputs), xs[1:] if np.all(np.isfinite(start)) else xs
    beyond = [numbers("u_lower", -np.inf) - us, us - numbers("u_upper", np.inf)]
    beyond += [numbers("x_lower", -np.inf) - later, later - numbers("x_upper", np.inf)]
    least = max(float(np.max(excess, initial=0.0)) for excess in beyond)
    recorded = metrics.get("bound violation")
    if recorded is not None and not recorded >= least - ROUNDED:  # midpoint states are no part of the plan
        yield f"{record.FILE}: metrics[bound violation] is {recorded}, and the plan's is at least {least:.6g}"


def _in_phases(folder: Path, record: PlanRecord, section: PhasesSection, models: Path | None) -> Reproduced:
    """The record of a solve in phases; the directory of each phase is reproduced as one of a plan."""
    for i, phase in enumerate(section.phases):
        if phase.directory != directory_of(i):
            raise ArtifactError(f"{record.FILE}: phase {i} is in {phase.directory!r}, expected {directory_of(i)!r}")
    records = [load_plan_record(folder / phase.directory) for phase in section.phases]
    plans = [read_plan(folder / phase.directory / PLAN) for phase in section.phases]
    names = (*FILES, record.FILE, record.SCHEMA_FILE)
    made = Reproduced(
        {},
        {},
        problems=tuple(_odd_phases(record, section, records, plans)),
        unchecked=(GIVEN_IN_PHASES,),
        written=tuple(f"{phase.directory}/{name}" for phase in section.phases for name in names),
    )
    if made.problems:
        return made
    with ExitStack() as stack:
        try:
            phases = tuple(_rebuilt_phases(stack, folder, section, records, plans, models))
        except ModelError as error:
            why = f"the search and the chain of all phases were not run again: {error}"
            return replace(made, undecided=(why,))
        problem = _phased_problem(section, list(phases))
        solution, apart, unrepeated = _solved_in_phases(problem, record, section, phases)
        again = _as_given(record_of_phases(folder, solution), record).model_dump(mode="json")
    for made_link, link in zip(again["phases"]["links"], section.links, strict=True):
        if link.reset == {"impact": {}}:  # as records of 2.x tell of one
            made_link["reset"] = link.reset
    certificates = tuple(f"phases.links[{i}].certificate" for i in range(len(section.links)))
    missing = (*SEARCHED, *SEARCHED_IN_PHASES, *certificates) if unrepeated else ()
    return replace(made, fields=again, apart=apart, unrepeated=unrepeated, missing=missing)


def _odd_phases(
    record: PlanRecord, section: PhasesSection, records: Sequence[PlanRecord], plans: Sequence[dict[str, Array]]
) -> Iterator[str]:
    """What the record of all phases says otherwise than those of its phases and their plans, dynamics apart."""
    count, links = len(section.phases), [(link.before, link.after) for link in section.links]
    if links not in ([(i, i + 1) for i in range(count - 1)], [(i, (i + 1) % count) for i in range(count)]):
        yield f"{record.FILE}: its links are {links}, which is no chain of {count} phases"
        return
    for phase, inner in zip(section.phases, records, strict=True):
        metrics = {metric.name: metric.value for metric in inner.metrics}
        expected = (inner.solver and inner.solver.status, metrics.get("cost"), metrics.get("horizon"))
        if (phase.status, phase.cost, phase.duration) != expected:
            yield f"{record.FILE}: {phase.name} has status, cost and duration {expected} in {phase.directory}"
    total, duration = (sum(getattr(p, name) or 0.0 for p in section.phases) for name in ("cost", "duration"))
    if section.cost is not None and not is_near(section.cost, total, ROUNDED, ROUNDED):
        yield f"{record.FILE}: phases.cost is {section.cost!r}, and the phases cost {total!r}"
    lower, upper = section.horizon_s or (0.0, np.inf)
    converged = record.solver is not None and record.solver.status == "converged"
    if converged and not lower - FEASIBILITY_TOLERANCE <= duration <= upper + FEASIBILITY_TOLERANCE:
        yield f"{record.FILE}: phases.horizon_s is {section.horizon_s}, and the phases take {duration!r} s"
    for i, link in enumerate(section.links):
        before, after = plans[link.before]["xs"][-1], plans[link.after]["xs"][0]
        if not link.reset or "impact" in link.reset:
            continue
        matrix: Any = link.reset.get("matrix")
        reset = np.array(matrix["rows"], dtype=float) if isinstance(matrix, dict) else np.eye(len(before))
        errors = [finite(error) for error in np.abs(after - reset @ before)]
        pairs = zip(link.errors, errors, strict=True)
        if not all(a == b or (a is not None and b is not None and is_near(a, b, ROUNDED, ROUNDED)) for a, b in pairs):
            yield f"{record.FILE}: phases.links[{i}].errors is {link.errors}, and the plan's are {errors}"


def _rebuilt_phases(
    stack: ExitStack,
    folder: Path,
    section: PhasesSection,
    records: Sequence[PlanRecord],
    plans: Sequence[dict[str, Array]],
    models: Path | None,
) -> Iterator[Solution]:
    """Each phase as its record tells it; ModelError where one has what is in no directory."""
    for i, link in enumerate(section.links):
        if link.reset is None:
            raise ModelError(f"links[{i}]: its reset {link.told} is a user's function")
    for phase, inner, plan in zip(section.phases, records, plans, strict=True):
        reasons = [r for r in why_not_repeated(inner) if "what solve was called with" not in r]
        if reasons:
            raise ModelError(f"{phase.name}: {reasons[0]}")
        attachments = read_trace(folder / phase.directory / TRACE).attachments
        model = stack.enter_context(rebuilt(inner.model, inner.contract.get("source"), attachments, models))
        yield resolve(inner, model, plan)


def _solved_in_phases(
    problem: PhasedProblem, record: PlanRecord, section: PhasesSection, phases: tuple[Solution, ...]
) -> tuple[PhasedSolution, float, tuple[str, ...]]:
    """The recorded plan as the search, run again, ends at it; how far away that ends, and why it was not run again.

    Where the search ends elsewhere, the plan is as the record says.
    """
    status = Status(record.solver.status if record.solver else "")
    recorded = PhasedSolution.joined(problem, phases, status=status, message=record.sentence)
    if section.search is None or section.initial_guess is not None:
        return recorded, 0.0, ("it began from a guess that the directory does not have",)
    arguments: dict[str, Any] = {name: value for name, value in section.search.items() if name != "time_limit"}
    options = arguments.pop("options").items()
    chosen = Options.from_dict({name: value for name, value in options if name not in REMOVED})
    solved = solve(problem, options=chosen, **arguments)
    apart = max(_distance(plan, other) for plan, other in zip(solved.phases, phases, strict=True))
    if apart > SAME_PLAN:
        return recorded, 0.0, (f"run again, it ends at another plan, {apart:.2g} of its largest number away",)
    ended = replace(solved, search=Search(dict(section.search)))
    if apart > 0:
        pairs = zip(phases, solved.phases, strict=True)
        ended = replace(ended, phases=tuple(plan.told(status=other.status) for plan, other in pairs))
    return ended, apart, ()


def _phased_problem(section: PhasesSection, solutions: list[Solution]) -> PhasedProblem:
    """The problem in phases that a record tells of; ArtifactError where it is none."""
    resets: list[Any] = []
    for link in section.links:
        reset: dict[str, Any] = dict(link.reset or {})
        system = solutions[link.after].problem.system
        if "impact" in reset:
            if not reset["impact"] and isinstance(system, FixedContacts):  # as records of 2.x tell that it stops them
                resets.append(system.impact)
                continue
            model: Any = system.model if isinstance(system, FixedContacts) else system
            try:
                resets.append(Impact.from_dict(reset["impact"], model))
            except DrakeDiffError as error:
                raise ArtifactError(f"{PlanRecord.FILE}: its impact cannot be rebuilt: {error}") from error
        else:
            resets.append(None if "identity" in reset else np.array(reset["matrix"]["rows"], dtype=float))
    closing: Any = False
    if len(resets) == len(solutions):
        last = resets.pop()
        closing = True if last is None else last
    try:
        return PhasedProblem(
            [solution.problem for solution in solutions],
            resets=resets,
            periodic=closing,
            horizon=None if section.horizon_s is None else tuple(section.horizon_s),
            names=[phase.name for phase in section.phases],
        )
    except DrakeDiffError as error:
        raise ArtifactError(f"{PlanRecord.FILE}: its problem cannot be rebuilt: {error}") from error

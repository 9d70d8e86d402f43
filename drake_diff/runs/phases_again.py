"""What in the directory of a solve in phases does not come out when it is made again.

Phases of models without user's functions, linked by nothing, matrices and impacts of both kinds, are solved again as
one problem. A user's function is in no artifact: then what the numbers say of each other is checked alone.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ArtifactError, DrakeDiffError, ModelError
from drake_diff.optimize.phased import PhasedSolution
from drake_diff.optimize.problem.held import HeldContacts, Impact
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.solution import Solution
from drake_diff.optimize.solve import solve
from drake_diff.runs.again import SAME_PLAN, apart_from, why_not_repeated
from drake_diff.runs.fields import finite
from drake_diff.runs.plan_record import PhaseEvidence, PhasesSection, PlanRecord
from drake_diff.runs.provenance import gradient_evidence
from drake_diff.runs.read import load_plan_record
from drake_diff.runs.rerun import PLAN, TRACE, read_plan, rebuilt, resolve
from drake_diff.runs.save import chain_evidence, directory_of
from drake_diff.runs.trace import read_trace

ROUNDED = 1e-12  # of the largest number: what the same sum may differ by on another machine


class PhasesAgain:
    """What in the directory of a solve in phases does not come out, what could not be made again, and how much was."""

    def __init__(self) -> None:
        self.problems: list[str] = []
        self.undecided: list[str] = []
        self.rounded: list[str] = []
        self.unchecked: list[str] = []
        self.checked = 0

    def same(self, key: str, recorded: Any, again: Any, allowed: float = ROUNDED) -> None:
        """Compare a number, or a text; note where they differ."""
        self.checked += 1
        if recorded == again:
            return
        if isinstance(recorded, float) and isinstance(again, float):
            off = abs(recorded - again)
            if off <= allowed * max(1.0, abs(again)):
                self.rounded.append(f"{PlanRecord.FILE}: {key} is {recorded:.17g}, made again {again:.17g}")
                return
        self.problems.append(f"{PlanRecord.FILE}: {key} is {recorded!r}, made again {again!r}")


def phases_again(
    folder: Path, whole: PlanRecord, models: Path | None, of_phase: Callable[[Path], PhasesAgain]
) -> PhasesAgain:
    """The directory beside the same made again; `of_phase` makes that of one phase again, `models` as in `rebuilt`."""
    found, record = PhasesAgain(), phases_of(whole)
    records: list[PlanRecord] = []
    plans: list[dict[str, Array]] = []
    for i, phase in enumerate(record.phases):
        if phase.directory != directory_of(i):
            raise ArtifactError(f"{whole.FILE}: phase {i} is in {phase.directory!r}, expected {directory_of(i)!r}")
        own = load_plan_record(folder / phase.directory)
        records.append(own)
        plans.append(read_plan(folder / phase.directory / PLAN))
        one = of_phase(folder / phase.directory)
        for name in ("problems", "undecided", "rounded", "unchecked"):
            getattr(found, name).extend(f"{phase.directory}: {line}" for line in getattr(one, name))
        found.checked += one.checked
        _agree(found, f"phases[{i}]", phase, own)
    _check_links(found, record, plans)
    if record.cost is not None:
        found.same("cost", record.cost, float(sum(phase.cost or 0.0 for phase in record.phases)))
    if whole.solver is not None and whole.solver.status == "converged":
        found.same("horizon_s", True, _within(record))
    with ExitStack() as stack:
        try:
            solutions = list(_rebuilt(stack, folder, record, records, plans, models))
        except ModelError as error:
            found.undecided.append(f"the search and the chain of all phases were not run again: {error}")
            return found
        _solve_again(found, whole, records, solutions)
    return found


def phases_of(record: PlanRecord) -> PhasesSection:
    """The section of a solve in phases; ArtifactError where the record has none."""
    if record.phases is None:
        raise ArtifactError(f"{record.FILE}: expected the record of a solve in phases")
    return record.phases


def _within(record: PhasesSection) -> bool:
    """Whether the durations sum to what was asked."""
    whole = sum(phase.duration for phase in record.phases)
    lower, upper = record.horizon_s or (0.0, np.inf)
    return bool(lower - FEASIBILITY_TOLERANCE <= whole <= upper + FEASIBILITY_TOLERANCE)


def _agree(found: PhasesAgain, key: str, phase: PhaseEvidence, own: PlanRecord) -> None:
    """A phase as the whole tells it, and as its own record does."""
    metrics = {metric.name: metric.value for metric in own.metrics}
    found.same(f"{key}.status", phase.status, None if own.solver is None else own.solver.status)
    found.same(f"{key}.cost", phase.cost, metrics.get("cost"))
    found.same(f"{key}.duration", phase.duration, metrics.get("horizon"))


def inconsistencies(record: PlanRecord, plan: dict[str, Array]) -> Iterator[str]:
    """Where the metrics of a record are not those of its plan, as far as that can be told without the dynamics."""
    p: dict[str, Any] = dict(record.problem)
    metrics = {metric.name: metric.value for metric in record.metrics}
    xs = plan["xs"]

    def numbers(name: str, missing: float) -> Array:
        return np.array([missing if v is None else v for v in p[name]], dtype=float)

    goal, start = numbers("x_goal", np.nan), numbers("x0", np.nan)
    start[np.array(p["initial_state_free"], dtype=bool)] = np.nan
    for name, x, wanted in (("goal error", xs[-1], goal), ("initial state error", xs[0], start)):
        told, again = metrics.get(name), finite(float(np.max(np.abs(x - wanted)[~np.isnan(wanted)], initial=0.0)))
        if (told is None) != (again is None) or abs((told or 0.0) - (again or 0.0)) > ROUNDED * max(1.0, again or 0.0):
            yield f"{record.FILE}: metrics[{name}] is {told}, and the plan's is {again}"
    inputs = [plan[name].reshape(-1, plan["us"].shape[1]) for name in ("us", "us_mid", "u_final") if name in plan]
    us, later = np.vstack(inputs), xs[1:] if np.all(np.isfinite(start)) else xs
    beyond = [numbers("u_lower", -np.inf) - us, us - numbers("u_upper", np.inf)]
    beyond += [numbers("x_lower", -np.inf) - later, later - numbers("x_upper", np.inf)]
    least = max(float(np.max(each, initial=0.0)) for each in beyond)
    told = metrics.get("bound violation")
    if told is not None and not told >= least - ROUNDED:  # midpoint states are no part of the plan
        yield f"{record.FILE}: metrics[bound violation] is {told}, and the plan's is at least {least:.6g}"


def _check_links(found: PhasesAgain, record: PhasesSection, plans: list[dict[str, Array]]) -> None:
    count = len(record.phases)
    pairs = [(link.before, link.after) for link in record.links]
    if pairs not in ([(i, i + 1) for i in range(count - 1)], [(i, (i + 1) % count) for i in range(count)]):
        found.problems.append(f"{PlanRecord.FILE}: its links are {pairs}, which is no chain of {count} phases")
        return
    for i, link in enumerate(record.links):
        before, after = plans[link.before]["xs"][-1], plans[link.after]["xs"][0]
        reset = link.reset or {}
        if "impact" in reset:
            continue  # with the model: see `_solve_again`
        if not reset:
            found.undecided.append(
                f"links[{i}]: its reset {link.told} is a user's function, which no artifact can hold"
            )
            continue
        matrix: Any = np.eye(len(before)) if "identity" in reset else reset.get("matrix")
        matrix = np.array(matrix["rows"], dtype=float) if isinstance(matrix, dict) else matrix
        errors = [finite(e) for e in np.abs(after - matrix @ before)]
        for j, (told, again) in enumerate(zip(link.errors, errors, strict=True)):
            found.same(f"links[{i}].errors[{j}]", told, again)


def _rebuilt(
    stack: ExitStack,
    folder: Path,
    record: PhasesSection,
    records: list[PlanRecord],
    plans: list[dict[str, Array]],
    models: Path | None,
) -> Iterator[Solution]:
    """Each phase as its record tells it; ModelError where one has what is in no artifact."""
    for i, link in enumerate(record.links):
        if link.reset is None:
            raise ModelError(f"links[{i}] has a user's function")
    for phase, own, plan in zip(record.phases, records, plans, strict=True):
        reasons = [r for r in why_not_repeated(own) if "what solve was called with" not in r]
        if reasons:
            raise ModelError(f"{phase.name}: {reasons[0]}")
        attachments = read_trace(folder / phase.directory / TRACE).attachments
        model = stack.enter_context(rebuilt(own.model, own.contract.get("source"), attachments, models))
        yield resolve(own, model, plan)


def _solve_again(found: PhasesAgain, whole: PlanRecord, records: list[PlanRecord], solutions: list[Solution]) -> None:
    record = phases_of(whole)
    problem = _problem_of(record, solutions)
    told = PhasedSolution(problem, solutions[0].status, whole.sentence, tuple(solutions))
    for i, (link, switch) in enumerate(zip(record.links, problem.switches, strict=True)):
        errors = [finite(error) for error in told.link_errors[switch.label]]
        for j, (one, other) in enumerate(zip(link.errors, errors, strict=True)):
            found.same(f"links[{i}].errors[{j}]", one, other, allowed=1e-9)
    if record.chain is not None:
        again = chain_evidence(told.chain)
        found.same("chain.holds", record.chain.holds, again.holds)
        found.same("chain.control", record.chain.control, again.control)
        found.same("chain.worst", record.chain.worst, again.worst, allowed=1e-9)
        found.same("chain.told", record.chain.told, again.told)
    if record.search is None or record.initial_guess is not None or whole.solver is None:
        found.undecided.append("the search was not run again: it began from a guess that the artifact does not have")
        return
    arguments: dict[str, Any] = dict(record.search)
    arguments.pop("time_limit", None)
    for name in ("solver", "continuation"):
        arguments.pop(name, None)
    solved = solve(problem, **arguments)
    apart = max(apart_from(one, other) for one, other in zip(solved.phases, solutions, strict=True))
    if apart > SAME_PLAN:
        found.undecided.append(f"the search, run again, ends at another plan, {apart:.2g} of its largest number away")
        return
    if apart > 0:
        found.rounded.append(f"the plan of the search, run again, is {apart:.2g} of its largest number away")
        found.same("solver.status", whole.solver.status, solved.status.value)
        return
    found.same("solver.status", whole.solver.status, solved.status.value)
    found.same("sentence", whole.sentence, solved.message)
    found.same("solver.message", whole.solver.message, solved.message)
    found.same("solver.iterations", whole.solver.iterations, len(solved.iterations))
    certificates = {c.subject: gradient_evidence(c).model_dump(mode="json") for c in solved.link_certificates}
    for i, (link, switch) in enumerate(zip(record.links, problem.switches, strict=True)):
        recorded = None if link.certificate is None else link.certificate.model_dump(mode="json")
        found.same(f"links[{i}].certificate", recorded, certificates.get(switch.label))


def _problem_of(record: PhasesSection, solutions: list[Solution]) -> PhasedProblem:
    """The problem in phases that a record tells of; ArtifactError where it is none."""
    resets: list[Any] = []
    for link in record.links:
        reset: dict[str, Any] = dict(link.reset or {})
        system = solutions[link.after].problem.system
        if "impact" in reset:
            if not reset["impact"] and isinstance(system, HeldContacts):  # as records of 2.x tell that it stops them
                resets.append(system.impact)
                continue
            model: Any = system.model if isinstance(system, HeldContacts) else system
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
            horizon=None if record.horizon_s is None else tuple(record.horizon_s),
            names=[phase.name for phase in record.phases],
        )
    except DrakeDiffError as error:
        raise ArtifactError(f"{PlanRecord.FILE}: its problem cannot be rebuilt: {error}") from error

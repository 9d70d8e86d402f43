"""Judge a solve: its status is what the solver says, cut down to what was measured again on Drake's plant."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from drake_diff._base.refusal import Refusal
from drake_diff.exceptions import GradientError
from drake_diff.model.contact import penetration
from drake_diff.model.parameters import applied
from drake_diff.model.step import set_state
from drake_diff.optimize.problem.goals import in_words
from drake_diff.optimize.problem.obstacles import along_steps, clearances
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE, NlpResult, Outcome
from drake_diff.optimize.replay import broken_variants, told_of_controls, told_of_goals, told_of_tolerance
from drake_diff.optimize.solution import INTEGRATION_TOLERANCE, Solution, Status
from drake_diff.optimize.transcription.between import passed_between_steps, violation_between_nodes
from drake_diff.optimize.transcription.collocation import SUBSTEPS, Collocated

FINER = "pass refine=True, or take more steps (num_steps)"
REFINED = "raise max_num_steps, or take more steps (num_steps)"  # where it was refined
_ALIKE = ("ITERATION_LIMIT", "TIME_LIMIT", "INFEASIBLE", "INTERRUPTED", "DIVERGED", "NO_GRADIENT", "FAILED")
# Where the solver stopped short of its own tolerance, or gave up: our own measures say at what.
STOPPED = (Outcome.INACCURATE, Outcome.INFEASIBLE, Outcome.ITERATION_LIMIT, Outcome.NO_GRADIENT, Outcome.FAILED)
_LED = "integrated accurately", "mapped step by step"
STATIONARY = 1e-6  # of the terms of the Lagrangian's gradient: what is left to gain is of its square
_STATUSES = {Outcome.UNBOUNDED: Status.DIVERGED, **{Outcome[name]: Status[name] for name in _ALIKE}}


def judged(draft: Solution, result: NlpResult) -> Solution:
    """The draft with the status that the solver's outcome and our own measures allow."""
    fields = {"iterations": result.iterations, "solver_message": result.message}
    complaints = list(complaints_about(draft))
    outcome, notes = (result.outcome, ()) if complaints else _by_our_measures(draft, result)
    notes = (*notes, *[result.note] * bool(result.note))
    if outcome in _STATUSES:
        detail = "; ".join([result.message, *complaints])
        return ended(draft, _STATUSES[outcome], detail, **fields)
    if outcome is Outcome.INACCURATE:
        complaints.insert(0, f"the solver could not reach its tolerance ({result.message})")
    if not np.all(np.isfinite(draft.xs)):
        return ended(draft, Status.DIVERGED, "; ".join(complaints), **fields)
    held: list[str] = []
    if not complaints and draft.transcribed is not None:
        follows, told = _followed(draft, draft.transcribed)
        (held if follows else complaints).append(told)
    if not complaints and draft.problem.has_model:
        complaints += broken_variants(draft.plan, draft.replays)
    status = Status.CONVERGED_NOT_VERIFIED if complaints else Status.CONVERGED
    if not complaints:
        every = [f(draft.plan, draft.replays) for f in (told_of_goals, told_of_controls, told_of_tolerance)]
        complaints = [each for each in (*every, *held) if each]
    return ended(draft, status, "; ".join([*complaints, *notes]), **fields)


def status_of(outcome: Outcome) -> Status | None:
    """What a solver's outcome is by itself; None where it says that it found a solution."""
    return _STATUSES.get(outcome)


def _by_our_measures(draft: Solution, result: NlpResult) -> tuple[Outcome, tuple[str, ...]]:
    """The outcome of a solve whose plan keeps all that was asked, and how that differs from what the solver says."""
    if result.outcome not in STOPPED:
        return result.outcome, ()
    ratio = _stationarity(draft, result)
    if not ratio <= STATIONARY:
        goes_on = result.outcome in (Outcome.ITERATION_LIMIT, Outcome.NO_GRADIENT)  # the words say why it did not
        return result.outcome if goes_on else Outcome.INACCURATE, ()
    told = f"what was asked is kept, and the Lagrangian's gradient is {ratio:.1g} of its terms"
    return Outcome.SOLVED, (f"by our own measures, where the solver says {result.message!r}: {told}",)


def _stationarity(draft: Solution, result: NlpResult) -> float:
    """What is left of the Lagrangian's gradient, over its largest term; inf where that is not known."""
    found = draft.optimality
    ratio = result.stationarity if isinstance(found, Refusal) else found.ratio
    return ratio if np.isfinite(ratio) else float("inf")


def may_be_too_coarse(solution: Solution) -> bool:
    """Whether a collocated plan keeps all that was asked at its nodes, and yet is none: a finer mesh may mend that."""
    motion = solution.transcribed
    if solution.status is not Status.CONVERGED_NOT_VERIFIED or motion is None or motion.task.is_map:
        return False
    agree = all(certificate.verdict == "agree" for certificate in solution.certificates)
    if not agree or not np.isfinite(solution.cost) or next(_infeasibilities(solution), ""):
        return False
    return not overlaps(solution)


def overlaps(solution: Solution) -> bool:
    """Whether geometries overlap in a collocated motion, which leaves contact out."""
    motion = solution.transcribed
    return motion is not None and solution.problem.has_model and next(_overlaps(solution, motion), "") != ""


def unmeasured(draft: Solution, result: NlpResult) -> Solution:
    """The draft as the solver leaves it: nothing of it is measured, so that it is no success."""
    status = _STATUSES.get(result.outcome, Status.CONVERGED_NOT_VERIFIED)
    fields = {"iterations": result.iterations, "solver_message": result.message}
    return ended(draft, status, f"{result.message}; nothing was measured yet", **fields)


def refused(draft: Solution, error: Exception) -> Solution:
    """The draft of a solve that ended because a step or its derivative was refused."""
    status = Status.NO_GRADIENT if isinstance(error, GradientError) else Status.DIVERGED
    return ended(draft, status, str(error))


def ended(draft: Solution, status: Status, detail: str, **fields: Any) -> Solution:
    """The draft with its final status, whose sentence and `detail` are the message."""
    message = f"{status.sentence}: {detail}" if detail else status.sentence
    return draft.told(status=status, message=message, **fields)


def complaints_about(solution: Solution) -> Iterator[str]:
    """What does not hold of `solution` when measured again on Drake's plant, a clause each, replays apart."""
    yield from _infeasibilities(solution)
    if not np.isfinite(solution.cost):
        yield "the cost is not finite"
    if solution.transcribed is not None:
        yield from _between_nodes(solution, solution.transcribed)
    elif np.all(np.isfinite(solution.xs)):
        for c in clearances(solution.problem.kept):
            for told in c.too_near(*along_steps(solution.times, solution.xs), c.between):
                yield f"between the knots {told}, tolerance {in_words(c.between, 'm')}: take a smaller time step"
        for told in passed_between_steps(solution.problem, solution.times, solution.xs, solution.us):
            yield f"{told}: take a smaller time step"
    if solution.transcribed is not None and solution.problem.has_model:
        yield from _overlaps(solution, solution.transcribed)
    for certificate in solution.certificates:
        if certificate.verdict != "agree":
            yield f"a gradient certificate says {certificate.verdict}: {certificate.worst}"
            break


def _overlaps(solution: Solution, motion: Collocated) -> Iterator[str]:
    """Where geometries touch, at knots or between them."""
    model, depths = solution.problem.model, []
    if not model.contract.contact.collision_pairs:
        return
    times, between = motion.between_knots
    xs = np.vstack([motion.xs, between])
    with applied(solution.vector):
        for x in xs[np.isfinite(xs).all(axis=1)]:
            set_state(model.double, x)
            depths.append(penetration(model))
    if max(depths) > 0:
        when = np.append(solution.times, times)[np.isfinite(xs).all(axis=1)][int(np.argmax(depths))]
        yield f"geometries overlap by {max(depths):.3g} m at {when:.4g} s, and collocation leaves contact out"


def _between_nodes(solution: Solution, motion: Collocated) -> Iterator[str]:
    """Where the motion between nodes is not that of the dynamics, or not within its bounds and constraints."""
    finer = "take a smaller time step" if solution.problem.horizon is None else FINER
    if "refinements" in solution.options:
        finer = REFINED
    tolerance = INTEGRATION_TOLERANCE * np.minimum(solution.problem.ranges(motion.xs), 1.0)
    if not np.all(motion.gaps <= tolerance):
        knot, i = np.unravel_index(int(np.argmax(motion.gaps / tolerance)), motion.gaps.shape)
        yield (
            f"an accurate integration from knot {knot} misses the next by {motion.gaps[knot, i]:.3g} in "
            f"{solution.problem.state_names[i]}, tolerance {tolerance[i]:.3g}: {finer}"
        )
    broken = violation_between_nodes(motion).broken
    if broken:
        yield f"{'; '.join(broken)}: take more, shorter steps (num_steps)"


def _followed(solution: Solution, motion: Collocated) -> tuple[bool, str]:
    """Whether the dynamics follow the plan from its first knot to its last, open loop or under TVLQR, and how well."""
    b, names, ranges = solution.problem.bounds, solution.problem.state_names, solution.problem.ranges(motion.xs)
    told = []
    for control in ("open loop", "TVLQR"):
        xs = motion.led(control)
        excess = np.max(np.maximum(np.maximum(b.x_lower - xs, xs - b.x_upper), 0.0)[1:], axis=0)
        apart = np.nan_to_num(np.max(np.abs(xs[::SUBSTEPS] - motion.xs), axis=0), nan=np.inf)
        excess = np.nan_to_num(excess, nan=np.inf)
        i, j = (int(np.argmax(off / ranges)) for off in (apart, excess))
        if max(apart[i] / ranges[i], excess[j] / ranges[j]) <= INTEGRATION_TOLERANCE:
            how = control if control == "open loop" else f"under {control}"
            return True, (
                f"{_LED[motion.task.is_map]} {how}, {names[i]} is at most {apart[i]:.2g} from the plan, "
                f"{apart[i] / ranges[i]:.1%} of its range, of {INTEGRATION_TOLERANCE:.0%} allowed"
            )
        bound = excess[j] / ranges[j] > apart[i] / ranges[i]
        told.append(
            f"{control}, {names[j]} is {excess[j]:.3g} beyond its bound"
            if bound
            else f"{control}, {names[i]} is {apart[i]:.3g} from the plan"
        )
    remedy = "" if motion.task.is_map else f": {FINER}"
    return False, (
        f"{_LED[motion.task.is_map]} from its first state the plan does not hold: {'; '.join(told)}; tolerance "
        f"{INTEGRATION_TOLERANCE:.0%} of each state's range{remedy}"
    )


def _infeasibilities(solution: Solution) -> Iterator[str]:
    """Equations, ends, bounds and constraints that do not hold, with the knots at which they do not."""
    names, above = solution.problem.state_names, f"above {FEASIBILITY_TOLERANCE:g}"
    if not solution.defect <= FEASIBILITY_TOLERANCE:
        where = _spans(np.flatnonzero(~(solution.defects <= FEASIBILITY_TOLERANCE)))
        whose = "the model's" if solution.problem.has_model else "that of the dynamics"
        yield f"defect {solution.defect:.3g} is {above}: the motion is not {whose} after knots {where}"
    if not solution.goal_error <= FEASIBILITY_TOLERANCE:
        worst = int(np.argmax(np.nan_to_num(np.abs(solution.problem.goal_error(solution.xs[-1])), nan=np.inf)))
        yield f"goal error {solution.goal_error:.3g} is {above}: {names[worst]} does not reach its goal"
    for kind, excesses in (("bound", solution.bound_excess), ("constraint", solution.constraint_excess)):
        for name, (excess, knot) in excesses.items():
            if not excess <= FEASIBILITY_TOLERANCE:
                yield f"{kind} violation {excess:.3g} is {above}: {name} at knot {knot}"
    if not solution.initial_state_error <= FEASIBILITY_TOLERANCE:
        yield f"initial state error {solution.initial_state_error:.3g} is {above}"


def _spans(knots: Any) -> str:
    """Whole numbers as ranges: "0-11, 14"."""
    runs = np.split(knots, np.flatnonzero(np.diff(knots) > 1) + 1)
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs if len(run))

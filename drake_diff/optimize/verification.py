"""Decide how a solve ended: what the solver says, cut down to what the checks of its plan allow."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from drake_diff._base.values import Refusal
from drake_diff.exceptions import GradientError
from drake_diff.optimize import messages
from drake_diff.optimize.checks import PLAN, Check
from drake_diff.optimize.measure import ASKED
from drake_diff.optimize.program import NlpResult, Outcome
from drake_diff.optimize.replay import broken_variants, deciding
from drake_diff.optimize.solution import Solution, Status

FINER = "pass refine=True, or take more steps (num_steps)"
REFINED = "raise max_num_steps, or take more steps (num_steps)"  # where it was refined
SHORTER = "take a smaller time step"
_ALIKE = ("ITERATION_LIMIT", "TIME_LIMIT", "INFEASIBLE", "INTERRUPTED", "DIVERGED", "NO_GRADIENT", "FAILED")
# Where the solver stopped short of its own tolerance: our own measures say at what.
STOPPED = (Outcome.INACCURATE, Outcome.ITERATION_LIMIT, Outcome.NO_GRADIENT, Outcome.FAILED)
STATIONARY = 1e-6  # of the terms of the Lagrangian's gradient: what is left to gain is of its square
_STATUSES = {Outcome.UNBOUNDED: Status.DIVERGED, **{Outcome[name]: Status[name] for name in _ALIKE}}


def judged(draft: Solution, result: NlpResult) -> Solution:
    """The draft with the status that the solver's outcome and the checks allow.

    Replays are taken of a plan only that passes all other checks.
    """
    fields = {"iterations": result.iterations, "solver_message": result.message}
    failing = [c for c in draft.plan_checks if not c.passes]
    complaints = [str(c) for c in failing]
    outcome, notes = (result.outcome, ()) if failing else _by_our_measures(draft, result)
    notes = (*notes, *[result.note] * bool(result.note))
    if outcome in _STATUSES:
        return ended(draft, _STATUSES[outcome], "; ".join([result.message, *complaints]), **fields)
    if outcome is Outcome.INACCURATE:
        complaints.insert(0, f"the solver could not reach its tolerance ({result.message})")
    if not np.all(np.isfinite(draft.xs)):
        return ended(draft, Status.DIVERGED, "; ".join(complaints), **fields)
    if not complaints:
        if draft.following and not draft.following[-1].passes:
            failing = draft.following
            complaints = [messages.followed(draft.following)]
        elif draft.problem.has_model:
            broken = broken_variants(draft.plan, draft.replays)
            complaints = [messages.broken_variant(variant, rows) for variant, rows in broken.items()]
    if complaints:
        sentences = [*complaints, *filter(None, [_remedy(draft, failing)]), *notes]
        return ended(draft, Status.CONVERGED_NOT_VERIFIED, "; ".join(sentences), **fields)
    return ended(draft, Status.CONVERGED, "; ".join(filter(None, [*_holding(draft), *notes])), **fields)


def _holding(s: Solution) -> list[str]:
    """Under which controls a plan holds, on the plant and where its dynamics are integrated."""
    sentences = [f"integrated {messages.under(s.following[-1].feedback or 'open loop')}"] if s.following else []
    if s.problem.has_model:
        sentences.insert(0, messages.controls(s.replays, deciding(s.plan, s.replays), finest=s.plan.continuous))
    return sentences


def _remedy(draft: Solution, failing: list[Check]) -> str:
    """What to try against what fails between knots."""
    if draft.problem.is_map or not any(c.what in ("cost", "integration") or c.plant != PLAN for c in failing):
        return ""
    if draft.transcribed is None:
        return SHORTER
    return REFINED if "refinements" in draft.options else FINER


def status_of(outcome: Outcome) -> Status | None:
    """What a solver's outcome is by itself; None where it says that it found a solution."""
    return _STATUSES.get(outcome)


def _by_our_measures(draft: Solution, result: NlpResult) -> tuple[Outcome, tuple[str, ...]]:
    """The outcome of a solve whose plan keeps all that was asked, and how that differs from what the solver says."""
    if result.outcome not in STOPPED:
        return result.outcome, ()
    optimality = draft.optimality
    ratio = result.stationarity if isinstance(optimality, Refusal) else optimality.ratio
    if not ratio <= STATIONARY:  # NaN where it is not known
        goes_on = result.outcome in (Outcome.ITERATION_LIMIT, Outcome.NO_GRADIENT)  # the words say why it did not
        return result.outcome if goes_on else Outcome.INACCURATE, ()
    sentence = f"what was asked is kept, and the Lagrangian's gradient is {ratio:.1g} of its terms"
    return Outcome.SOLVED, (f"by our own measures, where the solver says {result.message!r}: {sentence}",)


def may_be_too_coarse(solution: Solution) -> bool:
    """Whether a collocated plan keeps all that was asked at its nodes, and yet is none: a finer mesh may mend that."""
    motion = solution.transcribed
    if solution.status is not Status.CONVERGED_NOT_VERIFIED or motion is None or motion.task.is_map:
        return False
    final = (*(what for what in ASKED if what != "cost" or not np.isfinite(solution.cost)), "overlap", "derivative")
    return all(c.passes for c in solution.plan_checks if c.plant == PLAN and c.what in final)


def overlaps(solution: Solution) -> bool:
    """Whether geometries overlap in a collocated motion, which leaves contact out."""
    return any(c.what == "overlap" and not c.passes for c in solution.plan_checks)


def unmeasured(draft: Solution, result: NlpResult) -> Solution:
    """The draft as the solver leaves it: nothing of it is measured, so that it is no success."""
    status = _STATUSES.get(result.outcome, Status.CONVERGED_NOT_VERIFIED)
    fields = {"iterations": result.iterations, "solver_message": result.message}
    return ended(draft, status, f"{result.message}; nothing was measured yet", **fields)


def refused(draft: Solution, error: Exception) -> Solution:
    """The draft of a solve that ended because a step or its derivative was refused."""
    status = Status.NO_GRADIENT if isinstance(error, GradientError) else Status.DIVERGED
    return ended(draft, status, str(error))


def ended(draft: Any, status: Status, detail: str, **fields: Any) -> Any:
    """The draft with its final status, whose sentence and `detail` are the message."""
    message = f"{status.sentence}: {detail}" if detail else status.sentence
    return draft.told(status=status, message=message, **fields)


def advice(solution: Solution, arguments: dict[str, Any], other_methods: Sequence[str]) -> str:
    """A clause that says what to try; empty after a success or Ctrl-C.

    `arguments` are those of `solve`, `other_methods` those that take the problem and were not tried.
    """
    remedies = list(_remedies(solution, arguments, other_methods))
    return f"to try: {', or '.join(dict.fromkeys(remedies))}" if remedies else ""


def _remedies(solution: Solution, arguments: dict[str, Any], other_methods: Sequence[str]) -> Iterator[str]:
    status, problem = solution.status, solution.problem
    if status in (Status.CONVERGED, Status.INTERRUPTED):
        return
    touching = problem.has_model and problem.model.contract.contact.collision_pairs > 0
    if status is Status.NO_GRADIENT and touching and _may_continue(solution, other_methods):
        yield 'method="ilqr" with continuation="auto"'
    if status is Status.ITERATION_LIMIT:
        most = arguments["max_iterations"]
        if solution.options.get("max_iterations", most) < most:  # an attempt that was to find a guess
            yield f'method="{solution.method}", which then gets all {most} iterations'
        else:
            yield f"max_iterations above {most}"
    if status is Status.TIME_LIMIT:
        yield f"time_limit above {arguments['time_limit']:g} s"
    if status is Status.INFEASIBLE:
        yield "wider bounds or a longer horizon"
        yield from _nearer_goals(solution)
    if status is Status.DIVERGED:
        yield "a smaller time step"
    if status is not Status.NO_GRADIENT:
        yield from (f'method="{method}"' for method in other_methods)
    if status is Status.NO_GRADIENT and touching:
        yield "an initial_guess in which the bodies touch"
    else:
        yield "another initial_guess"


def _nearer_goals(solution: Solution) -> Iterator[str]:
    """The goals that the plan does not come near to."""
    for c in solution.problem.kept_goals:
        knots = solution.problem.knots_of(c, input_at_end=False)
        miss = max(c.miss(solution.xs[solution.knots[k]]) for k in knots)
        if not miss <= c.tolerance:
            yield f"a goal within reach ({c.told(miss)} here)"


def _may_continue(solution: Solution, other_methods: Sequence[str]) -> bool:
    """Whether iLQR takes the problem, and no attempt was a continuation."""
    chain = solution.options.get("chain", ())
    tried = "continuation" in solution.options or any("continuation" in link for link in chain)
    return not tried and (solution.method == "ilqr" or "ilqr" in other_methods)

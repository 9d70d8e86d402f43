"""Decide the status of a solve from the solver's outcome and the checks of its plan."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.values import Refusal
from drake_diff.exceptions import GradientError
from drake_diff.optimize import messages
from drake_diff.optimize.checks import PLAN, Check, Checks
from drake_diff.optimize.measure import ASKED, GIVEN
from drake_diff.optimize.messages import headline
from drake_diff.optimize.problem.cost import ConstantCost
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.program import NlpResult, Outcome
from drake_diff.optimize.replay import FEEDBACK, GAINS_ALONE, OPEN_LOOP, Replay, deciding
from drake_diff.optimize.solution import Solution, Status

FINER = "pass refine=True, or take more steps (num_steps)"
REFINED = "raise max_num_steps, or take more steps (num_steps)"  # if the mesh was already refined
SHORTER = "take a smaller time step"
_ALIKE = ("ITERATION_LIMIT", "TIME_LIMIT", "INFEASIBLE", "INTERRUPTED", "DIVERGED", "NO_GRADIENT", "FAILED")
# The solver stopped before it met its own tolerance, and independent measures decide whether the plan is a solution.
NEAR = "a motion near an earlier one, but not an optimum in these steps"
LOCAL = "a local optimum"
DEARER = 0.25  # of a plan's cost; motions near plans of the task benchmark cost up to 15 % more in coarse steps
STOPPED = (Outcome.INACCURATE, Outcome.ITERATION_LIMIT, Outcome.NO_GRADIENT, Outcome.FAILED)
ON_A_BOUND = 1e-6  # relative distance of a horizon from its bound, below which it counts as on the bound
STATIONARY = 1e-6  # fraction of the terms of the Lagrangian's gradient; the remaining gain is about its square
_STATUSES = {Outcome.UNBOUNDED: Status.DIVERGED, **{Outcome[name]: Status[name] for name in _ALIKE}}


@dataclass(frozen=True)
class PlantTrial:
    """A plan in one plant under one feedback, with its checks."""

    plant: str
    feedback: str | None
    checks: Sequence[Check]

    @property
    def holds(self) -> bool:
        """Whether every check passes."""
        return all(c.passes for c in self.checks)

    @property
    def worst(self) -> Check:
        """The check that is furthest from passing."""
        return Checks(self.checks)[0]

    def __str__(self) -> str:
        return f"{self.plant} {messages.under(self.feedback)}, {self.worst}"


def trials(s: Solution) -> list[list[PlantTrial]]:
    """Return the plan's trials in each plant in which it must hold under at least one feedback, its own plant first.

    A plan by shooting must hold open loop at its own step, from which its states result. A collocated plan must hold in
    an integration of its equations and, for a model, in the two finest steps of Drake that were tried.
    """
    feedbacks = dict.fromkeys(c.feedback for c in s.following)
    plant = "in its own steps" if s.problem.is_map else "in continuous time"
    following = [PlantTrial(plant, f, [c for c in s.following if c.feedback == f]) for f in feedbacks]
    plants = [following] if following else []
    if s.problem.has_model:
        for v in deciding(s.plan, s.deciding_replays):
            rows = [r for r in s.deciding_replays if r.variant == v]
            plants.append([_trial(r) for r in rows if r.control != GAINS_ALONE])
            if any(r.control == GAINS_ALONE for r in rows):  # open loop, or under both other controllers
                plants.append([_trial(r) for r in rows if r.control != FEEDBACK])
    if plants and s.method == "shooting" and s.scheme == "step":
        plants[0] = [trial for trial in plants[0] if trial.feedback is None]
    return plants


def _trial(r: Replay) -> PlantTrial:
    plant = f"at {messages.in_milliseconds(r.time_step)}" if r.variant.startswith("in steps of ") else r.variant
    return PlantTrial(plant, None if r.control == OPEN_LOOP else r.control, r.checks)


def judged(draft: Solution, result: NlpResult) -> Solution:
    """Return the draft with the status that the solver's outcome and the checks allow.

    Replays are only computed for a plan that passes all other checks.
    """
    fields = {"iterations": result.iterations, "solver_message": result.message}
    failing = draft.plan_checks.failing
    outcome, notes = (result.outcome, ()) if failing else _by_our_measures(draft, result)
    notes = (*notes, *[result.note] * bool(result.note))
    complaints = [str(c) for c in failing]
    if outcome in _STATUSES:
        return ended(draft, _STATUSES[outcome], result.message, *complaints, **fields)
    if not np.all(np.isfinite(draft.xs)):
        return ended(draft, Status.DIVERGED, *complaints, **fields)
    if outcome is Outcome.INACCURATE:
        complaints.append(f"the solver could not reach its tolerance ({result.message})")
    plants = [] if complaints else trials(draft)
    broken = [plant for plant in plants if not any(trial.holds for trial in plant)]
    complaints += [str(min(plant, key=lambda trial: trial.worst.ratio)) for plant in broken]
    if complaints:
        wrong = failing or [trial.worst for plant in broken for trial in plant]
        sentences = [*complaints, _remedy(draft, wrong), *notes]
        return ended(draft, Status.CONVERGED_NOT_VERIFIED, *sentences, **fields)
    return ended(draft, Status.CONVERGED, _holding(draft, plants), *notes, **fields)


def _holding(s: Solution, plants: list[list[PlantTrial]]) -> str:
    """Describe the feedback under which a plan holds in each plant, and a failure at the model's own step."""
    by_feedback: dict[str | None, list[str]] = {}
    for plant in plants:
        trial = next(trial for trial in plant if trial.holds)
        if trial.feedback != GAINS_ALONE:
            by_feedback.setdefault(trial.feedback, []).append(trial.plant)
    parts = [f"{messages.under(feedback)} {messages.joined(where)}" for feedback, where in by_feedback.items()]
    text = f"holds {'; '.join(parts)}" if parts else ""
    if s.transcribed is not None and s.deciding_replays:
        coarsest = [_trial(r) for r in s.deciding_replays if r.variant == s.deciding_replays[0].variant]
        text += "" if any(trial.holds for trial in coarsest) else f"; not {coarsest[0].plant}"
    return text


def _remedy(draft: Solution, failing: list[Check]) -> str:
    """Suggest a remedy for a failure between knots."""
    if draft.method == GIVEN:
        is_off = draft.transcribed is None and draft.problem.has_model and any(c.what == "defect" for c in failing)
        return 'plant="continuous" judges a plan whose input changes between its knots' if is_off else ""
    if draft.problem.is_map or not any(c.what in ("cost", "integration") or c.plant != PLAN for c in failing):
        return ""
    if draft.transcribed is None:
        return SHORTER
    return REFINED if "refinements" in draft.options else FINER


def status_of(outcome: Outcome) -> Status | None:
    """Return the status of a solver's outcome, or None if the solver reports a solution."""
    return _STATUSES.get(outcome)


def _by_our_measures(draft: Solution, result: NlpResult) -> tuple[Outcome, tuple[str, ...]]:
    """Return the outcome of a solve whose plan passes its checks, and a note if it differs from the solver's."""
    if result.outcome not in STOPPED:
        return result.outcome, ()
    optimality = draft.optimality
    ratio = result.stationarity if isinstance(optimality, Refusal) else optimality.ratio
    if not ratio <= STATIONARY:  # NaN if unknown
        goes_on = result.outcome in (Outcome.ITERATION_LIMIT, Outcome.NO_GRADIENT)  # these say why the solver stopped
        return result.outcome if goes_on else Outcome.INACCURATE, ()
    sentence = f"what was asked is kept, and the Lagrangian's gradient is {ratio:.1g} of its terms"
    return Outcome.SOLVED, (f"by our own measures, where the solver says {result.message!r}: {sentence}",)


def near(plan: Solution, motion: Solution) -> Solution:
    """Return the `motion` in steps near a collocated `plan`, not verified if it costs over DEARER more."""
    scale = max(abs(plan.cost), plan.problem.least_cost(plan.xs[0], plan.time_step))
    if not motion.success or motion.cost - plan.cost <= DEARER * scale:
        return motion
    text = f"its cost {motion.cost:.4g} exceeds the collocated plan's cost {plan.cost:.4g} by over {DEARER:.0%}"
    return ended(motion, Status.CONVERGED_NOT_VERIFIED, text, *motion.notes)


def not_in_steps(plan: Solution, refined: Solution) -> Solution:
    """Return a collocated plan that no motion in the model's own steps repeats, and the steps in which it holds."""
    rows = map(_trial, plan.deciding_replays)
    holding = (f"this plan holds {messages.under(t.feedback)} {t.plant}" for t in rows if t.holds)
    where = next(holding, "this plan holds in no steps that were tried")
    step = messages.in_milliseconds(plan.time_step)
    text = f"in continuous time alone: no plan in steps of {step} was verified; {where}"
    return ended(plan, Status.CONVERGED_NOT_VERIFIED, text, plan.message, refined.message, *refined.notes)


def may_be_too_coarse(solution: Solution) -> bool:
    """Return whether a collocated plan passes all checks at its nodes but fails others, which a finer mesh may fix."""
    motion = solution.transcribed
    if solution.status is not Status.CONVERGED_NOT_VERIFIED or motion is None or motion.task.is_map:
        return False
    final = {*ASKED, "overlap", "derivative", "jump", "traced"} - ({"cost"} if np.isfinite(solution.cost) else set())
    return all(c.passes for c in solution.plan_checks if c.plant == PLAN and c.what in final)


def overlaps(solution: Solution) -> bool:
    """Return whether geometries overlap in a collocated motion, which ignores contact."""
    return any(c.what == "overlap" and not c.passes for c in solution.plan_checks)


def unmeasured(draft: Solution, result: NlpResult) -> Solution:
    """Return the draft with the solver's outcome. It is not measured yet, and therefore no success."""
    status = _STATUSES.get(result.outcome, Status.CONVERGED_NOT_VERIFIED)
    fields = {"iterations": result.iterations, "solver_message": result.message}
    return ended(draft, status, result.message, "nothing was measured yet", **fields)


def refused(draft: Solution, error: Exception) -> Solution:
    """Return the draft of a solve that ended because a step failed or had no derivative."""
    status = Status.NO_GRADIENT if isinstance(error, GradientError) else Status.DIVERGED
    return ended(draft, status, str(error))


def ended(draft: Any, status: Status, *sentences: str, **fields: Any) -> Any:
    """Return the draft with its final status. The first of `sentences` is the message, and the others are notes."""
    text, *others = [s for s in sentences if s] or [""]
    is_given = draft.method == GIVEN and status is Status.CONVERGED
    message = headline("verified" if is_given else status.words, text)
    cut = [text] if text not in message else []
    return draft.told(status=status, message=message, notes=(*cut, *others), **fields)


def limits_of(solution: Solution, restarts: int | None) -> Iterator[str]:
    """Yield the limitations of a verified plan: a horizon on its bound, unlimited inputs, a single initial guess."""
    problem = solution.problem
    if not solution.success or isinstance(problem, PhasedProblem):
        return
    if problem.horizon is not None and problem.horizon[0] < problem.horizon[1]:
        for bound in problem.horizon:
            if abs(solution.horizon - bound) <= ON_A_BOUND * bound:
                yield f"the horizon is on its bound of {bound:.4g} s"
        b = problem.bounds
        free = [n for n, *sides in zip(problem.input_names, b.u_lower, b.u_upper, strict=True) if np.isinf(sides).any()]
        if isinstance(problem.running_cost, ConstantCost) and free:
            yield f"the least time of inputs without limits: {messages.joined(free)}"
    if not problem.has_cost:
        yield "not an optimum: the problem has no cost"
    elif not restarts and not any(LOCAL in note or note == NEAR for note in solution.notes):
        yield f"{LOCAL}: no other first guess was tried (restarts=0)"


def advice(solution: Solution, arguments: dict[str, Any], other_methods: Sequence[str]) -> str:
    """Return a clause that suggests what to try, or "" after a success or Ctrl-C.

    `arguments` are those of `solve`. `other_methods` accept the problem and were not tried.
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
        if solution.options.get("max_iterations", most) < most:  # an attempt that searches for a guess
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
    if solution.certificates and solution.certificates[0].verdict == "discontinuous":
        yield "an x0 that is not exactly at a contact or joint limit"
    else:
        blind = status is Status.NO_GRADIENT and touching
        yield "an initial_guess in which the bodies touch" if blind else "another initial_guess"


def _nearer_goals(solution: Solution) -> Iterator[str]:
    """Yield suggestions for the goals that the plan misses."""
    for c in solution.problem.kept_goals:
        knots = solution.problem.knots_of(c, input_at_end=False)
        miss = max(c.miss(solution.xs[solution.knots[k]]) for k in knots)
        if not miss <= c.tolerance:
            yield f"a goal within reach ({c.told(miss)} here)"


def _may_continue(solution: Solution, other_methods: Sequence[str]) -> bool:
    """Return whether iLQR accepts the problem and no attempt was a continuation."""
    chain = solution.options.get("chain", ())
    tried = "continuation" in solution.options or any("continuation" in link for link in chain)
    return not tried and (solution.method == "ilqr" or "ilqr" in other_methods)

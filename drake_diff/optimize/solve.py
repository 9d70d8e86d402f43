"""The door: check what is asked, choose a method or a chain of them, search, measure the result again, judge it."""

import dataclasses
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from hashlib import sha256
from typing import Any, overload

import numpy as np

from drake_diff._base.arrays import Array, frozen, positive_float, positive_int
from drake_diff.certificates.certificate import Certificate
from drake_diff.certificates.certify import certify_inside
from drake_diff.exceptions import DrakeDiffError, GradientError, InputError, SimulationError, UnknownNameError
from drake_diff.model.contact import penetration
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.model.parameters import TIME_STEP, applied
from drake_diff.model.soft_contact import SoftContact
from drake_diff.model.step import set_state
from drake_diff.optimize.advice import advice
from drake_diff.optimize.apart import is_kept_apart, kept_apart
from drake_diff.optimize.certified import certified_knots, certify_equations
from drake_diff.optimize.drake_program import SOLVERS
from drake_diff.optimize.guess import Guess, another_guess, first_guess, sampled
from drake_diff.optimize.ilqr.ilqr import check_problem, is_unconstrained, solve_ilqr
from drake_diff.optimize.ilqr.through_contact import (
    check_schedule,
    moves_shapes,
    solve_continuation,
    solve_through_jumps,
)
from drake_diff.optimize.judge import ended, judged, may_be_too_coarse, overlaps, refused
from drake_diff.optimize.optima import distinct
from drake_diff.optimize.phased import PhasedSolution, solve_phased
from drake_diff.optimize.problem.goals import in_words
from drake_diff.optimize.problem.obstacles import lacking_between, swept
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.problem.timed import TimedCost
from drake_diff.optimize.program import Iteration, Limits, NlpResult, Outcome, Report
from drake_diff.optimize.reach import out_of_reach, why_blind
from drake_diff.optimize.shooting import DEFAULT_SOLVER as SHOOTING_SOLVER
from drake_diff.optimize.shooting import ShootingVariables, check_segments, roll_segments, solve_shooting
from drake_diff.optimize.solution import Search, Solution, Status
from drake_diff.optimize.transcription.between import violation_between_nodes
from drake_diff.optimize.transcription.collocation import (
    FOUND,
    MeshRefinement,
    Transcribed,
    Transcription,
    kept,
)
from drake_diff.optimize.transcription.drake import solve_collocation
from drake_diff.optimize.transcription.task import MAP, SCHEMES, OptimalControl, default_scheme

METHODS = ("auto", "collocation", "shooting", "ilqr")
DEFAULT_SOLVERS = {"collocation": "ipopt", "shooting": SHOOTING_SOLVER, "ilqr": "riccati"}
CLEARANCE_PARTS = (4, 8, 16)  # of a step: looked at where a discrete plan comes too near to an obstacle in between
OTHER_GUESSES = 8  # of a collocation that finds no motion from a straight line
OTHER_ITERATIONS = 200  # of each
OTHER_GUESS = "another first guess"
NOT_FOUND = (Status.INFEASIBLE, Status.ITERATION_LIMIT, Status.DIVERGED, Status.FAILED)
FINER_ROUNDS = 6  # of a mesh whose plan does not hold
GUESS_ITERATIONS = 100  # of an attempt that is to find a guess for the next one
ENDED = (Status.CONVERGED, Status.INTERRUPTED, Status.TIME_LIMIT)
PLANS = (Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED)
# The order in which a chain that ends without a verified motion prefers what it has.
PREFERENCE = (Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED, Status.INTERRUPTED, Status.TIME_LIMIT)

Progress = Callable[[str], None]
Searcher = Callable[[Problem, Array, Array, Array], tuple[NlpResult, Array, Array]]


@overload
def solve(
    problem: Problem,
    *,
    method: str = "auto",
    initial_guess: Any = None,
    scheme: str | None = None,
    solver: str | None = None,
    max_iterations: int = 500,
    time_limit: float | None = None,
    tolerance: float = 1e-8,
    seed: int = 0,
    segments: int = 1,
    continuation: Any = None,
    refine: bool | None = None,
    error_tolerance: float = 1e-6,
    max_num_steps: int = 1000,
    restarts: int = 0,
    progress: bool | Progress = False,
    callback: Callable[[Iteration], None] | None = None,
    on_start: Callable[[], None] | None = None,
) -> Solution: ...
@overload
def solve(
    problem: PhasedProblem,
    *,
    method: str = "auto",
    initial_guess: Any = None,
    scheme: str | None = None,
    max_iterations: int = 500,
    time_limit: float | None = None,
    tolerance: float = 1e-8,
    seed: int = 0,
    refine: bool | None = None,
    error_tolerance: float = 1e-6,
    max_num_steps: int = 1000,
    progress: bool | Progress = False,
    callback: Callable[[Iteration], None] | None = None,
    on_start: Callable[[], None] | None = None,
) -> PhasedSolution: ...
def solve(
    problem: Problem | PhasedProblem,
    *,
    method: str = "auto",
    initial_guess: Any = None,
    scheme: str | None = None,
    solver: str | None = None,
    max_iterations: int = 500,
    time_limit: float | None = None,
    tolerance: float = 1e-8,
    seed: int = 0,
    segments: int = 1,
    continuation: Any = None,
    refine: bool | None = None,
    error_tolerance: float = 1e-6,
    max_num_steps: int = 1000,
    restarts: int = 0,
    progress: bool | Progress = False,
    callback: Callable[[Iteration], None] | None = None,
    on_start: Callable[[], None] | None = None,
) -> Solution | PhasedSolution:
    """Solve `problem`, certify the derivatives that were used, and measure the result again on Drake's plant.

    "auto" chains methods until one is verified: collocation where the model is smooth, or where every coordinate is
    driven and nothing touches in x0; else, or where that fails, iLQR (with a continuation where the guess touches
    nothing that matters), whose result the next one starts from.
    A collocation that finds no motion from a straight line is tried from other first guesses, random ones by `seed`.
    `Solution.options["chain"]` says what was tried, why, and how it ended.

    Args:
        problem: what to optimize, of a model or of plain `Dynamics`; or an `optimize.PhasedProblem`, which collocation
            takes and of which the solution is an `optimize.PhasedSolution`.
        method: "collocation" (in continuous time, for models without contact and for plain dynamics), "shooting"
            (through Drake's own steps, contact included), "ilqr" (the same by Riccati sweeps) or "auto".
        initial_guess: None (a straight line to the goal with inputs near zero; a `TrackingCost`'s reference), a
            Solution of any method, number of steps and horizon, a pair of Drake's trajectories (state, input) as
            `Solution.trajectory` gives, or (xs, us) with shapes (N+1, nx) and (N, nu). Collocation also takes us
            (N+1, nu), and a third entry, the horizon [s]. In phases: a PhasedSolution, or a list, one for each phase.
        scheme: of collocation: "hermite_simpson" (order 4, the default), "trapezoid" (order 2), or "drake", which is
            what Drake's DirectCollocation transcribes.
        solver: "ipopt" or "snopt"; the latter with method="shooting", or with scheme="drake", which then is Drake's
            own DirectCollocation.
        max_iterations: of the solver, and of each round of a refinement.
        time_limit: [s] of the whole solve.
        tolerance: the solver's, on feasibility and optimality.
        seed: of the noise in a default guess, and of the other first guesses.
        segments: of multiple shooting, whose first states are variables too; 1 is single shooting.
        continuation: finds contact that the guess does not make, by stages of a force at a distance before the true
            plant: "auto" or a sequence of SoftContacts, with method="ilqr". `Solution.options` has the stages' log.
        refine: with collocation, whether coarse intervals are split and the problem is solved again. None: where the
            plan does not hold between its knots or in a replay, until it does or every error is at most
            `error_tolerance`. True: until every error is. False: never.
        error_tolerance: of an interval, against an accurate integration, in the states' units; and of its part of
            the cost, relative to the whole.
        max_num_steps: the most intervals of a refined mesh.
        restarts: how many more first guesses are tried, one after the other, smooth random ones by `seed`, also where
            one was verified: the cheapest verified plan is kept, and `Solution.optima` has those that differ.
        progress: True prints a line a few times a second, a function gets each line.
        callback: gets an `Iteration` for each of the solver's (of SNOPT, and of IPOPT by shooting, a few times a
            second). What it raises ends the solve.
        on_start: called once, when all input has been checked and the work begins.

    Returns:
        A `Solution`, whatever happened: how the solve ended is its `status` and `message`.

    Raises:
        InputError: something that was asked for does not fit; nothing ran.
        ModelError: the model cannot do what the method needs.

    Source:
        The schemes of collocation: Kelly, "An Introduction to Trajectory Optimization", SIAM Review 59(4), 2017.
        The refinement of meshes: Betts, "Practical Methods for Optimal Control", ch. 4.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> problem = dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=20, final_cost=lambda x: x[1] ** 2)
        >>> solution = dd.solve(problem, method="collocation")
        >>> solution.success, solution.xs.shape, solution.us.shape
        (True, (21, 2), (20, 1))
    """
    _check_common(problem, seed, callback, progress)
    if method not in METHODS:
        raise UnknownNameError("method", got=method, known=METHODS)
    if solver is not None and solver not in SOLVERS:
        raise UnknownNameError("solver", got=solver, known=SOLVERS)
    if solver is not None and method == "ilqr":
        raise InputError("solver", got=repr(solver), expected='none for method="ilqr", which is its own')
    limits = Limits(
        positive_int("max_iterations", max_iterations),
        np.inf if time_limit is None else positive_float("time_limit [s]", time_limit),
        positive_float("tolerance", tolerance),
    )
    refinement = MeshRefinement(
        positive_float("error_tolerance", error_tolerance), positive_int("max_num_steps", max_num_steps)
    )
    if refine not in (None, True, False):
        raise InputError("refine", got=repr(refine), expected="None, True or False")
    report = Report(print if progress is True else (progress or None), callback)
    arguments: dict[str, Any] = {
        "method": method,
        "scheme": scheme,
        "solver": solver,
        "max_iterations": limits.max_iterations,
        "time_limit": None if time_limit is None else limits.time_limit,
        "tolerance": limits.tolerance,
        "seed": int(seed),
        "segments": int(segments),
        "continuation": _plain_stages(continuation),
        "refine": refine,
        "error_tolerance": refinement.tolerance,
        "max_num_steps": refinement.most,
    }
    if _count("restarts", restarts):
        arguments["restarts"] = int(restarts)
    if isinstance(problem, PhasedProblem):
        if restarts:
            raise InputError("restarts", got=restarts, expected="0 for a PhasedProblem")
        return solve_phased(problem, arguments, initial_guess, report, on_start)
    task = _Task(problem, limits, seed, report, on_start)
    asked = Attempt(method, "asked for", scheme, solver, segments, continuation, int(seed), refine, refinement)
    if method == "auto" and continuation is not None:
        asked = dataclasses.replace(asked, method="ilqr", reason="a continuation is asked for")
    initial_guess = sampled(problem, asked.method, initial_guess)
    in_chain = asked.method in ("auto", "collocation") and segments == 1
    make = partial(_solve_in_chain, task, asked, initial_guess) if in_chain else task.prepare(asked, initial_guess)
    solution = make()
    if restarts:
        solution = _restarted(task, asked, solution, restarts)
    tried = {link["method"] for link in solution.options.get("chain", ())} | {solution.method}
    told = advice(
        solution, arguments, [other for other in METHODS[1:] if other not in tried and _takes(problem, other)]
    )
    message = f"{solution.message}; {told}" if told else solution.message
    return solution.told(message=message, search=Search(arguments, initial_guess))


def _check_common(problem: Any, seed: Any, callback: Any, progress: Any) -> None:
    if not isinstance(problem, (Problem, PhasedProblem)):
        raise InputError("problem", got=type(problem).__name__, expected="a Problem or a PhasedProblem")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError("seed", got=repr(seed), expected="a whole number of at least 0")
    if not (callback is None or callable(callback)):
        raise InputError("callback", got=repr(callback), expected="None or a function of an Iteration")
    if not (isinstance(progress, bool) or callable(progress)):
        raise InputError("progress", got=repr(progress), expected="True, False or a function")


def _count(name: str, given: Any) -> int:
    if isinstance(given, bool) or not isinstance(given, (int, np.integer)) or given < 0:
        raise InputError(name, got=repr(given), expected="a whole number of at least 0")
    return int(given)


def _takes(problem: Problem, method: str) -> bool:
    """Whether `method` can be asked for `problem`, and says anything of its contact."""
    if method == "collocation" and problem.has_model and problem.model.contract.contact.collision_pairs:
        return False
    return _is_possible(problem, Attempt(method, ""))


def _is_possible(problem: Problem, attempt: "Attempt") -> bool:
    try:
        _check_attempt(problem, attempt)
    except DrakeDiffError:
        return False
    return True


def _plain_stages(stages: Any) -> Any:
    """Stages of a continuation as plain numbers; what is none stays as it is, and is refused where it is checked."""
    if not isinstance(stages, (list, tuple)):
        return stages
    return [asdict(stage) if isinstance(stage, SoftContact) else stage for stage in stages]


@dataclass(frozen=True)
class Attempt:
    """One method, and why it is taken; with `max_iterations` where they are fewer than the task's."""

    method: str
    reason: str
    scheme: str | None = None
    solver: str | None = None
    segments: int = 1
    continuation: Any = None
    seed: int = 0
    refine: bool | None = None
    refinement: MeshRefinement | None = None
    max_iterations: int | None = None
    apart: bool = False  # whether links are kept from each other that nothing else keeps apart


@dataclass(eq=False)
class _Task:
    """What all attempts at a problem share."""

    problem: Problem
    limits: Limits
    seed: int
    report: Report
    on_start: Callable[[], None] | None
    start: float = field(default_factory=time.monotonic)

    def prepare(self, attempt: Attempt, given: Any) -> Callable[[], Solution]:
        """Check that `attempt` can be made from the guess `given`; what is returned makes it."""
        problem, method = self.problem, attempt.method
        scheme = _check_attempt(problem, attempt)
        guess = first_guess(problem, method, given, self.seed)
        xs, us = guess.xs, guess.us
        check_segments(problem, method, attempt.segments)
        if attempt.continuation is not None and method != "ilqr":
            expected = f'none for method="{method}"; method="ilqr" takes it'
            raise InputError("continuation", got="given", expected=expected)
        if attempt.continuation is not None and problem.design.vector.parameters:
            given_too = "with parameters or a horizon"
            raise InputError("continuation", got=given_too, expected="none of them: leave the continuation out")
        stages = () if attempt.continuation is None else check_schedule(problem, attempt.continuation)
        left = self.limits.time_limit - (time.monotonic() - self.start)
        most = min(attempt.max_iterations or self.limits.max_iterations, self.limits.max_iterations)
        limits = dataclasses.replace(self.limits, time_limit=max(left, 0.0), max_iterations=most)
        options = {
            "max_iterations": limits.max_iterations,
            "time_limit": None if np.isinf(self.limits.time_limit) else self.limits.time_limit,
            "tolerance": self.limits.tolerance,
            "seed": self.seed,
            "segments": attempt.segments,
            "method_reason": attempt.reason,
            "initial_guess": "default" if given is None else "given",
            "initial_guess_sha256": sha256(xs.tobytes() + us.tobytes()).hexdigest(),
        }
        searched = kept_apart(problem) if attempt.apart else None
        solver = attempt.solver or DEFAULT_SOLVERS[method]
        run = Run(problem, method, scheme, solver, limits, options, self.report, searched)

        def make() -> Solution:
            if self.on_start is not None:
                self.on_start()
                self.on_start = None
            if method == "collocation":
                return run.collocate(guess, attempt.refinement, refine=attempt.refine)
            if method == "ilqr":
                return run.sweep(guess, given=given is not None, stages=stages)
            improve = given is None and attempt.segments == 1 and is_unconstrained(problem)
            return run.shoot(guess, attempt.segments, improve=improve)

        return make


def _solve_in_chain(task: _Task, asked: Attempt, given: Any) -> Solution:
    """Attempt after attempt until one is verified; the best of them, with what was tried in its options.

    A collocation that was asked for is tried from other first guesses alone.
    """
    found: list[Solution] = []
    chain: list[dict[str, str]] = []
    for attempt, guess in _attempts(task.problem, asked, given, found):
        try:
            make = task.prepare(attempt, guess)
        except DrakeDiffError as error:
            if not found:
                raise
            chain.append({"method": attempt.method, "reason": attempt.reason, "ended": f"not possible: {error}"})
            continue
        found.append(make())
        last = found[-1]
        if last.status is not Status.INTERRUPTED:
            task.report.say(f"{attempt.method} ({attempt.reason}): {last.status.value}")
        chain.append({"method": attempt.method, "reason": attempt.reason, "ended": last.status.value})
        if attempt.continuation is not None:
            chain[-1]["continuation"] = "auto"
        if last.status in ENDED:
            break

    best = min(found, key=_preference)
    if asked.method != "auto" and len(chain) == 1:
        return best
    if len(found) > 1 and best.status not in PLANS and all(s.method == "collocation" for s in found):
        best = best.told(message=f"{best.message}; from none of {len(found)} first guesses was a plan found")
    return best.told(options=best.options | {"chain": chain})


def _restarted(task: _Task, asked: Attempt, first: Solution, count: int) -> Solution:
    """The cheapest verified of a solution and of `count` more by the same method, with all optima that were found.

    Ctrl-C and the time limit end it; an attempt that fails is told in the chain.
    """
    told = {"method": first.method, "reason": asked.reason, "ended": first.status.value}
    chain = list(first.options.get("chain", (told,)))
    used = sum(OTHER_GUESS in link["reason"] for link in chain)
    solver = asked.solver if first.method == asked.method else None
    base = dataclasses.replace(asked, method=first.method, solver=solver, continuation=None)
    found = [(first, f"that of {len(chain)} in the chain" if len(chain) > 1 else "the first")]
    for number in range(1, count + 1):
        if found[-1][0].status in (Status.INTERRUPTED, Status.TIME_LIMIT):
            break
        which = f"{OTHER_GUESS}, number {used + number} of seed {asked.seed}"
        attempt = dataclasses.replace(base, reason=f"restart {number} of {count}: {which}")
        begun = another_guess(task.problem, asked.seed, used + number)
        if first.method != "collocation":
            begun = begun[0], begun[1][:-1]
        try:
            found.append((task.prepare(attempt, begun)(), which))
            ended = found[-1][0].status.value
        except DrakeDiffError as error:
            ended = f"not possible: {error}"
        task.report.say(f"{first.method} ({attempt.reason}): {ended}")
        chain.append({"method": first.method, "reason": attempt.reason, "ended": ended})
    best = min((solution for solution, _ in found), key=_preference)
    optima = distinct(found)
    options = best.options | {"chain": chain, "optima": [optimum.to_dict() for optimum in optima]}
    best = best.told(options=options, optima=tuple(optimum.solution for optimum in optima))
    if len(found) > 1 and found[-1][0].status in (Status.INTERRUPTED, Status.TIME_LIMIT):
        best = best.told(message=f"{best.message}; the restarts were ended: {found[-1][0].status.sentence}")
    if not optima:
        return best
    costs = ", ".join(f"{optimum.solution.cost:.4g} ({optimum.count})" for optimum in optima)
    verified = sum(optimum.count for optimum in optima)
    message = f"{verified} of {len(found)} first guesses were verified, at cost (how many): {costs}"
    return best.told(message=f"{best.message}; {message}")


def _preference(solution: Solution) -> tuple[int, float, float]:
    """The order of solutions, the best first: how they ended, how wrong they are where that is no plan, the cost."""
    rank = PREFERENCE.index(solution.status) if solution.status in PREFERENCE else len(PREFERENCE)
    return rank, 0.0 if solution.success else solution.defect + solution.goal_error, solution.cost


def _attempts(problem: Problem, asked: Attempt, given: Any, found: list[Solution]) -> Iterator[tuple[Attempt, Any]]:
    """What to try next and from which guess, by what the attempts before, in `found`, came to."""
    if asked.method == "collocation":
        yield asked, given
        yield from _other_guesses(problem, asked, given, found)
        yield from _kept_apart(problem, asked, found)
        return
    method, reason = choose_method(problem)
    first = dataclasses.replace(asked, method=method, reason=reason, solver=None if method == "ilqr" else asked.solver)
    told = "nothing touches at first, and every coordinate is driven"
    free = dataclasses.replace(asked, method="collocation", reason=told)
    by_steps = method == "ilqr" or (method == "shooting" and problem.couplings)
    if by_steps and _is_free_at_first(problem) and _is_possible(problem, free):
        yield free, given
        yield from _other_guesses(problem, free, given, found)
        yield from _kept_apart(problem, free, found)
    yield first, given
    if method == "collocation":
        yield from _other_guesses(problem, first, given, found)
        yield from _kept_apart(problem, first, found)
    if found[-1].status is Status.NO_GRADIENT and method == "ilqr":
        yield Attempt("ilqr", "the guess has no gradient", continuation="auto"), given
    if method == "shooting" or not problem.has_model or problem.couplings:  # which iLQR does not take
        return
    if method == "collocation":
        reason = "collocation was not verified: a guess for it"
        yield Attempt("ilqr", reason, max_iterations=GUESS_ITERATIONS), given
    if np.all(np.isfinite(found[-1].xs)):
        begun: Any = (found[-1].xs, found[-1].us)
        if problem.design.vector.parameters:
            begun = found[-1]
        after = "collocation" if method == "collocation" else "shooting"
        yield dataclasses.replace(asked, method=after, reason="from the motion that iLQR found"), begun


def _other_guesses(
    problem: Problem, attempt: Attempt, given: Any, found: list[Solution]
) -> Iterator[tuple[Attempt, Any]]:
    """A collocation from other first guesses than a straight line, from which no motion was found."""
    if given is not None or attempt.solver == "snopt":
        return
    for number in range(1, OTHER_GUESSES + 1):
        if found[-1].status not in NOT_FOUND:
            return
        reason = f"no motion was found: {OTHER_GUESS} ({number} of {OTHER_GUESSES})"
        begun = another_guess(problem, attempt.seed, number)
        yield dataclasses.replace(attempt, reason=reason, max_iterations=OTHER_ITERATIONS), begun


def _kept_apart(problem: Problem, attempt: Attempt, found: list[Solution]) -> Iterator[tuple[Attempt, Any]]:
    """A collocation whose links went through each other, from where it ended, with these kept apart."""
    last = found[-1]
    if attempt.solver == "snopt" or last.status is not Status.CONVERGED_NOT_VERIFIED or is_kept_apart(problem):
        return
    if overlaps(last):
        yield dataclasses.replace(attempt, reason="links overlapped: they are kept apart", apart=True), last


def _touches_at_first(problem: Problem) -> bool:
    """Whether geometries touch in x0, so that collocation, which leaves contact out, is no plan of the model."""
    model = problem.model
    if not (model.contract.contact.collision_pairs and problem.optimizes_controls and model.can_rebuild):
        return False
    with applied(problem.parameters):
        set_state(model.double, problem.x0)
        return bool(penetration(model) > 0)


def _is_free_at_first(problem: Problem) -> bool:
    """Whether contact is there to be avoided: nothing needs to be pushed, and in x0 nothing touches.

    A collocated motion in which geometries overlap is not verified, so that one which is has no contact.
    """
    model = problem.model
    contract = model.contract
    if contract.constraints or any(actuator.kp is not None for actuator in contract.actuators):
        return False
    if np.linalg.matrix_rank(model.actuation) < model.nv:
        return False
    set_state(model.double, problem.x0)
    return penetration(model) <= 0


def _check_attempt(problem: Problem, attempt: Attempt) -> str:
    """The scheme, "step" of the discrete methods; refuses what the method cannot take, and what is another's."""
    method, scheme = attempt.method, attempt.scheme
    if method == "collocation":
        return _check_collocation(problem, attempt)
    takes = 'method="collocation" takes it'
    if scheme is not None:
        raise InputError("scheme", got=repr(scheme), expected=f'none for method="{method}"')
    if not problem.has_model:
        expected = f'a model for method="{method}"; method="collocation" takes both'
        raise InputError("problem", got="plain dynamics", expected=expected)
    if problem.horizon is not None and not problem.model.can_rebuild:
        raise InputError(
            "horizon", got="given", expected=f"none for steps of a diagram, which are of one length: {takes}"
        )
    _check_timed_cost(problem)
    if attempt.refine:
        raise InputError("refine", got=True, expected=f'None or False for method="{method}": {takes}')
    if problem.rate_limits and problem.horizon is not None and problem.horizon[0] < problem.horizon[1]:
        expected = f'a horizon that is given for method="{method}": {takes}'
        raise InputError("couplings", got=f"{problem.rate_limits[0]!r} and a free horizon", expected=expected)
    if method == "ilqr":
        check_problem(problem)
    return "step"


def _check_collocation(problem: Problem, attempt: Attempt) -> str:
    scheme = _check_scheme(problem, attempt)
    if attempt.solver == "snopt" and scheme != "drake":
        raise InputError("solver", got='"snopt"', expected=f'"ipopt" for scheme="{scheme}"; scheme="drake" takes both')
    if problem.trajectory_cost is not None:
        raise InputError("trajectory_cost", got="given", expected='method="shooting"')
    if not problem.optimizes_controls:
        raise InputError("optimize", got=list(problem.optimize), expected='"controls" for method="collocation"')
    _check_timed_cost(problem)
    OptimalControl(problem, scheme)  # raises where a cost is no function that can be differentiated
    if attempt.solver == "snopt":  # Drake's DirectCollocation gets bounds, ends and costs alone
        left_out = {
            "dynamics": not problem.has_model,
            "waypoints": problem.waypoints,
            "constraints": problem.constraints,
            "couplings": problem.couplings,
            "goals": problem.goals,
            "horizon": problem.horizon,
            "parameters": problem.parameters.parameters,
            "a running_cost that changes in time": isinstance(problem.running_cost, TimedCost),
            "refine": attempt.refine,
        }
        for name, value in left_out.items():
            if value:
                raise InputError(name, got="given", expected='none for solver="snopt": solver="ipopt" takes it')
    return scheme


def _check_scheme(problem: Problem, attempt: Attempt) -> str:
    scheme = default_scheme(problem) if attempt.scheme is None else attempt.scheme
    if scheme not in SCHEMES:
        raise UnknownNameError("scheme", got=scheme, known=[name for name in SCHEMES if name != MAP])
    if (scheme == MAP) != problem.is_map:
        expected = f"{MAP!r}, as the system is a DiscreteMap" if problem.is_map else "one of motions in time"
        raise InputError("scheme", got=repr(scheme), expected=expected)
    if problem.is_map and attempt.refine:
        raise InputError("refine", got=True, expected="None or False: a DiscreteMap has no intervals to split")
    return scheme


def _check_timed_cost(problem: Problem) -> None:
    if isinstance(problem.running_cost, TimedCost) and problem.horizon and problem.horizon[0] < problem.horizon[1]:
        raise InputError(
            "running_cost", got="one that changes in time", expected="one that does not: the horizon is free"
        )


def choose_method(problem: Problem) -> tuple[str, str]:
    """(method, why)."""
    if not problem.has_model:
        told = "a discrete map is one sparse program" if problem.is_map else "plain dynamics have no discrete step"
        return "collocation", told
    contract = problem.model.contract
    if problem.horizon is not None and not _touches_at_first(problem):
        return "collocation", "the horizon is " + ("free" if problem.horizon[0] < problem.horizon[1] else "given")
    if not problem.optimizes_controls:
        return "shooting", "the controls are not optimized"
    if problem.trajectory_cost is not None:
        return "shooting", "collocation and iLQR take no cost of the whole trajectory"
    smooth = not contract.constraints and all(actuator.kp is None for actuator in contract.actuators)
    if problem.couplings and (contract.contact.collision_pairs or not smooth):
        return "shooting", "iLQR takes no couplings of knots, and collocation leaves out what acts on the model"
    if contract.contact.collision_pairs:
        return "ilqr", "the model has geometries that can touch, which collocation leaves out"
    if not smooth:
        return "ilqr", "the model has constraints or PD control, which collocation leaves out"
    if problem.optimizes_parameters:
        return "collocation", f"the model is smooth, with {', '.join(problem.parameters.names[:3])} among its variables"
    return "collocation", "the model is smooth"


@dataclass(frozen=True, eq=False)
class Run:
    """One solve by one method: certify at the guess, search, certify at the result, measure, judge."""

    problem: Problem
    method: str
    scheme: str
    solver: str
    limits: Limits
    options: dict[str, Any]
    report: Report | None
    searched: Problem | None = None  # what is solved where that is more than what is asked
    start: float = field(default_factory=time.monotonic)
    certified: dict[bytes, Certificate] = field(default_factory=dict)  # by state, input and parameters

    def collocate(self, guess: Guess, refinement: MeshRefinement | None, *, refine: bool | None) -> Solution:
        """In CasADi; SNOPT, which that does not carry, in Drake's own DirectCollocation.

        The mesh is refined where `refine` is True; where it is None, for as long as the plan does not hold.
        """
        if self.solver == "snopt":
            return self._collocate_in_drake(guess)
        problem, limits, report = self.problem, self.limits, self.report
        transcription = Transcription(self.searched or problem, self.scheme)
        try:
            before = certify_equations(self.problem, transcription.jacobian, guess.xs, guess.us, transcription.task)
        except (GradientError, SimulationError) as error:
            return refused(self._draft(guess.xs, guess.us), error)
        us_end = guess.us[-1:] if guess.u_final is None else guess.u_final
        begun = guess.motion or (guess.xs, np.vstack([guess.us, us_end]))
        motion = transcription.solve(
            begun,
            horizon=guess.horizon,
            limits=limits,
            report=report,
            refinement=refinement if refine else None,
            parameters=guess.parameters,
            far=guess.line,
            **self._known(transcription, guess, finer=refine is not False),
        )
        if refine:
            self.options["refinements"] = [list(each) for each in motion.refinements]
        if motion.cleared:
            self.options["clearance_rounds"] = [list(each) for each in motion.cleared]

        def judged(motion: Transcribed) -> Solution:
            return self._judge_collocated(transcription, motion, before)

        solution = judged(motion)
        if refine is not None or refinement is None:
            return solution
        return self._refined(transcription, motion, solution, refinement, judged)

    def _known(self, transcription: Transcription, guess: Guess, *, finer: bool) -> dict[str, Any]:
        """The mesh and the multipliers of a guess by the same scheme and in as many steps; `finer` may it be."""
        motion = guess.motion
        if motion is None or motion.task.scheme is not transcription.task.scheme:
            return {}
        same = motion.task.problem.num_steps == self.problem.num_steps
        if not same or (len(motion.mesh) > self.problem.num_steps + 1 and not finer):
            return {}
        return {"mesh": np.asarray(motion.mesh), "multipliers": guess.multipliers}

    def _refined(
        self,
        transcription: Transcription,
        motion: Transcribed,
        solution: Solution,
        until: MeshRefinement,
        judged: Callable[[Transcribed], Solution],
    ) -> Solution:
        """`solution`, or that on a mesh which is made finer for as long as the plan does not hold."""
        rounds = list(motion.refinements)
        for _ in range(FINER_ROUNDS):
            if not may_be_too_coarse(solution):
                break
            exceeded = violation_between_nodes(motion).intervals
            if motion.largest_error <= until.tolerance and not exceeded:
                break  # what does not hold is not the mesh's
            left = self.limits.time_limit - (time.monotonic() - self.start)
            limits = dataclasses.replace(self.limits, time_limit=max(left, 0.0))
            finer = transcription.finer(motion, exceeded, until.most, limits, self.report)
            if finer is None:
                break
            if finer.result.outcome not in FOUND:
                last = kept(motion, finer).result
                if last.outcome not in FOUND:
                    return self._judge(solution, last)
                return solution.told(message=f"{solution.message}; {last.note}")
            motion = finer
            rounds.append((len(finer.mesh) - 1, finer.largest_error))
            self.options["refinements"] = [list(each) for each in rounds]
            solution = judged(motion)
        if len(rounds) > 1:
            told = f"the mesh was refined from {rounds[0][0]} to {rounds[-1][0]} intervals"
            solution = solution.told(message=f"{solution.message}; {told}")
        return solution

    def _collocate_in_drake(self, guess: Guess) -> Solution:
        """By Drake's own DirectCollocation."""
        jacobian = EquationsOfMotion(self.problem.model).jacobian
        try:
            certificates = certify_equations(self.problem, jacobian, guess.xs, guess.us)
        except (GradientError, SimulationError) as error:
            return refused(self._draft(guess.xs, guess.us), error)
        result, xs, us, u_final = solve_collocation(
            self.problem, guess.xs, guess.us, solver=self.solver, limits=self.limits, report=self.report
        )
        if np.all(np.isfinite(xs)):
            certificates += certify_equations(self.problem, jacobian, xs, us)
        return self._judge(self._draft(xs, us, u_final=u_final, certificates=certificates), result)

    def _judge_collocated(
        self, transcription: Transcription, motion: Transcribed, certificates: tuple[Certificate, ...]
    ) -> Solution:
        xs, us = motion.xs, motion.us[:-1]
        self.options["derivatives"] = motion.derivatives
        if np.all(np.isfinite(xs)):
            certificates += certify_equations(self.problem, transcription.jacobian, xs, us, motion.task)
        draft = self._draft(
            xs,
            us,
            u_final=None if self.problem.is_map else motion.us[-1],
            us_mid=None if self.scheme == "drake" else motion.us_mid,
            free_horizon=motion.horizon if self.problem.horizon else None,
            mesh=motion.mesh if len(us) > self.problem.num_steps else None,
            parameters=frozen(motion.task.parameters),
            multipliers=motion.result.multipliers,
            certificates=certificates,
        )
        return self._judge(draft, motion.result)

    def sweep(self, guess: Guess, *, given: bool, stages: tuple[SoftContact, ...]) -> Solution:
        """iLQR; from the states of a `given` guess, which need not be a rollout, else from the rollout of `us`.

        With `stages`, which take the inputs of the guess alone, it need not have a gradient.
        """
        xs, us = guess.xs, guess.us
        limits, report, first = self.limits, self.report, iter([xs] if given else [])

        def search(problem: Problem, rolled: Array, us: Array, values: Array) -> tuple[NlpResult, Array, Array]:
            if stages:
                result, xs_found, us, logs = solve_continuation(problem, us, stages, limits=limits, report=report)
                self.options["continuation"] = [asdict(log) for log in logs]
                return result, xs_found, us
            touches = problem.model.contract.contact.collision_pairs and not moves_shapes(problem)
            begin = next(first, rolled)
            if touches:
                return solve_through_jumps(problem, begin, us, limits=limits, report=report, values=values)
            known = guess.multipliers
            return solve_ilqr(problem, begin, us, limits=limits, report=report, values=values, begun=known)

        return self._through_steps(xs, us, search, guess, may_be_blind=bool(stages))

    def shoot(self, guess: Guess, segments: int, *, improve: bool) -> Solution:
        """Shooting; `improve` the guess by iLQR, which gets out of curved valleys that shooting crawls along.

        Several `segments` are looked at around their own states, which defects part.
        """
        limits, report, xs, us = self.limits, self.report, guess.xs, guess.us
        if segments > 1:
            try:
                xs = roll_segments(self.problem, xs, us, segments)
            except SimulationError as error:
                return refused(self._draft(xs, us), error)

        def search(problem: Problem, xs: Array, us: Array, values: Array) -> tuple[NlpResult, Array, Array]:
            if improve:
                result, xs, us = solve_ilqr(problem, xs, us, limits=limits, report=report)
                self.options["initial_guess"] = f"default, then {result.message}"
                if result.outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT):
                    return result, xs, us
            options: dict[str, Any] = {"solver": self.solver, "segments": segments, "values": values}
            return solve_shooting(problem, xs, us, limits=limits, report=report, **options)

        return self._through_steps(xs, us, search, guess, segmented=segments > 1)

    def _through_steps(
        self,
        xs: Array,
        us: Array,
        search: Searcher,
        guess: Guess,
        *,
        segmented: bool = False,
        may_be_blind: bool = False,
    ) -> Solution:
        """Certify, search, certify again, on Drake's own steps; at rollouts, or at the states as they are."""
        variables, values = ShootingVariables(self.problem, around=xs if segmented else None), self._first_values(guess)
        try:
            xs, us, before, blindness = self._look_at(variables, variables.pack(xs[0], us, values))
        except (GradientError, SimulationError) as error:
            return refused(self._draft(xs, us), error)
        if blindness and not may_be_blind:
            return ended(self._draft(xs, us, certificates=before), Status.NO_GRADIENT, blindness)
        try:
            result, xs, us = self._keeping_clear(search, xs, us, values)
            variables = ShootingVariables(self.problem, around=xs if segmented else None)
            z = variables.pack(xs[0], us, result.parameters)
            if self.method == "shooting" and len(result.z) == variables.size:
                z = np.clip(result.z, *variables.limits())  # which solvers keep within their tolerance
            xs, us, after, blindness = self._look_at(variables, z)
        except (GradientError, SimulationError) as error:
            return refused(self._draft(xs, us, certificates=before), error)
        values = variables.parameters(z).values
        if result.note:
            self.options["contact_sequence"] = result.note
        design, horizon = self.problem.design, None
        if self.problem.horizon is not None:
            horizon = float(np.clip(design.time_step(values) * self.problem.num_steps, *self.problem.horizon))
        found = {"certificates": before + after, "parameters": frozen(design.own(values)), "free_horizon": horizon}
        solution = self._judge(self._draft(xs, us, multipliers=result.multipliers, **found), result)
        return ended(solution, Status.NO_GRADIENT, blindness) if blindness and solution.success else solution

    def _first_values(self, guess: Guess) -> Array:
        """(np,) those of the problem's `design` where a search begins."""
        problem, design = self.problem, self.problem.design
        own = problem.parameters.values if guess.parameters is None else guess.parameters
        first = problem.start_horizon if guess.horizon is None else guess.horizon
        h = (first if problem.horizon is None else float(np.clip(first, *problem.horizon))) / problem.num_steps
        return np.clip(design.whole(own, h), design.lower, design.upper)

    def _keeping_clear(self, search: Searcher, xs: Array, us: Array, values: Array) -> tuple[NlpResult, Array, Array]:
        """What `search` finds; where it comes too near to an obstacle between two states, again with these in view."""
        problem, rounds, guess = self.problem, list[list[float]](), (xs, us)
        result, xs, us = search(problem, xs, us, values)
        for parts in CLEARANCE_PARTS:
            lacking, enters = lacking_between(problem.kept, xs)
            if not lacking or result.outcome not in (Outcome.SOLVED, Outcome.INACCURATE, Outcome.ITERATION_LIMIT):
                break
            if self.report is not None:
                self.report.say(f"{in_words(lacking, 'm')} too near to an obstacle within a step: {parts} parts")
            last = self._values_of(result, values)
            more = swept(self.problem.kept, problem.design.time_step(last), parts)
            wider = dataclasses.replace(problem, constraints=(*problem.constraints, *more))
            result, xs, us = search(wider, *((*guess, values) if enters else (xs, us, last)))
            rounds.append([parts, lacking])
        if rounds:
            self.options["clearance_rounds"] = rounds
        return result, xs, us

    def _values_of(self, result: NlpResult, first: Array) -> Array:
        """(np,) what a search found, that began at `first`."""
        if result.parameters is not None:
            return result.parameters
        variables = ShootingVariables(self.problem)
        return variables.parameters(result.z).values if len(result.z) == variables.size else first

    def _judge(self, draft: Solution, result: NlpResult) -> Solution:
        """`judged`, and no success where the cost asks for a motion that nothing here could have begun."""
        solution, problem = judged(draft, result), self.problem
        if solution.status not in PLANS or not problem.has_model:
            return solution
        xs, us = solution.plan.sample(1)
        variables = ShootingVariables(problem, around=xs)
        try:
            found = out_of_reach(problem, variables, variables.pack(xs[0], us, solution.step_vector.values))
        except (GradientError, SimulationError) as error:
            detail = f"whether the cost asks for what nothing moves cannot be told: {error}"
            return ended(solution, Status.CONVERGED_NOT_VERIFIED, detail)
        if found.silent:
            return ended(solution, Status.NO_GRADIENT, found.silent)
        return solution.told(message=f"{solution.message}; {found.constant}") if found.constant else solution

    def _draft(self, xs: Array, us: Array, **found: Any) -> Solution:
        arrays = ("u_final", "us_mid", "mesh")
        found |= {name: frozen(found[name]) for name in arrays if found.get(name) is not None}
        found |= {"scheme": self.scheme, "options": self.options, "wall_time": time.monotonic() - self.start}
        return Solution(self.problem, self.method, self.solver, Status.FAILED, "", frozen(xs), frozen(us), **found)

    def _look_at(self, variables: ShootingVariables, z: Array) -> tuple[Array, Array, tuple[Certificate, ...], str]:
        """xs and us of z, certificates of some of its steps, and why the goal or cost is out of its reach."""
        us = variables.unpack(z)[1]
        xs, parameters = variables.states(z), variables.parameters(z).to_dict()
        model, design = self.problem.model, self.problem.design
        if design.has_step and not design.moves_step:
            model = model.at_time_step(float(parameters.pop(TIME_STEP)[0]))

        def certificate(x: Array, u: Array) -> Certificate:
            """That of a search which ends where it began is known: it costs as much as the search."""
            at = x.tobytes() + u.tobytes() + repr(parameters).encode()
            if at not in self.certified:
                self.certified[at] = certify_inside(model, x, u, parameters=parameters)
            return self.certified[at]

        certificates = tuple(certificate(xs[k], us[k]) for k in certified_knots(us))
        return xs, us, certificates, why_blind(self.problem, variables, z)

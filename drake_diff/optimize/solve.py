"""The entry point: validate the input, choose a method or a chain of methods, search, and verify the result."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from typing import Any, overload

import numpy as np

from drake_diff._base.arrays import LARGEST_SEED, count, positive_float, positive_int
from drake_diff._base.autodiff import noted
from drake_diff._base.clock import now, uncounted
from drake_diff.exceptions import DrakeDiffError, InputError, SimulationError, UnknownNameError
from drake_diff.model.contact import penetration
from drake_diff.model.parameters import applied
from drake_diff.model.step import set_state
from drake_diff.motion.intervals import roll
from drake_diff.motion.rollout import CONTINUOUS
from drake_diff.optimize.continuation import check_schedule
from drake_diff.optimize.guess import another_guess, first_guess, first_guesses, on_feet, other_guess, sampled
from drake_diff.optimize.ilqr.ilqr import check_problem, takes
from drake_diff.optimize.options import Options
from drake_diff.optimize.path_timing import PathTiming
from drake_diff.optimize.phased import PhasedSolution
from drake_diff.optimize.problem.cost import changes_in_time
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iteration, Limits, Report
from drake_diff.optimize.run import Run, closest_to, is_kept_apart, kept_apart
from drake_diff.optimize.solution import PLANS, Search, Solution, Status, distinct
from drake_diff.optimize.starts import search_cheaper
from drake_diff.optimize.transcription.task import MAP, SCHEMES, OptimalControl, default_scheme
from drake_diff.optimize.verification import LOCAL, NEAR, advice, limits_of, near, not_in_steps, overlaps

COMPILED = 0.5  # [s] a longer compilation is reported
DEFAULTS = Options()
METHODS = ("auto", "collocation", "shooting", "ilqr")
DEFAULT_SOLVERS = {"collocation": "ipopt", "shooting": "ipopt", "ilqr": "riccati"}
OTHER_GUESS = "another first guess"
OTHER_STARTS = {"method": "collocation", "reason": "other first guesses"}
MOST_VERIFIED = 3  # of the cheaper motions from random guesses
REFINING = 50  # iterations from a collocated plan to the optimum in steps; many take ten, a Panda at its bounds 45
ON_FEET = 2.0  # largest cost of a motion on fixed feet, relative to one that was not verified
NOT_FOUND = (Status.INFEASIBLE, Status.ITERATION_LIMIT, Status.DIVERGED, Status.FAILED)
BLIND = (Status.NO_GRADIENT, Status.DIVERGED)
ENDED = (Status.CONVERGED, Status.INTERRUPTED, Status.TIME_LIMIT)
# The order of preference among the solutions of a chain that ends without a verified motion.
PREFERENCE = (Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED, Status.INTERRUPTED, Status.TIME_LIMIT)

Progress = Callable[[str], None]


@overload
def solve(problem: Problem | PathTiming, **asked: Any) -> Solution: ...
@overload
def solve(problem: PhasedProblem, **asked: Any) -> PhasedSolution: ...
def solve(  # type: ignore[misc]  # only this signature lists the keywords
    problem: Problem | PhasedProblem | PathTiming,
    *,
    method: str = "auto",
    initial_guess: Any = None,
    max_iterations: int = 500,
    time_limit: float | None = None,
    seed: int = 0,
    restarts: int | None = None,
    options: Options | None = None,
    progress: bool | Progress = False,
    callback: Callable[[Iteration], None] | None = None,
    view: bool | Callable[[str], None] = False,
) -> Solution | PhasedSolution:
    """Solve `problem`, certify the derivatives that were used, and verify the result on Drake's plant.

    "auto" chains methods until a result is verified. It chooses collocation if the model is smooth, or if every
    coordinate is driven and no bodies touch in x0. It chooses shooting if inputs are commanded positions and no bodies
    touch in x0. Otherwise, or if that fails, it uses iLQR (with a continuation if the guess makes no relevant contact),
    and the next method starts from iLQR's result. A collocation that finds no motion from a straight line is repeated
    from random initial guesses by `seed`. `Solution.options["chain"]` lists all attempts, their reasons and how they
    ended.

    Args:
        problem: the problem of a model or of plain `Dynamics`, or an `optimize.PhasedProblem`, which requires
            collocation and whose solution is an `optimize.PhasedSolution`; or an `optimize.PathTiming`, for which only
            `max_iterations`, `time_limit` and `progress` apply.
        method: "collocation" (in continuous time, for models without contact, closed loops included, and for plain
            dynamics), "shooting" (through Drake's own steps, contact included), "ilqr" (the same by Riccati sweeps) or
            "auto".
        initial_guess: None (a straight line to the goal with inputs near zero, or a `TrackingCost`'s reference), a
            Solution of any method, number of steps and horizon, a pair of Drake trajectories (state, input) as in
            `Solution.trajectory`, one of states or of positions alone, or (xs, us) with shapes (N+1, nx) and (N, nu).
            Collocation also takes us (N+1, nu), and a third entry, the horizon [s]. For phases: a PhasedSolution, or a
            list with a guess for each phase.
        max_iterations: the iteration limit of the solver, and of each round of a refinement.
        time_limit: [s] of the whole solve. Numba's compilation, once per machine, is excluded, and a note reports it.
        seed: the seed of the noise in a default guess, and of random initial guesses.
        restarts: the number of further initial guesses, smooth random ones by `seed`, all tried in turn even if a plan
            is verified. The cheapest verified plan is returned, and `Solution.optima` has those that differ. None: if
            "auto" finds a collocated plan from its own guess, it searches from up to 12 such guesses, fewer if these
            lead to the same cost, and verifies the cheapest motions. Their number depends on iterations, not on time.
        options: further options of the algorithms, an `optimize.Options`: schemes, tolerances, continuations through
            contact, refinement of meshes.
        progress: True prints a line a few times a second. A function is called with each line.
        callback: called with an `optimize.Iteration` for each iteration of the solver, with its times, xs, us and
            contacts. SNOPT, and IPOPT in shooting, do not report the ends of iterations. For these, it is called with
            an evaluated point a few times a second. Relaxed stages do not call it. An exception from it ends the solve.
        view: True serves a page for browsers on this machine and prints its address. A function is called with the
            address. The page shows the iterates in Drake's Meshcat with their cost and violation, and at the end the
            motion of the plan for playback. It takes time, but does not change the result. It is served until the
            process ends. Plain dynamics and phases have no page.

    Returns:
        A `Solution` in all cases. Its `status`, `message` and `notes` describe how the solve ended.

    Raises:
        InputError: an argument is invalid; nothing ran.
        ModelError: the model does not support the method.

    Source:
        Collocation schemes: Kelly, "An Introduction to Trajectory Optimization", SIAM Review 59(4), 2017.
        Mesh refinement: Betts, "Practical Methods for Optimal Control", ch. 4.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> problem = dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=20, final_cost=lambda x: x[1] ** 2)
        >>> solution = dd.solve(problem, method="collocation")
        >>> solution.success, solution.xs.shape, solution.us.shape
        (True, (21, 2), (20, 1))
    """
    _check_common(problem, seed, callback, progress, view)
    if method not in METHODS:
        raise UnknownNameError("method", got=method, known=METHODS)
    if not (options is None or isinstance(options, Options)):
        raise InputError("options", got=f"{options!r:.80}", expected="an optimize.Options")
    chosen = Options() if options is None else options
    chosen.check_method(method)
    limits = Limits(
        positive_int("max_iterations", max_iterations),
        np.inf if time_limit is None else positive_float("time_limit [s]", time_limit),
        chosen.tolerance,
    )
    report = Report(
        print if progress is True else (progress or None),
        callback and partial(noted, "callback", callback),
        chosen.on_plan,
    )
    if isinstance(problem, PathTiming):
        unused = {"method": method != "auto", "initial_guess": initial_guess is not None, "restarts": bool(restarts)}
        unused |= {
            "options": replace(chosen, on_start=None) != DEFAULTS,
            "callback": callback is not None,
            "view": view is not False,
        }
        for name in (name for name, is_given in unused.items() if is_given):
            raise InputError(name, got="a value", expected="no value for a PathTiming")
        return problem.solved(limits, report.say, chosen.on_start)
    arguments: dict[str, Any] = {
        "method": method,
        "max_iterations": limits.max_iterations,
        "time_limit": None if time_limit is None else limits.time_limit,
        "seed": int(seed),
        "options": chosen.to_dict(),
    }
    if restarts is None or count("restarts", restarts, 0):
        arguments["restarts"] = restarts
    asked = Attempt(method, "asked for", chosen, int(seed))
    report.asked = Search(arguments, initial_guess)
    compiled = uncounted()
    if view is False:
        solution = _solved(problem, asked, limits, restarts, report, chosen.on_start)
        return _with_compilation(solution, uncounted() - compiled, report)
    from drake_diff.optimize.live import LiveSearch  # imports a web server

    live = LiveSearch(problem, _print_address if view is True else view)
    with live.running(chosen.on_start) as start:
        solution = _solved(problem, asked, limits, restarts, live.beside(report), start)
        live.end(solution)
    return _with_compilation(solution, uncounted() - compiled, report)


def _with_compilation(solution: Solution | PhasedSolution, seconds: float, report: Report) -> Solution | PhasedSolution:
    """Report a long compilation by Numba, and add a note to a solution that the time limit ended."""
    if seconds < COMPILED:
        return solution
    note = f"Numba compiled for {seconds:.2g} s, once on this machine, which no time limit counts"
    report.say(note)
    if solution.status is not Status.TIME_LIMIT:
        return solution
    return solution.noted(note)


def _print_address(address: str) -> None:
    print(f"the search is shown at {address}", flush=True)


def _solved(
    problem: Problem | PhasedProblem,
    asked: "Attempt",
    limits: Limits,
    restarts: int | None,
    report: Report,
    on_start: Callable[[], None] | None,
) -> Solution | PhasedSolution:
    """Solve with the arguments of `report.asked`, which have been validated one by one."""
    arguments, initial_guess = report.asked.arguments, report.asked.guess
    task = _Task(problem, limits, asked.seed, report, on_start)
    if isinstance(problem, PhasedProblem):
        if restarts:
            raise InputError("restarts", got=restarts, expected="0 for a PhasedProblem")
        asked.options.check_method("collocation")
        method = "collocation" if asked.method == "auto" else asked.method
        asked = replace(asked, method=method, reason="a straight line" if initial_guess is None else "given")
        return _solve_in_chain(task, asked, initial_guess).told(search=report.asked)
    if asked.method == "auto" and asked.options.continuation is not None:
        asked = replace(asked, method="ilqr", reason="a continuation is asked for")
    initial_guess = sampled(problem, asked.method, initial_guess)
    in_chain = asked.method in ("auto", "collocation")
    make = partial(_solve_in_chain, task, asked, initial_guess) if in_chain else task.prepare(asked, initial_guess)
    solution = make()
    if restarts:
        solution = _restarted(task, asked, solution, restarts)
    elif restarts is None and asked.method == "auto" and initial_guess is None:
        solution = _from_other_starts(task, asked, solution)
    tried = {link["method"] for link in solution.options.get("chain", ())} | {solution.method}
    suggestion = advice(
        solution, arguments, [other for other in METHODS[1:] if other not in tried and _takes(problem, other)]
    )
    notes = (suggestion,) if suggestion else tuple(limits_of(solution, restarts))
    return solution.noted(*notes).told(search=Search(arguments, initial_guess))


def _check_common(problem: Any, seed: Any, callback: Any, progress: Any, view: Any) -> None:
    if not isinstance(problem, (Problem, PhasedProblem, PathTiming)):
        raise InputError("problem", got=type(problem).__name__, expected="a Problem, a PhasedProblem or a PathTiming")
    count("seed", seed, 0, LARGEST_SEED)
    for phase in () if isinstance(problem, PathTiming) else problem.phases:
        phase.check_derivatives()
        if phase.has_model and phase.nu == 0 and set(phase.optimize) == {"controls"} and phase.horizon is None:
            raise InputError("optimize", got='"controls", but the model has no actuators', expected="an actuated model")
    if not (callback is None or callable(callback)):
        raise InputError("callback", got=repr(callback), expected="a function of an Iteration, or None")
    if not (isinstance(progress, bool) or callable(progress)):
        raise InputError("progress", got=repr(progress), expected="True, False or a function")
    if not (isinstance(view, bool) or callable(view)):
        raise InputError("view", got=repr(view), expected="True, False or a function")


def _takes(problem: Problem, method: str) -> bool:
    """Return whether `method` accepts `problem` and does not ignore its contact."""
    if method == "collocation" and problem.has_model and problem.model.contract.contact.collision_pairs:
        return False
    return _is_possible(problem, Attempt(method, ""))


def _is_possible(problem: Problem, attempt: "Attempt") -> bool:
    try:
        _check_attempt(problem, attempt)
    except DrakeDiffError:
        return False
    return True


@dataclass(frozen=True)
class Attempt:
    """A method with its options and a reason. `max_iterations` is set if it is less than the task's."""

    method: str
    reason: str
    options: Options = DEFAULTS
    seed: int = 0
    max_iterations: int | None = None
    apart: bool = False  # whether additional constraints keep links apart
    closest: bool = False  # whether to search for the motion nearest to the guess, regardless of its cost

    def told(self, in_phases: bool) -> dict[str, str]:
        """Return the attempt's entry in the chain."""
        return {"guess": self.reason} if in_phases else {"method": self.method, "reason": self.reason}

    def by(self, method: str, reason: str) -> "Attempt":
        """Return the attempt with a chosen `method` and the options that it accepts."""
        return replace(self, method=method, reason=reason, options=self.options.of_method(method))


@dataclass(eq=False)
class _Task:
    """The data that all attempts at a problem share."""

    problem: Any
    limits: Limits
    seed: int
    report: Report
    on_start: Callable[[], None] | None
    start: float = field(default_factory=now)
    collocated: list[Solution] = field(default_factory=list)  # plans that pass their own checks, unverified
    converted: list[Solution] = field(default_factory=list)  # solutions in steps from collocated plans

    @property
    def is_late(self) -> bool:
        """Return whether the time limit has passed."""
        return now() - self.start > self.limits.time_limit

    def begin(self) -> None:
        """Call `on_start` once, when the work begins."""
        on_start, self.on_start = self.on_start, None
        if on_start is not None:
            on_start()

    def prepare(self, attempt: Attempt, given: Any, convert: Any = None) -> Callable[[], Any]:
        """Check that `attempt` is possible from the guess `given`, and return a function that runs it.

        A collocated plan that passes its own checks goes to `convert`, whose solution replaces it.
        """
        problem, method = self.problem, attempt.method
        scheme = _check_attempt(problem, attempt)
        guesses = first_guesses(problem, method, given, self.seed)
        continuation = attempt.options.continuation
        if continuation is not None and problem.design.vector.parameters:
            given_too = "a continuation with parameters or a horizon"
            raise InputError(
                "continuation", got=given_too, expected="no continuation, or a problem without parameters and horizon"
            )
        stages = () if continuation is None else check_schedule(problem, continuation)
        searched = kept_apart(problem) if attempt.apart else closest_to(problem, given) if attempt.closest else None
        limits = self.limits_of(attempt)
        options = {
            "max_iterations": limits.max_iterations,
            "time_limit": None if np.isinf(self.limits.time_limit) else self.limits.time_limit,
            "tolerance": self.limits.tolerance,
            "seed": self.seed,
            "method_reason": attempt.reason,
            "initial_guess": "default" if self._is_default(given) else "given",
            "initial_guess_sha256": sha256(b"".join(g.xs.tobytes() + g.us.tobytes() for g in guesses)).hexdigest(),
        }
        if isinstance(problem, PhasedProblem):
            options = {name: options[name] for name in ("initial_guess", "seed")}
        solver = attempt.options.solver or DEFAULT_SOLVERS[method]
        run = Run(
            *(problem, method, scheme, solver, limits, attempt.options, options, self.report, searched),
            closest=attempt.closest,
            convert=convert,
        )

        def make() -> Solution:
            if method == "collocation":
                search = partial(run.collocate, guesses)
            elif method == "ilqr":
                search = partial(run.sweep, guesses, given=given is not None, stages=stages)
            else:
                search = partial(run.shoot, guesses, given=given is not None)
            return run.within_time(search, guesses, self.begin)

        return make

    def _is_default(self, given: Any) -> bool:
        """Return whether a search begins from a default guess. For phases, this depends on the user's guess only."""
        return (self.report.asked.guess if isinstance(self.problem, PhasedProblem) else given) is None

    def limits_of(self, attempt: Attempt) -> Limits:
        """Return the limits that remain for an attempt."""
        most = min(attempt.max_iterations or self.limits.max_iterations, self.limits.max_iterations)
        return replace(self.limits.after(self.start), max_iterations=most)


def _solve_in_chain(task: _Task, asked: Attempt, given: Any) -> Any:
    """Run attempts until a result is verified, and return the best result, with all attempts in its options.

    If collocation was requested, only other initial guesses are tried.
    """
    chain: list[dict[str, str]] = []
    in_phases = isinstance(task.problem, PhasedProblem)
    solutions = _attempted(task, asked, given, chain)
    best = _best_of(solutions)
    if asked.method == "auto" and not in_phases:
        best = _in_steps(task, asked, best, chain)
    if asked.method != "auto" and len(chain) == 1 and not in_phases:
        return best
    by_collocation = in_phases or all(s.method == "collocation" for s in solutions)
    if len(solutions) > 1 and best.status not in PLANS and by_collocation:
        best = best.noted(f"no plan was found from {len(solutions)} first guesses")
    return best.told(options=best.options | {"chain": chain})


def _attempted(task: _Task, asked: Attempt, given: Any, chain: list[dict[str, str]]) -> list[Any]:
    """Return the solutions of all attempts, of which the last may be verified. `chain` gets a row for each attempt."""
    solutions: list[Any] = []
    in_phases = isinstance(task.problem, PhasedProblem)
    for attempt, guess in _attempts(task.problem, asked, given, solutions):
        if solutions and task.is_late:
            chain.append({**attempt.told(in_phases), "ended": "not begun: time limit"})
            break
        early = asked.method == "auto" and attempt.method == "collocation" and not in_phases
        rows: list[dict[str, str]] = []
        try:
            make = task.prepare(attempt, guess, _conversion(task, asked, rows) if early else None)
        except DrakeDiffError as error:
            if not solutions:
                raise
            chain.append({**attempt.told(in_phases), "ended": f"not possible: {error}"})
            continue
        solutions.append(make())
        last = solutions[-1]
        if last.status is not Status.INTERRUPTED:
            task.report.say(f"{attempt.method} ({attempt.reason}): {last.status.value}")
        chain.append({**attempt.told(in_phases), "ended": last.status.value})
        if attempt.options.continuation is not None:
            chain[-1]["continuation"] = "auto"
        chain += rows
        if last.status in ENDED:
            break
    return solutions


def _conversion(
    task: _Task, asked: Attempt, rows: list[dict[str, str]]
) -> Callable[[Solution], Solution | None] | None:
    """Return a function that solves in steps from a collocated plan, or None if the problem has no steps.

    This comes before the plan's replays and finer meshes, which take longer and are often not needed.
    """

    def convert(plan: Solution) -> Solution | None:
        if rows:
            return None
        task.collocated.append(plan)
        _convert(task, _to_steps(task.problem, asked)[0], plan, rows)
        last = task.converted[-1] if task.converted else None
        return last if last is not None and last.status in (Status.CONVERGED, Status.INTERRUPTED) else None

    return convert if _has_steps(task.problem) else None


def _in_steps(task: _Task, asked: Attempt, plan: Solution, chain: list[dict[str, str]]) -> Solution:
    """Refine a collocated plan into the model's own steps: to their optimum, or else to their nearest motion.

    If steps are not small, their optimum may exploit their errors. A plan that no such steps repeat is not verified. A
    plan stays in continuous time if the problem has a horizon, if its jerk is limited (jerk jumps with a held input),
    or if the steps do not support the problem.
    """
    if not (plan.success and plan.transcribed is not None and _has_steps(task.problem)):
        return plan
    for attempt in _to_steps(task.problem, asked)[1 if task.converted and "refinements" not in plan.options else 0 :]:
        last = task.converted[-1] if task.converted else None
        if last is not None and last.status in ENDED:
            break
        if last is not None and last.method == "ilqr" and last.status in PLANS and not attempt.closest:
            continue  # another method would find the same optimum
        if attempt.method == "shooting" or _is_possible(task.problem, attempt):
            _convert(task, attempt, plan, chain)
    if not task.converted:
        return plan.noted("in continuous time alone: no method takes the problem in the model's own steps")
    return task.converted[-1] if task.converted[-1].success else not_in_steps(plan, task.converted[0])


def _to_steps(problem: Problem, asked: Attempt) -> tuple[Attempt, ...]:
    """Return the attempts in the model's own steps from a collocated plan, in their order."""
    reason = "the collocated plan in the model's own steps"
    nearest = "the motion in the model's own steps that is nearest to the collocated plan"
    shooting = replace(asked.by("shooting", reason), max_iterations=REFINING)
    by_ilqr = replace(asked.by("ilqr", f"{reason}, by iLQR"), max_iterations=REFINING)
    first, second = (by_ilqr, shooting) if _has_soft_goals(problem) else (shooting, by_ilqr)
    last = replace(first, reason=nearest, closest=True, max_iterations=5 * REFINING)
    return first, second, last


def _has_steps(problem: Problem) -> bool:
    return problem.has_model and problem.horizon is None and all(limit.of_inputs for limit in problem.rate_limits)


def _convert(task: _Task, attempt: Attempt, plan: Solution, chain: list[dict[str, str]]) -> None:
    """Run an attempt in the model's own steps from a collocated plan, and add its solution to `task.converted`."""
    try:
        make = task.prepare(attempt, plan)
    except DrakeDiffError as error:
        chain.append({**attempt.told(False), "ended": f"not possible: {error}"})
        return
    task.converted.append(near(plan, make()) if attempt.closest else make())
    status = task.converted[-1].status.value
    chain.append({**attempt.told(False), "ended": status})
    task.report.say(f"{attempt.method} ({attempt.reason}): {status}")


def _best_of(solutions: list[Solution]) -> Solution:
    """Return the preferred solution, with a note if a signal ended the attempts after it."""
    best = min(solutions, key=_preference) if len(solutions) > 1 else solutions[0]
    if solutions[-1].status is Status.INTERRUPTED and best is not solutions[-1]:
        return best.noted(f"what was tried after it: {Status.INTERRUPTED.sentence}")
    return best


def _restarted(task: _Task, asked: Attempt, first: Solution, restarts: int) -> Solution:
    """Return the cheapest verified solution of `first` and `restarts` more by the same method, with all optima found.

    Ctrl-C and the time limit end the restarts. The chain lists attempts that fail.
    """
    first_link = {"method": first.method, "reason": asked.reason, "ended": first.status.value}
    chain = list(first.options.get("chain", (first_link,)))
    used = sum(OTHER_GUESS in link["reason"] for link in chain)
    base = replace(
        asked, method=first.method, options=replace(asked.options.of_method(first.method), continuation=None)
    )
    attempts = [(first, f"that of {len(chain)} in the chain" if len(chain) > 1 else "the first")]
    for number in range(1, restarts + 1):
        if attempts[-1][0].status in (Status.INTERRUPTED, Status.TIME_LIMIT):
            break
        which = f"{OTHER_GUESS}, number {used + number} of seed {asked.seed}"
        attempt = replace(base, reason=f"restart {number} of {restarts}: {which}")
        if first.method == "collocation":
            guess = another_guess(task.problem, asked.seed, used + number)
        else:
            guess = _rolled_guess(task.problem, asked.seed, used + number)
        try:
            attempts.append((task.prepare(attempt, guess)(), which))
            ended = attempts[-1][0].status.value
        except DrakeDiffError as error:
            ended = f"not possible: {error}"
        task.report.say(f"{first.method} ({attempt.reason}): {ended}")
        chain.append({"method": first.method, "reason": attempt.reason, "ended": ended})
    best = min((solution for solution, _ in attempts), key=_preference)
    optima = distinct(attempts)
    options = best.options | {"chain": chain, "optima": [optimum.to_dict() for optimum in optima]}
    best = best.told(options=options, optima=tuple(optimum.solution for optimum in optima))
    if len(attempts) > 1 and attempts[-1][0].status in (Status.INTERRUPTED, Status.TIME_LIMIT):
        best = best.noted(f"the restarts were ended: {attempts[-1][0].status.sentence}")
    if not optima:
        return best
    costs = ", ".join(f"{optimum.solution.cost:.4g} ({optimum.count})" for optimum in optima)
    verified = sum(optimum.count for optimum in optima)
    return best.noted(f"{verified} of {len(attempts)} first guesses were verified, at cost (how many): {costs}")


def _from_other_starts(task: _Task, asked: Attempt, first: Solution) -> Solution:
    """Return a verified plan that is cheaper than `first`, from a few random guesses, or else `first` with a note."""
    plan, problem = task.collocated[-1] if task.collocated else first, task.problem
    if first.status not in PLANS or not problem.has_cost or task.is_late or choose_method(problem)[0] != "collocation":
        return first
    scheme = asked.options.scheme or default_scheme(problem)
    starts = search_cheaper(plan, scheme, asked.seed, lambda: task.limits_of(asked), task.report)
    chain = [*first.options.get("chain", ()), {**OTHER_STARTS, "ended": str(starts)}]
    best = first
    for guess in starts.cheaper[:MOST_VERIFIED]:
        if starts.ended or task.is_late:
            break
        task.converted.clear()
        attempt, rows = asked.by("collocation", f"a cheaper motion, {guess.message}"), list[dict[str, str]]()
        solution = task.prepare(attempt, guess, _conversion(task, asked, rows))()
        chain += [{**attempt.told(False), "ended": solution.status.value}, *rows]
        last = _in_steps(task, asked, solution, chain)
        best = min((best, last), key=_preference)
        if last.status in ENDED and (best is last or not last.success):  # a finer mesh may lead away from a guess
            break
    if not starts.starts:
        return first
    name = OTHER_STARTS["reason"] if NEAR in best.notes else LOCAL
    note = f"{name}: {starts}{', not verified' if starts.cheaper and best is first else ''}"
    best = best.told(options=best.options | {"chain": chain})
    return best.noted(note) if best.success else best


def _preference(solution: Solution) -> tuple[int, float, float]:
    """Return the sort key of a solution, best first: its status, its errors if it is no success, and its cost."""
    rank = PREFERENCE.index(solution.status) if solution.status in PREFERENCE else len(PREFERENCE)
    return rank, 0.0 if solution.success else solution.defect + solution.goal_error, solution.cost


def _attempts(problem: Any, asked: Attempt, given: Any, solutions: list[Any]) -> Iterator[tuple[Attempt, Any]]:
    """Yield the next attempt and its initial guess, depending on the `solutions` of the attempts before."""
    if asked.method == "collocation" or isinstance(problem, PhasedProblem):
        yield asked, given
        yield from _other_guesses(problem, asked, given, solutions)
        yield from _kept_apart(problem, asked, solutions)
        return
    method, reason = choose_method(problem)
    if problem.motion == CONTINUOUS:
        yield from _in_continuous_time(problem, asked.by(method, reason), given, solutions)
        return
    first = asked.by(method, reason)
    yield from _by_ilqr_first(problem, first, given)
    if method == "ilqr" or (method == "shooting" and problem.couplings):
        yield from _without_contact(problem, asked, given, solutions)
    yield first, given
    if method == "collocation":
        yield from _other_guesses(problem, first, given, solutions)
        yield from _kept_apart(problem, first, solutions)
    yield from _near_feet(problem, first, given, solutions[-1])
    if solutions[-1].status is Status.NO_GRADIENT and method == "ilqr":
        touching = replace(first.options, continuation="auto")
        yield replace(first, reason="the guess has no gradient", options=touching), given
    if method == "shooting" or not problem.has_model or problem.couplings:  # iLQR does not support couplings
        return
    if method == "collocation":
        reason = "collocation was not verified: a guess for it"
        yield replace(asked.by("ilqr", reason), max_iterations=asked.options.guess_iterations), given
    if np.all(np.isfinite(solutions[-1].xs)):
        guess: Any = (solutions[-1].xs, solutions[-1].us)
        if problem.design.vector.parameters:
            guess = solutions[-1]
        after = "collocation" if method == "collocation" else "shooting"
        yield asked.by(after, "from the motion that iLQR found"), guess


def _near_feet(problem: Problem, first: Attempt, given: Any, stalled: Solution) -> Iterator[tuple[Attempt, Any]]:
    """Yield a search for the motion that is nearest to the one on fixed feet, if it costs little more than `stalled`.

    The least cost is often at a jump: a robot that moves as fast as possible lifts its feet.
    """
    by_default = stalled.method == "ilqr" and given is None and stalled.status not in ENDED
    shift = on_feet(problem, fast=True) if by_default and np.all(np.isfinite(stalled.xs)) else None
    if shift is None:
        return
    motion = replace(stalled, xs=shift.xs, us=shift.us, certificates=(), iterations=())
    if motion.cost <= ON_FEET * stalled.cost:
        yield replace(first, reason="the motion nearest to one on fixed feet", closest=True), motion


def _by_ilqr_first(problem: Problem, first: Attempt, given: Any) -> Iterator[tuple[Attempt, Any]]:
    """Yield an attempt by iLQR before collocation if all goals are costs, from the states of collocation's guess."""
    attempt = replace(first.by("ilqr", "all goals are costs"), max_iterations=first.options.guess_iterations)
    if first.method == "collocation" and _has_soft_goals(problem) and _is_possible(problem, attempt):
        guess = first_guess(problem, "collocation", given, first.seed)
        yield attempt, (guess.xs, guess.us)


def _has_soft_goals(problem: Problem) -> bool:
    """Return whether a problem in steps has only costs, and limits of its states and inputs."""
    hard = problem.constraints or problem.couplings or problem.waypoints or problem.optimizes_parameters
    hard = hard or np.any(np.isfinite(problem.goal)) or any(goal.weight is None for goal in problem.goals)
    return _has_steps(problem) and not hard and problem.optimizes_controls and problem.has_cost


def _without_contact(
    problem: Problem, asked: Attempt, given: Any, solutions: list[Any]
) -> Iterator[tuple[Attempt, Any]]:
    """Yield attempts before discrete steps: collocation of a fully driven model, or shooting of servos from a line."""
    free = asked.by("collocation", "nothing touches at first, and every coordinate is driven")
    if _is_free_at_first(problem) and _is_possible(problem, free):
        yield free, given
        yield from _other_guesses(problem, free, given, solutions)
        yield from _kept_apart(problem, free, solutions)
    elif problem.model.inputs.commanded.any() and not _touches_at_first(problem):
        yield asked.by("shooting", "a straight line of commanded positions is near a motion"), given


def _in_continuous_time(
    problem: Problem, first: Attempt, given: Any, solutions: list[Solution]
) -> Iterator[tuple[Attempt, Any]]:
    """Yield one method, shooting from iLQR's motion, and random guesses, as a guess without contact has no gradient."""
    yield first, given
    most = first.options.other_guesses
    for number in range(most + 1):
        if number:
            reason = f"no plan was found: {OTHER_GUESS} ({number} of {most})"
            yield replace(first, reason=reason), _rolled_guess(problem, first.seed, number)
        last = solutions[-1]
        if (
            first.method == "ilqr"
            and last.method == "ilqr"
            and last.status not in BLIND
            and np.all(np.isfinite(last.xs))
        ):
            reason = "from the motion that iLQR found"
            yield first.by("shooting", reason), last


def _rolled_guess(problem: Problem, seed: int, number: int) -> tuple[Any, ...]:
    """Return a random guess for steps. In continuous time, its states are a rollout, if that succeeds."""
    xs, us = another_guess(problem, seed, number)[:2]
    us = us[:-1]
    if problem.motion == CONTINUOUS:
        with suppress(SimulationError), problem.intervals(problem.parameters) as intervals:
            xs = roll(intervals, np.where(problem.initial_state_mask, xs[0], problem.x0), us)
    return xs, us


def _other_guesses(
    problem: Problem | PhasedProblem, attempt: Attempt, given: Any, solutions: list[Any]
) -> Iterator[tuple[Attempt, Any]]:
    """Yield collocation attempts from random initial guesses, if no motion is found from a straight line."""
    if given is not None or attempt.options.solver == "snopt":
        return
    most = attempt.options.other_guesses
    for number in range(1, most + 1):
        if not _another_may_do(solutions[-1], attempt.options):
            return
        reason = f"no motion was found: {OTHER_GUESS} ({number} of {most})"
        if isinstance(problem, PhasedProblem):
            reason = f"random {number}"
        guess = other_guess(problem, attempt.seed, number)
        yield replace(attempt, reason=reason, max_iterations=attempt.options.other_iterations), guess


def _another_may_do(solution: Solution, options: Options) -> bool:
    """Return whether no plan was found, or in phases whether a plan fails on every mesh."""
    in_phases = isinstance(solution, PhasedSolution)
    if not in_phases or solution.status is not Status.CONVERGED_NOT_VERIFIED or options.refine is False:
        return solution.status in NOT_FOUND
    certificates = [*solution.certificates, *(c for phase in solution.phases for c in phase.certificates)]
    return all(c.verdict == "agree" for c in certificates)


def _kept_apart(problem: Problem, attempt: Attempt, solutions: list[Solution]) -> Iterator[tuple[Attempt, Any]]:
    """Yield a collocation that keeps links apart, from a result in which links passed through each other."""
    last = solutions[-1]
    if isinstance(problem, PhasedProblem):
        return
    if attempt.options.solver == "snopt" or last.status is not Status.CONVERGED_NOT_VERIFIED or is_kept_apart(problem):
        return
    if overlaps(last):
        yield replace(attempt, reason="links overlapped: they are kept apart", apart=True), last


def _touches_at_first(problem: Problem) -> bool:
    """Return whether geometries touch in x0, so that collocation, which ignores contact, cannot plan for the model."""
    model = problem.model
    if not (model.contract.contact.collision_pairs and problem.optimizes_controls and model.can_rebuild):
        return False
    with applied(problem.parameters):
        set_state(model.double, problem.x0)
        return bool(penetration(model) > 0)


def _is_free_at_first(problem: Problem) -> bool:
    """Return whether contact can be avoided: every coordinate is driven, and nothing touches in x0.

    A collocated motion with overlapping geometries is not verified, so that a verified one has no contact.
    """
    model = problem.model
    if not model.contract.is_unconstrained or np.linalg.matrix_rank(model.actuation) < model.nv:
        return False
    set_state(model.double, problem.x0)
    return penetration(model) <= 0


def _check_attempt(problem: Problem | PhasedProblem, attempt: Attempt) -> str:
    """Return the scheme ("step" for discrete methods). Raises an error for input that the method does not accept."""
    method = attempt.method
    if isinstance(problem, PhasedProblem):
        return _check_phases(problem, attempt)
    if problem.motion == CONTINUOUS:
        _check_motion(attempt)
    if method == "collocation":
        return _check_collocation(problem, attempt)
    takes = 'method="collocation" supports it'
    if attempt.options.solver == "snopt":
        raise InputError("solver", got='"snopt"', expected=f'another one for method="{method}", or scheme="drake"')
    if not problem.has_model:
        expected = f'a model for method="{method}"; method="collocation" supports plain dynamics'
        raise InputError("problem", got="plain dynamics", expected=expected)
    if problem.horizon is not None and not problem.model.can_rebuild:
        raise InputError(
            "horizon", got="given", expected=f"no horizon, as the steps of a diagram have a fixed length; {takes}"
        )
    _check_timed_cost(problem)
    if problem.rate_limits and problem.horizon is not None and problem.horizon[0] < problem.horizon[1]:
        expected = f'a given horizon for method="{method}"; {takes}'
        raise InputError("couplings", got=f"{problem.rate_limits[0]!r} and a free horizon", expected=expected)
    if method == "ilqr":
        check_problem(problem)
    return "step"


def _check_motion(attempt: Attempt) -> None:
    """Raise InputError for options that do not support motion in continuous time."""
    if attempt.method == "collocation":
        expected = 'method="ilqr" or "shooting" for motion="continuous", as collocation ignores contact'
        raise InputError("method", got='"collocation"', expected=expected)
    if attempt.options.continuation is not None:
        expected = 'no continuation for motion="continuous"; use restarts to try other initial guesses'
        raise InputError("continuation", got="given", expected=expected)


def _check_collocation(problem: Problem, attempt: Attempt) -> str:
    scheme = _check_scheme(problem, attempt)
    if attempt.options.solver == "snopt" and scheme != "drake":
        raise InputError("solver", got='"snopt"', expected=f'"ipopt" for scheme="{scheme}", or scheme="drake"')
    if problem.trajectory_cost is not None:
        raise InputError("trajectory_cost", got="given", expected='method="shooting"')
    if problem.nu and not problem.optimizes_controls:
        raise InputError("optimize", got=list(problem.optimize), expected='"controls" for method="collocation"')
    _check_timed_cost(problem)
    OptimalControl(problem, scheme)  # raises an error if a cost cannot be differentiated
    if attempt.options.solver == "snopt":  # Drake's DirectCollocation only gets bounds, ends and costs
        left_out = {
            "dynamics": not problem.has_model,
            "waypoints": problem.waypoints,
            "constraints": problem.constraints,
            "couplings": problem.couplings,
            "goals": problem.goals,
            "horizon": problem.horizon,
            "parameters": problem.parameters.parameters,
            "a running_cost that changes in time": changes_in_time(problem.running_cost),
            "refine": attempt.options.refine,
        }
        for name, value in left_out.items():
            if value:
                raise InputError(name, got="given", expected='no value for solver="snopt"; solver="ipopt" supports it')
    return scheme


def _check_phases(problem: PhasedProblem, attempt: Attempt) -> str:
    if attempt.method != "collocation":
        raise InputError("method", got=repr(attempt.method), expected='"auto" or "collocation" for a PhasedProblem')
    if attempt.options.solver not in (None, "ipopt"):
        raise InputError("solver", got=repr(attempt.options.solver), expected='"ipopt" for a PhasedProblem')
    scheme = _check_scheme(problem, attempt)
    if scheme == "drake":
        raise InputError("scheme", got=repr(scheme), expected="another scheme for a PhasedProblem")
    return scheme


def _check_scheme(problem: Problem | PhasedProblem, attempt: Attempt) -> str:
    scheme = attempt.options.scheme or default_scheme(problem)
    if scheme not in SCHEMES:
        raise UnknownNameError("scheme", got=scheme, known=[name for name in SCHEMES if name != MAP])
    if (scheme == MAP) != problem.is_map:
        expected = f"{MAP!r}, as the system is a DiscreteMap" if problem.is_map else f"a scheme other than {MAP!r}"
        raise InputError("scheme", got=repr(scheme), expected=expected)
    if problem.is_map and attempt.options.refine:
        raise InputError("refine", got=True, expected="False or None, as a DiscreteMap has no intervals to split")
    return scheme


def _check_timed_cost(problem: Problem) -> None:
    if changes_in_time(problem.running_cost) and problem.horizon and problem.horizon[0] < problem.horizon[1]:
        raise InputError(
            "running_cost",
            got="a cost that changes in time",
            expected="a running_cost that is constant in time, as the horizon is free",
        )


def choose_method(problem: Problem) -> tuple[str, str]:
    """Return (method, reason)."""
    if not problem.has_model:
        reason = "a discrete map is one sparse program" if problem.is_map else "plain dynamics have no discrete step"
        return "collocation", reason
    contract = problem.model.contract
    if problem.motion == CONTINUOUS:
        reason = "the motion is in continuous time, which collocation does not take"
        return "ilqr" if takes(problem) else "shooting", reason
    smooth = contract.is_unconstrained
    if not problem.optimizes_controls:
        return "shooting", "the controls are not optimized"
    if problem.trajectory_cost is not None:
        return "shooting", "collocation and iLQR take no cost of the whole trajectory"
    of_loops = bool(problem.model.file_facts.held_points) and _is_possible(problem, Attempt("collocation", ""))
    if problem.horizon is not None and (smooth or of_loops) and not _touches_at_first(problem):
        return "collocation", "the horizon is " + ("free" if problem.horizon[0] < problem.horizon[1] else "given")
    if problem.couplings and (contract.contact.collision_pairs or not smooth):
        return "shooting", "iLQR takes no couplings of knots, and collocation leaves out what acts on the model"
    if contract.contact.collision_pairs:
        return "ilqr", "the model has geometries that can touch, which collocation leaves out"
    if not smooth:
        return "ilqr", "the model has constraints or PD control, which its own steps include"
    if problem.optimizes_parameters:
        return "collocation", f"the model is smooth, with {', '.join(problem.parameters.names[:3])} among its variables"
    return "collocation", "the model is smooth"

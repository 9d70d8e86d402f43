"""One solve by one method: certify at the guess, search, certify at the result, measure, judge.

`solve`: check what is asked, choose a method or a chain of them, and run it.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float, positive_int
from drake_diff.certificates.certificate import Certificate, certify_jacobian
from drake_diff.certificates.certify import certify
from drake_diff.exceptions import DrakeDiffError, GradientError, InputError, SimulationError, UnknownNameError
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.model.soft_contact import SoftContact
from drake_diff.optimize.drake_program import SOLVERS
from drake_diff.optimize.ilqr.ilqr import check_problem, is_unconstrained, solve_ilqr
from drake_diff.optimize.ilqr.through_contact import check_schedule, solve_continuation, solve_through_jumps
from drake_diff.optimize.judge import ended, judged, refused, why_blind
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iteration, Limits, NlpResult, Outcome, Report
from drake_diff.optimize.shooting import DEFAULT_SOLVER as SHOOTING_SOLVER
from drake_diff.optimize.shooting import RolloutCost, ShootingVariables, check_segments, roll_segments, solve_shooting
from drake_diff.optimize.solution import Solution, Status
from drake_diff.optimize.transcription.drake import DEFAULT_SOLVER as COLLOCATION_SOLVER
from drake_diff.optimize.transcription.drake import solve_collocation
from drake_diff.optimize.transcription.scheme import SCHEMES
from drake_diff.optimize.transcription.solve import ProblemTranscription

CERTIFIED_KNOTS = 5
# Relative; forces are rounded at 1e-16 of their own size, and a wrist's small inertia turns that into accelerations.
ACCELERATION_ROUNDING = 1e-12

Search = Callable[[Array, Array], tuple[NlpResult, Array, Array]]


class Run:
    """One solve: certify at the guess, solve, certify at the result, measure, judge."""

    def __init__(
        self,
        problem: Problem,
        method: str,
        scheme: str,
        solver: str,
        limits: Limits,
        options: dict[str, Any],
        report: Report | None,
    ):
        self.problem, self.method, self.scheme, self.solver = problem, method, scheme, solver
        self.limits, self.options, self.report = limits, options, report
        self.start = time.monotonic()
        self.knots = np.unique(np.linspace(0, problem.num_steps - 1, CERTIFIED_KNOTS).astype(int))

    def collocate(self, xs: Array, us: Array) -> Solution:
        """In CasADi; SNOPT, which that does not carry, in Drake's own DirectCollocation."""
        if self.solver == "snopt":
            equations = EquationsOfMotion(self.problem.model)
            before = self._certify_equations(equations.jacobian, xs, us)
            result, found = self._solve_drakes(xs, us)
            return self._collocated(result, found, before, equations.jacobian)
        transcription = ProblemTranscription(self.problem, self.scheme)
        before = self._certify_equations(transcription.jacobian, xs, us)
        motion = transcription.solve(xs, np.vstack([us, us[-1:]]), limits=self.limits, report=self.report)
        self.options["derivatives"] = motion.derivatives
        found = {"xs": motion.xs, "us": motion.us[:-1], "u_final": motion.us[-1]}
        found |= {"us_mid": None if self.scheme == "drake" else motion.us_mid}
        found |= {"free_horizon": motion.horizon if self.problem.horizon else None}
        result = NlpResult(motion.nodes.ravel(), motion.outcome, motion.message, motion.iterations)
        return self._collocated(result, found, before, transcription.jacobian)

    def _solve_drakes(self, xs: Array, us: Array) -> tuple[NlpResult, dict[str, Any]]:
        result, xs, us, u_final = solve_collocation(
            self.problem, xs, us, solver=self.solver, limits=self.limits, report=self.report
        )
        return result, {"xs": xs, "us": us, "u_final": u_final}

    def _collocated(
        self, result: NlpResult, found: dict[str, Any], before: tuple[Certificate, ...], jacobian: Any
    ) -> Solution:
        finite = bool(np.all(np.isfinite(found["xs"])))
        after = self._certify_equations(jacobian, found["xs"], found["us"]) if finite else ()
        return judged(self._draft(**found, certificates=before + after), result)

    def sweep(self, xs: Array, us: Array, *, given: bool, stages: tuple[SoftContact, ...]) -> Solution:
        """iLQR; from the states of a `given` guess, which need not be a rollout, else from the rollout of `us`.

        With `stages`, which take the inputs of the guess alone, it need not have a gradient.
        """

        def search(rolled: Array, us: Array) -> tuple[NlpResult, Array, Array]:
            if stages:
                limits, report = self.limits, self.report
                result, xs_found, us, logs = solve_continuation(self.problem, us, stages, limits=limits, report=report)
                self.options["continuation"] = [log.to_dict() for log in logs]
                return result, xs_found, us
            solve_method = solve_through_jumps if self.problem.model.contract.contact.collision_pairs else solve_ilqr
            return solve_method(self.problem, xs if given else rolled, us, limits=self.limits, report=self.report)

        return self._through_steps(xs, us, search, may_be_blind=bool(stages))

    def shoot(self, xs: Array, us: Array, *, improve: bool) -> Solution:
        """Shooting; `improve` the guess by iLQR, which gets out of curved valleys that shooting crawls along."""

        def search(xs: Array, us: Array) -> tuple[NlpResult, Array, Array]:
            if improve:
                result, xs, us = solve_ilqr(self.problem, xs, us, limits=self.limits, report=self.report)
                self.options["initial_guess"] = f"default, then {result.message}"
                if result.outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT):
                    return result, xs, us
            return solve_shooting(self.problem, xs, us, solver=self.solver, limits=self.limits, report=self.report)

        return self._through_steps(xs, us, search)

    def shoot_segments(self, xs: Array, us: Array, segments: int) -> Solution:
        """Multiple shooting, looked at around the segments' own states, which defects part."""
        try:
            xs = roll_segments(self.problem, xs, us, segments)
        except SimulationError as error:
            return refused(self._draft(xs, us), error)
        search = partial(solve_shooting, solver=self.solver, limits=self.limits, report=self.report, segments=segments)
        return self._through_steps(xs, us, partial(search, self.problem), segmented=True)

    def _through_steps(
        self, xs: Array, us: Array, search: Search, *, segmented: bool = False, may_be_blind: bool = False
    ) -> Solution:
        """Certify, search, certify again, on Drake's own steps; at rollouts, or at the states as they are."""
        variables = ShootingVariables(self.problem, around=xs if segmented else None)
        try:
            xs, us, before, blindness = self._look_at(variables, variables.pack(xs[0], us))
        except (GradientError, SimulationError) as error:
            return refused(self._draft(xs, us), error)
        if blindness and not may_be_blind:
            return ended(self._draft(xs, us, certificates=before), Status.NO_GRADIENT, blindness)
        try:
            result, xs, us = search(xs, us)
            variables = ShootingVariables(self.problem, around=xs if segmented else None)
            z = result.z if self.method == "shooting" and len(result.z) == variables.size else variables.pack(xs[0], us)
            xs, us, after, blindness = self._look_at(variables, z)
        except (GradientError, SimulationError) as error:
            return refused(self._draft(xs, us, certificates=before), error)
        norms = np.linalg.norm(RolloutCost(self.problem, variables).differentiate(z)[2], axis=1)
        values = variables.parameters(z).values
        found = {"certificates": before + after, "gradient_norms": frozen(norms), "parameters": values}
        if result.note:
            self.options["contact_sequence"] = result.note
        draft = self._draft(xs, us, **found)
        solution = judged(draft, result)
        return ended(solution, Status.NO_GRADIENT, blindness) if blindness and solution.success else solution

    def _draft(self, xs: Array, us: Array, **found: Any) -> Solution:
        found |= {name: frozen(found[name]) for name in ("u_final", "us_mid") if found.get(name) is not None}
        return Solution(
            problem=self.problem,
            method=self.method,
            scheme=self.scheme,
            solver=self.solver,
            status=Status.FAILED,
            message="",
            xs=frozen(xs),
            us=frozen(us),
            options=self.options,
            wall_time=time.monotonic() - self.start,
            **found,
        )

    def _look_at(self, variables: ShootingVariables, z: Array) -> tuple[Array, Array, tuple[Certificate, ...], str]:
        """xs and us of z, certificates of some of its steps, and why the goal or cost is out of its reach."""
        us = variables.unpack(z)[1]
        xs, parameters = variables.states(z), variables.parameters(z).to_dict()
        certificates = tuple(certify(self.problem.model, xs[k], us[k], parameters=parameters) for k in self.knots)
        return xs, us, certificates, why_blind(self.problem, variables, z)

    def _certify_equations(self, jacobian: Any, xs: Array, us: Array) -> tuple[Certificate, ...]:
        """Certificates, at some knots, of the Jacobian that the solver gets against Drake's own equations."""
        model, equations = self.problem.model, EquationsOfMotion(self.problem.model)
        return tuple(
            certify_jacobian(
                equations.values,
                np.concatenate([xs[k], us[k]]),
                jacobian,
                batched=True,
                rows=tuple(f"d({name})/dt" for name in model.state_names),
                columns=model.state_names + model.input_names,
                solver_tolerance=ACCELERATION_ROUNDING,
                method="continuous time",
                subject=f"the equations of motion of {model.name}",
            )
            for k in self.knots
        )


METHODS = ("auto", "collocation", "shooting", "ilqr")
GUESS_NOISE = 1e-3  # of the largest input: breaks the symmetry of a guess that is a stationary point

Progress = Callable[[str], None]


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
    progress: bool | Progress = False,
    callback: Callable[[Iteration], None] | None = None,
    on_start: Callable[[], None] | None = None,
) -> Solution:
    """Solve `problem`, check the gradients that were used, and measure the result again on Drake's plant.

    `method`: "collocation" (smooth, in continuous time), "shooting" (through Drake's own steps, contact included),
    "ilqr" (the same by Riccati sweeps, from any xs and us) or "auto". `initial_guess` is None (a straight line to
    the goal; near zero inputs), (xs, us) with shapes (N+1, nx) and (N, nu), or a Solution. `solver` is "ipopt" or
    "snopt"; `time_limit` [s]; `tolerance` the solver's on feasibility and optimality; `seed` that of the guess's
    noise. With `segments` > 1 shooting is multiple: the states that the segments start from are variables too, first
    those of the guess. `continuation` finds contact that the guess does not make, by stages of a force at a distance
    before the true plant: "auto" (see `continuation.default_schedule`) or SoftContacts, with "ilqr"; `Solution.options`
    has the stages' log. `progress` prints, or hands each line to a function; `callback` gets an Iteration for each of
    the solver's (SNOPT, and IPOPT by shooting: a few times a second), and what it raises ends the solve; `on_start` is
    called once, when all input has been checked and the work begins.

    "auto" chains methods until one is verified: collocation where the model is smooth, else, or where that fails, iLQR
    (with a continuation where the guess touches nothing that matters), whose result the next one starts from.
    `Solution.options["chain"]` says what was tried, how it ended, and why it was chosen.

    Raises InputError and its kin, or ModelError, before anything runs; how a solve ended is `Solution.status`.
    """
    if not isinstance(problem, Problem):
        raise InputError("problem", got=type(problem).__name__, expected="a Problem")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError("seed", got=repr(seed), expected="a whole number of at least 0")
    if not (callback is None or callable(callback)):
        raise InputError("callback", got=repr(callback), expected="None or a function of an Iteration")
    if not (isinstance(progress, bool) or callable(progress)):
        raise InputError("progress", got=repr(progress), expected="True, False or a function")
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
    report = Report(print if progress is True else (progress or None), callback)
    task = _Task(problem, limits, seed, report, on_start)
    if method == "auto" and continuation is None and segments == 1:
        return _solve_in_chain(task, initial_guess, solver)
    reason = "asked for" if method != "auto" else "a continuation is asked for"
    method = "ilqr" if method == "auto" and continuation is not None else method
    options = {"scheme": scheme, "solver": solver, "segments": segments, "continuation": continuation}
    return task.prepare(Attempt(method, reason, **options), initial_guess)()


@dataclass(frozen=True)
class Attempt:
    """One method, and why it is taken."""

    method: str
    reason: str
    scheme: str | None = None
    solver: str | None = None
    segments: int = 1
    continuation: Any = None
    max_iterations: int | None = None


class _Task:
    """What all attempts at a problem share."""

    def __init__(
        self, problem: Problem, limits: Limits, seed: int, report: Report, on_start: Callable[[], None] | None
    ):
        self.problem, self.limits, self.seed, self.report, self.on_start = problem, limits, seed, report, on_start
        self.start = time.monotonic()

    def prepare(self, attempt: Attempt, given: Any) -> Callable[[], Solution]:
        """Check that `attempt` can be made from the guess `given`; what is returned makes it."""
        problem, method = self.problem, attempt.method
        scheme = _choose_scheme(attempt)
        solver = {"collocation": COLLOCATION_SOLVER, "shooting": SHOOTING_SOLVER}.get(method, "riccati")
        xs, us = _guess(problem, method, given, self.seed)
        _check_method(problem, method)
        check_segments(problem, method, attempt.segments)
        if attempt.continuation is not None and method != "ilqr":
            expected = f'none for method="{method}"; method="ilqr" takes it'
            raise InputError("continuation", got="given", expected=expected)
        stages = () if attempt.continuation is None else check_schedule(problem, attempt.continuation)
        left = self.limits.time_limit - (time.monotonic() - self.start)
        most = self.limits.max_iterations if attempt.max_iterations is None else attempt.max_iterations
        most = min(most, self.limits.max_iterations)
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
        run = Run(problem, method, scheme, attempt.solver or solver, limits, options, self.report)

        def make() -> Solution:
            if self.on_start is not None:
                self.on_start()
                self.on_start = None
            if method == "collocation":
                return run.collocate(xs, us)
            if method == "ilqr":
                return run.sweep(xs, us, given=given is not None, stages=stages)
            if attempt.segments > 1:
                return run.shoot_segments(xs, us, attempt.segments)
            return run.shoot(xs, us, improve=given is None and is_unconstrained(problem))

        return make


GUESS_ITERATIONS = 100  # of an attempt that is to find a guess for the next one
ENDED = (Status.CONVERGED, Status.INTERRUPTED, Status.TIME_LIMIT)
# The order in which a chain that ends without a verified motion prefers what it has.
PREFERENCE = (Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED, Status.INTERRUPTED, Status.TIME_LIMIT)


def _solve_in_chain(task: _Task, given: Any, solver: str | None) -> Solution:
    """Attempt after attempt until one is verified; the best of them, with what was tried in its options."""
    found: list[Solution] = []
    chain: list[dict[str, str]] = []
    for attempt, guess in _attempts(task.problem, given, solver, found):
        try:
            make = task.prepare(attempt, guess)
        except DrakeDiffError as error:
            if not found:
                raise
            chain.append({"method": attempt.method, "reason": attempt.reason, "ended": f"not possible: {error}"})
            continue
        found.append(make())
        last = found[-1]
        task.report.say(f"{attempt.method} ({attempt.reason}): {last.status.value}")
        chain.append({"method": attempt.method, "reason": attempt.reason, "ended": last.status.value})
        if last.status in ENDED:
            break
    best = min(found, key=_preference)
    return best.told(options=best.options | {"chain": chain})


def _preference(solution: Solution) -> tuple[int, float]:
    rank = PREFERENCE.index(solution.status) if solution.status in PREFERENCE else len(PREFERENCE)
    return rank, solution.defect + solution.goal_error


def _attempts(problem: Problem, given: Any, solver: str | None, found: list[Solution]) -> Iterator[tuple[Attempt, Any]]:
    """What to try next and from which guess, by what the attempts before, in `found`, came to."""
    method, reason = choose_method(problem)
    scheme = "hermite_simpson" if method == "collocation" and solver != "snopt" else None
    yield Attempt(method, reason, scheme=scheme, solver=None if method == "ilqr" else solver), given
    if found[-1].status is Status.NO_GRADIENT and method == "ilqr":
        yield Attempt("ilqr", "the guess has no gradient", continuation="auto"), given
    if method == "shooting":
        return
    if method == "collocation":
        reason = "collocation was not verified: a guess for it"
        yield Attempt("ilqr", reason, max_iterations=GUESS_ITERATIONS), given
    if np.all(np.isfinite(found[-1].xs)):
        begun = found[-1].xs, found[-1].us
        next_method = "collocation" if method == "collocation" else "shooting"
        yield Attempt(next_method, "from the motion that iLQR found", scheme=scheme, solver=solver), begun


def _check_method(problem: Problem, method: str) -> None:
    """Refuse a problem that `method` cannot take."""
    if problem.horizon is not None and method != "collocation":
        raise InputError("horizon", got="given", expected='none for discrete steps: method="collocation" takes it')
    if method == "ilqr":
        check_problem(problem)
    elif method == "collocation":
        EquationsOfMotion(problem.model)
        if problem.parameters.parameters or problem.trajectory_cost is not None:
            raise InputError("parameters, trajectory_cost", got="given", expected='method="shooting"')
        if not problem.optimizes_controls:
            raise InputError("optimize", got=list(problem.optimize), expected='"controls" for method="collocation"')


def _choose_scheme(attempt: Attempt) -> str:
    """The collocation scheme, "step" of the discrete methods; InputError where the solver does not go with it."""
    scheme = attempt.scheme
    if attempt.method != "collocation":
        if scheme is not None:
            raise InputError("scheme", got=repr(scheme), expected=f'none for method="{attempt.method}"')
        return "step"
    if scheme is None:
        scheme = "drake"
    if scheme not in SCHEMES:
        raise UnknownNameError("scheme", got=scheme, known=SCHEMES)
    if attempt.solver == "snopt" and scheme != "drake":
        raise InputError("solver", got='"snopt"', expected=f'"ipopt" for scheme="{scheme}"')
    return scheme


def choose_method(problem: Problem) -> tuple[str, str]:
    """(method, why)."""
    contract = problem.model.contract
    if problem.horizon is not None:
        return "collocation", "the horizon is free"
    if not problem.optimizes_controls:
        return "shooting", "the controls are not optimized"
    if problem.parameters.parameters or problem.trajectory_cost is not None:
        return "shooting", "collocation and iLQR take neither parameters nor a cost of the whole trajectory"
    if contract.contact.collision_pairs:
        return "ilqr", "the model has geometries that can touch, which collocation leaves out"
    if contract.constraints or any(actuator.kp is not None for actuator in contract.actuators):
        return "ilqr", "the model has constraints or PD control, which collocation leaves out"
    return "collocation", "the model is smooth"


def _guess(problem: Problem, method: str, given: Any, seed: int) -> tuple[Array, Array]:
    model, count = problem.model, problem.num_steps
    if isinstance(given, Solution):
        given = (given.xs, given.us)
    if given is not None:
        if not (isinstance(given, (tuple, list)) and len(given) == 2):
            raise InputError("initial_guess", got=type(given).__name__, expected="None, (xs, us) or a Solution")
        xs = finite_array("initial_guess xs", given[0], (count + 1, model.nx))
        return xs, finite_array("initial_guess us", given[1], (count, model.nu))
    end = np.where(np.isnan(problem.goal), problem.x0, problem.goal)
    xs = problem.x0 + np.linspace(0, 1, count + 1)[:, None] * (end - problem.x0)
    us = np.array(problem.us)
    if method == "shooting" and problem.optimizes_controls and not us.any():
        limit = np.minimum(np.abs(problem.bounds.u_lower), np.abs(problem.bounds.u_upper))
        size = np.where(np.isfinite(limit), np.minimum(limit, 100.0), 1.0)
        us = GUESS_NOISE * size * np.random.default_rng(seed).standard_normal(us.shape)
    inside = np.clip(us, problem.bounds.u_lower, problem.bounds.u_upper)
    return xs, inside if problem.optimizes_controls else us

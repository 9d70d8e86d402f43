"""`solve`: take a problem, a method and a guess; return a Solution whose status was measured, not believed."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.autodiffutils import InitializeAutoDiff

from drake_diff.arrays import Array, finite_array, frozen, positive_float, positive_int
from drake_diff.autodiff import gradient_rows
from drake_diff.certificate import Certificate, certify_jacobian
from drake_diff.certify import certify
from drake_diff.collocation import DEFAULT_SOLVER as COLLOCATION_SOLVER
from drake_diff.collocation import solve_collocation
from drake_diff.continuation import check_schedule, solve_continuation
from drake_diff.continuous import EquationsOfMotion
from drake_diff.dynamics import Dynamics, plant_dynamics
from drake_diff.exceptions import GradientError, InputError, SimulationError, UnknownNameError
from drake_diff.ilqr import check_problem, is_unconstrained, solve_ilqr
from drake_diff.nonlinear_program import SOLVERS, Limits, NlpResult, Outcome
from drake_diff.problem import Problem
from drake_diff.shooting import DEFAULT_SOLVER as SHOOTING_SOLVER
from drake_diff.shooting import RolloutCost, ShootingVariables, solve_shooting
from drake_diff.soft_contact import SoftContact
from drake_diff.solution import Solution, Status
from drake_diff.transcription import transcribe_problem
from drake_diff.transcription_scheme import SCHEMES
from drake_diff.verdict import ended, judged, refused, why_blind

METHODS = ("auto", "collocation", "shooting", "ilqr")
CERTIFIED_KNOTS = 5
GUESS_NOISE = 1e-3  # of the largest input: breaks the symmetry of a guess that is a stationary point

Progress = Callable[[str], None]
Search = Callable[[Array, Array], tuple[NlpResult, Array, Array]]


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
    continuation: Any = None,
    progress: bool | Progress = False,
    on_start: Callable[[], None] | None = None,
) -> Solution:
    """Solve `problem`, check the gradients that were used, and measure the result again on Drake's plant.

    `method`: "collocation" (smooth, in continuous time), "shooting" (through Drake's own steps, contact included),
    "ilqr" (the same by Riccati sweeps, from any xs and us) or "auto". `initial_guess` is None (a straight line to
    the goal; near zero inputs), (xs, us) with shapes (N+1, nx) and (N, nu), or a Solution. `solver` is "ipopt" or
    "snopt"; `time_limit` [s]; `tolerance` the solver's on feasibility and optimality; `seed` that of the guess's
    noise. `continuation` finds contact that the guess does not make, by stages of a force at a distance before the
    true plant: "auto" (see `continuation.default_schedule`) or SoftContacts, with "ilqr"; `Solution.options` has the
    stages' log. `progress` prints, or hands each line to a function; `on_start` is called once, when all input has been
    checked and the work begins.

    Raises InputError and its kin, or ModelError, before anything runs; how a solve ended is `Solution.status`.
    """
    if not isinstance(problem, Problem):
        raise InputError("problem", got=type(problem).__name__, expected="a Problem")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError("seed", got=repr(seed), expected="a whole number of at least 0")
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
    reason = "asked for"
    if continuation is not None and method == "auto":
        method, reason = "ilqr", "a continuation is asked for"
    if method == "auto":
        method, reason = choose_method(problem)
    scheme = _choose_scheme(method, scheme, solver, asked=reason == "asked for")
    solver = solver or {"collocation": COLLOCATION_SOLVER, "shooting": SHOOTING_SOLVER}.get(method, "riccati")
    xs, us = _guess(problem, method, initial_guess, seed)
    options = {
        "max_iterations": limits.max_iterations,
        "time_limit": time_limit,
        "tolerance": limits.tolerance,
        "seed": seed,
        "method_reason": reason,
        "initial_guess": "default" if initial_guess is None else "given",
    }
    report = print if progress is True else (progress or None)
    _check_method(problem, method)
    if continuation is not None and method != "ilqr":
        raise InputError("continuation", got="given", expected=f'none for method="{method}"; method="ilqr" takes it')
    stages = () if continuation is None else check_schedule(problem, continuation)
    if on_start is not None:
        on_start()
    run = _Run(problem, method, scheme, solver, limits, options, report)
    if method == "collocation":
        return run.collocate(xs, us)
    if method == "ilqr":
        return run.sweep(xs, us, given=initial_guess is not None, stages=stages)
    return run.shoot(xs, us, improve=initial_guess is None and is_unconstrained(problem))


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


def _choose_scheme(method: str, scheme: str | None, solver: str | None, *, asked: bool) -> str:
    """The collocation scheme, "step" of the discrete methods; InputError where `solver` does not go with it."""
    if method != "collocation":
        if scheme is not None:
            raise InputError("scheme", got=repr(scheme), expected=f'none for method="{method}"')
        return "step"
    if scheme is None:
        scheme = "drake" if asked or solver == "snopt" else "hermite_simpson"
    if scheme not in SCHEMES:
        raise UnknownNameError("scheme", got=scheme, known=SCHEMES)
    if solver == "snopt" and scheme != "drake":
        raise InputError("solver", got='"snopt"', expected=f'"ipopt" for scheme="{scheme}"')
    return scheme


def choose_method(problem: Problem) -> tuple[str, str]:
    """("collocation" or "shooting", why)."""
    contract = problem.model.contract
    if not problem.optimizes_controls:
        return "shooting", "the controls are not optimized"
    if problem.parameters.parameters or problem.trajectory_cost is not None:
        return "shooting", "collocation takes neither parameters nor a cost of the whole trajectory"
    if contract.contact.collision_pairs:
        return "shooting", "the model has geometries that can touch, which collocation leaves out"
    if contract.constraints or any(actuator.kp is not None for actuator in contract.actuators):
        return "shooting", "the model has constraints or PD control, which collocation leaves out"
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


class _Run:
    """One solve: certify at the guess, solve, certify at the result, measure, judge."""

    def __init__(
        self,
        problem: Problem,
        method: str,
        scheme: str,
        solver: str,
        limits: Limits,
        options: dict[str, Any],
        report: Progress | None,
    ):
        self.problem, self.method, self.scheme, self.solver = problem, method, scheme, solver
        self.limits, self.options, self.report = limits, options, report
        self.start = time.monotonic()
        self.knots = np.unique(np.linspace(0, problem.num_steps - 1, CERTIFIED_KNOTS).astype(int))

    def collocate(self, xs: Array, us: Array) -> Solution:
        dynamics = plant_dynamics(self.problem.model)
        before = self._certify_dynamics(dynamics, xs, us)
        result, found = self._drake(xs, us) if self.scheme == "drake" else self._transcribe(xs, us)
        finite = bool(np.all(np.isfinite(found["xs"])))
        after = self._certify_dynamics(dynamics, found["xs"], found["us"]) if finite else ()
        return judged(self._draft(**found, certificates=before + after), result)

    def _drake(self, xs: Array, us: Array) -> tuple[NlpResult, dict[str, Any]]:
        result, xs, us, u_final = solve_collocation(
            self.problem, xs, us, solver=self.solver, limits=self.limits, report=self.report
        )
        return result, {"xs": xs, "us": us, "u_final": u_final}

    def _transcribe(self, xs: Array, us: Array) -> tuple[NlpResult, dict[str, Any]]:
        knots = np.vstack([us, us[-1:]])
        motion = transcribe_problem(self.problem, self.scheme, (xs, knots), limits=self.limits, report=self.report)
        result = NlpResult(motion.nodes.ravel(), motion.outcome, motion.message, motion.iterations)
        found = {"xs": motion.xs, "us": motion.us[:-1], "u_final": motion.us[-1], "us_mid": motion.us_mid}
        return result, found | {"free_horizon": motion.horizon if self.problem.horizon else None}

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
            return solve_ilqr(self.problem, xs if given else rolled, us, limits=self.limits, report=self.report)

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

    def _through_steps(self, xs: Array, us: Array, search: Search, *, may_be_blind: bool = False) -> Solution:
        """Certify, search, certify again, on Drake's own steps."""
        variables = ShootingVariables(self.problem)
        try:
            xs, us, before, blindness = self._look_at(variables, variables.pack(xs[0], us))
        except (GradientError, SimulationError) as error:
            return refused(self._draft(xs, us), error)
        if blindness and not may_be_blind:
            return ended(self._draft(xs, us, certificates=before), Status.NO_GRADIENT, blindness)
        try:
            result, xs, us = search(xs, us)
            z = result.z if self.method == "shooting" and len(result.z) == variables.size else variables.pack(xs[0], us)
            xs, us, after, blindness = self._look_at(variables, z)
        except (GradientError, SimulationError) as error:
            return refused(self._draft(xs, us, certificates=before), error)
        norms = np.linalg.norm(RolloutCost(self.problem, variables).differentiate(z)[2], axis=1)
        values = variables.parameters(z).values
        found = {"certificates": before + after, "gradient_norms": frozen(norms), "parameters": values}
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

    def _certify_dynamics(self, dynamics: Dynamics, xs: Array, us: Array) -> tuple[Certificate, ...]:
        """Certificates, at some knots, of the derivative that collocation uses against the equations' differences."""
        model, equations = self.problem.model, EquationsOfMotion(self.problem.model)
        own = self.scheme != "drake"
        names = tuple(f"d({name})/dt" for name in model.state_names)

        def f(z: Array) -> Array:
            return equations(z[: model.nx], z[model.nx :])

        def jacobian(z: Array) -> Array:
            if own:
                return np.asarray(dynamics.linearize(z[None])[1][0])
            variables = InitializeAutoDiff(z).ravel()
            return gradient_rows(equations.autodiff(variables[: model.nx], variables[model.nx :]), len(z))

        return tuple(
            certify_jacobian(
                f,
                np.concatenate([xs[k], us[k]]),
                jacobian,
                rows=names,
                columns=model.state_names + model.input_names,
                method="continuous time" if own else "autodiff, continuous time",
                subject=f"the equations of motion of {model.name}",
            )
            for k in self.knots
        )

"""Iterative LQR on Drake's own steps: a Riccati sweep back, a rollout with feedback forward.

Li and Todorov, "Iterative linear quadratic regulator design for nonlinear biological movement systems", 2004.
Its feedback follows curved valleys of the cost in which quasi-Newton shooting crawls. No hard goal and no state
bounds; inputs that meet a bound are clipped and, where the cost pushes outwards, taken out of the sweep.
"""

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drake_diff.arrays import Array
from drake_diff.cost import (
    differentiate_cost,
    differentiate_final_cost,
    final_cost_hessian,
    running_cost_hessian,
)
from drake_diff.exceptions import InputError, SimulationError
from drake_diff.nonlinear_program import Limits, NlpResult, Outcome, Report, interrupt_flag
from drake_diff.problem import Problem
from drake_diff.rollout import roll_states
from drake_diff.rollout_gradient import linearize
from drake_diff.solution import Iteration
from drake_diff.step import advance

SMALLEST_REGULARIZATION, LARGEST_REGULARIZATION = 1e-8, 1e8
SUFFICIENT_DECREASE = 1e-4


def check_problem(problem: Problem) -> None:
    """Refuse what iLQR here cannot keep, naming what can."""
    for subject in _unkept(problem):
        raise InputError(subject, got="given", expected='none for method="ilqr"; method="shooting" takes it')


def is_solvable(problem: Problem) -> bool:
    """Whether `problem` has nothing that iLQR here cannot keep."""
    return not list(_unkept(problem))


def _unkept(problem: Problem) -> Iterator[str]:
    if problem.x_goal is not None:
        yield "x_goal"
    if np.isfinite(problem.bounds.x_lower).any() or np.isfinite(problem.bounds.x_upper).any():
        yield "state bounds"
    if problem.initial_state_mask.any():
        yield 'optimize "initial_state"'
    if not problem.optimizes_controls:
        yield "fixed controls"
    if problem.parameters.parameters:
        yield "parameters"
    if problem.trajectory_cost is not None:
        yield "trajectory_cost"


def solve_ilqr(problem: Problem, us: Array, *, limits: Limits, report: Report | None) -> tuple[NlpResult, Array, Array]:
    """Solve `problem` from the inputs `us` (N, nu); gives (result, xs, us), result.z being us flat."""
    search = _Search(problem, us, limits, report)
    with interrupt_flag() as interrupted:
        outcome = search.run(interrupted)
    message = f"iLQR: {outcome.value} after {len(search.rows) - 1} steps"
    return NlpResult(search.us.ravel(), outcome, message, tuple(search.rows)), search.xs, search.us


@dataclass(frozen=True, eq=False)
class _Sweep:
    feedforward: list[Array]
    feedback: list[Array]
    expected: float  # the decrease that the quadratic model promises, as a positive number
    gradient: float  # the largest |dJ/du| of an input that is free to move


class _Search:
    def __init__(self, problem: Problem, us: Array, limits: Limits, report: Report | None):
        self.problem, self.limits, self.report = problem, limits, report
        self.us = np.clip(us, problem.bounds.u_lower, problem.bounds.u_upper)
        self.xs = roll_states(problem.model, problem.x0, self.us)
        self.cost = problem.objective(self.xs, self.us)
        self.regularization = 0.0
        self.rows = [Iteration(0, self.cost, 0.0, math.nan, math.nan)]
        self.start = time.monotonic()

    def run(self, interrupted: threading.Event) -> Outcome:
        for iteration in range(1, self.limits.max_iterations + 1):
            model = _QuadraticModel(self.problem, self.xs, self.us)
            outcome = self._step(model, iteration)
            if outcome is not None:
                return outcome
            if interrupted.is_set():
                return Outcome.INTERRUPTED
            if time.monotonic() - self.start > self.limits.time_limit:
                return Outcome.TIME_LIMIT
        return Outcome.ITERATION_LIMIT

    def _step(self, model: "_QuadraticModel", iteration: int) -> Outcome | None:
        """Take one step that lowers the cost; an outcome where there is none left to take."""
        while self.regularization <= LARGEST_REGULARIZATION:
            sweep = model.sweep(self.regularization)
            if sweep is not None:
                if sweep.expected <= self.limits.tolerance**2 * (1 + abs(self.cost)):
                    return Outcome.SOLVED
                for size in 0.5 ** np.arange(12):
                    if self._try(sweep, float(size), iteration):
                        self.regularization = self._relaxed()
                        return None
                if sweep.expected <= 1e-13 * (1 + abs(self.cost)):
                    return Outcome.SOLVED  # what is left to gain is less than the cost's rounding
            self.regularization = max(8 * self.regularization, SMALLEST_REGULARIZATION)
        return Outcome.INACCURATE

    def _relaxed(self) -> float:
        smaller = self.regularization / 8
        return smaller if smaller > SMALLEST_REGULARIZATION else 0.0

    def _try(self, sweep: _Sweep, size: float, iteration: int) -> bool:
        try:
            xs, us, cost = self._roll_with_feedback(sweep, size)
        except SimulationError:
            return False  # too long a step: a shorter one is tried next
        if not cost <= self.cost - SUFFICIENT_DECREASE * size * sweep.expected:
            return False
        self.xs, self.us, self.cost = xs, us, cost
        self.rows.append(Iteration(iteration, cost, 0.0, sweep.gradient, size))
        if self.report:
            self.report(f"iteration {iteration:4d}  cost {cost:12.6g}  gradient {sweep.gradient:9.2e}  step {size:.3g}")
        return True

    def _roll_with_feedback(self, sweep: _Sweep, size: float) -> tuple[Array, Array, float]:
        bounds, xs, us = self.problem.bounds, [np.array(self.problem.x0)], []
        for k, u in enumerate(self.us):
            wanted = u + size * sweep.feedforward[k] + sweep.feedback[k] @ (xs[-1] - self.xs[k])
            us.append(np.clip(wanted, bounds.u_lower, bounds.u_upper))
            xs.append(advance(self.problem.model.double, xs[-1], us[-1]))
        states, inputs = np.array(xs), np.array(us)
        return states, inputs, self.problem.objective(states, inputs)


class _QuadraticModel:
    """Dynamics to first and cost to second order along a motion."""

    def __init__(self, problem: Problem, xs: Array, us: Array):
        self.problem, self.us = problem, us
        self.steps = linearize(problem.model, xs[0], us)
        h, nx, nu = problem.model.time_step, problem.model.nx, problem.model.nu
        self.hessians = np.zeros((len(us), nx + nu, nx + nu))
        self.gradients = np.zeros((len(us), nx + nu))
        if problem.running_cost is not None:
            for k, u in enumerate(us):
                _, by_x, by_u = differentiate_cost(problem.running_cost, xs[k], u)
                self.gradients[k] = h * np.concatenate([by_x, by_u])
                self.hessians[k] = h * running_cost_hessian(problem.running_cost, xs[k], u)
        self.final_gradient, self.final_hessian = np.zeros(nx), np.zeros((nx, nx))
        if problem.final_cost is not None:
            self.final_gradient = differentiate_final_cost(problem.final_cost, xs[-1])[1]
            self.final_hessian = final_cost_hessian(problem.final_cost, xs[-1])

    def sweep(self, regularization: float) -> _Sweep | None:
        """The Riccati recursion; None where the inputs' Hessian is not positive definite."""
        nx = self.problem.model.nx
        slope, curvature = self.final_gradient, self.final_hessian
        feedforward, feedback, expected, largest = [], [], 0.0, 0.0
        for k in reversed(range(len(self.us))):
            d = self.steps[k]
            dynamics = np.hstack([d.A, d.B])
            q = self.gradients[k] + dynamics.T @ slope
            Q = self.hessians[k] + dynamics.T @ curvature @ dynamics
            free = self._free(k, q[nx:])
            gains = _gains(Q, q, nx, free, regularization)
            if gains is None:
                return None
            step, gain = gains
            expected -= float(step @ q[nx:]) + 0.5 * float(step @ Q[nx:, nx:] @ step)
            largest = max(largest, float(np.abs(q[nx:][free]).max(initial=0.0)))
            slope = q[:nx] + gain.T @ (Q[nx:, nx:] @ step + q[nx:]) + Q[:nx, nx:] @ step
            curvature = Q[:nx, :nx] + gain.T @ Q[nx:, nx:] @ gain + gain.T @ Q[nx:, :nx] + Q[:nx, nx:] @ gain
            curvature = (curvature + curvature.T) / 2
            feedforward.append(step)
            feedback.append(gain)
        return _Sweep(feedforward[::-1], feedback[::-1], expected, largest)

    def _free(self, k: int, gradient: Array) -> Array:
        """Which inputs may move: not those at a bound that the cost pushes against."""
        bounds, u = self.problem.bounds, self.us[k]
        return ~(((u <= bounds.u_lower) & (gradient > 0)) | ((u >= bounds.u_upper) & (gradient < 0)))


def _gains(Q: Array, q: Array, nx: int, free: Array, regularization: float) -> tuple[Array, Array] | None:
    """(step (nu,), gain (nu, nx)) that minimize the quadratic model over the free inputs."""
    nu = len(q) - nx
    step, gain = np.zeros(nu), np.zeros((nu, nx))
    if not free.any():
        return step, gain
    inputs = nx + np.flatnonzero(free)
    hessian = Q[np.ix_(inputs, inputs)] + regularization * np.eye(len(inputs))
    try:
        np.linalg.cholesky(hessian)
    except np.linalg.LinAlgError:
        return None
    solved = -np.linalg.solve(hessian, np.column_stack([q[inputs], Q[inputs, :nx]]))
    step[free], gain[free] = solved[:, 0], solved[:, 1:]
    return step, gain

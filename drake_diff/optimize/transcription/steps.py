"""Shooting: a plan in Drake's own steps as a sparse program, z = [x_0, u_0, x_1, u_1, ..., x_N, parameters].

    g = x_(k+1) - f(x_k, u_k, p),    d^2 (lambda' g) = -sum_k lambda_k' d^2 f

Every state is a variable and every step a row, so that the effect of a late input does not pass through all earlier
steps (Bock and Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", 1984, with one
step per segment). First derivatives are the exact derivatives of the steps. Second derivatives are blocks, because a
step's Jacobian contains only its first and last state: they are analytic, or central differences of the Jacobians, or
learned over iterations. The same program defines the optimum for plans by iLQR and by shooting.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, frozen
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.model.parameters import ParameterVector
from drake_diff.motion.intervals import roll
from drake_diff.motion.loss import differentiate_loss
from drake_diff.optimize.ilqr.expansion import Motion, curvature_along
from drake_diff.optimize.knots import (
    DIFFERENCE,
    Called,
    KnotCost,
    PointFunction,
    costs_of,
    knot_function,
    require_finite,
)
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.cost import differentiate_final_cost
from drake_diff.optimize.problem.dynamics import PROBED
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iterate, Iteration, Limits, Multipliers, NlpResult, Outcome, Report
from drake_diff.optimize.transcription.expressions import joined_function
from drake_diff.optimize.transcription.program import COST, BlockProgram, solve_ipopt

ROUGH_DIFFERENCE = 1e-4  # for Jacobians that are differences themselves
ROUGH = "finite_difference"
CHEAP = {
    "analytic",
    "implicit",
}  # methods with one call for all steps: differences for second derivatives cost less than iterations
SMALLEST_MOVE, SAFE_DIVISOR = 1e-7, 1e-6  # least step and relative divisor of a symmetric rank one update
WITHIN = {"ipopt.bound_relax_factor": 0.0}  # the plant clips inputs beyond a limit
SAME_MOTION = 1e-8  # of a state's range: a rollout within this distance of a program's states is the same motion


def solve_shooting(
    problem: Problem,
    xs: Array,
    us: Array,
    *,
    limits: Limits,
    report: Report | None,
    values: Array | None = None,
    multipliers: Multipliers | None = None,
) -> tuple[NlpResult, Array, Array]:
    """Solve `problem` from the guess xs (N+1, nx), us (N, nu), a rollout or not. Return (result, xs, us).

    The search starts from the parameters `values` (np,), by default those of the problem's `design`, and from
    `multipliers` of a similar search. The returned states are the rollout of the inputs if it agrees with the program's
    states. Otherwise they are the program's states, which satisfy the steps within the tolerance, because an unstable
    motion deviates from them open loop. If a point cannot be simulated or differentiated, the step is shortened, and
    the message counts such points. Raises GradientError or SimulationError if the guess is such a point.
    """
    program = StepProgram(problem, lenient=True)
    guess = np.clip(program.pack(xs, us, values), program.lower, program.upper)
    program.require(guess)
    known = multipliers if multipliers and multipliers.sizes == (program.size, len(program.sides[0])) else None
    exact = not program.why_not
    result = program.optimum_at(guess, limits.tolerance)
    if result is None:
        result = solve_ipopt(
            program, guess, limits, report, exact=exact, multipliers=known, more=WITHIN, motions=program.iterates
        )
    elif report is not None:
        report.row(result.iterations[0], lambda: program.iterates(guess))
    if program.refusals:
        count = f"{program.refusals} point{'s' * (program.refusals > 1)}"
        remark = (
            f"; the line search avoided {count} that could not be stepped or differentiated, the last: "
            f"{program.refusal}"
        )
        refused = result.outcome is Outcome.FAILED
        outcome = Outcome.NO_GRADIENT if refused else result.outcome
        result = replace(result, message=result.message + remark, outcome=outcome)
    xs, us, parameters = program.motion(np.clip(result.z, program.lower, program.upper))
    result = replace(result, parameters=parameters)
    try:
        with problem.intervals(problem.design.vector.at(parameters)) as intervals:
            rolled = roll(intervals, xs[0], us)
    except SimulationError:
        return result, xs, us
    is_same = np.all(np.abs(rolled - xs) <= SAME_MOTION * problem.state_scales(xs))
    return result, rolled if is_same else xs, us


class StepProgram(BlockProgram):
    """The program of a `Problem` with a model in discrete steps.

    `states_at` (N+1, nx), `inputs_at` (N, nu) and `parameters_at` (np,) are their indices in z. If `lenient`, the
    Hessian omits the steps' curvature if a point near z cannot be simulated or differentiated.
    """

    backs_off = (GradientError, SimulationError)

    def __init__(self, problem: Problem, *, lenient: bool = False):
        self.problem, self.design = problem, problem.design
        nx, nu, count = problem.nx, problem.nu, problem.num_steps
        self.states_at = np.arange(count + 1)[:, None] * (nx + nu) + np.arange(nx)
        self.inputs_at = np.arange(count)[:, None] * (nx + nu) + nx + np.arange(nu)
        self.parameters_at = self.states_at[-1, -1] + 1 + np.arange(self.design.count)
        super().__init__(self._bounds(0), self._bounds(1))
        self.steps = Steps(self, lenient=lenient)
        knots = np.hstack([self.states_at, self.inputs_at[np.minimum(np.arange(count + 1), count - 1)]])
        self.blocks = np.hstack([knots[:-1], np.tile(self.parameters_at, (count, 1))])
        rows = self.add_rows(np.zeros(count * nx), np.zeros(count * nx))
        self.add_linear(rows, self.states_at[1:].ravel(), 1.0)
        self.add(self.steps, self.blocks).weigh(rows, np.arange(count * nx), -1.0)
        probe = np.random.default_rng(0).uniform(0.5, 1.5, (PROBED, nx + nu))
        probe[:, nx:] = np.clip(probe[:, nx:], problem.bounds.u_lower, problem.bounds.u_upper)
        self._add_costs(knots[:-1], probe)
        for c in problem.kept:
            at_knots = np.array(problem.knots_of(c, input_at_end=False))
            self._add_values(knot_function(c, nx, nu, probe), knots[at_knots], c)
        for coupling in problem.coupled_steps():
            sides = knots[coupling.knots][:, :, :nx], knots[coupling.knots][:, :, nx:]
            columns = np.hstack([side.reshape(len(side), -1) for side in sides])
            self._add_values(joined_function(coupling, nx, probe), columns, coupling.rows)

    def _add_values(self, function: PointFunction, columns: Indices, c: Constraint) -> None:
        rows = self.add_rows(np.tile(c.lower, len(columns)), np.tile(c.upper, len(columns)))
        self.add(function, columns).weigh(rows, np.arange(len(rows)), 1.0)

    def _add_costs(self, knots: Indices, probe: Array) -> None:
        problem, design, nx = self.problem, self.design, self.problem.nx
        h = design.time_step(np.asarray(design.vector.values))
        running, final = (stage.cost for stage in costs_of(problem, probe[:, :nx], probe[:, nx:]).stages)
        times = h * np.arange(len(knots) + 1.0)
        term = self.add(_KnownCost(running, knots.shape[1], times[:-1]), knots, self.horizon_at, h)
        unit = self.horizon_unit / len(knots) if design.moves_step else 1.0  # for a step's length, linear in c
        term.weigh(COST, np.arange(len(knots)), unit, by_time=True)
        self.add(_KnownCost(final, nx, times[-1:]), self.states_at[-1:]).weigh(COST, 0, 1.0)
        if problem.trajectory_cost is not None:
            self.why_not = "trajectory_cost joins all states"
            columns = np.concatenate([self.states_at.ravel(), self.inputs_at.ravel()])
            self.add(self._whole_motion(len(columns)), columns[None]).weigh(COST, 0, 1.0)
        if problem.parameter_cost is not None:
            self.add(self._parameter_cost(), self.parameters_at[None]).weigh(COST, 0, 1.0)

    def _whole_motion(self, width: int) -> Called:
        """Return the function `trajectory_cost` of all states and inputs."""
        cost: Any = self.problem.trajectory_cost

        def motion(points: Array) -> tuple[Array, Array]:
            xs, us = np.split(points[0], [self.states_at.size])
            return xs.reshape(self.states_at.shape), us.reshape(self.inputs_at.shape)

        def linearize(points: Array) -> tuple[Array, Array]:
            value, by_xs, by_us, _ = differentiate_loss(cost, *motion(points))
            return np.array([[value]]), np.concatenate([by_xs.ravel(), by_us.ravel()])[None, None]

        return Called(self.why_not, lambda z: np.array([[float(cost(*motion(z)))]]), linearize, 1, width)

    def _parameter_cost(self) -> Called:
        """Return `parameter_cost` as a function of the coordinates."""
        cost: Any = self.problem.parameter_cost

        def linearize(points: Array) -> tuple[Array, Array]:
            values = self.design.values(points[0])
            value, slope = differentiate_final_cost(cost, np.array(self.design.own(values)))
            by_values = np.append(slope, np.zeros(len(values) - len(slope)))
            return np.array([[value]]), self.design.pull_back(points[0], by_values)[None, None]

        def value_at(points: Array) -> Array:
            return np.array([[self.problem.cost_of_parameters(self.design.own(self.design.values(points[0])))]])

        return Called("", value_at, linearize, 1, self.design.count)

    @property
    def horizon_at(self) -> int | None:
        """The index in z of the step length's coordinate, in units of `horizon_unit` [s] of all steps."""
        return self.size - 1 if self.design.moves_step else None

    @cached_property
    def horizon_unit(self) -> float:
        if not self.design.moves_step:
            return 1.0
        by_values = np.zeros(len(self.design.vector.values))
        by_values[self.design.own_count] = self.problem.num_steps
        return float(self.design.pull_back(self.design.start, by_values)[-1])

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names (n,) of the variables."""
        names = np.full(self.size, "", dtype=object)
        for positions, labels in (
            (self.states_at, self.problem.state_names),
            (self.inputs_at, self.problem.input_names),
        ):
            for k, row in enumerate(positions):
                names[row] = [f"{name} at knot {k}" for name in labels]
        names[self.parameters_at] = self.design.coordinates.start.names
        return tuple(names)

    def pack(self, xs: Array, us: Array, values: Array | None = None) -> Array:
        """Return z (n,) from xs (N+1, nx), us (N, nu) and the values of the problem's `design`, by default its own."""
        z = np.empty(self.states_at.size + self.inputs_at.size + len(self.parameters_at))
        z[self.states_at], z[self.inputs_at] = xs, us
        z[self.parameters_at] = self.design.of_values(self.design.vector.values if values is None else values)
        return z

    def motion(self, z: Array) -> tuple[Array, Array, Array]:
        """Return xs (N+1, nx), us (N, nu) and the values (np,) of the problem's `design` at z (n,)."""
        return z[self.states_at], z[self.inputs_at], self.design.values(z[self.parameters_at])

    def vector(self, z: Array) -> ParameterVector:
        """Return the parameters of the steps at z (n,)."""
        return self.design.at(z[self.parameters_at])

    def spans(self, z: Array) -> Array:
        """Return the spans (n,) of `Problem.search_spans`, and 1 for coordinates."""
        xs, us, values = self.motion(z)
        along = self.steps.along(z[self.blocks])
        slopes = np.array([np.hstack([d.A - np.eye(len(d.A)), d.B]) for d in along]) / self.design.time_step(values)
        spans = np.ones(self.size)
        of_knot = self.problem.search_spans(xs, us, np.max(np.abs(slopes), axis=0), self.problem.start_horizon)
        spans[self.states_at], spans[self.inputs_at] = np.split(of_knot, [self.problem.nx])
        return spans

    def require(self, z: Array) -> None:
        """Raise GradientError or SimulationError if a step at z (n,) cannot be simulated or differentiated."""
        self.steps.along(z[self.blocks])

    def optimum_at(self, z: Array, tolerance: float) -> NlpResult | None:
        """Return z (n,) with multipliers of 0 if it satisfies every row and the cost has no slope, or else None.

        An interior point method would move such a point to the middle of the bounds.
        """
        cost, gradient = self.gradient(z)
        rows, (lower, upper) = self.evaluate(z)[1], self.sides
        violation = float(np.max(np.maximum(lower - rows, rows - upper), initial=0.0))
        if np.any(gradient) or not violation <= tolerance:
            return None
        table = (Iteration(0, cost, violation, 0.0, 0.0),)
        message = "the guess keeps every constraint, and the cost has no slope there"
        multipliers = Multipliers(np.zeros(self.size), np.zeros(len(rows)))
        return NlpResult(z, Outcome.SOLVED, message, table, stationarity=0.0, multipliers=multipliers)

    def iterates(self, z: Array) -> tuple[Iterate, ...]:
        """Return the motion at z, for callbacks."""
        xs, us, values = self.motion(z)
        times = frozen(self.design.time_step(values) * np.arange(len(xs)))
        return (Iterate(self.problem, times, frozen(xs), frozen(us), self.vector(z), by_steps=True),)

    def _bounds(self, side: int) -> Array:
        problem, b = self.problem, self.problem.bounds
        inputs = np.tile((b.u_lower, b.u_upper)[side], (problem.num_steps, 1))
        inputs = inputs if problem.optimizes_controls else np.asarray(problem.us)
        return self.pack(problem.state_limits()[side], inputs, (self.design.lower, self.design.upper)[side])


class _KnownCost(PointFunction):
    """A cost at knots with known `times`."""

    rows = 1

    def __init__(self, cost: KnotCost, width: int, times: Array):
        self.cost, self.width, self.times = cost, width, times
        self.jacobian_at = np.zeros(width, dtype=int), np.arange(width)
        self.hessian_at = np.triu_indices(width)

    def values(self, points: Array) -> Array:
        return self.cost.values(points, self.times)[:, None]

    def jacobian(self, points: Array) -> Array:
        gradients = self.cost.expand(points, self.times)[0]
        require_finite(gradients, points)
        return gradients

    def hessian(self, points: Array, weights: Array, jacobian: Array) -> Array:
        return np.asarray(weights * self.cost.expand(points, self.times)[1][:, *self.hessian_at])


class Steps(PointFunction):
    """The next states of N points [x, u, c], which share the coordinates c of the problem's design."""

    def __init__(self, program: StepProgram, *, lenient: bool):
        problem = program.problem
        self.program, self.problem, self.design, self.lenient = program, problem, program.design, lenient
        self.rows, self.knot, self.width = (
            problem.nx,
            problem.nx + problem.nu,
            problem.nx + problem.nu + self.design.count,
        )
        self.jacobian_at = np.repeat(np.arange(self.rows), self.width), np.tile(np.arange(self.width), self.rows)
        self.hessian_at = np.triu_indices(self.width)
        self.methods: set[str] = set()  # sources of the Jacobians
        self._kept: tuple[bytes, list[StepDerivatives]] = b"", []
        self._last: tuple[Array, Array, Array] | None = None  # a point, its Jacobians, and the learned curvature

    def along(self, points: Array) -> list[StepDerivatives]:
        """Return the derivatives of the N steps, computed once. Raises GradientError or SimulationError."""
        if self._kept[0] != points.tobytes():
            self._kept = points.tobytes(), self._taken(points)
        return self._kept[1]

    def _taken(self, points: Array) -> list[StepDerivatives]:
        xs = points[:, : self.rows]
        with self.problem.intervals(self.design.at(points[0, self.knot :])) as intervals:
            derivatives: list[StepDerivatives] = intervals.derivatives(xs[0], self._inputs(points), xs)
        self.methods |= {d.method for d in derivatives}
        return derivatives

    def _inputs(self, points: Array) -> Array:
        """Return the inputs (N, nu), moved by rounding inside their bounds, beyond which the plant clips an input."""
        b, us = self.problem.bounds, points[:, self.rows : self.knot]
        us = np.where(us >= b.u_upper, np.nextafter(b.u_upper, b.u_lower), us)
        return np.where(us <= b.u_lower, np.nextafter(b.u_lower, b.u_upper), us)

    def values(self, points: Array) -> Array:
        return np.array([d.x_next for d in self.along(points)])

    def jacobian(self, points: Array) -> Array:
        return self._dense(points[0], self.along(points)).reshape(len(points), -1)

    def _dense(self, point: Array, steps: Sequence[StepDerivatives]) -> Array:
        """Return the Jacobians (N, nx, w)."""
        c = point[self.knot :]
        return np.array([np.hstack([d.A, d.B, self.design.pull_back(c, d.C)]) for d in steps])

    def hessian(self, points: Array, weights: Array, jacobian: Array) -> Array:
        """Return the analytic curvature of known steps; of others, differences of Jacobians, or learned if slow."""
        steps, xs, known = self.along(points), points[:, : self.rows], None
        curvature, rest = np.zeros((*points.shape, self.width)), np.ones(len(points), dtype=bool)
        if not self.design.vector.parameters and self.problem.has_model:
            ends = np.array([d.x_next for d in steps])
            states = np.vstack([xs, ends[-1:]])
            known = curvature_along(self.problem, Motion(states, self._inputs(points), ends - states[1:]), weights)
        if known is not None:
            curvature[known[1]], rest = known[0], ~known[1]
        if rest.any() and self.lenient and not {d.method for d in steps} <= CHEAP:
            curvature[rest] = self._learned(points, jacobian.reshape(len(points), self.rows, -1), weights)[rest]
        elif rest.any():
            curvature[rest] = self._differences(points[rest], weights[rest])
        return np.asarray(curvature[:, *self.hessian_at])

    def _learned(self, points: Array, jacobians: Array, weights: Array) -> Array:
        """Learn the curvature from the Jacobians at previous points, block by block, by symmetric rank one updates.

        Griewank and Toint, "Partitioned variable metric updates for large structured optimization problems", 1982.
        """
        if self._last is None:
            self._last = points, jacobians, np.zeros((*points.shape, points.shape[1]))
        before, old, learned = self._last
        step = points - before
        off = np.einsum("kij,ki->kj", jacobians - old, weights) - np.einsum("kij,kj->ki", learned, step)
        divisor, length = np.einsum("ki,ki->k", off, step), np.linalg.norm(step, axis=1)
        safe = (length > SMALLEST_MOVE) & (np.abs(divisor) > SAFE_DIVISOR * length * np.linalg.norm(off, axis=1))
        learned[safe] += off[safe, :, None] * off[safe, None, :] / divisor[safe, None, None]
        self._last = points, jacobians, learned
        return np.array(learned)

    def _differences(self, points: Array, weights: Array) -> Array:
        """Return the curvature (N, w, w) by central differences of the Jacobians."""
        lower, upper = np.full(self.width, -np.inf), np.full(self.width, np.inf)
        inputs = slice(self.rows, self.knot)  # the plant may clip inputs beyond their bounds
        lower[inputs], upper[inputs] = self.problem.bounds.u_lower, self.problem.bounds.u_upper
        fraction = ROUGH_DIFFERENCE if ROUGH in self.methods else DIFFERENCE
        curvature = np.zeros((*points.shape, self.width))
        for j in range(self.width):
            step, ends = np.zeros_like(points), []
            step[:, j] = fraction * np.maximum(1.0, np.abs(points[:, j]))
            for side in (-1, 1):
                moved = np.clip(points + side * step, lower, upper)
                try:
                    slopes = self._dense(moved[0], self._taken(moved))
                except (GradientError, SimulationError) as error:
                    if not self.lenient:
                        raise
                    self.program.refusals, self.program.refusal = self.program.refusals + 1, str(error)
                    return np.zeros_like(curvature)
                ends.append((moved[:, j], np.einsum("kij,ki->kj", slopes, weights)))
            (low, before), (high, after) = ends
            apart = np.where(high > low, high - low, np.inf)
            curvature[:, :, j] = (after - before) / apart[:, None]
        return (curvature + curvature.swapaxes(1, 2)) / 2

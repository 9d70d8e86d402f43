"""Shooting: a plan by Drake's own steps as a sparse program, z = [x_0, u_0, x_1, u_1, ..., x_N, parameters].

    g = x_(k+1) - f(x_k, u_k, p),    d^2 (lambda' g) = -sum_k lambda_k' d^2 f

Every state is a variable and every step a row, so that what a late input does need not be seen through all the steps
before it (Bock and Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", 1984, with a
step to a segment). First derivatives are those of the steps, exact. Second ones are by blocks, as no two states are in
one step's Jacobian but the first and the last of it: known, or central differences of the Jacobians, or learned from
iteration to iteration. The same program says what is an optimum of plans by iLQR and by shooting alike.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices, frozen
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.model.parameters import ParameterVector
from drake_diff.motion.intervals import roll
from drake_diff.motion.loss import differentiate_loss
from drake_diff.optimize.ilqr.expansion import Motion, curvature_along
from drake_diff.optimize.knots import costs_of
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.cost import differentiate_final_cost
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iterate, Iteration, Limits, Multipliers, NlpResult, Outcome, Report
from drake_diff.optimize.transcription.program import solve_ipopt

DIFFERENCE = 1e-5  # of max(1, |z|): of exact Jacobians, known to 1e-12
ROUGH_DIFFERENCE = 1e-4  # of Jacobians that are differences themselves
ROUGH = "finite_difference"
CHEAP = {
    "analytic",
    "implicit",
}  # of all steps in one call: second derivatives by differences cost less than iterations
SMALLEST_MOVE, SAFE_DIVISOR = 1e-7, 1e-6  # where symmetric rank one is not defined, or of rounding
# Beyond a limit the plant cuts inputs off; CasADi makes no derivatives of what is called back.
CALLED_BACK = {"ipopt.bound_relax_factor": 0.0, "no_nlp_grad": True}
SAME_MOTION = 1e-8  # of a state's range: a rollout that stays so near to the states of a program is its motion


def solve_shooting(
    problem: Problem,
    xs: Array,
    us: Array,
    *,
    limits: Limits,
    report: Report | None,
    values: Array | None = None,
    begun: Multipliers | None = None,
) -> tuple[NlpResult, Array, Array]:
    """Solve `problem` from the guess xs (N+1, nx), us (N, nu), a rollout or not; gives (result, xs, us).

    `values` (np,) are those of the problem's `design` to begin with, its own where None; `begun` the multipliers of a
    search like this one. The states are the rollout of the inputs where that stays at those of the program, and else
    these themselves, which steps lead from to within the tolerance: an unstable motion leaves them open loop. A point
    that cannot be stepped or differentiated is a step that was too long, which the message counts; raises GradientError
    or SimulationError if the guess is such a point.
    """
    program = StepProgram(problem, lenient=True)
    guess = np.clip(program.pack(xs, us, values), program.lower, program.upper)
    program.require(guess)
    known = begun if begun is not None and begun.sizes == (program.size, len(program.sides[0])) else None
    exact = not program.functions.why_not
    result = program.optimum_at(guess, limits.tolerance)
    if result is None:
        result = solve_ipopt(
            program, guess, limits, report, exact=exact, begun=known, more=CALLED_BACK, motions=program.iterates
        )
    elif report is not None:
        report.row(result.iterations[0], lambda: program.iterates(guess))
    if program.refusals:
        count = f"{program.refusals} point{'s' * (program.refusals > 1)}"
        remark = f"; backed off from {count} that could not be stepped or differentiated, the last: {program.refusal}"
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
    is_same = np.all(np.abs(rolled - xs) <= SAME_MOTION * problem.ranges(xs))
    return result, rolled if is_same else xs, us


@dataclass(eq=False)
class Called:
    """What a program calls back: it has second derivatives, and keeps the first error that is none of a step."""

    why_not: str = ""
    error: Exception | None = None


class StepProgram:
    """The program of a `Problem` whose model takes discrete steps, with derivatives as CasADi's nlpsol takes them.

    `states_at` (N+1, nx), `inputs_at` (N, nu) and `parameters_at` (np,) say where in z they are. `refusals` counts the
    points that could not be stepped or differentiated, and `refusal` says why the last one could not. If `lenient`, the
    Hessian goes without the steps' curvature where a point beside z is such a point.
    """

    def __init__(self, problem: Problem, *, lenient: bool = False):
        self.problem, self.lenient, self.refusals, self.refusal = problem, lenient, 0, ""
        nx, nu, count = problem.nx, problem.nu, problem.num_steps
        self.design = problem.design
        width, free = nx + nu, self.design.count
        self.states_at = np.arange(count + 1)[:, None] * width + np.arange(nx)
        self.inputs_at = np.arange(count)[:, None] * width + nx + np.arange(nu)
        self.parameters_at = count * width + nx + np.arange(free)
        self.size = count * width + nx + free
        self.horizon_at: int | None = self.size - 1 if self.design.moves_step else None
        self.horizon_unit = count * float(self._by_step(self.design.start)[-1]) if self.design.moves_step else 1.0
        single = [(c, np.array([k])) for c in problem.kept for k in problem.knots_of(c, input_at_end=False)]
        several = [(c.rows, knots) for c in problem.coupled_steps() for knots in c.knots]
        self.paths = [_Path(self, rows, knots) for rows, knots in (*single, *several)]
        joins_all = problem.trajectory_cost is not None
        self.functions: Any = Called("trajectory_cost joins all states" if joins_all else "")
        self.z = ca.MX.sym("z", self.size)
        self.lower, self.upper = self._bounds(0), self._bounds(1)  # equal where a variable is given
        self.methods: set[str] = set()  # where Jacobians came from
        self._kept: tuple[bytes, list[StepDerivatives]] = b"", []
        self._last: tuple[Array, Array, Array] | None = None  # a point, its Jacobians, and the curvature learned so far
        self._callbacks: list[Any] = []  # CasADi holds no reference to its callbacks
        self._blocks = [self._block(k) for k in range(count + 1)]
        self._set_places()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """(n,) of the variables."""
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
        """z (n,) of xs (N+1, nx), us (N, nu) and the values of the problem's `design`, its own where None."""
        z = np.empty(self.size)
        z[self.states_at], z[self.inputs_at] = xs, us
        z[self.parameters_at] = self.design.of_values(self.design.vector.values if values is None else values)
        return z

    def motion(self, z: Array) -> tuple[Array, Array, Array]:
        """xs (N+1, nx), us (N, nu) and the values (np,) of the problem's `design` at z (n,)."""
        return z[self.states_at], z[self.inputs_at], self.design.values(z[self.parameters_at])

    def require(self, z: Array) -> None:
        """Raise GradientError or SimulationError where a step at z (n,) cannot be taken or differentiated."""
        self._steps(z)

    def optimum_at(self, z: Array, tolerance: float) -> NlpResult | None:
        """z (n,) with multipliers of 0 if it keeps every row and the cost has no slope there; None else.

        An interior-point method would leave such a point for the middle of the bounds.
        """
        cost, gradient = self.gradient(z)
        rows, (lower, upper) = self._values(z)[1], self.sides
        violation = float(np.max(np.maximum(lower - rows, rows - upper), initial=0.0))
        if np.any(gradient) or not violation <= tolerance:
            return None
        table = (Iteration(0, cost, violation, 0.0, 0.0),)
        message = "the guess keeps every constraint, and the cost has no slope there"
        multipliers = Multipliers(np.zeros(self.size), np.zeros(len(rows)))
        return NlpResult(z, Outcome.SOLVED, message, table, stationarity=0.0, multipliers=multipliers)

    def iterates(self, z: Array) -> tuple[Iterate, ...]:
        """The motion at z, for callbacks."""
        xs, us, values = self.motion(z)
        times = frozen(self.design.time_step(values) * np.arange(len(xs)))
        return (Iterate(self.problem, times, frozen(xs), frozen(us), self.vector(z), by_steps=True),)

    def _bounds(self, side: int) -> Array:
        problem, b = self.problem, self.problem.bounds
        inputs = np.tile((b.u_lower, b.u_upper)[side], (problem.num_steps, 1))
        inputs = inputs if problem.optimizes_controls else np.asarray(problem.us)
        return self.pack(problem.state_limits()[side], inputs, (self.design.lower, self.design.upper)[side])

    @cached_property
    def sides(self) -> tuple[Array, Array]:
        """(lower, upper) of the rows: 0 of the steps, then those of the constraints and of the couplings."""
        steps = np.zeros(self.problem.num_steps * self.problem.nx)
        lower, upper = ([steps, *(getattr(p.rows, s) for p in self.paths)] for s in ("lower", "upper"))
        return np.concatenate(lower), np.concatenate(upper)

    @cached_property
    def nlp(self) -> dict[str, Any]:
        """x, f and g as CasADi's nlpsol takes them."""
        rows = len(self.sides[0])
        dense = [ca.Sparsity.dense(1, 1), ca.Sparsity.dense(rows, 1)]
        f, g = self._callback("values", [self.size], dense, self._values)(self.z)
        return {"x": self.z, "f": f, "g": g}

    def derivatives(self, exact: bool = True) -> dict[str, Any]:
        """CasADi Functions by the names of nlpsol's options; the Hessian is there in any case."""
        n, m = self.size, len(self.sides[0])
        scalar, vector, rows = ca.Sparsity.dense(1, 1), ca.Sparsity.dense(n, 1), ca.Sparsity.dense(m, 1)
        return {
            "grad_f": self._callback("grad_f", [n, 0], [scalar, vector], self._gradient),
            "jac_g": self._callback("jac_g", [n, 0], [rows, self._rows_at.sparsity], self._jacobian),
            "hess_lag": self._callback("hess_lag", [n, 0, 1, m], [self._hessian_at.sparsity], self._hessian),
        }

    def _callback(self, name: str, sizes: list[int], outputs: list[Any], evaluate: Callable[..., list[Any]]) -> Any:
        self._callbacks.append(_Callback(name, sizes, outputs, evaluate, self))
        return self._callbacks[-1]

    def _block(self, k: int) -> Indices:
        """Where in z the variables of knot `k` are, parameters last; of the last knot its state alone."""
        if k == self.problem.num_steps:
            return self.states_at[k]
        return np.concatenate([self.states_at[k], self.inputs_at[k], self.parameters_at])

    def _set_places(self) -> None:
        nx, rows, columns = self.problem.nx, [], []
        for k, block in enumerate(self._blocks[:-1]):
            here = k * nx + np.arange(nx)
            rows += [here, np.repeat(here, len(block))]
            columns += [self.states_at[k + 1], np.tile(block, nx)]
        first = self.problem.num_steps * nx
        for path in self.paths:
            here = first + np.arange(path.count)
            rows.append(np.repeat(here, len(path.columns)))
            columns.append(np.tile(path.columns, path.count))
            first += path.count
        self._rows_at = _Places(rows, columns, (first, self.size))
        pairs = [entries[np.array(np.triu_indices(len(entries)))] for entries in self._hessian_blocks]
        ends = [np.min(pair, axis=0) for pair in pairs], [np.max(pair, axis=0) for pair in pairs]
        self._hessian_at = _Places(*ends, (self.size, self.size))

    @property
    def _hessian_blocks(self) -> list[Indices]:
        """Which variables have second derivatives by each other: those of a knot, and of a constraint."""
        return [*self._blocks, *(path.columns for path in self.paths)]

    # ------------------------------------------------------------------------------ what it evaluates

    def vector(self, z: Array) -> ParameterVector:
        """The parameters of the steps at z (n,)."""
        return self.design.at(z[self.parameters_at])

    def _read(self, z: Array) -> tuple[Array, Array, float]:
        """xs (N+1, nx), us (N, nu) and the length of a step [s]; inputs are taken inside their bounds by rounding.

        A bound is often an actuator's limit, beyond which the plant cuts an input off.
        """
        b, us = self.problem.bounds, z[self.inputs_at]
        us = np.where(us >= b.u_upper, np.nextafter(b.u_upper, b.u_lower), us)
        us = np.where(us <= b.u_lower, np.nextafter(b.u_lower, b.u_upper), us)
        return z[self.states_at], us, self.design.time_step(self.design.values(z[self.parameters_at]))

    def _by_step(self, coordinates: Array) -> Array:
        """(nc,) the derivative of the length of a step by the coordinates."""
        by_values = np.zeros(len(self.design.vector.values))
        if self.design.moves_step:
            by_values[self.design.own_count] = 1.0
        return self.design.pull_back(coordinates, by_values)

    def _steps(self, z: Array) -> list[StepDerivatives]:
        if self._kept[0] != z.tobytes():
            (xs, us, _), vector = self._read(z), self.vector(z)
            with self.problem.intervals(vector) as intervals:
                derivatives = intervals.derivatives(xs[0], us, xs[:-1])
            self.methods |= {d.method for d in derivatives}
            self._kept = z.tobytes(), derivatives
        return self._kept[1]

    def _values(self, z: Array) -> list[Any]:
        xs, us = self._read(z)[:2]
        ends = np.array([d.x_next for d in self._steps(z)])
        with np.errstate(all="ignore"):
            paths = [path.rows(*path.packed(xs, us)) for path in self.paths]
            return [self._cost(z), np.concatenate([(xs[1:] - ends).ravel(), *paths])]

    def _cost(self, z: Array) -> float:
        parameters = self.design.own(self.design.values(z[self.parameters_at]))
        return self.problem.objective(*self._read(z)) + self.problem.cost_of_parameters(parameters)

    def gradient(self, z: Array) -> tuple[float, Array]:
        """The cost and its derivatives (n,) by all variables, the steps apart."""
        cost, slope = self._gradient(z, z)
        return float(cost), np.asarray(slope)

    def _gradient(self, z: Array, _: Array) -> list[Any]:
        xs, us, h = self._read(z)
        gradient, coordinates, nx = np.zeros(self.size), z[self.parameters_at], self.problem.nx
        costs = costs_of(self.problem, xs, us, h)
        by_nodes = costs.expand(xs, us)[0]
        gradient[self.states_at], gradient[self.inputs_at] = by_nodes[:, :nx], by_nodes[:-1, nx:]
        if self.problem.trajectory_cost is not None:
            _paid, by_xs, by_us, _method = differentiate_loss(self.problem.trajectory_cost, xs, us)
            gradient[self.states_at] += by_xs
            gradient[self.inputs_at] += by_us
        paid = float(np.sum(costs.values(xs, us)[:-1])) / h  # of a running cost, whose steps are all of one length
        gradient[self.parameters_at] = self._by_coordinates(coordinates) + paid * self._by_step(coordinates)
        return [self._cost(z), gradient]

    def _by_coordinates(self, coordinates: Array) -> Array:
        """(nc,) the gradient of `parameter_cost` by the coordinates."""
        cost, values = self.problem.parameter_cost, self.design.values(coordinates)
        by_values = np.zeros(len(values))
        if cost is not None:
            by_values[: self.design.own_count] = differentiate_final_cost(cost, np.array(self.design.own(values)))[1]
        return self.design.pull_back(coordinates, by_values)

    def _jacobians(self, z: Array) -> Array:
        """(N, nx, nx + nu + np) of the steps."""
        coordinates = z[self.parameters_at]
        return np.array([np.hstack([d.A, d.B, self.design.pull_back(coordinates, d.C)]) for d in self._steps(z)])

    def _jacobian(self, z: Array, _: Array) -> list[Any]:
        xs, us = self._read(z)[:2]
        ones, values = np.ones(self.problem.nx), []
        for rows in self._jacobians(z):
            values += [ones, -rows.ravel()]
        values += [path.jacobian(*path.packed(xs, us)).ravel() for path in self.paths]
        return [self._values(z)[1], self._rows_at.matrix(values)]

    def _hessian(self, z: Array, _: Array, sigma: Array, multipliers: Array) -> list[Any]:
        xs, us, h = self._read(z)
        count, nx, nu = self.problem.num_steps, self.problem.nx, self.problem.nu
        blocks = list(-self._curvature(z, multipliers[: count * nx].reshape(count, nx)))
        blocks.append(np.zeros((nx, nx)))
        coordinates, width = z[self.parameters_at], nx + nu
        by_step = self._by_step(coordinates)
        slopes, costs = costs_of(self.problem, xs, us, h).expand(xs, us)
        for block, slope, cost in zip(blocks[:-1], slopes, costs, strict=False):
            block[:width, :width] += sigma[0] * cost
            block[:width, width:] += sigma[0] * np.outer(slope / h, by_step)
        blocks[-1] += sigma[0] * costs[-1, :nx, :nx]
        for j, step in enumerate(np.diag(DIFFERENCE * np.maximum(1.0, np.abs(coordinates)))):
            apart = self._by_coordinates(coordinates + step) - self._by_coordinates(coordinates - step)
            blocks[0][width:, width + j] += sigma[0] * apart / (2 * step[j])
        first = count * nx
        for path in self.paths:
            blocks.append(path.curvature(*path.packed(xs, us), multipliers[first : first + path.count]))
            first += path.count
        return [self._hessian_at.matrix([b[np.triu_indices(len(b))] for b in blocks])]

    def _curvature(self, z: Array, weights: Array) -> Array:
        """(N, w, w), w = nx + nu + np: the second derivatives of weights (N, nx) times the steps."""
        steps, (xs, us) = self._steps(z), self._read(z)[:2]
        if not self.design.vector.parameters and self.problem.has_model:
            known = curvature_along(self.problem, Motion(xs, us, np.array([d.x_next for d in steps]) - xs[1:]), weights)
            if known is not None and known[1].all():
                return known[0]
        if self.lenient and not {d.method for d in steps} <= CHEAP:
            return self._learned(z, weights)
        return self._differences(z, weights)

    def _learned(self, z: Array, weights: Array) -> Array:
        """The same as far as the Jacobians at the points before tell, block by block, by symmetric rank one.

        Griewank and Toint, "Partitioned variable metric updates for large structured optimization problems", 1982.
        """
        points, jacobians = z[np.array(self._blocks[:-1])], self._jacobians(z)
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

    def _differences(self, z: Array, weights: Array) -> Array:
        """The same by central differences of the Jacobians."""
        points, b = np.array(self._blocks[:-1]), self.problem.bounds
        lower, upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        lower[self.inputs_at], upper[self.inputs_at] = b.u_lower, b.u_upper  # beyond them the plant may cut off
        fraction = ROUGH_DIFFERENCE if ROUGH in self.methods else DIFFERENCE
        curvature = np.zeros((*points.shape, points.shape[1]))
        for j, column in enumerate(points.T):
            where, ends = np.unique(column), []
            for side in (-1, 1):
                moved = np.array(z)
                moved[where] += side * fraction * np.maximum(1.0, np.abs(z[where]))
                moved = np.clip(moved, lower, upper)
                try:
                    slopes = self._jacobians(moved)
                except (GradientError, SimulationError) as error:
                    if not self.lenient:
                        raise
                    self.refusals, self.refusal, self._kept = self.refusals + 1, str(error), (b"", [])
                    return np.zeros_like(curvature)
                ends.append((moved[column], np.einsum("kij,ki->kj", slopes, weights)))
            (low, before), (high, after) = ends
            apart = np.where(high > low, high - low, np.inf)
            curvature[:, :, j] = (after - before) / apart[:, None]
        self._kept = b"", []
        return (curvature + curvature.swapaxes(1, 2)) / 2


class _Path:
    """A constraint on the states at the knots `at` (n,) side by side, and on the inputs there."""

    def __init__(self, program: StepProgram, rows: Constraint, knots: Indices):
        self.rows, self.at, self.count = rows, knots, len(rows.lower)
        self.columns = program.states_at[knots].ravel()
        if rows.takes_input:
            self.columns = np.concatenate([self.columns, program.inputs_at[knots].ravel()])

    def packed(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """What `rows` takes; a function of states alone takes any input."""
        return xs[self.at].ravel(), us[np.minimum(self.at, len(us) - 1)].ravel()

    def jacobian(self, x: Array, u: Array) -> Array:
        """(m, w) by the columns."""
        return np.asarray(self.rows.differentiate(x, u)[1][:, : len(self.columns)])

    def curvature(self, x: Array, u: Array, weights: Array) -> Array:
        """(w, w) the second derivative of weights (m,) times the values, by differences of their Jacobian."""
        z, curvature = np.concatenate([x, u]), np.zeros((len(self.columns), len(self.columns)))
        if not np.any(weights):
            return curvature
        for j in range(len(curvature)):
            step = np.zeros(len(z))
            step[j] = DIFFERENCE * max(1.0, abs(z[j]))
            low, high = (self.jacobian(*np.split(z + side * step, [len(x)])) for side in (-1, 1))
            curvature[j] = weights @ (high - low) / (2 * step[j])
        return (curvature + curvature.T) / 2


class _Places:
    """A sparse matrix whose entries are sums of values in one order."""

    def __init__(self, rows: list[Any], columns: list[Any], shape: tuple[int, int]):
        positions = np.concatenate(columns) * shape[0] + np.concatenate(rows)
        places, self.targets = np.unique(positions, return_inverse=True)
        down, across = places % shape[0], places // shape[0]
        starts = np.searchsorted(across, np.arange(shape[1] + 1))
        self.sparsity = ca.Sparsity(*shape, starts.tolist(), down.tolist())

    def matrix(self, values: list[Array]) -> Any:
        """A DM of the entries, in parts."""
        return ca.DM(self.sparsity, np.bincount(self.targets, np.concatenate(values), self.sparsity.nnz()))


class _Callback(ca.Callback):  # type: ignore[misc]
    """A function of vectors; NaN where a step cannot be taken or differentiated, so that a search shortens its step."""

    def __init__(
        self, name: str, sizes: list[int], outputs: list[Any], evaluate: Callable[..., list[Any]], owner: StepProgram
    ):
        ca.Callback.__init__(self)
        self.sizes, self.outputs, self.evaluate, self.owner = sizes, outputs, evaluate, owner
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self.sizes)

    def get_n_out(self) -> int:
        return len(self.outputs)

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.sizes[i], 1)

    def get_sparsity_out(self, i: int) -> Any:
        return self.outputs[i]

    def eval(self, arguments: Any) -> Any:
        """The outputs; an error that is none of a step is kept for the solve to raise, as C++ must not see it."""
        try:
            values = self.evaluate(*[np.asarray(a).ravel() for a in arguments])
        except (GradientError, SimulationError) as error:
            self.owner.refusals, self.owner.refusal = self.owner.refusals + 1, str(error)
            return [ca.DM(sparsity, np.nan) for sparsity in self.outputs]
        except Exception as error:
            self.owner.functions.error = self.owner.functions.error or error
            return [ca.DM(sparsity, np.nan) for sparsity in self.outputs]
        return [ca.DM(value) for value in values]

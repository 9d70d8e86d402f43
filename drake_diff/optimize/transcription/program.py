"""Optimal control by collocation as a sparse program, its exact derivatives, and IPOPT, which CasADi carries, on it.

With the rates F and their Jacobians J at all nodes, each computed once, the rest is linear in them:

    g = S z - T D F,    dg = S - T D J,    d^2 (lambda' g) = -T sum_k d^2 (nu_k' f),    nu = D' lambda

with constant sparse S and D from the scheme's states and slopes, so that the Hessian has one block a node, and a column
for a free final time T. The Bernstein coefficients of bounded states are rows of the same form, those of bounded inputs
linear ones. Path constraints add rows to g and terms to the blocks of their nodes, couplings between them.
"""

import math
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, Protocol

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices, frozen
from drake_diff._base.clock import Pace, StoppedError, TimeIsUpError, check_time, noted_interrupts, now, until_set
from drake_diff.exceptions import DrakeDiffError, GradientError, SimulationError
from drake_diff.optimize.program import (
    FEASIBILITY_TOLERANCE,
    Iterate,
    Iteration,
    Limits,
    Multipliers,
    NlpResult,
    Outcome,
    Report,
    Watch,
)
from drake_diff.optimize.transcription.coupled import SlopeRows, SparseSum, rows_of, slopes_of, sparse
from drake_diff.optimize.transcription.expressions import KnotFunctions, Timed
from drake_diff.optimize.transcription.task import OptimalControl

OUTCOMES = {
    "Solve_Succeeded": Outcome.SOLVED,
    "Solved_To_Acceptable_Level": Outcome.INACCURATE,
    "Maximum_Iterations_Exceeded": Outcome.ITERATION_LIMIT,
    "Infeasible_Problem_Detected": Outcome.INFEASIBLE,
    "Diverging_Iterates": Outcome.UNBOUNDED,
}
OPTIONS = {
    "ipopt.mu_strategy": "adaptive",  # the monotone one ends minimum times of a pendulum as infeasible
    "ipopt.max_hessian_perturbation": 1e8,  # of IPOPT's 1e20 it takes tens of iterations to come down again
    # Larger pivots fill the factors where the final time is free, whose column is dense, up to ten times.
    "ipopt.mumps_pivtol": 1e-8,
    "ipopt.mumps_permuting_scaling": 0,
    "ipopt.mumps_scaling": 1,
    "print_time": False,
    "show_eval_warnings": False,
    "calc_lam_p": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.print_user_options": "no",
}
# From a line whose time is free: a search that begins well within its limits is quicker, and seldom ends in a motion
# that takes half as long again as another one.
FAR = dict.fromkeys(["ipopt.bound_push", "ipopt.bound_frac"], 0.2)
# From multipliers: a point that lies on its bounds stays there, and what is nearly right is not made wrong first.
BEGUN = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-6,
    **dict.fromkeys([f"ipopt.warm_start_{part}" for part in ("bound_push", "bound_frac", "mult_bound_push")], 1e-6),
    **dict.fromkeys([f"ipopt.warm_start_slack_{part}" for part in ("bound_push", "bound_frac")], 1e-6),
}
NOT_FINITE = "IPOPT: Invalid Number Detected"


class TranscribedProgram:
    """The program of an `OptimalControl` on a mesh (N+1,) of fractions of the horizon: z = [nodes row by row, c, T].

    c (np,) are the coordinates of parameters that are optimized.
    """

    def __init__(self, task: OptimalControl, mesh: Array, functions: KnotFunctions):
        self.task, self.mesh, self.functions = task, mesh, functions
        self.nx, self.width = task.dynamics.nx, task.dynamics.nx + task.dynamics.nu
        self.weights = task.scheme.node_weights(mesh)
        self.every = np.arange(len(self.weights))
        self.free = int(task.horizon[0] < task.horizon[1])
        self.first_parameter = self.every.size * self.width  # where in z they are
        limits = zip(task.node_limits(mesh), task.coordinate_limits(), task.horizon, strict=True)
        self.lower, self.upper = (np.concatenate([a.ravel(), c, [time] * self.free]) for a, c, time in limits)
        self.z = ca.MX.sym("z", len(self.lower))
        self.knots = ca.reshape(self.z[: self.first_parameter], self.width, self.every.size)
        self.parameters = self.z[self.first_parameter : self.first_parameter + len(task.coordinates)]
        tails = ca.repmat(self.parameters, 1, self.every.size)
        self.moved = ca.vertcat(self.knots, tails) if task.varied else self.knots
        self.time = self.z[-1] if self.free else ca.MX(task.horizon[0])
        paths = zip(functions.paths, task.problem.kept, strict=True)
        self.paths = [(f, task.nodes_of(constraint, mesh), constraint) for f, constraint in paths]
        couplings = zip(task.couplings, functions.joined, strict=True)
        knots = task.nodes_at(range(task.problem.num_steps + 1), mesh)
        self.coupled = [rows_of(c, function, knots, self.nx, self.width) for c, function in couplings]
        self.slopes = [slopes_of(limit, task, mesh) for limit in task.problem.rate_limits]
        times = task.horizon[0] * task.scheme.node_fractions(mesh)  # of a cost that changes in time, which fixes it
        self.rate = functions.rate.at(times) if isinstance(functions.rate, Timed) else functions.rate
        self.rates, self.costs = functions.dynamics.values(self.moved), self.rate.values(self.knots)
        self.rate_rows, self.cost_rows = functions.dynamics.jacobian(self.moved), self.rate.jacobian(self.knots)
        self._set_links()
        self.horizon_at, self.horizon_unit = len(self.lower) - 1 if self.free else None, 1.0

    @property
    def states_at(self) -> Indices:
        """(N+1, nx) where the states at the knots are in z."""
        return self.every[:: self.task.scheme.nodes, None] * self.width + np.arange(self.nx)

    @property
    def inputs_at(self) -> Indices:
        """(N+1, nu)"""
        return self.every[:: self.task.scheme.nodes, None] * self.width + np.arange(self.nx, self.width)

    @property
    def names(self) -> tuple[str, ...]:
        """(n,) of the variables."""
        names = (*self.task.dynamics.state_names, *self.task.dynamics.input_names)
        others = self.task.problem.parameters.names if self.task.varied else ()
        return (*[f"{name} at node {k}" for k in self.every for name in names], *others, *["horizon"] * self.free)

    def iterates(self, z: Array) -> tuple[Iterate, ...]:
        """The motion at z, for callbacks."""
        problem = self.task.problem
        vector = problem.parameters.at(self.parameter_values(z)) if self.task.varied else problem.parameters
        times = frozen(self.unpack(z)[1] * self.mesh)
        xs, us = frozen(z[self.states_at]), frozen(z[self.inputs_at[:-1]])
        return (Iterate(problem, times, xs, us, vector, by_steps=False),)

    def pack(self, nodes: Array, horizon: float, coordinates: Array | None = None) -> Array:
        """The decision variables of `nodes` (K, nx + nu), `horizon` [s] and `coordinates` (np,), the task's if None."""
        values = self.task.coordinates if coordinates is None else coordinates
        return np.concatenate([nodes.ravel(), values, [horizon] * self.free])

    def parameter_values(self, z: Array) -> Array:
        """The values (np,) of the problem's parameters at the decision variables."""
        moved = self.task.varied
        if moved is None:
            return self.task.parameters
        c = z[self.first_parameter : self.first_parameter + len(self.task.coordinates)]
        return np.clip(moved.coordinates.to_values(c), *self.task.problem.bounds_of_parameters())

    def column(self, node: Any, columns: Any) -> Any:
        """Where in z the entries `columns` of a knot [x, u, c] at `node` are."""
        return np.where(columns < self.width, node * self.width + columns, self.first_parameter + columns - self.width)

    def unpack(self, z: Array) -> tuple[Array, float]:
        """The nodes (K, nx + nu) and the horizon [s] of the decision variables."""
        nodes = z[: self.every.size * self.width].reshape(-1, self.width)
        return nodes, float(z[-1]) if self.free else self.task.horizon[0]

    @cached_property
    def sides(self) -> tuple[Array, Array]:
        """(lower, upper) of g: 0 for the defects, each path constraint's own, node by node, and each coupling's."""
        parts = [(b.lower, b.upper) for b in self._links]
        parts += [(np.tile(c.lower, len(nodes)), np.tile(c.upper, len(nodes))) for _, nodes, c in self.paths]
        parts += [*(c.sides for c in self.coupled), *(c.sides for c in self.slopes), self._linear_sides]
        lower, upper = zip(*parts, strict=True)
        return np.concatenate(lower), np.concatenate(upper)

    @cached_property
    def _slope_weights(self) -> list[Any]:
        """Sparse, of the rates of all nodes or of z."""
        sizes = {True: self.every.size * self.nx, False: self.z.numel()}
        return [sparse(*c.entries, (c.count, sizes[c.of_rates])) for c in self.slopes]

    @cached_property
    def nlp(self) -> dict[str, Any]:
        """x, f and g as CasADi's nlpsol takes them."""
        f = self.time * ca.dot(self.costs, ca.DM(self.weights).T)
        if self.functions.final is not None:
            f += self.functions.final.values(self.knots[:, -1])
        if self.functions.parameters is not None:
            f += self.functions.parameters.values(self.parameters)
        g = [ca.mtimes(self._S, self.z) - self.time * ca.mtimes(self._D, ca.vec(self.rates))]
        g += [ca.vec(f.values(self.knots[:, nodes.tolist()])) for f, nodes, _ in self.paths]
        g += [c.values(self.z) for c in self.coupled]
        for c, weights in zip(self.slopes, self._slope_weights, strict=True):
            g.append(ca.mtimes(weights, ca.vec(self.rates) if c.of_rates else self.z))
            g[-1] += ca.DM(c.by_time) * self.time if self.free else 0
        if self._linear is not None:
            g.append(ca.mtimes(self._linear, self.z))
        return {"x": self.z, "f": f, "g": ca.vertcat(*g)}

    def derivatives(self, exact: bool) -> dict[str, Any]:
        """CasADi Functions by the names of nlpsol's options, "hess_lag" only where `exact`."""
        pace, p, sigma = Pace(), ca.MX.sym("p", 0), ca.MX.sym("sigma")
        multipliers = ca.MX.sym("multipliers", self.nlp["g"].numel())
        pace.go_on()
        functions = {"grad_f": ca.Function("grad_f", [self.z, p], [self.nlp["f"], self._gradient()])}
        pace.go_on()
        functions["jac_g"] = ca.Function("jac_g", [self.z, p], [self.nlp["g"], self._jacobian()])
        if exact:
            pace.go_on()
            hessian = self._hessian(sigma, multipliers)
            pace.go_on()
            functions["hess_lag"] = ca.Function("hess_lag", [self.z, p, sigma, multipliers], [hessian])
        return functions

    def _set_links(self) -> None:
        """The defects and the Bernstein coefficients of bounded states, and those of bounded inputs."""
        scheme, b = self.task.scheme, self.task.bounds
        bounded = np.flatnonzero((np.isfinite(b.x_lower) | np.isfinite(b.x_upper)) & (b.x_lower < b.x_upper))
        defects = _Links(self, 0, scheme.states, scheme.slopes, np.arange(self.nx))
        hull = _Links(self, defects.count, scheme.hull_states, scheme.hull_slopes, bounded)
        hull.set_limits(b.x_lower[bounded], b.x_upper[bounded])
        self._relax_what_is_given(hull)
        self._links, self.num_links = (defects, hull), defects.count + hull.count
        rows, columns, states, slopes, rates = (
            np.concatenate([np.broadcast_to(getattr(link, name), link.rows.shape).ravel() for link in self._links])
            for name in ("rows", "columns", "state", "slope", "rates")
        )
        self._S = sparse(rows, columns, states, (self.num_links, self.z.numel()))
        self._D = sparse(rows, rates, slopes, (self.num_links, self.every.size * self.nx))
        self._linear: Any = None
        self._linear_sides = np.zeros(0), np.zeros(0)
        inputs = np.arange(self.task.dynamics.nu)
        if scheme.input_is_linear:  # 2 u_mid - u_0 - u_1 = 0 in all intervals
            self._add_linear(inputs, (2.0, -1.0, -1.0), np.zeros(len(inputs)), np.zeros(len(inputs)))
        elif scheme.nodes == 2:  # the parabola's inner Bernstein coefficient
            free = (np.isfinite(b.u_lower) | np.isfinite(b.u_upper)) & (b.u_lower < b.u_upper)
            self._add_linear(inputs[free], (2.0, -0.5, -0.5), b.u_lower[free], b.u_upper[free])

    def _add_linear(self, inputs: Indices, weights: tuple[float, float, float], lower: Array, upper: Array) -> None:
        """Rows that keep each interval's weighted sum of the `inputs` at its middle, start and end within limits."""
        if not len(inputs):
            return
        middle = np.arange(1, self.every.size, 2)[:, None] * self.width + self.nx + inputs
        rows = np.arange(middle.size).reshape(middle.shape)
        columns = np.stack([middle, middle - self.width, middle + self.width])
        values = np.array(weights)[:, None, None]
        self._linear = sparse(rows, columns, values, (middle.size, self.z.numel()))
        self._linear_sides = np.tile(lower, len(middle)), np.tile(upper, len(middle))

    def _relax_what_is_given(self, hull: "_Links") -> None:
        """No limit for a coefficient of given numbers alone: nothing that is searched for can keep it."""
        count = self.every.size * self.width
        lower, upper = (side[:count].reshape(-1, self.width) for side in (self.lower, self.upper))
        rows, columns = self.functions.dynamics.jacobian_at
        moved = slice(count, count + len(self.task.coordinates))
        for node in (0, self.every[-1]):
            given = np.append(lower[node] == upper[node], self.lower[moved] == self.upper[moved])
            for position, state in enumerate(hull.each):
                if given[state] and np.all(given[columns[rows == state]]):
                    indices = hull.rows[(hull.node == node) & (hull.state[:, 0] != 0), position] - hull.first
                    hull.lower[indices], hull.upper[indices] = -np.inf, np.inf

    def _gradient(self) -> Any:
        total, last = SparseSum((self.z.numel(), 1)), self.every[-1:]
        b = _Blocks(self.rate.jacobian_at, self.every, self.width)
        total.add(b.column, 0, self.weights[b.node], self.time * self.cost_rows, b.index)
        if self.free:
            total.add(self.z.numel() - 1, 0, self.weights, ca.vec(self.costs), self.every)
        if self.functions.final is not None:
            b = _Blocks(self.functions.final.jacobian_at, last, self.width)
            total.add(b.column, 0, 1.0, self.functions.final.jacobian(self.knots[:, -1]), b.index)
        if self.functions.parameters is not None:
            parameter_cost = self.functions.parameters
            places = self.first_parameter + parameter_cost.jacobian_at[1]
            total.add(places, 0, 1.0, parameter_cost.jacobian(self.parameters), np.arange(len(places)))
        return ca.densify(total.matrix())

    def _jacobian(self) -> Any:
        f, total = self.functions.dynamics, SparseSum((self.nlp["g"].numel(), self.z.numel()))
        rows, columns = f.jacobian_at
        for links in self._links:
            total.add(links.rows, links.columns, links.state, ca.DM(1), 0)
            positions = np.full(self.nx, -1)
            positions[links.each] = np.arange(len(links.each))
            entries = np.flatnonzero(positions[rows] >= 0)
            index = links.node[:, None] * len(rows) + entries
            targets = (
                links.starts[:, None] + positions[rows[entries]],
                self.column(links.node[:, None], columns[entries]),
            )
            total.add(*targets, -links.slope, self.time * self.rate_rows, index)
            if self.free:
                total.add(links.rows, self.z.numel() - 1, -links.slope, ca.vec(self.rates), links.rates)
        first = self.num_links
        for path, nodes, _ in self.paths:
            b = _Blocks(path.jacobian_at, nodes, self.width)
            source = path.jacobian(self.knots[:, nodes.tolist()])
            total.add(first + b.place * path.rows + b.rows, b.column, 1.0, source, b.index)
            first += path.rows * len(nodes)
        for c in self.coupled:
            (rows, columns, index), source = c.jacobian(self.z)
            total.add(first + rows, columns, 1.0, source, index)
            first += c.count
        for slopes in self.slopes:
            self._add_slopes(total, first, slopes)
            first += slopes.count
        if self._linear is not None:
            rows, columns = (np.array(a) for a in self._linear.sparsity().get_triplet())
            total.add(first + rows, columns, np.array(self._linear.nonzeros()), ca.DM(1), 0)
        return total.matrix()

    def _add_slopes(self, total: "SparseSum", first: int, c: SlopeRows) -> None:
        """The Jacobian of the rows of a rate limit, which begin at `first`."""
        rows, places, weights = c.entries
        if self.free:
            total.add(first + np.arange(c.count), self.z.numel() - 1, c.by_time, ca.DM(1), 0)
        if not c.of_rates:
            total.add(first + rows, places, weights, ca.DM(1), 0)
            return
        derivative_rows, columns = self.functions.dynamics.jacobian_at
        nodes, entries = np.divmod(places, self.nx)
        for entry in np.unique(entries):
            here, nonzeros = entries == entry, np.flatnonzero(derivative_rows == entry)
            node = nodes[here][:, None]
            targets = first + rows[here][:, None], self.column(node, columns[nonzeros])
            total.add(*targets, weights[here][:, None], self.rate_rows, node * len(derivative_rows) + nonzeros)

    def pulled(self, multipliers: Any, horizon: Any) -> Any:
        """(K nx,) what the rows' multipliers (m,) weigh the rates of all nodes by; MX or DM."""
        rate_weights = -horizon * ca.mtimes(self._D.T, multipliers[: self.num_links])
        for first, weights in self._of_rates():
            rate_weights += ca.mtimes(weights.T, multipliers[first : first + weights.shape[0]])
        return rate_weights

    def pushed(self, rates: Array, horizon: float) -> Array:
        """(m,) the part of all rows that is linear in the `rates` (K nx,) of all nodes; 0 of the others."""
        values = np.zeros(self.nlp["g"].numel())
        values[: self.num_links] = -horizon * np.asarray(ca.mtimes(self._D, ca.DM(rates))).ravel()
        for first, weights in self._of_rates():
            values[first : first + weights.shape[0]] = np.asarray(ca.mtimes(weights, ca.DM(rates))).ravel()
        return values

    def _of_rates(self) -> Iterator[tuple[int, Any]]:
        """Where the rows of limits of accelerations begin, and the weights of the rates in them."""
        first = (
            self.num_links + sum(f.rows * len(nodes) for f, nodes, _ in self.paths) + sum(c.count for c in self.coupled)
        )
        for c, weights in zip(self.slopes, self._slope_weights, strict=True):
            if c.of_rates:
                yield first, weights
            first += c.count

    def _hessian(self, sigma: Any, multipliers: Any) -> Any:
        """The upper triangle of d^2 (sigma f + multipliers' g) / dz^2."""
        f, rate, total = self.functions.dynamics, self.rate, SparseSum((self.z.numel(), self.z.numel()))
        nu = ca.mtimes(self._D.T, multipliers[: self.num_links])
        weights = ca.DM(self.weights).T
        terms: list[tuple[Any, Indices, Any]] = [
            (f, self.every, ca.reshape(self.pulled(multipliers, self.time), self.nx, self.every.size)),
            (rate, self.every, sigma * self.time * weights),
        ]
        if self.functions.final is not None:
            terms.append((self.functions.final, self.every[-1:], sigma))
        first = self.num_links
        for path, nodes, _ in self.paths:
            last = first + path.rows * len(nodes)
            terms.append((path, nodes, ca.reshape(multipliers[first:last], path.rows, len(nodes))))
            first = last
        for c in self.coupled:
            (rows, columns, index), source = c.hessian(self.z, multipliers[first : first + c.count])
            total.add(rows, columns, 1.0, source, index)
            first += c.count
        for function, nodes, seeds in terms:
            b = _Blocks(function.hessian_at, nodes, self.width)
            knots = self.moved if function is f else self.knots
            source = function.hessian(knots[:, nodes.tolist()], seeds)
            columns = function.hessian_at[1]
            total.add(self.column(b.node, b.rows), self.column(b.node, columns), 1.0, source, b.index)
        if self.functions.parameters is not None:
            parameter_cost: Any = self.functions.parameters
            rows, columns = (self.first_parameter + places for places in parameter_cost.hessian_at)
            total.add(rows, columns, 1.0, parameter_cost.hessian(self.parameters, sigma), np.arange(len(rows)))
        if self.free:
            b = _Blocks(f.jacobian_at, self.every, self.width)
            source = self.rate_rows * nu[(b.node * self.nx + b.rows).ravel().tolist()]
            total.add(self.column(b.node, f.jacobian_at[1]), self.z.numel() - 1, -1.0, source, b.index)
            b = _Blocks(rate.jacobian_at, self.every, self.width)
            source = sigma * self.cost_rows
            total.add(b.column, self.z.numel() - 1, self.weights[b.node], source, b.index)
        return total.matrix()


class Program(Protocol):
    """What IPOPT solves; see `TranscribedProgram`."""

    z: Any
    lower: Array
    upper: Array
    functions: Any

    @property
    def sides(self) -> tuple[Array, Array]: ...

    @property
    def nlp(self) -> dict[str, Any]: ...

    def derivatives(self, exact: bool) -> dict[str, Any]: ...


def solve_ipopt(
    program: Program,
    guess: Array,
    limits: Limits,
    report: Report | None,
    *,
    exact: bool,
    begun: Multipliers | None = None,
    more: dict[str, Any] | None = None,
    motions: Callable[[Array], tuple[Iterate, ...]] = lambda z: (),
) -> NlpResult:
    """Solve `program` from `guess` (n,), with its `exact` Hessian or IPOPT's limited-memory one.

    With multipliers `begun` the guess is taken for nearly optimal. `more` are options of nlpsol.

    `report` gets a line of progress a few times a second, with what `motions` makes of the iterate. Ctrl-C ends the
    solve with the best iterate so far. An error that a function of the user's raised is raised again, but that of a
    simulation or gradient is told.
    """
    options = OPTIONS | (BEGUN if begun else {}) | (more or {})
    options |= {
        "ipopt.tol": limits.tolerance,
        "ipopt.constr_viol_tol": limits.tolerance,
        "ipopt.max_iter": limits.max_iterations,
    }
    if not exact:
        options |= {"ipopt.hessian_approximation": "limited-memory", "pass_nonlinear_variables": False}
    with noted_interrupts() as interrupted:
        watch = Watch(limits, interrupted)
        callback = _IterateCallback(program, watch, report, motions)
        try:
            with until_set(interrupted):
                options |= program.derivatives(exact) | {"iteration_callback": callback}
        except StoppedError as stopped:
            return NlpResult(guess, Outcome.INTERRUPTED, f"stopped: {stopped}", ())
        solver = ca.nlpsol("solver", "ipopt", program.nlp, options)
        lower, upper = program.sides
        known = {} if begun is None else {"lam_x0": begun.variables, "lam_g0": begun.rows}
        with until_set(interrupted):
            solution = solver(x0=guess, lbx=program.lower, ubx=program.upper, lbg=lower, ubg=upper, **known)
        stats = solver.stats()
    columns = [stats.get("iterations", {}).get(name, ()) for name in ("obj", "inf_pr", "inf_du", "alpha_pr")]
    table = tuple(Iteration(i, *map(float, row)) for i, row in enumerate(zip(*columns, strict=True)))
    error = callback.error or program.functions.error
    if error is not None:
        if isinstance(error, TimeIsUpError):
            ended = Outcome.INTERRUPTED if interrupted.is_set() else Outcome.TIME_LIMIT
            return NlpResult(watch.best_of(guess), ended, f"stopped: {error}", table)
        if not isinstance(error, DrakeDiffError):
            raise error
        outcome = Outcome.NO_GRADIENT if isinstance(error, GradientError) else Outcome.FAILED
        outcome = Outcome.DIVERGED if isinstance(error, SimulationError) else outcome
        return NlpResult(watch.best_of(guess), outcome, f"{type(error).__name__}: {error}", table)
    if watch.stopped_by is not None:
        return NlpResult(watch.best_of(guess), watch.stopped_by, f"stopped: {watch.stopped_by.value}", table)
    words = str(stats["return_status"])
    outcome, left = OUTCOMES.get(words, Outcome.FAILED), _stationarity(program, options, solution)
    z = np.asarray(solution["x"]).ravel()
    multipliers = Multipliers(*(np.asarray(solution[name]).ravel() for name in ("lam_x", "lam_g")))
    message = f"IPOPT: {words.replace('_', ' ')}"
    return NlpResult(z, outcome, message, table, stationarity=left, multipliers=multipliers)


def _stationarity(program: Program, derivatives: Any, solution: Any) -> float:
    """What IPOPT's multipliers leave of the Lagrangian's gradient, those of what does not hold the plan left out."""
    z, slope = solution["x"], ca.DM(derivatives["grad_f"](solution["x"], [])[1])
    rows, jacobian = derivatives["jac_g"](z, [])
    of_rows, of_variables = (
        _holding(np.asarray(multiplier).ravel(), np.asarray(value).ravel(), *sides)
        for multiplier, value, sides in (
            (solution["lam_g"], rows, program.sides),
            (solution["lam_x"], z, (program.lower, program.upper)),
        )
    )
    left = slope + ca.mtimes(jacobian.T, ca.DM(of_rows)) + ca.DM(of_variables)
    terms = ca.fabs(slope) + ca.mtimes(ca.fabs(jacobian.T), ca.DM(abs(of_rows))) + ca.DM(abs(of_variables))
    gradient, largest = (float(np.max(np.abs(np.asarray(vector)), initial=0.0)) for vector in (left, terms))
    return gradient / largest if largest > 0 else 0.0


def _holding(multipliers: Array, values: Array, lower: Array, upper: Array) -> Array:
    """The multipliers (m,) of what lies on the side that they push from, 0 of all others."""
    on_lower, on_upper = values <= lower + FEASIBILITY_TOLERANCE, values >= upper - FEASIBILITY_TOLERANCE
    return np.where(on_upper, np.maximum(multipliers, 0.0), 0.0) + np.where(on_lower, np.minimum(multipliers, 0.0), 0.0)


class _IterateCallback(ca.Callback):  # type: ignore[misc]
    """Called by the solver at every iterate: reports, keeps the best, says when to stop."""

    def __init__(
        self,
        program: Program,
        watch: Watch,
        report: Report | None,
        motions: Callable[[Array], tuple[Iterate, ...]],
    ):
        ca.Callback.__init__(self)
        self.program, self.watch, self.report, self.motions = program, watch, report, motions
        size = len(program.lower)
        self.sizes = {"x": size, "f": 1, "g": program.nlp["g"].numel(), "lam_x": size}
        self.sizes |= {"lam_g": self.sizes["g"], "lam_p": 0}
        self.iterates, self.called = 0, now()
        self.error: Exception | None = None
        self.construct("callback", {})

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.sizes[ca.nlpsol_out(i)], 1)

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        try:
            x, f, g = (np.frombuffer(a, float) for a in arguments[:3])
            p = self.program
            sides = (p.lower - x, x - p.upper, p.sides[0] - g, g - p.sides[1])
            violation = max(float(np.max(side, initial=0.0)) for side in sides)
            self.watch.offer(x, float(f[0]), violation)
            due = self.watch.look_up()
            if self.report:
                row = Iteration(self.iterates, float(f[0]), violation, math.nan, math.nan)
                self.report.row(row, lambda: self.motions(x), printed=due)
            self.iterates += 1
            before, self.called = self.called, now()
            if self.iterates > 2:  # the next one takes as long as the last, but for the first, which begins the solver
                check_time(ahead=self.called - before)
        except Exception as error:  # of `report`; must not go through C++, the solve raises it
            self.error = error
        stop = self.watch.stopped_by is not None or self.error is not None or self.program.functions.error is not None
        np.frombuffer(results[0], float)[:] = float(stop)
        return 0


class _Links:
    """Rows states @ x - T h slopes @ f of each interval and row of a tableau, for the states `each`.

    One entry of node, state and slope for each interval, row and node of it; `starts` are where their rows begin.
    """

    def __init__(self, program: TranscribedProgram, first: int, states: Array, slopes: Array, coordinates: Indices):
        lengths, (groups, nodes) = np.diff(program.mesh), states.shape
        k, i, j = (a.ravel() for a in np.indices((len(lengths), groups, nodes)))
        self.first, self.each, self.count = first, coordinates, len(lengths) * groups * len(coordinates)
        self.node = k * program.task.scheme.nodes + j
        self.state, self.slope = states[i, j][:, None], (lengths[k] * slopes[i, j])[:, None]
        self.starts = first + (k * groups + i) * len(coordinates)
        self.rows = self.starts[:, None] + np.arange(len(coordinates))
        self.columns, self.rates = (self.node[:, None] * size + coordinates for size in (program.width, program.nx))
        self.lower, self.upper = np.zeros(self.count), np.zeros(self.count)

    def set_limits(self, lower: Array, upper: Array) -> None:
        """The same limits of the states `each` in all rows."""
        times = self.count // max(len(self.each), 1)
        self.lower, self.upper = np.tile(lower, times), np.tile(upper, times)


class _Blocks:
    """The nonzeros at `pattern` (rows, columns) of one block a node, as (nodes, nonzeros); `column` is of all z."""

    def __init__(self, pattern: tuple[Indices, Indices], nodes: Indices, width: int):
        self.rows, columns = (np.tile(a, (len(nodes), 1)) for a in pattern)
        self.place = np.repeat(np.arange(len(nodes))[:, None], len(pattern[0]), axis=1)
        self.node = np.repeat(nodes[:, None], len(pattern[0]), axis=1)
        self.column = self.node * width + columns
        self.index = np.arange(self.rows.size).reshape(self.rows.shape)

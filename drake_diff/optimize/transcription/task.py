"""The optimal control problem of a transcription, and the collocation schemes as tableaus.

Over an interval of length h with nodes 0 ... s (ends and, for Hermite-Simpson, the middle) the equations are

    sum_j states[i, j] x_j - h sum_j slopes[i, j] f(x_j, u_j) = 0,    cost = h sum_j weights[j] L(x_j, u_j),

Between nodes, x' is the polynomial through f_j and u the polynomial through u_j (Betts, "Practical Methods for Optimal
Control", ch. 4; Kelly, SIAM Review 59(4), 2017). Hermite-Simpson is in separated form: midpoint states are variables
with bounds. The orders are 2 and 4. "drake" is the transcription of Drake's DirectCollocation: Hermite-Simpson whose
midpoint input is the mean of its neighbours, and the cost by the trapezoid rule, which reduces the order of the optimum
to 2.

A polynomial lies within the range of its Bernstein coefficients, so that bounds on these bound the whole motion. The
inner two of a cubic are x_0 + h f_0 / 3 and x_1 - h f_1 / 3. The inner one of a parabola is x_0 + h f_0 / 2 or, from
its values, 2 u_mid - (u_0 + u_1) / 2. Bounds on nodes alone allow an excess of 1/8 between them.
"""

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import Refusal
from drake_diff.model.parameters import ParameterCoordinates
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.cost import (
    ConstantCost,
    CostToGo,
    QuadraticCost,
    SumOfCosts,
    TimedCost,
    TrackingCost,
    differentiate_cost,
)
from drake_diff.optimize.problem.coupling import BoundCoupling
from drake_diff.optimize.problem.dynamics import PROBED, DiscreteMap, MovedDynamics, Pointwise
from drake_diff.optimize.problem.goals import WithGoals
from drake_diff.optimize.problem.problem import Problem

AtPlaces = Callable[[Array, Array], Array]  # knots (S, nx + nu) and times (S,) [s] -> (S, r)


@dataclass(frozen=True, eq=False)
class Scheme:
    """A tableau: rows of `states` and `slopes` (r, s+1), and the `basis` (s+1, d+1) of polynomials in tau, 0 to 1.

    The inner Bernstein coefficients of a state are hull_states @ x - h hull_slopes @ f, each (p, s+1).
    """

    order: int
    states: Array
    slopes: Array
    basis: Array
    hull_states: Array
    hull_slopes: Array
    input_is_linear: bool = False

    @property
    def nodes(self) -> int:
        """The number s of an interval's nodes without the last, which is the first of the next interval."""
        return len(self.basis) - 1

    @cached_property
    def weights(self) -> Array:
        """The quadrature weights (s+1,) of an interval of length 1."""
        return np.array([0.5, 0, 0.5]) if self.input_is_linear else self.integrated(np.ones(1))[0]

    @cached_property
    def end_slopes(self) -> Array:
        """The weights (e, s+1) of nodes in the slope with respect to tau at an interval's ends, one for a line."""
        tau = np.array([0.0, 1.0] if self.basis.shape[1] > 2 else [0.0])
        powers = np.arange(1, self.basis.shape[1])
        return np.asarray(tau[:, None] ** (powers - 1) * powers @ self.basis[:, 1:].T)

    @cached_property
    def bernstein(self) -> Array:
        """The weights (s+1, s+1) of nodes in the Bernstein coefficients of their polynomial."""
        count = self.basis.shape[1]
        rows = [[comb(j, i) / comb(count - 1, i) for i in range(count)] for j in range(count)]
        return np.asarray(np.array(rows) @ self.basis.T)

    def at(self, tau: Array) -> Array:
        """Return the weights (S, s+1) of the nodes' values at `tau` (S,) within an interval."""
        return np.asarray(tau[:, None] ** np.arange(self.basis.shape[1]) @ self.basis.T)

    def integrated(self, tau: Array) -> Array:
        """Return the integrals (S, s+1) of `at` from 0 to `tau` (S,)."""
        powers = np.arange(1, self.basis.shape[1] + 1)
        return np.asarray(tau[:, None] ** powers / powers @ self.basis.T)

    def node_fractions(self, mesh: Array) -> Array:
        """Return the places (K,) of the nodes of `mesh` (N+1,), both from 0 to 1, with K = s N + 1."""
        inner = np.arange(self.nodes) / self.nodes
        return np.append((mesh[:-1, None] + np.diff(mesh)[:, None] * inner).ravel(), 1.0)

    def node_weights(self, mesh: Array) -> Array:
        """Return the weights (K,) of the nodes in the integral over a horizon of 1."""
        weights = np.zeros(self.nodes * (len(mesh) - 1) + 1)
        for k, h in enumerate(np.diff(mesh)):
            weights[self.nodes * k : self.nodes * (k + 1) + 1] += h * self.weights
        return weights

    def per_interval(self, nodes: Array) -> Array:
        """Return the nodes (K, ...) of each interval (N, s+1, ...), of which adjacent intervals share one."""
        starts = np.arange(0, len(nodes) - 1, self.nodes)
        return np.asarray(nodes[starts[:, None] + np.arange(self.nodes + 1)])

    def interval_defects(self, h: Array, xs: Array, fs: Array) -> Array:
        """Return residuals (N, r, nx) in states' units from lengths h (N,) [s], states xs and rates fs (N, s+1, nx)."""
        return np.asarray(self.states @ xs - h[:, None, None] * (self.slopes @ fs))


_SIMPSON = (
    np.array([[-1.0, 0, 1], [-0.5, 1, -0.5]]),
    np.array([[1.0, 4, 1], [0.75, 0, -0.75]]) / 6,
    np.array([[1.0, -3, 2], [0, 4, -4], [0, -1, 2]]),
    np.array([[1.0, 0, 0], [0, 0, 1]]),
    np.array([[-1.0, 0, 0], [0, 0, 1]]) / 3,
)
_TRAPEZOID = (
    np.array([[-1.0, 1]]),
    np.array([[0.5, 0.5]]),
    np.array([[1.0, -1], [0, 1]]),
    np.array([[1.0, 0]]),
    np.array([[-0.5, 0]]),
)
_MAP = np.array([[0.0, 1]]), np.array([[1.0, 0]]), np.array([[1.0], [0]]), np.zeros((0, 2)), np.zeros((0, 2))
MAP = "map"  # for a DiscreteMap: x_1 - f(x_0, u_0) = 0 with intervals of length 1 and constant inputs
SCHEMES = {
    "hermite_simpson": Scheme(4, *_SIMPSON),
    "trapezoid": Scheme(2, *_TRAPEZOID),
    "drake": Scheme(2, *_SIMPSON, input_is_linear=True),
    MAP: Scheme(1, *_MAP),
}
INSIDE = 2e-8  # of a bound of parameters: twice IPOPT's relaxation, which must not make a mass negative
DEFAULT_SCHEME = "hermite_simpson"


def default_scheme(problem: Any) -> str:
    """Return the default scheme."""
    return MAP if problem.is_map else DEFAULT_SCHEME


class KnownRate:
    """A ConstantCost or a QuadraticCost at many knots, with the methods of `Pointwise`."""

    def __init__(self, f: ConstantCost | QuadraticCost, nx: int):
        self.f, self.nx = f, nx

    def values(self, knots: Array) -> Array:
        """Return the values (K, 1) at `knots` (K, nx + nu)."""
        return np.asarray(self.f(knots[:, : self.nx], knots[:, self.nx :]))[:, None]

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """Return the values (K, 1) and the gradients (K, 1, nx + nu)."""
        derivatives = [differentiate_cost(self.f, k[: self.nx], k[self.nx :]) for k in knots]
        return np.array([[v] for v, _, _ in derivatives]), np.array([[np.concatenate(g)] for _, *g in derivatives])


class TimedRate:
    """A TimedCost at many knots with known times."""

    def __init__(self, cost: TimedCost, nx: int, nu: int, probe: Array):
        self.cost, self.width = cost, nx + nu
        self.probe = self.with_known(probe, np.linspace(0.0, 1.0, len(probe)))
        self.f = lambda x, z: cost.of(x, z[:nu], z[nu:])
        self.inner = Pointwise("running_cost", self.f, nx, (), self.probe)

    def with_known(self, knots: Array, times: Array) -> Array:
        """Return `knots` (K, nx + nu) with the cost's parameters at `times` (K,) [s], (K, nx + nu + p)."""
        return np.hstack([knots, self.cost.known_at(times)])

    def values(self, knots: Array) -> Array:
        """Return the values (K, 1) at knots (K, nx + nu + p)."""
        return self.inner.values(knots)

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """Return the values (K, 1) and the gradients (K, 1, nx + nu) with respect to state and input only."""
        values, rows = self.inner.linearize(knots)
        return values, rows[:, :, : self.width]


def values_of_many(form: Any, points: Array) -> Array:
    """Return a function's values (S, r) at very many points, by an expression if it has one and takes no columns."""
    if not isinstance(form, Pointwise) or form.takes_columns:
        return np.asarray(form.values(points))
    from drake_diff.optimize.knots import Traced, trace  # loads CasADi

    probe = points[:: max(1, len(points) // PROBED)]
    expression = trace(form.f, form.nx, probe, form.values(probe))
    return np.asarray(form.values(points) if isinstance(expression, Refusal) else Traced(expression).values(points))


def constraint_form(c: Constraint, nx: int, probe: Array) -> Pointwise:
    """Return a constraint's function of knots [x, u], checked at `probe` (3, nx + nu), or raise GradientError."""
    function: Any = c.function if c.takes_input else lambda x, u: c.function(x)
    size = len(c.lower)
    return Pointwise(
        f"constraint {c.label}",
        lambda x, u: _as_array(function(x, u)).reshape(size, *x.shape[1:]),
        nx,
        (size,),
        probe,
    )


def _as_array(result: Any) -> Any:
    return result if hasattr(result, "reshape") else np.asarray(result)  # also an array of JAX


def user_rate(problem: Problem, probe: Array) -> AtPlaces | None:
    """Return `OptimalControl.user_rate`. `probe` (3, nx + nu) are knots to check functions at."""
    parts = [_tracking(cost, problem.nx) for cost in _parts_of(problem.total_running_cost) if _is_table(cost)]
    parts += [cost.values_of_many for cost in user_costs(problem, probe)]
    return None if not parts else lambda knots, times: np.asarray(sum(term(knots, times) for term in parts))


def _is_table(cost: Any) -> bool:
    return isinstance(cost, TrackingCost)


def _tracking(cost: TrackingCost, nx: int) -> AtPlaces:
    return lambda knots, times: cost.along(times)(knots[:, :nx], knots[:, nx:])[:, None]


@dataclass(frozen=True, eq=False)
class UserCost:
    """A user's function that is a part of the "running" or "final" cost, of knots [x, u] and times [s]."""

    name: str
    form: Pointwise
    points: Callable[[Array, Array], Array]  # the argument of `form` from knots and times

    def values(self, knots: Array, times: Array) -> Array:
        """Return the values (K,) by calls of the function."""
        return self.form.values(self.points(knots, times))[:, 0]

    def values_of_many(self, knots: Array, times: Array) -> Array:
        """Return the values (K, 1) by `values_of_many`."""
        return values_of_many(self.form, self.points(knots, times))


def user_costs(problem: Problem, probe: Array, *, final: bool = False) -> list[UserCost]:
    """Return the user's functions in the running cost and, if `final`, in the final cost."""
    nx, nu, costs = problem.nx, problem.nu, list[UserCost]()
    for cost in _parts_of(problem.total_running_cost):
        if isinstance(cost, TimedCost) and not _is_table(cost):
            timed = TimedRate(cost, nx, nu, probe)
            costs.append(UserCost("running cost", timed.inner, timed.with_known))
        elif not _is_table(cost):
            costs.append(
                UserCost("running cost", Pointwise("running_cost", cost, nx, (), probe), lambda knots, _: knots)
            )
    for cost in _parts_of(problem.total_final_cost) if final else ():
        form = Pointwise("final_cost", _of_state(cost), nx, (), probe)
        costs.append(UserCost("final cost", form, lambda knots, _: knots))
    return costs


def _of_state(cost: Any) -> Callable[[Any, Any], Any]:
    return lambda x, u: cost(x)


def _parts_of(cost: Any) -> list[Any]:
    """Return the terms of a running cost whose form is unknown."""
    if isinstance(cost, SumOfCosts):
        return [leaf for term in cost.costs for leaf in _parts_of(term)]
    if isinstance(cost, WithGoals):
        return _parts_of(cost.own)
    return [] if cost is None or isinstance(cost, (ConstantCost, CostToGo, QuadraticCost)) else [cost]


class OptimalControl:
    """The optimal control problem of `problem` in a scheme. Raises ModelError if its model has no continuous form.

    `dynamics` have the parameters' own values. If these are optimized, a program uses `varied`, the dynamics at knots
    [x, u, c] with c (np,) the parameters' coordinates, and `parameter_cost` is a cost of knots [c].

    Raises InputError or GradientError if a cost is not a differentiable function.
    """

    def __init__(self, problem: Problem, scheme: str):
        self.problem, self.scheme = problem, SCHEMES[scheme]
        self.is_map = scheme == MAP
        self.dynamics, self.bounds = problem.dynamics, problem.bounds
        if problem.has_model and problem.model.file_facts.held_points and problem.initial_state_mask.any():
            form: Any = self.dynamics.form  # a FixedContactPlant
            free = [problem.initial_state_mask[s].any() for s in np.split(np.arange(problem.nx), [problem.model.nq])]
            # [m, m/s] equations would have dependent gradients if some positions are given
            closed = np.repeat(np.where(free, 1e-7, np.inf), len(form.rows))
            start = Constraint(form.closing, -closed, closed, knots=0, name="closed loops")
            self.problem = replace(problem, constraints=(*problem.constraints, start))
        self.horizon: tuple[float, float] = problem.horizon or (problem.start_horizon,) * 2  # (lower, upper) [s]
        self.varied: MovedDynamics | None = None
        self.parameter_cost: Pointwise | None = None
        if problem.optimizes_parameters:
            self.varied = MovedDynamics(self.dynamics, ParameterCoordinates(problem.parameters))
            of_values = problem.parameter_cost
            if of_values is not None:
                probe = self.varied.probe()[:, self.varied.width :]
                to_values, count = self.varied.coordinates.to_values, probe.shape[1]
                self.parameter_cost = Pointwise(
                    "parameter_cost", lambda c, _: of_values(to_values(c)), count, (), probe
                )
        running, cost, nx = problem.total_running_cost, problem.total_final_cost, self.dynamics.nx
        running = ConstantCost(0.0) if running is None else running
        self.rate: KnownRate | Pointwise | TimedRate
        if isinstance(running, TimedCost):
            self.rate = TimedRate(running, nx, self.dynamics.nu, self.dynamics.probe())
        elif isinstance(running, (ConstantCost, QuadraticCost)):
            self.rate = KnownRate(running, nx)
        else:
            self.rate = Pointwise("running_cost", running, nx, (), self.dynamics.probe())
        self.final: Pointwise | None = None  # of knots [x, u], independent of the inputs
        if cost is not None:
            self.final = Pointwise("final_cost", lambda x, u: cost(x), nx, (), self.dynamics.probe())

    def moved(self, knots: Array, k: Indices) -> Array:
        """Return rates, or a map's states, (K, nx) at `knots` (K, nx + nu) in the intervals `k` (K,)."""
        dynamics = self.dynamics
        return dynamics.values(knots, k) if isinstance(dynamics, DiscreteMap) else dynamics.values(knots)

    def linearized(self, knots: Array, k: Indices) -> Array:
        """Return the Jacobians (K, nx, nx + nu) of `moved`."""
        dynamics = self.dynamics
        return (dynamics.linearize(knots, k) if isinstance(dynamics, DiscreteMap) else dynamics.linearize(knots))[1]

    def interval_of(self, count: int) -> Indices:
        """Return the interval (K,) that each of `count` nodes starts or lies in, and the last one for the last node."""
        return np.minimum(np.arange(count) // self.scheme.nodes, (count - 1) // self.scheme.nodes - 1)

    def within(self, nodes: Array) -> Array:
        """Clip the inputs of `nodes` (K, nx + nu) to their bounds."""
        nodes[:, self.dynamics.nx :] = np.clip(nodes[:, self.dynamics.nx :], self.bounds.u_lower, self.bounds.u_upper)
        return nodes

    @property
    def parameters(self) -> Array:
        """The values (np,) of the problem's parameters in `dynamics`."""
        return self.dynamics.parameters.values

    def at(self, values: Array) -> "OptimalControl":
        """Return the same task with the parameter values `values` (np,)."""
        task = copy.copy(self)
        task.dynamics = self.dynamics.at(values)
        return task

    @property
    def coordinates(self) -> Array:
        """The coordinates (np,) of `parameters` if these are optimized, else (0,)."""
        return np.zeros(0) if self.varied is None else self.varied.coordinates.from_values(self.parameters)

    def coordinate_limits(self) -> tuple[Array, Array]:
        """Return the bounds (lower, upper) of `coordinates`."""
        if self.varied is None:
            return np.zeros(0), np.zeros(0)
        lower, upper = (self.varied.coordinates.from_values(side) for side in self.problem.bounds_of_parameters())
        inside = [INSIDE * np.maximum(1.0, np.where(np.isfinite(side), np.abs(side), 1.0)) for side in (lower, upper)]
        lower_in, upper_in = lower + inside[0], upper - inside[1]
        apart = lower_in < upper_in
        return np.where(apart, lower_in, lower), np.where(apart, upper_in, upper)

    @property
    def is_timed(self) -> bool:
        """Whether the running cost depends on time."""
        return isinstance(self.rate, TimedRate)

    @cached_property
    def user_dynamics(self) -> AtPlaces | None:
        """The rates (S, nx) at knots (S, nx + nu) and times (S,) [s], or None for equations without sudden changes.

        A model's own equations have none, unless systems of its diagram exert forces.
        """
        form = self.dynamics.form
        if self.is_map or (not isinstance(form, Pointwise) and not getattr(form, "may_jump", True)):
            return None
        return lambda knots, times: values_of_many(form, self.dynamics.whole(knots))

    @cached_property
    def user_rate(self) -> AtPlaces | None:
        """The part (S, 1) of the running cost from users' functions and tables, or None if there are none."""
        return None if self.is_map else user_rate(self.problem, self.dynamics.probe())

    def rates(self, knots: Array, times: Array) -> Array:
        """Return the running cost (K,) at `knots` (K, nx + nu) and `times` (K,) [s]."""
        with_known = self.rate.with_known(knots, times) if isinstance(self.rate, TimedRate) else knots
        return self.rate.values(with_known)[:, 0]

    @cached_property
    def couplings(self) -> tuple[BoundCoupling, ...]:
        """The problem's couplings on its knots."""
        return self.problem.coupled(input_at_end=not self.is_map)

    def nodes_of(self, constraint: Constraint, mesh: Array) -> Indices:
        """Return the nodes of `mesh` (N+1,) with `constraint`: its knots, or all nodes without a given first one."""
        knots = self.problem.knots_of(constraint, input_at_end=not self.is_map)
        if self.is_map:
            return np.array(knots)
        if constraint.knots is None:
            return np.arange(knots[0], self.scheme.nodes * (len(mesh) - 1) + 1)
        nodes = self.nodes_at(knots, mesh)
        return np.arange(nodes[0], nodes[-1] + 1) if constraint.whole else nodes

    def node_limits(self, mesh: Array) -> tuple[Array, Array]:
        """Return the bounds (lower, upper) of the nodes, (K, nx + nu) each, equal for a given end or waypoint."""
        b, nx, count = self.bounds, self.dynamics.nx, len(self.scheme.node_fractions(mesh))
        sides = [np.tile(np.concatenate(s), (count, 1)) for s in ((b.x_lower, b.u_lower), (b.x_upper, b.u_upper))]
        if self.scheme.input_is_linear:  # Drake bounds only knots
            sides[0][1::2], sides[1][1::2] = -np.inf, np.inf
        if self.is_map:  # no input after the last step
            sides[0][-1, nx:] = sides[1][-1, nx:] = np.clip(0.0, b.u_lower, b.u_upper)
        knots = self.nodes_at(range(self.problem.num_steps + 1), mesh)
        for side, states in zip(sides, self.problem.state_limits(), strict=True):
            side[knots, :nx] = states
        return sides[0], sides[1]

    def nodes_at(self, knots: Iterable[int], mesh: Array) -> Indices:
        """Return the nodes of the problem's own `knots`, which remain knots of a refined mesh."""
        fractions = np.linspace(0, 1, self.problem.num_steps + 1)[list(knots)]
        return self.scheme.nodes * np.argmin(np.abs(mesh[None] - fractions[:, None]), axis=1)

"""What a transcription solves, and the collocation schemes as tableaus.

Over an interval of length h with nodes 0 ... s (ends and, for Hermite-Simpson, the middle) they ask for

    sum_j states[i, j] x_j - h sum_j slopes[i, j] f(x_j, u_j) = 0,    cost = h sum_j weights[j] L(x_j, u_j),

and their motion between nodes is x' the polynomial through f_j, u the polynomial through u_j (Betts, "Practical
Methods for Optimal Control", ch. 4; Kelly, SIAM Review 59(4), 2017). Hermite-Simpson is in separated form: midpoint
states are variables, so that bounds hold there too. Order: 2 and 4. "drake" is what Drake's DirectCollocation
transcribes: Hermite-Simpson with the mean of its neighbours for the midpoint's input, and the cost by the trapezoid
rule, which makes the optimum of order 2.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.cost import ConstantCost, QuadraticCost, differentiate_cost
from drake_diff.optimize.problem.dynamics import Dynamics, Pointwise
from drake_diff.optimize.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Scheme:
    """A tableau: rows of `states` and `slopes` (r, s+1), and the `basis` (s+1, d+1): polynomials in tau, 0 to 1."""

    order: int
    states: Array
    slopes: Array
    basis: Array
    input_is_linear: bool = False

    @property
    def nodes(self) -> int:
        """s: nodes of an interval but the last, which is the next one's first."""
        return len(self.basis) - 1

    @cached_property
    def weights(self) -> Array:
        """(s+1,) the quadrature of an interval of length 1."""
        return np.array([0.5, 0, 0.5]) if self.input_is_linear else self.integrated(np.ones(1))[0]

    def at(self, tau: Array) -> Array:
        """(S, s+1) the weight of each node's value at `tau` (S,) within an interval."""
        return np.asarray(tau[:, None] ** np.arange(self.basis.shape[1]) @ self.basis.T)

    def integrated(self, tau: Array) -> Array:
        """(S, s+1) the integrals of `at` from 0 to `tau` (S,)."""
        powers = np.arange(1, self.basis.shape[1] + 1)
        return np.asarray(tau[:, None] ** powers / powers @ self.basis.T)

    def node_fractions(self, mesh: Array) -> Array:
        """(K,) where the nodes of `mesh` (N+1,) lie, both from 0 to 1; K = s N + 1."""
        inner = np.arange(self.nodes) / self.nodes
        return np.append((mesh[:-1, None] + np.diff(mesh)[:, None] * inner).ravel(), 1.0)

    def node_weights(self, mesh: Array) -> Array:
        """(K,) the weight of each node in the integral over a horizon of 1."""
        weights = np.zeros(self.nodes * (len(mesh) - 1) + 1)
        for k, h in enumerate(np.diff(mesh)):
            weights[self.nodes * k : self.nodes * (k + 1) + 1] += h * self.weights
        return weights

    def per_interval(self, nodes: Array) -> Array:
        """(N, s+1, ...): the nodes (K, ...) of each interval; neighbours share one."""
        starts = np.arange(0, len(nodes) - 1, self.nodes)
        return np.asarray(nodes[starts[:, None] + np.arange(self.nodes + 1)])

    def interval_defects(self, h: Array, xs: Array, fs: Array) -> Array:
        """(N, r, nx) from lengths h (N,) [s], states xs and rates fs (N, s+1, nx); in the state's units."""
        return np.asarray(self.states @ xs - h[:, None, None] * (self.slopes @ fs))


_SIMPSON = (
    np.array([[-1.0, 0, 1], [-0.5, 1, -0.5]]),
    np.array([[1.0, 4, 1], [0.75, 0, -0.75]]) / 6,
    np.array([[1.0, -3, 2], [0, 4, -4], [0, -1, 2]]),
)
SCHEMES = {
    "hermite_simpson": Scheme(4, *_SIMPSON),
    "trapezoid": Scheme(2, np.array([[-1.0, 1]]), np.array([[0.5, 0.5]]), np.array([[1.0, -1], [0, 1]])),
    "drake": Scheme(2, *_SIMPSON, input_is_linear=True),
}
DEFAULT_SCHEME = "hermite_simpson"


class RunningRate:
    """A running cost at many knots: none, a ConstantCost, a QuadraticCost, or a function (x, u) -> scalar."""

    def __init__(self, cost: Any, dynamics: Dynamics):
        self.cost, self.nx = ConstantCost(0.0) if cost is None else cost, dynamics.nx
        self._at: Pointwise | None = None
        if not isinstance(self.cost, (ConstantCost, QuadraticCost)):
            self._at = Pointwise("running_cost", cost, self.nx, (), dynamics.probe())

    def __call__(self, x: Any, u: Any) -> Any:
        """The rate at x (nx,), u (nu,): floats or what else goes through the cost."""
        return self.cost(x, u)

    def values(self, knots: Array) -> Array:
        """(K,) at `knots` (K, nx + nu)."""
        if self._at is not None:
            return self._at.values(knots)[:, 0]
        return np.asarray(self.cost.along(knots[:, : self.nx], knots[:, self.nx :]))

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """(K,) and the gradients (K, nx + nu)."""
        if self._at is not None:
            values, rows = self._at.linearize(knots)
            return values[:, 0], rows[:, 0]
        found = [differentiate_cost(self.cost, k[: self.nx], k[self.nx :]) for k in knots]
        return np.array([v for v, _, _ in found]), np.array([np.concatenate(g) for _, *g in found])


class OptimalControl:
    """What `problem` asks of a collocation scheme; ModelError where its model has no continuous form.

    Raises InputError or GradientError where a cost is no function that can be differentiated.
    """

    def __init__(self, problem: Problem, scheme: str):
        self.problem, self.scheme = problem, SCHEMES[scheme]
        self.dynamics, self.bounds = problem.dynamics, problem.bounds
        self.horizon: tuple[float, float] = problem.horizon or (problem.start_horizon,) * 2  # (lower, upper) [s]
        self.rate = RunningRate(problem.running_cost, self.dynamics)
        self.final: Pointwise | None = None  # of knots [x, u], whose inputs have no part in it
        cost = problem.final_cost
        if cost is not None:
            self.final = Pointwise("final_cost", lambda x, u: cost(x), self.dynamics.nx, (), self.dynamics.probe())

    def nodes_of(self, constraint: Constraint, mesh: Array) -> Indices:
        """The nodes of `mesh` (N+1,) where `constraint` holds: its knots, or all nodes but a given first one."""
        knots = self.problem.knots_of(constraint, input_at_end=True)
        if constraint.knots is None:
            return np.arange(knots[0], self.scheme.nodes * (len(mesh) - 1) + 1)
        return self._nodes_at(knots, mesh)

    def node_limits(self, mesh: Array) -> tuple[Array, Array]:
        """(lower, upper), each (K, nx + nu): the bounds of the nodes, equal where an end or a waypoint is given."""
        b, nx, count = self.bounds, self.dynamics.nx, len(self.scheme.node_fractions(mesh))
        sides = [np.tile(np.concatenate(s), (count, 1)) for s in ((b.x_lower, b.u_lower), (b.x_upper, b.u_upper))]
        if self.scheme.input_is_linear:  # Drake bounds knots alone
            sides[0][1::2], sides[1][1::2] = -np.inf, np.inf
        between = zip(self._nodes_at(self.problem.waypoints, mesh), self.problem.waypoints.values(), strict=True)
        for node, wanted in ((0, self.problem.start), *between, (-1, self.problem.goal)):
            for side in sides:
                side[node, :nx] = np.where(np.isnan(wanted), side[node, :nx], wanted)
        return sides[0], sides[1]

    def _nodes_at(self, knots: Iterable[int], mesh: Array) -> Indices:
        """The nodes that the problem's own `knots` are, which stay knots of a refined mesh."""
        fractions = np.linspace(0, 1, self.problem.num_steps + 1)[list(knots)]
        return self.scheme.nodes * np.argmin(np.abs(mesh[None] - fractions[:, None]), axis=1)

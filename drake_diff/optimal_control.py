"""What a transcription solves, checked: dynamics, ends, waypoints, costs, bounds and constraints over a horizon."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff.arrays import Array, Indices, finite_array
from drake_diff.bounds import Bounds
from drake_diff.constraint import Constraint
from drake_diff.cost import FinalCost, QuadraticCost, differentiate_cost
from drake_diff.dynamics import Dynamics, Pointwise
from drake_diff.transcription_scheme import Scheme, node_fractions


class RunningRate:
    """A running cost at many knots: a number [per s], a QuadraticCost, or a function (x, u) -> scalar."""

    def __init__(self, cost: Any, dynamics: Dynamics):
        self.cost, self.nx, self.width = cost, dynamics.nx, dynamics.nx + dynamics.nu
        self.quadratic = isinstance(cost, QuadraticCost)
        self.constant = None
        if cost is None or np.isscalar(cost):
            self.constant = float(finite_array("running_cost", 0.0 if cost is None else cost, ()))
        elif self.quadratic:
            cost.check_sizes("running_cost", dynamics.nx, dynamics.nu)
        else:
            self._at = Pointwise("running_cost", cost, self.nx, (), dynamics.probe())

    def __call__(self, x: Any, u: Any) -> Any:
        """The rate at x (nx,), u (nu,): floats or what else goes through the cost."""
        return self.cost(x, u) if self.constant is None else self.constant

    def values(self, knots: Array) -> Array:
        """(K,) at `knots` (K, nx + nu)."""
        if self.constant is not None:
            return np.full(len(knots), self.constant)
        if self.quadratic:
            return np.array([float(self.cost(k[: self.nx], k[self.nx :])) for k in knots])
        return self._at.values(knots)[:, 0]

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """(K,) and the gradients (K, nx + nu)."""
        if self.constant is not None:
            return self.values(knots), np.zeros(knots.shape)
        if self.quadratic:
            found = [differentiate_cost(self.cost, k[: self.nx], k[self.nx :]) for k in knots]
            return np.array([v for v, _, _ in found]), np.array([np.concatenate(g) for _, *g in found])
        values, rows = self._at.linearize(knots)
        return values[:, 0], rows[:, 0]


@dataclass(frozen=True, eq=False)
class PathConstraint:
    """A constraint at the nodes at `fractions` of the horizon, or, where None, at all but a given first one."""

    constraint: Constraint
    fractions: Array | None
    first: int

    def nodes(self, mesh: Array, scheme: Scheme) -> Indices:
        """The numbers of its nodes on `mesh` (N+1,), which holds the fractions."""
        if self.fractions is not None:
            return nodes_at(self.fractions, mesh, scheme)
        return np.arange(self.first, scheme.nodes * (len(mesh) - 1) + 1)


def nodes_at(fractions: Array, mesh: Array, scheme: Scheme) -> Indices:
    """The numbers of the nodes at `fractions` of the horizon that knots of `mesh` lie at."""
    return scheme.nodes * np.argmin(np.abs(mesh[None] - np.asarray(fractions)[:, None]), axis=1)


@dataclass(frozen=True, eq=False)
class OptimalControl:
    """What is transcribed, checked: NaN in `x0`, `x_goal` and waypoints is free; `horizon` (lower, upper) [s]."""

    dynamics: Dynamics
    x0: Array  # (nx,)
    x_goal: Array  # (nx,)
    horizon: tuple[float, float]
    rate: RunningRate
    final_cost: FinalCost | None
    bounds: Bounds
    scheme: Scheme
    waypoints: tuple[tuple[float, Array], ...] = ()  # fraction of the horizon, state (nx,)
    paths: tuple[PathConstraint, ...] = ()

    @property
    def time_is_free(self) -> bool:
        return self.horizon[0] < self.horizon[1]

    def final(self, x: Any) -> Any:
        """The final cost at `x` (nx,)."""
        return 0.0 if self.final_cost is None else self.final_cost(x)

    def node_limits(self, mesh: Array) -> tuple[Array, Array]:
        """(lower, upper), each (K, nx + nu): the bounds of the nodes, equal where an end or a waypoint is given."""
        b, nx, count = self.bounds, self.dynamics.nx, len(node_fractions(mesh, self.scheme))
        sides = [np.tile(np.concatenate(s), (count, 1)) for s in ((b.x_lower, b.u_lower), (b.x_upper, b.u_upper))]
        between = [(int(nodes_at(np.array([at]), mesh, self.scheme)[0]), wanted) for at, wanted in self.waypoints]
        for node, wanted in ((0, self.x0), *between, (-1, self.x_goal)):
            for side in sides:
                side[node, :nx] = np.where(np.isnan(wanted), side[node, :nx], wanted)
        return sides[0], sides[1]

    def path_excess(self, nodes: Array, mesh: Array) -> dict[str, float]:
        """The largest excess over its bounds of each path constraint at `nodes` (K, nx + nu); inf where no number."""
        nx = self.dynamics.nx
        found: dict[str, float] = {}
        for path in self.paths:
            c = path.constraint
            worst = max(c.excess(k[:nx], k[nx:]) for k in nodes[path.nodes(mesh, self.scheme)])
            found[c.label] = max(worst, found.get(c.label, 0.0))
        return found

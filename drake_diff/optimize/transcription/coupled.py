"""Rows of a program that are functions of chosen variables, whatever nodes these belong to.

One function of w entries of z (states and inputs of several nodes, the horizon) at each of K places gives m rows there:
traced to an expression, with an exact Jacobian and Hessian, or called back with AutoDiffXd's derivatives and no Hessian
(`expressions.Symbolic`, `expressions.Called`).
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.optimize.problem.coupling import BoundCoupling, RateLimit
from drake_diff.optimize.transcription.expressions import KnotFunction
from drake_diff.optimize.transcription.task import OptimalControl

Entries = tuple[Any, Any, Any]  # rows, columns (K, nonzeros) and where in `values` the nonzeros are


@dataclass(frozen=True, eq=False)
class CoupledRows:
    """lower <= function(z[columns[k]]) <= upper at each place k, with `columns` (K, w), no entry twice in a place."""

    label: str
    function: KnotFunction
    columns: Indices
    lower: Array  # (m,)
    upper: Array

    @property
    def count(self) -> int:
        """How many rows of the program they are."""
        return self.function.rows * len(self.columns)

    @property
    def sides(self) -> tuple[Array, Array]:
        """(lower, upper), each (count,), place by place."""
        return np.tile(self.lower, len(self.columns)), np.tile(self.upper, len(self.columns))

    def values(self, z: Any) -> Any:
        """(count,) at the variables z (n,), an MX."""
        return ca.vec(self.function.values(self._taken(z)))

    def jacobian(self, z: Any) -> tuple[Entries, Any]:
        """((rows, columns, index), source): the entry at rows, columns is source[index]."""
        rows, entries = self.function.jacobian_at
        positions, index = self._numbered(len(rows))
        return (self.function.rows * positions + rows, self.columns[:, entries], index), self.function.jacobian(
            self._taken(z)
        )

    def hessian(self, z: Any, multipliers: Any) -> tuple[Entries, Any]:
        """The same of the upper triangle of the second derivative of multipliers' (count,) values, if it is known."""
        function: Any = self.function
        rows, entries = function.hessian_at
        weights = ca.reshape(multipliers, self.function.rows, len(self.columns))
        first, other = self.columns[:, rows], self.columns[:, entries]
        _, index = self._numbered(len(rows))
        places = np.minimum(first, other), np.maximum(first, other), index
        return places, function.hessian(self._taken(z), weights)

    def _taken(self, z: Any) -> Any:
        return ca.reshape(z[self.columns.ravel().tolist()], self.columns.shape[1], len(self.columns))

    def _numbered(self, nonzeros: int) -> tuple[Indices, Indices]:
        """The place of each nonzero (K, nonzeros), and its number."""
        index = np.arange(len(self.columns) * nonzeros).reshape(len(self.columns), nonzeros)
        return np.arange(len(self.columns))[:, None], index


@dataclass(frozen=True, eq=False)
class SlopeRows:
    """|slopes| <= limit at the ends of all intervals, where the slope by time of a line or parabola is largest.

    As rows weights @ y within limit * T, with y the variables z or, `of_rates`, the rates F of all nodes: linear in T.
    With a free T there are two rows for each, one for either side.
    """

    of_rates: bool
    places: Indices  # (m, s+1) of the nodes' values in y
    weights: Array  # (m, s+1)
    limits: Array  # (m,) [per s]
    horizon: float | None  # [s] None where it is free

    @property
    def count(self) -> int:
        """How many rows of the program they are."""
        return len(self.limits) * (2 if self.horizon is None else 1)

    @property
    def sides(self) -> tuple[Array, Array]:
        """(lower, upper), each (count,)."""
        if self.horizon is not None:
            return -self.horizon * self.limits, self.horizon * self.limits
        zero, none = np.zeros(len(self.limits)), np.full(len(self.limits), np.inf)
        return np.append(-none, zero), np.append(zero, none)

    @property
    def by_time(self) -> Array:
        """(count,) the derivative by a free T."""
        return np.append(-self.limits, self.limits)

    @property
    def entries(self) -> tuple[Indices, Indices, Array]:
        """Rows, places in y and weights, each (count, s+1)."""
        times = self.count // max(len(self.limits), 1)
        rows = np.repeat(np.arange(self.count)[:, None], self.places.shape[1], axis=1)
        return rows, np.tile(self.places, (times, 1)), np.tile(self.weights, (times, 1))


def slopes_of(limit: RateLimit, task: OptimalControl, mesh: Array) -> SlopeRows:
    """The rows of a rate limit on `mesh` (N+1,)."""
    f, scheme = task.dynamics, task.scheme
    entries, limits = limit.entries(task.problem.system)
    ends, size, first = scheme.end_slopes, f.nx, entries
    if limit.of_inputs:
        ends = np.array([[-1.0, 0.0, 1.0]]) if scheme.input_is_linear else ends
        size, first = f.nx + f.nu, f.nx + entries
    lengths, shape = np.diff(mesh), (len(mesh) - 1, len(ends), len(entries))
    nodes = scheme.nodes * np.arange(len(lengths))[:, None] + np.arange(scheme.nodes + 1)
    places = nodes[:, None, None, :] * size + first[None, None, :, None]
    weights = ends[None, :, None, :] / lengths[:, None, None, None]
    whole = (*shape, scheme.nodes + 1)
    free = task.horizon[0] < task.horizon[1]
    return SlopeRows(
        of_rates=not limit.of_inputs,
        places=np.broadcast_to(places, whole).reshape(-1, scheme.nodes + 1),
        weights=np.broadcast_to(weights, whole).reshape(-1, scheme.nodes + 1),
        limits=np.broadcast_to(limits, shape).ravel(),
        horizon=None if free else task.horizon[0],
    )


def rows_of(c: BoundCoupling, function: KnotFunction, nodes: Indices, nx: int, width: int) -> CoupledRows:
    """Those of a coupling where `nodes` (N+1,) are the problem's knots, of nx + nu = `width` entries each."""
    first = nodes[c.knots][:, :, None] * width
    states = (first + np.arange(nx)).reshape(len(c.knots), -1)
    inputs = (first + np.arange(nx, width)).reshape(len(c.knots), -1)
    return CoupledRows(c.label, function, np.hstack([states, inputs]), c.rows.lower, c.rows.upper)

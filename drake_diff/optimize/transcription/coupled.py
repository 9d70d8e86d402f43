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
from drake_diff.optimize.problem.coupling import BoundCoupling
from drake_diff.optimize.transcription.expressions import KnotFunction

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
        place, index = self._numbered(len(rows))
        return (self.function.rows * place + rows, self.columns[:, entries], index), self.function.jacobian(
            self._taken(z)
        )

    def hessian(self, z: Any, multipliers: Any) -> tuple[Entries, Any]:
        """The same of the upper triangle of the second derivative of multipliers' (count,) values, if it is known."""
        function: Any = self.function
        rows, entries = function.hessian_at
        weights = ca.reshape(multipliers, self.function.rows, len(self.columns))
        one, other = self.columns[:, rows], self.columns[:, entries]
        _, index = self._numbered(len(rows))
        places = np.minimum(one, other), np.maximum(one, other), index
        return places, function.hessian(self._taken(z), weights)

    def _taken(self, z: Any) -> Any:
        return ca.reshape(z[self.columns.ravel().tolist()], self.columns.shape[1], len(self.columns))

    def _numbered(self, nonzeros: int) -> tuple[Indices, Indices]:
        """The place of each nonzero (K, nonzeros), and its number."""
        index = np.arange(len(self.columns) * nonzeros).reshape(len(self.columns), nonzeros)
        return np.arange(len(self.columns))[:, None], index


def rows_of(c: BoundCoupling, function: KnotFunction, nodes: Indices, nx: int, width: int) -> CoupledRows:
    """Those of a coupling where `nodes` (N+1,) are the problem's knots, of nx + nu = `width` entries each."""
    first = nodes[c.knots][:, :, None] * width
    states = (first + np.arange(nx)).reshape(len(c.knots), -1)
    inputs = (first + np.arange(nx, width)).reshape(len(c.knots), -1)
    return CoupledRows(c.label, function, np.hstack([states, inputs]), c.rows.lower, c.rows.upper)

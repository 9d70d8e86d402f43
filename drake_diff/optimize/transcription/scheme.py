"""Collocation schemes as tableaus: trapezoid, Hermite-Simpson with a free input at the midpoint, and Drake's.

Over an interval of length h with nodes 0 ... s (ends and, for Hermite-Simpson, the middle) they ask for

    sum_j states[i, j] x_j - h sum_j slopes[i, j] f(x_j, u_j) = 0,    cost = h sum_j weights[j] L(x_j, u_j),

and their motion between nodes is x' the polynomial through f_j, u the polynomial through u_j (Betts, "Practical
Methods for Optimal Control", ch. 4; Kelly, SIAM Review 59(4), 2017). Hermite-Simpson is in separated form: midpoint
states are variables, so that bounds hold there too. Order: 2 and 4. "drake" is what Drake's DirectCollocation
transcribes: Hermite-Simpson with the mean of its neighbours for the midpoint's input, and the cost by the trapezoid
rule, which makes the optimum of order 2.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drake_diff._base.arrays import Array


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


def node_fractions(mesh: Array, scheme: Scheme) -> Array:
    """(K,) where the nodes of `mesh` (N+1,) lie, both from 0 to 1; K = s N + 1."""
    inner = np.arange(scheme.nodes) / scheme.nodes
    return np.append((mesh[:-1, None] + np.diff(mesh)[:, None] * inner).ravel(), 1.0)


def node_weights(mesh: Array, scheme: Scheme) -> Array:
    """(K,) the weight of each node in the integral over a horizon of 1."""
    weights = np.zeros(scheme.nodes * (len(mesh) - 1) + 1)
    for k, h in enumerate(np.diff(mesh)):
        weights[scheme.nodes * k : scheme.nodes * (k + 1) + 1] += h * scheme.weights
    return weights


def per_interval(nodes: Array, scheme: Scheme) -> Array:
    """(N, s+1, ...): the nodes (K, ...) of each interval; neighbours share one."""
    starts = np.arange(0, len(nodes) - 1, scheme.nodes)
    return np.asarray(nodes[starts[:, None] + np.arange(scheme.nodes + 1)])


def interval_defects(scheme: Scheme, h: Array, xs: Array, fs: Array) -> Array:
    """(N, r, nx) from lengths h (N,) [s], states xs and rates fs (N, s+1, nx); in the state's units."""
    return np.asarray(scheme.states @ xs - h[:, None, None] * (scheme.slopes @ fs))

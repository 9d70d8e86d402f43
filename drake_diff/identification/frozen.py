"""The motion of a tree in continuous time, with derivatives of its steps that are cheap and nearly exact.

Over a step of length h the linearized motion is d' = J d + C dz. With J and C frozen halfway (the first term of the
series of Magnus, 1954) that gives

    d(h) = exp(h J) d(0) + h phi(h J) C dz,    phi(X) = (exp(X) - 1) / X,

wrong by h^3 / 24 of how J bends. So a step costs one evaluation instead of the twelve of the method's own derivatives,
also where a motion decays within the step. Least squares end where they would: only the way there is another.
"""

from dataclasses import dataclass, fields

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.identification.flow import CHUNK, ContinuousMotion

ORDER = 8  # of the series of phi
SMALL = 0.5  # the norm of X up to which it is summed; 0.5^9 / 10! is 5e-10


@dataclass(frozen=True, eq=False)
class FrozenMotion(ContinuousMotion):
    """As `ContinuousMotion`; each step is differentiated with its equations frozen halfway."""

    def exact(self) -> ContinuousMotion:
        """Differentiated by the method's own derivatives."""
        return ContinuousMotion(*(getattr(self, one.name) for one in fields(ContinuousMotion)))

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array) -> tuple[Array, Array]:
        """Of each step: by the state (K, M, nx, nx), and by z (K, M, nx, np)."""
        own, by = self.set_tree_at(z)
        (K, M), nx = hs.shape, xs.shape[2]
        h, u = hs.reshape(-1), us.reshape(K * M, -1)
        halfway = self.run(self.unknowns.values(z), xs[:, :-1].reshape(K * M, nx), h[:, None] / 2, u[:, None])[:, 1]
        by_x, by_z = np.empty((K * M, nx, nx)), np.empty((K * M, nx, by.shape[1]))
        for k in range(0, K * M, CHUNK):
            part = slice(k, k + CHUNK)
            _, J, C = self._rate_slopes(own, by, halfway[part], u[part])
            by_x[part], phi = exponential(h[part, None, None] * J)
            by_z[part] = h[part, None, None] * (phi @ C)
        return by_x.reshape(K, M, nx, nx), by_z.reshape(K, M, nx, -1)


def exponential(X: Array) -> tuple[Array, Array]:
    """exp(X) and phi(X) of matrices (N, n, n), by the series of X / 2^s and s times twice as much."""
    norm = float(np.max(np.sum(np.abs(X), axis=1), initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(norm / SMALL)))) if norm > 0 else 0
    X = X / 2.0**halvings
    one = np.eye(X.shape[1])
    phi = np.broadcast_to(one, X.shape)
    for k in range(ORDER, 0, -1):
        phi = one + X @ phi / (k + 1)
    whole = one + X @ phi
    for _ in range(halvings):
        phi = (phi + whole @ phi) / 2
        whole = whole @ whole
    return whole, phi

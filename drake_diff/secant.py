"""The dynamics' second derivatives, learned from the Jacobians of successive motions.

iLQR leaves out sum_i v_i d2 f_i / d z2, v being the multipliers of the dynamics, and crawls where that is large beside
the cost's curvature. For each knot a symmetric matrix M_k that stands for it is corrected by symmetric rank one (SR1;
Nocedal and Wright, "Numerical Optimization", 2006, section 6.2) so that M_k dz = (F_k(new) - F_k(old))' v. It costs no
simulation, and stays 0 where the dynamics are linear. Where more is known of M_k, it is set.
"""

import numpy as np

from drake_diff.arrays import Array
from drake_diff.riccati import LinearQuadratic

SMALLEST_MOVE = 1e-7  # below it rounding of the Jacobians, 1e-12, is too large a part of their difference
SAFE_DIVISOR = 1e-6  # of |dz| |r|: SR1 is not defined where dz' r vanishes


class DynamicsCurvature:
    """M (N, n + m, n + m), updated once for each motion."""

    def __init__(self) -> None:
        self.M = np.zeros(0)
        self._F = np.zeros(0)

    def update(self, problem: LinearQuadratic, dz: Array) -> None:
        """Learn from the problem around the new motion, dz (N, n + m) being how far it has moved."""
        if not self._F.size:
            self.M, self._F = np.zeros_like(problem.hessians), problem.F
            return
        v = multipliers(problem)
        r = np.einsum("kij,ki->kj", problem.F - self._F, v) - np.einsum("kij,kj->ki", self.M, dz)
        divisor = np.einsum("ki,ki->k", r, dz)
        length = np.linalg.norm(dz, axis=1)
        safe = (length > SMALLEST_MOVE) & (np.abs(divisor) > SAFE_DIVISOR * length * np.linalg.norm(r, axis=1))
        r, divisor = r[safe], divisor[safe]
        self.M[safe] += r[:, :, None] * r[:, None, :] / divisor[:, None, None]
        self._F = problem.F


def multipliers(problem: LinearQuadratic) -> Array:
    """(N, n): v_k = d cost / d x_(k+1), all inputs as they are and all gaps kept."""
    n, v = problem.num_states, np.empty_like(problem.gaps)
    v[-1] = problem.final_gradient
    for k in range(len(v) - 1, 0, -1):
        v[k - 1] = problem.gradients[k, :n] + problem.F[k, :, :n].T @ v[k]
    return v

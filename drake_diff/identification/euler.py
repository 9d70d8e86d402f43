"""The motion that a simulator makes by semi-implicit Euler steps of a length, with damping at the end of the step.

That is how Drake's discrete plants and MuJoCo's default integrator go ahead:

    v' = v + h (M + h D)^-1 (forces at q, v),    q' = q + h v'
"""

from dataclasses import dataclass, replace

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.identification.flow import ContinuousMotion
from drake_diff.identification.set_tree import SetTree
from drake_diff.identification.tree import Grip


@dataclass(frozen=True, eq=False)
class EulerMotion(ContinuousMotion):
    """Steps of the length `longest`, of which a whole number lies between samples; of hinges and slides."""

    @property
    def words(self) -> str:
        return f"semi-implicit Euler steps of {1e3 * self.longest:.4g} ms"

    def cut(self, period: float) -> tuple[float, ...]:
        """Lengths of the steps [s] over a time between samples [s]."""
        return (self.longest,) * max(1, round(period / self.longest))

    def shorter(self, than: float) -> None:  # type: ignore[override]
        """There is none: the step is what is looked for."""
        return

    def run(self, values: Array, starts: Array, hs: Array, us: Array) -> Array:
        """(K, M+1, nx) states from starts (K, nx) by steps of hs (K, M) [s] under us (K, M, nu)."""
        own = self._damped(self.set_tree(values))
        nq = self.model.nq
        xs = np.empty((len(starts), hs.shape[1] + 1, starts.shape[1]))
        xs[:, 0] = starts
        for m in range(hs.shape[1]):
            h, q, v = hs[:, m, None], xs[:, m, :nq], xs[:, m, nq:]
            after = v + h * own.accelerate(q, v, us[:, m])
            xs[:, m + 1] = np.concatenate([q + h * self._rate(q, after), after], axis=1)
        return xs

    def _rate(self, q: Array, v: Array) -> Array:
        return np.asarray((self.chart.coordinates.rate(q) @ v[..., None])[..., 0])

    def _damped(self, own: SetTree) -> SetTree:
        numbers = own.numbers
        return SetTree(own.tree, replace(numbers, reflected=numbers.reflected + self.longest * numbers.damping))

    def _step_slopes(self, own: SetTree, by: Array, x: Array, h: Array, u: Array, grip: Grip | None = None) -> Array:
        by = by.copy()
        by[own.numbers.places("reflected")] += self.longest * by[own.numbers.places("damping")]
        _, by_x, by_z = self._rate_slopes(self._damped(own), by, x, u, grip)
        nq, nx, h = self.model.nq, x.shape[1], h[:, None, None]
        after = np.zeros((len(x), nx - nq, nx + by.shape[1]))
        after[..., :nx], after[..., nx:] = h * by_x[:, nq:], h * by_z[:, nq:]
        after[..., nq:nx] += np.eye(nx - nq)
        found = np.empty((len(x), nx, nx + by.shape[1]))
        found[:, nq:] = after
        found[:, :nq] = h * (self.chart.coordinates.rate(x[:, :nq]) @ after)
        found[:, :nq, :nq] += np.eye(nq)
        return found

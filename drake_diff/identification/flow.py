"""The motion of a tree in continuous time over many segments at once, and its derivatives.

Fixed steps of order 8 by the method of Dormand and Prince (Hairer, Norsett and Wanner, "Solving Ordinary Differential
Equations I", 1993, II.5), over which inputs are held; the derivatives are those of the method's own steps. A step of
length 0 changes nothing: with such steps segments of different length stand side by side.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import DOP853

from drake_diff._base.arrays import Array
from drake_diff.identification.chart import Chart
from drake_diff.identification.set_tree import Method, SetTree
from drake_diff.identification.tree import Grip, Numbers, Tree
from drake_diff.identification.unknowns import Unknowns, numbers_at, set_numbers
from drake_diff.model.model import Model

CHUNK = 128  # steps that are differentiated in one call
STAGES, WEIGHTS = tuple(np.array(row[:i]) for i, row in enumerate(DOP853.A)), np.array(DOP853.B)
# Runge and Kutta's of order 4, where a rough motion does.
ROUGH = tuple(np.array(row) for row in ([], [0.5], [0.0, 0.5], [0.0, 0.0, 1.0])), np.array([1, 2, 2, 1]) / 6


@dataclass(frozen=True, eq=False)
class ContinuousMotion:
    """dq/dt = N(q) v, dv/dt = a of a tree whose numbers are set by unknowns."""

    model: Model
    tree: Tree
    chart: Chart
    unknowns: Unknowns
    longest: float  # [s] the longest step
    segment: float = 0.15  # [s]
    method: Method = (STAGES, WEIGHTS)

    @property
    def kinks(self) -> bool:
        """Whether derivatives say little of larger changes."""
        return False

    @property
    def words(self) -> str:
        return f"continuous time, by steps of order 8 of at most {1e3 * self.longest:.3g} ms"

    def cut(self, period: float) -> tuple[float, ...]:
        """Lengths of the steps [s] over a time between samples [s]."""
        count = max(1, int(np.ceil(period / self.longest - 1e-9)))
        return (period / count,) * count

    def shorter(self, than: float) -> "ContinuousMotion":
        """By steps of at most half of a length [s]."""
        return replace(self, longest=than / 2)

    def exact(self) -> "ContinuousMotion | None":
        """None: it has the derivatives of its own steps."""
        return None

    def is_possible(self, values: Array) -> bool:
        """Whether there are bodies with these values."""
        return self.unknowns.consistent(values, self.tree)

    def run(self, values: Array, starts: Array, hs: Array, us: Array) -> Array:
        """(K, M+1, nx) states from starts (K, nx) by steps of hs (K, M) [s] under us (K, M, nu)."""
        own = self.set_tree(values)
        xs = np.empty((len(starts), hs.shape[1] + 1, starts.shape[1]))
        xs[:, 0] = starts
        for m in range(hs.shape[1]):
            xs[:, m + 1] = self._stepped(own, xs[:, m], hs[:, m], us[:, m])
        return xs

    def set_tree(self, values: Array) -> SetTree:
        """The tree that unknowns of these values make."""
        return SetTree(self.tree, set_numbers(self.model, self.tree, self.unknowns, values))

    def _stepped(self, own: SetTree, x: Array, h: Array, u: Array, grip: Grip | None = None) -> Array:
        """The states (N, nx) after one step from x (N, nx) of h (N,) [s] under u (N, nu)."""
        found = own.step(self.method, x, h, u, grip)
        if found is not None:
            return found
        stages, weights = self.method
        slopes = np.empty((len(weights), *x.shape))
        for i, row in enumerate(stages):
            at = x + h[:, None] * np.tensordot(row, slopes[:i], 1)
            slopes[i] = self._rates(at, self._accelerations(own, at, u, grip))
        return np.asarray(x + h[:, None] * np.tensordot(weights, slopes, 1))

    def rates(self, values: Array, x: Array, u: Array) -> Array:
        """(N, nx) by time, of states (N, nx) under u (N, nu)."""
        return self._rates(x, self._accelerations(self.set_tree(values), x, u, None))

    def _accelerations(self, own: SetTree, x: Array, u: Array, grip: Grip | None) -> Array:
        """(N, nv) in states x (N, nx) under u (N, nu)."""
        return own.accelerate(x[:, : self.model.nq], x[:, self.model.nq :], u, grip)

    def grip_at(self, numbers: Numbers, q: Array, v: Array, u: Array) -> Grip | None:
        """What dry friction does in states (N, nq), (N, nv) under u (N, nu); None where it holds nothing."""
        return None

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array) -> tuple[Array, Array]:
        """Of each step: by the state (K, M, nx, nx), and by z (K, M, nx, np)."""
        own, by = self.set_tree_at(z)
        K, M = hs.shape
        x, h, u = xs[:, :-1].reshape(K * M, -1), hs.reshape(-1), us.reshape(K * M, -1)
        nx = x.shape[1]
        found = np.empty((K * M, nx, nx + by.shape[1]))
        for k in range(0, K * M, CHUNK):
            part = slice(k, k + CHUNK)
            found[part] = self._step_slopes(own, by, x[part], h[part], u[part])
        found = found.reshape(K, M, nx, -1)
        return found[..., :nx], found[..., nx:]

    def set_tree_at(self, z: Array) -> tuple[SetTree, Array]:
        """The tree that unknowns make at z, and (count, np) how its numbers change with z."""
        numbers, by = numbers_at(self.model, self.tree, self.unknowns, z)
        return SetTree(self.tree, numbers), by

    def _step_slopes(self, own: SetTree, by: Array, x: Array, h: Array, u: Array, grip: Grip | None = None) -> Array:
        nx, h = x.shape[1], h[:, None, None]
        start = np.zeros((*x.shape, nx + by.shape[1]))
        start[:, :, :nx] = np.eye(nx)
        stages, weights = self.method
        rates, changes = np.empty((len(weights), *x.shape)), np.empty((len(weights), *start.shape))
        for i, row in enumerate(stages):
            at = x + h[..., 0] * np.tensordot(row, rates[:i], 1)
            moved = start + h * np.tensordot(row, changes[:i], 1)
            rates[i], by_x, by_z = self._rate_slopes(own, by, at, u, grip)
            np.matmul(by_x, moved, out=changes[i])
            changes[i, :, :, nx:] += by_z
        return np.asarray(start + h * np.tensordot(weights, changes, 1))

    def _rates(self, x: Array, a: Array) -> Array:
        """(N, nx) by time, of states (N, nx) that accelerate by a (N, nv)."""
        q, v = x[:, : self.model.nq], x[:, self.model.nq :]
        if not self.chart.coordinates.free:
            return np.concatenate([v, a], axis=1)
        return np.concatenate([(self.chart.coordinates.rate(q) @ v[..., None])[..., 0], a], axis=1)

    def _rate_slopes(
        self, own: SetTree, by: Array, x: Array, u: Array, grip: Grip | None = None
    ) -> tuple[Array, Array, Array]:
        nq, chart = self.model.nq, self.chart.coordinates
        q, v = x[:, :nq], x[:, nq:]
        found = own.slopes(q, v, u, by, grip)
        N, W = chart.rate(q), chart.motion(q)
        by_x = np.zeros((*x.shape, x.shape[1]))
        by_x[:, :nq, :nq], by_x[:, :nq, nq:] = chart.rate_by_position(v), N
        by_x[:, nq:, :nq], by_x[:, nq:, nq:] = found.by_q @ W, found.by_v
        by_z = np.zeros((*x.shape, by.shape[1]))
        by_z[:, nq:] = found.by_numbers
        return np.concatenate([(N @ v[..., None])[..., 0], found.a], axis=1), by_x, by_z

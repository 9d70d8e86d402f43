"""Small motions of many states at once: [position; velocity], where a free body turns by a vector in world."""

from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.mechanics.coordinates import Coordinates


@dataclass(frozen=True, eq=False)
class Chart:
    """States (..., nx) and their small motions (..., 2 nv)."""

    coordinates: Coordinates

    @property
    def size(self) -> int:
        return 2 * self.coordinates.nv

    def plus(self, x: Array, d: Array) -> Array:
        """The states that the small motions lead to; quaternions get the norm 1."""
        nq, nv = self.coordinates.nq, self.coordinates.nv
        moved = np.concatenate([x[..., :nq], x[..., nq:] + d[..., nv:]], axis=-1)
        for i, j in self.coordinates.single:
            moved[..., i] += d[..., j]
        for i, j in self.coordinates.free:
            small = np.concatenate([np.ones((*d.shape[:-1], 1)), d[..., j : j + 3] / 2], axis=-1)
            turned = _product(small, x[..., i : i + 4])
            moved[..., i : i + 4] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
            moved[..., i + 4 : i + 7] += d[..., j + 3 : j + 6]
        return moved

    def minus(self, y: Array, x: Array) -> Array:
        """The small motion from x to y; NaN where y has NaN."""
        nq, nv = self.coordinates.nq, self.coordinates.nv
        found = np.empty((*np.broadcast_shapes(y.shape, x.shape)[:-1], 2 * nv))
        found[..., nv:] = y[..., nq:] - x[..., nq:]
        for i, j in self.coordinates.single:
            found[..., j] = y[..., i] - x[..., i]
        for i, j in self.coordinates.free:
            between = _product(y[..., i : i + 4], x[..., i : i + 4] * np.array([1.0, -1.0, -1.0, -1.0]))
            with np.errstate(divide="ignore", invalid="ignore"):
                found[..., j : j + 3] = 2 * between[..., 1:] / between[..., :1]
            found[..., j + 3 : j + 6] = y[..., i + 4 : i + 7] - x[..., i + 4 : i + 7]
        return found

    def to_motion(self, x: Array) -> Array:
        """(..., 2 nv, nx): the small motion that a change of the state is."""
        nq, nv = self.coordinates.nq, self.coordinates.nv
        found = np.zeros((*x.shape[:-1], 2 * nv, nq + nv))
        found[..., :nv, :nq] = self.coordinates.motion(x[..., :nq])
        found[..., nv:, nq:] = np.eye(nv)
        return found

    def from_motion(self, x: Array) -> Array:
        """(..., nx, 2 nv): how the state changes with a small motion."""
        nq, nv = self.coordinates.nq, self.coordinates.nv
        found = np.zeros((*x.shape[:-1], nq + nv, 2 * nv))
        found[..., :nq, :nv] = self.coordinates.rate(x[..., :nq])
        found[..., nq:, nv:] = np.eye(nv)
        return found


def _product(a: Array, b: Array) -> Array:
    """a * b of quaternions (w, x, y, z)."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )

"""Free bodies as simulators that work at centres of mass hold them: angular velocity and that of the centre, in world.

v_center = Q v, with r the place of the centre of mass from the body's origin in world and Q = [[1, 0], [-skew(r), 1]].
"""

from dataclasses import dataclass

import numpy as np

from drake_diff.arrays import Array
from drake_diff.cross_product import skew
from drake_diff.engines.euler import Coordinates, rotation


@dataclass(frozen=True, eq=False)
class Centers:
    """`centers` (3,) in the body, of each of `coordinates.free`."""

    coordinates: Coordinates
    centers: tuple[Array, ...]

    def turn(self, q: Array) -> Array:
        """Q (nv, nv)."""
        Q = np.eye(self.coordinates.nv)
        for _, j, r in self._arms(q):
            Q[j + 3 : j + 6, j : j + 3] = -skew(r)
        return Q

    def turning(self, q: Array, v: Array) -> Array:
        """(nv,) dQ/dt v: w x (w x r)."""
        found = np.zeros(self.coordinates.nv)
        for _, j, r in self._arms(q):
            w = v[j : j + 3]
            found[j + 3 : j + 6] = np.cross(w, np.cross(w, r))
        return found

    def derivative(self, x: Array) -> Array:
        """(nx, nx) of (q of norm 1, Q v) by (q, v)."""
        q, v = x[: self.coordinates.nq], x[self.coordinates.nq :]
        W, N = self.coordinates.motion(q), self.coordinates.rate(unit(self.coordinates, q))
        return np.block([[N @ W, np.zeros((len(q), len(v)))], [self._by_motion(q, v) @ W, self.turn(q)]])

    def inverse_derivative(self, x: Array) -> Array:
        """(nx, nx) of (q, v) by (q, Q v), where q has the norm 1."""
        q, v = x[: self.coordinates.nq], x[self.coordinates.nq :]
        W, N, back = self.coordinates.motion(q), self.coordinates.rate(q), np.linalg.inv(self.turn(q))
        return np.block([[N @ W, np.zeros((len(q), len(v)))], [-back @ self._by_motion(q, v) @ W, back]])

    def _by_motion(self, q: Array, v: Array) -> Array:
        """(nv, nv) of Q v by small motion at fixed v."""
        found = np.zeros((self.coordinates.nv, self.coordinates.nv))
        for _, j, r in self._arms(q):
            found[j + 3 : j + 6, j : j + 3] = -skew(v[j : j + 3]) @ skew(r)
        return found

    def _arms(self, q: Array) -> list[tuple[int, int, Array]]:
        places = zip(self.coordinates.free, self.centers, strict=True)
        return [(i, j, rotation(q[i : i + 4]) @ c) for (i, j), c in places]


def unit(coordinates: Coordinates, q: Array) -> Array:
    """`q` with quaternions of the norm 1."""
    found = np.array(q)
    for i, _ in coordinates.free:
        found[i : i + 4] /= np.linalg.norm(q[i : i + 4])
    return found


def zero(coordinates: Coordinates) -> Array:
    """(nq,) with free bodies at the origin, unturned."""
    q = np.zeros(coordinates.nq)
    for i, _ in coordinates.free:
        q[i] = 1.0
    return q

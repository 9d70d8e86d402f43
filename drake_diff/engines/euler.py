"""Drake's discrete step where nothing touches, written out: semi-implicit Euler with implicit joint damping.

    (M(q) + h D) a = B u - bias(q, v) - D v,   v' = v + h a,   q' = q + h N(q) v'

N is the identity but for a free body, where v = (w, v_o) in world and the quaternion moves by h/2 (0, w) * q.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drake_diff.arrays import Array
from drake_diff.cross_product import skew


@dataclass(frozen=True)
class Coordinates:
    """Which entries of q and v belong together: free bodies, and joints of one degree of freedom."""

    free: tuple[tuple[int, int], ...]  # (start in q, start in v)
    single: tuple[tuple[int, int], ...]  # (index in q, index in v)

    @cached_property
    def nq(self) -> int:
        return 7 * len(self.free) + len(self.single)

    @cached_property
    def nv(self) -> int:
        return 6 * len(self.free) + len(self.single)

    @cached_property
    def moves_as_is(self) -> Array:
        """(nq, nv): 1 where an entry of v moves one of q, but for the quaternions."""
        N = np.zeros((self.nq, self.nv))
        for i, j in self.single:
            N[i, j] = 1.0
        for i, j in self.free:
            N[i + 4 : i + 7, j + 3 : j + 6] = _ONE
        return N

    @cached_property
    def single_as_is(self) -> Array:
        """(nv, nv) the identity but for free bodies, where it is 0."""
        own = np.zeros(self.nv)
        own[[j for _, j in self.single]] = 1.0
        return np.diag(own)

    def rate(self, q: Array) -> Array:
        """N (..., nq, nv) with dq/dt = N v, at q (..., nq)."""
        N = np.empty((*q.shape[:-1], self.nq, self.nv))
        N[:] = self.moves_as_is
        for i, j in self.free:
            N[..., i : i + 4, j : j + 3] = 0.5 * _times_from_left(q[..., i : i + 4])
        return N

    def rate_by_position(self, v: Array) -> Array:
        """(..., nq, nq) the derivative of N(q) v by q, which does not depend on q, at v (..., nv)."""
        derivative = np.zeros((*v.shape[:-1], self.nq, self.nq))
        for i, j in self.free:
            derivative[..., i : i + 4, i : i + 4] = 0.5 * _left_product(v[..., j : j + 3])
        return derivative

    def motion(self, q: Array) -> Array:
        """W (..., nv, nq): the small motion, in the sense of v, that a change of q (..., nq) is.

        W N = 1, and W q = 0 for a norm.
        """
        W = np.empty((*q.shape[:-1], self.nv, self.nq))
        W[:] = self.moves_as_is.T
        for i, j in self.free:
            quaternion = q[..., i : i + 4]
            norm = (quaternion**2).sum(axis=-1)[..., None, None]
            W[..., j : j + 3, i : i + 4] = 2 * np.swapaxes(_times_from_left(quaternion), -1, -2) / norm
        return W


def euler_acceleration(M: Array, D: Array, h: float, v: Array, force: Array) -> Array:
    """(nv,) (v' - v) / h of the step, with `force` (nv,) = B u - bias and joint damping D (nv,)."""
    return np.asarray(np.linalg.solve(M + h * np.diag(D), force - D * v))


def euler_step(coordinates: Coordinates, h: float, x: Array, acceleration: Array) -> Array:
    """(nx,) the state that the acceleration leads to."""
    q, v = x[: coordinates.nq], x[coordinates.nq :]
    v_next = v + h * acceleration
    return np.concatenate([q + h * coordinates.rate(q) @ v_next, v_next])


def euler_jacobian(coordinates: Coordinates, h: float, x: Array, x_next: Array, by: Array) -> Array:
    """(nx, nx + nu) of `euler_step`, from `by` (nv, 2 nv + nu): the acceleration by small motion, by v and by u."""
    nq, nv = coordinates.nq, coordinates.nv
    q, v_next = x[:nq], x_next[nq:]
    lower = h * np.hstack([by[:, :nv] @ coordinates.motion(q), by[:, nv:]])
    lower[:, nq : nq + nv] += np.eye(nv)
    upper = h * coordinates.rate(q) @ lower
    upper[:, :nq] += np.eye(nq) + h * coordinates.rate_by_position(v_next)
    return np.vstack([upper, lower])


def exponential_turn(quaternion: Array, angle: Array) -> Array:
    """(4,) exp(angle / 2) * q: the quaternion (w, x, y, z) turned by the vector `angle` (3,) [rad] in world."""
    half = float(np.linalg.norm(angle)) / 2
    vector = np.sinc(half / np.pi) * angle / 2
    return np.asarray(np.cos(half) * quaternion + _times_from_left(quaternion) @ vector)


def rotation(quaternion: Array) -> Array:
    """(..., 3, 3) of a quaternion (w, x, y, z) (..., 4) of any norm."""
    vector = skew(quaternion[..., 1:])
    scale = 2 / (quaternion * quaternion).sum(axis=-1)[..., None, None]
    return np.asarray(_ONE + scale * (quaternion[..., :1, None] * vector + vector @ vector))


def _times_from_left(q: Array) -> Array:
    """(..., 4, 3): w -> (0, w) * q."""
    return np.asarray((q @ _TIMES_FROM_LEFT).reshape(*q.shape[:-1], 4, 3))


def _left_product(w: Array) -> Array:
    """(..., 4, 4): q -> (0, w) * q."""
    return np.asarray((w @ _LEFT_PRODUCT).reshape(*w.shape[:-1], 4, 4))


# Matrices whose entries are linear in a vector: row i holds the matrix of the vector's entry i, flattened.
_ONE = np.eye(3)
_PRODUCT = np.zeros((3, 4, 4))
_PRODUCT[:, 0, 1:], _PRODUCT[:, 1:, 0], _PRODUCT[:, 1:, 1:] = -_ONE, _ONE, skew(_ONE)
_LEFT_PRODUCT = _PRODUCT.reshape(3, 16)
_TIMES_FROM_LEFT = np.transpose(_PRODUCT, (2, 1, 0)).reshape(4, 12)

"""Coordinates of trees with free bodies: rates of q, and the coordinates of free bodies in other simulators.

Drake's free body has q = (quaternion w x y z, position) and v = (w, v_o) in world, v_o the velocity of its origin. All
other joints have one degree of freedom and the same coordinates in all simulators. This module implements

- Drake's step without contact, semi-implicit Euler with implicit joint damping D (`euler_step`):
      (M(q) + h D) a = B u - bias(q, v) - D v,   v' = v + h a,   q' = q + h N(q) v'
  where N is the identity except for a free body, whose quaternion moves by h/2 (0, w) * q;
- Pinocchio's free body: position and quaternion (x, y, z, w), and (v, w) in the body's own frame. With R the
  orientation, v_native = Q v and a tangent vector d is Q d, Q = [[0, R'], [R', 0]]; dv/dt = Q' a_native + (0, w x v);
- free bodies at their centres of mass (`Centers`): w and the velocity of the centre, in world. With r the vector from
  the origin to the centre, v_center = Q v, Q = [[1, 0], [-skew(r), 1]].
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, cross, own_array, skew
from drake_diff.mechanics import tree_kernel


@dataclass(frozen=True)
class Coordinates:
    """The indices in q and v of free bodies and of joints with one degree of freedom."""

    free: tuple[tuple[int, int], ...]  # (start in q, start in v)
    single: tuple[tuple[int, int], ...]  # (index in q, index in v)

    @cached_property
    def nq(self) -> int:
        return 7 * len(self.free) + len(self.single)

    @cached_property
    def nv(self) -> int:
        return 6 * len(self.free) + len(self.single)

    @cached_property
    def starts(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """`free` and `single` as arrays (bodies, 2) and (joints, 2)."""
        free, single = (np.array(pairs, dtype=np.int64).reshape(-1, 2) for pairs in (self.free, self.single))
        return free, single

    @cached_property
    def moves_as_is(self) -> Array:
        """A matrix (nq, nv) that is 1 where an entry of v is the rate of an entry of q, and 0 for quaternions."""
        N = np.zeros((self.nq, self.nv))
        for i, j in self.single:
            N[i, j] = 1.0
        for i, j in self.free:
            N[i + 4 : i + 7, j + 3 : j + 6] = _ONE
        return N

    @cached_property
    def single_as_is(self) -> Array:
        """The identity (nv, nv), but 0 for free bodies."""
        diagonal = np.zeros(self.nv)
        diagonal[[j for _, j in self.single]] = 1.0
        return np.diag(diagonal)

    def rate(self, q: Array) -> Array:
        """Return N (..., nq, nv) with dq/dt = N v, at q (..., nq)."""
        N = np.empty((*q.shape[:-1], self.nq, self.nv))
        N[:] = self.moves_as_is
        for i, j in self.free:
            N[..., i : i + 4, j : j + 3] = 0.5 * _times_from_left(q[..., i : i + 4])
        return N

    def rate_by_position(self, v: Array) -> Array:
        """Return d(N(q) v)/dq (..., nq, nq) at v (..., nv), which does not depend on q."""
        derivative = np.zeros((*v.shape[:-1], self.nq, self.nq))
        for i, j in self.free:
            derivative[..., i : i + 4, i : i + 4] = 0.5 * (v[..., j : j + 3] @ _LEFT_PRODUCT).reshape(
                *v.shape[:-1], 4, 4
            )
        return derivative

    def motion(self, q: Array) -> Array:
        """Return W (..., nv, nq), which maps a change of q (..., nq) to a tangent vector in the coordinates of v.

        W N = 1, and W maps a change of a quaternion's norm to 0.
        """
        W = np.empty((*q.shape[:-1], self.nv, self.nq))
        W[:] = self.moves_as_is.T
        for i, j in self.free:
            quaternion = q[..., i : i + 4]
            norm = (quaternion**2).sum(axis=-1)[..., None, None]
            W[..., j : j + 3, i : i + 4] = 2 * np.swapaxes(_times_from_left(quaternion), -1, -2) / norm
        return W


def euler_acceleration(M: Array, D: Array, h: float, v: Array, force: Array) -> Array:
    """Return (v' - v) / h of the step (nv,), for `force` (nv,) = B u - bias and joint damping D (nv,)."""
    return np.asarray(np.linalg.solve(M + h * np.diag(D), force - D * v))


def euler_step(coordinates: Coordinates, h: float, x: Array, acceleration: Array) -> Array:
    """Return the next states (..., nx) for accelerations (..., nv) at x (..., nx)."""
    q, v_next = x[..., : coordinates.nq], x[..., coordinates.nq :] + h * acceleration
    q_dot = (
        (coordinates.rate(q) @ v_next[..., None])[..., 0] if coordinates.free else v_next @ coordinates.moves_as_is.T
    )
    return np.concatenate([q + h * q_dot, v_next], axis=-1)


def euler_jacobian(coordinates: Coordinates, h: float, x: Array, x_next: Array, by: Array) -> Array:
    """Return `euler_step`'s Jacobian (N, nx, nx + nu) from da/d(tangent of q, v, u), `by` (N, nv, 2 nv + nu)."""
    nq, nv = coordinates.nq, coordinates.nv
    velocities, jacobians = h * by, np.empty((len(x), nq + nv, nq - nv + by.shape[2]))
    velocities[:, :, nv : 2 * nv] += np.eye(nv)
    q, v_next = own_array(x[:, :nq]), own_array(x_next[:, nq:])
    tree_kernel.assemble_steps(h, *coordinates.starts, q, v_next, velocities, jacobians)
    return jacobians


def exponential_turn(quaternion: Array, angle: Array) -> Array:
    """Return exp(angle / 2) * q (4,): the quaternion (w, x, y, z) rotated by the vector `angle` (3,) [rad] in world."""
    half = float(np.linalg.norm(angle)) / 2
    vector = np.sinc(half / np.pi) * angle / 2
    return np.asarray(np.cos(half) * quaternion + _times_from_left(quaternion) @ vector)


def rotation(quaternion: Array) -> Array:
    """Return the rotation matrix (..., 3, 3) of a quaternion (w, x, y, z) (..., 4) of any norm but 0."""
    vector = skew(quaternion[..., 1:])
    scale = 2 / (quaternion * quaternion).sum(axis=-1, keepdims=True)[..., None]
    return np.asarray(_ONE + scale * (quaternion[..., :1, None] * vector + vector @ vector))


def unit(coordinates: Coordinates, q: Array) -> Array:
    """Return `q` with normalized quaternions."""
    normalized = np.array(q)
    for i, _ in coordinates.free:
        normalized[i : i + 4] /= np.linalg.norm(q[i : i + 4])
    return normalized


def zero(coordinates: Coordinates) -> Array:
    """Return q (nq,) = 0, with the identity quaternion for free bodies."""
    q = np.zeros(coordinates.nq)
    for i, _ in coordinates.free:
        q[i] = 1.0
    return q


def native_positions(coordinates: Coordinates, q: Array) -> Array:
    """Convert Drake's q (..., nq) to native positions (..., nq)."""
    native = np.array(q)
    for i, _ in coordinates.free:
        quaternion = q[..., i : i + 4] / np.linalg.norm(q[..., i : i + 4], axis=-1, keepdims=True)
        native[..., i : i + 3], native[..., i + 3 : i + 7] = q[..., i + 4 : i + 7], quaternion[..., [1, 2, 3, 0]]
    return native


def turn(coordinates: Coordinates, q: Array) -> Array:
    """Return Q (..., nv, nv) with v_native = Q v."""
    Q = np.empty((*q.shape[:-1], coordinates.nv, coordinates.nv))
    Q[:] = coordinates.single_as_is
    for i, j in coordinates.free:
        R_t = np.swapaxes(rotation(q[..., i : i + 4]), -1, -2)
        Q[..., j : j + 3, j + 3 : j + 6] = Q[..., j + 3 : j + 6, j : j + 3] = R_t
    return Q


def turning(coordinates: Coordinates, v: Array) -> Array:
    """Return w x v (..., nv) for free bodies, and 0 for other joints, at Drake's v (..., nv)."""
    rates = np.zeros_like(v)
    for _, j in coordinates.free:
        rates[..., j + 3 : j + 6] = cross(v[..., j : j + 3], v[..., j + 3 : j + 6])
    return rates


def turn_change(coordinates: Coordinates, Q: Array, v: Array) -> Array:
    """Return d(Q v)/d(tangent of q) (..., nv, nv) at constant v (..., nv), with Q from `turn`."""
    change = np.zeros((*v.shape, coordinates.nv))
    for _, j in coordinates.free:
        about, move = slice(j, j + 3), slice(j + 3, j + 6)
        R_t = Q[..., about, move]
        change[..., about, about] = R_t @ skew(v[..., move])
        change[..., move, about] = R_t @ skew(v[..., about])
    return change


def turn_derivatives(coordinates: Coordinates, Q: Array, v: Array, native: Array) -> tuple[Array, Array, Array]:
    """Return d(Q v)/d(tangent of q), and of Q' a_native + w x v the derivatives by tangent and v (..., nv, nv)."""
    out, out_v = np.zeros((2, *v.shape, coordinates.nv))
    for _, j in coordinates.free:
        about, move = slice(j, j + 3), slice(j + 3, j + 6)
        R = Q[..., about, move].swapaxes(-1, -2)
        out[..., about, about] = -skew((R @ native[..., move, None])[..., 0])
        out[..., move, about] = -skew((R @ native[..., about, None])[..., 0])
        out_v[..., move, about], out_v[..., move, move] = -skew(v[..., move]), skew(v[..., about])
    return turn_change(coordinates, Q, v), out, out_v


@dataclass(frozen=True, eq=False)
class Centers:
    """Free bodies at their centres of mass: `centers` (3,) in the body, for each of `coordinates.free`."""

    coordinates: Coordinates
    centers: tuple[Array, ...]

    def turn(self, q: Array) -> Array:
        """Return Q (nv, nv) with v_center = Q v."""
        Q = np.eye(self.coordinates.nv)
        for _, j, r in self._arms(q):
            Q[j + 3 : j + 6, j : j + 3] = -skew(r)
        return Q

    def turning(self, q: Array, v: Array) -> Array:
        """Return dQ/dt v (nv,): w x (w x r)."""
        rates = np.zeros(self.coordinates.nv)
        for _, j, r in self._arms(q):
            w = v[j : j + 3]
            rates[j + 3 : j + 6] = np.cross(w, np.cross(w, r))
        return rates

    def derivative(self, x: Array) -> Array:
        """Return the derivative (nx, nx) of (normalized q, Q v) with respect to (q, v)."""
        q, v = x[: self.coordinates.nq], x[self.coordinates.nq :]
        W, N = self.coordinates.motion(q), self.coordinates.rate(unit(self.coordinates, q))
        return np.block([[N @ W, np.zeros((len(q), len(v)))], [self._by_motion(q, v) @ W, self.turn(q)]])

    def inverse_derivative(self, x: Array) -> Array:
        """Return the derivative (nx, nx) of (q, v) with respect to (q, Q v), for normalized q."""
        q, v = x[: self.coordinates.nq], x[self.coordinates.nq :]
        W, N, back = self.coordinates.motion(q), self.coordinates.rate(q), np.linalg.inv(self.turn(q))
        return np.block([[N @ W, np.zeros((len(q), len(v)))], [-back @ self._by_motion(q, v) @ W, back]])

    def _by_motion(self, q: Array, v: Array) -> Array:
        """Return d(Q v)/d(tangent of q) (nv, nv) at constant v."""
        derivative = np.zeros((self.coordinates.nv, self.coordinates.nv))
        for _, j, r in self._arms(q):
            derivative[j + 3 : j + 6, j : j + 3] = -skew(v[j : j + 3]) @ skew(r)
        return derivative

    def _arms(self, q: Array) -> list[tuple[int, int, Array]]:
        places = zip(self.coordinates.free, self.centers, strict=True)
        return [(i, j, rotation(q[i : i + 4]) @ c) for (i, j), c in places]


def _times_from_left(q: Array) -> Array:
    """Return the matrix (..., 4, 3) of w -> (0, w) * q."""
    return np.asarray((q @ _TIMES_FROM_LEFT).reshape(*q.shape[:-1], 4, 3))


# Matrices whose entries are linear in a vector: row i holds the matrix of the vector's entry i, flattened.
_ONE = np.eye(3)
_PRODUCT = np.zeros((3, 4, 4))
_PRODUCT[:, 0, 1:], _PRODUCT[:, 1:, 0], _PRODUCT[:, 1:, 1:] = -_ONE, _ONE, skew(_ONE)
_LEFT_PRODUCT = _PRODUCT.reshape(3, 16)  # linear in w: the matrix of q -> (0, w) * q
_TIMES_FROM_LEFT = np.transpose(_PRODUCT, (2, 1, 0)).reshape(4, 12)

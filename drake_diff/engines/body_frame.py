"""Free bodies as Pinocchio has them: a position and quaternion (x, y, z, w), and (v, w) in the body's own frame.

With R its orientation, v_native = Q v and a small motion is Q d, Q = [[0, R'], [R', 0]]; dv/dt = Q' a_native +
(0, w x v). All other joints are as in Drake.
"""

import numpy as np

from drake_diff.arrays import Array
from drake_diff.cross_product import cross, skew
from drake_diff.engines.euler import Coordinates, rotation


def native_positions(coordinates: Coordinates, q: Array) -> Array:
    """(..., nq) of Drake's q (..., nq)."""
    native = np.array(q)
    for i, _ in coordinates.free:
        quaternion = q[..., i : i + 4] / np.linalg.norm(q[..., i : i + 4], axis=-1, keepdims=True)
        native[..., i : i + 3], native[..., i + 3 : i + 7] = q[..., i + 4 : i + 7], quaternion[..., [1, 2, 3, 0]]
    return native


def turn(coordinates: Coordinates, q: Array) -> Array:
    """Q (..., nv, nv)."""
    Q = np.empty((*q.shape[:-1], coordinates.nv, coordinates.nv))
    Q[:] = coordinates.single_as_is
    for i, j in coordinates.free:
        R_t = np.swapaxes(rotation(q[..., i : i + 4]), -1, -2)
        Q[..., j : j + 3, j + 3 : j + 6] = Q[..., j + 3 : j + 6, j : j + 3] = R_t
    return Q


def turning(coordinates: Coordinates, v: Array) -> Array:
    """(..., nv) w x v of free bodies, in Drake's v (..., nv)."""
    found = np.zeros_like(v)
    for _, j in coordinates.free:
        found[..., j + 3 : j + 6] = cross(v[..., j : j + 3], v[..., j + 3 : j + 6])
    return found


def turn_change(coordinates: Coordinates, Q: Array, v: Array) -> Array:
    """(..., nv, nv) the derivative of Q v by small motion at fixed v (..., nv), Q being that of `turn`."""
    change = np.zeros((*v.shape, coordinates.nv))
    for _, j in coordinates.free:
        about, move = slice(j, j + 3), slice(j + 3, j + 6)
        R_t = Q[..., about, move]
        change[..., about, about] = R_t @ skew(v[..., move])
        change[..., move, about] = R_t @ skew(v[..., about])
    return change


def turn_derivatives(coordinates: Coordinates, Q: Array, v: Array, native: Array) -> tuple[Array, Array, Array]:
    """(..., nv, nv) of Q v by small motion at fixed v; of Q' a_native + w x v by small motion, and by v."""
    out, out_v = np.zeros((2, *v.shape, coordinates.nv))
    for _, j in coordinates.free:
        about, move = slice(j, j + 3), slice(j + 3, j + 6)
        R = Q[..., about, move].swapaxes(-1, -2)
        out[..., about, about] = -skew((R @ native[..., move, None])[..., 0])
        out[..., move, about] = -skew((R @ native[..., about, None])[..., 0])
        out_v[..., move, about], out_v[..., move, move] = -skew(v[..., move]), skew(v[..., about])
    return turn_change(coordinates, Q, v), out, out_v

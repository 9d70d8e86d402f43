"""The signed distance of a point from the shapes that spheres touch, and its gradient, as CasADi expressions."""

from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.derivatives.contact.active_contacts import ContactPairs

TINY = 1e-30  # [m^2] keeps the distance from a point or an axis differentiable on it


def distance_of(pairs: ContactPairs, i: int, local: Any) -> tuple[Any, Any]:
    """Of `local` (3,), in the frame of the other shape of pair `i`, from that shape: (distance, its gradient)."""
    lower, upper = pairs.lower[i], pairs.upper[i]
    if np.isinf(lower).any():  # a half space, below 0
        return local[2] - float(upper[2]), ca.DM([0, 0, 1])
    if pairs.is_round[i]:
        distance, gradient = _from_cylinder(local, float(upper[0]), float(upper[2]))
    elif np.all(lower == upper):
        distance = ca.sqrt(ca.sumsqr(local - ca.DM(upper)) + TINY)
        gradient = (local - ca.DM(upper)) / distance
    else:
        distance, gradient = _from_box(local, lower, upper)
    return distance - pairs.rounding[i], gradient


def edges_of(pairs: ContactPairs, i: int, local: Any) -> list[Any]:
    """Where the nearest point of the other shape goes from one of its faces to the next, how the normal turns jumps.

    Each is above 0 beyond a face, at `local` (3,) as in `distance_of`.
    """
    lower, upper = pairs.lower[i], pairs.upper[i]
    if np.isinf(lower).any():
        return []
    if pairs.is_round[i]:
        half = float(upper[2])
        return [ca.sqrt(ca.sumsqr(local[:2]) + TINY) - float(upper[0]), local[2] - half, -half - local[2]]
    wide = np.flatnonzero(upper > lower).tolist()
    return [side for j in wide for side in (local[j] - float(upper[j]), float(lower[j]) - local[j])]


def _from_box(local: Any, lower: Array, upper: Array) -> tuple[Any, Any]:
    outside = local - ca.fmin(ca.fmax(local, ca.DM(lower)), ca.DM(upper))
    ways = ca.vertcat(ca.DM(upper) - local, local - ca.DM(lower))
    return _from_faces(outside, ways, ca.DM(np.hstack([np.eye(3), -np.eye(3)])))


def _from_cylinder(local: Any, radius: float, half: float) -> tuple[Any, Any]:
    """Its axis is z."""
    away = ca.sqrt(ca.sumsqr(local[:2]) + TINY)
    beside = ca.if_else(away > radius, 1 - radius / away, 0.0)
    outside = ca.vertcat(beside * local[:2], local[2] - ca.fmin(ca.fmax(local[2], -half), half))
    ways = ca.vertcat(radius - away, half - local[2], local[2] + half)
    side, up = ca.vertcat(local[:2] / away, 0), ca.DM([0, 0, 1])
    return _from_faces(outside, ways, ca.horzcat(side, up, -up))


def _from_faces(outside: Any, ways: Any, normals: Any) -> tuple[Any, Any]:
    """By the way from the shape's nearest point, `outside` (3,), or within it by the shortest of the ways out."""
    square = ca.sumsqr(outside)
    beyond = square > 0
    length = ca.sqrt(ca.if_else(beyond, square, 1.0))
    least = ca.mmin(ways)
    face, found = ca.SX.zeros(3), ca.SX(0)
    for j in range(ways.numel()):
        nearest = ca.logic_and(ways[j] <= least, found < 0.5)
        face += ca.if_else(nearest, normals[:, j], ca.DM.zeros(3))
        found += ca.if_else(nearest, 1.0, 0.0)
    return ca.if_else(beyond, length, -least), ca.if_else(beyond, outside / length, face)

"""The distance of shapes with edges from a half space, which Drake does not compute: that of their lowest point."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, HalfSpace, Mesh
from pydrake.math import sqrt


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """As Drake's SignedDistancePair: of the geometries A and B, of floats or AutoDiffXd."""

    id_A: Any
    id_B: Any
    p_ACa: Any  # (3,) the closest point of A, in its own frame [m]
    p_BCb: Any
    distance: Any  # [m], signed
    nhat_BA_W: Any  # (3,)


def from_half_space(query: Any, ids: tuple[Any, Any]) -> ClosestPoints | None:
    """Of a half space and a box, capsule, cylinder, ellipsoid or mesh's hull; None where Drake is to be asked."""
    inspector = query.inspector()
    shapes = [inspector.GetShape(i) for i in ids]
    grounds = [i for i, shape in enumerate(shapes) if isinstance(shape, HalfSpace)]
    if len(grounds) != 1:
        return None
    ground, other = ids[grounds[0]], ids[1 - grounds[0]]
    X_WG, X_WO = query.GetPoseInWorld(ground), query.GetPoseInWorld(other)
    up = X_WG.rotation().matrix()[:, 2]
    low = _furthest(shapes[1 - grounds[0]], -(X_WO.rotation().matrix().T @ up))
    if low is None:
        return None
    from_ground = X_WG.rotation().matrix().T @ (
        X_WO.rotation().matrix() @ low + X_WO.translation() - X_WG.translation()
    )
    distance = from_ground[2]
    below = np.array([from_ground[0], from_ground[1], 0 * distance])
    if grounds[0] == 0:
        return ClosestPoints(ground, other, below, low, distance, -up)
    return ClosestPoints(other, ground, low, below, distance, up)


def _furthest(shape: Any, along: Any) -> Any:
    """(3,) the point of a shape, in its frame, that is furthest along a unit vector; None of a shape not known here."""
    if isinstance(shape, Box):
        return np.where(along > 0, 1, -1) * (np.array(shape.size()) / 2)
    if isinstance(shape, Capsule | Cylinder):
        end = np.array([0, 0, shape.length() / 2 if along[2] > 0 else -shape.length() / 2])
        if isinstance(shape, Capsule):
            return end + shape.radius() * along
        across = along * np.array([1, 1, 0])
        size = across @ across
        return end + (shape.radius() / sqrt(size) * across if size > 0 else 0)
    if isinstance(shape, Ellipsoid):
        half = np.array([shape.a(), shape.b(), shape.c()])
        return half**2 * along / sqrt(np.sum((half * along) ** 2))
    if isinstance(shape, Convex | Mesh):
        hull = shape.GetConvexHull()
        vertices = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
        return vertices[np.argmax(vertices @ along)]
    return None

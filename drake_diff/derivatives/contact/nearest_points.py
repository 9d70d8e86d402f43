"""Overlaps of pairs without a sphere, from SceneGraph of the double plant, and the derivatives of their contact points.

There are two methods for the derivative of SceneGraph's results. If SceneGraph returns the deepest points, the
derivative has a closed form. In other cases, SceneGraph is differenced along the motions of the joints between the
shapes: for boxes and cylinders, whose contact point is computed iteratively, and for shapes that lie flat on each
other, as long as only these joints move. If the result jumps to one side, as for two faces in contact, whose deepest
corner depends on rounding, the derivative to the other side is used, on which Drake's step is. If it jumps to both
sides, as at the rim of a cylinder, where the iteration stops at a tolerance, the derivative is not known.

For two overlapping shapes A and B with support functions s_A and s_B, Drake's normal n from B to A minimizes the
overlap s_B(n) + s_A(-n), whose minimum is -phi. Near its deepest point p_A, a shape is described by its flat directions
F and by C = d p / d m, where m is the outward normal. In the shape's frame, the normal remains orthogonal to F and the
point may slide along F. C is 0 at corners and edges, r for a sphere, and r / sin(angle) for the rim of a cylinder, with
the angle between normal and axis. With the twist of A relative to B and the change dn of the normal,

    d p_A = v(p_A) - C_A (dn - w x n) + F_A a,   d p_B = C_B dn + F_B b,   d p_A - d p_B = d(phi n)
    F_A . (dn - w x n) = 0,   F_B . dn = 0,

which determine all unknowns if the smallest overlap is a nondegenerate minimum.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    HalfSpace,
    Mesh,
    ProximityProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix

from drake_diff._base.arrays import Array, skew
from drake_diff.model.model import Model

Flags = NDArray[np.bool_]

KINDS = (Sphere, HalfSpace, Box, Cylinder, Capsule, Ellipsoid, Convex, Mesh)
FLAT = 1e-8  # rounding level of the entries of a normal, a unit vector
SAME_POINT = 1e-9  # [m] tolerance between the points of the closed form and of SceneGraph
DIFFERENCES = (1e-5, 1e-4, 1e-6)  # [m or rad] converged iterations of SceneGraph have an error of 1e-10
SAME_SLOPE = 1e-4  # tolerance between slopes over one and two difference sizes, relative to the largest entry
PROPER = 1e-6  # [m] smallest curvature of the overlap at its minimum; also smallest sine between two flat directions


@dataclass(frozen=True, eq=False)
class Shape:
    """A convex shape at a pose (3, 4) in its body."""

    kind: int  # in KINDS
    size: Array  # (3,) [m] radius, half sizes, semi-axes; or radius and half the length
    vertices: Array  # (V, 3) of a mesh's hull, else empty
    pose: Array

    @classmethod
    def read(cls, inspector: Any, geometry: Any) -> "Shape | None":
        """Read the shape of a geometry, or return None if it is not one of KINDS."""
        shape, size, vertices = inspector.GetShape(geometry), np.zeros(3), np.zeros((0, 3))
        if isinstance(shape, Sphere):
            size[0] = shape.radius()
        elif isinstance(shape, Box):
            size[:] = np.array(shape.size()) / 2
        elif isinstance(shape, Cylinder | Capsule):
            size[:2] = shape.radius(), shape.length() / 2
        elif isinstance(shape, Ellipsoid):
            size[:] = shape.a(), shape.b(), shape.c()
        elif isinstance(shape, Convex | Mesh):
            hull = inspector.GetConvexHull(geometry)
            vertices = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
        elif not isinstance(shape, HalfSpace):
            return None
        return cls(KINDS.index(type(shape)), size, vertices, inspector.GetPoseInFrame(geometry).GetAsMatrix34())

    def feature(self, normal: Array, flat: float) -> "Feature":
        """Return the extreme feature along `normal` (M, 3) in the shape's frame; entries below `flat` count as 0."""
        return _FEATURES[self.kind](self, normal, flat)


@dataclass(frozen=True, eq=False)
class Feature:
    """The extreme vertices, edges or faces of a shape along M normals."""

    point: Array  # (M, 3) an extreme point
    flat: Array  # (M, 3, 2) flat directions F, unit vectors or 0
    curve: Array  # (M, 3, 3) C


def _feature(normal: Array) -> Feature:
    count = len(normal)
    return Feature(np.zeros((count, 3)), np.zeros((count, 3, 2)), np.zeros((count, 3, 3)))


def _round(normal: Array) -> Array:
    """Return 1 - n n' (M, 3, 3)."""
    return np.eye(3) - normal[:, :, None] * normal[:, None, :]


def _sphere(shape: Shape, normal: Array, flat: float) -> Feature:
    radius = shape.size[0]
    return Feature(radius * normal, np.zeros((len(normal), 3, 2)), radius * _round(normal))


def _half_space(shape: Shape, normal: Array, flat: float) -> Feature:
    feature = _feature(normal)
    feature.flat[:] = np.eye(3)[:, :2]
    return feature


def _box(shape: Shape, normal: Array, flat: float) -> Feature:
    feature, zero = _feature(normal), np.abs(normal) < flat
    feature.point[:] = np.where(zero, 0.0, np.sign(normal) * shape.size)
    which, axis = np.nonzero(zero)
    feature.flat[which, axis, np.cumsum(zero, axis=1)[which, axis] - 1] = 1.0
    return feature


def _cylinder(shape: Shape, normal: Array, flat: float) -> Feature:
    feature, (radius, half, _) = _feature(normal), shape.size
    across = np.sqrt((normal[:, :2] ** 2).sum(axis=1))
    cap, side = across < flat, np.abs(normal[:, 2]) < flat
    out = normal[:, :2] / np.where(cap, 1.0, across)[:, None]
    feature.point[:, :2] = np.where(cap[:, None], 0.0, radius * out)
    feature.point[:, 2] = np.where(side, 0.0, np.sign(normal[:, 2]) * half)
    feature.flat[cap] = np.eye(3)[:, :2]
    feature.flat[side, 2, 0] = 1.0
    along = np.stack([-out[:, 1], out[:, 0], np.zeros(len(out))], axis=1)
    feature.curve[:] = (
        along[:, :, None] * along[:, None, :] * np.where(cap, 0.0, radius / np.where(cap, 1.0, across))[:, None, None]
    )
    return feature


def _capsule(shape: Shape, normal: Array, flat: float) -> Feature:
    feature, (radius, half, _) = _feature(normal), shape.size
    side = np.abs(normal[:, 2]) < flat
    feature.point[:] = radius * normal
    feature.point[:, 2] += np.where(side, 0.0, np.sign(normal[:, 2]) * half)
    feature.flat[side, 2, 0] = 1.0
    feature.curve[:] = radius * _round(normal)
    feature.curve[side, 2] = feature.curve[side, :, 2] = 0.0
    return feature


def _ellipsoid(shape: Shape, normal: Array, flat: float) -> Feature:
    feature, square = _feature(normal), shape.size**2
    size = np.sqrt((square * normal**2).sum(axis=1))
    feature.point[:] = square * normal / size[:, None]
    feature.curve[:] = (np.diag(square) - feature.point[:, :, None] * feature.point[:, None, :]) / size[:, None, None]
    return feature


def _mesh(shape: Shape, normal: Array, flat: float) -> Feature:
    feature = _feature(normal)
    heights = normal @ shape.vertices.T
    extent = float(np.max(np.ptp(shape.vertices, axis=0)))
    for i, row in enumerate(heights):
        top = shape.vertices[row >= row.max() - flat * extent]
        feature.point[i] = top.mean(axis=0)
        edges = top[1:] - top[0]
        if len(edges):
            first = edges[np.argmax((edges**2).sum(axis=1))]
            first = first / np.linalg.norm(first)
            rest = edges - np.outer(edges @ first, first)
            second = rest[np.argmax((rest**2).sum(axis=1))]
            size = float(np.linalg.norm(second))
            feature.flat[i, :, 0] = first
            if size > PROPER * extent:
                feature.flat[i, :, 1] = second / size
    return feature


_FEATURES = (_sphere, _half_space, _box, _cylinder, _capsule, _ellipsoid, _mesh, _mesh)


@dataclass(frozen=True, eq=False)
class NearestPointPairs:
    """Q pairs whose contacts are found by SceneGraph."""

    ids: tuple[tuple[Any, Any], ...]
    bodies: tuple[tuple[Any, Any], ...]  # Drake's bodies
    shapes: tuple[tuple[Any, Any], ...]  # Drake's shapes
    known: tuple[tuple[Shape | None, Shape | None], ...]
    scenes: dict[int, "PairScene"]  # made at first use

    def find(self, model: Model) -> list[tuple[int, Array]]:
        """Return the overlapping pairs at the double twin's state, each with its midpoint, normal and phi (7,)."""
        order = {pair: (i, 1.0) for i, pair in enumerate(self.ids)}
        order |= {(b, a): (i, -1.0) for (a, b), (i, _) in order.items()}
        query = model.plant.get_geometry_query_input_port().Eval(model.double.context)
        overlaps = []
        for penetration in query.ComputePointPairPenetration():
            if (penetration.id_A, penetration.id_B) in order:
                i, sign = order[penetration.id_A, penetration.id_B]
                middle = (penetration.p_WCa + penetration.p_WCb) / 2
                overlaps.append((i, np.concatenate([middle, sign * penetration.nhat_BA_W, [-penetration.depth]])))
        return overlaps

    def change(
        self, pair: int, poses: tuple[Array, Array], overlaps: Array, twists: Array
    ) -> tuple[Array, Flags, Flags]:
        """Return `Touches.change` (M, 7, 6) of M overlaps (M, 7), which are known (M,), and which are one-sided (M,).

        The bodies are at `poses` (M, 3, 4) each; `twists` (M, nv, 6) are of the first in the second, at the midpoint.
        """
        a, b = self.known[pair]
        if a is None or b is None:
            return np.zeros((len(overlaps), 7, 6)), *np.zeros((2, len(overlaps)), dtype=bool)
        placed = _times(poses[0], a.pose), _times(poses[1], b.pose)
        change, known = overlap_change(a, b, Overlaps(placed, overlaps[:, :3], overlaps[:, 3:6], overlaps[:, 6]))
        to_one_side = np.zeros(len(overlaps), dtype=bool)
        for k in np.flatnonzero(~known):
            if pair not in self.scenes:
                self.scenes[pair] = PairScene(*self.shapes[pair])
            R, X_a, X_b = placed[1][k, :, :3], RigidTransform(placed[0][k]), RigidTransform(placed[1][k])
            local_twists = np.concatenate([twists[k, :, :3] @ R, twists[k, :, 3:] @ R], axis=1)
            local, to_one_side[k] = self.scenes[pair].change(
                X_b.inverse() @ X_a, local_twists[np.abs(local_twists).max(axis=1) > FLAT]
            )
            if local is not None:
                known[k] = True
                turned = np.concatenate([local[:, :3] @ R.T, local[:, 3:] @ R.T], axis=1)
                change[k] = np.concatenate([R @ turned[:3], R @ turned[3:6], turned[6:]])
        return change, known, to_one_side


def _times(pose: Array, other: Array) -> Array:
    """Return the product (M, 3, 4) of poses (M, 3, 4) and a pose (3, 4)."""
    R = pose[:, :, :3]
    position = (R @ other[:, 3])[..., None] + pose[:, :, 3:]
    return np.concatenate([R @ other[:, :3], position], axis=2)


def read_nearest_point_pairs(model: Model, without: set[tuple[Any, Any]]) -> NearestPointPairs:
    """Read the pairs of `model` that have relative motion and are not in `without`."""
    inspector, plant = model.double.inspector, model.plant
    ids = []
    for pair in sorted(inspector.GetCollisionCandidates()) if inspector is not None else ():
        if not {pair, pair[::-1]} & without and move_apart(model, pair):
            ids.append(pair)
    bodies = tuple(tuple(plant.GetBodyFromFrameId(inspector.GetFrameId(i)) for i in pair) for pair in ids)
    shapes = tuple((inspector.GetShape(a), inspector.GetShape(b)) for a, b in ids)
    known = tuple((Shape.read(inspector, a), Shape.read(inspector, b)) for a, b in ids)
    return NearestPointPairs(tuple(ids), bodies, shapes, known, {})


@dataclass(frozen=True, eq=False)
class Overlaps:
    """M overlaps of two shapes found by Drake, in world."""

    poses: tuple[Array, Array]  # (M, 3, 4) of the shapes A and B
    middle: Array  # (M, 3) midpoint of their deepest points
    normal: Array  # (M, 3) from B to A
    phi: Array  # (M,)


def overlap_change(a: Shape, b: Shape, overlaps: Overlaps) -> tuple[Array, Flags]:
    """Return `Touches.change` (M, 7, 6), and which overlaps (M,) are known, i.e. minimal at Drake's points."""
    n = overlaps.normal
    sides = []
    for shape, pose, out, sign in ((a, overlaps.poses[0], -n, 0.5), (b, overlaps.poses[1], n, -0.5)):
        R = pose[:, :, :3]
        local = (out[:, None, :] @ R)[:, 0]
        feature = shape.feature(local, FLAT)
        point = (R @ feature.point[:, :, None])[..., 0] + pose[:, :, 3]
        flat, curve = R @ feature.flat, R @ feature.curve @ R.swapaxes(-1, -2)
        touching = overlaps.middle + sign * overlaps.phi[:, None] * n
        sides.append((point - touching, flat, curve))
    (off_a, F_a, C_a), (off_b, F_b, C_b) = sides
    tangent = _tangent(n)
    T_t = tangent.swapaxes(-1, -2)
    f_a, f_b = T_t @ F_a, T_t @ F_b
    H = T_t @ (C_a + C_b) @ tangent + overlaps.phi[:, None, None] * np.eye(2)
    left, known = _system(H, f_a, f_b)
    for off, F in ((off_a, F_a), (off_b, F_b)):
        beside = off - (F @ (F.swapaxes(-1, -2) @ off[:, :, None]))[..., 0]
        known &= (np.abs(beside) <= SAME_POINT).all(axis=1)
    turn = -skew(n)  # the matrix of w -> w x n
    at_a = np.zeros((len(n), 3, 6))
    at_a[..., :3], at_a[..., 3:] = np.eye(3), -skew(overlaps.phi[:, None] / 2 * n)
    at_a[..., 3:] += C_a @ turn
    right = np.zeros((len(n), 6, 6))
    right[:, :2] = T_t @ at_a
    right[:, 2:4, 3:] = f_a.swapaxes(-1, -2) @ T_t @ turn
    left[~known] = np.eye(6)
    solution = np.linalg.solve(left, right)
    normal = tangent @ solution[:, :2]
    point_a = at_a - C_a @ normal + F_a @ solution[:, 2:4]
    point_b = C_b @ normal + F_b @ solution[:, 4:]
    change = np.concatenate([(point_a + point_b) / 2, normal, np.zeros((len(n), 1, 6))], axis=1)
    change[:, 6, :3] = n
    return change, known


def _system(H: Array, f_a: Array, f_b: Array) -> tuple[Array, Flags]:
    """Return the matrix (M, 6, 6) for (dn in the tangent plane, a, b), and where (M,) the overlap is a minimum."""
    count = len(H)
    left = np.zeros((count, 6, 6))
    left[:, :2, :2] = H
    left[:, :2, 2:4], left[:, :2, 4:] = -f_a, f_b
    left[:, 2:4, :2], left[:, 4:, :2] = f_a.swapaxes(-1, -2), f_b.swapaxes(-1, -2)
    flats = np.concatenate([f_a, f_b], axis=2)
    used = np.abs(flats).max(axis=1) > 0
    which, column = np.nonzero(~used)
    left[which, 2 + column, 2 + column] = 1.0
    number = used.sum(axis=1)
    gram = flats @ flats.swapaxes(-1, -2)  # (M, 2, 2) of the flat directions
    size, axes = np.linalg.eigh(gram)
    proper = np.zeros(count, dtype=bool)
    proper[number == 0] = np.linalg.eigvalsh(H[number == 0])[:, 0] > PROPER
    free = axes[:, :, 0]  # orthogonal to the single flat direction
    along = (free[:, None, :] @ H @ free[:, :, None])[:, 0, 0]
    proper[number == 1] = along[number == 1] > PROPER
    proper[number == 2] = size[number == 2, 0] > PROPER
    return left, proper


def _same(slope: Array, other: Array, times: float = 1.0) -> bool:
    """Check if two slopes over different widths agree; for one-sided slopes, `times` increases the tolerance."""
    return bool(np.abs(slope - other).max() <= times * SAME_SLOPE * max(1.0, float(np.abs(slope).max())))


def _tangent(normal: Array) -> Array:
    """Return two unit vectors (M, 3, 2) orthogonal to each normal (M, 3) and to each other."""
    other = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, other)
    first /= np.sqrt((first**2).sum(axis=1))[:, None]
    return np.stack([first, np.cross(normal, first)], axis=2)


class PairScene:
    """A SceneGraph with two shapes only, to query their overlap."""

    def __init__(self, a: Any, b: Any) -> None:
        """Register two of Drake's shapes."""
        scene_graph = SceneGraph()
        source = scene_graph.RegisterSource("pair")
        self._frame = scene_graph.RegisterFrame(source, GeometryFrame("a"))
        moving = GeometryInstance(RigidTransform(), a, "a")
        self._a = scene_graph.RegisterGeometry(source, self._frame, moving)
        b = scene_graph.RegisterAnchoredGeometry(source, GeometryInstance(RigidTransform(), b, "b"))
        for geometry in (self._a, b):
            scene_graph.AssignRole(source, geometry, ProximityProperties())
        self._scene_graph, self._context = scene_graph, scene_graph.CreateDefaultContext()
        self._poses, self._port = FramePoseVector(), scene_graph.get_source_pose_port(source)

    def find(self, pose: RigidTransform) -> Array:
        """Return the midpoint, normal and phi (7,) in b's frame, for a at `pose` in it; NaN without overlap."""
        self._poses.set_value(self._frame, pose)
        self._port.FixValue(self._context, self._poses)
        overlaps = self._scene_graph.get_query_output_port().Eval(self._context).ComputePointPairPenetration()
        if not overlaps:
            return np.full(7, np.nan)
        sign = 1.0 if overlaps[0].id_A == self._a else -1.0
        middle = (overlaps[0].p_WCa + overlaps[0].p_WCb) / 2
        return np.concatenate([middle, sign * overlaps[0].nhat_BA_W, [-overlaps[0].depth]])

    def change(self, pose: RigidTransform, twists: Array) -> tuple[Array | None, bool]:
        """Return the derivative (7, 6) in the span of `twists` (K, 6) of a at the midpoint, or None if it is not known.

        It is 0 orthogonal to the span. Also return whether it is one-sided. All quantities are in b's frame. If the
        shapes rotate about one direction only, the position of the contact along this direction is irrelevant. Its
        derivative is set to 0, also if SceneGraph's result depends on rounding, as for a face and a cylinder.
        """
        here = self.find(pose)
        _, sizes, directions = np.linalg.svd(twists, full_matrices=False)
        change, matters = np.zeros((7, 6)), np.eye(7)
        _, turns, axes = np.linalg.svd(twists[:, 3:], full_matrices=True)
        if not (turns[1:] > FLAT * max(1.0, float(turns[0]))).any():
            matters[:3, :3] -= np.outer(axes[0], axes[0])
        to_one_side = False
        for direction in directions[sizes > SAME_SLOPE * max(1.0, float(sizes[0]))]:
            slope, sided = self._slope(pose, here, direction, matters)
            if slope is None:
                return None, False
            to_one_side |= sided
            change += slope[:, None] * direction
        return change, to_one_side

    def _slope(self, pose: RigidTransform, here: Array, direction: Array, matters: Array) -> tuple[Array | None, bool]:
        """Return the derivative (7,) along a direction, central or, if the result jumps on one side, one-sided."""
        for d in DIFFERENCES:
            near, far = (
                {
                    sign: matters @ (self._moved(pose, here, sign * e * direction) - here) / (sign * e)
                    for sign in (1, -1)
                }
                for e in (d, 2 * d)
            )
            if _same(both := (near[1] + near[-1]) / 2, (far[1] + far[-1]) / 2) and _same(near[1], near[-1], 1e2):
                return both, False
            stays = [2 * near[sign] - far[sign] for sign in (1, -1) if _same(near[sign], far[sign])]
            if len(stays) == 1:
                return stays[0], True
        return None, False

    def _moved(self, pose: RigidTransform, here: Array, motion: Array) -> Array:
        """Return SceneGraph's result after a small motion (6,) of a about the midpoint."""
        angle = float(np.linalg.norm(motion[3:]))
        R = RotationMatrix(AngleAxis(angle, motion[3:] / angle)) if angle else RotationMatrix()
        position = R @ (pose.translation() - here[:3]) + here[:3] + motion[:3]
        return self.find(RigidTransform(R @ pose.rotation(), position))


def move_apart(model: Model, pair: tuple[Any, Any]) -> bool:
    """Check if two geometries are on bodies that are not welded together. Contact of welded bodies has no effect."""
    plant, inspector = model.plant, model.double.inspector
    body, other = (plant.GetBodyFromFrameId(inspector.GetFrameId(i)) for i in pair)
    return all(welded.index() != body.index() for welded in plant.GetBodiesWeldedTo(other))

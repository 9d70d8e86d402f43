"""Spheres and capsules that contain the shapes of a robot's bodies, for clearance constraints.

The cover contains a body's collision shapes, or its illustration shapes if it has no collision shapes. Spheres and
capsules are used unchanged. Other shapes are enclosed by a few capsules. A body without shapes gets capsules from its
joint to the next joints, called a skeleton. A skeleton is not certain to contain the body, and is reported.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, HalfSpace, Mesh, Role, Sphere
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array, Indices
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.forward_kinematics import ForwardKinematics
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, joints, labelled
from drake_diff.model.triangles import read_mesh, scaled

MOST_STRIPS = 4  # maximum number of parallel capsules that cover a box
MOST_SLABS = 4  # maximum number of slabs along the axis of a hull or a mesh
DRAKES_OWN = (".vtk", ".gltf")  # mesh formats that only Drake reads; the convex hull is used
WHOLE_SHAPES: dict[str, Any] = {"contact": True, "contact_geometry": None, "meshes": "convex"}  # options of load_model
WORTH_A_SLAB = 0.8  # another slab must reduce the volume to this fraction or less
CYLINDER_PART = 0.5  # the segment ends this fraction of a cylinder's radius before its ends; 12 % sideways excess
BONE_PART, BONE_RADII = 0.2, (0.01, 0.06)  # radius of a skeleton's capsule: fraction of its length, and limits [m]
ROUNDING = 1e-9  # [m] added to a radius that is computed from corners
WAYS = np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(0).standard_normal((114, 3))])  # search directions
Around = tuple[Array, Array, float]  # the start, end and radius of a capsule


@dataclass(frozen=True, eq=False)
class Piece:
    """A capsule of `radius` [m] around the segment from `start` to `end` (3,) [m]; a sphere if both are equal."""

    body: str
    link: int  # index of the link in the ForwardKinematics, -1 for the world
    start: Array  # in the link's frame
    end: Array
    radius: float
    source: str  # the type of the covered shape, such as "box", or "skeleton"

    @property
    def squared(self) -> float:
        """The squared length of the segment [m^2]."""
        return float(np.sum((self.end - self.start) ** 2))


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape of a body, and the pieces that contain it."""

    body: str
    link: int
    pieces: tuple[Piece, ...]
    geometry: Any  # Drake's geometry id in `with_collision_shapes`; None for an illustration shape or a skeleton

    @property
    def is_round(self) -> bool:
        """Whether the piece is identical to the shape."""
        return self.pieces[0].source in ("sphere", "capsule")

    @property
    def corners(self) -> Array:
        """The corners (8, 3) of a bounding box in the link's frame."""
        ends = np.array([(p.start, p.end) for p in self.pieces])
        radii = np.array([p.radius for p in self.pieces])[:, None, None]
        low, high = np.min(ends - radii, axis=(0, 1)), np.max(ends + radii, axis=(0, 1))
        return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, 8).T


@dataclass(frozen=True)
class Cover:
    """The shapes of all bodies. `bare` are bodies without shapes; `doubts` describe what the pieces may not contain."""

    solids: tuple[Solid, ...]
    bare: tuple[str, ...]
    doubts: tuple[str, ...]

    @property
    def pieces(self) -> tuple[Piece, ...]:
        return tuple(piece for solid in self.solids for piece in solid.pieces)


def cover_of(model: Model, kinematics: ForwardKinematics) -> Cover:
    """Return the cover of the shapes of `model`."""
    return model.cache("cover", lambda: _cover(model, kinematics))


def _cover(model: Model, kinematics: ForwardKinematics) -> Cover:
    whole, solids, bare, unread = with_collision_shapes(model), list[Solid](), list[str](), list[str]()
    inspector = whole.double.inspector
    for label, body in labelled(bodies(whole.plant)).items():
        link, pose = kinematics.on[label]
        shapes = [] if inspector is None else list(_of_shapes(whole, inspector, body, unread))
        for geometry, pieces in shapes or [(None, [bone]) for bone in _skeleton(whole, body)]:
            placed = (replace(p, body=label, link=link, start=pose @ p.start, end=pose @ p.end) for p in pieces)
            solids.append(Solid(label, link, tuple(placed), geometry))
    for number, rigid in enumerate(kinematics.links):
        if number not in kinematics.between and all(solid.link != number for solid in solids):
            bare.append(rigid.joint.body)
    doubts = _doubts([piece for solid in solids for piece in solid.pieces], bare)
    return Cover(tuple(solids), tuple(bare), (*unread, *doubts))


def with_collision_shapes(model: Model) -> Model:
    """Rebuild the model with the shapes of its file, as its contact geometry may be smaller spheres or disabled.

    A model made from a user's diagram is returned unchanged.
    """
    return model.changed(**WHOLE_SHAPES) if model.can_rebuild else model


def _doubts(pieces: Sequence[Piece], bare: Sequence[str]) -> Iterator[str]:
    names = dict.fromkeys(p.body for p in pieces)
    bones = [b for b in names if any(p.body == b and p.source == "skeleton" for p in pieces)]
    if bones:
        radii = [p.radius for p in pieces if p.source == "skeleton"]
        yield (
            f"{', '.join(bones)}: no readable shape, represented by capsules from joint to joint, of radius "
            f"{min(radii):.3g} to {max(radii):.3g} m"
        )
    if bare:
        yield f"{', '.join(bare)}: not part of the clearance, as there is no shape, no mass and no next joint"


def _of_shapes(model: Model, inspector: Any, body: Any, unread: list[str]) -> Iterator[tuple[Any, list[Piece]]]:
    """Yield the body's collision shapes, or else its illustration shapes, with their pieces in the body's frame.

    A message is added to `unread` if the shapes of one of these roles cannot be read.
    """
    frame = model.plant.GetBodyFrameIdIfExists(body.index())
    if frame is None:
        return
    for role in (Role.kProximity, Role.kIllustration):
        geometries = inspector.GetGeometries(frame, role)
        try:
            around = [(g, list(_around(inspector.GetShape(g), inspector.GetPoseInFrame(g)))) for g in geometries]
        except (ModelError, RuntimeError) as error:
            kind = "collision shapes" if role == Role.kProximity else "drawn shapes"
            unread.append(f"{body.name()}: its {kind} cannot be read ({error}) and are replaced by other shapes")
            continue
        shapes = [(g if role == Role.kProximity else None, pieces) for g, pieces in around if pieces]
        if shapes:
            yield from shapes
            return


def _around(shape: Any, pose: RigidTransform) -> Iterator[Piece]:
    """Yield the pieces that contain a shape at `pose`; a half space is not part of a robot and gives no piece."""
    if isinstance(shape, HalfSpace):
        return
    for start, end, radius in pieces_around(shape):
        yield Piece("", -1, pose @ start, pose @ end, radius, type(shape).__name__.lower())


def pieces_around(shape: Any) -> list[Around]:
    """Return capsules (start, end, radius) that contain a shape."""
    z = np.array([0.0, 0.0, 1.0])
    if isinstance(shape, Sphere):
        return [(np.zeros(3), np.zeros(3), shape.radius())]
    if isinstance(shape, Capsule):
        return [(-shape.length() / 2 * z, shape.length() / 2 * z, shape.radius())]
    if isinstance(shape, Cylinder):
        half, short = shape.length() / 2, min(shape.length() / 2, CYLINDER_PART * shape.radius())
        return [((short - half) * z, (half - short) * z, float(np.hypot(shape.radius(), short)))]
    if isinstance(shape, Box):
        return _around_box(np.asarray(shape.size()))
    if isinstance(shape, Ellipsoid):  # a capsule with the second semi-axis as radius contains the sharper tips
        axes = np.array([shape.a(), shape.b(), shape.c()])
        longest = int(np.argmax(axes))
        radius = float(np.max(np.delete(axes, longest)))
        end = (axes[longest] - radius) * np.eye(3)[longest]
        return [(-end, end, radius)]
    if isinstance(shape, (Mesh, Convex)):
        return around_mesh(*_surface(shape))
    raise ModelError(f"shape {type(shape).__name__}: expected a shape of Drake's file formats")


def _around_box(size: Array) -> list[Around]:
    """Return capsules along the longest edge; their number grows with the ratio of the second to the third edge."""
    c, b, a = np.argsort(size)
    count = int(np.clip(np.ceil(size[b] / max(size[c], 1e-12) / 1.5), 1, MOST_STRIPS))
    corner, short = np.hypot(size[b] / count, size[c]) / 2, size[c] / 2
    radius, end = float(np.hypot(corner, short)) + ROUNDING, (size[a] / 2 - short) * np.eye(3)[a]
    places = ((np.arange(count) + 0.5) / count - 0.5) * size[b]
    return [(offset * np.eye(3)[b] - end, offset * np.eye(3)[b] + end, radius) for offset in places]


def _surface(shape: Any) -> tuple[Array, Indices]:
    """Return the vertices (n, 3) [m] and edges (e, 2) of a mesh, or of its hull if only Drake can read the shape."""
    source = shape.source() if isinstance(shape, Mesh) else None
    if source is not None and source.is_path() and source.extension() not in DRAKES_OWN:
        mesh = scaled(read_mesh(Path(source.path())), shape.scale3())
        return mesh.vertices, sides_of(np.asarray(mesh.faces, dtype=np.intp))
    hull = shape.GetConvexHull()
    faces = [
        [hull.element(i).vertex(j) for j in range(hull.element(i).num_vertices())] for i in range(hull.num_faces())
    ]
    around = [(a, b) for face in faces for a, b in zip(face, [*face[1:], face[0]], strict=True)]
    return np.array([hull.vertex(i) for i in range(hull.num_vertices())]), np.array(around, dtype=np.intp)


def sides_of(triangles: Indices) -> Indices:
    """Return the two vertices (3 m, 2) of each edge of triangles (m, 3)."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def around_mesh(corners: Array, sides: Indices) -> list[Around]:
    """Return capsules along the longest axis that contain a surface with vertices (n, 3) and edges `sides` (e, 2)."""
    used = corners[np.unique(sides)]
    axis = np.linalg.svd(used - np.mean(used, axis=0), full_matrices=False)[2][0]
    best: list[Around] = []
    for count in range(1, MOST_SLABS + 1):
        capsules = [_around_slab(slab) for slab in _slabs(used, corners[sides], axis, count)]
        if best and _volume(capsules) > WORTH_A_SLAB * _volume(best):
            break
        best = capsules
    return best


def _volume(pieces: Sequence[Around]) -> float:
    return sum(np.pi * r**2 * (float(np.linalg.norm(b - a)) + 4 / 3 * r) for a, b, r in pieces)


def _slabs(corners: Array, sides: Array, axis: Array, count: int) -> list[Array]:
    """Cut a surface across `axis` into `count` slabs; return each slab's vertices and the cut points of its edges.

    The edges are `sides` (e, 2, 3). The convex hulls of the slabs contain the interior of the surface.
    """
    heights, ends = corners @ axis, sides @ axis
    slabs = []
    for low, high in pairwise(np.linspace(np.min(heights), np.max(heights), count + 1)):
        points = [corners[(heights >= low) & (heights <= high)]]
        for level in (low, high):
            across = (ends[:, 0] - level) * (ends[:, 1] - level) < 0
            share = (level - ends[across, 0]) / (ends[across, 1] - ends[across, 0])
            points.append(sides[across, 0] + share[:, None] * (sides[across, 1] - sides[across, 0]))
        slabs.append(np.vstack(points))
    return [slab for slab in slabs if len(slab)]


def _around_slab(points: Array) -> Around:
    """Return the capsule of least volume, among candidate axes, that contains `points`."""
    outer = points[np.unique(np.argmax(points @ WAYS.T, axis=0))]
    turned = np.linalg.svd(outer - np.mean(outer, axis=0), full_matrices=False)[2]
    tried = [_capsule_along(outer, axis) for axis in (*np.eye(3), *turned)]
    start, end, _ = min(tried, key=lambda capsule: _volume([capsule]))
    return start, end, _radius(start, end, points)


def _capsule_along(points: Array, axis: Array) -> Around:
    """Return a capsule along `axis` that contains `points` (P, 3)."""
    across = np.linalg.svd(axis[None])[2][1:]  # (2, 3)
    flat, heights = points @ across.T, points @ axis
    middle = _circle(flat)
    off = np.linalg.norm(flat - middle, axis=1)
    spare = np.sqrt(np.maximum(np.max(off) ** 2 - off**2, 0.0))  # scalar and array powers may round differently
    low, high = float(np.min(heights + spare)), float(np.max(heights - spare))
    if low > high:  # a sphere with its centre anywhere in between contains all points
        low = high = (low + high) / 2
    start, end = (middle @ across + height * axis for height in (low, high))
    return start, end, _radius(start, end, points)


def _radius(start: Array, end: Array, points: Array) -> float:
    """Return the radius [m] of the capsule around a segment that contains `points` (P, 3)."""
    way = end - start
    share = np.clip((points - start) @ way / max(float(way @ way), 1e-300), 0, 1)
    return float(np.max(np.linalg.norm(points - start - share[:, None] * way, axis=1))) + ROUNDING


def _circle(points: Array) -> Array:
    """Approximate the centre (2,) of the smallest circle around `points` (P, 2), by shrinking steps to the farthest."""
    center = (np.min(points, axis=0) + np.max(points, axis=0)) / 2
    for k in range(1, 101):  # Badoiu and Clarkson (2003)
        far = points[int(np.argmax(np.sum((points - center) ** 2, axis=1)))]
        center = center + (far - center) / (k + 1)
    return np.asarray(center)


def _skeleton(model: Model, body: Any) -> Iterator[Piece]:
    """Yield capsules from a body's joint to its child joints, or to its centre of mass, in the body's frame.

    A body fixed to the world, and a frame without mass and child joints, have no capsules.
    """
    if model.plant.IsAnchored(body):
        return
    start, ends = np.zeros(3), []
    for joint in joints(model.plant):
        if joint.child_body().index() == body.index():
            start = joint.frame_on_child().GetFixedPoseInBodyFrame().translation()
        elif joint.parent_body().index() == body.index():
            ends.append(joint.frame_on_parent().GetFixedPoseInBodyFrame().translation())
    ends = [end for end in ends if np.linalg.norm(end - start) > ROUNDING]
    if not ends and body.default_mass() > 0:
        ends = [np.asarray(body.default_com())]
    for end in ends:
        radius = float(np.clip(BONE_PART * np.linalg.norm(end - start), *BONE_RADII))
        yield Piece("", -1, start, end, radius, "skeleton")

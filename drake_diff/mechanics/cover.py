"""What of a robot keeps clear of things: spheres and capsules that contain the shapes of its bodies.

A body's collision shapes are covered, or those that are only drawn where it has none. A sphere and a capsule are taken
as they are. Of other shapes a few capsules contain all. A body without any shape gets capsules from its joint to the
next ones, a skeleton: that contains nothing for certain, and is told.
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

MOST_STRIPS = 4  # side by side, that cover a box
MOST_SLABS = 4  # one after the other, that cover a hull or a mesh
DRAKES_OWN = (".vtk", ".gltf")  # meshes that Drake alone reads: their hull is taken
WHOLE_SHAPES: dict[str, Any] = {"contact": True, "contact_geometry": None, "meshes": "convex"}  # options of load_model
WORTH_A_SLAB = 0.8  # of the volume: more slabs have to save that much
CYLINDER_PART = 0.5  # of a cylinder's radius: how far before its ends a segment ends; it sticks out sideways by 12 %
BONE_PART, BONE_RADII = 0.2, (0.01, 0.06)  # of its length, and the limits [m]: the radius of a skeleton's capsule
ROUNDING = 1e-9  # [m] added to a radius that is computed from corners
WAYS = np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(0).standard_normal((114, 3))])  # whose farthest points
Around = tuple[Array, Array, float]  # the start, end and radius of a capsule


@dataclass(frozen=True, eq=False)
class Piece:
    """A capsule of a `radius` [m] around the segment from `start` to `end` (3,) [m]; a sphere where they are one."""

    body: str
    link: int  # its place among the links of its ForwardKinematics, -1 for the world
    start: Array  # in the link's frame
    end: Array
    radius: float
    source: str  # the shape that it covers, such as "box", or "skeleton"

    @property
    def squared(self) -> float:
        """[m^2] the segment's length, squared."""
        return float(np.sum((self.end - self.start) ** 2))


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape of a body, and the pieces that contain it."""

    body: str
    link: int
    pieces: tuple[Piece, ...]
    geometry: Any  # Drake's, in `with_collision_shapes`; None of a shape that is only drawn and of a skeleton

    @property
    def is_round(self) -> bool:
        """Whether its piece is the shape."""
        return self.pieces[0].source in ("sphere", "capsule")

    @property
    def corners(self) -> Array:
        """(8, 3) of a box in the link's frame that contains it."""
        ends = np.array([(p.start, p.end) for p in self.pieces])
        radii = np.array([p.radius for p in self.pieces])[:, None, None]
        low, high = np.min(ends - radii, axis=(0, 1)), np.max(ends + radii, axis=(0, 1))
        return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, 8).T


@dataclass(frozen=True)
class Cover:
    """The shapes of all bodies; `bare` are bodies that have none, `doubts` say what the pieces may not contain."""

    solids: tuple[Solid, ...]
    bare: tuple[str, ...]
    doubts: tuple[str, ...]

    @property
    def pieces(self) -> tuple[Piece, ...]:
        return tuple(piece for solid in self.solids for piece in solid.pieces)


def cover_of(model: Model, kinematics: ForwardKinematics) -> Cover:
    """The cover of the shapes that `model` has."""
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
    """The model with the shapes that its file gives: what it touches with may be spheres inside them, or nothing.

    A user's diagram has what it has.
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
        yield f"{', '.join(bare)}: no shape, no mass and no next joint, and no clearance"


def _of_shapes(model: Model, inspector: Any, body: Any, unread: list[str]) -> Iterator[tuple[Any, list[Piece]]]:
    """The body's collision shapes, or those that are drawn where there are none, and their pieces in its frame.

    A sentence is added to `unread` where shapes of a kind cannot be read.
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
            unread.append(f"{body.name()}: its {kind} cannot be read ({error}) and are replaced by others")
            continue
        shapes = [(g if role == Role.kProximity else None, pieces) for g, pieces in around if pieces]
        if shapes:
            yield from shapes
            return


def _around(shape: Any, pose: RigidTransform) -> Iterator[Piece]:
    """The pieces that contain a shape at `pose`; none of a half space, which no robot is made of."""
    if isinstance(shape, HalfSpace):
        return
    for start, end, radius in pieces_around(shape):
        yield Piece("", -1, pose @ start, pose @ end, radius, type(shape).__name__.lower())


def pieces_around(shape: Any) -> list[Around]:
    """Capsules (start, end, radius) that contain a shape."""
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
    if isinstance(shape, Ellipsoid):  # a capsule of the second axis, whose curvature at the tips is less
        axes = np.array([shape.a(), shape.b(), shape.c()])
        longest = int(np.argmax(axes))
        radius = float(np.max(np.delete(axes, longest)))
        end = (axes[longest] - radius) * np.eye(3)[longest]
        return [(-end, end, radius)]
    if isinstance(shape, (Mesh, Convex)):
        return around_mesh(*_surface(shape))
    raise ModelError(f"shape {type(shape).__name__}: expected one that Drake's files can have")


def _around_box(size: Array) -> list[Around]:
    """Capsules along the longest edge, as many side by side as the second is longer than the third."""
    c, b, a = np.argsort(size)
    count = int(np.clip(np.ceil(size[b] / max(size[c], 1e-12) / 1.5), 1, MOST_STRIPS))
    corner, short = np.hypot(size[b] / count, size[c]) / 2, size[c] / 2
    radius, end = float(np.hypot(corner, short)) + ROUNDING, (size[a] / 2 - short) * np.eye(3)[a]
    places = ((np.arange(count) + 0.5) / count - 0.5) * size[b]
    return [(offset * np.eye(3)[b] - end, offset * np.eye(3)[b] + end, radius) for offset in places]


def _surface(shape: Any) -> tuple[Array, Indices]:
    """Corners (n, 3) [m] of a mesh and its sides (e, 2), or those of the hull where Drake alone has the shape."""
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
    """(3 m, 2) the two corners of each side of triangles (m, 3)."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def around_mesh(corners: Array, sides: Indices) -> list[Around]:
    """Capsules that contain a body whose surface has these corners (n, 3) and sides (e, 2), along its longest way."""
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
    """A surface cut across `axis` into `count` slabs: the corners (n, 3) of each, and where `sides` (e, 2, 3) are cut.

    What is inside a surface is, slab by slab, within the hulls of these.
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
    """The slimmest of some capsules that contain `points`."""
    outer = points[np.unique(np.argmax(points @ WAYS.T, axis=0))]
    turned = np.linalg.svd(outer - np.mean(outer, axis=0), full_matrices=False)[2]
    tried = [_capsule_along(outer, axis) for axis in (*np.eye(3), *turned)]
    start, end, _ = min(tried, key=lambda capsule: _volume([capsule]))
    return start, end, _radius(start, end, points)


def _capsule_along(points: Array, axis: Array) -> Around:
    """A capsule along `axis` that contains `points` (P, 3)."""
    across = np.linalg.svd(axis[None])[2][1:]  # (2, 3)
    flat, heights = points @ across.T, points @ axis
    middle = _circle(flat)
    off = np.linalg.norm(flat - middle, axis=1)
    spare = np.sqrt(np.maximum(np.max(off) ** 2 - off**2, 0.0))  # powers of one number and of arrays round apart
    low, high = float(np.min(heights + spare)), float(np.max(heights - spare))
    if low > high:  # a sphere: its centre anywhere in between contains all
        low = high = (low + high) / 2
    start, end = (middle @ across + height * axis for height in (low, high))
    return start, end, _radius(start, end, points)


def _radius(start: Array, end: Array, points: Array) -> float:
    """[m] that of the capsule around a segment that contains `points` (P, 3)."""
    way = end - start
    share = np.clip((points - start) @ way / max(float(way @ way), 1e-300), 0, 1)
    return float(np.max(np.linalg.norm(points - start - share[:, None] * way, axis=1))) + ROUNDING


def _circle(points: Array) -> Array:
    """(2,) nearly the centre of the smallest circle around `points` (P, 2): steps to the farthest, ever shorter."""
    center = (np.min(points, axis=0) + np.max(points, axis=0)) / 2
    for k in range(1, 101):  # Badoiu and Clarkson (2003)
        far = points[int(np.argmax(np.sum((points - center) ** 2, axis=1)))]
        center = center + (far - center) / (k + 1)
    return np.asarray(center)


def _skeleton(model: Model, body: Any) -> Iterator[Piece]:
    """Capsules from where a body is carried to the joints that it carries, or to its centre of mass, in its frame.

    None of a body that the world carries, and none of a frame: no mass and nothing to carry.
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

"""The displayed shapes of a robot: its visuals, meshes with fewer faces, or a skeleton if it has no geometries."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, HalfSpace, Mesh, Rgba, Role, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError
from drake_diff.model.plant import joints
from drake_diff.model.triangles import READ_BY_TRIMESH, Triangles, read_mesh, scaled, with_fewer_faces

DRAWN = (Box, Capsule, Convex, Cylinder, Ellipsoid, HalfSpace, Mesh, Sphere, Triangles)
GREY = Rgba(0.6, 0.6, 0.62, 1)
BONE, JOINT = Rgba(0.72, 0.72, 0.74, 1), Rgba(0.33, 0.42, 0.55, 1)  # of a skeleton
BALL = 0.05  # [m] radius of the ball that represents a body of a robot without a size
MOST_FACES = 30_000  # of all meshes of a robot, which is about 0.7 MB of a page
BONE_PART, JOINT_PART = 0.008, 0.014  # radii of a skeleton's bones and joints, relative to the robot's size
SHORTEST_BONE = 0.01  # relative to the robot's size
ROLES = (Role.kIllustration, Role.kProximity)

MeshFile = tuple[Path, tuple[float, float, float], int, int]  # with its scale, modification time [ns] and size [bytes]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A shape on the body with path `body`, or in the world for ""; `centre` and `radius` [m] are a ball around it.

    If `origin` (3,) [m], a point on the body, is given, `pose` is relative to it and along the world's axes. A shape
    with `above` is drawn in front of everything else.
    """

    body: str
    shape: Any
    pose: RigidTransform
    colour: Rgba
    centre: Array
    radius: float
    origin: Array | None = None
    above: bool = False


def shapes_of(plant: Any, context: Any, drawn: Sequence[Any]) -> list[Drawn]:
    """Return the shapes of the world and of the bodies `drawn`, with a skeleton for bodies without shapes."""
    port = plant.get_geometry_query_input_port()
    result: dict[int, list[Drawn]] = {}
    if port.HasValue(context):
        inspector = port.Eval(context).inspector()
        frames = [(body, plant.GetBodyFrameIdIfExists(body.index())) for body in [plant.world_body(), *drawn]]
        looks = _Looks(inspector, [frame for _, frame in frames if frame is not None])
        for body, frame in frames:
            if frame is not None:
                result[int(body.index())] = looks.on(frame, body_path(body))
    bare = [body for body in drawn if not result.get(int(body.index()))]
    result |= _skeleton(plant, context, drawn, bare)
    shapes = []
    for body in [plant.world_body(), *drawn]:
        on_it = result.get(int(body.index()), [])
        if plant.IsAnchored(body):
            pose = plant.EvalBodyPoseInWorld(context, body)
            on_it = [replace(s, body="", pose=pose @ s.pose, centre=pose @ s.centre) for s in on_it]
        shapes += on_it
    return shapes


class _Looks:
    """The appearance of geometries on some frames; all mesh files are read together and share a number of faces."""

    def __init__(self, inspector: Any, frames: Sequence[Any]):
        self._inspector = inspector
        files = {
            self._file(g): None for frame in frames for role in ROLES for g in inspector.GetGeometries(frame, role)
        }
        wanted = tuple(file for file in files if file is not None)
        self._meshes = dict(zip(wanted, _read_together(wanted), strict=True))

    def on(self, frame: Any, path: str) -> list[Drawn]:
        """Return the illustration geometries of a frame, or its proximity geometries if it has none."""
        for role in ROLES:
            looks = (self._drawn(geometry, role, path) for geometry in self._inspector.GetGeometries(frame, role))
            result = [d for d in looks if d is not None and isinstance(d.shape, DRAWN)]
            if result:
                return result
        return []

    def _file(self, geometry: Any) -> MeshFile | None:
        """Return the mesh file of a geometry if trimesh can read it."""
        shape = self._inspector.GetShape(geometry)
        if not isinstance(shape, Mesh) or not shape.source().is_path() or shape.extension() not in READ_BY_TRIMESH:
            return None
        x, y, z = (float(factor) for factor in shape.scale3())
        try:
            state = shape.source().path().stat()
        except OSError:
            return None
        return shape.source().path(), (x, y, z), state.st_mtime_ns, state.st_size

    def _drawn(self, geometry: Any, role: Role, path: str) -> Drawn | None:
        """Return the drawing of a geometry, or None if its mesh cannot be read."""
        colour, pose = GREY, self._inspector.GetPoseInFrame(geometry)
        if role == Role.kIllustration:
            properties = self._inspector.GetIllustrationProperties(geometry)
            colour = properties.GetPropertyOrDefault("phong", "diffuse", GREY)
        file = self._file(geometry)
        if file is not None:
            mesh = self._meshes[file]
            if mesh is None:
                return None
            low, high = np.min(mesh.vertices, axis=0), np.max(mesh.vertices, axis=0)
            return Drawn(path, mesh, pose, colour, pose @ ((low + high) / 2), float(np.linalg.norm(high - low)) / 2)
        try:
            box = self._inspector.GetObbInGeometryFrame(geometry)
        except RuntimeError:  # a mesh is read at its first use
            return None
        centre = pose.translation() if box is None else pose @ box.pose().translation()
        radius = 0.0 if box is None else float(np.linalg.norm(box.half_width()))
        return Drawn(path, self._inspector.GetShape(geometry), pose, colour, np.asarray(centre), radius)


@lru_cache(maxsize=4)  # a run is drawn when it is saved and again when it is verified
def _read_together(files: tuple[MeshFile, ...]) -> tuple[Triangles | None, ...]:
    """Read the meshes of a robot, with MOST_FACES faces together; None for a file that cannot be read."""
    result: list[Triangles | None] = []
    for path, scale, *_ in files:
        try:
            result.append(scaled(read_mesh(path), scale))
        except ModelError:
            result.append(None)
    fewer = iter(with_fewer_faces([mesh for mesh in result if mesh is not None], MOST_FACES))
    return tuple(None if mesh is None else next(fewer) for mesh in result)


def _skeleton(plant: Any, context: Any, drawn: Sequence[Any], bare: Sequence[Any]) -> dict[int, list[Drawn]]:
    """Return bones and joints for each of the bodies `bare`, by index: from its joint to the next, or to its mass.

    Bodies with neither mass nor descendants (frames of tools and cameras) get nothing, unless nothing else is visible.
    """
    if not bare:
        return {}
    places = [plant.EvalBodyPoseInWorld(context, body).translation() for body in drawn]
    size = float(np.linalg.norm(np.ptp(places, axis=0))) or BALL / JOINT_PART
    tree = [(j, int(j.parent_body().index()), int(j.child_body().index())) for j in joints(plant)]
    without = {int(body.index()) for body in bare}
    seen = {int(b.index()) for b in drawn if int(b.index()) not in without or b.default_mass() > 0}
    for _ in tree:  # repeated up to the root, since the joints may be in any order
        behind = {parent for _, parent, child in tree if child in seen}
        if behind <= seen:
            break
        seen |= behind
    result = {}
    for body in [b for b in bare if int(b.index()) in seen] or bare:
        index, path = int(body.index()), body_path(body)
        start = next((_origin(j.frame_on_child(), context) for j, _, child in tree if child == index), np.zeros(3))
        ends = [_origin(j.frame_on_parent(), context) for j, parent, c in tree if parent == index and c in seen]
        if not ends and body.default_mass() > 0:
            ends = [np.asarray(body.default_com())]
        ends = [end for end in ends if np.linalg.norm(end - start) > SHORTEST_BONE * size]
        result[index] = [_bone(path, start, end, BONE_PART * size) for end in ends]
        result[index] += [ball(path, position, JOINT_PART * size, JOINT) for position in (start, *ends)]
    return result


def _origin(frame: Any, context: Any) -> Array:
    """Return the position (3,) of a frame on its body."""
    return np.asarray(frame.CalcPoseInBodyFrame(context).translation())


def _bone(path: str, start: Array, end: Array, radius: float) -> Drawn:
    along, middle = end - start, (start + end) / 2
    length = float(np.linalg.norm(along))
    pose = RigidTransform(RotationMatrix.MakeFromOneVector(along / length, 2), middle)
    return Drawn(path, Cylinder(radius, length), pose, BONE, middle, length / 2)


def ball(path: str, centre: ArrayLike = (0.0, 0.0, 0.0), radius: float = BALL, colour: Rgba = GREY) -> Drawn:
    """Return a ball at `centre` (3,) [m] on a body, by default one that represents an unknown body."""
    position = np.asarray(centre, dtype=float)
    return Drawn(path, Sphere(radius), RigidTransform(position), colour, position, radius)


def body_path(body: Any) -> str:
    """Return the Meshcat path of a body."""
    return meshcat_path(int(body.index()), body.name())


def meshcat_path(index: int, name: str) -> str:
    """Return a Meshcat path that is safe for any name; the index makes it unique."""
    return f"{index}_" + re.sub(r"[^A-Za-z0-9_.-]", "_", name)

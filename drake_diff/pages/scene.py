"""What is seen of a motion: shapes on bodies, where the bodies are over time, what pushes, and from where to look."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Mesh,
    Rgba,
    Role,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.tree import FrameIndex

from drake_diff._base.arrays import Array
from drake_diff.exceptions import UnknownNameError
from drake_diff.model.contact import ContactPoint
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies
from drake_diff.model.step import set_state

DRAWN = (Box, Capsule, Convex, Cylinder, Ellipsoid, HalfSpace, Mesh, Sphere)
GREY, BLUE = Rgba(0.6, 0.6, 0.62, 1), Rgba(0.15, 0.4, 0.95, 0.3)
LOOKED_AT = 60  # poses of a motion that its bounding box is taken from
ARROW_PART = 0.2  # of the scene's size: how long the arrow of `Scene.reference_force` is
SMALLEST_SIZE = 0.3  # [m] less is not zoomed in to

Poses = Mapping[str, Sequence[RigidTransform]]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A shape on a body, or in the world where `body` is "": pose, colour, and a ball around it, centre and radius."""

    body: str
    shape: Any
    pose: RigidTransform
    colour: Rgba
    centre: Array
    radius: float


@dataclass(frozen=True)
class Push:
    """A contact force (3,) [N] at a point (3,) [m], in the world frame."""

    point: Array
    force: Array


@dataclass(frozen=True)
class Ghost:
    """Another motion of the same bodies at the same times, translucent; `name` is a path of Meshcat.

    One that is not `framed` may leave the picture.
    """

    name: str
    poses: Poses
    colour: Rgba
    framed: bool = True


@dataclass(frozen=True, eq=False)
class Scene:
    """A motion to be drawn: `poses` of every moving body at `times` (N+1,) [s], `pushes` of each of the N steps.

    `trail` (N+1, 3) [m] is the way of the point that is followed.
    """

    shapes: tuple[Drawn, ...]
    times: Array
    poses: Poses
    ghosts: tuple[Ghost, ...]
    pushes: tuple[tuple[Push, ...], ...]
    trail: Array

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """The lowest and highest corner (3,) of the box that holds the motion and the framed ghosts."""
        lows, highs = [np.min(self.trail, axis=0)], [np.max(self.trail, axis=0)]
        for drawn in self.shapes:
            for poses in (
                motion.get(drawn.body, ()) for motion in (self.poses, *(g.poses for g in self.ghosts if g.framed))
            ):
                for pose in poses[:: max(1, len(poses) // LOOKED_AT)]:
                    centre = pose @ drawn.centre
                    lows.append(centre - drawn.radius)
                    highs.append(centre + drawn.radius)
        return np.min(lows, axis=0), np.max(highs, axis=0)

    @cached_property
    def size(self) -> float:
        """[m] the diagonal of the box."""
        low, high = self.box
        return max(SMALLEST_SIZE, float(np.linalg.norm(high - low)))

    @cached_property
    def reference_force(self) -> float:
        """[N] the force of an arrow of ARROW_PART of the size: nine tenths of all contact forces are no larger."""
        sizes = [float(np.linalg.norm(push.force)) for step in self.pushes for push in step]
        pushing = [size for size in sizes if size > 0]
        return float(np.quantile(pushing, 0.9)) if pushing else 1.0


def scene_of(
    model: Model,
    times: Array,
    xs: Array,
    *,
    contacts: Sequence[Sequence[ContactPoint]] = (),
    ghosts: Mapping[str, tuple[Array, Rgba]] | None = None,
    frame: str | None = None,
) -> Scene:
    """The scene of the motion `xs` (N+1, nx) at `times` (N+1,), with `ghosts`: states (N+1, nx) and colour by name.

    A ghost that would hide behind the motion is left out. `frame` is the name of the frame or body whose origin
    leaves a trail; without it, the centre of mass that moves most. UnknownNameError where there is no such frame.
    """
    poses = poses_of(model, xs)
    return Scene(
        shapes=tuple(shapes_of(model.plant, model.double.context)),
        times=times,
        poses=poses,
        ghosts=tuple(
            Ghost(name, poses_of(model, ghost_xs), colour)
            for name, (ghost_xs, colour) in (ghosts or {}).items()
            if not np.array_equal(ghost_xs, xs)
        ),
        pushes=tuple(tuple(Push(c.point, c.force) for c in step) for step in contacts),
        trail=longest_way(model.plant, poses) if frame is None else _way_of(model, xs, frame),
    )


def poses_of(model: Model, xs: Array) -> dict[str, list[RigidTransform]]:
    """Where every body that can move is in each of `xs` (N+1, nx), by its path."""
    moving = moving_bodies(model.plant)
    poses: dict[str, list[RigidTransform]] = {body_path(body): [] for body in moving}
    for x in xs:
        set_state(model.double, x)
        for body in moving:
            poses[body_path(body)].append(model.plant.EvalBodyPoseInWorld(model.double.context, body))
    return poses


def moving_bodies(plant: Any) -> list[Any]:
    """The bodies that are not fixed to the world."""
    return [body for body in bodies(plant) if not plant.IsAnchored(body)]


def longest_way(plant: Any, poses: Poses) -> Array:
    """(N+1, 3) of the centre of mass that moves most."""
    coms = {body_path(body): body.default_com() for body in moving_bodies(plant)}
    ways = [np.array([pose @ coms[path] for pose in found]) for path, found in poses.items()]
    return max(ways, key=lambda way: float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()))


def _way_of(model: Model, xs: Array, name: str) -> Array:
    known = {f.name(): f for f in (model.plant.get_frame(FrameIndex(i)) for i in range(model.plant.num_frames()))}
    if name not in known:
        raise UnknownNameError("frame", got=name, known=tuple(known))
    way = []
    for x in xs:
        set_state(model.double, x)
        way.append(known[name].CalcPoseInWorld(model.double.context).translation())
    return np.array(way)


def shapes_of(plant: Any, context: Any) -> list[Drawn]:
    """All that is drawn of a plant; a small ball at each centre of mass where it has no geometry at all."""
    port = plant.get_geometry_query_input_port()
    found: list[Drawn] = []
    if port.HasValue(context):
        inspector = port.Eval(context).inspector()
        for body in [plant.world_body(), *bodies(plant)]:
            frame = plant.GetBodyFrameIdIfExists(body.index())
            if frame is not None:
                shapes = _shapes_on(inspector, frame, body_path(body))
                fixed = plant.IsAnchored(body)
                found += [_in_world(s, plant.EvalBodyPoseInWorld(context, body)) for s in shapes] if fixed else shapes
    if found:
        return found
    return [_ball(body) for body in moving_bodies(plant)]


def _in_world(drawn: Drawn, pose: RigidTransform) -> Drawn:
    return replace(drawn, body="", pose=pose @ drawn.pose, centre=pose @ drawn.centre)


def _ball(body: Any) -> Drawn:
    com = np.asarray(body.default_com())
    return Drawn(body_path(body), Sphere(0.05), RigidTransform(com), GREY, com, 0.05)


def _shapes_on(inspector: Any, frame: Any, path: str) -> list[Drawn]:
    """Of a frame's geometries those meant to be seen, or those that touch where there are none."""
    for role in (Role.kIllustration, Role.kProximity):
        drawn = (_drawn(inspector, geometry, role, path) for geometry in inspector.GetGeometries(frame, role))
        found = [d for d in drawn if d is not None and isinstance(d.shape, DRAWN)]
        if found:
            return found
    return []


def _drawn(inspector: Any, geometry: Any, role: Role, path: str) -> Drawn | None:
    """A geometry as it is drawn; None where its file is no mesh that can be read, which the model's notes tell."""
    colour, pose = GREY, inspector.GetPoseInFrame(geometry)
    if role == Role.kIllustration:
        colour = inspector.GetIllustrationProperties(geometry).GetPropertyOrDefault("phong", "diffuse", GREY)
    try:
        box = inspector.GetObbInGeometryFrame(geometry)
    except RuntimeError:  # a mesh is read when it is first asked for
        return None
    centre = pose.translation() if box is None else pose @ box.pose().translation()
    radius = 0.0 if box is None else float(np.linalg.norm(box.half_width()))
    return Drawn(path, inspector.GetShape(geometry), pose, colour, np.asarray(centre), radius)


def body_path(body: Any) -> str:
    """A path of Meshcat that no name can break out of; the index keeps it unique."""
    return f"{int(body.index())}_" + re.sub(r"[^A-Za-z0-9_.-]", "_", body.name())

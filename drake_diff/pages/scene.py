"""What is seen of a motion: shapes on bodies, where the bodies are over time, contact forces, and how large it is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.geometry import Rgba
from pydrake.math import RigidTransform
from pydrake.multibody.tree import FrameIndex

from drake_diff._base.arrays import Array
from drake_diff.exceptions import UnknownNameError
from drake_diff.model.contact import ContactPoint
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies
from drake_diff.model.step import set_state
from drake_diff.pages.shapes import Drawn, body_path, shapes_of

BLUE = Rgba(0.15, 0.4, 0.95, 0.3)
LOOKED_AT = 60  # at most so many poses of a motion are looked at for its bounding box
ARROW_PART = 0.2  # of the scene's size: how long the arrow of `Scene.reference_force` is
LARGEST_MARK = 0.5  # [m] so much of a goal or an obstacle has to be in view
SMALLEST_SIZE = 0.3  # [m] the camera comes no closer

Poses = Mapping[str, Sequence[RigidTransform]]


@dataclass(frozen=True)
class Force:
    """A force (3,) [N] at a point (3,) [m], in the world frame."""

    point: Array
    force: Array


@dataclass(frozen=True)
class Ghost:
    """Another motion of the same bodies at the same times, translucent; one that is not `framed` may leave the picture.

    `name` is a path of Meshcat.
    """

    name: str
    poses: Poses
    colour: Rgba
    framed: bool = True


@dataclass(frozen=True, eq=False)
class Scene:
    """A motion to be drawn: `poses` of every moving body at `times` (N+1,) [s].

    In each of the N steps there are contact forces, `contacts`, and those that inputs put on bodies, `thrusts`.
    `trail` (N+1, 3) [m] is the path of the point that is followed, `marks` are goals and obstacles.
    """

    shapes: tuple[Drawn, ...]
    times: Array
    poses: Poses
    ghosts: tuple[Ghost, ...]
    contacts: tuple[tuple[Force, ...], ...]
    trail: Array
    marks: tuple[Drawn, ...] = ()
    thrusts: tuple[tuple[Force, ...], ...] = ()

    @cached_property
    def balls(self) -> tuple[Array, Array]:
        """Centres (n, 3) and radii (n,) [m] of balls that hold the motion, framed ghosts and marks in the world."""
        trail = self.trail[:: max(1, len(self.trail) // LOOKED_AT)]
        result = [(point, 0.0) for point in (*trail, self.trail[-1])]
        motions = [self.poses, *(ghost.poses for ghost in self.ghosts if ghost.framed)]
        for drawn in self.shapes:
            for motion in motions:
                poses = motion.get(drawn.body, ())
                result += [(p @ drawn.centre, drawn.radius) for p in poses[:: max(1, len(poses) // LOOKED_AT)]]
        result += [(mark.centre, min(mark.radius, LARGEST_MARK)) for mark in self.marks if not mark.body]
        return np.array([centre for centre, _ in result]), np.array([radius for _, radius in result])

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """The lowest and highest corner (3,) of the box that holds the balls."""
        centres, radii = self.balls
        return np.min(centres - radii[:, None], axis=0), np.max(centres + radii[:, None], axis=0)

    @cached_property
    def size(self) -> float:
        """[m] the diagonal of the box."""
        low, high = self.box
        return max(SMALLEST_SIZE, float(np.linalg.norm(high - low)))

    def reference_of(self, forces: Sequence[Sequence[Force]]) -> float:
        """[N] the force whose arrow is ARROW_PART of the size: nine tenths of all `forces` are no larger."""
        sizes = [float(np.linalg.norm(item.force)) for step in forces for item in step]
        pushing = [size for size in sizes if size > 0]
        return float(np.quantile(pushing, 0.9)) if pushing else 1.0


def scene_of(
    model: Model,
    times: Array,
    xs: Array,
    *,
    us: Array | None = None,
    contacts: Sequence[Sequence[ContactPoint | Force]] = (),
    ghosts: Mapping[str, tuple[Array, Rgba]] | None = None,
    frame: str | None = None,
    marks: Sequence[Drawn] = (),
    shapes: Sequence[Drawn] = (),
) -> Scene:
    """The scene of a motion of `model`.

    Args:
        model: Whose bodies move.
        times: (N+1,) [s].
        xs: (N+1, nx) the states at those times.
        us: (N, nu) the inputs in each of the N steps: the forces that they put on bodies are drawn as arrows.
        contacts: The contacts in each of the N steps, drawn as arrows.
        ghosts: States (N+1, nx) and colour by name; a ghost that would hide behind the motion is left out.
        frame: The name of the frame or body whose origin leaves a trail; by default the centre of mass that moves most.
        marks: Goals and obstacles.
        shapes: Those of an earlier scene of this model, which need not be read again.

    Raises:
        UnknownNameError: If there is no such frame.
    """
    drawn = bodies(model.plant)
    moving = [body for body in drawn if not model.plant.IsAnchored(body)]
    seen = {name: states for name, (states, _) in (ghosts or {}).items() if not np.array_equal(states, xs)}
    poses = _poses_of(model, moving, xs)
    of_ghosts = {name: _poses_of(model, moving, states) for name, states in seen.items()}
    trail = longest_path(poses, moving) if frame is None else _path_of(model, poses, len(xs), frame)
    return Scene(
        shapes=tuple(shapes or shapes_of(model.plant, model.double.context, drawn)),
        times=times,
        poses=poses,
        ghosts=tuple(Ghost(name, result, (ghosts or {})[name][1]) for name, result in of_ghosts.items()),
        contacts=tuple(tuple(Force(c.point, c.force) for c in step) for step in contacts),
        trail=trail,
        marks=tuple(marks),
        thrusts=() if us is None else _thrusts_of(model, xs, us),
    )


def _thrusts_of(model: Model, xs: Array, us: Array) -> tuple[tuple[Force, ...], ...]:
    """The forces that propellers, thrusters and the like put on bodies from each state on; () without any such."""
    twin = model.double
    port = twin.plant.get_applied_spatial_force_input_port()
    if int(port.get_index()) not in twin.inputs.fed:
        return ()
    result = []
    for x, u in zip(xs, us, strict=False):  # the last state has no input
        set_state(twin, x)
        twin.set_input(u)
        step = []
        for item in port.Eval(twin.context):
            pose = twin.plant.EvalBodyPoseInWorld(twin.context, twin.plant.get_body(item.body_index))
            step.append(Force(pose @ item.p_BoBq_B, np.asarray(item.F_Bq_W.translational())))
        result.append(tuple(step))
    return tuple(result)


def _poses_of(model: Model, moving: Sequence[Any], xs: Array) -> dict[str, list[RigidTransform]]:
    """Where each of the bodies `moving` is in each of `xs` (N+1, nx), by its path."""
    poses: dict[str, list[RigidTransform]] = {body_path(body): [] for body in moving}
    for x in xs:
        set_state(model.double, x)
        for body in moving:
            poses[body_path(body)].append(model.plant.EvalBodyPoseInWorld(model.double.context, body))
    return poses


def moving_bodies(plant: Any) -> list[Any]:
    """The bodies that are not fixed to the world."""
    return [body for body in bodies(plant) if not plant.IsAnchored(body)]


def longest_path(poses: Poses, moving: Sequence[Any] = ()) -> Array:
    """(N+1, 3) the path of that centre of mass of the bodies `moving` that moves most; of the origins without any."""
    centres = {body_path(body): np.asarray(body.default_com()) for body in moving}
    paths = [np.array([pose @ centres.get(name, np.zeros(3)) for pose in result]) for name, result in poses.items()]
    return max(paths, key=lambda path: float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()))


def _path_of(model: Model, poses: Poses, count: int, name: str) -> Array:
    """(N+1, 3) the path of a frame's origin, which is fixed to its body."""
    known = {f.name(): f for f in (model.plant.get_frame(FrameIndex(i)) for i in range(model.plant.num_frames()))}
    if name not in known:
        raise UnknownNameError("frame", got=name, known=tuple(known))
    body, context = known[name].body(), model.double.context
    origin = known[name].CalcPoseInBodyFrame(context).translation()
    fixed = model.plant.EvalBodyPoseInWorld(context, body)
    return np.array([pose @ origin for pose in poses.get(body_path(body), [fixed] * count)])

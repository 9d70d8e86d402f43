"""The scene of a motion: shapes on bodies, poses over time, contact forces, and its size."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.geometry import Rgba
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array
from drake_diff.model.contact import ContactPoint
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, frame_named
from drake_diff.model.step import set_state
from drake_diff.pages.shapes import Drawn, body_path, shapes_of

BLUE = Rgba(0.15, 0.4, 0.95, 0.3)
LOOKED_AT = 60  # largest number of poses of a motion that determine its bounding box
ARROW_PART = 0.2  # length of the arrow of the reference force, relative to the scene's size
LARGEST_MARK = 0.5  # [m] the part of a goal or an obstacle that must be in view
SMALLEST_SIZE = 0.3  # [m] smallest size that the camera shows

Poses = Mapping[str, Sequence[RigidTransform]]


@dataclass(frozen=True)
class Force:
    """A force (3,) [N] at a point (3,) [m], in the world frame."""

    point: Array
    force: Array


@dataclass(frozen=True)
class Ghost:
    """Another, translucent motion of the same bodies at the same times; if not `framed`, it may leave the view.

    `name` is a path of Meshcat.
    """

    name: str
    poses: Poses
    colour: Rgba
    framed: bool = True


@dataclass(frozen=True, eq=False)
class Scene:
    """A motion to draw: `poses` of every moving body at `times` (N+1,) [s].

    Each of the N steps has contact forces, `contacts`, and forces of inputs on bodies, `thrusts`. `trail` (N+1, 3) [m]
    is the path of the tracked point, and `marks` are goals and obstacles.
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
        """Centres (n, 3) and radii (n,) [m] of balls around the motion, framed ghosts and marks in the world."""
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
        """The lowest and highest corner (3,) of the balls' bounding box."""
        centres, radii = self.balls
        return np.min(centres - radii[:, None], axis=0), np.max(centres + radii[:, None], axis=0)

    @cached_property
    def size(self) -> float:
        """[m] the diagonal of the box."""
        low, high = self.box
        return max(SMALLEST_SIZE, float(np.linalg.norm(high - low)))

    def reference_of(self, forces: Sequence[Sequence[Force]]) -> float:
        """Return the force [N] whose arrow is ARROW_PART of the size: the 90 % quantile of all `forces`."""
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
    """Build the scene of a motion of `model`.

    Args:
        model: The model whose bodies move.
        times: (N+1,) [s].
        xs: (N+1, nx) the states at those times.
        us: (N, nu) the inputs in each of the N steps. Their forces on bodies are drawn as arrows.
        contacts: The contacts in each of the N steps, which are drawn as arrows.
        ghosts: States (N+1, nx) and colour by name. Ghosts that are equal to the motion are omitted.
        frame: The frame or body whose origin draws the trail; by default the centre of mass with the longest path.
        marks: Goals and obstacles.
        shapes: The shapes of an earlier scene of this model, to avoid reading them again.

    Raises:
        UnknownNameError: There is no such frame.
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
    """Return the forces of propellers, thrusters and the like on bodies at each state, or () if there are none."""
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
    """Return the pose of each body in `moving` at each of `xs` (N+1, nx), by the body's path."""
    poses: dict[str, list[RigidTransform]] = {body_path(body): [] for body in moving}
    for x in xs:
        set_state(model.double, x)
        for body in moving:
            poses[body_path(body)].append(model.plant.EvalBodyPoseInWorld(model.double.context, body))
    return poses


def moving_bodies(plant: Any) -> list[Any]:
    """Return the bodies that are not fixed to the world."""
    return [body for body in bodies(plant) if not plant.IsAnchored(body)]


def longest_path(poses: Poses, moving: Sequence[Any] = ()) -> Array:
    """Return the longest path (N+1, 3) of a centre of mass of the bodies `moving`, or of an origin without any."""
    centres = {body_path(body): np.asarray(body.default_com()) for body in moving}
    paths = [np.array([pose @ centres.get(name, np.zeros(3)) for pose in result]) for name, result in poses.items()]
    return max(paths, key=lambda path: float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()))


def _path_of(model: Model, poses: Poses, count: int, name: str) -> Array:
    """Return the path (N+1, 3) of the origin of a frame, which is fixed to its body."""
    frame, context = frame_named(model.plant, "frame", name, of_world=True), model.double.context
    body, origin = frame.body(), frame.CalcPoseInBodyFrame(context).translation()
    fixed = model.plant.EvalBodyPoseInWorld(context, body)
    return np.array([pose @ origin for pose in poses.get(body_path(body), [fixed] * count)])

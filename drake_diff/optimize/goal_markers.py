"""Goals and obstacles as shapes of a scene."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.geometry import Box, Cylinder, MeshcatCone, Rgba, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_diff._base.arrays import Array
from drake_diff.model.plant import frame_named
from drake_diff.optimize.problem.goals import Goal, Mark
from drake_diff.optimize.problem.obstacles import Obstacle
from drake_diff.pages.meshcat import RED, TRAIL, VIOLET
from drake_diff.pages.scene import BLUE
from drake_diff.pages.shapes import Drawn, body_path

AXES = (Rgba(0.8, 0.15, 0.1, 0.9), Rgba(0.1, 0.6, 0.15, 0.9), Rgba(0.1, 0.3, 0.85, 0.9))  # x, y, z
THIN = 0.03  # radius of an axis or an arrow, as a fraction of its length
Colour = tuple[str, str, str]  # a legend entry: a CSS colour, "line", "dot" or "arrow", and the meaning
LARGE = 0.25  # [m] goals with a larger radius are so translucent that the robot stays visible


def drawn_goals(plant: Any, context: Any, goals: Iterable[Goal]) -> tuple[Drawn, ...]:
    """Return the markers of `goals` on the bodies of `plant` or in the world. UnknownNameError for an unknown frame."""
    marks = [(mark, not isinstance(goal, Obstacle)) for goal in goals for mark in goal.marks()]
    shapes: list[Drawn] = []
    for mark, above in marks:
        frame = frame_named(plant, "frame", mark.frame, of_world=True)
        body, pose = frame.body(), frame.CalcPoseInBodyFrame(context)
        path = "" if plant.IsAnchored(body) else body_path(body)
        if not path:
            pose = plant.EvalBodyPoseInWorld(context, body) @ pose
        if not mark.in_world:
            shapes += _shapes(mark, path, pose @ RigidTransform(mark.position), above)
            continue
        origin = pose @ np.array(mark.position)  # a point on the body; the marker keeps the world's axes
        if path:
            shapes += [replace(shape, origin=origin) for shape in _shapes(mark, path, RigidTransform(), above)]
        else:
            shapes += _shapes(mark, path, RigidTransform(origin), above)
    return tuple(shapes)


def _shapes(mark: Mark, path: str, pose: RigidTransform, above: bool) -> list[Drawn]:
    """Return the shapes of one mark at `pose` on the body at `path`. Shapes `above` are drawn over what hides them."""
    frame = pose @ RigidTransform(RotationMatrix(np.array(mark.rotation)), np.zeros(3))
    colour = Rgba(*mark.colour)
    if above and mark.shape in ("sphere", "box") and max(mark.size) / 2 > LARGE:
        colour = Rgba(*mark.colour[:3], 0.2)
    if mark.shape == "sphere":
        shapes = [_drawn(path, Sphere(mark.size[0]), frame, colour, mark.size[0])]
    elif mark.shape == "box":
        shapes = [_drawn(path, Box(*mark.size), frame, colour, float(np.linalg.norm(mark.size)) / 2)]
    elif mark.shape == "axes":
        axes = zip(np.eye(3) * mark.size[0], AXES, strict=True)
        shapes = [_arrow(path, frame, along, shade)[0] for along, shade in axes]
    else:
        shapes = _arrow(path, frame, np.array(mark.size), colour)
    return [replace(shape, above=above) for shape in shapes]


def _arrow(path: str, frame: RigidTransform, along: Array, colour: Rgba) -> list[Drawn]:
    """Return a shaft from the origin of `frame` along a vector (3,) [m] and its tip, or [] for a zero vector."""
    length = float(np.linalg.norm(along))
    if length == 0.0:
        return []
    turned = frame @ RigidTransform(RotationMatrix.MakeFromOneVector(along / length, 2), np.zeros(3))
    radius = THIN * length
    middle, end = (turned @ RigidTransform([0.0, 0.0, fraction * length]) for fraction in (0.5, 1.0))
    tip = end @ RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.0, 0.0, 4 * radius])  # a cone's origin is its apex
    shaft = _drawn(path, Cylinder(radius, length), middle, colour, length / 2)
    return [shaft, _drawn(path, MeshcatCone(8 * radius, 3 * radius, 3 * radius), tip, colour, 4 * radius)]


def _drawn(path: str, shape: Any, pose: RigidTransform, colour: Rgba, radius: float) -> Drawn:
    return Drawn(path, shape, pose, colour, np.asarray(pose.translation()), radius)


def meaning_of(goals: Sequence[Goal]) -> list[Colour]:
    """Return the legend entries of the marks of `goals`, without duplicates."""
    marks = [mark for goal in goals for mark in goal.marks() if mark.shape != "axes"]
    rows = [(css(Rgba(*mark.colour)), "arrow" if mark.shape == "arrow" else "dot", mark.label) for mark in marks]
    if any(mark.shape == "axes" for goal in goals for mark in goal.marks()):
        rows.append((css(AXES[2]), "line", "axes of a target: x red, y green, z blue"))
    return list(dict.fromkeys(rows))


def colours_of(*, plan: bool, contacts: bool, thrusts: bool) -> list[Colour]:
    """Return the legend entries of a motion: its path, and the plan and the forces if they are drawn."""
    colours = [(css(BLUE), "dot", "the plan, where it differs from the motion")] if plan else []
    colours.append((css(TRAIL), "line", "path of the centre of mass of the body that moves most"))
    if contacts:
        colours.append((css(RED), "arrow", "contact forces: length by magnitude, the largest tenth may be clipped"))
    if thrusts:
        colours.append((css(VIOLET), "arrow", "forces of the inputs on bodies"))
    return colours


def css(colour: Any) -> str:
    """Format a Drake colour for a style sheet, without its opacity."""
    return f"rgb({', '.join(str(round(255 * channel)) for channel in (colour.r(), colour.g(), colour.b()))})"

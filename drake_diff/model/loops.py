"""Loops of a robot: points of two bodies that are held together, by <connect> and <weld> of MJCF or by joints of SDF.

A joint of SDF whose child has a joint already closes a loop. Drake has no such joints: here the child's points on the
joint's axis are held at those of the parent. Each pair of points is one of Drake's ball constraints, nearly rigid.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, SpatialInertia, UnitInertia

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError
from drake_diff.model.xml_text import Element, XmlText

APART = 0.1  # [m] between the points of one loop: the constraints are nearly rigid at any distance
POINTS = {"ball": 1, "revolute": 2, "continuous": 2, "fixed": 3}  # of a joint of SDF
WORLD = "world"


@dataclass(frozen=True)
class HeldBodies:
    """What a file holds together: `points` of a body and those of another, both by their names in one model instance.

    `other_points` are in the other body's frame, None where they coincide with these in the file's pose. `frame` is the
    name of a frame of the first body that points are given in, "" for the body's own.
    """

    instance: str
    body: str
    other: str
    points: tuple[tuple[float, ...], ...]  # [m]
    other_points: tuple[tuple[float, ...], ...] | None = None
    frame: str = ""


@dataclass
class HeldPoints:
    """A point of one body that a constraint of a plant holds at a point of another."""

    constraint: Any  # its MultibodyConstraintId
    bodies: tuple[Any, Any]  # their BodyIndex
    points: list[Array] = field(default_factory=list)  # [m] (3,) of each in its body's frame


def points_along(axis: Array, count: int) -> tuple[tuple[float, ...], ...]:
    """The first `count` of the origin, a point along an axis, and one across it."""
    axis = axis / np.linalg.norm(axis)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return tuple(tuple((APART * p).tolist()) for p in (np.zeros(3), axis, across / np.linalg.norm(across))[:count])


def loops_of_sdf(xml: XmlText, model: Element, instance: str) -> Iterator[HeldBodies]:
    """The joints of an SDF model that close loops; they become frames of their children.

    Raises ModelError, with its line, where one is of a kind that points cannot hold, or drives.
    """
    has_joint: set[str] = set()
    for joint in model.findall("joint"):
        parent, child = (element.text.strip() if (element := joint.find(tag)) else "" for tag in ("parent", "child"))
        if child not in has_joint:
            has_joint.add(child)
            continue
        kind, name = joint.get("type"), joint.get("name")
        where = f"line {joint.line}: the joint {name} closes a loop"
        if kind not in POINTS:
            raise ModelError(f"{where}: expected one of {', '.join(POINTS)}, got {kind}")
        xyz, effort = joint.find("axis", "xyz"), joint.find("axis", "limit", "effort")
        if xyz is not None and xyz.get("expressed_in"):
            raise ModelError(f"{where}: expected its axis in its own frame, got expressed_in")
        if effort is not None and float(effort.text) > 0:
            raise ModelError(f"{where}, and has a motor: drive another joint of the loop, or let its effort be 0")
        axis = np.array([float(word) for word in xyz.text.split()] if xyz is not None else [0.0, 0.0, 1.0])
        if not axis.any():
            raise ModelError(f"{where}: expected an axis, got 0 0 0")
        pose = joint.find("pose")
        text = "" if pose is None else xml.data[pose.start : pose.end].decode()
        xml.replace(joint, f"<frame name={quoteattr(name)} attached_to={quoteattr(child)}>{text}</frame>")
        yield HeldBodies(instance, child, parent, points_along(axis, POINTS[kind]), frame=name)


def close_loops(plant: MultibodyPlant, loops: list[HeldBodies], held: list[HeldPoints]) -> tuple[str, ...]:
    """Hold the points of loops together, before the plant is finalized, and add to `held` how; a sentence.

    Raises ModelError where a body is none of the plant's.
    """
    names: list[str] = []
    for loop in loops:
        instance = plant.GetModelInstanceByName(loop.instance)
        for name in (n for n in (loop.body, loop.other) if n != WORLD and not plant.HasBodyNamed(n, instance)):
            raise ModelError(f"expected bodies of {loop.instance} that are held together, got {name}, which is none")
        body, other = (_body(plant, name, instance) for name in (loop.body, loop.other))
        if {body.index(), other.index()} <= {fixed.index() for fixed in plant.GetBodiesWeldedTo(plant.world_body())}:
            continue  # neither moves, and a step would fail
        pose = RigidTransform()
        if loop.frame:
            pose = plant.GetFrameByName(loop.frame, instance).GetFixedPoseInBodyFrame()
        for i, point in enumerate(loop.points):
            points = [pose @ np.array(point)]
            points += [] if loop.other_points is None else [np.array(loop.other_points[i])]
            constraint = plant.AddBallConstraint(body, points[0], other, *points[1:])
            held.append(HeldPoints(constraint, (body.index(), other.index()), points))
        lost = f" (joint {loop.frame}, without its limits, damping, spring and motor)" if loop.frame else ""
        names.append(f"{loop.body} and {loop.other}{lost}")
    if not names:
        return ()
    return (f"{len(names)} loops are closed, nearly rigidly (softly in MuJoCo): {', '.join(names)}.",)


def _body(plant: MultibodyPlant, name: str, instance: Any) -> Any:
    """The body of that name. For the world it is one that is welded to it, as Drake crashes on the world itself."""
    if name != WORLD:
        return plant.GetBodyByName(name, instance)
    if not plant.HasBodyNamed(f"{WORLD}_of_loops", instance):
        nothing = SpatialInertia(0.0, np.zeros(3), UnitInertia(0.0, 0.0, 0.0))
        body = plant.AddRigidBody(f"{WORLD}_of_loops", instance, nothing)
        plant.WeldFrames(plant.world_frame(), body.body_frame())
    return plant.GetBodyByName(f"{WORLD}_of_loops", instance)


def find_points(plant: MultibodyPlant, held: list[HeldPoints]) -> None:
    """Complete, in the default pose of a finalized plant, the points that the file leaves open."""
    context = plant.CreateDefaultContext()
    for pair in (pair for pair in held if len(pair.points) == 1):
        first, second = (plant.EvalBodyPoseInWorld(context, plant.get_body(index)) for index in pair.bodies)
        pair.points.append(second.inverse() @ (first @ pair.points[0]))


def relative_motion(plant: MultibodyPlant, context: Any, held: list[HeldPoints]) -> tuple[Array, Array]:
    """The Jacobians (L, 3, nv) of the differences of L pairs of points by v, and the differences (L, 3) [m].

    They are those in the state of `context`, in the world's axes.
    """
    jacobians, differences = np.zeros((len(held), 3, plant.num_velocities())), np.zeros((len(held), 3))
    world = plant.world_frame()
    for pair, jacobian, difference in zip(held, jacobians, differences, strict=True):
        for index, point, sign in zip(pair.bodies, pair.points, (1, -1), strict=True):
            body = plant.get_body(index)
            moves = plant.CalcJacobianTranslationalVelocity(
                context, JacobianWrtVariable.kV, body.body_frame(), point, world, world
            )
            jacobian += sign * moves
            difference += sign * (plant.EvalBodyPoseInWorld(context, body) @ point)
    return jacobians, differences

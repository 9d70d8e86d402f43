"""Loops of a robot: points of two bodies that are held together, by <connect> and <weld> of MJCF or by joints of SDF.

A joint of SDF whose child has a joint already closes a loop. Drake has no such joints: here the child's points on the
joint's axis are held at those of the parent. Each pair of points is one of Drake's ball constraints, nearly rigid.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, SpatialInertia, UnitInertia

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError
from drake_diff.model.plant import joint_pose, joints
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

    Those of nested models come first: a joint to a link that has one there closes a loop.

    Raises ModelError, with its line, where one is of a kind that points cannot hold, or drives.
    """
    has_joint = set(_driven_links(model))
    for joint in model.findall("joint"):
        parent, child = _ends(joint)
        link = _link(model, child)
        if link not in has_joint:
            has_joint.add(link)
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
        says = {"relative_to": child} | ({} if pose is None else pose.attributes)
        given = " ".join(f"{key}={quoteattr(value)}" for key, value in says.items())
        placed = f"<pose {given}>{'' if pose is None else escape(pose.text)}</pose>"
        # To the link itself: Drake loses the pose of a frame on a frame of a nested model.
        xml.replace(joint, f"<frame name={quoteattr(name)} attached_to={quoteattr(link)}>{placed}</frame>")
        yield HeldBodies(instance, link, _link(model, parent), points_along(axis, POINTS[kind]), frame=name)


def _ends(joint: Element) -> tuple[str, str]:
    """The parent and the child that a joint of SDF names."""
    parent, child = (element.text.strip() if (element := joint.find(tag)) else "" for tag in ("parent", "child"))
    return parent, child


def _link(model: Element, name: str) -> str:
    """The link that a name in an SDF model means: "inner::link" of a nested one, and of a frame what it is fixed to."""
    seen: set[str] = set()
    while name not in seen:  # frames that are fixed to each other are refused by Drake
        seen.add(name)
        scope, _, rest = name.partition("::")
        inner = next((m for m in model.findall("model") if m.get("name") == scope), None)
        if rest and inner is not None:
            return f"{scope}::{_link(inner, rest)}"
        frame = next((f for f in model.findall("frame") if f.get("name") == name), None)
        name = name if frame is None else frame.get("attached_to") or name
    return name


def _driven_links(model: Element) -> Iterator[str]:
    """The links of nested models that are the child of a joint there, as `model` names them."""
    for inner in model.findall("model"):
        links = {_link(inner, _ends(joint)[1]) for joint in inner.findall("joint")}
        for link in (*links, *_driven_links(inner)):
            yield f"{inner.get('name')}::{link}"


def in_pose_of_files(
    plant: MultibodyPlant, loops: Sequence[HeldBodies], position: Callable[[Any], float]
) -> list[HeldBodies]:
    """`loops` with the points of both bodies, which coincide in the files' pose where a file gives those of one alone.

    The plant is not finalized and its joints are those of the files; `position` is that of a hinge or slide [rad or m]
    in the files' pose. A .dmd.yaml may let the robot start elsewhere, and a weld in place of a joint be elsewhere.

    Raises ModelError where a body is none of the plant's.
    """
    inboard = {joint.child_body().index(): joint for joint in joints(plant)}

    def pose(body: Any) -> RigidTransform:
        if body.index() == plant.world_body().index():
            return RigidTransform()
        joint = inboard.get(body.index())
        if joint is None:
            return plant.GetDefaultFloatingBaseBodyPose(body)
        moved = joint_pose(joint, position(joint))
        on_parent, on_child = (f.GetFixedPoseInBodyFrame() for f in (joint.frame_on_parent(), joint.frame_on_child()))
        return pose(joint.parent_body()) @ on_parent @ moved @ on_child.inverse()

    located = []
    for loop in loops:
        first, second = (_body(plant, loop.instance, name) for name in (loop.body, loop.other))
        points, others = loop.points, loop.other_points
        if loop.frame:
            of_frame = plant.GetFrameByName(loop.frame, first.model_instance()).GetFixedPoseInBodyFrame()
            points = tuple(tuple(of_frame @ np.array(point)) for point in points)
        if others is None:
            between = pose(second).inverse() @ pose(first)
            others = tuple(tuple(between @ np.array(point)) for point in points)
        located.append(replace(loop, points=points, other_points=others))
    return located


def close_loops(plant: MultibodyPlant, loops: Sequence[HeldBodies], held: list[HeldPoints]) -> tuple[str, ...]:
    """Hold the points of both bodies of loops together, before the plant is finalized; adds to `held`; a sentence."""
    names: list[str] = []
    for loop in loops:
        body, other = (
            _welded_to_the_world(plant, loop.instance) if name == WORLD else _body(plant, loop.instance, name)
            for name in (loop.body, loop.other)
        )
        if other.index() in {welded.index() for welded in plant.GetBodiesWeldedTo(body)}:
            continue  # they move together, and a step would fail
        for point, other_point in zip(loop.points, loop.other_points or (), strict=True):
            points = [np.array(point), np.array(other_point)]
            constraint = plant.AddBallConstraint(body, points[0], other, points[1])
            held.append(HeldPoints(constraint, (body.index(), other.index()), points))
        lost = f" (joint {loop.frame}, without its limits, damping, spring and motor)" if loop.frame else ""
        names.append(f"{loop.body} and {loop.other}{lost}")
    if not names:
        return ()
    return (
        f"{len(names)} kinematic loops are closed by nearly rigid constraints (soft in MuJoCo): {', '.join(names)}.",
    )


def _body(plant: MultibodyPlant, instance: str, name: str) -> Any:
    """That of a model instance, or of one within it, "inner::link"; ModelError where there is none."""
    if name == WORLD:
        return plant.world_body()
    *scopes, last = name.split("::")
    full = "::".join([instance, *scopes])
    if plant.HasModelInstanceNamed(full):
        index = plant.GetModelInstanceByName(full)
        if plant.HasBodyNamed(last, index):
            return plant.GetBodyByName(last, index)
    raise ModelError(f"expected a body of {instance} to connect, got the unknown name {name}")


def _welded_to_the_world(plant: MultibodyPlant, instance: str) -> Any:
    """A body without mass that is welded to the world, as Drake crashes on constraints of the world itself."""
    name, index = f"{WORLD}_of_loops", plant.GetModelInstanceByName(instance)
    if not plant.HasBodyNamed(name, index):
        nothing = SpatialInertia(0.0, np.zeros(3), UnitInertia(0.0, 0.0, 0.0))
        body = plant.AddRigidBody(name, index, nothing)
        plant.WeldFrames(plant.world_frame(), body.body_frame())
    return plant.GetBodyByName(name, index)


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

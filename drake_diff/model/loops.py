"""Kinematic loops: points of two bodies that <connect> or <weld> of MJCF, or joints of SDF, constrain to coincide.

A joint of SDF closes a loop if its child already has a joint. Drake does not support such joints. They are replaced by
constraints between the points of child and parent on the joint's axis, each a nearly rigid ball constraint of Drake.
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
from drake_diff.model.plant import joint_pose, joints, note
from drake_diff.model.xml_text import Element, XmlText

APART = 0.1  # [m] distance between the points of a loop: the constraints are nearly rigid at any distance
POINTS = {"ball": 1, "revolute": 2, "continuous": 2, "fixed": 3}  # number of points for each type of SDF joint
WORLD = "world"


@dataclass(frozen=True)
class HeldBodies:
    """Two bodies that a file connects: `points` of a body and of another body, named in one model instance.

    `other_points` are in the other body's frame, or None if they coincide with `points` in the file's pose. `frame` is
    the name of a frame of the first body in which the points are given, or "" for the body's own frame.
    """

    instance: str
    body: str
    other: str
    points: tuple[tuple[float, ...], ...]  # [m]
    other_points: tuple[tuple[float, ...], ...] | None = None
    frame: str = ""


@dataclass
class HeldPoints:
    """A point of one body that a constraint of the plant connects to a point of another body."""

    constraint: Any  # a MultibodyConstraintId
    bodies: tuple[Any, Any]  # of type BodyIndex
    points: list[Array] = field(default_factory=list)  # [m] (3,) for each body in its frame


def points_along(axis: Array, count: int) -> tuple[tuple[float, ...], ...]:
    """Return the first `count` points of: the origin, a point along the axis, a point perpendicular to it."""
    axis = axis / np.linalg.norm(axis)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return tuple(tuple((APART * p).tolist()) for p in (np.zeros(3), axis, across / np.linalg.norm(across))[:count])


def loops_of_sdf(xml: XmlText, model: Element, instance: str) -> Iterator[HeldBodies]:
    """Yield the joints of an SDF model that close loops, and replace them by frames of their child links.

    Nested models are handled first, because a joint to a link that already has a joint there closes a loop.

    Raises ModelError with the line if points cannot represent the joint's type, or if the joint has a motor.
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
            raise ModelError(f"{where}, and has a motor: drive another joint of the loop, or set its effort to 0")
        axis = np.array([float(word) for word in xyz.text.split()] if xyz is not None else [0.0, 0.0, 1.0])
        if not axis.any():
            raise ModelError(f"{where}: expected an axis, got 0 0 0")
        pose = joint.find("pose")
        says = {"relative_to": child} | ({} if pose is None else pose.attributes)
        given = " ".join(f"{key}={quoteattr(value)}" for key, value in says.items())
        placed = f"<pose {given}>{'' if pose is None else escape(pose.text)}</pose>"
        # Attached to the link itself, because Drake loses the pose of a frame on a frame of a nested model.
        xml.replace(joint, f"<frame name={quoteattr(name)} attached_to={quoteattr(link)}>{placed}</frame>")
        yield HeldBodies(instance, link, _link(model, parent), points_along(axis, POINTS[kind]), frame=name)


def _ends(joint: Element) -> tuple[str, str]:
    """Return the names of the parent and child of an SDF joint."""
    parent, child = (element.text.strip() if (element := joint.find(tag)) else "" for tag in ("parent", "child"))
    return parent, child


def _link(model: Element, name: str) -> str:
    """Resolve a name in an SDF model to a link, "inner::link" in a nested model; a frame resolves to its link."""
    seen: set[str] = set()
    while name not in seen:  # Drake refuses frames that are attached to each other
        seen.add(name)
        scope, _, rest = name.partition("::")
        inner = next((m for m in model.findall("model") if m.get("name") == scope), None)
        if rest and inner is not None:
            return f"{scope}::{_link(inner, rest)}"
        frame = next((f for f in model.findall("frame") if f.get("name") == name), None)
        name = name if frame is None else frame.get("attached_to") or name
    return name


def _driven_links(model: Element) -> Iterator[str]:
    """Yield the links of nested models that are the child of a joint there, with their names in `model`."""
    for inner in model.findall("model"):
        links = {_link(inner, _ends(joint)[1]) for joint in inner.findall("joint")}
        for link in (*links, *_driven_links(inner)):
            yield f"{inner.get('name')}::{link}"


def in_pose_of_files(
    plant: MultibodyPlant, loops: Sequence[HeldBodies], position: Callable[[Any], float]
) -> list[HeldBodies]:
    """Return `loops` with the points of both bodies; missing points are computed to coincide in the files' pose.

    The plant is not finalized and has the joints of the files. `position` returns the coordinate of a hinge or slide
    [rad or m] in the files' pose. The default pose may differ, because of a .dmd.yaml or a weld in place of a joint.

    Raises ModelError if a body does not exist in the plant.
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
    """Add constraints for loops to a plant before it is finalized, append them to `held`, and return a note."""
    names: list[str] = []
    for loop in loops:
        body, other = (
            _welded_to_the_world(plant, loop.instance) if name == WORLD else _body(plant, loop.instance, name)
            for name in (loop.body, loop.other)
        )
        if other.index() in {welded.index() for welded in plant.GetBodiesWeldedTo(body)}:
            continue  # the bodies are welded together, and a step would fail
        for point, other_point in zip(loop.points, loop.other_points or (), strict=True):
            points = [np.array(point), np.array(other_point)]
            constraint = plant.AddBallConstraint(body, points[0], other, points[1])
            held.append(HeldPoints(constraint, (body.index(), other.index()), points))
        lost = f" (joint {loop.frame}, without its limits, damping, spring and motor)" if loop.frame else ""
        names.append(f"{loop.body} and {loop.other}{lost}")
    return note(f"{len(names)} kinematic loops are closed by nearly rigid constraints (soft in MuJoCo)", names)


def _body(plant: MultibodyPlant, instance: str, name: str) -> Any:
    """Return the body of a model instance or of a nested one, "inner::link"; raise ModelError if it is unknown."""
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
    """Return a massless body welded to the world, because Drake crashes on constraints of the world body."""
    name, index = f"{WORLD}_of_loops", plant.GetModelInstanceByName(instance)
    if not plant.HasBodyNamed(name, index):
        nothing = SpatialInertia(0.0, np.zeros(3), UnitInertia(0.0, 0.0, 0.0))
        body = plant.AddRigidBody(name, index, nothing)
        plant.WeldFrames(plant.world_frame(), body.body_frame())
    return plant.GetBodyByName(name, index)


def relative_motion(plant: MultibodyPlant, context: Any, held: Sequence[HeldPoints]) -> tuple[Array, Array]:
    """Return the Jacobians (L, 3, nv) in v of the differences of L point pairs, and the differences (L, 3) [m].

    They are evaluated in the state of `context` and expressed in the world frame.
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


def relative_bias(plant: MultibodyPlant, context: Any, held: Sequence[HeldPoints]) -> Array:
    """Return the accelerations (L, 3) [m/s^2] of the differences of `relative_motion` at dv/dt = 0."""
    bias, world = np.zeros((len(held), 3)), plant.world_frame()
    for pair, entry in zip(held, bias, strict=True):
        for index, point, sign in zip(pair.bodies, pair.points, (1, -1), strict=True):
            asked = JacobianWrtVariable.kV, plant.get_body(index).body_frame(), point, world, world
            entry += sign * plant.CalcBiasTranslationalAcceleration(context, *asked).ravel()
    return bias

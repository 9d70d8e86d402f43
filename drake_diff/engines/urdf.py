"""Drake's plant as URDF, numbers to the last digit: for readers of URDF, and in the form that Bullet takes.

For readers of URDF each link's frame stands at its joint and parallel to the world where q = 0: no joint is turned
against its parent, so nothing goes through roll, pitch and yaw but geometry.
URDF has no springs; friction and softness of contact are written in the elements that Drake reads.
Bullet gets each link in the frame of its joint, with its inertia by the principal axes.
"""

from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_diff._base.arrays import Array
from drake_diff.engines.common import principal, row, shape_of, xml_text
from drake_diff.engines.interface import UNLIMITED
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.coordinates import rotation
from drake_diff.mechanics.description import Description, Geometry, Link, RigidLink

# Drake's own elements, in URDF and SDF, of what a side of a contact is made.
PROXIMITY = {
    "friction": ("mu_dynamic", "mu_static"), "stiffness": ("point_contact_stiffness",),
    "dissipation": ("hunt_crossley_dissipation",), "relaxation_time": ("relaxation_time",),
}  # fmt: skip
KINDS = {"weld": "fixed", "prismatic": "prismatic", "quaternion_floating": "floating"}
SHAPES = ("Sphere", "Box", "Cylinder")  # URDF's own; Bullet has capsules too


def urdf(description: Description) -> str:
    """The URDF text, with a link "world" that free bodies float on.

    A motor's torque limit is its joint's effort; geometries that are no sphere, box or cylinder are left out.
    """
    root, elements = _tree(description, "world", description.links)
    zero = AtZero(description)
    for geometry in (g for g in description.geometries if shape_of(g)[0] in SHAPES):
        collision = _add_collision(elements[geometry.body], geometry, zero.in_frame(geometry.body) @ geometry.pose)
        material = SubElement(collision, "drake:proximity_properties")
        for quantity, value in geometry.material.items():
            for name in PROXIMITY[quantity]:
                SubElement(material, f"drake:{name}", value=row(value))
    armature = {x.joint: x.armature for x in description.moving}
    for name, joint in zip(description.inputs, description.actuated, strict=True):
        transmission = SubElement(root, "transmission", name=name)
        SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
        driven = SubElement(transmission, "joint", name=joint)
        SubElement(driven, "hardwareInterface").text = "EffortJointInterface"
        motor = SubElement(transmission, "actuator", name=name)
        # The first motor of a joint has its whole armature.
        SubElement(motor, "drake:rotor_inertia", value=row(armature.pop(joint, 0.0)))
        SubElement(motor, "drake:gear_ratio", value="1.0")
    return xml_text(root)


def inertial_urdf(description: Description, base: str) -> str:
    """The URDF text, without geometry and motors, of the tree on the link `base`, a free body or "world"."""
    return xml_text(_tree(description, base, carried_by(description, base))[0])


def bullet_urdf(links: Sequence[tuple[int, RigidLink]], geometries: Sequence[tuple[int, Geometry]]) -> str:
    """One tree for Bullet: links, each with its place (by which geometries and children name it).

    The first link may be a free body; a tree that hangs on the world gets a massless base "world". Raises ModelError
    for a half space on a link, which Bullet has on the world alone.
    """
    root = Element("robot", name="tree")
    if not links[0][1].free:
        _add_inertial(SubElement(root, "link", name="world"), 0.0, RigidTransform(), np.zeros((3, 3)))
    for number, link in links:
        body = SubElement(root, "link", name=f"link_{number}")
        moments, turn = principal(link.inertia)
        axes = RigidTransform(RotationMatrix(rotation(turn)), link.center_of_mass)
        _add_inertial(body, link.mass, axes, np.diag(moments))
        for geometry in (g for owner, g in geometries if owner == number):
            if shape_of(geometry)[0] == "HalfSpace":
                raise ModelError(f"geometry {geometry.name}: Bullet has half spaces only on the world")
            _add_collision(body, geometry, geometry.pose)
        if not link.free:
            parent = "world" if link.parent < 0 else f"link_{link.parent}"
            joint = _add_joint(root, f"joint_{number}", link.joint.kind, (parent, f"link_{number}"), link.on_parent)
            limited = np.isfinite(link.joint.lower) or np.isfinite(link.joint.upper)
            sides = (link.joint.lower, link.joint.upper) if limited else (1.0, -1.0)  # upper below lower: no limit
            _add_freedom(joint, link.axis, link.joint.damping, UNLIMITED, sides)
    return xml_text(root)


def carried_by(description: Description, base: str) -> tuple[Link, ...]:
    """The links that stand on `base`, a free body or "world", free bodies not among them."""
    bodies, found = {base}, []
    for link in description.links:
        if link.parent in bodies and link.kind != "quaternion_floating":
            bodies.add(link.body)
            found.append(link)
    return tuple(found)


class AtZero:
    """Where `bodies` and the `frames` of links are in the world where q = 0: frames at the joints, parallel to it."""

    def __init__(self, description: Description):
        self.bodies, self.frames = {"world": RigidTransform()}, {"world": RigidTransform()}
        for link in description.links:
            at = self.bodies[link.parent] @ link.on_parent
            self.bodies[link.body] = at @ link.on_child.inverse()
            self.frames[link.body] = RigidTransform(at.translation())

    def in_frame(self, body: str) -> RigidTransform:
        """The pose of a body in its link's frame."""
        return self.frames[body].inverse() @ self.bodies[body]

    def in_parent(self, link: Link) -> RigidTransform:
        """The pose of a link's frame in that of its parent."""
        return self.frames[link.parent].inverse() @ self.frames[link.body]

    def inertia(self, link: Link) -> tuple[Array, Array]:
        """Centre of mass (3,) and inertia (3, 3) about it, in the link's frame."""
        X = self.in_frame(link.body)
        R = X.rotation().matrix()
        return np.asarray(X @ link.center_of_mass), R @ link.inertia @ R.T

    def axis(self, link: Link) -> Array:
        """(3,) of its joint, of norm 1."""
        turn = (self.bodies[link.parent] @ link.on_parent).rotation().matrix()
        return np.asarray(turn @ link.axis / np.linalg.norm(link.axis))


def _tree(description: Description, base: str, links: tuple[Link, ...]) -> tuple[Element, dict[str, Element]]:
    """The document of `links` on the link `base`, and its links."""
    root = Element("robot", {"name": "from_drake", "xmlns:drake": "http://drake.mit.edu"})
    elements = {name: SubElement(root, "link", name=name) for name in (base, *(x.body for x in links))}
    zero = AtZero(description)
    for link in description.links:
        if link.body in elements:
            center, inertia = zero.inertia(link)
            _add_inertial(elements[link.body], link.mass, RigidTransform(center), inertia)
    for link in links:
        limited = bool(np.isfinite(link.lower) or np.isfinite(link.upper))
        kind = KINDS.get(link.kind) or ("revolute" if limited else "continuous")
        joint = _add_joint(root, link.joint, kind, (link.parent, link.body), zero.in_parent(link))
        if link.kind in ("revolute", "prismatic"):
            own = [e for e, x in zip(description.effort_limits, description.actuated, strict=True) if x == link.joint]
            sides = None if kind == "continuous" else (link.lower, link.upper)
            _add_freedom(joint, zero.axis(link), link.damping, min([UNLIMITED, *own]), sides)
            for each in (each for each in description.followers if each.joint == link.joint):
                SubElement(joint, "mimic", joint=each.leader, multiplier=row(each.ratio), offset=row(each.offset))
    return root, elements


def _add_joint(root: Element, name: str, kind: str, sides: tuple[str, str], X: RigidTransform) -> Element:
    joint = SubElement(root, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=sides[0])
    SubElement(joint, "child", link=sides[1])
    _place(joint, X)
    return joint


def _add_freedom(joint: Element, axis: Array, damping: float, effort: float, sides: tuple[float, float] | None) -> None:
    SubElement(joint, "axis", xyz=row(axis))
    SubElement(joint, "dynamics", damping=row(damping))
    limit = SubElement(joint, "limit", effort=row(effort), velocity=row(UNLIMITED))
    if sides:
        limit.set("lower", row(max(sides[0], -UNLIMITED)))
        limit.set("upper", row(min(sides[1], UNLIMITED)))


def _add_inertial(body: Element, mass: float, center: RigidTransform, inertia: Array) -> None:
    """`inertia` (3, 3) is about `center` and in its axes."""
    inertial = SubElement(body, "inertial")
    _place(inertial, center)
    SubElement(inertial, "mass", value=row(mass))
    places = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    SubElement(inertial, "inertia", {name: row(inertia[place]) for name, place in places.items()})


def _add_collision(body: Element, geometry: Geometry, X: RigidTransform) -> Element:
    kind, sizes = shape_of(geometry)
    collision = SubElement(body, "collision", name=geometry.name)
    _place(collision, X)
    element = SubElement(SubElement(collision, "geometry"), kind.lower())
    for name, values in sizes.items():
        element.set(name, row(values))
    return collision


def _place(element: Element, X: RigidTransform) -> None:
    rpy: Array = RollPitchYaw(X.rotation()).vector()
    SubElement(element, "origin", xyz=row(X.translation()), rpy=row(rpy))

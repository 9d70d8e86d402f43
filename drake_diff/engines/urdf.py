"""Drake's plant as URDF: the same bodies, joints and actuators, numbers to the last digit.

Each link's frame stands at its joint and parallel to the world where q = 0: no joint is turned against its parent, so
nothing goes through roll, pitch and yaw but geometry. URDF has no springs and no friction; neither is written.

One tree of rigid links as URDF for Bullet: numbers to the last digit, inertias by their principal axes.
"""

from collections.abc import Sequence
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_diff._base.arrays import Array
from drake_diff.engines.mujoco.mjcf import principal
from drake_diff.mechanics.coordinates import rotation
from drake_diff.mechanics.description import Description, Geometry, Link, RigidLink

KINDS = {"weld": "fixed", "prismatic": "prismatic", "quaternion_floating": "floating"}
UNLIMITED = 1e10  # what is not limited: readers take a limit that is missing for 0, and not all can read inf
Poses = dict[str, RigidTransform]


def urdf(description: Description) -> str:
    """The URDF text, with a link "world" that free bodies float on.

    A motor's torque limit is its joint's effort; geometries that are no sphere, box or cylinder are left out.
    """
    root, elements = _tree(description, "world", description.links)
    bodies, frames = poses_at_zero(description)
    for geometry in description.geometries:
        X = frames[geometry.body].inverse() @ bodies[geometry.body] @ geometry.pose
        _add_geometry(elements[geometry.body], geometry, X)
    _add_motors(root, description)
    return _text(root)


def inertial_urdf(description: Description, base: str) -> str:
    """The URDF text, without geometry and motors, of the tree on the link `base`, a free body or "world"."""
    root, _ = _tree(description, base, carried_by(description, base))
    return _text(root)


def carried_by(description: Description, base: str) -> tuple[Link, ...]:
    """The links that stand on `base`, a free body or "world", free bodies not among them."""
    bodies, found = {base}, []
    for link in description.links:
        if link.parent in bodies and link.kind != "quaternion_floating":
            bodies.add(link.body)
            found.append(link)
    return tuple(found)


def _text(root: Element) -> str:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _tree(description: Description, base: str, links: tuple[Link, ...]) -> tuple[Element, dict[str, Element]]:
    """The document of `links` on the link `base`, and its links."""
    root = Element("robot", {"name": "from_drake", "xmlns:drake": "http://drake.mit.edu"})
    elements = {name: SubElement(root, "link", name=name) for name in (base, *(x.body for x in links))}
    bodies, frames = poses_at_zero(description)
    for link in description.links:
        if link.body in elements:
            _add_inertial(elements[link.body], link, frames[link.body].inverse() @ bodies[link.body])
    for link in links:
        joint = _add_joint(root, link, (frames[link.parent].inverse() @ frames[link.body]).translation())
        if link.kind in ("revolute", "prismatic"):
            turn = (bodies[link.parent] @ link.on_parent).rotation().matrix()
            _add_freedom(joint, description, link, turn @ link.axis / np.linalg.norm(link.axis))
    return root, elements


def poses_at_zero(description: Description) -> tuple[Poses, Poses]:
    """Of each body and of its URDF link's frame in the world, where q = 0."""
    bodies, frames = {"world": RigidTransform()}, {"world": RigidTransform()}
    for link in description.links:
        at = bodies[link.parent] @ link.on_parent
        bodies[link.body] = at @ link.on_child.inverse()
        frames[link.body] = RigidTransform(at.translation())
    return bodies, frames


def _row(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values, dtype=float)))


def _add_inertial(element: Element, link: Link, X: RigidTransform) -> None:
    inertial = SubElement(element, "inertial")
    SubElement(inertial, "origin", xyz=_row(X @ link.center_of_mass), rpy="0 0 0")
    SubElement(inertial, "mass", value=_row(link.mass))
    R = X.rotation().matrix()
    turned = R @ link.inertia @ R.T
    entries = {a + b: _row(turned["xyz".index(a), "xyz".index(b)]) for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")}
    SubElement(inertial, "inertia", {"i" + name: value for name, value in entries.items()})


def _add_joint(root: Element, link: Link, origin: Array) -> Element:
    limited = bool(np.isfinite(link.lower) or np.isfinite(link.upper))
    kind = KINDS.get(link.kind) or ("revolute" if limited else "continuous")
    joint = SubElement(root, "joint", name=link.joint, type=kind)
    SubElement(joint, "parent", link=link.parent)
    SubElement(joint, "child", link=link.body)
    SubElement(joint, "origin", xyz=_row(origin), rpy="0 0 0")
    return joint


def _add_freedom(joint: Element, description: Description, link: Link, axis: Array) -> None:
    SubElement(joint, "axis", xyz=_row(axis))
    SubElement(joint, "dynamics", damping=_row(link.damping))
    effort = [e for e, x in zip(description.effort_limits, description.actuated, strict=True) if x == link.joint]
    limit = SubElement(joint, "limit", effort=_row(min([UNLIMITED, *effort])), velocity=_row(UNLIMITED))
    if joint.get("type") != "continuous":
        limit.set("lower", _row(max(link.lower, -UNLIMITED)))
        limit.set("upper", _row(min(link.upper, UNLIMITED)))


def _add_motors(root: Element, description: Description) -> None:
    """One each, the first of a joint with the whole armature."""
    armature = {x.joint: x.armature for x in description.moving}
    for name, joint in zip(description.inputs, description.actuated, strict=True):
        transmission = SubElement(root, "transmission", name=name)
        SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
        driven = SubElement(transmission, "joint", name=joint)
        SubElement(driven, "hardwareInterface").text = "EffortJointInterface"
        motor = SubElement(transmission, "actuator", name=name)
        SubElement(motor, "drake:rotor_inertia", value=_row(armature.pop(joint, 0.0)))
        SubElement(motor, "drake:gear_ratio", value="1.0")


def _add_geometry(element: Element, geometry: Geometry, X: RigidTransform) -> None:
    shape, kind = geometry.shape, type(geometry.shape).__name__
    if kind == "Sphere":
        sizes = {"radius": _row(shape.radius())}
    elif kind == "Box":
        sizes = {"size": _row([shape.width(), shape.depth(), shape.height()])}
    elif kind == "Cylinder":
        sizes = {"radius": _row(shape.radius()), "length": _row(shape.length())}
    else:
        return
    collision = SubElement(element, "collision", name=geometry.name)
    rpy: Array = RollPitchYaw(X.rotation()).vector()
    SubElement(collision, "origin", xyz=_row(X.translation()), rpy=_row(rpy))
    SubElement(SubElement(collision, "geometry"), kind.lower(), sizes)


UNLIMITED_of_bullet_urdf = 1e10


def bullet_urdf(links: Sequence[tuple[int, RigidLink]], geometries: Sequence[tuple[int, Geometry]]) -> str:
    """Links, each with its place (by which its geometries and children name it); the first may be a free body.

    A tree that hangs on the world gets a massless base "world". Half spaces are left to the caller.
    """
    root = Element("robot", name="tree")
    if not links[0][1].free:
        base = SubElement(root, "link", name="world")
        _add_inertial_of_bullet_urdf(base, 0.0, np.zeros(3), np.zeros((3, 3)))
    for number, link in links:
        body = SubElement(root, "link", name=f"link_{number}")
        _add_inertial_of_bullet_urdf(body, link.mass, link.center_of_mass, link.inertia)
        for geometry in (g for owner, g in geometries if owner == number):
            _add_shape(body, geometry)
        if not link.free:
            _add_joint_of_bullet_urdf(root, number, link)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _add_joint_of_bullet_urdf(root: Element, number: int, link: RigidLink) -> None:
    limited = np.isfinite(link.joint.lower) or np.isfinite(link.joint.upper)
    sides = (
        np.clip([link.joint.lower, link.joint.upper], -UNLIMITED_of_bullet_urdf, UNLIMITED_of_bullet_urdf)
        if limited
        else [1.0, -1.0]
    )
    joint = SubElement(root, "joint", name=f"joint_{number}", type=link.joint.kind)
    _place(joint, link.on_parent)
    SubElement(joint, "parent", link="world" if link.parent < 0 else f"link_{link.parent}")
    SubElement(joint, "child", link=f"link_{number}")
    SubElement(joint, "axis", xyz=_row_of_bullet_urdf(link.axis))
    SubElement(joint, "dynamics", damping=_row_of_bullet_urdf([link.joint.damping]), friction="0")
    limit = {
        "lower": sides[0],
        "upper": sides[1],
        "effort": UNLIMITED_of_bullet_urdf,
        "velocity": UNLIMITED_of_bullet_urdf,
    }
    SubElement(joint, "limit", {name: _row_of_bullet_urdf([value]) for name, value in limit.items()})


def _add_inertial_of_bullet_urdf(body: Element, mass: float, center: Array, inertia: Array) -> None:
    moments, turn = principal(inertia)
    inertial = SubElement(body, "inertial")
    _place(inertial, RigidTransform(RotationMatrix(rotation(turn)), center))
    SubElement(inertial, "mass", value=_row_of_bullet_urdf([mass]))
    products = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    diagonal = {f"i{axis}{axis}": _row_of_bullet_urdf([m]) for axis, m in zip("xyz", moments, strict=True)}
    SubElement(inertial, "inertia", {**diagonal, **products})


def _add_shape(body: Element, geometry: Geometry) -> None:
    shape, kind = geometry.shape, type(geometry.shape).__name__.lower()
    collision = SubElement(body, "collision")
    _place(collision, geometry.pose)
    element = SubElement(SubElement(collision, "geometry"), kind)
    if kind == "box":
        element.set("size", _row_of_bullet_urdf([shape.width(), shape.depth(), shape.height()]))
    else:
        element.set("radius", _row_of_bullet_urdf([shape.radius()]))
    if kind in ("cylinder", "capsule"):
        element.set("length", _row_of_bullet_urdf([shape.length()]))


def _place(element: Element, X: RigidTransform) -> None:
    SubElement(
        element,
        "origin",
        xyz=_row_of_bullet_urdf(X.translation()),
        rpy=_row_of_bullet_urdf(RollPitchYaw(X.rotation()).vector()),
    )


def _row_of_bullet_urdf(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values, dtype=float)))

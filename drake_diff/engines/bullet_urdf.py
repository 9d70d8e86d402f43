"""One tree of rigid links as URDF for Bullet: numbers to the last digit, inertias by their principal axes."""

from collections.abc import Sequence
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_diff.arrays import Array
from drake_diff.engines.description import Geometry
from drake_diff.engines.euler import rotation
from drake_diff.engines.mjcf import principal
from drake_diff.engines.rigid_links import RigidLink

UNLIMITED = 1e10


def bullet_urdf(links: Sequence[tuple[int, RigidLink]], geometries: Sequence[tuple[int, Geometry]]) -> str:
    """Links, each with its place (by which its geometries and children name it); the first may be a free body.

    A tree that hangs on the world gets a massless base "world". Half spaces are left to the caller.
    """
    root = Element("robot", name="tree")
    if not links[0][1].free:
        base = SubElement(root, "link", name="world")
        _add_inertial(base, 0.0, np.zeros(3), np.zeros((3, 3)))
    for number, link in links:
        body = SubElement(root, "link", name=f"link_{number}")
        _add_inertial(body, link.mass, link.center_of_mass, link.inertia)
        for geometry in (g for owner, g in geometries if owner == number):
            _add_shape(body, geometry)
        if not link.free:
            _add_joint(root, number, link)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _add_joint(root: Element, number: int, link: RigidLink) -> None:
    limited = np.isfinite(link.joint.lower) or np.isfinite(link.joint.upper)
    sides = np.clip([link.joint.lower, link.joint.upper], -UNLIMITED, UNLIMITED) if limited else [1.0, -1.0]
    joint = SubElement(root, "joint", name=f"joint_{number}", type=link.joint.kind)
    _place(joint, link.on_parent)
    SubElement(joint, "parent", link="world" if link.parent < 0 else f"link_{link.parent}")
    SubElement(joint, "child", link=f"link_{number}")
    SubElement(joint, "axis", xyz=_row(link.axis))
    SubElement(joint, "dynamics", damping=_row([link.joint.damping]), friction="0")
    limit = {"lower": sides[0], "upper": sides[1], "effort": UNLIMITED, "velocity": UNLIMITED}
    SubElement(joint, "limit", {name: _row([value]) for name, value in limit.items()})


def _add_inertial(body: Element, mass: float, center: Array, inertia: Array) -> None:
    moments, turn = principal(inertia)
    inertial = SubElement(body, "inertial")
    _place(inertial, RigidTransform(RotationMatrix(rotation(turn)), center))
    SubElement(inertial, "mass", value=_row([mass]))
    products = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    diagonal = {f"i{axis}{axis}": _row([m]) for axis, m in zip("xyz", moments, strict=True)}
    SubElement(inertial, "inertia", {**diagonal, **products})


def _add_shape(body: Element, geometry: Geometry) -> None:
    shape, kind = geometry.shape, type(geometry.shape).__name__.lower()
    collision = SubElement(body, "collision")
    _place(collision, geometry.pose)
    element = SubElement(SubElement(collision, "geometry"), kind)
    if kind == "box":
        element.set("size", _row([shape.width(), shape.depth(), shape.height()]))
    else:
        element.set("radius", _row([shape.radius()]))
    if kind in ("cylinder", "capsule"):
        element.set("length", _row([shape.length()]))


def _place(element: Element, X: RigidTransform) -> None:
    SubElement(element, "origin", xyz=_row(X.translation()), rpy=_row(RollPitchYaw(X.rotation()).vector()))


def _row(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values, dtype=float)))

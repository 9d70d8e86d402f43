"""Drake's plant as MJCF: the same bodies, joints, actuators and collision pairs, numbers to the last digit."""

from collections.abc import Mapping
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.description import Description, Geometry, Link

# MuJoCo refuses a mass [kg] or moment of inertia [kg m^2] of at most 1e-15: massless links and point masses get this.
SMALLEST = 2e-15
# Constant impedance of contacts: near enough to rigid for friction to hold, far enough for a spring to be one.
IMPEDANCE = 0.9
FRICTION_IMPEDANCE_RATIO = 100.0  # so that what sticks creeps little
UNLIMITED = 1e10  # the other side of a limit that has one
Pair = tuple[str, str]


def mjcf(description: Description, time_step: float, solref: Mapping[Pair, tuple[float, float]] | None = None) -> str:
    """The MJCF text. `solref` gives pairs of geometries MuJoCo's (-stiffness, -damping); others keep MuJoCo's own.

    Geometries that are no sphere, box, cylinder, capsule, ellipsoid or half space are left out, with their pairs.
    Raises ModelError for a free body whose joint's frames are not its own and the world's.
    """
    root = Element("mujoco", model="from_drake")
    compiler = SubElement(root, "compiler", angle="radian", fusestatic="false")
    compiler.set("boundmass", _row([SMALLEST]))
    compiler.set("boundinertia", _row([SMALLEST]))
    options = {"timestep": time_step, "tolerance": 1e-12, "impratio": FRICTION_IMPEDANCE_RATIO}
    option = SubElement(root, "option", {name: _row([value]) for name, value in options.items()})
    for name, text in {"integrator": "Euler", "cone": "elliptic", "gravity": _row(description.gravity)}.items():
        option.set(name, text)
    SubElement(option, "flag", warmstart="disable")
    bodies = {"world": SubElement(root, "worldbody")}
    for link in description.links:
        bodies[link.body] = _add_link(bodies[link.parent], link)
    known = {g.name for g in description.geometries if _add_geometry(bodies[g.body], g)}
    actuators, contacts = SubElement(root, "actuator"), SubElement(root, "contact")
    for i, (name, joint) in enumerate(zip(description.inputs, description.actuated, strict=True)):
        motor = SubElement(actuators, "motor", name=name, joint=joint, gear="1")
        limit = float(description.effort_limits[i])
        if np.isfinite(limit):
            motor.set("forcelimited", "true")
            motor.set("forcerange", _row([-limit, limit]))
    for pair in description.pairs:
        if set(pair.names) <= known:
            element = SubElement(contacts, "pair", geom1=pair.names[0], geom2=pair.names[1], condim="3")
            element.set("solimp", _row([IMPEDANCE, IMPEDANCE, 0.001]))
            if pair.friction is not None:
                element.set("friction", _row([pair.friction] * 2 + [0.0] * 3))
            if solref and pair.names in solref:
                element.set("solref", _row(solref[pair.names]))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _row(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values, dtype=float)))


def _place(element: Element, X: RigidTransform) -> None:
    element.set("pos", _row(X.translation()))
    element.set("quat", _row(X.rotation().ToQuaternion().wxyz()))


def _add_link(parent: Element, link: Link) -> Element:
    body = SubElement(parent, "body", name=link.body)
    _place(body, link.on_parent @ link.on_child.inverse())
    if link.mass > 0:
        moments, turn = principal(link.inertia)
        inertial = SubElement(body, "inertial", mass=_row([link.mass]), diaginertia=_row(moments))
        inertial.set("pos", _row(link.center_of_mass))
        inertial.set("quat", _row(turn))
    if link.kind == "quaternion_floating":
        if link.parent != "world" or not all(x.IsExactlyIdentity() for x in (link.on_parent, link.on_child)):
            raise ModelError(f"joint {link.joint}: MuJoCo's free body is one of the world, by its own frame")
        SubElement(body, "freejoint", name=link.joint)
    elif link.kind != "weld":
        _add_joint(body, link)
    return body


def _add_joint(body: Element, link: Link) -> None:
    joint = SubElement(body, "joint", name=link.joint, type="hinge" if link.kind == "revolute" else "slide")
    joint.set("pos", _row(link.on_child.translation()))
    joint.set("axis", _row(link.on_child.rotation().matrix() @ link.axis))
    numbers = {"damping": link.damping, "armature": link.armature, "stiffness": link.stiffness, "springref": link.rest}
    for name, value in numbers.items():
        joint.set(name, _row([value]))
    limited = np.isfinite(link.lower) or np.isfinite(link.upper)
    joint.set("limited", "true" if limited else "false")
    if limited:
        joint.set("range", _row(np.clip([link.lower, link.upper], -UNLIMITED, UNLIMITED)))


def principal(inertia: Array) -> tuple[Array, Array]:
    """Principal moments (3,) of `inertia` (3, 3), and the quaternion (w, x, y, z) of their axes.

    What rounding takes from A + B >= C, which MuJoCo checks exactly, is put back: 1e-14 of the largest at most.
    """
    moments, axes = np.linalg.eigh(inertia)
    if np.array_equal(inertia, np.diag(np.diag(inertia))):
        moments, axes = np.diag(inertia).copy(), np.eye(3)
    axes = axes * np.sign(np.linalg.det(axes))
    order = np.argsort(moments)
    missing = moments[order[2]] - moments[order[1]] - moments[order[0]]
    if 0 < missing <= 1e-14 * moments[order[2]]:
        moments[order[0]] += 2 * missing
    X = RigidTransform(np.vstack([np.column_stack([axes, np.zeros(3)]), [0, 0, 0, 1.0]]))
    return moments, np.asarray(X.rotation().ToQuaternion().wxyz())


def _add_geometry(body: Element, geometry: Geometry) -> bool:
    shape, kind = geometry.shape, type(geometry.shape).__name__
    if kind == "Sphere":
        size = [shape.radius()]
    elif kind in ("Cylinder", "Capsule"):
        size = [shape.radius(), shape.length() / 2]
    elif kind == "Box":
        size = [shape.width() / 2, shape.depth() / 2, shape.height() / 2]
    elif kind == "Ellipsoid":
        size = [shape.a(), shape.b(), shape.c()]
    elif kind == "HalfSpace":
        size = [0.0, 0.0, 1.0]
    else:
        return False
    name = {"HalfSpace": "plane"}.get(kind, kind.lower())
    element = SubElement(body, "geom", name=geometry.name, type=name, size=_row(size), contype="0", conaffinity="0")
    element.set("mass", "0")
    _place(element, geometry.pose)
    return True

"""Drake's plant as MJCF: the same bodies, joints, actuators and collision pairs, numbers to the last digit."""

from collections.abc import Mapping
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.math import RigidTransform

from drake_diff.engines.common import principal, row, shape_of, xml_text
from drake_diff.engines.interface import UNLIMITED
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.description import Description, Geometry, Link

# MuJoCo refuses a mass [kg] or moment of inertia [kg m^2] of at most 1e-15: massless links and point masses get this.
SMALLEST = 2e-15
# Constant impedance of contacts: near enough to rigid for friction to hold, far enough for a spring to be one.
IMPEDANCE = 0.9
FRICTION_IMPEDANCE_RATIO = 100.0  # so that what sticks creeps little
STIFFEST = 0.9999  # MuJoCo's largest impedance: joints that follow others give way by a ten-thousandth


def mjcf(description: Description, time_step: float, inverse_masses: Mapping[str, float] | None = None) -> str:
    """The MJCF text, whose contacts have Drake's stiffness where they rest (see `contacts`) and are damped critically.

    `inverse_masses` are what MuJoCo takes for 1 / mass of each body, which only it knows; `generated` asks it. Without
    them contacts have MuJoCo's own stiffness, which is another model's. Geometries that are no sphere, box, cylinder,
    capsule, ellipsoid or half space are left out, with their pairs.

    Raises:
        ModelError: a free body whose joint's frames are not its own and the world's.
    """
    root = Element("mujoco", model="from_drake")
    smallest = row(SMALLEST)
    SubElement(root, "compiler", angle="radian", fusestatic="false", boundmass=smallest, boundinertia=smallest)
    numbers = {"timestep": time_step, "tolerance": 1e-12, "impratio": FRICTION_IMPEDANCE_RATIO}
    option = {name: row(value) for name, value in numbers.items()}
    option |= {"integrator": "Euler", "cone": "elliptic", "gravity": row(description.gravity)}
    SubElement(SubElement(root, "option", option), "flag", warmstart="disable")
    bodies = {"world": SubElement(root, "worldbody")}
    for link in description.links:
        bodies[link.body] = _add_link(bodies[link.parent], link)
    body_of = {g.name: g.body for g in description.geometries if _add_geometry(bodies[g.body], g)}
    actuators, contacts = SubElement(root, "actuator"), SubElement(root, "contact")
    for i, (name, joint) in enumerate(zip(description.inputs, description.actuated, strict=True)):
        motor = SubElement(actuators, "motor", name=name, joint=joint, gear="1")
        limit = float(description.effort_limits[i])
        if np.isfinite(limit):
            motor.set("forcelimited", "true")
            motor.set("forcerange", row([-limit, limit]))
    for pair in description.pairs:
        if set(pair.names) <= body_of.keys():
            element = SubElement(contacts, "pair", geom1=pair.names[0], geom2=pair.names[1], condim="3")
            element.set("solimp", row([IMPEDANCE, IMPEDANCE, 0.001]))
            if pair.friction is not None:
                element.set("friction", row([pair.friction] * 2 + [0.0] * 3))
            if inverse_masses and pair.stiffness:
                s = pair.stiffness * (1 - IMPEDANCE) * sum(inverse_masses[body_of[name]] for name in pair.names)
                element.set("solref", row([-s, -2 * np.sqrt(s)]))
    equality = SubElement(root, "equality") if description.followers else root
    for each in description.followers:
        element = SubElement(equality, "joint", joint1=each.joint, joint2=each.leader)
        element.set("polycoef", row([each.offset, each.ratio, 0, 0, 0]))
        element.set("solimp", row([STIFFEST, STIFFEST, 0.001]))
    return xml_text(root)


def _place(element: Element, X: RigidTransform) -> None:
    element.set("pos", row(X.translation()))
    element.set("quat", row(X.rotation().ToQuaternion().wxyz()))


def _add_link(parent: Element, link: Link) -> Element:
    body = SubElement(parent, "body", name=link.body)
    _place(body, link.on_parent @ link.on_child.inverse())
    if link.mass > 0:
        moments, turn = principal(link.inertia)
        inertial = SubElement(body, "inertial", mass=row(link.mass), diaginertia=row(moments))
        inertial.set("pos", row(link.center_of_mass))
        inertial.set("quat", row(turn))
    if link.kind == "quaternion_floating":
        if link.parent != "world" or not all(x.IsExactlyIdentity() for x in (link.on_parent, link.on_child)):
            raise ModelError(f"joint {link.joint}: a free body in MuJoCo must float in the world, by its own frame")
        SubElement(body, "freejoint", name=link.joint)
    elif link.kind != "weld":
        joint = SubElement(body, "joint", name=link.joint, type="hinge" if link.kind == "revolute" else "slide")
        joint.set("pos", row(link.on_child.translation()))
        joint.set("axis", row(link.on_child.rotation().matrix() @ link.axis))
        for name in ("damping", "armature", "stiffness"):
            joint.set(name, row(getattr(link, name)))
        joint.set("springref", row(link.rest))
        limited = np.isfinite(link.lower) or np.isfinite(link.upper)
        joint.set("limited", "true" if limited else "false")
        if limited:
            joint.set("range", row(np.clip([link.lower, link.upper], -UNLIMITED, UNLIMITED)))
    return body


def _add_geometry(body: Element, geometry: Geometry) -> bool:
    kind, sizes = shape_of(geometry)
    if not sizes:
        return False
    if kind == "HalfSpace":
        size = [0.0, 0.0, 1.0]
    elif kind == "Box":
        size = [side / 2 for side in sizes["size"]]
    elif kind == "Ellipsoid":
        size = sizes["radii"]
    else:
        size = [*sizes["radius"], *(length / 2 for length in sizes.get("length", []))]
    name = {"HalfSpace": "plane"}.get(kind, kind.lower())
    element = SubElement(body, "geom", name=geometry.name, type=name, size=row(size), contype="0", conaffinity="0")
    element.set("mass", "0")
    _place(element, geometry.pose)
    return True

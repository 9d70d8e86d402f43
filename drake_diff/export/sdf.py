"""Drake's plant as an SDF world: the same bodies, joints, springs, gravity and time step, numbers to the last digit.

Link frames are those of `urdf`: at the joints, parallel to the world where q = 0. SDF drives joints, and has no names
of actuators: the input of a joint has the joint's name, and an effort of 0 means that nothing drives it.
"""

from xml.etree.ElementTree import Element, SubElement

from pydrake.math import RigidTransform

from drake_diff.engines.common import row, shape_of, xml_text
from drake_diff.engines.interface import UNLIMITED
from drake_diff.engines.urdf import PROXIMITY, AtZero
from drake_diff.mechanics.description import Description, Geometry, Link

KINDS = {"weld": "fixed", "prismatic": "prismatic", "revolute": "revolute"}
GROUND = "fixed_to_the_world"  # the model of the world's own geometry


def sdf(description: Description, time_step: float) -> str:
    """The SDF text. Geometries that are no sphere, box, cylinder, capsule, ellipsoid or half space are left out.

    Friction and softness of contact are written for each geometry as Drake reads them, and friction as others do
    where all pairs have the same: these combine that of two geometries otherwise. Joints that follow others are written
    as Drake reads them, and as SDF has them.
    """
    version = "1.11" if description.followers else "1.9"  # the first that has <mimic>
    root = Element("sdf", {"version": version, "xmlns:drake": "http://drake.mit.edu"})
    world = SubElement(root, "world", name="from_drake")
    SubElement(SubElement(world, "physics", name="step", type="ode"), "max_step_size").text = row(time_step)
    SubElement(world, "gravity").text = row(description.gravity)
    model = SubElement(world, "model", name="from_drake")
    zero = AtZero(description)
    links = {link.body: _add_link(model, link, zero) for link in description.links}
    for link in description.links:
        if link.kind != "quaternion_floating":
            _add_joint(model, description, link, zero)
    frictions = {pair.friction for pair in description.pairs}
    friction = frictions.pop() if len(frictions) == 1 else None
    if any(g.body == "world" for g in description.geometries):
        ground = SubElement(world, "model", name=GROUND)
        SubElement(ground, "static").text = "true"
        links["world"] = SubElement(ground, "link", name=GROUND)
    for geometry in description.geometries:
        _add_geometry(links[geometry.body], geometry, zero.in_frame(geometry.body) @ geometry.pose, friction)
    return xml_text(root)


def collision_name(geometry: str) -> str:
    """SDF keeps :: for itself."""
    return geometry.replace("::", "/")


def _add_link(model: Element, link: Link, zero: AtZero) -> Element:
    element = SubElement(model, "link", name=link.body)
    SubElement(element, "pose").text = row([*zero.frames[link.body].translation(), 0, 0, 0])
    center, turned = zero.inertia(link)
    inertial = SubElement(element, "inertial")
    SubElement(inertial, "pose").text = row([*center, 0, 0, 0])
    SubElement(inertial, "mass").text = row(link.mass)
    inertia = SubElement(inertial, "inertia")
    for a, b in ("xx", "xy", "xz", "yy", "yz", "zz"):
        SubElement(inertia, f"i{a}{b}").text = row(turned["xyz".index(a), "xyz".index(b)])
    return element


def _add_joint(model: Element, description: Description, link: Link, zero: AtZero) -> None:
    joint = SubElement(model, "joint", name=link.joint, type=KINDS[link.kind])
    SubElement(joint, "parent").text = link.parent
    SubElement(joint, "child").text = link.body
    if link.kind == "weld":
        return
    axis = SubElement(joint, "axis")
    SubElement(axis, "xyz").text = row(zero.axis(link))
    limits = [e for e, x in zip(description.effort_limits, description.actuated, strict=True) if x == link.joint]
    limit, dynamics = SubElement(axis, "limit"), SubElement(axis, "dynamics")
    numbers = {"lower": max(link.lower, -UNLIMITED), "upper": min(link.upper, UNLIMITED)}
    for name, value in {**numbers, "effort": min([UNLIMITED, *limits]) if limits else 0.0}.items():
        SubElement(limit, name).text = row(value)
    numbers = {"damping": link.damping, "spring_reference": link.rest, "spring_stiffness": link.stiffness}
    for name, value in numbers.items():
        SubElement(dynamics, name).text = row(value)
    for each in (each for each in description.followers if each.joint == link.joint):
        numbers = {"multiplier": each.ratio, "offset": each.offset}
        mimic = SubElement(axis, "mimic", joint=each.leader)
        for name, value in {**numbers, "reference": 0.0}.items():
            SubElement(mimic, name).text = row(value)
        SubElement(joint, "drake:mimic", {"joint": each.leader, **{name: row(x) for name, x in numbers.items()}})
    if link.armature:
        SubElement(joint, "drake:rotor_inertia").text = row(link.armature)
        SubElement(joint, "drake:gear_ratio").text = "1.0"


def _add_geometry(link: Element, geometry: Geometry, X: RigidTransform, friction: float | None) -> None:
    kind, sizes = shape_of(geometry)
    if not sizes:
        return
    collision = SubElement(link, "collision", name=collision_name(geometry.name))
    w, *xyz = X.rotation().ToQuaternion().wxyz()
    pose = SubElement(collision, "pose", rotation_format="quat_xyzw")
    pose.text = row([*X.translation(), *xyz, w])
    name = "plane" if kind == "HalfSpace" else kind.lower()
    element = SubElement(SubElement(collision, "geometry"), name)
    for key, values in sizes.items():
        SubElement(element, key).text = row(values)
    if friction is not None:
        ode = SubElement(SubElement(SubElement(collision, "surface"), "friction"), "ode")
        SubElement(ode, "mu").text = SubElement(ode, "mu2").text = row(friction)
    material = SubElement(collision, "drake:proximity_properties")
    for quantity, value in geometry.material.items():
        for name in PROXIMITY[quantity]:
            SubElement(material, f"drake:{name}").text = row(value)

"""Write Drake's plant as URDF, MJCF and SDF: the same bodies, joints, motors and shapes, with all digits.

In URDF and SDF, each link's frame is at its joint and parallel to the world at q = 0. No joint is rotated relative to
its parent, so that only geometry uses roll, pitch and yaw. URDF has no springs. Friction and compliance of contact are
written in the elements that Drake reads. SDF drives joints and has no actuator names. The input of a joint has the
joint's name, and an effort of 0 means that the joint has no actuator. For Bullet, each link is written in the frame of
its joint, with principal moments of inertia.
"""

from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_diff._base.arrays import Array
from drake_diff.engines.interface import UNLIMITED, principal, row, shape_of, xml_text
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.coordinates import rotation
from drake_diff.mechanics.description import Description, Geometry, Link, RigidLink

# Drake's elements, in URDF and SDF, for the contact properties of a geometry.
PROXIMITY = {
    "friction": ("mu_dynamic", "mu_static"), "stiffness": ("point_contact_stiffness",),
    "dissipation": ("hunt_crossley_dissipation",), "relaxation_time": ("relaxation_time",),
}  # fmt: skip
KINDS = {"weld": "fixed", "prismatic": "prismatic", "quaternion_floating": "floating"}
SHAPES = ("Sphere", "Box", "Cylinder")  # shapes of URDF; Bullet also reads capsules
MOMENTS = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def urdf(description: Description) -> str:
    """Return the URDF text, with a link "world" as the parent of free bodies.

    A motor's torque limit is its joint's effort. Geometries other than spheres, boxes and cylinders are left out.
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
        # The first motor of a joint gets the joint's whole armature.
        SubElement(motor, "drake:rotor_inertia", value=row(armature.pop(joint, 0.0)))
        SubElement(motor, "drake:gear_ratio", value="1.0")
    return xml_text(root)


def inertial_urdf(description: Description, base: str) -> str:
    """Return the URDF text, without geometry and motors, of the tree on the link `base`, a free body or "world"."""
    return xml_text(_tree(description, base, carried_by(description, base))[0])


def bullet_urdf(links: Sequence[tuple[int, RigidLink]], geometries: Sequence[tuple[int, Geometry]]) -> str:
    """Return the URDF text of one tree for Bullet. Each link has an index, to which geometries and children refer.

    The first link may be a free body. A tree on the world gets a massless base "world". Raises ModelError for a half
    space on a link, which Bullet supports only on the world.
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
    """Return the links whose tree has the root `base`, a free body or "world", without free bodies."""
    bodies, links = {base}, []
    for link in description.links:
        if link.parent in bodies and link.kind != "quaternion_floating":
            bodies.add(link.body)
            links.append(link)
    return tuple(links)


class AtZero:
    """Poses of `bodies` and of the `frames` of links in the world at q = 0. The frames are parallel to the world."""

    def __init__(self, description: Description):
        self.bodies, self.frames = {"world": RigidTransform()}, {"world": RigidTransform()}
        for link in description.links:
            pose = self.bodies[link.parent] @ link.on_parent
            self.bodies[link.body] = pose @ link.on_child.inverse()
            self.frames[link.body] = RigidTransform(pose.translation())

    def in_frame(self, body: str) -> RigidTransform:
        """Return the pose of a body in its link's frame."""
        return self.frames[body].inverse() @ self.bodies[body]

    def in_parent(self, link: Link) -> RigidTransform:
        """Return the pose of a link's frame in its parent's frame."""
        return self.frames[link.parent].inverse() @ self.frames[link.body]

    def inertia(self, link: Link) -> tuple[Array, Array]:
        """Return the centre of mass (3,) and the inertia (3, 3) about it, in the link's frame."""
        X = self.in_frame(link.body)
        R = X.rotation().matrix()
        return np.asarray(X @ link.center_of_mass), R @ link.inertia @ R.T

    def axis(self, link: Link) -> Array:
        """Return the axis (3,) of the link's joint, with norm 1."""
        turn = (self.bodies[link.parent] @ link.on_parent).rotation().matrix()
        return np.asarray(turn @ link.axis / np.linalg.norm(link.axis))


def _tree(description: Description, base: str, links: tuple[Link, ...]) -> tuple[Element, dict[str, Element]]:
    """Return the document of `links` on the link `base`, and the elements of its links."""
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
            sides = None if kind == "continuous" else (link.lower, link.upper)
            driven = zip(description.effort_limits, description.actuated, strict=True)
            effort = min([UNLIMITED, *(effort for effort, name in driven if name == link.joint)])
            _add_freedom(joint, zero.axis(link), link.damping, effort, sides)
            for follower in (follower for follower in description.followers if follower.joint == link.joint):
                relation = {"multiplier": row(follower.ratio), "offset": row(follower.offset)}
                SubElement(joint, "mimic", {"joint": follower.leader, **relation})
    return root, elements


def _add_joint(root: Element, name: str, kind: str, sides: tuple[str, str], X: RigidTransform) -> Element:
    joint = SubElement(root, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=sides[0])
    SubElement(joint, "child", link=sides[1])
    _add_origin(joint, X)
    return joint


def _add_freedom(joint: Element, axis: Array, damping: float, effort: float, sides: tuple[float, float] | None) -> None:
    SubElement(joint, "axis", xyz=row(axis))
    SubElement(joint, "dynamics", damping=row(damping))
    limit = SubElement(joint, "limit", effort=row(effort), velocity=row(UNLIMITED))
    if sides:
        limit.set("lower", row(max(sides[0], -UNLIMITED)))
        limit.set("upper", row(min(sides[1], UNLIMITED)))


def _add_inertial(body: Element, mass: float, center: RigidTransform, inertia: Array) -> None:
    """Add mass, centre of mass and `inertia` (3, 3), about and in the axes of `center`."""
    inertial = SubElement(body, "inertial")
    _add_origin(inertial, center)
    SubElement(inertial, "mass", value=row(mass))
    SubElement(inertial, "inertia", {name: row(inertia[index]) for name, index in MOMENTS.items()})


def _add_collision(body: Element, geometry: Geometry, X: RigidTransform) -> Element:
    kind, sizes = shape_of(geometry)
    collision = SubElement(body, "collision", name=geometry.name)
    _add_origin(collision, X)
    element = SubElement(SubElement(collision, "geometry"), kind.lower())
    for name, values in sizes.items():
        element.set(name, row(values))
    return collision


def _add_origin(element: Element, X: RigidTransform) -> None:
    rpy: Array = RollPitchYaw(X.rotation()).vector()
    SubElement(element, "origin", xyz=row(X.translation()), rpy=row(rpy))


# Mass [kg] and moment of inertia [kg m^2] of massless links and point masses: MuJoCo does not accept 1e-15 or less.
SMALLEST = 2e-15
# Constant impedance of contacts: rigid enough for friction to hold, soft enough for a spring-like force.
IMPEDANCE = 0.9
FRICTION_IMPEDANCE_RATIO = 100.0  # reduces creep of sticking contacts
STIFFEST = 0.9999  # MuJoCo's largest impedance, with which joints that follow others yield by 1e-4


def mjcf(description: Description, time_step: float, inverse_masses: Mapping[str, float] | None = None) -> str:
    """Return the MJCF text. Its contacts have Drake's stiffness at rest (see `mujoco_contract`) and critical damping.

    `inverse_masses` are MuJoCo's values of 1 / mass for each body, which `generated` reads from a compiled model.
    Without them, contacts have MuJoCo's default stiffness and the models differ. Geometries other than spheres, boxes,
    cylinders, capsules, ellipsoids and half spaces are left out, with their pairs.

    Raises:
        ModelError: The frames of a free body's joint are not those of the body and the world.
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
        bodies[link.body] = _add_mjcf_body(bodies[link.parent], link)
    body_of = {g.name: g.body for g in description.geometries if _add_mjcf_geometry(bodies[g.body], g)}
    actuators, contacts = SubElement(root, "actuator"), SubElement(root, "contact")
    for i, (name, joint) in enumerate(zip(description.inputs, description.actuated, strict=True)):
        motor = SubElement(actuators, "motor", name=name, joint=joint, gear="1")
        if np.isfinite(description.effort_limits[i]):
            motor.set("forcelimited", "true")
            motor.set("forcerange", row(description.effort_sides[i]))
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
    for follower in description.followers:
        element = SubElement(equality, "joint", joint1=follower.joint, joint2=follower.leader)
        element.set("polycoef", row([follower.offset, follower.ratio, 0, 0, 0]))
        element.set("solimp", row([STIFFEST, STIFFEST, 0.001]))
    return xml_text(root)


def _set_mjcf_pose(element: Element, X: RigidTransform) -> None:
    element.set("pos", row(X.translation()))
    element.set("quat", row(X.rotation().ToQuaternion().wxyz()))


def _add_mjcf_body(parent: Element, link: Link) -> Element:
    body = SubElement(parent, "body", name=link.body)
    _set_mjcf_pose(body, link.on_parent @ link.on_child.inverse())
    if link.mass > 0:
        moments, turn = principal(link.inertia)
        numbers = {"mass": link.mass, "diaginertia": moments, "pos": link.center_of_mass, "quat": turn}
        SubElement(body, "inertial", {name: row(value) for name, value in numbers.items()})
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


def _add_mjcf_geometry(body: Element, geometry: Geometry) -> bool:
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
    _set_mjcf_pose(element, geometry.pose)
    return True


SDF_KINDS = {"weld": "fixed", "prismatic": "prismatic", "revolute": "revolute"}
GROUND = "fixed_to_the_world"  # name of the model with the world's geometries


def sdf(description: Description, time_step: float) -> str:
    """Return the SDF text, without geometries other than spheres, boxes, cylinders, capsules, ellipsoids, half spaces.

    Friction and compliance of contact are written for each geometry in Drake's elements. If all pairs have the same
    friction, it is also written in SDF's elements, as other simulators combine the friction of two geometries
    differently. Mimic joints are written in Drake's elements and in SDF's.
    """
    version = "1.11" if description.followers else "1.9"  # 1.11 is the first version with <mimic>
    root = Element("sdf", {"version": version, "xmlns:drake": "http://drake.mit.edu"})
    world = SubElement(root, "world", name="from_drake")
    SubElement(SubElement(world, "physics", name="step", type="ode"), "max_step_size").text = row(time_step)
    SubElement(world, "gravity").text = row(description.gravity)
    model = SubElement(world, "model", name="from_drake")
    zero = AtZero(description)
    links = {link.body: _add_sdf_link(model, link, zero) for link in description.links}
    for link in description.links:
        if link.kind != "quaternion_floating":
            _add_sdf_joint(model, description, link, zero)
    frictions = {pair.friction for pair in description.pairs}
    friction = frictions.pop() if len(frictions) == 1 else None
    if any(g.body == "world" for g in description.geometries):
        ground = SubElement(world, "model", name=GROUND)
        SubElement(ground, "static").text = "true"
        links["world"] = SubElement(ground, "link", name=GROUND)
    for geometry in description.geometries:
        _add_sdf_geometry(links[geometry.body], geometry, zero.in_frame(geometry.body) @ geometry.pose, friction)
    return xml_text(root)


def collision_name(geometry: str) -> str:
    """Replace "::", which is reserved in SDF."""
    return geometry.replace("::", "/")


def _add_sdf_link(model: Element, link: Link, zero: AtZero) -> Element:
    element = SubElement(model, "link", name=link.body)
    _add_texts(element, {"pose": [*zero.frames[link.body].translation(), 0, 0, 0]})
    center, inertia = zero.inertia(link)
    inertial = SubElement(element, "inertial")
    _add_texts(inertial, {"pose": [*center, 0, 0, 0], "mass": link.mass})
    _add_texts(SubElement(inertial, "inertia"), {name: inertia[index] for name, index in MOMENTS.items()})
    return element


def _add_texts(parent: Element, values: Mapping[str, object]) -> None:
    """Add an element with this name for each number or array."""
    for name, value in values.items():
        SubElement(parent, name).text = row(value)


def _add_sdf_joint(model: Element, description: Description, link: Link, zero: AtZero) -> None:
    joint = SubElement(model, "joint", name=link.joint, type=SDF_KINDS[link.kind])
    SubElement(joint, "parent").text = link.parent
    SubElement(joint, "child").text = link.body
    if link.kind == "weld":
        return
    axis = SubElement(joint, "axis")
    _add_texts(axis, {"xyz": zero.axis(link)})
    efforts = [e for e, x in zip(description.effort_limits, description.actuated, strict=True) if x == link.joint]
    numbers = {"lower": max(link.lower, -UNLIMITED), "upper": min(link.upper, UNLIMITED)}
    _add_texts(SubElement(axis, "limit"), {**numbers, "effort": min([UNLIMITED, *efforts]) if efforts else 0.0})
    numbers = {"damping": link.damping, "spring_reference": link.rest, "spring_stiffness": link.stiffness}
    _add_texts(SubElement(axis, "dynamics"), numbers)
    for follower in (follower for follower in description.followers if follower.joint == link.joint):
        numbers = {"multiplier": follower.ratio, "offset": follower.offset}
        _add_texts(SubElement(axis, "mimic", joint=follower.leader), {**numbers, "reference": 0.0})
        SubElement(joint, "drake:mimic", {"joint": follower.leader, **{name: row(x) for name, x in numbers.items()}})
    if link.armature:
        _add_texts(joint, {"drake:rotor_inertia": link.armature, "drake:gear_ratio": 1.0})


def _add_sdf_geometry(link: Element, geometry: Geometry, X: RigidTransform, friction: float | None) -> None:
    kind, sizes = shape_of(geometry)
    if not sizes:
        return
    collision = SubElement(link, "collision", name=collision_name(geometry.name))
    w, *xyz = X.rotation().ToQuaternion().wxyz()
    pose = SubElement(collision, "pose", rotation_format="quat_xyzw")
    pose.text = row([*X.translation(), *xyz, w])
    name = "plane" if kind == "HalfSpace" else kind.lower()
    _add_texts(SubElement(SubElement(collision, "geometry"), name), sizes)
    if friction is not None:
        ode = SubElement(SubElement(SubElement(collision, "surface"), "friction"), "ode")
        _add_texts(ode, {"mu": friction, "mu2": friction})
    material = {f"drake:{name}": x for quantity, x in geometry.material.items() for name in PROXIMITY[quantity]}
    _add_texts(SubElement(collision, "drake:proximity_properties"), material)

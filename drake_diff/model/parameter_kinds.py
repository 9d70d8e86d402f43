"""Parameters of bodies, joints, springs and actuators: unit, how each is read and written, what differentiates it.

Three sources of a derivative: "autodiff", where Drake keeps the quantity as a parameter of its context for either
scalar type; "chain_rule", where it enters the step as a generalized force that Drake differentiates (gravity,
prismatic springs); "finite_difference" of the double step for all that Drake takes as plain numbers (PD gains, the
time step; contact).

Parameters of contact, by body ("ball.friction", all its geometries) or by geometry ("ball/tip.friction").

Drake takes them as plain numbers only, so their derivative is a difference of the double step, but where
`contact_jacobian` has it in closed form.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.geometry import Capsule, Cylinder, ProximityProperties, Role, RoleAssign, SceneGraphInspector, Sphere
from pydrake.math import RigidTransform_, RotationMatrix_
from pydrake.multibody.plant import CoulombFriction
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ForceElementIndex,
    PdControllerGains,
    PrismaticSpring_,
    RevoluteSpring_,
    RotationalInertia_,
    SpatialInertia_,
    WeldJoint,
)

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import plain
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators, bodies, joints, labelled
from drake_diff.model.twin import GravityChange, SpringChange, Twin

# Drake drops the derivative of a frame's pose whose value is exactly the identity. A translation of this
# length [m] changes no number in the step and keeps the derivative.
IDENTITY_OFFSET = 1e-300

Values = Any  # (n,) floats, or AutoDiffXd where the twin is of that type
Found = Iterator[tuple[str, str, Any]]  # the element's label, the unit, the value in the model


@dataclass(frozen=True)
class Kind:
    """A quantity of some sort of element. `write` sets it in a twin, where an element is known by its label."""

    quantity: str
    source: str
    find: Callable[[Model], Found]
    write: Callable[[Twin, str, Values], None]
    positive: bool = False  # whether Drake takes no value below zero
    on_plant: bool = False  # whether it is set in the plant, which all contexts share


def _find_of_bodies(unit: str, read: Callable[[Any], Any]) -> Callable[[Model], Found]:
    def find(model: Model) -> Found:
        for label, body in labelled(bodies(model.plant)).items():
            yield label, unit, read(body)

    return find


def _central_inertia(body: Any) -> list[float]:
    inertia = body.default_spatial_inertia()
    about_com = inertia.Shift(inertia.get_com()).CalcRotationalInertia()
    return [*about_com.get_moments(), *about_com.get_products()]


def _find_inertia(model: Model) -> Found:
    for label, body in labelled(bodies(model.plant)).items():
        if body.default_mass() > 0:  # a frame without mass has none: setting it would end the process
            yield label, "kg m^2", _central_inertia(body)


def _write_mass(twin: Twin, label: str, value: Values) -> None:
    twin.body(label).SetMass(twin.context, value[0])


def _write_center_of_mass(twin: Twin, label: str, value: Values) -> None:
    twin.body(label).SetCenterOfMassInBodyFrame(twin.context, value)


def _write_inertia(twin: Twin, label: str, value: Values) -> None:
    body = twin.body(label)
    xx, yy, zz, xy, xz, yz = np.asarray(value).astype(twin.scalar)
    central = RotationalInertia_[twin.scalar](Ixx=xx, Iyy=yy, Izz=zz, Ixy=xy, Ixz=xz, Iyz=yz)
    mass, com = body.get_mass(twin.context), body.CalcCenterOfMassInBodyFrame(twin.context)
    body.SetSpatialInertiaInBodyFrame(
        twin.context, SpatialInertia_[twin.scalar].MakeFromCentralInertia(mass, com, central)
    )


def _find_damping(model: Model) -> Found:
    for label, joint in labelled(joints(model.plant)).items():
        if len(joint.default_damping_vector()) == 1:
            yield label, _unit(joint, "N s/m", "N m s/rad"), joint.default_damping_vector()


def _write_damping(twin: Twin, label: str, value: Values) -> None:
    twin.joint(label).SetDampingVector(twin.context, value)


def _find_offset(model: Model) -> Found:
    for label, joint in labelled(joints(model.plant)).items():
        if isinstance(joint.frame_on_parent(), FixedOffsetFrame) and not isinstance(joint, WeldJoint):
            yield label, "m", joint.frame_on_parent().GetFixedPoseInBodyFrame().translation()


def _write_offset(twin: Twin, label: str, value: Values) -> None:
    frame, scalar = twin.joint(label).frame_on_parent(), twin.scalar
    rotation = plain(frame.GetFixedPoseInBodyFrame().rotation().matrix())
    if np.all(plain(value) == 0) and np.array_equal(rotation, np.eye(3)):
        value = value + np.array([0.0, 0.0, IDENTITY_OFFSET])
    pose = RigidTransform_[scalar](RotationMatrix_[scalar](rotation.astype(scalar)), np.asarray(value).astype(scalar))
    frame.SetPoseInParentFrame(twin.context, pose)


def _unit(joint: Any, prismatic: str, other: str) -> str:
    return prismatic if joint.type_name() == "prismatic" else other


def _springs(plant: Any, kind: Any) -> dict[str, Any]:
    """The springs of a kind by their joint's label; of two springs on one joint neither can be named."""
    labels = {joint.index(): label for label, joint in labelled(joints(plant)).items()}
    elements = [plant.get_force_element(ForceElementIndex(i)) for i in range(plant.num_force_elements())]
    found = [(labels[e.joint().index()], e) for e in elements if isinstance(e, kind)]
    names = [label for label, _ in found]
    return {label: spring for label, spring in found if names.count(label) == 1}


def _find_revolute_spring(unit: str, read: Callable[[Any], float]) -> Callable[[Model], Found]:
    def find(model: Model) -> Found:
        for label, spring in _springs(model.plant, RevoluteSpring_[float]).items():
            yield label, unit, read(spring)

    return find


def _write_revolute_spring(setter: str) -> Callable[[Twin, str, Values], None]:
    def write(twin: Twin, label: str, value: Values) -> None:
        getattr(_springs(twin.plant, RevoluteSpring_[twin.scalar])[label], setter)(twin.context, value[0])

    return write


def _find_prismatic_spring(unit: str, read: Callable[[Any], float]) -> Callable[[Model], Found]:
    def find(model: Model) -> Found:
        if model.takes_forces:
            for label, spring in _springs(model.plant, PrismaticSpring_[float]).items():
                yield label, unit, read(spring)

    return find


def _write_prismatic_spring(field: str) -> Callable[[Twin, str, Values], None]:
    def write(twin: Twin, label: str, value: Values) -> None:
        name = f"{label}.spring"
        if name not in twin.added:
            twin.added[name] = SpringChange.none(_springs(twin.plant, PrismaticSpring_[twin.scalar])[label])
        setattr(twin.added[name], field, value[0])

    return write


def _find_of_actuators(unit: str, quantity: str) -> Callable[[Model], Found]:
    def find(model: Model) -> Found:
        for label, actuator in labelled(actuators(model.plant)).items():
            yield label, unit, getattr(actuator, f"default_{quantity}")()

    return find


def _write_actuator(setter: str) -> Callable[[Twin, str, Values], None]:
    def write(twin: Twin, label: str, value: Values) -> None:
        getattr(twin.actuator(label), setter)(twin.context, value[0])

    return write


def _find_gain(which: str, prismatic: str, other: str) -> Callable[[Model], Found]:
    def find(model: Model) -> Found:
        for label, actuator in labelled(actuators(model.plant)).items():
            if actuator.has_controller():
                yield label, _unit(actuator.joint(), prismatic, other), getattr(actuator.get_controller_gains(), which)

    return find


def _write_gain(which: str) -> Callable[[Twin, str, Values], None]:
    def write(twin: Twin, label: str, value: Values) -> None:
        actuator = twin.actuator(label)
        gains = {"p": actuator.get_controller_gains().p, "d": actuator.get_controller_gains().d}
        gains[which] = float(value[0])
        actuator.set_controller_gains(PdControllerGains(**gains))

    return write


def _find_time_step(model: Model) -> Found:
    if model.can_rebuild:
        yield "model", "s", model.time_step


def _write_time_step(twin: Twin, label: str, value: Values) -> None:
    """Nothing is set: a plant keeps its time step, and another model stands in (`parameters.applied`)."""


def _find_gravity(model: Model) -> Found:
    if model.takes_forces:
        yield "model", "m/s^2", model.plant.gravity_field().gravity_vector()


def _write_gravity(twin: Twin, label: str, value: Values) -> None:
    own: Array = plain(value)
    twin.plant.mutable_gravity_field().set_gravity_vector(own)
    if np.asarray(value).dtype == object:  # the plant takes the number, a force carries its derivative
        twin.added["gravity"] = GravityChange(value - own)


# In the order of writing: what an earlier one moves along, a later one sets.
MECHANISM_KINDS = (
    Kind("time_step", "finite_difference", _find_time_step, _write_time_step, positive=True),
    Kind("gravity", "chain_rule", _find_gravity, _write_gravity, on_plant=True),
    Kind("mass", "autodiff", _find_of_bodies("kg", lambda b: b.default_mass()), _write_mass, positive=True),
    Kind("center_of_mass", "autodiff", _find_of_bodies("m", lambda b: b.default_com()), _write_center_of_mass),
    Kind("inertia", "autodiff", _find_inertia, _write_inertia),
    Kind("damping", "autodiff", _find_damping, _write_damping, positive=True),
    Kind("offset", "autodiff", _find_offset, _write_offset),
    Kind(
        "spring_stiffness",
        "autodiff",
        _find_revolute_spring("N m/rad", lambda s: s.default_stiffness()),
        _write_revolute_spring("SetStiffness"),
        positive=True,
    ),
    Kind(
        "spring_rest_angle",
        "autodiff",
        _find_revolute_spring("rad", lambda s: s.default_nominal_angle()),
        _write_revolute_spring("SetNominalAngle"),
    ),
    Kind(
        "spring_stiffness",
        "chain_rule",
        _find_prismatic_spring("N/m", lambda s: s.stiffness()),
        _write_prismatic_spring("stiffness"),
        positive=True,
    ),
    Kind(
        "spring_rest_length",
        "chain_rule",
        _find_prismatic_spring("m", lambda s: s.nominal_position()),
        _write_prismatic_spring("rest"),
    ),
    Kind("gear_ratio", "autodiff", _find_of_actuators("1", "gear_ratio"), _write_actuator("SetGearRatio")),
    Kind(
        "rotor_inertia",
        "autodiff",
        _find_of_actuators("kg m^2", "rotor_inertia"),
        _write_actuator("SetRotorInertia"),
        positive=True,
    ),
    Kind("kp", "finite_difference", _find_gain("p", "N/m", "N m/rad"), _write_gain("p"), positive=True, on_plant=True),
    Kind(
        "kd", "finite_difference", _find_gain("d", "N s/m", "N m s/rad"), _write_gain("d"), positive=True, on_plant=True
    ),
)


_PROPERTIES = {  # quantity: (group, name, unit)
    "friction": ("material", "coulomb_friction", "1"),
    "stiffness": ("material", "point_contact_stiffness", "N/m"),
    "dissipation": ("material", "hunt_crossley_dissipation", "s/m"),
    "relaxation_time": ("material", "relaxation_time", "s"),
    "hydroelastic_modulus": ("hydroelastic", "hydroelastic_modulus", "Pa"),
}
_ROUND = (Sphere, Cylinder, Capsule)


def geometries_of(twin: Twin) -> dict[str, list[Any]]:
    """Collision geometries by the label of a body, and one by one."""
    inspector, plant = twin.inspector, twin.plant
    if inspector is None or twin.scene_graph is None:
        return {}
    found: dict[str, list[Any]] = {}
    for label, body in {"world": plant.world_body(), **labelled(bodies(plant))}.items():
        frame = plant.GetBodyFrameIdIfExists(body.index())
        own = [] if frame is None else list(inspector.GetGeometries(frame, Role.kProximity))
        if own:
            found[label] = own
            found |= {f"{label}/{inspector.GetName(i).split('::')[-1]}": [i] for i in own}
    return found


def _find(quantity: str, unit: str, read: Callable[[SceneGraphInspector, Any], float | None]) -> Kind:
    def find(model: Model) -> Found:
        for label, ids in geometries_of(model.double).items():
            values = {read(model.double.inspector, i) for i in ids}
            value = values.pop()
            if value is not None and not values:  # of geometries that differ each has its own value
                yield label, unit, value

    write = _write_radius if quantity == "radius" else _write_property(quantity)
    return Kind(quantity, "finite_difference", find, write, positive=True)


def _read_property(quantity: str) -> Callable[[SceneGraphInspector, Any], float | None]:
    group, name, _ = _PROPERTIES[quantity]

    def read(inspector: SceneGraphInspector, geometry: Any) -> float | None:
        properties = inspector.GetProximityProperties(geometry)
        if not properties.HasProperty(group, name):
            return None
        value = properties.GetProperty(group, name)
        return float(value.dynamic_friction() if quantity == "friction" else value)

    return read


def _read_radius(inspector: SceneGraphInspector, geometry: Any) -> float | None:
    shape = inspector.GetShape(geometry)
    return float(shape.radius()) if isinstance(shape, _ROUND) else None


def _write_property(quantity: str) -> Callable[[Twin, str, Values], None]:
    group, name, _ = _PROPERTIES[quantity]

    def write(twin: Twin, label: str, value: Values) -> None:
        new, inspector = float(value[0]), twin.inspector
        root = twin.scene_graph.GetMyMutableContextFromRoot(twin.root_context)
        for geometry in geometries_of(twin)[label]:
            properties = ProximityProperties(inspector.GetProximityProperties(geometry))
            properties.UpdateProperty(group, name, CoulombFriction(new, new) if quantity == "friction" else new)
            twin.scene_graph.AssignRole(root, twin.plant.get_source_id(), geometry, properties, RoleAssign.kReplace)

    return write


def _write_radius(twin: Twin, label: str, value: Values) -> None:
    radius, inspector = float(value[0]), twin.inspector
    root = twin.scene_graph.GetMyMutableContextFromRoot(twin.root_context)
    for geometry in geometries_of(twin)[label]:
        shape = inspector.GetShape(geometry)
        new = Sphere(radius) if isinstance(shape, Sphere) else type(shape)(radius, shape.length())
        twin.scene_graph.ChangeShape(root, twin.plant.get_source_id(), geometry, new)


CONTACT_KINDS = (
    *(_find(quantity, _PROPERTIES[quantity][2], _read_property(quantity)) for quantity in _PROPERTIES),
    _find("radius", "m", _read_radius),
)

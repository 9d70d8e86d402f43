"""The kinds of physical parameter: where each is found, its unit, how it is written, and what differentiates it.

There are three sources of a derivative:

- "autodiff": Drake keeps the quantity in its context, for floats and for AutoDiffXd;
- "chain_rule": it enters the step as a generalized force that Drake differentiates (gravity, prismatic springs);
- "finite_difference" of the double step: Drake takes it as a plain number (PD gains, time step, all of contact). For
  contact `derivatives.contact.jacobian` has it in closed form in many cases.

Parameters of contact are named by body ("ball.friction": all its geometries) or by geometry ("ball/tip.friction").
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from operator import methodcaller as get
from typing import Any

import numpy as np
from pydrake.geometry import Capsule, Cylinder, ProximityProperties, Role, RoleAssign, Sphere
from pydrake.math import RigidTransform_, RotationMatrix_
from pydrake.multibody import tree
from pydrake.multibody.plant import CoulombFriction

from drake_diff._base.autodiff import plain
from drake_diff.model.model import Model
from drake_diff.model.plant import PROXIMITY, actuators, bodies, joints, labelled, proximity_property
from drake_diff.model.twin import GravityChange, SpringChange, Twin

# Drake drops the derivative of a frame's pose whose value is exactly the identity. A translation of this
# length [m] changes no number in the step and keeps the derivative.
IDENTITY_OFFSET = 1e-300
AUTODIFF, CHAIN_RULE, DIFFERENCE = "autodiff", "chain_rule", "finite_difference"
DAMPING = ("N s/m", "N m s/rad")

Values = Any  # (n,) floats, or AutoDiffXd where the twin is of that type
Elements = Callable[[Model], Mapping[str, Any]]  # what of a model has the quantity, by label
Write = Callable[[Twin, str, Values], None]


@dataclass(frozen=True)
class Kind:
    """A quantity of some sort of element. `write` sets it in a twin, where an element is known by its label."""

    quantity: str
    source: str
    elements: Elements
    unit: str | tuple[str, str]  # of two: where the element moves along a line, and else
    read: Callable[[Any], Any]  # the value of an element in the model; None where it has none
    write: Write
    positive: bool = False  # whether Drake takes no value below zero
    on_plant: bool = False  # whether it is set in the plant, which all contexts share

    def find(self, model: Model) -> Iterator[tuple[str, str, Any]]:
        """The label of every element that has the quantity, the unit, and the value in the model."""
        for label, element in self.elements(model).items():
            value, unit = self.read(element), self.unit
            if isinstance(unit, tuple):
                joint = element.joint() if hasattr(element, "joint") else element
                unit = unit[0] if joint.type_name() == "prismatic" else unit[1]
            if value is not None:
                yield label, unit, value


def _rebuildable(model: Model) -> dict[str, Any]:
    return {"model": model} if model.can_rebuild else {}


def _taking_forces(model: Model) -> dict[str, Any]:
    return {"model": model} if model.takes_forces else {}


def _bodies(model: Model) -> dict[str, Any]:
    return labelled(bodies(model.plant))


def _joints(model: Model) -> dict[str, Any]:
    return labelled(joints(model.plant))


def _springs(plant: Any, kind: Any) -> dict[str, Any]:
    """The springs of a kind by their joint's label; of two springs on one joint neither can be named."""
    labels = {joint.index(): label for label, joint in labelled(joints(plant)).items()}
    elements = [plant.get_force_element(tree.ForceElementIndex(i)) for i in range(plant.num_force_elements())]
    springs = [(labels[e.joint().index()], e) for e in elements if isinstance(e, kind)]
    names = [label for label, _ in springs]
    return {label: spring for label, spring in springs if names.count(label) == 1}


def _hinge_springs(model: Model) -> dict[str, Any]:
    return _springs(model.plant, tree.RevoluteSpring_[float])


def _slide_springs(model: Model) -> dict[str, Any]:
    return _springs(model.plant, tree.PrismaticSpring_[float]) if model.takes_forces else {}


def _actuators(model: Model) -> dict[str, Any]:
    return labelled(actuators(model.plant))


def geometries_of(twin: Twin) -> dict[str, list[Any]]:
    """Collision geometries by the label of a body, and one by one."""
    inspector, plant = twin.inspector, twin.plant
    if inspector is None or twin.scene_graph is None:
        return {}
    by_label: dict[str, list[Any]] = {}
    for label, body in {"world": plant.world_body(), **labelled(bodies(plant))}.items():
        frame = plant.GetBodyFrameIdIfExists(body.index())
        of_body = [] if frame is None else list(inspector.GetGeometries(frame, Role.kProximity))
        if of_body:
            by_label[label] = of_body
            by_label |= {f"{label}/{inspector.GetName(i).split('::')[-1]}": [i] for i in of_body}
    return by_label


def _read_inertia(body: Any) -> list[float] | None:
    if not body.default_mass() > 0:
        return None  # a frame without mass has no inertia: setting it would end the process
    inertia = body.default_spatial_inertia()
    about_com = inertia.Shift(inertia.get_com()).CalcRotationalInertia()
    return [*about_com.get_moments(), *about_com.get_products()]


def _write_inertia(twin: Twin, label: str, value: Values) -> None:
    body = twin.body(label)
    xx, yy, zz, xy, xz, yz = np.asarray(value).astype(twin.scalar)
    central = tree.RotationalInertia_[twin.scalar](Ixx=xx, Iyy=yy, Izz=zz, Ixy=xy, Ixz=xz, Iyz=yz)
    mass, com = body.get_mass(twin.context), body.CalcCenterOfMassInBodyFrame(twin.context)
    body.SetSpatialInertiaInBodyFrame(
        twin.context, tree.SpatialInertia_[twin.scalar].MakeFromCentralInertia(mass, com, central)
    )


def _read_damping(joint: Any) -> Any:
    damping = joint.default_damping_vector()
    return damping if len(damping) == 1 else None


def _read_offset(joint: Any) -> Any:
    frame = joint.frame_on_parent()
    if isinstance(joint, tree.WeldJoint) or not isinstance(frame, tree.FixedOffsetFrame):
        return None
    return frame.GetFixedPoseInBodyFrame().translation()


def _write_offset(twin: Twin, label: str, value: Values) -> None:
    frame, scalar = twin.joint(label).frame_on_parent(), twin.scalar
    rotation = plain(frame.GetFixedPoseInBodyFrame().rotation().matrix())
    if np.all(plain(value) == 0) and np.array_equal(rotation, np.eye(3)):
        value = value + np.array([0.0, 0.0, IDENTITY_OFFSET])
    pose = RigidTransform_[scalar](RotationMatrix_[scalar](rotation.astype(scalar)), np.asarray(value).astype(scalar))
    frame.SetPoseInParentFrame(twin.context, pose)


def _setter(element: Callable[[Twin, str], Any], name: str, *, vector: bool = False) -> Write:
    """Write a number, or a vector, by the method of Drake's element that is called `name`."""

    def write(twin: Twin, label: str, value: Values) -> None:
        getattr(element(twin, label), name)(twin.context, value if vector else value[0])

    return write


def _hinge_spring(twin: Twin, label: str) -> Any:
    return _springs(twin.plant, tree.RevoluteSpring_[twin.scalar])[label]


def _set_slide(field: str) -> Write:
    def write(twin: Twin, label: str, value: Values) -> None:
        name = f"{label}.spring"
        if name not in twin.added:
            twin.added[name] = SpringChange.none(_springs(twin.plant, tree.PrismaticSpring_[twin.scalar])[label])
        setattr(twin.added[name], field, value[0])

    return write


def _gain(quantity: str, which: str, unit: tuple[str, str]) -> Kind:
    def write(twin: Twin, label: str, value: Values) -> None:
        actuator = twin.actuator(label)
        gains = {"p": actuator.get_controller_gains().p, "d": actuator.get_controller_gains().d}
        gains[which] = float(value[0])
        actuator.set_controller_gains(tree.PdControllerGains(**gains))

    def read(actuator: Any) -> float | None:
        return float(getattr(actuator.get_controller_gains(), which)) if actuator.has_controller() else None

    return Kind(quantity, DIFFERENCE, _actuators, unit, read, write, positive=True, on_plant=True)


def _read_gravity(model: Model) -> Any:
    return model.plant.gravity_field().gravity_vector()


def _write_gravity(twin: Twin, label: str, value: Values) -> None:
    vector = plain(value)
    twin.plant.mutable_gravity_field().set_gravity_vector(vector)
    if np.asarray(value).dtype == object:  # the plant takes the number, a force carries its derivative
        twin.added["gravity"] = GravityChange(value - vector)


_set_center_of_mass = _setter(Twin.body, "SetCenterOfMassInBodyFrame", vector=True)
_set_damping = _setter(Twin.joint, "SetDampingVector", vector=True)
_set_stiffness, _set_rest_angle = _setter(_hinge_spring, "SetStiffness"), _setter(_hinge_spring, "SetNominalAngle")
_set_rotor_inertia = _setter(Twin.actuator, "SetRotorInertia")

# In the order of writing: what an earlier one moves along, a later one sets.
MECHANISM_KINDS = (
    # A plant keeps its time step, so nothing is written: another model stands in (`parameters.applied`).
    Kind("time_step", DIFFERENCE, _rebuildable, "s", attrgetter("time_step"), lambda *_: None, positive=True),
    Kind("gravity", CHAIN_RULE, _taking_forces, "m/s^2", _read_gravity, _write_gravity, on_plant=True),
    Kind("mass", AUTODIFF, _bodies, "kg", get("default_mass"), _setter(Twin.body, "SetMass"), positive=True),
    Kind("center_of_mass", AUTODIFF, _bodies, "m", get("default_com"), _set_center_of_mass),
    Kind("inertia", AUTODIFF, _bodies, "kg m^2", _read_inertia, _write_inertia),
    Kind("damping", AUTODIFF, _joints, DAMPING, _read_damping, _set_damping, positive=True),
    Kind("offset", AUTODIFF, _joints, "m", _read_offset, _write_offset),
    Kind(
        "spring_stiffness", AUTODIFF, _hinge_springs, "N m/rad", get("default_stiffness"), _set_stiffness, positive=True
    ),
    Kind("spring_rest_angle", AUTODIFF, _hinge_springs, "rad", get("default_nominal_angle"), _set_rest_angle),
    Kind(
        "spring_stiffness", CHAIN_RULE, _slide_springs, "N/m", get("stiffness"), _set_slide("stiffness"), positive=True
    ),
    Kind("spring_rest_length", CHAIN_RULE, _slide_springs, "m", get("nominal_position"), _set_slide("rest")),
    Kind("gear_ratio", AUTODIFF, _actuators, "1", get("default_gear_ratio"), _setter(Twin.actuator, "SetGearRatio")),
    Kind(
        "rotor_inertia", AUTODIFF, _actuators, "kg m^2", get("default_rotor_inertia"), _set_rotor_inertia, positive=True
    ),
    _gain("kp", "p", ("N/m", "N m/rad")),
    _gain("kd", "d", DAMPING),
)


def _contact_kind(quantity: str, unit: str, read: Callable[[Any, Any], Any], change: Callable[..., None]) -> Kind:
    """`read(inspector, geometry)`, None where it has no value; `change(twin, geometry, value, root context)`."""

    def values(model: Model) -> dict[str, set[Any]]:
        geometries = geometries_of(model.double)
        return {label: {read(model.double.inspector, i) for i in ids} for label, ids in geometries.items()}

    def write(twin: Twin, label: str, value: Values) -> None:
        root = twin.scene_graph.GetMyMutableContextFromRoot(twin.root_context)
        for geometry in geometries_of(twin)[label]:
            change(twin, geometry, float(value[0]), root)

    # Of geometries that differ each has its own value, their body none.
    return Kind(quantity, DIFFERENCE, values, unit, lambda v: v.pop() if len(v) == 1 else None, write, positive=True)


def _change_property(twin: Twin, geometry: Any, value: float, root: Any, *, quantity: str) -> None:
    properties = ProximityProperties(twin.inspector.GetProximityProperties(geometry))
    friction_or_number = CoulombFriction(value, value) if quantity == "friction" else value
    properties.UpdateProperty(*PROXIMITY[quantity], friction_or_number)
    twin.scene_graph.AssignRole(root, twin.plant.get_source_id(), geometry, properties, RoleAssign.kReplace)


def _read_radius(inspector: Any, geometry: Any) -> float | None:
    shape = inspector.GetShape(geometry)
    return float(shape.radius()) if isinstance(shape, Sphere | Cylinder | Capsule) else None


def _change_radius(twin: Twin, geometry: Any, radius: float, root: Any) -> None:
    shape = twin.inspector.GetShape(geometry)
    new = Sphere(radius) if isinstance(shape, Sphere) else type(shape)(radius, shape.length())
    twin.scene_graph.ChangeShape(root, twin.plant.get_source_id(), geometry, new)


def _property_kind(quantity: str, unit: str) -> Kind:
    read = partial(proximity_property, quantity=quantity)
    return _contact_kind(quantity, unit, read, partial(_change_property, quantity=quantity))


CONTACT_KINDS = (
    *map(_property_kind, PROXIMITY, ("1", "N/m", "s/m", "s", "Pa")),
    _contact_kind("radius", "m", _read_radius, _change_radius),
)

"""Read a model's contract out of Drake's plant and scene graph."""

from typing import Any

from pydrake.geometry import ProximityProperties, Role, SceneGraphInspector

from drake_diff.contract import Actuator, Body, CollisionGeometry, Contact, Contract, Coordinate, Joint
from drake_diff.model import Model
from drake_diff.plant_elements import actuators, bodies, joints

# Drake's SAP solver stops at this relative change of momentum and cost; pydrake cannot change it.
SAP_RELATIVE_TOLERANCE = 1e-6

_UNITS = {  # joint type: (units of q, units of v)
    "revolute": (("rad",), ("rad/s",)),
    "prismatic": (("m",), ("m/s",)),
    "screw": (("rad",), ("rad/s",)),
    "curvilinear": (("m",), ("m/s",)),
    "universal": (("rad",) * 2, ("rad/s",) * 2),
    "planar": (("m", "m", "rad"), ("m/s", "m/s", "rad/s")),
    "ball_rpy": (("rad",) * 3, ("rad/s",) * 3),
    "rpy_floating": (("rad",) * 3 + ("m",) * 3, ("rad/s",) * 3 + ("m/s",) * 3),
    "quaternion_floating": (("1",) * 4 + ("m",) * 3, ("rad/s",) * 3 + ("m/s",) * 3),
}


def read_contract(model: Model) -> Contract:
    """The contract of `model`, from Drake's own plant and scene graph."""
    plant = model.plant
    return Contract(
        name=model.name,
        source=str(model.source) if model.source else None,
        time_step=model.time_step,
        integrator="semi-implicit Euler; damping, PD control, limits and contact implicit",
        scalar_types=("double", "AutoDiffXd"),
        gravity=_floats(plant.gravity_field().gravity_vector()),
        frame="world, z up; v of a floating body is w_WB then v_WBo, expressed in world",
        positions=_coordinates(model.position_names, _units(model, 0), *_position_limits(model)),
        velocities=_coordinates(model.velocity_names, _units(model, 1), *_velocity_limits(model)),
        inputs=_coordinates(model.input_names, _input_units(model), *_effort_limits(model)),
        bodies=tuple(_read_body(model, body) for body in bodies(plant)),
        joints=tuple(_read_joint(model, joint) for joint in joints(plant)),
        actuators=tuple(_read_actuator(actuator) for actuator in actuators(plant)),
        geometries=_read_geometries(model),
        contact=_read_contact(model),
        constraints=plant.num_constraints(),
        notes=model.notes,
    )


def _coordinates(names: Any, units: Any, lower: Any, upper: Any) -> tuple[Coordinate, ...]:
    return tuple(
        Coordinate(name, unit, float(low), float(high))
        for name, unit, low, high in zip(names, units, lower, upper, strict=True)
    )


def _position_limits(model: Model) -> tuple[Any, Any]:
    return model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()


def _velocity_limits(model: Model) -> tuple[Any, Any]:
    return model.plant.GetVelocityLowerLimits(), model.plant.GetVelocityUpperLimits()


def _effort_limits(model: Model) -> tuple[Any, Any]:
    return model.plant.GetEffortLowerLimits(), model.plant.GetEffortUpperLimits()


def _units(model: Model, which: int) -> list[str]:
    """Units of q (which = 0) or v (which = 1), joint by joint."""
    units = ["?"] * (model.nv if which else model.nq)
    for joint in joints(model.plant):
        start = joint.velocity_start() if which else joint.position_start()
        for i, unit in enumerate(_UNITS.get(joint.type_name(), ((), ()))[which]):
            units[start + i] = unit
    return units


def _input_units(model: Model) -> list[str]:
    return ["N" if a.joint().type_name() == "prismatic" else "N m" for a in actuators(model.plant)]


def _read_body(model: Model, body: Any) -> Body:
    inertia = body.CalcSpatialInertiaInBodyFrame(model.double.context)
    about_com = inertia.Shift(inertia.get_com()).CalcRotationalInertia()
    return Body(
        name=body.name(),
        mass=float(inertia.get_mass()),
        center_of_mass=_floats(inertia.get_com()),
        inertia=_floats(about_com.get_moments()) + _floats(about_com.get_products()),
    )


def _read_joint(model: Model, joint: Any) -> Joint:
    return Joint(
        name=joint.name(),
        type=joint.type_name(),
        parent=joint.parent_body().name(),
        child=joint.child_body().name(),
        damping=_floats(joint.default_damping_vector()),
        locked=bool(joint.is_locked(model.double.context)),
    )


def _read_actuator(actuator: Any) -> Actuator:
    gains = actuator.get_controller_gains() if actuator.has_controller() else None
    return Actuator(
        name=actuator.name(),
        joint=actuator.joint().name(),
        effort_limit=float(actuator.effort_limit()),
        gear_ratio=float(actuator.default_gear_ratio()),
        rotor_inertia=float(actuator.default_rotor_inertia()),
        kp=float(gains.p) if gains else None,
        kd=float(gains.d) if gains else None,
    )


def _read_geometries(model: Model) -> tuple[CollisionGeometry, ...]:
    inspector = model.double.inspector
    if inspector is None:
        return ()
    ids = inspector.GetAllGeometryIds(Role.kProximity)
    return tuple(_read_geometry(model, inspector, geometry_id) for geometry_id in ids)


def _read_geometry(model: Model, inspector: SceneGraphInspector, geometry_id: Any) -> CollisionGeometry:
    properties = inspector.GetProximityProperties(geometry_id)
    body = model.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry_id))
    friction = _property(properties, "material", "coulomb_friction")
    return CollisionGeometry(
        name=inspector.GetName(geometry_id),
        body=body.name() if body is not None else "?",
        shape=type(inspector.GetShape(geometry_id)).__name__,
        friction=None if friction is None else float(friction.dynamic_friction()),
        stiffness=_property(properties, "material", "point_contact_stiffness"),
        dissipation=_property(properties, "material", "hunt_crossley_dissipation"),
        relaxation_time=_property(properties, "material", "relaxation_time"),
        hydroelastic_modulus=_property(properties, "hydroelastic", "hydroelastic_modulus"),
    )


def _property(properties: ProximityProperties, group: str, name: str) -> Any:
    return properties.GetProperty(group, name) if properties.HasProperty(group, name) else None


def _read_contact(model: Model) -> Contact:
    inspector = model.double.inspector
    return Contact(
        model={"kPoint": "point", "kHydroelastic": "hydroelastic"}.get(
            model.plant.get_contact_model().name, "hydroelastic_with_fallback"
        ),
        approximation=model.plant.get_discrete_contact_approximation().name.removeprefix("k").lower(),
        geometry=model.contact_geometry or "as modelled",
        collision_pairs=len(inspector.GetCollisionCandidates()) if inspector is not None else 0,
        solver_relative_tolerance=SAP_RELATIVE_TOLERANCE,
        sap_near_rigid_threshold=float(model.plant.get_sap_near_rigid_threshold()),
    )


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in values)

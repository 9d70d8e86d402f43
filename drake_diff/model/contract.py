"""The contract of a model: names, units, frames, sizes, limits, contact parameters and tolerances."""

import math
from dataclasses import asdict, dataclass
from typing import Any

from pydrake.geometry import Role

from drake_diff._base.values import plain_numbers, preformatted
from drake_diff.model.plant import PROXIMITY, actuators, bodies, central_inertia, joints, proximity_property
from drake_diff.model.twin import Twin


@dataclass(frozen=True)
class CoordinateTerms:
    """An entry of q, v or u."""

    name: str
    unit: str
    lower: float
    upper: float


@dataclass(frozen=True)
class BodyTerms:
    """Mass [kg]; centre of mass [m] and inertia xx yy zz xy xz yz [kg m^2] about it, in the body's frame."""

    name: str
    mass: float
    center_of_mass: tuple[float, ...]
    inertia: tuple[float, ...]


@dataclass(frozen=True)
class JointTerms:
    """A joint and its damping [N s/m or N m s/rad], which is implicit in Drake's step."""

    name: str
    type: str
    parent: str
    child: str
    damping: tuple[float, ...]
    locked: bool


@dataclass(frozen=True)
class ActuatorTerms:
    """An actuator on a joint, with its PD gains, if any, whose target is the joint's default position."""

    name: str
    joint: str
    effort_limit: float
    gear_ratio: float
    rotor_inertia: float
    kp: float | None
    kd: float | None


@dataclass(frozen=True)
class GeometryTerms:
    """A geometry that may collide; a value is None if the model does not set it, so that Drake's default applies."""

    name: str
    body: str
    shape: str
    friction: float | None
    stiffness: float | None  # [N/m]
    dissipation: float | None  # Hunt-Crossley dissipation [s/m], for similar and lagged contact
    relaxation_time: float | None  # [s], for sap contact
    hydroelastic_modulus: float | None  # [Pa]


@dataclass(frozen=True)
class ContactTerms:
    """The contact model and its parameters."""

    model: str
    approximation: str
    geometry: str  # "as modelled", or the route around pairs that AutoDiffXd does not support
    collision_pairs: int
    solver_relative_tolerance: float
    sap_near_rigid_threshold: float


@dataclass(frozen=True)
class Contract:
    """All properties that a run depends on, read from Drake in SI units; `print(contract)` shows them.

    Example:
        >>> contract = dd.load_model("models/pendulum.urdf", time_step=0.01).contract
        >>> contract
        Contract of pendulum: time step 0.01 s, semi-implicit Euler; damping, PD control, limits and contact implicit
          positions 1, velocities 1, inputs 1, bodies 1, joints 1, collision geometries 0, constraints 0
          contact point, sap; print(contract) shows everything
        >>> contract.positions[0].name, contract.positions[0].unit
        ('hinge_q', 'rad')
    """

    name: str
    source: str | None
    time_step: float  # [s]
    integrator: str
    scalar_types: tuple[str, ...]
    gravity: tuple[float, ...]  # [m/s^2], in the world frame
    frame: str
    positions: tuple[CoordinateTerms, ...]
    velocities: tuple[CoordinateTerms, ...]
    inputs: tuple[CoordinateTerms, ...]
    bodies: tuple[BodyTerms, ...]
    joints: tuple[JointTerms, ...]
    actuators: tuple[ActuatorTerms, ...]
    geometries: tuple[GeometryTerms, ...]
    contact: ContactTerms
    constraints: int  # couplers, balls, welds, distances, tendons
    notes: tuple[str, ...]

    @property
    def is_unconstrained(self) -> bool:
        """Whether no constraint and no PD control acts on the model; joint limits and contact are not considered."""
        return not self.constraints and all(actuator.kp is None for actuator in self.actuators)

    def to_dict(self) -> dict[str, Any]:
        """Return dicts and lists for JSON; an absent (infinite) limit is None."""
        plain: dict[str, Any] = plain_numbers(asdict(self))
        return plain

    def __str__(self) -> str:
        lines = [
            f"{self.name}: time step {self.time_step:g} s, {self.integrator}",
            f"  source     {self.source or 'a diagram'}; scalar types {', '.join(self.scalar_types)}",
            f"  frame      {self.frame}; gravity {_row(self.gravity)} m/s^2",
            f"  contact    {self.contact.model}, {self.contact.approximation}, geometry {self.contact.geometry},"
            f" {self.contact.collision_pairs} pairs,"
            f" solver tolerance {self.contact.solver_relative_tolerance:g} (relative)",
        ]
        for kind, coordinates in (("q", self.positions), ("v", self.velocities), ("u", self.inputs)):
            for i, x in enumerate(coordinates):
                limits = "" if math.isinf(x.lower) and math.isinf(x.upper) else f" in [{x.lower:g}, {x.upper:g}]"
                lines.append(f"  {kind}[{i}]".ljust(13) + f"{x.name} [{x.unit}]{limits}")
        for body in self.bodies:
            lines.append(
                f"  body       {body.name}: {body.mass:g} kg at {_row(body.center_of_mass)} m,"
                f" inertia xx yy zz xy xz yz {_row(body.inertia)} kg m^2"
            )
        for joint in self.joints:
            damping = f", damping {_row(joint.damping)}" if any(joint.damping) else ""
            lines.append(
                f"  joint      {joint.name}: {joint.type}, {joint.parent} -> {joint.child}{damping}"
                f"{', locked' if joint.locked else ''}"
            )
        for a in self.actuators:
            gains = "" if a.kp is None else f", PD kp {a.kp:g} kd {a.kd:g}"
            limit = f", limit {a.effort_limit:g}" if math.isfinite(a.effort_limit) else ""
            lines.append(
                f"  actuator   {a.name} on {a.joint}{limit}, gear {a.gear_ratio:g}, rotor {a.rotor_inertia:g}{gains}"
            )
        for g in self.geometries:
            # sap uses only the relaxation time, similar and lagged only the Hunt-Crossley dissipation
            damped = f"dissipation {_or_default(g.dissipation)} s/m"
            if self.contact.approximation == "sap":
                damped = f"relaxation time {_or_default(g.relaxation_time)} s"
            lines.append(
                f"  collision  {g.name} of {g.body}: {g.shape}, friction {_or_default(g.friction)},"
                f" stiffness {_or_default(g.stiffness)} N/m, {damped}"
            )
        lines += [f"  note       {note}" for note in self.notes]
        return "\n".join(lines)

    def __repr__(self) -> str:
        counts = ["positions", "velocities", "inputs", "bodies", "joints", "geometries"]
        counted = ", ".join(f"{kind} {len(getattr(self, kind))}" for kind in counts).replace("geom", "collision geom")
        return (
            f"Contract of {self.name}: time step {self.time_step:g} s, {self.integrator}\n"
            f"  {counted}, constraints {self.constraints}\n"
            f"  contact {self.contact.model}, {self.contact.approximation}; print(contract) shows everything"
        )

    def _repr_html_(self) -> str:
        return preformatted(str(self))


def _row(values: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"


def _or_default(value: float | None) -> str:
    return "Drake's default" if value is None else f"{value:g}"


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


def read_contract(model: Any) -> Contract:
    """Read the contract of a Model."""
    twin: Twin = model.double
    plant, inspector, inputs = twin.plant, twin.inspector, twin.inputs
    geometries = [] if inspector is None else inspector.GetAllGeometryIds(Role.kProximity)
    contact_models = {"kPoint": "point", "kHydroelastic": "hydroelastic"}
    contact = ContactTerms(
        model=contact_models.get(plant.get_contact_model().name, "hydroelastic_with_fallback"),
        approximation=plant.get_discrete_contact_approximation().name.removeprefix("k").lower(),
        geometry=model.contact_geometry or "as modelled",
        collision_pairs=len(inspector.GetCollisionCandidates()) if inspector is not None else 0,
        solver_relative_tolerance=SAP_RELATIVE_TOLERANCE,
        sap_near_rigid_threshold=float(plant.get_sap_near_rigid_threshold()),
    )
    return Contract(
        name=model.name,
        source=str(model.source) if model.source else None,
        time_step=plant.time_step(),
        integrator="semi-implicit Euler; damping, PD control, limits and contact implicit",
        scalar_types=("double", "AutoDiffXd"),
        gravity=_floats(plant.gravity_field().gravity_vector()),
        frame="world, z up; v of a floating body is w_WB then v_WBo, expressed in world",
        positions=_terms(model.position_names, _units(twin, 0), *model.position_limits),
        velocities=_terms(model.velocity_names, _units(twin, 1), *model.velocity_limits),
        inputs=_terms(inputs.names, inputs.units, inputs.lower, inputs.upper),
        bodies=tuple(_body(twin, body) for body in bodies(plant)),
        joints=tuple(_joint(twin, joint) for joint in joints(plant)),
        actuators=tuple(_actuator(actuator) for actuator in actuators(plant)),
        geometries=tuple(_geometry(twin, geometry) for geometry in geometries),
        contact=contact,
        constraints=plant.num_constraints() if twin.coupling is None else 0,
        notes=model.notes,
    )


def _terms(names: Any, units: Any, lower: Any, upper: Any) -> tuple[CoordinateTerms, ...]:
    rows = zip(names, units, _floats(lower), _floats(upper), strict=True)
    return tuple(CoordinateTerms(*row) for row in rows)


def _units(twin: Twin, which: int) -> list[str]:
    """Return the units of q (which = 0) or v (which = 1), joint by joint."""
    plant = twin.plant
    units = ["?"] * (plant.num_velocities() if which else plant.num_positions())
    for joint in joints(plant):
        start = joint.velocity_start() if which else joint.position_start()
        for i, unit in enumerate(_UNITS.get(joint.type_name(), ((), ()))[which]):
            units[start + i] = unit
    if twin.coupling is not None:
        return [units[i] for i in (twin.coupling.own_v if which else twin.coupling.own_q)]
    return units


def _body(twin: Twin, body: Any) -> BodyTerms:
    inertia = body.CalcSpatialInertiaInBodyFrame(twin.context)
    six = _floats(central_inertia(inertia))
    return BodyTerms(body.name(), float(inertia.get_mass()), _floats(inertia.get_com()), six)


def _joint(twin: Twin, joint: Any) -> JointTerms:
    between, damping = (joint.parent_body().name(), joint.child_body().name()), joint.default_damping_vector()
    return JointTerms(joint.name(), joint.type_name(), *between, _floats(damping), bool(joint.is_locked(twin.context)))


def _actuator(actuator: Any) -> ActuatorTerms:
    gains = actuator.get_controller_gains() if actuator.has_controller() else None
    kp, kd = (float(gains.p), float(gains.d)) if gains else (None, None)
    limit, gear, rotor = actuator.effort_limit(), actuator.default_gear_ratio(), actuator.default_rotor_inertia()
    return ActuatorTerms(actuator.name(), actuator.joint().name(), float(limit), float(gear), float(rotor), kp, kd)


def _geometry(twin: Twin, geometry: Any) -> GeometryTerms:
    inspector = twin.inspector
    body = twin.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
    return GeometryTerms(
        name=inspector.GetName(geometry),
        body=body.name() if body is not None else "?",
        shape=type(inspector.GetShape(geometry)).__name__,
        **{quantity: proximity_property(inspector, geometry, quantity) for quantity in PROXIMITY},
    )


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in values)

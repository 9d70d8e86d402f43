"""What the model promises before any optimization: names, units, frames, sizes, limits, contact, tolerances."""

import math
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Coordinate:
    """One entry of q, v or u."""

    name: str
    unit: str
    lower: float
    upper: float


@dataclass(frozen=True)
class Body:
    """Mass [kg]; centre of mass [m] and inertia xx yy zz xy xz yz [kg m^2] about it, in the body's frame."""

    name: str
    mass: float
    center_of_mass: tuple[float, ...]
    inertia: tuple[float, ...]


@dataclass(frozen=True)
class Joint:
    """A joint and what holds it back: damping [N s/m or N m s/rad], implicit in Drake's step."""

    name: str
    type: str
    parent: str
    child: str
    damping: tuple[float, ...]
    locked: bool


@dataclass(frozen=True)
class Actuator:
    """An actuator on a joint; PD gains and their target (the joint's default position) where it has them."""

    name: str
    joint: str
    effort_limit: float
    gear_ratio: float
    rotor_inertia: float
    kp: float | None
    kd: float | None


@dataclass(frozen=True)
class CollisionGeometry:
    """What can touch. `None` is not given in the model: Drake's default decides."""

    name: str
    body: str
    shape: str
    friction: float | None
    stiffness: float | None  # [N/m]
    dissipation: float | None  # Hunt-Crossley [s/m]: similar and lagged contact
    relaxation_time: float | None  # [s]: sap contact
    hydroelastic_modulus: float | None  # [Pa]


@dataclass(frozen=True)
class Contact:
    """How contact is computed."""

    model: str
    approximation: str
    geometry: str  # "as modelled", or the route that was taken around pairs that AutoDiffXd refuses
    collision_pairs: int
    solver_relative_tolerance: float
    sap_near_rigid_threshold: float


@dataclass(frozen=True)
class Contract:
    """Everything a run rests on, read from Drake; SI units; `print(contract)` is for people."""

    name: str
    source: str | None
    time_step: float  # [s]
    integrator: str
    scalar_types: tuple[str, ...]
    gravity: tuple[float, ...]  # [m/s^2], in the world frame
    frame: str
    positions: tuple[Coordinate, ...]
    velocities: tuple[Coordinate, ...]
    inputs: tuple[Coordinate, ...]
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    actuators: tuple[Actuator, ...]
    geometries: tuple[CollisionGeometry, ...]
    contact: Contact
    constraints: int  # couplers, balls, welds, distances, tendons
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain dicts and lists for JSON: an absent limit (infinite) is None."""
        plain: dict[str, Any] = _plain(asdict(self))
        return plain

    def __str__(self) -> str:
        return "\n".join(_lines(self))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _lines(c: Contract) -> list[str]:
    lines = [
        f"{c.name}: time step {c.time_step:g} s, {c.integrator}",
        f"  source     {c.source or 'a diagram'}; scalar types {', '.join(c.scalar_types)}",
        f"  frame      {c.frame}; gravity {_row(c.gravity)} m/s^2",
        f"  contact    {c.contact.model}, {c.contact.approximation}, geometry {c.contact.geometry},"
        f" {c.contact.collision_pairs} pairs,"
        f" solver tolerance {c.contact.solver_relative_tolerance:g} (relative)",
    ]
    for kind, coordinates in (("q", c.positions), ("v", c.velocities), ("u", c.inputs)):
        for i, x in enumerate(coordinates):
            lines.append(f"  {kind}[{i}]".ljust(13) + f"{x.name} [{x.unit}]{_limits(x)}")
    for body in c.bodies:
        lines.append(
            f"  body       {body.name}: {body.mass:g} kg at {_row(body.center_of_mass)} m,"
            f" inertia xx yy zz xy xz yz {_row(body.inertia)} kg m^2"
        )
    for joint in c.joints:
        damping = f", damping {_row(joint.damping)}" if any(joint.damping) else ""
        lines.append(
            f"  joint      {joint.name}: {joint.type}, {joint.parent} -> {joint.child}{damping}"
            f"{', locked' if joint.locked else ''}"
        )
    for a in c.actuators:
        gains = "" if a.kp is None else f", PD kp {a.kp:g} kd {a.kd:g}"
        limit = f", limit {a.effort_limit:g}" if math.isfinite(a.effort_limit) else ""
        lines.append(
            f"  actuator   {a.name} on {a.joint}{limit}, gear {a.gear_ratio:g}, rotor {a.rotor_inertia:g}{gains}"
        )
    for g in c.geometries:
        lines.append(
            f"  collision  {g.name} of {g.body}: {g.shape}, friction {_or_default(g.friction)},"
            f" stiffness {_or_default(g.stiffness)} N/m, {_damping_of_contact(c.contact.approximation, g)}"
        )
    return lines + [f"  note       {note}" for note in c.notes]


def _damping_of_contact(approximation: str, g: CollisionGeometry) -> str:
    """What damps contact: sap knows only the relaxation time, similar and lagged only Hunt-Crossley's number."""
    if approximation == "sap":
        return f"relaxation time {_or_default(g.relaxation_time)} s"
    return f"dissipation {_or_default(g.dissipation)} s/m"


def _row(values: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"


def _limits(x: Coordinate) -> str:
    if math.isinf(x.lower) and math.isinf(x.upper):
        return ""
    return f" in [{x.lower:g}, {x.upper:g}]"


def _or_default(value: float | None) -> str:
    return "Drake's default" if value is None else f"{value:g}"

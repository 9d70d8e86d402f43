"""What touches: contact forces of a step, and how deep geometries overlap in a state."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff.arrays import Array, frozen
from drake_diff.exceptions import SimulationError
from drake_diff.model import Model


@dataclass(frozen=True, eq=False)
class ContactPoint:
    """One point, or one hydroelastic patch at its centroid, where two bodies push each other; world frame.

    Where one of them is fixed to the world it is body b, so that the force is the one on what moves.
    """

    body_a: str
    body_b: str
    point: Array  # (3,) [m]
    normal: Array  # (3,) from b into a
    force: Array  # (3,) [N], on a
    depth: float  # [m]; 0 for a patch, which has a pressure field instead
    slip_speed: float  # [m/s]


def contacts_of_the_step(model: Model) -> tuple[ContactPoint, ...]:
    """The contacts of the step that `step.advance` took last on the double twin."""
    results = model.plant.get_contact_results_output_port().Eval(model.double.context)
    points = [results.point_pair_contact_info(i) for i in range(results.num_point_pair_contacts())]
    patches = [results.hydroelastic_contact_info(i) for i in range(results.num_hydroelastic_contacts())]
    return tuple(_from_point(model, p) for p in points) + tuple(_from_patch(model, p) for p in patches)


def _from_point(model: Model, info: Any) -> ContactPoint:
    return _contact(
        model,
        [model.plant.get_body(index) for index in (info.bodyA_index(), info.bodyB_index())],
        point=frozen(info.contact_point()),
        normal=np.asarray(info.point_pair().nhat_BA_W),
        force=-np.asarray(info.contact_force()),  # Drake's is on B
        depth=float(info.point_pair().depth),
        slip_speed=float(info.slip_speed()),
    )


def _contact(model: Model, bodies: list[Any], *, normal: Array, force: Array, **rest: Any) -> ContactPoint:
    """A contact whose force is that on the body which can move, where only one of the two can."""
    a, b = bodies
    if model.plant.IsAnchored(a):
        a, b, normal, force = b, a, -normal, -force
    return ContactPoint(body_a=a.name(), body_b=b.name(), normal=frozen(normal), force=frozen(force), **rest)


def _from_patch(model: Model, info: Any) -> ContactPoint:
    surface = info.contact_surface()
    inspector = model.plant.get_geometry_query_input_port().Eval(model.double.context).inspector()
    bodies = [
        model.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)) for geometry in (surface.id_M(), surface.id_N())
    ]
    force = np.asarray(info.F_Ac_W().translational())
    size = float(np.linalg.norm(force))
    return _contact(
        model,
        bodies,
        point=frozen(surface.centroid()),
        normal=force / size if size else np.zeros(3),
        force=force,
        depth=0.0,
        slip_speed=0.0,
    )


def penetration(model: Model) -> float:
    """The largest overlap [m] of two geometries that may collide, in the double context's state; 0 if none."""
    port = model.plant.get_geometry_query_input_port()
    if not port.HasValue(model.double.context):
        return 0.0
    try:
        pairs = port.Eval(model.double.context).ComputePointPairPenetration()
    except RuntimeError as error:
        raise SimulationError(f"Drake cannot measure how deep the geometries overlap: {error}") from error
    return float(max((pair.depth for pair in pairs), default=0.0))

"""What touches: contact forces and modes of a step, and how deep geometries overlap in a state."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, frozen
from drake_diff.exceptions import SimulationError
from drake_diff.model.model import Model
from drake_diff.model.step import advance, check_point


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


Pair = tuple[str, str]  # two geometries, each as "body/geometry"
SEPARATED, STICKING, SLIDING = "separated", "sticking", "sliding"
# Of the friction that is possible, the part above which a pair slides. SAP sticks strictly inside the cone. The
# others slip by v_t for a part v_t / sqrt(v_t^2 + v_s^2): at the stiction tolerance v_s it is 1 / sqrt(2).
SLIDING_PART = {"sap": 1 - 1e-3, "similar": 0.5**0.5, "lagged": 0.5**0.5}


def contact_modes(model: Model, x: ArrayLike, u: ArrayLike | None = None) -> dict[Pair, str]:
    """Of every pair of geometries that may collide, its mode in the step at (`x`, `u`), from Drake's own forces.

    "separated": no normal force; "sticking": friction inside its cone, "sliding": at it (of sap), or a slip
    above the stiction tolerance (of similar and lagged). Raises what `step` raises.
    """
    advance(model.double, *check_point(model, x, u))
    active, inspector = active_modes(model), model.double.inspector
    if inspector is None:
        return {}
    pairs = [_pair(model, inspector, *ids) for ids in inspector.GetCollisionCandidates()]
    return {pair: active.get(pair, SEPARATED) for pair in sorted(pairs)}


def active_modes(model: Model) -> dict[Pair, str]:
    """The modes of the pairs that push each other in the step that `step.advance` took last on the double twin."""
    results = model.plant.get_contact_results_output_port().Eval(model.double.context)
    inspector = model.double.inspector
    found: dict[Pair, str] = {}
    if inspector is None:
        return found
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        ids = (info.point_pair().id_A, info.point_pair().id_B)
        _add_mode(found, model, inspector, ids, np.asarray(info.contact_force()), info.point_pair().nhat_BA_W)
    for i in range(results.num_hydroelastic_contacts()):
        hydroelastic = results.hydroelastic_contact_info(i)
        surface = hydroelastic.contact_surface()
        faces = range(surface.num_faces())
        normal = np.sum([surface.area(f) * np.asarray(surface.face_normal(f)) for f in faces], axis=0)
        force = np.asarray(hydroelastic.F_Ac_W().translational())
        ids = (surface.id_M(), surface.id_N())
        _add_mode(found, model, inspector, ids, force, normal / max(float(np.linalg.norm(normal)), 1e-300))
    return found


def _add_mode(found: dict[Pair, str], model: Model, inspector: Any, ids: Any, force: Array, normal: Any) -> None:
    push = abs(float(force @ normal))
    if push == 0:
        return
    mu_a, mu_b = (_friction(inspector, geometry) for geometry in ids)
    possible = 2 * mu_a * mu_b / (mu_a + mu_b) * push if mu_a + mu_b else 0.0
    tangential = float(np.linalg.norm(force - (force @ normal) * np.asarray(normal)))
    part = SLIDING_PART[model.contract.contact.approximation]
    found[_pair(model, inspector, *ids)] = SLIDING if tangential >= part * possible else STICKING


def _friction(inspector: Any, geometry: Any) -> float:
    properties = inspector.GetProximityProperties(geometry)
    return float(properties.GetProperty("material", "coulomb_friction").dynamic_friction())


def _pair(model: Model, inspector: Any, a: Any, b: Any) -> Pair:
    names = []
    for geometry in (a, b):
        body = model.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        names.append(f"{body.name()}/{inspector.GetName(geometry).split('::')[-1]}")
    first, second = sorted(names)
    return first, second


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


def thinnest_geometry(model: Model) -> tuple[float, str]:
    """(thickness [m], name) of the thinnest geometry that may collide; (inf, "nothing") where none has a size."""
    port = model.plant.get_geometry_query_input_port()
    found = (float("inf"), "nothing")
    if not port.HasValue(model.double.context):
        return found
    inspector = port.Eval(model.double.context).inspector()
    for geometry in {g for pair in inspector.GetCollisionCandidates() for g in pair}:
        box = inspector.GetObbInGeometryFrame(geometry)
        if box is not None:  # a half space has none
            found = min(found, (2 * float(np.min(box.half_width())), str(inspector.GetName(geometry))))
    return found

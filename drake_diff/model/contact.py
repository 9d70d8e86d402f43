"""What touches: contact forces and modes of a step, and how deep geometries overlap in a state."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, frozen
from drake_diff.exceptions import SimulationError
from drake_diff.model.model import Model
from drake_diff.model.plant import proximity_property
from drake_diff.model.step import advance, check_point
from drake_diff.model.twin import Twin


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


Pair = tuple[str, str]  # two geometries, each as "body/geometry"
SEPARATED, STICKING, SLIDING = "separated", "sticking", "sliding"
# Of the friction that is possible, the part above which a pair slides. SAP sticks strictly inside the cone. The
# others slip by v_t for a part v_t / sqrt(v_t^2 + v_s^2): at the stiction tolerance v_s it is 1 / sqrt(2).
SLIDING_PART = {"sap": 1 - 1e-3, "similar": 0.5**0.5, "lagged": 0.5**0.5}


def contact_modes(model: Model, x: ArrayLike, u: ArrayLike | None = None) -> dict[Pair, str]:
    """The contact mode of every pair of geometries that may collide, in the step at (`x`, `u`), by Drake's own forces.

    Args:
        model: The model.
        x: (nx,) the state before the step.
        u: (nu,) the input; may be left out where there is none.

    Returns:
        By pair of names, each "body/geometry": "separated" without a normal force; "sticking" with friction inside its
        cone; "sliding" with friction at the cone (sap) or a slip above the stiction tolerance (similar and lagged).

    Raises:
        ShapeError, NonFiniteError: x or u is wrong.
        SimulationError: Drake cannot take the step.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.01)
        >>> from drake_diff.model import contact_modes
        >>> contact_modes(model, model.default_state)
        {('ball/ball', 'ground/ground'): 'sticking'}
    """
    advance(model.double, *check_point(model, x, u))
    active, inspector = active_modes(model), model.double.inspector
    if inspector is None:
        return {}
    pairs = [_pair(model, *ids) for ids in inspector.GetCollisionCandidates()]
    return {pair: active.get(pair, SEPARATED) for pair in sorted(pairs)}


def active_modes(model: Model) -> dict[Pair, str]:
    """The modes of the pairs that push each other in the step that `step.advance` took last on the double twin."""
    modes: dict[Pair, str] = {}
    for a, b, force, info in contact_forces(model.double):
        normal = _normal(info)
        push = abs(float(force @ normal))
        if push == 0:
            continue
        mu_a, mu_b = (proximity_property(model.double.inspector, geometry, "friction") or 0.0 for geometry in (a, b))
        possible = 2 * mu_a * mu_b / (mu_a + mu_b) * push if mu_a + mu_b else 0.0  # Drake's rule for two frictions
        tangential = float(np.linalg.norm(force - (force @ normal) * normal))
        sliding_part = SLIDING_PART[model.contract.contact.approximation]
        modes[_pair(model, a, b)] = SLIDING if tangential >= sliding_part * possible else STICKING
    return modes


def contacts_of_the_step(model: Model) -> tuple[ContactPoint, ...]:
    """The contacts of the step that `step.advance` took last on the double twin."""
    contacts, results = [], model.double.plant.get_contact_results_output_port().Eval(model.double.context)
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        pair = info.point_pair()
        where, ids = (info.contact_point(), pair.nhat_BA_W, -info.contact_force()), (pair.id_A, pair.id_B)
        contacts.append(_contact_point(model, *ids, *where, pair.depth, info.slip_speed()))
    for i in range(results.num_hydroelastic_contacts()):
        info = results.hydroelastic_contact_info(i)
        surface, force = info.contact_surface(), info.F_Ac_W().translational()
        where, ids = (surface.centroid(), _normal(info), force), (surface.id_M(), surface.id_N())
        contacts.append(_contact_point(model, *ids, *where, 0.0, 0.0))
    return tuple(contacts)


def _contact_point(
    model: Model, a: Any, b: Any, point: Any, normal: Any, force: Any, depth: float, slip_speed: float
) -> ContactPoint:
    """Of the geometries a and b, by the force on a; told is the one on what can move."""
    (name_a, anchored), (name_b, _) = _carrier(model, a), _carrier(model, b)
    if anchored:
        name_a, name_b, normal, force = name_b, name_a, -normal, -force
    return ContactPoint(name_a, name_b, frozen(point), frozen(normal), frozen(force), float(depth), float(slip_speed))


def contact_forces(twin: Twin) -> Iterator[tuple[Any, Any, Any, Any]]:
    """Of each contact in the twin's last step: the geometries a and b, the force on a (3,) [N], and Drake's own result.

    The force holds floats or AutoDiffXd, as the twin does.
    """
    results = twin.plant.get_contact_results_output_port().Eval(twin.context)
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        yield info.point_pair().id_A, info.point_pair().id_B, -info.contact_force(), info  # Drake's is on B
    for i in range(results.num_hydroelastic_contacts()):
        info = results.hydroelastic_contact_info(i)
        yield info.contact_surface().id_M(), info.contact_surface().id_N(), info.F_Ac_W().translational(), info


def _normal(info: Any) -> Array:
    """(3,) from b into a; of a patch the mean over its faces, by area."""
    if not hasattr(info, "contact_surface"):
        return np.asarray(info.point_pair().nhat_BA_W)
    surface = info.contact_surface()
    faces = range(surface.num_faces())
    normal = np.sum([surface.area(f) * np.asarray(surface.face_normal(f)) for f in faces], axis=0)
    return np.asarray(normal / max(float(np.linalg.norm(normal)), np.finfo(float).tiny))


def body_of(model: Model, geometry: Any) -> Any:
    """The body that carries a geometry."""
    return model.plant.GetBodyFromFrameId(model.double.inspector.GetFrameId(geometry))


def _carrier(model: Model, geometry: Any) -> tuple[str, bool]:
    """The name of that body, and whether it is fixed to the world: they stay, and each contact of each step asks."""
    if geometry not in model.carriers:
        body = body_of(model, geometry)
        model.carriers[geometry] = body.name(), model.plant.IsAnchored(body)
    return model.carriers[geometry]


def _pair(model: Model, a: Any, b: Any) -> Pair:
    names = [f"{body_of(model, g).name()}/{model.double.inspector.GetName(g).split('::')[-1]}" for g in (a, b)]
    first, second = sorted(names)
    return first, second


def penetration(model: Model) -> float:
    """The largest overlap [m] of two geometries that may collide, in the double context's state; 0 if none."""
    return float(max((pair.depth for pair in _penetrations(model)), default=0.0))


def overlaps(model: Model) -> dict[Pair, float]:
    """[m] how deep each two geometries that may collide and do overlap, in the double context's state."""
    return {_pair(model, pair.id_A, pair.id_B): float(pair.depth) for pair in _penetrations(model)}


def _penetrations(model: Model) -> list[Any]:
    """Raises SimulationError where Drake cannot measure the shapes."""
    port = model.plant.get_geometry_query_input_port()
    if not port.HasValue(model.double.context):
        return []
    try:
        return list(port.Eval(model.double.context).ComputePointPairPenetration())
    except RuntimeError as error:
        raise SimulationError(f"Drake cannot measure how deep the geometries overlap: {error}") from error


def deepest_overlap(model: Model) -> tuple[float, float, str]:
    """(depth [m], thickness [m], name) of the overlap in the double context's state that is deepest for what overlaps.

    The thickness and the name are those of the thinner of the two geometries; (0, inf, "nothing") where none overlap.
    """
    deepest = 0.0, float("inf"), "nothing"
    port = model.plant.get_geometry_query_input_port()
    if not port.HasValue(model.double.context):
        return deepest
    for pair in port.Eval(model.double.context).ComputePointPairPenetration():
        thickness, name = min(_thickness(model, geometry) for geometry in (pair.id_A, pair.id_B))
        if pair.depth / thickness > deepest[0] / deepest[1]:
            deepest = float(pair.depth), thickness, name
    return deepest


def thinnest_geometry(model: Model) -> tuple[float, str]:
    """(thickness [m], name) of the thinnest geometry that may collide; (inf, "nothing") where none has a size."""
    inspector = model.double.inspector
    pairs = inspector.GetCollisionCandidates() if inspector else ()
    return min((_thickness(model, g) for pair in pairs for g in pair), default=(float("inf"), "nothing"))


def _thickness(model: Model, geometry: Any) -> tuple[float, str]:
    """(thickness [m], name) of a geometry; a half space has none."""
    box = model.double.inspector.GetObbInGeometryFrame(geometry)
    if box is None:
        return float("inf"), "nothing"
    return 2 * float(np.min(box.half_width())), str(model.double.inspector.GetName(geometry))

"""Contact forces and contact modes of a step, and penetration depths of geometries in a state.

`SoftContact` is a smooth force at a distance, which gives a nonzero gradient to geometries that are not in contact.
It acts between all geometry pairs that may collide, explicitly in the state before the step. Drake's contact also acts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import exp, log
from pydrake.multibody.tree import JacobianWrtVariable

from drake_diff._base.arrays import Array, frozen, positive_float
from drake_diff.exceptions import InputError, ModelError, SimulationError
from drake_diff.model.contact_geometry import from_half_space
from drake_diff.model.model import Model
from drake_diff.model.plant import proximity_property
from drake_diff.model.step import advance, check_point, set_state
from drake_diff.model.twin import Twin


@dataclass(frozen=True, eq=False)
class ContactPoint:
    """A contact point, or a hydroelastic patch represented by its centroid, between two bodies; in the world frame.

    If one of the bodies is fixed to the world, it is body b, so that the force acts on the body that can move.
    """

    body_a: str
    body_b: str
    point: Array  # (3,) [m]
    normal: Array  # (3,) from b into a
    force: Array  # (3,) [N], acting on a
    depth: float  # [m]; 0 for a patch, which has a pressure field instead
    slip_speed: float  # [m/s]


Pair = tuple[str, str]  # two geometries, each as "body/geometry"
SEPARATED, STICKING, SLIDING = "separated", "sticking", "sliding"
# A pair slides above this fraction of the maximum friction. SAP sticks strictly inside the cone. The other models slip
# by v_t at the fraction v_t / sqrt(v_t^2 + v_s^2), which is 1 / sqrt(2) at the stiction tolerance v_s.
SLIDING_PART = {"sap": 1 - 1e-3, "similar": 0.5**0.5, "lagged": 0.5**0.5}


def contact_modes(model: Model, x: ArrayLike, u: ArrayLike | None = None) -> dict[Pair, str]:
    """Return the contact mode of each geometry pair that may collide in the step at (`x`, `u`), from Drake's forces.

    Args:
        model: The model.
        x: (nx,) The state before the step.
        u: (nu,) The input; optional if the model has no inputs.

    Returns:
        By pair of names, each "body/geometry": "separated" without a normal force; "sticking" with friction inside its
        cone; "sliding" with friction at the cone (sap) or a slip above the stiction tolerance (similar and lagged).

    Raises:
        ShapeError, NonFiniteError: x or u is invalid.
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
    """Return the modes of the pairs with contact forces in the last step of `step.advance` on the double twin."""
    modes: dict[Pair, str] = {}
    for a, b, force, info in contact_forces(model.double):
        normal = _normal(info)
        push = abs(float(force @ normal))
        if push == 0:
            continue
        mu_a, mu_b = (proximity_property(model.double.inspector, geometry, "friction") or 0.0 for geometry in (a, b))
        possible = 2 * mu_a * mu_b / (mu_a + mu_b) * push if mu_a + mu_b else 0.0  # Drake's rule for two coefficients
        tangential = float(np.linalg.norm(force - (force @ normal) * normal))
        sliding_part = SLIDING_PART[model.contract.contact.approximation]
        modes[_pair(model, a, b)] = SLIDING if tangential >= sliding_part * possible else STICKING
    return modes


def contacts_of_the_step(model: Model) -> tuple[ContactPoint, ...]:
    """Return the contacts of the last step of `step.advance` on the double twin; forces act on the movable body."""
    contacts = []
    for a, b, force, info in contact_forces(model.double):
        normal, depth, slip = _normal(info), 0.0, 0.0
        if hasattr(info, "contact_surface"):
            point = info.contact_surface().centroid()
        else:
            point, depth, slip = info.contact_point(), float(info.point_pair().depth), float(info.slip_speed())
        (name_a, anchored), (name_b, _) = _carrier(model, a), _carrier(model, b)
        if anchored:
            name_a, name_b, normal, force = name_b, name_a, -normal, -force
        contacts.append(ContactPoint(name_a, name_b, frozen(point), frozen(normal), frozen(force), depth, slip))
    return tuple(contacts)


def contact_forces(twin: Twin) -> Iterator[tuple[Any, Any, Any, Any]]:
    """Yield for each contact in the twin's last step the geometries a, b, the force on a (3,) [N], and Drake's result.

    The force contains floats or AutoDiffXd, depending on the twin.
    """
    results = twin.plant.get_contact_results_output_port().Eval(twin.context)
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        yield info.point_pair().id_A, info.point_pair().id_B, -info.contact_force(), info  # Drake's force acts on B
    for i in range(results.num_hydroelastic_contacts()):
        info = results.hydroelastic_contact_info(i)
        yield info.contact_surface().id_M(), info.contact_surface().id_N(), info.F_Ac_W().translational(), info


def _normal(info: Any) -> Array:
    """Return the normal (3,) from b into a; for a patch, the mean over its faces weighted by area."""
    if not hasattr(info, "contact_surface"):
        return np.asarray(info.point_pair().nhat_BA_W)
    surface = info.contact_surface()
    faces = range(surface.num_faces())
    normal = np.sum([surface.area(f) * np.asarray(surface.face_normal(f)) for f in faces], axis=0)
    return np.asarray(normal / max(float(np.linalg.norm(normal)), np.finfo(float).tiny))


def body_of(model: Model, geometry: Any) -> Any:
    """Return the body that carries a geometry."""
    return model.plant.GetBodyFromFrameId(model.double.inspector.GetFrameId(geometry))


def _carrier(model: Model, geometry: Any) -> tuple[str, bool]:
    """Return the name of that body and whether it is fixed to the world, from a cache, as every contact needs them."""

    def carrier() -> tuple[str, bool]:
        body = body_of(model, geometry)
        return str(body.name()), bool(model.plant.IsAnchored(body))

    return model.cache(("carrier", geometry), carrier, of_structure=True)


def _pair(model: Model, a: Any, b: Any) -> Pair:
    names = [f"{body_of(model, g).name()}/{model.double.inspector.GetName(g).split('::')[-1]}" for g in (a, b)]
    first, second = sorted(names)
    return first, second


def penetration(model: Model) -> float:
    """Return the largest overlap [m] of two geometries that may collide in the double context's state, or 0."""
    return float(max((pair.depth for pair in _penetrations(model)), default=0.0))


def overlaps(model: Model) -> dict[Pair, float]:
    """Return the overlap depth [m] of each pair of overlapping geometries in the double context's state."""
    return {_pair(model, pair.id_A, pair.id_B): float(pair.depth) for pair in _penetrations(model)}


def _penetrations(model: Model) -> list[Any]:
    """Return Drake's penetrations; raise SimulationError if Drake cannot measure the shapes."""
    port = model.plant.get_geometry_query_input_port()
    if not port.HasValue(model.double.context):
        return []
    try:
        return list(port.Eval(model.double.context).ComputePointPairPenetration())
    except RuntimeError as error:
        raise SimulationError(f"Drake cannot measure how deep the geometries overlap: {error}") from error


def deepest_overlap(model: Model) -> tuple[float, float, str]:
    """Return (depth [m], thickness [m], name) of the overlap in the double context's state with the largest ratio.

    The ratio is the depth over the thickness of the thinner geometry, which has the name; (0, inf, "nothing") if none.
    """
    deepest = 0.0, float("inf"), "nothing"
    for pair in _penetrations(model):
        thickness, name = min(_thickness(model, geometry) for geometry in (pair.id_A, pair.id_B))
        if pair.depth / thickness > deepest[0] / deepest[1]:
            deepest = float(pair.depth), thickness, name
    return deepest


def thinnest_geometry(model: Model) -> tuple[float, str]:
    """Return (thickness [m], name) of the thinnest geometry that may collide, (inf, "nothing") if none has a size."""
    inspector = model.double.inspector
    pairs = inspector.GetCollisionCandidates() if inspector else ()
    return min((_thickness(model, g) for pair in pairs for g in pair), default=(float("inf"), "nothing"))


def _thickness(model: Model, geometry: Any) -> tuple[float, str]:
    """Return (thickness [m], name) of a geometry; the thickness of a half space is inf."""
    box = model.double.inspector.GetObbInGeometryFrame(geometry)
    if box is None:
        return float("inf"), "nothing"
    return 2 * float(np.min(box.half_width())), str(model.double.inspector.GetName(geometry))


# Quadrature nodes in [0, 1] for the potential; its integrand is smooth, so 16 nodes reach rounding error.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


@dataclass(frozen=True)
class SoftContact:
    """A smooth repulsive force between geometries, sigma k log(1 + exp(-phi / sigma)) at the signed distance phi [m].

    It decreases by a factor e per `distance` of separation, and tends to the spring k max(0, -phi) as `distance` tends
    to 0. A stable step requires h^2 k below 4 times the moving mass. There is no friction and no dissipation.

    Args:
        distance: sigma [m], above 0.
        stiffness: k [N/m], above 0.

    Raises:
        InputError: An argument is not above 0.

    Source:
        Kurtz and Lin, "Inverse dynamics trajectory optimization for contact-implicit model predictive control", 2023.

    Example:
        >>> soft = dd.model.SoftContact(distance=0.01, stiffness=100.0)
        >>> round(soft.normal_force(0.0), 6)  # sigma k log 2
        0.693147
    """

    distance: float
    stiffness: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "distance", positive_float("SoftContact.distance [m]", self.distance))
        object.__setattr__(self, "stiffness", positive_float("SoftContact.stiffness [N/m]", self.stiffness))

    def normal_force(self, phi: Any) -> Any:
        """Return the force [N] at the signed distance `phi` [m], a float or an AutoDiffXd."""
        a = phi / self.distance
        tail = log(1.0 + exp(-a)) if a > 0 else -a + log(1.0 + exp(a))  # neither branch overflows
        return self.distance * self.stiffness * tail

    def energy(self, phi: float) -> float:
        """Return the energy [J], the integral of the force from `phi` [m] to infinity."""
        a = abs(phi) / self.distance
        beyond = float(_WEIGHTS @ (np.log1p(np.exp(-a) * _NODES) / _NODES))
        if phi < 0:
            beyond = a * a / 2 + np.pi**2 / 6 - beyond
        return self.distance**2 * self.stiffness * beyond

    def force(self, plant: Any, context: Any) -> Any:
        """Return the generalized force (nv,) [N or N m] in the state of `context`, of either scalar type."""
        total = np.zeros(plant.num_velocities())
        for pair, bodies in _pairs(plant, context):
            total = total + self.normal_force(pair.distance) * _distance_rate(plant, context, pair, bodies)
        return total

    def potential(self, plant: Any, context: Any) -> float:
        return sum(self.energy(float(pair.distance)) for pair, _ in _pairs(plant, context))


def softened(model: Model, contact: SoftContact) -> Model:
    """Return `model` with a smooth force at a distance between all geometries that may collide.

    The force is in addition to Drake's own contact. All functions of a model work, at any time step. AutoDiffXd has
    the distance from a sphere to a sphere, a box and a half space. If another pair may collide, finite differences
    differentiate the steps, and the method is reported.

    Args:
        model: The model; it does not change.
        contact: The force.

    Returns:
        The new Model.

    Raises:
        InputError: No geometries may collide, or forces cannot be added.
        ModelError: Drake cannot compute the distance of a pair.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.01)
        >>> soft = dd.model.softened(model, dd.model.SoftContact(distance=0.05, stiffness=100.0))
        >>> x = np.array([1, 0, 0, 0, 0, 0, 0.2, 0, 0, 0, 0, 0, 0])  # 0.1 m above the ground
        >>> bool(dd.step(soft, x)[12] > dd.step(model, x)[12])  # it falls more slowly
        True
    """
    if not isinstance(contact, SoftContact):
        raise InputError("contact", got=type(contact).__name__, expected="a SoftContact")
    if not model.takes_forces:
        got = "a diagram that sets the applied generalized forces"
        raise InputError("model", got=got, expected="a diagram that leaves this input port free")
    if not model.contract.contact.collision_pairs:
        raise InputError("model", got="no geometries that may collide", expected="at least one collision pair")

    def rebuild(**change: Any) -> Model:
        return softened(model.changed(**change), contact)

    soft = Model(
        model.diagram,
        source=model.source,
        notes=model.notes,
        contact_geometry=model.contact_geometry,
        rebuild=rebuild if model.can_rebuild else None,
        forces=(*model.forces, contact),
        coupling=model.coupling,
        body_forces=model.body_forces,
        servos=model.servos,
        facts=model.file_facts,
        shared=model.shared,
    )
    contact.force(soft.plant, soft.double.context)  # raises ModelError if a distance is not available
    return soft


def distances(twin: Twin) -> dict[tuple[str, str], float]:
    """Return the smallest signed distance [m] of each two bodies that may collide, in the context's state."""
    by_pair: dict[tuple[str, str], float] = {}
    for names, distance in pair_distances(twin):
        by_pair[names] = min(distance, by_pair.get(names, np.inf))
    return by_pair


def pair_distances(twin: Twin) -> list[tuple[tuple[str, str], float]]:
    """Return the bodies and the distance [m] of each pair of `separations`, a call of which takes ten times as long."""
    return [((a.name(), b.name()), float(pair.distance)) for pair, (a, b) in _pairs(twin.plant, twin.context)]


@dataclass(frozen=True, eq=False)
class Separation:
    """Two bodies that may collide, their distance, its gradient, and the mobility of the pair."""

    bodies: tuple[str, str]
    distance: float  # [m], signed
    gradient: Array  # (nq,) of the distance
    mobility: float  # [1/kg] separation speed per unit impulse between the two bodies


def separations(twin: Twin) -> list[Separation]:
    """Return all geometry pairs that may collide, always in the same order, in the context's state."""
    return _separated(twin, _pairs(twin.plant, twin.context))


def separation_at(model: Model, x: Array, number: int) -> Separation:
    """Return one of the `separations` by its index in the state x (nx,), and set the double plant to this state."""
    set_state(model.double, x)
    plant, context = model.double.plant, model.double.context
    query = plant.get_geometry_query_input_port().Eval(context)
    candidates = model.cache("collision candidates", lambda: _candidates(query))
    return _separated(model.double, [_measured(plant, query, candidates[number])])[0]


def _separated(twin: Twin, pairs: Sequence[tuple[Any, tuple[Any, Any]]]) -> list[Separation]:
    plant, context, rows, coupling = twin.plant, twin.context, [], twin.coupling
    mass = twin.mass_matrix()
    to_v = np.array([plant.MapQDotToVelocity(context, e) for e in np.eye(plant.num_positions())]).T
    if coupling is not None:
        to_v = to_v[np.ix_(coupling.own_v, coupling.own_q)]
    for pair, (a, b) in pairs:
        rate = twin.own_force(_distance_rate(plant, context, pair, (a, b)))
        mobility = float(rate @ np.linalg.solve(mass, rate))
        rows.append(Separation((a.name(), b.name()), float(pair.distance), rate @ to_v, mobility))
    return rows


def _distance_rate(plant: Any, context: Any, pair: Any, bodies: tuple[Any, Any]) -> Any:
    """Return the derivative (nv,) of the distance's rate, the separation speed of the closest points, in v."""
    inspector = plant.get_geometry_query_input_port().Eval(context).inspector()
    world, by_v, jacobians = plant.world_frame(), JacobianWrtVariable.kV, []
    for body, geometry, p_GC in zip(bodies, (pair.id_A, pair.id_B), (pair.p_ACa, pair.p_BCb), strict=True):
        X_BG = inspector.GetPoseInFrame(geometry)
        p_BC = (X_BG.rotation().matrix() @ np.asarray(p_GC) + X_BG.translation()).reshape(3, 1)
        frame = body.body_frame()
        jacobians.append(plant.CalcJacobianTranslationalVelocity(context, by_v, frame, p_BC, world, world))
    return (jacobians[0] - jacobians[1]).T @ np.asarray(pair.nhat_BA_W)


def _pairs(plant: Any, context: Any) -> list[tuple[Any, tuple[Any, Any]]]:
    """Return Drake's signed distance and the bodies for each two geometries that may collide."""
    port = plant.get_geometry_query_input_port()
    if not port.HasValue(context):
        return []
    query = port.Eval(context)
    return [_measured(plant, query, ids) for ids in _candidates(query)]


def _candidates(query: Any) -> list[Any]:
    return sorted(query.inspector().GetCollisionCandidates(), key=lambda pair: [int(i.get_value()) for i in pair])


def _measured(plant: Any, query: Any, ids: Any) -> tuple[Any, tuple[Any, Any]]:
    """Return Drake's signed distance between two geometries, and their bodies."""
    try:
        pair = from_half_space(query, ids) or query.ComputeSignedDistancePairClosestPoints(*ids)
    except RuntimeError as error:
        why = "the distance of every pair of shapes is needed, and Drake does not support one of them"
        raise ModelError(f"{why}: {error}") from error
    bodies = [plant.GetBodyFromFrameId(query.inspector().GetFrameId(i)) for i in (pair.id_A, pair.id_B)]
    return pair, (bodies[0], bodies[1])

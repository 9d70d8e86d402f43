"""Contact that acts at a distance: a smooth force added to a plant, so that what does not touch has a gradient too.

The force of `SoftContact` acts between every two geometries that may collide and is explicit in the state before the
step; Drake's own contact, friction included, acts beside it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.math import exp, log
from pydrake.multibody.tree import JacobianWrtVariable

from drake_diff._base.arrays import Array, positive_float
from drake_diff.exceptions import InputError, ModelError
from drake_diff.model.half_space import from_half_space
from drake_diff.model.model import Model
from drake_diff.model.twin import Twin

# Nodes in [0, 1] of the integral for the potential, whose integrand is smooth there: 16 leave rounding only.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


@dataclass(frozen=True)
class SoftContact:
    """A smooth repulsive force between geometries, sigma k log(1 + exp(-phi / sigma)) at the signed distance phi [m].

    It falls by e with each `distance` of separation and tends to the spring k max(0, -phi) as `distance` tends to 0.
    A stable step needs h^2 k below 4 times the mass that it moves. It has no friction and no dissipation.

    Args:
        distance: sigma [m], above 0.
        stiffness: k [N/m], above 0.

    Raises:
        InputError: One of them is not above 0.

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
        """[N] at the signed distance `phi` [m], a float or an AutoDiffXd."""
        a = phi / self.distance
        tail = log(1.0 + exp(-a)) if a > 0 else -a + log(1.0 + exp(a))  # neither overflows
        return self.distance * self.stiffness * tail

    def energy(self, phi: float) -> float:
        """[J] the integral of the force from `phi` [m] to infinity."""
        a = abs(phi) / self.distance
        beyond = float(_WEIGHTS @ (np.log1p(np.exp(-a) * _NODES) / _NODES))
        if phi < 0:
            beyond = a * a / 2 + np.pi**2 / 6 - beyond
        return self.distance**2 * self.stiffness * beyond

    def force(self, plant: Any, context: Any) -> Any:
        """(nv,) the generalized force [N or N m] in the state of `context`, of either scalar type."""
        total = np.zeros(plant.num_velocities())
        for pair, bodies in _pairs(plant, context):
            total = total + self.normal_force(pair.distance) * _distance_rate(plant, context, pair, bodies)
        return total

    def potential(self, plant: Any, context: Any) -> float:
        return sum(self.energy(float(pair.distance)) for pair, _ in _pairs(plant, context))


def softened(model: Model, contact: SoftContact) -> Model:
    """`model` with a smooth force at a distance between all geometries that may collide, beside Drake's own contact.

    Its steps, rollouts, gradients and certificates are those of any model, at any time step. AutoDiffXd knows the
    distance of a sphere from a sphere, a box and a half space; where another pair may collide, steps are differenced,
    and say so.

    Args:
        model: The model; it stays as it is.
        contact: The force.

    Returns:
        A Model.

    Raises:
        InputError: Nothing may collide, or no force can be added.
        ModelError: Drake knows no distance of some pair.

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
        raise InputError("model", got=got, expected="one that leaves that input port free")
    if not model.contract.contact.collision_pairs:
        raise InputError("model", got="no geometries that may collide", expected="at least one pair")

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
        shared=model.shared,
    )
    contact.force(soft.plant, soft.double.context)  # refuses what has no distance
    return soft


def distances(twin: Twin) -> dict[tuple[str, str], float]:
    """The signed distance [m] of the geometries of every two bodies that may collide, in the context's state."""
    by_pair: dict[tuple[str, str], float] = {}
    for pair, (a, b) in _pairs(twin.plant, twin.context):
        names = (a.name(), b.name())
        by_pair[names] = min(float(pair.distance), by_pair.get(names, np.inf))
    return by_pair


@dataclass(frozen=True, eq=False)
class Separation:
    """Two bodies that may collide, how far they are apart, and how they part."""

    bodies: tuple[str, str]
    distance: float  # [m], signed
    gradient: Array  # (nq,) of the distance
    opening: Array  # (nq,) the least motion that adds a metre, in the metric of the mass matrix; 0 where there is none
    mobility: float  # [1/kg] how fast a unit impulse between the two makes them part


def separations(twin: Twin) -> list[Separation]:
    """Every pair of geometries that may collide, always in the same order, in the context's state."""
    plant, context, rows, coupling = twin.plant, twin.context, [], twin.coupling
    mass = twin.mass_matrix()
    to_v = np.array([plant.MapQDotToVelocity(context, e) for e in np.eye(plant.num_positions())]).T
    if coupling is not None:
        to_v = to_v[np.ix_(coupling.own_v, coupling.own_q)]
    for pair, (a, b) in _pairs(plant, context):
        rate = twin.own_force(_distance_rate(plant, context, pair, (a, b)))
        v = np.linalg.solve(mass, rate)
        opening = twin.rates(v / max(rate @ v, np.finfo(float).tiny))
        names = (a.name(), b.name())
        rows.append(Separation(names, float(pair.distance), rate @ to_v, opening, float(rate @ v)))
    return rows


def _distance_rate(plant: Any, context: Any, pair: Any, bodies: tuple[Any, Any]) -> Any:
    """(nv,) the derivative of the distance's rate by v: of the velocity at which the closest points part."""
    inspector = plant.get_geometry_query_input_port().Eval(context).inspector()
    world, by_v, jacobians = plant.world_frame(), JacobianWrtVariable.kV, []
    for body, geometry, p_GC in zip(bodies, (pair.id_A, pair.id_B), (pair.p_ACa, pair.p_BCb), strict=True):
        X_BG = inspector.GetPoseInFrame(geometry)
        p_BC = (X_BG.rotation().matrix() @ np.asarray(p_GC) + X_BG.translation()).reshape(3, 1)
        frame = body.body_frame()
        jacobians.append(plant.CalcJacobianTranslationalVelocity(context, by_v, frame, p_BC, world, world))
    return (jacobians[0] - jacobians[1]).T @ np.asarray(pair.nhat_BA_W)


def _pairs(plant: Any, context: Any) -> list[tuple[Any, tuple[Any, Any]]]:
    """Drake's signed distance, and the bodies, of every two geometries that may collide."""
    port = plant.get_geometry_query_input_port()
    if not port.HasValue(context):
        return []
    query = port.Eval(context)
    inspector, pairs = query.inspector(), []
    for ids in sorted(inspector.GetCollisionCandidates(), key=lambda pair: [int(i.get_value()) for i in pair]):
        try:
            pair = from_half_space(query, ids) or query.ComputeSignedDistancePairClosestPoints(*ids)
        except RuntimeError as error:
            why = "soft contact needs the distance of every pair, and Drake cannot compute one"
            raise ModelError(f"{why}: {error}") from error
        bodies = [plant.GetBodyFromFrameId(inspector.GetFrameId(i)) for i in (pair.id_A, pair.id_B)]
        pairs.append((pair, (bodies[0], bodies[1])))
    return pairs

"""Joints that copy another one, as a gripper's second finger does: q_follower = ratio q_leader + offset.

Drake keeps both joints in the state and holds them together by a constraint, nearly rigid, in every step. `load_model`
can fix them (`fix_mimics`), or reduce the state to its independent coordinates: with q = E q_own + c and v = E v_own,
motion that keeps to them obeys

    E' M(q) E dv_own/dt = E' (B u + forces(q, v) - C(q, v) v)

(Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 3.2). The constraint's impulse of a step lies across
E, so the momentum along E is what all other impulses make it: with A = M + h D that Drake solves the step by,

    v'_own = (E' A E)^-1 E' A v'

is the step of the reduced equations to rounding, as far as nothing is touched and no limit is met; there Drake's
impulses are those at its own v', which differs from E v'_own by what its near-rigid constraint gives way.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractValue
from pydrake.multibody.plant import MultibodyPlant

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError, UnknownNameError
from drake_diff.model.file_facts import Mimic
from drake_diff.model.plant import joints
from drake_diff.model.repairs import can_be_driven, weld

CHOICES = ("reduce", "fix")
SLACK = 1e-9  # [m or rad] of limits that meet in one point but for rounding


@dataclass(frozen=True, eq=False)
class Coupling:
    """The independent ("own") coordinates of a plant in which joints follow others, and all by them.

    Each entry of the plant's q (n,) is ratio * own entry `of_q` + offset, each of its v (m,) ratio * own entry `of_v`.
    """

    mimics: tuple[Mimic, ...]
    own_q: NDArray[np.intp]  # (nq,) where the independent ones are in the plant's q
    own_v: NDArray[np.intp]  # (nv,)
    of_q: NDArray[np.intp]  # (n,)
    of_v: NDArray[np.intp]  # (m,)
    ratio_q: Array  # (n,)
    ratio_v: Array  # (m,)
    offset: Array  # (n,)

    @property
    def spread(self) -> Array:
        """E (m, nv)."""
        E = np.zeros((len(self.of_v), len(self.own_v)))
        E[np.arange(len(self.of_v)), self.of_v] = self.ratio_v
        return E

    def positions(self, q: Any) -> Any:
        """The plant's q (..., n) of the own q (..., nq), floats or AutoDiffXd."""
        return self.ratio_q * q[..., self.of_q] + self.offset

    def velocities(self, v: Any) -> Any:
        """The plant's v (..., m) of the own v (..., nv)."""
        return self.ratio_v * v[..., self.of_v]

    def state(self, x: Any) -> Any:
        """The plant's [q; v] (..., n + m) of the own x (..., nx)."""
        nq = len(self.own_q)
        return np.concatenate([self.positions(x[..., :nq]), self.velocities(x[..., nq:])], axis=-1)

    def own_state(self, state: Any) -> Any:
        """The own x of the plant's [q; v]: followers are dropped."""
        return np.concatenate([state[: len(self.of_q)][self.own_q], state[len(self.of_q) :][self.own_v]])

    def forces(self, force: Any) -> Any:
        """(nv,) E' of the plant's generalized force (m,), floats or AutoDiffXd."""
        reduced = force[self.own_v]
        for i in np.setdiff1d(np.arange(len(self.of_v)), self.own_v):
            reduced[self.of_v[i]] = reduced[self.of_v[i]] + self.ratio_v[i] * force[i]
        return reduced

    def limits(self, lower: Array, upper: Array, *, of_velocities: bool = False) -> tuple[Array, Array]:
        """The own lower and upper limits (n,) that keep to all of the plant's."""
        leader, ratio = (self.of_v, self.ratio_v) if of_velocities else (self.of_q, self.ratio_q)
        offset = np.zeros(len(leader)) if of_velocities else self.offset
        count = len(self.own_v if of_velocities else self.own_q)
        low, high = np.full(count, -np.inf), np.full(count, np.inf)
        for i, k in enumerate(leader):
            ends = sorted(((lower[i] - offset[i]) / ratio[i], (upper[i] - offset[i]) / ratio[i]))
            low[k], high[k] = max(low[k], ends[0]), min(high[k], ends[1])
        return low, high

    def next_velocities(self, A: Any, v: Any) -> Any:
        """(nv,) of the plant's v (m,) after a step whose impulses are those of the mass A (m, m)."""
        E = self.spread
        if A.dtype == float:
            return np.linalg.solve(E.T @ A @ E, E.T @ (A @ v))
        value = ExtractValue(A)
        mass = E.T @ value @ E
        solution = np.linalg.solve(mass, E.T @ (value @ ExtractValue(v.reshape(-1, 1)).ravel()))
        missing = self.forces(
            A @ (v - self.velocities(solution))
        )  # 0, with the derivatives of one step of Newton's method
        return solution + np.linalg.inv(mass) @ missing


def check_mimic(choice: str | None) -> None:
    """UnknownNameError where it is none of CHOICES, nor None."""
    if choice is not None and choice not in CHOICES:
        raise UnknownNameError("mimic", got=choice, known=CHOICES)


def _called(plant: MultibodyPlant, mimic: Mimic, name: str) -> list[Any]:
    """The joints of that name, those of the mimic's model instance where others have them too."""
    same_name = [j for j in joints(plant) if j.name() == name]
    same_instance = [j for j in same_name if plant.GetModelInstanceName(j.model_instance()) == mimic.instance]
    return same_instance if len(same_name) > 1 else same_name


def _joint(plant: MultibodyPlant, mimic: Mimic, name: str) -> Any:
    matches = _called(plant, mimic, name)
    if len(matches) != 1:
        raise ModelError(f"mimic: the joint {mimic.follower} follows {mimic.leader}, and there is no joint {name}")
    if not can_be_driven(matches[0]):
        kind = matches[0].type_name()
        raise ModelError(f"mimic: {mimic} is of revolute and prismatic joints here, and {name} is a {kind} joint")
    return matches[0]


def joints_of_mimics(plant: MultibodyPlant, mimics: tuple[Mimic, ...]) -> list[tuple[Mimic, Any, Any]]:
    """Each with the joints that follow and lead."""
    triples = [(m, _joint(plant, m, m.follower), _joint(plant, m, m.leader)) for m in mimics]
    for mimic, _, _ in triples:
        if mimic.ratio == 0 or not np.isfinite([mimic.ratio, mimic.offset]).all():
            raise ModelError(f"mimic: {mimic}: expected a finite ratio other than 0")
    return triples


def _resolved(pairs: list[tuple[Mimic, Any, Any]]) -> dict[Any, tuple[Any, float, float]]:
    """By the index of each follower the joint that leads in the end, and q = ratio * its q + offset."""
    direct = {follower.index(): (leader, m.ratio, m.offset) for m, follower, leader in pairs}
    resolved = {}
    for follower in direct:
        leader, ratio, offset = direct[follower]
        seen = {follower}
        while leader.index() in direct:
            if leader.index() in seen:
                raise ModelError(f"mimic: {leader.name()} follows itself, through others")
            seen.add(leader.index())
            leader, r, o = direct[leader.index()]
            ratio, offset = ratio * r, ratio * o + offset
        resolved[follower] = (leader, ratio, offset)
    return resolved


def uncoupled(plant: MultibodyPlant, mimics: Iterable[Mimic]) -> tuple[Mimic, ...]:
    """The mimic joints, whose constraints are taken out of a plant that is not finalized.

    Raises ModelError where one cannot be, or where the plant has other constraints: pydrake does not tell which is
    which.
    """
    couplings = tuple(mimics)
    _resolved(joints_of_mimics(plant, couplings))
    known, count = sum(m.in_drake for m in couplings), int(plant.num_constraints())
    if couplings and count != known:
        raise ModelError(
            f"mimic: the model has {count} constraints for {known} mimic joints, and Drake does not tell which are "
            "which: take the other constraints (balls, welds, distances) out of the file"
        )
    for constraint in plant.GetConstraintIds() if couplings else ():
        plant.RemoveConstraint(constraint)
    return couplings


def still_moving(plant: MultibodyPlant, mimics: Iterable[Mimic]) -> tuple[Mimic, ...]:
    """Those whose follower was not fixed by name. ModelError where what it follows was."""

    def fixed(mimic: Mimic, name: str) -> bool:
        return any(joint.num_velocities() == 0 for joint in _called(plant, mimic, name))

    left = tuple(mimic for mimic in mimics if not fixed(mimic, mimic.follower))
    for mimic in left:
        if fixed(mimic, mimic.leader):
            raise ModelError(f"fix_joints={mimic.leader!r}: {mimic.follower} mimics it: fix {mimic.follower} too")
    return left


def fix_mimics(plant: MultibodyPlant, mimics: tuple[Mimic, ...]) -> tuple[str, ...]:
    """Weld what follows and what leads; a sentence that says where.

    The leader is where it starts, or at the nearest position that all joints' limits allow.
    """
    if not mimics:
        return ()
    followers = _resolved(joints_of_mimics(plant, mimics))
    leaders = {leader.index(): leader for leader, _, _ in followers.values()}
    places: dict[Any, tuple[Any, float]] = {}
    by_index = {j.index(): j for j in joints(plant)}
    for index, leader in leaders.items():
        low, high = -np.inf, np.inf
        led = [(by_index[f], r, o) for f, (who, r, o) in followers.items() if who.index() == index]
        for joint, ratio, offset in [(leader, 1.0, 0.0), *led]:
            ends = (joint.position_lower_limits()[0], joint.position_upper_limits()[0])
            lower, upper = sorted((end - offset) / ratio for end in ends)
            low, high = max(low, lower), min(high, upper)
        _check_limits(leader.name(), low, high)
        q = float(np.clip(leader.default_positions()[0], low, max(low, high)))
        for joint, ratio, offset in [(leader, 1.0, 0.0), *led]:
            places[joint.index()] = (joint, ratio * q + offset)
    positions = ", ".join(f"{joint.name()} at {q:.6g}" for joint, q in places.values())  # before Drake forgets them
    for joint, q in places.values():
        weld(plant, joint, q)
    return (f"{len(places)} mimic joints and those that they follow were fixed: {positions}.",)


def _check_limits(leader: str, low: float, high: float) -> None:
    if low > high + SLACK:
        raise ModelError(f"mimic: no position of {leader} is within its limits and those of all joints that follow it")


def couple(plant: MultibodyPlant, mimics: tuple[Mimic, ...]) -> tuple[str, ...]:
    """Give Drake the constraints of mimic joints again; a sentence for what is reduced."""
    for mimic, follower, leader in joints_of_mimics(plant, mimics):
        plant.AddCouplerConstraint(follower, leader, mimic.ratio, mimic.offset)
    listing = ", ".join(map(str, mimics))
    return (f"{len(mimics)} mimic joints were reduced: {listing}.",) if mimics else ()


def coupling_of(plant: MultibodyPlant, mimics: tuple[Mimic, ...]) -> Coupling | None:
    """The independent coordinates of a finalized plant; None where no joint follows another."""
    if not mimics:
        return None
    followers = _resolved(joints_of_mimics(plant, mimics))
    n, m = plant.num_positions(), plant.num_velocities()
    leading_q, leading_v, ratio_q, ratio_v, offset = np.arange(n), np.arange(m), np.ones(n), np.ones(m), np.zeros(n)
    for index, (leader, ratio, add) in followers.items():
        i, j = (plant.get_joint(index).position_start(), plant.get_joint(index).velocity_start())
        leading_q[i], leading_v[j] = leader.position_start(), leader.velocity_start()
        ratio_q[i], ratio_v[j], offset[i] = ratio, ratio, add
    own_q, own_v = np.flatnonzero(leading_q == np.arange(n)), np.flatnonzero(leading_v == np.arange(m))
    of_q, of_v = np.searchsorted(own_q, leading_q), np.searchsorted(own_v, leading_v)
    coupling = Coupling(mimics, own_q, own_v, of_q, of_v, ratio_q, ratio_v, offset)
    names = plant.GetPositionNames(add_model_instance_prefix=False)
    lows, highs = coupling.limits(plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits())
    for i, low, high in zip(own_q, lows, highs, strict=True):
        _check_limits(names[i].rsplit("_", 1)[0], low, high)
    return coupling

"""The impulses of joint limits, PD controllers and couplers on joints, as in Drake's solver.

Each impulse acts along one direction j of the velocities, as J' g with

    g = clip((v_hat - j . v') / R, lower, upper)

With the effective inverse mass w = j diag(A)^-1 j' and the time step h:

- a limit at the distance d >= 0 has v_hat = -d / 2h, R = max(b w, 1 / (2 h^2 1e12)), g >= 0. It is active if the joint
  may reach it in two steps, at the velocity before the step or at the velocity without constraints;
- a controller exerts h times its effort, so 1 / R = h (h kp + kd) and v_hat = R h (u - kp (q - q_ref) + kd v_ref), with
  |g| at most h times the effort limit. Gains too stiff for the time step, R < b w, are scaled down until R = b w;
- a coupler q_0 = ratio q_1 + offset with the position error d has v_hat = -d / 2h, R = b w;
- a point of a body constrained to a point of another, with the position error g in world axes, has three impulses along
  J, the Jacobian of the relative velocity: v_hat = -g / 2h, R = b |J diag(A)^-1 J'| / 3, in the Frobenius norm.

b = 0.1^2 / (4 pi^2) is Drake's near-rigid factor (Castro, Permenter and Han, "An unconstrained convex formulation of
compliant contact", 2022).

Drake does not expose the couplers of a plant, so they are identified from Drake's own steps. With one coupler as the
only constraint, the step's problem is quadratic and Drake solves it to rounding. The impulse A (v' - v*) of such a step
is along (1, -ratio) of the two joints, and its size gives the position error.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import CollisionFilterDeclaration, GeometrySet
from pydrake.multibody.tree import MultibodyForces

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import Refusal
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.repairs import joints_of_mimics

NEAR_RIGID = 0.1**2 / (4 * np.pi**2)
LIMIT_STIFFNESS = 1e12  # Drake's value [N/m or N m/rad]
LIMIT_WINDOW = 2.0  # Drake considers the limits within this number of steps


@dataclass(frozen=True, eq=False)
class JointImpulses:
    """S joint impulses in each of N problems. An impulse does not act if both its bounds are 0."""

    direction: Array  # (S, nv) j, or (N, S, nv) if there are impulses of loop points
    target: Array  # (N, S) v_hat [m/s or rad/s]
    compliance: Array  # (N, S) R [1/kg or 1/(kg m^2)]
    lower: Array  # (N, S) [N s or N m s]
    upper: Array

    def subset(self, which: Indices) -> "JointImpulses":
        """Return the impulses of some of the problems."""
        direction = self.direction if self.direction.ndim == 2 else self.direction[which]
        return JointImpulses(direction, *(array[which] for array in self._of_problems))

    @property
    def _of_problems(self) -> tuple[Array, ...]:
        return self.target, self.compliance, self.lower, self.upper

    def reach(self) -> NDArray[np.bool_]:
        """Return which degrees of freedom (N, nv) the impulses may move."""
        return np.asarray(((self.lower < self.upper)[:, None, :] @ (self.direction != 0))[:, 0])

    def evaluate(self, v: Array) -> tuple[Array, Array]:
        """Return impulses (N, S) at v (N, nv), and their derivatives with respect to -j . v' (N, S), 0 at bounds."""
        wanted = (self.target - (self.direction @ v[..., None])[..., 0]) / self.compliance
        free = (wanted > self.lower) & (wanted < self.upper)
        return np.clip(wanted, self.lower, self.upper), np.where(free, 1 / self.compliance, 0.0)


def gather(parts: Sequence[JointImpulses]) -> JointImpulses:
    """Concatenate several sets of impulses."""
    of_problems = zip(*(impulses._of_problems for impulses in parts), strict=True)
    directions = [impulses.direction for impulses in parts]
    if any(direction.ndim == 3 for direction in directions):
        count = len(parts[0].target)
        directions = [np.broadcast_to(d, (count, *d.shape[-2:])) for d in directions]
    return JointImpulses(np.concatenate(directions, axis=-2), *map(np.hstack, of_problems))


def impulses_of_loops(jacobian: Array, gap: Array, diagonal: Array, h: float) -> JointImpulses:
    """Return the impulses of L pairs of points with loop constraints in N problems.

    `jacobian` (N, L, 3, nv) is the Jacobian of the points' relative velocity, `gap` (N, L, 3) their relative position,
    and `diagonal` (N, nv) the diagonal of A.
    """
    count, L = gap.shape[:2]
    delassus = np.einsum("nlav,nv,nlbv->nlab", jacobian, 1 / diagonal, jacobian)
    compliance = np.repeat(NEAR_RIGID * np.linalg.norm(delassus, axis=(-2, -1)) / 3, 3, axis=1)
    infinite = np.full((count, 3 * L), np.inf)
    target = -gap.reshape(count, -1) / (2 * h)
    return JointImpulses(jacobian.reshape(count, 3 * L, -1), target, compliance, -infinite, infinite)


def limit_impulses(limits: Array, q: Array, v: Array, free: Array, diagonal: Array, h: float) -> list[JointImpulses]:
    """Return the impulses of joint limits at N states with positions q and velocities v (N, nv).

    `free` (N, nv) is v' without impulses, `limits` (2, nv) may be infinite, and `diagonal` (N, nv) is that of A.
    """
    window = LIMIT_WINDOW * h * np.maximum(np.abs(v), np.abs(free))
    impulses, stiffest = [], 1 / (2 * h * h * LIMIT_STIFFNESS)
    for sign, limit in ((1.0, limits[0]), (-1.0, limits[1])):
        limited = np.flatnonzero(np.isfinite(limit))
        distance = sign * (q - limit)[:, limited]
        compliance = np.maximum(NEAR_RIGID / diagonal[:, limited], stiffest)
        upper = np.where(distance <= window[:, limited], np.inf, 0.0)
        direction = sign * np.eye(q.shape[1])[limited]
        impulses.append(JointImpulses(direction, -distance / (2 * h), compliance, np.zeros_like(upper), upper))
    return impulses


@dataclass(frozen=True, eq=False)
class Controllers:
    """C PD controllers, in N states."""

    velocity: NDArray[np.intp]  # (C,) the degree of freedom of each controller
    kp: Array  # (N, C)
    kd: Array
    reference: Array  # (2, N, C) positions and velocities
    limit: Array  # (C,) effort limits

    def impulses(self, q: Array, us: Array, diagonal: Array, h: float) -> JointImpulses:
        """Return the impulses for q and `diagonal` (N, nv) as for limits, and the actuators' inputs us (N, C)."""
        softest = NEAR_RIGID / diagonal[:, self.velocity]
        lowered = np.minimum(1.0, 1 / (h * (h * self.kp + self.kd) * softest))
        kp, kd = lowered * self.kp, lowered * self.kd
        effort = us - kp * (q[:, self.velocity] - self.reference[0]) + kd * self.reference[1]
        total, bound = h * kp + kd, np.broadcast_to(h * self.limit, us.shape)
        direction = np.eye(q.shape[1])[self.velocity]
        return JointImpulses(direction, effort / total, 1 / (h * total), -bound, bound)


PROBES = 3  # two to identify a coupler, one more to check it
SAME = 1e-8  # relative to the largest entry: Drake solves a quadratic problem to rounding


@dataclass(frozen=True, eq=False)
class Couplers:
    """K couplers."""

    direction: Array  # (K, nv)
    offset: Array  # (K,)

    def impulses(self, q: Array, diagonal: Array, h: float) -> JointImpulses:
        """Return the impulses at N states: q (N, nv) of each degree of freedom, `diagonal` (N, nv) of A."""
        off, w = q @ self.direction.T - self.offset, 1 / diagonal @ (self.direction**2).T
        infinite = np.full(off.shape, np.inf)
        return JointImpulses(self.direction, -off / (2 * h), NEAR_RIGID * w, -infinite, infinite)


def couplers_of(model: Model) -> Couplers | Refusal:
    """Return the couplers that act in the model's steps, or a Refusal if a constraint is not a known coupler."""

    if model.coupling is not None:
        return model.cache("couplers", lambda: _known(model), of_structure=True)

    def read() -> Couplers | Refusal:
        couplers, of_loops = [], [pair.constraint for pair in model.file_facts.held_points]
        for constraint in model.plant.GetConstraintIds():
            if constraint in of_loops:
                continue
            if not model.plant.GetConstraintActiveStatus(model.double.context, constraint):
                continue
            coupler = _read(model, constraint)
            if isinstance(coupler, Refusal):
                return coupler
            couplers.append(coupler)
        directions, offsets = [d for d, _ in couplers], [o for _, o in couplers]
        return Couplers(np.array(directions).reshape(-1, model.nv), np.array(offsets, dtype=float))

    return model.cache("couplers", read, of_structure=True)


def _known(model: Model) -> Couplers:
    """Return the couplers of the reduced mimic joints, in the velocities of the whole plant."""
    pairs = joints_of_mimics(model.plant, model.coupling.mimics if model.coupling is not None else ())
    directions = np.zeros((len(pairs), model.plant.num_velocities()))
    for row, (mimic, follower, leader) in zip(directions, pairs, strict=True):
        row[follower.velocity_start()], row[leader.velocity_start()] = 1.0, -mimic.ratio
    return Couplers(directions, np.array([mimic.offset for mimic, _, _ in pairs]))


def _read(model: Model, constraint: Any) -> tuple[Array, float] | Refusal:
    """Identify the direction (nv,) and the offset of a coupler."""
    plant, random = model.plant, np.random.default_rng(0)
    root = model.diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    scene_graph = model.double.scene_graph
    if scene_graph is not None:  # disable contact in this context
        everything = GeometrySet(scene_graph.model_inspector().GetAllGeometryIds())
        filters = scene_graph.collision_filter_manager(scene_graph.GetMyMutableContextFromRoot(root))
        filters.Apply(CollisionFilterDeclaration().ExcludeWithin(everything))
    for other in plant.GetConstraintIds():
        plant.SetConstraintActiveStatus(context, other, other == constraint)
    if model.systems_act:
        return Refusal(f"a constraint acts, and {model.systems_act}")
    if model.nu:
        plant.get_actuation_input_port().FixValue(context, np.zeros(plant.num_actuators()))
    try:
        probes = [_probe(model, context, random) for _ in range(PROBES)]
    except RuntimeError as error:
        return Refusal(f"a constraint acts that could not be read: {error}")
    positions, _, single = single_joints(model)
    position, velocity = positions[single], np.flatnonzero(single)
    impulse = probes[0][2]
    coupled = np.flatnonzero(np.abs(impulse) > SAME * np.abs(impulse).max())
    if len(coupled) != 2 or not np.isin(coupled, velocity).all():
        return Refusal("a constraint acts that does not couple two joints")
    direction = np.zeros(model.nv)
    direction[coupled] = impulse[coupled] / impulse[coupled[0]]
    q = np.zeros((PROBES, model.nv))
    q[:, velocity] = np.array([p[0] for p in probes])[:, position]
    offsets = []
    for k, (_, v_next, impulse, A) in enumerate(probes):
        R = NEAR_RIGID * float((direction**2 / np.diag(A)).sum())
        offsets.append(float(direction @ q[k] + 2 * model.time_step * (R * impulse[coupled[0]] + direction @ v_next)))
        if not np.abs(impulse - impulse[coupled[0]] * direction).max() <= SAME * np.abs(impulse).max():
            return Refusal("a constraint acts that does not couple two joints")
    if not np.ptp(offsets) <= SAME:
        return Refusal("a constraint between two joints acts that is not a coupler")
    return direction, float(np.mean(offsets))


def _probe(model: Model, context: Any, random: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Return q, v', A (v' - v*) and A of one step from rest, with all other forces compensated, so that v* = 0.

    Otherwise the robot falls, and relative to its momentum the impulse of a light finger is lost to rounding.
    """
    plant = model.plant
    lower, upper = (
        np.clip(side, -1.0, 1.0) for side in (plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits())
    )
    q = np.array(plant.GetPositions(context))
    positions, _, single = single_joints(model)
    position = positions[single]
    q[position] = (lower + random.uniform(0.3, 0.7, len(q)) * (upper - lower))[position]
    plant.SetPositions(context, q)
    plant.SetVelocities(context, np.zeros(model.nv))
    forces = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    held = plant.CalcInverseDynamics(context, np.zeros(model.nv), forces)
    plant.get_applied_generalized_force_input_port().FixValue(context, held)
    v_next = np.array(plant.EvalUniquePeriodicDiscreteUpdate(context).value())[model.nq :]
    A = plant.CalcMassMatrix(context) + model.time_step * np.diag(model.double.damping())
    return q, v_next, A @ v_next, A


def single_joints(model: Model) -> tuple[Indices, Array, NDArray[np.bool_]]:
    """Return, for each degree of freedom, its index in q (nv,), limits (2, nv), and if its joint has no others (nv,).

    For other degrees of freedom, such as those of free bodies, the index is 0 and the limits are infinite.
    """

    def read() -> tuple[Indices, Array, NDArray[np.bool_]]:
        positions, limits = np.zeros(model.nv, dtype=np.intp), np.array([[-np.inf], [np.inf]]) * np.ones(model.nv)
        single = np.zeros(model.nv, dtype=bool)
        for joint in joints(model.plant):
            if joint.num_positions() == joint.num_velocities() == 1:
                i = joint.velocity_start()
                positions[i], single[i] = joint.position_start(), True
                limits[:, i] = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        return positions, limits, single

    return model.cache("single joints", read, of_structure=True)

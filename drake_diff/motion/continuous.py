"""The motion in continuous time that a model's discrete steps approximate, integrated with error control.

    M(q) dv/dt = B u + forces(q, v) - C(q, v) v + sum over contacts J' (the force of `compliance`)

with the law of the model's own contact approximation and Drake's rules to combine the two materials of a contact. The
mass matrix, the forces without contact, and the overlaps of geometries come from Drake. Discrete steps are not used.
It shares no equations with the flow used to plan in continuous time, so that replaying a plan is a cross-check.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable, MultibodyForces

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.model.contact import ContactPoint, body_of
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators
from drake_diff.model.step import set_state
from drake_diff.motion import compliance
from drake_diff.motion.integrate import TOLERANCE, Flags, Integrator, Pairs, Step, System, deepest_contacts
from drake_diff.motion.rollout import Policy, Rollout, continuous_rollout

NUDGE = 1e-9  # relative finite-difference step of the state for the Jacobian of the rates: a millionth of v_s
LOOK, LOOKS = 1e-3, 8  # [s] interval of contact checks within a step without contact, and their maximum number
Chooser = Callable[[Array, int], Array]  # the state (nx,) and the number of the step -> the input (nu,)
Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class _Touch:
    """The contact parameters of two geometries A and B."""

    friction: float
    stiffness: float  # [N/m]
    damping: float  # d [s/m] or tau [s]
    share: float  # weight of A's witness point in the contact point
    bodies: tuple[tuple[float, int, Any], ...]  # (+1 for A or -1 for B, body index, body), without the world


@dataclass(frozen=True, slots=True)
class _Contact:
    """Two overlapping geometries A and B; `relative` is A's velocity relative to B, and `normal` points out of B."""

    pair: int
    ids: tuple[Any, Any]
    touch: _Touch
    depth: float  # [m]
    point: Vector  # the contact point in world
    normal: Vector
    relative: Vector
    force: Vector  # [N] on A
    push: float  # [N] normal component of the force


class ContinuousMotion(System):
    """The continuous motion of a model with its currently applied parameters.

    `law` is the contact law, by default the model's own. With `works`, three more states are the work of the inputs,
    the energy dissipated by damping, and the work of contact [J]. Raises ModelError if the model has contact other than
    point contact, PD controllers, or constraints.
    """

    contact_is_stiff = True

    def __init__(self, model: Model, law: str | None = None, *, works: bool = False, sizes: Any = 1.0):
        plant, contact = model.plant, model.contract.contact
        if contact.collision_pairs and contact.model != "point":
            raise ModelError(f"{contact.model} contact is not supported in continuous time")
        if any(actuator.has_controller() for actuator in actuators(plant)):
            raise ModelError("PD controllers are not supported in continuous time")
        if model.num_constraints:
            raise ModelError("constraints are not supported in continuous time")
        self.model, self.twin, self.time_step, self.works = model, model.double, model.time_step, works
        self.law, self.sizes = law or compliance.limit_law(model), sizes
        self.limits = model.inputs.of_actuators([actuator.effort_limit() for actuator in actuators(plant)])
        self.position_limits, self.damping = model.position_limits, model.double.damping()
        self.moves_as_is, self.still = plant.IsVelocityEqualToQDot(), np.zeros(model.nv)
        self.forces = MultibodyForces(plant)
        candidates = model.double.inspector.GetCollisionCandidates() if contact.collision_pairs else ()
        self.numbers = {ids: i for i, pair in enumerate(sorted(candidates)) for ids in (pair, pair[::-1])}
        self.num_pairs = len(self.numbers) // 2
        self.touched = False  # whether any contact was active in the last call of `roll`
        self._touches: dict[int, _Touch] = {}
        self.set_input(np.zeros(model.nu))

    def set_input(self, u: Array) -> None:
        """Set the constant input `u` (nu,)."""
        self.twin.set_input(u)
        self.force = self.model.actuation @ np.clip(u, -self.limits, self.limits)

    def states(self, x0: Array, us: Array) -> Array:
        """Return the states (N+1, nx) at the ends of the model's steps under constant us (N, nu); raise as `roll`."""
        return self.roll(x0, lambda x, k: us[k], len(us))[0]

    def roll(
        self, x0: Array, choose: Chooser, count: int, *, tolerance: float = TOLERANCE, deadline: float = np.inf
    ) -> tuple[Array, Array]:
        """Return xs (N+1, nx) at the ends of the model's steps, and us (N, nu), each chosen at the start of its step.

        Raises SimulationError if the motion reaches a joint limit or is too stiff, and TimeoutError if this thread's
        CPU time (`time.thread_time`) exceeds `deadline` [s].
        """
        xs, us = np.empty((count + 1, len(x0))), np.empty((count, self.model.nu))
        xs[0], self.touched = x0, False
        for k, (u, steps) in enumerate(self.intervals(x0, choose, count, tolerance, deadline)):
            us[k], xs[k + 1] = u, steps[-1].ahead
            self.touched |= any(step.pushing for step in steps)
        return xs, us

    def intervals(
        self, x0: Array, choose: Chooser, count: int, tolerance: float = TOLERANCE, deadline: float = np.inf
    ) -> Iterator[tuple[Array, list[Step]]]:
        """Yield the input (nu,) and the integrator's steps for each of the model's own steps from the state `x0`."""
        integrator, x = Integrator(self, tolerance, deadline), x0
        for k in range(count):
            u = choose(x[: self.model.nx], k)
            self.set_input(u)
            if k == 0:
                integrator.start(x0)
            steps = integrator.advance(self.time_step)
            x = steps[-1].ahead
            yield u, steps

    def rates(self, x: Array) -> Array:
        """Return dx/dt at `x` under the input, with forces only from the pairs `pushing` of this step."""
        self.used += 1
        twin, v = self.twin, x[self.model.nq : self.model.nx]
        set_state(twin, x[: self.model.nx])
        push = self.contact_force(self.pushing) if self.pushing else self.still
        acceleration = np.linalg.solve(twin.mass_matrix(), self.force - twin.inverse_dynamics(self.still) + push)
        rates = v if self.moves_as_is else twin.rates(v), acceleration
        driven = self.force + twin.systems_force() if self.works and self.model.inputs.fed else self.force
        return np.concatenate([*rates, [v @ driven, v @ (self.damping * v), v @ push]] if self.works else rates)

    def slopes(self, x: Array, rates: Array) -> Array:
        slopes = np.empty((len(x), len(x)))
        for j, size in enumerate(np.maximum(1.0, np.abs(x)).tolist()):
            beside = x.copy()
            beside[j] += NUDGE * size
            slopes[:, j] = (self.rates(beside) - rates) / (beside[j] - x[j])
        return slopes

    def watch(self, x: Array, rates: Array) -> tuple[Array, Array]:
        """Return 1 for each pair with a contact force, else -1; Drake gives no distances of separated geometries."""
        values = np.full(self.num_pairs, -1.0)
        if self.num_pairs:
            set_state(self.twin, x[: self.model.nx])
            values[[contact.pair for contact in self._contacts() if contact.push > 0]] = 1.0
        return values, np.zeros(self.num_pairs)

    def pushing_where(self, on: Flags) -> Pairs:
        return tuple(np.flatnonzero(on).tolist())

    def parts(self, h: float) -> Sequence[float]:
        looks = 1 if self.pushing or not self.num_pairs else min(LOOKS, 1 + int(h / LOOK))
        return [i / looks for i in range(1, looks)]

    def check(self, x: Array) -> None:
        (lower, upper), q = self.position_limits, x[: self.model.nq]
        if np.any(q < lower) or np.any(q > upper):
            raise SimulationError("it reaches a joint limit, which is not supported in continuous time")

    def contact_force(self, pairs: Pairs | None = None) -> Array:
        """Return the generalized force (nv,) of all contacts at the context's state, or of some `pairs`."""
        plant, context = self.twin.plant, self.twin.context
        wrenches: dict[int, Array] = {}  # on each body about the world's origin
        for contact in self._contacts(pairs):
            wrench = np.array([*_cross(contact.point, contact.force), *contact.force])
            for sign, i, _ in contact.touch.bodies:
                wrenches[i] = wrenches.get(i, 0.0) + sign * wrench
        self.forces.SetZero()
        for i, total in wrenches.items():
            body = plant.get_body(BodyIndex(i))
            force = SpatialForce(total).Shift(plant.EvalBodyPoseInWorld(context, body).translation())
            body.AddInForceInWorld(context, force, self.forces)
        return np.asarray(self.twin.own_force(plant.CalcGeneralizedForces(context, self.forces)))

    def touches_at(self, x: Array) -> Iterator[tuple[str, float, float, Array]]:
        """Yield (names, k [N/m], d [s/m] or tau [s], inverse mass (3, 3) at the contact) for each overlap at `x`."""
        if not self.num_pairs:
            return
        set_state(self.twin, x)
        plant, context, by_v = self.twin.plant, self.twin.context, JacobianWrtVariable.kV
        world, mass = plant.world_frame(), self.twin.mass_matrix()
        for contact in list(self._contacts()):
            jacobian = np.zeros((3, plant.num_velocities()))
            for sign, _, body in contact.touch.bodies:
                frame = body.body_frame()
                local = plant.CalcPointsPositions(context, world, np.reshape(contact.point, (3, 1)), frame)
                jacobian += sign * plant.CalcJacobianTranslationalVelocity(context, by_v, frame, local, world, world)
            if self.model.coupling is not None:
                jacobian = jacobian @ self.model.coupling.spread
            names = " and ".join(self.twin.inspector.GetName(geometry) for geometry in contact.ids)
            touch = contact.touch
            yield names, touch.stiffness, touch.damping, jacobian @ np.linalg.solve(mass, jacobian.T)

    def points_at(self, x: Array, pairs: Pairs) -> Iterator[tuple[int, ContactPoint]]:
        set_state(self.twin, x[: self.model.nx])
        for contact in self._contacts(pairs):
            if contact.push > 0:
                (a, b), sign = (body_of(self.model, geometry) for geometry in contact.ids), 1.0
                if self.twin.plant.IsAnchored(a):  # report the force on the movable body
                    a, b, sign = b, a, -1.0
                normal, relative = np.array(contact.normal), np.array(contact.relative)
                slip = float(np.linalg.norm(relative - (relative @ normal) * normal))
                where = frozen(contact.point), frozen(sign * normal), frozen(sign * np.array(contact.force))
                yield contact.pair, ContactPoint(a.name(), b.name(), *where, contact.depth, slip)

    def _contacts(self, pairs: Pairs | None = None) -> "Iterator[_Contact]":
        """Yield the overlaps at the context's state, of all pairs or of `pairs`."""
        plant, context = self.twin.plant, self.twin.context
        query = plant.get_geometry_query_input_port().Eval(context)
        try:
            overlaps = query.ComputePointPairPenetration()
        except RuntimeError as error:
            raise SimulationError(f"Drake cannot tell how deep geometries overlap: {error}") from error
        twists: dict[int, tuple[Vector, Vector]] = {}  # angular velocity, and velocity of the point at world's origin
        for overlap in overlaps:
            ids = overlap.id_A, overlap.id_B
            number = self.numbers[ids]
            if pairs is not None and number not in pairs:
                continue
            touch = self._touches.get(number) or self._touch(number, ids, query.inspector())
            a, b = touch.share, 1 - touch.share
            point = _sum(_times(a, overlap.p_WCa.tolist()), _times(b, overlap.p_WCb.tolist()))
            relative = 0.0, 0.0, 0.0
            for sign, i, body in touch.bodies:
                if i not in twists:
                    twist = plant.EvalBodySpatialVelocityInWorld(context, body)
                    twist = twist.Shift(-plant.EvalBodyPoseInWorld(context, body).translation())
                    twists[i] = tuple(twist.rotational().tolist()), tuple(twist.translational().tolist())
                turn, move = twists[i]
                relative = _sum(relative, _times(sign, _sum(move, _cross(turn, point))))
            normal = overlap.nhat_BA_W.tolist()
            force, push = self._force(touch, overlap.depth, normal, relative)
            yield _Contact(number, ids, touch, float(overlap.depth), point, normal, relative, force, push)

    def _force(self, touch: _Touch, depth: float, normal: Vector, relative: Vector) -> tuple[Vector, float]:
        """Return the force on A [N] and its normal component."""
        rate = -_dot(normal, relative)
        bracket = compliance.bracket(self.law, depth, rate, touch.damping)
        push = max(0.0, compliance.normal_force(self.law, touch.stiffness, depth, bracket))
        slip = _sum(relative, _times(rate, normal))
        speed = _dot(slip, slip) ** 0.5
        drag = compliance.drag(touch.friction, speed, min) if speed > 0 else 0.0
        return _times(push, _sum(normal, _times(-drag, slip))), push

    def _touch(self, number: int, ids: tuple[Any, Any], inspector: Any) -> _Touch:
        plant, bodies = self.twin.plant, []
        material = compliance.read_material(inspector, [ids], self.law)
        for sign, geometry in zip((1.0, -1.0), ids, strict=True):
            body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
            if body.index() != plant.world_body().index():
                bodies.append((sign, int(body.index()), body))
        damped = material.time if self.law == compliance.KELVIN_VOIGT else material.dissipation
        # The contact point is that of Drake's steps, or the midpoint as in Drake's continuous plants.
        share = 1 - float(material.other_part[0]) if self.law == compliance.limit_law(self.model) else 0.5
        friction, stiffness, damping = (float(a[0]) for a in (material.friction, material.stiffness, damped))
        self._touches[number] = _Touch(friction, stiffness, damping, share, tuple(bodies))
        return self._touches[number]


def _sum(a: Any, b: Any) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _times(factor: float, a: Any) -> Vector:
    return factor * a[0], factor * a[1], factor * a[2]


def _dot(a: Any, b: Any) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _cross(a: Any, b: Any) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def replayed(
    model: Model,
    x0: Array,
    inputs: Array | Policy,
    count: int,
    tolerance: float = TOLERANCE,
    evaluations: int | None = None,
    sizes: Array | None = None,
) -> Rollout:
    """Return the motion over `count` of the model's steps under us (N, nu) or a policy; raise as `ContinuousMotion`.

    The motion is too stiff if it needs more than `evaluations` of the equations of motion at the given `tolerance`.
    """
    all_sizes = 1.0 if sizes is None else np.append(sizes, np.ones(3))  # 1 J for the work states
    motion, nx = ContinuousMotion(model, works=True, sizes=all_sizes), model.nx
    motion.most = evaluations or motion.most

    def choose(x: Array, k: int) -> Array:
        if callable(inputs):
            return finite_array("u", inputs(x.copy(), k * model.time_step), (model.nu,))
        return inputs[k]

    us, states, contacts = np.empty((count, model.nu)), np.zeros((count + 1, nx + 3)), []
    states[0, :nx] = x0
    for k, (u, steps) in enumerate(motion.intervals(states[0], choose, count, tolerance)):
        us[k], states[k + 1] = u, steps[-1].ahead
        contacts.append(deepest_contacts(motion, steps))
    return continuous_rollout(
        model, states[:, :nx], us, np.clip(us, -motion.limits, motion.limits), states[:, nx:], contacts
    )

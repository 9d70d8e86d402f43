"""The motion in continuous time that a model's discrete steps stand for, integrated with error control.

    M(q) dv/dt = B u + forces(q, v) - C(q, v) v + sum over contacts J' (f n - mu step5(|v_t| / v_s) f v_t / |v_t|)

with the normal force of the model's own contact approximation at depth x and its rate x',

    f = k (x + tau x')+   of `sap` (Kelvin and Voigt),    f = k x (1 + d x')+   of `similar` and `lagged` (Hunt and
    Crossley),

step5(r) = r^3 (10 - 15 r + 6 r^2) up to 1, and Drake's rules for the two sides of a contact. It is written out from
these formulas: of Drake it takes the mass matrix, the forces without contact and where geometries overlap, and nothing
of a discrete step.

In the air steps are explicit. What touches is stiff, as friction that holds is a damper of mu f / v_s: steps there are
linearly implicit, of Rodas5P. Where two geometries touch or let go the force has a corner, and that of Kelvin and
Voigt jumps by k tau x': a step ends there, and no pair pushes within a step that did not at its start.

It shares no equation with the flow that plans in continuous time are made by, so that they are replayed by it.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable, MultibodyForces

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.model.contact import ContactPoint, body_of
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators, proximity_property
from drake_diff.model.step import set_state
from drake_diff.motion.rollout import Policy, Rollout, continuous_rollout
from drake_diff.motion.tableaus import (
    ERROR,
    LEAST,
    ROSENBROCK_COUPLINGS,
    ROSENBROCK_GAMMA,
    ROSENBROCK_STAGES,
    STAGES,
    factor,
)

TOLERANCE = 1e-9  # of each step, relative to max(1, |x|)
EVALUATIONS = 1_000_000  # of the equations of motion at most, about half a minute
# v_s [m/s]: below it friction is a damper, above it Coulomb's, as in Drake's continuous plants. In Drake's steps it is
# 1e-4 or less.
SLIP = 1e-3
NUDGE = 1e-9  # of a state's entries, which the slopes of the rates are differences over: a millionth of v_s
SHORTEST = 1e-14  # [s] a step that is shorter does not move time
ROOT = 1e-13  # [s] how near to a touch, or to the end of one, the step before it ends
LOOK, LOOKS = 1e-3, 8  # [s] how often a step in the air is looked at for what touches, and how many times at most
KELVIN_VOIGT, HUNT_CROSSLEY = "Kelvin-Voigt", "Hunt-Crossley"  # the laws of contact
DAMPING = {KELVIN_VOIGT: "relaxation_time", HUNT_CROSSLEY: "dissipation"}  # the quantity each needs beside stiffness
Rates = Callable[[Array], Array]
Chooser = Callable[[Array, int], Array]  # the state (nx,) and the number of the step -> the input (nu,)
Pairs = frozenset[Any]  # of geometries' identifiers


def own_law(model: Model) -> str:
    """The law of contact that a model's steps tend to as they become short."""
    return KELVIN_VOIGT if model.contract.contact.approximation == "sap" else HUNT_CROSSLEY


@dataclass(frozen=True, eq=False)
class _Touch:
    """What two geometries are when they touch: mu, k [N/m], d [s/m] or tau [s], the part of A's own point in it."""

    friction: float
    stiffness: float
    damping: float
    part: float
    bodies: tuple[tuple[float, int, Any], ...]  # +1 for A and -1 for B, its index, itself; the world left out


@dataclass(frozen=True, slots=True)
class _Contact:
    """Two geometries A and B that overlap; A's point moves `relative` to B's, and the `normal` is out of B."""

    pair: tuple[Any, Any]
    touch: _Touch
    depth: float  # [m]
    point: tuple[float, ...]  # where the force acts, in world
    normal: list[float]
    relative: tuple[float, ...]
    force: list[float]  # [N] on A
    push: float  # [N] of it along the normal


class ContinuousMotion:
    """The continuous motion of a model, as it is now: parameters that are applied act.

    `law` is that of contact, the model's own where it is not given. Raises ModelError, which says why, where it has
    none: contact that is no point contact or states no stiffness, PD controllers, constraints.
    """

    def __init__(self, model: Model, law: str | None = None):
        plant, contract = model.plant, model.contract
        contact = contract.contact
        if contact.collision_pairs and contact.model != "point":
            raise ModelError(f"{contact.model} contact has none here")
        if any(actuator.has_controller() for actuator in actuators(plant)):
            raise ModelError("PD controllers have none")
        if model.num_constraints:
            raise ModelError("constraints have none")
        self.model, self.twin = model, model.double
        self.most = EVALUATIONS
        self.used, self.touched = 0, False  # evaluations of the rates, and whether anything touched, in the last call
        self.touches = bool(contact.collision_pairs)
        self.law = law or own_law(model)
        self.actuation = model.actuation
        self.limits = model.inputs.of_actuators([actuator.effort_limit() for actuator in actuators(plant)])
        self.plain_rates = plant.IsVelocityEqualToQDot()
        self.still = np.zeros(model.nv)
        self.lower, self.upper = model.position_limits
        self.forces = MultibodyForces(plant)
        self._touches: dict[Any, _Touch] = {}

    def states(self, x0: Array, us: Array) -> Array:
        """(N+1, nx) at the ends of the model's steps, over which us (N, nu) is held; raises as `roll`."""
        return self.roll(x0, lambda x, k: us[k], len(us))[0]

    def roll(
        self, x0: Array, choose: Chooser, count: int, *, tolerance: float = TOLERANCE, deadline: float = np.inf
    ) -> tuple[Array, Array]:
        """xs (N+1, nx) at the ends of the model's steps, and us (N, nu), each chosen at the start of one and held.

        SimulationError where it has no end: it reaches a joint limit, or is too stiff for `EVALUATIONS`. TimeoutError
        where this thread has worked (`time.thread_time`) until `deadline` [s].
        """
        xs, us, dt = np.empty((count + 1, self.model.nx)), np.empty((count, self.model.nu)), self.model.time_step
        xs[0], self.used, self.touched = x0, 0, False
        for k in range(count):
            us[k] = choose(xs[k], k)
            self.twin.set_input(us[k])
            force = self.actuation @ np.clip(us[k], -self.limits, self.limits)
            xs[k + 1], dt = self._advance(partial(self.rates, force), xs[k], dt, tolerance, deadline)
        return xs, us

    def rates(self, force: Array, x: Array, only: Pairs | None = None) -> Array:
        """(nx,) dx/dt at `x` (nx,) under the actuators' generalized `force` (nv,); of contacts `only` some push."""
        self.used += 1
        twin, nq = self.twin, self.model.nq
        set_state(twin, x)
        total = force - twin.inverse_dynamics(self.still)
        if self.touches and (only is None or only):
            total = total + self.contact_force(only)
        v = x[nq:]
        q_dot = v if self.plain_rates else twin.rates(v)
        return np.concatenate([q_dot, np.linalg.solve(twin.mass_matrix(), total)])

    def pushing(self, x: Array) -> Pairs:
        """The pairs of geometries that push each other at `x` (nx,)."""
        if not self.touches:
            return frozenset()
        set_state(self.twin, x)
        return frozenset(contact.pair for contact in self._contacts(None) if contact.push > 0)

    def contact_force(self, only: Pairs | None = None) -> Array:
        """(nv,) of all contacts in the context's state, or of some pairs `only`."""
        plant, context = self.twin.plant, self.twin.context
        wrenches: dict[int, list[float]] = {}  # on each body about the world's origin
        for contact in self._contacts(only):
            (x, y, z), (fx, fy, fz) = contact.point, contact.force
            wrench = y * fz - z * fy, z * fx - x * fz, x * fy - y * fx, fx, fy, fz
            for sign, i, _ in contact.touch.bodies:
                total = wrenches.setdefault(i, [0.0] * 6)
                for n, value in enumerate(wrench):
                    total[n] += sign * value
        self.forces.SetZero()
        for i, total in wrenches.items():
            body = plant.get_body(BodyIndex(i))
            force = SpatialForce(np.array(total)).Shift(plant.EvalBodyPoseInWorld(context, body).translation())
            body.AddInForceInWorld(context, force, self.forces)
        return np.asarray(self.twin.own_force(plant.CalcGeneralizedForces(context, self.forces)))

    def touches_at(self, x: Array) -> Iterator[tuple[str, float, float, Array]]:
        """(names, k [N/m], d [s/m] or tau [s], the inverse mass (3, 3) at the contact) of each that overlaps at `x`."""
        if not self.touches:
            return
        set_state(self.twin, x)
        plant, context, by_v = self.twin.plant, self.twin.context, JacobianWrtVariable.kV
        inspector, pairs = self._penetrations()
        world, mass = plant.world_frame(), self.twin.mass_matrix()
        for pair in pairs:
            touch = self._touches.get((pair.id_A, pair.id_B)) or self._touch(inspector, pair.id_A, pair.id_B)
            point = touch.part * np.asarray(pair.p_WCa) + (1 - touch.part) * np.asarray(pair.p_WCb)
            jacobian = np.zeros((3, self.model.nv))
            for sign, _, body in touch.bodies:
                local = plant.CalcPointsPositions(context, world, point.reshape(3, 1), body.body_frame())
                J = plant.CalcJacobianTranslationalVelocity(context, by_v, body.body_frame(), local, world, world)
                jacobian += sign * (J if self.model.coupling is None else J @ self.model.coupling.spread)
            names = " and ".join(inspector.GetName(geometry) for geometry in (pair.id_A, pair.id_B))
            yield names, touch.stiffness, touch.damping, jacobian @ np.linalg.solve(mass, jacobian.T)

    def _contacts(self, only: Pairs | None) -> "Iterator[_Contact]":
        """The pairs that overlap in the context's state, or some of them `only`."""
        plant, context = self.twin.plant, self.twin.context
        inspector, pairs = self._penetrations()
        twists: dict[int, list[float]] = {}  # of each body: how it turns, and how its point at the world's origin moves
        for pair in pairs:
            key = pair.id_A, pair.id_B
            if only is not None and key not in only:
                continue
            touch = self._touches.get(key) or self._touch(inspector, *key)
            a, b = touch.part, 1 - touch.part
            x, y, z = (a * p + b * q for p, q in zip(pair.p_WCa.tolist(), pair.p_WCb.tolist(), strict=True))
            ux = uy = uz = 0.0
            for sign, i, body in touch.bodies:
                if i not in twists:
                    twist = plant.EvalBodySpatialVelocityInWorld(context, body)
                    origin = plant.EvalBodyPoseInWorld(context, body).translation()
                    twists[i] = twist.Shift(-origin).get_coeffs().tolist()
                wx, wy, wz, vx, vy, vz = twists[i]
                ux += sign * (vx + wy * z - wz * y)
                uy += sign * (vy + wz * x - wx * z)
                uz += sign * (vz + wx * y - wy * x)
            normal, relative = pair.nhat_BA_W.tolist(), (ux, uy, uz)
            *force, push = self._force(touch, pair.depth, normal, relative)
            yield _Contact(key, touch, pair.depth, (x, y, z), normal, relative, force, push)

    def _force(self, touch: _Touch, depth: float, normal: Any, relative: Any) -> tuple[float, ...]:
        """[N] on A, and how much of it is along the normal. A's point moves `relative` to B's; `normal` is out of B."""
        (nx, ny, nz), (vx, vy, vz) = normal, relative
        rate = -(nx * vx + ny * vy + nz * vz)
        if self.law == KELVIN_VOIGT:
            push = max(0.0, touch.stiffness * (depth + touch.damping * rate))
        else:
            push = touch.stiffness * depth * max(0.0, 1 + touch.damping * rate)
        sx, sy, sz = vx + rate * nx, vy + rate * ny, vz + rate * nz
        speed = (sx * sx + sy * sy + sz * sz) ** 0.5
        r = min(speed / SLIP, 1.0)
        drag = touch.friction * r**3 * (10 - 15 * r + 6 * r * r) / speed if speed > 0 else 0.0
        return push * (nx - drag * sx), push * (ny - drag * sy), push * (nz - drag * sz), push

    def _penetrations(self) -> tuple[Any, Any]:
        """(inspector, pairs that overlap) in the context's state."""
        query = self.twin.plant.get_geometry_query_input_port().Eval(self.twin.context)
        try:
            return query.inspector(), query.ComputePointPairPenetration()
        except RuntimeError as error:
            raise SimulationError(f"Drake cannot tell how deep geometries overlap: {error}") from error

    def _touch(self, inspector: Any, a: Any, b: Any) -> _Touch:
        plant, names, sides, bodies = self.twin.plant, ("friction", "stiffness", DAMPING[self.law]), [], []
        for sign, geometry in ((1.0, a), (-1.0, b)):
            values = []
            for name in names:
                value = proximity_property(inspector, geometry, name)
                if value is None:
                    raise SimulationError(f"{inspector.GetName(geometry)} states no {name}")
                values.append(value)
            sides.append(values)
            body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
            if body.index() != plant.world_body().index():
                bodies.append((sign, int(body.index()), body))
        (mu_a, k_a, d_a), (mu_b, k_b, d_b) = sides
        share = k_a / (k_a + k_b)
        both = d_a + d_b if self.law == KELVIN_VOIGT else (1 - share) * d_a + share * d_b
        friction, stiffness = 2 * mu_a * mu_b / (mu_a + mu_b or 1.0), k_a * k_b / (k_a + k_b)
        acting = share if self.law == own_law(self.model) else 0.5  # Drake's continuous plant pushes in the middle
        self._touches[a, b] = _Touch(friction, stiffness, both, acting, tuple(bodies))
        return self._touches[a, b]

    def _advance(
        self, rates: Callable[..., Array], x: Array, dt: float, tolerance: float, deadline: float
    ) -> tuple[Array, float]:
        """(the state one of the model's steps after `x`, a length of step [s] that would do next)."""
        duration, now, pushing = self.model.time_step, 0.0, self.pushing(x)
        while now < duration:
            self.touched |= bool(pushing)
            f = partial(rates, only=pushing)
            steps = ImplicitSteps(f, x) if pushing else ExplicitSteps(f, x)
            while True:
                if self.used > self.most:
                    raise SimulationError(f"it is too stiff: {self.most} evaluations do not reach its end")
                if time.thread_time() > deadline:
                    raise TimeoutError
                step = min(dt, duration - now)
                ahead, error = steps.take(step)
                ratio = _ratio(x, ahead, error, tolerance)
                change = factor(ratio) if np.isfinite(ratio) else LEAST
                if ratio <= 1:
                    break
                dt = step * change
                if dt < SHORTEST:
                    raise SimulationError("it cannot go on: its rates are not finite, or jump")
            # A step that was cut off at the end says nothing against a longer one.
            dt = max(dt, step * change) if step < dt else step * change
            taken, x, pushing = self._until_change(steps, step, ahead, pushing)
            now = duration if taken == duration - now else now + taken
            if np.any(x[: self.model.nq] < self.lower) or np.any(x[: self.model.nq] > self.upper):
                raise SimulationError("it reaches a joint limit, which has none")
        return x, dt

    def _until_change(
        self, steps: "ExplicitSteps | ImplicitSteps", step: float, ahead: Array, pushing: Pairs
    ) -> tuple[float, Array, Pairs]:
        """(length, end, pairs that push there) of the step, or of its part until other pairs push than at its start."""
        if not self.touches:
            return step, ahead, pushing
        low, high, now = 0.0, step, self.pushing(ahead)
        if isinstance(steps, ExplicitSteps):
            looks = min(LOOKS, 1 + int(step / LOOK))
            parts = (i / looks for i in range(1, looks))
            seen = next((share for share in parts if self.pushing(steps.within(share, ahead))), 1.0)
            low, high = (seen - 1 / looks) * step, seen * step
            if seen < 1:
                ahead, _ = steps.take(high)
                now = self.pushing(ahead)
        while now != pushing and high - low > ROOT:
            middle = (low + high) / 2
            state, _ = steps.take(middle)
            there = self.pushing(state)
            if there == pushing:
                low = middle
            else:
                high, ahead, now = middle, state, there
        return high, ahead, now


class ExplicitSteps:
    """Steps of any length from one state, of Dormand and Prince's orders 5 and 4."""

    def __init__(self, rates: Rates, x: Array):
        self.rates, self.x, self.first = rates, x, rates(x)
        self.last, self.length = self.first, 0.0  # the slope at the end of the last step, and how long it was

    def take(self, h: float) -> tuple[Array, Array]:
        """The state after a step of `h` [s], and its error."""
        slopes, state = [self.first], self.x
        for weights in STAGES:
            state = self.x + h * (np.array(weights) @ np.array(slopes))
            slopes.append(self.rates(state))
        self.last, self.length = slopes[-1], h
        return state, h * (ERROR @ np.array(slopes))

    def within(self, share: float, ahead: Array) -> Array:
        """The state at a `share` of the last step, which led to `ahead`: by the cubic of both ends' slopes."""
        s, h = share, self.length
        ends = (1 + 2 * s) * (1 - s) ** 2 * self.x + s * s * (3 - 2 * s) * ahead
        return np.asarray(ends + h * s * (1 - s) * ((1 - s) * self.first - s * self.last))


class ImplicitSteps:
    """Steps of any length from one state, of Rodas5P, which share the slopes of the rates there."""

    def __init__(self, rates: Callable[[Array], Array], x: Array):
        self.rates, self.x, self.first = rates, x, rates(x)
        self.slopes = np.empty((len(x), len(x)))
        for j, size in enumerate(np.maximum(1.0, np.abs(x)).tolist()):
            beside = x.copy()
            beside[j] += NUDGE * size
            self.slopes[:, j] = (rates(beside) - self.first) / (beside[j] - x[j])

    def take(self, h: float) -> tuple[Array, Array]:
        """The state after a step of `h` [s], and its error."""
        inverse = np.linalg.inv(np.eye(len(self.x)) / (ROSENBROCK_GAMMA * h) - self.slopes)
        stages, state = np.empty((len(ROSENBROCK_STAGES), len(self.x))), self.x
        for i, (weights, couplings) in enumerate(zip(ROSENBROCK_STAGES, ROSENBROCK_COUPLINGS, strict=True)):
            state = self.x + weights @ stages[:i]
            value = self.first if i == 0 else self.rates(state)
            stages[i] = inverse @ (value + couplings @ stages[:i] / h)
        return state + stages[-1], stages[-1]


def _ratio(x: Array, ahead: Array, error: Array, tolerance: float) -> float:
    """The error of a step from `x` to `ahead`, as a part of what is allowed."""
    size = tolerance * np.maximum(1.0, np.maximum(np.abs(x), np.abs(ahead)))
    with np.errstate(over="ignore", invalid="ignore"):
        ratio = float(np.sqrt(np.mean((error / size) ** 2)))
    return ratio if np.isfinite(ratio) else float("inf")


def replayed(
    model: Model,
    x0: Array,
    inputs: Array | Policy,
    count: int,
    *,
    tolerance: float = TOLERANCE,
    evaluations: int | None = None,
) -> Rollout:
    """The motion over `count` of the model's steps under us (N, nu) or a policy; raises what `ContinuousMotion` does.

    It is too stiff where it takes more than `evaluations` of the equations of motion to the `tolerance` of each step.
    The states have work with them while they are integrated: of actuators, of what damping took, and of contact [J].
    """
    motion, nx, h = _WithWork(model, tolerance), model.nx, model.time_step
    motion.most = evaluations or motion.most
    states, us = np.zeros((count + 1, nx + 3)), np.empty((count, model.nu))
    states[0, :nx] = x0
    deepest, contacts, dt = np.zeros(count + 1), list[tuple[ContactPoint, ...]](), h
    for k in range(count):
        x = states[k, :nx].copy()
        us[k] = finite_array("u", inputs(x, k * h), (model.nu,)) if callable(inputs) else inputs[k]
        states[k + 1], dt = motion.follow(states[k], us[k], dt)
        pushed = motion.deepest()
        contacts.append(tuple(point for _, point in sorted(pushed.items())))
        deepest[k + 1] = max((point.depth for point in pushed.values()), default=0.0)
    efforts = np.clip(us, -motion.limits, motion.limits)
    return continuous_rollout(model, states[:, :nx], us, efforts, states[:, nx:], deepest, tuple(contacts))


class _WithWork(ContinuousMotion):
    """Of states (nx + 3,), the last three being work."""

    def __init__(self, model: Model, tolerance: float):
        super().__init__(model)
        self.tolerance = tolerance
        self.damping, self.push, self.seen = model.double.damping(), np.zeros(model.nv), list[Array]()

    def follow(self, state: Array, u: Array, dt: float) -> tuple[Array, float]:
        """The state one of the model's steps later, and a length of step [s] that would do next."""
        self.twin.set_input(u)
        self.seen = [state]
        force = self.actuation @ np.clip(u, -self.limits, self.limits)
        return self._advance(partial(self.rates, force), state, dt, self.tolerance, np.inf)

    def rates(self, force: Array, x: Array, only: Pairs | None = None) -> Array:
        self.push, v = self.still, x[self.model.nq : self.model.nx]
        slopes = super().rates(force, x[: self.model.nx], only)
        return np.concatenate([slopes, [v @ force, v @ (self.damping * v), v @ self.push]])

    def contact_force(self, only: Pairs | None = None) -> Array:
        self.push = super().contact_force(only)
        return self.push

    def pushing(self, x: Array) -> Pairs:
        return super().pushing(x[: self.model.nx])

    def _until_change(self, *given: Any) -> tuple[float, Array, Pairs]:
        change = super()._until_change(*given)
        self.seen.append(change[1])
        return change

    def deepest(self) -> dict[tuple[str, str], ContactPoint]:
        """Of each two bodies that pushed each other since `follow` was called, where they were deepest."""
        points: dict[tuple[str, str], ContactPoint] = {}
        for state in self.seen if self.touches else ():
            for point in self._points(state[: self.model.nx]):
                names = point.body_a, point.body_b
                if names not in points or point.depth > points[names].depth:
                    points[names] = point
        return points

    def _points(self, x: Array) -> Iterator[ContactPoint]:
        """Of the pairs that push at `x` (nx,)."""
        set_state(self.twin, x)
        for contact in self._contacts(None):
            if contact.push > 0:
                (a, b), sign = (body_of(self.model, geometry) for geometry in contact.pair), 1.0
                if self.twin.plant.IsAnchored(a):  # the force is the one on what can move
                    a, b, sign = b, a, -1.0
                normal, relative = np.array(contact.normal), np.array(contact.relative)
                slip = float(np.linalg.norm(relative - (relative @ normal) * normal))
                where = frozen(contact.point), frozen(sign * normal), frozen(sign * np.array(contact.force))
                yield ContactPoint(a.name(), b.name(), *where, float(contact.depth), slip)

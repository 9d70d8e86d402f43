"""What `rollout` measures, of the motion in continuous time as `ContinuousMotion` integrates it.

It shares no equation with the flow that plans in continuous time are made by, so that they are replayed by it.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff.model.contact import ContactPoint, body_of
from drake_diff.model.model import Model
from drake_diff.model.step import set_state
from drake_diff.motion.continuous import TOLERANCE, ContinuousMotion, Pairs
from drake_diff.motion.rollout import Meter, Policy, Rollout


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
    motion, meter, nx, h = _WithWork(model, tolerance), Meter(model), model.nx, model.time_step
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
    for x in states[:, :nx]:
        set_state(model.double, x)
        meter.measure_state(x)
    _, kinetic, potential, at_ends = (np.array(column) for column in zip(*meter.states, strict=True))
    work, dissipation, by_contact = states[:, nx:].T
    return Rollout(
        times=frozen(h * np.arange(count + 1)),
        xs=frozen(states[:, :nx]),
        us=frozen(us),
        efforts=frozen(np.clip(us, -motion.limits, motion.limits)),
        kinetic_energy=frozen(kinetic),
        potential_energy=frozen(potential),
        work=frozen(work),
        dissipation=frozen(dissipation),
        contact_work=frozen(by_contact),
        limit_work=frozen(np.zeros(count + 1)),  # a motion that reaches one is refused
        penetration=frozen(np.maximum(np.maximum(at_ends, deepest), np.append(0.0, at_ends[:-1]))),
        constraint_violation=frozen(meter.violations(states[:, : model.nq])),
        contacts=tuple(contacts),
    )


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
        found = super().rates(force, x[: self.model.nx], only)
        return np.concatenate([found, [v @ force, v @ (self.damping * v), v @ self.push]])

    def contact_force(self, only: Pairs | None = None) -> Array:
        self.push = super().contact_force(only)
        return self.push

    def pushing(self, x: Array) -> Pairs:
        return super().pushing(x[: self.model.nx])

    def _until_change(self, *given: Any) -> tuple[float, Array, Pairs]:
        found = super()._until_change(*given)
        self.seen.append(found[1])
        return found

    def deepest(self) -> dict[tuple[str, str], ContactPoint]:
        """Of each two bodies that pushed each other since `follow` was called, where they were deepest."""
        found: dict[tuple[str, str], ContactPoint] = {}
        for state in self.seen if self.touches else ():
            for point in self._points(state[: self.model.nx]):
                names = point.body_a, point.body_b
                if names not in found or point.depth > found[names].depth:
                    found[names] = point
        return found

    def _points(self, x: Array) -> Iterator[ContactPoint]:
        """Of the pairs that push at `x` (nx,)."""
        set_state(self.twin, x)
        plant, context = self.twin.plant, self.twin.context
        inspector, pairs = self._penetrations()
        for pair in pairs:
            key = pair.id_A, pair.id_B
            touch, normal = self._found.get(key) or self._touch(inspector, *key), np.asarray(pair.nhat_BA_W)
            point = touch.part * np.asarray(pair.p_WCa) + (1 - touch.part) * np.asarray(pair.p_WCb)
            relative = np.zeros(3)
            for sign, _, body in touch.bodies:
                moves, place = (
                    plant.EvalBodySpatialVelocityInWorld(context, body),
                    plant.EvalBodyPoseInWorld(context, body),
                )
                relative += sign * np.asarray(moves.Shift(point - place.translation()).translational())
            *force, push = self._force(touch, pair.depth, normal, relative)
            if push > 0:
                a, b, sign = body_of(self.model, key[0]), body_of(self.model, key[1]), 1.0
                if plant.IsAnchored(a):  # the force is the one on what can move
                    a, b, sign = b, a, -1.0
                slip = float(np.linalg.norm(relative - (relative @ normal) * normal))
                where = frozen(point), frozen(sign * normal), frozen(sign * np.array(force))
                yield ContactPoint(a.name(), b.name(), *where, float(pair.depth), slip)

"""Gauss-Newton over positions: the least cost of a motion under inverse dynamics with relaxed contact.

The unknowns are q_1 ... q_N. Velocities are v_k = (q_k - q_(k-1)) / h, forces are those of `plant`, inputs what of them
the motors give, and what they cannot give has to vanish. That, bounds, goals and constraints are an augmented
Lagrangian. With v_(k+1) as the input that leads from q_k to q_(k+1), a step of Gauss and Newton's is Riccati's sweep
(Kurtz and Lin, "Inverse dynamics trajectory optimization for contact-implicit model predictive control", 2023; there
the forces that no motor gives cost a penalty). No motion is ever rolled out, so that any guess will do.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, skew
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.optimize.ilqr.constraints import AugmentedLagrangian
from drake_diff.optimize.ilqr.expansion import Motion, expand_costs
from drake_diff.optimize.ilqr.riccati import LinearQuadratic, follow, slope_along, solve_riccati
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.relaxed.plant import RelaxedPlant, Softness


@dataclass(frozen=True)
class SearchOptions:
    """What tunes the search of a stage."""

    penalty: float = 1.0  # the first
    growth: float = 5.0
    largest_penalty: float = 1e8
    relent: float = 25.0  # times the first penalty: the highest that a stage begins with
    sufficient: float = 1e-3  # of the decrease that the model promises
    smallest: float = 1e-8  # of the Hessian's largest entry: what counts as its smallest
    least_damping: float = 1e-9
    most_damping: float = 1e9
    enough: float = 1e-3  # of the merit: less than that is no gain
    inner: int = 20  # steps between two looks at the multipliers
    # [m/s or rad/s], and in the units of bounds and goals: what a stage leaves is for the true plant to close.
    closed: float = 1e-3
    stalled: float = 0.7  # of what was open: where no more than that was closed
    patience: int = 6  # times in a row, the search ends


OPTIONS = SearchOptions()


@dataclass(frozen=True, eq=False)
class RelaxedMotion:
    """q (N+1, nq), and what it comes to."""

    q: Array
    xs: Array  # (N+1, nx)
    us: Array  # (N, nu)
    tau: Array  # (N, nv)


@dataclass(frozen=True, eq=False)
class Found:
    """The motion, its cost and how far it is from one: what no motor gives as a speed [m/s or rad/s], in N steps."""

    motion: RelaxedMotion
    iterations: int
    cost: float
    gap: float
    violation: float
    ended: str


class RelaxedSearch:
    """The search of one problem; each stage begins where the one before ended."""

    def __init__(self, problem: Problem, plant: RelaxedPlant):
        self.problem, self.plant, self.h = problem, plant, problem.model.time_step
        model = problem.model
        self.nv, self.count = model.nv, problem.num_steps
        self.constraints = AugmentedLagrangian(problem)
        self.undriven = plant.undriven
        self.lower, self.upper = problem.bounds.u_lower, problem.bounds.u_upper
        self.rest_multipliers = np.zeros((self.count, self.undriven.shape[1]))
        self.input_multipliers = np.zeros((self.count, problem.nu))
        self.rest_penalty, self.input_penalty = OPTIONS.penalty, 0.0
        self.rest_scale, self.input_scale = self._scales()
        self.started = False

    def _scales(self) -> tuple[Array, Array]:
        """What a force of 1 along each undriven direction and each input changes in a step, as a speed."""
        x0, model, plant = self.problem.x0, self.problem.model, self.plant
        still = np.zeros((1, model.nv))
        moved = plant.tree.compiled(x0[None, : model.nq], still, still, derivatives=False)
        mass = moved.mass[0] + np.diag(plant.tree.reflected)
        inverse = np.linalg.inv(mass)
        of_rest = np.einsum("ir,ij,jr->r", self.undriven, inverse, self.undriven)
        of_inputs = np.einsum("ir,ij,jr->r", plant.actuation, inverse, plant.actuation)
        return self.h * of_rest, self.h * of_inputs

    def run(
        self, q: Array, soft: Softness, most: int, is_over: Callable[[], bool], tell: Callable[[str], None]
    ) -> Found:
        """At most `most` steps from q (N+1, nq), of which the first is given."""
        motion = self.motion(q, soft)
        if self.started:
            self._relent()
        else:
            self._start(motion)
        merit, damping, since, ended, stuck = self._merit(motion), 1e-3, 0, "iteration_limit", 0
        number, before = 0, (self._gap(motion), self._violation(motion))
        while number < most:
            if is_over():
                ended = "time_limit"
                break
            moved, gained, damping = self._improved(motion, merit, soft, damping)
            number, since = number + 1, since + 1
            little = moved is None or gained < OPTIONS.enough * (abs(merit) + self._size(motion))
            if moved is not None:
                motion, merit = moved, merit - gained
            if not little and since < OPTIONS.inner:
                continue
            now = self._gap(motion), self._violation(motion)
            cost = self.problem.objective(motion.xs, motion.us)
            tell(f"relaxed step {number}: cost {cost:.6g}, gap {now[0]:.2g}, violation {now[1]:.2g}")
            if max(now) < OPTIONS.closed and little:
                ended = "solved"
                break
            stuck = stuck + 1 if max(now) > OPTIONS.stalled * max(before) else 0
            if stuck >= OPTIONS.patience:
                ended = "inaccurate"
                break
            self._update(motion, before, now, grow=little)
            merit, since, before, damping = self._merit(motion), 0, now, min(damping, 1e-3)
        cost = self.problem.objective(motion.xs, motion.us)
        return Found(motion, number, cost, self._gap(motion), self._violation(motion), ended)

    def _improved(
        self, motion: RelaxedMotion, merit: float, soft: Softness, damping: float
    ) -> tuple[RelaxedMotion | None, float, float]:
        """The motion after a step that lowers the merit, None where there is none; by how much; and the damping."""
        model, size = self._expand(motion, soft)
        while damping <= OPTIONS.most_damping:
            step = self._step(model, damping * size)
            if step is not None:
                trial = self.motion(self._moved(motion.q, step[0][:, : self.nv]), soft)
                gained, promised = merit - self._merit(trial), -slope_along(model, *step)[0] / 2
                if np.isfinite(gained) and gained > OPTIONS.sufficient * promised:
                    return trial, gained, max(damping / (5 if gained > 0.5 * promised else 1.5), OPTIONS.least_damping)
            damping *= 4
        return None, 0.0, damping

    def motion(self, q: Array, soft: Softness) -> RelaxedMotion:
        v = self._velocities(q)
        forces = self.plant.forces(q[:-1], v[:-1], v[1:], soft, slopes=False)
        return RelaxedMotion(q, np.hstack([q, v]), forces.tau @ self.plant.inverse_actuation.T, forces.tau)

    def _velocities(self, q: Array) -> Array:
        v = np.empty((len(q), self.nv))
        v[0] = self.problem.x0[self.problem.model.nq :]
        v[1:] = between(self.plant.coordinates, q[:-1], q[1:])[0] / self.h
        return v

    # ------------------------------------------------------------------ the augmented cost

    @property
    def learned(self) -> tuple[Any, ...]:
        """Multipliers and penalties, to go back to."""
        learned = self.rest_multipliers, self.input_multipliers, self.rest_penalty, self.input_penalty
        return (*learned, self.constraints.forces, self.constraints.penalty)

    @learned.setter
    def learned(self, learned: tuple[Any, ...]) -> None:
        self.rest_multipliers, self.input_multipliers, self.rest_penalty, self.input_penalty, forces, penalty = learned
        self.constraints.forces, self.constraints.penalty = forces, penalty

    def _start(self, motion: RelaxedMotion) -> None:
        self.started = True
        cost = self.problem.objective(motion.xs, motion.us)
        wrong = float(np.sum(self._rest(motion) ** 2)) / 2
        size = abs(cost) / wrong if wrong > 0 else 0.0
        self.rest_penalty = float(np.clip(size, 1.0, 1e4))
        self.input_penalty = self.rest_penalty
        self.constraints.start(motion.xs, motion.us, cost, float(np.sum(self._rest(motion) ** 2)))
        self.first_penalty, self.first_weight = self.rest_penalty, self.constraints.penalty

    def _relent(self) -> None:
        """Penalties no higher than a few times the first: those of the stage before are too stiff for another law."""
        most = OPTIONS.relent * self.first_penalty
        self.rest_penalty, self.input_penalty = min(self.rest_penalty, most), min(self.input_penalty, most)
        self.constraints.penalty = min(self.constraints.penalty, OPTIONS.relent * self.first_weight)

    def _rest(self, motion: RelaxedMotion) -> Array:
        return (motion.tau @ self.undriven) * self.rest_scale

    def _input_pushes(self, motion: RelaxedMotion) -> Array:
        p, s = self.input_penalty, self.input_scale
        above = self.input_multipliers + p * s * (motion.us - self.upper)
        below = self.input_multipliers + p * s * (motion.us - self.lower)
        return np.maximum(above, 0.0) + np.minimum(below, 0.0)

    def _merit(self, motion: RelaxedMotion) -> float:
        rest, p = self._rest(motion), self.rest_penalty
        with np.errstate(all="ignore"):
            total = self.problem.objective(motion.xs, motion.us) + self.constraints.value(motion.xs, motion.us)
        total += float(np.sum(self.rest_multipliers * rest + p * rest**2 / 2))
        pushes = self._input_pushes(motion)
        return total + float(np.sum(pushes**2 - self.input_multipliers**2)) / (2 * self.input_penalty)

    def _size(self, motion: RelaxedMotion) -> float:
        """What the merit's parts come to, which may cancel in it."""
        return abs(self.problem.objective(motion.xs, motion.us)) + self.rest_penalty / 2 * float(
            np.sum(self._rest(motion) ** 2)
        )

    def _update(
        self, motion: RelaxedMotion, before: tuple[float, float], now: tuple[float, float], *, grow: bool
    ) -> None:
        """Better multipliers, and where the last ones did not help, higher penalties."""
        self.rest_multipliers = self.rest_multipliers + self.rest_penalty * self._rest(motion)
        self.input_multipliers = self._input_pushes(motion)
        self.constraints.update(motion.xs, motion.us)
        if not grow:
            return
        if now[0] > max(OPTIONS.closed, before[0] / OPTIONS.growth):
            self.rest_penalty = min(OPTIONS.growth * self.rest_penalty, OPTIONS.largest_penalty)
        if now[1] > max(OPTIONS.closed, before[1] / OPTIONS.growth):
            self.input_penalty = min(OPTIONS.growth * self.input_penalty, OPTIONS.largest_penalty)
            self.constraints.penalty = min(OPTIONS.growth * self.constraints.penalty, OPTIONS.largest_penalty)

    def _gap(self, motion: RelaxedMotion) -> float:
        return float(np.max(np.abs(self._rest(motion)), initial=0.0))

    def _violation(self, motion: RelaxedMotion) -> float:
        beyond = np.maximum(np.maximum(self.lower - motion.us, motion.us - self.upper), 0.0) * self.input_scale
        return max(self.constraints.violation(motion.xs, motion.us), float(np.max(beyond, initial=0.0)))

    # ------------------------------------------------------------------ its expansion

    def _expand(self, motion: RelaxedMotion, soft: Softness) -> tuple[LinearQuadratic, Array]:
        """The cost by small motions of q and changes of v, v_(k+1) being the input of knot k; see `_sizes`."""
        nv, nq, N, h = self.nv, self.problem.model.nq, self.count, self.h
        q, v = motion.q, motion.xs[:, nq:]
        forces = self.plant.forces(q[:-1], v[:-1], v[1:], soft, slopes=True)
        g, H = self._of_knots(motion)  # by [dq_k, v_k, tau_k]
        Z = np.tile(np.diag([1.0] * 2 * nv + [0.0] * nv), (N + 1, 1, 1))  # that by z_k = [dq_k, dv_k, dv_(k+1)]
        Z[:-1, 2 * nv :] = np.concatenate([forces.by_motion, forces.by_v, forces.by_next], axis=2)
        first, second = slopes_of(self.plant.coordinates, q[:-1], q[1:])  # of h v_(k+1)
        F = np.zeros((N, 2 * nv, 3 * nv))
        F[:, :nv, :nv], F[:, :nv, 2 * nv :] = -np.linalg.solve(second, first), h * np.linalg.inv(second)
        F[:, nv:, 2 * nv :] = np.eye(nv)
        gradients, hessians = (Z.swapaxes(1, 2) @ g[..., None])[..., 0], Z.swapaxes(1, 2) @ H @ Z
        given, wide = np.zeros(2 * nv), np.full((N, nv), np.inf)
        model = LinearQuadratic(F, np.zeros((N, 2 * nv)), gradients, hessians, -wide, wide, given, given)
        return model, self._sizes(hessians, first / h, second / h)

    def _sizes(self, hessians: Array, first: Array, second: Array) -> Array:
        """(nv,) the mean curvature of the cost by one q_k alone, which changes v_k and v_(k+1) too."""
        none, one = np.zeros_like(first), np.broadcast_to(np.eye(self.nv), first.shape)
        after, beyond = np.concatenate([first[1:], none[:1]]), np.zeros((1, *hessians.shape[1:]))
        moved = (none, none, second), (one, second, after), (none, after, none)
        blocks = zip(moved, (hessians[:-1], hessians[1:], np.concatenate([hessians[2:], beyond])), strict=True)
        parts = ((np.concatenate(by_q, axis=1), block) for by_q, block in blocks)
        size = sum(np.einsum("kia,kij,kja->a", by_q, block, by_q, optimize=True) for by_q, block in parts) / self.count
        return np.asarray(np.maximum(size, OPTIONS.smallest * np.max(size)) + np.finfo(float).tiny)

    def _of_knots(self, motion: RelaxedMotion) -> tuple[Array, Array]:
        """The gradients (N+1, 3 nv) and Hessians (N+1, 3 nv, 3 nv) of the augmented cost by [dq, v, tau]."""
        nv, nq, nx, N = self.nv, self.problem.model.nq, self.problem.nx, self.count
        rate = self.plant.coordinates.rate(motion.q)
        T = np.zeros((N + 1, nx + self.problem.nu, 3 * nv))
        T[:, :nq, :nv] = rate
        T[:, nq:nx, nv : 2 * nv] = np.eye(nv)
        T[:, nx:, 2 * nv :] = self.plant.inverse_actuation
        rollout = Motion(motion.xs, motion.us, np.zeros((N, nx)))
        gradients, hessians = expand_costs(self.problem, rollout, self.constraints)
        pushes = self._input_pushes(motion)
        gradients[:-1, nx:] += self.input_scale * pushes
        inputs = np.arange(nx, T.shape[1])
        hessians[:-1, inputs, inputs] += np.where(pushes != 0, self.input_penalty, 0.0) * self.input_scale**2
        g = (T.swapaxes(1, 2) @ gradients[..., None])[..., 0]
        H = T.swapaxes(1, 2) @ hessians @ T
        U = self.undriven * self.rest_scale
        g[:-1, 2 * nv :] += (self.rest_multipliers + self.rest_penalty * (motion.tau @ U)) @ U.T
        H[:-1, 2 * nv :, 2 * nv :] += self.rest_penalty * U @ U.T
        return g, H

    def _step(self, model: LinearQuadratic, weights: Array) -> tuple[Array, Array] | None:
        """Gauss-Newton's step, with `weights` (nv,) on how far q_k and q_(k+1) part: a whole motion may shift."""
        apart, hessians = model.F[:, : self.nv] - np.eye(self.nv, 3 * self.nv), np.array(model.hessians)
        hessians[:-1] += (apart.swapaxes(1, 2) * weights) @ apart
        policy = solve_riccati(replace(model, hessians=hessians), 0.0)
        return None if policy is None else follow(model, policy)

    def _moved(self, q: Array, d: Array) -> Array:
        """q (N+1, nq) moved by d (N+1, nv)."""
        coordinates = self.plant.coordinates
        moved = q + (coordinates.rate(q) @ d[..., None])[..., 0]
        for i, _ in coordinates.free:
            moved[:, i : i + 4] /= np.linalg.norm(moved[:, i : i + 4], axis=1, keepdims=True)
        return moved


def _conjugate_product(p: Array, q: Array) -> Array:
    """(..., 4) p * conj(q) of quaternions w x y z."""
    w = (p * q).sum(axis=-1)
    vector = q[..., :1] * p[..., 1:] - p[..., :1] * q[..., 1:] - np.cross(p[..., 1:], q[..., 1:])
    return np.concatenate([w[..., None], vector], axis=-1)


def between(coordinates: Coordinates, q: Array, q_next: Array) -> tuple[Array, list[Array]]:
    """(N, nv) the small motion from q to q_next (each (N, nq)), h v' of Drake's step; and the turns (N, 3) in it."""
    moves, turns = np.empty((len(q), coordinates.nv)), []
    for i, j in coordinates.single:
        moves[:, j] = q_next[:, i] - q[:, i]
    for i, j in coordinates.free:
        turn = _conjugate_product(q_next[:, i : i + 4], q[:, i : i + 4])
        moves[:, j : j + 3] = 2 * turn[:, 1:] / turn[:, :1]
        moves[:, j + 3 : j + 6] = q_next[:, i + 4 : i + 7] - q[:, i + 4 : i + 7]
        turns.append(moves[:, j : j + 3])
    return moves, turns


def slopes_of(coordinates: Coordinates, q: Array, q_next: Array) -> tuple[Array, Array]:
    """(N, nv, nv) the derivatives of `between` by small motions of q and of q_next."""
    _, turns = between(coordinates, q, q_next)
    first = np.repeat(-np.eye(coordinates.nv)[None], len(q), axis=0)
    second = -first
    for (_, j), r in zip(coordinates.free, turns, strict=True):
        block, across, outer = slice(j, j + 3), skew(r) / 2, r[:, :, None] * r[:, None, :] / 4
        first[:, block, block] = -np.eye(3) - across - outer
        second[:, block, block] = np.eye(3) - across + outer
    return first, second

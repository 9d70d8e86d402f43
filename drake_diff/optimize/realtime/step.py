"""One step of sequential quadratic programming on a stretch of a problem: linearize, solve, take what the merit allows.

The merit is an exact one: the cost, the prices of what is beyond limits, and of the gaps between the steps. Gauss and
Newton's curvature alone is used, that of the dynamics is left out. Diehl, Bock and Schloeder, "A real-time iteration
scheme for nonlinear optimization in optimal feedback control", 2005.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.refusal import Refusal
from drake_diff.derivatives.step import linearize
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.step import advance
from drake_diff.optimize.ilqr.riccati import AffinePolicy, LinearQuadratic, solve_riccati
from drake_diff.optimize.problem.constraint import Bounds
from drake_diff.optimize.problem.cost import CostToGo
from drake_diff.optimize.realtime.knots import KnotCost, KnotFunction
from drake_diff.optimize.realtime.qp import Limited, Moves, Rows, SoftProgram

STEP_SIZES = (1.0, 0.5, 0.25, 0.125, 1 / 16, 1 / 32)
SUFFICIENT_DECREASE = 1e-4
GAP_PRICE = 2.0  # over the largest multiplier of the dynamics
SMALLEST_REGULARIZATION = 1e-8
ROUNDING = 1e-12  # of the merit: a change below this is lost in the sum
SOLVED_TO = 1e-9  # the same of a quadratic program with limits that push
# Of what a step moves the plant by: an error above it is looked at over a part of the step, where it has to shrink.
SUSPECT, SHORT_PART, STILL = 0.1, 1e-2, 0.5
UNSEEN = 1e-5  # of a state: Drake solves contact to 1e-6
# Of a multiplier over its price: a row between the two parts holds the motion, others do not or give way.
HOLDS, GIVES = 1e-6, 1 - 1e-6
SLIGHT = 1e-6  # of a row's range: what a limit that gives way is passed by at least
DEAR, NO_SLOPE = 10.0, 1e-12  # prices over what a unit is worth; slopes whose squares are taken for none
NARROW = 0.1  # of the range of a row: limits on both sides that are nearer to each other are met, not kept
STIFF = 1e4  # over a row's price, per its scale: the curvature of a row that holds, for gains and values


@dataclass(frozen=True, eq=False)
class Limits:
    """Rows lower <= f(z) <= upper at each knot of a stretch, infinite where there is none; `prices` (m,) per unit."""

    labels: tuple[str, ...]  # (m,)
    function: KnotFunction
    rows: Rows
    lower: Array  # (K, m)
    upper: Array
    prices: Array
    ranges: Array  # (m,) how far f ranges; a limit on both sides that is far narrower is one to be met

    def at(self, xs: Array, us: Array) -> Array:
        """(K, nx + nu) the knots of a motion where they hold."""
        found = np.concatenate([xs, np.zeros((len(xs), us.shape[1]))], axis=1)
        found[:-1, xs.shape[1] :] = us
        return found[self.rows.first : self.rows.last + 1]

    def beyond(self, values: Array) -> Array:
        """(K, m) how far `values` are beyond a limit."""
        return np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0)


@dataclass(frozen=True, eq=False)
class Stage:
    """A cost at some knots of a stretch: `weight` times that of knots (K, n) at their times (K,) [s]."""

    cost: KnotCost
    at: slice  # of the knots 0 ... N
    times: Array
    weight: float


@dataclass(frozen=True, eq=False)
class Stretch:
    """What is minimized over some steps. Costs of `running` are of [x, u], those of `final` of x alone."""

    model: Model
    bounds: Bounds
    running: Sequence[Stage]
    final: Sequence[Stage]
    limits: Sequence[Limits]
    program: SoftProgram

    def cost(self, xs: Array, us: Array) -> float:
        """That of a motion xs (N+1, nx), us (N, nu)."""
        knots = np.hstack([xs[:-1], us])
        parts = [(s, knots) for s in self.running] + [(s, xs) for s in self.final]
        return float(sum(s.weight * np.sum(s.cost.values(z[s.at], s.times)) for s, z in parts))

    def beyond(self, xs: Array, us: Array) -> list[Array]:
        """How far each limit is passed, (K, m) each."""
        return [limit.beyond(limit.function.values(limit.at(xs, us))) for limit in self.limits]

    def ends(self, xs: Array, us: Array) -> Array:
        """(N, nx) where the plant's steps from xs (N, nx) under us (N, nu) lead."""
        return np.array([advance(self.model.double, x, u) for x, u in zip(xs, us, strict=True)])


@dataclass(frozen=True, eq=False)
class Motion:
    """xs (N+1, nx) and us (N, nu), and where each step leads: `ends` (N, nx)."""

    xs: Array
    us: Array
    ends: Array

    @property
    def gaps(self) -> Array:
        """(N, nx)"""
        return self.ends - self.xs[1:]


@dataclass(frozen=True, eq=False)
class Expansion:
    """A stretch to second order around a motion."""

    quadratic: LinearQuadratic
    limited: tuple[Limited, ...]


@dataclass(frozen=True, eq=False)
class Step:
    """One step: where it leads, and how much of it was taken.

    `size` is 0 where none was. `promised` is the decrease of the merit that a full step promised, `slacks` are those of
    the quadratic program: how far each limit has to be passed.
    """

    stretch: Stretch
    motion: Motion
    size: float
    promised: float
    merit: float
    expansion: Expansion
    moves: Moves
    whole: bool  # whether no limit pushed
    is_doubtful: bool = False  # whether the derivatives seem not to be those of the plant's steps

    @cached_property
    def policy(self) -> AffinePolicy | None:
        """How the solution changes with its first state, and what remains to be paid; None where neither is known.

        Rows and bounds that hold the solution go on to hold it, and those that give way give way.
        """
        return _solved(_held(self.expansion, self.moves, self.stretch, one_sided=True))

    @cached_property
    def tails(self) -> tuple[CostToGo, ...] | None:
        """What remains to be paid from each knot on, for motions that may also leave the limits to the inside."""
        policy = _solved(_held(self.expansion, self.moves, self.stretch, one_sided=False))
        if policy is None:
            return None
        parts = zip(self.motion.xs, policy.value_gradients, policy.value_hessians, strict=True)
        return tuple(CostToGo(*part) for part in parts)

    @property
    def is_reached(self) -> bool:
        """Whether a further step promises no more than what the program is solved to."""
        return self.promised <= (ROUNDING if self.whole else SOLVED_TO) * (1 + abs(self.merit))

    @property
    def given_way(self) -> tuple[str, float, int] | None:
        """(label, how far, knot) of the limit that the solution passes at the highest price, if it passes one."""
        worst, found = 0.0, None
        prices = [one.prices for one in self.expansion.limited]
        rows = zip(self.stretch.limits, prices, self.moves.slacks, self.moves.multipliers, strict=True)
        for limit, price, slack, force in rows:
            gives = (np.abs(force) >= GIVES * price) & (slack > SLIGHT * limit.ranges)
            paid = np.where(gives, slack * price, 0.0)
            if np.max(paid, initial=0.0) > worst:
                k, i = np.unravel_index(int(np.argmax(paid)), paid.shape)
                worst, found = float(paid[k, i]), (limit.labels[i], float(slack[k, i]), int(k) + limit.rows.first)
        return found


def take_step(stretch: Stretch, motion: Motion, damping: Array | None = None) -> Step | Refusal:
    """One step from `motion`, whose first state is given; a Refusal where the quadratic program is not solved.

    `damping` (nx + nu,) is added to the curvature of each knot, for shorter steps (Levenberg and Marquardt).

    Raises GradientError or SimulationError where a derivative is refused.
    """
    expansion = expand(stretch, motion)
    if damping is not None:
        expansion = replace(expansion, quadratic=_damped(expansion.quadratic, damping))
    free = _free_moves(expansion.quadratic)
    found = free if free is not None and _is_kept(stretch, expansion, free) else None
    whole = found is not None
    if found is None:
        if free is not None:
            expansion = replace(expansion, limited=_dear_enough(expansion.limited, free.dynamics))
        solved = stretch.program.solve(expansion.quadratic, expansion.limited)
        if isinstance(solved, Refusal):
            return solved
        found = solved
    else:
        nothing = tuple(np.zeros_like(one.lower) for one in expansion.limited)
        found = replace(found, slacks=nothing, multipliers=nothing)
    gap_prices = GAP_PRICE * np.max(np.abs(found.dynamics), axis=0)

    def merit(m: Motion) -> float:
        with np.errstate(all="ignore"):
            paid = sum(
                float(np.sum(one.prices * beyond))
                for one, beyond in zip(expansion.limited, stretch.beyond(m.xs, m.us), strict=True)
            )
            return stretch.cost(m.xs, m.us) + paid + float(np.sum(gap_prices * np.abs(m.gaps)))

    before = merit(motion)
    saved = [one.prices * (one.beyond - slack) for one, slack in zip(expansion.limited, found.slacks, strict=True)]
    slope, curvature = _along(expansion.quadratic, found)
    slope -= sum(float(np.sum(one)) for one in saved) + float(np.sum(gap_prices * np.abs(motion.gaps)))
    promised = -(slope + curvature / 2)
    rounding = ROUNDING * (1 + abs(before))
    for size in STEP_SIZES:
        xs, us = motion.xs + size * found.dxs, motion.us + size * found.dus
        us = np.clip(us, stretch.bounds.u_lower, stretch.bounds.u_upper)
        try:
            tried = Motion(xs, us, stretch.ends(xs[:-1], us))
            after = merit(tried)
        except SimulationError:
            continue
        if after <= before + SUFFICIENT_DECREASE * size * min(slope, 0.0) + rounding:
            step = Step(stretch, tried, size, promised, after, expansion, found, whole)
            return replace(step, is_doubtful=_is_doubtful(step, motion))
    return Step(stretch, motion, 0.0, promised, before, expansion, found, whole, is_doubtful=True)


def _damped(quadratic: LinearQuadratic, damping: Array) -> LinearQuadratic:
    final = quadratic.final_hessian + np.diag(damping[: quadratic.num_states])
    return replace(quadratic, hessians=quadratic.hessians + np.diag(damping), final_hessian=final)


def _is_doubtful(step: Step, before: Motion) -> bool:
    """Whether the plant leaves its derivatives by an error that does not shrink with the step, as a true one's does.

    It is looked at again, over a short part of the step, where the error is large.
    """
    d = np.hstack([step.moves.dxs[:-1], step.moves.dus])
    linear = np.einsum("kij,kj->ki", step.expansion.quadratic.F, d)
    change = float(np.max(np.abs(linear - step.moves.dxs[:-1])))  # beside what a state moves by anyway

    def error(motion: Motion, size: float) -> float:
        return float(np.max(np.abs(motion.ends - before.ends - size * linear)))

    large = error(step.motion, step.size)
    if large <= max(SUSPECT * step.size * change, UNSEEN * (1 + float(np.max(np.abs(before.ends))))):
        return False
    size = SHORT_PART * step.size
    xs, us = before.xs + size * step.moves.dxs, before.us + size * step.moves.dus
    return error(Motion(xs, us, step.stretch.ends(xs[:-1], us)), size) > STILL * SHORT_PART * large


def expand(stretch: Stretch, motion: Motion) -> Expansion:
    """The quadratic program around `motion`. Raises GradientError or SimulationError."""
    model, xs, us, bounds = stretch.model, motion.xs, motion.us, stretch.bounds
    inside = np.where(us == bounds.u_upper, np.nextafter(us, bounds.u_lower), us)
    inside = np.where(us == bounds.u_lower, np.nextafter(us, bounds.u_upper), inside)
    A, B, _ = linearize(model, xs, inside, x_next=motion.ends)
    nx, n = model.nx, model.nx + model.nu
    gradients, hessians = np.zeros((len(us), n)), np.zeros((len(us), n, n))
    final_gradient, final_hessian = np.zeros(nx), np.zeros((nx, nx))
    knots = np.hstack([xs[:-1], us])
    for s in stretch.running:
        gradient, hessian = s.cost.expand(knots[s.at], s.times)
        gradients[s.at] += s.weight * gradient
        hessians[s.at] += s.weight * hessian
    for s in stretch.final:
        gradient, hessian = s.cost.expand(xs[s.at], s.times)
        for k, g, h in zip(range(*s.at.indices(len(xs))), gradient, hessian, strict=True):
            if k < len(us):
                gradients[k, :nx] += s.weight * g
                hessians[k, :nx, :nx] += s.weight * h
            else:
                final_gradient, final_hessian = final_gradient + s.weight * g, final_hessian + s.weight * h
    if not (np.all(np.isfinite(gradients)) and np.all(np.isfinite(hessians)) and np.all(np.isfinite(final_gradient))):
        raise GradientError("the cost's derivative is not finite along the motion")
    quadratic = LinearQuadratic(
        F=np.concatenate([A, B], axis=2),
        gaps=motion.gaps,
        gradients=gradients,
        hessians=hessians,
        final_gradient=final_gradient,
        final_hessian=final_hessian,
        lower=bounds.u_lower - us,
        upper=bounds.u_upper - us,
        start_lower=np.zeros(nx),
        start_upper=np.zeros(nx),
    )
    return Expansion(quadratic, tuple(_limited(limit, xs, us) for limit in stretch.limits))


def _limited(limit: Limits, xs: Array, us: Array) -> Limited:
    values, jacobians = limit.function.linearize(limit.at(xs, us))
    if not (np.all(np.isfinite(values)) and np.all(np.isfinite(jacobians))):
        raise GradientError(f"{limit.labels[0]} or its derivative is not finite along the motion")
    return Limited(jacobians, limit.lower - values, limit.upper - values, limit.prices, limit.ranges)


def _free_moves(quadratic: LinearQuadratic) -> Moves | None:
    """The solution without limits; None where the cost has no minimum."""
    policy = solve_riccati(_unbounded(quadratic), 0.0)
    if policy is None:
        return None
    dxs, dus = _roll(quadratic, policy)
    dynamics = policy.value_gradients[1:] + np.einsum("kij,kj->ki", policy.value_hessians[1:], dxs[1:])
    return Moves(dxs, dus, (), (), np.zeros_like(dus), dynamics)


def _is_kept(stretch: Stretch, expansion: Expansion, moves: Moves) -> bool:
    """Whether moves leave no limit."""
    quadratic = expansion.quadratic
    if np.any(moves.dus < quadratic.lower) or np.any(moves.dus > quadratic.upper):
        return False
    for limit, one in zip(stretch.limits, expansion.limited, strict=True):
        moved = np.einsum("kri,ki->kr", one.jacobians, limit.at(moves.dxs, moves.dus))
        if np.any(moved < one.lower) or np.any(moved > one.upper):
            return False
    return True


def _dear_enough(limited: Sequence[Limited], forces: Array) -> tuple[Limited, ...]:
    """The same at prices that stand above what the motion without limits is worth, all raised alike.

    `forces` (N, nx) are its multipliers: far from the plan they are larger than the plan's own.
    """
    worth, factor = np.max(np.abs(forces), axis=0), 1.0
    for one in limited:
        slopes = np.abs(one.jacobians[:, :, : len(worth)])
        squared = np.sum(slopes**2, axis=2)
        seen = squared > NO_SLOPE
        wanted = DEAR * (slopes @ worth) / np.where(seen, squared, 1.0)
        factor = max(factor, float(np.max(np.where(seen, wanted / one.prices, 0.0), initial=0.0)))
    return tuple(replace(one, prices=factor * one.prices) for one in limited)


def free_policy(quadratic: LinearQuadratic) -> AffinePolicy | None:
    """The best policy without limits; None where the cost has no minimum."""
    return _solved(_unbounded(quadratic))


def _unbounded(quadratic: LinearQuadratic) -> LinearQuadratic:
    wide = np.full_like(quadratic.lower, np.inf)
    return replace(quadratic, lower=-wide, upper=wide)


def _roll(quadratic: LinearQuadratic, policy: AffinePolicy) -> tuple[Array, Array]:
    dxs, dus = np.zeros((len(quadratic.gaps) + 1, quadratic.num_states)), np.empty_like(policy.feedforward)
    for k, F in enumerate(quadratic.F):
        dus[k] = policy.feedforward[k] + policy.feedback[k].dot(dxs[k])
        dxs[k + 1] = F.dot(np.concatenate([dxs[k], dus[k]])) + quadratic.gaps[k]
    return dxs, dus


def _along(quadratic: LinearQuadratic, moves: Moves) -> tuple[float, float]:
    """The cost's slope and curvature along the whole step."""
    d, last = np.hstack([moves.dxs[:-1], moves.dus]), moves.dxs[-1]
    slope = float(np.sum(quadratic.gradients * d) + quadratic.final_gradient @ last)
    curved = np.einsum("ki,kij,kj->", d, quadratic.hessians, d) + last @ quadratic.final_hessian @ last
    return slope, float(curved)


def _solved(quadratic: LinearQuadratic) -> AffinePolicy | None:
    return solve_riccati(quadratic, 0.0) or solve_riccati(quadratic, SMALLEST_REGULARIZATION)


def _held(expansion: Expansion, moves: Moves, stretch: Stretch, *, one_sided: bool) -> LinearQuadratic:
    """The program around its own solution, with what holds it as curvature, and held inputs at rest.

    Where not `one_sided`, that is of rows alone that are to be met from both sides, and as stiff as they are dear.
    """
    q = expansion.quadratic
    nx, n, count = q.num_states, q.F.shape[2], len(q.F)
    d = np.hstack([moves.dxs[:-1], moves.dus])
    gradients = q.gradients + np.einsum("kij,kj->ki", q.hessians, d)
    final_gradient = q.final_gradient + q.final_hessian @ moves.dxs[-1]
    gradients, hessians = np.vstack([gradients, np.zeros((1, n))]), np.zeros((count + 1, n, n))
    gradients[-1, :nx] = final_gradient
    hessians[:-1], hessians[-1, :nx, :nx] = q.hessians, q.final_hessian
    for limit, one, forces in zip(stretch.limits, expansion.limited, moves.multipliers, strict=True):
        at = slice(limit.rows.first, limit.rows.last + 1)
        part = np.abs(forces) / one.prices
        holds = (part > HOLDS) & (part < GIVES)
        if one_sided:
            stiff = np.where(holds, STIFF * one.prices, 0.0)
        else:
            met = limit.upper - limit.lower < NARROW * limit.ranges
            stiff = np.where(met, one.prices / limit.ranges, 0.0)
        gradients[at] += np.einsum("kr,kri->ki", forces, one.jacobians)
        hessians[at] += np.einsum("kri,kr,krj->kij", one.jacobians, stiff, one.jacobians)
    F, on_bound = np.array(q.F), _on_bound(q, moves)
    for k, i in np.argwhere(on_bound):
        F[k, :, nx + i] = 0.0
        hessians[k, nx + i, :] = hessians[k, :, nx + i] = 0.0
        hessians[k, nx + i, nx + i], gradients[k, nx + i] = 1.0, 0.0
    nothing = np.full_like(q.lower, math.inf)
    return replace(
        q, F=F, gaps=np.zeros_like(q.gaps), gradients=gradients[:-1], hessians=hessians[:-1],
        final_gradient=gradients[-1, :nx], final_hessian=hessians[-1, :nx, :nx], lower=-nothing, upper=nothing,
    )  # fmt: skip


def _on_bound(q: LinearQuadratic, moves: Moves) -> Array:
    """(N, nu) which inputs a bound holds: those nearer to it than its multiplier is to 0, both in their own scale."""
    width = np.where(np.isfinite(q.upper - q.lower), q.upper - q.lower, 1.0)
    near = np.minimum(moves.dus - q.lower, q.upper - moves.dus) / np.maximum(width, 1e-300)
    scale = np.max(np.abs(moves.bounds), initial=0.0)
    return np.asarray((near < 1e-6) & (np.abs(moves.bounds) > 1e-9 * max(scale, 1e-300)))

"""One step of sequential quadratic programming on a stretch of a problem: linearize, solve, take what the merit allows.

The merit is an exact one: the cost, the prices of what is beyond limits, and of the gaps between the steps. Gauss and
Newton's curvature alone is used, that of the dynamics is left out. Diehl, Bock and Schloeder, "A real-time iteration
scheme for nonlinear optimization in optimal feedback control", 2005.

Where shapes touch, a state beside the motion is in another contact: so each step is rolled out on the plant, under
the feedback of the quadratic program, and there are no gaps. Tassa, Erez and Todorov, "Synthesis and stabilization of
complex behaviors through online trajectory optimization", 2012.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal
from drake_diff.derivatives.step import linearize
from drake_diff.exceptions import SimulationError
from drake_diff.model.model import Model
from drake_diff.model.step import advance, set_state
from drake_diff.optimize.ilqr.expansion import Motion, off_bounds
from drake_diff.optimize.ilqr.riccati import (
    AffinePolicy,
    LinearQuadratic,
    follow,
    least_regularized,
    slope_along,
    solve_riccati,
)
from drake_diff.optimize.knots import Costs
from drake_diff.optimize.problem.constraint import Bounds
from drake_diff.optimize.problem.cost import CostToGo
from drake_diff.optimize.realtime.qp import Limited, Moves, RowLimits, SoftProgram


@dataclass(frozen=True)
class StepOptions:
    """What tunes a step."""

    step_sizes: tuple[float, ...] = (1.0, 0.5, 0.25, 0.125, 1 / 16, 1 / 32)
    rolled_sizes: tuple[float, ...] = (1.0, 0.4, 0.1)  # each costs a rollout
    sufficient_decrease: float = 1e-4
    gap_price: float = 2.0  # over the largest multiplier of the dynamics
    rounding: float = 1e-12  # of the merit: a change below this is lost in the sum
    solved_to: float = 1e-9  # the same of a quadratic program with limits that push
    # Of the plant's motion in a step: a larger error is measured again over a part of the step, where it has to shrink.
    suspect: float = 0.1
    short_part: float = 1e-2
    still: float = 0.5
    unseen: float = 1e-5  # of a state: Drake solves contact to 1e-6
    # Of a multiplier over its price: a row between the two holds the motion, others do not or give way.
    holds: float = 1e-6
    gives: float = 1 - 1e-6
    slight: float = 1e-6  # of a row's range: what a limit that gives way is passed by at least
    dear: float = 10.0  # prices over what a unit is worth
    no_slope: float = 1e-12  # slopes whose squares are taken for none
    narrow: float = 0.1  # of the range of a row: limits on both sides that are nearer to each other are met, not kept
    stiff: float = 1e4  # over a row's price, per its scale: the curvature of a row that holds, for gains and values
    # A price above a limit's multiplier keeps it wherever it can be kept. Where an end is stayed at, prices are this
    # many costs of the plan for a whole range of what is limited: ten times what staying costs that is off by as much.
    # Elsewhere they are `dear` times what the cost-to-go says that a unit is worth.
    dear_beside_staying: float = 1e5
    half: float = 0.5  # of a goal's tolerance
    perturbed: int = 8  # motions at which slopes are looked at,
    spread: float = 0.3  # in ranges of the states beside the plan


OPTIONS = StepOptions()


@dataclass(frozen=True, eq=False)
class Stretch:
    """What is minimized over some steps: costs, and limits, whose prices are paid where they are passed."""

    model: Model
    bounds: Bounds
    costs: Costs
    limits: Sequence[RowLimits]
    program: SoftProgram
    rolls: bool = False  # whether each motion is rolled out on the plant, see `along`

    def along(self, xs: Array) -> "Stretch":
        """The same for motions near xs (N+1, nx): rolled out where shapes touch in one of its states."""
        twin = self.model.double
        if not self.model.contract.contact.collision_pairs:
            return self
        for x in xs:
            set_state(twin, x)
            if twin.overlaps():
                return replace(self, rolls=True)
        return self

    def cost(self, xs: Array, us: Array) -> float:
        """That of a motion xs (N+1, nx), us (N, nu)."""
        return float(np.sum(self.costs.values(xs, us)))

    def paid(self, motion: Motion, rows: Sequence[RowLimits | Limited]) -> float:
        """The cost of a motion, and what it pays for what is beyond limits at the prices of `rows`."""
        with np.errstate(all="ignore"):
            beyond = (limit.beyond(*motion.point) for limit in self.limits)
            prices = (float(np.sum(row.prices * far)) for row, far in zip(rows, beyond, strict=True))
            return self.cost(*motion.point) + sum(prices)

    def ends(self, xs: Array, us: Array) -> Array:
        """(N, nx) where the plant's steps from xs (N, nx) under us (N, nu) lead."""
        return np.array([advance(self.model.double, x, u) for x, u in zip(xs, us, strict=True)])

    def motion(self, xs: Array, us: Array) -> Motion:
        """xs (N+1, nx) under us (N, nu), with the gaps that the plant leaves."""
        return Motion.with_ends(xs, us, self.ends(xs[:-1], us))


@dataclass(frozen=True, eq=False)
class Expansion:
    """A stretch to second order around a motion."""

    quadratic: LinearQuadratic
    limited: tuple[Limited, ...]


@dataclass(frozen=True, eq=False)
class RealtimeStep:
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
    swept: Array | None = None  # (N, nu, nx) the gains of the sweep that solved it, if one did
    is_doubtful: bool = False  # whether the derivatives seem not to be those of the plant's steps

    @cached_property
    def policy(self) -> AffinePolicy | None:
        """How the solution changes with its first state, and what remains to be paid; None where neither is known.

        Rows and bounds that hold the solution go on to hold it, and those that give way give way.
        """
        return least_regularized(_held(self.expansion, self.moves, one_sided=True))

    @cached_property
    def feedback(self) -> Array:
        """(N, nu, nx) the gains by which it is rolled out; 0 where there are none."""
        if self.swept is not None:
            return self.swept
        none = np.zeros((*self.motion.us.shape, self.motion.xs.shape[1]))
        return none if self.policy is None else self.policy.feedback

    @cached_property
    def tails(self) -> tuple[CostToGo, ...] | None:
        """What remains to be paid from each knot on, for motions that may also leave the limits to the inside."""
        policy = least_regularized(_held(self.expansion, self.moves, one_sided=False))
        if policy is None:
            return None
        parts = zip(self.motion.xs, policy.value_gradients, policy.value_hessians, strict=True)
        return tuple(CostToGo(*row) for row in parts)

    @property
    def is_reached(self) -> bool:
        """Whether a further step promises no more than what the program is solved to."""
        return self.promised <= (OPTIONS.rounding if self.whole else OPTIONS.solved_to) * (1 + abs(self.merit))

    @property
    def given_way(self) -> tuple[str, float, int] | None:
        """(label, how far, knot) of the limit that the solution passes at the highest price, if it passes one."""
        worst, passed = 0.0, None
        for rows, slack, force in zip(self.expansion.limited, self.moves.slacks, self.moves.multipliers, strict=True):
            limits = rows.limits
            gives = (np.abs(force) >= OPTIONS.gives * rows.prices) & (slack > OPTIONS.slight * limits.ranges)
            paid = np.where(gives, slack * rows.prices, 0.0)
            if np.max(paid, initial=0.0) > worst:
                k, i = np.unravel_index(int(np.argmax(paid)), paid.shape)
                worst, passed = float(paid[k, i]), (limits.labels[i], float(slack[k, i]), int(k) + limits.first)
        return passed


def take_step(stretch: Stretch, motion: Motion, damping: Array | None = None) -> RealtimeStep | Refusal:
    """One step from `motion`, whose first state is given; a Refusal where the quadratic program is not solved.

    `damping` (nx + nu,) is added to the curvature of each knot, for shorter steps (Levenberg and Marquardt).

    Raises GradientError or SimulationError where a derivative is refused.
    """
    expansion = expand(stretch, motion)
    if damping is not None:
        quadratic, added = expansion.quadratic, np.tile(np.diag(damping), (len(motion.xs), 1, 1))
        added[-1, :, len(motion.xs[0]) :] = 0.0
        expansion = replace(expansion, quadratic=replace(quadratic, hessians=quadratic.hessians + added))
    solved = _solve(stretch, expansion)
    if isinstance(solved, Refusal):
        return solved
    expansion, moves, whole, feedback = solved
    gap_prices = OPTIONS.gap_price * np.max(np.abs(moves.dynamics), axis=0)
    before = merit(stretch, expansion, motion, gap_prices)
    slope, curvature = slope_along(expansion.quadratic, moves.dxs, moves.dus)
    slope -= float(np.sum(gap_prices * np.abs(motion.gaps)))
    for rows, slack in zip(expansion.limited, moves.slacks, strict=True):
        slope -= float(np.sum(rows.prices * (rows.beyond - slack)))
    promised = -(slope + curvature / 2)
    rounding = OPTIONS.rounding * (1 + abs(before))
    step = RealtimeStep(stretch, motion, 0.0, promised, before, expansion, moves, whole, feedback)
    if stretch.rolls and not motion.is_rollout:
        return _first_rollout(step)
    for size in OPTIONS.rolled_sizes if stretch.rolls else OPTIONS.step_sizes:
        try:
            tried = _moved(step, size)
            after = merit(stretch, expansion, tried, gap_prices)
        except SimulationError:
            continue
        if after <= before + OPTIONS.sufficient_decrease * size * min(slope, 0.0) + rounding:
            step = replace(step, motion=tried, size=size, merit=after)
            return replace(step, is_doubtful=not stretch.rolls and _is_doubtful(step, motion))
    return step


def _is_doubtful(step: RealtimeStep, before: Motion) -> bool:
    """Whether the plant departs from its derivatives by an error that does not shrink with the step."""
    dxs, dus = step.motion.xs - before.xs, step.motion.us - before.us
    linear = np.einsum("kij,kj->ki", step.expansion.quadratic.F, np.hstack([dxs[:-1], dus]))
    change = float(np.max(np.abs(linear - dxs[:-1])))  # beside the motion of a state without inputs

    def error(motion: Motion, fraction: float) -> float:
        return float(np.max(np.abs(motion.ends - before.ends - fraction * linear)))

    large = error(step.motion, 1.0)
    if large <= max(OPTIONS.suspect * change, OPTIONS.unseen * (1 + float(np.max(np.abs(before.ends))))):
        return False
    short = step.stretch.motion(before.xs + OPTIONS.short_part * dxs, before.us + OPTIONS.short_part * dus)
    return error(short, OPTIONS.short_part) > OPTIONS.still * OPTIONS.short_part * large


def merit(stretch: Stretch, expansion: Expansion, motion: Motion, gap_prices: Array) -> float:
    """What a motion costs, with the prices of what is beyond limits and of gaps, `gap_prices` (nx,)."""
    return stretch.paid(motion, expansion.limited) + float(np.sum(gap_prices * np.abs(motion.gaps)))


def _moved(step: RealtimeStep, size: float) -> Motion:
    """A part of the step from its motion: rolled out where shapes touch."""
    motion, stretch = step.motion, step.stretch
    xs, us = motion.xs + size * step.moves.dxs, motion.us + size * step.moves.dus
    if stretch.rolls:
        return roll(stretch, motion.xs[0], xs, us, step.feedback)
    return stretch.motion(xs, np.clip(us, stretch.bounds.u_lower, stretch.bounds.u_upper))


def roll(stretch: Stretch, x: Array, xs: Array, us: Array, feedback: Array) -> Motion:
    """The plant's motion from x (nx,) under the `feedback` (N, nu, nx) about xs (N+1, nx) and us (N, nu)."""
    bounds, twin = stretch.bounds, stretch.model.double
    states, inputs = np.empty_like(xs), np.empty_like(us)
    states[0] = x
    for k, u in enumerate(us):
        inputs[k] = np.clip(u + feedback[k].dot(states[k] - xs[k]), bounds.u_lower, bounds.u_upper)
        states[k + 1] = advance(twin, states[k], inputs[k])
    return Motion(states, inputs, np.zeros_like(states[1:]))


def _first_rollout(step: RealtimeStep) -> RealtimeStep:
    """From a motion with gaps: the plant's own, the whole step or none of it, whichever costs less."""
    best = None
    for size in (1.0, 0.0):
        try:
            tried = _moved(step, size)
        except SimulationError:
            continue
        after = merit(step.stretch, step.expansion, tried, np.zeros(len(tried.xs[0])))
        if np.isfinite(after) and (best is None or after < best[1]):
            best = tried, after
    if best is None:
        return step
    return replace(step, motion=best[0], size=1.0, merit=best[1])


def _solve(stretch: Stretch, expansion: Expansion) -> tuple[Expansion, Moves, bool, Array | None] | Refusal:
    """The program with prices that are dear enough, its solution, whether no limit pushes, and gains (N, nu, nx).

    Where motions are rolled out and bounds of inputs alone push it is by Riccati's sweep, which has gains.
    """
    quadratic = expansion.quadratic
    nothing = tuple(np.zeros_like(rows.lower) for rows in expansion.limited)
    free = _swept(quadratic.unbounded())
    if free is not None:
        within = np.all((quadratic.lower <= free[0].dus) & (free[0].dus <= quadratic.upper))
        swept = free if within else _swept(quadratic) if stretch.rolls else None
        if swept is not None and _is_kept(expansion, swept[0]):
            moves = replace(swept[0], slacks=nothing, multipliers=nothing)
            return expansion, moves, bool(within), swept[1].feedback
        expansion = replace(expansion, limited=_dear_enough(expansion.limited, free[0].dynamics))
    priced = stretch.program.solve(quadratic, expansion.limited)
    return priced if isinstance(priced, Refusal) else (expansion, priced, False, None)


def expand(stretch: Stretch, motion: Motion) -> Expansion:
    """The quadratic program around `motion`. Raises GradientError or SimulationError."""
    xs, us, bounds = motion.xs, motion.us, stretch.bounds
    A, B, _ = linearize(stretch.model, xs, off_bounds(bounds, us), x_next=motion.ends)
    gradients, hessians = stretch.costs.expand(xs, us)
    given = np.zeros(len(xs[0]))
    quadratic = LinearQuadratic(
        F=np.concatenate([A, B], axis=2),
        gaps=motion.gaps,
        gradients=gradients,
        hessians=hessians,
        lower=bounds.u_lower - us,
        upper=bounds.u_upper - us,
        start_lower=given,
        start_upper=given,
    )
    return Expansion(quadratic, tuple(limit.linearize(xs, us) for limit in stretch.limits))


def _swept(quadratic: LinearQuadratic) -> tuple[Moves, AffinePolicy] | None:
    """The solution by Riccati's sweep, its inputs within their bounds; None where the cost has no minimum."""
    policy = solve_riccati(quadratic, 0.0)
    if policy is None:
        return None
    dxs, dus = follow(quadratic, policy, clipped=True)
    dynamics = policy.value_gradients[1:] + np.einsum("kij,kj->ki", policy.value_hessians[1:], dxs[1:])
    moved = np.hstack([dxs[:-1], dus])
    by_input = quadratic.gradients[:-1] + np.einsum("kij,kj->ki", quadratic.hessians[:-1], moved)
    by_input += np.einsum("kij,ki->kj", quadratic.F, dynamics)
    bounds = -by_input[:, quadratic.num_states :]
    return Moves(dxs, dus, (), (), bounds, dynamics), policy


def _is_kept(expansion: Expansion, moves: Moves) -> bool:
    """Whether moves leave no limit of states."""
    for rows in expansion.limited:
        moved = np.einsum("kri,ki->kr", rows.jacobians, rows.limits.select(moves.dxs, moves.dus))
        if np.any(moved < rows.lower) or np.any(moved > rows.upper):
            return False
    return True


def _dear_enough(limited: Sequence[Limited], forces: Array) -> tuple[Limited, ...]:
    """The same at prices that stand above what the motion without limits is worth, all raised alike.

    `forces` (N, nx) are its multipliers: far from the plan they are larger than the plan's own.
    """
    worth, factor = np.max(np.abs(forces), axis=0), 1.0
    for rows in limited:
        slopes = np.abs(rows.jacobians[:, :, : len(worth)])
        squared = np.sum(slopes**2, axis=2)
        seen = squared > OPTIONS.no_slope
        wanted = OPTIONS.dear * (slopes @ worth) / np.where(seen, squared, 1.0)
        factor = max(factor, float(np.max(np.where(seen, wanted / rows.prices, 0.0), initial=0.0)))
    return tuple(replace(rows, prices=factor * rows.prices) for rows in limited)


def _held(expansion: Expansion, moves: Moves, *, one_sided: bool) -> LinearQuadratic:
    """The program around its own solution, with what holds it as curvature, and held inputs at rest.

    Where not `one_sided`, that is of rows alone that are to be met from both sides, and as stiff as they are dear.
    """
    q = expansion.quadratic
    nx, d = q.num_states, np.hstack([moves.dxs, np.vstack([moves.dus, np.zeros((1, moves.dus.shape[1]))])])
    gradients, hessians = q.gradients + np.einsum("kij,kj->ki", q.hessians, d), np.array(q.hessians)
    for rows, forces in zip(expansion.limited, moves.multipliers, strict=True):
        limits, ratios = rows.limits, np.abs(forces) / rows.prices
        if one_sided:
            stiff = np.where((ratios > OPTIONS.holds) & (ratios < OPTIONS.gives), OPTIONS.stiff * rows.prices, 0.0)
        else:
            met = limits.upper - limits.lower < OPTIONS.narrow * limits.ranges
            stiff = np.where(met, rows.prices / limits.ranges, 0.0)
        gradients[limits.knots] += np.einsum("kr,kri->ki", forces, rows.jacobians)
        hessians[limits.knots] += np.einsum("kri,kr,krj->kij", rows.jacobians, stiff, rows.jacobians)
    F = np.array(q.F)
    for k, i in np.argwhere(_on_bound(q, moves)):
        F[k, :, nx + i] = 0.0
        hessians[k, nx + i, :] = hessians[k, :, nx + i] = 0.0
        hessians[k, nx + i, nx + i], gradients[k, nx + i] = 1.0, 0.0
    return replace(q, F=F, gaps=np.zeros_like(q.gaps), gradients=gradients, hessians=hessians).unbounded()


def _on_bound(q: LinearQuadratic, moves: Moves) -> Array:
    """(N, nu) which inputs a bound holds: those nearer to it than its multiplier is to 0, both in their own scale."""
    width = np.where(np.isfinite(q.upper - q.lower), q.upper - q.lower, 1.0)
    near = np.minimum(moves.dus - q.lower, q.upper - moves.dus) / np.maximum(width, 1e-300)
    scale = np.max(np.abs(moves.bounds), initial=0.0)
    return np.asarray((near < 1e-6) & (np.abs(moves.bounds) > 1e-9 * max(scale, 1e-300)))

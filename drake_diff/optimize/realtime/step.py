"""One step of sequential quadratic programming on a stretch of a problem: linearize, solve, and search along the step.

The merit function is exact. It is the cost plus the prices of violated limits and of gaps between the steps. The
curvature is that of Gauss-Newton, without the curvature of the dynamics. See Diehl, Bock and Schloeder, "A real-time
iteration scheme for nonlinear optimization in optimal feedback control", 2005.

Where shapes touch, a state near the motion may have other contacts. Each step is then rolled out on the plant under the
feedback of the quadratic program, and there are no gaps. See Tassa, Erez and Todorov, "Synthesis and stabilization of
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
    """Tuning parameters of a step."""

    step_sizes: tuple[float, ...] = (1.0, 0.5, 0.25, 0.125, 1 / 16, 1 / 32)
    rolled_sizes: tuple[float, ...] = (1.0, 0.4, 0.1)  # each costs a rollout
    sufficient_decrease: float = 1e-4
    gap_price: float = 2.0  # relative to the largest multiplier of the dynamics
    rounding: float = 1e-12  # of the merit: a smaller change is lost in rounding
    solved_to: float = 1e-9  # the same for a quadratic program with active limits
    # Relative to the plant's motion in a step. A larger error is measured again over a part of it and must shrink.
    suspect: float = 0.1
    short_part: float = 1e-2
    still: float = 0.5
    unseen: float = 1e-5  # relative to a state: Drake solves contact to 1e-6
    # Of a multiplier relative to its price. A row is inactive below `holds`, active, or violated above `gives`.
    holds: float = 1e-6
    gives: float = 1 - 1e-6
    slight: float = 1e-6  # of a row's range: the least violation of a limit that counts as violated
    dear: float = 10.0  # prices relative to the value of a unit
    no_slope: float = 1e-12  # squared slopes that count as zero
    narrow: float = 0.1  # of the range of a row: limits on both sides that are closer count as an equality
    stiff: float = 1e4  # relative to a row's price, per its scale: the curvature of an active row, for gains and values
    # A price above a limit's multiplier enforces the limit wherever possible. If the motion stays at its end, a
    # violation by the whole range of a row costs this many times the plan, ten times the cost of staying so far away.
    # Otherwise prices are `dear` times the value of a unit in the cost-to-go.
    dear_beside_staying: float = 1e5
    half: float = 0.5  # of a goal's tolerance
    perturbed: int = 8  # number of perturbed motions for slopes of rows
    spread: float = 0.3  # their deviation from the plan, in ranges of the states


OPTIONS = StepOptions()


@dataclass(frozen=True, eq=False)
class Stretch:
    """The minimization over some steps: costs, and limits with prices for violations."""

    model: Model
    bounds: Bounds
    costs: Costs
    limits: Sequence[RowLimits]
    program: SoftProgram
    rolls: bool = False  # whether each motion is rolled out on the plant, see `along`

    def along(self, xs: Array) -> "Stretch":
        """Return the stretch for motions near xs (N+1, nx), with rollouts if shapes touch in one of its states."""
        twin = self.model.double
        if not self.model.contract.contact.collision_pairs:
            return self
        for x in xs:
            set_state(twin, x)
            if twin.overlaps():
                return replace(self, rolls=True)
        return self

    def cost(self, xs: Array, us: Array) -> float:
        """Return the cost of a motion xs (N+1, nx), us (N, nu)."""
        return float(np.sum(self.costs.values(xs, us)))

    def paid(self, motion: Motion, rows: Sequence[RowLimits | Limited]) -> float:
        """Return the cost of a motion plus the cost of its limit violations at the prices of `rows`."""
        with np.errstate(all="ignore"):
            beyond = (limit.beyond(*motion.point) for limit in self.limits)
            prices = (float(np.sum(row.prices * far)) for row, far in zip(rows, beyond, strict=True))
            return self.cost(*motion.point) + sum(prices)

    def ends(self, xs: Array, us: Array) -> Array:
        """Return the ends (N, nx) of the plant's steps from xs (N, nx) under us (N, nu)."""
        return np.array([advance(self.model.double, x, u) for x, u in zip(xs, us, strict=True)])

    def motion(self, xs: Array, us: Array) -> Motion:
        """Return the motion xs (N+1, nx) under us (N, nu), with the gaps of the plant's steps."""
        return Motion.with_ends(xs, us, self.ends(xs[:-1], us))


@dataclass(frozen=True, eq=False)
class Expansion:
    """The second-order expansion of a stretch around a motion."""

    quadratic: LinearQuadratic
    limited: tuple[Limited, ...]


@dataclass(frozen=True, eq=False)
class RealtimeStep:
    """One step: its resulting motion and its size.

    `size` is 0 if no step was taken. `promised` is the predicted decrease of the merit by a full step. The slacks in
    `moves` are the violations of the limits that the quadratic program requires.
    """

    stretch: Stretch
    motion: Motion
    size: float
    promised: float
    merit: float
    expansion: Expansion
    moves: Moves
    whole: bool  # whether no limit was active
    swept: Array | None = None  # gains (N, nu, nx) of the Riccati sweep, if it solved the step
    is_doubtful: bool = False  # whether the derivatives seem to differ from those of the plant's steps

    @cached_property
    def policy(self) -> AffinePolicy | None:
        """The solution's feedback on its first state and the cost-to-go, or None if neither is known.

        Active rows and bounds stay active, and violated rows stay violated.
        """
        return least_regularized(_held(self.expansion, self.moves, one_sided=True))

    @cached_property
    def feedback(self) -> Array:
        """The feedback gains (N, nu, nx) of rollouts, or 0 if there are none."""
        if self.swept is not None:
            return self.swept
        none = np.zeros((*self.motion.us.shape, self.motion.xs.shape[1]))
        return none if self.policy is None else self.policy.feedback

    @cached_property
    def tails(self) -> tuple[CostToGo, ...] | None:
        """The cost-to-go from each knot, for motions that may also leave active limits to the inside."""
        policy = least_regularized(_held(self.expansion, self.moves, one_sided=False))
        if policy is None:
            return None
        parts = zip(self.motion.xs, policy.value_gradients, policy.value_hessians, strict=True)
        return tuple(CostToGo(*row) for row in parts)

    @property
    def is_reached(self) -> bool:
        """Whether the predicted decrease of a further step is within the accuracy of the program."""
        return self.promised <= (OPTIONS.rounding if self.whole else OPTIONS.solved_to) * (1 + abs(self.merit))

    @property
    def given_way(self) -> tuple[str, float, int] | None:
        """The (label, violation, knot) of the limit that is violated at the highest price, or None."""
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
    """Take one step from `motion` with a given first state. Return a Refusal if the quadratic program is not solved.

    `damping` (nx + nu,) is added to the curvature of each knot, for shorter steps (Levenberg-Marquardt).

    Raises GradientError or SimulationError if a derivative is refused.
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
    """Return whether the plant deviates from its derivatives by an error that does not shrink with the step."""
    dxs, dus = step.motion.xs - before.xs, step.motion.us - before.us
    linear = np.einsum("kij,kj->ki", step.expansion.quadratic.F, np.hstack([dxs[:-1], dus]))
    change = float(np.max(np.abs(linear - dxs[:-1])))  # change of the end minus that of the start

    def error(motion: Motion, fraction: float) -> float:
        return float(np.max(np.abs(motion.ends - before.ends - fraction * linear)))

    large = error(step.motion, 1.0)
    if large <= max(OPTIONS.suspect * change, OPTIONS.unseen * (1 + float(np.max(np.abs(before.ends))))):
        return False
    short = step.stretch.motion(before.xs + OPTIONS.short_part * dxs, before.us + OPTIONS.short_part * dus)
    return error(short, OPTIONS.short_part) > OPTIONS.still * OPTIONS.short_part * large


def merit(stretch: Stretch, expansion: Expansion, motion: Motion, gap_prices: Array) -> float:
    """Return a motion's cost plus the prices of limit violations and of gaps, `gap_prices` (nx,)."""
    return stretch.paid(motion, expansion.limited) + float(np.sum(gap_prices * np.abs(motion.gaps)))


def _moved(step: RealtimeStep, size: float) -> Motion:
    """Return the motion after a part of the step, rolled out where shapes touch."""
    motion, stretch = step.motion, step.stretch
    xs, us = motion.xs + size * step.moves.dxs, motion.us + size * step.moves.dus
    if stretch.rolls:
        return roll(stretch, motion.xs[0], xs, us, step.feedback)
    return stretch.motion(xs, np.clip(us, stretch.bounds.u_lower, stretch.bounds.u_upper))


def roll(stretch: Stretch, x: Array, xs: Array, us: Array, feedback: Array) -> Motion:
    """Return the plant's motion from x (nx,) under `feedback` (N, nu, nx) around xs (N+1, nx) and us (N, nu)."""
    bounds, twin = stretch.bounds, stretch.model.double
    states, inputs = np.empty_like(xs), np.empty_like(us)
    states[0] = x
    for k, u in enumerate(us):
        inputs[k] = np.clip(u + feedback[k].dot(states[k] - xs[k]), bounds.u_lower, bounds.u_upper)
        states[k + 1] = advance(twin, states[k], inputs[k])
    return Motion(states, inputs, np.zeros_like(states[1:]))


def _first_rollout(step: RealtimeStep) -> RealtimeStep:
    """Replace a motion with gaps by a rollout of the plant, with the full step or no step, whichever costs less."""
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
    """Return the program with high enough prices, its solution, whether no limit is active, and gains (N, nu, nx).

    If motions are rolled out and only bounds of inputs are active, the Riccati sweep solves it and has gains.
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
    """Return the quadratic program around `motion`. Raises GradientError or SimulationError."""
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
    """Solve by the Riccati sweep with inputs within bounds. Return None if the cost has no minimum."""
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
    """Return whether the moves satisfy all limits of states."""
    for rows in expansion.limited:
        moved = np.einsum("kri,ki->kr", rows.jacobians, rows.limits.select(moves.dxs, moves.dus))
        if np.any(moved < rows.lower) or np.any(moved > rows.upper):
            return False
    return True


def _dear_enough(limited: Sequence[Limited], forces: Array) -> tuple[Limited, ...]:
    """Raise all prices by one factor, above the value of a unit for the motion without limits.

    `forces` (N, nx) are this motion's multipliers, which far from the plan are larger than the plan's own.
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
    """Return the program around its own solution, with active rows as curvature and active inputs fixed.

    If not `one_sided`, only rows with an equality contribute, with a curvature proportional to their price.
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
    """Return a mask (N, nu) of inputs on a bound: those near it with a multiplier, each relative to its own scale."""
    width = np.where(np.isfinite(q.upper - q.lower), q.upper - q.lower, 1.0)
    near = np.minimum(moves.dus - q.lower, q.upper - moves.dus) / np.maximum(width, 1e-300)
    scale = np.max(np.abs(moves.bounds), initial=0.0)
    return np.asarray((near < 1e-6) & (np.abs(moves.bounds) > 1e-9 * max(scale, 1e-300)))

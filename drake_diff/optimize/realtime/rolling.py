"""Stretches of a problem, which start at any of its steps and may extend beyond its end."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import InputError
from drake_diff.optimize.ilqr.riccati import least_regularized
from drake_diff.optimize.knots import Costs, Selected, Stage, knot_cost, knot_function
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.cost import CostToGo, QuadraticCost
from drake_diff.optimize.problem.goals import LAST, GoalConstraint
from drake_diff.optimize.problem.obstacles import ClearanceConstraint
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.realtime.qp import RowLimits, SoftProgram
from drake_diff.optimize.realtime.step import OPTIONS, Stretch, expand


@dataclass(frozen=True, eq=False)
class Staying:
    """Staying at `point`, a state (nx,) and its input (nu,). `final` is the cost-to-go of staying from near states."""

    point: tuple[Array, Array]
    running: QuadraticCost
    final: QuadraticCost
    unit: float  # the cost of the plan


class Rolling:
    """Stretches of `problem` around a plan xs (N+1, nx), us (N, nu). With `staying`, motions stay at its end.

    Without `staying`, a stretch ends at the problem's end, and later stretches use the problem's own costs again.
    """

    def __init__(self, problem: Problem, staying: Staying | None, xs: Array, us: Array):
        self.problem, self.staying = problem, staying
        self.nx, self.nu = problem.nx, problem.nu
        middle = len(us) // 2
        probe = np.array([np.concatenate([xs[k], us[k]]) for k in (0, middle, len(us) - 1)])
        states = probe[:, : self.nx]
        running, final = problem.total_running_cost, problem.total_final_cost
        self._running = knot_cost(running, self.nx, self.nu, probe, gauss_newton=True)
        self._final = knot_cost(final, self.nx, 0, states, gauss_newton=True)
        if staying is not None:
            self._stay = knot_cost(staying.running, self.nx, self.nu, probe)
            self._stayed = knot_cost(staying.final, self.nx, 0, states)
        self.tails: tuple[CostToGo, ...] = ()  # cost-to-go at the states of a plan of the whole problem
        self._programs: dict[int, SoftProgram] = {}
        self.limits = tuple(self._limits(probe))
        self._set_prices(xs, us)

    def stretch(self, begin: int, count: int) -> Stretch:
        """Return the stretch over the steps `begin` ... `begin` + `count`."""
        limits = tuple(self._select(every, begin, count) for every in self.limits)
        if count not in self._programs:
            self._programs[count] = SoftProgram(self.nx, self.nu, count, limits)
        costs = Costs(tuple(self._stages(begin, count)))
        return Stretch(self.problem.model, self.problem.bounds, costs, limits, self._programs[count])

    def count(self, begin: int, horizon: int) -> int:
        """Return the largest number of steps to plan from step `begin` on."""
        left = self.problem.num_steps - begin
        return min(horizon, left) if self.staying is None and left > 0 else horizon

    def _stages(self, begin: int, count: int) -> Iterator[Stage]:
        h, end, last = self.problem.model.time_step, begin + count, self.problem.num_steps
        times: Array = h * np.arange(begin, end + 1, dtype=float)
        planned = count if self.staying is None else int(np.clip(last - begin, 0, count))
        yield Stage(self._running, slice(0, planned), times[:planned], h)
        if planned < count:
            yield Stage(self._stay, slice(planned, count), times[planned:count], h)
        final = self._final if self.staying is None else self._stayed
        if end < last:
            final = knot_cost(self.tails[end], self.nx, 0, np.empty((0, self.nx)))
        elif self.staying is not None and begin < last:
            yield Stage(self._final, slice(last - begin, last - begin + 1), times[last - begin :][:1], 1.0, final=True)
        yield Stage(final, slice(count, count + 1), times[count:], 1.0, final=True)

    def _limits(self, probe: Array) -> Iterator[RowLimits]:
        """Yield limits, without prices, at the knots 0 ... N of the problem and, in a last row, at all later knots."""
        problem, b, rows = self.problem, self.problem.bounds, (self.problem.num_steps + 2, 1)
        lower, upper = np.tile(b.x_lower, rows), np.tile(b.x_upper, rows)
        for k, wanted in problem.waypoints.items():
            given = ~np.isnan(wanted)
            lower[k, given] = upper[k, given] = wanted[given]
        which = np.flatnonzero(np.any(np.isfinite(lower) | np.isfinite(upper), axis=0))
        if len(which):
            labels, states = tuple(problem.state_names[i] for i in which), Selected(which, self.nx + self.nu)
            yield RowLimits.unpriced(labels, states, 1, lower[:, which], upper[:, which])
        for c in (*problem.constraints, *problem.kept_goals):
            if self.staying is not None and isinstance(c, GoalConstraint) and c.knots == LAST:
                continue  # the plan satisfies it, and motions stay at its end
            lower, upper = (np.tile(side, rows) for side in _wide(c))
            if c.knots is not None:
                away = np.setdiff1d(np.arange(rows[0]), problem.knots_of(c, input_at_end=False))
                lower[away], upper[away] = -np.inf, np.inf
            function = knot_function(c, self.nx, self.nu, probe)
            yield RowLimits.unpriced(_labels(c), function, 0 if c.takes_input else 1, lower, upper)

    def _select(self, limits: RowLimits, begin: int, count: int) -> RowLimits:
        """Return the limits for the steps `begin` ... `begin` + `count`."""
        knots = np.minimum(begin + limits.first + np.arange(count), len(limits.lower) - 1)
        return replace(limits, lower=limits.lower[knots], upper=limits.upper[knots])

    def _set_prices(self, xs: Array, us: Array) -> None:
        """Set prices from the value of a unit of each state and input along the plan, and from the rows' slopes."""
        problem, b = self.problem, self.problem.bounds
        whole = replace(self.stretch(0, problem.num_steps), limits=())
        quadratic = expand(whole, whole.motion(xs, us)).quadratic
        policy = least_regularized(quadratic.unbounded())
        if policy is None:
            raise InputError(
                "running_cost", got="no positive curvature in the inputs", expected="a cost with a minimum"
            )
        ranges = problem.state_scales(xs)
        for side in (b.x_lower, b.x_upper):
            apart = np.max(np.abs(xs - side), axis=0)
            ranges = np.where(np.isfinite(apart), np.maximum(ranges, apart), ranges)
        wide = b.u_upper - b.u_lower
        efforts = np.where(np.isfinite(wide), wide, 1.0 + np.ptp(us, axis=0))
        P = np.max(np.diagonal(policy.value_hessians, axis1=1, axis2=2), axis=0)
        worth = np.max(np.abs(policy.value_gradients), axis=0) + P * ranges
        B = quadratic.F[:, :, self.nx :]
        curved = np.einsum("kij,kil,klj->kj", B, policy.value_hessians[1:], B)
        curved = curved + np.diagonal(quadratic.hessians[:-1], axis1=1, axis2=2)[:, self.nx :]
        worth = np.concatenate([worth, np.max(curved, axis=0) * efforts])
        spans, random = np.concatenate([ranges, efforts]), np.random.default_rng(0)
        knots = np.hstack([xs[:-1], us])
        near = [knots + OPTIONS.spread * spans * random.standard_normal(knots.shape) for _ in range(OPTIONS.perturbed)]
        looked = np.concatenate([knots, *near])
        unit = None if self.staying is None else self.staying.unit
        self.limits = tuple(_priced(limits, looked, worth, spans, unit) for limits in self.limits)


def _priced(limits: RowLimits, knots: Array, worth: Array, spans: Array, unit: float | None) -> RowLimits:
    with np.errstate(all="ignore"):
        slopes = np.abs(limits.function.linearize(knots)[1])
    slopes = slopes[np.all(np.isfinite(slopes), axis=(1, 2))]
    steepest = np.max(slopes, axis=0, initial=0.0)  # (m, n)
    squared = np.sum(steepest**2, axis=1)
    flat = squared <= OPTIONS.no_slope
    ranges = np.where(flat, 1.0, steepest @ spans)
    if unit is not None:
        return replace(limits, prices=OPTIONS.dear_beside_staying * unit / ranges, ranges=ranges)
    prices = np.where(flat, np.sum(worth), steepest @ worth / np.where(flat, 1.0, squared))
    return replace(limits, prices=OPTIONS.dear * prices, ranges=ranges)


def _wide(c: Constraint) -> tuple[Array, Array]:
    """Return the limits of `c`. For a goal with limits on both sides, widen them to half of its tolerance.

    A plan uses less than half. The part that a disturbance uses need not be recovered at a high price.
    """
    if not isinstance(c, GoalConstraint):
        return c.lower, c.upper
    met, middle = ~np.isnan(c.wanted), np.nan_to_num(c.wanted)
    half = OPTIONS.half * c.tolerance / max(int(np.count_nonzero(met)), 1) ** (1 / c.norm)
    lower = np.where(met, np.minimum(c.lower, middle - half), c.lower)
    return lower, np.where(met, np.maximum(c.upper, middle + half), c.upper)


def _labels(c: Constraint) -> tuple[str, ...]:
    if isinstance(c, ClearanceConstraint):
        return tuple(f"{c.label} ({row})" for row in c.clearance.labels)
    return (c.label,) * len(c.lower)

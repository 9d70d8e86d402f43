"""Violations of bounds and constraints by a collocated motion between the nodes at which the solver enforces them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.exceptions import GradientError
from drake_diff.optimize.checks import Check, check
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.dynamics import PROBED
from drake_diff.optimize.problem.goals import GoalConstraint
from drake_diff.optimize.problem.obstacles import ClearanceConstraint
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.transcription.collocation import Collocated
from drake_diff.optimize.transcription.lead import MOST_PLACES, SUBSTEPS, WIDTH
from drake_diff.optimize.transcription.task import constraint_form, values_of_many

DENSE = np.linspace(0, 1, 41)[1:-1]  # places between two knots at which the input is checked
# Relative to a number's range along the motion: allowed excess over its bound between nodes. The solver keeps the
# scheme's polynomials within bounds. The dynamics' states differ from these by the integration error.
EXCESS_TOLERANCE = 1e-3
# Relative to a jerk limit. The slopes of a scheme's polynomials have an error that is one order of an interval's length
# larger than the error of the polynomials.
JERK_TOLERANCE = 1e-2
DEPTH_TOLERANCE = 1e-3  # of the ranges of states and inputs: allowed distance to where a constraint is satisfied
SOLVED = 1e-8  # of a constraint's scale or bound: the residual that a solver may leave
CLOSER, CLOSER_ROUNDS = 9, 2  # places around a constraint's closest approach to its bound, and repetitions
KINDS = ("state", "input", "constraint")


@dataclass(frozen=True)
class Excess:
    """The largest excess over a bound of a state, an input and a constraint between the nodes.

    The tolerance of each is 1e-3 of its range along the motion, or 1e-5 of its scale if that is larger. A violated
    constraint must also be satisfied within 1e-3 of the ranges of states and inputs. `worst` is the largest ratio of an
    excess to its tolerance, and `where` its place. `checks` has an entry for each bound and constraint, and failures
    are in the `intervals`.
    """

    state: float
    input: float
    constraint: float
    worst: float
    where: str
    checks: tuple[Check, ...]
    intervals: tuple[int, ...]


def violation_between_nodes(motion: Collocated) -> Excess:
    """Return the violations of bounds and constraints by a collocated motion between the nodes.

    The states are those of an accurate integration from each knot under the input that the plant applies, clipped at
    its own limits. A cost below the optimum of the problem implies an excess.
    """
    task, b, count = motion.task, motion.task.bounds, len(motion.mesh) - 1
    if task.is_map:
        return Excess(0.0, 0.0, 0.0, 0.0, "nowhere", (), ())
    states, inputs = task.dynamics.state_names, task.dynamics.input_names
    ranges, (times, xs) = task.problem.state_scales(motion.xs), motion.between_knots
    spans = np.concatenate([ranges, task.problem.input_scales(motion.us)])
    groups = [_beyond("state", states, xs, b.x_lower, b.x_upper, _tolerance(ranges, ranges), times)]
    for c in task.problem.kept:
        if isinstance(c, ClearanceConstraint):
            groups.append([_too_near(motion, c)])
        elif isinstance(c, GoalConstraint) and c.dwells:
            groups.append([_of_stay(motion, c)])
        elif c.knots is None:
            groups.append(_of_constraint(motion, c, spans))
    for limit in task.problem.rate_limits:
        _, most = limit.entries(task.problem.system)
        rates, when = motion.rates_of(limit)
        extent = _extent(rates) if limit.of_inputs or not limit.of_slopes else JERK_TOLERANCE / EXCESS_TOLERANCE * most
        tolerance = _tolerance(extent, most)
        groups.append(_beyond("constraint", (limit.label,) * len(most), rates, -most, most, tolerance, when))
    k, tau = np.repeat(np.arange(count), len(DENSE)), np.tile(DENSE, count)
    us = motion.between(k, tau)[1]
    tolerance = _tolerance(_extent(us), spans[len(ranges) :])
    groups.append(_beyond("input", inputs, us, b.u_lower, b.u_upper, tolerance, motion.times(k, tau)))
    every = [excess for kind in groups for excess in kind]
    largest = {kind: max((e.excess for e in every if e.kind == kind), default=0.0) for kind in KINDS}
    worst = max(every, key=lambda e: e.part)
    where = worst.check.where if worst.excess > 0 else "nowhere"
    return Excess(
        **largest,
        worst=worst.part,
        where=where,
        checks=tuple(e.check for e in every),
        intervals=tuple(np.unique(motion.interval_at(np.concatenate([e.when for e in every]))).tolist()),
    )


def passed_between_steps(problem: Problem, times: Array, xs: Array, us: Array) -> Iterator[Check]:
    """Yield checks of whether steps xs (N+1, nx) under us (N, nu) pass through a constraint between two of them."""
    every = np.unique(
        np.concatenate([times, np.interp(np.arange(0, len(us), 1 / SUBSTEPS), np.arange(len(xs)), times)])
    )
    spans = problem.spans(xs, us)

    def motion_at(when: Array) -> tuple[Array, Array]:
        held = np.clip(np.searchsorted(times, when, side="right") - 1, 0, len(us) - 1)
        return np.array([np.interp(when, times, column) for column in xs.T]).T, us[held]

    moved = np.max(np.abs(np.diff(xs, axis=0)) / spans[: xs.shape[1]], axis=1)
    counts = np.ceil(np.clip(moved / WIDTH, 1, MOST_PLACES / len(us))).astype(np.intp)
    dense = np.interp(np.arange(np.sum(counts)), np.append(0, np.cumsum(counts)), times)
    for c in problem.constraints:
        if c.knots is None:
            seen = every
            if _is_users(c):
                seen = np.union1d(every, dense[_outside(c, *motion_at(dense))])
            moments, between, applied = _looked_at(c, seen, *motion_at(seen), motion_at)
            excess = _excess(_values(c, between, applied), c.lower, c.upper)
            through = np.any(_depth(c, between, applied, excess, spans, c.scales(xs, us, spans))[1], axis=1)
            first = int(np.argmax(through))
            passed = float(np.max(excess[first])) if through[first] else 0.0
            yield check("passage", f"{c.label} at {moments[first]:.4g} s", passed, 0.0)


@dataclass(frozen=True)
class _Beyond:
    """The largest excess of one number over its bounds, in one of the `KINDS`, and the times above its tolerance."""

    kind: str
    excess: float
    part: float  # ratio to its tolerance
    when: Array  # [s]
    check: Check


def _beyond(
    kind: str, names: Sequence[str], values: Array, lower: Array, upper: Array, tolerance: Array, times: Array
) -> list[_Beyond]:
    """Return one entry for each column of `values` (S, n)."""
    excess, excesses = _excess(values, lower, upper), list[_Beyond]()
    for i, k in enumerate(np.argmax(excess, axis=0).tolist()):
        far, limit = float(excess[k, i]), float(tolerance[i])
        row = _between("bound", f"{names[i]} at {times[k]:.4g} s", far, limit)
        excesses.append(_Beyond(kind, far, row.ratio, times[~(excess[:, i] <= limit)], row))
    return excesses


def _between(what: str, where: str, value: float, tolerance: float, unit: str = "1") -> Check:
    return replace(check(what, where, value, tolerance, unit), plant="between the nodes")


def _excess(values: Array, lower: Array, upper: Array) -> Array:
    """Return the excess of `values` (S, n) over their bounds, infinite for values that are not finite."""
    excess = np.maximum(np.maximum(lower - values, values - upper), 0.0)
    return np.where(np.isfinite(values), excess, np.inf)


def _extent(values: Array) -> Array:
    return np.ptp(values, axis=0)


def _tolerance(ranges: Array, scales: Array) -> Array:
    return np.maximum(EXCESS_TOLERANCE * ranges, FEASIBILITY_TOLERANCE * scales)


def _parts(excess: Array, tolerance: Array) -> Array:
    """Return `excess` / `tolerance`, or 0 without an excess."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(excess > 0, excess / tolerance, 0.0)


def _too_near(motion: Collocated, c: ClearanceConstraint) -> _Beyond:
    moments, places = motion.seen(c)
    lacking = c.lacking(places)
    row = int(np.argmax(lacking))
    far = max(float(lacking[row]), 0.0)
    nearest = replace(c.check_at(places[row], f"{moments[row]:.4g} s", c.between), plant="between the nodes")
    return _Beyond("constraint", far, far / c.between, moments[~(lacking <= c.between)], nearest)


def _of_stay(motion: Collocated, c: GoalConstraint) -> _Beyond:
    """Return the excess of a goal over its tolerance while it applies, for the dynamics' states between the knots."""
    problem, (times, xs) = motion.task.problem, motion.between_knots
    knots = problem.knots_of(c, input_at_end=True)
    begin, end = (motion.horizon * knots[i] / problem.num_steps for i in (0, -1))
    here = (times >= begin) & (times <= end)
    times, misses = times[here], np.array([c.miss(x) for x in xs[here]])
    k = int(np.argmax(misses))
    row = _between("constraint", f"{c.label} at {times[k]:.4g} s", float(misses[k]), c.tolerance, c.unit)
    far = max(float(misses[k]) - c.tolerance, 0.0)
    return _Beyond("constraint", far, row.ratio, times[misses > c.tolerance], row)


def _of_constraint(motion: Collocated, c: Constraint, spans: Array) -> list[_Beyond]:
    """Return one entry for each number of a constraint on all knots.

    Its range is a poor scale if its slope is small at the bound: (x - a)^2 >= r^2 is a wall of any width. The distance
    to where it is satisfied must also be small, by its slope or by the ends of the violation along the motion, and the
    motion must not leave the forbidden set on its other side.
    """
    times, xs = motion.between_knots
    order = np.argsort(times)
    times, xs = times[order], xs[order]
    first = motion.horizon * (motion.mesh[0] + motion.mesh[1]) / 2
    mask = times > (first if motion.task.problem.initial_state_is_given else 0.0)  # given states are not checked
    mask &= np.isfinite(xs).all(axis=1)  # where the dynamics diverge, their integration check fails
    times, xs = times[mask], xs[mask]

    def motion_at(more: Array) -> tuple[Array, Array]:
        return motion.at(more)[0], motion.applied_at(more)

    if _is_users(c):
        outside = _outside(c, motion.places.points.T[:, : xs.shape[1]], motion.places.points.T[:, xs.shape[1] :])
        more = np.setdiff1d(motion.places.times[outside], times)
        more = more[more > (times[0] if len(times) else 0.0)]
        every, xs = np.concatenate([times, more]), np.vstack([xs, motion_at(more)[0]])
        order = np.argsort(every)
        times, xs = every[order], xs[order]
    times, xs, us = _looked_at(c, times, xs, motion.applied_at(times), motion_at)
    values = _values(c, xs, us)
    if not len(values):
        row = _between("bound", f"{c.label} at no moment", np.inf, 0.0)
        return [_Beyond("constraint", np.inf, np.inf, times, row)]
    scales = c.scales(xs, us, spans)
    excess, tolerance = _excess(values, c.lower, c.upper), _tolerance(_extent(np.nan_to_num(values)), scales)
    depth, through = _depth(c, xs, us, excess, spans, scales)
    depth = np.where(through, 1.0, depth)
    fraction = np.maximum(_parts(excess, tolerance), depth / DEPTH_TOLERANCE)
    excesses = []
    for i in range(values.shape[1]):
        k = int(np.lexsort((excess[:, i], fraction[:, i]))[-1])
        far, where = float(excess[k, i]), f"{c.label} at {times[k]:.4g} s"
        row = _between("bound", where, far, float(tolerance[i]))
        if through[k, i]:
            row = replace(row, what="passage", verdict="fail")
        elif depth[k, i] / DEPTH_TOLERANCE > row.ratio:
            row = _between("depth", where, float(depth[k, i]), DEPTH_TOLERANCE)
        excesses.append(_Beyond("constraint", far, float(fraction[k, i]), times[~(fraction[:, i] <= 1)], row))
    return excesses


def _is_users(c: Constraint) -> bool:
    """Return whether nothing is known about the places where `c` may be violated."""
    return not isinstance(c, GoalConstraint) and not hasattr(c.function, "linearize")


def _outside(c: Constraint, xs: Array, us: Array) -> Any:
    """Select places from very many in order, xs (S, nx) and us (S, nu), that describe where `c` is violated.

    These are the ends and the worst place of each sequence of violations.
    """
    knots = np.hstack([xs, us])
    values = values_of_many(constraint_form(c, xs.shape[1], knots[:: max(1, len(knots) // PROBED)]), knots)
    excess = np.max(_excess(values, c.lower, c.upper), axis=1)
    rows = np.flatnonzero(excess > SOLVED)
    telling = set[int]()
    for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []:
        telling |= {max(run[0] - 1, 0), int(run[np.argmax(excess[run])]), min(run[-1] + 1, len(xs) - 1)}
    return sorted(telling)


def _values(c: Constraint, xs: Array, us: Array) -> Array:
    """Return the values (S, m) along xs (S, nx) and us (S, nu)."""
    with np.errstate(all="ignore"):
        return np.array([c(x, u) for x, u in zip(xs, us, strict=True)]).reshape(len(xs), -1)


def _looked_at(
    c: Constraint, times: Array, xs: Array, us: Array, motion_at: Callable[[Array], tuple[Array, Array]]
) -> tuple[Array, Array, Array]:
    """Return ordered `times` (S,) [s] and states and inputs (S, ...), with more from `motion_at` where `c` may fail.

    The new places are around each local minimum of the distance from a bound.
    """
    for _ in range(CLOSER_ROUNDS):
        values = _values(c, xs, us)
        slack = np.nan_to_num(np.minimum(values - c.lower, c.upper - values), nan=-np.inf)
        before, here, after = slack[:-2], slack[1:-1], slack[2:]
        with np.errstate(invalid="ignore"):
            may_be_beyond = here <= 2 * (np.maximum(before, after) - here)
            dips = (here <= before) & (here <= after) & may_be_beyond & np.isfinite(here)
        places = 1 + np.flatnonzero(np.any(dips, axis=1))
        if not len(places):
            break
        inside = np.arange(1, CLOSER + 1) / (CLOSER + 1)
        ends = np.stack([times[places - 1], times[places + 1]])
        more = np.setdiff1d((ends[0] + inside[:, None] * (ends[1] - ends[0])).ravel(), times)
        every = np.concatenate([times, more])
        order = np.argsort(every)
        found_xs, found_us = motion_at(more)
        times, xs, us = every[order], np.vstack([xs, found_xs])[order], np.vstack([us, found_us])[order]
    return times, xs, us


def _depth(
    c: Constraint, xs: Array, us: Array, excess: Array, spans: Array, scales: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the distance (S, m), in `spans` (nx + nu,), to where the constraint holds, and where motions pass it.

    The distance is the smaller of two values: the first-order estimate by the slope, and half of the motion between the
    previous and next places at which the constraint is satisfied. If the slopes at the first and the last place between
    these are opposite, the motion has passed through the forbidden set.
    """
    z, depth, through = np.hstack([xs, us]) / spans, np.zeros_like(excess), np.zeros(excess.shape, dtype=bool)
    bound = np.where(np.isfinite(c.lower), np.abs(c.lower), np.abs(c.upper))
    outside = excess > SOLVED * np.maximum(scales, bound)
    slopes = np.zeros((*excess.shape, len(spans)))
    for k in np.flatnonzero(np.any(outside, axis=1)):
        try:
            slopes[k] = c.differentiate(xs[k], us[k])[1] * spans
        except GradientError:  # without a derivative, only the second value is used
            continue
    with np.errstate(divide="ignore", invalid="ignore"):
        by_slope = np.where(outside, excess / np.sum(np.abs(slopes), axis=2), 0.0)
    for i in range(excess.shape[1]):
        rows = np.flatnonzero(outside[:, i])
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []:
            on_the_way = z[max(run[0] - 1, 0) : run[-1] + 2]
            half = float(np.max(np.ptp(on_the_way, axis=0))) / 2
            depth[run, i] = np.minimum(by_slope[run, i], half)
            through[run, i] = slopes[run[0], i] @ slopes[run[-1], i] < 0
    return depth, through

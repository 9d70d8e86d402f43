"""Measure a function around a point: its difference quotients, the scatter of its values, and its discontinuities.

The function is differenced at 13 step sizes, half a decade apart. With C(h) the central quotient and r = sqrt(10),
Richardson's D(h) = C(h/r) + (C(h/r) - C(h)) / (r^2 - 1) has an error of order h^4. Three neighbouring D that lie close
together are a plateau.

The accuracy of the quotients is measured along a random line. The function is evaluated at eight equal steps to each
side of the point, with spacings of 1e-9, 1e-7, 1e-5 and 1e-3. High-order differences of eight values leave only the
scatter of a smooth function (More and Wild, "Estimating computational noise", 2011). If they are much larger at larger
spacings, the function has a corner, a jump or a staircase, which bisection distinguishes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import comb

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.differences import Difference, Many, richardson, sweep_of


@dataclass(frozen=True)
class DifferenceOptions:
    """Step sizes of the differences around a point, and thresholds for noise."""

    steps: tuple[float, ...] = tuple(10.0 ** (-k / 2) for k in range(4, 17))  # 1e-2 ... 1e-8
    spacings: tuple[float, ...] = (1e-9, 1e-7, 1e-5, 1e-3)  # of the values along a line
    rounded_point: float = 4 * np.finfo(float).eps  # relative rounding of a point's entries, displaced to both sides
    values: int = 8  # at each spacing, to each side
    orders: tuple[int, ...] = (4, 5, 6)  # of the differences from which scatter is estimated
    last_place: float = 1.1e-16  # half a unit in the last place of 1
    safety: float = 3.0  # multiple of the scatter, which is a standard deviation estimated from a few values
    significant: float = 30.0  # multiple of the scatter above which a corner or a jump is significant
    visible: float = 1e-10  # relative to a value: smaller stairs are magnified rounding
    fine: float = 1e-5  # for this and the next see `_stairs`
    flat: float = 1e-2
    shrinks: float = 0.7  # ratio of gaps at a corner, at least; it is 0.56 for |x|^1.5, 0.32 for a smooth function
    near: int = 2  # number of the finest spacings, which usually do not reach a corner or a staircase
    halvings: int = 24
    seeds: tuple[int, ...] = (2, 3, 4, 5)  # of lines for second differences: products cancel along few of them
    stairs: int = 3  # jumps to each side, in different intervals, of a staircase; a single one is the start of contact


DIFFERENCES = DifferenceOptions()

TINY = 1e-300  # below every meaningful number


@dataclass(frozen=True)
class Neighbourhood:
    """The difference quotients of a function R^n -> R^m around a point, and the scatter of its values."""

    centre: Array  # the value at the point
    size: Array  # (m,) magnitude of the values, which determines their rounding
    forward: Array  # (s, m, n) one-sided quotients at DIFFERENCES.steps
    backward: Array  # (s, m, n)
    scatter: Array  # (m,) scatter of the values within 1e-6, or the error that a solver leaves if that is larger
    finest: Array  # (m,) the same within 1e-8
    products: Array  # (m,) second derivatives along random lines, over 1e-2: size of the terms that may cancel
    stairs: dict[int, str]  # rows that jump on both sides of the point, with a description

    def plateaus(self) -> tuple[Array, Array]:
        """Return the middle of three neighbouring Richardson values (w, m, n), from wide to small steps, and its
        uncertainty (w, m, n): the spread of the three, plus the scatter and the solver's error divided by the step.
        """
        central = (self.forward + self.backward) / 2
        values = richardson(central)
        three = np.array([values[w : w + 3] for w in range(len(values) - 2)])
        steps = np.array(DIFFERENCES.steps)[:, None, None]
        # The scatter of an entry's values is at most their total change, as many entries are zero and solved exactly.
        change = (steps * np.maximum(np.abs(self.forward), np.abs(self.backward))).max(axis=0)
        noise = np.maximum(
            np.minimum(DIFFERENCES.safety * self.scatter[:, None], 2 * change),
            DIFFERENCES.last_place * self.size[:, None],
        )
        doubt = noise / steps[2:-1] + self._corners()
        return three[:, 1], three.max(axis=1) - three.min(axis=1) + doubt

    def _corners(self) -> Array:
        """Return (w, m, n) half the gap between one-sided quotients where it does not shrink with the step, else 0.

        The gap of a smooth function is smaller by r at the next step. At a corner the gap is constant, and central
        quotients have a plateau at the mean of two slopes.
        """
        gap = np.abs(self.forward - self.backward)[1:-1]
        shrinks = gap[1:] <= DIFFERENCES.shrinks * gap[:-1]
        return np.asarray(np.where(shrinks, 0.0, gap[1:] / 2))


def look_around(
    f: Many, n: int, minus: Difference = np.subtract, unsolved: Array | float = 0.0, point: Array | None = None
) -> Neighbourhood:
    """Evaluate `f`, a function of displacements (K, n) with values (K, m), around 0.

    `unsolved` (m,) bounds the error of a value due to a solver that stops early. Jumps of that size are no staircase.
    Neither is the effect of rounding the displaced `point` (n,), which exceeds the value's rounding if terms cancel.
    """
    sweep = sweep_of(f, n, DIFFERENCES.steps, minus=minus)
    centre, ahead = sweep.centre, sweep.forward
    rows, direction = ahead.shape[1], line(n)
    size = np.abs(centre) if minus is np.subtract else np.ones(rows)
    along, rounding, by_spacing = _scattered(minus(np.asarray(f(_along(n)), dtype=float), centre), size)
    unknown = np.array(np.broadcast_to(unsolved, rows), dtype=float)
    if point is not None:
        unknown = np.maximum(unknown, DIFFERENCES.rounded_point * np.nan_to_num(np.abs(ahead[0])) @ np.abs(point))
    scatter = np.maximum(by_spacing[:, : DIFFERENCES.near].max(axis=(0, 1)), unknown / DIFFERENCES.safety)
    finest = np.maximum(by_spacing[:, 0].max(axis=0), unknown / DIFFERENCES.safety)
    lines = DIFFERENCES.steps[0] * np.array([line(n, seed) for seed in DIFFERENCES.seeds])
    ends = minus(np.asarray(f(np.vstack([lines, -lines])), dtype=float), centre).reshape(2, len(lines), rows)
    products = np.abs(ends.sum(axis=0)).max(axis=0) / DIFFERENCES.steps[0] ** 2
    stairs = _stairs(lambda t: minus(f(np.multiply.outer(t, direction)), centre), along, by_spacing, rounding, unknown)
    return Neighbourhood(centre, size, ahead, sweep.backward, scatter, finest, products, stairs)


def is_broken(changes: Many, n: int, noise: Array | float = 0.0) -> tuple[str, Array]:
    """Describe how a function of displacements (K, n) is not smooth, from its `changes` (K, m) along one line.

    It may be a staircase, or have a corner or a jump within 1e-6 of the point. The description is "" if it is smooth.
    The scatter of the values (m,) beside the point is returned too; it is `noise` (m,) at least.
    """
    direction, line_changes = line(n), changes(_along(n))
    unsolved = np.zeros(line_changes.shape[1]) + DIFFERENCES.significant * noise
    along, rounding, by_spacing = _scattered(line_changes, np.ones(len(unsolved)))
    still = np.maximum(by_spacing[:, 0].min(axis=0), rounding[:, DIFFERENCES.near - 1].max(axis=0))
    still = np.maximum(still, noise)
    for k in range(DIFFERENCES.near):
        through = np.concatenate([along[1, k, ::-1], np.zeros((1, len(unsolved))), along[0, k]])
        if np.any(_scatter(through) > DIFFERENCES.significant * still):
            return "the function has a break near the point", still
    some = _stairs(lambda t: changes(np.multiply.outer(t, direction)), along, by_spacing, rounding, unsolved)
    return next(iter(some.values()), ""), still


def noise_of(changes: Many, n: int) -> Array:
    """Return the scatter (3, m) of a function's values, from its `changes` (K, m), at spacings of 1e-9, 1e-7 and 1e-5.

    It is the larger one of both sides of the point, but the smaller one at 1e-5.
    """
    spacings = DIFFERENCES.spacings[: DIFFERENCES.near + 1]
    scatter = _scatter(changes(_along(n, spacings)).reshape(2, len(spacings), DIFFERENCES.values, -1))
    return np.vstack([scatter[:, :-1].max(axis=0), scatter[:, -1:].min(axis=0)])


def _along(n: int, spacings: tuple[float, ...] = DIFFERENCES.spacings) -> Array:
    """Return places (K, n) along a line to both sides of the point, at each of the spacings."""
    places = np.multiply.outer([1.0, -1.0], np.multiply.outer(spacings, np.arange(1, DIFFERENCES.values + 1)))
    return np.asarray(places.reshape(-1, 1) * line(n))


def _scattered(changes: Array, size: Array) -> tuple[Array, Array, Array]:
    """Return the `changes` along a line (2, spacings, values, m), their rounding and scatter (2, spacings, m)."""
    along = changes.reshape(2, len(DIFFERENCES.spacings), DIFFERENCES.values, -1)
    rounding = DIFFERENCES.last_place * (size + np.abs(along).max(axis=2))
    return along, rounding, np.maximum(_scatter(along), rounding)


def line(shape: int | tuple[int, ...], seed: int = 1) -> Array:
    """Return a random direction without small entries."""
    random = np.random.default_rng(seed)
    return np.asarray(random.uniform(0.5, 1.0, shape) * random.choice([-1.0, 1.0], shape))


def _scatter(values: Array) -> Array:
    """Return the standard deviation (..., m) of equally spaced `values` (..., k, m) around a smooth curve."""
    deviations = []
    for order in DIFFERENCES.orders:
        differences = np.diff(values, order, axis=-2)
        deviations.append((differences**2).mean(axis=-2) / comb(2 * order, order))
    return np.asarray(np.sqrt(np.median(deviations, axis=0)))


def _stairs(
    along_line: Callable[[Array], Array], along: Array, scatter: Array, rounding: Array, unsolved: Array
) -> dict[int, str]:
    """Describe the rows of `along` (2, spacings, values, m) that jump in at least three intervals on each side.

    `along_line` returns the changes (k, m) at k places of the line. `scatter` has the shape (2, spacings, m).
    """
    slope = (along[0, 0, -1] - along[1, 0, -1]) / (2 * DIFFERENCES.values * DIFFERENCES.spacings[0])
    reasons: dict[int, str] = {}
    for k in range(1, len(DIFFERENCES.spacings) if len(slope) else 0):
        finest = np.maximum(scatter[:, 0].max(axis=0), rounding[:, k].max(axis=0)) + TINY
        values = 2 * rounding[:, k].max(axis=0) / DIFFERENCES.last_place
        least = np.maximum(np.maximum(DIFFERENCES.significant * finest, unsolved), DIFFERENCES.visible * values)
        both, spacing = scatter[:, k].min(axis=0), DIFFERENCES.spacings[k]
        # At spacings at which several contacts may start, only a function that is flat between jumps is a staircase.
        if spacing > DIFFERENCES.fine:
            risen = np.abs(along[:, k]).max(axis=(0, 1))
            both[~(np.abs(slope) * DIFFERENCES.values * spacing <= DIFFERENCES.flat * risen)] = 0.0
        row = int(np.argmax(both / finest))
        if row in reasons or not both[row] > least[row]:
            continue
        jumps = [
            _jumps(along_line, row, sign, k, along[s, k, :, row], slope[row], least[row])
            for s, sign in enumerate((1, -1))
        ]
        if all(len(some) >= DIFFERENCES.stairs for some in jumps):
            (up, here), (down, there) = jumps[0][0], jumps[1][0]
            reasons[row] = (
                f"the function jumps by {up:.2g} at {here:.2g} and by {down:.2g} at {there:.2g} of a line through "
                "the point"
            )
    return reasons


def _jumps(
    along_line: Callable[[Array], Array], row: int, sign: int, k: int, values: Array, slope: float, least: float
) -> list[tuple[float, float]]:
    """Return up to three jumps of a row and their places, each found by bisection between two of `values` (k,)."""
    places, heights = sign * DIFFERENCES.spacings[k] * np.arange(DIFFERENCES.values + 1), np.append(0.0, values)
    off = np.abs(np.diff(heights) - slope * np.diff(places))
    jumps: list[tuple[float, float]] = []
    for i in np.argsort(-off, kind="stable")[: DIFFERENCES.stairs]:
        ends, ends_at = places[i : i + 2].copy(), heights[i : i + 2].copy()
        for _ in range(DIFFERENCES.halvings):
            middle = ends.mean()
            value = along_line(np.array([middle]))[0, row]
            halves = np.abs(np.diff([ends_at[0], value, ends_at[1]]) - slope * (ends[1] - ends[0]) / 2)
            later = int(halves[1] > halves[0])
            ends[1 - later], ends_at[1 - later] = middle, value
        jump = ends_at[1] - ends_at[0]
        if not abs(jump) > max(least, off[i] / 100):
            break
        jumps.append((float(jump), float(ends.mean())))
    return jumps

"""Compare a derivative with differences, entry by entry: agree, disagree, discontinuous, undecided.

For every entry the function is differenced at 13 step sizes, half a decade apart. With C(h) the central quotient
and r = sqrt(10), Richardson's D(h) = C(h/r) + (C(h/r) - C(h)) / (r^2 - 1) has an error of order h^4. Where three
neighbouring D lie close together is a plateau; their spread is its uncertainty. An entry

    agrees            where it lies on a plateau that is resolved to 1e-4 of it; an iteratively solved step
                      is allowed 100 times its solver's tolerance, relative to the entry and the row's largest;
    disagrees         where there are such plateaus and it lies on none, by more than ten times that allowance;
    is discontinuous  where forward and backward quotients do not approach each other as h shrinks (a kink), or
                      grow apart as 1/h (a jump), or where the derivative is another one 1e-9 beside the point;
    is undecided      where the differences resolve nothing. Undecided does not pass;
    is not converged  where it agrees, but a rollout's gradient is another one at a finer time step (`refinement`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff._base.differences import ROUNDING, Difference, Function, Many, one_by_one, richardson, sweep_of
from drake_diff.certificates.mode_changes import ModeChange
from drake_diff.exceptions import CertificateError, GradientError, ShapeError

STEPS = tuple(10.0 ** (-k / 2) for k in range(4, 17))  # 1e-2 ... 1e-8
RELATIVE_TOLERANCE = 1e-6
RESOLVED = 1e-4
# Entries below this part of their row's largest, or below NOTHING, need not be resolved, only consistent.
NEGLIGIBLE, NOTHING = 1e-6, 1e-9
# The derivative of what an iterative solver leaves unsolved: measured up to 60 times its tolerance, by row.
SOLVER_FACTOR = 100.0
DOUBTFUL = 10.0  # up to so many times that, a gap may still be the solver's: undecided, which does not pass
JITTER = 1e-9
JITTER_CHANGE = 0.1
VERDICTS = ("agree", "undecided", "not_converged", "disagree", "discontinuous")  # from good to bad


@dataclass(frozen=True)
class Entry:
    """One entry of the derivative: its own value, the differences' value, and what is left of doubt."""

    row: str
    column: str
    derivative: float
    difference: float
    tolerance: float
    verdict: str

    def __str__(self) -> str:
        return (
            f"d {self.row} / d {self.column}: derivative {self.derivative:.9g}, differences {self.difference:.9g}, "
            f"tolerance {self.tolerance:.2g}: {self.verdict}"
        )


@dataclass(frozen=True, eq=False)
class Certificate:
    """The comparison of one derivative (m, n) with differences; arrays (m, n), verdicts by index in VERDICTS."""

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    derivative: Array
    difference: Array
    tolerance: Array
    codes: NDArray[np.int64]
    method: str
    subject: str
    mode_changes: tuple[ModeChange, ...] = ()  # of contact, within 1e-4 of the point

    @property
    def verdict(self) -> str:
        """The worst verdict of all entries."""
        return VERDICTS[int(np.max(self.codes))] if self.codes.size else "agree"

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """Every entry, row by row."""
        return tuple(self.entry(i, j) for i in range(len(self.rows)) for j in range(len(self.columns)))

    @property
    def worst(self) -> Entry:
        """The entry with the worst verdict; among equals, the one furthest beyond its tolerance."""
        excess = np.abs(self.derivative - self.difference) / self.tolerance
        rank = self.codes + excess / (1 + excess)
        i, j = np.unravel_index(int(np.argmax(np.where(np.isnan(rank), np.inf, rank))), rank.shape)
        return self.entry(int(i), int(j))

    def entry(self, row: int, column: int) -> Entry:
        """The entry at (`row`, `column`)."""
        at = (row, column)
        return Entry(
            self.rows[row],
            self.columns[column],
            float(self.derivative[at]),
            float(self.difference[at]),
            float(self.tolerance[at]),
            VERDICTS[self.codes[at]],
        )

    def count(self, verdict: str) -> int:
        """How many entries have this verdict."""
        return int((self.codes == VERDICTS.index(verdict)).sum())

    def require(self) -> "Certificate":
        """This certificate where every entry agrees; CertificateError, naming the worst entry, where not."""
        if self.verdict != "agree":
            raise CertificateError(f"{self.subject}: {self}")
        return self

    def __str__(self) -> str:
        counts = ", ".join(f"{self.count(v)} {v}" for v in VERDICTS if self.count(v))
        worst = f"; worst: {self.worst}" if self.codes.size else ""
        changes = f"; contact changes nearby: {self.mode_changes[0]}" if self.mode_changes else ""
        more = f" and {len(self.mode_changes) - 1} more" if len(self.mode_changes) > 1 else ""
        return f"{self.verdict} ({counts} of {self.codes.size} entries, {self.method}){worst}{changes}{more}"


def certify_jacobian(
    f: Function,
    x: ArrayLike,
    jacobian: ArrayLike | Callable[[Array], Array],
    *,
    rows: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    solver_tolerance: float = 0.0,
    method: str = "given",
    subject: str = "the derivative",
) -> Certificate:
    """Certify `jacobian` (m, n), an array or a function of x, of any `f`: R^n -> R^m at `x` (n,).

    `solver_tolerance` is how accurately `f` is solved, relative to max(1, |f|), where it is solved iteratively.
    Given a function, the derivative is also taken 1e-9 beside `x`.
    """
    return certify_jacobian_of_many(
        one_by_one(lambda at: np.asarray(f(at), dtype=float)),
        x,
        jacobian,
        rows=rows,
        columns=columns,
        solver_tolerance=solver_tolerance,
        method=method,
        subject=subject,
    )


def certify_jacobian_of_many(
    f: Many,
    x: ArrayLike,
    jacobian: ArrayLike | Callable[[Array], Array],
    *,
    rows: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    solver_tolerance: float = 0.0,
    method: str = "given",
    subject: str = "the derivative",
) -> Certificate:
    """`certify_jacobian` of `f`: (K, n) -> (K, m), which is called once for all points of the differences."""
    x = finite_array("x", x, ("n",))
    scale = np.maximum(1.0, np.abs(x))
    at_x = np.asarray(jacobian(x) if callable(jacobian) else jacobian, dtype=float)
    beside = None
    if callable(jacobian):
        beside = np.asarray(jacobian(x + JITTER * scale * jitter_direction(len(x))), dtype=float)
    return certify_displacement(
        lambda d: f(x + scale * d),
        at_x * scale,
        beside=None if beside is None else beside * scale,
        scale=scale,
        rows=tuple(rows or (f"f[{i}]" for i in range(at_x.shape[0]))),
        columns=tuple(columns or (f"x[{i}]" for i in range(len(x)))),
        solver_tolerance=solver_tolerance,
        method=method,
        subject=subject,
    )


def jitter_direction(size: int) -> Array:
    """(size,) entries between 0.5 and 1 of either sign, always the same ones."""
    random = np.random.default_rng(0)
    return random.uniform(0.5, 1.0, size) * random.choice([-1.0, 1.0], size)


def certify_displacement(
    f: Many,
    derivative: Array,
    *,
    rows: tuple[str, ...],
    columns: tuple[str, ...],
    scale: Array,
    beside: Array | None = None,
    minus: Difference = np.subtract,
    solver_tolerance: float = 0.0,
    method: str = "given",
    subject: str = "the derivative",
) -> Certificate:
    """Certify `derivative` (m, n) of `f` at 0, a function of scaled displacements (K, n) with values (K, m).

    `beside` is the derivative at a point 1e-9 away; `scale` (n,) takes the scaling out of what is reported;
    `minus` subtracts two values of `f`, on a tangent space if need be.
    """
    if derivative.shape != (len(rows), len(columns)):
        raise ShapeError("derivative", got=derivative.shape, expected=(len(rows), len(columns)))
    if not np.all(np.isfinite(derivative)):
        raise GradientError(f"{subject} is not finite: {derivative}")
    sweep = sweep_of(f, len(columns), STEPS, minus=minus)
    centre, forward, backward = sweep.centre, sweep.forward, sweep.backward
    values = np.abs(minus(centre, np.zeros_like(centre))) if minus is np.subtract else np.ones(len(rows))
    value_scale = np.maximum(1.0, values)
    difference, tolerance, codes = _judge(derivative, (forward + backward) / 2, value_scale, solver_tolerance)
    jumps = _not_smooth(forward, backward, derivative, value_scale, solver_tolerance)
    if beside is not None:
        reach = np.maximum(np.abs(forward), np.abs(backward)).max(axis=0, initial=0)
        jumps |= _jittery(derivative, beside, reach, solver_tolerance)
    codes[jumps] = VERDICTS.index("discontinuous")
    return Certificate(
        rows,
        columns,
        frozen(derivative / scale),
        frozen(difference / scale),
        frozen(tolerance / scale),
        codes,
        method,
        subject,
    )


def _judge(
    a: Array, central: Array, value_scale: Array, solver_tolerance: float
) -> tuple[Array, Array, NDArray[np.int64]]:
    """The differences' value, the tolerance and the verdict of every entry, kinks and jumps aside."""
    values = richardson(central)
    windows = np.array([values[s - 1 : s + 2] for s in range(1, len(values) - 1)])
    middle = windows[:, 1]
    rounding = ROUNDING * value_scale[None, :, None] / np.array(STEPS[2:-1])[:, None, None]
    uncertainty = windows.max(axis=1) - windows.min(axis=1) + rounding
    magnitude = np.maximum(np.abs(a), np.abs(middle))
    row_size = np.abs(a).max(axis=1, keepdims=True, initial=0)
    unsolved = SOLVER_FACTOR * solver_tolerance * (row_size + magnitude)
    allowed = RELATIVE_TOLERANCE * magnitude + 3 * uncertainty + unsolved
    resolved = uncertainty <= RESOLVED * magnitude + unsolved
    best = uncertainty <= 10 * np.min(uncertainty, axis=0, initial=np.inf)
    vanishing = (magnitude <= np.maximum(NEGLIGIBLE * row_size, NOTHING)) & best
    gap = np.abs(a - middle)
    agrees = (gap <= allowed) & (resolved | vanishing)
    contradicts = resolved.any(axis=0) & ~(resolved & (gap <= allowed + DOUBTFUL * unsolved)).any(axis=0)
    codes = np.where(contradicts, VERDICTS.index("disagree"), VERDICTS.index("undecided"))
    codes[agrees.any(axis=0)] = VERDICTS.index("agree")
    # Report the step that tells most: the best of the agreeing ones, else the least uncertain.
    rank = np.where(agrees.any(axis=0)[None] & ~agrees, np.inf, uncertainty)
    best = np.argmin(rank, axis=0)[None]
    picked = [np.take_along_axis(values, best, axis=0)[0] for values in (middle, allowed)]
    return picked[0], picked[1], codes


def _not_smooth(
    forward: Array, backward: Array, a: Array, value_scale: Array, solver_tolerance: float
) -> NDArray[np.bool_]:
    """Entries whose one-sided quotients do not approach each other as the step shrinks.

    What an iterative solver leaves unsolved looks like a jump too, so a gap must also stand above that.
    """
    found = np.zeros(a.shape, dtype=bool)
    # A jump that is the same on both sides shows in no gap, but in quotients that grow without end.
    for gap, steepest in ((np.abs(forward - backward), 0.5), (np.abs(forward + backward) / 2, -0.5)):
        apart = _does_not_shrink(gap, a, 100 * ROUNDING * value_scale, steepest)
        if solver_tolerance and apart.any():
            apart &= _does_not_shrink(gap, a, solver_tolerance * value_scale, steepest)
        found |= apart
    return found


def _does_not_shrink(gap: Array, a: Array, noise: Array, steepest: float) -> NDArray[np.bool_]:
    """Entries whose gap, over the four smallest steps at which it stands above `noise`, goes as h^`steepest` or less.

    The gap of a smooth entry shrinks as h, that of a kink at the point stays, that of a jump grows as 1/h.
    """
    tells = gap * np.array(STEPS)[:, None, None] > noise[None, :, None]
    significant = RESOLVED * np.maximum(np.abs(a), NEGLIGIBLE * np.abs(a).max(axis=1, keepdims=True, initial=0))
    found = np.zeros(a.shape, dtype=bool)
    i, j = np.nonzero(tells[3:].any(axis=0))
    last = len(STEPS) - 1 - np.argmax(tells[::-1, i, j], axis=0)
    gaps = gap[last + np.arange(-3, 1)[:, None], i, j]
    # Where a kink of this size would still tell at the next smaller step, and does not: it is not at the point.
    ends_early = gaps[-1] * np.array([*STEPS[1:], 0.0])[last] > 2 * noise[i]
    told = ~ends_early & (gaps[-1] > significant[i, j]) & (gaps.min(axis=0, initial=np.inf) > 0)
    # The slope of the line through the four points; their steps are half a decade apart.
    slope = np.array([1.5, 0.5, -0.5, -1.5]) @ np.log(gaps[:, told]) / (5 * np.log(10) / 2)
    found[i[told], j[told]] = slope < steepest
    return found


def _jittery(a: Array, beside: Array, reach: Array, solver_tolerance: float) -> NDArray[np.bool_]:
    """Entries that are another number right beside the point; `reach` is the largest quotient seen around it.

    A smooth entry changes by about 1e-9 of its derivative's slope, and by 1e-2 of it over the widest quotient; what
    an iterative solver leaves unsolved changes from point to point.
    """
    change, size = np.abs(a - beside), np.abs(a) + np.abs(beside)
    row_size = size.max(axis=1, keepdims=True, initial=0)
    told = change > np.maximum(RESOLVED * reach, SOLVER_FACTOR * solver_tolerance * row_size)
    return told & (change > JITTER_CHANGE * size) & (size > NEGLIGIBLE * row_size)

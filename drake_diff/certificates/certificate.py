"""Compare a derivative with difference quotients, entry by entry, and say whether it may be used.

The function is differenced at 13 step sizes, half a decade apart. With C(h) the central quotient and r = sqrt(10),
Richardson's D(h) = C(h/r) + (C(h/r) - C(h)) / (r^2 - 1) has an error of order h^4. Three neighbouring D that lie close
together are a plateau, and their spread is its uncertainty. What the verdicts mean stands in `Certificate`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff._base.differences import ROUNDING, Difference, Function, Many, one_by_one, richardson, sweep_of
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.exceptions import CertificateError, GradientError, ShapeError
from drake_diff.model.contact import Pair

STEPS = tuple(10.0 ** (-k / 2) for k in range(4, 17))  # 1e-2 ... 1e-8
RELATIVE_TOLERANCE = 1e-6
RESOLVED = 1e-4
# Entries below this part of their row's largest, or below NOTHING, need not be resolved, only consistent.
NEGLIGIBLE, NOTHING = 1e-6, 1e-9
# An iterative solver stops early, and the derivative shows it: measured up to 60 times its tolerance, by row.
SOLVER_FACTOR = 100.0
DOUBTFUL = 10.0  # a gap up to this many times that may still be the solver's: undecided, which does not pass
JITTER = 1e-9
JITTER_CHANGE = 0.1
VERDICTS = ("agree", "undecided", "not_converged", "disagree", "discontinuous")  # from good to bad


@dataclass(frozen=True)
class Entry:
    """One entry of a derivative, the differences' value of it, and the gap that is allowed between them."""

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


@dataclass(frozen=True)
class ModeChange:
    """One pair's contact mode at the point and beside it, and the rows that the derivative misses there."""

    pair: Pair
    before: str
    after: str
    column: str
    displacement: float  # in the column's own unit
    rows: tuple[str, ...]

    def __str__(self) -> str:
        touched = f", which touches d({', '.join(self.rows)})/d{self.column}" if self.rows else ""
        return (
            f"{self.pair[0]} and {self.pair[1]}: {self.before} here, {self.after} where {self.column} "
            f"is {self.displacement:+.3g}{touched}"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(ShowsItsRepr):
    """One derivative (m, n), compared with difference quotients; `codes` (m, n) are indices into VERDICTS.

    The verdict of an entry is

    - "agree": it lies on a plateau that is known to 1e-4 of it. The step of an iterative solver is allowed 100 times
      the solver's tolerance, relative to the entry and to the largest of its row;
    - "undecided": the differences do not resolve it. Undecided does not pass;
    - "not_converged": it agrees, but a rollout's gradient changes at a finer time step or in stiffer contact;
    - "disagree": there are plateaus, and it misses all of them by more than ten times what is allowed;
    - "discontinuous": forward and backward quotients do not approach each other as h shrinks (a kink), or grow apart
      as 1/h (a jump), or the derivative is another one 1e-9 beside the point.

    Example:
        >>> certificate = dd.certificates.certify_jacobian(np.sin, [0.0], [[1.01]], rows=["y"], columns=["x"])
        >>> certificate.verdict
        'disagree'
        >>> print(certificate.worst)
        d y / d x: derivative 1.01, differences 1, tolerance ...: disagree
    """

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
        a, d, t = (float(values[row, column]) for values in (self.derivative, self.difference, self.tolerance))
        return Entry(self.rows[row], self.columns[column], a, d, t, VERDICTS[self.codes[row, column]])

    def count(self, verdict: str) -> int:
        """How many entries have this verdict."""
        return int((self.codes == VERDICTS.index(verdict)).sum())

    def require(self) -> "Certificate":
        """This certificate if every entry agrees; otherwise CertificateError, which names the worst entry."""
        if self.verdict != "agree":
            raise CertificateError(f"{self.subject}: {self}")
        return self

    def _lines(self) -> list[str]:
        counts = ", ".join(f"{self.count(v)} {v}" for v in VERDICTS if self.count(v))
        lines = [f"{self.verdict} ({counts} of {self.codes.size} entries, {self.method})"]
        lines += [f"worst: {self.worst}"] if self.codes.size else []
        if self.mode_changes:
            more = f" and {len(self.mode_changes) - 1} more" if len(self.mode_changes) > 1 else ""
            lines.append(f"contact changes nearby: {self.mode_changes[0]}{more}")
        return lines

    def __str__(self) -> str:
        return "; ".join(self._lines())

    def __repr__(self) -> str:
        return f"{type(self).__name__} of {self.subject}: " + "\n  ".join(self._lines())


def certify_jacobian(
    f: Function | Many,
    x: ArrayLike,
    jacobian: ArrayLike | Callable[[Array], Array],
    *,
    batched: bool = False,
    rows: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    solver_tolerance: float = 0.0,
    method: str = "given",
    subject: str = "the derivative",
) -> Certificate:
    """Certify the Jacobian of any function R^n -> R^m at a point.

    Args:
        f: the function, (n,) -> (m,); if `batched`, (K, n) -> (K, m), and it is called once for all points.
        x: (n,) the point.
        jacobian: (m, n), or a function of x that gives it, which is then also asked 1e-9 beside `x`.
        batched: whether `f` takes many points at once.
        rows: m names of the function's values.
        columns: n names of the variables.
        solver_tolerance: how accurately `f` is solved, relative to max(1, |f|), if it is solved iteratively.
        method: how the Jacobian was computed, for the record.
        subject: what is certified, for messages.

    Returns:
        The certificate; its derivatives have the units of `f` per unit of `x`.

    Raises:
        ShapeError: the Jacobian does not have m rows and n columns.
        GradientError: the Jacobian is not finite.

    Source:
        Richardson, "The approximate arithmetical solution by finite differences", 1911.

    Example:
        >>> dd.certificates.certify_jacobian(np.sin, [0.0], [[1.0]]).verdict
        'agree'
        >>> dd.certificates.certify_jacobian(np.abs, [0.0], [[0.0]]).verdict  # a kink: central differences see 0
        'discontinuous'
    """
    x = finite_array("x", x, ("n",))
    scale = np.maximum(1.0, np.abs(x))
    at_x, beside = np.asarray(jacobian(x) if callable(jacobian) else jacobian, dtype=float), None
    if callable(jacobian):
        beside = np.asarray(jacobian(x + jitter(scale)), dtype=float) * scale
    many = f if batched else one_by_one(lambda at: np.asarray(f(at), dtype=float))
    return certify_displacement(
        lambda d: many(x + scale * d),
        at_x * scale,
        beside=beside,
        scale=scale,
        rows=tuple(rows or (f"f[{i}]" for i in range(at_x.shape[0]))),
        columns=tuple(columns or (f"x[{i}]" for i in range(len(x)))),
        solver_tolerance=solver_tolerance,
        method=method,
        subject=subject,
    )


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
    a, d, t = (frozen(numbers / scale) for numbers in (derivative, difference, tolerance))
    return Certificate(rows, columns, a, d, t, codes, method, subject)


def jitter(scale: Array) -> Array:
    """(n,) entries between a half and all of 1e-9 `scale` (n,), of either sign, always the same ones."""
    random, size = np.random.default_rng(0), len(scale)
    return JITTER * scale * (random.uniform(0.5, 1.0, size) * random.choice([-1.0, 1.0], size))


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
    """Entries whose one-sided quotients do not approach each other as the step shrinks."""
    found = np.zeros(a.shape, dtype=bool)
    # A jump that is the same on both sides shows in no gap, but in quotients that grow without end.
    for gap, steepest in ((np.abs(forward - backward), 0.5), (np.abs(forward + backward) / 2, -0.5)):
        apart = _does_not_shrink(gap, a, 100 * ROUNDING * value_scale, steepest)
        if solver_tolerance and apart.any():  # what a solver leaves looks like a jump too: the gap must be larger
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
    """Entries that are another number right beside the point; `reach` is the largest quotient seen around it."""
    change, size = np.abs(a - beside), np.abs(a) + np.abs(beside)
    row_size = size.max(axis=1, keepdims=True, initial=0)
    # A smooth entry changes by 1e-9 of its slope here, and by 1e-2 of it over the widest quotient.
    told = change > np.maximum(RESOLVED * reach, SOLVER_FACTOR * solver_tolerance * row_size)
    return told & (change > JITTER_CHANGE * size) & (size > NEGLIGIBLE * row_size)

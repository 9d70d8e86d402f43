"""Compare a derivative with difference quotients, entry by entry, and say whether it may be used.

What the differences say is in `differences`; `judge` makes the verdict, and `Certificate` says what it means.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import Array, Indices, array_with_gaps, finite_array, frozen
from drake_diff._base.autodiff import Shape, called
from drake_diff._base.differences import Difference, Function, Many, one_by_one
from drake_diff._base.values import ShowsItsRepr
from drake_diff.certificates.differences import DIFFERENCES, TINY, Neighbourhood, line, look_around
from drake_diff.exceptions import CertificateError, GradientError, InputError, ShapeError
from drake_diff.model.contact import Pair

VERDICTS = ("agree", "undecided", "not_converged", "disagree", "discontinuous")  # from good to bad


@dataclass(frozen=True)
class VerdictOptions:
    """What makes a verdict of differences."""

    power: float = 1e-2  # of an entry: an error as large as this must be noticed
    exact: float = 1e-6  # of an entry: no derivative need be better
    trusted: float = 3.0  # times the uncertainty of a plateau
    early: float = 1000.0  # for this and the next two see `judge`
    stopped: float = 4e-3
    doubtful: float = 9e-3
    doubtless: float = 10.0  # times the tolerance: a gap that large is an error though the differences do not tell 1 %
    negligible: float = 1e-4  # of the largest of the row and of the column
    unseen: float = 1e-8  # of the largest of the row, whatever the column's
    visible: float = 1e-12  # of a value: a smaller jump is rounding
    products: float = 3.3e-15  # of the products in a row: what sums of 30 of them may be off
    nearer: float = 0.5  # of the gap to wide differences: a derivative so much nearer to narrow ones is theirs
    gone: float = 0.1  # of a gap over the next larger step: what a jump between the two steps leaves
    rounded: float = 1e-6  # of the largest of the row: rounding excuses no more
    vanishing: float = 1e-5  # of the quotient over the widest step
    resolved: float = 1e-4  # of an entry: a smaller corner is none
    corner: float = 0.25
    jump: float = -0.5  # one-sided quotients part as h^corner or less at a corner, and grow as h^jump at a jump
    significant: float = 30.0  # times the scatter: what can be told from it
    jitter_change: float = 0.1  # of an entry, 1e-9 beside the point
    mixed: float = 1e-9  # of the largest entry of all: what as large a mixed derivative makes 1e-9 beside the point
    jitter: float = 1e-9  # of the scale: how far beside the point the derivative is taken once more


LIMITS = VerdictOptions()

EPS = float(np.finfo(float).eps)
AGREE, UNDECIDED, NOT_CONVERGED, DISAGREE, DISCONTINUOUS = range(len(VERDICTS))

Flags = NDArray[np.bool_]
Codes = NDArray[np.int64]
Scales = tuple[Array, Array]


@dataclass(frozen=True)
class Judgement:
    """Of every entry (m, n): the differences' value, the gap that is allowed, and the verdict as an index of VERDICTS.

    `noticeable` is the smallest error that would have been noticed, and `size` what an error is measured by.
    """

    difference: Array
    tolerance: Array
    noticeable: Array
    size: Array
    codes: Codes
    reasons: dict[tuple[int, int], str]  # of every entry that is discontinuous


def judge(
    around: Neighbourhood, a: Array, beside: Array | None = None, stopped: float = 0.0, second: Scales | None = None
) -> Judgement:
    """Judge the derivative `a` (m, n); `beside` (m, n) is what it is 1e-9 away, if that is known.

    `stopped` says how early, of the momentum, a solver stopped whose solution `a` was taken at. That much of the
    largest entry of the row is allowed, a thousand times, but no more than 0.4 % of the entry; up to 0.9 % of it, that
    much is no error for certain. `second` are the units (m,) of the rows and (n,) of the columns by which entries are
    weighed as well: see `_matters`.
    """
    difference, doubt = _nearest(around, a, second)
    size, least = _matters(around, a, difference, second)
    largest = np.abs(difference).max(axis=1, keepdims=True, initial=0)
    early = LIMITS.early * stopped * largest
    exact = LIMITS.exact * np.abs(difference) + LIMITS.trusted * doubt + LIMITS.power * least / 100
    exact += LIMITS.products * around.products[:, None]
    doubtful = exact + np.minimum(early, LIMITS.doubtful * size)
    tolerance = exact + np.minimum(early, LIMITS.stopped * size)
    gap = np.abs(a - difference)
    noticeable = tolerance + gap
    tells = LIMITS.trusted * doubt <= LIMITS.power * size
    codes = np.full(a.shape, UNDECIDED)
    codes[(gap <= tolerance) & (noticeable <= LIMITS.power * size)] = AGREE
    # The function does not depend on the variable: to the last bit it is the same at every step.
    unchanged = np.all((around.forward == 0) & (around.backward == 0), axis=0)
    left_out = (a == 0) & unchanged & (noticeable <= LIMITS.exact * np.abs(difference).max(initial=0))
    codes[left_out] = AGREE
    size = np.where(left_out, np.maximum(size, noticeable / LIMITS.power), size)
    codes[(gap > doubtful) & (tells | (gap > LIMITS.doubtless * tolerance))] = DISAGREE
    reasons = _beside(around, a, gap, codes)
    reasons |= _stairs(around, size) | _broken(around, a, difference, size)
    if beside is not None:
        jittery = np.argwhere(_jittery(around, a, beside)).tolist()
        reasons = {
            (i, j): f"at a distance of 1e-9 from the point the derivative is {beside[i, j]:.6g}" for i, j in jittery
        } | reasons
    for entry in reasons:
        codes[entry] = DISCONTINUOUS
    return Judgement(difference, tolerance, noticeable, size, codes, reasons)


def _nearest(around: Neighbourhood, a: Array, second: Scales | None) -> tuple[Array, Array]:
    """The differences' value (m, n) and its uncertainty.

    The limit is at the smallest steps that tell 1 %; of the plateaus that agree with that one the best is taken.
    """
    values, uncertainty = around.plateaus()

    def choose(which: Indices) -> tuple[Array, Array]:
        value, doubt = (np.take_along_axis(numbers, which[None], axis=0)[0] for numbers in (values, uncertainty))
        return value, doubt

    best = np.argmin(uncertainty, axis=0)
    size, _ = _matters(around, a, choose(best)[0], second)
    tells = LIMITS.trusted * uncertainty <= LIMITS.power * size
    value, doubt = choose(np.where(tells.any(axis=0), len(values) - 1 - np.argmax(tells[::-1], axis=0), best))
    stands = np.abs(values - value) <= LIMITS.trusted * (uncertainty + doubt)
    return choose(np.argmin(np.where(stands, uncertainty, np.inf), axis=0))


def _matters(around: Neighbourhood, a: Array, difference: Array, second: Scales | None) -> tuple[Array, Array]:
    """(m, n) what an error of each entry is measured by, and the least of that.

    It is the entry itself, but no less than

    - 1e-4 of the largest entry of its row or of its column, whichever is smaller, and 1e-8 of its row's. A row's
      entries are compared after each column was moved by its scale: 1 m, rad, m/s, rad/s, N or N m, or the variable's
      magnitude where that is more. Where `second` says what the units are with time counted in steps, an entry must be
      negligible both so and in seconds: h in x' = x + h v is small in seconds, h k / m in v' in steps, and both matter;
    - 1e-5 of its own quotient over the widest step, a hundredth of that scale, where the slope is zero at the point;
    - the rounding of the largest entry of all, where a row is nothing but rounding, as of a moment that is zero;
    - what rounding leaves of a row in which products cancel, as of two opposite thrusters on a satellite: 3.3e-15 of
      what the row's second differences over 1e-2 show of these products. That scales as the row does;
    - what the smallest step of the widest plateau leaves of the rounding of the value, which is measured, up to 1e-6
      of the largest entry of the row.
    """
    largest = np.abs(difference).max(axis=1, keepdims=True, initial=0)
    rounding = (LIMITS.significant * around.finest / DIFFERENCES.steps[3] / LIMITS.power)[:, None]
    widest = LIMITS.vanishing * np.maximum(np.abs(around.forward[0]), np.abs(around.backward[0]))
    products = 4 / LIMITS.power * LIMITS.products * around.products[:, None]  # which leaves differences three of four
    floor = np.maximum(np.maximum(widest, products), np.minimum(rounding, LIMITS.rounded * largest))
    return weigh(a, difference, second, floor)


def weigh(a: Array, difference: Array, second: Scales | None, floor: Array | float = 0.0) -> tuple[Array, Array]:
    """(m, n) what an error of each entry is measured by, and the least of that: see `_matters`."""
    magnitude = np.abs(difference)
    small = _small(magnitude)
    if second is not None:
        unit = second[0][:, None] / second[1]
        small = np.minimum(small, unit * _small(magnitude / unit))
    small = np.maximum(small, LIMITS.unseen * magnitude.max(axis=1, keepdims=True, initial=0))
    least = np.maximum(small, floor) + EPS * magnitude.max(initial=0) + TINY
    return np.maximum(np.maximum(np.abs(a), magnitude), least), least


def _small(magnitude: Array) -> Array:
    """(m, n) what is negligible beside the largest of the row and of the column."""
    by_row, by_column = magnitude.max(axis=1, keepdims=True, initial=0), magnitude.max(axis=0, keepdims=True, initial=0)
    return np.asarray(LIMITS.negligible * np.minimum(by_row, by_column))


def _beside(around: Neighbourhood, a: Array, gap: Array, codes: Codes) -> dict[tuple[int, int], str]:
    """Entries of which the derivative is that over small steps and not over larger ones.

    There is a break beside the point, nearer than differences resolve. It is a steep slope, a corner or a jump where
    the differences' value is another one, by `gap` (m, n): the smallest step counts at which scatter cannot bridge that
    gap, so that what is wrong there too stays wrong. Where they have no value it is a jump alone, of which the gap
    grows as the step shrinks, and then is gone.
    """
    steps, gaps = np.array(DIFFERENCES.steps)[:, None, None], np.abs((around.forward + around.backward) / 2 - a)
    scatter = LIMITS.significant * np.maximum(around.finest, DIFFERENCES.last_place * around.size)[:, None]
    last = (gap * steps > scatter).sum(axis=0) - 1
    nearest = np.take_along_axis(gaps, np.maximum(last, 0)[None], axis=0)[0]
    steep = (codes == DISAGREE) & (last >= 0) & (nearest <= LIMITS.nearer * gap)
    grows = (LIMITS.nearer * gaps[1:-1] > gaps[:-2]) & (gaps[1:-1] * steps[2:] > scatter)
    jumps = (codes == UNDECIDED) & np.any(grows & (gaps[2:] <= LIMITS.gone * gaps[1:-1]), axis=0)
    why = "the derivative is the slope over small steps but not over larger steps: {} near the point"
    kinds = [(steep, "there is a break"), (jumps, "the value jumps")]
    return {(i, j): why.format(what) for where, what in kinds for i, j in np.argwhere(where).tolist()}


def _broken(around: Neighbourhood, a: Array, difference: Array, size: Array) -> dict[tuple[int, int], str]:
    """Entries at a corner or a jump of the function, and the numbers that tell it."""
    forward, backward = around.forward, around.backward
    values = around.size + np.max(np.abs(forward[0]), axis=1, initial=0) * DIFFERENCES.steps[0]
    noise = np.maximum(LIMITS.significant * around.finest, LIMITS.visible * values)
    reasons: dict[tuple[int, int], str] = {}
    least = LIMITS.resolved * np.maximum(np.abs(a), np.abs(difference)) + LIMITS.power * size
    # A jump that is the same on both sides shows in no gap, but in quotients that grow without end.
    for gap, steepest in ((np.abs(forward - backward), LIMITS.corner), (np.abs(forward + backward) / 2, LIMITS.jump)):
        for i, j, s in _does_not_shrink(gap, least, noise, steepest):
            h, ahead, behind = DIFFERENCES.steps[s], forward[s, i, j], backward[s, i, j]
            grows = gap[s, i, j] > 3 * gap[s - 2, i, j]  # tenfold at a jump, over a decade
            jump = f"the value jumps by {(ahead + behind) * h:.3g}" if steepest == LIMITS.jump else "the value jumps"
            kind = jump if grows else "the slope has a corner"
            reasons.setdefault((i, j), f"{kind}: {ahead:.6g} ahead, {behind:.6g} behind, with steps of {h:.1g}")
    return reasons


def _does_not_shrink(gap: Array, least: Array, noise: Array, steepest: float) -> list[tuple[int, int, int]]:
    """Entries whose gap, over the four smallest steps at which it stands above `noise` (m,), goes as h^`steepest` or
    less, each with the smallest of those steps.

    The gap of a smooth entry shrinks as h, that of a corner at the point stays, that of a jump grows as 1/h.
    """
    steps = np.array(DIFFERENCES.steps)[:, None, None]
    tells = gap * steps > noise[None, :, None]
    i, j = np.nonzero(tells[3:].any(axis=0))
    last = len(DIFFERENCES.steps) - 1 - np.argmax(tells[::-1, i, j], axis=0)
    i, j, last = (numbers[last >= 3] for numbers in (i, j, last))
    gaps = gap[last + np.arange(-3, 1)[:, None], i, j]
    # Where it would still tell at the next smaller step, and does not: it is beside the point.
    after = np.minimum(last + 1, len(DIFFERENCES.steps) - 1)
    ends_early = (last + 1 < len(DIFFERENCES.steps)) & (gaps[-1] * np.array(DIFFERENCES.steps)[after] > 2 * noise[i])
    significant = ~ends_early & (gaps[-1] > least[i, j]) & (gaps.min(axis=0, initial=np.inf) > 0)
    # The slope of the line through the four points; their steps are half a decade apart.
    slope = np.array([1.5, 0.5, -0.5, -1.5]) @ np.log(gaps[:, significant]) / (5 * np.log(10) / 2)
    i, j, last = (numbers[significant][slope < steepest] for numbers in (i, j, last))
    return list(zip(i.tolist(), j.tolist(), last.tolist(), strict=True))


def _stairs(around: Neighbourhood, size: Array) -> dict[tuple[int, int], str]:
    """The entries of rows on a staircase whose slope is another on the stair than over many; else the whole row."""
    reasons: dict[tuple[int, int], str] = {}
    values, _ = around.plateaus()
    for i, why in around.stairs.items():
        differs = np.max(np.abs(values[:, i] - values[-1, i]), axis=0) > LIMITS.power * size[i]
        for j in np.flatnonzero(differs if differs.any() else np.ones(len(differs), dtype=bool)):
            reasons[i, int(j)] = why
    return reasons


def _jittery(around: Neighbourhood, a: Array, beside: Array) -> Flags:
    """Entries that are another number right beside the point than the function's slopes around it explain."""
    change, size = np.abs(a - beside), np.abs(a) + np.abs(beside)
    reach = np.maximum(np.abs(around.forward), np.abs(around.backward)).max(axis=0, initial=0)
    row_size = size.max(axis=1, keepdims=True, initial=0)
    # A smooth entry changes by 1e-9 of its slope here, and by 1e-2 of it over the widest quotient; by 1e-9 of mixed
    # derivatives, too, which its own quotients do not show: dq/dt of a quaternion by itself, at rest.
    smooth = np.maximum(LIMITS.resolved * reach, LIMITS.mixed * size.max(initial=0))
    return np.asarray(
        (change > smooth) & (change > LIMITS.jitter_change * size) & (size > LIMITS.negligible * row_size)
    )


@dataclass(frozen=True)
class Entry:
    """One entry of a derivative, the differences' value of it, the gap that is allowed, and what would be noticed."""

    row: str
    column: str
    derivative: float
    difference: float
    tolerance: float
    noticeable: float  # the smallest error that would have been noticed
    verdict: str
    reason: str = ""  # of "discontinuous": which kind, with numbers

    def __str__(self) -> str:
        why = f" ({self.reason})" if self.reason else ""
        return (
            f"d {self.row} / d {self.column}: derivative {self.derivative:.9g}, differences {self.difference:.9g}, "
            f"tolerance {self.tolerance:.2g}, would have noticed {self.noticeable:.2g}: {self.verdict}{why}"
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
        touched = f", which affects d({', '.join(self.rows)})/d{self.column}" if self.rows else ""
        return (
            f"{self.pair[0]} and {self.pair[1]}: {self.before} at this point, {self.after} with {self.column} "
            f"moved by {self.displacement:+.3g}{touched}"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(ShowsItsRepr):
    """One derivative (m, n), compared with difference quotients; `codes` (m, n) are indices into VERDICTS.

    How far the differences can be trusted is measured at the point: by how much they depend on their step, and by how
    much the function's values scatter. From that comes `noticeable`, the smallest error of each entry that would have
    been noticed. It is weighed by `size`: the entry itself, but no less than a millionth of the largest entry of its
    row and of its column, the columns being moved by 1 SI unit, or by the variable's magnitude where that is more.
    The verdict of an entry is

    - "agree": it is the differences' value, and an error of 1 % of `size` would have been noticed;
    - "undecided": the differences do not tell 1 %. Undecided does not pass;
    - "not_converged": it agrees, but a rollout's gradient changes at a finer time step or in stiffer contact;
    - "disagree": it is another value than the differences';
    - "discontinuous": the function has a corner, a jump or stairs at the point, or the derivative is another one 1e-9
      beside it; or the derivative is the slope over small steps, and not the one that larger steps settle at; or a jump
      is nearer than 1e-6, which differences do not resolve. The entry's `reason` says which. A jump or a corner farther
      away does not matter: the derivative is judged by the steps that do not reach it.

    Example:
        >>> from drake_diff.certificates import certify_jacobian
        >>> certificate = certify_jacobian(np.sin, [0.0], [[1.01]], rows=["y"], columns=["x"])
        >>> certificate.verdict
        'disagree'
        >>> print(certificate.worst)
        d y / d x: derivative 1.01, differences 1, tolerance ..., would have noticed ...: disagree
    """

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    derivative: Array
    difference: Array
    tolerance: Array
    noticeable: Array
    size: Array
    codes: Codes
    method: str
    subject: str
    scale: Array  # (n,) of the displacements by which entries are compared
    reasons: dict[tuple[int, int], str] = field(default_factory=dict)  # of the entries that are discontinuous
    # In displacements of which one changes a column by its `scale`; None where the differences are of another motion,
    # or along directions alone: `difference` then is the matrix nearest to the derivative that has their slopes.
    around: Neighbourhood | None = None
    stopped: float = 0.0  # how early the solver stopped where the derivative was taken, as a part of the momentum
    second: Scales | None = None  # units of rows and columns by which entries are weighed as well
    told: str = ""  # whose differences these are, where it is not plain
    mode_changes: tuple[ModeChange, ...] = ()  # of contact, within 1e-4 of the point

    @property
    def verdict(self) -> str:
        """The worst verdict of all entries."""
        return VERDICTS[int(np.max(self.codes))] if self.codes.size else "agree"

    @property
    def power(self) -> float:
        """The smallest error, as a part of what it is weighed by, that would have been noticed in every entry."""
        return float(np.max(self.noticeable / self.size, initial=0.0))

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """Every entry, row by row."""
        return tuple(self.entry(i, j) for i in range(len(self.rows)) for j in range(len(self.columns)))

    @property
    def worst(self) -> Entry:
        """The entry with the worst verdict; among equals, the one that is most wrong, or least known, for its size."""
        gap = np.abs(self.derivative - self.difference)
        excess = np.where(gap > self.tolerance, gap, self.noticeable) / self.size
        rank = self.codes + excess / (1 + excess)
        i, j = np.unravel_index(int(np.argmax(np.where(np.isnan(rank), np.inf, rank))), rank.shape)
        return self.entry(int(i), int(j))

    def entry(self, row: int, column: int) -> Entry:
        """The entry at (`row`, `column`)."""
        numbers = (self.derivative, self.difference, self.tolerance, self.noticeable)
        a, d, t, n = (float(values[row, column]) for values in numbers)
        verdict, reason = VERDICTS[self.codes[row, column]], self.reasons.get((row, column), "")
        return Entry(self.rows[row], self.columns[column], a, d, t, n, verdict, reason)

    def of(self, derivative: ArrayLike) -> Certificate:
        """The certificate of another `derivative` (m, n) at this point, by the same differences."""
        if self.around is None:
            raise InputError("of", got="a certificate without differences of each entry", expected="one by `certify`")
        a = finite_array("derivative", derivative, self.derivative.shape) * self.scale
        names = ("rows", "columns", "method", "subject", "told", "stopped", "second", "scale")
        return certificate_of(self.around, a, None, **{name: getattr(self, name) for name in names})

    def count(self, verdict: str) -> int:
        """How many entries have this verdict."""
        return int((self.codes == VERDICTS.index(verdict)).sum())

    def require(self) -> Certificate:
        """This certificate if every entry agrees; otherwise CertificateError, which names the worst entry."""
        if self.verdict != "agree":
            raise CertificateError(f"{self.subject}: {self}")
        return self

    def _lines(self) -> list[str]:
        counts = ", ".join(f"{self.count(v)} {v}" for v in VERDICTS if self.count(v))
        noticed = f", would have noticed {100 * self.power:.1g} %" if self.verdict == "agree" else ""
        lines = [f"{self.verdict} ({counts} of {self.codes.size} entries, {self.method}{noticed})"]
        lines += [f"worst: {self.worst}"] if self.codes.size else []
        lines += [self.told] if self.told else []
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
    scale: ArrayLike | None = None,
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
        scale: (n,) sizes of the variables, which differences move by parts of; max(1, |x|) where not given.

    Returns:
        The certificate; its derivatives have the units of `f` per unit of `x`.

    Raises:
        ShapeError: the Jacobian does not have m rows and n columns.
        GradientError: the Jacobian is not finite.

    Source:
        Richardson, "The approximate arithmetical solution by finite differences", 1911.

    Example:
        >>> from drake_diff.certificates import certify_jacobian
        >>> certify_jacobian(np.sin, [0.0], [[1.0]]).verdict
        'agree'
        >>> from drake_diff.certificates import certify_jacobian
        >>> certify_jacobian(np.abs, [0.0], [[0.0]]).verdict  # a kink: central differences see 0
        'discontinuous'
    """
    x = finite_array("x", x, ("n",))
    scale = np.maximum(1.0, np.abs(x)) if scale is None else finite_array("scale", scale, x.shape)
    given: Any = jacobian
    if callable(jacobian):
        given = called("jacobian", jacobian, x, shape=("m", len(x)))
    at_x, beside = array_with_gaps("jacobian", given, ("m", len(x))), None
    if callable(jacobian):
        beside = np.asarray(called("jacobian", jacobian, x + jitter(scale), shape=at_x.shape), dtype=float) * scale
    shape: Shape = ("K", len(at_x)) if batched else (len(at_x),)

    def ask(point: Array) -> Array:
        return np.asarray(called("f", f, point, shape=shape), dtype=float)

    many = ask if batched else one_by_one(ask)
    unsolved: Array | float = 0.0
    if solver_tolerance:
        unsolved = solver_tolerance * np.maximum(1.0, np.abs(np.asarray(many(x[None]), dtype=float)[0]))
    return certify_displacement(
        lambda d: many(x + scale * d),
        at_x * scale,
        beside=beside,
        scale=scale,
        rows=tuple(rows or (f"f[{i}]" for i in range(at_x.shape[0]))),
        columns=tuple(columns or (f"x[{i}]" for i in range(len(x)))),
        unsolved=unsolved,
        stopped=solver_tolerance,
        point=x / scale,
        method=method,
        subject=subject,
    )


def certify_displacement(
    f: Many,
    derivative: Array,
    *,
    rows: tuple[str, ...],
    columns: tuple[str, ...],
    subject: str,
    beside: Array | None = None,
    minus: Difference = np.subtract,
    unsolved: Array | float = 0.0,
    point: Array | None = None,
    **named: Any,
) -> Certificate:
    """Certify `derivative` (m, n) of `f` at 0, a function of scaled displacements (K, n) with values (K, m).

    `minus` subtracts two values of `f`, on a tangent space if need be; `unsolved` (m,) is how wrong a value of `f` may
    be because a solver stopped early; `point` (n,) is what is displaced, in the same units, if it is numbers that are
    rounded. The others are arguments of `certificate_of`.
    """
    if derivative.shape != (len(rows), len(columns)):
        raise ShapeError("derivative", got=derivative.shape, expected=(len(rows), len(columns)))
    if not np.all(np.isfinite(derivative)):
        raise GradientError(f"{subject} is not finite: {derivative}")
    around = look_around(f, len(columns), minus, unsolved, point)
    return certificate_of(around, derivative, beside, rows=rows, columns=columns, subject=subject, **named)


def certificate_of(
    around: Neighbourhood,
    derivative: Array,
    beside: Array | None,
    *,
    scale: Array,
    stopped: float = 0.0,
    second: Scales | None = None,
    **named: Any,
) -> Certificate:
    """The verdict on a `derivative` (m, n) by displacements in parts of `scale` (n,): see `judge`."""
    by = judge(around, derivative, beside, stopped, second)
    numbers = unscaled(scale, derivative, by.difference, by.tolerance, by.noticeable, by.size)
    more: dict[str, Any] = {"around": around, "scale": scale, "stopped": stopped, "second": second}
    return Certificate(**numbers, codes=by.codes, reasons=by.reasons, **more, **named)


def unscaled(
    scale: Array, derivative: Array, difference: Array, tolerance: Array, noticeable: Array, size: Array
) -> dict[str, Any]:
    """A certificate's numbers (m, n) by its columns, of those by scaled displacements."""
    numbers = {"derivative": derivative, "difference": difference, "tolerance": tolerance}
    numbers |= {"noticeable": noticeable, "size": size}
    return {name: frozen(values / scale) for name, values in numbers.items()}


def jitter(scale: Array) -> Array:
    """(n,) entries between a half and all of 1e-9 `scale` (n,), of either sign, always the same ones."""
    return LIMITS.jitter * scale * line(len(scale), 0)

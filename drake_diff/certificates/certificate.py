"""Compare a derivative with difference quotients, entry by entry, and decide whether it may be used.

`differences` computes the difference quotients, `judge` decides the verdict, and `Certificate` documents the verdicts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import Array, Indices, array_with_gaps, finite_array, frozen
from drake_diff._base.autodiff import Shape, called
from drake_diff._base.differences import Difference, Function, Many, one_by_one
from drake_diff._base.values import ShowsItsRepr
from drake_diff.certificates.differences import DIFFERENCES, TINY, Neighbourhood, line, look_around
from drake_diff.exceptions import CertificateError, GradientError, InputError, ShapeError
from drake_diff.model.contact import Pair

VERDICTS = ("agree", "undecided", "not_converged", "disagree", "discontinuous")  # from best to worst
NUMBERS = ("derivative", "difference", "tolerance", "noticeable", "size")


@dataclass(frozen=True)
class VerdictOptions:
    """Thresholds that turn differences into a verdict."""

    power: float = 1e-2  # relative to an entry: an error of this size must be noticeable
    exact: float = 1e-6  # relative to an entry: an error of this size is always allowed
    trusted: float = 3.0  # multiple of a plateau's uncertainty that is allowed
    early: float = 1000.0  # for this and the next two see `judge`
    stopped: float = 4e-3
    doubtful: float = 9e-3
    doubtless: float = 10.0  # a gap above this multiple of the tolerance is an error even if 1 % is not resolved
    negligible: float = 1e-4  # relative to the largest entry of the row and of the column
    unseen: float = 1e-8  # relative to the largest entry of the row, regardless of the column
    visible: float = 1e-12  # relative to a value: a smaller jump is rounding
    products: float = 3.3e-15  # relative rounding error of a sum of 30 products in a row
    nearer: float = 0.5  # a derivative belongs to narrow steps if its gap there is below this part of the wide gap
    gone: float = 0.1  # part of the gap at the next larger step that is left when a jump lies between the two steps
    rounded: float = 1e-6  # relative to the largest entry of the row: upper bound of the allowance for rounding
    vanishing: float = 1e-5  # relative to the quotient over the widest step
    resolved: float = 1e-4  # relative to an entry: a smaller corner is ignored
    corner: float = 0.25
    jump: float = -0.5  # exponent of h, at most: of the gap at a corner (`corner`), of the quotients at a jump (`jump`)
    significant: float = 30.0  # multiple of the scatter above which a change is significant
    jitter_change: float = 0.1  # relative to an entry: change at a distance of 1e-9 from the point
    mixed: float = 1e-9  # relative to the largest entry of all: effect of a mixed derivative of that size at 1e-9
    solved: float = 1e-13  # relative to the largest change: rounding of a row that linear equations make constant
    jitter: float = 1e-9  # relative to the scale: distance from the point at which the derivative is taken again


LIMITS = VerdictOptions()

EPS = float(np.finfo(float).eps)
AGREE, UNDECIDED, NOT_CONVERGED, DISAGREE, DISCONTINUOUS = range(len(VERDICTS))

Flags = NDArray[np.bool_]
Codes = NDArray[np.int64]
Scales = tuple[Array, Array]


@dataclass(frozen=True)
class Judgement:
    """The value from differences, the allowed gap, and the verdict (an index into VERDICTS) of every entry (m, n).

    `noticeable` is the smallest error that would have been noticed. Errors are measured relative to `size`.
    """

    difference: Array
    tolerance: Array
    noticeable: Array
    size: Array
    codes: Codes
    reasons: dict[tuple[int, int], str]  # of every discontinuous entry


def judge(
    around: Neighbourhood, a: Array, beside: Array | None = None, stopped: float = 0.0, second: Scales | None = None
) -> Judgement:
    """Judge the derivative `a` (m, n). `beside` (m, n) is the derivative at a distance of 1e-9, if it is known.

    `stopped` is the residual, relative to the momentum, at which the solver stopped whose solution `a` was taken at.
    A gap of 1000 `stopped` times the largest entry of the row is allowed, but no more than 0.4 % of the entry. Between
    0.4 % and 0.9 % of the entry, such a gap is undecided. `second` contains the units of the rows (m,) and of the
    columns (n,) for a second comparison of the entries, see `_matters`.
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
    # The function does not depend on the variable if its values at all steps are identical to the last bit.
    unchanged = np.all((around.forward == 0) & (around.backward == 0), axis=0)
    left_out = (a == 0) & unchanged | _only_rounding(around, a) & (np.abs(difference) <= LIMITS.trusted * doubt)
    left_out &= noticeable <= LIMITS.exact * np.abs(difference).max(initial=0)
    codes[(gap > doubtful) & (tells | (gap > LIMITS.doubtless * tolerance))] = DISAGREE
    codes[left_out] = AGREE
    size = np.where(left_out, np.maximum(size, noticeable / LIMITS.power), size)
    reasons = _beside(around, a, gap, codes)
    reasons |= _stairs(around, size) | _broken(around, a, difference, size)
    if beside is not None:
        for i, j in np.argwhere(_jittery(around, a, beside)).tolist():
            reasons.setdefault((i, j), f"at a distance of 1e-9 from the point the derivative is {beside[i, j]:.6g}")
    for entry in reasons:
        codes[entry] = DISCONTINUOUS
    return Judgement(difference, tolerance, noticeable, size, codes, reasons)


def _only_rounding(around: Neighbourhood, a: Array) -> Flags:
    """Return the rows (m, 1) whose changes and derivative are the rounding of another row, as of a fixed velocity."""
    changes = np.maximum(np.abs(around.forward), np.abs(around.backward)) * np.array(DIFFERENCES.steps)[:, None, None]
    of_rows = np.maximum(changes.max(axis=(0, 2), initial=0), DIFFERENCES.steps[0] * np.abs(a).max(axis=1, initial=0))
    return np.asarray(of_rows <= LIMITS.solved * of_rows.max(initial=0))[:, None]


def _nearest(around: Neighbourhood, a: Array, second: Scales | None) -> tuple[Array, Array]:
    """Return the value from differences (m, n) and its uncertainty.

    The reference is the plateau at the smallest steps that resolve 1 %. The result is the plateau with the smallest
    uncertainty among those that agree with the reference.
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
    """Return the size (m, n) that errors of each entry are measured by, and its lower bound.

    The size is the magnitude of the entry, but at least

    - 1e-4 of the largest entry of its row or of its column, whichever is smaller, and 1e-8 of the largest entry of its
      row. Each column is first multiplied by its scale, which is 1 m, rad, m/s, rad/s, N or N m, or the variable's
      magnitude if that is larger. If `second` gives the units with time counted in steps, an entry is negligible only
      if it is small in both units of time: h in x' = x + h v is small in seconds, h k / m in v' in steps;
    - 1e-5 of its own quotient over the widest step (1e-2 of the scale), if the slope is zero at the point;
    - the rounding of the largest entry of all, if a row is only rounding, such as a moment that is zero;
    - the rounding of a row in which products cancel, such as two opposite thrusters on a satellite. It is 3.3e-15 of
      these products, which are estimated from the row's second differences over 1e-2. It scales with the row;
    - the measured rounding of the value divided by the smallest step of the widest plateau, up to 1e-6 of the largest
      entry of the row.
    """
    largest = np.abs(difference).max(axis=1, keepdims=True, initial=0)
    rounding = (LIMITS.significant * around.finest / DIFFERENCES.steps[3] / LIMITS.power)[:, None]
    widest = LIMITS.vanishing * np.maximum(np.abs(around.forward[0]), np.abs(around.backward[0]))
    products = 4 / LIMITS.power * LIMITS.products * around.products[:, None]  # 4: three of them for the differences
    floor = np.maximum(np.maximum(widest, products), np.minimum(rounding, LIMITS.rounded * largest))
    return weigh(a, difference, second, floor)


def weigh(a: Array, difference: Array, second: Scales | None, floor: Array | float = 0.0) -> tuple[Array, Array]:
    """Return the size (m, n) that errors of each entry are measured by, and its lower bound, see `_matters`."""
    magnitude = np.abs(difference)
    small = _small(magnitude)
    if second is not None:
        unit = second[0][:, None] / second[1]
        small = np.minimum(small, unit * _small(magnitude / unit))
    small = np.maximum(small, LIMITS.unseen * magnitude.max(axis=1, keepdims=True, initial=0))
    least = np.maximum(small, floor) + EPS * magnitude.max(initial=0) + TINY
    return np.maximum(np.maximum(np.abs(a), magnitude), least), least


def _small(magnitude: Array) -> Array:
    """Return (m, n) the magnitude that is negligible compared with the largest of the row and of the column."""
    by_row, by_column = magnitude.max(axis=1, keepdims=True, initial=0), magnitude.max(axis=0, keepdims=True, initial=0)
    return np.asarray(LIMITS.negligible * np.minimum(by_row, by_column))


def _beside(around: Neighbourhood, a: Array, gap: Array, codes: Codes) -> dict[tuple[int, int], str]:
    """Return the entries whose derivative is the slope over small steps but not over larger steps.

    The function then has a break near the point, at a distance that the differences do not resolve. If the differences
    have a value, which differs from the derivative by `gap` (m, n), the break is a steep slope, a corner or a jump. The
    entry is compared at the smallest step at which scatter is less than the gap, so that an entry that is wrong there
    stays wrong. If the differences have no value, only a jump counts, whose gap grows as the step shrinks and vanishes.
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
    """Return the entries at a corner or a jump of the function, each with the quotients that show it."""
    forward, backward = around.forward, around.backward
    values = around.size + np.max(np.abs(forward[0]), axis=1, initial=0) * DIFFERENCES.steps[0]
    noise = np.maximum(LIMITS.significant * around.finest, LIMITS.visible * values)
    reasons: dict[tuple[int, int], str] = {}
    least = LIMITS.resolved * np.maximum(np.abs(a), np.abs(difference)) + LIMITS.power * size
    # A jump by the same amount on both sides leaves no gap between the quotients, but both grow as the step shrinks.
    for gap, steepest in ((np.abs(forward - backward), LIMITS.corner), (np.abs(forward + backward) / 2, LIMITS.jump)):
        for i, j, s in _does_not_shrink(gap, least, noise, steepest):
            h, ahead, behind = DIFFERENCES.steps[s], forward[s, i, j], backward[s, i, j]
            grows = gap[s, i, j] > 3 * gap[s - 2, i, j]  # tenfold at a jump, as the steps are a decade apart
            jump = f"the value jumps by {(ahead + behind) * h:.3g}" if steepest == LIMITS.jump else "the value jumps"
            kind = jump if grows else "the slope has a corner"
            reasons.setdefault((i, j), f"{kind}: {ahead:.6g} ahead, {behind:.6g} behind, with steps of {h:.1g}")
    return reasons


def _does_not_shrink(gap: Array, least: Array, noise: Array, steepest: float) -> list[tuple[int, int, int]]:
    """Return the entries whose gap scales as h^`steepest` or less, each with its smallest significant step.

    The exponent is fitted over the four smallest steps at which the gap exceeds `noise` (m,). The gap shrinks as h if
    the function is smooth, is constant at a corner, and grows as 1/h at a jump.
    """
    steps = np.array(DIFFERENCES.steps)[:, None, None]
    tells = gap * steps > noise[None, :, None]
    i, j = np.nonzero(tells[3:].any(axis=0))
    last = len(DIFFERENCES.steps) - 1 - np.argmax(tells[::-1, i, j], axis=0)
    i, j, last = (numbers[last >= 3] for numbers in (i, j, last))
    fitted = last + np.arange(-3, 1)[:, None]
    gaps = gap[fitted, i, j]
    # Across a break, the change of the value is as large at the larger steps; a single one is an outlier of the noise.
    alone = tells[fitted, i, j].sum(axis=0) < 3
    # If the gap should exceed the noise at the next smaller step but does not, the break is not at the point.
    after = np.minimum(last + 1, len(DIFFERENCES.steps) - 1)
    ends_early = (last + 1 < len(DIFFERENCES.steps)) & (gaps[-1] * np.array(DIFFERENCES.steps)[after] > 2 * noise[i])
    significant = ~ends_early & ~alone & (gaps[-1] > least[i, j]) & (gaps.min(axis=0, initial=np.inf) > 0)
    # The slope of the line through the four points, whose steps are half a decade apart.
    slope = np.array([1.5, 0.5, -0.5, -1.5]) @ np.log(gaps[:, significant]) / (5 * np.log(10) / 2)
    i, j, last = (numbers[significant][slope < steepest] for numbers in (i, j, last))
    return list(zip(i.tolist(), j.tolist(), last.tolist(), strict=True))


def _stairs(around: Neighbourhood, size: Array) -> dict[tuple[int, int], str]:
    """Return the entries whose slope within one stair differs from the slope over many stairs, or the whole row."""
    reasons: dict[tuple[int, int], str] = {}
    values, _ = around.plateaus()
    for i, why in around.stairs.items():
        differs = np.max(np.abs(values[:, i] - values[-1, i]), axis=0) > LIMITS.power * size[i]
        for j in np.flatnonzero(differs if differs.any() else np.ones(len(differs), dtype=bool)):
            reasons[i, int(j)] = why
    return reasons


def _jittery(around: Neighbourhood, a: Array, beside: Array) -> Flags:
    """Return the entries that change by more at a distance of 1e-9 than the slopes around the point explain."""
    change, size = np.abs(a - beside), np.abs(a) + np.abs(beside)
    reach = np.maximum(np.abs(around.forward), np.abs(around.backward)).max(axis=0, initial=0)
    row_size = size.max(axis=1, keepdims=True, initial=0)
    # A smooth entry changes by 1e-9 of its slope at this distance and by 1e-2 of it over the widest quotient. Mixed
    # derivatives add 1e-9 of their size, which its own quotients do not show: d(dq/dt)/dq of a quaternion at rest.
    smooth = np.maximum(LIMITS.resolved * reach, LIMITS.mixed * size.max(initial=0))
    return np.asarray(
        (change > smooth) & (change > LIMITS.jitter_change * size) & (size > LIMITS.negligible * row_size)
    )


@dataclass(frozen=True)
class Entry:
    """An entry of a derivative with its value from differences, the allowed gap, and the smallest noticeable error."""

    row: str
    column: str
    derivative: float
    difference: float
    tolerance: float
    noticeable: float  # the smallest error that would have been noticed
    verdict: str
    reason: str = ""  # for "discontinuous": the kind of discontinuity, with numbers

    def __str__(self) -> str:
        why = f" ({self.reason})" if self.reason else ""
        return (
            f"d {self.row} / d {self.column}: derivative {self.derivative:.9g}, differences {self.difference:.9g}, "
            f"tolerance {self.tolerance:.2g}, would have noticed {self.noticeable:.2g}: {self.verdict}{why}"
        )


@dataclass(frozen=True)
class ModeChange:
    """A pair's contact modes at the point and near it, and the rows that the derivative predicts wrongly there."""

    pair: Pair
    before: str
    after: str
    column: str
    displacement: float  # in the unit of the column
    rows: tuple[str, ...]

    def __str__(self) -> str:
        touched = f", which affects d({', '.join(self.rows)})/d{self.column}" if self.rows else ""
        return (
            f"{self.pair[0]} and {self.pair[1]}: {self.before} at this point, {self.after} with {self.column} "
            f"moved by {self.displacement:+.3g}{touched}"
        )


class Verdict(ShowsItsRepr):
    """A result with a `verdict` on a `subject`, and lines of text."""

    verdict: str
    subject: str

    def require(self) -> Self:
        """Return this certificate if every entry agrees, and raise CertificateError otherwise."""
        if self.verdict != "agree":
            raise CertificateError(f"{self.subject}: {self}")
        return self

    def _lines(self) -> list[str]:
        raise NotImplementedError

    def __str__(self) -> str:
        return "; ".join(self._lines())

    def __repr__(self) -> str:
        return f"{type(self).__name__} of {self.subject}: " + "\n  ".join(self._lines())


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(Verdict):
    """A derivative (m, n), compared with difference quotients. `codes` (m, n) are indices into VERDICTS.

    The accuracy of the differences is measured at the point, from their dependence on the step size and from the
    scatter of the function's values. It yields `noticeable`, the smallest error of each entry that would have been
    noticed. Errors are measured relative to `size`: the magnitude of the entry, but at least 1e-4 of the largest entry
    of its row or of its column, whichever is smaller. For this comparison, each column is multiplied by 1 SI unit, or
    by the variable's magnitude if that is larger. The verdict of an entry is

    - "agree": it equals the value from differences, and an error of 1 % of `size` would have been noticed;
    - "undecided": the differences do not resolve 1 %, so that the entry is not certified;
    - "not_converged": it agrees, but a rollout's gradient does not converge to the slope of the continuous motion;
    - "disagree": it differs from the value from differences;
    - "discontinuous": the function has a corner, a jump or a staircase at the point, or a jump nearer than 1e-6, which
      differences do not resolve. Or the derivative changes at a distance of 1e-9, or it is the slope over small steps
      only. The entry's `reason` gives the case. Jumps and corners farther away have no effect on the verdict.

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
    scale: Array  # (n,) displacement of each variable for which the entries are compared
    reasons: dict[tuple[int, int], str] = field(default_factory=dict)  # of the discontinuous entries
    # In units of `scale` per column. None if the differences are of another motion or only along random directions, in
    # which case `difference` is the matrix nearest to the derivative that has the measured slopes.
    around: Neighbourhood | None = None
    stopped: float = 0.0  # relative to the momentum: residual of the solution at which the derivative was taken
    second: Scales | None = None  # units of rows and columns for a second comparison of the entries
    told: str = ""  # note on the source of the differences
    mode_changes: tuple[ModeChange, ...] = ()  # of contact, within 1e-4 of the point

    @property
    def verdict(self) -> str:  # type: ignore[override]  # computed, and a field of other results
        """The worst verdict of all entries."""
        return VERDICTS[int(np.max(self.codes))] if self.codes.size else "agree"

    @property
    def power(self) -> float:
        """The smallest error, relative to `size`, that would have been noticed in every entry."""
        return float(np.max(self.noticeable / self.size, initial=0.0))

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """All entries, row by row."""
        return tuple(self.entry(i, j) for i in range(len(self.rows)) for j in range(len(self.columns)))

    @property
    def worst(self) -> Entry:
        """The entry with the worst verdict and, among these, the largest error or uncertainty relative to its size."""
        gap = np.abs(self.derivative - self.difference)
        excess = np.where(gap > self.tolerance, gap, self.noticeable) / self.size
        rank = self.codes + excess / (1 + excess)
        i, j = np.unravel_index(int(np.argmax(np.where(np.isnan(rank), np.inf, rank))), rank.shape)
        return self.entry(int(i), int(j))

    def entry(self, row: int, column: int) -> Entry:
        """Return the entry at (`row`, `column`)."""
        numbers = {name: float(getattr(self, name)[row, column]) for name in NUMBERS[:4]}
        verdict, reason = VERDICTS[self.codes[row, column]], self.reasons.get((row, column), "")
        return Entry(self.rows[row], self.columns[column], **numbers, verdict=verdict, reason=reason)

    def of(self, derivative: ArrayLike) -> Certificate:
        """Return the certificate of another `derivative` (m, n) at this point, from the same differences."""
        if self.around is None:
            raise InputError("of", got="a certificate without differences of each entry", expected="one by `certify`")
        a = finite_array("derivative", derivative, self.derivative.shape) * self.scale
        names = ("rows", "columns", "method", "subject", "told", "stopped", "second", "scale")
        return certificate_of(self.around, a, None, **{name: getattr(self, name) for name in names})

    def count(self, verdict: str) -> int:
        """Return the number of entries with this verdict."""
        return int((self.codes == VERDICTS.index(verdict)).sum())

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
        f: The function, (n,) -> (m,). If `batched`, (K, n) -> (K, m), and it is called with many points at once.
        x: (n,) The point.
        jacobian: (m, n) The Jacobian, or a function of x that returns it, which is also called 1e-9 away from `x`.
        batched: Whether `f` takes many points at once.
        rows: m names of the function's values.
        columns: n names of the variables.
        solver_tolerance: Relative tolerance of the values, with respect to max(1, |f|), if `f` is solved iteratively.
        method: Name of the method that computed the Jacobian, which the certificate records.
        subject: Name of the derivative in messages.
        scale: (n,) Scales of the variables, to which the difference steps are relative. The default is max(1, |x|).

    Returns:
        The certificate. Its derivatives have the units of `f` per unit of `x`.

    Raises:
        ShapeError: The Jacobian does not have m rows and n columns.
        GradientError: The Jacobian is not finite.

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
        return np.array(called("f", f, point, shape=shape), dtype=float)

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
    """Certify the `derivative` (m, n) at 0 of `f`, a function of scaled displacements (K, n) with values (K, m).

    `minus` subtracts two values of `f`, for example in a tangent space. `unsolved` (m,) bounds the error of a value of
    `f` due to a solver that stops early. `point` (n,) is the displaced point in the same units, if its entries are
    rounded. The other arguments are those of `certificate_of`.
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
    """Return the certificate of a `derivative` (m, n) with respect to displacements in units of `scale` (n,)."""
    by = judge(around, derivative, beside, stopped, second)
    numbers = unscaled(scale, derivative, by.difference, by.tolerance, by.noticeable, by.size)
    more: dict[str, Any] = {"around": around, "scale": scale, "stopped": stopped, "second": second}
    return Certificate(**numbers, codes=by.codes, reasons=by.reasons, **more, **named)


def unscaled(scale: Array, *numbers: Array) -> dict[str, Any]:
    """Convert the NUMBERS (m, n) of a certificate from scaled displacements to the units of its columns."""
    return {name: frozen(values / scale) for name, values in zip(NUMBERS, numbers, strict=True)}


def jitter(scale: Array) -> Array:
    """Return a fixed displacement (n,) with entries of either sign, between half of 1e-9 `scale` (n,) and all of it."""
    return LIMITS.jitter * scale * line(len(scale), 0)

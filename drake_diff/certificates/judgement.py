"""The verdict on every entry of a derivative, by what the differences say around the point."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.certificates.neighbourhood import STEPS, TINY, Neighbourhood

VERDICTS = ("agree", "undecided", "not_converged", "disagree", "discontinuous")  # from good to bad
POWER = 1e-2  # of an entry: an error as large as this must be noticed
EXACT = 1e-6  # of an entry: no derivative need be better
TRUSTED = 3.0  # times the uncertainty of a plateau
EARLY, STOPPED, DOUBTFUL = 1000.0, 4e-3, 9e-3  # see `judge`
DOUBTLESS = 10.0  # times the tolerance: a gap that large is an error though the differences do not tell 1 %
NEGLIGIBLE = 1e-4  # of the largest of the row and of the column
UNSEEN = 1e-8  # of the largest of the row, whatever the column's
VISIBLE = 1e-12  # of a value: a smaller jump is rounding
ROUNDED = 1e-6  # of the largest of the row: rounding excuses no more
VANISHING = 1e-5  # of the quotient over the widest step
RESOLVED = 1e-4  # of an entry: a smaller corner is none
CORNER, JUMP = 0.25, -0.5  # one-sided quotients part as h^CORNER or less at a corner, and grow as h^JUMP at a jump
TOLD = 30.0  # times the scatter: what can be told from it
JITTER_CHANGE = 0.1  # of an entry, 1e-9 beside the point
EPS = float(np.finfo(float).eps)
MIXED = 1e-9  # of the largest entry of all: what as large a mixed derivative makes 1e-9 beside the point

Flags = NDArray[np.bool_]
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
    codes: NDArray[np.int64]
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
    early = EARLY * stopped * np.abs(difference).max(axis=1, keepdims=True, initial=0)
    tolerance = EXACT * np.abs(difference) + TRUSTED * doubt + POWER * least / 100
    doubtful = tolerance + np.minimum(early, DOUBTFUL * size)
    tolerance += np.minimum(early, STOPPED * size)
    gap = np.abs(a - difference)
    noticeable = tolerance + gap
    tells = TRUSTED * doubt <= POWER * size
    codes = np.full(a.shape, VERDICTS.index("undecided"))
    codes[(gap <= tolerance) & (noticeable <= POWER * size)] = VERDICTS.index("agree")
    left_out = (a == 0) & _is_left_out(around) & (noticeable <= EXACT * np.abs(difference).max(initial=0))
    codes[left_out] = VERDICTS.index("agree")
    size = np.where(left_out, np.maximum(size, noticeable / POWER), size)  # nothing else tells what matters there
    codes[(gap > doubtful) & (tells | (gap > DOUBTLESS * tolerance))] = VERDICTS.index("disagree")
    reasons = _broken(around, a, difference, size)
    for j, why in _stairs(around, size).items():
        reasons.setdefault(j, why)
    if beside is not None:
        for i, j in np.argwhere(_jittery(around, a, beside)):
            reasons.setdefault((int(i), int(j)), f"1e-9 beside the point the derivative is {beside[i, j]:.6g}")
    for entry in reasons:
        codes[entry] = VERDICTS.index("discontinuous")
    return Judgement(difference, tolerance, noticeable, size, codes, reasons)


def _is_left_out(around: Neighbourhood) -> Flags:
    """(m, n) where the function does not depend on the variable: to the last bit it is the same at every step."""
    return np.asarray(np.all((around.forward == 0) & (around.backward == 0), axis=0))


def _nearest(around: Neighbourhood, a: Array, second: Scales | None) -> tuple[Array, Array]:
    """The differences' value (m, n) and its uncertainty.

    The limit is at the smallest steps that tell 1 %; of the plateaus that agree with that one the best is taken.
    """
    values, uncertainty = around.plateaus()
    best = np.argmin(uncertainty, axis=0)[None]
    size, _ = _matters(around, a, np.take_along_axis(values, best, axis=0)[0], second)
    tells = TRUSTED * uncertainty <= POWER * size
    nearest = np.where(tells.any(axis=0), len(values) - 1 - np.argmax(tells[::-1], axis=0), best[0])[None]
    first, doubt = (np.take_along_axis(numbers, nearest, axis=0) for numbers in (values, uncertainty))
    stands = np.abs(values - first) <= TRUSTED * (uncertainty + doubt)
    best = np.argmin(np.where(stands, uncertainty, np.inf), axis=0)[None]
    found, doubt = (np.take_along_axis(numbers, best, axis=0)[0] for numbers in (values, uncertainty))
    return found, doubt


def _matters(around: Neighbourhood, a: Array, difference: Array, second: Scales | None) -> tuple[Array, Array]:
    """(m, n) what an error of each entry is measured by, and the least of that.

    It is the entry itself, but no less than

    - 1e-4 of the largest entry of its row or of its column, whichever is smaller, and 1e-8 of its row's. A row's
      entries are compared after each column was moved by its scale: 1 m, rad, m/s, rad/s, N or N m, or the variable's
      magnitude where that is more. Where `second` says what the units are with time counted in steps, an entry must be
      negligible both so and in seconds: h in x' = x + h v is small in seconds, h k / m in v' in steps, and both matter;
    - 1e-5 of its own quotient over the widest step, a hundredth of that scale, where the slope is zero at the point;
    - the rounding of the largest entry of all, where a row is nothing but rounding, as of a moment that is zero;
    - what the smallest step of the widest plateau leaves of the rounding of the value, which is measured, up to 1e-6
      of the largest entry of the row.
    """
    found = np.abs(difference)
    small = _negligible(found, second)
    rounding = (TOLD * around.finest / STEPS[3] / POWER)[:, None]
    rounding = np.minimum(rounding, ROUNDED * found.max(axis=1, keepdims=True, initial=0))
    widest = VANISHING * np.maximum(np.abs(around.forward[0]), np.abs(around.backward[0]))
    least = np.maximum(np.maximum(small, widest), rounding) + EPS * found.max(initial=0) + TINY
    return np.maximum(np.maximum(np.abs(a), found), least), least


def weighed(a: Array, second: Scales | None) -> Array:
    """(m, n) what an error of each entry of `a` is measured by: see `_matters`; nothing is excused by rounding."""
    found = np.abs(a)
    return np.maximum(found, _negligible(found, second) + EPS * found.max(initial=0) + TINY)


def _negligible(found: Array, second: Scales | None) -> Array:
    """(m, n) the least that matters of entries of these magnitudes."""
    small = _small(found)
    if second is not None:
        unit = second[0][:, None] / second[1]
        small = np.minimum(small, unit * _small(found / unit))
    return np.maximum(small, UNSEEN * found.max(axis=1, keepdims=True, initial=0))


def _small(found: Array) -> Array:
    """(m, n) what is negligible beside the largest of the row and of the column."""
    by_row, by_column = found.max(axis=1, keepdims=True, initial=0), found.max(axis=0, keepdims=True, initial=0)
    return np.asarray(NEGLIGIBLE * np.minimum(by_row, by_column))


def _broken(around: Neighbourhood, a: Array, difference: Array, size: Array) -> dict[tuple[int, int], str]:
    """Entries at a corner or a jump of the function, and the numbers that tell it."""
    forward, backward = around.forward, around.backward
    values = around.size + np.max(np.abs(forward[0]), axis=1, initial=0) * STEPS[0]
    noise = np.maximum(TOLD * around.finest, VISIBLE * values)
    found: dict[tuple[int, int], str] = {}
    least = RESOLVED * np.maximum(np.abs(a), np.abs(difference)) + POWER * size
    # A jump that is the same on both sides shows in no gap, but in quotients that grow without end.
    for gap, steepest in ((np.abs(forward - backward), CORNER), (np.abs(forward + backward) / 2, JUMP)):
        for i, j, s in _does_not_shrink(gap, least, noise, steepest):
            h, ahead, behind = STEPS[s], forward[s, i, j], backward[s, i, j]
            grows = gap[s, i, j] > 3 * gap[s - 2, i, j]  # tenfold at a jump, over a decade
            jump = f"the value jumps by {(ahead + behind) * h:.3g}" if steepest == JUMP else "the value jumps"
            kind = jump if grows else "the slope has a corner"
            found.setdefault((i, j), f"{kind}: {ahead:.6g} ahead, {behind:.6g} behind, with steps of {h:.1g}")
    return found


def _does_not_shrink(gap: Array, least: Array, noise: Array, steepest: float) -> list[tuple[int, int, int]]:
    """Entries whose gap, over the four smallest steps at which it stands above `noise` (m,), goes as h^`steepest` or
    less, each with the smallest of those steps.

    The gap of a smooth entry shrinks as h, that of a corner at the point stays, that of a jump grows as 1/h.
    """
    steps = np.array(STEPS)[:, None, None]
    tells = gap * steps > noise[None, :, None]
    i, j = np.nonzero(tells[3:].any(axis=0))
    last = len(STEPS) - 1 - np.argmax(tells[::-1, i, j], axis=0)
    i, j, last = (numbers[last >= 3] for numbers in (i, j, last))
    gaps = gap[last + np.arange(-3, 1)[:, None], i, j]
    # Where it would still tell at the next smaller step, and does not: it is beside the point.
    after = np.minimum(last + 1, len(STEPS) - 1)
    ends_early = (last + 1 < len(STEPS)) & (gaps[-1] * np.array(STEPS)[after] > 2 * noise[i])
    told = ~ends_early & (gaps[-1] > least[i, j]) & (gaps.min(axis=0, initial=np.inf) > 0)
    # The slope of the line through the four points; their steps are half a decade apart.
    slope = np.array([1.5, 0.5, -0.5, -1.5]) @ np.log(gaps[:, told]) / (5 * np.log(10) / 2)
    i, j, last = (numbers[told][slope < steepest] for numbers in (i, j, last))
    return list(zip(i.tolist(), j.tolist(), last.tolist(), strict=True))


def _stairs(around: Neighbourhood, size: Array) -> dict[tuple[int, int], str]:
    """The entries of rows on a staircase whose slope is another on the stair than over many; else the whole row."""
    found: dict[tuple[int, int], str] = {}
    values, _ = around.plateaus()
    for i, why in around.stairs.items():
        differs = np.max(np.abs(values[:, i] - values[-1, i]), axis=0) > POWER * size[i]
        for j in np.flatnonzero(differs if differs.any() else np.ones(len(differs), dtype=bool)):
            found[i, int(j)] = why
    return found


def _jittery(around: Neighbourhood, a: Array, beside: Array) -> Flags:
    """Entries that are another number right beside the point than the function's slopes around it explain."""
    change, size = np.abs(a - beside), np.abs(a) + np.abs(beside)
    reach = np.maximum(np.abs(around.forward), np.abs(around.backward)).max(axis=0, initial=0)
    row_size = size.max(axis=1, keepdims=True, initial=0)
    # A smooth entry changes by 1e-9 of its slope here, and by 1e-2 of it over the widest quotient; by 1e-9 of mixed
    # derivatives, too, which its own quotients do not show: dq/dt of a quaternion by itself, at rest.
    smooth = np.maximum(RESOLVED * reach, MIXED * size.max(initial=0))
    return np.asarray((change > smooth) & (change > JITTER_CHANGE * size) & (size > NEGLIGIBLE * row_size))

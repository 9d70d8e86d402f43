"""Screen the claimed slopes of a function R^n -> R^m along a few random directions, before any entry is compared.

A wrong entry changes the slope along a random direction with probability one, in proportion to its size. Each column is
moved by a weight w times a normal number z. The weights make the entry that matters least as visible as possible. Along
a direction, the gap of row i is sum_j e_j z_j, where e_j = w_j times the error of entry (i, j). Over K directions, the
sum of the squared gaps is below q |e|^2 with probability `miss` at most. This holds regardless of the error of the
differences, which only makes the gaps larger. So a significant error is missed with a probability below `miss`, and an
error in a single entry is never missed, as no column of z is small.

The first two widths suit the precision of the values. Narrower and wider ones are added while a row is in doubt, as
noise limits narrow differences and curvature limits wide ones. The differences also show whether the function is smooth
at the point. At a corner, the gap between forward and backward slopes is constant. At a jump, it grows. On a staircase,
slopes differ between widths. A doubt is not a verdict, but a reason to compare entries (see `differences`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.differences import Difference, Many, richardson
from drake_diff.certificates.certificate import AGREE, EPS, LIMITS, Certificate, Flags, Scales, unscaled, weigh
from drake_diff.certificates.differences import DIFFERENCES, TINY, is_broken


@dataclass(frozen=True)
class ScreenOptions:
    """Options of the screen of claimed slopes along a few random directions. Widths are half a decade apart."""

    directions: int = 4
    miss: float = 1e-4
    quantile: float = 0.0284184  # `miss`-quantile of the chi^2 distribution with 4 degrees of freedom
    least: float = 1.0  # lower bound of the sum of squares of a column of z, whose expected value is 4
    narrower: int = 2  # pairs of narrower widths, each added if a row is in doubt
    widest_power: int = 1  # the widest width is 10^(-1/2)
    narrow: float = 2.0  # the first width over the cube root of the precision, see `first_power`
    resolved: float = 4e3  # see `resolution`
    by_value: float = 0.04  # see `least_size`
    wide: tuple[float, float] = (8e-3, 4e-3)  # of all columns together, to find a staircase, flat except for jumps
    flat: float = 1e-2  # relative to the change over `wide`, as is `alike`
    alike: float = 0.2
    same: float = 0.1  # relative to a gap: change over the next widths, and corner, of a wrong derivative
    seeded: int = 11
    largest: float = 3.0  # bound of the normal numbers
    widest: float = 1e2  # bound of a weight relative to the median
    rounds: int = 20  # maximum number of iterations that balance the weights
    balanced: float = 1e-2  # relative change of the weights at which these iterations stop
    scatter: float = 4.0  # scatter of the values over the precision, at least; see `is_broken`
    rounding: float = 13.5  # rounding of the sums in a value over the precision, 30 times its scatter


SCREEN = ScreenOptions()


def first_power(precision: float) -> int:
    """Return k for which 10^(-k/2) is the narrower of the first widths: 1e-5 in double, 1e-2 in single precision."""
    return max(SCREEN.widest_power + 1, round(-2 * np.log10(SCREEN.narrow * precision ** (1 / 3))))


def resolution(precision: float) -> float:
    """Return the part of the largest entry of its row that an entry must reach to be resolved to 1 %.

    It is 1e-4 in double precision and 0.1 in single precision.
    """
    return float(np.clip(SCREEN.resolved * precision ** (2 / 3), LIMITS.negligible, 1.0))


def least_size(largest: Array, values: Array, precision: float) -> Array:
    """Return the size (m,) that an entry must reach to be resolved to 1 %, from the largest of its row (m,).

    Rounding also hides slopes below 6e-9 of the value (m,) in double precision, 4e-3 in single precision. They are
    ignored up to the same part of the largest entry of all rows.
    """
    by_value = SCREEN.by_value * SCREEN.resolved * precision ** (2 / 3) * np.abs(values)
    by_others = resolution(precision) * np.max(largest, initial=0.0)
    return np.asarray(np.maximum(resolution(precision) * largest, np.minimum(by_value, by_others)))


@dataclass(frozen=True, eq=False)
class Claim:
    """The claimed slopes of a function R^n -> R^m of scaled displacements, and the errors that must be noticed."""

    along: Callable[[Array], Array]  # directions (K, n) -> slopes (K, m)
    weights: Array  # (n,) zero in columns that are said to have no effect
    allowed: Array  # (m,) error of a row along a unit column of z
    reach: Array  # (m,) sum of the magnitudes of a row, by which its values are rounded
    size: Array  # (m, n) magnitude to which the error of each entry is relative, or (m, 1)
    second: Scales | None = None

    @classmethod
    def of_matrix(
        cls,
        a: Array,
        second: Scales | None = None,
        *,
        least: Array | float = 0.0,
        still: float = 0.0,
    ) -> "Claim":
        """Claim the slopes of the Jacobian `a` (m, n), of which errors of 1 % of an entry must be noticed.

        An entry counts `least` (m, 1) at least. Columns of zeros get the weight `still`. If it is
        0, they must have no effect at all.
        """
        size = weigh(a, a, second, least)[0]
        weights = _weights(a, size)
        weights[weights == 0] = still
        allowed = LIMITS.power * np.min((weights * size)[:, weights > 0], axis=1, initial=np.inf)
        return cls(lambda z: z @ a.T, weights, allowed, np.abs(a).sum(axis=1), size, second)


class Screen:
    """The differences of a function along a few directions from a point, beside the claimed slopes.

    `values` is a function of scaled displacements (K, n) with values (K, m), of the given relative `precision`, and
    `minus` subtracts two of them. A `doubt` is the reason to compare entries, "" if the claim is correct.
    """

    def __init__(self, claim: Claim, values: Many, minus: Difference = np.subtract, *, precision: float = EPS):
        self.claim, self._values, self._minus = claim, values, minus
        n, z, first = len(claim.weights), normals(len(claim.weights)), first_power(precision)
        self.directions = z * claim.weights  # (K, n)
        signs = np.where(z[0] > 0, 1.0, -1.0)
        line = signs * np.minimum(claim.weights, 1.0)
        unmoved = signs * (claim.weights == 0)
        *claimed, self._along_line = claim.along(np.vstack([self.directions, line]))
        self.claimed = np.array(claimed).reshape(SCREEN.directions, -1)
        self.powers, self._first = [first - 1, first], 10.0 ** (-first / 2)
        self.displacements = [
            np.zeros((1, n)),
            _to_both_sides(self.directions, self._widths(self.powers)),
            _to_both_sides(line[None], SCREEN.wide),
            np.multiply.outer([self._widths(self.powers)[0], -SCREEN.wide[0]], unmoved)[: 2 * unmoved.any()],
        ]
        self.evaluations = sum(map(len, self.displacements))
        evaluated = np.asarray(values(np.vstack(self.displacements)), dtype=float)
        self.centre, changes = evaluated[0], minus(evaluated[1:], evaluated[0])
        split = np.cumsum([len(d) for d in self.displacements[1:-1]])
        near, wide, self._left_out = np.split(changes, split)
        self._wide = wide.reshape(2, 2, -1).swapaxes(0, 1)  # (widths, sides, m)
        size = np.abs(self.centre) if minus is np.subtract else np.ones(changes.shape[1])
        self._unit = precision * (size + claim.reach)  # (m,) a unit in the last place
        self.rounding = SCREEN.rounding * self._unit
        self._hidden = _bound(np.broadcast_to(self.rounding, (SCREEN.directions, len(size))))
        # As for single entries, in a row of zeros a slope counts from 1e-5 of that over a wide step.
        widely = np.nan_to_num(np.abs(self._wide).max(axis=(0, 1), initial=0) / SCREEN.wide[0])
        least = LIMITS.power * LIMITS.vanishing * widely
        self.allowed = np.where(claim.reach > 0, claim.allowed, np.maximum(claim.allowed, least))
        self.slopes = _one_sided(near, self._widths(self.powers))
        self._settle(first)
        self.broken, self.doubt = "", self._doubt()

    @property
    def noticeable(self) -> Array:
        """The error (m,) along a unit column that would have been noticed with a probability of 1 - SCREEN.miss."""
        return np.asarray(np.nan_to_num(_bound(self.gaps), nan=np.inf).min(axis=0))

    @property
    def in_doubt(self) -> Flags:
        """The rows (m,) that agree with the claim at no width."""
        return np.asarray(~self.agrees.any(axis=0))

    @property
    def gap(self) -> Array:
        """The gaps (K, m) to the slopes at the widths at which all rows together are nearest to the claim."""
        return np.asarray(self.gaps[self._nearest()])

    def within_steps(self) -> Flags:
        """Return the rows (m,) whose claimed slope, over the first width, exceeds all changes of the values seen.

        They change within that width, unless they disagree with the claim and their slopes do not depend on the width.
        """
        risen = np.nanmax(np.abs(self._wide), axis=(0, 1), initial=0.0)
        changes = np.abs(self.slopes) * self._widths(self.powers)[:, None, None]
        risen = np.maximum(risen, np.nanmax(changes, axis=(0, 1, 2), initial=0.0)) + self.rounding
        slopes, h = self.claimed - self.gaps, self._widths(self.powers)[1:]
        left = np.maximum(SCREEN.same * _bound(slopes[1:]), self._hidden / h[1:, None])
        steady = (_bound(np.diff(slopes, axis=0)) <= left).any(axis=0)
        steep = np.abs(self.claimed).max(axis=0, initial=0.0) * self._first > 2 * risen
        return np.asarray(steep & ~(steady & self.in_doubt))

    def certificate(self, derivative: Array, scale: Array, *, told: str = "", **named: Any) -> Certificate:
        """Return the certificate that all entries of `derivative` agree, for a screen without doubt."""
        claim, per_weight = self.claim, self._per_weight
        best = np.argmin(np.nan_to_num(_bound(self.gaps), nan=np.inf), axis=0)
        gap = np.take_along_axis(self.gaps, best[None, None], axis=0)[0]  # (K, m)
        error = np.linalg.lstsq(self.directions * per_weight, gap, rcond=None)[0].T
        noticeable = self.noticeable[:, None] * per_weight
        statement = (
            f"the slopes along {SCREEN.directions} random directions agree: an error of this size in one entry would "
            f"have been noticed, errors in several entries except with a probability of {SCREEN.miss:g}; the "
            "differences shown are the nearest values that explain the slopes"
        )
        numbers = unscaled(scale, derivative, derivative - error * per_weight, noticeable, noticeable, claim.size)
        codes, text = np.full(derivative.shape, AGREE), f"{statement}; {told}" if told else statement
        return Certificate(**numbers, codes=codes, scale=scale, second=claim.second, told=text, **named)

    def doubtful(self, columns: Flags) -> Flags:
        """Return the rows (m,) that differ from the claim, or have a corner, if only `columns` (n,) are moved."""
        directions, powers = self.directions * columns, self.powers[self._nearest() :][:2]
        slopes = self._take(directions, powers)
        return np.asarray(~self._compare(slopes, self.claim.along(directions), powers)[2][0])

    def _settle(self, first: int) -> None:
        """Add widths, narrower or wider, until each row agrees at some of them or none are left."""
        narrower = [[first + 2 * k - 1, first + 2 * k] for k in range(1, SCREEN.narrower + 1)]
        wider = [[k - 1, k] for k in range(first - 2, SCREEN.widest_power, -2)]
        self.gaps, self.corners, self.agrees = self._compare(self.slopes, self.claimed, self.powers)
        while self.in_doubt.any() and not self._settled() and (narrower or wider):
            ratio = np.nan_to_num((_bound(self.gaps) + self.corners)[:, self.in_doubt], nan=np.inf)
            inward = np.mean(np.argmin(ratio, axis=0)) >= (len(ratio) - 1) / 2
            powers = narrower.pop(0) if narrower and (inward or not wider) else wider.pop(0)
            taken = self._take(self.directions, powers)
            parts = (self.slopes, taken) if powers[0] > self.powers[-1] else (taken, self.slopes)
            self.slopes, self.powers = np.concatenate(parts, axis=1), sorted(self.powers + powers)
            self.gaps, self.corners, self.agrees = self._compare(self.slopes, self.claimed, self.powers)

    def _settled(self) -> bool:
        """Return whether the rows in doubt have the same gap, much larger than their corner, at two pairs of widths."""
        gaps, corners = self.gaps[:, :, self.in_doubt], self.corners[:, self.in_doubt]
        size, change = SCREEN.same * _bound(gaps[1:]), _bound(np.diff(gaps, axis=0))
        return bool(((change <= size) & (corners[1:] <= size)).any(axis=0).all())

    def _take(self, directions: Array, powers: list[int]) -> Array:
        """Return the one-sided quotients (2, s, K, m) along `directions` (K, n) over the widths 10^(-power / 2)."""
        widths = self._widths(powers)
        displacements = _to_both_sides(directions, widths)
        self.evaluations += len(displacements)
        return _one_sided(self._minus(np.asarray(self._values(displacements), dtype=float), self.centre), widths)

    def _doubt(self) -> str:
        """Return the reason to compare entries, or "" if the claim is correct."""
        moves = np.any(np.abs(self._left_out) > self.rounding, axis=1)
        if moves[:1].any():
            return "a column that is 0 in the derivative has an effect"
        if self.in_doubt.any():
            i = int(np.argmax(self.in_doubt))
            if np.any(_bound(self.gaps)[:, i] <= self.allowed[i]):
                return f"the forward and backward slopes of row {i} do not approach each other"
            return f"row {i} disagrees with the slopes along random directions"
        if np.any(self._stairs()):
            return "a row is constant near the point and changes farther away"
        hidden, over = self._hidden, np.maximum(_bound(self.gaps), self.corners) * self._widths(self.powers)[1:, None]
        if (self.agrees | (over <= hidden)).all() and not moves.any():
            return ""
        # A jump, a staircase or noise makes widths disagree. Values along a line distinguish them.
        self.broken, noise = is_broken(self.changes, len(self.claim.weights), self._unit * SCREEN.scatter)
        if self.broken:
            return self.broken
        narrower = np.arange(len(self.agrees))[:, None] > np.argmax(self.agrees, axis=0)  # than the widest that agrees
        explained = self.agrees | ~narrower | (over <= hidden + DIFFERENCES.significant * noise)
        return "" if explained.all() else "the slopes along random directions change with smaller steps"

    def changes(self, displacements: Array) -> Array:
        """Return the changes (K, m) of the function at `displacements` (K, n)."""
        self.evaluations += len(displacements)
        return self._minus(np.asarray(self._values(displacements), dtype=float), self.centre)

    def _stairs(self) -> Flags:
        """Find rows (m,) that are flat at the point and change farther away, but not as h^2 and h^3 (a staircase)."""
        risen = np.abs(self._wide).max(axis=0).min(axis=0)
        predicted = np.abs(self._along_line) * SCREEN.wide[0]
        ahead, behind = self._wide[:, 0], self._wide[:, 1]
        left = predicted + SCREEN.flat * risen + self.rounding
        bent = np.ones(len(risen), dtype=bool)
        for half, order in (((ahead + behind) / 2, 2), ((ahead - behind) / 2, 3)):
            expected = half[0] * (SCREEN.wide[1] / SCREEN.wide[0]) ** order
            bent &= np.abs(half[1] - expected) <= SCREEN.alike * np.abs(expected) + left
        return np.asarray((predicted <= SCREEN.flat * risen) & (risen > self.rounding) & ~bent)

    @property
    def _per_weight(self) -> Array:
        """The reciprocal weights (n,), zero where the weight is zero."""
        weights = self.claim.weights
        return np.divide(1.0, weights, out=np.zeros_like(weights), where=weights > 0)

    @staticmethod
    def _widths(powers: list[int]) -> Array:
        return np.asarray(10.0 ** (-np.array(powers) / 2))

    def _compare(self, slopes: Array, claimed: Array, powers: list[int]) -> tuple[Array, Array, Flags]:
        """Return gaps (s - 1, K, m) to slopes with an error of order h^4, bounds (s - 1, m) of corners, and agreement.

        A corner is the gap between forward and backward slopes, extrapolated to h = 0: linearly from two widths, and
        as the constant term of a fit with h and h^3 to three neighbouring widths. The smaller of both counts.
        """
        gaps, bend = claimed - richardson((slopes[0] + slopes[1]) / 2), (slopes[0] - slopes[1]) / 2
        h, ratio = self._widths(powers), np.sqrt(10.0)
        corners = _bound((ratio * bend[1:] - bend[:-1]) / (ratio - 1))
        for k in range(len(h) - 2):
            terms = np.stack([np.ones(3), h[k : k + 3], h[k : k + 3] ** 3])
            cubic = np.tensordot(np.linalg.solve(terms, [1.0, 0.0, 0.0]), bend[k : k + 3], axes=1)
            corners[k + 1] = np.fmin(corners[k + 1], _bound(cubic))
        smooth = corners <= np.maximum(self.allowed, self._hidden / h[1:, None])
        return gaps, corners, np.asarray((_bound(gaps) <= self.allowed) & smooth)

    def _nearest(self) -> int:
        """Return the index of the two neighbouring widths at which all rows together are nearest to the claim."""
        total = np.log(_bound(self.gaps) + self.corners + TINY).sum(axis=1)
        return int(np.argmin(np.nan_to_num(total, nan=np.inf)))


def _to_both_sides(directions: Array, widths: Any) -> Array:
    """Return the displacements (2 s K, n) along `directions` (K, n) over `widths` (s,), forward ones first."""
    steps = np.multiply.outer([1.0, -1.0], np.multiply.outer(widths, directions))
    return np.asarray(steps.reshape(-1, directions.shape[1]))


def _one_sided(changes: Array, widths: Array) -> Array:
    """Return the forward and the backward quotients (2, s, K, m) of `changes` (2 s K, m)."""
    quotients = changes.reshape(2, len(widths), -1, changes.shape[1]) / widths[:, None, None]
    return np.asarray(quotients * np.array([1.0, -1.0])[:, None, None, None])


def _bound(gaps: Array) -> Array:
    """Return, from gaps (..., K, m), bounds (..., m) that errors of rows exceed with probability SCREEN.miss."""
    largest = np.abs(gaps).max(axis=-2, initial=TINY)  # squares of smaller numbers than 1e-162 vanish
    return np.asarray(largest * np.sqrt(((gaps / largest[..., None, :]) ** 2).sum(axis=-2) / SCREEN.quantile))


@cache
def normals(n: int) -> Array:
    """Return fixed normal numbers (K, n), of which no column is small."""
    random = np.random.default_rng(SCREEN.seeded)
    z = random.standard_normal((SCREEN.directions, n))
    while np.any(small := (z**2).sum(axis=0) < SCREEN.least):
        z[:, small] = random.standard_normal((SCREEN.directions, int(np.count_nonzero(small))))
    return frozen(np.clip(z, -SCREEN.largest, SCREEN.largest))


def _weights(a: Array, size: Array) -> Array:
    """Return weights (n,) for which the smallest entry that matters is the same part of its row in each column."""
    moved = np.any(a != 0, axis=0)
    w = np.where(moved, 1.0, 0.0)
    if not moved.any():
        return w
    magnitude = np.abs(a)
    rows = magnitude.max(axis=1) > 0
    magnitude, least = magnitude[rows], 1 / size[rows]
    for _ in range(SCREEN.rounds):
        need = ((magnitude * w).max(axis=1)[:, None] * least).max(axis=0)
        last, w = w, np.where(moved, np.sqrt(w * need / _middle(need[moved])), 0.0)
        if np.all(np.abs(w - last) <= SCREEN.balanced * w):
            break
    return np.asarray(np.clip(w / _middle(w[moved]), 1 / SCREEN.widest, SCREEN.widest) * moved)


def _middle(values: Array) -> float:
    """Return the median of `values` (n,), twenty times as fast as `np.median`."""
    values, half = np.sort(values), len(values) // 2
    return float(values[half] if len(values) % 2 else (values[half - 1] + values[half]) / 2)

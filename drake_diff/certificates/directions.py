"""Check the Jacobian (m, n) of a step along a few random directions, to decide whether every entry must be compared.

A wrong entry changes the slope along a random direction with probability one, in proportion to its size. Each column is
moved by a weight w times a normal number z. The weights make the entry that matters least as visible as possible. Along
a direction, the gap of row i is sum_j e_j z_j, where e_j = w_j times the error of entry (i, j). Over K directions, the
sum of the squared gaps is below q |e|^2 with probability `miss` at most. This holds regardless of the error of the
differences, which only makes the gaps larger. So a significant error is missed with a probability below `miss`, and an
error in a single entry is never missed, as no column of z is small.

The same differences show whether the function is smooth at the point. At a corner, the gap between forward and backward
slopes is constant. At a jump, it grows. On a staircase, slopes differ between widths. A doubt is not a verdict, but a
reason to compare every entry (see `differences`).
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.differences import Difference, richardson
from drake_diff.certificates.certificate import AGREE, LIMITS, Certificate, Flags, Scales, unscaled, weigh


@dataclass(frozen=True)
class ScreenOptions:
    """Options of the check of a derivative (m, n) along a few random directions."""

    directions: int = 6
    miss: float = 1e-4
    quantile: float = 0.17209  # `miss`-quantile of the chi^2 distribution with 6 degrees of freedom
    least: float = 1.5  # lower bound of the sum of squares of a column of z, whose expected value is 6
    widths: tuple[float, ...] = tuple(10.0 ** (-k / 2) for k in (9, 10, 11, 12))  # friction reverses within 1e-4 m/s
    nearer: float = 0.1  # factor on `widths` for the second look, which is nearer to the point
    wide: tuple[float, float] = (8e-3, 4e-3)  # of all columns together, to find a staircase, flat except for jumps
    flat: float = 1e-2  # relative to the change over `wide`, as is `alike`
    alike: float = 0.2
    seeded: int = 11
    largest: float = 3.0  # bound of the normal numbers
    widest: float = 1e2  # bound of a weight relative to the median: no column is moved by more than 1e-2
    rounds: int = 20  # maximum number of iterations that balance the weights
    balanced: float = 1e-2  # relative change of the weights at which these iterations stop
    rounding: float = 3e-15  # relative rounding of the sums in a value, 30 times its scatter


SCREEN = ScreenOptions()


class LookAt:
    """The scaled displacements at which a function R^n -> R^m is evaluated to check its derivative (m, n)."""

    def __init__(self, derivative: Array, second: Scales | None = None, *, nearer: bool = False):
        self.derivative, self.second, self.nearer = derivative, second, nearer
        self.widths = SCREEN.nearer * np.array(SCREEN.widths) if nearer else np.array(SCREEN.widths)
        self.weights = _weights(derivative, weigh(derivative, derivative, second)[0])
        n, z = len(self.weights), _normals(len(self.weights))
        self.directions = z * self.weights  # (K, n), zero in columns in which the derivative is zero
        both, signs = np.array([1.0, -1.0]), np.where(z[0] > 0, 1.0, -1.0)
        small = np.multiply.outer(both, np.multiply.outer(self.widths, self.directions)).reshape(-1, n)
        line = np.multiply.outer(both, signs * np.minimum(self.weights, 1.0))
        wide = np.multiply.outer(SCREEN.wide, line).reshape(-1, n)
        unmoved = np.multiply.outer([self.widths[0], -SCREEN.wide[0]], signs * (self.weights == 0))
        self.displacements = np.vstack([np.zeros((1, n)), small, wide, unmoved])  # at most 1e-2

    def taken(self, values: Array, minus: Difference = np.subtract) -> "FirstLook":
        """Evaluate the values (p, m) at the `displacements` (p, n). `minus` subtracts two values."""
        centre = values[0]
        changes = minus(values[1:], centre)
        small, wide, unmoved = np.split(changes, [2 * len(self.widths) * SCREEN.directions, -2])
        ahead, behind = small.reshape(2, len(self.widths), SCREEN.directions, -1) / self.widths[:, None, None]
        size = np.abs(centre) if minus is np.subtract else np.ones(changes.shape[1])
        rounding = SCREEN.rounding * (size + np.abs(self.derivative).sum(axis=1))
        return FirstLook(self.derivative, self, ahead, -behind, wide.reshape(2, 2, -1), unmoved, rounding)


@dataclass(frozen=True, eq=False)
class FirstLook:
    """The differences of a function R^n -> R^m along a few directions from a point, to check `derivative` (m, n)."""

    derivative: Array
    plan: LookAt
    ahead: Array  # (s, K, m) one-sided quotients
    behind: Array
    wide: Array  # (2, 2, m) changes over SCREEN.wide, to both sides
    left_out: Array  # (2, m) changes along the columns in which the derivative is zero
    rounding: Array  # (m,) rounding of a value

    @property
    def size(self) -> Array:
        """The magnitude (m, n) to which the error of each entry is relative."""
        return weigh(self.derivative, self.derivative, self.plan.second)[0]

    @property
    def noticeable(self) -> Array:
        """The error (m, n) of each entry that would have been noticed with a probability of 1 - SCREEN.miss."""
        return np.asarray(_bound(self._gaps()).min(axis=0)[:, None] * self._per_weight)

    @property
    def difference(self) -> Array:
        """The matrix (m, n) that has the measured slopes along the directions and is nearest to the derivative."""
        gaps = self._gaps()
        best = np.argmin(_bound(gaps), axis=0)
        gap = np.take_along_axis(gaps, best[None, None], axis=0)[0]  # (K, m)
        error = np.linalg.lstsq(self.plan.directions * self._per_weight, gap, rcond=None)[0].T
        return np.asarray(self.derivative - error * self._per_weight)

    def certificate(self, scale: Array, *, told: str = "", **named: Any) -> Certificate:
        """Return the certificate that all entries agree, for a check that leaves no doubt."""
        plan, noticeable = self.plan, self.noticeable
        near = f"within {plan.widths[0]:.1g} of the scales, beyond which something changes, " if plan.nearer else ""
        statement = (
            f"{near}{len(plan.displacements)} steps along {SCREEN.directions} random directions leave no doubt: of "
            "single entries an error that large would have been noticed, of several together but for a probability of "
            f"{SCREEN.miss * (1 + plan.nearer):g}; differences of entries are the nearest that explain the slopes"
        )
        numbers = unscaled(scale, self.derivative, self.difference, noticeable, noticeable, self.size)
        codes, text = np.full(self.derivative.shape, AGREE), f"{statement}; {told}" if told else statement
        return Certificate(**numbers, codes=codes, scale=scale, second=plan.second, told=text, **named)

    def doubt(self) -> str:
        """Return the reason to compare every entry, or "" if the derivative is correct."""
        if np.any(self.left_out != 0):
            return "a column that is 0 in the derivative has an effect"
        gaps, moved = self._gaps(), self.plan.weights > 0
        allowed = LIMITS.power * np.min((self.plan.weights * self.size)[:, moved], axis=1, initial=np.inf)  # (m,)
        bounds = _bound(gaps)
        significant = bounds <= allowed
        hidden = _bound(np.broadcast_to(self.rounding / self.plan.widths[-1], gaps[0].shape))
        if not np.all(significant.any(axis=0)):
            return f"row {int(np.argmin(significant.any(axis=0)))} disagrees with the slopes along random directions"
        # The smallest steps decide: a gap there that exceeds rounding shows a discontinuity near the point.
        if not np.all(significant[-1] | (bounds[-1] <= hidden)):
            return "the slopes along random directions change with smaller steps"
        corners = self._corners()
        significant = corners <= np.maximum(allowed, hidden)
        if not np.all(significant[-1] & (corners <= allowed).any(axis=0) | (corners <= hidden).all(axis=0)):
            return "the forward and backward slopes do not approach each other"
        return "a row is constant near the point and changes farther away" if np.any(self._stairs()) else ""

    def _stairs(self) -> Flags:
        """Find rows (m,) that are flat at the point and change farther away, but not as h^2 and h^3 (a staircase)."""
        risen = np.abs(self.wide).max(axis=0).min(axis=0)
        weights = np.minimum(self.plan.weights, 1.0)
        predicted = np.linalg.norm(self.derivative * weights, axis=1) * SCREEN.wide[0]
        ahead, behind = self.wide[:, 0], self.wide[:, 1]
        left = predicted + SCREEN.flat * risen + self.rounding
        bent = np.ones(len(risen), dtype=bool)
        for half, order in (((ahead + behind) / 2, 2), ((ahead - behind) / 2, 3)):
            expected = half[0] * (SCREEN.wide[1] / SCREEN.wide[0]) ** order
            bent &= np.abs(half[1] - expected) <= SCREEN.alike * np.abs(expected) + left
        return np.asarray((predicted <= SCREEN.flat * risen) & (risen > self.rounding) & ~bent)

    @property
    def _per_weight(self) -> Array:
        """The reciprocal weights (n,), zero where the weight is zero."""
        weights = self.plan.weights
        return np.divide(1.0, weights, out=np.zeros_like(weights), where=weights > 0)

    def _gaps(self) -> Array:
        """Return the gaps (s - 1, K, m) to slopes with an error of order h^4, from wide to small steps."""
        return np.asarray(self.plan.directions @ self.derivative.T - richardson((self.ahead + self.behind) / 2))

    def _corners(self) -> Array:
        """Return (s - 2, m) the gap between forward and backward slopes, extrapolated to h = 0.

        Each value is the constant term of a fit with h and h^3 to three neighbouring widths.
        """
        bend, corners = (self.ahead - self.behind) / 2, []
        for first in range(len(self.plan.widths) - 2):
            h = self.plan.widths[first : first + 3]
            terms = np.stack([np.ones_like(h), h, h**3])
            corners.append(np.tensordot(np.linalg.solve(terms, [1.0, 0.0, 0.0]), bend[first : first + 3], axes=1))
        return _bound(np.array(corners))


def _bound(gaps: Array) -> Array:
    """Return, from gaps (..., K, m), bounds (..., m) that errors of rows exceed with probability SCREEN.miss."""
    return np.asarray(np.sqrt((gaps**2).sum(axis=-2) / SCREEN.quantile))


@cache
def _normals(n: int) -> Array:
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

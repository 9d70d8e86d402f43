"""The Jacobian (m, n) of a step along a few random directions: whether all of its entries stand, or must be looked at.

A wrong entry is seen along a random direction with probability one; how well depends on its size beside all others.
Each column is moved by a weight w times a normal number z, so that the entry that matters least is as well seen as it
can be. Along a direction the gap of row i is sum_j e_j z_j, where e_j = w_j times the error of entry (i, j). Over K
directions the sum of its squares is below q |e|^2 with probability `miss` at most, whatever the differences themselves
leave: they only make the gaps larger. So an error that would matter is missed with a probability below `miss`, and one
in a single entry never, as no column of z is small.

What is smooth at the point is seen by the same differences: a corner stays in the gap between slopes ahead and behind,
a jump makes that gap grow, stairs make slopes differ between widths. Whatever is in doubt is no verdict: it is a reason
to look at every entry (see `differences`).
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
    """How a derivative (m, n) is screened along a few random directions."""

    directions: int = 6
    miss: float = 1e-4
    quantile: float = 0.17209  # where the distribution of chi^2 with 6 degrees of freedom is `miss`
    least: float = 1.5  # the sum of squares of a column of z: six normal numbers have 6
    widths: tuple[float, ...] = tuple(10.0 ** (-k / 2) for k in (9, 10, 11, 12))  # friction turns within 1e-4 m/s
    nearer: float = 0.1  # of these: where what is there leaves a doubt, and what is at the point may leave none
    wide: tuple[float, float] = (8e-3, 4e-3)  # of all columns: what is flat there, but for jumps, is stairs
    flat: float = 1e-2  # of the change over `wide`, likewise `alike`
    alike: float = 0.2
    seeded: int = 11
    largest: float = 3.0  # of the normal numbers
    widest: float = 1e2  # a weight over the middle one: no column is moved by more than 1e-2
    rounds: int = 20  # of balancing weights, at most
    balanced: float = 1e-2  # by what part of them the last round may change one
    rounding: float = 3e-15  # of the sums in a value: 30 of its scatter


SCREEN = ScreenOptions()


class LookAt:
    """Where a function R^n -> R^m is to be taken to look at its derivative (m, n), by the scaled displacements."""

    def __init__(self, derivative: Array, second: Scales | None = None, *, nearer: bool = False):
        self.derivative, self.second, self.nearer = derivative, second, nearer
        self.widths = SCREEN.nearer * np.array(SCREEN.widths) if nearer else np.array(SCREEN.widths)
        self.weights = _weights(derivative, weigh(derivative, derivative, second)[0])
        n, z = len(self.weights), _normals(len(self.weights))
        self.directions = z * self.weights  # (K, n) zero where the derivative is zero in all rows
        both, signs = np.array([1.0, -1.0]), np.where(z[0] > 0, 1.0, -1.0)
        small = np.multiply.outer(both, np.multiply.outer(self.widths, self.directions)).reshape(-1, n)
        line = np.multiply.outer(both, signs * np.minimum(self.weights, 1.0))
        wide = np.multiply.outer(SCREEN.wide, line).reshape(-1, n)
        unmoved = np.multiply.outer([self.widths[0], -SCREEN.wide[0]], signs * (self.weights == 0))
        self.displacements = np.vstack([np.zeros((1, n)), small, wide, unmoved])  # by at most 1e-2

    def taken(self, values: Array, minus: Difference = np.subtract) -> "FirstLook":
        """What the values (p, m) at the `displacements` (p, n) say; `minus` subtracts two of them."""
        centre = values[0]
        changes = values[1:] - centre if minus is np.subtract else np.array([minus(v, centre) for v in values[1:]])
        small, wide, unmoved = np.split(changes, [2 * len(self.widths) * SCREEN.directions, -2])
        ahead, behind = small.reshape(2, len(self.widths), SCREEN.directions, -1) / self.widths[:, None, None]
        size = np.abs(centre) if minus is np.subtract else np.ones(changes.shape[1])
        rounding = SCREEN.rounding * (size + np.abs(self.derivative).sum(axis=1))
        return FirstLook(self.derivative, self, ahead, -behind, wide.reshape(2, 2, -1), unmoved, rounding)


@dataclass(frozen=True, eq=False)
class FirstLook:
    """What a function R^n -> R^m does along a few directions from a point; `derivative` (m, n) is that in question."""

    derivative: Array
    plan: LookAt
    ahead: Array  # (s, K, m) one-sided quotients
    behind: Array
    wide: Array  # (2, 2, m) changes over SCREEN.wide, to both sides
    left_out: Array  # (2, m) changes by the columns that are zero
    rounding: Array  # (m,) of a value

    @property
    def size(self) -> Array:
        """(m, n) what an error of each entry is measured by."""
        return weigh(self.derivative, self.derivative, self.plan.second)[0]

    @property
    def noticeable(self) -> Array:
        """(m, n) the error of each entry that would have been noticed, but for a probability of SCREEN.miss."""
        return np.asarray(_bound(self._gaps()).min(axis=0)[:, None] * self._per_weight)

    @property
    def difference(self) -> Array:
        """(m, n) the matrix nearest to the derivative, by weights, that has the slopes along the directions."""
        gaps = self._gaps()
        best = np.argmin(_bound(gaps), axis=0)
        gap = np.take_along_axis(gaps, best[None, None], axis=0)[0]  # (K, m)
        error = np.linalg.lstsq(self.plan.directions * self._per_weight, gap, rcond=None)[0].T
        return np.asarray(self.derivative - error * self._per_weight)

    def certificate(self, scale: Array, *, told: str = "", **named: Any) -> Certificate:
        """That the derivative is the function's, in which this look leaves no doubt."""
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
        """Why every entry has to be looked at; empty where the derivative is that of the function."""
        if np.any(self.left_out != 0):
            return "a column that is 0 in the derivative has an effect"
        gaps, moved = self._gaps(), self.plan.weights > 0
        allowed = LIMITS.power * np.min((self.plan.weights * self.size)[:, moved], axis=1, initial=np.inf)  # (m,)
        bounds = _bound(gaps)
        significant = bounds <= allowed
        hidden = _bound(np.broadcast_to(self.rounding / self.plan.widths[-1], gaps[0].shape))
        if not np.all(significant.any(axis=0)):
            return f"row {int(np.argmin(significant.any(axis=0)))} disagrees with the slopes along random directions"
        # The smallest steps decide: where they say something else it is rounding, or there is something at the point.
        if not np.all(significant[-1] | (bounds[-1] <= hidden)):
            return "the slopes along random directions change with smaller steps"
        corners = self._corners()
        significant = corners <= np.maximum(allowed, hidden)
        if not np.all(significant[-1] & (corners <= allowed).any(axis=0) | (corners <= hidden).all(axis=0)):
            return "the forward and backward slopes do not approach each other"
        return "a row is constant near the point and changes farther away" if np.any(self._stairs()) else ""

    def _stairs(self) -> Flags:
        """(m,) rows that are flat here and change to both sides farther away, not as smooth curves do, h^2 and h^3."""
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
        """(n,) zero where the weight is."""
        weights = self.plan.weights
        return np.divide(1.0, weights, out=np.zeros_like(weights), where=weights > 0)

    def _gaps(self) -> Array:
        """(s - 1, K, m) of slopes with an error of order h^4, from wide steps to small."""
        return np.asarray(self.plan.directions @ self.derivative.T - richardson((self.ahead + self.behind) / 2))

    def _corners(self) -> Array:
        """(s - 2, m) what is left of the gap between both sides at no width, where it shrinks as h + h^3.

        Of three neighbouring widths each.
        """
        bend, corners = (self.ahead - self.behind) / 2, []
        for first in range(len(self.plan.widths) - 2):
            h = self.plan.widths[first : first + 3]
            terms = np.stack([np.ones_like(h), h, h**3])
            corners.append(np.tensordot(np.linalg.solve(terms, [1.0, 0.0, 0.0]), bend[first : first + 3], axes=1))
        return _bound(np.array(corners))


def _bound(gaps: Array) -> Array:
    """(..., m) of gaps (..., K, m): the error of a row is smaller but for a probability of SCREEN.miss."""
    return np.asarray(np.sqrt((gaps**2).sum(axis=-2) / SCREEN.quantile))


@cache
def _normals(n: int) -> Array:
    """(K, n) always the same ones, no column of which is small."""
    random = np.random.default_rng(SCREEN.seeded)
    z = random.standard_normal((SCREEN.directions, n))
    while np.any(small := (z**2).sum(axis=0) < SCREEN.least):
        z[:, small] = random.standard_normal((SCREEN.directions, int(np.count_nonzero(small))))
    return frozen(np.clip(z, -SCREEN.largest, SCREEN.largest))


def _weights(a: Array, size: Array) -> Array:
    """(n,) such that the least entry that matters in a column is as large a part of its row as in any other column."""
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
    """The median of `values` (n,), without what makes NumPy's own twenty times as slow."""
    values, half = np.sort(values), len(values) // 2
    return float(values[half] if len(values) % 2 else (values[half - 1] + values[half]) / 2)

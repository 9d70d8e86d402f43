"""A derivative (m, n) along a few random directions: whether all of its entries stand, or must be looked at one by one.

A wrong entry is seen along a random direction with probability one; how well depends on its size beside all others.
Each column is moved by a weight w times a normal number z, so that the entry that matters least is as well seen as it
can be. Along a direction the gap of row i is sum_j e_j z_j, where e_j = w_j times the error of entry (i, j). Over K
directions the sum of its squares is below q |e|^2 with probability MISS at most, whatever the differences themselves
leave: they only make the gaps larger. So an error that would matter is missed with a probability below MISS, and one in
a single entry never, as no column of z is small.

What is smooth at the point is seen by the same differences: a corner stays in the gap between slopes ahead and behind,
a jump makes that gap grow, stairs make slopes differ between widths. Whatever is in doubt is no verdict: it is a reason
to look at every entry (see `neighbourhood`).
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.differences import RATIO_SQUARED, Difference
from drake_diff.certificates.certificate import Certificate
from drake_diff.certificates.judgement import POWER, VERDICTS, Flags, Scales, weighed

DIRECTIONS = 6
MISS, QUANTILE = 1e-4, 0.17209  # where the distribution of chi^2 with 6 degrees of freedom is MISS
LEAST = 1.5  # the sum of squares of a column of z: six normal numbers have 6
WIDTHS = tuple(10.0 ** (-k / 2) for k in (9, 10, 11, 12))  # 3e-5 ... 1e-6: friction turns within 1e-4 m/s
NEARER = 0.1  # of these: where what is there leaves a doubt, and what is at the point may leave none
WIDE = 8e-3, 4e-3  # of all columns at once, to both sides: what is flat there, but for jumps, is stairs
FLAT, ALIKE = 1e-2, 0.2  # of the change: see WIDE
SEEDED = 11
LARGEST, WIDEST = 3.0, 1e2  # of the numbers, and a weight over the middle one: no column is moved by more than 1e-2
ROUNDS, BALANCED = 20, 1e-2  # of balancing weights, at most, and by what part of them the last round may change one
ROUNDING = 3e-15  # of the sums in a value: 30 of its scatter
TINY = 1e-300


@dataclass(frozen=True, eq=False)
class FirstLook:
    """What a function R^n -> R^m does along a few directions from a point; `derivative` (m, n) is that in question."""

    derivative: Array
    second: Scales | None
    weights: Array  # (n,) zero where the derivative is zero in all rows
    directions: Array  # (K, n)
    widths: tuple[float, ...]  # (s,) of the steps along them
    ahead: Array  # (s, K, m) one-sided quotients
    behind: Array
    wide: Array  # (2, 2, m) changes over WIDE, to both sides
    left_out: Array  # (2, m) changes by the columns that are zero
    rounding: Array  # (m,) of a value

    @property
    def slopes(self) -> Array:
        """(s - 1, K, m) along the directions, from wide steps to small, with an error of order h^4."""
        central = (self.ahead + self.behind) / 2
        return np.asarray(central[1:] + (central[1:] - central[:-1]) / (RATIO_SQUARED - 1))

    @property
    def noticeable(self) -> Array:
        """(m, n) the error of each entry that would have been noticed, but for a probability of MISS."""
        bound = self._bound(self._gaps()).min(axis=0)
        return np.asarray(bound[:, None] * self._per_weight)

    @property
    def size(self) -> Array:
        """(m, n) what an error of each entry is measured by."""
        return weighed(self.derivative, self.second)

    @property
    def difference(self) -> Array:
        """(m, n) the matrix nearest to the derivative, by weights, that has the slopes along the directions."""
        gaps = self._gaps()
        best = np.argmin(self._bound(gaps), axis=0)
        gap = np.take_along_axis(gaps, best[None, None], axis=0)[0]  # (K, m)
        error = np.linalg.lstsq(self.directions * self._per_weight, gap, rcond=None)[0].T
        return np.asarray(self.derivative - error * self._per_weight)

    @property
    def told(self) -> str:
        """What the certificate rests on."""
        points = 2 * len(self.widths) * DIRECTIONS + 2 * len(WIDE) + 3
        near = f"within {self.widths[0]:.1g} of the scales, beyond which something changes, " if self.is_nearer else ""
        return (
            f"{near}{points} steps along {DIRECTIONS} random directions leave no doubt: of single entries an error "
            "that large would have been noticed, of several together but for a probability of "
            f"{MISS * (1 + self.is_nearer):g}; differences of entries are the nearest that explain the slopes"
        )

    @property
    def is_nearer(self) -> bool:
        """Whether steps are shorter than at first."""
        return self.widths != WIDTHS

    def doubt(self) -> str:
        """Why every entry has to be looked at; empty where the derivative is that of the function."""
        if np.any(self.left_out != 0):
            return "what the derivative says to have no effect has one"
        gaps, moved = self._gaps(), self.weights > 0
        allowed = POWER * np.min((self.weights * self.size)[:, moved], axis=1, initial=np.inf)  # (m,)
        bounds = self._bound(gaps)
        told = bounds <= allowed
        hidden = self._bound(np.broadcast_to(self.rounding / self.widths[-1], gaps[0].shape))
        if not np.all(told.any(axis=0)):
            return f"along random directions row {int(np.argmin(told.any(axis=0)))} is another one"
        # The smallest steps decide: where they say something else it is rounding, or there is something at the point.
        if not np.all(told[-1] | (bounds[-1] <= hidden)):
            return "along random directions slopes are others over smaller steps"
        corners = self._corners()
        told = corners <= np.maximum(allowed, hidden)
        if not np.all(told[-1] & (corners <= allowed).any(axis=0) | (corners <= hidden).all(axis=0)):
            return "slopes ahead and behind do not approach each other"
        if np.any(self._stairs()):
            return "a row is flat here, and changes farther away"
        return ""

    def _stairs(self) -> Flags:
        """(m,) rows that are flat here and change to both sides farther away, not as smooth curves do, h^2 and h^3."""
        risen = np.abs(self.wide).max(axis=0).min(axis=0)
        said = np.linalg.norm(self.derivative * np.minimum(self.weights, 1.0), axis=1) * WIDE[0]
        ahead, behind = self.wide[:, 0], self.wide[:, 1]
        left = said + FLAT * risen + self.rounding
        bent = np.ones(len(risen), dtype=bool)
        for part, order in (((ahead + behind) / 2, 2), ((ahead - behind) / 2, 3)):
            expected = part[0] * (WIDE[1] / WIDE[0]) ** order
            bent &= np.abs(part[1] - expected) <= ALIKE * np.abs(expected) + left
        return np.asarray((said <= FLAT * risen) & (risen > self.rounding) & ~bent)

    @property
    def _per_weight(self) -> Array:
        """(n,) zero where the weight is."""
        return np.array([1 / w if w else 0.0 for w in self.weights.tolist()])

    def _gaps(self) -> Array:
        return np.asarray(self.directions @ self.derivative.T - self.slopes)

    def _bound(self, gaps: Array) -> Array:
        """(..., m) of gaps (..., K, m): the error of a row is smaller but for a probability of MISS."""
        return np.asarray(np.sqrt((gaps**2).sum(axis=-2) / QUANTILE))

    def _corners(self) -> Array:
        """(s - 2, m) the same of what is left of the gap between both sides at no width, where it shrinks as h + h^3.

        Of three neighbouring widths each.
        """
        bend, found = (self.ahead - self.behind) / 2, []
        for first in range(len(self.widths) - 2):
            h = np.array(self.widths[first : first + 3])
            terms = np.stack([np.ones_like(h), h, h**3])
            found.append(np.tensordot(np.linalg.solve(terms, [1.0, 0.0, 0.0]), bend[first : first + 3], axes=1))
        return self._bound(np.array(found))

    def of(self, derivative: Array) -> "FirstLook":
        """The same of another derivative that is zero in the same columns."""
        parts = {name: getattr(self, name) for name in FirstLook.__dataclass_fields__}
        return FirstLook(**parts | {"derivative": derivative})


def certificate_by(
    look: FirstLook,
    *,
    scale: Array,
    rows: tuple[str, ...],
    columns: tuple[str, ...],
    told: str,
    method: str,
    subject: str,
) -> Certificate:
    """The certificate of a derivative in which `look` leaves no doubt."""
    noticeable = frozen(look.noticeable / scale)
    return Certificate(
        rows=rows,
        columns=columns,
        derivative=frozen(look.derivative / scale),
        difference=frozen(look.difference / scale),
        tolerance=noticeable,
        noticeable=noticeable,
        size=frozen(look.size / scale),
        codes=np.full(look.derivative.shape, VERDICTS.index("agree")),
        reasons={},
        around=None,
        scale=scale,
        stopped=0.0,
        second=look.second,
        told="; ".join(text for text in (look.told, told) if text),
        method=method,
        subject=subject,
    )


class LookAt:
    """Where a function R^n -> R^m is to be taken to look at its derivative (m, n), by the scaled displacements."""

    def __init__(self, derivative: Array, second: Scales | None = None, *, nearer: bool = False):
        self.derivative, self.second = derivative, second
        self.widths = tuple(NEARER * h for h in WIDTHS) if nearer else WIDTHS
        self.weights = _weights(derivative, weighed(derivative, second))
        n, z = len(self.weights), _normals(len(self.weights))
        self.directions = z * self.weights
        small = np.multiply.outer([1.0, -1.0], np.multiply.outer(self.widths, self.directions)).reshape(-1, n)
        signs = np.where(z[0] > 0, 1.0, -1.0)
        line = signs * np.minimum(self.weights, 1.0)
        wide = np.multiply.outer(WIDE, np.multiply.outer([1.0, -1.0], line)).reshape(-1, n)
        unmoved = np.multiply.outer([self.widths[0], -WIDE[0]], signs * (self.weights == 0))
        self.displacements = np.vstack([np.zeros((1, n)), small, wide, unmoved])  # by at most 1e-2

    def taken(self, values: Array, minus: Difference = np.subtract) -> FirstLook:
        """What the values (p, m) at the `displacements` (p, n) say; `minus` subtracts two of them."""
        centre = values[0]
        changes = values[1:] - centre if minus is np.subtract else np.array([minus(v, centre) for v in values[1:]])
        small, wide, unmoved = np.split(changes, [2 * len(self.widths) * DIRECTIONS, -2])
        sides = small.reshape(2, len(self.widths), DIRECTIONS, -1) / np.array(self.widths)[:, None, None]
        size = np.abs(centre) if minus is np.subtract else np.ones(changes.shape[1])
        return FirstLook(
            derivative=self.derivative,
            second=self.second,
            weights=self.weights,
            directions=self.directions,
            widths=self.widths,
            ahead=sides[0],
            behind=-sides[1],
            wide=wide.reshape(2, 2, -1),
            left_out=unmoved,
            rounding=ROUNDING * (size + np.abs(self.derivative).sum(axis=1)),
        )


@cache
def _normals(n: int) -> Array:
    """(K, n) always the same ones, no column of which is small."""
    random = np.random.default_rng(SEEDED)
    z = random.standard_normal((DIRECTIONS, n))
    while np.any(small := (z**2).sum(axis=0) < LEAST):
        z[:, small] = random.standard_normal((DIRECTIONS, int(np.count_nonzero(small))))
    return frozen(np.clip(z, -LARGEST, LARGEST))


def _weights(a: Array, size: Array) -> Array:
    """(n,) such that the least entry that matters in a column is as large a part of its row as in any other column."""
    moved = np.any(a != 0, axis=0)
    w = np.where(moved, 1.0, 0.0)
    if not moved.any():
        return w
    found = np.abs(a)
    rows = found.max(axis=1) > 0
    found, least = found[rows], 1 / size[rows]
    for _ in range(ROUNDS):
        need = ((found * w).max(axis=1)[:, None] * least).max(axis=0)
        last, w = w, np.where(moved, np.sqrt(w * need / _middle(need[moved])), 0.0)
        if np.all(np.abs(w - last) <= BALANCED * w):
            break
    return np.asarray(np.clip(w / _middle(w[moved]), 1 / WIDEST, WIDEST) * moved)


def _middle(values: Array) -> float:
    """The median of `values` (n,), without what makes NumPy's own twenty times as slow."""
    values, half = np.sort(values), len(values) // 2
    return float(values[half] if len(values) % 2 else (values[half - 1] + values[half]) / 2)

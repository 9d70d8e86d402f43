"""A derivative along a few random directions: what that tells of its entries, and what it cannot.

Of the Jacobian (m, n) of a step (`FirstLook`): whether all of its entries stand, or must be looked at one by one.

A wrong entry is seen along a random direction with probability one; how well depends on its size beside all others.
Each column is moved by a weight w times a normal number z, so that the entry that matters least is as well seen as it
can be. Along a direction the gap of row i is sum_j e_j z_j, where e_j = w_j times the error of entry (i, j). Over K
directions the sum of its squares is below q |e|^2 with probability MISS at most, whatever the differences themselves
leave: they only make the gaps larger. So an error that would matter is missed with a probability below MISS, and one in
a single entry never, as no column of z is small.

What is smooth at the point is seen by the same differences: a corner stays in the gap between slopes ahead and behind,
a jump makes that gap grow, stairs make slopes differ between widths. Whatever is in doubt is no verdict: it is a reason
to look at every entry (see `neighbourhood`).

Of the gradient (n,) of a rollout (`Probe`) each difference takes two rollouts. Those along a direction v tell the gap
(g - g*)' v between the gradient g that is stated and the true one. Let e be the error in units in which each entry that
matters weighs the same, and z = v in these units a vector of independent normal numbers. Then each gap is e' z plus
what the differences themselves leave, and whatever that is, m gaps are in sum of squares below q |e|^2 with probability
at most P(chi^2_m <= q). So |e| <= U = sqrt(sum gap^2 / q) but for that probability: no model of the noise is needed, a
noisy difference merely makes U large.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.differences import Difference, richardson
from drake_diff.certificates.certificate import LIMITS, VERDICTS, Certificate, Flags, Scales, weighed


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
    wide: Array  # (2, 2, m) changes over SCREEN.wide, to both sides
    left_out: Array  # (2, m) changes by the columns that are zero
    rounding: Array  # (m,) of a value

    @property
    def slopes(self) -> Array:
        """(s - 1, K, m) along the directions, from wide steps to small, with an error of order h^4."""
        central = (self.ahead + self.behind) / 2
        return richardson(central)

    @property
    def noticeable(self) -> Array:
        """(m, n) the error of each entry that would have been noticed, but for a probability of SCREEN.miss."""
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
    def statement(self) -> str:
        """What the certificate rests on."""
        points = 2 * len(self.widths) * SCREEN.directions + 2 * len(SCREEN.wide) + 3
        near = f"within {self.widths[0]:.1g} of the scales, beyond which something changes, " if self.is_nearer else ""
        return (
            f"{near}{points} steps along {SCREEN.directions} random directions leave no doubt: of single entries an "
            "error that large would have been noticed, of several together but for a probability of "
            f"{SCREEN.miss * (1 + self.is_nearer):g}; differences of entries are the nearest that explain the slopes"
        )

    @property
    def is_nearer(self) -> bool:
        """Whether steps are shorter than at first."""
        return self.widths != SCREEN.widths

    def doubt(self) -> str:
        """Why every entry has to be looked at; empty where the derivative is that of the function."""
        if np.any(self.left_out != 0):
            return "what the derivative says to have no effect has one"
        gaps, moved = self._gaps(), self.weights > 0
        allowed = LIMITS.power * np.min((self.weights * self.size)[:, moved], axis=1, initial=np.inf)  # (m,)
        bounds = self._bound(gaps)
        significant = bounds <= allowed
        hidden = self._bound(np.broadcast_to(self.rounding / self.widths[-1], gaps[0].shape))
        if not np.all(significant.any(axis=0)):
            return f"along random directions row {int(np.argmin(significant.any(axis=0)))} is another one"
        # The smallest steps decide: where they say something else it is rounding, or there is something at the point.
        if not np.all(significant[-1] | (bounds[-1] <= hidden)):
            return "along random directions slopes are others over smaller steps"
        corners = self._corners()
        significant = corners <= np.maximum(allowed, hidden)
        if not np.all(significant[-1] & (corners <= allowed).any(axis=0) | (corners <= hidden).all(axis=0)):
            return "slopes ahead and behind do not approach each other"
        if np.any(self._stairs()):
            return "a row is flat here, and changes farther away"
        return ""

    def _stairs(self) -> Flags:
        """(m,) rows that are flat here and change to both sides farther away, not as smooth curves do, h^2 and h^3."""
        risen = np.abs(self.wide).max(axis=0).min(axis=0)
        predicted = np.linalg.norm(self.derivative * np.minimum(self.weights, 1.0), axis=1) * SCREEN.wide[0]
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
        return np.array([1 / w if w else 0.0 for w in self.weights.tolist()])

    def _gaps(self) -> Array:
        return np.asarray(self.directions @ self.derivative.T - self.slopes)

    def _bound(self, gaps: Array) -> Array:
        """(..., m) of gaps (..., K, m): the error of a row is smaller but for a probability of SCREEN.miss."""
        return np.asarray(np.sqrt((gaps**2).sum(axis=-2) / SCREEN.quantile))

    def _corners(self) -> Array:
        """(s - 2, m) the same of what is left of the gap between both sides at no width, where it shrinks as h + h^3.

        Of three neighbouring widths each.
        """
        bend, corners = (self.ahead - self.behind) / 2, []
        for first in range(len(self.widths) - 2):
            h = np.array(self.widths[first : first + 3])
            terms = np.stack([np.ones_like(h), h, h**3])
            corners.append(np.tensordot(np.linalg.solve(terms, [1.0, 0.0, 0.0]), bend[first : first + 3], axes=1))
        return self._bound(np.array(corners))


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
        told="; ".join(text for text in (look.statement, told) if text),
        method=method,
        subject=subject,
    )


class LookAt:
    """Where a function R^n -> R^m is to be taken to look at its derivative (m, n), by the scaled displacements."""

    def __init__(self, derivative: Array, second: Scales | None = None, *, nearer: bool = False):
        self.derivative, self.second = derivative, second
        self.widths = tuple(SCREEN.nearer * h for h in SCREEN.widths) if nearer else SCREEN.widths
        self.weights = _weights(derivative, weighed(derivative, second))
        n, z = len(self.weights), _normals(len(self.weights))
        self.directions = z * self.weights
        small = np.multiply.outer([1.0, -1.0], np.multiply.outer(self.widths, self.directions)).reshape(-1, n)
        signs = np.where(z[0] > 0, 1.0, -1.0)
        line = signs * np.minimum(self.weights, 1.0)
        wide = np.multiply.outer(SCREEN.wide, np.multiply.outer([1.0, -1.0], line)).reshape(-1, n)
        unmoved = np.multiply.outer([self.widths[0], -SCREEN.wide[0]], signs * (self.weights == 0))
        self.displacements = np.vstack([np.zeros((1, n)), small, wide, unmoved])  # by at most 1e-2

    def taken(self, values: Array, minus: Difference = np.subtract) -> FirstLook:
        """What the values (p, m) at the `displacements` (p, n) say; `minus` subtracts two of them."""
        centre = values[0]
        changes = values[1:] - centre if minus is np.subtract else np.array([minus(v, centre) for v in values[1:]])
        small, wide, unmoved = np.split(changes, [2 * len(self.widths) * SCREEN.directions, -2])
        sides = small.reshape(2, len(self.widths), SCREEN.directions, -1) / np.array(self.widths)[:, None, None]
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
            rounding=SCREEN.rounding * (size + np.abs(self.derivative).sum(axis=1)),
        )


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


@dataclass(frozen=True)
class SampleOptions:
    """How a rollout's gradient is checked along a few random directions."""

    miss: float = 1e-3  # the probability that an error is missed
    # Where the distribution of chi^2 with `second` and with `first` degrees of freedom is `miss` / 2, as each of two
    # step sizes may agree.
    quantiles: tuple[float, float] = (0.06392, 0.15810)
    limit: float = 1e-2  # the error of an entry that must be noticed
    # An entry matters that is at least `least` of the largest of its kind. A kind matters whose largest is at least
    # `floor` of the largest of all, each entry times the scale of its column.
    least: float = 1e-2
    floor: float = 1e-6
    first: int = 5
    second: int = 4  # directions at the first step size, and at the second
    step: float = 1e-6
    # The second step size over the first: finer where the loss bends by more than `bent` of its slope, else coarser.
    finer: float = 1e-1
    coarser: float = 10.0
    bent: float = 1e-2
    rounding: float = 1e-14  # of a loss along a rollout
    widest: float = 1e-2
    steady: float = 0.25  # numbers at two step sizes that differ by this part, or less, are not the differences' own
    alone: float = 1e-3  # of the squared gaps may be left by the one entry that explains them
    rollouts: int = 20  # at most
    doubt: float = 0.05  # of the derivative along a direction: what Drake's solver, stopping early, changed it by
    elsewhere: float = 1e-3  # of the scale: how far from the motion a policy is led before it is asked again


SAMPLE = SampleOptions()

TINY = 1e-100


@dataclass(frozen=True, eq=False)
class Gaps:
    """At one step size, of m directions, in the unit in which an entry that matters is 1."""

    step: float
    stated: Array  # (m,) the slope along each direction
    gap: Array  # (m,) that less the differences'
    bend: Array  # (m,) half of what the quotients of both sides differ by
    rounding: float  # what the loss's rounding makes of a gap

    def __len__(self) -> int:
        return len(self.gap)

    def __str__(self) -> str:
        worst = int(np.argmax(np.abs(self.gap)))
        stated, differenced = self.stated[worst], self.stated[worst] - self.gap[worst]
        return (
            f"along direction {worst} the gradient states {stated:.6g} and differences say {differenced:.6g}, in units "
            "of an entry that matters"
        )

    @property
    def bound(self) -> float:
        """U: the error is smaller, but for a probability of `SAMPLE.miss` / 2, as two step sizes are tried."""
        return _bound(self.gap)

    @property
    def kink(self) -> float:
        """The same of the slope's jump at the point."""
        return _bound(self.bend)


def weights(contribution: Array, kinds: NDArray[np.intp]) -> Array:
    """(n,) what makes an entry that matters 1; `contribution` (n,) are the entries' sizes, `kinds` (n,) their kinds."""
    of_kind = np.zeros(int(np.max(kinds)) + 1)
    np.maximum.at(of_kind, kinds, contribution)
    floor = max(SAMPLE.floor * float(np.max(contribution)), TINY)
    return 1 / np.maximum(np.maximum(contribution, SAMPLE.least * of_kind[kinds]), floor)


@dataclass(frozen=True, eq=False)
class Probe:
    """Rollouts along random directions around one point; `f` takes displacements (K, n) and gives losses (K,)."""

    f: Callable[[Array], Array]
    derivative: Array  # (n,)
    weight: Array  # (n,)
    seed: int

    @property
    def reach(self) -> float:
        """What the directions are shortened by, so that no entry is moved by more than its scale times a normal."""
        return 1 / float(np.max(self.weight))

    def normals(self, count: int) -> Array:
        """(count, n) the same ones first."""
        return np.random.default_rng(self.seed).standard_normal((SAMPLE.first, len(self.weight)))[:count]

    def first(self, loss: float, count: int) -> Gaps:
        """At the usual step size, but no smaller than the rounding of a loss of this size allows."""
        return self.gaps(loss, float(np.clip(SAMPLE.step, self._least(loss), SAMPLE.widest)), count)

    def second(self, loss: float, first: Gaps, count: int) -> Gaps | None:
        """At another step size; None where there is none."""
        bent = _size(first.bend) > SAMPLE.bent * _size(first.stated)
        step = SAMPLE.finer * first.step if bent else SAMPLE.coarser * first.step
        step = step if step >= self._least(loss) else SAMPLE.coarser * first.step
        return self.gaps(loss, step, count) if step <= SAMPLE.widest else None

    def _least(self, loss: float) -> float:
        """Where rounding is a tenth of what is allowed."""
        return 10 * SAMPLE.rounding * abs(loss) / (SAMPLE.limit * self.reach)

    def gaps(self, loss: float, step: float, count: int) -> Gaps:
        """Of the first `count` directions, `loss` being the one at the point."""
        z = self.normals(count)
        v = self.reach * self.weight * z
        values = self.f(np.vstack([step * v, -step * v]))
        ahead, behind = values[:count], values[count:]
        unit = step * self.reach
        stated = (v @ self.derivative) / self.reach
        bend = ((ahead - loss) - (loss - behind)) / (2 * unit)
        return Gaps(step, stated, stated - (ahead - behind) / (2 * unit), bend, SAMPLE.rounding * abs(loss) / unit)

    def alone(self, gaps: Gaps) -> tuple[int, float] | None:
        """The entry whose error alone explains the gaps, and that error; None where no single one does."""
        z = self.normals(len(gaps))
        size = (z**2).sum(axis=0)
        error = (gaps.gap @ z) / size
        left = gaps.gap @ gaps.gap - error**2 * size
        j = int(np.argmin(left))
        return (j, float(error[j] / self.weight[j])) if left[j] <= SAMPLE.alone * (gaps.gap @ gaps.gap) else None


def judge(first: Gaps, second: Gaps | None, doubt: float) -> tuple[str, str]:
    """The verdict and its reason; `doubt` is the root mean square of gaps that a solver's early stop may leave."""
    if second is None:
        return (
            ("agree", "")
            if max(first.bound, first.kink) <= SAMPLE.limit
            else ("undecided", "no second step size is possible")
        )
    fine, coarse = sorted((first, second), key=lambda gaps: gaps.step)
    grown, threshold = coarse.step / fine.step, max(doubt, 100 * fine.rounding)
    for near, far, why in (
        (fine.bend, coarse.bend, "the loss has a corner: the slopes to both sides do not approach each other"),
        (fine.bend, grown * coarse.bend, "the loss jumps: its quotients grow as the step shrinks"),
        (fine.gap, grown * coarse.gap, "the loss jumps: its quotients grow as the step shrinks"),
    ):
        if fine.kink > SAMPLE.limit and _steady(near, far) and _size(near) > threshold:
            return "discontinuous", why
    if min(first.bound, second.bound) <= SAMPLE.limit:
        return "agree", ""
    if _steady(fine.gap, coarse.gap) and _size(coarse.gap) > max(doubt, coarse.rounding):
        return "disagree", "the gap is the same at both step sizes"
    return "undecided", "what the differences leave is more than what must be noticed"


def _bound(values: Array) -> float:
    return float(np.sqrt(values @ values / SAMPLE.quantiles[len(values) - SAMPLE.second]))


def _steady(near: Array, far: Array) -> bool:
    """Whether two step sizes tell the same of the directions that they share."""
    both = min(len(near), len(far))
    near, far = near[:both], far[:both]
    return _size(near - far) <= SAMPLE.steady * min(_size(near), _size(far))


def _size(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))

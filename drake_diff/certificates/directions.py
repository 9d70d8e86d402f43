"""The check of a gradient by a few rollouts along random directions, and how small an error it would have noticed.

Differences along a direction v tell the gap (g - g*)' v between the gradient g that is stated and the true one. Let e
be the error in units in which each entry that matters weighs the same, and z = v in these units a vector of independent
normal numbers. Then each gap is e' z plus what the differences themselves leave, and whatever that is, m gaps are in
sum of squares below q |e|^2 with probability at most P(chi^2_m <= q). So |e| <= U = sqrt(sum gap^2 / q) but for that
probability: no model of the noise is needed, a noisy difference merely makes U large.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array

MISS = 1e-3  # the probability that an error is missed
# Where the distribution of chi^2 with 4 and with 5 degrees of freedom is MISS / 2: each of two step sizes may agree.
QUANTILE = {4: 0.06392, 5: 0.15810}
LIMIT = 1e-2  # the error of an entry that must be noticed
# An entry matters that is at least LEAST of the largest of its kind. A kind matters whose largest is at least FLOOR of
# the largest of all, each entry times the scale of its column.
LEAST, FLOOR = 1e-2, 1e-6
FIRST, SECOND = 5, 4  # directions at the first step size, and at the second
STEP = 1e-6
# The second step size over the first: finer where the loss bends by more than BENT of its slope, else coarser.
FINER, COARSER, BENT = 1e-1, 10.0, 1e-2
ROUNDING = 1e-14  # of a loss along a rollout
WIDEST = 1e-2
TINY = 1e-100
STEADY = 0.25  # numbers at two step sizes that differ by this part, or less, are not the differences' own
ALONE = 1e-3  # of the squared gaps may be left by the one entry that explains them


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
        at = int(np.argmax(np.abs(self.gap)))
        stated, found = self.stated[at], self.stated[at] - self.gap[at]
        return (
            f"along direction {at} the gradient states {stated:.6g} and differences say {found:.6g}, in units of an "
            "entry that matters"
        )

    @property
    def bound(self) -> float:
        """U: the error is smaller than this, but for a probability of MISS / 2, as two step sizes are tried."""
        return _bound(self.gap)

    @property
    def kink(self) -> float:
        """The same of the slope's jump at the point."""
        return _bound(self.bend)


def weights(contribution: Array, kinds: NDArray[np.intp]) -> Array:
    """(n,) what makes an entry that matters 1; `contribution` (n,) are the entries' sizes, `kinds` (n,) their kinds."""
    of_kind = np.zeros(int(np.max(kinds)) + 1)
    np.maximum.at(of_kind, kinds, contribution)
    floor = max(FLOOR * float(np.max(contribution)), TINY)
    return 1 / np.maximum(np.maximum(contribution, LEAST * of_kind[kinds]), floor)


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
        return np.random.default_rng(self.seed).standard_normal((FIRST, len(self.weight)))[:count]

    def first(self, loss: float, count: int) -> Gaps:
        """At the usual step size, but no smaller than the rounding of a loss of this size allows."""
        return self.gaps(loss, float(np.clip(STEP, self._least(loss), WIDEST)), count)

    def second(self, loss: float, first: Gaps, count: int) -> Gaps | None:
        """At another step size; None where there is none."""
        bent = _size(first.bend) > BENT * _size(first.stated)
        step = FINER * first.step if bent else COARSER * first.step
        step = step if step >= self._least(loss) else COARSER * first.step
        return self.gaps(loss, step, count) if step <= WIDEST else None

    def _least(self, loss: float) -> float:
        """Where rounding is a tenth of what is allowed."""
        return 10 * ROUNDING * abs(loss) / (LIMIT * self.reach)

    def gaps(self, loss: float, step: float, count: int) -> Gaps:
        """Of the first `count` directions, `loss` being the one at the point."""
        z = self.normals(count)
        v = self.reach * self.weight * z
        values = self.f(np.vstack([step * v, -step * v]))
        ahead, behind = values[:count], values[count:]
        unit = step * self.reach
        stated = (v @ self.derivative) / self.reach
        bend = ((ahead - loss) - (loss - behind)) / (2 * unit)
        return Gaps(step, stated, stated - (ahead - behind) / (2 * unit), bend, ROUNDING * abs(loss) / unit)

    def alone(self, gaps: Gaps) -> tuple[int, float] | None:
        """The entry whose error alone explains the gaps, and that error; None where no single one does."""
        z = self.normals(len(gaps))
        size = (z**2).sum(axis=0)
        error = (gaps.gap @ z) / size
        left = gaps.gap @ gaps.gap - error**2 * size
        j = int(np.argmin(left))
        return (j, float(error[j] / self.weight[j])) if left[j] <= ALONE * (gaps.gap @ gaps.gap) else None


def judge(first: Gaps, second: Gaps | None, doubt: float) -> tuple[str, str]:
    """The verdict and its reason; `doubt` is the root mean square of gaps that a solver's early stop may leave."""
    if second is None:
        return (
            ("agree", "") if max(first.bound, first.kink) <= LIMIT else ("undecided", "no second step size is possible")
        )
    fine, coarse = sorted((first, second), key=lambda gaps: gaps.step)
    grown, told = coarse.step / fine.step, max(doubt, 100 * fine.rounding)
    for near, far, why in (
        (fine.bend, coarse.bend, "the loss has a corner: the slopes to both sides do not approach each other"),
        (fine.bend, grown * coarse.bend, "the loss jumps: its quotients grow as the step shrinks"),
        (fine.gap, grown * coarse.gap, "the loss jumps: its quotients grow as the step shrinks"),
    ):
        if fine.kink > LIMIT and _steady(near, far) and _size(near) > told:
            return "discontinuous", why
    if min(first.bound, second.bound) <= LIMIT:
        return "agree", ""
    if _steady(fine.gap, coarse.gap) and _size(coarse.gap) > max(doubt, coarse.rounding):
        return "disagree", "the gap is the same at both step sizes"
    return "undecided", "what the differences leave is more than what must be noticed"


def _bound(values: Array) -> float:
    return float(np.sqrt(values @ values / QUANTILE[len(values)]))


def _steady(near: Array, far: Array) -> bool:
    """Whether two step sizes tell the same of the directions that they share."""
    both = min(len(near), len(far))
    near, far = near[:both], far[:both]
    return _size(near - far) <= STEADY * min(_size(near), _size(far))


def _size(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))

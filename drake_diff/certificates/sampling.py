"""Check the gradient (n,) of a rollout along a few random directions, with two rollouts for each difference.

The difference along a direction v yields the gap (g - g*)' v between the gradient g in question and the true gradient
g*. Let e be the error in units in which all significant entries have the same weight, and let z = v in these units be a
vector of independent normal numbers. Then each gap is e' z plus the error of the difference. For any such error, the
sum of m squared gaps is below q |e|^2 with probability P(chi^2_m <= q) at most. So |e| <= U = sqrt(sum gap^2 / q) holds
except with that probability. No model of the noise is needed, as noise only makes U larger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.certificates.certificate import AGREE, VERDICTS, Certificate, unscaled
from drake_diff.certificates.certify import UnsolvedError, differences_of_drake, differences_of_solved
from drake_diff.certificates.displaced import Displaced
from drake_diff.motion.gradient import RolloutGradient


@dataclass(frozen=True)
class SampleOptions:
    """Options of the check of a rollout's gradient along a few random directions."""

    miss: float = 1e-3  # the probability that an error is missed
    # The (`miss` / 2)-quantiles of the chi^2 distribution with `second` and `first` degrees of freedom. The probability
    # is halved because each of two step sizes may agree.
    quantiles: tuple[float, float] = (0.06392, 0.15810)
    limit: float = 1e-2  # relative error of an entry that must be noticed
    # An entry is significant if it is at least `least` times the largest of its kind. A kind is significant if its
    # largest entry is at least `floor` times the largest of all. Entries are multiplied by the scale of their column.
    least: float = 1e-2
    floor: float = 1e-6
    first: int = 5
    second: int = 4  # number of directions at the first and at the second step size
    step: float = 1e-6
    # Ratio of the second step size to the first: `finer` if the loss bends by more than `bent` of its slope.
    finer: float = 1e-1
    coarser: float = 10.0
    bent: float = 1e-2
    rounding: float = 1e-14  # relative rounding of a loss along a rollout
    widest: float = 1e-2
    steady: float = 0.25  # largest relative change between two step sizes of a gap not due to the differences
    alone: float = 1e-3  # part of the squared gaps that a single entry that explains them may leave
    rollouts: int = 20  # maximum number
    doubt: float = 0.05  # relative change of a directional derivative due to the early stop of Drake's solver
    elsewhere: float = 1e-3  # relative to the scale: displacement of the rollout that precedes the check of the memory


SAMPLE = SampleOptions()
TINY = 1e-100


@dataclass(frozen=True, eq=False, repr=False)
class SampledCertificate(Certificate):
    """A rollout's gradient (1, n), compared with differences along random directions. All entries have one verdict.

    An entry is significant if it is at least 1 % of the largest of its kind, and at least 1e-6 of the largest entry of
    all. The kinds are positions, velocities, each input, the policy's parameters, and each parameter of the model.
    Entries are multiplied by the scale of their column, which is 1 in SI units, or the magnitude of the variable if
    that is larger. `size` is the entry or the smallest significant value. The verdict is

    - "agree": errors of 1 % in any significant entry, or in several together, would have been missed with a
      probability below 1e-3 over the seeds of the directions. `noticeable` is the noticeable error of every entry;
    - "disagree": the gaps are the same at two step sizes;
    - "discontinuous": the loss has a corner or a jump at the point;
    - "undecided": the differences do not resolve 1 % of an entry.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
        >>> certificate = dd.certify_rollout(model, np.ones(4), np.zeros((50, 1)), lambda x: x @ x, sampled=True)
        >>> certificate.verdict, certificate.rollouts <= 20
        ('agree', True)
    """

    gradient: RolloutGradient = field(kw_only=True)
    rollouts: int = 0
    seed: int = 0
    why: str = ""  # reason for every verdict except "agree"
    cause: str = ""  # error of the policy's own derivative, if it is known

    def _lines(self) -> list[str]:
        count = int((self.noticeable <= SAMPLE.limit * np.abs(self.derivative)).sum())
        power = (
            f"an error of {100 * self.power:.1g} % in a significant entry, or of 1 % in any of {count} entries of "
            f"{len(self.columns)}, would be missed with a probability below {SAMPLE.miss:g}"
        )
        head = f"{self.verdict} ({self.rollouts} rollouts along random directions, seed {self.seed}, {self.method})"
        texts = head, self.why, power if self.verdict == "agree" else "", self.told, self.cause
        return [text for text in texts if text]


@dataclass(frozen=True, eq=False)
class Gaps:
    """The gaps along m directions at one step size, in units in which significant entries are 1."""

    step: float
    stated: Array  # (m,) slope of the gradient in question along each direction
    gap: Array  # (m,) this slope minus the slope from differences
    bend: Array  # (m,) half of the difference between forward and backward quotients
    rounding: float  # effect of the loss's rounding on a gap

    def __str__(self) -> str:
        worst = int(np.argmax(np.abs(self.gap)))
        stated, differenced = self.stated[worst], self.stated[worst] - self.gap[worst]
        return (
            f"along direction {worst} the slope of the gradient is {stated:.6g}, the slope of the differences is "
            f"{differenced:.6g}, in units of a significant entry"
        )

    @property
    def bound(self) -> float:
        """The bound U, which the error exceeds with a probability of at most `SAMPLE.miss` / 2."""
        return _bound(self.gap)


def weights(contribution: Array, kinds: Indices) -> Array:
    """Return weights (n,) that scale significant entries to 1, from the sizes `contribution` (n,) and `kinds` (n,)."""
    of_kind = np.zeros(int(np.max(kinds)) + 1)
    np.maximum.at(of_kind, kinds, contribution)
    floor = max(SAMPLE.floor * float(np.max(contribution)), TINY)
    return 1 / np.maximum(np.maximum(contribution, SAMPLE.least * of_kind[kinds]), floor)


@dataclass(eq=False)
class Probe:
    """Rollouts along random directions around one point. `f` takes displacements (K, n) and returns losses (K,)."""

    f: Callable[[Array], Array]
    derivative: Array  # (n,)
    weight: Array  # (n,)
    seed: int
    spent: int = 0  # rollouts

    @property
    def left(self) -> int:
        """The number of remaining rollouts."""
        return SAMPLE.rollouts - self.spent

    def normals(self, count: int) -> Array:
        """Return the first `count` rows (count, n) of a fixed set of normal numbers."""
        return np.random.default_rng(self.seed).standard_normal((SAMPLE.first, len(self.weight)))[:count]

    def gaps(self, loss: float, step: float, count: int) -> Gaps:
        """Compute the gaps along the first `count` directions, with the `loss` at the point.

        No entry is displaced by more than `step` times its scale times a normal number.
        """
        reach = 1 / float(np.max(self.weight))
        v = reach * self.weight * self.normals(count)
        self.spent += 2 * count
        values, unit = self.f(np.vstack([step * v, -step * v])), step * reach
        ahead, behind = values[:count], values[count:]
        stated = (v @ self.derivative) / reach
        bend = ((ahead - loss) - (loss - behind)) / (2 * unit)
        return Gaps(step, stated, stated - (ahead - behind) / (2 * unit), bend, SAMPLE.rounding * abs(loss) / unit)

    def two(self, loss: float) -> tuple[Gaps, Gaps | None]:
        """Compute the gaps at the default step size, and at a second one if these do not agree and rollouts are left.

        The steps are large enough that the rounding of the loss is at most a tenth of the allowed error.
        """
        least = 10 * SAMPLE.rounding * abs(loss) / SAMPLE.limit * float(np.max(self.weight))
        count = SAMPLE.first if self.left >= 2 * (SAMPLE.first + SAMPLE.second) else SAMPLE.second
        first = self.gaps(loss, float(np.clip(SAMPLE.step, least, SAMPLE.widest)), count)
        if judge(first, None, 0.0)[0] == "agree" or self.left < 2 * SAMPLE.second:
            return first, None
        bent = _size(first.bend) > SAMPLE.bent * _size(first.stated) and SAMPLE.finer * first.step >= least
        step = (SAMPLE.finer if bent else SAMPLE.coarser) * first.step
        return first, self.gaps(loss, step, SAMPLE.second) if step <= SAMPLE.widest else None

    def alone(self, gaps: Gaps) -> tuple[int, float] | None:
        """Return the entry whose error alone explains the gaps, and this error, or None if there is no such entry."""
        z = self.normals(len(gaps.gap))
        size = (z**2).sum(axis=0)
        error = (gaps.gap @ z) / size
        left = gaps.gap @ gaps.gap - error**2 * size
        j = int(np.argmin(left))
        return (j, float(error[j] / self.weight[j])) if left[j] <= SAMPLE.alone * (gaps.gap @ gaps.gap) else None


def judge(first: Gaps, second: Gaps | None, doubt: float) -> tuple[str, str]:
    """Return the verdict and its reason. `doubt` is the root mean square of gaps due to a solver's early stop."""
    if second is None:
        agrees = max(first.bound, _bound(first.bend)) <= SAMPLE.limit
        return ("agree", "") if agrees else ("undecided", "no second step size is possible")
    fine, coarse = sorted((first, second), key=lambda gaps: gaps.step)
    grown, threshold = coarse.step / fine.step, max(doubt, 100 * fine.rounding)
    for near, far, why in (
        (fine.bend, coarse.bend, "the loss has a corner: the slopes to both sides do not approach each other"),
        (fine.bend, grown * coarse.bend, "the loss jumps: its quotients grow as the step shrinks"),
        (fine.gap, grown * coarse.gap, "the loss jumps: its quotients grow as the step shrinks"),
    ):
        if _bound(fine.bend) > SAMPLE.limit and _steady(near, far) and _size(near) > threshold:
            return "discontinuous", why
    if min(first.bound, second.bound) <= SAMPLE.limit:
        return "agree", ""
    if _steady(fine.gap, coarse.gap) and _size(coarse.gap) > max(doubt, coarse.rounding):
        return "disagree", "the gap is the same at both step sizes"
    return "undecided", "the error bound of the differences exceeds the error that must be detected"


def _bound(values: Array) -> float:
    return float(np.sqrt(values @ values / SAMPLE.quantiles[len(values) - SAMPLE.second]))


def _steady(near: Array, far: Array) -> bool:
    """Return whether the values at two step sizes agree along their common directions."""
    both = min(len(near), len(far))
    near, far = near[:both], far[:both]
    return _size(near - far) <= SAMPLE.steady * min(_size(near), _size(far))


def _size(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def certify_sampled(moved: Displaced, g: RolloutGradient, seed: int) -> SampledCertificate:
    """Certify `g` by at most 20 rollouts, of solved steps if possible. One of them checks a policy's memory."""
    derivative = moved.flat(g) * moved.scale
    weight = weights(np.abs(derivative), moved.kinds)
    probe = Probe(lambda d: moved.losses(d)[:, 0], derivative, weight, seed, 0 if moved.policy is None else 1)
    drake, doubt, note = probe.f, 0.0, ""
    try:
        if moved.solver_tolerance(g):
            left, worst = moved.left_by_drake(g)
            probe.f, probe.spent = (lambda d: moved.solved_losses(left, d)[:, 0]), probe.spent + 1
            note = differences_of_solved(worst)
        first, second = probe.two(g.loss)
    except UnsolvedError as why:
        probe.f, note = drake, differences_of_drake(str(why))
        doubt = SAMPLE.doubt * float(np.linalg.norm(derivative * weight))
        first, second = probe.two(g.loss)
    verdict, reason = judge(first, second, doubt)
    best = min((gaps for gaps in (first, second) if gaps is not None), key=lambda gaps: gaps.bound)
    if verdict == "disagree" and (explanation := probe.alone(best)):
        j, error = explanation
        stated, right = (value / moved.scale[j] for value in (derivative[j], derivative[j] - error))
        reason += (
            f"; an error in the entry of {moved.columns[j]} would explain it: expected {right:.6g}, got {stated:.6g}"
        )
    off = np.linalg.lstsq(probe.normals(len(best.gap)), best.gap, rcond=None)[0] / weight
    code, size, noticeable = VERDICTS.index(verdict), 1 / weight[None], best.bound / weight[None]
    return SampledCertificate(
        **unscaled(moved.scale, derivative[None], (derivative - off)[None], noticeable, noticeable, size),
        rows=("loss",),
        columns=moved.columns,
        codes=np.full((1, len(weight)), code),
        method=" + ".join(dict.fromkeys((*g.methods, *g.parameter_sources))),
        subject=moved.subject,
        scale=moved.scale,
        told=note,
        gradient=g,
        rollouts=probe.spent,
        seed=seed,
        why=reason if code == AGREE else f"{reason}; {best}",
    )

"""The gradient (n,) of a rollout along a few random directions, each difference of which takes two rollouts.

Those along a direction v tell the gap (g - g*)' v between the gradient g that is stated and the true one. Let e be the
error in units in which each entry that matters weighs the same, and z = v in these units a vector of independent normal
numbers. Then each gap is e' z plus what the differences themselves leave, and whatever that is, m gaps are in sum of
squares below q |e|^2 with probability at most P(chi^2_m <= q). So |e| <= U = sqrt(sum gap^2 / q) but for that
probability: no model of the noise is needed, a noisy difference merely makes U large.
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


@dataclass(frozen=True, eq=False, repr=False)
class SampledCertificate(Certificate):
    """A rollout's gradient (1, n), compared with differences along random directions; all entries have one verdict.

    An entry matters that is at least 1 % of the largest of its kind: positions, velocities, each input, the policy's
    parameters, each parameter of the model; where all of a kind are below 1e-6 of the largest entry, at least that.
    Entries are compared after each is multiplied by the scale of its column: 1 in SI units, or the magnitude of what
    is moved where that is more. `size` is the entry, or what would matter. The verdict is

    - "agree": errors of 1 % in any entry that matters, or in several together, would have been missed with a
      probability below 1e-3, over the seeds of the directions. `noticeable` says it for every entry;
    - "disagree": the gaps are the same at two step sizes;
    - "discontinuous": the loss has a corner or jumps at the point;
    - "undecided": what the differences leave is more than 1 % of an entry.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
        >>> certificate = dd.certify_rollout(model, np.ones(4), np.zeros((50, 1)), lambda x: x @ x, sampled=True)
        >>> certificate.verdict, certificate.rollouts <= 20
        ('agree', True)
    """

    gradient: RolloutGradient = field(kw_only=True)
    rollouts: int = 0
    seed: int = 0
    why: str = ""  # of every verdict but "agree"
    cause: str = ""  # what is wrong with the policy's own derivative, where that is known

    def _lines(self) -> list[str]:
        count = int((self.noticeable <= SAMPLE.limit * np.abs(self.derivative)).sum())
        power = (
            f"an error of {100 * self.power:.1g} % in an entry that matters, or of 1 % in any of {count} entries of "
            f"{len(self.columns)}, would be missed with a probability below {SAMPLE.miss:g}"
        )
        head = f"{self.verdict} ({self.rollouts} rollouts along random directions, seed {self.seed}, {self.method})"
        texts = head, self.why, power if self.verdict == "agree" else "", self.told, self.cause
        return [text for text in texts if text]


@dataclass(frozen=True, eq=False)
class Gaps:
    """At one step size, of m directions, in the unit in which an entry that matters is 1."""

    step: float
    stated: Array  # (m,) the slope along each direction
    gap: Array  # (m,) that less the differences'
    bend: Array  # (m,) half of what the quotients of both sides differ by
    rounding: float  # what the loss's rounding makes of a gap

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


def weights(contribution: Array, kinds: Indices) -> Array:
    """(n,) what makes an entry that matters 1; `contribution` (n,) are the entries' sizes, `kinds` (n,) their kinds."""
    of_kind = np.zeros(int(np.max(kinds)) + 1)
    np.maximum.at(of_kind, kinds, contribution)
    floor = max(SAMPLE.floor * float(np.max(contribution)), TINY)
    return 1 / np.maximum(np.maximum(contribution, SAMPLE.least * of_kind[kinds]), floor)


@dataclass(eq=False)
class Probe:
    """Rollouts along random directions around one point; `f` takes displacements (K, n) and gives losses (K,)."""

    f: Callable[[Array], Array]
    derivative: Array  # (n,)
    weight: Array  # (n,)
    seed: int
    spent: int = 0  # rollouts

    @property
    def left(self) -> int:
        """How many more rollouts may be taken."""
        return SAMPLE.rollouts - self.spent

    def normals(self, count: int) -> Array:
        """(count, n) the same ones first."""
        return np.random.default_rng(self.seed).standard_normal((SAMPLE.first, len(self.weight)))[:count]

    def gaps(self, loss: float, step: float, count: int) -> Gaps:
        """Of the first `count` directions, `loss` being the one at the point.

        No entry is moved by more than its scale times a normal number.
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
        """The gaps at the usual step size and, where these do not agree and there is something left, at another.

        No step is so small that the rounding of the loss is more than a tenth of what is allowed.
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
        """The entry whose error alone explains the gaps, and that error; None where no single one does."""
        z = self.normals(len(gaps.gap))
        size = (z**2).sum(axis=0)
        error = (gaps.gap @ z) / size
        left = gaps.gap @ gaps.gap - error**2 * size
        j = int(np.argmin(left))
        return (j, float(error[j] / self.weight[j])) if left[j] <= SAMPLE.alone * (gaps.gap @ gaps.gap) else None


def judge(first: Gaps, second: Gaps | None, doubt: float) -> tuple[str, str]:
    """The verdict and its reason; `doubt` is the root mean square of gaps that a solver's early stop may leave."""
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
    return "undecided", "the error bound of the differences exceeds the error that must be noticed"


def _bound(values: Array) -> float:
    return float(np.sqrt(values @ values / SAMPLE.quantiles[len(values) - SAMPLE.second]))


def _steady(near: Array, far: Array) -> bool:
    """Whether two step sizes tell the same of the directions that they share."""
    both = min(len(near), len(far))
    near, far = near[:both], far[:both]
    return _size(near - far) <= SAMPLE.steady * min(_size(near), _size(far))


def _size(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def certify_sampled(moved: Displaced, g: RolloutGradient, seed: int) -> SampledCertificate:
    """Certify `g` by at most 20 rollouts, of solved steps if possible; one has led a policy elsewhere before."""
    derivative = moved.flat(g) * moved.scale
    weight = weights(np.abs(derivative), moved.kinds)
    probe = Probe(lambda d: moved.losses(d)[:, 0], derivative, weight, seed, 0 if moved.policy is None else 1)
    drake, doubt, note = probe.f, 0.0, ""
    if not moved.solver_tolerance(g):
        first, second = probe.two(g.loss)
    else:
        try:
            left, worst = moved.left_by_drake(g)
            probe.f, probe.spent = (lambda d: moved.solved_losses(left, d)[:, 0]), probe.spent + 1
            (first, second), note = probe.two(g.loss), differences_of_solved(worst)
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
            f"; an error by {moved.columns[j]} alone would explain it: {stated:.6g} is stated, {right:.6g} is right"
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

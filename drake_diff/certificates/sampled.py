"""A rollout's gradient, checked by at most 20 rollouts: see `directions` for what that tells and what it cannot."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.certificates.certify import differences_of_drake, differences_of_solved
from drake_diff.certificates.directions import FIRST, LIMIT, MISS, SECOND, Gaps, Probe, judge, weights
from drake_diff.certificates.displaced import Displaced, NotSolvedError
from drake_diff.exceptions import CertificateError
from drake_diff.motion.gradient import RolloutGradient

ROLLOUTS = 20
DOUBT = 0.05  # of the derivative along a direction: what Drake's solver, stopping early, was seen to change it by


@dataclass(frozen=True, eq=False, repr=False)
class SampledCertificate(ShowsItsRepr):
    """A rollout's gradient (n,), compared with differences along random directions.

    An entry matters that is at least 1 % of the largest of its kind: positions, velocities, each input, the policy's
    parameters, each parameter of the model; where all of a kind are below 1e-6 of the largest entry, at least that.
    Entries are compared after each is multiplied by the scale of its column: 1 in SI units, or the magnitude of what
    is moved where that is more. The verdict is

    - "agree": errors of 1 % in any entry that matters, or in several together, would have been missed with a
      probability below 1e-3, over the seeds of the directions. `noticed` says it for every entry;
    - "disagree": the gaps are the same at two step sizes;
    - "discontinuous": the loss has a corner or jumps at the point;
    - "undecided": what the differences leave is more than 1 % of an entry.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
        >>> certificate = dd.certify_rollout(model, np.ones(4), np.zeros((50, 1)), lambda x: x @ x, sampled=True)
        >>> certificate.verdict, certificate.rollouts <= 20
        ('agree', True)
    """

    verdict: str
    reason: str  # of every verdict but "agree"
    gradient: RolloutGradient
    columns: tuple[str, ...]
    derivative: Array  # (n,)
    noticed: Array  # (n,) the error of each entry that would have been missed with a probability of 1e-3
    matters: Array  # (n,) what an error of each entry is measured by: the entry, or what would matter
    slopes: tuple[
        tuple[float, float], ...
    ]  # along each direction: stated, and the differences'; 1: an entry that matters
    rollouts: int
    seed: int
    method: str
    subject: str
    told: str = ""  # whose differences these are, where it is not plain
    cause: str = ""  # what is wrong with the policy's own derivative, where that is known

    @property
    def power(self) -> float:
        """The error, as a part of an entry that matters, that would have been missed with a probability of 1e-3."""
        return float(np.max(self.noticed / self.matters, initial=0.0))

    def require(self) -> "SampledCertificate":
        """This certificate if it agrees; otherwise CertificateError, which says why."""
        if self.verdict != "agree":
            raise CertificateError(f"{self.subject}: {self}")
        return self

    def _lines(self) -> list[str]:
        count = int((self.noticed <= LIMIT * np.abs(self.derivative)).sum())
        power = (
            f"an error of {100 * self.power:.1g} % in an entry that matters, or of 1 % in any of {count} entries of "
            f"{len(self.columns)}, would be missed with a probability below {MISS:g}"
        )
        lines = [f"{self.verdict} ({self.rollouts} rollouts along random directions, seed {self.seed}, {self.method})"]
        texts = self.reason, power if self.verdict == "agree" else "", self.told, self.cause
        return [*lines, *(text for text in texts if text)]

    def __str__(self) -> str:
        return "; ".join(self._lines())

    def __repr__(self) -> str:
        return f"{type(self).__name__} of {self.subject}: " + "\n  ".join(self._lines())


def certify_sampled(moved: Displaced, g: RolloutGradient, seed: int, spent: int, subject: str) -> SampledCertificate:
    """Certify `g` by what is left of 20 rollouts, of which `spent` are gone."""
    derivative = moved.flat(g) * moved.scale
    weight = weights(np.abs(derivative), moved.kinds)
    budget = _Budget(spent)
    tolerance, told = moved.solver_tolerance(g), ""
    drake = Probe(budget.counting(lambda d: moved.losses(d)[:, 0]), derivative, weight, seed)
    first, second, probe = None, None, drake
    if tolerance:
        try:
            left, worst = moved.left_by_drake(g)
            budget.spent += 1
            probe = Probe(budget.counting(lambda d: moved.solved_losses(left, d)[:, 0]), derivative, weight, seed)
            first, second = _two(probe, g.loss, budget)
            told = differences_of_solved(worst)
        except NotSolvedError as why:
            told = differences_of_drake(str(why))
            probe = drake
    doubt = DOUBT * float(np.linalg.norm(derivative * weight)) if probe is drake and tolerance else 0.0
    if first is None:
        first, second = _two(drake, g.loss, budget)
    verdict, reason = judge(first, second, doubt)
    if verdict == "agree" and probe is not drake and second is None and budget.left >= 2 * SECOND:
        own = drake.gaps(g.loss, first.step, SECOND)
        told += f"; differences of those alone would have told {100 * own.bound:.1g} %"
    best = min((gaps for gaps in (first, second) if gaps is not None), key=lambda gaps: gaps.bound)
    if verdict == "disagree" and (one := probe.alone(best)):
        j, error = one
        stated, right = (value / moved.scale[j] for value in (derivative[j], derivative[j] - error))
        reason += f"; by {moved.columns[j]} alone it would be explained: {stated:.6g} is stated, {right:.6g} is right"
    if verdict != "agree":
        reason += f"; {best}"
    return SampledCertificate(
        verdict=verdict,
        reason=reason,
        gradient=g,
        columns=moved.columns,
        derivative=frozen(derivative / moved.scale),
        noticed=frozen(best.bound / weight / moved.scale),
        matters=frozen(1 / weight / moved.scale),
        slopes=tuple(zip(best.stated.tolist(), (best.stated - best.gap).tolist(), strict=True)),
        rollouts=budget.spent,
        seed=seed,
        method=" + ".join(dict.fromkeys((*g.methods, *g.parameter_sources))),
        subject=subject,
        told=told,
    )


@dataclass
class _Budget:
    spent: int

    @property
    def left(self) -> int:
        return ROLLOUTS - self.spent

    def counting(self, f: Callable[[Array], Array]) -> Callable[[Array], Array]:
        def counted(displacements: Array) -> Array:
            self.spent += len(displacements)
            return f(displacements)

        return counted


def _two(probe: Probe, loss: float, budget: _Budget) -> tuple[Gaps, Gaps | None]:
    """The gaps at the usual step size and, where these do not agree and there is something left, at another."""
    first = probe.first(loss, FIRST if budget.left >= 2 * (FIRST + SECOND) else SECOND)
    if judge(first, None, 0.0)[0] == "agree" or budget.left < 2 * SECOND:
        return first, None
    return first, probe.second(loss, first, SECOND)

"""Certify the gradient of a whole rollout before it is used: entry by entry, or by at most 20 rollouts."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array, frozen, positive_int
from drake_diff._base.differences import Many
from drake_diff._base.values import ShowsItsRepr
from drake_diff.certificates.certificate import LIMITS, VERDICTS, Certificate, certify_displacement, jitter
from drake_diff.certificates.certify import differences_of_drake, differences_of_solved
from drake_diff.certificates.directions import SAMPLE, Gaps, Probe, judge, weights
from drake_diff.certificates.displaced import (
    Displaced,
    NotSolvedError,
    check_memory,
    fresh,
    stairs_of_loss,
    stairs_of_policy,
    wrong_derivative,
)
from drake_diff.certificates.truth import SECONDS, Refinement, Truth, by_truth, refine_by_time_step, truth_of
from drake_diff.derivatives.sources import check_method
from drake_diff.exceptions import CertificateError, GradientWarning, InputError, ModelError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, select
from drake_diff.motion.gradient import CONTINUOUS, RolloutGradient
from drake_diff.motion.loss import Loss
from drake_diff.motion.rollout import Policy, check_inputs


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

    def require(self) -> SampledCertificate:
        """This certificate if it agrees; otherwise CertificateError, which says why."""
        if self.verdict != "agree":
            raise CertificateError(f"{self.subject}: {self}")
        return self

    def _lines(self) -> list[str]:
        count = int((self.noticed <= SAMPLE.limit * np.abs(self.derivative)).sum())
        power = (
            f"an error of {100 * self.power:.1g} % in an entry that matters, or of 1 % in any of {count} entries of "
            f"{len(self.columns)}, would be missed with a probability below {SAMPLE.miss:g}"
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
    tolerance, note = moved.solver_tolerance(g), ""
    drake = Probe(budget.counting(lambda d: moved.losses(d)[:, 0]), derivative, weight, seed)
    first, second, probe = None, None, drake
    if tolerance:
        try:
            left, worst = moved.left_by_drake(g)
            budget.spent += 1
            probe = Probe(budget.counting(lambda d: moved.solved_losses(left, d)[:, 0]), derivative, weight, seed)
            first, second = _two(probe, g.loss, budget)
            note = differences_of_solved(worst)
        except NotSolvedError as why:
            note = differences_of_drake(str(why))
            probe = drake
    doubt = SAMPLE.doubt * float(np.linalg.norm(derivative * weight)) if probe is drake and tolerance else 0.0
    if first is None:
        first, second = _two(drake, g.loss, budget)
    verdict, reason = judge(first, second, doubt)
    if verdict == "agree" and probe is not drake and second is None and budget.left >= 2 * SAMPLE.second:
        drakes_gaps = drake.gaps(g.loss, first.step, SAMPLE.second)
        note += f"; differences of those alone would have told {100 * drakes_gaps.bound:.1g} %"
    best = min((gaps for gaps in (first, second) if gaps is not None), key=lambda gaps: gaps.bound)
    if verdict == "disagree" and (explanation := probe.alone(best)):
        j, error = explanation
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
        told=note,
    )


@dataclass
class _Budget:
    spent: int

    @property
    def left(self) -> int:
        return SAMPLE.rollouts - self.spent

    def counting(self, f: Callable[[Array], Array]) -> Callable[[Array], Array]:
        def counted(displacements: Array) -> Array:
            self.spent += len(displacements)
            return f(displacements)

        return counted


def _two(probe: Probe, loss: float, budget: _Budget) -> tuple[Gaps, Gaps | None]:
    """The gaps at the usual step size and, where these do not agree and there is something left, at another."""
    first = probe.first(loss, SAMPLE.first if budget.left >= 2 * (SAMPLE.first + SAMPLE.second) else SAMPLE.second)
    if judge(first, None, 0.0)[0] == "agree" or budget.left < 2 * SAMPLE.second:
        return first, None
    return first, probe.second(loss, first, SAMPLE.second)


@dataclass(frozen=True, eq=False, repr=False)
class RolloutCertificate(Certificate):
    """The certificate of a rollout's gradient, with that gradient and its refinements.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> certificate = dd.certify_rollout(model, [0.5, 0.0], np.zeros((20, 1)), lambda x: x[0] ** 2, refine=True)
        >>> certificate.verdict, certificate.refinements[0].levels
        ('agree', (0.01, 0.005, 0.0025))
    """

    gradient: RolloutGradient = field(kw_only=True)
    refinements: tuple[Refinement, ...] = ()
    cause: str = ""  # why entries disagree, where that is known
    truth: Truth | None = None  # the motion in continuous time, where it was asked for and there is one
    no_truth: str = ""  # why there is none

    def _lines(self) -> list[str]:
        truth = [repr(self.truth)] if self.truth else [f"no truth: {self.no_truth}"] if self.no_truth else []
        return [*super()._lines(), *map(str, self.refinements), *truth, *([self.cause] if self.cause else [])]


def certify_rollout(
    model: Model,
    x0: ArrayLike,
    us: ArrayLike | None,
    loss: Loss,
    *,
    policy: Policy | None = None,
    parameters: Parameters = (),
    num_steps: int | None = None,
    refine: bool = False,
    seconds: float = SECONDS,
    method: str = "auto",
    gradient: RolloutGradient | None = None,
    sampled: bool = False,
    seed: int = 0,
) -> RolloutCertificate | SampledCertificate:
    """Compare the gradient of a rollout's loss with differences of whole rollouts, 26 for each column.

    Under a policy the rollouts are of the closed loop: it is asked with plain numbers, and each rollout has a copy of
    it with a memory of its own.

    Args:
        model: the model that is rolled out.
        x0: (nx,) the first state.
        us: (N, nu) [N or N m] the inputs; None where the model has none, and under a policy.
        loss: a function of (xs, us) or of the last state, written so that AutoDiffXd flows through it.
        policy: u = policy(x, t) in place of `us`, as in `differentiate_rollout`.
        parameters: names, or values by name, of the parameters to differentiate by too.
        num_steps: N, where `us` is None.
        refine: take the gradient again at h/2 and h/4, under the same inputs, and compare it with the slopes of the
            motion in continuous time, along each state, each input by as much at all times, and each parameter: the
            certificate's `truth`. Where something touches and they are not known, nothing converges.
        seconds: of this thread's work at most for the motion in continuous time [s]; columns that are not measured by
            then say so.
        method: as in `differentiate_step`; or "continuous": the gradient of the motion in continuous time, beside the
            slopes of another integration of it. A column has no slope where those do not settle, which is
            "discontinuous", and is "undecided" where they were not measured in time.
        gradient: what to certify, instead of what `differentiate_rollout` gives; one by "continuous" is judged so.
        sampled: take at most 20 rollouts, along random directions, whatever the number of columns.
        seed: of these directions.

    Returns:
        The certificate of one row, the loss; its columns are x0 (on the tangent space), u[k] step by step or the
        policy's parameters, and the model's; in continuous time each input is one column, by as much at all times.
        Entries that agree and do not converge are "not_converged". Where
        `sampled`, a certificate of all columns together, which says how small an error it would have noticed.

    Raises:
        InputError: both `us` and `policy` are given; what is sampled, or under a policy, is to be refined; the time
            step is refined and a parameter at once.
        ModelError: the motion in continuous time is asked for and there is none; `refine` of a model from a diagram,
            which has but one time step, where that is so.
        GradientError: the rollout has no gradient, or the policy remembers what it was asked before.
        SimulationError: Drake cannot take a step.

    Source:
        Suh, Simchowitz, Zhang and Tedrake, "Do differentiable simulators give better policy gradients?", 2022.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> certificate = dd.certify_rollout(model, [0.5, 0.0], [[0.1], [0.0]], lambda x: x[0] ** 2)
        >>> certificate.verdict, certificate.columns
        ('agree', ('hinge_q[0]', 'hinge_w[0]', 'motor[0]', 'motor[1]'))
    """
    is_continuous = method == CONTINUOUS or (gradient is not None and CONTINUOUS in gradient.methods)
    _check_arguments(us, policy, refine, sampled, is_continuous)
    if not is_continuous:
        check_method(method)
    x0, vector = finite_array("x0", x0, (model.nx,)), select(model, parameters)
    if policy is None:
        inputs = check_inputs(model, us, num_steps)
    else:
        inputs = np.empty((positive_int("num_steps", num_steps), 0))
    moved = Displaced(model, x0, inputs, loss, fresh(policy), vector, method)
    columns, subject = moved.columns, f"the rollout of {model.name}"
    if is_continuous:
        return _certify_continuous(moved, gradient, seconds, subject)
    here, beside = np.zeros(len(columns)), None
    if gradient is None:
        gradient = moved.gradient(here)
        if not sampled:
            beside = moved.flat(moved.gradient(jitter(here + 1)))[None] * moved.scale
    stairs = _checked(moved, gradient)
    if sampled:
        return _sampled(moved, gradient, stairs, seed, subject)
    truth, no_truth = _truth(moved, gradient, seconds) if refine else (None, "")
    refinements = []
    if refine and (model.can_rebuild or truth is None):
        refinements.append(refine_by_time_step(moved, gradient, truth))
    method = " + ".join(dict.fromkeys((*gradient.methods, *gradient.parameter_sources)))
    certificate = _certified(moved, gradient, beside, method, subject)
    return RolloutCertificate(
        **_with_refinements(certificate, refinements, None if model.can_rebuild else truth, stairs),
        gradient=gradient,
        refinements=tuple(refinements),
        cause=_cause(moved, gradient, certificate.verdict),
        truth=truth,
        no_truth=no_truth,
    )


def _check_arguments(
    us: ArrayLike | None, policy: Policy | None, refine: bool, sampled: bool, is_continuous: bool
) -> None:
    """Raise InputError where two of them do not go together."""
    if us is not None and policy is not None:
        raise InputError("certify_rollout", got="us and policy", expected="one of them")
    if is_continuous and (sampled or refine):
        raise InputError("certify_rollout", got="refinement or a sample in continuous time", expected="neither there")
    if (policy is not None or sampled) and refine:
        raise InputError("refine", got="refinement of a closed loop or of a sample", expected="it of given inputs")


def _sampled(moved: Displaced, gradient: RolloutGradient, stairs: str, seed: int, subject: str) -> SampledCertificate:
    """The certificate by few rollouts along random directions."""
    sample = certify_sampled(moved, gradient, seed, 0 if moved.policy is None else 1, subject)
    if stairs:
        return replace(sample, verdict="discontinuous", reason=stairs)
    cause = _cause(moved, gradient, "")  # which few rollouts may not tell: it is asked for whatever they say
    return replace(sample, cause=cause, verdict="disagree" if cause and sample.verdict == "agree" else sample.verdict)


def _certify_continuous(
    moved: Displaced, gradient: RolloutGradient | None, seconds: float, subject: str
) -> RolloutCertificate:
    """The certificate of a gradient in continuous time: one column for each slope that is measured."""
    if gradient is None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GradientWarning)  # the certificate says it, and more
            gradient = moved.gradient(np.zeros(len(moved.scale)))
    stairs = stairs_of_loss(moved.loss, gradient, moved.space)
    if moved.policy is not None:
        stairs = stairs or stairs_of_policy(moved.policy, gradient, moved.space, moved.model.time_step)
    truth = truth_of(moved, gradient, seconds)
    parts = by_truth(truth, subject)
    return RolloutCertificate(
        **_with_refinements(Certificate(**parts), (), None, stairs), gradient=gradient, truth=truth
    )


def _truth(moved: Displaced, gradient: RolloutGradient, seconds: float) -> tuple[Truth | None, str]:
    """The motion in continuous time beside a gradient, or why there is none."""
    try:
        return truth_of(moved, gradient, seconds), ""
    except (ModelError, SimulationError) as error:
        return None, str(error)


def _checked(moved: Displaced, gradient: RolloutGradient) -> str:
    """How the loss or the policy is a staircase, empty where they are none; a policy that remembers is refused."""
    stairs = stairs_of_loss(moved.loss, gradient, moved.space)
    if moved.policy is None:
        return stairs
    elsewhere, time_step = fresh(moved.policy), moved.vector.time_step(moved.vector.values)
    moved.losses(jitter(np.full(len(moved.scale), SAMPLE.elsewhere / LIMITS.jitter))[None], elsewhere)
    check_memory(elsewhere, gradient, time_step)
    return stairs or stairs_of_policy(moved.policy, gradient, moved.space, time_step)


def _certified(
    moved: Displaced, gradient: RolloutGradient, beside: Array | None, method: str, subject: str
) -> Certificate:
    """The certificate by rollouts whose steps are solved to rounding, else by Drake's own."""
    derivative, tolerance = moved.flat(gradient)[None] * moved.scale, moved.solver_tolerance(gradient)

    def by(losses: Many, statement: str, unsolved: float, stopped: float) -> Certificate:
        return certify_displacement(
            losses, derivative, rows=("loss",), columns=moved.columns, scale=moved.scale, beside=beside,
            unsolved=unsolved, stopped=stopped, told=statement, method=method, subject=subject,
        )  # fmt: skip

    if not tolerance:
        return by(moved.losses, "", 0.0, 0.0)
    try:
        left, worst = moved.left_by_drake(gradient)
        return by(partial(moved.solved_losses, left), differences_of_solved(worst), 0.0, worst)
    except NotSolvedError as why:
        return by(moved.losses, differences_of_drake(str(why)), tolerance * abs(gradient.loss), tolerance)


def _with_refinements(
    certificate: Certificate, refinements: Sequence[Refinement], truth: Truth | None, stairs: str
) -> dict[str, Any]:
    """The parts of a certificate whose entries that do not converge, are not the truth, or on stairs, do not agree."""
    codes, reasons = np.array(certificate.codes), dict(certificate.reasons)
    wrong = np.zeros(codes.shape[1], dtype=bool)
    for refinement in refinements:
        wrong |= ~refinement.converged
    for slope in truth.slopes if truth is not None else ():
        wrong[list(slope.columns)] |= slope.agrees is not True
    codes[0, wrong] = np.maximum(codes[0, wrong], VERDICTS.index("not_converged"))
    if stairs:
        codes[:] = VERDICTS.index("discontinuous")
        reasons = {(0, j): stairs for j in range(codes.shape[1])}
    parts = {name: getattr(certificate, name) for name in Certificate.__dataclass_fields__}
    return parts | {"codes": codes, "reasons": reasons}


def _cause(moved: Displaced, gradient: RolloutGradient, verdict: str) -> str:
    """What is wrong with the policy's own derivative, where a gradient does not agree."""
    if moved.policy is None or verdict == "agree":
        return ""
    return wrong_derivative(moved.policy, moved.space, gradient, moved.vector.time_step(moved.vector.values))

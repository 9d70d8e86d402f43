"""Certify the gradient of a whole rollout: entry by entry, or with at most 20 rollouts."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, number_of_steps
from drake_diff._base.differences import Many
from drake_diff.certificates.certificate import (
    DISAGREE,
    DISCONTINUOUS,
    LIMITS,
    NOT_CONVERGED,
    Certificate,
    certify_displacement,
    jitter,
)
from drake_diff.certificates.certify import UnsolvedError, differences_of_drake, differences_of_solved
from drake_diff.certificates.displaced import (
    Displaced,
    check_memory,
    fresh,
    stairs_of_loss,
    stairs_of_policy,
    wrong_derivative,
)
from drake_diff.certificates.sampling import SAMPLE, SampledCertificate, certify_sampled
from drake_diff.certificates.truth import SECONDS, Refinement, Truth, by_truth, refine_by_time_step, truth_of
from drake_diff.derivatives.sources import check_method
from drake_diff.exceptions import GradientWarning, InputError, ModelError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, select
from drake_diff.motion.gradient import CONTINUOUS, RolloutGradient
from drake_diff.motion.loss import Loss
from drake_diff.motion.rollout import Policy, check_inputs


@dataclass(frozen=True, eq=False, repr=False)
class RolloutCertificate(Certificate):
    """The certificate of a rollout's gradient, with the gradient and its refinements.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> certificate = dd.certify_rollout(model, [0.5, 0.0], np.zeros((20, 1)), lambda x: x[0] ** 2, refine=True)
        >>> certificate.verdict, certificate.refinements[0].levels
        ('agree', (0.01, 0.005, 0.0025))
    """

    gradient: RolloutGradient = field(kw_only=True)
    refinements: tuple[Refinement, ...] = ()
    cause: str = ""  # reason for entries that disagree, if it is known
    truth: Truth | None = None  # the loss and its slopes in continuous time, if requested and available
    no_truth: str = ""  # reason why `truth` is not available

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

    With a policy, the rollouts are those of the closed loop. The policy is called with plain numbers, and each rollout
    uses its own copy of the policy and of the policy's memory.

    Args:
        model: The model.
        x0: (nx,) The initial state.
        us: (N, nu) [N or N m] The inputs, or None for a policy or a model without inputs.
        loss: A function of (xs, us) or of the last state that supports AutoDiffXd.
        policy: u = policy(x, t) in place of `us`, as in `differentiate_rollout`.
        parameters: Names, or values by name, of the parameters that the loss is also differentiated with respect to.
        num_steps: N, if `us` is None.
        refine: Compute the gradient again at h/2 and h/4, under the same inputs, and compare it with the slopes of the
            motion in continuous time along each state, each input equally at all times, and each parameter (`truth` of
            the certificate). If geometries touch and these slopes are not known, no entry converges.
        seconds: [s] Maximum thread time for the continuous motion. Columns not measured in this time are marked.
        method: As in `differentiate_step`, or "continuous" for the gradient of the motion in continuous time, compared
            with the slopes of another integration. A column is "discontinuous" if these slopes do not converge, and
            "undecided" if they were not measured in time.
        gradient: The gradient to certify, by default the result of `differentiate_rollout`. The comparison for a
            gradient by "continuous" is the one of this method.
        sampled: Take at most 20 rollouts, along random directions, for any number of columns.
        seed: Seed of these directions.

    Returns:
        The certificate with one row, the loss. Its columns are x0 (on the tangent space), u[k] step by step or the
        policy's parameters, and the model's parameters. In continuous time, each input is one column for all times.
        Entries that agree but do not converge are "not_converged". With `sampled`, the certificate has one verdict for
        all columns, and states the smallest error that it would have noticed.

    Raises:
        InputError: Both `us` and `policy` are given. Or `refine` is combined with `sampled`, with a policy, or with the
            time step as a parameter.
        ModelError: The motion in continuous time is requested but not available, also by `refine` for a model from a
            diagram, whose time step cannot change.
        GradientError: The rollout has no gradient, or the policy depends on earlier calls.
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
    for wrong, got, expected in (
        (us is not None and policy is not None, "us and policy", "either us or policy"),
        (is_continuous and (sampled or refine), "sampled or refine in continuous time", "neither argument"),
        ((policy is not None or sampled) and refine, "refine with policy or sampled", "refine only with us"),
    ):
        if wrong:
            raise InputError("certify_rollout", got=got, expected=expected)
    if not is_continuous:
        check_method(method)
    x0, vector = model.finite_state("x0", x0), select(model, parameters)
    inputs = check_inputs(model, us, num_steps) if policy is None else np.empty((number_of_steps(num_steps), 0))
    moved = Displaced(model, x0, inputs, loss, fresh(policy), vector, method)
    if is_continuous:
        return _certify_continuous(moved, gradient, seconds)
    here, beside = np.zeros(len(moved.columns)), None
    if gradient is None:
        gradient = moved.gradient(here)
        beside = None if sampled else moved.flat(moved.gradient(jitter(here + 1)))[None] * moved.scale
    if policy is not None:
        elsewhere = fresh(moved.policy)
        moved.losses(jitter(here + SAMPLE.elsewhere / LIMITS.jitter)[None], elsewhere)
        check_memory(elsewhere, gradient, moved.time_step)
    return (
        _sampled(moved, gradient, seed) if sampled else _entries(moved, gradient, beside, seconds if refine else None)
    )


def _entries(
    moved: Displaced, gradient: RolloutGradient, beside: Array | None, seconds: float | None
) -> RolloutCertificate:
    """Certify by differences of whole rollouts, with a refinement if `seconds` is given."""
    stairs, truth, no_truth = _staircase(moved, gradient), None, ""
    refinements: tuple[Refinement, ...] = ()
    if seconds is not None:
        try:
            truth = truth_of(moved, gradient, seconds)
        except (ModelError, SimulationError) as error:
            no_truth = str(error)
        if moved.model.can_rebuild or truth is None:
            refinements = (refine_by_time_step(moved, gradient, truth),)
    certificate = _certified(moved, gradient, beside)
    cause = _cause(moved, gradient, certificate.verdict)
    more: dict[str, Any] = {"gradient": gradient, "truth": truth, "no_truth": no_truth, "cause": cause}
    return _of_rollout(certificate, stairs, refinements=refinements, **more)


def _sampled(moved: Displaced, gradient: RolloutGradient, seed: int) -> SampledCertificate:
    """Certify by a few rollouts along random directions."""
    sample, stairs = certify_sampled(moved, gradient, seed), _staircase(moved, gradient)
    if stairs:
        return replace(sample, codes=np.full(sample.codes.shape, DISCONTINUOUS), why=stairs)
    cause = _cause(moved, gradient, "")  # for every verdict, as few rollouts may miss a wrong policy derivative
    codes = np.full(sample.codes.shape, DISAGREE) if cause and sample.verdict == "agree" else sample.codes
    return replace(sample, cause=cause, codes=codes)


def _certify_continuous(moved: Displaced, gradient: RolloutGradient | None, seconds: float) -> RolloutCertificate:
    """Certify a gradient in continuous time, with one column for each measured slope."""
    if gradient is None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GradientWarning)  # the certificate contains this information
            gradient = moved.gradient(np.zeros(len(moved.scale)))
    stairs, truth = _staircase(moved, gradient), truth_of(moved, gradient, seconds)
    return _of_rollout(by_truth(truth, moved.subject), stairs, gradient=gradient, truth=truth)


def _staircase(moved: Displaced, gradient: RolloutGradient) -> str:
    """Describe the staircase of the loss or the policy, or return "" if there is none."""
    stairs = stairs_of_loss(moved.loss, gradient, moved.space)
    if stairs or moved.policy is None:
        return stairs
    return stairs_of_policy(moved.policy, gradient, moved.space, moved.time_step)


def _certified(moved: Displaced, gradient: RolloutGradient, beside: Array | None) -> Certificate:
    """Certify by rollouts whose steps are solved to rounding if possible, else by Drake's own steps."""
    derivative, tolerance = moved.flat(gradient)[None] * moved.scale, moved.solver_tolerance(gradient)
    method = " + ".join(dict.fromkeys((*gradient.methods, *gradient.parameter_sources)))

    def by(losses: Many, statement: str, unsolved: float, stopped: float) -> Certificate:
        return certify_displacement(
            losses, derivative, rows=("loss",), columns=moved.columns, scale=moved.scale, beside=beside,
            unsolved=unsolved, stopped=stopped, told=statement, method=method, subject=moved.subject,
        )  # fmt: skip

    if not tolerance:
        return by(moved.losses, "", 0.0, 0.0)
    try:
        left, worst = moved.left_by_drake(gradient)
        return by(partial(moved.solved_losses, left), differences_of_solved(worst), 0.0, worst)
    except UnsolvedError as why:
        return by(moved.losses, differences_of_drake(str(why)), tolerance * abs(gradient.loss), tolerance)


def _of_rollout(
    certificate: Certificate,
    stairs: str,
    truth: Truth | None,
    refinements: tuple[Refinement, ...] = (),
    **more: Any,
) -> RolloutCertificate:
    """Extend a certificate to a rollout's; entries that do not converge, differ from `truth`, or have stairs fail."""
    codes, reasons = np.array(certificate.codes), certificate.reasons
    wrong = np.zeros(codes.shape[1], dtype=bool)
    for refinement in refinements:
        wrong |= ~refinement.converged
    if truth is not None and not refinements and certificate.method != CONTINUOUS:
        for slope in truth.slopes:
            wrong[list(slope.columns)] |= slope.agrees is not True
    codes[0, wrong] = np.maximum(codes[0, wrong], NOT_CONVERGED)
    if stairs:
        codes[:] = DISCONTINUOUS
        reasons = {(0, j): stairs for j in range(codes.shape[1])}
    known = {f.name: getattr(certificate, f.name) for f in fields(Certificate)}
    known |= {"codes": codes, "reasons": reasons}
    return RolloutCertificate(**known, truth=truth, refinements=refinements, **more)


def _cause(moved: Displaced, gradient: RolloutGradient, verdict: str) -> str:
    """Describe the error of the policy's own derivative, if the gradient does not agree."""
    if moved.policy is None or verdict == "agree":
        return ""
    return wrong_derivative(moved.policy, moved.space, gradient, moved.time_step)

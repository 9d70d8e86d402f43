"""Certify the gradient of a whole rollout before it is used."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array
from drake_diff._base.differences import one_by_one
from drake_diff.certificates.certificate import VERDICTS, Certificate, certify_displacement, jitter
from drake_diff.certificates.certify import move, solver_tolerance, state_scale
from drake_diff.certificates.refinement import (
    REFINEMENTS,
    STIFFENING,
    Refinement,
    at_finer_steps,
    flat_gradient,
    in_stiffer_contact,
    judge_levels,
)
from drake_diff.derivatives.sources import check_method
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, ParameterVector, applied, select
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.gradient import Loss, RolloutGradient, differentiate_rollout, evaluate_loss
from drake_diff.motion.rollout import check_inputs, roll_states


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

    def _lines(self) -> list[str]:
        return [*super()._lines(), *map(str, self.refinements)]


def certify_rollout(
    model: Model,
    x0: ArrayLike,
    us: ArrayLike | None,
    loss: Loss,
    *,
    parameters: Parameters = (),
    num_steps: int | None = None,
    refine: bool = False,
    refine_stiffness: bool = False,
    method: str = "auto",
) -> RolloutCertificate:
    """Compare the gradient of a rollout's loss with differences of whole rollouts, 26 for each column.

    Args:
        model: the model that is rolled out.
        x0: (nx,) the first state.
        us: (N, nu) [N or N m] the inputs; None where the model has none.
        loss: a function of (xs, us) or of the last state, written so that AutoDiffXd flows through it.
        parameters: names, or values by name, of the parameters to differentiate by too.
        num_steps: N, where `us` is None.
        refine: take the gradient again at h/2 and h/4, under the same inputs.
        refine_stiffness: take it again at 4 and 16 times every contact stiffness that the model states.
        method: as in `differentiate_step`.

    Returns:
        The certificate of one row, the loss; its columns are x0 (on the tangent space), u[k] step by step, and the
        parameters. Entries that agree with differences and do not converge are "not_converged".

    Raises:
        InputError: the time step or a stiffness is refined and a parameter at once, or no stiffness is stated.
        ModelError: `refine` of a model that has but one time step.
        GradientError, SimulationError: the rollout, or its derivative, is refused.

    Source:
        Suh, Simchowitz, Zhang and Tedrake, "Do differentiable simulators give better policy gradients?", 2022.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> certificate = dd.certify_rollout(model, [0.5, 0.0], [[0.1], [0.0]], lambda x: x[0] ** 2)
        >>> certificate.verdict, certificate.columns
        ('agree', ('hinge_q[0]', 'hinge_w[0]', 'motor[0]', 'motor[1]'))
    """
    check_method(method)
    us = check_inputs(model, us, num_steps)
    x0 = finite_array("x0", x0, (model.nx,))
    vector, space = select(model, parameters), tangent_space(model)
    steps = np.maximum(1.0, np.abs(us.ravel()))
    scale = np.concatenate([state_scale(space, x0), steps, vector.difference_scale()])
    end = model.nx + us.size

    def moved(displacement: Array) -> tuple[Array, Array, ParameterVector]:
        point = np.concatenate([x0, us.ravel(), vector.values])
        point = move(space, model.nx, point, scale * displacement)
        return point[: model.nx], point[model.nx : end].reshape(us.shape), vector.at(point[end:])

    def f(displacement: Array) -> Array:
        x, inputs, values = moved(displacement)
        with applied(values) as set_model:
            return np.array([evaluate_loss(loss, roll_states(set_model, x, inputs), inputs)])

    def gradient_at(displacement: Array) -> RolloutGradient:
        x, inputs, values = moved(displacement)
        return differentiate_rollout(model, x, inputs, loss, parameters=values, method=method)

    gradient = gradient_at(np.zeros(len(scale)))
    inputs = tuple(f"{name}[{k}]" for k in range(len(us)) for name in model.input_names)
    columns = tuple(f"{name}[0]" for name in space.names) + inputs + vector.names
    refinements = []
    for wanted, by, levels, refined in (
        (refine, "time step", tuple(model.time_step / m for m in REFINEMENTS), at_finer_steps),
        (refine_stiffness, "stiffness, times", tuple(map(float, STIFFENING)), in_stiffer_contact),
    ):
        if wanted:
            values = [flat_gradient(space, gradient, us.shape), *refined(model, x0, us, loss, vector, method)]
            refinements.append(judge_levels(by, levels, columns, np.array(values), space.size, us.shape))
    certificate = certify_displacement(
        one_by_one(f),
        flat_gradient(space, gradient, us.shape)[None] * scale,
        rows=("loss",),
        columns=columns,
        scale=scale,
        beside=flat_gradient(space, gradient_at(jitter(np.ones(len(scale)))), us.shape)[None] * scale,
        solver_tolerance=max(solver_tolerance(model, x, u) for x, u in zip(gradient.xs[:-1], us, strict=True)),
        method=" + ".join(dict.fromkeys((*gradient.methods, *gradient.parameter_sources))),
        subject=f"the rollout of {model.name}",
    )
    codes = np.array(certificate.codes)
    for found in refinements:
        codes[0] = np.where(found.converged, codes[0], np.maximum(codes[0], VERDICTS.index("not_converged")))
    parts = {name: getattr(certificate, name) for name in Certificate.__dataclass_fields__} | {"codes": codes}
    return RolloutCertificate(**parts, gradient=gradient, refinements=tuple(refinements))

"""Certify the derivative of a step, or of a whole rollout, before it is used."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from drake_diff.arrays import Array, finite_array
from drake_diff.certificate import JITTER, VERDICTS, Certificate, certify_displacement, jitter_direction
from drake_diff.finite_difference import one_by_one
from drake_diff.mode_changes import ModeChange, find_mode_changes
from drake_diff.model import Model
from drake_diff.parameters import Parameters, ParameterVector, applied, select
from drake_diff.plant_elements import actuators
from drake_diff.read_contract import SAP_RELATIVE_TOLERANCE
from drake_diff.refinement import Refinement, refined, stiffened
from drake_diff.rollout import check_inputs, roll_states
from drake_diff.rollout_gradient import Loss, RolloutGradient, differentiate_rollout, evaluate_loss
from drake_diff.step import advance, check_point
from drake_diff.step_derivatives import StepDerivatives, check_method, step_at, step_jacobians
from drake_diff.tangent import TangentSpace, tangent_space


@dataclass(frozen=True, eq=False)
class RolloutCertificate(Certificate):
    """The certificate of a rollout's gradient, the gradient, and whether it converges with the time step."""

    gradient: RolloutGradient = field(kw_only=True)
    refinements: tuple[Refinement, ...] = ()

    def __str__(self) -> str:
        return "; ".join([super().__str__(), *map(str, self.refinements)])


LIMIT_REACH = 0.05  # [m or rad] a joint limit this near may hold the joint in one of the displaced steps


def certify(
    model: Model,
    x: ArrayLike,
    u: ArrayLike | None = None,
    *,
    parameters: Parameters = (),
    method: str = "auto",
    derivatives: StepDerivatives | None = None,
) -> Certificate:
    """Compare the Jacobians of the step at (`x`, `u`) with differences of the double step, entry by entry.

    Rows are the next state's, columns those of [x; u; parameters], both on the tangent space (a quaternion has
    three entries). The derivative is `differentiate_step(..., method=method)`, or `derivatives` where given.
    """
    check_method(method)
    x, u = check_point(model, x, u)
    vector = select(model, parameters)
    with applied(vector) as set_model:
        return _certify_step(set_model, vector, x, u, method, derivatives)


def _certify_step(
    model: Model, vector: ParameterVector, x: Array, u: Array, method: str, given: StepDerivatives | None
) -> Certificate:
    space, end = tangent_space(model), model.nx + model.nu
    point = np.concatenate([x, u, vector.values])
    scale = np.concatenate([_scale(space, x), np.maximum(1.0, np.abs(u)), vector.difference_scale()])

    def f(displacement: Array) -> Array:
        moved = _move(space, model.nx, point, scale * displacement)
        return step_at(model, vector, moved[: model.nx], moved[model.nx : end], moved[end:])

    def on_tangent(at: Array, d: StepDerivatives) -> Array:
        return space.jacobian(at[: model.nx], d.x_next, d.A, d.B, d.C) * scale

    d = given or step_jacobians(model, vector, x, u, method)
    beside = None
    if given is None and not vector.parameters:
        jittered = _move(space, model.nx, point, JITTER * scale * jitter_direction(len(scale)))
        d_beside = step_jacobians(model, vector, jittered[: model.nx], jittered[model.nx :], method)
        beside = on_tangent(jittered, d_beside)
    derivative, by_point = on_tangent(point, d), space.names + model.input_names
    changes: tuple[ModeChange, ...] = ()
    if model.contract.contact.collision_pairs:
        changes = find_mode_changes(
            model, f, derivative, rows=space.names, columns=by_point, scale=scale, minus=space.minus
        )
    certificate = certify_displacement(
        one_by_one(f),
        derivative,
        rows=space.names,
        columns=by_point + vector.names,
        scale=scale,
        beside=beside,
        minus=space.minus,
        solver_tolerance=solver_tolerance(model, x, u),
        method=" + ".join(dict.fromkeys((d.method, *d.sources))),
        subject=f"the step of {model.name}",
    )
    return replace(certificate, mode_changes=changes)


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
    """Compare `differentiate_rollout`'s gradient by x0, us and parameters with differences of whole rollouts.

    One row, the loss; columns x0 (on the tangent space), then u[k] step by step, then the parameters. Costs 26
    rollouts per column. `refine` takes the gradient again at h/2 and h/4, `refine_stiffness` at 4 and 16 times
    the contact stiffness (see `drake_diff.refinement`): entries that agree with differences and do not converge
    are `not_converged`.
    """
    check_method(method)
    us = check_inputs(model, us, num_steps)
    x0 = finite_array("x0", x0, (model.nx,))
    vector, space = select(model, parameters), tangent_space(model)
    steps = np.maximum(1.0, np.abs(us.ravel()))
    scale = np.concatenate([_scale(space, x0), steps, vector.difference_scale()])
    end = model.nx + us.size

    def moved(displacement: Array) -> tuple[Array, Array, ParameterVector]:
        point = np.concatenate([x0, us.ravel(), vector.values])
        point = _move(space, model.nx, point, scale * displacement)
        return point[: model.nx], point[model.nx : end].reshape(us.shape), vector.at(point[end:])

    def f(displacement: Array) -> Array:
        x, inputs, values = moved(displacement)
        with applied(values) as set_model:
            return np.array([evaluate_loss(loss, roll_states(set_model, x, inputs), inputs)])

    def on_tangent(displacement: Array) -> tuple[Array, RolloutGradient]:
        x, inputs, values = moved(displacement)
        g = differentiate_rollout(model, x, inputs, loss, parameters=values, method=method)
        by_x0 = g.x0 @ space.derivative_of_plus(x)
        return np.concatenate([by_x0, g.us.ravel(), g.parameters])[None] * scale, g

    derivative, gradient = on_tangent(np.zeros(len(scale)))
    inputs = tuple(f"{name}[{k}]" for k in range(len(us)) for name in model.input_names)
    columns = tuple(f"{name}[0]" for name in space.names) + inputs + vector.names
    refinements = []
    for wanted, by in ((refine, refined), (refine_stiffness, stiffened)):
        if wanted:
            refinements.append(by(model, x0, us, loss, vector, columns, method, gradient))
    certificate = certify_displacement(
        one_by_one(f),
        derivative,
        rows=("loss",),
        columns=columns,
        scale=scale,
        beside=on_tangent(JITTER * jitter_direction(len(scale)))[0],
        solver_tolerance=max(solver_tolerance(model, x, u) for x, u in zip(gradient.xs[:-1], us, strict=True)),
        method=" + ".join(dict.fromkeys((*gradient.methods, *gradient.parameter_sources))),
        subject=f"the rollout of {model.name}",
    )
    return _with_refinements(certificate, gradient, tuple(refinements))


def _with_refinements(
    certificate: Certificate, gradient: RolloutGradient, refinements: tuple[Refinement, ...]
) -> RolloutCertificate:
    codes = np.array(certificate.codes)
    for found in refinements:
        codes[0] = np.where(found.converged, codes[0], np.maximum(codes[0], VERDICTS.index("not_converged")))
    parts = {name: getattr(certificate, name) for name in Certificate.__dataclass_fields__} | {"codes": codes}
    return RolloutCertificate(**parts, gradient=gradient, refinements=refinements)


def solver_tolerance(model: Model, x: Array, u: Array) -> float:
    """How accurately the step at (`x`, `u`) is solved: SAP's tolerance where it has anything to solve."""
    plant = model.plant
    advance(model.double, x, u)
    touching = model.double.touches()
    q = x[: model.nq]
    reach = LIMIT_REACH + 2 * model.time_step * np.abs(x[model.nq :]).max(initial=0)
    near_limit = np.any(q < plant.GetPositionLowerLimits() + reach) or np.any(
        q > plant.GetPositionUpperLimits() - reach
    )
    pd = any(actuator.has_controller() for actuator in actuators(plant))
    return SAP_RELATIVE_TOLERANCE if touching or near_limit or pd or plant.num_constraints() else 0.0


def _scale(space: TangentSpace, x: Array) -> Array:
    """(size,) how far a coordinate is moved relative to the step: its magnitude, at least 1; rotations 1."""
    magnitude = np.maximum(1.0, np.abs(x))
    magnitude[[i for q in space.quaternions for i in range(q, q + 4)]] = 1.0
    return np.delete(magnitude, list(space.quaternions))


def _move(space: TangentSpace, nx: int, point: Array, displacement: Array) -> Array:
    return np.concatenate([space.plus(point[:nx], displacement[: space.size]), point[nx:] + displacement[space.size :]])

"""Does a rollout's gradient converge as the time step shrinks, or as contact stiffens, and to what?

AutoDiffXd can equal differences and both be wrong about the physics: through a compliant bounce the gradient of the
discrete motion can be 10 to 400 times that of the motion it stands for. So the gradient is taken again at h, h/2
and h/4 (at k, 4 k and 16 k, a compliant contact being off by 1/sqrt(k)). Its error being of first order in h, two
changes d1 and d2 of it have |d2| about |d1| / 2, and its limit is g3 + d2. An entry has

    converged   where |d2| <= 0.75 |d1| and the first value is within 10 % of the limit, or both are below 1 %.

Certify the derivative of a step, or of a whole rollout, before it is used.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff._base.differences import one_by_one
from drake_diff.certificates.certificate import JITTER, VERDICTS, Certificate, certify_displacement, jitter_direction
from drake_diff.certificates.mode_changes import ModeChange, find_mode_changes
from drake_diff.derivatives.step import StepDerivatives, check_method, step_at, step_jacobians
from drake_diff.exceptions import InputError
from drake_diff.model.contract import SAP_RELATIVE_TOLERANCE
from drake_diff.model.model import Model
from drake_diff.model.parameters import TIME_STEP, Parameters, ParameterVector, applied, list_parameters, select
from drake_diff.model.plant import actuators
from drake_diff.model.step import advance, check_point
from drake_diff.model.tangent import TangentSpace, tangent_space
from drake_diff.motion.gradient import Loss, RolloutGradient, differentiate_rollout, evaluate_loss, takes_one_argument
from drake_diff.motion.rollout import check_inputs, roll_states

REFINEMENTS = (1, 2, 4)
STIFFENING = (1, 4, 16)
CONTRACTION = 0.75
TRUSTED = 0.1  # how far from its limit a gradient may be, relative to it
STILL = 1e-2  # changes below this part tell no rate
NEGLIGIBLE = 1e-3  # entries below this part of the largest are judged by its measure


@dataclass(frozen=True, eq=False)
class Refinement:
    """A gradient (n,) at three levels of the time step [s] or of the stiffness (a factor), and its limit."""

    by: str
    levels: tuple[float, ...]
    columns: tuple[str, ...]
    values: Array  # (3, n)
    limit: Array  # (n,)
    converged: NDArray[np.bool_]  # (n,)

    @property
    def worst(self) -> int:
        """The column whose first value is furthest from its limit, those that have converged last."""
        distance = np.abs(self.values[0] - self.limit) / np.maximum(np.abs(self.values).max(axis=0), 1e-300)
        return int(np.argmax(distance + 1e6 * ~self.converged))

    def __str__(self) -> str:
        j = self.worst
        values = ", ".join(f"{value:.4g}" for value in self.values[:, j])
        levels = ", ".join(f"{level:.4g}" for level in self.levels)
        if self.converged.all():
            return f"converges with {self.by} ({levels}): by {self.columns[j]} {values}, limit {self.limit[j]:.4g}"
        count = int((~self.converged).sum())
        return (
            f"not converged: do not optimize with this; with {self.by} ({levels}) the gradient by "
            f"{self.columns[j]} is {values}" + (f" ({count} of {len(self.columns)} entries)" if count > 1 else "")
        )


def refined(
    model: Model,
    x0: Array,
    us: Array,
    loss: Loss,
    vector: ParameterVector,
    columns: Sequence[str],
    method: str,
    first: RolloutGradient,
) -> Refinement:
    """The gradient at h, h/2 and h/4 under the same inputs, the loss seeing the states at the same times.

    `first` is the gradient at h. Raises InputError where the time step is itself a parameter, ModelError where the
    model has but one.
    """
    if TIME_STEP in {p.name for p in vector.parameters}:
        raise InputError("parameters", got=TIME_STEP, expected="others, as refine=True changes the time step")
    values = [_flat(model, x0, first, us.shape, 1)]
    for m in REFINEMENTS[1:]:
        finer = model.at_time_step(model.time_step / m)
        gradient = differentiate_rollout(
            finer, x0, np.repeat(us, m, axis=0), _coarse(loss, m), parameters=vector.to_dict(), method=method
        )
        values.append(_flat(model, x0, gradient, us.shape, m))
    return _judge("time step", tuple(model.time_step / m for m in REFINEMENTS), columns, np.array(values), model, us)


def stiffened(
    model: Model,
    x0: Array,
    us: Array,
    loss: Loss,
    vector: ParameterVector,
    columns: Sequence[str],
    method: str,
    first: RolloutGradient,
) -> Refinement:
    """The gradient at k, 4 k and 16 k of every stiffness that the model states, at the model's own time step.

    `first` is the gradient at k. Raises InputError where it states none.
    """
    stiffness = _stated_stiffness(model)
    named = sorted(stiffness.keys() & vector.to_dict().keys())
    if named:
        raise InputError("parameters", got=named[0], expected="others, as refine_stiffness=True changes it")
    if not stiffness:
        raise InputError("refine_stiffness", got="a model that states no point stiffness", expected="one that does")
    values = [_flat(model, x0, first, us.shape, 1)]
    for factor in STIFFENING[1:]:
        with applied(select(model, {name: factor * k for name, k in stiffness.items()})) as stiffer:
            gradient = differentiate_rollout(stiffer, x0, us, loss, parameters=vector.to_dict(), method=method)
        values.append(_flat(model, x0, gradient, us.shape, 1))
    return _judge("stiffness, times", tuple(map(float, STIFFENING)), columns, np.array(values), model, us)


def _stated_stiffness(model: Model) -> dict[str, float]:
    """By body where it has one value, else by geometry."""
    stated = {p.name: float(p.value[0]) for p in list_parameters(model) if p.kind.quantity == "stiffness"}
    return {name: k for name, k in stated.items() if "/" not in name or f"{name.split('/')[0]}.stiffness" not in stated}


def _coarse(loss: Loss, m: int) -> Loss:
    """The loss of a motion with m times as many steps."""
    if takes_one_argument(loss):
        return loss
    return lambda xs, us: loss(xs[::m], us[::m])


def _flat(model: Model, x0: Array, g: RolloutGradient, shape: tuple[int, ...], m: int) -> Array:
    """[by x0 on the tangent space; by each held input; by parameters]."""
    by_x0 = g.by_x0 @ tangent_space(model).derivative_of_plus(x0)
    by_us = g.by_us.reshape(shape[0], m, shape[1]).sum(axis=1).ravel()
    return np.concatenate([by_x0, by_us, g.by_parameters])


def _judge(
    by: str, levels: tuple[float, ...], columns: Sequence[str], values: Array, model: Model, us: Array
) -> Refinement:
    first, second = values[1] - values[0], values[2] - values[1]
    limit = values[2] + second
    size = np.maximum(np.abs(values).max(axis=0), np.abs(limit))
    largest = float(size.max(initial=0.0))
    scale = np.maximum(size, NEGLIGIBLE * largest)
    inputs = slice(tangent_space(model).size, tangent_space(model).size + us.size)
    by_input = size[inputs].reshape(us.shape)
    if us.size:  # one input's entries are one function of time, which may pass through zero
        typical = np.sqrt((by_input**2).mean(axis=0))
        scale[inputs] = np.maximum(by_input, typical).ravel()
    contracts = np.abs(second) <= CONTRACTION * np.abs(first)
    still = np.maximum(np.abs(first), np.abs(second)) <= STILL * scale
    near = np.abs(values[0] - limit) <= TRUSTED * scale
    converged = ((contracts & near) | still) & np.all(np.isfinite(values), axis=0)
    return Refinement(by, levels, tuple(columns), frozen(values), frozen(limit), converged)


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
    the contact stiffness: entries that agree with differences and do not converge
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
        by_x0 = g.by_x0 @ space.derivative_of_plus(x)
        return np.concatenate([by_x0, g.by_us.ravel(), g.by_parameters])[None] * scale, g

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

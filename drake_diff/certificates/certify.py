"""Certify the derivative of a step, or of a whole rollout, before it is used.

Both AutoDiffXd and difference quotients can be wrong about the physics: through a compliant bounce the gradient of the
discrete motion can be 10 to 400 times that of the motion it stands for. So a rollout's gradient may also be taken at h,
h/2 and h/4, or at k, 4 k and 16 k of the contact stiffness (a compliant contact is off by 1/sqrt(k)).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff._base.differences import one_by_one
from drake_diff.certificates.certificate import VERDICTS, Certificate, ModeChange, certify_displacement, jitter
from drake_diff.derivatives.sources import check_method, step_at
from drake_diff.derivatives.step import StepDerivatives, step_jacobians
from drake_diff.exceptions import InputError
from drake_diff.model.contact import SEPARATED, active_modes
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
CONTRACTION = 0.75  # halfway between 1/2, which first order promises, and 1, no convergence
TRUSTED = 0.1  # how far from its limit a gradient may be, relative to it
STILL = 1e-2  # changes below this part tell no rate
NEGLIGIBLE = 1e-3  # entries below this part of the largest are judged by its measure
LIMIT_REACH = 0.05  # [m or rad] a joint limit this near may hold the joint in one of the displaced steps
NEIGHBOURHOOD = 1e-4  # in scaled coordinates: how far away a change of contact mode is looked for
# A row is touched by one if its change departs from what the derivative predicts by this part of the larger one.
TOUCHED = 1e-2


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


def certify(
    model: Model,
    x: ArrayLike,
    u: ArrayLike | None = None,
    *,
    parameters: Parameters = (),
    method: str = "auto",
    derivatives: StepDerivatives | None = None,
) -> Certificate:
    """Compare the Jacobians of one step with differences of the double step, entry by entry.

    Args:
        model: the model whose step it is.
        x: (nx,) the state [q; v].
        u: (nu,) [N or N m] the input; may be left out where the model has none.
        parameters: names, or values by name, of the parameters to differentiate by too.
        method: as in `differentiate_step`.
        derivatives: what to certify, instead of what `differentiate_step` gives.

    Returns:
        The certificate: rows are the next state's, columns those of [x; u; parameters], states on the tangent space
        (a quaternion has three entries).

    Raises:
        UnknownNameError: a method or parameter that does not exist.
        ShapeError, NonFiniteError: a bad x or u.
        GradientError, SimulationError: the step, or its derivative, is refused.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> certificate = dd.certify(model, [0.5, 0.0], [0.1]).require()
        >>> certificate.verdict, certificate.derivative.shape
        ('agree', (2, 3))
    """
    check_method(method)
    x, u = check_point(model, x, u)
    vector = select(model, parameters)
    with applied(vector) as model:
        space, end = tangent_space(model), model.nx + model.nu
        point = np.concatenate([x, u, vector.values])
        scale = np.concatenate([_scale(space, x), np.maximum(1.0, np.abs(u)), vector.difference_scale()])

        def f(displacement: Array) -> Array:
            moved = _move(space, model.nx, point, scale * displacement)
            return step_at(model, vector, moved[: model.nx], moved[model.nx : end], moved[end:])

        def on_tangent(at: Array, d: StepDerivatives) -> Array:
            return space.jacobian(at[: model.nx], d.x_next, d.A, d.B, d.C) * scale

        d, beside = derivatives or step_jacobians(model, vector, x, u, method), None
        if derivatives is None and not vector.parameters:
            jittered = _move(space, model.nx, point, jitter(scale))
            d_beside = step_jacobians(model, vector, jittered[: model.nx], jittered[model.nx :], method)
            beside = on_tangent(jittered, d_beside)
        derivative = on_tangent(point, d)
        certificate = certify_displacement(
            one_by_one(f),
            derivative,
            rows=space.names,
            columns=space.names + model.input_names + vector.names,
            scale=scale,
            beside=beside,
            minus=space.minus,
            solver_tolerance=solver_tolerance(model, x, u),
            method=" + ".join(dict.fromkeys((d.method, *d.sources))),
            subject=f"the step of {model.name}",
        )
        if not model.contract.contact.collision_pairs:
            return certificate
        return replace(certificate, mode_changes=_find_mode_changes(model, space, f, derivative, scale))


def _find_mode_changes(
    model: Model, space: TangentSpace, f: Callable[[Array], Array], derivative: Array, scale: Array
) -> tuple[ModeChange, ...]:
    """Displace each state and input by 1e-4 of its scale to both sides and compare the modes of the step `f`.

    `f` takes a scaled displacement (n,) and leaves the double twin at the step; `derivative` (m, n) is by it.
    """
    directions = np.eye(derivative.shape[1])
    centre, found = f(np.zeros(len(directions))), []
    here = active_modes(model)
    for j, column in enumerate(space.names + model.input_names):
        for reach in (NEIGHBOURHOOD, -NEIGHBOURHOOD):
            step = reach * directions[j]
            change = space.minus(f(step), centre)
            there = active_modes(model)
            predicted = derivative @ step
            size = np.maximum(np.abs(predicted), np.abs(change))
            missed = np.abs(change - predicted) > TOUCHED * np.maximum(size, 1e-6 * size.max(initial=0.0))
            touched = tuple(name for name, miss in zip(space.names, missed, strict=True) if miss)
            for pair in sorted(pair for pair in here.keys() | there.keys() if here.get(pair) != there.get(pair)):
                before, after = here.get(pair, SEPARATED), there.get(pair, SEPARATED)
                found.append(ModeChange(pair, before, after, column, float(reach * scale[j]), touched))
    return tuple(found)


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

    def gradient_at(displacement: Array) -> RolloutGradient:
        x, inputs, values = moved(displacement)
        return differentiate_rollout(model, x, inputs, loss, parameters=values, method=method)

    gradient = gradient_at(np.zeros(len(scale)))
    inputs = tuple(f"{name}[{k}]" for k in range(len(us)) for name in model.input_names)
    columns = tuple(f"{name}[0]" for name in space.names) + inputs + vector.names
    refinements = []
    for wanted, by, levels, refined in (
        (refine, "time step", tuple(model.time_step / m for m in REFINEMENTS), _at_finer_steps),
        (refine_stiffness, "stiffness, times", tuple(map(float, STIFFENING)), _in_stiffer_contact),
    ):
        if wanted:
            values = [_flat(space, gradient, us.shape), *refined(model, x0, us, loss, vector, method)]
            refinements.append(_judge(by, levels, columns, np.array(values), space.size, us.shape))
    certificate = certify_displacement(
        one_by_one(f),
        _flat(space, gradient, us.shape)[None] * scale,
        rows=("loss",),
        columns=columns,
        scale=scale,
        beside=_flat(space, gradient_at(jitter(np.ones(len(scale)))), us.shape)[None] * scale,
        solver_tolerance=max(solver_tolerance(model, x, u) for x, u in zip(gradient.xs[:-1], us, strict=True)),
        method=" + ".join(dict.fromkeys((*gradient.methods, *gradient.parameter_sources))),
        subject=f"the rollout of {model.name}",
    )
    codes = np.array(certificate.codes)
    for found in refinements:
        codes[0] = np.where(found.converged, codes[0], np.maximum(codes[0], VERDICTS.index("not_converged")))
    parts = {name: getattr(certificate, name) for name in Certificate.__dataclass_fields__} | {"codes": codes}
    return RolloutCertificate(**parts, gradient=gradient, refinements=tuple(refinements))


def _flat(space: TangentSpace, g: RolloutGradient, shape: tuple[int, ...]) -> Array:
    """[by x0 on the tangent space; by each of the inputs (N, nu), held over several steps; by parameters]."""
    by_us = g.by_us.reshape(shape[0], len(g.by_us) // shape[0], shape[1]).sum(axis=1)
    return np.concatenate([g.by_x0 @ space.derivative_of_plus(g.xs[0]), by_us.ravel(), g.by_parameters])


def _at_finer_steps(
    model: Model, x0: Array, us: Array, loss: Loss, vector: ParameterVector, method: str
) -> Iterator[Array]:
    """The gradient at h/2 and h/4 under the same inputs, the loss seeing the states at the same times."""
    if TIME_STEP in {p.name for p in vector.parameters}:
        raise InputError("parameters", got=TIME_STEP, expected="others, as refine=True changes the time step")
    for m in REFINEMENTS[1:]:
        finer, held = model.at_time_step(model.time_step / m), np.repeat(us, m, axis=0)
        coarse = loss if takes_one_argument(loss) else lambda xs, us, m=m: loss(xs[::m], us[::m])
        g = differentiate_rollout(finer, x0, held, coarse, parameters=vector.to_dict(), method=method)
        yield _flat(tangent_space(model), g, us.shape)


def _in_stiffer_contact(
    model: Model, x0: Array, us: Array, loss: Loss, vector: ParameterVector, method: str
) -> Iterator[Array]:
    """The gradient at 4 and 16 times every stiffness that the model states, at the model's own time step."""
    stated = {p.name: float(p.value[0]) for p in list_parameters(model) if p.kind.quantity == "stiffness"}
    # By body if all its geometries have one value, else by geometry.
    named = {name for name in stated if "/" not in name or f"{name.split('/')[0]}.stiffness" not in stated}
    if both := sorted(named & vector.to_dict().keys()):
        raise InputError("parameters", got=both[0], expected="others, as refine_stiffness=True changes it")
    if not named:
        raise InputError("refine_stiffness", got="a model that states no point stiffness", expected="one that does")
    for factor in STIFFENING[1:]:
        with applied(select(model, {name: factor * stated[name] for name in stated if name in named})) as stiffer:
            g = differentiate_rollout(stiffer, x0, us, loss, parameters=vector.to_dict(), method=method)
        yield _flat(tangent_space(model), g, us.shape)


def _judge(
    by: str, levels: tuple[float, ...], columns: Sequence[str], values: Array, first: int, shape: tuple[int, ...]
) -> Refinement:
    """Which columns of `values` (3, n) converge; from `first` on are those by the inputs, of `shape` (N, nu).

    An error of first order makes the changes d1 and d2 halve, and the limit is g3 + d2. An entry has converged if
    |d2| <= 0.75 |d1| and its first value is within 10 % of the limit, or if both changes are below 1 %.
    """
    d1, d2 = np.diff(values, axis=0)
    limit = values[2] + d2
    size = np.maximum(np.abs(values).max(axis=0), np.abs(limit))
    scale = np.maximum(size, NEGLIGIBLE * float(size.max(initial=0.0)))
    inputs = slice(first, first + shape[0] * shape[1])
    if shape[1]:  # one input's entries are one function of time, which may pass through zero
        by_input = size[inputs].reshape(shape)
        scale[inputs] = np.maximum(by_input, np.sqrt((by_input**2).mean(axis=0))).ravel()
    contracts = np.abs(d2) <= CONTRACTION * np.abs(d1)
    still = np.maximum(np.abs(d1), np.abs(d2)) <= STILL * scale
    near = np.abs(values[0] - limit) <= TRUSTED * scale
    converged = ((contracts & near) | still) & np.all(np.isfinite(values), axis=0)
    return Refinement(by, levels, tuple(columns), frozen(values), frozen(limit), converged)


def solver_tolerance(model: Model, x: Array, u: Array) -> float:
    """How accurately the step at (`x`, `u`) is solved: SAP's tolerance if SAP has anything to solve, else 0."""
    plant = model.plant
    advance(model.double, x, u)
    q, reach = x[: model.nq], LIMIT_REACH + 2 * model.time_step * np.abs(x[model.nq :]).max(initial=0)
    near_limit = np.any(q < plant.GetPositionLowerLimits() + reach) or np.any(
        q > plant.GetPositionUpperLimits() - reach
    )
    pd = any(actuator.has_controller() for actuator in actuators(plant))
    solves = model.double.touches() or near_limit or pd or plant.num_constraints()
    return SAP_RELATIVE_TOLERANCE if solves else 0.0


def _scale(space: TangentSpace, x: Array) -> Array:
    """(size,) how far a coordinate is moved relative to the step: its magnitude, at least 1; rotations 1."""
    magnitude = np.maximum(1.0, np.abs(x))
    magnitude[[i for q in space.quaternions for i in range(q, q + 4)]] = 1.0
    return np.delete(magnitude, list(space.quaternions))


def _move(space: TangentSpace, nx: int, point: Array, displacement: Array) -> Array:
    return np.concatenate([space.plus(point[:nx], displacement[: space.size]), point[nx:] + displacement[space.size :]])

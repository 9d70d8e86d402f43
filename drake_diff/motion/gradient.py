"""The gradient of a scalar loss through the steps of a rollout, with its norm at every step."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, frozen, number_of_steps
from drake_diff._base.values import ShowsItsRepr, stacked
from drake_diff.derivatives.sources import check_method
from drake_diff.derivatives.step import Linearization, linearize_steps
from drake_diff.derivatives.steps import take_steps
from drake_diff.exceptions import GradientWarning, InputError
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, ParameterVector, applied, select
from drake_diff.model.step import advance
from drake_diff.motion.integrate import TOLERANCE
from drake_diff.motion.loss import Loss, Totals, total_gradients
from drake_diff.motion.policy import Feedback, recording_choice
from drake_diff.motion.rollout import Policy, batch_of, check_inputs, rows_of_batch

if TYPE_CHECKING:
    from drake_diff.motion.undefined import Undefined

CONTINUOUS = "continuous"  # the method that does not use Drake's steps
FINER = 1e-3  # factor on the tolerance if the derivative differs from the converged slope
NAMED = 3  # maximum number of columns listed in a warning


@dataclass(frozen=True, eq=False)
class RolloutGradient(ShowsItsRepr):
    """The loss of a rollout and its gradient, returned by `differentiate_rollout`. Arrays are read-only.

    Under a policy, `us` are the inputs that the policy returned, and all gradients are those of the closed loop. For a
    batch, the loss and all arrays have its leading dimensions: each rollout has its own loss and gradients.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> dd.differentiate_rollout(model, [0, 0], np.zeros((20, 1)), lambda x: x[0], method="autodiff")
        RolloutGradient of 20 steps by autodiff: loss 0
          |by x0| 0.648, |by us| 0.0191
          |d loss / d x_k| from 0.648 at the start to 1 at the end, a factor of 0.979 a step
    """

    loss: Any  # a float, or (...) of a batch
    by_x0: Array  # (nx,)
    by_us: Array  # (N, nu)
    by_parameters: Array  # (np,)
    by_policy: Array  # (n,) with respect to the policy's own parameters
    parameter_names: tuple[str, ...]
    parameter_sources: tuple[str, ...]  # the derivative method of each parameter
    # (N+1,) |d loss / d x_k|, with the later steps as functions of x_k. If it grows without bound for decreasing k, the
    # gradient explodes. If it vanishes, the early inputs cannot be learned.
    state_gradient_norms: Array
    xs: Array  # (N+1, nx) the trajectory
    us: Array  # (N, nu) the applied inputs
    methods: tuple[str, ...]  # the methods of the step Jacobians: one name, or more if a fallback was used
    loss_method: str  # the method that differentiated the loss: "autograd", "autodiff" if autograd cannot, or "jax"
    # For method="continuous": the columns in which the loss has no slope. Their derivative is valid at the point only.
    undefined: tuple[Undefined, ...] = ()

    def __repr__(self) -> str:
        sizes = [f"|by x0| {np.linalg.norm(self.by_x0):.3g}", f"|by us| {np.linalg.norm(self.by_us):.3g}"]
        sizes += [f"|by the policy| {np.linalg.norm(self.by_policy):.3g}"] if self.by_policy.size else []
        if self.xs.ndim > 2:
            mean = f"mean loss {np.mean(self.loss):.6g}"
            return (
                f"RolloutGradient of {self.xs.shape[:-2]} rollouts of {self.us.shape[-2]} steps by "
                f"{' and '.join(self.methods)}: {mean}\n  {', '.join(sizes)}"
            )
        named = zip(self.parameter_names, self.by_parameters, strict=True)
        sizes += [f"by {name} {value:.3g}" for name, value in named]
        first, last = self.state_gradient_norms[[0, -1]]
        return (
            f"RolloutGradient of {len(self.us)} steps by {' and '.join(self.methods)}: loss {self.loss:.6g}\n"
            f"  {', '.join(sizes[:6])}{', ...' if len(sizes) > 6 else ''}\n"
            f"  |d loss / d x_k| from {first:.3g} at the start to {last:.3g} at the end, a factor of "
            f"{self.growth_rate:.3g} a step"
            + (f"\n  no slope for {', '.join(column.column for column in self.undefined)}" if self.undefined else "")
        )

    @property
    def growth_rate(self) -> Any:
        """The factor by which |d loss / d x_k| grows per step back in time, as a geometric mean; 1 is neutral.

        NaN if the norm is zero at either end.
        """
        norms = self.state_gradient_norms
        first, last = (np.where(norms[..., k] == 0, np.nan, norms[..., k]) for k in (0, -1))
        return (first / last)[()] ** (1 / (norms.shape[-1] - 1))


def differentiate_rollout(
    model: Model,
    x0: ArrayLike,
    us: ArrayLike | None,
    loss: Loss,
    *,
    policy: Policy | None = None,
    parameters: Parameters = (),
    num_steps: int | None = None,
    method: str = "auto",
) -> RolloutGradient:
    """Compute the gradient of a loss along a rollout, by reverse accumulation through the Jacobians of its steps.

    Let l_N = dloss/dx_N, g_k = dloss/du_k + B_k' l_(k+1) and l_k = dloss/dx_k + A_k' l_(k+1) + K_k' g_k, where K and P
    are the policy's derivatives with respect to the state and to its own parameters. The gradient is l_0 for x0, g_k
    for u_k, sum_k C_k' l_(k+1) for the model's parameters and sum_k P_k' g_k for the policy's parameters.

    Args:
        model: The discrete model.
        x0: (nx,) the initial state, or (..., nx) those of a batch of rollouts.
        us: (N, nu) the inputs [N or N m], or (..., N, nu), with leading dimensions that are broadcast with those of
            `x0`; None with a policy, or if the model has no actuators.
        loss: `loss(xs, us)` of the states (N+1, nx) and the inputs, or `loss(x_final)` if it takes one argument. It
            returns a scalar and is written with ordinary arithmetic and NumPy functions that AutoDiffXd supports, or in
            JAX with double precision.
        policy: u = policy(x, t), written likewise (see `drake_diff.motion.policy`), in place of `us`.
        parameters: Names of the model's parameters for the gradient, or a mapping of the names to values.
        num_steps: N, if `us` is not given.
        method: The method for the step Jacobians, see `differentiate_step`. With "continuous", the motion in continuous
            time that the steps approximate is integrated with error control, contact included. It is differentiated
            with respect to the state, the inputs, the policy and contact parameters. Columns in which the loss has no
            slope, after many bounces or near grazing contact, are in `undefined`, and a `GradientWarning` names them.
            Their derivative is valid only at the point itself (see `drake_diff.motion.undefined`).

    Returns:
        The loss, `by_x0` (nx,), `by_us` (N, nu), `by_parameters` (np,), `by_policy` (n,), the trajectory, and the norm
        of the gradient with respect to every state.

    Raises:
        GradientError: The loss, the policy or a step has no gradient, or a gradient that is not finite.
        InputError: Both or neither of `us` and `policy` are given, or the loss is not a scalar.
        SimulationError: Drake cannot compute a step.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
        >>> g = dd.differentiate_rollout(model, [0, 0, 1, 0], np.zeros((10, 1)), lambda x: x[0])
        >>> g.by_x0.shape, g.by_us.shape, g.loss > 0.09
        ((4,), (10, 1), True)
    """
    if method != CONTINUOUS:
        check_method(method)
    if us is not None and policy is not None:
        raise InputError("differentiate_rollout", got="us and policy", expected="one of them")
    vector = select(model, parameters)
    if batch := batch_of(model, x0, us):
        more: Any = {"policy": policy, "parameters": vector, "num_steps": num_steps, "method": method}
        rows = rows_of_batch(model, batch, x0, us)
        return _batch_of_gradients([differentiate_rollout(model, x, u, loss, **more) for x, u in rows], batch)
    x0 = model.finite_state("x0", x0)
    if method == CONTINUOUS:
        return _in_continuous_time(model, x0, us, policy, loss, vector, num_steps)
    feedback: list[Feedback] = []
    with applied(vector) as set_model:
        if policy is None:
            inputs = check_inputs(model, us, num_steps)
            linearization = linearize_steps(take_steps(set_model, vector, x0, inputs), method)
        else:
            steps = number_of_steps(num_steps)
            linearization, feedback, inputs = _close_the_loop(set_model, x0, policy, steps, vector, method)
    value, totals = total_gradients(loss, x0, inputs, policy, linearization, feedback)
    return _collected(value, totals, x0, inputs, linearization)


def _batch_of_gradients(gradients: list[RolloutGradient], batch: tuple[int, ...]) -> RolloutGradient:
    """Return the gradients of rollouts in one, with leading dimensions."""
    return stacked(
        gradients,
        batch,
        methods=tuple(sorted({method for g in gradients for method in g.methods})),
        loss_method=" and ".join(sorted({g.loss_method for g in gradients})),
        undefined=tuple(column for g in gradients for column in g.undefined),
    )


def _collected(
    value: float,
    totals: Totals,
    x0: Array,
    inputs: Array,
    linearization: Linearization,
) -> RolloutGradient:
    """Make the RolloutGradient from the loss, its total gradients and the linearized steps."""
    return RolloutGradient(
        loss=value,
        by_x0=frozen(totals.states[0]),
        by_us=frozen(totals.inputs),
        by_parameters=frozen(totals.parameters),
        parameter_names=linearization.parameters,
        parameter_sources=linearization.sources,
        by_policy=frozen(totals.policy),
        state_gradient_norms=frozen(np.linalg.norm(totals.states, axis=1)),
        xs=frozen(np.vstack([x0, linearization.x_next])),
        us=frozen(inputs),
        methods=linearization.methods,
        loss_method=totals.loss_method,
    )


def _in_continuous_time(
    model: Model,
    x0: Array,
    us: ArrayLike | None,
    policy: Policy | None,
    loss: Loss,
    vector: ParameterVector,
    num_steps: int | None,
) -> RolloutGradient:
    """Compute the gradient along the flow; warn if the loss has no slope. See `drake_diff.motion.undefined`."""
    from drake_diff.motion.flow import FlowSteps  # loads CasADi
    from drake_diff.motion.undefined import Beside, undefined_columns

    given = check_inputs(model, us, num_steps) if policy is None else np.zeros((number_of_steps(num_steps), model.nu))
    with applied(vector) as set_model:
        beside = Beside(model, x0, given, policy, loss, vector, FlowSteps(set_model, vector))
    still = np.zeros(beside.space.size + len(beside.given) + len(vector.values))
    for tolerance in (TOLERANCE, FINER * TOLERANCE):
        linearization, feedback, inputs = beside.linearize(still, tolerance)
        value, totals = total_gradients(loss, x0, inputs, policy, linearization, feedback)
        undefined = undefined_columns(beside, totals)
        if not any(column.missed for column in undefined):
            break
    if undefined:
        more = f", and {len(undefined) - NAMED} more" if len(undefined) > NAMED else ""
        named = "; ".join(str(column) for column in undefined[:NAMED])
        warnings.warn(
            f"the loss has no slope with respect to {len(undefined)} variables, whose derivatives are valid at the "
            f"point only: {named}{more}",
            GradientWarning,
            stacklevel=3,
        )
    gradient = _collected(value, totals, x0, inputs, linearization)
    return replace(gradient, undefined=undefined)


def _close_the_loop(
    model: Model, x0: Array, policy: Policy, count: int, vector: ParameterVector, method: str
) -> tuple[Linearization, list[Feedback], Array]:
    """Roll out under the policy, then compute the derivatives of all steps at once."""
    feedback = list[Feedback]()
    choose = recording_choice(policy, model, feedback)
    x, xs, inputs = x0, np.empty((count, model.nx)), np.empty((count, model.nu))
    for k in range(count):
        xs[k], inputs[k] = x, choose(x, k)
        x = advance(model.double, x, inputs[k])
    return linearize_steps(take_steps(model, vector, x0, inputs, xs), method), feedback, inputs

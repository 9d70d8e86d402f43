"""The loss of a trajectory, and its gradient by reverse accumulation through the derivatives of the steps."""

import inspect
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import called, carrying, gradient_of, traced_gradient, user_function
from drake_diff.derivatives.step import Linearization
from drake_diff.exceptions import GradientError, InputError
from drake_diff.motion.policy import Feedback, policy_parameters

Loss = Callable[..., Any]
AUTOGRAD, AUTODIFF, JAX = "autograd", "autodiff", "jax"  # the methods that differentiate a loss


@dataclass(frozen=True, eq=False)
class Totals:
    """Total gradients of a loss with respect to states, inputs and parameters, each with the batch's dimensions."""

    states: Array  # (..., N+1, nx)
    inputs: Array  # (..., N, nu)
    parameters: Array  # (..., np) of the model
    policy: Array  # (n,) of the policy
    loss_method: str = ""  # see `differentiate_loss`


def accumulate(
    jacobians: Array,
    by_xs: Array,
    by_us: Array,
    feedback: Sequence[Feedback] = (),
    num_policy_parameters: int = 0,
) -> Totals:
    """Compute the total gradients of a loss from its partial gradients `by_xs` (..., N+1, nx) and `by_us` (..., N, nu).

    `jacobians` (..., N, nx, nx + nu + np) are those of the steps. Only products of a row with a Jacobian are formed.
    With the feedback of a policy, there are no leading dimensions.
    """
    state, inputs = np.array(by_xs), np.array(by_us)
    nx, end = state.shape[-1], state.shape[-1] + inputs.shape[-1]
    parameters = np.zeros((*state.shape[:-2], jacobians.shape[-1] - end))
    policy = np.zeros(num_policy_parameters)
    for k in reversed(range(inputs.shape[-2])):
        row = np.matmul(state[..., k + 1, None, :], jacobians[..., k, :, :])[..., 0, :]
        state[..., k, :] += row[..., :nx]
        inputs[..., k, :] += row[..., nx:end]
        parameters += row[..., end:]
        if feedback:
            by_x, by_parameters, active = feedback[k]
            state[k] += by_x.T @ inputs[k]
            policy[active] += by_parameters.T @ inputs[k]
    return Totals(state, inputs, parameters, policy)


def total_gradients(
    loss: Loss,
    x0: Array,
    us: Array,
    policy: Any,
    linearization: Linearization,
    feedback: Sequence[Feedback],
) -> tuple[float, Totals]:
    """Return the value of a loss of the steps from `x0` (nx,) under `us` (N, nu), and its total gradients."""
    xs = np.vstack([x0, linearization.x_next])
    value, by_xs, by_us, method = differentiate_loss(loss, xs, us)
    totals = accumulate(linearization.jacobians, by_xs, by_us, feedback, len(policy_parameters(policy)))
    return value, replace(totals, loss_method=method)


def evaluate_loss(loss: Loss, xs: Array, us: Array) -> float:
    """Evaluate `loss` at a rollout of floats."""
    arguments = (xs[-1],) if takes_one_argument(loss) else (xs, us)
    return float(called("loss", loss, *arguments, shape=()))


def differentiate_loss(loss: Loss, xs: Array, us: Array) -> tuple[float, Array, Array, str]:
    """Return the value of `loss`, its partial gradients with respect to xs (N+1, nx) and us (N, nu), and the method.

    The method is "jax" for a function that returns a JAX array. Otherwise it is "autograd", or "autodiff" for a
    function that autograd does not support and for a loss of the final state only. The time of "autodiff" grows with
    the square of the trajectory's length.
    """
    arguments = (xs[-1],) if takes_one_argument(loss) else (xs, us)
    with np.errstate(all="ignore"):
        result = called("loss", loss, *arguments, shape=())  # raises a descriptive error if the loss is invalid
    if "jax" in sys.modules and isinstance(result, sys.modules["jax"].Array):
        return _by_jax(loss, arguments, xs, us)
    if len(arguments) == 1:
        value, gradient = gradient_of(user_function("loss", loss), xs[-1])
        return value, np.vstack([np.zeros_like(xs[:-1]), gradient]), np.zeros_like(us), AUTODIFF
    try:
        with np.errstate(all="ignore"):  # values that are not finite are refused below
            value, (by_xs, by_us) = traced_gradient(loss, (xs, us))
    except Exception:  # not supported by autograd, or an error in the loss, which AutoDiffXd then reports
        return *_by_autodiff(loss, xs, us), AUTODIFF
    return _finite(value, by_xs, by_us, AUTOGRAD)


def _by_jax(loss: Loss, arguments: tuple[Array, ...], xs: Array, us: Array) -> tuple[float, Array, Array, str]:
    """Differentiate a loss that is written in JAX."""
    jax: Any = sys.modules["jax"]
    # It is not compiled, since a compiled loss would keep the globals and attributes that it read at first.
    value, gradients = carrying("loss", jax.value_and_grad(loss, argnums=tuple(range(len(arguments)))), *arguments)
    if value.dtype != float:
        expected = 'double precision: jax.config.update("jax_enable_x64", True)'
        raise InputError("loss", got=f"a JAX array of {value.dtype}", expected=expected)
    by_xs, by_us = np.zeros_like(xs), np.zeros_like(us)
    if len(arguments) == 1:
        by_xs[-1] = gradients[0]
    else:
        by_xs[:], by_us[:] = gradients
    return _finite(float(value), by_xs, by_us, JAX)


def _finite(value: float, by_xs: Array, by_us: Array, method: str) -> tuple[float, Array, Array, str]:
    """Return the arguments if they are finite, or raise GradientError."""
    if not (np.isfinite(value) and np.all(np.isfinite(by_xs)) and np.all(np.isfinite(by_us))):
        raise GradientError(f"the loss or its gradient is not finite, like the gradient of a norm at 0: loss {value}")
    return value, by_xs, by_us, method


def _by_autodiff(loss: Loss, xs: Array, us: Array) -> tuple[float, Array, Array]:
    """Differentiate as `differentiate_loss`, in a time that grows with the square of the trajectory's length."""
    split = xs.size

    def flat(z: Any) -> Any:
        return carrying("loss", loss, z[:split].reshape(xs.shape), z[split:].reshape(us.shape))

    value, gradient = gradient_of(flat, np.concatenate([xs.ravel(), us.ravel()]))
    return value, gradient[:split].reshape(xs.shape), gradient[split:].reshape(us.shape)


def takes_one_argument(loss: Loss) -> bool:
    """Check if `loss` is a function of the final state only."""
    arguments = [p for p in inspect.signature(loss).parameters.values() if p.default is p.empty]
    required = [p for p in arguments if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if len(required) not in (1, 2):
        raise InputError("loss", got=f"{len(required)} arguments", expected="loss(xs, us) or loss(x_final)")
    return len(required) == 1

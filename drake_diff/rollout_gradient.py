"""The gradient of a scalar back through the steps of a rollout, with its norm at every step."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff.arrays import Array, finite_array, frozen
from drake_diff.autodiff import gradient_of
from drake_diff.exceptions import InputError
from drake_diff.model import Model
from drake_diff.rollout import check_inputs
from drake_diff.step_derivatives import StepDerivatives, differentiate_step

Loss = Callable[..., Any]


@dataclass(frozen=True, eq=False)
class RolloutGradient:
    """loss and its gradient by x0 (nx,), us (N, nu) and parameters (np,).

    `state_gradient_norms` (N+1,) is |d loss / d x_k|, the later steps being functions of x_k: where it grows
    without bound going back the gradient explodes, where it dies out the early inputs cannot be learned.
    """

    loss: float
    x0: Array
    us: Array
    parameters: Array
    parameter_names: tuple[str, ...]
    state_gradient_norms: Array
    xs: Array  # (N+1, nx) the rollout itself
    methods: tuple[str, ...]  # where the step Jacobians came from: one name, or more where a fallback was taken


def differentiate_rollout(
    model: Model,
    x0: ArrayLike,
    us: ArrayLike | None,
    loss: Loss,
    *,
    parameters: Sequence[str] = (),
    num_steps: int | None = None,
    method: str = "auto",
) -> RolloutGradient:
    """The gradient of `loss` along the rollout from `x0` (nx,) under `us` (N, nu).

    `loss(xs, us)`, or `loss(x_final)` where it takes one argument, is a scalar written with ordinary arithmetic
    and NumPy functions, so that AutoDiffXd flows through it. Reverse accumulation through the step Jacobians:
    with l_N = dloss/dx_N, l_k = dloss/dx_k + A_k' l_(k+1), the gradients are l_0 by x0,
    dloss/du_k + B_k' l_(k+1) by u_k and sum_k C_k' l_(k+1) by the parameters.
    """
    us = check_inputs(model, us, num_steps)
    x0 = finite_array("x0", x0, (model.nx,))
    linearization = linearize(model, x0, us, parameters=parameters, method=method)
    xs = np.vstack([x0, [d.x_next for d in linearization]])
    value, by_xs, by_us = differentiate_loss(loss, xs, us)
    state_gradients, input_gradients, parameter_gradient = accumulate(linearization, by_xs, by_us)
    return RolloutGradient(
        loss=value,
        x0=frozen(state_gradients[0]),
        us=frozen(input_gradients),
        parameters=frozen(parameter_gradient),
        parameter_names=linearization[0].parameters,
        state_gradient_norms=frozen(np.linalg.norm(state_gradients, axis=1)),
        xs=frozen(xs),
        methods=tuple(sorted({d.method for d in linearization})),
    )


def linearize(
    model: Model, x0: Array, us: Array, *, parameters: Sequence[str] = (), method: str = "auto"
) -> list[StepDerivatives]:
    """The step derivatives along the rollout from `x0` (nx,) under `us` (N, nu)."""
    found: list[StepDerivatives] = []
    x = x0
    for u in us:
        found.append(differentiate_step(model, x, u, parameters=parameters, method=method))
        x = found[-1].x_next
    return found


def accumulate(linearization: Sequence[StepDerivatives], by_xs: Array, by_us: Array) -> tuple[Array, Array, Array]:
    """From a loss's partial gradients by xs (N+1, nx) and us (N, nu) to its total ones, and by parameters (np,)."""
    state = np.array(by_xs)
    inputs = np.array(by_us)
    parameters = np.zeros(linearization[0].C.shape[1])
    for k in reversed(range(len(linearization))):
        d = linearization[k]
        inputs[k] += d.B.T @ state[k + 1]
        parameters += d.C.T @ state[k + 1]
        state[k] += d.A.T @ state[k + 1]
    return state, inputs, parameters


def evaluate_loss(loss: Loss, xs: Array, us: Array) -> float:
    """`loss` at a rollout of plain numbers."""
    return float(loss(xs[-1]) if takes_one_argument(loss) else loss(xs, us))


def differentiate_loss(loss: Loss, xs: Array, us: Array) -> tuple[float, Array, Array]:
    """(value, gradient by xs (N+1, nx), gradient by us (N, nu)) of `loss` on its own, the steps apart."""
    if takes_one_argument(loss):
        value, gradient = gradient_of(loss, xs[-1])
        return value, np.vstack([np.zeros_like(xs[:-1]), gradient]), np.zeros_like(us)
    split = xs.size

    def flat(z: Any) -> Any:
        return loss(z[:split].reshape(xs.shape), z[split:].reshape(us.shape))

    value, gradient = gradient_of(flat, np.concatenate([xs.ravel(), us.ravel()]))
    return value, gradient[:split].reshape(xs.shape), gradient[split:].reshape(us.shape)


def takes_one_argument(loss: Loss) -> bool:
    """Whether `loss` is a function of the final state alone."""
    required = [
        p
        for p in inspect.signature(loss).parameters.values()
        if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
    ]
    if len(required) not in (1, 2):
        raise InputError("loss", got=f"{len(required)} arguments", expected="loss(xs, us) or loss(x_final)")
    return len(required) == 1

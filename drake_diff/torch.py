"""Steps, rollouts and plans as functions of PyTorch tensors, in double precision and with leading batch dimensions.

`step`, `rollout` and `solve` are documented at `drake_diff.bridges.functions.Functions`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.bridges.functions import Functions
from drake_diff.bridges.plans import PlanFunction
from drake_diff.bridges.rollouts import RolloutFunction
from drake_diff.exceptions import GradientError, MissingDependencyError

try:
    import torch
    from torch import Tensor
except ImportError as error:
    raise MissingDependencyError(f"it needs PyTorch ({error}): pip install 'drake-diff[torch]'") from error


class _States(torch.autograd.Function):  # type: ignore[misc]  # PyTorch is an optional dependency
    """The states of rollouts, or the end state of a `single` step, and the pull-back of their gradients."""

    @staticmethod
    def forward(ctx: Any, function: RolloutFunction, single: bool, x0: Tensor, us: Tensor, *values: Tensor) -> Tensor:
        """Return the states (..., N+1, nx), or (..., nx) for inputs (..., nu) of a single step."""
        inputs = _numbers(us)[..., None, :] if single else _numbers(us)
        xs, touching = function.states(_numbers(x0), inputs, [*map(_numbers, values)])
        states = torch.from_numpy(xs[..., 1, :] if single else xs).to(x0.device)
        ctx.function, ctx.single, ctx.touching = function, single, touching
        ctx.save_for_backward(x0, us, states, *values)
        return states

    @staticmethod
    def backward(ctx: Any, by_states: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients by x0, us and the parameters' values."""
        _refuse_a_graph()
        device, by_xs = by_states.device, _numbers(by_states)
        x0, us, xs, *values = map(_numbers, ctx.saved_tensors)
        if ctx.single:
            xs, by_xs, us = np.stack([x0, xs], -2), np.stack([np.zeros_like(by_xs), by_xs], -2), us[..., None, :]
        by_x0, by_us, *by_values = ctx.function.pull_back(xs, us, ctx.touching, values, by_xs)
        gradients = by_x0, by_us[..., 0, :] if ctx.single else by_us, *by_values
        return None, None, *(torch.from_numpy(gradient).to(device) for gradient in gradients)


class _Plans(torch.autograd.Function):  # type: ignore[misc]
    """The arrays of a plan, and the pull-back of their gradients."""

    @staticmethod
    def forward(ctx: Any, function: PlanFunction, *values: Tensor) -> tuple[Tensor, ...]:
        """Return the states, the inputs, the cost and the horizon."""
        ctx.function = function
        ctx.save_for_backward(*values)
        return tuple(torch.from_numpy(a).to(values[0].device) for a in function.plans([*map(_numbers, values)]))

    @staticmethod
    def backward(ctx: Any, *by_plan: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients by the values."""
        _refuse_a_graph()
        gradients = ctx.function.pull_back([*map(_numbers, ctx.saved_tensors)], [*map(_numbers, by_plan)])
        return None, *(torch.from_numpy(gradient).to(by_plan[0].device) for gradient in gradients)


def _refuse_a_graph() -> None:
    """Raise GradientError if PyTorch records the backward pass, as it does with create_graph=True."""
    if torch.is_grad_enabled():
        raise GradientError("drake_diff has no second derivatives of steps and plans: expected create_graph=False")


def _numbers(tensor: Tensor) -> Array:
    return np.asarray(tensor.detach().cpu().numpy())


def _array(value: Any) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64)


def _broadcast(array: Tensor, shape: tuple[int, ...]) -> Tensor:
    return array if array.shape == shape else array.expand(shape)  # `expand` takes as long as a small step


def _loop(advance: Callable[[Any, Any], Any], x0: Tensor, count: int) -> tuple[Tensor, Tensor]:
    xs, us = [x0], []
    for k in range(count):
        x, u = advance(xs[-1], k)
        xs.append(x)
        us.append(u)
    return torch.stack(xs, -2), torch.stack(us, -2)


_FUNCTIONS = Functions(_array, _broadcast, _States.apply, _loop, _Plans.apply)
step, rollout, solve = _FUNCTIONS.step, _FUNCTIONS.rollout, _FUNCTIONS.solve

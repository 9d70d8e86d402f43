"""The rollouts that a certificate takes: the loss at displaced first states, inputs and parameters."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array
from drake_diff.certificates.certify import move, state_scale
from drake_diff.certificates.feedback import fresh, with_parameters
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied
from drake_diff.model.step import advance
from drake_diff.model.tangent import TangentSpace, tangent_space
from drake_diff.motion.gradient import Loss, RolloutGradient, differentiate_rollout, evaluate_loss
from drake_diff.motion.policy import policy_parameters

Point = tuple[Array, Array, Array, ParameterVector]  # x0 (nx,), us (N, nu), the policy's parameters, the model's


@dataclass(frozen=True, eq=False)
class Displaced:
    """A rollout of N steps under `us` (N, nu), or under `policy`, and all that its gradient is by.

    A displacement (n,) is [x0 on the tangent space; the inputs step by step, or the policy's parameters; the model's
    parameters], each relative to `scale` (n,).
    """

    model: Model
    x0: Array
    us: Array  # (N, nu); under a policy (N, 0), as no input is given
    loss: Loss
    policy: Any
    vector: ParameterVector
    method: str

    @cached_property
    def space(self) -> TangentSpace:
        return tangent_space(self.model)

    @cached_property
    def _values(self) -> Array:
        """(n - size,) all but the state."""
        return np.concatenate([self.us.ravel(), policy_parameters(self.policy), self.vector.values])

    @cached_property
    def scale(self) -> Array:
        """(n,) what one unit of a displacement is: the magnitude of what it moves, at least 1."""
        given = self._values[: len(self._values) - len(self.vector.values)]
        steps = np.maximum(1.0, np.abs(given))
        return np.concatenate([state_scale(self.space, self.x0), steps, self.vector.difference_scale()])

    @property
    def columns(self) -> tuple[str, ...]:
        """(n,) names."""
        inputs = tuple(f"{name}[{k}]" for k in range(len(self.us)) for name in self.model.input_names)
        if self.policy is not None:
            inputs = tuple(f"policy[{i}]" for i in range(len(policy_parameters(self.policy))))
        return tuple(f"{name}[0]" for name in self.space.names) + inputs + self.vector.names

    def at(self, displacement: Array) -> Point:
        """What is rolled out at a displacement (n,)."""
        point = move(self.space, self.model.nx, np.concatenate([self.x0, self._values]), self.scale * displacement)
        sizes = self.model.nx, self.us.size, len(policy_parameters(self.policy))
        x0, us, parameters, values = np.split(point, np.cumsum(sizes))
        return x0, us.reshape(self.us.shape), parameters, self.vector.at(values)

    def gradient(self, displacement: Array) -> RolloutGradient:
        """The gradient at a displacement (n,)."""
        x0, us, parameters, values = self.at(displacement)
        options: dict[str, Any] = {"parameters": values, "method": self.method}
        if self.policy is None:
            return differentiate_rollout(self.model, x0, us, self.loss, **options)
        policy = with_parameters(fresh(self.policy), parameters)
        return differentiate_rollout(self.model, x0, None, self.loss, policy=policy, num_steps=len(self.us), **options)

    def flat(self, g: RolloutGradient) -> Array:
        """(n,) the gradient by what a displacement moves, `scale` left out."""
        by_x0 = g.by_x0 @ self.space.derivative_of_plus(g.xs[0])
        return np.concatenate([by_x0, g.by_us.ravel() if self.policy is None else g.by_policy, g.by_parameters])

    def roll(self, displacement: Array, policy: Any = None) -> float:
        """The loss of the double plant's rollout at a displacement (n,), under `policy` or one without a memory."""
        x0, us, parameters, values = self.at(displacement)
        if self.policy is not None:
            policy = with_parameters(fresh(self.policy) if policy is None else policy, parameters)
        xs, inputs = np.empty((len(us) + 1, self.model.nx)), np.empty((len(us), self.model.nu))
        xs[0] = x0
        with applied(values) as model:
            for k in range(len(us)):
                inputs[k] = us[k] if policy is None else _ask(policy, xs[k], k * model.time_step, model.nu)
                xs[k + 1] = advance(model.double, xs[k], inputs[k])
        return evaluate_loss(self.loss, xs, inputs)

    def losses(self, displacements: Array) -> Array:
        """(K, 1) of displacements (K, n)."""
        return np.array([[self.roll(d)] for d in displacements])


def _ask(policy: Any, x: Array, t: float, nu: int) -> Array:
    return finite_array("policy(x, t)", policy(x.copy(), t), (nu,))

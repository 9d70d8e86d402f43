"""The rollouts that a certificate takes: the loss at displaced first states, inputs and parameters."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, finite_array
from drake_diff.certificates.certify import move, solver_tolerance, state_scale
from drake_diff.certificates.feedback import fresh, with_parameters
from drake_diff.derivatives.polish import Polished, polished_steps
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied
from drake_diff.model.step import advance
from drake_diff.model.tangent import TangentSpace, tangent_space
from drake_diff.motion.gradient import RolloutGradient, differentiate_rollout
from drake_diff.motion.loss import Loss, evaluate_loss
from drake_diff.motion.policy import policy_parameters

MANY = 256  # rollouts whose steps are solved at once
Point = tuple[Array, Array, Array, ParameterVector]  # x0 (nx,), us (N, nu), the policy's parameters, the model's


class NotSolvedError(Exception):
    """A step is not known to rounding; it says why."""


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

    @property
    def kinds(self) -> Indices:
        """(n,) which columns are of a kind: positions, velocities, one input, the policy's or one model parameter."""
        of_x0 = [0] * self.model.nv + [1] * self.model.nv
        given = [2 + i for _ in self.us for i in range(self.us.shape[1])] + [2] * len(policy_parameters(self.policy))
        first = 2 + max(1, self.us.shape[1])
        of_model = [first + i for i, p in enumerate(self.vector.parameters) for _ in p.value]
        return np.array([*of_x0, *given, *of_model], dtype=np.intp)

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

    def losses(self, displacements: Array, policy: Any = None) -> Array:
        """(K, 1) of the double plant's rollouts at displacements (K, n); `policy` is one that may keep its memory."""
        return np.array([[self._roll(d, policy)] for d in displacements])

    def _roll(self, displacement: Array, policy: Any) -> float:
        x0, us, parameters, values = self.at(displacement)
        ask = self.inputs(us, parameters, policy)
        xs, inputs = np.empty((len(us) + 1, self.model.nx)), np.empty((len(us), self.model.nu))
        xs[0] = x0
        with applied(values) as model:
            for k in range(len(us)):
                inputs[k] = ask(xs[k], k, model.time_step)
                xs[k + 1] = advance(model.double, xs[k], inputs[k])
        return evaluate_loss(self.loss, xs, inputs)

    def left_by_drake(self, g: RolloutGradient) -> tuple[Array, float]:
        """(N, size) what Drake's own steps along the motion of `g` leave unsolved, and the worst, of the momentum.

        Raises NotSolvedError where a step is not known to rounding.
        """
        with applied(self.vector) as model:
            found = polished_steps(model, self.vector, g.xs[:-1], g.us)
        _check_solved(found)
        left = [self.space.minus(*pair) for pair in zip(found.drake, found.x_next, strict=True)]
        return np.array(left), float(np.max(found.left))

    def solved_losses(self, left: Array, displacements: Array) -> Array:
        """(K, 1) as `losses`, of rollouts whose every step is solved to rounding and then moved by `left` (N, size).

        That is what Drake's own steps leave unsolved along the motion, so that this is where the rollouts start from,
        and differences are of the steps' equation there. Raises NotSolvedError as `left_by_drake`.
        """
        parts = np.array_split(displacements, -(-len(displacements) // MANY))
        return np.vstack([self._solved(left, part) for part in parts])

    def _solved(self, left: Array, displacements: Array) -> Array:
        count, size = len(self.us), len(displacements)
        points = [self.at(d) for d in displacements]
        asks = [self.inputs(us, parameters, None) for _, us, parameters, _ in points]
        values = np.array([vector.values for *_, vector in points])
        times = [self.vector.time_step(row) for row in values]
        xs, inputs = np.empty((size, count + 1, self.model.nx)), np.empty((size, count, self.model.nu))
        xs[:, 0] = [x0 for x0, *_ in points]
        with applied(self.vector) as model:
            for k in range(count):
                inputs[:, k] = [ask(x, k, h) for ask, x, h in zip(asks, xs[:, k], times, strict=True)]
                found = polished_steps(model, self.vector, xs[:, k], inputs[:, k], values)
                _check_solved(found)
                xs[:, k + 1] = [self.space.plus(x_next, left[k]) for x_next in found.x_next]
        return np.array([[evaluate_loss(self.loss, *motion)] for motion in zip(xs, inputs, strict=True)])

    def solver_tolerance(self, g: RolloutGradient) -> float:
        """How accurately the steps along the motion of `g` are solved by Drake; 0 where they are known to rounding."""
        with applied(self.vector) as model:
            return max(solver_tolerance(model, x, u) for x, u in zip(g.xs[:-1], g.us, strict=True))

    def inputs(self, us: Array, parameters: Array, policy: Any) -> Callable[[Array, int, float], Array]:
        """The input (nu,) at a state, a step and a time step [s]."""
        if self.policy is None:
            return lambda x, k, h: us[k]
        asked, nu = with_parameters(fresh(self.policy) if policy is None else policy, parameters), self.model.nu
        return lambda x, k, h: finite_array("policy(x, t)", asked(x.copy(), k * h), (nu,))


def _check_solved(found: Polished) -> None:
    for k, refusal in found.refused.items():
        raise NotSolvedError(f"{refusal} (step {k})" if len(found.refused) < len(found.left) else str(refusal))

"""Does a rollout's gradient converge as the time step shrinks, or as contact stiffens, and to what?

AutoDiffXd can equal differences and both be wrong about the physics: through a compliant bounce the gradient of the
discrete motion can be 10 to 400 times that of the motion it stands for. So the gradient is taken again at h, h/2
and h/4 (at k, 4 k and 16 k, a compliant contact being off by 1/sqrt(k)). Its error being of first order in h, two
changes d1 and d2 of it have |d2| about |d1| / 2, and its limit is g3 + d2. An entry has

    converged   where |d2| <= 0.75 |d1| and the first value is within 10 % of the limit, or both are below 1 %.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_diff.arrays import Array, frozen
from drake_diff.exceptions import InputError
from drake_diff.model import Model
from drake_diff.parameters import TIME_STEP, ParameterVector, applied, select
from drake_diff.rollout_gradient import Loss, RolloutGradient, differentiate_rollout, takes_one_argument
from drake_diff.tangent import tangent_space

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
    stated = {p.name: float(p.value[0]) for p in model.parameters if p.kind.quantity == "stiffness"}
    return {name: k for name, k in stated.items() if "/" not in name or f"{name.split('/')[0]}.stiffness" not in stated}


def _coarse(loss: Loss, m: int) -> Loss:
    """The loss of a motion with m times as many steps."""
    if takes_one_argument(loss):
        return loss
    return lambda xs, us: loss(xs[::m], us[::m])


def _flat(model: Model, x0: Array, g: RolloutGradient, shape: tuple[int, ...], m: int) -> Array:
    """[by x0 on the tangent space; by each held input; by parameters]."""
    by_x0 = g.x0 @ tangent_space(model).derivative_of_plus(x0)
    by_us = g.us.reshape(shape[0], m, shape[1]).sum(axis=1).ravel()
    return np.concatenate([by_x0, by_us, g.parameters])


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

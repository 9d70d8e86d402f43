"""The gradient at finer time steps or in stiffer contact.

Both AutoDiffXd and difference quotients can be wrong about the physics: through a compliant bounce the gradient of the
discrete motion can be 10 to 400 times that of the motion it stands for. So a rollout's gradient may also be taken at h,
h/2 and h/4, or at k, 4 k and 16 k of the contact stiffness (a compliant contact is off by 1/sqrt(k)).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, frozen
from drake_diff.exceptions import InputError
from drake_diff.model.model import Model
from drake_diff.model.parameters import TIME_STEP, ParameterVector, applied, list_parameters, select
from drake_diff.model.tangent import TangentSpace, tangent_space
from drake_diff.motion.gradient import Loss, RolloutGradient, differentiate_rollout, takes_one_argument

REFINEMENTS = (1, 2, 4)
STIFFENING = (1, 4, 16)
CONTRACTION = 0.75  # halfway between 1/2, which first order promises, and 1, no convergence
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


def flat_gradient(space: TangentSpace, g: RolloutGradient, shape: tuple[int, ...]) -> Array:
    """[by x0 on the tangent space; by each of the inputs (N, nu), held over several steps; by parameters]."""
    by_us = g.by_us.reshape(shape[0], len(g.by_us) // shape[0], shape[1]).sum(axis=1)
    return np.concatenate([g.by_x0 @ space.derivative_of_plus(g.xs[0]), by_us.ravel(), g.by_parameters])


def at_finer_steps(
    model: Model, x0: Array, us: Array, loss: Loss, vector: ParameterVector, method: str
) -> Iterator[Array]:
    """The gradient at h/2 and h/4 under the same inputs, the loss seeing the states at the same times."""
    if TIME_STEP in {p.name for p in vector.parameters}:
        raise InputError("parameters", got=TIME_STEP, expected="others, as refine=True changes the time step")
    for m in REFINEMENTS[1:]:
        finer, held = model.at_time_step(model.time_step / m), np.repeat(us, m, axis=0)
        coarse = loss if takes_one_argument(loss) else lambda xs, us, m=m: loss(xs[::m], us[::m])
        g = differentiate_rollout(finer, x0, held, coarse, parameters=vector.to_dict(), method=method)
        yield flat_gradient(tangent_space(model), g, us.shape)


def in_stiffer_contact(
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
        yield flat_gradient(tangent_space(model), g, us.shape)


def judge_levels(
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

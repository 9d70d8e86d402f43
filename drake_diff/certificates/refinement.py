"""The gradient at finer time steps or in stiffer contact, and beside the slope of the motion itself.

Both AutoDiffXd and difference quotients can be wrong about the physics: through a compliant bounce the gradient of the
discrete motion can be 10 to 400 times that of the motion it stands for. So a rollout's gradient may also be taken at h,
h/2 and h/4, or at k, 4 k and 16 k of the contact stiffness (a compliant contact is off by 1/sqrt(k)).

That a gradient converges does not make it right. Contact begins at the first step that overlaps, with a force that is
not small (k tau v in `sap`): what is lost of it grows along a step and starts again at the next, and the loss is a
sawtooth of the start. Its teeth shrink with h and keep their slope, which is what derivatives see at every h. So the
gradient is compared with two slopes that no tooth is in: of a line through the loss over many teeth, and of the motion
in continuous time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, frozen
from drake_diff.certificates.slopes import Motions, Slope, directions
from drake_diff.certificates.truth import Truth
from drake_diff.exceptions import InputError
from drake_diff.model.model import Model
from drake_diff.model.parameters import TIME_STEP, ParameterVector, applied, list_parameters, select
from drake_diff.model.tangent import TangentSpace, tangent_space
from drake_diff.motion.gradient import RolloutGradient, differentiate_rollout
from drake_diff.motion.loss import Loss, takes_one_argument

REFINEMENTS = (1, 2, 4)
STIFFENING = (1, 4, 16)
CONTRACTION = 0.75  # halfway between 1/2, which first order promises, and 1, no convergence
TRUSTED = 0.1  # how far from its limit a gradient may be, relative to it
STILL = 1e-2  # changes below this part tell no rate
NEGLIGIBLE = 1e-3  # entries below this part of the largest are judged by its measure
SPREAD = 0.05  # how far apart two differences of the continuous motion may be, relative to their size
Columns = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Compared:
    """The gradient along one direction at the levels (3,), beside the slopes of the motion itself."""

    gradient: Array
    slope: Slope
    disagree: tuple[str, ...]  # which of the slopes the first of them is not

    def __str__(self) -> str:
        said = f"; the gradient is not {' and not '.join(self.disagree)}" if self.disagree else ""
        return f"along {self.slope.direction.name} {_row(self.gradient)}, {self.slope}{said}"


@dataclass(frozen=True, eq=False)
class Refinement:
    """A gradient (n,) at three levels of the time step [s] or of the stiffness (a factor), and its limit.

    By the time step it is also compared with the motion's own slopes, along single directions.
    """

    by: str
    levels: tuple[float, ...]
    columns: tuple[str, ...]
    values: Array  # (3, n)
    limit: Array  # (n,)
    scale: Array  # (n,) what the errors of each entry are parts of
    converged: NDArray[np.bool_]  # (n,)
    compared: tuple[Compared, ...] = ()

    @property
    def worst(self) -> int:
        """The column whose first value is furthest from its limit, those that have converged last."""
        distance = np.abs(self.values[0] - self.limit) / np.maximum(self.scale, 1e-300)
        return int(np.argmax(distance + 1e6 * ~self.converged))

    def __str__(self) -> str:
        j = self.worst
        levels = ", ".join(f"{level:.4g}" for level in self.levels)
        if self.converged.all():
            said = f"converges with {self.by} ({levels}): by {self.columns[j]} {_row(self.values[:, j])}, "
            parts = [f"{said}limit {self.limit[j]:.4g}"]
        else:
            count = int((~self.converged).sum())
            parts = [
                f"not converged: do not optimize with this; with {self.by} ({levels}) the gradient by "
                f"{self.columns[j]} is {_row(self.values[:, j])}"
                + (f" ({count} of {len(self.columns)} entries)" if count > 1 else "")
            ]
        # The one that disagrees most, else the one of the column above.
        of_worst = [c for c in self.compared if j in range(len(self.columns))[c.slope.direction.columns]]
        parts += [str(c) for c in ([c for c in self.compared if c.disagree] or of_worst)[:1]]
        return "; ".join(parts)


def _row(values: Array) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


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


def refine_by_time_step(
    model: Model,
    x0: Array,
    us: Array,
    loss: Loss,
    vector: ParameterVector,
    method: str,
    first: Array,
    columns: Columns,
    truth: Truth | None,
    no_truth: str,
) -> Refinement:
    """The gradient `first` (n,) at h, at h/2 and h/4, beside the slopes of the loss itself and the `truth`.

    `no_truth` says why there is none.
    """
    values = np.array([first, *at_finer_steps(model, x0, us, loss, vector, method)])
    levels = tuple(model.time_step / m for m in REFINEMENTS)
    found = judge_levels("time step", levels, columns, values, kinds_of(model, len(us), vector))
    motions = Motions(model, x0, us, loss, vector, REFINEMENTS[-1], truth, no_truth)
    compared = [motions.slope(direction) for direction in directions(model, x0, us, vector)]
    return beside_slopes(found, compared)


def refine_by_stiffness(
    model: Model, x0: Array, us: Array, loss: Loss, vector: ParameterVector, method: str, first: Array, columns: Columns
) -> Refinement:
    """The gradient `first` (n,) at k, at 4 k and 16 k."""
    values = np.array([first, *in_stiffer_contact(model, x0, us, loss, vector, method)])
    levels = tuple(map(float, STIFFENING))
    return judge_levels("stiffness, times", levels, columns, values, kinds_of(model, len(us), vector))


def kinds_of(model: Model, count: int, vector: ParameterVector) -> list[str]:
    """(n,) the kind of each column of a gradient of `count` steps: what is of one kind has one unit."""
    contract, space = model.contract, tangent_space(model)
    units = [f"position [{term.unit}]" for term in contract.positions]
    units += [f"velocity [{term.unit}]" for term in contract.velocities]
    kinds = [unit for i, unit in enumerate(units) if i not in space.quaternions]
    return kinds + count * [f"input [{term.unit}]" for term in contract.inputs] + list(vector.names)


def judge_levels(
    by: str, levels: tuple[float, ...], columns: Sequence[str], values: Array, kinds: Sequence[str]
) -> Refinement:
    """Which columns of `values` (3, n) converge.

    An error of first order makes the changes d1 and d2 halve, and the limit is g3 + d2. An entry has converged if
    |d2| <= 0.75 |d1| and its first value is within 10 % of the limit, or if both changes are below 1 %: of the largest
    of its own values, or of the root mean square of all entries of its kind, as the others matter more than it then.
    """
    d1, d2 = np.diff(values, axis=0)
    limit = values[2] + d2
    size = np.maximum(np.abs(values).max(axis=0), np.abs(limit))
    scale = np.maximum(size, NEGLIGIBLE * float(size.max(initial=0.0)))
    for kind in set(kinds):
        alike = np.array(kinds) == kind
        scale[alike] = np.maximum(scale[alike], np.sqrt((size[alike] ** 2).mean()))
    contracts = np.abs(d2) <= CONTRACTION * np.abs(d1)
    still = np.maximum(np.abs(d1), np.abs(d2)) <= STILL * scale
    near = np.abs(values[0] - limit) <= TRUSTED * scale
    converged = ((contracts & near) | still) & np.all(np.isfinite(values), axis=0)
    return Refinement(by, levels, tuple(columns), frozen(values), frozen(limit), frozen(scale), converged)


def beside_slopes(found: Refinement, slopes: Sequence[Slope]) -> Refinement:
    """`found`, in which only what agrees with every slope of the loss that there is, and with one at least, converges.

    The gradient at the first level has to be within 10 % of both; of inputs at all times, of the sum of their sizes.
    """
    converged, compared = found.converged.copy(), []
    for slope in slopes:
        columns = slope.direction.columns
        along = found.values[:, columns].sum(axis=1)
        size = float(found.scale[columns].sum())
        disagree = []
        if np.isfinite(slope.secant) and abs(along[0] - slope.secant) > TRUSTED * max(size, abs(slope.secant)):
            disagree.append("the slope over many steps' way")
        if np.isfinite(slope.continuous):
            size = max(size, abs(slope.continuous))
            if not abs(along[0] - slope.continuous) <= TRUSTED * size:
                disagree.append("the continuous motion's")
            elif slope.spread > SPREAD * size:
                disagree.append("compared with a continuous motion, which has no slope here")
        if np.isnan(slope.secant) and np.isnan(slope.continuous):
            disagree.append("compared with anything")
        converged[columns] &= not disagree
        compared.append(Compared(frozen(along), slope, tuple(disagree)))
    return replace(found, converged=converged, compared=tuple(compared))

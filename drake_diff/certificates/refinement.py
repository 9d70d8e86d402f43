"""The gradient at finer time steps or in stiffer contact, and beside the slope of the motion itself.

Both AutoDiffXd and difference quotients can be wrong about the physics: through a compliant bounce the gradient of the
discrete motion can be 10 to 400 times that of the motion it stands for. So a rollout's gradient may also be taken at h,
h/2 and h/4, or at k, 4 k and 16 k of the contact stiffness (a compliant contact is off by 1/sqrt(k)).

That a gradient converges does not make it right. Contact begins at the first step that overlaps, with a force that is
not small (k tau v in `sap`): what is lost of it grows along a step and starts again at the next, and the loss is a
sawtooth of the start. Its teeth shrink with h and keep their slope, which is what derivatives see at every h. So the
gradient is compared with two slopes that no tooth is in: of a line through the loss over many teeth, and of the motion
in continuous time.

1. A line through the loss of the discrete motion over a width of many teeth. Two geometries touch one step later where
   a direction moves them apart by the way v h by which they approach each other in a step: that is the width of a
   tooth, and it is measured where they touch.
2. Central differences of the loss of the motion in continuous time, where there is one (see `truth`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, frozen
from drake_diff.certificates.displaced import Displaced, Line
from drake_diff.certificates.truth import Truth
from drake_diff.exceptions import DrakeDiffError, InputError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.parameters import TIME_STEP, applied, list_parameters, select
from drake_diff.model.step import set_state
from drake_diff.motion.gradient import differentiate_rollout
from drake_diff.motion.loss import evaluate_loss, takes_one_argument
from drake_diff.motion.rollout import roll_states

FRACTIONS = np.array([0.25, 0.5, 0.75, 1.0])  # of the width: where the loss is taken, on both sides, whole teeth apart
TEETH = 8.0  # to each side
ALIKE = 30.0  # what needs so many times the narrowest tooth's width is hardly moved by the direction
WIDTH = 1e-3  # of the scale, where no tooth is known
PILOT = 1e-6  # of the scale: how far a direction is followed to see what it moves


@dataclass(frozen=True, eq=False)
class Slope:
    """How the loss changes along one direction; NaN where that cannot be told, `missing` saying why."""

    line: Line
    secant: float
    width: float  # to both sides, in the unit of the direction
    continuous: float
    spread: float  # by how much that may be off; infinite where there is none
    missing: tuple[str, ...]

    def __str__(self) -> str:
        texts = []
        if np.isfinite(self.secant):
            texts.append(f"over +-{self.width:.2g} the loss itself rises by {self.secant:.4g}")
        if np.isfinite(self.continuous):
            sure = (
                f"(+-{self.spread:.1g})"
                if np.isfinite(self.spread)
                else "over its narrowest width, and does not settle"
            )
            texts.append(f"the continuous motion's slope is {self.continuous:.4g} {sure}")
        return ", ".join((*texts, *self.missing))


@dataclass(frozen=True, eq=False)
class Motions:
    """A rollout and those beside it, in steps of which `parts` make one of the model's, and in continuous time."""

    moved: Displaced
    parts: int
    truth: Truth | None
    no_truth: str = ""

    def slope(self, line: Line) -> Slope:
        """The loss's, along one direction."""
        secant = width = continuous = spread = np.nan
        missing = []
        try:
            width = self._width(line)
            secant = self._secant(line, width)
        except DrakeDiffError as error:
            missing.append(f"no line through the loss: {error}")
        if self.truth is None:
            missing.append(f"no slope of the continuous motion: {self.no_truth}")
        else:
            true = self.truth.slope(line.name)
            if true.exists is None:
                missing.append(f"no slope of the continuous motion: {true.reason}")
            else:
                continuous, spread = (true.value, true.error) if true.exists else (true.slopes[-1], np.inf)
        return Slope(line, secant, width, continuous, spread, tuple(missing))

    def _states(self, line: Line, s: float) -> tuple[Array, Array]:
        """xs (parts N + 1, nx) of the discrete motion moved by `s` along the line, and its us (N, nu)."""
        x0, us, _, values = self.moved.point(s * line.vector)
        with applied(select(self._finer, values.to_dict())) as finer:
            return roll_states(finer, x0, np.repeat(us, self.parts, axis=0)), us

    def _secant(self, line: Line, width: float) -> float:
        """By least squares of an odd cubic through the loss at `FRACTIONS` of the width."""
        rises = []
        for s in FRACTIONS * width:
            (ahead, us_ahead), (behind, us_behind) = self._states(line, s), self._states(line, -s)
            rise = evaluate_loss(self.moved.loss, ahead[:: self.parts], us_ahead)
            rises.append((rise - evaluate_loss(self.moved.loss, behind[:: self.parts], us_behind)) / 2)
        fitted = np.linalg.lstsq(np.column_stack([FRACTIONS, FRACTIONS**3]), np.array(rises), rcond=None)[0]
        return float(fitted[0] / width)

    def _width(self, line: Line) -> float:
        width = WIDTH * line.scale
        if self._touches:
            teeth = self._teeth(line)
            moved = teeth[teeth <= ALIKE * np.min(teeth, initial=np.inf)]
            width = max(width, TEETH * float(np.max(moved, initial=0.0)))
        if width > line.room:
            why = f"{TEETH:g} steps' way is +-{width:.2g}" if width > WIDTH * line.scale else f"+-{width:.2g}"
            raise SimulationError(f"{why}, and it may not be moved by more than {line.room:.2g}")
        return width

    def _teeth(self, line: Line) -> Array:
        """(n,) how far the direction has to move each touch to make it a step later; none where it does not."""
        step, teeth = PILOT * line.scale, []
        (ahead, _), (behind, _) = self._states(line, step), self._states(line, -step)
        for k, pair, way in self._touches:
            by = (self._depths(ahead[k]).get(pair, 0.0) - self._depths(behind[k]).get(pair, 0.0)) / (2 * step)
            if abs(by) > 0:
                teeth.append(way / abs(by))
        return np.array(teeth)

    @cached_property
    def _finer(self) -> Model:
        return (
            self.moved.model
            if self.parts == 1
            else self.moved.model.at_time_step(self.moved.model.time_step / self.parts)
        )

    @cached_property
    def _touches(self) -> list[tuple[int, tuple[int, int], float]]:
        """(k, pair, way [m]) of each pair of geometries that overlap from state k on: by how much more in a step."""
        if not self.moved.model.contract.contact.collision_pairs:
            return []
        with applied(select(self._finer, self.moved.vector.to_dict())) as finer:
            xs = roll_states(finer, self.moved.x0, np.repeat(self.moved.us, self.parts, axis=0))
        touches: list[tuple[int, tuple[int, int], float]] = []
        before: dict[tuple[int, int], float] = {}
        for k, x in enumerate(xs):
            now = self._depths(x, ahead=False)
            later = self._depths(x) if now.keys() - before.keys() else {}
            for pair in now.keys() - before.keys():
                way = later.get(pair, 0.0) - now[pair]
                if way > 0 and (k > 0 or now[pair] <= way):  # what starts deeper did not just touch
                    touches.append((k, pair, way))
            before = now
        return touches

    def _depths(self, x: Array, *, ahead: bool = True) -> dict[tuple[int, int], float]:
        """[m] by pair of geometries that overlap in the state `x`, or where its velocity takes it in a step."""
        twin, nq = self._finer.double, self.moved.model.nq
        set_state(twin, x)
        if ahead:
            set_state(twin, np.concatenate([x[:nq] + self._finer.time_step * twin.rates(x[nq:]), x[nq:]]))
        try:
            pairs = twin.plant.get_geometry_query_input_port().Eval(twin.context).ComputePointPairPenetration()
        except RuntimeError as error:
            raise SimulationError(f"Drake cannot tell how deep geometries overlap: {error}") from error
        return {(int(p.id_A.get_value()), int(p.id_B.get_value())): float(p.depth) for p in pairs}


REFINEMENTS = (1, 2, 4)
STIFFENING = (1, 4, 16)
CONTRACTION = 0.75  # halfway between 1/2, which first order promises, and 1, no convergence
TRUSTED = 0.1  # how far from its limit a gradient may be, relative to it
STILL = 1e-2  # changes below this part tell no rate
NEGLIGIBLE = 1e-3  # entries below this part of the largest are judged by its measure
SPREAD = 0.05  # how far apart two differences of the continuous motion may be, relative to their size


@dataclass(frozen=True, eq=False)
class Compared:
    """The gradient along one direction at the levels (3,), beside the slopes of the motion itself."""

    gradient: Array
    slope: Slope
    disagree: tuple[str, ...]  # which of the slopes the first of them is not

    def __str__(self) -> str:
        text = f"; the gradient is not {' and not '.join(self.disagree)}" if self.disagree else ""
        return f"along {self.slope.line.name} {_row(self.gradient)}, {self.slope}{text}"


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
            text = f"converges with {self.by} ({levels}): by {self.columns[j]} {_row(self.values[:, j])}, "
            parts = [f"{text}limit {self.limit[j]:.4g}"]
        else:
            count = int((~self.converged).sum())
            parts = [
                f"not converged: do not optimize with this; with {self.by} ({levels}) the gradient by "
                f"{self.columns[j]} is {_row(self.values[:, j])}"
                + (f" ({count} of {len(self.columns)} entries)" if count > 1 else "")
            ]
        # The one that disagrees most, else the one of the column above.
        of_worst = [c for c in self.compared if j in c.slope.line.columns]
        parts += [str(c) for c in ([c for c in self.compared if c.disagree] or of_worst)[:1]]
        return "; ".join(parts)


def _row(values: Array) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def at_finer_steps(moved: Displaced) -> Iterator[Array]:
    """The gradient at h/2 and h/4 under the same inputs, the loss seeing the states at the same times."""
    if TIME_STEP in {p.name for p in moved.vector.parameters}:
        raise InputError("parameters", got=TIME_STEP, expected="others, as refine=True changes the time step")
    model, loss, (count, nu) = moved.model, moved.loss, moved.us.shape
    options: dict[str, Any] = {"parameters": moved.vector.to_dict(), "method": moved.method}
    for m in REFINEMENTS[1:]:
        finer, held = model.at_time_step(model.time_step / m), np.repeat(moved.us, m, axis=0)
        coarse = loss if takes_one_argument(loss) else lambda xs, us, m=m: loss(xs[::m], us[::m])
        g = differentiate_rollout(finer, moved.x0, held, coarse, **options)
        yield moved.flat(replace(g, by_us=g.by_us.reshape(count, m, nu).sum(axis=1)))


def in_stiffer_contact(moved: Displaced) -> Iterator[Array]:
    """The gradient at 4 and 16 times every stiffness that the model states, at the model's own time step."""
    model, given = moved.model, moved.vector.to_dict()
    stated = {p.name: float(p.value[0]) for p in list_parameters(model) if p.kind.quantity == "stiffness"}
    # By body if all its geometries have one value, else by geometry.
    named = {name for name in stated if "/" not in name or f"{name.split('/')[0]}.stiffness" not in stated}
    if both := sorted(named & given.keys()):
        raise InputError("parameters", got=both[0], expected="others, as refine_stiffness=True changes it")
    if not named:
        raise InputError("refine_stiffness", got="a model that states no point stiffness", expected="one that does")
    for factor in STIFFENING[1:]:
        with applied(select(model, {name: factor * stated[name] for name in stated if name in named})) as stiffer:
            g = differentiate_rollout(stiffer, moved.x0, moved.us, moved.loss, parameters=given, method=moved.method)
        yield moved.flat(g)


def refine_by_time_step(moved: Displaced, first: Array, truth: Truth | None, no_truth: str) -> Refinement:
    """The gradient `first` (n,) at h, at h/2 and h/4, beside the slopes of the loss itself and the `truth`.

    `no_truth` says why there is none.
    """
    values = np.array([first, *at_finer_steps(moved)])
    levels = tuple(moved.model.time_step / m for m in REFINEMENTS)
    refinement = judge_levels("time step", levels, moved.columns, values, kinds_of(moved))
    motions = Motions(moved, REFINEMENTS[-1], truth, no_truth)
    return beside_slopes(refinement, [motions.slope(line) for line in moved.lines])


def refine_by_stiffness(moved: Displaced, first: Array) -> Refinement:
    """The gradient `first` (n,) at k, at 4 k and 16 k."""
    values, levels = np.array([first, *in_stiffer_contact(moved)]), tuple(map(float, STIFFENING))
    return judge_levels("stiffness, times", levels, moved.columns, values, kinds_of(moved))


def kinds_of(moved: Displaced) -> list[str]:
    """(n,) the kind of each column of a gradient: what is of one kind has one unit."""
    contract, space = moved.model.contract, moved.space
    units = [f"position [{term.unit}]" for term in contract.positions]
    units += [f"velocity [{term.unit}]" for term in contract.velocities]
    kinds = [unit for i, unit in enumerate(units) if i not in space.quaternions]
    return kinds + len(moved.us) * [f"input [{term.unit}]" for term in contract.inputs] + list(moved.vector.names)


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


def beside_slopes(refinement: Refinement, slopes: Sequence[Slope]) -> Refinement:
    """`refinement`, in which only what agrees with every slope of the loss that there is, one at least, converges.

    The gradient at the first level has to be within 10 % of both; of inputs at all times, of the sum of their sizes.
    """
    converged, compared = refinement.converged.copy(), []
    for slope in slopes:
        columns = slope.line.columns
        along = refinement.values[:, columns].sum(axis=1)
        size = float(refinement.scale[columns].sum())
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
    return replace(refinement, converged=converged, compared=tuple(compared))

"""The slope of a rollout's loss along single directions, by means that differentiate no step.

1. A line through the loss of the discrete motion over a width of many teeth (see `refinement`). Two geometries touch
   one step later where a direction moves them apart by the way v h by which they approach each other in a step: that is
   the width of a tooth, and it is measured where they touch.
2. Central differences of the loss of the motion in continuous time, where there is one (see `truth`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.certificates.certify import move, state_scale
from drake_diff.certificates.truth import Truth
from drake_diff.exceptions import DrakeDiffError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied, select
from drake_diff.model.plant import actuators
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.loss import Loss, evaluate_loss
from drake_diff.motion.rollout import roll_states

FRACTIONS = np.array([0.25, 0.5, 0.75, 1.0])  # of the width: where the loss is taken, on both sides, whole teeth apart
TEETH = 8.0  # to each side
ALIKE = 30.0  # what needs so many times the narrowest tooth's width is hardly moved by the direction
WIDEST = 0.25  # of a state's or a parameter's own scale
WIDTH = 1e-3  # of the scale, where no tooth is known
PILOT = 1e-6  # of the scale: how far a direction is followed to see what it moves


@dataclass(frozen=True, eq=False)
class Direction:
    """One direction in which a rollout is moved: its start on the tangent space, its inputs and its parameters."""

    name: str
    columns: slice  # of the gradient, which add up to it
    scale: float
    vector: Array  # (size + N nu + np,)
    widest: float


@dataclass(frozen=True, eq=False)
class Slope:
    """How the loss changes along one direction; NaN where that cannot be told, `missing` saying why."""

    direction: Direction
    secant: float
    width: float  # to both sides, in the unit of the direction
    continuous: float
    spread: float  # by how much that may be off; infinite where there is none
    missing: tuple[str, ...]

    def __str__(self) -> str:
        found = []
        if np.isfinite(self.secant):
            found.append(f"over +-{self.width:.2g} the loss itself rises by {self.secant:.4g}")
        if np.isfinite(self.continuous):
            sure = (
                f"(+-{self.spread:.1g})"
                if np.isfinite(self.spread)
                else "over its narrowest width, and does not settle"
            )
            found.append(f"the continuous motion's slope is {self.continuous:.4g} {sure}")
        return ", ".join((*found, *self.missing))


def directions(model: Model, x0: Array, us: Array, vector: ParameterVector) -> Iterator[Direction]:
    """Each state, each input by as much at all times, and each parameter, as far as differences may move it."""
    space, (count, nu) = tangent_space(model), us.shape
    end, eye = space.size + us.size, np.eye(space.size + us.size + len(vector.values))
    for j, (name, scale) in enumerate(zip(space.names, state_scale(space, x0), strict=True)):
        yield Direction(f"{name}[0]", slice(j, j + 1), scale, eye[j], WIDEST * scale)
    limits = [actuator.effort_limit() for actuator in actuators(model.plant)]
    cut = np.where(model.inputs.actuator >= 0, model.inputs.of_actuators(limits), np.inf)
    for j, limit in enumerate(cut.tolist()):
        columns = slice(space.size + j, space.size + (count - 1) * nu + j + 1, nu)
        room = float(np.abs(limit - np.abs(us[:, j])).min())  # what is cut off is no line
        scale = max(1.0, float(np.abs(us[:, j]).max()))
        yield Direction(f"{model.input_names[j]} at all times", columns, scale, eye[columns].sum(axis=0), room)
    for j, (name, scale) in enumerate(zip(vector.names, vector.difference_scale(), strict=True)):
        yield Direction(name, slice(end + j, end + j + 1), scale, eye[end + j], WIDEST * scale)


@dataclass(frozen=True, eq=False)
class Motions:
    """A rollout and those beside it, in steps of which `parts` make one of the model's, and in continuous time."""

    model: Model
    x0: Array
    us: Array
    loss: Loss
    vector: ParameterVector
    parts: int
    truth: Truth | None
    no_truth: str = ""

    def slope(self, direction: Direction) -> Slope:
        """The loss's, along one direction."""
        secant = width = continuous = spread = np.nan
        missing = []
        try:
            width = self._width(direction)
            secant = self._secant(direction, width)
        except DrakeDiffError as error:
            missing.append(f"no line through the loss: {error}")
        if self.truth is None:
            missing.append(f"no slope of the continuous motion: {self.no_truth}")
        else:
            true = self.truth.slope(direction.name)
            if true.exists is None:
                missing.append(f"no slope of the continuous motion: {true.reason}")
            else:
                continuous, spread = (true.value, true.error) if true.exists else (true.slopes[-1], np.inf)
        return Slope(direction, secant, width, continuous, spread, tuple(missing))

    def _at(self, direction: Direction, s: float) -> tuple[Array, Array, ParameterVector]:
        point = np.concatenate([self.x0, self.us.ravel(), self.vector.values])
        point = move(tangent_space(self.model), self.model.nx, point, s * direction.vector)
        end = self.model.nx + self.us.size
        return point[: self.model.nx], point[self.model.nx : end].reshape(self.us.shape), self.vector.at(point[end:])

    def _states(self, direction: Direction, s: float) -> tuple[Array, Array]:
        """xs (parts N + 1, nx) of the discrete motion moved by `s` along the direction, and its us (N, nu)."""
        x0, us, values = self._at(direction, s)
        with applied(select(self._finer, values.to_dict())) as finer:
            return roll_states(finer, x0, np.repeat(us, self.parts, axis=0)), us

    def _secant(self, direction: Direction, width: float) -> float:
        """By least squares of an odd cubic through the loss at `FRACTIONS` of the width."""
        rises = []
        for s in FRACTIONS * width:
            (ahead, us_ahead), (behind, us_behind) = self._states(direction, s), self._states(direction, -s)
            rise = evaluate_loss(self.loss, ahead[:: self.parts], us_ahead)
            rises.append((rise - evaluate_loss(self.loss, behind[:: self.parts], us_behind)) / 2)
        fitted = np.linalg.lstsq(np.column_stack([FRACTIONS, FRACTIONS**3]), np.array(rises), rcond=None)[0]
        return float(fitted[0] / width)

    def _width(self, direction: Direction) -> float:
        width = WIDTH * direction.scale
        if self._touches:
            teeth = self._teeth(direction)
            told = teeth[teeth <= ALIKE * np.min(teeth, initial=np.inf)]
            width = max(width, TEETH * float(np.max(told, initial=0.0)))
        if width > direction.widest:
            why = f"{TEETH:g} steps' way is +-{width:.2g}" if width > WIDTH * direction.scale else f"+-{width:.2g}"
            raise SimulationError(f"{why}, and it may not be moved by more than {direction.widest:.2g}")
        return width

    def _teeth(self, direction: Direction) -> Array:
        """(n,) how far the direction has to move each touch to make it a step later; none where it does not."""
        step, found = PILOT * direction.scale, []
        (ahead, _), (behind, _) = self._states(direction, step), self._states(direction, -step)
        for k, pair, way in self._touches:
            by = (self._depths(ahead[k]).get(pair, 0.0) - self._depths(behind[k]).get(pair, 0.0)) / (2 * step)
            if abs(by) > 0:
                found.append(way / abs(by))
        return np.array(found)

    @cached_property
    def _finer(self) -> Model:
        return self.model if self.parts == 1 else self.model.at_time_step(self.model.time_step / self.parts)

    @cached_property
    def _touches(self) -> list[tuple[int, tuple[int, int], float]]:
        """(k, pair, way [m]) of each pair of geometries that overlap from state k on: by how much more in a step."""
        if not self.model.contract.contact.collision_pairs:
            return []
        with applied(select(self._finer, self.vector.to_dict())) as finer:
            xs = roll_states(finer, self.x0, np.repeat(self.us, self.parts, axis=0))
        found: list[tuple[int, tuple[int, int], float]] = []
        before: dict[tuple[int, int], float] = {}
        for k, x in enumerate(xs):
            now = self._depths(x, ahead=False)
            later = self._depths(x) if now.keys() - before.keys() else {}
            for pair in now.keys() - before.keys():
                way = later.get(pair, 0.0) - now[pair]
                if way > 0 and (k > 0 or now[pair] <= way):  # what starts deeper did not just touch
                    found.append((k, pair, way))
            before = now
        return found

    def _depths(self, x: Array, *, ahead: bool = True) -> dict[tuple[int, int], float]:
        """[m] by pair of geometries that overlap in the state `x`, or where its velocity takes it in a step."""
        twin, nq = self._finer.double, self.model.nq
        set_state(twin, x)
        if ahead:
            set_state(twin, np.concatenate([x[:nq] + self._finer.time_step * twin.rates(x[nq:]), x[nq:]]))
        try:
            pairs = twin.plant.get_geometry_query_input_port().Eval(twin.context).ComputePointPairPenetration()
        except RuntimeError as error:
            raise SimulationError(f"Drake cannot tell how deep geometries overlap: {error}") from error
        return {(int(p.id_A.get_value()), int(p.id_B.get_value())): float(p.depth) for p in pairs}

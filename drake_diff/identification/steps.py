"""The model's own discrete steps over segments, contact and limits included, and their derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.comparison.recordings import CLOCK_TOLERANCE
from drake_diff.derivatives.step import StepDerivatives, derivatives_along
from drake_diff.exceptions import GradientError, InputError, ModelError
from drake_diff.identification.measured import Piece
from drake_diff.identification.tree import Numbers
from drake_diff.identification.unknowns import BIAS, Unknowns
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied, select
from drake_diff.model.step import advance


@dataclass(frozen=True, eq=False)
class DiscreteMotion:
    """Drake's steps of a length of which a whole number lies between samples."""

    model: Model  # at that time step
    unknowns: Unknowns
    vector: ParameterVector  # of the unknowns that are the model's
    own: Indices  # where the vector's entries stand among the unknowns
    segment: float = np.inf  # [s] a whole piece: where bodies touch, a state from noisy samples is no start of a motion
    differenced: list[str] = field(default_factory=list)  # says where Drake's own derivatives were refused
    kinks: bool = False

    @property
    def words(self) -> str:
        return ", ".join([f"the model's own steps of {1e3 * self.model.time_step:.4g} ms", *self.differenced[:1]])

    def cut(self, period: float) -> tuple[float, ...]:
        """Lengths of the steps [s] over a time between samples [s]."""
        return (self.model.time_step,) * round(period / self.model.time_step)

    def shorter(self, than: float) -> None:
        """There is none: it is the model's step that is fitted."""
        return

    def exact(self) -> None:
        """None: it has the derivatives of its own steps."""
        return

    def is_possible(self, values: Array) -> bool:
        """Whether there are bodies with these values."""
        return self.unknowns.consistent(values, None)

    def run(self, values: Array, starts: Array, hs: Array, us: Array) -> Array:
        """(K, M+1, nx) states from starts (K, nx) by steps of hs (K, M) [s], 0 for none, under us (K, M, nu)."""
        vector = self.vector.at(values[self.own])
        xs = np.repeat(starts[:, None], hs.shape[1] + 1, axis=1)
        with applied(vector) as model:
            for k, count in enumerate(np.count_nonzero(hs, axis=1)):
                for i in range(count):
                    xs[k, i + 1] = advance(model.double, xs[k, i], us[k, i])
                xs[k, count + 1 :] = xs[k, count]
        return xs

    def rates(self, values: Array, x: Array, u: Array) -> Array:
        """There are none: whoever needs them is refused."""
        raise ModelError(f"{self.words} have no rates in between: a delay is sought in continuous time")

    def grip_at(self, numbers: Numbers, q: Array, v: Array, u: Array) -> None:
        """Nothing: Drake's joints have no dry friction."""
        return

    def derivatives(self, model: Model, vector: ParameterVector, xs: Array, us: Array) -> Sequence[StepDerivatives]:
        """Of steps from each of xs (N, nx) under us (N, nu), by the vector's parameters; those applied act."""
        try:
            return derivatives_along(model, xs[0], us, vector=vector, xs=xs)
        except GradientError:
            self.differenced.append("some derivatives by differences")
            return derivatives_along(model, xs[0], us, vector=vector, xs=xs, method="finite_difference")

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array) -> tuple[Array, Array]:
        """Of each step: by the state (K, M, nx, nx), and by z (K, M, nx, np)."""
        vector, by_z = self.vector.at(self.unknowns.values(z)[self.own]), self.unknowns.by_z(z)[self.own]
        K, M, nx = *hs.shape, xs.shape[2]
        by_x, by = np.tile(np.eye(nx), (K, M, 1, 1)), np.zeros((K, M, nx, len(z)))
        taken = hs > 0
        with applied(vector) as model:
            each = self.derivatives(model, vector, xs[:, :-1][taken], us[taken])
        by_x[taken] = np.array([step.A for step in each])
        by[taken] = np.array([step.C for step in each]) @ by_z
        return by_x, by


def discrete_motion(model: Model, unknowns: Unknowns, pieces: Sequence[Piece]) -> DiscreteMotion:
    """Of steps as long as the model's, or shortened so that a whole number of them lies between samples.

    InputError where samples are not the same time apart; ModelError where the model came from a diagram, which has but
    one time step.
    """
    every = np.concatenate([np.diff(piece.times) for piece in pieces])
    period = float(np.median(every))
    if np.any(np.abs(every - period) > CLOCK_TOLERANCE * min(period, model.time_step)):
        got = f"from {1e3 * np.min(every):.6g} to {1e3 * np.max(every):.6g} ms"
        raise InputError("times between samples", got=got, expected="the same, as the model's own steps are fitted")
    h = period / max(1, round(period / model.time_step))
    if abs(h - model.time_step) > CLOCK_TOLERANCE * model.time_step:
        model = model.at_time_step(h)
    own = [one for one in unknowns.each if one.quantity != BIAS]
    places = [s for one, s in zip(unknowns.each, unknowns.slices, strict=True) if one.quantity != BIAS]
    entries = np.concatenate([np.arange(s.start, s.stop) for s in places]) if places else np.zeros(0, dtype=int)
    return DiscreteMotion(model, unknowns, select(model, [one.name for one in own]), entries)

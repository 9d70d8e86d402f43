"""The map from one knot of a trajectory to the next: Drake's own step, or the continuous motion that it approximates.

Both are functions of the state and the input only, with derivatives, so that a solver can use either.
"""

from typing import Protocol

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.derivatives.step import StepDerivatives, derivatives_along, linearize
from drake_diff.model.contact import contacts_of_the_step
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector
from drake_diff.model.step import advance
from drake_diff.motion.rollout import CONTINUOUS

BodyPair = tuple[str, str]


class Intervals(Protocol):
    """The intervals of a model with applied parameters, valid while these parameters are applied."""

    def end(self, x: Array, u: Array) -> Array:
        """Return the state (nx,) at the end of an interval from `x` (nx,) under `u` (nu,)."""

    def derivatives(self, x0: Array, us: Array, xs: Array | None = None) -> list[StepDerivatives]:
        """Differentiate along the motion from `x0` under `us` (N, nu), or the intervals from each of xs (N, nx)."""

    def jacobians(self, xs: Array, us: Array, ends: Array | None = None) -> Array:
        """Return the Jacobians (N, nx, nx + nu) of the intervals from xs (N or N+1, nx), with known `ends` (N, nx)."""

    def touching(self, x: Array, u: Array) -> tuple[BodyPair, ...]:
        """Return the pairs of bodies in contact in the interval from `x` under `u`."""


def intervals_of(model: Model, vector: ParameterVector, motion: str) -> Intervals:
    """Return the intervals of a `motion`; raise ModelError if continuous time does not support the model."""
    if motion == CONTINUOUS:
        from drake_diff.motion.flow import FlowSteps  # loads CasADi

        return FlowSteps(model, vector)
    return DrakeSteps(model, vector)


def roll(intervals: Intervals, x0: Array, us: Array) -> Array:
    """Return the states (N+1, nx) at the ends of the intervals from `x0` (nx,) under `us` (N, nu)."""
    xs = np.empty((len(us) + 1, len(x0)))
    xs[0] = x0
    for k, u in enumerate(us):
        xs[k + 1] = intervals.end(xs[k], u)
    return xs


class DrakeSteps:
    """Drake's own discrete steps."""

    def __init__(self, model: Model, vector: ParameterVector):
        self.model, self.vector = model, vector

    def end(self, x: Array, u: Array) -> Array:
        return np.asarray(advance(self.model.double, x, u))

    def derivatives(self, x0: Array, us: Array, xs: Array | None = None) -> list[StepDerivatives]:
        return derivatives_along(self.model, x0, us, vector=self.vector, xs=xs)

    def jacobians(self, xs: Array, us: Array, ends: Array | None = None) -> Array:
        A, B, _ = linearize(self.model, xs, us, x_next=ends)
        return np.concatenate([A, B], axis=2)

    def touching(self, x: Array, u: Array) -> tuple[BodyPair, ...]:
        advance(self.model.double, x, u)
        return tuple((c.body_a, c.body_b) for c in contacts_of_the_step(self.model))

"""Where the dynamics lead along a collocated motion from a state, with error control; open loop or under feedback.

Each interval is taken in equal steps of the pair of Dormand and Prince, in twice as many wherever one of them has an
error above its tolerance, so that an interval in which nothing bends costs six evaluations of the dynamics.
"""

from functools import cache
from typing import Any, Protocol

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.motion.tableaus import AT, DENSE, ERROR, STAGES
from drake_diff.optimize.transcription.task import OptimalControl

TOLERANCE = 1e-6  # of a state's range along the motion, in a step: a ten-thousandth of how far it may be off at all
MOST_STEPS = 16  # of an interval, whatever their errors: stable where ten of the classical Runge-Kutta method are
EASY = 1e-2  # of what is allowed: half as many steps would have 32 times the error
STAGE_WEIGHTS = tuple(np.array(weights) for weights in STAGES)


class Motion(Protocol):
    """A motion between N+1 knots, xs (N+1, nx), whose input is a polynomial in each interval."""

    @property
    def task(self) -> OptimalControl: ...
    @property
    def xs(self) -> Array: ...
    @property
    def lengths(self) -> Array: ...
    @property
    def input_limits(self) -> tuple[Array, Array]: ...
    def between(self, k: Any, tau: Array) -> tuple[Array, Array]: ...
    def cut_off(self, us: Array) -> Array: ...


class Lead:
    """Where `motion` leads at every `substeps`-th part of its intervals, which start and end at its knots."""

    def __init__(self, motion: Motion, substeps: int):
        self.motion, self.substeps = motion, substeps
        self.nx = motion.task.dynamics.nx
        self.allowed = TOLERANCE * motion.task.problem.ranges(motion.xs)
        self.lower, self.upper = motion.input_limits
        self._planned: dict[int, Array] = {}

    def from_state(self, x: Array, gains: Array | None) -> Array:
        """(substeps N + 1, nx) from `x` (nx,), with feedback by `gains` (N, nu, nx) if there are."""
        states, steps, slope = [x[None]], 1, None
        with np.errstate(all="ignore"):
            for k in range(len(self.motion.lengths)):
                gain = None if gains is None else gains[k]
                slope = slope if gains is None else None  # another gain acts from here on
                within, steps, slope = self._through(k, states[-1][-1], gain, steps, slope)
                states.append(within)
        return np.concatenate(states)

    def _through(
        self, k: int, x: Array, gain: Array | None, steps: int, slope: Array | None
    ) -> tuple[Array, int, Array]:
        """(substeps, nx) through the interval `k`; in how many steps the next may be taken, and x' at the end."""
        steps = MOST_STEPS if not np.all(np.isfinite(x)) else steps
        while True:
            states, slopes, error = self._in_steps(k, x, gain, steps, slope)
            if error <= 1 or steps >= MOST_STEPS:
                break
            slope, steps = slopes[0][0], 2 * steps
        samples = np.empty((self.substeps, self.nx))
        dt = self.motion.lengths[k] / steps
        for (rows, weights), start, step_slopes in zip(_shown(self.substeps, steps), states, slopes, strict=False):
            samples[rows] = start + dt * (weights @ step_slopes)
        samples[-1] = states[-1]
        return samples, max(steps // 2, 1) if error <= EASY else steps, slopes[-1][-1]

    def _in_steps(
        self, k: int, x: Array, gain: Array | None, steps: int, slope: Array | None
    ) -> tuple[list[Array], list[Array], float]:
        """The states at the ends of `steps` steps, the slopes (7, nx) of each, and the largest part of what is allowed.

        That is of their errors. Of steps whose error is too large only the first are taken.
        """
        states, every, worst, dt = [x], [], 0.0, self.motion.lengths[k] / steps
        planned = self._plan(steps)[k]
        for i in range(steps):
            slopes = np.empty((len(STAGES) + 1, self.nx))
            slopes[0] = self._rate(k, x, planned[i, 0], gain) if slope is None else slope
            for stage, weights in enumerate(STAGE_WEIGHTS, 1):
                state = x + dt * (weights @ slopes[:stage])
                slopes[stage] = self._rate(k, state, planned[i, stage], gain)
            x, slope = state, slopes[-1]
            states.append(x)
            every.append(slopes)
            error = np.abs(dt * (ERROR @ slopes)) / self.allowed
            worst = max(worst, float(np.max(np.nan_to_num(error, nan=np.inf))))
            if not worst <= 1 and steps < MOST_STEPS:
                break
        return states, every, worst

    def _rate(self, k: int, x: Array, planned: Array, gain: Array | None) -> Array:
        u = planned[self.nx :]
        if gain is not None:
            u = np.minimum(np.maximum(u + gain @ (planned[: self.nx] - x), self.lower), self.upper)
        return self.motion.task.moved(np.concatenate((x, u))[None], np.array([k]))[0]

    def _plan(self, steps: int) -> Array:
        """(N, steps, 7, nx + nu) the motion, inputs as the plant applies them, at the stages of `steps` steps."""
        if steps not in self._planned:
            count, tau = len(self.motion.lengths), (np.arange(steps)[:, None] + np.array((0.0, *AT))).ravel() / steps
            xs, us = self.motion.between(np.repeat(np.arange(count), len(tau)), np.tile(tau, count))
            self._planned[steps] = np.hstack([xs, self.motion.cut_off(us)]).reshape(count, steps, len(AT) + 1, -1)
        return self._planned[steps]


@cache
def _shown(substeps: int, steps: int) -> list[tuple[slice, Array]]:
    """Of each of an interval's `steps`, which of `substeps` ends lie in it, and the weights of its slopes there."""
    pairs, ends = [], np.arange(1, substeps + 1) / substeps * steps
    for i in range(steps):
        first, last = np.searchsorted(ends, [i, i + 1], side="right").tolist()
        powers = (ends[first:last, None] - i) ** np.arange(1, DENSE.shape[1] + 1)
        pairs.append((slice(first, last), powers @ DENSE.T))
    return pairs

"""From what a sensor gives to the state that a controller acts on: the seam where an estimator goes in."""

from collections import deque
from typing import Protocol

import numpy as np

from drake_diff.arrays import Array
from drake_diff.loop.checks import count
from drake_diff.model import Model
from drake_diff.step import advance


class Estimator(Protocol):
    """One estimate a step. `start` is called before each run, so that nothing is left of the run before."""

    def start(self, x0: Array) -> None:
        """Forget everything; `x0` (nx,) is the state that is known to begin with."""
        ...

    def estimate(self, observation: Array | None, u: Array | None) -> Array:
        """(nx,) from what arrived, None where nothing did, and the last command (nu,), None at first."""
        ...


class Hold:
    """The last thing that was seen."""

    def start(self, x0: Array) -> None:
        self._last = x0

    def estimate(self, observation: Array | None, u: Array | None) -> Array:
        self._last = self._last if observation is None else observation
        return self._last


class Predictor:
    """The last thing seen, `delay` steps old, rolled forward through `model` under the commands since.

    It makes up for a known delay of the sensor, and for lost samples.
    """

    def __init__(self, model: Model, delay: int):
        self.model, self.delay = model, count("Predictor.delay", delay, 0)

    def start(self, x0: Array) -> None:
        self._seen, self._k = x0, 0
        self._since: deque[Array] = deque()

    def estimate(self, observation: Array | None, u: Array | None) -> Array:
        if u is not None:
            self._since.append(u)
            self._k += 1
        if observation is not None:
            self._seen = observation
            while len(self._since) > min(self.delay, self._k):
                self._since.popleft()
        x = np.array(self._seen)
        for command in self._since:
            x = np.asarray(advance(self.model.double, x, command))
        return x

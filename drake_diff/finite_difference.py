"""Forward, backward and central differences of any function; knows no robots."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drake_diff.arrays import Array

Function = Callable[[Array], Array]
Difference = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Differences:
    """Difference quotients (m, n) of one step size."""

    step: float
    forward: Array
    backward: Array

    @property
    def central(self) -> Array:
        return (self.forward + self.backward) / 2


def differences(
    f: Function, size: int, step: float, *, at_zero: Array | None = None, minus: Difference = np.subtract
) -> Differences:
    """Difference quotients of `f`: R^size -> R^m around 0 with `step` in each direction.

    `f` takes the displacement, so that the caller decides how it is added; `minus(a, b)` subtracts two values
    of `f`. With e the unit vectors: forward = (f(h e) - f(0)) / h, backward = (f(0) - f(-h e)) / h.
    """
    centre = f(np.zeros(size)) if at_zero is None else at_zero
    columns = [(minus(f(step * e), centre) / step, -minus(f(-step * e), centre) / step) for e in np.eye(size)]
    rows = len(minus(centre, centre))
    forward = np.array([c[0] for c in columns]).reshape(size, rows).T
    backward = np.array([c[1] for c in columns]).reshape(size, rows).T
    return Differences(step, forward, backward)

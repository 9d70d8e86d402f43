"""Forward, backward and central differences of any function; knows no robots."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array

Function = Callable[[Array], Array]
Many = Callable[[Array], Array]  # displacements (K, n) -> values (K, m)
Difference = Callable[[Array, Array], Array]

RATIO_SQUARED = 10.0  # of neighbouring steps of a sweep: half a decade
SWEEP = tuple(10.0 ** (-k / 2) for k in range(4, 12))  # 1e-2 ... 3e-6
ROUNDING = 1e-15


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


@dataclass(frozen=True)
class Sweep:
    """One-sided difference quotients (s, m, n) of several step sizes around `centre`, the value (m,) there."""

    centre: Array
    forward: Array
    backward: Array


def sweep_of(f: Many, size: int, steps: Sequence[float], *, minus: Difference = np.subtract) -> Sweep:
    """`differences` of `f`: (K, size) -> (K, m) with each of `steps`, from one call of `f` with all displacements."""
    h = np.array(steps)[:, None, None]
    sides = np.stack([h * np.eye(size), -h * np.eye(size)])  # (2, s, n, n)
    values = np.asarray(f(np.vstack([np.zeros((1, size)), sides.reshape(-1, size)])), dtype=float)
    centre = values[0]
    apart = values[1:] - centre if minus is np.subtract else np.array([minus(v, centre) for v in values[1:]])
    rows = len(minus(centre, centre))
    ahead, behind = apart.reshape(2, len(steps), size, rows).swapaxes(2, 3) / h
    return Sweep(centre, ahead, -behind)


def one_by_one(f: Function) -> Many:
    """`f` of a displacement as a function of many."""
    return lambda displacements: np.array([f(d) for d in displacements])


def richardson(central: Array) -> Array:
    """(s - 1, m, n) of central quotients (s, m, n) half a decade apart: with an error of order h^4, not h^2."""
    return central[1:] + (central[1:] - central[:-1]) / (RATIO_SQUARED - 1)


def plateau(f: Function, size: int, *, at_zero: Array) -> Array:
    """(m, n) the derivative of `f` at 0 where the quotients of a sweep of steps depend least on the step.

    Every entry is judged on its own: no one step suits all, where a solver leaves small changes unsolved or large
    ones change the contact. Of three neighbouring Richardson values that lie closest, the middle one.
    """
    central = np.array([differences(f, size, h, at_zero=at_zero).central for h in SWEEP])
    values = richardson(central)
    windows = np.array([values[s : s + 3] for s in range(len(values) - 2)])
    rounding = ROUNDING * np.maximum(1.0, np.abs(at_zero))[None, :, None] / np.array(SWEEP[2:-1])[:, None, None]
    best = np.argmin(windows.max(axis=1) - windows.min(axis=1) + rounding, axis=0)
    return np.asarray(np.take_along_axis(windows[:, 1], best[None], axis=0)[0])

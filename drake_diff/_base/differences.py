"""Difference quotients of any function: central, one-sided at many step sizes, and the best of a sweep."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array

Function = Callable[[Array], Array]
Many = Callable[[Array], Array]  # displacements (K, n) -> values (K, m)
Difference = Callable[[Array, Array], Array]

RATIO_SQUARED = 10.0  # of neighbouring steps of a sweep: half a decade
SWEEP = tuple(10.0 ** (-k / 2) for k in range(4, 12))  # 1e-2 ... 3e-6
ROUNDING = 1e-15  # of a value in double precision: a few units in the last place


def central_differences(
    f: Function, size: int, step: float, *, at_zero: Array | None = None, minus: Difference = np.subtract
) -> Array:
    """(m, n): (f(h e) - f(-h e)) / 2h of `f`: R^size -> R^m around 0, h being `step` and e each unit vector.

    `f` takes the displacement, so that the caller decides how it is added; `minus(a, b)` subtracts two values of `f`,
    always from f(0), so that it may be a chart of a curved space there.
    """
    centre = f(np.zeros(size)) if at_zero is None else at_zero
    columns = [(minus(f(step * e), centre) - minus(f(-step * e), centre)) / (2 * step) for e in np.eye(size)]
    return np.array(columns).reshape(size, len(minus(centre, centre))).T


@dataclass(frozen=True)
class Sweep:
    """One-sided difference quotients (s, m, n) of several step sizes around `centre`, the value (m,) there."""

    centre: Array
    forward: Array
    backward: Array


def sweep_of(f: Many, size: int, steps: Sequence[float], *, minus: Difference = np.subtract) -> Sweep:
    """One-sided differences of `f`: (K, size) -> (K, m) around 0, from one call of `f` with all displacements."""
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


def plateau(f: Many, size: int) -> Array:
    """(m, n) the derivative of `f` at 0, by the step sizes at which its difference quotients depend least on the step.

    Each entry is judged on its own, as no one step suits all: a solver leaves small changes unsolved, and large ones
    change the contact. It is the middle one of the three neighbouring Richardson values that lie closest together.
    """
    sweep = sweep_of(f, size, SWEEP)
    values = richardson((sweep.forward + sweep.backward) / 2)
    windows = np.array([values[s : s + 3] for s in range(len(values) - 2)])
    rounding = ROUNDING * np.maximum(1.0, np.abs(sweep.centre))[None, :, None] / np.array(SWEEP[2:-1])[:, None, None]
    best = np.argmin(windows.max(axis=1) - windows.min(axis=1) + rounding, axis=0)
    return np.asarray(np.take_along_axis(windows[:, 1], best[None], axis=0)[0])

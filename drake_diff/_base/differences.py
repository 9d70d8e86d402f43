"""Difference quotients of a function: central differences, one-sided differences at many steps, and the best step."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array

Function = Callable[[Array], Array]
Many = Callable[[Array], Array]  # displacements (K, n) -> values (K, m)
Difference = Callable[[Array, Array], Array]  # (..., m) and (m,) or (..., m) -> (..., n)

RATIO_SQUARED = 10.0  # squared ratio of neighbouring steps, which are half a decade apart
SWEEP = tuple(10.0 ** (-k / 2) for k in range(4, 12))  # 1e-2 ... 3e-6
TINY = 1e-30  # size of a complex step
ROUNDING = 1e-15  # relative rounding error in double precision: a few units in the last place


def central_differences(
    f: Function, size: int, step: float, *, at_zero: Array | None = None, minus: Difference = np.subtract
) -> Array:
    """Compute (f(h e) - f(-h e)) / 2h (m, n) of `f`: R^size -> R^m, with h = `step` and the unit vectors e.

    `f` takes a displacement, so the caller decides how to add it. `minus(a, b)` subtracts two values of `f`. Its second
    argument is always f(0), so it may be a chart of a curved space at f(0).
    """
    centre = f(np.zeros(size)) if at_zero is None else at_zero
    columns = [(minus(f(step * e), centre) - minus(f(-step * e), centre)) / (2 * step) for e in np.eye(size)]
    return np.array(columns).reshape(size, len(minus(centre, centre))).T


def complex_steps(f: Function, z: Array) -> Array:
    """Return the derivative (m, n) of an analytic function of z (n,), exact to rounding."""
    columns = [np.imag(f(z + 1j * TINY * e)) / TINY for e in np.eye(len(z))]
    return np.array(columns, dtype=float).T if columns else np.zeros((len(f(z)), 0))


@dataclass(frozen=True)
class Sweep:
    """One-sided difference quotients (s, m, n) for several step sizes, and the function's value `centre` (m,)."""

    centre: Array
    forward: Array
    backward: Array


def sweep_of(f: Many, size: int, steps: Sequence[float], *, minus: Difference = np.subtract) -> Sweep:
    """Compute one-sided differences of `f`: (K, size) -> (K, m) around 0, in one call of `f` with all displacements."""
    h = np.array(steps)[:, None, None]
    sides = np.stack([h * np.eye(size), -h * np.eye(size)])  # (2, s, n, n)
    values = np.asarray(f(np.vstack([np.zeros((1, size)), sides.reshape(-1, size)])), dtype=float)
    centre = values[0]
    displacements = minus(values[1:], centre)
    rows = len(minus(centre, centre))
    ahead, behind = displacements.reshape(2, len(steps), size, rows).swapaxes(2, 3) / h
    return Sweep(centre, ahead, -behind)


def one_by_one(f: Function) -> Many:
    """Turn a function `f` of one displacement into a function of many; `f` may return the same buffer each time."""
    return lambda displacements: np.array([np.array(f(d)) for d in displacements])


def richardson(central: Array) -> Array:
    """Extrapolate central quotients (s, m, n), half a decade apart, to (s - 1, m, n) with an error of O(h^4)."""
    return central[1:] + (central[1:] - central[:-1]) / (RATIO_SQUARED - 1)


def plateau(f: Many, size: int) -> Array:
    """Return the derivative (m, n) of `f` at 0 from the step sizes at which the quotients depend least on the step.

    The step is chosen for each entry separately: a solver may ignore small changes, while large changes alter the
    contact. The result is the middle one of the three neighbouring Richardson values that are closest to one another.
    """
    sweep = sweep_of(f, size, SWEEP)
    values = richardson((sweep.forward + sweep.backward) / 2)
    windows = np.array([values[s : s + 3] for s in range(len(values) - 2)])
    rounding = ROUNDING * np.maximum(1.0, np.abs(sweep.centre))[None, :, None] / np.array(SWEEP[2:-1])[:, None, None]
    best = np.argmin(windows.max(axis=1) - windows.min(axis=1) + rounding, axis=0)
    return np.asarray(np.take_along_axis(windows[:, 1], best[None], axis=0)[0])

"""A flow within its steps: rates, their slopes, and the states between the ends of a step.

Between its ends the motion is taken to be the polynomial of degree 5 that has its states there, their rates and how
these change.
"""

from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.motion.flow.plant import FlowPart
from drake_diff.motion.flow.stepping import on_arrays


class Slopes:
    """Rates where a given set of pairs pushes, and their slopes by state, input and n parameters.

    `by_parameters` (4 pairs that push, n) is the derivative of their materials.
    """

    def __init__(self, part: FlowPart, materials: Array, by_parameters: Array):
        nx, nu = part.slopes.size1_in(0), part.slopes.size1_in(1)
        self.by_parameters, self.width = by_parameters, nx + nu
        self._x, self._u = np.empty(nx), np.empty(nu)
        self._rates, self._slopes = np.empty(nx), np.empty((nx + nu, nx))
        self._by_materials = np.empty((part.material_slopes.size2_out(0), nx))
        given = self._x, self._u, materials
        self._kept, self._run = on_arrays(part.slopes, given, (self._rates, self._slopes))
        self._kept_too, self._run_materials = on_arrays(part.material_slopes, given, (self._by_materials,))

    def __call__(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """(M, nx) the rates at xs (M, nx), us (M, nu), and (M, nx, nx + nu + n) their slopes."""
        n = self.by_parameters.shape[1]
        rates, slopes = np.empty(xs.shape), np.empty((*xs.shape, self.width + n))
        for k in range(len(xs)):
            self._x[:], self._u[:] = xs[k], us[k]
            self._run()
            rates[k], slopes[k, :, : self.width] = self._rates, self._slopes.T
            if n:
                self._run_materials()
                slopes[k, :, self.width :] = self._by_materials.T @ self.by_parameters
        return rates, slopes

    def at_ends(self, starts: Array, ends: Array, us: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """The same at the starts (M, nx) and the ends of steps; an end at which the next step starts is taken once."""
        points = np.concatenate([starts, ends])
        same = np.all(starts[1:] == ends[:-1], axis=1) & np.all(us[1:] == us[:-1], axis=1)
        count, own = len(starts), np.ones(2 * len(starts), dtype=bool)
        own[count:-1] = ~same
        where = np.empty(2 * count, dtype=int)
        where[own] = np.arange(np.sum(own))
        where[count:-1][same] = where[1:count][same]
        rates, slopes = self(points[own], np.concatenate([us, us])[own])
        first, last = where[:count], where[count:]
        return (rates[first], slopes[first]), (rates[last], slopes[last])


def between(part: float, starts: Array, ends: Array, hs: Array, at_start: Any, at_end: Any) -> Array:
    """(M, nx) at a `part` of steps of lengths hs (M,), from what `Slopes.at_ends` has there."""
    c, d, h = part, 1 - part, hs[:, None]
    (f0, A0), (f1, A1) = at_start, at_end
    j0, j1 = ((A[:, :, : f.shape[1]] @ f[:, :, None])[:, :, 0] for f, A in ((f0, A0), (f1, A1)))
    of_gap = c**3 * (10 - 15 * c + 6 * c**2)
    of_f0, of_f1 = c * d**3 * (1 + 3 * c), -(c**3) * d * (4 - 3 * c)
    of_j0, of_j1 = c**2 * d**3 / 2, c**3 * d**2 / 2
    found = starts + of_gap * (ends - starts) + h * (of_f0 * f0 + of_f1 * f1) + h**2 * (of_j0 * j0 + of_j1 * j1)
    return np.asarray(found)

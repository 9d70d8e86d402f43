"""Functions that a user writes in JAX, compiled with their derivatives for many points at once."""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import returns_jax
from drake_diff.exceptions import GradientError

SAME_VALUES = 1e-10  # the same operations in another order, relative to values above 1
STEPS = (1e-2, 1e-4, 1e-6)  # relative to max(1, |z|); noise of single precision hides slopes over the last ones
SAME_SLOPES = 1e-4  # of the sum of the slope's terms
LEAST_ROWS, GROWTH = 8, 4  # counts of rows that are compiled: 8, 32, 128, ...
ROUNDING = 1e-14  # of a value, over its size


class JaxRows:
    """A function (x, rest) -> (rows,) of points [x, rest], with derivatives in their first `width` entries.

    Messages show the `name`. The slopes at one point of each batch are compared with differences of the values, and
    GradientError is raised if they differ, as behind `stop_gradient` or a wrong rule.
    """

    def __init__(self, name: str, f: Callable[[Any, Any], Any], nx: int, rows: int, width: int):
        jax: Any = sys.modules["jax"]
        self.name, self.rows, self.width, self._turn = name, rows, width, 0

        def of_point(z: Any, known: Any) -> Any:
            point = jax.numpy.concatenate([z, known])
            result = jax.numpy.asarray(f(point[:nx], point[nx:]), dtype=float)
            return jax.numpy.reshape(result, rows)

        def weighted(z: Any, known: Any, weights: Any) -> Any:
            return weights @ of_point(z, known)

        functions = of_point, jax.jacrev(of_point), jax.hessian(weighted)
        self._values, self._jacobians, self._hessians = (jax.jit(jax.vmap(function)) for function in functions)

    def values(self, points: Array) -> Array:
        """Return the values (K, rows) at points (K, n)."""
        return self._run(self._values, points)

    def jacobians(self, points: Array) -> Array:
        """Return the Jacobians (K, rows, width) at points (K, n), and check those at one of them."""
        jacobians = self.unchecked_jacobians(points)
        if len(points):
            self._turn += 1
            self.check(points[self._turn % len(points)], jacobians[self._turn % len(points)])
        return jacobians

    def unchecked_jacobians(self, points: Array) -> Array:
        """Return the Jacobians (K, rows, width) at points (K, n)."""
        return self._run(self._jacobians, points)

    def hessians(self, points: Array, weights: Array) -> Array:
        """Return the Hessians (K, width, width) of weights (K, rows) times the values at points (K, n)."""
        return self._run(self._hessians, points, weights)

    def check(self, point: Array, jacobian: Array) -> None:
        """Raise GradientError if the slope along a line is not between those of the values to both sides.

        At a corner, any slope between both is correct. A slope is wrong if it is outside over every step.
        """
        width, moves = self.width, []
        direction = np.zeros(len(point))
        direction[:width] = np.cos(self._turn + np.arange(width)) * np.maximum(1.0, np.abs(point[:width]))
        for step in STEPS:
            moves += [point + step * direction, point - step * direction]
        values = self.values(np.array([point, *moves]))
        terms = jacobian * direction[:width]
        claimed, far = np.sum(terms, axis=1), np.ones(self.rows, dtype=bool)
        for k, step in enumerate(STEPS):
            ahead, behind = (values[1 + 2 * k] - values[0]) / step, (values[0] - values[2 + 2 * k]) / step
            allowed = SAME_SLOPES * np.sum(np.abs(terms), axis=1) + ROUNDING * np.max(np.abs(values), axis=0) / step
            outside = (claimed < np.minimum(ahead, behind) - allowed) | (claimed > np.maximum(ahead, behind) + allowed)
            far &= outside & np.isfinite(ahead + behind)
        if np.any(far):
            i = int(np.argmax(far))
            slopes = f"{claimed[i]:.6g} by JAX and {ahead[i]:.6g} by differences"
            raise GradientError(
                f"{self.name}: the slope of value {i} along a line is {slopes}; see dd.certify_function"
            )

    def _run(self, function: Any, points: Array, *more: Array) -> Array:
        """Call a compiled function of rows. Copies of the last are added, since JAX compiles for each count."""
        count, size = len(points), LEAST_ROWS
        while size < count:
            size *= GROWTH
        split = points[:, : self.width], points[:, self.width :], *more
        padding = (np.repeat(rows[-1:], size - count, axis=0) for rows in split)
        padded = [np.concatenate([rows, copies]) for rows, copies in zip(split, padding, strict=True)]
        return np.array(function(*padded)[:count])


def in_jax(name: str, f: Any, nx: int, rows: int, probe: Array, width: int | None = None) -> JaxRows | None:
    """Return the function (x, rest) -> (rows,) of points like `probe` if it is written in JAX, or else None.

    The result is None too if JAX cannot trace all of the function or gets other values. Messages show the `name`.
    """
    with np.errstate(all="ignore"):
        if not returns_jax(name, f, probe[0, :nx], probe[0, nx:]):
            return None
        wanted = np.array([np.reshape(f(point[:nx], point[nx:]), rows) for point in probe])
    function = JaxRows(name, f, nx, rows, probe.shape[1] if width is None else width)
    try:
        values, jacobians = function.values(probe), function.unchecked_jacobians(probe)
    except Exception:  # a part of f may be written in NumPy and raise anything
        return None
    if not np.allclose(values, wanted, rtol=SAME_VALUES, atol=SAME_VALUES, equal_nan=True):
        return None
    for point, jacobian in zip(probe, jacobians, strict=True):
        function.check(point, jacobian)
    return function

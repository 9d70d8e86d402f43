"""Functions that a user writes in JAX, compiled with their derivatives for many points at once."""

import sys
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import returns_jax
from drake_diff.exceptions import GradientWarning

SAME_VALUES = 1e-10  # the same operations in another order, relative to values above 1
STEP, SAME_SLOPES = 1e-6, 1e-4  # a difference over this step is accurate to 1e-6 for values and slopes of order 1


class JaxRows:
    """A function (x, rest) -> (rows,) of points [x, rest], with derivatives in their first `width` entries."""

    def __init__(self, f: Callable[[Any, Any], Any], nx: int, rows: int, width: int):
        jax: Any = sys.modules["jax"]
        self.rows, self.width = rows, width

        def of_point(z: Any, known: Any) -> Any:
            point = jax.numpy.concatenate([z, known])
            return jax.numpy.reshape(f(point[:nx], point[nx:]), rows)

        def weighted(z: Any, known: Any, weights: Any) -> Any:
            return weights @ of_point(z, known)

        functions = of_point, jax.jacrev(of_point), jax.hessian(weighted)
        self._values, self._jacobians, self._hessians = (jax.jit(jax.vmap(function)) for function in functions)

    def values(self, points: Array) -> Array:
        """Return the values (K, rows) at points (K, n)."""
        return np.array(self._values(*self._split(points)))

    def jacobians(self, points: Array) -> Array:
        """Return the Jacobians (K, rows, width) at points (K, n)."""
        return np.array(self._jacobians(*self._split(points)))

    def hessians(self, points: Array, weights: Array) -> Array:
        """Return the Hessians (K, width, width) of weights (K, rows) times the values at points (K, n)."""
        return np.array(self._hessians(*self._split(points), weights))

    def _split(self, points: Array) -> tuple[Array, Array]:
        return points[:, : self.width], points[:, self.width :]


def in_jax(name: str, f: Any, nx: int, rows: int, probe: Array, width: int | None = None) -> JaxRows | None:
    """Return the function (x, rest) -> (rows,) of points like `probe` if it is written in JAX, or else None.

    The result is None too if JAX cannot trace all of the function or gets other values. Messages show the `name`.
    """
    with np.errstate(all="ignore"):
        if not returns_jax(name, f, probe[0, :nx], probe[0, nx:]):
            return None
        wanted = np.array([np.reshape(f(point[:nx], point[nx:]), rows) for point in probe])
    try:
        function = JaxRows(f, nx, rows, probe.shape[1] if width is None else width)
        values = function.values(probe)
    except Exception:  # a part of f may be written in NumPy and raise anything
        return None
    if not np.allclose(values, wanted, rtol=SAME_VALUES, atol=SAME_VALUES, equal_nan=True):
        return None
    _warn_of_other_slopes(name, function, probe)
    return function


def _warn_of_other_slopes(name: str, function: JaxRows, points: Array) -> None:
    """Warn if JAX's slopes along a line are not those of the values, as behind `stop_gradient` or a wrong rule."""
    direction = np.zeros(points.shape[1])
    direction[: function.width] = np.cos(np.arange(function.width))
    ahead, behind = (function.values(points + side * STEP * direction) for side in (1, -1))
    measured, claimed = (ahead - behind) / (2 * STEP), function.jacobians(points) @ direction[: function.width]
    bad = np.abs(measured - claimed) > SAME_SLOPES * np.maximum(1.0, np.abs(measured))
    if np.any(np.all(bad, axis=0)):  # at every point, so that a corner at one of them does not count
        row = int(np.argmax(np.all(bad, axis=0)))
        text = f"value {row} of {name} changes by {measured[0, row]:.6g} along a line, by JAX {claimed[0, row]:.6g}"
        warnings.warn(f"{text}: see dd.certify_function", GradientWarning, stacklevel=2)

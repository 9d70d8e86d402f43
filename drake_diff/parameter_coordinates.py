"""The coordinates in which a solver moves parameters: scaled, and free of values that nothing physical can have."""

from dataclasses import dataclass

import numpy as np

from drake_diff.arrays import Array
from drake_diff.inertia import derivative_of_from_log_cholesky, from_log_cholesky, to_log_cholesky
from drake_diff.parameters import ParameterVector


@dataclass(frozen=True, eq=False)
class ParameterCoordinates:
    """z (np,): a parameter over its first value's size, an inertia's log-Cholesky coordinates."""

    start: ParameterVector

    def __post_init__(self) -> None:
        self.from_values(self.start.values)  # an inertia that has no coordinates is refused here

    @property
    def scale(self) -> Array:
        """(np,) the size of a parameter's first value; 1 where that is zero, or its coordinate is no quotient."""
        size = np.abs(self.start.values)
        scale = np.where(size > 0, size, 1.0)
        for s in self._inertias:
            scale[s] = 1.0
        return scale

    @property
    def _inertias(self) -> list[slice]:
        pairs = zip(self.start.parameters, self.start.slices, strict=True)
        return [s for p, s in pairs if p.kind.quantity == "inertia"]

    def from_values(self, values: Array) -> Array:
        """z of parameter values (np,); bounds of an inertia are the whole line."""
        z = values / self.scale
        for s in self._inertias:
            z[s] = to_log_cholesky(values[s]) if np.all(np.isfinite(values[s])) else values[s]
        return z

    def to_values(self, z: Array) -> Array:
        """(np,) parameter values of z."""
        values = z * self.scale
        for s in self._inertias:
            values[s] = from_log_cholesky(z[s])
        return values

    def pull_back(self, z: Array, by_values: Array) -> Array:
        """(..., np) a derivative by z from one by the values (..., np)."""
        by_z = by_values * self.scale
        for s in self._inertias:
            by_z[..., s] = by_values[..., s] @ derivative_of_from_log_cholesky(z[s])[1]
        return np.asarray(by_z)

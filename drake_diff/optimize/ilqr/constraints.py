"""An augmented Lagrangian that turns goals, waypoints, state bounds and other constraints into costs.

The method is due to Hestenes, Powell and Rockafellar. An equality c = 0 with multiplier y costs y c + p c^2 / 2, and an
inequality c <= 0 costs (max(0, y + p c)^2 - y^2) / (2 p), where p is the penalty. After each minimization y becomes y +
p c, or max(0, y + p c). Howell, Jackson and Manchester, "ALTRO", 2019, use it with iLQR. The Hessian is only p J'J of
the active rows (Gauss-Newton), so that no constraint makes it indefinite.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, slices_of
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import UNSCALED, Scales

FIRST_PENALTIES = (1.0, 1e6)  # the lowest and the highest
LARGEST_PENALTY, GROWTH = 1e9, 10.0
SMALLEST_SLOPE = 1e-8  # slope of a row below which no scale is derived from it


class PenalizedRows:
    """Rows lower <= c <= upper with a `scale` for each row, their multipliers, and one penalty.

    Multipliers are positive at an upper bound and negative at a lower one. All methods take the arguments of `values`,
    which in this class are the values of the rows, with the shape of `lower`.
    """

    def __init__(self, lower: Array, upper: Array, scale: Any = 1.0):
        self.lower, self.upper = lower, upper
        self.scale = np.array(np.broadcast_to(scale, lower.shape), dtype=float)
        self.multipliers = np.zeros(lower.shape)
        self.penalty = FIRST_PENALTIES[0]
        self.is_equality = lower == upper

    def values(self, *given: Array) -> Array:
        """Return c."""
        return given[0]

    @property
    def forces(self) -> Array:
        """The multipliers in the rows' own units, without their scales."""
        return self.multipliers * self.scale

    @forces.setter
    def forces(self, forces: Array) -> None:
        self.multipliers = forces / self.scale

    def excess(self, *given: Array) -> Array:
        """Return how far each row lies beyond its bound, in the row's own unit."""
        values = self.values(*given)
        return np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0)

    def violation(self, *given: Array) -> float:
        """Return the largest `excess`."""
        return float(np.max(self.excess(*given), initial=0.0))

    def pushes(self, *given: Array) -> Array:
        """Return y + p c for each active bound, and 0 for the others."""
        above, below = self._sides(self.values(*given))
        return np.maximum(above, 0.0) + np.minimum(below, 0.0)

    def residual(self, *given: Array) -> float:
        """Return the largest change of a multiplier in `update`, divided by the penalty. It is 0 at a KKT point."""
        return float(np.abs(self.pushes(*given) - self.multipliers).max(initial=0.0)) / self.penalty

    def unrest(self, *given: Array) -> float:
        """Return how much an `update` of the multipliers would change the augmented cost."""
        return float(np.sum((self.pushes(*given) - self.multipliers) ** 2)) / (2 * self.penalty)

    def value(self, *given: Array) -> float:
        """Return the rows' part of the augmented cost."""
        return float(np.sum(self.pushes(*given) ** 2 - self.multipliers**2)) / (2 * self.penalty)

    def expand(self, *given: Array) -> tuple[Array, Array]:
        """Return the gradient of `value` with respect to each row, and the curvature of equalities and active rows."""
        above, below = self._sides(self.values(*given))
        on = (above > 0) | (below < 0) | self.is_equality
        pushes = np.maximum(above, 0.0) + np.minimum(below, 0.0)
        return self.scale * pushes, np.where(on, self.penalty * self.scale**2, 0.0)

    def update(self, *given: Array) -> None:
        """Set the multipliers to the estimate at the minimum of the augmented cost."""
        self.multipliers = self.pushes(*given)

    def _sides(self, values: Array) -> tuple[Array, Array]:
        """Return y + p c for the upper bounds, which are active where it is positive, and for the lower bounds."""
        weight = self.penalty * self.scale
        return self.multipliers + weight * (values - self.upper), self.multipliers + weight * (values - self.lower)


class AugmentedLagrangian(PenalizedRows):
    """The constraints on a motion xs (N+1, nx), us (N, nu). All methods take xs and us.

    The first rows are the state coordinates at every knot, in their own units, without the bounds of x_0. The rows of
    the problem's constraints follow. These are divided by the largest slope |dc / d(x, u)| that they have had at any of
    their knots, so that forces in newtons and positions in metres have comparable weights. Where states, inputs and
    cost have `scales`, a violation has no unit.
    """

    def __init__(self, problem: Problem, scales: Scales = UNSCALED):
        self.problem, self.unit, self.is_scaled = problem, scales.cost, scales is not UNSCALED
        self.spans = np.broadcast_to(scales.variables, problem.nx + problem.nu)
        lower, upper = problem.state_limits()
        lower[0], upper[0] = -np.inf, np.inf
        self.groups = [_Rows(problem, constraint) for constraint in problem.kept]
        super().__init__(
            np.concatenate([lower.ravel(), *(g.lower for g in self.groups)]),
            np.concatenate([upper.ravel(), *(g.upper for g in self.groups)]),
        )
        self.scale[: lower.size] = np.tile(1 / self.spans[: problem.nx], len(lower))
        self.slices = slices_of([lower.size, *(g.size for g in self.groups)])[1:]  # the slice of each group's rows
        self.any = bool(np.any(np.isfinite(self.lower) | np.isfinite(self.upper)))

    def start(self, xs: Array, us: Array, cost: float, gaps: float) -> None:
        """Choose scales, and a penalty that makes the violation of the guess cost as much as its objective.

        `gaps` is the sum of the squares of the guess's other violations.
        """
        self._choose_scales(xs, us)
        wrong = (gaps + float(np.sum((self.scale * self.excess(xs, us)) ** 2))) / 2
        first = abs(cost) / self.unit / wrong if wrong else np.inf
        self.penalty = self.unit * float(np.clip(first, *FIRST_PENALTIES))

    def value(self, *given: Array) -> float:
        return super().value(*given) if self.any else 0.0

    def violation(self, *given: Array) -> float:
        weights = self.scale if self.is_scaled else 1.0
        return float(np.max(weights * self.excess(*given), initial=0.0))

    def values(self, *given: Array) -> Array:
        return np.concatenate([given[0].ravel(), *(group.values(*given) for group in self.groups)])

    def differentiate(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """Return gradients (N+1, nx + nu) and Hessians (N+1, nx + nu, nx + nu) of `value` with respect to [x_k; u_k].

        The Hessians are those of `expand`. Raises GradientError if a constraint's derivative is lost or not finite.
        """
        slopes, stiffness = self.expand(xs, us)
        (count, nx), n = xs.shape, xs.shape[1] + us.shape[1]
        gradients, hessians = np.zeros((count, n)), np.zeros((count, n, n))
        gradients[:, :nx] = slopes[: xs.size].reshape(xs.shape)
        hessians[:, np.arange(nx), np.arange(nx)] = stiffness[: xs.size].reshape(xs.shape)
        for group, rows in zip(self.groups, self.slices, strict=True):
            jacobians = group.jacobians(xs, us)
            gradients[group.knots] += (slopes[rows].reshape(group.shape)[:, None] @ jacobians)[:, 0]
            for k, stiff, by_z in zip(group.knots, stiffness[rows].reshape(group.shape), jacobians, strict=True):
                on = stiff > 0
                if on.any():
                    hessians[k] += (by_z[on].T * stiff[on]).dot(by_z[on])
        return gradients, hessians

    def update(self, *given: Array) -> None:
        """Update the multipliers and the scales."""
        forces = self.pushes(*given) * self.scale
        self._choose_scales(*given)
        self.forces = forces

    def _choose_scales(self, xs: Array, us: Array) -> None:
        for group, rows in zip(self.groups, self.slices, strict=True):
            self.scale[rows] = group.scale(xs, us, self.spans)


class _Rows:
    """One constraint at all its knots, flattened from (knots, rows). It caches the values for the last motion."""

    def __init__(self, problem: Problem, constraint: Constraint):
        self.constraint = constraint
        self.knots = list(constraint.at_knots(problem.num_steps, problem.initial_state_is_given))
        self.shape = (len(self.knots), len(constraint.lower))
        self.size = self.shape[0] * self.shape[1]
        self.lower, self.upper = np.tile(constraint.lower, len(self.knots)), np.tile(constraint.upper, len(self.knots))
        self._steepest = np.zeros(self.shape[1])
        self._kept: dict[str, tuple[bytes, Array]] = {}

    def values(self, xs: Array, us: Array) -> Array:
        """Return the values (size,)."""
        return self._cached("values", xs, us, self.constraint.along).ravel()

    def jacobians(self, xs: Array, us: Array) -> Array:
        """Return the Jacobians (knots, rows, nx + nu)."""
        return self._cached("jacobians", xs, us, self.constraint.slopes)

    def scale(self, xs: Array, us: Array, spans: Array) -> Array:
        """Return (size,) 1 / each row's largest slope so far with respect to (x, u) / `spans` (nx + nu,), or 1 if 0."""
        slopes = np.linalg.norm(self.jacobians(xs, us) * spans, axis=2).max(axis=0)
        self._steepest = np.maximum(self._steepest, slopes)
        steep = self._steepest > SMALLEST_SLOPE
        return np.tile(np.where(steep, 1 / np.where(steep, self._steepest, 1.0), 1.0), len(self.knots))

    def _cached(self, what: str, xs: Array, us: Array, evaluate: Callable[[Array, Array], Array]) -> Array:
        key = xs.tobytes() + us.tobytes()
        if self._kept.get(what, (b"", xs))[0] != key:
            self._kept[what] = key, evaluate(xs[self.knots], us[np.minimum(self.knots, len(us) - 1)])
        return self._kept[what][1]

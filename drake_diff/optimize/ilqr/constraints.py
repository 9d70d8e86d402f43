"""A hard goal, waypoints, state bounds and other constraints as costs: the augmented Lagrangian.

It is due to Hestenes, Powell and Rockafellar. An equality c = 0 with multiplier y costs y c + p c^2 / 2, an inequality
c <= 0 costs (max(0, y + p c)^2 - y^2) / (2 p), where p is the penalty. After each minimization y becomes y + p c, or
max(0, y + p c). Howell, Jackson and Manchester, "ALTRO", 2019, do the same with iLQR inside. Of the Hessian only
p J'J of the rows that push is kept (Gauss-Newton), which no constraint can make indefinite.
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
SMALLEST_SLOPE = 1e-8  # of a row: below it nothing says in what unit it is to be weighed


class PenalizedRows:
    """Rows lower <= c <= upper, each weighed by its `scale`, with their multipliers and one penalty.

    Multipliers are positive at an upper bound and negative at a lower one. All methods take what `values` takes: here
    the values of the rows themselves, of the shape of `lower`.
    """

    def __init__(self, lower: Array, upper: Array, scale: Any = 1.0):
        self.lower, self.upper = lower, upper
        self.scale = np.array(np.broadcast_to(scale, lower.shape), dtype=float)
        self.multipliers = np.zeros(lower.shape)
        self.penalty = FIRST_PENALTIES[0]
        self.is_equality = lower == upper

    def values(self, *given: Array) -> Array:
        """c."""
        return given[0]

    @property
    def forces(self) -> Array:
        """The multipliers of the rows in their own units, whatever their scales are."""
        return self.multipliers * self.scale

    @forces.setter
    def forces(self, forces: Array) -> None:
        self.multipliers = forces / self.scale

    def excess(self, *given: Array) -> Array:
        """How far beyond a bound each row is, in its own unit."""
        values = self.values(*given)
        return np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0)

    def violation(self, *given: Array) -> float:
        """The largest of these."""
        return float(np.max(self.excess(*given), initial=0.0))

    def pushes(self, *given: Array) -> Array:
        """y + p c of each bound that pushes, 0 elsewhere."""
        above, below = self._sides(self.values(*given))
        return np.maximum(above, 0.0) + np.minimum(below, 0.0)

    def residual(self, *given: Array) -> float:
        """The largest change of a multiplier by `update`, over the penalty: 0 at a KKT point."""
        return float(np.abs(self.pushes(*given) - self.multipliers).max(initial=0.0)) / self.penalty

    def unrest(self, *given: Array) -> float:
        """How far the augmented cost is from being the same after an `update`."""
        return float(np.sum((self.pushes(*given) - self.multipliers) ** 2)) / (2 * self.penalty)

    def value(self, *given: Array) -> float:
        """What the rows add to the cost."""
        return float(np.sum(self.pushes(*given) ** 2 - self.multipliers**2)) / (2 * self.penalty)

    def expand(self, *given: Array) -> tuple[Array, Array]:
        """The gradient of `value` by each row, and the curvature of those that push, as equalities always do."""
        above, below = self._sides(self.values(*given))
        on = (above > 0) | (below < 0) | self.is_equality
        pushes = np.maximum(above, 0.0) + np.minimum(below, 0.0)
        return self.scale * pushes, np.where(on, self.penalty * self.scale**2, 0.0)

    def update(self, *given: Array) -> None:
        """Take over the multipliers that the minimum of the augmented cost tells."""
        self.multipliers = self.pushes(*given)

    def _sides(self, values: Array) -> tuple[Array, Array]:
        """y + p c of the upper bounds, which push where it is positive, and of the lower ones."""
        weight = self.penalty * self.scale
        return self.multipliers + weight * (values - self.upper), self.multipliers + weight * (values - self.lower)


class AugmentedLagrangian(PenalizedRows):
    """What must hold of a motion xs (N+1, nx), us (N, nu), which all methods take.

    First a row for every state coordinate at every knot, in its own unit (the bounds of x_0 are not here), then those
    of the problem's constraints. These are divided by the largest slope |dc / d(x, u)| that they were seen to have at
    any of their knots, so that newtons beside metres weigh as the metres do that change them. Where states, inputs and
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
        self.slices = slices_of([lower.size, *(g.size for g in self.groups)])[1:]  # where the rows of each group are
        self.any = bool(np.any(np.isfinite(self.lower) | np.isfinite(self.upper)))

    def start(self, xs: Array, us: Array, cost: float, gaps: float) -> None:
        """Choose scales, and a first penalty that makes the guess as wrong as it is expensive: a good one is not left.

        `gaps` is the sum of the squares of what else is wrong with the guess.
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
        """(gradients (N+1, nx + nu), Hessians (N+1, nx + nu, nx + nu)) of `value` by each [x_k; u_k], as by `expand`.

        Raises GradientError if the derivative of a constraint is lost or not finite.
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
        """Take over the multipliers, and look at the scales."""
        forces = self.pushes(*given) * self.scale
        self._choose_scales(*given)
        self.forces = forces

    def _choose_scales(self, xs: Array, us: Array) -> None:
        for group, rows in zip(self.groups, self.slices, strict=True):
            self.scale[rows] = group.scale(xs, us, self.spans)


class _Rows:
    """One constraint at all its knots: (knots, its own rows) flattened; the last motion's numbers are kept."""

    def __init__(self, problem: Problem, constraint: Constraint):
        self.constraint = constraint
        self.knots = list(constraint.at_knots(problem.num_steps, problem.initial_state_is_given))
        self.shape = (len(self.knots), len(constraint.lower))
        self.size = self.shape[0] * self.shape[1]
        self.lower, self.upper = np.tile(constraint.lower, len(self.knots)), np.tile(constraint.upper, len(self.knots))
        self._steepest = np.zeros(self.shape[1])
        self._kept: dict[str, tuple[bytes, Array]] = {}

    def values(self, xs: Array, us: Array) -> Array:
        """(size,)"""
        return self._cached("values", xs, us, self.constraint.along).ravel()

    def jacobians(self, xs: Array, us: Array) -> Array:
        """(knots, rows, nx + nu)"""
        return self._cached("jacobians", xs, us, self.constraint.slopes)

    def scale(self, xs: Array, us: Array, spans: Array) -> Array:
        """(size,): one over the largest slope so far of each row by (x, u) / `spans` (nx + nu,), 1 if it has none."""
        slopes = np.linalg.norm(self.jacobians(xs, us) * spans, axis=2).max(axis=0)
        self._steepest = np.maximum(self._steepest, slopes)
        steep = self._steepest > SMALLEST_SLOPE
        return np.tile(np.where(steep, 1 / np.where(steep, self._steepest, 1.0), 1.0), len(self.knots))

    def _cached(self, what: str, xs: Array, us: Array, evaluate: Callable[[Array, Array], Array]) -> Array:
        key = xs.tobytes() + us.tobytes()
        if self._kept.get(what, (b"", xs))[0] != key:
            self._kept[what] = key, evaluate(xs[self.knots], us[np.minimum(self.knots, len(us) - 1)])
        return self._kept[what][1]

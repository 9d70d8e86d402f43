"""A hard goal and bounds of states as costs: the augmented Lagrangian of Hestenes, Powell and Rockafellar.

An equality c = 0 with multiplier y costs  y c + p c^2 / 2, an inequality c <= 0 costs
(max(0, y + p c)^2 - y^2) / (2 p), where p is the penalty. After each minimization y becomes y + p c, or
max(0, y + p c). Howell, Jackson and Manchester, "ALTRO", 2019, do the same with iLQR inside.
"""

import numpy as np

from drake_diff.arrays import Array
from drake_diff.problem import Problem

FIRST_PENALTIES = (1.0, 1e6)  # the lowest and the highest
LARGEST_PENALTY, GROWTH = 1e9, 10.0


class StateConstraints:
    """The goal and the state bounds of a problem, their multipliers and their common penalty.

    All are bounds of single coordinates at single knots, a goal being two that coincide; the bounds of x_0 are not
    here. Multipliers (N+1, nx) are positive at an upper bound and negative at a lower one.
    """

    def __init__(self, problem: Problem):
        shape = (problem.num_steps + 1, problem.model.nx)
        bounds = problem.bounds
        self.lower, self.upper = np.tile(bounds.x_lower, (shape[0], 1)), np.tile(bounds.x_upper, (shape[0], 1))
        self.lower[0], self.upper[0] = -np.inf, np.inf
        wanted = ~np.isnan(problem.goal)
        self.lower[-1, wanted] = self.upper[-1, wanted] = problem.goal[wanted]
        self.multipliers = np.zeros(shape)
        self.penalty = FIRST_PENALTIES[0]
        self.any = bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    def choose_penalty(self, xs: Array, cost: float, gaps: float) -> None:
        """A first penalty that makes the guess xs (N+1, nx) as wrong as it is expensive: a good one is not left.

        `gaps` is the sum of the squares of what else is wrong with the guess.
        """
        wrong = (gaps + np.sum(np.maximum(np.maximum(self.lower - xs, xs - self.upper), 0) ** 2)) / 2
        self.penalty = float(np.clip(abs(cost) / wrong if wrong else np.inf, *FIRST_PENALTIES))

    def violation(self, xs: Array) -> float:
        """The largest excess over a bound, or distance from the goal, of xs (N+1, nx), in the state's units."""
        return float(np.maximum(self.lower - xs, xs - self.upper).max(initial=0.0))

    def residual(self, xs: Array) -> float:
        """The largest change of a multiplier by `update`, over the penalty: 0 at a KKT point of xs (N+1, nx)."""
        return float(np.abs(self._pushes(xs) - self.multipliers).max(initial=0.0)) / self.penalty

    def unrest(self, xs: Array) -> float:
        """How far the augmented cost is from saying the same at xs (N+1, nx) after an `update`."""
        return float(np.sum((self._pushes(xs) - self.multipliers) ** 2)) / (2 * self.penalty)

    def value(self, xs: Array) -> float:
        """What the constraints add to the cost of xs (N+1, nx)."""
        if not self.any:
            return 0.0
        return float(np.sum(self._pushes(xs) ** 2 - self.multipliers**2)) / (2 * self.penalty)

    def differentiate(self, xs: Array) -> tuple[Array, Array]:
        """(gradient (N+1, nx), diagonal of the Hessian (N+1, nx)) of `value`."""
        pushes = self._pushes(xs)
        return pushes, np.where((pushes != 0) | (self.lower == self.upper), self.penalty, 0.0)

    def update(self, xs: Array) -> None:
        """Take over the multipliers that the minimum xs (N+1, nx) of the augmented cost tells."""
        self.multipliers = self._pushes(xs)

    def _pushes(self, xs: Array) -> Array:
        """(N+1, nx): y + p c of each bound that pushes, 0 elsewhere."""
        above = self.multipliers + self.penalty * (xs - self.upper)
        below = self.multipliers + self.penalty * (xs - self.lower)
        return np.maximum(above, 0.0) + np.minimum(below, 0.0)

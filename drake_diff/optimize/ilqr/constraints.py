"""A hard goal, waypoints, state bounds and other constraints as costs: the augmented Lagrangian.

It is due to Hestenes, Powell and Rockafellar. An equality c = 0 with multiplier y costs y c + p c^2 / 2, an inequality
c <= 0 costs (max(0, y + p c)^2 - y^2) / (2 p), where p is the penalty. After each minimization y becomes y + p c, or
max(0, y + p c). Howell, Jackson and Manchester, "ALTRO", 2019, do the same with iLQR inside. Of the Hessian only
p J'J of the rows that push is kept (Gauss-Newton), which no constraint can make indefinite.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, slices_of
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.problem import Problem

FIRST_PENALTIES = (1.0, 1e6)  # the lowest and the highest
LARGEST_PENALTY, GROWTH = 1e9, 10.0
Active = tuple[NDArray[np.bool_], NDArray[np.bool_]]  # (m,) which upper bounds push, and which lower ones
SMALLEST_SLOPE = 1e-8  # of a row: below it nothing says in what unit it is to be weighed


class AugmentedLagrangian:
    """What must hold of a motion, as rows lower <= c <= upper, their multipliers and their common penalty.

    First a row for every state coordinate at every knot, in its own unit (the bounds of x_0 are not here), then those
    of the problem's constraints. These are divided by the largest slope |dc / d(x, u)| that they were seen to have at
    any of their knots, so that newtons beside metres weigh as the metres do that change them. Multipliers (m,) are
    positive at an upper bound and negative at a lower one.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        lower, upper = problem.state_limits()
        lower[0], upper[0] = -np.inf, np.inf
        self.groups = [_Rows(problem, constraint) for constraint in problem.kept]
        self.lower = np.concatenate([lower.ravel(), *(g.lower for g in self.groups)])
        self.upper = np.concatenate([upper.ravel(), *(g.upper for g in self.groups)])
        self.slices = slices_of([lower.size, *(g.size for g in self.groups)])[1:]  # where the rows of each group are
        self.scale = np.ones(len(self.lower))
        self.multipliers = np.zeros(len(self.lower))
        self.penalty = FIRST_PENALTIES[0]
        self.any = bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())
        self.is_equality = self.lower == self.upper
        self.have_bends = bool((np.isfinite(self.lower) | np.isfinite(self.upper))[~self.is_equality].any())

    @property
    def forces(self) -> Array:
        """(m,) the multipliers of the rows in their own units, whatever their scales are."""
        return self.multipliers * self.scale

    @forces.setter
    def forces(self, forces: Array) -> None:
        self.multipliers = forces / self.scale

    def start(self, xs: Array, us: Array, cost: float, gaps: float) -> None:
        """Choose scales, and a first penalty that makes the guess as wrong as it is expensive: a good one is not left.

        `gaps` is the sum of the squares of what else is wrong with the guess xs (N+1, nx), us (N, nu).
        """
        self._choose_scales(xs, us)
        wrong = (gaps + float(np.sum((self.scale * self._excess(xs, us)) ** 2))) / 2
        self.penalty = float(np.clip(abs(cost) / wrong if wrong else np.inf, *FIRST_PENALTIES))

    def violation(self, xs: Array, us: Array) -> float:
        """The largest excess over a bound, or distance from the goal, in the row's own unit."""
        return float(np.max(self._excess(xs, us), initial=0.0))

    def residual(self, xs: Array, us: Array) -> float:
        """The largest change of a multiplier by `update`, over the penalty: 0 at a KKT point."""
        return float(np.abs(self._pushes(xs, us) - self.multipliers).max(initial=0.0)) / self.penalty

    def unrest(self, xs: Array, us: Array) -> float:
        """How far the augmented cost is from saying the same at xs, us after an `update`."""
        return float(np.sum((self._pushes(xs, us) - self.multipliers) ** 2)) / (2 * self.penalty)

    def value(self, xs: Array, us: Array) -> float:
        """What the constraints add to the cost of xs (N+1, nx), us (N, nu)."""
        if not self.any:
            return 0.0
        return self._value(*self._forces(self._values(xs, us)))

    def active(self, xs: Array, us: Array) -> Active:
        """Which rows push."""
        return self._active(*self._forces(self._values(xs, us)))

    def look_ahead(self, xs: Array, us: Array, dxs: Array, dus: Array) -> tuple[Active, float]:
        """Which rows push, and `value`, at the distance dxs (N+1, nx), dus (N, nu) from xs, us, by the rows' slopes."""
        zs, moved = np.hstack([dxs, np.vstack([dus, dus[-1:]])]), [dxs.ravel()]
        for group in self.groups:
            moved.append(np.einsum("kri,ki->kr", group.jacobians(xs, us), zs[group.knots]).ravel())
        forces = self._forces(self._values(xs, us) + np.concatenate(moved))
        return self._active(*forces), self._value(*forces)

    def differentiate(self, xs: Array, us: Array, active: Active | None = None) -> tuple[Array, Array]:
        """(gradients (N+1, nx + nu), Hessians (N+1, nx + nu, nx + nu)) of `value` by each [x_k; u_k].

        Given other rows than those that push here, of what `value` would be if the given pushed, and they alone. Raises
        GradientError if that of a constraint is lost or not finite.
        """
        above, below = self._forces(self._values(xs, us))
        active = self._active(above, below) if active is None else active
        pushes = np.where(active[0], above, 0.0) + np.where(active[1], below, 0.0)
        stiffness = np.where(active[0] | active[1], self.penalty, 0.0)
        (count, nx), n = xs.shape, xs.shape[1] + us.shape[1]
        gradients, hessians = np.zeros((count, n)), np.zeros((count, n, n))
        gradients[:, :nx] = pushes[: xs.size].reshape(xs.shape)
        hessians[:, np.arange(nx), np.arange(nx)] = stiffness[: xs.size].reshape(xs.shape)
        for group, rows in zip(self.groups, self.slices, strict=True):
            jacobians = self.scale[rows].reshape(group.shape)[:, :, None] * group.jacobians(xs, us)
            gradients[group.knots] += (pushes[rows].reshape(group.shape)[:, None] @ jacobians)[:, 0]
            stiff = stiffness[rows].reshape(group.shape)
            for k, those, by_z in zip(group.knots, stiff, jacobians, strict=True):
                pushing = by_z[those > 0]
                if len(pushing):
                    hessians[k] += self.penalty * pushing.T.dot(pushing)
        return gradients, hessians

    def update(self, xs: Array, us: Array) -> None:
        """Take over the multipliers that the minimum xs, us of the augmented cost tells, and look at the scales."""
        forces = self._pushes(xs, us) * self.scale
        self._choose_scales(xs, us)
        self.forces = forces

    def _choose_scales(self, xs: Array, us: Array) -> None:
        for group, rows in zip(self.groups, self.slices, strict=True):
            self.scale[rows] = group.scale(xs, us)

    def _values(self, xs: Array, us: Array) -> Array:
        return np.concatenate([xs.ravel(), *(group.values(xs, us) for group in self.groups)])

    def _excess(self, xs: Array, us: Array) -> Array:
        values = self._values(xs, us)
        return np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0)

    def _forces(self, values: Array) -> tuple[Array, Array]:
        """(m,) each: y + p c of the upper bounds, which push where it is positive, and of the lower ones."""
        weight = self.penalty * self.scale
        return self.multipliers + weight * (values - self.upper), self.multipliers + weight * (values - self.lower)

    def _active(self, above: Array, below: Array) -> Active:
        """An equality pushes always, on one side or the other: it is told as its upper bound."""
        return (above > 0) | self.is_equality, (below < 0) & ~self.is_equality

    def _value(self, above: Array, below: Array) -> float:
        pushes = np.maximum(above, 0.0) + np.minimum(below, 0.0)
        return float(np.sum(pushes**2 - self.multipliers**2)) / (2 * self.penalty)

    def _pushes(self, xs: Array, us: Array) -> Array:
        """(m,): y + p c of each bound that pushes, 0 elsewhere."""
        above, below = self._forces(self._values(xs, us))
        return np.maximum(above, 0.0) + np.minimum(below, 0.0)


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
        return self._at("values", xs, us, self.constraint.along).ravel()

    def jacobians(self, xs: Array, us: Array) -> Array:
        """(knots, rows, nx + nu)"""
        return self._at("jacobians", xs, us, self.constraint.slopes)

    def scale(self, xs: Array, us: Array) -> Array:
        """(size,): one over the largest slope so far of each row, 1 if it has had none."""
        slopes = np.linalg.norm(self.jacobians(xs, us), axis=2).max(axis=0)
        self._steepest = np.maximum(self._steepest, slopes)
        steep = self._steepest > SMALLEST_SLOPE
        return np.tile(np.where(steep, 1 / np.where(steep, self._steepest, 1.0), 1.0), len(self.knots))

    def _at(self, what: str, xs: Array, us: Array, evaluate: Callable[[Array, Array], Array]) -> Array:
        key = xs.tobytes() + us.tobytes()
        if self._kept.get(what, (b"", xs))[0] != key:
            self._kept[what] = key, evaluate(xs[self.knots], us[np.minimum(self.knots, len(us) - 1)])
        return self._kept[what][1]

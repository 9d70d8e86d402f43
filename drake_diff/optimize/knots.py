"""Batched values and exact derivatives of functions of points, such as the knots z = [x, u] of a motion.

A function is traced to a CasADi expression if possible, and otherwise called point by point with AutoDiffXd. Hessians
of costs are positive semidefinite, because negative eigenvalues are set to 0.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.jax_rows import JaxRows, in_jax
from drake_diff._base.values import Refusal
from drake_diff.exceptions import GradientError
from drake_diff.mechanics.casadi_tree import agrees
from drake_diff.mechanics.clearance import OfShapes
from drake_diff.mechanics.symbol import Mapped, Symbol, symbols
from drake_diff.optimize.problem.constraint import Constraint, short
from drake_diff.optimize.problem.cost import (
    QuadraticCost,
    QuadraticForm,
    SumOfCosts,
    TimedCost,
    TrackingCost,
    differentiate_final_cost,
    final_cost_hessian,
    quadratic_form,
)
from drake_diff.optimize.problem.goals import GoalConstraint, WithGoals
from drake_diff.optimize.problem.obstacles import ClearanceConstraint
from drake_diff.optimize.problem.problem import Problem

SAME_VALUES = 1e-10  # relative to the largest value at a knot; the same operations may be rounded in another order
DIFFERENCE = 1e-5  # step of differences, relative to max(1, |z|), of exact Jacobians that are accurate to 1e-12
Values = Callable[[Array], Array]  # points (K, w) -> (K, m)
Linearize = Callable[[Array], tuple[Array, Array]]  # -> (K, m), (K, m, w)
Pattern = tuple[Indices, Indices]  # rows and columns of a matrix's nonzeros


def trace(f: Callable[[Any, Any], Any], nx: int, probe: Array, wanted: Array) -> Any | Refusal:
    """Trace the function (x, u) -> (m,) to an SX function of a knot [x, u], or return the reason why that fails.

    It must return the values `wanted` (P, m) at the knots `probe` (P, nx + nu).
    """
    knot = ca.SX.sym("knot", probe.shape[1])
    entries = symbols(knot)
    try:
        with np.errstate(all="ignore"):
            result = np.asarray(f(entries[:nx], entries[nx:])).ravel()
            expressions = [entry.sx if isinstance(entry, Symbol) else float(entry) for entry in result]
    except Exception as error:  # f need not support symbols, and may raise anything
        return Refusal(f"{type(error).__name__}: {str(error).splitlines()[0][:100] if str(error) else ''}")
    function = ca.Function("traced", [knot], [ca.vertcat(*expressions)])
    if not agrees(function, probe, wanted, SAME_VALUES):
        return Refusal("its symbolic form gives other values")
    return function


class PointFunction:
    """A function from a point of `width` entries to m numbers.

    `why_not` is the reason why it has no exact second derivatives, or "". If it is `linear`, a search takes them as 0.
    `jacobian_at` and `hessian_at` (upper triangle) are the positions of the nonzeros at one point.
    """

    rows: int
    width: int
    why_not: str = ""
    linear: bool = False
    jacobian_at: Pattern
    hessian_at: Pattern

    def values(self, points: Array) -> Array:
        """Compute the values (K, m) at points (K, width)."""
        raise NotImplementedError

    def jacobian(self, points: Array) -> Array:
        """Compute the nonzeros (K, nonzeros) of the Jacobians."""
        raise NotImplementedError

    def hessian(self, points: Array, weights: Array, jacobian: Array) -> Array:
        """Compute the Hessians' nonzeros (K, nonzeros) of weights (K, m) times the values; `jacobian` is known."""
        raise NotImplementedError

    def linearize(self, points: Array) -> tuple[Array, Array]:
        """Compute the values (K, m) and the Jacobians (K, m, width)."""
        dense = np.zeros((len(points), self.rows, self.width))
        dense[:, self.jacobian_at[0], self.jacobian_at[1]] = self.jacobian(points)
        return self.values(points), dense

    @cached_property
    def columns(self) -> Indices:
        """The entries of a point that the function depends on."""
        return np.unique(self.jacobian_at[1])


class Traced(PointFunction):
    """A function with a CasADi expression. `known` holds its further arguments, each (K, p)."""

    def __init__(self, function: Any, *known: Array):
        self.function, self.known = function, known
        self.rows, self.width = function.size1_out(0), function.size1_in(0)

    def values(self, points: Array) -> Array:
        return self._values(points, *self.known)[0]

    def jacobian(self, points: Array) -> Array:
        return self._slopes(points, *self.known)[0]

    def hessian(self, points: Array, weights: Array, jacobian: Array) -> Array:
        return self._curves(points, weights, *self.known)[0]

    @cached_property
    def jacobian_at(self) -> Pattern:  # type: ignore[override]
        return _places(self._slopes.function.sparsity_out(0))

    @cached_property
    def hessian_at(self) -> Pattern:  # type: ignore[override]
        return _places(self._curves.function.sparsity_out(0))

    @cached_property
    def _values(self) -> Mapped:
        inputs = self._symbols()
        return Mapped(ca.Function("values", inputs, [ca.densify(self.function(*inputs))]))

    @cached_property
    def _slopes(self) -> Mapped:
        inputs = self._symbols()
        return Mapped(ca.Function("jacobian", inputs, [ca.jacobian(self.function(*inputs), inputs[0])]))

    @cached_property
    def _curves(self) -> Mapped:
        (point, *known), weights = self._symbols(), ca.SX.sym("weights", self.rows)
        hessian, _ = ca.hessian(ca.dot(weights, self.function(point, *known)), point)
        return Mapped(ca.Function("hessian", [point, weights, *known], [ca.triu(hessian)]))

    def _symbols(self) -> list[Any]:
        return [ca.SX.sym(f"z{i}", self.function.size1_in(i)) for i in range(self.function.n_in())]


class InJax(PointFunction):
    """A function written in JAX. `known` (K, p) are its further arguments, if its points do not have them."""

    def __init__(self, function: JaxRows, known: Array | None = None):
        self.function, self.known = function, known
        self.rows, self.width = function.rows, function.width
        self.jacobian_at = np.repeat(np.arange(self.rows), self.width), np.tile(np.arange(self.width), self.rows)
        self.hessian_at = np.triu_indices(self.width)

    def _whole(self, points: Array) -> Array:
        return points if self.known is None else np.hstack([points, self.known])

    def values(self, points: Array) -> Array:
        return self.function.values(self._whole(points))

    def jacobian(self, points: Array) -> Array:
        return self.function.jacobians(self._whole(points)).reshape(len(points), -1)

    def hessian(self, points: Array, weights: Array, jacobian: Array) -> Array:
        return self.function.hessians(self._whole(points), weights)[:, *self.hessian_at]


class Called(PointFunction):
    """A function that is called, and that depends on the entries `depends` of a point (None: on all entries).

    Its second derivatives are differences of its Jacobians, or 0 if it is `linear`.
    """

    def __init__(
        self,
        why_not: str,
        values: Values,
        linearize: Linearize,
        rows: int,
        width: int,
        depends: Indices | None = None,
        *,
        linear: bool = False,
    ):
        self.why_not, self.rows, self.width, self.linear = why_not, rows, width, linear
        self._evaluate, self._linearize = values, linearize
        self._depends = np.arange(width) if depends is None else depends
        self.jacobian_at = np.repeat(np.arange(rows), len(self._depends)), np.tile(self._depends, rows)
        above, right = np.triu_indices(len(self._depends))
        self.hessian_at = self._depends[above], self._depends[right]

    def values(self, points: Array) -> Array:
        return self._evaluate(points)

    def jacobian(self, points: Array) -> Array:
        return self._linearize(points)[1][:, :, self._depends].reshape(len(points), -1)

    def hessian(self, points: Array, weights: Array, jacobian: Array) -> Array:
        size = len(self._depends)
        if self.linear:
            return np.zeros((len(points), len(self.hessian_at[0])))
        full, pushed = np.zeros((len(points), size, size)), np.flatnonzero(np.any(weights, axis=1))
        points, weights = points[pushed], weights[pushed]
        for j, column in enumerate(self._depends if len(pushed) else ()):
            step = np.zeros_like(points)
            step[:, column] = DIFFERENCE * np.maximum(1.0, np.abs(points[:, column]))
            low, high = (self.jacobian(points + side * step).reshape(len(points), -1, size) for side in (-1, 1))
            full[pushed, :, j] = np.einsum("km,kmi->ki", weights, high - low) / (2 * step[:, column, None])
        full = (full + full.swapaxes(1, 2)) / 2
        return np.asarray(full[:, *np.triu_indices(size)])


def _places(sparsity: Any) -> Pattern:
    return np.array(sparsity.row(), dtype=np.intp), np.array(sparsity.get_col(), dtype=np.intp)


def constraint_function(c: Constraint, nx: int, probe: Array) -> PointFunction:
    """Return the function that a constraint limits. `probe` (P, nx + nu) are points [x, u] that test its expression."""
    if isinstance(c, ClearanceConstraint) and isinstance(c.clearance, OfShapes):  # Drake's distances have no expression
        depends, why_not = np.arange(c.clearance.model.nq), "distances between shapes are taken as linear"
        return _called(c, why_not, nx, probe[:0], depends, linear=True)
    values = c.along(probe[:, :nx], probe[:, nx:])
    as_given: Any = c.function if c.takes_input else lambda x, u: c.function(x)
    with np.errstate(all="ignore"):
        function = trace(as_given, nx, probe, values)
    if not isinstance(function, Refusal):
        return Traced(function)
    if (compiled := in_jax(f"constraint {c.label}", as_given, nx, len(c.lower), probe)) is not None:
        return InJax(compiled)
    return _called(c, function.reason, nx, probe, np.arange(probe.shape[1] if c.takes_input else nx))


def knot_function(c: Constraint, nx: int, nu: int, probe: Array) -> PointFunction:
    """Return this function of a knot [x, u]. Clearances are called, as few of their many rows are close."""
    if isinstance(c, ClearanceConstraint):
        return _called(c, "called", nx, np.empty((0, nx + nu)), np.arange(c.clearance.model.nq))
    return constraint_function(c, nx, probe)


def _called(c: Constraint, why_not: str, nx: int, probe: Array, depends: Indices, *, linear: bool = False) -> Called:
    def values(knots: Array) -> Array:
        return c.along(knots[:, :nx], knots[:, nx:])

    def linearize(knots: Array) -> tuple[Array, Array]:
        return values(knots), c.slopes(knots[:, :nx], knots[:, nx:])

    return Called(why_not, values, linearize, len(c.lower), probe.shape[1], depends, linear=linear)


class Selected(PointFunction):
    """The selection of entries from a point of `width` numbers."""

    def __init__(self, which: Indices, width: int):
        self.rows, self.width = len(which), width
        self.jacobian_at = np.arange(len(which)), which

    def values(self, points: Array) -> Array:
        return points[:, self.jacobian_at[1]]

    def jacobian(self, points: Array) -> Array:
        return np.ones((len(points), self.rows))


class KnotCost(Protocol):
    """A cost at knots (K, n) at times (K,) [s]."""

    def values(self, knots: Array, times: Array) -> Array:
        """Compute the costs (K,)."""
        ...

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        """Compute the gradients (K, n) and the positive semidefinite Hessians (K, n, n)."""
        ...


def knot_cost(cost: Any, nx: int, nu: int, probe: Array, *, gauss_newton: bool = False) -> KnotCost:
    """Return the knot cost of a running cost of (x, u), or of a final cost of x if nu = 0. None means no cost.

    `probe` (P, nx + nu) are knots that test the cost's expression. With `gauss_newton`, the Hessians of weighted goals
    omit the second derivatives of the goals' residuals.
    """
    if cost is None:
        return _Sum(())
    if isinstance(cost, SumOfCosts):
        return _Sum([knot_cost(term, nx, nu, probe, gauss_newton=gauss_newton) for term in cost.costs])
    if isinstance(cost, WithGoals) and gauss_newton:
        squares = [_WeightedGoal(weight, goal, nx, nu, probe) for weight, goal in cost.goals]
        return _Sum([knot_cost(cost.own, nx, nu, probe), *squares])
    tracking = cost if isinstance(cost, TrackingCost) else None
    form = quadratic_form(cost if tracking is None else QuadraticCost(Q=tracking.Q, R=tracking.R), nx, nu)
    if form is not None:
        return _Quadratic(form, tracking)
    return _Function(cost, nx, nu, probe)


class _Sum:
    def __init__(self, terms: Sequence[KnotCost]):
        self.terms = terms

    def values(self, knots: Array, times: Array) -> Array:
        return sum((term.values(knots, times) for term in self.terms), np.zeros(len(knots)))

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        count, n = knots.shape
        gradients, hessians = np.zeros((count, n)), np.zeros((count, n, n))
        for term in self.terms:
            gradient, hessian = term.expand(knots, times)
            gradients += gradient
            hessians += hessian
        return gradients, hessians


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """A quadratic form of the knots minus the references of `tracking` at their times."""

    form: QuadraticForm
    tracking: TrackingCost | None = None

    def _knots(self, knots: Array, times: Array) -> Array:
        if self.tracking is None:
            return knots
        known = self.tracking.known_at(times)
        return np.hstack([knots[:, : known.shape[1]] - known, knots[:, known.shape[1] :]])

    def values(self, knots: Array, times: Array) -> Array:
        return self.form.values(self._knots(knots, times))

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        hessian = 2 * self.form.weight
        return self.form.gradients(self._knots(knots, times)), np.broadcast_to(hessian, (len(knots), *hessian.shape))


class _WeightedGoal:
    """The weighted squared residuals of a goal, with the Gauss-Newton Hessian."""

    def __init__(self, weight: float, goal: GoalConstraint, nx: int, nu: int, probe: Array):
        self.weight, size = weight, len(goal.residuals(probe[0, :nx]))
        constraint = Constraint(goal.residuals, lower=np.zeros(size), name=goal.label)
        self.function = knot_function(constraint, nx, nu, probe)

    def values(self, knots: Array, times: Array) -> Array:
        return self.weight * np.sum(self.function.values(knots) ** 2, axis=1)

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        off, jacobians = self.function.linearize(knots)
        doubled = 2 * self.weight * jacobians
        return np.einsum("kr,kri->ki", off, doubled), np.einsum("kri,krj->kij", jacobians, doubled)


class _Function:
    """Any other cost, by its expression, or else called at each knot, with differences of exact gradients."""

    def __init__(self, cost: Any, nx: int, nu: int, probe: Array):
        self.timed = cost if isinstance(cost, TimedCost) else None
        self.nx, self.n = nx, nx + nu

        def evaluate(x: Any, rest: Any) -> Any:
            if self.timed is not None:
                return self.timed.of(x, rest[:nu], rest[nu:])
            return cost(x, rest) if nu else cost(x)

        self.evaluate, self.mapped, self.by_jax = evaluate, None, None
        knots = self._with_known(probe, np.zeros(len(probe)))
        with np.errstate(all="ignore"):
            function = trace(evaluate, nx, knots, self._called(knots)[:, None])
        if isinstance(function, Refusal):
            self.by_jax = in_jax("cost", evaluate, nx, 1, knots, self.n)
            return
        z, known = ca.SX.sym("z", self.n), ca.SX.sym("known", knots.shape[1] - self.n)
        inputs, value = [ca.vertcat(z, known)], function(ca.vertcat(z, known))
        hessian, gradient = ca.hessian(value, z)
        both = [ca.densify(gradient), ca.densify(hessian)]
        self.mapped = (
            Mapped(ca.Function("value", inputs, [ca.densify(value)])),
            Mapped(ca.Function("slopes", inputs, both)),
        )

    def _with_known(self, knots: Array, times: Array) -> Array:
        return knots if self.timed is None else np.hstack([knots, self.timed.known_at(times)])

    def _called(self, rows: Array) -> Array:
        return np.array([float(self.evaluate(row[: self.nx], row[self.nx :])) for row in rows])

    def values(self, knots: Array, times: Array) -> Array:
        rows = self._with_known(knots, times)
        if self.by_jax is not None:
            return self.by_jax.values(rows)[:, 0]
        if self.mapped is None:
            return self._called(rows)
        return np.asarray(self.mapped[0](rows)[0][:, 0])

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        rows = self._with_known(knots, times)
        if self.mapped is not None:
            gradients, hessians = self.mapped[1](rows)
            return gradients, not_negative(hessians.reshape(len(rows), self.n, self.n))
        if self.by_jax is not None:
            hessians = self.by_jax.hessians(rows, np.ones((len(rows), 1)))
            return self.by_jax.jacobians(rows)[:, 0], not_negative(hessians)
        gradients, hessians = np.empty(knots.shape), np.empty((*knots.shape, self.n))
        for k, (z, row) in enumerate(zip(knots, rows, strict=True)):

            def at_knot(z: Any, known: Array = row[self.n :]) -> Any:
                return self.evaluate(z[: self.nx], np.concatenate([z[self.nx :], known]))

            gradients[k] = differentiate_final_cost(at_knot, z)[1]
            hessians[k] = final_cost_hessian(at_knot, z)
        return gradients, hessians


def not_negative(hessians: Array) -> Array:
    """Set the negative eigenvalues of symmetric matrices (K, n, n) to 0."""
    if not np.all(np.isfinite(hessians)):
        return hessians
    values, vectors = np.linalg.eigh(hessians)
    if np.min(values, initial=0.0) >= 0.0:
        return hessians
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ vectors.swapaxes(1, 2))


@dataclass(frozen=True, eq=False)
class Stage:
    """`weight` times a cost of [x, u] (or of x if `final`) at the knots `at` of 0 ... N, at `times` (K,) [s]."""

    cost: KnotCost
    at: slice
    times: Array
    weight: float
    final: bool = False


@dataclass(frozen=True)
class Costs:
    """The cost of a motion xs (N+1, nx), us (N, nu): the sum of its stages."""

    stages: tuple[Stage, ...]

    def _evaluate(self, evaluate: Callable[[Stage, Array], Any], xs: Array, us: Array) -> list[Any]:
        knots = np.hstack([xs[:-1], us])
        return [evaluate(stage, (xs if stage.final else knots)[stage.at]) for stage in self.stages]

    def values(self, xs: Array, us: Array) -> Array:
        """Compute the costs (N+1,) of the knots."""
        total = np.zeros(len(xs))
        values = self._evaluate(lambda stage, knots: stage.weight * stage.cost.values(knots, stage.times), xs, us)
        for stage, of_knots in zip(self.stages, values, strict=True):
            total[stage.at] += of_knots
        return total

    def expand(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """Compute gradients (N+1, nx + nu) and Hessians (N+1, nx + nu, nx + nu), or raise GradientError."""
        nx, n = xs.shape[1], xs.shape[1] + us.shape[1]
        gradients, hessians = np.zeros((len(xs), n)), np.zeros((len(xs), n, n))
        expanded = self._evaluate(lambda stage, knots: stage.cost.expand(knots, stage.times), xs, us)
        for stage, (gradient, hessian) in zip(self.stages, expanded, strict=True):
            width = nx if stage.final else n
            gradients[stage.at, :width] += stage.weight * gradient
            hessians[stage.at, :width, :width] += stage.weight * hessian
        knots = np.hstack([xs, np.vstack([us, np.zeros((len(xs) - len(us), us.shape[1]))])])
        require_finite(np.concatenate([gradients[:, None], hessians], axis=1), knots)
        return gradients, hessians


def require_finite(derivatives: Array, knots: Array) -> None:
    """Raise GradientError if the derivatives (K, ...) of a cost are not finite at one of the knots (K, n)."""
    bad = ~np.isfinite(derivatives).reshape(len(derivatives), -1).all(axis=1)
    if bad.any():
        k = int(np.argmax(bad))
        raise GradientError(
            f"the cost's derivative is not finite at knot {k}, [x; u] = {short(knots[k])}: a norm has no derivative at "
            "zero, sqrt(f + 1e-9) has one"
        )


_KNOT_COSTS: WeakKeyDictionary[Problem, tuple[KnotCost, KnotCost]] = WeakKeyDictionary()


def costs_of(problem: Problem, xs: Array, us: Array, time_step: float | None = None) -> Costs:
    """Return the running and the final cost of `problem` for steps of `time_step` [s], by default the model's.

    The first call tests their expressions at knots of xs (N+1, nx), us (N, nu).
    """
    h, N = problem.time_step if time_step is None else time_step, len(us)
    costs = _KNOT_COSTS.get(problem)
    if costs is None:
        k = [0, N // 2, N - 1]
        probe = np.hstack([xs[k], us[k]])
        running = knot_cost(problem.total_running_cost, problem.nx, problem.nu, probe)
        costs = _KNOT_COSTS[problem] = running, knot_cost(problem.total_final_cost, problem.nx, 0, xs[k])
    times = h * np.arange(N + 1.0)
    final = Stage(costs[1], slice(N, N + 1), times[N:], 1.0, final=True)
    return Costs((Stage(costs[0], slice(0, N), times[:N], h), final))

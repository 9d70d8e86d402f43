"""Costs and constraints at the knots z = [x, u] of motions: values and exact derivatives of many knots in one call.

A function is traced to a CasADi expression where that is possible, and else called knot by knot with AutoDiffXd.
Hessians of costs are positive semidefinite: negative eigenvalues are cut to 0.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import Refusal
from drake_diff.exceptions import GradientError
from drake_diff.mechanics.casadi_tree import agrees
from drake_diff.mechanics.symbol import Symbol, symbols
from drake_diff.optimize.problem.constraint import Constraint
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

SAME_VALUES = 1e-10  # of the largest value at a knot: the same operations, rounded in another order


def trace(f: Callable[[Any, Any], Any], nx: int, probe: Array, wanted: Array) -> Any | Refusal:
    """The function (x, u) -> (m,) as an SX function of a knot [x, u], or why there is none.

    It must give the values `wanted` (P, m) at the knots `probe` (P, nx + nu).
    """
    knot = ca.SX.sym("knot", probe.shape[1])
    entries = symbols(knot)
    try:
        with np.errstate(all="ignore"):
            result = np.asarray(f(entries[:nx], entries[nx:])).ravel()
            expressions = [entry.sx if isinstance(entry, Symbol) else float(entry) for entry in result]
    except Exception as error:  # whatever it is that f cannot do with symbols: it need not
        return Refusal(f"{type(error).__name__}: {str(error).splitlines()[0][:100] if str(error) else ''}")
    function = ca.Function("traced", [knot], [ca.vertcat(*expressions)])
    if not agrees(function, probe, wanted, SAME_VALUES):
        return Refusal("its symbolic form gives other values")
    return function


class KnotCost(Protocol):
    """A cost at knots (K, n) at times (K,) [s]."""

    def values(self, knots: Array, times: Array) -> Array:
        """(K,)"""
        ...

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        """Gradients (K, n) and Hessians (K, n, n), which are positive semidefinite."""
        ...


def knot_cost(cost: Any, nx: int, nu: int, probe: Array, *, gauss_newton: bool = False) -> KnotCost:
    """A running cost of (x, u), or with nu = 0 a final one of x; None costs nothing.

    `probe` (P, nx + nu) are knots at which its expression is compared with it. With `gauss_newton` the Hessians of
    goals with a weight leave out the second derivatives of what these measure.
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
    """A quadratic form, from whose knots the references of `tracking` at their times are subtracted."""

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
    """The weighted square of what a goal misses, with Gauss and Newton's curvature."""

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
    """Any other cost: by its expression, or where it has none, knot by knot with differences of exact gradients."""

    def __init__(self, cost: Any, nx: int, nu: int, probe: Array):
        self.timed = cost if isinstance(cost, TimedCost) else None
        self.nx, self.n = nx, nx + nu

        def of(x: Any, rest: Any) -> Any:
            if self.timed is not None:
                return self.timed.of(x, rest[:nu], rest[nu:])
            return cost(x, rest) if nu else cost(x)

        self.of, self.columns = of, None
        knots = self._with_known(probe, np.zeros(len(probe)))
        with np.errstate(all="ignore"):
            function = trace(of, nx, knots, self._called(knots)[:, None])
        if isinstance(function, Refusal):
            return
        z, known = ca.SX.sym("z", self.n), ca.SX.sym("known", knots.shape[1] - self.n)
        inputs, value = [ca.vertcat(z, known)], function(ca.vertcat(z, known))
        hessian, gradient = ca.hessian(value, z)
        self.columns = Columns(inputs, [value]), Columns(inputs, [gradient, hessian])

    def _with_known(self, knots: Array, times: Array) -> Array:
        return knots if self.timed is None else np.hstack([knots, self.timed.known_at(times)])

    def _called(self, rows: Array) -> Array:
        return np.array([float(self.of(row[: self.nx], row[self.nx :])) for row in rows])

    def values(self, knots: Array, times: Array) -> Array:
        rows = self._with_known(knots, times)
        if self.columns is None:
            return self._called(rows)
        return np.asarray(self.columns[0](rows)[0][:, 0, 0])

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        rows = self._with_known(knots, times)
        if self.columns is not None:
            gradients, hessians = self.columns[1](rows)
            return gradients[:, 0], not_negative(hessians)
        gradients, hessians = np.empty(knots.shape), np.empty((*knots.shape, self.n))
        for k, (z, row) in enumerate(zip(knots, rows, strict=True)):

            def at_knot(z: Any, known: Array = row[self.n :]) -> Any:
                return self.of(z[: self.nx], np.concatenate([z[self.nx :], known]))

            gradients[k] = differentiate_final_cost(at_knot, z)[1]
            hessians[k] = final_cost_hessian(at_knot, z)
        return gradients, hessians


def not_negative(hessians: Array) -> Array:
    """(K, n, n) symmetric matrices, their negative eigenvalues cut to 0."""
    if not np.all(np.isfinite(hessians)):
        return hessians
    values, vectors = np.linalg.eigh(hessians)
    if np.min(values, initial=0.0) >= 0.0:
        return hessians
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ vectors.swapaxes(1, 2))


@dataclass(frozen=True, eq=False)
class Stage:
    """`weight` times a cost at some of the knots 0 ... N, at their times (K,) [s]: of [x, u], or of x where `final`."""

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
        """(N+1,) of the knots."""
        total = np.zeros(len(xs))
        values = self._evaluate(lambda stage, knots: stage.weight * stage.cost.values(knots, stage.times), xs, us)
        for stage, of_knots in zip(self.stages, values, strict=True):
            total[stage.at] += of_knots
        return total

    def expand(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """Gradients (N+1, nx + nu) and Hessians (N+1, nx + nu, nx + nu); GradientError where one is not finite."""
        nx, n = xs.shape[1], xs.shape[1] + us.shape[1]
        gradients, hessians = np.zeros((len(xs), n)), np.zeros((len(xs), n, n))
        expanded = self._evaluate(lambda stage, knots: stage.cost.expand(knots, stage.times), xs, us)
        for stage, (gradient, hessian) in zip(self.stages, expanded, strict=True):
            width = nx if stage.final else n
            gradients[stage.at, :width] += stage.weight * gradient
            hessians[stage.at, :width, :width] += stage.weight * hessian
        if not (np.all(np.isfinite(gradients)) and np.all(np.isfinite(hessians))):
            raise GradientError("the cost's derivative is not finite along the motion")
        return gradients, hessians


_KNOT_COSTS: WeakKeyDictionary[Problem, tuple[KnotCost, KnotCost]] = WeakKeyDictionary()


def costs_of(problem: Problem, xs: Array, us: Array, time_step: float | None = None) -> Costs:
    """The running and the final cost of `problem`, in steps of `time_step` [s], the model's where None.

    Where they were not expanded before, their expressions are compared with them at knots of xs (N+1, nx), us (N, nu).
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


class KnotFunction(Protocol):
    """What a constraint limits, at knots (K, nx + nu)."""

    columns: Indices  # of a knot: those that it depends on

    def values(self, knots: Array) -> Array:
        """(K, m)"""
        ...

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """(K, m), and the Jacobians (K, m, nx + nu)."""
        ...


def knot_function(constraint: Constraint, nx: int, nu: int, probe: Array) -> KnotFunction:
    """What `constraint` limits; `probe` (P, nx + nu) are knots at which its expression is compared with it."""
    if isinstance(constraint, ClearanceConstraint):
        return _CalledRows(constraint, nx, np.arange(constraint.clearance.model.nq))

    def f(x: Any, u: Any) -> Any:
        return constraint.function(x, u) if constraint.takes_input else constraint.function(x)

    with np.errstate(all="ignore"):
        traced = trace(f, nx, probe, constraint.along(probe[:, :nx], probe[:, nx:]))
    if isinstance(traced, Refusal):
        return _CalledRows(constraint, nx, np.arange(nx + nu if constraint.takes_input else nx))
    return _TracedRows(traced)


class Selected:
    """Entries of a knot of `width` numbers."""

    def __init__(self, which: Indices, width: int):
        self.columns = which
        self._rows = np.eye(width)[which]

    def values(self, knots: Array) -> Array:
        return knots[:, self.columns]

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        return knots[:, self.columns], np.broadcast_to(self._rows, (len(knots), *self._rows.shape))


class _TracedRows:
    def __init__(self, function: Any):
        z = ca.SX.sym("z", function.size1_in(0))
        value = function(z)
        jacobian = ca.jacobian(value, z)
        self.columns = np.unique(np.array(jacobian.sparsity().get_col(), dtype=np.intp))
        self._values, self._both = Columns([z], [value]), Columns([z], [value, jacobian])

    def values(self, knots: Array) -> Array:
        return self._values(knots)[0][:, 0]

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        values, jacobians = self._both(knots)
        return values[:, 0], jacobians.swapaxes(1, 2)


class _CalledRows:
    def __init__(self, constraint: Constraint, nx: int, columns: Indices):
        self.constraint, self.nx, self.columns = constraint, nx, columns

    def values(self, knots: Array) -> Array:
        return self.constraint.along(knots[:, : self.nx], knots[:, self.nx :])

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        return self.values(knots), self.constraint.slopes(knots[:, : self.nx], knots[:, self.nx :])


class Columns:
    """A CasADi function of columns at many of them in one call: rows (K, .) in, dense (K, columns, rows) out."""

    def __init__(self, inputs: list[Any], outputs: list[Any]):
        self.function = ca.Function("columns", inputs, [ca.densify(output) for output in outputs])
        self._maps: dict[int, Any] = {}

    def __call__(self, *rows: Array) -> list[Array]:
        count = len(rows[0])
        if count not in self._maps:
            mapped, f = self.function.map(count), self.function
            buffer, evaluate = mapped.buffer()
            arrays = [np.empty((count, f.size2_out(i), f.size1_out(i))) for i in range(f.n_out())]
            for i, array in enumerate(arrays):
                buffer.set_res(i, array.reshape(-1).data)
            self._maps[count] = buffer, evaluate, arrays, mapped
        buffer, evaluate, arrays, _ = self._maps[count]
        given = [np.ascontiguousarray(array, dtype=float).reshape(-1) for array in rows]
        for i, array in enumerate(given):
            buffer.set_arg(i, array.data)
        evaluate()
        return [np.array(array) for array in arrays]

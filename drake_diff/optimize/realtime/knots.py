"""Costs and constraints at many knots in one call, with exact derivatives and curvature that is nowhere negative.

A knot is a row z = [x, u]. A function is traced to a CasADi expression where that is possible (see
`transcription.expressions`), and else called knot by knot with AutoDiffXd.
"""

from collections.abc import Sequence
from typing import Any, Protocol

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import Refusal
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.cost import (
    ConstantCost,
    CostToGo,
    QuadraticCost,
    SumOfCosts,
    TimedCost,
    TrackingCost,
    cost_at,
    differentiate_cost,
    running_cost_hessian,
)
from drake_diff.optimize.problem.goals import GoalConstraint, WithGoals
from drake_diff.optimize.problem.obstacles import ClearanceConstraint
from drake_diff.optimize.transcription.expressions import trace


class KnotCost(Protocol):
    """A cost at knots (K, n) at times (K,) [s]."""

    def values(self, knots: Array, times: Array) -> Array:
        """(K,)"""
        ...

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        """Gradients (K, n) and Hessians (K, n, n), which are positive semidefinite."""
        ...


def knot_cost(cost: Any, nx: int, nu: int, probe: Array) -> KnotCost:
    """A running cost of (x, u), or with nu = 0 a final one of x; None costs nothing. `probe` (P, n): knots to try."""
    if cost is None:
        return _Sum(())
    if isinstance(cost, SumOfCosts):
        return _Sum(tuple(knot_cost(term, nx, nu, probe) for term in cost.costs))
    if isinstance(cost, WithGoals):
        inner = knot_cost(cost.own, nx, nu, probe)
        return _Sum((inner, *(_Missed(weight, goal, nx, nu, probe) for weight, goal in cost.goals)))
    if isinstance(cost, QuadraticCost):
        return _Quadratic(cost, nx, nu)
    if isinstance(cost, TrackingCost):
        return _Tracking(cost, nx, nu)
    if isinstance(cost, CostToGo):
        return _Remaining(cost)
    if isinstance(cost, ConstantCost):
        return _Constant(cost.rate)
    return _traced_cost(cost, nx, nu, probe)


class _Sum:
    def __init__(self, parts: Sequence[KnotCost]):
        self.parts = parts

    def values(self, knots: Array, times: Array) -> Array:
        return sum((term.values(knots, times) for term in self.parts), np.zeros(len(knots)))

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        count, n = knots.shape
        gradients, hessians = np.zeros((count, n)), np.zeros((count, n, n))
        for term in self.parts:
            gradient, hessian = term.expand(knots, times)
            gradients += gradient
            hessians += hessian
        return gradients, hessians


class _Constant:
    def __init__(self, rate: float):
        self.rate = rate

    def values(self, knots: Array, times: Array) -> Array:
        return np.full(len(knots), self.rate)

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        return np.zeros(knots.shape), np.zeros((*knots.shape, knots.shape[1]))


class _Quadratic:
    def __init__(self, cost: QuadraticCost, nx: int, nu: int):
        self.weight, self.reference = np.zeros((nx + nu, nx + nu)), np.zeros(nx + nu)
        parts = [(slice(0, nx), cost.Q, cost.x_ref), (slice(nx, nx + nu), cost.R, cost.u_ref)][: 1 + (nu > 0)]
        for columns, weight, reference in parts:
            self.weight[columns, columns] = 0.0 if weight is None else weight
            self.reference[columns] = 0.0 if reference is None else reference

    def _apart(self, knots: Array, times: Array) -> Array:
        return knots - self.reference

    def values(self, knots: Array, times: Array) -> Array:
        d = self._apart(knots, times)
        return np.asarray(np.einsum("ki,ki->k", d, d @ self.weight))

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        hessian = 2 * self.weight
        return self._apart(knots, times) @ hessian, np.broadcast_to(hessian, (len(knots), *hessian.shape))


class _Tracking(_Quadratic):
    def __init__(self, cost: TrackingCost, nx: int, nu: int):
        super().__init__(QuadraticCost(Q=cost.Q, R=cost.R), nx, nu)
        self.cost = cost

    def _apart(self, knots: Array, times: Array) -> Array:
        known = self.cost.known_at(times)
        deviations = np.array(knots)
        deviations[:, : known.shape[1]] -= known
        return deviations


class _Remaining:
    def __init__(self, cost: CostToGo):
        self.cost = cost

    def values(self, knots: Array, times: Array) -> Array:
        return np.array([self.cost(x) for x in knots])

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        hessian = self.cost.hessian
        gradients = self.cost.gradient + (knots - self.cost.x_ref) @ hessian
        return gradients, np.broadcast_to(hessian, (len(knots), *hessian.shape))


class _Missed:
    """The weighted square of what a goal misses, with Gauss and Newton's curvature."""

    def __init__(self, weight: float, goal: GoalConstraint, nx: int, nu: int, probe: Array):
        self.weight = weight
        f, wanted = goal.function, goal.wanted
        if goal.measured is not None:
            f, wanted = goal.measured, np.zeros(len(np.atleast_1d(goal.measured(probe[0, :nx]))))
        self.kept = np.flatnonzero(~np.isnan(wanted))
        self.wanted = wanted[self.kept]
        constraint = Constraint(f, lower=np.full(len(wanted), 0.0), name=goal.label)
        self.function = knot_function(constraint, nx, nu, probe)

    def values(self, knots: Array, times: Array) -> Array:
        off = self.function.values(knots)[:, self.kept] - self.wanted
        return self.weight * np.sum(off**2, axis=1)

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        values, rows = self.function.linearize(knots)
        off, rows = values[:, self.kept] - self.wanted, rows[:, self.kept]
        doubled = 2 * self.weight * rows
        return np.einsum("kr,kri->ki", off, doubled), np.einsum("kri,krj->kij", rows, doubled)


def _traced_cost(cost: Any, nx: int, nu: int, probe: Array) -> KnotCost:
    if isinstance(cost, TimedCost):
        known = cost.known_at(np.zeros(len(probe)))

        def of(x: Any, rest: Any) -> Any:
            return cost.of(x, rest[:nu], rest[nu:])

    else:
        known = np.empty((len(probe), 0))

        def of(x: Any, rest: Any) -> Any:
            return cost(x, rest) if nu else cost(x)

    tried = np.hstack([probe, known])
    with np.errstate(all="ignore"):
        wanted = np.array([[float(of(z[:nx], z[nx:]))] for z in tried])
        traced = trace(of, nx, tried, wanted)
    return _Called(cost, nx, nu) if isinstance(traced, Refusal) else _Traced(cost, traced, nx + nu)


class _Traced:
    def __init__(self, cost: Any, function: Any, n: int):
        self.cost = cost if isinstance(cost, TimedCost) else None
        z, known = ca.SX.sym("z", n), ca.SX.sym("known", function.size1_in(0) - n)
        value = function(ca.vertcat(z, known))
        hessian, gradient = ca.hessian(value, z)
        inputs = [z, known] if self.cost is not None else [z]
        self._value, self._both = Columns(inputs, [value]), Columns(inputs, [gradient, hessian])

    def _given(self, knots: Array, times: Array) -> list[Array]:
        return [knots] if self.cost is None else [knots, self.cost.known_at(times)]

    def values(self, knots: Array, times: Array) -> Array:
        return np.asarray(self._value(*self._given(knots, times))[0][:, 0, 0])

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        gradients, hessians = self._both(*self._given(knots, times))
        return gradients[:, 0], not_negative(hessians)


class _Called:
    """Knot by knot: of a function that is no expression."""

    def __init__(self, cost: Any, nx: int, nu: int):
        self.cost, self.nx, self.nu = cost, nx, nu

    def _at(self, time: float) -> Any:
        cost = cost_at(self.cost, time)
        return cost if self.nu else lambda x, u: cost(x)

    def values(self, knots: Array, times: Array) -> Array:
        rows = zip(knots, times, strict=True)
        return np.array([float(self._at(t)(z[: self.nx], z[self.nx :])) for z, t in rows])

    def expand(self, knots: Array, times: Array) -> tuple[Array, Array]:
        gradients, hessians = [], []
        for z, t in zip(knots, times, strict=True):
            cost, x, u = self._at(t), z[: self.nx], z[self.nx :]
            gradients.append(np.concatenate(differentiate_cost(cost, x, u)[1:]))
            hessians.append(running_cost_hessian(cost, x, u))
        return np.array(gradients), np.array(hessians)


def not_negative(hessians: Array) -> Array:
    """(K, n, n) symmetric matrices, their negative eigenvalues cut to 0."""
    values, vectors = np.linalg.eigh(hessians)
    if np.min(values, initial=0.0) >= 0.0:
        return hessians
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ vectors.swapaxes(1, 2))


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
    """What `constraint` limits; `probe` (P, nx + nu) are knots to try."""
    if isinstance(constraint, ClearanceConstraint):
        return _Clear(constraint, nx, nu)
    takes_input = constraint.takes_input

    def function(x: Any, u: Any) -> Any:
        return np.atleast_1d(np.asarray(constraint.function(x, u) if takes_input else constraint.function(x)))

    with np.errstate(all="ignore"):
        traced = trace(function, nx, probe, np.array([constraint(z[:nx], z[nx:]) for z in probe]))
    return _CalledRows(constraint, nx, nu) if isinstance(traced, Refusal) else _TracedRows(traced)


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
    def __init__(self, constraint: Constraint, nx: int, nu: int):
        self.constraint, self.nx = constraint, nx
        self.columns = np.arange(nx + nu if constraint.takes_input else nx)

    def values(self, knots: Array) -> Array:
        return np.array([self.constraint(z[: self.nx], z[self.nx :]) for z in knots])

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        pairs = [self.constraint.differentiate(z[: self.nx], z[self.nx :]) for z in knots]
        return np.array([value for value, _ in pairs]), np.array([rows for _, rows in pairs])


class _Clear:
    def __init__(self, constraint: ClearanceConstraint, nx: int, nu: int):
        self.clearance, self.nx, self.nu = constraint.clearance, nx, nu
        self.columns = np.arange(constraint.clearance.model.nq)

    def values(self, knots: Array) -> Array:
        return self.clearance.values(knots[:, : self.nx])

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        values, rows = self.clearance.linearize(knots[:, : self.nx])
        return values, np.concatenate([rows, np.zeros((*values.shape, self.nu))], axis=2)


class Columns:
    """A CasADi function of columns at many of them in one call: rows (K, .) in, dense (K, columns, rows) out."""

    def __init__(self, inputs: list[Any], outputs: list[Any]):
        self.function = ca.Function("columns", inputs, [ca.densify(output) for output in outputs])
        self._kept: dict[int, Any] = {}

    def __call__(self, *rows: Array) -> list[Array]:
        count = len(rows[0])
        if count not in self._kept:
            mapped, f = self.function.map(count), self.function
            buffer, evaluate = mapped.buffer()
            arrays = [np.empty((count, f.size2_out(i), f.size1_out(i))) for i in range(f.n_out())]
            for i, array in enumerate(arrays):
                buffer.set_res(i, array.reshape(-1).data)
            self._kept[count] = buffer, evaluate, arrays, mapped
        buffer, evaluate, arrays, _ = self._kept[count]
        given = [np.ascontiguousarray(array, dtype=float).reshape(-1) for array in rows]
        for i, array in enumerate(given):
            buffer.set_arg(i, array.data)
        evaluate()
        return [np.array(array) for array in arrays]

"""First-order optimality of a discrete plan, by our own multipliers, and what its states do to its end.

With the multipliers mu of what holds the plan (goal, waypoints, and the bounds and constraints that it lies on), the
Lagrangian is L = cost + mu' c. At an optimum its gradient by every variable that no bound holds is zero, and
d L / d x_k, the later steps being functions of x_k, is the costate (Nocedal and Wright, "Numerical Optimization", 2006,
ch. 12). The multipliers are those that leave the least gradient, an inequality's of its own sign alone, so that nothing
here is a solver's word.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, frozen
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.motion.loss import Totals, accumulate
from drake_diff.optimize.ilqr.riccati import minimize_in_box
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.shooting import RolloutCost, ShootingVariables

RIDGE = 1e-12  # on columns of length 1: rows that say the same have no multipliers of their own
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Optimality:
    """What `optimality` finds; a discrete plan is a stationary point where `gradient` is rounding beside `terms`."""

    multipliers: Array  # (m,) of what holds the plan
    state_norms: Array  # (N+1,) |d L / d x_k|, the cost's unit per the state's
    gradient: float  # the largest |d L / d z| of an optimized variable that no bound holds
    terms: float  # the largest sum of magnitudes that such an entry is made of

    @property
    def ratio(self) -> float:
        """`gradient` over `terms`; 0 where there are no terms."""
        return self.gradient / self.terms if self.terms else 0.0


@dataclass(frozen=True, eq=False)
class _Row:
    """A row that holds the plan: its derivatives by states and inputs, and the signs that its multiplier may have."""

    knots: tuple[int, ...]
    by_x: Array  # (knots, nx)
    by_u: Array  # (knots, nu)
    lowest: float  # -inf or 0
    highest: float  # inf or 0


def final_state_norms(linearization: list[StepDerivatives]) -> Array:
    """(N+1,) |d x_N / d x_k|, the largest singular value, from the derivatives of N steps."""
    product = np.eye(len(linearization[-1].x_next))
    norms = [1.0]
    for d in reversed(linearization):
        product = product @ d.A
        norms.append(float(np.linalg.norm(product, 2)))
    return frozen(norms[::-1])


def optimality(problem: Problem, variables: ShootingVariables, z: Array) -> Optimality:
    """How far the plan at z (size,) is from a stationary point of the Lagrangian.

    Raises GradientError where a cost or constraint has no derivative.
    """
    linearization = variables.linearization(z)
    xs, us = variables.states(z), variables.unpack(z)[1]
    direct_xs, direct_us = RolloutCost(problem, variables).partials(z)[1:]
    rows = list(_rows(problem, xs, us))
    columns = [variables.gradient(z, _totals(linearization, row, xs, us)) for row in rows]
    of_parameters = RolloutCost(problem, variables).by_design(z)[1]
    of_cost = of_parameters + variables.gradient(z, accumulate(linearization, direct_xs, direct_us))
    jacobian = np.array(columns).reshape(len(rows), len(of_cost)).T
    sides = _sides(variables, z)
    free = ~(sides[0] | sides[1])
    multipliers = _multipliers(of_cost[free], jacobian[free], rows)
    for row, multiplier in zip(rows, multipliers, strict=True):
        for knot, by_x, by_u in zip(row.knots, row.by_x, row.by_u, strict=True):
            direct_xs[knot] += multiplier * by_x
            if knot < len(us):
                direct_us[knot] += multiplier * by_u
    totals = accumulate(linearization, direct_xs, direct_us)
    left = of_parameters + variables.gradient(z, totals)
    left = np.where(sides[0], np.minimum(left, 0.0), np.where(sides[1], np.maximum(left, 0.0), left))
    terms = np.abs(variables.gradient(z, Totals(direct_xs, direct_us, 0 * totals.parameters, totals.policy)))
    steps = [d.A.T @ state for d, state in zip(linearization[:1], totals.states[1:], strict=False)]
    by_us = [d.B.T @ state for d, state in zip(linearization, totals.states[1:], strict=True)]
    by_p = sum(np.abs(d.C.T @ state) for d, state in zip(linearization, totals.states[1:], strict=True))
    through = Totals(np.array([*steps, *totals.states[1:]]), np.array(by_us), np.asarray(by_p), totals.policy)
    terms += np.abs(variables.gradient(z, through)) + np.abs(of_parameters)
    return Optimality(
        multipliers=frozen(multipliers),
        state_norms=frozen(np.linalg.norm(totals.states, axis=1)),
        gradient=float(np.max(np.abs(left), initial=0.0)),
        terms=float(np.max(terms, initial=0.0)),
    )


def _totals(linearization: list[StepDerivatives], row: _Row, xs: Array, us: Array) -> Totals:
    by_xs, by_us = np.zeros_like(xs), np.zeros_like(us)
    for knot, by_x, by_u in zip(row.knots, row.by_x, row.by_u, strict=True):
        by_xs[knot] = by_x
        if knot < len(us):
            by_us[knot] = by_u
    return accumulate(linearization, by_xs, by_us)


def _rows(problem: Problem, xs: Array, us: Array) -> Iterator[_Row]:
    """Goal, waypoints, and each bound of a state after the first, constraint and coupling that the plan lies on."""
    none = np.zeros(us.shape[1])
    lower, upper = problem.state_limits()
    for k, i in np.argwhere((xs <= lower + FEASIBILITY_TOLERANCE) | (xs >= upper - FEASIBILITY_TOLERANCE)):
        if k:
            yield _Row((int(k),), np.eye(problem.nx)[[i]], none[None], *_signs(xs[k, i], lower[k, i], upper[k, i]))
    for constraint in problem.kept:
        for k in problem.knots_of(constraint, input_at_end=False):
            yield from _held(constraint, (k,), xs[k], us[min(k, len(us) - 1)])
    for coupling in problem.coupled_steps():
        for at in coupling.knots:
            yield from _held(coupling.rows, tuple(at.tolist()), *coupling.packed(xs, us, at))


def _held(constraint: Constraint, knots: tuple[int, ...], x: Array, u: Array) -> Iterator[_Row]:
    """The rows of `constraint` that lie on a bound, with x and u the states and inputs at the `knots` side by side."""
    values, by_xu = constraint.differentiate(x, u)
    count = len(knots)
    for value, slopes, least, most in zip(values, by_xu, constraint.lower, constraint.upper, strict=True):
        if value <= least + FEASIBILITY_TOLERANCE or value >= most - FEASIBILITY_TOLERANCE:
            by_x, by_u = slopes[: len(x)].reshape(count, -1), slopes[len(x) :].reshape(count, -1)
            yield _Row(knots, by_x, by_u, *_signs(value, least, most))


def _signs(value: float, lower: float, upper: float) -> tuple[float, float]:
    """What a multiplier may be: below 0 on a lower bound alone, above 0 on an upper one alone."""
    on_lower, on_upper = value <= lower + FEASIBILITY_TOLERANCE, value >= upper - FEASIBILITY_TOLERANCE
    return -np.inf if on_lower else 0.0, np.inf if on_upper else 0.0


def _sides(variables: ShootingVariables, z: Array) -> tuple[Mask, Mask]:
    """Which variables lie on their lower bound, and which on their upper one."""
    lower, upper = variables.limits()
    return z <= lower + FEASIBILITY_TOLERANCE, z >= upper - FEASIBILITY_TOLERANCE


def _multipliers(of_cost: Array, jacobian: Array, rows: list[_Row]) -> Array:
    """(m,) those with the least |of_cost + jacobian mu|, each of its own signs."""
    if not rows or not len(of_cost):
        return np.zeros(len(rows))
    lowest, highest = (np.array([getattr(row, side) for row in rows]) for side in ("lowest", "highest"))
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0] = 1.0
    unit, acts = jacobian / scale, np.ones(len(rows), dtype=bool)
    found = np.linalg.lstsq(unit, -of_cost)[0]
    if np.any((found < lowest) | (found > highest)):
        hessian = unit.T @ unit + RIDGE * np.eye(len(rows))
        _, acts = minimize_in_box(hessian, unit.T @ of_cost, lowest, highest)
        found = np.zeros(len(rows))
        found[acts] = np.linalg.lstsq(unit[:, acts], -of_cost)[0]
        found = np.clip(found, lowest, highest)
    return np.asarray(found / scale)

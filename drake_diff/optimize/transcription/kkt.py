"""The Karush-Kuhn-Tucker system of a collocated plan, for derivatives of its variables with respect to the problem.

Let y be the multipliers of the rows that are active at the plan z. The stationarity of the Lagrangian and these rows
remain valid as the problem changes by p, so that, for a constant active set,

    [ H  A' ] [ dz ]      [ d^2 L / dz dp ]
    [ A  0  ] [ dy ]  = - [ dg / dp       ]

(Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming", 1983, ch. 3).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, Indices
from drake_diff.exceptions import GradientError
from drake_diff.model.parameters import Parameters, applied, select
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Multipliers
from drake_diff.optimize.transcription.nodes import TranscribedProgram
from drake_diff.optimize.transcription.steps import StepProgram

NEAR_BOUND = 1e-4  # of max(1, |bound|): a value this near may be on it, as an interior point method leaves sqrt(mu)
WEAK = 1e-4  # of the cost's largest slope: a bound or row with a smaller multiplier may be inactive
LEFT = 3e-7  # largest value of both if an interior point method leaves a product of 1e-14
NEAREST = 1e-5  # of max(1, |p|): a corner (a change of the active set) nearer than this is one of the plan
ROUNDED = 1e-7  # of the largest derivative of a kind: smaller ones count as 0
SINGULAR, REFINEMENTS = 1e-10, 4  # diagonal entry for redundant rows, and refinements of its error
DIFFERENCE = 1e-5  # of max(1, |p|): step of differences of exact first derivatives with respect to a model parameter
FLAT = "the plan has no derivative: the optimum is not unique, as a change of the plan leaves the cost unchanged"
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Change:
    """The change of the problem: entries of the first or last node, or parameters of the model."""

    columns: tuple[str, ...]
    values: Array  # (p,)
    ends: Indices | None  # the entries of the state
    end: str = ""
    parameters: Parameters = ()

    @contextmanager
    def moved(self, problem: Problem, column: int, step: float) -> Iterator[Problem]:
        """Yield the problem with one column moved by `step`."""
        if self.ends is None:
            values = np.array(self.values)
            values[column] += step
            moved, settings = select(problem.model, self.parameters).at(values).to_dict(), problem.parameters.to_dict()
            others = {name: value for name, value in moved.items() if name not in settings}
            with applied(select(problem.model, others)) as model:
                given = {name: moved.get(name, value) for name, value in settings.items()}
                yield replace(problem, system=model, parameters=given)
            return
        first = self.end == "x0"
        state = np.array(problem.x0 if first else problem.x_goal)
        state[self.ends[column]] += step
        yield replace(problem, x0=state) if first else replace(problem, x_goal=state)


KnotProgram = TranscribedProgram | StepProgram


@dataclass(frozen=True, eq=False)
class Held:
    """Derivatives of the variables (n, p) and the cost (p,), weakly active rows, and the number of active ones."""

    dz: Array
    cost: Array
    weak: tuple[str, ...]
    active: int


class HeldPlan:
    """The Lagrangian's second derivatives and the active rows of a solution, in the variables without active bounds.

    `make` returns the program of a problem, also of a changed one. Its variables at the plan are z (n,).
    """

    def __init__(self, problem: Problem, make: Callable[[Problem], KnotProgram], z: Array):
        self.problem, self.make, self.z = problem, make, z
        self.program = program = make(problem)
        self.derivatives = program.derivatives(exact=True)
        self.slope, self.values, self.rows = self._first_derivatives(self.derivatives)

    def _first_derivatives(self, derivatives: dict[str, Any]) -> tuple[Array, Array, Any]:
        """Return the cost's gradient (n,), the rows' values (m,) and Jacobian. Raises GradientError if refused."""
        slope = np.asarray(derivatives["grad_f"](self.z, [])[1]).ravel()
        values, rows = derivatives["jac_g"](self.z, [])
        if not (np.all(np.isfinite(slope)) and np.all(np.isfinite(rows.nonzeros()))):
            raise GradientError("the plan has no derivative: a step or a cost cannot be differentiated there")
        return slope, np.asarray(values).ravel(), rows

    @cached_property
    def fixed(self) -> Mask:
        """A mask (n,) of the variables that are given."""
        return self.program.lower >= self.program.upper

    @cached_property
    def multipliers(self) -> Multipliers:
        """The multipliers that minimize the Lagrangian's gradient."""
        on_bound, _, of_rows, left = self._active
        return Multipliers(np.where(on_bound | self.fixed, -left, 0.0), of_rows)

    @cached_property
    def left(self) -> float:
        """The Lagrangian's remaining gradient, relative to the cost's largest slope. It is 0 at an optimum."""
        on_bound, _, _, left = self._active
        return float(np.max(np.abs(left[~(on_bound | self.fixed)]), initial=0.0)) / self._scale

    @property
    def _scale(self) -> float:
        return max(float(np.max(np.abs(self.slope))), 1e-300)

    def solve(self, change: Change) -> Held:
        """Return the derivatives of the variables with respect to `change`, for a constant active set."""
        on_bound, on_row, multipliers, _ = self._active
        free = np.flatnonzero(~(self.fixed | on_bound))
        dz = np.zeros((len(self.z), len(change.values)))
        right, of_cost = np.zeros((len(self.z) + len(self.values), len(change.values))), np.zeros(len(change.values))
        if change.ends is not None:
            ends = self.program.states_at[0 if change.end == "x0" else -1]
            dz[ends[change.ends], np.arange(len(change.ends))] = 1.0
        else:
            of_cost, right = self._by_parameters(change, multipliers)
        hessian = self._hessian(multipliers)
        rows = self.rows[np.flatnonzero(on_row).tolist(), :]
        first = -(np.asarray(ca.mtimes(hessian, ca.DM(dz))) + right[: len(self.z)])[free]
        second = -(np.asarray(ca.mtimes(rows, ca.DM(dz))) + right[len(self.z) :][on_row])
        indices = free.tolist()
        solution = _kkt(hessian[indices, indices], rows[:, indices], first, second)
        dz[free] = solution[: len(free)]
        of_rows = np.zeros((len(self.values), len(change.values)))
        of_rows[on_row] = solution[len(free) :]
        moved = np.asarray(ca.mtimes(self.rows, ca.DM(dz))) + right[len(self.z) :]
        left = np.asarray(ca.mtimes(hessian, ca.DM(dz)) + ca.mtimes(self.rows.T, ca.DM(of_rows))) + right[: len(self.z)]
        weak = self._weak(np.maximum(1.0, np.abs(change.values)), dz, left, moved, of_rows)
        holding = int(np.sum(on_bound) + np.sum(on_row & (self.program.sides[0] < self.program.sides[1])))
        return Held(dz, self.slope @ dz + of_cost, weak, holding)

    def _weak(self, units: Array, dz: Array, left: Array, moved: Array, of_rows: Array) -> tuple[str, ...]:
        """Name bounds and rows that become active or inactive, to first order, if a column moves by NEAREST units.

        The derivatives are of the variables, of the remaining gradient, of the rows and of their multipliers.
        """
        on_bound, on_row, multipliers, remains = self._active
        lower, upper = self.program.lower, self.program.upper
        equal = self.program.sides[0] >= self.program.sides[1]
        apart, row_apart = _apart(self.z, lower, upper), _apart(self.values, *self.program.sides)
        free, free_row = ~(self.fixed | on_bound), ~(on_row | equal)
        weak = free & _crosses(apart, dz, units)
        weak |= on_bound & _crosses(np.abs(remains) / self._scale, left / self._scale, units)
        weak_row = free_row & _crosses(row_apart, moved, units)
        weak_row |= on_row & ~equal & _crosses(np.abs(multipliers) / self._scale, of_rows / self._scale, units)
        return (*self._names(weak), *[f"row {i}" for i in np.flatnonzero(weak_row)])

    def _hessian(self, multipliers: Array) -> Any:
        upper = self.derivatives["hess_lag"](self.z, [], 1.0, multipliers)
        return ca.triu2symm(upper)

    @cached_property
    def _active(self) -> tuple[Mask, Mask, Array, Array]:
        """Masks of active bounds and rows, the multipliers of all rows, and the Lagrangian's remaining gradient (n,).

        A bound or row is inactive if its distance from the plan exceeds its multiplier, both relative to their size.
        """
        program, (least, most) = self.program, self.program.sides
        low, high = _near(self.z, program.lower), _near(program.upper, self.z)
        row_low, row_high = _near(self.values, least), _near(most, self.values)
        equal = least >= most
        scale = self._scale
        on_bound, holds = (low | high) & ~self.fixed, row_low | row_high | equal
        while True:  # one at a time, since of equivalent ones only one is active
            on_row = holds & (equal | self._moves(on_bound))
            multipliers, left = self._multipliers(on_bound, on_row)
            by_bound = np.where(on_bound, -left, 0.0)
            pull = np.where(on_bound & ~(low & high), np.where(low, by_bound, -by_bound), 0.0)
            pull_row = np.where(on_row & ~equal & ~(row_low & row_high), np.where(row_low, 1, -1) * multipliers, 0.0)
            worst, worst_row = int(np.argmax(pull)), int(np.argmax(pull_row)) if len(pull_row) else 0
            if max(pull[worst], pull_row[worst_row]) <= WEAK * scale:
                break
            if pull[worst] >= pull_row[worst_row]:
                on_bound[worst] = False
            else:
                holds[worst_row] = False
        idle = on_bound & (np.abs(by_bound) <= scale * np.maximum(LEFT, _apart(self.z, program.lower, program.upper)))
        idle_row = on_row & ~equal & (np.abs(multipliers) <= scale * np.maximum(LEFT, _apart(self.values, least, most)))
        if np.any(idle) or np.any(idle_row):
            on_bound, holds = on_bound & ~idle, holds & ~idle_row
            on_row = holds & (equal | self._moves(on_bound))
            multipliers, left = self._multipliers(on_bound, on_row)
        return on_bound, on_row, multipliers, left

    def _moves(self, on_bound: Mask) -> Mask:
        """Return a mask (m,) of the rows that depend on free variables. The other rows follow from bounds."""
        of_row = np.asarray(ca.sum2(ca.fabs(self.rows[:, np.flatnonzero(~(self.fixed | on_bound)).tolist()]))).ravel()
        return of_row > 0

    def _names(self, which: Mask) -> list[str]:
        return [self.program.names[i] for i in np.flatnonzero(which).tolist()]

    def _multipliers(self, on_bound: Mask, on_row: Mask) -> tuple[Array, Array]:
        """Return the multipliers (m,) that minimize the Lagrangian's gradient, and the remaining gradient (n,)."""
        free, rows = np.flatnonzero(~(self.fixed | on_bound)), np.flatnonzero(on_row)
        jacobian = self.rows[rows.tolist(), free.tolist()]
        solution = _kkt(ca.DM.eye(len(free)), jacobian, -self.slope[free][:, None], np.zeros((len(rows), 1)))
        multipliers = np.zeros(len(self.values))
        multipliers[rows] = solution[len(free) :, 0]
        left = self.slope + np.asarray(ca.mtimes(self.rows.T, ca.DM(multipliers))).ravel()
        return multipliers, left

    def _by_parameters(self, change: Change, multipliers: Array) -> tuple[Array, Array]:
        """Return derivatives (p,) of the cost and (n + m, p) of the Lagrangian's gradient and rows, by differences."""

        def at(column: int, step: float) -> Array:
            with change.moved(self.problem, column, step) as problem:
                derivatives = self.make(problem).derivatives(exact=False)
                slope, values, rows = self._first_derivatives(derivatives)
                cost = np.asarray(derivatives["grad_f"](self.z, [])[0]).ravel()
            gradient = slope + np.asarray(ca.mtimes(rows.T, ca.DM(multipliers))).ravel()
            return np.concatenate([cost, gradient, values])

        steps = DIFFERENCE * np.maximum(1.0, np.abs(change.values))
        differences = np.array([(at(i, step) - at(i, -step)) / (2 * step) for i, step in enumerate(steps.tolist())]).T
        return differences[0], differences[1:]


def _near(values: Array, bound: Array) -> Mask:
    """Return a mask of `values` at most NEAR_BOUND above `bound`, False if it is infinite."""
    with np.errstate(invalid="ignore"):
        gap = values - bound
        finite = np.isfinite(gap)
        size = np.maximum(1.0, np.where(finite, np.minimum(np.abs(values), np.abs(bound)), 1.0))
        return np.asarray(finite & (gap <= NEAR_BOUND * size))


def _apart(values: Array, lower: Array, upper: Array) -> Array:
    """Return the distance (n,) of values from the nearer bound, relative to the bound's size, inf if there is none."""
    with np.errstate(invalid="ignore"):
        sides = [np.abs(values - bound) / np.maximum(1.0, np.abs(bound)) for bound in (lower, upper)]
    return np.asarray(np.minimum(*[np.where(np.isfinite(side), side, np.inf) for side in sides]))


def _crosses(distance: Array, derivative: Array, units: Array) -> Mask:
    """Return a mask (n,) of distances with derivatives (n, p) that reach 0 within NEAREST of a column's unit."""
    noise = ROUNDED * np.max(np.abs(derivative), axis=0, initial=0.0)
    goes = np.where(np.abs(derivative) > noise, np.abs(derivative), 0.0) * units * NEAREST
    return np.asarray(np.any((goes > 0) & (goes >= (distance - LEFT)[:, None]), axis=1))


def _kkt(hessian: Any, rows: Any, first: Array, second: Array) -> Array:
    """Solve the sparse system [H A'; A 0] z = [first; second], whose rows may be redundant."""
    m = rows.shape[0]
    exact = ca.blockcat([[hessian, rows.T], [rows, ca.DM(m, m)]])
    matrix = ca.blockcat([[hessian, rows.T], [rows, -SINGULAR * ca.DM.eye(m)]])
    solver, right = ca.Linsol("kkt", "qr", matrix.sparsity()), ca.DM(np.vstack([first, second]))
    try:
        solution = solver.solve(matrix, right)
        for _ in range(REFINEMENTS):
            solution += solver.solve(matrix, right - ca.mtimes(exact, solution))
    except RuntimeError as error:  # CasADi's error for a singular matrix
        raise GradientError(FLAT) from error
    if not np.all(np.isfinite(np.asarray(solution))):
        raise GradientError(FLAT)
    return np.asarray(solution)

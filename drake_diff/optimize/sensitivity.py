"""How an optimal plan changes with its problem: the derivative of states, inputs, horizon and cost of a solution.

At a solution z with the multipliers y of what holds it, the stationarity of the Lagrangian and the rows that are active
stay true as the problem changes by p. With the active set kept, their derivative is a linear system in dz and dy:

    [ H  A' ] [ dz ]      [ d^2 L / dz dp ]
    [ A  0  ] [ dy ]  = - [ dg / dp       ]

(the implicit function theorem; Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming",
1983, ch. 3). It holds on both sides of p where no active row has a multiplier of 0; else the plan has a corner there.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, Indices, frozen
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.model.parameters import Parameters, applied, select
from drake_diff.optimize.problem.dynamics import plant_dynamics
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits
from drake_diff.optimize.solution import Solution
from drake_diff.optimize.transcription.collocation import FOUND, Collocated, Transcribed, Transcription
from drake_diff.optimize.transcription.expressions import knot_functions
from drake_diff.optimize.transcription.program import TranscribedProgram
from drake_diff.optimize.transcription.task import SCHEMES

ENDS = ("x0", "goal")
NEAR_BOUND = 1e-4  # of max(1, |bound|): a value this near may lie on it: an interior point method leaves sqrt(mu)
WEAK = 1e-4  # of the cost's largest slope: a smaller multiplier may hold nothing
SINGULAR, REFINEMENTS = 1e-10, 4  # on the diagonal, of rows that say the same, and how often its error is taken out
DIFFERENCE = 1e-5  # of max(1, |p|): of derivatives by a parameter of the model, which are exact by the state
RESOLVED = (1e-4, 1e-5)  # of max(1, |p|): how far away the problem is solved again
LEAST = 1e-3  # of a quantity's size per that of p: a column whose entries are less counts as that large
SAME = 1e-4  # of the largest entry of a column: what a derivative and differences of re-solves may differ by
EXACT = Limits(500, np.inf, 1e-10)  # of re-solves
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity(ShowsItsRepr):
    """What `sensitivity` finds. Units are those of the state, input, time or cost, per that of the column.

    Attributes:
        solution: The plan whose derivative it is.
        columns: Names of what the problem changes by.
        xs: (N+1, nx, p) of the states at the knots.
        us: (N, nu, p) of the inputs at the knots but the last.
        u_final: (nu, p) of the last.
        horizon: (p,) [s] of a free horizon; 0 of one that is given.
        cost: (p,) of the cost.
        active: How many bounds and inequalities hold the plan.
        weak: Those that hold it without force: the plan has a corner there, and this is the derivative of one side.
        differences: (p,) the largest distance from differences of re-solves, as a part of the column; None if not
            asked for, NaN where a re-solve failed.
        verdict: "agree", "disagree", "discontinuous" where something is weak, or "not certified".
    """

    solution: Solution
    columns: tuple[str, ...]
    xs: Array
    us: Array
    u_final: Array
    horizon: Array
    cost: Array
    active: int
    weak: tuple[str, ...]
    differences: Array | None = None

    @property
    def verdict(self) -> str:
        """Whether it is the derivative of what `solve` finds."""
        if self.weak:
            return "discontinuous"
        if self.differences is None:
            return "not certified"
        return "agree" if np.all(self.differences <= SAME) else "disagree"

    def __repr__(self) -> str:
        told = f"by {', '.join(self.columns)}"
        lines = [f"Sensitivity of {self.solution.problem.name} {told}: {self.verdict}"]
        if self.differences is not None:
            worst = float(np.max(np.nan_to_num(self.differences, nan=np.inf)))
            lines.append(f"{worst:.2g} of a column from differences of re-solves, {SAME:g} allowed")
        lines += [f"held without force: {', '.join(self.weak)}"] * bool(self.weak)
        lines.append(f"d cost = {np.array2string(self.cost, precision=4, threshold=10)}")
        return "\n  ".join(lines)


def sensitivity(solution: Solution, by: Any = "x0", *, certified: bool = True) -> Sensitivity:
    """The derivative of a solution by its first state, its goal, or parameters of its model.

    Args:
        solution: A plan by collocation that is a success.
        by: "x0" or "goal" (of their entries that are given), or names of the model's parameters.
        certified: Whether the problem is solved again on both sides of each column, and the differences are compared.

    Returns:
        A `Sensitivity`. Where a bound holds the plan without force its `verdict` is "discontinuous": a plan that is
        pushed to one side changes otherwise than one that is pushed to the other.

    Raises:
        InputError: The solution is no success or not by collocation, or nothing is asked for.
        UnknownNameError: There is no such parameter.
        ModelError: Its equations have no second derivatives here.

    Source:
        Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming", 1983, ch. 3.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> effort = dd.QuadraticCost(R=[[1.0]])
        >>> problem = dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=10, horizon=1.0, running_cost=effort)
        >>> found = dd.sensitivity(dd.solve(problem), "goal")
        >>> found.verdict, found.columns, found.cost.round(3)  # the cost is 12 x^2 - 12 x v + 4 v^2
        ('agree', ('x0', 'x1'), array([ 24., -12.]))
    """
    if not isinstance(solution, Solution):
        raise InputError("solution", got=type(solution).__name__, expected="a Solution")
    if not solution.success:
        raise InputError("solution", got=solution.status.value, expected="one that is a success: its message says why")
    motion = solution.transcribed
    if motion is None or solution.scheme == "drake":
        how = solution.method if motion is None else 'scheme="drake"'
        raise InputError("solution", got=how, expected="one by collocation: hermite_simpson or trapezoid")
    change = _change(solution, by)
    sharper = _resolved(solution.problem, motion)  # of what `solve` found within its tolerance
    motion = sharper if sharper.result.outcome in FOUND else motion
    system = _System(solution.problem, motion)
    dz, weak, active = system.solve(change)
    found = _assembled(solution, system, change, dz, weak, active)
    return (
        replace(found, differences=frozen(_differences(solution.problem, motion, change, found)))
        if certified
        else found
    )


@dataclass(frozen=True, eq=False)
class _Change:
    """What the problem changes by: entries of the first or last node, or parameters of the model."""

    columns: tuple[str, ...]
    values: Array  # (p,)
    ends: Indices | None  # the entries of the state
    end: str = ""
    parameters: Parameters = ()

    @contextmanager
    def moved(self, problem: Problem, column: int, step: float) -> Iterator[Problem]:
        """The problem with one column moved by `step`."""
        if self.ends is None:
            values = np.array(self.values)
            values[column] += step
            with applied(select(problem.model, self.parameters).at(values)) as model:
                yield replace(problem, system=model)
            return
        first = self.end == "x0"
        state = np.array(problem.x0 if first else problem.x_goal)
        state[self.ends[column]] += step
        yield replace(problem, x0=state) if first else replace(problem, x_goal=state)


def _change(solution: Solution, by: Any) -> _Change:
    problem = solution.problem
    if isinstance(by, str) and by in ENDS:
        state = problem.start if by == "x0" else problem.goal
        ends = np.flatnonzero(~np.isnan(state))
        if not len(ends):
            raise InputError("by", got=repr(by), expected="an end that is given: all of its entries are free")
        return _Change(tuple(problem.state_names[i] for i in ends), state[ends], ends, by)
    if not problem.has_model:
        raise UnknownNameError("by", got=by, known=ENDS)
    vector = select(problem.model, by)
    if not vector.parameters:
        raise InputError("by", got=repr(by), expected='"x0", "goal", or names of parameters')
    return _Change(vector.names, np.array(vector.values), None, parameters=by)


class _System:
    """The Lagrangian's second derivatives and the rows that hold a solution, in the variables that nothing holds."""

    def __init__(self, problem: Problem, motion: Collocated):
        self.problem, self.motion, self.task = problem, motion, motion.task
        functions = knot_functions(self.task)
        if functions.why_not:
            raise ModelError(f"{self.problem.name}: no second derivatives: {functions.why_not}")
        self.program = program = TranscribedProgram(self.task, motion.mesh, functions)
        self.z = program.pack(np.asarray(motion.nodes), motion.horizon)
        self.derivatives = program.derivatives(exact=True)
        self.slope = np.asarray(self.derivatives["grad_f"](self.z, [])[1]).ravel()
        self.values, self.rows = self.derivatives["jac_g"](self.z, [])
        self.values = np.asarray(self.values).ravel()

    @cached_property
    def fixed(self) -> Mask:
        """(n,) the variables that are given."""
        return self.program.lower >= self.program.upper

    def solve(self, change: _Change) -> tuple[Array, tuple[str, ...], int]:
        """(n, p) the derivative of the variables, what holds the plan without force, and how many rows hold it."""
        on_bound, on_row, multipliers, weak = self._active()
        held = self.fixed | on_bound
        free = np.flatnonzero(~held)
        dz = np.zeros((len(self.z), len(change.values)))
        right = np.zeros((len(self.z) + len(self.values), len(change.values)))
        if change.ends is not None:
            node = 0 if change.end == "x0" else self.program.every[-1]
            dz[node * self.program.width + change.ends, np.arange(len(change.ends))] = 1.0
        else:
            right = self._by_parameters(change, multipliers)
        hessian = self._hessian(multipliers)
        rows = self.rows[np.flatnonzero(on_row).tolist(), :]
        first = -(np.asarray(ca.mtimes(hessian, ca.DM(dz))) + right[: len(self.z)])[free]
        second = -(np.asarray(ca.mtimes(rows, ca.DM(dz))) + right[len(self.z) :][on_row])
        kept = free.tolist()
        found = _kkt(hessian[kept, kept], rows[:, kept], first, second)
        dz[free] = found[: len(free)]
        return dz, weak, int(np.sum(on_bound) + np.sum(on_row & (self.program.sides[0] < self.program.sides[1])))

    def _hessian(self, multipliers: Array) -> Any:
        upper = self.derivatives["hess_lag"](self.z, [], 1.0, multipliers)
        return ca.triu2symm(upper)

    def _active(self) -> tuple[Mask, Mask, Array, tuple[str, ...]]:
        """The bounds and rows that hold the plan, the multipliers of all rows, and what holds without force."""
        program, (least, most) = self.program, self.program.sides
        low, high = _near(self.z, program.lower), _near(program.upper, self.z)
        row_low, row_high = _near(self.values, least), _near(most, self.values)
        equal = least >= most
        scale = max(float(np.max(np.abs(self.slope))), 1e-300)
        on_bound, holds = (low | high) & ~self.fixed, row_low | row_high | equal
        while True:  # one after the other, as of bounds and rows that say the same only one pushes
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
        weak_bound = on_bound & (np.abs(by_bound) <= WEAK * scale)
        weak_row = on_row & ~equal & (np.abs(multipliers) <= WEAK * scale)
        return (
            on_bound,
            on_row,
            multipliers,
            (*self._names(weak_bound), *[f"row {i}" for i in np.flatnonzero(weak_row)]),
        )

    def _moves(self, on_bound: Mask) -> Mask:
        """(m,) the rows in which a variable has a part that nothing holds; the others follow from bounds."""
        of_row = np.asarray(ca.sum2(ca.fabs(self.rows[:, np.flatnonzero(~(self.fixed | on_bound)).tolist()]))).ravel()
        return of_row > 0

    def _names(self, which: Mask) -> list[str]:
        names, width = (*self.problem.state_names, *self.problem.input_names), self.program.width
        nodes = len(self.program.every) * width
        return [f"{names[i % width]} at node {i // width}" if i < nodes else "horizon" for i in np.flatnonzero(which)]

    def _multipliers(self, on_bound: Mask, on_row: Mask) -> tuple[Array, Array]:
        """(m,) those of the rows that leave the least of the Lagrangian's gradient, and what they leave (n,)."""
        free, rows = np.flatnonzero(~(self.fixed | on_bound)), np.flatnonzero(on_row)
        jacobian = self.rows[rows.tolist(), free.tolist()]
        found = _kkt(ca.DM.eye(len(free)), jacobian, -self.slope[free][:, None], np.zeros((len(rows), 1)))
        multipliers = np.zeros(len(self.values))
        multipliers[rows] = found[len(free) :, 0]
        left = self.slope + np.asarray(ca.mtimes(self.rows.T, ca.DM(multipliers))).ravel()
        return multipliers, left

    def _by_parameters(self, change: _Change, multipliers: Array) -> Array:
        """(n + m, p) of the Lagrangian's gradient and of the rows: by differences of the dynamics' exact Jacobians."""
        program, horizon = self.program, self.motion.horizon
        nu = np.asarray(ca.mtimes(program._D.T, ca.DM(multipliers[: program.num_links])))
        nu = nu.reshape(len(program.every), program.nx)
        columns = []
        for i, value in enumerate(change.values):
            step = DIFFERENCE * max(1.0, abs(value))
            (f_low, j_low), (f_high, j_high) = (self._dynamics(change, i, side * step) for side in (-1, 1))
            by_f, by_j = (f_high - f_low) / (2 * step), (j_high - j_low) / (2 * step)
            of_nodes = -horizon * np.einsum("ki,kij->kj", nu, by_j).ravel()
            of_time = [-float(np.sum(nu * by_f))] * program.free
            links = -horizon * np.asarray(ca.mtimes(program._D, ca.DM(by_f.ravel()))).ravel()
            of_rows = np.zeros(len(self.values))
            of_rows[: program.num_links] = links
            columns.append(np.concatenate([of_nodes, of_time, of_rows]))
        return np.array(columns).T

    def _dynamics(self, change: _Change, column: int, step: float) -> tuple[Array, Array]:
        """(K, nx) and (K, nx, nx + nu) the rates and their Jacobians at the nodes with one parameter moved."""
        with change.moved(self.problem, column, step) as problem:
            return plant_dynamics(problem.model).linearize(np.asarray(self.motion.nodes))


def _near(values: Array, bound: Array) -> Mask:
    """Where `values` are not above `bound` by more than NEAR_BOUND; False where it is infinite."""
    with np.errstate(invalid="ignore"):
        gap = values - bound
        finite = np.isfinite(gap)
        size = np.maximum(1.0, np.where(finite, np.minimum(np.abs(values), np.abs(bound)), 1.0))
        return np.asarray(finite & (gap <= NEAR_BOUND * size))


def _kkt(hessian: Any, rows: Any, first: Array, second: Array) -> Array:
    """The solution of [H A'; A 0] z = [first; second], sparse, where rows may say the same."""
    m = rows.shape[0]
    exact = ca.blockcat([[hessian, rows.T], [rows, ca.DM(m, m)]])
    matrix = ca.blockcat([[hessian, rows.T], [rows, -SINGULAR * ca.DM.eye(m)]])
    solver, right = ca.Linsol("kkt", "qr", matrix.sparsity()), ca.DM(np.vstack([first, second]))
    found = solver.solve(matrix, right)
    for _ in range(REFINEMENTS):
        found += solver.solve(matrix, right - ca.mtimes(exact, found))
    return np.asarray(found)


def _assembled(
    solution: Solution, system: _System, change: _Change, dz: Array, weak: tuple[str, ...], active: int
) -> Sensitivity:
    program, nx = system.program, solution.problem.nx
    nodes = dz[: len(program.every) * program.width].reshape(len(program.every), program.width, -1)
    knots = nodes[:: system.task.scheme.nodes]
    return Sensitivity(
        solution=solution,
        columns=change.columns,
        xs=frozen(knots[:, :nx]),
        us=frozen(knots[:-1, nx:]),
        u_final=frozen(knots[-1, nx:]),
        horizon=frozen(dz[-1] if program.free else np.zeros(dz.shape[1])),
        cost=frozen(system.slope @ dz),
        active=active,
        weak=weak,
    )


def _differences(problem: Problem, motion: Collocated, change: _Change, found: Sensitivity) -> Array:
    """(p,) how far the derivative is from central differences of re-solves, extrapolated, as a part of each column."""
    apart = []
    for i, value in enumerate(change.values):
        unit, ours = max(1.0, abs(value)), (found.xs[..., i], found.us[..., i], found.cost[i : i + 1])
        least = [LEAST * _size(each) / unit for each in (motion.xs, motion.us, np.array(motion.cost))]
        off = np.inf
        for part in RESOLVED:  # nearer, where another bound begins to hold on the way
            coarse, fine = (_quotients(problem, motion, change, i, part * unit / n) for n in (1, 2))
            wanted = [b + (b - a) / 3 for a, b in zip(coarse, fine, strict=True)]  # Richardson
            pairs = zip(ours, wanted, least, strict=True)
            off = max(_size(a - b) / max(_size(a), _size(b), smallest, 1e-300) for a, b, smallest in pairs)
            if off <= SAME:
                break
        apart.append(off)
    return np.array(apart)


def _size(values: Array) -> float:
    """The largest magnitude; NaN where an entry is none."""
    return float(np.max(np.abs(values), initial=0.0))


def _quotients(problem: Problem, motion: Collocated, change: _Change, column: int, step: float) -> list[Array]:
    """Those of the states (N+1, nx), inputs (N, nu) and cost (1,); NaN where the problem was not solved again."""
    found = []
    for side in (-1, 1):
        with change.moved(problem, column, side * step) as moved:
            again = _resolved(moved, motion)
            part = 1.0 if again.result.outcome in FOUND else np.nan
            found.append((part * again.xs, part * again.us[:-1], np.array([part * again.cost])))
    return [(high - low) / (2 * step) for low, high in zip(*found, strict=True)]


def _resolved(problem: Problem, motion: Collocated) -> Transcribed:
    """What the same search finds for a problem, from a solution and on its mesh."""
    scheme = next(name for name, scheme in SCHEMES.items() if scheme is motion.task.scheme)
    nodes = np.array(motion.nodes)
    return Transcription(problem, scheme).solve_on(motion.mesh, nodes, motion.horizon, EXACT, None)

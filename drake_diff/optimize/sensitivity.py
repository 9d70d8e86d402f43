"""How an optimal plan changes with its problem: the derivative of states, inputs, horizon and cost of a solution.

It is that of the Karush-Kuhn-Tucker conditions (`transcription.kkt`), by the implicit function theorem, and holds on
both sides where no active row has a multiplier of 0; else the plan has a corner there.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.parameters import select
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits
from drake_diff.optimize.solution import Solution
from drake_diff.optimize.transcription.collocation import FOUND, Collocated, Transcribed, Transcription
from drake_diff.optimize.transcription.kkt import Change, HeldPlan
from drake_diff.optimize.transcription.task import SCHEMES

ENDS = ("x0", "goal")
RESOLVED = (1e-3, 1e-4, 1e-5)  # of max(1, |p|): how far away the problem is solved again
LEAST = 1e-3  # of a quantity's size per that of p: a column whose entries are less counts as that large
SAME = 1e-4  # of the largest entry of a column: what a derivative and differences of re-solves may differ by
EXACT = Limits(500, np.inf, 1e-12)  # of re-solves


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
        GradientError: Some change of the plan costs nothing, so that it is not the only optimum.

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
    system = HeldPlan(solution.problem, motion)
    dz, weak, active = system.solve(change)
    found = _assembled(solution, system, change, dz, weak, active)
    return (
        replace(found, differences=frozen(_differences(solution.problem, motion, change, found)))
        if certified
        else found
    )


def _change(solution: Solution, by: Any) -> Change:
    problem = solution.problem
    if isinstance(by, str) and by in ENDS:
        state = problem.start if by == "x0" else problem.goal
        ends = np.flatnonzero(~np.isnan(state))
        if not len(ends):
            raise InputError("by", got=repr(by), expected="an end that is given: all of its entries are free")
        return Change(tuple(problem.state_names[i] for i in ends), state[ends], ends, by)
    if not problem.has_model:
        raise UnknownNameError("by", got=by, known=ENDS)
    vector = select(problem.model, by)
    if not vector.parameters:
        raise InputError("by", got=repr(by), expected='"x0", "goal", or names of parameters')
    if problem.parameters.parameters:
        expected = '"x0" or "goal", as the problem has parameters of its own'
        raise InputError("by", got=repr(by), expected=expected)
    return Change(vector.names, np.array(vector.values), None, parameters=by)


def _assembled(
    solution: Solution, system: HeldPlan, change: Change, dz: Array, weak: tuple[str, ...], active: int
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


def _differences(problem: Problem, motion: Collocated, change: Change, found: Sensitivity) -> Array:
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


def _quotients(problem: Problem, motion: Collocated, change: Change, column: int, step: float) -> list[Array]:
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
    values = motion.task.parameters if problem.optimizes_parameters else None
    return Transcription(problem, scheme).solve_on(motion.mesh, nodes, motion.horizon, EXACT, None, values)

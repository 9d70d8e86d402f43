"""How an optimal plan changes with its problem: the derivative of states, inputs, horizon and cost of a solution.

It is that of the Karush-Kuhn-Tucker conditions (`transcription.kkt`), by the implicit function theorem, and holds on
both sides where no active row has a multiplier of 0 and no contact is about to change; else the plan has a corner.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import GradientError, InputError, ModelError, UnknownNameError
from drake_diff.model.parameters import select
from drake_diff.motion.rollout import STEPS
from drake_diff.optimize.problem.obstacles import swept
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.problem.terminal import TerminalSet
from drake_diff.optimize.program import Limits, Multipliers
from drake_diff.optimize.solution import Solution
from drake_diff.optimize.transcription.collocation import FOUND
from drake_diff.optimize.transcription.expressions import knot_functions
from drake_diff.optimize.transcription.kkt import NEAREST, WEAK, Change, Held, HeldPlan, KnotProgram
from drake_diff.optimize.transcription.nodes import Phase, TranscribedProgram
from drake_diff.optimize.transcription.program import solve_ipopt
from drake_diff.optimize.transcription.steps import WITHIN, StepProgram
from drake_diff.optimize.transcription.task import OptimalControl

ENDS = ("x0", "goal")
RESOLVED = (1e-3, 1e-4, NEAREST)  # of max(1, |p|): how far away the problem is solved again
LEAST = 1e-3  # of a quantity's size per that of p: a column whose entries are less counts as that large
SAME = 1e-4  # of the largest entry of a column: what a derivative and differences of re-solves may differ by
EXACT_TOLERANCE = 1e-12  # of re-solves, which begin at an optimum beside theirs
EXACT = Limits(100, np.inf, EXACT_TOLERANCE)
CLOSE = {"ipopt.compl_inf_tol": 1e-14, "ipopt.mu_min": 1e-16}  # a barrier is stiff near a bound that holds nothing
NEAR = 1e-2  # of max(1, |z|): what a variable may move by as the plan is solved to rounding, or it is another plan
TWO_SIDED = 10  # times SAME: what the two one-sided slopes differ by at a corner


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
        weak: What makes a corner of the plan, of which this is the derivative of one side: bounds that begin or cease
            to hold it, and columns whose two sides differ, as where a contact begins.
        differences: (p,) the largest distance from differences of re-solves, as a part of the column; None if not
            asked for, NaN where a re-solve failed.
        derivatives: Where the second derivatives came from.
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
    derivatives: str = "symbolic"
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
        columns = f"by {', '.join(self.columns)}"
        lines = [f"Sensitivity of {self.solution.problem.name} {columns}: {self.verdict}"]
        if self.differences is not None:
            worst = float(np.max(np.nan_to_num(self.differences, nan=np.inf)))
            lines.append(f"{worst:.2g} of a column from differences of re-solves, {SAME:g} allowed")
        lines += [f"a corner: {', '.join(self.weak)}"] * bool(self.weak)
        lines.append(f"d cost = {np.array2string(self.cost, precision=4, threshold=10)}")
        return "\n  ".join(lines)


def sensitivity(solution: Solution, by: Any = "x0", *, certified: bool = True) -> Sensitivity:
    """The derivative of a solution by its first state, its goal, or parameters of its model.

    Plans of every method have one. That of a plan by iLQR or shooting is of Drake's own steps, contact included.

    Args:
        solution: A plan that is a success.
        by: "x0" or "goal" (of their entries that are given), or names of the model's parameters.
        certified: Whether the problem is solved again on both sides of each column, and the differences are compared.

    Returns:
        A `Sensitivity`. Where a bound holds the plan without force, or differences of re-solves tell that a contact is
        about to change, its `verdict` is "discontinuous": a plan that is pushed to one side changes otherwise than one
        that is pushed to the other.

    Raises:
        InputError: The solution is no success, its cost is one of the whole trajectory, or nothing is asked for.
        UnknownNameError: There is no such parameter.
        ModelError: Its equations have no second derivatives here.
        GradientError: Some change of the plan costs nothing, so that it is not the only optimum, or the plan is no
            stationary point of its problem.

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
    if type(solution) is not Solution:
        raise InputError("solution", got=type(solution).__name__, expected="a Solution")
    if not solution.success:
        raise InputError(
            "solution", got=solution.status.value, expected="a successful solution; its message says why it is not"
        )
    if solution.scheme == "drake":
        raise InputError(
            "solution", got='scheme="drake"', expected="one by hermite_simpson, trapezoid, iLQR or shooting"
        )
    change = _change(solution, by)
    plan = _plan(solution)
    plan_held = _held(plan)
    program, response = plan_held.program, plan_held.solve(change)
    dz, knots = response.dz, len(program.states_at) - 1
    sensitive = Sensitivity(
        solution=solution,
        columns=change.columns,
        xs=frozen(dz[program.states_at]),
        us=frozen(dz[program.inputs_at[:knots]]),
        u_final=frozen(dz[program.inputs_at[-1]]),
        horizon=frozen(
            np.zeros(dz.shape[1]) if program.horizon_at is None else program.horizon_unit * dz[program.horizon_at]
        ),
        cost=frozen(response.cost),
        active=response.active,
        weak=tuple(response.weak),
        derivatives=plan.derivatives(program),
    )
    if not certified:
        return sensitive
    apart, corners = _differences(plan, plan_held, change, response)
    return replace(sensitive, differences=frozen(apart), weak=(*sensitive.weak, *corners))


@dataclass(frozen=True, eq=False)
class _Plan:
    """The variables z (n,) of a solution, the program they are of, and whether that is one of discrete steps."""

    problem: Problem
    make: Callable[[Problem], KnotProgram]
    z: Array
    discrete: bool

    def derivatives(self, program: KnotProgram) -> str:
        """Where the second derivatives came from."""
        if not isinstance(program, StepProgram):
            return "symbolic"
        return f"the steps' Jacobians by {' and '.join(sorted(program.steps.methods))}"


def _plan(solution: Solution) -> _Plan:
    motion, problem = solution.transcribed, solution.problem
    if problem.motion != STEPS:
        raise ModelError('a plan with motion="continuous" has no second derivatives here: motion="steps" has them')
    if motion is not None:
        scheme, mesh = solution.scheme, motion.mesh

        def collocated(problem: Problem) -> TranscribedProgram:
            task = OptimalControl(problem, scheme)
            return TranscribedProgram([Phase(task, mesh, knot_functions(task))])

        program = collocated(problem)
        if why := program.why_not or program.linearized:
            raise ModelError(f"{problem.name}: no second derivatives: {why}")
        z = program.phases[0].pack(np.asarray(motion.nodes), motion.horizon, motion.task.parameters)
        return _Plan(problem, collocated, z, False)
    if problem.trajectory_cost is not None:
        raise InputError(
            "trajectory_cost", got="given", expected="no trajectory_cost, as it joins the states of all steps"
        )
    rounds = solution.options.get("clearance_rounds", ())
    if rounds:  # what it was searched with besides
        more = swept(problem.kept, solution.time_step, int(rounds[-1][0]))
        problem = replace(problem, constraints=(*problem.constraints, *more))
    values = problem.design.whole(solution.vector.values, solution.time_step)
    z = StepProgram(problem).pack(np.asarray(solution.xs), np.asarray(solution.us), values)
    return _Plan(problem, StepProgram, z, True)


def _held(plan: _Plan) -> HeldPlan:
    """The plan, solved to rounding from where `solve` stopped; GradientError if it is no optimum."""
    held = HeldPlan(plan.problem, plan.make, plan.z)
    sharper, solved = _resolved(held.program, plan.z, held.multipliers)
    if solved and np.all(np.abs(sharper - plan.z) <= NEAR * np.maximum(1.0, np.abs(plan.z))):
        return HeldPlan(plan.problem, plan.make, sharper)
    if held.left > WEAK:
        raise GradientError(
            f"the plan has no derivative: it is not a stationary point of its problem, as {held.left:.2g} of the "
            "cost's slope remains; it ends at a kink, as where a contact begins, or short of its optimum"
        )
    return held


def _change(solution: Solution, by: Any) -> Change:
    problem = solution.problem
    if isinstance(by, str) and by in ENDS:
        state = problem.start if by == "x0" else np.where(problem.is_orientation, np.nan, problem.goal)
        ends = np.flatnonzero(~np.isnan(state))
        if not len(ends):
            raise InputError("by", got=repr(by), expected="a state with given entries, as all of these are free")
        return Change(tuple(problem.state_names[i] for i in ends), state[ends], ends, by)
    if not problem.has_model:
        raise UnknownNameError("by", got=by, known=ENDS)
    vector = select(problem.model, by)
    if not vector.parameters:
        raise InputError("by", got=repr(by), expected='"x0", "goal", or names of parameters')
    if problem.parameters.parameters and solution.transcribed is not None:
        expected = '"x0" or "goal", as the problem has parameters of its own'
        raise InputError("by", got=repr(by), expected=expected)
    if any(isinstance(goal, TerminalSet) for goal in problem.goals):
        raise InputError("by", got=repr(by), expected='"x0", as a TerminalSet does not depend on the other parameters')
    if problem.horizon is not None and solution.transcribed is None:
        raise InputError("by", got=repr(by), expected='"x0" or "goal", as a horizon sets the length of the steps')
    chosen = {p.name for p in problem.parameters.parameters} & {p.name for p in vector.parameters}
    if chosen and problem.optimizes_parameters:
        raise InputError("by", got=sorted(chosen), expected="parameters that the plan does not choose itself")
    return Change(vector.names, np.array(vector.values), None, parameters=by)


def _differences(plan: _Plan, held: HeldPlan, change: Change, response: Held) -> tuple[Array, list[str]]:
    """(p,) how far the derivative is from central differences of re-solves, extrapolated, as a part of each column.

    And the columns whose two sides differ, where it is far.
    """
    base, apart, corners = _read(held.program, held.z), [], []
    derivative = [response.dz[held.program.states_at], response.dz[held.program.inputs_at], response.cost[None]]
    for i, value in enumerate(change.values):
        unit, ours = max(1.0, abs(value)), [array[..., i] for array in derivative]
        least = [LEAST * _size(array) / unit for array in base]
        off, sides = np.inf, 0.0
        for fraction in RESOLVED:  # nearer, where another bound begins to hold on the way
            slopes = [
                _one_sided(plan, held, change, i, side * fraction * unit / n, base) for n in (1, 2) for side in (-1, 1)
            ]
            low, high, near_low, near_high = slopes
            coarse, fine = _means(low, high), _means(near_low, near_high)
            wanted = [b + (b - a) / 3 for a, b in zip(coarse, fine, strict=True)]  # Richardson
            off = _distance(ours, wanted, least)
            if off <= SAME:
                break
            # at a corner these go to two limits; elsewhere to one, with the step
            left, right = (
                [2 * b - a for a, b in zip(*pair, strict=True)] for pair in ((low, near_low), (high, near_high))
            )
            sides = _distance(left, right, least)
        apart.append(off)
        if off > SAME and sides > TWO_SIDED * SAME:
            corners.append(f"the one-sided derivatives by {change.columns[i]} differ by {sides:.2g} of their size")
    return np.array(apart), corners


def _means(low: list[Array], high: list[Array]) -> list[Array]:
    return [(a + b) / 2 for a, b in zip(low, high, strict=True)]


def _distance(arrays: list[Array], other: list[Array], least: list[float]) -> float:
    """The largest of their entries' differences, as a part of the largest entry; NaN where one is no number."""
    pairs = zip(arrays, other, least, strict=True)
    return float(np.max([_size(a - b) / max(_size(a), _size(b), smallest, 1e-300) for a, b, smallest in pairs]))


def _size(values: Array) -> float:
    """The largest magnitude; NaN where an entry is none."""
    return float(np.max(np.abs(values), initial=0.0))


def _read(program: KnotProgram, z: Array) -> list[Array]:
    """The states (N+1, nx), the inputs (M, nu) and the cost (1,) of the variables."""
    cost = np.asarray(program.derivatives(exact=False)["grad_f"](z, [])[0]).ravel()
    return [z[program.states_at], z[program.inputs_at], cost]


def _one_sided(plan: _Plan, held: HeldPlan, change: Change, column: int, step: float, base: list[Array]) -> list[Array]:
    """The quotients of what `_read` gives, from the problem moved by `step`; NaN where that was not solved again."""
    with change.moved(plan.problem, column, step) as moved:
        program = plan.make(moved)
        z, solved = _resolved(program, held.z, held.multipliers)
        arrays = _read(program, z)
    return [(a - b) / step if solved else np.full_like(a, np.nan) for a, b in zip(arrays, base, strict=True)]


def _resolved(program: KnotProgram, z: Array, multipliers: Multipliers) -> tuple[Array, bool]:
    """What IPOPT finds from a plan, and whether that is a solution."""
    more = CLOSE | (WITHIN if isinstance(program, StepProgram) else {})
    exact = not program.why_not
    result = solve_ipopt(program, z, EXACT, None, exact=exact, multipliers=multipliers, more=more)
    return result.z, result.outcome in FOUND

"""The sensitivity of an optimal plan: the derivatives of a solution's states, inputs, horizon and cost.

They follow from the Karush-Kuhn-Tucker conditions (`transcription.kkt`) by the implicit function theorem. They are
two-sided if no active row has a multiplier of 0 and no contact is about to change. Otherwise the plan has a corner.
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
RESOLVED = (1e-3, 1e-4, NEAREST)  # steps of re-solves, as fractions of max(1, |p|)
LEAST = 1e-3  # smallest scale of a column, as a fraction of the quantity's size per size of p
SAME = 1e-4  # largest difference between a derivative and re-solves, as a fraction of a column's largest entry
EXACT_TOLERANCE = 1e-12  # of re-solves, which begin at a nearby optimum
EXACT = Limits(100, np.inf, EXACT_TOLERANCE)
CLOSE = {"ipopt.compl_inf_tol": 1e-14, "ipopt.mu_min": 1e-16}  # a barrier is stiff near a bound without force
NEAR = 1e-2  # largest change of a variable in a re-solve, as a fraction of max(1, |z|); beyond it is another plan
TWO_SIDED = 10  # times SAME: difference of the one-sided slopes at a corner


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity(ShowsItsRepr):
    """The result of `sensitivity`. Units are those of the state, input, time or cost, per unit of the column.

    Attributes:
        solution: The differentiated plan.
        columns: Names of the quantities that the derivatives are taken with respect to.
        xs: (N+1, nx, p) the derivatives of the states at the knots.
        us: (N, nu, p) the derivatives of the inputs at all knots except the last.
        u_final: (nu, p) the derivatives of the last input.
        horizon: (p,) the derivatives of a free horizon [s]; 0 for a given horizon.
        cost: (p,) the derivatives of the cost.
        active: The number of active bounds and inequalities.
        weak: The causes of a corner of the plan, where the derivatives are one-sided: bounds that become active or
            inactive, and columns whose two sides differ, as where a contact begins.
        differences: (p,) the largest distance from differences of re-solves, as a fraction of the column; None if not
            requested, NaN if a re-solve failed.
        derivatives: The source of the second derivatives.
        verdict: "agree", "disagree", "discontinuous" if `weak` is not empty, or "not certified".
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
        """Whether the derivatives agree with re-solves of the problem."""
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
    """Compute the derivative of a solution with respect to its first state, its goal or parameters of its model.

    Plans of all methods are supported. For iLQR and shooting, Drake's own steps are differentiated, including contact.

    Args:
        solution: A successful plan.
        by: "x0" or "goal" (their given entries), or names of the model's parameters.
        certified: Whether the problem is solved again on both sides of each column to compare the differences.

    Returns:
        A `Sensitivity`. Its `verdict` is "discontinuous" if an active bound has no force, or if differences of
        re-solves show that a contact is about to change. The effects of a change to either side then differ.

    Raises:
        InputError: The solution is not successful, its cost depends on the whole trajectory, or `by` is empty.
        UnknownNameError: A parameter does not exist.
        ModelError: The equations have no second derivatives.
        GradientError: A change of the plan costs nothing, so that the optimum is not unique, or the plan is not a
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
            "solution", got=solution.status.value, expected="a successful solution; solution.message states the failure"
        )
    if solution.scheme == "drake":
        raise InputError(
            "solution", got='scheme="drake"', expected="a solution by hermite_simpson, trapezoid, iLQR or shooting"
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
    """The variables z (n,) of a solution, a function that makes their program, and whether it is discrete."""

    problem: Problem
    make: Callable[[Problem], KnotProgram]
    z: Array
    discrete: bool

    def derivatives(self, program: KnotProgram) -> str:
        """Return the source of the second derivatives."""
        if not isinstance(program, StepProgram):
            return "symbolic"
        return f"the steps' Jacobians by {' and '.join(sorted(program.steps.methods))}"


def _plan(solution: Solution) -> _Plan:
    motion, problem = solution.transcribed, solution.problem
    if problem.motion != STEPS:
        raise ModelError('motion="continuous" has no second derivatives for sensitivities: use motion="steps"')
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
    if rounds:  # the search had these additional constraints
        more = swept(problem.kept, solution.time_step, int(rounds[-1][0]))
        problem = replace(problem, constraints=(*problem.constraints, *more))
    values = problem.design.whole(solution.vector.values, solution.time_step)
    z = StepProgram(problem).pack(np.asarray(solution.xs), np.asarray(solution.us), values)
    return _Plan(problem, StepProgram, z, True)


def _held(plan: _Plan) -> HeldPlan:
    """Solve the plan to rounding from the result of `solve`. Raises GradientError if it is not an optimum."""
    held = HeldPlan(plan.problem, plan.make, plan.z)
    sharper, solved = _resolved(held.program, plan.z, held.multipliers)
    if solved and np.all(np.abs(sharper - plan.z) <= NEAR * np.maximum(1.0, np.abs(plan.z))):
        return HeldPlan(plan.problem, plan.make, sharper)
    if held.left > WEAK:
        raise GradientError(
            f"the plan has no derivative: it is not a stationary point of its problem, as {held.left:.2g} of the "
            "cost's gradient remains; the search ended at a kink, as where a contact begins, or before its optimum"
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
    settings = problem.parameters.to_dict()
    vector = select(problem.model, {name: settings.get(name, value) for name, value in vector.to_dict().items()})
    if not vector.parameters:
        raise InputError("by", got=repr(by), expected='"x0", "goal", or names of parameters')
    if any(isinstance(goal, TerminalSet) for goal in problem.goals):
        raise InputError("by", got=repr(by), expected='"x0", as a TerminalSet does not depend on the other parameters')
    if problem.horizon is not None and solution.transcribed is None:
        raise InputError("by", got=repr(by), expected='"x0" or "goal", as a horizon sets the length of the steps')
    chosen = {p.name for p in problem.parameters.parameters} & {p.name for p in vector.parameters}
    if chosen and problem.optimizes_parameters:
        raise InputError("by", got=sorted(chosen), expected="parameters that are not optimized")
    return Change(vector.names, np.array(vector.values), None, parameters=vector)


def _differences(plan: _Plan, held: HeldPlan, change: Change, response: Held) -> tuple[Array, list[str]]:
    """Return (p,) the distance of the derivative from extrapolated central differences of re-solves, per column.

    Also return the columns whose distance is large and whose two sides differ.
    """
    base, apart, corners = _read(held.program, held.z), [], []
    derivative = [response.dz[held.program.states_at], response.dz[held.program.inputs_at], response.cost[None]]
    for i, value in enumerate(change.values):
        unit, ours = max(1.0, abs(value)), [array[..., i] for array in derivative]
        least = [LEAST * _size(array) / unit for array in base]
        off, sides = np.inf, 0.0
        for fraction in RESOLVED:  # smaller steps, in case another bound becomes active on the way
            slopes = [
                _one_sided(plan, held, change, i, side * fraction * unit / n, base) for n in (1, 2) for side in (-1, 1)
            ]
            low, high, near_low, near_high = slopes
            coarse, fine = _means(low, high), _means(near_low, near_high)
            wanted = [b + (b - a) / 3 for a, b in zip(coarse, fine, strict=True)]  # Richardson
            off = _distance(ours, wanted, least)
            if off <= SAME:
                break
            # at a corner these have two limits as the step shrinks, elsewhere a single one
            left, right = (
                [2 * b - a for a, b in zip(*pair, strict=True)] for pair in ((low, near_low), (high, near_high))
            )
            sides = _distance(left, right, least)
        apart.append(off)
        if off > SAME and sides > TWO_SIDED * SAME:
            name = change.columns[i]
            corners.append(f"the one-sided derivatives with respect to {name} differ by {sides:.2g} of their size")
    return np.array(apart), corners


def _means(low: list[Array], high: list[Array]) -> list[Array]:
    return [(a + b) / 2 for a, b in zip(low, high, strict=True)]


def _distance(arrays: list[Array], other: list[Array], least: list[float]) -> float:
    """Return the largest difference of the entries, as a fraction of the largest entry, or NaN if one is NaN."""
    pairs = zip(arrays, other, least, strict=True)
    return float(np.max([_size(a - b) / max(_size(a), _size(b), smallest, 1e-300) for a, b, smallest in pairs]))


def _size(values: Array) -> float:
    """Return the largest magnitude, or NaN if an entry is NaN."""
    return float(np.max(np.abs(values), initial=0.0))


def _read(program: KnotProgram, z: Array) -> list[Array]:
    """Return the states (N+1, nx), the inputs (M, nu) and the cost (1,) of the variables."""
    cost = np.asarray(program.derivatives(exact=False)["grad_f"](z, [])[0]).ravel()
    return [z[program.states_at], z[program.inputs_at], cost]


def _one_sided(plan: _Plan, held: HeldPlan, change: Change, column: int, step: float, base: list[Array]) -> list[Array]:
    """Return one-sided quotients of `_read` for the problem moved by `step`, or NaN if the re-solve failed."""
    with change.moved(plan.problem, column, step) as moved:
        program = plan.make(moved)
        z, solved = _resolved(program, held.z, held.multipliers)
        arrays = _read(program, z)
    return [(a - b) / step if solved else np.full_like(a, np.nan) for a, b in zip(arrays, base, strict=True)]


def _resolved(program: KnotProgram, z: Array, multipliers: Multipliers) -> tuple[Array, bool]:
    """Solve again with IPOPT from a plan, and return the variables and whether they are a solution."""
    more = CLOSE | (WITHIN if isinstance(program, StepProgram) else {})
    exact = not program.why_not
    result = solve_ipopt(program, z, EXACT, None, exact=exact, multipliers=multipliers, more=more)
    return result.z, result.outcome in FOUND

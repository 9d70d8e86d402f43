"""Drake's own DirectCollocation over the model's equations of motion in continuous time, solved by SNOPT."""

import math
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydrake import solvers
from pydrake.autodiffutils import ExtractValue
from pydrake.solvers import MathematicalProgram, SnoptSolver, SolutionResult

from drake_diff._base.arrays import Array, Indices, frozen
from drake_diff._base.autodiff import chain
from drake_diff._base.clock import TimeIsUpError, check_time, noted_interrupts, now, until_set
from drake_diff.exceptions import DrakeDiffError, MissingDependencyError
from drake_diff.model.equations import ContinuousSystem, EquationsOfMotion
from drake_diff.optimize.problem.cost import QuadraticCost, differentiate_cost, differentiate_final_cost
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iterate, Iteration, Limits, NlpResult, Outcome, Report, Watch


def solve_collocation(
    problem: Problem, xs: Array, us: Array, *, limits: Limits, report: Report | None
) -> tuple[NlpResult, Array, Array, Array | None]:
    """Solve `problem` from the guess xs (N+1, nx), us (N, nu). Return (result, xs, us, u_final).

    The N intervals have the length model.time_step, inputs are linear between knots, and the running cost is integrated
    by the trapezoid rule. Raises ModelError if the model has no continuous form.
    """
    from pydrake.planning import DirectCollocation  # slow to import, and used by this method only

    h, count, b = problem.model.time_step, problem.num_steps, problem.bounds
    system = ContinuousSystem(EquationsOfMotion(problem.model))
    drake = DirectCollocation(system, system.CreateDefaultContext(), count + 1, h, h)
    program = drake.prog()
    states = [drake.state(k) for k in range(count + 1)]
    inputs = [drake.input(k) for k in range(count + 1)]
    for variables, lower, upper in zip(states, *problem.state_limits(), strict=True):
        program.AddBoundingBoxConstraint(lower, upper, variables)
    for variables in inputs:
        program.AddBoundingBoxConstraint(b.u_lower, b.u_upper, variables)
    _add_hull(problem, program, states, inputs)
    _add_costs(problem, program, states, inputs)
    guess, steps = np.zeros(program.num_vars()), [drake.time_step(k) for k in range(count)]
    for variables, values in zip([*states, *inputs, *steps], [*xs, *us, us[-1], *[[h]] * count], strict=True):
        program.SetDecisionVariableValueInVector(variables, values, guess)
    places = [np.array([program.FindDecisionVariableIndices(v) for v in variables]) for variables in (states, inputs)]

    def motions(z: Array) -> tuple[Iterate, ...]:
        xs, us = frozen(z[places[0]]), frozen(z[places[1][:-1]])
        return (Iterate(problem, frozen(h * np.arange(count + 1)), xs, us, problem.parameters, by_steps=False),)

    result = _solve_snopt(program, guess, limits, report, motions)
    xs, us = (result.z[indices] for indices in places)
    return result, xs, us[:-1], us[-1]


def _add_hull(problem: Problem, program: MathematicalProgram, states: list[Any], inputs: list[Any]) -> None:
    """Constrain the inner Bernstein coefficients of bounded states, x + h f / 3 and x - h f / 3, by the same bounds."""
    b, count, h = problem.bounds, problem.num_steps, problem.model.time_step
    bounded = np.flatnonzero((np.isfinite(b.x_lower) | np.isfinite(b.x_upper)) & (b.x_lower < b.x_upper))
    equations = EquationsOfMotion(problem.model)
    for k, (x, u) in enumerate(zip(states, inputs, strict=True) if len(bounded) else ()):
        signs = np.array([1.0] * (k < count) + [-1.0] * (k > 0))
        lower, upper = (np.tile(side[bounded], len(signs)) for side in (b.x_lower, b.x_upper))
        program.AddConstraint(_Hull(equations, bounded, h / 3 * signs), lower, upper, vars=np.concatenate([x, u]))


class _Hull:
    """x + step f(x, u) of the states `bounded`, for each of `steps` [s], of floats or AutoDiffXd [x, u]."""

    def __init__(self, equations: EquationsOfMotion, bounded: Indices, steps: Array):
        self.equations, self.bounded, self.steps = equations, bounded, steps

    def __call__(self, z: Any) -> Any:
        nx = self.equations.model.nx
        rates = self.equations.values(z[None])[0] if z.dtype == float else self.equations.autodiff(z[:nx], z[nx:])
        return np.concatenate([z[self.bounded] + step * rates[self.bounded] for step in self.steps])


def _add_costs(problem: Problem, program: MathematicalProgram, states: list[Any], inputs: list[Any]) -> None:
    running, final, nx = problem.total_running_cost, problem.total_final_cost, problem.nx
    h, count = problem.time_step, problem.num_steps

    def differentiate_running(z: Array) -> tuple[float, Array]:
        value, by_x, by_u = differentiate_cost(running, z[:nx], z[nx:])
        return value, np.concatenate([by_x, by_u])

    def add_quadratic_form(weight: float, form: Any, reference: Any, variables: Any) -> None:
        if form is None or not len(variables):
            return
        r = np.zeros(len(variables)) if reference is None else reference
        constant = weight * float(r @ form @ r)
        program.AddQuadraticCost(2 * weight * form, -2 * weight * form @ r, constant, variables, is_convex=True)

    for k, (x, u) in enumerate(zip(states, inputs, strict=True)):
        weight = h / 2 if k in (0, count) else h
        if isinstance(running, QuadraticCost):
            add_quadratic_form(weight, running.Q, running.x_ref, x)
            add_quadratic_form(weight, running.R, running.u_ref, u)
        elif running is not None:
            program.AddCost(_Cost(differentiate_running, weight), vars=np.concatenate([x, u]))
    if isinstance(final, QuadraticCost):
        add_quadratic_form(1.0, final.Q, final.x_ref, states[-1])
    elif final is not None:
        program.AddCost(_Cost(partial(differentiate_final_cost, final), 1.0), vars=states[-1])


class _Cost:
    """weight * cost(z) for a MathematicalProgram, floats or AutoDiffXd, from its value and gradient."""

    def __init__(self, differentiate: Callable[[Array], tuple[float, Array]], weight: float):
        self.differentiate, self.weight = differentiate, weight

    def __call__(self, z: Any) -> Any:
        value, gradient = self.differentiate(z if z.dtype == float else ExtractValue(z).ravel())
        return self.weight * value if z.dtype == float else chain(self.weight * value, self.weight * gradient, z)


class _Stop(Exception):  # noqa: N818  (a signal, not an error)
    """An exception that the callback raises to end a solve."""


def _solve_snopt(
    program: MathematicalProgram,
    guess: Array,
    limits: Limits,
    report: Report | None,
    motions: Callable[[Array], tuple[Iterate, ...]],
) -> NlpResult:
    """Solve `program` from `guess` (n,).

    `report` receives a line of progress a few times a second, with the `motions` of the point. Ctrl-C and the time
    limit end the solve with the best iterate so far.
    """
    engine, options = SnoptSolver(), solvers.SolverOptions()
    if not (engine.available() and engine.enabled()):
        raise MissingDependencyError('this build of Drake has no SNOPT: install Drake\'s wheel, or use solver="ipopt"')
    with tempfile.TemporaryDirectory() as folder, noted_interrupts() as interrupted:
        watch, print_file = Watch(limits, interrupted), Path(folder) / "log"
        options.SetOption(solvers.CommonSolverOption.kPrintFileName, str(print_file))
        tolerance, most = limits.tolerance, limits.max_iterations
        chosen: dict[str, float] = {"Major iterations limit": most, "Iterations limit": 1000 * most}
        chosen |= {"Major feasibility tolerance": tolerance, "Major optimality tolerance": tolerance}
        for option, value in chosen.items():
            options.SetOption(SnoptSolver.id(), option, value)
        callback = _Callback(program, watch, report, motions)
        program.AddVisualizationCallback(callback, program.decision_variables())
        try:
            with until_set(interrupted):
                result = engine.Solve(program, guess, options)
        except (DrakeDiffError, RuntimeError, _Stop, TimeIsUpError) as error:
            outcome, message = _explain_exception(watch, error)
            callback.look_back()
            ended = NlpResult(watch.best_of(guess), outcome, message, ())
        else:
            outcome, message = _explain(result)
            ended = NlpResult(np.asarray(result.GetSolution(program.decision_variables())), outcome, message, ())
        return replace(ended, iterations=_read_table(print_file))


class _Callback:
    """The solver's callback for every evaluation. It reports, stores the best iterate, and raises to stop."""

    def __init__(
        self, program: MathematicalProgram, watch: Watch, report: Report | None, motions: Callable[[Array], Any]
    ):
        self.program, self.watch, self.report, self.motions = program, watch, report, motions
        self.evaluations, self.called = 0, now()
        self.current: Array | None = None
        self.before: Array | None = None  # the previous point at which all functions were evaluated

    def __call__(self, z: Array) -> None:
        self.evaluations += 1
        before, self.called = self.called, now()
        if self.current is None or not np.array_equal(z, self.current):
            self.before, self.current = self.current, np.array(z)
        if self.evaluations == 1:
            self.watch.offer(z, math.inf, 0.0)  # a first best iterate, of unknown cost
        if self.watch.look_up():
            self._look(z)
        if self.watch.stopped_by is not None:
            raise _Stop
        if self.evaluations > 2:  # the next one takes as long as the last, except after the first, which loads modules
            check_time(ahead=self.called - before)

    def look_back(self) -> None:
        """Offer the point before the last one as the best iterate."""
        if self.before is not None:
            try:
                self._look(self.before)
            except (DrakeDiffError, TimeIsUpError):
                return  # it cannot be evaluated either: the best iterate is unchanged

    def _look(self, z: Array) -> None:
        cost = sum(float(self.program.EvalBinding(binding, z)[0]) for binding in self.program.GetAllCosts())
        violations = []
        for binding in self.program.GetAllConstraints():
            constraint, values = binding.evaluator(), self.program.EvalBinding(binding, z)
            beyond = np.maximum(constraint.lower_bound() - values, values - constraint.upper_bound())
            violations.append(float(np.max(beyond, initial=0)))
        violation = max(violations, default=0.0)
        self.watch.offer(z, cost, violation)
        row = Iteration(self.evaluations, cost, violation, math.nan, math.nan)
        if self.report is not None:
            point = np.array(z)
            self.report.row(row, lambda: self.motions(point), printed=False)
            cost_told, violation_told = f"cost {cost:12.6g}", f"violation {violation:9.2e}"
            self.report.say(
                f"evaluation {self.evaluations:5d}  {cost_told}  {violation_told}  {self.watch.elapsed:6.1f} s"
            )


def _explain_exception(watch: Watch, error: Exception) -> tuple[Outcome, str]:
    """Return the outcome and message of an exception. SNOPT wraps exceptions in a RuntimeError with their names."""
    if watch.stopped_by is None and watch.interrupted.is_set():  # during an evaluation
        watch.stopped_by = Outcome.INTERRUPTED
    if watch.stopped_by is not None:
        return watch.stopped_by, f"stopped: {watch.stopped_by.value}"
    text = f"{type(error).__name__}: {error}"
    if TimeIsUpError.__name__ in text:  # during an evaluation
        return Outcome.TIME_LIMIT, f"stopped: {Outcome.TIME_LIMIT.value}"
    for name, outcome in (("SimulationError", Outcome.DIVERGED), ("GradientError", Outcome.NO_GRADIENT)):
        if name in text:
            return outcome, text[text.rindex(name) :].strip()  # SNOPT's text starts with the traceback
    return Outcome.FAILED, text


_RESULTS = {
    SolutionResult.kSolutionFound: Outcome.SOLVED,
    SolutionResult.kIterationLimit: Outcome.ITERATION_LIMIT,
    SolutionResult.kInfeasibleConstraints: Outcome.INFEASIBLE,
    SolutionResult.kInfeasibleOrUnbounded: Outcome.INFEASIBLE,
    SolutionResult.kUnbounded: Outcome.UNBOUNDED,
}
# Feasible ("requested accuracy could not be achieved"), or not better ("current point cannot be improved").
_SNOPT_INACCURATE = (3, 41)
_SNOPT_INFEASIBLE = (11, 12, 13, 14, 15, 16)


def _explain(result: Any) -> tuple[Outcome, str]:
    """Return the outcome and the solver's message."""
    outcome = _RESULTS.get(result.get_solution_result(), Outcome.FAILED)
    info = result.get_solver_details().info
    if info in _SNOPT_INACCURATE:
        outcome = Outcome.INACCURATE
    elif info in _SNOPT_INFEASIBLE:
        outcome = Outcome.INFEASIBLE
    return outcome, f"SNOPT info {info}: {result.get_solution_result().name}"


def _read_table(print_file: Path) -> tuple[Iteration, ...]:
    if not print_file.is_file():
        return ()
    rows = _snopt_rows(print_file.read_text(errors="replace").splitlines())
    return tuple({row.iteration: row for row in rows}.values())  # SNOPT repeats an iteration after a Hessian reset


def _snopt_rows(lines: list[str]) -> Iterator[Iteration]:
    """Yield the rows of the table. Columns are located by their header, because the first row leaves some blank."""
    ends: dict[str, tuple[int, int]] = {}
    for line in lines:
        if "Itns" in line and "Major" in line and "Feasible" in line:
            previous = 0
            for match in re.finditer(r"\S+", line):
                ends[match.group()] = (previous, match.end())
                previous = match.end()
        elif ends and re.match(r"^\s+\d+\s+\d+\s", line):
            objective = next((n for n in ("MeritFunction", "Objective") if n in ends), "")
            cell = {name: line[a:b].strip(" ()") for name, (a, b) in ends.items()}
            numbers = (_number(cell.get(name, "")) for name in (objective, "Feasible", "Optimal", "Step"))
            yield Iteration(int(cell["Major"]), *numbers)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan

"""Run a MathematicalProgram with SNOPT or IPOPT, and read the solver's table."""

import math
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from pydrake import solvers
from pydrake.solvers import IpoptSolver, MathematicalProgram, SnoptSolver, SolutionResult

from drake_diff._base.arrays import Array
from drake_diff._base.clock import TimeIsUpError, check_time, now, until_set
from drake_diff._base.forked import can_fork, forked
from drake_diff._base.signals import noted_interrupts
from drake_diff.exceptions import DrakeDiffError, MissingDependencyError, UnknownNameError
from drake_diff.model.counted import count_steps, stepped
from drake_diff.optimize.iterate import Iterate
from drake_diff.optimize.program import Iteration, Limits, NlpResult, Outcome, Report, Watch

SOLVERS = ("ipopt", "snopt")
# Entries, see `_size_of`, from which on a solver may work for seconds between two evaluations, as IPOPT does in 20
# steps of a chain of 30 joints (1.1 million). Those of a Panda have 0.1 million.
LARGE = 300_000
SNOPT_STEP_LIMIT = 2.0  # its own default: by how much of itself the point may change in a step


_Tell = Callable[[Iteration, Array, float], None]  # gets a row, the point (n,), and the seconds until then


class _Stop(Exception):  # noqa: N818  (a signal, not an error)
    """Raised in the callback to end a solve."""


def solve_program(
    program: MathematicalProgram,
    guess: Array,
    *,
    solver: str,
    limits: Limits,
    report: Report | None = None,
    longest: float = 1.0,
    motions: Callable[[Array], tuple[Iterate, ...]] = lambda z: (),
    refusal: Callable[[], str] = lambda: "",
) -> NlpResult:
    """Solve `program` from `guess` (n,) with "ipopt" or "snopt", which takes steps of at most `longest` its default.

    `report` gets a line of progress a few times a second, with what `motions` makes of the point. Ctrl-C and the time
    limit end the solve with the best iterate so far; a large one in the middle of the solver's own work too, for which
    that has a process of its own. `refusal` says why a point could not be evaluated, the last one, for the result.
    """
    if solver not in SOLVERS:
        raise UnknownNameError("solver", got=solver, known=SOLVERS)
    engine = IpoptSolver() if solver == "ipopt" else SnoptSolver()
    if not (engine.available() and engine.enabled()):
        raise MissingDependencyError(f"the solver {solver} is not in this Drake: take another one, or Drake's wheel")
    with tempfile.TemporaryDirectory() as folder, noted_interrupts() as interrupted:
        watch, print_file = Watch(limits, interrupted), Path(folder) / "log"
        options = _options(solver, limits, print_file, longest)

        def solved(tell: _Tell) -> NlpResult:
            callback = _Callback(program, watch, tell)
            program.AddVisualizationCallback(callback, program.decision_variables())
            try:
                with until_set(interrupted):
                    result = engine.Solve(program, guess, options)
            except (DrakeDiffError, RuntimeError, _Stop, TimeIsUpError) as error:
                outcome, message = _explain_exception(watch, error)
                callback.look_back()
                return NlpResult(watch.best_of(guess), outcome, message, (), refusal=refusal())
            outcome, message = _explain(solver, result)
            z = np.asarray(result.GetSolution(program.decision_variables()))
            return NlpResult(z, outcome, message, (), refusal=refusal())

        def tell(row: Iteration, z: Array, spent: float) -> None:
            if report is not None:
                report.row(row, lambda: motions(z), printed=False)
                cost, violation = f"cost {row.objective:12.6g}", f"violation {row.primal_infeasibility:9.2e}"
                report.say(f"evaluation {row.iteration:5d}  {cost}  {violation}  {spent:6.1f} s")

        if _size_of(program) >= LARGE and can_fork():
            result = _solved_apart(solved, tell, watch, guess, solver, refusal)
        else:
            result = solved(tell)
        return replace(result, iterations=_read_table(solver, print_file))


def _size_of(program: MathematicalProgram) -> int:
    """The entries of all rows' derivatives, and of a matrix of the variables."""
    rows = (len(each.variables()) * each.evaluator().num_constraints() for each in program.GetAllConstraints())
    return int(program.num_vars() ** 2 + sum(rows))


def _solved_apart(
    solved: Callable[[_Tell], NlpResult],
    tell: _Tell,
    watch: Watch,
    guess: Array,
    solver: str,
    refusal: Callable[[], str],
) -> NlpResult:
    """What `solved(tell)` gives, in a process that can be ended while the solver hears nothing."""
    best, why, steps = guess, "", 0

    def work(send: Callable[[Any], None]) -> tuple[NlpResult, int]:
        with count_steps() as count:
            result = solved(lambda *row: send((row, watch.best_of(guess), refusal(), count.steps)))
            return result, count.steps

    def heard(message: Any) -> None:
        nonlocal best, why, steps
        before = steps
        row, best, why, steps = message
        stepped(steps - before)
        tell(*row)

    ended = forked(work, heard, watch.interrupted, watch.start + watch.limits.time_limit)
    if ended.returned is not None:
        result, taken = cast(tuple[NlpResult, int], ended.returned)
        stepped(taken - steps)
        return result
    if ended.crashed:
        message = f"the process of {solver.upper()} ended by {ended.crashed}"
        return NlpResult(best, Outcome.FAILED, message, (), refusal=why)
    outcome = Outcome.INTERRUPTED if watch.interrupted.is_set() else Outcome.TIME_LIMIT
    message = f"stopped: {outcome.value}, in the middle of {solver.upper()}'s own work"
    return NlpResult(best, outcome, message, (), refusal=why)


class _Callback:
    """Called by the solver at every evaluation: reports, keeps the best iterate, raises to stop."""

    def __init__(self, program: MathematicalProgram, watch: Watch, tell: _Tell):
        self.program, self.watch, self.tell = program, watch, tell
        self.evaluations, self.called = 0, now()
        self.current: Array | None = None
        self.before: Array | None = None  # the last point but this at which everything could be evaluated

    def __call__(self, z: Array) -> None:
        self.evaluations += 1
        before, self.called = self.called, now()
        if self.current is None or not np.array_equal(z, self.current):
            self.before, self.current = self.current, np.array(z)
        if self.evaluations == 1:
            self.watch.offer(z, math.inf, 0.0)  # better than none: what it costs has not been asked yet
        if self.watch.look_up():
            self._look(z)
        if self.watch.stopped_by is not None:
            raise _Stop
        if self.evaluations > 2:  # the next one takes as long as the last, but for the first, which loads what it needs
            check_time(ahead=self.called - before)

    def look_back(self) -> None:
        """Keep the point before the one that ended the solve, if it is the best."""
        if self.before is not None:
            try:
                self._look(self.before)
            except (DrakeDiffError, TimeIsUpError):
                return  # nor can it be evaluated: the best that was seen stays

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
        self.tell(row, np.array(z), self.watch.elapsed)


def _options(solver: str, limits: Limits, print_file: Path, longest: float) -> solvers.SolverOptions:
    options = solvers.SolverOptions()
    options.SetOption(solvers.CommonSolverOption.kPrintFileName, str(print_file))
    tolerance, most = limits.tolerance, limits.max_iterations
    if solver == "ipopt":
        name, own = IpoptSolver.id(), {"tol": tolerance, "constr_viol_tol": tolerance, "max_iter": most}
        own["file_print_level"] = 5  # else the file holds no table
    else:
        name, own = SnoptSolver.id(), {"Major iterations limit": most, "Iterations limit": 1000 * most}
        own |= {"Major step limit": SNOPT_STEP_LIMIT * longest}
        own |= {"Major feasibility tolerance": tolerance, "Major optimality tolerance": tolerance}
    for option, value in own.items():
        options.SetOption(name, option, value)
    return options


def _explain_exception(watch: Watch, error: Exception) -> tuple[Outcome, str]:
    """IPOPT hands our exceptions on, SNOPT wraps them in a RuntimeError: flags and names tell, not types."""
    if watch.stopped_by is None and watch.interrupted.is_set():  # in the middle of an evaluation
        watch.stopped_by = Outcome.INTERRUPTED
    if watch.stopped_by is not None:
        return watch.stopped_by, f"stopped: {watch.stopped_by.value}"
    text = f"{type(error).__name__}: {error}"
    if TimeIsUpError.__name__ in text:  # in the middle of an evaluation
        return Outcome.TIME_LIMIT, f"stopped: {Outcome.TIME_LIMIT.value}"
    for name, outcome in (("SimulationError", Outcome.DIVERGED), ("GradientError", Outcome.NO_GRADIENT)):
        if name in text:
            return outcome, text[text.rindex(name) :].strip()  # SNOPT's text holds the traceback first
    return Outcome.FAILED, text


_RESULTS = {
    SolutionResult.kSolutionFound: Outcome.SOLVED,
    SolutionResult.kIterationLimit: Outcome.ITERATION_LIMIT,
    SolutionResult.kInfeasibleConstraints: Outcome.INFEASIBLE,
    SolutionResult.kInfeasibleOrUnbounded: Outcome.INFEASIBLE,
    SolutionResult.kUnbounded: Outcome.UNBOUNDED,
}
# Feasible, or not better: "requested accuracy could not be achieved", "current point cannot be improved".
_SNOPT_INACCURATE = (3, 41)
_SNOPT_INFEASIBLE = (11, 12, 13, 14, 15, 16)


def _explain(solver: str, result: Any) -> tuple[Outcome, str]:
    """The outcome and the solver's own words for it."""
    outcome = _RESULTS.get(result.get_solution_result(), Outcome.FAILED)
    details = result.get_solver_details()
    if solver == "ipopt":
        words = details.ConvertStatusToString()
        if words == "Stop at acceptable point":
            outcome = Outcome.INACCURATE
        return outcome, f"IPOPT: {words}"
    if details.info in _SNOPT_INACCURATE:
        outcome = Outcome.INACCURATE
    elif details.info in _SNOPT_INFEASIBLE:
        outcome = Outcome.INFEASIBLE
    return outcome, f"SNOPT info {details.info}: {result.get_solution_result().name}"


def _read_table(solver: str, print_file: Path) -> tuple[Iteration, ...]:
    if not print_file.is_file():
        return ()
    lines = print_file.read_text(errors="replace").splitlines()
    rows = _ipopt_rows(lines) if solver == "ipopt" else _snopt_rows(lines)
    return tuple({row.iteration: row for row in rows}.values())  # SNOPT repeats an iteration whose Hessian it resets


# iter, objective, inf_pr, inf_du, four that are left out, alpha_pr with the letter of its step, line searches
_IPOPT_ROW = re.compile(r"^\s*(\d+)[r\s]\s*(-?\d\S+)\s+(\S+)\s+(\S+)\s+\S+\s+\S+\s+\S+\s+\S+\s+([\d.e+-]+)\w?\s+\d+")


def _ipopt_rows(lines: list[str]) -> Iterator[Iteration]:
    for match in filter(None, map(_IPOPT_ROW.match, lines)):
        number, *cells = match.groups()
        yield Iteration(int(number), *map(_number, cells))


def _snopt_rows(lines: list[str]) -> Iterator[Iteration]:
    """Columns are read where their header stands: the first row leaves some of them blank."""
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

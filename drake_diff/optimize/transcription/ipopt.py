"""Run a transcribed program with the IPOPT that CasADi carries: progress, limits, interrupts, the best iterate."""

import math
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import DrakeDiffError, GradientError, SimulationError
from drake_diff.optimize.program import Iteration, Limits, NlpResult, Outcome, Report, Watch, ctrl_c
from drake_diff.optimize.transcription.program import TranscribedProgram

OUTCOMES = {
    "Solve_Succeeded": Outcome.SOLVED,
    "Solved_To_Acceptable_Level": Outcome.INACCURATE,
    "Maximum_Iterations_Exceeded": Outcome.ITERATION_LIMIT,
    "Infeasible_Problem_Detected": Outcome.INFEASIBLE,
    "Diverging_Iterates": Outcome.UNBOUNDED,
}
OPTIONS = {
    "ipopt.mu_strategy": "adaptive",  # the monotone one ends minimum times of a pendulum as infeasible
    "print_time": False,
    "show_eval_warnings": False,
    "calc_lam_p": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.print_user_options": "no",
}


NOT_FINITE = "IPOPT: Invalid Number Detected"


def solve_ipopt(
    program: TranscribedProgram, guess: Array, limits: Limits, report: Report | None, *, exact: bool
) -> NlpResult:
    """Solve `program` from `guess` (n,), with its `exact` Hessian or IPOPT's limited-memory one.

    `report` gets a line of progress a few times a second. Ctrl-C ends the solve with the best iterate so far.
    An error that a function of the user's raised is raised again, but that of a simulation or gradient is told.
    """
    with ctrl_c() as interrupted:
        watch = Watch(limits, interrupted)
        callback = _IterateCallback(program, watch, report)
        options = OPTIONS | program.derivatives(exact) | _options(exact, limits) | {"iteration_callback": callback}
        solver = ca.nlpsol("solver", "ipopt", program.nlp, options)
        lower, upper = program.sides
        found = solver(x0=guess, lbx=program.lower, ubx=program.upper, lbg=lower, ubg=upper)
        stats = solver.stats()
    table, error = _rows(stats.get("iterations", {})), callback.error or program.functions.error
    if error is not None:
        return NlpResult(watch.best_of(guess), _explain_error(error), f"{type(error).__name__}: {error}", table)
    if watch.stopped_by is not None:
        return NlpResult(watch.best_of(guess), watch.stopped_by, f"stopped: {watch.stopped_by.value}", table)
    words = str(stats["return_status"])
    outcome = OUTCOMES.get(words, Outcome.FAILED)
    return NlpResult(np.asarray(found["x"]).ravel(), outcome, f"IPOPT: {words.replace('_', ' ')}", table)


class _IterateCallback(ca.Callback):  # type: ignore[misc]
    """Called by the solver at every iterate: reports, keeps the best, says when to stop."""

    def __init__(self, program: TranscribedProgram, watch: Watch, report: Report | None):
        ca.Callback.__init__(self)
        self.program, self.watch, self.report = program, watch, report
        self.sizes = {"x": program.z.numel(), "f": 1, "g": program.nlp["g"].numel(), "lam_x": program.z.numel()}
        self.sizes |= {"lam_g": self.sizes["g"], "lam_p": 0}
        self.iterates = 0
        self.error: Exception | None = None
        self.construct("callback", {})

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.sizes[ca.nlpsol_out(i)], 1)

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        try:
            self._look(*(np.frombuffer(a, float) for a in arguments[:3]))
        except Exception as error:  # of `report`; must not go through C++, the solve raises it
            self.error = error
        stop = self.watch.stopped_by is not None or self.error is not None or self.program.functions.error is not None
        np.frombuffer(results[0], float)[:] = float(stop)
        return 0

    def _look(self, x: Array, f: Array, g: Array) -> None:
        violation = self._violation(x, g)
        self.watch.offer(x, float(f[0]), violation)
        due = self.watch.look_up()
        if self.report:
            self.report.row(Iteration(self.iterates, float(f[0]), violation, math.nan, math.nan), printed=due)
        self.iterates += 1

    def _violation(self, x: Array, g: Array) -> float:
        p = self.program
        lower, upper = p.sides
        return max(
            float(np.max(np.maximum(a - v, v - b), initial=0.0))
            for v, a, b in ((x, p.lower, p.upper), (g, lower, upper))
        )


def _options(exact: bool, limits: Limits) -> dict[str, Any]:
    found: dict[str, Any] = {
        "ipopt.tol": limits.tolerance,
        "ipopt.constr_viol_tol": limits.tolerance,
        "ipopt.max_iter": limits.max_iterations,
    }
    if not exact:
        found |= {"ipopt.hessian_approximation": "limited-memory", "pass_nonlinear_variables": False}
    return found


def _explain_error(error: Exception) -> Outcome:
    if not isinstance(error, DrakeDiffError):
        raise error
    if isinstance(error, SimulationError):
        return Outcome.DIVERGED
    return Outcome.NO_GRADIENT if isinstance(error, GradientError) else Outcome.FAILED


def _rows(table: dict[str, Any]) -> tuple[Iteration, ...]:
    columns = [table.get(name, ()) for name in ("obj", "inf_pr", "inf_du", "alpha_pr")]
    return tuple(Iteration(i, *map(float, row)) for i, row in enumerate(zip(*columns, strict=True)))

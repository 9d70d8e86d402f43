"""Why a run is no success: each case under one of five labels, with what detected it."""

from drake_diff.exceptions import DrakeDiffError, GradientError, SimulationError
from drake_diff.record_parts import Failure, Label, Metric
from drake_diff.solution import Solution, Status

_OF_STATUS: dict[Status, tuple[Label, str]] = {
    Status.CONVERGED_NOT_VERIFIED: ("planning_error", "not_verified"),
    Status.ITERATION_LIMIT: ("planning_error", "solver_iteration_limit"),
    Status.TIME_LIMIT: ("planning_error", "latency_budget_exceeded"),
    Status.INFEASIBLE: ("planning_error", "solver_infeasible"),
    Status.DIVERGED: ("state_error", "simulation_diverged"),
    Status.NO_GRADIENT: ("planning_error", "gradient_vanishing"),
    Status.INTERRUPTED: ("evaluation_error", "interrupted"),
    Status.FAILED: ("planning_error", "solver_numerical"),
}


def failures_of(solution: Solution, metrics: list[Metric]) -> list[Failure]:
    """None for a success; else the status, the first certificate and the metrics that do not hold."""
    broken = [metric for metric in metrics if metric.verdict in ("fail", "undecided")]
    found = [] if solution.success else [_of_status(solution)]
    bad = next((c for c in solution.certificates if c.verdict != "agree"), None)
    if bad is not None and not solution.success:
        message = f"{bad.subject}: {bad}"
        found.append(_failure("planning_error", "gradient_mismatch", message, "certificate", "gradient.certificates"))
    if solution.success and broken:
        message = f"{', '.join(m.name for m in broken)}: the solution says success, its metrics do not hold"
        found.append(_failure("evaluation_error", "metric_does_not_hold", message, "metrics", "metrics"))
    return found


def failure_of(error: Exception) -> Failure:
    """An exception that ended the run before there was a solution."""
    label: Label = "evaluation_error"
    if isinstance(error, (SimulationError, GradientError)):
        label = "state_error" if isinstance(error, SimulationError) else "planning_error"
    code = "refused" if isinstance(error, DrakeDiffError) else "exception"
    message = f"{type(error).__name__}: {error}".encode("utf-8", "replace").decode()
    return _failure(label, code, message, "the exception that ended the run", None)


def _of_status(solution: Solution) -> Failure:
    label, code = _OF_STATUS[solution.status]
    return _failure(label, code, solution.message, "the solver's status, measured again", "solver, metrics, replays")


def _failure(label: Label, code: str, message: str, detected_by: str, evidence: str | None) -> Failure:
    return Failure(label=label, code=code, message=message, detected_by=detected_by, evidence=evidence)

"""Why a run is no success: each case under one of five labels, with what detected it.

What happened in a run, in order: the solver, contacts made and broken, inputs at their limits, the failure.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.exceptions import DrakeDiffError, GradientError, SimulationError
from drake_diff.motion.rollout import Rollout
from drake_diff.optimize.solution import Solution, Status
from drake_diff.record.parts import Event, Failure, Label, Metric

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


AT_LIMIT = 1e-3  # of a limit: so close to it an input counts as there; interior points never quite reach it


def events_of(solution: Solution, failures: list[Failure]) -> list[Event]:
    """Before the motion, along the replay in simulated time, and after it."""
    start = f"{solution.method} with {solution.solver}"
    end = f"{solution.status.value} after {len(solution.iterations)} iterations: {solution.solver_message}"
    along: list[Event] = []
    if solution.replay is not None:
        along = [*_contact_events(solution.replay), *_saturation_events(solution, solution.replay)]
    return [
        Event(t_s=None, kind="solver_started", message=start),
        Event(t_s=None, kind="solver_ended", message=end),
        *sorted(along, key=lambda event: event.t_s or 0.0),
        *(Event(t_s=f.t_s, kind="failure", message=f"{f.label}, {f.code}: {f.message}") for f in failures),
    ]


def _contact_events(motion: Rollout) -> Iterator[Event]:
    """Each pair of bodies that begins or ceases to push each other."""
    before: set[tuple[str, str]] = set()
    for time, contacts in zip(motion.times, motion.contacts, strict=False):
        now = {(c.body_a, c.body_b) for c in contacts}
        for a, b in sorted(now - before):
            yield Event(t_s=float(time), kind="contact_made", message=f"{a} touches {b}")
        for a, b in sorted(before - now):
            yield Event(t_s=float(time), kind="contact_broken", message=f"{a} leaves {b}")
        before = now


def _saturation_events(solution: Solution, motion: Rollout) -> Iterator[Event]:
    """Each input that reaches or leaves a bound of the problem or the effort limit of its actuator."""
    model, bounds = solution.problem.model, solution.problem.bounds
    limits = [(coordinate.lower, coordinate.upper) for coordinate in model.contract.inputs]
    for i, name in enumerate(model.input_names):
        lower, upper = max(bounds.u_lower[i], limits[i][0]), min(bounds.u_upper[i], limits[i][1])
        at_limit = _near(motion.us[:, i], lower) | _near(motion.us[:, i], upper)
        yield from _changes(name, motion.times, at_limit)


def _near(us: Array, limit: float) -> NDArray[np.bool_]:
    """(N,) booleans: whether an input is at `limit`."""
    return np.abs(us - limit) <= AT_LIMIT * abs(limit) if np.isfinite(limit) else np.zeros(len(us), dtype=bool)


def _changes(name: str, times: Array, at_limit: NDArray[np.bool_]) -> Iterator[Event]:
    for k in np.flatnonzero(np.diff(at_limit, prepend=False)):
        if at_limit[k]:
            yield Event(t_s=float(times[k]), kind="saturation_begins", message=f"{name} is at its limit")
        else:
            yield Event(t_s=float(times[k]), kind="saturation_ends", message=f"{name} leaves its limit")

"""The record of a run: what was asked, what came out, what was measured again, and with which versions.

A run directory is written so that record.json is complete last: a run that is killed leaves one that says so.
"""

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from drake_diff.constraint import Constraint
from drake_diff.exceptions import ArtifactError
from drake_diff.nonlinear_program import FEASIBILITY_TOLERANCE
from drake_diff.problem import Problem
from drake_diff.provenance import file_evidence, gradient_evidence, provenance_of
from drake_diff.record import (
    SCHEMA_VERSION,
    Check,
    EvidenceRecord,
    Failure,
    ParameterEvidence,
    Quantity,
    ReplayEvidence,
    Solver,
    WallClock,
)
from drake_diff.replay import Replay
from drake_diff.solution import INTEGRATION_TOLERANCE, Solution, Status
from drake_diff.whole_file import write_whole

RECORD, TRACE, REPLAY, REPORT = "record.json", "trace.mcap", "replay.html", "report.html"


def load_record(directory: str | Path) -> EvidenceRecord:
    """The record in a run directory. ArtifactError where there is none or it does not hold to the schema."""
    path = Path(directory) / RECORD
    try:
        return EvidenceRecord.model_validate_json(path.read_text())
    except FileNotFoundError as error:
        raise ArtifactError(f"{path}: no such record; expected a run directory that drake_diff wrote") from error
    except (ValidationError, UnicodeDecodeError) as error:
        raise ArtifactError(f"{path} is no record of schema {SCHEMA_VERSION}: {error}") from error


def begin(directory: str | Path, problem: Problem) -> None:
    """Mark `directory` as a run that is under way: whatever happens next, its record says "incomplete"."""
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    sentence = "the run has begun and not ended: it is under way, or it was killed"
    record = _record(folder.name, problem, state="incomplete", verdict="incomplete", sentence=sentence)
    write_whole(folder / RECORD, record.to_json().encode())


def save(solution: Solution, directory: str | Path) -> EvidenceRecord:
    """Write the run directory of `solution`: record.json, trace.mcap, replay.html and report.html; gives it.

    Each file is written aside and moved into place, record.json last, so that at any moment the record is
    complete only if everything it names is.
    """
    from drake_diff.meshcat_view import write_replay  # what a script that saves nothing need not load
    from drake_diff.report import write_report
    from drake_diff.trace import write_trace

    folder = Path(directory)
    begin(folder, solution.problem)
    complete = _record(
        folder.name,
        solution.problem,
        state="complete",
        verdict="pass" if solution.success else "fail",
        sentence=solution.message,
        solver=_solver(solution),
        checks=_checks(solution),
        parameters=_parameters(solution),
        gradients=[gradient_evidence(c) for c in solution.certificates],
        gradient_norms=[] if solution.gradient_norms is None else _finite_list(solution.gradient_norms),
        replays=[_replay_evidence(r) for r in solution.replays],
        failures=_failures(solution),
        solve_s=solution.wall_time,
    )
    write_trace(folder / TRACE, solution, {RECORD: ("application/json", _reproducible(complete))})
    motion = solution.replay
    model = solution.problem.model
    write_replay(
        folder / REPLAY,
        model,
        solution.times,
        _drawable(solution) if motion is None else motion.xs,
        contacts=() if motion is None else motion.contacts,
        planned_xs=solution.xs if solution.transcribed is not None and motion is not None else None,
        title=f"{folder.name}: {solution.status.value}",
    )
    write_report(folder / REPORT, solution, complete.model_dump(mode="json"), folder / REPLAY)
    files = {name: file_evidence(folder / name, name) for name in (TRACE, REPLAY, REPORT)}
    complete = complete.model_copy(update={"files": files})
    write_whole(folder / RECORD, complete.to_json().encode())
    return complete


def _drawable(solution: Solution) -> np.ndarray:
    """The solver's states, those that are not finite at the problem's x0: a page cannot show nothing."""
    finite = np.all(np.isfinite(solution.xs), axis=1)
    return np.where(finite[:, None], solution.xs, solution.problem.x0)


def _record(name: str, problem: Problem, *, solve_s: float | None = None, **fields: Any) -> EvidenceRecord:
    return EvidenceRecord(
        name=name,
        problem=_describe(problem),
        contract=problem.model.contract.to_dict(),
        provenance=provenance_of(problem.model),
        wall_clock=WallClock(written_utc=datetime.now(UTC).isoformat(timespec="seconds"), solve_s=solve_s),
        **fields,
    )


def _reproducible(record: EvidenceRecord) -> bytes:
    """The record without wall-clock facts and without the files' hashes, which could not hold their own."""
    fields = record.model_dump(mode="json")
    del fields["wall_clock"], fields["files"]
    return (json.dumps(fields, sort_keys=True, indent=2, allow_nan=False) + "\n").encode()


def _describe(problem: Problem) -> dict[str, Any]:
    b = problem.bounds
    return {
        "num_steps": problem.num_steps,
        "time_step_s": problem.model.time_step,
        "horizon_s": problem.num_steps * problem.model.time_step,
        "state_names": list(problem.model.state_names),
        "input_names": list(problem.model.input_names),
        "x0": _finite_list(problem.x0),
        "x_goal": _finite_list(problem.goal),
        "waypoints": {str(k): _finite_list(x) for k, x in problem.waypoints.items()},
        "constraints": [_constraint(problem, c) for c in problem.constraints],
        "free_horizon_s": None if problem.horizon is None else list(problem.horizon),
        "x_lower": _finite_list(b.x_lower),
        "x_upper": _finite_list(b.x_upper),
        "u_lower": _finite_list(b.u_lower),
        "u_upper": _finite_list(b.u_upper),
        "optimize": list(problem.optimize),
        "running_cost": _name(problem.running_cost),
        "final_cost": _name(problem.final_cost),
        "trajectory_cost": _name(problem.trajectory_cost),
        "initial_state_free": [bool(free) for free in problem.initial_state_mask],
    }


def _constraint(problem: Problem, c: Constraint) -> dict[str, Any]:
    knots = c.at_knots(problem.num_steps, problem.initial_state_is_given)
    return {"name": c.label, "lower": _finite_list(c.lower), "upper": _finite_list(c.upper), "knots": list(knots)}


def _parameters(solution: Solution) -> list[ParameterEvidence]:
    problem, found = solution.problem, solution.vector
    lower, upper = problem.bounds_of_parameters()
    units = [p.unit for p in found.parameters for _ in p.value]
    return [
        ParameterEvidence(
            name=name,
            unit=units[i],
            derivative_source=found.sources[i],
            start=float(problem.parameters.values[i]),
            value=float(found.values[i]),
            optimized=problem.optimizes_parameters,
            lower=_finite_list(lower)[i],
            upper=_finite_list(upper)[i],
        )
        for i, name in enumerate(found.names)
    ]


def _finite_list(values: Any) -> list[float | None]:
    """Numbers for JSON; None where there is no bound or no goal (infinite, NaN)."""
    return [float(v) if math.isfinite(v) else None for v in np.asarray(values).ravel()]


def _name(cost: Any) -> Any:
    if cost is None or not hasattr(cost, "Q"):
        return None if cost is None else getattr(cost, "__qualname__", type(cost).__name__)
    parts = {name: getattr(cost, name) for name in ("Q", "R", "x_ref", "u_ref")}
    return {"QuadraticCost": {name: np.asarray(v).tolist() for name, v in parts.items() if v is not None}}


def _solver(solution: Solution) -> Solver:
    return Solver(
        method=solution.method,
        solver=solution.solver,
        status=solution.status.value,
        message=solution.message,
        solver_message=solution.solver_message,
        options=solution.options,
        iterations=len(solution.iterations),
    )


def _checks(solution: Solution) -> list[Check]:
    """Every measure of the solution and of its replay; those with a bound decide, the others inform."""
    tolerance = FEASIBILITY_TOLERANCE
    checks = [
        _check("cost", "objective of the states and inputs as the problem defines it", solution.cost, "1"),
        _check("defect", "largest distance from the dynamics over one step", solution.defect, "q, v", tolerance),
        _check(
            "goal error", "largest distance of the final state from the goal", solution.goal_error, "q, v", tolerance
        ),
        _check("bound violation", "largest excess over a bound", solution.bound_violation, "q, v, u", tolerance),
        _check(
            "initial state error",
            "distance of the first state from x0",
            solution.initial_state_error,
            "q, v",
            tolerance,
        ),
        _check(
            "constraint violation",
            "largest excess over a bound of a constraint, or distance from a waypoint",
            solution.constraint_violation,
            "the constraint's",
            tolerance,
        ),
        _check("horizon", "time from the first state to the last", solution.horizon, "s"),
    ]
    if solution.transcribed is not None:
        definition = "largest distance of a knot from an accurate integration from the knot before"
        checks.append(
            _check("integration error", definition, solution.integration_error, "q, v", INTEGRATION_TOLERANCE)
        )
    return checks + _replay_checks(solution)


def _replay_checks(solution: Solution) -> list[Check]:
    r = solution.replay
    if r is None:
        missing = "the discrete plant could not be stepped along these inputs"
        return [
            Check(
                name="replay",
                definition="open-loop replay on the discrete plant",
                quantity=Quantity(value=None, unit="1", reason=missing),
                passed=False,
            )
        ]
    end = float(np.abs(r.xs[-1] - solution.xs[-1]).max())
    scale = "in the open-loop replay on the discrete plant"
    return [
        _check("replay end error", f"largest distance of the final state {scale} from the plan's", end, "q, v"),
        _check("half-step end error", "the same, in steps half as long", solution.half_step_error, "q, v"),
        _check(
            "energy drift", f"lasting energy that actuators and damping do not explain, {scale}", r.energy_drift, "J"
        ),
        _check(
            "energy oscillation",
            f"largest oscillation of that energy about its drift, {scale}",
            r.energy_oscillation,
            "J",
        ),
        _check("energy scale", f"range of kinetic plus potential energy {scale}", float(np.ptp(r.energy)), "J"),
        _check("penetration", f"largest overlap of two geometries {scale}", float(np.max(r.penetration)), "m"),
        _check(
            "joint limit violation",
            f"largest excess over a joint limit or of a quaternion's norm {scale}",
            float(np.max(r.constraint_violation)),
            "q",
        ),
    ]


def _replay_evidence(r: Replay) -> ReplayEvidence:
    goal, bound, energy, depth = _finite_list([r.goal_error, r.bound_violation, r.energy_error, r.penetration])
    return ReplayEvidence(
        variant=r.variant,
        control=r.control,
        time_step_s=r.time_step,
        contact_approximation=r.approximation,
        goal_error=goal,
        bound_violation=bound,
        energy_error_J=energy,
        penetration_m=depth,
        holds=r.holds,
        failures=list(r.failures),
    )


def _check(name: str, definition: str, value: float, unit: str, bound: float | None = None) -> Check:
    finite = math.isfinite(value)
    quantity = Quantity(value=value if finite else None, unit=unit, reason=None if finite else "not finite")
    passed = None if bound is None else bool(value <= bound)
    return Check(name=name, definition=definition, quantity=quantity, bound=bound, passed=passed)


_FAILURES: dict[Status, tuple[str, str]] = {
    Status.CONVERGED_NOT_VERIFIED: ("planning_error", "not_verified"),
    Status.ITERATION_LIMIT: ("planning_error", "solver_iteration_limit"),
    Status.TIME_LIMIT: ("planning_error", "latency_budget_exceeded"),
    Status.INFEASIBLE: ("planning_error", "solver_infeasible"),
    Status.DIVERGED: ("state_error", "simulation_diverged"),
    Status.NO_GRADIENT: ("planning_error", "gradient_vanishing"),
    Status.INTERRUPTED: ("evaluation_error", "interrupted"),
    Status.FAILED: ("planning_error", "solver_numerical"),
}


def _failures(solution: Solution) -> list[Failure]:
    if solution.success:
        return []
    label, code = _FAILURES[solution.status]
    failures = [Failure(label=label, code=code, message=solution.message)]  # type: ignore[arg-type]
    bad = next((c for c in solution.certificates if c.verdict != "agree"), None)
    if bad is not None:
        failures.append(Failure(label="planning_error", code="gradient_mismatch", message=f"{bad.subject}: {bad}"))
    return failures

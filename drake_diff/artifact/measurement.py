"""Everything that is measured of a solution, once: record.json, trace.mcap and the pages are written from it.

Whatever a record says of a motion, `verify` computes again by the same function.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.artifact.invariants import ON_THE_PLANT, invariants_of
from drake_diff.exceptions import DrakeDiffError, GradientError, SimulationError
from drake_diff.motion.rollout import Rollout
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.replay import Replay
from drake_diff.optimize.solution import INTEGRATION_TOLERANCE, Solution, Status
from drake_diff.optimize.transcription.motion import violation_between_nodes
from drake_diff.record.parts import Event, Failure, Label, Metric, measured
from drake_diff.record.solve import ReplayEvidence

AT_LIMIT = 1e-3  # of a limit: so close to it an input counts as there; interior points never quite reach it
NO_REPLAY = "the discrete plant could not be stepped along these inputs"
FAILURES: dict[Status, tuple[Label, str]] = {
    Status.CONVERGED_NOT_VERIFIED: ("planning_error", "not_verified"),
    Status.ITERATION_LIMIT: ("planning_error", "solver_iteration_limit"),
    Status.TIME_LIMIT: ("planning_error", "latency_budget_exceeded"),
    Status.INFEASIBLE: ("planning_error", "solver_infeasible"),
    Status.DIVERGED: ("state_error", "simulation_diverged"),
    Status.NO_GRADIENT: ("planning_error", "gradient_vanishing"),
    Status.INTERRUPTED: ("evaluation_error", "interrupted"),
    Status.FAILED: ("planning_error", "solver_numerical"),
}


@dataclass(frozen=True)
class Column:
    """A column of the states or inputs: its name and unit, and the bounds that the problem sets."""

    name: str
    unit: str
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class Measurement:
    """What a solution is on Drake's plant; `measure` makes it.

    Attributes:
        solution: The plan, and how the solver came to it.
        positions, velocities, inputs: The columns of its states and inputs.
        motion: The plant's own motion under the planned inputs; None where it could not be taken.
        replays: The plan in every variant of the plant.
        metrics: Every measure of the plan and of its replay; those with a tolerance decide.
        invariants: What physics keeps along the replay.
        failures: Why the run is no success; none for a success.
        events: What happened, in order: the solver, contacts, inputs at their limits, failures.
    """

    solution: Solution
    positions: tuple[Column, ...]
    velocities: tuple[Column, ...]
    inputs: tuple[Column, ...]
    motion: Rollout | None
    replays: tuple[Replay, ...]
    metrics: tuple[Metric, ...]
    invariants: tuple[Metric, ...]
    failures: tuple[Failure, ...]
    events: tuple[Event, ...]

    @property
    def state_unit(self) -> str:
        """The unit of the worst of all states: "rad or rad/s"."""
        return _unit((*self.positions, *self.velocities))

    def __str__(self) -> str:
        broken = [m.name for m in (*self.metrics, *self.invariants) if m.verdict in ("fail", "undecided")]
        decided = sum(m.verdict != "info" for m in (*self.metrics, *self.invariants))
        kept = f"{decided - len(broken)} of {decided} bounds are kept"
        return f"{self.solution.status.value}: {kept}" + (f", not those of {', '.join(broken)}" if broken else "")

    def __repr__(self) -> str:
        lines = [f"Measurement: {self}", *(f"{f.label}: {f.message}" for f in self.failures)]
        return "\n  ".join((*lines, *(f"{m.name}: {m.value} {m.unit} ({m.verdict})" for m in self.metrics)))

    def _repr_html_(self) -> str:
        return f"<pre>{escape(repr(self))}</pre>"


def measure(solution: Solution) -> Measurement:
    """Measure a solution on the plant: once, for all that is written of it.

    Args:
        solution: A result of `solve`.

    Returns:
        A `Measurement`.

    Example:
        >>> from drake_diff.artifact import measure
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> problem = dd.Problem(model, x0=[0.1, 0], num_steps=5, running_cost=dd.QuadraticCost(R=[[1.0]]))
        >>> print(measure(dd.solve(problem, method="shooting")))
        converged: 5 of 5 bounds are kept
    """
    with np.errstate(over="ignore", invalid="ignore"):  # numbers of a run that diverged: they are measured as infinite
        return _measure(solution)


def _measure(solution: Solution) -> Measurement:
    problem = solution.problem
    contract, bounds = problem.model.contract, problem.bounds
    limits = (
        np.array([bounds.x_lower, bounds.x_upper]).T.tolist(),
        np.array([bounds.u_lower, bounds.u_upper]).T.tolist(),
    )
    states = [
        Column(c.name, c.unit, *limit)
        for c, limit in zip(contract.positions + contract.velocities, limits[0], strict=True)
    ]
    count = len(contract.positions)
    positions, velocities = tuple(states[:count]), tuple(states[count:])
    inputs = tuple(Column(c.name, c.unit, *limit) for c, limit in zip(contract.inputs, limits[1], strict=True))
    motion = solution.replay
    metrics = (
        *_metrics_of_the_plan(solution, states, inputs),
        *_metrics_of_the_replay(solution, motion, states, positions),
    )
    failures = tuple(_failures(solution, metrics))
    return Measurement(
        solution=solution,
        positions=positions,
        velocities=velocities,
        inputs=inputs,
        motion=motion,
        replays=solution.replays,
        metrics=metrics,
        invariants=tuple(invariants_of(solution.vector, motion, _unit(positions), NO_REPLAY)),
        failures=failures,
        events=tuple(_events(solution, motion, failures)),
    )


def _unit(columns: Sequence[Column]) -> str:
    """The units of the worst of several coordinates: "rad or m"."""
    return " or ".join(dict.fromkeys(column.unit for column in columns))


def _metrics_of_the_plan(solution: Solution, states: Sequence[Column], inputs: Sequence[Column]) -> Iterator[Metric]:
    tolerance, x = FEASIBILITY_TOLERANCE, _unit(states)
    units = [c.unit for c in (*states, *inputs)] + [p.unit for p in solution.vector.parameters]
    bounded = " or ".join(dict.fromkeys(units))
    worst = int(np.argmax(solution.defects)) if len(solution.defects) else 0
    when = float(solution.times[worst])
    yield measured("cost", "objective of the states and inputs as the problem defines it", solution.cost, "1")
    yield measured(
        "defect", "largest distance from the dynamics over one step", solution.defect, x, tolerance, t_s=when
    )
    yield measured("goal error", "largest distance of the final state from the goal", solution.goal_error, x, tolerance)
    yield measured("bound violation", "largest excess over a bound", solution.bound_violation, bounded, tolerance)
    yield measured(
        "initial state error", "distance of the first state from x0", solution.initial_state_error, x, tolerance
    )
    excess = "largest excess over a bound of a constraint, or distance from a waypoint"
    yield measured("constraint violation", excess, solution.constraint_violation, "the constraint's", tolerance)
    yield measured("horizon", "time from the first state to the last", solution.horizon, "s")
    if solution.transcribed is None:
        return
    definition = "largest distance of a knot from an accurate integration from the knot before"
    yield measured("integration error", definition, solution.integration_error, x, INTEGRATION_TOLERANCE)
    between = violation_between_nodes(solution.transcribed)
    for name, value, unit in (("state", between.state, x), ("input", between.input, _unit(inputs))):
        definition = f"largest excess of the {name} over its bounds between the nodes, where no solver keeps them"
        yield measured(f"{name} excess between nodes", definition, value, unit)


def _metrics_of_the_replay(
    solution: Solution, motion: Rollout | None, states: Sequence[Column], positions: Sequence[Column]
) -> Iterator[Metric]:
    here, x = ON_THE_PLANT, _unit(states)
    measures = (
        ("replay end error", f"largest distance of the final state {here} from the plan's", x),
        ("half-step end error", "the same, in steps half as long", x),
        ("energy drift", f"lasting energy that actuators and damping do not explain, {here}", "J"),
        ("energy oscillation", f"largest oscillation of that energy about its drift, {here}", "J"),
        ("energy scale", f"range of kinetic plus potential energy {here}", "J"),
        ("penetration", f"largest overlap of two geometries {here}", "m"),
        (
            "joint limit violation",
            f"largest excess over a joint limit or of a quaternion's norm {here}",
            _unit(positions),
        ),
    )
    if motion is None:
        for name, definition, unit in measures:
            yield measured(name, definition, float("inf"), unit, reason=NO_REPLAY)
        return
    values = (
        float(np.abs(motion.xs[-1] - solution.xs[-1]).max()),
        solution.half_step_error,
        motion.energy_drift,
        motion.energy_oscillation,
        float(np.ptp(motion.energy)),
        float(np.max(motion.penetration)),
        float(np.max(motion.constraint_violation)),
    )
    for (name, definition, unit), value in zip(measures, values, strict=True):
        yield measured(name, definition, value, unit)


def _failures(solution: Solution, metrics: Sequence[Metric]) -> Iterator[Failure]:
    """None for a success; else the status, the first certificate and the metrics that do not hold."""
    if not solution.success:
        label, code = FAILURES[solution.status]
        found_by = "the solver's status, measured again"
        yield _failure(label, code, solution.message, found_by, "solver, metrics, replays")
        bad = next((c for c in solution.certificates if c.verdict != "agree"), None)
        if bad is not None:
            message = f"{bad.subject}: {bad}"
            yield _failure("planning_error", "gradient_mismatch", message, "certificate", "gradient.certificates")
        return
    broken = [metric.name for metric in metrics if metric.verdict in ("fail", "undecided")]
    if broken:
        message = f"{', '.join(broken)}: the solution says success, its metrics do not hold"
        yield _failure("evaluation_error", "metric_does_not_hold", message, "metrics", "metrics")


def replay_evidence(r: Replay) -> ReplayEvidence:
    """A replay as it stands in a record."""
    goal, bound, energy, depth = (
        float(v) if math.isfinite(v) else None for v in (r.goal_error, r.bound_violation, r.energy_error, r.penetration)
    )
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


def failure_of(error: Exception) -> Failure:
    """The failure of a run that `error` ended before there was a solution."""
    label: Label = "evaluation_error"
    if isinstance(error, (SimulationError, GradientError)):
        label = "state_error" if isinstance(error, SimulationError) else "planning_error"
    code = "refused" if isinstance(error, DrakeDiffError) else "exception"
    message = f"{type(error).__name__}: {error}".encode("utf-8", "replace").decode()
    return _failure(label, code, message, "the exception that ended the run", None)


def _failure(label: Label, code: str, message: str, detected_by: str, evidence: str | None) -> Failure:
    return Failure(label=label, code=code, message=message, detected_by=detected_by, evidence=evidence)


def _events(solution: Solution, motion: Rollout | None, failures: Sequence[Failure]) -> Iterator[Event]:
    """Before the motion, along the replay in simulated time, and after it."""
    yield Event(t_s=None, kind="solver_started", message=f"{solution.method} with {solution.solver}")
    end = f"{solution.status.value} after {len(solution.iterations)} iterations: {solution.solver_message}"
    yield Event(t_s=None, kind="solver_ended", message=end)
    if motion is not None:
        along = [*_contact_events(motion), *_saturation_events(solution, motion)]
        yield from sorted(along, key=lambda event: event.t_s or 0.0)
    for f in failures:
        yield Event(t_s=f.t_s, kind="failure", message=f"{f.label}, {f.code}: {f.message}")


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
    bounds = solution.problem.bounds
    for i, coordinate in enumerate(solution.problem.model.contract.inputs):
        limits = (max(bounds.u_lower[i], coordinate.lower), min(bounds.u_upper[i], coordinate.upper))
        us: Array = motion.us[:, i]
        at_limit = np.zeros(us.shape, dtype=bool)
        for limit in limits:
            if np.isfinite(limit):
                at_limit |= np.abs(us - limit) <= AT_LIMIT * abs(limit)
        for k in np.flatnonzero(np.diff(at_limit, prepend=False)):
            message = f"{coordinate.name} is at its limit" if at_limit[k] else f"{coordinate.name} leaves its limit"
            yield Event(
                t_s=float(motion.times[k]),
                kind="saturation_begins" if at_limit[k] else "saturation_ends",
                message=message,
            )

"""Measure a solution once; record.json, trace.mcap and the pages are written from this measurement.

`verify` recomputes every statement of a record about a motion with the same function.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal, ShowsItsRepr
from drake_diff.exceptions import DrakeDiffError, GradientError, SimulationError
from drake_diff.model.contact import thinnest_geometry
from drake_diff.model.contract import CoordinateTerms
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameter, ParameterVector, applied
from drake_diff.model.plant import FLOATING, bodies, joints
from drake_diff.model.step import set_state
from drake_diff.motion.rollout import CONTINUOUS, STEPS, Rollout, drift, smooth_mean
from drake_diff.optimize.measure import ASKED, INTEGRATION_TOLERANCE
from drake_diff.optimize.problem.dynamics import units_of
from drake_diff.optimize.replay import PENETRATION_PART, Replay, energy_tolerance, loop_check
from drake_diff.optimize.solution import Solution, Status
from drake_diff.runs.fields import Event, Failure, Label, Metric, ReplayEvidence, evidence, finite

AT_LIMIT = 1e-3  # relative distance to a limit that counts as saturation; interior-point solutions stay slightly inside
ON_THE_PLANT = {  # by the problem's motion
    STEPS: "in the open-loop replay on the discrete plant",
    CONTINUOUS: "in the open-loop replay in continuous time, integrated apart",
}
NO_REPLAY = "the plant could not be stepped along these inputs"
HALF_STEP = "half-step end error"
NEVER_FREE = "there is contact, or a limit, from the first step on"
INVARIANTS = {
    "free-motion energy drift": "J",
    "free-motion energy oscillation": "J",
    "linear momentum error": "N s",
    "angular momentum error": "N m s",
    "penetration": "m",
    "limit violation": "",  # the unit of the positions
    "friction-cone excess": "N",
}
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


@dataclass(frozen=True, eq=False)
class Measurement(ShowsItsRepr):
    """The measures of a solution on Drake's plant, computed by `measure`.

    Attributes:
        solution: The plan, and the solver's result.
        positions, velocities, inputs: The columns of its states and inputs, with the problem's bounds.
        times, xs, us: (N+1,), (N+1, nx), and (N, nu) or (N+1, nu): the plan at the problem's own knots.
        motion: The plant's own motion under the planned inputs; None if it could not be computed.
        integrated: (N+1, nx) the states integrated from the first state, for a plan in continuous time.
        penetration_limit: [m] allowed overlap of two geometries; `thinnest` is the geometry that determines it.
        replays: The replays of the plan in every variant of the plant.
        metrics: All measures of the plan and of its replay; those with a tolerance decide the verdict.
        invariants: The physical invariants along the replay.
        failures: The reasons why the run is not a success; empty for a success.
        events: The events in order: the solver, contacts, inputs at their limits, failures.

    Example:
        >>> from drake_diff.runs import measure
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> problem = dd.Problem(model, x0=[0.1, 0], num_steps=5, running_cost=dd.QuadraticCost(R=[[1.0]]))
        >>> m = measure(dd.solve(problem, method="shooting"))
        >>> [column.name for column in m.positions], m.xs.shape, len(m.failures)
        (['hinge_q'], (6, 2), 0)
    """

    solution: Solution
    positions: tuple[CoordinateTerms, ...]
    velocities: tuple[CoordinateTerms, ...]
    inputs: tuple[CoordinateTerms, ...]
    times: Array
    xs: Array
    us: Array
    motion: Rollout | None
    integrated: Array | None
    replays: tuple[Replay, ...]
    penetration_limit: float
    thinnest: str
    metrics: tuple[Metric, ...]
    invariants: tuple[Metric, ...]
    failures: tuple[Failure, ...]
    events: tuple[Event, ...]

    @property
    def shown(self) -> tuple[Rollout | None, str]:
        """The motion on which the verdict depends, and its description; the open-loop motion if no replay holds."""
        judged = self.solution.judged_replay
        if judged is None or judged.motion is None or judged.motion is self.motion:
            return self.motion, "open loop"
        return judged.motion, f"{judged.control}, {judged.variant}"

    def __str__(self) -> str:
        broken = [m.name for m in (*self.metrics, *self.invariants) if m.verdict in ("fail", "undecided")]
        decided = sum(m.verdict != "info" for m in (*self.metrics, *self.invariants))
        summary = f"{decided - len(broken)} of {decided} bounds are kept"
        return f"{self.solution.status.value}: {summary}" + (f", not those of {', '.join(broken)}" if broken else "")

    def __repr__(self) -> str:
        lines = [f"Measurement: {self}", *(f"{f.label}: {f.message}" for f in self.failures)]
        return "\n  ".join((*lines, *(f"{m.name}: {m.value} {m.unit} ({m.verdict})" for m in self.metrics)))


@np.errstate(over="ignore", invalid="ignore")  # values of a diverged run, which are measured as infinite
def measure(solution: Solution) -> Measurement:
    """Measure a solution on the plant, for everything that is written about it.

    Args:
        solution: A result of `solve`.

    Returns:
        A `Measurement`.

    Example:
        >>> from drake_diff.runs import measure
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> problem = dd.Problem(model, x0=[0.1, 0], num_steps=5, running_cost=dd.QuadraticCost(R=[[1.0]]))
        >>> print(measure(dd.solve(problem, method="shooting")))
        converged: 6 of 6 bounds are kept
    """
    problem, motion, knots, us = solution.problem, solution.replay, solution.knots, solution.inputs_at_knots
    names, b = (*problem.state_names, *problem.input_names), problem.bounds
    limits = np.append(b.x_lower, b.u_lower).tolist(), np.append(b.x_upper, b.u_upper).tolist()
    columns = tuple(CoordinateTerms(*column) for column in zip(names, units_of(problem), *limits, strict=True))
    states, inputs = columns[: problem.nx], columns[problem.nx :]
    count = problem.model.nq if problem.has_model else problem.nx  # all states of plain dynamics are positions
    positions, velocities = states[:count], states[count:]
    metrics = [*_metrics_of_the_plan(solution, states, inputs)]
    invariants: list[Metric] = []
    limit, thinnest = math.inf, ""
    if problem.has_model:
        metrics += _metrics_of_the_replay(solution, motion, states, positions)
        invariants += invariants_of(solution.vector, motion, _unit(positions), ON_THE_PLANT[problem.motion])
        limit, thinnest = thinnest_geometry(problem.model)
    failures = tuple(_failures(solution, metrics))
    return Measurement(
        solution=solution,
        positions=positions,
        velocities=velocities,
        inputs=inputs,
        times=solution.times[knots],
        xs=solution.xs[knots],
        us=us if len(us) == problem.num_steps else us[knots],
        motion=motion,
        integrated=None if solution.integrated is None else solution.integrated[knots],
        replays=solution.replays,
        penetration_limit=PENETRATION_PART * limit,
        thinnest=thinnest,
        metrics=tuple(metrics),
        invariants=tuple(invariants),
        failures=failures,
        events=tuple(_events(solution, motion, failures)),
    )


def _unit(columns: Sequence[CoordinateTerms | Parameter]) -> str:
    """Join the units of several columns: "rad or m"."""
    return " or ".join(dict.fromkeys(column.unit for column in columns))


def _metrics_of_the_plan(
    s: Solution, states: Sequence[CoordinateTerms], inputs: Sequence[CoordinateTerms]
) -> Iterator[Metric]:
    rows, x = {what: [c for c in s.plan_checks if c.what == what] for what in ASKED}, _unit(states)
    most = {what: max((c.tolerance for c in checks), default=0.0) for what, checks in rows.items()}
    bounded = _unit((*states, *inputs, *s.vector.parameters))
    worst = int(np.argmax(s.defects)) if len(s.defects) else 0
    when = float(s.times[min(worst, len(s.times) - 1)])
    yield measured("cost", "objective of the states and inputs as the problem defines it", s.cost, "1")
    yield measured(
        "cost error", "distance of the cost from what was minimized and from its true value", s.cost_error, "1"
    )
    limit = most["defect"] if rows["defect"] else None  # a given plan in continuous time has no scheme
    yield measured("defect", "largest distance from the dynamics over one step", s.defect, x, limit, t_s=when)
    yield measured("goal error", "largest distance of the final state from the goal", s.goal_error, x, most["goal"])
    yield measured("bound violation", "largest excess over a bound", s.bound_violation, bounded, most["bound"])
    yield measured(
        "initial state error", "distance of the first state from x0", s.initial_state_error, x, most["start"]
    )
    excess = "largest excess over a bound of a constraint, or distance from a waypoint"
    yield measured("constraint violation", excess, s.constraint_violation, "the constraint's", most["constraint"])
    yield measured("horizon", "time from the first state to the last", s.horizon, "s")
    between = s.between_nodes
    if between is None:
        return
    definition = "largest distance of a knot from an accurate integration from the knot before"
    yield measured("integration error", definition, s.integration_error, x, INTEGRATION_TOLERANCE)
    excesses = ("state", between.state, x), ("input", between.input, _unit(inputs))
    for name, value, unit in (*excesses, ("constraint", between.constraint, "the constraint's")):
        definition = f"largest excess of the {name} over its bounds between the nodes, as the dynamics move there"
        yield measured(f"{name} excess between nodes", definition, value, unit)
    tolerances = (
        "1e-3 of its range along the plan or 1e-5, and 1e-3 of the ranges of states and inputs to where it holds"
    )
    definition = f"the worst of these as a part of its tolerance, {tolerances}"
    yield measured("excess between nodes", definition, between.worst, "1", 1.0)
    if s.integrated is not None and not s.problem.has_model:
        definition = "largest distance of the final state from where the equations lead from the first, unstable or not"
        yield measured("open-loop end error", definition, float(np.abs(s.integrated[-1] - s.xs[-1]).max()), x)


def _metrics_of_the_replay(
    solution: Solution, motion: Rollout | None, states: Sequence[CoordinateTerms], positions: Sequence[CoordinateTerms]
) -> Iterator[Metric]:
    here, x, position = ON_THE_PLANT[solution.problem.motion], _unit(states), _unit(positions)

    def on_replay(
        name: str, definition: str, value: Callable[[Rollout], Any], unit: str, tolerance: float | None = None
    ) -> Metric:
        if motion is None:
            return measured(name, definition, math.inf, unit, reason=NO_REPLAY)
        return measured(name, definition, float(value(motion)), unit, tolerance)

    tolerance = None
    judged = solution.judged_replay  # a replay that holds has passed its own energy check
    rests_on_it = judged is None or judged.motion is None or judged.motion is motion
    if motion is not None and rests_on_it and np.all(np.isfinite(motion.constraint_violation)):  # else may lose energy
        tolerance = energy_tolerance(motion)
    if motion is not None and solution.problem.has_model and solution.problem.model.file_facts.held_points:
        loop = loop_check(solution.problem.model, motion.times, motion.xs)
        yield measured("loop gap", f"largest distance of points that a loop holds together {here}", loop.value, "m")
    definition = f"largest distance of the final state {here} from the plan's"
    yield on_replay("replay end error", definition, lambda m: np.abs(m.xs[-1] - solution.xs[-1]).max(), x)
    if solution.problem.motion == STEPS:  # continuous time has no steps
        yield on_replay(HALF_STEP, "the same, in steps half as long", lambda _: solution.half_step_error, x)
    definition = f"lasting energy that no force explains (actuators, damping, contact, limits), {here}"
    yield on_replay("energy drift", definition, lambda m: abs(m.energy_drift), "J", tolerance)
    definition = f"largest oscillation of that energy about its drift, {here}"
    yield on_replay("energy oscillation", definition, lambda m: m.energy_oscillation, "J")
    yield on_replay("energy scale", f"range of kinetic plus potential energy {here}", lambda m: np.ptp(m.energy), "J")
    yield on_replay("penetration", f"largest overlap of two geometries {here}", lambda m: np.max(m.penetration), "m")
    definition = f"largest excess over a joint limit or of a quaternion's norm {here}"
    yield on_replay("joint limit violation", definition, lambda m: np.max(m.constraint_violation), position)


def _failures(solution: Solution, metrics: Sequence[Metric]) -> Iterator[Failure]:
    """Yield the status and a failed certificate of an unsuccessful solve, or the failed metrics of a successful one."""
    if not solution.success:
        label, code = FAILURES[solution.status]
        found_by = "the solver's status, measured again"
        yield failure(label, code, solution.message, found_by, "solver, metrics, replays")
        bad = next((c for c in solution.certificates if c.verdict != "agree"), None)
        if bad is not None:
            message = f"{bad.subject}: {bad}"
            yield failure("planning_error", "gradient_mismatch", message, "certificate", "gradient.certificates")
        return
    broken = [metric.name for metric in metrics if metric.verdict in ("fail", "undecided")]
    if broken:
        message = f"{', '.join(broken)}: the solution says success, its metrics do not hold"
        yield failure("evaluation_error", "metric_does_not_hold", message, "metrics", "metrics")


def gradient_norms(solution: Solution) -> tuple[Array | None, Array | None]:
    """Return the norms (N+1,) |d x_N / d x_k| and |d L / d x_k|, or None if they are unknown."""
    ends, result = solution.final_state_norms, solution.optimality
    return None if isinstance(ends, Refusal) else ends, None if isinstance(result, Refusal) else result.state_norms


def replay_evidence(r: Replay) -> ReplayEvidence:
    """Convert a replay to a section of a record."""
    return evidence(
        ReplayEvidence,
        r,
        time_step_s=r.time_step,
        contact_approximation=r.approximation,
        energy_error_J=finite(r.energy_error),
        penetration_m=finite(r.penetration),
    )


def failure_of(error: BaseException) -> Failure:
    """Return the failure of a run that `error` ended before there was a solution."""
    label: Label = "evaluation_error"
    if isinstance(error, (SimulationError, GradientError)):
        label = "state_error" if isinstance(error, SimulationError) else "planning_error"
    code = "refused" if isinstance(error, DrakeDiffError) else "exception"
    message = f"{type(error).__name__}: {error}".encode("utf-8", "replace").decode()
    return failure(label, code, message, "the exception that ended the run", None)


def failure(label: Label, code: str, message: str, detected_by: str, section: str | None) -> Failure:
    return Failure(label=label, code=code, message=message, detected_by=detected_by, evidence=section)


def _events(solution: Solution, motion: Rollout | None, failures: Sequence[Failure]) -> Iterator[Event]:
    """Yield the events before the motion, along the replay in simulated time, and after it."""
    yield Event(t_s=None, kind="solver_started", message=f"{solution.method} with {solution.solver}")
    end = f"{solution.status.value} after {len(solution.iterations)} iterations: {solution.solver_message}"
    yield Event(t_s=None, kind="solver_ended", message=end)
    if motion is not None:
        along = [*contact_events(motion), *_saturation_events(solution, motion)]
        yield from sorted(along, key=lambda event: event.t_s or 0.0)
    for f in failures:
        yield Event(t_s=f.t_s, kind="failure", message=f"{f.label}, {f.code}: {f.message}")


def contact_events(motion: Rollout) -> Iterator[Event]:
    """Yield an event whenever a pair of bodies makes or breaks contact."""
    before: set[tuple[str, str]] = set()
    for time, contacts in zip(motion.times, motion.contacts, strict=False):
        now = {(c.body_a, c.body_b) for c in contacts}
        for a, b in sorted(now - before):
            yield Event(t_s=float(time), kind="contact_made", message=f"{a} touches {b}")
        for a, b in sorted(before - now):
            yield Event(t_s=float(time), kind="contact_broken", message=f"{a} leaves {b}")
        before = now


def _saturation_events(solution: Solution, motion: Rollout) -> Iterator[Event]:
    """Yield an event whenever an input reaches or leaves a bound of the problem or its actuator's effort limit."""
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


def measured(
    name: str,
    definition: str,
    value: float,
    unit: str,
    tolerance: float | None = None,
    *,
    reason: str = "not finite",
    t_s: float | None = None,
) -> Metric:
    """Make a metric of at most `tolerance`, or an "info" metric; `reason` explains a non-finite `value`."""
    known = math.isfinite(value)
    if tolerance is not None and not math.isfinite(tolerance):
        tolerance = 0.0  # the tolerance is relative to the scale of a non-finite plan
    return Metric(
        name=name,
        definition=definition,
        unit=unit,
        value=float(value) if known else None,
        reason=None if known else reason,
        tolerance=tolerance,
        direction="info" if tolerance is None else "at_most",
        verdict="info" if tolerance is None else "pass" if known and value <= tolerance else "fail",
        t_s=t_s if known else None,
    )


def invariants_of(vector: ParameterVector, motion: Rollout | None, unit: str, here: str) -> Iterator[Metric]:
    """Yield each invariant along the replay; null with a reason if it does not apply.

    `vector` has the parameter values of the motion, `unit` is the unit of the positions, `here` describes the motion.
    """
    if motion is None:
        for name, of_its_own in INVARIANTS.items():
            yield measured(name, here, np.inf, of_its_own or unit, reason=NO_REPLAY)
        return
    positions, (lower, upper) = motion.xs[:, : vector.model.nq], vector.model.position_limits
    limits = (positions <= lower) | (positions >= upper)
    # Joint limits are implicit: a limit acts in the step before it is reached.
    held = np.array([bool(c) for c in motion.contacts]) | np.any(limits, axis=1)[1:]
    free = int(np.argmax(held)) if held.any() else len(held)  # steps from the start without contact or limits
    yield from _energy(motion, free, here)
    yield from _momentum(vector, motion, free)
    yield _worst("penetration", f"largest overlap of two geometries {here}", "m", motion, motion.penetration)
    definition = f"largest excess over a joint limit, or of a quaternion's norm over 1, {here}"
    untold = "the plant has constraints (couplers, balls, welds), whose violation pydrake does not tell"
    yield _worst("limit violation", definition, unit, motion, motion.constraint_violation, untold)
    yield _friction_cone(vector, motion, here)


def _worst(name: str, definition: str, unit: str, motion: Rollout, values: Array, reason: str = "not finite") -> Metric:
    k = int(np.argmax(values))
    return measured(name, definition, float(values[k]), unit, reason=reason, t_s=float(motion.times[k]))


def _energy(motion: Rollout, free: int, here: str) -> Iterator[Metric]:
    """Yield the drift and oscillation of the energy that neither actuators nor damping explain, in the free part."""
    error = motion.energy_error[: free + 1]
    where = f"over the {free} steps from the start without contact, {here}"
    lasting = swing = math.inf
    if free > 0:
        lasting = drift(error)
        swing = float(np.abs(error - smooth_mean(error) - lasting * np.linspace(-0.5, 0.5, len(error))).max())
    definition = f"lasting part of the energy that neither actuators nor damping explain, {where}"
    yield measured("free-motion energy drift", definition, lasting, "J", reason=NEVER_FREE)
    definition = f"largest distance of that energy from its drift line, {where}"
    yield measured("free-motion energy oscillation", definition, swing, "J", reason=NEVER_FREE)


def _momentum(vector: ParameterVector, motion: Rollout, free: int) -> Iterator[Metric]:
    """Yield the errors of the linear momentum, without gravity's impulse, and of the spin about the mass centre."""
    linear = angular = math.inf
    reason = _why_not_conserved(vector.model, free)
    if not reason:
        reason = "not finite"
        with applied(vector) as model:
            linear, angular = _momentum_errors(model, motion, free)
    definition = "largest change of the linear momentum beyond gravity's, in free motion"
    yield measured("linear momentum error", definition, linear, "N s", reason=reason)
    definition = "largest change of the angular momentum about the centre of mass, in free motion"
    yield measured("angular momentum error", definition, angular, "N m s", reason=reason)


def _why_not_conserved(model: Model, free: int) -> str:
    """Return the reason why the model does not conserve momentum, or "" if it does."""
    for joint in joints(model.plant):
        holds = model.plant.IsAnchored(joint.parent_body()) and not model.plant.IsAnchored(joint.child_body())
        if holds and joint.type_name() not in FLOATING:
            return f"{joint.name()} holds the model to the world, which takes up momentum"
        if joint.type_name() in FLOATING and np.any(np.asarray(joint.default_damping_vector()) != 0):
            return f"{joint.name()} is damped, which takes momentum away"
    return "" if free > 0 else NEVER_FREE


def _momentum_errors(model: Model, motion: Rollout, free: int) -> tuple[float, float]:
    plant, context = model.plant, model.double.context
    linear, angular = [], []
    moving = [body for body in bodies(plant) if not plant.IsAnchored(body)]
    masses = np.array([body.get_mass(context) for body in moving])
    for x in motion.xs[: free + 1]:
        set_state(model.double, x)
        centres = [plant.EvalBodyPoseInWorld(context, b) @ b.CalcCenterOfMassInBodyFrame(context) for b in moving]
        centre = masses @ np.array(centres) / masses.sum()
        momentum = plant.CalcSpatialMomentumInWorldAboutPoint(context, centre)
        linear.append(np.asarray(momentum.translational()))
        angular.append(np.asarray(momentum.rotational()))
    pull = masses.sum() * np.asarray(plant.gravity_field().gravity_vector())
    change = np.array(linear) - linear[0] - motion.times[: free + 1, None] * pull
    return float(np.abs(change).max()), float(np.abs(np.array(angular) - angular[0]).max())


def _friction_cone(vector: ParameterVector, motion: Rollout, here: str) -> Metric:
    """Compute the largest excess of a tangential contact force over the limit of Coulomb friction."""
    name, definition = "friction-cone excess", f"largest |f_t| - mu f_n of a contact's force {here}"
    if any(parameter.name.endswith(".friction") for parameter in vector.parameters):
        return measured(name, definition, np.inf, "N", reason="friction is a parameter here, not the contract's")
    coefficients: dict[str, set[Any]] = {}
    for geometry in vector.model.contract.geometries:
        coefficients.setdefault(geometry.body, set()).add(geometry.friction)
    known = {body: of_body.pop() for body, of_body in coefficients.items() if len(of_body) == 1}
    worst, when = -np.inf, 0.0
    for time, contacts in zip(motion.times, motion.contacts, strict=False):
        for contact in contacts:
            a, b = known.get(contact.body_a), known.get(contact.body_b)
            if a is None or b is None:
                pair = f"{contact.body_a} and {contact.body_b}"
                return measured(name, definition, np.inf, "N", reason=f"the friction between {pair} is not one number")
            mu = 2 * a * b / (a + b) if a + b else 0.0  # Drake's coefficient for two bodies
            push = float(contact.force @ contact.normal)
            excess = float(np.linalg.norm(contact.force - push * contact.normal)) - mu * push
            if excess > worst:
                worst, when = excess, float(time)
    return measured(name, definition, worst, "N", reason="nothing touches", t_s=when)

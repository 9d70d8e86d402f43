"""Continuation through contact, for an initial guess that makes no contact.

Bodies that do not touch have no gradient. `solve_continuation` therefore first solves the same problem with contact
that acts at a distance, either on the plant with an added force (`soft_contact`) or by inverse dynamics (`relaxed`).
The distance shrinks in each stage. A stage only warm-starts the next one, so that the schedule continues if it fails.
The true plant tracks each relaxed stage under feedback, and its own search starts from the motion that tracks best.
"""

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.clock import TimeIsUpError, noted_interrupts, now, until_set
from drake_diff._base.values import Refusal
from drake_diff.exceptions import GradientError, InputError, NonFiniteError, SimulationError
from drake_diff.model.contact import SoftContact, distances, separations, softened, thinnest_geometry
from drake_diff.model.plant import bodies
from drake_diff.model.step import advance, set_state
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.policy import TVLQR
from drake_diff.motion.rollout import roll_states
from drake_diff.optimize.ilqr.expansion import off_bounds
from drake_diff.optimize.ilqr.ilqr import solve_ilqr
from drake_diff.optimize.ilqr.through_contact import (
    PATIENCE,
    cost_of,
    miss_of,
    solve_through_jumps,
    where_it_jumps,
)
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits, NlpResult, Outcome, Report
from drake_diff.optimize.relaxed_contact import RelaxedPlant, RelaxedSearch, Softness, relaxed_plant


@dataclass(frozen=True)
class SoftOptions:
    """Options of the stages on a plant with an added force that acts at a distance."""

    iterations: int = 30  # per stage
    tolerance: float = 1e-4  # per stage, as a stage is only the initial guess of the next one
    reach: float = 3.0  # first distance = gap / reach; the force across the gap is then e^-3 = 5 % of that at contact
    shorter: float = 3.0  # each distance is the previous one divided by this number
    # No distance is shorter than a step at the speed 4 L / T across the gap L: contact would only be met by chance.
    fastest: float = 4.0
    # h^2 k / m of the stiffest stage. At 4 the explicit force is unstable. A weak force leaves the load to true
    # contact, which is discontinuous, and the stage is then as rough as the true plant.
    largest_stiffness: float = 0.4
    nudge: float = 10.0  # displacement, in gaps, by the force at x0 if it acted for the whole horizon


@dataclass(frozen=True)
class RelaxedOptions:
    """Options of the stages by inverse dynamics with relaxed contact."""

    stages: int = 5  # each reach is half of the previous one
    iterations: int = 60  # per stage
    reach: tuple[float, float] = (0.01, 0.1)  # [m] bounds of the first stage's reach
    nearest: float = 6.0  # without contact, the first reach is the smallest gap divided by this number
    slip: float = 0.1  # [m/s] slip speed of the friction law in the first stage
    least_slip: float = 0.02  # [m/s] smallest slip speed of all stages
    rebound: float = 0.1  # [m/s] bodies that separate faster than twice this speed do not push each other
    share: float = 1 / 3  # force on a body at first contact, as a fraction of its weight
    without_gravity: float = 1.0  # [m/s^2] in place of gravity if the model has none
    # Regulator cost of an input's full range; a state's full range costs 1. The last weight disables the feedback.
    weights: tuple[float, ...] = (0.1, 10.0, 1e9)


SOFT, RELAXED = SoftOptions(), RelaxedOptions()
FORMS = 'None, "auto", "relaxed" or a SoftContact for each stage'
Stages = tuple[SoftContact, ...] | RelaxedPlant


@dataclass(frozen=True)
class StageLog:
    """The log of one stage of a continuation.

    `distance` [m] and `stiffness` [N/m] belong to a SoftContact or to relaxed contact, as `kind` says. They are None
    for the true plant. `status` is an outcome of iLQR or "refused: ...". `goal_error` is that of the stage's own
    motion, and `gradient` is that of its last step.
    """

    kind: str
    number: int
    distance: float | None
    stiffness: float | None
    status: str
    iterations: int
    cost: float | None
    goal_error: float | None
    gradient: float | None

    def __str__(self) -> str:
        contact = "the true plant"
        if self.distance is not None:
            contact = f"{self.kind}, distance {self.distance:.3g} m, stiffness {self.stiffness:.3g} N/m"
        numbers = "" if self.cost is None else f", cost {self.cost:.6g}, goal error {self.goal_error:.2g}"
        return f"stage {self.number}: {contact}: {self.status} after {self.iterations} steps{numbers}"


def solve_continuation(
    problem: Problem, xs: Array, us: Array, stages: Stages, *, limits: Limits, report: Report | None
) -> tuple[NlpResult, Array, Array, tuple[StageLog, ...]]:
    """Solve `problem` by iLQR through the `stages` and then on the true plant, from xs (N+1, nx) and us (N, nu).

    SoftContact stages start from the inputs, and relaxed stages start from the positions. Returns the result, states
    and inputs of `solve_ilqr` on the true plant, and a log for each stage. `limits.time_limit` applies to all stages
    together. If it or Ctrl-C ends a stage, the other stages are skipped, and the motion is the true plant's rollout.
    Raises GradientError or SimulationError if a step of the true plant fails or has no derivative.
    """
    with noted_interrupts() as interrupted:
        through = _Stages(problem, limits, report, interrupted)
        if isinstance(stages, RelaxedPlant):
            through.relax(xs, us, stages)
        else:
            through.soften(us, stages)
        if through.ended is None:
            result = through.on_the_true_plant()
        else:
            message = f"iLQR: {through.ended.value} in stage {len(through.logs)}"
            result = NlpResult(through.us.ravel(), through.ended, message, ())
    return result, through.xs, through.us, tuple(through.logs)


class _Stages:
    """A sequence of stages. `xs`, `us` are the true plant's motion so far, and `ended` is why no further stage runs."""

    def __init__(self, problem: Problem, limits: Limits, report: Report | None, interrupted: threading.Event):
        self.problem, self.limits, self.report, self.interrupted = problem, limits, report, interrupted
        self.deadline, self.logs = now() + limits.time_limit, list[StageLog]()
        self.xs, self.us, self.ended = np.empty(0), np.empty(0), None

    xs: Array
    us: Array
    ended: Outcome | None

    def is_over(self) -> bool:
        return self.interrupted.is_set() or now() > self.deadline

    def log(self, *entries: Any, kind: str = "true plant") -> None:
        self.logs.append(StageLog(kind, len(self.logs) + 1, *entries))
        self._say(str(self.logs[-1]))

    def soften(self, us: Array, stages: Sequence[SoftContact]) -> None:
        """Run the stages by iLQR on the plant with an added force that acts at a distance."""
        problem, limits, x0 = self.problem, self.limits, np.array(self.problem.x0)
        for contact in stages:
            softer = replace(problem, system=softened(problem.model, contact))
            iterations, tolerance = min(SOFT.iterations, limits.max_iterations), max(SOFT.tolerance, limits.tolerance)
            short = Limits(iterations, self.deadline - now(), tolerance)
            record: tuple[Any, ...]
            try:
                xs = roll_states(softer.model, x0, us)
                result, xs, us = solve_ilqr(softer, xs, us, limits=short, report=self.report, patience=PATIENCE)
                x0, outcome, record = xs[0], result.outcome, _stage_record(softer, result, xs, us)
            except (GradientError, SimulationError) as error:
                outcome, record = Outcome.NO_GRADIENT, (f"refused: {error}", 0, None, None, None)
            self.log(contact.distance, contact.stiffness, *record, kind="softened")
            if self.interrupted.is_set() or outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT):
                self.ended = Outcome.TIME_LIMIT if outcome is Outcome.TIME_LIMIT else Outcome.INTERRUPTED
                break
        self.xs, self.us = roll_states(problem.model, x0, us), us

    def relax(self, xs: Array, us: Array, plant: RelaxedPlant) -> None:
        """Run the relaxed stages from xs (N+1, nx), then keep the true plant's motion that tracks a stage best."""
        problem, followed = self.problem, list[tuple[float, Array, Array]]()
        try:
            with until_set(self.interrupted):
                self._relax(xs, plant, followed)
        except TimeIsUpError:
            self._say("the remaining relaxed stages are skipped")
        if followed:
            _, self.xs, self.us = min(followed, key=lambda start: start[0])
        else:
            refusal = "refused: the true plant follows no relaxed stage"
            self.log(None, None, refusal, 0, None, None, None, kind="relaxed")
            self.xs, self.us = roll_states(problem.model, problem.x0, us), us
        if self.is_over():
            self.ended = Outcome.INTERRUPTED if self.interrupted.is_set() else Outcome.TIME_LIMIT

    def _relax(self, xs: Array, plant: RelaxedPlant, followed: list[tuple[float, Array, Array]]) -> None:
        """Append (distance from the stage, xs, us) to `followed` for each true-plant motion that tracks a stage."""
        problem, nq = self.problem, self.problem.model.nq
        search = RelaxedSearch(problem, plant)
        q = np.array(xs[:, :nq])
        q[0] = problem.x0[:nq]
        for i, _ in plant.coordinates.free:
            q[:, i : i + 4] /= np.linalg.norm(q[:, i : i + 4], axis=1, keepdims=True)
        for softness in relaxed_schedule(problem, plant):
            result = search.run(q, softness, RELAXED.iterations, self.is_over, self._say)
            q, states = result.motion.q, result.motion.xs
            stiffness = float(np.max(softness.force)) / (softness.reach * math.log(2))
            numbers = result.ended, result.iterations, result.cost, miss_of(problem, states), None
            self.log(softness.reach, stiffness, *numbers, kind="relaxed")
            for weight in RELAXED.weights:
                motion = follow(problem, states, result.motion.us, weight)
                if motion is not None:
                    off = np.mean(((motion[0] - states) / problem.state_scales(states)) ** 2)
                    followed.append((float(off) + result.gap + result.violation, *motion))
            if self.is_over():
                break

    def _say(self, line: str) -> None:
        if self.report:
            self.report.say(line)

    def on_the_true_plant(self) -> NlpResult:
        """Solve on the true plant, store its motion in `xs` and `us`, and return the result."""
        problem, limits = self.problem, self.limits
        left = replace(limits, time_limit=self.deadline - now())
        try:
            result, xs, us = solve_through_jumps(problem, self.xs, self.us, limits=left, report=self.report)
        except (GradientError, SimulationError) as error:
            self.log(None, None, f"refused: {error}", 0, None, None, None)
            outcome = Outcome.NO_GRADIENT if isinstance(error, GradientError) else Outcome.DIVERGED
            message = f"iLQR: the true plant refuses the motion of the last stage: {error}"
            return NlpResult(self.us.ravel(), outcome, message, ())
        self.log(None, None, *_stage_record(problem, result, xs, us))
        if result.outcome in (Outcome.INACCURATE, Outcome.ITERATION_LIMIT, Outcome.INFEASIBLE):
            result = replace(result, message=result.message + where_it_jumps(problem, xs))
        self.xs, self.us = xs, us
        return result


def check_schedule(problem: Problem, continuation: Any) -> Stages:
    """Return the stages for "auto", "relaxed" or a sequence of SoftContacts, or raise InputError."""
    if isinstance(continuation, str) and continuation == "auto":
        return default_schedule(problem)
    if isinstance(continuation, str) and continuation == "relaxed":
        return read_relaxed_plant(problem)
    given = tuple(continuation) if isinstance(continuation, Sequence) else ()
    if not given or not all(isinstance(stage, SoftContact) for stage in given):
        raise InputError("continuation", got=repr(continuation), expected=FORMS)
    softened(problem.model, given[0])
    return given


def default_schedule(problem: Problem) -> tuple[SoftContact, ...]:
    """Choose stages from the model's sizes and masses and from the problem's start and duration.

    The reach L is the largest gap at x0 between two bodies that may collide, or half of the smallest thickness of a
    collision geometry if that is larger. The distances are L/3, L/9, ..., down to 4 L / num_steps, the motion in one
    step at the speed 4 L / T. The stiffness is such that the force at L alone would move m, the lightest mass of a pair
    that can approach, by 10 L in the whole time T. It is at most 0.4 m / h^2, where h is the time step.
    """
    model = problem.model
    softened(model, SoftContact(1.0, 1.0))  # raises if the model does not support soft contact
    set_state(model.double, problem.x0)
    mass = min((1 / pair.mobility for pair in separations(model.double) if pair.mobility > 0), default=math.inf)
    if not math.isfinite(mass):
        raise InputError("x0", got="no such pair", expected="a state in which a collision pair can approach")
    reach = max(*distances(model.double).values(), thinnest_geometry(model)[0] / 2)
    duration, stiffest = problem.num_steps * model.time_step, SOFT.largest_stiffness * mass / model.time_step**2
    stages: list[SoftContact] = []
    sigma = reach / SOFT.reach
    while not stages or sigma >= SOFT.fastest * reach / problem.num_steps:
        unit = SoftContact(float(sigma), 1.0)
        nudge = SOFT.nudge * 2 * mass * reach / duration**2 / unit.normal_force(reach)
        stages.append(replace(unit, stiffness=float(min(stiffest, nudge))))
        sigma /= SOFT.shorter
    return tuple(stages)


def read_relaxed_plant(problem: Problem) -> RelaxedPlant:
    """Return the model data of the relaxed stages, or raise InputError if they do not support the problem or model."""
    if not problem.initial_state_is_given:
        raise InputError("continuation", got="'relaxed' with a free initial state", expected="a given initial state")
    plant = problem.model.cache("relaxed plant", lambda: relaxed_plant(problem.model))
    if isinstance(plant, Refusal):
        raise InputError("continuation", got=f"'relaxed': {plant.reason}", expected="another model, or 'auto'")
    if not plant.pairs.ids:
        raise InputError(
            "continuation", got="'relaxed'", expected="'auto', as no sphere of the model has a collision pair"
        )
    return plant


def relaxed_schedule(problem: Problem, plant: RelaxedPlant) -> tuple[Softness, ...]:
    """Choose relaxed stages from the model's sizes and masses.

    The first reach is half of the smallest thickness or a sixth of the smallest gap, whichever is larger. The force at
    first contact is a third of the lighter body's weight, and no contact is stiffer than the model's own.
    """
    model = problem.model
    gap = float(np.min(plant.distances(problem.x0[None, : model.nq])))
    first = float(np.clip(max(thinnest_geometry(model)[0] / 2, gap / RELAXED.nearest), *RELAXED.reach))
    weight, stiffest, schedule = _weights(problem, plant) * RELAXED.share, plant.material.stiffness * np.log(2), []
    for number in range(RELAXED.stages):
        reach = first / 2**number
        force, slip = np.minimum(weight, stiffest * reach), max(RELAXED.least_slip, RELAXED.slip / 2**number)
        schedule.append(Softness(reach, force, slip, RELAXED.rebound))
    return tuple(schedule)


def _weights(problem: Problem, plant: RelaxedPlant) -> Array:
    """Return (P,) [N] the weight of the lighter tree of each pair, with 1 m/s^2 in place of zero gravity."""
    drake, mass = problem.model.plant, dict[int, float]()  # keyed by the tree's first degree of freedom

    def tree(body: Any) -> int | None:
        moving = np.flatnonzero(plant.moving(body))
        return int(moving[0]) if len(moving) else None

    for body in bodies(drake):
        first = tree(body)
        if first is not None:
            mass[first] = mass.get(first, 0.0) + float(body.default_mass())
    acceleration = float(np.linalg.norm(drake.gravity_field().gravity_vector())) or RELAXED.without_gravity
    trees = [tree(body) for body in plant.pairs.bodies]
    pairs = zip(plant.pairs.sphere_body, plant.pairs.other_body, strict=True)
    lighter = [min(mass[first] for i in pair if (first := trees[i]) is not None) for pair in pairs]
    return np.array(lighter) * acceleration


def follow(problem: Problem, xs: Array, us: Array, weight: float) -> tuple[Array, Array] | None:
    """Return the true plant's motion that tracks xs (N+1, nx), us (N, nu) under TVLQR, or None if a step fails.

    States are weighted by their ranges along xs, and inputs by their ranges and `weight`.
    """
    bounds, model = problem.bounds, problem.model
    us = np.clip(us, bounds.u_lower, bounds.u_upper)
    limit = np.minimum(np.abs(bounds.u_lower), np.abs(bounds.u_upper))
    size = np.where(np.isfinite(limit), limit, np.maximum(np.max(np.abs(us), axis=0), 1.0))
    Q, R = np.diag(1 / tangent_space(model).scale(problem.state_scales(xs)) ** 2), np.diag(weight / size**2)
    try:
        regulator = TVLQR(model, xs, off_bounds(bounds, us), Q, R)
        states, inputs = np.array(xs), np.array(us)
        states[0] = problem.x0
        for k in range(len(us)):
            inputs[k] = np.clip(regulator(states[k], k * model.time_step), bounds.u_lower, bounds.u_upper)
            states[k + 1] = advance(model.double, states[k], inputs[k])
    except (GradientError, SimulationError, NonFiniteError):
        return None
    return (states, inputs) if np.all(np.isfinite(states)) else None


def _stage_record(
    problem: Problem, result: NlpResult, xs: Array, us: Array
) -> tuple[str, int, float | None, float | None, float | None]:
    """Return the status, iterations, cost, goal error and gradient of a stage for its log."""
    last = result.iterations[-1]
    numbers = cost_of(problem, result, xs, us), miss_of(problem, xs), last.dual_infeasibility
    cost, error, gradient = (value if math.isfinite(value) else None for value in numbers)
    return result.outcome.value, last.iteration, cost, error, gradient

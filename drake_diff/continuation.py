"""Trajectory optimization through contact from a guess that does not touch, by a schedule of softer contacts.

What does not touch has no gradient. So iLQR solves a row of problems: the same plant with a force at a distance added
(`soft_contact`), of a shorter reach in each stage, and in the last one the true plant. Each stage starts from the
inputs that the one before found, and only warms up the next: it is short, and the schedule goes on where one fails.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from drake_diff.arrays import Array
from drake_diff.contact_sequence import PATIENCE, solve_through_jumps
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.goal_restoration import restore_goal
from drake_diff.ilqr import solve_ilqr
from drake_diff.nonlinear_program import Limits, NlpResult, Outcome, Report, interrupt_flag
from drake_diff.problem import Problem
from drake_diff.rollout import roll_states
from drake_diff.soft_contact import SoftContact, approaches, distances, smallest_half_width, softened
from drake_diff.step import set_state

STAGE_ITERATIONS, STAGE_TOLERANCE = 30, 1e-4  # a stage is a guess for the next: no more than that is asked of it
REACH = 3.0  # the first distance is this part of the gap, where the force is e^-3 = 5 % of that at touching
SHORTER = 3.0  # each distance is this part of the one before
# No distance is shorter than what crosses the gap L at 4 L / T moves in a step: it would be met only by chance.
FASTEST = 4.0
# h^2 k / m of the stiffest stage: at 4 the explicit force is unstable; where it is weak, true contact, which jumps,
# does the work, and the stage is as rough as the true plant.
LARGEST_STIFFNESS = 0.4
JUST_TOUCHING = 2e-5  # [m], beyond the margin of `contact_sequence`; what rests on something presses further into it
NUDGE = 10.0  # how many gaps the force at x0 alone would move what it acts on, were it to last


@dataclass(frozen=True)
class StageLog:
    """What one stage did; `distance` [m] and `stiffness` [N/m] are None for the true plant.

    `status` is an outcome of iLQR or "refused: ..."; `goal_error` is the stage's own and `gradient` that of
    its last step.
    """

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
            contact = f"distance {self.distance:.3g} m, stiffness {self.stiffness:.3g} N/m"
        numbers = "" if self.cost is None else f", cost {self.cost:.6g}, goal error {self.goal_error:.2g}"
        return f"stage {self.number}: {contact}: {self.status} after {self.iterations} steps{numbers}"

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def check_schedule(problem: Problem, continuation: Any) -> tuple[SoftContact, ...]:
    """The stages before the true plant, from "auto" or a sequence of SoftContacts; refuses what cannot be softened."""
    if isinstance(continuation, str) and continuation == "auto":
        return default_schedule(problem)
    given = tuple(continuation) if isinstance(continuation, Sequence) else ()
    if not given or not all(isinstance(stage, SoftContact) for stage in given):
        raise InputError("continuation", got=repr(continuation), expected='None, "auto" or SoftContacts, one a stage')
    softened(problem.model, given[0])
    return given


def default_schedule(problem: Problem) -> tuple[SoftContact, ...]:
    """Stages from the model's sizes and masses, the problem's start and duration.

    The reach L is the largest gap at x0 between two bodies that may collide, or the smallest half width of what
    collides where that is more. The distances are L/3, L/9, ..., down to 4 L / num_steps, what moves at
    4 L / T passes in a step. The stiffness is such that the force at L alone would move the lightest of what can
    approach each other, its mass m, by 10 L in the whole time T; but no more than 0.4 m / h^2, h being the time step.
    """
    model = problem.model
    softened(model, SoftContact(1.0, 1.0))  # refuses what cannot be
    set_state(model.double, problem.x0)
    mass = min((1 / mobility for mobility in approaches(model.double) if mobility > 0), default=math.inf)
    if not math.isfinite(mass):
        raise InputError("x0", got="nothing that may collide can approach", expected="a pair that can")
    reach = max(*distances(model.double).values(), smallest_half_width(model.double))
    duration, stiffest = problem.num_steps * model.time_step, LARGEST_STIFFNESS * mass / model.time_step**2
    stages: list[SoftContact] = []
    sigma = reach / REACH
    while not stages or sigma >= FASTEST * reach / problem.num_steps:
        unit = SoftContact(float(sigma), 1.0)
        nudge = NUDGE * 2 * mass * reach / duration**2 / unit.normal_force(reach)
        stages.append(replace(unit, stiffness=float(min(stiffest, nudge))))
        sigma /= SHORTER
    return tuple(stages)


def solve_continuation(
    problem: Problem, us: Array, stages: Sequence[SoftContact], *, limits: Limits, report: Report | None
) -> tuple[NlpResult, Array, Array, tuple[StageLog, ...]]:
    """Solve `problem` by iLQR through the `stages` and then on the true plant, from us (N, nu).

    Gives what `solve_ilqr` gives, of the true plant, and a log for each stage. `limits.time_limit` is that of all
    stages together; where it or Ctrl-C ends one, the rest are left out and the motion is the true plant's rollout. A
    search that ends short of a minimum is taken to the goal by `restore_goal`, which its message says.
    Raises GradientError or SimulationError where the true plant refuses.
    """
    start, logs, x0 = time.monotonic(), list[StageLog](), np.array(problem.x0)

    def is_over() -> bool:
        return interrupted.is_set() or time.monotonic() - start > limits.time_limit

    with interrupt_flag() as interrupted:
        for contact in stages:
            left = limits.time_limit - (time.monotonic() - start)
            short = Limits(min(STAGE_ITERATIONS, limits.max_iterations), left, max(STAGE_TOLERANCE, limits.tolerance))
            soft = replace(problem, model=softened(problem.model, contact))
            x0, us, log, outcome = _take_stage(soft, x0, us, short, report, len(logs) + 1, contact)
            _add(logs, log, report)
            if interrupted.is_set() or outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT):
                outcome = Outcome.TIME_LIMIT if outcome is Outcome.TIME_LIMIT else Outcome.INTERRUPTED
                xs = roll_states(problem.model, x0, us)
                message = f"iLQR: {outcome.value} in stage {len(logs)}"
                return NlpResult(us.ravel(), outcome, message, ()), xs, us, tuple(logs)
        left = limits.time_limit - (time.monotonic() - start)
        xs = roll_states(problem.model, x0, us)
        result, xs, us = solve_through_jumps(problem, xs, us, limits=replace(limits, time_limit=left), report=report)
        _add(logs, _log(problem, len(logs) + 1, None, result, xs, us), report)
        if result.outcome in (Outcome.INACCURATE, Outcome.ITERATION_LIMIT, Outcome.INFEASIBLE):
            xs, us, done = restore_goal(problem, xs, us, limits.tolerance, is_over)
            message, outcome = result.message + _where_it_jumps(problem, xs) + done, result.outcome
            if outcome is Outcome.INFEASIBLE and np.abs(problem.goal_error(xs[-1])).max() <= limits.tolerance:
                outcome = Outcome.INACCURATE  # state bounds are measured again by the verdict
            result = replace(result, z=us.ravel(), outcome=outcome, message=message)
            if done and report:
                report.say(done.removeprefix("; "))
    return result, xs, us, tuple(logs)


def _where_it_jumps(problem: Problem, xs: Array) -> str:
    """Where along xs (N+1, nx) two bodies are just touching, and what that means; empty where none are."""
    for k, x in enumerate(xs[:-1]):
        set_state(problem.model.double, x)
        for (a, b), distance in distances(problem.model.double).items():
            if abs(distance) < JUST_TOUCHING:
                return (
                    f", with {a} and {b} just touching at knot {k}: the step jumps there, and a minimum at a jump "
                    "has no gradient to tell it by"
                )
    return ""


def _add(logs: list[StageLog], log: StageLog, report: Report | None) -> None:
    logs.append(log)
    if report:
        report.say(str(log))


def _take_stage(
    soft: Problem, x0: Array, us: Array, limits: Limits, report: Report | None, number: int, contact: SoftContact
) -> tuple[Array, Array, StageLog, Outcome]:
    """The first state and the inputs that a stage finds, those given where it is refused."""
    try:
        xs = roll_states(soft.model, x0, us)
        result, xs, found = solve_ilqr(soft, xs, us, limits=limits, report=report, patience=PATIENCE)
    except (GradientError, SimulationError) as error:
        log = StageLog(number, contact.distance, contact.stiffness, f"refused: {error}", 0, None, None, None)
        return x0, us, log, Outcome.NO_GRADIENT
    return xs[0], found, _log(soft, number, contact, result, xs, found), result.outcome


def _log(
    problem: Problem, number: int, contact: SoftContact | None, result: NlpResult, xs: Array, us: Array
) -> StageLog:
    last = result.iterations[-1]
    numbers = problem.objective(xs, us), float(np.abs(problem.goal_error(xs[-1])).max()), last.dual_infeasibility
    cost, error, gradient = (value if math.isfinite(value) else None for value in numbers)
    distance, stiffness = (None, None) if contact is None else (contact.distance, contact.stiffness)
    return StageLog(number, distance, stiffness, result.outcome.value, last.iteration, cost, error, gradient)

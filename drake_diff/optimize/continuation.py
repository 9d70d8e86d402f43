"""Plans through contact from a guess that makes none: stages of softer contact, then the true plant.

What does not touch has no gradient. So `solve_continuation` first solves the same problem with contact at a distance:
on the plant with a force added (`soft_contact`), or by inverse dynamics (`relaxed`), of a shorter reach in each stage.
A stage only warms up the next: the schedule goes on if it fails.
"""

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.clock import noted_interrupts, now, until_set
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.model.contact import SoftContact, distances, separations, softened, thinnest_geometry
from drake_diff.model.step import set_state
from drake_diff.motion.rollout import roll_states
from drake_diff.optimize.ilqr.ilqr import solve_ilqr
from drake_diff.optimize.ilqr.through_contact import (
    PATIENCE,
    cost_of,
    miss_of,
    restore_goal,
    solve_through_jumps,
    where_it_jumps,
)
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits, NlpResult, Outcome, Report
from drake_diff.optimize.relaxed.plant import RelaxedPlant, Softness
from drake_diff.optimize.relaxed.search import Found
from drake_diff.optimize.relaxed.stages import describe, solve_relaxed

STAGE_ITERATIONS, STAGE_TOLERANCE = 30, 1e-4  # a stage is a guess for the next: no more than that is asked of it
REACH = 3.0  # the first distance is this part of the gap, where the force is e^-3 = 5 % of that at touching
SHORTER = 3.0  # each distance is this part of the one before
# No distance is shorter than what crosses the gap L at 4 L / T moves in a step: it would be met only by chance.
FASTEST = 4.0
# h^2 k / m of the stiffest stage: at 4 the explicit force is unstable; where it is weak, true contact, which jumps,
# does the work, and the stage is as rough as the true plant.
LARGEST_STIFFNESS = 0.4
NUDGE = 10.0  # how many gaps the force at x0 alone would move what it acts on, were it to last
FORMS = 'None, "auto", "relaxed" or SoftContacts, one a stage'
Stages = tuple[SoftContact, ...] | RelaxedPlant


@dataclass(frozen=True)
class StageLog:
    """What one stage did; `distance` [m] and `stiffness` [N/m] are None for the true plant.

    They are those of a SoftContact, or of relaxed contact, which `kind` says.

    `status` is an outcome of iLQR or "refused: ..."; `goal_error` is the stage's own and `gradient` that of
    its last step.
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

    Stages of SoftContacts take the inputs, relaxed ones the positions. Gives what `solve_ilqr` gives, of the true
    plant, and a log for each stage. `limits.time_limit` is that of all stages together; if it or Ctrl-C ends one, the
    rest are left out and the motion is the true plant's rollout. A search that ends short of a minimum is taken to the
    goal by `restore_goal`, which its message says. Raises GradientError or SimulationError if the true plant refuses.
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
    """One stage after the other; `xs`, `us` are the motion of the true plant so far, `ended` why no other follows."""

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
        if self.report:
            self.report.say(str(self.logs[-1]))

    def soften(self, us: Array, stages: Sequence[SoftContact]) -> None:
        """By iLQR on the plant with a force at a distance beside its contact."""
        problem, limits, x0 = self.problem, self.limits, np.array(self.problem.x0)
        for contact in stages:
            softer = replace(problem, system=softened(problem.model, contact))
            iterations, tolerance = min(STAGE_ITERATIONS, limits.max_iterations), max(STAGE_TOLERANCE, limits.tolerance)
            short = Limits(iterations, self.deadline - now(), tolerance)
            record: tuple[Any, ...]
            try:
                xs = roll_states(softer.model, x0, us)
                result, xs, us = solve_ilqr(softer, xs, us, limits=short, report=self.report, patience=PATIENCE)
                x0, outcome, record = xs[0], result.outcome, _told(softer, result, xs, us)
            except (GradientError, SimulationError) as error:
                outcome, record = Outcome.NO_GRADIENT, (f"refused: {error}", 0, None, None, None)
            self.log(contact.distance, contact.stiffness, *record, kind="softened")
            if self.interrupted.is_set() or outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT):
                self.ended = Outcome.TIME_LIMIT if outcome is Outcome.TIME_LIMIT else Outcome.INTERRUPTED
                break
        self.xs, self.us = roll_states(problem.model, x0, us), us

    def relax(self, xs: Array, us: Array, plant: RelaxedPlant) -> None:
        """By inverse dynamics with relaxed contact, and where the true plant gets that follows what they find."""
        problem = self.problem

        def tell(line: str) -> None:
            if self.report:
                self.report.say(line)

        def log(soft: Softness, result: Found) -> None:
            miss = float(np.abs(problem.goal_error(result.motion.xs[-1])).max())
            stiffness = float(np.max(soft.force)) / (soft.reach * math.log(2))
            self.log(soft.reach, stiffness, result.ended, result.iterations, result.cost, miss, None, kind="relaxed")

        try:
            with until_set(self.interrupted):
                self.xs, self.us = solve_relaxed(problem, plant, xs, is_over=self.is_over, log=log, tell=tell)
        except SimulationError as error:
            self.log(None, None, f"refused: {error}", 0, None, None, None, kind="relaxed")
            self.xs, self.us = roll_states(problem.model, problem.x0, us), us
        if self.is_over():
            self.ended = Outcome.INTERRUPTED if self.interrupted.is_set() else Outcome.TIME_LIMIT

    def on_the_true_plant(self) -> NlpResult:
        """The stage whose result is told; what is found is `xs`, `us`."""
        problem, limits = self.problem, self.limits
        left = replace(limits, time_limit=self.deadline - now())
        try:
            result, xs, us = solve_through_jumps(problem, self.xs, self.us, limits=left, report=self.report)
        except (GradientError, SimulationError) as error:
            self.log(None, None, f"refused: {error}", 0, None, None, None)
            outcome = Outcome.NO_GRADIENT if isinstance(error, GradientError) else Outcome.DIVERGED
            message = f"iLQR: the motion that the stages lead to is refused on the true plant: {error}"
            return NlpResult(self.us.ravel(), outcome, message, ())
        self.log(None, None, *_told(problem, result, xs, us))
        if result.outcome in (Outcome.INACCURATE, Outcome.ITERATION_LIMIT, Outcome.INFEASIBLE):
            xs, us, done = restore_goal(problem, xs, us, limits.tolerance, self.is_over)
            message, outcome = result.message + where_it_jumps(problem, xs) + done, result.outcome
            if outcome is Outcome.INFEASIBLE and miss_of(problem, xs) <= limits.tolerance:
                outcome = Outcome.INACCURATE  # state bounds are measured again by the verdict
            result = replace(result, z=us.ravel(), outcome=outcome, message=message)
            if done and self.report:
                self.report.say(done.removeprefix("; "))
        self.xs, self.us = xs, us
        return result


def check_schedule(problem: Problem, continuation: Any) -> Stages:
    """The stages before the true plant, from "auto", "relaxed" or a sequence of SoftContacts; refuses what has none."""
    if isinstance(continuation, str) and continuation == "auto":
        return default_schedule(problem)
    if isinstance(continuation, str) and continuation == "relaxed":
        return describe(problem)
    given = tuple(continuation) if isinstance(continuation, Sequence) else ()
    if not given or not all(isinstance(stage, SoftContact) for stage in given):
        raise InputError("continuation", got=repr(continuation), expected=FORMS)
    softened(problem.model, given[0])
    return given


def default_schedule(problem: Problem) -> tuple[SoftContact, ...]:
    """Stages from the model's sizes and masses, the problem's start and duration.

    The reach L is the largest gap at x0 between two bodies that may collide, or the smallest half width of what
    collides if that is more. The distances are L/3, L/9, ..., down to 4 L / num_steps, what moves at
    4 L / T passes in a step. The stiffness is such that the force at L alone would move the lightest of what can
    approach each other, its mass m, by 10 L in the whole time T; but no more than 0.4 m / h^2, h being the time step.
    """
    model = problem.model
    softened(model, SoftContact(1.0, 1.0))  # refuses what cannot be
    set_state(model.double, problem.x0)
    mass = min((1 / pair.mobility for pair in separations(model.double) if pair.mobility > 0), default=math.inf)
    if not math.isfinite(mass):
        raise InputError("x0", got="nothing that may collide can approach", expected="a pair that can")
    reach = max(*distances(model.double).values(), thinnest_geometry(model)[0] / 2)
    duration, stiffest = problem.num_steps * model.time_step, LARGEST_STIFFNESS * mass / model.time_step**2
    stages: list[SoftContact] = []
    sigma = reach / REACH
    while not stages or sigma >= FASTEST * reach / problem.num_steps:
        unit = SoftContact(float(sigma), 1.0)
        nudge = NUDGE * 2 * mass * reach / duration**2 / unit.normal_force(reach)
        stages.append(replace(unit, stiffness=float(min(stiffest, nudge))))
        sigma /= SHORTER
    return tuple(stages)


def _told(
    problem: Problem, result: NlpResult, xs: Array, us: Array
) -> tuple[str, int, float | None, float | None, float | None]:
    """Status, iterations, cost, goal error and gradient of a stage, for its log."""
    last = result.iterations[-1]
    numbers = cost_of(problem, result, xs, us), miss_of(problem, xs), last.dual_infeasibility
    cost, error, gradient = (value if math.isfinite(value) else None for value in numbers)
    return result.outcome.value, last.iteration, cost, error, gradient

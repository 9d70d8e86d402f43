"""Replays of a solution in plants that had no part in it: continuous time, and other simulators.

TVLQR with the gains of the plan's own steps follows it, and each command is held over one of them, as a robot would be
driven; where that does not lead to the goal, the inputs alone are tried. No verdict rests on these replays.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.engines.contract import is_another_model, match_contracts
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.interface import Engine
from drake_diff.engines.load import load_engine
from drake_diff.exceptions import InputError, MissingDependencyError, ModelError, SimulationError
from drake_diff.model.contact import penetration
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, select
from drake_diff.model.step import set_state
from drake_diff.motion.continuous import replayed
from drake_diff.motion.rollout import CONTINUOUS, Policy, rollout
from drake_diff.optimize.checks import Check, check
from drake_diff.optimize.replay import (
    BROKEN,
    FEEDBACK,
    OPEN_LOOP,
    STATE_TOLERANCE,
    MeasuredMotion,
    Replay,
    ReplayPlan,
    deciding,
    energy_check,
    measured_replay,
    missing_replay,
    motion_checks,
    regulator,
    replays,
    track,
)
from drake_diff.optimize.solution import Solution

SIMULATORS = ("mujoco",)
NOT_INSTALLED = "it is not installed: "  # the failure of a simulator begins so
IN_CONTINUOUS_TIME = "in continuous time"
# Another simulator has other laws of contact and of joint limits: it may end and stray twice as far.
WIDER = 2.0
TOLERANCE = 1e-6  # of each step of the integration: the motion is judged to 5 %
EVALUATIONS = 150_000  # of the equations of motion; stiffer ones are followed in the short steps instead
SHORT = 1e-4  # [s] Drake's steps where there is no motion in continuous time
LONGEST = 1e-3  # [s] a step of another simulator


def cross_check(solution: Solution, engines: Sequence[str] = SIMULATORS) -> Solution:
    """Replay a solution in continuous time and in other simulators.

    The motion in continuous time is the one that Drake's steps stand for, integrated with error control, or Drake's in
    steps of 0.1 ms where there is none. Other simulators take steps of 1 ms or less, with contacts matched to Drake's.
    What is asked is what replays are asked; in another simulator all tolerances but obstacles' are twice as wide.

    Args:
        solution: A result of `solve` for a model, of any status.
        engines: Names of simulators for `engines.load_engine`. One that is not installed or cannot have the model is
            a replay that could not be taken.

    Returns:
        The same solution with its `cross_checks`: a replay in each plant under TVLQR and, where that does not hold,
        open loop. They are among its `checks`; `save` writes them, and `verify` takes them again.

    Raises:
        InputError: The solution has no model, or is one in phases.
        UnknownNameError: There is no such simulator.

    Example:
        >>> from drake_diff.runs import cross_check
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.02)
        >>> effort = dd.QuadraticCost(R=[[1.0]])
        >>> problem = dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=25, running_cost=effort)
        >>> cross_check(dd.solve(problem, method="ilqr"), engines=()).cross_checks
        (Replay in continuous time, TVLQR: holds,)
    """
    if type(solution) is not Solution or not solution.problem.has_model:
        got = f"{type(solution).__name__} of plain dynamics" if type(solution) is Solution else type(solution)
        raise InputError("solution", got=got, expected="the Solution of a problem with a model")
    follower = PlanFollower(solution.plan, solution.replays if solution.transcribed is not None else ())
    rows = [*follower.in_continuous_time(), *(row for name in engines for row in _in_simulator(follower, name))]
    return solution.told(cross_checks=tuple(rows), options=solution.options | {"cross_check": list(engines)})


def _in_simulator(follower: "PlanFollower", name: str) -> list[Replay]:
    plan, parts = follower.plan, max(1, math.ceil(follower.period / LONGEST - 1e-9))
    try:
        if not np.array_equal(plan.vector.values, select(plan.problem.model, plan.vector.names).values):
            raise ModelError("another simulator is given the model's own parameters, and the plan has others")
        if name == "mujoco":  # which takes any step of a model that Drake has at one alone
            return replays_in(follower, load_engine(name, plan.problem.model, time_step=follower.period / parts))
        return replays_in(follower, load_engine(name, plan.problem.model.at_time_step(follower.period / parts)))
    except MissingDependencyError as error:
        why = f"{NOT_INSTALLED}{error}"
    except ModelError as error:
        why = str(error)
    return [missing_replay(plan, f"in {name}", FEEDBACK if plan.problem.model.nu else OPEN_LOOP, why)]


def replays_in(follower: "PlanFollower", engine: Engine) -> list[Replay]:
    """A plan in a simulator; what its contract has otherwise than Drake's is a check that fails."""
    model = follower.plan.problem.model
    touch = bool(model.contract.contact.collision_pairs)
    lines = [line for line in match_contracts(DrakeEngine(model), engine) if line.verdict == "different"]
    wrong = [line for line in lines if is_another_model(line, touch) and line.quantity != "time step"]
    unlike = [check("model", f"{line.quantity}: {line.detail}", np.inf, 0.0) for line in wrong]
    return follower.in_engine(f"{engine.name} {engine.version}", engine.step, engine.contract.time_step, unlike)


@dataclass(frozen=True, eq=False)
class _Moved:
    """A `Motion` of another simulator."""

    times: Array
    xs: Array
    us: Array
    penetration: Array


Mover = Callable[
    [Policy], tuple[MeasuredMotion, list[Check]]
]  # a motion under a law, and what is checked of it besides


class PlanFollower:
    """Follows a plan with the feedback of its own steps in other plants.

    `period` [s] is the step of the plan's own controller, and `parts` how many of them an interval of the plan has: of
    a collocated one, whose intervals need not be steps, the first in which it has to hold (by its replays `known`).
    """

    def __init__(self, plan: ReplayPlan, known: Sequence[Replay] = ()):
        self.plan, self.parts = plan, 1
        if plan.continuous and plan.problem.motion != CONTINUOUS:
            known = known or replays(plan)
            named = [r for r in known if r.variant in deciding(plan, known)]
            self.parts = round(plan.time_step / named[0].time_step) if named else 1
        self.period = plan.time_step / self.parts
        self.xs, self.us = plan.sample(self.parts)
        self._gains: Array | None = None
        self.controls = (FEEDBACK, OPEN_LOOP) if plan.problem.model.nu else (OPEN_LOOP,)

    def in_continuous_time(self) -> list[Replay]:
        """In the continuous time that Drake's steps stand for, by error control; in short steps where it has none."""

        def move(law: Policy) -> tuple[MeasuredMotion, list[Check]]:
            model = self.plan.model_at(self.parts)
            with applied(select(model, self.plan.vector.to_dict())) as set_model:
                motion = replayed(
                    set_model, self.xs[0], law, len(self.us), tolerance=TOLERANCE, evaluations=EVALUATIONS
                )
            return motion, [energy_check(motion)]

        rows = self._replays(IN_CONTINUOUS_TIME, 0.0, 1, move)
        refused = [row for row in rows if row.motion is None]
        if not refused or rows[-1].holds:
            return rows
        parts = max(1, math.ceil(self.period / SHORT - 1e-9))
        name = f"in steps of {self.period / parts:.4g} s in place of continuous time: {refused[0].failures[0]}"
        short = self._replays(name, self.period / parts, parts, self._steps(parts))
        return short if any(row.motion is not None for row in short) else rows

    def _steps(self, parts: int) -> Mover:
        def move(law: Policy) -> tuple[MeasuredMotion, list[Check]]:
            model = self.plan.model_at(self.parts * parts)
            with applied(select(model, self.plan.vector.to_dict())) as set_model:
                motion = rollout(set_model, self.xs[0], policy=law, num_steps=parts * len(self.us))
            return motion, [energy_check(motion)]

        return move

    def in_engine(
        self, name: str, step: Callable[[Array, Array], Array], time_step: float, unlike: Sequence[Check] = ()
    ) -> list[Replay]:
        """In another simulator, by its `step` (x, u) -> x' of `time_step` [s], a whole part of the plan's own.

        `unlike` are checks of its model.
        """
        parts = round(self.period / time_step)
        if not parts or abs(parts * time_step - self.period) > 1e-9 * self.period:
            raise InputError("time_step [s]", got=time_step, expected=f"a whole part of {self.period:.12g}")

        def move(law: Policy) -> tuple[MeasuredMotion, list[Check]]:
            count, checks = parts * len(self.us), list(unlike)
            xs, us = np.full((count + 1, self.xs.shape[1]), np.nan), np.zeros((count, self.us.shape[1]))
            xs[0] = self.xs[0]
            for k in range(count):
                us[k] = law(xs[k], k * time_step)
                try:
                    xs[k + 1] = step(xs[k], us[k])
                except SimulationError as error:
                    why = f"it breaks off at {k * time_step:.3g} s: {_first_clause(error)}"
                    checks.append(check("motion", why, np.inf, 0.0, verdict="undecided"))
                    break
            model = self.plan.model_at(self.parts)
            with applied(select(model, self.plan.vector.to_dict())) as set_model:
                return _Moved(np.asarray(time_step * np.arange(count + 1)), xs, us, _overlaps(set_model, xs)), checks

        return self._replays(f"in {name} in steps of {time_step:.4g} s", time_step, parts, move, WIDER)

    def _replays(self, variant: str, time_step: float, parts: int, move: Mover, wider: float = 1.0) -> list[Replay]:
        """The plan in a plant, `parts` of whose steps make one of its own, up to the first control by which it holds.

        `time_step` [s] is that of the plant.
        """
        rows, model, every = list[Replay](), self.plan.model_at(self.parts), parts * self.parts
        for control in self.controls:
            try:
                with applied(select(model, self.plan.vector.to_dict())) as set_model:
                    law = self._law(set_model, control, parts)
                motion, checks = move(law)
                if np.all(np.isfinite(motion.xs)):
                    with applied(select(model, self.plan.vector.to_dict())) as set_model:
                        asked = motion_checks(self.plan, set_model, motion, every, wider * STATE_TOLERANCE, wider)
                        checks = [*asked, *checks]
                rows.append(measured_replay(self.plan, variant, control, model, motion, checks, time_step))
            except BROKEN as error:
                row = missing_replay(self.plan, variant, control, _first_clause(error))
                rows.append(replace(row, time_step=time_step))
            if rows[-1].holds:
                break
        return rows

    def _law(self, model: Model, control: str, parts: int) -> Policy:
        """The command of each of the plan's own steps, held over `parts` steps of a plant: for one motion."""
        law, plan_step, command = None, self.period / parts, [np.zeros(0)]
        if control == FEEDBACK:
            if self._gains is None:
                self._gains = regulator(self.plan, model, self.xs, self.us).gains
            law = track(self.plan, model, self.xs, self.us, self._gains)

        def held(x: Array, t: float) -> Array:
            k, within = divmod(round(t / plan_step), parts)
            if not within:
                command[0] = self.us[k] if law is None else np.asarray(law(x, k * self.period))
            return command[0]

        return held


def _overlaps(model: Model, xs: Array) -> Array:
    """(n+1,) [m] of Drake's geometries at xs, NaN where these are no numbers."""
    depths = np.full(len(xs), np.nan)
    touches = bool(model.contract.contact.collision_pairs)
    for k in np.flatnonzero(np.isfinite(xs).all(axis=1)):
        if touches:
            set_state(model.double, xs[k])
        depths[k] = penetration(model) if touches else 0.0
    return depths


def _first_clause(error: Exception) -> str:
    """What it says, without the state at which it happened."""
    return str(error).split(", from x = ")[0]

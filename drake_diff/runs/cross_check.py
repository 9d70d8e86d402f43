"""Replays of a solution in plants that had no part in it: continuous time, and other simulators.

The plan's own controller follows it, each command of which is held over one of the controller's steps. Where TVLQR does
not lead to the goal, the inputs alone are tried. No verdict rests on these replays.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.engines.contract import is_another_model, match_contracts
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.interface import Engine
from drake_diff.engines.load import load_engine
from drake_diff.exceptions import InputError, MissingDependencyError, ModelError, SimulationError
from drake_diff.model.contact import penetration
from drake_diff.model.model import Model
from drake_diff.model.parameters import select
from drake_diff.model.step import set_state
from drake_diff.motion.rollout import CONTINUOUS
from drake_diff.optimize.checks import Check, check
from drake_diff.optimize.replay import (
    FEEDBACK,
    OPEN_LOOP,
    WIDER,
    FollowedPlant,
    MeasuredMotion,
    PlanFollower,
    Replay,
    ReplayPlan,
    deciding,
    missing_replay,
    replays,
)
from drake_diff.optimize.solution import Solution

SIMULATORS = ("mujoco",)
NOT_INSTALLED = "it is not installed: "  # the failure of a simulator begins so
LONGEST = 1e-3  # [s] a step of another simulator


def cross_check(solution: Solution, engines: Sequence[str] = SIMULATORS) -> Solution:
    """Replay a solution in continuous time and in other simulators.

    The motion in continuous time is the one that Drake's steps stand for, integrated with error control, or Drake's in
    64 steps of each interval where there is none. Other simulators take steps of 1 ms or less, with contacts matched to
    Drake's. The checks are those of replays. In another simulator all tolerances but those of obstacles are twice as
    wide.

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
    follower = follower_of(solution.plan, solution.replays if solution.transcribed is not None else ())
    rows = follower.in_continuous_time(enough=True)
    rows += [row for name in engines for row in _in_simulator(follower, name)]
    return solution.told(cross_checks=tuple(rows), options=solution.options | {"cross_check": list(engines)})


def _in_simulator(follower: PlanFollower, name: str) -> list[Replay]:
    plan, parts = follower.plan, max(1, math.ceil(follower.period / LONGEST - 1e-9))
    try:
        if not np.array_equal(plan.vector.values, select(plan.problem.model, plan.vector.names).values):
            raise ModelError("another simulator uses the model's own parameters, but the plan has others")
        if name == "mujoco":  # which takes any step of a model that Drake has at one alone
            return replays_in(follower, load_engine(name, plan.problem.model, time_step=follower.period / parts))
        return replays_in(follower, load_engine(name, plan.problem.model.at_time_step(follower.period / parts)))
    except MissingDependencyError as error:
        why = f"{NOT_INSTALLED}{error}"
    except ModelError as error:
        why = str(error)
    return [missing_replay(plan, f"in {name}", FEEDBACK if plan.problem.model.nu else OPEN_LOOP, why)]


def follower_of(plan: ReplayPlan, known: Sequence[Replay] = ()) -> PlanFollower:
    """The controller of a plan in other plants.

    It has a quarter of the steps of the plan, with offsets for continuous time, or these steps where bodies can touch.
    Of a collocated plan it has the first steps in which that has to hold, by its replays (`known` or taken).
    """
    model = plan.problem.model
    if not plan.continuous or plan.problem.motion == CONTINUOUS:
        can_touch = bool(model.contract.contact.collision_pairs)
        only_own_steps = plan.continuous or can_touch or not model.can_rebuild
        return plan.follower() if only_own_steps else plan.follower_in_continuous_time
    known = known or replays(plan)
    named = [r for r in known if r.variant in deciding(plan, known)]
    return plan.follower(round(plan.time_step / named[0].time_step) if named else 1)


def replays_in(follower: PlanFollower, engine: Engine) -> list[Replay]:
    """A plan in a simulator; what its contract has otherwise than Drake's is a check that fails."""
    plan, h, x0 = follower.plan, engine.contract.time_step, follower.xs[0]
    model, pieces = plan.problem.model, round(follower.period / h)
    if not pieces or abs(pieces * h - follower.period) > 1e-9 * follower.period:
        raise InputError("time_step [s]", got=h, expected=f"{follower.period:.12g} divided by a whole number")
    touch = bool(model.contract.contact.collision_pairs)
    lines = [line for line in match_contracts(DrakeEngine(model), engine) if line.verdict == "different"]
    wrong = [line for line in lines if is_another_model(line, touch) and line.quantity != "time step"]

    def move(control: str) -> tuple[MeasuredMotion, list[Check]]:
        checks = [check("model", f"{line.quantity}: {line.detail}", np.inf, 0.0) for line in wrong]
        law, count = follower.law(control, pieces), pieces * len(follower.us)
        xs, us = np.full((count + 1, len(x0)), np.nan), np.zeros((count, model.nu))
        xs[0] = x0
        for k in range(count):
            us[k] = law(xs[k], k * h)
            try:
                xs[k + 1] = engine.step(xs[k], us[k])
            except SimulationError as error:
                why = f"it breaks off at {k * h:.3g} s: {str(error).split(', from x = ')[0]}"
                checks.append(check("motion", why, np.inf, 0.0, verdict="undecided"))
                break
        with plan.applied_to(follower.model) as set_model:
            return _Moved(np.asarray(h * np.arange(count + 1)), xs, us, _overlaps(set_model, xs)), checks

    variant = f"in {engine.name} {engine.version} in steps of {h:.4g} s"
    return follower.replays(FollowedPlant(variant, follower.model, move, pieces, h, WIDER), enough=True)


@dataclass(frozen=True, eq=False)
class _Moved:
    """A `Motion` of another simulator."""

    times: Array
    xs: Array
    us: Array
    penetration: Array


def _overlaps(model: Model, xs: Array) -> Array:
    """(n+1,) [m] of Drake's geometries at xs, NaN where these are no numbers."""
    depths = np.full(len(xs), np.nan)
    touches = bool(model.contract.contact.collision_pairs)
    for k in np.flatnonzero(np.isfinite(xs).all(axis=1)):
        if touches:
            set_state(model.double, xs[k])
        depths[k] = penetration(model) if touches else 0.0
    return depths

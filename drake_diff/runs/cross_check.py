"""Replay a solution in plants that the solver did not use: continuous time, and other simulators.

The plan's own controller tracks the plan. Each command is constant over one step of the controller. If the plan does
not reach its goal under TVLQR, the planned inputs are replayed open loop. No verdict depends on these replays.
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
NOT_INSTALLED = "it is not installed: "  # start of the failure message of a missing simulator
LONGEST = 1e-3  # [s] longest time step of another simulator


def cross_check(solution: Solution, engines: Sequence[str] = SIMULATORS) -> Solution:
    """Replay a solution in continuous time and in other simulators.

    The motion in continuous time is the limit of Drake's steps. It is integrated with error control, or by Drake in 64
    steps per interval if that is not possible. Other simulators take steps of at most 1 ms, with contact parameters
    that match Drake's. The checks are those of the replays. In another simulator all tolerances except those of
    obstacles are twice as wide.

    Args:
        solution: A result of `solve` for a model, of any status.
        engines: Names of simulators for `engines.load_engine`. A simulator that is not installed or does not support
            the model gives a failed replay.

    Returns:
        The same solution with its `cross_checks`: a replay in each plant under TVLQR and, if that fails, open loop.
        They are also among its `checks`. `save` writes them, and `verify` repeats them.

    Raises:
        InputError: The solution has no model, or has several phases.
        UnknownNameError: No simulator has such a name.

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
    rows = follower.in_continuous_time(sufficient=FEEDBACK)
    rows += [row for name in engines for row in _in_simulator(follower, name)]
    return solution.told(cross_checks=tuple(rows), options=solution.options | {"cross_check": list(engines)})


def _in_simulator(follower: PlanFollower, name: str) -> list[Replay]:
    plan, parts = follower.plan, max(1, math.ceil(follower.period / LONGEST - 1e-9))
    try:
        if not np.array_equal(plan.vector.values, select(plan.problem.model, plan.vector.names).values):
            raise ModelError("another simulator uses the model's own parameters, but the plan has others")
        if name == "mujoco":  # MuJoCo accepts any time step, also for a model that Drake has at one step only
            return replays_in(follower, load_engine(name, plan.problem.model, time_step=follower.period / parts))
        return replays_in(follower, load_engine(name, plan.problem.model.at_time_step(follower.period / parts)))
    except MissingDependencyError as error:
        why = f"{NOT_INSTALLED}{error}"
    except ModelError as error:
        why = str(error)
    return [missing_replay(plan, f"in {name}", FEEDBACK if plan.problem.model.nu else OPEN_LOOP, why)]


def follower_of(plan: ReplayPlan, known: Sequence[Replay] = ()) -> PlanFollower:
    """Return the controller that tracks a plan in other plants.

    Its step is a quarter of the plan's step, with offsets for continuous time, or the plan's step if bodies can
    collide. For a collocated plan, it is the first step size that has to hold in the replays (`known` or new).
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
    """Replay a plan in a simulator; each deviation of its contract from Drake's is a failed check."""
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
    return follower.replays(
        FollowedPlant(variant, follower.model, move, pieces, h, WIDER, is_drake=False), sufficient=FEEDBACK
    )


@dataclass(frozen=True, eq=False)
class _Moved:
    """A `MeasuredMotion` of another simulator."""

    times: Array
    xs: Array
    us: Array
    penetration: Array


def _overlaps(model: Model, xs: Array) -> Array:
    """Compute the largest overlap (n+1,) [m] of Drake's geometries at each state, NaN for non-finite states."""
    depths = np.full(len(xs), np.nan)
    touches = bool(model.contract.contact.collision_pairs)
    for k in np.flatnonzero(np.isfinite(xs).all(axis=1)):
        if touches:
            set_state(model.double, xs[k])
        depths[k] = penetration(model) if touches else 0.0
    return depths

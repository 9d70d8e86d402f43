"""Replay a plan on Drake's double plant: in its own step and finer ones, in continuous time, and under another contact.

A motion that exists at one step size or in one law of contact only is an artefact of the numerics. A plan holds in a
variant of the plant if its inputs reach the goal and keep all limits, open loop or under TVLQR about the plan.

A plan in steps has to hold at h, h/2 and h/8 and, where nothing can touch, in continuous time. There the inputs lead
elsewhere than the plan, for which TVLQR has offsets. A plan that does not hold open loop there also has to come near
its goal without them. A collocated plan has no steps of its own: it has to hold at two successive ones of h, h/2, ...
h/64. Under feedback less is allowed, since the end then depends on its weights too.

The other law of contact is followed by the gains of the plan's own steps: where a foot has just landed, lagged contact
has derivatives of fifty times the plan's, and its own gains throw the foot up. A step that is right for one law may be
too long for another, whose foot then goes through the ground. So a plan that does not hold in the other law at h is
tried in it at h/8, which decides. A plan in continuous time with contact has to hold in another integration of its law.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import GradientError, InputError, ModelError, SimulationError
from drake_diff.model.assembly import OPEN, gap
from drake_diff.model.contact import deepest_overlap, thinnest_geometry
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied, select
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.continuous import ContinuousMotion, replayed
from drake_diff.motion.intervals import DrakeSteps, intervals_of, roll
from drake_diff.motion.policy import TVLQR
from drake_diff.motion.rollout import CONTINUOUS, Policy, Rollout, rollout
from drake_diff.optimize.checks import Check, check
from drake_diff.optimize.problem.dynamics import units_of
from drake_diff.optimize.problem.goals import GoalConstraint
from drake_diff.optimize.problem.obstacles import ClearanceConstraint, SelfCollision, along_steps, clearances
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.problem.terminal import TerminalConstraint
from drake_diff.optimize.transcription.collocation import EFFORT_WEIGHT, FINAL_WEIGHT

# Of a coordinate's range in the plan: how far from goal, bound or waypoint a replay may be. Discretizations differ by
# O(h), so nothing tight can be asked of h against h/2; a plan that is wrong is wrong by the order of its range.
STATE_TOLERANCE = 0.05
# The same under TVLQR, of the goal alone: where the effort weighs a fourth, a saturated motion was seen to end three
# times as far off. Who repeats the plan has other weights.
FEEDBACK_TOLERANCE = 0.03
# Gains alone leave the error of a coarse step where it is, and other simulators have other laws of contact and of joint
# limits: there a motion may end, and in these also stray, twice as far.
WIDER = 2.0
LEAST_EFFORT = 1e-3  # of the largest input, what a regulator weighs an input by that the plan does not use
SAME = 1e-2  # the same in the plan's own plant, of every state at every knot, and of the cost
ANOTHER_PLANT = 0.2  # the same of positions on the way, and of the cost, in another plant, in which a goal decides
SMALLEST_ENERGY = 1e-9  # [J] less is rounding
ENERGY_TOLERANCE = 0.1  # of the energy that the motion exchanges: what no force accounts for
HELD = 1e-3  # of a constraint's scale: it moves at least that far, where a plan stays on it
PENETRATION_PART = 0.25  # of the thinnest geometry's thickness: beyond half of it contact may push out the other way
OTHER_APPROXIMATION = {"sap": "lagged", "similar": "sap", "lagged": "sap", "tamsi": "sap"}
FINE = 8  # parts of a step: what is left of an error of O(h) from there on is a seventh of what is seen up to there
# Intervals are cut into at most that many steps: a hand that is to be within 5 mm at 1 m/s needs those of 5 ms.
FINER, FINEST = 16, 64
MOST_STEPS = 4000  # of a replay in more than FINER parts of an interval
ANOTHER_INTEGRATION, IN_CONTINUOUS_TIME = "by another integration in continuous time", "in continuous time"
TOLERANCE = 1e-6  # of each step of the integration in continuous time: the motion is judged to 5 %
EVALUATIONS = 150_000  # of the equations of motion; stiffer ones are followed in the short steps instead
OPEN_LOOP, FEEDBACK, GAINS_ALONE = "open loop", "TVLQR", "TVLQR without offsets"
BROKEN = (SimulationError, ModelError, GradientError, ValueError)


class MeasuredMotion(Protocol):
    """What is measured of a motion: times (n+1,) [s], xs (n+1, nx), us (n, nu) and penetration (n+1,) [m]."""

    @property
    def times(self) -> Array: ...
    @property
    def xs(self) -> Array: ...
    @property
    def us(self) -> Array: ...
    @property
    def penetration(self) -> Array: ...


@dataclass(frozen=True, eq=False, repr=False)
class Replay(ShowsItsRepr):
    """A plan followed in one variant of the plant under one control: its motion and what is checked of it.

    `motion` is None, and the measures infinite, where it could not be taken.
    """

    variant: str
    control: str  # "open loop" or "TVLQR"
    time_step: float  # [s]; 0 in continuous time
    approximation: str
    motion: Any
    checks: tuple[Check, ...]
    goal_error: float = np.inf  # the largest distance from the goal, free entries apart, in the state's units
    bound_violation: float = np.inf  # the largest excess of a state over a bound, in the state's units
    energy_error: float = np.inf  # [J] drift of the energy that no force accounts for
    penetration: float = np.inf  # [m]

    @property
    def holds(self) -> bool:
        """Whether every check passes."""
        return all(c.passes for c in self.checks)

    @property
    def failures(self) -> tuple[str, ...]:
        """A clause for each check that does not pass."""
        return tuple(str(c) for c in self.checks if not c.passes)

    def __str__(self) -> str:
        return f"{self.variant}, {self.control}: {'; '.join(self.failures) or 'holds'}"

    def __repr__(self) -> str:
        return f"Replay {self}"


@dataclass(frozen=True, eq=False)
class ReplayPlan:
    """What is replayed: `sample(m)` gives xs (m N + 1, nx) and us (m N, nu) held over each m-th part of an interval.

    `time_step` [s] is an interval's length; `continuous` tells that the plan is a motion in continuous time. `cost` is
    the plan's.
    """

    problem: Problem
    vector: ParameterVector
    time_step: float
    sample: Callable[[int], tuple[Array, Array]]
    continuous: bool
    cost: float

    @cached_property
    def scale(self) -> Array:
        """(nx,) see `Problem.state_scales`."""
        return self.problem.state_scales(self.sample(1)[0])

    def cost_of(self, xs: Array, us: Array, parts: int) -> float:
        """The objective of xs (m N + 1, nx) and us (m N, nu), `parts` m of whose steps make an interval of the plan.

        Of a plan in steps that is the sum over its own knots.
        """
        every = 1 if self.continuous and self.problem.trajectory_cost is None else parts
        total = self.problem.objective(xs[::every], us[::every], self.time_step * every / parts)
        return total + self.problem.cost_of_parameters(self.vector.values)

    def cost_tolerance(self, fraction: float) -> float:
        """How much the cost changes where each state and input is off by that `fraction` of its range all along."""
        xs, us = self.sample(1)
        cost, total = self.cost_of(xs, us, 1), 0.0
        for values, scale in ((xs, self.scale), (us, np.ptp(us, axis=0))):
            for direction in np.diag(fraction * scale):
                moved = (xs + direction, us) if values is xs else (xs, us + direction)
                total += abs(self.cost_of(moved[0], moved[1], 1) - cost)
        return total

    @cached_property
    def open_loop(self) -> Rollout | None:
        """The plant's own motion under the inputs at the plan's own step; None if it cannot be taken."""
        try:
            xs, us = self.sample(1)
            with self.applied_to(self.model_at(1)) as model:
                return _rolled(self.problem, model, xs[0], us, len(us))
        except (SimulationError, ModelError, ValueError):
            return None  # not finite, or beyond what Drake can step: recorded as missing, never as zero

    def applied_to(self, model: Model) -> AbstractContextManager[Model]:
        """The model with the plan's parameters, until the context ends."""
        return applied(select(model, self.vector.to_dict()))

    @cached_property
    def follower(self) -> "Callable[..., PlanFollower]":
        """Of `PlanFollower`'s parts and pieces: always the same one, which knows its gains."""
        return cache(partial(PlanFollower, self))

    @property
    def follower_in_continuous_time(self) -> "PlanFollower":
        """Of a plan in steps of a model that cannot touch: by a controller in quarters of its steps."""
        return self.follower(FINE // 2, 0)

    @property
    def own_plant(self) -> str:
        """The variant in which a plan by steps is made; empty of a collocated one, which no step makes."""
        steps = f"in steps of {self.time_step:.4g} s"
        return "" if self.continuous else ANOTHER_INTEGRATION if self.problem.motion == CONTINUOUS else steps

    def model_at(self, parts: int) -> Model:
        """The model at the m-th part of an interval."""
        model, h = self.problem.model, self.time_step / parts
        return model if h == model.time_step else model.at_time_step(h)


def held(xs: Array, us: Array) -> Callable[[int], tuple[Array, Array]]:
    """`Plan.sample` of states xs (N+1, nx) at the ends of steps over which us (N, nu) is held."""

    def sample(parts: int) -> tuple[Array, Array]:
        places = np.arange(parts * len(us) + 1) / parts
        between = np.array([np.interp(places, np.arange(len(xs)), column) for column in xs.T]).T
        return between, np.repeat(us, parts, axis=0)

    return sample


def replays(plan: ReplayPlan) -> tuple[Replay, ...]:
    """`plan` in the variants of the plant, open loop and, if there are inputs, under TVLQR."""
    model, parts = plan.problem.model, 2
    if plan.problem.motion == CONTINUOUS:
        return tuple(plan.follower().in_model(ANOTHER_INTEGRATION, lambda: model))
    rows = plan.follower().in_steps()
    if not model.can_rebuild:  # a user's diagram is one plant: there are no variants of it to try
        return tuple(rows)
    rows += plan.follower(parts).in_steps()
    if plan.continuous:
        most = finest_parts(plan)
        while parts < most and not (any(r.holds for r in rows[-2:]) and any(r.holds for r in rows[-4:-2])):
            parts *= 2
            rows += plan.follower(parts).in_steps()
        return tuple(rows)
    rows += plan.follower(FINE).in_steps()
    contact = model.contract.contact
    if not contact.collision_pairs:
        return (*rows, *plan.follower_in_continuous_time.in_continuous_time())
    other = OTHER_APPROXIMATION[contact.approximation]
    name = f"with {other} contact"
    tried = plan.follower().in_model(name, lambda: model.with_contact(other))
    if not any(r.holds for r in tried):
        name = f"{name} in steps of {plan.time_step / FINE:.4g} s"
        tried += plan.follower().in_model(name, lambda: plan.model_at(FINE).with_contact(other), FINE)
    return (*rows, *tried)


def finest_parts(plan: ReplayPlan) -> int:
    """In how many steps an interval of a collocated plan is cut at most."""
    return min(FINEST, max(FINER, MOST_STEPS // plan.problem.num_steps))


def deciding(plan: ReplayPlan, rows: Sequence[Replay]) -> list[str]:
    """The variants in which the plan has to hold."""
    variants = list(dict.fromkeys(r.variant for r in rows))
    if plan.continuous:
        return variants[-2:] if len(variants) > 1 else []  # the two finest; one alone says nothing
    return [v for v in variants if not any(other.startswith(f"{v} in steps of ") for other in variants)]


def judged_replay(plan: ReplayPlan, rows: Sequence[Replay]) -> Replay | None:
    """The motion that a verdict rests on: open loop where that holds, else under TVLQR; None where neither does."""
    decides = deciding(plan, rows)
    for control in dict.fromkeys(r.control for r in rows if r.control != GAINS_ALONE):
        tried = [r for r in rows if r.control == control]
        if all(r.holds for r in tried if r.variant in decides):
            return next((r for r in tried if r.holds), None)
    return None


# A motion under a control, and what is checked of it besides.
Mover = Callable[[str], tuple[MeasuredMotion, list[Check]]]


class FollowedPlant(NamedTuple):
    """Where a plan is followed: the motion that a plant makes, and the model whose contact is like the plant's.

    The plant takes `pieces` steps for one of the controller's, of the model's `time_step` [s] where none is given.
    Tolerances are `wider` than they would be.
    """

    variant: str
    model: Model
    move: Mover
    pieces: int = 1
    time_step: float | None = None
    wider: float = 1.0


class PlanFollower:
    """A plan under its own controller, in any plant.

    The controller has `parts` steps of `period` [s] in an interval of the plan. Each command is held over one of them.
    Finer steps than a plan's own do not lead from one of its states to the next (`leads_elsewhere`): TVLQR has offsets
    for a plant that takes `pieces` of them for one of the controller's, 0 where it moves in continuous time.
    """

    def __init__(self, plan: ReplayPlan, parts: int = 1, pieces: int = 1):
        self.plan, self.parts, self.period = plan, parts, plan.time_step / parts
        self.xs, self.us = plan.sample(parts)
        self.controls = (OPEN_LOOP, FEEDBACK) if plan.problem.model.nu else (OPEN_LOOP,)
        self.pieces, self.leads_elsewhere = pieces, parts > 1 and not plan.continuous

    @cached_property
    def model(self) -> Model:
        """The model in the controller's steps."""
        return self.plan.model_at(self.parts)

    @cached_property
    def plant(self) -> Model:
        """The model in the plant's steps; in continuous time in the controller's."""
        return self.plan.model_at(self.parts * max(1, self.pieces))

    @cached_property
    def gains(self) -> Array:
        """(m N, nu, nt) of TVLQR in each of the controller's steps.

        A motion in continuous time has gains that are smooth in time: those of halves, in between, are next to those of
        finer steps.
        """
        if self.parts <= 2 or not self.plan.continuous:
            return self._regulator.gains
        known = self.plan.follower(2).gains
        places = np.minimum(np.arange(self.parts * self.plan.problem.num_steps) * 2 / self.parts, len(known) - 1)
        first = np.minimum(places.astype(int), len(known) - 2)
        ahead = (places - first)[:, None, None]
        return np.asarray((1 - ahead) * known[first] + ahead * known[first + 1])

    @cached_property
    def _regulator(self) -> TVLQR:
        defects, space = None, tangent_space(self.model)
        if self.leads_elsewhere:
            defects = [space.minus(end, x) for end, x in zip(self._ends(), self.xs[1:], strict=True)]
        with self.plan.applied_to(self.model) as model:
            return regulator(self.plan, model, self.xs, self.us, defects)

    def _ends(self) -> list[Array]:
        """Where the controller's steps lead from the plan's states."""
        us = [np.tile(u, (max(1, self.pieces), 1)) for u in self.us]
        with self.plan.applied_to(self.plant) as plant:
            steps = DrakeSteps(plant, self.plan.vector)
            states = partial(roll, steps) if self.pieces else ContinuousMotion(plant, sizes=self.plan.scale).states
            return [states(x, held_us)[-1] for x, held_us in zip(self.xs, us, strict=False)]

    def law(self, control: str = FEEDBACK, pieces: int = 1) -> Policy:
        """u(x, t) for one motion at a time, in a plant that takes `pieces` steps for one of the controller's.

        Under TVLQR it is within the bounds of inputs and the limits of their rates, from the first command on.
        """
        space, last = tangent_space(self.plan.problem.model), list[Any]()
        bounds, slew, us = self.plan.problem.bounds, self._slew, self.us
        gains = self.gains if control != OPEN_LOOP else None
        if control == FEEDBACK and self.leads_elsewhere:
            us = us - self._regulator.offsets

        def command(x: Any, k: int) -> Any:
            if gains is None:
                return us[k]
            wanted = us[k] - gains[k] @ space.minus(x, self.xs[k])
            wanted = np.minimum(np.maximum(wanted, bounds.u_lower), bounds.u_upper)
            return wanted if k == 0 or np.all(np.isinf(slew)) else np.clip(wanted, last[0] - slew, last[0] + slew)

        def law(x: Any, t: float) -> Any:
            k, piece = divmod(round(t * pieces / self.period), pieces)
            if not piece:
                last[:] = [command(x, min(k, len(us) - 1))]
            return last[0]

        return law

    @cached_property
    def _slew(self) -> Array:
        """(nu,) by how much a command may differ from the last one."""
        slew = np.full(self.plan.problem.model.nu, np.inf)
        period = self.period if self.plan.continuous else self.plan.time_step  # held inputs jump at the plan's knots
        for limit in self.plan.problem.rate_limits:
            if limit.of_inputs:
                entries, limits = limit.entries(self.plan.problem.system)
                slew[entries] = np.minimum(slew[entries], limits * period)
        return slew

    def in_steps(self) -> list[Replay]:
        """By each control in the controller's own steps."""
        return self.in_model(f"in steps of {self.period:.4g} s", lambda: self.model)

    def in_model(self, variant: str, make: Callable[[], Model], pieces: int = 1, enough: bool = False) -> list[Replay]:
        """`replays` in the steps of a model, which may not be to be had."""
        try:
            model = make()
        except (ModelError, InputError) as error:
            return [missing_replay(self.plan, variant, control, str(error)) for control in self.controls]
        # A coarse step gains and loses some energy, an artefact all.
        with_energy = self.plan.continuous or self.parts * pieces >= FINE or not model.can_rebuild

        def move(control: str) -> tuple[MeasuredMotion, list[Check]]:
            motion = self.plan.open_loop if control == OPEN_LOOP and model is self.plan.follower().model else None
            if motion is None:
                law, count = self.law(control, pieces), pieces * len(self.us)
                with self.plan.applied_to(model) as set_model:
                    motion = _rolled(self.plan.problem, set_model, self.xs[0], law, count)
            return motion, [energy_check(motion)] * with_energy

        return self.replays(FollowedPlant(variant, model, move, pieces), enough=enough)

    def in_continuous_time(self, *, enough: bool = False) -> list[Replay]:
        """`replays` in the continuous time that Drake's steps stand for; in short steps where there is none."""

        def move(control: str) -> tuple[MeasuredMotion, list[Check]]:
            law, x0, count = self.law(control), self.xs[0], len(self.us)
            with self.plan.applied_to(self.model) as set_model:
                motion = replayed(set_model, x0, law, count, TOLERANCE, EVALUATIONS, self.plan.scale)
            return motion, [energy_check(motion)]

        rows = self.replays(FollowedPlant(IN_CONTINUOUS_TIME, self.model, move, time_step=0.0), enough=enough)
        refused = [row for row in rows if row.motion is None]
        others = {GAINS_ALONE, FEEDBACK}.intersection(row.control for row in rows)
        if not refused or all(any(r.holds for r in rows if r.control in (OPEN_LOOP, other)) for other in others):
            return rows
        by = self.plan.follower(self.parts, max(1, FINEST // self.parts))
        name = f"in steps of {by.period / by.pieces:.4g} s in place of continuous time: {refused[0].failures[0]}"
        short = by.in_model(name, lambda: by.plant, by.pieces, enough)
        return short if any(row.motion is not None for row in short) else rows

    def replays(self, plant: FollowedPlant, *, enough: bool = False) -> list[Replay]:
        """By each control, and by gains alone where the inputs lead elsewhere and do not hold.

        With `enough` by TVLQR, and by the inputs alone where that does not hold.
        """
        rows = list[Replay]()
        for control in self.controls[::-1] if enough else self.controls:
            rows.append(self.replay(plant, control))
            if enough and rows[-1].holds:
                break
        if self.leads_elsewhere and not enough and len(rows) > 1 and not rows[0].holds:
            rows.append(self.replay(plant, GAINS_ALONE))
        return rows

    def replay(self, plant: FollowedPlant, control: str) -> Replay:
        """The replay in a plant under one control."""
        plan, (variant, model, move, pieces, time_step, wider) = self.plan, plant
        every = pieces * self.parts
        try:
            motion, checks = move(control)
            if control == GAINS_ALONE:  # which stand for any such regulator
                off = plan.problem.goal_error(motion.xs[-1])
                checks = [goal_check(plan, off, WIDER * STATE_TOLERANCE), *comparison_checks(plan, motion, every)]
            elif np.all(np.isfinite(motion.xs)):
                # Feedback corrects what the laws of contact differ by: there nothing tighter can be asked of it.
                tight = control == FEEDBACK and wider == 1 and not _has_another_law(plan, model)
                fraction = FEEDBACK_TOLERANCE if tight else wider * STATE_TOLERANCE
                same = variant == plan.own_plant
                with plan.applied_to(model) as set_model:
                    checks = [*motion_checks(plan, set_model, motion, every, fraction, wider, same=same), *checks]
            return measured_replay(plan, variant, control, model, motion, checks, time_step)
        except BROKEN as error:
            return missing_replay(plan, variant, control, str(error).split(", from x = ")[0], time_step)


def _has_another_law(plan: ReplayPlan, model: Model) -> bool:
    return model.contract.contact.approximation != plan.problem.model.contract.contact.approximation


def measured_replay(
    plan: ReplayPlan,
    variant: str,
    control: str,
    model: Model,
    motion: Any,
    checks: Iterable[Check],
    time_step: float | None = None,
) -> Replay:
    """A replay that was taken; `time_step` [s] is the model's unless it is given."""
    bounds, feedback = plan.problem.bounds, None if control == OPEN_LOOP else control
    beyond = np.maximum(bounds.x_lower - motion.xs, motion.xs - bounds.x_upper)[1:]
    return Replay(
        variant=variant,
        control=control,
        time_step=model.time_step if time_step is None else time_step,
        approximation=model.contract.contact.approximation,
        motion=motion,
        checks=tuple(replace(c, plant=variant, feedback=feedback) for c in checks),
        goal_error=_largest(np.abs(plan.problem.goal_error(motion.xs[-1]))),
        bound_violation=_largest(np.maximum(beyond, 0.0)),
        energy_error=getattr(motion, "energy_drift", np.nan),
        penetration=_largest(motion.penetration),
    )


def missing_replay(plan: ReplayPlan, variant: str, control: str, why: str, time_step: float | None = None) -> Replay:
    """A replay that could not be taken: its measures are infinite, never zero."""
    feedback = None if control == OPEN_LOOP else control
    row = replace(check("motion", why, np.inf, 0.0, verdict="undecided"), plant=variant, feedback=feedback)
    h, contact = plan.time_step if time_step is None else time_step, plan.problem.model.contract.contact
    return Replay(variant, control, h, contact.approximation, None, (row,))


def _rolled(problem: Problem, model: Model, x0: Array, inputs: Array | Policy, count: int) -> Rollout:
    """The plant's motion by its own steps, or in continuous time by another integration than a plan is made by."""
    if problem.motion == CONTINUOUS:
        return replayed(model, x0, inputs, count)
    if callable(inputs):
        return rollout(model, x0, policy=inputs, num_steps=count)
    return rollout(model, x0, inputs)


# Feedback.


def regulator(plan: ReplayPlan, model: Model, xs: Array, us: Array, defects: Sequence[Array] | None = None) -> TVLQR:
    """TVLQR on `model` about xs (N+1, nx) and us (N, nu) of the plan; for `defects` see `TVLQR`."""
    Q, R, final = regulator_weights(plan, us)
    ratio = model.time_step / plan.time_step  # a running cost is summed over more steps where they are finer
    jacobians = None
    if plan.problem.motion == CONTINUOUS:
        jacobians = intervals_of(model, select(model, ()), CONTINUOUS).jacobians(xs, us)
    return TVLQR(model, xs, us, ratio * Q, ratio * R, final, jacobians=jacobians, defects=defects)


def regulator_weights(plan: ReplayPlan, us: Array) -> tuple[Array, Array, Array]:
    """Q (nt, nt), R (nu, nu) and Qf by Bryson's rule, one over the square of each range; a rotation's is a radian.

    Where jerks are limited, the end has no weight of its own: the last steps would pull at it.
    """
    space = tangent_space(plan.problem.model)
    effort = plan.problem.input_scales(us)
    effort = np.maximum(effort, LEAST_EFFORT * np.max(effort, initial=0.0))
    Q = np.diag(1 / space.scale(plan.scale) ** 2)
    smooth = any(not limit.of_inputs for limit in plan.problem.rate_limits)
    return Q, EFFORT_WEIGHT * np.diag(1 / effort**2), (1.0 if smooth else FINAL_WEIGHT) * Q


# What is checked of a motion.


def motion_checks(
    plan: ReplayPlan,
    model: Model,
    motion: MeasuredMotion,
    parts: int,
    fraction: float,
    wider: float = 1.0,
    *,
    same: bool = False,
) -> Iterator[Check]:
    """All that the problem asks of `motion`, of which `parts` steps make one of the plan's; energy apart.

    It may end `fraction` of each state's range from x_goal, or in the `same` plant SAME of its way; every other
    tolerance is `wider` than a replay's.
    """
    problem = plan.problem
    if not _has_another_law(plan, model):
        yield from comparison_checks(plan, motion, parts, same=same)
    if not np.all(np.isnan(problem.goal)):
        yield goal_check(plan, problem.goal_error(motion.xs[-1]), fraction, same=same)
    yield bounds_check(plan, motion, wider)
    for c in problem.kept_goals:
        if not isinstance(c, ClearanceConstraint):
            yield check("goal", c.label, _miss(c, motion, plan), wider * c.tolerance, c.unit)
        if isinstance(c, TerminalConstraint):
            off = 0.0 if c.region.converges(model, motion.xs[-1]) else np.inf
            yield check("regulator", c.label, off, 0.0)
    yield from _constraint_checks(plan, motion.xs[::parts], motion.us[::parts], wider)
    yield from clearance_checks(plan, motion)
    if model.contract.contact.collision_pairs:
        yield penetration_check(model, motion)
    if model.file_facts.held_points:
        yield loop_check(model, motion)


def comparison_checks(plan: ReplayPlan, motion: MeasuredMotion, parts: int, *, same: bool = False) -> Iterator[Check]:
    """The states at the plan's knots and the cost beside the plan's.

    In the `same` plant all states and the cost agree to SAME, or to a cost that is nothing. In another one the goal
    decides where there is one. Else positions, the last state and the cost are compared to ANOTHER_PLANT: impacts come
    at other times there, and a step of another length leads elsewhere by its own error.
    """
    problem, wanted, fraction = plan.problem, plan.sample(1)[0], SAME if same else ANOTHER_PLANT
    asked = [c for c in problem.kept_goals if not isinstance(c, ClearanceConstraint)]
    if not same and (asked or not np.all(np.isnan(problem.goal))):
        return  # what is asked decides: feedback costs what it has to
    distances = np.abs(motion.xs[::parts] - wanted[: len(motion.xs[::parts])])
    if not same:
        distances[:-1, problem.model.nq :] = 0.0
    with np.errstate(invalid="ignore"):  # a plan whose states are not finite
        k, i = divmod(int(np.argmax(np.nan_to_num(distances / plan.scale, nan=np.inf))), distances.shape[1])
    where, unit = f"{problem.state_names[i]} at knot {k}", units_of(problem)[i]
    yield check("following", where, distances[k, i], fraction * plan.scale[i], unit)
    with np.errstate(all="ignore"):
        difference = abs(plan.cost_of(motion.xs, motion.us, parts) - plan.cost)
        tolerance = fraction * abs(plan.cost)
        if not difference <= tolerance:  # as a rule that much is enough
            tolerance += problem.least_cost(wanted[0], plan.time_step) if same else plan.cost_tolerance(STATE_TOLERANCE)
    yield check("replayed cost", "the whole motion", difference, tolerance)


def goal_check(plan: ReplayPlan, distance: Array, fraction: float = STATE_TOLERANCE, *, same: bool = False) -> Check:
    """The `distance` (nx,) from the goal of the state that is furthest from it for its tolerance.

    That is the problem's `goal_tolerance` where it is given, else in the `same` plant SAME of what the state has to
    travel, in another one the `fraction` of its range along the plan.
    """
    problem = plan.problem
    tolerances = problem.goal_tolerances(plan.sample(1)[0])
    if not same:
        tolerances = np.where(problem.has_goal_tolerance, tolerances, fraction * plan.scale)
    i = int(np.argmax(np.nan_to_num(np.abs(distance) / tolerances, nan=np.inf)))
    return check("goal", problem.state_names[i], abs(distance[i]), tolerances[i], units_of(problem)[i])


def bounds_check(plan: ReplayPlan, motion: MeasuredMotion, wider: float = 1.0) -> Check:
    """The state of the motion, but the first, that is furthest beyond a bound for its range."""
    bounds, scale, tolerance = plan.problem.bounds, plan.scale, wider * STATE_TOLERANCE * plan.scale
    excess = np.maximum(np.maximum(bounds.x_lower - motion.xs, motion.xs - bounds.x_upper), 0.0)[1:]
    if not len(excess):  # it broke off in its first step
        return check("bound", "no state after the first", 0.0, tolerance[0], units_of(plan.problem)[0])
    k, i = divmod(int(np.argmax(np.nan_to_num(excess / scale, nan=np.inf))), excess.shape[1])
    where = f"{plan.problem.state_names[i]} at {motion.times[k + 1]:.3g} s"
    return check("bound", where, excess[k, i], tolerance[i], units_of(plan.problem)[i])


def clearance_checks(plan: ReplayPlan, motion: MeasuredMotion) -> Iterator[Check]:
    """How near the motion comes to obstacles, at its states or between them: it may use the margin up."""
    for c in clearances(plan.problem.kept):
        yield c.nearest(*along_steps(motion.times, motion.xs), c.tolerance)
    for goal in plan.problem.goals:
        if isinstance(goal, SelfCollision):
            for pair in goal.left_out(plan.problem.model, plan.problem.x0):
                yield check("left-out pair", pair, np.nan, goal.margin, "m", "undecided")


def penetration_check(model: Model, motion: MeasuredMotion) -> Check:
    """The deepest overlap for a quarter of the thinner of the geometries that overlap."""
    least, name = thinnest_geometry(model)
    deep = list[Check]()
    for k in np.flatnonzero(motion.penetration > PENETRATION_PART * least):
        set_state(model.double, motion.xs[k])
        depth, thickness, geometry = deepest_overlap(model)
        where = f"{geometry} at {motion.times[k]:.3g} s"
        deep.append(check("penetration", where, depth, PENETRATION_PART * thickness, "m"))
    if deep:
        return max(deep, key=lambda c: c.ratio)
    worst = int(np.argmax(motion.penetration))
    where = f"{name} at {motion.times[worst]:.3g} s"
    return check("penetration", where, motion.penetration[worst], PENETRATION_PART * least, "m")


def loop_check(model: Model, motion: MeasuredMotion) -> Check:
    """How far the points of a loop come apart for a hundredth of the mechanism: Drake's constraints give way to force.

    They do so in proportion to the square of the time step.
    """
    gaps = [gap(model, x[: model.nq]) if np.all(np.isfinite(x)) else (np.inf, 1.0) for x in motion.xs]
    k = int(np.argmax([distance / size for distance, size in gaps]))
    distance, size = gaps[k]
    return check("loop", f"at {motion.times[k]:.3g} s", distance, OPEN * size, "m")


def energy_check(motion: Rollout) -> Check:
    """Energy out of nothing, or gone; what constraints (couplers, balls, welds) take is not told."""
    gained, tolerance = motion.energy_drift, energy_tolerance(motion)
    is_measured = gained > 0 or np.all(np.isfinite(motion.constraint_violation))
    return check("energy", "gained" if gained > 0 else "lost", abs(gained) if is_measured else 0.0, tolerance, "J")


def energy_tolerance(motion: Rollout) -> float:
    """[J] how much lasting energy a motion may gain or lose unexplained."""
    return max(ENERGY_TOLERANCE * motion.energy_exchanged, SMALLEST_ENERGY)


def _miss(c: GoalConstraint, motion: MeasuredMotion, plan: ReplayPlan) -> float:
    """The largest distance of a replay from a goal at the knots of the plan."""
    parts = (len(motion.xs) - 1) // plan.problem.num_steps
    knots = plan.problem.knots_of(c, input_at_end=False)
    if c.dwells:
        return max(c.miss(x) for x in motion.xs[parts * knots[0] : parts * knots[-1] + 1])
    return max(c.miss(motion.xs[parts * k]) for k in knots)


def _constraint_checks(plan: ReplayPlan, xs: Array, us: Array, wider: float) -> Iterator[Check]:
    """Of constraints, couplings and waypoints, by a replay's states xs (N+1, nx) and us (N, nu) at the plan's knots."""
    problem, tolerances = plan.problem, dict[str, float]()
    planned_xs, planned_us = plan.sample(1)
    spans = problem.spans(planned_xs, planned_us)
    for c in problem.constraints:  # its range is that along the whole plan: at a single knot it has none
        with np.errstate(all="ignore"):
            values = np.array([c(x, u) for x, u in zip(planned_xs, [*planned_us, planned_us[-1]], strict=True)])
        values = values[np.isfinite(values).all(axis=1)]
        reach = max(float(np.ptp(values, axis=0).max()), HELD * float(c.scales(planned_xs, planned_us, spans).max()))
        tolerances[c.label] = STATE_TOLERANCE * reach
    couplings = problem.coupled_steps(plan.time_step)
    for coupling in couplings:
        held_at = HELD * float(np.max(coupling.scales(planned_xs, planned_us, spans), initial=0.0))
        reach = max(coupling.reach(planned_xs, planned_us), held_at)
        tolerances[coupling.label] = max(STATE_TOLERANCE * reach, tolerances.get(coupling.label, 0.0))
    goals = {c.label for c in problem.kept_goals}.difference(tolerances)  # they say themselves how near is near enough
    for name, (excess, knot) in problem.constraint_excess(xs, us, coupled=couplings).items():
        tolerance = wider * tolerances.get(name, STATE_TOLERANCE * float(np.max(plan.scale)))
        if name not in goals:
            yield check("constraint", f"{name} at knot {knot}", excess, tolerance)


def _largest(values: Array) -> float:
    """The largest value, at least 0; inf where one is no number."""
    return float("inf") if np.any(np.isnan(values)) else float(np.max(values, initial=0.0))

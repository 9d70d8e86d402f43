"""Replay a plan on Drake's double plant in its own and finer steps, in continuous time, and with another contact model.

A motion that exists only at one step size or with one contact model is a numerical artefact. A plan holds in a variant
of the plant if its inputs reach the goal and satisfy all limits, open loop or under TVLQR about the plan.

A discrete plan must hold at h, h/2 and h/8 and, without possible contacts, in continuous time. In the variants finer
than h, its inputs lead away from the plan, and TVLQR has offsets that correct this. A plan that fails open loop there
must also come near its goal without offsets. A collocated plan has no step of its own, and must hold at two successive
steps of h, h/2, ... h/64. Tolerances are tighter under feedback, as the end then also depends on the feedback weights.

Under the other contact model, the gains are those of the plan's own steps: after a landing, lagged contact has
derivatives fifty times as large as the plan's, and its own gains throw the foot up. A step that suits one model may be
too long for another, so that a foot passes through the ground. A plan that fails with the other model at h is therefore
tried at h/8, which decides. A plan in continuous time with contact must hold in another integration.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import ShowsItsRepr
from drake_diff.derivatives.step import linearize
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

# Largest distance of a replay from a goal, bound or waypoint, as a fraction of a coordinate's range in the plan.
# Replays at h and h/2 differ by O(h), so that the tolerance cannot be tight; a wrong plan is off by about its range.
STATE_TOLERANCE = 0.05
# The same under TVLQR, for the goal only. With a quarter of the effort's weight, a saturated motion ended three times
# as far off, and users who repeat the plan have other weights.
FEEDBACK_TOLERANCE = 0.03
# Gains without offsets do not correct the error of a coarse step: their motion may end twice as far off. Other
# simulators have other models of contact and joint limits: their motion may also deviate twice as far on the way.
WIDER = 2.0
LEAST_EFFORT = 1e-3  # smallest scale of an input in a regulator, as a fraction of the largest input scale
SAME = 1e-2  # tolerance in the plan's own plant, for every state at every knot and for the cost
ANOTHER_PLANT = 0.2  # tolerance in another plant, for positions on the way and the cost, if there is no goal
SMALLEST_ENERGY = 1e-9  # [J] smaller values are rounding
ENERGY_TOLERANCE = 0.1  # largest unexplained energy, as a fraction of the energy that the motion exchanges
HELD = 1e-3  # smallest range of a constraint that a plan stays on, as a fraction of its scale
PENETRATION_PART = 0.25  # fraction of the thinnest geometry's thickness; beyond half, contact may push the other way
OTHER_APPROXIMATION = {"sap": "lagged", "similar": "sap", "lagged": "sap", "tamsi": "sap"}
FINE = 8  # parts of a step; at h/8 the O(h) error that remains is a seventh of the change from h to h/8
# Largest numbers of steps in an interval. A hand that must be within 5 mm at 1 m/s needs steps of 5 ms.
FINER, FINEST = 16, 64
MOST_STEPS = 4000  # of a replay with more than FINER parts per interval
ANOTHER_INTEGRATION, IN_CONTINUOUS_TIME = "by another integration in continuous time", "in continuous time"
TOLERANCE = 1e-6  # of each step of the integration in continuous time; the motion is judged to 5 %
EVALUATIONS = 150_000  # of the equations of motion; stiffer plants are replayed in short steps instead
OPEN_LOOP, FEEDBACK, GAINS_ALONE = "open loop", "TVLQR", "TVLQR without offsets"
BROKEN = (SimulationError, ModelError, GradientError, ValueError)


class MeasuredMotion(Protocol):
    """The measured data of a motion: times (n+1,) [s], xs (n+1, nx), us (n, nu) and penetration (n+1,) [m]."""

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
    """The replay of a plan in one variant of the plant under one controller, with its motion and its checks.

    If the replay failed, `motion` is None and the measures are infinite.
    """

    variant: str
    control: str  # "open loop" or "TVLQR"
    time_step: float  # [s]; 0 in continuous time
    approximation: str
    motion: Any
    checks: tuple[Check, ...]
    goal_error: float = np.inf  # the largest distance from the goal, without free entries, in the state's units
    bound_violation: float = np.inf  # the largest excess of a state over a bound, in the state's units
    energy_error: float = np.inf  # [J] energy drift that no force explains
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
    """A plan to replay. `sample(m)` returns xs (m N + 1, nx), and us (m N, nu) held over each m-th part of an interval.

    `time_step` [s] is an interval's length. `continuous` is true if the plan is a motion in continuous time. `cost` is
    the plan's cost.
    """

    problem: Problem
    vector: ParameterVector
    time_step: float
    sample: Callable[[int], tuple[Array, Array]]
    continuous: bool
    cost: float

    def __repr__(self) -> str:
        return f"ReplayPlan of {self.problem.name}: cost {self.cost:g}; sample(1) returns (xs, us)"

    @cached_property
    def scale(self) -> Array:
        """(nx,) the scales of the states; see `Problem.state_scales`."""
        return self.problem.state_scales(self.sample(1)[0])

    def cost_of(self, xs: Array, us: Array, parts: int) -> float:
        """Compute the objective of xs (m N + 1, nx) and us (m N, nu), with m = `parts` steps per interval of the plan.

        For a discrete plan, it is the sum over the plan's own knots.
        """
        every = 1 if self.continuous and self.problem.trajectory_cost is None else parts
        total = self.problem.objective(xs[::every], us[::every], self.time_step * every / parts)
        return total + self.problem.cost_of_parameters(self.vector.values)

    @cached_property
    def cost_tolerance(self) -> float:
        """The change of the cost if each state and input is off by STATE_TOLERANCE of its range all along."""
        xs, us = self.sample(1)
        cost, total = self.cost_of(xs, us, 1), 0.0
        for values, scale in ((xs, self.scale), (us, np.ptp(us, axis=0))):
            for direction in np.diag(STATE_TOLERANCE * scale):
                moved = (xs + direction, us) if values is xs else (xs, us + direction)
                total += abs(self.cost_of(moved[0], moved[1], 1) - cost)
        return total

    @cached_property
    def open_loop(self) -> Rollout | None:
        """The plant's open-loop motion at the plan's own step, or None if the simulation fails."""
        try:
            xs, us = self.sample(1)
            with self.applied_to(self.model_at(1)) as model:
                return _rolled(self.problem, model, xs[0], us, len(us))
        except (SimulationError, ModelError, ValueError):
            return None  # not finite, or Drake cannot step it: recorded as missing, never as zero

    def applied_to(self, model: Model) -> AbstractContextManager[Model]:
        """Return the model with the plan's parameters, until the context ends."""
        return applied(select(model, self.vector.to_dict()))

    @cached_property
    def follower(self) -> "Callable[..., PlanFollower]":
        """The cached constructor of `PlanFollower` by its parts and pieces, so that gains are computed once."""
        return cache(partial(PlanFollower, self))

    @property
    def follower_in_continuous_time(self) -> "PlanFollower":
        """The follower of a discrete plan without contact, with a controller in quarters of the plan's steps."""
        return self.follower(FINE // 2, 0)

    @property
    def own_plant(self) -> str:
        """The variant in which a discrete plan was made, or "" for a collocated plan."""
        steps = f"in steps of {self.time_step:.4g} s"
        return "" if self.continuous else ANOTHER_INTEGRATION if self.problem.motion == CONTINUOUS else steps

    def model_at(self, parts: int) -> Model:
        """Return the model with the time step interval / `parts`."""
        model, h = self.problem.model, self.time_step / parts
        return model if h == model.time_step else model.at_time_step(h)


def held(xs: Array, us: Array) -> Callable[[int], tuple[Array, Array]]:
    """Return `ReplayPlan.sample` for states xs (N+1, nx) at the ends of steps over which us (N, nu) is held."""

    def sample(parts: int) -> tuple[Array, Array]:
        places = np.arange(parts * len(us) + 1) / parts
        between = np.array([np.interp(places, np.arange(len(xs)), column) for column in xs.T]).T
        return between, np.repeat(us, parts, axis=0)

    return sample


def replays(plan: ReplayPlan, *, sufficient: str = "") -> tuple[Replay, ...]:
    """Replay `plan` in the variants of the plant, open loop and, if there are inputs, under TVLQR.

    With `sufficient` open loop, variants in which the plan holds open loop are not replayed under TVLQR. The verdict
    is the same. Later calls repeat no replay.
    """
    model, parts = plan.problem.model, 2
    if plan.problem.motion == CONTINUOUS:
        return tuple(plan.follower().in_model(ANOTHER_INTEGRATION, lambda: model, sufficient=sufficient))
    by_steps = [plan.follower().in_steps(sufficient)]
    if not model.can_rebuild:  # a user's diagram has no variants
        return tuple(by_steps[0])
    by_steps.append(plan.follower(parts).in_steps(sufficient))
    if plan.continuous:
        most = finest_parts(plan)
        while parts < most and not all(any(r.holds for r in tried) for tried in by_steps[-2:]):
            last = plan.follower(parts // 2), plan.follower(parts)
            if parts >= FINE and _fails_in_the_limit([r for follower in last for r in follower.in_steps()]):
                break
            parts *= 2
            by_steps.append(plan.follower(parts).in_steps(sufficient))
        return tuple(r for tried in by_steps for r in tried)
    rows = by_steps[0] + by_steps[1] + plan.follower(FINE).in_steps(sufficient)
    contact = model.contract.contact
    if not contact.collision_pairs:
        return (*rows, *plan.follower_in_continuous_time.in_continuous_time(sufficient=sufficient))
    other = OTHER_APPROXIMATION[contact.approximation]
    name, follower = f"with {other} contact", plan.follower()
    tried = follower.in_model(name, lambda: model.with_contact(other), sufficient=sufficient)
    if not any(r.holds for r in tried):
        name = f"{name} in steps of {plan.time_step / FINE:.4g} s"
        tried += follower.in_model(name, lambda: plan.model_at(FINE).with_contact(other), FINE, sufficient)
    return (*rows, *tried)


def _fails_in_the_limit(rows: Sequence[Replay]) -> bool:
    """Return whether the plan fails a WIDER tolerance under every controller in ever finer steps, by its last two.

    The error of a replay is O(h), so that the worst ratio of a value to its tolerance tends to 2 r(h/2) - r(h).
    """
    coarse, fine = (
        [max(c.ratio for c in r.checks) for r in rows if r.variant == variant]
        for variant in list(dict.fromkeys(r.variant for r in rows))[-2:]
    )
    return all(np.isfinite(a) and 2 * b - a > WIDER for a, b in zip(coarse, fine, strict=True))


def finest_parts(plan: ReplayPlan) -> int:
    """Return the largest number of steps in an interval of a collocated plan."""
    return min(FINEST, max(FINER, MOST_STEPS // plan.problem.num_steps))


def deciding(plan: ReplayPlan, rows: Sequence[Replay]) -> list[str]:
    """Return the variants in which the plan must hold."""
    variants = list(dict.fromkeys(r.variant for r in rows))
    if plan.continuous:
        return variants[-2:] if len(variants) > 1 else []  # the two finest; a single variant is no evidence
    return [v for v in variants if not any(other.startswith(f"{v} in steps of ") for other in variants)]


def judged_replay(plan: ReplayPlan, rows: Sequence[Replay]) -> Replay | None:
    """Return the replay that decides the verdict: open loop if that holds, else under TVLQR, or None if both fail."""
    decides = deciding(plan, rows)
    for control in dict.fromkeys(r.control for r in rows if r.control != GAINS_ALONE):
        tried = [r for r in rows if r.control == control]
        if all(r.holds for r in tried if r.variant in decides):
            return next((r for r in tried if r.holds), None)
    return None


# A function of a controller's name that returns a motion and additional checks of it.
Mover = Callable[[str], tuple[MeasuredMotion, list[Check]]]


class FollowedPlant(NamedTuple):
    """A plant in which a plan is replayed: a function that moves it, and the model whose contact is like the plant's.

    The plant takes `pieces` steps for each step of the controller. `time_step` [s] is the model's by default. `wider`
    is a factor on tolerances. A replay in a plant of Drake's (`is_drake`) is known after the first call.
    """

    variant: str
    model: Model
    move: Mover
    pieces: int = 1
    time_step: float | None = None
    wider: float = 1.0
    is_drake: bool = True


class PlanFollower:
    """A plan under its own controller, in any plant.

    The controller has `parts` steps of `period` [s] in an interval of the plan, and holds each command over a step.
    Steps finer than a plan's own do not lead from one planned state to the next (`leads_elsewhere`). TVLQR then has
    offsets for a plant that takes `pieces` steps per controller step, with 0 for continuous time.
    """

    def __init__(self, plan: ReplayPlan, parts: int = 1, pieces: int = 1):
        self.plan, self.parts, self.period = plan, parts, plan.time_step / parts
        self.xs, self.us = plan.sample(parts)
        self.controls = (OPEN_LOOP, FEEDBACK) if plan.problem.model.nu else (OPEN_LOOP,)
        self.pieces, self.leads_elsewhere = pieces, parts > 1 and not plan.continuous
        self.known = dict[tuple[str, str], Replay]()  # by variant and controller

    @cached_property
    def model(self) -> Model:
        """The model with the controller's time step."""
        return self.plan.model_at(self.parts)

    @cached_property
    def plant(self) -> Model:
        """The model with the plant's time step, or with the controller's if the plant moves in continuous time."""
        return self.plan.model_at(self.parts * max(1, self.pieces))

    @cached_property
    def gains(self) -> Array:
        """(m N, nu, nt) the gains of TVLQR in each of the controller's steps.

        The gains of a motion in continuous time are smooth in time. Gains at finer steps are interpolated from those at
        half steps, which are almost equal.
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
        known, space = dict[str, Any](), tangent_space(self.model)
        ends = np.array(self._ends()) if self.leads_elsewhere else self.xs[1:]
        with self.plan.applied_to(self.model) as model:
            if self.leads_elsewhere:
                known["defects"] = [space.minus(end, x) for end, x in zip(ends, self.xs[1:], strict=True)]
                if self.pieces == 1:  # Drake's steps are not repeated
                    known["jacobians"] = np.concatenate(linearize(model, self.xs, self.us, x_next=ends)[:2], axis=2)
            return regulator(self.plan, model, self.xs, self.us, **known)

    def _ends(self) -> list[Array]:
        """Return the ends of the controller's steps from the plan's states."""
        us = [np.tile(u, (max(1, self.pieces), 1)) for u in self.us]
        with self.plan.applied_to(self.plant) as plant:
            steps = DrakeSteps(plant, self.plan.vector)
            states = partial(roll, steps) if self.pieces else ContinuousMotion(plant, sizes=self.plan.scale).states
            return [states(x, held_us)[-1] for x, held_us in zip(self.xs, us, strict=False)]

    def law(self, control: str = FEEDBACK, pieces: int = 1) -> Policy:
        """Return the law u(x, t) for a single motion, in a plant that takes `pieces` steps per controller step.

        Under TVLQR, commands keep the bounds of inputs and, from the first command on, the limits of their rates.
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
        """(nu,) the largest change from one command to the next."""
        slew = np.full(self.plan.problem.model.nu, np.inf)
        period = self.period if self.plan.continuous else self.plan.time_step  # held inputs jump at the plan's knots
        for limit in self.plan.problem.rate_limits:
            if limit.of_inputs:
                entries, limits = limit.entries(self.plan.problem.system)
                slew[entries] = np.minimum(slew[entries], limits * period)
        return slew

    def in_steps(self, sufficient: str = "") -> list[Replay]:
        """Run `replays` in the controller's own steps."""
        return self.in_model(f"in steps of {self.period:.4g} s", lambda: self.model, sufficient=sufficient)

    def in_model(self, variant: str, make: Callable[[], Model], pieces: int = 1, sufficient: str = "") -> list[Replay]:
        """Run `replays` in the steps of the model from `make`. An error in `make` returns missing replays."""
        try:
            model = make()
        except (ModelError, InputError) as error:
            return [missing_replay(self.plan, variant, control, str(error)) for control in self.controls]
        # Coarse steps gain and lose some energy, which is a numerical artefact.
        with_energy = self.plan.continuous or self.parts * pieces >= FINE or not model.can_rebuild

        def move(control: str) -> tuple[MeasuredMotion, list[Check]]:
            motion = self.plan.open_loop if control == OPEN_LOOP and model is self.plan.follower().model else None
            if motion is None:
                law, count = self.law(control, pieces), pieces * len(self.us)
                with self.plan.applied_to(model) as set_model:
                    motion = _rolled(self.plan.problem, set_model, self.xs[0], law, count)
            return motion, [energy_check(motion)] * with_energy

        return self.replays(FollowedPlant(variant, model, move, pieces), sufficient=sufficient)

    def in_continuous_time(self, *, sufficient: str = "") -> list[Replay]:
        """Run `replays` in the continuous time that Drake's steps approximate, or in short steps if that fails."""

        def move(control: str) -> tuple[MeasuredMotion, list[Check]]:
            law, x0, count = self.law(control), self.xs[0], len(self.us)
            with self.plan.applied_to(self.model) as set_model:
                motion = replayed(set_model, x0, law, count, TOLERANCE, EVALUATIONS, self.plan.scale)
            return motion, [energy_check(motion)]

        rows = self.replays(FollowedPlant(IN_CONTINUOUS_TIME, self.model, move, time_step=0.0), sufficient=sufficient)
        refused = [row for row in rows if row.motion is None]
        others = {GAINS_ALONE, FEEDBACK}.intersection(row.control for row in rows)
        if not refused or all(any(r.holds for r in rows if r.control in (OPEN_LOOP, other)) for other in others):
            return rows
        by = self.plan.follower(self.parts, max(1, FINEST // self.parts))
        name = f"in steps of {by.period / by.pieces:.4g} s in place of continuous time: {refused[0].failures[0]}"
        short = by.in_model(name, lambda: by.plant, by.pieces, sufficient)
        return short if any(row.motion is not None for row in short) else rows

    def replays(self, plant: FollowedPlant, *, sufficient: str = "") -> list[Replay]:
        """Replay under each controller, and by gains without offsets if finer steps lead elsewhere and fail open loop.

        With a `sufficient` controller, the others are only used if the plan does not hold under it. If that is TVLQR,
        gains without offsets are not used.
        """
        rows = list[Replay]()
        for control in self.controls[::-1] if sufficient == FEEDBACK else self.controls:
            rows.append(self.replay(plant, control))
            if sufficient and rows[-1].holds:
                break
        if self.leads_elsewhere and sufficient != FEEDBACK and len(rows) > 1 and not rows[0].holds:
            rows.append(self.replay(plant, GAINS_ALONE))
        return rows

    def replay(self, plant: FollowedPlant, control: str) -> Replay:
        """Return the replay of the plan in a plant under one controller, which may be known."""
        key = plant.variant, control
        if not plant.is_drake:
            return self._replay(plant, control)
        if key not in self.known:
            self.known[key] = self._replay(plant, control)
        return self.known[key]

    def _replay(self, plant: FollowedPlant, control: str) -> Replay:
        """Replay the plan in a plant under one controller."""
        plan, (variant, model, move, pieces, time_step, wider, _) = self.plan, plant
        every = pieces * self.parts
        try:
            motion, checks = move(control)
            if control == GAINS_ALONE:  # these gains represent any such regulator
                off = plan.problem.goal_error(motion.xs[-1])
                checks = [goal_check(plan, off, WIDER * STATE_TOLERANCE), *comparison_checks(plan, motion, every)]
            elif np.all(np.isfinite(motion.xs)):
                # Feedback must correct the difference between contact models, so that its tolerance is wider there.
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
    """Return the replay of a completed motion. `time_step` [s] is the model's by default."""
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
    """Return a failed replay. Its measures are infinite, never zero."""
    feedback = None if control == OPEN_LOOP else control
    row = replace(check("motion", why, np.inf, 0.0, verdict="undecided"), plant=variant, feedback=feedback)
    h, contact = plan.time_step if time_step is None else time_step, plan.problem.model.contract.contact
    return Replay(variant, control, h, contact.approximation, None, (row,))


def _rolled(problem: Problem, model: Model, x0: Array, inputs: Array | Policy, count: int) -> Rollout:
    """Simulate the plant in its own steps, or in continuous time by another integration than the plan's."""
    if problem.motion == CONTINUOUS:
        return replayed(model, x0, inputs, count)
    if callable(inputs):
        return rollout(model, x0, policy=inputs, num_steps=count)
    return rollout(model, x0, inputs)


# Feedback.


def regulator(plan: ReplayPlan, model: Model, xs: Array, us: Array, **known: Any) -> TVLQR:
    """Return TVLQR on `model` about the plan's xs (N+1, nx) and us (N, nu). `known` are arguments of `TVLQR`."""
    Q, R, final = regulator_weights(plan, us)
    ratio = model.time_step / plan.time_step  # finer steps add more terms to a running cost
    if plan.problem.motion == CONTINUOUS:
        known["jacobians"] = intervals_of(model, select(model, ()), CONTINUOUS).jacobians(xs, us)
    return TVLQR(model, xs, us, ratio * Q, ratio * R, final, **known)


def regulator_weights(plan: ReplayPlan, us: Array) -> tuple[Array, Array, Array]:
    """Return Q (nt, nt), R (nu, nu) and Qf by Bryson's rule, 1 / range^2. The range of a rotation is one radian.

    If jerks are limited, the end has no extra weight, because the last steps would react to it.
    """
    space = tangent_space(plan.problem.model)
    effort = plan.problem.input_scales(us)
    effort = np.maximum(effort, LEAST_EFFORT * np.max(effort, initial=0.0))
    Q = np.diag(1 / space.scale(plan.scale) ** 2)
    return Q, EFFORT_WEIGHT * np.diag(1 / effort**2), (1.0 if plan.problem.limits_jerk else FINAL_WEIGHT) * Q


# Checks of a motion.


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
    """Check what the problem requires of `motion`, except energy; `parts` of its steps make one step of the plan.

    It may end off x_goal by `fraction` of each state's range, or in the `same` plant by SAME of its travel. `wider` is
    a factor on all other tolerances of a replay.
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
        yield loop_check(model, motion.times, motion.xs)


def comparison_checks(plan: ReplayPlan, motion: MeasuredMotion, parts: int, *, same: bool = False) -> Iterator[Check]:
    """Compare the states at the plan's knots and the cost with those of the plan.

    In the `same` plant, all states and the cost must agree to SAME, or to a negligible cost. In another plant, only the
    goal decides if the problem has one. Otherwise positions, the last state and the cost are compared to ANOTHER_PLANT,
    because impacts occur at other times, and a step of another length has another error.
    """
    problem, wanted, fraction = plan.problem, plan.sample(1)[0], SAME if same else ANOTHER_PLANT
    asked = [c for c in problem.kept_goals if not isinstance(c, ClearanceConstraint)]
    if not same and (asked or not np.all(np.isnan(problem.goal))):
        return  # the goals decide, as feedback may change the cost
    distances = np.abs(motion.xs[::parts] - wanted[: len(motion.xs[::parts])])
    if not same:
        distances[:-1, problem.model.nq :] = 0.0
    with np.errstate(invalid="ignore"):  # for a plan with states that are not finite
        k, i = divmod(int(np.argmax(np.nan_to_num(distances / plan.scale, nan=np.inf))), distances.shape[1])
    where, unit = f"{problem.state_names[i]} at knot {k}", units_of(problem)[i]
    yield check("following", where, distances[k, i], fraction * plan.scale[i], unit)
    with np.errstate(all="ignore"):
        difference = abs(plan.cost_of(motion.xs, motion.us, parts) - plan.cost)
        tolerance = fraction * abs(plan.cost)
        if not difference <= tolerance:  # this tolerance usually suffices
            tolerance += problem.least_cost(wanted[0], plan.time_step) if same else plan.cost_tolerance
    yield check("replayed cost", "the whole motion", difference, tolerance)


def goal_check(plan: ReplayPlan, distance: Array, fraction: float = STATE_TOLERANCE, *, same: bool = False) -> Check:
    """Check the `distance` (nx,) from the goal of the state that is furthest off relative to its tolerance.

    The tolerance is the problem's `goal_tolerance` if it is given. Otherwise it is SAME of the state's travel in the
    `same` plant, and the `fraction` of its range along the plan in another plant.
    """
    problem = plan.problem
    tolerances = problem.goal_tolerances(plan.sample(1)[0])
    if not same:
        tolerances = np.where(problem.has_goal_tolerance, tolerances, fraction * plan.scale)
    i = int(np.argmax(np.nan_to_num(np.abs(distance) / tolerances, nan=np.inf)))
    return check("goal", problem.state_names[i], abs(distance[i]), tolerances[i], units_of(problem)[i])


def bounds_check(plan: ReplayPlan, motion: MeasuredMotion, wider: float = 1.0) -> Check:
    """Check the state, except the first, that exceeds a bound most relative to its range."""
    bounds, scale, tolerance = plan.problem.bounds, plan.scale, wider * STATE_TOLERANCE * plan.scale
    excess = np.maximum(np.maximum(bounds.x_lower - motion.xs, motion.xs - bounds.x_upper), 0.0)[1:]
    if not len(excess):  # the motion ended in its first step
        return check("bound", "no state after the first", 0.0, tolerance[0], units_of(plan.problem)[0])
    k, i = divmod(int(np.argmax(np.nan_to_num(excess / scale, nan=np.inf))), excess.shape[1])
    where = f"{plan.problem.state_names[i]} at {motion.times[k + 1]:.3g} s"
    return check("bound", where, excess[k, i], tolerance[i], units_of(plan.problem)[i])


def clearance_checks(plan: ReplayPlan, motion: MeasuredMotion) -> Iterator[Check]:
    """Check how near the motion comes to obstacles, at its states or between them. It may use up the margin."""
    for c in clearances(plan.problem.kept):
        yield c.nearest(*along_steps(motion.times, motion.xs), c.tolerance)
    for goal in plan.problem.goals:
        if isinstance(goal, SelfCollision):
            for pair in goal.left_out(plan.problem.model, plan.problem.x0):
                yield check("left-out pair", pair, np.nan, goal.margin, "m", "undecided")


def penetration_check(model: Model, motion: MeasuredMotion) -> Check:
    """Check the deepest overlap, relative to a quarter of the thickness of the thinner overlapping geometry."""
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


def loop_check(model: Model, times: Array, xs: Array) -> Check:
    """Check how far the points of a loop separate in a motion, up to a hundredth of the mechanism's size.

    Drake's constraints yield to forces, in proportion to the square of the time step.
    """
    gaps = [gap(model, x[: model.nq]) if np.all(np.isfinite(x)) else (np.inf, 1.0) for x in xs]
    k = int(np.argmax([distance / size for distance, size in gaps]))
    distance, size = gaps[k]
    return check("loop", f"at {times[k]:.3g} s", distance, OPEN * size, "m")


def energy_check(motion: Rollout) -> Check:
    """Check for unexplained energy. A loss to constraints (couplers, balls, welds) is unknown and not reported."""
    gained, tolerance = motion.energy_drift, energy_tolerance(motion)
    is_measured = gained > 0 or np.all(np.isfinite(motion.constraint_violation))
    return check("energy", "gained" if gained > 0 else "lost", abs(gained) if is_measured else 0.0, tolerance, "J")


def energy_tolerance(motion: Rollout) -> float:
    """Return [J] the largest lasting energy that a motion may gain or lose without an explanation."""
    return max(ENERGY_TOLERANCE * motion.energy_exchanged, SMALLEST_ENERGY)


def _miss(c: GoalConstraint, motion: MeasuredMotion, plan: ReplayPlan) -> float:
    """Return the largest distance of a replay from a goal at the knots of the plan."""
    parts = (len(motion.xs) - 1) // plan.problem.num_steps
    knots = plan.problem.knots_of(c, input_at_end=False)
    if c.dwells:
        return max(c.miss(x) for x in motion.xs[parts * knots[0] : parts * knots[-1] + 1])
    return max(c.miss(motion.xs[parts * k]) for k in knots)


def _constraint_checks(plan: ReplayPlan, xs: Array, us: Array, wider: float) -> Iterator[Check]:
    """Check constraints, couplings and waypoints by a replay's xs (N+1, nx) and us (N, nu) at the plan's knots."""
    problem, tolerances = plan.problem, dict[str, float]()
    planned_xs, planned_us = plan.sample(1)
    spans = problem.spans(planned_xs, planned_us)
    for c in problem.constraints:  # the range is that along the whole plan, as a single knot has no range
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
    goals = {c.label for c in problem.kept_goals}.difference(tolerances)  # goals have tolerances of their own
    for name, (excess, knot) in problem.constraint_excess(xs, us, coupled=couplings).items():
        tolerance = wider * tolerances.get(name, STATE_TOLERANCE * float(np.max(plan.scale)))
        if name not in goals:
            yield check("constraint", f"{name} at knot {knot}", excess, tolerance)


def _largest(values: Array) -> float:
    """Return the largest value, at least 0, or inf if a value is NaN."""
    return float("inf") if np.any(np.isnan(values)) else float(np.max(values, initial=0.0))

"""A plan followed in plants that had no part in its making: in finer steps, in continuous time, in another simulator.

One controller follows it everywhere: TVLQR with the gains of the plan's own steps, whose command is held over each of
them, as a robot would be driven. Where that does not lead to the goal, the inputs alone are tried. What is found is
evidence beside the verdict of a solve, which rests on its own replays.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.exceptions import GradientError, InputError, ModelError, SimulationError
from drake_diff.model.contact import penetration
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, select
from drake_diff.model.step import set_state
from drake_diff.motion.replayed import replayed
from drake_diff.motion.rollout import CONTINUOUS, Policy, rollout
from drake_diff.optimize.problem.obstacles import ClearanceConstraint
from drake_diff.optimize.replay import (
    STATE_TOLERANCE,
    Motion,
    Plan,
    Replay,
    broken_balance,
    deciding,
    failures_of,
    goal_tolerance,
    replays,
    track,
)

PARTS = (1, 2, 4)  # of the plan's own step, in which Drake's steps follow it
# Another simulator has other laws of contact and of joint limits: it may end and stray twice as far.
WIDER = 2.0
# Of a problem that asks nothing of the end, the plan's own end is what is asked, to a replay's tolerance of x_goal, and
# at least to this [m or rad] and, of velocities, this [m/s or rad/s]: the ranges of a plan that stands are of rounding.
NEAR_THE_END, SLOW_AT_THE_END = 0.02, 0.1
TOLERANCE = 1e-6  # of each step of the integration: the motion is judged to 5 %
EVALUATIONS = 150_000  # of the equations of motion; stiffer ones are followed in the short steps instead
SHORT = 1e-4  # [s] Drake's steps where there is no motion in continuous time
LONGEST = 1e-3  # [s] a step of another simulator
STEPS, IN_CONTINUOUS_TIME = "steps", "continuous time"  # plants of `Followed`; the others are engines' names
CONTROLS = "TVLQR", "open loop"
BROKEN = (SimulationError, ModelError, InputError, GradientError, ValueError)


@dataclass(frozen=True, eq=False, repr=False)
class Followed(ShowsItsRepr):
    """One plant in which a plan was followed, and what became of it there.

    Attributes:
        plant: "steps", "continuous time", or the name of an engine.
        where: The same with its steps, in words.
        control: By which it holds: "TVLQR" or "open loop"; where by neither, the first that was tried.
        time_step: [s] of the plant.
        measured: Whether there is a motion; `failures` say why there is none.
        xs: (N+1, nx) at the plan's knots, NaN from where it broke off.
        goal_error: The largest distance from the goal, free entries apart, in the states' units.
        bound_violation: The largest excess of a state over a bound, in the states' units.
        penetration: [m] the deepest overlap.
        off: How far from the plan it ends: the worst state's distance, as a part of that state's range in the plan.
        left_at: [s] from when on it is further than allowed from the plan, to the end; None where it ends near it.
        failures: What does not hold.
        unlike: What is another in this plant than in the plan's, such as a mass.
        remark: What is followed instead, and why; empty otherwise.
    """

    plant: str
    where: str
    control: str
    time_step: float
    measured: bool
    xs: Array
    goal_error: float
    bound_violation: float
    penetration: float
    off: float
    left_at: float | None
    failures: tuple[str, ...]
    unlike: tuple[str, ...] = ()
    remark: str = ""

    @property
    def holds(self) -> bool:
        """Whether nothing failed, in a plant that is the plan's own but for its laws."""
        return self.measured and not self.failures and not self.unlike

    def __str__(self) -> str:
        told = [*self.failures[:1], *(f"another plant: {line}" for line in self.unlike)]
        if not self.measured:
            return f"{self.where}: not measured: {self.failures[0]}"
        told += [f"away from the plan from {self.left_at:.3g} s on"] if self.left_at is not None and told else []
        instead = f" ({self.remark})" if self.remark else ""
        return f"{self.where}{instead}, {self.control}: {', '.join(told) or f'holds, {self.off:.1%} of a range off'}"

    def __repr__(self) -> str:
        return f"Followed {self}"


@dataclass(frozen=True, eq=False, repr=False)
class Elsewhere(ShowsItsRepr):
    """Where a plan holds beside the plant that it was made on: a row for each plant in which it was followed.

    `engines` are the names that were asked for; `period` [s] is how long each command of its controller is held.
    """

    rows: tuple[Followed, ...]
    engines: tuple[str, ...]
    period: float

    def __getitem__(self, plant: str) -> tuple[Followed, ...]:
        """The rows of a plant: "steps", "continuous time", or an engine's name."""
        return tuple(row for row in self.rows if row.plant == plant)

    @property
    def holds(self) -> bool:
        """Whether it holds everywhere, nothing left unmeasured."""
        return all(row.holds for row in self.rows)

    @property
    def sentence(self) -> str:
        """What held where, in plain words."""
        kept = [row for row in self.rows if row.holds]
        told = []
        for control in dict.fromkeys(row.control for row in kept):
            how = "open loop" if control == "open loop" else f"under {control}"
            told.append(f"{how} {_listed([row.where for row in kept if row.control == control])}")
        parts = [f"followed at its own rate of {self.period:.4g} s, it holds {'; '.join(told) or 'nowhere'}"]
        parts += [f"not {row}" for row in self.rows if row.measured and not row.holds]
        parts += [str(row) for row in self.rows if not row.measured]
        parts += [f"{row.where} {row.remark}" for row in kept if row.remark]
        return "; ".join(parts)

    def __str__(self) -> str:
        return self.sentence

    def __repr__(self) -> str:
        return "\n  ".join(("Elsewhere: " + self.sentence, *map(str, self.rows)))


def followed_in_drake(plan: Plan, found: Sequence[Replay] = ()) -> tuple[Followed, ...]:
    """`plan` on Drake's plant in steps of h, h/2 and h/4 and in continuous time; h is the first step where it has to
    hold, which of a collocated plan its replays (`found`, where they are known) tell.
    """
    follower = Follower(plan, found)
    return (*(follower.in_steps(parts) for parts in PARTS), follower.in_continuous_time())


class Follower:
    """Follows a plan with the feedback of its own steps, wherever it is asked to.

    `period` [s] is the step of the plan's own controller, and `parts` how many of them an interval of the plan has.
    """

    def __init__(self, plan: Plan, found: Sequence[Replay] = ()):
        self.plan, self.parts = plan, 1
        if plan.continuous and plan.problem.motion != CONTINUOUS:  # an interval need not be a step
            found = found or replays(plan)
            named = [r for r in found if r.variant in deciding(plan, found)]
            self.parts = round(plan.time_step / named[0].time_step) if named else 1
        self.period = plan.time_step / self.parts
        self.xs, self.us = plan.sample(self.parts)
        self.controls = CONTROLS if plan.problem.model.nu else CONTROLS[1:]

    def in_steps(self, parts: int) -> Followed:
        """In Drake's steps, `parts` to one of the plan's own."""
        return _chosen(self._in_steps(STEPS, parts, None))

    def in_continuous_time(self) -> Followed:
        """In the continuous time that Drake's steps stand for, by error control; in short steps where it has none."""

        def move(control: str) -> tuple[Motion, tuple[str, ...]]:
            with applied(select(self._model(1), self.plan.vector.to_dict())) as model:
                law, count = self._law(control, 1), len(self.us)
                motion = replayed(model, self.xs[0], law, count, tolerance=TOLERANCE, evaluations=EVALUATIONS)
            return motion, tuple(broken_balance(motion))

        place = _Place(IN_CONTINUOUS_TIME, f"in {IN_CONTINUOUS_TIME}", 0.0, STATE_TOLERANCE)
        found = self._each(place, 1, move)
        refused = [row for row in found if not row.measured]
        if not refused or _chosen(found).holds:
            return _chosen(found)
        parts = max(1, math.ceil(self.period / SHORT - 1e-9))
        remark = f"in place of continuous time: {refused[0].failures[0]}"
        short = [replace(row, remark=remark) for row in self._in_steps(IN_CONTINUOUS_TIME, parts, STATE_TOLERANCE)]
        return _chosen(short if any(row.measured for row in short) else found)

    def in_engine(
        self,
        name: str,
        told: str,
        step: Callable[[Array, Array], Array],
        time_step: float,
        unlike: tuple[str, ...] = (),
    ) -> Followed:
        """In another simulator, by its `step` (x, u) -> x' of `time_step` [s], a whole part of the plan's own.

        `unlike` says what is another there than in the plan's plant.
        """
        parts = round(self.period / time_step)
        if not parts or abs(parts * time_step - self.period) > 1e-9 * self.period:
            raise InputError("time_step [s]", got=time_step, expected=f"a whole part of {self.period:.12g}")

        def move(control: str) -> tuple[Motion, tuple[str, ...]]:
            law, count = self._law(control, parts), parts * len(self.us)
            xs, us = np.full((count + 1, self.xs.shape[1]), np.nan), np.zeros((count, self.us.shape[1]))
            xs[0], why = self.xs[0], tuple[str, ...]()
            for k in range(count):
                us[k] = law(xs[k], k * time_step)
                try:
                    xs[k + 1] = step(xs[k], us[k])
                except SimulationError as error:
                    why = (f"it breaks off at {k * time_step:.3g} s: {_first_clause(error)}",)
                    break
            with applied(select(self._model(1), self.plan.vector.to_dict())) as model:
                times = np.asarray(time_step * np.arange(count + 1))
                return _Moved(times, xs, us, _overlaps(model, xs)), why

        where = f"in {told} in steps of {time_step:.4g} s"
        place = _Place(name, where, time_step, WIDER * STATE_TOLERANCE, WIDER, unlike)
        return _chosen(self._each(place, parts, move))

    def missing(self, plant: str, why: str) -> Followed:
        """A plant in which the plan cannot be followed."""
        return self._missing(_Place(plant, f"in {plant}", 0.0), self.controls[0], why)

    def _in_steps(self, plant: str, parts: int, part: float | None) -> list[Followed]:
        def move(control: str) -> tuple[Motion, tuple[str, ...]]:
            with applied(select(self._model(parts), self.plan.vector.to_dict())) as model:
                law = self._law(control, parts)
                motion = rollout(model, self.xs[0], policy=law, num_steps=parts * len(self.us))
            return motion, tuple(broken_balance(motion))

        time_step = self.period / parts
        return self._each(_Place(plant, f"in steps of {time_step:.4g} s", time_step, part), parts, move)

    def _each(
        self, place: "_Place", parts: int, move: Callable[[str], tuple[Motion, tuple[str, ...]]]
    ) -> list[Followed]:
        """What becomes of the plan in `place` under each control, up to the first by which it holds."""
        rows = list[Followed]()
        for control in self.controls:
            try:
                motion, why = move(control)
                rows.append(self._measured(place, control, parts, motion, why))
            except BROKEN as error:
                rows.append(self._missing(place, control, _first_clause(error)))
            if not rows[-1].failures:
                break
        return rows

    def _missing(self, place: "_Place", control: str, why: str) -> Followed:
        inf, nothing = math.inf, np.full((self.plan.problem.num_steps + 1, self.xs.shape[1]), np.nan)
        return Followed(
            place.plant, place.where, control, place.time_step, False, nothing, inf, inf, inf, inf, None, (why,)
        )

    def _measured(self, place: "_Place", control: str, parts: int, motion: Motion, why: tuple[str, ...]) -> Followed:
        """What is told of a motion, `parts` of whose steps make one of the plan's own, and which fails for `why`."""
        problem, every = self.plan.problem, parts * self.parts
        bounds, planned = problem.bounds, self.plan.sample(1)[0]
        part = goal_tolerance(control, False) if place.part is None else place.part
        if np.all(np.isfinite(motion.xs)):
            with applied(select(self._model(1), self.plan.vector.to_dict())) as model:
                why = (*failures_of(self.plan, model, motion, every, part, place.wider), *why)
            why = (*self._missed_end(np.abs(motion.xs[-1] - planned[-1]), place.wider), *why)
        beyond = np.maximum(bounds.x_lower - motion.xs, motion.xs - bounds.x_upper)[1:]
        apart = np.abs(motion.xs[::every] - planned)
        near = np.flatnonzero(np.all(apart <= self._allowed(place.wider), axis=1))
        left = int(near[-1]) + 1 if len(near) else 0
        return Followed(
            plant=place.plant,
            where=place.where,
            control=control,
            time_step=place.time_step,
            measured=True,
            xs=motion.xs[::every],
            goal_error=_largest(np.abs(problem.goal_error(motion.xs[-1]))),
            bound_violation=_largest(beyond),
            penetration=_largest(motion.penetration),
            off=_largest(apart[-1] / self.plan.scale),
            left_at=None if left == len(apart) else float(left * self.plan.time_step),
            failures=why,
            unlike=place.unlike,
        )

    def _allowed(self, wider: float) -> Array:
        """(nx,) how far from the plan is near it, in the states' units."""
        least = np.full(self.xs.shape[1], SLOW_AT_THE_END)
        least[: self.plan.problem.model.nq] = NEAR_THE_END
        return np.asarray(wider * np.maximum(STATE_TOLERANCE * self.plan.scale, least))

    def _missed_end(self, apart: Array, wider: float) -> Iterator[str]:
        """Where the last state is too far from the plan's, of a problem that asks nothing of it."""
        asked = [c for c in self.plan.problem.kept_goals if not isinstance(c, ClearanceConstraint)]
        allowed = self._allowed(wider)
        if not asked and np.all(np.isnan(self.plan.problem.goal)) and np.any(apart > allowed):
            worst = int(np.argmax(apart / allowed))
            name = self.plan.problem.state_names[worst]
            yield f"{name} ends {apart[worst]:.3g} from the plan's end, tolerance {allowed[worst]:.3g}"

    def _model(self, parts: int) -> Model:
        """The model at the `parts`-th part of a step of the plan's own."""
        return self.plan.model_at(self.parts * parts)

    @cached_property
    def _feedback(self) -> Policy:
        with applied(select(self._model(1), self.plan.vector.to_dict())) as model:
            return track(self.plan, model, self.xs, self.us)

    def _law(self, control: str, parts: int) -> Policy:
        """The command of each of the plan's own steps, held over `parts` steps of a plant: for one motion."""
        if self.plan.problem.rate_limits:  # it remembers its last command
            vars(self).pop("_feedback", None)
        feedback = self._feedback if control == CONTROLS[0] else None
        now, held = self.period / parts, [np.zeros(0)]

        def command(x: Array, t: float) -> Array:
            k, within = divmod(round(t / now), parts)
            if not within:
                held[0] = self.us[k] if feedback is None else np.asarray(feedback(x, k * self.period))
            return held[0]

        return command


@dataclass(frozen=True)
class _Place:
    """A plant: what it is called, and how far from the plan's goal and from all else that was asked one may be there.

    `part` of each state's range is for the goal; without it, what a replay is allowed.
    """

    plant: str
    where: str
    time_step: float
    part: float | None = None
    wider: float = 1.0
    unlike: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Moved:
    """A `Motion` of another simulator."""

    times: Array
    xs: Array
    us: Array
    penetration: Array


def _chosen(rows: Sequence[Followed]) -> Followed:
    """The row that has no failures, else the first that was measured, with what fails under the other control too."""
    if not rows[-1].failures:
        return rows[-1]
    first = next((row for row in rows if row.measured), rows[0])
    others = [f"{row.control}, {row.failures[0]}" for row in rows if row.failures[0] != first.failures[0]]
    return replace(first, failures=(*first.failures, *others))


def _overlaps(model: Model, xs: Array) -> Array:
    """(n+1,) [m] of Drake's geometries at xs, NaN where these are no numbers."""
    found = np.full(len(xs), np.nan)
    touches = bool(model.contract.contact.collision_pairs)
    for k in np.flatnonzero(np.isfinite(xs).all(axis=1)):
        if touches:
            set_state(model.double, xs[k])
        found[k] = penetration(model) if touches else 0.0
    return found


def _first_clause(error: Exception) -> str:
    """What it says, without the state at which it happened."""
    return str(error).split(", from x = ")[0]


def _largest(values: Array) -> float:
    """inf where one is no number."""
    return math.inf if np.any(np.isnan(values)) else float(np.max(values, initial=0.0))


def _listed(words: Sequence[str]) -> str:
    """Steps by their lengths alone after the first, joined by commas and one "and"."""
    words, steps = list(words), "in steps of "
    for i, (before, word) in reversed(list(enumerate(pairwise(words), start=1))):
        if before.startswith(steps) and word.startswith(steps):
            words[i] = word.removeprefix(steps)
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]

"""Goals of a robot in task space: a hand at a target, joints at angles, a tray kept level.

A goal is a few plain values and refers to no model. The `Problem` binds it to its model, which checks the names and
returns `GoalConstraint`s, which every method treats as ordinary `Constraint`s. A record contains the values, and
`verify` binds them again. `marks` returns the shapes that a page draws.

A plan aims at the middle of a goal's tolerance (see AIMED). Each replay that the verdict uses has the whole tolerance,
because steps of another length lead to slightly different states.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from drake_diff._base.arrays import Array, array_with_gaps, count, finite_array, positive_float
from drake_diff.exceptions import InputError
from drake_diff.mechanics.coordinates import rotation
from drake_diff.mechanics.quantities import (
    UP,
    center_of_mass,
    frame_angular_velocity,
    frame_position,
    frame_rotation_error,
    frame_tilt,
    frame_velocity,
)
from drake_diff.model.model import Model
from drake_diff.optimize.problem.constraint import Constraint, Described
from drake_diff.optimize.problem.cost import ConstantCost, QuadraticCost
from drake_diff.optimize.problem.dynamics import coordinates

LAST = (-1,)
AIMED = 0.1  # of a tolerance: part for the plan; the rest is for deviations in steps of other lengths
STAYED = 0.5  # the same for a goal that holds over a time interval
ROUNDED = 1e-9  # of an interval
USED = 0.9  # the same for a tolerance that a plan may use almost fully
SAME_ROTATION = 1e-3  # largest deviation of a quaternion's norm from 1, as typed by users; it is normalized
SMALLEST_BALL = 0.015  # [m] the smallest radius of a drawn ball
GREEN = (0.18, 0.49, 0.2, 0.8)  # red, green, blue, opacity

FREE = (None, None, None)


@dataclass(frozen=True)
class Mark:
    """A shape of a size [m] that a page draws for a goal, posed in a frame of the model; plain values.

    `shape` and its `size`: "sphere" (radius), "box" (edges x, y, z), "axes" (length of each), "arrow" (x, y, z).
    """

    label: str
    shape: str
    size: tuple[float, ...]
    position: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m] in `frame`
    rotation: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    frame: str = "world"
    in_world: bool = False  # whether `rotation` and the arrow refer to the world's axes rather than the frame's
    colour: tuple[float, float, float, float] = GREEN


@dataclass(frozen=True, eq=False, repr=False)
class GoalConstraint(Constraint):
    """A constraint on the state that represents a goal.

    A plan satisfies its bounds. A replay may deviate (`miss`) from the wanted values by `tolerance`. Both are in
    `unit`. `norm` is the order of the norm of several rows.
    """

    tolerance: float = 0.0
    unit: str = "m"
    norm: float = 2.0
    dwells: bool = False  # whether it also applies between its knots
    measured: Any = None  # a function of the state whose norm is the miss, if it differs from the bounded function

    @property
    def whole(self) -> bool:
        return self.knots is None or self.dwells

    @cached_property
    def wanted(self) -> Array:
        """The middle of the bounds (m,), or NaN for a row with at most one bound."""
        both = np.isfinite(self.lower) & np.isfinite(self.upper)
        return np.where(both, np.where(both, self.lower, 0.0) / 2 + np.where(both, self.upper, 0.0) / 2, np.nan)

    def residuals(self, x: Any) -> Any:
        """Return the residuals at x (nx,), of floats, AutoDiffXd or symbols, of the rows with a wanted value.

        If `takes_rows`, the result is (K, .) at the rows x (K, nx) of floats.
        """
        if self.measured is not None:
            return self.measured(x)
        return (np.asarray(self.function(x)) - self.wanted)[..., ~np.isnan(self.wanted)]

    @property
    def takes_rows(self) -> bool:
        return self.measured is None and getattr(self.function, "takes_rows", False)

    def miss(self, x: Array) -> float:
        """Return the deviation of x (nx,) from the goal, or inf if it is not a number.

        It is the distance from the middle of the bounds, or the excess over the bound of a row with one bound.
        """
        if self.measured is not None:
            off = self.measured(x)
        else:
            values = self(x, None)
            excess = np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0)
            off = np.where(np.isnan(self.wanted), excess, values - self.wanted)
        size = float(np.linalg.norm(off, ord=self.norm))
        return size if np.isfinite(size) else float("inf")

    def told(self, miss: float) -> str:
        """Return a clause about a motion with the largest miss `miss`: "hand position is 0.3 mm off"."""
        return f"{self.label} is {in_words(miss, self.unit)} off"


def in_words(value: float, unit: str) -> str:
    """Format a length, an angle or a speed for people, such as 0.31 mm or 0.002 rad."""
    if unit in ("m", "m/s") and abs(value) < 0.0995:  # two digits would print 1e+02 mm above this
        return f"{1000 * value:.2g} m{unit}"
    return f"{value:.2g} {unit}"


class Goal(Described):
    """The base of all goals, which a `Problem` binds to its model.

    A goal with a `weight` is not a constraint. The weighted square of its residuals is added to the cost instead.
    """

    weight: float | None = None
    knots: Any = None

    def __post_init__(self) -> None:
        kind = type(self).__name__
        for f in fields(self):  # type: ignore[arg-type]  # all are dataclasses
            value = getattr(self, f.name)
            if f.name in CHECKS and not (value is None and f.default is None):
                self._set(**{f.name: CHECKS[f.name](f"{kind}.{f.name}", value)})
        if self.weight is not None and self.knots not in (None, LAST):
            expected = "-1 for the last knot, or None for all knots"
            raise InputError(f"{kind}.knots with a weight", got=list(self.knots), expected=expected)
        self._check()

    def _check(self) -> None:
        """Raise InputError for values that do not fit each other."""

    def targets(self, model: Model) -> Iterator["Target"]:
        """Yield the targets on a model. Raises UnknownNameError if the model does not have a frame or joint."""
        raise NotImplementedError

    def bind(self, model: Model) -> tuple[GoalConstraint, ...]:
        """Return the constraints on a motion of `model`."""
        return tuple(target.constraint(self.knots) for target in self.targets(model))

    def bind_to(self, problem: Any) -> tuple[GoalConstraint, ...]:
        """Return the constraints on a motion of a `Problem`, for goals that depend on more than its model."""
        return self.bind(problem.model)

    def marks(self) -> tuple[Mark, ...]:
        """Return the shapes that a page draws for the goal."""
        return ()


@dataclass(frozen=True)
class Target:
    """`function` (m,) of the state within `tolerance` of `wanted` (m,), None or NaN where free, in a `norm`.

    A plan uses a part of the tolerance (AIMED): the bounds of its rows are the largest cube within that distance.
    """

    function: Callable[[Any], Any]
    wanted: Any
    tolerance: float
    unit: str
    name: str
    norm: float = 2.0

    def constraint(self, knots: Any) -> GoalConstraint:
        wanted = np.array(self.wanted, dtype=float)
        half = AIMED * self.tolerance / np.count_nonzero(np.isfinite(wanted)) ** (1 / self.norm)
        lower, upper = (np.where(np.isnan(wanted), np.sign(side) * np.inf, wanted + side) for side in (-half, half))
        options: dict[str, Any] = {"tolerance": self.tolerance, "unit": self.unit, "norm": self.norm}
        return GoalConstraint(self.function, lower, upper, knots, self.name, **options)


@dataclass(frozen=True, repr=False)
class FrameGoal(Goal):
    """A target for the position of a robot's point, the rotation of a frame, or both, at the end or at other knots.

    The motion ends at rest only if the problem requires it: give the velocities in `x_goal`, or add a
    `FrameVelocityGoal`.

    Args:
        frame: The frame, or a body's name.
        position: (3,) [m] the position of `point` in the world; None or NaN for free entries.
        rotation: The frame's rotation in the world: a rotation matrix (3, 3), or a quaternion (4,) as w, x, y, z.
        point: (3,) [m] in `frame`, the point at `position`: its origin, or a tool that it carries.
        tolerance: [m] the largest distance from `position`, without the free entries.
        rotation_tolerance: [rad] the largest angle from `rotation`.
        knots: The knots at which it applies, as in a `Constraint`; by default the last one, None for all.
        weight: If given, the goal is a cost instead of a constraint: weight times the squared residual [m, rad] is
            added to the cost, at the last knot, or with knots=None per second along the motion.

    Raises:
        InputError: Neither a position nor a rotation, or invalid values.
        UnknownNameError: The Problem's model has no such frame; the message lists the frames that exist.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> side = dd.FrameGoal("pole", point=[0, 0, -0.5], position=[-0.3, None, None])
        >>> dd.Problem(model, x0=[0, 0], num_steps=20, goals=[side], running_cost=dd.QuadraticCost(R=[[1.0]]))
        Problem of pendulum: 2 states, 1 input, 20 steps in 1 s
          from x0 = [0., 0.]
          running cost: QuadraticCost(R=[[1.]])
          goal: FrameGoal(frame='pole', position=[-0.3, None, None], point=[0.0, 0.0, -0.5])
          optimize: controls
    """

    frame: str
    position: Any = None
    rotation: Any = None  # becomes a tuple of rows
    _: KW_ONLY
    point: Any = (0.0, 0.0, 0.0)
    tolerance: float = 5e-3
    rotation_tolerance: float = 1e-2
    knots: Any = LAST
    weight: float | None = None

    def _check(self) -> None:
        if self.rotation is None and self.position in (None, FREE):
            raise InputError("FrameGoal", got="no position and no rotation", expected="a position, a rotation, or both")

    def targets(self, model: Model) -> Iterator[Target]:
        if self.position is not None:
            where = frame_position(model, self.frame, self.point)
            yield Target(where, self.position, self.tolerance, "m", f"{self.frame} position")
        if self.rotation is not None:
            turned = frame_rotation_error(model, self.frame, np.array(self.rotation))
            yield Target(turned, np.zeros(3), self.rotation_tolerance, "rad", f"{self.frame} rotation")

    def marks(self) -> tuple[Mark, ...]:
        label, centre = f"target of {self.frame}", _filled(self.position or FREE)
        axes = () if self.rotation is None else (Mark(label, "axes", (0.1,), centre, self.rotation),)
        return axes if self.position is None else (*_target_marks(label, self.position, self.tolerance), *axes)


@dataclass(frozen=True, repr=False)
class FrameVelocityGoal(Goal):
    """A target velocity of a robot's point, at the end of a motion or at other knots. The default is rest.

    Args:
        frame: The frame that carries the point, or a body's name.
        velocity: (3,) [m/s] in the world; None or NaN for free entries.
        angular_velocity: (3,) [rad/s] of the frame in the world; None, or None entries, are free.
        point: (3,) [m] in `frame`, the point that moves at `velocity`.
        tolerance: [m/s] the largest deviation from `velocity`, without the free entries.
        angular_tolerance: [rad/s] the largest deviation from `angular_velocity`.
        knots, weight: As in a `FrameGoal`.

    Raises:
        InputError, UnknownNameError: As for a `FrameGoal`.

    Example:
        >>> dd.FrameVelocityGoal("hand", [0.5, None, None])
        FrameVelocityGoal(frame='hand', velocity=[0.5, None, None])
    """

    frame: str
    velocity: Any = (0.0, 0.0, 0.0)
    _: KW_ONLY
    angular_velocity: Any = FREE
    point: Any = (0.0, 0.0, 0.0)
    tolerance: float = 1e-2
    angular_tolerance: float = 5e-2
    knots: Any = LAST
    weight: float | None = None

    def _check(self) -> None:
        if self.velocity == self.angular_velocity == FREE:
            raise InputError("FrameVelocityGoal", got="free entries only", expected="a velocity")

    def targets(self, model: Model) -> Iterator[Target]:
        if self.velocity != FREE:
            moving = frame_velocity(model, self.frame, self.point)
            yield Target(moving, self.velocity, self.tolerance, "m/s", f"{self.frame} velocity")
        if self.angular_velocity != FREE:
            turning, name = frame_angular_velocity(model, self.frame), f"{self.frame} angular velocity"
            yield Target(turning, self.angular_velocity, self.angular_tolerance, "rad/s", name)

    def marks(self) -> tuple[Mark, ...]:
        if not any(self.velocity):
            return ()
        along = _filled(self.velocity)
        return (Mark(f"velocity of {self.frame}", "arrow", along, self.point, frame=self.frame, in_world=True),)


@dataclass(frozen=True, repr=False)
class JointGoal(Goal):
    """Target positions or speeds of joints, at the end of a motion or at other knots.

    `x_goal` is the same at the last knot as a hard equality. This goal has a tolerance, in the plan and in its replays.

    Args:
        values: The value of each coordinate by its name: one of the model's `state_names`, or the name of a joint with
            one position, which then means this position. In the coordinates' units: m, rad, m/s, rad/s.
        tolerance: The largest deviation of each coordinate from its value, in its own unit.
        knots, weight: As in a `FrameGoal`.

    Raises:
        InputError, UnknownNameError: As for a `FrameGoal`.

    Example:
        >>> dd.JointGoal({"elbow": 1.0})
        JointGoal(values={'elbow': 1.0})
    """

    values: Any  # becomes a dict
    _: KW_ONLY
    tolerance: float = 1e-2
    knots: Any = LAST
    weight: float | None = None

    def _check(self) -> None:
        if not isinstance(self.values, Mapping) or not self.values:
            raise InputError("JointGoal", got=repr(self.values)[:80], expected="a value for each name")
        values = sorted(self.values.items(), key=lambda item: str(item[0]))  # a record has the same order
        self._set(values={name_of("JointGoal", n): float(finite_array(f"JointGoal {n}", v, ())) for n, v in values})

    def targets(self, model: Model) -> Iterator[Target]:
        wanted, contract = coordinates(model, "JointGoal", self.values), model.contract
        units = [coordinate.unit for coordinate in contract.positions + contract.velocities]
        for unit in dict.fromkeys(units[i] for i in wanted):
            here = [i for i in wanted if units[i] == unit]
            names = [model.state_names[i] for i in here]
            label = ", ".join(names) if len(names) < 4 else f"{names[0]} and {len(names) - 1} more"
            values = [wanted[i] for i in here]
            yield Target(_Entries(tuple(here)), values, self.tolerance, unit, label, norm=np.inf)


@dataclass(frozen=True, repr=False)
class CenterOfMassGoal(Goal):
    """A target position of the centre of mass of all bodies of the model, at the end of a motion or at other knots.

    Args:
        position: (3,) [m] in the world; None or NaN for free entries.
        tolerance: [m] the largest distance from `position`, without the free entries.
        knots, weight: As in a `FrameGoal`.

    Raises:
        InputError: Invalid values.
        ModelError: The bodies of the Problem's model have no mass.

    Example:
        >>> dd.CenterOfMassGoal([0.0, None, None], knots=None)
        CenterOfMassGoal(position=[0.0, None, None], knots=None)
    """

    position: Any
    _: KW_ONLY
    tolerance: float = 5e-3
    knots: Any = LAST
    weight: float | None = None

    def _check(self) -> None:
        if self.position == FREE:
            raise InputError("CenterOfMassGoal", got="only free entries", expected="at least one number")

    def targets(self, model: Model) -> Iterator[Target]:
        yield Target(center_of_mass(model), self.position, self.tolerance, "m", "centre of mass")

    def marks(self) -> tuple[Mark, ...]:
        return _target_marks("target of the centre of mass", self.position, self.tolerance)


@dataclass(frozen=True, repr=False)
class KeepLevel(Goal):
    """An upright axis of a frame, such as that of a tray with a full glass, at all knots or at some.

    Args:
        frame: The frame, or a body's name.
        axis: (3,) the axis in `frame` that points up, along the world's z; of any length.
        tolerance: [rad] the largest tilt.
        knots, weight: As in a `FrameGoal`; all knots by default.

    Raises:
        InputError, UnknownNameError: As for a `FrameGoal`.

    Example:
        >>> dd.KeepLevel("tray", tolerance=0.1)
        KeepLevel(frame='tray', tolerance=0.1)
    """

    frame: str
    _: KW_ONLY
    axis: Any = UP
    tolerance: float = 5e-2
    knots: Any = None
    weight: float | None = None

    def _check(self) -> None:
        if not any(self.axis):
            raise InputError("KeepLevel.axis", got=list(self.axis), expected="a direction")

    def bind(self, model: Model) -> tuple[GoalConstraint, ...]:
        leans = frame_tilt(model, self.frame, self.axis)
        return (
            GoalConstraint(
                _Squared(leans, self.tolerance),
                upper=USED**2 * self.tolerance,
                knots=self.knots,
                name=f"{self.frame} level",
                tolerance=self.tolerance,
                unit="rad",
                measured=leans,
            ),
        )

    def marks(self) -> tuple[Mark, ...]:
        length = float(np.linalg.norm(self.axis))
        return (Mark(f"{self.frame} level", "arrow", tuple(0.15 * a / length for a in self.axis), frame=self.frame),)


@dataclass(frozen=True, repr=False)
class Dwell(Goal):
    """A goal that holds at every time of an interval of at least some seconds, before the end or before another knot.

    The interval starts at the last knot that is early enough. A plan uses half of the goal's tolerance, and is also
    checked between its knots. The replays have the whole tolerance at each of their steps. Every method supports it.

    Args:
        goal: The goal, such as a `FrameGoal` or a `JointGoal`; its own `knots` are not used.
        seconds: [s] the least duration.
        end: The last knot of the interval; negative ones count from the end.

    Raises:
        InputError: Invalid values, or a horizon of the Problem that is free or too short. For a free horizon, use a
            `PhasedProblem` with a phase for the interval.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.05)
        >>> stay = dd.optimize.Dwell(dd.JointGoal({"slide_x": 0.5}, tolerance=0.02), 0.5)
        >>> problem = dd.Problem(
        ...     model, x0=np.zeros(4), num_steps=50, goals=[stay], running_cost=dd.QuadraticCost(R=[[1.0]])
        ... )
        >>> solution = dd.solve(problem)
        >>> solution.success, bool(np.abs(solution.xs[-11:, 0] - 0.5).max() < 0.02)
        (True, True)
    """

    goal: Goal
    seconds: float
    _: KW_ONLY
    end: int = -1

    def _check(self) -> None:
        goal = self.goal
        if not isinstance(goal, Goal) or "knots" not in {f.name for f in fields(goal)}:  # type: ignore[arg-type]
            raise InputError("Dwell.goal", got=repr(goal)[:80], expected="a goal of a state, such as a FrameGoal")
        if goal.weight is not None or goal.knots not in (None, LAST):
            raise InputError("Dwell.goal", got=repr(goal)[:80], expected="a goal without knots and weight")
        self._set(seconds=positive_float("Dwell.seconds [s]", self.seconds), end=count("Dwell.end", self.end, -(10**9)))

    def bind_to(self, problem: Any) -> tuple[GoalConstraint, ...]:
        knots = self.knots_in(problem)
        goal: Any = self.goal
        return tuple(_held(c) for c in replace(goal, knots=knots).bind_to(problem))

    def knots_in(self, problem: Any) -> tuple[int, ...]:
        """Return the knots of a Problem at which the goal applies."""
        count, horizon = problem.num_steps, problem.horizon
        if not -count - 1 <= self.end <= count:
            raise InputError("Dwell.end", got=self.end, expected=f"a whole number from {-count - 1} to {count}")
        if horizon is not None and horizon[0] < horizon[1]:
            expected = "a given horizon; with a free horizon, the stay can be a phase of a PhasedProblem"
            raise InputError("Dwell", got="a free horizon", expected=expected)
        last, h = self.end % (count + 1), problem.start_horizon / count
        first = last - math.ceil(self.seconds / h - ROUNDED)
        if first < 0:
            raise InputError(
                "Dwell.seconds [s]", got=self.seconds, expected=f"at most {last * h:g}, the time since knot 0"
            )
        return tuple(range(first, last + 1))

    def marks(self) -> Any:
        return self.goal.marks()


def _held(c: GoalConstraint) -> GoalConstraint:
    """Return `c` also between its knots, with the part of its tolerance for a goal over an interval."""
    fraction = STAYED / AIMED if c.measured is None else 1.0
    middle = np.nan_to_num(c.wanted)
    lower, upper = (
        np.where(np.isnan(c.wanted), side, middle + fraction * (side - middle)) for side in (c.lower, c.upper)
    )
    return replace(c, lower=lower, upper=upper, name=f"{c.label}, stayed at", dwells=True)


@dataclass(frozen=True)
class _Entries:
    """A function x (nx,) -> the selected entries."""

    which: tuple[int, ...]
    takes_rows: ClassVar = True

    def __call__(self, x: Any) -> Any:
        return np.asarray(x)[..., list(self.which)]


@dataclass(frozen=True)
class _Squared:
    """A function x (nx,) -> |`vector`|^2 / `unit`, which is smooth where `vector` is 0 and has slope 2 at `unit`."""

    vector: Callable[[Any], Any]
    unit: float

    def __call__(self, x: Any) -> Any:
        residuals = self.vector(x)
        return residuals @ residuals / self.unit


@dataclass(frozen=True, eq=False)
class WithGoals:
    """A cost plus the weighted squares of goals' residuals, of x (nx,) and, as a running cost, of u (nu,).

    If `takes_rows`, it also returns the costs (K,) at K rows of floats.
    """

    own: Any  # the user's cost, or None
    goals: tuple[tuple[float, GoalConstraint], ...]

    def __call__(self, x: Any, *u: Any) -> Any:
        total = 0.0 * x[..., 0] if self.own is None else self.own(x, *u)
        for weight, goal in self.goals:
            off = goal.residuals(x)
            total = total + weight * (off * off).sum(axis=-1)
        return total

    @cached_property
    def takes_rows(self) -> bool:
        known = self.own is None or isinstance(self.own, (QuadraticCost, ConstantCost))
        return known and all(goal.takes_rows for _, goal in self.goals)


def _target_marks(label: str, position: Any, tolerance: float) -> tuple[Mark, ...]:
    """Return a ball at a position, or a slab if some of its entries are free."""
    centre, free = _filled(position), [p is None for p in position]
    if any(free):
        return (Mark(label, "box", tuple(1.0 if f else 2 * tolerance for f in free), centre),)
    return (Mark(label, "sphere", (max(tolerance, SMALLEST_BALL),), centre),)


def _filled(numbers: Any) -> tuple[float, ...]:
    return tuple(v or 0.0 for v in numbers)


def vector(subject: str, values: Any) -> tuple[float, ...]:
    """Convert (3,) finite numbers to a tuple."""
    return tuple(finite_array(subject, values, (3,)).tolist())


def _with_gaps(subject: str, values: Any) -> tuple[float | None, ...]:
    """Convert (3,) finite numbers to a tuple, with None for None or NaN. None means that all entries are free."""
    array = array_with_gaps(subject, FREE if values is None else values, (3,))
    if np.any(np.isinf(array)):
        raise InputError(subject, got=array.tolist(), expected="finite numbers, None where free")
    return tuple(None if np.isnan(v) else float(v) for v in array)


def name_of(subject: str, given: Any) -> str:
    """Return `given` if it is a name, or raise InputError."""
    if not isinstance(given, str) or not given:
        raise InputError(subject, got=repr(given)[:80], expected="a name")
    return given


def names_of(subject: str, given: Any) -> tuple[str, ...]:
    """Return names of bodies as a tuple."""
    if isinstance(given, str) or not len(given):
        raise InputError(subject, got=repr(given)[:80], expected="names of bodies, or None for all")
    return tuple(name_of(subject, name) for name in given)


def _knots(subject: str, given: Any) -> tuple[int, ...] | None:
    """Convert whole numbers to a tuple. None means all knots and is returned unchanged."""
    if given is None:
        return None
    array = np.atleast_1d(np.asarray(given))
    if array.ndim != 1 or not len(array) or not np.issubdtype(array.dtype, np.integer):
        raise InputError(subject, got=repr(given)[:80], expected="whole numbers, or None for all knots")
    return tuple(int(k) for k in array)


def _rotation(subject: str, given: Any) -> tuple[tuple[float, ...], ...]:
    """Return the rows of a rotation matrix from a matrix (3, 3) or a quaternion w, x, y, z."""
    if np.shape(given) != (4,):
        return tuple(map(tuple, finite_array(subject, given, (3, 3)).tolist()))
    quaternion = finite_array(subject, given, (4,))
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > SAME_ROTATION:
        raise InputError(subject, got=f"a quaternion of norm {norm:.6g}", expected="norm 1")
    return tuple(map(tuple, rotation(quaternion / norm).tolist()))


def _not_negative(subject: str, value: Any) -> float:
    return 0.0 if type(value) in (int, float) and not value else positive_float(subject, value)


def _size(subject: str, given: Any) -> tuple[float, ...]:
    size = vector(subject, given)
    if min(size) <= 0:
        raise InputError(f"{subject} [m]", got=list(size), expected="three numbers above 0")
    return size


CHECKS: dict[str, Callable[[str, Any], Any]] = {
    "frame": name_of,
    "knots": _knots,
    "links": names_of,
    "margin": _not_negative,
    "rotation": _rotation,
    "size": _size,
    **dict.fromkeys(("point", "axis", "center"), vector),
    **dict.fromkeys(("position", "velocity", "angular_velocity"), _with_gaps),
    **dict.fromkeys(("tolerance", "rotation_tolerance", "angular_tolerance", "radius", "weight"), positive_float),
    **dict.fromkeys(("clearance", "slip", "touch"), positive_float),
}

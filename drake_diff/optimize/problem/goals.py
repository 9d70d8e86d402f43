"""What a robot is to do, in its own words: a hand at a target, joints at angles, a tray kept level.

A goal is a few plain values and holds no model. The `Problem` binds it to its own: names are checked there, and what
comes out are `GoalConstraint`s, which every method takes as it takes any `Constraint`. A record has the values, and
`verify` binds them again. `marks` is what a page draws.

A plan keeps a goal to half of its tolerance, and each replay on which the verdict rests to the whole of it: steps of
another length end a little elsewhere.
"""

from collections.abc import Callable
from dataclasses import KW_ONLY, MISSING, dataclass, fields
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, array_with_gaps, finite_array, positive_float
from drake_diff.exceptions import InputError
from drake_diff.model.model import Model
from drake_diff.model.quantities import frame_position, frame_rotation_error
from drake_diff.optimize.problem.constraint import Constraint

LAST = (-1,)
PLANNED_PART = 0.5  # of a tolerance: what a plan uses of it, and leaves the rest to the replays
SAME_ROTATION = 1e-3  # of a quaternion's norm from 1: typed by hand, it is made one
GREEN = (0.18, 0.49, 0.2, 0.8)  # red, green, blue, opacity

Numbers = tuple[float | None, ...]  # None where free


@dataclass(frozen=True)
class Mark:
    """What a page draws of a goal: a shape of a size [m], posed in a frame of the model; plain values.

    `shape` and its `size`: "sphere" (radius), "box" (edges x, y, z), "axes" (length of each), "arrow" (x, y, z).
    """

    label: str
    shape: str
    size: tuple[float, ...]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [m] in `frame`
    rotation: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    frame: str = "world"
    colour: tuple[float, float, float, float] = GREEN


@dataclass(frozen=True, eq=False, repr=False)
class GoalConstraint(Constraint):
    """A constraint that a goal comes to, which tells in the goal's own words how far a motion is from it.

    `allowance` is how far beyond its bounds a replay may be, `unit` that of all its numbers. `told` takes the largest
    `miss` of a motion: the distance from the middle of the bounds, or, where only one side is bounded, from that side.
    """

    allowance: float = 0.0
    unit: str = "m"
    words: Callable[[str], str] = (
        str  # what is told of a length or an angle, such as "hand ends 0.3 mm from its target"
    )

    def miss(self, x: Array, u: Array) -> float:
        """How far x (nx,), u (nu,) is from what is wanted, one number in `unit`; inf where it is no number."""
        values, both = self(x, u), np.isfinite(self.lower) & np.isfinite(self.upper)
        off = np.linalg.norm((values - (self.lower + self.upper) / 2)[both]) if np.any(both) else self.excess(x, u)
        return float(off) if np.isfinite(off) else float("inf")

    def told(self, miss: float) -> str:
        """A clause about a motion whose largest `miss` this is."""
        return self.words(in_words(miss, self.unit))


def in_words(value: float, unit: str) -> str:
    """A length, an angle or a speed as people write it: 0.31 mm, 0.002 rad."""
    if unit in ("m", "m/s") and abs(value) < 0.1:
        return f"{1000 * value:.2g} m{unit}"
    return f"{value:.2g} {unit}"


class Goal:
    """The base of all goals: frozen dataclasses of plain values, which a `Problem` binds to its model."""

    def bind(self, model: Model) -> tuple[GoalConstraint, ...]:
        """What has to hold of a motion of `model`; UnknownNameError where it has no such frame or joint."""
        raise NotImplementedError

    def marks(self) -> tuple[Mark, ...]:
        """What a page draws of it."""
        return ()

    def to_dict(self) -> dict[str, Any]:
        """The kind and the values that are not the defaults, for a record: `Kind(**values)` is the goal again."""
        return {type(self).__name__: {name: _plain(value) for name, value in self._given()}}

    def __repr__(self) -> str:
        told = ", ".join(f"{name}={_plain(value)}" for name, value in self._given())
        return f"{type(self).__name__}({told})"

    def _given(self) -> list[tuple[str, Any]]:
        found = [(f, getattr(self, f.name)) for f in fields(self)]  # type: ignore[arg-type]  # all are dataclasses
        return [(f.name, value) for f, value in found if f.default is MISSING or value != f.default]

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)


@dataclass(frozen=True, repr=False)
class FrameGoal(Goal):
    """A point of a robot is at a position, or a frame turned as wanted, or both: at the end, or at other knots.

    The end of a motion is to be at rest as well where nothing says otherwise: give the velocities in `x_goal`, or a
    `FrameVelocityGoal`.

    Args:
        frame: The frame that is to get there; a body's name will do.
        position: (3,) [m] in the world, where `point` is to be; None or NaN where an entry is free.
        rotation: The frame's own in the world: a rotation matrix (3, 3), or a quaternion (4,) as w, x, y, z.
        point: (3,) [m] in `frame`, what is at `position`: its origin, or a tool that it carries.
        tolerance: [m] how far from `position` it may be, in x, in y and in z.
        rotation_tolerance: [rad] how far it may be turned away, about x, about y and about z.
        knots: The knots at which it holds, as those of a `Constraint`; the last one where not given, None for all.

    Raises:
        InputError: Neither a position nor a rotation, or values that are none.
        UnknownNameError: By the Problem: its model has no such frame; the message lists those that exist.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> side = dd.FrameGoal("pole", point=[0, 0, -0.5], position=[-0.3, None, None])
        >>> dd.Problem(model, x0=[0, 0], num_steps=20, goals=[side], running_cost=dd.QuadraticCost(R=[[1.0]]))
        Problem of pendulum: 2 states, 1 input, 20 steps in 1 s
          from x0 = [0., 0.]
          running cost: QuadraticCost(R=[[1.]])
          goal: FrameGoal(frame=pole, position=[-0.3, None, None], point=[0.0, 0.0, -0.5])
          optimize: controls
    """

    frame: str
    position: Any = None  # becomes Numbers
    rotation: Any = None  # becomes a tuple of rows
    _: KW_ONLY
    point: Any = (0.0, 0.0, 0.0)
    tolerance: float = 1e-3
    rotation_tolerance: float = 1e-2
    knots: Any = LAST

    def __post_init__(self) -> None:
        position = None if self.position is None else with_gaps("FrameGoal.position", self.position, 3)
        if self.rotation is None and (position is None or not any(p is not None for p in position)):
            raise InputError("FrameGoal", got="no position and no rotation", expected="one of them, or both")
        self._set(
            frame=name_of("FrameGoal.frame", self.frame),
            position=position,
            rotation=None if self.rotation is None else _rotation("FrameGoal.rotation", self.rotation),
            point=tuple(finite_array("FrameGoal.point", self.point, (3,)).tolist()),
            tolerance=positive_float("FrameGoal.tolerance [m]", self.tolerance),
            rotation_tolerance=positive_float("FrameGoal.rotation_tolerance [rad]", self.rotation_tolerance),
            knots=checked_knots("FrameGoal.knots", self.knots),
        )

    def bind(self, model: Model) -> tuple[GoalConstraint, ...]:
        found, at_end = [], self.knots == LAST
        if self.position is not None:
            where = frame_position(model, self.frame, self.point)

            def at_place(off: str) -> str:
                return f"{self.frame} {'ends' if at_end else 'is at most'} {off} from its target"

            wanted = np.array([np.nan if p is None else p for p in self.position])
            found.append(within(where, wanted, self.tolerance, "m", f"{self.frame} position", self.knots, at_place))
        if self.rotation is not None:
            turned = frame_rotation_error(model, self.frame, np.array(self.rotation))

            def as_turned(off: str) -> str:
                return f"{self.frame} {'ends' if at_end else 'is at most'} {off} turned from its target"

            name, tolerance = f"{self.frame} rotation", self.rotation_tolerance
            found.append(within(turned, np.zeros(3), tolerance, "rad", name, self.knots, as_turned))
        return tuple(found)

    def marks(self) -> tuple[Mark, ...]:
        label, place = f"target of {self.frame}", tuple(p or 0.0 for p in self.position or (0.0,) * 3)
        found = []
        if self.position is not None:
            free = [p is None for p in self.position]
            edges = tuple(1.0 if f else 2 * self.tolerance for f in free)
            ball = Mark(label, "sphere", (max(self.tolerance, 0.015),), place)  # type: ignore[arg-type]
            found.append(Mark(label, "box", edges, place) if any(free) else ball)  # type: ignore[arg-type]
        if self.rotation is not None:
            found.append(Mark(label, "axes", (0.1,), place, self.rotation))  # type: ignore[arg-type]
        return tuple(found)


def within(
    function: Callable[[Any], Any],
    wanted: Array,
    tolerance: float,
    unit: str,
    name: str,
    knots: Any,
    words: Callable[[str], str],
) -> GoalConstraint:
    """`function` (m,) of the state within `tolerance` of `wanted` (m,), NaN where free; see PLANNED_PART."""
    planned = PLANNED_PART * tolerance
    lower, upper = (np.where(np.isnan(wanted), np.sign(side) * np.inf, wanted + side) for side in (-planned, planned))
    return GoalConstraint(function, lower, upper, knots, name, allowance=tolerance - planned, unit=unit, words=words)


def with_gaps(subject: str, values: Any, size: int) -> Numbers:
    """`values` (size,) as a tuple of floats, None where they are None or NaN; InputError where one is infinite."""
    try:
        given = [np.nan if v is None else v for v in values]
    except TypeError as error:
        raise InputError(subject, got=repr(values)[:80], expected=f"{size} numbers, None where free") from error
    array = array_with_gaps(subject, given, (size,))
    if np.any(np.isinf(array)):
        raise InputError(subject, got=array.tolist(), expected="finite numbers, None where free")
    return tuple(None if np.isnan(v) else float(v) for v in array)


def name_of(subject: str, given: Any) -> str:
    """`given` where it is a name; InputError of anything else."""
    if not isinstance(given, str) or not given:
        raise InputError(subject, got=repr(given)[:80], expected="a name")
    return given


def checked_knots(subject: str, given: Any) -> tuple[int, ...] | None:
    """Whole numbers as a tuple; None, which is all knots, as it is."""
    if given is None:
        return None
    array = np.atleast_1d(np.asarray(given))
    if array.ndim != 1 or not len(array) or not np.issubdtype(array.dtype, np.integer):
        raise InputError(subject, got=repr(given)[:80], expected="whole numbers, or None for all knots")
    return tuple(int(k) for k in array)


def _rotation(subject: str, given: Any) -> tuple[tuple[float, ...], ...]:
    """The rows of a rotation that is given as a matrix (3, 3) or as a quaternion w, x, y, z."""
    if np.shape(given) != (4,):
        matrix = finite_array(subject, given, (3, 3))
        return tuple(tuple(row) for row in matrix.tolist())
    quaternion = finite_array(subject, given, (4,))
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > SAME_ROTATION:
        raise InputError(subject, got=f"a quaternion of norm {norm:.6g}", expected="norm 1")
    w, x, y, z = (quaternion / norm).tolist()
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def _plain(value: Any) -> Any:
    """Tuples as lists, so that what is written to JSON is what is read again."""
    return [_plain(v) for v in value] if isinstance(value, tuple) else value

"""Schedules of the feet in contact, as goals of a plan, and initial guesses that follow them."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, finite_array, positive_float
from drake_diff.exceptions import InputError
from drake_diff.legs.feet import Legs, Soles
from drake_diff.legs.motion import scheduled_motion, swings, touching
from drake_diff.legs.standing import standing, with_soft_feet
from drake_diff.model.model import Model
from drake_diff.optimize.problem.constraint import StateFunction
from drake_diff.optimize.problem.cost import QuadraticCost, TrackingCost
from drake_diff.optimize.problem.dynamics import coordinates
from drake_diff.optimize.problem.goals import USED, Goal, GoalConstraint, name_of

MIDDLE = 0.25  # part at either end of a swing in which its clearance is not constrained
KEPT = 1000  # number of states with cached positions of the feet
OF_FRICTION = 0.7  # part of the possible friction that a guess uses
# Scales of a plan's deviation from its guess: of quaternions, [m], [rad], [rad/s or m/s] of the base, [rad/s], and of
# inputs relative to the guess's largest; then the weight of the last state relative to a second of motion.
TURN, PLACE, JOINT, BASE_SPEED, JOINT_SPEED, EFFORT, LAST_STATE = 0.3, 0.2, 1.0, 3.0, 10.0, 1.5, 10.0


@dataclass(frozen=True, repr=False)
class ContactSchedule(Goal):
    """The feet that stand in each step, on a ground at z = 0. All other feet swing.

    As a goal of a `Problem` it is a constraint: a standing foot touches the ground and does not slip, a swinging foot
    is above the ground. `guess` computes an initial guess, and `follow` a cost on the distance from it. The plan itself
    uses the model's own steps.

    Args:
        phases: For each phase the number of its steps and its standing feet.
        feet: The feet; by default those of all phases. A foot is a body with spheres or boxes fixed to it.
        clearance: [m] the least height of a swinging foot in the middle half of its swing.
        slip: [m/s] the largest sliding speed of a standing foot.
        touch: [m] the largest height of a standing foot over the ground in a replay; in the plan the height is 0.

    Raises:
        InputError: Invalid values, a different number of steps in the Problem, or a foot without a shape.
        UnknownNameError: The Problem's model has no such foot; the message lists its bodies.

    Example:
        >>> hop = dd.optimize.ContactSchedule([(20, ["left", "right"]), (12, []), (20, ["left", "right"])])
        >>> hop.num_steps, hop.feet
        (52, ('left', 'right'))
    """

    phases: Any  # becomes tuple[tuple[int, tuple[str, ...]], ...]
    _: KW_ONLY
    feet: Any = None  # becomes names
    clearance: float = 5e-3
    slip: float = 0.2
    touch: float = 5e-3

    def _check(self) -> None:
        if not isinstance(self.phases, (list, tuple)) or not self.phases:
            raise InputError("ContactSchedule.phases", got=repr(self.phases)[:80], expected="(steps, feet) per phase")
        phases = tuple(_phase(phase) for phase in self.phases)
        named = tuple(dict.fromkeys(foot for _, standing in phases for foot in standing))
        feet = named if self.feet is None else tuple(name_of("ContactSchedule.feet", foot) for foot in self.feet)
        if not feet or set(named) - set(feet):
            got = f"phases of {', '.join(named) or 'none'}"
            raise InputError("ContactSchedule.feet", got=got, expected=f"some of {', '.join(feet) or 'the feet'}")
        self._set(phases=phases, feet=feet)

    @property
    def num_steps(self) -> int:
        """The number of steps of all phases."""
        return sum(steps for steps, _ in self.phases)

    @property
    def stands(self) -> Any:
        """A mask (N, feet) of the standing feet in each step."""
        rows = [[foot in standing for foot in self.feet] for steps, standing in self.phases for _ in range(steps)]
        return np.array(rows, dtype=bool)

    def bind(self, model: Model) -> tuple[GoalConstraint, ...]:
        return self._bound(model, np.asarray(model.default_state))

    def bind_to(self, problem: Any) -> tuple[GoalConstraint, ...]:
        if problem.num_steps != self.num_steps:
            raise InputError("ContactSchedule.phases", got=f"{self.num_steps} steps", expected=str(problem.num_steps))
        return self._bound(problem.model, np.asarray(problem.x0))

    def _bound(self, model: Model, x0: Array) -> tuple[GoalConstraint, ...]:
        soles = _Soles(Legs.named(model, self.feet, x0[: model.nq]))
        stands, on = self.stands, touching(self.stands)
        alike = dict[bytes, list[int]]()
        for foot in range(len(self.feet)):
            alike.setdefault(stands[:, foot].tobytes(), []).append(foot)
        constraints, most = list[GoalConstraint](), USED * self.slip
        for those in alike.values():
            name, down = ", ".join(self.feet[i] for i in those), on[:, those[0]]
            points = np.flatnonzero(np.isin(soles.legs.owners, those))
            heights = _OfFeet(soles, False, points)
            slides = _OfFeet(soles, True, np.concatenate([2 * points, 2 * points + 1]))
            carries = stands[:, those[0]]
            standing = np.flatnonzero(carries) + 1  # not at the landing knot: longer steps fly a little longer
            still = np.flatnonzero(carries & np.concatenate([carries[:1], carries[:-1]])) + 1
            swung = np.array([k for a, b in swings(down) for k in _middle(a, b, self.num_steps)], dtype=int)
            constraints += _rows(heights, standing, name, "over the ground where it stands", self.touch, upper=0.0)
            clear = self.clearance
            constraints += _rows(heights, swung, name, "short of its clearance where it swings", clear, lower=clear)
            constraints += _rows(slides, still, name, "of slip where it stands", self.slip, lower=-most, upper=most)
        return tuple(constraints)

    def with_soft_feet(self, model: Model) -> Model:
        """Return the model with contact as soft as plans need at its time step, unless its file defines the contact.

        An even share of the weight presses a foot in by 0.0625 m/s times the step. The contact relaxes in 2.5 steps. A
        stiff foot leaves the ground if a search moves it by 0.1 mm, and no derivative predicts this.

        Args:
            model: A model from a file, with a ground.

        Returns:
            `model.changed(...)` with another `stiffness`, `dissipation`, `relaxation_time` and `near_rigid`.

        Raises:
            ModelError: The model was made from a diagram.

        Example:
            >>> model = dd.load_model("models/quadruped.urdf", time_step=0.02, ground=True, actuators="all")
            >>> schedule = dd.optimize.ContactSchedule([(50, ["FL_foot", "FR_foot", "RL_foot", "RR_foot"])])
            >>> schedule.with_soft_feet(model).options["relaxation_time"]
            0.05
        """
        return with_soft_feet(model, len(self.feet))

    def standing(self, model: Model, joints: Any) -> Array:
        """Return the state at rest on all feet, with the given joint positions.

        The base is rolled, pitched and raised until a step of the model leaves the state unchanged.

        Args:
            model: The model, with a ground at z = 0.
            joints: The position [rad or m] of joints by name; other joints have the positions of the file.

        Returns:
            (nx,) the state.

        Raises:
            InputError: The state is not at rest, a foot is off the ground, other bodies touch, or a motor is too weak.
            UnknownNameError: The model has no such foot or joint.

        Example:
            >>> legs = "FL", "FR", "RL", "RR"
            >>> model = dd.load_model("models/quadruped.urdf", time_step=0.02, ground=True, actuators="all")
            >>> schedule = dd.optimize.ContactSchedule([(50, [f"{leg}_foot" for leg in legs])])
            >>> bent = {f"{leg}_hip_pitch": 0.8 for leg in legs} | {f"{leg}_knee": -1.6 for leg in legs}
            >>> x0 = schedule.standing(schedule.with_soft_feet(model), bent)
            >>> round(float(x0[model.state_names.index("trunk_z")]), 3)
            0.247
        """
        posture = np.array(model.default_state[: model.nq])
        if not isinstance(joints, Mapping):
            raise InputError("ContactSchedule.standing: joints", got=repr(joints)[:80], expected="positions by name")
        for index, value in coordinates(model, "ContactSchedule.standing", joints).items():
            if index >= model.nq:
                got = model.state_names[index]
                raise InputError("ContactSchedule.standing: joints", got=got, expected="positions, not velocities")
            posture[index] = float(finite_array(f"ContactSchedule.standing {model.state_names[index]}", value, ()))
        return standing(Legs.named(model, self.feet, posture), posture).x

    def guess(self, model: Model, x0: Any, end: Any = None, *, swing: float = 0.04) -> tuple[Array, Array]:
        """Return a scheduled motion, in which forces at the standing feet move the centre of mass to its target.

        The motion nearly satisfies the model's steps and is an `initial_guess` of `solve`. The result of a solve is the
        search's own motion.

        Args:
            model: The model.
            x0: (nx,) the first state, with its initially standing feet on the ground.
            end: (nq,) the final posture, at rest, with the feet at their last places of contact. It is the first
                posture by default.
            swing: [m] the height of a swing.

        Returns:
            States xs (N+1, nx) and inputs us (N, nu).

        Raises:
            InputError: No forces of the feet within friction allow such a motion, or standing feet are in the air.
        """
        x0 = np.array(model.finite_state("x0", x0))
        last = x0[: model.nq] if end is None else np.array(finite_array("end", end, (model.nq,)))
        legs = Legs.named(model, self.feet, x0[: model.nq])
        self._check_touching(legs, x0)
        height, friction = positive_float("swing [m]", swing), OF_FRICTION * float(np.min(legs.frictions))
        return scheduled_motion(model, legs, x0, last, self.stands, height, friction)

    def _check_touching(self, legs: Legs, x0: Array) -> None:
        """Raise InputError if the initial state has feet in the air that stand in the first step."""
        legs.put(x0[: legs.model.nq])
        over, standing = legs.heights(), np.flatnonzero(self.stands[0])
        if not len(standing):
            return
        worst = standing[np.argmax(over[standing])]
        if over[worst] > self.touch or np.min(over[standing]) >= 0:
            got = f"{self.feet[worst]} at {1e3 * over[worst]:.3g} mm above the ground"
            expected = "standing feet that press into the ground; see ContactSchedule.standing"
            raise InputError("ContactSchedule: x0", got=got, expected=expected)

    def follow(self, model: Model, guess: tuple[Array, Array]) -> dict[str, Any]:
        """Return the costs of a Problem that stays near a guess and ends at rest at the guess's final posture.

        Args:
            model: The model.
            guess: The result of `guess`, or another motion xs (N+1, nx), us (N, nu).

        Returns:
            The `running_cost` and `final_cost` by name, for `Problem(model, ..., **schedule.follow(model, guess))`.
        """
        xs, us = guess
        base = Legs.named(model, self.feet, xs[0, : model.nq]).base_q
        unit = np.concatenate([np.full(model.nq, JOINT), np.full(model.nv, JOINT_SPEED)])
        unit[base : base + 4], unit[base + 4 : base + 7] = TURN, PLACE
        unit[model.nq + base : model.nq + base + 6] = BASE_SPEED
        effort = EFFORT * max(float(np.max(np.abs(us))), 1e-9)
        Q, times = np.diag(unit**-2.0), model.time_step * np.arange(len(xs))
        table = times, xs, np.vstack([us, us[-1:]])
        end = np.concatenate([xs[-1, : model.nq], np.zeros(model.nv)])
        return {
            "running_cost": TrackingCost(table, Q=Q, R=np.eye(model.nu) / effort**2),
            "final_cost": QuadraticCost(Q=LAST_STATE * Q, x_ref=end),
        }


class _Soles:
    """Heights and sliding velocities of the feet's contact points, with a cache of the last KEPT states."""

    def __init__(self, legs: Legs):
        self.legs, self.read = legs, dict[bytes, tuple[Array, Array]]()  # the plant's values, which are slow to read
        self.known: dict[Any, dict[bytes, tuple[Array, Array]]] = {self._values: {}, self._slopes: {}}

    def values(self, xs: Array) -> list[tuple[Array, Array]]:
        """Return heights (n,) [m] over the ground and sliding velocities (2 n,) [m/s] at each of xs (K, nx)."""
        return self._cached(xs, self._values)

    def slopes(self, xs: Array) -> list[tuple[Array, Array]]:
        """Return the derivatives (n, nx) and (2 n, nx) of `values`."""
        return self._cached(xs, self._slopes)

    def _cached(self, xs: Array, evaluate: Callable[[Array, Soles], tuple[Array, Array]]) -> list[tuple[Array, Array]]:
        known = self.known[evaluate]
        for memory in (known, self.read):
            if len(memory) > KEPT:
                memory.clear()
        new = {x.tobytes(): x for x in xs if x.tobytes() not in known}
        if new:
            self.read.update({key: self.legs.read(x) for key, x in new.items() if key not in self.read})
            pair = evaluate(np.array(list(new.values())), self.legs.soles([self.read[key] for key in new]))
            known.update(zip(new, zip(*pair, strict=True), strict=True))
        return [known[x.tobytes()] for x in xs]

    def _values(self, xs: Array, soles: Soles) -> tuple[Array, Array]:
        slides = soles.velocities(xs[:, self.legs.model.nq :])[..., :2].reshape(len(xs), -1)
        return soles.places[..., 2], slides

    def _slopes(self, xs: Array, soles: Soles) -> tuple[Array, Array]:
        v, (count, nv) = xs[:, self.legs.model.nq :], (len(xs), self.legs.model.nv)
        moves, turned = soles.moves.swapaxes(2, 3), soles.slopes(v).swapaxes(2, 3)
        tangent = np.array([self.legs.space.derivative_of_minus(x) for x in xs])
        heights, by_v = moves[:, :, 2], moves[:, :, :2].reshape(count, -1, nv)
        by_q = turned[:, :, :2].reshape(count, -1, nv)
        return heights @ tangent[:, :nv], by_q @ tangent[:, :nv] + by_v @ tangent[:, nv:]


@dataclass(frozen=True, eq=False)
class _OfFeet(StateFunction):
    """Some `rows` of the heights, or of the sliding velocities, of `soles`."""

    soles: _Soles
    slides: bool
    rows: Indices

    def values(self, xs: Array) -> Array:
        return np.array([pair[self.slides][self.rows] for pair in self.soles.values(xs)])

    def linearize(self, xs: Array) -> tuple[Array, Array]:
        return self.values(xs), np.array([pair[self.slides][self.rows] for pair in self.soles.slopes(xs)])


def _rows(
    function: Callable[[Any], Any], knots: Indices, name: str, off: str, tolerance: float, **sides: Any
) -> Iterator[GoalConstraint]:
    """Yield a constraint on `function` within `sides` at `knots`, if any; `off` describes a violation."""
    if not len(knots):
        return
    unit = "m/s" if off.startswith("of slip") else "m"
    indices = tuple(int(k) for k in knots)
    label = f"{name}: {off}"
    yield GoalConstraint(function, knots=indices, name=label, tolerance=tolerance, unit=unit, norm=np.inf, **sides)


def _phase(given: Any) -> tuple[int, tuple[str, ...]]:
    expected = "(number of steps, names of the feet that stand)"
    if not (isinstance(given, (list, tuple)) and len(given) == 2) or isinstance(given[1], str):
        raise InputError("ContactSchedule.phases", got=repr(given)[:80], expected=expected)
    steps, standing = given
    if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1:
        raise InputError("ContactSchedule.phases", got=repr(given)[:80], expected=expected)
    return int(steps), tuple(name_of("ContactSchedule.phases", foot) for foot in standing)


def _middle(a: int, b: int, last: int) -> range:
    """Return the knots of a swing from a to b without its first and last part, except at the ends of the motion."""
    margin = MIDDLE * (b - a)
    return range(math.ceil(a + margin) if a > 0 else 1, (math.floor(b - margin) if b < last else last) + 1)

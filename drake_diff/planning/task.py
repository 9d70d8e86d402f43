"""What a robot is asked to do: goals by the names of frames and joints, and postures that keep them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.mechanics.quantities import frame_position
from drake_diff.model.model import Model
from drake_diff.optimize.problem.obstacles import Obstacle
from drake_diff.planning.around import Space
from drake_diff.planning.motion import PEAK, speed_limits
from drake_diff.planning.posture import HELD, TOUCHING, share_to_hold
from drake_diff.planning.robot import Robot

DAMPING = 1e-3  # of the least squares, in the unit of the Jacobian
DIFFERENCE = 1e-6  # [rad or m] of a Jacobian: errors of 1e-10 do not matter to a search
ITERATIONS = 150
FARTHEST = 0.3  # [rad or m] of one iteration
REACHED = 1e-6  # [m]
SEEDS = 12  # first postures of inverse kinematics
MORE_SEEDS = 40  # where obstacles are in the way
CANDIDATES = 3  # postures that are tried
MOVE = 0.25  # part of a joint's range that a random goal is away, at most
RANDOM = 2  # goals that are drawn where none is asked for
SOON = 2.0  # [s] a random goal is no further than what its joints do in that time
DRAWS = 50
NEARER = 0.5


@dataclass(frozen=True, eq=False)
class Task:
    """Goals of one robot: positions (3,) of frames, positions of joints by their place in q; none is a random goal.

    `avoid` is what it keeps clear of on its way.
    """

    frames: Mapping[str, Array]
    joints: Mapping[int, float]
    avoid: tuple[Obstacle, ...] = ()

    @property
    def is_free(self) -> bool:
        """Whether nothing is asked for."""
        return not self.frames and not self.joints


def asked(model: Model, goals: Mapping[str, Any], avoid: Sequence[Obstacle] = ()) -> Task:
    """The task that `goals` are for `model`: a name with three numbers is a frame's, with one a joint's.

    Raises UnknownNameError where there is no such frame or joint, InputError where the numbers do not fit.
    """
    places: dict[str, Array] = {}
    angles: dict[int, float] = {}
    of_joints = {name.rpartition("_")[0]: i for i, name in enumerate(model.position_names)}
    for name, value in goals.items():
        numbers = np.atleast_1d(np.asarray(value, dtype=float))
        if len(numbers) == 3:
            frame_position(model, name)  # which names the frames where this is none
            places[name] = finite_array(f"goal {name} [m]", numbers, (3,))
        elif len(numbers) == 1:
            if name not in of_joints or (model.nq != model.nv and of_joints[name] < model.nq - model.nv + 6):
                raise UnknownNameError("goal: joint", got=name, known=of_joints)
            index = of_joints[name]
            low, high = model.contract.positions[index].lower, model.contract.positions[index].upper
            if not low <= numbers[0] <= high:
                expected = f"a position within its limits [{low:g}, {high:g}]"
                raise InputError(f"goal {name}", got=numbers[0], expected=expected)
            angles[index] = float(numbers[0])
        else:
            expected = "three numbers (the position of a frame) or one (that of a joint)"
            raise InputError(f"goal {name}", got=f"{len(numbers)} numbers", expected=expected)
    for obstacle in avoid:
        if not isinstance(obstacle, Obstacle):
            raise InputError("avoid", got=repr(obstacle)[:80], expected="SphereObstacles and BoxObstacles")
    return Task(places, angles, tuple(avoid))


def postures(robot: Robot, task: Task, seed: int) -> list[Array]:
    """Postures (nq,) that keep the task, the nearest to the start first; ModelError where none is found.

    Where nothing is asked for it is a random one: inside the limits, without overlap, and held by its motors.
    """
    random, space = np.random.default_rng([seed, 1]), Space.of(robot, task.avoid)
    if task.is_free:
        return _random_goals(space, random)
    start, fixed = robot.q.copy(), np.zeros(robot.model.nq, dtype=bool)
    for index, value in task.joints.items():
        start[index], fixed[index] = value, True
    if not task.frames:
        space.check("goal", start)
        return [start]
    candidates: list[Array] = []
    nearest, blocked = np.inf, ""
    for i in range(MORE_SEEDS if task.avoid else SEEDS):
        if len(candidates) >= CANDIDATES and i >= SEEDS:
            break
        first = start if i == 0 else np.where(fixed, start, random.uniform(robot.lower, robot.upper))
        q, off = _reached(robot, task, first, fixed)
        nearest = min(nearest, off)
        if off <= REACHED and robot.overlap(q) <= TOUCHING and share_to_hold(robot.model, q) <= 1.0:
            blocked = space.told(q)
            candidates += [] if blocked else [q]
    if not candidates and blocked:
        expected = f"a goal that some posture reaches clear of all obstacles; {MORE_SEEDS} were tried"
        raise InputError(f"goal {', '.join(task.frames)}", got=f"at the goal {blocked}", expected=expected)
    if not candidates:
        criteria = "inside all limits, without overlap and held by the motors"
        if nearest > REACHED:
            criteria = f"inside all limits: the nearest of {SEEDS} tries is {nearest:.3g} m away"
        raise ModelError(f"no posture was found with {', '.join(task.frames)} at its goal, {criteria}")
    return sorted(candidates, key=lambda q: float(np.max(np.abs(q - robot.q))))[:CANDIDATES]


def _reached(robot: Robot, task: Task, q: Array, fixed: Array) -> tuple[Array, float]:
    """Damped least squares from posture q (nq,), inside the limits; the posture and how far [m] it is off.

    Source: Buss, "Introduction to inverse kinematics with Jacobian transpose, pseudoinverse and damped least squares
    methods", 2009.
    """
    model = robot.model
    inside = 0.01 * (robot.upper - robot.lower)
    low, high = robot.lower + inside, robot.upper - inside
    low, high = np.where(fixed, q, low), np.where(fixed, q, high)
    goal = np.concatenate(list(task.frames.values()))
    functions = [frame_position(model, name) for name in task.frames]

    def places(q: Array) -> Array:
        x = np.concatenate([q, np.zeros(model.nv)])
        return np.concatenate([np.asarray(function(x), dtype=float) for function in functions])

    q, off = np.clip(q, low, high), np.inf
    for _ in range(ITERATIONS):
        error = goal - places(q)
        off = float(np.max(np.abs(error)))
        if off <= REACHED / 10:
            break
        steps = DIFFERENCE * np.eye(len(q))
        jacobian = np.array([(places(q + d) - places(q - d)) / (2 * DIFFERENCE) for d in steps]).T
        pushed = jacobian.T @ error
        jacobian = np.where(((q <= low) & (pushed < 0)) | ((q >= high) & (pushed > 0)), 0.0, jacobian)
        damped = jacobian @ jacobian.T + (min(DAMPING, off**2) + 1e-12) * np.eye(len(error))
        change = jacobian.T @ np.linalg.solve(damped, error)
        change *= min(1.0, FARTHEST / max(float(np.max(np.abs(change))), 1e-12))
        q = np.clip(q + change, low, high)
    return q, off


def _random_goals(space: Space, random: np.random.Generator) -> list[Array]:
    """Some of those; ModelError where none is found."""
    drawn = [_random_posture(space, random) for _ in range(RANDOM)]
    goals = [q for q in drawn if q is not None]
    if not goals:
        message = "no posture to go to was found: none that was drawn is clear of all shapes and held by the motors"
        raise ModelError(f"{message}: give a goal")
    return goals


def _random_posture(space: Space, random: np.random.Generator) -> Array | None:
    """Some way off the start, inside the limits, where nothing is touched and the motors hold the weight, best within
    HELD; None where none of those drawn is."""
    robot = space.robot
    far = speed_limits(robot.model) * SOON / PEAK
    reach = np.minimum(MOVE * (robot.upper - robot.lower), far)
    margin = 0.2 * MOVE * (robot.upper - robot.lower)
    best, least = None, 1.0
    for i in range(DRAWS):
        fraction = NEARER ** (i // (DRAWS // 5))  # some robots can only hold what is near
        q = robot.q + fraction * random.uniform(-1, 1, len(reach)) * reach
        q = np.clip(q, robot.lower + margin, robot.upper - margin)
        if any(robot.overlap(robot.q + s * (q - robot.q)) > TOUCHING for s in (0.25, 0.5, 0.75, 1.0)):
            continue
        if space.told(q):
            continue
        load = max(share_to_hold(robot.model, robot.q + s * (q - robot.q)) for s in (0.5, 1.0))
        if load <= HELD:
            return q
        if load < least:
            best, least = q, load
    return best

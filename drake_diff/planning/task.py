"""What a robot is asked to do: goals and obstacles by their names, and the postures that keep them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable

from drake_diff._base.arrays import Array, finite_array
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, joints, labelled
from drake_diff.model.step import set_state
from drake_diff.planning.motion import OF_EFFORT, weights_held
from drake_diff.planning.robot import TOUCHING, Robot, overlap

DAMPING = 1e-3  # of the least squares, in the unit of the Jacobian
ITERATIONS = 200
REACHED = 1e-6  # [m]
SEEDS = 12  # first postures of inverse kinematics
MOVE = 0.25  # part of a joint's range that a random goal is away, at most
DRAWS = 50


@dataclass(frozen=True, eq=False)
class Task:
    """Goals of one robot: positions (3,) of frames, positions of joints; neither is a random goal."""

    frames: Mapping[str, Array]
    joints: Mapping[str, float]

    @property
    def is_free(self) -> bool:
        """Whether nothing is asked for."""
        return not self.frames and not self.joints


def asked(model: Model, goals: Mapping[str, Any]) -> Task:
    """The task that `goals` are for `model`: a name with three numbers is a frame, with one a joint.

    Raises UnknownNameError where there is no such frame or joint, InputError where the numbers do not fit.
    """
    plant = model.plant
    frames = {plant.get_body(b).name() for b in plant.GetBodyIndices(plant.world_body().model_instance())}
    frames = {b.name() for b in bodies(plant)} | {plant.get_frame(i).name() for i in _frame_indices(plant)}
    single = {name: joint for name, joint in labelled(joints(plant)).items() if joint.num_positions() == 1}
    places: dict[str, Array] = {}
    angles: dict[str, float] = {}
    for name, value in goals.items():
        numbers = np.atleast_1d(np.asarray(value, dtype=float))
        if len(numbers) == 3:
            if name not in frames:
                raise UnknownNameError("goal of a frame", got=name, known=sorted(frames))
            places[name] = finite_array(f"goal {name} [m]", numbers, (3,))
        elif len(numbers) == 1:
            if name not in single:
                raise UnknownNameError("goal of a joint", got=name, known=sorted(single))
            angles[name] = float(finite_array(f"goal {name}", numbers, (1,))[0])
        else:
            expected = "three numbers (the position of a frame) or one (of a joint)"
            raise InputError(f"goal {name}", got=f"{len(numbers)} numbers", expected=expected)
    return Task(places, angles)


def _frame_indices(plant: Any) -> Sequence[Any]:
    from pydrake.multibody.tree import FrameIndex

    return [FrameIndex(i) for i in range(plant.num_frames())]


def postures(robot: Robot, task: Task, seed: int) -> list[Array]:
    """Postures (nq,) that keep the task, the nearest to the start first; ModelError where none is found.

    A random one where nothing is asked for: inside the limits, without overlap, and held by its motors.
    """
    random = np.random.default_rng([seed, 1])
    if task.is_free:
        return [_random_posture(robot, random)]
    start = robot.q.copy()
    fixed = np.zeros(robot.model.nq, dtype=bool)
    named = labelled(joints(robot.model.plant))
    for name, value in task.joints.items():
        at = named[name].position_start()
        low, high = robot.model.plant.GetPositionLowerLimits()[at], robot.model.plant.GetPositionUpperLimits()[at]
        if not low <= value <= high:
            raise InputError(f"goal {name}", got=value, expected=f"a position within its limits [{low:g}, {high:g}]")
        start[at], fixed[at] = value, True
    if not task.frames:
        return [start]
    found, nearest = [], np.inf
    for i in range(SEEDS):
        first = start if i == 0 else np.where(fixed, start, random.uniform(robot.lower, robot.upper))
        q, off = _reached(robot, task, first, fixed)
        nearest = min(nearest, off)
        if off <= REACHED and overlap(robot.model, q) <= TOUCHING and weights_held(robot.model, q) <= 1.0:
            found.append(q)
    if not found:
        raise ModelError(
            f"no posture was found in which {', '.join(task.frames)} is at its goal, inside all limits and without "
            f"overlap: the nearest of {SEEDS} tries is {nearest:.3g} m away"
        )
    return sorted(found, key=lambda q: float(np.max(np.abs(q - robot.q))))[:4]


def _reached(robot: Robot, task: Task, q: Array, fixed: Array) -> tuple[Array, float]:
    """Damped least squares from posture q (nq,), inside the limits; the posture and how far [m] it is off."""
    model = robot.model
    plant, context = model.double.plant, model.double.context
    inside = 0.01 * (robot.upper - robot.lower)
    low, high = robot.lower + inside, robot.upper - inside
    q, off = np.clip(q, low, high), np.inf
    world = plant.world_frame()
    for _ in range(ITERATIONS):
        set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
        rows, errors = [], []
        for name, goal in task.frames.items():
            frame = plant.GetFrameByName(name)
            errors.append(goal - frame.CalcPoseInWorld(context).translation())
            rows.append(
                plant.CalcJacobianTranslationalVelocity(
                    context, JacobianWrtVariable.kQDot, frame, np.zeros(3), world, world
                )
            )
        error, jacobian = np.concatenate(errors), np.vstack(rows)
        off = float(np.max(np.abs(error)))
        if off <= REACHED / 10:
            break
        at_limit = ((q <= low) & (jacobian.T @ error < 0)) | ((q >= high) & (jacobian.T @ error > 0)) | fixed
        jacobian = np.where(at_limit, 0.0, jacobian)
        damping = min(DAMPING, off**2) + 1e-12
        change = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(len(error)), error)
        change *= min(1.0, 0.3 / max(float(np.max(np.abs(change))), 1e-12))
        q = np.clip(q + change, low, high)
    return q, off


def _random_posture(robot: Robot, random: np.random.Generator) -> Array:
    """Some way off the start, inside the limits, where nothing overlaps and the motors hold the weight."""
    reach = MOVE * (robot.upper - robot.lower)
    best, least = robot.q, np.inf
    for i in range(DRAWS):
        part = 1.0 if i < DRAWS // 2 else 0.3  # some robots can only hold what is near
        q = np.clip(robot.q + part * random.uniform(-1, 1, len(reach)) * reach, robot.lower, robot.upper)
        q = np.clip(q, robot.lower + 0.2 * reach, robot.upper - 0.2 * reach)
        if overlap(robot.model, q) > TOUCHING or overlap(robot.model, (q + robot.q) / 2) > TOUCHING:
            continue
        load = weights_held(robot.model, q)
        if load <= 0.7 * OF_EFFORT:
            return q
        if load < least:
            best, least = q, load
    return best

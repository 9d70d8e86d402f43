"""A way through the air for bodies that nothing but thrusters drives."""

from collections.abc import Mapping

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import InputError
from drake_diff.mechanics.quantities import frame_position
from drake_diff.model.model import Model
from drake_diff.model.step import advance
from drake_diff.planning.motion import LONGEST, PEAK, SHORTEST, STEPS, Guess, smooth
from drake_diff.planning.posture import TOUCHING, shares
from drake_diff.planning.robot import Robot
from drake_diff.planning.thrusters import floating

SPEED, TURN = 1.0, 1.0  # [m/s], [rad/s] at most on the way
FAR, TURNED = (1.0, 1.0, 0.5), 1.0  # [m], [rad] to each side: a random goal
UP = 0.75  # [m] of its middle
DRAWS = 20


def flight(robot: Robot, places: Mapping[str, Array], seed: int) -> Guess:
    """A smooth flight of what floats to where the frames of `places` are at theirs (3,) [m], at rest.

    Without places each body goes to a random one, by a straight line on which nothing overlaps, turned about the
    vertical.
    """
    model, random = robot.model, np.random.default_rng([seed, 4])
    free = floating(model)
    best: Guess | None = None
    for _ in range(1 if places else DRAWS):
        shifts, turns = np.zeros((len(free), 3)), np.zeros(len(free))
        if not places:
            shifts = np.array(FAR) * random.uniform(-1, 1, shifts.shape) + np.array([0.0, 0.0, UP])
            turns = TURNED * random.uniform(-1, 1, turns.shape)
        for name, position in places.items():
            i = _carrier(robot, name)
            missing = position - np.asarray(frame_position(model, name)(np.concatenate([robot.q, np.zeros(model.nv)])))
            shifts[i] = missing
        candidate = _flown(robot, shifts, turns)
        if best is None or candidate.depth < best.depth:
            best = candidate
        if best.depth <= TOUCHING:
            break
    assert best is not None  # noqa: S101  there is one draw at least
    return best


def _flown(robot: Robot, shifts: Array, turns: Array) -> Guess:
    """Each body moved by its shift (3,) and turned by its angle about the vertical, as fast as this module allows."""
    model = robot.model
    far = max(float(np.max(np.linalg.norm(shifts, axis=1))) / SPEED, float(np.max(np.abs(turns))) / TURN)
    duration = float(np.clip(PEAK * far, SHORTEST, LONGEST))
    steps = int(np.clip(round(duration / model.time_step), *STEPS))
    if duration / steps > 1.25 * model.time_step:
        model = model.at_time_step(float(f"{duration / steps:.1g}"))
    s = smooth(np.clip(np.arange(steps + 1) / (steps - 1), 0.0, 1.0))
    x = np.concatenate([robot.q, np.zeros(model.nv)])
    xs, us = [x], []
    for k in range(steps):
        wanted = np.zeros(model.nv)
        for i, (_, _, v) in enumerate(floating(model)):
            wanted[v + 2 : v + 6] = np.append(turns[i], shifts[i]) * (s[k + 1] - s[k]) / model.time_step
        us.append(_inputs(model, x, wanted))
        x = np.array(advance(model.double, x, us[-1]))
        xs.append(x)
    depth = max(robot.overlap(x[: model.nq]) for x in xs[:: max(1, steps // 25)])
    name = "a straight line through the air"
    return Guess(name, model, np.array(xs), np.array(us), float(np.max(shares(model, np.array(us)))), depth)


def _inputs(model: Model, x: Array, wanted: Array) -> Array:
    """(nu,) the inputs whose step from x (nx,) leads to the velocities `wanted` (nv,): a step is linear in them."""
    nq, none = model.nq, np.zeros(model.nu)
    fallen = np.array(advance(model.double, x, none))[nq:]
    effect = np.array([np.array(advance(model.double, x, u))[nq:] - fallen for u in np.eye(model.nu)]).T
    return np.asarray(np.linalg.lstsq(effect, wanted - fallen, rcond=None)[0])


def _carrier(robot: Robot, name: str) -> int:
    """Which of the floating bodies carries a frame or body: the one that takes it along."""
    locate, still = frame_position(robot.model, name), np.zeros(robot.model.nv)
    free = floating(robot.model)
    for i, (_, q_start, _) in enumerate(free):
        moved = robot.q.copy()
        moved[q_start + 4] += 1.0
        if np.any(locate(np.concatenate([moved, still])) != locate(np.concatenate([robot.q, still]))):
            return i
    raise InputError("goals", got=name, expected=f"a frame on what flies: {', '.join(label for label, _, _ in free)}")

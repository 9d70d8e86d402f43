"""From one posture in which a robot stands to another, its feet where they are."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.mechanics.quantities import frame_position
from drake_diff.model.step import advance, set_state
from drake_diff.motion.policy import TVLQR
from drake_diff.planning.feet import center_of_mass
from drake_diff.planning.standing import (
    INSIDE,
    Legged,
    Rest,
    Wish,
    find_posture,
    hold,
    input_limits,
    settled,
    weights,
)

DURATIONS, HELD = (0.6, 1.0), 0.2  # [s] of a motion, and of holding its end
SIZES = ((1.0, 1.0), (1.0, 0.2), (0.5, 0.2), (0.25, 0.1), (0.12, 0.0))  # of a random shift of the base and of the arms
TURNED, SHIFTED, LOWERED = 0.1, 0.06, 0.12  # [rad], and shares of the height of the centre of mass: of the base
MOVED = 0.1  # of the range of a joint that is no leg's
ARRIVED, AT_REST = 0.01, 0.02  # [rad or m] off the rest that was to be reached, [rad/s or m/s] there
FEET_STAY = 1e-3  # [m] how far a foot may be from where it stood in a posture that is found
FREE_BASE, FREE_JOINT, KEPT = 0.1, 0.3, 1e-5  # [rad or m] off what is wished for that counts as 1
BASE_TURN, BASE_PLACE = 0.003, 0.001  # the same of a base that is told where to be
ALONG = 0.05  # the same on the way
OVER_FEET = 0.02  # [m] the same of the centre of mass
CORRECTIONS, FRAME_MISS, JOINT_MISS = 3, 3e-4, 1e-3  # [m], [rad or m]: what needs no other try


@dataclass(frozen=True, eq=False)
class Shift:
    """A motion xs (N+1, nx) under us (N, nu) of the model's own steps, and the rest that it goes to."""

    xs: Array
    us: Array
    end: Rest


def random_shift(robot: Legged, start: Rest, seed: Sequence[int], depth: Callable[[Array], float]) -> Shift | Refusal:
    """To a posture drawn at random, the base lower and shifted and the arms moved; or why none was found.

    `depth` tells how deep [m] shapes overlap in a posture: more than at the start is not wanted.
    """
    random = np.random.default_rng([*seed, 4])
    model, q0 = robot.model, start.x[: robot.model.nq]
    deepest, feet = max(depth(q0), 1e-4), robot.soles(q0)[0]
    tall = float(center_of_mass(model)[0][2])
    base, near = robot.base_v, np.full(model.nv, FREE_JOINT)
    near[base : base + 6] = np.repeat([BASE_TURN, BASE_PLACE], 3)
    legs = {i for foot in robot.feet for i in foot.joints}
    arms = np.array([i for i, v in enumerate(robot.joint_v) if v not in legs], dtype=int)
    low, high = robot.limits(0.0)
    why = Refusal("")
    for size, of_arms in SIZES:
        way = np.zeros(model.nv)
        way[base : base + 3] = size * TURNED * random.uniform(-1, 1, 3)
        way[base + 3 : base + 5] = size * SHIFTED * tall * random.uniform(-1, 1, 2)
        way[base + 5] = -size * LOWERED * tall * random.uniform(0.5, 1)
        way[robot.joint_v[arms]] = of_arms * MOVED * random.uniform(-1, 1, len(arms)) * (high - low)[arms]
        wish = Wish(robot.moved(q0, way), near, feet, inside=INSIDE / 2)
        shift = reached(robot, start, find_posture(robot, q0, wish), feet)
        if isinstance(shift, Refusal):
            why = shift
        elif max(depth(x[: model.nq]) for x in shift.xs[:: max(1, len(shift.us) // 20)]) > deepest:
            why = Refusal("its own shapes would overlap")
        else:
            return shift
    return why


def shift_to(robot: Legged, start: Rest, frames: Mapping[str, Array], joints: Mapping[int, float]) -> Shift | Refusal:
    """To where frames (3,) [m] by name and joints by their place in q are as asked, the feet where they stand."""
    model, q0 = robot.model, start.x[: robot.model.nq]
    feet, base = robot.soles(q0)[0], robot.base_v
    near = np.full(model.nv, FREE_JOINT)
    near[base : base + 6] = FREE_BASE
    indices = list(joints)
    near[[i - 1 if i > robot.base_q else i for i in indices]] = KEPT
    asked, aimed = np.array(list(joints.values())), np.array(list(joints.values()))
    places = {name: np.array(position) for name, position in frames.items()}
    shift: Shift | Refusal = Refusal("")
    for _ in range(CORRECTIONS + 1):
        q = q0.copy()
        q[indices] = aimed
        wish = Wish(q, near, feet, balanced=OVER_FEET, frames=places)
        shift = reached(robot, start, find_posture(robot, q0, wish), feet)
        if isinstance(shift, Refusal):
            return shift
        end = shift.xs[-1]
        misses = {name: frames[name] - np.asarray(frame_position(model, name)(end)) for name in frames}
        off = asked - end[indices]
        far = max((float(np.max(np.abs(miss))) for miss in misses.values()), default=0.0)
        if far < FRAME_MISS and np.max(np.abs(off), initial=0.0) < JOINT_MISS:
            return shift
        aimed = aimed + off
        places = {name: position + misses[name] for name, position in places.items()}
    return Refusal(
        f"its frames end {far:.2g} m and its joints {np.max(np.abs(off), initial=0.0):.2g} off what is asked"
    )


def reached(robot: Legged, start: Rest, q: Array, feet: Array) -> Shift | Refusal:
    """From rest to posture q (nq,), if that is one in which the robot stands with its `feet` (n, 3) where they are."""
    off = float(np.max(np.abs(robot.soles(q)[0] - feet)))
    if off > FEET_STAY:
        return Refusal(f"its feet would have to move by {off:.2g} m")
    stance = hold(robot, q)
    end = stance if isinstance(stance, Refusal) else settled(robot, stance)
    if isinstance(end, Refusal):
        return end
    why = Refusal("")
    for duration in DURATIONS:
        shift = between(robot, start, end, duration)
        if isinstance(shift, Refusal):
            why = shift
            continue
        x, nq = shift.xs[-1], robot.model.nq
        away, speed = float(np.max(np.abs(robot.apart(x[:nq], end.x[:nq])))), float(np.max(np.abs(x[nq:])))
        if away <= ARRIVED and speed <= AT_REST:
            return shift
        why = Refusal(f"it ends {away:.2g} rad or m from where it would rest, at {speed:.2g} rad/s or m/s")
    return why


def between(robot: Legged, start: Rest, end: Rest, duration: float) -> Shift | Refusal:
    """The model's own steps from one rest to (nearly) another in `duration` [s], the feet on the ground.

    The inputs are those that make a smooth motion of the posture, its forces shared among the feet, and a regulator
    keeps the steps to it.
    """
    model, h = robot.model, robot.model.time_step
    moving, holding = round(duration / h), round(HELD / h)
    q0, q1 = start.x[: model.nq], end.x[: model.nq]
    s = _smooth(moving + 1)
    feet = [robot.soles(q)[0] for q in (q0, q1)]
    way, qs = robot.apart(q1, q0), [q0]
    for fraction in s[1:-1]:
        near = robot.moved(q0, fraction * way)
        wish = Wish(near, np.full(model.nv, ALONG), feet[0] + fraction * (feet[1] - feet[0]))
        qs.append(find_posture(robot, qs[-1], wish))
    qs += [q1] * (holding + 1)
    v = [np.zeros(model.nv)] + [robot.apart(b, a) / h for a, b in pairwise(qs)]
    xs = np.array([np.concatenate([q, speed]) for q, speed in zip(qs, v, strict=True)])
    us = []
    for k in range(moving + 1):
        change = v[k + 1] - v[k]
        set_state(model.double, xs[k])
        stance = hold(robot, qs[k], model.double.inverse_dynamics(change / h) + model.double.damping() * change)
        if isinstance(stance, Refusal):
            return Refusal(f"on the way {stance.reason}")
        us.append(stance.u)
    made = np.array(us[:-1] + [us[-1]] * holding)
    s = np.concatenate([s[:-1], np.ones(holding)])[:, None]
    return _regulated(robot, xs, made + (1 - s) * (start.u - us[0]) + s * (end.u - us[-1]), end)


def _smooth(count: int) -> Array:
    """(count,) from 0 to 1, at rest at both ends."""
    s = np.linspace(0, 1, count)
    return np.asarray(10 * s**3 - 15 * s**4 + 6 * s**5)


def _regulated(robot: Legged, xs: Array, us: Array, end: Rest) -> Shift | Refusal:
    """The model's own steps along xs (N+1, nx) under us (N, nu) and a regulator, which must stay within the limits."""
    model = robot.model
    lower, upper = input_limits(model)
    try:
        policy = TVLQR(model, xs, us, *weights(robot, us[0]))
        x, states, inputs = xs[0], [xs[0]], []
        for k in range(len(us)):
            u = np.clip(policy(x, k * model.time_step), lower, upper)
            x = np.array(advance(model.double, x, u))
            states.append(x)
            inputs.append(u)
    except (SimulationError, GradientError) as error:
        return Refusal(f"the motion cannot be stepped: {error}")
    terms = [*model.contract.positions, *model.contract.velocities]
    low, high = np.array([t.lower for t in terms]), np.array([t.upper for t in terms])
    beyond = (low < high) & np.any((np.array(states) < low) | (np.array(states) > high), axis=0)
    if np.any(beyond):
        return Refusal(f"{model.state_names[int(np.argmax(beyond))]} would leave its limits")
    return Shift(np.array(states), np.array(inputs), end)

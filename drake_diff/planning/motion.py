"""Motions to begin a search with: smooth ones of driven joints with their inputs, and those that a controller makes."""

from dataclasses import dataclass, replace

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.exceptions import SimulationError
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.step import advance, set_state
from drake_diff.planning.around import Line
from drake_diff.planning.posture import effort_limits, shares
from drake_diff.planning.robot import Robot, drive

FASTEST = 1.0  # [rad/s or m/s] the peak of a joint without a velocity limit
OF_SPEED = 0.6  # of a velocity limit: the peak of a first guess
SHORTEST, LONGEST = 0.6, 6.0  # [s] a motion
STEPS = (30, 100)  # fewest and most of a plan
OF_EFFORT = 0.9  # of an effort limit: what a first guess may use
PEAK = 1.875  # the greatest slope of the smooth way from 0 to 1
CORRECTIONS = 3
EXACT = 1e-11  # [rad/s or m/s]
PULL, DAMP = 30.0, 9.0  # [1/s^2], [1/s] of a controller
OF_PULL = 0.8  # of an effort limit: what a controller may use


@dataclass(frozen=True, eq=False)
class Guess:
    """A motion xs (N+1, nx) under us (N, nu) of `model`, and what it is called.

    `effort` is the largest share of an effort limit that it takes, `depth` [m] its deepest overlap.
    """

    name: str
    model: Model
    xs: Array
    us: Array
    effort: float
    depth: float = 0.0

    @property
    def num_steps(self) -> int:
        """The number of steps."""
        return len(self.us)

    def in_steps(self, count: int) -> "Guess":
        """The same motion at `count` + 1 even times, for a search whose horizon is free."""
        now, then = np.linspace(0, 1, count + 1), np.linspace(0, 1, len(self.xs))
        xs = np.array([np.interp(now, then, column) for column in self.xs.T]).T
        us = np.array([np.interp((now[1:] + now[:-1]) / 2, (then[1:] + then[:-1]) / 2, c) for c in self.us.T]).T
        return replace(self, xs=xs, us=us)


def speed_limits(model: Model) -> Array:
    """(nv,) what a first guess may use of the velocity limits; FASTEST where there is none, or one of 0."""
    limits = np.array([min(abs(v.lower), abs(v.upper)) for v in model.contract.velocities])
    return np.where((limits > 0) & np.isfinite(limits), np.minimum(OF_SPEED * limits, 5 * FASTEST), FASTEST)


def _inputs(model: Model, x: Array, wanted: Array) -> Array:
    """(nu,) the inputs whose step from x (nx,) leads to the velocities `wanted` (nv,)."""
    twin, h = model.double, model.time_step
    set_state(twin, x)
    change = wanted - x[model.nq :]
    # The step's own equation, whose damping acts on the velocity after it; probing the step would meet joint limits.
    needed = twin.inverse_dynamics(change / h) + twin.damping() * change
    effect = h * np.linalg.solve(twin.mass_matrix() + h * np.diag(twin.damping()), model.actuation)
    u = np.linalg.lstsq(model.actuation, needed, rcond=None)[0]
    for i in range(CORRECTIONS):
        off = wanted - np.array(advance(model.double, x, u))[model.nq :]
        if np.max(np.abs(off), initial=0.0) < EXACT:
            break
        if i == 1:  # controllers in the plant, which the equation does not have
            effect = _probed(model, x, u)
        u = u + np.linalg.lstsq(effect, off, rcond=None)[0]
    return np.asarray(u)


def _probed(model: Model, x: Array, u: Array) -> Array:
    """(nv, nu) what a change of each input by 1 adds to the velocities after the step from x (nx,) with u (nu,)."""
    nq, still = model.nq, np.array(advance(model.double, x, u))[model.nq :]
    return np.array([np.array(advance(model.double, x, u + d))[nq:] - still for d in np.eye(model.nu)]).T


def along(robot: Robot, line: Line, *, slower: float = 1.0) -> Guess:
    """The smooth motion along a line, at rest at both ends, and the inputs that make it.

    It is as fast as the joints' speeds and efforts allow, within the limits of this module. SimulationError where
    Drake cannot take a step of it.
    """
    t = np.linspace(0, 1, 101)
    speeds = np.abs(line.slopes(smooth(t))) * (30 * t**2 * (1 - t) ** 2)[:, None]
    duration = slower * float(np.max(speeds / speed_limits(robot.model), initial=0.0))
    duration = float(np.clip(duration, SHORTEST, LONGEST))
    name = line.name if slower == 1 else f"{line.name} in {slower:g} times the time"
    guess = _timed(robot, name, line, duration)
    while guess.effort > OF_EFFORT and duration < LONGEST:
        duration = min(1.5 * duration, LONGEST)
        guess = _timed(robot, name, line, duration)
    return guess


def _timed(robot: Robot, name: str, line: Line, duration: float) -> Guess:
    model = robot.model
    steps = int(np.clip(round(duration / model.time_step), *STEPS))
    if duration / steps > 1.25 * model.time_step:
        model = model.at_time_step(float(f"{duration / steps:.1g}"))
    h = model.time_step
    # One step before the end it is at the goal, and rests there: Drake's step moves by the velocity after it.
    s = np.clip(np.arange(steps + 1) / (steps - 1), 0.0, 1.0)
    q = line.at(smooth(s))
    v = np.vstack([np.zeros((1, model.nv)), np.diff(q, axis=0) / h])
    us = np.array([_inputs(model, np.concatenate([q[k], v[k]]), v[k + 1]) for k in range(steps)])
    depth = max(robot.overlap(posture) for posture in q[:: max(1, steps // 25)])
    return Guess(name, model, np.hstack([q, v]), us, float(np.max(shares(model, us))), depth)


def smooth(t: Array) -> Array:
    """From 0 to 1 as t does, with a speed and an acceleration of 0 at both ends."""
    return np.asarray(10 * t**3 - 15 * t**4 + 6 * t**5)


def _positions(model: Model) -> Indices:
    """(nv,) where in q the coordinate of each velocity of a joint is."""
    indices = np.arange(model.nv)
    for joint in joints(model.plant):
        q, v = model.places(joint)
        if len(q) == len(v) == 1:
            indices[v[0]] = q[0]
    return indices


def by_controller(robot: Robot, model: Model, target: Array, *, steps: int, reach: float, name: str) -> Guess | None:
    """What `model` of the robot does when each input pulls its own joint toward `target` (nq,), `reach` of the way.

    None where Drake cannot take a step of it.
    """
    x = np.concatenate([robot.q, np.zeros(model.nv)])
    limits = np.minimum(effort_limits(model), 1e4)
    xs, us = [x], []
    try:
        effect = drive(model, robot.q)
        joint_v = np.argmax(np.abs(effect), axis=0)  # the velocity that an input acts on most
        gain = model.time_step / effect[joint_v, np.arange(model.nu)]
        joint_q = _positions(model)[joint_v]
        for k in range(steps):
            s = np.array(min(1.0, 1.25 * (k + 1) / steps))
            aim = robot.q[joint_q] + reach * smooth(s) * (target[joint_q] - robot.q[joint_q])
            u = gain * (PULL * (aim - x[joint_q]) - DAMP * x[model.nq + joint_v])
            u = np.clip(u, -OF_PULL * limits, OF_PULL * limits)
            x = np.array(advance(model.double, x, u))
            xs.append(x)
            us.append(u)
    except SimulationError:
        return None
    depth = max(robot.overlap(x[: model.nq]) for x in xs) if model is robot.apart else 0.0
    return Guess(name, model, np.array(xs), np.array(us), float(np.max(shares(model, np.array(us)))), depth)

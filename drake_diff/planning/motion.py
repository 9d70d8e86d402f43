"""Motions to begin a search with: smooth ones of driven joints with their inputs, and those that a controller makes."""

from dataclasses import dataclass

import numpy as np
from pydrake.multibody.tree import MultibodyForces

from drake_diff._base.arrays import Array
from drake_diff.exceptions import SimulationError
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.step import advance, set_state
from drake_diff.planning.robot import Robot, overlap

FASTEST = 1.0  # [rad/s or m/s] the peak of a joint without a velocity limit
OF_SPEED = 0.6  # of a velocity limit: the peak of a first guess
SHORTEST, LONGEST = 0.6, 6.0  # [s] a motion
STEPS = (30, 100)  # fewest and most of a plan
OF_EFFORT = 0.9  # of an effort limit: what a first guess may use
CORRECTIONS = 3
EXACT = 1e-10  # [rad/s or m/s]
PEAK = 1.875  # of a motion x(s) = 10 s^3 - 15 s^4 + 6 s^5: its greatest slope


@dataclass(frozen=True, eq=False)
class Guess:
    """A motion xs (N+1, nx) under us (N, nu) of `model`, what it is called, and what it breaks.

    `effort` is the largest share of an effort limit that it takes, `depth` [m] its deepest overlap.
    """

    name: str
    model: Model
    xs: Array
    us: Array
    effort: float
    depth: float = 0.0
    exact: bool = False  # whether the model's own steps make this motion

    @property
    def num_steps(self) -> int:
        return len(self.us)


def effort_limits(model: Model) -> Array:
    """(nu,) the smaller of the two limits of each input, infinite where there is none."""
    found = np.minimum(np.abs(model.plant.GetEffortLowerLimits()), np.abs(model.plant.GetEffortUpperLimits()))
    return np.asarray(found, dtype=float)


def speed_limits(model: Model) -> Array:
    """(nv,) the velocity limits; FASTEST where there is none, or one of 0."""
    found = np.minimum(np.abs(model.plant.GetVelocityLowerLimits()), np.abs(model.plant.GetVelocityUpperLimits()))
    return np.where((found > 0) & np.isfinite(found), OF_SPEED * found, FASTEST)


def weights_held(model: Model, q: Array) -> float:
    """The share of its effort limits that a fully driven robot needs to hold posture q (nq,)."""
    set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
    us = _inputs(model, np.zeros(model.nv), np.zeros(model.nv))
    return _share(model, us[None])


def _share(model: Model, us: Array) -> float:
    limits = effort_limits(model)
    used = np.abs(us) / np.where(limits > 0, limits, np.inf)
    return float(np.max(np.where(np.isfinite(limits), used, 0.0), initial=0.0))


def _inputs(model: Model, acceleration: Array, v_next: Array) -> Array:
    """(nu,) the inputs that give this acceleration at the state that is set; damping acts on the next velocity."""
    plant, context = model.double.plant, model.double.context
    forces = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    tau = plant.CalcInverseDynamics(context, acceleration, forces)
    tau += _damping(model) * v_next
    return np.asarray(np.linalg.solve(plant.MakeActuationMatrix(), tau))


def _damping(model: Model) -> Array:
    found = np.zeros(model.nv)
    for joint in joints(model.plant):
        if joint.num_velocities():
            start = joint.velocity_start()
            found[start : start + joint.num_velocities()] = joint.default_damping_vector()
    return found


def _corrected(model: Model, x: Array, u: Array, wanted: Array) -> Array:
    """`u` changed so that a step from x leads to the velocity `wanted`: what springs, PD gains, ... leave of it."""
    plant, context = model.double.plant, model.double.context
    to_input = plant.CalcMassMatrix(context) / model.time_step
    drive = plant.MakeActuationMatrix()
    for _ in range(CORRECTIONS):
        try:
            off = wanted - advance(model.double, x, u)[model.nq :]
        except SimulationError:
            return u
        if np.max(np.abs(off), initial=0.0) < EXACT:
            break
        u = u + np.linalg.solve(drive, to_input @ off)
    return u


def along(robot: Robot, name: str, via: list[Array], *, slower: float = 1.0) -> Guess:
    """The smooth motion through postures `via`, [q0, ..., q1], at rest at both ends, and the inputs that make it.

    It is as fast as the joints' speeds and efforts allow, within the limits of this module.
    """
    model, legs = robot.model, np.diff(np.array(via), axis=0)
    slowest = max(float(np.max(np.abs(leg) / speed_limits(model), initial=0.0)) for leg in legs)
    duration = float(np.clip(slower * PEAK * len(legs) * slowest, SHORTEST, LONGEST))
    found = _timed(robot, name, via, duration)
    for _ in range(4):
        if found.effort <= OF_EFFORT or duration >= LONGEST:
            break
        duration = min(1.5 * duration, LONGEST)
        found = _timed(robot, name, via, duration)
    return found


def _timed(robot: Robot, name: str, via: list[Array], duration: float) -> Guess:
    steps = int(np.clip(round(duration / robot.model.time_step), *STEPS))
    step = duration / steps
    model = robot.model
    if abs(step - model.time_step) > 0.25 * model.time_step:
        model = model.at_time_step(float(f"{step:.1g}"))
    h = model.time_step
    # One step before the end it is at the goal, and rests there: Drake's step moves by the velocity after it.
    s = np.clip(np.arange(steps + 1) / (steps - 1), 0.0, 1.0)
    smooth = 10 * s**3 - 15 * s**4 + 6 * s**5
    q = _through(np.array(via), smooth)
    v = np.vstack([np.zeros((1, model.nv)), np.diff(q, axis=0) / h])
    us = np.zeros((steps, model.nu))
    for k in range(steps):
        set_state(model.double, np.concatenate([q[k], v[k]]))
        us[k] = _inputs(model, (v[k + 1] - v[k]) / h, v[k + 1])
        us[k] = _corrected(model, np.concatenate([q[k], v[k]]), us[k], v[k + 1])
    depth = max(overlap(model, posture) for posture in q[:: max(1, steps // 25)])
    return Guess(name, model, np.hstack([q, v]), us, _share(model, us), depth, exact=depth == 0.0)


def _through(via: Array, s: Array) -> Array:
    """(M, nq) the curve through `via` (K, nq) at s in [0, 1]: a line, or the parabolas of Bezier through the middle."""
    if len(via) == 2:
        return np.asarray(via[0] + s[:, None] * (via[1] - via[0]))
    start, middle, end = via
    control = 2 * middle - (start + end) / 2
    t = s[:, None]
    return np.asarray((1 - t) ** 2 * start + 2 * t * (1 - t) * control + t**2 * end)


def by_controller(robot: Robot, target: Array, *, steps: int, reach: float, name: str) -> Guess | None:
    """What the robot does when PD controllers pull its driven joints toward `target` (nq,), `reach` of the way.

    None where the motion leaves what can be simulated or the robot's limits.
    """
    model = robot.model
    plant = model.plant
    x = np.concatenate([robot.q, np.zeros(model.nv)])
    limits = np.minimum(effort_limits(model), 1e4)
    rows = plant.MakeActuationMatrix().T
    set_state(model.double, x)
    mass = np.diag(model.double.plant.CalcMassMatrix(model.double.context))
    stiff = 30.0 * mass
    damp = 9.0 * mass
    place = {j.velocity_start(): j.position_start() for j in joints(plant) if j.num_velocities() == 1}
    xs, us = [x], []
    bias = np.zeros(model.nu)
    for k in range(steps):
        s = min(1.0, 1.25 * (k + 1) / steps)
        wanted = reach * (10 * s**3 - 15 * s**4 + 6 * s**5)
        tau = np.zeros(model.nv)
        for dof, at in place.items():
            aim = robot.q[at] + wanted * (target[at] - robot.q[at])
            tau[dof] = stiff[dof] * (aim - x[at]) - damp[dof] * x[model.nq + dof]
        scale = np.maximum(np.sum(rows**2, axis=1), 1e-12)
        u = np.clip(rows @ tau / scale + bias, -0.8 * limits, 0.8 * limits)
        try:
            x = np.asarray(advance(model.double, x, u)).copy()
        except SimulationError:
            return None
        if not np.all(np.isfinite(x)):
            return None
        xs.append(x)
        us.append(u)
    return Guess(name, model, np.array(xs), np.array(us), _share(model, np.array(us)), exact=True)

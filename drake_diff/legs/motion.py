"""Motions for a schedule of contacts: states and inputs that nearly obey the model's steps.

The feet move smoothly from one stance to the next, with a clearance over the ground. The centre of mass moves as forces
at the feet allow, so that it flies while no foot stands. Inverse kinematics computes the joints, and inverse dynamics
the inputs. The model's steps deviate slightly, mostly where a foot lands. The motion is an initial guess for a search,
which starts with the gaps from state to state.

The path of the centre of mass and the forces are the solution of a quadratic program. Its variables are positions at
the knots and forces at the contact points in each step. Newton's law holds exactly. Forces lie in a friction pyramid,
are even, and change little between steps. Their moment about the centre of mass is small to keep the robot's
orientation. The moment is bilinear, so that a few programs are solved, each about the previous path.
"""

from collections.abc import Collection, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from drake_diff._base.arrays import Array, skew
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError
from drake_diff.legs.feet import Legs
from drake_diff.legs.inverse_kinematics import Wish, inverse_kinematics
from drake_diff.model.model import Model

LANDS = 1e-3  # [m] additional depth of a landing foot; a foot that misses the ground touches it a step later
LEVELLED = 6  # steps in which the soles reach a common depth
# A phase on some feet is slow if it lasts FALLS times a fall, sqrt(height / gravity). The centre of mass then moves by
# the fraction INWARD to the middle of these feet, and a sole moves by the fraction SINKS to its depth in each step.
FALLS, INWARD, SINKS = 2.0, 0.75, 0.3
RUNS_OUT = 0.4  # [s] until an initial spin of the base has decayed
RISE = 2.0  # exponent of a swing's arc, so that a foot lifts off and lands slowly
BY_INPUT, BY_FORCE, BY_BASE = 1e3, 1.0, 1e-3  # scales of changes in inputs, forces and the base's acceleration

# Postures: foot tolerance [m]; deviations that cost 1 for the centre of mass [m], the base's rotation [rad] and joints;
# and the distance of joints from their limits [rad or m].
AT_PLACE, OVER, TURNED, POSED, INSIDE = 1e-5, 1e-3, 0.02, 0.5, 1e-3
ROUNDS = 3
ALIKE, CHANGE, MOMENT, NEAR = 1e-2, 1.0, 100.0, 0.1  # forces in weights of the robot, lengths in its size
EASES = 0.2  # [s] in which a point is unloaded before a slow phase without it
STEP = 0.02  # [s] time step for which the weights are given; they are rates, so that they suit steps of another length
SHARES = 0.5, 0.2, 0.02  # least load of a contact point, as a fraction of an even share; the first feasible one is used
Mask = NDArray[np.bool_]


def scheduled_motion(
    model: Model, legs: Legs, x0: Array, end: Array, stands: Mask, clearance: float, friction: float
) -> tuple[Array, Array]:
    """Return states xs (N+1, nx) and inputs us (N, nu) from x0 (nx,) to approximately posture `end` (nq,) at rest.

    Args:
        model: The model.
        legs: Its feet.
        x0: The first state.
        end: The last posture, to which the base and the joints move.
        stands: (N, feet) whether a foot carries load in a step.
        clearance: [m] the height of a foot in the middle of its swing, over its stance.
        friction: The largest tangential force, as a fraction of the normal force.

    Raises:
        InputError: No forces at the feet move the robot to this posture.
    """
    h, first = model.time_step, x0[: model.nq]
    carries = stands[:, legs.owners]
    legs.put(end)
    last, over = legs.points(), legs.center_of_mass()
    legs.put(first, x0[model.nq :])
    begun, mass_at = legs.points(), legs.center_of_mass()
    on = touching(carries)
    places, arcs = _foot_ways(begun, last, on, clearance)
    places[:, :, 2] = _level(begun[:, 2], len(on))
    s = smooth(np.linspace(0, 1, len(on)))
    way = mass_at + s[:, None] * (over - mass_at)
    gravity = np.asarray(model.double.plant.gravity_field().gravity_vector())
    start = mass_at, legs.center_of_mass_velocity(x0[model.nq :])
    pull = float(np.linalg.norm(gravity))
    slow, weight = _slow_phases(carries, h, way[0, 2], pull), legs.mass * pull
    for a, b in slow:
        middle = np.mean(places[a : b + 1, carries[a], :2], axis=1)
        way[a : b + 1, :2] += INWARD * (middle - way[a : b + 1, :2])
    plan = plan_forces(legs.mass, gravity, h, start, way, places, carries, friction, slow)
    if not isinstance(plan, tuple):
        raise InputError("ContactSchedule", got=str(plan), expected="phases with feasible contact forces")
    mass, forces = plan
    landing = on & ~np.vstack([on[:1], on[:-1]])
    if slow or len(legs.owners) > len(legs.feet):
        places[:, :, 2] -= _sunk(-float(np.mean(places[-1, :, 2])), forces[:, :, 2] / weight, landing)
    else:
        places[landing, 2] -= LANDS
    places[:, :, 2] += arcs + _lifts(mass[:, 2], on)
    ways, qs = s[:, None] * legs.apart(end, first) + _run_out(legs, x0[model.nq :], h, len(on)), [first]
    for k in range(1, len(on)):
        rolls = np.flatnonzero(on[k] & on[k - 1]).tolist()
        qs.append(posture(legs, qs[-1], legs.moved(first, ways[k]), mass[k], places[k], rolls))
    vs = [x0[model.nq :]] + [legs.apart(b, a) / h for a, b in pairwise(qs)]
    xs = np.array([np.concatenate(pair) for pair in zip(qs, vs, strict=True)])
    us = np.array([_inputs(legs, xs[k], vs[k + 1], forces[k], carries[k]) for k in range(len(stands))])
    return xs, us


def posture(legs: Legs, first: Array, near: Array, mass: Array, places: Array, rolls: Collection[int] = ()) -> Array:
    """Return the posture (nq,) for positions of soles and centre of mass, from posture `first` and near posture `near`.

    `places` (n, 3) are the positions of the lowest points, `mass` (3,) of the centre of mass; `rolls` as in `Legs.at`.
    """
    unit, base, margin = np.full(legs.model.nv, POSED), legs.base_v, np.zeros(legs.model.nq)
    unit[base : base + 3], unit[base + 3 : base + 6] = TURNED, np.inf
    margin[legs.joint_q] = np.minimum(INSIDE, (legs.upper - legs.lower)[legs.joint_q] / 2)
    legs.put(first)
    targets = legs.at(places, AT_PLACE, rolls)
    wish = Wish(near, unit, mass, OVER)
    return inverse_kinematics(legs.model, first, targets, wish, legs.lower + margin, legs.upper - margin)


def touching(stands: Mask) -> Mask:
    """Return (N+1, n) the contacts at knots, from those of the steps before and after, `stands` (N, n)."""
    return np.vstack([stands, stands[-1:]]) | np.vstack([stands[:1], stands])


def smooth(s: Array) -> Array:
    """Return the smooth transition from 0 to 1 that is at rest at both ends."""
    return np.asarray(10 * s**3 - 15 * s**4 + 6 * s**5)


def swings(on: Mask) -> list[tuple[int, int]]:
    """Return the first and last knot of each swing, from contacts `on` (N+1,). The motion's ends can be such knots."""
    off = np.concatenate([[False], ~on, [False]])
    edges = np.flatnonzero(off[1:] != off[:-1]).reshape(-1, 2)
    return [(max(int(a) - 1, 0), min(int(b), len(on) - 1)) for a, b in edges]


def _foot_ways(first: Array, last: Array, on: Mask, clearance: float) -> tuple[Array, Array]:
    """Return (N+1, n, 3) [m] the points, in equal swings from `first` to `last`, and (N+1, n) [m] their arcs."""
    places = np.repeat(first[None], len(on), axis=0)
    arcs = np.zeros(on.shape)
    for i in range(on.shape[1]):
        ways = swings(on[:, i])
        for number, (a, b) in enumerate(ways):
            s = np.linspace(0, 1, b - a + 1)
            fractions = (number + smooth(s)) / len(ways)
            places[a : b + 1, i] = first[i] + fractions[:, None] * (last[i] - first[i])
            places[b + 1 :, i] = places[b, i]
            open_end = b == len(on) - 1 and not on[b, i]
            arcs[a : b + 1, i] = clearance * (smooth(s) if open_end else (4 * s * (1 - s)) ** RISE)
    return places, arcs


def _run_out(legs: Legs, v: Array, h: float, count: int) -> Array:
    """Return (N+1, nv) the displacement by the base's initial spin in v (nv,), which returns to zero after a while."""
    spin = np.zeros(legs.model.nv)
    turn, times = slice(legs.base_v, legs.base_v + 3), h * np.arange(float(count))
    spin[turn] = v[turn]
    return np.asarray((times * np.maximum(1 - times / min(RUNS_OUT, times[-1]), 0.0) ** 3)[:, None] * spin)


def _level(heights: Array, count: int) -> Array:
    """Return (N+1, n) [m] the heights of soles, from `heights` (n,) at first to their average depth soon after.

    Some feet of a robot on four feet hardly touch the ground, and would soon lose contact otherwise.
    """
    sink = -float(np.mean(np.maximum(-heights, 0.0)))
    s = smooth(np.clip(np.arange(count) / LEVELLED, 0.0, 1.0))[:, None]
    return np.asarray(heights + s * (sink - heights))


def _slow_phases(carries: Mask, h: float, height: float, pull: float) -> list[tuple[int, int]]:
    """Return (first, last) of long phases inside the motion in which the robot stands on the same few points."""
    changes = np.flatnonzero(np.any(carries[1:] != carries[:-1], axis=1)) + 1
    long = FALLS * np.sqrt(max(height, 0.0) / pull) if pull else np.inf
    phases = [(int(a), int(b)) for a, b in pairwise(changes)]
    return [(a, b) for a, b in phases if (b - a) * h >= long and carries[a].any() and not carries[a].all()]


def _sunk(depth: float, shares: Array, landing: Mask) -> Array:
    """Return (N+1, n) [m] the additional depth of soles, relative to `depth` of an even share, for shares (N, n).

    A sole without load rises to the ground. A sole that lands is slightly deeper.
    """
    wanted = depth * (shares.shape[1] * shares - 1)
    sunk = np.zeros(landing.shape)
    for k, goal in enumerate(wanted):
        sunk[k + 1] = sunk[k] + SINKS * (goal - sunk[k]) + LANDS * landing[k + 1]
    return sunk


def _lifts(heights: Array, on: Mask) -> Array:
    """Return (N+1, 1) [m] the rise of the feet with the body in flight. They lift off and land more slowly than it."""
    lift = np.zeros((len(on), 1))
    for a, b in swings(np.any(on, axis=1)):
        straight = np.interp(np.arange(a, b + 1), [a, b], heights[[a, b]])
        over = np.maximum(heights[a : b + 1] - straight, 0.0)
        peak = max(float(np.max(over)), 1e-9)
        lift[a : b + 1, 0] = peak * (over / peak) ** RISE
    return lift


def _inputs(legs: Legs, x: Array, v_next: Array, forces: Array, carries: Array) -> Array:
    """Return (nu,) the inputs from state x (nx,) to velocity v_next (nv,), with about the forces (n, 3) of points."""
    model, twin, base = legs.model, legs.twin, legs.base_v
    legs.put(x[: model.nq], x[model.nq :])
    change = v_next - x[model.nq :]
    needed = twin.inverse_dynamics(change / model.time_step) + twin.damping() * change
    by_force = legs.jacobian()[carries].reshape(-1, model.nv).T
    needed = needed - by_force @ forces[carries].ravel()
    gives = -np.asarray(twin.mass_matrix())[:, base : base + 6]
    loads = forces[carries][:, 2] / max(float(np.mean(forces[carries][:, 2])), 1e-9) if carries.any() else np.zeros(0)
    columns = np.hstack([BY_INPUT * model.actuation, BY_FORCE * by_force * np.repeat(loads, 3), BY_BASE * gives])
    solution = np.linalg.lstsq(columns, needed, rcond=1e-9)[0]
    return model.commands(x, v_next, BY_INPUT * solution[: model.nu])


def plan_forces(
    mass: float,
    gravity: Array,
    time_step: float,
    start: tuple[Array, Array],
    way: Array,
    places: Array,
    stands: Mask,
    friction: float,
    slow: Sequence[tuple[int, int]] = (),
) -> tuple[Array, Array] | Refusal:
    """Return positions (N+1, 3) [m] of the centre of mass and forces (N, n, 3) [N], or a Refusal.

    Args:
        mass: [kg]
        gravity: (3,) [m/s^2]
        time_step: [s]
        start: The initial position and velocity (3,) of the centre of mass.
        way: (N+1, 3) [m] the reference path of the centre of mass, at whose end it is at rest.
        places: (N+1, n, 3) [m] the positions of the points.
        stands: (N, n) whether a point carries load in a step.
        friction: The largest tangential force, as a fraction of the normal force.
        slow: First steps of slow phases and of the phases after them. Points are gradually unloaded and loaded there.
    """
    size = max(float(np.max(np.ptp(places[0], axis=0))) / 2, 1e-3)
    eased, unloaded = _eased(stands, slow, round(EASES / time_step))
    for least in SHARES:
        plan: tuple[Array, Array] | Refusal = (np.array(way), np.zeros(0))
        for _ in range(ROUNDS):
            if not isinstance(plan, Refusal):
                program = _Program(mass, gravity, time_step, size, stands)
                program.follow(start, way)
                program.share(friction, least * eased, unloaded)
                program.keep_turn(places, plan[0])
                plan = program.solve()
        if not isinstance(plan, Refusal):
            break
    return plan


class _Program:
    def __init__(self, mass: float, gravity: Array, time_step: float, size: float, stands: Mask):
        self.gravity, self.h, self.size, self.stands = gravity, time_step, size, stands
        self.pull = float(np.linalg.norm(gravity)) or 1.0
        self.weight = mass * self.pull
        self.part = time_step / STEP
        self.program = MathematicalProgram()
        self.at = self.program.NewContinuousVariables(len(stands) + 1, 3)
        self.carries = np.argwhere(stands)  # (m, 2): step and point
        self.forces = self.program.NewContinuousVariables(max(len(self.carries), 1), 3)  # in units of the weight
        self.of_step = [np.flatnonzero(self.carries[:, 0] == k) for k in range(len(stands))]

    def follow(self, start: tuple[Array, Array], way: Array) -> None:
        """Add Newton's law by the model's step, the first state, rest at the end, and a cost of leaving `way`."""
        program, positions, h = self.program, self.at, self.h
        first, speed = start
        program.AddBoundingBoxConstraint(first, first, positions[0])
        program.AddBoundingBoxConstraint(way[-1], way[-1], positions[-1])
        last = np.concatenate([positions[-1], positions[-2]])
        program.AddLinearEqualityConstraint(np.hstack([np.eye(3), -np.eye(3)]), np.zeros(3), last)
        push = -(h**2) * self.pull * np.eye(3)
        for k, carrying in enumerate(self.of_step):
            blocks, known = [np.eye(3)], h**2 * self.gravity
            variables = [positions[k + 1]]
            if k == 0:
                known = known + first + h * speed
            else:
                blocks += [-2 * np.eye(3), np.eye(3)]
                variables += [positions[k], positions[k - 1]]
            blocks += [push] * len(carrying)
            variables += [self.forces[j] for j in carrying]
            program.AddLinearEqualityConstraint(np.hstack(blocks), known, np.concatenate(variables))
        near = np.sqrt(NEAR * self.part) / self.size * np.eye(positions.size)
        program.Add2NormSquaredCost(near, near @ way.ravel(), positions.ravel())

    def share(self, friction: float, least: Array, unloaded: Mask) -> None:
        """Add the friction pyramid, least normal forces, and costs of uneven, changing and unloaded forces."""
        program, steps = self.program, {(int(k), int(i)): j for j, (k, i) in enumerate(self.carries)}
        sides = np.array([[1, 0, -friction], [-1, 0, -friction], [0, 1, -friction], [0, -1, -friction]])
        up, alike = -self.gravity / self.pull, np.sqrt(ALIKE * self.part) * np.eye(3)
        change = np.sqrt(CHANGE / self.part) * np.eye(3)
        for (k, i), j in steps.items():
            force, share = self.forces[j], 1 / len(self.of_step[k])
            program.AddLinearConstraint(sides, np.full(4, -np.inf), np.zeros(4), force)
            program.AddBoundingBoxConstraint(least[k, i] * share, np.inf, force[2])
            program.Add2NormSquaredCost(alike, alike @ (share * up), force)
            before = steps.get((k - 1, i))
            if before is not None:
                pair = np.concatenate([force, self.forces[before]])
                program.Add2NormSquaredCost(np.hstack([change, -change]), np.zeros(3), pair)
            if unloaded[k, i]:
                program.Add2NormSquaredCost(change, np.zeros(3), force)

    def keep_turn(self, places: Array, way: Array) -> None:
        """Add a cost of the moment about the path `way` (N+1, 3) of the centre of mass."""
        for k, carrying in enumerate(self.of_step):
            if len(carrying):
                arms = (places[k, self.carries[carrying, 1]] - way[k]) / self.size
                moment = np.sqrt(MOMENT * self.part) * np.hstack([skew(arm) for arm in arms])
                self.program.Add2NormSquaredCost(moment, np.zeros(3), self.forces[carrying].ravel())

    def solve(self) -> tuple[Array, Array] | Refusal:
        if not len(self.carries):
            self.program.AddBoundingBoxConstraint(0.0, 0.0, self.forces)
        result = ClarabelSolver().Solve(self.program)
        if not result.is_success():
            return Refusal("no contact forces within the friction cones move the centre of mass to its required end")
        forces = np.zeros((*self.stands.shape, 3))
        forces[self.stands] = self.weight * np.asarray(result.GetSolution(self.forces))[: len(self.carries)]
        return np.asarray(result.GetSolution(self.at)), forces


def _eased(stands: Mask, slow: Sequence[tuple[int, int]], steps: int) -> tuple[Array, Mask]:
    """Return (N, n) factors on the least share, and a mask of last steps before and first steps after slow phases."""
    shares, last = np.ones(stands.shape), np.zeros(stands.shape, dtype=bool)
    for a, b in slow:
        leaves, lands = stands[a - 1] & ~stands[a], stands[b] & ~stands[b - 1]
        last[a - 1, leaves] = last[b, lands] = True
        for i in range(steps):
            if a - 1 - i >= 0:
                shares[a - 1 - i, leaves] = np.minimum(shares[a - 1 - i, leaves], i / steps)
            if b + i < len(stands):
                shares[b + i, lands] = np.minimum(shares[b + i, lands], i / steps)
    return shares, last

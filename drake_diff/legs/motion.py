"""A motion in which the feet stand as scheduled: states and inputs that nearly obey the model's steps.

The feet go smoothly from where they stand to where they stand next, over the ground by a clearance. The centre of mass
goes where forces at the feet can bring it, so that it flies where no foot stands. Inverse kinematics puts the joints
there, inverse dynamics makes the inputs. What the steps make of it is a little off, above all where a foot lands: it is
a guess for a search, which starts with what is missing from state to state.

The way of the centre of mass and the forces are a quadratic program in its positions at the knots and the forces at the
standing points in each step. Newton's law holds exactly; forces are in a pyramid of friction, alike, and change little
from step to step; their moment about the centre of mass is small, so that the robot keeps its turn. That moment is
bilinear, so it is taken about the way of the program before, and there are a few of them.
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

LANDS = 1e-3  # [m] how much deeper than it stands a foot lands: one that misses the ground meets it a step later
LEVELLED = 6  # steps in which the soles become alike in depth
# A phase on some feet is slow where it lasts so many times as long as a fall, the square root of height over gravity;
# how far the centre of mass goes then from its way to the middle of these feet, and a sole in a step to its depth.
FALLS, INWARD, SINKS = 2.0, 0.75, 0.3
RUNS_OUT = 0.4  # [s] in which a first spin of the base does
RISE = 2.0  # the power of a swing's arc: a foot that leaves and lands slowly
BY_INPUT, BY_FORCE, BY_BASE = 1e3, 1.0, 1e-3  # how willingly inputs, forces and the base's acceleration give way

# A posture: [m] how far a foot may be off; what counts as 1 of the centre of mass [m], of the base's turn [rad], of
# joints; and [rad or m] how far inside its limits a joint stays.
AT_PLACE, OVER, TURNED, POSED, INSIDE = 1e-5, 1e-3, 0.02, 0.5, 1e-3
ROUNDS = 3
ALIKE, CHANGE, MOMENT, NEAR = 1e-2, 1.0, 100.0, 0.1  # of forces in weights of the robot, lengths in its size
EASES = 0.2  # [s] in which a point is unloaded before a slow phase without it
STEP = 0.02  # [s] of which these weights are; they are rates, so that they say the same in steps of another length
SHARES = 0.5, 0.2, 0.02  # of an even share of the weight: what a standing point carries at least; the first that can be
Mask = NDArray[np.bool_]


def scheduled_motion(
    model: Model, legs: Legs, x0: Array, end: Array, stands: Mask, clearance: float, friction: float
) -> tuple[Array, Array]:
    """States xs (N+1, nx) and inputs us (N, nu) from x0 (nx,) to about posture `end` (nq,), at rest.

    Args:
        model: The model.
        legs: Its feet.
        x0: The first state.
        end: The last posture; its base and joints are what those on the way go to.
        stands: (N, feet) whether a foot carries in a step.
        clearance: [m] how high a foot is in the middle of its way, over where it stood.
        friction: The largest sideways force, as a part of the upright one.

    Raises:
        InputError: No forces at the feet bring the robot there.
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
    """(nq,) from posture `first` (nq,) to where the soles and the centre of mass are to be, near another one (nq,).

    `places` (n, 3) are those of the lowest points, `mass` (3,) that of the centre of mass; `rolls` as in `Legs.at`.
    """
    unit, base, margin = np.full(legs.model.nv, POSED), legs.base_v, np.zeros(legs.model.nq)
    unit[base : base + 3], unit[base + 3 : base + 6] = TURNED, np.inf
    margin[legs.joint_q] = np.minimum(INSIDE, (legs.upper - legs.lower)[legs.joint_q] / 2)
    legs.put(first)
    targets = legs.at(places, AT_PLACE, rolls)
    wish = Wish(near, unit, mass, OVER)
    return inverse_kinematics(legs.model, first, targets, wish, legs.lower + margin, legs.upper - margin)


def touching(stands: Mask) -> Mask:
    """(N+1, n) at which knots what `stands` (N, n) in the steps is on the ground: before and after each of them."""
    return np.vstack([stands, stands[-1:]]) | np.vstack([stands[:1], stands])


def smooth(s: Array) -> Array:
    """From 0 to 1, at rest at both ends."""
    return np.asarray(10 * s**3 - 15 * s**4 + 6 * s**5)


def swings(on: Mask) -> list[tuple[int, int]]:
    """The knots, on the ground or the ends of the motion, between which what is `on` (N+1,) the ground is off it."""
    off = np.concatenate([[False], ~on, [False]])
    edges = np.flatnonzero(off[1:] != off[:-1]).reshape(-1, 2)
    return [(max(int(a) - 1, 0), min(int(b), len(on) - 1)) for a, b in edges]


def _foot_ways(first: Array, last: Array, on: Mask, clearance: float) -> tuple[Array, Array]:
    """(N+1, n, 3) [m] where the points are, each way an even part of that from first to last, and (N+1, n) its arc."""
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
    """(N+1, nv) how a first spin of the base, of v (nv,), goes on for a while and comes back."""
    spin = np.zeros(legs.model.nv)
    turn, times = slice(legs.base_v, legs.base_v + 3), h * np.arange(float(count))
    spin[turn] = v[turn]
    return np.asarray((times * np.maximum(1 - times / min(RUNS_OUT, times[-1]), 0.0) ** 3)[:, None] * spin)


def _level(heights: Array, count: int) -> Array:
    """(N+1, n) [m] of soles that first are at `heights` (n,), and soon all as deep as they are on average.

    Some of a robot that stands on four feet hardly touch, and would soon not touch at all.
    """
    sink = -float(np.mean(np.maximum(-heights, 0.0)))
    s = smooth(np.clip(np.arange(count) / LEVELLED, 0.0, 1.0))[:, None]
    return np.asarray(heights + s * (sink - heights))


def _slow_phases(carries: Mask, h: float, height: float, pull: float) -> list[tuple[int, int]]:
    """The knots from a to b, inside the motion, between which it stands on the same few points for long."""
    changes = np.flatnonzero(np.any(carries[1:] != carries[:-1], axis=1)) + 1
    long = FALLS * np.sqrt(max(height, 0.0) / pull) if pull else np.inf
    phases = [(int(a), int(b)) for a, b in pairwise(changes)]
    return [(a, b) for a, b in phases if (b - a) * h >= long and carries[a].any() and not carries[a].all()]


def _sunk(depth: float, shares: Array, landing: Mask) -> Array:
    """(N+1, n) [m] how much deeper than `depth`, that of an even share, soles are for shares (N, n) of the weight.

    One that carries nothing comes up to the ground; where it lands it is a little deeper.
    """
    wanted = depth * (shares.shape[1] * shares - 1)
    sunk = np.zeros(landing.shape)
    for k, goal in enumerate(wanted):
        sunk[k + 1] = sunk[k] + SINKS * (goal - sunk[k]) + LANDS * landing[k + 1]
    return sunk


def _lifts(heights: Array, on: Mask) -> Array:
    """(N+1, 1) [m] by how much feet rise with the body while none stands; they leave and land more slowly than it."""
    lift = np.zeros((len(on), 1))
    for a, b in swings(np.any(on, axis=1)):
        straight = np.interp(np.arange(a, b + 1), [a, b], heights[[a, b]])
        over = np.maximum(heights[a : b + 1] - straight, 0.0)
        peak = max(float(np.max(over)), 1e-9)
        lift[a : b + 1, 0] = peak * (over / peak) ** RISE
    return lift


def _inputs(legs: Legs, x: Array, v_next: Array, forces: Array, carries: Array) -> Array:
    """(nu,) what makes the velocity v_next (nv,) of the state x (nx,), with about the forces (n, 3) of the points."""
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
    """Positions (N+1, 3) [m] of the centre of mass, and forces (N, n, 3) [N]; or why there are none.

    Args:
        mass: [kg]
        gravity: (3,) [m/s^2]
        time_step: [s]
        start: Place and velocity (3,) of the centre of mass at first.
        way: (N+1, 3) [m] what it is to be near; it ends there, at rest.
        places: (N+1, n, 3) [m] of the points.
        stands: (N, n) whether a point carries in a step.
        friction: The largest sideways force, as a part of the upright one.
        slow: First steps of phases, and of those after them, into and out of which points are unloaded bit by bit.
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
        self.forces = self.program.NewContinuousVariables(max(len(self.carries), 1), 3)  # in weights
        self.of_step = [np.flatnonzero(self.carries[:, 0] == k) for k in range(len(stands))]

    def follow(self, start: tuple[Array, Array], way: Array) -> None:
        """Newton's law by the step's own rule, the given first state, and rest at the end of the way."""
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
        """Forces within friction, upwards, alike among the points and from step to step; small where unloaded."""
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
        """No moment about the way (N+1, 3) of the centre of mass, as nearly as may be."""
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
            return Refusal("no forces of its feet within friction move its centre of mass to the required end")
        forces = np.zeros((*self.stands.shape, 3))
        forces[self.stands] = self.weight * np.asarray(result.GetSolution(self.forces))[: len(self.carries)]
        return np.asarray(result.GetSolution(self.at)), forces


def _eased(stands: Mask, slow: Sequence[tuple[int, int]], steps: int) -> tuple[Array, Mask]:
    """(N, n) parts of the least share; and whether a step is a point's last before a slow phase, or its first after."""
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

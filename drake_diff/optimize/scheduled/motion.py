"""A motion in which the feet stand as scheduled: states and inputs that nearly obey the model's steps.

The feet go smoothly from where they stand to where they stand next, over the ground by a clearance. The centre of mass
goes where forces at the feet can bring it (`centroidal`), so that it flies where no foot stands. Inverse kinematics
puts the joints there, inverse dynamics makes the inputs. What the steps make of it is a little off, above all where a
foot lands: it is a guess for a search, which starts with what is missing from state to state.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.exceptions import InputError
from drake_diff.model.model import Model
from drake_diff.optimize.scheduled.centroidal import plan_forces
from drake_diff.optimize.scheduled.legs import Legs

LANDS = 1e-3  # [m] how much deeper than it stands a foot lands: one that misses the ground meets it a step later
LEVELLED = 6  # steps in which the soles become alike in depth
# A phase on some feet is slow where it lasts so many times as long as a fall, the square root of height over gravity;
# how far the centre of mass goes then from its way to the middle of these feet, and a sole in a step to its depth.
FALLS, INWARD, SINKS = 2.0, 0.75, 0.3
RUNS_OUT = 0.4  # [s] in which a first spin of the base does
RISE = 2.0  # the power of a swing's arc: a foot that leaves and lands slowly
BY_INPUT, BY_FORCE, BY_BASE = 1e3, 1.0, 1e-3  # how willingly inputs, forces and the base's acceleration give way

Mask = NDArray[np.bool_]


def scheduled_motion(
    model: Model,
    legs: Legs,
    x0: Array,
    end: Array,
    stands: Mask,
    clearance: float,
    friction: float,
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
    last, over = legs.points(), legs.center_of_mass()[0]
    legs.put(first, x0[model.nq :])
    begun, (mass_at, mass_by) = legs.points(), legs.center_of_mass()
    on = touching(carries)
    places, arcs = _foot_ways(begun, last, on, clearance)
    places[:, :, 2] = _level(begun[:, 2], len(on))
    s = smooth(np.linspace(0, 1, len(on)))
    way = mass_at + s[:, None] * (over - mass_at)
    gravity = np.asarray(model.double.plant.gravity_field().gravity_vector())
    start = mass_at, mass_by @ x0[model.nq :]
    pull = float(np.linalg.norm(gravity))
    slow, weight = _slow_phases(carries, h, way[0, 2], pull), legs.mass * pull
    for a, b in slow:
        middle = np.mean(places[a : b + 1, carries[a], :2], axis=1)
        way[a : b + 1, :2] += INWARD * (middle - way[a : b + 1, :2])
    plan = plan_forces(legs.mass, gravity, h, start, way, places, carries, friction, slow)
    if not isinstance(plan, tuple):
        raise InputError("ContactSchedule", got=str(plan), expected="phases in which there are such forces")
    mass, forces = plan
    landing = on & ~np.vstack([on[:1], on[:-1]])
    if slow or len(legs.owners) > len(legs.feet):
        places[:, :, 2] -= _sunk(-float(np.mean(places[-1, :, 2])), forces[:, :, 2] / weight, landing)
    else:
        places[landing, 2] -= LANDS
    places[:, :, 2] += arcs + _lifts(mass[:, 2], on)
    ways, qs = s[:, None] * legs.apart(end, first) + _run_out(legs, x0[model.nq :], h, len(on)), [first]
    for k in range(1, len(on)):
        wish = legs.moved(first, ways[k])
        qs.append(legs.posture(qs[-1], wish, mass[k], places[k], on[k] & on[k - 1]))
    vs = [x0[model.nq :]] + [legs.apart(b, a) / h for a, b in pairwise(qs)]
    xs = np.array([np.concatenate(pair) for pair in zip(qs, vs, strict=True)])
    us = np.array([_inputs(legs, xs[k], vs[k + 1], forces[k], carries[k]) for k in range(len(stands))])
    return xs, us


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
    by_force = legs.jacobians()[0][carries].reshape(-1, model.nv).T
    needed = needed - by_force @ forces[carries].ravel()
    gives = -np.asarray(twin.mass_matrix())[:, base : base + 6]
    loads = forces[carries][:, 2] / max(float(np.mean(forces[carries][:, 2])), 1e-9) if carries.any() else np.zeros(0)
    columns = np.hstack([BY_INPUT * model.actuation, BY_FORCE * by_force * np.repeat(loads, 3), BY_BASE * gives])
    solution = np.linalg.lstsq(columns, needed, rcond=1e-9)[0]
    return np.asarray(BY_INPUT * solution[: model.nu])

"""Steps of a tree in continuous time with Coulomb friction that holds joints still, and their derivatives.

A joint slides one way or the other against a constant force, or friction holds it: its acceleration is 0 for as long as
the force that this takes is within the friction. Each of these phases is smooth. Within a step the time is sought at
which one ends, where a velocity is 0 or a force leaves the friction, and the next one starts there. Derivatives go
through such an end as Aizerman and Gantmacher (1958) say: a joint that stops passes on no velocity, and where it goes
on the other way, its velocity is stretched by how its acceleration jumps.
"""

from typing import NamedTuple

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.identification.tree import Dynamics, Grip

MOST_PHASES = 60  # of a step: one with more is given up, and its state is NaN
SEARCHED, MET = 99, 1e-9  # steps of the search for an end; [rad/s, m/s] or of the friction: how near it is then
SHORT = 1e-13  # [s] between which an end is known well enough, however steep it is there


class Phase(NamedTuple):
    """Of some steps, a time in which each joint slides one way or is held."""

    rows: Indices  # of the steps
    x: Array  # (n, nx) at its start
    h: Array  # (n,) [s]
    u: Array
    grip: Grip
    stopped: Indices  # (n,) the joint that slid and has just come to 0; -1 where none has
    before: Grip  # of the phase before


def step_with_friction(dynamics: Dynamics, x: Array, h: Array, u: Array) -> tuple[Array, list[Phase]]:
    """Where steps from x (N, nx) of lengths h (N,) end, and their phases."""
    nv = dynamics.nv
    nq, nothing = x.shape[1] - nv, np.zeros((len(x), nv))
    x, left, phases, released = x.copy(), h.copy(), list[Phase](), nothing.copy()
    stopped, before = np.full(len(x), -1), Grip(nothing.copy(), nothing.copy())
    for _ in range(MOST_PHASES):
        rows = np.flatnonzero(left > 0)
        if not len(rows):
            break
        here, inputs = x[rows], u[rows]
        grip = dynamics.grip(here, inputs, released[rows])
        begin = _begin(dynamics, here, grip)
        lengths, ends = left[rows], dynamics.step(begin, left[rows], inputs, grip)
        room = _room(dynamics, ends, inputs, grip)
        last = np.flatnonzero(np.any(room < 0, axis=1))
        which = np.zeros(len(rows), dtype=np.intp)
        if len(last):
            some = grip.some(last)
            lengths[last], ends[last], which[last] = _end(
                dynamics, begin[last], inputs[last], some, lengths[last], room[last]
            )
            _, holding = dynamics.accelerate_and_hold(ends[last], inputs[last], some)
        phases.append(Phase(rows, here, lengths, inputs, grip, stopped[rows], before.some(rows)))
        released[rows], stopped[rows] = 0.0, -1
        before.turn[rows], before.held[rows] = grip.turn, grip.held
        left[rows] -= lengths
        for k, i in enumerate(last):
            j = which[i]
            if grip.held[i, j]:
                released[rows[i], j] = np.sign(holding[k, j])
            else:
                ends[i, nq + j], stopped[rows[i]] = 0.0, j
        left[np.delete(rows, last)] = 0.0
        x[rows] = ends
    x[left > 0] = np.nan
    return x, phases


def friction_jacobians(dynamics: Dynamics, x: Array, h: Array, u: Array, by: Array) -> Array:
    """(N, nx, nx + P) of these steps; `by` (count, P) is how the numbers change with parameters."""
    nx = x.shape[1]
    total = np.zeros((len(x), nx, nx + by.shape[1]))
    total[:, :, :nx] = np.eye(nx)
    for phase in step_with_friction(dynamics, x, h, u)[1]:
        begin = _begin(dynamics, phase.x, phase.grip)
        through = dynamics.step_jacobians(begin, phase.h, phase.u, by, phase.grip)
        moved = through[:, :, :nx] @ _jump(dynamics, phase) @ total[phase.rows]
        moved[:, :, nx:] += through[:, :, nx:]
        total[phase.rows] = moved
    return total


def _begin(dynamics: Dynamics, x: Array, grip: Grip) -> Array:
    """x with joints at rest that are held."""
    begin = x.copy()
    begin[:, -dynamics.nv :][grip.held > 0] = 0.0
    return begin


def _room(dynamics: Dynamics, x: Array, u: Array, grip: Grip) -> Array:
    """(N, nv) by how much each joint slides or is held as it should at x, negative beyond; infinite of others."""
    room = np.where(grip.turn != 0, grip.turn * x[:, -dynamics.nv :], np.inf)
    some = np.flatnonzero(np.any(grip.held > 0, axis=1))
    if len(some):
        _, holding = dynamics.accelerate_and_hold(x[some], u[some], grip.some(some))
        share = 1 - np.abs(holding) / np.maximum(dynamics.friction, 1e-300)
        room[some] = np.where(grip.held[some] > 0, share, room[some])
    return room


def _end(dynamics: Dynamics, x: Array, u: Array, grip: Grip, h: Array, room: Array) -> tuple[Array, Array, Indices]:
    """(when a phase ends that has this room (N, nv) at h (N,), where, by which joint): regula falsi of Illinois.

    Looked at are the joints that are beyond at h; every third step halves what is left.
    """
    sought, rows = room < 0, np.arange(len(x))

    def least(y: Array, i: Indices) -> tuple[Array, Indices]:
        margins = np.where(sought[i], _room(dynamics, y, u[i], grip.some(i)), np.inf)
        which = np.argmin(margins, axis=1)
        return margins[np.arange(len(i)), which], which

    low, high, t = np.zeros(len(x)), h.copy(), h.copy()
    at_low, at_high = np.maximum(least(x, rows)[0], 0.0), np.min(room, axis=1)
    ends, which, side = x.copy(), np.argmin(room, axis=1), np.zeros(len(x))
    i = rows
    for k in range(SEARCHED):
        secant = at_low[i] / np.maximum(at_low[i] - at_high[i], 1e-300)
        t[i] = low[i] + (high[i] - low[i]) * np.where((at_low[i] > 0) & (k % 3 < 2), secant, 0.5)
        ends[i] = dynamics.step(x[i], t[i], u[i], grip.some(i))
        margin, which[i] = least(ends[i], i)
        above = margin > 0
        at_high[i] = np.where(above, np.where(side[i] > 0, at_high[i] / 2, at_high[i]), margin)
        at_low[i] = np.where(above, margin, np.where(side[i] < 0, at_low[i] / 2, at_low[i]))
        low[i], high[i] = np.where(above, t[i], low[i]), np.where(above, high[i], t[i])
        side[i] = np.where(above, 1.0, -1.0)
        i = i[(np.abs(margin) >= MET) & (high[i] - low[i] > SHORT)]
        if not len(i):
            break
    return t, ends, which


def _jump(dynamics: Dynamics, phase: Phase) -> Array:
    """(n, nx, nx) what becomes of a small change of the state where a phase begins.

    Of a joint that has come to 0 it has changed when: what is accelerated otherwise from then on is moved by that.
    """
    nx, nv, x, u, grip = phase.x.shape[1], dynamics.nv, phase.x, phase.u, phase.grip
    jump = np.tile(np.eye(nx), (len(x), 1, 1))
    caught = np.flatnonzero(np.any(grip.held > 0, axis=1) & (phase.stopped < 0))
    if len(caught):  # the momentum of what goes on is what it was
        mass, free = dynamics.mass(x[caught]), 1 - grip.held[caught]
        held = mass * free[:, :, None] * free[:, None] + np.eye(nv) * grip.held[caught][:, None]
        jump[caught, nx - nv :, nx - nv :] = np.linalg.solve(held, mass * free[:, :, None])
    some = np.flatnonzero(phase.stopped >= 0)
    if len(some):
        j, rows = phase.stopped[some], np.arange(len(some))
        old, _ = dynamics.accelerate_and_hold(x[some], u[some], phase.before.some(some))
        new, _ = dynamics.accelerate_and_hold(x[some], u[some], grip.some(some))
        slowed = np.where(old[rows, j] != 0, old[rows, j], np.inf)
        jump[some, nx - nv :, nx - nv + j] += (new - old) / slowed[:, None]
    return jump

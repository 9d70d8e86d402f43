"""The motion of a tree in continuous time with Coulomb friction that holds joints still: compiled.

A joint slides one way or the other against a constant force, or friction holds it: its acceleration is 0 for as long as
the force that this takes is within the friction. Each of these motions is smooth. Within a step the time is sought at
which one ends, where a velocity is 0 or a force leaves the friction, and the next one starts there. Derivatives go
through such an end as Aizerman and Gantmacher (1958) say: a joint that stops passes on no velocity, and where it goes
on the other way, its velocity is stretched by how its acceleration jumps.

Friction can also give way: what it holds moves as with an inertia g and a damping d more, for as long as the force
|g a + d v| that this takes is within the friction. Simulators hold joints so: by MuJoCo's `frictionloss` 1/g is its R,
and d/g the rate by which its reference slows a joint down. This force has no jumps.
"""

import numpy as np

from drake_diff._base.compiled import compiled, inner
from drake_diff.identification.kernel import (
    Array,
    Changes,
    Grip,
    System,
    Workspace,
    _accelerate,
    _differentiate,
    _mass_and_force,
    _step,
    _substitute,
    workspace,
)
from drake_diff.mechanics.tree_kernel import _factor

REST = 1e-9  # [rad/s, m/s] below which a joint is at rest
MOST_PHASES = 60  # of a step: one with more has no end that can be told, and its state is NaN
SEARCHED, MET = 99, 1e-9  # steps of the search for an end; [rad/s, m/s] or of the friction: how near it is then
SHORT = 1e-13  # [s] between which an end is known well enough, however steep it is there


@inner
def _holding_forces(s: System, w: Workspace, x: Array, effort: Array, g: Grip, a: Array, out: Array) -> None:
    """a (nv,), and out (nv,) the force that holds each joint that is held."""
    nv = len(a)
    _accelerate(s, w, x, effort, g, a)
    if s.gives:
        for i in range(nv):
            out[i] = (s.held_inertia[i] * a[i] + s.held_damping[i] * x[len(x) - nv + i]) if g.held[i] != 0 else 0.0
        return
    _mass_and_force(s, w, x, effort, g)
    for i in range(nv):
        out[i] = 0.0
        if g.held[i] != 0:
            out[i] = w.right[i, 0]
            for j in range(nv):
                out[i] -= w.M[i, j] * a[j]


@inner
def _friction(s: System, i: int) -> float:
    """The most that friction pushes along a coordinate: of its joint and of those that follow it."""
    total = 0.0
    for j in range(len(s.spread)):
        total += abs(s.spread[j, i]) * s.coulomb[j]
    return total


@inner
def _grip(s: System, w: Workspace, x: Array, effort: Array, released: Array, stays: Array, g: Grip) -> None:
    """Fill turn and held of a motion that begins at x; a joint at rest is held where friction can."""
    nv = s.spread.shape[1]
    a, force = np.empty(nv), np.empty(nv)
    count = 0
    for i in range(nv):
        g.turn[i] = g.held[i] = 0.0
        if s.dry[i]:
            speed = x[len(x) - nv + i]
            g.turn[i] = np.sign(speed) if not s.gives and abs(speed) > REST else released[i]
            if g.turn[i] == 0:
                g.held[i] = 1.0
                count += 1
    for _ in range(count):
        _holding_forces(s, w, x, effort, g, a, force)
        worst, most = -1, 0.0
        for i in range(nv):
            if g.held[i] != 0 and stays[i] == 0 and abs(force[i]) - _friction(s, i) > most:
                worst, most = i, abs(force[i]) - _friction(s, i)
        if worst < 0:
            return
        g.turn[worst], g.held[worst] = np.sign(force[worst]), 0.0


@inner
def _room(s: System, w: Workspace, x: Array, effort: Array, g: Grip, room: Array) -> None:
    """By how much each joint slides or is held as it should at x, negative beyond; infinite of others."""
    nv = len(room)
    a, force, some = np.empty(nv), np.empty(nv), False
    for i in range(nv):
        room[i] = np.inf
        if g.turn[i] != 0 and not s.gives:
            room[i] = g.turn[i] * x[len(x) - nv + i]
        some = some or g.held[i] != 0
    if s.gives:
        every = np.zeros(nv)
        for i in range(nv):
            every[i] = 1.0 if s.dry[i] else 0.0
        _holding_forces(s, w, x, effort, Grip(False, np.zeros(nv), every), a, force)
    elif some:
        _holding_forces(s, w, x, effort, g, a, force)
    for i in range(nv):
        size = max(_friction(s, i), 1e-300)
        if g.held[i] != 0:
            room[i] = 1 - abs(force[i]) / size
        elif s.gives and s.dry[i]:
            room[i] = g.turn[i] * force[i] / size - 1


@inner
def _begin(s: System, x: Array, g: Grip, y: Array) -> None:
    """y is x with joints at rest that are held."""
    for i in range(len(x)):
        y[i] = x[i]
    if not s.gives:
        for i in range(len(g.held)):
            if g.held[i] != 0:
                y[len(x) - len(g.held) + i] = 0.0


@inner
def _jump(
    s: System,
    w: Workspace,
    x: Array,
    effort: Array,
    g: Grip,
    stopped: int,
    last: Grip,
    X: Array,
) -> None:
    """Of X, what becomes of a small change of the state where a phase begins.

    Of a joint that has come to 0 it has changed when: what is accelerated otherwise from then on is moved by that.
    """
    nv, nx = len(g.held), len(x)
    nq = nx - nv
    before, after, some = np.empty(nv), np.empty(nv), False
    for i in range(nv):
        some = some or g.held[i] != 0
    if stopped >= 0:
        _accelerate(s, w, x, effort, last, before)
        _accelerate(s, w, x, effort, g, after)
        if before[stopped] != 0:
            for k in range(X.shape[1]):
                late = X[nq + stopped, k] / before[stopped]
                for i in range(nv):
                    X[nq + i, k] += (after[i] - before[i]) * late
    elif some and not s.gives:  # the momentum of what goes on is what it was
        _mass_and_force(s, w, x, effort, g)
        M, b = w.M.copy(), np.zeros((nv, X.shape[1]))
        for i in range(nv):
            for k in range(X.shape[1]):
                for j in range(nv):
                    if g.held[i] == 0:
                        b[i, k] += M[i, j] * X[nq + j, k]
        for i in range(nv):
            if g.held[i] != 0:
                for j in range(nv):
                    M[i, j] = M[j, i] = 0.0
                M[i, i] = 1.0
        if _factor(M):
            _substitute(M, b, 0, X.shape[1])
        for i in range(nv):
            for k in range(X.shape[1]):
                X[nq + i, k] = b[i, k]


@inner
def _end(
    s: System,
    c: Changes,
    w: Workspace,
    x: Array,
    h: float,
    effort: Array,
    g: Grip,
    room: Array,
    out: Array,
) -> tuple[float, int]:
    """(when a motion ends that has this room (nv,) at h, by which joint), out being where: Illinois' regula falsi.

    Looked at are the joints that are beyond at h; every third step halves what is left.
    """
    nv, nothing = len(room), np.empty((0, 0))
    sought, now = room < 0, np.empty(nv)
    low, high, t, which = 0.0, h, h, 0
    at_low, at_high, side = np.inf, np.inf, 0.0
    _room(s, w, x, effort, g, now)
    for i in range(nv):
        if sought[i]:
            at_low = min(at_low, now[i])
            at_high = min(at_high, room[i])
    at_low = max(at_low, 0.0)
    for k in range(SEARCHED):
        fraction = at_low / max(at_low - at_high, 1e-300) if at_low > 0 and k % 3 < 2 else 0.5
        t = low + (high - low) * fraction
        _step(s, c, w, x, t, effort, g, nothing, out)
        _room(s, w, out, effort, g, now)
        least = np.inf
        for i in range(nv):
            if sought[i] and not now[i] >= least:
                least, which = now[i], i
        if least > 0:
            at_low, low = least, t
            at_high = at_high / 2 if side > 0 else at_high
            side = 1.0
        else:
            at_high, high = least, t
            at_low = at_low / 2 if side < 0 else at_low
            side = -1.0
        if abs(least) < MET or not high - low > SHORT:
            break
    return t, which


@inner
def _advance(
    s: System,
    c: Changes,
    w: Workspace,
    x: Array,
    h: float,
    effort: Array,
    X: Array,
    out: Array,
) -> None:
    """As `_step`, with Coulomb friction of the coordinates that are dry."""
    nv, nx = s.spread.shape[1], len(x)
    nothing, dry = np.empty((0, 0)), False
    for i in range(nv):
        dry = dry or s.dry[i]
    g, last = Grip(not dry, np.zeros(nv), np.zeros(nv)), Grip(False, np.zeros(nv), np.zeros(nv))
    if not dry:
        _step(s, c, w, x, h, effort, g, X, out)
        return
    released, stays, room, a, force = np.zeros(nv), np.zeros(nv), np.empty(nv), np.empty(nv), np.empty(nv)
    here, y, left, stopped = x.copy(), np.empty(nx), h, -1
    for _ in range(MOST_PHASES):
        if left <= 0:
            break
        _grip(s, w, here, effort, released, stays, g)
        _begin(s, here, g, y)
        _step(s, c, w, y, left, effort, g, nothing, out)
        _room(s, w, out, effort, g, room)
        ends, length, which = False, left, -1
        for i in range(nv):
            ends = ends or room[i] < 0
        if ends:
            length, which = _end(s, c, w, y, left, effort, g, room, out)
        if len(X):
            _jump(s, w, here, effort, g, stopped, last, X)
            _step(s, c, w, y, length, effort, g, X, out)
        stopped = -1
        for i in range(nv):
            released[i] = stays[i] = 0.0
            last.turn[i], last.held[i] = g.turn[i], g.held[i]
        if ends:
            if g.held[which] != 0:
                _holding_forces(s, w, out, effort, g, a, force)
                released[which] = np.sign(force[which])
            elif s.gives:
                stays[which] = 1.0
            else:
                out[nx - nv + which] = 0.0
                stopped = which
        for i in range(nx):
            here[i] = out[i]
        left = left - length if ends else 0.0
    for i in range(nx):
        out[i] = here[i] if left <= 0 else np.nan


@compiled
def run(s: System, c: Changes, hs: Array, effort: Array, xs: Array, jacobians: Array) -> None:
    """Fill xs (K, M + 1, nx), which has the starts, by steps of hs (K, M) under inputs effort (K, M, nu).

    Or, unless they are empty, jacobians (K, M, nx, nx + P) with the derivatives of each step from xs.
    """
    w, nx = workspace(s, c.parameters), xs.shape[2]
    X, end = np.empty((0, 0)), np.empty(nx)
    for k in range(len(hs)):
        for m in range(hs.shape[1]):
            if len(jacobians):
                X, out = jacobians[k, m], end
                X[:] = 0.0
                for i in range(nx):
                    X[i, i] = 1.0
            else:
                out = xs[k, m + 1]
                out[:] = xs[k, m]
            if hs[k, m] != 0:
                _advance(s, c, w, xs[k, m], hs[k, m], effort[k, m], X, out)


@compiled
def accelerations(
    s: System, c: Changes, x: Array, effort: Array, turn: Array, held: Array, a: Array, by: Array
) -> None:
    """Fill turn and held (N, nv), a (N, nv), and, unless it is empty, by (N, nv, 2 nv + P), at x (N, nx)."""
    w, nv, dry = workspace(s, c.parameters), s.spread.shape[1], False
    for i in range(nv):
        dry = dry or s.dry[i]
    for k in range(len(x)):
        g = Grip(not dry, turn[k], held[k])
        if dry:
            _grip(s, w, x[k], effort[k], np.zeros(nv), np.zeros(nv), g)
        if len(by):
            _differentiate(s, c, w, x[k], effort[k], g, a[k], by[k])
        else:
            _accelerate(s, w, x[k], effort[k], g, a[k])

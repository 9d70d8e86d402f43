"""Compiled steps of trees with inputs, springs, dampers and friction.

    M(q) a = B u - C(q, v) v + gravity - springs - damping v - friction

Inverse dynamics is from `mechanics.tree_kernel`. This module adds the other forces and the Runge-Kutta steps.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.compiled import compiled, inner
from drake_diff.mechanics.tree_kernel import Tree, _factor, differentiate_tree, substitute

Array = NDArray[np.float64]
Whole = NDArray[np.int64]


class TreeSystem(NamedTuple):
    """A tree of n joint coordinates, some of which may be mimic coordinates, and the forces on it."""

    tree: Tree
    of_q: Whole  # q of the joints is ratio * q[of_q] + shift
    ratio: Array
    shift: Array
    spread: Array  # (n, nv) derivatives of the joint velocities with respect to the independent ones
    single: Whole  # (S, 2) indices in q and v of the independent joints with one degree of freedom
    free: Whole  # (F, 2) first indices in q and v of free bodies
    position: Whole  # (n,) index of a spring's position in q of the joints
    reflected: Array  # (n,)
    damping: Array
    stiffness: Array
    rest: Array
    coulomb: Array
    servo: Whole  # (n,) index of the input that is the joint's commanded position; -1 if there is none
    kp: Array  # (nu,)
    kd: Array  # (nu,)
    strength: Array  # (nu,)
    limit: Array  # (nu,) maximum effort of a servo
    slip: float  # speed over which smooth friction changes its sign; 0 if `turn` gives the direction of sliding


@inner
def _load(s: TreeSystem, x: Array, q: Array, v: Array) -> None:
    """Fill q and v (n,) of all joints at x (nx,)."""
    n, nv = s.spread.shape
    nq = len(x) - nv
    for i in range(len(q)):
        q[i] = s.ratio[i] * x[s.of_q[i]] + s.shift[i]
    for i in range(n):
        v[i] = 0.0
        for j in range(nv):
            v[i] += s.spread[i, j] * x[nq + j]


@inner
def _add_forces(s: TreeSystem, q: Array, v: Array, push: Array, turn: Array, mass: Array, tau: Array) -> None:
    """Replace tau (n,) by the accelerating force, and add the reflected inertia to mass (n, n).

    push (n,) is the force on a joint, or the commanded position of a servo.
    """
    for i in range(len(v)):
        slide = 0.0
        if s.slip > 0:
            slide = np.tanh(v[i] / s.slip) if s.coulomb[i] != 0 else 0.0
        else:
            for j in range(len(turn)):
                slide += np.sign(s.spread[i, j]) * turn[j]
        mass[i, i] += s.reflected[i]
        force, k = push[i], s.servo[i]
        if k >= 0:
            force = s.kp[k] * (push[i] - q[s.position[i]]) - s.kd[k] * v[i]
            force = s.strength[k] * min(max(force, -s.limit[k]), s.limit[k])
        tau[i] = force - tau[i] - s.damping[i] * v[i] - s.coulomb[i] * slide
        if s.stiffness[i] != 0:
            tau[i] -= s.stiffness[i] * (q[s.position[i]] - s.rest[i])


@inner
def _reduce(s: TreeSystem, mass: Array, tau: Array, M: Array, force: Array) -> None:
    """Fill M (nv, nv) = E' mass E and force (nv,) = E' tau of the independent joints."""
    n, nv = s.spread.shape
    M[:], force[:] = 0.0, 0.0
    for i in range(n):
        for a in range(nv):
            if s.spread[i, a] == 0:
                continue
            force[a] += s.spread[i, a] * tau[i]
            for j in range(n):
                for b in range(nv):
                    if s.spread[j, b] != 0:
                        M[a, b] += s.spread[i, a] * mass[i, j] * s.spread[j, b]


@compiled
def accelerate(s: TreeSystem, x: Array, push: Array, turn: Array, held: Array, a: Array, holding: Array) -> None:
    """Fill a (N, nv) at x (N, nx) under generalized forces push (N, n), with NaN if M is not positive definite.

    Also fill holding (N, nv), the force on each sticking joint. turn (N, nv) is 1 or -1 for sliding joints.
    """
    N, nv = a.shape
    n = len(s.spread)
    q, v, zero = np.empty((N, len(s.of_q))), np.empty((N, n)), np.zeros((N, n))
    poses, S, tau = np.empty((N, len(s.tree.kind), 3, 4)), np.empty((N, n, 6)), np.empty((N, n))
    mass, slope, by_q, by_v = np.empty((N, n, n)), np.empty((N, n, n)), np.empty((N, n, n)), np.empty((N, n, n))
    M, b, factored = np.empty((nv, nv)), np.empty((nv, 1)), np.empty((nv, nv))
    for k in range(N):
        _load(s, x[k], q[k], v[k])
    differentiate_tree(s.tree, q, v, zero, False, poses, S, mass, slope, tau, by_q, by_v)
    for k in range(N):
        force = holding[k]
        _add_forces(s, q[k], v[k], push[k], turn[k], mass[k], tau[k])
        _reduce(s, mass[k], tau[k], M, force)
        for i in range(nv):
            b[i, 0] = 0.0 if held[k, i] != 0 else force[i]
            for j in range(nv):
                is_fixed = held[k, i] != 0 or held[k, j] != 0
                factored[i, j] = M[i, j] if not is_fixed else 1.0 if i == j else 0.0
        good = _factor(factored)
        if good:
            substitute(factored, b)
        for i in range(nv):
            a[k, i] = b[i, 0] if good else np.nan
        for i in range(nv):
            for j in range(nv):
                force[i] -= M[i, j] * a[k, j]
            if held[k, i] == 0:
                force[i] = 0.0


@inner
def _rate(s: TreeSystem, x: Array, a: Array, out: Array) -> None:
    """Fill out (nx,) with dx/dt."""
    nq = len(x) - len(a)
    for k in range(len(s.single)):
        out[s.single[k, 0]] = x[nq + s.single[k, 1]]
    for k in range(len(s.free)):
        start, i = s.free[k, 0], nq + s.free[k, 1]
        w, y, z, t = x[start], x[start + 1], x[start + 2], x[start + 3]
        out[start] = -0.5 * (x[i] * y + x[i + 1] * z + x[i + 2] * t)
        out[start + 1] = 0.5 * (x[i] * w + x[i + 1] * t - x[i + 2] * z)
        out[start + 2] = 0.5 * (x[i + 1] * w + x[i + 2] * y - x[i] * t)
        out[start + 3] = 0.5 * (x[i + 2] * w + x[i] * z - x[i + 1] * y)
        for m in range(3):
            out[start + 4 + m] = x[i + 3 + m]
    for j in range(len(a)):
        out[nq + j] = a[j]


@compiled
def step(
    s: TreeSystem, stages: Array, weights: Array, x: Array, h: Array, push: Array, turn: Array, held: Array, out: Array
) -> None:
    """Fill out (N, nx) with the states after steps of h (N,) from x (N, nx), for these stages and weights."""
    N, nx = x.shape
    y, a, holding = x.copy(), np.empty(turn.shape), np.empty(turn.shape)
    rates = np.empty((len(weights), N, nx))
    for m in range(len(weights)):
        for k in range(N):
            for i in range(nx):
                total = 0.0
                for r in range(m):
                    total += stages[m, r] * rates[r, k, i]
                y[k, i] = x[k, i] + h[k] * total
        accelerate(s, y, push, turn, held, a, holding)
        for k in range(N):
            _rate(s, y[k], a[k], rates[m, k])
    for k in range(N):
        for i in range(nx):
            total = 0.0
            for m in range(len(weights)):
                total += weights[m] * rates[m, k, i]
            out[k, i] = x[k, i] + h[k] * total

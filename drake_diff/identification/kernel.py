"""A tree with dampers, springs, dry friction and inputs: its steps, and its forces by what its links weigh: compiled.

The formulas are those of `identification.tree` and `identification.flow`. Kept apart as Numba compiles what is in here.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.compiled import compiled
from drake_diff.mechanics.tree_kernel import (
    FREE,
    Tree,
    _add_cross,
    _add_cross_force,
    _dot,
    _rotated,
    _times,
    differentiate_tree,
    solve,
)

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

TURNS, SLIDES = 0, 1  # dry friction that turns over a small speed, or one of which is said what it does


class Forces(NamedTuple):
    """What acts beside inertia and gravity, by the n degrees of freedom."""

    position: Whole  # (n,) of a spring, in q
    reflected: Array  # (n,)
    damping: Array  # (n,)
    stiffness: Array  # (n,)
    rest: Array  # (n,)
    coulomb: Array  # (n,)
    held_inertia: Array  # (n,)
    held_damping: Array  # (n,)
    slip: float


@compiled
def step(
    tree: Tree,
    forces: Forces,
    stages: Array,
    weights: Array,
    x: Array,
    h: Array,
    push: Array,
    friction: int,
    turn: Array,
    held: Array,
    out: Array,
) -> None:
    """Fill out (N, nx) with where x (N, nx) is after steps of h (N,) under generalized forces push (N, n) of inputs.

    By the method of Runge and Kutta of these stages (s, s) and weights (s,). `friction` is TURNS, or SLIDES where turn
    (N, n) says which way joints slide, and held (N, n) is 1 of those that are held. NaN where a mass matrix is not
    positive definite.
    """
    N, nx = x.shape
    n = push.shape[1]
    nq, count = nx - n, len(weights)
    q, v, none, rates = np.empty((N, nq)), np.empty((N, n)), np.zeros((N, n)), np.empty((count, N, nx))
    poses, S, tau = np.empty((N, len(tree.kind), 3, 4)), np.empty((N, n, 6)), np.empty((N, n))
    mass, slope, by_q, by_v = np.empty((N, n, n)), np.empty((N, n, n)), np.empty((N, n, n)), np.empty((N, n, n))
    for s in range(count):
        for k in range(N):
            for i in range(nx):
                total = 0.0
                for r in range(s):
                    total += stages[s, r] * rates[r, k, i]
                if i < nq:
                    q[k, i] = x[k, i] + h[k] * total
                else:
                    v[k, i - nq] = x[k, i] + h[k] * total
        differentiate_tree(tree, q, v, none, False, poses, S, mass, slope, tau, by_q, by_v)
        for k in range(N):
            M, a = mass[k], tau[k]
            for i in range(n):
                speed = v[k, i]
                force = push[k, i] - a[i] - forces.damping[i] * speed
                M[i, i] += forces.reflected[i]
                if forces.stiffness[i] != 0:
                    force -= forces.stiffness[i] * (q[k, forces.position[i]] - forces.rest[i])
                if friction == TURNS:
                    if forces.coulomb[i] != 0:
                        force -= forces.coulomb[i] * np.tanh(speed / forces.slip)
                else:
                    force -= forces.coulomb[i] * turn[k, i]
                    if held[k, i] != 0:
                        force -= forces.held_damping[i] * speed
                        M[i, i] += forces.held_inertia[i]
                a[i] = force
            if friction == SLIDES:
                for i in range(n):
                    if held[k, i] != 0 and forces.held_inertia[i] == 0:
                        for j in range(n):
                            M[i, j] = M[j, i] = 0.0
                        M[i, i], a[i] = 1.0, 0.0
            if not solve(M, a):
                for i in range(n):
                    a[i] = np.nan
            _rate(tree, q, v, k, rates[s])
            for i in range(n):
                rates[s, k, nq + i] = a[i]
    for k in range(N):
        for i in range(nx):
            total = 0.0
            for s in range(count):
                total += weights[s] * rates[s, k, i]
            out[k, i] = x[k, i] + h[k] * total


@compiled
def _rate(tree: Tree, q: Array, v: Array, k: int, out: Array) -> None:
    """out[k] begins with dq/dt."""
    for i in range(len(tree.kind)):
        at, s = tree.q_start[i], tree.v_start[i]
        if tree.kind[i] != FREE:
            out[k, at] = v[k, s]
            continue
        w, x, y, z = q[k, at], q[k, at + 1], q[k, at + 2], q[k, at + 3]
        a, b, c = v[k, s], v[k, s + 1], v[k, s + 2]
        out[k, at] = -0.5 * (a * x + b * y + c * z)
        out[k, at + 1] = 0.5 * (a * w + b * z - c * y)
        out[k, at + 2] = 0.5 * (b * w + c * x - a * z)
        out[k, at + 3] = 0.5 * (c * w + a * y - b * x)
        for m in range(3):
            out[k, at + 4 + m] = v[k, s + 3 + m]


@compiled
def _in_world(X: Array, numbers: Array, m: int, J: Array, out: Array) -> None:
    """out (1, 10) = numbers[m] (10,) of a link at X (3, 4), about the world's origin; J (3, 3) is worked in.

    The numbers are about the origin of the link's frame.
    """
    mass, squared, along = numbers[m, 0], 0.0, 0.0
    out[0, 0] = mass
    for a in range(3):
        h = X[a, 0] * numbers[m, 1] + X[a, 1] * numbers[m, 2] + X[a, 2] * numbers[m, 3]
        squared += X[a, 3] * X[a, 3]
        along += X[a, 3] * h
        out[0, 1 + a] = h
        J[a, a] = numbers[m, 4 + a]
    J[0, 1] = J[1, 0] = numbers[m, 7]
    J[0, 2] = J[2, 0] = numbers[m, 8]
    J[1, 2] = J[2, 1] = numbers[m, 9]
    for i in range(6):
        a, b = (i, i) if i < 3 else ((i - 3) // 2, 1 + (i - 2) // 2)
        total = _rotated(X, J, a, b) - X[a, 3] * out[0, 1 + b] - out[0, 1 + a] * X[b, 3] - mass * X[a, 3] * X[b, 3]
        if a == b:
            total += 2 * along + mass * squared
        out[0, 4 + i] = total
    for a in range(3):
        out[0, 1 + a] += mass * X[a, 3]


@compiled
def force_by_links(
    tree: Tree,
    links: Array,
    poses: Array,
    S: Array,
    v: Array,
    a: Array,
    inertial: Array,
    gravity: Array,
    out: Array,
) -> None:
    """Fill out (N, n, c) with inverse dynamics at v and a (N, n) by c small changes of links' numbers and of gravity.

    The links have the ten numbers (L, 10), which change by `inertial` (c, L, 10), and gravity by `gravity` (c, 3);
    poses (N, L, 3, 4) and S (N, n, 6) are those of `differentiate_tree`.
    """
    J, L, C = len(tree.parent), len(tree.kind), len(inertial)
    V, A, F = np.empty((J + 1, 6)), np.empty((J + 1, 6)), np.empty((J, 6))
    ten, momentum, before, falling, work = (
        np.empty((1, 10)),
        np.empty((1, 6)),
        np.empty((1, 6)),
        np.zeros((1, 6)),
        np.empty((3, 3)),
    )
    falls = np.zeros(C, dtype=np.bool_)
    some = np.zeros((C, L), dtype=np.bool_)
    for c in range(C):
        for i in range(3):
            falls[c] = falls[c] or gravity[c, i] != 0
        for m in range(L):
            for i in range(10):
                some[c, m] = some[c, m] or inertial[c, m, i] != 0
    for k in range(len(v)):
        V[J], A[J] = 0.0, 0.0
        for i in range(3):
            A[J, 3 + i] = -tree.gravity[i]
        for j in range(J):
            up = tree.parent[j] if tree.parent[j] >= 0 else J
            for i in range(6):
                V[j, i], A[j, i] = V[up, i], A[up, i]
            for s in range(tree.first[j], tree.first[j] + tree.size[j]):
                for i in range(6):
                    before[0, i] = 0.0
                _add_cross(V, up, S[k], s, before, 0)
                for i in range(6):
                    V[j, i] += S[k, s, i] * v[k, s]
                    A[j, i] += S[k, s, i] * a[k, s] + before[0, i] * v[k, s]
        for c in range(C):
            for j in range(J):
                for i in range(6):
                    F[j, i] = 0.0
            for i in range(3):  # gravity is an acceleration of the world the other way
                falling[0, 3 + i] = -gravity[c, i]
            for m in range(L):
                j = tree.joint[m]
                if some[c, m]:
                    _in_world(poses[k, m], inertial[c], m, work, ten)
                    _times(ten, 0, A, j, momentum, 0)
                    for i in range(6):
                        F[j, i] += momentum[0, i]
                    _times(ten, 0, V, j, momentum, 0)
                    _add_cross_force(V, j, momentum, 0, F, j)
                if falls[c]:
                    _in_world(poses[k, m], links, m, work, ten)
                    _times(ten, 0, falling, 0, momentum, 0)
                    for i in range(6):
                        F[j, i] += momentum[0, i]
            for j in range(J - 1, -1, -1):
                for s in range(tree.first[j], tree.first[j] + tree.size[j]):
                    out[k, s, c] = _dot(S[k], s, F, j)
                if tree.parent[j] >= 0:
                    for i in range(6):
                        F[tree.parent[j], i] += F[j, i]

"""A tree of hinges and slides moved under feedback, step after step: compiled.

The formulas are those of `mechanics.tree` and `derivatives.smooth_step`. Kept apart as Numba compiles what is in here.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.compiled import compiled
from drake_diff.mechanics.tree_kernel import Tree, _add_cross, _add_cross_force, _dot, _place, _times, solve

Array = NDArray[np.float64]


class Forces(NamedTuple):
    """What acts beside the tree's own inertia and gravity, by its nv velocities."""

    time_step: float
    armature: Array  # (nv,)
    stiffness: Array  # (nv,)
    damping: Array  # (nv,)
    rest: Array  # (nv,)
    actuation: Array  # (nv, nu)
    limit: Array  # (nu,) of inputs that are clipped


class Bounds(NamedTuple):
    """(nu,) each: from `lowest` down an input is on its lower bound, from `highest` up on its upper one."""

    lowest: Array
    highest: Array
    lower: Array
    upper: Array


@compiled
def roll(
    tree: Tree,
    forces: Forces,
    bounds: Bounds,
    old: Array,
    gaps: Array,
    wanted: Array,
    gains: Array,
    xs: Array,
    us: Array,
) -> bool:
    """Fill us (N, nu) = wanted + gains (N, nu, nx) (xs - old), within bounds, and xs (N+1, nx) from xs[0] on.

    Each step leads to what it leaves less its gap (N, nx). False where a mass matrix is not positive definite.
    """
    count, nu = us.shape
    nx = xs.shape[1]
    n, J, h = nx // 2, len(tree.parent), forces.time_step
    parent, first = tree.parent, tree.first
    poses, S, own = np.empty((len(tree.kind), 3, 4)), np.empty((n, 6)), np.empty((J, 10))
    V, A, F, momentum = np.empty((J + 1, 6)), np.empty((J + 1, 6)), np.empty((J, 6)), np.empty((1, 6))
    M, a = np.zeros((n, n)), np.empty(n)
    V[J], A[J] = 0.0, 0.0  # the world's
    for i in range(3):
        A[J, 3 + i] = -tree.gravity[i]
    for k in range(count):
        x = xs[k]
        for i in range(nu):
            u = wanted[k, i]
            for c in range(nx):
                u += gains[k, i, c] * (x[c] - old[k, c])
            if u <= bounds.lowest[i]:
                u = bounds.lower[i]
            elif u >= bounds.highest[i]:
                u = bounds.upper[i]
            us[k, i] = u
        _place(tree, x[:n], poses, S, own)
        for j in range(J):
            s, up = first[j], parent[j] if parent[j] >= 0 else J
            speed = x[n + s]
            for i in range(6):
                V[j, i], A[j, i], F[j, i], momentum[0, i] = V[up, i], A[up, i], 0.0, 0.0
            _add_cross(V, up, S, s, momentum, 0)
            for i in range(6):
                V[j, i] += S[s, i] * speed
                A[j, i] += momentum[0, i] * speed
            _times(own, j, A, j, F, j)
            _times(own, j, V, j, momentum, 0)
            _add_cross_force(V, j, momentum, 0, F, j)
        for j in range(J - 1, -1, -1):
            s, up = first[j], parent[j]
            total = forces.rest[s] - forces.damping[s] * x[n + s] - forces.stiffness[s] * x[s] - _dot(S, s, F, j)
            for i in range(nu):
                total += forces.actuation[s, i] * min(max(us[k, i], -forces.limit[i]), forces.limit[i])
            a[s] = total
            _times(own, j, S, s, momentum, 0)
            M[s, s] = _dot(momentum, 0, S, s) + forces.armature[s]
            above = up
            while above >= 0:
                c = first[above]
                M[s, c] = M[c, s] = _dot(momentum, 0, S, c)
                above = parent[above]
            if up >= 0:
                for i in range(10):
                    own[up, i] += own[j, i]
                for i in range(6):
                    F[up, i] += F[j, i]
        if not solve(M, a):
            return False
        for s in range(n):
            v = x[n + s] + h * a[s]
            xs[k + 1, n + s] = v - gaps[k, n + s]
            xs[k + 1, s] = x[s] + h * v - gaps[k, s]
        for r in range(n):
            for c in range(n):
                M[r, c] = 0.0
    return True

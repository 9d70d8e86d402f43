"""Compiled kernels for a tree's poses, motions, inertia and inverse dynamics with derivatives, state by state.

The formulas are in `mechanics.tree`. Spatial vectors are [angular; linear] in world about its origin. Each inner loop
visits only the ancestors of a joint. The kernels have a module of their own because Numba compiles them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.compiled import compiled

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

WELD, HINGE, SLIDE, FREE = 0, 1, 2, 3


class Tree(NamedTuple):
    """L links, every parent before its children, carried by J joints of one or three degrees of freedom.

    A free body has two joints: three slides, followed by three rotations about world axes.
    """

    link_parent: Whole  # (L,) -1 for the world
    kind: Whole  # (L,)
    joint: Whole  # (L,) the joint that carries the link, -1 for a link fixed to the world
    q_start: Whole  # (L,)
    v_start: Whole  # (L,)
    axis: Array  # (L, 3) in the joint's frames
    frame: Array  # (L, 3, 4) pose of the joint's frame on the parent
    back: Array  # (L, 3, 4) pose of the link in the joint's frame on the child
    mass: Array  # (L,)
    center: Array  # (L, 3) centre of mass in the link's frame
    inertia: Array  # (L, 3, 3) about the centre of mass
    parent: Whole  # (J,) -1 for the world; every parent before its children
    first: Whole  # (J,) index of the first velocity
    size: Whole  # (J,) number of degrees of freedom
    gravity: Array  # (3,)


class Forces(NamedTuple):
    """Joint forces and input forces added to the tree's inertia and gravity, in the order of its nv velocities."""

    time_step: float
    armature: Array  # (nv,)
    stiffness: Array  # (nv,)
    damping: Array  # (nv,)
    rest: Array  # (nv,) constant force due to the rest positions
    actuation: Array  # (nv, nu)
    limit: Array  # (nu,) effort limits, to which the inputs are clipped


class SaturationBounds(NamedTuple):
    """Bounds (nu,) of inputs: an input <= `lowest` is set to `lower`, and an input >= `highest` is set to `upper`."""

    lowest: Array
    highest: Array
    lower: Array
    upper: Array


@compiled
def _compose(R: Array, p: Array, X: Array, R_out: Array, p_out: Array) -> None:
    """Compute (R_out, p_out) = (R, p) X."""
    for i in range(3):
        total = p[i]
        for j in range(3):
            total += R[i, j] * X[j, 3]
            R_out[i, j] = R[i, 0] * X[0, j] + R[i, 1] * X[1, j] + R[i, 2] * X[2, j]
        p_out[i] = total


@compiled
def _turned(R: Array, axis: Array, angle: float, out: Array) -> None:
    """Compute out = R exp(angle axis^)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z, d = axis[0], axis[1], axis[2], 1.0 - c
    for i in range(3):
        a, b, e = R[i, 0], R[i, 1], R[i, 2]
        along = d * (a * x + b * y + e * z)
        out[i, 0] = c * a + along * x + s * (b * z - e * y)
        out[i, 1] = c * b + along * y + s * (e * x - a * z)
        out[i, 2] = c * e + along * z + s * (a * y - b * x)


@compiled
def _orientation(q: Array, start: int, out: Array) -> None:
    """Compute the rotation matrix of the quaternion (w, x, y, z), of any norm, that begins at q[start]."""
    w, x, y, z = q[start], q[start + 1], q[start + 2], q[start + 3]
    d = 2.0 / (w * w + x * x + y * y + z * z)
    out[0, 0], out[0, 1], out[0, 2] = 1 - d * (y * y + z * z), d * (x * y - w * z), d * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = d * (x * y + w * z), 1 - d * (x * x + z * z), d * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = d * (x * z - w * y), d * (y * z + w * x), 1 - d * (x * x + y * y)


@compiled
def _axis_through(S: Array, i: int, axis: Array, p: Array) -> None:
    """Set S[i] to the rotation about an axis through p."""
    S[i, 0], S[i, 1], S[i, 2] = axis[0], axis[1], axis[2]
    S[i, 3] = p[1] * axis[2] - p[2] * axis[1]
    S[i, 4] = p[2] * axis[0] - p[0] * axis[2]
    S[i, 5] = p[0] * axis[1] - p[1] * axis[0]


@compiled
def _through_joint(
    kind: int, local: Array, q: Array, start: int, R: Array, p: Array, R_child: Array, p_child: Array, S: Array, v: int
) -> None:
    """Compute the frame after a joint with the axis `local` (3,) in the frame (R, p), and its motions from S[v] on."""
    for a in range(3):
        p_child[a] = p[a]
        for b in range(3):
            R_child[a, b] = R[a, b]
    if kind == FREE:
        axis = np.zeros(3)
        _orientation(q, start, R_child)
        for a in range(3):
            p_child[a] = q[start + 4 + a]
        for a in range(3):
            axis[a] = 1.0
            _axis_through(S, v + a, axis, p_child)
            S[v + 3 + a, 3 + a] = 1.0
            axis[a] = 0.0
    elif kind != WELD:
        axis = np.empty(3)
        for a in range(3):
            axis[a] = R[a, 0] * local[0] + R[a, 1] * local[1] + R[a, 2] * local[2]
        if kind == HINGE:
            _turned(R, local, q[start], R_child)
            _axis_through(S, v, axis, p)
        else:
            for a in range(3):
                S[v, 3 + a] = axis[a]
                p_child[a] = p[a] + q[start] * axis[a]


@compiled
def _add_inertia(m: float, center: Array, inertia: Array, X: Array, out: Array) -> None:
    """Add the inertia of a link with the pose X (3, 4) to out (10,).

    The entries are mass, moment of mass (3), and xx yy zz xy xz yz about the world's origin.
    """
    c, squared = np.empty(3), 0.0
    for a in range(3):
        c[a] = X[a, 0] * center[0] + X[a, 1] * center[1] + X[a, 2] * center[2] + X[a, 3]
        squared += c[a] * c[a]
    out[0] += m
    for a in range(3):
        out[1 + a] += m * c[a]
        out[4 + a] += m * (squared - c[a] * c[a]) + _rotated(X, inertia, a, a)
    out[7] += _rotated(X, inertia, 0, 1) - m * c[0] * c[1]
    out[8] += _rotated(X, inertia, 0, 2) - m * c[0] * c[2]
    out[9] += _rotated(X, inertia, 1, 2) - m * c[1] * c[2]


@compiled
def _forward_kinematics(t: Tree, q: Array, poses: Array, S: Array, inertias: Array) -> None:
    """Compute the links' poses (L, 3, 4), the motions S (nv, 6), and each joint's own inertia (J, 10)."""
    R, p, R_child, p_child = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    R_world, p_world = np.eye(3), np.zeros(3)
    S[:], inertias[:] = 0.0, 0.0
    for i in range(len(t.kind)):
        up, j = t.link_parent[i], t.joint[i]
        if up < 0:
            _compose(R_world, p_world, t.frame[i], R, p)
        else:
            _compose(poses[up, :, :3], poses[up, :, 3], t.frame[i], R, p)
        start, v = t.q_start[i], t.v_start[i]
        _through_joint(t.kind[i], t.axis[i], q, start, R, p, R_child, p_child, S, v)
        _compose(R_child, p_child, t.back[i], poses[i, :, :3], poses[i, :, 3])
        if j >= 0:
            _add_inertia(t.mass[i], t.center[i], t.inertia[i], poses[i], inertias[j])


@compiled
def _rotated(X: Array, inertia: Array, a: int, b: int) -> float:
    """Return entry (a, b) of R inertia R'."""
    total = 0.0
    for i in range(3):
        total += X[a, i] * (inertia[i, 0] * X[b, 0] + inertia[i, 1] * X[b, 1] + inertia[i, 2] * X[b, 2])
    return total


# These functions take matrices and row indices, as a view of a row costs more than the arithmetic on the row.
@compiled
def _times(I: Array, i: int, S: Array, s: int, out: Array, o: int) -> None:  # noqa: E741
    """Compute out[o] = I[i] S[s]: the momentum [about the origin; linear] of an inertia (10,) moving at S[s] (6,)."""
    m, x, y, z = I[i, 0], I[i, 1], I[i, 2], I[i, 3]
    w0, w1, w2, l0, l1, l2 = S[s, 0], S[s, 1], S[s, 2], S[s, 3], S[s, 4], S[s, 5]
    out[o, 0] = I[i, 4] * w0 + I[i, 7] * w1 + I[i, 8] * w2 + y * l2 - z * l1
    out[o, 1] = I[i, 7] * w0 + I[i, 5] * w1 + I[i, 9] * w2 + z * l0 - x * l2
    out[o, 2] = I[i, 8] * w0 + I[i, 9] * w1 + I[i, 6] * w2 + x * l1 - y * l0
    out[o, 3] = m * l0 - (y * w2 - z * w1)
    out[o, 4] = m * l1 - (z * w0 - x * w2)
    out[o, 5] = m * l2 - (x * w1 - y * w0)


@compiled
def _add_cross(M: Array, m: int, S: Array, s: int, out: Array, o: int) -> None:
    """Compute out[o] += M[m] x S[s] for motions (6,)."""
    a0, a1, a2, b0, b1, b2 = M[m, 0], M[m, 1], M[m, 2], M[m, 3], M[m, 4], M[m, 5]
    w0, w1, w2, l0, l1, l2 = S[s, 0], S[s, 1], S[s, 2], S[s, 3], S[s, 4], S[s, 5]
    out[o, 0] += a1 * w2 - a2 * w1
    out[o, 1] += a2 * w0 - a0 * w2
    out[o, 2] += a0 * w1 - a1 * w0
    out[o, 3] += a1 * l2 - a2 * l1 + b1 * w2 - b2 * w1
    out[o, 4] += a2 * l0 - a0 * l2 + b2 * w0 - b0 * w2
    out[o, 5] += a0 * l1 - a1 * l0 + b0 * w1 - b1 * w0


@compiled
def _add_cross_force(M: Array, m: int, F: Array, f: int, out: Array, o: int) -> None:
    """Compute out[o] += M[m] x* F[f] for a motion and a force (6,)."""
    a0, a1, a2, b0, b1, b2 = M[m, 0], M[m, 1], M[m, 2], M[m, 3], M[m, 4], M[m, 5]
    n0, n1, n2, f0, f1, f2 = F[f, 0], F[f, 1], F[f, 2], F[f, 3], F[f, 4], F[f, 5]
    out[o, 0] += a1 * n2 - a2 * n1 + b1 * f2 - b2 * f1
    out[o, 1] += a2 * n0 - a0 * n2 + b2 * f0 - b0 * f2
    out[o, 2] += a0 * n1 - a1 * n0 + b0 * f1 - b1 * f0
    out[o, 3] += a1 * f2 - a2 * f1
    out[o, 4] += a2 * f0 - a0 * f2
    out[o, 5] += a0 * f1 - a1 * f0


@compiled
def _dot(A: Array, a: int, B: Array, b: int) -> float:
    total = 0.0
    for i in range(6):
        total += A[a, i] * B[b, i]
    return total


@compiled
def _force_rates(I: Array, j: int, V: Array, momentum: Array, B: Array, work: Array) -> None:  # noqa: E741
    """Compute B[j] (6, 6) = (V x*) I - I (V x) + (I V) x* for the inertia I[j] at V[j] with `momentum` (1, 6)."""
    for k in range(6):
        for r in range(3):
            for i in range(6):
                work[r, i] = 0.0
        work[0, k] = 1.0
        _add_cross(V, j, work, 0, work, 1)
        _times(I, j, work, 1, work, 3)
        _times(I, j, work, 0, work, 1)
        _add_cross_force(V, j, work, 1, work, 2)
        _add_cross_force(work, 0, momentum, 0, work, 2)
        for i in range(6):
            B[j, i, k] = work[2, i] - work[3, i]


@compiled
def differentiate_tree(
    t: Tree,
    q: Array,
    v: Array,
    a: Array,
    derivatives: bool,
    poses: Array,
    motions: Array,
    mass: Array,
    slope: Array,
    tau: Array,
    by_q: Array,
    by_v: Array,
) -> None:
    """Compute, at N states, the links' poses (N, L, 3, 4), S (N, nv, 6), M, and d M_kk / d q_j at entry k, j.

    Also compute the inverse dynamics (N, nv) at the accelerations a (N, nv) and, with `derivatives`, its derivatives
    with respect to the tangent of q and to v. `slope` is only computed with `derivatives`.
    """
    nv, J = v.shape[1], len(t.parent)
    parent, first, size = t.parent, t.first, t.size
    inertias, carried, work = np.empty((J, 10)), np.empty((J, 10)), np.empty((4, 6))
    V, A, F, B = np.empty((J + 1, 6)), np.empty((J + 1, 6)), np.empty((J, 6)), np.empty((J, 6, 6))
    before, P, Q, T = np.empty((nv, 6)), np.empty((nv, 6)), np.empty((nv, 6)), np.empty((nv, 6))
    S_I, S_B, of_q, of_v = np.empty((1, 6)), np.empty(6), np.empty((1, 6)), np.empty((1, 6))
    V[J], A[J] = 0.0, 0.0  # of the world
    for i in range(3):
        A[J, 3 + i] = -t.gravity[i]
    for n in range(len(q)):
        S = motions[n]
        _forward_kinematics(t, q[n], poses[n], S, inertias)
        for j in range(J):
            up = parent[j] if parent[j] >= 0 else J
            for i in range(6):
                V[j, i], A[j, i], F[j, i] = V[up, i], A[up, i], 0.0
            for s in range(first[j], first[j] + size[j]):
                for i in range(6):
                    before[s, i] = 0.0
                _add_cross(V, up, S, s, before, s)
                for i in range(6):
                    V[j, i] += S[s, i] * v[n, s]
                    A[j, i] += S[s, i] * a[n, s] + before[s, i] * v[n, s]
            for i in range(10):
                carried[j, i] = inertias[j, i]
            _times(inertias, j, A, j, F, j)
            _times(inertias, j, V, j, S_I, 0)
            _add_cross_force(V, j, S_I, 0, F, j)
            if derivatives:
                _force_rates(inertias, j, V, S_I, B, work)
        for j in range(J - 1, -1, -1):
            up = parent[j]
            if up >= 0:
                for i in range(10):
                    carried[up, i] += carried[j, i]
                for i in range(6):
                    F[up, i] += F[j, i]
                    if derivatives:
                        for k in range(6):
                            B[up, i, k] += B[j, i, k]
        for j in range(J if derivatives else 0):
            for s in range(first[j], first[j] + size[j]):
                for i in range(6):
                    P[s, i] = Q[s, i] = 0.0
                _add_cross(V, j, S, s, P, s)
                _add_cross(A, j, S, s, Q, s)
                _add_cross(V, j, P, s, Q, s)
                for i in range(6):
                    T[s, i] = before[s, i] + P[s, i]
        mass[n], slope[n], by_q[n], by_v[n] = 0.0, 0.0, 0.0, 0.0
        for j in range(J):
            for s in range(first[j], first[j] + size[j]):
                tau[n, s] = _dot(S, s, F, j)
                _times(carried, j, S, s, S_I, 0)
                if not derivatives:
                    up = j
                    while up >= 0:
                        for k in range(first[up], first[up] + size[up]):
                            mass[n, s, k] = mass[n, k, s] = _dot(S_I, 0, S, k)
                        up = parent[up]
                    continue
                _times(carried, j, Q, s, of_q, 0)
                _times(carried, j, T, s, of_v, 0)
                _add_cross_force(S, s, F, j, of_q, 0)
                for i in range(6):
                    total = 0.0
                    for k in range(6):
                        of_q[0, i] += B[j, i, k] * P[s, k]
                        of_v[0, i] += B[j, i, k] * S[s, k]
                        total += B[j, k, i] * S[s, k]
                    S_B[i] = total
                turns = size[j] == 1 or S[s, 0] != 0 or S[s, 1] != 0 or S[s, 2] != 0
                up = j
                while up >= 0:
                    for k in range(first[up], first[up] + size[up]):
                        by_q[n, k, s] += _dot(of_q, 0, S, k)
                        by_v[n, k, s] += _dot(of_v, 0, S, k)
                        mass[n, s, k] = mass[n, k, s] = _dot(S_I, 0, S, k)
                        if up != j:
                            for i in range(6):
                                by_q[n, s, k] += S_B[i] * P[k, i] + S_I[0, i] * Q[k, i]
                                by_v[n, s, k] += S_B[i] * S[k, i] + S_I[0, i] * T[k, i]
                        if turns:  # rotating the carried bodies is equivalent to rotating the motions before them back
                            for i in range(6):
                                work[0, i] = 0.0
                            _add_cross(S, s, S, k, work, 0)
                            _times(carried, j, S, k, work, 1)
                            slope[n, k, s] = -2.0 * _dot(work, 0, work, 1)
                    up = parent[up]


@compiled
def _factor(M: Array) -> bool:
    """Factor M = L D L' in place, L in the lower half and D on the diagonal; return False if not positive definite."""
    n = len(M)
    for i in range(n):
        for j in range(i):
            total = M[i, j]
            for k in range(j):
                total -= M[i, k] * M[j, k]
            M[i, j] = total  # L times D
        d = M[i, i]
        for j in range(i):
            entry = M[i, j]
            M[i, j] = entry / M[j, j]
            d -= entry * M[i, j]
        if not d > 0:
            return False
        M[i, i] = d
    return True


@compiled
def substitute(M: Array, B: Array) -> None:
    """Solve B (n, m) = (L D L')^-1 B in place with the factors of `_factor` in M, in the memory order of rows."""
    n, m = B.shape
    for i in range(n):
        for k in range(i):
            factor = M[i, k]
            for j in range(m):
                B[i, j] -= factor * B[k, j]
    for i in range(n - 1, -1, -1):
        inverse = 1.0 / M[i, i]
        for j in range(m):
            B[i, j] *= inverse
        for k in range(i + 1, n):
            factor = M[k, i]
            for j in range(m):
                B[i, j] -= factor * B[k, j]


@compiled
def assemble_step(h: float, free: Whole, single: Whole, q: Array, v_next: Array, by: Array, out: Array) -> None:
    """Compute `out` (nx, nx + nu + np) from dv' / d(tangent of q, v, u, parameters), `by` (nv, 2 nv + nu + np)."""
    nq, nv, width = len(q), len(v_next), by.shape[1]
    shift = nq - nv
    out[:] = 0.0
    for i in range(nv):
        row = nq + i
        for b in range(len(single)):
            out[row, single[b, 0]] = by[i, single[b, 1]]
        for b in range(len(free)):
            s, d = free[b, 0], free[b, 1]
            w, x, y, z = q[s], q[s + 1], q[s + 2], q[s + 3]
            f = 2.0 / (w * w + x * x + y * y + z * z)
            b0, b1, b2 = f * by[i, d], f * by[i, d + 1], f * by[i, d + 2]
            out[row, s] = -(b0 * x + b1 * y + b2 * z)
            out[row, s + 1] = b0 * w + b1 * z - b2 * y
            out[row, s + 2] = -b0 * z + b1 * w + b2 * x
            out[row, s + 3] = b0 * y - b1 * x + b2 * w
            for a in range(3):
                out[row, s + 4 + a] = by[i, d + 3 + a]
        for j in range(nv, width):
            out[row, shift + j] = by[i, j]
    total = out.shape[1]
    for b in range(len(single)):
        s, row = single[b, 0], nq + single[b, 1]
        for j in range(total):
            out[s, j] = h * out[row, j]
        out[s, s] += 1.0
    for b in range(len(free)):
        s, d = free[b, 0], free[b, 1]
        w, x, y, z = q[s], q[s + 1], q[s + 2], q[s + 3]
        for j in range(total):
            r0, r1, r2 = out[nq + d, j], out[nq + d + 1, j], out[nq + d + 2, j]
            out[s, j] = -0.5 * h * (x * r0 + y * r1 + z * r2)
            out[s + 1, j] = 0.5 * h * (w * r0 + z * r1 - y * r2)
            out[s + 2, j] = 0.5 * h * (-z * r0 + w * r1 + x * r2)
            out[s + 3, j] = 0.5 * h * (y * r0 - x * r1 + w * r2)
            for a in range(3):
                out[s + 4 + a, j] = h * out[nq + d + 3 + a, j]
        for a in range(7):
            out[s + a, s + a] += 1.0
        w0, w1, w2 = 0.5 * h * v_next[d], 0.5 * h * v_next[d + 1], 0.5 * h * v_next[d + 2]
        out[s, s + 1] -= w0
        out[s, s + 2] -= w1
        out[s, s + 3] -= w2
        out[s + 1, s] += w0
        out[s + 1, s + 2] -= w2
        out[s + 1, s + 3] += w1
        out[s + 2, s] += w1
        out[s + 2, s + 1] += w2
        out[s + 2, s + 3] -= w0
        out[s + 3, s] += w2
        out[s + 3, s + 1] -= w1
        out[s + 3, s + 2] += w0


@compiled
def assemble_steps(h: float, free: Whole, single: Whole, q: Array, v_next: Array, by: Array, out: Array) -> None:
    """Compute `assemble_step` for N steps."""
    for k in range(len(q)):
        assemble_step(h, free, single, q[k], v_next[k], by[k], out[k])


@compiled
def differentiate_acceleration(
    t: Tree,
    q: Array,
    v: Array,
    force: Array,
    armature: Array,
    by_q: Array,
    by_v: Array,
    inverse: Array,
    acceleration: Array,
) -> None:
    """Compute accelerations (N, nv) under generalized forces (N, nv), and derivatives (N, nv, nv each), at N states.

    The derivatives are with respect to the tangent of q, v, and the forces. The last is the inverse of the mass matrix
    plus `armature` (nv,). All results are NaN where this matrix is not positive definite.
    """
    n, L = v.shape[1], len(t.kind)
    poses, S, tau = np.empty((1, L, 3, 4)), np.empty((1, n, 6)), np.empty((1, n))
    mass, slope, tau_q, tau_v = np.empty((1, n, n)), np.empty((1, n, n)), np.empty((1, n, n)), np.empty((1, n, n))
    a = np.empty((1, n))
    for k in range(len(q)):
        a[0] = 0.0
        differentiate_tree(t, q[k : k + 1], v[k : k + 1], a, False, poses, S, mass, slope, tau, tau_q, tau_v)
        for i in range(n):
            mass[0, i, i] += armature[i]
        inverse[k] = 0.0
        for i in range(n):
            inverse[k, i, i] = 1.0
        if not _factor(mass[0]):
            inverse[k] = np.nan
        substitute(mass[0], inverse[k])
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += inverse[k, i, j] * (force[k, j] - tau[0, j])
            a[0, i] = acceleration[k, i] = total
        differentiate_tree(t, q[k : k + 1], v[k : k + 1], a, True, poses, S, mass, slope, tau, tau_q, tau_v)
        for i in range(n):
            for c in range(n):
                by_q[k, i, c], by_v[k, i, c] = 0.0, 0.0
            for j in range(n):
                entry = inverse[k, i, j]
                for c in range(n):
                    by_q[k, i, c] -= entry * tau_q[0, j, c]
                    by_v[k, i, c] -= entry * tau_v[0, j, c]


@compiled
def roll(
    tree: Tree,
    forces: Forces,
    bounds: SaturationBounds,
    old: Array,
    gaps: Array,
    wanted: Array,
    gains: Array,
    xs: Array,
    us: Array,
) -> bool:
    """Fill us (N, nu) = wanted + gains (N, nu, nx) (xs - old), within bounds, and xs (N+1, nx) from xs[0] on.

    The gap (N, nx) of each step is subtracted from its next state. False if a mass matrix is not positive definite.
    """
    count, nu = us.shape
    nx = xs.shape[1]
    n, J, h = nx // 2, len(tree.parent), forces.time_step
    parent, first = tree.parent, tree.first
    poses, S, inertias = np.empty((len(tree.kind), 3, 4)), np.empty((n, 6)), np.empty((J, 10))
    V, A, F, momentum = np.empty((J + 1, 6)), np.empty((J + 1, 6)), np.empty((J, 6)), np.empty((1, 6))
    M, a = np.zeros((n, n)), np.empty((n, 1))
    V[J], A[J] = 0.0, 0.0  # of the world
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
        _forward_kinematics(tree, x[:n], poses, S, inertias)
        for j in range(J):
            s, up = first[j], parent[j] if parent[j] >= 0 else J
            speed = x[n + s]
            for i in range(6):
                V[j, i], A[j, i], F[j, i], momentum[0, i] = V[up, i], A[up, i], 0.0, 0.0
            _add_cross(V, up, S, s, momentum, 0)
            for i in range(6):
                V[j, i] += S[s, i] * speed
                A[j, i] += momentum[0, i] * speed
            _times(inertias, j, A, j, F, j)
            _times(inertias, j, V, j, momentum, 0)
            _add_cross_force(V, j, momentum, 0, F, j)
        for j in range(J - 1, -1, -1):
            s, up = first[j], parent[j]
            total = forces.rest[s] - forces.damping[s] * x[n + s] - forces.stiffness[s] * x[s] - _dot(S, s, F, j)
            for i in range(nu):
                total += forces.actuation[s, i] * min(max(us[k, i], -forces.limit[i]), forces.limit[i])
            a[s, 0] = total
            _times(inertias, j, S, s, momentum, 0)
            M[s, s] = _dot(momentum, 0, S, s) + forces.armature[s]
            above = up
            while above >= 0:
                c = first[above]
                M[s, c] = M[c, s] = _dot(momentum, 0, S, c)
                above = parent[above]
            if up >= 0:
                for i in range(10):
                    inertias[up, i] += inertias[j, i]
                for i in range(6):
                    F[up, i] += F[j, i]
        if not _factor(M):
            return False
        substitute(M, a)
        for s in range(n):
            v = x[n + s] + h * a[s, 0]
            xs[k + 1, n + s] = v - gaps[k, n + s]
            xs[k + 1, s] = x[s] + h * v - gaps[k, s]
        for r in range(n):
            for c in range(n):
                M[r, c] = 0.0
    return True

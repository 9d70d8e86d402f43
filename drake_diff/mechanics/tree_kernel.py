"""A tree's places, motions, inertia and inverse dynamics with their derivatives, state by state: compiled.

The formulas are those of `mechanics.tree`, which says what they are: spatial vectors are [angular; linear] in world
about its origin. Each loop goes along a joint's own ancestors only. Kept apart as Numba compiles what is in here.
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

    A free body is two joints: three slides, and after them three turns about world axes.
    """

    link_parent: Whole  # (L,) -1 for the world
    kind: Whole  # (L,)
    joint: Whole  # (L,) that carries it, -1 where none does
    q_start: Whole  # (L,)
    v_start: Whole  # (L,)
    axis: Array  # (L, 3) in the joint's frames
    frame: Array  # (L, 3, 4) of the joint on the parent
    back: Array  # (L, 3, 4) of the link in the joint's other frame
    mass: Array  # (L,)
    center: Array  # (L, 3) of mass, in the link
    inertia: Array  # (L, 3, 3) about it
    parent: Whole  # (J,) -1 for the world; every parent before its children
    first: Whole  # (J,) in v
    size: Whole  # (J,) degrees of freedom
    gravity: Array  # (3,)


@compiled
def _compose(R: Array, p: Array, X: Array, R_out: Array, p_out: Array) -> None:
    """(R_out, p_out) = (R, p) X."""
    for i in range(3):
        total = p[i]
        for j in range(3):
            total += R[i, j] * X[j, 3]
            R_out[i, j] = R[i, 0] * X[0, j] + R[i, 1] * X[1, j] + R[i, 2] * X[2, j]
        p_out[i] = total


@compiled
def _turned(R: Array, axis: Array, angle: float, out: Array) -> None:
    """out = R exp(angle axis^)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z, d = axis[0], axis[1], axis[2], 1.0 - c
    for i in range(3):
        a, b, e = R[i, 0], R[i, 1], R[i, 2]
        along = d * (a * x + b * y + e * z)
        out[i, 0] = c * a + along * x + s * (b * z - e * y)
        out[i, 1] = c * b + along * y + s * (e * x - a * z)
        out[i, 2] = c * e + along * z + s * (a * y - b * x)


@compiled
def _orientation(q: Array, at: int, out: Array) -> None:
    """Of a quaternion (w, x, y, z) of any norm that begins at q[at]."""
    w, x, y, z = q[at], q[at + 1], q[at + 2], q[at + 3]
    d = 2.0 / (w * w + x * x + y * y + z * z)
    out[0, 0], out[0, 1], out[0, 2] = 1 - d * (y * y + z * z), d * (x * y - w * z), d * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = d * (x * y + w * z), 1 - d * (x * x + z * z), d * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = d * (x * z - w * y), d * (y * z + w * x), 1 - d * (x * x + y * y)


@compiled
def _axis_through(S: Array, i: int, axis: Array, p: Array) -> None:
    """S[i] is the turn about an axis through p."""
    S[i, 0], S[i, 1], S[i, 2] = axis[0], axis[1], axis[2]
    S[i, 3] = p[1] * axis[2] - p[2] * axis[1]
    S[i, 4] = p[2] * axis[0] - p[0] * axis[2]
    S[i, 5] = p[0] * axis[1] - p[1] * axis[0]


@compiled
def _through_joint(
    kind: int, local: Array, q: Array, at: int, R: Array, p: Array, R_child: Array, p_child: Array, S: Array, v: int
) -> None:
    """The frame after a joint with the axis `local` (3,), (R, p) being that before it, and its motions from S[v] on."""
    for a in range(3):
        p_child[a] = p[a]
        for b in range(3):
            R_child[a, b] = R[a, b]
    if kind == FREE:
        axis = np.zeros(3)
        _orientation(q, at, R_child)
        for a in range(3):
            p_child[a] = q[at + 4 + a]
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
            _turned(R, local, q[at], R_child)
            _axis_through(S, v, axis, p)
        else:
            for a in range(3):
                S[v, 3 + a] = axis[a]
                p_child[a] = p[a] + q[at] * axis[a]


@compiled
def _add_inertia(m: float, center: Array, inertia: Array, X: Array, own: Array) -> None:
    """Add a link's inertia where its pose is X (3, 4) to own (10,).

    That is mass, moment of mass (3) and xx yy zz xy xz yz about the world's origin.
    """
    c, squared = np.empty(3), 0.0
    for a in range(3):
        c[a] = X[a, 0] * center[0] + X[a, 1] * center[1] + X[a, 2] * center[2] + X[a, 3]
        squared += c[a] * c[a]
    own[0] += m
    for a in range(3):
        own[1 + a] += m * c[a]
        own[4 + a] += m * (squared - c[a] * c[a]) + _rotated(X, inertia, a, a)
    own[7] += _rotated(X, inertia, 0, 1) - m * c[0] * c[1]
    own[8] += _rotated(X, inertia, 0, 2) - m * c[0] * c[2]
    own[9] += _rotated(X, inertia, 1, 2) - m * c[1] * c[2]


@compiled
def _place(t: Tree, q: Array, poses: Array, S: Array, own: Array) -> None:
    """The links' poses (L, 3, 4), the motions S (nv, 6), and the inertia (J, 10) that each joint carries itself."""
    R, p, R_child, p_child = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    R_world, p_world = np.eye(3), np.zeros(3)
    S[:], own[:] = 0.0, 0.0
    for i in range(len(t.kind)):
        up, j = t.link_parent[i], t.joint[i]
        if up < 0:
            _compose(R_world, p_world, t.frame[i], R, p)
        else:
            _compose(poses[up, :, :3], poses[up, :, 3], t.frame[i], R, p)
        at, v = t.q_start[i], t.v_start[i]
        _through_joint(t.kind[i], t.axis[i], q, at, R, p, R_child, p_child, S, v)
        _compose(R_child, p_child, t.back[i], poses[i, :, :3], poses[i, :, 3])
        if j >= 0:
            _add_inertia(t.mass[i], t.center[i], t.inertia[i], poses[i], own[j])


@compiled
def _rotated(X: Array, inertia: Array, a: int, b: int) -> float:
    """Entry (a, b) of R inertia R'."""
    total = 0.0
    for i in range(3):
        total += X[a, i] * (inertia[i, 0] * X[b, 0] + inertia[i, 1] * X[b, 1] + inertia[i, 2] * X[b, 2])
    return total


@compiled
def _times(I: Array, s: Array, out: Array) -> None:  # noqa: E741
    """out = I s: the momentum [about the origin; linear] of an inertia (10,) that moves at s (6,)."""
    m, x, y, z = I[0], I[1], I[2], I[3]
    out[0] = I[4] * s[0] + I[7] * s[1] + I[8] * s[2] + y * s[5] - z * s[4]
    out[1] = I[7] * s[0] + I[5] * s[1] + I[9] * s[2] + z * s[3] - x * s[5]
    out[2] = I[8] * s[0] + I[9] * s[1] + I[6] * s[2] + x * s[4] - y * s[3]
    out[3] = m * s[3] - (y * s[2] - z * s[1])
    out[4] = m * s[4] - (z * s[0] - x * s[2])
    out[5] = m * s[5] - (x * s[1] - y * s[0])


@compiled
def _cross(m: Array, s: Array, out: Array) -> None:
    """out = m x s of motions (6,)."""
    out[0] = m[1] * s[2] - m[2] * s[1]
    out[1] = m[2] * s[0] - m[0] * s[2]
    out[2] = m[0] * s[1] - m[1] * s[0]
    out[3] = m[1] * s[5] - m[2] * s[4] + m[4] * s[2] - m[5] * s[1]
    out[4] = m[2] * s[3] - m[0] * s[5] + m[5] * s[0] - m[3] * s[2]
    out[5] = m[0] * s[4] - m[1] * s[3] + m[3] * s[1] - m[4] * s[0]


@compiled
def _add_cross_force(m: Array, f: Array, out: Array) -> None:
    """out += m x* f of a motion and a force (6,)."""
    out[0] += m[1] * f[2] - m[2] * f[1] + m[4] * f[5] - m[5] * f[4]
    out[1] += m[2] * f[0] - m[0] * f[2] + m[5] * f[3] - m[3] * f[5]
    out[2] += m[0] * f[1] - m[1] * f[0] + m[3] * f[4] - m[4] * f[3]
    out[3] += m[1] * f[5] - m[2] * f[4]
    out[4] += m[2] * f[3] - m[0] * f[5]
    out[5] += m[0] * f[4] - m[1] * f[3]


@compiled
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]


@compiled
def _force_rates(I: Array, V: Array, B: Array) -> None:  # noqa: E741
    """B (6, 6) = (V x*) I - I (V x) + (I V) x* of an inertia (10,) that moves at V (6,), column by column."""
    e, momentum, turned, out = np.zeros(6), np.empty(6), np.empty(6), np.empty(6)
    own = np.empty(6)
    _times(I, V, own)
    for k in range(6):
        e[k] = 1.0
        _cross(V, e, turned)
        _times(I, turned, out)
        for i in range(6):
            out[i] = -out[i]
        _times(I, e, momentum)
        _add_cross_force(V, momentum, out)
        _add_cross_force(e, own, out)
        B[:, k] = out
        e[k] = 0.0


@compiled
def differentiate_tree(
    t: Tree,
    q: Array,
    v: Array,
    a: Array,
    poses: Array,
    motions: Array,
    mass: Array,
    slope: Array,
    tau: Array,
    by_q: Array,
    by_v: Array,
) -> None:
    """At N states: the links' poses (N, L, 3, 4), S (N, nv, 6), M and d M_kk / d q_j (N, nv, nv) by k and j.

    And the inverse dynamics (N, nv) at the accelerations a (N, nv), with its derivatives by small motion and by v.
    """
    N, nv, J = len(q), v.shape[1], len(t.parent)
    own, carried = np.empty((J, 10)), np.empty((J, 10))
    V, A, F, B = np.empty((J, 6)), np.empty((J, 6)), np.empty((J, 6)), np.empty((J, 6, 6))
    before, P, Q, T = np.empty((nv, 6)), np.empty((nv, 6)), np.empty((nv, 6)), np.empty((nv, 6))
    rest, still, one, other = np.zeros(6), np.zeros(6), np.empty(6), np.empty(6)
    S_I, S_B, of_q, of_v = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    for i in range(3):
        rest[3 + i] = -t.gravity[i]
    for n in range(N):
        S = motions[n]
        _place(t, q[n], poses[n], S, own)
        for j in range(J):
            up = t.parent[j]
            V_P = V[up] if up >= 0 else still
            A_P = A[up] if up >= 0 else rest
            for i in range(6):
                V[j, i], A[j, i] = V_P[i], A_P[i]
            for s in range(t.first[j], t.first[j] + t.size[j]):
                _cross(V_P, S[s], before[s])
                for i in range(6):
                    V[j, i] += S[s, i] * v[n, s]
                    A[j, i] += S[s, i] * a[n, s] + before[s, i] * v[n, s]
            for i in range(10):
                carried[j, i] = own[j, i]
            _times(own[j], A[j], F[j])
            _times(own[j], V[j], one)
            _add_cross_force(V[j], one, F[j])
            _force_rates(own[j], V[j], B[j])
        for j in range(J - 1, -1, -1):
            up = t.parent[j]
            if up >= 0:
                for i in range(10):
                    carried[up, i] += carried[j, i]
                for i in range(6):
                    F[up, i] += F[j, i]
                    for k in range(6):
                        B[up, i, k] += B[j, i, k]
        for j in range(J):
            for s in range(t.first[j], t.first[j] + t.size[j]):
                _cross(V[j], S[s], P[s])
                _cross(A[j], S[s], Q[s])
                _cross(V[j], P[s], one)
                for i in range(6):
                    Q[s, i] += one[i]
                    T[s, i] = before[s, i] + P[s, i]
        mass[n], slope[n], by_q[n], by_v[n] = 0.0, 0.0, 0.0, 0.0
        for j in range(J):
            I_c, B_c = carried[j], B[j]
            for s in range(t.first[j], t.first[j] + t.size[j]):
                tau[n, s] = _dot(S[s], F[j])
                _times(I_c, S[s], S_I)
                _times(I_c, Q[s], of_q)
                _times(I_c, T[s], of_v)
                _add_cross_force(S[s], F[j], of_q)
                for i in range(6):
                    total = 0.0
                    for k in range(6):
                        of_q[i] += B_c[i, k] * P[s, k]
                        of_v[i] += B_c[i, k] * S[s, k]
                        total += B_c[k, i] * S[s, k]
                    S_B[i] = total
                turns = S[s, 0] != 0.0 or S[s, 1] != 0.0 or S[s, 2] != 0.0
                turns = turns or t.size[j] == 1
                up = j
                while up >= 0:
                    for k in range(t.first[up], t.first[up] + t.size[up]):
                        by_q[n, k, s] += _dot(of_q, S[k])
                        by_v[n, k, s] += _dot(of_v, S[k])
                        m = _dot(S_I, S[k])
                        mass[n, s, k] = m
                        mass[n, k, s] = m
                        if up != j:
                            by_q[n, s, k] += _dot(S_B, P[k]) + _dot(S_I, Q[k])
                            by_v[n, s, k] += _dot(S_B, S[k]) + _dot(S_I, T[k])
                        if turns:
                            _cross(S[s], S[k], one)
                            _times(I_c, S[k], other)
                            slope[n, k, s] = -2.0 * _dot(one, other)
                    up = t.parent[up]

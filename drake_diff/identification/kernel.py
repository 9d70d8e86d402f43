"""The equations of motion of a tree with inputs, springs, dampers and friction, and their derivatives: compiled.

    M(q) a = B u - C(q, v) v + gravity - springs - damping v - friction

Inverse dynamics and its derivatives are those of `mechanics.tree_kernel`; here are the other forces, the derivatives by
the numbers of the tree, and Runge and Kutta's steps with the derivatives of these steps.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.compiled import compiled, inner
from drake_diff.mechanics.tree_kernel import (
    Tree,
    _add_cross,
    _add_cross_force,
    _dot,
    _factor,
    _rotated,
    _times,
    differentiate_tree,
)

Array = NDArray[np.float64]
Whole = NDArray[np.int64]


class System(NamedTuple):
    """A tree of n joint coordinates, of which some may follow others, and what acts on it."""

    tree: Tree  # coordinates after the first n are virtual: they do not move
    links: Array  # (L, 10) mass, moment of mass and inertia about the origin of each link's frame
    of_q: Whole  # q of the joints is ratio * q[of_q] + shift
    ratio: Array
    shift: Array
    spread: Array  # (n, nv) velocities of the joints by the independent ones
    single: Whole  # (S, 2) of the independent coordinates: where joints of one degree of freedom are in q and in v
    free: Whole  # (F, 2) where free bodies begin
    position: Whole  # (n,) of a spring, in q of the joints
    reflected: Array  # (n,)
    damping: Array  # (n,)
    stiffness: Array  # (n,)
    rest: Array  # (n,)
    coulomb: Array  # (n,)
    held_inertia: Array  # (n,) of friction that gives way; 0 of friction that holds
    held_damping: Array  # (n,)
    slip: float  # over which friction turns where it is smooth
    actuation: Array  # (n, nu) times the strengths of the inputs
    dry: NDArray[np.bool_]  # (nv,) which coordinates have friction that holds
    gives: bool  # whether it gives way
    stages: Array  # (m, m) of the method of Runge and Kutta
    weights: Array  # (m,)


class Changes(NamedTuple):
    """How the numbers of a system change with P parameters."""

    parameters: int  # P
    link: Whole  # (K,) changes of the ten numbers of a link, by one parameter each
    parameter: Whole  # (K,)
    ten: Array  # (K, 10)
    gravity: Array  # (P, 3)
    shift: Array  # (virtual coordinates, P)
    reflected: Array  # (n, P) and so on
    damping: Array
    stiffness: Array
    rest: Array
    coulomb: Array
    held_inertia: Array
    held_damping: Array
    strength: Array  # (nu, P)
    actuation: Array  # (n, nu) at the strength 1


class Grip(NamedTuple):
    """What friction does."""

    smooth: bool  # it turns over a small speed
    turn: Array  # (nv,) 1 or -1 of coordinates that slide
    held: Array  # (nv,) 1 of those that are held


class Workspace(NamedTuple):
    """Arrays that are filled at each state."""

    q: Array  # (1, ...) of all coordinates of the tree
    v: Array
    a: Array
    zero: Array
    poses: Array
    S: Array
    mass: Array
    slope: Array
    tau: Array
    by_q: Array
    by_v: Array
    change: Array  # (n, P)
    M: Array  # (nv, nv)
    right: Array  # (nv, 2 nv + P + 1)
    friction: Array  # (n,) 1 or -1 of joints that slide
    held: Array  # (n,) 1 of joints that are held


@inner
def workspace(s: System, count: int) -> Workspace:
    """Of P = count parameters."""
    n, nv = s.spread.shape
    t, e = s.tree, 0
    nq = len(s.of_q)
    for i in range(len(t.first)):
        e += t.size[i]
    return Workspace(
        np.zeros((1, nq + e - n)),
        np.zeros((1, e)),
        np.zeros((1, e)),
        np.zeros((1, e)),
        np.empty((1, len(t.kind), 3, 4)),
        np.empty((1, e, 6)),
        np.empty((1, e, e)),
        np.empty((1, e, e)),
        np.empty((1, e)),
        np.empty((1, e, e)),
        np.empty((1, e, e)),
        np.empty((n, count)),
        np.empty((nv, nv)),
        np.empty((nv, 2 * nv + count + 1)),
        np.empty(n),
        np.empty(n),
    )


@inner
def _substitute(M: Array, b: Array, first: int, last: int) -> None:
    """Columns first to last of b become M^-1 b, of an M that is factored."""
    n = len(M)
    for c in range(first, last):
        for i in range(n):
            for k in range(i):
                b[i, c] -= M[i, k] * b[k, c]
        for i in range(n):
            b[i, c] /= M[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                b[i, c] -= M[k, i] * b[k, c]


@inner
def _in_world(X: Array, ten: Array, m: int, J: Array, out: Array) -> None:
    """out (1, 10) = ten[m] of a link at X (3, 4), about the world's origin; J (3, 3) is worked in."""
    mass, squared, along = ten[m, 0], 0.0, 0.0
    out[0, 0] = mass
    for a in range(3):
        h = X[a, 0] * ten[m, 1] + X[a, 1] * ten[m, 2] + X[a, 2] * ten[m, 3]
        squared += X[a, 3] * X[a, 3]
        along += X[a, 3] * h
        out[0, 1 + a] = h
        J[a, a] = ten[m, 4 + a]
    J[0, 1] = J[1, 0] = ten[m, 7]
    J[0, 2] = J[2, 0] = ten[m, 8]
    J[1, 2] = J[2, 1] = ten[m, 9]
    for i in range(6):
        a, b = (i, i) if i < 3 else ((i - 3) // 2, 1 + (i - 2) // 2)
        total = _rotated(X, J, a, b) - X[a, 3] * out[0, 1 + b] - out[0, 1 + a] * X[b, 3] - mass * X[a, 3] * X[b, 3]
        if a == b:
            total += 2 * along + mass * squared
        out[0, 4 + i] = total
    for a in range(3):
        out[0, 1 + a] += mass * X[a, 3]


@inner
def _by_links(s: System, c: Changes, w: Workspace) -> None:
    """Add to w.change inverse dynamics at w.v and w.a by the ten numbers of links and by gravity."""
    t, S = s.tree, w.S[0]
    J = len(t.parent)
    V, A = np.zeros((J + 1, 6)), np.zeros((J + 1, 6))
    ten, force, momentum, turned = np.empty((1, 10)), np.empty((1, 6)), np.empty((1, 6)), np.empty((3, 3))
    for i in range(3):
        A[J, 3 + i] = -t.gravity[i]
    for j in range(J):
        up = t.parent[j] if t.parent[j] >= 0 else J
        for i in range(6):
            V[j, i], A[j, i] = V[up, i], A[up, i]
        for k in range(t.first[j], t.first[j] + t.size[j]):
            for i in range(6):
                force[0, i] = 0.0
            _add_cross(V, up, S, k, force, 0)
            for i in range(6):
                V[j, i] += S[k, i] * w.v[0, k]
                A[j, i] += S[k, i] * w.a[0, k] + force[0, i] * w.v[0, k]
    for m in range(len(c.link)):
        j = t.joint[c.link[m]]
        _in_world(w.poses[0, c.link[m]], c.ten, m, turned, ten)
        _times(ten, 0, A, j, force, 0)
        _times(ten, 0, V, j, momentum, 0)
        _add_cross_force(V, j, momentum, 0, force, 0)
        _carry(t, S, j, force, w.change, c.parameter[m])
    fall = np.zeros((1, 6))
    for p in range(c.parameters):
        if c.gravity[p, 0] == 0 and c.gravity[p, 1] == 0 and c.gravity[p, 2] == 0:
            continue
        for i in range(3):  # gravity is an acceleration of the world the other way
            fall[0, 3 + i] = -c.gravity[p, i]
        for m in range(len(t.kind)):
            _in_world(w.poses[0, m], s.links, m, turned, ten)
            _times(ten, 0, fall, 0, force, 0)
            _carry(t, S, t.joint[m], force, w.change, p)


@inner
def _carry(t: Tree, S: Array, j: int, force: Array, change: Array, p: int) -> None:
    """Add to change[:, p] what the joints that carry joint j feel of a force (1, 6)."""
    while j >= 0:
        for k in range(t.first[j], t.first[j] + t.size[j]):
            if k < len(change):
                change[k, p] += _dot(S, k, force, 0)
        j = t.parent[j]


@inner
def _reduce(s: System, full: Array, out: Array) -> None:
    """out = E' full E (nv, nv) of the joints that move independently."""
    n, nv = s.spread.shape
    out[:] = 0.0
    for i in range(n):
        for j in range(n):
            for a in range(nv):
                if s.spread[i, a] != 0:
                    for b in range(nv):
                        out[a, b] += s.spread[i, a] * full[i, j] * s.spread[j, b]


@inner
def _mass_and_force(s: System, w: Workspace, x: Array, effort: Array, g: Grip) -> None:
    """w.M (nv, nv) and w.right[:, 0] (nv,) with M a = force; which way joints slide is `turn`, if it is not smooth."""
    n, nv = s.spread.shape
    nq = len(x) - nv
    for i in range(len(s.of_q)):
        w.q[0, i] = s.ratio[i] * x[s.of_q[i]] + s.shift[i]
    for i in range(n):
        w.v[0, i] = w.friction[i] = w.held[i] = 0.0
        for j in range(nv):
            if s.spread[i, j] != 0:
                w.v[0, i] += s.spread[i, j] * x[nq + j]
                w.friction[i] += np.sign(s.spread[i, j]) * g.turn[j]
                w.held[i] = max(w.held[i], g.held[j])
        if g.smooth:
            w.friction[i] = np.tanh(w.v[0, i] / s.slip)
    differentiate_tree(s.tree, w.q, w.v, w.zero, False, w.poses, w.S, w.mass, w.slope, w.tau, w.by_q, w.by_v)
    M, tau = w.mass[0], w.tau[0]
    for i in range(n):
        speed = w.v[0, i]
        force = -tau[i] - s.damping[i] * speed - s.coulomb[i] * w.friction[i]
        for k in range(len(effort)):
            force += s.actuation[i, k] * effort[k]
        M[i, i] += s.reflected[i]
        if s.stiffness[i] != 0:
            force -= s.stiffness[i] * (w.q[0, s.position[i]] - s.rest[i])
        if w.held[i] != 0:
            force -= s.held_damping[i] * speed
            M[i, i] += s.held_inertia[i]
        tau[i] = force
    _reduce(s, M, w.M)
    for j in range(nv):
        w.right[j, 0] = 0.0
        for i in range(n):
            w.right[j, 0] += s.spread[i, j] * tau[i]


@inner
def _accelerate(s: System, w: Workspace, x: Array, effort: Array, g: Grip, a: Array) -> None:
    """a (nv,), NaN where M is not positive definite, which is left factored; joints that are held still have 0."""
    nv = len(a)
    _mass_and_force(s, w, x, effort, g)
    if not g.smooth and not s.gives:
        for i in range(nv):
            if g.held[i] != 0:
                for j in range(nv):
                    w.M[i, j] = w.M[j, i] = 0.0
                w.M[i, i], w.right[i, 0] = 1.0, 0.0
    good = _factor(w.M)
    if good:
        _substitute(w.M, w.right, 0, 1)
    for i in range(nv):
        a[i] = w.right[i, 0] if good else np.nan


@inner
def _differentiate(
    s: System,
    c: Changes,
    w: Workspace,
    x: Array,
    effort: Array,
    g: Grip,
    a: Array,
    by: Array,
) -> None:
    """As `_accelerate`, and by (nv, 2 nv + P): by small motion, by v and by the parameters, of efforts (nu,)."""
    n, nv = s.spread.shape
    _accelerate(s, w, x, effort, g, a)
    for i in range(n):
        w.a[0, i] = 0.0
        for j in range(nv):
            w.a[0, i] += s.spread[i, j] * a[j]
    differentiate_tree(s.tree, w.q, w.v, w.a, True, w.poses, w.S, w.mass, w.slope, w.tau, w.by_q, w.by_v)
    by_q, by_v, change = w.by_q[0], w.by_v[0], w.change
    change[:] = 0.0
    _by_links(s, c, w)
    for i in range(n):
        speed, stretched = w.v[0, i], w.q[0, s.position[i]] - s.rest[i]
        by_q[i, i] += s.stiffness[i]
        by_v[i, i] += s.damping[i] + s.held_damping[i] * w.held[i]
        if g.smooth and s.coulomb[i] != 0:
            by_v[i, i] += s.coulomb[i] / s.slip * (1 - w.friction[i] ** 2)
        for p in range(c.parameters):
            total = c.reflected[i, p] * w.a[0, i] + c.damping[i, p] * speed + c.stiffness[i, p] * stretched
            total += c.coulomb[i, p] * w.friction[i] - c.rest[i, p] * s.stiffness[i]
            total += w.held[i] * (c.held_inertia[i, p] * w.a[0, i] + c.held_damping[i, p] * speed)
            for k in range(len(effort)):
                if c.strength[k, p] != 0:
                    total -= c.actuation[i, k] * c.strength[k, p] * effort[k]
            for k in range(len(c.shift)):
                if c.shift[k, p] != 0:
                    total += by_q[i, n + k] * c.shift[k, p]
            change[i, p] += total
    right = w.right
    for i in range(nv):
        for k in range(2 * nv + c.parameters):
            total = 0.0
            for j in range(n):
                if s.spread[j, i] == 0:
                    continue
                entry = change[j, k - 2 * nv] if k >= 2 * nv else 0.0
                if k < 2 * nv:
                    for m in range(n):
                        entry += (by_q[j, m] if k < nv else by_v[j, m]) * s.spread[m, k % nv]
                total += s.spread[j, i] * entry
            right[i, k] = 0.0 if g.held[i] != 0 and not g.smooth and not s.gives else -total
    _substitute(w.M, right, 0, 2 * nv + c.parameters)
    for i in range(nv):
        for k in range(2 * nv + c.parameters):
            by[i, k] = right[i, k]


@inner
def _rate(s: System, q: Array, v: Array, out: Array) -> None:
    """out begins with dq/dt, which is linear in q and linear in v."""
    for k in range(len(s.single)):
        out[s.single[k, 0]] = v[s.single[k, 1]]
    for k in range(len(s.free)):
        start, i = s.free[k, 0], s.free[k, 1]
        w, x, y, z = q[start], q[start + 1], q[start + 2], q[start + 3]
        a, b, c = v[i], v[i + 1], v[i + 2]
        out[start] = -0.5 * (a * x + b * y + c * z)
        out[start + 1] = 0.5 * (a * w + b * z - c * y)
        out[start + 2] = 0.5 * (b * w + c * x - a * z)
        out[start + 3] = 0.5 * (c * w + a * y - b * x)
        for m in range(3):
            out[start + 4 + m] = v[i + 3 + m]


@inner
def _motion(s: System, q: Array, d: Array, out: Array) -> None:
    """out (nv,) the small motion that a change d (nq,) of q is."""
    for k in range(len(s.single)):
        out[s.single[k, 1]] = d[s.single[k, 0]]
    for k in range(len(s.free)):
        start, i = s.free[k, 0], s.free[k, 1]
        w, x, y, z = q[start], q[start + 1], q[start + 2], q[start + 3]
        scale = 2.0 / (w * w + x * x + y * y + z * z)
        out[i] = scale * (w * d[start + 1] - x * d[start] - z * d[start + 2] + y * d[start + 3])
        out[i + 1] = scale * (w * d[start + 2] - y * d[start] + z * d[start + 1] - x * d[start + 3])
        out[i + 2] = scale * (w * d[start + 3] - z * d[start] - y * d[start + 1] + x * d[start + 2])
        for m in range(3):
            out[i + 3 + m] = d[start + 4 + m]


@inner
def _step(
    s: System,
    c: Changes,
    w: Workspace,
    x: Array,
    h: float,
    effort: Array,
    g: Grip,
    X: Array,
    out: Array,
) -> None:
    """out (nx,) after a step of h from x.

    With derivatives, X (nx, nx + P), the derivative of x, becomes that of out.
    """
    nv, nx, count = s.spread.shape[1], len(x), len(s.weights)
    nq = nx - nv
    rates, y, a = np.empty((count, nx)), np.empty(nx), np.empty(nv)
    columns = X.shape[1]
    moved, changes = np.empty((nx, columns)), np.empty((count, nx, columns))
    by, d, motion, other = np.empty((nv, 2 * nv + c.parameters)), np.empty(nx), np.empty(nv), np.empty(nx)
    for m in range(count):
        for i in range(nx):
            total = 0.0
            for r in range(m):
                total += s.stages[m, r] * rates[r, i]
            y[i] = x[i] + h * total
        if len(X):
            _differentiate(s, c, w, y, effort, g, a, by)
        else:
            _accelerate(s, w, y, effort, g, a)
        _rate(s, y[:nq], y[nq:], rates[m])
        for i in range(nv):
            rates[m, nq + i] = a[i]
        if not len(X):
            continue
        for i in range(nx):
            for k in range(columns):
                total = 0.0
                for r in range(m):
                    total += s.stages[m, r] * changes[r, i, k]
                moved[i, k] = X[i, k] + h * total
        for k in range(columns):
            for i in range(nx):
                d[i] = moved[i, k]
            _rate(s, y[:nq], d[nq:], other)
            for i in range(nq):
                changes[m, i, k] = other[i]
            if len(s.free):
                _rate(s, d[:nq], y[nq:], other)
                for r in range(len(s.free)):
                    for i in range(s.free[r, 0], s.free[r, 0] + 4):
                        changes[m, i, k] += other[i]
            _motion(s, y[:nq], d[:nq], motion)
            for i in range(nv):
                total = by[i, 2 * nv + k - nx] if k >= nx else 0.0
                for j in range(nv):
                    total += by[i, j] * motion[j] + by[i, nv + j] * d[nq + j]
                changes[m, nq + i, k] = total
    for i in range(nx):
        total = 0.0
        for m in range(count):
            total += s.weights[m] * rates[m, i]
        out[i] = x[i] + h * total
        if len(X):
            for k in range(columns):
                total = 0.0
                for m in range(count):
                    total += s.weights[m] * changes[m, i, k]
                X[i, k] += h * total


@compiled
def inverse_dynamics(s: System, c: Changes, q: Array, v: Array, a: Array, tau: Array, mass: Array, by: Array) -> None:
    """Fill tau (N, n) of the links alone, mass (N, n, n) and by (N, n, 2 n + P) at q, v and a of the joints."""
    w, n = workspace(s, c.parameters), len(s.spread)
    for k in range(len(q)):
        for i in range(q.shape[1]):
            w.q[0, i] = q[k, i]
        for i in range(n):
            w.v[0, i], w.a[0, i] = v[k, i], a[k, i]
        differentiate_tree(s.tree, w.q, w.v, w.a, True, w.poses, w.S, w.mass, w.slope, w.tau, w.by_q, w.by_v)
        w.change[:] = 0.0
        _by_links(s, c, w)
        for i in range(n):
            tau[k, i] = w.tau[0, i]
            for j in range(n):
                mass[k, i, j] = w.mass[0, i, j]
                by[k, i, j], by[k, i, n + j] = w.by_q[0, i, j], w.by_v[0, i, j]
            for p in range(c.parameters):
                by[k, i, 2 * n + p] = w.change[i, p]
                for r in range(len(c.shift)):
                    by[k, i, 2 * n + p] += w.by_q[0, i, n + r] * c.shift[r, p]

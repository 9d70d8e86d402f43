"""Compiled kernels for the effects of contacts, joint limits and couplers on a step's Jacobian, state by state.

`jacobian` documents the equation, and `laws` and `joint_impulses` document the impulses.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.compiled import compiled
from drake_diff.derivatives.contact.laws import SAME_MATERIAL, SAME_STATE, SAP, change_law, solve_law
from drake_diff.mechanics.tree_kernel import _factor, assemble_step, substitute

Array = NDArray[np.float64]
Whole = NDArray[np.int64]
Flags = NDArray[np.bool_]


class Touching(NamedTuple):
    """M contacts; the contacts of state k are those from first[k] to first[k + 1]. See `active_contacts.Touches`."""

    first: Whole  # (N + 1,)
    pair: Whole  # (M,)
    point: Array  # (M, 3)
    normal: Array  # (M, 3)
    phi: Array  # (M,)
    change: Array  # (M, 7, 6)


class Pairs(NamedTuple):
    """P pairs. See `active_contacts.AllPairs` and `laws.Material`."""

    sides: Whole  # (P, 2) body indices
    by_body: Array  # (bodies, nv) 1 where a degree of freedom moves the body
    friction: Array  # (P,)
    stiffness: Array  # (P,)
    time: Array  # (P,)
    dissipation: Array  # (P,)
    other_part: Array  # (P,)
    changes: Array  # (5, P, np) derivatives of these five with respect to parameters


class Spheres(NamedTuple):
    """The first K pairs, each of a sphere and another shape. See `active_contacts.ContactPairs`."""

    center: Array  # (K, 3)
    radius: Array  # (K,)
    rotation: Array  # (K, 3, 3)
    position: Array  # (K, 3)
    lower: Array  # (K, 3)
    upper: Array  # (K, 3)
    rounding: Array  # (K,)


class Plant(NamedTuple):
    """The data of a model that does not change from step to step."""

    time_step: float
    law: int
    near_rigid: float
    constants: tuple[float, float, float]  # SIGMA, SOFT_NORM and STICTION_TOLERANCE
    joint_constants: tuple[float, float, float]  # NEAR_RIGID, LIMIT_STIFFNESS and LIMIT_WINDOW
    moves: Array  # (nv, nv) entry j, k: whether j moves the axis of k
    armature: Array  # (nv,)
    controlled: Array  # (nv,) the contribution of controllers to the armature
    stiffness: Array  # (nv,) of springs
    damping: Array  # (nv,)
    actuation: Array  # (nv, nu)
    limits: Array  # (2, nv)
    couplers: Array  # (K, nv)
    offsets: Array  # (K,)
    free: Whole  # (bodies, 2) first indices of free bodies in q and v
    single: Whole  # (joints, 2) indices of the other joints in q and v


@compiled
def _center_in(
    X: Array, center: Array, Y: Array, rotation: Array, position: Array, in_world: Array, local: Array
) -> None:
    """Compute a sphere's centre in world and in the other shape's frame (`local`), for bodies at X and Y (3, 4)."""
    d, in_body = np.empty(3), np.empty(3)
    for a in range(3):
        in_world[a] = X[a, 0] * center[0] + X[a, 1] * center[1] + X[a, 2] * center[2] + X[a, 3]
        d[a] = in_world[a] - Y[a, 3]
    for a in range(3):
        in_body[a] = Y[0, a] * d[0] + Y[1, a] * d[1] + Y[2, a] * d[2] - position[a]
    for a in range(3):
        local[a] = rotation[0, a] * in_body[0] + rotation[1, a] * in_body[1] + rotation[2, a] * in_body[2]


@compiled
def overlapping(s: Spheres, sides: Whole, poses: Array, first: Whole, pair: Whole) -> int:
    """Write the pairs that overlap at `poses` (N, bodies, 3, 4) to `pair`, state k from first[k]; return the count."""
    count, R, p, d = 0, s.rotation, s.position, s.center
    for k in range(len(poses)):
        first[k] = count
        for i in range(len(s.radius)):
            X, Y = sides[i, 0], sides[i, 1]  # as in _center_in, but without views, which are slow
            x = poses[k, X, 0, 0] * d[i, 0] + poses[k, X, 0, 1] * d[i, 1] + poses[k, X, 0, 2] * d[i, 2]
            y = poses[k, X, 1, 0] * d[i, 0] + poses[k, X, 1, 1] * d[i, 1] + poses[k, X, 1, 2] * d[i, 2]
            z = poses[k, X, 2, 0] * d[i, 0] + poses[k, X, 2, 1] * d[i, 1] + poses[k, X, 2, 2] * d[i, 2]
            x += poses[k, X, 0, 3] - poses[k, Y, 0, 3]
            y += poses[k, X, 1, 3] - poses[k, Y, 1, 3]
            z += poses[k, X, 2, 3] - poses[k, Y, 2, 3]
            e = poses[k, Y, 0, 0] * x + poses[k, Y, 1, 0] * y + poses[k, Y, 2, 0] * z - p[i, 0]
            f = poses[k, Y, 0, 1] * x + poses[k, Y, 1, 1] * y + poses[k, Y, 2, 1] * z - p[i, 1]
            g = poses[k, Y, 0, 2] * x + poses[k, Y, 1, 2] * y + poses[k, Y, 2, 2] * z - p[i, 2]
            squared = 0.0
            for a in range(3):
                local = R[i, 0, a] * e + R[i, 1, a] * f + R[i, 2, a] * g
                outside = local - min(max(local, s.lower[i, a]), s.upper[i, a])
                squared += outside * outside
            if np.sqrt(squared) < s.radius[i] + s.rounding[i]:
                pair[count] = i
                count += 1
    first[len(poses)] = count
    return count


@compiled
def _nearest(local: Array, lower: Array, upper: Array, normal: Array, across: Array) -> float:
    """Return a point's signed distance from a box; compute the normal and its derivative `across` (3, 3)."""
    squared = 0.0
    for a in range(3):
        normal[a] = local[a] - min(max(local[a], lower[a]), upper[a])
        squared += normal[a] * normal[a]
    across[:] = 0.0
    if squared > 0:
        length = np.sqrt(squared)
        for a in range(3):
            if normal[a] != 0:
                across[a, a] = 1 / length
            normal[a] /= length
        for a in range(3):
            for b in range(3):
                across[a, b] -= normal[a] * normal[b] / length
        return length
    way, axis, sign = np.inf, 0, 1.0  # for equal distances the upper faces have priority
    for a in range(3):
        if upper[a] - local[a] < way:
            way, axis, sign = upper[a] - local[a], a, 1.0
    for a in range(3):
        if local[a] - lower[a] < way:
            way, axis, sign = local[a] - lower[a], a, -1.0
    normal[axis] = sign
    return -way


@compiled
def touch(s: Spheres, p: Pairs, poses: Array, c: Touching) -> None:
    """Compute the contact points of spheres and their derivatives."""
    center, local, flat, across, R = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    half, skew, back = np.empty((3, 3)), np.zeros((3, 3)), np.empty(3)
    for k in range(len(poses)):
        for m in range(c.first[k], c.first[k + 1]):
            i, n, change = c.pair[m], c.normal[m], c.change[m]
            Y, radius = poses[k, p.sides[i, 1]], s.radius[i]
            _center_in(poses[k, p.sides[i, 0]], s.center[i], Y, s.rotation[i], s.position[i], center, local)
            phi = _nearest(local, s.lower[i], s.upper[i], flat, across) - s.rounding[i] - radius
            for a in range(3):
                for b in range(3):
                    R[a, b] = 0.0
                    for d in range(3):
                        R[a, b] += Y[a, d] * s.rotation[i, d, b]
            for a in range(3):
                n[a] = R[a, 0] * flat[0] + R[a, 1] * flat[1] + R[a, 2] * flat[2]
                for b in range(3):
                    half[a, b] = R[a, 0] * across[0, b] + R[a, 1] * across[1, b] + R[a, 2] * across[2, b]
            reach, share = radius + phi / 2, p.other_part[i] - 0.5
            for a in range(3):
                back[a] = share * phi * n[a]
                c.point[m, a] = center[a] - reach * n[a] - back[a]
            c.phi[m] = phi
            # Derivative for the twist at the midpoint, where the centre moves by [1, -reach n^], then at the point.
            skew[0, 1], skew[0, 2], skew[1, 2] = -n[2], n[1], -n[0]
            skew[1, 0], skew[2, 0], skew[2, 1] = n[2], -n[1], n[0]
            for a in range(3):
                for b in range(3):
                    curved = half[a, 0] * R[b, 0] + half[a, 1] * R[b, 1] + half[a, 2] * R[b, 2]
                    change[3 + a, b] = curved
                    change[a, b] = (1.0 if a == b else 0.0) - reach * curved - n[a] * n[b] / 2
                change[6, a] = n[a]
                change[6, 3 + a] = 0.0
            for a in range(3):
                for b in range(3):
                    turned = (
                        change[3 + a, 0] * skew[0, b] + change[3 + a, 1] * skew[1, b] + change[3 + a, 2] * skew[2, b]
                    )
                    change[3 + a, 3 + b] = -reach * turned
                    change[a, 3 + b] = -reach * (skew[a, b] - reach * turned)
            for a in range(7):
                x, y, z = change[a, 0], change[a, 1], change[a, 2]
                change[a, 3] -= y * back[2] - z * back[1]
                change[a, 4] -= z * back[0] - x * back[2]
                change[a, 5] -= x * back[1] - y * back[0]
            for a in range(3):
                for b in range(6):
                    change[a, b] -= share * (n[a] * change[6, b] + phi * change[3 + a, b])


@compiled
def _add_contact(
    p: Plant,
    pairs: Pairs,
    c: Touching,
    m: int,
    S: Array,
    diagonal: Array,
    slope: Array,
    v: Array,
    v_next: Array,
    right: Array,
    left: Array,
    push: Array,
    L: Array,
    point: Array,
    across: Array,
    y: Array,
) -> None:
    """Add contact m to right (nv, 2 nv + nu + np), left (nv, nv) and push (nv,); L and all after it are scratch."""
    nv, n, here, change = len(v), c.normal[m], c.point[m], c.change[m]
    i_pair, moves, law, h = c.pair[m], p.moves, p.law, p.time_step
    sphere, other = pairs.by_body[pairs.sides[i_pair, 0]], pairs.by_body[pairs.sides[i_pair, 1]]
    mu, k_c, d, tau = pairs.friction[i_pair], pairs.stiffness[i_pair], pairs.dissipation[i_pair], pairs.time[i_pair]
    sigma = p.constants[0]
    solved, u, du, dn, g = np.zeros(23), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    W, G, turned_sum, zero = np.zeros((3, 3)), np.empty((3, 3)), np.zeros(3), np.zeros(3)
    u_0 = 0.0
    for j in range(nv):  # the velocities L of all degrees of freedom at p, and W of J
        a0, a1, a2 = S[j, 0], S[j, 1], S[j, 2]
        L[j, 0] = S[j, 3] + a1 * here[2] - a2 * here[1]
        L[j, 1] = S[j, 4] + a2 * here[0] - a0 * here[2]
        L[j, 2] = S[j, 5] + a0 * here[1] - a1 * here[0]
        s = sphere[j] - other[j]
        if s != 0:
            for a in range(3):
                u[a] += s * L[j, a] * v_next[j]
                u_0 += s * L[j, a] * v[j] * n[a]
                for b in range(3):
                    W[a, b] += s * s * L[j, a] * L[j, b] / diagonal[j]
    size = 0.0
    for a in range(3):
        for b in range(3):
            size += W[a, b] * W[a, b]
    size = np.sqrt(size)
    w = size / 3
    phi = c.phi[m]
    solve_law(law, h, p.near_rigid, p.constants, n, phi, mu, k_c, tau, d, w, u, u_0, solved)
    f0, f1, f2 = solved[0], solved[1], solved[2]
    for j in range(nv):  # derivatives of p, normal and phi, f x a, and terms for the derivative of the weight
        s = sphere[j] - other[j]
        a0, a1, a2 = S[j, 0], S[j, 1], S[j, 2]
        across[j, 0], across[j, 1], across[j, 2] = f1 * a2 - f2 * a1, f2 * a0 - f0 * a2, f0 * a1 - f1 * a0
        for a in range(7):
            point[j, a] = 0.0
            if s != 0:
                moved = change[a, 0] * L[j, 0] + change[a, 1] * L[j, 1] + change[a, 2] * L[j, 2]
                point[j, a] = s * (moved + change[a, 3] * a0 + change[a, 4] * a1 + change[a, 5] * a2)
        for a in range(3):
            point[j, a] += other[j] * L[j, a]
            y[j, a] = 0.0
            if s != 0:
                along = W[a, 0] * L[j, 0] + W[a, 1] * L[j, 1] + W[a, 2] * L[j, 2]
                y[j, a] = s * s * along / (3 * size) / diagonal[j]
        point[j, 3] += other[j] * (a1 * n[2] - a2 * n[1])
        point[j, 4] += other[j] * (a2 * n[0] - a0 * n[2])
        point[j, 5] += other[j] * (a0 * n[1] - a1 * n[0])
        y[j, 3] = a1 * y[j, 2] - a2 * y[j, 1]  # a x y
        y[j, 4] = a2 * y[j, 0] - a0 * y[j, 2]
        y[j, 5] = a0 * y[j, 1] - a1 * y[j, 0]
        y[j, 6] = (L[j, 0] * y[j, 0] + L[j, 1] * y[j, 1] + L[j, 2] * y[j, 2]) / diagonal[j]
        for a in range(3):
            turned_sum[a] += y[j, 3 + a]
    ua0, ua1, ua2 = 0.0, 0.0, 0.0  # the angular velocity of the sphere minus the other shape's, after the step
    va0, va1, va2 = 0.0, 0.0, 0.0  # and before the step
    for j in range(nv):
        s = sphere[j] - other[j]
        if s != 0:
            ua0 += s * v_next[j] * S[j, 0]
            ua1 += s * v_next[j] * S[j, 1]
            ua2 += s * v_next[j] * S[j, 2]
            va0 += s * v[j] * S[j, 0]
            va1 += s * v[j] * S[j, 1]
            va2 += s * v[j] * S[j, 2]
    for a in range(3):  # derivative of the impulse with respect to the velocity
        du[a] = 1.0
        change_law(law, h, sigma, n, phi, mu, k_c, d, w, u, solved, du, zero, SAME_STATE, SAME_MATERIAL, g)
        for b in range(3):
            G[b, a] = g[b]
        du[a] = 0.0
    g_0 = np.zeros(3)
    if law != SAP:
        change_law(law, h, sigma, n, phi, mu, k_c, d, w, u, solved, zero, zero, (0.0, 0.0, 1.0), SAME_MATERIAL, g_0)
    for j in range(nv):
        a0, a1, a2, l0, l1, l2 = S[j, 0], S[j, 1], S[j, 2], L[j, 0], L[j, 1], L[j, 2]
        p0, p1, p2 = point[j, 0], point[j, 1], point[j, 2]
        # Sums over all k whose axes j moves: of u_k [L_k; a_k] after and before the step, and for the weight.
        b0, b1, b2, b3, b4, b5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        e0, e1, e2, e3, e4, e5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        w0, w1, w2, w3, w4, w5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        by_slope = 0.0
        for k in range(nv):
            s = sphere[k] - other[k]
            if s == 0:
                continue
            by_slope += y[k, 6] * slope[k, j]
            if moves[j, k] == 0:
                continue
            r, r_0 = s * v_next[k], s * v[k]
            b0, b1, b2 = b0 + r * L[k, 0], b1 + r * L[k, 1], b2 + r * L[k, 2]
            b3, b4, b5 = b3 + r * S[k, 0], b4 + r * S[k, 1], b5 + r * S[k, 2]
            e0, e1, e2 = e0 + r_0 * L[k, 0], e1 + r_0 * L[k, 1], e2 + r_0 * L[k, 2]
            e3, e4, e5 = e3 + r_0 * S[k, 0], e4 + r_0 * S[k, 1], e5 + r_0 * S[k, 2]
            w0 += L[k, 1] * y[k, 2] - L[k, 2] * y[k, 1]
            w1 += L[k, 2] * y[k, 0] - L[k, 0] * y[k, 2]
            w2 += L[k, 0] * y[k, 1] - L[k, 1] * y[k, 0]
            w3, w4, w5 = w3 + y[k, 3], w4 + y[k, 4], w5 + y[k, 5]
        du[0] = ua1 * p2 - ua2 * p1 + a1 * b2 - a2 * b1 + l1 * b5 - l2 * b4
        du[1] = ua2 * p0 - ua0 * p2 + a2 * b0 - a0 * b2 + l2 * b3 - l0 * b5
        du[2] = ua0 * p1 - ua1 * p0 + a0 * b1 - a1 * b0 + l0 * b4 - l1 * b3
        d_before = 0.0
        if law != SAP:
            d_before = n[0] * (va1 * p2 - va2 * p1 + a1 * e2 - a2 * e1 + l1 * e5 - l2 * e4)
            d_before += n[1] * (va2 * p0 - va0 * p2 + a2 * e0 - a0 * e2 + l2 * e3 - l0 * e5)
            d_before += n[2] * (va0 * p1 - va1 * p0 + a0 * e1 - a1 * e0 + l0 * e4 - l1 * e3)
            for k in range(nv):
                s = sphere[k] - other[k]
                if s != 0:
                    along = L[k, 0] * point[j, 3] + L[k, 1] * point[j, 4] + L[k, 2] * point[j, 5]
                    d_before += s * v[k] * along
        d_w = -(p0 * turned_sum[0] + p1 * turned_sum[1] + p2 * turned_sum[2])
        d_w += a0 * w0 + a1 * w1 + a2 * w2 + l0 * w3 + l1 * w4 + l2 * w5
        d_w = 2 * d_w - by_slope
        dn[0], dn[1], dn[2] = point[j, 3], point[j, 4], point[j, 5]
        of_state = (point[j, 6], d_w, d_before)
        change_law(law, h, sigma, n, phi, mu, k_c, d, w, u, solved, du, dn, of_state, SAME_MATERIAL, g)
        for i in range(nv):
            s = sphere[i] - other[i]
            if s == 0:
                continue
            total = L[i, 0] * g[0] + L[i, 1] * g[1] + L[i, 2] * g[2]
            total += across[i, 0] * p0 + across[i, 1] * p1 + across[i, 2] * p2
            if moves[j, i] != 0:
                total += across[j, 0] * L[i, 0] + across[j, 1] * L[i, 1] + across[j, 2] * L[i, 2]
                total -= across[i, 0] * l0 + across[i, 1] * l1 + across[i, 2] * l2
            right[i, j] += s * total
    begin = right.shape[1] - pairs.changes.shape[2]
    for r in range(pairs.changes.shape[2]):  # material parameters act through the law and through the contact point
        by = pairs.changes[:, i_pair, r]
        back = -phi * by[4]  # along the normal
        m0, m1, m2 = back * n[0], back * n[1], back * n[2]
        du[0], du[1], du[2] = ua1 * m2 - ua2 * m1, ua2 * m0 - ua0 * m2, ua0 * m1 - ua1 * m0
        d_w = -2 * (m0 * turned_sum[0] + m1 * turned_sum[1] + m2 * turned_sum[2])
        d_before = n[0] * (va1 * m2 - va2 * m1) + n[1] * (va2 * m0 - va0 * m2) + n[2] * (va0 * m1 - va1 * m0)
        of_state, of_material = (0.0, d_w, d_before), (by[0], by[1], by[2], by[3])
        change_law(law, h, sigma, n, phi, mu, k_c, d, w, u, solved, du, zero, of_state, of_material, g)
        for i in range(nv):
            s = sphere[i] - other[i]
            if s != 0:
                total = L[i, 0] * g[0] + L[i, 1] * g[1] + L[i, 2] * g[2]
                total += across[i, 0] * m0 + across[i, 1] * m1 + across[i, 2] * m2
                right[i, begin + r] += s * total
    for i in range(nv):
        s = sphere[i] - other[i]
        if s == 0:
            continue
        push[i] += s * (L[i, 0] * f0 + L[i, 1] * f1 + L[i, 2] * f2)
        for a in range(3):
            g[a] = L[i, 0] * G[0, a] + L[i, 1] * G[1, a] + L[i, 2] * G[2, a]
        early = L[i, 0] * g_0[0] + L[i, 1] * g_0[1] + L[i, 2] * g_0[2]
        for k in range(nv):
            s_k = sphere[k] - other[k]
            if s_k != 0:
                left[i, k] -= s * s_k * (g[0] * L[k, 0] + g[1] * L[k, 1] + g[2] * L[k, 2])
                if early != 0:
                    right[i, nv + k] += s * s_k * early * (L[k, 0] * n[0] + L[k, 1] * n[1] + L[k, 2] * n[2])


@compiled
def _add_joint(
    j: Array,
    target: float,
    R: float,
    near_rigid: float,
    one_sided: bool,
    h: float,
    v_next: Array,
    diagonal: Array,
    slope: Array,
    right: Array,
    left: Array,
    push: Array,
) -> None:
    """Add an impulse (target - j . v') / R along j (nv,), which for a limit (`one_sided`) is at least 0.

    `near_rigid` is R / w if R is proportional to the effective inverse mass w, else 0.
    """
    nv, along = len(j), 0.0
    for i in range(nv):
        along += j[i] * v_next[i]
    impulse = (target - along) / R
    if one_sided and not impulse > 0:
        return
    for i in range(nv):
        if j[i] == 0:
            continue
        push[i] += j[i] * impulse
        for k in range(nv):
            by_weight = 0.0
            if near_rigid != 0:
                for b in range(nv):
                    if j[b] != 0:
                        by_weight += (j[b] / diagonal[b]) ** 2 * slope[b, k]
            right[i, k] += j[i] * (near_rigid * impulse / R * by_weight - j[k] / (2 * h * R))
            left[i, k] += j[i] * j[k] / R


@compiled
def step_jacobians(
    p: Plant,
    pairs: Pairs,
    c: Touching,
    q: Array,
    v: Array,
    v_next: Array,
    at_joints: Array,
    force: Array,
    clipped: Flags,
    S: Array,
    mass: Array,
    slope: Array,
    tau: Array,
    by_q: Array,
    by_v: Array,
    out: Array,
    sizes: Array,
) -> None:
    """Compute the Jacobians (N, nx, nx + nu + np) of N steps from q and v to v'.

    `at_joints` (N, nv) are positions of hinges and slides, and `force` (N, nv) forces in addition to inverse dynamics,
    which was differentiated at (v' - v) / h. `sizes` (N, 3): Drake's norms of momentum residual, momentum and impulses.
    """
    N, nv = v.shape
    nu, h = p.actuation.shape[1], p.time_step
    right, left = np.empty((nv, 2 * nv + nu + pairs.changes.shape[2])), np.empty((nv, nv))
    factor = np.empty((nv, nv))
    A, diagonal, push, gained = np.empty((nv, nv)), np.empty(nv), np.empty(nv), np.empty((nv, 1))
    free, j = np.empty((nv, 1)), np.zeros(nv)
    L, point, across, y = np.empty((nv, 3)), np.empty((nv, 7)), np.empty((nv, 3)), np.empty((nv, 7))
    joint_near_rigid, limit_stiffness, limit_window = p.joint_constants
    stiffest = 1 / (2 * h * h * limit_stiffness)
    for n in range(N):
        for i in range(nv):
            push[i] = 0.0
            for k in range(nv):
                A[i, k] = mass[n, i, k]
            A[i, i] += p.armature[i]
            diagonal[i] = A[i, i] - p.controlled[i]
            for k in range(nv):
                right[i, k] = -h * by_q[n, i, k]
                right[i, nv + k] = A[i, k] - h * by_v[n, i, k]
                left[i, k] = A[i, k]
            right[i, i] -= h * p.stiffness[i]
            right[i, nv + i] -= h * p.damping[i]
            for k in range(nu):
                right[i, 2 * nv + k] = 0.0 if clipped[n, k] else h * p.actuation[i, k]
            right[i, 2 * nv + nu :] = 0.0
            gained[i, 0] = h * (tau[n, i] - force[n, i]) + p.armature[i] * (v_next[n, i] - v[n, i])
            free[i, 0] = gained[i, 0]
        factor[:] = A
        if not _factor(factor):
            free[:] = np.nan
        substitute(factor, free)
        for m in range(c.first[n], c.first[n + 1]):
            _add_contact(
                p, pairs, c, m, S[n], diagonal, slope[n], v[n], v_next[n], right, left, push, L, point, across, y
            )
        for i in range(nv):
            window = limit_window * h * max(abs(v[n, i]), abs(v_next[n, i] - free[i, 0]))
            for side in range(2):
                sign = 1.0 - 2.0 * side
                distance = sign * (at_joints[n, i] - p.limits[side, i])
                if distance <= window:
                    R = max(joint_near_rigid / diagonal[i], stiffest)
                    soft = joint_near_rigid if stiffest < R else 0.0
                    j[i] = sign
                    target = -distance / (2 * h)
                    _add_joint(j, target, R, soft, True, h, v_next[n], diagonal, slope[n], right, left, push)
                    j[i] = 0.0
        for b in range(len(p.offsets)):
            off, weight = -p.offsets[b], 0.0
            for i in range(nv):
                off += p.couplers[b, i] * at_joints[n, i]
                weight += p.couplers[b, i] ** 2 / diagonal[i]
            R, target, soft = joint_near_rigid * weight, off / (-2 * h), joint_near_rigid
            _add_joint(p.couplers[b], target, R, soft, False, h, v_next[n], diagonal, slope[n], right, left, push)
        missing, had, given = 0.0, 0.0, 0.0
        for i in range(nv):
            momentum = 0.0
            for k in range(nv):
                momentum += A[i, k] * v_next[n, k]
            missing += (gained[i, 0] - push[i]) ** 2 / diagonal[i]
            had += momentum * momentum / diagonal[i]
            given += push[i] * push[i] / diagonal[i]
        sizes[n, 0], sizes[n, 1], sizes[n, 2] = np.sqrt(missing), np.sqrt(had), np.sqrt(given)
        if not _factor(left):
            right[:] = np.nan
        substitute(left, right)
        assemble_step(h, p.free, p.single, q[n], v_next[n], right, out[n])

"""One contact's impulse by Drake's contact approximations, and its derivative: compiled. `laws` has the formulas."""

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.compiled import compiled

Array = NDArray[np.float64]

SAP, SIMILAR, LAGGED = 0, 1, 2
SAME_STATE, SAME_MATERIAL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)  # for `change_law`


@compiled
def solve_law(
    law: int,
    h: float,
    beta: float,
    constants: tuple[float, float, float],
    n: Array,
    phi: float,
    mu: float,
    k: float,
    tau: float,
    d: float,
    w: float,
    u: Array,
    u_0: float,
    solved: Array,
) -> None:
    """Solve the law of a contact with the velocity u (3,) after the step and u_0 along the normal before it.

    `solved` keeps what its derivatives are made of, from solved[0:3] the impulse on.
    """
    sigma, soft_norm, stiction_tolerance = constants
    vn = u[0] * n[0] + u[1] * n[1] + u[2] * n[2]
    if law == SAP:
        soft = h + tau
        rigid, compliant = (beta / (2 * np.pi)) ** 2 * w, 1.0 / (h * k * soft)
        R_n, R_t = max(rigid, compliant), sigma * w
        y_n = (-phi / soft - vn) / R_n
        squared = soft_norm**2
        for i in range(3):
            solved[3 + i] = (vn * n[i] - u[i]) / R_t  # y_t
            squared += solved[3 + i] * solved[3 + i]
        y_r, ratio = np.sqrt(squared), R_t / R_n
        sticks = y_r <= mu * y_n
        pushes = sticks or -mu * ratio * y_r < y_n
        g_n = 0.0
        if sticks:
            g_n = y_n
        elif pushes:
            g_n = (y_n + mu * ratio * y_r) / (1 + mu * mu * ratio)
        for i in range(3):
            solved[6 + i] = solved[3 + i] / y_r  # the tangent
            solved[i] = (solved[3 + i] if sticks else mu * g_n * solved[6 + i]) + g_n * n[i]
        solved[9], solved[10], solved[11], solved[12], solved[13], solved[14] = soft, R_n, R_t, vn, y_n, y_r
        solved[15], solved[16], solved[17] = 1.0 if sticks else 0.0, 1.0 if pushes else 0.0, g_n
        solved[18] = 1.0 if rigid > compliant else 0.0
        return
    elastic, slowed = h * max(-k * phi, 0.0), max(1 - d * u_0, 0.0)
    soft = mu * sigma * w * elastic * slowed
    e = max(stiction_tolerance, soft)
    squared = e * e
    for i in range(3):
        solved[3 + i] = u[i] - vn * n[i]
        squared += solved[3 + i] * solved[3 + i]
    s = np.sqrt(squared)
    z = vn if law == LAGGED else vn - mu * (s - e)
    force, left = -k * phi - h * k * z, 1 - d * z
    pushes = force > 0 and left > 0
    g_n = h * force * left if pushes else 0.0
    n_f = elastic * slowed if law == LAGGED else g_n
    for i in range(3):
        solved[6 + i] = solved[3 + i] / s
        solved[i] = g_n * n[i] - mu * n_f * solved[6 + i]
    solved[9], solved[10], solved[11], solved[12], solved[13], solved[14] = elastic, slowed, e, vn, s, z
    solved[15], solved[16], solved[17], solved[18], solved[19] = force, left, g_n, n_f, w
    solved[20], solved[21], solved[22] = u_0, 1.0 if pushes else 0.0, 1.0 if soft > stiction_tolerance else 0.0


@compiled
def change_law(
    law: int,
    h: float,
    sigma: float,
    n: Array,
    phi: float,
    mu: float,
    k: float,
    d: float,
    w: float,
    u: Array,
    solved: Array,
    du: Array,
    dn: Array,
    state: tuple[float, float, float],
    material: tuple[float, float, float, float],
    out: Array,
) -> None:
    """out (3,) the change of the impulse by those of u, of the normal, of phi, w and u_0, and of mu, k, tau and d."""
    d_phi, d_w, d_before = state
    d_mu, d_k, d_tau, d_d = material
    d_vn = du[0] * n[0] + du[1] * n[1] + du[2] * n[2] + u[0] * dn[0] + u[1] * dn[1] + u[2] * dn[2]
    if law == SAP:
        soft, R_n, R_t, vn, y_n, y_r = solved[9], solved[10], solved[11], solved[12], solved[13], solved[14]
        sticks, pushes, g_n = solved[15] != 0, solved[16] != 0, solved[17]
        if not pushes:
            out[0], out[1], out[2] = 0.0, 0.0, 0.0
            return
        d_Rt = d_w / w
        d_Rn = d_Rt if solved[18] != 0 else -d_k / k - d_tau / soft
        d_yn = (phi / (soft * soft) * d_tau - d_vn - d_phi / soft) / R_n - y_n * d_Rn
        ratio, d_yr = R_t / R_n, 0.0
        for i in range(3):
            out[i] = -(du[i] - d_vn * n[i] - vn * dn[i]) / R_t - solved[3 + i] * d_Rt  # d y_t
            d_yr += solved[6 + i] * out[i]
        if sticks:
            for i in range(3):
                out[i] += d_yn * n[i] + g_n * dn[i]
            return
        slide = d_yn + mu * ratio * (d_yr + (y_r - mu * g_n) * (d_Rt - d_Rn))
        slide += ratio * (y_r - 2 * mu * g_n) * d_mu
        slide /= 1 + mu * mu * ratio
        for i in range(3):
            turned = (out[i] - solved[6 + i] * d_yr) / y_r
            out[i] = (mu * slide + d_mu * g_n) * solved[6 + i] + mu * g_n * turned + slide * n[i] + g_n * dn[i]
        return
    elastic, slowed, e, vn, s, z = solved[9], solved[10], solved[11], solved[12], solved[13], solved[14]
    force, left, g_n, n_f, u_0 = solved[15], solved[16], solved[17], solved[18], solved[20]
    pushes, is_soft = solved[21] != 0, solved[22] != 0
    d_force, n_0 = -k * d_phi - phi * d_k, elastic * slowed
    d_n0 = h * slowed * d_force - (elastic * (d * d_before + u_0 * d_d) if slowed > 0 else 0.0)
    d_e = sigma * (d_mu * w * n_0 + mu * (d_w * n_0 + w * d_n0)) if is_soft else 0.0
    d_s = e / s * d_e
    for i in range(3):
        out[i] = du[i] - d_vn * n[i] - vn * dn[i]  # d v_t
        d_s += solved[6 + i] * out[i]
    d_z = d_vn if law == LAGGED else d_vn - mu * (d_s - d_e) - d_mu * (s - e)
    d_push = d_force - h * (k * d_z + z * d_k)
    d_gn = h * (left * d_push - force * (d * d_z + z * d_d)) if pushes else 0.0
    d_nf = d_n0 if law == LAGGED else d_gn
    for i in range(3):
        turned = (out[i] - solved[6 + i] * d_s) / s
        out[i] = d_gn * n[i] + g_n * dn[i] - (d_mu * n_f + mu * d_nf) * solved[6 + i] - mu * n_f * turned


@compiled
def impulses(
    law: int,
    h: float,
    beta: float,
    constants: tuple[float, float, float],
    normal: Array,
    phi: Array,
    friction: Array,
    stiffness: Array,
    time: Array,
    dissipation: Array,
    weight: Array,
    velocity: Array,
    before: Array,
    impulse: Array,
    slope: Array,
) -> None:
    """`impulse` (M, 3) of M contacts at velocities (M, 3) after the step, and `slope` (M, 3, 3), its derivative."""
    solved, du, zero, g = np.zeros(23), np.zeros(3), np.zeros(3), np.zeros(3)
    for m in range(len(phi)):
        n, mu, k, d, w, u = normal[m], friction[m], stiffness[m], dissipation[m], weight[m], velocity[m]
        solve_law(law, h, beta, constants, n, phi[m], mu, k, time[m], d, w, u, before[m], solved)
        for a in range(3):
            impulse[m, a] = solved[a]
            du[a] = 1.0
            change_law(law, h, constants[0], n, phi[m], mu, k, d, w, u, solved, du, zero, SAME_STATE, SAME_MATERIAL, g)
            du[a] = 0.0
            for b in range(3):
                slope[m, b, a] = g[b]

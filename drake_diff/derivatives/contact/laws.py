"""The impulses of Drake's contact approximations at the solver's own solution, and their derivatives.

Let vn and vt be the normal and tangential velocity after the step, phi the signed distance and vn_0 the normal velocity
before the step, w the size of the effective inverse mass and h the time step.

`sap` (Castro, Permenter and Han, "An unconstrained convex formulation of compliant contact", 2021), with the relaxation
time tau, has

    R_n = max(beta^2 / (4 pi^2) w, 1 / (h k (h + tau))),   R_t = sigma w
    y_n = (-phi / (h + tau) - vn) / R_n,   y_t = -vt / R_t,   y_r = sqrt(|y_t|^2 + s^2)

The impulse is y inside the friction cone (stiction, y_r <= mu y_n), 0 inside the polar cone, and else (sliding)

    g_n = (y_n + mu R_t / R_n y_r) / (1 + mu^2 R_t / R_n),   g_t = mu g_n y_t / y_r.

`similar` and `lagged` (Castro, Han and Masterjohn, "A theory of irrotational contact fields", 2023), with Hunt and
Crossley's dissipation d and the stiction tolerance v_s, have

    n(z) = h (-k phi - h k z)+ (1 - d z)+,   n_0 = h (-k phi)+ (1 - d vn_0)+,   e = max(v_s, mu sigma w n_0)
    g_n = n(z),   g_t = -mu n_f vt / s,   s = sqrt(|vt|^2 + e^2)

with z = vn - mu (s - e), n_f = n(z) for `similar`, and z = vn, n_f = n_0 for `lagged`.

Drake combines the materials of the sphere s and the other shape o to

    mu = 2 mu_s mu_o / (mu_s + mu_o),   k = k_s k_o / (k_s + k_o),   b = k_o / (k_s + k_o)
    tau = tau_s + tau_o,   d = b d_s + (1 - b) d_o

with the friction mu, the stiffness k, the relaxation time tau and the dissipation d.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, own_array
from drake_diff._base.compiled import compiled
from drake_diff.mechanics.description import harmonic
from drake_diff.model.parameters import ParameterVector, geometries_of
from drake_diff.model.plant import proximity_property
from drake_diff.model.twin import Twin

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
    """Solve the law of a contact with the velocity u (3,) after the step and u_0 along the normal before the step.

    `solved` stores the impulse in solved[0:3], followed by the values from which the derivatives are computed.
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
    """Compute the impulse's change `out` (3,) from changes of u, n, `state` (phi, w, u_0) and (mu, k, tau, d)."""
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
    """Compute `impulse` (M, 3) at velocities (M, 3) after the step for M contacts, and its derivative `slope`."""
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


LAWS = {"sap": SAP, "similar": SIMILAR, "lagged": LAGGED}
SIGMA = 1e-3  # Drake's value, as in both papers: regularizes friction, so that stiction has a small creep
# Drake's default [m/s]. Drake has no getter for it; a different value is detected by a large residual.
STICTION_TOLERANCE = 1e-4
SOFT_NORM = 1e-7  # s [N s], Drake's value: makes the norm of a zero impulse differentiable


@dataclass(frozen=True, eq=False)
class ContactLaw:
    """M contacts of one approximation, with all arguments of their impulses except the velocity after the step."""

    approximation: str
    time_step: float
    near_rigid: float  # beta
    before: Array  # (M,) vn_0 [m/s], not used by SAP
    normal: Array  # (M, 3)
    phi: Array  # (M,) [m]
    weight: Array  # (M,) w [1/kg]
    friction: Array  # (M,)
    stiffness: Array  # (M,) k [N/m]
    time: Array  # (M,) tau [s], used only by SAP
    dissipation: Array  # (M,) d [s/m], not used by SAP

    def impulses(self, velocity: Array) -> tuple[Array, Array]:
        """Return impulses on the sphere (M, 3) [N s] and derivatives (M, 3, 3), at velocities (M, 3) after the step."""
        impulse, slope = np.empty((len(self.phi), 3)), np.empty((len(self.phi), 3, 3))
        arrays = (self.normal, self.phi, self.friction, self.stiffness, self.time, self.dissipation, self.weight)
        given = [own_array(array) for array in (*arrays, velocity, self.before)] + [impulse, slope]
        constants, law = (SIGMA, SOFT_NORM, STICTION_TOLERANCE), LAWS[self.approximation]
        impulses(law, self.time_step, self.near_rigid, constants, *given)
        return impulse, slope

    def subset(self, which: Indices) -> "ContactLaw":
        """Return some of the contacts."""
        arrays: dict[str, Any] = {n: v[which] for n, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, **arrays)


QUANTITIES = ("friction", "stiffness", "relaxation_time", "dissipation")  # with derivatives in closed form


@dataclass(frozen=True, eq=False)
class Material:
    """The material of P pairs, or its derivative with respect to parameters, each (P, np).

    `sides` (P, 2, 4) are the materials of the sphere and of the other shape, in the order of QUANTITIES.
    """

    sides: Array
    friction: Array  # (P,) mu
    stiffness: Array  # (P,) k [N/m]
    time: Array  # (P,) tau [s]
    dissipation: Array  # (P,) d [s/m]
    other_part: Array  # (P,) b

    @property
    def of_pairs(self) -> tuple[Array, ...]:
        """The combined material of both sides."""
        return self.friction, self.stiffness, self.time, self.dissipation, self.other_part


def read_material(twin: Twin, pairs: Any) -> Material:
    """Read the material of the pairs in the context, including applied parameters and Drake's defaults."""
    inspector, geometries = twin.inspector, {i for ids in pairs.ids for i in ids}
    read = {i: [proximity_property(inspector, i, quantity) for quantity in QUANTITIES] for i in geometries}
    sides = np.array([[read[i] for i in ids] for ids in pairs.ids], dtype=float).reshape(len(pairs.ids), 2, 4)
    return combine(sides)


def combine(sides: Array) -> Material:
    """Combine the materials of the two sides (P, 2, 4) of pairs."""
    mu, k, tau, d = np.moveaxis(sides, -1, 0)
    b = k[:, 1] / k.sum(axis=1)
    return Material(sides, 2 * harmonic(mu), harmonic(k), tau.sum(axis=1), b * d[:, 0] + (1 - b) * d[:, 1], b)


def material_change(pairs: Any, material: Material, vector: ParameterVector, twin: Twin) -> Material:
    """Differentiate the material with respect to the entries of a vector that has only QUANTITIES."""
    by_sides = np.zeros((len(vector.values), *material.sides.shape))
    of_label = geometries_of(twin)
    for column, parameter in zip(by_sides, vector.parameters, strict=True):
        wanted = of_label[parameter.label]
        column[..., QUANTITIES.index(parameter.kind.quantity)] = [[i in wanted for i in ids] for ids in pairs.ids]
    by_mu, by_k, by_tau, by_d = np.moveaxis(by_sides, (-1, 0), (0, -1))  # (P, 2, np)
    mu, k, _, d = np.moveaxis(material.sides, -1, 0)
    b = material.other_part[:, None]
    by_b = (by_k[:, 1] * k[:, :1] - by_k[:, 0] * k[:, 1:]) / k.sum(axis=1)[:, None] ** 2
    return Material(
        sides=by_sides,
        friction=2 * _harmonic_change(mu, by_mu),
        stiffness=_harmonic_change(k, by_k),
        time=by_tau.sum(axis=1),
        dissipation=b * by_d[:, 0] + (1 - b) * by_d[:, 1] + (d[:, :1] - d[:, 1:]) * by_b,
        other_part=by_b,
    )


def _harmonic_change(sides: Array, change: Array) -> Array:
    """Return the change (P, np) of a b / (a + b) for changes of a and b (P, 2, np): (b^2 da + a^2 db) / (a + b)^2."""
    total = np.where(sides.sum(axis=1) > 0, sides.sum(axis=1), 1.0)[:, None, None]
    return np.asarray(((sides[:, ::-1, None] / total) ** 2 * change).sum(axis=1))

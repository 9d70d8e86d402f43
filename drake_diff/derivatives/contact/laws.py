"""The impulses of Drake's contact approximations at the solver's own solution, and how they change.

With vn and vt the normal and tangential velocity after the step, phi the signed distance and vn_0 the normal velocity
before it, w the size of the effective inverse mass and h the time step:

`sap` (Castro, Permenter and Han, "An unconstrained convex formulation of compliant contact", 2021), with the relaxation
time tau,

    R_n = max(beta^2 / (4 pi^2) w, 1 / (h k (h + tau))),   R_t = sigma w
    y_n = (-phi / (h + tau) - vn) / R_n,   y_t = -vt / R_t,   y_r = sqrt(|y_t|^2 + s^2)

the impulse is y inside the friction cone (y_r <= mu y_n: it sticks), 0 inside its polar, and else, sliding,

    g_n = (y_n + mu R_t / R_n y_r) / (1 + mu^2 R_t / R_n),   g_t = mu g_n y_t / y_r.

`similar` and `lagged` (Castro, Han and Masterjohn, "A theory of irrotational contact fields", 2023), with Hunt and
Crossley's dissipation d and the stiction tolerance v_s,

    n(z) = h (-k phi - h k z)+ (1 - d z)+,   n_0 = h (-k phi)+ (1 - d vn_0)+,   e = max(v_s, mu sigma w n_0)
    g_n = n(z),   g_t = -mu n_f vt / s,   s = sqrt(|vt|^2 + e^2)

with z = vn - mu (s - e), n_f = n(z) of `similar`, and z = vn, n_f = n_0 of `lagged`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.derivatives.contact.material import MaterialChange

SIGMA = 1e-3  # Drake's, of both papers: regularizes friction so that a contact sticks up to a creep
# Drake's default [m/s], which it does not give back: another one shows in what it leaves unsolved.
STICTION_TOLERANCE = 1e-4
SOFT_NORM = 1e-7  # s [N s], Drake's: keeps the norm of an impulse of 0 differentiable


@dataclass(frozen=True, eq=False)
class StateChange:
    """K changes of the states of M contacts."""

    velocity: Array  # (M, K, 3) after the step
    normal: Array  # (M, K, 3)
    phi: Array  # (M, K), as all below
    weight: Array
    before: Array  # of the normal velocity before the step, which SAP does not know


@dataclass(frozen=True, eq=False)
class Cone:
    """M contacts of the SAP approximation."""

    velocity: Array  # (M, 3) after the step, of the sphere's side less the other's [m/s]
    normal: Array  # (M, 3)
    phi: Array  # (M,) [m]
    weight: Array  # (M,) w [1/kg]
    friction: Array  # (M,)
    stiffness: Array  # (M,) k [N/m]
    time: Array  # (M,) tau [s]
    time_step: float
    near_rigid: float  # beta

    def solve(self) -> "Impulse":
        """The impulses, and what their derivatives are made of."""
        h, mu = self.time_step, self.friction
        soft = h + self.time
        compliant = 1.0 / (h * self.stiffness * soft)
        rigid = (self.near_rigid / (2 * np.pi)) ** 2 * self.weight
        R_n, R_t = np.maximum(rigid, compliant), SIGMA * self.weight
        vn = (self.velocity * self.normal).sum(axis=-1)
        y_n = (-self.phi / soft - vn) / R_n
        y_t = (vn[:, None] * self.normal - self.velocity) / R_t[:, None]
        y_r = np.sqrt((y_t * y_t).sum(axis=-1) + SOFT_NORM**2)
        tangent, ratio = y_t / y_r[:, None], R_t / R_n
        sticks = y_r <= mu * y_n
        pushes = sticks | (-mu * ratio * y_r < y_n)
        g_n = np.where(sticks, y_n, np.where(pushes, (y_n + mu * ratio * y_r) / (1 + mu * mu * ratio), 0.0))
        g_t = np.where(sticks[:, None], y_t, (mu * g_n)[:, None] * tangent)
        return Impulse(self, soft, rigid > compliant, R_n, R_t, vn, y_n, y_t, y_r, tangent, sticks, pushes, g_n, g_t)


@dataclass(frozen=True, eq=False)
class Impulse:
    """The solution of a Cone; `change` is its derivative along K directions."""

    cone: Cone
    soft: Array  # h + tau
    is_rigid: NDArray[np.bool_]
    R_n: Array
    R_t: Array
    vn: Array
    y_n: Array
    y_t: Array
    y_r: Array
    tangent: Array
    sticks: NDArray[np.bool_]
    pushes: NDArray[np.bool_]
    g_n: Array
    g_t: Array

    @property
    def impulse(self) -> Array:
        """(M, 3) on the sphere's side [N s]."""
        return self.g_t + self.g_n[:, None] * self.cone.normal

    def by_velocity(self) -> Array:
        """(M, 3, 3) the derivative of the impulse by the velocity: symmetric and negative semidefinite."""
        mu, n = self.cone.friction, self.cone.normal
        nn = n[:, :, None] * n[:, None, :]
        ratio, tt = self.R_t / self.R_n, self.tangent[:, :, None] * self.tangent[:, None, :]
        across = np.eye(3) - nn
        factor = 1 / (1 + mu * mu * ratio)
        stick = across / self.R_t[:, None, None] + nn / self.R_n[:, None, None]
        mixed = mu[:, None] * self.tangent + n
        along = (factor / self.R_n)[:, None, None] * mixed[:, :, None] * mixed[:, None, :]
        turn = (mu * self.g_n / (self.y_r * self.R_t))[:, None, None] * (across - tt)
        return -np.where(self.sticks[:, None, None], stick, np.where(self.pushes[:, None, None], along + turn, 0.0))

    def by_state(self, change: StateChange) -> Array:
        """(M, K, 3) the change of the impulse."""
        c, n = self.cone, self.cone.normal[:, None, :]
        R_n, R_t = self.R_n[:, None], self.R_t[:, None]
        d_vn = (change.velocity * n).sum(axis=-1) + (c.velocity[:, None, :] * change.normal).sum(axis=-1)
        d_vt = change.velocity - d_vn[..., None] * n - self.vn[:, None, None] * change.normal
        d_Rt = change.weight / c.weight[:, None]  # as a part of R_t
        d_Rn = np.where(self.is_rigid[:, None], d_Rt, 0.0)
        d_yn = -(d_vn + change.phi / self.soft[:, None]) / R_n - self.y_n[:, None] * d_Rn
        d_yt = -d_vt / R_t[..., None] - self.y_t[:, None, :] * d_Rt[..., None]
        return self._projected(d_yn, d_yt, d_Rt - d_Rn, change.normal)

    def _projected(self, d_yn: Array, d_yt: Array, d_ratio: Array, d_normal: Array) -> Array:
        """The change of the impulse by those of y_n, y_t, of R_t / R_n as a part of it, and of the normal."""
        mu, ratio = self.cone.friction[:, None], (self.R_t / self.R_n)[:, None]
        tangent, y_r, g_n = self.tangent[:, None, :], self.y_r[:, None], self.g_n[:, None]
        d_yr = (tangent * d_yt).sum(axis=-1)
        factor = 1 / (1 + mu * mu * ratio)
        slide = factor * (d_yn + mu * ratio * (d_yr + (y_r - mu * g_n) * d_ratio))
        d_tangent = (d_yt - tangent * d_yr[..., None]) / y_r[..., None]
        slide_t = mu[..., None] * (slide[..., None] * tangent + g_n[..., None] * d_tangent)
        sticks = self.sticks[:, None]
        d_gn = np.where(sticks, d_yn, slide)
        d_gt = np.where(sticks[..., None], d_yt, slide_t)
        found = d_gt + d_gn[..., None] * self.cone.normal[:, None, :] + g_n[..., None] * d_normal
        return np.where(self.pushes[:, None, None], found, 0.0)

    def by_material(self, change: MaterialChange) -> Array:
        """(M, K, 3) the change of the impulse along K changes (M, K) of the material."""
        c = self.cone
        soft, compliant = self.soft[:, None], ~self.is_rigid[:, None]
        d_Rn = np.where(compliant, -change.stiffness / c.stiffness[:, None] - change.time / soft, 0.0)
        d_yn = c.phi[:, None] / soft**2 * change.time / self.R_n[:, None] - self.y_n[:, None] * d_Rn
        nothing = np.zeros((*change.friction.shape, 3))
        mu, ratio, slides = c.friction, self.R_t / self.R_n, self.pushes & ~self.sticks
        by_n = ratio * (self.y_r - 2 * mu * self.g_n) / (1 + mu * mu * ratio)
        by_mu = (self.g_n + mu * by_n)[:, None] * self.tangent + by_n[:, None] * c.normal
        by_friction = np.where(slides[:, None, None], change.friction[..., None] * by_mu[:, None, :], 0.0)
        return self._projected(d_yn, nothing, -d_Rn, nothing) + by_friction


@dataclass(frozen=True, eq=False)
class HuntCrossley:
    """M contacts of the approximations `similar` and `lagged`."""

    velocity: Array  # (M, 3) after the step, of the sphere's side less the other's [m/s]
    before: Array  # (M,) vn_0 [m/s]
    normal: Array  # (M, 3)
    phi: Array  # (M,) [m]
    weight: Array  # (M,) w [1/kg]
    friction: Array  # (M,)
    stiffness: Array  # (M,) k [N/m]
    dissipation: Array  # (M,) d [s/m]
    time_step: float
    stiction_tolerance: float  # v_s [m/s]
    lagged: bool

    def solve(self) -> "HuntCrossleyImpulse":
        """The impulses, and what their derivatives are made of."""
        h, k, mu, d = self.time_step, self.stiffness, self.friction, self.dissipation
        elastic, damping = h * np.maximum(-k * self.phi, 0.0), np.maximum(1 - d * self.before, 0.0)
        soft = mu * SIGMA * self.weight * elastic * damping
        e = np.maximum(self.stiction_tolerance, soft)
        vn = (self.velocity * self.normal).sum(axis=-1)
        vt = self.velocity - vn[:, None] * self.normal
        s = np.sqrt((vt * vt).sum(axis=-1) + e * e)
        z = vn if self.lagged else vn - mu * (s - e)
        force, left = -k * self.phi - h * k * z, 1 - d * z
        pushes = (force > 0) & (left > 0)
        n = np.where(pushes, h * force * left, 0.0)
        tangent, is_soft = vt / s[:, None], soft > self.stiction_tolerance
        n_f = elastic * damping if self.lagged else n
        return HuntCrossleyImpulse(self, elastic, damping, is_soft, e, vn, s, tangent, z, force, left, pushes, n, n_f)


@dataclass(frozen=True, eq=False)
class HuntCrossleyImpulse:
    """The solution of a HuntCrossley law."""

    law: HuntCrossley
    elastic: Array  # h (-k phi)+
    damping: Array  # (1 - d vn_0)+
    is_soft: NDArray[np.bool_]  # whether e is not v_s
    e: Array
    vn: Array
    s: Array
    tangent: Array  # vt / s
    z: Array
    force: Array  # -k phi - h k z
    left: Array  # 1 - d z
    pushes: NDArray[np.bool_]
    g_n: Array
    n_f: Array

    @property
    def impulse(self) -> Array:
        """(M, 3) on the sphere's side [N s]."""
        return np.asarray(self.g_n[:, None] * self.law.normal - (self.law.friction * self.n_f)[:, None] * self.tangent)

    def by_velocity(self) -> Array:
        """(M, 3, 3) the derivative of the impulse by the velocity: symmetric and negative semidefinite."""
        along = np.repeat(np.eye(3)[None], len(self.g_n), axis=0)
        zero = np.zeros((len(self.g_n), 3))
        return np.swapaxes(self.by_state(StateChange(along, 0 * along, zero, zero, zero)), -1, -2)

    def by_before(self) -> Array:
        """(M, 3) the derivative of the impulse by vn_0."""
        zero = np.zeros((len(self.g_n), 1))
        nothing = np.zeros((len(self.g_n), 1, 3))
        return np.asarray(self.by_state(StateChange(nothing, nothing, zero, zero, zero + 1))[:, 0])

    def by_state(self, change: StateChange) -> Array:
        """(M, K, 3) the change of the impulse."""
        zero = np.zeros_like(change.phi)
        return self._change(change, MaterialChange(zero, zero, zero, zero, zero))

    def by_material(self, change: MaterialChange) -> Array:
        """(M, K, 3) the change of the impulse along K changes (M, K) of the material."""
        zero = np.zeros_like(change.friction)
        nothing = np.zeros((*zero.shape, 3))
        return self._change(StateChange(nothing, nothing, zero, zero, zero), change)

    def _change(self, by: StateChange, of: MaterialChange) -> Array:
        law, h, n = self.law, self.law.time_step, self.law.normal[:, None, :]
        mu, k, d = law.friction[:, None], law.stiffness[:, None], law.dissipation[:, None]
        s, e, tangent = self.s[:, None], self.e[:, None], self.tangent[:, None]
        elastic, damping = self.elastic[:, None], self.damping[:, None]
        d_force = -k * by.phi - law.phi[:, None] * of.stiffness  # of -k phi, which overlap makes positive
        slower = -d * by.before - law.before[:, None] * of.dissipation
        d_n0 = h * damping * d_force + elastic * np.where(damping > 0, slower, 0.0)
        n_0 = elastic * damping
        soft = SIGMA * (of.friction * law.weight[:, None] * n_0 + mu * (by.weight * n_0 + law.weight[:, None] * d_n0))
        d_e = np.where(self.is_soft[:, None], soft, 0.0)
        d_vn = (by.velocity * n).sum(axis=-1) + (law.velocity[:, None, :] * by.normal).sum(axis=-1)
        d_vt = by.velocity - d_vn[..., None] * n - self.vn[:, None, None] * by.normal
        d_s = (tangent * d_vt).sum(axis=-1) + e / s * d_e
        d_tangent = (d_vt - tangent * d_s[..., None]) / s[..., None]
        d_z = d_vn if law.lagged else d_vn - mu * (d_s - d_e) - of.friction * (s - e)
        z, force, left = self.z[:, None], self.force[:, None], self.left[:, None]
        d_push = d_force - h * (k * d_z + z * of.stiffness)
        d_gn = np.where(self.pushes[:, None], h * (left * d_push - force * (d * d_z + z * of.dissipation)), 0.0)
        n_f, d_nf = self.n_f[:, None], d_n0 if law.lagged else d_gn
        d_gt = (of.friction * n_f + mu * d_nf)[..., None] * tangent + (mu * n_f)[..., None] * d_tangent
        return np.asarray(d_gn[..., None] * n + self.g_n[:, None, None] * by.normal - d_gt)

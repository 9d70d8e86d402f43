"""The impulse of Drake's `similar` and `lagged` contact at its own solution, and how it changes.

With phi the signed distance and vn_0 the normal velocity before the step, vn and vt those after it, w the size of the
effective inverse mass, h the time step, d Hunt and Crossley's dissipation and v_s the stiction tolerance (Castro, Han
and Masterjohn, "A theory of irrotational contact fields", 2023),

    n(z) = h (-k phi - h k z)+ (1 - d z)+,   n_0 = h (-k phi)+ (1 - d vn_0)+,   e = max(v_s, mu sigma w n_0)
    g_n = n(z),   g_t = -mu n_f vt / s,   s = sqrt(|vt|^2 + e^2)

with z = vn - mu (s - e), n_f = n(z) of `similar`, and z = vn, n_f = n_0 of `lagged`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_diff.arrays import Array
from drake_diff.contact_material import MaterialChange
from drake_diff.friction_cone import SIGMA, StateChange


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
        return HuntCrossleyImpulse(
            law=self,
            elastic=elastic,
            damping=damping,
            is_soft=soft > self.stiction_tolerance,
            e=e,
            vn=vn,
            s=s,
            tangent=vt / s[:, None],
            z=z,
            force=force,
            left=left,
            pushes=pushes,
            g_n=n,
            n_f=elastic * damping if self.lagged else n,
        )


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
        d_force, d_n0 = self._change_before(by, of)
        n_0 = (self.elastic * self.damping)[:, None]
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

    def _change_before(self, by: StateChange, of: MaterialChange) -> tuple[Array, Array]:
        """(M, K) of -k phi, which overlap makes positive, and of n_0."""
        law, elastic, damping = self.law, self.elastic[:, None], self.damping[:, None]
        d_force = -law.stiffness[:, None] * by.phi - law.phi[:, None] * of.stiffness
        slower = -law.dissipation[:, None] * by.before - law.before[:, None] * of.dissipation
        return d_force, law.time_step * damping * d_force + elastic * np.where(damping > 0, slower, 0.0)

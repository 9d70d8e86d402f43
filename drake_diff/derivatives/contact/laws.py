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

Of the two sides of a contact, the sphere's s and the other o, Drake makes

    mu = 2 mu_s mu_o / (mu_s + mu_o),   k = k_s k_o / (k_s + k_o),   b = k_o / (k_s + k_o)
    tau = tau_s + tau_o,   d = b d_s + (1 - b) d_o

with the friction mu, the stiffness k, the relaxation time tau and the dissipation d.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, own_array
from drake_diff._base.compiled import kernel
from drake_diff.derivatives.contact.active_contacts import AllPairs, ContactPairs
from drake_diff.model.parameters import ParameterVector, geometries_of
from drake_diff.model.plant import proximity_property
from drake_diff.model.twin import Twin

KERNEL = "drake_diff.derivatives.contact.law_kernel"
LAWS = {"sap": 0, "similar": 1, "lagged": 2}
SIGMA = 1e-3  # Drake's, of both papers: regularizes friction so that a contact sticks up to a creep
# Drake's default [m/s], which it does not give back: another one shows in what it leaves unsolved.
STICTION_TOLERANCE = 1e-4
SOFT_NORM = 1e-7  # s [N s], Drake's: keeps the norm of an impulse of 0 differentiable


@dataclass(frozen=True, eq=False)
class ContactLaw:
    """M contacts of one approximation, with all that their impulses depend on but the velocity after the step."""

    approximation: str
    time_step: float
    near_rigid: float  # beta
    before: Array  # (M,) vn_0 [m/s], which SAP does not know
    normal: Array  # (M, 3)
    phi: Array  # (M,) [m]
    weight: Array  # (M,) w [1/kg]
    friction: Array  # (M,)
    stiffness: Array  # (M,) k [N/m]
    time: Array  # (M,) tau [s], of SAP alone
    dissipation: Array  # (M,) d [s/m], of the others alone

    def impulses(self, velocity: Array) -> tuple[Array, Array]:
        """(M, 3) [N s] on the sphere's side and (M, 3, 3) their derivative, at velocities (M, 3) after the step."""
        impulse, slope = np.empty((len(self.phi), 3)), np.empty((len(self.phi), 3, 3))
        arrays = (self.normal, self.phi, self.friction, self.stiffness, self.time, self.dissipation, self.weight)
        constants = SIGMA, SOFT_NORM, STICTION_TOLERANCE
        kernel(KERNEL).impulses(
            LAWS[self.approximation],
            self.time_step,
            self.near_rigid,
            constants,
            *map(own_array, arrays),
            own_array(velocity),
            own_array(self.before),
            impulse,
            slope,
        )
        return impulse, slope

    def subset(self, which: Indices) -> "ContactLaw":
        """Some of the contacts."""
        arrays: dict[str, Any] = {n: v[which] for n, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, **arrays)


QUANTITIES = ("friction", "stiffness", "relaxation_time", "dissipation")  # whose derivatives have a closed form


@dataclass(frozen=True, eq=False)
class Material:
    """Of P pairs; `sides` (P, 2, 4) is that of the sphere and of the other, in the order of QUANTITIES."""

    sides: Array
    friction: Array  # (P,) mu
    stiffness: Array  # (P,) k [N/m]
    time: Array  # (P,) tau [s]
    dissipation: Array  # (P,) d [s/m]
    other_part: Array  # (P,) b

    @property
    def of_pairs(self) -> tuple[Array, ...]:
        """What the two sides make."""
        return self.friction, self.stiffness, self.time, self.dissipation, self.other_part


@dataclass(frozen=True, eq=False)
class MaterialChange:
    """The derivative of a Material by parameters, each (P, np)."""

    friction: Array
    stiffness: Array
    time: Array
    dissipation: Array
    other_part: Array

    @property
    def stacked(self) -> Array:
        """(5, P, np) in the order of `Material.of_pairs`."""
        return np.array([self.friction, self.stiffness, self.time, self.dissipation, self.other_part])


def read_material(twin: Twin, pairs: AllPairs | ContactPairs) -> Material:
    """What the context has for the pairs, parameters that are applied included; Drake fills in its defaults there."""
    inspector, geometries = twin.inspector, {i for ids in pairs.ids for i in ids}
    read = {i: [proximity_property(inspector, i, quantity) for quantity in QUANTITIES] for i in geometries}
    sides = np.array([[read[i] for i in ids] for ids in pairs.ids], dtype=float).reshape(len(pairs.ids), 2, 4)
    return combine(sides)


def combine(sides: Array) -> Material:
    """Of the two sides (P, 2, 4) of pairs."""
    mu, k, tau, d = np.moveaxis(sides, -1, 0)
    b = k[:, 1] / k.sum(axis=1)
    return Material(sides, 2 * _harmonic(mu), _harmonic(k), tau.sum(axis=1), b * d[:, 0] + (1 - b) * d[:, 1], b)


def _harmonic(sides: Array) -> Array:
    """(P,) a b / (a + b) of sides (P, 2), 0 where both are 0."""
    total = sides.sum(axis=1)
    return np.asarray(sides.prod(axis=1) / np.where(total > 0, total, 1.0))


def material_change(
    pairs: AllPairs | ContactPairs, material: Material, vector: ParameterVector, twin: Twin
) -> MaterialChange:
    """By the entries of a vector all of whose quantities are QUANTITIES."""
    by_sides = np.zeros((len(vector.values), *material.sides.shape))
    of_label = geometries_of(twin)
    for column, parameter in zip(by_sides, vector.parameters, strict=True):
        wanted = of_label[parameter.label]
        column[..., QUANTITIES.index(parameter.kind.quantity)] = [[i in wanted for i in ids] for ids in pairs.ids]
    by_mu, by_k, by_tau, by_d = np.moveaxis(by_sides, (-1, 0), (0, -1))  # (P, 2, np)
    mu, k, _, d = np.moveaxis(material.sides, -1, 0)
    b = material.other_part[:, None]
    by_b = (by_k[:, 1] * k[:, :1] - by_k[:, 0] * k[:, 1:]) / k.sum(axis=1)[:, None] ** 2
    return MaterialChange(
        friction=2 * _harmonic_change(mu, by_mu),
        stiffness=_harmonic_change(k, by_k),
        time=by_tau.sum(axis=1),
        dissipation=b * by_d[:, 0] + (1 - b) * by_d[:, 1] + (d[:, :1] - d[:, 1:]) * by_b,
        other_part=by_b,
    )


def _harmonic_change(sides: Array, change: Array) -> Array:
    """(P, np) the change of a b / (a + b) by those (P, 2, np) of a and b: (b^2 da + a^2 db) / (a + b)^2."""
    total = np.where(sides.sum(axis=1) > 0, sides.sum(axis=1), 1.0)[:, None, None]
    return np.asarray(((sides[:, ::-1, None] / total) ** 2 * change).sum(axis=1))

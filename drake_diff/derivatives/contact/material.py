"""What the two sides of a contact are made of, and what Drake makes of the two.

    mu = 2 mu_s mu_o / (mu_s + mu_o),   k = k_s k_o / (k_s + k_o),   b = k_o / (k_s + k_o)
    tau = tau_s + tau_o,   d = b d_s + (1 - b) d_o

of the sphere's and the other side: friction, stiffness, relaxation time (of `sap` alone) and Hunt and Crossley's
dissipation (of `similar` and `lagged` alone).
"""

from dataclasses import dataclass, fields

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.derivatives.contact.pairs import ContactPairs, Indices
from drake_diff.derivatives.contact.touching import AllPairs
from drake_diff.model.parameter_kinds import geometries_of
from drake_diff.model.parameters import ParameterVector
from drake_diff.model.plant import proximity_property
from drake_diff.model.twin import Twin

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


@dataclass(frozen=True, eq=False)
class MaterialChange:
    """The derivative of a Material by parameters, each (P, np)."""

    friction: Array
    stiffness: Array
    time: Array
    dissipation: Array
    other_part: Array

    def part(self, pairs: Indices) -> "MaterialChange":
        """That of some pairs (M,)."""
        return MaterialChange(*(getattr(self, f.name)[pairs] for f in fields(self)))


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

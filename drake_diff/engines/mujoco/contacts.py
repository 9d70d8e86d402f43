"""The geometries of a compiled MuJoCo model, the pairs of them that may touch, and what each pair's contact is made of.

MuJoCo's contact has the force f for which the overlap r accelerates by r'' = -B r' - K d r + R f, where d is the
impedance and R = (1 - d) / d / m, with 1 / m the sum of the bodies' inverse weights. Where nothing accelerates this is

    f = k (r + tau r'),   k = K d^2 m / (1 - d),   tau = B / (K d)

so that with a constant d a weight rests m g / k deep, as on the spring of Drake's point contact. With solref = (-S, -D)
K is S / d^2 and B is D / d. As it moves, r'' = -B d r' - K d^2 r: it is damped critically where B is 2 sqrt(K).
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.engines.common import geometry_contract
from drake_diff.engines.mujoco.coordinates import name_of
from drake_diff.mechanics.description import GeometryContract, PairContract

PLANE = 0  # mjtGeom
KINDS = {PLANE: "HalfSpace", 2: "Sphere", 3: "Capsule", 4: "Ellipsoid", 5: "Cylinder", 6: "Box"}
PYRAMIDAL = 0  # mjtCone
FILTERPARENT, REFSAFE = 1 << 9, 1 << 11  # mjtDisableBit
SMALL = 1e-15  # mjMINVAL
Given = tuple[int, Array, Array, Array, Array, Array]


def geometry_name(m: Any, g: int) -> str:
    """The geom's own name, or its number and its body's."""
    own = name_of(m, m.name_geomadr[g])
    return own or f"geom {g} of {name_of(m, m.name_bodyadr[int(m.geom_bodyid[g])])}"


def read_geometries(m: Any, d: Any) -> tuple[GeometryContract, ...]:
    """Every geom, where `d` is at Drake's q = 0; a mesh or height field without sizes."""
    found = []
    for g in range(m.ngeom):
        body = int(m.body_weldid[int(m.geom_bodyid[g])])
        last = int(m.body_jntadr[body]) + int(m.body_jntnum[body]) - 1
        carrier = "world" if body == 0 else name_of(m, m.name_jntadr[last])
        kind = KINDS.get(int(m.geom_type[g]), "Mesh")
        at = np.array(d.geom_xpos[g], dtype=float), np.array(d.geom_xmat[g], dtype=float).reshape(3, 3)
        size = [float(s) for s in m.geom_size[g]]
        sizes = {
            "HalfSpace": [], "Mesh": [], "Sphere": size[:1], "Ellipsoid": size, "Box": [2 * s for s in size],
        }.get(kind, [size[0], 2 * size[1]])  # fmt: skip
        found.append(geometry_contract(geometry_name(m, g), carrier, kind, sizes, *at))
    return tuple(found)


def read_pairs(m: Any) -> tuple[PairContract, ...]:
    """Every pair of geoms that may touch: those that are listed, then those that MuJoCo's filters leave."""
    listed = {frozenset(map(int, pair)): i for i, pair in enumerate(zip(m.pair_geom1, m.pair_geom2, strict=True))}
    return (
        *(_contract(m, (int(m.pair_geom1[i]), int(m.pair_geom2[i])), *_of_pair(m, i)) for i in listed.values()),
        *(_contract(m, both, *_of_geoms(m, *both)) for both in _unfiltered(m) if frozenset(both) not in listed),
    )


def _unfiltered(m: Any) -> Iterator[tuple[int, int]]:
    excluded = {int(signature) for signature in m.exclude_signature}
    weld = [int(w) for w in m.body_weldid]
    parent = [weld[int(m.body_parentid[w])] for w in weld]
    related = not int(m.opt.disableflags) & FILTERPARENT
    for a in range(m.ngeom):
        for b in range(a + 1, m.ngeom):
            bits = int(m.geom_contype[a]) & int(m.geom_conaffinity[b])
            bits |= int(m.geom_contype[b]) & int(m.geom_conaffinity[a])
            i, j = sorted((int(m.geom_bodyid[a]), int(m.geom_bodyid[b])))
            one_family = related and weld[i] and weld[j] and (weld[i] == parent[j] or weld[j] == parent[i])
            both_flat = int(m.geom_type[a]) == int(m.geom_type[b]) == PLANE
            if bits and weld[i] != weld[j] and not one_family and not both_flat and (i << 16) + j not in excluded:
                yield a, b


def _of_pair(m: Any, i: int) -> Given:
    """The dimension of the contact, friction (5,), solref (2,), solref of friction (2,), solimp (5,), (margin, gap)."""
    numbers = (np.array(getattr(m, f"pair_{name}")[i]) for name in ("friction", "solref", "solreffriction", "solimp"))
    friction, solref, of_friction, solimp = numbers
    return int(m.pair_dim[i]), friction, solref, of_friction, solimp, np.array([m.pair_margin[i], m.pair_gap[i]])


def _of_geoms(m: Any, a: int, b: int) -> Given:
    """As `_of_pair`, by MuJoCo's rules for two geoms."""
    apart = np.array([max(numbers[a], numbers[b]) for numbers in (m.geom_margin, m.geom_gap)])
    none, rank = np.zeros(2), int(m.geom_priority[a]) - int(m.geom_priority[b])
    if rank:
        g = a if rank > 0 else b
        friction = np.array(m.geom_friction[g])[[0, 0, 1, 2, 2]]
        return int(m.geom_condim[g]), friction, np.array(m.geom_solref[g]), none, np.array(m.geom_solimp[g]), apart
    one, two = float(m.geom_solmix[a]), float(m.geom_solmix[b])
    part = 0.5 if max(one, two) < SMALL else 0.0 if one < SMALL else 1.0 if two < SMALL else one / (one + two)
    solref_a, solref_b = np.array(m.geom_solref[a]), np.array(m.geom_solref[b])
    mixed = part * solref_a + (1 - part) * solref_b
    solref = mixed if min(solref_a[0], solref_b[0]) > 0 else np.minimum(solref_a, solref_b)
    solimp = part * np.array(m.geom_solimp[a]) + (1 - part) * np.array(m.geom_solimp[b])
    friction = np.maximum(m.geom_friction[a], m.geom_friction[b])[[0, 0, 1, 2, 2]]
    return max(int(m.geom_condim[a]), int(m.geom_condim[b])), friction, solref, none, solimp, apart


def _contract(
    m: Any, both: tuple[int, int], dim: int, friction: Array, solref: Array, of_friction: Array, solimp: Array,
    apart: Array,
) -> PairContract:  # fmt: skip
    more = {"friction across": float(friction[1]) if friction[1] != friction[0] else 0.0} if dim > 1 else {}
    more |= {"torsional friction [m]": float(friction[2])} if dim > 3 else {}
    more |= {"rolling friction [m]": float(max(friction[3:]))} if dim > 4 else {}
    more |= {"solreffriction": float(np.abs(of_friction).max()), "gap [m]": float(apart[1])}
    least, most = (float(d) for d in np.clip(solimp[:2], 1e-4, 0.9999))
    K, B = _reference(m, solref, solimp)
    if solimp[2] <= SMALL:  # no width: the mean of the two everywhere
        least = most = (least + most) / 2
    stiffness = _stiffness(m, both, dim, friction, K, least)
    if least != most:
        more["stiffness beyond the width of solimp [N/m]"] = _stiffness(m, both, dim, friction, K, most)
    return PairContract(
        names=(geometry_name(m, both[0]), geometry_name(m, both[1])),
        friction=float(friction[0]) if dim > 1 else 0.0,
        stiffness=stiffness,
        relaxation_time=B / (K * least) if K else None,
        critical_time=2 / (float(np.sqrt(K)) * least) if K else None,
        margin=float(apart[0]),
        more=tuple((name, value) for name, value in more.items() if value),
    )


def _reference(m: Any, solref: Array, solimp: Array) -> tuple[float, float]:
    """K and B of solref, given by stiffness and damping or by a time constant and damping ratio."""
    d = float(np.clip(solimp[1], 1e-4, 0.9999))
    if solref[0] <= 0:
        return -float(solref[0]) / d**2, -float(solref[1]) / d
    shortest = 0.0 if int(m.opt.disableflags) & REFSAFE else 2 * float(m.opt.timestep)
    time, ratio = max(float(solref[0]), shortest), float(solref[1])
    return 1 / (d * time * ratio) ** 2, 2 / (d * time)


def _stiffness(m: Any, both: tuple[int, int], dim: int, friction: Array, K: float, d: float) -> float:
    """[N/m] where the contact rests, at the impedance `d`; a pyramid's edges share the force."""
    bodies = [int(m.geom_bodyid[g]) for g in both]
    inverse_mass = sum(float(m.body_invweight0[b][0]) for b in bodies)
    found = K * d**2 / ((1 - d) * inverse_mass) if inverse_mass else np.inf
    if dim == 1 or int(m.opt.cone) != PYRAMIDAL:
        return float(found)
    mu = float(friction[0])
    return float(found * (dim - 1) * float(m.opt.impratio) / (mu**2 * (1 + mu**2)))

"""Read the contract out of Bullet (`bullet`: pybullet's client), and what its links are given for their contacts.

Bullet has friction and stiffness by link and makes those of pairs: mu = mu_a mu_b and 1/k = 1/k_a + 1/k_b.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from drake_diff.arrays import Array
from drake_diff.engines.bullet_urdf import UNLIMITED
from drake_diff.engines.description import joint_contract
from drake_diff.engines.engine import JointContract, PairContract
from drake_diff.engines.euler import rotation
from drake_diff.engines.rigid_links import RigidLink, RigidLinks

T = TypeVar("T")
Owner = tuple[int, int]  # Bullet's body and link, -1 for its base
KINDS = {0: "revolute", 1: "prismatic"}  # pybullet.JOINT_REVOLUTE and JOINT_PRISMATIC
SMALLEST = 1e-30  # for 0, whose logarithm and whose inverse are needed


def owners_of(pair: PairContract, owners: dict[str, Owner]) -> tuple[Owner, Owner]:
    """The two links of a pair of geometries, the smaller first."""
    a, b = sorted(owners[name] for name in pair.names)
    return a, b


def side_values(tree: RigidLinks, owners: dict[str, Owner]) -> dict[Owner, tuple[float | None, float | None]]:
    """Friction and stiffness of each link that touches, as near to those of Drake's pairs as they can come.

    None where no pair of the link has one. Where pairs disagree it is the least squares' solution, which the contract
    shows.
    """
    pairs = [(owners_of(pair, owners), pair) for pair in tree.pairs]
    friction = split([(x, np.log(max(pair.friction, SMALLEST))) for x, pair in pairs if pair.friction is not None])
    compliance = split([(x, 1 / max(pair.stiffness, SMALLEST)) for x, pair in pairs if pair.stiffness is not None])
    touching = {owner for pair in tree.pairs for owner in owners_of(pair, owners)}
    return {
        owner: (
            float(np.exp(friction[owner])) if owner in friction else None,
            1 / max(compliance[owner], SMALLEST) if owner in compliance else None,
        )
        for owner in touching
    }


def split(given: Sequence[tuple[tuple[T, T], float]]) -> dict[T, float]:
    """s with s_a + s_b = the value of each pair (a, b): the least squares' solution, the smallest where many are."""
    found = list(dict.fromkeys(side for pair, _ in given for side in pair))
    sums = np.zeros((len(given), len(found)))
    for row, (pair, _) in zip(sums, given, strict=True):
        for side in pair:
            row[found.index(side)] += 1.0
    values = np.linalg.lstsq(sums, np.array([value for _, value in given]), rcond=None)[0] if given else []
    return dict(zip(found, (float(value) for value in values), strict=True))


def read_part(bullet: Any, place: Owner) -> tuple[float, Array, Array, Array]:
    """Mass, centre of mass (3,), inertia (3, 3) about it and principal axes (3, 3) of a link, in world."""
    info = bullet.getDynamicsInfo(*place)
    state = bullet.getBasePositionAndOrientation(place[0]) if place[1] < 0 else bullet.getLinkState(*place, 0, 1)
    R = rotation(np.array(state[1])[[3, 0, 1, 2]])
    return float(info[0]), np.array(state[0]), R @ np.diag(info[2]) @ R.T, R


def read_joint(bullet: Any, place: Owner, link: RigidLink) -> JointContract:
    """Where Bullet is at Drake's q = 0; springs are those of the engine."""
    mass, center, inertia, R = read_part(bullet, place)
    kind, axis, anchor, damping, lower, upper = "quaternion_floating", np.zeros(3), center, 0.0, -np.inf, np.inf
    if place[1] >= 0:
        info = bullet.getJointInfo(*place)
        kind, damping, axis = KINDS[info[2]], float(info[6]), R @ info[13]  # the axis is in the principal axes
        _, above, _, turned = read_part(bullet, (place[0], info[16]))
        anchor = above + turned @ info[14]
        lower, upper = (float(side) for side in info[8:10]) if info[8] <= info[9] else (lower, upper)
    return joint_contract(
        name=link.joint.joint,
        kind=kind,
        axis=axis,
        anchor=anchor,
        carried=[(mass, center, inertia)],
        damping=damping,
        armature=0.0,
        stiffness=link.joint.stiffness,
        rest=link.joint.rest,
        lower=lower if lower > -UNLIMITED else -np.inf,
        upper=upper if upper < UNLIMITED else np.inf,
    )


def read_pairs(bullet: Any, tree: RigidLinks, owners: dict[str, Owner]) -> tuple[PairContract, ...]:
    """Every pair of geometries whose links touch each other in Bullet: Drake's, then what comes with them."""
    links = {owners_of(pair, owners) for pair in tree.pairs}
    found = [pair.names for pair in tree.pairs]
    for a in owners:
        for b in owners:
            both = a < b and tuple(sorted((owners[a], owners[b]))) in links
            if both and (a, b) not in found and (b, a) not in found:
                found.append((a, b))
    return tuple(_pair(names, [bullet.getDynamicsInfo(*owners[name]) for name in names]) for names in found)


def _pair(names: tuple[str, str], sides: list[Any]) -> PairContract:
    a, b = (float(side[9]) for side in sides)
    return PairContract(names, float(sides[0][1] * sides[1][1]), a * b / (a + b) if min(a, b) > 0 else None)

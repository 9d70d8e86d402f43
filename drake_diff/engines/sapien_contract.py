"""Read the contract out of PhysX (`link`: its articulation link), and what its shapes are given for their contacts.

PhysX has friction by shape and makes the pair's by the mean of the two.
"""

from typing import Any

import numpy as np

from drake_diff.arrays import Array
from drake_diff.engines.bullet_contract import split
from drake_diff.engines.description import joint_contract
from drake_diff.engines.engine import JointContract, PairContract
from drake_diff.engines.euler import rotation
from drake_diff.engines.rigid_links import RigidLink, RigidLinks
from drake_diff.exceptions import ModelError

KINDS = {"revolute_unwrapped": "revolute", "prismatic": "prismatic", "undefined": "quaternion_floating"}
GROUPS = 32  # bits of a collision group
Pair = tuple[str, str]


def touching(tree: RigidLinks) -> tuple[tuple[PairContract, ...], tuple[Pair, ...]]:
    """The pairs that PhysX can have, and those between a link and its parent, which never touch in PhysX."""
    owner = {geometry.name: number for number, geometry in tree.geometries}

    def adjacent(pair: PairContract) -> bool:
        a, b = sorted(owner[name] for name in pair.names)
        return a >= 0 and tree.links[b].parent == a

    found = tuple(pair for pair in tree.pairs if not adjacent(pair))
    return found, tuple(pair.names for pair in tree.pairs if adjacent(pair))


def groups_by_shape(pairs: tuple[PairContract, ...]) -> dict[str, tuple[int, int]]:
    """Of each shape its own bit and those of its partners; those with the same partners share a bit. ModelError."""
    names = sorted({name for pair in pairs for name in pair.names})
    partners = {a: frozenset(b for pair in pairs if a in pair.names for b in pair.names if b != a) for a in names}
    kinds = list(dict.fromkeys(partners[name] for name in names))
    if len(kinds) > GROUPS:
        raise ModelError(f"PhysX tells {GROUPS} groups of shapes apart, and here are {len(kinds)} with other partners")
    bit = {name: 1 << kinds.index(partners[name]) for name in names}
    masks = dict.fromkeys(names, 0)
    for name in names:
        for partner in partners[name]:
            masks[name] |= bit[partner]
    return {name: (bit[name], masks[name]) for name in names}


def friction_by_shape(pairs: tuple[PairContract, ...]) -> dict[str, float]:
    """[1] of each shape, as near to those of the pairs as they can come; the contract shows what comes of it."""
    given = [(pair.names, 2 * pair.friction) for pair in pairs if pair.friction is not None]
    return {name: max(value, 0.0) for name, value in split(given).items()}


def read_part(link: Any) -> tuple[float, Array, Array, Array]:
    """Mass, centre of mass (3,), inertia (3, 3) about it and orientation of the body (3, 3), in world."""
    pose, at = link.entity_pose, link.cmass_local_pose
    body = rotation(np.array(pose.q, dtype=float))
    R = body @ rotation(np.array(at.q, dtype=float))
    center = np.array(pose.p, dtype=float) + body @ np.array(at.p, dtype=float)
    return float(link.mass), center, R @ np.diag(np.array(link.inertia, dtype=float)) @ R.T, body


def read_joint(link: Any, rigid: RigidLink) -> JointContract:
    """Where PhysX is at Drake's q = 0; springs are those of the engine."""
    mass, center, inertia, body = read_part(link)
    joint, kind = link.joint, KINDS[link.joint.type]
    single, at = kind != "quaternion_floating", link.joint.pose_in_child
    limit = np.array(joint.limit, dtype=float).ravel() if single else np.array([-np.inf, np.inf])
    return joint_contract(
        name=joint.name,
        kind=kind,
        axis=body @ rotation(np.array(at.q, dtype=float))[:, 0] if single else np.zeros(3),
        anchor=np.array(link.entity_pose.p, dtype=float) + body @ np.array(at.p, dtype=float),
        carried=[(mass, center, inertia)],
        damping=float(joint.damping) if single else 0.0,
        armature=float(joint.armature[0]) if single else 0.0,
        stiffness=rigid.joint.stiffness,
        rest=rigid.joint.rest,
        lower=float(limit[0]),
        upper=float(limit[1]),
    )

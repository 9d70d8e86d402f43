"""A description without its welds, for engines that build joint by joint: each link in the frame of its own joint."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from drake_diff.arrays import Array
from drake_diff.engines.description import Description, Geometry, Link, merged
from drake_diff.engines.engine import PairContract
from drake_diff.exceptions import ModelError

SHAPES = ("Sphere", "Box", "Cylinder", "Capsule", "HalfSpace")


@dataclass(frozen=True, eq=False)
class RigidLink:
    """A moving link and what is welded to it, in the frame of its joint on it, which at q = 0 is `on_parent`."""

    joint: Link
    parent: int  # its place in `RigidLinks.links`, -1 for the world
    on_parent: RigidTransform
    axis: Array  # (3,) unit; zero for a free body
    mass: float
    center_of_mass: Array  # (3,)
    inertia: Array  # (3, 3) about it

    @property
    def free(self) -> bool:
        return self.joint.kind == "quaternion_floating"


@dataclass(frozen=True, eq=False)
class RigidLinks:
    """`links` has every parent before its children, and one tree after the other."""

    links: tuple[RigidLink, ...]
    trees: tuple[range, ...]  # of places in `links`
    geometries: tuple[tuple[int, Geometry], ...]  # the link's place (-1 for the world), the pose on it; SHAPES only
    pairs: tuple[PairContract, ...]  # of these geometries
    left_out: tuple[tuple[str, str], ...]  # the other pairs
    anchored_energy: float  # [J] the potential energy of what is fixed to the world


def rigid_links(description: Description) -> RigidLinks:
    """ModelError for a free body whose joint's frames are not its own and the world's."""
    ordered = _by_tree(description.links)
    place = {x.body: i for i, x in enumerate(x for x in ordered if x.kind != "weld")}
    on: dict[str, tuple[int, RigidTransform]] = {"world": (-1, RigidTransform())}
    frames: dict[int, tuple[Link, int, RigidTransform]] = {}
    carried: dict[int, list[tuple[float, Array, Array]]] = {-1: []}
    for link in ordered:
        number, pose = on[link.parent]
        frame = pose @ link.on_parent
        if link.kind == "weld":
            on[link.body] = (number, frame @ link.on_child.inverse())
        else:
            _check(link)
            frames[place[link.body]] = (link, number, frame)
            on[link.body] = (place[link.body], link.on_child.inverse())
        number, pose = on[link.body]
        R = pose.rotation().matrix()
        carried.setdefault(number, []).append((link.mass, pose @ link.center_of_mass, R @ link.inertia @ R.T))
    links = tuple(_link(*frames[i], carried[i]) for i in range(len(frames)))
    known = tuple(
        (on[g.body][0], Geometry(g.name, g.body, on[g.body][1] @ g.pose, g.shape))
        for g in description.geometries
        if type(g.shape).__name__ in SHAPES
    )
    names = {g.name for _, g in known}
    pairs = tuple(pair for pair in description.pairs if set(pair.names) <= names)
    left_out = tuple(pair.names for pair in description.pairs if pair not in pairs)
    energy = -sum(m * float(description.gravity @ c) for m, c, _ in carried[-1])
    return RigidLinks(links, _trees(links), known, pairs, left_out, energy)


def _by_tree(links: tuple[Link, ...]) -> list[Link]:
    """The links of one tree after those of another; what is fixed to the world comes first."""
    tree = {"world": -1}
    for i, link in enumerate(links):
        up = tree[link.parent]
        tree[link.body] = i if up < 0 and link.kind != "weld" else up
    return sorted(links, key=lambda link: tree[link.body])


def _trees(links: tuple[RigidLink, ...]) -> tuple[range, ...]:
    starts = [i for i, link in enumerate(links) if link.parent < 0]
    return tuple(range(a, b) for a, b in zip(starts, [*starts[1:], len(links)], strict=True))


def _check(link: Link) -> None:
    if link.kind != "quaternion_floating":
        return
    if link.parent != "world" or not all(x.IsExactlyIdentity() for x in (link.on_parent, link.on_child)):
        raise ModelError(f"joint {link.joint}: this engine's free body is one of the world, by its own frame")


def _link(link: Link, parent: int, frame: RigidTransform, carried: list[tuple[float, Array, Array]]) -> RigidLink:
    mass, center_of_mass, inertia = merged(carried)
    axis = link.axis if link.kind == "quaternion_floating" else link.axis / np.linalg.norm(link.axis)
    return RigidLink(link, parent, frame, axis, mass, center_of_mass, inertia)

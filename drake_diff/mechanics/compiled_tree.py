"""The tables of a tree of hinges, slides and free bodies for `tree_kernel`, and what it makes of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array, own_array
from drake_diff.mechanics import tree_kernel
from drake_diff.mechanics.description import Description, Link

KERNEL = "drake_diff.mechanics.tree_kernel"


@dataclass(frozen=True, eq=False)
class Moved:
    """A tree at N states and accelerations; S is [angular; linear] in world about its origin."""

    poses: Array  # (N, L, 3, 4) of the links
    S: Array  # (N, nv, 6) the motion of each degree of freedom at unit speed
    mass: Array  # (N, nv, nv) M, without reflected inertia
    slope: Array  # (N, nv, nv) d M_kk / d q_j by k and j
    tau: Array  # (N, nv) M a + bias - gravity
    by_q: Array  # (N, nv, nv) its derivative by small motion
    by_v: Array  # (N, nv, nv)


@dataclass(frozen=True, eq=False)
class CompiledTree:
    """A tree whose kernel is compiled."""

    tables: tree_kernel.Tree
    links: dict[str, int]  # by their bodies' names
    nv: int

    @property
    def nq(self) -> int:
        """How many positions there are: seven of a free body."""
        return self.nv + int(np.count_nonzero(self.tables.kind == tree_kernel.FREE))

    def __call__(self, q: Array, v: Array, a: Array, *, derivatives: bool = True) -> Moved:
        """At q (N, nq), v and a (each (N, nv)), in Drake's coordinates; `slope`, `by_q` and `by_v` are 0 without."""
        N, n = len(q), self.nv
        point = own_array(q), own_array(v), own_array(a)
        poses, S, tau = np.empty((N, len(self.links), 3, 4)), np.empty((N, n, 6)), np.empty((N, n))
        mass, slope, by_q, by_v = np.empty((4, N, n, n))
        tree_kernel.differentiate_tree(self.tables, *point, derivatives, poses, S, mass, slope, tau, by_q, by_v)
        return Moved(poses, S, mass, slope, tau, by_q, by_v)


def compiled_tree(description: Description) -> CompiledTree | None:
    """None where a free body is not joined to the world by its own frame."""
    return compile_links(description.links, description.gravity, description.coordinates.nv)


def compile_links(links: Sequence[Link], gravity: Array, nv: int) -> CompiledTree | None:
    """Of all links, parents before their children; None as of `compiled_tree`."""
    identity = RigidTransform()
    for link in links:
        has_identity = link.on_parent.IsExactlyEqualTo(identity) and link.on_child.IsExactlyEqualTo(identity)
        if link.kind == "quaternion_floating" and (link.parent != "world" or not has_identity):
            return None
    kinds = {
        "weld": tree_kernel.WELD,
        "revolute": tree_kernel.HINGE,
        "prismatic": tree_kernel.SLIDE,
        "quaternion_floating": tree_kernel.FREE,
    }
    number = {link.body: i for i, link in enumerate(links)}
    joint_of, parents, first, count = {"world": -1}, [], [], []
    for link in links:
        joint_of[link.body] = joint_of[link.parent]
        starts = {"weld": (), "quaternion_floating": (3, 0)}.get(link.kind, (0,))
        for start in starts:
            parents.append(joint_of[link.body])
            first.append(link.v_start + start)
            count.append(3 if len(starts) == 2 else 1)
            joint_of[link.body] = len(parents) - 1
    axes = [link.axis / (np.linalg.norm(link.axis) if link.kind in ("revolute", "prismatic") else 1) for link in links]
    tables: tuple[Array, ...] = (
        _whole([number.get(link.parent, -1) for link in links]),
        _whole([kinds[link.kind] for link in links]),
        _whole([joint_of[link.body] for link in links]),
        _whole([link.q_start for link in links]),
        _whole([link.v_start for link in links]),
        np.array(axes, dtype=float).reshape(-1, 3),
        np.array([link.on_parent.GetAsMatrix34() for link in links]).reshape(-1, 3, 4),
        np.array([link.on_child.inverse().GetAsMatrix34() for link in links]).reshape(-1, 3, 4),
        np.array([link.mass for link in links], dtype=float),
        np.array([link.center_of_mass for link in links], dtype=float).reshape(-1, 3),
        np.array([link.inertia for link in links], dtype=float).reshape(-1, 3, 3),
        _whole(parents),
        _whole(first),
        _whole(count),
        np.array(gravity, dtype=float),
    )
    return CompiledTree(tree_kernel.Tree(*map(own_array, tables)), number, nv)


def _whole(numbers: list[int]) -> Array:
    return np.array(numbers, dtype=np.int64)

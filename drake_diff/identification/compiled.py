"""A tree whose numbers are set, as `kernel` takes it: steps, and forces by what its links weigh."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, own_array, skew
from drake_diff._base.compiled import kernel
from drake_diff.mechanics.compiled_tree import KERNEL as TREE
from drake_diff.mechanics.compiled_tree import CompiledTree, Moved
from drake_diff.mechanics.description import RigidLink

KERNEL = "drake_diff.identification.kernel"
INERTIA = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # xx yy zz xy xz yz


@dataclass(frozen=True, eq=False)
class CompiledForces:
    """A tree whose links are the frames of joints with what they carry by welds, and what else acts on it."""

    tree: CompiledTree
    forces: tuple[Any, ...]  # of a `kernel.Forces`
    inertial: Array  # (L, 10)

    def step(
        self,
        method: tuple[tuple[Array, ...], Array],
        x: Array,
        h: Array,
        push: Array,
        turn: Array | None = None,
        held: Array | None = None,
    ) -> Array:
        """The states (N, nx) after steps of h (N,) from x under forces push (N, n) of inputs.

        Dry friction turns over a small speed, or does what turn and held (N, n) say.
        """
        compiled, (stages, weights) = kernel(KERNEL), method
        rows = np.zeros((len(weights), len(weights)))
        for i, row in enumerate(stages):
            rows[i, :i] = row
        none = np.zeros((0, 0))
        law = (compiled.TURNS, none, none) if turn is None else (compiled.SLIDES, turn, held)
        out = np.empty_like(x)
        compiled.step(
            kernel(TREE).Tree(*self.tree.tables),
            compiled.Forces(*self.forces),
            rows,
            own_array(weights),
            *map(own_array, (x, h, push)),
            law[0],
            *(own_array(np.asarray(each, dtype=float)) for each in law[1:]),
            out,
        )
        return out

    def by_links(self, moved: Moved, v: Array, a: Array, inertial: Array, gravity: Array) -> Array:
        """(N, n, c) inverse dynamics by c changes of the links' numbers (L, 10, c) and of gravity (3, c)."""
        out = np.empty((*v.shape, inertial.shape[2]))
        kernel(KERNEL).force_by_links(
            kernel(TREE).Tree(*self.tree.tables),
            own_array(self.inertial),
            moved.poses,
            moved.S,
            *map(own_array, (v, a, np.moveaxis(inertial, 2, 0), gravity.T)),
            out,
        )
        return out


def compiled_forces(
    links: Sequence[RigidLink], inertial: Array, offset: Array, gravity: Array, forces: tuple[Any, ...]
) -> CompiledForces | None:
    """Each link is its joint's frame with what it carries by welds; None where Numba is not installed."""
    module = kernel(TREE)
    if module is None:
        return None
    kinds = {"revolute": module.HINGE, "prismatic": module.SLIDE, "quaternion_floating": module.FREE}
    parents: list[int] = []
    first: list[int] = []
    size: list[int] = []
    joint_of: list[int] = []
    for link in links:
        before = joint_of[link.parent] if link.parent >= 0 else -1
        for start in (3, 0) if link.free else (0,):
            parents.append(before)
            first.append(link.joint.v_start + start)
            size.append(3 if link.free else 1)
            before = len(parents) - 1
        joint_of.append(before)
    frames = np.array([link.on_parent.GetAsMatrix34() for link in links]).reshape(-1, 3, 4)
    frames[:, :, 3] = offset
    identity = np.broadcast_to(np.eye(3, 4), frames.shape)
    mass = inertial[:, 0]
    center = inertial[:, 1:4] / np.where(mass != 0, mass, 1.0)[:, None]
    inertia = np.empty((len(mass), 3, 3))
    for k, (i, j) in enumerate(INERTIA):
        inertia[:, i, j] = inertia[:, j, i] = inertial[:, 4 + k]
    hat = skew(center)
    inertia += mass[:, None, None] * (hat @ hat)  # about the centre of mass
    tables = (
        [link.parent for link in links],
        [kinds[link.joint.kind] for link in links],
        joint_of,
        [link.joint.q_start for link in links],
        [link.joint.v_start for link in links],
        np.array([link.axis for link in links], dtype=float).reshape(-1, 3),
        frames,
        identity,
        mass,
        center,
        inertia,
        parents,
        first,
        size,
        gravity,
    )
    whole = [own_array(np.array(t, dtype=np.int64) if isinstance(t, list) else t) for t in tables]
    names = {link.joint.body: i for i, link in enumerate(links)}
    return CompiledForces(CompiledTree(kernel(TREE).Tree(*whole), names, len(forces[1])), forces, own_array(inertial))

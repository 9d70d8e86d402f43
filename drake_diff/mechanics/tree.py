"""The dynamics of a tree of hinges, slides and free bodies and their derivatives, for many states in one call.

    tau(q, v, a) = M(q) a + C(q, v) v - gravity - springs + D v + reflected inertia

Spatial vectors are [angular; linear] in the world frame at its origin. A joint K moves its body along the columns s of
S_K, which move with the body P before the joint. A joint is a hinge, a slide, a free body's three slides, or the
following rotation of the free body about world axes. V_P and V_K are the velocities before and after the joint, A_K is
the acceleration after the joint (the world's is -g), x is the motion cross product, and

    P_s = V_K x s,   T_s = (V_P + V_K) x s,   Q_s = A_K x s + V_K x P_s

The derivatives of the force F on all bodies that joint K carries, with respect to motion and speed along s, are

    I Q_s + B P_s + s x* F,   I T_s + B s

where I, F and B are sums over the bodies that K carries: their inertias, their forces, and
(v x*) I - I (v x) + (I v) x*. The derivative of the force of joint i is S_i' times this derivative for the lower of
the two joints, without s x* F if i is the lower one, as its axes turn with K. For joints of one degree of freedom these
are the formulas of Singh, Russell and Wensing, "Efficient analytical derivatives of rigid-body dynamics using spatial
vector algebra" (2022). Derivatives with respect to q are with respect to the tangent: for a free body, its rotation and
translation in world. `tree_kernel` implements the arithmetic.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array, Indices, own_array
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.values import Refusal
from drake_diff.mechanics import tree_kernel
from drake_diff.mechanics.description import Description, Link, RigidLink, read_links, springs_of, without_welds
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.repairs import JointCoupling
from drake_diff.model.step import set_state


@dataclass(frozen=True, eq=False)
class Moved:
    """The results for a tree at N states and accelerations; S is [angular; linear] in world about its origin."""

    poses: Array  # (N, L, 3, 4) of the links
    S: Array  # (N, nv, 6) the motion of each degree of freedom at unit speed
    mass: Array  # (N, nv, nv) M, without reflected inertia
    slope: Array  # (N, nv, nv) entry k, j: d M_kk / d q_j
    tau: Array  # (N, nv) M a + bias - gravity
    by_q: Array  # (N, nv, nv) derivative of tau with respect to the tangent of q
    by_v: Array  # (N, nv, nv) derivative of tau with respect to v


@dataclass(frozen=True, eq=False)
class CompiledTree:
    """A tree whose kernel is compiled."""

    tables: tree_kernel.Tree
    links: dict[str, int]  # body name -> index of the link
    nv: int

    @property
    def nq(self) -> int:
        """The number of positions, which is seven for a free body."""
        return self.nv + int(np.count_nonzero(self.tables.kind == tree_kernel.FREE))

    def __call__(self, q: Array, v: Array, a: Array, *, derivatives: bool = True) -> Moved:
        """Evaluate at q (N, nq), v and a (each (N, nv)); without `derivatives`, `slope`, `by_q` and `by_v` are 0."""
        N, n = len(q), self.nv
        point = own_array(q), own_array(v), own_array(a)
        poses, S, tau = np.empty((N, len(self.links), 3, 4)), np.empty((N, n, 6)), np.empty((N, n))
        mass, slope, by_q, by_v = np.empty((4, N, n, n))
        tree_kernel.differentiate_tree(self.tables, *point, derivatives, poses, S, mass, slope, tau, by_q, by_v)
        return Moved(poses, S, mass, slope, tau, by_q, by_v)


def compiled_tree(description: Description) -> CompiledTree | None:
    """Compile a description, or return None if a free body is not joined to the world by its own frame."""
    return compile_links(description.links, description.gravity, description.coordinates.nv)


def compile_links(links: Sequence[Link], gravity: Array, nv: int) -> CompiledTree | None:
    """Compile all links, parents before their children, or return None as `compiled_tree` does."""
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


SAME_TREE = 1e-11  # tolerance relative to the largest entry: these formulas and AutoDiffXd differ by rounding
# [rad or m] times max(1, |q|): first derivatives are accurate to 1e-15, so the second derivatives are to about 1e-6.
SECOND_DIFFERENCE = 3e-8


@dataclass(frozen=True, eq=False)
class InverseDynamics:
    """Inverse dynamics tau (N, n) and derivatives with respect to q, v and a (each (N, n, n)) at N states."""

    tau: Array
    by_q: Array
    by_v: Array
    mass: Array


@dataclass(frozen=True, eq=False)
class TreeModel:
    """A tree of n degrees of freedom, with the springs, damping and reflected inertia of each."""

    links: tuple[RigidLink, ...]  # including the bodies welded to them, every parent before its children
    on: dict[str, tuple[int, RigidTransform]]  # body name -> link that carries the body (-1: world), and pose on it
    compiled: CompiledTree
    gravity: Array  # (3,)
    positions: Indices  # (n,) index in q; 0 for free bodies, which have no springs
    free: NDArray[np.bool_]  # (n,) True for the velocities of free bodies
    stiffness: Array  # (n,) of springs [N/m or N m/rad]
    rest: Array  # (n,) rest positions of springs [m or rad]
    damping: Array  # (n,)
    reflected: Array  # (n,) rotor inertia times gear ratio squared
    coupling: JointCoupling | None  # if given, q, v, a and tau are in the independent coordinates

    def __call__(self, q: Array, v: Array, a: Array) -> InverseDynamics:
        """Compute inverse dynamics and its derivatives, in the tangent of q (N, nq), at v and a (each (N, nv))."""
        if self.coupling is None:
            return self._of_all(q, v, a)
        q, v, a = self.coupling.positions(q), self.coupling.velocities(v), self.coupling.velocities(a)
        every, E = self._of_all(q, v, a), self.coupling.spread
        return InverseDynamics(every.tau @ E, *(E.T @ by @ E for by in (every.by_q, every.by_v, every.mass)))

    def _of_all(self, q: Array, v: Array, a: Array) -> InverseDynamics:
        """Compute the inverse dynamics of all n degrees of freedom."""
        moved, diagonal = self.compiled(q, v, a), np.arange(len(self.stiffness))
        moved.by_q[:, diagonal, diagonal] += self.stiffness
        moved.by_v[:, diagonal, diagonal] += self.damping
        moved.mass[:, diagonal, diagonal] += self.reflected
        stretched = np.where(self.free, 0.0, q[:, self.positions] - self.rest)
        tau = moved.tau + self.stiffness * stretched + self.damping * v + self.reflected * a
        return InverseDynamics(tau, moved.by_q, moved.by_v, moved.mass)


@dataclass(frozen=True, eq=False)
class ForwardDynamics:
    """Forward dynamics of a tree with an armature (n,) added to its inertia, in Drake's coordinates."""

    tree: CompiledTree
    armature: Array

    def accelerate(self, q: Array, v: Array, force: Array) -> tuple[Array, Array, Array, Array]:
        """Compute da/dq, da/dv, da/dforce (each (N, n, n)) and a (N, n) under generalized forces (N, n).

        The quaternions in q (N, nq) may have any norm. da/dq is with respect to the tangent. The results are NaN where
        the mass matrix is not positive definite.
        """
        by_q, by_v, inverse = np.empty((3, *v.shape, v.shape[1]))
        a = np.empty(v.shape)
        q, v, force, armature = (own_array(values) for values in (q, v, force, self.armature))
        tree_kernel.differentiate_acceleration(self.tree.tables, q, v, force, armature, by_q, by_v, inverse, a)
        return by_q, by_v, inverse, a

    def accelerate_one(self, q: Array, v: Array, force: Array) -> tuple[Array, Array, Array, Array]:
        """Compute `accelerate` for one state (nq,) and (nv,); the next call overwrites the results."""
        point, armature, (by_q, by_v, inverse, a) = self._buffers
        for buffer, values in zip(point, (q, v, force), strict=True):
            buffer[0] = values
        tree_kernel.differentiate_acceleration(self.tree.tables, *point, armature, by_q, by_v, inverse, a)
        return by_q[0], by_v[0], inverse[0], a[0]

    @cached_property
    def _buffers(self) -> tuple[tuple[Array, Array, Array], Array, tuple[Array, Array, Array, Array]]:
        """Buffers for one state: (q, v, forces), the armature, and (derivatives, acceleration)."""
        n, nq = self.tree.nv, self.tree.nq
        point = np.zeros((1, nq)), np.zeros((1, n)), np.zeros((1, n))
        results = np.empty((1, n, n)), np.empty((1, n, n)), np.empty((1, n, n)), np.empty((1, n))
        return point, own_array(self.armature), results

    def bend(self, q: Array, v: Array, a: Array, along: Array) -> tuple[Array, Array, Array, Array]:
        """Compute second derivatives of along' tau (N, n each), with tau the inverse dynamics: qq, vq, aq and vv.

        Each is (N, n, n). The tree may have hinges and slides only. The first three are differences of exact first
        derivatives. The last follows from the derivative of the mass matrix by the Christoffel symbols.
        """
        count, n = v.shape
        steps = SECOND_DIFFERENCE * np.maximum(1.0, np.abs(q))
        size = SECOND_DIFFERENCE / np.maximum(np.max(np.abs(along), axis=1), np.finfo(float).tiny)
        points = np.concatenate([q[:, None], q[:, None] + steps[:, :, None] * np.eye(n)], axis=1)
        points = np.concatenate([points, (q + size[:, None] * along)[:, None]], axis=1)
        moved_tree = self.tree(points.reshape(-1, n), np.repeat(v, n + 2, axis=0), np.repeat(a, n + 2, axis=0))
        first = np.stack(
            [values.reshape(count, n + 2, n, n) for values in (moved_tree.by_q, moved_tree.by_v, moved_tree.mass)],
            axis=2,
        )
        rates = np.einsum("ki,kjbim->kjbm", along, first[:, : n + 1])
        moved = np.diagonal(points[:, 1 : n + 1] - points[:, :1], axis1=1, axis2=2)
        slopes = (rates[:, 1:] - rates[:, :1]) / moved[..., None, None]
        by_qq, by_vq, by_aq = (slopes[:, :, i].swapaxes(1, 2) for i in range(3))
        twice = (first[:, -1, 2] - first[:, 0, 2]) / size[:, None, None]
        return by_qq, by_vq, by_aq, by_aq + by_aq.swapaxes(1, 2) - twice


def _links_of(model: Model, free: bool, body_forces: bool) -> list[Any] | Refusal:
    """Return all links of the model, or a Refusal that names the unsupported element."""
    plant = model.plant
    if model.forces:
        return Refusal("forces are added to Drake's")
    if model.systems_act and not (body_forces and model.body_forces and model.coupling is None):
        return Refusal(model.systems_act)
    kinds = ("revolute", "prismatic", "quaternion_floating") if free else ("revolute", "prismatic")
    for joint in sorted((j for j in joints(plant) if j.num_velocities()), key=lambda j: j.velocity_start()):
        if joint.type_name() not in kinds:
            return Refusal(f"joint {joint.name()} is of type {joint.type_name()}")
    springs = springs_of(plant)
    return springs if isinstance(springs, Refusal) else read_links(plant, springs)


def tree_of(model: Model, *, free: bool = False, body_forces: bool = False) -> TreeModel | Refusal:
    """Read the tree of a model without comparing it with Drake, or return a Refusal that names the unsupported element.

    The tree may have hinges and slides, and with `free` also free bodies. `body_forces` are no part of the tree.
    """
    every = _links_of(model, free, body_forces)
    if isinstance(every, Refusal):
        return every
    plant, n = model.plant, model.plant.num_velocities()
    gravity = np.array(plant.gravity_field().gravity_vector())
    compiled, (links, on, _) = compile_links(every, gravity, n), without_welds(every)
    if compiled is None:
        return Refusal("a free body is not joined to the world by its own frame")
    of_joints, positions, is_free = np.zeros((4, n)), np.zeros(n, dtype=np.intp), np.zeros(n, dtype=bool)
    for link in links:
        joint = link.joint
        of_joints[:, joint.v_start] = joint.stiffness, joint.rest, joint.damping, joint.armature
        if link.free:
            is_free[joint.v_start : joint.v_start + 6] = True
        else:
            positions[joint.v_start] = joint.q_start
    stiffness, rest, damping, reflected = of_joints
    return TreeModel(
        links, on, compiled, gravity, positions, is_free, stiffness, rest, damping, reflected, model.coupling
    )


def tree_for(model: Model) -> TreeModel | None:
    """Return the model's tree if it agrees with AutoDiffXd through Drake at two states, else None.

    The tree uses the model's own parameters. The result is None while other parameters are applied.
    """
    if model.has_other_parameters:
        return None

    def checked() -> TreeModel | None:
        tree = tree_of(model)
        if isinstance(tree, Refusal):
            return None
        random, here = np.random.default_rng(0), model.double.state()
        states = random.standard_normal((2, model.nx))
        same = all(_is_same(model, tree, x, random.standard_normal(model.nv)) for x in states)
        set_state(model.double, here)
        return tree if same else None

    return model.cache("tree", checked)


def _is_same(model: Model, tree: TreeModel, x: Array, a: Array) -> bool:
    n = model.nv
    set_state(model.autodiff, InitializeAutoDiff(x).ravel())
    exact = model.autodiff.inverse_dynamics(np.array([AutoDiffXd(entry) for entry in a])).reshape(-1, 1)
    ours = tree(x[None, :n], x[None, n:], a[None])
    stacked = np.column_stack([ours.tau[0], ours.by_q[0], ours.by_v[0]])
    wanted = np.column_stack([ExtractValue(exact).ravel(), gradient_rows(exact, 2 * n)])
    return bool(np.all(np.abs(stacked - wanted) <= SAME_TREE * max(1.0, float(np.abs(wanted).max()))))

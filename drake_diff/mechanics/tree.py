"""Inverse dynamics of a tree of hinges and slides, its derivatives and its mass matrix, for many states in one call.

    tau(q, v, a) = M(q) a + C(q, v) v - gravity - springs + D v + reflected inertia

With spatial vectors [angular; linear] in the world frame at its origin, S_j the motion of joint j, v_p and a_p those of
its parent body (a of the world being -g), and x the motion cross product, Singh, Russell and Wensing, "Efficient
analytical derivatives of rigid-body dynamics using spatial vector algebra" (2022) have

    P_j = v_p x S_j,   Q_j = a_p x S_j + v_p x P_j
    d tau_i / d q_j = S_i' (2 B_i P_j + I_i Q_j)               j an ancestor of i, or i
    d tau_j / d q_i = S_j' (2 B_i P_i + I_i Q_i + f_i x* S_i)   j an ancestor of i
    d tau_i / d v_j = S_i' (2 B_i S_j + 2 I_i P_j),   d tau_j / d v_i = S_j' (2 B_i S_i + 2 I_i P_i)

where I_i, f_i and 2 B_i are sums over the bodies that joint i carries, of their inertia, of their force and of
(v x*) I - I (v x) + (I v) x*. Drake places the bodies; the rest is NumPy over all states at once.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array, cross, skew
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.refusal import Refusal
from drake_diff.mechanics.description import read_links, springs_of, without_welds
from drake_diff.model.mimic import Coupling
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.step import set_state


@dataclass(frozen=True, eq=False)
class InverseDynamics:
    """tau (N, n) and its derivatives by q, by v and by a (each (N, n, n)) at N states."""

    tau: Array
    by_q: Array
    by_v: Array
    mass: Array


@dataclass(frozen=True, eq=False)
class TreeDynamics:
    """The constants of a tree: n joints of one degree of freedom, each carrying what is welded to its child."""

    bodies: list[Any]  # the child of each joint, in the order of the velocities
    ancestors: NDArray[np.bool_]  # (n, n): whether j carries i, or is i
    hinge: NDArray[np.bool_]  # (n,)
    axis: Array  # (n, 3) in the frame of the child
    origin: Array  # (n, 3) of the joint in it [m]
    mass: Array  # (n,) [kg]
    moment: Array  # (n, 3) mass times centre of mass [kg m]
    inertia: Array  # (n, 3, 3) about the child's origin [kg m^2]
    gravity: Array  # (3,)
    stiffness: Array  # (n,) of springs [N/m or N m/rad]
    rest: Array  # (n,) [m or rad]
    damping: Array  # (n,)
    reflected: Array  # (n,) rotor inertia times gear ratio squared
    coupling: Coupling | None  # where q, v and a are of the independent coordinates alone, and tau is along them

    def place(self, model: Model, q: Array) -> Array:
        """(N, n, 3, 4) the children's poses at q (N, nq), from Drake; the double context is left at the last."""
        return self.place_all(model, q if self.coupling is None else self.coupling.positions(q))

    def place_all(self, model: Model, q: Array) -> Array:
        """The same at the positions q (N, n) of all joints."""
        plant, context = model.plant, model.double.context
        poses = np.empty((*q.shape, 3, 4))
        for k, positions in enumerate(q):
            plant.SetPositions(context, positions)
            for i, body in enumerate(self.bodies):
                poses[k, i] = plant.EvalBodyPoseInWorld(context, body).GetAsMatrix34()
        return poses

    def __call__(self, poses: Array, q: Array, v: Array, a: Array) -> InverseDynamics:
        """Inverse dynamics at poses (N, n, 3, 4), q, v and a (each (N, nv))."""
        if self.coupling is None:
            return self._of_all(poses, q, v, a)
        q, v, a = self.coupling.positions(q), self.coupling.velocities(v), self.coupling.velocities(a)
        found, E = self._of_all(poses, q, v, a), self.coupling.spread
        return InverseDynamics(found.tau @ E, *(E.T @ by @ E for by in (found.by_q, found.by_v, found.mass)))

    @property
    def own_damping(self) -> Array:
        """(nv,) `damping` along the independent coordinates."""
        coupling = self.coupling
        return self.damping if coupling is None else np.asarray(coupling.forces(coupling.ratio_v * self.damping))

    def _of_all(self, poses: Array, q: Array, v: Array, a: Array) -> InverseDynamics:
        """Of all n joints."""
        S = self._motions(poses)
        inertia = self._inertias(poses)
        own, carried = np.eye(len(self.mass), dtype=bool), self.ancestors.astype(float)
        turning = S * v[..., None]
        V = carried @ turning
        cross_parent = _cross(V - turning)
        P = _times(cross_parent, S)
        added = S * a[..., None] + P * v[..., None]
        A = carried @ added
        A[..., 3:] -= self.gravity
        Q = _times(_cross(A - added), S) + _times(cross_parent, P)
        motion_cross = _cross(V)
        momentum = _times(inertia, V)
        force_cross = -np.swapaxes(motion_cross, -1, -2)
        force = _times(inertia, A) + _times(force_cross, momentum)
        B = force_cross @ inertia - inertia @ motion_cross + _cross_of_force(momentum)
        shape, up = inertia.shape, carried.T
        inertia_c = (up @ inertia.reshape(*shape[:2], 36)).reshape(shape)
        B_c = (up @ B.reshape(*shape[:2], 36)).reshape(shape)
        force_c = up @ force
        S_t, S_I = np.swapaxes(S, -1, -2), _times(inertia_c, S)
        S_B = _times(np.swapaxes(B_c, -1, -2), S)
        P_t, Q_t = np.swapaxes(P, -1, -2), np.swapaxes(Q, -1, -2)
        right_q = _times(B_c, P) + _times(inertia_c, Q) + _times(_cross_of_force(force_c), S)
        right_v = _times(B_c, S) + 2 * _times(inertia_c, P)
        below, above = self.ancestors, self.ancestors & ~own
        by_q = np.where(below, S_B @ P_t + S_I @ Q_t, 0) + np.swapaxes(np.where(above, right_q @ S_t, 0), -1, -2)
        by_v = np.where(below, S_B @ S_t + 2 * S_I @ P_t, 0) + np.swapaxes(np.where(above, right_v @ S_t, 0), -1, -2)
        lower = S_I @ S_t
        mass = np.where(below, lower, 0) + np.swapaxes(np.where(above, lower, 0), -1, -2)
        diagonal = np.arange(len(self.mass))
        by_q[:, diagonal, diagonal] += self.stiffness
        by_v[:, diagonal, diagonal] += self.damping
        mass[:, diagonal, diagonal] += self.reflected
        tau = (S * force_c).sum(axis=-1) + self.stiffness * (q - self.rest) + self.damping * v + self.reflected * a
        return InverseDynamics(tau, by_q, by_v, mass)

    def _motions(self, poses: Array) -> Array:
        """(N, n, 6) the motion of each joint at unit speed."""
        axis = _times(poses[..., :3], self.axis)
        through = _times(poses[..., :3], self.origin) + poses[..., 3]
        turn = np.concatenate([axis, cross(through, axis)], axis=-1)
        slide = np.concatenate([np.zeros_like(axis), axis], axis=-1)
        return np.where(self.hinge[:, None], turn, slide)

    def _inertias(self, poses: Array) -> Array:
        """(N, n, 6, 6) the spatial inertia of what each joint's child carries by welds, about the world's origin."""
        R, p, m = poses[..., :3], poses[..., 3], self.mass[:, None, None]
        moment = _times(R, self.moment)
        p_hat, moment_hat = skew(p), skew(moment)
        about_origin = R @ self.inertia @ np.swapaxes(R, -1, -2)
        about_origin -= p_hat @ moment_hat + moment_hat @ p_hat + m * (p_hat @ p_hat)
        coupling = moment_hat + m * p_hat
        inertia = np.zeros((*p.shape[:-1], 6, 6))
        inertia[..., :3, :3] = about_origin
        inertia[..., :3, 3:] = coupling
        inertia[..., 3:, :3] = -coupling
        inertia[..., 3:, 3:] = m * np.eye(3)
        return inertia


def _times(matrices: Array, vectors: Array) -> Array:
    """Matrices (..., m, k) times vectors (..., k)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _cross(motion: Array) -> Array:
    """(..., 6, 6): the motion cross product with [w; l], [w^ 0; l^ w^]."""
    matrix = np.zeros((*motion.shape, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = skew(motion[..., :3])
    matrix[..., 3:, :3] = skew(motion[..., 3:])
    return matrix


def _cross_of_force(force: Array) -> Array:
    """(..., 6, 6): m -> m x* f for a fixed force f = [n; l], [-n^ -l^; -l^ 0]."""
    matrix = np.zeros((*force.shape, 6))
    linear = -skew(force[..., 3:])
    matrix[..., :3, :3] = -skew(force[..., :3])
    matrix[..., :3, 3:] = matrix[..., 3:, :3] = linear
    return matrix


def tree_of(model: Model) -> TreeDynamics | Refusal:
    """The tree of a model as it is read, not yet compared with Drake; a Refusal that names what in it is no tree."""
    plant = model.plant
    if model.forces:
        return Refusal("forces are added to Drake's")
    if model.systems_act:
        return Refusal(model.systems_act)
    moving = sorted((j for j in joints(plant) if j.num_velocities()), key=lambda j: j.velocity_start())
    for joint in moving:
        if joint.type_name() not in ("revolute", "prismatic"):
            return Refusal(f"joint {joint.name()} is of type {joint.type_name()}")
    springs = springs_of(plant)
    if isinstance(springs, Refusal):
        return springs
    by_tree, _, _ = without_welds(read_links(plant, springs))
    ancestors = np.eye(len(moving), dtype=bool)
    for link in by_tree:  # parents come first
        if link.parent >= 0:
            ancestors[link.joint.v_start] |= ancestors[by_tree[link.parent].joint.v_start]
    links = sorted(by_tree, key=lambda link: link.joint.v_start)
    frames = [link.joint.on_child for link in links]
    turns = np.array([frame.rotation().matrix() for frame in frames])
    mass = np.array([link.mass for link in links])
    center = np.array([frame @ link.center_of_mass for frame, link in zip(frames, links, strict=True)])
    to_center = skew(center)
    central = turns @ np.array([link.inertia for link in links]) @ np.swapaxes(turns, -1, -2)
    return TreeDynamics(
        bodies=[joint.child_body() for joint in moving],
        ancestors=ancestors,
        hinge=np.array([link.joint.kind == "revolute" for link in links]),
        axis=_times(turns, np.array([link.axis for link in links])),
        origin=np.array([frame.translation() for frame in frames]),
        mass=mass,
        moment=mass[:, None] * center,
        inertia=central - mass[:, None, None] * (to_center @ to_center),
        gravity=np.array(plant.gravity_field().gravity_vector()),
        stiffness=np.array([link.joint.stiffness for link in links]),
        rest=np.array([link.joint.rest for link in links]),
        damping=np.array([link.joint.damping for link in links]),
        reflected=np.array([link.joint.armature for link in links]),
        coupling=model.coupling,
    )


SAME_TREE = 1e-11  # of the largest entry: these formulas and AutoDiffXd differ by rounding


def tree_for(model: Model) -> TreeDynamics | None:
    """The model's tree where it gives at two states what AutoDiffXd through Drake gives; None where it has no such.

    It is that of the model's own parameters: while others are applied there is none.
    """
    if model.has_other_parameters:
        return None

    def checked() -> TreeDynamics | None:
        tree = tree_of(model)
        if isinstance(tree, Refusal):
            return None
        random, here = np.random.default_rng(0), model.double.state()
        states = random.standard_normal((2, model.nx))
        same = all(_is_same(model, tree, x, random.standard_normal(model.nv)) for x in states)
        set_state(model.double, here)
        return tree if same else None

    return model.cache("tree", checked)


def _is_same(model: Model, tree: TreeDynamics, x: Array, a: Array) -> bool:
    n = model.nv
    set_state(model.autodiff, InitializeAutoDiff(x).ravel())
    exact = model.autodiff.inverse_dynamics(np.array([AutoDiffXd(entry) for entry in a])).reshape(-1, 1)
    ours = tree(tree.place(model, x[None, :n]), x[None, :n], x[None, n:], a[None])
    found = np.column_stack([ours.tau[0], ours.by_q[0], ours.by_v[0]])
    wanted = np.column_stack([ExtractValue(exact).ravel(), gradient_rows(exact, 2 * n)])
    return bool(np.all(np.abs(found - wanted) <= SAME_TREE * max(1.0, float(np.abs(wanted).max()))))

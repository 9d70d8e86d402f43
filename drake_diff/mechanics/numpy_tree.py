"""Inverse dynamics of a tree, its derivatives and its mass matrix, for many states in one call.

    tau(q, v, a) = M(q) a + C(q, v) v - gravity - springs + D v + reflected inertia

Spatial vectors are [angular; linear] in the world frame at its origin. A joint K moves its body by the columns s of
S_K, which the body P before it carries along: a hinge, a slide, and a free body's three slides and, after them, its
turn about world axes. With V_P and V_K the velocities before and after the joint, A_K the acceleration after it (of the
world -g), x the motion cross product and

    P_s = V_K x s,   T_s = (V_P + V_K) x s,   Q_s = A_K x s + V_K x P_s

the force F on all that joint K carries changes along s, and with the speed along s, by

    I Q_s + B P_s + s x* F,   I T_s + B s

where I, F and B are sums over the bodies that K carries, of their inertia, of their force and of
(v x*) I - I (v x) + (I v) x*. The force of joint i is S_i' times that change of what the lower of the two joints
carries, but without s x* F where i is below, as its axes turn with it. With joints of one degree of freedom these are
the formulas of Singh, Russell and Wensing, "Efficient analytical derivatives of rigid-body dynamics using spatial
vector algebra" (2022). Derivatives by q are by small motion: for a free body by its turn in world and by its shift.
Drake places the bodies; the rest is NumPy over all states at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array, Indices, cross, skew
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.refusal import Refusal
from drake_diff.mechanics.compiled_tree import CompiledTree
from drake_diff.mechanics.description import RigidLink, read_links, springs_of, without_welds
from drake_diff.model.mimic import Coupling
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.step import set_state


def poses_of(model: Model, bodies: Sequence[Any], q: Array) -> Array:
    """(N, len(bodies), 3, 4) poses of Drake's bodies at q (N, nq); the double context is left at the last."""
    plant, context = model.plant, model.double.context
    own = {body.index(): body for body in bodies}
    order = {index: i for i, index in enumerate(own)}
    poses = np.empty((len(q), len(own), 3, 4))
    for k, positions in enumerate(q):
        plant.SetPositions(context, positions)
        for i, body in enumerate(own.values()):
            poses[k, i] = plant.EvalBodyPoseInWorld(context, body).GetAsMatrix34()
    return np.take(poses, [order[body.index()] for body in bodies], axis=1)


@dataclass(frozen=True, eq=False)
class InverseDynamics:
    """tau (N, n) and its derivatives by q, by v and by a (each (N, n, n)) at N states."""

    tau: Array
    by_q: Array
    by_v: Array
    mass: Array


@dataclass(frozen=True, eq=False)
class Moving:
    """A tree at N states that move; what is of each degree of freedom is of what its joint carries."""

    tree: "TreeDynamics"
    poses: Array  # (N, n, 3, 4)
    S: Array  # (N, n, 6) the motion of each at unit speed
    v: Array  # (N, n)
    inertia: Array  # (N, n, 6, 6) of the bodies alone
    carried_inertia: Array  # (N, n, 6, 6)
    carried_B: Array  # (N, n, 6, 6)
    V: Array  # (N, n, 6) after the joint
    before: Array  # (N, n, 6) V_P x S, by which the axes move
    P: Array
    force_cross: Array  # (N, n, 6, 6) V x*

    @property
    def mass(self) -> Array:
        """M (N, n, n), reflected inertia left out."""
        lower = _times(self.carried_inertia, self.S) @ np.swapaxes(self.S, -1, -2)
        below, together = self.tree.strictly_below, self.tree.together
        return np.asarray(np.where(below | together, lower, 0) + np.swapaxes(np.where(below, lower, 0), -1, -2))

    def forces(self, a: Array) -> tuple[Array, Array, Array]:
        """tau (N, n) at a (N, n), springs, damping and reflected inertia left out; A and what is carried of F."""
        added = self.S * a[..., None] + self.before * self.v[..., None]
        A = self.tree.ancestors.astype(float) @ added
        A[..., 3:] -= self.tree.gravity
        force = _times(self.inertia, A) + _times(self.force_cross, _times(self.inertia, self.V))
        carried = self.tree.ancestors.T.astype(float) @ force
        return (self.S * carried).sum(axis=-1), A, carried

    def derivatives(self, a: Array) -> tuple[Array, Array, Array]:
        """tau (N, n) as by `forces`, and its derivatives by small motion and by v (each (N, n, n))."""
        tau, A, force = self.forces(a)
        S, P, I_c, B_c = self.S, self.P, self.carried_inertia, self.carried_B
        below, carries = self.tree.strictly_below, self.tree.ancestors
        Q, T = _cross_each(A, S) + _cross_each(self.V, P), self.before + P
        S_t, S_I, S_B = np.swapaxes(S, -1, -2), _times(I_c, S), _times(np.swapaxes(B_c, -1, -2), S)
        by_q = _times(B_c, P) + _times(I_c, Q) + _times(_cross_of_force(force), S)
        by_v = _times(B_c, S) + _times(I_c, T)
        P_t, Q_t, T_t = (np.swapaxes(each, -1, -2) for each in (P, Q, T))
        return (
            tau,
            np.where(below, S_B @ P_t + S_I @ Q_t, 0) + np.swapaxes(np.where(carries, by_q @ S_t, 0), -1, -2),
            np.where(below, S_B @ S_t + S_I @ T_t, 0) + np.swapaxes(np.where(carries, by_v @ S_t, 0), -1, -2),
        )


@dataclass(frozen=True, eq=False)
class TreeDynamics:
    """The constants of a tree of n degrees of freedom, each with what its joint's child carries by welds.

    Those of a free body are six, of which the first turn it; its inertia is with the first, no other has any.
    """

    bodies: list[Any]  # the child of each joint, in the order of the velocities
    ancestors: NDArray[np.bool_]  # (n, n): whether the joint of j carries that of i, or is the same
    together: NDArray[np.bool_]  # (n, n): whether both are of one joint
    positions: Indices  # (n,) in q, 0 for free bodies, which have no springs
    free: NDArray[np.bool_]  # (n,) of free bodies, whose axes are in world
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

    @property
    def strictly_below(self) -> NDArray[np.bool_]:
        """(n, n) whether the joint of j carries that of i, and is another."""
        return np.asarray(self.ancestors & ~self.together)

    def place(self, model: Model, q: Array) -> Array:
        """(N, n, 3, 4) the children's poses at q (N, nq), from Drake; the double context is left at the last."""
        return self.place_all(model, q if self.coupling is None else self.coupling.positions(q))

    def place_all(self, model: Model, q: Array) -> Array:
        """The same at the positions q (N, nq) of all joints."""
        return poses_of(model, self.bodies, q)

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

    def moving(self, poses: Array, v: Array) -> Moving:
        """The tree with its bodies at poses (N, n, 3, 4), moving at v (N, n)."""
        S, inertia = self._motions(poses), self._inertias(poses)
        turning = S * v[..., None]
        V = self.ancestors.astype(float) @ turning
        before = _cross_each(self.strictly_below.astype(float) @ turning, S)
        motion_cross = _cross(V)
        force_cross = -np.swapaxes(motion_cross, -1, -2)
        B = force_cross @ inertia - inertia @ motion_cross + _cross_of_force(_times(inertia, V))
        shape, up = inertia.shape, self.ancestors.T.astype(float)
        I_c, B_c = ((up @ each.reshape(*shape[:2], 36)).reshape(shape) for each in (inertia, B))
        return Moving(self, poses, S, v, inertia, I_c, B_c, V, before, _cross_each(V, S), force_cross)

    def _of_all(self, poses: Array, q: Array, v: Array, a: Array) -> InverseDynamics:
        """Of all n degrees of freedom."""
        moving = self.moving(poses, v)
        tau, by_q, by_v = moving.derivatives(a)
        mass, diagonal = moving.mass, np.arange(len(self.mass))
        by_q[:, diagonal, diagonal] += self.stiffness
        by_v[:, diagonal, diagonal] += self.damping
        mass[:, diagonal, diagonal] += self.reflected
        stretched = q[:, self.positions] - self.rest
        return InverseDynamics(
            tau + self.stiffness * stretched + self.damping * v + self.reflected * a, by_q, by_v, mass
        )

    def _motions(self, poses: Array) -> Array:
        """(N, n, 6) the motion of each joint at unit speed."""
        axis = np.where(self.free[:, None], self.axis, _times(poses[..., :3], self.axis))
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


def _cross_each(motion: Array, other: Array) -> Array:
    """(..., 6): motion x other."""
    w, of = motion[..., :3], other[..., :3]
    return np.concatenate([cross(w, of), cross(w, other[..., 3:]) + cross(motion[..., 3:], of)], axis=-1)


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


@dataclass(frozen=True, eq=False)
class OwnDynamics:
    """Accelerations of a tree with an armature (n,) beside its inertia, in Drake's own coordinates."""

    tree: TreeDynamics
    model: Model
    armature: Array
    compiled: CompiledTree | None = None

    def accelerate(self, q: Array, v: Array, force: Array) -> tuple[Array, Array, Array, Array]:
        """da/dq, da/dv, da/dforce (each (N, n, n)) and a (N, n) under generalized forces (N, n).

        q (N, nq), whose quaternions may be of any norm; its derivative is by small motion.
        """
        if self.compiled is not None:
            at_rest = self.compiled(q, v, np.zeros_like(v))
            inverse = np.asarray(np.linalg.inv(at_rest.mass + np.diag(self.armature)), dtype=float)
            a = _times(inverse, force - at_rest.tau)
            moved = self.compiled(q, v, a)
            return -inverse @ moved.by_q, -inverse @ moved.by_v, inverse, a
        moving, a, inverse = self._solved(q, v, force)
        _, by_q, by_v = moving.derivatives(a)
        return -inverse @ by_q, -inverse @ by_v, inverse, a

    def accelerate_one(self, q: Array, v: Array, force: Array) -> tuple[Array, Array, Array, Array]:
        """As `accelerate`, of one state (nq,) and (nv,)."""
        by_q, by_v, inverse, a = self.accelerate(q[None], v[None], force[None])
        return by_q[0], by_v[0], inverse[0], a[0]

    def motions(self, q: Array, v: Array, force: Array) -> tuple[Array, Array, Array]:
        """(N, n, 6) the motion [linear; angular] of each degree of freedom in world, about its origin, at unit speed.

        And (N, n, 6, 6) the spatial inertia of what it carries, and a (N, n).
        """
        moving, a, _ = self._solved(q, v, force)
        swap = np.r_[3:6, 0:3]
        return moving.S[..., swap], moving.carried_inertia[..., swap[:, None], swap], a

    def _solved(self, q: Array, v: Array, force: Array) -> tuple[Moving, Array, Array]:
        moving = self.tree.moving(self.tree.place_all(self.model, q), v)
        inertia = moving.mass + np.diag(self.armature)
        inverse = np.asarray(np.linalg.inv(inertia), dtype=float)
        bias, _, _ = moving.forces(np.zeros_like(v))
        return moving, _times(inverse, force - bias), inverse


def _links_of(model: Model, free: bool) -> tuple[RigidLink, ...] | Refusal:
    """The moving links, every parent before its children; a Refusal that names what is none."""
    plant = model.plant
    if model.forces:
        return Refusal("forces are added to Drake's")
    if model.systems_act:
        return Refusal(model.systems_act)
    kinds = ("revolute", "prismatic", "quaternion_floating") if free else ("revolute", "prismatic")
    for joint in sorted((j for j in joints(plant) if j.num_velocities()), key=lambda j: j.velocity_start()):
        if joint.type_name() not in kinds:
            return Refusal(f"joint {joint.name()} is of type {joint.type_name()}")
    springs = springs_of(plant)
    if isinstance(springs, Refusal):
        return springs
    by_tree, _, _ = without_welds(read_links(plant, springs))
    for link in by_tree:
        own = all(pose.IsExactlyIdentity() for pose in (link.joint.on_parent, link.joint.on_child))
        if link.free and (link.parent >= 0 or not own):
            return Refusal(f"the free body of joint {link.joint.joint} is not joined to the world by its own frame")
    return by_tree


def _carrying(
    links: tuple[RigidLink, ...], of: Indices, slides: NDArray[np.bool_], turns: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """`ancestors` and `together` of TreeDynamics: `of` (n,) has the link of each, of free bodies slides move turns."""
    of_links = np.eye(len(links), dtype=bool)
    for i, link in enumerate(links):  # parents come first
        if link.parent >= 0:
            of_links[i] |= of_links[link.parent]
    one_link = of[:, None] == of
    ancestors = of_links[np.ix_(of, of)] & ~(one_link & slides[:, None] & turns)
    return ancestors, one_link & (turns[:, None] == turns)


def tree_of(model: Model, *, free: bool = False) -> TreeDynamics | Refusal:
    """The tree of a model as it is read, not yet compared with Drake; a Refusal that names what in it is no tree.

    Of hinges and slides, and of `free` bodies where they are asked for.
    """
    by_tree = _links_of(model, free)
    if isinstance(by_tree, Refusal):
        return by_tree
    order = sorted(range(len(by_tree)), key=lambda i: by_tree[i].joint.v_start)
    links, counts = [by_tree[i] for i in order], [6 if by_tree[i].free else 1 for i in order]
    first = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)
    within = np.arange(sum(counts)) - np.repeat(first, counts)
    is_free = np.repeat([link.free for link in links], counts)
    turns_free = is_free & (within < 3)
    ancestors, together = _carrying(by_tree, np.repeat(order, counts), is_free & ~turns_free, turns_free)
    axis = np.repeat([link.joint.on_child.rotation() @ link.axis for link in links], counts, axis=0)
    axis[is_free] = np.eye(3)[within[is_free] % 3]

    def spread(values: list[Any]) -> Array:
        """Of each degree of freedom (n, ...): the link's own with its first, else 0."""
        found = np.zeros((len(within), *np.shape(values[0])))
        found[first] = values
        return found

    moving = sorted((j for j in joints(model.plant) if j.num_velocities()), key=lambda j: j.velocity_start())
    frames = [link.joint.on_child for link in links]
    turns = np.array([frame.rotation().matrix() for frame in frames])
    mass = np.array([link.mass for link in links])
    center = np.array([frame @ link.center_of_mass for frame, link in zip(frames, links, strict=True)])
    to_center = skew(center)
    central = turns @ np.array([link.inertia for link in links]) @ np.swapaxes(turns, -1, -2)
    return TreeDynamics(
        bodies=[body for joint, count in zip(moving, counts, strict=True) for body in count * [joint.child_body()]],
        ancestors=ancestors,
        together=together,
        positions=np.where(is_free, 0, np.repeat([link.joint.q_start for link in links], counts)),
        free=is_free,
        hinge=np.repeat([link.joint.kind == "revolute" for link in links], counts) | turns_free,
        axis=axis,
        origin=np.repeat([frame.translation() for frame in frames], counts, axis=0),
        mass=spread(list(mass)),
        moment=spread(list(mass[:, None] * center)),
        inertia=spread(list(central - mass[:, None, None] * (to_center @ to_center))),
        gravity=np.array(model.plant.gravity_field().gravity_vector()),
        stiffness=spread([link.joint.stiffness for link in links]),
        rest=spread([link.joint.rest for link in links]),
        damping=spread([link.joint.damping for link in links]),
        reflected=spread([link.joint.armature for link in links]),
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

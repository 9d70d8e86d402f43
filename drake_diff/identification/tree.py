"""The equations of motion of a tree at many states, as functions of the numbers that parameters set.

The force of inverse dynamics is linear in each link's ten numbers: mass, mass times centre of mass, inertia about the
frame's origin. So is it in damping, stiffness, friction and gravity, and

    da / dnumber = M^-1 (d force / dnumber - d inverse dynamics / dnumber)   at fixed q, v and a.

A shift of a joint on its parent is the motion of a virtual slide without mass that is put before the joint and does not
move: its derivative is that by the slide's coordinate. `kernel` and `coulomb_friction` have the formulas.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import DOP853

from drake_diff._base.arrays import Array, Indices, own_array, skew
from drake_diff._base.compiled import kernel
from drake_diff._base.values import Refusal
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.mechanics.description import Link, RigidLink, coordinates_of, read_links, springs_of
from drake_diff.mechanics.tree import tree_of
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators
from drake_diff.model.repairs import Coupling

KERNEL = "drake_diff.identification.kernel"
FRICTION = "drake_diff.identification.coulomb_friction"
TREE = "drake_diff.mechanics.tree_kernel"
INERTIA = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # xx yy zz xy xz yz
SLIP_SPEED = 0.02  # [rad/s or m/s] over which friction turns where it is smooth
Mask = NDArray[np.bool_]
Method = tuple[Array, Array]  # of Runge and Kutta: (m, m) its stages, (m,) its weights
ORDER_8: Method = (np.array(DOP853.A[: len(DOP853.B), : len(DOP853.B)]), np.array(DOP853.B))
ORDER_4: Method = (np.diag([0.5, 0.5, 1.0], -1), np.array([1, 2, 2, 1]) / 6)


@dataclass(frozen=True, eq=False)
class Numbers:
    """What parameters set, of L moving links and n degrees of freedom; complex where a derivative is taken by it."""

    inertial: Any  # (L, 10) mass, mass times centre, xx yy zz xy xz yz about the origin, in the joint's frame
    offset: Any  # (L, 3) [m] of the joint's frame on the link before it
    gravity: Any  # (3,)
    damping: Any  # (n,)
    reflected: Any  # (n,) rotor inertia times gear ratio squared
    stiffness: Any  # (n,)
    rest: Any  # (n,)
    coulomb: Any  # (n,) dry friction [N or N m]
    held_inertia: Any  # (n,) by which friction that gives way holds a joint, beside a damping
    held_damping: Any  # (n,)
    strength: Any  # (nu,) what an input is multiplied by

    @property
    def flat(self) -> Any:
        """All of them (count,), one after the other."""
        return np.concatenate([np.ravel(getattr(self, name)) for name in self.__dataclass_fields__])

    def places(self, name: str) -> Indices:
        """Where those called `name` stand in `flat`, in their own shape."""
        start = 0
        for other in self.__dataclass_fields__:
            values = getattr(self, other)
            if other == name:
                return start + np.arange(np.size(values)).reshape(np.shape(values))
            start += np.size(values)
        raise KeyError(name)


@dataclass(frozen=True, eq=False)
class Tree:
    """The tree of a model: what stays where parameters change."""

    links: tuple[RigidLink, ...]  # parents first
    coordinates: Coordinates  # of the independent joints
    coupling: Coupling | None  # of joints that follow others
    n: int  # degrees of freedom of all joints
    actuation: Array  # (n, nu)
    limits: Array  # (nu,) what Drake cuts each input at
    placed: Mapping[str, tuple[int, Any]]  # by body: the link it belongs to, and the pose of the body in its frame
    moved_by: Mapping[str, Array]  # (10, 10) by body: its ten numbers in the frame of its link
    bodies: Mapping[str, Link]
    numbers: Numbers  # the model's own

    @property
    def first(self) -> Indices:
        """(L,) of each link, its first degree of freedom."""
        return np.array([link.joint.v_start for link in self.links], dtype=np.intp)

    @cached_property
    def spread(self) -> Array:
        """(n, nv) velocities of all joints by the independent ones."""
        return np.eye(self.n) if self.coupling is None else np.asarray(self.coupling.spread, dtype=float)


@dataclass(frozen=True, eq=False)
class Dynamics:
    """A tree with these numbers; Coulomb friction holds the coordinates that are `dry`, else it turns over a speed."""

    tree: Tree
    numbers: Numbers
    dry: tuple[int, ...] = ()
    gives: bool = False  # whether it gives way, of one joint
    method: Method = ORDER_8

    def run(self, xs: Array, hs: Array, us: Array) -> None:
        """Fill xs (K, M+1, nx), which has the starts, by steps of hs (K, M) [s] under us (K, M, nu)."""
        kernel(FRICTION).run(*self._system(), own_array(hs), self._effort(us), xs, np.empty((0, 0, 0, 0)))

    def step_jacobians(self, xs: Array, hs: Array, us: Array, by: Array) -> Array:
        """(K, M, nx, nx + P) of each of these steps; `by` (count, P) is how the numbers change with parameters."""
        nx = xs.shape[2]
        jacobians = np.empty((*hs.shape, nx, nx + by.shape[1]))
        kernel(FRICTION).run(*self._system(by), own_array(hs), self._effort(us), own_array(xs), jacobians)
        return jacobians

    def accelerate(self, x: Array, u: Array) -> Array:
        """(N, nv) at x (N, nx) under u (N, nu)."""
        return self._accelerations(x, u, None)[0]

    def acceleration_jacobians(self, x: Array, u: Array, by: Array) -> tuple[Array, Array]:
        """(N, nv), and (N, nv, 2 nv + P) by small motion, by v and by parameters."""
        a, jacobians, _, _ = self._accelerations(x, u, by)
        return a, jacobians

    def grip(self, x: Array, u: Array) -> tuple[Array, Array]:
        """(N, nv) which way friction lets coordinates slide, and which of them it holds."""
        return self._accelerations(x, u, None)[2:]

    def _accelerations(self, x: Array, u: Array, by: Array | None) -> tuple[Array, Array, Array, Array]:
        N, nv = len(x), self.tree.spread.shape[1]
        a, turn, held = np.empty((N, nv)), np.zeros((N, nv)), np.zeros((N, nv))
        jacobians = np.empty((0, 0, 0)) if by is None else np.empty((N, nv, 2 * nv + by.shape[1]))
        kernel(FRICTION).accelerations(*self._system(by), own_array(x), self._effort(u), turn, held, a, jacobians)
        return a, jacobians, turn, held

    def inverse_dynamics(self, q: Array, v: Array, a: Array, by: Array | None = None) -> tuple[Array, Array, Array]:
        """tau (N, n) of the links, mass (N, n, n), and tau by small motion, by v and by parameters (N, n, 2 n + P).

        At q, v and a of all joints, those that follow others included.
        """
        system, changes = self._system(by)
        N, n = v.shape
        tau, mass, jacobians = np.empty((N, n)), np.empty((N, n, n)), np.empty((N, n, 2 * n + changes.parameters))
        kernel(KERNEL).inverse_dynamics(system, changes, *map(own_array, (q, v, a)), tau, mass, jacobians)
        return tau, mass, jacobians

    def regressors(self, q: Array, v: Array, a: Array) -> list[Array]:
        """Of each link (N nv, 10): the force of inverse dynamics at q, v and a (N, nv) by its ten numbers."""
        tree, spread = self.tree, self.tree.spread
        places = self.numbers.places("inertial")
        by = np.eye(len(self.numbers.flat))[:, places.ravel()]
        q = q if tree.coupling is None else tree.coupling.positions(q)
        of_joints = self.inverse_dynamics(q, v @ spread.T, a @ spread.T, by)[2][..., 2 * tree.n :]
        reduced = (spread.T @ of_joints).reshape(-1, len(tree.links), 10)
        return [reduced[:, i] for i in range(len(tree.links))]

    @property
    def efforts(self) -> Array:
        """(nv, nu) the generalized force by the inputs."""
        return np.asarray(self.tree.spread.T @ (self.tree.actuation * self.numbers.strength))

    def inputs_for(self, x: Array, a: Array) -> Array:
        """(N, nu) the inputs that give accelerations a (N, nv), the nearest where none do; limits are not looked at."""
        nv, none = a.shape[1], np.zeros((len(x), self.tree.actuation.shape[1]))
        _, mass, free = self._equations(x, none)
        needed = (mass @ (a - free)[..., None])[..., 0]
        return np.asarray(needed.reshape(-1, nv) @ np.linalg.pinv(self.efforts).T)

    def _equations(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """x, the mass matrix (N, nv, nv) with reflected inertia, and the acceleration (N, nv) under u."""
        tree, nv = self.tree, self.tree.spread.shape[1]
        q = x[:, : x.shape[1] - nv]
        q = q if tree.coupling is None else tree.coupling.positions(q)
        still = np.zeros((len(x), tree.n))
        mass = self.inverse_dynamics(q, still, still)[1] + np.diag(self.numbers.reflected)
        return x, tree.spread.T @ mass @ tree.spread, self.accelerate(x, u)

    def mass(self, x: Array) -> Array:
        """(N, nv, nv) with reflected inertia."""
        return self._equations(x, np.zeros((len(x), self.tree.actuation.shape[1])))[1]

    def _effort(self, u: Array) -> Array:
        return np.ascontiguousarray(np.clip(u, -self.tree.limits, self.tree.limits))

    def _system(self, by: Array | None = None) -> tuple[Any, Any]:
        """A `kernel.System`, and `kernel.Changes` by parameters that move the numbers by `by` (count, P)."""
        if by is None:
            return self._fixed
        shifted = np.flatnonzero(np.any(by[self.numbers.places("offset")] != 0, axis=(1, 2)))
        if not len(shifted):
            system, _ = self._fixed
            return system, self._changes(by, system, ())
        system = self._tables(tuple(int(i) for i in shifted))
        return system, self._changes(by, system, tuple(int(i) for i in shifted))

    @cached_property
    def _fixed(self) -> tuple[Any, Any]:
        system = self._tables(())
        return system, self._changes(np.zeros((len(self.numbers.flat), 0)), system, ())

    def _tables(self, shifted: tuple[int, ...]) -> Any:
        """With three virtual slides before each joint that is shifted."""
        tree, numbers, compiled, t = self.tree, self.numbers, kernel(KERNEL), kernel(TREE)
        rows, joints = list[tuple[Any, ...]](), list[tuple[int, int, int]]()
        table_of, joint_of = list[int](), list[int]()
        n, nq = tree.n, sum(7 if link.free else 1 for link in tree.links)
        kinds = {"revolute": t.HINGE, "prismatic": t.SLIDE, "quaternion_floating": t.FREE}
        for i, link in enumerate(tree.links):
            parent, joint = (-1, -1) if link.parent < 0 else (table_of[link.parent], joint_of[link.parent])
            for k in range(3) if i in shifted else ():
                index = 3 * shifted.index(i) + k
                joints.append((joint, n + index, 1))
                joint = len(joints) - 1
                rows.append((parent, t.SLIDE, joint, nq + index, n + index, np.eye(3)[k], np.eye(3, 4), np.zeros(10)))
                parent = len(rows) - 1
            for start in (3, 0) if link.free else (0,):
                joints.append((joint, link.joint.v_start + start, 3 if link.free else 1))
                joint = len(joints) - 1
            frame = np.hstack([link.on_parent.rotation().matrix(), numbers.offset[i][:, None]])
            starts = link.joint.q_start, link.joint.v_start
            rows.append((parent, kinds[link.joint.kind], joint, *starts, link.axis, frame, numbers.inertial[i]))
            table_of.append(len(rows) - 1)
            joint_of.append(joint)
        parents, kind, joint_at, q_start, v_start, axis, frames, ten = (np.array(c) for c in zip(*rows, strict=True))
        mass = ten[:, 0]
        center = ten[:, 1:4] / np.where(mass != 0, mass, 1.0)[:, None]
        inertia = np.empty((len(mass), 3, 3))
        for k, (i, j) in enumerate(INERTIA):
            inertia[:, i, j] = inertia[:, j, i] = ten[:, 4 + k]
        inertia += mass[:, None, None] * (skew(center) @ skew(center))  # about the centre of mass
        identity = np.broadcast_to(np.eye(3, 4), frames.shape)
        chain = (np.array(column) for column in zip(*joints, strict=True))
        tables = (
            parents, kind, joint_at, q_start, v_start, axis, frames, identity, mass, center, inertia, *chain,
            numbers.gravity,
        )  # fmt: skip
        positions = np.zeros(n, dtype=np.int64)
        for link in tree.links:
            if not link.free:
                positions[link.joint.v_start] = link.joint.q_start
        coupling, coordinates = tree.coupling, tree.coordinates
        plain = np.arange(nq), np.ones(nq), np.zeros(nq)
        follow = plain if coupling is None else (coupling.of_q, coupling.ratio_q, coupling.offset)
        return compiled.System(
            t.Tree(*map(_array, tables)),
            _array(ten),
            *map(_array, follow),
            _array(tree.spread),
            _array(np.array(coordinates.single, dtype=np.int64).reshape(-1, 2)),
            _array(np.array(coordinates.free, dtype=np.int64).reshape(-1, 2)),
            positions,
            *(_array(getattr(numbers, name)) for name in OF_JOINTS),
            SLIP_SPEED,
            _array(tree.actuation * numbers.strength),
            np.isin(np.arange(tree.spread.shape[1]), self.dry),
            self.gives,
            *map(_array, self.method),
        )

    def _changes(self, by: Array, system: Any, shifted: tuple[int, ...]) -> Any:
        places = self.numbers.places
        ten = by[places("inertial")]
        links, parameters = np.nonzero(np.any(ten != 0, axis=1))
        real = np.flatnonzero(system.tree.v_start < self.tree.n)
        return kernel(KERNEL).Changes(
            by.shape[1],
            _array(real[links]),
            _array(parameters),
            _array(ten[links, :, parameters]),
            _array(by[places("gravity")].T),
            _array(by[places("offset")[list(shifted)].ravel()]),
            *(_array(by[places(name)]) for name in (*OF_JOINTS, "strength")),
            _array(self.tree.actuation),
        )


OF_JOINTS = ("reflected", "damping", "stiffness", "rest", "coulomb", "held_inertia", "held_damping")


def _array(values: Any) -> Any:
    """Contiguous, of float64 or int64: of other arrays the kernel would be compiled once more."""
    array = np.asarray(values)
    return np.array(array, dtype=np.int64 if array.dtype.kind == "i" else float, order="C")


def tree_for_identification(model: Model) -> Tree | Refusal:
    """The tree of a model's own values; a Refusal that says what in it moves otherwise."""
    if model.num_constraints:
        return Refusal("joints are held by constraints")
    if any(actuator.has_controller() for actuator in actuators(model.plant)):
        return Refusal("actuators have PD controllers in the plant")
    dynamics, springs = tree_of(model, free=True), springs_of(model.plant)
    if isinstance(dynamics, Refusal):
        return dynamics
    if isinstance(springs, Refusal):
        return springs
    every, links, placed = read_links(model.plant, springs), dynamics.links, dynamics.on
    if any(link.stiffness != 0 and link.kind == "quaternion_floating" for link in every):
        raise ModelError("a free body has a spring")
    n, inertial = len(dynamics.damping), np.zeros((len(links), 10))
    for link in every:
        index, pose = placed[link.body]
        if index >= 0:
            body_numbers = ten_numbers(link.mass, link.center_of_mass, link.inertia[tuple(np.transpose(INERTIA))])
            inertial[index] += _moved_by(pose) @ body_numbers
    numbers = Numbers(
        inertial=inertial,
        offset=np.array([link.on_parent.translation() for link in links]).reshape(-1, 3),
        gravity=dynamics.gravity,
        damping=dynamics.damping,
        reflected=dynamics.reflected,
        stiffness=dynamics.stiffness,
        rest=dynamics.rest,
        coulomb=np.zeros(n),
        held_inertia=np.zeros(n),
        held_damping=np.zeros(n),
        strength=np.ones(model.nu),
    )
    limits = model.inputs.of_actuators([actuator.effort_limit() for actuator in actuators(model.plant)])
    actuation = model.inputs.of_actuators(np.asarray(model.plant.MakeActuationMatrix()).T).T
    return Tree(
        links=links,
        coordinates=coordinates_of(model),
        coupling=model.coupling,
        n=n,
        actuation=np.asarray(actuation),
        limits=np.asarray(limits),
        placed=placed,
        moved_by={body: _moved_by(pose) for body, (_, pose) in placed.items()},
        bodies={link.body: link for link in every},
        numbers=numbers,
    )


def ten_numbers(mass: Any, center: Any, inertia: Any) -> Any:
    """(10,) of a body: mass, centre of mass (3,), and xx yy zz xy xz yz about the centre; complex or float."""
    x, y, z = center
    about = [y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z]
    return np.array([mass, *(mass * c for c in center), *(i + mass * s for i, s in zip(inertia, about, strict=True))])


def _moved_by(pose: Any) -> Array:
    """(10, 10) the ten numbers of a body in a frame in which its own has this pose, by those in its own."""
    R, p = pose.rotation().matrix(), np.array(pose.translation())
    columns = []
    for basis in np.eye(10):
        m, h, J = basis[0], R @ basis[1:4], np.zeros((3, 3))
        for value, (i, j) in zip(basis[4:], INERTIA, strict=True):
            J[i, j] = J[j, i] = value
        p_hat, h_hat = skew(p), skew(h)
        J = R @ J @ R.T - p_hat @ h_hat - h_hat @ p_hat - m * p_hat @ p_hat
        columns.append([m, *(h + m * p), *(J[i, j] for i, j in INERTIA)])
    return np.array(columns).T

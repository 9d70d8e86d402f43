"""The accelerations of a tree at many states in one call, as functions of the numbers that parameters set.

    M(q) a = B (strength * u) - C(q, v) v + gravity - springs - damping v - coulomb tanh(v / v_s)

where dry friction turns over a small speed; `identification.dry` has the one that holds.

The force of inverse dynamics is linear in each link's ten numbers: mass, mass times centre of mass, inertia about the
frame's origin. So is it in damping, stiffness, friction and gravity, and

    da / dnumber = M^-1 (d force / dnumber - d inverse dynamics / dnumber)   at fixed q, v and a.

A shift of a joint on its parent is the motion of a slide without mass that is put before the joint and does not move:
its column is that of a coordinate in the derivative of `mechanics.tree`, whose notation is used here.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, Indices, cross, own_array, skew
from drake_diff._base.compiled import kernel
from drake_diff._base.refusal import Refusal
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.compiled_tree import KERNEL, CompiledTree
from drake_diff.mechanics.coordinates import rotation
from drake_diff.mechanics.description import Link, RigidLink, read_links, springs_of, without_welds
from drake_diff.mechanics.tree import Moving, TreeDynamics, tree_of
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators

SLIP_SPEED = 0.02  # v_s [rad/s or m/s] over which dry friction turns: Drake's joints have none, so nothing gives one
Mask = NDArray[np.bool_]
Grip = tuple[Array, Mask]  # what dry friction does: which way each coordinate slides, and which of them it holds
_INERTIA = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # xx yy zz xy xz yz


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
    held_inertia: Any  # (n,) by which dry friction holds a joint, beside a damping; 0 where it holds it still
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
class Slopes:
    """Accelerations a (N, n) and their derivatives by small motion, by v, by u and by the numbers asked for."""

    a: Array
    by_q: Array
    by_v: Array
    by_u: Array
    by_numbers: Array  # (N, n, np)


@dataclass(frozen=True, eq=False)
class Tree:
    """The tree of a model: what stays where parameters change."""

    links: tuple[RigidLink, ...]  # parents first
    dynamics: TreeDynamics  # each link in the frame of its joint; numbers are put in
    first: Indices  # (L,) of each link, its first degree of freedom
    actuation: Array  # (n, nu), of all joints
    limits: Array  # (nu,) what Drake cuts each input at
    placed: Mapping[str, tuple[int, Any]]  # by body: the link it belongs to, and the pose of the body in its frame
    moved_by: Mapping[str, Array]  # (10, 10) by body: its ten numbers in the frame of its link
    bodies: Mapping[str, Link]
    numbers: Numbers  # the model's own
    slip: float = SLIP_SPEED  # v_s [rad/s or m/s]

    @property
    def free(self) -> NDArray[np.bool_]:
        """(L,) whether a link is a free body."""
        return np.array([link.free for link in self.links], dtype=bool)

    def accelerate(self, numbers: Numbers, q: Array, v: Array, u: Array, grip: Grip | None = None) -> Array:
        """a (N, nv) at q (N, nq), v (N, nv) under u (N, nu); `grip` as `slopes` says, of friction that holds still."""
        if grip is None:
            return self.acceleration(numbers)(q, v, u)
        turn, held = grip
        mass, force = self.pushed(numbers)(q, v, u, turn)
        return np.asarray((held_inverse(mass, held) @ force[..., None])[..., 0])

    def acceleration(self, numbers: Numbers) -> Callable[[Array, Array, Array], Array]:
        """`accelerate` with these numbers, for many calls."""
        pushed = self.pushed(numbers)

        def of(q: Array, v: Array, u: Array) -> Array:
            mass, force = pushed(q, v, u, None)
            return np.asarray(np.linalg.solve(mass, force[..., None])[..., 0])

        return of

    def pushed(self, numbers: Numbers) -> Callable[[Array, Array, Array, Array | None], tuple[Array, Array]]:
        """(M (N, nv, nv), M a (N, nv)) with these numbers, for many calls: compiled where Numba is installed.

        The last argument is of dry friction, as `slopes` says.
        """
        compiled = self._compiled(numbers)

        def of(q: Array, v: Array, u: Array, turn: Array | None) -> tuple[Array, Array]:
            q, v = self._all(q, v)
            if compiled is None:
                moving, force, mass = self._moved(numbers, q, v, u, turn)
                bias = moving.forces(np.zeros_like(v))[0]
            else:
                moved, force = compiled(q, v, np.zeros_like(v), derivatives=False), self._force(numbers, q, v, u, turn)
                bias, mass = moved.tau, moved.mass + np.diag(numbers.reflected)
            return self._own(mass), self._along(force - bias)

        return of

    def _compiled(self, numbers: Numbers) -> CompiledTree | None:
        """Each link is its joint's frame with what it carries by welds; None where Numba is not installed."""
        module = kernel(KERNEL)
        if module is None:
            return None
        kinds = {"revolute": module.HINGE, "prismatic": module.SLIDE, "quaternion_floating": module.FREE}
        parents: list[int] = []
        first: list[int] = []
        size: list[int] = []
        joint_of: list[int] = []
        for link in self.links:
            before = joint_of[link.parent] if link.parent >= 0 else -1
            for start in (3, 0) if link.free else (0,):
                parents.append(before)
                first.append(link.joint.v_start + start)
                size.append(3 if link.free else 1)
                before = len(parents) - 1
            joint_of.append(before)
        frames = np.array([link.on_parent.GetAsMatrix34() for link in self.links]).reshape(-1, 3, 4)
        frames[:, :, 3] = numbers.offset
        identity = np.broadcast_to(np.eye(3, 4), frames.shape)
        mass = numbers.inertial[:, 0]
        center = numbers.inertial[:, 1:4] / np.where(mass != 0, mass, 1.0)[:, None]
        inertia = np.empty((len(mass), 3, 3))
        for k, (i, j) in enumerate(_INERTIA):
            inertia[:, i, j] = inertia[:, j, i] = numbers.inertial[:, 4 + k]
        hat = skew(center)
        inertia += mass[:, None, None] * (hat @ hat)  # about the centre of mass
        tables = (
            [link.parent for link in self.links],
            [kinds[link.joint.kind] for link in self.links],
            joint_of,
            [link.joint.q_start for link in self.links],
            [link.joint.v_start for link in self.links],
            np.array([link.axis for link in self.links], dtype=float).reshape(-1, 3),
            frames,
            identity,
            mass,
            center,
            inertia,
            parents,
            first,
            size,
            numbers.gravity,
        )
        whole = [own_array(np.array(t, dtype=np.int64) if isinstance(t, list) else t) for t in tables]
        names = {link.joint.body: i for i, link in enumerate(self.links)}
        return CompiledTree(tuple(whole), names, len(self.dynamics.mass))

    def slopes(self, numbers: Numbers, q: Array, v: Array, u: Array, by: Array, grip: Grip | None = None) -> Slopes:
        """The same with derivatives; `by` (count, np) is how the numbers change with each parameter.

        `grip` can say what dry friction does: (which way each coordinate slides (N, nv), -1 to 1; which of them it
        holds (N, nv)).
        """
        q, v = self._all(q, v)
        turn, held = (None, np.zeros(v.shape, dtype=bool)) if grip is None else grip
        moving, force, mass = self._moved(numbers, q, v, u, turn)
        diagonal = np.arange(v.shape[1])
        if turn is None:
            inverse = np.asarray(np.linalg.inv(self._own(mass)))
        else:
            still = held & (self._along(numbers.held_inertia) == 0)
            turn, held = self._of_all(turn), self._of_all(held.astype(float)) != 0
            mass, force = caught(numbers, mass, force, v, held)
            inverse = held_inverse(self._own(mass), still)
        bias = moving.forces(np.zeros_like(v))[0]
        own = (inverse @ self._along(force - bias)[..., None])[..., 0]
        a = self._all(q, own)[1]
        _, by_q, by_v = moving.derivatives(a)
        by_q[:, diagonal, diagonal] += numbers.stiffness
        by_v[:, diagonal, diagonal] += numbers.damping + numbers.held_damping * held
        if turn is None:
            by_v[:, diagonal, diagonal] += numbers.coulomb / self.slip / np.cosh(np.clip(v / self.slip, -300, 300)) ** 2
            turn = np.tanh(v / self.slip)
        change = self._by_numbers(numbers, moving, q, v, u, a, by, turn, held)
        by_u = inverse @ self._along_columns(self.actuation * numbers.strength * self._passes(u)[:, None, :])
        by_q, by_v = self._own(by_q), self._own(by_v)
        return Slopes(own, -inverse @ by_q, -inverse @ by_v, by_u, -inverse @ self._along_columns(change))

    def carried(self, numbers: Numbers, q: Array, v: Array, a: Array) -> Array:
        """(N, n) what moves each link with all that it carries; of a tree in which no joint follows another."""
        return self._with(numbers).moving(self.place(numbers, q), v).forces(a)[0]

    def carried_slopes(
        self, numbers: Numbers, q: Array, v: Array, a: Array, by: Array
    ) -> tuple[Array, Array, Array, Array]:
        """The same by small motion, by v, by a (N, n, n) and by what moves the numbers by `by` (N, n, np)."""
        moving = self._with(numbers).moving(self.place(numbers, q), v)
        _, by_q, by_v = moving.derivatives(a)
        return by_q, by_v, moving.mass, self._by_links(numbers, moving, a, by)

    def regressors(self, numbers: Numbers, q: Array, v: Array, a: Array) -> list[Array]:
        """Of each link (N nv, 10): the force of inverse dynamics at q, v and a (N, nv) by its ten numbers."""
        every, v = self._all(q, v)
        poses = self.place(numbers, every)
        moving = self._with(numbers).moving(poses, v)
        A = moving.forces(self._all(q, a)[1])[1]
        each = (self._along_columns(self._regressor(i, poses, moving, A)) for i in range(len(self.links)))
        return [one.reshape(-1, 10) for one in each]

    def efforts(self, numbers: Numbers) -> Array:
        """(nv, nu) the generalized force by the inputs."""
        return self._along_columns(self.actuation * numbers.strength)

    def inputs_for(self, numbers: Numbers, q: Array, v: Array, a: Array) -> Array:
        """(N, nu) the inputs that give accelerations a (N, nv), the nearest where none do; limits are not looked at."""
        q, v = self._all(q, v)
        moving, force, mass = self._moved(numbers, q, v, np.zeros((len(q), self.actuation.shape[1])))
        bias = moving.forces(np.zeros_like(v))[0]
        needed = (self._own(mass) @ a[..., None])[..., 0] + self._along(bias - force)
        return np.asarray(needed @ np.linalg.pinv(self.efforts(numbers)).T)

    def friction(self, numbers: Numbers) -> Array:
        """(nv,) the most that dry friction pushes along each coordinate: of its joint and of those that follow it."""
        coupling = self.dynamics.coupling
        return numbers.coulomb if coupling is None else np.asarray(np.abs(coupling.spread).T @ numbers.coulomb)

    def _of_all(self, turn: Array) -> Array:
        """(N, n) which way each joint slides, of which way coordinates do (N, nv)."""
        coupling = self.dynamics.coupling
        return turn if coupling is None else np.asarray(turn @ np.sign(coupling.spread).T)

    def _all(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Positions and velocities of all joints, those that follow another included."""
        coupling = self.dynamics.coupling
        return (q, v) if coupling is None else (coupling.positions(q), coupling.velocities(v))

    def _own(self, matrix: Array) -> Array:
        """(N, nv, nv) a matrix (N, n, n) of all joints, of the independent coordinates."""
        coupling = self.dynamics.coupling
        return matrix if coupling is None else np.asarray(coupling.spread.T @ matrix @ coupling.spread)

    def _along(self, force: Array) -> Array:
        """(N, nv) of forces (N, n)."""
        coupling = self.dynamics.coupling
        return force if coupling is None else np.asarray(force @ coupling.spread)

    def _along_columns(self, columns: Array) -> Array:
        """(N, nv, k) of (N, n, k)."""
        coupling = self.dynamics.coupling
        return columns if coupling is None else np.asarray(coupling.spread.T @ columns)

    def _moved(
        self, numbers: Numbers, q: Array, v: Array, u: Array, turn: Array | None = None
    ) -> tuple[Moving, Array, Array]:
        """The tree in motion, the force (N, n) that does not come from its links, and M (N, n, n)."""
        moving = self._with(numbers).moving(self.place(numbers, q), v)
        return moving, self._force(numbers, q, v, u, turn), moving.mass + np.diag(numbers.reflected)

    def _force(self, numbers: Numbers, q: Array, v: Array, u: Array, turn: Array | None = None) -> Array:
        """(N, n) what does not come from links."""
        effort = np.clip(u, -self.limits, self.limits) * numbers.strength
        stretched = np.where(numbers.stiffness != 0, q[:, self.dynamics.positions] - numbers.rest, 0.0)
        force = effort @ self.actuation.T - numbers.stiffness * stretched - numbers.damping * v
        return np.asarray(force - numbers.coulomb * (np.tanh(v / self.slip) if turn is None else self._of_all(turn)))

    def _passes(self, u: Array) -> Array:
        """(N, nu) 1 where an input is within its limits, beyond which it changes nothing."""
        return np.asarray((np.abs(u) <= self.limits).astype(float))

    def _with(self, numbers: Numbers) -> TreeDynamics:
        own, n = numbers.inertial, len(self.dynamics.mass)
        mass, moment, inertia = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
        mass[self.first], moment[self.first] = own[:, 0], own[:, 1:4]
        for k, (i, j) in enumerate(_INERTIA):
            inertia[self.first, i, j] = inertia[self.first, j, i] = own[:, 4 + k]
        return replace(self.dynamics, mass=mass, moment=moment, inertia=inertia, gravity=numbers.gravity)

    def place(self, numbers: Numbers, q: Array) -> Array:
        """(N, n, 3, 4) the poses of the frames of the joints, of each degree of freedom, at q (N, nq)."""
        of_links = np.empty((len(q), len(self.links), 3, 4))
        for i, link in enumerate(self.links):
            joint, at = link.joint, q[:, link.joint.q_start]
            if link.free:
                quaternion = q[:, joint.q_start : joint.q_start + 4]
                of_links[:, i, :, :3] = rotation(quaternion)
                of_links[:, i, :, 3] = q[:, joint.q_start + 4 : joint.q_start + 7]
                continue
            turn = np.broadcast_to(link.on_parent.rotation().matrix(), (len(q), 3, 3))
            shift = np.broadcast_to(numbers.offset[i], (len(q), 3))
            if joint.kind == "revolute":
                hat, s, c = skew(link.axis), np.sin(at)[:, None, None], np.cos(at)[:, None, None]
                turn = turn @ (np.eye(3) + s * hat + (1 - c) * (hat @ hat))
            else:
                shift = shift + at[:, None] * (link.on_parent.rotation().matrix() @ link.axis)
            if link.parent >= 0:
                before = of_links[:, link.parent]
                shift = before[..., 3] + (before[..., :3] @ shift[..., None])[..., 0]
                turn = before[..., :3] @ turn
            of_links[:, i, :, :3], of_links[:, i, :, 3] = turn, shift
        of_each = np.empty((len(q), len(self.dynamics.mass), 3, 4))
        for i, link in enumerate(self.links):
            count = 6 if link.free else 1
            of_each[:, self.first[i] : self.first[i] + count] = of_links[:, i, None]
        return of_each

    def _by_numbers(
        self,
        numbers: Numbers,
        moving: Moving,
        q: Array,
        v: Array,
        u: Array,
        a: Array,
        by: Array,
        turn: Array,
        held: Mask,
    ) -> Array:
        """(N, n, np) of inverse dynamics less the other forces, at fixed a."""
        found = self._by_links(numbers, moving, a, by)
        stretched = q[:, self.dynamics.positions] - numbers.rest
        for name, value in (
            ("damping", v),
            ("reflected", a),
            ("stiffness", stretched),
            ("rest", np.broadcast_to(-numbers.stiffness, v.shape)),
            ("coulomb", turn),
            ("held_inertia", a * held),
            ("held_damping", v * held),
        ):
            rows = by[numbers.places(name)]
            if np.any(rows):
                found += value[..., None] * rows
        rows = by[numbers.places("strength")]
        if np.any(rows):
            effort = np.clip(u, -self.limits, self.limits)
            found -= (self.actuation * effort[:, None, :]) @ rows
        return found

    def _by_links(self, numbers: Numbers, moving: Moving, a: Array, by: Array) -> Array:
        """(N, n, np) of inverse dynamics at fixed a."""
        found = np.zeros((*a.shape, by.shape[1]))
        _, A, carried = moving.forces(a)
        poses = moving.poses
        for i, places in enumerate(numbers.places("inertial")):
            used = np.flatnonzero(np.any(by[places] != 0, axis=0))
            if len(used):
                found[:, :, used] += self._regressor(i, poses, moving, A) @ by[np.ix_(places, used)]
        for i, places in enumerate(numbers.places("offset")):
            used = np.flatnonzero(np.any(by[places] != 0, axis=0))
            if len(used):
                found[:, :, used] += self._by_shift(i, poses, moving, A, carried) @ by[np.ix_(places, used)]
        by_gravity = -(moving.carried_inertia @ moving.S[..., None])[..., 0][..., 3:]
        found += by_gravity @ by[numbers.places("gravity")]
        return found

    def _regressor(self, i: int, poses: Array, moving: Moving, A: Array) -> Array:
        """(N, n, 10) inverse dynamics by the ten numbers of link i."""
        k = self.first[i]
        R, p = poses[:, k, :, :3], poses[:, k, :, 3]
        V, A_own = _in_frame(R, p, moving.V[:, k]), _in_frame(R, p, A[:, k])
        force = np.moveaxis(_BASIS @ A_own.T, -1, 0)  # (N, 10, 6)
        force += _cross_force(V[:, None], np.moveaxis(_BASIS @ V.T, -1, 0))
        carriers = np.flatnonzero(self.dynamics.ancestors[k])
        found = np.zeros((*moving.v.shape, 10))
        S = _in_frame(R[:, None], p[:, None], moving.S[:, carriers])
        found[:, carriers] = S @ np.swapaxes(force, -1, -2)
        return found

    def _by_shift(self, i: int, poses: Array, moving: Moving, A: Array, carried: Array) -> Array:
        """(N, n, 3) inverse dynamics by the shift of joint i on the link before it."""
        link, k, N = self.links[i], self.first[i], len(poses)
        if link.parent >= 0:
            parent = self.first[link.parent]
            turn, V, A_before = poses[:, parent, :, :3], moving.V[:, parent], A[:, parent]
        else:
            turn, V = np.broadcast_to(np.eye(3), (N, 3, 3)), np.zeros((N, 6))
            A_before = np.zeros((N, 6))
            A_before[:, 3:] = -moving.tree.gravity
        S = np.concatenate([np.zeros((N, 3, 3)), np.swapaxes(turn, -1, -2)], axis=-1)  # (N, 3, 6)
        P = _cross_motion(V[:, None], S)
        Q = _cross_motion(A_before[:, None], S) + _cross_motion(V[:, None], P)
        found = np.zeros((*moving.v.shape, 3))
        P_t, Q_t = np.swapaxes(P, -1, -2), np.swapaxes(Q, -1, -2)
        ancestors = self.dynamics.ancestors
        below = np.flatnonzero(ancestors[:, k])
        change = moving.carried_B[:, below] @ P_t[:, None] + moving.carried_inertia[:, below] @ Q_t[:, None]
        found[:, below] = (moving.S[:, below, None, :] @ change)[:, :, 0]
        above = np.setdiff1d(np.flatnonzero(ancestors[k]), below)
        change = moving.carried_B[:, k] @ P_t + moving.carried_inertia[:, k] @ Q_t
        change += np.swapaxes(_cross_force(S, carried[:, None, k]), -1, -2)
        found[:, above] = moving.S[:, above] @ change
        return found


def tree_for_identification(model: Model) -> Tree | Refusal:
    """The tree of a model's own values; a Refusal that says what in it moves otherwise."""
    if model.num_constraints:
        return Refusal("joints are held by constraints")
    if any(actuator.has_controller() for actuator in actuators(model.plant)):
        return Refusal("actuators have PD controllers in the plant")
    dynamics = tree_of(model, free=True)
    if isinstance(dynamics, Refusal):
        return dynamics
    springs = springs_of(model.plant)
    if isinstance(springs, Refusal):
        return springs
    every = read_links(model.plant, springs)
    links, placed, _ = without_welds(every)
    if any(link.stiffness != 0 and link.kind == "quaternion_floating" for link in every):
        raise ModelError("a free body has a spring")
    inertial, n = np.zeros((len(links), 10)), len(dynamics.mass)
    axis = np.array(dynamics.axis)
    for rigid in links:
        if not rigid.free:
            axis[rigid.joint.v_start] = rigid.axis
    for link in every:
        place, pose = placed[link.body]
        if place >= 0:
            own = ten_numbers(link.mass, link.center_of_mass, link.inertia[tuple(np.transpose(_INERTIA))])
            inertial[place] += _moved_by(pose) @ own
    numbers = Numbers(
        inertial=inertial,
        offset=np.array([link.on_parent.translation() for link in links]).reshape(-1, 3),
        gravity=np.array(dynamics.gravity, dtype=float),
        damping=np.array(dynamics.damping),
        reflected=np.array(dynamics.reflected),
        stiffness=np.array(dynamics.stiffness),
        rest=np.array(dynamics.rest),
        coulomb=np.zeros(n),
        held_inertia=np.zeros(n),
        held_damping=np.zeros(n),
        strength=np.ones(model.nu),
    )
    limits = model.inputs.of_actuators([actuator.effort_limit() for actuator in actuators(model.plant)])
    own = replace(dynamics, axis=axis, origin=np.zeros((n, 3)))
    first = np.array([link.joint.v_start for link in links], dtype=np.intp)
    bodies = {link.body: link for link in every}
    moves = {body: _moved_by(pose) for body, (_, pose) in placed.items()}
    actuation = model.inputs.of_actuators(np.asarray(model.plant.MakeActuationMatrix()).T).T
    return Tree(links, own, first, np.asarray(actuation), np.asarray(limits), placed, moves, bodies, numbers)


def caught(numbers: Numbers, mass: Array, force: Array, v: Array, held: Mask) -> tuple[Array, Array]:
    """M (N, n, n) and M a (N, n) with what dry friction that gives way does to joints that it holds (N, n)."""
    own = np.where(held, numbers.held_inertia, 0.0)
    return mass + own[:, :, None] * np.eye(len(numbers.coulomb)), force - np.where(held, numbers.held_damping * v, 0.0)


def held_inverse(mass: Array, held: Mask) -> Array:
    """(N, n, n) accelerations by forces where the joints that are held (N, n) do not move, of M (N, n, n)."""
    free = ~held[:, :, None] & ~held[:, None, :]
    within = np.where(free, mass, np.eye(mass.shape[1]) * np.max(np.abs(mass)))
    return np.asarray(np.where(free, np.linalg.inv(within), 0.0))


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
        for value, (i, j) in zip(basis[4:], _INERTIA, strict=True):
            J[i, j] = J[j, i] = value
        p_hat, h_hat = skew(p), skew(h)
        J = R @ J @ R.T - p_hat @ h_hat - h_hat @ p_hat - m * p_hat @ p_hat
        columns.append([m, *(h + m * p), *(J[i, j] for i, j in _INERTIA)])
    return np.array(columns).T


def _basis() -> Array:
    """(10, 6, 6) the spatial inertia of each of the ten numbers."""
    found = np.zeros((10, 6, 6))
    found[0, 3:, 3:] = np.eye(3)
    for k in range(3):
        hat = skew(np.eye(3)[k])
        found[1 + k, :3, 3:], found[1 + k, 3:, :3] = hat, -hat
    for k, (i, j) in enumerate(_INERTIA):
        found[4 + k, i, j] = found[4 + k, j, i] = 1.0
    return found


_BASIS = _basis()


def _in_frame(R: Array, p: Array, motion: Array) -> Array:
    """Motions (..., 6) about the world's origin, in a frame at R (..., 3, 3) and p (..., 3) and about its origin."""
    w, moved = motion[..., :3], motion[..., 3:]
    at = moved + cross(w, np.broadcast_to(p, w.shape))
    R_t = np.swapaxes(R, -1, -2)
    return np.concatenate([(R_t @ w[..., None])[..., 0], (R_t @ at[..., None])[..., 0]], axis=-1)


def _cross_motion(motion: Array, other: Array) -> Array:
    w, lin, of, of_lin = np.broadcast_arrays(motion[..., :3], motion[..., 3:], other[..., :3], other[..., 3:])
    return np.concatenate([cross(w, of), cross(w, of_lin) + cross(lin, of)], axis=-1)


def _cross_force(motion: Array, force: Array) -> Array:
    w, lin, n, f = np.broadcast_arrays(motion[..., :3], motion[..., 3:], force[..., :3], force[..., 3:])
    return np.concatenate([cross(w, n) + cross(lin, f), cross(w, f)], axis=-1)

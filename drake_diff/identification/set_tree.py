"""A tree whose numbers are set: its accelerations at many states in one call, and their derivatives.

Where Numba is installed, `kernel` and `mechanics.tree_kernel` say what the links do; else `mechanics.tree`.

A shift of a joint on its parent is the motion of a slide without mass that is put before the joint and does not move:
its column is that of a coordinate in the derivative of `mechanics.tree`, whose notation is used here.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from drake_diff._base.arrays import Array, cross, own_array, skew
from drake_diff.identification.compiled import INERTIA, CompiledForces, compiled_forces
from drake_diff.identification.tree import Grip, Mask, Numbers, Slopes, Tree
from drake_diff.mechanics.coordinates import rotation
from drake_diff.mechanics.numpy_tree import Moving, TreeDynamics

Method = tuple[tuple[Array, ...], Array]  # of Runge and Kutta: the rows of its stages, and its weights


@dataclass(frozen=True, eq=False)
class SetTree:
    """A tree with these numbers, for many calls."""

    tree: Tree
    numbers: Numbers

    @cached_property
    def compiled(self) -> CompiledForces | None:
        """None where Numba is not installed."""
        own, dynamics = self.numbers, self.tree.dynamics
        forces = (
            np.asarray(dynamics.positions, dtype=np.int64),
            own.reflected,
            own.damping,
            own.stiffness,
            own.rest,
            own.coulomb,
            own.held_inertia,
            own.held_damping,
        )
        return compiled_forces(
            self.tree.links, own.inertial, own.offset, own.gravity, (*map(own_array, forces), self.tree.slip)
        )

    def accelerate(self, q: Array, v: Array, u: Array, grip: Grip | None = None) -> Array:
        """a (N, nv) at q (N, nq), v (N, nv) under u (N, nu); `grip` as `slopes` says, of friction that holds still."""
        if grip is None:
            mass, force = self.pushed(q, v, u)
            return np.asarray(np.linalg.solve(mass, force[..., None])[..., 0])
        turn, held = grip
        mass, force = self.pushed(q, v, u, turn)
        return np.asarray((held_inverse(mass, held) @ force[..., None])[..., 0])

    def pushed(self, q: Array, v: Array, u: Array, turn: Array | None = None) -> tuple[Array, Array]:
        """(M (N, nv, nv), M a (N, nv)); which way dry friction slides is said by `turn`, as `slopes` says."""
        q, v = self.tree.all_of(q, v)
        mass, bias, _ = self._at_rest(q, v)
        return self.tree.own(mass), self.tree.along(self._force(q, v, u, turn) - bias)

    def step(self, method: Method, x: Array, h: Array, u: Array, grip: Grip | None = None) -> Array | None:
        """The states (N, nx) after steps of h (N,) from x under u (N, nu); None where that is not compiled."""
        if self.compiled is None or self.tree.dynamics.coupling is not None:
            return None
        return self.compiled.step(method, x, h, self._effort(u), *(() if grip is None else grip))

    def slopes(self, q: Array, v: Array, u: Array, by: Array, grip: Grip | None = None) -> Slopes:
        """`accelerate` with derivatives; `by` (count, np) is how the numbers change with each parameter.

        `grip` can say what dry friction does: (which way each coordinate slides (N, nv), -1 to 1; which of them it
        holds (N, nv)).
        """
        q, v = self.tree.all_of(q, v)
        turn, held = (None, np.zeros(v.shape, dtype=bool)) if grip is None else grip
        (mass, bias, moving), force = self._at_rest(q, v), self._force(q, v, u, turn)
        diagonal = np.arange(v.shape[1])
        if turn is None:
            inverse = np.asarray(np.linalg.inv(self.tree.own(mass)))
        else:
            still = held & (self.tree.along(self.numbers.held_inertia) == 0)
            turn, held = self.tree.of_all(turn), self.tree.of_all(held.astype(float)) != 0
            mass, force = caught(self.numbers, mass, force, v, held)
            inverse = held_inverse(self.tree.own(mass), still)
        own = (inverse @ self.tree.along(force - bias)[..., None])[..., 0]
        a = self.tree.all_of(q, own)[1]
        by_q, by_v, change = self._links_by(q, v, a, by, moving)
        by_q[:, diagonal, diagonal] += self.numbers.stiffness
        by_v[:, diagonal, diagonal] += self.numbers.damping + self.numbers.held_damping * held
        if turn is None:
            slid = v / self.tree.slip
            by_v[:, diagonal, diagonal] += (
                self.numbers.coulomb / self.tree.slip / np.cosh(np.clip(slid, -300, 300)) ** 2
            )
            turn = np.tanh(slid)
        change += self._forces_by(q, v, u, a, by, turn, held)
        passes = (np.abs(u) <= self.tree.limits).astype(float)  # beyond its limits an input changes nothing
        by_u = inverse @ self.tree.along_columns(self.tree.actuation * self.numbers.strength * passes[:, None, :])
        by_q, by_v = self.tree.own(by_q), self.tree.own(by_v)
        return Slopes(own, -inverse @ by_q, -inverse @ by_v, by_u, -inverse @ self.tree.along_columns(change))

    def _at_rest(self, q: Array, v: Array) -> tuple[Array, Array, Moving | None]:
        """(M (N, n, n), inverse dynamics (N, n) at no acceleration, the tree in motion where that is not compiled)."""
        still = np.zeros_like(v)
        if self.compiled is not None:
            moved = self.compiled.tree(q, v, still, derivatives=False)
            return moved.mass + np.diag(self.numbers.reflected), moved.tau, None
        moving = self._moving(q, v)
        return moving.mass + np.diag(self.numbers.reflected), moving.forces(still)[0], moving

    def _links_by(self, q: Array, v: Array, a: Array, by: Array, moving: Moving | None) -> tuple[Array, Array, Array]:
        """Inverse dynamics of the links by small motion, by v (N, n, n), and by what moves the numbers (N, n, np)."""
        if self.compiled is None:
            moving = moving or self._moving(q, v)
            _, by_q, by_v = moving.derivatives(a)
            return by_q, by_v, self._by_inertial(moving, a, by) + self._by_offsets(moving, a, by)
        moved = self.compiled.tree(q, v, a)
        inertial, gravity = by[self.numbers.places("inertial")], by[self.numbers.places("gravity")]
        change = np.zeros((*v.shape, by.shape[1]))
        used = np.flatnonzero(np.any(inertial != 0, axis=(0, 1)) | np.any(gravity != 0, axis=0))
        if len(used):
            change[..., used] = self.compiled.by_links(moved, v, a, inertial[..., used], gravity[:, used])
        if np.any(by[self.numbers.places("offset")]):
            change += self._by_offsets(self._moving(q, v), a, by)
        return moved.by_q, moved.by_v, change

    def _by_inertial(self, moving: Moving, a: Array, by: Array) -> Array:
        """(N, n, np) inverse dynamics at fixed a, by what links weigh and by gravity."""
        by_gravity = -(moving.carried_inertia @ moving.S[..., None])[..., 0][..., 3:]
        found = np.asarray(by_gravity @ by[self.numbers.places("gravity")])
        _, A, _ = moving.forces(a)
        for i, places in enumerate(self.numbers.places("inertial")):
            used = np.flatnonzero(np.any(by[places] != 0, axis=0))
            if len(used):
                found[:, :, used] += self._regressor(i, moving, A) @ by[np.ix_(places, used)]
        return found

    def _by_offsets(self, moving: Moving, a: Array, by: Array) -> Array:
        """(N, n, np) inverse dynamics at fixed a, by where joints are on the links before them."""
        found = np.zeros((*a.shape, by.shape[1]))
        _, A, carried = moving.forces(a)
        for i, places in enumerate(self.numbers.places("offset")):
            used = np.flatnonzero(np.any(by[places] != 0, axis=0))
            if len(used):
                found[:, :, used] += self._by_shift(i, moving, A, carried) @ by[np.ix_(places, used)]
        return found

    def _forces_by(self, q: Array, v: Array, u: Array, a: Array, by: Array, turn: Array, held: Mask) -> Array:
        """(N, n, np) at fixed a, what reflected inertia takes less the other forces that do not come from links."""
        found = np.zeros((*v.shape, by.shape[1]))
        stretched = q[:, self.tree.dynamics.positions] - self.numbers.rest
        for name, value in (
            ("damping", v),
            ("reflected", a),
            ("stiffness", stretched),
            ("rest", np.broadcast_to(-self.numbers.stiffness, v.shape)),
            ("coulomb", turn),
            ("held_inertia", a * held),
            ("held_damping", v * held),
        ):
            rows = by[self.numbers.places(name)]
            if np.any(rows):
                found += value[..., None] * rows
        rows = by[self.numbers.places("strength")]
        if np.any(rows):
            effort = np.clip(u, -self.tree.limits, self.tree.limits)
            found -= (self.tree.actuation * effort[:, None, :]) @ rows
        return found

    def carried(self, q: Array, v: Array, a: Array) -> Array:
        """(N, n) what moves each link with all that it carries; of a tree in which no joint follows another."""
        return self._moving(q, v).forces(a)[0]

    def carried_slopes(self, q: Array, v: Array, a: Array, by: Array) -> tuple[Array, Array, Array, Array]:
        """The same by small motion, by v, by a (N, n, n) and by what moves the numbers by `by` (N, n, np)."""
        moving = self._moving(q, v)
        by_q, by_v, change = self._links_by(q, v, a, by, moving)
        return by_q, by_v, moving.mass, change

    def regressors(self, q: Array, v: Array, a: Array) -> list[Array]:
        """Of each link (N nv, 10): the force of inverse dynamics at q, v and a (N, nv) by its ten numbers."""
        every, v = self.tree.all_of(q, v)
        moving = self._moving(every, v)
        A = moving.forces(self.tree.all_of(q, a)[1])[1]
        each = (self.tree.along_columns(self._regressor(i, moving, A)) for i in range(len(self.tree.links)))
        return [one.reshape(-1, 10) for one in each]

    def efforts(self) -> Array:
        """(nv, nu) the generalized force by the inputs."""
        return self.tree.along_columns(self.tree.actuation * self.numbers.strength)

    def inputs_for(self, q: Array, v: Array, a: Array) -> Array:
        """(N, nu) the inputs that give accelerations a (N, nv), the nearest where none do; limits are not looked at."""
        mass, force = self.pushed(q, v, np.zeros((len(q), self.tree.actuation.shape[1])))
        needed = (mass @ a[..., None])[..., 0] - force
        return np.asarray(needed @ np.linalg.pinv(self.efforts()).T)

    def friction(self) -> Array:
        """(nv,) the most that dry friction pushes along each coordinate: of its joint and of those that follow it."""
        coupling = self.tree.dynamics.coupling
        return (
            self.numbers.coulomb if coupling is None else np.asarray(np.abs(coupling.spread).T @ self.numbers.coulomb)
        )

    def _effort(self, u: Array) -> Array:
        """(N, n) the generalized force by inputs."""
        return np.asarray(
            (np.clip(u, -self.tree.limits, self.tree.limits) * self.numbers.strength) @ self.tree.actuation.T
        )

    def _force(self, q: Array, v: Array, u: Array, turn: Array | None = None) -> Array:
        """(N, n) what does not come from links."""
        own, places = self.numbers, self.tree.dynamics.positions
        stretched = np.where(own.stiffness != 0, q[:, places] - own.rest, 0.0)
        turned = np.tanh(v / self.tree.slip) if turn is None else self.tree.of_all(turn)
        return np.asarray(self._effort(u) - own.stiffness * stretched - own.damping * v - own.coulomb * turned)

    def _moving(self, q: Array, v: Array) -> Moving:
        return self._with().moving(self.place(q), v)

    def _with(self) -> TreeDynamics:
        own, n = self.numbers.inertial, len(self.tree.dynamics.mass)
        mass, moment, inertia = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
        mass[self.tree.first], moment[self.tree.first] = own[:, 0], own[:, 1:4]
        for k, (i, j) in enumerate(INERTIA):
            inertia[self.tree.first, i, j] = inertia[self.tree.first, j, i] = own[:, 4 + k]
        return replace(self.tree.dynamics, mass=mass, moment=moment, inertia=inertia, gravity=self.numbers.gravity)

    def place(self, q: Array) -> Array:
        """(N, n, 3, 4) the poses of the frames of the joints, of each degree of freedom, at q (N, nq)."""
        of_links = np.empty((len(q), len(self.tree.links), 3, 4))
        for i, link in enumerate(self.tree.links):
            joint, at = link.joint, q[:, link.joint.q_start]
            if link.free:
                quaternion = q[:, joint.q_start : joint.q_start + 4]
                of_links[:, i, :, :3] = rotation(quaternion)
                of_links[:, i, :, 3] = q[:, joint.q_start + 4 : joint.q_start + 7]
                continue
            turn = np.broadcast_to(link.on_parent.rotation().matrix(), (len(q), 3, 3))
            shift = np.broadcast_to(self.numbers.offset[i], (len(q), 3))
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
        of_each = np.empty((len(q), len(self.tree.dynamics.mass), 3, 4))
        for i, link in enumerate(self.tree.links):
            count = 6 if link.free else 1
            of_each[:, self.tree.first[i] : self.tree.first[i] + count] = of_links[:, i, None]
        return of_each

    def _regressor(self, i: int, moving: Moving, A: Array) -> Array:
        """(N, n, 10) inverse dynamics by the ten numbers of link i."""
        k, poses = self.tree.first[i], moving.poses
        R, p = poses[:, k, :, :3], poses[:, k, :, 3]
        V, A_own = _in_frame(R, p, moving.V[:, k]), _in_frame(R, p, A[:, k])
        force = np.moveaxis(_BASIS @ A_own.T, -1, 0)  # (N, 10, 6)
        force += _cross_force(V[:, None], np.moveaxis(_BASIS @ V.T, -1, 0))
        carriers = np.flatnonzero(self.tree.dynamics.ancestors[k])
        found = np.zeros((*moving.v.shape, 10))
        S = _in_frame(R[:, None], p[:, None], moving.S[:, carriers])
        found[:, carriers] = S @ np.swapaxes(force, -1, -2)
        return found

    def _by_shift(self, i: int, moving: Moving, A: Array, carried: Array) -> Array:
        """(N, n, 3) inverse dynamics by the shift of joint i on the link before it."""
        link, k, poses = self.tree.links[i], self.tree.first[i], moving.poses
        N = len(poses)
        if link.parent >= 0:
            parent = self.tree.first[link.parent]
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
        ancestors = self.tree.dynamics.ancestors
        below = np.flatnonzero(ancestors[:, k])
        change = moving.carried_B[:, below] @ P_t[:, None] + moving.carried_inertia[:, below] @ Q_t[:, None]
        found[:, below] = (moving.S[:, below, None, :] @ change)[:, :, 0]
        above = np.setdiff1d(np.flatnonzero(ancestors[k]), below)
        change = moving.carried_B[:, k] @ P_t + moving.carried_inertia[:, k] @ Q_t
        change += np.swapaxes(_cross_force(S, carried[:, None, k]), -1, -2)
        found[:, above] = moving.S[:, above] @ change
        return found


def caught(numbers: Numbers, mass: Array, force: Array, v: Array, held: Mask) -> tuple[Array, Array]:
    """M (N, n, n) and M a (N, n) with what dry friction that gives way does to joints that it holds (N, n)."""
    own = np.where(held, numbers.held_inertia, 0.0)
    return mass + own[:, :, None] * np.eye(len(numbers.coulomb)), force - np.where(held, numbers.held_damping * v, 0.0)


def held_inverse(mass: Array, held: Mask) -> Array:
    """(N, n, n) accelerations by forces where the joints that are held (N, n) do not move, of M (N, n, n)."""
    free = ~held[:, :, None] & ~held[:, None, :]
    within = np.where(free, mass, np.eye(mass.shape[1]) * np.max(np.abs(mass)))
    return np.asarray(np.where(free, np.linalg.inv(within), 0.0))


def _basis() -> Array:
    """(10, 6, 6) the spatial inertia of each of the ten numbers."""
    found = np.zeros((10, 6, 6))
    found[0, 3:, 3:] = np.eye(3)
    for k in range(3):
        hat = skew(np.eye(3)[k])
        found[1 + k, :3, 3:], found[1 + k, 3:, :3] = hat, -hat
    for k, (i, j) in enumerate(INERTIA):
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

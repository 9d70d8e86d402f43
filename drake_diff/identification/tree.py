"""The equations of motion of a tree at many states, as functions of its numbers, which depend on the parameters.

The force of inverse dynamics is linear in each link's ten numbers: mass, mass times centre of mass, inertia about the
frame's origin. It is also linear in damping, stiffness, friction and gravity. It is quadratic in the offset of a joint
on its parent, so a central difference gives the exact derivative. With these

    da / dnumber = M^-1 (d force / dnumber - d inverse dynamics / dnumber)   at fixed q, v and a.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.integrate import DOP853

from drake_diff._base.arrays import Array, Indices, cross, skew
from drake_diff._base.compiled import kernel
from drake_diff._base.values import Refusal
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.mechanics.description import Link, RigidLink, coordinates_of, read_links, springs_of
from drake_diff.mechanics.tree import CompiledTree, Moved, TreeModel, compile_links, tree_of
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators

KERNEL = "drake_diff.identification.kernel"
INERTIA = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # xx yy zz xy xz yz
SLIP_SPEED = 0.02  # [rad/s or m/s] over which smooth friction changes its sign
REST = 1e-9  # [rad/s, m/s] below which a joint is at rest
SHIFT = 0.437  # size of a central difference of numbers, which is exact for quadratic polynomials
OF_JOINTS = ("reflected", "damping", "stiffness", "rest", "coulomb")
OF_SERVOS = ("kp", "kd", "strength", "limit")
PER_LINK = ("kind", "axis", "frame", "back", "mass", "center", "inertia", "size")
Mask = NDArray[np.bool_]
Method = tuple[Array, Array]  # of Runge-Kutta type: stages (m, m) and weights (m,)
ORDER_8: Method = (np.array(DOP853.A[: len(DOP853.B), : len(DOP853.B)]), np.array(DOP853.B))
ORDER_4: Method = (np.pad(np.diag([0.5, 0.5, 1.0]), ((1, 0), (0, 1))), np.array([1, 2, 2, 1]) / 6)


class Grip(NamedTuple):
    """The sliding or sticking of joints by Coulomb friction at N states."""

    turn: Array  # (N, nv) 1 or -1 for joints that slide, else 0
    held: Array  # (N, nv) 1 for joints that stick, else 0

    def some(self, rows: Any) -> "Grip":
        return Grip(self.turn[rows], self.held[rows])


@dataclass(frozen=True, eq=False)
class Numbers:
    """The numbers of L moving links and n degrees of freedom that depend on parameters; complex for derivatives."""

    inertial: Any  # (L, 10) mass, mass times centre, xx yy zz xy xz yz about the origin, in the joint's frame
    offset: Any  # (L, 3) [m] origin of the joint's frame on the parent link
    gravity: Any  # (3,)
    damping: Any  # (n,)
    reflected: Any  # (n,) rotor inertia times gear ratio squared
    stiffness: Any  # (n,)
    rest: Any  # (n,)
    coulomb: Any  # (n,) Coulomb friction [N or N m]
    strength: Any  # (nu,) factor of an input
    limit: Any  # (nu,) magnitude to which an input, or the effort of a servo, is clipped
    kp: Any  # (nu,) gains of servos, whose inputs are commanded positions; 0 for other inputs
    kd: Any  # (nu,)

    @property
    def flat(self) -> Any:
        """All numbers (count,), concatenated."""
        return np.concatenate([np.ravel(getattr(self, name)) for name in self.__dataclass_fields__])

    def places(self, name: str) -> Indices:
        """Return the indices of the numbers `name` in `flat`, in their own shape."""
        start = 0
        for other in self.__dataclass_fields__:
            values = getattr(self, other)
            if other == name:
                return start + np.arange(np.size(values)).reshape(np.shape(values))
            start += np.size(values)
        raise KeyError(name)

    def moved(self, change: Any) -> "Numbers":
        """Return the numbers plus a change (count,) of all."""
        return Numbers(**{n: getattr(self, n) + change[self.places(n)] for n in self.__dataclass_fields__})


@dataclass(frozen=True, eq=False)
class Tree(TreeModel):
    """The tree of a model, with its own numbers and what does not depend on parameters; `compiled` has no welds."""

    coordinates: Coordinates  # of the independent joints
    actuation: Array  # (n, nu)
    servo: Indices  # (n,) index of the input that is the joint's commanded position; -1 if there is none
    moved_by: Mapping[str, Array]  # (10, 10) by body: the map of its ten numbers to the frame of its link
    bodies: Mapping[str, Link]
    numbers: Numbers  # the model's own

    @property
    def n(self) -> int:
        """The degrees of freedom of all joints."""
        return len(self.damping)

    @cached_property
    def commanded(self) -> Mask:
        """Whether each input (nu,) is a commanded position."""
        return np.isin(np.arange(self.actuation.shape[1]), self.servo)

    @cached_property
    def spread(self) -> Array:
        """The matrix (n, nv) from independent velocities to those of all joints."""
        return np.eye(self.n) if self.coupling is None else np.asarray(self.coupling.spread, dtype=float)

    def joint_positions(self, q: Array) -> Array:
        """Return the positions of all joints for q (N, nq) of the independent ones."""
        return q if self.coupling is None else np.asarray(self.coupling.positions(q))

    def with_numbers(self, numbers: Numbers) -> CompiledTree:
        """Return the links with these numbers."""
        ten, tables = numbers.inertial, self.compiled.tables
        mass = ten[:, 0]
        center = ten[:, 1:4] / np.where(mass != 0, mass, 1.0)[:, None]
        inertia = np.empty((len(mass), 3, 3))
        for k, (i, j) in enumerate(INERTIA):
            inertia[:, i, j] = inertia[:, j, i] = ten[:, 4 + k]
        inertia += mass[:, None, None] * (skew(center) @ skew(center))  # about the centre of mass
        frame = np.concatenate([tables.frame[:, :, :3], numbers.offset[:, :, None]], axis=2)
        parts = {"frame": frame, "mass": mass, "center": center, "inertia": inertia, "gravity": numbers.gravity}
        return replace(self.compiled, tables=tables._replace(**{n: _array(values) for n, values in parts.items()}))


@dataclass(frozen=True, eq=False)
class TreeDynamics:
    """The dynamics of a tree. Coulomb friction can stick in the coordinates `dry`, or is smooth if `dry` is empty."""

    tree: Tree
    numbers: Numbers
    dry: tuple[int, ...] = ()
    method: Method = ORDER_8
    frozen: bool = False  # whether derivatives use the equations linearized at the midpoint of a step
    slip: float = SLIP_SPEED  # [rad/s or m/s] over which smooth friction changes its sign

    @property
    def nv(self) -> int:
        return int(self.tree.spread.shape[1])

    @property
    def is_dry(self) -> Mask:
        """Whether each coordinate (nv,) can stick."""
        return np.isin(np.arange(self.nv), self.dry)

    @property
    def friction(self) -> Array:
        """The largest friction (nv,) along each coordinate: that of its joint and of the joint's followers."""
        return np.asarray(self.numbers.coulomb @ np.abs(self.tree.spread))

    @cached_property
    def links(self) -> CompiledTree:
        return self.tree.with_numbers(self.numbers)

    @cached_property
    def _system(self) -> Any:
        tree = self.tree
        coupling, nq = tree.coupling, self.links.nq
        follow = (np.arange(nq), np.ones(nq), np.zeros(nq))
        if coupling is not None:
            follow = (coupling.of_q, coupling.ratio_q, coupling.offset)
        of_joints, of_servos = ([getattr(self.numbers, n) for n in names] for names in (OF_JOINTS, OF_SERVOS))
        starts = reversed(tree.coordinates.starts)
        arrays = (*follow, tree.spread, *starts, tree.positions, *of_joints, tree.servo, *of_servos)
        return kernel(KERNEL).TreeSystem(self.links.tables, *map(_array, arrays), 0.0 if self.dry else self.slip)

    def _push(self, u: Array) -> Array:
        """Return the forces (N, n) of inputs u (N, nu); for servos, the commanded positions."""
        inputs = np.clip(u, -self.numbers.limit, self.numbers.limit) * self.numbers.strength
        return np.asarray(np.where(self.tree.commanded, u, inputs) @ self.tree.actuation.T)

    def grip(self, x: Array, u: Array, released: Array | None = None) -> Grip:
        """Return the grip at x (N, nx); joints at rest stick unless they are `released` or the force is too large."""
        v, free = x[:, -self.nv :], np.zeros((len(x), self.nv)) if released is None else released
        turn = np.where(self.is_dry, np.where(np.abs(v) > REST, np.sign(v), free), 0.0)
        grip = Grip(turn, (self.is_dry & (turn == 0)).astype(float))
        for _ in self.dry:
            _, holding = self.accelerate_and_hold(x, u, grip)
            beyond = np.where(grip.held > 0, np.abs(holding) - self.friction, -np.inf)
            rows, j = np.arange(len(x)), np.argmax(beyond, axis=1)
            let = beyond[rows, j] > 0
            if not np.any(let):
                break
            turn[rows[let], j[let]] = np.sign(holding[rows[let], j[let]])
            grip.held[rows[let], j[let]] = 0.0
        return grip

    def accelerate(self, x: Array, u: Array) -> Array:
        """Return the accelerations (N, nv) at x (N, nx) under u (N, nu)."""
        return self.accelerate_and_hold(x, u, self.grip(x, u))[0]

    def accelerate_and_hold(self, x: Array, u: Array, grip: Grip) -> tuple[Array, Array]:
        """Return the accelerations (N, nv), and the friction forces (N, nv) on sticking joints."""
        a, holding = np.empty((2, len(x), self.nv))
        kernel(KERNEL).accelerate(self._system, *map(_array, (x, self._push(u), *grip)), a, holding)
        return a, holding

    def step(self, x: Array, h: Array, u: Array, grip: Grip | None = None) -> Array:
        """Return the states (N, nx) after steps of h (N,) [s] from x under u (N, nu)."""
        nothing, out = np.zeros((len(x), self.nv)), np.empty(x.shape)
        grip = Grip(nothing, nothing) if grip is None else grip
        points = map(_array, (*self.method, x, h, self._push(u), *grip))
        kernel(KERNEL).step(self._system, *points, out)
        return out

    def step_jacobians(self, x: Array, h: Array, u: Array, by: Array, grip: Grip | None = None) -> Array:
        """Return the Jacobians (N, nx, nx + P) of these steps; `by` (count, P) is d numbers / d parameters."""
        (N, nx), nothing, h = x.shape, np.zeros((len(x), self.nv)), h[:, None, None]
        grip = Grip(nothing, nothing) if grip is None else grip
        if self.frozen:
            # d' = J d + C with J, C at the midpoint, solved by the diagonal Pade approximation of exp of order 4
            halfway = replace(self, method=ORDER_4).step(x, h[:, 0, 0] / 2, u, grip)
            _, J, C = self._rates(halfway, u, by, grip)
            X, identity = h * J, np.eye(nx)
            even = identity + X @ X / 12
            return np.linalg.solve(even - X / 2, np.concatenate([even + X / 2, h * C], axis=2))
        stages, weights = self.method
        start = np.zeros((N, nx, nx + by.shape[1]))
        start[:, :, :nx] = np.eye(nx)
        rates, changes = np.empty((len(weights), N, nx)), np.empty((len(weights), *start.shape))
        for m, row in enumerate(stages):
            y = x + h[..., 0] * np.tensordot(row[:m], rates[:m], 1)
            rates[m], J, C = self._rates(y, u, by, grip)
            changes[m] = J @ (start + h * np.tensordot(row[:m], changes[:m], 1))
            changes[m, :, :, nx:] += C
        return np.asarray(start + h * np.tensordot(weights, changes, 1))

    def _rates(self, x: Array, u: Array, by: Array, grip: Grip) -> tuple[Array, Array, Array]:
        """Return dx/dt (N, nx), and its derivatives with respect to x (N, nx, nx) and parameters (N, nx, P)."""
        (N, nx), nv, coordinates = x.shape, self.nv, self.tree.coordinates
        q, v, nq = x[:, : nx - nv], x[:, -nv:], nx - nv
        a, by_state = self.acceleration_jacobians(x, u, by, grip)
        J, C, rate = np.zeros((N, nx, nx)), np.zeros((N, nx, by.shape[1])), coordinates.rate(q)
        J[:, :nq, :nq], J[:, :nq, nq:] = coordinates.rate_by_position(v), rate
        J[:, nq:, :nq], J[:, nq:, nq:] = by_state[..., :nv] @ coordinates.motion(q), by_state[..., nv : 2 * nv]
        C[:, nq:] = by_state[..., 2 * nv :]
        return np.concatenate([(rate @ v[..., None])[..., 0], a], axis=1), J, C

    def acceleration_jacobians(self, x: Array, u: Array, by: Array, grip: Grip | None = None) -> tuple[Array, Array]:
        """Return accelerations (N, nv), derivatives (N, nv, 2 nv + P) with respect to q (tangent), v, parameters."""
        tree, numbers, nv, n = self.tree, self.numbers, self.nv, self.tree.n
        grip, E, places = self.grip(x, u) if grip is None else grip, self.tree.spread, self.numbers.places
        a, _ = self.accelerate_and_hold(x, u, grip)
        q, v = tree.joint_positions(x[:, : x.shape[1] - nv]), x[:, -nv:] @ E.T
        _, mass, jacobians = self.inverse_dynamics(q, v, a @ E.T, by)
        slide, diagonal = grip.turn @ np.sign(E).T, np.arange(n)
        jacobians[:, diagonal, diagonal] += numbers.stiffness
        jacobians[:, diagonal, n + diagonal] += numbers.damping
        if not self.dry:
            slide = np.tanh(v / self.slip)
            jacobians[:, diagonal, n + diagonal] += numbers.coulomb / self.slip * (1 - slide**2)
        terms = (a @ E.T, v, q[:, tree.positions] - numbers.rest, -numbers.stiffness, slide)
        for name, term in zip(OF_JOINTS, terms, strict=True):
            jacobians[..., 2 * n :] += np.broadcast_to(term, v.shape)[..., None] * by[places(name)]
        jacobians[..., 2 * n :] -= tree.actuation @ self._by_input(u, q, v, jacobians, by)
        columns = [jacobians[..., :n] @ E, jacobians[..., n : 2 * n] @ E, jacobians[..., 2 * n :]]
        free = 1 - grip.held[..., None]
        right = free * (E.T @ np.concatenate(columns, axis=2))
        M = E.T @ (mass + np.diag(numbers.reflected)) @ E
        M = M * free * np.swapaxes(free, 1, 2) + np.eye(nv) * (1 - free)
        return a, np.asarray(-np.linalg.solve(M, right), dtype=float)

    def _by_input(self, u: Array, q: Array, v: Array, jacobians: Array, by: Array) -> Array:
        """Return the derivatives (N, nu, P) of efforts by parameters; add those of servos by q and v to `jacobians`."""
        numbers, places, n = self.numbers, self.numbers.places, self.tree.n
        joints = np.flatnonzero(self.tree.servo >= 0)
        inputs, (lag, speed) = self.tree.servo[joints], np.zeros((2, *u.shape))
        lag[:, inputs], speed[:, inputs] = u[:, inputs] - q[:, self.tree.positions[joints]], -v[:, joints]
        force = np.where(self.tree.commanded, numbers.kp * lag + numbers.kd * speed, u)
        is_free = np.abs(force) <= numbers.limit
        by_force = np.where(is_free, numbers.strength, 0.0)
        terms = {
            "kp": lag * by_force,
            "kd": speed * by_force,
            "strength": np.clip(force, -numbers.limit, numbers.limit),
            "limit": np.where(is_free, 0.0, np.sign(force) * numbers.strength),
        }
        jacobians[:, joints, joints] += (by_force * numbers.kp)[:, inputs]
        jacobians[:, joints, n + joints] += (by_force * numbers.kd)[:, inputs]
        return np.asarray(sum(term[..., None] * by[places(name)] for name, term in terms.items()))

    def inverse_dynamics(self, q: Array, v: Array, a: Array, by: Array | None = None) -> tuple[Array, Array, Array]:
        """Return tau (N, n), mass (N, n, n), and d tau (N, n, 2 n + P) with respect to q's tangent, v and parameters.

        q, v and a are those of all joints, including mimic joints.
        """
        moved = self.links(q, v, a, derivatives=by is not None)
        if by is None:
            return moved.tau, moved.mass, np.concatenate([moved.by_q, moved.by_v], axis=2)
        places = self.numbers.places
        by_parameters = np.zeros((*v.shape, by.shape[1]))
        ten = by[places("inertial").ravel()]
        if np.any(ten):
            by_parameters += self._regressors(moved, v, a).reshape(*v.shape, -1) @ ten
        others = np.concatenate([places("offset").ravel(), places("gravity")])
        for p in np.flatnonzero(np.any(by[others] != 0, axis=0)):
            change = np.zeros(len(by))
            change[others] = SHIFT * by[others, p]
            ends = [self.tree.with_numbers(self.numbers.moved(sign * change)) for sign in (1, -1)]
            ahead, back = (end(q, v, a, derivatives=False).tau for end in ends)
            by_parameters[..., p] += (ahead - back) / (2 * SHIFT)
        return moved.tau, moved.mass, np.concatenate([moved.by_q, moved.by_v, by_parameters], axis=2)

    def frames(self, q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """Return poses (N, L, 3, 4) of the links, and velocities and accelerations (N, L, 6) in the links' frames.

        q, v and a are those of all joints. The accelerations are relative to free fall.
        """
        moved = self.links(q, v, a, derivatives=False)
        motion, change, _ = self._motions(moved, v, a)
        joints = self.links.tables.joint
        X = moved.poses.reshape(-1, 3, 4)
        V, A = (_in_frame(X, m[:, joints].reshape(-1, 1, 6)).reshape(len(q), -1, 6) for m in (motion, change))
        return moved.poses, V, A

    def _motions(self, moved: Moved, v: Array, a: Array) -> tuple[Array, Array, Mask]:
        """Return joint velocities and accelerations (N, J, 6) at the world's origin, and a mask (J, n) of ancestors."""
        t, (N, n), S = self.links.tables, v.shape, moved.S
        J = len(t.parent)
        V, A = np.zeros((2, N, J + 1, 6))  # the last entry is the world, with index -1
        A[:, J, 3:] = -t.gravity
        carries = np.zeros((J + 1, n), dtype=bool)
        for j, (up, first, size) in enumerate(zip(t.parent, t.first, t.size, strict=True)):
            s = slice(first, first + size)
            turned = _cross_motion(V[:, None, up], S[:, s])
            V[:, j] = V[:, up] + np.sum(v[:, s, None] * S[:, s], axis=1)
            A[:, j] = A[:, up] + np.sum(a[:, s, None] * S[:, s] + v[:, s, None] * turned, axis=1)
            carries[j] = carries[up]
            carries[j, s] = True
        return V, A, carries

    def regressors(self, q: Array, v: Array, a: Array) -> Array:
        """Return the derivatives (N, n, L, 10) of inverse dynamics with respect to the ten numbers of each link."""
        return self._regressors(self.links(q, v, a, derivatives=False), v, a)

    def _regressors(self, moved: Moved, v: Array, a: Array) -> Array:
        V, A, carries = self._motions(moved, v, a)
        joints = self.links.tables.joint
        regressors = np.zeros((*v.shape, len(joints), 10))
        for link, j in enumerate(joints):
            columns, X = np.flatnonzero(carries[j]), moved.poses[:, link]
            along = [_in_frame(X, motion) for motion in (V[:, None, j], A[:, None, j], moved.S[:, columns])]
            regressors[:, columns, link] = along[2] @ _wrench(along[0][:, 0], along[1][:, 0])
        return regressors

    @property
    def efforts(self) -> Array:
        """The matrix (nv, nu) from inputs to generalized forces."""
        return np.asarray(self.tree.spread.T @ (self.tree.actuation * self.numbers.strength))

    def inputs_for(self, x: Array, a: Array) -> Array:
        """Return inputs (N, nu) for accelerations a (N, nv), by least squares and without regard to limits."""
        free = self.accelerate(x, np.zeros((len(x), self.tree.actuation.shape[1])))
        needed = (self.mass(x) @ (a - free)[..., None])[..., 0]
        return np.asarray(needed @ np.linalg.pinv(self.efforts).T)

    def mass(self, x: Array) -> Array:
        """Return the mass matrices (N, nv, nv), including reflected inertia."""
        tree, still = self.tree, np.zeros((len(x), self.tree.n))
        mass = self.inverse_dynamics(tree.joint_positions(x[:, : x.shape[1] - self.nv]), still, still)[1]
        return np.asarray(tree.spread.T @ (mass + np.diag(self.numbers.reflected)) @ tree.spread)


@dataclass(frozen=True, eq=False)
class Branch:
    """A part of a tree that moves independently of the others, as a leg on a fixed base."""

    tree: Tree
    states: Indices  # (nx,) its entries in a state of the whole tree
    tangent: Indices  # (2 nv,) its entries in a tangent vector
    inputs: Indices  # (nu,)
    numbers: Mapping[str, Indices]  # the places of its numbers in `flat` of the whole tree

    @property
    def flat(self) -> Indices:
        """The places (count,) of all its numbers."""
        return np.concatenate([np.ravel(places) for places in self.numbers.values()])

    def restrict(self, dynamics: TreeDynamics) -> TreeDynamics:
        """Return the dynamics of this part of a whole tree."""
        flat, v = dynamics.numbers.flat, self.tangent[: len(self.tangent) // 2]
        numbers = Numbers(**{name: flat[places] for name, places in self.numbers.items()})
        dry = tuple(int(i) for i in np.flatnonzero(np.isin(v, dynamics.dry)))
        return replace(dynamics, tree=self.tree, numbers=numbers, dry=dry)


def undivided(tree: Tree) -> Branch:
    """Return the branch that is the whole tree."""
    nx, nv, names = tree.coordinates.nq + tree.coordinates.nv, tree.coordinates.nv, vars(tree.numbers)
    places = {name: tree.numbers.places(name) for name in names}
    return Branch(tree, np.arange(nx), np.arange(2 * nv), np.arange(tree.actuation.shape[1]), places)


def branches_of(tree: Tree) -> tuple[Branch, ...]:
    """Return the independent branches of a tree; one if it has free bodies or mimic joints, which may couple them."""
    if tree.coupling is not None or tree.coordinates.free or not tree.links:
        return (undivided(tree),)
    roots = list(range(len(tree.links)))
    for i, link in enumerate(tree.links):
        roots[i] = i if link.parent < 0 else roots[link.parent]
    branches, t, nq = [], tree.compiled.tables, tree.coordinates.nq
    for root in np.unique(roots):
        links = np.flatnonzero(np.array(roots) == root)
        count, v = np.arange(len(links)), t.first[links]
        inputs = np.flatnonzero(np.any(tree.actuation[v] != 0, axis=0))
        parent = np.where(t.parent[links] < 0, -1, np.searchsorted(links, t.parent[links]))
        changed = {name: _array(getattr(t, name)[links]) for name in PER_LINK}
        changed |= dict.fromkeys(("link_parent", "parent"), parent)
        changed |= dict.fromkeys(("joint", "q_start", "v_start", "first"), count)
        rows = {"inertial": links, "offset": links, "gravity": np.arange(3)}
        rows |= dict.fromkeys(OF_JOINTS, v) | dict.fromkeys(OF_SERVOS, inputs)
        numbers = {name: tree.numbers.places(name)[rows[name]] for name in vars(tree.numbers)}
        some = replace(
            tree,
            links=tuple(tree.links[i] for i in links),
            compiled=CompiledTree(
                t._replace(**changed), {tree.links[i].joint.body: k for k, i in enumerate(links)}, len(links)
            ),
            coordinates=Coordinates((), tuple((k, k) for k in range(len(links)))),
            positions=count,
            damping=tree.damping[v],
            actuation=tree.actuation[np.ix_(v, inputs)],
            servo=np.where(tree.servo[v] < 0, -1, np.searchsorted(inputs, tree.servo[v])),
        )
        states, tangent = np.concatenate([tree.positions[v], nq + v]), np.concatenate([v, nq + v])
        branches.append(Branch(some, states, tangent, inputs, numbers))
    return tuple(branches)


def _array(values: Any) -> Any:
    """Return a contiguous array of float64 or int64; for other arrays the kernel would be compiled again."""
    array = np.asarray(values)
    return np.ascontiguousarray(array, dtype=np.int64 if array.dtype.kind == "i" else float)


def _cross_motion(motion: Array, other: Array) -> Array:
    w, moving = motion[..., :3], cross(motion[..., :3], other[..., 3:])
    return np.concatenate([cross(w, other[..., :3]), moving + cross(motion[..., 3:], other[..., :3])], axis=-1)


def _in_frame(X: Array, motion: Array) -> Array:
    """Transform spatial vectors (N, k, 6) about the world's origin to frames with poses X (N, 3, 4)."""
    R, p = X[:, :, :3], X[:, None, :, 3]
    w = motion[..., :3]
    return np.concatenate([w @ R, (motion[..., 3:] + cross(w, p)) @ R], axis=2)


def _wrench(motion: Array, change: Array) -> Array:
    """Return the regressor (N, 6, 10) of moment and force on a link for its velocity and acceleration (N, 6)."""
    w, w_dot = motion[:, :3], change[:, :3]
    a = change[:, 3:] + cross(w, motion[:, 3:])
    turn, wrench = skew(w), np.zeros((len(w), 6, 10))
    wrench[:, 3:, 0] = a
    wrench[:, :3, 1:4], wrench[:, 3:, 1:4] = -skew(a), skew(w_dot) + turn @ turn
    wrench[:, :3, 4:] = _spun(w_dot) + turn @ _spun(w)
    return wrench


def _spun(w: Array) -> Array:
    """Return the matrix (N, 3, 6) from inertia (xx yy zz xy xz yz) to inertia times w (N, 3)."""
    spun = np.zeros((len(w), 3, 6))
    for k, (i, j) in enumerate(INERTIA):
        spun[:, i, k], spun[:, j, k] = w[:, j], w[:, i]
    return spun


def tree_for_identification(model: Model, *, servos: bool = False) -> Tree | Refusal:
    """Return the tree of a model with its own values, or a Refusal that names what a tree cannot represent.

    With `servos`, inputs may be commanded positions.
    """
    if model.num_constraints:
        return Refusal("joints are held by constraints")
    commanded = model.inputs.commanded
    controllers = sum(actuator.has_controller() for actuator in actuators(model.plant))
    if controllers and not (servos and np.sum(commanded) == controllers):
        return Refusal("actuators have PD controllers in the plant")
    dynamics, springs = tree_of(model, free=True), springs_of(model.plant)
    if isinstance(dynamics, Refusal):
        return dynamics
    if isinstance(springs, Refusal):
        return springs
    bodies, links = read_links(model.plant, springs), dynamics.links
    if any(link.stiffness != 0 and link.kind == "quaternion_floating" for link in bodies):
        raise ModelError("a free body has a spring")
    motors = actuators(model.plant)
    limits = model.inputs.of_actuators([actuator.effort_limit() for actuator in motors])
    numbers = Numbers(
        inertial=np.array([numbers_of(link) for link in links]).reshape(-1, 10),
        offset=np.array([link.on_parent.translation() for link in links]).reshape(-1, 3),
        gravity=dynamics.gravity,
        damping=dynamics.damping,
        reflected=dynamics.reflected,
        stiffness=dynamics.stiffness,
        rest=dynamics.rest,
        coulomb=np.zeros(len(dynamics.damping)),
        strength=np.ones(model.nu),
        limit=np.asarray(limits, dtype=float),
        kp=np.where(commanded, model.servo_gains[0], 0.0),
        kd=np.where(commanded, model.servo_gains[1], 0.0),
    )
    actuation = model.inputs.of_actuators(np.asarray(model.plant.MakeActuationMatrix()).T[: len(motors)]).T
    by_servo = (actuation != 0) & commanded
    if np.any(by_servo.any(axis=1) & (np.count_nonzero(actuation, axis=1) > 1)):
        return Refusal("a joint with a servo has another actuator")
    names = ["world", *(link.joint.body for link in links)]
    rigid = [
        replace(
            link.joint, parent=names[link.parent + 1], on_parent=link.on_parent, on_child=RigidTransform(),
            mass=link.mass, center_of_mass=link.center_of_mass, inertia=link.inertia,
        )
        for link in links
    ]  # fmt: skip
    compiled = compile_links(rigid, dynamics.gravity, len(dynamics.damping))
    if compiled is None:
        return Refusal("a free body is not joined to the world by its own frame")
    return Tree(
        **{**vars(dynamics), "compiled": compiled},
        coordinates=coordinates_of(model),
        actuation=actuation,
        servo=np.where(by_servo.any(axis=1), np.argmax(by_servo, axis=1) if model.nu else 0, -1),
        moved_by={body: _moved_by(pose) for body, (_, pose) in dynamics.on.items()},
        bodies={link.body: link for link in bodies},
        numbers=numbers,
    )


def ten_numbers(mass: Any, center: Any, inertia: Any) -> Any:
    """Return the ten numbers for mass, centre of mass (3,) and inertia (6,) about the centre; complex or float."""
    x, y, z = center
    about = [y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z]
    return np.array([mass, *(mass * c for c in center), *(i + mass * s for i, s in zip(inertia, about, strict=True))])


def numbers_of(link: Link | RigidLink) -> Array:
    """Return the ten numbers of a body in its own frame, or of a link with its welded bodies in the link's frame."""
    return np.asarray(ten_numbers(link.mass, link.center_of_mass, link.inertia[tuple(np.transpose(INERTIA))]))


def _moved_by(pose: Any) -> Array:
    """Return the map (10, 10) of a body's ten numbers to a frame in which the body's frame has this pose."""
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

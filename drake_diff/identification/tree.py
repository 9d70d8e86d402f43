"""The accelerations of a tree at many states in one call, as functions of the numbers that parameters set.

    M(q) a = B (strength * u) - C(q, v) v + gravity - springs - damping v - coulomb tanh(v / v_s)

where dry friction turns over a small speed; `identification.dry` has the one that holds.

The force of inverse dynamics is linear in each link's ten numbers: mass, mass times centre of mass, inertia about the
frame's origin. So is it in damping, stiffness, friction and gravity, and

    da / dnumber = M^-1 (d force / dnumber - d inverse dynamics / dnumber)   at fixed q, v and a.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, Indices, skew
from drake_diff._base.refusal import Refusal
from drake_diff.exceptions import ModelError
from drake_diff.identification.compiled import INERTIA
from drake_diff.mechanics.description import Link, RigidLink, read_links, springs_of, without_welds
from drake_diff.mechanics.numpy_tree import TreeDynamics, tree_of
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators

SLIP_SPEED = 0.02  # v_s [rad/s or m/s] over which dry friction turns: Drake's joints have none, so nothing gives one
Mask = NDArray[np.bool_]
Grip = tuple[Array, Mask]  # what dry friction does: which way each coordinate slides, and which of them it holds


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

    def of_all(self, turn: Array) -> Array:
        """(N, n) which way each joint slides, of which way coordinates do (N, nv)."""
        coupling = self.dynamics.coupling
        return turn if coupling is None else np.asarray(turn @ np.sign(coupling.spread).T)

    def all_of(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Positions and velocities of all joints, those that follow another included."""
        coupling = self.dynamics.coupling
        return (q, v) if coupling is None else (coupling.positions(q), coupling.velocities(v))

    def own(self, matrix: Array) -> Array:
        """(N, nv, nv) a matrix (N, n, n) of all joints, of the independent coordinates."""
        coupling = self.dynamics.coupling
        return matrix if coupling is None else np.asarray(coupling.spread.T @ matrix @ coupling.spread)

    def along(self, force: Array) -> Array:
        """(N, nv) of forces (N, n)."""
        coupling = self.dynamics.coupling
        return force if coupling is None else np.asarray(force @ coupling.spread)

    def along_columns(self, columns: Array) -> Array:
        """(N, nv, k) of (N, n, k)."""
        coupling = self.dynamics.coupling
        return columns if coupling is None else np.asarray(coupling.spread.T @ columns)


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
            own = ten_numbers(link.mass, link.center_of_mass, link.inertia[tuple(np.transpose(INERTIA))])
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

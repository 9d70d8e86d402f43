"""Drake's coordinates in a MuJoCo model, by name: order, quaternions, velocities of free bodies. Without MuJoCo itself.

A free body's native velocity is (v in world, w in the body): v_native = Q v with Q = [[0, 1], [R', 0]].
"""

from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, skew
from drake_diff.exceptions import InputError
from drake_diff.mechanics.coordinates import rotation, unit
from drake_diff.mechanics.description import Description

KINDS = {0: "quaternion_floating", 1: "ball", 2: "prismatic", 3: "revolute"}  # mjtJoint


class MujocoCoordinates:
    """Drake's joints and actuators in `m` (MjModel or mjx.Model); InputError where they are not there by name."""

    def __init__(self, description: Description, m: Any):
        self.coordinates = description.coordinates
        self.nq, self.nv = self.coordinates.nq, self.coordinates.nv
        wanted = description.moving
        ids = {name_of(m, m.name_jntadr[j]): j for j in range(m.njnt)}
        drives = {name_of(m, m.name_actuatoradr[i]): i for i in range(m.nu)}
        sides = (("joints", [x.joint for x in wanted], ids), ("actuators", list(description.inputs), drives))
        for kind, names, known in sides:
            if set(names) != set(known):
                expected = f"those of the plant, {sorted(names)}"
                raise InputError(f"{kind} of the MJCF", got=sorted(known), expected=expected)
        self.joints = [ids[x.joint] for x in wanted]
        self.actuator = [drives[name] for name in description.inputs]
        self.positions, self.dofs = np.zeros(self.nq, dtype=int), np.zeros(self.nv, dtype=int)
        for x, j in zip(wanted, self.joints, strict=True):
            if KINDS[int(m.jnt_type[j])] != x.kind:
                raise InputError(f"joint {x.joint} of the MJCF", got=KINDS[int(m.jnt_type[j])], expected=x.kind)
            at_q, at_v = int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
            if x.kind == "quaternion_floating":
                self.positions[x.q_start : x.q_start + 7] = at_q + np.array([3, 4, 5, 6, 0, 1, 2])
                self.dofs[x.v_start : x.v_start + 6] = at_v + np.array([3, 4, 5, 0, 1, 2])
            else:
                self.positions[x.q_start], self.dofs[x.v_start] = at_q, at_v

    def to_native(self, x: Array) -> tuple[Array, Array]:
        """qpos (nq,) and qvel (nv,), quaternions of norm 1."""
        q = unit(self.coordinates, x[: self.nq])
        qpos = np.empty(self.nq)
        qpos[self.positions] = q
        return qpos, self.turn(q) @ x[self.nq :]

    def to_drake(self, qpos: Array, qvel: Array) -> Array:
        """x (nx,)."""
        q = np.array(qpos[self.positions])
        return np.concatenate([q, self.turn(q).T @ qvel])

    def control(self, u: Array) -> Array:
        """ctrl (nu,)."""
        ctrl = np.empty(len(self.actuator))
        ctrl[self.actuator] = u
        return ctrl

    def turn(self, q: Array) -> Array:
        """Q (nv, nv) with v_native = Q v."""
        Q = np.zeros((self.nv, self.nv))
        Q[self.dofs, np.arange(self.nv)] = 1.0
        for i, j in self.coordinates.free:
            Q[np.ix_(self.dofs[j : j + 3], np.arange(j, j + 3))] = rotation(q[i : i + 4]).T
        return Q

    def jacobian(self, x: Array, x_next: Array, A: Array, B: Array) -> tuple[Array, Array]:
        """Drake's A (nx, nx) and B (nx, nu), from MuJoCo's in its tangent coordinates, (2 nv, 2 nv) and (2 nv, nu)."""
        into, out = self._tangent_map(x), np.linalg.inv(self._tangent_map(x_next))
        W, N = self.coordinates.motion(x[: self.nq]), self.coordinates.rate(x_next[: self.nq])
        eye = np.eye(self.nv)
        narrow, wide = _diagonal(W, eye), _diagonal(N, eye)
        return wide @ out @ A @ into @ narrow, wide @ out @ B[:, self.actuator]

    def on_tangent(self, x: Array, x_next: Array, by_native: Array) -> tuple[Array, Array]:
        """A and B for `jacobian`, from the step's derivative by qpos, qvel and ctrl, (nq + nv, nq + nv + nu)."""
        n, eye = self.nq + self.nv, np.eye(self.nv)
        q, q_next = (unit(self.coordinates, state[: self.nq]) for state in (x, x_next))
        move, see = np.zeros((self.nq, self.nv)), np.zeros((self.nv, self.nq))
        move[self.positions] = self.coordinates.rate(q) @ self.turn(q).T
        see[:, self.positions] = self.turn(q_next) @ self.coordinates.motion(q_next)
        narrowed = _diagonal(see, eye) @ by_native
        return narrowed[:, :n] @ _diagonal(move, eye), narrowed[:, n:]

    def _tangent_map(self, x: Array) -> Array:
        """(2 nv, 2 nv) from Drake's (small motion, dv) to MuJoCo's."""
        q, v = x[: self.nq], x[self.nq :]
        T = _diagonal(self.turn(q), self.turn(q))
        for i, j in self.coordinates.free:
            by_turn = rotation(q[i : i + 4]).T @ skew(v[j : j + 3])
            T[np.ix_(self.nv + self.dofs[j : j + 3], np.arange(j, j + 3))] = by_turn
        return T


def name_of(m: Any, address: Any) -> str:
    """The name at this address of the model's text."""
    start = int(address)
    return str(m.names[start : m.names.index(b"\0", start)].decode())


def _diagonal(a: Array, b: Array) -> Array:
    (m, n), (r, s) = a.shape, b.shape
    return np.block([[a, np.zeros((m, s))], [np.zeros((r, n)), b]])

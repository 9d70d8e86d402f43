"""The dynamics of a tree of hinges, slides and free bodies as CasADi expressions, and their derivatives in closed form.

Bodies are moved by spatial vectors [angular; linear] in world about its origin (Featherstone, "Rigid Body Dynamics
Algorithms", 2008, ch. 5 and 6). A joint K moves its body by the columns s of S_K, which the body P before it carries
along: a hinge, a slide, and a free body's three slides and, after them, its turn. With x and x* the cross products of
motions and forces, V_K the velocity of the joint's body, A_K its acceleration less gravity's, and

    P_s = V_K x s,   T_s = (V_P + V_K) x s,   Q_s = A_K x s + V_K x P_s,
    B m = V x* (I m) - I (V x m) + m x* (I V),

the force F on all that joint K carries (I and B are sums over it) changes along s, and with the speed along s, by

    I Q_s + B P_s + s x* F,   I T_s + B s.

Torques of joints below K lack the last term, as their axes turn with the bodies. This is what Singh, Russell and
Wensing have for joints of one degree of freedom ("Efficient analytical derivatives of rigid-body dynamics using spatial
vector algebra", 2022), written so that it holds for velocities in the parent's axes as well, as Drake's free bodies
have them.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array
from drake_diff.mechanics.description import Description, RigidLink, names_of, without_welds
from drake_diff.model.model import Model


@dataclass(frozen=True, eq=False)
class _Joint:
    """Degrees of freedom that move together: a hinge, a slide, or a free body's slides or turn."""

    link: int
    parent: int  # in the tree's joints, -1 for the world
    dofs: list[int]


class Tree:
    """Poses, motions, mass matrix and bias of a description's tree at the state x, as expressions."""

    def __init__(self, description: Description, model: Model, x: Any):
        self.description, self.nv = description, model.nv
        self.q, self.v = x[: model.nq], x[model.nq :]
        links, on, _ = without_welds(description.links)
        body_names = names_of(model.plant)[0]
        self.on = {index: on[name] for index, name in body_names.items()}
        self.poses: list[tuple[Any, Any]] = []
        self.above: list[list[int]] = []  # the degrees of freedom that move each link
        self.S = ca.SX(6, self.nv)
        self.links, self.joints = links, list[_Joint]()
        self._last: list[int] = []  # of each link, the joint that moves it
        for link in links:
            self._place(link)
        self._inertias = [self._inertia(i) for i in range(len(links))]

    def _place(self, link: RigidLink) -> None:
        R, p = (ca.SX.eye(3), ca.SX.zeros(3)) if link.parent < 0 else self.poses[link.parent]
        R, p = _times((R, p), link.on_parent)
        joint, above = link.joint, [] if link.parent < 0 else self.above[link.parent]
        before, here = -1 if link.parent < 0 else self._last[link.parent], len(self.poses)
        i, k = joint.q_start, joint.v_start
        if link.free:
            p = p + R @ self.q[i + 4 : i + 7]
            own = [k + j for j in range(6)]
            for j in range(3):
                axis = R[:, j]
                self.S[:, k + j] = ca.vertcat(axis, ca.cross(p, axis))
                self.S[3:, k + 3 + j] = axis
            R = R @ _rotation(self.q[i : i + 4])
            self.joints += [_Joint(here, before, own[3:]), _Joint(here, len(self.joints), own[:3])]
        else:
            axis, own = R @ ca.DM(link.axis), [k]
            if joint.kind == "revolute":
                self.S[:, k] = ca.vertcat(axis, ca.cross(p, axis))
                R = R @ _about(link.axis, self.q[i])
            else:
                self.S[3:, k] = axis
                p = p + axis * self.q[i]
            self.joints.append(_Joint(here, before, own))
        self._last.append(len(self.joints) - 1)
        self.poses.append((R, p))
        self.above.append([*above, *own])

    @property
    def position_rates(self) -> Any:
        """(nq,) q'."""
        found = ca.SX.zeros(self.q.numel())
        for link in self.description.moving:
            i, k = link.q_start, link.v_start
            if link.kind != "quaternion_floating":
                found[i] = self.v[k]
                continue
            found[i : i + 4] = _quaternion_rates(self.q[i : i + 4]) @ self.v[k : k + 3]
            found[i + 4 : i + 7] = self.v[k + 3 : k + 6]
        return found

    @property
    def turns(self) -> Any:
        """(nv, nq) how the bodies move with q, along the velocities."""
        found = ca.SX(self.nv, self.q.numel())
        for link in self.description.moving:
            i, k = link.q_start, link.v_start
            if link.kind != "quaternion_floating":
                found[k, i] = 1
                continue
            q = self.q[i : i + 4]
            found[k : k + 3, i : i + 4] = 4 / ca.sumsqr(q) * _quaternion_rates(q).T
            found[k + 3 : k + 6, i + 4 : i + 7] = ca.SX.eye(3)
        return found

    def force(self, u: Any) -> Any:
        """(nv,) what moves the tree at q, v under the inputs, contact apart."""
        description = self.description
        limits = ca.DM(description.effort_limits)
        effort = ca.fmin(ca.fmax(u, -limits), limits) if u.numel() else u
        total = ca.DM(description.actuation) @ effort - self.inverse(ca.SX.zeros(self.nv))[0]
        damping, stiffness = (ca.DM(description.by_velocity(name)) for name in ("damping", "stiffness"))
        total -= damping * self.v
        for link in description.moving:
            if link.stiffness:
                total[link.v_start] -= stiffness[link.v_start] * (self.q[link.q_start] - link.rest)
        return total

    def force_slopes(self, acceleration: Any) -> tuple[Any, Any]:
        """(nv, nq) and (nv, nv) of `force` less what the mass matrix gives at a fixed `acceleration` (nv,)."""
        by_motion, by_v = self._inverse_slopes(acceleration)
        by_q = by_motion @ self.turns
        for link in self.description.moving:
            if link.stiffness:
                by_q[link.v_start, link.q_start] += link.stiffness
        return -by_q, -(by_v + ca.diag(ca.DM(self.description.by_velocity("damping"))))

    def _inertia(self, i: int) -> Any:
        """(6, 6) of a link about the world's origin."""
        link, (R, p) = self.links[i], self.poses[i]
        c = p + R @ ca.DM(link.center_of_mass)
        C, m = ca.skew(c), link.mass
        about = R @ ca.DM(link.inertia) @ R.T - m * C @ C
        return ca.blockcat([[about, m * C], [-m * C, m * ca.SX.eye(3)]])

    def acceleration(self, u: Any, force: Any) -> Any:
        """(nv,) dv/dt under the inputs and a generalized `force` (nv,) of contact."""
        total = force + self.force(u)
        return ca.ldl_solve(total, *ca.ldl(self.mass())) if self.nv else total

    def mass(self) -> Any:
        """(nv, nv) by composite rigid bodies: M_jk = S_j' I_k S_k, I_k what k carries and j above it."""
        carried, M = list(self._inertias), ca.SX(self.nv, self.nv)
        for i in reversed(range(len(self.links))):
            link = self.links[i]
            own = range(link.joint.v_start, link.joint.v_start + (6 if link.free else 1))
            for k in own:
                momentum = carried[i] @ self.S[:, k]
                for j in self.above[i]:
                    if j <= k or j not in own:
                        M[j, k] = M[k, j] = ca.dot(self.S[:, j], momentum)
            if link.parent >= 0:
                carried[link.parent] = carried[link.parent] + carried[i]
        return M + ca.diag(ca.DM(self.description.by_velocity("armature")))

    def _motions(self, acceleration: Any) -> tuple[list[Any], list[Any]]:
        """(6,) the velocity and acceleration, gravity's taken off, of what each joint moves."""
        velocities: list[Any] = []
        accelerations: list[Any] = []
        gravity = ca.vertcat(ca.SX.zeros(3), -ca.DM(self.description.gravity))
        for joint in self.joints:
            V, A = (ca.SX.zeros(6), gravity)
            if joint.parent >= 0:
                V, A = velocities[joint.parent], accelerations[joint.parent]
            S = self.S[:, joint.dofs]
            own = S @ self.v[joint.dofs]
            accelerations.append(A + S @ acceleration[joint.dofs] + motion_cross(V, own))
            velocities.append(V + own)
        return velocities, accelerations

    def inverse(self, acceleration: Any) -> tuple[Any, list[Any], list[Any], list[Any]]:
        """(nv,) inverse dynamics without springs, damping and armature; and of each joint V, A and F."""
        velocities, accelerations = self._motions(acceleration)
        forces = []
        for at, joint in enumerate(self.joints):
            if at != self._last[joint.link]:  # the slides of a free body, which carry nothing of their own
                forces.append(ca.SX.zeros(6))
                continue
            inertia, V = self._inertias[joint.link], velocities[at]
            forces.append(inertia @ accelerations[at] + force_cross(V, inertia @ V))
        tau = ca.SX.zeros(self.nv)
        for at in reversed(range(len(self.joints))):
            joint = self.joints[at]
            tau[joint.dofs] = self.S[:, joint.dofs].T @ forces[at]
            if joint.parent >= 0:
                forces[joint.parent] = forces[joint.parent] + forces[at]
        return tau, velocities, accelerations, forces

    def _inverse_slopes(self, acceleration: Any) -> tuple[Any, Any]:
        """(nv, nv) twice, of `inverse` by the bodies' motion along the velocities, and by the velocities."""
        _, velocities, accelerations, forces = self.inverse(acceleration)
        inertias, drags = self._carried(velocities)
        by_motion, by_v = ca.SX(self.nv, self.nv), ca.SX(self.nv, self.nv)
        changes: list[tuple[Any, Any, Any]] = []
        for at, joint in enumerate(self.joints):
            S, V = self.S[:, joint.dofs], velocities[at]
            both = V + velocities[joint.parent] if joint.parent >= 0 else V
            P, T = motion_cross(V, S), motion_cross(both, S)
            Q = motion_cross(accelerations[at], S) + motion_cross(V, P)
            changes.append((P, T, Q))
            by_inertia, by_drag = S.T @ inertias[at], S.T @ drags[at]
            moved, faster = inertias[at] @ Q + drags[at] @ P, inertias[at] @ T + drags[at] @ S
            moved += force_cross(S, forces[at])
            other = at
            while other >= 0:  # it and those above it: their torques by its motion, and its torques by theirs
                dofs = self.joints[other].dofs
                by_motion[dofs, joint.dofs] = self.S[:, dofs].T @ moved
                by_v[dofs, joint.dofs] = self.S[:, dofs].T @ faster
                if other != at:
                    P, T, Q = changes[other]
                    by_motion[joint.dofs, dofs] = by_inertia @ Q + by_drag @ P
                    by_v[joint.dofs, dofs] = by_inertia @ T + by_drag @ self.S[:, dofs]
                other = self.joints[other].parent
        return by_motion, by_v

    def _carried(self, velocities: list[Any]) -> tuple[list[Any], list[Any]]:
        """(6, 6) the inertia, and what B is of, of all that each joint carries."""
        inertias, drags = [ca.SX(6, 6) for _ in self.joints], [ca.SX(6, 6) for _ in self.joints]
        for at in reversed(range(len(self.joints))):
            joint = self.joints[at]
            if at == self._last[joint.link]:
                inertia, V = self._inertias[joint.link], velocities[at]
                cross = motion_cross_matrix(V)
                inertias[at] += inertia
                drags[at] += crossed_with(inertia @ V) - cross.T @ inertia - inertia @ cross
            if joint.parent >= 0:
                inertias[joint.parent] += inertias[at]
                drags[joint.parent] += drags[at]
        return inertias, drags

    def body(self, index: Any) -> tuple[Any, Any, list[int]]:
        """Rotation and origin of one of Drake's bodies, and the degrees of freedom that move it."""
        place, pose = self.on[index]
        own = (ca.SX.eye(3), ca.SX.zeros(3)) if place < 0 else self.poses[place]
        return *_times(own, pose), [] if place < 0 else self.above[place]


def motion_cross_matrix(V: Any) -> Any:
    """(6, 6) of V x: [w^ 0; l^ w^]."""
    turn = ca.skew(V[:3])
    return ca.blockcat([[turn, ca.SX(3, 3)], [ca.skew(V[3:]), turn]])


def motion_cross(V: Any, m: Any) -> Any:
    """V x m, m (6, n)."""
    return motion_cross_matrix(V) @ m


def force_cross(motions: Any, f: Any) -> Any:
    """m x* f of motions m (6, n)."""
    return crossed_with(f) @ motions


def crossed_with(f: Any) -> Any:
    """(6, 6) of m -> m x* f: [-n^ -l^; -l^ 0]."""
    linear = -ca.skew(f[3:])
    return ca.blockcat([[-ca.skew(f[:3]), linear], [linear, ca.SX(3, 3)]])


def _times(frame: tuple[Any, Any], pose: RigidTransform) -> tuple[Any, Any]:
    R, p = frame
    return R @ ca.DM(pose.rotation().matrix()), p + R @ ca.DM(pose.translation())


def _rotation(q: Any) -> Any:
    """Of a quaternion (w, x, y, z) of any norm, as Drake reads one."""
    S, scale = ca.skew(q[1:]), 2 / ca.sumsqr(q)
    return ca.SX.eye(3) + scale * (q[0] * S + S @ S)


def _quaternion_rates(q: Any) -> Any:
    """(4, 3) q' = N w of an angular velocity w in the parent's axes."""
    return ca.vertcat(-q[1:].T, q[0] * ca.SX.eye(3) - ca.skew(q[1:])) / 2


def _about(axis: Array, angle: Any) -> Any:
    K = ca.DM(np.array(ca.skew(ca.DM(axis))))
    return ca.SX.eye(3) + ca.sin(angle) * K + (1 - ca.cos(angle)) * (K @ K)

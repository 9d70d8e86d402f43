"""Forward kinematics of the links of a tree, in ordinary arithmetic.

The functions take floats, many states at once, AutoDiffXd and symbols. A collocation traces functions of the state with
symbols to get exact second derivatives. The traced functions are compared with Drake's own values before they are used.

    R = R_parent R_F exp(axis q),  p = p_parent + R_parent p_F        of a hinge
    R = R_parent R_F,              p = p_parent + R_parent (p_F + R_F axis q)   of a slide

As in Drake, the pose of a free body is given by its quaternion, which need not be normalized, and its position. Any
other joint with several coordinates is a chain of hinges and slides, with massless virtual links between them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from drake_diff._base.arrays import Array, Indices, cross, skew
from drake_diff._base.values import Refusal
from drake_diff.mechanics.coordinates import rotation
from drake_diff.mechanics.description import Link, RigidLink, names_of, read_links, without_welds
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, joints, labelled
from drake_diff.model.repairs import JointCoupling
from drake_diff.model.step import set_state

X, Y, Z = np.eye(3)
ROUNDED = 1e-15  # smaller entries of the frames (sines of pi) are set to zero, so that products of symbols vanish
TURNS = (("revolute", Z, 2), ("revolute", Y, 1), ("revolute", X, 0))  # yaw, pitch and roll
CHAINS: dict[str, tuple[tuple[str, Array, int], ...]] = {  # the kind, axis and coordinate of each link
    "planar": (("prismatic", X, 0), ("prismatic", Y, 1), ("revolute", Z, 2)),
    "universal": (("revolute", X, 0), ("revolute", Y, 1)),
    "ball_rpy": TURNS,
    "rpy_floating": (("prismatic", X, 3), ("prismatic", Y, 4), ("prismatic", Z, 5), *TURNS),
}
RPY = "ball_rpy", "rpy_floating"
KNOWN = ("weld", "revolute", "prismatic", "quaternion_floating", *CHAINS)
SAME_PLACE = 1e-11  # [m, or entries of a rotation matrix] tolerance for rounding, absolute and relative


@dataclass(frozen=True)
class Moving:
    """A frame in the world: rotation (3, 3), origin (3,) [m], angular velocity (3,), velocity of origin (3,) [m/s]."""

    R: Any
    p: Any
    w: Any
    v: Any

    def shifted(self, R: Array, p: Array) -> "Moving":
        """Return the frame whose pose in this frame is R (3, 3), p (3,)."""
        arm = self.R @ p
        return Moving(self.R @ R, self.p + arm, self.w, self.v + cross(self.w, arm))


@dataclass(frozen=True, eq=False)
class ForwardKinematics:
    """Forward kinematics of the links of a tree, every parent before its children."""

    links: tuple[RigidLink, ...]
    on: dict[str, tuple[int, Any]]  # body -> (index of its link, -1 for the world; pose on the link)
    between: frozenset[int]  # the virtual links, which are not bodies
    carried: NDArray[np.bool_]  # (L, L) entry i, j: link j is link i or an ancestor of link i
    spins: frozenset[int]  # the hinges whose three velocities are the angular velocity in the joint's frame
    labels: dict[int, str]  # body index -> body label
    model: Model

    @property
    def nx(self) -> int:
        return self.model.nx

    @property
    def coupling(self) -> JointCoupling | None:
        """The coupling of mimic joints, if q has only the independent coordinates."""
        return self.model.coupling

    def carrier(self, link: int) -> int:
        """Return the nearest ancestor of a link that is a body, or -1 for the world."""
        parent = self.links[link].parent
        return self.carrier(parent) if parent in self.between else parent

    def __call__(self, q: Any) -> tuple[Any, Any]:
        """Return rotations (..., L + 1, 3, 3) and origins (..., L + 1, 3) of the links, world last, at q (..., nq)."""
        q = self._all(np.asarray(q))
        zero = 0.0 * q[..., :1]  # zero of the same scalar type
        world, origin = np.eye(3) + zero[..., None], np.zeros(3) + zero
        turns: list[Any] = []
        places: list[Any] = []
        for link in self.links:
            R, p = (world, origin) if link.parent < 0 else (turns[link.parent], places[link.parent])
            start, (A, b) = link.joint.q_start, _without_rounding(link.on_parent)
            if link.free:
                places.append(p + _times(R, b + _times(A, q[..., start + 4 : start + 7])))
                turns.append(R @ (A @ rotation(q[..., start : start + 4])))
                continue
            angle = q[..., start, None]
            if link.joint.kind == "revolute":
                K = skew(link.axis)
                turned = A + np.sin(angle)[..., None] * (A @ K) + (1 - np.cos(angle))[..., None] * (A @ K @ K)
                turns.append(turned if link.parent < 0 else R @ turned)
                places.append(p + _times(R, b))
            else:
                turns.append(R @ A)
                places.append(p + _times(R, b + angle * (A @ link.axis)))
        return np.stack([*turns, world], axis=-3), np.stack([*places, origin], axis=-2)

    def pushes(self, q: Array, frames: tuple[Array, Array], carriers: Indices, points: Array, ways: Array) -> Array:
        """Return the gradient (K, m, nx) of the points' motion along `ways` (K, m, 3) with respect to the state.

        The `points` (K, m, 3) are fixed in the links `carriers` (m,), at q (K, nq) with the links' `frames`.
        """
        turns, places = frames
        q = self._all(q)
        slopes = np.zeros((*points.shape[:2], max(self.nx, q.shape[1])))
        for j, link in enumerate(self.links):
            rows = np.flatnonzero((carriers >= 0) & self.carried[np.maximum(carriers, 0), j])
            if not len(rows):
                continue
            start, way = link.joint.q_start, ways[:, rows]
            arm = points[:, rows] - places[:, j, None]
            if link.free:
                A = turns[:, link.parent] @ link.on_parent.rotation().matrix()  # -1 is the world, the last entry
                slopes[:, rows, start + 4 : start + 7] = way @ A
                moment = cross(arm, way) @ A  # in the frame of the quaternion
                slopes[:, rows, start : start + 4] = moment @ _turning(q[:, start : start + 4])
                continue
            axis = (turns[:, j] @ link.axis)[:, None]
            moving = cross(axis, arm) if link.joint.kind == "revolute" else np.broadcast_to(axis, way.shape)
            slopes[:, rows, start] = np.sum(moving * way, axis=-1)
        if self.coupling is None:
            return slopes
        independent = np.zeros((*points.shape[:2], self.nx))
        for i, (k, ratio) in enumerate(zip(self.coupling.of_q, self.coupling.ratio_q, strict=True)):
            independent[:, :, k] += ratio * slopes[:, :, i]
        return independent

    def frame(self, x: Any, frame: Any, *, speeds: bool = False) -> Moving:
        """Return a `frame` of the plant at the state x (nx,), or without `speeds`, as 0, at K states (K, nx)."""
        x = np.asarray(x)
        turns, places = self(x[..., : self.model.nq])
        link, pose = self._on(frame)
        still = Moving(turns[..., link, :, :], places[..., link, :], np.zeros(3), np.zeros(3))
        return (self._moving(x, turns, places, link) if speeds else still).shifted(*pose)

    def _on(self, frame: Any) -> tuple[int, tuple[Array, Array]]:
        """Return the link that carries a frame, and the frame's rotation and origin on the link."""
        link, pose = self.on[self.labels[int(frame.body().index())]]
        return link, _without_rounding(pose @ frame.GetFixedPoseInBodyFrame())

    def _moving(self, x: Any, turns: Any, places: Any, link: int) -> Moving:
        v = x[self.model.nq :]
        v, origin = v if self.coupling is None else self.coupling.velocities(v), places[link]
        angular, linear = np.zeros(3), np.zeros(3)
        for j in np.flatnonzero(self.carried[link]) if link >= 0 else ():
            carrier, i, arm = self.links[j], self.links[j].joint.v_start, origin - places[j]
            if i < 0:
                continue
            if carrier.free or j in self.spins:
                before = turns[carrier.parent] @ _without_rounding(carrier.on_parent)[0]  # -1: the world, the last one
                spin = before @ v[i : i + 3]
                angular, linear = angular + spin, linear + cross(spin, arm)
                if carrier.free:
                    linear = linear + before @ v[i + 3 : i + 6]
                continue
            axis = (turns[j] @ carrier.axis) * v[i]
            if carrier.joint.kind == "revolute":
                angular, linear = angular + axis, linear + cross(axis, arm)
            else:
                linear = linear + axis
        return Moving(turns[link], origin, angular, linear)

    def quaternion(self, x: Any, frame: Any) -> Any:
        """Return the quaternion w, x, y, z (4,), of either sign, of `frame` in the world, at the state x (nx,)."""
        q = self._all(np.asarray(x)[: self.model.nq])
        link, (R, _) = self._on(frame)
        turned = _quaternion_of(R)
        while link >= 0:
            carrier, start = self.links[link], self.links[link].joint.q_start
            if carrier.free:
                w_xyz = q[start : start + 4]
                turned = product(w_xyz / np.sqrt(w_xyz.dot(w_xyz)), turned)
            elif carrier.joint.kind == "revolute":
                turned = product(np.array([np.cos(q[start] / 2), *(carrier.axis * np.sin(q[start] / 2))]), turned)
            turned = product(_quaternion_of(_without_rounding(carrier.on_parent)[0]), turned)
            link = carrier.parent
        return turned

    def center_of_mass(self, x: Any) -> Any:
        """Return the centre of mass (3,) [m] of all bodies except the world, at the state x (nx,)."""
        total, moment, (turns, places) = 0.0, np.zeros(3), self(np.asarray(x)[: self.model.nq])
        for link, mass, center in self._masses:
            total, moment = total + mass, moment + mass * (places[link] + turns[link] @ center)
        return moment / total

    @cached_property
    def _masses(self) -> list[tuple[int, float, Array]]:
        """A list of (link, mass [kg], centre of mass (3,) in the link [m]) of the bodies."""
        context, masses = self.model.plant.CreateDefaultContext(), []
        for label, body in labelled(bodies(self.model.plant)).items():
            mass, (link, pose) = float(body.get_mass(context)), self.on[label]
            if mass > 0:
                masses.append((link, mass, _rounded(pose @ body.CalcCenterOfMassInBodyFrame(context))))
        return masses

    def _all(self, q: Any) -> Any:
        """Return the positions (..., n) of all joints."""
        return q if self.coupling is None else self.coupling.positions(q)


def _times(matrix: Any, vector: Any) -> Any:
    return (matrix @ vector[..., None])[..., 0]


def _turning(quaternion: Array) -> Array:
    """Return the matrix (K, 3, 4) of dq -> angular velocity 2 vec(dq q*) / |q|^2, at the quaternion w x y z (K, 4)."""
    w, v = quaternion[:, 0], quaternion[:, 1:]
    parts = [-v[:, :, None], w[:, None, None] * np.eye(3) + skew(v)]
    return np.asarray(np.concatenate(parts, axis=2) * (2 / np.sum(quaternion**2, axis=1))[:, None, None])


def product(a: Any, b: Any) -> Any:
    """Return the quaternion product a b (4,)."""
    return np.array([a[0] * b[0] - a[1:].dot(b[1:]), *(a[0] * b[1:] + b[0] * a[1:] + cross(a[1:], b[1:]))])


def _quaternion_of(R: Array) -> Array:
    return _rounded(RotationMatrix(R).ToQuaternion().wxyz())


def _without_rounding(pose: RigidTransform) -> tuple[Array, Array]:
    return _rounded(pose.rotation().matrix()), _rounded(pose.translation())


def _rounded(values: Any) -> Array:
    return np.where(np.abs(values) < ROUNDED, 0.0, values)


def forward_kinematics(model: Model) -> ForwardKinematics | Refusal:
    """Make the kinematics of `model`, compared with Drake's at two states, or a Refusal that names the joint."""

    def compared() -> ForwardKinematics | Refusal:
        if not model.nq:
            return Refusal("the model has no joint that moves")
        for joint in joints(model.plant):
            if joint.type_name() not in KNOWN:
                return Refusal(
                    f"joint {joint.name()} is a {joint.type_name()} joint, which forward kinematics does not support: "
                    "replace it by hinges and slides"
                )
        whole = read_links(model.plant, {}, backwards=True)
        rpy = {link.joint for link in whole if link.kind in RPY}
        single = [item for link in whole for item in _chain(link)]
        links, on, _ = without_welds(single)
        known = {"world", *labelled(bodies(model.plant))}
        between = frozenset(i for i, link in enumerate(links) if link.joint.body not in known)
        on = {body: where for body, where in on.items() if body in known}
        carried = np.eye(len(links), dtype=bool)
        for i, link in enumerate(links):
            if link.parent >= 0:
                carried[i] |= carried[link.parent]
        turning = {item.body for item in single if item.joint in rpy and item.v_start >= 0 and item.kind == "revolute"}
        spins = frozenset(i for i, link in enumerate(links) if link.joint.body in turning)
        labels = {int(index): label for index, label in names_of(model.plant)[0].items()}
        kinematics = ForwardKinematics(tuple(links), on, between, carried, spins, labels, model)
        here, random = model.double.state(), np.random.default_rng(0)
        same = all(_is_same(model, kinematics, random.standard_normal(model.nq)) for _ in range(2))
        set_state(model.double, here)
        return kinematics if same else Refusal("its forward kinematics differs from Drake's")

    return model.cache("forward kinematics", compared)


def _chain(link: Link) -> Iterator[Link]:
    """Yield a link unchanged, or one link for each coordinate of its joint, of which the last is the body."""
    chain = CHAINS.get(link.kind)
    if chain is None:
        yield link
        return
    parent, pose = link.parent, link.on_parent
    for i, (kind, axis, k) in enumerate(chain):
        last = i == len(chain) - 1
        massless: dict[str, Any] = (
            {} if last else {"mass": 0.0, "inertia": np.zeros((3, 3)), "on_child": RigidTransform()}
        )
        body = link.body if last else f"{link.body} behind {i + 1} of {len(chain)} coordinates"
        starts: dict[str, Any] = {"q_start": link.q_start + k, "v_start": link.v_start + k}
        if link.kind in RPY and kind == "revolute":  # the first hinge has the whole angular velocity
            starts["v_start"] = link.v_start if axis is Z else -1
        yield replace(link, body=body, parent=parent, kind=kind, axis=axis, on_parent=pose, **starts, **massless)
        parent, pose = body, RigidTransform()


def _is_same(model: Model, kinematics: ForwardKinematics, q: Array) -> bool:
    turns, places = kinematics(q)
    set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
    for label, (carrier, pose) in kinematics.on.items():
        body = model.plant.world_body() if label == "world" else model.double.body(label)
        wanted = model.plant.EvalBodyPoseInWorld(model.double.context, body).GetAsMatrix34()
        R = turns[carrier] @ pose.rotation().matrix()
        ours = np.column_stack([R, turns[carrier] @ pose.translation() + places[carrier]])
        if not np.allclose(ours, wanted, rtol=SAME_PLACE, atol=SAME_PLACE):
            return False
    return True

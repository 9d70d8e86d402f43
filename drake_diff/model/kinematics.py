"""Where the frames of a model are and how they move, in ordinary arithmetic: for scalars that Drake does not know.

Drake places frames for floats and AutoDiffXd. A collocation traces functions of the state with symbols, to have their
exact second derivatives; for these the chain of joints from the world to a frame is written out here, in NumPy arrays
of whatever entries the state has. What is traced is compared with Drake's own numbers before it is used.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, joints

ROUNDED = 1e-15  # of the frames' entries (sines of pi): zeros that would keep products alive
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
X, Y, Z = np.eye(3)
WORLD = 0  # the index of the world's body


@dataclass(frozen=True)
class _Link:
    """A joint as it is met on the way from the world: `backwards` where its child is nearer to the world."""

    joint: Any
    parent: int  # the body that is nearer to the world
    backwards: bool


@dataclass(frozen=True)
class Moving:
    """A frame in the world: rotation (3, 3), origin (3,) [m], angular velocity (3,) and its origin's (3,) [m/s]."""

    R: Any
    p: Any
    w: Any
    v: Any

    def shifted(self, R: Array, p: Array) -> "Moving":
        """The frame that lies at rotation R (3, 3), origin p (3,) in this one."""
        arm = self.R @ p
        return Moving(self.R @ R, self.p + arm, self.w, self.v + _cross(self.w, arm))


class Kinematics:
    """The joints of a model by the bodies that they lead to; ModelError where the world does not reach one."""

    def __init__(self, model: Model):
        self.plant, self.coupling = model.plant, model.coupling
        self._links: dict[int, _Link] = {}
        reached = {WORLD}
        left = joints(self.plant)
        while left:
            reachable = [j for j in left if len(reached & _ends(j)) > 0]
            if not reachable:
                raise ModelError(f"joint {left[0].name()} is not connected to the world")
            for joint in reachable:
                left.remove(joint)
                a, b = int(joint.parent_body().index()), int(joint.child_body().index())
                if a in reached and b not in reached:
                    self._links[b] = _Link(joint, a, backwards=False)
                elif b in reached and a not in reached:
                    self._links[a] = _Link(joint, b, backwards=True)
                reached |= {a, b}

    def frame(self, x: Any, frame: Any, *, speeds: bool = False) -> Moving:
        """`frame` of the plant at the state x (nx,); without `speeds` as if at rest, which is less to trace."""
        pose = frame.GetFixedPoseInBodyFrame()
        return self._body(self._state(x, speeds), int(frame.body().index())).shifted(*_parts(pose))

    def quaternion(self, x: Any, frame: Any) -> Any:
        """(4,) w, x, y, z of the rotation of `frame` in the world, of either sign, at the state x (nx,)."""
        state, turned, body = (
            self._state(x, speeds=False),
            _of(frame.GetFixedPoseInBodyFrame()),
            int(frame.body().index()),
        )
        while body in self._links:
            link = self._links[body]
            in_parent, in_child = _frames(link.joint)
            steps = [_of(in_parent), _turn(link.joint, state), _conjugate(_of(in_child))]
            for step in [_conjugate(q) for q in steps] if link.backwards else reversed(steps):
                turned = product(step, turned)
            body = link.parent
        return turned

    def center_of_mass(self, x: Any) -> Any:
        """(3,) [m] of all bodies but the world, at the state x (nx,)."""
        total, moment, state = 0.0, np.zeros(3), self._state(x, speeds=False)
        for body, mass, center in self._masses:
            here = self._body(state, body)
            total, moment = total + mass, moment + mass * (here.p + here.R @ center)
        return moment / total

    @cached_property
    def _masses(self) -> list[tuple[int, float, Array]]:
        """(body, mass [kg], centre of mass (3,) in it [m])."""
        context = self.plant.CreateDefaultContext()
        masses = []
        for body in bodies(self.plant):
            mass = float(body.get_mass(context))
            if mass > 0:
                center = np.array(body.CalcCenterOfMassInBodyFrame(context))
                masses.append((int(body.index()), mass, _without_rounding(center)))
        return masses

    def _state(self, x: Any, speeds: bool) -> "_State":
        """The plant's own state, in which joints that follow others have coordinates too."""
        whole = np.asarray(x) if self.coupling is None else self.coupling.state(np.asarray(x))
        return _State(self.plant.num_positions(), whole, speeds)

    def _body(self, state: "_State", body: int) -> Moving:
        if body not in state.known:
            link = self._links[body]
            state.known[body] = _carried(self._body(state, link.parent), link, state)
        return state.known[body]


class _State:
    """x (nx,) by joints, and the bodies that were placed in it."""

    def __init__(self, nq: int, x: Any, speeds: bool):
        rest = Moving(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
        self.nq, self.x, self.speeds, self.known = nq, x, speeds, {WORLD: rest}

    def of(self, joint: Any) -> tuple[Any, Any]:
        """The joint's positions and velocities."""
        q, v = joint.position_start(), self.nq + joint.velocity_start()
        speeds = self.x[v : v + joint.num_velocities()] if self.speeds else np.zeros(joint.num_velocities())
        return self.x[q : q + joint.num_positions()], speeds


def _carried(here: Moving, link: _Link, state: _State) -> Moving:
    """The body behind a joint; `here` is the one before it."""
    R, p, w, v = _motion(link.joint, *state.of(link.joint))
    in_parent, in_child = (_parts(pose) for pose in _frames(link.joint))
    if link.backwards:
        end = here.shifted(*in_child)
        turned = end.R @ R.T
        arm, spin = turned @ p, end.w - turned @ w
        start = Moving(turned, end.p - arm, spin, end.v - _cross(spin, arm) - turned @ v)
        return start.shifted(*_inverse(*in_parent))
    start = here.shifted(*in_parent)
    moved = start.shifted(R, p)
    end = Moving(moved.R, moved.p, moved.w + start.R @ w, moved.v + start.R @ v)
    return end.shifted(*_inverse(*in_child))


def _motion(joint: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any]:
    """R, p, w, v of the joint's moving frame in its fixed one."""
    kind, zero = joint.type_name(), np.zeros(3)
    if kind == "weld":
        return *_parts(joint.X_FM()), zero, zero
    if kind == "revolute":
        axis = np.array(joint.revolute_axis())
        return _about(axis, q[0]), zero, axis * v[0], zero
    if kind == "prismatic":
        axis = np.array(joint.translation_axis())
        return np.eye(3), axis * q[0], zero, axis * v[0]
    if kind == "planar":
        return _about(Z, q[2]), np.array([q[0], q[1], 0.0]), Z * v[2], np.array([v[0], v[1], 0.0])
    if kind == "quaternion_floating":
        return rotation_of(_unit(q[:4])), q[4:7], v[:3], v[3:6]
    if kind in ("ball_rpy", "rpy_floating"):
        R = _about(Z, q[2]) @ _about(Y, q[1]) @ _about(X, q[0])
        return (R, zero, v[:3], zero) if kind == "ball_rpy" else (R, q[3:6], v[:3], v[3:6])
    raise ModelError(f"joint {joint.name()} of type {kind} is not written out")


def _turn(joint: Any, state: _State) -> Any:
    """(4,) the quaternion of `_motion`'s R."""
    kind, (q, _) = joint.type_name(), state.of(joint)
    if kind == "weld":
        return _of(joint.X_FM())
    if kind == "revolute":
        return _half(np.array(joint.revolute_axis()), q[0])
    if kind == "prismatic":
        return IDENTITY
    if kind == "planar":
        return _half(Z, q[2])
    if kind == "quaternion_floating":
        return _unit(q[:4])
    if kind in ("ball_rpy", "rpy_floating"):
        return product(product(_half(Z, q[2]), _half(Y, q[1])), _half(X, q[0]))
    raise ModelError(f"joint {joint.name()} of type {kind} is not written out")


def kinematics_of(model: Model) -> Kinematics:
    """Those of a model, made once."""
    return model.cache("kinematics", lambda: Kinematics(model))


def product(a: Any, b: Any) -> Any:
    """(4,) the quaternion a b."""
    return np.array(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )


def rotation_of(quaternion: Any) -> Any:
    """(3, 3) the rotation of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _ends(joint: Any) -> set[int]:
    return {int(joint.parent_body().index()), int(joint.child_body().index())}


def _frames(joint: Any) -> tuple[Any, Any]:
    """The poses of the joint's frames in the bodies that they are fixed in."""
    return joint.frame_on_parent().GetFixedPoseInBodyFrame(), joint.frame_on_child().GetFixedPoseInBodyFrame()


def _parts(pose: Any) -> tuple[Array, Array]:
    return _without_rounding(pose.rotation().matrix()), _without_rounding(pose.translation())


def _inverse(R: Array, p: Array) -> tuple[Array, Array]:
    return R.T, -R.T @ p


def _of(pose: Any) -> Array:
    return _without_rounding(pose.rotation().ToQuaternion().wxyz())


def _without_rounding(values: Any) -> Array:
    array = np.array(values, dtype=float)
    return np.where(np.abs(array) < ROUNDED, 0.0, array)


def _conjugate(q: Any) -> Any:
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def _unit(q: Any) -> Any:
    return q / np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])


def _half(axis: Array, angle: Any) -> Any:
    return np.array([np.cos(angle / 2), *(axis * np.sin(angle / 2))])


def _about(axis: Array, angle: Any) -> Any:
    """(3, 3) the rotation about a unit axis, by Rodrigues' formula."""
    a, b, c = axis
    cross, outer = np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]), np.outer(axis, axis)
    return outer + (np.eye(3) - outer) * np.cos(angle) + cross * np.sin(angle)


def _cross(a: Any, b: Any) -> Any:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])

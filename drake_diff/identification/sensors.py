"""What sensors read that are no coordinates: where a point is, how a body turns and accelerates, a joint's force.

Readings are functions of positions, velocities, accelerations and the tree's numbers. Accelerations follow from the
equations of motion, with their derivatives; the rest is kinematics, which is differentiated by complex steps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array, skew
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.identification.tree import Dynamics, Numbers, Tree
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, joints, labelled

AXES = ("x", "y", "z")
OF_BODY = ("position", "gyro", "accel")  # [m] in world; [rad/s] and [m/s^2] in the sensor's frame
FORCE = "force"  # [N m] or [N] of a joint
TINY = 1e-30  # of a complex step


@dataclass(frozen=True, eq=False)
class MountedSensor:
    """Three readings of a body, or one of a joint."""

    label: str  # as its columns call it
    quantity: str
    link: int  # which carries it; of a force, its joint's
    turn: Array  # (3, 3) of its frame on the link
    point: Array  # (3,) [m] of its origin there

    @property
    def columns(self) -> tuple[str, ...]:
        """A name for each reading."""
        if self.quantity == FORCE:
            return (f"{self.label}.{FORCE}",)
        return tuple(f"{self.label}.{self.quantity}_{axis}" for axis in AXES)


def sensor_of(column: str) -> tuple[str, str]:
    """(label, quantity) of a column. InputError where it is none of a sensor."""
    label, dot, last = column.rpartition(".")
    quantity, _, axis = last.partition("_")
    if dot and label and (last == FORCE or (quantity in OF_BODY and axis in AXES)):
        return label, quantity
    expected = "BODY.position_x, BODY.gyro_x, BODY.accel_x (or y, z), or JOINT.force"
    raise InputError("output", got=column, expected=expected)


def choose_sensors(
    model: Model, tree: Tree | None, columns: Sequence[str], mounted: Mapping[str, tuple[str, Sequence[float]]] | None
) -> "Sensors":
    """Those whose readings the columns are. A label is a joint, a body, whose frame it then is, or one of `mounted`.

    Raises UnknownNameError or InputError where there is no such body or joint, ModelError where it cannot be told.
    """
    mounted = dict(mounted or {})
    wanted = dict.fromkeys(sensor_of(column) for column in columns)
    if wanted and (tree is None or tree.coupling is not None):
        why = "joints follow others" if tree is not None else "there is none here"
        raise ModelError(f"{model.name}: sensors are read from motion in continuous time, and {why}")
    for name in mounted:
        if name not in {label for label, _ in wanted}:
            raise UnknownNameError("sensor of which there are columns", got=name, known=[s for s, _ in wanted])
    if tree is None:
        return Sensors(None, (), ())
    return Sensors(
        tree, tuple(_sensor(model, tree, *sensor, mounted.get(sensor[0])) for sensor in wanted), tuple(columns)
    )


def _sensor(model: Model, tree: Tree, label: str, quantity: str, mounted: Any) -> MountedSensor:
    if quantity == FORCE:
        by_label = labelled(joints(model.plant))
        known = [name for name, joint in by_label.items() if joint.num_velocities() == 1]
        if label not in known:
            raise UnknownNameError("joint with a force", got=label, known=known)
        index = next(i for i, link in enumerate(tree.links) if link.joint.joint == label)
        return MountedSensor(label, quantity, index, np.eye(3), np.zeros(3))
    body, turn, point = label, np.eye(3), np.zeros(3)
    if mounted is not None:
        body, turn, point = _mounted(label, mounted)
    if body not in tree.placed:
        raise UnknownNameError(f"body of sensor {label}", got=body, known=list(labelled(bodies(model.plant))))
    index, pose = tree.placed[body]
    if index < 0:
        raise InputError(f"sensor {label}", got=f"on {body}, which is fixed to the world", expected="one that moves")
    R = pose.rotation().matrix()
    return MountedSensor(label, quantity, index, R @ turn, R @ point + pose.translation())


def _mounted(label: str, given: Any) -> tuple[str, Array, Array]:
    """Its body, and the pose on it: a point, or a point with roll, pitch and yaw."""
    expected = "a body, and x, y, z [m], or x, y, z, roll, pitch, yaw [rad] in its frame"
    try:
        body, pose = given
        numbers = np.array(pose, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"sensor {label}", got=given, expected=expected) from error
    if not isinstance(body, str) or numbers.shape not in ((3,), (6,)):
        raise InputError(f"sensor {label}", got=given, expected=expected)
    finite_array(f"sensor {label}", numbers, (len(numbers),))
    roll, pitch, yaw = numbers[3:] if len(numbers) == 6 else np.zeros(3)
    turn = (
        _about(np.array([0, 0, 1.0]), yaw) @ _about(np.array([0, 1.0, 0]), pitch) @ _about(np.array([1.0, 0, 0]), roll)
    )
    return body, turn, numbers[:3]


def _about(axis: Array, angle: Any) -> Any:
    """(..., 3, 3) by angles (...,), complex or float."""
    hat, angle = skew(axis), np.asarray(angle)[..., None, None]
    return np.eye(3) + np.sin(angle) * hat + (1 - np.cos(angle)) * (hat @ hat)


@dataclass(frozen=True, eq=False)
class _At:
    """Where a frame is and how it moves, in world; acceleration less gravity."""

    R: Any
    p: Any
    w: Any
    v: Any
    w_dot: Any
    a: Any

    def to(self, turn: Any, point: Any) -> "_At":
        """A frame that is fixed on it."""
        r = (self.R @ point[..., None])[..., 0] if point.ndim > 1 else self.R @ point
        v = self.v + np.cross(self.w, r)
        a = self.a + np.cross(self.w_dot, r) + np.cross(self.w, np.cross(self.w, r))
        return _At(self.R @ turn, self.p + r, self.w, v, self.w_dot, a)


@dataclass(frozen=True, eq=False)
class Sensors:
    """All sensors of a fit; `columns` are those that were recorded, in their order."""

    tree: Tree | None
    each: tuple[MountedSensor, ...]
    columns: tuple[str, ...]

    @property
    def count(self) -> int:
        return len(self.columns)

    def _entries(self) -> list[int]:
        every = [column for sensor in self.each for column in sensor.columns]
        return [every.index(column) for column in self.columns]

    def read(self, dynamics: Dynamics, x: Array, u: Array) -> Array:
        """(N, m) at x (N, nx) under u (N, nu)."""
        q, v = self._split(x)
        a = dynamics.accelerate(x, u) if self._accelerates else np.zeros_like(v)
        forces = dynamics.inverse_dynamics(q, v, a)[0] if self._forces else None
        return np.asarray(self._read(dynamics.numbers, q, v, a, forces).real)

    def _split(self, x: Array) -> tuple[Array, Array]:
        nv = self._tree.n
        return x[:, : x.shape[1] - nv], x[:, x.shape[1] - nv :]

    @property
    def _tree(self) -> Tree:
        if self.tree is None:
            raise ModelError("sensors without motion in continuous time")
        return self.tree

    @property
    def _accelerates(self) -> bool:
        return any(sensor.quantity in ("accel", FORCE) for sensor in self.each)

    @property
    def _forces(self) -> list[tuple[int, int]]:
        """(column, degree of freedom) of each force."""
        tree = self._tree
        sensors = [sensor for sensor in self.each if sensor.quantity == FORCE]
        return [(self.columns.index(sensor.columns[0]), int(tree.first[sensor.link])) for sensor in sensors]

    def slopes(self, dynamics: Dynamics, x: Array, u: Array, by: Array) -> tuple[Array, Array]:
        """(N, m, 2 nv) by small motions of the state, and (N, m, np) by parameters, of which `by` moves the numbers."""
        q, v = self._split(x)
        nv, numbers = v.shape[1], dynamics.numbers
        a, by_state = dynamics.acceleration_jacobians(x, u, by) if self._accelerates else (np.zeros_like(v), None)
        moved = np.zeros((len(q), self.count, 2 * nv))
        by_a = np.zeros((len(q), self.count, nv))
        used = np.flatnonzero(self._above())
        for j in used:
            step = np.zeros(nv, dtype=complex)
            step[j] = 1j * TINY
            moved[..., j] = self._read(numbers, q, v, a, small=step).imag / TINY
            moved[..., nv + j] = self._read(numbers, q, v + step, a).imag / TINY
            if by_state is not None:
                by_a[..., j] = self._read(numbers, q, v, a + step).imag / TINY
        by_parameters = np.zeros((len(q), self.count, by.shape[1]))
        for column in range(by.shape[1]):
            if np.any(by[:, column] != 0):
                turned = numbers.moved(1j * TINY * by[:, column])
                by_parameters[..., column] = self._read(turned, q, v, a).imag / TINY
        if self._forces:
            _, mass, slopes = dynamics.inverse_dynamics(q, v, a, by)
            for i, k in self._forces:
                moved[:, i], by_a[:, i], by_parameters[:, i] = (
                    slopes[:, k, : 2 * nv],
                    mass[:, k],
                    slopes[:, k, 2 * nv :],
                )
        if by_state is not None:
            moved += by_a @ by_state[..., : 2 * nv]
            by_parameters += by_a @ by_state[..., 2 * nv :]
        return moved, by_parameters

    def _above(self) -> Array:
        """(nv,) which coordinates any of the sensors sees by its place or motion."""
        tree = self._tree
        seen = np.zeros(tree.n, dtype=bool)
        for sensor in self.each:
            i = sensor.link
            while i >= 0:
                start = tree.first[i]
                seen[start : start + (6 if tree.links[i].free else 1)] = True
                i = tree.links[i].parent
        return seen

    def _read(self, numbers: Numbers, q: Any, v: Any, a: Any, forces: Array | None = None, small: Any = None) -> Any:
        """(N, m), complex where anything is; `small` (nv,) is a small motion of the positions. Forces are given."""
        small = np.zeros(v.shape[1]) if small is None else small
        known: dict[int, _At] = {}
        every = []
        for sensor in self.each:
            if sensor.quantity == FORCE:
                k = int(self._tree.first[sensor.link])
                every.append(np.zeros((len(q), 1)) if forces is None else forces[:, [k]])
                continue
            frame = self._frame(sensor.link, numbers, q, v, a, small, known).to(sensor.turn, sensor.point)
            if sensor.quantity == "position":
                every.append(frame.p)
            else:
                vector = frame.w if sensor.quantity == "gyro" else frame.a
                every.append((np.swapaxes(frame.R, -1, -2) @ vector[..., None])[..., 0])
        return np.concatenate(every, axis=1)[:, self._entries()]

    def _frame(self, i: int, numbers: Numbers, q: Any, v: Any, a: Any, small: Any, known: dict[int, _At]) -> _At:
        """Of link i."""
        if i in known:
            return known[i]
        tree = self._tree
        link, k = tree.links[i], tree.first[i]
        if link.free:
            s = link.joint.q_start
            quaternion, position = q[:, s : s + 4], q[:, s + 4 : s + 7] + small[k + 3 : k + 6]
            vector = skew(quaternion[:, 1:])
            scale = 2 / np.sum(quaternion * quaternion, axis=1)[:, None, None]
            R = np.eye(3) + scale * (quaternion[:, :1, None] * vector + vector @ vector)
            w = small[k : k + 3]
            R = R + np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]) @ R
            frame = _At(
                R,
                position,
                v[:, k : k + 3],
                v[:, k + 3 : k + 6],
                a[:, k : k + 3],
                a[:, k + 3 : k + 6] - numbers.gravity,
            )
        else:
            zero = np.zeros((len(q), 3))
            ground = _At(np.broadcast_to(np.eye(3), (len(q), 3, 3)), zero, zero, zero, zero, zero - numbers.gravity)
            before = self._frame(link.parent, numbers, q, v, a, small, known) if link.parent >= 0 else ground
            joint_frame = before.to(link.on_parent.rotation().matrix(), numbers.offset[i])
            angle, speed, change = q[:, link.joint.q_start] + small[k], v[:, k, None], a[:, k, None]
            axis = joint_frame.R @ link.axis
            if link.joint.kind == "revolute":
                w_dot = joint_frame.w_dot + axis * change + np.cross(joint_frame.w, axis * speed)
                frame = _At(
                    joint_frame.R @ _about(link.axis, angle),
                    joint_frame.p,
                    joint_frame.w + axis * speed,
                    joint_frame.v,
                    w_dot,
                    joint_frame.a,
                )
            else:
                moved = joint_frame.to(np.eye(3), angle[:, None] * link.axis)
                acceleration = moved.a + 2 * np.cross(joint_frame.w, axis * speed) + axis * change
                frame = _At(moved.R, moved.p, moved.w, moved.v + axis * speed, moved.w_dot, acceleration)
        known[i] = frame
        return frame

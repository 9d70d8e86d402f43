"""Readings of sensors: the position of a point, the angular velocity and acceleration of a body, the force of a joint.

Accelerations and forces use the derivatives of the equations of motion. Kinematics is differentiated by differences.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.math import RollPitchYaw

from drake_diff._base.arrays import Array, cross, finite_array
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.identification.tree import Tree, TreeDynamics
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, joints, labelled
from drake_diff.model.tangent import TangentSpace

AXES = ("x", "y", "z")
OF_BODY = ("position", "gyro", "accel")  # [m] in world; [rad/s] and [m/s^2] in the sensor's frame
FORCE = "force"  # [N m] or [N], at a joint
STEP = 1e-5  # [rad, m] of a central difference


@dataclass(frozen=True, eq=False)
class MountedSensor:
    """Three readings of a body, or one of a joint."""

    label: str  # the label in its columns
    quantity: str
    link: int  # index of the link that carries it; for a force, the link of its joint
    turn: Array  # (3, 3) rotation of its frame on the link
    point: Array  # (3,) [m] its origin on the link

    @property
    def columns(self) -> tuple[str, ...]:
        """The name of each reading."""
        if self.quantity == FORCE:
            return (f"{self.label}.{FORCE}",)
        return tuple(f"{self.label}.{self.quantity}_{axis}" for axis in AXES)


def sensor_of(column: str) -> tuple[str, str]:
    """Return (label, quantity) of a column. Raises InputError if it is not the column of a sensor."""
    label, dot, last = column.rpartition(".")
    quantity, _, axis = last.partition("_")
    if dot and label and (last == FORCE or (quantity in OF_BODY and axis in AXES)):
        return label, quantity
    expected = "BODY.position_x, BODY.gyro_x, BODY.accel_x (or y, z), or JOINT.force"
    raise InputError("output", got=column, expected=expected)


def choose_sensors(
    model: Model, tree: Tree | None, columns: Sequence[str], mounted: Mapping[str, tuple[str, Sequence[float]]] | None
) -> "Sensors":
    """Return the sensors of the columns; a label is a joint, a body (the sensor has its frame), or one of `mounted`.

    Raises UnknownNameError or InputError for an unusable body or joint, ModelError for a motion without sensor support.
    """
    mounted = dict(mounted or {})
    wanted = dict.fromkeys(sensor_of(column) for column in columns)
    if wanted and (tree is None or tree.coupling is not None):
        why = "mimic joints are reduced" if tree is not None else "the model's steps are fitted"
        raise ModelError(f"{model.name}: sensors need motion in continuous time, but {why}")
    for name in mounted:
        if name not in {label for label, _ in wanted}:
            raise UnknownNameError("sensor with columns", got=name, known=[s for s, _ in wanted])
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
    if body not in tree.on:
        raise UnknownNameError(f"body of sensor {label}", got=body, known=list(labelled(bodies(model.plant))))
    index, pose = tree.on[body]
    if index < 0:
        raise InputError(
            f"sensor {label}", got=f"on {body}, which is fixed to the world", expected="a sensor on a moving body"
        )
    R = pose.rotation().matrix()
    return MountedSensor(label, quantity, index, R @ turn, R @ point + pose.translation())


def _mounted(label: str, given: Any) -> tuple[str, Array, Array]:
    """Return the body, rotation and point of a sensor that is given as a point, or as a point with roll, pitch, yaw."""
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
    return body, RollPitchYaw(roll, pitch, yaw).ToRotationMatrix().matrix(), numbers[:3]


@dataclass(frozen=True, eq=False)
class Sensors:
    """All sensors of a fit; `columns` are the recorded columns, in their order."""

    tree: Tree | None
    each: tuple[MountedSensor, ...]
    columns: tuple[str, ...]

    @property
    def count(self) -> int:
        return len(self.columns)

    def read(self, dynamics: TreeDynamics, x: Array, u: Array) -> Array:
        """Return the readings (N, m) at x (N, nx) under u (N, nu)."""
        q, v, a = x[:, : x.shape[1] - dynamics.nv], x[:, -dynamics.nv :], dynamics.accelerate(x, u)
        read = self._of_links(dynamics, q, v, a)
        for i, k in self._forces(dynamics):
            read[:, i] = dynamics.inverse_dynamics(q, v, a)[0][:, k]
        return read

    def slopes(self, space: TangentSpace, dynamics: TreeDynamics, x: Array, u: Array, by: Array) -> tuple[Array, Array]:
        """Return derivatives with respect to tangent vectors (N, m, 2 nv) and parameters (N, m, np) for `by`."""
        nv, (a, by_state) = dynamics.nv, dynamics.acceleration_jacobians(x, u, by)
        q, v, numbers = x[:, : x.shape[1] - nv], x[:, -nv:], dynamics.numbers
        moved, by_a = np.zeros((len(x), self.count, 2 * nv)), np.zeros((len(x), self.count, nv))
        for j, e in enumerate(np.eye(nv)):  # quadratic in v, linear in a: central differences are exact
            turned = [space.plus(x, np.append(sign * STEP * e, 0 * e))[:, :-nv] for sign in (1, -1)]
            ahead, back = (self._of_links(dynamics, q_end, v, a) for q_end in turned)
            moved[..., j] = (ahead - back) / (2 * STEP)
            ahead, back = (self._of_links(dynamics, q, v + sign * e, a) for sign in (1, -1))
            moved[..., nv + j] = (ahead - back) / 2
            ahead, back = (self._of_links(dynamics, q, v, a + sign * e) for sign in (1, -1))
            by_a[..., j] = (ahead - back) / 2
        by_parameters = np.zeros((len(x), self.count, by.shape[1]))
        frames = np.concatenate([numbers.places("offset").ravel(), numbers.places("gravity")])
        for p in np.flatnonzero(np.any(by[frames] != 0, axis=0)):  # readings are linear in them
            moved_trees = (replace(dynamics, numbers=numbers.moved(sign * by[:, p])) for sign in (1, -1))
            ahead, back = (self._of_links(there, q, v, a) for there in moved_trees)
            by_parameters[..., p] = (ahead - back) / 2
        for i, k in self._forces(dynamics):
            _, mass, slopes = dynamics.inverse_dynamics(q, v, a, by)
            moved[:, i], by_a[:, i], by_parameters[:, i] = slopes[:, k, : 2 * nv], mass[:, k], slopes[:, k, 2 * nv :]
        return moved + by_a @ by_state[..., : 2 * nv], by_parameters + by_a @ by_state[..., 2 * nv :]

    def _forces(self, dynamics: TreeDynamics) -> list[tuple[int, int]]:
        """Return (column, degree of freedom) of each force."""
        forces = (sensor for sensor in self.each if sensor.quantity == FORCE)
        return [(self.columns.index(f"{s.label}.{FORCE}"), dynamics.tree.links[s.link].joint.v_start) for s in forces]

    def _of_links(self, dynamics: TreeDynamics, q: Array, v: Array, a: Array) -> Array:
        """Return the readings (N, m), with 0 for forces."""
        frames, columns = dynamics.frames(q, v, a), dict[str, Array]()
        for sensor in self.each:
            pose, motion, change = (values[:, sensor.link] for values in frames)
            columns.update(zip(sensor.columns, _reading(sensor, pose, motion, change).T, strict=True))
        return np.array([columns[name] for name in self.columns]).T


def _reading(sensor: MountedSensor, pose: Array, motion: Array, change: Array) -> Array:
    """Return readings (N, 3) on a link at `pose` (N, 3, 4) with this motion (N, 6); zeros (N, 1) for a force."""
    w, point = motion[:, :3], np.broadcast_to(sensor.point, motion[:, :3].shape)
    if sensor.quantity == FORCE:
        return np.zeros((len(pose), 1))
    if sensor.quantity == "position":
        return np.asarray(pose[:, :, :3] @ sensor.point + pose[:, :, 3])
    if sensor.quantity == "gyro":
        return np.asarray(w @ sensor.turn)
    at_origin = change[:, 3:] + cross(w, motion[:, 3:])
    acceleration = at_origin + cross(change[:, :3], point) + cross(w, cross(w, point))
    return np.asarray(acceleration @ sensor.turn)

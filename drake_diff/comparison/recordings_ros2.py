"""Recorded motions out of ROS 2 messages, in a bag or in one MCAP file, by the time in their headers.

sensor_msgs/JointState (/joint_states, or the only one) has joints by name, efforts being their actuators' inputs;
nav_msgs/Odometry, or geometry_msgs/PoseStamped and TwistStamped, the one free body. A bag cut short is refused; another
byte is found only where the writer left a checksum, which rosbags does not.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ArtifactError, InputError, MissingDependencyError
from drake_diff.mechanics.coordinates import rotation
from drake_diff.mechanics.description import Description, describe
from drake_diff.model.model import Model

JOINTS, ODOMETRY = "sensor_msgs/msg/JointState", "nav_msgs/msg/Odometry"
POSE, TWIST = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped"
USED = (JOINTS, ODOMETRY, POSE, TWIST)
Stamped = dict[int, Any]  # messages by time [ns]


def is_ros2(path: Path) -> bool:
    """Whether the messages in an MCAP file are encoded as ROS 2's; False where it is damaged, for others to say."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        try:
            summary = make_reader(file).get_summary()
        except Exception:  # as in `mcap_read`, which then names the damage
            return False
    return summary is not None and any(c.message_encoding == "cdr" for c in summary.channels.values())


def read_ros2(path: Path, model: Model) -> tuple[tuple[Array, Array, Array], Mapping[str, str]]:
    """(times (n,) from 0, xs (n, nx), us (n - 1, nu)), and the metadata record "contract" of an MCAP file.

    InputError, naming message and time, where a joint, a twist or an effort is missing.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingDependencyError("a ROS 2 bag needs rosbags: pip install 'drake-diff[ros2]'") from error
    store, found = get_typestore(Stores.ROS2_HUMBLE), _Found(str(path), describe(model))
    messages, facts = _messages(path)
    for topic, kind, data in messages:
        message = store.deserialize_cdr(data, kind)
        stamp = message.header.stamp
        found.topics[kind].setdefault(topic, {})[stamp.sec * 1_000_000_000 + stamp.nanosec] = message
    return found.motion(model), facts


def _messages(path: Path) -> tuple[list[tuple[str, str, bytes]], Mapping[str, str]]:
    """Topic, type and bytes of what is used, and the metadata record "contract" of an MCAP file."""
    from mcap.reader import make_reader
    from rosbags.rosbag2 import Reader

    try:
        if path.is_dir():
            with Reader(path) as bag:
                return [(c.topic, c.msgtype, data) for c, _, data in bag.messages() if c.msgtype in USED], {}
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            rows = [(c.topic, s.name, m.data) for s, c, m in reader.iter_messages() if s and s.name in USED]
            metadata = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
            return rows, metadata.get("contract", {})
    except Exception as error:  # a damaged file makes readers fail in many ways
        what = "a ROS 2 bag" if path.is_dir() else "a complete MCAP file"
        raise ArtifactError(f"{path} is not {what}: {error}") from error


class _Found:
    def __init__(self, source: str, description: Description):
        self.source, self.description = source, description
        self.topics: dict[str, dict[str, Stamped]] = {kind: {} for kind in USED}
        self.singles = [x for x in description.moving if x.kind != "quaternion_floating"]
        self.free = [x for x in description.moving if x.kind == "quaternion_floating"]

    def motion(self, model: Model) -> tuple[Array, Array, Array]:
        joints = self._only(JOINTS, "/joint_states") if self.singles else {}
        bases = self._bases()
        stamps = sorted(joints or bases)
        if self.singles and self.free and joints.keys() != bases.keys():
            k = min(joints.keys() ^ bases.keys())
            raise InputError(f"{self.source}: t = {k} ns", got="joints or base alone", expected="both at each time")
        xs, us = np.zeros((len(stamps), model.nx)), np.zeros((max(len(stamps) - 1, 0), model.nu))
        for k, time in enumerate(stamps):
            for link in self.singles:
                xs[k, link.q_start] = self._joint(joints[time], time, link.joint, "position")
                xs[k, model.nq + link.v_start] = self._joint(joints[time], time, link.joint, "velocity")
            for link in self.free:
                xs[k, link.q_start : link.q_start + 7] = bases[time][:7]
                xs[k, model.nq + link.v_start : model.nq + link.v_start + 6] = bases[time][7:]
            for i, joint in enumerate(self.description.actuated if k < len(us) else ()):
                if self.description.actuated.count(joint) > 1 or joint not in [x.joint for x in self.singles]:
                    expected = "one effort, one input"
                    raise InputError(f"joint {joint}", got="not driven by one actuator alone", expected=expected)
                us[k, i] = self._joint(joints[time], time, joint, "effort")
        return np.array([time - stamps[0] for time in stamps]) / 1e9, xs, us

    def _joint(self, message: Any, time: int, joint: str, what: str) -> float:
        names, values = list(message.name), getattr(message, what)
        subject = f"{self.source}: JointState at {time} ns, {what} of {joint}"
        if joint not in names or len(values) != len(names):
            raise InputError(subject, got=f"{len(values)} of {', '.join(names)}", expected="one of each joint")
        value = float(values[names.index(joint)])
        if not np.isfinite(value):
            raise InputError(subject, got=value, expected="a finite number")
        return value

    def _only(self, kind: str, preferred: str = "") -> Stamped:
        topics = self.topics[kind]
        if preferred in topics:
            return topics[preferred]
        if len(topics) != 1:
            got = ", ".join(sorted(topics)) or "none"
            raise InputError(f"{self.source}: topics of {kind}", got=got, expected=preferred or "one")
        return next(iter(topics.values()))

    def _bases(self) -> dict[int, Array]:
        if not self.free:
            return {}
        link = self.free[0]
        if len(self.free) > 1 or not all(X.IsExactlyIdentity() for X in (link.on_parent, link.on_child)):
            got = ", ".join(x.joint for x in self.free)
            raise InputError("free bodies", got=got, expected="one, by its own frame in the world")
        if self.topics[ODOMETRY]:
            odometry = self._only(ODOMETRY)
            return {t: _base(m.pose.pose, m.twist.twist, in_body=True) for t, m in odometry.items()}
        poses, twists = self._only(POSE), self._only(TWIST)
        if poses.keys() != twists.keys():
            k = min(poses.keys() ^ twists.keys())
            raise InputError(f"{self.source}: t = {k} ns", got="pose or twist alone", expected="both at each time")
        found = {}
        for t, pose in poses.items():
            frame, world = twists[t].header.frame_id, pose.header.frame_id
            if frame not in (world, link.body) or world == link.body:
                expected = f"{world!r}, the pose's, or {link.body!r}, the body"
                raise InputError(f"{self.source}: frame_id of TwistStamped", got=repr(frame), expected=expected)
            found[t] = _base(pose.pose, twists[t].twist, in_body=frame == link.body)
        return found


def _base(pose: Any, twist: Any, in_body: bool) -> Array:
    """(13,) q and v of the free body, in Drake's coordinates."""
    p, r, w, v = pose.position, pose.orientation, twist.angular, twist.linear
    q = np.array([r.w, r.x, r.y, r.z, p.x, p.y, p.z])
    parts = np.array([[w.x, w.y, w.z], [v.x, v.y, v.z]])
    return np.concatenate([q, (parts @ rotation(q[:4]).T if in_body else parts).ravel()])

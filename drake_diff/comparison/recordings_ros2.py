"""Recorded motions out of ROS 2 messages, in a bag or in one MCAP file, by the time in their headers.

sensor_msgs/JointState (/joint_states, or the only one) has joints by name, efforts being their actuators' inputs;
nav_msgs/Odometry, or geometry_msgs/PoseStamped and TwistStamped, a free body each. Of several bodies the messages are
told apart by the frame of the body, or by the body's name in that of the topic. A bag cut short is refused; another
byte is found only where the writer left a checksum, which rosbags does not.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ArtifactError, InputError, MissingDependencyError
from drake_diff.mechanics.coordinates import rotation
from drake_diff.mechanics.description import Link, describe_whole
from drake_diff.model.model import Model

JOINTS, ODOMETRY = "sensor_msgs/msg/JointState", "nav_msgs/msg/Odometry"
POSE, TWIST = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped"
USED = (JOINTS, ODOMETRY, POSE, TWIST)
Stamped = dict[int, Any]  # messages by time [ns]
Source = tuple[str, str]  # a topic, and the frame of the body that its messages are of, empty where they say none


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
    store, found = get_typestore(Stores.ROS2_HUMBLE), _Found(str(path), model)
    messages, facts = _messages(path)
    for topic, kind, data in messages:
        message = store.deserialize_cdr(data, kind)
        stamp = message.header.stamp
        source = topic, _frame_of_body(kind, message)
        found.sources[kind].setdefault(source, {})[stamp.sec * 1_000_000_000 + stamp.nanosec] = message
    return found.motion(), facts


def _frame_of_body(kind: str, message: Any) -> str:
    if kind == ODOMETRY:
        return str(message.child_frame_id)
    return str(message.header.frame_id) if kind == TWIST else ""


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
    """Messages by their kind and source, and where in a state what they say belongs."""

    def __init__(self, path: str, model: Model):
        self.path, self.model, self.description = path, model, describe_whole(model)
        self.sources: dict[str, dict[Source, Stamped]] = {kind: {} for kind in USED}
        followers = {each.joint for each in self.description.followers}
        moving = [link for link in self.description.moving if link.joint not in followers]
        self.singles = [x for x in moving if x.kind != "quaternion_floating"]
        self.free = [x for x in moving if x.kind == "quaternion_floating"]

    def motion(self) -> tuple[Array, Array, Array]:
        model = self.model
        joints = self._only(JOINTS, "/joint_states") if self.singles else {}
        bases = {link.body: self._base_of(link) for link in self.free}
        stamps = self._common({"the joints": joints, **bases} if self.singles else bases)
        xs, us = np.zeros((len(stamps), model.nx)), np.zeros((max(len(stamps) - 1, 0), model.nu))
        places = {link.joint: self._places(link) for link in (*self.singles, *self.free)}
        for k, time in enumerate(stamps):
            for link in self.singles:
                i, j = places[link.joint]
                xs[k, i] = self._joint(joints[time], time, link.joint, "position")
                xs[k, model.nq + j] = self._joint(joints[time], time, link.joint, "velocity")
            for link in self.free:
                i, j = places[link.joint]
                xs[k, i : i + 7] = bases[link.body][time][:7]
                xs[k, model.nq + j : model.nq + j + 6] = bases[link.body][time][7:]
            for i, joint in enumerate(self.description.actuated if k < len(us) else ()):
                if self.description.actuated.count(joint) > 1:
                    expected = "one effort, one input"
                    raise InputError(f"joint {joint}", got="not driven by one actuator alone", expected=expected)
                us[k, i] = self._joint(joints[time], time, joint, "effort")
        return np.array([time - stamps[0] for time in stamps]) / 1e9, xs, us

    def _places(self, link: Link) -> tuple[int, int]:
        """Where q and v of a joint begin, in those of the model."""
        coupling = self.model.coupling
        if coupling is None:
            return link.q_start, link.v_start
        return int(np.searchsorted(coupling.own_q, link.q_start)), int(np.searchsorted(coupling.own_v, link.v_start))

    def _common(self, parts: Mapping[str, Mapping[int, Any]]) -> list[int]:
        """The times that all parts have; InputError for one that some lack."""
        every = sorted({time for part in parts.values() for time in part})
        for time in every:
            there = [name for name, part in parts.items() if time in part]
            if len(there) < len(parts):
                raise InputError(
                    f"{self.path}: t = {time} ns", got=f"{', '.join(there)} alone",
                    expected=f"{', '.join(parts)} at each time",
                )  # fmt: skip
        return every

    def _joint(self, message: Any, time: int, joint: str, what: str) -> float:
        names, values = list(message.name), getattr(message, what)
        subject = f"{self.path}: JointState at {time} ns, {what} of {joint}"
        if joint not in names or len(values) != len(names):
            raise InputError(subject, got=f"{len(values)} of {', '.join(names)}", expected="one of each joint")
        value = float(values[names.index(joint)])
        if not np.isfinite(value):
            raise InputError(subject, got=value, expected="a finite number")
        return value

    def _only(self, kind: str, preferred: str = "") -> Stamped:
        sources = self.sources[kind]
        for (topic, _), messages in sources.items():
            if topic == preferred:
                return messages
        if len(sources) != 1:
            raise InputError(f"{self.path}: topics of {kind}", got=_listed(sources), expected=preferred or "one")
        return next(iter(sources.values()))

    def _of_body(self, kind: str, link: Link) -> Stamped:
        """The messages of one free body, by their frame, else by the topic's name; of an only body the only ones."""
        names, sources = _names(link.body), self.sources[kind]
        by_frame = [source for source in sources if source[1].strip("/") in names]
        by_topic = [source for source in sources if any(f"/{name}/" in f"/{source[0].strip('/')}/" for name in names)]
        for found in (by_frame, by_topic):
            if len(found) == 1:
                return sources[found[0]]
        if len(self.free) == 1:
            return self._only(kind)
        raise InputError(
            f"{self.path}: topics of {kind} of the free body {link.body}", got=_listed(sources),
            expected=f"one of the frame {link.body}, or with {link.body} as a part of its name",
        )  # fmt: skip

    def _base_of(self, link: Link) -> dict[int, Array]:
        if not all(X.IsExactlyIdentity() for X in (link.on_parent, link.on_child)):
            raise InputError("free bodies", got=link.joint, expected="by its own frame in the world")
        if self.sources[ODOMETRY]:
            odometry = self._of_body(ODOMETRY, link)
            return {t: _base(m.pose.pose, m.twist.twist, in_body=True) for t, m in odometry.items()}
        poses, twists = self._of_body(POSE, link), self._of_body(TWIST, link)
        self._common({f"the pose of {link.body}": poses, f"the twist of {link.body}": twists})
        found = {}
        for t, pose in poses.items():
            frame, world = twists[t].header.frame_id, pose.header.frame_id
            if (frame != world and frame not in _names(link.body)) or world in _names(link.body):
                expected = f"{world!r}, the pose's, or {link.body!r}, the body"
                raise InputError(f"{self.path}: frame_id of TwistStamped", got=repr(frame), expected=expected)
            found[t] = _base(pose.pose, twists[t].twist, in_body=frame != world)
        return found


def _names(body: str) -> set[str]:
    """How frames and topics may call a body: ROS has no :: in names."""
    return {body, body.replace("::", "/"), body.replace("::", "_")}


def _listed(sources: Mapping[Source, Stamped]) -> str:
    told = sorted(topic if not frame else f"{topic} (of {frame})" for topic, frame in sources)
    return ", ".join(told) or "none"


def _base(pose: Any, twist: Any, in_body: bool) -> Array:
    """(13,) q and v of the free body, in Drake's coordinates."""
    p, r, w, v = pose.position, pose.orientation, twist.angular, twist.linear
    q = np.array([r.w, r.x, r.y, r.z, p.x, p.y, p.z])
    parts = np.array([[w.x, w.y, w.z], [v.x, v.y, v.z]])
    return np.concatenate([q, (parts @ rotation(q[:4]).T if in_body else parts).ravel()])

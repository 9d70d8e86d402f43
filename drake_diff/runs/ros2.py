"""A run's motion as a bag that `ros2 bag` reads: the trace's own channels in ROS 2's messages and encoding."""

import re
from collections.abc import Callable
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff.exceptions import ArtifactError, InputError, MissingDependencyError
from drake_diff.logs.mcap_file import read_mcap
from drake_diff.mechanics.coordinates import rotation

TRACE, STATE = "trace.mcap", "/state"
QUATERNION_POSE = ("qw", "qx", "qy", "qz", "x", "y", "z")  # of a free body's coordinates, by the ends of their names
INFO, ERROR = 20, 40  # of rcl_interfaces/Log
BAG_VERSION = 8  # of metadata.yaml: the one that Humble and everything newer reads
Convert = Callable[[dict[str, Any], int, Any, dict[str, Any]], Any]  # ROS types, time [ns], message, channel metadata


def export_ros2(run: str | Path, out: str | Path) -> dict[str, int]:
    """Write the bag directory `out` from the trace of the run directory `run`; gives messages by topic.

    Each free body is nav_msgs/Odometry in /odometry/BODY. Times are simulated, from 0. Raises ArtifactError where the
    trace is missing, damaged or without joints, InputError where `out` exists, MissingDependencyError without the
    `rosbags` package.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingDependencyError("a ROS 2 bag needs rosbags: pip install 'drake-diff[ros2]'") from error
    source, out = Path(run) / TRACE, Path(out)
    log = read_mcap(source, links=False)
    missing = CONVERTED.keys() - log.messages.keys()
    if missing:
        raise ArtifactError(f"{source}: no channel {', '.join(sorted(missing))}")
    if out.exists() or not out.parent.is_dir():
        raise InputError("OUT", got=str(out), expected="a directory that does not exist, in one that does")
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(out, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
        bag.set_custom_data("written_by", "drake_diff")
        written = {topic: (topic, *converted) for topic, converted in CONVERTED.items()}
        written |= _free_bodies(log.channel_metadata.get(STATE, {}))
        bags = {topic: bag.add_connection(topic, name, typestore=store) for topic, (_, name, _) in written.items()}
        rows = [
            (time, topic, message) for topic, (inner, *_) in written.items() for time, message in log.messages[inner]
        ]
        for time, topic, message in sorted(rows, key=itemgetter(0)):
            inner, name, convert = written[topic]
            converted = convert(store.types, time, message, log.channel_metadata[inner])
            bag.write(bags[topic], time, store.serialize_cdr(converted, name))
    return {topic: len(log.messages[inner]) for topic, (inner, *_) in written.items()}


def _free_bodies(metadata: dict[str, Any]) -> dict[str, tuple[str, str, Convert]]:
    """By topic the channel, the type and the conversion of each free body, known by the names of its coordinates."""
    names: dict[str, list[str]] = metadata.get("names", {})
    q, v = names.get("q", []), names.get("v", [])
    result: dict[str, tuple[str, str, Convert]] = {}
    for i, first in enumerate(q):
        body = first.removesuffix("_qw")
        if q[i : i + 7] == [f"{body}_{piece}" for piece in QUATERNION_POSE] and f"{body}_wx" in v:
            convert = partial(_odometry, body=body, i=i, j=v.index(f"{body}_wx"))
            result[f"/odometry/{re.sub(r'[^A-Za-z0-9_]', '_', body)}"] = (STATE, "nav_msgs/msg/Odometry", convert)
    return result


def _odometry(types: dict[str, Any], time: int, message: Any, _: dict[str, Any], *, body: str, i: int, j: int) -> Any:
    """nav_msgs/Odometry, as REP 105 has it: the twist in the body's frame. `i` and `j` are its places in q and v."""
    w, x, y, z, *p = message.q[i : i + 7]
    turn = rotation(np.array([w, x, y, z])).T
    angular, linear = (turn @ np.array(message.v[k : k + 3]) for k in (j, j + 3))
    vector, unknown = types["geometry_msgs/msg/Vector3"], np.zeros(36)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](*p),
        orientation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
    )
    twist = types["geometry_msgs/msg/Twist"](linear=vector(*map(float, linear)), angular=vector(*map(float, angular)))
    return types["nav_msgs/msg/Odometry"](
        header=_header(types, time, "world"), child_frame_id=body,
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=unknown),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=unknown),
    )  # fmt: skip


def _joint_state(types: dict[str, Any], time: int, message: Any, _: dict[str, Any]) -> Any:
    """sensor_msgs/JointState; NaN for the effort of a joint that nothing drives, no efforts where none is known."""
    joints = message.joints
    efforts = [j.effort if j.HasField("effort") else np.nan for j in joints]
    return types["sensor_msgs/msg/JointState"](
        header=_header(types, time),
        name=[j.name for j in joints],
        position=np.array([j.position for j in joints]),
        velocity=np.array([j.velocity for j in joints]),
        effort=np.array(efforts if any(j.HasField("effort") for j in joints) else []),
    )


def _transforms(types: dict[str, Any], time: int, message: Any, _: dict[str, Any]) -> Any:
    def pose(t: Any) -> Any:
        p, r = t.translation, t.rotation
        return types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](x=p.x, y=p.y, z=p.z),
            rotation=types["geometry_msgs/msg/Quaternion"](x=r.x, y=r.y, z=r.z, w=r.w),
        )

    stamped = types["geometry_msgs/msg/TransformStamped"]
    result = [stamped(_header(types, time, t.parent_frame_id), t.child_frame_id, pose(t)) for t in message.transforms]
    return types["tf2_msgs/msg/TFMessage"](transforms=result)


def _input(types: dict[str, Any], _: int, message: Any, metadata: dict[str, Any]) -> Any:
    """std_msgs/Float64MultiArray, the inputs' names as the label of its dimension."""
    count = len(message.u)
    dimension = types["std_msgs/msg/MultiArrayDimension"](", ".join(metadata["names"]["u"]), count, count)
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[dimension], data_offset=0)
    return types["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.array(message.u, dtype=float))


def _diagnostics(types: dict[str, Any], time: int, message: Any, metadata: dict[str, Any]) -> Any:
    """diagnostic_msgs/DiagnosticArray: every number as text that reads back to the same bits, its unit beside it."""
    units = metadata["units"]
    pair = types["diagnostic_msgs/msg/KeyValue"]
    names = [field.name for field in message.DESCRIPTOR.fields]
    values = [pair(f"{name} [{units[name]}]", repr(getattr(message, name))) for name in names]
    content = types["diagnostic_msgs/msg/DiagnosticStatus"]
    status = content(level=0, name="drake_diff", message="", hardware_id="", values=values)
    return types["diagnostic_msgs/msg/DiagnosticArray"](header=_header(types, time), status=[status])


def _contacts(types: dict[str, Any], time: int, message: Any, metadata: dict[str, Any]) -> Any:
    """diagnostic_msgs/DiagnosticArray: a status for each contact, body a on body b; numbers as in `_diagnostics`."""
    units, pair = metadata["units"], types["diagnostic_msgs/msg/KeyValue"]
    names = [field.name for field in message.DESCRIPTOR.fields if field.name not in ("body_a", "body_b")]
    result = [
        types["diagnostic_msgs/msg/DiagnosticStatus"](
            level=0, name=f"{a} on {b}", message="contact", hardware_id="",
            values=[pair(f"{name} [{units[name]}]", repr(getattr(message, name)[i])) for name in names],
        )
        for i, (a, b) in enumerate(zip(message.body_a, message.body_b, strict=True))
    ]  # fmt: skip
    return types["diagnostic_msgs/msg/DiagnosticArray"](header=_header(types, time), status=result)


def _event(types: dict[str, Any], time: int, message: Any, _: dict[str, Any]) -> Any:
    """rcl_interfaces/Log: a failure is an error, anything else information; its kind is the name."""
    content = message.kind if not message.failure_label else f"{message.kind}: {message.failure_label}"
    return types["rcl_interfaces/msg/Log"](
        stamp=_header(types, time).stamp, level=ERROR if message.kind == "failure" else INFO, name=content,
        msg=message.message, file="", function=message.code, line=0,
    )  # fmt: skip


def _header(types: dict[str, Any], time: int, frame: str = "") -> Any:
    return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(time, 1_000_000_000)), frame)


CONVERTED: dict[str, tuple[str, Convert]] = {
    "/joint_states": ("sensor_msgs/msg/JointState", _joint_state),
    "/planned/joint_states": ("sensor_msgs/msg/JointState", _joint_state),
    "/tf": ("tf2_msgs/msg/TFMessage", _transforms),
    "/input": ("std_msgs/msg/Float64MultiArray", _input),
    "/contacts": ("diagnostic_msgs/msg/DiagnosticArray", _contacts),
    "/events": ("rcl_interfaces/msg/Log", _event),
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", _diagnostics),
}

"""Recorded motions of a model: reading from CSV, NumPy, MCAP and ROS 2 files, checks, and storage as arrays in a run.

ROS 2 messages, in a bag or in one MCAP file, have the time of their headers. sensor_msgs/JointState (/joint_states, or
the only topic of this type) gives joints by name, with efforts as the inputs of their actuators. Commanded positions
are those of trajectory_msgs/JointTrajectory: the latest message holds, linear between its points. nav_msgs/Odometry, or
geometry_msgs/PoseStamped and TwistStamped, give one free body. With several bodies, a message belongs to the body
of its frame, or to the body whose name is part of the topic's name. A truncated bag is refused. A changed byte is
detected only if the writer added a checksum, which rosbags does not.
"""

import csv
import io
import json
import math
import re
import sqlite3
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import chain, count, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, array_with_gaps, finite_array, frozen
from drake_diff._base.files import MOST_TEXT, arrays_of, json_of, make_folder, plain_file, read_plain, write_whole
from drake_diff._base.sandbox import reading
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import ArtifactError, InputError, MissingDependencyError, UnknownNameError
from drake_diff.logs.mcap_file import has_channels, raw_messages, read_mcap
from drake_diff.mechanics.coordinates import rotation
from drake_diff.mechanics.description import Link, describe_tree, describe_whole
from drake_diff.model.file_facts import Mjcf, joints_below
from drake_diff.model.mjcf_repairs import CtrlInput, inputs_of_ctrl
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators, joints, labelled
from drake_diff.model.tangent import tangent_space
from drake_diff.model.xml_text import Element

JOINTS, ODOMETRY = "sensor_msgs/msg/JointState", "nav_msgs/msg/Odometry"
POSE, TWIST = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped"
ROS2 = "cdr"  # encoding of ROS 2 messages
COMMANDS = "trajectory_msgs/msg/JointTrajectory"
USED = (JOINTS, ODOMETRY, POSE, TWIST, COMMANDS)
Stamped = dict[int, Any]  # messages by time [ns]
Motion = tuple[Array, Array, Array]  # times (n,) [s], xs (n, nx), us (n - 1, nu)
Source = tuple[str, str]  # a topic, and the body frame in its messages, or "" if they have none


def read_ros2(path: Path, model: Model, gaps: bool = False) -> tuple[Motion, Mapping[str, str]]:
    """Return (times (n,) from 0, xs (n, nx), us (n - 1, nu)), and the metadata record "contract" of an MCAP file.

    With `gaps`, velocities that a JointState lacks are NaN. Raises InputError that names message and time if a joint, a
    twist or an effort is missing.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingDependencyError("a ROS 2 bag needs rosbags: pip install 'drake-diff[ros2]'") from error
    store, log = get_typestore(Stores.ROS2_HUMBLE), _Found(str(path), model, gaps)
    messages, facts = _messages(path)
    for topic, kind, data, logged in messages:
        message = store.deserialize_cdr(data, kind)
        stamp = message.header.stamp
        source, time = (topic, _frame_of_body(kind, message)), stamp.sec * 1_000_000_000 + stamp.nanosec
        if kind == COMMANDS:
            log.commands.append((time or logged, message))  # without a stamp, a trajectory begins at once
        else:
            log.sources[kind].setdefault(source, {})[time] = message
    return log.motion(), facts


def _frame_of_body(kind: str, message: Any) -> str:
    if kind == ODOMETRY:
        return str(message.child_frame_id)
    return str(message.header.frame_id) if kind == TWIST else ""


def _messages(path: Path) -> tuple[list[tuple[str, str, bytes, int]], Mapping[str, str]]:
    """Return topic, type, bytes and log time of the messages, and the metadata record "contract" of an MCAP file."""
    from rosbags.rosbag2 import Reader

    files, rows, facts = sorted(path.glob("*.mcap")) if path.is_dir() else [path], [], dict[str, str]()
    if files:
        for file in files:
            messages, metadata = raw_messages(read_plain(file, links=True), ROS2)
            rows += [message for message in messages if message[1] in USED]
            facts |= metadata.get("contract", {}) if file == path else {}
        return rows, facts
    for file in path.glob("*.db3"):
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True)) as base:
            (others,) = base.execute("SELECT count(*) FROM sqlite_master WHERE type IN ('view', 'trigger')").fetchone()
        if others:  # views and triggers can generate endless rows
            raise ArtifactError(f"{file}: expected only tables of messages, got {others} views and triggers")
    with Reader(path) as bag:
        wanted = [c for c in bag.connections if c.msgtype in USED]
        return [(c.topic, c.msgtype, data, logged) for c, logged, data in bag.messages(wanted)] if wanted else [], {}


class _Found:
    """Messages by type and source, and their conversion to states."""

    def __init__(self, path: str, model: Model, gaps: bool):
        self.path, self.model, self.gaps = path, model, gaps
        self.description = describe_tree(model) if np.any(model.inputs.commanded) else describe_whole(model)
        self.sources: dict[str, dict[Source, Stamped]] = {kind: {} for kind in USED}
        self.commands: list[tuple[int, Any]] = []  # begin [ns] and trajectory
        followers = {follower.joint for follower in self.description.followers}
        moving = [link for link in self.description.moving if link.joint not in followers]
        self.singles = [x for x in moving if x.kind != "quaternion_floating"]
        self.free = [x for x in moving if x.kind == "quaternion_floating"]

    def motion(self) -> Motion:
        model = self.model
        messages = self._only(JOINTS, "/joint_states") if self.singles else {}
        bases = {link.body: self._base_of(link) for link in self.free}
        stamps = self._common({"the joints": messages, **bases} if self.singles else bases)
        commands = self._commands() if np.any(model.inputs.commanded) else {}
        stamps = [time for time in stamps if all(times[0] <= time for times, _ in commands.values())]
        xs, us = np.zeros((len(stamps), model.nx)), np.zeros((max(len(stamps) - 1, 0), model.nu))
        places = {label: model.places(joint) for label, joint in labelled(joints(model.plant)).items()}
        for k, time in enumerate(stamps):
            for link in self.singles:
                q, v = places[link.joint]
                xs[k, q.start] = self._joint(messages[time], time, link.joint, "position")
                is_given = len(messages[time].velocity) or not self.gaps
                speed = self._joint(messages[time], time, link.joint, "velocity") if is_given else np.nan
                xs[k, model.nq + v.start] = speed
            for link in self.free:
                q, v = places[link.joint]
                xs[k, [*q, *(model.nq + j for j in v)]] = bases[link.body][time]
            for i, joint in enumerate(self.description.actuated if k < len(us) else ()):
                if self.description.actuated.count(joint) > 1:
                    expected = "a joint with one actuator"
                    raise InputError(f"joint {joint}", got="several actuators", expected=expected)
                if not model.inputs.commanded[i]:
                    us[k, i] = self._joint(messages[time], time, joint, "effort")
                elif joint in commands:
                    us[k, i] = np.interp(time, *commands[joint])
                else:
                    raise InputError(f"{self.path}: commands of {joint}", got="none", expected=f"{COMMANDS} with it")
        return np.array([time - stamps[0] for time in stamps]) / 1e9, xs, us

    def _commands(self) -> dict[str, tuple[list[int], list[float]]]:
        """Return times [ns] and commanded positions of each commanded joint, linear in between."""
        commands: dict[str, tuple[list[int], list[float]]] = {}
        commanded = {self.description.actuated[i] for i in np.flatnonzero(self.model.inputs.commanded)}
        for begin, message in sorted(self.commands, key=lambda pair: pair[0]):
            for i, joint in ((i, joint) for i, joint in enumerate(message.joint_names) if joint in commanded):
                times, values = commands.setdefault(joint, ([], []))
                before = sum(time < begin - 1 for time in times)
                # The command until now ends just before this one begins; before its first point, none is known.
                until = [float(np.interp(begin - 1, times, values))] if times and times[0] < begin else []
                times[before:], values[before:] = [begin - 1] * len(until), until
                for point in message.points:
                    wait, positions = point.time_from_start, np.asarray(point.positions)
                    time = begin + wait.sec * 1_000_000_000 + wait.nanosec
                    subject = f"{self.path}: JointTrajectory at {begin} ns, point at {time} ns"
                    if len(positions) != len(message.joint_names) or not np.all(np.isfinite(positions)):
                        raise InputError(subject, got=f"positions {positions}", expected="a finite one for each joint")
                    if time < max([begin, *times[-1:]]):
                        raise InputError(subject, got="an earlier point before it", expected="times that increase")
                    times.append(time)
                    values.append(float(positions[i]))
        return {joint: pair for joint, pair in commands.items() if pair[0]}

    def _common(self, parts: Mapping[str, Mapping[int, Any]]) -> list[int]:
        """Return the times of all parts. Raises InputError for a time that a part lacks."""
        every = sorted({time for messages in parts.values() for time in messages})
        for time in every:
            there = [name for name, messages in parts.items() if time in messages]
            if len(there) < len(parts):
                raise InputError(
                    f"{self.path}: t = {time} ns", got=f"only {', '.join(there)}",
                    expected=f"messages of {', '.join(parts)} at each time",
                )  # fmt: skip
        return every

    def _joint(self, message: Any, time: int, joint: str, what: str) -> float:
        names, values = list(message.name), getattr(message, what)
        subject = f"{self.path}: JointState at {time} ns, {what} of {joint}"
        if joint not in names or len(values) != len(names):
            raise InputError(subject, got=f"{len(values)} values for {', '.join(names)}", expected="one for each joint")
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
            raise InputError(f"{self.path}: topics of {kind}", got=_listed(sources), expected=preferred or "one topic")
        return next(iter(sources.values()))

    def _of_body(self, kind: str, link: Link) -> Stamped:
        """Return the messages of a free body by their frame, else by topic name; an only body has the only messages."""
        names, sources = _names(link.body), self.sources[kind]
        by_frame = [source for source in sources if source[1].strip("/") in names]
        by_topic = [source for source in sources if any(f"/{name}/" in f"/{source[0].strip('/')}/" for name in names)]
        for matches in (by_frame, by_topic):
            if len(matches) == 1:
                return sources[matches[0]]
        if len(self.free) == 1:
            return self._only(kind)
        raise InputError(
            f"{self.path}: topics of {kind} of the free body {link.body}", got=_listed(sources),
            expected=f"one topic with the frame {link.body}, or with {link.body} in its name",
        )  # fmt: skip

    def _base_of(self, link: Link) -> dict[int, Array]:
        if not all(X.IsExactlyIdentity() for X in (link.on_parent, link.on_child)):
            raise InputError("free body", got=link.joint, expected="a joint of its own frame to the world")
        if self.sources[ODOMETRY]:
            odometry = self._of_body(ODOMETRY, link)
            return {t: _base(m.pose.pose, m.twist.twist, in_body=True) for t, m in odometry.items()}
        poses, twists = self._of_body(POSE, link), self._of_body(TWIST, link)
        self._common({f"the pose of {link.body}": poses, f"the twist of {link.body}": twists})
        bases = {}
        for t, pose in poses.items():
            frame, world = twists[t].header.frame_id, pose.header.frame_id
            if (frame != world and frame not in _names(link.body)) or world in _names(link.body):
                expected = f"the frame of the pose, {world!r}, or the body, {link.body!r}"
                raise InputError(f"{self.path}: frame_id of TwistStamped", got=repr(frame), expected=expected)
            bases[t] = _base(pose.pose, twists[t].twist, in_body=frame != world)
        return bases


def _names(body: str) -> set[str]:
    """Return the names that frames and topics may use for a body, as ROS names cannot contain "::"."""
    return {body, body.replace("::", "/"), body.replace("::", "_")}


def _listed(sources: Mapping[Source, Stamped]) -> str:
    topics = sorted(topic if not frame else f"{topic} (of {frame})" for topic, frame in sources)
    return ", ".join(topics) or "none"


def _base(pose: Any, twist: Any, in_body: bool) -> Array:
    """Return q and v (13,) of the free body, in Drake's coordinates."""
    p, r, w, v = pose.position, pose.orientation, twist.angular, twist.linear
    q = np.array([r.w, r.x, r.y, r.z, p.x, p.y, p.z])
    parts = np.array([[w.x, w.y, w.z], [v.x, v.y, v.z]])
    return np.concatenate([q, (parts @ rotation(q[:4]).T if in_body else parts).ravel()])


# Allowed facts of an engine; numbers are JSON: the time step [s], gravity (3,) [m/s^2], seeds.
FACTS = (
    "engine", "version", "precision", "time step", "integrator", "contact law", "limit law", "gravity",
    "seeds", "reset distribution",
)  # fmt: skip
NORM_TOLERANCE = 1e-3  # of a quaternion's norm: allows float32 and five printed digits, but not another order
# Names of quantities of joints in the columns of a CSV file.
POSITION, VELOCITY = ("position", "pos", "q"), ("velocity", "vel", "v", "dq", "qd")
COMMAND = ("q_desired", "q_des", "desired_position", "position_command", "command", "target")
EFFORT = ("effort", "torque", "tau")
UNUSED = " effort of "  # of a joint with a servo: no model reads it; with a space, as no name in a file begins with one
KINDS = ("an effort", "a commanded position")  # of inputs
OF_MUJOCO = ("time", "t", "qpos", "qvel", "ctrl")  # arrays
NUMBERED = ("{}{}", "{}_{}", "{}[{}]")  # a quantity and the number of a joint
CLOCK_TOLERANCE = 1e-3  # relative to a time step: allows printed times and nanoseconds


@dataclass(frozen=True, eq=False, repr=False)
class Recording(ShowsItsRepr):
    """A recorded motion of a model, for `dd.compare` and `dd.identify`.

    Args:
        name: the name of the engine.
        version: the version of the engine.
        times: (n,) [s], increasing, a whole number of the model's time steps apart.
        xs: (n, nx) states in Drake's coordinates.
        us: (n - 1, nu) inputs, each constant until the next time.
        facts: known facts of the engine's contract, by quantity: "precision", "time step", "integrator",
            "contact law", "limit law", "gravity", "seeds", "reset distribution".
        outputs: sensor readings for `dd.identify`: (n,) by column, BODY.position_x, BODY.gyro_x, BODY.accel_x (or y,
            z) or JOINT.force; NaN if not measured.

    Example:
        >>> fall = dd.Recording("lab", "1.0", times=[0, 0.01], xs=[[0, 0], [0, 0]], us=[[0]])
        >>> print(fall)
        lab 1.0: 2 samples over 0.01 s
    """

    name: str
    version: str
    times: Array
    xs: Array
    us: Array
    facts: Mapping[str, str] = field(default_factory=dict)
    outputs: Mapping[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"{self.name} {self.version}: {len(self.times)} samples over {self.times[-1] - self.times[0]:.6g} s"


def checked_motion(recording: Recording, model: Model, *, least: int = 2, gaps: bool = False) -> Motion:
    """Return times, states and inputs of at least `least` samples; with `gaps`, states may be NaN.

    Raises ShapeError, NonFiniteError or InputError that names recording and row.
    """
    subject = f"recording {recording.name}"
    times = finite_array(f"{subject}: times", recording.times, ("n",))
    if len(times) < least:
        raise InputError(f"{subject}: samples", got=len(times), expected=f"{least} or more")
    for k in np.flatnonzero(np.diff(times) <= 0)[:1] + 1:
        before = f"more than {times[k - 1]} s, the time of the sample before"
        raise InputError(f"{subject}: time of sample {k}", got=f"{times[k]} s", expected=before)
    xs = (array_with_gaps if gaps else finite_array)(f"{subject}: xs", recording.xs, (len(times), model.nx))
    us = finite_array(f"{subject}: us", recording.us, (len(times) - 1, model.nu))
    check_sizes(f"{subject}: times", times[:, None], ["s"])
    check_sizes(f"{subject}: xs", xs, model.state_names)
    check_sizes(f"{subject}: us", us, model.input_names)
    return times, xs, us


def check_recording(recording: Recording, model: Model) -> None:
    """Raise ShapeError, NonFiniteError or InputError, with recording and row, if this is not a motion of `model`."""
    subject, (_, xs, _) = f"recording {recording.name}", checked_motion(recording, model)
    for start in tangent_space(model).quaternions:
        norms = np.linalg.norm(xs[:, start : start + 4], axis=1)
        k = int(np.argmax(np.abs(norms - 1)))
        if abs(norms[k] - 1) > NORM_TOLERANCE:
            names = ", ".join(model.state_names[start : start + 4])
            raise InputError(f"{subject}: norm of ({names}) at sample {k}", got=float(norms[k]), expected="1")
    for quantity in recording.facts:
        if quantity not in FACTS:
            raise UnknownNameError(f"{subject}: fact", got=quantity, known=FACTS)


def check_sizes(subject: str, values: Array, names: Sequence[str]) -> None:
    """Raise InputError, with sample and column, if any of `values` (n, len(names)) exceeds `LARGEST_NUMBER`."""
    for k, j in np.argwhere(np.abs(values) > LARGEST_NUMBER)[:1]:
        expected = f"at most {LARGEST_NUMBER:g} in magnitude"
        raise InputError(f"{subject}: {names[j]} at sample {k}", got=values[k, j], expected=expected)


def steps_between(recording: Recording, time_step: float) -> int:
    """Return the number of steps of `time_step` [s] between samples. Raises InputError if it is not a constant integer.

    Periods may be off by the clock's rounding, a thousandth of a step.
    """
    periods = np.diff(recording.times)
    count = max(1, round(float(periods[0]) / time_step))
    for k in np.flatnonzero(np.abs(periods - count * time_step) > CLOCK_TOLERANCE * time_step)[:1]:
        subject = f"recording {recording.name}: period from sample {k} to {k + 1}"
        expected = f"{count * time_step:g} s throughout, a whole multiple of the model's time step, {time_step:g} s"
        raise InputError(subject, got=f"{periods[k]:.9g} s", expected=expected)
    return count


LARGEST_NUMBER = 1e12  # of a recording, in any unit: above, squares and products may overflow
LONGEST_LINE = 2**20  # characters of a line of a CSV file
MOST_NUMBERS = 2**25  # of a recording: 256 MiB
BLOCK = 10_000  # number of rows that are read at once
PACKED = {
    b"\x1f\x8b": "a gzip file", b"PK\x03\x04": "a zip archive", b"\x28\xb5\x2f\xfd": "a zstd file",
    b"\xfd7zXZ": "an xz file", b"BZh": "a bzip2 file", b"\xff\xfe": "text in UTF-16",
    b"\xfe\xff": "text in UTF-16", b"\x89MCAP": "an MCAP file", b"SQLite": "an SQLite file",
}  # fmt: skip
SUFFIXES = "a .csv, .npz or .mcap file, or the directory of a ROS 2 bag"


def read_recording(path: str | Path, model: Model, *, name: str | None = None, gaps: bool = False) -> Recording:
    """Read a motion of `model` from a CSV, .npz or MCAP file, or the directory of a ROS 2 bag.

    A CSV file has a header row and a row per sample. Its columns, in any order, are `time`, `model.state_names` and
    `model.input_names`. Joints with one degree of freedom may use `position.JOINT` and `velocity.JOINT` instead. Inputs
    are constant until the next sample and may be empty in the last row. With `gaps`, columns of sensors are allowed,
    with names as in `Recording`. An MCAP file has the channels /state and /input as written by this package, or ROS 2
    messages (JointState, JointTrajectory, Odometry, PoseStamped and TwistStamped). An .npz file has MuJoCo's arrays
    time (n,), qpos, qvel and ctrl (n or n - 1, ...), and a CSV file may have their columns, as qpos_0; only with `gaps`
    may qvel be missing. For a model from an MJCF file, they are in MuJoCo's order of that file, and each ctrl is
    converted to the model's input: an effort, or a servo's commanded position. For other models, the order is that of
    the model, and ctrl are its inputs. A free joint's position is first in qpos, and its angular velocity last in qvel
    and in the body's frame, as MuJoCo has them.

    Facts of the engine are in a JSON object in NAME.contract.json in the folder of the recording NAME, or in the
    metadata record "contract" of the MCAP file: any of the facts of `Recording`, and "engine" and "version".

    Args:
        path: the file or directory.
        model: the model that moved.
        name: a name for the engine, in place of the file's.
        gaps: whether a CSV file may lack columns of states, or have empty cells in them; missing states become NaN.

    Returns:
        A `Recording`, for `dd.compare(model, recordings=[...])`.

    Raises:
        InputError, UnknownNameError: the recording does not fit the model; the message has file, line and column.
        ArtifactError: the log is damaged.
        MissingDependencyError: rosbags, which a ROS 2 bag needs, is not installed.

    Example:
        >>> import pathlib, tempfile
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
        >>> head = ",".join(["time", *model.state_names, *model.input_names])
        >>> _ = path.write_text(head + "\\n0,0,0,0\\n0.01,0,0,")
        >>> from drake_diff.comparison import read_recording
        >>> print(read_recording(path, model))
        run (version unknown): 2 samples over 0.01 s
    """
    path = Path(path)
    if not path.exists():
        raise InputError("recording", got=f"{path}, which does not exist", expected=SUFFIXES)
    facts: Mapping[str, str] = {}
    outputs: dict[str, Array] = {}
    with reading(path, "a ROS 2 bag" if path.is_dir() else f"a complete {path.suffix} file"):
        if path.suffix == ".csv":
            motion, outputs = _read_csv(path, model, gaps)
        elif path.is_dir() or (path.suffix == ".mcap" and has_channels(read_plain(path, links=True), ROS2)):
            motion, facts = read_ros2(path, model, gaps)
        elif path.suffix == ".npz":
            motion = _of_mujoco(str(path), arrays_of(path, only=OF_MUJOCO), model, gaps)
        elif path.suffix == ".mcap":
            motion, facts = _read_mcap(path, model)
        else:
            raise InputError("recording", got=str(path), expected=SUFFIXES)
        facts = {**facts, **_contract_facts(path)}
    name, version = name or facts.get("engine", path.stem), facts.get("version", "(version unknown)")
    times, xs, us = (frozen(array) for array in motion)
    recording = Recording(name, version, times, xs, us, facts, outputs)
    if not gaps:
        check_recording(recording, model)
    return recording


def with_own_names(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings with unique names: a number is appended to a repeated name, as from files of one name."""
    renamed: dict[str, Recording] = {}
    for recording in recordings:
        numbered = chain([recording.name], (f"{recording.name} {i}" for i in count(2)))
        name = next(name for name in numbered if name not in renamed)
        renamed[name] = replace(recording, name=name)
    return list(renamed.values())


def write_csv(recording: Recording, model: Model, path: Path) -> None:
    """Write times, states and inputs in the format of `read_recording`; the last row has no inputs."""
    if np.shape(recording.xs)[1] != model.nx or np.shape(recording.us)[1] != model.nu:
        got = f"{np.shape(recording.xs)[1]} states and {np.shape(recording.us)[1]} inputs"
        raise InputError(f"recording {recording.name}", got=got, expected=f"{model.nx} and {model.nu}")
    text = io.StringIO()
    rows = csv.writer(text)
    rows.writerow(["time", *model.state_names, *model.input_names])
    for k, (t, x) in enumerate(zip(recording.times.tolist(), recording.xs.tolist(), strict=True)):
        rows.writerow([t, *x, *(recording.us[k].tolist() if k < len(recording.us) else [""] * model.nu)])
    make_folder(path.parent)
    write_whole(path, text.getvalue().encode())


def _contract_facts(path: Path) -> dict[str, str]:
    """Read the facts in the recording's .contract.json file; numbers stay JSON."""
    beside = path.with_name((path.name if path.is_dir() else path.stem) + ".contract.json")
    if not beside.exists():
        return {}
    try:
        facts = json_of(read_plain(beside, MOST_TEXT, links=True))
    except ValueError as error:
        raise InputError(str(beside), got=str(error), expected="a JSON object") from error
    if not isinstance(facts, dict):
        raise InputError(str(beside), got=type(facts).__name__, expected="a JSON object")
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in facts.items()}


def is_output(column: str) -> bool:
    """Return whether a column has the name of a sensor reading."""
    return re.fullmatch(r".+\.((position|gyro|accel)_[xyz]|force)", column) is not None


def _read_csv(path: Path, model: Model, gaps: bool) -> tuple[Motion, dict[str, Array]]:
    rows = _rows_of_csv(path)
    _, header = next(rows, (0, []))
    if not header:
        raise InputError(str(path), got="an empty file", expected="a header row and samples")
    texts = [text.strip() for text in header]
    if any(form.format("qpos", 0) in texts for form in NUMBERED):
        arrays = _arrays_in(path, rows, texts, gaps)
        sensors = {name: frozen(values) for name, values in arrays.items() if name not in OF_MUJOCO}
        return _of_mujoco(str(path), arrays, model, gaps), sensors
    outputs = tuple(text.strip() for text in header if gaps and is_output(text.strip()))
    wanted = ("time", *model.state_names, *model.input_names, *outputs)
    places = np.array(_columns(path, model, header, wanted, model.state_names if gaps else ()))
    last, given = 1 + model.nx + model.nu, np.flatnonzero(places >= 0)
    lines, cells = _numbers_of(path, rows, [(wanted[j], int(places[j])) for j in given], len(header))
    table = np.full((len(cells), len(wanted)), np.nan)
    table[:, given] = cells
    may_lack = np.zeros(table.shape, dtype=bool)
    may_lack[-1:, model.nx + 1 : last] = True  # no step begins at the last sample
    may_lack[:, 1 : model.nx + 1] = may_lack[:, last:] = gaps
    for k, j in np.argwhere(np.isnan(table) & ~may_lack)[:1]:
        raise InputError(f"{path} line {lines[k]}, column {wanted[j]}", got="''", expected="a finite number")
    for k in np.flatnonzero(np.diff(table[:, 0]) <= 0)[:1]:
        expected = f"more than {table[k, 0]}"
        raise InputError(f"{path} line {lines[k + 1]}, column time", got=table[k + 1, 0], expected=expected)
    motion = table[:, 0], table[:, 1 : model.nx + 1], table[:-1, model.nx + 1 : last]
    return motion, {name: frozen(table[:, last + i]) for i, name in enumerate(outputs)}


def _arrays_in(path: Path, rows: Iterator[tuple[int, list[str]]], header: list[str], gaps: bool) -> dict[str, Array]:
    """Return the arrays of numbered columns, as qpos_0 and qpos_1, by name, the time, and with `gaps` the sensors."""
    columns = {text: [i] for i, text in enumerate(header) if text in ("time", "t") or (gaps and is_output(text))}
    for name in OF_MUJOCO[2:]:
        numbered = {form.format(name, k): k for form in NUMBERED for k in range(len(header))}
        here = sorted((numbered[text], i) for i, text in enumerate(header) if text in numbered)
        if [k for k, _ in here] != list(range(len(here))):
            got = ", ".join(header[i] for _, i in here)
            raise InputError(f"{path} line 1, columns of {name}", got=got, expected=f"{name}_0 and so on, each once")
        columns |= {name: [i for _, i in here]} if here else {}
    for i in sorted(set(range(len(header))) - {i for places in columns.values() for i in places})[:1]:
        expected = "time, qpos_0, qvel_0, ctrl_0 and so on, each once, and with gaps=True sensors"
        raise InputError(f"{path} line 1, column", got=header[i][:80], expected=expected)
    _, cells = _numbers_of(path, rows, [(text, i) for i, text in enumerate(header)], len(header))
    return {name: cells[:, places if name in OF_MUJOCO[2:] else places[0]] for name, places in columns.items()}


def _of_mujoco(subject: str, arrays: Mapping[str, Array], model: Model, gaps: bool) -> Motion:
    """Return the motion with MuJoCo's qpos, qvel and ctrl in the order of the model's MJCF file, or of the model."""
    arrays = {"time": arrays["t"], **arrays} if "t" in arrays else arrays
    wanted = ("time", "qpos", *([] if gaps else ["qvel"]), *(["ctrl"] if model.nu else []))
    if not arrays.keys() >= set(wanted):
        raise InputError(subject, got=f"arrays {', '.join(arrays)}", expected=f"arrays {', '.join(wanted)}")
    times, qpos = arrays["time"], arrays["qpos"]
    places = {name: ends for name, j in labelled(joints(model.plant)).items() if (ends := model.places(j))[0]}
    order, inputs = sorted(places, key=lambda name: places[name][0].start), [(i, 1.0, 0.0) for i in range(model.nu)]
    if model.source is not None and model.source.suffix in (".xml", ".mjcf"):
        mjcf, rows = inputs_of_ctrl(model.source)
        order = [_joint_of(model, mjcf, element, places) for element in joints_below(mjcf.root)]
        inputs = [_input_of(model, row) for row in rows]
    missing = [name for name in places if name not in order]
    missing += [name for k, name in enumerate(model.input_names) if k not in [index for index, _, _ in inputs]]
    if missing:
        raise InputError(f"{model.source}", got=f"none for {missing[0]}", expected="joints and actuators of the model")
    n, nv, nu = times.size, model.nv, len(inputs)
    qvel, ctrl = arrays.get("qvel", np.full((n, nv), np.nan)), arrays.get("ctrl", np.zeros((n, nu)))
    widths = {"time": (), "qpos": (model.nq,), "qvel": (nv,), "ctrl": (nu,)}
    for (name, width), values in zip(widths.items(), (times, qpos, qvel, ctrl), strict=True):
        if values.shape[1:] != width or values.shape[:1] not in ((n,), (n - (name == "ctrl"),)):
            raise InputError(f"{subject}: {name}", got=values.shape, expected=f"{(n, *width)}, as time and model have")
    us, xs, i, j = np.zeros((max(n - 1, 0), model.nu)), np.full((n, model.nx), np.nan), 0, 0
    for k, (index, scale, offset) in enumerate(inputs):
        us[:, index] = scale * ctrl[: n - 1, k] + offset
    for name in order:
        q, v = places[name]
        there, speed = qpos[:, i : i + len(q)], qvel[:, j : j + len(v)]
        if len(q) == 7:  # MuJoCo has the position first, and the angular velocity in the body's frame
            spin = np.array([rotation(turn) @ w for turn, w in zip(there[:, 3:], speed[:, 3:], strict=True)])
            there, speed = np.roll(there, 4, axis=1), np.hstack([spin.reshape(n, 3), speed[:, :3]])
        xs[:, q], xs[:, [model.nq + k for k in v]] = there, speed
        i, j = i + len(q), j + len(v)
    return times, xs, us


def _joint_of(model: Model, mjcf: Mjcf, element: Element, names: Container[str]) -> str:
    """Return the name of a joint of the file, or of the free body, after checking that it is in the model's state."""
    is_free = element.tag == "freejoint" or mjcf.attributes(element).get("type") == "free"
    name = (element.parent if is_free and element.parent else element).get("name")
    if name not in names:
        got = f"{name or 'one without a name'} (line {element.line}), not in the model's state"
        raise InputError(f"{model.source}: joints", got=got, expected="named joints, none fixed, welded or reduced")
    return name


def _input_of(model: Model, row: CtrlInput) -> tuple[int, float, float]:
    """Return the index of the input that an actuator of the model's file is, and scale and offset of its ctrl."""
    actuator, key, scale, offset = row
    motors, subject = actuators(model.plant), f"{model.source}: {actuator.kind} {actuator.name} (line {actuator.line})"
    is_motor = isinstance(key, int) and key < len(motors) and motors[key].joint().name() == actuator.joint
    here = [i for i in range(model.nu) if (model.inputs.actuator[i] if is_motor else model.input_names[i]) == key]
    given = [KINDS[int(model.inputs.commanded[i])] for i in here]
    if given != [wanted := KINDS[actuator.kind == "position"]]:
        raise InputError(subject, got="".join(given) or "none", expected=f"{wanted} as its input of the model")
    return here[0], scale, offset


def _rows_of_csv(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield last line number and cells of each row that is not empty. Raises InputError if it is not CSV in UTF-8."""
    with plain_file(path, links=True) as file:
        start = file.peek(len(max(PACKED, key=len)))
        for kind in (kind for first, kind in PACKED.items() if start.startswith(first)):
            raise InputError(str(path), got=kind, expected="a CSV file: text in UTF-8, not compressed")
        rows = csv.reader(_lines(path, io.TextIOWrapper(file, encoding="utf-8-sig", newline="")))
        try:
            yield from ((rows.line_num, row) for row in rows if row)
        except csv.Error as error:
            raise InputError(f"{path} line {rows.line_num}", got=str(error), expected="a row of a CSV file") from error
        except UnicodeDecodeError as error:
            raise _no_text(path) from error


def _lines(path: Path, text: io.TextIOWrapper) -> Iterator[str]:
    for number, line in enumerate(iter(lambda: text.readline(LONGEST_LINE + 1), ""), start=1):
        if len(line) > LONGEST_LINE:
            raise InputError(f"{path} line {number}", got="more", expected=f"at most {LONGEST_LINE} characters")
        yield line


def _no_text(path: Path) -> InputError:
    """Return the error for a file that is not in UTF-8, with the line and the byte."""
    with plain_file(path, links=True) as file:
        for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), b""), start=1):
            try:
                line.decode()
            except UnicodeDecodeError as error:
                subject = f"{path} line {number}, byte {error.start + 1}"
                return InputError(subject, got=f"{line[error.start]:#04x}", expected="text in UTF-8")
    return InputError(str(path), got="other bytes", expected="text in UTF-8")


def _numbers_of(
    path: Path, rows: Iterator[tuple[int, list[str]]], columns: list[tuple[str, int]], width: int
) -> tuple[list[int], Array]:
    """Return the line numbers (n,) and the values (n, len(columns)) of some columns; NaN for an empty cell."""
    lines, blocks = list[int](), [np.zeros((0, len(columns)))]
    while block := list(islice(rows, BLOCK)):
        for line, row in block:
            if len(row) != width:
                raise InputError(f"{path} line {line}", got=f"{len(row)} cells", expected=f"{width}")
        try:
            values = np.array([[float(row[i]) for _, i in columns] for _, row in block])
            plain = bool((np.abs(values) <= LARGEST_NUMBER).all())
        except ValueError:
            plain = False
        if not plain:
            values = np.array(
                [[_number(f"{path} line {k}, column {name}", row[i]) for name, i in columns] for k, row in block]
            )
        blocks.append(values)
        lines += [line for line, _ in block]
        if len(lines) * len(columns) > MOST_NUMBERS:
            raise InputError(f"{path} line {lines[-1]}", got="more", expected=f"at most {MOST_NUMBERS} numbers in all")
    return lines, np.vstack(blocks)


def _number(subject: str, text: str) -> float:
    try:
        value = float(text) if text.strip() else 0.0
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST_NUMBER:
        expected = "a finite number" if not math.isfinite(value) else f"a number of at most {LARGEST_NUMBER:g}"
        raise InputError(subject, got=f"{text!r:.80}", expected=expected)
    return value if text.strip() else math.nan


def _other_names(model: Model, commanded: NDArray[np.bool_], header: Sequence[str]) -> dict[str, list[str]]:
    """Return the columns for which other names may stand: QUANTITY.JOINT, JOINT_QUANTITY and the like, and t.

    A quantity and a number, as q0, q_0 or q[0], count the joints in the order of the model, if the header has a 0.
    """
    names, shorter, motors, index = {"t": ["time"]}, dict[str, list[str]](), actuators(model.plant), 0
    for label, joint in labelled(joints(model.plant)).items():
        q, v = model.places(joint)
        if len(q) != 1 or len(v) != 1:
            continue
        columns = {model.state_names[q.start]: POSITION, model.state_names[model.nq + v.start]: VELOCITY}
        for i in np.flatnonzero(model.inputs.actuator >= 0):
            if motors[model.inputs.actuator[i]].joint().index() == joint.index():
                columns[model.input_names[i]] = COMMAND if commanded[i] else EFFORT
                columns |= {f"{UNUSED}{label}": EFFORT} if commanded[i] else {}
        for column, quantities in columns.items():
            for name in quantities:
                for table, text in ((names, label), (shorter, label.removesuffix("_joint"))):
                    for other in (f"{name}.{text}", f"{name}_{text}", f"{text}.{name}", f"{text}_{name}"):
                        table.setdefault(other, []).append(column)
                for form in (form for form in NUMBERED if form.format(name, 0) in header):
                    names.setdefault(form.format(name, index), []).append(column)
        index += 1
    return shorter | names


def _columns(path: Path, model: Model, header: list[str], wanted: Sequence[str], spared: Sequence[str]) -> list[int]:
    """Return the index of each wanted column, or -1 for a column in `spared` that is missing."""
    texts, every = [text.strip() for text in header], np.ones(model.nu, dtype=bool)
    others, commands = _other_names(model, model.inputs.commanded, texts), _other_names(model, every, texts)
    choices = [[text] if text in wanted else others.get(text, [text]) for text in texts]
    names = [columns[0] for columns in choices]
    for given, column, columns in zip(header, names, choices, strict=True):
        if len(set(columns)) > 1:
            raise InputError(f"{path} line 1, column {given[:80]}", got=" or ".join(columns), expected="one of them")
        if column not in wanted and column in commands:
            expected = 'a model with inputs="position" and gains (--gains KP,KD)'
            raise InputError(f"{path} line 1, column {given[:80]}", got="a commanded position", expected=expected)
        if column not in wanted and not column.startswith(UNUSED):
            raise UnknownNameError(f"{path} line 1, column", got=given[:80], known=wanted)
        if names.count(column) > 1:
            raise InputError(f"{path} line 1, column {column}", got="twice", expected="once")
    for column in wanted:
        if column not in names and column not in spared:
            got = f"only {', '.join(header):.200}"
            raise InputError(f"{path} line 1, column {column}", got=got, expected="a column")
    return [names.index(column) if column in names else -1 for column in wanted]


def _read_mcap(path: Path, model: Model) -> tuple[Motion, Mapping[str, str]]:
    log = read_mcap(path)
    state, given = log.arrays("/state"), log.arrays("/input")
    wanted = {"q": model.position_names, "v": model.velocity_names, "u": model.input_names}
    for key, names in wanted.items():
        topic = "/input" if key == "u" else "/state"
        labels: Any = log.channel_metadata[topic].get("names", {}).get(key, [])
        if tuple(labels) != names:
            raise InputError(f"{path}: names of {key} in {topic}", got=labels, expected=str(list(names)))
    motion = state["time"], np.hstack([state["q"], state["v"]]), given["u"]
    return motion, log.metadata.get("contract", {})


RECORDINGS, ARRAYS = "recordings", "arrays.npz"
LARGEST = 64 * 2**20  # largest size of a saved recording [bytes]
OUTPUT = "output "  # prefix of the arrays of sensor columns


def place_of(i: int) -> str:
    """Return the path of the arrays of recording i in the directory."""
    return f"{RECORDINGS}/{i}/{ARRAYS}"


def size_of(recording: Recording) -> int:
    """Return the size of a recording's arrays in bytes."""
    return sum(array.nbytes for array in _arrays(recording).values())


def write_arrays(path: Path, recording: Recording) -> None:
    """Write times, states, inputs and sensor readings; equal recordings give equal bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, **_arrays(recording))
    make_folder(path.parent)
    write_whole(path, buffer.getvalue())


def _arrays(recording: Recording) -> dict[str, Any]:
    arrays = {"times": recording.times, "xs": recording.xs, "us": recording.us}
    outputs = {f"{OUTPUT}{name}": values for name, values in recording.outputs.items()}
    return {name: np.asarray(values, dtype=float) for name, values in {**arrays, **outputs}.items()}


def read_arrays(path: Path, name: str, version: str, facts: Mapping[str, str]) -> Recording:
    """Read the recording with arrays at `path`. Raises ArtifactError if they are not a recording's."""
    arrays = arrays_of(path)
    missing = {"times", "xs", "us"} - arrays.keys()
    if missing:
        tail = "/".join(path.parts[-3:])
        raise ArtifactError(f"{tail} is not a recording: it lacks the arrays {', '.join(sorted(missing))}")
    times, xs, us = (arrays.pop(key) for key in ("times", "xs", "us"))
    outputs = {key.removeprefix(OUTPUT): values for key, values in arrays.items() if key.startswith(OUTPUT)}
    return Recording(name, version, times, xs, us, dict(facts), outputs)

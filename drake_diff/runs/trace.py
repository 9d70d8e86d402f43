"""trace.mcap: the plant's motion and the plan in simulated time, and the search for the plan; and its ROS 2 bag.

Tables without simulated time are logged at 1 ms per row, since wall-clock times would make every file different. The
bag contains the trace's own channels in ROS 2's messages and encoding, as `ros2 bag` reads them.
"""

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.values import ShowsItsRepr
from drake_diff.certificates.certificate import Certificate
from drake_diff.exceptions import ArtifactError, InputError, MissingDependencyError
from drake_diff.logs.channels import (
    TYPES,
    MessageType,
    Shown,
    input_channel,
    motion_channels,
    nanoseconds,
    state_channel,
)
from drake_diff.logs.mcap_file import Channel, read_mcap, write_mcap
from drake_diff.mechanics.coordinates import rotation
from drake_diff.model.parameters import applied
from drake_diff.motion.rollout import CONTINUOUS
from drake_diff.runs.fields import canonical
from drake_diff.runs.measurement import Measurement, gradient_norms

ROW_PERIOD = 1_000_000  # [ns] of log time per row of a table
CONFIGURATION = "configuration.json"
MEDIA_TYPES = {".urdf": "application/xml", ".sdf": "application/xml", ".xml": "application/xml"}
# The channels that `read_trace` needs; a trace has more channels.
CHANNELS = {"/state", "/input", "/planned/state", "/planned/input", "/planned/plan", "/diagnostics"}


def write_trace(path: Path, m: Measurement, attachments: Mapping[str, tuple[str, bytes]]) -> None:
    """Write the trace of a measurement; `attachments` maps names to (media type, data).

    The configuration and the model file are attached too. The frames are those of the plant with the solution's
    parameters.
    """
    solution = m.solution
    problem = solution.problem
    configuration = {
        "method": solution.method,
        "solver": solution.solver,
        "scheme": solution.scheme,
        "num_steps": problem.num_steps,
        "time_step_s": problem.time_step,
        # Non-finite numbers are stored as text, since JSON has none.
        "options": json.loads(json.dumps(solution.options, default=str), parse_constant=str),
    }
    files = {CONFIGURATION: ("application/json", canonical(configuration).encode()), **attachments}
    if problem.moved is not None and problem.moved.source is not None:
        source = problem.moved.source
        files[source.name] = (MEDIA_TYPES.get(source.suffix, "application/octet-stream"), source.read_bytes())
    metadata = {
        "status": solution.status.value,
        "method": solution.method,
        "model": problem.name,
        "time_axis": "simulated; tables: 1 ms per row",
        "motion": _told_of_motion(m),
        "verdict_rests_on": m.shown[1],
    }
    shown = Shown(problem.model, solution.time_step, m.xs, m.motion) if problem.has_model else None
    # The tables and the plan are made before the parameters are applied, since the replays use the plant too.
    channels = [*_solver_channels(m), *_plan_channels(m), _event_channel(m)]
    with applied(solution.vector) if shown else nullcontext():
        write_mcap(path, [*(motion_channels(shown) if shown else _no_motion(m)), *channels], metadata, files)


def _told_of_motion(m: Measurement) -> str:
    if m.motion is None:
        return "missing: it could not be stepped"
    continuous = m.solution.problem.motion == CONTINUOUS
    return "in continuous time, integrated apart, open loop" if continuous else "the discrete plant, open loop"


def _no_motion(m: Measurement) -> Iterator[Channel]:
    """Yield the channels of the plant's motion without rows, since plain dynamics have no plant."""
    nothing = np.zeros((0, len(m.positions)))
    yield state_channel("/state", nothing[:, 0], nothing, m.positions, m.velocities)
    yield input_channel("/input", nothing[:, 0], nothing, m.inputs)
    yield _channel("/diagnostics", TYPES["Diagnostics"], [])


def _plan_channels(m: Measurement) -> Iterator[Channel]:
    """Yield the channels of a Solution's numbers: states, inputs at knots and midpoints, horizon, parameters."""
    solution, times = m.solution, m.solution.times
    inputs = solution.inputs_at_knots
    yield state_channel("/planned/state", times, solution.xs, m.positions, m.velocities)
    yield input_channel("/planned/input", times[: len(inputs)], inputs, m.inputs)
    if solution.us_mid is not None:
        yield input_channel("/planned/input_mid", (times[:-1] + times[1:]) / 2, solution.us_mid, m.inputs)
    kind, vector = TYPES["Plan"], solution.vector
    plan = kind.cls(
        scheme=solution.scheme,
        num_steps=len(solution.us),
        horizon=solution.horizon,
        horizon_is_free=solution.free_horizon is not None,
        parameters=vector.values.tolist(),
        mesh=[] if solution.mesh is None else solution.mesh.tolist(),
    )
    units = [p.unit for p in vector.parameters for _ in p.value]
    metadata = {
        "units": {**kind.units, "parameters": dict(zip(vector.names, units, strict=True))},
        "names": {"parameters": list(vector.names)},
    }
    yield Channel("/planned/plan", kind.cls, [(0, plan)], metadata)


def _solver_channels(m: Measurement) -> Iterator[Channel]:
    """Yield the tables of the solver's iterations, certificates and replays, and the gradient's norm at each step."""
    solution = m.solution
    yield _table("/solver/iterations", "SolverIteration", solution.iterations, "iteration")
    checks = [_gradient_check(c) for c in solution.certificates]
    yield _table("/gradient/check", "GradientCheck", checks, "certificate")
    kind = TYPES["GradientNorm"]
    norms = [np.full(len(m.times), np.nan) if n is None else n for n in gradient_norms(solution)]
    known = any(np.any(np.isfinite(n)) for n in norms)
    by_knot = enumerate(zip(*norms, strict=True)) if known else ()
    rows = [
        (nanoseconds(float(m.times[k])), kind.cls(step=k, final_state=end, lagrangian=slope))
        for k, (end, slope) in by_knot
    ]
    yield _channel("/gradient/norm", kind, rows)
    yield _table("/replays", "Replay", m.replays, "replay")


def _channel(topic: str, kind: MessageType, rows: Sequence[tuple[int, Any]], **metadata: Any) -> Channel:
    return Channel(topic, kind.cls, rows, {"units": kind.units, **metadata})


def _table(topic: str, name: str, rows: Sequence[Any], row: str) -> Channel:
    """Return the channel of `rows` with an attribute for each field of the message."""
    kind = TYPES[name]
    names = [field.name for field in kind.cls.DESCRIPTOR.fields]
    messages = [kind.cls(**{n: getattr(value, n) for n in names}) for value in rows]
    timed = [(rank * ROW_PERIOD, message) for rank, message in enumerate(messages)]
    return _channel(topic, kind, timed, time_axis=f"1 ms per {row}")


def _gradient_check(c: Certificate) -> Any:
    worst = c.worst if c.codes.size else None  # an empty derivative has no entry
    derivative, difference = c.derivative.ravel(), c.difference.ravel()
    lengths = float(np.linalg.norm(derivative) * np.linalg.norm(difference))
    return TYPES["GradientCheck"].cls(
        subject=c.subject,
        method=c.method,
        verdict=c.verdict,
        entries=int(c.codes.size),
        agreeing=c.count("agree"),
        cosine=float(derivative @ difference) / lengths if lengths else float("nan"),
        worst_row=worst.row if worst else "",
        worst_column=worst.column if worst else "",
        worst_derivative=worst.derivative if worst else float("nan"),
        worst_difference=worst.difference if worst else float("nan"),
        worst_tolerance=worst.tolerance if worst else float("nan"),
        mode_changes=[str(change) for change in c.mode_changes],
    )


def _event_channel(m: Measurement) -> Channel:
    """Return the channel of the record's events and failures: those before the motion at 0 s, failures at its end."""
    kind = TYPES["Event"]
    before = [event for event in m.events if event.kind != "failure"]
    rows = [kind.cls(time=event.t_s or 0.0, kind=event.kind, message=event.message) for event in before]
    end = float(m.solution.times[-1])
    for f in m.failures:
        rows.append(kind.cls(time=end, kind="failure", failure_label=f.label, code=f.code, message=f.message))
    return _channel("/events", kind, [(nanoseconds(row.time), row) for row in rows])


@dataclass(frozen=True, eq=False, repr=False)
class Trace(ShowsItsRepr):
    """The motions in a trace; arrays are read-only. All numbers of the plan are in plan.npz.

    `xs` (N+1, nx) under `us` (N, nu) is the open-loop motion of the discrete plant, without rows if it could not be
    computed; `planned_xs` (N+1, nx) and `planned_us` (N or N+1, nu) are the solver's.

    Example:
        >>> from drake_diff.runs import read_trace
        >>> trace = read_trace("artifacts/pendulum_swing_up/trace.mcap")
        >>> sorted(trace.attachments), float(trace.diagnostics["max_penetration"].max())
        (['configuration.json', 'pendulum.urdf', 'record.json'], 0.0)
    """

    times: Array  # (N+1,) [s]
    xs: Array
    us: Array
    planned_xs: Array
    planned_us: Array
    diagnostics: dict[str, Array]  # (N+1,) each, by the name of a field of drake_diff.Diagnostics
    metadata: dict[str, str]
    attachments: dict[str, bytes]

    def __repr__(self) -> str:
        counts = f"{len(self.planned_xs)} planned states, {len(self.xs)} of the motion, {self.us.shape[1]} inputs"
        return f"Trace of {self.metadata.get('model', '?')}: {counts}\n  {', '.join(self.attachments)}"


def read_trace(path: str | Path) -> Trace:
    """Read the numbers of a trace, bit for bit as they were written.

    Args:
        path: A trace.mcap that `save` wrote.

    Returns:
        A `Trace`.

    Raises:
        ArtifactError: The file is damaged or lacks a channel.

    Example:
        >>> from drake_diff.runs import read_trace
        >>> trace = read_trace("artifacts/pendulum_swing_up/trace.mcap")
        >>> trace.xs.shape, trace.us.shape, float(trace.times[-1])
        ((41, 2), (40, 1), 0.8)
    """
    log = read_mcap(path, links=False)
    missing = CHANNELS - set(log.messages)
    if missing:
        raise ArtifactError(f"{path}: no channel {', '.join(sorted(missing))}")
    try:
        planned = log.arrays("/planned/state")
        return Trace(
            times=frozen(planned["time"]),
            xs=_states(log.arrays("/state")),
            us=frozen(log.arrays("/input")["u"]),
            planned_xs=_states(planned),
            planned_us=frozen(log.arrays("/planned/input")["u"]),
            diagnostics={name: frozen(values) for name, values in log.arrays("/diagnostics").items()},
            metadata=log.metadata.get("run", {}),
            attachments=log.attachments,
        )
    except (LookupError, ValueError) as error:
        raise ArtifactError(f"{path}: the channels contradict each other: {error}") from error


def _states(columns: dict[str, Any]) -> Array:
    return frozen(np.hstack([columns["q"], columns["v"]]))


TRACE, STATE = "trace.mcap", "/state"
QUATERNION_POSE = ("qw", "qx", "qy", "qz", "x", "y", "z")  # suffixes of a free body's coordinates
INFO, ERROR = 20, 40  # levels of rcl_interfaces/Log
BAG_VERSION = 8  # version of metadata.yaml that Humble and all newer releases read
Ros = Callable[..., Any]  # makes the ROS 2 message "package/Type" from the values of its fields, in their order
Convert = Callable[[Ros, int, Any, dict[str, Any]], Any]  # time [ns], message, channel metadata


def export_ros2(run: str | Path, out: str | Path) -> dict[str, int]:
    """Write the bag directory `out` from the trace of the run directory `run`; return the number of messages by topic.

    Each free body is nav_msgs/Odometry in /odometry/BODY. Times are simulated, from 0. Raises ArtifactError if the
    trace is missing, damaged or without joints, InputError if `out` exists, and MissingDependencyError without the
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
        raise InputError("OUT", got=str(out), expected="a new directory in an existing directory")
    store = get_typestore(Stores.ROS2_HUMBLE)

    def ros(name: str, *values: Any) -> Any:
        return store.types[name.replace("/", "/msg/")](*values)

    with Writer(out, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
        bag.set_custom_data("written_by", "drake_diff")
        written = {topic: (topic, *converted) for topic, converted in CONVERTED.items()}
        written |= _free_bodies(log.channel_metadata.get(STATE, {}))
        rows = []
        for topic, (inner, name, convert) in written.items():
            connection = bag.add_connection(topic, name, typestore=store)
            for time, message in log.messages[inner]:
                converted = convert(ros, time, message, log.channel_metadata[inner])
                rows.append((time, connection, store.serialize_cdr(converted, name)))
        for time, connection, data in sorted(rows, key=itemgetter(0)):
            bag.write(connection, time, data)
    return {topic: len(log.messages[inner]) for topic, (inner, *_) in written.items()}


def _free_bodies(metadata: dict[str, Any]) -> dict[str, tuple[str, str, Convert]]:
    """Map topics to the channel, type and conversion of each free body, recognized by its coordinates' names."""
    names: dict[str, list[str]] = metadata.get("names", {})
    q, v = names.get("q", []), names.get("v", [])
    result: dict[str, tuple[str, str, Convert]] = {}
    for i, first in enumerate(q):
        body = first.removesuffix("_qw")
        if q[i : i + 7] == [f"{body}_{piece}" for piece in QUATERNION_POSE] and f"{body}_wx" in v:
            convert = partial(_odometry, body=body, i=i, j=v.index(f"{body}_wx"))
            result[f"/odometry/{re.sub(r'[^A-Za-z0-9_]', '_', body)}"] = (STATE, "nav_msgs/msg/Odometry", convert)
    return result


def _odometry(ros: Ros, time: int, message: Any, _: dict[str, Any], *, body: str, i: int, j: int) -> Any:
    """Return nav_msgs/Odometry with the twist in the body's frame (REP 105); `i` and `j` are its indices in q and v."""
    w, x, y, z, *p = message.q[i : i + 7]
    turn, unknown = rotation(np.array([w, x, y, z])).T, np.zeros(36)
    angular, linear = (turn @ np.array(message.v[k : k + 3]) for k in (j, j + 3))
    twist = ros("geometry_msgs/Twist", _vector(ros, linear), _vector(ros, angular))
    pose = ros("geometry_msgs/Pose", ros("geometry_msgs/Point", *p), ros("geometry_msgs/Quaternion", x, y, z, w))
    poses = ros("geometry_msgs/PoseWithCovariance", pose, unknown)
    twists = ros("geometry_msgs/TwistWithCovariance", twist, unknown)
    return ros("nav_msgs/Odometry", _header(ros, time, "world"), body, poses, twists)


def _vector(ros: Ros, xyz: Iterable[float]) -> Any:
    return ros("geometry_msgs/Vector3", *map(float, xyz))


def _joint_state(ros: Ros, time: int, message: Any, _: dict[str, Any]) -> Any:
    """Return sensor_msgs/JointState; the effort is NaN for an unactuated joint, and empty if no effort is known."""
    joints = message.joints
    positions, velocities = np.array([j.position for j in joints]), np.array([j.velocity for j in joints])
    known = any(j.HasField("effort") for j in joints)
    efforts = [j.effort if j.HasField("effort") else np.nan for j in joints if known]
    names = [j.name for j in joints]
    return ros("sensor_msgs/JointState", _header(ros, time), names, positions, velocities, np.array(efforts))


def _transforms(ros: Ros, time: int, message: Any, _: dict[str, Any]) -> Any:
    result = []
    for t in message.transforms:
        p, r = t.translation, t.rotation
        turn = ros("geometry_msgs/Quaternion", r.x, r.y, r.z, r.w)
        transform = ros("geometry_msgs/Transform", _vector(ros, (p.x, p.y, p.z)), turn)
        header = _header(ros, time, t.parent_frame_id)
        result.append(ros("geometry_msgs/TransformStamped", header, t.child_frame_id, transform))
    return ros("tf2_msgs/TFMessage", result)


def _input(ros: Ros, _: int, message: Any, metadata: dict[str, Any]) -> Any:
    """Return std_msgs/Float64MultiArray; the label of its dimension lists the names of the inputs."""
    count = len(message.u)
    dimension = ros("std_msgs/MultiArrayDimension", ", ".join(metadata["names"]["u"]), count, count)
    layout = ros("std_msgs/MultiArrayLayout", [dimension], 0)
    return ros("std_msgs/Float64MultiArray", layout, np.array(message.u, dtype=float))


def _diagnostics(ros: Ros, time: int, message: Any, metadata: dict[str, Any]) -> Any:
    """Return diagnostic_msgs/DiagnosticArray with all numbers as text without rounding, and with their units."""
    values = {field.name: getattr(message, field.name) for field in message.DESCRIPTOR.fields}
    return _statuses(ros, time, [_status(ros, "drake_diff", "", values, metadata)])


def _contacts(ros: Ros, time: int, message: Any, metadata: dict[str, Any]) -> Any:
    """Return diagnostic_msgs/DiagnosticArray with a status for each contact, body a on body b, as in `_diagnostics`."""
    columns = {field.name: getattr(message, field.name) for field in message.DESCRIPTOR.fields}
    pairs = zip(columns.pop("body_a"), columns.pop("body_b"), strict=True)
    rows = [(f"{a} on {b}", {name: column[i] for name, column in columns.items()}) for i, (a, b) in enumerate(pairs)]
    return _statuses(ros, time, [_status(ros, name, "contact", values, metadata) for name, values in rows])


def _status(ros: Ros, name: str, message: str, values: Mapping[str, Any], metadata: dict[str, Any]) -> Any:
    units = metadata["units"]
    pairs = [ros("diagnostic_msgs/KeyValue", f"{key} [{units[key]}]", repr(value)) for key, value in values.items()]
    return ros("diagnostic_msgs/DiagnosticStatus", 0, name, message, "", pairs)


def _statuses(ros: Ros, time: int, statuses: list[Any]) -> Any:
    return ros("diagnostic_msgs/DiagnosticArray", _header(ros, time), statuses)


def _event(ros: Ros, time: int, message: Any, _: dict[str, Any]) -> Any:
    """Return rcl_interfaces/Log: an error for a failure, else information; its name is the event's kind."""
    name = message.kind if not message.failure_label else f"{message.kind}: {message.failure_label}"
    level = ERROR if message.kind == "failure" else INFO
    return ros("rcl_interfaces/Log", _time(ros, time), level, name, message.message, "", message.code, 0)


def _header(ros: Ros, time: int, frame: str = "") -> Any:
    return ros("std_msgs/Header", _time(ros, time), frame)


def _time(ros: Ros, time: int) -> Any:
    return ros("builtin_interfaces/Time", *divmod(time, 1_000_000_000))


CONVERTED: dict[str, tuple[str, Convert]] = {
    "/joint_states": ("sensor_msgs/msg/JointState", _joint_state),
    "/planned/joint_states": ("sensor_msgs/msg/JointState", _joint_state),
    "/tf": ("tf2_msgs/msg/TFMessage", _transforms),
    "/input": ("std_msgs/msg/Float64MultiArray", _input),
    "/contacts": ("diagnostic_msgs/msg/DiagnosticArray", _contacts),
    "/events": ("rcl_interfaces/msg/Log", _event),
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", _diagnostics),
}

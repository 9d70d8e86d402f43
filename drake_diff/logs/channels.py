"""The channels of trace.mcap for a motion in simulated time: states, inputs, joints, frames, contacts, energies.

Our own protobuf messages are flat, so that any viewer can plot them, and are built without protoc. The messages of a
channel are generated while they are written, so that a long motion is not stored in memory twice.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from drake_diff._base.arrays import Array
from drake_diff.exceptions import SimulationError
from drake_diff.logs.mcap_file import Channel
from drake_diff.model.contact import ContactPoint
from drake_diff.model.contract import CoordinateTerms
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators, bodies, joints
from drake_diff.model.step import set_state
from drake_diff.motion.rollout import Rollout

NUMBER, NUMBERS = ("double", False), ("double", True)
WHOLE, FLAG, TEXT, TEXTS = ("int64", False), ("bool", False), ("string", False), ("string", True)
ROW_PER_COLUMN = "unit of the row per unit of the column"

# message: {field: (type, unit)}; the order defines the field numbers, so new fields go last.
MESSAGES: dict[str, dict[str, tuple[tuple[str, bool], str]]] = {
    "State": {"time": (NUMBER, "s"), "q": (NUMBERS, "see names"), "v": (NUMBERS, "see names")},
    "Input": {"time": (NUMBER, "s"), "u": (NUMBERS, "see names")},
    "Diagnostics": {
        **dict.fromkeys(("energy_kinetic", "energy_potential", "energy_total", "energy_error"), (NUMBER, "J")),
        **dict.fromkeys(("work_actuators", "dissipation"), (NUMBER, "J")),
        "max_penetration": (NUMBER, "m"),
        "constraint_violation": (NUMBER, "m, rad or 1"),
        "n_contacts": (WHOLE, "1"),
    },
    "Contacts": {
        **dict.fromkeys(("body_a", "body_b"), (TEXTS, "")),
        **dict.fromkeys(("px", "py", "pz"), (NUMBERS, "m")),
        **dict.fromkeys(("nx", "ny", "nz"), (NUMBERS, "1")),
        **dict.fromkeys(("fx", "fy", "fz"), (NUMBERS, "N")),
        "depth": (NUMBERS, "m"),
        "slip_speed": (NUMBERS, "m/s"),
    },
    "SolverIteration": {
        "iteration": (WHOLE, "1"),
        **dict.fromkeys(("objective", "primal_infeasibility", "dual_infeasibility", "step"), (NUMBER, "1")),
    },
    "GradientCheck": {
        **dict.fromkeys(("subject", "method", "verdict"), (TEXT, "")),
        **dict.fromkeys(("entries", "agreeing"), (WHOLE, "1")),
        "cosine": (NUMBER, "1"),  # of the angle between derivative and differences, with all entries in one vector
        **dict.fromkeys(("worst_row", "worst_column"), (TEXT, "")),
        **dict.fromkeys(("worst_derivative", "worst_difference", "worst_tolerance"), (NUMBER, ROW_PER_COLUMN)),
        "mode_changes": (TEXTS, ""),
    },
    "GradientNorm": {  # |d x_N / d x_k| and |d L / d x_k|; NaN if unknown
        "step": (WHOLE, "1"),
        "final_state": (NUMBER, "state unit per state unit"),
        "lagrangian": (NUMBER, "1 per state unit"),
    },
    "Plan": {
        "scheme": (TEXT, ""),
        "num_steps": (WHOLE, "1"),
        "horizon": (NUMBER, "s"),
        "horizon_is_free": (FLAG, "1"),
        "parameters": (NUMBERS, "see names"),
        "mesh": (NUMBERS, "1"),  # the knots relative to the horizon, if they are not equidistant
    },
    "Replay": {
        **dict.fromkeys(("variant", "control", "approximation"), (TEXT, "")),
        "time_step": (NUMBER, "s"),
        **dict.fromkeys(("goal_error", "bound_violation"), (NUMBER, "the state's")),
        "energy_error": (NUMBER, "J"),
        "penetration": (NUMBER, "m"),
        "holds": (FLAG, "1"),
        "failures": (TEXTS, ""),
    },
    "Event": {"time": (NUMBER, "s"), **dict.fromkeys(("kind", "failure_label", "code", "message"), (TEXT, ""))},
}
# In a separate file, since an addition to the other file would change the schemas in every trace.
LOOP_MESSAGES: dict[str, dict[str, tuple[tuple[str, bool], str]]] = {
    "Deadline": {**dict.fromkeys(("time", "latency", "budget"), (NUMBER, "s")), "missed": (FLAG, "1")},
}


@dataclass(frozen=True)
class MessageType:
    """A message class and the units of its fields."""

    cls: Any
    units: dict[str, str]


def _build(file_name: str, messages: dict[str, Any]) -> dict[str, MessageType]:
    file = FileDescriptorProto(name=file_name, package="drake_diff", syntax="proto3")
    for name, fields in messages.items():
        message = file.message_type.add(name=name)
        for number, (field, ((kind, repeated), _)) in enumerate(fields.items(), start=1):
            label = FieldDescriptorProto.LABEL_REPEATED if repeated else FieldDescriptorProto.LABEL_OPTIONAL
            code = getattr(FieldDescriptorProto, f"TYPE_{kind.upper()}")
            message.field.add(name=field, number=number, type=code, label=label)
    pool = DescriptorPool()
    pool.Add(file)
    result = {}
    for name, fields in messages.items():
        units = {field: unit for field, (_, unit) in fields.items() if unit}
        result[name] = MessageType(GetMessageClass(pool.FindMessageTypeByName(f"drake_diff.{name}")), units)
    return result


TYPES = _build("drake_diff.proto", MESSAGES) | _build("drake_diff_loop.proto", LOOP_MESSAGES)

ARROW_LENGTH_PER_NEWTON = 0.02  # [m/N]
GHOST = "planned/"  # prefix of a body's name for its planned frame

Rows = Iterator[tuple[int, Any]]


@dataclass(frozen=True, eq=False)
class Shown:
    """A model, its planned states, and the motion of the discrete plant if there is one."""

    model: Model
    time_step: float  # [s]
    planned_xs: Array  # (N+1, nx)
    motion: Rollout | None

    @property
    def xs(self) -> Array:
        """The motion's states, without rows if the motion could not be computed."""
        return np.zeros((0, self.model.nx)) if self.motion is None else self.motion.xs

    @property
    def us(self) -> Array:
        """The motion's inputs, without rows if the motion could not be computed."""
        return np.zeros((0, self.model.nu)) if self.motion is None else self.motion.us

    def times(self, count: int) -> Array:
        """Return the first `count` times [s]: k h."""
        return np.asarray(self.time_step * np.arange(count), dtype=float)


def motion_channels(shown: Shown) -> Iterator[Channel]:
    """Yield the channels of the discrete plant's motion and its measures, and of the planned joints and frames."""
    contract = shown.model.contract
    yield state_channel("/state", shown.times(len(shown.xs)), shown.xs, contract.positions, contract.velocities)
    yield input_channel("/input", shown.times(len(shown.us)), shown.us, contract.inputs)
    efforts = None if shown.motion is None else shown.motion.efforts
    yield _joint_states(shown, "/joint_states", shown.xs, efforts)
    yield _joint_states(shown, "/planned/joint_states", shown.planned_xs, None)
    # The ghost is the plan, which is shown if it differs from the plant's own motion.
    ghost = not np.array_equal(shown.xs, shown.planned_xs)
    frames = {"": shown.xs, **({GHOST: shown.planned_xs} if ghost else {})}
    count = max(len(shown.xs), len(shown.planned_xs))
    content = {"ghost": GHOST if ghost else "the motion is the plan"}
    yield transform_channel(shown.model, shown.times(count), frames, content)
    yield _diagnostics(shown)
    yield _contacts(shown)
    yield _contact_scene(shown)


def nanoseconds(time: float) -> int:
    """Convert simulated time [s] to log time [ns]."""
    return round(float(time) * 1e9)


def _stamp(stamp: Any, time: float) -> None:
    """Set a protobuf Timestamp or Duration."""
    stamp.seconds, stamp.nanos = divmod(nanoseconds(time), 1_000_000_000)


def state_channel(
    topic: str, times: Array, xs: Array, positions: Sequence[CoordinateTerms], velocities: Sequence[CoordinateTerms]
) -> Channel:
    """Return drake_diff.State of states (n, nx) at `times` (n,) [s], not rounded, with names and units as metadata."""
    kind, nq, parts = TYPES["State"], len(positions), {"q": positions, "v": velocities}
    rows = (
        (nanoseconds(t), kind.cls(time=t, q=x[:nq], v=x[nq:])) for t, x in zip(times.tolist(), xs.tolist(), strict=True)
    )
    return Channel(topic, kind.cls, rows, _column_metadata(parts))


def input_channel(topic: str, times: Array, us: Array, inputs: Sequence[CoordinateTerms]) -> Channel:
    """Return drake_diff.Input of inputs (n, nu) at `times` (n,) [s]."""
    kind = TYPES["Input"]
    rows = ((nanoseconds(t), kind.cls(time=t, u=u)) for t, u in zip(times.tolist(), us.tolist(), strict=True))
    return Channel(topic, kind.cls, rows, _column_metadata({"u": inputs}))


def _column_metadata(parts: Mapping[str, Sequence[CoordinateTerms]]) -> dict[str, Any]:
    units = {piece: {c.name: c.unit for c in coordinates} for piece, coordinates in parts.items()}
    names = {piece: [c.name for c in coordinates] for piece, coordinates in parts.items()}
    return {"units": {"time": "s", **units}, "names": names}


def _joint_states(shown: Shown, topic: str, xs: Array, efforts: Array | None) -> Channel:
    """Return foxglove.JointStates of every joint with one degree of freedom, with efforts of actuated joints."""
    plant, coupling = shown.model.plant, shown.model.coupling
    single = [j for j in joints(plant) if j.num_positions() == 1 and j.num_velocities() == 1]
    driven = {a.joint().index(): i for i, a in enumerate(actuators(plant))}
    places = [
        (j.name(), j.position_start(), plant.num_positions() + j.velocity_start(), driven.get(j.index()))
        for j in single
    ]

    def rows() -> Rows:
        applied = [] if efforts is None else efforts.tolist()
        for k, (t, x) in enumerate(zip(shown.times(len(xs)), xs.tolist(), strict=True)):
            message = JointStates()
            _stamp(message.timestamp, t)
            x = x if coupling is None else coupling.state(np.array(x)).tolist()  # including coupled joints
            for name, position, velocity, actuator in places:
                state = message.joints.add(name=name, position=x[position], velocity=x[velocity])
                if actuator is not None and k < len(applied):
                    state.effort = applied[k][actuator]
            yield nanoseconds(t), message

    units = {"position": "rad or m", "velocity": "rad/s or m/s", "effort": "N m or N"}
    return Channel(topic, JointStates, rows(), {"units": units})


def transform_channel(
    model: Model, times: Array, motions: Mapping[str, Array], more: Mapping[str, str] | None = None
) -> Channel:
    """Return foxglove.FrameTransforms in /tf of the bodies in `motions`, (n, nx) by the prefix of the frames' names."""
    plant = model.plant
    named = [(b, f"{plant.GetModelInstanceName(b.model_instance())}::{b.name()}") for b in bodies(plant)]

    def rows() -> Rows:
        for k, t in enumerate(times):
            message = FrameTransforms()
            for prefix, xs in motions.items():
                for name, p, r in _poses(model, named, xs[k]) if k < len(xs) else []:
                    transform = message.transforms.add(parent_frame_id="world", child_frame_id=prefix + name)
                    _stamp(transform.timestamp, t)
                    transform.translation.x, transform.translation.y, transform.translation.z = p
                    rotation = transform.rotation
                    rotation.w, rotation.x, rotation.y, rotation.z = r
            if message.transforms:
                yield nanoseconds(t), message

    metadata = {"units": {"translation": "m", "rotation": "1"}, **(more or {})}
    return Channel("/tf", FrameTransforms, rows(), metadata)


def _poses(model: Model, named: list[tuple[Any, str]], x: Array) -> list[tuple[str, list[float], list[float]]]:
    """Return name, translation [m] and quaternion of each body; [] for a state without poses (NaN, zero quaternion)."""
    plant, context = model.plant, model.double.context
    try:
        set_state(model.double, x)
        poses = [(name, plant.EvalBodyPoseInWorld(context, body)) for body, name in named]
    except (SimulationError, RuntimeError):
        return []
    return [(n, X.translation().tolist(), X.rotation().ToQuaternion().wxyz().tolist()) for n, X in poses]


def _diagnostics(shown: Shown) -> Channel:
    kind, motion = TYPES["Diagnostics"], shown.motion

    def rows() -> Rows:
        if motion is None:
            return
        columns = {
            "energy_kinetic": motion.kinetic_energy,
            "energy_potential": motion.potential_energy,
            "energy_total": motion.energy,
            "energy_error": motion.energy_error,
            "work_actuators": motion.work,
            "dissipation": motion.dissipation,
            "max_penetration": motion.penetration,
            "constraint_violation": motion.constraint_violation,
            "n_contacts": np.array([*(len(c) for c in motion.contacts), 0]),
        }
        values = zip(*(column.tolist() for column in columns.values()), strict=True)
        for t, row in zip(shown.times(len(motion.xs)), values, strict=True):
            yield nanoseconds(t), kind.cls(**dict(zip(columns, row, strict=True)))

    metadata = {"units": kind.units, "n_contacts": "of the step that begins; 0 at the last state, which begins none"}
    return Channel("/diagnostics", kind.cls, rows(), metadata)


def _steps_in_contact(shown: Shown) -> Iterator[tuple[float, tuple[ContactPoint, ...]]]:
    contacts = () if shown.motion is None else shown.motion.contacts
    return ((t, c) for t, c in zip(shown.times(len(contacts)), contacts, strict=True) if c)


def _contacts(shown: Shown) -> Channel:
    kind = TYPES["Contacts"]

    def columns(contacts: tuple[ContactPoint, ...]) -> dict[str, list[Any]]:
        result: dict[str, list[Any]] = {
            name: [getattr(c, name) for c in contacts] for name in ("body_a", "body_b", "depth", "slip_speed")
        }
        for vector in ("point", "normal", "force"):
            for i, axis in enumerate("xyz"):
                result[vector[0] + axis] = [float(getattr(c, vector)[i]) for c in contacts]
        return result

    rows = ((nanoseconds(t), kind.cls(**columns(c))) for t, c in _steps_in_contact(shown))
    return Channel("/contacts", kind.cls, rows, {"units": kind.units})


def _contact_scene(shown: Shown) -> Channel:
    """Return foxglove.SceneUpdate with an arrow along the force at each contact; the numbers are in /contacts."""

    def rows() -> Rows:
        for t, contacts in _steps_in_contact(shown):
            message = SceneUpdate()
            for i, contact in enumerate(contacts):
                entity = message.entities.add(frame_id="world", id=f"contact {i}")
                _stamp(entity.timestamp, t)
                _stamp(entity.lifetime, shown.time_step)
                _draw_arrow(entity.arrows.add(), contact)
            yield nanoseconds(t), message

    units = {"position": "m", "arrow_length": "m", "arrow_length_per_newton": f"{ARROW_LENGTH_PER_NEWTON} m/N"}
    return Channel("/scene/contacts", SceneUpdate, rows(), {"units": units})


def _draw_arrow(arrow: Any, contact: ContactPoint) -> None:
    """Draw an arrow along +x, rotated to the force by the shortest rotation."""
    size = float(np.linalg.norm(contact.force))
    direction = contact.force / size if size else np.array([1.0, 0.0, 0.0])
    arrow.pose.position.x, arrow.pose.position.y, arrow.pose.position.z = contact.point
    half = np.array([1.0 + direction[0], 0.0, -direction[2], direction[1]])  # 1 + x.d, x cross d
    norm = float(np.linalg.norm(half))
    w, x, y, z = half / norm if norm > 1e-9 else (0.0, 0.0, 0.0, 1.0)
    arrow.pose.orientation.w, arrow.pose.orientation.x = w, x
    arrow.pose.orientation.y, arrow.pose.orientation.z = y, z
    arrow.shaft_length, arrow.shaft_diameter = size * ARROW_LENGTH_PER_NEWTON, 0.01
    arrow.head_length, arrow.head_diameter = 0.03, 0.03
    arrow.color.r, arrow.color.g, arrow.color.b, arrow.color.a = 0.85, 0.2, 0.1, 1.0

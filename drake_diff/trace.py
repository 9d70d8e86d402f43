"""What is in trace.mcap: the motion on the discrete plant and the plan, in simulated time."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from drake_diff.arrays import Array, frozen
from drake_diff.contact import ContactPoint
from drake_diff.exceptions import ArtifactError
from drake_diff.mcap_log import Channel, read_mcap, write_mcap
from drake_diff.mcap_messages import TYPES
from drake_diff.model import Model
from drake_diff.plant_elements import actuators, bodies, joints
from drake_diff.rollout import Rollout
from drake_diff.solution import Solution
from drake_diff.step import set_state

ITERATION_PERIOD = 1_000_000  # [ns] of log time per solver iteration: wall time would make no two files alike
ARROW_LENGTH_PER_NEWTON = 0.02  # [m/N]
MEDIA_TYPES = {".urdf": "application/xml", ".sdf": "application/xml", ".xml": "application/xml"}


@dataclass(frozen=True, eq=False)
class Trace:
    """The numbers of a trace, bit for bit as they were written.

    `xs` (N+1, nx) under `us` (N, nu) is the open-loop motion of the discrete plant, empty where it could not be
    taken; `planned_xs` (N+1, nx) and `planned_us` (N or N+1, nu) are the solver's.
    """

    times: Array
    xs: Array
    us: Array
    planned_xs: Array
    planned_us: Array
    diagnostics: dict[str, Array]
    metadata: dict[str, str]
    attachments: dict[str, bytes]


def write_trace(path: Path, solution: Solution, attachments: Mapping[str, tuple[str, bytes]]) -> None:
    """Write the trace of `solution`; the model file goes in as an attachment of its own."""
    model = solution.problem.model
    metadata = {
        "status": solution.status.value,
        "method": solution.method,
        "model": model.name,
        "time_axis": "simulated; /solver/iterations: 1 ms per iteration",
        "motion": "the discrete plant, open loop"
        if solution.replay is not None
        else "missing: it could not be stepped",
    }
    files = dict(attachments)
    if model.source is not None:
        files[model.source.name] = (
            MEDIA_TYPES.get(model.source.suffix, "application/octet-stream"),
            model.source.read_bytes(),
        )
    write_mcap(path, list(_channels(solution)), metadata, files)


def read_trace(path: str | Path) -> Trace:
    """The numbers in a trace. ArtifactError where the file is damaged or lacks a channel."""
    log = read_mcap(path)
    missing = {"/state", "/input", "/planned/state", "/planned/input", "/diagnostics"} - set(log.messages)
    if missing:
        raise ArtifactError(f"{path}: no channel {', '.join(sorted(missing))}")

    def column(topic: str, *fields: str) -> Array:
        rows = [np.concatenate([np.atleast_1d(getattr(m, f)) for f in fields]) for _, m in log.messages[topic]]
        return frozen(rows)

    names = [field.name for field in TYPES["Diagnostics"].cls.DESCRIPTOR.fields]
    rows = [message for _, message in log.messages["/diagnostics"]]
    return Trace(
        times=column("/planned/state", "time").ravel() if log.messages["/planned/state"] else frozen([]),
        xs=column("/state", "q", "v"),
        us=column("/input", "u"),
        planned_xs=column("/planned/state", "q", "v"),
        planned_us=column("/planned/input", "u"),
        diagnostics={name: frozen([getattr(row, name) for row in rows]) for name in names},
        metadata=log.metadata.get("run", {}),
        attachments=log.attachments,
    )


def _channels(solution: Solution) -> Iterator[Channel]:
    model, motion = solution.problem.model, solution.replay
    times = solution.times
    yield from _motion_channels(model, times, motion)
    yield _states(model, "/planned/state", times, solution.xs)
    yield _inputs(model, "/planned/input", times, solution.inputs_at_knots)
    yield _joint_states(model, "/planned/joint_states", times, solution.xs, None)
    yield _iterations(solution)
    yield _gradient_checks(solution)
    yield _gradient_norms(solution, times)
    level = "info" if solution.success else "error"
    event = TYPES["Event"].cls(level=level, label=solution.status.value, message=solution.message)
    yield Channel("/events", TYPES["Event"].cls, [(nanoseconds(times[-1]), event)])


def _motion_channels(model: Model, times: Array, motion: Rollout | None) -> Iterator[Channel]:
    xs = np.zeros((0, model.nx)) if motion is None else motion.xs
    us = np.zeros((0, model.nu)) if motion is None else motion.us
    yield _states(model, "/state", times, xs)
    yield _inputs(model, "/input", times, us)
    yield _joint_states(model, "/joint_states", times, xs, None if motion is None else motion.efforts)
    yield _transforms(model, times, xs)
    yield _diagnostics(times, motion)
    yield _contacts(times, motion)
    yield _contact_scene(model, times, motion)


def nanoseconds(time: float) -> int:
    """Simulated time [s] as log time [ns]."""
    return round(float(time) * 1e9)


def _states(model: Model, topic: str, times: Array, xs: Array) -> Channel:
    kind, nq = TYPES["State"], model.nq
    rows = [
        (nanoseconds(t), kind.cls(time=float(t), q=x[:nq].tolist(), v=x[nq:].tolist()))
        for t, x in zip(times, xs, strict=False)
    ]
    units = {
        "q": {c.name: c.unit for c in model.contract.positions},
        "v": {c.name: c.unit for c in model.contract.velocities},
    }
    names = {"q": list(model.position_names), "v": list(model.velocity_names)}
    return Channel(topic, kind.cls, rows, {"units": {"time": "s", **units}, "names": names})


def _inputs(model: Model, topic: str, times: Array, us: Array) -> Channel:
    kind = TYPES["Input"]
    rows = [(nanoseconds(t), kind.cls(time=float(t), u=u.tolist())) for t, u in zip(times, us, strict=False)]
    units = {c.name: c.unit for c in model.contract.inputs}
    return Channel(topic, kind.cls, rows, {"units": {"time": "s", "u": units}, "names": {"u": list(model.input_names)}})


def _joint_states(model: Model, topic: str, times: Array, xs: Array, efforts: Array | None) -> Channel:
    """foxglove.JointStates of every joint with one degree of freedom; efforts where an actuator drives it."""
    single = [j for j in joints(model.plant) if j.num_positions() == 1 and j.num_velocities() == 1]
    driven = {a.joint().name(): i for i, a in enumerate(actuators(model.plant))}
    rows = []
    for k, (t, x) in enumerate(zip(times, xs, strict=False)):
        message = JointStates()
        _stamp(message.timestamp, t)
        for joint in single:
            state = message.joints.add(name=joint.name())
            state.position = x[joint.position_start()]
            state.velocity = x[model.nq + joint.velocity_start()]
            if efforts is not None and joint.name() in driven and k < len(efforts):
                state.effort = efforts[k, driven[joint.name()]]
        rows.append((nanoseconds(t), message))
    units = {"position": "rad or m", "velocity": "rad/s or m/s", "effort": "N m or N"}
    return Channel(topic, JointStates, rows, {"units": units})


def _stamp(timestamp: Any, time: float) -> None:
    timestamp.seconds, timestamp.nanos = divmod(nanoseconds(time), 1_000_000_000)


def _transforms(model: Model, times: Array, xs: Array) -> Channel:
    """foxglove.FrameTransforms of every body in the world frame."""
    plant, context = model.plant, model.double.context
    named = [(b, f"{plant.GetModelInstanceName(b.model_instance())}::{b.name()}") for b in bodies(plant)]
    rows = []
    for t, x in zip(times, xs, strict=False):
        set_state(model.double, x)
        message = FrameTransforms()
        for body, name in named:
            transform = message.transforms.add(parent_frame_id="world", child_frame_id=name)
            _stamp(transform.timestamp, t)
            pose = plant.EvalBodyPoseInWorld(context, body)
            p, r = pose.translation(), pose.rotation().ToQuaternion()
            transform.translation.x, transform.translation.y, transform.translation.z = p
            transform.rotation.w, transform.rotation.x = r.w(), r.x()
            transform.rotation.y, transform.rotation.z = r.y(), r.z()
        rows.append((nanoseconds(t), message))
    return Channel("/tf", FrameTransforms, rows, {"units": {"translation": "m", "rotation": "1"}})


def _diagnostics(times: Array, motion: Rollout | None) -> Channel:
    kind, rows = TYPES["Diagnostics"], []
    if motion is not None:
        energy, error = motion.energy, motion.energy_error
        for k, t in enumerate(times):
            message = kind.cls(
                energy_kinetic=motion.kinetic_energy[k],
                energy_potential=motion.potential_energy[k],
                energy_total=energy[k],
                energy_error=error[k],
                work_actuators=motion.work[k],
                dissipation=motion.dissipation[k],
                max_penetration=motion.penetration[k],
                constraint_violation=motion.constraint_violation[k],
                n_contacts=len(motion.contacts[k]) if k < len(motion.contacts) else 0,
            )
            rows.append((nanoseconds(t), message))
    return Channel("/diagnostics", kind.cls, rows, {"units": kind.units})


def _contacts(times: Array, motion: Rollout | None) -> Channel:
    kind = TYPES["Contacts"]
    steps = [] if motion is None else [(t, c) for t, c in zip(times, motion.contacts, strict=False) if c]
    rows = [(nanoseconds(t), kind.cls(**_contact_columns(contacts))) for t, contacts in steps]
    return Channel("/contacts", kind.cls, rows, {"units": kind.units})


def _contact_columns(contacts: tuple[ContactPoint, ...]) -> dict[str, list[Any]]:
    columns: dict[str, list[Any]] = {
        "body_a": [c.body_a for c in contacts],
        "body_b": [c.body_b for c in contacts],
        "depth": [c.depth for c in contacts],
        "slip_speed": [c.slip_speed for c in contacts],
    }
    for letter, vectors in (
        ("p", [c.point for c in contacts]),
        ("n", [c.normal for c in contacts]),
        ("f", [c.force for c in contacts]),
    ):
        for i, axis in enumerate("xyz"):
            columns[letter + axis] = [float(v[i]) for v in vectors]
    return columns


def _contact_scene(model: Model, times: Array, motion: Rollout | None) -> Channel:
    """foxglove.SceneUpdate: an arrow along the force at each contact, for drawing; the numbers are in /contacts."""
    rows = []
    for t, contacts in [] if motion is None else zip(times, motion.contacts, strict=False):
        message = SceneUpdate()
        for i, contact in enumerate(contacts):
            entity = message.entities.add(frame_id="world", id=f"contact {i}")
            _stamp(entity.timestamp, t)
            entity.lifetime.nanos = nanoseconds(model.time_step)
            _draw_arrow(entity.arrows.add(), contact)
        if contacts:
            rows.append((nanoseconds(t), message))
    return Channel("/scene/contacts", SceneUpdate, rows, {"units": {"position": "m", "arrow_length_per_newton": "m/N"}})


def _draw_arrow(arrow: Any, contact: ContactPoint) -> None:
    """An arrow along +x, turned onto the force by the shortest rotation."""
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


def _iterations(solution: Solution) -> Channel:
    kind = TYPES["SolverIteration"]
    rows = [
        (
            rank * ITERATION_PERIOD,
            kind.cls(
                iteration=row.iteration,
                objective=row.objective,
                primal_infeasibility=row.primal_infeasibility,
                dual_infeasibility=row.dual_infeasibility,
                step=row.step,
            ),
        )
        for rank, row in enumerate(solution.iterations)
    ]
    return Channel("/solver/iterations", kind.cls, rows, {"units": kind.units, "time_axis": "1 ms per iteration"})


def _gradient_checks(solution: Solution) -> Channel:
    kind = TYPES["GradientCheck"]
    rows = [
        (
            rank * ITERATION_PERIOD,
            kind.cls(
                subject=c.subject,
                method=c.method,
                verdict=c.verdict,
                entries=int(c.codes.size),
                agreeing=c.count("agree"),
                worst=str(c.worst),
            ),
        )
        for rank, c in enumerate(solution.certificates)
    ]
    return Channel("/gradient/check", kind.cls, rows, {"units": kind.units, "time_axis": "1 ms per certificate"})


def _gradient_norms(solution: Solution, times: Array) -> Channel:
    kind = TYPES["GradientNorm"]
    norms = np.zeros(0) if solution.gradient_norms is None else solution.gradient_norms
    rows = [
        (nanoseconds(t), kind.cls(step=k, norm=float(norm)))
        for k, (t, norm) in enumerate(zip(times, norms, strict=False))
    ]
    return Channel("/gradient/norm", kind.cls, rows, {"units": kind.units})

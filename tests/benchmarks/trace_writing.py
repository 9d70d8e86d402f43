"""A trace of 10,000 steps of a 30-joint plant: written by `write_trace`, and by a plain `mcap` loop.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/trace_writing.py [STEPS]

Three plain loops, each with the `mcap` package's defaults (chunks of 1 MiB, no checksum of the data):
  stored   the very messages of the trace, already made: what our chunks, checksums and merging in time cost
  encoded  the same, encoded to bytes in the loop
  made     joints, frames, states, inputs and diagnostics made in the loop in the obvious way, field by field
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

import drake_diff as dd
from drake_diff.artifact import measure
from drake_diff.artifact.trace import write_trace
from drake_diff.logs.channels import Shown, motion_channels
from drake_diff.logs.mcap_file import Channel, write_mcap
from drake_diff.logs.messages import TYPES
from drake_diff.model.plant import bodies, joints
from drake_diff.model.step import set_state
from drake_diff.motion.rollout import Rollout
from drake_diff.optimize.solution import Solution

JOINTS, TIME_STEP, REPEATS = 30, 1e-3, 3
CLOCK = (
    time.process_time
)  # of this process alone: what else the machine does is no part of it, nor is waiting for the disk

LINK = """<link name="l{i}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
  </inertial></link>
<joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="l{i}"/><origin xyz="0 0 -0.1"/>
  <axis xyz="0 1 0"/><limit effort="100" lower="-9" upper="9" velocity="99"/></joint>
<transmission><type>transmission_interface/SimpleTransmission</type>
  <joint name="j{i}"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>
  <actuator name="m{i}"/></transmission>"""


def motion_of(model: dd.Model, count: int) -> Rollout:
    """Random numbers: what is measured is the writing, and noise compresses worst."""
    random = np.random.default_rng(0)

    def series(*shape: int) -> np.ndarray:
        return random.normal(size=shape)

    us = series(count, model.nu)
    energies = [series(count + 1) for _ in range(8)]
    times = TIME_STEP * np.arange(count + 1)
    return Rollout(times, series(count + 1, model.nx), us, us, *energies, contacts=((),) * count)


def timed(write, *arguments) -> float:
    durations = []
    for _ in range(REPEATS):
        start = CLOCK()
        write(*arguments)
        durations.append(CLOCK() - start)
    return min(durations)


def once(channel: Channel) -> float:
    start = CLOCK()
    for _ in channel.messages:
        pass
    return CLOCK() - start


def plain_writer(file):
    writer = Writer(file)
    writer.start()
    return writer


def register(writer: Writer, topic: str, cls) -> int:
    schema = build_file_descriptor_set(cls).SerializeToString()
    return writer.register_channel(
        topic, "protobuf", writer.register_schema(cls.DESCRIPTOR.full_name, "protobuf", schema)
    )


def stored_loop(path: Path, channels: list[Channel], rows: list) -> None:
    with path.open("wb") as file:
        writer = plain_writer(file)
        ids = [register(writer, c.topic, c.message_class) for c in channels]
        for stamp, channel, data in rows:
            writer.add_message(
                ids[channel], stamp, data if isinstance(data, bytes) else data.SerializeToString(), stamp
            )
        writer.finish()


def made_loop(path: Path, model: dd.Model, motion: Rollout) -> None:
    """The obvious way."""
    plant, context, nq = model.plant, model.double.context, model.nq
    state, inputs, diagnostics = (TYPES[name].cls for name in ("State", "Input", "Diagnostics"))
    with path.open("wb") as file:
        writer = plain_writer(file)
        kinds = {"/joint_states": JointStates, "/tf": FrameTransforms, "/state": state, "/input": inputs}
        kinds |= {"/planned/joint_states": JointStates, "/planned/state": state, "/planned/input": inputs}
        ids = {topic: register(writer, topic, cls) for topic, cls in (kinds | {"/diagnostics": diagnostics}).items()}
        every, links = joints(plant), bodies(plant)
        for k, t in enumerate(motion.times):
            stamp, x = round(t * 1e9), motion.xs[k]

            def put(topic, message, stamp=stamp):
                writer.add_message(ids[topic], stamp, message.SerializeToString(), stamp)

            for topic in ("/joint_states", "/planned/joint_states"):
                message = JointStates()
                message.timestamp.FromNanoseconds(stamp)
                for i, joint in enumerate(every):
                    one = message.joints.add()
                    one.name, one.position = joint.name(), x[joint.position_start()]
                    one.velocity = x[nq + joint.velocity_start()]
                    if topic == "/joint_states" and k < len(motion.us):
                        one.effort = motion.us[k, i]
                put(topic, message)
            set_state(model.double, x)
            message = FrameTransforms()
            for body in links:
                pose = plant.EvalBodyPoseInWorld(context, body)
                p, r = pose.translation(), pose.rotation().ToQuaternion()
                one = message.transforms.add()
                one.timestamp.FromNanoseconds(stamp)
                one.parent_frame_id = "world"
                one.child_frame_id = f"{plant.GetModelInstanceName(body.model_instance())}::{body.name()}"
                one.translation.x, one.translation.y, one.translation.z = p
                one.rotation.w, one.rotation.x, one.rotation.y, one.rotation.z = r.w(), r.x(), r.y(), r.z()
            put("/tf", message)
            for topic in ("/state", "/planned/state"):
                put(topic, state(time=t, q=x[:nq].tolist(), v=x[nq:].tolist()))
            if k < len(motion.us):
                for topic in ("/input", "/planned/input"):
                    put(topic, inputs(time=t, u=motion.us[k].tolist()))
            put("/diagnostics", diagnostics(energy_kinetic=motion.kinetic_energy[k], work_actuators=motion.work[k]))
        writer.finish()


def main(count: int) -> None:
    folder = Path(tempfile.mkdtemp())
    parents = ["world", *(f"l{i}" for i in range(JOINTS))]
    links = "".join(LINK.format(i=i, parent=parents[i]) for i in range(JOINTS))
    (folder / "arm.urdf").write_text(f'<robot name="arm">{links}</robot>')
    model = dd.load_model(folder / "arm.urdf", time_step=TIME_STEP)
    motion = motion_of(model, count)
    problem = dd.Problem(model, x0=np.zeros(model.nx), num_steps=count, final_cost=lambda x: x[0])
    solution = Solution(problem, "shooting", "none", dd.Status.FAILED, "none", motion.xs, motion.us)
    vars(solution).update(replay=motion, replays=())
    measured = measure(solution)  # not timed
    trace, plain, again = folder / "trace.mcap", folder / "plain.mcap", folder / "again.mcap"
    ours = timed(write_trace, trace, measured, {})
    log = dd.logs.read_mcap(trace)
    channels = [Channel(topic, log.message_types[topic], rows) for topic, rows in log.messages.items()]
    rows = [(t, i, m) for i, c in enumerate(channels) for t, m in c.messages]
    rows.sort(key=lambda row: row[0])
    ours_stored = timed(write_mcap, again, channels, {}, {})
    encoded = timed(stored_loop, plain, channels, rows)
    stored = timed(stored_loop, plain, channels, [(t, i, m.SerializeToString()) for t, i, m in rows])
    made = timed(made_loop, plain, model, motion)
    start = CLOCK()
    found = dd.read_trace(trace)
    reading = CLOCK() - start
    equal = all(
        a.tobytes() == b.tobytes()
        for a, b in ((found.xs, motion.xs), (found.us, motion.us), (found.planned_xs, motion.xs))
    )
    size = trace.stat().st_size
    print(f"{count} steps of {JOINTS} joints, {len(rows)} messages; read back bit for bit: {equal}")
    print(f"write_trace, messages made and written    {ours:6.2f} s  {len(rows) / ours:8.0f} messages/s")
    print(f"plain loop, messages made and written     {made:6.2f} s  ours is {ours / made:.2f} times that")
    print(f"write_mcap, messages given                {ours_stored:6.2f} s")
    print(f"plain loop, messages given                {encoded:6.2f} s  ours is {ours_stored / encoded:.2f} times that")
    print(f"plain loop, bytes given                   {stored:6.2f} s  ours is {ours_stored / stored:.2f} times that")
    print(f"read_trace, every checksum                {reading:6.2f} s")
    print(
        f"{size} bytes, {size / (count * TIME_STEP):.0f} bytes per second of motion, {size / len(rows):.0f} per message"
    )
    shown = Shown(model, TIME_STEP, motion.xs, motion)
    for channel in motion_channels(shown):
        print(f"  making {channel.topic:<24}{once(channel):6.2f} s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)

"""Check that an exported bag, read by another library than its writer, has the same numbers."""

import sys

import numpy as np
import pytest
from helpers.engines import needs

import drake_diff as dd
from drake_diff.exceptions import ArtifactError, InputError, MissingDependencyError
from drake_diff.logs import read_mcap
from drake_diff.runs import read_trace
from drake_diff.runs.trace import export_ros2

needs("rosbags")


@pytest.fixture(scope="module")
def run(pushed):
    return pushed[2]


@pytest.fixture(scope="module")
def bag(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags") / "bag"
    export_ros2(run, folder)
    return folder


def messages(bag, topic):
    """Return times [ns] and messages from the `mcap` project's ROS 2 decoder, with all checksums checked."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with (bag / "bag.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(m.message.log_time, m.decoded_message) for m in reader.iter_decoded_messages(topics=[topic])]


@pytest.mark.solve
def test_joint_states_are_the_trace_s_bit_for_bit(run, bag):
    trace, found = read_trace(run / "trace.mcap"), messages(bag, "/joint_states")
    assert [t for t, _ in found] == [20_000_000 * k for k in range(11)]
    assert [list(m.name) for _, m in found] == [["slide", "hinge"]] * 11
    xs = np.array([[*m.position, *m.velocity] for _, m in found])
    assert xs.tobytes() == trace.xs.tobytes()
    efforts = np.array([m.effort for _, m in found[:-1]])
    assert efforts[:, 0].tobytes() == trace.us[:, 0].tobytes()
    assert np.isnan(efforts[:, 1]).all()  # the hinge has no actuator
    assert list(found[-1][1].effort) == []  # the last state has no step
    assert (found[3][1].header.stamp.sec, found[3][1].header.stamp.nanosec) == (0, 60_000_000)


def test_frames_inputs_and_diagnostics_are_the_trace_s(run, bag):
    log = read_mcap(run / "trace.mcap")
    for (_, ours), (_, theirs) in zip(log.messages["/tf"], messages(bag, "/tf"), strict=True):
        for a, b in zip(ours.transforms, theirs.transforms, strict=True):
            assert (b.header.frame_id, b.child_frame_id) == ("world", a.child_frame_id)
            for part, axes in (("translation", "xyz"), ("rotation", "wxyz")):
                for axis in axes:
                    assert getattr(getattr(a, part), axis) == getattr(getattr(b.transform, part), axis)
    inputs = messages(bag, "/input")
    assert [list(m.data) for _, m in inputs] == log.arrays("/input")["u"].tolist()
    assert inputs[0][1].layout.dim[0].label == "force"
    energies = log.arrays("/diagnostics")["energy_total"]
    for energy, (_, m) in zip(energies, messages(bag, "/diagnostics"), strict=True):
        assert float({v.key: v.value for v in m.status[0].values}["energy_total [J]"]) == energy


@pytest.mark.solve
def test_contacts_and_events_are_the_trace_s(load, tmp_path):
    """The hopper stands on its foot."""
    from drake_diff.runs import measure
    from drake_diff.runs.trace import write_trace

    model = load("hopper.sdf", time_step=0.005)
    x0 = model.default_state
    problem = dd.Problem(model, x0=x0, num_steps=3, final_cost=lambda x: x[0] ** 2)
    motion = dd.rollout(model, x0, np.zeros((3, model.nu)))
    solution = dd.Solution(problem, "shooting", "none", dd.Status.CONVERGED, "by hand", motion.xs, motion.us)
    write_trace(tmp_path / "trace.mcap", measure(solution), {})
    export_ros2(tmp_path, tmp_path / "bag")
    log = read_mcap(tmp_path / "trace.mcap").messages
    found = messages(tmp_path / "bag", "/contacts")
    assert len(found) == len(log["/contacts"]) == 3
    for (time, ours), (at, theirs) in zip(log["/contacts"], found, strict=True):
        assert at == time
        assert [x.name for x in theirs.status] == [f"{a} on {b}" for a, b in zip(ours.body_a, ours.body_b, strict=True)]
        for i, status in enumerate(theirs.status):
            values = {v.key: float(v.value) for v in status.values}
            units = {"depth": "m", "slip_speed": "m/s", "px": "m", "nz": "1", "fx": "N", "fz": "N"}
            for name, unit in units.items():
                assert values[f"{name} [{unit}]"] == getattr(ours, name)[i]
    assert max(ours.fz[0] for _, ours in log["/contacts"]) > 0
    events = messages(tmp_path / "bag", "/events")
    assert [m.msg for _, m in events] == [e.message for _, e in log["/events"]]
    assert [m.level for _, m in events] == [40 if e.kind == "failure" else 20 for _, e in log["/events"]]


def test_rosbags_reads_the_whole_bag_with_its_metadata(bag):
    from rosbags.rosbag2 import Reader

    with Reader(bag) as reader:
        assert {c.topic: (c.msgtype, c.msgcount) for c in reader.connections} == {
            "/joint_states": ("sensor_msgs/msg/JointState", 11),
            "/planned/joint_states": ("sensor_msgs/msg/JointState", 11),
            "/tf": ("tf2_msgs/msg/TFMessage", 11),
            "/input": ("std_msgs/msg/Float64MultiArray", 10),
            "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", 11),
            "/contacts": ("diagnostic_msgs/msg/DiagnosticArray", 0),
            "/events": ("rcl_interfaces/msg/Log", 2),
        }
        assert len(list(reader.messages())) == 56


def test_what_exists_is_not_written_over_and_what_is_no_run_is_refused(run, bag, tmp_path):
    with pytest.raises(InputError, match="OUT: expected a new directory"):
        export_ros2(run, bag)
    with pytest.raises(ArtifactError, match=r"trace\.mcap"):
        export_ros2(tmp_path, tmp_path / "bag")
    damaged = bytearray((run / "trace.mcap").read_bytes())
    damaged[1000] ^= 1
    (tmp_path / "trace.mcap").write_bytes(damaged)
    with pytest.raises(ArtifactError, match="checksum"):
        export_ros2(tmp_path, tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_without_rosbags_it_says_what_to_install(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'drake-diff\[ros2\]'"):
        export_ros2(run, tmp_path / "bag")

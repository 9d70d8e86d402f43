"""Check recorded motions: reading from all file types, comparison step by step, and the law that they imply."""

import gzip
import json
import sqlite3
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from helpers.engines import engine_of, needs
from helpers.followers import followed
from helpers.models import MODELS
from helpers.table import each_row
from helpers.two_bases import two_bases
from pydrake.math import RollPitchYaw

import drake_diff as dd
from drake_diff.comparison import read_recording
from drake_diff.comparison.attribution import move
from drake_diff.engines.formats import mjcf
from drake_diff.exceptions import ArtifactError, InputError, ShapeError
from drake_diff.logs.mcap_file import raw_messages

pytestmark = pytest.mark.solve

H = 0.01
INPUTS = 2 * np.sin(np.arange(40))[:, None]


def record(engine, x0, us, *, every=1, h=H, name="recorded", **facts):
    """Record the engine's motion, with every `every`-th state."""
    motion = move(engine, np.array(x0, dtype=float), np.repeat(us, every, axis=0))
    return dd.Recording(name, "1", h * np.arange(len(us) + 1), motion.xs[::every], us, facts)


def compared(model, recording, **options):
    return dd.compare(model, (), recordings=(recording,), **options).engines[-1]


def write_csv(path, header, rows):
    path.write_text("\n".join(",".join(map(str, row)) for row in [header, *rows]) + "\n")
    return path


# ---- comparison --------------------------------------------------------------------------------------------------


def test_a_recording_of_the_same_model_is_the_same_and_has_no_jacobians(load):
    needs("mujoco")
    model = load("cart_pole.urdf")
    mujoco = engine_of("mujoco", model)
    found = dd.compare(model, ("numpy",), recordings=(record(mujoco, [0, 0.7, 0, 0], INPUTS),))
    numpy, e = found.engines[1:]
    np.testing.assert_array_equal(found.x0, [0, 0.7, 0, 0])  # the recording's x0 is used by all engines
    np.testing.assert_array_equal(found.us, INPUTS)
    np.testing.assert_allclose(numpy.motion.xs, e.motion.xs, atol=1e-10)  # 40 steps, each accurate to rounding
    assert (e.engine, e.verdict, e.first_apart, e.gradient) == ("recorded", "same", None, "none")
    assert e.step_gaps.max() < 1e-13
    assert (len(e.jacobians), e.rollout_jacobian, e.seconds_per_step) == (0, None, None)
    assert e.motion.energy is not None  # Drake computes the energy of the recorded states
    assert "Jacobian" not in e.sentence


def test_the_reference_takes_as_many_steps_as_lie_between_samples(load):
    model = load("pendulum.urdf")
    drake = engine_of("drake", model)
    e = compared(model, record(drake, [0.5, 0], INPUTS[:10], every=5, h=5 * H))
    assert (e.verdict, e.step_gaps.max(), len(e.step_gaps)) == ("same", 0.0, 10)
    assert e.final_gap == 0.0
    late = record(drake, [0.5, 0], INPUTS[:10])
    late = dd.Recording("late", "1", late.times + 7, late.xs, late.us)
    assert compared(model, late).motion.times[0] == 0.0  # the times start at 0 for all engines
    for period in (1.5 * H, 0.5 * H):
        with pytest.raises(InputError, match=rf"0\.01 s, got {period:g}"):
            compared(model, record(drake, [0.5, 0], INPUTS[:10], h=period))
    dropped = dd.Recording("dropped", "1", np.delete(late.times, 4), np.delete(late.xs, 4, axis=0), late.us[:-1])
    with pytest.raises(InputError, match=r"from sample 3 to 4: expected 0\.01 s throughout.* got 0\.02"):
        compared(model, dropped)


def damped_cart_pole(tmp_path, damping):
    text = (MODELS / "cart_pole.urdf").read_text()
    path = tmp_path / f"cart_pole_{damping}.urdf"
    path.write_text(text.replace('<axis xyz="1 0 0"/>', f'<axis xyz="1 0 0"/><dynamics damping="{damping}"/>'))
    return dd.load_model(path, time_step=H)


def explicit_damping(model, tmp_path):
    """Return the MuJoCo engine without `eulerdamp`."""
    path = tmp_path / "explicit.xml"
    text = mjcf(engine_of("mujoco", model).description, model.time_step)
    path.write_text(text.replace('warmstart="disable"', 'warmstart="disable" eulerdamp="disable"'))
    return engine_of("mujoco", model, path=path)


@pytest.mark.slow
def test_explicit_joint_damping_is_another_law_and_half_of_the_time_step_is_unexplained(tmp_path):
    """Searching for the smallest change of the model that explains a recording is left to `dd.explain`."""
    model, x0 = damped_cart_pole(tmp_path, 0.4), [0, 0.7, 0.3, -0.2]
    e = compared(model, record(explicit_damping(model, tmp_path), x0, INPUTS))
    told = "as if joint damping were explicit"
    assert (e.verdict, e.first.as_if, e.largest.as_if) == ("other law", told, told)
    assert (e.first.responsible, e.largest.responsible) == ("integrator", "integrator")
    assert told in e.sentence
    e = compared(model, record(engine_of("drake", model.at_time_step(H / 2)), x0, INPUTS, every=2))
    assert (e.verdict, e.largest.responsible) == ("unexplained", "unexplained")


def test_mujoco_s_turn_of_a_free_body_is_named(load):
    needs("mujoco")
    model = load("projectile.sdf")
    x0 = [1.0, 0, 0, 0, 0, 0, 5, 3, -2, 4, 1, 0, 2]
    e = compared(model, record(engine_of("mujoco", model), x0, np.zeros((20, 0))))
    assert (e.verdict, e.first.as_if) == ("other law", "as if rotations were by the exponential")


def test_what_no_single_change_takes_is_unexplained(load):
    """The changes are a push of 1e-3 on every state, and a gravity with a different size but the same direction."""
    model = load("pendulum.urdf")
    recording = record(engine_of("drake", model), [0.5, 0], INPUTS)
    pushed = dd.Recording("pushed", "1", recording.times, recording.xs + 1e-3 * np.arange(41)[:, None], INPUTS)
    e = compared(model, pushed)
    assert (e.verdict, e.largest.responsible, e.largest.as_if) == ("unexplained", "unexplained", "")
    moon = engine_of("drake", dd.load_model(model.source, time_step=H, gravity=[0, 0, -1.62]))
    e = compared(model, record(moon, [0.5, 0], INPUTS))
    assert (e.verdict, e.largest.responsible, e.largest.as_if) == ("unexplained", "unexplained", "")


def test_a_deviation_of_a_model_with_reduced_mimic_joints_is_unexplained(tmp_path):
    model = followed(tmp_path)
    motion = dd.rollout(model, [0.1, 0.0], INPUTS)
    pushed = dd.Recording("pushed", "1", H * np.arange(41), motion.xs + 1e-3 * np.arange(41)[:, None], INPUTS)
    e = compared(model, pushed)
    assert (e.verdict, e.largest.responsible) == ("unexplained", "unexplained")


def test_contact_is_the_contact_law_s_and_a_told_law_explains_it(load):
    needs("mujoco")
    model = load("sphere_on_ground.sdf")
    x0 = np.array(model.default_state)
    x0[6] = 0.15
    recording = record(engine_of("mujoco", model), x0, np.zeros((30, 0)))
    e = compared(model, recording)
    assert (e.verdict, e.largest.responsible) == ("unexplained", "contact law")  # the recording has no fact on the law
    told = {"contact law": "soft constraint, elliptic cone"}
    e = compared(model, dd.Recording("told", "1", recording.times, recording.xs, recording.us, told))
    assert (e.verdict, [line.quantity for line in e.told]) == ("other law", ["contact law"])


def test_facts_are_lines_of_the_contract_and_nothing_else_is_known(load):
    model = load("pendulum.urdf")
    drake = engine_of("drake", model)
    facts = {"time step": "0.01", "gravity": "[0, 0, -9.81]", "integrator": "RK4", "seeds": "[7]"}
    lines = {x.quantity: x for x in compared(model, record(drake, [0.5, 0], INPUTS, **facts)).lines}
    verdicts = {quantity: lines[quantity].verdict for quantity in facts}
    assert verdicts == {"time step": "equal", "gravity": "equal", "integrator": "different", "seeds": "mapped"}
    assert lines["mass"].verdict == lines["contact law"].verdict == lines["reset distribution"].verdict == "different"
    assert lines["mass"].reason == "the recording does not say"
    flipped = compared(model, record(drake, [0.5, 0], INPUTS, gravity="[0, 0, 9.81]"))
    assert (flipped.verdict, [x.quantity for x in flipped.broken]) == ("other model", ["gravity"])
    for wrong in ({"gravity": "9.81"}, {"time step": "fast"}, {"precision": "half"}, {"mass": "1"}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            compared(model, record(drake, [0.5, 0], INPUTS, **wrong))
    rounded = record(drake, [0.5, 0], INPUTS, precision="float32")
    rounded = dd.Recording("r", "1", rounded.times, rounded.xs.astype(np.float32), INPUTS, rounded.facts)
    assert compared(model, rounded).verdict == "same"
    strict = dd.Recording("r", "1", rounded.times, rounded.xs, INPUTS)
    assert compared(model, strict).verdict == "unexplained"  # precision is not guessed from the numbers


def test_a_recording_by_hand_is_checked_too(load):
    model = load("projectile.sdf")
    good = record(engine_of("drake", model), model.default_state, np.zeros((3, 0)))
    bad = np.array(good.xs)
    bad[:, :4] = [0.5, 0.5, 0, 0]
    with pytest.raises(InputError, match="norm of"):
        compared(model, dd.Recording("r", "1", good.times, bad, good.us))
    with pytest.raises(InputError, match="sample 2"):
        compared(model, dd.Recording("r", "1", np.array([0, 0.01, 0.01, 0.02]), good.xs, good.us))
    with pytest.raises(InputError, match=r"xs: .* at sample 0: expected at most 1e\+12"):
        compared(model, dd.Recording("r", "1", good.times, np.where(np.eye(4, 13, k=5), 1e300, good.xs), good.us))
    with pytest.raises(ShapeError, match=r"\(4, 13\)"):
        compared(model, dd.Recording("r", "1", good.times, good.xs[:, :7], good.us))


# ---- CSV ---------------------------------------------------------------------------------------------------------

HEADER = ["time", "slide_x", "position.hinge", "slide_v", "velocity.hinge", "force"]
ROWS = [[0, 0.1, 0.2, 0.3, 0.4, 1.5], [0.01, 1.1, 1.2, 1.3, 1.4, 2.5], [0.02, 2.1, 2.2, 2.3, 2.4, ""]]


def test_csv_columns_are_found_by_name(load, tmp_path):
    model = load("cart_pole.urdf")
    plain = read_recording(write_csv(tmp_path / "run.csv", HEADER, ROWS), model)
    order = [5, 4, 0, 2, 1, 3]
    turned = [[row[i] for i in order] for row in [HEADER, *ROWS]]
    other = read_recording(write_csv(tmp_path / "turned.csv", turned[0], turned[1:]), model, name="turned")
    for recording in (plain, other):
        np.testing.assert_array_equal(recording.times, [0, 0.01, 0.02])
        np.testing.assert_array_equal(recording.xs, [row[1:5] for row in ROWS])
        np.testing.assert_array_equal(recording.us, [[1.5], [2.5]])
    assert (plain.name, plain.version, other.name) == ("run", "(version unknown)", "turned")
    told = {"engine": "isaaclab", "version": "3.0.0", "time step": 0.01, "gravity": [0, 0, -9.81], "seeds": [1, 2]}
    (tmp_path / "run.contract.json").write_text(json.dumps(told))
    plain = read_recording(tmp_path / "run.csv", model)
    assert (plain.name, plain.version, plain.facts["time step"]) == ("isaaclab", "3.0.0", "0.01")


def changed(row, column, value):
    rows = [list(r) for r in ROWS]
    rows[row][column] = value
    return rows


@each_row(
    "header, rows, match",
    [
        (HEADER, changed(1, 2, "nan"), r"line 3, column hinge_q: expected a finite number, got 'nan'"),
        (HEADER, changed(1, 2, "1.2.3"), r"line 3, column hinge_q: .* got '1\.2\.3'"),
        (HEADER, changed(0, 5, ""), r"line 2, column force"),
        (HEADER, changed(2, 0, 0.01), r"line 4, column time: expected more than 0\.01"),
        (HEADER[:4] + HEADER[5:], [r[:4] + r[5:] for r in ROWS], r"column hinge_w: expected a column, got only time"),
        ([*HEADER[:5], "frce"], ROWS, r"column: expected one of .*force.*, got 'frce'"),
        ([*HEADER[:5], "slide_x"], ROWS, r"column slide_x: expected once, got twice"),
        (HEADER, [*ROWS[:2], ROWS[2][:3]], r"line 4: expected 6, got 3 cells"),
        (HEADER, ROWS[:1], r"expected 2 or more"),
    ],
)
def test_a_bad_csv_is_named_by_line_and_column(load, tmp_path, header, rows, match):
    with pytest.raises(InputError, match=match):
        read_recording(write_csv(tmp_path / "bad.csv", header, rows), load("cart_pole.urdf"))


TEXT = "\n".join(",".join(map(str, row)) for row in [HEADER, *ROWS]) + "\n"


@each_row(
    "data, match",
    [
        (TEXT.encode("utf-16"), "got text in UTF-16"),
        (gzip.compress(TEXT.encode()), "got a gzip file"),
        (TEXT.replace("1.4", "\u00e9").encode("latin-1"), r"line 3, byte 18: expected text in UTF-8, got 0xe9"),
        (f"{TEXT[:-1]}{'0' * 2_000_000}\n".encode(), r"line 4: expected at most 1048576 characters"),
        (f"{TEXT[:-1]}{'0' * 200_000}\n".encode(), r"line 4: expected a row of a CSV file, got field larger"),
        (TEXT.replace("1.4", "1e308").encode(), r"line 3, column hinge_w: expected a number of at most 1e\+12"),
        (TEXT.replace("0.02,", "1e308,").encode(), r"line 4, column time: expected a number of at most 1e\+12"),
        (TEXT.replace("time", "x" * 100_000).encode(), r"line 1, column: expected one of .*, got 'x{80}'$"),
    ],
)
def test_bytes_that_are_no_csv_are_named_by_line(load, tmp_path, data, match):
    (tmp_path / "bad.csv").write_bytes(data)
    for gaps in (False, True):
        with pytest.raises(InputError, match=match):
            read_recording(tmp_path / "bad.csv", load("cart_pole.urdf"), gaps=gaps)


def test_what_a_parser_raises_is_an_error_that_names_the_file(load, tmp_path, monkeypatch):
    def takes_too_much(*_):
        return bytes(2**31)

    def fails(*_):
        raise RecursionError("too deep")

    write_csv(tmp_path / "run.csv", HEADER, ROWS)
    ends = {
        takes_too_much: r"csv: reading it takes more than 1 GiB",
        fails: r"not a complete \.csv file: RecursionError",
    }
    for parser, match in ends.items():
        monkeypatch.setattr("drake_diff.comparison.recordings._read_csv", parser)
        with pytest.raises(ArtifactError, match=match):
            read_recording(tmp_path / "run.csv", load("cart_pole.urdf"))


def test_what_is_no_recording_is_refused(load, tmp_path):
    model = load("cart_pole.urdf")
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "run.txt").write_text("1")
    (tmp_path / "junk.mcap").write_bytes(b"junk")
    for name, error in (
        ("empty.csv", InputError),
        ("run.txt", InputError),
        ("none.csv", InputError),
    ):
        with pytest.raises(error, match=name):
            read_recording(tmp_path / name, model)
    with pytest.raises(ArtifactError, match=r"junk\.mcap"):
        read_recording(tmp_path / "junk.mcap", model)
    write_csv(tmp_path / "run.csv", HEADER, ROWS)
    for text, match in (("{", "JSON object"), ("[]", "JSON object"), ('{"color": "red"}', "color")):
        (tmp_path / "run.contract.json").write_text(text)
        with pytest.raises(InputError, match=match):
            read_recording(tmp_path / "run.csv", model)


# ---- MCAP of this project, and ROS 2 -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(pushed):
    return pushed


def test_our_own_trace_is_a_recording_to_the_bit(run, load):
    model, motion, folder = run
    found = read_recording(folder / "trace.mcap", model)
    assert found.xs.tobytes() == motion.xs.tobytes()
    assert found.us.tobytes() == motion.us.tobytes()
    assert compared(model, found).step_gaps.max() == 0
    with pytest.raises(InputError, match="names of q in /state"):
        read_recording(folder / "trace.mcap", load("pendulum.urdf"))


def test_the_exported_bag_is_a_recording_to_the_bit(run, tmp_path):
    pytest.importorskip("rosbags", reason="no rosbags (the extra `ros2`)")
    from drake_diff.runs.trace import export_ros2

    model, motion, folder = run
    export_ros2(folder, tmp_path / "bag")
    for path in (tmp_path / "bag", tmp_path / "bag" / "bag.mcap"):
        found = read_recording(path, model)
        assert found.xs.tobytes() == motion.xs.tobytes()
        assert found.us.tobytes() == motion.us.tobytes()
        assert compared(model, found).verdict == "same"


def test_a_damaged_bag_is_no_recording(run, tmp_path):
    pytest.importorskip("rosbags", reason="no rosbags (the extra `ros2`)")
    from drake_diff.runs.trace import export_ros2

    model, _, folder = run
    export_ros2(folder, tmp_path / "bag")
    file = tmp_path / "bag" / "bag.mcap"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    for path in (file, tmp_path / "bag"):
        with pytest.raises(ArtifactError):
            read_recording(path, model)


def test_rows_and_records_without_end_are_refused(load, tmp_path):
    pytest.importorskip("rosbags", reason="no rosbags (the extra `ros2`)")
    (tmp_path / "bag").mkdir()
    with sqlite3.connect(tmp_path / "bag" / "bag.db3") as base:
        numbers = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT i FROM n"
        base.execute(f"CREATE VIEW messages AS {numbers}")
    with pytest.raises(ArtifactError, match=r"bag\.db3: expected only tables of messages, got 1 views and triggers"):
        read_recording(tmp_path / "bag", load("pendulum.urdf"))
    zeros = bytes(9 * 10)  # ten records of opcode 0 without length: mcap reads 33 million of them in a minute
    chunk = struct.pack("<QQQIIQ", 0, 0, len(zeros), zlib.crc32(zeros), 0, len(zeros)) + zeros
    with pytest.raises(ValueError, match="opcode 0"):
        raw_messages(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(chunk)) + chunk, "cdr")


def bag_of(path, messages):
    """Write a bag of (topic, type, header frame, stamp [ns], fields) with rosbags."""
    pytest.importorskip("rosbags", reason="no rosbags (the extra `ros2`)")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        open_topics = {}
        for topic, kind, frame, stamp, fields in messages:
            if topic not in open_topics:
                open_topics[topic] = bag.add_connection(topic, kind, typestore=store)
            time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
            header = store.types["std_msgs/msg/Header"](time, frame)
            message = store.types[kind](header=header, **fields(store.types))
            bag.write(open_topics[topic], stamp, store.serialize_cdr(message, kind))
    return path


def vector(types, kind, values):
    return types[f"geometry_msgs/msg/{kind}"](**dict(zip("xyzw", map(float, values), strict=False)))


def pose(types, x):
    w, *xyz = x[:4]
    return types["geometry_msgs/msg/Pose"](
        position=vector(types, "Point", x[4:7]), orientation=vector(types, "Quaternion", [*xyz, w])
    )


def twist(types, linear, angular):
    return types["geometry_msgs/msg/Twist"](
        linear=vector(types, "Vector3", linear), angular=vector(types, "Vector3", angular)
    )


def odometry(types, x, R):
    """Return the fields as REP 105 defines them: the twist in the child frame, and the quaternion as x y z w."""
    covariance = np.zeros(36)
    return {
        "child_frame_id": "ball",
        "pose": types["geometry_msgs/msg/PoseWithCovariance"](pose=pose(types, x), covariance=covariance),
        "twist": types["geometry_msgs/msg/TwistWithCovariance"](
            twist=twist(types, R.T @ x[10:13], R.T @ x[7:10]), covariance=covariance
        ),
    }


STAMP = 1_700_000_000_000_000_000
TURNED = RollPitchYaw(0.3, -0.8, 1.9).ToRotationMatrix()
BALL = np.array([*TURNED.ToQuaternion().wxyz(), 1, 2, 3, 0.4, -0.5, 0.6, 7, 8, -9.0])


def ball_bag(path, parts):
    """Write a bag of a ball's flight from Drake, with messages for each state and present-day time stamps."""
    model = dd.load_model(MODELS / "projectile.sdf", time_step=H)
    xs = dd.rollout(model, BALL, num_steps=5).xs
    rows = [part(STAMP + 10_000_000 * k, x) for k, x in enumerate(xs) for part in parts]
    return model, xs, bag_of(path, rows)


def rotation_of(x):
    from drake_diff.mechanics.coordinates import rotation

    return rotation(x[:4])


def test_odometry_s_frames_and_quaternion_are_mapped(tmp_path):
    """The twist is rotated from the child frame, and w moves to the front. With an error in either, no step agrees."""
    part = lambda t, x: ("/odom", "nav_msgs/msg/Odometry", "world", t, lambda y: odometry(y, x, rotation_of(x)))  # noqa: E731
    model, xs, path = ball_bag(tmp_path / "bag", [part])
    found = read_recording(path, model)
    np.testing.assert_allclose(found.xs[0], BALL, atol=1e-14)  # by hand, with Drake's rotation
    np.testing.assert_allclose(found.xs, xs, atol=1e-14)
    np.testing.assert_allclose(found.times, H * np.arange(6), atol=1e-9)  # times start at 0 and are accurate to 1 ns
    assert compared(model, found).verdict == "same"
    swapped = np.array(found.xs)
    swapped[:, :4] = np.roll(found.xs[:, :4], -1, axis=1)  # the order x y z w
    as_child = np.array(found.xs)
    as_child[:, 7:10] = found.xs[:, 7:10] @ TURNED.matrix()
    for wrong in (swapped, as_child):
        e = compared(model, dd.Recording("wrong", "1", found.times, wrong, found.us))
        assert e.verdict == "unexplained"


@pytest.mark.parametrize("frame", ["world", "ball"])
def test_pose_and_twist_say_their_frame(tmp_path, frame):
    def velocity(types, x):
        R = rotation_of(x).T if frame == "ball" else np.eye(3)
        return {"twist": twist(types, R @ x[10:13], R @ x[7:10])}

    def poses(t, x):
        return "/pose", "geometry_msgs/msg/PoseStamped", "world", t, lambda types: {"pose": pose(types, x)}

    def twists(t, x):
        return "/twist", "geometry_msgs/msg/TwistStamped", frame, t, lambda types: velocity(types, x)

    model, xs, path = ball_bag(tmp_path / "bag", [poses, twists])
    np.testing.assert_allclose(read_recording(path, model).xs, xs, atol=1e-14)
    unknown = lambda t, x: (*twists(t, x)[:2], "camera", *twists(t, x)[3:])  # noqa: E731
    _, _, path = ball_bag(tmp_path / "camera", [poses, unknown])
    with pytest.raises(
        InputError, match=r"frame_id of TwistStamped: expected the frame of the pose, 'world'.*got 'camera'"
    ):
        read_recording(path, model)


# ---- several free bodies -----------------------------------------------------------------------------------------


def two_in_mujoco(model, *, fine=1, count=30):
    """Record two thrown and rotating bodies with driven arms, from MuJoCo with steps of H / fine."""
    random = np.random.default_rng(0)
    x0 = np.array(model.default_state)
    x0[16:] = 0.3 * random.standard_normal(14)
    us = 0.5 * random.standard_normal((count // 10, 2)).repeat(10, axis=0)
    engine = engine_of("mujoco", model, time_step=H / fine)
    xs = move(engine, x0, us.repeat(fine, axis=0)).xs[::fine]
    return dd.Recording("mujoco", "1", H * np.arange(count + 1), xs, us)


def csv_of(path, model, r):
    us = [*r.us.tolist(), [""] * model.nu]
    rows = [[repr(float(t)), *map(repr, map(float, x)), *u] for t, x, u in zip(r.times, r.xs, us, strict=True)]
    return write_csv(path, ["time", *model.state_names, *model.input_names], rows)


def test_a_recording_of_two_free_bodies_is_compared_and_the_wrong_mass_is_seen(tmp_path):
    """The recording is from MuJoCo, which differs from the right model only in its rotation of free bodies."""
    needs("mujoco")
    model = two_bases(tmp_path)
    right = csv_of(tmp_path / "right.csv", model, two_in_mujoco(model))
    e = compared(model, read_recording(right, model))
    assert (e.verdict, e.first.as_if) == ("other law", "as if rotations were by the exponential")
    wrong = csv_of(tmp_path / "wrong.csv", model, two_in_mujoco(two_bases(tmp_path, 0.65)))
    e = compared(model, read_recording(wrong, model))
    assert e.verdict == "unexplained"
    assert e.step_gaps.max() > 1e-4  # 30 % of an arm's mass, whereas the rotation law gives 1e-7


def two_bag(path, model, xs, names):
    """Write a bag of joint states and each body's odometry, with topics and child frames from `names`."""
    rows = []
    for k, x in enumerate(xs):
        t = STAMP + 10_000_000 * k
        state = joints(["right_turn", "left_turn"], x[[15, 7]], x[[29, 22]], [0.2, 0.1])
        rows.append(("/joint_states", "sensor_msgs/msg/JointState", "", t, state))
        for (topic, frame), i, j in zip(names, (8, 0), (23, 16), strict=True):  # the right body is first
            body = np.concatenate([x[i : i + 7], x[j : j + 6]])
            made = lambda types, body=body, frame=frame: {  # noqa: E731
                **odometry(types, body, rotation_of(body)),
                "child_frame_id": frame,
            }
            rows.append((topic, "nav_msgs/msg/Odometry", "world", t, made))
    return bag_of(path, rows)


@each_row(
    "names, match",
    [
        ([("/odom", "right_body"), ("/odom", "left_body")], ""),  # one topic, with two frames
        ([("/a", "/right_body"), ("/b", "left_body")], ""),
        ([("/right_body/odom", "base_link"), ("/left_body/odom", "base_link")], ""),  # separate topics
        ([("/a", "base_link"), ("/b", "left_body")], r"Odometry of the free body right_body: .*/b \(of left_body\)"),
        ([("/a", "left_body"), ("/b", "left_body")], r"Odometry of the free body left_body"),
    ],
)
def test_the_odometry_of_two_bodies_is_told_apart(tmp_path, names, match):
    model = two_bases(tmp_path)
    xs = two_in_mujoco(model, count=10).xs
    path = two_bag(tmp_path / "bag", model, xs, names)
    if match:
        with pytest.raises(InputError, match=match):
            read_recording(path, model)
        return
    found = read_recording(path, model)
    np.testing.assert_allclose(found.xs, xs, atol=1e-14)
    np.testing.assert_array_equal(found.us, np.tile([0.1, 0.2], (10, 1)))


def test_a_body_that_is_missing_at_one_time_is_named(tmp_path):
    model = two_bases(tmp_path)
    xs = two_in_mujoco(model, count=10).xs
    rows = []

    def kept(*row):
        if not (row[0] == "/a" and row[3] == STAMP + 30_000_000):
            rows.append(row)

    for k, x in enumerate(xs):
        t = STAMP + 10_000_000 * k
        kept("/joint_states", "sensor_msgs/msg/JointState", "", t,
             joints(["left_turn", "right_turn"], x[[7, 15]], x[[22, 29]], [0.0, 0.0]))  # fmt: skip
        for topic, frame, i, j in (("/a", "left_body", 0, 16), ("/b", "right_body", 8, 23)):
            body = np.concatenate([x[i : i + 7], x[j : j + 6]])
            kept(topic, "nav_msgs/msg/Odometry", "world", t,
                 lambda types, body=body, frame=frame: {**odometry(types, body, rotation_of(body)),
                                                        "child_frame_id": frame})  # fmt: skip
    with pytest.raises(InputError, match=r"t = 1700000000030000000 ns: .*got only the joints, right_body"):
        read_recording(bag_of(tmp_path / "bag", rows), model)


def test_a_follower_is_left_out_of_a_bag_s_state(tmp_path):
    """Only `a` is in the state and `b` follows it, but the bag's messages have both."""
    from helpers.followers import followed

    model = followed(tmp_path)
    xs = dd.rollout(model, [0.1, 0.5], np.full((4, 1), 2.0)).xs
    rows = [
        ("/joint_states", "sensor_msgs/msg/JointState", "", STAMP + 10_000_000 * k,
         joints(["b", "a"], [1.7 * q + 0.3, q], [1.7 * v, v], [0.0, 2.0]))
        for k, (q, v) in enumerate(xs)
    ]  # fmt: skip
    found = read_recording(bag_of(tmp_path / "bag", rows), model)
    np.testing.assert_array_equal(found.xs, xs)
    np.testing.assert_array_equal(found.us, np.full((4, 1), 2.0))


def joints(names, position, velocity, effort):
    values = {"position": np.array(position), "velocity": np.array(velocity), "effort": np.array(effort)}
    return lambda types: {"name": names, **values}


@each_row(
    "fields, match",
    [
        (joints(["slide"], [1.0], [1.0], [1.0]), "position of hinge"),
        (joints(["slide", "hinge"], [1.0, 1.0], [], [1.0, 1.0]), "velocity of slide: .*got 0 values for slide, hinge"),
        (joints(["slide", "hinge"], [1.0, 1.0], [1.0, np.nan], [1.0, 1.0]), "velocity of hinge: .*finite"),
        (joints(["slide", "hinge"], [1.0, 1.0], [1.0, 1.0], []), "effort of slide"),
    ],
)
def test_what_joint_states_lack_is_named(load, tmp_path, fields, match):
    rows = [("/joint_states", "sensor_msgs/msg/JointState", "", STAMP + k, fields) for k in (0, 10_000_000)]
    with pytest.raises(InputError, match=match):
        read_recording(bag_of(tmp_path / "bag", rows), load("cart_pole.urdf"))


def test_a_bag_without_what_the_model_has_is_refused(load, tmp_path):
    rows = [
        ("/joint_states", "sensor_msgs/msg/JointState", "", STAMP, joints(["slide"], [1.0], [1.0], [1.0])),
    ]
    path = bag_of(tmp_path / "bag", rows)
    with pytest.raises(InputError, match="topics of geometry_msgs/msg/PoseStamped"):
        read_recording(path, load("projectile.sdf"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ArtifactError, match="not a ROS 2 bag"):
        read_recording(Path(tmp_path / "empty"), load("projectile.sdf"))


TRAIN = """<mujoco><option timestep="0.001"/><worldbody><body name="ball" pos="0 0 3"><freejoint name="f"/>
<geom size=".1" mass="1"/></body><body name="arm" pos="2 0 1"><joint name="k" axis="0 1 0"/>
<geom type="capsule" size="0.03" fromto="0 0 0 0 0 -.3" mass="1"/><body name="fore" pos="0 0 -.3">
<joint name="a" axis="0 1 0"/><geom type="capsule" size="0.03" fromto="0 0 0 0 0 -.3" mass="1"/></body></body>
</worldbody>
<actuator><motor name="pa" joint="a" gear="3"/><motor name="pk" joint="k"/></actuator></mujoco>"""


def test_a_log_of_mujoco_is_the_motion_of_drake(tmp_path):
    """The arrays are in the order of the file, with the free body first and its angular velocity in its own frame."""
    mujoco = pytest.importorskip("mujoco", reason="no mujoco")
    (tmp_path / "train.xml").write_text(TRAIN)
    m = mujoco.MjModel.from_xml_string(TRAIN)
    d, rows = mujoco.MjData(m), {"time": [], "qpos": [], "qvel": [], "ctrl": []}
    d.qvel[:] = np.random.default_rng(0).standard_normal(m.nv)
    for k in range(100):
        d.ctrl[:] = 0.1 * np.sin(0.05 * k), 0.3 * np.cos(0.03 * k)
        for name, values in rows.items():
            values.append(np.copy(getattr(d, name)))
        mujoco.mj_step(m, d)
    np.savez(tmp_path / "log.npz", **rows)
    columns = [f"{name}_{i}" for name in ("qpos", "qvel", "ctrl") for i in range(len(rows[name][0]))]
    table = np.hstack([np.reshape(values, (100, -1)) for values in rows.values()])
    write_csv(tmp_path / "log.csv", ["time", *columns], table.tolist())
    model = dd.load_model(tmp_path / "train.xml", time_step=0.001)
    recording = read_recording(tmp_path / "log.npz", model)
    np.testing.assert_allclose(dd.rollout(model, recording.xs[0], recording.us).xs, recording.xs, atol=1e-5)
    again = read_recording(tmp_path / "log.csv", model)
    np.testing.assert_array_equal(again.xs, recording.xs)
    np.testing.assert_array_equal(again.us, recording.us)
    np.savez(tmp_path / "short.npz", **(rows | {"qpos": np.array(rows["qpos"])[:, 1:]}))
    with pytest.raises(InputError, match=r"qpos: expected \(100, 9\)"):
        read_recording(tmp_path / "short.npz", model)


@pytest.fixture
def commanded(load, tmp_path):
    """Return a function that reads a bag of 8 samples of a pendulum, 0.1 s apart from 0.1 s on, with trajectories.

    A trajectory is (stamp [ms], points (wait [ms], positions), joints).
    """
    model = load("pendulum.urdf", inputs="position", gains=(40.0, 3.0))
    ms, none = 10**6, np.zeros(0)

    def trajectory(types, points, names):
        point, duration = types["trajectory_msgs/msg/JointTrajectoryPoint"], types["builtin_interfaces/msg/Duration"]
        waits = [duration(*divmod(wait * ms, 10**9)) for wait, _ in points]
        positions = [np.array(q, dtype=float) for _, q in points]
        made = [point(q, none, none, none, wait) for q, wait in zip(positions, waits, strict=True)]
        return {"joint_names": names, "points": made}

    def read(*trajectories):
        messages = [
            (
                "/joint_states",
                "sensor_msgs/msg/JointState",
                "",
                100 * k * ms,
                joints(["hinge"], [0.1 * k - 0.1], [], []),
            )
            for k in range(1, 9)
        ]
        kind = "trajectory_msgs/msg/JointTrajectory"
        for begin, points, *names in trajectories:
            fields = lambda types, points=points, names=names: trajectory(types, points, names or ["hinge"])  # noqa: E731
            messages.append(("/arm/command", kind, "", begin * ms, fields))
        path = tmp_path / f"bag_{len(list(tmp_path.iterdir()))}"
        return read_recording(bag_of(path, messages), model, gaps=True)

    return read


def test_a_bag_has_commanded_positions_in_its_trajectories(commanded):
    """A trajectory holds until the next one begins, and is linear between its points."""
    plans = (200, [(0, [0.5])]), (400, [(0, [0.5]), (200, [0.7]), (1000, [9.0])]), (650, [(0, [0.2])])
    recording = commanded(*plans)
    np.testing.assert_allclose(recording.times, 0.1 * np.arange(7), atol=1e-12)  # from the first command on
    np.testing.assert_allclose(recording.xs[:, 0], 0.1 * np.arange(1, 8))
    assert np.isnan(recording.xs[:, 1]).all()
    np.testing.assert_allclose(recording.us[:, 0], [0.5, 0.5, 0.5, 0.6, 0.7, 0.2], atol=1e-6)


def test_no_command_is_known_before_the_first_point_that_was_reached(commanded):
    """The first trajectory is replaced before its only point, and the second reaches its point at 0.7 s."""
    recording = commanded((100, [(1000, [1.0])]), (200, [(500, [0.0])]))
    np.testing.assert_allclose(recording.xs[:, 0], [0.6, 0.7], atol=1e-12)
    np.testing.assert_array_equal(recording.us, [[0.0]])


def test_commands_of_other_joints_change_nothing(commanded):
    """They have the same stamp in the same topic, a later begin than the samples, or no positions."""
    others = (100, [(0, [0.7])], "other"), (700, [(0, [0.7])], "gripper"), (300, [(0, [])], "wheel")
    recording = commanded((100, [(0, [0.5])]), *others)
    np.testing.assert_array_equal(recording.us, np.full((7, 1), 0.5))


@each_row(
    "points, names, match",
    [
        ([(500, [0.5]), (0, [0.0])], ["hinge"], r"point at 100000000 ns: expected times that increase"),
        ([(0, [])], ["hinge"], r"at 100000000 ns.* expected a finite one for each joint, got positions \[\]"),
        ([(0, [0.5])], ["other", "hinge"], r"expected a finite one for each joint, got positions \[0\.5\]"),
        ([(0, [np.nan])], ["hinge"], r"expected a finite one for each joint, got positions \[nan\]"),
    ],
)
def test_a_wrong_trajectory_is_named(commanded, points, names, match):
    with pytest.raises(InputError, match=match):
        commanded((100, points, *names))


# ---- logs of MuJoCo ----------------------------------------------------------------------------------------------

INERTIAL = '<inertial pos="0 0 -.2" mass="1" diaginertia=".02 .02 .01"/>'
COUNT = 5
QPOS, QVEL = np.tile([0.1, 0.2], (COUNT, 1)), np.tile([1.0, 2.0], (COUNT, 1))
LOG = {"time": H * np.arange(COUNT), "qpos": QPOS, "qvel": QVEL, "ctrl": np.tile([0.3, 0.4], (COUNT, 1))}
MOTORS = '<motor name="x" joint="a"/><motor name="y" joint="b"/>'
JOINT_A, JOINT_B = (f'<joint name="{name}" axis="0 1 0"/>' for name in "ab")
NESTED = f'<body name="A">{JOINT_A}{INERTIAL}<body name="B" pos="0 0 -.4">{JOINT_B}{INERTIAL}</body></body>'


def logged(tmp_path, bodies=NESTED, actuators=MOTORS, log=LOG, gaps=False, **options):
    """Return the recording of an .npz log of joints a and b, with the model of these bodies and actuators."""
    path = tmp_path / "two.xml"
    world = f'<compiler angle="radian"/><worldbody>{bodies}</worldbody><actuator>{actuators}</actuator>'
    path.write_text(f"<mujoco>{world}</mujoco>")
    np.savez(tmp_path / "log.npz", **log)
    return read_recording(tmp_path / "log.npz", dd.load_model(path, time_step=H, **options), gaps=gaps)


SERVO = '<general name="{}" joint="{}" gainprm="{}" biastype="affine" biasprm="{} -100 -5" gear="{}"/>'


@each_row(
    "actuators, u",
    [
        (SERVO.format("x", "a", 100, 0, 1) + SERVO.format("y", "b", 100, 0, 2), [0.3, 0.2]),
        (SERVO.format("x", "a", 50, 3, 1) + '<motor name="y" joint="b"/>', [0.4, (50 * 0.3 + 3) / 100]),  # motors first
        ('<velocity name="x" joint="a" kv="10" gear="2"/><motor name="y" joint="b" gear="3"/>', [6.0, 1.2]),
        ('<general name="x" joint="a" gainprm="5" gear="2"/><motor name="y" joint="b"/>', [3.0, 0.4]),
        ('<motor joint="b" gear="7"/><motor joint="a"/>', [2.1, 0.4]),  # without names
        ('<position name="x" joint="a" kp="9" kv="1" gear="2"/><motor joint="b"/>', [0.4, 0.15]),
    ],
)
def test_ctrl_is_converted_to_the_inputs_of_the_rewritten_actuators(tmp_path, actuators, u):
    np.testing.assert_allclose(logged(tmp_path, actuators=actuators).us, np.tile(u, (COUNT - 1, 1)), atol=1e-15)


@pytest.mark.parametrize("kind", ['general gainprm="50" biastype="affine" biasprm="3 -100 -5"', 'velocity kv="10"'])
def test_drake_follows_mujoco_with_the_converted_ctrl(tmp_path, kind):
    mujoco = pytest.importorskip("mujoco", reason="no mujoco")
    path, h = tmp_path / "servo.xml", 0.0005
    body = f'<body name="A">{JOINT_A}{INERTIAL}</body>'
    path.write_text(
        f'<mujoco><option timestep="{h}" integrator="implicitfast"/><worldbody>{body}</worldbody>'
        f'<actuator><{kind} name="x" joint="a"/></actuator></mujoco>'
    )
    m = mujoco.MjModel.from_xml_path(str(path))
    d, rows = mujoco.MjData(m), {"time": [], "qpos": [], "qvel": [], "ctrl": []}
    for k in range(400):
        d.ctrl[:] = 0.3 * np.sin(0.02 * k)
        for name, values in rows.items():
            values.append(np.copy(getattr(d, name)))
        mujoco.mj_step(m, d)
    np.savez(tmp_path / "log.npz", **rows)
    model = dd.load_model(path, time_step=h)
    recording = read_recording(tmp_path / "log.npz", model)
    xs = dd.rollout(model, recording.xs[0], recording.us).xs
    np.testing.assert_allclose(xs[:, 0], recording.xs[:, 0], atol=2e-3)  # the servos' laws differ by one step; q is 0.1


def test_the_ctrl_of_motors_at_sites_is_a_force_on_a_body(tmp_path):
    site = '<site name="s" pos="0 0 0.1"/></body>'
    actuators = '<motor name="up" site="s" gear="0 0 2 0 0 0.1"/><motor name="y" joint="b"/>'
    recording = logged(tmp_path, NESTED.removesuffix("</body>") + site, actuators)
    np.testing.assert_allclose(recording.us[0], [0.4, 0.6], atol=1e-15)  # y, up


@each_row(
    "actuators, options, match",
    [
        (f'{MOTORS}<damper name="z" joint="a" kv="1" ctrlrange="0 1"/>', {}, r"damper z .*as its input of the model"),
        ('<motor name="x" joint="a"/>', {"body_forces": [dd.model.BodyForce("jet", "A")]}, "got none for jet"),
        (MOTORS, {"inputs": "position", "gains": (9.0, 1.0)}, r"motor x .* an effort .*got a commanded position"),
        (
            '<position name="x" joint="a" kp="9" kv="1"/><motor name="y" joint="b"/>',
            {"inputs": "effort"},
            r"position x .* a commanded position .*got an effort",
        ),
        (MOTORS, {"fix_joints": ["a"]}, r"none fixed, welded or reduced, got a \(line 1\), not in the model"),
    ],
)
def test_an_actuator_or_joint_of_the_file_that_the_model_has_not_is_named(tmp_path, actuators, options, match):
    with pytest.raises(InputError, match=match):
        logged(tmp_path, actuators=actuators, **options)


def test_a_joint_without_a_name_is_refused(tmp_path):
    with pytest.raises(InputError, match="got one without a name"):
        logged(tmp_path, NESTED.replace('name="b" ', ""), '<motor name="x" joint="a"/>')


@each_row(
    "bodies",
    [
        f'<body name="A">{INERTIAL}<body name="B" pos="0 0 -.4">{JOINT_B}{INERTIAL}</body>{JOINT_A}</body>',
        f'<body name="A">{INERTIAL}<frame><body name="B">{JOINT_B}{INERTIAL}</body></frame>{JOINT_A}</body>',
        f'<include file="a.xml"/><body name="B">{JOINT_B}{INERTIAL}</body>',
    ],
)
def test_joints_are_in_mujoco_s_order(tmp_path, bodies):
    """A body's joints come before those of the bodies in it, and an included body is at its place."""
    (tmp_path / "a.xml").write_text(f'<mujoco><body name="A">{JOINT_A}{INERTIAL}</body></mujoco>')
    recording = logged(tmp_path, bodies)
    model = dd.load_model(tmp_path / "two.xml", time_step=H)
    by_name = dict(zip(model.state_names, recording.xs[0], strict=True))
    assert by_name == {"a_q": 0.1, "b_q": 0.2, "a_w": 1.0, "b_w": 2.0}
    mujoco = pytest.importorskip("mujoco", reason="no mujoco")
    m = mujoco.MjModel.from_xml_path(str(tmp_path / "two.xml"))
    assert [m.joint(i).name for i in range(m.njnt)] == ["a", "b"]


def test_included_actuators_have_their_gear(tmp_path):
    (tmp_path / "x.xml").write_text('<mujoco><motor name="x" joint="a" gear="3"/></mujoco>')
    recording = logged(tmp_path, actuators='<include file="x.xml"/><motor name="y" joint="b"/>')
    np.testing.assert_allclose(recording.us[0], [0.9, 0.4], atol=1e-15)


@each_row(
    "changes, match",
    [
        ({"ctrl": None}, r"expected arrays time, qpos, qvel, ctrl, got arrays time, qpos, qvel$"),
        ({"qvel": None}, r"expected arrays time, qpos, qvel, ctrl"),
        ({"time": None}, r"expected arrays time"),
        ({"time": np.array(1.0)}, r"time: expected \(1,\), .*got \(\)"),
        ({"time": LOG["time"][:, None]}, r"time: expected \(5,\), .*got \(5, 1\)"),
        ({"ctrl": LOG["ctrl"][:, :1]}, r"ctrl: expected \(5, 2\)"),
    ],
)
def test_arrays_that_a_log_lacks_are_named(tmp_path, changes, match):
    log = {name: values for name, values in (LOG | changes).items() if values is not None}
    with pytest.raises(InputError, match=match):
        logged(tmp_path, log=log)


def test_other_arrays_of_a_log_are_not_read(tmp_path):
    names, objects = np.array(["a"]), np.array(["a", None], dtype=object)
    recording = logged(tmp_path, log=LOG | {"seed": np.array(3), "names": names, "notes": objects})
    np.testing.assert_array_equal(recording.xs[:, :2], QPOS)
    with pytest.raises(ArtifactError, match="object"):
        logged(tmp_path, log=LOG | {"ctrl": np.full((COUNT, 2), None, dtype=object)})


def one_joint(tmp_path):
    path, body = tmp_path / "one.xml", f'<body name="A">{JOINT_A}{INERTIAL}</body>'
    motor = '<actuator><motor name="m" joint="a" gear="3"/></actuator>'
    path.write_text(f"<mujoco><worldbody>{body}</worldbody>{motor}</mujoco>")
    return dd.load_model(path, time_step=H)


@each_row(
    "header, match",
    [
        ("time,qpos_0,qvel_0", "expected arrays time, qpos, qvel, ctrl"),
        ("time,qpos_0,qvel_0,ctrl_1", r"columns of ctrl: expected ctrl_0 and so on, each once, got ctrl_1"),
        ("time,qpos_0,qpos0,qvel_0,ctrl_0", r"columns of qpos: .* got qpos_0, qpos0"),
        ("time,time,qpos_0,qvel_0,ctrl_0", r"column: expected time.*each once.* got time"),
        ("time,qpos_0,qvel_0,m", r"column: expected time, qpos_0.* got m"),
        ("time,qpos_0,qvel_0,ctrl_0,phase", r"column: expected .* got phase"),
        ("time,qpos_0,qvel_0,ctrl_0,A.gyro_x", r"with gaps=True sensors, got A\.gyro_x"),
    ],
)
def test_columns_of_a_log_are_numbered_from_0_and_no_others_are_dropped(tmp_path, header, match):
    rows = [[k * H] * len(header.split(",")) for k in range(2)]
    with pytest.raises(InputError, match=match):
        read_recording(write_csv(tmp_path / "log.csv", header.split(","), rows), one_joint(tmp_path))


def test_sensors_in_a_log_are_read(tmp_path):
    path = write_csv(tmp_path / "log.csv", ["time", "qpos_0", "ctrl_0", "A.gyro_x"], [[0, 1, 2, 3], [H, 4, 5, 6]])
    recording = read_recording(path, one_joint(tmp_path), gaps=True)
    np.testing.assert_array_equal(recording.outputs["A.gyro_x"], [3, 6])
    np.testing.assert_array_equal(recording.us, [[6]])
    np.testing.assert_array_equal(recording.xs, [[1, np.nan], [4, np.nan]])

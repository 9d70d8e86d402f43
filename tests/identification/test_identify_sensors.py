"""Check sensors of other quantities with Drake's kinematics, closed forms and a robot in another simulator."""

import numpy as np
import pytest
from helpers.estimates import assert_known
from helpers.models import MODELS
from helpers.pendulum import GRAVITY, LEVER, swing
from helpers.robots import example_robot, state_in_range
from helpers.table import each_row
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import JacobianWrtVariable

import drake_diff as dd
from drake_diff.comparison import read_recording
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.identification.sensors import choose_sensors
from drake_diff.identification.tree import TreeDynamics, tree_for_identification
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

pytestmark = pytest.mark.solve

POSE = (0.1, -0.05, 0.2, 0.3, -0.4, 0.5)


def columns(label):
    return [f"{label}.{quantity}_{axis}" for quantity in ("position", "gyro", "accel") for axis in "xyz"]


@each_row(
    "name, body, joint", [("ur5_robot.urdf", "wrist_2_link", "elbow_joint"), ("solo12.urdf", "FR_LOWER_LEG", "FR_KFE")]
)
def test_readings_are_drakes_and_their_slopes_those_of_differences(name, body, joint):
    model, random = example_robot(name), np.random.default_rng(0)
    tree, plant, space = tree_for_identification(model), model.plant, tangent_space(model)
    sensors = choose_sensors(model, tree, [*columns("imu"), f"{joint}.force"], {"imu": (body, POSE)})
    x, u = state_in_range(model, random), random.uniform(-1, 1, model.nu)
    nq, nv, numbers = model.nq, model.nv, tree.numbers
    dynamics = TreeDynamics(tree, numbers)
    read = sensors.read(dynamics, x[None], u[None])[0]
    context = plant.CreateDefaultContext()
    plant.SetPositionsAndVelocities(context, x)
    a = dynamics.accelerate(x[None], u[None])[0]
    frame, world = plant.GetBodyByName(body).body_frame(), plant.world_frame()
    pose = frame.CalcPoseInWorld(context) @ RigidTransform(RollPitchYaw(*POSE[3:]), POSE[:3])
    J = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, frame, POSE[:3], world, world)
    at_rest = plant.CalcBiasSpatialAcceleration(context, JacobianWrtVariable.kV, frame, POSE[:3], world, world)
    R = pose.rotation().matrix().T
    spatial, acceleration = J @ x[nq:], J @ a + at_rest.get_coeffs()
    np.testing.assert_allclose(read[:3], pose.translation(), atol=1e-12)
    np.testing.assert_allclose(read[3:6], R @ spatial[:3], atol=1e-12)
    size = np.abs(acceleration).max()
    np.testing.assert_allclose(read[6:9], R @ (acceleration[3:] + 9.81 * np.eye(3)[2]), atol=1e-9 * size)
    # The force is what the drive supplies: inverse dynamics without rotors, springs and friction.
    k = plant.GetJointByName(joint).velocity_start()
    set_state(model.double, x)
    rotors = numbers.reflected * a + numbers.damping * x[nq:]
    drive = model.double.inverse_dynamics(a) - rotors
    assert read[9] == pytest.approx(drive[k], abs=1e-9 * np.abs(a).max())

    by = np.eye(len(numbers.flat))
    by_x, by_numbers = sensors.slopes(space, dynamics, x[None], u[None], by)
    direction = random.uniform(-1, 1, 2 * nv)
    change = random.uniform(-1, 1, len(by)) * np.clip(np.abs(numbers.flat), 1e-3, 1e3)

    def at(h):
        moved = space.plus(x[None], h * direction[None])
        return sensors.read(TreeDynamics(tree, numbers.moved(h * change)), moved, u[None])[0]

    difference = (at(1e-5) - at(-1e-5)) / 2e-5
    found = by_x[0] @ direction + by_numbers[0] @ change
    # For light links, differences of accelerations with a step of 1e-5 are accurate to 1e-6 of the largest entry.
    np.testing.assert_allclose(found, difference, atol=1e-6 * max(np.abs(difference).max(), 1.0))


def test_a_pendulum_is_known_by_an_accelerometer_and_a_gyro_on_it(load):
    """At r from the hinge, the sensor measures r w' + g sin q and r w^2 + g cos q. The gyro has a bias."""
    model, random, r = load("pendulum.urdf"), np.random.default_rng(0), 0.4
    exact = swing(damping=0.15, noise=0.0, velocities=True)
    q, w = exact.xs.T
    w_dot = -GRAVITY / LEVER * np.sin(q) - 0.15 * w / LEVER**2  # for 1 kg
    outputs = {  # the rod hangs along -z of its frame and rotates about +y
        "imu.gyro_y": w + 0.05 + 1e-3 * random.standard_normal(len(q)),
        "imu.accel_x": -r * w_dot - GRAVITY * np.sin(q) + 1e-2 * random.standard_normal(len(q)),
        "imu.accel_z": r * w**2 + GRAVITY * np.cos(q) + 1e-2 * random.standard_normal(len(q)),
    }
    measured = swing(damping=0.15, noise=5e-3, seed=3)
    without = dd.identify(model, measured, ["hinge.damping"])
    log = dd.Recording("lab", "1", exact.times, measured.xs, exact.us, outputs=outputs)
    mounted = {"imu": ("pole", (0, 0, -r))}
    e = dd.identify(model, log, ["hinge.damping", "imu.gyro_y.bias"], sensors=mounted)
    assert_known(e, "hinge.damping", 0.15, 0.3 * np.ptp(without.intervals["hinge.damping"]))
    assert_known(e, "imu.gyro_y.bias", 0.05, 1e-3)
    assert e.noise["imu.accel_x"] == pytest.approx(1e-2, rel=0.2)
    wrong = dd.identify(model, log, ["hinge.damping", "imu.gyro_y.bias"], sensors={"imu": ("pole", (0, 0, -0.3))})
    assert not wrong.explained


@pytest.mark.slow
def test_a_sensor_file_is_kept_and_comes_out_again(tmp_path):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
    log = swing(damping=0.15, times=np.linspace(0, 1, 81))
    tip = 0.5 * np.sin(-log.xs[:, 0]) + 1e-4 * np.random.default_rng(0).standard_normal(81)
    samples = zip(*map(np.ndarray.tolist, (log.times, log.xs[:, 0], tip)), strict=True)
    rows = [f"{t!r},{x!r},{y!r},0" for t, x, y in samples]
    rows[5] = rows[5].replace(f"{tip[5]!r}", "")
    path = tmp_path / "lab.csv"
    path.write_text("\n".join([f"time,hinge_q,tip.position_x,{model.input_names[0]}", *rows]))
    mounted = {"tip": ("pole", [0, 0, -0.5])}
    e = dd.identify(model, path, ["hinge.damping"], sensors=mounted)
    assert e.explained, e.reason
    assert set(e.noise) == {"hinge_q", "tip.position_x"}
    record = dd.save(e, tmp_path / "run")
    assert record.inputs.sensors["tip"].body == "pole"
    assert dd.verify(tmp_path / "run").holds
    read = read_recording(path, model, gaps=True)
    again = dd.save(dd.identify(model, read, ["hinge.damping"], sensors=mounted), tmp_path / "b")
    assert again.estimates == record.estimates
    assert dd.verify(tmp_path / "b").holds


def test_what_makes_no_sense_is_refused(load):
    model, log = load("pendulum.urdf"), swing()

    def refused(error, words, column, **more):
        recording = dd.Recording("lab", "1", log.times, log.xs, log.us, outputs={column: np.zeros(len(log.times))})
        with pytest.raises(error, match=words):
            dd.identify(model, recording, ["hinge.damping"], **more)

    refused(InputError, "BODY.position_x", "pole.speed_x")
    refused(UnknownNameError, "body of sensor", "pool.gyro_x")
    refused(UnknownNameError, "joint with a force", "pole.force")
    refused(UnknownNameError, "sensor with columns", "pole.gyro_x", sensors={"imu": ("pole", [0, 0, 0])})
    refused(InputError, "x, y, z", "imu.gyro_x", sensors={"imu": ("pole", [0, 0])})
    refused(ModelError, "continuous", "pole.gyro_x", motion="steps")

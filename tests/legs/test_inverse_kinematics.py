"""Tests of inverse kinematics against closed forms, with mimic joints, a closed loop, and a floating base."""

import numpy as np
import pytest
from helpers.legged import LEGGED, legged_model, rest
from helpers.models import MODELS

import drake_diff as dd
from drake_diff.legs.feet import Legs
from drake_diff.legs.inverse_kinematics import PointTarget, Wish, inverse_kinematics
from drake_diff.legs.motion import LEVELLED

pytestmark = pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")


def link(name, joint, parent, origin, more=""):
    inertia = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    return (
        f'<link name="{name}">{inertia}</link><joint name="{joint}" type="revolute"><parent link="{parent}"/>'
        f'<child link="{name}"/><origin xyz="{origin}"/><axis xyz="0 1 0"/>'
        f'<limit lower="-3" upper="3" effort="9" velocity="9"/>{more}</joint>'
    )


def arm(tmp_path, more=""):
    """Write the URDF of two hanging links of 0.5 m that turn about y. `more` may make the elbow mimic the shoulder."""
    path = tmp_path / "arm.urdf"
    links = link("upper", "shoulder", "world", "0 0 0") + link("lower", "elbow", "upper", "0 0 -0.5", more)
    path.write_text(f'<robot name="arm"><link name="world"/>{links}</robot>')
    return path


def solve(model, frame, point, position, first, tolerance=1e-8):
    target = PointTarget(model.double.plant.GetFrameByName(frame), point, position, tolerance)
    limits = np.full(model.nq, 3.0)
    return inverse_kinematics(model, first, [target], Wish(first, np.ones(model.nv)), -limits, limits)


@pytest.mark.parametrize("bent", [-1.0, 1.0])
def test_two_links_reach_by_the_law_of_cosines(tmp_path, bent):
    model, r = dd.load_model(arm(tmp_path), time_step=0.01, actuators="all"), 0.7
    q = solve(model, "lower", [0, 0, -0.5], [r * np.sin(0.3), 0, -r * np.cos(0.3)], np.array([0.0, bent]))
    half = np.arccos(r)  # the base angle of the triangle with sides 0.5, 0.5, r
    assert q == pytest.approx([-0.3 - bent * half, bent * 2 * half], abs=1e-6)


def test_what_is_free_stays_where_it_is_wished_for(tmp_path):
    """Only the tip's height is prescribed. The expected posture is the one nearest to the first, by a grid search."""
    model, first = dd.load_model(arm(tmp_path), time_step=0.01, actuators="all"), np.array([0.5, 0.4])
    q = solve(model, "lower", [0, 0, -0.5], [np.nan, np.nan, -0.6], first)
    shoulders = np.linspace(-1, 2, 300_001)
    elbows = np.arccos(np.clip(1.2 - np.cos(shoulders), -1, 1)) - shoulders
    nearest = np.argmin((shoulders - first[0]) ** 2 + (elbows - first[1]) ** 2)
    assert q == pytest.approx([shoulders[nearest], elbows[nearest]], abs=1e-4)


def test_a_joint_that_follows_goes_along(tmp_path):
    """The elbow angle is twice the shoulder angle a, so the tip is at 0.5 (sin a + sin 3 a, cos a + cos 3 a)."""
    mimic = '<mimic joint="shoulder" multiplier="2" offset="0"/>'
    model = dd.load_model(arm(tmp_path, mimic), time_step=0.01, actuators="all", mimic="reduce")
    height = -0.5 * (np.cos(0.4) + np.cos(1.2))
    q = solve(model, "lower", [0, 0, -0.5], [np.nan, np.nan, height], np.array([0.1]))
    assert q == pytest.approx([0.4], abs=1e-6)


def test_a_loop_that_is_closed_stays_closed(tmp_path):
    """Both cranks of a parallelogram, whose coupler is connected by a ball joint, have the same angle."""
    path = tmp_path / "loop.xml"
    inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    hinge = '<joint name="{}" type="hinge" axis="0 1 0" range="-170 170"/>'
    path.write_text(
        f"""<mujoco><worldbody><body name="left">{inertia}{hinge.format("a")}
        <body name="coupler" pos="0 0 -0.3">{inertia}{hinge.format("b")}</body></body>
        <body name="right" pos="0.5 0 0">{inertia}{hinge.format("c")}</body></worldbody>
        <equality><connect body1="coupler" body2="right" anchor="0.5 0 0"/></equality></mujoco>"""
    )
    model = dd.load_model(path, time_step=0.01, actuators="all")
    assert model.num_constraints == 1
    q = solve(model, "left", [0, 0, -0.3], [-0.3 * np.sin(0.5), np.nan, np.nan], np.array([0.2, -0.1, 0.0]))
    assert q == pytest.approx([0.5, -0.5, 0.5], abs=1e-6)


def test_a_base_turns_and_moves_so_that_feet_and_centre_of_mass_are_where_they_are_asked_to():
    legs = [f"{leg}_foot" for leg in ("FL", "FR", "RL", "RR")]
    model = dd.load_model(MODELS / "quadruped.urdf", time_step=0.02, ground=True, actuators="all", base="free")
    q0 = np.array(model.default_state[: model.nq])
    robot = Legs.named(model, legs, q0)
    way = np.random.default_rng(0).uniform(-0.1, 0.1, model.nv)
    way[:3] *= 3  # [rad], about a random axis
    there = robot.moved(q0, way)
    feet, mass = robot.points_in(there), robot.center_of_mass()
    robot.put(q0)
    lower, upper = model.position_limits
    wish = Wish(q0, np.ones(model.nv), mass, 1e-4)
    q = inverse_kinematics(model, q0, robot.at(feet, 1e-7), wish, lower, upper)
    assert robot.points_in(q) == pytest.approx(feet, abs=2e-7)
    assert robot.center_of_mass() == pytest.approx(mass, abs=1e-4)
    assert np.linalg.norm(q[:4]) == pytest.approx(1.0, abs=1e-8)


@pytest.mark.skipif(not LEGGED["talos"].is_installed, reason="no example-robot-data")
@pytest.mark.parametrize(("seed", "steps", "ahead"), [(0, 60, 0.0), (10, 60, 0.0), (12, 40, 0.02)])
def test_a_robot_on_flat_feet_rises_smoothly(seed, steps, ahead):
    """Joints that turn by d in time T accelerate by at most 10 / sqrt(3) d / T^2. SNOPT fails at some postures."""
    model, robot = legged_model("talos"), LEGGED["talos"]
    first = rest("talos", model, np.array(robot.low), np.random.default_rng(seed))
    end = rest("talos", model, np.array(robot.high))[: model.nq]
    end[4:6] = first[4] + ahead, first[5]
    xs, _ = dd.optimize.ContactSchedule([(steps, robot.feet)]).guess(model, first, end)
    turned = np.max(np.abs(xs[-1, 7 : model.nq] - first[7 : model.nq]))
    most = 10 / np.sqrt(3) * turned / (steps * model.time_step) ** 2
    acceleration = np.diff(xs[LEVELLED:, model.nq + 6 :], axis=0) / model.time_step
    assert np.max(np.abs(acceleration)) < 1.5 * most  # the knees turn fastest, and less evenly; a jump gives 20


def test_a_foot_that_rolls_goes_as_far_as_its_ball_turns():
    """When the body of a ball foot turns by a, the ball's centre moves by r a, up to the third order in a."""
    legs = [f"{leg}_foot" for leg in ("FL", "FR", "RL", "RR")]
    model = dd.load_model(MODELS / "quadruped.urdf", time_step=0.02, ground=True, actuators="all", base="free")
    q0 = np.array(model.default_state[: model.nq])
    q0[[model.position_names.index(f"{leg}_knee_q") for leg in ("FL", "FR", "RL", "RR")]] = -1.0
    robot = Legs.named(model, legs, q0)
    feet = robot.points_in(q0)
    wish = Wish(robot.moved(q0, np.eye(model.nv)[robot.base_v + 3] * 0.2), np.full(model.nv, 0.1))
    robot.put(q0)
    before = [foot.frame.CalcPoseInWorld(model.double.context).rotation() for foot in robot.feet]
    lower, upper = model.position_limits
    q = inverse_kinematics(model, q0, robot.at(feet, 1e-9, rolls=range(4)), wish, lower, upper)
    moved = robot.points_in(q) - feet
    for foot, rotation, way in zip(robot.feet, before, moved, strict=True):
        turned = foot.frame.CalcPoseInWorld(model.double.context).rotation() @ rotation.transpose()
        pitch = np.arctan2(turned.matrix()[0, 2], turned.matrix()[0, 0])
        assert 5e-3 < abs(pitch) < 0.5
        assert way[0] == pytest.approx(foot.radii[0] * pitch, abs=foot.radii[0] * abs(pitch) ** 3 + 2e-9)

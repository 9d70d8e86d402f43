"""Tests of floating bodies without actuators, such as a drone's base in a URDF, to which `plan` adds thrusters."""

import numpy as np
import pytest
from helpers.models import robot_file

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError
from drake_diff.planning import plan
from drake_diff.planning.robot import load_robot

pytestmark = pytest.mark.solve

BOX = """<sdf version="1.9"><model name="scene">
<link name="ground"><collision name="skin"><pose>0 0 -0.5 0 0 0</pose><geometry><box><size>9 9 1</size></box></geometry>
</collision></link><joint name="held" type="fixed"><parent>world</parent><child>ground</child></joint>
<link name="box"><pose>0.3 0 0.05 0 0 0.4</pose><inertial><pose>0.1 0.02 0 0 0 0</pose><mass>3</mass><inertia>
<ixx>0.03</ixx><iyy>0.05</iyy><izz>0.07</izz></inertia></inertial><collision name="skin"><geometry><box><size>
0.2 0.2 0.2</size></box></geometry></collision></link></model></sdf>"""


@pytest.fixture
def box(tmp_path):
    """Write a box of 3 kg that starts half in the ground, and whose centre of mass is not its origin."""
    path = tmp_path / "box.sdf"
    path.write_text(BOX)
    return path


def test_thrusters_push_and_turn_a_body_in_every_direction(box):
    """The wrench of each thruster about the centre of mass is r x f and f, in the body's frame."""
    model = load_robot(box, 0).model
    wrenches = []
    for thruster in model.body_forces:
        force = np.array(thruster.direction)
        wrenches.append(np.append(np.cross(np.array(thruster.point) - [0.1, 0.02, 0.0], force), force))
        assert thruster.upper == -thruster.lower == pytest.approx(1.5 * 3 * 9.81, rel=2e-3)  # three digits
    assert np.linalg.svd(np.array(wrenches), compute_uv=False)[-1] > 0.1  # the lever arm is 0.15 m
    assert np.sum(wrenches, axis=0) == pytest.approx([0, 0, 0, 2, 2, 2], abs=1e-12)


@pytest.mark.slow
def test_a_box_is_lifted_out_of_the_ground_and_flown(box, tmp_path):
    found = load_robot(box, 0)
    assert "thrusters" in " ".join(found.repairs)
    assert found.q[6] >= 0.1 - 1e-4
    done = plan(box, out=tmp_path / "out", seed=1)
    assert done.success, done.lines
    assert min(x[6] for x in done.solution.xs) >= 0.1 - 1e-4
    assert dd.verify(tmp_path / "out").holds


def test_a_goal_of_what_does_not_fly_is_refused(box, tmp_path):
    with pytest.raises(InputError, match="box"):
        plan(box, goals={"ground": [0.0, 0.0, 1.0]}, out=tmp_path / "out")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["quadrotor_base.urdf", pytest.param("iris_simple.urdf", marks=pytest.mark.slow)])
def test_drones_of_strangers_hover(name, tmp_path):
    done = plan(robot_file(name), out=tmp_path / "out", seed=2)
    assert done.success, done.lines


def test_what_floats_without_a_mass_is_refused(tmp_path):
    path = tmp_path / "tool.urdf"
    path.write_text('<robot name="tool"><link name="tool"/></robot>')
    with pytest.raises(ModelError, match=r"tool floats.*no mass"):
        plan(path, out=tmp_path / "out")


@pytest.mark.slow
@pytest.mark.long
def test_a_quadrotor_of_mjcf_flies_by_its_own_rotors(tmp_path):
    """Four motors at sites push only upward, so the quadrotor tilts on its way, and it hovers at the end."""
    rotors = {"a": (0.14, 0.18, 0.02), "b": (0.14, -0.18, -0.02), "c": (-0.14, -0.18, 0.02), "d": (-0.14, 0.18, -0.02)}
    sites = "".join(f'<site name="{name}" pos="{x} {y} 0.05"/>' for name, (x, y, _) in rotors.items())
    motors = "".join(
        f'<motor name="{name}" site="{name}" gear="0 0 1 0 0 {ratio}" ctrlrange="0 13"/>'
        for name, (_, _, ratio) in rotors.items()
    )
    (tmp_path / "x4.xml").write_text(
        '<mujoco model="x4"><worldbody><body name="x4" pos="0 0 1"><freejoint/>'
        f'<inertial pos="0 0 0" mass="1.3" diaginertia="0.04 0.025 0.06"/>{sites}</body></worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    done = plan(tmp_path / "x4.xml", goals={"x4": [1.5, 0.0, 1.2]}, out=tmp_path / "run")
    assert done.success, repr(done)
    us, xs = done.solution.us, done.solution.xs
    assert us.min() >= 0
    assert us.max() <= 13
    assert np.linalg.norm(xs[-1, 4:7] - [1.5, 0.0, 1.2]) < 5e-3
    assert np.abs(xs[:, 1:4]).max() > 0.02  # the quadrotor tilts
    assert us[-1].sum() == pytest.approx(1.3 * 9.81, rel=0.3)

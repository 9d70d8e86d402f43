"""`drake-diff plan`: from a file to a verified plan; what is wrong is one sentence and a status."""

import subprocess
import sys

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.planning import plan
from drake_diff.planning.motion import along
from drake_diff.planning.robot import load_robot


def command(*words, cwd):
    return subprocess.run(
        [sys.executable, "-m", "drake_diff.cli.main", "plan", *map(str, words)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=300,
    )


ARM = """<robot name="arm"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 -0.25"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><origin xyz="0 0 -0.25"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="40" velocity="4"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.5"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="20" velocity="4"/></joint></robot>"""


@pytest.fixture
def arm(tmp_path):
    """A two-link arm as textbooks write it: no motor, and a base that floats in Drake."""
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


def test_a_textbook_arm_is_mended_planned_for_and_verified(arm, tmp_path):
    done = command(arm, "--goal", "elbow=0.5", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "actuators='all'" in done.stdout
    assert "base='weld'" in done.stdout
    assert (tmp_path / "out" / "report.html").is_file()
    assert dd.verify(tmp_path / "out").holds
    end = dd.read_trace(tmp_path / "out").xs[-1]
    assert end == pytest.approx([0.0, 0.5, 0.0, 0.0], abs=1e-5)


def test_the_inputs_of_a_smooth_guess_make_that_motion(arm):
    """The recursion of Newton and Euler, stepped by Drake: to rounding of the state after 30 to 100 steps."""
    robot = load_robot(arm, 0)
    guess = along(robot, "line", [robot.q, np.array([0.7, -0.4])])
    motion = dd.rollout(guess.model, guess.xs[0], guess.us)
    assert motion.xs == pytest.approx(guess.xs, abs=1e-9)
    assert guess.xs[-1] == pytest.approx([0.7, -0.4, 0.0, 0.0], abs=1e-12)


def test_a_robot_that_is_not_fully_driven_goes_where_its_motors_can_bring_it(tmp_path):
    done = plan(MODELS / "cart_pole.urdf", out=tmp_path / "out", seed=3)
    assert done.success
    assert np.max(np.abs(done.solution.xs[-1] - done.solution.problem.x_goal)) < 1e-5


def test_a_goal_that_motors_cannot_hold_is_not_called_a_plan(arm, tmp_path):
    """A level arm of 2 kg weighs 15 N m at the shoulder; this one has a motor of 5."""
    weak = tmp_path / "weak.urdf"
    weak.write_text(ARM.replace('effort="40"', 'effort="5"'))
    done = command(weak, "--goal", "shoulder=1.5", "--goal", "elbow=0", "--out", "out", cwd=tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert not plan(weak, goals={"shoulder": 1.5}, out=tmp_path / "again").success


@each_row(
    "words",
    [
        ["--goal", "elbow"],
        ["--goal", "elbow=a"],
        ["--goal", "elbow=1,2"],
        ["--goal", "knee=1"],
        ["--goal", "elbow=4"],
        ["--avoid", "cone:1,2"],
        ["--avoid", "sphere:1,2,3"],
        ["--time", "soon"],
        ["no_such_file.urdf"],
    ],
)
def test_bad_words_are_one_sentence_and_status_2(words, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    done = command(*([] if words[0].endswith("urdf") else [path]), *words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith(("drake-diff: ", "Usage"))
    assert "Traceback" not in done.stderr


def test_unknown_names_list_the_known_ones(arm, tmp_path):
    with pytest.raises(UnknownNameError, match="elbow, shoulder"):
        plan(arm, goals={"knee": 1.0}, out=tmp_path)
    with pytest.raises(InputError, match="limits"):
        plan(arm, goals={"elbow": 4.0}, out=tmp_path)


def test_what_nothing_drives_is_refused(tmp_path):
    path = tmp_path / "ball.sdf"
    path.write_text('<sdf version="1.9"><model name="ball"><link name="ball"/></model></sdf>')
    with pytest.raises(ModelError, match="driven"):
        plan(path, out=tmp_path / "out")

"""Tests of `drake-diff plan`, from a file to a verified plan. An error is one sentence and an exit status."""

import sys

import numpy as np
import pytest
from helpers.command import drake_diff
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff.cli.main import main
from drake_diff.exceptions import ModelError
from drake_diff.model.model import example_files
from drake_diff.planning import plan
from drake_diff.planning.guesses import PostureLine, along
from drake_diff.planning.robot import load_robot
from drake_diff.runs import read_trace

pytestmark = pytest.mark.solve


ARM = """<robot name="arm"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 -0.25"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><origin xyz="0 0 -0.25"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="40" velocity="4"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.5"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="20" velocity="4"/></joint></robot>"""

SLIDE = """<robot name="slide"><link name="base"/><link name="block"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="block"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="4" velocity="0.05"/></joint></robot>"""


@pytest.fixture
def arm(tmp_path):
    """Write a two-link arm as in textbooks, without motors, whose base floats in Drake."""
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


@pytest.mark.slow
def test_a_textbook_arm_is_mended_planned_for_and_verified(arm, tmp_path):
    done = drake_diff("plan", arm, "--goal", "elbow=0.5", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "actuators='all'" in done.stdout
    assert "base='weld'" in done.stdout
    assert (tmp_path / "out" / "report.html").is_file()
    assert dd.verify(tmp_path / "out").holds
    end = read_trace(tmp_path / "out" / "trace.mcap").xs[-1]
    assert end[:2] == pytest.approx([0.0, 0.5], abs=0.025)  # 5 % of the way: the replay has other steps


def test_the_inputs_of_a_smooth_guess_make_that_motion(arm):
    """Inputs from the Newton-Euler recursion, stepped by Drake, give the guess to rounding after 30 to 100 steps."""
    robot = load_robot(arm, 0)
    guess = along(robot, PostureLine("line", np.array([robot.q, [0.7, -0.4]]), robot))
    motion = dd.rollout(guess.model, guess.xs[0], guess.us)
    assert motion.xs == pytest.approx(guess.xs, abs=1e-9)
    assert guess.xs[-1] == pytest.approx([0.7, -0.4, 0.0, 0.0], abs=1e-12)


def test_a_robot_that_is_not_fully_driven_goes_where_its_motors_can_bring_it(tmp_path):
    done = plan(MODELS / "cart_pole.urdf", out=tmp_path / "out", seed=3)
    assert done.success
    assert np.max(np.abs(done.solution.xs[-1] - done.solution.problem.x_goal)) < 1e-5


@pytest.mark.slow
def test_a_goal_that_cannot_be_reached_in_time_is_not_called_a_plan(tmp_path):
    """At 0.05 m/s a slide moves 0.3 m in the longest motion that is tried, and the goal is 0.9 m."""
    (tmp_path / "slide.urdf").write_text(SLIDE)
    done = drake_diff("plan", "slide.urdf", "--goal", "slide=0.9", "--out", "out", cwd=tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "Traceback" not in done.stderr


def test_a_hand_goes_where_it_is_asked_to(arm, tmp_path):
    """The links are 0.5 m long. The frame of the lower link is at the elbow, on a circle of 0.5 m."""
    done = plan(arm, goals={"lower": [-0.3, 0.0, -0.4]}, out=tmp_path / "out")
    assert done.success, done.lines
    shoulder = done.solution.xs[-1][0]
    assert shoulder == pytest.approx(np.arctan2(0.3, 0.4), abs=2e-3)  # the tolerance of 1 mm on 0.5 m


def test_a_hand_out_of_reach_is_refused_with_its_distance(arm, tmp_path):
    with pytest.raises(ModelError, match=r"0\.5 m away"):
        plan(arm, goals={"lower": [0.0, 0.0, -1.0]}, out=tmp_path / "out")


AVOID = ["--goal", "elbow=1", "--avoid"]


@each_row(
    "words, message",
    [
        (["--goal", "elbow"], "NAME=x,y,z for a frame"),
        (["--goal", "elbow=a"], "NAME=x,y,z for a frame"),
        (["--goal", "elbow=1,2"], "three numbers"),
        (["--goal", "knee=1"], "goal: joint"),
        (["--goal", "elbow=4"], "within its limits"),
        (["--time", "soon"], 'None or "least"'),
        (["no_such_file.urdf"], "a file that exists"),
        ([*AVOID, "ball:0,0,0,1"], "sphere:x,y,z,radius or box:"),
        ([*AVOID, "0,0,0,1"], "sphere:x,y,z,radius or box:"),
        ([*AVOID, "sphere:0,0,0"], "4 numbers"),
        ([*AVOID, "box:0,0,0,1"], "6 numbers"),
        ([*AVOID, "sphere:a,0,0,1"], "numbers separated by commas"),
        ([*AVOID, "sphere:0,0,0,-1"], "SphereObstacle.radius"),
        ([*AVOID, "box:0,0,0,1,0,1"], "BoxObstacle.size"),
    ],
)
def test_bad_words_are_one_sentence_and_status_2(words, message, arm, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    file = [] if words[0].endswith("urdf") else [str(arm)]
    monkeypatch.setattr(sys, "argv", ["drake-diff", "plan", *file, *words])
    with pytest.raises(SystemExit) as ended:
        main()
    told = capsys.readouterr().err
    assert ended.value.code == 2
    assert told.startswith("drake-diff: ")
    assert message in told
    assert "Traceback" not in told


def test_what_nothing_drives_is_refused(tmp_path):
    """A ball joint cannot have a motor, and a body on a joint does not float."""
    path = tmp_path / "ball.sdf"
    path.write_text(
        '<sdf version="1.9"><model name="ball"><link name="ball"/><joint name="hangs" type="ball">'
        "<parent>world</parent><child>ball</child></joint></model></sdf>"
    )
    with pytest.raises(ModelError, match="driven"):
        plan(path, out=tmp_path / "out")


@pytest.mark.slow
def test_a_panda_brings_its_hand_to_a_place(tmp_path):
    """Drake's forward kinematics of the last state gives the hand's position, independently of the search."""
    done = plan(example_files()["panda"], goals={"panda_hand": [0.4, 0.3, 0.5]}, out=tmp_path / "out")
    assert done.success, done.lines
    plant = done.solution.problem.model.plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, done.solution.xs[-1][: plant.num_positions()])
    place = plant.GetFrameByName("panda_hand").CalcPoseInWorld(context).translation()
    assert place == pytest.approx([0.4, 0.3, 0.5], abs=1e-3)  # the tolerance of the goal

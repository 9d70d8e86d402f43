"""Tests of paths around obstacles. Errors name the obstacle, and paths are clear by the closed form of two links."""

from itertools import pairwise

import numpy as np
import pytest
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError, MissingDependencyError
from drake_diff.planning import guesses, plan
from drake_diff.planning.guesses import PostureLine, Space, lines
from drake_diff.planning.robot import load_robot

pytestmark = pytest.mark.solve

LONG, THICK = 0.5, 0.03  # [m] of each link, and its radius
ROD = """<link name="{name}"><inertial><origin xyz="0 0 -0.25"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 -0.25"/><geometry><capsule radius="0.03" length="0.5"/></geometry></collision></link>"""
ARM = f"""<robot name="arm"><link name="base"/>{ROD.format(name="upper")}{ROD.format(name="lower")}
<link name="tip"/><joint name="at_tip" type="fixed"><parent link="lower"/><child link="tip"/>
<origin xyz="0 0 -0.5"/></joint>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="40" velocity="4"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.5"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="20" velocity="4"/></joint></robot>"""

SLIDE = """<robot name="slide"><link name="base"/><link name="block"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="block"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" {limits}/></joint></robot>"""


@pytest.fixture
def arm(tmp_path):
    """Write an arm of two capsule links of 0.5 m in the x-z plane, which hangs down at 0."""
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


def distance(qs, center):
    """Return the distances (K,) [m] of the two links' surfaces from a point at the angles qs (K, 2)."""
    found = []
    for shoulder, elbow in qs:
        ends = [np.zeros(2)]
        for angle in (shoulder, shoulder + elbow):  # about y, downwards at 0
            ends.append(ends[-1] - LONG * np.array([np.sin(angle), np.cos(angle)]))
        point, best = np.array([center[0], center[2]]), np.inf
        for a, b in pairwise(ends):
            t = np.clip((point - a) @ (b - a) / LONG**2, 0, 1)
            best = min(best, np.hypot(np.linalg.norm(point - a - t * (b - a)), center[1]))
        found.append(best - THICK)
    return np.array(found)


def test_a_line_is_bent_around_a_disk_that_the_straight_one_meets(arm):
    """With the elbow straight the arm hits a ball at 0.95 m from the shoulder and 0.5 rad, so the elbow has to fold."""
    robot, angle = load_robot(arm, 0), 0.5
    center = -0.95 * np.array([np.sin(angle), 0, np.cos(angle)])
    ball = dd.SphereObstacle(center, 0.08)
    target = np.array([1.0, 0.0])
    space = Space.around(robot, [ball])
    straight = PostureLine("", np.array([robot.q, target]), robot)
    assert np.min(distance(straight.postures, center)) < 0.0
    assert not space.is_free(straight.postures)
    found = lines(space, target, 0)
    assert found
    for line in found:
        fine = line.at(np.linspace(0, 1, 2000))
        assert fine[0] == pytest.approx(robot.q, abs=1e-12)
        assert fine[-1] == pytest.approx(target, abs=1e-12)
        # the margin, minus the possible loss between the postures that are checked: half of 0.04 rad at 1 m
        assert np.min(distance(fine, center)) >= 0.08 + 0.01 - 0.02
        assert np.max(np.abs(fine[:, 1])) > 0.3


def test_what_a_space_lacks_is_the_closed_form(arm):
    robot, random = load_robot(arm, 0), np.random.default_rng(0)
    center = np.array([0.3, 0.1, -0.5])
    space = Space.around(robot, [dd.SphereObstacle(center, 0.08, margin=0.02)])
    qs = random.uniform(-2, 2, (200, 2))
    assert space.lacking(qs) == pytest.approx(0.02 + 0.08 - distance(qs, center), abs=1e-9)


def test_where_no_bent_line_is_clear_and_ompl_is_missing_it_is_asked_for(arm, monkeypatch):
    robot = load_robot(arm, 0)
    space, target = Space.around(robot, [dd.SphereObstacle([-0.45, 0, -0.8], 0.08)]), np.array([1.0, 0.0])
    monkeypatch.setattr(guesses, "find_spec", lambda name: None)
    monkeypatch.setattr(guesses, "BENDS", 0)
    with pytest.raises(MissingDependencyError, match="pip install ompl"):
        lines(space, target, 0)


@pytest.mark.slow
def test_a_hand_goes_around_a_ball_and_the_plan_is_clear_by_the_closed_form(arm, tmp_path):
    angle = 0.5
    center = -0.95 * np.array([np.sin(angle), 0, np.cos(angle)])
    ball = dd.SphereObstacle(center, 0.08)
    done = plan(arm, goals={"shoulder": 1.0, "elbow": 0.0}, avoid=[ball], out=tmp_path / "run")
    assert done.success, done.lines
    times = np.linspace(0, done.solution.horizon, 1 + round(1000 * done.solution.horizon))
    qs = done.solution.transcribed.at(times)[0][:, :2]
    assert np.min(distance(qs, center)) >= 0.08 + 0.01 - 0.001  # between knots, a part of the margin may be used
    assert "SphereObstacle" in done.lines[3]


@pytest.mark.slow
@each_row(
    "avoid, message",
    [
        ([dd.SphereObstacle([0, 0, -0.8], 0.1)], r"start: .*got lower and obstacle sphere at 0, 0, -0.8 come"),
        ([dd.SphereObstacle([-1, 0, 0], 0.2)], r"goal tip: .*got lower and obstacle"),
        ([dd.BoxObstacle([-0.9, 0, 0.1], [0.3, 0.3, 0.3])], r"goal tip: .*got lower and obstacle"),
        ([1.0], r"avoid: .*SphereObstacles"),
    ],
    ids=str,
)
def test_what_no_way_leads_around_is_named_before_it_is_solved(avoid, message, arm, tmp_path):
    with pytest.raises(InputError, match=message):
        plan(arm, goals={"tip": [-0.9, 0, 0.1]}, avoid=avoid, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_least_time_is_that_of_full_force_one_way_and_then_the_other(tmp_path):
    """A slide of 2 kg with 4 N moves 0.5 m in T = 2 sqrt(d m / F). Intervals and a tolerance add up to 2 %."""
    path = tmp_path / "slide.urdf"
    path.write_text(SLIDE.format(limits='effort="4" velocity="100"'))
    done = plan(path, goals={"slide": 0.5}, time="least", out=tmp_path / "out")
    assert done.success, done.lines
    assert 1.0 <= done.solution.horizon / (2 * np.sqrt(0.5 * 2 / 4)) <= 1.02

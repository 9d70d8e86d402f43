"""Tests of models that `plan` has to correct: weak motors, shapes that always overlap, slow joints."""

import dataclasses

import numpy as np
import pytest

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError
from drake_diff.planning import plan
from drake_diff.planning.guesses import Goals, MotionGuess, PostureLine, along, postures
from drake_diff.planning.planner import _goes
from drake_diff.planning.robot import TOUCHING, load_robot, share_to_hold, spring_step
from drake_diff.runs.fields import Failure

pytestmark = pytest.mark.solve

G = 9.81
INERTIA = '<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/>'


def link(name, mass=1.0, at="0 0 -0.25", shape=""):
    collision = f'<collision name="skin"><origin xyz="{at}"/><geometry>{shape}</geometry></collision>' if shape else ""
    inertial = f'<inertial><origin xyz="{at}"/><mass value="{mass}"/>{INERTIA}</inertial>' if mass else ""
    return f'<link name="{name}">{inertial}{collision}</link>'


def joint(name, parent, child, *, at="0 0 0", axis="0 1 0", kind="revolute", limit="", more=""):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        f'<axis xyz="{axis}"/><limit {limit}/>{more}</joint>'
    )


def robot(tmp_path, *parts):
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="robot"><link name="world"/>{"".join(parts)}</robot>')
    return path


def outstretched(tmp_path, effort):
    """Write an arm of 1 kg at 0.25 m along x, which needs a torque of 2.45 N m at 0, and cos(q) of this at q."""
    limit = f'lower="-1.6" upper="1.6" effort="{effort}" velocity="3"'
    return robot(tmp_path, link("arm", at="0.25 0 0"), joint("shoulder", "world", "arm", limit=limit))


def test_a_plan_starts_where_the_motors_hold_the_robot(tmp_path):
    found = load_robot(outstretched(tmp_path, 1.0), 0)
    assert abs(np.cos(found.q[0])) * G * 0.25 <= 0.63  # the gravity torque relative to the limit of 1 N m
    assert "motors can hold" in " ".join(found.repairs)
    assert plan(outstretched(tmp_path, 1.0), out=tmp_path / "out").success


def test_a_joint_that_no_posture_relieves_is_fixed_and_told(tmp_path):
    """The weight on a vertical slide is the same in every posture, and it is more than the motor's 5 N."""
    slide = joint(
        "slide",
        "world",
        "carriage",
        axis="0 0 1",
        kind="prismatic",
        limit='lower="0" upper="1" effort="5" velocity="1"',
    )
    arm = joint("shoulder", "carriage", "arm", limit='lower="-1" upper="1" effort="30" velocity="3"')
    found = load_robot(robot(tmp_path, link("carriage"), link("arm"), slide, arm), 0)
    assert found.model.position_names == ("shoulder_q",)
    assert "motors of slide cannot hold the weight" in " ".join(found.repairs)


def test_only_shapes_that_overlap_in_every_posture_are_not_looked_at(tmp_path):
    """The hand is always inside the collar, two links before it. The forearm meets the post at some angles only."""
    ball = '<sphere radius="0.05"/>'
    limit = 'lower="-3" upper="3" effort="50" velocity="3"'
    path = robot(
        tmp_path,
        link("post", at="0.3 0 -0.5", shape=ball),
        joint("still", "world", "post", kind="fixed"),
        link("upper"),
        joint("shoulder", "world", "upper", limit=limit),
        link("collar", at="0 0 -0.2", shape=ball),
        joint("twist", "upper", "collar", axis="0 0 1", limit=limit),
        link("fore", at="0 0 -0.5", shape=ball),
        joint("elbow", "collar", "fore", at="0 0 -0.1", limit='lower="-0.1" upper="0.1" effort="50" velocity="3"'),
        link("hand", at="0 0 -0.1", shape=ball),
        joint("wrist", "fore", "hand", axis="0 0 1", limit=limit),
    )
    found = load_robot(path, 0)
    assert found.always == {("collar/skin", "hand/skin")}
    assert found.shapes is not None
    assert found.overlap(np.zeros(found.model.nq)) == 0  # although the hand is in the collar
    angle = np.arctan2(-0.3, 0.5)  # the forearm's ball is 0.6 m from the shoulder, the post's 0.583 m
    bent = np.zeros(found.model.nq)
    bent[found.model.position_names.index("shoulder_q")] = angle
    assert found.overlap(bent) == pytest.approx(0.1 - (0.6 - np.hypot(0.3, 0.5)), abs=1e-9)


def test_a_random_goal_is_no_further_than_slow_joints_go(tmp_path):
    """At 0.6 of 0.1 rad/s, a smooth motion of 2 s goes 0.064 rad."""
    limit = 'lower="-3" upper="3" effort="50" velocity="0.1"'
    found = load_robot(robot(tmp_path, link("arm"), joint("shoulder", "world", "arm", limit=limit)), 0)
    for seed in range(10):
        for goal in postures(found, Goals({}, {}), seed):
            assert abs(goal[0] - found.q[0]) <= 0.06 * 2.0 / 1.875 + 1e-12


@pytest.mark.parametrize("seed", range(5))
def test_a_random_goal_and_the_way_to_it_are_held(tmp_path, seed):
    found = load_robot(outstretched(tmp_path, 1.0), seed)
    for goal in postures(found, Goals({}, {}), seed):
        for s in (0.5, 1.0):
            assert share_to_hold(found.model, found.q + s * (goal - found.q)) <= 0.63
        assert found.overlap(goal) <= TOUCHING


FOLLOWER = '<mimic joint="lead" multiplier="{ratio}" offset="0"/>'


def test_a_joint_that_its_followers_hold_is_fixed(tmp_path):
    """The joint has the limits [0, 1], and so has its follower, which turns the other way. Only 0 is possible."""
    limit = 'lower="0" upper="1" effort="50" velocity="3"'
    path = robot(
        tmp_path,
        link("arm"),
        joint("shoulder", "world", "arm", limit='lower="-1" upper="1" effort="50" velocity="3"'),
        link("a"),
        joint("lead", "arm", "a", limit=limit),
        link("b"),
        joint("follow", "arm", "b", limit=limit, more=FOLLOWER.format(ratio=-1)),
    )
    found = load_robot(path, 0)
    assert found.model.position_names == ("shoulder_q",)
    assert any("lead, follow" in told for told in found.repairs)


@pytest.mark.parametrize("follows", [True, False], ids=["a follower", "a joint of its own"])
def test_a_finger_without_mass_is_fixed(tmp_path, follows):
    limit = 'lower="-1" upper="1" effort="50" velocity="3"'
    parts = [link("arm"), joint("shoulder", "world", "arm", limit=limit), link("lead_link")]
    parts += [joint("lead", "arm", "lead_link", limit=limit), link("tip", mass=0)]
    parts += [joint("tip_joint", "lead_link", "tip", limit=limit, more=FOLLOWER.format(ratio=1) if follows else "")]
    path = robot(tmp_path, *parts)
    found = load_robot(path, 0)
    assert "tip_joint_q" not in found.model.position_names
    assert "shoulder_q" in found.model.position_names
    dd.step(found.model, found.model.default_state, np.zeros(found.model.nu))


def test_a_robot_of_joints_without_a_way_to_go_is_refused(tmp_path):
    limit = 'lower="0.5" upper="0.5" effort="50" velocity="3"'
    with pytest.raises(ModelError, match="equal lower and upper limits"):
        load_robot(robot(tmp_path, link("arm"), joint("shoulder", "world", "arm", limit=limit)), 0)


def test_a_plan_whose_record_would_not_hold_is_none(tmp_path, monkeypatch):
    """The first attempt is made to fail a metric. The next one is tried then, and both are reported."""
    from drake_diff.planning import planner
    from drake_diff.runs.measurement import measure

    seen = []

    def measured(solution):
        found = measure(solution)
        seen.append(solution)
        failure = Failure(
            label="evaluation_error", code="metric_does_not_hold", message="it drifts", detected_by="a test"
        )
        return dataclasses.replace(found, failures=(failure,)) if len(seen) == 1 else found

    monkeypatch.setattr(planner, "measure", measured)
    done = plan(outstretched(tmp_path, 10.0), out=tmp_path / "out")
    assert done.success
    assert len(seen) == 2
    assert "but it drifts" in done.tried[0]


def test_a_cart_in_its_rails_goes_without_contact(tmp_path):
    """The cart is always inside the rail, which would brake it, and touches nothing else on its way."""
    pole = joint("hinge", "cart", "pole", limit='lower="-9" upper="9" effort="0" velocity="20"')
    motor = (
        '<transmission><type>transmission_interface/SimpleTransmission</type><joint name="slide"><hardwareInterface>'
        "EffortJointInterface</hardwareInterface></joint><actuator name='motor'/></transmission>"
    )
    path = robot(
        tmp_path,
        link("rail", shape='<box size="2 0.1 0.1"/>', at="0 0 0"),
        joint("still", "world", "rail", kind="fixed"),
        link("carriage"),
        joint("slide", "rail", "carriage", kind="prismatic", axis="1 0 0", limit=LIMIT_OF_THE_SLIDE),
        link("cart", shape='<box size="0.2 0.1 0.1"/>', at="0 0 0"),
        joint("bolt", "carriage", "cart", kind="fixed"),
        link("pole"),
        pole,
        motor,
    )
    done = plan(path, out=tmp_path / "out")
    assert done.success, done.lines
    assert "without contact" in done.tried[-1]
    assert done.solution.problem.model.contract.contact.collision_pairs == 0


LIMIT_OF_THE_SLIDE = 'lower="-1" upper="1" effort="20" velocity="5"'


def test_a_robot_that_can_go_nowhere_is_refused_and_not_planned_for(tmp_path):
    """The balls overlap except within 0.01 rad of the start. A plan that stays at the start is not accepted."""
    ball = '<sphere radius="0.25"/>'
    posts = [
        part
        for name, side in (("left", 1.0), ("right", -1.0))
        for part in (
            link(name, at=f"0.502 0 {side * 0.5}", shape=ball),
            joint(f"{name}_still", "world", name, kind="fixed"),
        )
    ]
    limit = 'lower="-1.2" upper="1.2" effort="50" velocity="3"'
    path = robot(
        tmp_path, *posts, link("arm", at="0.502 0 0", shape=ball), joint("shoulder", "world", "arm", limit=limit)
    )
    with pytest.raises(ModelError, match="no goal posture"):
        plan(path, out=tmp_path / "out")


SPRUNG = """<mujoco model="sprung"><compiler angle="radian"/><worldbody>
<body name="a" pos="0 0 0.5"><joint name="j1" axis="0 1 0" range="-2 2" damping="0.5"/>
<inertial pos="0 0 0.15" mass="1" diaginertia="0.01 0.01 0.001"/><body name="b" pos="0 0 0.3">
<joint name="j2" axis="0 1 0" range="-2 2" stiffness="{}" damping="0.1"/>
<inertial pos="0 0 0.1" mass="0.2" diaginertia="0.001 0.001 0.0001"/></body></body></worldbody><actuator>
<motor joint="j1" ctrlrange="-20 20"/><motor joint="j2" ctrlrange="-60 60"/></actuator></mujoco>"""
SLIDE = """<mujoco><worldbody><body><joint name="slide" type="slide" axis="1 0 0" stiffness="{}"/>
<geom type="sphere" size="0.1" mass="2.5"/></body></worldbody><actuator><motor joint="slide"/></actuator></mujoco>"""


@pytest.mark.parametrize("stiffness", [4e2, 9e4])
def test_the_step_that_resolves_a_spring_is_half_the_inverse_of_its_frequency(stiffness, tmp_path):
    path = tmp_path / "slide.xml"
    path.write_text(SLIDE.format(stiffness))
    frequency = np.sqrt(stiffness / 2.5)
    step, name = spring_step(dd.load_model(path, time_step=0.01))
    assert step == pytest.approx(0.5 / frequency, rel=1e-6)
    assert name == "slide"
    path.write_text(SLIDE.format(0))
    assert spring_step(dd.load_model(path, time_step=0.01))[0] == np.inf


def test_a_plan_does_not_begin_with_steps_that_leave_a_spring_unresolved(tmp_path):
    """A spring of 1e4 N m/rad needs steps of 70 us, 9000 in the shortest plan. One of 300 needs 600 of 1 ms, or more
    than 1000 in 2 rad at 0.6 rad/s. A step that is not shorter in rounded numbers is no repair."""
    path = tmp_path / "sprung.xml"
    path.write_text(SPRUNG.format(1e4))
    with pytest.raises(ModelError, match=r"spring of j2 needs time steps of .*: fix this joint"):
        load_robot(path, 0)
    path.write_text(SPRUNG.format(300))
    with pytest.raises(InputError, match=r"goals: .*spring of j2 needs time steps of 0.001 s"):
        plan(path, goals={"j1": 1.9}, out=tmp_path / "out")
    found = load_robot(path, 0)
    for goal in postures(found, Goals({}, {}), 0):
        guess = along(found, PostureLine("a line", np.array([found.q, goal]), found))
        assert guess.model.time_step == found.model.time_step
        assert guess.num_steps <= 1000
    path.write_text(SLIDE.format(2.5 * (0.5 / 0.0196) ** 2))
    found = load_robot(path, 0)
    assert found.model.time_step == 0.02
    assert not found.stiff
    assert not any("spring" in repair for repair in found.repairs)


LOCKED = """directives:
- add_model: {{name: left, file: "file://{0}"}}
- add_weld: {{parent: world, child: left::rail}}
- add_model: {{name: right, file: "file://{0}"}}
- add_weld: {{parent: world, child: right::rail}}
"""


def test_two_robots_of_one_file_are_repaired_by_their_own_names(tmp_path):
    limit = 'lower="0" upper="0" effort="5" velocity="1"'
    motor = (
        '<transmission name="t"><type>transmission_interface/SimpleTransmission</type><joint name="shoulder"/>'
        '<actuator name="motor"/></transmission>'
    )
    parts = [link("rail"), link("arm"), joint("shoulder", "rail", "arm", limit=limit), motor]
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    both = tmp_path / "both.dmd.yaml"
    both.write_text(LOCKED.format(tmp_path / "arm.urdf"))
    found = load_robot(both, 0)
    assert found.model.nu == 2
    assert any("0 to 0 of left::shoulder, right::shoulder" in repair for repair in found.repairs)


@pytest.mark.slow
def test_an_arm_with_a_stiff_spring_is_planned_in_steps_that_resolve_it(tmp_path):
    """In steps of 20 ms, Drake's explicit spring is unstable, and no plan holds."""
    path = tmp_path / "sprung.xml"
    path.write_text(SPRUNG.format(300))
    result = plan(path, goals={"j2": 0.1}, out=tmp_path / "out")
    assert result.success, result
    assert result.solution.problem.model.time_step == 0.001
    assert any("stiff springs" in repair for repair in result.repairs)


def test_a_motion_with_a_locked_joint_is_within_its_limits(tmp_path):
    """Drake holds the joint at 0 to about 1e-6, which is not beyond its limits."""
    parts = [link("upper"), joint("shoulder", "world", "upper", limit='lower="0" upper="0" effort="5" velocity="9"')]
    wide = 'lower="-2" upper="2" effort="5" velocity="9"'
    parts += [link("fore"), joint("elbow", "upper", "fore", at="0 0 -0.5", limit=wide)]
    model = dd.load_model(robot(tmp_path, *parts), time_step=0.01, actuators=["elbow"])
    motion = dd.rollout(model, model.default_state, np.full((30, 1), 1.0))
    assert 0 < np.max(np.abs(motion.xs[:, model.position_names.index("shoulder_q")])) < 1e-5
    assert _goes(MotionGuess("", model, motion.xs, motion.us, 0.0))

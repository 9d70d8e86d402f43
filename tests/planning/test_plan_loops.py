"""Plans for robots with closed kinematic loops: a leg with a rod, and an arm with a gripper of four bars per finger."""

import mujoco
import numpy as np
import pytest
from helpers.linkages import LEG

import drake_diff as dd
from drake_diff.exceptions import DrakeDiffError
from drake_diff.model.assembly import gap, loop_velocities
from drake_diff.planning import plan
from drake_diff.planning.guesses import has_passive_loops, settled
from drake_diff.planning.robot import load_robot, share_to_hold, steered

pytestmark = pytest.mark.solve

SERVO = '<position name="{0}" joint="{0}" kp="{1}" kv="{2}" forcerange="-40 40" ctrlrange="{3}"/>'
SERVOS = "".join(
    SERVO.format(*row)
    for row in (("shoulder", 800, 80, "-2 2"), ("elbow", 400, 40, "-2 2"), ("finger", 20, 2, "0 0.8"))
)


def arm(servos=SERVOS):
    """Write an arm of two joints whose finger is a parallelogram of 4 by 3 cm: `finger`, `tip`, `inner`."""
    small = 'mass="0.05" diaginertia="2e-5 2e-5 2e-5"'
    return (
        '<mujoco model="arm"><compiler angle="radian"/><option gravity="0 0 -9.81"/><worldbody>'
        '<body name="upper"><joint name="shoulder" axis="0 1 0" range="-2 2" damping="1" armature="0.05"/>'
        '<inertial pos="0.15 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
        '<body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" range="-2 2" damping="1" armature="0.05"/>'
        '<inertial pos="0.12 0 0" mass="0.7" diaginertia="0.005 0.005 0.005"/>'
        '<body name="driver" pos="0.25 0 0.03"><joint name="finger" axis="0 1 0" range="0 0.8" damping="0.05"/>'
        f'<inertial pos="0.02 0 0" {small}/>'
        '<body name="tip" pos="0.04 0 0"><joint name="tip" axis="0 -1 0" range="-0.1 0.9" damping="0.001"/>'
        f'<inertial pos="0.02 0 0" {small}/></body></body>'
        '<body name="inner" pos="0.25 0 0"><joint name="inner" axis="0 1 0" range="-0.1 0.9" damping="0.001"/>'
        f'<inertial pos="0.02 0 0" {small}/></body></body></body></worldbody>'
        '<equality><connect body1="tip" body2="inner" anchor="0 0 -0.03"/></equality>'
        f"<actuator>{servos}</actuator></mujoco>"
    )


def adaptive_gripper():
    """Write a finger of five bars, in which a spring moves the joint `coupler` to its upper limit of 0."""
    light = 'diaginertia="2e-6 2e-6 1e-6"'
    driver = '<joint name="driver" axis="1 0 0" range="0 0.8" armature="0.005" damping="0.1"/>'
    spring = '<joint name="link" axis="1 0 0" range="-0.3 0.8" stiffness="0.05" springref="2.6"/>'
    return (
        '<mujoco model="gripper"><compiler angle="radian"/><worldbody>'
        f'<body name="driver" pos="0 0.03 0.05">{driver}<inertial pos="0 0.02 0" mass="0.01" {light}/>'
        '<body name="coupler" pos="0 0.03 -0.004"><joint name="coupler" axis="1 0 0" range="-1.5 0"/>'
        f'<inertial pos="0 0 0.015" mass="0.014" {light}/></body></body>'
        f'<body name="link" pos="0 0.013 0.06">{spring}<inertial pos="0 0.02 0.02" mass="0.02" {light}/>'
        '<body name="finger" pos="0 0.055 0.037"><joint name="finger" axis="1 0 0" range="-0.9 0.9"/>'
        f'<inertial pos="0 -0.01 0.02" mass="0.03" {light}/></body></body></worldbody>'
        '<equality><connect body1="finger" body2="coupler" anchor="0 0.017 -0.01"/></equality>'
        '<actuator><motor name="driver" joint="driver" ctrlrange="-5 5"/></actuator></mujoco>'
    )


def written(tmp_path, text):
    path = tmp_path / "robot.xml"
    path.write_text(text)
    return path


def test_velocities_that_keep_a_parallelogram_closed(tmp_path):
    """Its tip does not turn: the finger and the inner bar turn at one speed, and the tip turns back at the same."""
    model = dd.load_model(written(tmp_path, arm()), time_step=0.01)
    ways = loop_velocities(model, model.default_state[:5])
    expected = np.zeros((5, 3))
    expected[0, 0] = expected[1, 1] = 1.0
    expected[2:, 2] = 1 / np.sqrt(3)  # the axis of the tip points the other way
    np.testing.assert_allclose(ways @ ways.T, expected @ expected.T, atol=1e-12)  # rounding of a decomposition
    assert steered(model, model.default_state[:5]).tolist() == [True, True, True, False, False]


def test_the_joints_of_a_loop_without_a_motor_are_not_chosen(tmp_path):
    """The finger then hangs, and the arm can still be planned; without any motor there is nothing to choose."""
    assert steered_of(tmp_path, SERVOS).tolist() == [True, True, True, False, False]
    assert steered_of(tmp_path, SERVOS.partition('<position name="finger"')[0]).tolist() == [True, True] + 3 * [False]
    assert steered_of(tmp_path, SERVOS.partition('<position name="elbow"')[0]) is None


def steered_of(tmp_path, servos):
    model = dd.load_model(written(tmp_path, arm(servos)), time_step=0.01)
    return steered(model, model.default_state[:5])


def test_the_share_to_hold_a_loop_counts_the_weight_of_all_its_bars(tmp_path):
    """The weights (0.05 kg, 2 cm from their joints) load the finger's motor by the virtual work of its speed."""
    limits = SERVOS.replace("-40 40", "-0.05 0.05").replace('"-0.05 0.05"', '"-40 40"', 2)
    model = dd.load_model(written(tmp_path, arm(limits)), time_step=0.01)
    # Per rad: driver and inner move 0.02 m, and the tip, which does not turn, moves with the end of the driver, 0.04 m.
    torque = 9.81 * 0.05 * (0.02 + 0.02 + 0.04)
    share = share_to_hold(model, model.default_state[:5])
    np.testing.assert_allclose(share, torque / 0.05, rtol=1e-9)  # the decomposition of the loop's Jacobian


def test_a_truss_has_nothing_to_move(tmp_path):
    """Two hinges whose bodies meet in a point form a triangle."""
    bar = '<inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
    text = (
        '<mujoco><worldbody><body name="a"><joint name="a" axis="0 1 0"/>'
        f'{bar}</body><body name="c" pos="0.4 0 0"><joint name="c" axis="0 1 0"/>{bar}</body></worldbody>'
        '<equality><connect body1="a" body2="c" anchor="0.2 0 0.1"/></equality>'
        '<actuator><motor joint="a" ctrlrange="-5 5"/></actuator></mujoco>'
    )
    assert load_robot(written(tmp_path, text), 0).steered is None


@pytest.mark.slow
@pytest.mark.parametrize("goal", [{"driver": (0.3, 0.0, -0.25)}, {"finger": 0.5}, {"inner": 0.6, "shoulder": 0.5}])
def test_a_servo_arm_with_a_loop_reaches_goals_here_and_in_mujoco(goal, tmp_path):
    path = written(tmp_path, arm())
    result = plan(path, goals=goal, out=tmp_path / "out")
    assert result.success, result
    solution = result.solution
    physics = mujoco.MjModel.from_xml_path(str(path))
    physics.opt.timestep = 1e-4
    data = mujoco.MjData(physics)
    data.qpos[:] = solution.xs[0][:5]
    for u in solution.us:
        data.ctrl[:] = u
        mujoco.mj_step(physics, data, nstep=round(solution.problem.model.time_step / 1e-4))
    assert np.max(np.abs(data.qpos - solution.xs[-1][:5])) < 0.03  # [rad] the bound; <connect> is soft there
    for name, value in goal.items():
        at = data.joint(name).qpos[0] if np.ndim(value) == 0 else data.body(name).xpos
        assert np.max(np.abs(np.subtract(at, value))) < 0.03


@pytest.mark.slow
def test_a_foot_on_a_loop_reaches_a_position(tmp_path):
    """The foot's frame is the shank, which the crank moves by a rod."""
    robot = load_robot(written(tmp_path, LEG), 0)
    assert robot.steered is not None
    result = plan(tmp_path / "robot.xml", goals={"shank": (0.1, 0.0, 0.55)}, out=tmp_path / "out")
    assert result.success, result
    assert max(gap(result.solution.problem.model, x[:5])[0] for x in result.solution.xs) < 1e-5


def test_a_posture_that_opens_a_loop_is_refused(tmp_path):
    with pytest.raises(DrakeDiffError, match=r"no posture near the start has closed loops and .*inner_q"):
        plan(written(tmp_path, arm()), goals={"finger": 0.1, "inner": 0.6}, out=tmp_path / "out")


@pytest.mark.slow
def test_a_goal_of_a_hanging_finger_is_not_dropped(tmp_path):
    """Without a motor, the finger hangs on its limit of 0.8 rad, and only a goal of its own can take it from there."""
    path = written(tmp_path, arm(SERVOS.partition('<position name="finger"')[0]))
    free = plan(path, goals={"shoulder": 0.3}, out=tmp_path / "free")
    assert free.success
    assert abs(free.solution.xs[-1][2] - 0.8) < 0.01
    swung = plan(path, goals={"shoulder": 0.3, "finger": 0.4}, out=tmp_path / "swung")
    assert swung.solution.problem.x_goal[2] == pytest.approx(0.4, abs=1e-6)  # the posture's closed loop
    assert not swung.success or abs(swung.solution.xs[-1][2] - 0.4) < 1e-4


@pytest.mark.slow
def test_an_adaptive_gripper_starts_at_rest_on_a_limit_and_opens(tmp_path):
    path = written(tmp_path, adaptive_gripper())
    robot = load_robot(path, 0)
    names = list(robot.model.position_names)
    rest = settled(robot)
    assert has_passive_loops(robot)
    assert abs(rest.q[names.index("coupler_q")]) < 0.01  # [rad] a limit yields in steps; the start was 0.075 away
    result = plan(path, goals={"driver": 0.6}, out=tmp_path / "out")
    assert result.success, result
    assert abs(result.solution.xs[-1][names.index("driver_q")] - 0.6) < 1e-6


@pytest.mark.slow
def test_a_goal_on_the_other_side_of_a_dead_point_is_refused_or_reached(tmp_path):
    """The rocker of this crank and rocker turns by less than 2.5 rad, and a plan to elsewhere is not a success."""
    bar = '<inertial pos="0 0 0.1" mass="0.3" diaginertia="1e-3 1e-3 1e-4"/>'
    text = (
        '<mujoco model="crank"><compiler angle="radian"/><worldbody><body name="crank">'
        f'<joint name="crank" axis="0 1 0" damping="0.02"/>{bar}'
        f'<body name="coupler" pos="0 0 0.2"><joint name="elbow" axis="0 1 0"/>{bar}</body></body>'
        f'<body name="rocker" pos="0.5 0 0"><joint name="rocker" axis="0 1 0"/>{bar}</body></worldbody><equality>'
        '<connect body1="coupler" body2="rocker" anchor="0.5 0 0.1"/></equality><actuator>'
        '<motor name="m" joint="crank" ctrlrange="-5 5"/></actuator></mujoco>'
    )
    path = written(tmp_path, text)
    assert plan(path, goals={"rocker": -0.5}, out=tmp_path / "near").success
    for goal in (-2.5, 1.5):
        with pytest.raises(DrakeDiffError, match=r"no plan could be tried|no posture near the start"):
            plan(path, goals={"rocker": goal}, out=tmp_path / "far")

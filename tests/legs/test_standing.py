"""Tests of standing robots: contact forces, refused postures, and a plan with the feet on the ground."""

import numpy as np
import pytest
from helpers.models import robot_file
from helpers.table import each_row, slow_after
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

import drake_diff as dd
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError, ModelError
from drake_diff.legs.feet import Legs, find_feet
from drake_diff.legs.standing import Shift, hold, ranges, shift_to, stand_at_rest, standing_posture
from drake_diff.model.contact import contacts_of_the_step
from drake_diff.model.step import advance
from drake_diff.model.tangent import tangent_space
from drake_diff.motion import TVLQR
from drake_diff.optimize.guess import first_guess
from drake_diff.planning import plan
from drake_diff.planning.robot import GROUND, ON_FEET, load_robot

pytestmark = [pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning"), pytest.mark.solve]
G = 9.81
HIPS = {"fl": (0.2, 0.1), "fr": (0.2, -0.1), "hl": (-0.2, 0.1), "hr": (-0.2, -0.1)}


def body(name, mass, centre, shape=""):
    box = f'<inertia ixx="{mass / 50}" iyy="{mass / 50}" izz="{mass / 50}" ixy="0" ixz="0" iyz="0"/>'
    inertial = f'<inertial><origin xyz="{centre}"/><mass value="{mass}"/>{box}</inertial>'
    return f'<link name="{name}">{inertial}{shape}</link>'


def sphere(place, radius):
    return f'<collision><origin xyz="{place}"/><geometry><sphere radius="{radius}"/></geometry></collision>'


def quadruped(*, load="0 0 0", effort=60.0, foot=True, trunk=10.0, bottom=0.05):
    """Return the URDF of a 10 kg trunk, centred at `load`, on four ball-footed legs of 0.2 + 0.2 m and 1 kg each."""
    text = '<robot name="table">' + body("trunk", trunk, load, sphere("0 0 0", bottom))
    for leg, (x, y) in HIPS.items():
        text += body(f"{leg}_thigh", 0.5, "0 0 -0.1")
        text += body(f"{leg}_shank", 0.5, "0 0 -0.1", sphere("0 0 -0.2", 0.02) if foot else "")
        for name, parent, child, place in (
            ("hip", "trunk", "thigh", f"{x} {y} 0"),
            ("knee", f"{leg}_thigh", "shank", "0 0 -0.2"),
        ):
            text += f'<joint name="{leg}_{name}" type="revolute"><parent link="{parent}"/><child link="{leg}_{child}"/>'
            text += f'<origin xyz="{place}"/><axis xyz="0 1 0"/>'
            text += f'<limit lower="-2.5" upper="2.5" effort="{effort}" velocity="10"/></joint>'
    return text + "</robot>"


@pytest.fixture
def on_feet(tmp_path):
    def make(**changes):
        path = tmp_path / "table.urdf"
        path.write_text(quadruped(**changes))
        return dd.load_model(path, time_step=0.005, actuators="all", **ON_FEET, **GROUND)

    return make


def legged(model):
    feet = find_feet(model, model.default_state[: model.nq])
    assert not isinstance(feet, Refusal), feet
    return Legs(model, feet, *ranges(model))


def test_four_feet_share_the_weight(on_feet):
    """Check that the forces sum to m g, have no moment about the centre of mass, and are equal by symmetry."""
    robot = legged(on_feet())
    stance = standing_posture(robot, robot.model.default_state[: robot.model.nq])
    total = np.sum(stance.forces, axis=0)
    assert total == pytest.approx([0.0, 0.0, 14 * G], abs=1e-5)  # Clarabel's error may be 1e-8 of the weight
    assert stance.forces[:, 2] == pytest.approx(np.full(4, 14 * G / 4), rel=0.05)  # the trunk is centred to a few mm
    robot.put(stance.q)
    center = robot.model.plant.CalcCenterOfMassPositionInWorld(robot.model.double.context)
    moment = np.sum(np.cross(stance.points - center, stance.forces), axis=0)
    assert moment == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)


def test_forces_of_a_load_off_the_middle_obey_the_lever(on_feet):
    """The trunk's centre is 0.1 m to the front. Moments about the line of the hind feet give the front feet's load."""
    robot = legged(on_feet(load="0.1 0 0"))
    model = robot.model
    stance = hold(robot, model.default_state[: model.nq] + np.eye(model.nq)[robot.base_q + 6] * 0.4)
    front = stance.forces[stance.points[:, 0] > 0, 2].sum()
    assert front == pytest.approx((10 * G * 0.3 + 4 * G * 0.2) / 0.4, rel=1e-6)


def test_the_centre_of_mass_has_to_be_over_the_feet(on_feet):
    """Check that a robot falls if its centre of mass is outside the feet's rectangle, and stands if it is inside.

    With straight legs, motors carry little. A tenth of an even share per foot takes a twentieth off the half widths.
    """
    random, seen = np.random.default_rng(0), {True: 0, False: 0}
    for load in random.uniform([-0.4, -0.2], [0.4, 0.2], (24, 2)):
        robot = legged(on_feet(load=f"{load[0]} {load[1]} 0", effort=500))
        q = robot.model.default_state[: robot.model.nq] + np.eye(robot.model.nq)[robot.base_q + 6] * 0.42
        part = float(np.max(np.abs(load * 10 / 14) / [0.2, 0.1]))  # relative to the half widths
        held = not isinstance(hold(robot, q), Refusal)
        if part > 1 or part < 0.9:
            assert held == (part < 1), (load, part)
            seen[held] += 1
    assert min(seen.values()) > 5


@each_row(
    "change, why",
    [
        ({"load": "0.9 0 0", "trunk": 60.0}, "no contact forces"),  # outside the feet, wherever legs of 0.4 m put them
        ({"effort": 0.5}, "no contact forces"),  # a fourth of 14 kg on a bent knee needs a few N m
        ({"foot": False}, "has no collision shape|end in a sphere"),
        ({"bottom": 0.6}, "not at the end of a limb"),  # the trunk lies on the ground
    ],
)
def test_what_cannot_stand_is_refused_with_the_reason(change, why, on_feet):
    model = on_feet(**change)
    found = stand_at_rest(model, *ranges(model))
    assert isinstance(found, Refusal)
    assert any(part in found.reason for part in why.split("|")), found.reason


def test_at_rest_the_step_changes_nothing_and_drake_carries_the_weight(on_feet):
    """Check that a step keeps the robot at rest and that Drake's own contact forces carry the weight."""
    model = on_feet()
    robot, rest = stand_at_rest(model, *ranges(model))
    x = np.array(advance(model.double, rest.x, rest.u))
    forces = sum(contact.force for contact in contacts_of_the_step(model))
    assert forces == pytest.approx([0.0, 0.0, 14 * G], abs=0.05)  # 1e-4 m/s per step of 5 ms is 14 kg * 0.02 m/s^2
    assert np.max(np.abs(x[model.nq :])) < 5e-3  # the threshold of rest
    assert {contact.body_a for contact in contacts_of_the_step(model)} == {f"{leg}_shank" for leg in HIPS}
    assert np.max(np.abs(robot.points_in(rest.x[: model.nq])[:, 2])) < 1e-3


def test_a_frame_and_a_joint_go_where_they_are_asked_to(on_feet):
    """Check by Drake's kinematics of the last state. A shift that legs with fixed feet cannot make is refused."""
    model = on_feet()
    robot, rest = stand_at_rest(model, *ranges(model))
    frame, context = model.plant.GetFrameByName("trunk"), model.plant.CreateDefaultContext()
    lower = rest.x[robot.base_q + 4 : robot.base_q + 7] - np.array([0.01, 0.0, 0.01])
    found = shift_to(robot, rest, {"trunk": lower}, {})
    assert isinstance(found, Shift), found
    model.plant.SetPositions(context, found.xs[-1][: model.nq])
    assert frame.CalcPoseInWorld(context).translation() == pytest.approx(lower, abs=5e-4)
    knee = model.position_names.index("fl_knee_q")
    found = shift_to(robot, rest, {}, {knee: rest.x[knee] + 0.05})
    assert isinstance(found, Shift), found
    assert found.xs[-1][knee] == pytest.approx(rest.x[knee] + 0.05, abs=2e-3)
    sideways = shift_to(robot, rest, {"trunk": lower + np.array([0.0, 0.1, 0.0])}, {})
    assert isinstance(sideways, Refusal)  # legs of two joints about y keep the trunk in its plane


def test_a_robot_stands_by_one_call_on_soft_feet(on_feet):
    """Drake's own contact carries the weight, at a depth of 0.0625 m/s times the step."""
    robot = dd.legs.stand(on_feet())
    after = np.array(advance(robot.model.double, robot.x0, robot.u))
    contacts = contacts_of_the_step(robot.model)
    assert after == pytest.approx(robot.x0, abs=1e-7)
    assert {contact.body_a for contact in contacts} == set(robot.feet)
    assert sum(contact.force for contact in contacts) == pytest.approx([0.0, 0.0, 14 * G], abs=1e-3)
    assert np.mean([contact.depth for contact in contacts]) == pytest.approx(0.0625 * 0.005, rel=1e-3)
    with pytest.raises(InputError, match=r"legs.stand: model.*no contact forces"):
        dd.legs.stand(on_feet(effort=0.5))


def test_no_foot_lifts_off_in_a_fast_motion(on_feet):
    """A step of h adds h^2 w^2 l / 2 to the height of a foot of a leg l that turns by w, more than light feet sink."""
    model = on_feet(effort=500, trunk=1.0)
    robot, rest = stand_at_rest(model, *ranges(model))
    lower = rest.x[robot.base_q + 4 : robot.base_q + 7] - np.array([0.01, 0.0, 0.14])
    found = shift_to(robot, rest, {"trunk": lower}, {})
    assert isinstance(found, Shift), found
    for x, u in zip(found.xs[:-1], found.us, strict=True):
        advance(model.double, x, u)
        assert {contact.body_a for contact in contacts_of_the_step(model)} == {f"{leg}_shank" for leg in HIPS}


def test_a_standing_robot_is_regulated_until_its_motion_ends(on_feet):
    """A regulator without a weight on the last state lets go in the last tenth of a second, and the robot falls."""
    model = on_feet()
    robot, rest = stand_at_rest(model, *ranges(model))
    found = shift_to(robot, rest, {"trunk": rest.x[robot.base_q + 4 : robot.base_q + 7] - [0.01, 0.0, 0.1]}, {})
    assert isinstance(found, Shift), found
    speeds = np.max(np.abs(found.xs[:, model.nq :]), axis=1)
    assert speeds[-1] < 2 * speeds[-20]


def antenna(*, limits, stiffness=0):
    """Return the quadruped as a URDF with a hinged rod on its trunk."""
    ends = '<frame name="a" link="trunk"/><frame name="b" link="rod"/><drake:linear_bushing_rpy>'
    ends += '<drake:bushing_frameA name="a"/><drake:bushing_frameC name="b"/>'
    ends += f'<drake:bushing_torque_stiffness value="0 {stiffness} 0"/>'
    for zero in ("torque_damping", "force_stiffness", "force_damping"):
        ends += f'<drake:bushing_{zero} value="0 0 0"/>'
    spring = f"{ends}</drake:linear_bushing_rpy>" if stiffness else ""
    hinge = '<joint name="antenna" type="revolute"><parent link="trunk"/><child link="rod"/><axis xyz="0 1 0"/>'
    more = body("rod", 0.2, "0 0 0.1") + f'{hinge}<limit {limits} effort="5" velocity="9"/></joint>{spring}</robot>'
    return quadruped().replace("</robot>", more).replace("<robot ", '<robot xmlns:drake="http://drake.mit.edu" ')


def test_a_standing_robot_with_a_locked_joint_moves(tmp_path):
    """Drake holds the joint to about 1e-6, which is not beyond its limits."""
    path = tmp_path / "table.urdf"
    path.write_text(antenna(limits='lower="0.1" upper="0.1"'))
    model = dd.load_model(path, time_step=0.005, actuators="all", **ON_FEET, **GROUND)
    robot, rest = stand_at_rest(model, *ranges(model))
    found = shift_to(robot, rest, {"trunk": rest.x[robot.base_q + 4 : robot.base_q + 7] - [0.0, 0.0, 0.05]}, {})
    assert isinstance(found, Shift), found
    assert 0 < np.max(np.abs(found.xs[:, model.position_names.index("antenna_q")] - 0.1)) < 1e-4


@pytest.mark.parametrize("name", slow_after(1, ["panda.urdf", "iris.urdf", "allegro_left_hand.urdf", "kinova.urdf"]))
def test_an_arm_a_hand_and_a_drone_have_no_feet(name):
    model = dd.load_model(robot_file(name), time_step=0.005, actuators="all", mimic="reduce", **ON_FEET, **GROUND)
    assert isinstance(find_feet(model, model.default_state[: model.nq]), Refusal)


def test_what_cannot_stand_is_held_and_the_reason_is_told(tmp_path):
    path = tmp_path / "weak.urdf"
    path.write_text(quadruped(effort=0.5))
    robot = load_robot(path, 0)
    assert robot.standing is None
    assert any("base='weld'" in told and "it cannot stand: no contact forces" in told for told in robot.repairs)
    path.write_text(quadruped())
    assert any("base='free'" in told for told in load_robot(path, 0).repairs)


@pytest.mark.parametrize(("stiffness", "step"), [(300.0, 0.002), (1e6, 0.005)])
def test_a_spring_of_a_standing_robot_is_resolved_or_named(stiffness, step, tmp_path):
    path = tmp_path / "table.urdf"
    path.write_text(antenna(limits='lower="-1" upper="1"', stiffness=stiffness))
    robot = load_robot(path, 0)
    assert robot.standing is not None, robot.repairs
    assert robot.model.time_step == step
    assert sum("antenna" in repair and "spring" in repair for repair in robot.repairs) == 1


def test_a_robot_may_touch_the_ground_and_not_itself(tmp_path):
    path = tmp_path / "table.urdf"
    path.write_text(quadruped())
    options = {"time_step": 0.01, "ground": True}
    every, ground = (dd.load_model(path, contact=contact, **options).contract.contact for contact in (True, "ground"))
    assert ground.collision_pairs == 5  # a trunk and four feet
    assert every.collision_pairs > ground.collision_pairs
    with pytest.raises(InputError, match="ground"):
        dd.load_model(path, contact="floor", **options)


def test_the_law_of_contact_can_be_told_where_the_file_does_not(tmp_path):
    """Check the near-rigid option, whose threshold hides the sinkage m g / k of light bodies at long steps."""
    path = tmp_path / "table.urdf"
    path.write_text(quadruped())
    model = dd.load_model(path, time_step=0.01, near_rigid=0.1, relaxation_time=0.02)
    assert model.contract.contact.sap_near_rigid_threshold == 0.1
    assert model.changed(time_step=0.005).contract.contact.sap_near_rigid_threshold == 0.1
    for wrong in ({"near_rigid": 0}, {"relaxation_time": -1.0}):
        with pytest.raises(InputError, match="above 0"):
            dd.load_model(path, time_step=0.01, **wrong)


def test_a_range_of_a_quaternion_is_that_of_the_turn(on_feet):
    """When a body turns by a small angle, its unit quaternion changes by half of this angle."""
    model = on_feet()
    space, x = tangent_space(model), model.default_state
    turn = np.zeros(space.size)
    turn[[0, 3]] = 1e-3, 0.2
    ranges_of_x = np.ptp([x, space.plus(x, turn)], axis=0)
    assert space.scale(ranges_of_x)[[0, 1, 2, 3, 4]] == pytest.approx([1e-3, 1e-3, 1e-3, 0.2, 0.0], rel=1e-6)


@pytest.mark.slow
def test_solo12_lowers_its_trunk_with_its_feet_on_the_ground(tmp_path):
    """Check feet and trunk by a plant of the original file, over a replay at half the time step."""
    file = robot_file("solo12.urdf")
    done = plan(file, out=tmp_path / "out")
    assert done.success, done.lines
    assert any("base='free'" in told for told in done.repairs)
    solution, model = done.solution, done.model
    half = model.at_time_step(model.time_step / 2)
    xs, us = solution.plan.sample(2)
    weights = np.eye(half.nu), np.eye(tangent_space(half).size)
    policy = TVLQR(half, xs, us, 100 * weights[1], weights[0])
    motion = dd.rollout(half, xs[0], policy=policy, num_steps=len(us))
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(file))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    feet = [plant.GetFrameByName(f"{leg}_FOOT") for leg in ("FL", "FR", "HL", "HR")]

    def poses(x):
        plant.SetPositions(context, x[: plant.num_positions()])
        return [frame.CalcPoseInWorld(context) for frame in feet]

    first = poses(motion.xs[0])
    for x in motion.xs:  # a ball rolls as far as it turns, and its centre moves with it
        for pose, begun in zip(poses(x), first, strict=True):
            turned = (begun.rotation().inverse() @ pose.rotation()).ToAngleAxis().angle()
            radius = begun.translation()[2]  # [m] from the centre of the ball to the ground, 16 mm
            off = np.max(np.abs(pose.translation() - begun.translation()))
            assert off < radius * turned + 5e-4  # [m] a foot slips by less than half a millimetre
    trunk = [motion.xs[0][6], solution.xs[-1][6], motion.xs[-1][6]]
    assert trunk[0] - trunk[1] > 0.003  # the trunk is lowered
    assert trunk[2] == pytest.approx(trunk[1], abs=1e-3)
    assert np.max(np.abs(motion.xs[-1][model.nq :])) < 0.05  # [rad/s, m/s] at rest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["go2.urdf", "solo12.urdf"])
def test_a_trunk_goes_where_it_is_asked_to(name, tmp_path):
    """The feet of go2 are meshes of many spheres, from one of which to the next they roll. Solo12 has no joint limits.

    The trunk is lowered by 15 % and moved by 5 % of its height.
    """
    file = robot_file(name)
    start = load_robot(file, 0)
    plant, q = start.model.plant, start.standing[1].x[: start.model.nq]
    (base,) = plant.GetFloatingBaseBodies()
    context, trunk = plant.CreateDefaultContext(), plant.get_body(base)
    plant.SetPositions(context, q)
    goal = trunk.EvalPoseInWorld(context).translation() * [1, 1, 0.85]
    goal[:2] += 0.05 * goal[2]
    done = plan(file, goals={trunk.name(): goal.tolist()}, out=tmp_path / "out")
    assert done.success, done.lines
    assert len(done.model.plant.GetFloatingBaseBodies()) == 1
    plant.SetPositions(context, done.solution.xs[-1][: start.model.nq])
    assert trunk.EvalPoseInWorld(context).translation() == pytest.approx(goal, abs=1e-3)


def test_a_base_that_was_fixed_and_a_least_time_on_feet_are_refused_with_the_reason(tmp_path):
    """The planner does not fix a trunk to reach its goal."""
    file = robot_file("simple_humanoid.urdf")
    with pytest.raises(InputError, match=r"goal base_link.*it cannot stand"):
        plan(file, goals={"base_link": [0, 0, 0.5]}, out=tmp_path / "out")
    with pytest.raises(InputError, match=r"time.*on its feet"):
        plan(robot_file("solo12.urdf"), time="least", out=tmp_path / "out")
    with pytest.raises(ModelError, match=r"no other posture.*the feet would have to move"):
        plan(robot_file("solo12.urdf"), goals={"base_link": [0, 0, 3.0]}, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_standing_robot_is_held_by_the_default_guess():
    """Without inputs, Solo12 falls, and a search from there ends with the trunk a quarter of a metre off its goal."""
    robot = load_robot(robot_file("solo12.urdf"), 0)
    model, x0 = robot.model, robot.standing[1].x
    effort = dd.QuadraticCost(R=np.eye(model.nu))
    fallen = np.array(advance(model.double, x0, np.zeros(model.nu)))
    assert np.max(np.abs(fallen[model.nq :])) > 0.1
    guess = first_guess(dd.Problem(model, x0=x0, num_steps=20, running_cost=effort), "ilqr", None, 0)
    assert np.max(np.abs(np.array(advance(model.double, x0, guess.us[0]))[model.nq :])) < 1e-6  # [rad/s, m/s] rounding
    motion = dd.rollout(model, x0, guess.us)
    assert np.max(np.abs(motion.xs[-1] - x0)) < 1e-4
    lifted = x0 + 0.1 * np.eye(model.nx)[6]  # in the air, nothing holds it
    free = first_guess(dd.Problem(model, x0=lifted, num_steps=20, running_cost=effort), "ilqr", None, 0)
    assert not np.any(free.us)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["solo12", "a1"])
def test_a_robot_on_its_feet_is_lowered_by_a_plain_cost(name):
    """For A1, the least cost is at a jump, where a foot lifts off. The plan is then near the first guess."""
    options = {"base": "free", "ground": True, "contact": "ground", "actuators": "all", "time_step": 0.01}
    file = robot_file(f"{name}.urdf")
    robot = dd.legs.stand(dd.load_model(file, meshes="spheres", contact_geometry="corner_spheres", **options))
    model, z = robot.model, 6
    lower = robot.x0 - 0.04 * np.eye(model.nx)[z]
    weights = np.zeros(model.nx)
    weights[:4], weights[4:7], weights[model.nq :] = 10.0, 100.0, 0.01
    inputs = 1e-3 / np.max(np.abs(robot.u)) ** 2 * np.eye(model.nu)
    running = dd.QuadraticCost(Q=np.diag(weights), R=inputs, x_ref=lower)
    final = dd.QuadraticCost(Q=10 * np.diag(weights), x_ref=lower)
    solution = dd.solve(dd.Problem(model, x0=robot.x0, num_steps=50, running_cost=running, final_cost=final))
    assert solution.success, solution.message
    assert np.linalg.norm((solution.xs[-1] - lower)[4:7]) < 1e-3  # [m]
    assert solution.options["chain"][-1]["method"] == "ilqr"
    assert any("not an optimum" in note for note in solution.notes) == (name == "a1")

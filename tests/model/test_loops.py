"""Tests of loops, which <connect>, <weld> or a joint of SDF closes by constraining points of two bodies."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
from helpers.linkages import LEG
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.model.assembly import gap
from drake_diff.planning import plan

L, WIDTH, MASS, BAR = 0.3, 0.4, 0.7, 0.5  # [m, m, kg, kg] a parallelogram: two equal cranks and the bar between them
G = 9.81


def load(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return dd.load_model(path, **{"time_step": 0.001, **options})


def parallelogram(tmp_path, equality=None, more=""):
    """Write a parallelogram of cranks that hang down from two hinges; the bar is the first crank's child."""
    rod = f'<inertial pos="0 0 {-L / 2}" mass="{MASS}" diaginertia="{MASS * L**2 / 12} {MASS * L**2 / 12} 1e-4"/>'
    bar = f'<inertial pos="{WIDTH / 2} 0 0" mass="{BAR}" diaginertia="1e-4 0.01 0.01"/>'
    equality = equality or f'<connect body1="bar" body2="second" anchor="{WIDTH} 0 0"/>'
    path = tmp_path / "loop.xml"
    path.write_text(
        f'<mujoco model="loop"><worldbody><body name="first" pos="0 0 1"><joint name="a" axis="0 1 0"/>{rod}'
        f'<body name="bar" pos="0 0 {-L}"><joint name="b" axis="0 1 0"/>{bar}'
        f'<site name="end" pos="{WIDTH} 0 0"/></body></body>'
        f'<body name="second" pos="{WIDTH} 0 1"><joint name="c" axis="0 1 0"/>{rod}<site name="tip" pos="0 0 {-L}"/>'
        f"</body>{more}</worldbody><equality>{equality}</equality>"
        '<actuator><motor name="m" joint="a" ctrlrange="-9 9"/></actuator></mujoco>'
    )
    return path


SDF_LINK = (
    '<link name="{}"><pose>{} 0 0 0</pose><inertial><pose>0.1 0 0.1 0 0 0</pose><mass>0.4</mass><inertia>'
    "<ixx>0.01</ixx><iyy>0.01</iyy><izz>0.01</izz></inertia></inertial></link>"
)


def scaled(text, scale):
    """Return the text of an SDF file with the positions of its poses multiplied by `scale`."""

    def pose(match):
        numbers = [float(word) * (scale if i < 3 else 1.0) for i, word in enumerate(match[2].split())]
        return f"<pose{match[1]}>{' '.join(map(str, numbers))}</pose>"

    return re.sub(r"<pose([^>]*)>([^<]*)</pose>", pose, text)


def sdf(tmp_path, kind="revolute", effort="0", expressed=""):
    """Write a four-bar linkage. The hinges of its crank and its rocker are at 1 m height."""
    axis = f"<axis><xyz{expressed}>0 1 0</xyz><limit><effort>{{}}</effort></limit></axis>"

    def joint(name, parent, child, effort, kind="revolute", pose=""):
        return (
            f'<joint name="{name}" type="{kind}">{pose}<parent>{parent}</parent><child>{child}</child>'
            f"{axis.format(effort)}</joint>"
        )

    links = SDF_LINK.format("crank", "0 0 1") + SDF_LINK.format("bar", "0 0 1.2") + SDF_LINK.format("rocker", "0.5 0 1")
    path = tmp_path / "loop.sdf"
    closing = joint("last", "bar", "rocker", effort, kind, '<pose relative_to="rocker">0 0 0.3 0 0 0</pose>')
    path.write_text(
        f'<sdf version="1.9"><model name="loop">{links}{joint("j", "world", "crank", 5)}'
        f"{joint('k', 'crank', 'bar', 0)}{joint('l', 'world', 'rocker', 0)}{closing}</model></sdf>"
    )
    return path


def gaps(model, x):
    """Return the distances [m] between the points of each pair."""
    plant, context = model.plant, model.plant.CreateDefaultContext()
    plant.SetPositions(context, x[: model.nq])
    return [
        np.linalg.norm(np.subtract(*(plant.EvalBodyPoseInWorld(context, plant.get_body(i)) @ p for i, p in ends)))
        for ends in (zip(pair.bodies, pair.points, strict=True) for pair in model.file_facts.held_points)
    ]


@each_row(
    "equality",
    [
        None,
        '<connect site1="end" site2="tip"/>',
        f'<connect body1="second" body2="bar" anchor="0 0 {-L}"/>',
        f'<connect body1="bar" body2="second" anchor="{WIDTH} 0 0"/><connect body1="bar" active="false"/>',
    ],
)
def test_a_parallelogram_swings_as_a_pendulum(tmp_path, equality):
    """The cranks turn by one angle and the bar by none: (2 m L^2 / 3 + M L^2) a = u - (m + M) g L sin(angle).

    The constraint is nearly rigid: Drake's compliance changes the motion by (0.1 / 2 pi)^2 = 2.5e-4.
    """
    model = load(parallelogram(tmp_path, equality))
    angle, u = 0.4, 1.5
    x = np.array([angle, -angle, angle, 0.0, 0.0, 0.0])
    x[:3] *= -1  # a positive turn about y moves a hanging body to -x
    assert max(gaps(model, x)) < 1e-12
    end = dd.step(model, x, [u])
    wanted = (u + (MASS + BAR) * G * L * np.sin(angle)) / (2 * MASS * L**2 / 3 + BAR * L**2)
    np.testing.assert_allclose(end[3:] / model.time_step, np.array([1, -1, 1]) * wanted, rtol=5e-4)
    certificate = dd.certify(model, x + 0.01, [u])
    certificate.require()
    assert "solved to rounding" in str(certificate)


@each_row(
    "connect, moves",
    [
        (
            '<connect body1="first" anchor="0 0 -0.1"/>',
            False,
        ),  # Drake aborts on a ball constraint with the world body
        ('<connect body1="first" body2="world" anchor="0 0 -0.1"/>', False),
        ('<connect body1="first" body2="world" anchor="0 0 -0.1" active="false"/>', True),
    ],
)
def test_a_body_is_held_at_the_world(tmp_path, connect, moves):
    model = load(parallelogram(tmp_path, connect), gravity=[0, 0, 0])
    assert model.num_constraints == (0 if moves else 1)
    x = dd.step(model, np.zeros(6), [1.0])
    assert (abs(x[3]) > 1e-3) == moves
    dd.certify(model, x, [1.0]).require()


def test_a_gap_closes_within_some_steps(tmp_path):
    """The constraint halves the gap in each step."""
    model = load(parallelogram(tmp_path), gravity=[0, 0, 0])
    x = np.array([0.0, 0.01, 0, 0, 0, 0])
    before = max(gaps(model, x))
    assert before == pytest.approx(0.01 * WIDTH, rel=1e-3)
    for _ in range(20):
        x = dd.step(model, x, [0.0])
    assert max(gaps(model, x)) < 1e-3 * before


@each_row("kind", ["revolute", "ball", "fixed"])
def test_a_joint_of_sdf_that_closes_a_loop_holds(tmp_path, kind):
    """With a weld nothing can move; with the other joints the crank turns. Every derivative is right."""
    model, x = load(sdf(tmp_path, kind), time_step=0.005), np.zeros(6)
    for _ in range(40):
        x = dd.step(model, x, [0.2])
    assert max(gaps(model, x)) < 1e-4  # a step of 5 ms at 2 rad/s opens a gap of (0.01 rad)^2 0.5 m / 2
    assert (abs(x[0]) > 0.02) == (kind != "fixed")
    dd.certify(model, x, [1.0]).require()


def test_ends_of_a_joint_of_sdf_are_frames_or_links_of_a_nested_model(tmp_path):
    """The same four-bar with its rocker in a nested model and a closing joint between frames has the same motion."""
    plain = sdf(tmp_path)
    text = plain.read_text()
    rocker = SDF_LINK.format("rocker", "0.5 0 1")
    tip = '<frame name="tip" attached_to="arm"><pose>0 0 0.3 0 0 0</pose></frame><frame name="arm" attached_to="side"/>'
    text = text.replace(rocker, f'<model name="inner">{rocker}</model><frame name="side" attached_to="inner::rocker"/>')
    text = text.replace("<child>rocker</child>", "<child>inner::rocker</child>", 1)
    text = text.replace('<pose relative_to="rocker">0 0 0.3 0 0 0</pose>', "")
    text = text.replace("<child>rocker</child>", "<child>tip</child>").replace("</model></sdf>", f"{tip}</model></sdf>")
    nested = tmp_path / "nested.sdf"
    nested.write_text(text)
    ends = []
    for path in (plain, nested):
        model, x = load(path, time_step=0.005), np.zeros(6)
        for _ in range(20):
            x = dd.step(model, x, [0.2])
        ends.append(x)
    assert ends[0] == pytest.approx(ends[1], abs=1e-9)  # rounding, as both are one mechanism
    assert abs(ends[0][0]) > 0.005
    lost = tmp_path / "lost.sdf"
    lost.write_text(text.replace("<parent>bar</parent>", "<parent>inner::bar</parent>"))
    with pytest.raises(ModelError, match="inner::bar"):
        load(lost)


@each_row(
    "options, words",
    [
        ({"kind": "prismatic"}, "line 1: the joint last closes a loop: expected one of ball"),
        ({"effort": "3"}, "has a motor: drive another joint"),
        ({"expressed": ' expressed_in="crank"'}, "expected its axis in its own frame"),
    ],
)
def test_a_loop_that_points_cannot_hold_is_refused(tmp_path, options, words):
    with pytest.raises(ModelError, match=words):
        load(sdf(tmp_path, **options))


@pytest.mark.parametrize("fixed", [(), ("c",)])
def test_points_coincide_in_the_pose_of_the_file_wherever_the_robot_starts(tmp_path, fixed):
    """The points do not change if a .dmd.yaml sets initial angles of 0.4 rad, or if a joint is fixed at that angle."""
    moved = tmp_path / "moved.dmd.yaml"
    moved.write_text(
        "directives:\n- add_model:\n    name: loop\n    file: file://"
        f"{parallelogram(tmp_path)}\n    default_joint_positions: {{a: [0.4], b: [-0.4], c: [0.4]}}\n"
    )
    model, plain = load(moved, fix_joints=fixed), load(parallelogram(tmp_path))
    ends = [model.file_facts.held_points[0].points, plain.file_facts.held_points[0].points]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)
    np.testing.assert_allclose(ends[1], [[WIDTH, 0, 0], [0, 0, -L]], atol=1e-12)
    assert max(gaps(model, model.default_state)) < 1e-12


@each_row("relpose", ["", 'relpose="0.3 0 0.1 0.8 0 0.6 0"', 'relpose="0.356 0 -0.092 0.8 0 0.6 0" anchor="0.2 0 0"'])
def test_a_weld_holds_a_body_in_its_pose(tmp_path, relpose):
    """The body is welded to another body. A relpose that differs from the file's pose applies, as in MuJoCo."""
    free = (
        '<body name="free" pos="0.2 0.1 0.5"><freejoint/><geom size="0.1" mass="1" contype="0" conaffinity="0"/></body>'
    )
    weld = f'<weld body1="first" body2="free" {relpose}/><connect body1="second" anchor="0 0 0.1"/>'
    model = load(parallelogram(tmp_path, weld, free), gravity=[0, 0, 0])
    x = dd.model.assembled(model, model.default_state)
    plant, context = model.plant, model.plant.CreateDefaultContext()
    plant.SetPositions(context, x[: model.nq])
    first, body = (plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(name)) for name in ("first", "free"))
    pose = first.InvertAndCompose(body)
    wanted = [0.3, 0, 0.1] if relpose else [0.2, 0.1, -0.5]
    np.testing.assert_allclose(pose.translation(), wanted, atol=1e-8)
    np.testing.assert_allclose(
        pose.rotation().ToQuaternion().wxyz(), [0.8, 0, 0.6, 0] if relpose else [1, 0, 0, 0], atol=1e-8
    )


def test_the_motion_is_mujoco_s(tmp_path):
    """Both move for 0.5 s under a torque. MuJoCo's constraint is soft, so the angles agree within 5 mrad."""
    mujoco = pytest.importorskip("mujoco")
    path = parallelogram(
        tmp_path,
        f'<connect body1="bar" body2="second" anchor="{WIDTH} 0 0" solref="0.002 1" solimp="0.9999 0.9999 0.001"/>',
    )
    model, other = load(path), mujoco.MjModel.from_xml_path(str(path))
    other.opt.timestep = model.time_step
    data, x = mujoco.MjData(other), np.zeros(6)
    data.ctrl = 3.0
    for _ in range(500):
        mujoco.mj_step(other, data)
        x = dd.step(model, x, [3.0])
    assert abs(x[0]) > 0.3
    np.testing.assert_allclose(x[:3], data.qpos, atol=5e-3)


def test_other_points_than_the_plants_are_noticed(tmp_path):
    """The equation that is solved to rounding then is not Drake's, and the certificate stays undecided."""
    model = load(parallelogram(tmp_path))
    pair = model.file_facts.held_points[0]
    model.file_facts.held_points[0] = dataclasses.replace(pair, points=[pair.points[0], pair.points[1] + 1e-4])
    certificate = dd.certify(model, np.full(6, 0.1), [1.0])
    assert certificate.verdict == "undecided"
    assert "the equation is not Drake's" in str(certificate)


def test_loops_are_closed_from_a_posture_nearby(tmp_path):
    """The other joints follow those in `keep`. An error is raised if `keep` leaves the bar out of reach."""
    model = load(parallelogram(tmp_path))
    x = dd.model.assembled(model, [0.5, 0.0, 0.0, 1.0, 2.0, 3.0], keep=["a_q"])
    np.testing.assert_allclose(x, [0.5, -0.5, 0.5, 1.0, 2.0, 3.0], atol=1e-7)
    with pytest.raises(ModelError, match=r"loops cannot be closed from x, in which points are 0\.\d+ m apart"):
        dd.model.assembled(model, [0.5, 0.0, 0.0, 0, 0, 0], keep=["a_q", "b_q", "c_q"])
    with pytest.raises(UnknownNameError, match="position to keep"):
        dd.model.assembled(model, x, keep=["crank"])
    with pytest.raises(InputError, match=r"x0: expected closed loops, .*got 0\.\d+ m between two points"):
        dd.Problem(model, x0={"a_q": 0.5}, x_goal={"a_q": 0.6}, num_steps=10)


def test_what_floats_beside_a_loop_is_left_alone(tmp_path):
    """Joints keep their limits and their places in q, which also contains the quaternion of the box."""
    box = '<body name="box" pos="0 0 3"><freejoint/><geom size="0.1" mass="1"/></body>'
    path = parallelogram(tmp_path, more=box)
    path.write_text(path.read_text().replace('name="a"', 'name="a" range="-60 60"'))
    model = load(path)
    x = np.array(model.default_state)
    a, b = (model.position_names.index(name) for name in ("a_q", "b_q"))
    x[a] = 0.2
    near = dd.model.assembled(model, x, keep=["a_q"])
    assert (near[a], near[b]) == (0.2, pytest.approx(-0.2, abs=1e-7))
    box_entries = [i for i, name in enumerate(model.position_names) if name.startswith("box")]
    np.testing.assert_array_equal(near[box_entries], x[box_entries])
    bounds = dd.Problem(model, x0=model.default_state, num_steps=5, x_goal={"a_q": 0.3}).bounds
    assert bounds.x_upper[a] == pytest.approx(np.pi / 3)
    assert bounds.x_upper[b] == np.inf


def test_points_at_the_origins_of_their_bodies_can_be_held(tmp_path):
    """The distance of such points from the bodies' origins is zero, so a gap cannot be compared with it."""
    sites = '<body name="end" pos="{} 0 {}"><site name="{}"/></body>'
    path = parallelogram(tmp_path, '<connect site1="p" site2="s"/>')
    text = path.read_text().replace(f'<site name="end" pos="{WIDTH} 0 0"/>', sites.format(WIDTH, 0, "p"))
    path.write_text(text.replace(f'<site name="tip" pos="0 0 {-L}"/>', sites.format(0, -L, "s").replace("end", "tip")))
    model = load(path)
    x = dd.model.assembled(model, [0.5, 0.0, 0.0, 0, 0, 0], keep=["a_q"])
    np.testing.assert_allclose(x[:3], [0.5, -0.5, 0.5], atol=1e-7)


@each_row(
    "equality, words",
    [
        (
            '<connect body1="bar" body2="nobody" anchor="0 0 0"/>',
            "expected a body of loop to connect, got the unknown name nobody",
        ),
        ('<weld site1="end" site2="tip"/>', "line 1: expected a <connect> of two sites"),
        ('<connect site1="inner" site2="tip"/>', "line 1: expected sites on bodies or frames that have a name"),
    ],
)
def test_what_cannot_be_held_is_refused_by_name(tmp_path, equality, words):
    more = '<body name="more"><joint name="d"/><geom size="0.1"/><body pos="1 0 0"><site name="inner"/></body></body>'
    with pytest.raises(ModelError, match=words):
        load(parallelogram(tmp_path, equality, more))


@each_row(
    "head, attributes",
    [
        ('<option><flag equality="disable"/></option>', ""),
        ('<option><flag constraint="disable"/></option>', ""),
        ('<default><default class="off"><equality active="false"/></default></default>', 'class="off"'),
    ],
)
def test_a_loop_that_mujoco_does_not_close_is_open(tmp_path, head, attributes):
    path = parallelogram(tmp_path, f'<connect body1="bar" body2="second" anchor="{WIDTH} 0 0" {attributes}/>')
    path.write_text(path.read_text().replace("<worldbody>", f"{head}<worldbody>"))
    assert load(path).num_constraints == 0


def test_bodies_that_joints_fix_are_held_by_nothing(tmp_path):
    """Drake's step fails with a constraint between two bodies that cannot move."""
    model = load(parallelogram(tmp_path), fix_joints=["a", "b", "c"][1:])
    assert model.num_constraints == 1
    more = '<body name="more"><joint name="d"/><geom size="0.1"/></body>'
    model = load(parallelogram(tmp_path, more=more), fix_joints=["a", "b", "c"])
    assert model.num_constraints == 0
    assert "loops are closed" not in str(model.notes)
    dd.step(model, [0.1, 0.2], [])


def test_an_open_loop_of_a_millimetre_is_refused(tmp_path):
    """The links of the four-bar are 0.3 and 0.4 mm long, and its second crank is displaced by 0.5 rad."""
    path = parallelogram(tmp_path)
    text = path.read_text()
    for length in (f"{-L}", f"{-L / 2}", f"{WIDTH}", f"{WIDTH / 2}"):
        text = text.replace(f' {length}"', f' {float(length) / 1000}"').replace(
            f'"{length} ', f'"{float(length) / 1000} '
        )
    path.write_text(text)
    model = load(path)
    with pytest.raises(InputError, match=r"x0: expected closed loops"):
        dd.Problem(model, x0={"c_q": 0.5}, x_goal={"a_q": 0.6}, num_steps=10)
    x = dd.model.assembled(model, [0.5, 0.0, 0.0, 0, 0, 0], keep=["a_q"])
    np.testing.assert_allclose(x[:3], [0.5, -0.5, 0.5], atol=1e-7)


@each_row("method", ["ilqr", "shooting"])
def test_a_crank_is_moved_by_a_verified_plan(tmp_path, method):
    model = load(parallelogram(tmp_path), time_step=0.01)
    cost = dd.QuadraticCost(R=[[1.0]])
    problem = dd.Problem(model, x0=np.zeros(6), x_goal={"a_q": 0.6, "a_w": 0.0}, num_steps=40, running_cost=cost)
    solution = dd.solve(problem, method=method)
    assert solution.status is dd.Status.CONVERGED, solution.message
    np.testing.assert_allclose(solution.xs[-1][:3], [0.6, -0.6, 0.6], atol=1e-4)
    assert max(max(gaps(model, x)) for x in solution.xs) < 1e-4


def finger(side, outward):
    """Return a finger in MJCF: a driver and a coupler, and a longer link and the finger's root, to be connected."""
    turn = "" if outward > 0 else 'quat="0 0 0 1"'
    light = 'diaginertia="2e-6 2e-6 1e-6"'
    return (
        f'<body name="{side}_driver" pos="0 {0.03 * outward} 0.05" {turn}><inertial pos="0 0.02 0" mass="0.01" {light}'
        f'/><joint name="{side}" axis="1 0 0" range="0 0.8" armature="0.005" damping="0.1"/>'
        f'<body name="{side}_coupler" pos="0 0.03 -0.004"><inertial pos="0 0 0.015" mass="0.014" {light}/>'
        f'<joint name="{side}_c" axis="1 0 0" range="-1.5 0"/></body></body>'
        f'<body name="{side}_link" pos="0 {0.013 * outward} 0.06" {turn}><inertial pos="0 0.02 0.02" mass="0.02" '
        f'{light}/><joint name="{side}_l" axis="1 0 0" range="-0.3 0.8" stiffness="0.05" springref="2.6"/>'
        f'<body name="{side}_root" pos="0 0.055 0.037"><inertial pos="0 -0.01 0.02" mass="0.03" {light}/>'
        f'<joint name="{side}_r" axis="1 0 0" range="-0.9 0.9"/></body></body>'
    )


GRIPPER = (
    '<mujoco model="gripper"><compiler angle="radian"/><worldbody>'
    f'{finger("right", 1)}{finger("left", -1)}</worldbody><tendon><fixed name="split">'
    '<joint joint="right" coef="0.5"/><joint joint="left" coef="0.5"/></fixed></tendon><equality>'
    '<connect anchor="0 0.017 -0.01" body1="right_root" body2="right_coupler"/>'
    '<connect anchor="0 0.017 -0.01" body1="left_root" body2="left_coupler"/><joint joint1="right" joint2="left"/>'
    '</equality><actuator><general name="fingers" tendon="split" forcerange="-5 5" ctrlrange="0 255" '
    'gainprm="0.3137255" biastype="affine" biasprm="0 -100 -10"/></actuator></mujoco>'
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "goals"),
    [
        pytest.param(GRIPPER, {"left": 0.5}, id="gripper", marks=pytest.mark.long),
        pytest.param(LEG, {"hip": 0.4, "drive": -0.3, "rail": 0.05}, id="leg"),
    ],
)
def test_robots_with_loops_are_planned_by_default(tmp_path, text, goals):
    """The robots are a gripper whose servo pulls a tendon of two fingers, and a leg whose knee is moved by a rod."""
    (tmp_path / "robot.xml").write_text(text)
    done = plan(tmp_path / "robot.xml", goals=goals, out=tmp_path / "out")
    assert done.success, done
    q = dict(zip(done.model.position_names, done.solution.xs[-1], strict=False))
    assert all(abs(q[f"{name}_{'x' if name == 'rail' else 'q'}"] - value) < 1e-5 for name, value in goals.items())
    # The constraint yields by 2 h^2 (0.1 / 2 pi)^2 F / m, which is 1.1 mm for 5 N m at 0.03 m of a link of 0.03 kg.
    assert max(gap(done.model, x[: done.model.nq])[0] for x in done.solution.xs) < 1.2e-3


def test_a_servo_of_a_tendon_drives_the_joint_that_the_others_follow(tmp_path):
    """A ctrl of 255 is 0.8 rad. In MuJoCo the same command moves both fingers to the same angle."""
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "robot.xml").write_text(GRIPPER)
    model = load(tmp_path / "robot.xml", time_step=0.002, mimic="reduce")
    assert "Actuators of tendons drive" in str(model.notes)
    assert "<general> actuators became motors and servos" in str(model.notes)
    terms = model.contract.inputs[0]
    assert (terms.name, terms.unit, terms.lower) == ("fingers", "rad", 0.0)
    assert terms.upper == pytest.approx(255 * 0.3137255 / 100)
    other = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    data, x = mujoco.MjData(other), model.default_state
    data.ctrl = 0.5 * 100 / 0.3137255
    for _ in range(1000):
        mujoco.mj_step(other, data)
        x = dd.step(model, x, [0.5])
    left = model.position_names.index("left_q")
    assert x[left] == pytest.approx(0.5, abs=5e-3)  # the springs cause the difference
    assert x[left] == pytest.approx(float(data.joint("left").qpos[0]), abs=5e-3)
    assert x[left] == pytest.approx(float(data.joint("right").qpos[0]), abs=5e-3)


@each_row(
    "coefficients, coupled",
    [((0.5, 0.5), True), ((0.5, -0.5), True), ((1.0, 1.0), False)],
)
def test_a_tendon_of_joints_that_do_not_follow_is_left_out(tmp_path, coefficients, coupled):
    """A tendon whose length does not change with its joints is left out too."""
    first, second = coefficients
    text = GRIPPER.replace('joint="right" coef="0.5"', f'joint="right" coef="{first}"')
    text = text.replace('joint="left" coef="0.5"', f'joint="left" coef="{second}"')
    (tmp_path / "robot.xml").write_text(text if coupled else text.replace('<joint joint1="right" joint2="left"/>', ""))
    model = load(tmp_path / "robot.xml")
    assert model.nu == (1 if coupled and first + second else 0)
    assert ("1 actuators left out" in str(model.notes)) == (model.nu == 0)


def test_bodies_that_move_together_need_no_constraint(tmp_path):
    """Drake's step would fail with a weld between two bodies that are already fixed to each other."""
    rim = '<body name="rim"><geom size="0.2"/></body>'
    more = f'<body name="plate" pos="0 1 1"><joint name="p"/><geom size="0.1"/>{rim}</body>'
    equality = f'<connect body1="bar" body2="second" anchor="{WIDTH} 0 0"/><weld body1="plate" body2="rim"/>'
    model = load(parallelogram(tmp_path, equality, more))
    assert len(model.file_facts.held_points) == 1
    assert np.all(np.isfinite(dd.step(model, model.default_state, [0.1])))


@pytest.mark.parametrize("kind", ["ball", "revolute", "fixed"])
def test_how_far_a_loop_is_open_does_not_depend_on_the_unit_of_length(tmp_path, kind):
    """The points that define a joint's axis are 0.1 m away, also if the mechanism is half a millimetre in size."""
    path, ratios = sdf(tmp_path, kind), []
    text = path.read_text()
    for scale in (1.0, 1e-3, 1e3):
        path.write_text(scaled(text, scale))
        distance, size = gap(load(path), [0.02, 0.0, 0.0])
        ratios.append(distance / size)
    assert ratios == pytest.approx([ratios[0]] * 3, rel=1e-6)  # rounding of points that are far away
    assert ratios[0] > 0.001


@pytest.mark.parametrize(("step", "success"), [(0.05, False), (0.0125, True)])
def test_a_plan_whose_loop_comes_apart_is_not_verified(tmp_path, step, success):
    """A step h at the rate w opens a gap of (w h)^2 / 2 crank lengths. A hundredth of the mechanism is allowed."""
    model = load(sdf(tmp_path), time_step=step, gravity=[0, 0, 0])
    problem = dd.Problem(
        model,
        x0=np.zeros(6),
        x_goal=[-1.0, *[np.nan] * 5],
        num_steps=round(0.2 / step),
        running_cost=dd.QuadraticCost(R=[[1e-4]]),
    )
    solution = dd.solve(problem)
    assert solution.success == success
    assert any(c.what == "loop" and not c.passes for c in solution.checks) != success
    if success:
        record = dd.save(solution, tmp_path / "run")
        gap_in_record = next(metric for metric in record.metrics if metric.name == "loop gap")
        assert 0 < gap_in_record.value < 0.005

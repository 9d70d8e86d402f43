"""Tests of `load_model` options that complete a file: motors, a base, fixed joints, packages, a ground."""

import math
import warnings

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.mechanics.description import describe_tree

INERTIAL = (
    '<inertial><origin xyz="0 0 -0.5"/><mass value="1"/>'
    '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
)
BALL = '<collision><origin xyz="0 0 -1"/><geometry><sphere radius="0.1"/></geometry></collision>'


def joint(name, parent, child, kind="revolute", limit='<limit effort="7" velocity="1" lower="-2" upper="2"/>', more=""):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>'
        f'<origin xyz="0 0 -1"/>{limit}{more}</joint>'
    )


def robot(*joints, links="base upper lower"):
    """Return the URDF of a two-link arm as in a textbook, without a world and without transmissions."""
    parts = [f'<link name="{name}">{INERTIAL}{BALL if name == "lower" else ""}</link>' for name in links.split()]
    return f'<robot name="arm">{"".join(parts)}{"".join(joints)}</robot>'


SHOULDER, ELBOW = joint("shoulder", "base", "upper"), joint("elbow", "upper", "lower")


@pytest.fixture
def write(tmp_path):
    def write(text=None, name="arm.urdf"):
        (tmp_path / name).write_text(text or robot(SHOULDER, ELBOW))
        return tmp_path / name

    return write


def load(path, **options):
    """Return the model and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = dd.load_model(path, **{"time_step": 0.01, **options})
    return model, "\n".join(str(w.message) for w in caught)


def test_a_textbook_arm_becomes_one_that_can_be_driven(write):
    """The step of the completed arm equals that of the same arm in a file with a world and transmissions."""
    model, told = load(write(), actuators="all", base="weld", ground=True)
    assert (model.nq, model.nu, model.input_names) == (2, 2, ("shoulder", "elbow"))
    assert [a.effort_limit for a in model.contract.actuators] == [7.0, 7.0]
    assert model.notes == (
        "2 actuators added, with the effort limits of the file: shoulder (7), elbow (7).",
        "The base base was welded to the world.",
        "A ground was added at z = 0, with friction 0.5.",
    )
    assert told == "arm.urdf:\n  " + "\n  ".join(model.notes)
    assert model.contract.notes == model.notes
    drives = "".join(
        f'<transmission><type>transmission_interface/SimpleTransmission</type><joint name="{name}">'
        f'<hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="{name}"/></transmission>'
        for name in ("shoulder", "elbow")
    )
    whole = robot(SHOULDER, ELBOW).replace(
        "</robot>", joint("hold", "world", "base", "fixed", "") + drives + "</robot>"
    )
    other, _ = load(write(whole.replace('<origin xyz="0 0 -1"/></joint><tr', "</joint><tr"), "whole.urdf"), ground=0.5)
    x, u = [0.3, -0.4, 0.5, 0.6], [1.0, -2.0]
    np.testing.assert_array_equal(dd.step(model, x, u), dd.step(other, x, u))


def test_a_joint_without_a_limit_or_with_one_of_zero_gets_none_and_that_is_told(write):
    zero = joint("elbow", "upper", "lower", limit='<limit effort="0" velocity="0" lower="-1" upper="1"/>')
    model, _ = load(write(robot(joint("shoulder", "base", "upper", "continuous", ""), zero)), actuators="all")
    assert [math.isinf(a.effort_limit) for a in model.contract.actuators] == [True, True]
    assert model.notes == (
        "Velocity limits of 0 removed: elbow.",
        "2 actuators added without an effort limit, as the file has no limit or 0: shoulder, elbow.",
    )
    assert model.contract.velocities[-1].upper == math.inf


def test_limits_of_zero_have_one_rule_for_driven_and_passive_joints(write):
    """A speed of 0 is no limit of any joint; a range of 0 is removed from each joint of `actuators`, driven or not."""
    zero = '<limit effort="7" velocity="0" lower="0" upper="0"/>'
    drive = (
        '<transmission><type>transmission_interface/SimpleTransmission</type><joint name="elbow">'
        '<hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="elbow"/></transmission>'
    )
    chain = robot(joint("shoulder", "base", "upper", limit=zero), joint("elbow", "upper", "lower", limit=zero))
    file = write(chain.replace("</robot>", drive + "</robot>"))

    def ranges(model):
        return [(p.lower, v.upper) for p, v in zip(model.contract.positions, model.contract.velocities, strict=True)]

    asked = [(-math.inf, math.inf)] * 2
    assert ranges(load(file, base="weld")[0]) == [(0.0, math.inf)] * 2
    assert ranges(load(file, base="weld", actuators="all")[0]) == asked
    assert ranges(load(file, base="weld", actuators=["shoulder", "elbow"])[0]) == asked


def test_actuators_by_name_and_by_effort(write):
    path = write()
    model, _ = load(path, actuators=["elbow"])
    assert [(a.joint, a.effort_limit) for a in model.contract.actuators] == [("elbow", 7.0)]
    model, _ = load(path, actuators={"elbow": 3, "shoulder": None})
    assert [(a.joint, a.effort_limit) for a in model.contract.actuators] == [("elbow", 3.0), ("shoulder", math.inf)]
    again, told = load(MODELS / "cart_pole.urdf", actuators={"slide": 5})
    assert [a.effort_limit for a in again.contract.actuators] == [5.0]
    assert told.endswith("The effort limit of force became 5; the file has 20.")
    same, told = load(MODELS / "cart_pole.urdf", actuators=["slide"])
    assert (same.nu, told) == (1, "")


def test_actuators_can_be_added_after_loading(write):
    model, _ = load(write(), base="weld")
    driven = model.changed(actuators={"elbow": 3})
    assert (model.nu, driven.nu, driven.nq) == (0, 1, 2)
    assert driven.changed(time_step=0.002).nu == 1
    assert model.changed(actuators={"elbow": 3}) is driven
    assert model.changed(actuators={"elbow": 4}) is not driven
    assert model.changed(ground=True) is not model.changed(ground=1.0)


def test_what_copies_another_joint_is_not_driven(write):
    finger = joint("elbow", "upper", "lower", more='<mimic joint="shoulder" multiplier="1"/>')
    path = write(robot(SHOULDER, finger))
    assert load(path, actuators="all")[0].input_names == ("shoulder",)
    with pytest.raises(InputError, match="a joint that mimics no other joint, got 'elbow'"):
        load(path, actuators=["elbow"])


SDF = (
    '<sdf version="1.9"><model name="outer"><link name="a"><inertial><mass>1</mass></inertial></link>'
    '<model name="inner"><link name="b"><inertial><mass>1</mass></inertial></link></model>'
    '<joint name="j" type="revolute"><parent>a</parent><child>inner::b</child><axis><xyz>0 1 0</xyz>'
    "<limit><effort>{}</effort></limit></axis></joint></model></sdf>"
)
MJCF = (
    '<mujoco model="m"><worldbody><body name="a" pos="0 0 2"><freejoint/><geom type="sphere" size="0.1" mass="1"/>'
    '<body name="b" pos="0 0 1"><joint name="j" axis="0 1 0"/><geom type="sphere" size="0.1" mass="1"/></body></body>'
    "</worldbody></mujoco>"
)


@pytest.mark.solve
@each_row("name, text", [("m.sdf", SDF.format(0)), ("m.xml", MJCF), ("m.dmd.yaml", "")])
def test_the_repairs_are_the_same_in_every_format(tmp_path, name, text):
    if name == "m.dmd.yaml":
        (tmp_path / "arms").mkdir(exist_ok=True)
        (tmp_path / "arms" / "arm.urdf").write_text(robot(joint("j", "base", "upper"), links="base upper"))
        text = "directives:\n- add_model:\n    name: left\n    file: package://arms/arm.urdf\n"
        text += "- add_model:\n    name: right\n    file: package://arms/arm.urdf\n"
    (tmp_path / name).write_text(text)
    packages = {"arms": tmp_path / "arms"} if text.startswith("directives") else None
    count = 2 if packages else 1
    passive, _ = load(tmp_path / name, packages=packages)
    assert (passive.nq, passive.nu) == (8 * count, 0)
    model, _ = load(tmp_path / name, actuators="all", base="weld", packages=packages)
    assert (model.nq, model.nu) == (count, count)
    expected = 7.0 if packages else math.inf  # from arm.urdf
    assert [a.effort_limit for a in model.contract.actuators] == [expected] * count
    fixed, _ = load(tmp_path / name, fix_joints=["left::j" if packages else "j"], packages=packages)
    assert fixed.nq == 8 * count - 1


def test_a_welded_base_stays_where_the_file_puts_it(tmp_path):
    (tmp_path / "m.xml").write_text(MJCF)
    model, _ = load(tmp_path / "m.xml", base="weld")
    context = model.plant.CreateDefaultContext()
    height = model.plant.EvalBodyPoseInWorld(context, model.plant.GetBodyByName("a")).translation()[2]
    assert height == 2.0


def test_any_frame_can_be_the_base(write):
    """If the chain is welded at its last link, it is reversed, and the base moves with its joints."""
    model, _ = load(write(), base="lower")
    assert model.nq == 2
    context = model.plant.CreateDefaultContext()
    at = model.plant.EvalBodyPoseInWorld(context, model.plant.GetBodyByName("base")).translation()
    np.testing.assert_allclose(at, [0, 0, 2], atol=1e-15)


def test_a_fixed_joint_is_held_where_it_is_by_default(write):
    model, told = load(write(), base="weld", fix_joints=["elbow"])
    assert model.position_names == ("shoulder_q",)
    assert "1 joints fixed: elbow at 0." in told
    bent = write(robot(SHOULDER, ELBOW.replace('lower="-2"', 'lower="0.5"')), "bent.urdf")
    assert "1 joints fixed: elbow at 0.5." in load(bent, base="weld", fix_joints=["elbow"])[1]
    assert model.contract.bodies[0].mass == 1.0  # a pendulum of two bodies: m g l about the shoulder at rest
    weight = model.double.plant.CalcGravityGeneralizedForces
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, [0.3])
    expected = -9.81 * (0.5 + 1.5) * math.sin(0.3)
    assert weight(context)[0] == pytest.approx(expected, rel=1e-12)


def test_without_contact_nothing_touches(write):
    assert len(load(write())[0].contract.geometries) == 1
    model, told = load(write(), contact=False)
    assert model.contract.geometries == ()
    assert "1 collision shapes removed: the model has no contact." in told


@each_row(
    "options, error, words",
    [
        ({"actuators": "some"}, InputError, 'actuators: expected None, "all", names of joints'),
        ({"actuators": ["wrist"]}, UnknownNameError, "one of elbow, shoulder, got 'wrist'"),
        ({"actuators": {"elbow": 0}}, InputError, "an effort limit above 0"),
        ({"actuators": {"elbow": True}}, InputError, "an effort limit above 0"),
        ({"actuators": {"elbow": "strong"}}, InputError, "an effort limit above 0"),
        ({"actuators": 3}, InputError, "actuators: expected"),
        ({"base": "hand"}, UnknownNameError, "base: frame: expected one of base, .*got 'hand'"),
        ({"base": 1}, InputError, "base"),
        ({"base": "weld", "weld_base": "base"}, InputError, "base: expected one of them"),
        ({"fix_joints": ["wrist"]}, UnknownNameError, "joint that can move: expected one of elbow, shoulder"),
        ({"fix_joints": "elbow"}, InputError, "fix_joints: expected names of joints, got 'elbow'"),
        ({"packages": {"arm": "/nowhere"}}, InputError, r"packages\['arm'\]: expected a folder that exists"),
        ({"packages": "arm"}, InputError, "packages: expected a mapping from names of packages to folders"),
        ({"ground": False}, InputError, "ground"),
        ({"ground": 0.5, "contact": False}, InputError, "ground: expected contact"),
        ({"contact": "no"}, InputError, 'contact: expected True, False, "ground" or "separable", got \'no\''),
    ],
)
def test_bad_repairs_are_named(write, options, error, words):
    with pytest.raises(error, match=words):
        load(write(), **options)


def test_a_base_that_is_held_is_not_free_and_needs_no_weld(write):
    path = write(robot(joint("shoulder", "world", "upper"), ELBOW, links="upper lower"))
    with pytest.raises(ModelError, match=r"arm.urdf: base=\"free\": expected .*shoulder \(revolute\) of upper"):
        load(path, base="free")
    model, told = load(path, base="weld")
    assert (model.nq, told) == (2, "")
    with pytest.raises(ModelError, match="expected a frame of a floating body"):
        load(path, base="lower")
    assert load(write(), base="free")[0].nq == 9


def test_what_has_no_joint_cannot_be_welded_away():
    with pytest.raises(ModelError, match="expected floating bodies with joints"):
        load(MODELS / "projectile.sdf", base="weld")


def test_a_joint_is_fixed_beside_those_that_mimic(write):
    finger = joint("elbow", "upper", "lower", more='<mimic joint="shoulder" multiplier="1"/>')
    path = write(robot(SHOULDER, finger))
    model, _ = load(path, base="weld", fix_joints=["elbow"])
    assert (model.position_names, model.contract.constraints) == (("shoulder_q",), 0)
    assert "2 joints fixed: shoulder at 0, elbow at 0." in load(path, fix_joints=["shoulder", "elbow"])[0].notes
    with pytest.raises(ModelError, match="fix_joints='shoulder': elbow mimics it: fix elbow too"):
        load(path, fix_joints=["shoulder"])
    bent = write(robot(SHOULDER, finger.replace('lower="-2"', 'lower="1"')))
    assert "1 joints fixed: elbow at 1." in load(bent, base="weld", fix_joints=["elbow"])[1]


def test_slips_that_say_nothing_of_the_robot_are_mended_and_told(write):
    black = '<material name="black"><color rgba="0 0 0 {}"/></material>'
    still = joint("elbow", "upper", "lower", "fixed", "", '<mimic joint="shoulder"/>')
    turning = joint("shoulder", "base", "upper", "continuous", '<limit effort="1" velocity="1" lower="0" upper="0"/>')
    text = robot(turning, still).replace(' name="arm"', "").replace("</robot>", black.format(1) + "</robot>")
    text = text.replace(
        "<collision>", "<visual><geometry><sphere radius='1'/></geometry>" + black.format(0.9) + "</visual><collision>"
    )
    model, _told = load(write(text), base="weld")
    assert model.notes[:4] == (
        "The robot has no name in the file: it is called arm.",
        "Materials: black is defined twice, and the first definition is drawn.",
        "Limits of continuous joints removed, as lower and upper limit are equal: shoulder.",
        "The joint elbow is fixed, so that it mimics nothing.",
    )
    assert (model.name, model.contract.positions[0].upper) == ("arm", math.inf)


def test_packages_are_found_above_the_file_beside_it_and_where_they_are_said_to_be(tmp_path):
    mesh = BALL.replace('<sphere radius="0.1"/>', '<mesh filename="package://shapes/tri.obj"/>')
    text = robot(SHOULDER, ELBOW).replace(BALL, mesh)
    obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    for folder in ("arm/urdf", "elsewhere", "shapes"):
        (tmp_path / folder).mkdir(parents=True)
    path = tmp_path / "arm" / "urdf" / "arm.urdf"
    path.write_text(text)
    (tmp_path / "elsewhere" / "tri.obj").write_text(obj)
    model, _ = load(path, packages={"shapes": tmp_path / "elsewhere"})
    assert [g.shape for g in model.contract.geometries] == ["Mesh"]
    lost, told = load(path)
    assert lost.contract.geometries == ()
    assert "no file found: lower collision package://shapes/tri.obj. " in told
    assert "packages={name: folder}" in told
    (tmp_path / "shapes" / "tri.obj").write_text(obj)
    (tmp_path / "shapes" / "package.xml").write_text("<package><name>shapes</name></package>")
    assert load(path)[0].contract.geometries == model.contract.geometries
    (tmp_path / "shapes").rename(tmp_path / "shapes_of_2020")  # a checkout whose folder has another name
    (tmp_path / "arm" / "package.xml").write_text("<package><name>arm_description</name></package>")
    assert load(path)[0].contract.geometries == model.contract.geometries
    path.write_text(path.read_text().replace("package://shapes/", "package://arm_description/"))
    (tmp_path / "arm" / "tri.obj").write_text(obj)
    assert load(path)[0].contract.geometries == model.contract.geometries


def test_a_chain_that_is_held_at_its_other_end_is_told_to_engines_and_differentiated(write):
    model, _ = load(write(), base="lower", actuators="all")
    dd.certify(model, [0.3, -0.2, 0.1, 0.4], [1.0, 2.0]).require()
    with pytest.raises(ModelError, match=r"nearer to the world than its parent: .*elbow"):
        describe_tree(model)


REPAIRS = [
    {"actuators": {"shoulder": 50.0}, "base": "weld", "fix_joints": ["elbow"], "contact": False},
    {"actuators": ["shoulder", "elbow"], "base": "lower", "packages": {"shapes": "shapes"}},
    {"actuators": "all", "base": "weld", "ground": True},
]


@pytest.mark.slow
@each_row("options", REPAIRS)
def test_a_run_of_a_repaired_model_is_made_again_with_its_repairs(tmp_path, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shapes").mkdir(exist_ok=True)
    (tmp_path / "shapes" / "tri.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    )
    visual = '<visual><geometry><mesh filename="package://shapes/tri.obj"/></geometry></visual></link>'
    text = robot(SHOULDER, ELBOW).replace("</link>", visual, 1) if "packages" in options else robot(SHOULDER, ELBOW)
    (tmp_path / "arm.urdf").write_text(text)
    model, _ = load("arm.urdf", time_step=0.02, **options)
    cost = dd.QuadraticCost(Q=np.eye(model.nx), R=0.01 * np.eye(model.nu))
    problem = dd.Problem(model, x0=np.full(model.nx, 0.1), num_steps=4, running_cost=cost)
    folder = tmp_path / "-".join(options)
    record = dd.save(dd.solve(problem, method="ilqr"), folder)
    assert set(options) - {"packages"} <= set(record.model.options)
    assert record.contract["notes"] == list(model.notes)
    assert record.contract["notes"]
    found = dd.verify(folder, models=tmp_path)
    assert found.verdict == "holds", found


def test_what_speaks_of_joints_that_are_not_there_is_left_out_and_told(write):
    lost = (
        '<transmission name="t"><type>SimpleTransmission</type><joint name="gone"/><actuator name="m"/></transmission>'
        '<material name="red"><color rgba="1, 0.5,0 1"/></material>'
    )
    follower = joint("elbow", "upper", "lower", more='<mimic joint="gone"/>')
    model, _ = load(write(robot(SHOULDER, follower).replace("</robot>", lost + "</robot>")), base="weld")
    assert model.nq == 2
    assert load(model.source, base="weld", mimic="reduce")[0].nq == 2
    assert model.notes[:3] == (
        "Materials: red has its colour written with commas.",
        "The joint elbow mimics gone, which does not exist: it moves by itself.",
        "A transmission is left out, as its joint does not exist: gone.",
    )

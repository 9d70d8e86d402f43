"""Check that a corrected model file has the parameters that were found, and that errors name unsupported ones."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from helpers.table import each_row
from scipy.integrate import solve_ivp

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError
from drake_diff.identification import Identification, write_model
from drake_diff.identification.results import Request
from drake_diff.identification.write_model import IN_MJCF

ARM = """<?xml version="1.0"?>
<!-- an arm -- of one link -->
<robot name="arm">
  <link name="arm"><inertial><origin xyz="0.1 0 -0.2" rpy="0.3 0 0"/><mass value="2"/>
    <inertia ixx="0.03" iyy="0.04" izz="0.02" ixy="0.001" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="world"/><child link="arm"/>
    <origin xyz="0 0 1" rpy="0 0 0.5"/><axis xyz="0 1 0"/></joint>
  <transmission name="t"><type>transmission_interface/SimpleTransmission</type>
    <joint name="shoulder"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>
    <actuator name="motor"/></transmission>
</robot>
"""


def saying(model, values, *, file=None, explained=True):
    """Return an identification of `model` with the given values and intervals of 10 %, without fitting."""
    own = {p.name: p for p in dd.list_parameters(model)}
    start = {name: own[name].value if name in own else np.ones(1) for name in values}
    start = {name: float(value[0]) if len(value) == 1 else value for name, value in start.items()}
    intervals = {}
    for name, value in values.items():
        value = np.atleast_1d(value)
        half = 0.1 * np.abs(value) + 1e-3
        found = np.column_stack([value - half, value + half])
        intervals[name] = found[0] if len(value) == 1 else found
    recording = dd.Recording("lab", "1", np.arange(9.0), np.zeros((9, model.nx)), np.zeros((8, model.nu)))
    count = sum(np.size(value) for value in values.values())
    return Identification(
        values=values, start=start, intervals=intervals, units={n: own[n].unit if n in own else "1" for n in values},
        unidentifiable=(), explained=explained, reason="", sentence="Explained: so -- it is -->.", noise={},
        error_before=2.0, error_after=1.0, residuals=(), entries=(), columns=(), covariance=np.eye(count), score=0.0,
        count=9, converged=True, steps=1, motion="continuous time", motions=(),
        asked=Request(model, (recording,), (file,), tuple(values), {}, 0.2, "auto", 60),
    )  # fmt: skip


def number(model, name):
    (value,) = [p.value for p in dd.list_parameters(model) if p.name == name]
    return value


def same(model, path, values):
    """Check that all parameters of the new file equal the old ones, except for those that were found."""
    old = {p.name: p.value for p in dd.list_parameters(model)}
    new = {p.name: p.value for p in dd.list_parameters(dd.load_model(path, **model.options))}
    assert set(old) == set(new)
    for name, value in old.items():
        # Values are printed to the last digit. Shifting an inertia of up to 1 kg m^2 to the center of mass rounds it.
        np.testing.assert_allclose(new[name], np.atleast_1d(values.get(name, value)), rtol=1e-12, atol=1e-14)


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return dd.load_model(path, time_step=0.01)


INERTIA = np.array([0.05, 0.06, 0.03, 0.002, -0.001, 0.003])


def test_a_urdf_file_takes_everything_that_it_has_a_place_for(arm, tmp_path):
    values = {
        "arm.mass": 3.0,
        "arm.center_of_mass": np.array([0.02, 0.01, -0.3]),
        "arm.inertia": INERTIA,
        "shoulder.damping": 0.7,
        "shoulder.offset": np.array([0.0, 0.1, 1.1]),
        "motor.rotor_inertia": 1e-4,
        "motor.gear_ratio": 30.0,
    }
    path = write_model(saying(arm, values), tmp_path / "right.urdf")
    same(arm, path, values)
    text = path.read_text()
    assert "arm.mass was 2 kg, is 3 (95 % interval 2.699 to 3.301)" in text
    assert "from lab" in text
    assert "<!-- an arm -- of one link -->" in text  # unchanged text stays
    assert "--" not in re.sub("<!--|-->", "", text.replace("<!-- an arm -- of one link -->", ""))
    # The rotation of the joint's frame comes from the file.
    turned = dd.load_model(path, **arm.options).plant.GetJointByName("shoulder").frame_on_parent()
    assert turned.GetFixedPoseInBodyFrame().rotation().ToRollPitchYaw().yaw_angle() == pytest.approx(0.5)


def test_an_sdf_file_takes_springs_too(load, tmp_path):
    model = load("mass_spring_damper.sdf")
    values = {"block.mass": 2.5, "slide.damping": 1.0, "slide.spring_stiffness": 60.0, "slide.spring_rest_length": 0.2}
    values["slide.coulomb_friction"] = 0.3
    # A mass scales the inertia, as in Drake.
    path = write_model(saying(model, values), tmp_path / "right.sdf")
    same(model, path, {**values, "block.inertia": number(model, "block.inertia") * 1.25})


@pytest.mark.solve
@each_row("seed", range(12))
def test_random_bodies_come_out_as_they_were_found(arm, tmp_path, seed):
    rng = np.random.default_rng(seed)
    spread = rng.normal(size=(3, 3)) * 0.1
    second = spread @ spread.T + 1e-3 * np.eye(3)
    inertia = np.trace(second) * np.eye(3) - second
    values = {
        "arm.mass": float(rng.uniform(0.1, 10)),
        "arm.center_of_mass": rng.normal(size=3) * 0.3,
        "arm.inertia": np.array([inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]),
    }
    # A center of mass alone may be physically impossible.
    names = values if seed % 2 else ["arm.mass"] if seed % 4 else ["arm.inertia"]
    kept = {name: values[name] for name in names}
    path = write_model(saying(arm, kept), tmp_path / f"{seed}.urdf")
    wanted = dict(kept)
    if "arm.inertia" not in kept and "arm.mass" in kept:
        wanted["arm.inertia"] = number(arm, "arm.inertia") * kept["arm.mass"] / 2
    same(arm, path, wanted)


def test_a_body_that_cannot_be_is_not_written(arm, tmp_path):
    found = saying(arm, {"arm.center_of_mass": np.array([3.0, 0.0, 0.0])})
    with pytest.raises(ModelError, match="no corrected model is written"):
        write_model(found, tmp_path / "right.urdf")
    assert not (tmp_path / "right.urdf").exists()


def test_a_recording_makes_a_file_that_has_what_was_found(load, tmp_path):
    model = load("pendulum.urdf")
    times = 0.01 * np.arange(101)
    moment = lambda t, y: [y[1], (-9.81 * 0.5 * np.sin(y[0]) - 0.15 * y[1]) / 0.25]  # noqa: E731
    q = solve_ivp(moment, (0, 1), (1.0, 0.0), rtol=1e-9, atol=1e-11, t_eval=times).y[0]
    xs = np.column_stack([q + 1e-3 * np.random.default_rng(0).standard_normal(101), np.full(101, np.nan)])
    found = dd.identify(model, dd.Recording("lab", "1", times, xs, np.zeros((100, 1))), ["hinge.damping"])
    path = write_model(found, tmp_path / "right.urdf")
    same(model, path, found.values)
    assert "Explained" in path.read_text()


@each_row(
    "name, words",
    [
        ("motor.strength", "a scale factor of an input"),
        ("shoulder_q.bias", "property of the recording"),
        ("gravity.gravity", "option of load_model"),
        ("arm.friction", "a quantity that cannot be written to URDF"),
    ],
)
def test_what_a_file_cannot_carry_is_named(arm, tmp_path, name, words):
    with pytest.raises(InputError, match=words) as refused:
        write_model(saying(arm, {name: 2.0}), tmp_path / "right.urdf")
    assert name in str(refused.value)
    assert not (tmp_path / "right.urdf").exists()


SERVOS = """<mujoco><default><joint damping="0.1"/><position kp="20" dampratio="0"/></default><worldbody>
<body name="arm"><joint name="j" axis="0 1 0" armature="0.02"/><geom size="0.03" pos="0 0 -0.2" mass="1"/>
<body name="fore" pos="0 0 -.3"><inertial pos="0 0 -.1" mass="0.5" diaginertia=".01 .01 .002"/>
<joint name="k" axis="0 1 0"/></body></body></worldbody>
<actuator><position name="p" joint="j" kp="30" kv="1" gear="2"/><position name="k" joint="k" gear="3"/></actuator>
</mujoco>"""


def test_an_mjcf_file_takes_what_mujoco_has_a_place_for(tmp_path):
    (tmp_path / "arm.xml").write_text(SERVOS)
    model = dd.load_model(tmp_path / "arm.xml", inputs="position", time_step=0.01)
    servos = {"p.rotor_inertia": 0.05, "k.rotor_inertia": 0.01, "p.kp": 100.0, "p.kd": 5.0, "k.kp": 225.0}
    values = {
        "j.damping": 0.3,
        "k.damping": 0.4,
        "k.spring_stiffness": 2.0,
        **servos,
        "arm.mass": 1.3,
        "fore.center_of_mass": np.array([0.01, 0, -0.1]),
    }
    path = write_model(
        saying(model, values | {"k.coulomb_friction": 0.2, "model.input_delay": 0.004}), tmp_path / "b.xml"
    )
    assert "model.input_delay is 0.004" in path.read_text()
    m = mujoco.MjModel.from_xml_path(str(path))
    np.testing.assert_allclose(m.dof_damping, [0.3, 0.4])
    np.testing.assert_allclose(m.dof_frictionloss, [0.0, 0.2])
    np.testing.assert_allclose(m.jnt_stiffness, [0.0, 2.0])
    np.testing.assert_allclose(m.dof_armature, [0.2, 0.09])  # the gears are 2 and 3
    np.testing.assert_allclose(m.actuator_gainprm[:, 0], [25.0, 25.0])
    np.testing.assert_allclose(m.actuator_biasprm[:, 2], [-1.25, 0.0])
    np.testing.assert_allclose(m.body_mass[1:], [1.3, 0.5])
    again = {p.name: p.value for p in dd.list_parameters(dd.load_model(path, **model.options))}
    for name, value in values.items():
        np.testing.assert_allclose(again[name], value, rtol=1e-9, err_msg=name)
    comments = [line for line in path.read_text().splitlines() if "drake_diff: k." in line]
    assert [comment.count(" was ") for comment in comments] == [3, 1, 1]  # of the joint, its armature, its servo


@each_row("in_class, own", [('kp="40" dampratio="0.7"', ""), ("", 'kp="40" dampratio="0.7"'), ('kv="3" kp="40"', "")])
@each_row("values", [{"p.kp": 60.0}, {"p.kd": 2.0}, {"p.kp": 60.0, "p.kd": 2.0}])
def test_a_gain_of_a_servo_with_a_damping_ratio_is_written_with_the_other_gain(tmp_path, in_class, own, values):
    text = SERVOS.replace('kp="20" dampratio="0"', in_class).replace('kp="30" kv="1"', own)
    (tmp_path / "arm.xml").write_text(text)
    model = dd.load_model(tmp_path / "arm.xml", inputs="position", time_step=0.01)
    path = write_model(saying(model, values), tmp_path / "b.xml")
    same(model, path, values)
    m = mujoco.MjModel.from_xml_path(str(path))
    gains = [float(np.ravel(values.get(f"p.{name}", number(model, f"p.{name}")))[0]) for name in ("kp", "kd")]
    np.testing.assert_allclose([m.actuator_gainprm[0, 0], -m.actuator_biasprm[0, 2]], np.array(gains) / 4)  # gear 2


def test_the_gains_of_a_general_actuator_are_refused(tmp_path):
    general = '<general name="p" joint="j" gainprm="40" biastype="affine" biasprm="0 -40 -3"'
    (tmp_path / "arm.xml").write_text(SERVOS.replace('<position name="p" joint="j" kp="30" kv="1"', general))
    model = dd.load_model(tmp_path / "arm.xml", inputs="position", time_step=0.01)
    with pytest.raises(InputError, match=r"p\.kp: expected a <position> actuator, got a <general>"):
        write_model(saying(model, {"p.kp": 50.0}), tmp_path / "b.xml")


def test_each_joint_that_changes_has_a_comment(tmp_path):
    """The motor of joint k has the name of joint j."""
    servo = '<position name="p" joint="j" kp="30" kv="1" gear="2"/>'
    (tmp_path / "arm.xml").write_text(SERVOS.replace(servo, "").replace('name="k" joint', 'name="j" joint'))
    model = dd.load_model(tmp_path / "arm.xml", inputs="position", time_step=0.01)
    path = write_model(saying(model, {"j.damping": 0.3, "j.rotor_inertia": 0.05}), tmp_path / "b.xml")
    lines = path.read_text().splitlines()
    changed = [
        i for i, line in enumerate(lines) if 'damping="0.3"' in line or 'armature="0.45' in line
    ]  # the gear is 3
    assert len(changed) == 2
    assert all("drake_diff: j." in lines[i - 1] for i in changed)


def test_a_file_with_another_friction_is_refused(tmp_path, monkeypatch):
    (tmp_path / "arm.xml").write_text(SERVOS)
    model = dd.load_model(tmp_path / "arm.xml", inputs="position", time_step=0.01)
    monkeypatch.setitem(IN_MJCF, "coulomb_friction", "user")
    with pytest.raises(ModelError, match=r"k\.coulomb_friction in the file: expected 0\.2, as estimated"):
        write_model(saying(model, {"k.coulomb_friction": 0.2}), tmp_path / "b.xml")
    assert not (tmp_path / "b.xml").exists()


def test_friction_is_in_a_urdf_file_and_what_belongs_to_commands_in_its_comment(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    model = dd.load_model(tmp_path / "arm.urdf", time_step=0.01, inputs="position", gains=(40.0, 3.0))
    values = {"shoulder.damping": 0.7, "shoulder.coulomb_friction": 0.4, "motor.kp": 33.0, "model.input_delay": 0.004}
    text = write_model(saying(model, values), tmp_path / "right.urdf").read_text()
    assert '<dynamics damping="0.7" friction="0.4"/>' in text
    assert "motor.kp is 33 N m/rad. model.input_delay is 0.004" in text


def test_other_kinds_of_files_are_refused(arm, tmp_path):
    found = saying(arm, {"arm.mass": 3.0})
    with pytest.raises(InputError, match=r"a \.urdf file"):
        write_model(found, tmp_path / "right.sdf")
    with pytest.raises(InputError, match="expected a new file"):
        write_model(found, arm.source)
    with pytest.raises(InputError, match=r"the result of dd\.identify"):
        write_model(replace(found, asked=None), tmp_path / "right.urdf")


ON_BASE = ARM.replace('<robot name="arm">', '<robot name="arm"><link name="base"/>').replace('"world"', '"base"')
OVERLAY = """directives:
- add_model:
    name: one
    file: {0}  # the arm
    default_joint_positions:
      shoulder: [0.4]
- add_frame:
    name: tilted
    X_PF: {{base_frame: world, translation: [0, 0, 2], rotation: !Rpy {{deg: [0, 30, 0]}}}}
- add_weld: {{parent: tilted, child: one::base}}
"""


def test_an_overlay_stays_over_a_corrected_copy_of_the_file_that_it_adds(tmp_path):
    (tmp_path / "arm.urdf").write_text(ON_BASE)
    (tmp_path / "arm.dmd.yaml").write_text(OVERLAY.format(f"file://{tmp_path / 'arm.urdf'}"))
    model = dd.load_model(tmp_path / "arm.dmd.yaml", time_step=0.01)
    values = {"shoulder.damping": 0.7, "shoulder.offset": np.array([0.0, 0.1, 1.2])}
    more = {"shoulder.coulomb_friction": 0.4, "model.input_delay": 0.004}
    path = write_model(saying(model, values | more), tmp_path / "right.dmd.yaml")
    same(model, path, values)
    new = dd.load_model(path, time_step=0.01)
    np.testing.assert_array_equal(new.default_state, model.default_state)  # the positions come from the overlay
    lines = path.read_text().splitlines()
    assert lines[0].startswith("# Explained: so -- it is -->. model.input_delay is 0.004")
    assert 'friction="0.4"' in (tmp_path / "right_arm.urdf").read_text()
    assert [line for line in lines[1:] if "file:" not in line] == [
        line for line in (tmp_path / "arm.dmd.yaml").read_text().splitlines() if "file:" not in line
    ]
    assert "# the arm" in path.read_text()
    assert "shoulder.damping was 0 N m s/rad, is 0.7" in (tmp_path / "right_arm.urdf").read_text()
    assert (tmp_path / "arm.urdf").read_text() == ON_BASE


def test_what_an_overlay_cannot_tell_apart_is_refused_and_nothing_stays(tmp_path):
    for name in ("arm", "other"):
        (tmp_path / f"{name}.urdf").write_text(ON_BASE)
    weld = "- add_weld: {{parent: world, child: {0}::base}}\n"
    adds = "- add_model: {{name: {0}, file: 'file://{1}'}}\n"
    parts = [adds.format(n, tmp_path / f"{f}.urdf") + weld.format(n) for n, f in (("one", "arm"), ("two", "other"))]
    (tmp_path / "two.dmd.yaml").write_text("directives:\n" + "".join(parts))
    model = dd.load_model(tmp_path / "two.dmd.yaml", time_step=0.01)
    with pytest.raises(InputError, match=r"one::arm\.mass: .*one URDF or SDF file with one::arm .* 0 files"):
        write_model(saying(model, {"one::arm.mass": 3.0}), tmp_path / "right.dmd.yaml")
    with pytest.raises(InputError, match=r"a \.dmd\.yaml file, like the model's file"):
        write_model(saying(model, {"one::arm.mass": 3.0}), tmp_path / "right.urdf")
    assert not list(tmp_path.glob("right*"))


def test_a_name_that_the_file_has_twice_is_refused(tmp_path):
    path = tmp_path / "two.sdf"
    link = '<link name="a"><inertial><mass>1</mass></inertial></link>'
    models = "".join(f'<model name="{name}">{link}</model>' for name in ("one", "two"))
    path.write_text(f'<sdf version="1.9"><world name="w">{models}</world></sdf>')
    model = dd.load_model(path, time_step=0.01)
    with pytest.raises(InputError, match="one element link of this name"):
        write_model(saying(model, {"one::a.mass": 2.0}), tmp_path / "right.sdf")


def test_names_cannot_end_the_comment(arm, tmp_path):
    odd = tmp_path / "x--><evil a='--'/>.csv"
    found = saying(arm, {"arm.mass": 3.0}, file=(odd, "0" * 64))
    text = write_model(found, tmp_path / "right.urdf").read_text()
    assert "--><evil" not in text
    same(arm, tmp_path / "right.urdf", {**found.values, "arm.inertia": number(arm, "arm.inertia") * 1.5})

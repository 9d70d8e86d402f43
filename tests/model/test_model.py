"""Tests of models from files and diagrams: accepted inputs, errors, and the contract."""

import json
import math
import warnings

import numpy as np
import pytest
from helpers.models import MODELS, add_slide
from helpers.table import each_row
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, ModelWarning, ShapeError, UnknownNameError
from drake_diff.model import load_file

NAMES = sorted(p.name for p in MODELS.iterdir())


@pytest.mark.solve
@each_row("name", NAMES)
def test_every_model_loads_without_a_warning_and_steps_and_differentiates(load, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", r"(?s).*12 actuators added")  # to the quadruped, whose file has no actuators
        model = load(name)
    d = dd.differentiate_step(model, model.default_state, np.zeros(model.nu))
    assert d.A.shape == (model.nx, model.nx)
    assert d.B.shape == (model.nx, model.nu)
    assert len(model.state_names) == model.nx == model.nq + model.nv
    assert len(model.input_names) == model.nu
    assert model.time_step == 0.01


def test_kellys_cart_pole_has_kellys_numbers(load):
    c = load("cart_pole.urdf").contract
    assert [b.mass for b in c.bodies] == [1.0, 0.3]
    assert c.bodies[1].center_of_mass == (0, 0, -0.5)
    assert (c.positions[0].lower, c.positions[0].upper) == (-2, 2)
    assert (c.inputs[0].lower, c.inputs[0].upper, c.inputs[0].unit) == (-20, 20, "N")


def test_the_contract_is_readable_and_plain(load):
    model = load("sliding_block.sdf", time_step=0.004, contact_approximation="lagged")
    c = model.contract
    assert c.contact.approximation == "lagged"
    assert c.contact.model == "point"
    assert c.contact.collision_pairs == 8
    assert {g.friction for g in c.geometries} == {0.4}
    assert {g.stiffness for g in c.geometries} == {20000.0}
    assert c.gravity == (0, 0, -9.81)
    assert [p.unit for p in c.positions] == ["1"] * 4 + ["m"] * 3
    assert [v.unit for v in c.velocities] == ["rad/s"] * 3 + ["m/s"] * 3
    plain = json.loads(json.dumps(c.to_dict(), allow_nan=False))
    assert plain["positions"][0]["upper"] is None  # infinite
    assert plain["time_step"] == 0.004


def test_the_contract_is_the_models_own_whatever_was_set_when_it_was_first_asked_for(load):
    model = load("cart_pole.urdf")
    dd.differentiate_step(model, np.zeros(4), [0.0], parameters={"pole.mass": 3.3})
    assert [body.mass for body in model.contract.bodies] == [1.0, 0.3]


@each_row(
    "options, error, words",
    [
        ({"time_step": 0}, InputError, "time_step .*above 0, got 0"),
        ({"time_step": -0.01}, InputError, "time_step"),
        ({"time_step": math.nan}, InputError, "time_step"),
        ({"time_step": "fast"}, InputError, "time_step"),
        (
            {"contact_model": "soft"},
            UnknownNameError,
            "one of hydroelastic, hydroelastic_with_fallback, point",
        ),
        (
            {"contact_approximation": "tamsi"},
            UnknownNameError,
            "one of lagged, sap, similar, got 'tamsi'",
        ),
        ({"weld_base": "base"}, UnknownNameError, "link: expected one of pole, got 'base'"),
        ({"weld_base": "pole"}, ModelError, "weld_base to be a link without a joint"),
        ({"ground": -1.0}, InputError, "ground"),
        (
            {"ground": "rough"},
            InputError,
            "ground: expected a friction coefficient of at least 0, or True, got 'rough'",
        ),
        ({"gravity": (0, 0)}, ShapeError, "gravity"),
        ({"mimic": "lock"}, UnknownNameError, "one of fix, reduce"),
        ({"meshes": "hull"}, UnknownNameError, "convex"),
    ],
)
def test_bad_options_are_named(options, error, words):
    with pytest.raises(error, match=words):
        dd.load_model(MODELS / "pendulum.urdf", **{"time_step": 0.01, **options})


LINK = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
HINGE = (
    f'<link name="a">{LINK}</link><link name="b">{LINK}</link>'
    '<joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>'
)


def urdf(old="", new=""):
    return '<robot name="r">' + HINGE.replace(old, new) + "</robot>"


def shape(text):
    return urdf("</inertial>", f"</inertial><collision><geometry>{text}</geometry></collision>")


def sdf(link="", more=""):
    inertial = "<inertial><mass>1</mass></inertial>"
    return f'<sdf version="1.7"><model name="m"><link name="a">{link or inertial}</link>{more}</model></sdf>'


def mjcf(joint="", geom='size="0.1"', more=""):
    body = f'<body name="b"><joint name="h" type="hinge" {joint}/><geom type="sphere" {geom}/></body>'
    return f'<mujoco model="r"><worldbody>{body}</worldbody>{more}</mujoco>'


LIMITED = '<limit lower="1" upper="-1" effort="1" velocity="1"/></joint>'
BAD_FILES = {
    # These two ended the process, one by an invalid read, one when memory was exhausted.
    "transmission_empty.urdf": (
        urdf("</joint>", '</joint>\n<transmission>\n\n<type/><joint name="j"/><actuator name="m"/></transmission>'),
        r"transmission_empty.urdf:4: <type> of a <transmission> is empty: write SimpleTransmission in it",
    ),
    "circle.xml": (mjcf(more='<include file="circle.xml"/>'), r"the file includes itself: circle.xml -> circle.xml"),
    # Drake would download these packages.
    "drake_models.urdf": (
        shape('<mesh filename="package://drake_models/a.obj"/>'),
        r"unknown package 'drake_models'.*packages=\{'drake_models': folder\}\); drake_diff does not download it",
    ),
    "drake_models.dmd.yaml": (
        "directives:\n- add_model:\n    name: x\n    file: package://drake_models/a.urdf\n",
        r"packages=\{'drake_models': folder\}\); drake_diff does not download it",
    ),
    # A condition in Drake's C++ rejects these two. pydrake raises it as SystemExit, which ended the process.
    "limits_crossed.urdf": (urdf("</joint>", LIMITED).replace("continuous", "revolute"), "limit"),
    "range_crossed.xml": (mjcf('range="1 -1"'), "limits"),
    # Drake raises ValueError for these two, which was formerly not converted.
    "axis_of_letters.urdf": (urdf("0 0 1", "0 x 0"), "3 values for attribute xyz got 0 x 0"),
    "axis.xml": (mjcf('axis="x y z"'), "3 values for attribute axis"),
    # Drake raises RuntimeError for these, or Python's XML parser raises ParseError.
    "broken.urdf": ("<robot><link", "XML"),
    "broken.sdf": ("<sdf><model", "XML"),
    "broken.xml": ("<mujoco><", "XML"),
    "broken_with_meshes.urdf": ("<robot> hand.stl <link", "not well-formed|unclosed"),
    "no_robot.urdf": ("<html/>", "robot tag"),
    "nothing.urdf": ("", "line 1: invalid XML: no element found"),
    "nothing.dmd.yaml": ("", "top level element"),
    "binary.urdf": (bytes(range(256)), "text in UTF-8, got byte 0x80 at position 128"),
    "binary.dmd.yaml": (bytes(range(256)), "UTF-8"),
    "mass_of_letters.urdf": (urdf('mass value="1"', 'mass value="heavy"'), "got 'heavy'"),
    "type.urdf": (urdf("continuous", "wobbly"), "wobbly"),
    "child.urdf": (urdf('child link="b"', 'child link="c"'), "'c'"),
    "twice.urdf": (urdf('link name="b"', 'link name="a"'), "'a'"),
    "nothing_moves.urdf": ('<robot name="r"/>', "cannot move"),
    "version.sdf": (sdf().replace("1.7", "99"), "99"),
    "mass_of_letters.sdf": (sdf("<inertial><mass>heavy</mass></inertial>"), "mass"),
    "include_missing.sdf": (sdf(more="<include><uri>model://gone</uri></include>"), "gone"),
    "include_missing.xml": (mjcf(more='<include file="gone.xml"/>'), r"gone\.xml"),
    "mesh_missing.xml": (mjcf(more='<asset><mesh name="m" file="gone.obj"/></asset>'), r"gone\.obj"),
    "syntax.dmd.yaml": ("directives: [\n- add", "yaml"),
    "unknown.dmd.yaml": ("directives:\n- add_robot:\n    name: x\n", "add_robot|YAML"),
    "include_missing.dmd.yaml": (
        "directives:\n- add_model:\n    name: x\n    file: package://gone/x.sdf\n",
        "package 'gone'",
    ),
}


@pytest.mark.solve
@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
@each_row("name", BAD_FILES)
def test_a_file_that_is_no_robot_is_refused_with_its_name_and_what_was_got(tmp_path, name):
    content, words = BAD_FILES[name]
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ModelError, match=words) as refusal:
        dd.load_model(tmp_path / name, time_step=0.01)
    assert str(refusal.value).startswith(str(tmp_path / name))


@each_row(
    "path, words",
    [
        ("missing.urdf", "expected a file that exists, got .*missing.urdf"),
        (".", "expected a file that exists, got a directory"),
        ("robot.txt", r"\.urdf, \.sdf.*got .*robot.txt"),
        ("no_extension", r"\.urdf, \.sdf"),
    ],
)
def test_what_is_no_robot_file_is_refused(tmp_path, path, words):
    for name in ("robot.txt", "no_extension"):
        (tmp_path / name).write_text("<robot/>")
    with pytest.raises(InputError, match=words):
        dd.load_model(tmp_path / path, time_step=0.01)


def test_what_is_no_path_is_refused():
    with pytest.raises(InputError, match="expected a path, got None"):
        dd.load_model(None, time_step=0.01)


def test_a_namespace_that_pythons_xml_parser_keeps_for_itself_is_no_obstacle(tmp_path):
    text = shape('<mesh filename="hand.dae"/>').replace("<robot", '<robot xmlns:ns0="http://x"')
    (tmp_path / "r.urdf").write_text(text)
    with pytest.warns(ModelWarning, match="hand.dae"):
        assert dd.load_model(tmp_path / "r.urdf", time_step=0.01).nv == 7


def test_meshes_of_unusable_format_are_skipped_and_named(tmp_path):
    text = (MODELS / "pendulum.urdf").read_text().replace('<sphere radius="0.05"/>', '<mesh filename="bob.dae"/>')
    (tmp_path / "p.urdf").write_text(text)
    with pytest.warns(ModelWarning, match=r"pole visual bob\.dae"):
        model = dd.load_model(tmp_path / "p.urdf", time_step=0.01)
    assert "bob.dae" in model.notes[0]
    assert dd.step(model, [0.7, -1.2], [0.3])[1] == pytest.approx(-1.309158874737, rel=1e-12)


def test_what_drakes_parser_ignores_is_a_warning(tmp_path):
    text = (MODELS / "acrobot.xml").read_text().replace('axis="0 1 0"', 'axis="0 1 0" frictionloss="5"')
    (tmp_path / "a.xml").write_text(text)
    with pytest.warns(ModelWarning, match="frictionloss"):
        dd.load_model(tmp_path / "a.xml", time_step=0.01)


def diagram_with(time_step=0.01, *, sampled=False, plants=1, drive=False):
    builder = DiagramBuilder()
    for i in range(plants):
        config = MultibodyPlantConfig(time_step=time_step, use_sampled_output_ports=sampled)
        plant, scene_graph = AddMultibodyPlant(config, builder)
        plant.set_name(f"plant{i}")
        scene_graph.set_name(f"scene_graph{i}")
        body = plant.AddRigidBody("block", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        plant.AddJointActuator("push", add_slide(plant, "slide", plant.world_frame(), body, "x"))
        plant.Finalize()
    if drive:
        source = builder.AddSystem(ConstantVectorSource([1.0]))
        builder.Connect(source.get_output_port(), plant.get_actuation_input_port())
    return builder.Build()


@each_row(
    "options, words",
    [
        ({"time_step": 0.0}, "continuous"),
        ({"sampled": True}, "use_sampled_output_ports=False"),
        ({"plants": 2}, "expected exactly one MultibodyPlant, got 2"),
        ({"drive": True}, "actuation input is connected"),
    ],
)
def test_diagrams_that_cannot_be_stepped_are_refused(options, words):
    with pytest.raises(ModelError, match=words):
        dd.model_from_diagram(diagram_with(**options))
    with pytest.raises(InputError, match="a pydrake Diagram"):
        dd.model_from_diagram("diagram")


def test_a_plant_in_a_nested_diagram_is_found_and_driven():
    """The inner diagram exports the actuation. If free in the outer diagram, it is an input, otherwise an error."""
    for connected in (False, True):
        inner = DiagramBuilder()
        config = MultibodyPlantConfig(time_step=0.01, use_sampled_output_ports=False)
        plant, _ = AddMultibodyPlant(config, inner)
        body = plant.AddRigidBody("block", SpatialInertia.SolidSphereWithMass(2.0, 0.1))
        plant.AddJointActuator("push", add_slide(plant, "slide", plant.world_frame(), body, "x"))
        plant.Finalize()
        inner.ExportInput(plant.get_actuation_input_port(), "u")
        outer = DiagramBuilder()
        nested = outer.AddSystem(inner.Build())
        if connected:
            source = outer.AddSystem(ConstantVectorSource([1.0]))
            outer.Connect(source.get_output_port(), nested.get_input_port())
            with pytest.raises(ModelError, match="actuation input is connected"):
                dd.model_from_diagram(outer.Build())
        else:
            d = dd.differentiate_step(dd.model_from_diagram(outer.Build()), [0.0, 0.0], [3.0])
            assert d.B[1, 0] == pytest.approx(0.01 / 2, rel=1e-12)


def test_the_same_model_at_another_time_step(load):
    model = load("sphere_on_ground.sdf", contact_approximation="lagged", gravity=(0, 0, -1.0))
    finer = model.at_time_step(0.002)
    assert finer.time_step == 0.002
    assert finer.contract.contact == model.contract.contact
    assert finer.contract.gravity == (0, 0, -1.0)
    with pytest.raises(InputError, match="time_step"):
        model.at_time_step(0.0)
    with pytest.raises(ModelError, match="cannot be changed"):
        dd.model_from_diagram(diagram_with()).at_time_step(0.01)


def test_each_set_of_changes_is_a_model_of_its_own(load):
    """The cache formerly used only the first word of a change as its key."""
    model = load("sphere_on_ground.sdf")
    both = model.changed(time_step=0.002, contact_approximation="lagged")
    one = model.changed(time_step=0.002)
    assert (both.time_step, both.contract.contact.approximation) == (0.002, "lagged")
    assert (one.time_step, one.contract.contact.approximation) == (0.002, "sap")
    assert model.changed(contact_approximation="lagged", time_step=0.002) is both
    assert model.changed(contact_approximation="lagged").time_step == model.time_step


def test_a_change_that_load_model_does_not_know_is_refused(load):
    with pytest.raises(UnknownNameError, match=r"one of actuators.*contact_approximation.*got 'friction'"):
        load("pendulum.urdf").changed(friction=1.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"weld_base": {}}, "link: expected one of pole, got {}"),
        ({"gravity": [[1], [2, 3]]}, "gravity .*expected an array of numbers"),
        ({"time_step": [0.1]}, r"time_step .*got \[0\.1\]"),
    ],
)
def test_a_change_that_has_no_hash_is_refused_by_name(load, change, words):
    with pytest.raises(InputError, match=words):
        load("pendulum.urdf").changed(**change)


@pytest.mark.parametrize(("bound", "warns"), [("0.5", True), ("1", True), ("9999", False)])
def test_a_package_newer_than_tested_is_named_once(monkeypatch, bound, warns):
    lines = ["numpy>=2.2", f'numpy<{bound}; extra == "tested"', 'absent<1; extra == "tested"']
    monkeypatch.setattr(load_file, "requires", lambda name: lines)
    load_file.warn_of_newer_versions.cache_clear()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
    expected = f"packages newer than the tested versions: numpy {np.__version__} (tested: below {bound})"
    assert [str(w.message).startswith(expected) for w in caught] == [True] * warns
    load_file.warn_of_newer_versions.cache_clear()

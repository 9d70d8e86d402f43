"""Models from files and diagrams: what is accepted, what is refused, and what the contract says."""

import json
import math
import warnings

import numpy as np
import pytest
from helpers.models import MODELS, Plant, add_slide, contact_properties, robot_file
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.planning import RobotDiagramBuilder
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, ModelWarning, ShapeError, UnknownNameError

NAMES = sorted(p.name for p in MODELS.iterdir())


def test_there_is_a_model_of_each_format():
    assert {name.rsplit(".", 1)[1] for name in NAMES} == {"urdf", "sdf", "xml"}
    assert len(NAMES) == 11


@pytest.mark.parametrize("name", NAMES)
def test_every_model_loads_without_a_warning_and_steps_and_differentiates(load, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
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
    text = str(c)
    for words in ("time step 0.004 s", "block: 2 kg", "friction 0.4", "lagged", "dissipation 1 s/m"):
        assert words in text
    plain = json.loads(json.dumps(c.to_dict(), allow_nan=False))
    assert plain["positions"][0]["upper"] is None  # infinite
    assert plain["time_step"] == 0.004


def test_the_contract_names_what_damps_contact_in_the_chosen_approximation(load):
    assert "relaxation time 0.001 s" in str(load("sphere_on_ground.sdf").contract)
    assert "dissipation 1 s/m" in str(load("sphere_on_ground.sdf", contact_approximation="similar").contract)


def test_joint_and_actuator_facts_are_in_the_contract(load):
    c = load("pendulum.urdf").contract
    assert c.joints[0].damping == (0.1,)
    assert (c.joints[0].parent, c.joints[0].child, c.joints[0].type) == ("world", "pole", "revolute")
    assert math.isinf(c.actuators[0].effort_limit)
    assert c.actuators[0].kp is None


def test_the_contract_is_the_models_own_whatever_was_set_when_it_was_first_asked_for(load):
    model = load("cart_pole.urdf")
    dd.differentiate_step(model, np.zeros(4), [0.0], parameters={"pole.mass": 3.3})
    assert [body.mass for body in model.contract.bodies] == [1.0, 0.3]


def test_a_ground_plane_can_be_added_with_its_friction(load):
    c = load("projectile.sdf", ground=0.3).contract
    assert [(g.body, g.shape, g.friction) for g in c.geometries] == [("world", "HalfSpace", 0.3)]


def test_a_base_can_be_welded(load):
    with pytest.raises(ModelError, match="cannot move"):
        load("projectile.sdf", weld_base="ball")


@pytest.mark.parametrize(
    ("options", "error", "words"),
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
        ({"ground": -1.0}, InputError, "ground"),
        ({"gravity": (0, 0)}, ShapeError, "gravity"),
    ],
)
def test_bad_options_are_named(options, error, words):
    with pytest.raises(error, match=words):
        dd.load_model(MODELS / "pendulum.urdf", **{"time_step": 0.01, **options})


@pytest.mark.parametrize(
    ("name", "text", "error", "words"),
    [
        ("missing.urdf", None, InputError, "a file that exists"),
        ("robot.txt", "<robot/>", InputError, r"\.urdf, \.sdf"),
        ("broken.urdf", "this is no robot", ModelError, r"broken\.urdf"),
        ("empty.urdf", "<robot name='r'/>", ModelError, "cannot move"),
        ("mesh.urdf", "MESH", ModelError, r"nothing\.obj"),
    ],
)
def test_files_that_are_no_robots_are_refused(tmp_path, name, text, error, words):
    if text == "MESH":
        text = (
            (MODELS / "pendulum.urdf").read_text().replace('<sphere radius="0.05"/>', '<mesh filename="nothing.obj"/>')
        )
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(error, match=words):
        dd.load_model(tmp_path / name, time_step=0.01)


def test_meshes_of_unusable_format_are_skipped_and_named(tmp_path):
    text = (MODELS / "pendulum.urdf").read_text().replace('<sphere radius="0.05"/>', '<mesh filename="bob.dae"/>')
    (tmp_path / "p.urdf").write_text(text)
    with pytest.warns(ModelWarning, match=r"pole visual bob\.dae"):
        model = dd.load_model(tmp_path / "p.urdf", time_step=0.01)
    assert "bob.dae" in model.notes[0]
    assert dd.step(model, [0.7, -1.2], [0.3])[1] == pytest.approx(-1.309158874737, rel=1e-12)


def test_what_drakes_parser_ignores_is_a_warning(tmp_path):
    text = (MODELS / "acrobot.xml").read_text().replace('axis="0 1 0"', 'axis="0 1 0" stiffness="5"')
    (tmp_path / "a.xml").write_text(text)
    with pytest.warns(ModelWarning, match="stiffness"):
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


@pytest.mark.parametrize(
    ("options", "words"),
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


def test_what_is_no_diagram_is_refused():
    with pytest.raises(InputError, match="a pydrake Diagram"):
        dd.model_from_diagram("diagram")


def test_a_robot_diagram_is_taken():
    builder = RobotDiagramBuilder(time_step=0.01)
    plant = builder.plant()
    if plant.has_sampled_output_ports():
        plant.SetUseSampledOutputPorts(False)
    builder.parser().AddModels(str(MODELS / "pendulum.urdf"))
    plant.Finalize()
    model = dd.model_from_diagram(builder.Build())
    assert dd.step(model, [0.7, -1.2], [0.3])[1] == pytest.approx(-1.309158874737, rel=1e-12)


def test_a_plant_in_a_nested_diagram_is_found_and_driven():
    """The inner diagram exports the actuation; free outside it is ours, connected it is refused."""
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


def test_a_diagram_of_ones_own_steps_as_the_file_does(load):
    """The ball of sphere_on_ground built by hand: k = 1e4, friction 0.5, relaxation time 0.002 s for the pair."""
    plant = Plant(0.005)
    plant.ball("ball", 1.0, 0.1, contact_properties(2e4, 1.0, 0.5, 0.001))
    plant.ground(contact_properties(2e4, 1.0, 0.5, 0.001))
    mine, file = plant.model(), load("sphere_on_ground.sdf", time_step=0.005)
    x = file.default_state
    x[6], x[7], x[10], x[12] = 0.0985, 1.0, 0.7, -0.3
    assert dd.step(mine, x) == pytest.approx(dd.step(file, x), abs=1e-12)


def test_the_same_model_at_another_time_step(load):
    model = load("sphere_on_ground.sdf", contact_approximation="lagged", gravity=(0, 0, -1.0))
    finer = model.at_time_step(0.002)
    assert finer.time_step == 0.002
    assert finer.contract.contact == model.contract.contact
    assert finer.contract.gravity == (0, 0, -1.0)
    with pytest.raises(InputError, match="time_step"):
        model.at_time_step(0.0)
    with pytest.raises(ModelError, match="keeps its time step"):
        dd.model_from_diagram(diagram_with()).at_time_step(0.01)


def test_a_diagram_without_an_autodiff_form_is_differenced_and_says_so():
    """A Python system that defines no scalar conversion stops Drake's conversion of the whole diagram."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01, use_sampled_output_ports=False), builder)
    body = plant.AddRigidBody("block", SpatialInertia.SolidSphereWithMass(2.0, 0.1))
    plant.AddJointActuator("push", add_slide(plant, "slide", plant.world_frame(), body, "x"))
    plant.Finalize()
    builder.AddSystem(LeafSystem()).set_name("python_only")
    model = dd.model_from_diagram(builder.Build())
    d = dd.differentiate_step(model, [0.0, 0.0], [3.0])
    assert d.method == "finite_difference"
    assert "no AutoDiffXd twin" in d.reason
    assert d.B[1, 0] == pytest.approx(0.01 / 2, rel=1e-9)
    with pytest.raises(ModelError, match="no AutoDiffXd twin"):
        dd.differentiate_step(model, [0.0, 0.0], [3.0], method="autodiff")


@pytest.mark.parametrize(
    ("name", "base", "size"),
    [("panda.urdf", "panda_link0", 18), ("ur5_robot.urdf", None, 12), ("solo12.urdf", None, 37)],
)
def test_a_real_robot_loads_steps_and_is_certified(name, base, size):
    with pytest.warns(ModelWarning, match=r"(?s)meshes skipped.*(stl|dae)"):
        model = dd.load_model(robot_file(name), time_step=0.005, weld_base=base)
    assert model.nx == size
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    random = np.random.default_rng(0)
    for _ in range(3):
        x = model.default_state
        limited = np.isfinite(lower) & np.isfinite(upper)
        middle = np.where(limited, (np.where(limited, lower, 0) + np.where(limited, upper, 0)) / 2, x[: model.nq])
        free = name == "solo12.urdf"
        x[7 * free : model.nq] = (middle + 0.05 * random.standard_normal(model.nq))[7 * free :]
        x[model.nq :] = 0.5 * random.standard_normal(model.nv)
        dd.certify(model, x, 0.1 * random.standard_normal(model.nu)).require()

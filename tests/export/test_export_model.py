"""Tests of exports to engines that are not installed: the written file is the model, or no file is written."""

import csv
import json
import re
import warnings

import numpy as np
import pytest
from helpers.contracts import arms
from helpers.engines import engine_of, needs
from helpers.followers import followed
from helpers.models import robot
from helpers.table import each_row
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff.cli.main import app
from drake_diff.comparison import read_recording
from drake_diff.comparison.attribution import move
from drake_diff.engines.formats import urdf
from drake_diff.exceptions import InputError, ModelError, ModelWarning, UnknownNameError
from drake_diff.export import export
from drake_diff.export.export import complaints, export_model, written
from drake_diff.mechanics.description import describe, describe_whole
from drake_diff.model.tangent import sample_states

pytestmark = pytest.mark.solve

FILES = {"contract.json", "initial_states.csv", "inputs.csv", "README.md"}
MODEL_FILE = {
    "gazebo": "model.sdf", "isaaclab": "model.urdf", "urdf": "model.urdf", "sdf": "model.sdf", "mjcf": "model.xml",
}  # fmt: skip


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.reader(file))


@each_row("target", list(MODEL_FILE))
def test_the_written_file_steps_as_the_hand_calculation_does(load, tmp_path, target):
    """The step is m l^2 (v' - v) = h (u - m g l sin q - b v'), with 1 kg at 0.5 m and b = 0.1 N m s."""
    files = export_model(load("pendulum.urdf"), tmp_path / "out", target=target, states=3)
    assert {f.name for f in files} == {f.name for f in (tmp_path / "out").iterdir()} == FILES | {MODEL_FILE[target]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # about elements for other engines
        model = dd.load_model(tmp_path / "out" / MODEL_FILE[target], time_step=0.01)
    x = dd.step(model, [0.7, -1.2], [0.3])
    np.testing.assert_allclose(x, [0.686908411253, -1.309158874737], atol=1e-11)  # the number of known digits


def test_a_motor_that_only_pushes_stays_so(tmp_path):
    (tmp_path / "m.xml").write_text(
        '<mujoco model="m"><worldbody><body><joint name="j"/><geom size="0.1" mass="1"/></body></worldbody>'
        '<actuator><motor joint="j" gear="4" ctrlrange="0 1"/></actuator></mujoco>'
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # about the gear
        model = dd.load_model(tmp_path / "m.xml", time_step=0.01)
        export_model(model, tmp_path / "out", target="mjcf")
        again = dd.load_model(tmp_path / "out" / "model.xml", time_step=0.01)
    assert (again.inputs.lower, again.inputs.upper) == (0.0, 4.0)
    assert "in [0, 4]" in export_model(model, tmp_path / "u", target="urdf")[-1].read_text()  # URDF has no such limits


def test_the_contract_is_drake_s_in_strict_json(load, tmp_path):
    export_model(load("cart_pole.urdf"), tmp_path / "out", target="gazebo", states=4, seed=9)

    def refuse(constant):
        raise AssertionError(constant)

    told = json.loads((tmp_path / "out" / "contract.json").read_text(), parse_constant=refuse)
    assert (told["time_step"], told["gravity"], told["inputs"]) == (0.01, [0, 0, -9.81], ["force"])
    assert [j["name"] for j in told["joints"]] == ["slide", "hinge"]
    assert [j["mass"] for j in told["joints"]] == [1.0, 0.3]
    assert told["joints"][1]["lower"] is None
    assert (told["initial_states"]["seed"], told["initial_states"]["count"]) == (9, 4)
    assert "deviation 0.5" in told["initial_states"]["distribution"]


def test_states_and_inputs_are_the_samples_to_the_bit(load, tmp_path):
    model = load("sphere_on_ground.sdf")
    export_model(model, tmp_path / "out", target="sdf", states=4, seed=5)
    states, inputs = rows_of(tmp_path / "out" / "initial_states.csv"), rows_of(tmp_path / "out" / "inputs.csv")
    samples = sample_states(model, 4, 5)
    assert states[0] == ["state", "kind", *model.state_names]
    assert [row[1] for row in states[1:]] == ["free", "contact", "free", "contact"]
    np.testing.assert_array_equal([[float(n) for n in row[2:]] for row in states[1:]], [s.x for s in samples])
    assert inputs == [["state"], ["0"], ["1"], ["2"], ["3"]]


def test_the_other_side_s_motion_comes_back_and_is_the_same(load, tmp_path):
    """MuJoCo simulates the exported file from the exported state and input, and the CSV has the README's header."""
    needs("mujoco")
    model = load("cart_pole.urdf")
    out = tmp_path / "out"
    export_model(model, out, target="mjcf", states=3)
    other = engine_of("mujoco", model, path=out / "model.xml")
    states, inputs = rows_of(out / "initial_states.csv"), rows_of(out / "inputs.csv")
    x0, u = np.array(states[2][2:], dtype=float), np.array(inputs[2][1:], dtype=float)
    motion = move(other, x0, np.tile(u, (30, 1)))  # before the rail's end, where the engines differ
    header = next(x for x in (out / "README.md").read_text().splitlines() if x.strip().startswith("time,")).strip()
    samples = [[repr(float(n)) for n in (0.01 * k, *x, *u)] for k, x in enumerate(motion.xs)]
    (out / "run.csv").write_text("\n".join([header, *map(",".join, samples)]))
    (out / "run.contract.json").write_text('{"engine": "theirs", "time step": 0.01, "gravity": [0, 0, -9.81]}')
    e = dd.compare(model, (), recordings=(read_recording(out / "run.csv", model),)).engines[-1]
    assert (e.engine, e.verdict, len(e.step_gaps)) == ("theirs", "same", 30)


@pytest.mark.parametrize("form", ["urdf", "sdf", "mjcf"])
def test_trees_with_turned_joints_armature_and_limits_come_back(tmp_path, form):
    for model in (arms(tmp_path), robot("solo12.urdf", tmp_path)):
        assert complaints(form, model, written(form, describe(model), model.time_step)) == []


@pytest.mark.parametrize("form", ["urdf", "sdf"])
def test_shapes_come_back_where_they_were(load, tmp_path, form):
    """Compare penetration depths at random states. Only SDF has a half space."""
    for name in ("box_push.sdf", "two_spheres.sdf", *(("sphere_on_ground.sdf",) if form == "sdf" else ())):
        model, path = load(name), tmp_path / f"model.{form}"
        path.write_text(written(form, describe(model), model.time_step))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ModelWarning)  # about gravity and time step, which are options in Drake
            theirs = engine_of("drake", dd.load_model(path, time_step=model.time_step))
        ours, depths, random = engine_of("drake", model), [], np.random.default_rng(0)
        for _ in range(20):
            x = model.default_state + 0.2 * random.standard_normal(model.nx)
            depths.append(ours.contact_depth(x))
            assert theirs.contact_depth(x) == pytest.approx(depths[-1], abs=1e-12)  # rounding of poses
        assert max(depths) > 0
        if form == "sdf" and name == "sphere_on_ground.sdf":
            assert theirs.contract.contacts[0].friction == 0.5


@pytest.mark.slow
@each_row(
    "form, element, named",
    [
        (form, element, named)
        for form in ("urdf", "sdf")
        for element, named in (
            ("mu_dynamic", "friction"), ("point_contact_stiffness", "stiffness"),
            ("hunt_crossley_dissipation", "dissipation"), ("damping", "damping"), ("lower", "position limits"),
            ("mass", "mass"),
        )
    ],
)  # fmt: skip
def test_friction_softness_limits_and_damping_come_back_and_one_that_is_off_is_named(load, form, element, named):
    model = load("hopper.sdf")
    text = written(form, describe(model), model.time_step)
    assert complaints(form, model, text) == []

    def more(found):
        return f"{found[1]}{0.8 * float(found[2]) + 0.01!r}"

    wrong, count = re.subn(rf'(<(?:drake:)?{element}(?: value=")?>?|{element}=")(-?[0-9.e+-]+)', more, text)
    assert count
    assert any(f", {named}: " in told for told in complaints(form, model, wrong)), (form, element)


# ---- joints that follow others ----------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["urdf", "sdf", "mjcf"])
def test_joints_that_follow_others_come_back_and_one_that_does_not_is_named(tmp_path, form):
    model = followed(tmp_path, ("revolute", "prismatic"), damping=0.2)
    text = written(form, describe_whole(model), model.time_step)
    assert complaints(form, model, text) == []
    elements = {
        "urdf": ["<mimic .*?/>"], "mjcf": ["(?s)<equality>.*</equality>"], "sdf": ["(?s)<mimic .*?</mimic>"]
    }  # fmt: skip
    for pattern in ("1\\.7", "\\b0\\.3\\b", *elements[form]):
        wrong, count = re.subn(pattern, lambda found: "" if "<" in found[0] else found[0] + "1", text)
        assert count
        told = complaints(form, model, wrong)
        assert any("mimic joints: expected b" in each for each in told), (pattern, told)


def test_mujoco_holds_the_exported_follower(tmp_path):
    """Euler steps of (m + r^2 M) v' = u: 2 kg, and 3 kg at 1.7 times the distance. MuJoCo's constraint is soft."""
    mujoco = pytest.importorskip("mujoco", reason="no MuJoCo (the extra `engines`)")
    model = followed(tmp_path)
    export_model(model, tmp_path / "out", target="mjcf", states=2)
    theirs = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml"))
    data = mujoco.MjData(theirs)
    data.qpos[:], data.qvel[:], data.ctrl[:] = [0.1, 0.1 * 1.7 + 0.3], [0.5, 0.5 * 1.7], 6.0
    mujoco.mj_step(theirs, data, 100)
    a = 6.0 / (2 + 1.7**2 * 3)
    right = np.array([0.1 + 0.5 + a * 0.01**2 * 100 * 101 / 2, 0.5 + a])
    # The constraint yields by 1 - 0.9999 of the error of one step, which is 1e-7 m at such accelerations.
    np.testing.assert_allclose([data.qpos[0], data.qvel[0]], right, atol=1e-6)
    np.testing.assert_allclose(data.qpos[1], 1.7 * right[0] + 0.3, atol=1e-6)
    states = rows_of(tmp_path / "out" / "initial_states.csv")
    assert states[0] == ["state", "kind", "a_x", "b_x", "a_v", "b_v"]
    for _, _, q, follower, v, its in states[1:]:
        np.testing.assert_allclose([float(follower), float(its)], [1.7 * float(q) + 0.3, 1.7 * float(v)], rtol=1e-12)
    contract = json.loads((tmp_path / "out" / "contract.json").read_text())
    assert contract["followers"] == [{"joint": "b", "leader": "a", "ratio": 1.7, "offset": 0.3}]
    readme = (tmp_path / "out" / "README.md").read_text()
    assert "Joints that follow others: b = 1.7 a + 0.3" in readme
    assert "    time,a_x,a_v,motor" in readme
    urdf_of = mujoco.MjModel.from_xml_string(urdf(describe_whole(model)))  # MuJoCo's parser of URDF
    np.testing.assert_allclose(urdf_of.eq_data[:, :3], [[0.3, 1.7, 0]])


def test_followers_that_are_not_reduced_are_refused(tmp_path):
    followed(tmp_path)
    model = dd.load_model(tmp_path / "followed.urdf", time_step=0.01)
    with pytest.raises(ModelError, match="mimic joints, for which see mimic="):
        export_model(model, tmp_path / "out", target="urdf")


# ---- errors ------------------------------------------------------------------------------------------------------


def test_what_a_format_cannot_say_is_refused(load, tmp_path, monkeypatch):
    model = load("mass_spring_damper.sdf")
    with pytest.raises(ModelError, match=r"urdf cannot represent this model; read by drake, springs: .*50, 0\.1"):
        export_model(model, tmp_path / "out", target="isaaclab")
    assert not (tmp_path / "out").exists()
    export_model(model, tmp_path / "out", target="gazebo")  # SDF has springs
    monkeypatch.setattr(export, "find_spec", lambda name: None)
    with pytest.raises(ModelError, match="MuJoCo is not installed"):  # Drake reads no springs in MJCF
        export_model(model, tmp_path / "mjcf", target="mjcf")


def test_bad_input_is_named(load, tmp_path):
    model = load("pendulum.urdf")
    with pytest.raises(UnknownNameError, match="gazebo"):
        export_model(model, tmp_path / "out", target="unity")
    with pytest.raises(InputError, match="expected a new directory"):
        export_model(model, tmp_path, target="sdf")
    with pytest.raises(InputError, match="states"):
        export_model(model, tmp_path / "out", target="sdf", states=0)


def test_the_command_exports(load, tmp_path):
    source = str(load("pendulum.urdf").source)
    done = CliRunner().invoke(app, ["export-model", source, "--to", "isaaclab", "--out", str(tmp_path / "lab")])
    assert done.exit_code == 0
    assert "model.urdf" in done.output
    text = (tmp_path / "lab" / "README.md").read_text()
    for words in ("decimation = 1", "sim.dt = 0.01", "friction_combine_mode", "--recording run.csv"):
        assert words in text
    assert export.TARGETS["isaaclab"] == "urdf"

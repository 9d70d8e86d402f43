"""Check that the contracts of one model match in all engines, and that each single change is found and named."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.contracts import CHANGES, FOLLOWS, arms, different, different_from_drake
from helpers.engines import engine_of, own_mjcf
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff.engines.closed_form import CartPole, DoublePendulum, MassSpringDamper, NumpyEngine, Pendulum
from drake_diff.engines.formats import mjcf
from drake_diff.exceptions import InputError, ModelError, NotOfferedError
from drake_diff.mechanics.description import describe

MJX = pytest.param("mjx", marks=pytest.mark.slow)  # JAX compiles for seconds
ENGINES = ["drake", "mujoco", MJX, "pinocchio", "casadi"]


@pytest.mark.solve
@pytest.mark.parametrize("name", ENGINES)
@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_found_and_named(tmp_path, name, change):
    changes, must, may, words = CHANGES[change]
    reference = dd.engines.load_engine("drake", arms(tmp_path))
    own = different(reference, engine_of(name, arms(tmp_path)))
    assert own.keys() <= {"limit law", "solver tolerance"}  # terms that differ in every engine but Drake
    found = different(reference, engine_of(name, arms(tmp_path, **changes)))
    assert must <= found.keys() - own.keys() <= must | may
    first = next(quantity for quantity in found if quantity in must)
    assert all(word in found[first] for word in words), found[first]


@pytest.mark.parametrize("name", ENGINES)
def test_the_same_model_is_the_same_in_every_engine(tmp_path, name):
    lines = dd.engines.match_contracts(dd.engines.load_engine("drake", arms(tmp_path)), engine_of(name, arms(tmp_path)))
    assert len({line.quantity for line in lines}) == len(lines) == 32
    assert all(str(line).startswith(line.verdict) for line in lines)
    assert {line.quantity for line in lines if line.verdict == "mapped"} <= {"derivative convention"}


HAND = {
    "mass + 1 %": ("pendulum.urdf", Pendulum(mass=1.01), {"mass", *FOLLOWS}),
    "frame": ("double_pendulum.urdf", DoublePendulum(lengths=(0.81, 0.5)),
              {"frames", "center of mass", "inertia", *FOLLOWS}),
    "gravity sign": ("pendulum.urdf", Pendulum(gravity=-9.81), {"gravity", "bias(q, v)"}),
    "damping dropped": ("pendulum.urdf", Pendulum(joint_damping=(0.0,)), {"damping"}),
    "spring": ("mass_spring_damper.sdf", MassSpringDamper(rest=0.11), {"springs", "bias(q, v)"}),
    "inertia": ("mass_spring_damper.sdf", MassSpringDamper(inertia=0.004), {"inertia"}),
    "limit": ("cart_pole.urdf", CartPole(limits={"slide": (-2, 2.1)}), {"position limits"}),
    "effort limit": ("cart_pole.urdf", CartPole(effort_limits=(19.0,)), {"effort limits"}),
    "actuator name": ("pendulum.urdf", Pendulum(input_names=("drive",)), {"actuator mapping"}),
}  # fmt: skip


@pytest.mark.solve
@each_row("change", HAND)
def test_a_change_of_a_hand_calculation_is_found_and_named(load, change):
    file, form, quantities = HAND[change]
    drake = dd.engines.load_engine("drake", load(file))
    own = different(drake, dd.engines.load_engine("numpy", load(file)))
    assert own.keys() <= {"limit law", "solver tolerance"}
    assert different(drake, NumpyEngine(form, time_step=0.01)).keys() - own.keys() == quantities


def test_another_time_step_of_a_hand_calculation_is_found(load):
    drake = dd.engines.load_engine("drake", load("pendulum.urdf"))
    assert different(drake, NumpyEngine(Pendulum(), time_step=0.005)).keys() == {"time step"}


def test_other_names_of_joints_are_found(load):
    drake = dd.engines.load_engine("drake", load("double_pendulum.urdf"))
    swapped = replace(DoublePendulum(), joint_names=("elbow", "shoulder"))
    assert "joint order and names" in different(drake, NumpyEngine(swapped, time_step=0.01))
    assert "no joint has the same name" in different(drake, NumpyEngine(Pendulum(), time_step=0.01))["mass"]


def test_other_joint_types_are_not_compared_further(load):
    drake = dd.engines.load_engine("drake", load("pendulum.urdf"))
    found = different(drake, NumpyEngine(MassSpringDamper(joint_names=("hinge",)), time_step=0.01))
    assert "not comparable" in found["M(q)"]
    assert "revolute" in found["joint types"]


def test_a_stiffness_that_is_each_engines_own_default_is_not_called_equal(load):
    drake = dd.engines.load_engine("drake", load("sphere_on_ground.sdf"))

    def without_stiffness(**changes):
        contacts = tuple(replace(pair, stiffness=None) for pair in drake.contract.contacts)
        contract = replace(drake.contract, contacts=contacts, **changes)
        return SimpleNamespace(contract=contract, mass_matrix=drake.mass_matrix, bias=drake.bias)

    assert different(without_stiffness(), without_stiffness()) == {}
    told = different(without_stiffness(), without_stiffness(contact_law="other"))["stiffness"]
    assert told.count("None") == 2
    assert "10000" in different(drake, without_stiffness())["stiffness"]


def test_a_users_own_mjcf_is_mapped_by_name_and_its_gear_is_found(tmp_path):
    model = arms(tmp_path)
    gear = 'joint="left_joint_2" gear="1"', 'joint="left_joint_2" gear="2"'
    found = different_from_drake(model, own_mjcf("mujoco", tmp_path, model, gear))
    assert {"actuator mapping"} == found.keys() - {"limit law", "solver tolerance", "effort limits"}
    assert "'left_joint_2': 2.0" in found["actuator mapping"]
    renamed = [(f'{where}="left_joint_2"', f'{where}="other"') for where in ("<joint name", "joint")]
    with pytest.raises(InputError, match="left_joint_2"):
        own_mjcf("mujoco", tmp_path, model, *renamed)


@each_row("old, new, said", [
    ("Euler", "implicitfast", None), ("Euler", "implicit", "IMPLICIT, joint damping implicit"),
    ('warmstart="disable"', 'eulerdamp="disable"', "EULER, joint damping explicit"),
])  # fmt: skip
def test_the_integrators_step_is_drakes_exactly_where_the_contract_says_so(tmp_path, old, new, said):
    model = arms(tmp_path)
    drake, mujoco = dd.engines.load_engine("drake", model), own_mjcf("mujoco", tmp_path, model, (old, new))
    found = different(drake, mujoco)
    assert (said is None and "integrator" not in found) or said in found["integrator"]
    x, u = np.linspace(-0.5, 0.6, 8), np.linspace(-1, 1, 4)
    gap = np.abs(mujoco.step(x, u) - drake.step(x, u)).max()
    assert gap < 1e-13 if said is None else gap > 1e-7


@each_row("old, new, said", [
    ('armature=', 'frictionloss="0.1" armature=', "friction loss"), ("<option ", '<option density="1.2" ', "a fluid"),
    ('warmstart=', 'gravity="disable" warmstart=', "disabled parts"),
    ("<contact", '<equality><joint joint1="left_joint_1"/></equality><contact', "equality constraints"),
])  # fmt: skip
def test_an_mjcf_with_what_the_contract_does_not_know_is_refused(tmp_path, old, new, said):
    with pytest.raises(ModelError, match=said):
        own_mjcf("mujoco", tmp_path, arms(tmp_path), (old, new))


def test_an_mjcf_that_mujoco_does_not_read_is_refused(tmp_path):
    with pytest.raises(ModelError, match="own"):
        own_mjcf("mujoco", tmp_path, arms(tmp_path), ("<option", "<opinion"))


@pytest.mark.parametrize("name", ["mujoco", MJX])
def test_another_order_inside_mujoco_is_mapped(tmp_path, name):
    needed = arms(tmp_path)
    turned = arms(tmp_path, order=("right", "left"))
    engine_of(name, needed)
    path = tmp_path / "turned.xml"
    path.write_text(mjcf(describe(turned), turned.time_step))
    engine, drake = dd.engines.load_engine(name, needed, path=path), dd.engines.load_engine("drake", needed)
    lines = {line.quantity: line for line in dd.engines.match_contracts(drake, engine)}
    assert lines["joint order and names"].verdict == "mapped"
    assert lines["M(q)"].verdict == lines["bias(q, v)"].verdict == lines["actuator mapping"].verdict == "equal"
    x, u = np.linspace(-0.5, 0.6, 8), np.linspace(-1, 1, 4)
    np.testing.assert_allclose(engine.step(x, u), drake.step(x, u), atol=1e-13)
    one, two = engine.differentiate_step(x, u), drake.differentiate_step(x, u)
    np.testing.assert_allclose(one.A, two.A, atol=1e-9)  # MuJoCo's Jacobian comes from finite differences
    np.testing.assert_allclose(one.B, two.B, atol=1e-10)


def test_other_friction_and_stiffness_are_found(tmp_path):
    needed = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.01)
    for old, new, quantity, word in (
        ("mu_dynamic>0.5", "mu_dynamic>0.4", "friction", "0.444"),
        ("stiffness>20000", "stiffness>10000", "stiffness", "6666"),
    ):
        path = tmp_path / "ball.sdf"
        path.write_text((MODELS / "sphere_on_ground.sdf").read_text().replace(old, new, 1))
        found = different_from_drake(needed, engine_of("mujoco", dd.load_model(path, time_step=0.01)))
        assert word in found[quantity]
    assert different_from_drake(needed, engine_of("mujoco", needed)).keys() == {
        "contact law",
        "solver tolerance",
        "integrator",
    }


class Other:
    """An engine with the contract and dynamics of another engine, except for the given changes."""

    def __init__(self, engine, mass_matrix=None, **contract):
        self.contract = replace(engine.contract, **contract)
        self.mass_matrix, self.bias = mass_matrix or engine.mass_matrix, engine.bias


def test_what_an_engine_does_not_compute_is_not_called_equal(load):
    def none(q):
        raise NotOfferedError("no mass matrix here")

    drake = engine_of("drake", load("pendulum.urdf"))
    lines = {line.quantity: line for line in dd.engines.match_contracts(drake, Other(drake, none))}
    assert lines["M(q)"].verdict == "different"
    assert "no mass matrix here" in lines["M(q)"].detail
    assert lines["bias(q, v)"].verdict == "equal"


@pytest.mark.parametrize(("precision", "verdict"), [("float64", "different"), ("float32", "equal")])
def test_single_precision_is_allowed_its_rounding_and_no_more(load, precision, verdict):
    drake = engine_of("drake", load("pendulum.urdf"))
    joint = drake.contract.joints[0]
    for factor, expected in ((1 + 1e-7, verdict), (1 + 1e-4, "different")):
        other = Other(drake, precision=precision, joints=(replace(joint, mass=joint.mass * factor),))
        lines = {line.quantity: line.verdict for line in dd.engines.match_contracts(drake, other)}
        assert lines["mass"] == expected
        assert lines["scalar type"] == ("equal" if precision == "float64" else "different")


def test_the_convention_of_derivatives_is_a_line(load):
    drake = engine_of("drake", load("pendulum.urdf"))
    for told, verdict in (("by every entry of x and u", "equal"), ("by small turns", "mapped"), ("none", "different")):
        lines = {line.quantity: line for line in dd.engines.match_contracts(drake, Other(drake, derivatives=told))}
        assert lines["derivative convention"].verdict == verdict
    assert "offers no derivatives" in lines["derivative convention"].reason

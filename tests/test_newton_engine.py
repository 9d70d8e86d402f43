"""Newton's step against its formula by hand, against Drake where both have the same, and its contact where it rests.

All are slow: the first to ask builds Newton's kernels, half a minute on an empty cache.
"""

import re
import subprocess
import sys

import numpy as np
import pytest
from helpers.contracts import CHANGES, arms, different
from helpers.engines import free_state, on_tangent
from helpers.forward_formula import formula, free_box, turned
from helpers.models import MODELS, Plant, contact_properties, robot
from helpers.plants import block_on_rails, tetrahedron_on_ground
from pydrake.geometry import Box, Capsule, Cylinder
from pydrake.math import RigidTransform
from pydrake.multibody.tree import SpatialInertia

import drake_diff as dd
from drake_diff.exceptions import NonFiniteError, NotOfferedError, ShapeError, SimulationError
from drake_diff.model.tangent import tangent_space

pytest.importorskip("newton", reason="newton is not installed: pip install 'drake-diff[forward]'")

pytestmark = pytest.mark.slow
G = 9.81
# What no engine but Drake has as Drake has it, and Newton's damping, which is explicit.
OWN = {"limit law", "solver tolerance", "integrator", "scalar type"}


def newton(model):
    return dd.engines.load_engine("newton", model)


# ---- the step -------------------------------------------------------------------------------------------------------


def test_a_damped_pendulums_step_by_hand_has_explicit_damping(load):
    engine, h, inertia, damping = newton(load("pendulum.urdf")), 0.01, 0.25, 0.1
    x, u = [0.7, -1.2], 0.3
    v = x[1] + h * (u - damping * x[1] - inertia * G / 0.5 * np.sin(x[0])) / inertia
    np.testing.assert_allclose(engine.step(x, [u]), [x[0] + h * v, v], rtol=3e-7)  # single precision: 6e-8 a rounding
    implicit = x[1] + (v - x[1]) / (1 + h * damping / inertia)
    assert abs(engine.step(x, [u])[1] - implicit) > 1e-4  # it could be told
    assert "joint damping explicit" in engine.contract.integrator


def test_a_spinning_body_by_hand_turns_by_its_rate_and_moves_by_its_center():
    center, h = np.array([0.1, 0.2, 0.3]), 0.01
    engine = newton(free_box(center, h))
    v_center, w = np.array([0.5, -0.2, 0.1]), np.array([0.0, 0.0, 3.0])  # about a principal axis: w stays
    x = np.array([1, 0, 0, 0, 0, 0, 1, *w, *(v_center - np.cross(w, center))])
    after = engine.step(x, [])
    half = h * 3 / 2
    quaternion = np.array([1, 0, 0, half]) / np.sqrt(1 + half * half)
    v_next = v_center - h * np.array([0, 0, G])
    np.testing.assert_allclose(after[:4], quaternion, rtol=0, atol=3e-7)
    arm = turned(quaternion) @ center
    np.testing.assert_allclose(after[4:7], [0, 0, 1] + center + h * v_next - arm, rtol=0, atol=3e-7)
    np.testing.assert_allclose(after[7:10], w, rtol=0, atol=1e-6)
    np.testing.assert_allclose(after[10:], v_next - np.cross(w, arm), rtol=0, atol=1e-6)
    drake = dd.engines.load_engine("drake", free_box(center, h)).step(x, [])
    assert np.abs(after[4:7] - drake[4:7]).max() > 1e-5  # Drake moves it by its origin


@pytest.mark.parametrize("name", ["double_pendulum.urdf", "cart_pole.urdf", "acrobot.xml"])
def test_without_damping_the_step_is_drakes(load, name):
    model = load(name)
    drake, engine, random = dd.engines.load_engine("drake", model), newton(model), np.random.default_rng(0)
    damped = np.any(drake.description.by_velocity("damping"))
    assert damped == ("integrator" in different(drake, engine))
    for _ in range(3):
        x, u = free_state(model, random), random.standard_normal(model.nu)
        expected = formula(model, x, u) if damped else drake.step(x, u)
        # single precision, magnified by h / (smallest inertia) and rounding of forces of 10 N
        np.testing.assert_allclose(engine.step(x, u), expected, rtol=0, atol=2e-6 * max(1, abs(expected).max()))
        assert engine.energy(x) == pytest.approx(drake.energy(x), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("name", ["panda.urdf", "ur5_robot.urdf", "solo12.urdf"])
def test_robots_step_by_the_formula(tmp_path, name):
    model, random = robot(name, tmp_path), np.random.default_rng(3)
    engine = newton(model)
    for _ in range(2):
        x, u = free_state(model, random), random.standard_normal(model.nu)
        expected = formula(model, x, u)
        np.testing.assert_allclose(engine.step(x, u), expected, rtol=0, atol=4e-6 * max(1, abs(expected).max()))


def test_effort_limits_cut(load):
    model = load("cart_pole.urdf")  # of 20 N
    x, engine = [0.1, 0.4, 0.2, -0.3], newton(model)
    assert engine.step(x, [25.0]).tobytes() == engine.step(x, [20.0]).tobytes()
    assert np.abs(engine.differentiate_step(x, [25.0]).B).max() == 0


def test_each_step_depends_on_its_arguments_alone():
    model, rest = block_on_rails(0.002)
    one, two = newton(model), newton(model)
    states = [rest + d * np.array([0, -0.001, 1, -0.5]) for d in (0.0, 1.0, 2.0)]
    first = [one.step(x, []).tobytes() for x in states]
    assert first == [two.step(x, []).tobytes() for x in reversed(states)][::-1]
    two.mass_matrix(states[0][:2])
    two.contact_depth(states[2])
    assert first[1] == two.step(states[1], []).tobytes()


# ---- its derivatives ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pendulum.urdf", "cart_pole.urdf", "acrobot.xml", "box", "solo12.urdf"])
def test_warps_tape_is_the_derivative_of_the_formula(load, tmp_path, name):
    model = free_box((0.1, 0.2, 0.3)) if name == "box" else robot(name, tmp_path) if "solo" in name else load(name)
    engine, random, space = newton(model), np.random.default_rng(4), tangent_space(model)
    x, u = free_state(model, random), random.standard_normal(model.nu)
    A, B, method = engine.differentiate_step(x, u)
    assert method == "warp tape"
    after = engine.step(x, u)
    A = on_tangent(model, A, x, after)
    scale = max(1.0, np.abs(A).max())
    for i, column in enumerate(A.T):
        e = 1e-6 * np.eye(len(A))[i]
        ends = [space.minus(formula(model, space.plus(x, d), u), after) for d in (e, -e)]
        # the tape is good to single precision, magnified as the step is
        np.testing.assert_allclose(column, (ends[0] - ends[1]) / 2e-6, rtol=0, atol=2e-5 * scale)
    for i, column in enumerate(B.T):
        e = 1e-6 * np.eye(len(u))[i]
        difference = (formula(model, x, u + e) - formula(model, x, u - e)) / 2e-6
        np.testing.assert_allclose(column, difference, rtol=0, atol=2e-5 * max(1.0, np.abs(B).max()))


def test_there_is_no_derivative_where_something_touches():
    model, rest = block_on_rails()
    engine = newton(model)
    assert engine.differentiate_step(rest + np.array([0, 0.01, 0, 0]), []).method == "warp tape"
    with pytest.raises(NotOfferedError, match="touch"):
        engine.differentiate_step(rest, [])


# ---- the contract ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_found_and_named(tmp_path, change):
    changes, must, may, words = CHANGES[change]
    reference = dd.engines.load_engine("drake", arms(tmp_path))
    own = different(reference, newton(arms(tmp_path)))
    assert own.keys() <= OWN
    found = different(reference, newton(arms(tmp_path, **changes)))
    assert must <= found.keys() - own.keys() <= must | may
    first = next(quantity for quantity in found if quantity in must)
    shown = re.sub(
        r"[\d.e-]*\.[\d.e-]*\d", lambda m: f"{float(m[0]):.6g}", found[first]
    )  # 1.299999952 is 1.3 in single
    assert all(word in shown for word in words), found[first]


@pytest.mark.parametrize("wrong", ["quaternion order", "velocity frame", "angular and linear"])
def test_a_swapped_quaternion_or_velocity_frame_is_found(wrong, monkeypatch):
    model = free_box((0.1, 0.2, 0.3))
    drake, engine = dd.engines.load_engine("drake", model), newton(model)
    assert different(drake, engine).keys() == {"integrator", "scalar type"}
    if wrong == "quaternion order":
        engine.positions[:4] = np.roll(engine.positions[:4], 1)
    elif wrong == "velocity frame":
        monkeypatch.setattr("drake_diff.mechanics.coordinates.rotation", lambda q: np.eye(3))
    else:
        engine.dofs = np.roll(engine.dofs, 3)
    assert different(drake, engine).keys() & {"M(q)", "bias(q, v)"}


def test_contacts_are_drakes_pairs_and_a_shape_that_is_not_built_is_named(load, tmp_path):
    model = load("sphere_on_ground.sdf")
    assert different(dd.engines.load_engine("drake", model), newton(model)).keys() == {
        "integrator", "contact law", "dissipation", "solver tolerance", "scalar type"}  # fmt: skip
    model = tetrahedron_on_ground(tmp_path)
    assert "body_shape" in different(dd.engines.load_engine("drake", model), newton(model))["contact pairs"]


# ---- contact --------------------------------------------------------------------------------------------------------


def test_one_step_of_landing_by_hand():
    h, k, c = 0.002, 1e4, 100.0  # the damper is Newton's own
    model, _ = block_on_rails(h)
    engine = newton(model)
    for z, v in ((0.098, -0.3), (0.098, 0.3)):
        push = k * (0.1 - z) - c * min(v, 0.0)
        after = engine.step([0, z, 0, v], [])
        np.testing.assert_allclose(after[3], v + h * (push - G), rtol=0, atol=1e-5)  # 0.1 - z to 1e-8 m, times k
        assert engine.contact_depth([0, z, 0, v]) == pytest.approx(0.1 - z, abs=2e-8)
    assert "damper of 100 N s/m while closing" in engine.contract.contact_law


def test_it_rests_as_deep_as_drake_and_slides_by_coulomb_to_its_own_slope():
    h, friction, slope = 0.0005, 0.5, 1000.0  # explicit friction holds for h slope / m < 2
    model, x = block_on_rails(h, friction)
    engine = newton(model)
    for _ in range(1500):
        x = engine.step(x, [])
    assert engine.contact_depth(x) == pytest.approx(G / 1e4, rel=1e-4)
    x[2] = 0.5
    v = [x[2]]
    for _ in range(300):
        x = engine.step(x, [])
        v.append(x[2])
    fast = np.array(v[:-1]) > friction * G / slope
    np.testing.assert_allclose(np.diff(v)[fast] / h, -friction * G, rtol=2e-3)  # 0.5 to 3e-8, over h
    slow = np.array(v[:-1])[~fast]
    np.testing.assert_allclose(np.array(v[1:])[~fast], slow * (1 - h * slope), rtol=1e-3, atol=1e-7)
    assert f"friction of {slope:g} N s/m" in engine.contract.contact_law


def test_a_ball_without_friction_is_not_slowed():
    model, x = block_on_rails(0.002, 0.0)
    engine, x = newton(model), x + np.array([0, 0, 1.0, 0])
    assert engine.step(x, [])[2] == 1.0


@pytest.mark.parametrize(("shape", "height"), [(Box(0.2, 0.3, 0.4), 0.2), (Cylinder(0.1, 0.4), 0.2),
                                               (Capsule(0.1, 0.4), 0.3)])  # fmt: skip
def test_shapes_stand_where_drakes_stand(shape, height):
    plant = Plant(0.002)
    body = plant.plant.AddRigidBody("body", SpatialInertia.SolidBoxWithMass(1.0, 0.2, 0.3, 0.4))
    plant.shape(body, shape, contact_properties(1e4), RigidTransform([0.1, 0.2, 0.3]))
    plant.ground(contact_properties(1e4))
    x = np.array([1, 0, 0, 0, 0, 0, height - 0.3 - 0.001, *[0] * 6])
    assert newton(plant.model()).contact_depth(x) == pytest.approx(0.001, abs=1e-6)  # single precision of 0.3 m


def test_a_limit_is_an_explicit_spring_and_damper(load):
    engine, h, ke, kd = newton(load("cart_pole.urdf", time_step=0.001)), 0.001, 1e4, 10.0  # the slide from -2 to 2
    inside, beyond = engine.step([1.999, 0, 1.0, 0], [0]), engine.step([2.01, 0, 1.0, 0], [0])
    mass = engine.mass_matrix([2.01, 0])
    push = np.linalg.solve(mass, [-ke * 0.01 - kd * 1.0, 0])
    np.testing.assert_allclose((beyond - inside)[2:], h * push, rtol=0, atol=1e-5)
    assert "springs of 10000 and dampers of 10" in engine.contract.limit_law


# ---- refusals -------------------------------------------------------------------------------------------------------


def test_bad_input_is_named(load):
    engine = newton(load("pendulum.urdf"))
    with pytest.raises(ShapeError, match="x"):
        engine.step([0.0], [0.0])
    with pytest.raises(NonFiniteError, match="u"):
        engine.differentiate_step([0.0, 0.0], [np.nan])
    with pytest.raises(SimulationError, match="Newton"):
        engine.step([0.0, 1e300], [0.0])


def test_contacts_without_room_are_in_the_status():
    model, rest = block_on_rails()
    engine = newton(model)
    engine.step(rest, [])
    assert engine.status == "ok"
    real = engine.pipeline.contacts

    def small():
        contacts = real()
        contacts.rigid_contact_max = 0
        return contacts

    engine.pipeline.contacts = small
    engine.step(rest, [])
    assert "room for 0" in engine.status


def test_newton_says_nothing_and_a_missing_one_is_named_with_its_extra():
    code = f"""import drake_diff as dd
model = dd.load_model({str(MODELS / "pendulum.urdf")!r}, time_step=0.01)
dd.engines.load_engine('newton', model).step([0, 0], [0])"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
    code = """import sys; sys.modules['newton'] = None
import drake_diff as dd
from drake_diff.exceptions import MissingDependencyError
try: dd.engines.load_engine('newton', None)
except dd.exceptions.MissingDependencyError as error: print(error)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install 'drake-diff[forward]'" in done.stdout

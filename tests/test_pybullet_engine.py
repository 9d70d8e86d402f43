"""Bullet's step against its formula by hand, against Drake where both have the same, and its contact where it rests."""

import subprocess
import sys

import numpy as np
import pytest
from helpers.contracts import CHANGES, PLAIN, arms, different
from helpers.engines import free_state
from helpers.forward_formula import formula, free_box, turned
from helpers.models import MODELS, Plant, contact_properties, robot
from helpers.plants import block_on_rails, tetrahedron_on_ground
from helpers.table import each_row
from pydrake.geometry import Box, Capsule, Cylinder, HalfSpace
from pydrake.math import RigidTransform
from pydrake.multibody.tree import SpatialInertia

import drake_diff as dd
from drake_diff.engines.formats import bullet_urdf
from drake_diff.exceptions import ModelError, NonFiniteError, NotOfferedError, ShapeError, SimulationError
from drake_diff.mechanics.description import Geometry, describe, rigid_links

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'drake-diff[forward]' (Python 3.11)")
G = 9.81
# What no engine but Drake has as Drake has it, and Bullet's damping, which is explicit.
OWN = {"limit law", "solver tolerance", "integrator", "derivative convention"}


def bullet(model):
    return dd.engines.load_engine("pybullet", model)


# ---- the step -------------------------------------------------------------------------------------------------------


def test_a_damped_pendulums_step_by_hand_has_explicit_damping(load):
    engine, h, inertia, damping = bullet(load("pendulum.urdf")), 0.01, 0.25, 0.1
    x, u = [0.7, -1.2], 0.3
    v = x[1] + h * (u - damping * x[1] - inertia * G / 0.5 * np.sin(x[0])) / inertia
    np.testing.assert_allclose(engine.step(x, [u]), [x[0] + h * v, v], rtol=1e-14)
    assert "joint damping explicit" in engine.contract.integrator


def test_nothing_is_clamped_or_dragged_by_itself(load):
    engine, h = bullet(load("pendulum.urdf")), 0.01
    v = 500 - h * 0.1 * 500 / 0.25  # Bullet would clamp at 100 rad/s
    np.testing.assert_allclose(engine.step([0.0, 500.0], [0.0]), [h * v, v], rtol=1e-14)
    after = bullet(free_box()).step([1, 0, 0, 0, 0, 0, 1, 0, 0, 300, 500, 0, 0], [])
    np.testing.assert_allclose(after[[9, 10]], [300, 500], rtol=1e-14)


def test_a_spinning_body_by_hand_turns_by_the_exponential_and_moves_by_its_center():
    center, h = np.array([0.1, 0.2, 0.3]), 0.01
    engine = bullet(free_box(center, h))
    v_center, w = np.array([0.5, -0.2, 0.1]), np.array([0.0, 0.0, 3.0])  # about a principal axis: w stays
    x = np.array([1, 0, 0, 0, 0, 0, 1, *w, *(v_center - np.cross(w, center))])
    after = engine.step(x, [])
    quaternion = np.array([np.cos(h * 3 / 2), 0, 0, np.sin(h * 3 / 2)])
    v_next = v_center - h * np.array([0, 0, G])
    arm = turned(quaternion) @ center
    expected = [*quaternion, *([0, 0, 1] + center + h * v_next - arm), *w, *(v_next - np.cross(w, arm))]
    np.testing.assert_allclose(after, expected, rtol=0, atol=1e-13)


@each_row("name", ["double_pendulum.urdf", "cart_pole.urdf", "acrobot.xml", "mass_spring_damper.sdf"])
def test_without_damping_the_step_is_drakes(load, name):
    model = load(name)
    drake, engine, random = dd.engines.load_engine("drake", model), bullet(model), np.random.default_rng(0)
    damped = np.any(drake.description.by_velocity("damping"))
    assert damped == ("integrator" in different(drake, engine))
    for _ in range(3):
        x, u = free_state(model, random), random.standard_normal(model.nu)
        expected = formula(model, x, u) if damped else drake.step(x, u)
        np.testing.assert_allclose(engine.step(x, u), expected, rtol=0, atol=1e-14 * max(1, abs(expected).max()))
        assert engine.energy(x) == pytest.approx(drake.energy(x), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("name", ["panda.urdf", "ur5_robot.urdf", "solo12.urdf"])
def test_robots_step_by_the_formula(tmp_path, name):
    model, random = robot(name, tmp_path), np.random.default_rng(3)
    engine = bullet(model)
    for _ in range(2):
        x, u = free_state(model, random), random.standard_normal(model.nu)
        expected = formula(model, x, u, exponential=True)
        np.testing.assert_allclose(engine.step(x, u), expected, rtol=0, atol=1e-13 * max(1, abs(expected).max()))


def test_effort_limits_cut(load):
    engine, x = bullet(load("cart_pole.urdf")), [0.1, 0.4, 0.2, -0.3]  # of 20 N
    assert engine.step(x, [25.0]).tobytes() == engine.step(x, [20.0]).tobytes()


def test_what_is_beyond_a_limit_comes_back_by_a_fifth_of_it_each_step(load):
    engine, h = bullet(load("cart_pole.urdf")), 0.01  # the slide from -2 to 2
    for beyond, v in ((0.01, 0.0), (0.001, 3.0)):
        assert engine.step([2 + beyond, 0, v, 0], [0])[2] == pytest.approx(-0.2 * beyond / h, abs=1e-12)
    assert engine.step([1.999, 0, 3.0, 0], [0])[2] == 3.0  # nothing holds it before
    assert "0.2" in engine.contract.limit_law


def test_each_step_depends_on_its_arguments_alone(load):
    model = load("sliding_block.sdf", time_step=0.002)
    one, two, x = bullet(model), bullet(model), np.array(model.default_state)
    x[6] = 0.0495
    states = [x + d * np.array([0] * 7 + [0.1, 0.2, 0, 1, 0.5, -0.1]) for d in (0.0, 1.0, 2.0)]
    first = [one.step(x, []).tobytes() for x in states]
    assert first == [two.step(x, []).tobytes() for x in reversed(states)][::-1]
    two.contact_depth(states[2])
    two.mass_matrix(states[2][:7])
    assert first[1] == two.step(states[1], []).tobytes()


# ---- the contract ---------------------------------------------------------------------------------------------------


@each_row("change", sorted(CHANGES.keys() - {"armature", "gear"}))
def test_a_change_is_found_and_named(tmp_path, monkeypatch, change):
    monkeypatch.setitem(PLAIN, "rotor", 0.0)  # Bullet has no armature, as is tested below
    changes, must, may, words = CHANGES[change]
    reference = dd.engines.load_engine("drake", arms(tmp_path))
    own = different(reference, bullet(arms(tmp_path)))
    assert own.keys() <= OWN
    found = different(reference, bullet(arms(tmp_path, **changes)))
    assert must <= found.keys() - own.keys() <= must | may
    first = next(quantity for quantity in found if quantity in must)
    assert all(word in found[first] for word in words), found[first]


@pytest.mark.parametrize("change", ["armature", "gear"])
def test_armature_is_what_bullet_has_not(tmp_path, change):
    model = arms(tmp_path, **CHANGES[change][0])
    found = different(dd.engines.load_engine("drake", model), bullet(model))
    assert found.keys() - OWN == {"armature", "M(q)"}
    assert "Bullet has no rotor inertia" in found["armature"]
    assert "left_joint_2" in found["armature"]


@pytest.mark.parametrize("wrong", ["quaternion order", "velocity frame", "none"])
def test_a_swapped_quaternion_or_velocity_frame_is_found(wrong, monkeypatch):
    model = free_box((0.1, 0.2, 0.3))
    drake, engine = dd.engines.load_engine("drake", model), bullet(model)
    module = sys.modules["drake_diff.engines.bullet"]
    real, x = module.rotation, np.array([0.5, 0.1, -0.7, 0.5, 1, 2, 3, 0.3, -0.4, 0.5, 1, 2, 3])
    x[:4] /= np.linalg.norm(x[:4])
    expected = formula(model, x, [], exponential=True)
    if wrong == "quaternion order":
        monkeypatch.setattr(module, "rotation", lambda q: real(np.roll(q, 1)))
    elif wrong == "velocity frame":
        monkeypatch.setattr("drake_diff.mechanics.coordinates.rotation", lambda q: np.eye(3))
    found = different(drake, engine)
    assert ("M(q)" in found) == (wrong != "none")
    assert "not that of Bullet's own step" in found["bias(q, v)"]
    assert (np.abs(engine.step(x, []) - expected).max() < 1e-12) == (wrong == "none")


def test_contacts_are_drakes_pairs_and_a_shape_that_is_not_built_is_named(load, tmp_path):
    for name in ("sphere_on_ground.sdf", "sliding_block.sdf", "two_spheres.sdf"):
        model = load(name)
        found = different(dd.engines.load_engine("drake", model), bullet(model)).keys()
        assert found <= {*OWN, "contact law", "dissipation", "bias(q, v)"}, name
    model = tetrahedron_on_ground(tmp_path)
    assert "body_shape" in different(dd.engines.load_engine("drake", model), bullet(model))["contact pairs"]


# ---- contact --------------------------------------------------------------------------------------------------------


@each_row("z, v", [(0.098, -0.3), (0.098, 0.0), (0.0995, 0.3), (0.098, 0.5)])
def test_one_step_of_landing_by_hand_is_an_implicit_spring(z, v):
    h, k, mu = 0.01, 1e4, 0.5
    model, _ = block_on_rails(h, mu)
    engine = bullet(model)
    push = max(0.0, k * ((0.1 - z) - h * (v - h * G)) / (1 + h * h * k))  # N = k (depth - h v'), m = 1
    after = engine.step([0, z, 1.0, v], [])
    np.testing.assert_allclose(after[3], v + h * (push - G), rtol=0, atol=1e-12)
    np.testing.assert_allclose(after[2], 1.0 - h * mu * push, rtol=0, atol=1e-12)  # Coulomb's, from 1 m/s
    assert engine.contact_depth([0, z, 0, v]) == pytest.approx(0.1 - z, abs=1e-15)


def test_it_rests_as_deep_as_drake_slides_and_stops():
    h, mu = 0.002, 0.5
    model, x = block_on_rails(h, mu)
    engine = bullet(model)
    for _ in range(300):
        x = engine.step(x, [])
    assert engine.contact_depth(x) == pytest.approx(G / 1e4, rel=1e-9)
    x[2], v = 0.5, [0.5]
    for _ in range(100):
        x = engine.step(x, [])
        v.append(x[2])
    np.testing.assert_allclose(np.diff(v)[:50], -h * mu * G, rtol=1e-7)
    np.testing.assert_allclose(v[52:], 0.0, atol=1e-12)


def test_links_are_given_what_makes_drakes_pairs_and_the_least_squares_where_pairs_disagree():
    plant = Plant(0.002)
    for name, k, mu in (("one", 1e4, 0.2), ("two", 3e4, 0.8)):
        plant.ball(name, 1.0, 0.1, contact_properties(k, 1, mu))
    plant.ground(contact_properties(2e4, 1, 0.5))
    drake = dd.engines.load_engine("drake", plant.model())
    engine = bullet(drake.model)
    wanted = {pair.names: pair for pair in drake.contract.contacts}
    for pair in engine.contract.contacts:  # with three pairs of three links all can be had
        assert pair.stiffness == pytest.approx(wanted[pair.names].stiffness, rel=1e-12)
        assert pair.friction == pytest.approx(wanted[pair.names].friction, rel=1e-12)
    assert "contact pairs" not in different(drake, engine)
    split = sys.modules["drake_diff.engines.bullet"].split
    square = [(("a", "b"), 1.0), (("b", "c"), 2.0), (("c", "d"), 1.0), (("d", "a"), 1.0)]  # a + c, b + d: 3 and 2
    found = split(square)
    assert [found[x] + found[y] for (x, y), _ in square] == pytest.approx([1.25, 1.75, 1.25, 0.75], rel=1e-12)


@pytest.mark.parametrize(("shape", "height"), [(Box(0.2, 0.3, 0.4), 0.2), (Cylinder(0.1, 0.4), 0.2),
                                               (Capsule(0.1, 0.4), 0.3)])  # fmt: skip
def test_shapes_stand_where_drakes_stand(shape, height):
    plant = Plant(0.002)
    body = plant.plant.AddRigidBody("body", SpatialInertia.SolidBoxWithMass(1.0, 0.2, 0.3, 0.4))
    plant.shape(body, shape, contact_properties(1e4), RigidTransform([0.1, 0.2, 0.3]))
    plant.ground(contact_properties(1e4))
    x = np.array([1, 0, 0, 0, 0, 0, height - 0.3 - 0.001, *[0] * 6])
    assert bullet(plant.model()).contact_depth(x) == pytest.approx(0.001, abs=1e-9)


# ---- refusals -------------------------------------------------------------------------------------------------------


def test_bad_input_and_what_bullet_has_not_are_named(load):
    engine = bullet(load("pendulum.urdf"))
    with pytest.raises(ShapeError, match="x"):
        engine.step([0.0], [0.0])
    with pytest.raises(NonFiniteError, match="u"):
        engine.step([0.0, 0.0], [np.nan])
    with pytest.raises(NotOfferedError, match="no derivatives"):
        engine.differentiate_step([0.0, 0.0], [0.0])
    with pytest.raises(NotOfferedError, match="free body"):
        bullet(free_box()).bias([1, 0, 0, 0, 0, 0, 1], np.zeros(6))
    with pytest.raises(SimulationError, match="Bullet"):
        bullet(load("double_pendulum.urdf")).step([0.0, 1.0, 1e200, 1e200], [0.0, 0.0])


def test_a_half_space_on_a_moving_link_is_refused(load):
    links = rigid_links(describe(load("pendulum.urdf"))).links
    half_space = Geometry("ramp", "pole", RigidTransform(), HalfSpace())
    with pytest.raises(ModelError, match="geometry ramp: Bullet has half spaces only on the world"):
        bullet_urdf([(0, links[0])], [(0, half_space)])


def test_pybullet_says_nothing_and_a_missing_one_is_named_with_its_extra():
    code = f"""import drake_diff as dd
model = dd.load_model({str(MODELS / "pendulum.urdf")!r}, time_step=0.01)
engine = dd.engines.load_engine('pybullet', model)
engine.step([0, 0], [0])  # and it lives to the end"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
    code = """import sys; sys.modules['pybullet'] = None
import drake_diff as dd
from drake_diff.exceptions import MissingDependencyError
try: dd.engines.load_engine('pybullet', None)
except dd.exceptions.MissingDependencyError as error: print(error)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install 'drake-diff[forward]'" in done.stdout

"""Compare Bullet's step with its formula, with Drake where both agree, and check its contact at rest."""

import sys

import numpy as np
import pytest
from helpers.contracts import different
from helpers.engines import needs
from helpers.forward_formula import formula, free_box
from helpers.models import Plant, contact_properties
from helpers.plants import block_on_rails
from helpers.table import each_row
from pydrake.geometry import HalfSpace
from pydrake.math import RigidTransform

import drake_diff as dd
from drake_diff.engines.formats import bullet_urdf
from drake_diff.exceptions import ModelError, NonFiniteError, NotOfferedError, ShapeError, SimulationError
from drake_diff.mechanics.description import Geometry, describe, rigid_links

needs("pybullet")
G = 9.81


def bullet(model):
    return dd.engines.load_engine("pybullet", model)


# ---- the step -------------------------------------------------------------------------------------------------------


def test_nothing_is_clamped_or_dragged_by_itself(load):
    engine, h = bullet(load("pendulum.urdf")), 0.01
    v = 500 - h * 0.1 * 500 / 0.25  # Bullet's default would clamp at 100 rad/s
    np.testing.assert_allclose(engine.step([0.0, 500.0], [0.0]), [h * v, v], rtol=1e-14)
    after = bullet(free_box()).step([1, 0, 0, 0, 0, 0, 1, 0, 0, 300, 500, 0, 0], [])
    np.testing.assert_allclose(after[[9, 10]], [300, 500], rtol=1e-14)


def test_what_is_beyond_a_limit_comes_back_by_a_fifth_of_it_each_step(load):
    engine, h = bullet(load("cart_pole.urdf")), 0.01  # the slide's limits are -2 and 2
    for beyond, v in ((0.01, 0.0), (0.001, 3.0)):
        assert engine.step([2 + beyond, 0, v, 0], [0])[2] == pytest.approx(-0.2 * beyond / h, abs=1e-12)
    assert engine.step([1.999, 0, 3.0, 0], [0])[2] == 3.0  # no force acts before the limit
    assert "0.2" in engine.contract.limit_law


# ---- the contract ---------------------------------------------------------------------------------------------------


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


# ---- contact --------------------------------------------------------------------------------------------------------


@each_row("z, v", [(0.098, -0.3), (0.098, 0.0), (0.0995, 0.3), (0.098, 0.5)])
def test_one_step_of_landing_by_hand_is_an_implicit_spring(z, v):
    h, k, mu = 0.01, 1e4, 0.5
    model, _ = block_on_rails(h, mu)
    engine = bullet(model)
    push = max(0.0, k * ((0.1 - z) - h * (v - h * G)) / (1 + h * h * k))  # N = k (depth - h v'), m = 1
    after = engine.step([0, z, 1.0, v], [])
    np.testing.assert_allclose(after[3], v + h * (push - G), rtol=0, atol=1e-12)
    np.testing.assert_allclose(after[2], 1.0 - h * mu * push, rtol=0, atol=1e-12)  # Coulomb friction, sliding at 1 m/s
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
    for pair in engine.contract.contacts:  # three pairs of three links can all be satisfied
        assert pair.stiffness == pytest.approx(wanted[pair.names].stiffness, rel=1e-12)
        assert pair.friction == pytest.approx(wanted[pair.names].friction, rel=1e-12)
    assert "contact pairs" not in different(drake, engine)
    split = sys.modules["drake_diff.engines.bullet"].split
    square = [(("a", "b"), 1.0), (("b", "c"), 2.0), (("c", "d"), 1.0), (("d", "a"), 1.0)]  # a + b + c + d: 2 or 3
    found = split(square)
    assert [found[x] + found[y] for (x, y), _ in square] == pytest.approx([1.25, 1.75, 1.25, 0.75], rel=1e-12)


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

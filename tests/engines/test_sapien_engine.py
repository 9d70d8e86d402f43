"""Compare PhysX's step with hand calculations, with Drake where both agree, and check its contact at rest."""

import numpy as np
import pytest
from helpers.contracts import different
from helpers.engines import needs
from helpers.forward_formula import formula, free_box
from helpers.models import Plant, contact_properties
from helpers.plants import block_on_rails
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia

import drake_diff as dd
from drake_diff.exceptions import ModelError, NonFiniteError, NotOfferedError, ShapeError, SimulationError

needs("sapien")
G = 9.81


def physx(model):
    return dd.engines.load_engine("sapien", model)


# ---- the step -------------------------------------------------------------------------------------------------------


@pytest.mark.solve
def test_nothing_is_clamped_or_dragged_by_itself(load):
    engine, h = physx(load("pendulum.urdf")), 0.01
    v = 500 / (1 + h * 0.1 / 0.25)  # PhysX's default would clamp at 100 rad/s
    np.testing.assert_allclose(engine.step([0.0, 500.0], [0.0]), [h * v, v], rtol=1e-6)
    after = physx(free_box()).step([1, 0, 0, 0, 0, 0, 1, 0, 0, 60, 500, 0, 0], [])
    np.testing.assert_allclose(after[[9, 10]], [60, 500], rtol=1e-6)


def test_a_tumbling_body_keeps_the_size_of_its_angular_momentum():
    h, w = 0.01, np.array([1.0, 2.0, 3.0])
    model = free_box((0, 0, 0), h)
    box = model.plant.GetBodyByName("box").default_spatial_inertia()
    inertia = np.diag(box.CalcRotationalInertia().CopyToFullMatrix3())
    after = physx(model).step([1, 0, 0, 0, 0, 0, 1, *w, 0, 0, 0], [])
    explicit = w - h * np.cross(w, inertia * w) / inertia
    scaled = explicit * np.linalg.norm(inertia * w) / np.linalg.norm(inertia * explicit)
    np.testing.assert_allclose(after[7:10], scaled, rtol=0, atol=1e-6)
    assert np.abs(scaled - explicit).max() > 1e-5  # the two can be distinguished


def test_a_limit_is_not_crossed_within_the_step_and_beyond_it_four_fifths_come_back(load):
    engine, h = physx(load("cart_pole.urdf")), 0.01  # the slide's limits are -2 and 2
    np.testing.assert_allclose(engine.step([1.999, 0, 3.0, 0], [0])[[0, 2]], [2.0, 0.001 / h], atol=1e-4)
    assert engine.step([2.01, 0, 0, 0], [0])[2] == pytest.approx(-0.8 * 0.01 / h, abs=1e-4)
    assert engine.step([1.9, 0, 3.0, 0], [0])[2] == pytest.approx(3.0, abs=1e-6)


# ---- the contract ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", ["quaternion order", "velocity frame", "none"])
def test_a_swapped_quaternion_or_velocity_frame_is_found(wrong, monkeypatch):
    model = free_box((0.1, 0.2, 0.3))
    engine = physx(model)
    x = np.array([0.5, 0.1, -0.7, 0.5, 1, 2, 3, 0.3, -0.4, 0.5, 1, 2, 3])
    x[:4] /= np.linalg.norm(x[:4])
    expected = formula(model, x, [], exponential=True)
    if wrong == "quaternion order":
        real = engine.centers.turn
        turn = lambda self, q: real(np.concatenate([np.roll(q[:4], 1), q[4:]]))  # noqa: E731
        monkeypatch.setattr(type(engine.centers), "turn", turn)
    elif wrong == "velocity frame":
        monkeypatch.setattr("drake_diff.mechanics.coordinates.rotation", lambda q: np.eye(3))
    assert (np.abs(engine.step(x, []) - expected).max() < 2e-6) == (wrong == "none")


# ---- contact --------------------------------------------------------------------------------------------------------


@pytest.mark.solve
def test_it_rests_at_no_depth_slides_by_coulomb_and_stops():
    h, mu = 0.002, 0.5
    model, _ = block_on_rails(h, mu)
    engine, x, v = physx(model), np.array([0, 0.1, 0.5, 0]), [0.5]
    for _ in range(150):
        x = engine.step(x, [])
        v.append(x[2])
        assert engine.contact_depth(x) < 1e-6
    np.testing.assert_allclose(np.diff(v)[:50], -h * mu * G, rtol=1e-3)  # 0.5 m/s in single precision, over 0.01 m/s
    np.testing.assert_allclose(v[53:], 0.0, atol=1e-5)


def test_what_is_deep_comes_out_and_what_would_not_touch_falls_through(load):
    model = load("sphere_on_ground.sdf", time_step=0.002)
    engine, x = physx(model), np.array(model.default_state)
    x[6] = 0.099
    assert engine.contact_depth(x) == pytest.approx(0.001, abs=1e-6)
    assert engine.step(x, [])[12] > 0
    plant = Plant(0.002)
    for name, height in (("one", 0.0), ("two", 0.15)):
        body = plant.ball(name, 1.0, 0.1, contact_properties(1e4))
        plant.plant.SetDefaultFloatingBaseBodyPose(body, RigidTransform([0, 0, height]))
    model = plant.model()
    engine = physx(model)
    assert engine.contact_depth(model.default_state) == pytest.approx(0.05, abs=1e-6)  # balls of one model can touch
    engine.groups = {}
    assert engine.contact_depth(model.default_state) == 0  # without collision groups they do not touch


def test_friction_of_a_pair_is_the_mean_of_the_two():
    h = 0.002
    model, _ = block_on_rails(h, 0.5)
    engine = physx(model)
    a, b = engine.pairs[0].names
    engine.friction = {a: 0.2, b: 0.6}
    after = engine.step(engine.step([0, 0.1, 1.0, 0], []), [])
    assert after[2] == pytest.approx(1.0 - 2 * h * 0.4 * G, abs=1e-5)
    assert engine.contract.contacts[0].friction == pytest.approx(0.4, rel=1e-6)


def test_a_link_and_its_parent_never_touch_and_the_contract_says_so():
    plant = Plant(0.002)
    one = plant.ball("one", 1.0, 0.1, contact_properties(1e4))
    lid = plant.plant.AddRigidBody("lid", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.plant.WeldFrames(one.body_frame(), lid.body_frame(), RigidTransform([0, 0, 0.5]))
    plant.shape(lid, Box(0.2, 0.2, 0.2), contact_properties(1e4))
    two = plant.plant.AddRigidBody("two", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.plant.AddJoint(PrismaticJoint("slide", one.body_frame(), two.body_frame(), [0, 0, 1]))
    plant.shape(two, Box(0.2, 0.2, 0.2), contact_properties(1e4))
    model = plant.model()
    x = np.array([1, 0, 0, 0, 0, 0, 0, 0.35, *[0] * 7])
    drake, engine = dd.engines.load_engine("drake", model), physx(model)
    assert drake.contact_depth(x) == pytest.approx(0.05, abs=1e-9)  # in Drake, two can touch the body welded to one
    assert "lid_shape" in different(drake, engine)["contact pairs"]
    engine.groups = {geometry.name: (1, 1) for _, geometry in engine.tree.geometries}
    assert engine.contact_depth(x) == 0  # PhysX ignores the pair even if the groups would allow it


def test_bad_input_and_what_physx_has_not_are_named(load):
    engine = physx(load("pendulum.urdf"))
    with pytest.raises(ShapeError, match="x"):
        engine.step([0.0], [0.0])
    with pytest.raises(NonFiniteError, match="u"):
        engine.step([0.0, 0.0], [np.nan])
    with pytest.raises(NotOfferedError, match="no derivatives"):
        engine.differentiate_step([0.0, 0.0], [0.0])
    for call in (lambda: engine.mass_matrix([0.0]), lambda: engine.bias([0.0], [0.0])):
        with pytest.raises(NotOfferedError, match="neither mass matrix"):
            call()
    with pytest.raises(SimulationError, match="PhysX"):
        engine.step([0.0, 1e300], [0.0])


def test_more_groups_than_physx_has_are_refused():
    from drake_diff.engines.physx import groups_by_shape
    from drake_diff.mechanics.description import PairContract

    chain = tuple(PairContract((f"shape {i}", f"shape {i + 1}"), 0.5, None) for i in range(40))
    with pytest.raises(ModelError, match="32 collision groups"):
        groups_by_shape(chain)
    groups = groups_by_shape(chain[:20])
    for i in range(21):
        for j in range(21):
            touch = groups[f"shape {i}"][0] & groups[f"shape {j}"][1]
            assert bool(touch) == (abs(i - j) == 1)

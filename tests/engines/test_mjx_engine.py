"""Compare MJX with hand calculations, Drake, MuJoCo and, in contact, finite differences of its own step.

JAX compiles for seconds per model, so all tests are marked slow.
"""

import numpy as np
import pytest
from helpers.contracts import arms, different, different_from_drake
from helpers.engines import G, engine_of, needs, on_tangent, own_mjcf
from helpers.forward_formula import free_box
from helpers.models import Plant, contact_properties, random_state
from helpers.plants import block_on_rails
from pydrake.geometry import Box, Cylinder
from pydrake.math import RigidTransform
from pydrake.multibody.tree import SpatialInertia

import drake_diff as dd
from drake_diff.engines.closed_form import MassSpringDamper, NumpyEngine
from drake_diff.exceptions import GradientError, ModelError
from drake_diff.mechanics.description import describe
from drake_diff.model.tangent import tangent_space

pytestmark = pytest.mark.slow


def assert_jacobian_is_that_of_the_step(engine, model, x, u, *, step=1e-6, atol=2e-8):
    """Compare with differences on the tangent space. With the solver at 1e-14 to 1e-13, errors are about 1e-8."""
    space, x_next = tangent_space(model), engine.step(x, u)
    A = on_tangent(model, engine.differentiate_step(x, u).A, x, x_next)
    for i, column in enumerate(A.T):
        e = step * np.eye(len(A))[i]
        ends = [space.minus(engine.step(space.plus(x, d), u), x_next) for d in (e, -e)]
        np.testing.assert_allclose(column, (ends[0] - ends[1]) / (2 * step), rtol=0, atol=atol)


# ---- free motion ---------------------------------------------------------------------------------------------------


def test_mass_spring_damper_by_hand_and_jax_is_left_as_it_was(load):
    model, hand, random = load("mass_spring_damper.sdf"), NumpyEngine(MassSpringDamper(), time_step=0.01), [0.3, -0.2]
    engine = engine_of("mjx", model)
    one, two = engine.differentiate_step(random, [1.5]), hand.differentiate_step(random, [1.5])
    np.testing.assert_allclose(engine.step(random, [1.5]), hand.step(random, [1.5]), rtol=0, atol=1e-14)  # rounding
    np.testing.assert_allclose(one.A, two.A, rtol=0, atol=1e-14)
    np.testing.assert_allclose(one.B, two.B, rtol=0, atol=1e-14)
    assert (one.method, engine.status, engine.contract.precision) == ("jax.jacfwd", "ok", "float64")
    import jax.numpy as jnp

    assert jnp.ones(1).dtype == jnp.float32


def test_a_turn_from_rest_has_its_derivative_and_says_that_mjx_has_it_not():
    model = free_box(mass=1.0)
    engine, x = engine_of("mjx", model), model.default_state
    x[4:7] = [1, 2, 3]
    found = engine.differentiate_step(x, [])
    assert found.method == "jax.jacfwd, turns from rest by hand"
    drake = dd.engines.load_engine("drake", model)
    A, A2 = (on_tangent(model, e.differentiate_step(x, []).A, x, e.step(x, [])) for e in (drake, engine))
    np.testing.assert_allclose(A2, A, rtol=0, atol=1e-14)  # rounding
    np.testing.assert_allclose(A2[:3, 6:9], 0.01 * np.eye(3), rtol=0, atol=1e-14)  # by hand: the rotation is h w
    x[7] = 2e-8  # above MJX's threshold for zero rotation, where jacfwd is correct
    again = engine.differentiate_step(x, [])
    assert again.method == "jax.jacfwd"
    np.testing.assert_allclose(on_tangent(model, again.A, x, engine.step(x, [])), A, rtol=0, atol=1e-9)


def test_mjx_still_loses_the_turn_from_rest(monkeypatch):
    """Check that MJX still has this error. When this test fails, `_put_turns_back` can be removed."""
    model = free_box(mass=1.0)
    engine, x = engine_of("mjx", model), model.default_state
    monkeypatch.setattr(type(engine), "_put_turns_back", lambda *_: "")
    A = on_tangent(model, engine.differentiate_step(x, []).A, x, engine.step(x, []))
    assert np.abs(A[:3, 6:9]).max() == 0


# ---- contact -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", ["sphere_on_ground.sdf", "sliding_block.sdf"])
def test_mjx_rests_as_deep_as_mujoco_and_drake(load, file):
    model = load(file, time_step=0.005)
    engine, mujoco, x = engine_of("mjx", model), engine_of("mujoco", model), model.default_state
    weight, points, radius = {"sphere_on_ground.sdf": (1, 1, 0.1), "sliding_block.sdf": (2, 4, 0.05)}[file]
    x[6] = radius
    for _ in range(1000):
        x = engine.step(x, [])
    assert engine.status == "ok"
    assert engine.contact_depth(x) == pytest.approx(weight * G / points / 1e4, rel=1e-9)  # settled for 5 s
    assert mujoco.contact_depth(x) == pytest.approx(engine.contact_depth(x), rel=1e-12)
    np.testing.assert_allclose(engine.step(x, []), mujoco.step(x, []), rtol=0, atol=1e-12)


def test_a_free_bodys_jacobian_in_contact_is_that_of_mjxs_own_step(load):
    model, random = load("sphere_on_ground.sdf", time_step=0.005), np.random.default_rng(5)
    engine, mujoco, x = engine_of("mjx", model), engine_of("mujoco", model), model.default_state
    x[:4] = random_state(model, random)[:4]
    x[6:] = [0.099, 0.3, 1, -0.5, 0.4, 0.2, -0.1]
    np.testing.assert_allclose(engine.step(x, []), mujoco.step(x, []), rtol=0, atol=1e-12)  # one law, two solvers
    assert_jacobian_is_that_of_the_step(engine, model, x, [])


def test_sliding_and_sticking_have_the_steps_jacobian_and_not_slipping_at_all_has_none():
    model, x = block_on_rails()
    engine, mujoco = engine_of("mjx", model), engine_of("mujoco", model)
    for speed in (1.0, 0.03, 1e-4):
        x[2] = speed
        np.testing.assert_allclose(engine.step(x, []), mujoco.step(x, []), rtol=0, atol=1e-12)
        assert_jacobian_is_that_of_the_step(engine, model, x, [])
    x[2] = 0.0
    np.testing.assert_allclose(engine.step(x, []), mujoco.step(x, []), rtol=0, atol=1e-12)
    with pytest.raises(GradientError, match="not finite"):  # d sqrt(0) in the line search of elliptic cones
        engine.differentiate_step(x, [])


def test_a_solver_that_stops_early_is_said(tmp_path):
    model, x = block_on_rails()
    x[2] = 0.03  # between sliding and sticking, where no Newton step is exact
    engine = own_mjcf("mjx", tmp_path, model, ("<option ", '<option iterations="1" '))
    engine.step(x, [])
    assert "unbalanced" in engine.status
    engine.step([0, 1, 0, 0], [])  # without contact the solver has nothing to solve
    assert engine.status == "ok"


def test_mjx_still_cannot_have_limits_with_elliptic_cones_and_no_contact(load):
    """Check that MJX still has this error. When this test fails, the engine need not set the cone."""
    needs("mjx")
    import jax
    from mujoco import mjx

    from drake_diff.engines.mujoco import mujoco_model

    _, compiled = mujoco_model(describe(load("cart_pole.urdf")), 0.01, None)
    model = mjx.put_model(compiled)
    with pytest.raises(TypeError, match="float32"):
        jax.eval_shape(mjx.step, model, mjx.make_data(model))


# ---- the contract, refusals ----------------------------------------------------------------------------------------


def test_the_contract_is_that_of_mjxs_own_model(tmp_path):
    model = arms(tmp_path)
    engine, drake = engine_of("mjx", model), dd.engines.load_engine("drake", model)
    own = different(drake, engine)
    import jax

    engine.model = engine.model.replace(body_mass=engine.model.body_mass * 1.01)
    with jax.enable_x64(True):
        engine.mjx = jax.tree.map(jax.numpy.asarray, engine.model)
    assert different(drake, engine).keys() - own.keys() == {"mass", "M(q)", "bias(q, v)"}


def test_the_integrator_is_drakes_or_refused(tmp_path):
    model = arms(tmp_path)
    found = different_from_drake(model, own_mjcf("mjx", tmp_path, model, ('"Euler"', '"implicitfast"')))
    assert "integrator" not in found
    with pytest.raises(ModelError, match="got RK4"):
        own_mjcf("mjx", tmp_path, model, ('"Euler"', '"RK4"'))


def test_an_integrator_and_a_cone_that_mjx_has_not_are_refused(tmp_path):
    with pytest.raises(ModelError, match="IMPLICIT"):
        own_mjcf("mjx", tmp_path, arms(tmp_path), ('"Euler"', '"implicit"'))
    with pytest.raises(ModelError, match="condim=1"):
        own_mjcf("mjx", tmp_path, block_on_rails()[0], ('condim="3"', 'condim="1"'))


def test_a_pair_that_mjx_has_no_collision_for_is_refused_by_name():
    plant = Plant(0.01)
    for name, shape in (("crate", Box(0.1, 0.2, 0.3)), ("can", Cylinder(0.1, 0.2))):
        body = plant.plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        plant.shape(body, shape, contact_properties(1e4), RigidTransform())
    with pytest.raises(ModelError, match=r"CYLINDER.*BOX"):
        engine_of("mjx", plant.model())

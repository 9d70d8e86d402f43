"""Compare Newton's step with its formula, with Drake where both agree, and check its contact at rest.

All tests are slow: the first one builds Newton's kernels, which takes half a minute with an empty cache.
"""

import numpy as np
import pytest
from helpers.contracts import different
from helpers.engines import free_state, needs, on_tangent
from helpers.forward_formula import formula, free_box
from helpers.models import robot
from helpers.plants import block_on_rails

import drake_diff as dd
from drake_diff.exceptions import NotOfferedError
from drake_diff.model.tangent import tangent_space

needs("newton")

pytestmark = pytest.mark.slow
G = 9.81


def newton(model):
    return dd.engines.load_engine("newton", model)


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
        # the tape has single precision, scaled by the largest entry
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


# ---- contact --------------------------------------------------------------------------------------------------------


def test_one_step_of_landing_by_hand():
    h, k, c = 0.002, 1e4, 100.0  # c is Newton's own damping
    model, _ = block_on_rails(h)
    engine = newton(model)
    for z, v in ((0.098, -0.3), (0.098, 0.3)):
        push = k * (0.1 - z) - c * min(v, 0.0)
        after = engine.step([0, z, 0, v], [])
        np.testing.assert_allclose(after[3], v + h * (push - G), rtol=0, atol=1e-5)  # 1e-8 m in z, times k
        assert engine.contact_depth([0, z, 0, v]) == pytest.approx(0.1 - z, abs=2e-8)
    assert "damper of 100 N s/m while closing" in engine.contract.contact_law


def test_it_rests_as_deep_as_drake_and_slides_by_coulomb_to_its_own_slope():
    h, friction, slope = 0.0005, 0.5, 1000.0  # explicit friction is stable for h slope / m < 2
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
    np.testing.assert_allclose(np.diff(v)[fast] / h, -friction * G, rtol=2e-3)  # 0.5 is rounded to 3e-8, divided by h
    slow = np.array(v[:-1])[~fast]
    np.testing.assert_allclose(np.array(v[1:])[~fast], slow * (1 - h * slope), rtol=1e-3, atol=1e-7)
    assert f"friction of {slope:g} N s/m" in engine.contract.contact_law


def test_a_ball_without_friction_is_not_slowed():
    model, x = block_on_rails(0.002, 0.0)
    engine, x = newton(model), x + np.array([0, 0, 1.0, 0])
    assert engine.step(x, [])[2] == 1.0


def test_a_limit_is_an_explicit_spring_and_damper(load):
    engine, h, ke, kd = newton(load("cart_pole.urdf", time_step=0.001)), 0.001, 1e4, 10.0  # slide limits: -2 and 2
    inside, beyond = engine.step([1.999, 0, 1.0, 0], [0]), engine.step([2.01, 0, 1.0, 0], [0])
    mass = engine.mass_matrix([2.01, 0])
    push = np.linalg.solve(mass, [-ke * 0.01 - kd * 1.0, 0])
    np.testing.assert_allclose((beyond - inside)[2:], h * push, rtol=0, atol=1e-5)
    assert "springs of 10000 and dampers of 10" in engine.contract.limit_law


# ---- refusals -------------------------------------------------------------------------------------------------------


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
    assert "buffer holds 0" in engine.status

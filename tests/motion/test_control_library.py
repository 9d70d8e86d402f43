"""python-control cross-checks the A and B of every engine: poles of A, LQR gains and costs."""

import numpy as np
import pytest
from helpers.engines import engine_of
from helpers.table import each_row

import drake_diff as dd
from drake_diff.motion import TVLQR

ENGINES = ["numpy", "drake", "mujoco", "pinocchio"]
H, G = 0.01, 9.81


@pytest.fixture(scope="module")
def control():
    return pytest.importorskip("control", reason="python-control is not installed")


def linearized(engine, model):
    x = np.zeros(model.nx)
    return engine.differentiate_step(x, np.zeros(model.nu))


@pytest.mark.solve
@each_row("name", ENGINES)
def test_the_poles_of_a_mass_on_a_spring(load, control, name):
    """For m v' = m v - h (k q + d v'), the poles solve z^2 (1 + h d/m) - z (2 + h d/m - h^2 k/m) + 1 = 0."""
    model = load("mass_spring_damper.sdf", time_step=H)
    A, B, _ = linearized(engine_of(name, model), model)
    contract = engine_of("drake", model).contract.joints[0]
    m, d, k = contract.mass + contract.armature, contract.damping, contract.stiffness
    assert min(m, k) > 0
    expected = np.roots([1 + H * d / m, -(2 + H * d / m - H**2 * k / m), 1])
    poles = control.ss(A, B, np.eye(2), 0, H).poles()
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(expected), atol=1e-9)


@pytest.mark.solve
@each_row("name", ENGINES)
def test_the_poles_of_a_hanging_pendulum(load, control, name):
    """With w^2 = m g l / J the free pendulum is a damped oscillator like the mass on a spring above."""
    model = load("pendulum.urdf", time_step=H)
    engine = engine_of(name, model)
    A, B, _ = linearized(engine, model)
    J = float(engine.mass_matrix(np.zeros(1))[0, 0])
    joint = engine_of("drake", model).contract.joints[0]
    lever = np.linalg.norm(np.array(joint.center_of_mass) - np.array(joint.anchor))
    expected = np.roots(
        [1 + H * joint.damping / J, -(2 + H * joint.damping / J - H**2 * joint.mass * G * lever / J), 1]
    )
    poles = control.ss(A, B, np.eye(2), 0, H).poles()
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(expected), atol=1e-8)


@each_row("name", ENGINES)
def test_the_lqr_gain_of_the_cart_pole_upright(load, control, name):
    """python-control's gain solves the Riccati equation, stabilizes the cart-pole, and is equal for all engines."""
    model = load("cart_pole.urdf", time_step=H)
    x = np.array([0.0, np.pi, 0.0, 0.0])
    A, B, _ = engine_of(name, model).differentiate_step(x, np.zeros(1))
    Q, R = np.diag([1.0, 10.0, 0.1, 0.1]), np.array([[0.1]])
    K, P, poles = control.dlqr(A, B, Q, R)
    gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    np.testing.assert_allclose(K, gain, rtol=1e-8)
    np.testing.assert_allclose(P, Q + A.T @ P @ (A - B @ K), rtol=1e-8)
    assert np.abs(np.linalg.eigvals(A)).max() > 1 > np.abs(poles).max()
    reference = engine_of("drake", model).differentiate_step(x, np.zeros(1))
    np.testing.assert_allclose(K, control.dlqr(reference.A, reference.B, Q, R)[0], rtol=1e-6)


def test_ilqrs_gain_at_rest_is_python_controls(load, control):
    """Far from the end of the horizon, the time-varying gain is the fixed point of the Riccati equation."""
    model = load("cart_pole.urdf", time_step=H)
    x = np.array([0.0, np.pi, 0.0, 0.0])
    Q, R = np.diag([1.0, 10.0, 0.1, 0.1]), np.array([[0.1]])
    found = dd.differentiate_step(model, x, np.zeros(1))
    K, *_ = control.dlqr(found.A, found.B, Q, R)
    policy = TVLQR(model, np.tile(x, (1501, 1)), np.zeros((1500, 1)), Q=Q, R=R, Qf=Q)
    np.testing.assert_allclose(policy.gains[0], K, rtol=1e-6)

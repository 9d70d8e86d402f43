"""Gradients of rollouts agree with closed forms and invariants of contact. Unsuitable losses are refused."""

import math

import numpy as np
import pytest
from helpers.models import Plant, contact_properties
from helpers.table import each_row, slow_after

import drake_diff as dd
from drake_diff._base.autodiff import plain
from drake_diff.derivatives.step import derivatives_along
from drake_diff.exceptions import GradientError, InputError


def test_the_double_integrators_gradient_and_norms_have_their_closed_form(write_urdf):
    """As x_N = x_0 + N h v_0 + h^2 / m sum_k (N - k) u_k, d x_N / d x_k is (1, (N - k) h)."""
    h, m, count = 0.1, 2.0, 7
    model = write_urdf(mass=m, time_step=h)
    us = np.random.default_rng(0).standard_normal((count, 1))
    g = dd.differentiate_rollout(model, [0.5, -1.0], us, lambda x: x[0])
    left = count - np.arange(count)
    assert g.loss == pytest.approx(0.5 - count * h + h**2 / m * float(left @ us[:, 0]), rel=1e-12)
    assert g.by_x0 == pytest.approx([1.0, count * h], rel=1e-12)
    assert g.by_us[:, 0] == pytest.approx(h**2 / m * left, rel=1e-12)
    assert g.state_gradient_norms == pytest.approx(
        [math.hypot(1, (count - k) * h) for k in range(count + 1)], rel=1e-12
    )
    assert g.methods == ("analytic",)


def test_a_loss_of_the_whole_motion_is_differentiated_too(write_urdf):
    """The loss is sum_k x_k + 3 sum_k u_k^2 over one step, x_1 = x_0 + h v_0 + h^2 u_0 / m."""
    model = write_urdf(mass=2.0, time_step=0.1)
    g = dd.differentiate_rollout(model, [0.5, -1.0], [[0.7]], lambda xs, us: xs[:, 0].sum() + 3 * (us**2).sum())
    assert g.by_x0 == pytest.approx([2.0, 0.1], rel=1e-12)
    assert g.by_us[0, 0] == pytest.approx(6 * 0.7 + 0.01 / 2, rel=1e-12)


def test_a_long_loss_is_differentiated_in_blocks_without_changing_it(load):
    """AutoDiffXd differentiates the 300 variables and more in blocks of 128."""
    model = load("pendulum.urdf")
    us = 0.1 * np.random.default_rng(1).standard_normal((150, 1))
    g = dd.differentiate_rollout(model, [0.1, 0.0], us, lambda xs, us: (xs**2).sum() + np.sin(us).sum())
    by_us = np.cos(us[-1, 0]) + 2 * float(g.xs[-1] @ dd.differentiate_step(model, g.xs[-2], us[-1]).B[:, 0])
    assert g.by_us[-1, 0] == pytest.approx(by_us, rel=1e-12)


def test_reverse_accumulation_is_the_product_of_the_steps(load):
    """The gradient is v' Phi with the product Phi of the steps' Jacobians. Rounding of 25 products is 1e-10."""
    model, random = load("acrobot.xml"), np.random.default_rng(2)
    x0, us, v = random.standard_normal(4), random.standard_normal((25, 1)), random.standard_normal(4)
    product = np.eye(4)
    for d in derivatives_along(model, x0, us):
        product = d.A @ product
    g = dd.differentiate_rollout(model, x0, us, lambda x: v @ x)
    assert g.by_x0 == pytest.approx(v @ product, rel=1e-10)


def test_the_projectiles_jacobian_is_exact(load):
    """The exact derivatives are d p_N / d v_0 = N h I and d p_N / d p_0 = I."""
    model = load("projectile.sdf")
    for i in range(3):
        g = dd.differentiate_rollout(model, model.default_state, None, lambda x, i=i: x[4 + i], num_steps=100)
        assert g.by_x0[4:7] == pytest.approx(np.eye(3)[i], abs=1e-12)
        assert g.by_x0[10:] == pytest.approx(np.eye(3)[i], abs=1e-12)


@pytest.mark.solve
@each_row("masses", [(1.0, 1.0), (1.0, 2.0)])
@each_row("approximation", ["lagged", "sap"])
def test_momentum_invariants_of_a_collision(masses, approximation):
    """Any contact law has sum_i m_i dv_i/dv_j = m_j, and in the same way dv/dx -> 0, dx/dx -> m_j, dx/dv -> m_j T."""
    h, count = 1e-3, 1000
    plant = Plant(h, approximation, gravity=0.0)
    for name, mass in zip("ab", masses, strict=True):
        plant.ball(name, mass, 0.1, contact_properties(2e4, dissipation=5.0, relaxation_time=0.01), "x")
    model = plant.model()
    product = np.eye(4)
    steps = derivatives_along(model, np.array([0.0, 0.52, 1.0, 0.0]), np.zeros((count, 0)))
    for d in steps:
        product = d.A @ product
    m = np.array(masses)
    assert steps[-1].x_next[3] > 0.1  # the balls collided
    assert m @ product[2:, 2:] == pytest.approx(m, rel=1e-9)
    assert m @ product[2:, :2] == pytest.approx([0, 0], abs=1e-8)
    assert m @ product[:2, :2] == pytest.approx(m, rel=1e-9)
    assert m @ product[:2, 2:] == pytest.approx(m * count * h, rel=1e-9)


def bouncing_ball(k):
    plant = Plant(1 / 480, "lagged", gravity=0.0)
    plant.ball("ball", 1.0, 0.1, contact_properties(2 * k), "z")
    plant.ground(contact_properties(2 * k))
    return plant.model()


@pytest.mark.slow
@pytest.mark.parametrize(("k", "at_least"), slow_after(1, [(1e3, 0.05), (1e4, 0.5)]))
def test_a_compliant_bounce_does_not_have_the_rigid_gradient(k, at_least):
    """A lossless bounce off the ground has dy/dy0 = dy/dv0 = -1. The gradient of Drake's discrete contact is wrong by
    10 to 400 %, more for stiffer contact, although differences confirm it. It is useless for optimization."""
    model = bouncing_ball(k)
    start = [1.001, -2.0]
    g = dd.differentiate_rollout(model, start, None, lambda x: x[0], num_steps=480)
    assert g.loss == pytest.approx(1.2, rel=0.35)  # the motion is close to the rigid one, y(T) = 1.2
    assert np.abs(g.by_x0 + 1).max() > at_least  # the gradient is not close
    dd.certify_rollout(model, start, None, lambda x: x[0], num_steps=480).require()


def test_gradient_by_parameters_is_accumulated(write_urdf, load):
    """The derivative of x_N with respect to the mass is -h^2 / m^2 sum_k (N - k) u_k."""
    h, m, count = 0.1, 2.0, 5
    us = np.ones((count, 1))
    g = dd.differentiate_rollout(
        write_urdf(mass=m, time_step=h), [0, 0], us, lambda x: x[0], parameters=("block.mass",)
    )
    assert g.parameter_names == ("block.mass",)
    assert g.by_parameters == pytest.approx([-(h**2) / m**2 * sum(range(1, count + 1))], rel=1e-10)


@each_row(
    "loss, error, words",
    [
        (lambda x: 1.0, GradientError, "plain number"),
        (lambda x: float(plain(x)[0]), GradientError, "plain number"),
        (lambda x: x, InputError, r"^loss <lambda> .*: expected shape \(\), got shape \(2,\)"),
        (lambda: 1.0, InputError, r"loss\(xs, us\) or loss\(x_final\)"),
        (lambda x: np.log(x[0] - x[0]), GradientError, "not finite"),
    ],
)
def test_a_loss_that_carries_no_gradient_is_refused(load, loss, error, words):
    with pytest.raises(error, match=words):
        dd.differentiate_rollout(load("pendulum.urdf"), [0.1, 0.0], [[0.0]], loss)


def test_lqr_sensitivity_of_the_optimal_cost(write_urdf):
    """d J* / d x_0 = 2 P_0 x_0, by the envelope theorem at the optimal inputs."""
    h, Q, R, Qf = 0.1, np.eye(2), 0.1, 10 * np.eye(2)
    model = write_urdf(time_step=h)
    d = dd.differentiate_step(model, [0, 0], [0])
    assert pytest.approx(np.array([[1, h], [0, 1]]), rel=1e-12) == d.A
    assert pytest.approx(np.array([[h**2], [h]]), rel=1e-12) == d.B
    P, gains = Qf, []
    for _ in range(20):
        K = np.linalg.solve(R + d.B.T @ P @ d.B, d.B.T @ P @ d.A)
        P = Q + d.A.T @ P @ (d.A - d.B @ K)
        gains.append(K)
    x, us = np.array([1.0, 0.0]), []
    for K in reversed(gains):
        us.append(-K @ x)
        x = d.A @ x + d.B @ us[-1]

    def cost(xs, us):
        return sum(x @ Q @ x for x in xs[:-1]) + sum(R * (u @ u) for u in us) + xs[-1] @ Qf @ xs[-1]

    g = dd.differentiate_rollout(model, [1.0, 0.0], us, cost)
    assert g.loss == pytest.approx(12.948481280713864, rel=1e-12)
    assert g.by_x0 == pytest.approx([25.89696256, 5.23643035], abs=1e-8)
    assert np.abs(g.by_us).max() < 1e-12

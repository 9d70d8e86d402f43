"""Batches of rollouts and of their gradients are the rollouts and gradients of their entries."""

import numpy as np
import pytest

import drake_diff as dd
from drake_diff.exceptions import InputError, NonFiniteError, ShapeError
from drake_diff.motion import ParametricPolicy
from drake_diff.motion.loss import accumulate


def motions(model, *batch, steps=5):
    random = np.random.default_rng(0)
    return random.standard_normal((*batch, model.nx)), random.standard_normal((*batch, steps, model.nu))


def test_a_batch_of_rollouts_has_the_states_and_measurements_of_each(load):
    model = load("double_pendulum.urdf")
    x0, us = motions(model, 2, 3)
    batch = dd.rollout(model, x0, us)
    assert batch.xs.shape == (2, 3, 6, 4)
    assert batch.times.shape == (6,)
    for i, j in np.ndindex(2, 3):
        alone = dd.rollout(model, x0[i, j], us[i, j])
        for name in ("xs", "us", "efforts", "energy", "energy_error", "penetration", "constraint_violation"):
            assert np.array_equal(getattr(batch, name)[i, j], getattr(alone, name)), name
        for name in ("energy_drift", "energy_exchanged", "energy_oscillation"):
            assert getattr(batch, name)[i, j] == pytest.approx(getattr(alone, name), rel=1e-12, abs=1e-15)
    assert repr(batch).startswith("(2, 3) rollouts of 5 steps, 0.05 s: up to ")


def test_leading_dimensions_are_broadcast(load):
    model = load("cart_pole.urdf")
    x0, us = motions(model, 3)
    for starts, inputs in ((x0, us[0]), (x0[0], us), (x0[:, None], us[:1])):
        batch = dd.rollout(model, starts, inputs)
        full = np.broadcast_to(starts[..., None, :], (*batch.xs.shape[:-2], 1, 4))
        assert np.array_equal(batch.xs[..., :1, :], full)
    policy = dd.PD(model, 1.0, 0.1)
    assert dd.rollout(model, x0, policy=policy, num_steps=4).us.shape == (3, 4, 1)


def test_contacts_of_a_batch_are_those_of_each_rollout(load):
    model = load("sphere_on_ground.sdf")
    low, high = model.default_state, model.default_state
    low[6], high[6] = 0.0999, 1.0
    batch = dd.rollout(model, [high, low], np.zeros((3, model.nu)))
    assert [[bool(step) for step in rollout] for rollout in batch.contacts] == [[False] * 3, [True] * 3]
    assert "3 steps with contact" in repr(batch)


@pytest.mark.parametrize("policy", [False, True])
def test_a_batch_of_gradients_is_the_gradients_of_each(load, policy):
    model = load("cart_pole.urdf")
    x0, us = motions(model, 3)
    more = {"parameters": ("pole.mass",)}
    if policy:
        us = [None] * 3
        more |= {"policy": ParametricPolicy(lambda x, t, p: np.tanh(p[None] @ x), np.ones(4)), "num_steps": 5}

    def loss(xs, us):
        return (xs**2).sum() + (us**2).sum()

    batch = dd.differentiate_rollout(model, x0, None if policy else us, loss, **more)
    for i in range(3):
        alone = dd.differentiate_rollout(model, x0[i], us[i], loss, **more)
        for name in ("loss", "by_x0", "by_us", "by_parameters", "by_policy", "state_gradient_norms"):
            assert np.array_equal(getattr(batch, name)[i], getattr(alone, name)), name
        assert batch.growth_rate[i] == pytest.approx(alone.growth_rate, rel=1e-12)
    assert batch.by_us.shape == (3, 5, 1)
    assert repr(batch).startswith("RolloutGradient of (3,) rollouts of 5 steps by ")


def test_a_batch_in_continuous_time_names_the_undefined_columns_of_all(load):
    """One ball is far from the ground, the other touches it exactly at the end."""
    model = load("sphere_on_ground.sdf")
    x0 = np.array([[1.0, 0, 0, 0, 0, 0, z, 0, 0, 0, 0, 0, 0] for z in (1.0, 0.2964)])
    with pytest.warns(dd.exceptions.GradientWarning, match="no slope"):
        g = dd.differentiate_rollout(model, x0, None, lambda x: x[12], num_steps=20, method="continuous")
    assert [entry.column for entry in g.undefined] == ["ball_z[0]", "ball_vz[0]"]
    assert g.methods == ("continuous",)


@pytest.mark.parametrize(
    ("x0", "us", "error", "words"),
    [
        (np.zeros((2, 3)), np.zeros((5, 1)), ShapeError, r"x0: expected shape \(..., 4\)"),
        (np.zeros((2, 4)), np.zeros((2, 5, 2)), ShapeError, r"us: expected shape \(..., N, 1\)"),
        (np.zeros((2, 4)), np.zeros((3, 5, 1)), InputError, r"got leading dimensions \[\(2,\), \(3,\)\]"),
        (np.zeros((0, 4)), np.zeros((5, 1)), InputError, "at least one entry"),
        (np.full((2, 4), np.nan), np.zeros((5, 1)), NonFiniteError, r"x0\[0, 0\]"),
    ],
)
def test_a_batch_that_does_not_fit_is_refused(load, x0, us, error, words):
    for call in (dd.rollout, lambda *point: dd.differentiate_rollout(*point, lambda x: x[0])):
        with pytest.raises(error, match=words):
            call(load("cart_pole.urdf"), x0, us)


def test_the_adjoint_of_a_batch_is_the_transposed_product_of_the_jacobians():
    """In each motion, d x_2 / d (x_0, u_0, u_1, p) is (A1 A0, A1 B0, B1, A1 C0 + C1)."""
    random = np.random.default_rng(1)
    jacobians, by_xs = random.standard_normal((4, 2, 3, 3 + 2 + 1)), np.zeros((4, 3, 3))
    by_xs[:, 2] = random.standard_normal((4, 3))
    totals = accumulate(jacobians, by_xs, np.zeros((4, 2, 2)))
    for i, ((A0, A1), row) in enumerate(zip(jacobians, by_xs[:, 2], strict=True)):
        after = row @ A1[:, :3]
        np.testing.assert_allclose(totals.states[i, 0], after @ A0[:, :3], rtol=1e-12)
        np.testing.assert_allclose(totals.inputs[i], [after @ A0[:, 3:5], row @ A1[:, 3:5]], rtol=1e-12)
        np.testing.assert_allclose(totals.parameters[i], after @ A0[:, 5:] + row @ A1[:, 5:], rtol=1e-12)

"""Tests of the tangent space: plus and minus are inverse, and their derivatives agree with finite differences."""

import numpy as np
import pytest
from helpers.models import random_state

import drake_diff as dd
from drake_diff.model.tangent import tangent_space


@pytest.fixture
def free_body(load):
    model = load("projectile.sdf")
    return model, tangent_space(model), random_state(model, np.random.default_rng(0))


def test_it_has_one_dimension_less_for_a_quaternion(free_body, load):
    _, space, _ = free_body
    assert (space.size, space.nx) == (12, 13)
    assert tangent_space(load("cart_pole.urdf")).size == 4


def test_minus_undoes_plus(free_body):
    _, space, x = free_body
    d = np.random.default_rng(1).standard_normal(12)
    assert space.minus(space.plus(x, d), x) == pytest.approx(d, rel=1e-12)


def test_plus_keeps_the_quaternions_norm(free_body):
    _, space, x = free_body
    scaled = x.copy()
    scaled[:4] *= 1.7
    assert np.linalg.norm(space.plus(scaled, np.ones(12))[:4]) == pytest.approx(1.7, rel=1e-14)


def test_q_and_minus_q_are_the_same_rotation(free_body):
    _, space, x = free_body
    flipped = x.copy()
    flipped[:4] *= -1
    assert space.minus(flipped, x) == pytest.approx(np.zeros(12), abs=1e-15)


def test_the_tangent_follows_drakes_angular_velocity(free_body):
    """One step with angular velocity w turns by h w, expressed in the world frame, to first order in h."""
    model, space, x = free_body
    turned = dd.step(model, x)
    assert space.minus(turned, x)[:3] == pytest.approx(0.01 * x[7:10], rel=1e-12)


def test_the_derivatives_are_those_of_differences(free_body):
    _, space, x = free_body
    h, e = 1e-6, np.eye(12)
    plus = np.array([(space.plus(x, h * d) - space.plus(x, -h * d)) / (2 * h) for d in e]).T
    assert space.derivative_of_plus(x) == pytest.approx(plus, abs=1e-9)
    scaled = x.copy()
    scaled[:4] *= 1.3  # Drake's step does not keep the norm
    minus = [(space.minus(scaled + h * d, scaled) - space.minus(scaled - h * d, scaled)) / (2 * h) for d in np.eye(13)]
    assert space.derivative_of_minus(scaled) == pytest.approx(np.array(minus).T, abs=1e-9)


def test_minus_after_plus_is_the_identity_to_first_order(free_body):
    _, space, x = free_body
    assert space.derivative_of_minus(x) @ space.derivative_of_plus(x) == pytest.approx(np.eye(12), abs=1e-14)

"""Tests of costs: formulas, exact derivatives of functions, and refusal of costs without a gradient."""

import numpy as np
import pytest
from helpers.table import each_row
from pydrake.autodiffutils import InitializeAutoDiff

import drake_diff as dd
from drake_diff.exceptions import GradientError, InputError
from drake_diff.optimize.problem.cost import (
    CostToGo,
    differentiate_cost,
    differentiate_final_cost,
    final_cost_hessian,
    running_cost_hessian,
)


def random_weight(random, n):
    half = random.standard_normal((n, n))
    return half @ half.T


def test_a_quadratic_costs_gradient_is_that_of_autodiff_through_it():
    random = np.random.default_rng(0)
    cost = dd.QuadraticCost(random_weight(random, 3), random_weight(random, 2), random.random(3), random.random(2))
    x, u = random.standard_normal(3), random.standard_normal(2)
    value, by_x, by_u = differentiate_cost(cost, x, u)
    z = InitializeAutoDiff(np.concatenate([x, u])).ravel()
    autodiff = cost(z[:3], z[3:])
    assert autodiff.value() == pytest.approx(value, rel=1e-14)  # rounding of a few sums
    assert np.concatenate([by_x, by_u]) == pytest.approx(autodiff.derivatives(), rel=1e-12)


def test_a_cost_to_gos_derivatives_are_those_of_autodiff_through_it():
    random = np.random.default_rng(1)
    cost = CostToGo(random.random(3), random.standard_normal(3), random_weight(random, 3))
    x = random.standard_normal(3)
    value, gradient = differentiate_final_cost(cost, x)
    autodiff = cost(InitializeAutoDiff(x).ravel())
    assert autodiff.value() == pytest.approx(value, rel=1e-14)  # rounding of a few sums
    assert gradient == pytest.approx(autodiff.derivatives(), rel=1e-12)
    moved = differentiate_final_cost(cost, x + np.eye(3)[1])[1] - gradient
    assert final_cost_hessian(cost, x)[1] == pytest.approx(moved, rel=1e-12)


def test_a_functions_gradient_is_the_closed_form():
    """The function is sin(x0) exp(u0) + x1^2 u1."""
    x, u = np.array([0.4, -1.3]), np.array([0.2, 0.9])
    value, by_x, by_u = differentiate_cost(lambda x, u: np.sin(x[0]) * np.exp(u[0]) + x[1] ** 2 * u[1], x, u)
    assert value == pytest.approx(np.sin(0.4) * np.exp(0.2) + 1.69 * 0.9, rel=1e-14)
    assert by_x == pytest.approx([np.cos(0.4) * np.exp(0.2), 2 * -1.3 * 0.9], rel=1e-14)
    assert by_u == pytest.approx([np.sin(0.4) * np.exp(0.2), 1.69], rel=1e-14)


def test_a_gradient_by_hundreds_of_variables_is_whole():
    """AutoDiffXd takes 128 directions at a time, so that 300 variables need three rounds, the last one not full."""
    weights = np.arange(1.0, 301.0)
    x, u = np.linspace(-1, 1, 200), np.linspace(2, 3, 100)
    _, by_x, by_u = differentiate_cost(lambda x, u: weights[:200] @ (x * x) + weights[200:] @ (u * u), x, u)
    assert by_x == pytest.approx(2 * weights[:200] * x, rel=1e-14, abs=1e-14)
    assert by_u == pytest.approx(2 * weights[200:] * u, rel=1e-14)


def test_a_functions_hessian_is_the_closed_form():
    """cosh(x0) + x1^2 u0^2 + u0^4 is convex near (0.5, 1, 1). A central difference of 1e-5 leaves about 1e-9."""
    x, u = np.array([0.5, 1.0]), np.array([1.0])
    hessian = running_cost_hessian(lambda x, u: np.cosh(x[0]) + x[1] ** 2 * u[0] ** 2 + u[0] ** 4, x, u)
    expected = np.array([[np.cosh(0.5), 0, 0], [0, 2, 4], [0, 4, 14]])
    assert hessian == pytest.approx(expected, abs=1e-7)


def test_an_indefinite_hessian_keeps_its_positive_part():
    """x0 x1 has the eigenvalues +1 along (1, 1) and -1 along (1, -1). The positive part is [[1, 1], [1, 1]] / 2."""
    hessian = final_cost_hessian(lambda x: x[0] * x[1], np.array([0.3, -0.2]))
    assert hessian == pytest.approx(np.full((2, 2), 0.5), abs=1e-8)


@each_row(
    "fields, words",
    [
        ({"R": [[1.0, 1e-6], [0.0, 1.0]]}, "R: expected a symmetric matrix, got a matrix that is not"),
        ({"R": [[1.0, 2.0], [2.0, 1.0]]}, "R: expected a positive semidefinite matrix, got lowest eigenvalue -1"),
        ({"R": [[np.inf]]}, r"R\[0, 0\]: expected a finite number, got inf"),
        ({"Q": [1.0, 2.0]}, r"Q: expected shape \(n, n\), got shape \(2,\)"),
        ({"Q": "heavy"}, "Q: expected an array of numbers, got 'heavy'"),
        ({"Q": np.eye(2), "x_ref": [1.0]}, r"x_ref: expected shape \(2,\), got shape \(1,\)"),
        ({"R": np.eye(1), "u_ref": [np.nan]}, r"u_ref\[0\]: expected a finite number, got nan"),
    ],
)
def test_a_bad_weight_or_reference_is_named(fields, words):
    with pytest.raises(InputError, match=words):
        dd.QuadraticCost(**fields)


@each_row(
    "cost, words",
    [
        (lambda x, u: 1.0, "lost its derivatives"),
        (lambda x, u: x[0].value(), "lost its derivatives"),
        (lambda x, u: float(x[0]), "lost its derivatives"),
        (lambda x, u: x[0] * np.nan, "not finite"),
        (lambda x, u: np.sqrt(x[0] - 1.0), "not finite"),  # a vertical slope at x0 = 1
    ],
)
def test_a_cost_without_a_usable_gradient_is_refused(cost, words):
    with pytest.raises(GradientError, match=words):
        differentiate_cost(cost, np.array([1.0]), np.array([1.0]))


def test_a_cost_that_is_no_scalar_is_refused():
    with pytest.raises(InputError, match="expected one scalar, got 2 values"):
        differentiate_final_cost(lambda x: x, np.ones(2))


def test_a_quadratic_cost_along_a_motion_is_the_sum_of_its_calls():
    """The tolerance of 1e-14 allows for rounding in products of two and three numbers."""
    random = np.random.default_rng(0)
    xs, us = random.standard_normal((5, 3)), random.standard_normal((5, 2))
    xs[3, 0] = np.nan
    Q, R, x_ref, u_ref = np.diag([1.0, 0, 2]), np.array([[2.0, 0.5], [0.5, 1.0]]), np.ones(3), -np.ones(2)
    for parts in ({"Q": Q}, {"R": R, "u_ref": u_ref}, {"Q": Q, "R": R, "x_ref": x_ref}, {}):
        cost = dd.QuadraticCost(**parts)
        expected = [cost(x, u) for x, u in zip(xs, us, strict=True)]
        np.testing.assert_allclose(cost(xs, us), expected, rtol=1e-14)

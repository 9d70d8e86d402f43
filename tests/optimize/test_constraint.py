"""Tests of constraints: refused input, the knots at which they apply, their values and derivatives."""

import numpy as np
import pytest
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import GradientError, InputError
from drake_diff.optimize.problem.constraint import Constraint


def test_values_and_jacobian_are_those_of_the_formula():
    c = Constraint(lambda x, u: np.array([x[0] ** 2 + u[0], np.sin(x[1])]), lower=0, upper=[1, 2]).resolved(
        np.zeros(2), np.zeros(1)
    )
    values, rows = c.differentiate(np.array([3.0, 0.5]), np.array([2.0]))
    np.testing.assert_allclose(values, [11, np.sin(0.5)], rtol=1e-15)
    np.testing.assert_allclose(rows, [[6, 0, 1], [0, np.cos(0.5), 0]], rtol=1e-15)
    assert c.excess(np.array([3.0, 0.5]), np.array([2.0])) == 10.0
    assert c.excess(np.array([np.nan, 0.5]), np.array([2.0])) == np.inf


@each_row(
    "knots, takes_input, given, expected",
    [
        (None, False, True, (1, 2, 3)),
        (None, False, False, (0, 1, 2, 3)),
        (None, True, True, (0, 1, 2)),
        (-1, False, True, (3,)),
        ([-1, 0], True, True, (0, 2)),
        ((2, 2), False, True, (2,)),
    ],
)
def test_it_holds_at_these_knots_of_three_steps(knots, takes_input, given, expected):
    function = (lambda x, u: x[0] + u[0]) if takes_input else (lambda x: x[0])
    assert Constraint(function, upper=1, knots=knots).at_knots(3, given) == expected


@each_row("knots", [4, [-5], [], 1.5, ["a"], [[1]]])
def test_knots_that_are_none_are_refused(knots):
    with pytest.raises(InputError, match="expected whole numbers from -4 to 3"):
        Constraint(lambda x: x[0], upper=1, knots=knots).at_knots(3, True)


@each_row(
    "fields, match",
    [
        ({}, "no lower and no upper"),
        ({"lower": 2, "upper": 1}, "a lower bound of at most the upper bound"),
        ({"lower": np.nan}, "a lower bound of at most the upper bound"),
        ({"lower": [0, 0], "upper": [1, 1, 1]}, "shape"),
        ({"lower": "low"}, "numbers"),
    ],
)
def test_bounds_that_cannot_be_kept_are_refused(fields, match):
    with pytest.raises(InputError, match=match):
        Constraint(lambda x: x[0], **fields)


def pendulum(**fields):
    model = dd.load_model("models/pendulum.urdf", time_step=0.01)
    return dd.Problem(model, x0=[0, 0], num_steps=10, x_goal=[1, 0], **fields)


@pytest.mark.parametrize(
    ("function", "match"),
    [
        (lambda x: np.zeros((2, 2)), "shape"),
        (lambda x: np.zeros(3), "3 values"),
        (lambda x: x[7], "IndexError"),
    ],
)
def test_a_problem_refuses_a_function_that_is_no_constraint(function, match):
    with pytest.raises(InputError, match=match):
        pendulum(constraints=Constraint(function, upper=[1, 1]))


def test_a_lost_derivative_is_an_error():
    c = Constraint(lambda x: float(getattr(x[0], "value", lambda: x[0])()), upper=1).resolved(np.zeros(1), np.zeros(0))
    with pytest.raises(GradientError, match="lost its derivatives"):
        c.differentiate(np.zeros(1), np.zeros(0))


def test_the_excess_names_constraint_and_knot():
    problem = pendulum(constraints=Constraint(lambda x: x[0], upper=0.5, name="low"), waypoints={4: [0.1, np.nan]})
    xs = np.zeros((11, 2))
    xs[7, 0], xs[4, 0] = 2, 0.4
    assert problem.constraint_excess(xs, np.zeros((10, 1))) == {
        "low": (1.5, 7),
        "waypoint at knot 4": (pytest.approx(0.3), 4),
    }

"""Tests of problems and costs: their meaning, and problems that are refused before anything runs."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError, ShapeError
from drake_diff.optimize.problem.cost import differentiate_cost, running_cost_hessian

R = dd.QuadraticCost(R=[[1.0]])


def cart_pole(load, **changes):
    fields = {"x0": [0, 0, 0, 0], "x_goal": [1, np.pi, 0, 0], "num_steps": 10, "running_cost": R}
    return dd.Problem(load("cart_pole.urdf"), **{**fields, **changes})


def test_the_objective_is_a_rate_times_the_time_step_plus_the_final_cost(load):
    model = load("pendulum.urdf", time_step=0.02)
    problem = dd.Problem(
        model, x0=[0, 0], num_steps=2, running_cost=lambda x, u: x[0] + 2 * u[0], final_cost=lambda x: 10 * x[1]
    )
    xs, us = np.array([[1.0, 0], [2.0, 0], [3.0, 4.0]]), np.array([[0.5], [1.5]])
    assert problem.objective(xs, us) == pytest.approx(0.02 * (1 + 2 * 0.5 + 2 + 2 * 1.5) + 40, rel=1e-14)
    knots = np.array([[0.5], [1.5], [2.5]])
    trapezoid = 0.02 * ((1 + 1) / 2 + (2 + 3) + (3 + 5) / 2)
    assert problem.objective(xs, knots) == pytest.approx(trapezoid + 40, rel=1e-14)


def test_a_quadratic_cost_has_no_half():
    cost = dd.QuadraticCost(Q=[[2.0, 1.0], [1.0, 3.0]], R=[[4.0]], x_ref=[1, 0], u_ref=[0.5])
    x, u = np.array([2.0, -1.0]), np.array([1.5])
    assert cost(x, u) == pytest.approx(2 - 2 + 3 + 4, rel=1e-15)  # (1, -1) Q (1, -1)' = 2 - 2 + 3; 4 * 1^2
    assert cost(x) == pytest.approx(3.0, rel=1e-15)
    value, by_x, by_u = differentiate_cost(cost, x, u)
    assert value == pytest.approx(7.0, rel=1e-15)
    assert by_x == pytest.approx([2 * (2 - 1), 2 * (1 - 3)], rel=1e-15)
    assert by_u == pytest.approx([8.0], rel=1e-15)
    hessian = running_cost_hessian(cost, x, u)
    assert hessian == pytest.approx(np.array([[4, 2, 0], [2, 6, 0], [0, 0, 8]]), abs=0)


def test_the_models_limits_apply_where_no_bound_is_given(load):
    b = cart_pole(load).bounds
    assert (b.x_lower[0], b.x_upper[0], b.u_lower[0], b.u_upper[0]) == (-2, 2, -20, 20)
    assert np.isinf(b.x_upper[1])


def test_nan_means_the_models_limit_and_inf_means_none(load):
    b = cart_pole(load, bounds=dd.Bounds(x_upper=[math.nan, 4.0, math.nan, 1.0], u_upper=[math.inf])).bounds
    assert b.x_upper.tolist() == [2.0, 4.0, math.inf, 1.0]
    assert b.u_upper.tolist() == [math.inf]


def test_a_nan_goal_is_free(load):
    problem = cart_pole(load, x_goal=[math.nan, np.pi, math.nan, 0])
    assert problem.goal_error(np.array([9.0, 3.0, 9.0, 0.5])) == pytest.approx([0, 3 - np.pi, 0, 0.5])


@pytest.mark.solve
@each_row(
    "changes, words",
    [
        ({"x0": [0, 0]}, r"x0: expected shape \(4,\), got shape \(2,\)"),
        ({"x0": [0, 0, 0, math.nan]}, r"x0\[3\]: expected a finite number, got nan"),
        ({"x0": [3.0, 0, 0, 0]}, r"x0, slide_x: expected within \[-2, 2\], got 3"),
        ({"x_goal": [2.5, 0, 0, 0]}, r"x_goal, slide_x: expected within \[-2, 2\], got 2.5"),
        ({"x_goal": [math.inf, 0, 0, 0]}, "x_goal: expected finite numbers"),
        ({"x_goal": [0.0]}, "x_goal: expected shape"),
        ({"num_steps": 0}, "num_steps: expected a whole number of at least 1, got 0"),
        ({"num_steps": -3}, "num_steps"),
        ({"num_steps": 2.5}, "num_steps"),
        ({"num_steps": True}, "num_steps"),
        (
            {"bounds": dd.Bounds(u_lower=[5.0], u_upper=[-5.0])},
            r"bounds of force: expected a lower bound of at most the upper bound",
        ),
        ({"bounds": dd.Bounds(u_lower=[30.0])}, r"bounds of force: .*got \[30, 20\]"),
        ({"bounds": dd.Bounds(x_lower=[0.0])}, "x_lower: expected shape"),
        ({"optimize": ()}, "optimize"),
        ({"optimize": ("everything",)}, "controls, initial_state, parameters, got 'everything'"),
        ({"optimize": "initial_state", "initial_state_mask": [True]}, "initial_state_mask: expected shape"),
        ({"optimize": "initial_state", "initial_state_mask": [1, 0, 0, 0]}, "booleans"),
        ({"optimize": "initial_state", "initial_state_mask": [False] * 4}, "booleans, of which some are True"),
        ({"initial_state_mask": [True] * 4}, "no True without"),
        ({"running_cost": 3.0}, "a QuadraticCost or a function, such as .*, got float"),
        ({"running_cost": dd.QuadraticCost(R=np.eye(2))}, r"running_cost.R: expected shape \(1, 1\)"),
        ({"running_cost": dd.QuadraticCost(Q=np.eye(3))}, r"running_cost.Q: expected shape \(4, 4\)"),
        ({"running_cost": None, "x_goal": None}, "a cost, an x_goal, goals or constraints"),
        ({"us": np.zeros((3, 1))}, r"us: expected shape \(10, 1\)"),
        ({"us": np.full((10, 1), math.nan)}, r"us\[0, 0\]: expected a finite number, got nan"),
        (
            {"optimize": "initial_state", "us": np.full((10, 1), 21.0)},
            r"us, force: expected within \[-20, 20\], got 21",
        ),
        ({"x0": None}, r"x0: expected shape \(4,\), got shape \(\)"),
        ({"x0": "rest"}, "x0: expected an array of numbers, got 'rest'"),
        ({"x0": [0, 0, 0, math.inf]}, r"x0\[3\]: expected a finite number, got inf"),
        ({"num_steps": 10.0}, "num_steps: expected a whole number of at least 1, got 10.0"),
        ({"final_cost": dd.QuadraticCost(Q=np.eye(3))}, r"final_cost.Q: expected shape \(4, 4\), got shape \(3, 3\)"),
        ({"final_cost": "small"}, "final_cost: expected a QuadraticCost or a function, such as .*, got str"),
        ({"running_cost": dd.QuadraticCost(x_ref=[1, 2])}, r"running_cost.x_ref: expected shape \(4,\)"),
        ({"running_cost": dd.QuadraticCost(u_ref=[1, 2])}, r"running_cost.u_ref: expected shape \(1,\)"),
        ({"bounds": dd.Bounds(u_upper=5.0)}, r"u_upper: expected shape \(1,\), got shape \(\)"),
        (
            {"bounds": dd.Bounds(x_lower=[0.5, math.nan, math.nan, math.nan])},
            r"x0, slide_x: expected within \[0.5, 2\]",
        ),
        ({"optimize": "initial_state", "initial_state_mask": [0.0, 1.0, 0.0, 0.0]}, "booleans, of which some are True"),
    ],
)
def test_bad_problems_are_named(load, changes, words):
    with pytest.raises(InputError, match=words) as error:
        cart_pole(load, **changes)
    assert f": expected {error.value.expected}, got {error.value.got}" in str(error.value)


@each_row(
    "changes",
    [
        {"bounds": ([-1], [1])},
        {"bounds": dd.Bounds(u_lower=[math.inf], u_upper=[math.inf])},
        {"optimize": None},
        {"optimize": 3},
        {"x_goal": [math.nan] * 4, "running_cost": None},
        {"x0": np.array([0.5 + 1j, 0, 0, 0])},
    ],
)
def test_what_cannot_be_meant_is_refused_by_a_named_error(load, changes):
    """Test a tuple for Bounds, an input of infinity at least, no names, an empty goal and no cost, a complex number."""
    with pytest.raises(InputError, match=r"expected .*got"):
        cart_pole(load, **changes)


def test_a_models_speed_limit_applies(tmp_path):
    text = (MODELS / "cart_pole.urdf").read_text()
    limited = text.replace('effort="20"/>', 'effort="20" velocity="3"/>')
    assert limited != text
    (tmp_path / "limited.urdf").write_text(limited)
    model = dd.load_model(tmp_path / "limited.urdf", time_step=0.1)
    bounds = dd.Problem(model, x0=np.zeros(4), num_steps=3, running_cost=R).bounds
    assert bounds.x_upper.tolist() == [2.0, math.inf, 3.0, math.inf]
    assert bounds.x_lower.tolist() == [-2.0, -math.inf, -3.0, -math.inf]


def test_a_problem_is_copied_with_another_number_of_steps(load):
    problem = dd.Problem(load("pendulum.urdf"), x0=[0, 0], num_steps=3, running_cost=R)
    assert replace(problem, num_steps=5).us.shape == (5, 1)
    given = replace(problem, us=np.zeros((3, 1)))
    with pytest.raises(InputError, match="us: expected shape"):
        replace(given, num_steps=5)


def test_controls_without_actuators_are_refused(load):
    problem = dd.Problem(load("projectile.sdf"), x0=np.eye(13)[0], num_steps=3, final_cost=lambda x: x[4])
    with pytest.raises(InputError, match="an actuated model"):
        dd.solve(problem)


def test_a_tolerance_is_of_a_state_itself_and_of_its_way(load):
    """A wheel's 1,000 rad do not affect a pole's tolerance. A state that does not travel has 1 % of its own range.

    The cart is a point, so that the bob, 0.5 m from the pole's joint, gives the slide its length.
    """
    xs = np.linspace([0.0, 0.0, 0.0, 0.0], [1.0, np.pi, 0.2, 1000.0], 11)
    xs[5, 2] = 3.0
    problem = cart_pole(load, goal_tolerance={"slide_x": 0.002})
    assert problem.state_scales(xs) == pytest.approx([1.0, np.pi, 3.0, 1000.0], rel=1e-12)
    assert problem.goal_tolerances(xs) == pytest.approx([0.002, 0.01 * np.pi, 0.03, 10.0], rel=1e-12)
    assert "to within 0.002 of slide_x" in str(problem)
    for limit in (math.inf, 1e30):  # values that files use for no limit
        bounds = dd.Bounds(x_lower=4 * [-limit], x_upper=4 * [limit])
        problem = cart_pole(load, bounds=bounds, x_goal=[1.0, 0, 0, 0])
        still = problem.state_scales(np.outer([0, 1], [1.0, 0, 0, 0]))  # least scales: 0.01 rad, 0.01 of 0.5 m
        assert still == pytest.approx([1, 0.01, *np.array([0.005, 0.01]) / problem.start_horizon], rel=1e-9)


@each_row(
    "given, words",
    [
        ({"slide_x": 0.0}, "positive"),
        ({"slide_x": math.inf}, "positive|finite"),
        ({"nothing": 0.1}, "slide_x"),
        ([0.1, 0.1], "4"),
    ],
)
def test_a_goal_tolerance_is_refused_by_name(load, given, words):
    with pytest.raises(InputError, match=words):
        cart_pole(load, goal_tolerance=given)


def test_no_goal_has_no_tolerance(load):
    with pytest.raises(InputError, match="goal"):
        cart_pole(load, x_goal=[1, np.nan, 0, 0], goal_tolerance=[0.1, 0.1, np.nan, np.nan])


def test_the_shape_error_of_a_state_names_what_floats(load):
    model = load("sphere_on_ground.sdf")
    for ask in (lambda: dd.Problem(model, x0=[0, 0], num_steps=5), lambda: dd.step(model, [0, 0])):
        with pytest.raises(ShapeError, match=r"got shape \(2,\): .* floats, with 13 states; base="):
            ask()
    with pytest.raises(ShapeError, match=r"got shape \(3,\)$"):
        dd.step(load("pendulum.urdf"), [0, 0, 0], [0])


@each_row("method", ["collocation", "shooting", "ilqr", "auto"])
def test_a_cost_without_a_derivative_where_the_search_begins_is_named_with_its_knot(load, method):
    def norm(x, u):
        return (x[0] ** 2 + x[1] ** 2) ** 0.5

    problem = dd.Problem(load("pendulum.urdf"), x0=[0, 0], x_goal=[0.5, 0], num_steps=20, running_cost=norm)
    solution = dd.solve(problem, method=method)
    assert solution.status.value == "no_gradient"
    assert "not finite at knot 0" in " ".join([solution.message, *solution.notes])
    assert "norm" in " ".join([solution.message, *solution.notes])


def test_a_quaternion_and_its_negative_are_one_goal(load):
    """A goal on the other side is turned to the side of x0. A state on either side is at a distance of 0 from it."""
    model = load("sphere_on_ground.sdf")
    x0 = np.array(model.default_state)
    x0[:4], free = [0.8, 0.6, 0.0, 0.0], np.arange(model.nx) == 10
    goal = x0 * np.where(np.arange(model.nx) < 4, -1.0, 1.0)
    fields = {"num_steps": 5, "optimize": ("initial_state",), "initial_state_mask": free}
    problem = dd.Problem(model, x0=x0, x_goal=goal, **fields)
    for x in (x0, goal):
        assert np.all(problem.goal_error(x) == 0)
    np.testing.assert_array_equal(problem.x_goal, x0)


def test_a_quaternion_of_zeros_is_no_orientation(load):
    """The direction of such a quaternion would be that of any state."""
    model = load("sphere_on_ground.sdf")
    goal = np.where(np.arange(model.nx) < 4, 0.0, model.default_state)
    fields = {"optimize": ("initial_state",), "initial_state_mask": np.arange(model.nx) == 10}
    with pytest.raises(InputError, match="x_goal: expected an orientation, got a quaternion of zeros"):
        dd.Problem(model, x0=model.default_state, x_goal=goal, num_steps=5, **fields)


def test_a_body_that_turns_on_has_the_signs_of_the_waypoint_before(load):
    """Make quarter turns about z. At three of them the quaternion is nearer to the negative of x0's quaternion."""
    model = load("sphere_on_ground.sdf")
    angles = np.array([0.0, np.pi / 2, np.pi, 3 * np.pi / 2, 2 * np.pi])
    states = np.tile(np.asarray(model.default_state), (5, 1))
    states[:, :4] = np.column_stack([np.cos(angles / 2), 0 * angles, 0 * angles, np.sin(angles / 2)])
    asked = states * np.where(np.arange(model.nx) < 4, np.array([1, -1, 1, 1, -1])[:, None], 1.0)
    waypoints = {1: asked[1], 2: np.full(model.nx, np.nan), 3: asked[2], 4: asked[3]}
    free = np.arange(model.nx) == 10
    fields = {"num_steps": 5, "optimize": ("initial_state",), "initial_state_mask": free, "waypoints": waypoints}
    problem = dd.Problem(model, x0=states[0], x_goal=asked[4], **fields)
    for knot, state in ((1, states[1]), (3, states[2]), (4, states[3])):
        np.testing.assert_allclose(problem.waypoints[knot], state, rtol=0, atol=1e-15)  # sums of rounded angles
    np.testing.assert_allclose(
        problem.x_goal, states[4], rtol=0, atol=1e-15
    )  # a whole turn, whose quaternion is the negative of x0's

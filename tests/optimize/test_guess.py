"""Tests of initial guesses: solutions on other knots, of another duration or method, and Drake's trajectories."""

import re

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row
from pydrake.trajectories import PiecewisePolynomial

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, ShapeError
from drake_diff.optimize import Options
from drake_diff.optimize.guess import another_guess, first_guess

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])


def block(count=10, horizon=1.0, **asked):
    """Return the problem of moving 1 kg by 1 m from rest to rest. The optimum is u = 6 - 12 t with a cost of 12."""
    push = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    ends = {"x0": [0, 0], "x_goal": [1, 0]} | asked
    return dd.Problem(push, num_steps=count, horizon=horizon, running_cost=EFFORT, **ends)


def plant(write_urdf, count=10, h=0.1):
    model = write_urdf(time_step=h)
    return dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=count, running_cost=EFFORT)


@each_row("scheme", ["hermite_simpson", "trapezoid", "drake"])
def test_a_collocated_solution_as_drakes_trajectories_is_its_motion(scheme):
    solution = dd.solve(block(), options=Options(scheme=scheme))
    state, held = solution.trajectory()
    assert (state.start_time(), state.end_time(), held.end_time()) == (0.0, 1.0, 1.0)
    at = np.linspace(0, 1, 57)
    xs, us = solution.transcribed.at(at)
    np.testing.assert_allclose(state.vector_values(at).T, xs, atol=1e-9)  # the defects are 1e-10
    np.testing.assert_allclose(held.vector_values(at).T, us, atol=1e-9)


def test_a_discrete_solution_as_drakes_trajectories_holds_its_inputs(write_urdf):
    solution = dd.solve(plant(write_urdf), method="ilqr")
    state, held = solution.trajectory()
    np.testing.assert_allclose(state.vector_values(solution.times).T, solution.xs, atol=1e-15)
    np.testing.assert_array_equal(held.value(0.05).ravel(), solution.us[0])
    np.testing.assert_array_equal(held.value(0.95).ravel(), solution.us[9])
    np.testing.assert_allclose(state.value(0.05).ravel(), (solution.xs[0] + solution.xs[1]) / 2, atol=1e-15)


def test_a_solution_that_is_not_finite_has_no_trajectory(write_urdf):
    problem = plant(write_urdf)
    broken = dd.solve(problem, method="ilqr").told()
    vars(broken)["xs"] = np.full((11, 2), np.nan)
    with pytest.raises(ModelError, match="no trajectory"):
        broken.trajectory()


@pytest.mark.slow
@each_row("method", ["collocation", "ilqr", "shooting"])
@each_row("count", [7, 10, 25])
def test_a_solution_of_any_method_and_length_is_a_guess(write_urdf, method, count):
    """The guess interpolates the old solution at the new knots. The solve ends at the same optimum as without it."""
    first = plant(write_urdf)
    found = dd.solve(first, method=method)
    problem = plant(write_urdf, count, h=1.0 / count)
    for other in ("collocation", "ilqr", "shooting"):
        guess = first_guess(problem, other, found, 0)
        assert guess.xs.shape == (count + 1, 2)
        assert guess.us.shape == (count, 1)
        t = np.linspace(0, 1, count + 1)
        np.testing.assert_allclose(guess.xs[[0, -1]], [[0, 0], [1, 0]], atol=1e-6)
        np.testing.assert_allclose(guess.xs[:, 0], 3 * t**2 - 2 * t**3, atol=0.08)  # half a step at 1.5 m/s is 0.075 m
        mean = 6 - 12 * (t[1:] + t[:-1]) / 2
        np.testing.assert_allclose(guess.us[:, 0], mean, atol=1.0 if other != "collocation" else 1.5)
        if other == "collocation":
            continue
        np.testing.assert_allclose(np.sum(guess.us) / count, np.mean(found.us), atol=0.6)
    warm = dd.solve(problem, method="ilqr", initial_guess=found)
    assert warm.success
    np.testing.assert_allclose(warm.us, dd.solve(problem, method="ilqr").us, atol=1e-6)


def test_held_inputs_on_other_knots_have_the_same_integral(write_urdf):
    found = dd.solve(plant(write_urdf), method="ilqr")
    for count in (3, 4, 9, 20, 33):
        us = first_guess(plant(write_urdf, count, 1 / count), "ilqr", found, 0).us
        assert us.mean() == pytest.approx(found.us.mean(), abs=1e-13)


def test_drakes_trajectories_are_a_guess(write_urdf):
    """The guess is the closed form as Drake's polynomials. iLQR needs a single step from it, as from any guess."""
    t = np.linspace(0, 1, 5)
    state = PiecewisePolynomial.CubicHermite(t, [3 * t**2 - 2 * t**3, 6 * t - 6 * t**2], [6 * t - 6 * t**2, 6 - 12 * t])
    held = PiecewisePolynomial.FirstOrderHold([0, 1], [[6.0, -6.0]])
    problem = plant(write_urdf, 20, 0.05)
    solution = dd.solve(problem, method="ilqr", initial_guess=(state, held))
    assert solution.success
    assert solution.options["initial_guess"] == "given"
    np.testing.assert_allclose(solution.search.guess[1].ravel(), 6 - 12 * (np.arange(20) + 0.5) / 20, atol=1e-12)
    collocated = dd.solve(block(horizon=(0.5, 2.0)), initial_guess=(state, held), max_iterations=100)
    assert collocated.search.guess[2] == 1.0
    positions = PiecewisePolynomial.CubicHermite(t, [3 * t**2 - 2 * t**3], [6 * t - 6 * t**2])
    alone = dd.solve(problem, method="ilqr", initial_guess=positions)
    np.testing.assert_allclose(alone.search.guess[0], solution.search.guess[0], atol=1e-12)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((PiecewisePolynomial.FirstOrderHold([0, 1], np.zeros((3, 2))),) * 2, "initial_guess state: expected shape"),
        ((PiecewisePolynomial.FirstOrderHold([0, 1], np.zeros((2, 2))),) * 2, "initial_guess input: expected shape"),
        ((PiecewisePolynomial.FirstOrderHold([0, 1], np.zeros((2, 2))), np.zeros((10, 1))), "initial_guess input: exp"),
        ((PiecewisePolynomial.FirstOrderHold([0, 1], np.zeros((2, 2))),), "two trajectories"),
        ((PiecewisePolynomial([[0.0], [0.0]]), PiecewisePolynomial([[0.0]])), "a duration in"),
    ],
)
def test_trajectories_that_do_not_fit_are_refused(write_urdf, given, message):
    with pytest.raises((InputError, ShapeError), match=re.escape(message)):
        dd.solve(plant(write_urdf), method="ilqr", initial_guess=given)


def test_a_solution_of_another_system_is_refused(write_urdf):
    found = dd.solve(plant(write_urdf), method="ilqr")
    cart = dd.example_model("cart_pole", time_step=0.1)
    with pytest.raises(ShapeError, match="states and inputs"):
        dd.solve(dd.Problem(cart, x0=[0, 0, 0, 0], x_goal=[0, 0.1, 0, 0], num_steps=10), initial_guess=found)


# ------------------------------------------------------------------------------ other initial guesses


def limited_pendulum(limit, **asked):
    """For m = l = 1 gravity's torque is up to 9.81 N m, so that a weaker motor has to swing the pendulum up."""
    swing = dd.Dynamics(
        lambda x, u: [x[1], u[0] - 9.81 * np.sin(x[0]) - 0.1 * x[1]], nx=2, nu=1, u_lower=[-limit], u_upper=[limit]
    )
    ends = {"x0": [0, 0], "x_goal": [np.pi, 0], "num_steps": 40}
    return dd.Problem(swing, **ends | asked)


@pytest.mark.slow
@each_row("limit", [3.9, 2.5])
@each_row("method", ["auto", "collocation"])
def test_a_swing_up_in_least_time_is_found_from_another_first_guess(limit, method):
    """IPOPT reports infeasibility from a straight line. The test integrates the motion under the plan's own input."""
    solution = dd.solve(limited_pendulum(limit, horizon=(0.5, 10.0), running_cost=1.0), method=method, restarts=0)
    assert solution.success, solution.message
    chain = solution.options["chain"]
    assert len(chain) > 1
    assert {link["ended"] for link in chain[:-1]} <= {"infeasible", "iteration_limit"}
    assert f"another first guess ({len(chain) - 1} of 8)" in chain[-1]["reason"]
    assert np.abs(solution.us).max() <= limit + 1e-6
    x, parts = np.zeros(2), 4000
    us = solution.transcribed.at(solution.horizon * (np.arange(parts) + 0.5) / parts)[1][:, 0]
    for u in us:  # the midpoint rule, whose error is 1e-6 for these steps
        h = solution.horizon / parts
        middle = x + h / 2 * np.array([x[1], u - 9.81 * np.sin(x[0]) - 0.1 * x[1]])
        x = x + h * np.array([middle[1], u - 9.81 * np.sin(middle[0]) - 0.1 * middle[1]])
    np.testing.assert_allclose(x, [np.pi, 0], atol=0.06)  # near the upright position an error of 1e-6 grows as e^(3 t)


def test_what_no_guess_solves_says_how_many_were_tried():
    """1 m in 1 s from rest to rest needs at least 4 N."""
    problem = block(bounds=dd.Bounds(u_lower=[-3.9], u_upper=[3.9]))
    solution = dd.solve(problem)
    assert solution.status is dd.Status.INFEASIBLE
    assert "no plan was found from 9 first guesses" in repr(solution)
    assert len(solution.options["chain"]) == 9
    given = dd.solve(problem, initial_guess=(solution.xs, solution.us))  # only the given guess is tried
    assert len(given.options["chain"]) == 1


def test_another_guess_is_inside_all_bounds_and_begins_where_the_motion_does():
    problem = limited_pendulum(3.0, horizon=(0.5, 10.0), running_cost=1.0, bounds={"x1": (-1, 2)})
    for number in range(1, 9):
        xs, us, horizon = another_guess(problem, 0, number)
        np.testing.assert_array_equal(xs[0], [0, 0])
        assert np.all((xs[:, 1] >= -1) & (xs[:, 1] <= 2))
        assert np.abs(us).max() <= 3.0
        assert 0.5 <= horizon <= 10.0
    lift = dd.model.BodyForce("lift", "body", upper=20.0)
    quadrotor = dd.load_model(MODELS / "quadrotor.urdf", time_step=0.05, body_forces=[lift])
    x0 = quadrotor.default_state
    free = dd.Problem(quadrotor, x0=x0, x_goal=x0, num_steps=5)
    np.testing.assert_allclose(np.linalg.norm(another_guess(free, 0, 1)[0][:, :4], axis=1), 1.0, rtol=1e-12)


def test_a_reference_is_the_first_guess_bent_to_the_ends_that_are_given():
    """Only the first state follows the reference. The second state keeps to the straight line."""
    times = np.linspace(0, 2, 201)
    wanted = np.column_stack([np.sin(3 * times), 0 * times])
    follow = dd.optimize.TrackingCost((times, wanted, np.cos(times)[:, None]), Q=np.diag([1.0, 0.0]), R=[[1.0]])
    push = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    asked = {"x0": [0.5, 1.0], "x_goal": [np.nan, 3.0], "num_steps": 20, "horizon": 2.0}
    guess = first_guess(dd.Problem(push, running_cost=[EFFORT, follow], **asked), "collocation", None, 0)
    s = np.linspace(0, 1, 21)
    assert guess.xs[:, 0] == pytest.approx(np.sin(6 * s) + 0.5 * (1 - s), abs=2e-4)  # linear interpolation in the table
    assert guess.xs[:, 1] == pytest.approx(1 + 2 * s)
    assert guess.us[:, 0] == pytest.approx(np.cos(2 * s[:-1] + 0.05), abs=2e-3)


@pytest.mark.slow
def test_a_car_keeps_to_a_figure_eight_from_beside_it():
    """The initial guess of a straight line, which stays at the start, led to loops, 0.28 m off the eight."""
    time = 23.0
    times = np.linspace(0, time, 401)
    angle, rate = 2 * np.pi * times / time, 2 * np.pi / time
    at = 2.5 * np.column_stack([np.sin(angle), np.sin(angle) * np.cos(angle)])
    speed = 2.5 * rate * np.column_stack([np.cos(angle), np.cos(2 * angle)])
    wanted = np.column_stack([at, np.unwrap(np.arctan2(speed[:, 1], speed[:, 0])), np.hypot(*speed.T)])
    car = dd.Dynamics(
        lambda x, u: [x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), x[3] * np.tan(u[1]), u[0]],
        4,
        2,
        u_lower=[-2, -1.2],
        u_upper=[2, 1.2],
    )
    follow = dd.optimize.TrackingCost((times, wanted), Q=np.diag([10.0, 10.0, 1.0, 1.0]), R=0.05 * np.eye(2))
    start = wanted[0] + [0.05, -0.05, 0.05, 0.0]
    solution = dd.solve(dd.Problem(car, x0=start, num_steps=80, horizon=time, running_cost=follow))
    assert solution.success, solution.message
    path = np.array([np.interp(solution.times, times, column) for column in at.T]).T
    assert np.sqrt(np.mean(np.sum((solution.xs[:, :2] - path) ** 2, axis=1))) < 0.05

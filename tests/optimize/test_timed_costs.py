"""Tests of running costs that change in time, by every method: closed forms, references, sums, MPC, records."""

import re

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row
from pydrake.trajectories import PiecewisePolynomial

import drake_diff as dd
from drake_diff.exceptions import GradientError, InputError, ShapeError
from drake_diff.loop import MPC, closed_loop
from drake_diff.optimize import Options, TrackingCost
from drake_diff.runs.sections import describe_problem

METHODS = ["collocation", "ilqr", "shooting"]


def point(horizon=1.0, count=20, **asked):
    """Return the problem of moving x' = u from 0 to 1."""
    return dd.Problem(
        dd.Dynamics(lambda x, u: [u[0]], nx=1, nu=1), x0=[0], x_goal=[1], num_steps=count, horizon=horizon, **asked
    )


def block(write_urdf, h=0.05, count=20, **asked):
    return dd.Problem(write_urdf(time_step=h), x0=[0, 0], num_steps=count, **asked)


def branching(x, u, t):
    """Return the same cost with a branch on the time, which CasADi cannot trace."""
    return (1 + t) * u[0] ** 2 if t >= 0 else 0.0


@pytest.mark.solve
@each_row("cost", [lambda x, u, t: (1 + t) * u[0] ** 2, branching])
def test_a_weight_that_grows_in_time_has_the_closed_forms_optimum(cost):
    """The minimum of int (1 + t) u^2 with int u = 1 is at u = 1 / ((1 + t) ln 2), with a cost of 1 / ln 2."""
    solution = dd.solve(point(running_cost=cost))
    assert solution.success, solution.message
    t = solution.times
    np.testing.assert_allclose(solution.inputs_at_knots[:, 0], 1 / ((1 + t) * np.log(2)), atol=2e-4)  # O(h^4)
    assert solution.cost == pytest.approx(1 / np.log(2), rel=1e-7)


@pytest.mark.slow
@each_row("method", METHODS)
def test_an_input_that_is_asked_for_in_time_is_given(write_urdf, method):
    """(u - sin 3 t)^2 is 0 for u = sin 3 t. Discrete methods use the time at the beginning of each step."""
    problem = block(write_urdf, running_cost=lambda x, u, t: (u[0] - np.sin(3 * t)) ** 2)
    solution = dd.solve(problem, method=method)
    assert solution.success, solution.message
    at = solution.times[: len(solution.us)]
    np.testing.assert_allclose(solution.us[:, 0], np.sin(3 * at), atol=1e-6)


@pytest.mark.slow
@each_row("method", METHODS)
@each_row("kind", ["arrays", "solution", "trajectory", "trajectories", "function"])
def test_a_reference_is_followed_in_whatever_form_it_is_given(write_urdf, method, kind):
    """x = t^2 / 2 under u = 1, so that a plan that follows it with its own input costs nothing."""
    t = np.linspace(0, 1, 21)
    xs, us = np.column_stack([t**2 / 2, t]), np.ones((21, 1))
    state, held = PiecewisePolynomial.CubicHermite(t, xs.T, [t, 0 * t + 1]), PiecewisePolynomial([[1.0]])
    weights = {"Q": np.diag([50.0, 1.0]), "R": [[1e-4]]}
    if kind == "solution":
        made = dd.solve(block(write_urdf, running_cost=lambda x, u: (u[0] - 1) ** 2), method="collocation")
        cost = TrackingCost(made, **weights)
    elif kind == "function":
        cost = lambda x, u, t: 50 * (x[0] - t**2 / 2) ** 2 + (x[1] - t) ** 2 + 1e-4 * (u[0] - 1) ** 2  # noqa: E731
    else:
        given = {"arrays": (t, xs, us), "trajectory": state, "trajectories": (state, held)}[kind]
        cost = TrackingCost(given, **weights)
    solution = dd.solve(block(write_urdf, running_cost=cost), method=method)
    assert solution.success, solution.message
    np.testing.assert_allclose(solution.xs[solution.knots], xs, atol=0.07)  # a step moves by h = 0.05 at 1 m/s
    if kind != "trajectory":
        np.testing.assert_allclose(
            solution.us[2 * len(solution.us) // 20 :], 1.0, atol=0.15
        )  # the first inputs make up for half a step


def test_the_cost_of_a_reference_is_the_sum_over_its_steps(write_urdf):
    random = np.random.default_rng(0)
    t, xs, us = np.linspace(0, 1, 21), random.standard_normal((21, 2)), random.standard_normal((21, 1))
    Q, R = np.diag([2.0, 3.0]), np.array([[0.5]])
    problem = block(write_urdf, running_cost=TrackingCost((t, xs, us), Q=Q, R=R))
    at, held = random.standard_normal((21, 2)), random.standard_normal((20, 1))
    wanted = sum(
        0.05 * ((x - a) @ Q @ (x - a) + (u - b) @ R @ (u - b)) for x, a, u, b in zip(at, xs, held, us, strict=False)
    )
    assert problem.objective(at, held) == pytest.approx(wanted, rel=1e-12)


def test_goals_that_are_paid_for_go_with_it():
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    side = dd.FrameGoal("pole", point=[0, 0, -0.5], position=[-0.3, None, None], weight=1e3)
    wave = lambda x, u, t: (u[0] - np.sin(t)) ** 2  # noqa: E731
    solution = dd.solve(dd.Problem(model, x0=[0, 0], num_steps=20, goals=[side], running_cost=wave), method="ilqr")
    assert solution.success, solution.message
    all_along = dd.JointGoal({"hinge": 0.2}, knots=None, weight=1e4)
    held = dd.solve(dd.Problem(model, x0=[0.2, 0], num_steps=20, goals=[all_along], running_cost=wave), method="ilqr")
    np.testing.assert_allclose(held.xs[:, 0], 0.2, atol=0.01)


@pytest.mark.solve
def test_mpc_follows_a_reference_that_moves_on():
    """Each plan begins later in the reference. A plan that began anew would follow the first second forever."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    t = np.linspace(0, 4, 81)
    wave = np.column_stack([0.5 * np.sin(2 * t), np.cos(2 * t)])
    follow = TrackingCost((t, wave), Q=np.diag([100.0, 1.0]), R=[[1e-4]])
    problem = dd.Problem(model, x0=wave[0], num_steps=80, running_cost=follow, final_cost=dd.QuadraticCost(Q=np.eye(2)))
    plan = dd.solve(problem, method="ilqr")
    control = MPC(problem, plan=plan, horizon=10)
    motion = closed_loop(model, control, wave[0] + [0.2, 0], 60).motion
    np.testing.assert_allclose(motion.xs[20:60, 0], wave[20:60, 0], atol=0.05)


@pytest.mark.solve
def test_a_run_that_follows_a_reference_verifies(write_urdf, tmp_path):
    t = np.linspace(0, 1, 21)
    follow = TrackingCost((t, np.column_stack([t**2 / 2, t])), Q=np.eye(2))
    cost = [follow, dd.QuadraticCost(R=[[0.1]])]
    dd.save(dd.solve(block(write_urdf, running_cost=cost), method="ilqr"), tmp_path / "run")
    assert dd.verify(tmp_path / "run").holds
    told = describe_problem(block(write_urdf, running_cost=lambda x, u, t: t * u[0] ** 2))
    assert "lambda" in told["running_cost"]  # the user's function is in no record


@pytest.mark.parametrize(
    ("cost", "options", "message"),
    [
        (
            lambda x, u, t: t * u[0] ** 2,
            {"horizon": (0.5, 2.0)},
            "expected a running_cost that is constant in time, as the horizon is free",
        ),
        ([], {}, "running_cost: expected costs, got an empty list"),
        (lambda x, u, t: t * float(u[0]) ** 2, {}, "lost its derivatives"),
    ],
)
def test_what_cannot_be_is_refused(cost, options, message):
    with pytest.raises((InputError, GradientError), match=re.escape(message)):
        dd.solve(point(**{"running_cost": cost} | options))


def test_drakes_own_transcription_has_no_time(write_urdf):
    problem = block(write_urdf, running_cost=lambda x, u, t: t * u[0] ** 2, x_goal=[1, 0])
    with pytest.raises(InputError, match="changes in time"):
        dd.solve(problem, method="collocation", options=Options(scheme="drake", solver="snopt"))


@pytest.mark.parametrize(
    ("reference", "weights", "error"),
    [
        (([0, 1], np.zeros((3, 2))), {"Q": np.eye(2)}, ShapeError),
        (([0, 0], np.zeros((2, 2))), {"Q": np.eye(2)}, InputError),
        (([0, 1], np.zeros((2, 2))), {}, InputError),
        (([0, 1], np.zeros((2, 3))), {"Q": np.eye(3)}, ShapeError),
        (([0, 1], np.zeros((2, 2))), {"Q": np.eye(3)}, ShapeError),
        (7, {"Q": np.eye(2)}, InputError),
    ],
)
def test_a_reference_that_is_none_is_refused(write_urdf, reference, weights, error):
    with pytest.raises(error):
        block(write_urdf, running_cost=TrackingCost(reference, **weights))

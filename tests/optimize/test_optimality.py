"""Tests of costates, multipliers and end sensitivities against closed forms, and of plans that are not optimal."""

import dataclasses

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.values import Refusal
from drake_diff.derivatives.step import differentiate_step
from drake_diff.optimize.optimality import final_state_norms

pytestmark = pytest.mark.solve

H, N = 0.1, 10
EFFORT = dd.QuadraticCost(R=[[1.0]])


def move(**changes):
    return dd.Problem(
        block(time_step=H), **{"x0": [0, 0], "x_goal": [1, 0], "num_steps": N, "running_cost": EFFORT} | changes
    )


def exact_costates():
    """Return the costates (N+1, 2) of the least effort from rest at 0 to rest at 1 by symplectic Euler, and the norms.

    For x' = A x + B u, x_N = sum_k A^(N-1-k) B u_k = G u is the goal, u = G' (G G')^-1 goal, 2 h u + G' mu = 0.
    """
    A, B = np.array([[1, H], [0, 1]]), np.array([H**2, H])
    powers = [np.linalg.matrix_power(A, N - k) for k in range(N + 1)]
    G = np.array([powers[k + 1] @ B for k in range(N)]).T
    mu = -2 * H * np.linalg.solve(G @ G.T, [1.0, 0.0])
    return np.array([power.T @ mu for power in powers]), np.array([np.linalg.norm(power, 2) for power in powers])


@pytest.mark.parametrize("method", ["shooting", "ilqr"])
def test_effort_with_a_hard_goal_has_the_costates_of_the_closed_form(method):
    """Both solvers meet first-order optimality to 1e-8 of the cost's scale."""
    solution = dd.solve(move(), method=method)
    costates, ends = exact_costates()
    assert solution.final_state_norms == pytest.approx(ends, rel=1e-9)
    assert solution.optimality.state_norms == pytest.approx(np.linalg.norm(costates, axis=1), rel=1e-5)
    assert solution.optimality.multipliers == pytest.approx(costates[-1], rel=1e-5)
    assert solution.optimality.ratio < 1e-6


def test_without_constraints_the_costate_is_the_costs_own_gradient():
    """For the final cost x_N, d cost / d x_0 is the first row of A^N for any inputs."""
    problem = move(x_goal=None, final_cost=lambda x: x[0])
    solution = dataclasses.replace(dd.solve(problem, method="ilqr"), us=np.zeros((N, 1)), xs=np.zeros((N + 1, 2)))
    found = solution.optimality
    assert found.multipliers.size == 0
    assert found.state_norms[0] == pytest.approx(np.hypot(1, N * H), rel=1e-12)
    assert found.state_norms[-1] == pytest.approx(1.0, rel=1e-12)
    assert found.gradient == pytest.approx(N * H**2, rel=1e-12)  # with respect to u_0: h^2 N
    assert found.ratio == pytest.approx(1.0, rel=1e-12)


@each_row("seed", [0, 1, 2])
def test_a_plan_that_reaches_the_goal_by_a_detour_is_no_stationary_point(seed):
    """The inputs are moved within the null space of the goal, so that the goal is met with more effort than needed."""
    solution = dd.solve(move(), method="shooting")
    A, B = np.array([[1, H], [0, 1]]), np.array([H**2, H])
    G = np.array([np.linalg.matrix_power(A, N - 1 - k) @ B for k in range(N)]).T
    detour = np.random.default_rng(seed).standard_normal(N)
    detour -= np.linalg.pinv(G) @ (G @ detour)
    us = solution.us + 1e-2 * detour[:, None]
    moved = dataclasses.replace(solution, us=us, xs=dd.rollout(solution.problem.model, [0, 0], us).xs)
    assert moved.goal_error == pytest.approx(solution.goal_error, abs=1e-12)
    assert moved.optimality.gradient == pytest.approx(2 * H * 1e-2 * np.abs(detour).max(), rel=0.2)
    assert moved.optimality.ratio > 1e-4


def test_a_bound_may_push_inwards_only():
    """At u = 1 = u_upper the cost (u - 2)^2 pushes outwards, which is optimal. At u = 1 = u_lower it is not."""
    cost = dd.QuadraticCost(R=[[1.0]], u_ref=[2.0])
    found = []
    for side in ("u_upper", "u_lower"):
        problem = move(x_goal=None, running_cost=cost, bounds=dd.Bounds(**{side: [1.0]}), us=np.ones((N, 1)))
        us = np.ones((N, 1))
        solution = dd.solve(problem, method="ilqr", initial_guess=(np.zeros((N + 1, 2)), us))
        solution = dataclasses.replace(solution, us=us, xs=dd.rollout(problem.model, [0, 0], us).xs)
        found.append(solution.optimality.gradient)
    assert found == pytest.approx([0.0, 2 * H * (2 - 1)], abs=1e-12)


@each_row("side", [1, -1])
def test_a_state_on_a_bound_pushes_only_inwards(side):
    """The speed is 0.5 all the way and the cost wants 2. An upper bound explains this, but a lower bound does not."""
    limit = {"x_upper": [np.inf, 0.5]} if side > 0 else {"x_lower": [-np.inf, 0.5]}
    problem = move(
        x0=[0, 0.5],
        x_goal=None,
        running_cost=None,
        final_cost=lambda x: (x[1] - 2.0) ** 2,
        bounds=dd.Bounds(**limit),
    )
    us = np.zeros((N, 1))
    xs = dd.rollout(problem.model, [0, 0.5], us).xs
    solution = dataclasses.replace(dd.solve(problem, method="ilqr"), us=us, xs=xs)
    gradient = solution.optimality.gradient
    assert gradient == pytest.approx(0 if side > 0 else 2 * 1.5 * H, abs=1e-9)


def test_collocation_has_sensitivities_and_says_why_it_has_no_costates():
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=20, running_cost=EFFORT)
    solution = dd.solve(problem, method="collocation")
    us = solution.plan.sample(1)[1]
    d = [dd.differentiate_step(model, x, u).A for x, u in zip(solution.xs[1:-1], us[1:], strict=True)]
    assert solution.final_state_norms[1] == pytest.approx(np.linalg.norm(np.linalg.multi_dot(d[::-1]), 2), rel=1e-9)
    assert isinstance(solution.optimality, Refusal)


def test_plain_dynamics_have_neither():
    system = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    problem = dd.Problem(system, x0=[0, 0], x_goal=[1, 0], num_steps=5, horizon=1.0, running_cost=EFFORT)
    solution = dd.solve(problem)
    assert isinstance(solution.final_state_norms, Refusal)
    assert isinstance(solution.optimality, Refusal)


def test_parameters_and_a_free_start_are_variables_too(thrown):
    """The ball reaches its goal without cost. The optimum is a zero of the residual, so that the gradient is 0."""
    assert thrown.optimality.gradient < 1e-6


def test_norms_beyond_all_numbers_are_infinite():
    """Each of 40 steps multiplies differences by 1e10."""
    d = differentiate_step(dd.load_model(MODELS / "cart_pole.urdf", time_step=H), np.zeros(4), [0.0])
    norms = final_state_norms([dataclasses.replace(d, A=1e10 * np.eye(4))] * 40)
    assert norms[-2] == 1e10
    assert norms[0] == np.inf


def test_a_plan_whose_derivatives_overflow_has_no_multipliers_and_says_so(tmp_path):
    """In steps of 1 s, an explicit spring of frequency 1000 grows by about 1e6 per step, beyond 1e308 in 60 steps."""
    path = tmp_path / "spring.xml"
    path.write_text(SPRING)
    model = dd.load_model(path, time_step=1.0)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[0, 0], num_steps=60, running_cost=EFFORT)
    solution = dd.solve(problem, method="shooting", initial_guess=(np.zeros((61, 2)), np.zeros((60, 1))))
    found = solution.optimality
    assert isinstance(found, Refusal)
    assert "exceed the range of numbers" in found.reason


SPRING = """<mujoco model="spring"><worldbody><body><joint name="slide" type="slide" axis="1 0 0" stiffness="1e6"/>
<geom type="sphere" size="0.1" mass="1"/></body></worldbody><actuator><motor joint="slide"/></actuator></mujoco>"""

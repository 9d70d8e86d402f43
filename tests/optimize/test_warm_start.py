"""Tests of a collocated solution as its own initial guess, with its mesh and its multipliers."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.table import each_row, slow_after

import drake_diff as dd
from drake_diff.optimize import Options
from drake_diff.optimize.program import Multipliers

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])


def block(upper=5.0, **asked):
    """Return x'' = u, -5 <= u <= 5 from rest at 0 to rest at 1 in T = 1, for which u is 6 - 12 t, clipped."""
    push = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1, u_lower=[-5], u_upper=[upper])
    given = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 20, "horizon": 1.0, "running_cost": EFFORT}
    return dd.Problem(push, **given | asked)


def swing_up(**asked):
    model = dd.example_model("cart_pole", time_step=0.04)
    limits = dd.Bounds(u_lower=[-15.0], u_upper=[15.0])
    given = {"x0": [0] * 4, "x_goal": [1, np.pi, 0, 0], "num_steps": 50, "running_cost": EFFORT, "bounds": limits}
    return dd.Problem(model, **given | asked)


def steps(solution):
    return len(solution.iterations) - 1  # the table begins with the guess


@each_row("make, asked", [(block, {}), (block, {"horizon": (0.1, 10), "running_cost": 1.0}), (swing_up, {})])
def test_its_own_optimum_takes_three_iterations_at_most(make, asked):
    problem = make(**asked)
    solution = dd.solve(problem, method="collocation")
    again = dd.solve(problem, method="collocation", initial_guess=solution)
    assert again.success
    assert steps(again) <= 3 < steps(solution)
    assert again.cost == pytest.approx(solution.cost, rel=1e-6)  # IPOPT leaves 1e-8 for each of 100 limits
    assert "multipliers" in again.solver_message
    without = dd.solve(problem, method="collocation", initial_guess=replace(solution, multipliers=None))
    assert steps(without) > steps(again)


def test_the_multiplier_of_a_limit_is_what_it_costs():
    """A multiplier is positive on an upper bound. It is d cost / d limit for bounds at the knots and between them."""
    solution = dd.solve(block())
    wider = dd.solve(block(5.001))
    of_inputs = solution.multipliers.variables.reshape(-1, 3)[:, 2]
    assert of_inputs[0] > 0 > of_inputs[-1]
    rows = solution.multipliers.rows[-20:]  # the last rows: the inner Bernstein coefficients of the intervals' inputs
    pushed = np.sum(np.maximum(of_inputs, 0.0)) + np.sum(np.maximum(rows, 0.0))
    assert (solution.cost - wider.cost) / 0.001 == pytest.approx(pushed, rel=1e-2)  # the cost is nonlinear


@pytest.mark.parametrize("moved", slow_after(1, [0.1, 1e-3]))
def test_a_problem_that_changed_comes_out_as_from_anywhere(moved):
    solution = dd.solve(swing_up(), method="collocation")
    other = swing_up(x0=[moved, -moved, 0, 0])
    warm = dd.solve(other, method="collocation", initial_guess=solution)
    cold = dd.solve(other, method="collocation", initial_guess=replace(solution, multipliers=None))
    assert warm.success
    assert warm.cost == pytest.approx(cold.cost, rel=1e-6)


def test_wrong_multipliers_do_no_harm():
    """Test multipliers of another sign and size, multipliers of NaN, and multipliers for another number of rows."""
    problem = block()
    solution = dd.solve(problem)
    sizes = solution.multipliers.sizes
    random = np.random.default_rng(0)
    wrong = Multipliers(*(1e3 * random.standard_normal(size) for size in sizes))
    none = Multipliers(*(np.full(size, np.nan) for size in sizes))
    other = Multipliers(np.zeros(sizes[0] + 1), np.zeros(sizes[1]))
    for multipliers in (wrong, none, other):
        again = dd.solve(problem, initial_guess=replace(solution, multipliers=multipliers))
        assert again.success
        assert again.cost == pytest.approx(solution.cost, rel=1e-6)
    assert "multipliers" not in again.solver_message
    longer = dd.solve(replace(problem, num_steps=30, us=None), initial_guess=solution)  # no multipliers on another mesh
    assert longer.success
    assert "multipliers" not in longer.solver_message


def test_a_refined_mesh_is_gone_on_from():
    model = dd.example_model("double_pendulum", time_step=0.03)
    cost = dd.QuadraticCost(R=np.eye(2))
    problem = dd.Problem(model, x0=[0] * 4, x_goal=[np.pi, 0, 0, 0], num_steps=40, running_cost=cost)
    solution = dd.solve(problem, method="collocation", options=Options(refine=True, error_tolerance=1e-5))
    assert len(solution.us) > 40
    again = dd.solve(problem, method="collocation", initial_guess=solution)
    assert again.success
    assert len(again.us) == len(solution.us)
    assert steps(again) <= 3
    never = dd.solve(problem, method="collocation", initial_guess=solution, options=Options(refine=False))
    assert len(never.us) == 40


def test_a_run_that_began_with_multipliers_comes_out_again(tmp_path):
    solution = dd.solve(swing_up(), method="collocation")
    again = dd.solve(swing_up(x0=[0.01, 0, 0, 0]), method="collocation", initial_guess=solution)
    dd.save(again, tmp_path / "run")
    found = dd.verify(tmp_path / "run")
    assert found.holds, found
    assert "differ" not in found.sentence

"""Tests of the advice after a failed solve: nothing that was just tried, and only what the problem accepts."""

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff.optimize import Options

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])


@pytest.mark.parametrize("method", ["collocation", "shooting"])
def test_a_tolerance_that_no_solver_reaches_is_judged_by_our_own_measures(method):
    """With a tolerance of 1e-17 IPOPT stops at an acceptable level, and the plan is at the optimum."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=60, running_cost=EFFORT)
    exact = dd.solve(problem, method=method)
    solution = dd.solve(problem, method=method, options=Options(tolerance=1e-17))
    assert solution.solver_message == "IPOPT: Solved To Acceptable Level"
    assert solution.success, solution.message
    assert f"by our own measures, where the solver says {solution.solver_message!r}" in repr(solution)
    assert solution.cost == pytest.approx(exact.cost, rel=1e-6)


@pytest.mark.slow
@each_row("outcome", ["FAILED", "ITERATION_LIMIT", "INACCURATE", "NO_GRADIENT"])
def test_what_a_solver_says_of_an_optimum_is_measured_again(outcome):
    """Check that a failure status is overruled at an optimum, but not for a feasible plan optimal for another cost."""
    from drake_diff.optimize.program import NlpResult, Outcome
    from drake_diff.optimize.verification import judged

    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=60, running_cost=EFFORT)
    good = dd.solve(problem, method="ilqr")
    said = NlpResult(good.us.ravel(), Outcome[outcome], "said", ())
    assert judged(good, said).success
    never = NlpResult(good.us.ravel(), Outcome.INFEASIBLE, "said", ())
    assert judged(good, never).status is dd.Status.INFEASIBLE
    other = dd.Problem(
        model,
        x0=[0, 0],
        x_goal=[np.pi, 0],
        num_steps=60,
        running_cost=dd.QuadraticCost(R=[[1.0]], Q=np.diag([3.0, 1.0])),
    )
    detour = dd.solve(other, method="ilqr")
    assert detour.success
    moved = dd.Solution(problem, "ilqr", "riccati", dd.Status.FAILED, "", detour.xs, detour.us)
    assert moved.optimality.ratio > 1e-3
    assert not judged(moved, said).success


def test_infeasible_stays_where_something_asked_is_not_kept():
    from drake_diff.optimize.program import NlpResult, Outcome
    from drake_diff.optimize.verification import judged

    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=60, running_cost=EFFORT)
    us = np.zeros((60, 1))
    still = dd.Solution(problem, "ilqr", "riccati", dd.Status.FAILED, "", np.zeros((61, 2)), us)
    assert judged(still, NlpResult(us.ravel(), Outcome.INFEASIBLE, "said", ())).status is dd.Status.INFEASIBLE


def test_what_limits_a_verified_plan_is_noted():
    """Check the notes on a horizon at its bound, on least time without input limits, and on a single initial guess."""
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    ends = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 10}
    longest = dd.solve(dd.Problem(block, **ends, horizon=(0.5, 2.0), running_cost=dd.QuadraticCost(R=[[1.0]])))
    assert "the horizon is on its bound of 2 s" in longest.notes  # the effort 12 d^2 / T^3 falls with T
    shortest = dd.solve(dd.Problem(block, **ends, horizon=(0.5, 2.0), running_cost=1.0), restarts=0)
    assert shortest.notes[:2] == ("the horizon is on its bound of 0.5 s", "the least time of inputs without limits: u0")
    assert "a local optimum: no other first guess was tried (restarts=0)" in shortest.notes
    assert dd.solve(dd.Problem(block, **ends, horizon=1.0)).notes == ("not an optimum: the problem has no cost",)
    light = dd.Dynamics(lambda x, u, m: [x[1], u[0] / m[0]], nx=2, nu=1, parameters={"m": 1.0})
    chosen = {"optimize": ("controls", "parameters"), "parameters": ["m"], "parameter_cost": lambda m: (m[0] - 2) ** 2}
    assert not any("no cost" in note for note in dd.solve(dd.Problem(light, **ends, horizon=1.0, **chosen)).notes)
    bounds = dd.Bounds(u_lower=[-4.0], u_upper=[4.0])  # T = 2 sqrt(d / u)
    limited = dd.solve(dd.Problem(block, **ends, horizon=(0.5, 2.0), running_cost=1.0, bounds=bounds), restarts=1)
    assert not any(
        "horizon is on" in note or "without limits" in note or "restarts=0" in note for note in limited.notes
    )


def test_a_start_at_a_kink_is_to_be_moved():
    """The foot of a hopper just touches the ground at x0, where the step jumps with the length of its leg."""
    model = dd.load_model(MODELS / "hopper.sdf", time_step=0.005, fix_joints=("x", "swing"))
    solution = dd.solve(dd.Problem(model, x0={"z_x": 0.5, "leg_x": 0.45}, num_steps=5, running_cost=EFFORT))
    assert solution.certificates[0].verdict == "discontinuous"
    assert "to try: an x0 that is not exactly at a contact or joint limit" in solution.notes

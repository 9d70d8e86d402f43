"""What a solve that is no success says to try: nothing that it has just tried, and only what the problem takes."""

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
    """1e-17: IPOPT stops at an acceptable level, at the optimum."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=60, running_cost=EFFORT)
    exact = dd.solve(problem, method=method)
    solution = dd.solve(problem, method=method, options=Options(tolerance=1e-17))
    assert solution.solver_message == "IPOPT: Solved To Acceptable Level"
    assert solution.success, solution.message
    assert f"by our own measures, where the solver says {solution.solver_message!r}" in repr(solution)
    assert solution.cost == pytest.approx(exact.cost, rel=1e-6)


@pytest.mark.slow
@each_row("outcome", ["INFEASIBLE", "FAILED", "ITERATION_LIMIT", "INACCURATE", "NO_GRADIENT"])
def test_what_a_solver_says_of_an_optimum_is_measured_again(outcome):
    """The words are false of an optimum; a plan that keeps all, and is the optimum of another cost, is none."""
    from drake_diff.optimize.program import NlpResult, Outcome
    from drake_diff.optimize.verification import judged

    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=60, running_cost=EFFORT)
    good = dd.solve(problem, method="ilqr")
    said = NlpResult(good.us.ravel(), Outcome[outcome], "said", ())
    assert judged(good, said).success
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

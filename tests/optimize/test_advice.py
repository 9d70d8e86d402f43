"""What a solve that is no success says to try: nothing that it has just tried, and only what the problem takes."""

import re

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.problems import push
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError

EFFORT = dd.QuadraticCost(R=[[1.0]])


def to_try(solution):
    assert not solution.success, solution.message
    return solution.message.split("to try: ")[1]


def methods_in(text):
    return set(re.findall(r'method="(\w+)"(?! with)(?!, which)', text))


def swing_up(**changes):
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.05)
    fields = {"x0": np.zeros(4), "x_goal": [1, np.pi, 0, 0], "num_steps": 20, "running_cost": EFFORT, **changes}
    return dd.Problem(model, **fields)


@each_row("method", ["collocation", "shooting", "ilqr"])
def test_after_one_method_the_others_are_named_and_not_itself(method):
    """3 iterations are not enough for a swing-up."""
    told = to_try(dd.solve(swing_up(), method=method, max_iterations=3))
    assert methods_in(told) == {"collocation", "shooting", "ilqr"} - {method}
    assert "max_iterations above 3" in told


def test_after_the_chain_no_method_of_it_is_named():
    solution = dd.solve(swing_up(bounds=dd.Bounds(u_lower=[-0.1], u_upper=[0.1])), max_iterations=20)
    tried = {link["method"] for link in solution.options["chain"]}
    assert tried == {"collocation", "ilqr"}
    assert methods_in(to_try(solution)) == {"shooting"}


def test_parameters_that_are_only_given_keep_no_method_away():
    solution = dd.solve(swing_up(parameters={"cart.mass": 1.0}), method="shooting", max_iterations=3)
    assert methods_in(to_try(solution)) == {"collocation", "ilqr"}


@pytest.mark.slow
def test_a_continuation_is_named_until_it_was_tried(two_spheres):
    model = two_spheres()
    told = to_try(dd.solve(push(model, gap=0.4, goal=1.0), method="ilqr"))
    assert 'method="ilqr" with continuation="auto"' in told
    assert 'method="ilqr" with continuation="auto"' in to_try(
        dd.solve(push(model, gap=0.4, goal=1.0), method="shooting")
    )
    beyond = push(model, gap=0.4, goal=30.0, num_steps=10)  # m away in 0.2 s, with 50 N
    for options in ({"continuation": "auto"}, {"method": "auto"}):
        solution = dd.solve(beyond, max_iterations=20, **options)
        assert "continuation" not in to_try(solution), solution.message


def test_refinement_is_named_until_it_was_tried():
    problem = swing_up(num_steps=6, horizon=2.0)
    coarse = dd.solve(problem, method="collocation", refine=False)
    assert "refine=True" in coarse.message
    refined = dd.solve(problem, method="collocation", refine=True, max_num_steps=7, error_tolerance=1e-12)
    assert not refined.success
    assert "refine=True" not in refined.message
    assert "max_num_steps" in refined.message


def test_an_attempt_that_was_cut_short_is_named_with_all_its_iterations(monkeypatch):
    monkeypatch.setattr("drake_diff.optimize.solve.GUESS_ITERATIONS", 1)
    monkeypatch.setattr("drake_diff.optimize.solve.PREFERENCE", ())
    solution = dd.solve(swing_up(), max_iterations=2)
    told = to_try(solution)
    assert ("all 2 iterations" in told) == (solution.method == "ilqr")
    assert ("max_iterations above 2" in told) == (solution.method != "ilqr")


@each_row("status", [s for s in dd.Status if s not in (dd.Status.CONVERGED, dd.Status.INTERRUPTED)])
def test_every_status_that_is_no_success_has_something_to_try(status):
    from drake_diff.optimize.verification import advice

    solution = dd.solve(swing_up(), method="ilqr", max_iterations=1).told(status=status)
    assert advice(solution, {"max_iterations": 1, "time_limit": 1.0}, []).startswith("to try: ")


def test_a_success_and_an_interrupt_have_nothing_to_try():
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=20, running_cost=EFFORT)
    assert "to try" not in dd.solve(problem).message


@pytest.mark.slow
def test_what_is_named_is_taken():
    """Each method that a refusal names for a problem is not refused for it."""
    problems = [swing_up(), swing_up(horizon=(0.5, 2.0)), swing_up(trajectory_cost=lambda xs, us: 0.0 * xs[-1][0])]
    for problem in problems:
        for method in ("collocation", "shooting", "ilqr"):
            try:
                solution = dd.solve(problem, method=method, max_iterations=2)
            except InputError:
                continue
            for other in methods_in(solution.message):
                dd.solve(problem, method=other, max_iterations=1)


@pytest.mark.parametrize("method", ["collocation", "shooting"])
def test_a_tolerance_that_no_solver_reaches_is_judged_by_our_own_measures(method):
    """1e-17: IPOPT stops at an acceptable level, at the optimum."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=60, running_cost=EFFORT)
    exact = dd.solve(problem, method=method)
    solution = dd.solve(problem, method=method, tolerance=1e-17)
    assert solution.solver_message == "IPOPT: Solved To Acceptable Level"
    assert solution.success, solution.message
    assert f"by our own measures, where the solver says {solution.solver_message!r}" in solution.message
    assert solution.cost == pytest.approx(exact.cost, rel=1e-6)


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

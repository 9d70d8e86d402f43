"""The random first guesses of "auto": a pendulum with several optima, a convex problem, and their limits."""

import importlib
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from helpers.models import MODELS

import drake_diff as dd
from drake_diff.optimize import starts

EFFORT = dd.QuadraticCost(R=[[1.0]])


def weak_pendulum(steps: int) -> dd.Problem:
    """Swing up with at most 3 N m, where gravity takes 4.9 N m: the number of swings is a choice."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=4.0 / steps)
    bounds = dd.Bounds(u_lower=[-3], u_upper=[3])
    return dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=steps, running_cost=EFFORT, bounds=bounds)


@pytest.mark.parametrize("steps", [37, 52, 80])
def test_the_optimum_of_a_pendulum_does_not_depend_on_the_number_of_steps(steps):
    """The best of 24 restarts costs between 5.46 and 5.53; a straight line leads to 6.4 or more at 37 and 52 steps."""
    solution = dd.solve(weak_pendulum(steps))
    assert solution.success
    assert 5.4 < solution.cost < 5.6
    assert any("random first guesses" in note for note in solution.notes)


def test_a_convex_problem_takes_five_starts():
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    problem = dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=10, horizon=1.0, running_cost=EFFORT)
    solution = dd.solve(problem)
    assert solution.notes[0].startswith("a local optimum: 5 random first guesses in ")
    assert solution.notes[0].endswith("led to no cheaper motion")
    assert solution.cost == pytest.approx(12.0, rel=1e-6)


def test_the_errors_of_long_steps_are_no_cheaper_motion():
    """A soft goal is solved by iLQR in steps, whose optimum costs 1 % more than that of the convex problem in time."""
    model = dd.example_model("mass_spring_damper", time_step=0.05)
    costs = {"running_cost": dd.QuadraticCost(R=[[1e-2]]), "final_cost": lambda x: 100 * (x[0] - 1) ** 2 + x[1] ** 2}
    problem = dd.Problem(model, x0=[0, 0], num_steps=20, **costs)
    solution, exact = dd.solve(problem), dd.solve(problem, method="collocation")
    assert (solution.success, solution.method) == (True, "ilqr")
    assert solution.cost > 1.005 * exact.cost
    assert "led to no cheaper motion" in solution.notes[-1]
    assert "a local optimum: 5 random first guesses" in solution.notes[-1]


def test_other_starts_are_never_worse_and_only_without_a_given_guess_or_number(monkeypatch):
    problem = weak_pendulum(40)
    plain = dd.solve(problem, restarts=0)
    assert dd.solve(problem, initial_guess=plain).cost == pytest.approx(plain.cost, rel=1e-6)
    assert dd.solve(problem).cost < 0.9 * plain.cost
    monkeypatch.setattr(starts, "MOST_OF_A_START", 2)  # no search ends
    same = dd.solve(problem)
    assert same.success
    assert same.cost == plain.cost
    assert "led to no cheaper motion" in same.options["chain"][-1]["ended"]


def test_a_start_that_leads_back_to_the_plan_does_not_end_the_search(monkeypatch):
    """On a finer mesh, the search from a cheaper motion may return to the plan. The next cheaper motion is tried."""
    module, problem = importlib.import_module("drake_diff.optimize.solve"), weak_pendulum(40)
    search = module.search_cheaper

    def plan_and_cheaper(plan, *arguments):
        result = search(plan, *arguments)
        return replace(result, cheaper=(plan, *result.cheaper))

    monkeypatch.setattr(module, "search_cheaper", plan_and_cheaper)
    assert dd.solve(problem).cost < 0.9 * dd.solve(problem, restarts=0).cost


def test_ctrl_c_during_the_other_starts_returns_the_verified_plan():
    def interrupt(line):
        if "random first guess 1" in line:
            os.kill(os.getpid(), signal.SIGINT)

    solution = dd.solve(weak_pendulum(40), progress=interrupt)
    assert solution.success
    assert solution.cost == dd.solve(weak_pendulum(40), restarts=0).cost
    assert "before the user or the time limit ended the search" in solution.notes[-1]


def test_a_run_with_other_starts_is_repeated_exactly(tmp_path):
    solution = dd.solve(weak_pendulum(30), seed=3)
    dd.save(solution, tmp_path / "run")
    assert dd.verify(tmp_path / "run").holds
    assert np.array_equal(dd.solve(weak_pendulum(30), seed=3).xs, solution.xs)

"""Tests of goals that apply for a duration, and of sets in which a regulator takes over."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row, slow_after
from scipy.linalg import solve_discrete_are

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError
from drake_diff.motion import LQR
from drake_diff.optimize import Dwell, TerminalSet
from drake_diff.runs.messages import asked_for

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])
METHODS = ["collocation", "shooting", "ilqr"]


def crane(**more):
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.05)
    return dd.Problem(model, x0=np.zeros(4), **{"num_steps": 50, "running_cost": EFFORT} | more)


def stay(seconds=0.5, **more):
    return Dwell(dd.JointGoal({"slide_x": 0.5, "hinge_q": 0.0}, tolerance=0.02), seconds, **more)


def swung_up(path="pendulum.urdf", goal=(np.pi, 0.0), limit=3.0, **more):
    model = dd.load_model(MODELS / path, time_step=0.05)
    bounds = dd.Bounds(u_lower=[-limit], u_upper=[limit])
    goals = [TerminalSet(goal)]
    return dd.Problem(
        model, x0=np.zeros(model.nx), bounds=bounds, **{"num_steps": 60, "goals": goals, "running_cost": EFFORT} | more
    )


@pytest.mark.slow
@each_row("method", METHODS)
def test_a_crane_stays_where_it_was_sent(method):
    solution = dd.solve(crane(goals=[stay()]), method=method)
    assert solution.success, solution.message
    # The last 0.5 s of 2.5 s, in the plan and on the plant in its finest steps
    assert np.max(np.abs(solution.xs[solution.times >= 2.0 - 1e-9, :2] - [0.5, 0])) < 0.0101
    held = [r for r in solution.replays if r.holds][-1].motion
    assert np.max(np.abs(held.xs[held.times >= 2.0 - 1e-9, :2] - [0.5, 0])) <= 0.02


def test_it_stays_on_the_way():
    solution = dd.solve(crane(goals=[stay(end=30)], x_goal=[1.0, 0, 0, 0], num_steps=60), method="collocation")
    assert solution.success, solution.message
    state, _ = solution.trajectory()
    between = state.vector_values(np.linspace(1.0, 1.5, 501)).T
    assert np.max(np.abs(between[:, :2] - [0.5, 0])) <= 0.02
    asked = asked_for(solution.problem, solution.times)
    assert "hinge_q = 0 and slide_x = 0.5 for 0.5 s from 1 to 1.5 s" in asked


def test_a_motion_that_leaves_too_early_is_refused():
    """One knot of the stay is moved by more than the half of the tolerance that the plan uses."""
    solution = dd.solve(crane(goals=[stay()]))
    random, knots = np.random.default_rng(0), np.flatnonzero(solution.times >= 2.0 - 1e-9)
    for _ in range(30):
        xs = np.array(solution.xs)
        xs[random.choice(knots), 0] += random.choice([-1, 1]) * 10 ** random.uniform(-1.6, 0)  # 25 mm or more
        excess, knot = replace(solution, xs=xs).constraint_excess["slide_x, stayed at"]
        assert excess > 5e-3
        assert knot >= knots[0]


@each_row(
    "make, told",
    [
        (lambda: stay(0), "above 0"),
        (lambda: Dwell(3, 1.0), "a goal of a state"),
        (lambda: Dwell(dd.JointGoal({"slide_x": 1.0}, weight=1.0), 1.0), "without knots and weight"),
        (lambda: Dwell(dd.SelfCollision(), 1.0), "a goal of a state"),
        (lambda: stay(end=1.5), "whole number"),
        (lambda: crane(goals=[stay(3.0)]), "at most 2.5"),
        (lambda: crane(goals=[stay(end=51)]), "from -51 to 50"),
        (lambda: crane(goals=[stay()], horizon=(1, 5)), "PhasedProblem"),
    ],
)
def test_what_is_no_stay_is_refused_at_once(make, told):
    with pytest.raises(InputError, match=told):
        make()


def test_the_set_of_a_block_is_the_largest_in_which_its_force_is_enough(write_urdf):
    """For a linear plant the level is that at which the largest |K d| is the limit, by SciPy's Riccati equation."""
    model, h, limit = write_urdf(time_step=0.1), 0.1, 0.7
    mass = 1 / model_gain(model)
    A, B = np.array([[1, h], [0, 1]]), np.array([[h * h], [h]]) / mass  # Drake's step: v first, then q with the new v
    S = solve_discrete_are(A, B, np.eye(2), np.eye(1))
    K = np.linalg.solve(np.eye(1) + B.T @ S @ B, B.T @ S @ A)
    wanted = limit**2 / float((K @ np.linalg.inv(S) @ K.T)[0, 0])
    bounds = dd.Bounds(u_lower=[-limit], u_upper=[limit], x_lower=[-np.inf] * 2, x_upper=[np.inf] * 2)
    problem = dd.Problem(model, x0=[0, 0], num_steps=5, x_goal=[0, 0], bounds=bounds)
    region = TerminalSet([0, 0]).region(model, problem.bounds)
    np.testing.assert_allclose(region.cost_to_go, S, rtol=1e-8)
    assert region.level == pytest.approx(wanted, rel=1e-8)


def model_gain(model):
    return dd.step(model, [0, 0], [1.0])[1] / model.time_step


@pytest.mark.parametrize("method", slow_after(1, METHODS))
def test_a_pendulum_swings_up_to_where_a_regulator_takes_over(method):
    solution = dd.solve(swung_up(), method=method)
    assert solution.success, solution.message
    assert all(c.passes for c in solution.checks if c.what == "regulator" and c.plant == "in steps of 0.01 s")
    # Drake's own plant comes to rest upright under the regulator of its own LQR
    model, x = solution.problem.model, np.array(solution.xs[-1])
    regulator = LQR(model, [np.pi, 0], [0], np.eye(2), np.eye(1))
    for _ in range(200):
        u = regulator(x, 0.0)
        assert np.abs(u) <= 3.0
        x = dd.step(model, x, u)
    assert np.max(np.abs(x - [np.pi, 0])) < 1e-6


@pytest.mark.slow
def test_where_a_formula_is_too_hopeful_sampling_lowers_the_level():
    """An acrobot falls over long before its torque is at the limit. States of other seeds test the level."""
    problem = swung_up("acrobot.xml", (np.pi, 0, 0, 0), 500.0)
    model = problem.model
    region = problem.goals[0].region(model, problem.bounds)
    assert region.level < 0.3 * region.linear_level
    hopeful, random = replace(region, level=region.linear_level), np.random.default_rng(7)

    def arrives(x):
        regulator = LQR(model, [np.pi, 0, 0, 0], [0], np.eye(4), np.eye(1))
        for _ in range(400):
            if np.max(np.abs(x)) > 1e6:  # it spins too fast for this time step
                return False
            x = dd.step(model, x, np.clip(regulator(x, 0.0), -500, 500))
        return bool(np.max(np.abs(x - [np.pi, 0, 0, 0])) < 0.05)

    assert sum(arrives(region.random_state(random)) for _ in range(60)) == 60
    assert sum(arrives(hopeful.random_state(random)) for _ in range(60)) < 45
    with pytest.raises(InputError, match="no convergence from"):
        replace(problem, goals=[TerminalSet((np.pi, 0, 0, 0), level=region.linear_level)])


def test_an_end_outside_of_the_set_is_refused():
    solution = dd.solve(swung_up())
    region = solution.problem.kept_goals[0].region
    random, refused = np.random.default_rng(0), 0
    for _ in range(40):
        xs = np.array(solution.xs)
        xs[-1] += random.normal(0, 1.0, 2)
        d = xs[-1] - region.x_goal
        outside = d @ region.cost_to_go @ d > 0.75 * region.level + 1e-4
        refused += outside
        assert (replace(solution, xs=xs).constraint_excess["terminal set"][0] > 1e-5) == outside
    assert refused > 20


@each_row(
    "make, told",
    [
        (lambda: TerminalSet([np.pi, 0], level=-1), "above 0"),
        (lambda: swung_up(goals=[TerminalSet([np.pi, 0], level=1e6)]), "the largest level within the limits"),
        (lambda: swung_up(goals=[TerminalSet([1.5, 0])]), "a fixed point with u"),
        (lambda: swung_up(goals=[TerminalSet([np.pi, 0, 0])]), "shape"),
        (lambda: swung_up(goals=[TerminalSet([np.pi, 0])], limit=1e-300), "a fixed point with u"),
    ],
)
def test_what_is_no_set_is_refused_at_once(make, told):
    with pytest.raises(dd.exceptions.DrakeDiffError, match=told):
        make().kept  # noqa: B018


def test_a_quadrotor_has_quaternions_and_no_set():
    model = dd.load_model(MODELS / "quadrotor.urdf", time_step=0.02)
    with pytest.raises(ModelError, match=r"quaternions"):
        dd.Problem(
            model, x0=model.default_state, num_steps=5, goals=[TerminalSet(model.default_state)],
            optimize="initial_state",
        )  # fmt: skip


def test_a_set_is_one_of_the_model_as_it_is():
    solution = dd.solve(swung_up())
    assert dd.sensitivity(solution).verdict == "agree"
    with pytest.raises(InputError, match=r"a TerminalSet does not depend on the other parameters"):
        dd.sensitivity(solution, ["pole.mass"])


@pytest.mark.slow
def test_records_of_both_are_verified(tmp_path):
    for name, problem in (("stay", crane(goals=[stay()])), ("set", swung_up())):
        solution = dd.solve(problem)
        assert dd.save(solution, tmp_path / name).verdict == "pass"
        found = dd.verify(tmp_path / name)
        assert found.holds, found
        assert any(word in " ".join(found.claimed) for word in ("Dwell", "TerminalSet"))

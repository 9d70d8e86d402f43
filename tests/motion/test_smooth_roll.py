"""Compiled smooth steps equal Drake's steps, and the results of a search are from Drake's rollout."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.models import robot_file
from helpers.table import each_row

import drake_diff as dd
from drake_diff.motion import smooth_roll
from drake_diff.motion.smooth_roll import SmoothRoll, smooth_roll_of
from drake_diff.optimize.ilqr.ilqr import solve_ilqr
from drake_diff.optimize.program import Limits, Outcome

pytestmark = [pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning"), pytest.mark.solve]


def arm(file, time_step=0.01):
    return dd.load_model(
        robot_file(file), time_step=time_step, base="weld", actuators="all", mimic="fix", contact=False
    )


def in_the_middle(model):
    lower, upper = model.position_limits
    return np.concatenate([(np.maximum(lower, -2) + np.minimum(upper, 2)) / 2, np.zeros(model.nv)])


def stays(model):
    """Return x0 and the other arguments of a roll without feedback, gaps and bounds."""
    free = np.full(model.nu, np.inf)
    zeros = np.zeros((12, model.nu, model.nx))
    return in_the_middle(model), np.zeros((13, model.nx)), np.zeros((12, model.nx)), zeros, (-free, free, -free, free)


@each_row("file", ["ur5_robot.urdf", "panda.urdf", "z1.urdf"])
@each_row("time_step", [0.002, 0.02])
@each_row("seed", [0, 1])
def test_it_moves_as_drake_does(file, time_step, seed):
    """12 steps with gravity, damping and reflected inertia agree to 1e-11 of the largest state."""
    model, random = arm(file, time_step), np.random.default_rng(seed)
    x0, old, gaps, gains, bounds = stays(model)
    x0 = x0 + 0.05 * random.standard_normal(model.nx)
    us = random.standard_normal((12, model.nu))
    roll = smooth_roll_of(model)
    assert isinstance(roll, SmoothRoll)
    xs, used, count = roll(x0, old, gaps, us, gains, bounds)
    expected = dd.rollout(model, x0, us).xs
    assert count == 12
    np.testing.assert_array_equal(used, us)
    np.testing.assert_allclose(xs, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_feedback_gaps_and_bounds_are_those_that_drakes_step_gets():
    model, random = arm("ur5_robot.urdf"), np.random.default_rng(3)
    x0, old, gaps, gains, _ = stays(model)
    gaps, gains = (0.01 * random.standard_normal(part.shape) for part in (gaps, gains))
    wanted, limit = random.standard_normal((12, model.nu)), np.ones(model.nu)
    xs, us, _ = smooth_roll_of(model)(x0, old, gaps, wanted, gains, (-0.9 * limit, 0.9 * limit, -limit, limit))
    x = x0
    for k in range(12):
        u = wanted[k] + gains[k] @ (x - old[k])
        u = np.where(u <= -0.9, -1.0, np.where(u >= 0.9, 1.0, u))
        np.testing.assert_allclose(us[k], u, rtol=0, atol=1e-12)
        x = dd.step(model, x, u) - gaps[k]
        np.testing.assert_allclose(xs[k + 1], x, rtol=0, atol=1e-12 * np.abs(x).max())


def test_what_it_leaves_out_it_does_not_move(write_urdf):
    model = arm("ur5_robot.urdf")
    x0, old, gaps, gains, bounds = stays(model)
    roll, us = smooth_roll_of(model), np.zeros((12, model.nu))
    at_limit = x0.copy()
    at_limit[2] = model.position_limits[1][2] - 1e-4
    at_limit[model.nq + 2] = 1.0
    assert roll(at_limit, old, gaps, us, gains, bounds)[2] == 0
    us[3:] = np.nan
    xs, _, count = roll(x0, old, gaps, us, gains, bounds)
    assert count == 3
    np.testing.assert_allclose(xs[:4], dd.rollout(model, x0, us[:3]).xs, rtol=0, atol=1e-11 * np.abs(xs[:4]).max())
    touching = dd.load_model(robot_file("ur5_robot.urdf"), time_step=0.01, base="weld", actuators="all")
    floating = dd.example_model("quadrotor", time_step=0.01)
    for other in (touching, floating):
        if other.contract.contact.collision_pairs or other.nq != other.nv:
            assert smooth_roll_of(other) is None


def reach(model):
    """Return the reaching problem of `tests/benchmarks/peers_examples.py`."""
    goal = np.array([0.5, -1.2, 1.0, -0.8, 0.6, 0.3, 0, 0, 0, 0, 0, 0])
    weights = np.repeat([0.1, 0.01], 6), np.repeat([1000.0, 10.0], 6)
    effort, final = (dd.QuadraticCost(Q=np.diag(q), R=1e-3 * np.eye(6), x_ref=goal) for q in weights)
    free = dd.Bounds(*(np.full(n, sign * np.inf) for n in (12, 6) for sign in (-1, 1)))
    x0 = [0.0, -0.6, 0.3, -0.2, *np.zeros(8)]
    return dd.Problem(model, x0=x0, num_steps=100, running_cost=effort, final_cost=replace(final, R=None), bounds=free)


def searched(problem):
    xs, us = np.tile(problem.x0, (problem.num_steps + 1, 1)), np.zeros((problem.num_steps, problem.nu))
    return solve_ilqr(problem, xs, us, limits=Limits(100, 60.0, 1e-8), report=None)


def test_what_is_told_is_drakes_own_rollout():
    """The states are equal to the last bit, and the last iteration has the cost of this rollout."""
    problem = reach(arm("ur5_robot.urdf"))
    result, xs, us = searched(problem)
    assert result.outcome is Outcome.SOLVED
    np.testing.assert_array_equal(xs, dd.rollout(problem.model, problem.x0, us).xs)
    cost = problem.objective(xs, us)
    assert result.iterations[-1].objective == pytest.approx(cost, rel=1e-14)  # sums in another order: a few roundings


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [1 + 1e-6, 1.01])
def test_a_form_that_moves_otherwise_is_found_out(wrong, monkeypatch):
    """A search whose trial rolls have wrong masses ends at the same solution, to 1e-9 of its cost."""
    problem = reach(arm("ur5_robot.urdf"))
    expected, _, right = searched(problem)
    plain = smooth_roll.SmoothRoll.__call__

    def planted(self, *args):
        tree = self.tree._replace(mass=wrong * self.tree.mass)
        return plain(SmoothRoll(self.smooth, tree, self.forces), *args)

    monkeypatch.setattr(smooth_roll.SmoothRoll, "__call__", planted)
    result, xs, us = searched(problem)
    assert result.outcome is expected.outcome is Outcome.SOLVED
    np.testing.assert_array_equal(xs, dd.rollout(problem.model, problem.x0, us).xs)
    assert result.iterations[-1].objective == pytest.approx(expected.iterations[-1].objective, rel=1e-9)
    assert np.abs(us - right).max() < 1e-4 * np.abs(right).max()

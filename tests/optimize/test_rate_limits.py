"""Tests of limits on the rates of inputs and accelerations: least times in closed form, and detected violations."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.optimize import Acceleration, InputRate, Jerk

pytestmark = pytest.mark.solve

BLOCK = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
EFFORT = dd.QuadraticCost(R=[[1.0]])
ENDS = dd.Constraint(lambda x, u: u, 0.0, 0.0, knots=(0, -1), name="no force at the ends")


def least_time(way, most, rate, couplings, **more):
    limits = dd.Bounds(u_lower=[-most], u_upper=[most])
    asked = {"num_steps": 40, "horizon": (0.2, 10), "running_cost": 1.0, "bounds": limits, "constraints": ENDS}
    return dd.Problem(BLOCK, x0=[0, 0], x_goal=[way, 0], couplings=couplings, **asked | more)


@each_row("limit", [InputRate(2.0), Jerk({"x1": 2.0})])
@each_row("way", [0.1, 1.0])
def test_the_least_time_from_rest_to_rest_is_that_of_the_s_curve(way, limit):
    """|a| <= 1 and |a'| <= 2 give four ramps of (way / (2 J))^(1/3) each, and plateaus where they would pass A."""
    A, J = 1.0, 2.0
    wanted = 4 * (way / (2 * J)) ** (1 / 3) if way < 2 * A**3 / J**2 else A / J + np.sqrt((A / J) ** 2 + 4 * way / A)
    solution = dd.solve(least_time(way, A, J, limit))
    assert solution.success
    assert solution.horizon == pytest.approx(wanted, rel=1e-3)  # the input switches between the knots of 40 intervals
    assert solution.horizon > wanted * (1 - 1e-6)


def test_a_limit_of_acceleration_gives_the_time_of_bang_bang_motion():
    """With |a| <= A alone, the least time over a distance is 2 sqrt(way / A)."""
    solution = dd.solve(least_time(1.0, 100.0, 0.0, Acceleration({"x1": 4.0}), constraints=()))
    assert solution.success
    assert solution.horizon == pytest.approx(1.0, rel=1e-3)  # parabolas switch within an interval
    us = np.array(solution.us)
    us[3] = 4.5
    assert replace(solution, us=us).constraint_excess["acceleration"][0] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.slow
@each_row("method", ["collocation", "shooting"])
def test_a_pendulum_accelerates_within_its_limit(method):
    """Without the limit, the motion from 0 to 1 rad in 1 s has a larger acceleration."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.025)
    problem = dd.Problem(
        model, x0=[0, 0], x_goal=[1, 0], num_steps=40, running_cost=EFFORT, couplings=Acceleration(4.5)
    )
    solution = dd.solve(problem, method=method)
    assert solution.success, solution.message
    assert np.max(np.abs(np.diff(solution.xs[:, 1]))) <= 4.5 * 0.025 + 1e-6
    free = dd.solve(replace(problem, couplings=()), method=method)
    assert np.max(np.abs(np.diff(free.xs[:, 1]))) > 5.0 * 0.025


@pytest.mark.slow
@each_row("method", ["collocation", "shooting"])
def test_a_pendulum_swings_up_with_a_slow_motor(method):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    problem = dd.Problem(
        model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=60, running_cost=EFFORT, couplings=InputRate(10.0),
        bounds=dd.Bounds(u_lower=[-3.0], u_upper=[3.0]),
    )  # fmt: skip
    solution = dd.solve(problem, method=method)
    assert solution.success, solution.message
    assert np.max(np.abs(np.diff(solution.us[:, 0]))) <= 10 * 0.05 + 1e-6
    for replay in solution.replays:  # feedback has the same limit
        assert np.max(np.abs(np.diff(replay.motion.us[:, 0]))) <= 10 * 0.05 * 1.05


@pytest.mark.slow
def test_steps_of_another_length_have_their_own_rates():
    """A horizon of 2 s in 40 steps of a model of 0.02 s. Inputs change from one step of 0.05 s to the next."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(
        model, x0=[0, 0], x_goal=[1, 0], num_steps=40, horizon=2.0, running_cost=EFFORT, couplings=InputRate(4.0)
    )
    solution = dd.solve(problem, method="shooting")
    assert solution.success, solution.message
    assert 0.9 * 4.0 * 0.05 < np.max(np.abs(np.diff(solution.us[:, 0]))) <= 4.0 * 0.05 + 1e-6
    with pytest.raises(InputError, match=r"a given horizon.*collocation"):
        dd.solve(replace(problem, horizon=(1.0, 3.0)), method="shooting")


def test_an_arm_moves_without_jerks_and_its_motion_is_smooth_between_its_knots():
    model = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.05)
    problem = dd.Problem(
        model, x0=np.zeros(4), x_goal=[1, -1, 0, 0], num_steps=20, running_cost=dd.QuadraticCost(R=np.eye(2)),
        couplings=Jerk(60.0),
    )  # fmt: skip
    solution = dd.solve(problem, method="collocation")
    assert solution.success, solution.message
    state, given = solution.trajectory()
    times = np.linspace(0, solution.horizon, 2001)
    knots = np.hstack([state.vector_values(times).T, given.vector_values(times).T])
    accelerations = problem.dynamics.values(knots)[:, 2:]
    # By differences of the plant's accelerations. The check allows 1 % of the limit.
    assert np.max(np.abs(np.diff(accelerations, axis=0))) / times[1] <= 60.6


def test_whatever_breaks_a_limit_is_seen():
    """Inputs are moved at random. The expected violations are from the slopes of the parabolas through them."""
    for limit in (InputRate(2.0), Jerk({"x1": 2.0})):
        solution = dd.solve(least_time(1.0, 1.0, 2.0, limit, horizon=3.0, running_cost=EFFORT))
        assert solution.success
        random, tau, planted = np.random.default_rng(0), np.array([0, 0.5, 1.0]), 0
        for _ in range(100):
            us, us_mid = np.array(solution.us), np.array(solution.us_mid)
            moved = us if random.random() < 0.5 else us_mid
            moved[random.integers(1, len(us))] += random.choice([-1, 1]) * 10 ** random.uniform(-4, 0)
            changed = replace(solution, us=us, us_mid=us_mid)
            ends, h = np.vstack([us, solution.u_final[None]])[:, 0], np.diff(solution.times)
            parabolas = [np.polyfit(tau, [ends[k], us_mid[k, 0], ends[k + 1]], 2) for k in range(len(us))]
            slopes = [abs(np.polyval(np.polyder(p), t)) / length for p, length in zip(parabolas, h, strict=True)
                      for t in (0, 1)]  # fmt: skip
            excess = max(slopes) - 2.0
            found = changed.constraint_excess[limit.label][0]
            assert found == pytest.approx(max(excess, 0.0), abs=1e-9)
            planted += excess > 1e-5
        assert planted > 50


def test_a_record_of_it_is_verified_and_one_that_breaks_it_fails(tmp_path):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    problem = dd.Problem(
        model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=EFFORT,
        couplings=[InputRate({"motor": 60.0}), Acceleration(30.0), Jerk(300.0)],
    )  # fmt: skip
    solution = dd.solve(problem)
    assert dd.save(solution, tmp_path / "a").verdict == "pass"
    found = dd.verify(tmp_path / "a")
    assert found.holds
    assert sum("coupling" in line for line in found.claimed) == 3
    us = np.array(solution.us)
    us[5] += 1.0
    assert dd.save(replace(solution, us=us), tmp_path / "b").verdict == "fail"


@each_row(
    "couplings, error, told",
    [
        (lambda: InputRate(0), InputError, "above 0"),
        (lambda: InputRate({}), InputError, "no names"),
        (lambda: Jerk(-1.0), InputError, "above 0"),
        (lambda: Acceleration({"x5": 3.0}), UnknownNameError, "x5"),
        (lambda: InputRate({"none": 1.0}), UnknownNameError, "none"),
        (lambda: Jerk(3.0), InputError, "by name"),
        (lambda: Jerk({"x5": 3.0}), UnknownNameError, "x5"),
    ],
)
def test_what_is_no_limit_is_refused_at_once(couplings, error, told):
    with pytest.raises(error, match=told):
        least_time(1.0, 1.0, 1.0, couplings())


@each_row("limit, by", [(InputRate(8.0), "goal"), (Acceleration(5.0), ["pole.mass"]), (Jerk(40.0), ["pole.mass"])])
def test_a_sensitivity_counts_them(limit, by):
    """Check this also for jerks, whose rows change with the parameters of the model."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=EFFORT, couplings=limit)
    found = dd.sensitivity(dd.solve(problem), by)
    assert found.verdict == "agree", found
    assert found.active > 0

"""Tests of constraint violations between the nodes, with walls of random width that no motion can avoid."""

import numpy as np
import pytest
from helpers.plants import block
from helpers.table import slow_after

import drake_diff as dd
from drake_diff.exceptions import GradientError
from drake_diff.optimize.transcription.between import violation_between_nodes
from drake_diff.optimize.transcription.collocation import collocated


def pushed():
    return dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)


def wall(random):
    """Return a wall of 1 mm to 10 cm on the only way from 0 to 1 m, in one of four forms, and its half width."""
    half, at = 10 ** random.uniform(-3.3, -1.3), random.uniform(0.2, 0.8)
    forms = (
        (lambda x: (x[0] - at) ** 2, half**2),
        (lambda x: 1e3 * (x[0] - at) ** 2, 1e3 * half**2),
        (lambda x: abs(x[0] - at), half),
        (lambda x: -np.exp(-(((x[0] - at) / half) ** 2)), -np.exp(-1.0)),
    )
    function, lower = forms[random.integers(len(forms))]
    return dd.Constraint(function, lower=lower, name="wall"), half


@pytest.mark.solve
@pytest.mark.parametrize("seed", range(16))
def test_a_wall_between_start_and_goal_is_not_crossed_between_two_nodes(seed):
    random = np.random.default_rng(seed)
    constraint, half = wall(random)
    problem = dd.Problem(
        pushed(),
        x0=[0, 0],
        x_goal=[1, 0],
        num_steps=int(random.integers(8, 40)),
        horizon=1.0,
        running_cost=dd.QuadraticCost(R=[[0.5]]),
        constraints=constraint,
    )
    solution = dd.solve(problem, max_iterations=60, time_limit=10)
    assert not solution.success, (half, solution.message)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("method", ["ilqr", "shooting"])
def test_steps_do_not_jump_over_a_wall(method, seed):
    """Move 1 kg on a rail whose knots may lie on both sides of a wall that is thinner than a step."""
    constraint, half = wall(np.random.default_rng(100 + seed))
    effort = dd.QuadraticCost(R=[[0.5]])
    problem = dd.Problem(block(), x0=[0, 0], x_goal=[1, 0], num_steps=10, running_cost=effort, constraints=constraint)
    solution = dd.solve(problem, method=method, max_iterations=60, time_limit=10)
    assert not solution.success, (half, solution.message)


def test_what_is_kept_beside_a_disk_holds_between_the_nodes():
    """With 40 intervals the dense motion enters a disk of 0.2 m by less than a thousandth of its way."""
    point = dd.Dynamics(lambda x, u: [x[2], x[3], u[0], u[1]], nx=4, nu=2)
    disk = dd.Constraint(lambda x: (x[0] - 0.5) ** 2 + (x[1] - 0.01) ** 2, lower=0.04, name="disk")
    problem = dd.Problem(
        point,
        x0=[0, 0, 0, 0],
        x_goal=[1, 0, 0, 0],
        num_steps=40,
        horizon=1.0,
        running_cost=dd.QuadraticCost(R=np.eye(2)),
        constraints=disk,
    )
    solution = dd.solve(problem)
    assert solution.success, solution.message
    xs = solution.transcribed.at(np.linspace(0, 1, 4001))[0]
    assert np.min(np.hypot(xs[:, 0] - 0.5, xs[:, 1] - 0.01)) > 0.2 - 1e-3
    assert violation_between_nodes(solution.transcribed).worst <= 1


def at_rest(us=None, horizon=1.0, mesh=None):
    """Return the plan of x' = u, |u| <= 1, that stays at 0 for 20 intervals."""
    drift = dd.Dynamics(lambda x, u: [u[0]], nx=1, nu=1, u_lower=[-1], u_upper=[1])
    problem = dd.Problem(
        drift, x0=[0], num_steps=20, horizon=horizon, running_cost=dd.QuadraticCost(Q=[[1]], R=[[1]]), x_goal=[0]
    )
    mesh, us = np.linspace(0, 1, 21) if mesh is None else mesh, np.zeros((21, 1)) if us is None else us
    return collocated(problem, "hermite_simpson", np.zeros((21, 1)), us, None, horizon, mesh)


def test_a_plan_is_followed_under_feedback_as_in_closed_form():
    """x' = -3 x decays as exp(-3 t), to 1e-9 by Runge-Kutta steps of 5 ms. From -2 the input's bound gives -2 + t."""
    motion, gains = at_rest(), np.full((20, 1, 1), 3.0)
    times = np.linspace(0, 1, 201)
    led = motion.led_from(np.array([0.3]), gains)[:, 0]
    assert led == pytest.approx(0.3 * np.exp(-3 * times), abs=1e-9)
    assert motion.led_from(np.array([-2.0]), gains)[:, 0] == pytest.approx(-2 + times, abs=1e-12)
    assert motion.led_from(np.array([0.3]), None)[:, 0] == pytest.approx(0.3, abs=1e-15)


def narrow(random):
    """Return (f, its area, the speed at f): a bump of 0.1 to 10 mm on a motion from rest to rest, 0 to 1 m in 1 s."""
    width, at = 10 ** random.uniform(-4, -2), random.uniform(0.1, 0.9)
    time = np.roots([-2, 3, 0, -at])
    time = float(np.real(time[(np.real(time) > 0) & (np.real(time) < 1)][0]))
    height = random.choice([-1, 1]) * 0.5 / width
    if random.random() < 0.5:
        bump = lambda x: height * np.exp(-(((x - at) / width) ** 2))  # noqa: E731
        return bump, height * width * np.sqrt(np.pi), 6 * time * (1 - time)
    box = lambda x: height if abs(x - at) < width / 2 else 0.0  # noqa: E731
    return box, height * width, 6 * time * (1 - time)


@pytest.mark.solve
@pytest.mark.parametrize("seed", slow_after(1, range(8)))
def test_a_gust_between_two_nodes_is_seen(seed):
    """The input of the motion from rest to rest is 6 - 12 t. The gust's work changes the speed within one interval."""
    random = np.random.default_rng(seed)
    gust, work, speed = narrow(random)
    pushed = dd.Dynamics(lambda x, u: [x[1], u[0] + gust(x[0])], nx=2, nu=1)
    problem = dd.Problem(
        pushed, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=dd.QuadraticCost(R=[[1.0]]), horizon=1.0
    )
    t = np.linspace(0, 1, 21)
    xs, us = np.column_stack([3 * t**2 - 2 * t**3, 6 * t * (1 - t)]), (6 - 12 * t)[:, None]
    motion = collocated(problem, "hermite_simpson", xs, us, None, 1.0, t)
    expected = abs(np.sqrt(max(speed**2 + 2 * work, 0.0)) - speed)
    assert np.max(motion.gaps) > 0.02  # twice the tolerance of an interval
    if work > 0:
        assert np.max(motion.gaps[:, 1]) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("seed", slow_after(1, range(8)))
def test_a_peak_of_the_cost_between_two_nodes_counts(seed):
    random = np.random.default_rng(100 + seed)
    peak, area, speed = narrow(random)
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    problem = dd.Problem(
        block, x0=[0, 0], num_steps=20, running_cost=lambda x, u: u[0] ** 2 + 40 * peak(x[0]), horizon=1.0
    )
    t = np.linspace(0, 1, 21)
    xs, us = np.column_stack([3 * t**2 - 2 * t**3, 6 * t * (1 - t)]), (6 - 12 * t)[:, None]
    motion = collocated(problem, "hermite_simpson", xs, us, None, 1.0, t)
    assert motion.cost == pytest.approx(12 + 40 * area / speed, rel=0.03)


@pytest.mark.solve
@pytest.mark.parametrize("seed", range(4))
def test_a_constraint_that_is_broken_within_a_narrow_range_is_seen(seed):
    """Every path from 0 to 1 m passes the forbidden position, and every move from rest in 1 s the forbidden speed."""
    random = np.random.default_rng(seed)
    i, at, width = int(random.integers(2)), random.uniform(0.2, 0.8), 10 ** random.uniform(-4, -3)
    spike = dd.Constraint(lambda x: np.exp(-(((x[i] - at) / width) ** 2)), upper=0.5, name="spike")
    t = np.linspace(0, 1, 21)
    xs, us = np.column_stack([3 * t**2 - 2 * t**3, 6 * t * (1 - t)]), (6 - 12 * t)[:, None]
    effort = dd.QuadraticCost(R=[[1.0]])
    problem = dd.Problem(pushed(), x0=[0, 0], num_steps=20, running_cost=effort, constraints=spike, horizon=1.0)
    found = violation_between_nodes(collocated(problem, "hermite_simpson", xs, us, None, 1.0, t))
    assert found.constraint == pytest.approx(0.5, abs=0.1)
    assert found.worst > 1


@pytest.mark.solve
@pytest.mark.parametrize(
    ("what", "cost", "jump"),
    [
        ("by place", lambda x, u, t: u[0] ** 2 + (5.0 if x[0] > 0.4321 else 0.0), 5.0),
        ("by time", lambda x, u, t: u[0] ** 2 + (2.0 if t > 0.1234 else 0.0), 2.0),
        ("beside the way", lambda x, u, t: u[0] ** 2 + (3.0 if u[0] < -6.1 else 0.0), 3.0),
        ("a corner", lambda x, u, t: u[0] ** 2 + abs(x[1] - 1), 0.0),
        ("steep", lambda x, u, t: u[0] ** 2 + 1e-3 * np.tanh((x[0] - 0.4321) / 1e-3), 0.0),
    ],
)
def test_a_cost_that_jumps_is_reported(what, cost, jump):
    problem = dd.Problem(pushed(), x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=cost, horizon=1.0)
    solution = dd.solve(problem, options=dd.optimize.Options(refine=False))
    (row,) = (c for c in solution.checks if c.what == "jump")
    assert row.value == pytest.approx(jump, abs=1e-4)
    assert row.passes == (jump == 0.0) == solution.success, (what, solution.message)


@pytest.mark.slow
def test_a_cost_whose_derivatives_are_of_other_values_is_refused_or_reported():
    """Costs of 1 or 2 u^2, depending on the number type, everywhere or only away from the points that are probed."""
    everywhere = lambda x, u: u[0] ** 2 * (1 + (x.dtype != float))  # noqa: E731
    problem = dd.Problem(pushed(), x0=[0, 0], x_goal=[1, 0], num_steps=9, running_cost=everywhere, horizon=1.0)
    with pytest.raises(GradientError, match=r"running_cost is .* with AutoDiffXd and .* with floats"):
        dd.solve(problem)
    far = lambda x, u: u[0] ** 2 * (1 + (x.dtype != float and u[0] > 2))  # noqa: E731
    solution = dd.solve(dd.Problem(pushed(), x0=[0, 0], x_goal=[1, 0], num_steps=9, running_cost=far, horizon=1.0))
    assert not solution.success
    assert [c.what for c in solution.checks.failing if c.what == "traced"]

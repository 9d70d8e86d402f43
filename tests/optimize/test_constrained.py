"""Tests of waypoints and constraints with iLQR and shooting, against closed forms."""

import dataclasses

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block
from helpers.problems import DOUBLE_INTEGRATOR, lqr

import drake_diff as dd
from drake_diff.optimize.ilqr.constraints import AugmentedLagrangian

EFFORT = dd.QuadraticCost(R=[[1.0]])
METHODS = {
    "ilqr": {"method": "ilqr"},
    "shooting": {"method": "shooting"},
}
by_each_method = pytest.mark.parametrize("method", METHODS)


def solved(problem, method, **options):
    solution = dd.solve(problem, **METHODS[method], **options)
    assert solution.success, solution.message
    return solution


def move(count=20, **fields):
    """Return the problem of moving a block of 1 kg by 1 m in 1 s from rest to rest with the least effort."""
    fields = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": count, "running_cost": EFFORT, **fields}
    return dd.Problem(block(time_step=1 / count), **fields)


def double_integrator(count):
    """Return S (N+1, 2, N) with xs = S us, for symplectic Euler from rest at 0 over 1 s."""
    h = 1 / count
    S = np.zeros((count + 1, 2, count))
    for k in range(count):
        S[k + 1] = np.array([[1, h], [0, 1]]) @ S[k]
        S[k + 1, :, k] += [h**2, h]
    return S


def least_effort(count, rows, values):
    """Return us (N,) from the KKT system of min h sum u^2 subject to rows @ us = values."""
    n, m = count, len(rows)
    kkt = np.block([[2 / count * np.eye(n), rows.T], [rows, np.zeros((m, m))]])
    return np.linalg.solve(kkt, np.concatenate([np.zeros(n), values]))[:n]


@by_each_method
def test_a_waypoint_is_the_kkt_systems_solution(method):
    """The waypoint is 1.5 m at half the time, at any velocity. The solvers meet it to 1e-8, which 1 / h^2 magnifies."""
    count = 20
    S = double_integrator(count)
    us = least_effort(count, np.vstack([S[count], S[10, :1]]), np.array([1, 0, 1.5]))
    problem = move(count, waypoints={10: [1.5, np.nan]})
    solution = solved(problem, method)
    assert solution.us[:, 0] == pytest.approx(us, abs=1e-5)
    assert solution.cost == pytest.approx(us @ us / count, rel=1e-7)
    assert solution.xs[10, 0] == pytest.approx(1.5, abs=1e-7)


@pytest.mark.solve
@by_each_method
@pytest.mark.parametrize("unit", [1e3, 1e-3])
def test_the_unit_of_a_constraint_does_not_matter(method, unit):
    """Check the same velocity limit in mm/s and km/s, together with a goal in metres.

    IPOPT meets 1.2e-3 km/s to 1e-8, which is 1e-5 m/s. With a multiplier of 40 N this is 4e-4 of the cost 15.5.
    """
    plain = solved(move(constraints=dd.Constraint(lambda x: x[1], upper=1.2)), method)
    other = solved(move(constraints=dd.Constraint(lambda x: unit * x[1], upper=unit * 1.2)), method)
    assert other.cost == pytest.approx(plain.cost, rel=5e-5)
    if method == "ilqr":
        assert len(other.iterations) <= 1.5 * len(plain.iterations)


@pytest.mark.slow
@by_each_method
def test_a_force_and_a_power_are_limited(method):
    """Limit |u| to 5 N by a constraint on (x, u), and |u v| to 3.3 W. Without limits 6 N and 3.46 W are optimal."""
    power = dd.Constraint(lambda x, u: u[0] * x[1], lower=-3.3, upper=3.3, name="power")
    force = dd.Constraint(lambda x, u: u[0], lower=-5, upper=5, name="force")
    solution = solved(move(constraints=[power, force]), method)
    watts = solution.us[:, 0] * solution.xs[:-1, 1]
    assert np.abs(watts).max() == pytest.approx(3.3, abs=1e-6)
    assert np.abs(solution.us).max() == pytest.approx(5, abs=1e-6)
    free = solved(move(), method)
    assert np.abs(free.us[:, 0] * free.xs[:-1, 1]).max() > 3.3
    assert solution.cost > free.cost
    bounded = solved(move(constraints=power, bounds=dd.Bounds(u_lower=[-5], u_upper=[5])), method)
    assert solution.cost == pytest.approx(bounded.cost, rel=1e-6)


@pytest.mark.solve
@by_each_method
def test_a_pendulums_tip_reaches_a_height(method):
    """At rest 0.3 m below the hinge, cos q = 0.6."""
    height = dd.Constraint(lambda x: -0.5 * np.cos(x[0]), lower=-0.3, upper=-0.3, knots=-1, name="height")
    stop = dd.Constraint(lambda x: x[1], lower=0, upper=0, knots=-1)
    problem = dd.Problem(
        dd.load_model(MODELS / "pendulum.urdf", time_step=0.02),
        x0=[0, 0],
        num_steps=40,
        running_cost=EFFORT,
        constraints=[height, stop],
    )
    us = np.full((40, 1), 0.5)
    solution = solved(problem, method, initial_guess=(dd.rollout(problem.model, [0, 0], us).xs, us))
    assert np.abs(solution.xs[-1, 0]) == pytest.approx(np.arccos(0.6), abs=1e-6)
    goal = dd.Problem(problem.model, x0=[0, 0], num_steps=40, running_cost=EFFORT, x_goal=solution.xs[-1].round(7))
    assert solution.cost == pytest.approx(dd.solve(goal, method="ilqr").cost, rel=1e-6)


@pytest.mark.solve
@by_each_method
def test_a_point_goes_around_a_disc(method):
    """From (-1, 0.1) to (1, 0) the point passes above a disc of 0.5 m. It touches the disc and no knot is inside."""
    model = block(time_step=0.1, blocks=2, actuated=2)
    clear = dd.Constraint(lambda x: x[0] ** 2 + x[1] ** 2, lower=0.25, name="disc")
    problem = dd.Problem(
        model,
        x0=[-1, 0.1, 0, 0],
        x_goal=[1, 0, 0, 0],
        num_steps=20,
        running_cost=dd.QuadraticCost(R=np.eye(2)),
        constraints=clear,
    )
    t = np.linspace(0, 2, 21)[:, None]
    us = np.hstack([1.5 - 1.5 * t, np.cos(np.pi * t / 2)])[:-1]  # straight ahead and up
    solution = solved(problem, method, initial_guess=(dd.rollout(model, problem.x0, us).xs, us))
    distance = np.linalg.norm(solution.xs[:, :2], axis=1)
    assert distance.min() == pytest.approx(0.5, abs=1e-6)
    assert solution.xs[np.argmin(distance), 1] > 0
    assert solution.cost == pytest.approx(solved(problem, "ilqr", initial_guess=solution).cost, rel=1e-6)


def test_a_constraint_that_never_acts_leaves_one_full_step():
    """Check that J* = 12.948481280713864 is found in one step, as without the constraint."""
    never = dd.Constraint(lambda x, u: u[0] + x[0], upper=1e6)
    solution = dd.solve(lqr(*DOUBLE_INTEGRATOR, constraints=never), method="ilqr")
    assert solution.success, solution.message
    assert len(solution.iterations) == 2
    assert solution.cost == pytest.approx(12.948481280713864, rel=1e-12)
    assert not AugmentedLagrangian(lqr(*DOUBLE_INTEGRATOR)).any


@pytest.mark.parametrize("free", [False, True])
def test_the_augmented_lagrangians_derivatives_are_differences(free):
    """Every row is active or an equality, so that the value is smooth. Gauss-Newton is exact for linear rows."""
    random = np.random.default_rng(0)
    fields = {"optimize": ("controls", "initial_state")} if free else {}
    constraints = [
        dd.Constraint(lambda x, u: [x[0] + 3 * u[0], x[1] - u[0]], lower=[9, -np.inf], upper=[np.inf, -9]),
        dd.Constraint(lambda x: np.sin(x[0]) * x[1], lower=5, knots=[3, -1]),
    ]
    problem = move(6, waypoints={2: [1, np.nan]}, constraints=constraints, **fields)
    rows = AugmentedLagrangian(problem)
    xs, us = random.standard_normal((7, 2)), random.standard_normal((6, 1))
    rows.start(xs, us, 10.0, 0.0)
    rows.update(xs, us)
    gradients, hessians = rows.differentiate(xs, us)
    z = np.concatenate([xs.ravel(), us.ravel()])

    def value(z):
        return rows.value(z[:14].reshape(7, 2), z[14:].reshape(6, 1))

    slopes = [(value(z + d) - value(z - d)) / 2e-6 for d in 1e-6 * np.eye(20)]
    ours = np.concatenate([gradients[:, :2].ravel(), gradients[:-1, 2]])
    assert ours == pytest.approx(np.array(slopes), rel=1e-6, abs=1e-6)
    assert np.all(np.linalg.eigvalsh(hessians) > -1e-9)


@pytest.mark.solve
@pytest.mark.parametrize("knot", [3, 10, 20])
def test_a_motion_that_breaks_a_constraint_is_told(knot):
    """Check v <= 1.2 with one velocity set to 1.3, and a waypoint moved by a thousandth."""
    problem = move(constraints=dd.Constraint(lambda x: x[1], upper=1.2, name="speed"), waypoints={10: [0.5, np.nan]})
    solution = solved(problem, "ilqr")
    assert not solution.plan_checks.failing
    xs = np.array(solution.xs)
    xs[knot, 1], xs[10, 0] = 1.3, xs[10, 0] + 1e-3
    failing = dataclasses.replace(solution, xs=xs).plan_checks.failing
    broken = {c.where: c.value for c in failing if c.what == "constraint"}
    assert broken[f"speed at knot {knot}"] == pytest.approx(0.1)
    assert broken["waypoint at knot 10 at knot 10"] == pytest.approx(0.001, rel=1e-3)

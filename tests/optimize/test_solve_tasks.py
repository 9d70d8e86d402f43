"""Tests of common tasks against closed forms: minimum time, path constraints, and limits."""

import math

import numpy as np
import pytest

import drake_diff as dd
from drake_diff.derivatives.smooth_step import SmoothStep
from drake_diff.optimize import Options

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])
SCHEMES = ("hermite_simpson", "trapezoid", "drake")


@pytest.mark.parametrize("scheme", SCHEMES)
def test_minimum_time_is_bang_bang(write_urdf, scheme):
    """From rest, with D = 1, |u| <= 1, m = 1: T = 2 sqrt(D) = 2 and u = +1, then -1. A node is at the switch."""
    problem = dd.Problem(
        write_urdf(time_step=0.1),
        x0=[-1, 0],
        x_goal=[0, 0],
        num_steps=20,
        running_cost=1.0,
        horizon=(0.5, 8.0),
        bounds=dd.Bounds(u_lower=[-1], u_upper=[1]),
    )
    solution = dd.solve(problem, method="collocation", options=Options(scheme=scheme))
    # The input jumps in the middle, where all schemes are continuous, so that O(h^2) of the distance is lost.
    assert 2.0 < solution.horizon < 2.01, solution.message
    assert solution.cost == pytest.approx(solution.horizon, rel=1e-12)
    assert solution.times[-1] == pytest.approx(solution.horizon, rel=1e-12)
    assert solution.us[:9, 0] == pytest.approx(np.ones(9), abs=1e-4)
    assert solution.us[12:, 0] == pytest.approx(-np.ones(8), abs=1e-4)


def test_auto_takes_collocation_where_the_horizon_is_free(load):
    """More time never costs more, so that the optimum of a free horizon costs at most that of its upper end."""
    model = load("pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=60, running_cost=EFFORT, horizon=(0.5, 2.0))
    solution = dd.solve(problem)
    assert solution.method == "collocation"
    assert solution.options["method_reason"] == "the horizon is free"
    assert solution.success, solution.message
    assert 0.5 <= solution.horizon <= 2.0 + 1e-6  # IPOPT satisfies a bound to its tolerance
    fixed = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=60, running_cost=EFFORT, horizon=(2.0, 2.0))
    assert solution.cost <= dd.solve(fixed).cost + 1e-6


@pytest.mark.parametrize(("count", "holds"), [(4, False), (40, True)])
def test_what_a_constraint_is_exceeded_by_between_the_nodes_is_in_the_record(write_urdf, tmp_path, count, holds):
    """v <= 1.25 over 1 m in 1 s is reached at 0.3 s, which is between nodes of one mesh and at a node of the other."""
    problem = dd.Problem(
        write_urdf(time_step=1 / count),
        x0=[0, 0],
        x_goal=[1, 0],
        num_steps=count,
        running_cost=EFFORT,
        constraints=dd.Constraint(lambda x: x[1], upper=1.25, name="slow"),
    )
    solution = dd.solve(problem, method="collocation", options=Options(scheme="hermite_simpson", refine=False))
    record = dd.save(solution, tmp_path / f"run{count}")
    metrics = {m.name: m for m in record.metrics}
    beyond = solution.transcribed.at(np.linspace(0, 1, 5001))[0][:, 1].max() - 1.25
    assert metrics["constraint excess between nodes"].value == pytest.approx(beyond, rel=0.05, abs=1e-7)
    assert metrics["excess between nodes"].verdict == ("pass" if holds else "fail")
    assert solution.success is holds
    assert metrics["state excess between nodes"].value == 0
    assert metrics["input excess between nodes"].value == 0


@pytest.mark.parametrize("method", ["shooting", "ilqr"])
@pytest.mark.parametrize("limit", [2.0, 0.03])
def test_a_plan_at_the_limits_of_its_motor_is_verified(write_urdf, method, limit):
    """The inputs of least effort reach 6 d / T^2, and limits need at least 4 d / T^2, so that 4.5 d / T^2 is active."""
    count, h = 30, 0.04
    distance = limit * (count * h) ** 2 / 4.5
    model = write_urdf(limit=limit, time_step=h)
    effort = dd.QuadraticCost(R=np.eye(1) / limit**2)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[distance, 0], num_steps=count, running_cost=effort)
    solution = dd.solve(problem, method=method)
    assert solution.success, solution.message
    np.testing.assert_allclose(np.abs(solution.us[[0, -1], 0]), limit, rtol=1e-9)
    assert solution.us.max() <= limit
    told = [certificate.told for certificate in solution.certificates[-5:]]
    assert "certified beside the limit of its effort" in told[0]
    assert "certified beside the limit of its effort" in told[-1]


def test_a_plan_whose_derivative_is_wrong_exactly_at_the_limit_is_not_verified(write_urdf, monkeypatch):
    """The derivative is wrong at the limit only, where no difference is taken."""
    force = SmoothStep.force_of
    monkeypatch.setattr(
        SmoothStep,
        "force_of",
        lambda self, q, v, us: (force(self, q, v, us)[0], np.abs(us) >= self.limit),
    )
    model = write_urdf(limit=2.0, time_step=0.04)
    effort = dd.QuadraticCost(R=np.eye(1) / 4)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[0.64, 0], num_steps=30, running_cost=effort)
    solution = dd.solve(problem, method="ilqr")
    assert not solution.success
    assert "disagree" in {certificate.verdict for certificate in solution.certificates}


def test_a_bead_takes_the_cycloid_though_its_first_time_is_far_off():
    """r (a - sin a) = 2.28, r (1 - cos a) = 2.017 in a sqrt(r / g). A search once found a path of twice the time."""
    a = 2.5
    for _ in range(50):  # Newton's method on the quotient of both
        value, slope = (2.28 * (1 - math.cos(a)) - 2.017 * (a - math.sin(a)) for a in (a, a + 1e-6))
        a -= 1e-6 * value / (slope - value)
    least = a * math.sqrt(2.017 / (1 - math.cos(a)) / 9.81)

    def slides(x, u):
        return [x[2] * np.sin(u[0]), x[2] * np.cos(u[0]), 9.81 * np.cos(u[0])]

    bead = dd.Dynamics(slides, 3, 1, u_lower=[0], u_upper=[np.pi])
    problem = dd.Problem(
        bead, x0=[0, 0, 0], x_goal=[2.28, 2.017, math.nan], num_steps=40, running_cost=1.0, horizon=(0.05, 10)
    )
    solution = dd.solve(problem)
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(least, rel=1e-6)

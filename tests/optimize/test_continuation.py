"""Tests of continuation from an initial guess without contact: the stages, and the result on the true plant."""

import math

import numpy as np
import pytest
from helpers.problems import FREE, push
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.optimize import Options
from drake_diff.optimize.continuation import default_schedule
from drake_diff.optimize.solution import Status

pytestmark = pytest.mark.solve


def test_a_push_from_a_distance_arrives_and_keeps_momentum(two_spheres):
    """Without damping the momentum of both bodies is the motor's impulse, the sum of h u, on Drake's own plant.

    SAP solves impulses to 1e-6 of the largest but applies each to both bodies, so that only rounding is left.
    """
    problem = push(two_spheres(damping=0), gap=0.4, goal=1.0)
    solution = dd.solve(problem, options=Options(continuation="auto"), max_iterations=100)
    assert solution.success, solution.message
    end = solution.replay.xs[-1]
    assert end[1] == pytest.approx(1.0, abs=1e-8)
    assert 1.0 * end[2] + 0.5 * end[3] == pytest.approx(0.02 * solution.us.sum(), rel=1e-10)
    assert solution.replay.penetration[0] == 0 < solution.replay.penetration.max()
    assert solution.method == "ilqr"


def test_auto_finds_contact_that_its_guess_does_not_make(two_spheres):
    solution = dd.solve(push(two_spheres(damping=0), gap=0.4, goal=1.0), max_iterations=100)
    assert solution.success, solution.message
    assert [link["ended"] for link in solution.options["chain"]] == ["no_gradient", "converged"]
    assert solution.options["chain"][1]["reason"] == "the guess has no gradient"


def test_before_touching_the_push_is_the_closed_form_of_least_effort(two_spheres):
    """The pusher alone is a double integrator, so that its least effort until contact is linear in time."""
    solution = dd.solve(
        push(two_spheres(damping=0), gap=0.4, goal=1.0), options=Options(continuation="auto"), max_iterations=100
    )
    first = next(k for k, contacts in enumerate(solution.replay.contacts) if contacts)
    bend = np.diff(solution.us[:first, 0], 2)
    assert first > 10
    assert np.abs(bend).max() < 1e-4 * np.abs(solution.us).max()  # the gradient is 0 to 1e-8 of the cost's scale


def test_a_soft_final_cost_is_reached_too(two_spheres):
    problem = push(two_spheres(damping=0), gap=0.4, goal=1.0, x_goal=None, final_cost=lambda x: 10 * (x[1] - 1.0) ** 2)
    assert dd.solve(problem, method="ilqr").status is Status.NO_GRADIENT
    solution = dd.solve(problem, options=Options(continuation="auto"), max_iterations=100)
    assert solution.success, solution.message
    assert abs(solution.replay.xs[-1][1] - 1.0) < 1e-3  # the miss has the order of the ratio of effort to cost, 1e-4


def test_the_default_schedule_is_read_off_the_model(two_spheres):
    """L = 0.45, h = 0.02, N = 50 give L/3 and L/9, as L/27 < 4 L / 50. The reduced mass of 1 and 0.5 is 1/3."""
    stages = default_schedule(push(two_spheres(), gap=0.45, goal=1.0))
    assert [s.distance for s in stages] == pytest.approx([0.15, 0.05], rel=1e-12)
    nudge = 10 * 2 / 3 * 0.45 / 1.0**2 / (0.15 * math.log1p(math.exp(-3)))
    assert stages[0].stiffness == pytest.approx(min(nudge, 0.4 / 3 / 0.02**2), rel=1e-9)
    assert stages[1].stiffness == pytest.approx(0.4 / 3 / 0.02**2, rel=1e-9)


def test_blindness_names_what_stays_apart(two_spheres):
    """The pusher moves from 0.3 m to 0.12 m from the ball at the last knot, as h^2 u N (N + 1) / 2 = 0.18."""
    us = np.full((20, 1), 0.18 / (0.02**2 * 20 * 21 / 2))
    problem = push(two_spheres(), gap=0.3, goal=1.0, num_steps=20)
    xs = dd.rollout(problem.model, problem.x0, us).xs
    solution = dd.solve(problem, method="ilqr", initial_guess=(xs, us))
    assert solution.status is Status.NO_GRADIENT
    assert "at knots 0-20 nothing touches (pusher and ball stay 0.12 m apart or more, nearest at knot 20)" in (
        solution.message
    )
    assert 'continuation="auto"' in repr(solution)


def test_a_stage_that_is_refused_is_told_and_the_schedule_goes_on(two_spheres):
    """With h^2 k / m = 1e9 the ball's state diverges in the first stage."""
    problem = push(two_spheres(damping=0), gap=0.4, goal=1.0)
    given = [dd.model.SoftContact(1.0, 1e12), *default_schedule(problem)]
    solution = dd.solve(problem, options=Options(continuation=given), max_iterations=100)
    first, *rest = solution.options["continuation"]
    assert first["status"] != "solved"
    assert len(rest) == len(given)
    assert solution.success, solution.message


def test_the_time_limit_is_that_of_all_stages(two_spheres, monkeypatch):
    monkeypatch.setattr("drake_diff.optimize.run.GRACE", 1e6)  # otherwise the solve ends before the first stage
    solution = dd.solve(push(two_spheres(), gap=0.4, goal=1.0), options=Options(continuation="auto"), time_limit=0.05)
    assert solution.status is Status.TIME_LIMIT
    assert "in stage 1" in repr(solution)
    assert len(solution.options["continuation"]) == 1
    assert solution.defect == 0


@each_row("wrong", ["soft", 0.1, [], [0.1], (dd.model.SoftContact(0.1, 1.0), None)])
def test_a_schedule_that_is_none_is_refused(two_spheres, wrong):
    with pytest.raises(InputError, match="continuation"):
        dd.solve(push(two_spheres(), gap=0.4, goal=1.0), options=Options(continuation=wrong))


def test_only_ilqr_takes_a_continuation(two_spheres, load):
    with pytest.raises(InputError, match='an option of method="ilqr"'):
        dd.solve(push(two_spheres(), gap=0.4, goal=1.0), method="shooting", options=Options(continuation="auto"))
    pendulum = load("pendulum.urdf")
    with pytest.raises(InputError, match="may collide"):
        dd.solve(dd.Problem(pendulum, x0=[0, 0], num_steps=5, x_goal=[1, 0]), options=Options(continuation="auto"))


@pytest.mark.slow
@pytest.mark.parametrize("wanted", [[0.4, 0.1], [0.4, 0.1, 0.3]])
def test_a_box_is_pushed_to_its_goal(load, wanted):
    """The pusher starts 0.15 m away from the box. The goal is a position in the plane, with the yaw free or given."""
    goal = np.full(10, FREE)
    goal[: len(wanted)] = wanted
    problem = dd.Problem(
        load("box_push.sdf", time_step=0.02),
        x0=[0, 0, 0, -0.35, -0.05, 0, 0, 0, 0, 0],
        num_steps=60,
        running_cost=dd.QuadraticCost(Q=np.zeros((10, 10)), R=1e-3 * np.eye(2)),
        x_goal=goal,
    )
    solution = dd.solve(problem)
    assert solution.success, solution.message
    assert solution.options["chain"][0]["ended"] == "no_gradient"
    replay = solution.replay
    assert replay.xs[-1][: len(wanted)] == pytest.approx(wanted, abs=1e-7)
    assert not replay.contacts[0]
    assert any(replay.contacts)

"""Tasks from end to end: a tip, a hand, a contact force, written with task quantities."""

import numpy as np
import pytest
from helpers.derivatives import differentiate
from helpers.models import MODELS, ur5
from helpers.plants import box_on_the_ground

import drake_diff as dd

pytestmark = pytest.mark.solve

FAR = dd.Bounds(np.full(12, -50), np.full(12, 50))  # the URDF's limits of speed would act
METHODS = (
    {"method": "ilqr"},
    {"method": "shooting"},
)
by_each_method = pytest.mark.parametrize("method", METHODS, ids=["ilqr", "shooting"])


def reach(model, point, target, x0, count, axes, **fields):
    """Rest to rest, `point` = (frame, offset) at `target` at the end."""
    tip = dd.quantities.frame_position(model, *point)
    at_target = dd.Constraint(lambda x: (tip(x) - target)[axes], lower=0, upper=0, knots=-1, name="tip")
    stop = dd.Constraint(lambda x: x[model.nq :], lower=0, upper=0, knots=-1, name="rest")
    effort = dd.QuadraticCost(R=np.eye(model.nu))
    problem = dd.Problem(model, x0=x0, num_steps=count, running_cost=effort, constraints=[at_target, stop], **fields)
    return tip, problem


@by_each_method
def test_a_double_pendulums_tip_reaches_a_point(method):
    """One elbow or the other: inverse kinematics by hand give both; the cost is no more than that goal's own."""
    model, target = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.02), np.array([0.3, 0, -1.1])
    tip, problem = reach(model, ("lower", [0, 0, -0.5]), target, np.zeros(4), 50, [0, 2])
    solution = dd.solve(problem, **method)
    assert solution.success, solution.message
    assert tip(solution.xs[-1]) == pytest.approx(target, abs=1e-6)
    elbow = np.arccos((target @ target - 0.8**2 - 0.5**2) / (2 * 0.8 * 0.5))
    assert abs(solution.xs[-1, 1]) == pytest.approx(elbow, abs=1e-5)
    goal = dd.Problem(model, x0=np.zeros(4), num_steps=50, running_cost=problem.running_cost, x_goal=solution.xs[-1])
    again = dd.solve(goal, method="ilqr", initial_guess=solution)
    assert solution.cost == pytest.approx(again.cost, rel=1e-5)


@pytest.mark.slow
def test_a_ur5s_hand_reaches_a_point_by_shooting():
    """Six joints for three coordinates: where it ends is the cheapest of many postures.

    There what a joint angle would be worth, y_q of 2 h u_k + (d x_N / d u_k)' y = 0, is what the hand's place is.
    """
    model, x0 = ur5(), np.array([0, -1.2, 1.5, -1.0, -1.5, 0, 0, 0, 0, 0, 0, 0.0])
    target = dd.quantities.frame_position(model, "tool0")(x0) + np.array([0.1, 0.2, 0.15])
    tip, problem = reach(model, ("tool0",), target, x0, 25, [0, 1, 2], bounds=FAR)
    solution = dd.solve(problem, method="shooting")
    assert solution.success, solution.message
    assert tip(solution.xs[-1]) == pytest.approx(target, abs=1e-6)
    jacobian = differentiate(tip, solution.xs[-1])[1][:, :6]
    multipliers = _final_multipliers(model, solution)[:6]
    coefficients = np.linalg.lstsq(jacobian.T, multipliers, rcond=None)[0]
    assert np.linalg.norm(multipliers) > 1
    assert jacobian.T @ coefficients == pytest.approx(multipliers, abs=1e-4 * np.linalg.norm(multipliers))


def _final_multipliers(model, solution):
    """(nx,) y with 2 h u_k + (d x_N / d u_k)' y = 0 for all k, by least squares."""
    S, rows = np.eye(model.nx), []
    for x, u in zip(solution.xs[-2::-1], solution.us[::-1], strict=True):
        d = dd.differentiate_step(model, x, u)
        rows.append(S @ d.B)
        S = S @ d.A
    sensitivity = np.hstack(rows)  # the last input first
    wanted = -2 * model.time_step * solution.us[::-1].ravel()
    return np.linalg.lstsq(sensitivity.T, wanted, rcond=None)[0]


@pytest.mark.slow
@by_each_method
def test_a_box_is_pressed_as_deep_as_a_contact_force_allows(method):
    """F_k = k (d_k + (h + tau) w_(k+1)) with d_(k+1) = d_k + h w_(k+1), of SAP's linear law, k = 4e4 N/m, tau = 0.2 s.

    Deepest is F = 30 N in each step: d_N = F / k - (F - m g) / k * (tau / (h + tau))^N.
    """
    model, count, k, limit, weight = box_on_the_ground(pusher=True), 12, 4e4, 30.0, 2 * 9.81
    force, x0 = dd.quantities.contact_force(model, "box"), np.array([0.1 - weight / k, 0])
    problem = dd.Problem(
        model,
        x0=x0,
        num_steps=count,
        running_cost=dd.QuadraticCost(R=[[1e-3]]),
        final_cost=lambda x: 1e6 * x[0],
        constraints=dd.Constraint(lambda x, u: force(x, u)[2], upper=limit, name="contact force"),
    )
    us = np.full((count, 1), -1.0)
    solution = dd.solve(problem, **method, initial_guess=(dd.rollout(model, x0, us).xs, us))
    assert solution.success, solution.message
    deepest = limit / k - (limit - weight) / k / 1.05**count
    assert 0.1 - solution.xs[-1, 0] == pytest.approx(deepest, rel=1e-6)
    forces = [force(x, u)[2] for x, u in zip(solution.xs, solution.us, strict=False)]
    assert forces == pytest.approx([limit] * count, rel=1e-6)


def test_a_constraint_of_a_force_where_nothing_touches_has_a_derivative_of_zero():
    model = box_on_the_ground(pusher=True)
    force = dd.quantities.contact_force(model, "box")
    limit = dd.Constraint(lambda x, u: force(x, u)[2], upper=30.0)
    values, rows = limit.differentiate(np.array([0.5, 0.0]), np.zeros(1))
    assert values.tolist() == [0.0]
    assert rows.tolist() == [[0.0, 0.0, 0.0]]

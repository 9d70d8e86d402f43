"""Tests of tasks with a contact force, which is limited by a constraint on a task quantity."""

import numpy as np
import pytest
from helpers.plants import box_on_the_ground

import drake_diff as dd

pytestmark = pytest.mark.solve

METHODS = (
    {"method": "ilqr"},
    {"method": "shooting"},
)
by_each_method = pytest.mark.parametrize("method", METHODS, ids=["ilqr", "shooting"])


@pytest.mark.slow
@by_each_method
def test_a_box_is_pressed_as_deep_as_a_contact_force_allows(method):
    """SAP's linear law is F_k = k (d_k + (h + tau) w_(k+1)), d_(k+1) = d_k + h w_(k+1), k = 4e4 N/m, tau = 0.2 s.

    F = 30 N in each step gives the largest depth: d_N = F / k - (F - m g) / k * (tau / (h + tau))^N.
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
    exact = {} if method["method"] == "ilqr" else {"options": dd.optimize.Options(tolerance=1e-10)}
    solution = dd.solve(problem, **method, **exact, initial_guess=(dd.rollout(model, x0, us).xs, us))
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

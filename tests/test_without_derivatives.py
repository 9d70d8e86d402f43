"""A search by values alone, at a given price in simulated steps."""

import numpy as np
import pytest
from helpers.plants import block

import drake_diff as dd
from drake_diff.exceptions import InputError


def asked(**more):
    limits = dd.Bounds(u_lower=[-20], u_upper=[20])
    given = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 20, "bounds": limits}
    return dd.Problem(block(mass=1.5, time_step=0.1), **given | {"running_cost": dd.QuadraticCost(R=[[1.0]])} | more)


def test_it_finds_the_least_effort_within_its_price():
    """Steps are v_N = h/m sum u_k and x_N = h^2/m sum (N - k) u_k: effort and price are least squares of the inputs.

    Their best is a line in time, which two knots have; 1 % is what is left of the search. What it simulates is the
    budget, and less than one generation of ten rollouts, the result's own rollout and its measures more.
    """
    m, h, n, price = 1.5, 0.1, 20, 100.0
    ends = np.array([h**2 / m * (n - np.arange(n)), np.full(n, h / m)])
    rows, wanted = np.vstack([np.sqrt(h) * np.eye(n), np.sqrt(price) * ends]), np.append(np.zeros(n + 1), 0.0)
    wanted[n] = np.sqrt(price)  # to x = 1 and v = 0
    best = np.linalg.lstsq(rows, wanted)[1][0]
    with dd.model.count_steps() as count:
        found = dd.studies.without_derivatives(asked(), 8000, knots=2, price=price)
        searched = count.steps
    total = found.cost + price * np.sum((found.xs[-1] - [1, 0]) ** 2)
    assert best * (1 - 1e-9) <= total <= 1.01 * best
    assert 8000 <= searched < 8000 + 12 * n
    assert not found.success  # a price alone does not reach a goal
    assert "goal error" in found.message


def test_what_it_cannot_draw_from_is_refused():
    with pytest.raises(InputError, match="lower and upper ones of all"):
        dd.studies.without_derivatives(asked(bounds=None), 100)
    with pytest.raises(InputError, match="got a horizon"):
        dd.studies.without_derivatives(asked(horizon=2.0), 100)
    with pytest.raises(InputError, match="steps"):
        dd.studies.without_derivatives(asked(), 0)

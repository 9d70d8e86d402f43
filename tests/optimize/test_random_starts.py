"""Swing-ups from random states: nearly all verified, and none said to be right that is not.

The referee is the textbook's equations written out here, integrated between the knots; it knows nothing of Drake.
"""

import numpy as np
import pytest
from helpers.models import MODELS

import drake_diff as dd

EFFORT = dd.QuadraticCost(R=[[1.0]])
COUNT, H = 100, 0.02
TRIALS = {"pendulum.urdf": 100, "cart_pole.urdf": 40}  # of a hundred, one may fail


def pendulum(x, u):
    """m = 1, l = 0.5, b = 0.1, g = 9.81."""
    q, v = x.T
    return np.column_stack([v, (u[:, 0] - 0.1 * v - 9.81 * 0.5 * np.sin(q)) / 0.25])


def cart_pole(x, u):
    """Kelly 2017, eq. 6.1 and 6.2: m1 = 1, m2 = 0.3, l = 0.5, g = 9.81."""
    _, q, v, w = x.T
    s, c, f = np.sin(q), np.cos(q), u[:, 0]
    cart = (0.5 * 0.3 * s * w**2 + f + 0.3 * 9.81 * c * s) / (1 + 0.3 * s**2)
    pole = -(0.5 * 0.3 * c * s * w**2 + f * c + 1.3 * 9.81 * s) / (0.5 + 0.5 * 0.3 * s**2)
    return np.column_stack([v, w, cart, pole])


CASES = {
    "pendulum.urdf": (pendulum, [np.pi, 0], [np.pi, 3], dd.Bounds(u_lower=[-6], u_upper=[6])),
    "cart_pole.urdf": (cart_pole, [0, np.pi, 0, 0], [1, np.pi, 1, 3], None),
}


def misses(solution, rates):
    """(N,) how far each knot is from where the referee's equations lead from the one before, 20 RK4 steps each."""
    u0, um, u1 = solution.us, solution.us_mid, np.vstack([solution.us[1:], solution.u_final])

    def f(x, s):  # the parabola through the three inputs
        return rates(x, u0 * (1 - s) * (1 - 2 * s) + um * 4 * s * (1 - s) + u1 * s * (2 * s - 1))

    x, dt = np.array(solution.xs[:-1]), H / 20
    for s in np.arange(20) / 20:
        k1 = f(x, s)
        k2 = f(x + dt / 2 * k1, s + 1 / 40)
        k3 = f(x + dt / 2 * k2, s + 1 / 40)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + dt * k3, s + 1 / 20))
    return np.abs(x - solution.xs[1:]).max(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_swing_ups_from_random_states(name):
    rates, goal, spread, bounds = CASES[name]
    model, random = dd.load_model(MODELS / name, time_step=H), np.random.default_rng(2026)
    verified = []
    for _ in range(TRIALS[name]):
        x0 = random.uniform(-1, 1, model.nx) * spread
        problem = dd.Problem(model, x0=x0, x_goal=goal, num_steps=COUNT, running_cost=EFFORT, bounds=bounds)
        solution = dd.solve(problem, max_iterations=200)
        verified.append(solution.success)
        if solution.success and solution.method == "collocation":
            assert misses(solution, rates).max() < 1e-2  # what `Solution` allows between knots
            assert np.abs(solution.xs[0] - x0).max() < 1e-7
            assert np.abs(solution.xs[-1] - goal).max() < 1e-5
            b = problem.bounds
            assert np.all((solution.us >= b.u_lower - 1e-5) & (solution.us <= b.u_upper + 1e-5))
            assert np.all((solution.xs[1:] >= b.x_lower - 1e-5) & (solution.xs[1:] <= b.x_upper + 1e-5))
    assert sum(verified) >= TRIALS[name] - TRIALS[name] // 100, f"not verified: {np.flatnonzero(~np.array(verified))}"

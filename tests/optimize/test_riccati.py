"""Tests of the Riccati recursion against a problem by hand, and the whole problem as one linear system."""

import numpy as np
import pytest
from helpers.table import each_row

from drake_diff.optimize.ilqr.riccati import LinearQuadratic, follow, slope_along, solve_riccati


def problem(seed=0, count=6, n=3, m=2, *, gaps=1.0, free=0.0, bound=np.inf):
    """Return a random convex problem with x_0 within +-`free` and inputs within +-`bound`."""
    random = np.random.default_rng(seed)
    roots = random.standard_normal((count + 1, n + m, n + m))
    gradients, hessians = random.standard_normal((count + 1, n + m)), roots @ roots.swapaxes(1, 2) + 0.1 * np.eye(n + m)
    gradients[-1, n:], hessians[-1, n:], hessians[-1, :, n:] = 0.0, 0.0, 0.0
    return LinearQuadratic(
        F=random.standard_normal((count, n, n + m)) / np.sqrt(n),
        gaps=gaps * random.standard_normal((count, n)),
        gradients=gradients,
        hessians=hessians,
        lower=np.full((count, m), -bound),
        upper=np.full((count, m), bound),
        start_lower=np.full(n, -free),
        start_upper=np.full(n, free),
    )


def minimum(p):
    """Return (dxs (N+1, n), dus (N, m)) from the optimality conditions of the whole problem as one linear system."""
    n, (count, m) = p.num_states, p.lower.shape
    moves = p.start_lower < p.start_upper
    xs = np.arange((count + 1) * n).reshape(-1, n)
    us = xs.size + np.arange(count * m).reshape(-1, m)
    size = xs.size + us.size
    H, g = np.zeros((size, size)), np.zeros(size)
    C, c = np.zeros((count * n + n, size)), np.zeros(count * n + n)
    for k in range(count):
        z = np.concatenate([xs[k], us[k]])
        H[np.ix_(z, z)] += p.hessians[k]
        g[z] += p.gradients[k]
        rows = slice(k * n, (k + 1) * n)
        C[rows, xs[k + 1]], C[rows, z], c[rows] = np.eye(n), -p.F[k], p.gaps[k]
    H[np.ix_(xs[-1], xs[-1])] += p.final_hessian
    g[xs[-1]] += p.final_gradient
    C[count * n :, xs[0]] = np.eye(n)
    held = np.append(np.ones(count * n, dtype=bool), ~moves)
    C, c = C[held], c[held]
    whole = np.block([[H, C.T], [C, np.zeros((len(C), len(C)))]])
    found = np.linalg.solve(whole, np.concatenate([-g, c]))
    return found[xs], found[us]


def followed(p, policy, start):
    """Return (dxs, dus) under the policy's feedback."""
    xs, us = [start], []
    for k in range(len(p.F)):
        us.append(policy.feedforward[k] + policy.feedback[k] @ xs[-1])
        xs.append(p.F[k] @ np.concatenate([xs[-1], us[-1]]) + p.gaps[k])
    return np.array(xs), np.array(us)


def value(p, xs, us):
    zs = np.hstack([xs[:-1], us])
    own = np.sum(p.gradients[:-1] * zs) + np.einsum("ki,kij,kj->", zs, p.hessians[:-1], zs) / 2
    return own + p.final_gradient @ xs[-1] + xs[-1] @ p.final_hessian @ xs[-1] / 2


def one_step(bound=np.inf):
    """Return x' = x + u with the cost x^2/2 + 3 u + u^2/2 + 2 x' + x'^2/2."""
    one = np.ones((1, 1))
    return LinearQuadratic(
        F=np.ones((1, 1, 2)),
        gaps=0 * one,
        gradients=np.array([[0.0, 3.0], [2.0, 0.0]]),
        hessians=np.array([np.eye(2), np.diag([1.0, 0.0])]),
        lower=-bound * one,
        upper=bound * one,
        start_lower=np.zeros(1),
        start_upper=np.zeros(1),
    )


@pytest.mark.parametrize(
    ("bound", "regularization", "u", "K", "s", "P", "slope", "curvature", "gradient"),
    [
        (np.inf, 0.0, -2.5, -0.5, -0.5, 1.5, -12.5, 12.5, 5.0),  # 5 + x + 2 u = 0; s = 2 + u, P = 2 - 2/4
        (np.inf, 1.0, -1.25, -0.25, -0.5 + 1.25 / 2, 2 - 0.5 + 2 / 16, -6.25, 3.125, 5.0),  # 5 + x + (1 + 1) 2 u = 0
        (1.0, 0.0, -1.0, 0.0, 1.0, 2.0, -5.0, 2.0, 0.0),  # on the bound for any x
    ],
)
def test_one_step_by_hand(bound, regularization, u, K, s, P, slope, curvature, gradient):
    """V = x^2 + 2 x + 5 w + x w + w^2 with w = u + K x, so that s = 2 + 5 K + u + 2 u K, P = 2 + 2 K + 2 K^2."""
    policy = solve_riccati(one_step(bound), regularization)
    assert (policy.feedforward[0, 0], policy.feedback[0, 0, 0]) == (u, K)
    assert (policy.value_gradients[0, 0], policy.value_hessians[0, 0, 0]) == (2 + 5 * K + u + 2 * u * K, P) == (s, P)
    assert (policy.slope, policy.curvature, policy.gradient) == (slope, curvature, gradient)
    assert policy.expected == -slope - curvature / 2


@each_row("seed", range(3))
@each_row("size", [(6, 3, 2), (20, 4, 1), (1, 2, 3), (9, 7, 4), (3, 1, 5)])
@each_row("free", [0.0, 1e6])
def test_the_policy_leads_to_the_minimum_of_the_whole_problem(seed, size, free):
    """The tolerance is 1e-9 of the largest entry, as 20 unstable steps magnify rounding."""
    p = problem(seed, *size, free=free)
    policy = solve_riccati(p, 0.0)
    for found, expected in zip(followed(p, policy, policy.start), minimum(p), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * max(1.0, np.abs(expected).max()))


@each_row("gaps", [0.0, 1.0])
@each_row("bound", [np.inf, 0.2])
@each_row("regularization", [0.0, 0.3])
def test_what_is_promised_is_what_following_the_policy_costs(gaps, bound, regularization):
    """The tolerance of 1e-10 allows for rounding in sums of a hundred terms of size 10."""
    p = problem(gaps=gaps, bound=bound)
    policy = solve_riccati(p, regularization)
    held = np.abs(policy.feedforward) == bound
    assert held.any() == np.isfinite(bound)
    assert not policy.feedback[held].any()
    still = value(p, *followed(p, policy, np.zeros(3)))
    dx = np.array([0.3, -0.2, 0.5])
    remains = policy.value_gradients[0] @ dx + dx @ policy.value_hessians[0] @ dx / 2
    assert value(p, *followed(p, policy, dx)) - still == pytest.approx(remains, abs=1e-10)
    slope, curvature = slope_along(p, *follow(p, policy))
    assert slope + curvature / 2 == pytest.approx(still, abs=1e-10)
    if not gaps:
        assert -policy.expected == pytest.approx(still, abs=1e-10)
    if not gaps and not held.any() and not regularization:  # otherwise the sum is split differently
        assert (policy.slope, policy.curvature) == pytest.approx((slope, curvature), abs=1e-10)


@pytest.mark.parametrize("size", [(6, 3, 2), (6, 3, 1)])
def test_without_a_minimum_there_is_no_policy_until_it_is_regularized(size):
    p = problem(0, *size)
    n = p.num_states
    p.hessians[2, n:, n:] -= 100 * np.eye(size[2])
    assert solve_riccati(p, 0.0) is None
    assert solve_riccati(p, 1e3) is not None
    p.hessians[3, 0, 0] = np.nan
    assert solve_riccati(p, 1e3) is None

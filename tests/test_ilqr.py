"""iLQR against the Riccati recursion, its own quadratic case, and against what its optimum must satisfy."""

import signal

import numpy as np
import pytest
from test_solution import MODELS, block

import drake_diff as dd
from drake_diff.solution import Status

SOFT = {
    "running_cost": dd.QuadraticCost(Q=np.diag([0.1, 0.01]), R=[[0.1]], x_ref=[np.pi, 0]),
    "final_cost": dd.QuadraticCost(Q=np.diag([50, 5]), x_ref=[np.pi, 0]),
}


def lqr(h, count, Q, R, Qf, x0=(1, 0)):
    """The running cost is a rate: weights divided by h give sums without h."""
    return dd.Problem(
        block(time_step=h),
        x0=x0,
        num_steps=count,
        running_cost=dd.QuadraticCost(Q=np.array(Q) / h, R=[[R / h]]),
        final_cost=dd.QuadraticCost(Q=Qf),
    )


def riccati(h, count, Q, R, Qf):
    """(P0, gains K_0 ... K_N-1) of the double integrator as symplectic Euler steps it."""
    A, B = np.array([[1, h], [0, 1]]), np.array([[h**2], [h]])
    P, gains = np.array(Qf, dtype=float), []
    for _ in range(count):
        gains.append(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A))
        P = Q + A.T @ P @ (A - B @ gains[-1])
    return P, gains[::-1]


A30 = (0.1, 20, np.eye(2), 0.1, 10 * np.eye(2))
OTHERS = [
    A30,
    (0.05, 33, np.diag([3.0, 0.5]), 0.7, np.diag([2.0, 0.1])),
    (0.2, 7, np.array([[2.0, 0.5], [0.5, 1.0]]), 3.0, np.array([[4.0, -1.0], [-1.0, 9.0]])),
]


@pytest.mark.parametrize("case", OTHERS)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_one_step_from_any_guess_is_the_riccati_recursions_optimum(case, seed):
    """1e-12 relative: a sum of a few hundred rounded terms."""
    problem = lqr(*case, x0=(1.0, -0.5))
    us = 10 * np.random.default_rng(seed).standard_normal((case[1], 1))
    solution = dd.solve(problem, method="ilqr", initial_guess=(np.zeros((case[1] + 1, 2)), us))
    P, gains = riccati(*case)
    x0 = np.array([1.0, -0.5])
    assert solution.success, solution.message
    assert [row.iteration for row in solution.iterations] == [0, 1]
    assert solution.cost == pytest.approx(x0 @ P @ x0, rel=1e-12)
    for x, u, K in zip(solution.xs, solution.us, gains, strict=False):
        assert u == pytest.approx(-K @ x, abs=1e-10)


def test_the_oracles_digits():
    """A30: J* = 12.948481280713864, u_0 = -K_0 x_0 = -2.61821518."""
    solution = dd.solve(lqr(*A30), method="ilqr")
    assert solution.cost == pytest.approx(12.948481280713864, rel=1e-12)
    assert solution.us[0, 0] == pytest.approx(-2.61821518, abs=5e-9)  # half of the last digit given


@pytest.mark.parametrize("case", OTHERS)
def test_the_optimal_costs_gradient_by_the_initial_state_is_twice_p0_x0(case):
    """The inputs are optimal, so that only the direct effect of x0 counts."""
    _, _, Q, R, Qf = case
    problem = lqr(*case)
    us = dd.solve(problem, method="ilqr").us

    def loss(xs, us):
        return sum(x @ Q @ x + R * u @ u for x, u in zip(xs, us, strict=False)) + xs[-1] @ Qf @ xs[-1]

    gradient = dd.differentiate_rollout(problem.model, problem.x0, us, loss)
    assert gradient.x0 == pytest.approx(2 * riccati(*case)[0] @ [1, 0], rel=1e-10)
    assert np.abs(gradient.us).max() < 1e-10
    if case is A30:
        assert gradient.x0 == pytest.approx([25.89696256, 5.23643035], abs=5e-9)


def pendulum_gradient(us):
    """dJ/du (N, 1) of SOFT by the hand-made pendulum of A03: m = 1, l = 0.5, b = 0.1 implicit, h = 0.02."""
    h, g, length, b, inertia = 0.02, 9.81, 0.5, 0.1, 0.25
    s = 1 / (1 + h * b / inertia)
    xs = [np.zeros(2)]
    for u in us[:, 0]:
        q, w = xs[-1]
        w = s * (w + h * (-g / length * np.sin(q) + u / inertia))
        xs.append(np.array([q + h * w, w]))
    B = np.array([h**2 * s / inertia, h * s / inertia])
    slope = 2 * np.array([50, 5]) * (xs[-1] - [np.pi, 0])
    gradient = np.zeros_like(us)
    for k in reversed(range(len(us))):
        gradient[k] = 2 * h * 0.1 * us[k] + B @ slope
        c = h * s * g / length * np.cos(xs[k][0])
        A = np.array([[1 - h * c, h * s], [-c, s]])
        slope = 2 * h * np.array([0.1, 0.01]) * (xs[k] - [np.pi, 0]) + A.T @ slope
    return gradient


def pendulum(**changes):
    fields = {"x0": [0, 0], "num_steps": 100, **SOFT, **changes}
    return dd.Problem(dd.load_model(MODELS / "pendulum.urdf", time_step=0.02), **fields)


def test_a_swing_up_without_bounds_leaves_no_slope():
    solution = dd.solve(pendulum(), method="ilqr")
    assert solution.success, solution.message
    assert np.abs(pendulum_gradient(solution.us)).max() < 1e-6


def test_a_swing_up_within_bounds_meets_them_and_the_conditions_of_an_optimum():
    """Where |u| < 2.5 there is no slope; at a bound the cost pushes outwards. Shooting finds the same cost."""
    problem = pendulum(bounds=dd.Bounds(u_lower=[-2.5], u_upper=[2.5]))
    solution = dd.solve(problem, method="ilqr")
    assert solution.success, solution.message
    us, gradient = solution.us[:, 0], pendulum_gradient(solution.us)[:, 0]
    assert np.abs(us).max() == 2.5
    assert np.abs(gradient[np.abs(us) < 2.5]).max() < 1e-6
    assert np.all(gradient[us == 2.5] <= 0)
    assert np.all(gradient[us == -2.5] >= 0)
    shooting = dd.solve(problem, method="shooting", solver="snopt")
    assert shooting.success, shooting.message
    assert shooting.cost == pytest.approx(solution.cost, rel=1e-6)


def test_the_cost_falls_from_row_to_row():
    solution = dd.solve(pendulum(), method="ilqr")
    costs = [row.objective for row in solution.iterations]
    assert costs[0] == pytest.approx(50.2 * np.pi**2, rel=1e-12)  # hanging still: 100 * 0.02 * 0.1 pi^2 + 50 pi^2
    assert np.all(np.diff(costs) <= 0)  # the last step may gain less than rounding
    assert len(costs) > 3
    assert costs[-1] == solution.cost


def test_a_function_is_optimized_like_the_quadratic_cost_it_is():
    """A30 again; second derivatives by differences of 1e-5 cost digits, so it may take more than one step."""
    h, count, Q, R, Qf = A30
    problem = dd.Problem(
        block(time_step=h),
        x0=[1, 0],
        num_steps=count,
        running_cost=lambda x, u: (x @ Q @ x + R * u[0] ** 2) / h,
        final_cost=lambda x: x @ Qf @ x,
    )
    solution = dd.solve(problem, method="ilqr")
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(12.948481280713864, rel=1e-12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"x_goal": [np.pi, 0]}, 'x_goal: expected none for method="ilqr"; method="shooting" takes it, got given'),
        ({"bounds": dd.Bounds(x_upper=[4, np.inf])}, 'state bounds: expected none for method="ilqr"'),
        ({"optimize": ("controls", "initial_state")}, 'optimize "initial_state": expected none'),
        ({"optimize": ("initial_state",)}, 'optimize "initial_state": expected none'),
    ],
)
def test_what_ilqr_cannot_keep_is_refused(changes, words):
    with pytest.raises(dd.InputError, match=words):
        dd.solve(pendulum(**changes), method="ilqr")


def test_the_limits_are_told():
    few = dd.solve(pendulum(), method="ilqr", max_iterations=2)
    assert few.status is Status.ITERATION_LIMIT
    assert [row.iteration for row in few.iterations] == [0, 1, 2]
    assert dd.solve(pendulum(), method="ilqr", time_limit=1e-6).status is Status.TIME_LIMIT


def test_ctrl_c_ends_it_with_the_motion_so_far():
    before = signal.getsignal(signal.SIGINT)
    solution = dd.solve(pendulum(), method="ilqr", progress=lambda line: signal.raise_signal(signal.SIGINT))
    assert solution.status is Status.INTERRUPTED
    assert solution.cost < 50.2 * np.pi**2  # that of the guess
    assert solution.defect < 1e-12
    assert signal.getsignal(signal.SIGINT) is before


def test_a_guess_outside_the_bounds_is_taken_inside():
    """min u^2 within 1 <= u <= 2 is u = 1, at the bound; the guess is at 9."""
    problem = dd.Problem(
        block(),
        x0=[0, 0],
        num_steps=5,
        running_cost=dd.QuadraticCost(R=[[1.0]]),
        bounds=dd.Bounds(u_lower=[1.0], u_upper=[2.0]),
    )
    solution = dd.solve(problem, method="ilqr", initial_guess=(np.zeros((6, 2)), np.full((5, 1), 9.0)))
    assert solution.success, solution.message
    assert solution.us.tolist() == [[1.0]] * 5

"""Tests of iLQR against the Riccati recursion, closed forms, and the conditions of an optimum."""

import itertools
import signal

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block, craft, tilted
from helpers.problems import DOUBLE_INTEGRATOR, OTHERS, lqr, pendulum, riccati
from helpers.robots import example_robot, state_in_range
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.optimize.ilqr.riccati import LinearQuadratic, minimize_in_box, solve_riccati
from drake_diff.optimize.replay import GAINS_ALONE
from drake_diff.optimize.solution import Status

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])


@each_row("case", OTHERS)
@each_row("seed", [0, 1, 2])
@each_row("infeasible", [False, True])
def test_one_step_from_any_guess_is_the_riccati_recursions_optimum(case, seed, infeasible):
    """The relative tolerance of 1e-12 allows for rounding in a sum of a few hundred terms."""
    problem = lqr(*case, x0=(1.0, -0.5))
    random = np.random.default_rng(seed)
    us = 10 * random.standard_normal((case[1], 1))
    xs = 10 * random.standard_normal((case[1] + 1, 2)) if infeasible else dd.rollout(problem.model, problem.x0, us).xs
    solution = dd.solve(problem, method="ilqr", initial_guess=(xs, us))
    P, gains = riccati(*case)
    x0 = np.array([1.0, -0.5])
    assert solution.success, solution.message
    assert [row.iteration for row in solution.iterations] == [0, 1]
    assert solution.cost == pytest.approx(x0 @ P @ x0, rel=1e-12)
    for x, u, K in zip(solution.xs, solution.us, gains, strict=False):
        assert u == pytest.approx(-K @ x, abs=1e-10)


@pytest.mark.parametrize("case", OTHERS)
def test_the_optimal_costs_gradient_by_the_initial_state_is_twice_p0_x0(case):
    """The inputs are optimal, so that only the direct effect of x0 counts."""
    _, _, Q, R, Qf = case
    problem = lqr(*case)
    us = dd.solve(problem, method="ilqr").us

    def loss(xs, us):
        return sum(x @ Q @ x + R * u @ u for x, u in zip(xs, us, strict=False)) + xs[-1] @ Qf @ xs[-1]

    gradient = dd.differentiate_rollout(problem.model, problem.x0, us, loss)
    assert gradient.by_x0 == pytest.approx(2 * riccati(*case)[0] @ [1, 0], rel=1e-10)
    assert np.abs(gradient.by_us).max() < 1e-10
    if case is DOUBLE_INTEGRATOR:
        assert gradient.by_x0 == pytest.approx([25.89696256, 5.23643035], abs=5e-9)


def pendulum_gradient(us):
    """Return dJ/du (N, 1) of SOFT for a pendulum by hand, with m = 1, l = 0.5, b = 0.1 implicit, h = 0.02."""
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


def test_a_swing_up_without_bounds_leaves_no_slope():
    solution = dd.solve(pendulum(), method="ilqr")
    assert solution.success, solution.message
    assert np.abs(pendulum_gradient(solution.us)).max() < 1e-6


@pytest.mark.slow
def test_a_swing_up_within_bounds_meets_them_and_the_conditions_of_an_optimum():
    """The gradient is 0 where |u| < 2.5. At a bound the cost pushes outwards. Shooting finds the same cost."""
    problem = pendulum(bounds=dd.Bounds(u_lower=[-2.5], u_upper=[2.5]))
    solution = dd.solve(problem, method="ilqr")
    assert solution.success, solution.message
    us, gradient = solution.us[:, 0], pendulum_gradient(solution.us)[:, 0]
    assert np.abs(us).max() == 2.5
    assert np.abs(gradient[np.abs(us) < 2.5]).max() < 1e-6
    assert np.all(gradient[us == 2.5] <= 0)
    assert np.all(gradient[us == -2.5] >= 0)
    shooting = dd.solve(problem, method="shooting")
    assert shooting.success, shooting.message
    assert shooting.cost == pytest.approx(solution.cost, rel=1e-6)


def test_the_cost_falls_from_row_to_row():
    solution = dd.solve(pendulum(), method="ilqr")
    costs = [row.objective for row in solution.iterations]
    assert costs[0] == pytest.approx(50.2 * np.pi**2, rel=1e-12)  # hanging at rest: 100 * 0.02 * 0.1 pi^2 + 50 pi^2
    assert np.all(np.diff(costs) <= 0)  # the last step may gain less than rounding
    assert len(costs) > 3
    assert costs[-1] == solution.cost


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"trajectory_cost": lambda xs, us: xs[3, 0] ** 2}, 'trajectory_cost: expected no value for method="ilqr"'),
    ],
)
def test_what_ilqr_cannot_keep_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
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
    assert solution.cost < 50.2 * np.pi**2  # the cost of the initial guess
    assert solution.defect < 1e-12
    assert signal.getsignal(signal.SIGINT) is before


def test_a_step_of_size_a_leaves_the_rest_of_each_gap():
    """Swing up from a straight line. The largest gap is multiplied by 1 - size, and is exactly 0 after a full step."""
    xs = np.linspace(0, 1, 101)[:, None] * np.array([np.pi, 0])
    solution = dd.solve(pendulum(), method="ilqr", initial_guess=(xs, np.full((100, 1), 8.0)))
    rows = solution.iterations
    assert rows[0].primal_infeasibility > 0.1
    for before, after in itertools.pairwise(rows):
        assert after.primal_infeasibility == pytest.approx((1 - after.step) * before.primal_infeasibility, rel=1e-12)
    assert solution.success, solution.message
    assert solution.defect < 1e-12
    assert np.abs(pendulum_gradient(solution.us)).max() < 1e-6


def test_a_hard_goal_of_the_pendulum():
    """J = 8.826541704941 by an independent program, to a relative 1e-8, as the goal is met to 1e-8."""
    solution = dd.solve(pendulum(x_goal=[np.pi, 0], running_cost=EFFORT, final_cost=None), method="ilqr")
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(8.826541704941, rel=1e-8)
    assert solution.goal_error < 1e-8
    assert solution.us[:3, 0] == pytest.approx([-1.52719898, -1.74962353, -1.96009648], abs=2e-6)


def test_the_pendulum_of_drake_ddp():
    """0.225845385916 by an independent program. The solve takes few steps, as it learns the dynamics' curvature."""
    problem = dd.Problem(
        dd.load_model(MODELS / "pendulum.urdf", time_step=0.01),
        x0=[0, 0],
        num_steps=199,
        running_cost=dd.QuadraticCost(Q=np.diag([0, 0.01]), R=[[0.01]]),
        final_cost=dd.QuadraticCost(Q=100 * np.eye(2), x_ref=[np.pi, 0]),
    )
    solution = dd.solve(problem, method="ilqr")
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(0.225845385916, abs=1e-12)
    assert len(solution.iterations) < 40  # 199 without the curvature


def move(count=20, goal=(1, 0), **bounds):
    model = block(time_step=1 / count)
    fields = {"x0": [0, 0], "num_steps": count, "running_cost": EFFORT, "bounds": dd.Bounds(**bounds)}
    return dd.Problem(model, x_goal=goal, **fields)


def test_a_velocity_limit_is_met_and_pays():
    """u_k - u_(k+1) is a constant plus the multiplier of v_(k+1) <= 1.2, which is 0 where v is below the limit.

    IPOPT, which relaxes bounds by 1e-8, finds the same cost.
    """
    problem = move(x_upper=[np.inf, 1.2])
    solution = dd.solve(problem, method="ilqr")
    assert solution.success, solution.message
    assert solution.bound_violation < 1e-8
    slack = 1.2 - solution.xs[1:-1, 1]
    assert (slack < 1e-7).sum() > 3
    falls = -np.diff(solution.us[:, 0])
    apart = falls[slack > 1e-3]
    assert np.ptp(apart) < 1e-6
    assert falls.min() > apart.max() - 1e-6 or falls.max() < apart.min() + 1e-6
    shooting = dd.solve(problem, method="shooting")
    assert shooting.success, shooting.message
    assert solution.cost == pytest.approx(shooting.cost, rel=1e-6)


def test_cart_pole_swing_up_from_rest():
    """The optimum of examples/cart_pole_swing_up.py at 50 steps is 58.6088 by SNOPT and IPOPT.

    With steps of 0.04 s the plan is no motion of the plant. In finer steps it needs feedback. With the gains alone it
    ends more than 5 % of a range from the goal, and within 10 %.
    """
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.04)
    problem = dd.Problem(model, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], num_steps=50, running_cost=EFFORT)
    solution = dd.solve(problem, method="ilqr")
    line = np.linspace(0, 1, 51)[:, None] * problem.x_goal
    from_a_line = dd.solve(problem, method="ilqr", initial_guess=(line, np.zeros((50, 1))))
    again = dd.solve(problem, method="ilqr", initial_guess=solution)
    for found in (solution, from_a_line, again):
        assert found.message.startswith("converged: holds open loop at 40 ms and at 20 ms; under TVLQR at 5 ms and in ")
        alone = next(r for r in found.replays if r.control == GAINS_ALONE)
        part = np.max(np.abs(problem.goal_error(alone.motion.xs[-1])) / np.ptp(found.xs, axis=0))
        assert 0.05 < part < 0.1
        assert found.goal_error < 1e-6
        assert found.cost == pytest.approx(58.6088133284, rel=1e-8)
    assert len(again.iterations) < 12  # iLQR stays near a good guess


@pytest.mark.parametrize("target", [[1, 0, 0, 0], [0, 1, 0, 0]])
def test_a_floating_bodys_optimum_has_no_slope(target):
    """Check by reverse accumulation in Drake's coordinates. Without the quaternion's growing norm 1e-3 is left."""
    model = craft()
    x0, x_ref, Q = tilted(model), np.array(model.default_state), np.zeros((model.nx, model.nx))
    x_ref[:4], Q[:4, :4] = target, np.eye(4)
    running = dd.QuadraticCost(Q=Q, R=0.01 * np.eye(3), x_ref=x_ref)
    problem = dd.Problem(model, x0=x0, num_steps=30, running_cost=running, final_cost=dd.QuadraticCost(Q, x_ref=x_ref))
    solution = dd.solve(problem, method="ilqr")
    assert solution.success, solution.message

    def loss(xs, us):
        return 0.05 * sum(running(x, u) for x, u in zip(xs, us, strict=False)) + problem.final_cost(xs[-1])

    assert np.abs(dd.differentiate_rollout(model, x0, solution.us, loss).by_us).max() < 1e-7


def test_a_guess_with_the_other_sign_of_a_quaternion_is_the_same_guess():
    model = craft()
    x0, x_ref, Q = tilted(model), np.array(model.default_state), np.zeros((model.nx, model.nx))
    Q[:4, :4] = np.eye(4)
    cost = dd.QuadraticCost(Q=Q, R=0.01 * np.eye(3), x_ref=x_ref)
    problem = dd.Problem(model, x0=x0, num_steps=10, running_cost=cost)
    xs, us = np.tile(x0, (11, 1)), np.zeros((10, 3))
    flipped = np.array(xs)
    flipped[1::2, :4] *= -1
    a, b = (dd.solve(problem, method="ilqr", initial_guess=(guess, us)) for guess in (xs, flipped))
    assert a.success, a.message
    assert a.us.tobytes() == b.us.tobytes()


def test_a_free_initial_velocity_drifts_to_the_goal():
    """No force is needed for v_0 = 1. With v_0 <= 0.7, v = 0.7 + the sum of h u."""
    fields = {"optimize": ("controls", "initial_state"), "initial_state_mask": [False, True]}
    problem = dd.Problem(block(), x0=[0, 0], num_steps=10, x_goal=[1, np.nan], running_cost=EFFORT, **fields)
    solution = dd.solve(problem, method="ilqr")
    assert solution.success, solution.message
    assert solution.xs[0] == pytest.approx([0, 1], abs=1e-7)
    assert solution.cost < 1e-12
    slow = dd.Problem(
        block(),
        x0=[0, 0],
        num_steps=10,
        final_cost=dd.QuadraticCost(Q=np.diag([100, 0]), x_ref=[1, 0]),
        running_cost=EFFORT,
        bounds=dd.Bounds(x_upper=[np.inf, 0.7]),
        **fields,
    )
    a, b = dd.solve(slow, method="ilqr"), dd.solve(slow, method="shooting")
    assert a.success, a.message
    assert a.xs[0, 1] == pytest.approx(0.7, abs=1e-12)
    assert a.cost == pytest.approx(b.cost, rel=1e-6)


@pytest.mark.parametrize(
    "bounds", [{"x_upper": [np.inf, 0.8]}, {"u_lower": [-3.0], "u_upper": [3.0]}, {"x_upper": [np.inf, 0.99]}]
)
def test_a_goal_out_of_reach_is_infeasible(bounds):
    """1 m in 1 s from rest to rest needs more than 1 m/s, and 4 N."""
    solution = dd.solve(move(**bounds), method="ilqr")
    assert solution.status is Status.INFEASIBLE, solution.message
    assert solution.iterations[-1].primal_infeasibility > 1e-3
    assert "after" in repr(solution)


def test_a_goal_alone_needs_no_cost():
    problem = dd.Problem(block(), x0=[0, 0], num_steps=30, x_goal=[1, 0])
    solution = dd.solve(problem, method="ilqr")
    assert solution.success, solution.message


@each_row("seed", range(5))
def test_the_box_newton_step_satisfies_the_conditions_of_an_optimum(seed):
    random = np.random.default_rng(seed)
    root = random.standard_normal((5, 5))
    hessian, gradient = root @ root.T + 0.1 * np.eye(5), 3 * random.standard_normal(5)
    lower, upper = -random.random(5), random.random(5)
    d, free = minimize_in_box(hessian, gradient, lower, upper)
    slope = gradient + hessian @ d
    assert np.abs(slope[free]).max(initial=0.0) < 1e-10
    assert np.all((slope[d == lower] >= 0) | free[d == lower])
    assert np.all((slope[d == upper] <= 0) | free[d == upper])
    assert np.all((lower <= d) & (d <= upper))


def test_a_ridge_is_in_the_units_of_what_it_is_added_to():
    """If one input has another unit, with 1000 times the value, the regularized motion is the same."""
    plain, p = [], _around(np.ones(2))
    for scale in (np.ones(2), np.array([1.0, 1000.0])):
        policy = solve_riccati(_around(scale), 0.7)
        plain.append(policy.feedforward * scale)
    np.testing.assert_allclose(plain[1], plain[0], rtol=1e-9)  # rounding of a Cholesky factorization
    assert np.abs(solve_riccati(p, 0.0).feedforward - plain[0]).max() > 1e-3


def _around(scale):
    """Return a linear-quadratic problem with three states and two inputs in units of `scale`."""
    random = np.random.default_rng(4)
    F, g = random.standard_normal((5, 3, 5)), random.standard_normal((6, 5))
    H = np.tile(np.eye(5), (6, 1, 1))
    g[-1], H[-1] = [1, 1, 1, 0, 0], np.diag([1, 1, 1, 0, 0])
    into = np.diag(np.concatenate([np.ones(3), scale]))
    one = np.full((5, 2), np.inf)
    return LinearQuadratic(
        F @ into,
        np.zeros((5, 3)),
        g @ into,
        into @ H @ into,
        -one,
        one,
        np.zeros(3),
        np.zeros(3),
    )


def without_derivatives(monkeypatch, refuses, error=GradientError):
    """Raise `error` for the Jacobians of motions with `refuses(xs)`, and return the list of requested motions."""
    from drake_diff.optimize.ilqr import ilqr

    true, seen = ilqr.jacobians_along, []

    def jacobians_along(problem, motion):
        seen.append(motion.xs)
        if refuses(motion.xs):
            raise error("no derivative here")
        return true(problem, motion)

    monkeypatch.setattr(ilqr, "jacobians_along", jacobians_along)
    return seen


@pytest.mark.parametrize("error", [GradientError, SimulationError])
def test_a_motion_without_a_derivative_is_a_step_that_was_too_long(monkeypatch, error):
    """The iterates of a swing-up are faster than its guess and optimum. Derivatives fail above half of this excess."""
    limit = [np.inf]
    seen = without_derivatives(monkeypatch, lambda xs: np.abs(xs[:, 1]).max() > limit[0], error)
    problem = pendulum(running_cost=dd.QuadraticCost(R=[[1.0]]), final_cost=None, x_goal=[np.pi, 0], num_steps=60)
    free = dd.solve(problem, method="ilqr")
    assert free.success, free.message
    needed, fastest = np.abs(free.xs[:, 1]).max(), max(np.abs(xs[:, 1]).max() for xs in seen)
    assert fastest > 1.02 * needed
    limit[0] = (needed + fastest) / 2
    solution = dd.solve(problem, method="ilqr")
    assert solution.success, solution.message
    assert "backed off from: no derivative here" in solution.solver_message
    assert solution.cost == pytest.approx(free.cost, rel=1e-8)


def test_where_no_way_goes_on_the_motion_so_far_is_kept_and_the_reason_told(monkeypatch):
    problem = pendulum()
    still = np.zeros((101, 2))
    without_derivatives(monkeypatch, lambda xs: np.abs(xs - still).max() > 0)
    solution = dd.solve(problem, method="ilqr")
    assert solution.status is dd.Status.NO_GRADIENT
    assert "backed off from: no derivative here" in repr(solution)
    assert np.array_equal(solution.xs, still)
    assert len(solution.iterations) == 1


@pytest.mark.parametrize("name", ["finger_edu.urdf", pytest.param("ur5_robot.urdf", marks=pytest.mark.slow)])
@pytest.mark.parametrize("approximation", ["sap", "lagged"])
def test_an_arm_that_starts_beside_a_joint_limit_leaves_it(name, approximation):
    """Start 10 mrad from a limit with gravity. The limit acts on the way, SAP stops early, and the arm has to leave."""
    model = example_robot(name, 0.01, approximation=approximation)
    random = np.random.default_rng(3)
    x0 = state_in_range(model, random, 0.0)
    lower = model.plant.GetPositionLowerLimits()
    j = int(np.flatnonzero(np.isfinite(lower))[0])
    x0[j] = lower[j] + 0.01
    wanted = np.array(x0)
    wanted[j] += 0.2
    Q = np.diag(np.repeat([1.0, 0.1], [model.nq, model.nv]))
    cost = dd.QuadraticCost(Q=Q, x_ref=wanted, R=1e-3 * np.eye(model.nu))
    solution = dd.solve(dd.Problem(model, x0=x0, num_steps=40, running_cost=cost), method="ilqr", max_iterations=100)
    assert solution.success, solution.message
    assert solution.xs[-1, j] > lower[j] + 0.05


def test_a_search_begins_where_the_rollout_of_its_guess_is_not_finite(tmp_path):
    """A step of a spring of 5000 N/m multiplies a deviation by 23, so that 260 steps without force overflow.

    With free forces, the deviation x moves by h v. Its least cost h p x^2 solves p = 1 + p / (1 + p h^2).
    """
    text = (MODELS / "mass_spring_damper.sdf").read_text()
    text = text.replace("<spring_stiffness>50<", "<spring_stiffness>5000<").replace("<effort>1000<", "<effort>1e9<")
    path = tmp_path / "stiff.sdf"
    path.write_text(text)
    model, h = dd.load_model(path, time_step=0.1), 0.1
    cost = dd.QuadraticCost(Q=np.eye(2), R=[[1e-14]], x_ref=[0.1, 0.0])
    problem = dd.Problem(model, x0=[0.2, 0.0], num_steps=260, running_cost=cost)
    with pytest.raises(SimulationError):
        dd.rollout(model, problem.x0, np.zeros((260, 1)))
    solution = dd.solve(problem, method="ilqr")
    p = (1 + np.sqrt(1 + 4 / h**2)) / 2
    assert len(solution.iterations) > 1
    assert solution.cost == pytest.approx(h * p * 0.1**2, rel=1e-6)

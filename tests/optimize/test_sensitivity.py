"""Tests of the derivative of an optimal plan: closed forms, repeated solves, and corners without a derivative."""

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row, slow_after

import drake_diff as dd
from drake_diff.exceptions import GradientError, InputError, UnknownNameError
from drake_diff.optimize import Options
from drake_diff.optimize.transcription.kkt import HeldPlan

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])


def block(limit=np.inf, **asked):
    """Return x'' = u from rest at 0 to rest at 1 in T = 1, for which u = 6 - 12 t."""
    push = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1, u_lower=[-limit], u_upper=[limit])
    rest = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 10, "horizon": 1.0, "running_cost": EFFORT}
    return dd.Problem(push, **rest | asked)


@each_row("scheme", ["hermite_simpson", "trapezoid"])
def test_a_block_between_two_states_has_the_closed_forms_derivative(scheme):
    """cost = 12 d^2 - 12 d (v0 + v1) + 4 (v0^2 + v0 v1 + v1^2), with the distance d and the end speeds v0, v1."""
    solution = dd.solve(block(), options=Options(scheme=scheme))
    by_goal, by_x0 = dd.sensitivity(solution, "goal"), dd.sensitivity(solution, "x0")
    exact = scheme == "hermite_simpson"  # the other scheme has order 2 and is off by 4 % for ten intervals
    np.testing.assert_allclose(by_goal.cost, [24, -12], rtol=1e-9 if exact else 0.05)
    np.testing.assert_allclose(by_x0.cost, [-24, -12], rtol=1e-9 if exact else 0.05)
    assert by_goal.verdict == by_x0.verdict == "agree"
    t = solution.times
    if exact:
        np.testing.assert_allclose(by_goal.xs[:, 0, 0], 3 * t**2 - 2 * t**3, atol=1e-9)
        np.testing.assert_allclose(by_goal.us[:, 0, 0], 6 - 12 * t[:-1], atol=1e-8)
        np.testing.assert_allclose(by_goal.us[:, 0, 1], 6 * t[:-1] - 2, atol=1e-8)
    np.testing.assert_allclose(by_x0.xs[0, :, :], np.eye(2), atol=1e-12)
    np.testing.assert_allclose(by_x0.xs[-1], 0.0, atol=1e-12)


def test_least_time_with_a_limited_input_has_the_closed_forms_derivative():
    """T = 2 sqrt(d) has dT/dd = 1 / sqrt(d), with the input at its limit in every interval."""
    for way in (0.5, 1.0, 3.0):
        problem = block(1.0, x_goal=[way, 0], num_steps=20, horizon=(0.1, 10), running_cost=1.0)
        found = dd.sensitivity(dd.solve(problem), "goal")
        assert found.horizon[0] == pytest.approx(1 / np.sqrt(way), rel=2e-3)  # the interval with the switch
        assert found.active >= 36
        assert found.differences[0] < 1e-4


def test_a_limit_that_is_touched_without_force_is_a_corner():
    """u = 6 at both ends is exactly the limit, which is active for a farther goal, but not for a nearer one."""
    found = dd.sensitivity(dd.solve(block(6.0)), "goal")
    assert found.verdict == "discontinuous"
    assert "u0 at node 0" in found.weak
    assert dd.sensitivity(dd.solve(block(6.5)), "goal").verdict == "agree"
    held = dd.sensitivity(dd.solve(block(5.0)), "goal")
    assert held.verdict == "agree"
    assert held.active > 0


def test_a_wrong_derivative_is_told(monkeypatch):
    """The Hessian has a planted error of up to 1 %, or of a tenth of that."""
    honest = HeldPlan._hessian
    for part in (0.01, 0.001):
        with monkeypatch.context() as patched:
            patched.setattr(
                HeldPlan,
                "_hessian",
                lambda self, y, part=part: honest(self, y) * (1 + part * np.linspace(0, 1, len(self.z))[:, None]),
            )
            found = dd.sensitivity(dd.solve(block()), "goal")
        assert found.verdict == "disagree"
        assert "differences of re-solves" in repr(found)
    assert dd.sensitivity(dd.solve(block()), "goal", certified=False).verdict == "not certified"


def test_a_plan_that_is_one_of_many_has_no_derivative():
    """The second input moves a state that has no goal and no cost."""
    slide = dd.Dynamics(lambda x, u: [u[0], u[1]], nx=2, nu=2)
    free = dd.QuadraticCost(R=np.diag([1.0, 0.0]))
    problem = dd.Problem(slide, x0=[0, 0], x_goal=[1, None], num_steps=10, horizon=1.0, running_cost=free)
    with pytest.raises(GradientError, match="the optimum is not unique"):
        dd.sensitivity(dd.solve(problem), "goal")


def test_what_has_no_sensitivity_is_refused(write_urdf):
    model = write_urdf(time_step=0.1)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=10, running_cost=EFFORT)
    solution = dd.solve(problem, method="collocation")
    for given, by, match in (
        (problem, "x0", "solution: expected a Solution"),
        (dd.solve(problem, method="ilqr"), (), 'expected "x0", "goal", or names of parameters'),
        (dd.solve(block(3.9)), "x0", "expected a successful solution"),
        (
            dd.solve(problem, method="collocation", options=Options(scheme="drake")),
            "x0",
            "hermite_simpson, trapezoid, iLQR or shooting",
        ),
        (solution, (), 'expected "x0", "goal", or names of parameters'),
        (dd.solve(block(x_goal=None, final_cost=lambda x: (x[0] - 1) ** 2)), "goal", "all of these are free"),
    ):
        with pytest.raises(InputError, match=re.escape(match)):
            dd.sensitivity(given, by)
    with pytest.raises(UnknownNameError):
        dd.sensitivity(solution, ["block.colour"])
    with pytest.raises(UnknownNameError):
        dd.sensitivity(dd.solve(block()), ["block.mass"])


# ------------------------------------------------------------------------------ plans by Drake's own steps


def regulated(write_urdf, x0=(1.0, 0.5), **asked):
    """Return the problem of bringing a block of 1.5 kg to rest."""
    given = {"num_steps": 20, "running_cost": dd.QuadraticCost(Q=np.diag([1.0, 0.1]), R=[[0.2]])}
    model = write_urdf(mass=1.5, time_step=0.1)
    return dd.Problem(model, x0=x0, final_cost=dd.QuadraticCost(Q=np.diag([5.0, 2.0])), **given | asked)


@pytest.mark.parametrize("method", slow_after(1, ["ilqr", "shooting"]))
def test_a_linear_regulator_has_the_gains_of_its_riccati_equation(write_urdf, method):
    """By the discrete Riccati recursion du_0/dx0 = -K_0, dx_k/dx0 is the closed loop, and d cost/dx0 = 2 P_0 x0."""
    problem = regulated(write_urdf)
    h, m, count = 0.1, 1.5, 20
    A, B = np.array([[1, h], [0, 1]]), np.array([[h * h / m], [h / m]])
    Q, R, P = h * np.diag([1.0, 0.1]), h * np.array([[0.2]]), np.diag([5.0, 2.0])
    gains = []
    for _ in range(count):
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ K)
        gains.insert(0, K)
    found = dd.sensitivity(dd.solve(problem, method=method))
    states = [np.eye(2)]
    for K in gains:
        states.append((A - B @ K) @ states[-1])
    np.testing.assert_allclose(found.xs, states, atol=1e-9)
    np.testing.assert_allclose(found.us, [-K @ x for K, x in zip(gains, states, strict=False)], atol=1e-8)
    np.testing.assert_allclose(found.cost, 2 * P @ problem.x0, rtol=1e-8)
    assert found.verdict == "agree"
    assert "Jacobians" in found.derivatives


@pytest.mark.slow
def test_a_discrete_plan_between_two_states_is_a_least_norm(write_urdf):
    """u = S' (S S')^-1 (goal - free motion), with S from inputs to the last state. u and cost scale with the mass."""
    h, m, count = 0.1, 1.5, 10
    A, B = np.array([[1, h], [0, 1]]), np.array([[h * h / m], [h / m]])
    S = np.hstack([np.linalg.matrix_power(A, count - 1 - k) @ B for k in range(count)])
    model = write_urdf(mass=m, time_step=h)
    problem = dd.Problem(model, x0=[0.2, 0], x_goal=[1, 0], num_steps=count, running_cost=EFFORT)
    solution = dd.solve(problem, method="ilqr")
    by_goal, by_mass = dd.sensitivity(solution, "goal"), dd.sensitivity(solution, ["block.mass"])
    pull = S.T @ np.linalg.inv(S @ S.T)
    np.testing.assert_allclose(by_goal.us[:, 0], pull, atol=1e-7)
    np.testing.assert_allclose(by_mass.us[:, 0, 0], pull @ [0.8, 0] / m, atol=1e-6)
    assert by_mass.cost[0] == pytest.approx(2 * solution.cost / m, rel=1e-6)
    assert by_goal.verdict == by_mass.verdict == "agree"


@pytest.mark.slow
def test_discrete_plans_keep_what_holds_them(write_urdf):
    """Test a waypoint, a constraint, a coupling, a free entry of the first state, and a bound on the input."""
    model = write_urdf(mass=1.0, time_step=0.1)
    asked = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 20, "running_cost": EFFORT}
    slow = dd.Constraint(lambda x: x[1] ** 2, upper=0.7**2, name="slow")
    way = dd.optimize.Coupling(lambda a, b: b[0] - a[0], knots=(5, 15), lower=0.6, upper=0.6, name="way")
    bounded = dd.Bounds(u_lower=[-2.0], u_upper=[2.0])
    free = {"optimize": ("controls", "initial_state"), "initial_state_mask": [False, True]}
    for more, method in (
        ({"waypoints": {8: [0.3, None]}}, "ilqr"),
        ({"constraints": slow}, "ilqr"),
        ({"couplings": way}, "shooting"),
        ({"bounds": bounded, "num_steps": 15}, "ilqr"),
        (free, "ilqr"),
    ):
        solution = dd.solve(dd.Problem(model, **asked | more), method=method)
        found = dd.sensitivity(solution, "goal")
        assert found.verdict == "agree", (more, found)
        assert (found.active > 0) == bool({"constraints", "bounds"} & set(more))
        if "waypoints" in more:
            np.testing.assert_allclose(found.xs[8, 0], 0.0, atol=1e-9)
        if "couplings" in more:
            np.testing.assert_allclose(found.xs[15, 0] - found.xs[5, 0], 0.0, atol=1e-9)
        if "optimize" in more:
            assert np.abs(found.xs[0, 1]).max() > 0.1


@pytest.mark.slow
@pytest.mark.long
@each_row("method", ["ilqr", "shooting"])
def test_the_length_of_steps_moves_with_the_goal(write_urdf, method):
    """The cost is k d^2 / T^3 for the effort of N steps, plus T. T grows with the root of d, and dT/dd = T / (2 d)."""
    problem = dd.Problem(
        write_urdf(mass=1.0, time_step=0.1),
        x0=[0, 0],
        x_goal=[1, 0],
        num_steps=12,
        horizon=(0.5, 10.0),
        running_cost=lambda x, u: u[0] ** 2 + 1.0,
    )
    solution = dd.solve(problem, method=method, max_iterations=3000)
    found = dd.sensitivity(solution, "goal")
    assert found.verdict == "agree", found
    assert found.horizon[0] == pytest.approx(solution.horizon / 2, rel=1e-6)
    assert found.cost[0] == pytest.approx(2 * (solution.cost - solution.horizon), rel=1e-6)
    with pytest.raises(InputError, match="a horizon sets the length of the steps"):
        dd.sensitivity(solution, ["block.mass"])


@pytest.mark.slow
def test_a_contact_that_is_about_to_begin_is_a_corner():
    """A ball ends 4 um before it touches another, which is a corner. At -0.2 mm and 0.1 mm there is no corner."""
    model = dd.load_model(MODELS / "two_spheres.sdf", time_step=0.01)
    slopes = {}
    for off, verdict in ((-4e-6, "discontinuous"), (-2e-4, "agree"), (1e-4, "agree")):
        asked = {"x0": [0, 0.25, 0, 0], "x_goal": [0.05 + off, None, 0, None], "num_steps": 40}
        solution = dd.solve(dd.Problem(model, running_cost=dd.QuadraticCost(R=[[1e-3]]), **asked), method="ilqr")
        found = dd.sensitivity(solution, "goal")
        assert found.verdict == verdict, found
        slopes[off] = found.us[-1, 0, 0]
        if verdict == "discontinuous":
            assert any("the one-sided derivatives with respect to push_x differ" in told for told in found.weak)
    assert slopes[1e-4] > slopes[-2e-4] + 10  # both are correct, and the corner is between them


def test_a_plan_that_is_no_optimum_has_no_derivative(write_urdf):
    problem = regulated(write_urdf)
    solution = dd.solve(problem, method="ilqr")
    us = np.array(solution.us) + 0.5
    other = replace(solution, us=us, xs=dd.rollout(problem.model, problem.x0, us).xs)
    with pytest.raises(GradientError, match="not a stationary point"):
        dd.sensitivity(other)
    other_cost = {"running_cost": None, "final_cost": None}
    whole = replace(problem, trajectory_cost=lambda xs, us: (us**2).sum() + xs[-1, 0] ** 2, **other_cost)
    with pytest.raises(InputError, match="trajectory_cost"):
        dd.sensitivity(dd.solve(whole, method="shooting"))


@pytest.mark.solve
@pytest.mark.parametrize("method", ["shooting", "collocation"])
@pytest.mark.parametrize("by", ["pole.mass", "hinge.damping"])
def test_the_sensitivity_of_a_problem_with_parameters_is_that_at_their_values(load, method, by):
    """The cost's slope is that of plans at other values, for a parameter that the problem sets and for another one."""
    model, values = load("pendulum.urdf", time_step=0.05), {"pole.mass": 1.3, "hinge.damping": 0.1}

    def solved(**parameters):
        effort = dd.QuadraticCost(R=[[1.0]])
        return dd.solve(
            dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=20, running_cost=effort, parameters=parameters),
            method=method,
        )

    result = dd.sensitivity(solved(**{"pole.mass": 1.3}), by)
    ahead, behind = (solved(**values | {by: values[by] + sign * 1e-3}).cost for sign in (1, -1))
    assert result.verdict == "agree"
    assert result.cost == pytest.approx([(ahead - behind) / 2e-3], rel=1e-6)  # error of the difference: 1e-6

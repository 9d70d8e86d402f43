"""Tests of maps x_(k+1) = f(x_k, u_k, k) as the system of a Problem, against Riccati and against the map itself."""

import numpy as np
import pytest
from helpers.solving import solve_with

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.optimize import Options

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
STEPS = 30


def block(x, u):
    return [x[0] + 0.1 * x[1], x[1] + 0.1 * u[0]]


def kicked(x, u, k):
    """Step a block on a bent track, which is stopped and thrown back at step 10. The step of the event is known."""
    position, speed = x[0] + 0.1 * x[1] + 0.05 * np.sin(x[0]), x[1] + 0.1 * u[0]
    return [position, -0.5 * speed if k == 10 else speed]


def branching(x, u, k):
    """Return the same step by a function that cannot be traced to an expression."""
    return kicked(x, u, k) if x[0] < 100 else [x[0], x[1]]


def kicked_problem(f=kicked, **more):
    system = dd.optimize.DiscreteMap(f, 2, 1, u_lower=[-5], u_upper=[5])
    effort = dd.QuadraticCost(R=[[1.0]])
    return dd.Problem(system, x0=[0, 0], x_goal=[1, 0], num_steps=STEPS, running_cost=effort, **more)


def test_a_linear_map_costs_what_riccati_says():
    Q, R, final = np.diag([1.0, 0.5]), np.eye(1), 10 * np.eye(2)
    P, x = final, np.array([1.0, -0.3])
    for _ in range(STEPS):
        P = Q + A.T @ P @ (A - B @ np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A))
    system = dd.optimize.DiscreteMap(block, 2, 1)
    costs = {"running_cost": dd.QuadraticCost(Q=Q, R=R), "final_cost": dd.QuadraticCost(Q=final)}
    solution = dd.solve(dd.Problem(system, x0=x, num_steps=STEPS, **costs))
    assert solution.success
    assert solution.scheme == "map"
    assert "open loop in its own steps" in solution.message
    assert solution.cost == pytest.approx(x @ P @ x, rel=1e-7)  # the solver's tolerance is 1e-8
    assert solution.us.shape == (STEPS, 1)
    assert solution.u_final is None


@pytest.mark.parametrize("f", [kicked, branching])
def test_an_event_at_a_step_is_part_of_the_map(f):
    limit = dd.Constraint(lambda x, u: u[0] + x[0], upper=0.9, name="limit")
    solution = dd.solve(kicked_problem(f, constraints=limit))
    assert solution.success, solution.message
    exact = "symbolic" in solution.options["derivatives"]
    assert exact == (f is kicked)
    x = np.zeros(2)
    for k, u in enumerate(solution.us):
        assert u[0] + x[0] <= 0.9 + 1e-6 or k == 0
        x = np.array(kicked(x, u, k))
    np.testing.assert_allclose(x, [1, 0], atol=1e-6)
    state, control = solution.trajectory()
    np.testing.assert_allclose(state.value(10.5).ravel(), solution.xs[10])
    np.testing.assert_allclose(control.value(10.5).ravel(), solution.us[10])
    np.testing.assert_array_equal(solution.times, np.arange(STEPS + 1))


def test_a_cost_in_time_counts_steps():
    late = kicked_problem()
    late = dd.Problem(late.system, x0=[0, 0], num_steps=STEPS, running_cost=lambda x, u, t: (u[0] - t) ** 2)
    np.testing.assert_allclose(dd.solve(late).us[:5, 0], [0, 1, 2, 3, 4], atol=1e-5)


def test_a_planted_defect_is_found():
    solution = dd.solve(kicked_problem())
    for seed in range(5):
        random = np.random.default_rng(seed)
        xs = np.array(solution.xs)
        k = int(random.integers(1, STEPS))
        xs[k, random.integers(2)] += 1e-3 * random.choice([-1, 1])
        wrong = dd.Solution(
            solution.problem, "collocation", "ipopt", solution.status, "", xs, solution.us, scheme=solution.scheme
        )
        assert wrong.defect > 1e-4
        assert {int(np.argmax(wrong.defects)), int(np.argmax(wrong.integration_errors))} <= {k - 1, k}


def test_a_wrong_derivative_of_one_step_is_found():
    """Check that the certificate reports wrong derivatives that a function provides itself."""

    class Wrong:
        def values(self, knots):
            return np.array([block(k[:2], k[2:]) for k in np.asarray(knots)])

        def linearize(self, knots):
            rows = np.hstack([A, B]) + np.array([[0, 0, 0], [0.01, 0, 0]])
            return self.values(knots), np.broadcast_to(rows, (len(knots), 2, 3))

    system = dd.optimize.DiscreteMap(Wrong(), 2, 1)
    effort = dd.QuadraticCost(R=[[1.0]])
    solution = dd.solve(dd.Problem(system, x0=[0, 0], x_goal=[1, 0], num_steps=STEPS, running_cost=effort))
    assert not solution.success
    assert [c.what for c in solution.plan_checks.failing] == ["derivative"]


def test_what_a_map_cannot_be_asked():
    with pytest.raises(InputError, match="whose time counts its steps"):
        kicked_problem(horizon=3.0)
    problem = kicked_problem()
    for asked in ({"scheme": "trapezoid"}, {"refine": True}, {"method": "shooting"}, {"method": "ilqr"}):
        with pytest.raises(InputError):
            solve_with(problem, **asked)
    pendulum = dd.load_model("models/pendulum.urdf", time_step=0.05)
    driven = dd.Problem(pendulum, x0=[0, 0], num_steps=5, running_cost=dd.QuadraticCost(R=[[1.0]]))
    with pytest.raises(InputError, match="scheme"):
        dd.solve(driven, method="collocation", options=Options(scheme="map"))


@pytest.mark.solve
def test_a_map_is_warm_started_and_its_sensitivity_is_that_of_re_solves():
    problem = kicked_problem()
    first = dd.solve(problem)
    again = dd.solve(problem, initial_guess=first)
    assert again.success
    assert again.iterations[0].objective == pytest.approx(first.cost, rel=1e-9)  # it begins where the first one ended
    assert again.iterations[0].primal_infeasibility < 1e-12
    assert dd.sensitivity(first, "goal").verdict == "agree"

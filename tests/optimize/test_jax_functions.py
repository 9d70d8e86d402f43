"""Functions that a user writes in JAX give the plans and gradients of the same functions in NumPy."""

import cloudpickle
import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.autodiff import UserFunction
from drake_diff._base.jax_rows import in_jax
from drake_diff.exceptions import GradientError, InputError
from drake_diff.motion import ParametricPolicy

jax = pytest.importorskip("jax", reason="pip install 'drake-diff[jax]'")
jnp = jax.numpy
GOAL = np.array([np.pi, 0.0])


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def functions(np):
    """Return the functions of a problem in NumPy or in JAX."""
    return {
        "running": lambda x, u: 0.1 * np.sum(x**2) + 0.01 * np.sum(u**2) + np.sin(x[0]) ** 2,
        "timed": lambda x, u, t: (0.1 * np.sum(x**2) + 0.01 * np.sum(u**2)) * (1 + np.sin(t)),
        "final": lambda x: 100 * np.sum((x - GOAL) ** 2),
        "limit": lambda x: x[1] * np.cos(x[0]),
        "dynamics": lambda x, u: np.concatenate([x[1:], -9.81 * np.sin(x[:1]) - 0.1 * x[1:] + u]),
        "trajectory": lambda xs, us: 0.01 * np.sum(xs[:, 0] ** 2) + 0.01 * np.sum(us**2),
        "policy": lambda x, t, p: np.tanh(p.reshape(1, 2) @ x) * np.cos(t),
    }


def pendulum():
    return dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)


def solved(f, running, method):
    fast = dd.Constraint(f["limit"], lower=-3.0, upper=3.0)
    problem = dd.Problem(
        pendulum(), x0=[0, 0], num_steps=30, running_cost=f[running], final_cost=f["final"], constraints=[fast]
    )
    return dd.solve(problem, method=method, restarts=0)


@pytest.mark.solve
@each_row("running, method", [("timed", "collocation"), ("running", "shooting"), ("timed", "ilqr")])
def test_costs_and_constraints_have_the_plan_of_numpys(running, method):
    expected, solution = (solved(functions(library), running, method) for library in (np, jnp))
    assert expected.success
    assert solution.success, solution
    assert solution.cost == pytest.approx(expected.cost, rel=1e-9)  # a second-order error of the same optimum
    # Without the exact Hessian, collocation takes several times as many.
    assert len(solution.iterations) <= len(expected.iterations) + 2


@pytest.mark.solve
def test_plain_dynamics_have_the_plan_of_numpys():
    def plan(library):
        f = functions(library)
        system = dd.Dynamics(f["dynamics"], nx=2, nu=1)
        return dd.solve(
            dd.Problem(system, x0=[0, 0], num_steps=20, horizon=(2, 2), running_cost=f["running"], x_goal=GOAL)
        )

    expected, solution = plan(np), plan(jnp)
    assert expected.success
    assert solution.success
    assert solution.cost == pytest.approx(expected.cost, rel=1e-9)


def test_a_cost_of_the_trajectory_and_a_policy_have_numpys_gradients():
    inputs = np.linspace(-1, 1, 20)[:, None]
    by_us = [
        dd.differentiate_rollout(pendulum(), [0.5, 0], inputs, functions(library)["trajectory"]).by_us
        for library in (np, jnp)
    ]
    np.testing.assert_allclose(by_us[1], by_us[0], rtol=1e-12, atol=1e-14)
    by_policy = [
        dd.differentiate_rollout(
            pendulum(),
            [0.5, 0],
            None,
            lambda x: x @ x,
            policy=ParametricPolicy(functions(library)["policy"], np.array([-3.0, -1.0])),
            num_steps=20,
        ).by_policy
        for library in (np, jnp)
    ]
    np.testing.assert_allclose(by_policy[1], by_policy[0], rtol=1e-10)


def test_jax_traces_a_cost_once_for_its_values_and_once_for_each_derivative():
    traced = []

    def cost(x, u):
        traced.append(isinstance(x, jax.core.Tracer))
        return jnp.sum(x**2) + jnp.sum(u**2)

    function = UserFunction("running_cost", cost, (), 1)
    compiled = in_jax("cost", lambda x, rest: function(x, rest), 2, 1, np.ones((3, 3)))
    first = len(traced)
    points = np.arange(12.0).reshape(4, 3)
    for _ in range(3):
        np.testing.assert_allclose(compiled.values(points)[:, 0], np.sum(points**2, axis=1))
        np.testing.assert_allclose(compiled.jacobians(points)[:, 0], 2 * points)
        np.testing.assert_allclose(compiled.hessians(points, np.ones((4, 1))), np.tile(2 * np.eye(3), (4, 1, 1)))
    assert all(traced[first:])
    assert len(traced) - first <= 6


def test_single_precision_is_refused_with_the_setting_to_change():
    with jax.enable_x64(False), pytest.raises(InputError, match="jax_enable_x64"):
        solved(functions(jnp), "running", "shooting")


def test_a_function_that_jax_cannot_trace_is_called():
    """A branch on a number works with single points, and JAX does not see it."""
    inner = UserFunction("cost", lambda x, u: jnp.sum(x**2), (), 1)
    assert in_jax("cost", lambda x, u: inner(x, u) if x[0] > 0 else 0.0, 2, 1, np.ones((3, 3))) is None
    assert in_jax("cost", lambda x, u: np.sum(x**2), 2, 1, np.ones((3, 3))) is None


def rows_of(cost, points):
    user = UserFunction("running_cost", cost, (), 1)
    return in_jax("running_cost", lambda x, rest: user(x, rest), 2, 1, points)


POINTS = np.array([[1.0, 2.0, 3.0], [0.5, 0.1, 0.2], [3.0, 2.0, 1.0]])


@each_row("hidden", [lambda x: x[0], lambda x: jnp.where(x[0] > 0.9, x[1], 0.0)], ids=["everywhere", "in a region"])
def test_a_slope_that_jax_does_not_see_is_refused(hidden):
    """JAX has the slope 0 behind `stop_gradient`."""
    with pytest.raises(
        GradientError, match=r"running_cost: the slope of value 0 along a line is .* by JAX .*dd\.certify_function"
    ):
        rows_of(lambda x, u: jnp.sum(x**2) + 3 * jax.lax.stop_gradient(hidden(x)), POINTS)


def test_a_slope_that_jax_does_not_see_beside_the_first_points_is_refused():
    def cost(x, u):
        return jnp.sum(x**2) + jax.lax.stop_gradient(jnp.where(x[0] > 5, x[0], 0.0))

    rows = rows_of(cost, POINTS)
    with pytest.raises(GradientError, match="certify_function"):
        rows.jacobians(POINTS + 5.0)


@each_row(
    "cost",
    [
        lambda x, u: jnp.abs(x[0] - 1) + jnp.sum(jnp.abs(u - 3)),  # with corners at the first point
        lambda x, u: jnp.sum((x - 7.0001e6) ** 2),
        lambda x, u: 1e8 + jnp.sum(x**2),
        lambda x, u: jnp.sum(jnp.tanh(x.astype(jnp.float32)).astype(jnp.float64)),
        lambda x, u: jnp.sum(u) - jnp.sum(u) + 0.0 * x[0],
    ],
)
@each_row("size", [1e-3, 1e6])
def test_the_slopes_of_jax_are_accepted_at_corners_and_in_any_unit(cost, size):
    assert rows_of(cost, POINTS * size) is not None


@pytest.mark.solve
@each_row("names", [None, ["k"], ["c", "k"]])
def test_parameters_of_dynamics_have_their_own_values(names):
    """The first derivative by the input is the parameter k."""

    def rates(x, u, p):
        return jnp.stack([x[1], u[0] * p[0] - p[1] * jnp.sin(x[1])])

    system = dd.Dynamics(rates, nx=2, nu=1, parameters={"k": 2.0, "c": 0.1})
    if names is not None:
        system = system.with_parameters(names)
    assert system.derivatives([0.3, 0.4], [0.5])[2][1, 0] == pytest.approx(2.0, rel=1e-12)
    cost = dd.QuadraticCost(Q=np.eye(2), R=np.eye(1))
    given = {} if names is None else {"parameters": names}
    problem = dd.Problem(system, num_steps=10, horizon=1.0, x0=[1.0, 0.0], running_cost=cost, **given)
    assert dd.solve(problem, restarts=0).cost == pytest.approx(plan_of_numpy(cost).cost, rel=1e-9)


def plan_of_numpy(cost):
    def rates(x, u, p):
        return np.array([x[1], u[0] * p[0] - p[1] * np.sin(x[1])])

    system = dd.Dynamics(rates, nx=2, nu=1, parameters={"k": 2.0, "c": 0.1})
    return dd.solve(dd.Problem(system, num_steps=10, horizon=1.0, x0=[1.0, 0.0], running_cost=cost), restarts=0)


def test_a_function_is_not_frozen_at_its_first_call():
    target = np.array([0.5])
    limit = dd.Constraint(lambda x: jnp.sum(x[:1]) - jnp.asarray(target)[0], lower=0.0)
    assert float(limit.function(np.array([2.0, 0.0]))) == 1.5
    target[0] = 1.9
    assert float(limit.function(np.array([2.0, 0.0]))) == pytest.approx(0.1)


def test_a_map_branches_on_its_step():
    jump = dd.optimize.DiscreteMap(lambda x, u, k: jnp.stack([x[0] + (5.0 if k == 2 else 0.0) - u[0]]), nx=1, nu=1)
    assert jump.values(np.array([[1.0, 0.5], [1.0, 0.5]]), np.array([1, 2])).ravel().tolist() == [0.5, 5.5]


def test_a_list_with_numbers_of_jax_is_an_array():
    system = dd.Dynamics(lambda x, u: [x[1], jnp.sin(x[0]) + u[0]], nx=2, nu=1)
    _, A, B = system.derivatives([0.3, 0.4], [0.5])
    np.testing.assert_allclose(A, [[0, 1], [np.cos(0.3), 0]], atol=1e-15)
    np.testing.assert_allclose(B, [[0], [1]])


def test_a_function_that_returns_no_numbers_is_refused_by_its_name():
    function = UserFunction("running_cost", lambda x, u: jnp.cos(str(x)), (), 1)
    with pytest.raises(InputError, match="running_cost <lambda>"):
        function(np.ones(2), np.ones(1))
    with pytest.raises(GradientError, match="lost its derivatives"):
        dd.differentiate_rollout(pendulum(), [0.5, 0], np.zeros((3, 1)), lambda x: float(jnp.sum(x)))


def test_a_cost_in_jax_is_pickled_after_its_use():
    function = UserFunction("final_cost", functions(jnp)["final"], (), 1)
    value = function(np.ones(2))
    assert cloudpickle.loads(cloudpickle.dumps(function))(np.ones(2)) == value

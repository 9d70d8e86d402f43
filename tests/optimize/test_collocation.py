"""Tests of collocation against closed forms and a dense solve of the same transcription, and of its refusals."""

import dataclasses

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block
from helpers.solving import solve_with
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])


def move(count=10, *, model=None, **changes):
    """Return the problem of least effort from rest at 0 to rest at 1 within 1 s."""
    fields = {"x0": [0, 0], "x_goal": [1, 0], "running_cost": EFFORT, "num_steps": count}
    return dd.Problem(model or block(time_step=1 / count), **{**fields, **changes})


def swing_up(count=20, **changes):
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=2 / count)
    fields = {"x0": np.zeros(4), "x_goal": [1, np.pi, 0, 0], "running_cost": EFFORT, "num_steps": count}
    return dd.Problem(model, **{**fields, **changes})


def collocate(problem, **options):
    return solve_with(problem, method="collocation", scheme="drake", **options)


def dense_block(count, h, Q, R, Qf, target):
    """Return the knots xs, us of min trapezoid(x'Qx + R u^2) + (x_N - target)'Qf(x_N - target), by least squares."""
    steps = np.zeros((count + 1, 2, count + 1))  # x_k = steps[k] @ u, exact for linear u
    for k in range(count):
        steps[k + 1] = [[1, h], [0, 1]] @ steps[k]
        steps[k + 1, :, k] += [h**2 / 3, h / 2]
        steps[k + 1, :, k + 1] += [h**2 / 6, h / 2]
    weights = np.full(count + 1, h)
    weights[[0, -1]] = h / 2
    H = sum(w * S.T @ Q @ S for w, S in zip(weights, steps, strict=True)) + np.diag(weights * R)
    H += steps[-1].T @ Qf @ steps[-1]
    us = np.linalg.solve(H, steps[-1].T @ Qf @ target)
    return steps @ us, us


@pytest.mark.parametrize("as_functions", [False, True])
def test_running_and_final_costs_give_the_dense_solves_optimum(as_functions):
    count, h, Q, R, Qf, target = 8, 0.125, np.diag([2.0, 0.3]), 0.05, np.diag([7.0, 1.0]), np.array([1.0, 0.2])
    running, final = dd.QuadraticCost(Q=Q, R=[[R]]), dd.QuadraticCost(Q=Qf, x_ref=target)
    if as_functions:
        running, final = lambda x, u: x @ Q @ x + R * u @ u, lambda x: (x - target) @ Qf @ (x - target)
    solution = collocate(move(count, x_goal=None, running_cost=running, final_cost=final))
    xs, us = dense_block(count, h, Q, R, Qf, target)
    assert solution.success, solution.message
    assert solution.xs == pytest.approx(xs, abs=1e-6)
    assert solution.inputs_at_knots[:, 0] == pytest.approx(us, abs=1e-5)


def test_a_coupled_model_is_refused():
    model = block(blocks=2, actuated=1, couple=True)
    problem = dd.Problem(model, x0=np.zeros(4), num_steps=5, running_cost=EFFORT, x_goal=[1, 0.5, 0, 0])
    with pytest.raises(ModelError, match=r"constraints have no continuous form; use method='shooting'"):
        collocate(problem)


def test_nothing_to_control_is_refused():
    problem = move(optimize=("initial_state",))
    with pytest.raises(InputError, match=r'optimize: expected "controls" .* got \[\'initial_state\'\]'):
        collocate(problem)


@pytest.mark.slow
@each_row("row, column", [(2, 1), (2, 3), (3, 1), (3, 3), (2, 4), (3, 4)])
def test_a_derivative_that_is_one_percent_off_is_named(row, column, monkeypatch):
    """Test every entry of the accelerations' [A B] that is not identically zero, with an initial guess that moves."""
    from drake_diff.model.equations import EquationsOfMotion

    honest = EquationsOfMotion.autodiff

    def one_percent_off(self, x, u):
        from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff

        result = honest(self, x, u)
        jacobian = np.array(ExtractGradient(result.reshape(-1, 1)))
        jacobian[row, column] *= 1.01
        return InitializeAutoDiff(ExtractValue(result.reshape(-1, 1)), jacobian).ravel()

    problem = swing_up()
    guess = np.linspace(0, 1, 21)[:, None] * [0.5, 2.5, 1.0, 2.0], np.full((20, 1), 3.0)
    monkeypatch.setattr(EquationsOfMotion, "autodiff", one_percent_off)
    solution = collocate(problem, solver="snopt", initial_guess=guess, max_iterations=3)
    names = (*problem.model.state_names, *problem.model.input_names)
    assert not solution.success
    assert "disagree" in [certificate.verdict for certificate in solution.certificates]
    assert f"d d({names[row]})/dt / d {names[column]}" in repr(solution)


@pytest.mark.parametrize(("row", "column"), [(2, 1), (3, 3), (3, 4)])
def test_an_expressions_derivative_that_is_one_percent_off_is_named(row, column, monkeypatch):
    """Repeat the check for the expressions of CasADi."""
    import casadi as ca

    from drake_diff.optimize.transcription import expressions as knot_functions

    honest = knot_functions.symbolic_plant

    def one_percent_off(*asked):
        found = honest(*asked)
        knot, factor = ca.SX.sym("knot", found.function.size1_in(0)), np.ones((4, 5))
        factor[row, column] = 1.01
        wrong = ca.Function("wrong", [knot], [found.jacobian(knot) * ca.DM(factor)])
        return dataclasses.replace(found, jacobian=wrong)

    guess = np.linspace(0, 1, 21)[:, None] * [0.5, 2.5, 1.0, 2.0], np.full((20, 1), 3.0)
    monkeypatch.setattr(knot_functions, "symbolic_plant", one_percent_off)
    problem = swing_up()
    solution = collocate(problem, initial_guess=guess, max_iterations=3)
    names = (*problem.model.state_names, *problem.model.input_names)
    assert not solution.success
    assert f"d d({names[row]})/dt / d {names[column]}" in repr(solution)

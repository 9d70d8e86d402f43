"""Shooting: exact gradients through Drake's steps, known optima, and only what is free moves."""

import math
import signal
import sys
import tracemalloc

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block
from helpers.problems import DOUBLE_INTEGRATOR, lqr
from helpers.table import each_row, slow_after
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff

import drake_diff as dd
from drake_diff._base.autodiff import WIDE, chain, chain_rows
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.optimize.program import Limits, Outcome
from drake_diff.optimize.shooting import (
    RolloutCost,
    ShootingVariables,
    final_sensitivity,
    limits_of_states,
    solve_shooting,
    state_sensitivities,
)
from drake_diff.optimize.solution import Status

SOLVERS = ("ipopt", "snopt")
EFFORT = dd.QuadraticCost(R=[[1.0]])


def shoot(problem, **options):
    return dd.solve(problem, method="shooting", **options)


def pendulum(**changes):
    fields = {"x0": [0, 0], "num_steps": 100, "running_cost": EFFORT, "x_goal": [np.pi, 0], **changes}
    return dd.Problem(dd.load_model(MODELS / "pendulum.urdf", time_step=0.02), **fields)


def test_the_sensitivities_of_a_block_are_the_closed_form():
    """x_N = x_0 + N h v_0 + h^2 sum (N - k) u_k / m and v_N = v_0 + h sum u_k / m."""
    h, count, mass = 0.1, 6, 2.5
    problem = dd.Problem(
        block(mass=mass, time_step=h),
        x0=[0, 0],
        num_steps=count,
        running_cost=EFFORT,
        optimize=("controls", "initial_state"),
        initial_state_mask=[False, True],
    )
    variables = ShootingVariables(problem)
    S = state_sensitivities(variables, np.linspace(-1, 1, 7))[-1]
    position = np.concatenate([[count * h], h**2 * (count - np.arange(count)) / mass])
    velocity = np.concatenate([[1.0], np.full(count, h / mass)])
    assert pytest.approx(np.array([position, velocity]), rel=1e-12) == S


def grown(running_cost, most):
    """Bytes that `most` iterations of a swing-up leave behind in Python, over those that 20 do; and how many rows."""
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.2)
    problem = dd.Problem(model, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], num_steps=10, running_cost=running_cost)
    xs, us = np.zeros((11, 4)), 0.5 * np.random.default_rng(0).standard_normal((10, 1))
    kept, rows = [], []
    for count in (most, 20, most):  # the first fills what is kept of a model, and the interpreter's caches
        if rows:
            tracemalloc.start()
        found = solve_shooting(problem, xs, us, solver="snopt", limits=Limits(count, 1e3, 1e-30), report=None)
        rows.append(len(found[0].iterations))
        kept.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    return kept[2] - kept[1], rows[2] - rows[1]


@pytest.mark.slow
def test_memory_is_flat_in_iterations():
    """A row of five numbers is 250 bytes, Drake 1.51 leaves some 400 more; one motion's derivatives are above 5000."""
    growth, rows = grown(EFFORT, 100)
    assert rows > 50
    assert growth < 2000 * rows
    seen = []
    growth, rows = grown(lambda x, u: (seen.append(np.array(x)), u @ u)[1], 30)
    assert growth > 2000 * rows > 0


@pytest.mark.parametrize("optimize", [("controls",), ("initial_state",), ("controls", "initial_state")])
def test_the_costs_gradient_is_its_central_difference_in_every_entry(optimize):
    """A pole in full swing; differences of 1e-6 of a cost near 1e2 leave 1e-7 of rounding and less of truncation."""
    problem = dd.Problem(
        dd.load_model(MODELS / "cart_pole.urdf", time_step=0.05),
        x0=[0.1, 0.5, -0.3, 1.0],
        num_steps=12,
        running_cost=lambda x, u: np.sin(x[1]) ** 2 + x[0] * u[0] + 0.1 * u[0] ** 2,
        final_cost=lambda x: np.cos(x[1]) + x[2] * x[3],
        optimize=optimize,
        us=np.linspace(-2, 3, 12)[:, None],
    )
    variables = ShootingVariables(problem)
    cost = RolloutCost(problem, variables)
    z = variables.pack(problem.x0, problem.us)
    value, gradient = cost.differentiate(z)
    assert value == pytest.approx(cost.value(z), rel=1e-13)
    differences = [(cost.value(z + d) - cost.value(z - d)) / 2e-6 for d in 1e-6 * np.eye(len(z))]
    assert gradient == pytest.approx(np.array(differences), rel=1e-6, abs=1e-7)


def test_the_last_sensitivity_is_had_without_all_the_others():
    """Of 300 states (2,) by 300 inputs all take 301 * 2 * 300 doubles, 1.4 MB, the last alone 5 kB and a copy."""
    problem = dd.Problem(block(time_step=0.01), x0=[0, 0], num_steps=300, x_goal=[1, 0])
    variables = ShootingVariables(problem)
    z = variables.pack(problem.x0, np.ones((300, 1)))
    every = state_sensitivities(variables, z)
    goal = limits_of_states(problem, variables)
    tracemalloc.start()
    last, by_goal = final_sensitivity(variables, z), goal.jacobian(z)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(last, every[-1], rtol=1e-13)  # the same products from the other end, rounded otherwise
    assert np.array_equal(by_goal, every[-1])
    # Symplectic Euler of 1 kg: d x_N / d u_k = h^2 (N - k), d v_N / d u_k = h.
    assert last == pytest.approx(np.array([1e-4 * np.arange(300, 0, -1), np.full(300, 0.01)]), rel=1e-9)
    assert peak < every.nbytes / 10


@each_row("solver", SOLVERS)
@each_row("count", [2, 4, 10, 20])
def test_the_block_moves_by_symplectic_eulers_optimum(solver, count):
    """The least effort of moving 1 kg by 1 m in 1 s is 12 / (1 - 1/N^2)."""
    model = block(time_step=1 / count)
    solution = shoot(dd.Problem(model, x0=[0, 0], x_goal=[1, 0], running_cost=EFFORT, num_steps=count), solver=solver)
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(12 / (1 - 1 / count**2), rel=1e-8)


@pytest.mark.parametrize("solver", SOLVERS)
def test_lqr_by_shooting_has_the_riccati_recursions_cost(solver):
    """From a given guess, so that iLQR does not help; 1e-12 since the cost is flat at its minimum."""
    problem = lqr(*DOUBLE_INTEGRATOR)
    count = problem.num_steps
    us = 10 * np.random.default_rng(5).standard_normal((count, 1))
    solution = shoot(problem, solver=solver, initial_guess=(np.zeros((count + 1, 2)), us))
    assert solution.success, solution.message
    assert solution.options["initial_guess"] == "given"
    assert solution.cost == pytest.approx(12.948481280713864, rel=1e-12)
    assert solution.us[0, 0] == pytest.approx(-2.61821518, abs=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
def test_initial_state_and_inputs_together_are_the_dense_kkt_solution(solver):
    """min sum_k (x'Qx + R u^2) + x_N'Qf x_N over v_0 and u with x_0 = 0.2 fixed and x_N = 1 required."""
    h, count, Q, R, Qf = 0.1, 8, np.diag([1.0, 0.5]), 0.2, np.diag([2.0, 3.0])
    A, B = np.array([[1, h], [0, 1]]), np.array([h**2, h])
    states = [(np.array([0.2, 0.0]), np.vstack([np.zeros(count + 1), np.eye(count + 1)[0]]))]  # x_k = a + S z
    for k in range(count):
        a, S = states[-1]
        states.append((A @ a, A @ S + np.outer(B, np.eye(count + 1)[k + 1])))
    weights = [Q] * count + [Qf]
    hessian = sum(S.T @ W @ S for W, (_, S) in zip(weights, states, strict=True))
    hessian += np.diag([0.0] + [R] * count)
    slope = sum(S.T @ W @ a for W, (a, S) in zip(weights, states, strict=True))
    a, S = states[-1]
    kkt = np.block([[hessian, S[:1].T], [S[:1], np.zeros((1, 1))]])
    z = np.linalg.solve(kkt, np.concatenate([-slope, [1 - a[0]]]))[:-1]
    constant = sum(a @ W @ a for W, (a, _) in zip(weights, states, strict=True))

    problem = dd.Problem(
        block(time_step=h),
        x0=[0.2, 0],
        num_steps=count,
        running_cost=dd.QuadraticCost(Q=Q / h, R=[[R / h]]),
        final_cost=dd.QuadraticCost(Q=Qf),
        x_goal=[1, math.nan],
        optimize=("controls", "initial_state"),
        initial_state_mask=[False, True],
    )
    solution = shoot(problem, solver=solver)
    assert solution.success, solution.message
    # The solver meets the goal to 1e-8, which its multiplier of 5 or so turns into cost.
    assert solution.cost == pytest.approx(z @ hessian @ z + 2 * slope @ z + constant, rel=1e-8)
    assert solution.xs[0, 0] == 0.2
    assert solution.xs[0, 1] == pytest.approx(z[0], abs=1e-5)
    assert solution.us[:, 0] == pytest.approx(z[1:], abs=1e-5)


@pytest.mark.parametrize("by", ["cost", "goal"])
def test_the_projectile_lands_at_six_metres(by):
    """300 steps of 0.01 s without drag: v_x = 6 / 3 = 2; nothing else of the initial state may move."""
    model = dd.load_model(MODELS / "projectile.sdf", time_step=0.01)
    x0 = model.default_state
    x0[11:13] = 0.3, 14.715
    free = np.arange(13) == 10
    goal = np.where(np.arange(13) == 4, 6.0, math.nan)
    aim = {"final_cost": lambda x: (x[4] - 6.0) ** 2} if by == "cost" else {"x_goal": goal}
    solution = dd.solve(
        dd.Problem(model, x0=x0, num_steps=300, optimize=("initial_state",), initial_state_mask=free, **aim)
    )
    assert solution.success, solution.message
    assert solution.method == "shooting"
    assert solution.xs[0, 10] == pytest.approx(2.0, abs=1e-6)
    assert solution.xs[-1, 4] == pytest.approx(6.0, abs=3e-6)
    assert np.array_equal(solution.xs[0][~free], x0[~free])
    assert solution.us.shape == (300, 0)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_speed_limit_and_a_force_limit_are_used_up(solver):
    """|u| <= 1 and v <= 0.5 on 1 kg for 1 s: x_N = 0.1 (0.1 + 0.2 + 0.3 + 0.4 + 6 * 0.5) = 0.4 at the most."""
    problem = dd.Problem(
        block(),
        x0=[0, 0],
        num_steps=10,
        final_cost=lambda x: (x[0] - 1) ** 2,
        bounds=dd.Bounds(x_upper=[9, 0.5], u_lower=[-1], u_upper=[1]),
    )
    solution = shoot(problem, solver=solver)
    assert solution.success, solution.message
    assert solution.xs[-1, 0] == pytest.approx(0.4, abs=1e-6)
    assert solution.bound_violation < 1e-6


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_pendulum_too_weak_and_too_late_is_infeasible(solver):
    """0.6 s and |u| <= 0.5, where hanging straight out takes 4.9: the energy of half a turn is out of reach."""
    solution = shoot(pendulum(num_steps=30, bounds=dd.Bounds(u_lower=[-0.5], u_upper=[0.5])), solver=solver)
    assert solution.status is Status.INFEASIBLE
    assert any(c.what == "goal" for c in solution.plan_checks.failing)
    assert np.all(np.isfinite(solution.xs))
    assert np.abs(solution.us).max() <= 0.5 + 1e-6


@pytest.mark.parametrize(("row", "column"), slow_after(2, [(0, 1), (1, 2), (0, 0), (0, 2), (1, 0), (1, 1)]))
def test_a_step_derivative_that_is_one_percent_off_is_named(row, column, monkeypatch):
    """Each entry of [A B] of the pendulum; the wrong one is used by the solver and by the certificate alike."""
    module = sys.modules["drake_diff.derivatives.sources"]
    honest = module._by_autodiff

    def one_percent_off(*args):
        jacobian = np.array(honest(*args))
        jacobian[row, column] *= 1.01
        return jacobian

    monkeypatch.setitem(module._ORDERS, "auto", (module.AUTODIFF, module.DIFFERENCES))
    monkeypatch.setattr(module, "_by_autodiff", one_percent_off)
    solution = shoot(pendulum(num_steps=20, x_goal=[0.3, 0]), max_iterations=50)
    assert not solution.success
    assert f"d {('hinge_q', 'hinge_w')[row]} / d {('hinge_q', 'hinge_w', 'motor')[column]}" in solution.message
    assert "disagree" in solution.message


def test_an_honest_derivative_lets_the_same_solve_succeed():
    assert shoot(pendulum(num_steps=20, x_goal=[0.3, 0]), max_iterations=50).success


def test_a_wrong_derivative_is_not_believed_by_ilqr(monkeypatch):
    module = sys.modules["drake_diff.derivatives.sources"]
    honest = module._by_autodiff
    monkeypatch.setitem(module._ORDERS, "auto", (module.AUTODIFF, module.DIFFERENCES))
    monkeypatch.setattr(module, "_by_autodiff", lambda *args: honest(*args) * [[1, 1, 1], [1, 1, 1.01]])
    problem = pendulum(x_goal=None, num_steps=20, final_cost=dd.QuadraticCost(Q=np.eye(2), x_ref=[1, 0]))
    solution = dd.solve(problem, method="ilqr")
    assert not solution.success
    assert "d hinge_w / d motor" in solution.message


def test_inputs_that_move_nothing_of_the_goal_end_as_no_gradient():
    """Two blocks, one pushed; the goal is the other's."""
    model = block(blocks=2, actuated=1)
    problem = dd.Problem(model, x0=np.zeros(4), num_steps=5, running_cost=EFFORT, x_goal=[math.nan, 1, math.nan, 0])
    solution = shoot(problem)
    assert solution.status is Status.NO_GRADIENT
    assert f"no variable moves {model.state_names[1]}, whose goal is not reached" in solution.message


def test_a_goal_that_nothing_moves_may_be_reached_already():
    """The neighbour is to stay where it is: that holds without any gradient."""
    problem = dd.Problem(
        block(blocks=2, actuated=1), x0=np.zeros(4), num_steps=5, running_cost=EFFORT, x_goal=[1, 0, 0, 0]
    )
    solution = shoot(problem)
    assert solution.success, solution.message
    assert solution.xs[-1] == pytest.approx([1, 0, 0, 0], abs=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
def test_ctrl_c_ends_it_with_a_motion(solver, monkeypatch):
    monkeypatch.setattr("drake_diff.optimize.program.REPORT_PERIOD", 0.0)
    before = signal.getsignal(signal.SIGINT)
    solution = shoot(pendulum(), solver=solver, progress=lambda line: signal.raise_signal(signal.SIGINT))
    assert solution.status is Status.INTERRUPTED
    assert solution.defect == 0.0
    assert np.all(np.isfinite(solution.us))
    assert signal.getsignal(signal.SIGINT) is before


def test_another_seed_starts_elsewhere_and_the_same_seed_in_the_same_place():
    def first_row(seed):
        return repr(shoot(pendulum(num_steps=20), seed=seed, max_iterations=1).iterations[0])

    assert first_row(1) == first_row(1)
    assert first_row(1) != first_row(2)


@pytest.mark.parametrize("effort", [math.inf, 20.0, 1e9])
def test_the_default_guess_is_near_zero_whatever_the_limit(effort):
    """1e9 N is a file's way of saying no limit: the guess's effort, h sum u^2, must not be 1e12."""
    problem = dd.Problem(block(effort=effort), x0=[0, 0], x_goal=[1, 0], running_cost=EFFORT, num_steps=10)
    assert shoot(problem).iterations[0].objective < 1.0


def test_fixed_inputs_act_while_the_initial_state_is_free():
    """x_N = x_0 + N h v_0 + u h^2 N (N + 1) / 2 with u = 0.5 held: v_0 = 1 - 0.5 * 0.55 reaches 1 after 1 s."""
    problem = dd.Problem(
        block(),
        x0=[0, 0],
        num_steps=10,
        x_goal=[1, math.nan],
        us=np.full((10, 1), 0.5),
        optimize=("initial_state",),
        initial_state_mask=[False, True],
    )
    solution = shoot(problem)
    assert solution.success, solution.message
    assert solution.xs[0] == pytest.approx([0, 0.725], abs=1e-6)
    assert np.array_equal(solution.us, np.full((10, 1), 0.5))


@pytest.mark.parametrize("error", slow_after(1, [GradientError, SimulationError]))
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_point_without_a_derivative_is_a_step_that_was_too_long(monkeypatch, solver, error):
    """A swing-up whose trial points go faster than guess and optimum ever do: halfway there derivatives end."""
    true, limit, fastest = ShootingVariables.linearization, [np.inf], []

    def linearization(self, z):
        found = true(self, z)
        fastest.append(max(abs(d.x_next[1]) for d in found))
        if fastest[-1] > limit[0]:
            raise error("no derivative here")
        return found

    monkeypatch.setattr(ShootingVariables, "linearization", linearization)
    problem = pendulum(num_steps=60)
    free = shoot(problem, solver=solver)
    needed = np.abs(free.xs[:, 1]).max()
    assert max(fastest) > 1.2 * needed
    limit[0] = (needed + max(fastest)) / 2
    solution = shoot(problem, solver=solver)
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(free.cost, rel=1e-6)
    assert "backed off from points that were refused" in solution.solver_message
    assert solution.solver_message.endswith("the last: no derivative here")
    assert ("started again" in solution.solver_message) == (solver == "snopt")  # IPOPT's own line search is told


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_guess_without_a_derivative_is_the_end(monkeypatch, solver):
    def linearization(self, z):
        raise GradientError("no derivative here")

    monkeypatch.setattr(ShootingVariables, "linearization", linearization)
    guess, limits = (np.zeros((11, 2)), np.zeros((10, 1))), Limits(50, 60.0, 1e-8)
    result = solve_shooting(pendulum(num_steps=10), *guess, solver=solver, limits=limits, report=None)[0]
    assert result.outcome is Outcome.NO_GRADIENT
    assert "no derivative here" in result.message


@each_row("count", [3, WIDE + 1])
def test_the_chain_rule_by_few_and_many_variables(count):
    """Of many the identity is told row by row; what is nearly the identity must not be taken for it."""
    rows = np.arange(2.0 * count).reshape(2, count)
    nearly = np.eye(count)
    nearly[-1, 0] = 0.5
    for seed in (np.eye(count), nearly, 2 * np.eye(count), np.ones((count, 1))):
        z = InitializeAutoDiff(value=np.zeros((count, 1)), gradient=seed).ravel()
        assert np.array_equal(ExtractGradient(chain_rows(np.zeros(2), rows, z).reshape(-1, 1)), rows @ seed)
        assert np.array_equal(chain(1.0, rows[1], z).derivatives(), rows[1] @ seed)

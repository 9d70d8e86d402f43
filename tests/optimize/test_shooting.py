"""Tests of shooting: exact gradients through Drake's steps, known optima, and fixed variables."""

import math
import signal
import sys

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block
from helpers.table import each_row, slow_after
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff

import drake_diff as dd
from drake_diff._base.autodiff import chain, chain_rows
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.optimize.problem.coupling import Coupling
from drake_diff.optimize.problem.design import ShootingVariables, final_sensitivity
from drake_diff.optimize.program import Limits
from drake_diff.optimize.solution import Status
from drake_diff.optimize.transcription import steps

pytestmark = pytest.mark.solve

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
    S = final_sensitivity(ShootingVariables(problem), np.linspace(-1, 1, 7))
    position = np.concatenate([[count * h], h**2 * (count - np.arange(count)) / mass])
    velocity = np.concatenate([[1.0], np.full(count, h / mass)])
    assert pytest.approx(np.array([position, velocity]), rel=1e-12) == S


def everything(**changes):
    """Return 30 steps with a free initial speed, free inputs and damping, and limits of every kind."""
    given = {
        "num_steps": 30,
        "final_cost": lambda x: np.cos(x[0]) + x[1] ** 2,
        "optimize": ("controls", "initial_state", "parameters"),
        "initial_state_mask": [False, True],
        "parameters": ["hinge.damping"],
        "bounds": dd.Bounds(x_upper=[9, 4]),
        "waypoints": {10: [0.3, np.nan], 14: [np.nan, 0.2]},
        "constraints": [
            dd.Constraint(lambda x, u: u[0] * x[1], upper=5),
            dd.Constraint(lambda x: np.sin(x[0]), lower=-0.9, upper=0.9, knots=[0, 9, 10, -1]),
        ],
        "couplings": [Coupling(lambda a, b, u, w: a[0] * b[1] + u[0] * w[0], knots=(3, 8), upper=1.0, name="joined")],
    }
    return pendulum(**given | changes)


@pytest.mark.parametrize("error", [GradientError, SimulationError])
def test_a_point_without_a_derivative_is_a_step_that_was_too_long(monkeypatch, error):
    """The trial points of a swing-up are faster than guess and optimum. Derivatives fail above half of this excess."""
    true, limit, fastest = steps.Steps.along, [np.inf], []

    def some(self, points):
        found = true(self, points)
        fastest.append(np.abs(points[:, 1]).max())
        if fastest[-1] > limit[0]:
            raise error("no derivative here")
        return found

    monkeypatch.setattr(steps.Steps, "along", some)
    problem = pendulum(num_steps=60)
    random = np.random.default_rng(0)
    guess = np.zeros((61, 2)), 5 * random.standard_normal((60, 1))
    free = shoot(problem, initial_guess=guess)
    needed = np.abs(free.xs[:, 1]).max()
    assert max(fastest) > 1.02 * needed
    limit[0] = (needed + max(fastest)) / 2
    solution = shoot(problem, initial_guess=guess)
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(free.cost, rel=1e-6)
    assert "that could not be stepped or differentiated, the last: no derivative here" in solution.solver_message


def test_a_guess_without_a_derivative_is_the_end(monkeypatch):
    def none(self, z):
        raise GradientError("no derivative here")

    monkeypatch.setattr(steps.Steps, "along", none)
    guess, limits = (np.zeros((11, 2)), np.zeros((10, 1))), Limits(50, 60.0, 1e-8)
    with pytest.raises(GradientError, match="no derivative here"):
        steps.solve_shooting(pendulum(num_steps=10), *guess, limits=limits, report=None)


@pytest.mark.slow
def test_an_acrobot_swings_up_from_rest():
    """At half the step the acrobot falls over open loop."""
    model = dd.load_model(MODELS / "acrobot.xml", time_step=0.05)
    solution = shoot(dd.Problem(model, x0=np.zeros(4), x_goal=[np.pi, 0, 0, 0], num_steps=100, running_cost=EFFORT))
    assert solution.status in (Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED), solution.message
    assert not solution.plan_checks.failing
    assert solution.goal_error < 1e-7
    assert solution.defect < 1e-7


@pytest.mark.parametrize("limit", [None, 8.0])
def test_a_cart_pole_swings_up(limit):
    """The cost is 67.095 without a limit and at most 41.234 in 3 s with it, by fatrop on the same program."""
    model, bounds = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.04), None
    if limit is not None:
        bounds = dd.Bounds(u_lower=[-limit], u_upper=[limit])
    count, cost = (50, 67.0951254) if limit is None else (75, 41.2331700)
    goal = [0, np.pi, 0, 0]
    problem = dd.Problem(model, x0=np.zeros(4), x_goal=goal, num_steps=count, running_cost=EFFORT, bounds=bounds)
    solution = shoot(problem)
    assert not solution.plan_checks.failing
    assert solution.cost <= cost * (1 + 1e-7)
    assert solution.goal_error < 1e-7


@pytest.mark.slow
@pytest.mark.long
def test_all_of_it_together_is_solved():
    solution = shoot(everything(x_goal=None))
    assert solution.success, solution.message
    assert solution.xs[10, 0] == pytest.approx(0.3, abs=1e-6)


def test_states_that_no_step_joins_are_told_by_the_defect():
    solution = shoot(pendulum(), max_iterations=1)
    assert solution.status is Status.ITERATION_LIMIT
    assert solution.defect > 1e-5


@each_row("count", [2, 4, 10, 20])
def test_the_block_moves_by_symplectic_eulers_optimum(count):
    """The least effort of moving 1 kg by 1 m in 1 s is 12 / (1 - 1/N^2)."""
    model = block(time_step=1 / count)
    solution = shoot(dd.Problem(model, x0=[0, 0], x_goal=[1, 0], running_cost=EFFORT, num_steps=count))
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(12 / (1 - 1 / count**2), rel=1e-8)


def test_initial_state_and_inputs_together_are_the_dense_kkt_solution():
    """Solve min sum_k (x'Qx + R u^2) + x_N'Qf x_N over v_0 and u with x_0 = 0.2 fixed and x_N = 1 required."""
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
    solution = shoot(problem)
    assert solution.success, solution.message
    # The solver meets the goal to 1e-8. The cost changes by this times a multiplier of about 5.
    assert solution.cost == pytest.approx(z @ hessian @ z + 2 * slope @ z + constant, rel=1e-8)
    assert solution.xs[0, 0] == 0.2
    assert solution.xs[0, 1] == pytest.approx(z[0], abs=1e-5)
    assert solution.us[:, 0] == pytest.approx(z[1:], abs=1e-5)


@pytest.mark.parametrize("by", ["cost", "goal"])
def test_the_projectile_lands_at_six_metres(by):
    """300 steps of 0.01 s without drag need v_x = 6 / 3 = 2. No other entry of the initial state may move."""
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


@pytest.mark.parametrize(("row", "column"), slow_after(2, [(0, 1), (1, 2), (0, 0), (0, 2), (1, 0), (1, 1)]))
def test_a_step_derivative_that_is_one_percent_off_is_named(row, column, monkeypatch):
    """Test each entry of the pendulum's [A B]. The solver and the certificate both use the wrong entry."""
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
    assert f"d {('hinge_q', 'hinge_w')[row]} / d {('hinge_q', 'hinge_w', 'motor')[column]}" in repr(solution)
    assert "disagree" in repr(solution)


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
    assert "d hinge_w / d motor" in repr(solution)


def test_inputs_that_move_nothing_of_the_goal_end_as_no_gradient():
    """Only one of two blocks is pushed, and the goal is for the other one."""
    model = block(blocks=2, actuated=1)
    problem = dd.Problem(model, x0=np.zeros(4), num_steps=5, running_cost=EFFORT, x_goal=[math.nan, 1, math.nan, 0])
    solution = shoot(problem)
    assert solution.status is Status.NO_GRADIENT
    assert f"no variable moves {model.state_names[1]}, whose goal is not reached" in repr(solution)


def test_ctrl_c_ends_it_with_a_motion(monkeypatch):
    monkeypatch.setattr("drake_diff.optimize.program.REPORT_PERIOD", 0.0)
    before = signal.getsignal(signal.SIGINT)
    solution = shoot(pendulum(), progress=lambda line: signal.raise_signal(signal.SIGINT))
    assert solution.status is Status.INTERRUPTED
    assert np.isfinite(solution.defect)
    assert np.all(np.isfinite(solution.us))
    assert signal.getsignal(signal.SIGINT) is before


def test_another_seed_starts_elsewhere_and_the_same_seed_in_the_same_place():
    def first_row(seed):
        return repr(shoot(pendulum(num_steps=20), seed=seed, max_iterations=1).iterations[0])

    assert first_row(1) == first_row(1)
    assert first_row(1) != first_row(2)


@pytest.mark.parametrize("method", ["shooting", "ilqr"])
def test_fixed_inputs_act_while_the_initial_state_is_free(method):
    """x_N = x_0 + N h v_0 + u h^2 N (N + 1) / 2 for a fixed u = 0.5. v_0 = 1 - 0.5 * 0.55 reaches 1 after 1 s."""
    problem = dd.Problem(
        block(),
        x0=[0, 0],
        num_steps=10,
        x_goal=[1, math.nan],
        us=np.full((10, 1), 0.5),
        optimize=("initial_state",),
        initial_state_mask=[False, True],
    )
    solution = dd.solve(problem, method=method)
    assert solution.success, solution.message
    assert solution.xs[0] == pytest.approx([0, 0.725], abs=1e-6)
    assert np.array_equal(solution.us, np.full((10, 1), 0.5))


@each_row("count", [3, 1001])
def test_the_chain_rule_by_few_and_many_variables(count):
    """A matrix that is nearly the identity must not be treated as the identity."""
    rows = np.arange(2.0 * count).reshape(2, count)
    nearly = np.eye(count)
    nearly[-1, 0] = 0.5
    for seed in (np.eye(count), nearly, 2 * np.eye(count), np.ones((count, 1))):
        z = InitializeAutoDiff(value=np.zeros((count, 1)), gradient=seed).ravel()
        assert np.array_equal(ExtractGradient(chain_rows(np.zeros(2), rows, z).reshape(-1, 1)), rows @ seed)
        assert np.array_equal(chain(1.0, rows[1], z).derivatives(), rows[1] @ seed)

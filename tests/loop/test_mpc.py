"""MPC equals Riccati's recursion and Drake's regulator, swings up a pushed cart-pole, and handles failed solves."""

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block
from helpers.problems import DOUBLE_INTEGRATOR, OTHERS, lqr, riccati
from helpers.table import each_row
from pydrake.systems.controllers import DiscreteTimeLinearQuadraticRegulator

import drake_diff as dd
from drake_diff.exceptions import GradientError, InputError
from drake_diff.model.step import advance
from drake_diff.optimize.replay import regulator_weights

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])


def straight(problem):
    """Return a guess that is no motion. With linear dynamics and quadratic costs, any guess is sufficient."""
    return np.tile(problem.x0, (problem.num_steps + 1, 1)), np.zeros((problem.num_steps, 1))


def swing_up():
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.02)
    return dd.Problem(model, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], num_steps=100, running_cost=EFFORT)


@pytest.fixture(scope="module")
def swung():
    return dd.solve(swing_up(), restarts=0)


@each_row("case", OTHERS)
@each_row("horizon", [1, 4, 1000])
def test_it_is_the_remaining_horizons_lqr_whatever_its_own_horizon(case, horizon):
    """The states are far from any plan. A tolerance of 1e-9 for inputs of about 5 is rounding of dozens of terms."""
    problem, gains = lqr(*case), riccati(*case)[1]
    mpc = dd.loop.MPC(problem, horizon=horizon, plan=straight(problem))
    random = np.random.default_rng(0)
    for k, K in enumerate(gains):
        x = random.standard_normal(2)
        assert mpc(x, k * case[0]) == pytest.approx(-K @ x, abs=1e-9)
        assert mpc.status == "ok"


@pytest.mark.parametrize("horizon", [1, 7])
def test_with_the_infinite_cost_to_go_as_its_final_cost_it_is_lqr_for_ever(horizon):
    h, count, Q, R, _ = DOUBLE_INTEGRATOR
    A, B = np.array([[1, h], [0, 1]]), np.array([[h**2], [h]])
    K, P = DiscreteTimeLinearQuadraticRegulator(A, B, Q, np.array([[R]]))
    problem = lqr(h, count, Q, R, P)
    mpc = dd.loop.MPC(problem, horizon=horizon, plan=straight(problem))
    for k in (0, 3, count - 1, count, count + 1, 5 * count):
        x = np.array([1.0, -0.3 * k])
        assert mpc(x, k * h) == pytest.approx(-K @ x, abs=1e-9 * (1 + k))


def test_after_the_end_the_goal_is_stayed_at_by_lqr():
    problem = dd.Problem(block(time_step=0.1), x0=[1, 0], x_goal=[0, 0], num_steps=20, running_cost=EFFORT)
    plan = dd.solve(problem, method="ilqr")
    mpc = dd.loop.MPC(problem, horizon=5, plan=plan)
    assert repr(mpc) == f"MPC of {problem.name}: horizon 5 steps, 0.5 s, 1 step of optimization a call"
    A, B = np.array([[1, 0.1], [0, 1]]), np.array([[0.01], [0.1]])
    K, _ = DiscreteTimeLinearQuadraticRegulator(A, B, *regulator_weights(plan.plan, plan.us)[:2])
    for k in (20, 21, 90):
        assert mpc([0.3, 0.1], 0.1 * k) == pytest.approx(-K @ [0.3, 0.1], abs=1e-9)


def test_a_goal_that_gravity_pulls_away_from_is_stayed_at_by_the_input_that_holds_it():
    """The pendulum of 1 kg and 0.5 m is horizontal under m g l sin q = 9.81 / 2 N m. LQR's tolerance is 1e-6."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi / 2, 0], num_steps=50, running_cost=EFFORT)
    mpc = dd.loop.MPC(problem, horizon=20)
    assert mpc([np.pi / 2, 0], 10.0) == pytest.approx(9.81 / 2, abs=1e-6)
    bounds = dd.Bounds(u_lower=[-4.0], u_upper=[4.0])
    weak = dd.Problem(model, x0=[0, 0], x_goal=[np.pi / 2, 0], num_steps=50, running_cost=EFFORT, bounds=bounds)
    with pytest.raises(InputError, match=r"a fixed point with u = \[4\.9"):
        dd.loop.MPC(weak, horizon=20, plan=(np.zeros((51, 2)), np.zeros((50, 1))))


@pytest.mark.slow
def test_the_pushed_cart_pole_ends_upright(swung):
    """One push acts during the swing-up, after which the open loop fails, and one when the pole is upright."""
    problem, pushes = swung.problem, [dd.loop.Push("pole", [1.5, 0, 0], 0.8), dd.loop.Push("pole", [-0.5, 0, 0], 2.6)]
    runs = {}
    for name, controller in (
        ("mpc", dd.loop.MPC(problem, horizon=30, plan=swung)),
        ("open loop", dd.loop.OpenLoop(swung.us, 0.02)),
    ):
        runs[name] = dd.loop.closed_loop(problem.model, controller, problem.x0, 300, dd.loop.Loop(pushes=pushes))
    end = runs["mpc"].motion.xs[-1]
    assert np.abs(end - [1, np.pi, 0, 0]).max() < 0.02  # 3.4 s after the push; the cart returns slowly
    assert np.abs(runs["open loop"].motion.xs[-1] - end).max() > 1
    assert np.abs(runs["mpc"].commands).max() <= 20
    assert np.abs(runs["mpc"].commands).max() > 19.9  # the bound is active, where Drake's derivative is 0
    assert runs["mpc"].ended == ""


def test_between_two_plans_the_first_ones_inputs_are_given(swung):
    """Only steps 0, 3 and 6 use the state, which is the planned one. The inputs of two minima of a cost of 59 that are
    equal to 1e-16 may differ by 1e-4 of 3 N."""
    mpc = dd.loop.MPC(swung.problem, horizon=30, plan=swung, replan_every=3)
    xs, us = mpc._reference.xs, mpc._reference.us
    given = [mpc(xs[k] + (0.1 if k % 3 else 0.0), 0.02 * k) for k in range(7)]
    np.testing.assert_allclose(np.array(given), us[:7], atol=1e-4)
    assert not np.allclose(mpc(xs[9] + 0.1, 0.18), us[9], atol=1e-2)


def test_a_refused_solve_is_told_and_the_last_plan_followed(swung, monkeypatch):
    mpc = dd.loop.MPC(swung.problem, horizon=30, plan=swung)
    x1 = advance(swung.problem.model.double, np.zeros(4), mpc(np.zeros(4), 0.0))
    planned, reference = np.array(mpc.plan[1]), mpc._reference
    with monkeypatch.context() as patch:

        def refuse(*_, **__):
            raise GradientError("this far and no further")

        patch.setattr("drake_diff.optimize.realtime.step.linearize", refuse)
        for k in (1, 2, 35):
            command = mpc(x1, 0.02 * k)
            assert mpc.status == "the last plan is followed further: GradientError: this far and no further"
            assert np.array_equal(command, planned[k] if k < 30 else reference.us[k])
            assert mpc.gains is None  # no step was solved
    assert mpc(np.full(4, np.nan), 0.02 * 36) == pytest.approx(reference.us[36])
    assert "NonFiniteError" in mpc.status
    assert mpc(reference.xs[37], 0.02 * 37) == pytest.approx(reference.us[37], abs=1e-4)
    assert mpc.status == "ok"


@each_row(
    "changes, options, said",
    [
        ({}, {"horizon": 0}, "horizon"),
        ({}, {"replan_every": 0}, "replan_every"),
        ({}, {"iterations": 0}, "iterations"),
        ({}, {"plan": "a plan"}, "plan"),
        ({}, {"plan": (np.zeros((5, 2)), np.zeros((20, 1)))}, "plan xs"),
        ({}, {"budget": 0.0}, "budget"),
        ({"us": np.zeros((20, 1)), "optimize": ("initial_state",)}, {}, "optimize"),
        ({"parameters": ["block_0.mass"]}, {}, "parameters"),
        ({"trajectory_cost": lambda xs, us: xs[0, 0]}, {}, "trajectory_cost"),
        ({"couplings": dd.optimize.InputRate(5.0)}, {}, "couplings"),
        ({"horizon": (1.0, 3.0)}, {}, "horizon"),
        ({"bounds": dd.Bounds(x_lower=[-2.0, -0.01])}, {}, r"x.* gives way by"),
        ({"x_goal": [0, 1]}, {}, "fixed point"),
        ({"optimize": ("controls", "initial_state"), "initial_state_mask": [True, False]}, {}, "optimize"),
    ],
)
def test_what_it_cannot_do_is_refused_at_once(changes, options, said):
    fields = {"x0": [1, 0], "x_goal": [0, 0], "num_steps": 20, "running_cost": EFFORT, **changes}
    problem = dd.Problem(block(time_step=0.1), **fields)
    with pytest.raises(InputError, match=said):
        dd.loop.MPC(problem, **{"horizon": 5, "plan": straight(problem), **options})

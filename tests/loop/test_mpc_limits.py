"""Limits in MPC as in another solver's optimum, relaxed limits, late answers, wrong derivatives, and contact."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block, box_on_the_ground
from helpers.problems import DOUBLE_INTEGRATOR, lqr
from helpers.table import each_row
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SolverOptions

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.loop import MPC, Loop, Push, closed_loop
from drake_diff.optimize.realtime import step as realtime_step

pytestmark = pytest.mark.solve

H, COUNT, Q, R, QF = DOUBLE_INTEGRATOR
A, B = np.array([[1, H], [0, 1]]), np.array([[H**2], [H]])
EFFORT = dd.QuadraticCost(R=[[1.0]])


def straight(problem):
    return np.tile(problem.x0, (problem.num_steps + 1, 1)), np.zeros((problem.num_steps, problem.nu))


def by_clarabel(x0, count, *, u_max, v_max, price=None):
    """Solve for us (count,), the cost, and the excess of |v| over v_max (count,) of the double integrator.

    With a price, the limit of the speed may be violated.
    """
    program = MathematicalProgram()
    us, xs, slacks = (program.NewContinuousVariables(count, n, name) for n, name in ((1, "u"), (2, "x"), (1, "s")))
    rows, speed = np.hstack([np.eye(2), -A, -B]), np.array([[1.0, -1.0]])
    for k in range(count):
        if k:
            program.AddLinearEqualityConstraint(rows, np.zeros(2), np.array([*xs[k], *xs[k - 1], *us[k]]))
        else:
            program.AddLinearEqualityConstraint(rows[:, [0, 1, 4]], A @ np.asarray(x0), np.array([*xs[k], *us[k]]))
        program.AddQuadraticCost(2 * (QF if k == count - 1 else Q), np.zeros(2), xs[k], is_convex=True)
        program.AddLinearConstraint(speed, [-np.inf], [v_max], np.array([xs[k, 1], slacks[k, 0]]))
        program.AddLinearConstraint(np.array([[-1.0, -1.0]]), [-np.inf], [v_max], np.array([xs[k, 1], slacks[k, 0]]))
    program.AddQuadraticCost(2 * R * np.eye(count), np.zeros(count), us[:, 0], is_convex=True)
    program.AddBoundingBoxConstraint(-u_max, u_max, us)
    program.AddBoundingBoxConstraint(0, 0 if price is None else np.inf, slacks)
    program.AddLinearCost(np.full(count, 0.0 if price is None else price), slacks[:, 0])
    options = SolverOptions()
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
        options.SetOption(ClarabelSolver.id(), name, 1e-13)
    found = ClarabelSolver().Solve(program, None, options)
    assert found.is_success()
    cost = found.get_optimal_cost() + np.asarray(x0) @ Q @ np.asarray(x0)
    return found.GetSolution(us).ravel(), cost, found.GetSolution(slacks).ravel()


def limited(u_max=1.0, v_max=0.4):
    problem = lqr(*DOUBLE_INTEGRATOR, x0=[0, 0])
    bounds = dd.Bounds(x_lower=[-np.inf, -v_max], x_upper=[np.inf, v_max], u_lower=[-u_max], u_upper=[u_max])
    return replace(problem, bounds=bounds)


def test_with_limits_that_hold_it_is_the_programs_solution():
    """Inputs up to 1 agree to 1e-6: Clarabel's tolerance is 1e-8, of a cost that is flat at its minimum."""
    problem, random, held = limited(), np.random.default_rng(0), 0
    mpc = MPC(problem, horizon=COUNT, plan=straight(problem))
    for _ in range(20):
        x0 = np.array([random.uniform(-2, 2), random.uniform(-0.4, 0.4)])
        mpc.start(x0)
        mpc(x0, 0.0)
        us, _, _ = by_clarabel(x0, COUNT, u_max=1.0, v_max=0.4)
        np.testing.assert_allclose(mpc.plan[1][:, 0], us, atol=1e-6)
        assert mpc.status == "ok"
        held += int(np.any(np.abs(mpc.plan[0][1:, 1]) > 0.4 - 1e-6))
    assert held > 10  # the limit of the speed is active in most solutions


@each_row("x0", [[1.2, -0.15], [-0.9, 0.1]])
def test_gains_and_value_are_the_derivatives_of_the_programs_solution_by_its_first_state(x0):
    """The reference is central differences over 1e-3 of Clarabel's solutions with the same active limits."""
    problem = limited()
    mpc = MPC(problem, horizon=COUNT, plan=straight(problem))
    x0, d, with_limits = np.array(x0), 1e-3, {"u_max": 1.0, "v_max": 0.4}
    mpc.start(x0)
    mpc(x0, 0.0)
    found = [[by_clarabel(x0 + s * d * e, COUNT, **with_limits) for s in (1, -1)] for e in np.eye(2)]
    slope = np.array([(plus[1] - minus[1]) / (2 * d) for plus, minus in found])
    us = np.array([(plus[0] - minus[0]) / (2 * d) for plus, minus in found]).T
    middle = by_clarabel(x0, COUNT, **with_limits)[1]
    curvature = np.array([(plus[1] + minus[1] - 2 * middle) / d**2 for plus, minus in found])
    assert mpc.value.gradient == pytest.approx(slope, abs=1e-5)
    assert np.diag(mpc.value.hessian) == pytest.approx(curvature, rel=1e-4)
    moved, x = [], np.eye(2)
    for k, K in enumerate(mpc.gains):
        moved.append(K @ x)
        x = A @ x + B @ moved[k]
    assert np.any(np.abs(mpc.plan[1]) > 1 - 1e-6)
    assert np.any(np.abs(mpc.plan[0][1:, 1]) > 0.4 - 1e-6)
    np.testing.assert_allclose(np.array(moved)[:, 0], us, atol=1e-3)  # gains are about 10


def test_what_cannot_be_kept_gives_way_by_as_little_as_it_can_and_is_told():
    """At 0.6 m/s with |u| <= 1, the next speed is at least 0.5 m/s, which is 0.1 m/s beyond its limit."""
    problem = limited()
    mpc = MPC(problem, horizon=COUNT, plan=straight(problem))
    assert mpc([-1.0, 0.6], 0.0) == pytest.approx([-1.0], abs=1e-6)
    name = problem.state_names[1]
    assert mpc.status == f"{name} gives way by 0.1 at 0.1 s"
    us, _, slacks = by_clarabel([-1.0, 0.6], COUNT, u_max=1.0, v_max=0.4, price=1e4)
    np.testing.assert_allclose(mpc.plan[1][:, 0], us, atol=1e-4)
    assert slacks[0] == pytest.approx(0.1, abs=1e-6)
    mpc([-1.0, 0.3], 0.1)
    assert mpc.status == "ok"


def test_a_limit_that_the_motion_need_not_pass_is_never_traded_for_its_cost():
    """At 20 m from the goal, the cost of a state is 400 times larger, but the limit of the speed is satisfied."""
    problem = limited()
    mpc = MPC(problem, horizon=COUNT, plan=straight(problem))
    mpc.start([20.0, 0.0])
    mpc([20.0, 0.0], 0.0)
    assert np.abs(mpc.plan[0][1:, 1]).max() < 0.4 + 1e-6
    assert mpc.status == "ok"


@pytest.mark.slow
@each_row("horizon", [6, 40])
def test_a_waypoint_is_met_at_the_problems_own_knot(horizon):
    problem = dd.Problem(
        block(time_step=0.1), x0=[0, 0], x_goal=[0, 0], num_steps=30, running_cost=EFFORT,
        waypoints={15: [1.0, np.nan]},
    )  # fmt: skip
    mpc = MPC(problem, horizon=horizon)
    pushes = [Push("block_0", [0.3, 0, 0], 0.3), Push("block_0", [-0.2, 0, 0], 2.0)]
    run = closed_loop(problem.model, mpc, problem.x0, 40, Loop(pushes=pushes))
    assert run.motion.xs[15, 0] == pytest.approx(1.0, abs=1e-5)
    assert np.abs(run.motion.xs[-1]).max() < 5e-3
    assert set(run.controller_status) == {"ok"}


def test_constraints_of_states_and_inputs_are_kept_at_their_knots():
    """The power is limited at all knots, and the speed only at knots 5 to 8."""
    power = dd.Constraint(lambda x, u: x[1] * u[0], lower=-0.2, upper=0.2, name="power")
    slow = dd.Constraint(lambda x: x[1], upper=0.15, knots=[5, 6, 7, 8], name="slow")
    problem = dd.Problem(
        block(time_step=0.1), x0=[0, 0], x_goal=[1, 0], num_steps=30, running_cost=EFFORT, constraints=[power, slow]
    )
    run = closed_loop(problem.model, MPC(problem, horizon=12), problem.x0, 40)
    xs, us = run.motion.xs, run.applied
    assert np.abs(xs[:-1, 1] * us[:, 0]).max() < 0.2 + 1e-3  # one real-time iteration from the plan's optimum
    assert xs[5:9, 1].max() < 0.15 + 1e-5
    assert xs[10:20, 1].max() > 0.3
    assert np.abs(xs[-1] - [1, 0]).max() < 1e-3


@pytest.mark.slow
def test_a_goal_is_stayed_at_past_an_obstacle():
    """A double pendulum reaches its goal past a ball that the motion without an obstacle would enter."""
    model = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.02)
    goals = [dd.SphereObstacle([0.5, 0.0, -0.75], 0.1, margin=0.02, name="ball")]
    end = [1.2, 0.3, 0.0, 0.0]
    problem = dd.Problem(model, x0=[0, 0, 0, 0], x_goal=end, num_steps=50, goals=goals,
                         running_cost=dd.QuadraticCost(R=0.01 * np.eye(2)))  # fmt: skip
    mpc = MPC(problem, horizon=15, plan=dd.solve(problem))
    pushes = [Push("lower", [0.05, 0, 0.05], 0.3)]
    run = closed_loop(model, mpc, problem.x0, 70, Loop(pushes=pushes))
    clear = problem.kept_goals[0]
    assert np.abs(run.motion.xs[-1] - end).max() < 1e-2
    assert np.max(clear.lacking(run.motion.xs)) < 0.02  # the margin may be violated, but the ball is not entered


def test_a_late_answer_is_not_used_and_the_last_plan_goes_on():
    problem = limited()

    def ticking(taken):
        """Return a clock, and a function that advances it by the next duration in `taken`."""
        now = [0.0]
        rows = iter(taken)

        def clock():
            return now[0]

        def spend():
            now[0] += next(rows)

        return clock, spend

    clock, spend = ticking([0.01, 0.5, 0.01])
    mpc = MPC(problem, horizon=10, plan=straight(problem), budget=0.1, clock=clock)
    take, x = realtime_step.take_step, np.array([1.0, 0.0])

    def slow(*given):
        spend()
        return take(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("drake_diff.loop.mpc.take_step", slow)
        first = mpc(x, 0.0)
        planned = np.array(mpc.plan[1])
        assert first == pytest.approx(planned[0])
        assert mpc(np.array([0.5, 0.3]), 0.1) == pytest.approx(planned[1])
        assert mpc.status == "late: 0.5 s, expected at most 0.1 s"
        assert mpc.missed == 1
        mpc(np.array([0.5, 0.3]), 0.2)
    assert mpc.status == "ok"
    assert mpc.latencies == pytest.approx([0.01, 0.5, 0.01])
    mpc.start(x)
    assert mpc.missed == 0
    assert len(mpc.latencies) == 0


@pytest.mark.slow
@each_row("wrong", ["sign", "half", "transposed"])
def test_wrong_derivatives_are_seen(wrong):
    """With a wrong sign or half the size of B, or a transposed A, the plant does not move as predicted."""
    model = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0, 0, 0], x_goal=[1.0, 0.5, 0, 0], num_steps=50,
                         running_cost=dd.QuadraticCost(R=0.01 * np.eye(2)))  # fmt: skip
    mpc = MPC(problem, horizon=20)
    true = realtime_step.linearize

    def planted(*given, **more):
        a, b, methods = true(*given, **more)
        return *{"sign": (a, -b), "half": (a, 0.5 * b), "transposed": (a.swapaxes(1, 2), b)}[wrong], methods

    x = mpc._reference.xs[10] + np.array([0.1, -0.1, 0.3, 0.2])
    mpc(x, 0.2)
    assert mpc.status == "ok"
    mpc.start(x)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("drake_diff.optimize.realtime.step.linearize", planted)
        mpc(x, 0.2)
    assert mpc.status != "ok"
    assert "derivatives" in mpc.status


def test_it_starts_and_stays_in_contact():
    """Contact alone supports a box of 2 kg on the ground. The actuator's bounds allow lifting the box."""
    model = box_on_the_ground(pusher=True)
    x0 = dd.rollout(model, model.default_state, np.zeros((1000, 1))).xs[-1]
    cost = dd.QuadraticCost(Q=np.diag([1e4, 1.0]), R=[[1e-4]], x_ref=x0)
    problem = dd.Problem(model, x0=x0, num_steps=40, running_cost=cost,
                         bounds=dd.Bounds(u_lower=[-30], u_upper=[30]))  # fmt: skip
    mpc = MPC(problem, horizon=10, plan=(np.tile(x0, (41, 1)), np.zeros((40, 1))))
    run = closed_loop(model, mpc, x0, 40, Loop(pushes=[Push("box", [0, 0, -0.05], 0.1)]))
    assert run.ended == ""
    assert set(run.controller_status) == {"ok"}
    assert np.abs(run.motion.xs[-1] - x0).max() < 1e-4


def test_a_solution_of_another_horizon_starts_it():
    problem = dd.Problem(block(time_step=0.1), x0=[1, 0], x_goal=[0, 0], num_steps=20, running_cost=EFFORT)
    other = dd.solve(dd.Problem(block(time_step=0.05), x0=[1, 0], x_goal=[0, 0], num_steps=50, running_cost=EFFORT))
    found = MPC(problem, horizon=5, plan=other), MPC(problem, horizon=5)
    # Of 1.4 N: the penalty on the goal error is in units of the given plan's cost.
    np.testing.assert_allclose(found[0]._reference.us, found[1]._reference.us, atol=3e-3)
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.05)
    of_another = dd.solve(dd.Problem(model, x0=np.zeros(4), num_steps=5, running_cost=EFFORT))
    with pytest.raises(InputError, match="a Solution with 4 states"):
        MPC(problem, horizon=5, plan=of_another)


def test_a_plan_that_cannot_keep_what_is_asked_for_is_refused():
    wall = dd.Constraint(lambda x: x[0], upper=0.5, knots=[10], name="wall")
    problem = dd.Problem(block(time_step=0.1), x0=[1, 0], x_goal=[0, 0], num_steps=20, running_cost=EFFORT,
                         constraints=[wall], bounds=dd.Bounds(u_lower=[-0.6], u_upper=[0.6]))  # fmt: skip
    with pytest.raises(InputError, match="wall gives way by"):
        MPC(problem, horizon=5, plan=straight(problem))

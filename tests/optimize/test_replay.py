"""Tests of replays of a plan: closed forms of their measures, and plans that must not pass."""

import dataclasses
import math

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row
from scipy.integrate import solve_ivp

import drake_diff as dd
from drake_diff.model.parameters import select
from drake_diff.motion import LQR
from drake_diff.optimize import Options
from drake_diff.optimize.checks import check
from drake_diff.optimize.replay import (
    FEEDBACK,
    FEEDBACK_TOLERANCE,
    GAINS_ALONE,
    OPEN_LOOP,
    SAME,
    STATE_TOLERANCE,
    Replay,
    ReplayPlan,
    _fails_in_the_limit,
    deciding,
    energy_check,
    held,
    regulator,
    replays,
)
from drake_diff.optimize.solution import Status

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])
H, COUNT = 0.05, 20


def block(write_urdf, *, time_step=H, count=COUNT, **fields):
    given = {"x0": [0, 0], "num_steps": count, "running_cost": EFFORT, **fields}
    return dd.Problem(write_urdf(time_step=time_step), **given)


def plan_of(problem, us):
    """Return the plan of `us` by the plant's own steps."""
    us = np.asarray(us, dtype=float)
    xs = dd.rollout(problem.model, problem.x0, us).xs if problem.model.nu else None
    with np.errstate(all="ignore"):
        cost = problem.objective(xs, us) if xs is not None else 0.0
    return ReplayPlan(problem, select(problem.model, ()), problem.model.time_step, held(xs, us), False, cost)


def broken_variants(plan, found):
    """Return the plants in which a plan has to hold, but holds under no control."""
    variants = deciding(plan, found)
    return [v for v in variants if not any(r.holds for r in found if r.variant == v and r.control != GAINS_ALONE)]


def by_name(found, variant, control):
    return next(r for r in found if (r.variant, r.control) == (variant, control))


def test_half_the_step_leads_a_block_elsewhere_by_the_closed_form(write_urdf):
    """Symplectic Euler under a constant force gives x_N = u h^2 N (N + 1) / 2 = u T (T + h) / 2."""
    problem = block(write_urdf, x_goal=[math.nan, math.nan], final_cost=lambda x: x[0])
    found = replays(plan_of(problem, np.full((COUNT, 1), 2.0)))
    total, steps = H * COUNT, (H, H / 2, H / 8)
    for h in steps:
        end = by_name(found, f"in steps of {h:g} s", "open loop").motion.xs[-1, 0]
        assert end == pytest.approx(2.0 * total * (total + h) / 2, rel=1e-9)
    assert by_name(found, "in continuous time", "open loop").motion.xs[-1, 0] == pytest.approx(total**2, rel=1e-9)
    assert len({r.variant for r in found}) == 4  # without contact


def test_feedback_holds_what_open_loop_loses(load):
    """Balance upright. The change by half the step grows as exp(4.4 t) open loop, and decays under TVLQR."""
    model = load("pendulum.urdf", time_step=0.02)
    balance = LQR(model, [np.pi, 0], [0], Q=np.eye(2), R=[[1.0]])
    us = dd.rollout(model, [np.pi - 0.5, 0], policy=balance, num_steps=150).us
    problem = dd.Problem(model, x0=[np.pi - 0.5, 0], num_steps=150, x_goal=[np.pi, 0])
    plan = plan_of(problem, us)
    found = replays(plan)
    assert by_name(found, "in steps of 0.01 s", "open loop").goal_error > 0.1
    assert by_name(found, "in steps of 0.01 s", "TVLQR").goal_error < 1e-3
    assert not broken_variants(plan, found)


@each_row("offset, holds", [(0.0, {True}), (0.5, {True, False})])
def test_the_deciding_replays_are_under_feedback_where_open_loop_fails(load, offset, holds):
    """A pendulum that rests hangs on open loop, and one that balances does not stay up in finer steps."""
    model = load("pendulum.urdf", time_step=0.02)
    up = np.pi if offset else 0.0
    balance = LQR(model, [up, 0], [0], Q=np.eye(2), R=[[1.0]])
    us = dd.rollout(model, [up - offset, 0], policy=balance, num_steps=100).us
    plan = plan_of(dd.Problem(model, x0=[up - offset, 0], num_steps=100, x_goal=[up, 0]), us)
    brief = replays(plan, sufficient=OPEN_LOOP)
    found = replays(plan)
    assert {r.holds for r in brief if r.control == OPEN_LOOP} == holds
    for row in found:  # the same objects, so that no replay was repeated
        first = by_name(found, row.variant, OPEN_LOOP)
        assert (row in brief) == (row is first or not first.holds)
    assert broken_variants(plan, brief) == broken_variants(plan, found) == []


def test_the_plants_own_step_gives_the_plan_back(write_urdf):
    plan = plan_of(block(write_urdf, final_cost=lambda x: x[0]), np.linspace(-1, 1, COUNT)[:, None])
    for control in ("open loop", "TVLQR"):
        motion = by_name(replays(plan), f"in steps of {H:g} s", control).motion
        np.testing.assert_allclose(motion.xs, plan.sample(1)[0], rtol=0, atol=1e-13)


@pytest.mark.slow
@each_row(
    "fields, what, where, value",
    [
        ({"x_goal": [0.9, math.nan]}, "goal", "slide_x", 0.15),
        ({"x_goal": [math.nan, 0.0]}, "goal", "slide_v", 2.0),
        ({"bounds": dd.Bounds(x_upper=[0.5, math.inf])}, "bound", "slide_x at 1 s", 0.55),
        ({"constraints": dd.Constraint(lambda x: x[1], upper=1, name="slow")}, "constraint", "slow at knot 20", 1.0),
        ({"waypoints": {10: [0.1, math.nan]}}, "constraint", "waypoint at knot 10 at knot 10", 0.175),
    ],
)
def test_a_plan_that_misses_what_is_asked_is_told(write_urdf, fields, what, where, value):
    """With u = 2 for 1 s, x ends at 1.05 (symplectic Euler), v at 2, and x_10 = 0.275."""
    problem = block(write_urdf, **{"final_cost": lambda x: x[0], **fields})
    plan = plan_of(problem, np.full((COUNT, 1), 2.0))
    found = by_name(replays(plan), f"in steps of {H:g} s", "open loop")
    (failing,) = [c for c in found.checks if not c.passes]
    assert (failing.what, failing.where, failing.value) == (what, where, pytest.approx(value))
    assert len(broken_variants(plan, replays(plan))) == 4


@pytest.mark.slow
@each_row("i", range(4))
def test_one_coordinate_off_is_refused_and_named(load, i):
    """The goal is the motion's own last state except for one coordinate, or one coordinate has to satisfy a bound."""
    model, us = load("cart_pole.urdf"), np.linspace(40, -20, 15)[:, None]
    x0 = np.array([0.1, 0.5, -0.3, 1.0])
    xs = dd.rollout(model, x0, us).xs
    plan = plan_of(dd.Problem(model, x0=x0, num_steps=15, final_cost=lambda x: x[0]), us)
    scale = plan.scale[i]
    sign = np.sign((xs[:, i] - x0[i])[np.argmax(np.abs(xs[:, i] - x0[i]))])  # the side to which it moves
    for factor in (0.9, 1.1):  # a nearer bound is itself the scale of a state that need not travel
        goal, limits = np.array(xs[-1]), np.full(4, sign * np.inf)
        goal[i] += sign * factor * SAME * scale
        limits[i] = sign * (np.max(sign * xs[1:, i]) - factor * STATE_TOLERANCE * scale)
        side = "x_upper" if sign > 0 else "x_lower"
        ends = {"x_goal": goal, "goal_tolerance": SAME * plan.scale}
        for asked, what in ((ends, "goal"), ({"bounds": dd.Bounds(**{side: limits})}, "bound")):
            problem = dd.Problem(model, x0=x0, num_steps=15, final_cost=lambda x: x[0], **asked)
            found = by_name(replays(plan_of(problem, us)), f"in steps of {model.time_step:g} s", "open loop")
            assert found.holds is (factor < 1), found.failures
            (row,) = [c for c in found.checks if c.what == what]
            assert row.where.startswith(model.state_names[i])
            if what == "goal":
                assert (row.value, row.tolerance) == pytest.approx((factor * SAME * scale, SAME * scale), rel=1e-6)


def test_the_plans_own_step_allows_one_percent_and_finer_ones_five_or_three_under_feedback(write_urdf):
    """u = 2 for 1 s ends at 1 + h in steps of h, which is 1.05 in the plan's own steps and 1.025 in halves."""
    us, own, finer = np.full((COUNT, 1), 2.0), f"in steps of {H:g} s", f"in steps of {H / 2:g} s"
    for variant, control, end, tolerance in (
        (own, "open loop", 1.05, SAME),
        (own, "TVLQR", 1.05, SAME),
        (finer, "open loop", 1.025, STATE_TOLERANCE),
    ):
        for factor, holds in ((0.9, True), (1.1, False)):
            off = end - end / (1 + factor * SAME) if tolerance == SAME else 1.05 * factor * tolerance
            plan = plan_of(block(write_urdf, x_goal=[end - off, math.nan]), us)
            assert by_name(replays(plan), variant, control).holds is holds
    assert FEEDBACK_TOLERANCE < STATE_TOLERANCE
    row = by_name(replays(plan), finer, "TVLQR").checks[0]
    assert row.tolerance == pytest.approx(1.05 * FEEDBACK_TOLERANCE)


def test_a_replay_is_compared_with_the_plan_where_nothing_is_asked_of_its_end(write_urdf):
    """With soft costs only, u = 2 for 1 s ends at 1 + h in steps of h and costs 4. Plans that differ are refused."""
    us, own = np.full((COUNT, 1), 2.0), f"in steps of {H:g} s"
    plan = plan_of(block(write_urdf, final_cost=lambda x: 0.0 * x[0]), us)
    fine = by_name(replays(plan), f"in steps of {H / 8:g} s", "open loop")
    assert {c.what: c for c in fine.checks}["following"].value == pytest.approx(7 / 8 * H)
    assert fine.holds
    elsewhere = held(plan.sample(1)[0] * [1.1, 1.0], us)
    for changed, what in (({"cost": 4.05}, "replayed cost"), ({"sample": elsewhere}, "following")):
        replay = by_name(replays(dataclasses.replace(plan, **changed)), own, "open loop")
        assert what in [c.what for c in replay.checks if not c.passes]


def test_what_an_eighth_of_the_step_alone_shows_is_refused(write_urdf):
    """u = 2 ends at 1 + h. A goal of 1.05 is missed by 2.5, 4.4 and, in continuous time, 5 of 5.25 hundredths."""
    for beyond, holds in ((0.0, True), (0.01, False)):  # at 1.06, h and h/2 miss by 1 and 3.5, h/8 by 5.4 hundredths
        problem = block(write_urdf, x_goal=[1.05 + beyond, math.nan])
        plan = plan_of(problem, np.full((COUNT, 1), 2.0))
        found = [r for r in replays(plan) if r.control == "open loop"]
        assert [r.holds for r in found] == [True, True, holds, holds]
        assert len(list(broken_variants(plan, found))) == 2 * (not holds)


def test_the_regulator_is_the_same_in_finer_steps(write_urdf):
    """The running weights are for a sum over steps. As an integral they give gains that converge as h shrinks."""
    problem = block(write_urdf, x_goal=[1, 0])
    us = np.concatenate([np.full((COUNT // 2, 1), 4.0), np.full((COUNT // 2, 1), -4.0)])
    plan = plan_of(problem, us)
    first = []
    for parts in (16, 32):
        xs, finer = plan.sample(parts)
        policy = regulator(plan, plan.model_at(parts), xs, finer)
        away = [float(policy(xs[0] + d, 0.0)[0] - policy(xs[0], 0.0)[0]) for d in np.eye(2) * 0.01]
        first.append(away)
    assert first[0] == pytest.approx(first[1], rel=0.05)  # O(h); a sum's weights would give a factor of 2


def test_energy_out_of_nothing_is_told(load):
    """Semi-implicit Euler of an oscillator is unstable beyond h w = 2. The swing grows without work of a motor."""
    model = load("pendulum.urdf", time_step=0.55)  # w = sqrt(g / l) = 4.4: h w = 2.4
    problem = dd.Problem(model, x0=[0.02, 0], num_steps=4, final_cost=lambda x: x[0])  # later the swing is not small
    plan = plan_of(problem, np.zeros((4, 1)))
    check = energy_check(plan.open_loop)
    assert (check.where, check.passes) == ("gained", False)
    found = replays(plan)  # finer steps do not repeat this motion
    assert broken_variants(plan, found)[-2:] == ["in steps of 0.06875 s", "in continuous time"]


def test_a_deep_overlap_is_told_and_another_approximation_is_tried(tmp_path):
    """A ball of 1 kg and radius 0.1 m on 100 N/m sinks by m g / k = 0.098 m. A quarter of its diameter is 0.05 m."""
    path = tmp_path / "ball.sdf"
    path.write_text(BALL)
    model = dd.load_model(path, time_step=0.002, ground=0.5)
    problem = dd.Problem(model, x0=[0.1, 0], num_steps=300, final_cost=lambda x: x[0], optimize="initial_state")
    us = np.zeros((300, 0))
    xs = dd.rollout(model, [0.1, 0], num_steps=300).xs
    found = replays(ReplayPlan(problem, select(model, ()), 0.002, held(xs, us), False, xs[-1, 0]))
    steps = [f"in steps of {h:g} s" for h in (0.002, 0.001, 0.00025)]
    assert [r.variant for r in found] == [*steps, "with lagged contact"]
    assert found[3].approximation == "lagged"
    assert 0.02 < found[3].penetration < 0.05  # Hunt-Crossley dissipation, which sap ignores, slows the ball down
    assert found[3].holds
    for replay in found[:3]:
        (deep,) = [c for c in replay.checks if not c.passes]
        assert (deep.what, deep.tolerance, deep.unit) == ("penetration", pytest.approx(0.05), "m")
        assert 0.09 < replay.penetration < 0.2  # near the static depth, below twice this depth without damping


BALL = """<sdf version="1.9"><model name="ball"><link name="ball"><inertial><mass>1</mass></inertial>
<collision name="ball"><geometry><sphere><radius>0.1</radius></sphere></geometry>
<drake:proximity_properties><drake:point_contact_stiffness>100</drake:point_contact_stiffness>
</drake:proximity_properties></collision></link>
<joint name="z" type="prismatic"><parent>world</parent><child>ball</child><axis><xyz>0 0 1</xyz>
<limit><effort>0</effort></limit></axis></joint>
</model></sdf>""".replace("<sdf ", '<sdf xmlns:drake="drake" ')


def test_a_plan_that_lives_from_one_law_of_contact_is_refused_in_the_other_in_fine_steps_too(tmp_path):
    """A ball has to lie still after its fall. The relaxation time of sap stops it, an undamped spring does not."""
    path = tmp_path / "ball.sdf"
    damped = """10000</drake:point_contact_stiffness><drake:relaxation_time>0.1</drake:relaxation_time>
    <drake:hunt_crossley_dissipation>0</drake:hunt_crossley_dissipation>"""
    path.write_text(BALL.replace("100</drake:point_contact_stiffness>", damped))
    model = dd.load_model(path, time_step=0.002, ground=0.5, near_rigid=1e-3)
    us = np.zeros((100, 0))
    xs = dd.rollout(model, [0.15, 0], num_steps=100).xs
    lies = [xs[-1, 0], math.nan]
    fall = dd.Problem(model, x0=[0.15, 0], num_steps=100, x_goal=lies, optimize="initial_state")
    plan = ReplayPlan(fall, select(model, ()), 0.002, held(xs, us), False, cost=0.0)
    found = replays(plan)
    other = ["with lagged contact", "with lagged contact in steps of 0.00025 s"]
    assert [(r.variant, r.holds) for r in found[-2:]] == [(name, False) for name in other]
    assert all(r.holds for r in found[:-2]), found
    assert list(broken_variants(plan, found)) == [other[1]]
    assert [(c.what, c.where) for c in found[-1].checks if not c.passes] == [("goal", "z_x")]
    assert found[-1].motion.xs[-1, 0] > 0.11  # after 0.1 s to the ground and 0.03 s on its spring it is on the way up


def test_inputs_that_cannot_be_stepped_are_missing_not_zero(write_urdf):
    problem = block(write_urdf, final_cost=lambda x: x[0])
    us = np.full((COUNT, 1), np.nan)
    plan = ReplayPlan(problem, select(problem.model, ()), H, held(np.zeros((COUNT + 1, 2)), us), False, 0.0)
    assert plan.open_loop is None
    for replay in replays(plan):
        assert replay.motion is None
        assert replay.goal_error == replay.penetration == math.inf
        assert not replay.holds


def test_a_collocated_plan_is_replayed_in_finer_steps_until_two_hold(write_urdf):
    """With 4 intervals of h = 0.25 the simulator ends off by h T / 2 times the mean slope, with h/16 within 5 %."""
    problem = block(write_urdf, time_step=0.25, count=4, x_goal=[1, 0])
    solution = dd.solve(problem, method="collocation", options=Options(scheme="hermite_simpson"))
    assert solution.success, solution.message
    variants = list(dict.fromkeys(r.variant for r in solution.replays))
    assert variants[:2] == ["in steps of 0.25 s", "in steps of 0.125 s"]
    assert not solution.replays[0].holds
    assert all(any(r.holds for r in solution.replays if r.variant == v) for v in variants[-2:])


def test_a_frame_that_has_to_be_exact_is_replayed_in_steps_that_are_fine_enough_for_it(write_urdf):
    """x = t^2 under 2 N on 1 kg. Steps of h end h further. A tolerance of 5 mm allows 0.1 s / 32, not 0.1 s / 16."""
    fixed = dd.Bounds(u_lower=[2.0], u_upper=[2.0])  # feedback has no effect
    goals = [dd.FrameGoal("block", [1, 0, 0])]
    problem = block(write_urdf, time_step=0.1, count=10, bounds=fixed, goals=goals)

    def sample(parts):
        times = np.linspace(0, 1, 10 * parts + 1)
        return np.column_stack([times**2, 2 * times]), np.full((10 * parts, 1), 2.0)

    plan = ReplayPlan(problem, select(problem.model, ()), 0.1, sample, continuous=True, cost=4.0)
    found = replays(plan)
    for parts in (1, 2, 4, 8, 16, 32, 64):
        replay = by_name(found, f"in steps of {0.1 / parts:.4g} s", "open loop")
        assert replay.motion.xs[-1, 0] == pytest.approx(1 + 0.1 / parts, rel=1e-9)
        assert replay.holds == (parts >= 32)
    assert not broken_variants(plan, found)


def test_a_solve_whose_replay_fails_is_no_success(load):
    """A discrete swing-up in steps of 0.2 s holds in these steps only."""
    problem = dd.Problem(
        load("cart_pole.urdf", time_step=0.2),
        x0=np.zeros(4),
        x_goal=[1, np.pi, 0, 0],
        num_steps=10,
        running_cost=EFFORT,
    )
    solution = dd.solve(problem, method="ilqr")
    assert solution.defect == 0
    assert solution.status is Status.CONVERGED_NOT_VERIFIED
    assert solution.message.startswith("not verified: at 100 ms under TVLQR, hinge_q ends ")
    assert len(solution.message) <= 160


def cart_pole_swing_up():
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.04)
    bounds = dd.Bounds(x_lower=[-2, *[-np.inf] * 3], x_upper=[2, *[np.inf] * 3], u_lower=[-20], u_upper=[20])
    problem = dd.Problem(
        model, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], num_steps=50, running_cost=EFFORT, bounds=bounds
    )
    return dd.solve(problem, method="collocation")


def test_gains_of_half_steps_keep_a_smooth_plan_in_finer_ones_as_well_as_their_own():
    """In steps of 5 ms both regulators bring the cart-pole up. In steps of 20 ms they are the same."""
    plan = cart_pole_swing_up().plan
    ends = {}
    for parts in (2, 8):
        model, (xs, us) = plan.model_at(parts), plan.sample(parts)
        for known, policy in ((False, regulator(plan, model, xs, us)), (True, plan.follower(parts).law())):
            motion = dd.rollout(model, xs[0], policy=policy, num_steps=len(us))
            ends[parts, known] = np.abs(plan.problem.goal_error(motion.xs[-1])) / plan.scale
    assert np.allclose(ends[2, True], ends[2, False], rtol=1e-9)  # no input limit is reached
    assert np.max(ends[8, True]) < 0.01  # 3 % are allowed
    assert np.max(ends[8, False]) < 0.01


def test_a_smooth_plan_that_is_wrong_is_refused_whatever_its_gains():
    """Test feedback about states that deviate from the middle on, and inputs that are clipped."""
    plan = cart_pole_swing_up().plan
    assert not list(broken_variants(plan, replays(plan)))

    def elsewhere(parts):
        xs, us = plan.sample(parts)
        moved = xs.copy()
        moved[len(xs) // 2 :, 0] += 0.2 * plan.scale[0]
        return moved, us

    def weak(parts):
        xs, us = plan.sample(parts)
        return xs, np.clip(us, -5.0, 5.0)

    found = replays(dataclasses.replace(plan, sample=elsewhere))
    assert not any(r.holds for r in found if r.control == "TVLQR")
    bounds = dataclasses.replace(plan.problem.bounds, u_lower=np.array([-5.0]), u_upper=np.array([5.0]))
    cut = dataclasses.replace(plan, problem=dataclasses.replace(plan.problem, bounds=bounds), sample=weak)
    assert list(broken_variants(cut, replays(cut)))


def test_a_command_is_held_over_a_step_of_the_controller(write_urdf):
    """The command is u_k - K_k (x - x_k) with the state at the controller's steps, within the limits of the input."""
    us = np.concatenate([np.full((COUNT // 2, 1), 4.0), np.full((COUNT // 2, 1), -4.0)])
    plan = plan_of(block(write_urdf, x_goal=[1, 0], bounds=dd.Bounds(u_lower=[-4], u_upper=[4])), us)
    motion = plan.follower().in_model("in eighths", lambda: plan.model_at(8), 8)[1].motion
    commands, (xs, _) = motion.us.reshape(COUNT, 8), plan.sample(1)
    assert not np.ptp(commands, axis=1).any()
    off = motion.xs[:-1:8] - xs[:-1]
    wanted = us[:, 0] - np.einsum("kj,kj->k", plan.follower().gains[:, 0], off)
    np.testing.assert_allclose(commands[:, 0], np.clip(wanted, -4, 4), rtol=1e-12)
    assert np.any(wanted > 4)
    assert np.any(np.abs(wanted) < 3.99)


def test_a_collocated_plan_holds_open_loop_only_where_its_motion_costs_what_is_reported():
    """Errors of x' = 8 x + u grow by exp(8) to less than 1 % of x. With a final cost of 1e6 x^2 this doubles a cost."""
    unstable, steep = dd.Dynamics(lambda x, u: [8 * x[0] + u[0]], nx=1, nu=1), 1e6
    fields = {"num_steps": 40, "running_cost": lambda x, u: u[0] ** 2, "final_cost": lambda x: steep * x[0] ** 2}
    problem = dd.Problem(unstable, x0=[1.0], horizon=1.0, **fields)
    solution = dd.solve(problem, options=Options(refine=False))
    given = solution.trajectory().input
    rate = lambda t, x: 8 * x + given.value(t)[0, 0]  # noqa: E731
    end = solve_ivp(rate, (0, 1), [1.0], rtol=1e-11, atol=1e-13, max_step=0.01).y[0, -1]
    state, cost = (c for c in solution.following if c.feedback is None)
    assert state.passes
    assert (cost.what, cost.passes) == ("replayed cost", False)
    assert cost.value == pytest.approx(steep * (end**2 - solution.xs[-1, 0] ** 2), rel=0.1)  # 1e-6 per step grows too
    assert solution.feedback == "TVLQR"
    assert solution.message == "converged: holds under TVLQR in continuous time"


def test_the_cost_beside_a_plans_is_by_the_integral():
    """A motion shifted by 0.1 costs 0.1 (3 T + 5) more, for a running cost of 3 x and a final cost of 5 x."""
    drift = dd.Dynamics(lambda x, u: [u[0]], nx=1, nu=1)
    fields = {"running_cost": lambda x, u: u[0] ** 2 + 3 * x[0], "final_cost": lambda x: 5 * x[0]}
    motion = dd.solve(dd.Problem(drift, x0=[0.0], num_steps=7, horizon=2.0, **fields)).transcribed
    assert motion.cost_beside(motion.led("open loop") + 0.1, None) == pytest.approx(0.1 * (3 * 2.0 + 5), rel=1e-9)


def test_finer_steps_have_the_gains_of_the_plans_own_parameters(load):
    """The rod has 3 kg instead of the file's mass. The gains are those of half steps, to which offsets are added."""
    model = load("pendulum.urdf", time_step=0.02)
    heavy = select(model, {"pole.mass": 3.0})
    us, x0 = np.full((20, 1), 2.0), np.array([0.1, 0.0])
    problem = dd.Problem(model, x0=x0, num_steps=20, x_goal=[0.5, 0])
    xs = dd.rollout(model, x0, us, parameters={"pole.mass": 3.0}).xs
    plan = ReplayPlan(problem, heavy, 0.02, held(xs, us), False, 0.0)
    with plan.applied_to(plan.model_at(2)) as halved:
        expected = regulator(plan, halved, *plan.sample(2)).gains
    np.testing.assert_allclose(plan.follower(2).gains, expected, rtol=1e-12)
    assert not np.allclose(regulator(plan, plan.model_at(2), *plan.sample(2)).gains, expected, rtol=1e-2)


def test_a_law_with_limits_of_rates_begins_each_motion_anew(write_urdf):
    limits = dd.optimize.InputRate(1.0)
    plan = plan_of(block(write_urdf, x_goal=[1, 0], couplings=limits), np.full((COUNT, 1), 2.0))
    law = plan.follower().law()
    first, *_, far = (law(np.array([-9.0 * k, 0.0]), k * H) for k in range(6))
    assert far[0] - first[0] == pytest.approx(5 * H)
    assert law(np.zeros(2), 0.0) == first


@each_row(
    "coarse, fine, fails",
    [
        ((5.0, 9.0), (4.9, 9.1), True),
        ((5.0, 9.0), (3.4, 9.1), False),  # open loop, 2 * 3.4 - 5 is 1.8: finer steps may pass
        ((5.0, 0.9), (4.9, 0.8), False),  # TVLQR passes
        ((math.inf, 9.0), (math.inf, 9.1), False),  # a replay that broke off says nothing of finer steps
    ],
)
def test_finer_steps_are_not_tried_if_the_extrapolated_error_is_too_large(coarse, fine, fails):
    rows = [
        Replay(variant, control, h, "sap", None, (check("goal", "a", ratio, 1.0),))
        for variant, h, ratios in (("in steps of 1 s", 1.0, coarse), ("in steps of 0.5 s", 0.5, fine))
        for control, ratio in zip((OPEN_LOOP, FEEDBACK), ratios, strict=True)
    ]
    assert _fails_in_the_limit(rows) == fails

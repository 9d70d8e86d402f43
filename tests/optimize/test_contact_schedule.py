"""Tests of contact schedules: soles, forces and initial guess by closed forms, refused schedules, and plans."""

import json

import numpy as np
import pytest
from helpers.legged import LEGGED, SOLO_FEET, legged_model, rest, robot_on_feet

import drake_diff as dd
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.legs.feet import Legs
from drake_diff.legs.motion import plan_forces, swings, touching
from drake_diff.model.parameters import select
from drake_diff.model.step import advance
from drake_diff.model.tangent import tangent_space
from drake_diff.optimize import Options
from drake_diff.optimize.replay import ReplayPlan, deciding, held, replays
from drake_diff.runs.sections import rebuild_goal

H, G = 0.02, np.array([0.0, 0.0, -9.81])
SQUARE = np.array([[0.2, 0.1, 0.0], [0.2, -0.1, 0.0], [-0.2, 0.1, 0.0], [-0.2, -0.1, 0.0]])
HOP = [(20, SOLO_FEET), (8, ()), (20, SOLO_FEET)]


@pytest.fixture(scope="module")
def solo():
    return legged_model("solo12")


@pytest.fixture(scope="module")
def standing(solo):
    return rest("solo12", solo, np.array(LEGGED["solo12"].high))


def posed(model, seed):
    """Return a random state with a random orientation of the base."""
    random = np.random.default_rng(seed)
    x = np.array(model.default_state)
    x[:4] = random.standard_normal(4)
    x[:4] /= np.linalg.norm(x[:4])
    x[4 : model.nq] = random.uniform(-1, 1, model.nq - 4)
    x[model.nq :] = random.standard_normal(model.nv)
    return x


def test_a_schedule_comes_back_from_what_a_record_tells_of_it():
    """`verify` can repeat the run of a legged robot by its record. Invalid data raise an error that names the field."""
    schedule = dd.optimize.ContactSchedule(HOP, feet=SOLO_FEET, clearance=0.01, slip=0.3, touch=0.004)
    told = json.loads(json.dumps(schedule.to_dict()))
    again = rebuild_goal(told)
    assert again == schedule
    assert (again.phases, again.clearance, again.slip, again.touch) == (schedule.phases, 0.01, 0.3, 0.004)
    told["ContactSchedule"]["phases"] = [[20]]
    with pytest.raises(InputError, match=r"ContactSchedule\.phases"):
        rebuild_goal(told)


@pytest.mark.parametrize("seed", range(3))
def test_soles_move_as_differences_say(solo, seed):
    x, nq, nv = posed(solo, seed), solo.nq, solo.nv
    legs, space, step = Legs.named(solo, SOLO_FEET, np.array(solo.default_state[:nq])), tangent_space(solo), 1e-6

    def at(d):
        moved = space.plus(x, np.concatenate([d, np.zeros(nv)]))
        legs.put(moved[:nq], x[nq:])
        return legs.points(), legs.soles([legs.read(np.concatenate([moved[:nq], x[nq:]]))]).velocities(x[None, nq:])[0]

    units = step * np.eye(nv)
    slopes = [[(a - b) / (2 * step) for a, b in zip(at(d), at(-d), strict=True)] for d in units]
    legs.put(x[:nq], x[nq:])
    moves, soles = legs.jacobian(), legs.soles([legs.read(x)])
    turns = soles.turns[0].swapaxes(1, 2)
    velocities, by_posture = soles.velocities(x[None, nq:])[0], soles.slopes(x[None, nq:])[0].swapaxes(1, 2)
    assert np.allclose(velocities, moves @ x[nq:], atol=1e-12)
    assert np.allclose(by_posture, np.moveaxis([s[1] for s in slopes], 0, -1), atol=1e-7)  # differences over 1e-6
    height = np.moveaxis([s[0] for s in slopes], 0, -1)[:, 2]
    assert np.allclose(moves[:, 2], height, atol=1e-7)
    assert np.allclose(turns[:, :, :3], np.eye(3), atol=1e-12)  # a turn of the base turns every foot


def test_where_no_foot_stands_the_centre_of_mass_flies():
    stands = np.repeat([[True], [False], [True]], [20, 10, 20], axis=0) & np.ones((1, 4), bool)
    way = np.tile([0.0, 0.0, 0.3], (51, 1))
    way[:, 0] = np.linspace(0, 0.1, 51)
    places = np.tile(SQUARE, (51, 1, 1))
    at, forces = plan_forces(3.0, G, H, (way[0], np.zeros(3)), way, places, stands, 0.5)
    velocity = np.diff(at, axis=0) / H
    before = np.vstack([np.zeros(3), velocity[:-1]])
    assert np.allclose((velocity - before) / H, forces.sum(axis=1) / 3.0 + G, atol=1e-4)  # [m/s^2] Newton's law
    assert np.all(forces[20:30] == 0)
    # Between the last and the first step on the ground the robot is in free fall, by the rule of the time steps.
    assert np.allclose(
        at[20:31, 2] - at[20, 2], H * velocity[19, 2] * np.arange(11) - 9.81 * H**2 * np.cumsum(range(11)), atol=1e-6
    )
    assert np.all(np.abs(forces[..., :2]) <= 0.5 * forces[..., 2:] + 1e-5)
    assert np.allclose(at[[0, -1]], way[[0, -1]], atol=1e-7)


def test_without_a_foot_that_stands_there_are_no_forces():
    refused = plan_forces(
        3.0, G, H, (np.zeros(3), np.zeros(3)), np.zeros((11, 3)), np.zeros((11, 4, 3)), np.zeros((10, 4), bool), 0.5
    )
    assert "no contact forces" in str(refused)


def test_a_foot_is_on_the_ground_before_and_after_each_step_it_stands_in():
    stands = np.array([[1, 1, 0, 0, 0, 1, 1]], bool).T
    on = touching(stands)
    assert on.ravel().tolist() == [True, True, True, False, False, True, True, True]
    assert swings(on[:, 0]) == [(2, 5)]
    assert swings(touching(~stands)[:, 0]) == [(0, 2), (5, 7)]


@pytest.mark.solve
def test_a_guess_keeps_its_schedule_and_nearly_the_steps(solo, standing):
    schedule = dd.optimize.ContactSchedule(HOP)
    xs, us = schedule.guess(solo, standing)
    problem = dd.Problem(solo, x0=standing, num_steps=48, goals=[schedule], **schedule.follow(solo, (xs, us)))
    for constraint in problem.kept_goals:
        knots = problem.knots_of(constraint, input_at_end=False)
        assert max(constraint.miss(xs[k]) for k in knots) <= constraint.tolerance
    ends = np.array([advance(solo.double, x, u) for x, u in zip(xs[:-1], us, strict=True)])
    gaps = np.array([tangent_space(solo).minus(a, b) for a, b in zip(ends, xs[1:], strict=True)])
    base = gaps[:, [0, 1, 2, 3, 4, 5, 18, 19, 20, 21, 22, 23]]
    assert np.max(np.abs(base)) < 0.05  # [rad, m and their rates], while the robot flies at 0.8 m/s
    assert np.max(xs[:, 6]) > standing[6] + 0.02  # g T^2 / 8 = 0.03 m


def test_what_does_not_keep_the_schedule_is_told(solo, standing):
    schedule = dd.optimize.ContactSchedule(HOP)
    xs, us = schedule.guess(solo, standing)
    problem = dd.Problem(solo, x0=standing, num_steps=48, goals=[schedule], **schedule.follow(solo, (xs, us)))
    lifted, low, dragged = np.array(xs[10]), np.array(xs[24]), np.array(xs[10])
    lifted[6] += 0.02
    low[6] -= 0.08
    dragged[solo.nq + 3] += 0.5
    stands, clear, slips = problem.kept_goals
    assert stands.miss(lifted) == pytest.approx(0.02 - 1.25e-3, abs=5e-4)  # a standing foot sinks by 1.25 mm
    assert clear.miss(low) > clear.tolerance
    assert slips.miss(dragged) > slips.tolerance
    assert slips.miss(xs[10]) < slips.tolerance
    assert "over the ground" in stands.told(0.02)


def test_rows_of_a_schedule_have_the_derivative_of_differences(solo, standing):
    schedule = dd.optimize.ContactSchedule(HOP)
    problem = dd.Problem(solo, x0=standing, num_steps=48, goals=[schedule])
    x, u, step = posed(solo, 5), np.zeros(solo.nu), 1e-6
    for constraint in problem.kept_goals:
        found = constraint.differentiate(x, u)[1][:, : solo.nx]
        assert np.allclose(found[:, :4] @ x[:4], 0.0, atol=1e-9)  # the norm of a quaternion has no effect
        units = step * np.eye(solo.nx)
        along = np.array([(constraint(x + d, u) - constraint(x - d, u)) / (2 * step) for d in units]).T
        assert np.allclose(found, along, atol=1e-6)
        states = np.array([posed(solo, 6), x, posed(solo, 7)])  # x among other states, which must not affect it
        assert np.allclose(constraint.slopes(states, np.zeros((3, solo.nu)))[1, :, : solo.nx], along, atol=1e-6)
        values = constraint.along(states, np.zeros((3, solo.nu)))
        assert np.allclose(values, [constraint(state, u) for state in states], rtol=0, atol=1e-14)  # rounding


@pytest.mark.parametrize(
    ("phases", "named"),
    [
        ([], "phases"),
        ([(0, SOLO_FEET)], "phases"),
        ([(4, "FL_FOOT")], "phases"),
        ([(4, ())], "feet"),
        ([(2.5, SOLO_FEET)], "phases"),
    ],
)
def test_what_is_no_schedule_is_refused(phases, named):
    with pytest.raises(InputError, match=named):
        dd.optimize.ContactSchedule(phases)


def test_a_schedule_that_does_not_fit_the_problem_is_refused(solo, standing):
    hop = dd.optimize.ContactSchedule(HOP)
    with pytest.raises(InputError, match="48 steps"):
        dd.Problem(solo, x0=standing, num_steps=50, goals=[hop])
    with pytest.raises(UnknownNameError, match="FL_FOOT"):
        dd.Problem(solo, x0=standing, num_steps=4, goals=[dd.optimize.ContactSchedule([(4, ["left"])])])
    with pytest.raises(InputError, match="no such shape"):
        dd.optimize.ContactSchedule([(4, ["base_link"])]).guess(solo, standing)
    far = np.array(standing[: solo.nq])
    far[4] += 50.0
    with pytest.raises(InputError, match="no contact forces"):
        hop.guess(solo, standing, far)


@pytest.mark.slow
def test_solo_hops_and_lands(solo, standing):
    schedule = dd.optimize.ContactSchedule(HOP)
    guess = schedule.guess(solo, standing)
    place = dd.FrameGoal("base_link", position=standing[4:7], tolerance=0.05)
    problem = dd.Problem(solo, x0=standing, num_steps=48, goals=[schedule, place], **schedule.follow(solo, guess))
    solution = dd.solve(problem, method="ilqr", initial_guess=guess, options=Options(tolerance=1e-4))
    assert solution.success, solution.message
    # An independent check by Drake's own poses: every foot is in the air in the middle of the flight.
    context = solo.plant.CreateDefaultContext()
    solo.plant.SetPositions(context, solution.xs[24, : solo.nq])
    feet = [solo.plant.GetBodyByName(foot) for foot in SOLO_FEET]
    heights = [solo.plant.EvalBodyPoseInWorld(context, foot).translation()[2] - 0.016 for foot in feet]
    assert min(heights) > 0.02


@pytest.fixture(scope="module", params=range(2))
def lifted(solo, request):
    """Solve for a motion that lifts a foot for half a second. Return the problem and the solution."""
    problem, guess = _lift(solo, request.param)
    return problem, dd.solve(
        problem, method="ilqr", initial_guess=guess, options=Options(tolerance=1e-4), max_iterations=20
    )


def _lift(solo, seed):
    x0 = rest("solo12", solo, np.array(LEGGED["solo12"].high), np.random.default_rng(seed))
    schedule = dd.optimize.ContactSchedule([(25, SOLO_FEET), (25, SOLO_FEET[1:]), (15, SOLO_FEET)])
    guess = schedule.guess(solo, x0)
    place = dd.FrameGoal("base_link", position=guess[0][-1][4:7], tolerance=0.05)
    return dd.Problem(solo, x0=x0, num_steps=65, goals=[schedule, place], **schedule.follow(solo, guess)), guess


@pytest.mark.slow
def test_solo_lifts_a_foot(solo, lifted):
    problem, solution = lifted
    assert solution.success, solution.message
    x0 = np.asarray(problem.x0)
    legs, xs = Legs.named(solo, SOLO_FEET, x0[: solo.nq]), [x0]
    for u in solution.us:  # Drake's own steps
        xs.append(advance(solo.double, xs[-1], u))
    heights = legs.soles([legs.read(x) for x in xs]).places[..., 2]
    assert heights[37, 0] > 0.01
    assert np.max(heights[:, 1:]) < 1e-5  # 0 to the tolerance of a search
    assert np.max(np.abs(xs[-1][solo.nq : solo.nq + 6])) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("lifted", [0], indirect=True)
@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
def test_a_lift_that_is_not_what_was_asked_is_refused(solo, lifted):
    problem, solution = lifted
    x0, us = np.asarray(problem.x0), np.asarray(solution.us)
    base = solution.xs[-1][4:7]
    kept = next(goal for goal in problem.goals if isinstance(goal, dd.optimize.ContactSchedule))
    slippery = dd.load_model(
        robot_on_feet("solo12", 0.02), time_step=0.02, base="free", actuators="all", ground=0.03, near_rigid=0.1
    )
    strength = np.full(solo.nu, 0.6 * np.max(np.abs(us)))  # the knees of a standing robot need more
    limits = dd.Bounds(u_lower=-strength, u_upper=strength)
    other = dd.optimize.ContactSchedule([(25, SOLO_FEET), (25, SOLO_FEET[:3]), (15, SOLO_FEET)])
    there = dd.FrameGoal("base_link", base, tolerance=0.05)
    further = dd.FrameGoal("base_link", base + np.array([0.1, 0, 0]), tolerance=0.05)
    planted = {
        "another foot is to be lifted": (solo, us, [other], None),
        "the base is to end 0.1 m further": (solo, us, [kept, further], None),
        "feet slip": (slippery, us, [kept, there], None),
        "motors are too weak": (solo, np.clip(us, -strength, strength), [kept, there], limits),
    }
    for name, (model, inputs, goals, bounds) in planted.items():
        asked = dd.Problem(model, x0=x0, num_steps=65, goals=goals, bounds=bounds, final_cost=lambda x: x[0])
        plan = ReplayPlan(asked, select(model, ()), 0.02, held(np.asarray(solution.xs), inputs), False, 0.0)
        found = replays(plan)
        assert any(not any(r.holds for r in found if r.variant == v) for v in deciding(plan, found)), f"{name}: {found}"
        assert not any(r.holds for r in found if "lagged" in r.variant), f"{name}: {found}"

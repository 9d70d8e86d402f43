"""Tests of obstacles: plans clear them at knots and in between, as measured by Drake, and violations are named."""

import re
import warnings
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers.robots import arm_beside_table, example_robot
from helpers.table import each_row
from pydrake.math import RigidTransform

import drake_diff as dd
import drake_diff.optimize.transcription.collocation as collocation_module
from drake_diff.exceptions import InputError, ModelWarning, UnknownNameError
from drake_diff.optimize import Options
from drake_diff.optimize.guess import first_guess
from drake_diff.optimize.problem.obstacles import along_steps
from drake_diff.optimize.program import NlpResult, Outcome
from drake_diff.optimize.verification import judged

pytestmark = pytest.mark.solve

BALL = dd.SphereObstacle([0.0, 0.0, -1.2], 0.1, name="ball")
POST = dd.BoxObstacle([0.0, 0.0, -1.25], [0.1, 0.4, 0.2], name="post")
SMOOTH = dd.QuadraticCost(Q=np.diag([0, 0, 1.0, 1.0]), R=1e-2 * np.eye(2))


def arm(obstacles, *, num_steps=30, time_step=0.05, **options):
    """Return the problem of two rods that swing to the other side, past an obstacle where they would hang."""
    model = dd.load_model("models/double_pendulum.urdf", time_step=time_step)
    ends = {"x0": [-1.0, 0.1, 0, 0], "x_goal": [1.0, -0.1, 0, 0]}
    return dd.Problem(model, num_steps=num_steps, running_cost=SMOOTH, goals=obstacles, **(ends | options))


def depth_by_drake(model, xs, obstacle, parts=1):
    """Return how deep [m] the rods, of radius 0.02, enter the obstacle on `parts` places of each line between xs.

    The depth follows from Drake's poses and points on the rods' axes, not from a formula of the toolkit.
    """
    plant, context = model.plant, model.plant.CreateDefaultContext()
    deepest = -np.inf
    for before, after in pairwise(xs):
        for part in np.arange(parts) / parts:
            plant.SetPositions(context, ((1 - part) * before + part * after)[: model.nq])
            for name, long in (("upper", 0.8), ("lower", 0.5)):
                pose = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(name))
                points = (pose @ np.column_stack([np.zeros((201, 2)), -np.linspace(0, long, 201)]).T).T
                if isinstance(obstacle, dd.SphereObstacle):
                    distance = np.linalg.norm(points - obstacle.center, axis=1) - obstacle.radius
                else:
                    local = (
                        np.abs((points - obstacle.center) @ np.array(obstacle.rotation)) - np.array(obstacle.size) / 2
                    )
                    outside = np.linalg.norm(np.maximum(local, 0), axis=1)
                    distance = outside + np.minimum(np.max(local, axis=1), 0)
                deepest = max(deepest, 0.02 - float(np.min(distance)))
    return deepest


@each_row("name, method", [("ball", "collocation")])
def test_a_plan_goes_around_as_drake_measures_it(name, method):
    check_that_it_goes_around(name, method)


@pytest.mark.slow
@each_row("name, method", [("post", "ilqr")])
def test_a_plan_of_steps_or_lines_goes_around_too(name, method):
    check_that_it_goes_around(name, method)


def check_that_it_goes_around(name, method):
    obstacle = {"ball": BALL, "post": POST}[name]
    problem = arm([obstacle])
    solution = dd.solve(problem, method=method, max_iterations=200)
    assert solution.success, solution.message
    if method == "ilqr":
        assert depth_by_drake(problem.model, solution.xs, obstacle, parts=50) < 0
    else:
        assert depth_by_drake(problem.model, finely(solution), obstacle) < 0


def finely(solution):
    """Return the states of a collocated plan at 1 kHz."""
    return solution.transcribed.at(np.linspace(0, solution.horizon, 1 + round(1000 * solution.horizon)))[0]


def test_where_a_plan_jumps_through_between_knots_the_mesh_is_refined(monkeypatch):
    problem = arm([BALL], num_steps=8, time_step=0.2)
    solution = dd.solve(problem, method="collocation", max_iterations=200)
    rounds = solution.options["clearance_rounds"]
    assert rounds[0][0] == 8
    assert rounds[0][1] > 0.05
    assert rounds[-1] == [len(solution.us), 0.0]
    assert depth_by_drake(problem.model, finely(solution), BALL) < 0
    monkeypatch.setattr(collocation_module, "CLEARANCE_ROUNDS", 0)
    solution = dd.solve(problem, method="collocation", max_iterations=200, options=Options(refine=False))
    assert solution.status is dd.Status.CONVERGED_NOT_VERIFIED
    assert failing(solution, "between the nodes")[0].where.startswith("lower and obstacle 'ball' at ")


def failing(solution, plant):
    """Return the failing clearance checks in a plant."""
    return [c for c in solution.plan_checks.failing if (c.what, c.plant) == ("clearance", plant)]


def test_no_obstacle_is_so_thin_that_a_motion_jumps_over_it_unseen():
    """Put balls of 1 mm on the way of the lower rod's end, which moves by half the rods' width and more between checks.

    The rods' depth in each ball is computed by Pythagoras at 10,000 times.
    """
    ends = {"num_steps": 4, "time_step": 0.4, "x0": [-1.5, 0.1, 0, 0], "x_goal": [1.5, -0.1, 0, 0]}
    plan = dd.solve(arm([], **ends), method="collocation", options=Options(refine=False))
    angles = np.cumsum(plan.transcribed.at(np.linspace(0, plan.horizon, 10_000))[0][:, :2], axis=1)
    hinges = -0.8 * np.column_stack([np.sin(angles[:, 0]), np.cos(angles[:, 0])])
    tips = hinges - 0.49 * np.column_stack([np.sin(angles[:, 1]), np.cos(angles[:, 1])])
    assert np.linalg.norm(np.diff(tips[2500:7500:250], axis=0), axis=1).max() > 0.08  # within a tenth of an interval
    for k in (2650, 3100, 3660, 4210, 4440, 5330, 5870, 6420, 6905):
        ball = dd.SphereObstacle([tips[k, 0], 0, tips[k, 1]], 1e-3, margin=1e-3, name="pin")
        along = np.clip(np.sum((tips[k] - hinges) * (tips - hinges), axis=1) / 0.49**2, 0, 1)[:, None]
        nearest = np.linalg.norm(hinges + along * (tips - hinges) - tips[k], axis=1).min()
        assert nearest < 1e-3
        (found,) = failing(replace(plan, problem=arm([ball], **ends)), "between the nodes")
        assert found.where.startswith("lower and obstacle 'pin' at "), k
        assert found.value > ball.margin, k  # the rod enters the ball


def test_steps_are_looked_at_as_closely_and_a_motion_too_wild_to_be_seen_is_none():
    constraint = arm([dd.SphereObstacle([0, 0, -1.25], 1e-3, margin=1e-3, name="pin")]).kept_goals[0]
    for turn in (0.5, 3.0, 40.0):  # in one step, with the pin in its middle
        steps = along_steps(np.array([0.0, 1.0]), np.array([[-turn / 2, 0, 0, 0], [turn / 2 + 0.3, 0, 0, 0]]))
        found = constraint.nearest(*steps, constraint.tolerance)
        assert found.where.startswith("lower and obstacle 'pin' at ")
        assert found.value > constraint.margin
    beside = along_steps(np.array([0.0, 1.0]), np.array([[0.03, 0, 0, 0], [1.0, 0, 0, 0]]))
    assert constraint.nearest(*beside, constraint.tolerance).passes  # 0.03 rad at 1.25 m, clear of 21 mm
    wild = along_steps(np.array([0.0, 1.0]), np.array([[0.03, 0, 0, 0], [1e9, 0, 0, 0]]))
    assert constraint.nearest(*wild, constraint.tolerance).value > constraint.margin


@pytest.mark.slow
def test_where_steps_jump_through_they_are_looked_at_within():
    problem = arm([BALL])
    through = dd.solve(problem, method="ilqr", max_iterations=200, options=Options(clearance_parts=()))
    assert not through.success
    assert through.constraint_violation <= 1e-5  # every knot is clear
    assert failing(through, "between the knots")[0].value > BALL.margin
    assert depth_by_drake(problem.model, through.xs, BALL, parts=50) > 0


def test_a_plan_through_an_obstacle_is_refused_and_says_by_how_much_and_when():
    without = dd.solve(arm([]), method="collocation")
    assert without.success
    problem = arm([dd.SphereObstacle([0.0, 0.0, -1.25], 0.1, name="ball")])
    through = replace(without, problem=problem)
    assert any("clear of 'ball' at knot" in c.where for c in through.plan_checks.failing)
    assert failing(through, "between the nodes")[0].value > 0.01
    found = judged(through, NlpResult(np.zeros(1), Outcome.SOLVED, "said to be solved", ()))
    assert found.status is dd.Status.CONVERGED_NOT_VERIFIED
    deep = [c for r in through.replays for c in r.checks if c.what == "clearance" and c.value > 0.01]
    assert len(deep) >= 4
    # The rod passes the middle of the ball at 0.75 s. The ball's far side is 0.1 m and the capsule's radius away.
    assert all(" at 0.7" in c.where or " at 0.8" in c.where for c in deep), deep


@each_row(
    "make, message",
    [
        (lambda: dd.SphereObstacle([0, 0], 0.1), "SphereObstacle.center"),
        (lambda: dd.SphereObstacle([0, 0, 0], -0.1), "SphereObstacle.radius"),
        (lambda: dd.SphereObstacle([0, 0, 0], 0.1, margin=-1), "SphereObstacle.margin"),
        (lambda: dd.SphereObstacle([0, 0, 0], 0.1, links="lower"), "SphereObstacle.links"),
        (lambda: dd.BoxObstacle([0, 0, 0], [0.1, 0.0, 0.1]), "BoxObstacle.size"),
        (lambda: dd.BoxObstacle([0, 0, 0], [1, 1, 1], rotation=[2, 0, 0, 0]), "norm"),
        (lambda: dd.SelfCollision(ignore=["upper"]), "SelfCollision.ignore"),
        (lambda: arm([dd.SphereObstacle([0.0, 0.0, -0.4], 0.5)]), "x0.*upper and obstacle sphere at 0, 0, -0.4 come"),
        (lambda: arm([dd.SphereObstacle([-0.7, 0.0, -0.5], 0.1)]), "x_goal.*lower and obstacle"),
    ],
    ids=str,
)
def test_what_cannot_be_is_refused_early(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_unknown_links_list_the_known_ones():
    for obstacle in (
        dd.SphereObstacle([9, 0, 0], 0.1, links=["forearm"]),
        dd.SelfCollision(ignore=[("upper", "hand")]),
    ):
        with pytest.raises(UnknownNameError, match="lower, upper"):
            arm([obstacle])


def test_what_nothing_can_reach_asks_for_nothing():
    assert arm([dd.SphereObstacle([1.5, 0, 0], 0.1)]).kept_goals == ()
    near = arm([dd.SphereObstacle([1.4, 0, 0], 0.1)]).kept_goals
    assert near[0].clearance.labels == ("lower",)
    assert arm([dd.SphereObstacle([0.9, 0, 0], 0.1, links=["upper"])]).kept_goals[0].clearance.labels == ("upper",)


def test_neighbours_and_what_always_overlaps_are_left_out_of_self_collision():
    model = example_robot("ur5_robot.urdf", 0.02)
    rest = np.array([0, -1.2, 1.2, 0, 0, 0])
    x0 = np.concatenate([rest, np.zeros(6)])
    problem = dd.Problem(model, x0=x0, num_steps=5, final_cost=lambda x: x[0] ** 2, goals=[dd.SelfCollision()])
    labels = set(problem.kept_goals[0].clearance.labels)
    assert "shoulder_link and wrist_3_link" in labels or "upper_arm_link and wrist_3_link" in labels
    assert "upper_arm_link and forearm_link" not in labels
    left = dd.SelfCollision().left_out(model)
    assert left
    assert not labels & set(left)
    with pytest.warns(ModelWarning, match=f"ignores {len(left)} pairs of links, .*{left[0]}"):
        dd.Problem(model, x0=x0, num_steps=5, final_cost=lambda x: x[0] ** 2, goals=[dd.SelfCollision()])
    some = dd.SelfCollision(ignore=[("wrist_3_link", "upper_arm_link")])
    fewer = dd.Problem(model, x0=x0, num_steps=5, final_cost=lambda x: x[0] ** 2, goals=[some])
    assert set(fewer.kept_goals[0].clearance.labels) == labels - {"upper_arm_link and wrist_3_link"}


BAR, TOP = "<box><size>0.04 0.04 0.26</size></box>", "<box><size>1 1 0.05</size></box>"


def reach(folder, at, *, margin=0.01, ignore=(), start=(0.0, 0.0), to=(0.3, 0.5)):
    """Return the problem of moving an arm from `start` to `to` with a table at `at`."""
    model = arm_beside_table(folder, BAR, TOP, at=at, actuators="all", gravity=[0, 0, 0])
    goal, cost = dd.SelfCollision(margin=margin, ignore=ignore), dd.QuadraticCost(R=np.eye(2))
    return dd.Problem(model, x0=[*start, 0, 0], x_goal=[*to, 0, 0], num_steps=20, running_cost=cost, goals=[goal])


def overlaps(model, xs):
    """Return whether shapes that Drake lets collide overlap on the way between some of xs, by its penetration query."""
    twin, found = model.changed(contact=True).double, False
    for before, after in pairwise(xs):
        for share in np.linspace(0, 1, 10):
            twin.set_state((1 - share) * before + share * after)
            found |= twin.overlaps()
    return found


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
def test_a_pair_that_overlaps_at_the_start_leaves_a_plan_undecided(tmp_path):
    """The table passes through the lower link, and no option allows this."""
    at = (0.9, 0, 0.0)
    solution = dd.solve(reach(tmp_path, at))
    assert not solution.success
    assert "lower and top overlap where the file has them" in solution.message
    assert dd.solve(reach(tmp_path, at, ignore=[("lower", "top")])).success


@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
def test_a_pair_that_overlaps_in_the_file_is_kept_clear_from_a_start_that_is(tmp_path):
    problem = reach(tmp_path, (0.9, 0, 0.0), start=(1.5, 0.5), to=(1.2, 0.8))
    assert "lower and top" in problem.kept_goals[0].clearance.labels
    goal = dd.SelfCollision()
    assert goal.left_out(problem.model, problem.x0) == ()
    assert goal.left_out(problem.model) == goal.left_out(problem.model, np.zeros(4)) == ("lower and top",)


@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
def test_a_search_begins_with_a_motion_from_rest_to_rest_where_shapes_keep_clear(tmp_path):
    """The largest rate of x(s) = 10 s^3 - 15 s^4 + 6 s^5 is 15/8. Without gravity the inputs do no work in total."""
    problem = reach(tmp_path, (0.3, 0, -0.1), start=(0.0, 0.2), to=(0.05, 1.0))
    guess, way, h = first_guess(problem, "collocation", None, 0), np.array([0.05, 0.8]), problem.time_step
    assert guess.xs[10] == pytest.approx([0.025, 0.6, *(15 / 8 * way / problem.start_horizon)])
    assert guess.xs[[0, -1], 2:] == pytest.approx(np.zeros((2, 2)))
    power = np.sum(guess.us * (guess.xs[1:, 2:] + guess.xs[:-1, 2:]) / 2, axis=1)
    assert np.abs(power.sum() * h) < 0.02 * np.abs(power).sum() * h  # to the accuracy of 20 intervals
    assert np.abs(power).max() > 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
def test_a_plan_passes_over_a_table_and_not_through_it(tmp_path):
    """The table is half a metre wide, 0.05 m high, and 0.1 m below the arm. Capsules around it would reach the arm."""
    solution = dd.solve(reach(tmp_path, (0.3, 0, -0.1), to=(0.05, 1.0)))
    assert solution.success, solution
    with pytest.raises(InputError, match=r"x_goal: .*and top come .* nearer than their margin"):
        reach(tmp_path, (0.3, 0, -0.1), to=(0.5, 0.0))
    around = dd.solve(reach(tmp_path, (0.5, 0, -0.45), to=(2.5, 0.0)))  # from above the table to below it
    assert around.success
    assert overlaps(around.problem.model, np.linspace(around.xs[0], around.xs[-1], 100))
    assert not overlaps(around.problem.model, around.xs)


def test_a_folded_arm_is_refused_by_self_collision():
    model = example_robot("ur5_robot.urdf", 0.02)
    folded = np.concatenate([[0, -1.2, 3.1, 0, 0, 0], np.zeros(6)])
    with pytest.raises(InputError, match=r"x0: .* nearer than their margin"):
        dd.Problem(model, x0=folded, num_steps=5, final_cost=lambda x: x[0] ** 2, goals=[dd.SelfCollision()])


@pytest.mark.slow
def test_obstacles_are_recorded_drawn_and_made_again(tmp_path):
    turned = RigidTransform().rotation().matrix().tolist()
    post = dd.BoxObstacle([0.0, 0.0, -1.25], [0.1, 0.4, 0.2], rotation=turned, name="post", links=["lower"])
    problem = arm([BALL, post, dd.SelfCollision()])
    (sphere,), (box,) = BALL.marks(), post.marks()
    assert (sphere.shape, sphere.size, sphere.position) == ("sphere", (0.1,), (0.0, 0.0, -1.2))
    assert (box.shape, box.size) == ("box", (0.1, 0.4, 0.2))
    solution = dd.solve(problem, method="collocation", max_iterations=200)
    record = dd.save(solution, tmp_path / "run")
    assert [next(iter(goal)) for goal in record.problem["goals"]] == ["SphereObstacle", "BoxObstacle", "SelfCollision"]
    found = dd.verify(tmp_path / "run")
    assert found.verdict == "holds", found


def test_a_soft_obstacle_is_a_cost_of_what_is_used_of_its_margin():
    hard = arm([dd.SphereObstacle([0.0, 0.0, -1.25], 0.1, margin=0.05)])
    soft = arm([dd.SphereObstacle([0.0, 0.0, -1.25], 0.1, margin=0.05, weight=200.0)])
    x = np.array([0.1, -0.05, 0, 0])
    used = np.maximum(0.05 - hard.kept_goals[0].clearance.values(x[None])[0], 0)
    assert soft.kept_goals == ()
    own = SMOOTH(x, np.zeros(2))
    assert soft.total_running_cost(x, np.zeros(2)) - own == pytest.approx(200 * used @ used, rel=1e-9)
    assert used.max() > 0.05


def test_a_problem_warns_of_links_that_are_kept_clear_as_a_skeleton(tmp_path):
    text = Path("models/double_pendulum.urdf").read_text()
    path = tmp_path / "bare.urdf"
    path.write_text(re.sub("<(visual|collision)>.*?</(visual|collision)>", "", text, flags=re.DOTALL))
    model = dd.load_model(path, time_step=0.05)
    fields = {"x0": [-1.0, 0.1, 0, 0], "num_steps": 10, "running_cost": SMOOTH}
    with pytest.warns(ModelWarning, match=r"upper, lower: no readable shape, represented by capsules"):
        dd.Problem(model, goals=[BALL], **fields)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dd.Problem(model, goals=[dd.JointGoal({"elbow": 0.5})], **fields)

"""The tasks of `benchmarks/arm_tasks.py`: what is asked is not there at the start, and the referee refuses misses."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.contact_tasks import assert_solved_and_found, drawn_task

import drake_diff as dd

sys.path.append(str(Path(__file__).parent / "benchmarks"))

from arm_tasks import HALF, LAST, TASKS, TIP, motion_of, seat

BALL, BALL_V = slice(3, 5), slice(9, 11)  # in the state of arm_cup.sdf
BOX = slice(6, 8)  # in that of the UR5 and the box


@pytest.mark.parametrize("name", TASKS)
def test_nothing_asked_is_there_where_nothing_is_done(name):
    problem = (task := drawn_task(TASKS, name)).problem
    us = np.zeros((problem.num_steps, problem.nu))
    xs = dd.rollout(problem.model, problem.x0, us).xs
    assert task.asks
    for what, measure, allowed in task.asks:
        assert measure(xs, us) > 2 * allowed, what


@pytest.mark.parametrize("name", ["throw", "catch"])
def test_an_end_just_inside_its_tolerance_is_taken_and_one_outside_is_refused(name):
    task = drawn_task(TASKS, name)
    xs, us = (np.array(part) for part in task.options["initial_guess"])
    (_, place_off, allowed), *rest = task.asks
    xs[-1, BALL] = list(task.problem.goals[0].values.values())  # sorted by name: x, z
    for part, taken in ((0.99, True), (1.01, False), (-1.01, False)):
        moved = xs.copy()
        moved[-1, BALL] += part * allowed
        assert bool(place_off(moved, us) <= allowed) is taken
    for _, speed, slow in rest:
        for knot, taken in ((-LAST, False), (-LAST - 1, True)):
            moved = xs.copy()
            moved[-LAST:, BALL_V] = 0
            moved[knot, BALL_V] = 1.01 * slow
            assert bool(speed(moved, us) <= slow) is taken


def test_a_box_just_inside_its_tolerance_is_taken_and_one_outside_is_refused():
    task = drawn_task(TASKS, "push")
    xs, us = (np.array(part) for part in task.options["initial_guess"])
    ((_, place_off, allowed),) = task.asks
    for part, taken in ((0.99, True), (1.01, False), (-1.01, False)):
        xs[-1, BOX] = np.array(list(task.problem.goals[0].values.values())) + part * allowed
        assert bool(place_off(xs, us) <= allowed) is taken


def test_the_guess_takes_the_arms_tip_along_with_the_box_and_leaves_it_where_it_is_wanted():
    task = drawn_task(TASKS, "push")
    model, (xs, _) = task.problem.model, task.options["initial_guess"]
    plant, context = model.plant, model.plant.CreateDefaultContext()
    tip, box = plant.GetFrameByName("tip"), plant.GetFrameByName("box")
    apart = []
    for x in xs:
        plant.SetPositionsAndVelocities(context, x)
        place = plant.CalcPointsPositions(context, tip, np.zeros(3), plant.world_frame()).ravel()
        assert abs(place[2] - 0.05) < 1e-6  # [m] the middle of the box; SNOPT meets its constraints to 1e-6
        apart.append(np.linalg.norm(place[:2] - x[BOX]))
        assert np.isclose(box.CalcPoseInWorld(context).translation()[2], 0.05)
    pushed = np.count_nonzero(np.abs(np.array(apart) - HALF - TIP) < 1e-5)
    assert pushed > 0.15 * len(xs)
    assert min(apart) > HALF + TIP - 1e-5
    # what it glides on is of the steps' own damping, but for 1 mm
    np.testing.assert_allclose(xs[-1, BOX], list(task.problem.goals[0].values.values()), atol=1e-3)


def test_the_target_of_a_throw_is_beyond_the_cup():
    for start in range(20):
        assert np.linalg.norm(list(drawn_task(TASKS, "throw", start).problem.goals[0].values.values())) > 0.9


def test_a_ball_in_its_seat_lies_still_where_motors_hold_the_arm():
    problem = drawn_task(TASKS, "throw").problem
    model, x = problem.model, problem.x0
    plant, context = model.plant, model.plant.CreateDefaultContext()
    plant.SetPositionsAndVelocities(context, x)
    held = -plant.CalcGravityGeneralizedForces(context)[:3]
    pose = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("cup"))
    reach = pose.translation()[0]
    upper = 0.35 * np.cos(x[0])
    held += 0.1 * 9.81 * np.array([reach, reach - upper, 0.0])
    after = dd.rollout(model, x, np.tile(held, (10, 1))).xs[-1]
    np.testing.assert_allclose(after[BALL], x[BALL], atol=1e-6)  # [m] friction's creep, and the arm's slow fall


def test_the_guess_has_the_ball_in_the_cup():
    pitch = np.array([0.0, -0.4])
    wrist = np.array([[0.4, 0.1], [0.3, -0.2]])
    xs, _ = motion_of(wrist, pitch, wrist + seat(pitch), np.zeros(6), 0.005)
    model = drawn_task(TASKS, "throw").problem.model
    plant, context = model.plant, model.plant.CreateDefaultContext()
    for x in xs:
        plant.SetPositionsAndVelocities(context, x)
        ball = plant.CalcPointsPositions(
            context, plant.GetFrameByName("ball"), np.zeros(3), plant.GetFrameByName("cup")
        ).ravel()
        # 0.04 m to the plates, sqrt(2) radii from there, sunk by its weight of 0.981 N at 500 N/m
        np.testing.assert_allclose(ball, [0, 0, 0.04 + 0.035 * np.sqrt(2) - 0.981 / 500], atol=1e-12)


@pytest.mark.parametrize("name", TASKS)
def test_the_referee_refuses_an_arm_that_does_nothing(name):
    from contact_plans import referee

    task = drawn_task(TASKS, name)
    wrong, _ = referee(task, SimpleNamespace(us=np.zeros((task.problem.num_steps, task.problem.nu))))
    assert wrong


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_a_start_is_solved_and_drake_alone_finds_what_moves_there(name):
    assert_solved_and_found(drawn_task(TASKS, name))

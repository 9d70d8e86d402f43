"""The tasks of `benchmarks/manipulation_tasks.py`: what is asked is not there at the start, and the guess touches."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.contact_tasks import assert_solved_and_found, drawn_task

import drake_diff as dd

sys.path.append(str(Path(__file__).parent / "benchmarks"))

from manipulation_tasks import BESIDE, OUT, TASKS

AT = {"spin": "spin_q", "slide": "slide_x", "bx": "bx_x", "by": "by_x"}  # the coordinate of a joint
KEPT = {"grasp": 2}  # of what is asked, at the end: it is there at first, and to be kept


@pytest.mark.parametrize("name", TASKS)
def test_nothing_asked_is_there_where_nothing_is_done(name):
    problem = (task := drawn_task(TASKS, name)).problem
    us = np.zeros((problem.num_steps, problem.nu))
    xs = dd.rollout(problem.model, problem.x0, us).xs
    assert task.asks
    for what, measure, allowed in task.asks[: len(task.asks) - KEPT.get(name, 0)]:
        assert measure(xs, us) > 5 * allowed, what


@pytest.mark.parametrize("name", ["spinner", "ball", "box"])
def test_an_end_just_inside_its_tolerance_is_taken_and_one_outside_is_refused(name):
    problem = (task := drawn_task(TASKS, name)).problem
    (goal,) = problem.goals
    ((_, measure, allowed),) = task.asks
    for part, taken in ((0.99, True), (1.01, False), (-1.01, False)):
        x = np.array(problem.x0)
        for entry, wanted in goal.values.items():
            x[problem.state_names.index(AT[entry])] = wanted + part * goal.tolerance
        assert bool(measure(x[None], np.empty((0, problem.nu))) <= allowed) is taken


def test_the_guess_takes_the_tip_beside_the_spinner_and_along_with_it():
    task = drawn_task(TASKS, "spinner")
    model, (xs, _) = task.problem.model, task.options["initial_guess"]
    plant, context = model.plant, model.plant.CreateDefaultContext()
    there = xs[round(0.4 * (len(xs) - 1)) :]
    reached = there[there[:, 1] > 0]  # the elbow: it is straight where the finger is too short
    assert len(reached) > 0.8 * len(there)
    for x in reached:
        plant.SetPositionsAndVelocities(context, x)
        tip = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("lower")) @ np.array([0.15, 0, 0])
        spinner = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("spinner"))
        # 1e-9 m: rounding of an arccos
        np.testing.assert_allclose(spinner.inverse() @ tip, [-OUT, -BESIDE, 0], atol=1e-9)


def test_the_referee_refuses_what_is_not_as_asked_and_a_task_that_asks_nothing():
    from contact_plans import referee

    task = drawn_task(TASKS, "ball")
    nothing = SimpleNamespace(us=np.zeros((task.problem.num_steps, task.problem.nu)))
    ((what, _, _),) = task.asks
    (wrong,), _ = referee(task, nothing)
    assert wrong.startswith(what)
    (wrong,), _ = referee(replace(task, asks=()), nothing)
    assert "nothing of its goal is measured" in wrong
    beyond = np.zeros_like(nothing.us)
    beyond[0] = 1.01 * task.problem.bounds.u_upper
    wrong, _ = referee(task, SimpleNamespace(us=beyond))
    assert any("beyond its limit" in one for one in wrong)


def test_a_box_that_is_dropped_leans_or_is_carried_from_below_is_refused():
    """Of a motion whose end is as asked; 2 of the 10 knots of the last 0.2 s are spoilt."""
    task = drawn_task(TASKS, "grasp")
    us = np.zeros((task.problem.num_steps, 4))
    asked = np.array(task.problem.goals[0].goal.values["z"])

    def missed(**spoilt):
        xs = np.tile(task.problem.x0, (len(us) + 1, 1))
        xs[50:, 1] = xs[50:, 4] = xs[50:, 6] = asked
        for name, (knots, value) in spoilt.items():
            xs[knots, task.problem.state_names.index(name)] = value
        return [number for number, (_, measure, allowed) in enumerate(task.asks) if not measure(xs, us) <= allowed]

    assert missed() == []
    assert missed(z_x=(slice(-5, -3), asked - 0.011)) == [0]
    assert missed(turn_q=(-1, 0.051)) == [1]
    assert missed(left_z_x=(slice(60, 62), asked - 0.12)) == [2]  # below its side: the tip carries the box


def test_a_box_that_still_rocks_is_not_flipped():
    """As it lies at the end, but for 2 of the 10 knots of the last 0.2 s."""
    task = drawn_task(TASKS, "flip")
    us = np.zeros((task.problem.num_steps, 2))
    xs = np.tile(task.problem.x0, (len(us) + 1, 1))
    xs[-20:, 2] = np.pi / 2
    ((_, measure, allowed),) = task.asks
    assert measure(xs, us) <= allowed
    xs[-5:-3, 2] -= 0.051
    assert measure(xs, us) > allowed


def test_the_guess_turns_the_box_about_its_far_edge_and_the_finger_with_it():
    task = drawn_task(TASKS, "flip")
    xs, _ = task.options["initial_guess"]
    x0 = task.problem.x0
    turn = xs[:, 2]
    edge = xs[:, :2] + np.column_stack(
        [0.05 * np.cos(turn) - 0.05 * np.sin(turn), -0.05 * np.sin(turn) - 0.05 * np.cos(turn)]
    )
    # 1e-15: rounding of sums of numbers below 1
    np.testing.assert_allclose(edge, np.tile(x0[:2] + np.array([0.05, -0.05]), (len(xs), 1)), atol=1e-15)
    there = xs[round(0.4 * (len(xs) - 1)) :]
    np.testing.assert_allclose(np.linalg.norm(there[:, 3:5] - there[:, :2], axis=1), np.hypot(0.07, 0.03), atol=1e-15)


def test_the_guess_closes_both_fingers_on_the_box_and_goes_up_with_it():
    task = drawn_task(TASKS, "grasp")
    xs, _ = task.options["initial_guess"]
    there = xs[round(0.4 * (len(xs) - 1)) :]
    # 0.07 m: half of the box and a fingertip; rounding of sums of three numbers below 1
    np.testing.assert_allclose(there[:, 0] - there[:, 3], 0.07, atol=1e-15)
    np.testing.assert_allclose(there[:, 5] - there[:, 0], 0.07, atol=1e-15)
    np.testing.assert_array_equal(there[:, 1], there[:, 4])
    np.testing.assert_array_equal(there[:, 1], there[:, 6])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spinner", "ball", "box", "grasp"])
def test_a_start_is_solved_and_drake_alone_finds_the_object_there(name):
    assert_solved_and_found(drawn_task(TASKS, name))

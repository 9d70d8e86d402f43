"""Tests of the drawings of goals: their positions, sizes and bodies."""

import numpy as np
import pytest
from helpers.models import MODELS
from pydrake.geometry import Box, Sphere

import drake_diff as dd
from drake_diff.exceptions import UnknownNameError
from drake_diff.optimize.goal_markers import drawn_goals
from drake_diff.pages.scene import scene_of


@pytest.fixture(scope="module")
def model():
    return dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)


def drawn(model, *goals):
    return drawn_goals(model.plant, model.double.context, goals)


def test_a_target_is_a_ball_where_it_was_asked_for(model):
    (ball,) = drawn(model, dd.FrameGoal("pole", position=[0.1, 0.2, 0.3], tolerance=0.04))
    assert isinstance(ball.shape, Sphere)
    assert (ball.body, ball.shape.radius()) == ("", 0.04)
    np.testing.assert_allclose(ball.pose.translation(), [0.1, 0.2, 0.3])


def test_what_is_free_is_a_long_side_of_a_box(model):
    (box,) = drawn(model, dd.FrameGoal("pole", position=[0.1, None, 0.3], tolerance=0.04))
    assert isinstance(box.shape, Box)
    assert box.shape.depth() > 10 * box.shape.width()  # y is free


def test_a_rotation_is_three_axes_turned_so(model):
    """After half a turn about y, x points back and z down. The middle of a shaft of 0.1 m is 0.05 m from the origin."""
    marks = drawn(model, dd.FrameGoal("pole", rotation=[0, 0, 1, 0]))
    middles = np.array([mark.pose.translation() for mark in marks])
    np.testing.assert_allclose(middles, [[-0.05, 0, 0], [0, 0.05, 0], [0, 0, -0.05]], atol=1e-15)
    red, green, blue = (mark.colour for mark in marks)
    assert red.r() > 0.5
    assert green.g() > 0.5
    assert blue.b() > 0.5


def test_a_velocity_goes_with_its_body_and_does_not_turn_with_it(model):
    goal = dd.FrameVelocityGoal("pole", velocity=[0.5, 0, 0], point=[0, 0, -0.5])
    marks = drawn(model, goal)
    assert {mark.body for mark in marks} == set(scene_of(model, np.arange(2.0), np.zeros((2, 2))).poses)
    for mark in marks:
        np.testing.assert_allclose(mark.origin, [0, 0, -0.5])  # on the pole, at its end
        np.testing.assert_allclose(mark.pose.translation() / np.linalg.norm(mark.pose.translation()), [1, 0, 0])


def test_an_unknown_frame_is_named(model):
    with pytest.raises(UnknownNameError, match="elbow"):
        drawn(model, dd.FrameVelocityGoal("elbow", velocity=[1, 0, 0]))

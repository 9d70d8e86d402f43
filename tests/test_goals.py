"""Goals in a robot's own words: what they check, what they come to, and that the motions found keep them."""

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError, ShapeError, UnknownNameError


@pytest.fixture(scope="module")
def arm():
    return dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.05)


@each_row(
    "given, error, words",
    [
        ({"frame": "tip"}, InputError, "no position and no rotation"),
        ({"frame": "tip", "position": [None, None, np.nan]}, InputError, "no position"),
        ({"frame": "tip", "position": [0.0, 1.0]}, ShapeError, "position"),
        ({"frame": "tip", "position": [0.0, 1.0, np.inf]}, InputError, "finite"),
        ({"frame": "tip", "position": 3.0}, InputError, "3 numbers"),
        ({"frame": 3, "position": [0, 0, 0]}, InputError, "a name"),
        ({"frame": "tip", "position": [0, 0, 0], "tolerance": 0.0}, InputError, "above 0"),
        ({"frame": "tip", "position": [0, 0, 0], "knots": 0.5}, InputError, "whole numbers"),
        ({"frame": "tip", "rotation": [0, 0, 0, 0.5]}, InputError, "norm"),
        ({"frame": "tip", "rotation": np.eye(2)}, ShapeError, "rotation"),
    ],
)
def test_a_frame_goal_refuses(given, error, words):
    with pytest.raises(error, match=words):
        dd.FrameGoal(**given)


def test_an_unknown_frame_lists_those_that_exist(arm):
    with pytest.raises(UnknownNameError, match="upper"):
        dd.Problem(arm, x0=np.zeros(4), num_steps=5, goals=dd.FrameGoal("hand", [0.1, 0, 0]))


def test_a_goal_is_made_again_from_its_values():
    goal = dd.FrameGoal("hand", [0.1, None, 0.3], [0.0, 1.0, 0.0, 0.0], tolerance=0.02, knots=[3, -1])
    ((kind, values),) = goal.to_dict().items()
    assert getattr(dd, kind)(**values) == goal
    assert goal.rotation == ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))

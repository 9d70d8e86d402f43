"""The truth in continuous time that a rollout's certificate carries: its integration, its slopes, and its verdicts."""

import numpy as np
import pytest
from helpers.bounces import Bounce

from drake_diff.motion.continuous import ContinuousMotion
from drake_diff.motion.rodas import ImplicitSteps


def test_the_implicit_step_is_of_order_five_and_follows_what_is_stiff():
    """y' = -y^2 from 1 is 1 / (1 + t); y' = -1e6 (y - sin) + cos stays on the sine (an autonomous pair [y, t])."""
    errors = []
    for count in (8, 16):
        y = np.array([1.0])
        for _ in range(count):
            y, _ = ImplicitSteps(lambda y: -(y**2), y).take(1 / count)
        errors.append(abs(y[0] - 0.5))
    assert 2**4.5 < errors[0] / errors[1] < 2**5.5

    def stiff(x):
        return np.array([-1e6 * (x[0] - np.sin(x[1])) + np.cos(x[1]), 1.0])

    x = np.zeros(2)
    for _ in range(10):
        x, _ = ImplicitSteps(stiff, x).take(0.1)
    assert x[0] == pytest.approx(np.sin(1.0), abs=1e-8)


@pytest.mark.parametrize("approximation", ["sap", "lagged"])
def test_a_motion_of_several_bounces_is_known_to_what_the_slopes_need(tmp_path, approximation):
    """A hundredth of 0.1 % of a slope of 1 over the narrowest width of 1e-4; another way, event by event."""
    ball = Bounce(2e3, relaxation_time=4e-3, dissipation=0.2, mass=0.7)
    motion = ContinuousMotion(ball.model(tmp_path / "bouncer.sdf", approximation, 0.01))
    for start in [(0.5, -0.5), (0.3, 1.0)]:
        found = motion.states(np.array(start), np.zeros((100, 0)))[-1]
        assert found == pytest.approx(ball.end(approximation, start, 1.0), abs=1e-8)


def test_a_touch_that_is_over_within_a_step_is_seen(tmp_path):
    """Thrown up from below a floor's reach: it grazes the floor by 1e-5 m in the middle of a step of 0.05 s."""
    ball = Bounce(1e6, relaxation_time=2e-3)
    model = ball.model(tmp_path / "bouncer.sdf", "sap", 0.05)
    fall = 0.175  # [s] half a step off the grid
    start = (0.1 + 9.81 * fall**2 / 2 - 1e-5, 0.0)
    found = ContinuousMotion(model).states(np.array(start), np.zeros((8, 0)))[-1]
    assert found == pytest.approx(ball.end("sap", start, 0.4), abs=1e-7)

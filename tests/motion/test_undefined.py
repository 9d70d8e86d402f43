"""A column of a gradient is reported as undefined if the loss has no slope there, and only then."""

import warnings

import numpy as np
import pytest
from helpers.models import Plant, contact_properties
from pydrake.geometry import Sphere

import drake_diff as dd
from drake_diff.exceptions import GradientError, GradientWarning, InputError
from drake_diff.motion import ParametricPolicy
from drake_diff.motion.flow import FlowSteps
from drake_diff.motion.undefined import Undefined


def ball(
    *, gravity=0.0, stiffness=1e4, dissipation=0.2, friction=0.3, approximation="lagged", relaxation=0.0, motor=False
):
    """Build a ball of 1 kg and radius 0.1 m on rails along x and z over the ground."""
    plant = Plant(0.01, approximation, gravity=gravity)
    properties = contact_properties(2 * stiffness, dissipation, friction, relaxation / 2)
    plant.ball("ball", 1.0, 0.1, properties, "x", "z")
    plant.ground(properties)
    if motor:
        plant.plant.AddJointActuator("lift", plant.plant.GetJointByName("ball_z"))
    return plant.model()


def gradient(model, x0, loss, steps, **more):
    """Return the gradient and the names of its undefined columns. Check that a warning is issued for these only."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GradientWarning)
        g = dd.differentiate_rollout(model, x0, None, loss, num_steps=steps, method="continuous", **more)
    told = [str(one.message) for one in caught if one.category is GradientWarning]
    assert len(told) == bool(g.undefined)
    return g, [one.column for one in g.undefined]


@pytest.mark.solve
def test_a_clean_bounce_and_a_pendulum_are_defined():
    g, undefined = gradient(ball(), [0, 1.0, 0, -2.0], lambda x: x[1], 100)
    assert undefined == []
    assert "undefined" not in repr(g)
    pendulum = dd.load_model("models/double_pendulum.urdf", time_step=0.01)
    with warnings.catch_warnings():
        warnings.simplefilter("error", GradientWarning)
        dd.differentiate_rollout(
            pendulum, [2.5, 1.0, 0, 0], np.zeros((200, pendulum.nu)), lambda x: x[0], method="continuous"
        )


def test_a_curve_that_is_steep_is_defined():
    """The slope of sin(30 x) over +-1e-2 differs by 1.5 %, in proportion to the square of the width."""
    model = ball(gravity=9.81)
    _, undefined = gradient(model, [0.3, 1.0, 0.5, 0], lambda x: np.sin(30 * x[0]), 20)
    assert undefined == []


@pytest.mark.parametrize(
    ("gap", "is_smooth"), [(-1e-4, False), (1e-4, False), (-3e-3, False), (3e-3, False), (3e-2, True)]
)
def test_a_ball_that_passes_another_has_a_slope_only_far_from_touching(gap, is_smooth):
    """The path of the ball misses the other ball by `gap` [m], or hits it if `gap` is negative."""
    plant = Plant(0.01, "lagged", gravity=0.0)
    properties = contact_properties(2e4, 0.2, 0.3)
    plant.ball("ball", 1.0, 0.1, properties, "x", "z")
    plant.shape(plant.plant.world_body(), Sphere(0.1), properties)
    _, undefined = gradient(plant.model(), [-0.5, 0.2 + gap, 1.5, 0], lambda x: x[3], 80)
    assert ("ball_z_x[0]" in undefined) == (not is_smooth)
    assert ("ball_z_v[0]" in undefined) == (not is_smooth)
    assert "ball_x_x[0]" not in undefined  # it changes the time of contact only


def test_what_the_entry_says_is_what_the_loss_does():
    """In closed form, the ball moves as z - v t before contact, and afterwards with the opposite velocity."""
    model, speed, gap = ball(stiffness=1e6, dissipation=0.0), 1.0, 2e-4
    x0 = [0, 0.1 + 0.2 * speed + gap, 0, -speed]
    g, undefined = gradient(model, x0, lambda x: x[3], 20)
    assert undefined == ["ball_z_x[0]", "ball_z_v[0]"]
    entry = g.undefined[0]
    assert entry.derivative == pytest.approx(0.0, abs=1e-9)
    assert entry.widths[0] == 1e-2
    assert entry.slopes[0] == pytest.approx(-speed * 2 / 2e-2, rel=1e-3)  # -v on one side, v on the other
    assert "no slope for ball_z_x[0], ball_z_v[0]" in repr(g)
    assert "over +-0.01" in repr(entry)


def test_columns_of_parameters_inputs_and_policies_are_judged():
    """The motor slows the fall of the ball, which may reach the ground at the end."""
    model = ball(gravity=9.81, motor=True)
    fall = 0.1 + 1e-5 + 9.81 * 0.2**2 / 4
    x0, half = [0, fall, 0, 0], [[9.81 / 2]] * 20
    with pytest.warns(GradientWarning, match="lift at all times"):
        g = dd.differentiate_rollout(
            model, x0, half, lambda x: x[3], method="continuous", parameters=("ball.stiffness",)
        )
    names = [one.column for one in g.undefined]
    assert "lift at all times" in names
    assert "ball.stiffness" not in names  # there is no contact
    policy = ParametricPolicy(lambda x, t, p: [p[0] + 50 * p[1] * x[1]], [9.81 / 2, 0.0])
    _, undefined = gradient(model, x0, lambda x: x[3], 20, policy=policy)
    assert {"policy[0]", "policy[1]"} <= set(undefined)
    touching = [0, 0.1 - 1e-5, 0, 1e-4]  # a marginal contact: the loss is not smooth
    g, undefined = gradient(ball(), touching, lambda x: x[3], 20, parameters=("ball.stiffness",))
    assert "ball_z_x[0]" in undefined


def test_a_loss_that_jumps_is_undefined_where_it_may_jump():
    model = ball(gravity=9.81)
    _, undefined = gradient(model, [0, 1.0, 1.0, 0], lambda x: x[0] + (1.0 if x[0] > 0.2 else 0.0), 20)
    assert undefined == ["ball_x_x[0]", "ball_x_v[0]"]


def test_where_a_motion_a_little_away_has_no_end_is_told():
    """The cart comes within 5e-3 m of its limit."""
    model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
    with pytest.warns(GradientWarning, match="a perturbed motion fails: slide_x reaches a joint limit"):
        g = dd.differentiate_rollout(model, [1.895, 0, 0.5, 0], np.zeros((20, 1)), lambda x: x[0], method="continuous")
    assert "slide_x[0]" in [one.column for one in g.undefined]


@pytest.mark.solve
def test_a_derivative_that_is_not_the_slope_that_there_is_is_not_called_undefined(monkeypatch):
    """Derivatives of too long steps are computed again at 1/100 of the tolerance. A remaining error is reported."""
    model, x0 = ball(gravity=9.81), [0, 0.5, 0.3, 0]
    right = gradient(model, x0, lambda x: x[1], 60)[0]
    real = FlowSteps.linearize

    def wrong(only_first):
        def linearize(self, flow):
            linearization = real(self, flow)
            if self.integrator.tolerance > 1e-10 or not only_first:
                linearization.jacobians[0, :, : model.nx] *= 1.05
            return linearization

        return linearize

    monkeypatch.setattr(FlowSteps, "linearize", wrong(only_first=True))
    again, undefined = gradient(model, x0, lambda x: x[1], 60)
    assert undefined == []
    assert np.allclose(again.by_x0, right.by_x0, rtol=1e-4, atol=1e-6)
    monkeypatch.setattr(FlowSteps, "linearize", wrong(only_first=False))
    g, undefined = gradient(model, x0, lambda x: x[1], 60)
    assert {"ball_z_x[0]", "ball_z_v[0]"} <= set(undefined)
    assert all(isinstance(one, Undefined) and one.missed for one in g.undefined)


@pytest.mark.slow
def test_a_smoothed_step_has_the_slope_of_its_closed_form_where_first_order_has_none():
    """The loss is 1 if the ball has reversed its velocity by the end, else 0. Its derivatives are 0.

    The derivative of E[1(z + w < z1)] with respect to z is -density(z1 - z) of the noise w.
    """
    model, speed, duration, stiffness = ball(stiffness=1e6, dissipation=0.0), 1.0, 0.05, 1e6
    turns = 0.1 + speed * (duration - np.pi / 2 / np.sqrt(stiffness))
    g, undefined = gradient(model, [0, turns + 5e-4, 0, -speed], lambda x: 0 * x[1] + (1.0 if x[3] > 0 else 0.0), 5)
    assert undefined[0] == "ball_z_x[0]"
    found = g.undefined[0].smooth(150, seed=1)
    width = float(found.noise.sigma)
    exact = -np.exp(-((5e-4 / width) ** 2) / 2) / (width * np.sqrt(2 * np.pi))
    assert width == 1e-3
    assert found.first.item() == 0
    assert found.biased.item()
    assert found.jacobian.item() == pytest.approx(exact, abs=3 * np.sqrt(found.variance.item()))
    assert np.sqrt(found.variance.item()) < 0.2 * abs(exact)
    again = g.undefined[0].smooth(150, seed=1)
    assert again.jacobian.item() == found.jacobian.item()


@pytest.mark.solve
def test_where_no_width_has_a_slope_there_is_no_number():
    """|x - 0.3| at 0.3 decreases as often as it increases."""
    g, undefined = gradient(ball(), [0.3, 1.0, 0, 0], lambda x: abs(x[0] - 0.3), 5)
    assert undefined == ["ball_x_x[0]", "ball_x_v[0]"]
    with pytest.raises(
        GradientError,
        match=r"the smoothed slope with respect to ball_x_x\[0\] is not significant with 30 samples: .* width, 1,",
    ):
        g.undefined[0].smooth(30)
    with pytest.raises(InputError, match="at least 4"):
        g.undefined[0].smooth(3)

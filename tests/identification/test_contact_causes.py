"""Check that causes of errors in models with contact are named, with noisy motions of a changed model from Drake."""

import numpy as np
import pytest
from helpers.contact_recordings import recorded

import drake_diff as dd
from drake_diff.identification import candidates, contact
from drake_diff.identification.motion import discrete_motion
from drake_diff.identification.recordings import read_pieces
from drake_diff.identification.unknowns import Unknowns, choose_unknowns

pytestmark = pytest.mark.solve

PERIOD = 0.01


def thrown(model, seed=0, samples=40, **parameters):
    """Record a ball that lands after 60 ms and slides, with noise of 0.1 mm, 0.5 mrad, 5 mm/s and 25 mrad/s."""
    x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.13, 0, 0, 1.0, 1.0, 0.1, -0.4])
    each = round(PERIOD / model.time_step)
    named = {name.replace("__", "."): value for name, value in parameters.items()}
    xs = dd.rollout(model, x0, np.zeros((each * samples, 0)), parameters=named).xs[::each]
    size = np.concatenate([np.full(4, 2.5e-4), np.full(3, 1e-4), np.full(3, 2.5e-2), np.full(3, 5e-3)])
    measured = xs + size * np.random.default_rng(seed).standard_normal(xs.shape)
    measured[:, :4] /= np.linalg.norm(measured[:, :4], axis=1, keepdims=True)
    return dd.Recording("lab", "1", PERIOD * np.arange(samples + 1), measured, np.zeros((samples, 0)))


@pytest.fixture
def ball(load):
    return load("sphere_on_ground.sdf", time_step=0.005)


def test_of_a_right_model_nothing_is_said(ball):
    w = dd.explain(ball, thrown(ball))
    assert w.sentence == "Nothing: the model explains it."
    assert w.explained


@pytest.mark.slow
def test_a_right_model_is_not_blamed_where_its_motion_is_hard_to_find():
    """For this block, simulation from the measured first state ends at twice the noise, so stiffness looked wrong."""
    model, log, name, _ = recorded("sliding_block", 0.005, False, 50009)
    w = dd.explain(model, log)
    assert not name
    assert w.names == ()
    assert w.explained


@pytest.fixture
def contact_alone(monkeypatch):
    """Skip masses and gravity to halve the time, and lift the time limit, so that a busy machine agrees."""
    monkeypatch.setattr(contact, "OF_MOTION", ())
    monkeypatch.setattr(candidates, "LONGEST_SEARCH", np.inf)


@pytest.mark.slow
@pytest.mark.parametrize(("quantity", "value"), [("friction", 0.3), ("stiffness", 13000.0)])
def test_a_change_of_a_ball_is_named(ball, quantity, value, contact_alone):
    """Drake combines the friction of both bodies into one number, so the ground's friction is named as well."""
    w = dd.explain(ball, thrown(ball, **{f"ball__{quantity}": value}))
    named = [w.names, *w.alternatives]
    assert (f"ball.{quantity}",) in named
    assert set(named) <= {(f"ball.{quantity}",), (f"ground.{quantity}",)}
    assert len(named) == 2 or quantity == "stiffness"
    low, high = w.intervals[f"ball.{quantity}"]
    assert abs(w.values[f"ball.{quantity}"] - value) < high - low  # two 95 % intervals are four standard deviations
    assert high - low < 0.2 * value
    assert w.sentence.endswith("by the model's own steps of 5 ms.")


def test_slopes_by_a_parameter_that_drake_takes_as_a_float_are_those_of_the_steps(ball):
    """Compare with differences of one step by 1e-7 of the radius of a ball in contact, which lose half the digits."""
    (radius,) = choose_unknowns(ball, None, ["ball.radius"]).each
    pieces = read_pieces(ball, thrown(ball), 0.0)
    law = discrete_motion(ball, Unknowns((radius,)), pieces)
    x = np.array([[1.0, 0, 0, 0, 0, 0, 0.099, 0, 0, 1.0, 1.0, 0.1, -0.4]])
    h, u = np.full((1, 1), 0.005), np.zeros((1, 1, 0))
    xs = law.run(radius.start, x, h, u)
    step = 1e-7 * radius.start
    by_differences = (law.run(radius.start + step, x, h, u) - law.run(radius.start - step, x, h, u))[0, 1] / (2 * step)
    (slopes,) = law.slopes(radius.start, xs, h, u)
    np.testing.assert_allclose(
        slopes.by_z[0, 0, :, 0], by_differences, rtol=0, atol=1e-3 * np.abs(by_differences).max()
    )

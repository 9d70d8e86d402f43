"""What is wrong in a model whose bodies touch, by name: Drake's motions of a model that is changed, with noise."""

import sys
from pathlib import Path

import numpy as np
import pytest

import drake_diff as dd

sys.path.append(str(Path(__file__).parent / "benchmarks"))
import identify_contact_causes

PERIOD = 0.01


def thrown(model, seed=0, samples=40, **parameters):
    """A ball that hits the ground after 60 ms and slides: 0.1 mm, 0.5 mrad, 5 mm/s and 25 mrad/s of noise."""
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


def test_a_right_model_is_not_blamed_where_its_motion_is_hard_to_find():
    """Steps from the measured first state of this block end at twice the noise, from which stiffness looked wrong."""
    model, log, name, _ = identify_contact_causes.recorded("sliding_block", 0.005, False, 50009)
    w = dd.explain(model, log)
    assert not name
    assert w.names == ()
    assert w.explained


@pytest.mark.slow
@pytest.mark.parametrize(("quantity", "value"), [("friction", 0.3), ("stiffness", 13000.0)])
def test_a_change_of_a_ball_is_named_beside_the_same_of_the_ground(ball, quantity, value):
    """Drake makes one number of both bodies that touch."""
    w = dd.explain(ball, thrown(ball, **{f"ball__{quantity}": value}))
    assert {w.names, *w.alternatives} == {(f"ball.{quantity}",), (f"ground.{quantity}",)}, w
    low, high = w.intervals[f"ball.{quantity}"]
    assert abs(w.values[f"ball.{quantity}"] - value) < high - low  # two intervals of 95 %: four deviations
    assert high - low < 0.2 * value
    assert w.sentence.endswith("the recording cannot tell, by the model's own steps of 5 ms.")


@pytest.mark.slow
def test_two_changes_are_not_explained_by_one(ball):
    w = dd.explain(ball, thrown(ball, ball__friction=0.2, ball__stiffness=8000.0, ball__mass=1.5))
    assert w.names == ()
    assert not w.explained
    assert w.sentence.startswith("Not explained: no change that was tried")


@pytest.mark.slow
def test_of_a_hopper_a_radius_is_named_beside_the_height_of_the_ground():
    model, log, name, truth = identify_contact_causes.recorded("hopper", 0.005, True, 4)
    assert name == "z_x.bias"
    w = dd.explain(model, log)
    assert {w.names, *w.alternatives} == {("foot.radius",), ("z_x.bias",)}
    assert w.values["z_x.bias"] == pytest.approx(truth["z_x"], abs=2e-4)  # [m] four times half of its interval

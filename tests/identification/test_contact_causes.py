"""What is wrong in a model whose bodies touch, by name: Drake's motions of a model that is changed, with noise."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.table import each_row

import drake_diff as dd
from drake_diff.identification import contact
from drake_diff.identification.contact import Fitted, Point, WholeMotions
from drake_diff.identification.recordings import Chart, read_pieces
from drake_diff.identification.unknowns import Unknown, choose_unknowns
from drake_diff.mechanics.description import coordinates_of

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import identify_contact_causes

pytestmark = pytest.mark.solve

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


@pytest.mark.slow
def test_a_right_model_is_not_blamed_where_its_motion_is_hard_to_find():
    """Steps from the measured first state of this block end at twice the noise, from which stiffness looked wrong."""
    model, log, name, _ = identify_contact_causes.recorded("sliding_block", 0.005, False, 50009)
    w = dd.explain(model, log)
    assert not name
    assert w.names == ()
    assert w.explained


@pytest.fixture
def contact_alone(monkeypatch):
    """Masses and gravity are not tried, which takes half of the time; a busy machine says the same."""
    monkeypatch.setattr(contact, "OF_MOTION", ())
    monkeypatch.setattr(contact, "LONGEST_SEARCH", np.inf)


@pytest.mark.slow
@pytest.mark.parametrize(("quantity", "value"), [("friction", 0.3), ("stiffness", 13000.0)])
def test_a_change_of_a_ball_is_named(ball, quantity, value, contact_alone):
    """Drake makes one number of both bodies' friction, so that the ground's is told beside the ball's."""
    w = dd.explain(ball, thrown(ball, **{f"ball__{quantity}": value}))
    named = [w.names, *w.alternatives]
    assert (f"ball.{quantity}",) in named
    assert set(named) <= {(f"ball.{quantity}",), (f"ground.{quantity}",)}
    assert len(named) == 2 or quantity == "stiffness"
    low, high = w.intervals[f"ball.{quantity}"]
    assert abs(w.values[f"ball.{quantity}"] - value) < high - low  # two intervals of 95 %: four deviations
    assert high - low < 0.2 * value
    assert w.sentence.endswith("by the model's own steps of 5 ms.")


def test_slopes_are_those_of_differences_of_motions():
    """A hopper that lands, with a ground that is higher than was recorded; differences of 1e-7 of what is left."""
    model, log, _, _ = identify_contact_causes.recorded("hopper", 0.005, True, 4)
    chart = Chart(coordinates_of(model))
    motions = WholeMotions(model, chart, read_pieces(model, log, 0.0), np.full(chart.size, np.nan))
    (height,) = choose_unknowns(model, None, ["z_x.bias"]).each
    point = motions.at(height, np.array([0.1]), (log.xs[0],), 0.5)
    slopes = motions.slopes(height, point, 0.5)
    for column, step in zip(slopes.T, 1e-7 * np.eye(len(slopes.T)), strict=True):
        by_differences = (motions.moved(height, point, step, 0.5).r - point.r) / 1e-7
        np.testing.assert_allclose(column, by_differences, rtol=0, atol=1e-3 * np.linalg.norm(by_differences))


@each_row(
    "start, value, half, nothing",
    [(1.0, 1.0005, 1e-6, True), (1.0, 1.3, 0.01, False), (1.0, 1.3, 0.4, True), (1.0, 1.3, np.inf, False)],
)
def test_a_change_that_is_none_is_told_from_one(start, value, half, nothing):
    own, each = mass_of(start, value, half, 0.0)
    assert contact.is_nothing(own, each) == nothing


def mass_of(start, value, half, score, name="ball.mass"):
    """A mass with how a change of it fits."""
    own = Unknown(name, "kg", np.array([start]), 0.0, start)
    point = Point(np.log([value / start]), (), np.zeros(1))
    interval = np.array([[value - half, value + half]])
    return own, Fitted(name, score, 1, True, "", np.array([value]), interval, point, np.array([half]))


@each_row("other, names", [(None, ()), (45.0, ()), (10.0, ("box.mass",))])
def test_a_change_that_is_none_blames_no_model(other, names):
    """It finds a better motion than the model's own search; a real change must leave clearly less than that one."""
    own, none = mass_of(1.0, 1.0005, 1e-6, 50.0)
    tried, fitted = [own], [none]
    if other is not None:
        real = mass_of(1.0, 1.3, 0.01, other, "box.mass")
        tried.append(real[0])
        fitted.append(real[1])
    base = none._replace(name="", score=100.0)
    search = SimpleNamespace(
        ended_early=False,
        model=SimpleNamespace(time_step=0.001),
        motions=SimpleNamespace(widened=lambda _, one: one),
        bic=lambda one: one.score,
        limit=lambda *_: 20.0,
        words=contact._Search.words,
    )
    w = contact._Search.said(search, base, fitted, tried)
    assert w.explained
    assert w.names == names

"""Check input delays, priors and bounds, with closed forms and then with a robot in another simulator."""

import numpy as np
import pytest
from helpers.estimates import assert_known
from helpers.models import MODELS
from helpers.pendulum import swing
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff.cli.main import app
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.identification.fit import Fit, cut_segments
from drake_diff.identification.motion import TreeMotion
from drake_diff.identification.recordings import Excerpt
from drake_diff.identification.tree import tree_for_identification
from drake_diff.identification.unknowns import choose_unknowns

pytestmark = pytest.mark.solve


def pushed(t, us, period, delay, mass):
    """Return the position of a pushed block: the double integral of inputs that act `delay` after the recorded time."""
    begin = period * np.arange(len(us)) + delay
    begin[0] = min(begin[0], 0.0)  # the first input acts from the start
    ends = np.append(begin[1:], np.inf)
    x = 0.2 - 0.1 * t
    for a, b, u in zip(begin, ends, us, strict=True):
        during = np.clip(np.minimum(t, b) - max(a, 0.0), 0, None)
        x += u / mass * (during**2 / 2 + during * np.maximum(t - b, 0))
    return x


def rail(model, delay, mass=2.0, noise=1e-3, n=150):
    period, random = 0.02, np.random.default_rng(1)
    t = period * np.arange(n + 1)
    us = 3 * np.sin(2 * np.pi * t[:-1]) + random.uniform(-1, 1, n)
    x = pushed(t, us, period, delay, mass) + noise * random.standard_normal(n + 1)
    return dd.Recording("rail", "1", t, np.column_stack([x, np.full(n + 1, np.nan)]), us[:, None])


@pytest.mark.slow
def test_a_delay_is_found_to_a_part_of_a_sample(write_urdf):
    model = write_urdf(mass=2.0)
    for delay in (0.013, 0.06):
        e = dd.identify(model, rail(model, delay), ["model.input_delay", "block.mass"])
        assert_known(e, "model.input_delay", delay, 0.004)  # the samples are 0.02 s apart
    e = dd.identify(model, rail(model, 0.0), ["model.input_delay"])
    assert e.intervals["model.input_delay"][0] == 0.0
    assert e.values["model.input_delay"] < 0.002


def test_the_derivative_by_a_delay_is_that_of_differences(load):
    """Inputs jump between samples, at a sample of the previous piece, and several times in one step."""
    model = load("double_pendulum.urdf")
    tree = tree_for_identification(model)
    unknowns = choose_unknowns(model, tree, ["model.input_delay", "lower.mass"])
    random = np.random.default_rng(0)
    times = np.cumsum(random.uniform(0.005, 0.03, 40))
    whole = Excerpt("lab", times, np.zeros((40, 4)), random.uniform(-1, 1, (39, 2)), held_out=False)
    piece = whole.part(8, 30)
    law = TreeMotion(model, tree, unknowns, 0.01)
    fit = Fit(model, law, unknowns, [piece], np.array([1e-3, 1e-3, np.nan, np.nan]))
    s = fit.segments
    starts = 0.3 * np.sin(np.arange(4 * len(s.first))).reshape(-1, 4)

    def residuals(delay):
        point = fit.at(np.array([delay, 0.0]), starts)
        return np.concatenate(point.residuals)[:, :2]

    delay, h = 0.0371, 1e-6
    z = np.array([delay, 0.0])
    point = fit.at(z, starts)
    segments = cut_segments(law, [piece], model.nu, delay)
    assert np.max(np.count_nonzero(segments.hs, axis=1)) > 15
    (slopes,) = law.slopes(z, point.xs, segments.hs, segments.us)
    rates = law.rates(unknowns.values(z), point.xs[:, 1:].reshape(-1, 4), segments.us.reshape(-1, 2))
    by_delay = rates.reshape(slopes.by_z.shape[:3]) * segments.by_delay[..., None]
    found = []
    for k in range(len(s.first)):
        moved, each = np.zeros(4), [np.zeros(4)]
        for m in range(segments.hs.shape[1]):
            moved = slopes.by_x[k, m] @ moved + by_delay[k, m]
            each.append(moved)
        found.append(-np.array(each)[segments.at[k], :2] / 1e-3)
    wanted = (residuals(delay + h) - residuals(delay - h)) / (2 * h)
    # Residuals of 1e3 with rounding of 1e-13 give 1e-4 in differences over 2e-6 s. The derivatives are 10 and more.
    np.testing.assert_allclose(np.concatenate(found), wanted, atol=1e-3)


def test_a_prior_counts_as_a_measurement(write_urdf):
    """The problem is linear in the strength, so the result is the mean weighted by the inverse variances."""
    model = write_urdf(mass=2.0)
    log, name = rail(model, 0.0, noise=0.02), f"{model.input_names[0]}.strength"
    noise = {model.position_names[0]: 0.02}
    alone = dd.identify(model, log, [name], noise=noise, held_out=0)
    own = np.sqrt(alone.covariance[0, 0])
    both = dd.identify(model, log, [name], noise=noise, held_out=0, priors={name: (1.0 + 2 * own, own)})
    assert both.values[name] == pytest.approx((alone.values[name] + 1.0 + 2 * own) / 2, abs=1e-3 * own)
    assert both.covariance[0, 0] == pytest.approx(own**2 / 2, rel=1e-4)
    assert both.explained, both.reason
    far = dd.identify(model, log, [name], noise=noise, held_out=0, priors={name: (1.0 + 20 * own, own)})
    assert not far.explained
    assert "standard deviations from its prior" in far.reason


def test_a_prior_tells_apart_what_the_data_do_not(load):
    model, names = load("pendulum.urdf"), ["hinge.damping", "pole.mass"]
    e = dd.identify(model, swing(), names, priors={"pole.mass": (1.0, 0.02)})
    assert e.unidentifiable == ()
    low, high = e.intervals["pole.mass"]
    assert (high - low) / 2 == pytest.approx(1.97 * 0.02, rel=0.02)  # Student's t for 155 samples
    assert low < 1.0 < high


def test_bounds_hold_and_are_told(load):
    model = load("pendulum.urdf")
    e = dd.identify(model, swing(damping=0.15), ["hinge.damping"], bounds={"hinge.damping": (0.0, 0.12)})
    assert e.values["hinge.damping"] == pytest.approx(0.12)
    assert "hinge.damping is at its bound, 0.12" in e.sentence
    assert not e.explained
    inside = dd.identify(model, swing(damping=0.15), ["hinge.damping"], bounds={"hinge.damping": (0.12, 0.3)})
    assert inside.explained, inside.reason
    e = dd.identify(model, swing(), ["pole.mass", "hinge.damping"], bounds={"pole.mass": (1.5, 2.0)})
    assert 1.5 <= e.values["pole.mass"] <= 2.0


def test_what_makes_no_sense_is_refused(load):
    model, log = load("pendulum.urdf"), swing()

    def refused(error, words, **more):
        with pytest.raises(error, match=words):
            dd.identify(model, log, ["hinge.damping", "pole.mass"], **more)

    refused(UnknownNameError, "prior of", priors={"hinge.dumping": (0.1, 0.1)})
    refused(InputError, "above 0", priors={"pole.mass": (1.0, 0.0)})
    refused(InputError, "mean above 0", priors={"pole.mass": (-1.0, 0.1)})
    refused(UnknownNameError, "bounds of", bounds={"hinge.dumping": (0.1, 0.2)})
    refused(InputError, "below the upper", bounds={"hinge.damping": (0.2, 0.1)})
    refused(InputError, "a lower and an upper", bounds={"hinge.damping": 0.1})
    with pytest.raises(InputError, match="continuous"):
        dd.identify(model, log, ["model.input_delay"], motion="steps")


def test_priors_and_bounds_are_kept_and_come_out_again(tmp_path):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
    log = swing(damping=0.15, times=np.linspace(0, 1, 81))
    rows = [f"{t!r},{x!r},0" for t, x in zip(log.times.tolist(), log.xs[:, 0].tolist(), strict=True)]
    path = tmp_path / "lab.csv"
    path.write_text("\n".join([f"time,hinge_q,{model.input_names[0]}", *rows]))
    words = ["identify", str(MODELS / "pendulum.urdf"), "--recording", str(path)]
    words += ["--parameters", "hinge.damping,pole.mass"]
    more = ["--prior", "pole.mass=1,0.02", "--bounds", "hinge.damping=0,1", "--out", str(tmp_path / "run")]
    result = CliRunner().invoke(app, [*words, *more])
    assert result.exit_code == 0, result.output
    record = dd.load_record(tmp_path / "run")
    assert record.inputs.priors == {"pole.mass": [[1.0], [0.02]]}
    assert record.inputs.bounds == {"hinge.damping": [0.0, 1.0]}
    assert "Prior of pole.mass: 1 ± 0.02" in (tmp_path / "run" / "report.html").read_text()
    assert dd.verify(tmp_path / "run").holds
    refused = CliRunner().invoke(app, [*words, "--prior", "pole.mass=1"])
    assert isinstance(refused.exception, InputError)

"""Check the promised accuracy of exciting motions, against closed forms and estimates from noisy motions."""

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row
from typer.testing import CliRunner

from drake_diff.cli.main import app
from drake_diff.comparison import read_recording
from drake_diff.exceptions import DrakeDiffError, InputError, UnknownNameError
from drake_diff.identification import excite

pytestmark = pytest.mark.solve

SIGMA, LIMITS = 0.002, {"slide_x": 0.5, "slide_v": 2.0, "push": 3.0}
RAIL = {"duration": 1.0, "period": 0.02, "noise": {"slide_x": SIGMA}, "limits": LIMITS, "harmonics": 2}


def test_what_is_promised_of_a_block_is_the_textbooks_and_more_than_random_motion_gives(write_urdf):
    """x = x0 + v0 t + s (double integral of u / m) is linear in x0, v0 and the strength s. The mass is 1 / s."""
    model, found = write_urdf(mass=2.0), {}
    assert (*model.state_names, *model.input_names) == tuple(RAIL["limits"])
    for name, most in (("push.strength", 4), ("push.strength", 0), ("block.mass", 0)):
        e = excite(model, [name], **RAIL, max_iterations=most)
        moved = e.xs[:, 0] - e.xs[0, 0]  # the effect of s = 1, as the block starts from rest
        X = np.column_stack([np.ones(51), e.times, moved])
        deviation = SIGMA * np.sqrt(np.linalg.inv(X.T @ X)[2, 2])
        wanted = deviation * (2.0 if name == "block.mass" else 1.0)
        # The values differ by rounding and by the error of Runge-Kutta steps of order 8.
        assert e.deviations[name] == pytest.approx(wanted, rel=1e-6)
        assert np.all(np.abs(e.xs) <= [0.5, 2.0])
        assert np.all(np.abs(e.us) <= 3.0)
        assert e.rest[name] == np.inf
        found[name, most] = e
    best = found["push.strength", 4]
    (name,) = best.deviations
    assert best.deviations[name] < 0.8 * found[name, 0].deviations[name]  # the value for the best of 15 random motions
    assert best.deviations[name] < 0.5 * best.random[name]
    assert best.gain == pytest.approx(best.random[name] / best.deviations[name], rel=1e-2)
    # The motion is the double integral of piecewise constant inputs.
    v = np.concatenate([[0.0], np.cumsum(best.us[:, 0]) * 0.02 / 2.0])
    np.testing.assert_allclose(best.xs[:, 1], v, atol=1e-9)


def test_what_is_promised_of_friction_is_what_its_sign_does(write_urdf):
    """At friction 0, the position's derivative with respect to it is minus the double integral of sign(v) / m."""
    e = excite(write_urdf(mass=2.0), ["slide.coulomb_friction"], **RAIL, max_iterations=0)
    fine = np.linspace(0, 1, 50 * 400 + 1)
    slows = np.sign(np.interp(fine, e.times, e.xs[:, 1]))  # the speed is linear between samples
    speed = np.concatenate([[0.0], np.cumsum((slows[1:] + slows[:-1]) / 2)]) * (fine[1] - fine[0]) / 2.0
    moved = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2)])[::400] * (fine[1] - fine[0])
    X = np.column_stack([np.ones(51), e.times, moved])
    # The sum with steps of 50 us misses a reversal by at most half a step, in motions of about 0.1 s per side.
    wanted = SIGMA * np.sqrt(np.linalg.inv(X.T @ X)[2, 2])
    assert e.deviations["slide.coulomb_friction"] == pytest.approx(wanted, rel=1e-3)


def command(*words):
    return CliRunner().invoke(app, ["excite", str(MODELS / "pendulum.urdf"), *map(str, words)])


QUICK = ("--parameters", "hinge.damping", "--duration", 1, "--max-iterations", 0, "--limit", "hinge_q=-1,1.5")


def test_the_command_prints_the_sentence_and_writes_a_recording(load, tmp_path):
    out = tmp_path / "made" / "motor.csv"
    result = command(*QUICK, "--limit", "motor=4", "--out", out)
    assert result.exit_code == 0, result.output
    model = load("pendulum.urdf")
    limits = {"hinge_q": (-1, 1.5), "motor": 4.0}
    e = excite(model, ["hinge.damping"], duration=1.0, max_iterations=0, limits=limits)
    assert e.sentence in result.output
    read = read_recording(out, model)
    for one, other in ((read.times, e.times), (read.xs, e.xs), (read.us, e.us)):
        np.testing.assert_array_equal(one, other)  # the values are printed to the last bit
    assert np.max(np.abs(read.us)) <= 4


@each_row(
    "words, expected",
    [
        (("--limit", "motor"), "NAME=MOST or NAME=LOWER,UPPER"),
        (("--limit", "motor=1,2,3"), "NAME=MOST or NAME=LOWER,UPPER"),
        (("--limit", "moter=1"), "limit of"),
        (("--noise", "hinge_q"), "STATE=DEVIATION"),
        (("--x0", "0.1;0"), "numbers separated by commas"),
        (("--duration", "0.1"), "periods"),
        (("--out", "motor.txt"), "a .csv file"),
    ],
)
def test_the_command_refuses_what_makes_no_sense(words, expected):
    result = command(*QUICK, *words)
    assert isinstance(result.exception, DrakeDiffError), result.output  # the entry point turns this into exit status 2
    assert expected in str(result.exception)


def test_what_makes_no_sense_is_refused(load, write_urdf):
    model = load("cart_pole.urdf")
    with pytest.raises(InputError, match="limits of"):
        excite(write_urdf(), ["block.mass"])
    with pytest.raises(UnknownNameError, match="limit of"):
        excite(model, ["pole.mass"], limits={"nothing": 1.0})
    with pytest.raises(InputError, match="a state at rest"):
        excite(model, ["pole.mass"], x0=[0, 0, 1, 0])
    with pytest.raises(InputError, match="periods"):
        excite(model, ["pole.mass"], duration=0.1)

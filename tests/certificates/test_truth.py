"""A rollout's certificate contains the continuous-time truth: its integration, its slopes, and its verdicts."""

import dataclasses

import numpy as np
import pytest
from helpers.bounces import Bounce
from helpers.models import Plant, contact_properties
from helpers.table import slow_after

import drake_diff as dd
from drake_diff.certificates.truth import TrueSlope, judged, softest_contact
from drake_diff.exceptions import InputError
from drake_diff.motion.continuous import ContinuousMotion

pytestmark = pytest.mark.solve


@pytest.mark.parametrize("approximation", slow_after(1, ["sap", "lagged"]))
def test_a_motion_of_several_bounces_is_known_to_what_the_slopes_need(tmp_path, approximation):
    """1e-8 is below 0.1 % of a slope of 1 over the smallest width, 1e-4. `Bounce` integrates from event to event."""
    ball = Bounce(2e3, relaxation_time=4e-3, dissipation=0.2, mass=0.7)
    motion = ContinuousMotion(ball.model(tmp_path / "bouncer.sdf", approximation, 0.01))
    for start in [(0.5, -0.5), (0.3, 1.0)]:
        found = motion.states(np.array(start), np.zeros((100, 0)))[-1]
        assert found == pytest.approx(ball.end(approximation, start, 1.0), abs=1e-8)


def test_a_touch_that_is_over_within_a_step_is_seen(tmp_path):
    """A dropped ball touches the floor for about 3 ms in the middle of a step of 0.05 s."""
    ball = Bounce(1e6, relaxation_time=2e-3)
    model = ball.model(tmp_path / "bouncer.sdf", "sap", 0.05)
    fall = 0.175  # [s] half a step off the grid
    start = (0.1 + 9.81 * fall**2 / 2 - 1e-5, 0.0)
    found = ContinuousMotion(model).states(np.array(start), np.zeros((8, 0)))[-1]
    assert found == pytest.approx(ball.end("sap", start, 0.4), abs=1e-7)


DROP, STEPS = (0.6, 0.0), 50  # steps of 10 ms; the ball reaches the floor after 0.319 s at 3.13 m/s


def height(x):
    return x[0]


@pytest.fixture
def dropped(tmp_path):
    """Return a function that builds a ball that falls on a floor, and its model with steps of 10 ms."""

    def make(approximation, **law):
        ball = Bounce(1e4, **law)
        return ball, ball.model(tmp_path / "bouncer.sdf", approximation, 0.01)

    return make


@pytest.mark.slow
def test_the_truth_of_a_bounce_is_that_of_its_events_and_the_steps_have_another_sign(dropped):
    ball, model = dropped("lagged", dissipation=0.2)
    exact, uncertain = ball.slopes("lagged", DROP, 0.5)
    assert uncertain < 1e-4
    certificate = dd.certify_rollout(model, DROP, None, height, num_steps=STEPS, refine=True, seconds=60)
    truth = certificate.truth
    assert truth.law == "Hunt-Crossley"
    assert truth.other_law == ""  # Drake's continuous plant has the same law
    assert truth.loss == pytest.approx(ball.end("lagged", DROP, 0.5)[0], abs=1e-8)
    for slope, value in zip(truth.slopes, exact, strict=True):
        assert slope.exists, str(slope)
        assert slope.value == pytest.approx(value, rel=1e-3, abs=1e-4)
        assert abs(slope.value - value) <= slope.error + uncertain
        assert slope.sign_agrees == (np.sign(slope.ours) == np.sign(value))
        assert slope.agrees == (abs(slope.ours - value) <= 0.011 * max(abs(slope.ours), abs(value)))
    assert len(truth.wrong) == 2
    assert "in continuous time (Hunt-Crossley, k x (1 + d x')+) the loss is" in str(certificate)
    assert "time-stepping error" in str(certificate)
    assert "2 of 2 slopes differ from the gradient, first d loss / d slide_x[0]" in str(certificate), str(certificate)


@pytest.mark.slow
def test_the_difference_of_the_laws_is_measured_apart_from_the_error_of_the_step(dropped):
    """`sap` uses the relaxation time, and Drake's continuous plant Hunt and Crossley's law, both from the same file."""
    ball, model = dropped("sap", relaxation_time=0.01, dissipation=0.3)
    truth = dd.certify_rollout(model, DROP, None, height, num_steps=STEPS, refine=True, seconds=60).truth
    own, other = (ball.end(law, DROP, 0.5)[0] for law in ("sap", "lagged"))
    assert (truth.law, truth.other_law) == ("Kelvin-Voigt", "Hunt-Crossley")
    assert truth.loss == pytest.approx(own, abs=1e-8)
    assert truth.by_other_law == pytest.approx(other - own, abs=1e-6)
    slopes = [ball.slopes(law, DROP, 0.5)[0] for law in ("sap", "lagged")]
    for i, slope in enumerate(truth.slopes):
        assert slope.value == pytest.approx(slopes[0][i], rel=1e-3)
        assert slope.by_other_law == pytest.approx(slopes[1][i] - slopes[0][i], rel=1e-2, abs=1e-3)
    assert "difference to Hunt-Crossley, the contact law of Drake's continuous plant: the loss changes by" in str(truth)


@pytest.mark.parametrize("approximation", slow_after(1, ["sap", "lagged"]))
def test_steps_tend_to_the_law_that_is_named(tmp_path, approximation):
    """After a contact of 10 ms, the ball's speed converges at first order in h to the speed of its own contact law."""
    ball, start = Bounce(1e5, relaxation_time=1e-3, dissipation=0.1), (0.1005, -1.0)
    files = tmp_path / "fine.sdf", tmp_path / "coarse.sdf"
    fine = ball.model(files[0], approximation, 2e-5)
    once, twice = (
        dd.rollout(fine.at_time_step(h), start, None, num_steps=round(0.015 / h)).xs[-1][1] for h in (2e-5, 1e-5)
    )
    model = ball.model(files[1], approximation, 1e-3)
    ends = {
        law: ContinuousMotion(model, law).states(np.array(start), np.zeros((15, 0)))[-1]
        for law in ("Kelvin-Voigt", "Hunt-Crossley")
    }
    own, other = ends.values() if approximation == "sap" else reversed(ends.values())
    assert own == pytest.approx(ball.end(approximation, start, 0.015), abs=1e-6)
    assert (once - own[1]) / (twice - own[1]) == pytest.approx(2.0, abs=0.1)
    assert 2 * twice - once == pytest.approx(own[1], abs=3e-4)  # second order: a multiple of (1e-5 s times 316 / s)^2
    assert abs(other[1] - own[1]) > 0.1


def test_a_slope_that_is_not_measured_in_time_is_unknown_and_not_absent(dropped):
    _, model = dropped("lagged")
    certificate = dd.certify_rollout(model, DROP, None, height, num_steps=STEPS, method="continuous", seconds=1e-6)
    assert certificate.verdict == "undecided"
    for slope in certificate.truth.slopes:
        assert slope.exists is None
        assert slope.agrees is None
        assert "not measured within the time limit of 1e-06 s" in str(slope)


def test_a_graze_has_no_slope_and_that_is_its_own_answer(dropped):
    """The ball reaches the floor exactly at the end of the motion, or not at all."""
    _, model = dropped("sap", relaxation_time=0.01)
    start = (0.1 + 9.81 * 0.2**2 / 2, 0.0)  # the ball reaches the floor at the end of the last step
    certificate = dd.certify_rollout(model, start, None, lambda x: x[1], num_steps=20, method="continuous", seconds=60)
    assert certificate.verdict == "discontinuous", str(certificate)
    assert [slope.exists for slope in certificate.truth.slopes] == [False, False]
    assert "the loss has a kink: slope" in str(certificate)


@pytest.mark.slow
def test_the_gradient_in_continuous_time_is_certified_and_wrong_ones_are_not(dropped):
    _, model = dropped("lagged", relaxation_time=0.005, dissipation=0.2)
    start, arguments = (0.2, -2.0), {"num_steps": 15, "seconds": 60}
    certificate = dd.certify_rollout(
        model, start, None, height, method="continuous", parameters=("ball.stiffness",), **arguments
    ).require()
    assert certificate.columns == ("slide_x[0]", "slide_v[0]", "ball.stiffness")
    right = dd.differentiate_rollout(model, start, None, height, num_steps=15, method="continuous")
    for by_x0 in (1.02 * right.by_x0, -right.by_x0, right.by_x0 * [0, 1]):
        wrong = dataclasses.replace(right, by_x0=by_x0)
        found = dd.certify_rollout(model, start, None, height, gradient=wrong, **arguments)  # in continuous time
        assert found.verdict == "disagree", str(found)
    plain = dd.differentiate_rollout(model, start, None, height, num_steps=15)
    found = dd.certify_rollout(model, start, None, height, gradient=plain, method="continuous", **arguments)
    assert found.verdict == "disagree"


def test_a_closed_loop_in_continuous_time_is_certified(load):
    model = load("pendulum.urdf")
    certificate = dd.certify_rollout(
        model, [0.5, 0.1], None, height, policy=dd.PD(model, kp=3.0, kd=0.2), num_steps=40, method="continuous"
    ).require()
    assert certificate.columns[:2] == ("hinge_q[0]", "hinge_w[0]")
    with pytest.raises(InputError, match="sampled or refine in continuous time"):
        dd.certify_rollout(model, [0.5, 0.1], np.zeros((4, 1)), height, method="continuous", sampled=True)


def test_a_slope_exists_where_the_narrow_ones_agree_and_the_wide_one_as_on_a_curve():
    """For f = s w + c w^3 / 6, the slopes over +-w are s + c w^2 / 6. Near a corner they have another form."""
    still = np.zeros(3)

    def over(*slopes, widths=(1e-2, 5e-3, 1e-3, 1e-4), corners=(0.0, 0.0)):
        return TrueSlope("z", (0,), 1.0, widths, slopes, corners)

    three = (1e-2, 1e-3, 1e-4)
    assert judged(over(*(1 + 600 * w**2 / 6 for w in (1e-2, 5e-3, 1e-3, 1e-4))), still, 0.0).exists
    assert judged(over(1.0005, 1.0, 1.0, widths=three, corners=(1e-1, 1e-2)), still, 0.0).exists
    assert judged(over(1.4, 1.3, 1.0, 1.0), still, 0.0).exists is False
    assert judged(over(-4.6, 2.0, 0.9, -8.1), still, 0.0).exists is False
    corner = judged(over(1.0, 1.0, 1.0, widths=three, corners=(0.5, 0.5)), still, 0.0)
    assert corner.exists is False
    assert corner.reason == "the loss has a kink: slope 1.25 ahead, 0.75 behind"
    # An error of 1e-5 in the loss is 0.1 in a slope over 1e-4. It is unknown, unless it is far from convergence.
    noise = np.full(3, 1e-5)
    assert judged(over(1.0, 1.0, 1.0, widths=three), noise, 1e-3).exists is None
    assert judged(over(1.0, 1.0, 1.0, 9.0), noise, 1e-3).exists is False


@pytest.mark.parametrize("stiffness", [1e4, 1e7])
def test_contact_that_the_steps_soften_is_named_by_as_much_as_it_sinks_in(stiffness):
    """A ball at rest penetrates by m g / k, or by `factor` times m g / k if it is near-rigid at steps of 10 ms."""
    plant, properties = Plant(0.01, "sap"), contact_properties(2 * stiffness, 0.0, 0.5, 0.0)
    plant.ball("ball", 1.0, 0.1, properties)
    plant.ground(properties)
    model = plant.model()
    x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.1, *np.zeros(6)])
    xs = dd.rollout(model, x0, None, num_steps=400).xs
    told = softest_contact(model, xs[-1:])
    softer = (0.1 - xs[-1][6]) / (9.81 / stiffness)
    if stiffness == 1e4:
        assert softer == pytest.approx(1.0, rel=1e-3)
        assert told is None
    else:
        assert "times softer than specified (near-rigid)" in told
        assert float(told.split(" times")[0].split()[-1]) == pytest.approx(softer, rel=1e-2)

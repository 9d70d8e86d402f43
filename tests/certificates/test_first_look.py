"""The check along a few random directions accepts right derivatives, and doubts wrong or undefined ones."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.derivatives import scaled
from helpers.models import MODELS
from helpers.robots import example_robot, state_in_contact, state_in_range
from helpers.table import each_row

import drake_diff as dd
from drake_diff.certificates.certify import certify_inside, certify_steps, first_looks
from drake_diff.certificates.differences import is_broken
from drake_diff.certificates.directions import Claim, Screen

RANDOM = np.random.default_rng(3)
WEIGHT = RANDOM.standard_normal((5, 8)) * 10.0 ** RANDOM.uniform(-3, 3, (5, 1)) * 10.0 ** RANDOM.uniform(-3, 0, 8)


def bent(x):
    """Map (K, 8) to (K, 5). The Jacobian at 0 is WEIGHT, whose entries differ by nine orders of magnitude."""
    return np.sin(x) @ WEIGHT.T + np.cos(x[:, :1] * x[:, 1:2])


def screened(f, derivative):
    return Screen(Claim.of_matrix(np.asarray(derivative, dtype=float)), f)


def doubt(f, derivative):
    return screened(f, derivative).doubt


def test_the_jacobian_of_a_formula_passes_and_each_entry_a_percent_off_does_not():
    assert doubt(bent, WEIGHT) == ""
    for i, j in np.ndindex(WEIGHT.shape):
        assert "disagrees with" in doubt(bent, scaled(WEIGHT, (i, j), 1.0101)), (i, j)


def test_what_would_have_been_noticed_is_noticed():
    scale = np.ones(WEIGHT.shape[1])
    certificate = screened(bent, WEIGHT).certificate(WEIGHT, scale, rows=(), columns=(), method="", subject="")
    assert np.all(certificate.noticeable <= 0.01 * certificate.size)
    random, seen = np.random.default_rng(5), 0
    for _ in range(200):  # errors in all entries at once, each just significant
        error = 0.0101 * certificate.size * random.choice([-1.0, 1.0], WEIGHT.shape)
        seen += doubt(bent, WEIGHT + error) != ""
    assert seen == 200


def test_the_difference_of_one_wrong_entry_has_the_slopes_that_were_measured():
    wrong = scaled(WEIGHT, (2, 3), 2)
    screen = screened(bent, wrong)
    certificate = screen.certificate(wrong, np.ones(8), rows=(), columns=(), method="", subject="")
    # the differences have an error of 1e-9 of the largest slope
    assert certificate.difference @ screen.directions.T == pytest.approx(WEIGHT @ screen.directions.T, abs=1e-9 * 1e3)


@each_row(
    "f, slope",
    [
        (lambda x: np.abs(x), 0.0),  # a corner
        (lambda x: x + 0.02 * np.abs(x), 1.0),  # a small corner
        (lambda x: x + 1e-9 * (x > 0), 1.0),  # a jump
        (lambda x: np.floor(x / 1e-7) * 1e-7, 1.0),  # a staircase, with its average slope
        (lambda x: np.floor(x / 1e-7 + 0.5) * 1e-7, 0.0),  # a staircase, with the slope of one stair
        (lambda x: x + 1e-6 * np.floor(x / 1e-5 + 0.5), 1.0),  # a staircase that rises more than its stairs
        (lambda x: np.floor(x / 1e-3 + 0.5) * 1e-3, 0.0),  # wide stairs
        (lambda x: x + np.maximum(x - 1e-7, 0.0), 1.0),  # a corner at a distance of 1e-7
        # a small slope between larger slopes on both sides
        (lambda x: 1e-3 * x + np.maximum(np.abs(x) - 1e-4, 0) * np.sign(x), 1e-3),
    ],
)
def test_what_has_no_slope_at_the_point_is_in_doubt(f, slope):
    def both(x):
        return np.hstack([f(x[:, :1]), x[:, 1:] * 3])

    assert doubt(both, [[slope, 0.0], [0.0, 3.0]]) != ""


def test_a_column_of_zeros_is_zero():
    assert doubt(lambda x: x[:, :1], [[1.0, 0.0]]) == ""
    assert "a column that is 0" in doubt(lambda x: x[:, :1] + 1e-9 * x[:, 1:], [[1.0, 0.0]])


def test_a_wide_bend_and_a_far_corner_are_no_doubt():
    assert doubt(lambda x: x + 100 * x**2, [[1.0]]) == ""
    assert doubt(lambda x: x + np.maximum(x - 1e-3, 0.0), [[1.0]]) == ""  # a contact that begins farther away
    assert doubt(lambda x: np.hstack([x[:, 1:] ** 2, x]), [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]) == ""  # a parabola


@pytest.mark.solve
@pytest.mark.parametrize("name", ["go2.urdf", "solo12.urdf"])
@pytest.mark.parametrize("approximation", ["sap", "lagged", "similar"])
def test_robots_on_their_feet_pass_at_once_and_a_wrong_entry_is_named(name, approximation):
    model, random = example_robot(name, 0.005, approximation=approximation, feet=True), np.random.default_rng(1)
    xs = np.array([state_in_contact(model, random, depth=3e-4) for _ in range(2)])
    us = random.standard_normal((2, model.nu))
    for look in first_looks(model, xs, us, ()):
        assert look.doubt == ""
        assert look.certificate.verdict == "agree"
        assert look.certificate.power <= 0.01
        a, size = look.certificate.derivative * look.step.scale, look.screen.claim.size
        for i, j in random.permutation(np.argwhere(np.abs(a) >= size * (1 - 1e-12)))[:30]:
            assert look.step.screened(scaled(a, (i, j), 1.0101))[2] != "", (i, j)


def test_where_a_ball_just_touches_every_entry_is_looked_at():
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.001)
    x = model.default_state
    x[:4], x[4:] = [1, 0, 0, 0], 0
    x[6], x[12] = 0.1 + 1e-7, -0.1
    (found,) = certify_steps(model, x[None], np.zeros((1, 0)))
    assert found.around is not None
    assert found.verdict == certify_inside(model, x, np.zeros(0)).verdict != "agree"


def test_many_steps_agree_as_each_does():
    model, random = example_robot("ur5_robot.urdf", 0.01), np.random.default_rng(2)
    xs, us = np.array([state_in_range(model, random) for _ in range(3)]), random.standard_normal((3, model.nu))
    together = certify_steps(model, xs, us)
    for x, u, found in zip(xs, us, together, strict=True):
        assert found.verdict == certify_inside(model, x, u).verdict == "agree"
        assert "random directions" in found.told


@each_row(
    "f, broken",
    [
        (lambda t: np.sin(t), False),
        (lambda t: t + np.maximum(t - 1e-3, 0.0), False),  # a contact that begins farther away
        (lambda t: t + (t > 2e-6), False),  # one jump is no staircase
        (lambda t: t + np.maximum(t - 4e-8, 0.0), True),  # between the point and the first value on the line
        (lambda t: t + np.maximum(-t - 3e-7, 0.0), True),  # a corner on one side
        (lambda t: t + 1e-9 * (t > 0), True),
        (lambda t: np.floor(t / 1e-5 + 0.5) * 1e-5, True),  # stairs longer than the widths of the second look
        (lambda t: t + 1e-6 * np.floor(t / 1e-5 + 0.5), True),
    ],
)
def test_what_a_nearer_look_does_not_meet_is_sought_along_a_line(f, broken):
    def changes(x):
        return np.stack([f(x @ [1.0, 0.5]), x[:, 0] * 3], axis=1) - [f(np.zeros(1))[0], 0.0]

    assert bool(is_broken(changes, 2)[0]) == broken


@each_row(
    "f, doubtful",
    [
        (lambda x: x + np.maximum(x - 5e-6, 0.0), False),
        (lambda x: x + np.maximum(x - 1e-7, 0.0), True),
        (lambda x: x + 0.02 * np.abs(x), True),
        (lambda x: 1.0101 * x, True),
        (lambda x: np.floor(x / 1e-3 + 0.5) * 1e-3, True),
        (lambda x: 1e15 + x, True),  # an error of a percent is not resolved
        (lambda x: 1e9 + x, False),  # rounding: wider steps resolve it
    ],
)
def test_narrower_and_wider_steps_meet_what_is_at_the_point_and_not_what_is_beside_it(f, doubtful):
    assert (doubt(f, np.array([[1.0]])) != "") == doubtful


@pytest.mark.solve
def test_a_ball_that_has_just_touched_passes_nearer_to_the_point_where_every_entry_agrees():
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.01)
    x = model.default_state
    x[:4], x[4:] = [1, 0, 0, 0], [0.75, 0.25, 0.1 - 1.57e-6, -1.65, 0.25, 1.22, -0.3, -0.8, 0]
    (found,) = certify_steps(model, x[None], np.zeros((1, 0)))
    assert found.around is None  # it was not necessary to compare every entry
    assert "random directions" in found.told
    assert found.verdict == certify_inside(model, x, np.zeros(0)).verdict == "agree"


@pytest.mark.parametrize("thorough", [False, True])
def test_a_derivative_that_is_not_a_number_is_undecided_and_named(thorough):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    right = dd.differentiate_step(model, [0.3, 0.1], [0.2])
    wrong = replace(right, A=right.A * np.nan)
    certificate = dd.certify(model, [0.3, 0.1], [0.2], derivatives=wrong, thorough=thorough)
    assert certificate.verdict == "undecided"
    assert "d hinge_q / d hinge_q: derivative nan" in str(certificate)

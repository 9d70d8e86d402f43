"""Tests of the gradient panel of examples/studies: first and zeroth order against closed forms and theory."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.models import script
from helpers.table import each_row, slow_after

pytestmark = pytest.mark.solve

PANEL = script("examples/studies/gradient_panel.py")


@pytest.mark.parametrize(
    ("theta", "value", "gradient", "bias"),
    slow_after(
        2,
        [
            (0.3, -0.00307709811, -0.01115833969, 0.0),
            (0.7, -0.00728360895, -0.05318651088, 0.05092558118),
            (0.6, -0.00380439500, -0.00923031040, 0.00904499591),
            (1.0, -0.00852432022, 0.01541917168, -3.2564e-6),
        ],
    ),
)
def test_the_wall_has_the_bias_of_its_jumps(theta, value, gradient, bias):
    """F and dF/dx are from SciPy's `quad`, split at the jumps. The bias is minus each jump times the density at it."""
    case = PANEL.wall(sigmas=(0.05,), start=theta)
    F, slope, _ = PANEL.truth_of(case, case.start, 0.05)
    assert (F, slope[0]) == pytest.approx((value, gradient), rel=1e-8)
    q = PANEL.quality(case, "first", 0.05, samples=1000)
    assert abs(q.bias[0] - bias) < 5 * q.bias_error[0] + 1e-9
    assert q.biased == (abs(bias) > 1e-3)


@pytest.mark.slow
def test_over_the_wall_only_zeroth_order_finds_the_way():
    case = PANEL.wall()
    for sigma in case.sigmas:
        assert PANEL.quality(case, "first", sigma, samples=100).biased
        assert not PANEL.quality(case, "zeroth", sigma, samples=100).biased
    assert not any(PANEL.descend(case, "first", seed) for seed in range(10))
    assert sum(PANEL.descend(case, "zeroth", seed) for seed in range(10)) > 8


@pytest.mark.slow
def test_a_doubled_derivative_is_biased_and_the_derivative_itself_is_not():
    case = PANEL.double_integrator()
    wrong = replace(case, derivative=lambda x: 2 * case.derivative(x))
    assert not PANEL.quality(case, "first", 0.3, samples=20, seeds=3).biased
    assert PANEL.quality(wrong, "first", 0.3, samples=20, seeds=3).biased


@pytest.mark.slow
def test_the_smoothed_push_is_that_of_coulombs_law():
    """Coulomb's x = max(0, u - mu m g) h^2 N (N + 1) / 2 m, smoothed by quadrature, is independent of Drake."""
    case, h, steps, sigma = PANEL.push(), 0.02, 20, 2.0
    nodes, weights = np.polynomial.hermite_e.hermegauss(200)  # with so many nodes, a kink is smoothed to 1e-3
    reach = h**2 * steps * (steps + 1) / 2
    loss = 10 * (np.maximum(0, 2 + sigma * nodes - 4.905) * reach - 0.3) ** 2
    gradient = weights @ (loss * nodes) / weights.sum() / sigma
    value, slope, error = PANEL.truth_of(case, case.start, sigma, 400)
    assert value == pytest.approx(weights @ loss / weights.sum(), abs=0.1)  # 5 standard errors
    assert abs(slope[0] - gradient) < 5 * error[0] + 2e-3  # Drake's friction creeps by 1e-4 m
    assert abs(case.derivative(case.start)[0]) < 1e-3 * abs(gradient)  # below the friction limit, the gradient vanishes


@pytest.mark.slow
def test_on_stiff_ground_the_jumps_of_the_step_turn_the_sign_of_first_order():
    """The reference is the trapezoid rule over 401 heights, which needs neither derivatives nor samples."""
    case, sigma = PANEL.bounce(1e5), 0.01
    w = np.linspace(-5, 5, 401) * sigma
    f = np.array([case.f(case.start + a) for a in w])
    weights = np.exp(-((w / sigma) ** 2) / 2)
    gradient = np.sum(weights * f * w) / np.sum(weights) / sigma**2
    _, slope, error = PANEL.truth_of(case, case.start, sigma)
    assert abs(slope[0] - gradient) < 5 * error[0]
    first = PANEL.quality(case, "first", sigma, samples=20, seeds=3)
    assert (first.biased, first.cosine) == (True, -1)
    assert not PANEL.quality(case, "zeroth", sigma, samples=20, seeds=3).biased


@pytest.mark.slow
@pytest.mark.long
def test_stiffness_and_a_long_chaotic_horizon_make_first_order_vary_and_zeroth_hardly():
    def variances(case, sigma, samples):
        return [PANEL.quality(case, order, sigma, samples=samples, seeds=2).variance for order in ("first", "zeroth")]

    soft, stiff = (variances(PANEL.bounce(k), 0.03, 40) for k in (1e3, 1e5))
    assert stiff[0] > 3 * soft[0]
    assert stiff[1] < soft[1]
    short, long = (variances(PANEL.double_pendulum(n), 0.3, 12) for n in (25, 150))
    assert long[0] > 1000 * short[0]
    assert long[1] < 20 * short[1]
    assert short[0] < short[1]


@each_row("name", PANEL.CASES)
def test_the_derivative_of_every_case_is_that_of_its_loss(name):
    """Compare with central differences away from jumps; for stiff contact, which SAP solves to 1e-6, in flight."""
    case = PANEL.CASES[name]()
    x = {"bounce_k1e3": [0.33], "bounce_k1e5": [0.35], "push": [7.0], "wall": [0.8]}.get(name, case.start + 0.01)
    for i, entry in enumerate(case.derivative(np.array(x))):
        step = 1e-6 * np.eye(len(x))[i]
        assert (case.f(x + step) - case.f(x - step)) / 2e-6 == pytest.approx(entry, rel=1e-4, abs=1e-6)

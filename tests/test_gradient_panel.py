"""Gradient panels against closed forms, and on the tasks of the panel the verdict that theory demands."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.browser import browsing
from helpers.table import each_row, slow_after
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff.cli.main import app
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.studies.gradient_cases import CASES, bounce, double_integrator, double_pendulum, push, wall
from drake_diff.studies.gradient_estimates import ORDERS, GradientCase, descend, truth_of

A, X, SIGMA = 1.5, 0.3, 0.5


def density(t):
    return math.exp(-(t**2) / 2) / math.sqrt(2 * math.pi)


def below(t):
    return (1 + math.erf(t / math.sqrt(2))) / 2


def make(name, f, derivative, truth, start=X, **changes):
    """A case of one variable, whose F is not asked for."""
    case = GradientCase(
        name=name,
        about=name,
        f=lambda x: float(f(x[0])),
        derivative=lambda x: np.array([float(derivative(x[0]))]),
        start=[start],
        sigmas=(SIGMA,),
        rate=0.1,
        goal=0.0,
        closed_form=lambda x, sigma: (f(x[0]), np.array([truth(x[0], sigma)])),
    )
    return replace(case, **changes)


QUADRATIC = make("quadratic", lambda x: A * x**2 / 2, lambda x: A * x, lambda x, s: A * x)
STEP = make("step", lambda x: x > 0, lambda x: 0.0, lambda x, s: density(x / s) / s, start=-X)
ABSOLUTE = make("absolute", abs, np.sign, lambda x, s: 2 * below(x / s) - 1)
T, P = X / SIGMA, density(X / SIGMA) / SIGMA
M = 2 * below(T) - 1
# Of one sample: w normal, zeroth order (f(x + w) - f(x)) w / sigma^2; E w^4 = 3 sigma^4, E w^6 = 15 sigma^6,
# E[w^2; w > t sigma] = sigma^2 (t density(t) + 1 - below(t)).
VARIANCES = {
    "quadratic": (A**2 * SIGMA**2, 2 * A**2 * X**2 + 15 / 4 * A**2 * SIGMA**2),
    "step": (0.0, (T * density(T) + 1 - below(T)) / SIGMA**2 - P**2),
    "absolute": (1 - M**2, None),
}


@pytest.mark.parametrize("case", slow_after(1, [STEP, QUADRATIC, ABSOLUTE]), ids=lambda c: c.name)
def test_variance_and_bias_are_those_of_the_closed_forms(case):
    """Of 20000 samples in all a variance is known to 3 % or so (their kurtosis is below 20)."""
    panel = dd.studies.gradient_panel([case], samples=2000, seeds=10, budget=50)
    found = panel.case(case.name)
    first, zeroth = (found.at(order, SIGMA) for order in ("first", "zeroth"))
    for q, expected in zip((first, zeroth), VARIANCES[case.name], strict=True):
        if expected is not None:
            assert 2000 * q.trace == pytest.approx(expected, rel=0.1)
    assert first.biased == (case is STEP)
    assert not zeroth.biased
    if case is STEP:
        assert first.bias[0] == pytest.approx(-P, rel=1e-12)
        assert first.bias_in_errors == np.inf
        assert "first order is biased at sigma 0.5 (by 0.67, exactly)" in found.verdict  # density(0.6) / 0.5
        assert found.least_error(SIGMA) == "zeroth"
    else:
        assert found.least_error(SIGMA) == "first"


def test_the_variance_of_zeroth_order_at_a_kink():
    """f = |x| at 0: |w| w / sigma^2 has the mean 0 and the variance 3."""
    case = replace(ABSOLUTE, start=[0.0])
    found = dd.studies.gradient_panel([case], samples=2000, seeds=10, budget=50).case("absolute")
    assert 2000 * found.at("zeroth", SIGMA).trace == pytest.approx(3, rel=0.1)
    assert 2000 * found.at("first", SIGMA).trace == pytest.approx(1, rel=0.1)
    assert found.at("first", SIGMA).cosine is None


def test_estimates_spread_as_their_variances_say():
    """The variance of 300 estimates is known to 10 %."""
    found = dd.studies.gradient_panel([QUADRATIC], samples=20, seeds=300, budget=50).case("quadratic")
    for order in ("first", "zeroth"):
        q = found.at(order, SIGMA)
        assert np.var([e.gradient[0] for e in q.estimates], ddof=1) == pytest.approx(q.trace, rel=0.3)


def test_equal_evaluations_count_every_call():
    found = dd.studies.gradient_panel([QUADRATIC], samples=20, seeds=3, budget=50).case("quadratic")
    for order, functions, derivatives in (("point", 0, 1), ("first", 0, 20), ("zeroth", 21, 0), ("blend", 21, 21)):
        q = found.at(order, SIGMA)
        assert {(e.functions, e.derivatives) for e in q.estimates} == {(functions, derivatives)}
        expected = q.trace * (functions + derivatives) / 20 + (q.bias @ q.bias if q.biased else 0)
        assert q.mean_squared_error == pytest.approx(expected)


@pytest.mark.parametrize("case", [QUADRATIC, double_integrator()], ids=lambda c: c.name)
def test_a_doubled_derivative_is_called_biased(case):
    """Above and below the refusal: the same case with its own derivative shows no bias."""
    wrong = replace(case, derivative=lambda x: 2 * case.derivative(x))
    for doctored in (case, wrong):
        found = dd.studies.gradient_panel([doctored], samples=50, seeds=4, sigmas=[0.2], budget=25).case(case.name)
        assert found.at("first", 0.2).biased == found.at("point", 0.2).biased == (doctored is wrong)
        assert any(s.startswith("first order is biased") for s in found.verdict) == (doctored is wrong)
        assert not found.at("zeroth", 0.2).biased


def test_a_mass_on_a_slide_has_the_closed_form_of_its_recursion():
    """v += h u / m, x += h v by hand; first order varies by the Hessian H alone: tr Var = sigma^2 |H|^2."""
    case, z = double_integrator(0.1, 10), np.array([0.7, -0.4])

    def by_hand(z):
        x = v = 0.0
        for u in np.repeat(z, 5):
            v += 0.1 * u
            x += 0.1 * v
        return (x - 1) ** 2 + 0.1 * v**2

    assert case.f(z) == pytest.approx(by_hand(z), rel=1e-12)
    value, gradient = case.closed_form(z, 1e-9)
    assert value == pytest.approx(by_hand(z), rel=1e-12)
    assert case.derivative(z) == pytest.approx(gradient, rel=1e-9)
    unit = np.eye(2)  # differences of a quadratic are exact
    H = [[by_hand(a + b) - by_hand(a) - by_hand(b) + by_hand(0 * a) for a in unit] for b in unit]
    found = dd.studies.gradient_panel([case], samples=200, seeds=2, sigmas=[0.5], budget=25).case(case.name)
    assert 200 * found.at("first", 0.5).trace == pytest.approx(0.25 * np.sum(np.square(H)), rel=0.2)
    assert found.at("zeroth", 0.5).trace > 5 * found.at("first", 0.5).trace
    assert found.least_error(0.5) == "first"
    assert not any(q.biased for q in found.qualities)


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
    """F and dF/dx by SciPy's `quad`, split at the jumps; the bias is minus each jump times the density there."""
    case = replace(wall(sigmas=(0.05,)), start=[theta])
    truth = truth_of(case, case.start, 0.05, 2)
    assert (truth.value, truth.gradient[0]) == pytest.approx((value, gradient), rel=1e-8)
    q = dd.studies.gradient_panel([case], ["first"], samples=1000, seeds=10, budget=50).case("wall").at("first", 0.05)
    assert abs(q.bias[0] - bias) < 5 * q.bias_error[0] + 1e-9
    assert q.biased == (abs(bias) > 1e-3)


@pytest.mark.slow
def test_over_the_wall_only_zeroth_order_finds_the_way():
    panel = dd.studies.gradient_panel(["wall"], samples=100, seeds=10)
    found = panel.case("wall")
    assert all(found.at("first", sigma).biased for sigma in found.sigmas)
    assert not any(found.at("zeroth", sigma).biased for sigma in found.sigmas)
    assert found.least_error(0.2) == "zeroth"
    assert (found.rate("first").successes, found.rate("point").successes) == (0, 0)
    assert found.rate("zeroth").lower > 0.5
    assert "zeroth order shows no bias" in found.verdict


@pytest.mark.slow
def test_a_push_below_friction_has_no_derivative_to_follow():
    """A second engine: Coulomb's x = max(0, u - mu m g) h^2 N (N + 1) / 2 m, smoothed by quadrature."""
    case, h, steps, sigma = push(), 0.02, 20, 2.0
    nodes, weights = np.polynomial.hermite_e.hermegauss(200)  # a kink is smoothed to 1e-3 by so many nodes
    reach = h**2 * steps * (steps + 1) / 2
    x = np.maximum(0, 2 + sigma * nodes - 4.905) * reach
    loss = 10 * (x - 0.3) ** 2
    value = weights @ loss / weights.sum()
    gradient = weights @ (loss * nodes) / weights.sum() / sigma
    truth = truth_of(case, case.start, sigma, 400)
    assert abs(truth.value - value) < 5 * truth.value_error + 2e-3  # Drake's friction creeps by 1e-4 m
    assert abs(truth.gradient[0] - gradient) < 5 * truth.standard_error[0] + 2e-3
    assert abs(case.derivative(case.start)[0]) < 1e-3 * abs(gradient)
    assert descend(case, "zeroth", sigma, 0, budget=200, batch=10, samples=50).arrived
    run = descend(case, "point", sigma, 0, budget=30, batch=10, samples=50)
    assert not run.arrived
    assert run.x == pytest.approx([2.0], abs=0.1)


def qualities(case, sigma, samples, seeds):
    """The traces of first and zeroth order alone."""
    found = dd.studies.gradient_panel(
        [case], ["first", "zeroth"], [sigma], samples=samples, seeds=seeds, reference_samples=50, budget=22
    )
    return [found.cases[0].at(order, sigma).trace for order in ("first", "zeroth")]


@pytest.mark.slow
def test_stiffness_makes_first_order_vary_and_zeroth_no_more_than_before():
    """A slope of the contact grows with its stiffness; the loss, and what zeroth order varies by, does not."""
    soft, stiff = (qualities(bounce(k), 0.03, 100, 1) for k in (1e3, 1e5))
    assert stiff[0] > 3 * soft[0]
    assert stiff[1] < soft[1]
    assert soft[0] < soft[1]
    assert stiff[0] > stiff[1]


@pytest.mark.slow
def test_on_stiff_ground_the_jumps_of_the_step_turn_the_sign_of_first_order():
    """The truth by the trapezoid rule over 401 heights, which needs neither derivatives nor samples."""
    case, sigma = bounce(1e5), 0.01
    w = np.linspace(-5, 5, 401) * sigma
    f = np.array([case.f(case.start + a) for a in w])
    weights = np.exp(-((w / sigma) ** 2) / 2)
    gradient = np.sum(weights * f * w) / np.sum(weights) / sigma**2
    found = dd.studies.gradient_panel(
        [case], sigmas=[sigma], samples=20, seeds=3, budget=22, reference_samples=300
    ).cases[0]
    assert abs(found.truths[0].gradient[0] - gradient) < 5 * found.truths[0].standard_error[0]
    first, zeroth = found.at("first", sigma), found.at("zeroth", sigma)
    assert (first.biased, first.cosine) == (True, -1)
    assert (zeroth.biased, found.least_error(sigma)) == (False, "zeroth")


@pytest.mark.slow
def test_a_long_chaotic_horizon_makes_first_order_vary_and_zeroth_hardly():
    short, long = (qualities(double_pendulum(num_steps=n), 0.3, 30, 1) for n in (25, 150))
    assert long[0] > 1000 * short[0]
    assert long[1] < 20 * short[1]
    assert long[1] < long[0] / 100
    assert short[0] < short[1]


@each_row("name", CASES)
def test_the_derivative_of_every_case_is_that_of_its_loss(name):
    """Away from jumps, by central differences; of the stiff contact, which SAP solves to 1e-6, in flight."""
    case = CASES[name]()
    assert case.name == name
    x = {"bounce_k1e3": [0.33], "bounce_k1e5": [0.35], "push": [7.0], "wall": [0.8]}.get(name, case.start + 0.01)
    for i, entry in enumerate(case.derivative(np.array(x))):
        step = 1e-6 * np.eye(len(x))[i]
        assert (case.f(x + step) - case.f(x - step)) / 2e-6 == pytest.approx(entry, rel=1e-4, abs=1e-6)


def test_a_descent_that_leaves_the_numbers_says_so_and_has_not_arrived():
    case = replace(QUADRATIC, rate=1e9, goal=1e300)
    run = descend(case, "first", SIGMA, 0, budget=2000, batch=10, samples=10)
    assert not run.arrived
    assert run.failure.startswith("GradientError")
    assert np.isfinite(run.losses).all()
    assert len(run.losses) == len(run.evaluations) == 6


def test_the_same_seeds_give_the_same_bytes(tmp_path):
    for name in "ab":
        dd.studies.save_gradient_panel(
            dd.studies.gradient_panel([wall(), QUADRATIC], sigmas=[0.2], seeds=3), tmp_path / name
        )
    for file in ("gradient_panel.json", "gradient_panel.csv", "gradient_panel.html"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    one, other = (
        dd.studies.gradient_panel([QUADRATIC], seeds=2).case("quadratic").at("zeroth", SIGMA) for _ in range(2)
    )
    assert one.estimates[0].gradient != one.estimates[1].gradient
    assert one.estimates[1].gradient == other.estimates[1].gradient


def test_the_command_writes_table_numbers_and_page(tmp_path):
    done = CliRunner().invoke(
        app, ["gradient-panel", "--cases", "wall", "--samples", "10", "--seeds", "3", "--out", str(tmp_path)]
    )
    assert done.exit_code == 0, done.output
    assert "the descent arrived with point 0 of 1" in done.output
    record = json.loads((tmp_path / "gradient_panel.json").read_text())
    assert [case["name"] for case in record["cases"]] == ["wall"]
    rows = list(csv.DictReader((tmp_path / "gradient_panel.csv").open()))
    assert [row["order"] for row in rows] == 3 * list(ORDERS)
    assert float(rows[0]["bias"]) == record["cases"][0]["qualities"][0]["bias"]
    page = (tmp_path / "gradient_panel.html").read_text()
    assert 'id="plots"' in page
    assert "<iframe" not in page


@browsing
def test_the_page_needs_no_motion_to_draw_its_plots(tmp_path, browser):
    dd.studies.save_gradient_panel(dd.studies.gradient_panel([wall()], seeds=2), tmp_path)
    browser.get_log("browser")
    browser.get((tmp_path / "gradient_panel.html").as_uri())
    assert browser.execute_script("return document.documentElement.dataset.ready") == "yes"
    assert browser.execute_script("return document.querySelectorAll('.plot canvas').length") == 3
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


@each_row(
    "changes, message",
    [
        ({"cases": []}, "cases: expected at least one"),
        ({"cases": ["cliff"]}, "one of bounce_k1e3"),
        ({"orders": ["second"]}, "one of blend, first, point, zeroth"),
        ({"orders": []}, "orders"),
        ({"sigmas": []}, "sigmas"),
        ({"sigmas": [0.1, 0.0]}, "sigmas"),
        ({"samples": 1}, "samples: expected at least 2"),
        ({"samples": 2.5}, "samples"),
        ({"seeds": 0}, "seeds"),
        ({"batch": 1}, "batch"),
        ({"reference_samples": 1}, "reference_samples"),
        ({"budget": 20}, "budget: expected at least 22"),
    ],
)
def test_bad_input_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        dd.studies.gradient_panel(**({"cases": [QUADRATIC]} | changes))


@each_row("changes", [{"start": [np.nan]}, {"start": 1.0}, {"sigmas": ()}, {"rate": 0.0}, {"goal": float("nan")}])
def test_a_case_that_cannot_be_is_refused(changes):
    with pytest.raises(InputError, match=f"quadratic.{next(iter(changes))}"):
        replace(QUADRATIC, **changes)


def test_results_print_in_a_few_lines():
    evil = make("<script>", lambda x: A * x**2 / 2, lambda x: A * x, lambda x, s: A * x)
    panel = dd.studies.gradient_panel([evil], ["first"], seeds=2, budget=22)
    assert repr(evil) == "GradientCase('<script>': <script>; 1 variable, sigmas (0.5,))"
    assert repr(panel).splitlines()[0] == "GradientPanel(1 case, 2 seeds of 30 samples)"
    assert repr(panel.cases[0]).startswith("CasePanel(<script>)\n  least mean squared error")
    assert repr(panel.cases[0].qualities[0]).startswith("Quality(first, sigma 0.5: variance")
    assert max(len(text.splitlines()) for text in (repr(panel), repr(panel.cases[0]))) <= 5
    assert "<script>" not in panel._repr_html_()


def test_an_unknown_case_of_a_panel_is_named():
    with pytest.raises(UnknownNameError, match="quadratic"):
        dd.studies.gradient_panel([QUADRATIC], seeds=1).case("cubic")

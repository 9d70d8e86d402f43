"""Tests of the contact table of examples/studies: its closed forms, and every engine against them."""

import re
from math import cos, log, radians, sin, sqrt

import numpy as np
import pytest
from helpers.engines import needs
from helpers.models import ROOT, script
from hypothesis import given
from hypothesis import strategies as st

pytestmark = pytest.mark.solve

TABLE = script("examples/studies/contact_table.py")
CASES, Case = TABLE.CASES, TABLE.Case
G = 9.81
ENGINES = ("drake", "drake:similar", "drake:lagged", "mujoco")
positive = st.floats(0.1, 10)


@pytest.fixture(scope="module")
def found():
    needs("mujoco")
    return {(name, engine): TABLE.measure(name, engine) for name in CASES for engine in ENGINES}


def bounce(height, dissipation, duration=0.2):
    return Case("z", 0.01, round(duration / 0.01), dissipation=dissipation, height=height)


@given(positive, positive, st.floats(1e-4, 1e-2))
def test_the_stopping_distance_is_the_sum_of_its_steps_and_tends_to_the_closed_form(v0, mu, h):
    v, x, n = v0 - mu * G * h, 0.0, 0
    while v >= 0:
        x, v, n = x + h * v, v - mu * G * h, n + 1
    value, slope = TABLE.rigid_answer("stop", Case("xz", h, 1, speed=v0, friction=mu))
    assert value == pytest.approx(x, rel=1e-9, abs=1e-12)  # a sum of at most 1e5 terms
    assert slope == pytest.approx(h * n)
    assert abs(value - v0**2 / (2 * mu * G)) <= h * v0  # O(h)
    assert abs(slope - v0 / (mu * G)) <= h


def test_closed_forms_have_the_digits_of_a_pocket_calculator():
    answers = {name: TABLE.rigid_answer(name, case) for name, case in CASES.items()}
    assert answers["stop"] == pytest.approx((0.096995, 0.2), rel=1e-12)
    assert answers["slide"] == pytest.approx((2.0914415968662, 1), rel=1e-12)
    assert answers["roll"] == pytest.approx((2.396584004, 5 / 7), rel=1e-9)
    assert TABLE.rigid_answer("bounce", bounce(0.5, 0.0, 0.5)).gradient == pytest.approx(0.1320919527, rel=1e-9)


@given(st.floats(1e-3, 5), st.floats(0.1, 1))
def test_the_restitution_of_hunt_and_crossley_solves_its_equation(d, height):
    value, _ = TABLE.rigid_answer("damped bounce", bounce(height, d))
    v, e = sqrt(2 * G * height), sqrt(value / height)
    assert 0 < e < 1
    assert d * v * (1 + e) == pytest.approx(log((1 + d * v) / (1 - e * d * v)), rel=1e-6)  # 1 - e d v may be small


def test_without_gravity_in_contact_the_law_of_hunt_and_crossley_has_its_restitution():
    """The effect of gravity during a stiff contact is small: g / (v omega) is 3e-5."""
    case = Case("z", 1e-3, 200, stiffness=1e9, dissipation=0.3, height=0.05)
    assert TABLE.bounce_by_law("drake:lagged", case).value == pytest.approx(
        TABLE.rigid_answer("damped bounce", case).value, rel=1e-3
    )


@pytest.mark.slow
def test_values_are_those_by_hand_and_by_drake_alone(found):
    """Stop and slide are from Drake without this package. Rest is m g / k, and roll is from a formula."""
    stop = {
        "drake": (0.0967120, 0.1926076),
        "drake:similar": (0.0967701, 0.1951943),
        "drake:lagged": (0.0969954306, 0.2000252),
    }
    for engine, numbers in stop.items():
        assert found["stop", engine] == pytest.approx(numbers, abs=6e-8)  # seven digits
    for engine, value in {"drake": 2.08920, "drake:similar": 2.09427, "drake:lagged": 2.0914416014}.items():
        assert found["slide", engine].value == pytest.approx(value, abs=6e-6)  # five digits
    for engine in ENGINES:
        assert found["rest", engine].value == pytest.approx(G / 1e4, rel=1e-5)
        r_e = 0.1 - G * cos(radians(20)) / 2e5  # the ball rolls on the point at half of the overlap
        rolls = G * sin(radians(20)) / (1 + 0.4 * (0.1 / r_e) ** 2)
        assert found["roll", engine].value == pytest.approx(rolls, rel=1e-5)
        assert found["roll", engine].gradient == pytest.approx(1 / (1 + 0.4 * (0.1 / r_e) ** 2), rel=1e-5)


@pytest.mark.slow
def test_friction_that_slides_is_mu_times_the_normal_force_in_every_engine():
    """The sum over the steps is v_x + mu v_z = v_0 + g (sin a - mu cos a) t, for any normal force."""
    needs("mujoco")
    case = CASES["slide"]
    for engine in ENGINES:
        vx, vz = TABLE.run(TABLE.load(engine, case), case)[-1, 2:]
        assert vx + case.friction * vz == pytest.approx(TABLE.rigid_answer("slide", case).value, rel=1e-6)


@pytest.mark.slow
def test_a_bounce_has_the_height_of_the_engines_law_and_a_gradient_that_misses_the_jump(found):
    """A damper's force jumps at first contact. The product of step Jacobians has the opposite sign."""
    for engine in ENGINES:
        for name, tolerance in (("bounce", 5e-3), ("damped bounce", 1e-2)):  # h sqrt(k / m) is 0.02
            law = TABLE.bounce_by_law(engine, CASES[name])
            assert found[name, engine].value == pytest.approx(law.value, rel=tolerance)
            assert abs(found[name, engine].gradient - law.gradient) > 0.1
    assert (
        found["damped bounce", "drake"].gradient < -0.5 < 0.4 < TABLE.bounce_by_law("drake", CASES["damped bounce"])[1]
    )


def test_a_ball_falls_through_the_ground_of_an_engine_without_contact():
    needs("pinocchio")
    case = CASES["rest"]
    x0 = case.x0[0]
    fallen = TABLE.RADIUS - TABLE.measure("rest", "pinocchio").value
    h, N = case.time_step, case.num_steps
    assert fallen == pytest.approx(x0 - G * h**2 * N * (N + 1) / 2, rel=1e-9)


DOCUMENTED = {
    "depth at rest": ("rest", "value"),
    "stopping distance": ("stop", "value"),
    "derivative of that distance": ("stop", "gradient"),
    "speed after sliding": ("slide", "value"),
    "creep": ("hold", "value"),
    "speed after rolling": ("roll", "value"),
    "rebound height": ("damped bounce", "value"),
    "derivative of the height": ("damped bounce", "gradient"),
}
SMALLEST_TOLD = 1e-6  # of the rigid answer: smaller differences come from solvers, and vary between versions


@pytest.mark.slow
def test_the_table_in_the_documents_is_this_table(found):
    text = (ROOT / "docs" / "contact.md").read_text()
    rows = [line.split("|")[1:-1] for line in text.splitlines() if re.match(r"\| [\w ]", line)][:8]
    for label, _, *cells in rows:
        name, what = next(row for start, row in DOCUMENTED.items() if label.strip().startswith(start))
        for engine, cell in zip(ENGINES, cells, strict=True):
            answer, told = found[name, engine], cell.replace("*", "").strip()
            number, digits = float(re.match(r"[-+.e\d]+", told)[0]), last_digit(told)
            if told.endswith("%"):
                right = 100 * (answer.value / TABLE.rigid_answer(name, CASES[name]).value - 1)
                digits = max(digits, 100 * SMALLEST_TOLD)
            else:
                right = getattr(answer, what)
            assert number == pytest.approx(right, abs=0.51 * digits + 1e-12), (label, engine, told, right)
    told = re.search(r"closed forms are ([-.\d]+), ([-.\d]+), ([-.\d]+) and ([-.\d]+)\.", text.replace("\n", " "))
    laws = [TABLE.bounce_by_law(engine, CASES["damped bounce"]).gradient for engine in ENGINES]
    assert [float(number) for number in told.groups()] == pytest.approx(laws, abs=0.0051)


def test_the_rebound_is_read_at_any_step_of_the_flight():
    """Semi-implicit Euler conserves z + v^2 / (2 g) - h v / 2, so the apex is known at each step."""
    case, h = CASES["bounce"], CASES["bounce"].time_step
    z, v, heights = 0.1, 0.8, []
    for _ in range(100):
        v -= G * h
        z += h * v
        heights.append(TABLE.value_of("bounce", case, np.array([[z, v]])))
    np.testing.assert_allclose(heights, heights[0], rtol=1e-12)
    assert TABLE.value_of("bounce", case, np.array([[0.09, 0.5], [0.2, -0.5]])) == 0


def last_digit(told):
    """Return the value of one unit of the last digit in a number's text."""
    mantissa, _, exponent = re.match(r"[-+]?([.\d]+)(e?)([-+]?\d*)", told).groups()
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))

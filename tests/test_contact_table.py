"""The textbook contact cases: closed forms, each engine against them, and engines that are doctored."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from math import cos, exp, log, radians, sin, sqrt

import numpy as np
import pytest
from helpers.engines import Doctored, needs
from helpers.models import ROOT
from helpers.table import each_row, slow_after
from hypothesis import given
from hypothesis import strategies as st

import drake_diff as dd
from drake_diff.exceptions import GradientError, InputError, NotOfferedError, SimulationError, UnknownNameError
from drake_diff.studies.contact_cases import (
    ContactCase,
    contact_cases,
    hunt_crossley_restitution,
    rebound,
    rolling_factor,
    sliding_speed,
    stopping_staircase,
)
from drake_diff.studies.contact_comparison import TOLERANCES, as_json, contact_table, lines_of, rebound_height
from drake_diff.studies.contact_laws import impact, impact_gradients, law_of

G = 9.81
DRAKES = ["drake (sap, autodiff)", "drake (similar, autodiff)", "drake (lagged, autodiff)"]
SAP, SIMILAR, LAGGED = DRAKES
MUJOCOS = "soft constraint, elliptic cone, impratio 100"
CASES = {case.kind: case for case in contact_cases()}
positive = st.floats(0.1, 10)


@pytest.fixture(scope="module")
def found():
    needs("mujoco")
    return contact_table(("drake", "drake:similar", "drake:lagged", "mujoco"))


def stopping_distance(speed, friction, gravity):
    """[m] v^2 / (2 mu g), and its derivative by v [s]."""
    return speed**2 / (2 * friction * gravity), speed / (friction * gravity)


def linear_restitution(z):
    """e of f = k x + c v, f >= 0, without gravity, z = c / (2 sqrt(k m)): 1 at 0 and exp(-2) where it is critical.

    x = v sin(w t) exp(-z t) / w until f = 0: see Schwager and Poeschel, "Coefficient of restitution and linear-dashpot
    model revisited", 2007.
    """
    if z < 1:
        turn = sqrt(1 - z**2)
        return exp(-z / turn * np.arctan2(2 * z * turn, 2 * z**2 - 1))
    if z == 1:
        return exp(-2)
    turn = sqrt(z**2 - 1)
    return exp(-z / turn * log((z + turn) / (z - turn)))


# ---- closed forms -----------------------------------------------------------------------------------------------


@given(positive, positive, st.floats(1e-4, 1e-2))
def test_the_staircase_is_the_sum_of_its_steps_and_tends_to_the_stopping_distance(v0, mu, h):
    v, x, n = v0 - mu * G * h, 0.0, 0
    while v >= 0:
        x, v, n = x + h * v, v - mu * G * h, n + 1
    value, slope = stopping_staircase(v0, mu, G, h)
    assert value == pytest.approx(x, rel=1e-9, abs=1e-12)  # a sum of at most 1e5 terms
    assert slope == pytest.approx(h * n)
    distance, by_speed = stopping_distance(v0, mu, G)
    assert abs(value - distance) <= h * v0  # O(h)
    assert abs(slope - by_speed) <= h


def test_closed_forms_have_the_digits_of_a_pocket_calculator():
    assert stopping_distance(1, 0.5, G) == pytest.approx((0.1019367991845, 0.2038735983690), rel=1e-12)
    assert stopping_staircase(1, 0.5, G, 0.01) == pytest.approx((0.096995, 0.2), rel=1e-12)
    assert sliding_speed(0.5, radians(15), 0.1, G, 1) == pytest.approx(2.0914415968662, rel=1e-12)
    assert rolling_factor(1, 1) == 5 / 7
    assert CASES["roll"].rigid == pytest.approx(2.396584004, rel=1e-9)
    _, z, by_height = rebound(0.5, G, 1.0, 0.5)
    assert (z + 0.1, by_height) == pytest.approx((0.5058419527, 0.1320919527), rel=1e-9)


@given(positive, st.floats(0, 1), st.floats(1.1, 1.9))
def test_the_rebounds_derivative_is_that_of_its_height(height, e, impacts):
    duration = impacts * sqrt(2 * height / G)
    by = (rebound(height + 1e-6, G, e, duration)[1] - rebound(height - 1e-6, G, e, duration)[1]) / 2e-6
    assert rebound(height, G, e, duration)[2] == pytest.approx(by, rel=1e-6, abs=1e-8)  # differences, 1e-6 wide


@given(st.floats(1e-3, 5), st.floats(0.1, 5))
def test_the_restitution_of_hunt_and_crossley_solves_its_equation(d, v):
    e = hunt_crossley_restitution(d, v)
    assert 0 < e < 1
    assert d * v * (1 + e) == pytest.approx(log((1 + d * v) / (1 - e * d * v)), rel=1e-6)  # 1 - e d v may be small
    assert hunt_crossley_restitution(0, v) == 1


def test_the_restitution_of_a_damper_has_its_limits():
    assert linear_restitution(0) == 1
    assert linear_restitution(1) == exp(-2)
    for z in (1 - 1e-6, 1 + 1e-6):
        assert linear_restitution(z) == pytest.approx(exp(-2), rel=1e-5)  # z = 1 to 1e-6, slope of order 1


@each_row("tau, d", [(0.0, 0.0), (2e-3, 0.0), (0.02, 0.0), (0.03, 0.0), (0.0, 0.3), (0.0, 2.0)])
def test_the_impact_without_gravity_has_the_restitution_of_the_closed_form(tau, d):
    case = replace(CASES["bounce"], gravity=1e-12)
    v, k = 0.7, case.stiffness
    *_, rate, free = impact(lambda x, r: k * (x + tau * r) * max(0.0, 1 + d * r), case, 0.0, v, 10.0)
    expected = linear_restitution(tau * sqrt(k) / 2) if tau else hunt_crossley_restitution(d, v)
    assert free
    assert -rate / v == pytest.approx(expected, rel=1e-7)  # Runge-Kutta, 100 pieces in 1 / omega


def test_the_impact_is_scipys():
    integrate = pytest.importorskip("scipy.integrate")
    case, v = CASES["damped bounce"], 0.99
    for law in ("point, sap", "point, lagged", MUJOCOS):
        force = law_of(law, case).force
        time, x, rate, _ = impact(force, case, 0.0, v, 0.05)
        other = integrate.solve_ivp(
            lambda t, y, force=force: [y[1], G - force(*y)], (0, time), [0, v], rtol=1e-10, atol=1e-13
        )
        np.testing.assert_allclose([x, rate], other.y[:, -1], atol=1e-8)


def test_the_saltation_is_what_the_drops_own_differences_say():
    """d z(T) / d z_0 of fall and impact as one function; without damper there is no jump to leave out."""
    for kind, law in (("bounce", "point, sap"), ("damped bounce", "point, sap"), ("damped bounce", "point, similar")):
        case = CASES[kind]
        force = law_of(law, case).force

        def end(height, case=case, force=force):
            v = sqrt(2 * G * height)
            time, x, rate, _ = impact(force, case, 0.0, v, case.duration - v / G)
            left = case.duration - v / G - time
            return -(x + rate * left + G * left**2 / 2)

        by = (end(case.height + 1e-6) - end(case.height - 1e-6)) / 2e-6
        with_jump, without = impact_gradients(force, case)
        assert with_jump == pytest.approx(by, rel=1e-5)  # differences of a function good to 1e-11
        assert (with_jump == without) == (force(0.0, 1.0) == 0)


# ---- the engines ------------------------------------------------------------------------------------------------


def test_what_drake_does_is_its_laws_answer():
    """Of two cases; the tests of `found` have them all, and other engines."""
    few = contact_table(("drake", "drake:lagged"), (CASES["rest"], CASES["slide"]))
    assert few.off == ()
    assert [row.law_gap <= TOLERANCES[row.case].value for row in few.rows] == [True] * 4


@pytest.mark.slow
def test_every_engine_has_a_row_in_every_case(found):
    assert found.engines == (*DRAKES, "mujoco")
    assert len(found.rows) == 4 * len(CASES)
    assert found.off == ()
    for row in found.rows:
        tolerance = TOLERANCES[row.case].value
        assert row.law_gap <= tolerance  # what a law gives is what its engine does
        assert row.verdict == ("rigid answer" if row.rigid_gap <= tolerance and row.rigid else "own law's"), row
        assert row.tolerance == tolerance


@pytest.mark.slow
def test_values_by_hand_and_by_drake_alone(found):
    """Stop and slide as Drake alone gave them, stepped without this package; rest m g / k and roll by formula."""
    stop = {SAP: (0.0967120, 0.1926076), SIMILAR: (0.0967701, 0.1951943), LAGGED: (0.0969954306, 0.2000252)}
    for engine, numbers in stop.items():
        row = found.row("stop", engine)
        assert (row.value, row.gradient) == pytest.approx(numbers, abs=6e-8)  # seven digits
    slide = {SAP: 2.08920, SIMILAR: 2.09427, LAGGED: 2.0914416014}
    for engine, value in slide.items():
        assert found.row("slide", engine).value == pytest.approx(value, abs=6e-6)  # five digits
    for engine in found.engines:
        assert found.row("rest", engine).value == pytest.approx(G / 1e4, rel=1e-5)
        r_e = 0.1 - G * cos(radians(20)) / 2e5
        rolls = G * sin(radians(20)) / (1 + 0.4 * (0.1 / r_e) ** 2)
        assert found.row("roll", engine).value == pytest.approx(rolls, rel=1e-5)


@pytest.mark.slow
def test_verdicts_on_gradients(found):
    """Sliding: right or the law's. A bounce: wrong in all, where the force jumps at touch even in its sign."""
    verdicts = {(row.case, row.engine): row.gradient_verdict for row in found.rows}
    for engine in found.engines:
        assert verdicts["rest", engine] == "right"
        assert verdicts["hold", engine] == verdicts["roll", engine] == "own law's"
        assert verdicts["bounce", engine] == verdicts["damped bounce", engine] == "wrong"
        assert verdicts["stop", engine] == ("right" if engine == LAGGED else "own law's")
        assert verdicts["slide", engine] == ("own law's" if engine == SIMILAR else "right")
    sap, mujoco = found.row("damped bounce", SAP), found.row("bounce", "mujoco")
    assert sap.gradient < -0.5 < 0.4 < sap.law_gradient
    assert mujoco.gradient > 0.15 > 0 > mujoco.law_gradient
    assert "at touch the force jumps" in sap.gradient_why


@pytest.mark.slow
def test_wrong_gradients_are_those_without_the_jump(found):
    """MuJoCo's to the h of an explicit step, Drake's with the damper k h that an implicit step is."""
    for kind in ("bounce", "damped bounce"):
        case = CASES[kind]
        for engine, law in zip(DRAKES, ("point, sap", "point, similar", "point, lagged"), strict=True):
            _, seen = impact_gradients(law_of(law, case).stepped, case)
            assert found.row(kind, engine).gradient == pytest.approx(seen, abs=0.03)  # 1.5 h omega
        _, seen = impact_gradients(law_of(MUJOCOS, case).force, case)
        assert found.row(kind, "mujoco").gradient == pytest.approx(seen, rel=5e-3)  # 1 h omega of its softer spring


@pytest.mark.slow
def test_smaller_steps_mend_the_steps_damper_and_not_the_jump():
    """By the hand calculation, which is Drake's sap: without a damper the gradient tends to its law's, with one not."""
    gaps = {}
    for kind in ("bounce", "damped bounce"):
        for finer in (1, 8):
            case = replace(CASES[kind], time_step=2e-4 / finer, num_steps=1000 * finer)
            row = contact_table(("numpy",), (case,)).rows[0]
            gaps[kind, finer] = row.gradient - row.law_gradient
    assert abs(gaps["bounce", 8]) < abs(gaps["bounce", 1]) / 4  # first order, and the chance of when it touches
    with_jump, without = impact_gradients(law_of("point, sap", CASES["damped bounce"]).force, CASES["damped bounce"])
    assert gaps["damped bounce", 8] == pytest.approx(without - with_jump, abs=0.03)  # of 0.98


def test_a_hard_fall_on_mujocos_critical_damper_bounces_by_exp_minus_2():
    """Where gravity hardly matters, g / (v omega) = 0.016: exit speed to impact speed."""
    needs("mujoco")
    case = replace(CASES["bounce"], stiffness=1e5, height=2.0, num_steps=3600)
    v = sqrt(2 * G * case.height)
    *_, rate, free = impact(law_of(MUJOCOS, case).force, case, 0.0, v, 0.1)
    assert free
    assert -rate / v == pytest.approx(exp(-2), rel=0.02)
    row = contact_table(("mujoco",), (case,)).rows[0]
    assert row.value == pytest.approx(row.law, rel=0.04)  # 2 h omega: when in a step it touches is chance


def test_who_has_no_contact_falls_through():
    needs("pinocchio")
    found = contact_table(("pinocchio",))
    assert {row.verdict for row in found.rows} == {"falls through"}
    assert {row.gradient_verdict for row in found.rows} == {"not asked"}
    assert "falls freely" in found.rows[0].why
    assert found.off == ()


@pytest.mark.slow
def test_the_hand_calculation_is_drakes_sap_where_there_is_one(found):
    hand = contact_table(("numpy",))
    assert {row.case for row in hand.rows} == {"rest", "bounce", "damped bounce"}
    assert any("hand calculation" in refused.reason for refused in hand.refused)
    for row in hand.rows:
        assert row.value == pytest.approx(found.row(row.case, SAP).value, rel=1e-6)  # where SAP stops
        assert row.gradient == pytest.approx(found.row(row.case, SAP).gradient, rel=1e-6, abs=1e-12)


# ---- what must be refused ---------------------------------------------------------------------------------------


def doctored(case, engine="drake", contact=None, **changes):
    """An engine on a model with fields of the case scaled."""

    def load(model):
        scaled = {name: getattr(case, name) * factor for name, factor in changes.items()}
        options = {"contact": contact} if contact else {}
        return dd.engines.load_engine(engine, model.changed(**scaled), **options)

    return load


@pytest.mark.parametrize(
    ("kind", "changes"),
    slow_after(
        7,
        [
            ("rest", {"stiffness": 1.001}),
            ("stop", {"friction": 1.1}),
            ("slide", {"slope": 1.01}),
            ("hold", {"friction": 1.1}),
            ("roll", {"gravity": 1.01}),
            ("bounce", {"gravity": 1.01}),
            ("damped bounce", {"relaxation_time": 1.1}),
            ("rest", {"gravity": 1.01}),
            ("rest", {"mass": 1.01}),
            ("stop", {"gravity": 1.01}),
            ("slide", {"friction": 1.1}),
            ("slide", {"gravity": 1.01}),
            ("roll", {"stiffness": 0.5}),
            ("roll", {"friction": 0.1}),
            ("damped bounce", {"dissipation": 1.1}),
        ],
    ),
)
def test_a_doctored_engine_is_off(kind, changes):
    contact = "sap" if "relaxation_time" in changes or kind == "rest" else "lagged"
    row = contact_table((doctored(CASES[kind], contact=contact, **changes),), (CASES[kind],)).rows[0]
    assert row.verdict == "off", row
    assert "%" in row.why or "m/s" in row.why


@each_row(
    "kind, changes",
    [
        ("rest", {"stiffness": 1.001}),
        ("stop", {"friction": 1.1}),
        ("slide", {"friction": 1.1}),
        ("slide", {"gravity": 1.01}),
        ("hold", {"gravity": 1.01}),
        ("roll", {"gravity": 1.01}),
    ],
)
def test_a_doctored_mujoco_is_off(kind, changes):
    needs("mujoco")
    row = contact_table((doctored(CASES[kind], "mujoco", **changes),), (CASES[kind],)).rows[0]
    assert row.verdict == "off", row


def test_creep_of_regularized_friction_does_not_know_gravity():
    """s tan a / sqrt(mu^2 - tan^2 a): what the case cannot find, rest and roll do."""
    row = contact_table((doctored(CASES["hold"], contact="lagged", gravity=1.01),), (CASES["hold"],)).rows[0]
    assert row.verdict == "own law's"


def test_wrong_zero_and_missing_gradients_are_told():
    def scaled(factor):
        def load(model):
            drake = dd.engines.load_engine("drake", model, contact="lagged")

            def differentiate(x, u):
                found = drake.differentiate_step(x, u)
                return found._replace(A=factor * np.asarray(found.A))

            return Doctored(drake, differentiate_step=differentiate)

        return load

    def blind(model):
        def none(x, u):
            raise NotOfferedError("forward only")

        return Doctored(dd.engines.load_engine("drake", model, contact="lagged"), differentiate_step=none)

    def infinite(model):
        def differentiate(x, u):
            raise GradientError("it is not finite")

        return Doctored(dd.engines.load_engine("drake", model, contact="lagged"), differentiate_step=differentiate)

    slide = (CASES["slide"],)
    assert contact_table((scaled(1.0),), slide).rows[0].gradient_verdict == "right"
    assert contact_table((scaled(1.0001),), slide).rows[0].gradient_verdict == "wrong"
    assert contact_table((scaled(0.0),), slide).rows[0].gradient_verdict == "zero"
    assert contact_table((blind,), slide).rows[0].gradient_verdict == "none"
    row = contact_table((infinite,), slide).rows[0]
    assert (row.gradient_verdict, row.gradient) == ("none", None)
    assert "not finite" in row.gradient_why


def test_an_engine_of_an_unknown_law_is_judged_by_the_rigid_answer_alone():
    def unknown(approximation):
        def load(model):
            drake = dd.engines.load_engine("drake", model, contact=approximation)
            return Doctored(drake, contract=replace(drake.contract, contact_law="springs of its own"))

        return load

    row = contact_table((unknown("lagged"),), (CASES["slide"],)).rows[0]
    assert (row.verdict, row.law) == ("rigid answer", None)
    row = contact_table((unknown("sap"),), (CASES["slide"],)).rows[0]
    assert (row.verdict, row.law, row.law_gap) == ("off", None, None)
    assert "its own law: springs of its own" in row.why


def test_an_engine_that_breaks_off_says_so():
    def weak(model):
        drake = dd.engines.load_engine("drake", model)

        def step(x, u):
            if x[2] > 1:
                raise SimulationError("the solver gave up")
            return drake.step(x, u)

        return Doctored(drake, step=step)

    row = contact_table((weak,), (CASES["slide"],)).rows[0]
    assert row.verdict == "broke off"
    assert "the solver gave up" in row.why


@pytest.mark.slow
def test_a_row_that_is_not_there_is_named(found):
    with pytest.raises(UnknownNameError, match="slide of mujoco"):
        found.row("fly", "mujoco")


def test_bad_input_is_named():
    with pytest.raises(UnknownNameError, match="mujoco"):
        contact_table(("bullet-proof",))
    with pytest.raises(InputError, match="slope"):
        ContactCase("slide", 0.01, 10, slope=2.0)
    with pytest.raises(InputError, match="height"):
        ContactCase("bounce", 0.01, 10)
    with pytest.raises(InputError, match="stiffness"):
        ContactCase("rest", 0.01, 10, stiffness=-1.0)


def test_the_rebound_is_read_at_any_step_of_the_flight():
    """z + v^2 / (2 g) - h v / 2 is kept by semi-implicit Euler: an apex in steps, known from each of them."""
    case, h = CASES["bounce"], CASES["bounce"].time_step
    z, v, heights = 0.1, 0.8, []
    for _ in range(100):
        v -= G * h
        z += h * v
        heights.append(rebound_height(case, np.array([[z, v]])))
    np.testing.assert_allclose(heights, heights[0], rtol=1e-12)
    assert rebound_height(case, np.array([[0.09, 0.5], [0.2, -0.5]])) == 0


# ---- words and the command --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_sentences_and_json(found):
    said = " ".join(lines_of(found, SAP))
    assert "rigid answer (rest, bounce)" in said
    assert "wrong (bounce, damped bounce)" in said
    assert "gradient of damped bounce" in said
    assert "slide: -0.107 % from the rigid answer: friction is mu N, and k (x + tau x')" in said
    assert repr(found).startswith("ContactTable(28 rows, 0 off)\n  drake (sap, autodiff): values: rigid answer (rest")
    assert repr(found.row("stop", SAP)).startswith(
        "ContactRow(stop in drake (sap, autodiff): stopping distance 0.09671 m"
    )
    assert "&#x27;" in found._repr_html_()  # own law's: it is escaped
    read = json.loads(as_json(found))
    assert len(read["rows"]) == len(found.rows)
    assert read["rows"][0]["value"] == found.rows[0].value


@pytest.mark.slow
def test_the_command_prints_the_table_and_writes_json(tmp_path):
    words = ["contact-table", "--engines", "drake:lagged", "--out", str(tmp_path / "table.json")]
    done = subprocess.run(
        [sys.executable, "-m", "drake_diff.cli.main", *words], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    for word in ("damped bounce", "own law's", "wrong", LAGGED):
        assert word in done.stdout
    assert len(json.loads((tmp_path / "table.json").read_text())["rows"]) == 7


@pytest.mark.slow
def test_every_engine_that_is_here_is_told_of():
    found = contact_table()
    assert set(DRAKES) <= set(found.engines)
    for engine in found.engines:
        assert " ".join(lines_of(found, engine))
        for row in found.rows:
            assert row.why or row.verdict == "rigid answer"


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
SMALLEST_TOLD = (
    1e-6  # of the rigid answer: what is nearer to it is left by solvers, and differs from version to version
)


@pytest.mark.slow
def test_the_table_in_the_documents_is_this_table(found):
    text = (ROOT / "docs" / "contact.md").read_text()
    table = [line.split("|")[2:-1] for line in text.splitlines() if re.match(r"\| [\w ]", line)][:8]
    labels = [line.split("|")[1].strip() for line in text.splitlines() if re.match(r"\| [\w ]", line)][:8]
    for label, cells in zip(labels, table, strict=True):
        case, what = next(found_at for start, found_at in DOCUMENTED.items() if label.startswith(start))
        for engine, cell in zip(found.engines, cells[1:], strict=True):
            row, told = found.row(case, engine), cell.replace("*", "").strip()
            number, digits = float(re.match(r"[-+.e\d]+", told)[0]), last_digit(told)
            if told.endswith("%"):
                right = 100 * (row.value / row.rigid - 1)
                digits = max(digits, 100 * SMALLEST_TOLD)
            else:
                right = row.value if what == "value" else row.gradient
            assert number == pytest.approx(right, abs=0.51 * digits + 1e-12), (label, engine, told, right)
    told = re.search(
        r"closed forms are ([-.\d]+), ([-.\d]+), ([-.\d]+) and ([-.\d]+)\.", text.replace("\n", " ")
    ).groups()
    laws = [found.row("damped bounce", engine).law_gradient for engine in found.engines]
    assert [float(number) for number in told] == pytest.approx(laws, abs=0.0051)


@pytest.mark.slow
def test_what_the_documents_say_of_physx_and_newton():
    needs("mujoco")
    for module in ("sapien", "newton"):
        pytest.importorskip(module)
    table = contact_table(("sapien", "newton"))
    physx, newton = table.engines
    assert 1 - table.row("stop", physx).value / table.row("stop", physx).rigid == pytest.approx(0.005, abs=5e-4)
    assert table.row("bounce", physx).value == 0
    assert 1 - table.row("bounce", newton).value / table.row("bounce", newton).rigid == pytest.approx(0.76, abs=5e-3)
    assert table.row("hold", newton).value == pytest.approx(0.02, abs=5e-4)


def last_digit(told):
    """What one unit of the last digit of a number's text is worth."""
    mantissa, _, exponent = re.match(r"[-+]?([.\d]+)(e?)([-+]?\d*)", told).groups()
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))

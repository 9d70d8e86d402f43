"""The random impacts and their truth, that the benchmark judges by: closed forms, and errors that it has to see."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.bounces import RADIUS, Bounce
from helpers.models import ROOT

sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))

import impact_orders
import impacts
from impact_cases import FAMILIES, Material, Mover, Obstacle, case
from impact_truth import Motion, Slopes, truth


def bounce(law, ball, start, duration):
    """A case of the closed form's `ball`."""
    made = Material(0.5, 2 * ball.stiffness, ball.dissipation, ball.relaxation_time / 2)
    mover = Mover("ball", ball.mass, (RADIUS,), RADIUS, ((0, 0, 0),), made, "z")
    return replace(
        case(0, 0),
        law=law,
        movers=(mover,),
        obstacles=(Obstacle("ground", (), (0, 0, 0), (0, 0, 0), made),),
        gravity=(0, 0, -ball.gravity),
        x0=start,
        num_steps=round(duration / 0.01),
        weights=(1.0, 0.0),
        target=None,
        columns=(1, 0),
    )


@pytest.mark.parametrize(
    ("law", "ball"),
    [
        pytest.param("lagged", Bounce(4e4, dissipation=0.4), id="lagged"),
        pytest.param("sap", Bounce(4e4, relaxation_time=2e-3), marks=pytest.mark.slow, id="sap"),
    ],
)
def test_the_truth_of_a_bounce_is_its_closed_form(law, ball):
    start, duration = (0.4, -1.0), 0.4
    value, slopes = truth(bounce(law, ball, start, duration), columns=(1,))
    wanted, _ = ball.slopes(law, start, duration)
    assert value == pytest.approx(ball.end(law, start, duration)[0], abs=1e-7)
    assert slopes[0].kind == "exists"
    assert slopes[0].best == pytest.approx(wanted[1], rel=1e-3)  # what the three widths agree to


@pytest.mark.parametrize(
    "family",
    [pytest.param(n, marks=[pytest.mark.slow] if n == "toss" else []) for n in FAMILIES if n != "wall"],
)
def test_the_laws_by_hand_are_drakes_where_they_are_the_same(family):
    """Without damping both laws are k x: friction, the points where forces act and torques are Drake's."""
    one = case(3, 0, family)
    made = replace(one.movers[0].material, dissipation=0.0, relaxation_time=0.0)
    one = replace(one, movers=tuple(replace(m, material=made) for m in one.movers))
    one = replace(one, obstacles=tuple(replace(o, material=made) for o in one.obstacles))
    ours, drakes = (Motion(replace(one, law=law)) for law in ("sap", "lagged"))
    touched, x = 0.0, None
    for k in range(1, one.num_steps + 1):
        x = Motion(replace(one, law="lagged", num_steps=k)).end()
        rates = []
        for motion in (ours, drakes):
            if motion.plant.num_actuators():
                motion.plant.get_actuation_input_port().FixValue(motion.context, [one.input])
            motion.plant.SetPositionsAndVelocities(motion.context, x)
            rates.append(motion.simulator.get_system().EvalTimeDerivatives(motion.root).CopyToVector())
        assert np.allclose(*rates, rtol=1e-9, atol=1e-9 * np.max(np.abs(rates)))
        touched = max(touched, float(np.max(np.abs(rates[0]))))
        if k % 10 == 9 and touched > 100:  # m/s^2 or rad/s^2: nothing but contact does that here
            break
    assert x is not None


def test_a_bounce_at_its_last_moment_has_no_slope():
    """It touches 2 mm/s before the end, or not at all: the force acts on one side of the first state alone."""
    ball = Bounce(1e5)
    grazing = replace(bounce("lagged", ball, (0.6, 0.0), 0.32), weights=(0.0, 1.0))
    fall = np.sqrt(2 * 0.5 / 9.81)
    assert 0 < 0.32 - fall < 2e-3
    _, slopes = truth(grazing)
    assert "exists" not in [one.kind for one in slopes]


def test_slopes_that_do_not_settle_do_not_exist():
    assert Slopes(0, 1.0, (1.0, 1.0005, 1.0009)).kind == "exists"
    assert Slopes(0, 1.0, (1.2, 1.0005, 1.0009)).kind == "narrow"
    assert Slopes(0, 1.0, (1.0, 1.0005, 1.002)).kind == "none"
    assert Slopes(0, 1.0, (-4.6, 0.9, -8.1)).kind == "none"


@pytest.mark.slow
def test_a_wrong_gradient_and_a_wrong_verdict_are_counted(monkeypatch):
    one = case(0, 0)
    found = impacts.judge(one, None, costs=False)
    assert [c["kind"] for c in found["columns"]] == ["exists"] * 3
    assert all(c["right"] for c in found["columns"])
    honest = impacts.ours

    def off(*given):
        loss, by, _ = honest(*given)
        return loss, {column: 1.02 * slope for column, slope in by.items()}, {one.columns[1]}

    monkeypatch.setattr(impacts, "ours", off)
    wrong = impacts.judge(one, None, costs=False)
    counts = {name: found for name, found, _ in impacts.figures([wrong])}
    assert counts["a derivative that exists is given, within 1 %"] == 0
    assert counts["one that exists is called undefined"] == 1
    assert counts["one that exists is given and is off by more"] == 2


def test_a_seed_is_its_cases():
    assert case(5, 3) == case(5, 3) != case(6, 3)
    assert [case(5, n).family for n in range(len(FAMILIES))] == list(FAMILIES)


@pytest.mark.slow
def test_the_readmes_table_of_a_bounce_and_a_toss():
    """Through Drake's steps by AutoDiffXd in Drake alone, and ours; the last line is another integration, or exact."""
    text = (ROOT / "README.md").read_text()
    table = text[text.index("| One second, d end") :].split("\n\n")[0]
    printed = [[cell.strip() for cell in row.split("|")[2:4]] for row in table.splitlines()[2:]]
    motions = impact_orders.BALL, impact_orders.CUBE
    found = [
        [impact_orders.drake(one, one.columns[0], 1e-3)[1] for one in motions],
        [impact_orders.drake(one, one.columns[0], 2e-4)[1] for one in motions],
        [impacts.ours(one, one.model(), np.zeros((one.num_steps, 0)))[1][one.columns[0]] for one in motions],
        [impact_orders.reference(one)[1] for one in motions],
    ]
    for row, values in zip(printed, found, strict=True):
        assert row == [f"{value:.4g}" for value in values]


def test_value_and_slope_of_a_bounce_converge_by_the_order_of_the_method():
    """A step's error is held to a tolerance: both fall in proportion to it, and by order 5 in the steps that push."""
    found = impact_orders.measure(impact_orders.BALL, None)
    for what in ("value", "slope"):
        assert impact_orders.order(found["tolerance"], found[what]) == pytest.approx(1.0, abs=0.2)
        assert -impact_orders.order(found["steps"], found[what]) > 4.5

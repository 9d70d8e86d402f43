"""Check a report's first screen: the task in words, and the checks, each with the color of its result."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.models import MODELS

import drake_diff as dd
from drake_diff.runs import measure
from drake_diff.runs.messages import asked_for
from drake_diff.runs.page import _of_replays, checks_of
from drake_diff.runs.save import record_of

CONTROLS = ("Inputs alone (open loop)", "With feedback (TVLQR)")


@pytest.fixture(scope="module")
def cart_pole():
    return dd.load_model(MODELS / "cart_pole.urdf", time_step=0.02)


def asked(model, num_steps=50, **options):
    problem = dd.Problem(model, x0=np.zeros(model.nx), num_steps=num_steps, **options)
    return asked_for(problem, np.linspace(0, num_steps * 0.02, num_steps + 1))


def test_the_end_is_named_with_its_units(cart_pole):
    told = asked(cart_pole, x_goal={"slide_x": 1.0, "hinge_q": 3.0, "slide_v": 0.0, "hinge_w": 0.0})
    assert told == (
        "Task for cart_pole (2 degrees of freedom, 1 input): end with slide_x = 1 m and hinge_q = 3 rad and be at rest "
        "at the end, in 1 s."
    )
    assert "rest" not in asked(cart_pole, x_goal={"slide_x": 1.0, "hinge_w": 0.5})
    assert "end with slide_x = 1 m and hinge_w = 0.5 rad/s" in asked(cart_pole, x_goal={"slide_x": 1.0, "hinge_w": 0.5})


@pytest.fixture(scope="module")
def swung():
    """Return a pendulum's swing-up, and the same plan stopped early, before it reaches its goal."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=40, running_cost=dd.QuadraticCost(R=[[1.0]]))
    return dd.solve(problem, method="shooting"), dd.solve(problem, method="ilqr", max_iterations=2)


def checked(solution):
    m = measure(solution)
    record = record_of(m, Path("run")).model_dump(mode="json")
    return {check.title: check for check in checks_of(m, record)}, record


def test_what_holds_is_green(swung):
    found, record = checked(swung[0])
    assert record["verdict"] == "pass"
    assert {name: check.kind for name, check in found.items()} == {
        "Solver": "pass",
        "Plan": "pass",
        "Inputs alone (open loop)": "pass",
        "With feedback (TVLQR)": "pass",
        "Gradients": "pass",
    }
    assert found["Solver"].text.startswith("converged after ")


def test_what_fails_is_red_and_named(swung):
    found, record = checked(swung[1])
    assert record["verdict"] == "fail"
    assert found["Solver"].kind == found["Plan"].kind == "fail"
    assert found["Solver"].text.startswith("iteration limit after")
    assert "goal error" in found["Plan"].text
    for name in CONTROLS:
        assert found[name].kind == "fail"
        assert "hinge" in found[name].text


def test_a_plan_that_misses_its_goal_is_not_green_whatever_the_solver_says(swung):
    """The plan has the inputs of another motion, and a solver status that says it converged."""
    wrong = dataclasses.replace(swung[0], us=np.zeros((40, 1)), xs=np.zeros((41, 2)))
    found, _ = checked(wrong)
    assert found["Solver"].kind == "pass"
    assert found["Plan"].kind == "fail"
    assert "pass" not in {found[name].kind for name in found if name in CONTROLS}


@pytest.mark.parametrize(("success", "kind"), [(True, "warn"), (False, "fail")])
def test_replays_that_hold_by_one_of_two_in_turn_are_red_only_where_the_plan_fails(success, kind):
    """Each variant holds with only one of two controls, and no control holds in both, but the plan may pass."""
    replays = [
        {"control": control, "variant": variant, "holds": (control == "TVLQR") == (variant == "half"), "failures": []}
        for control in ("open loop", "TVLQR")
        for variant in ("whole", "half")
    ]
    m = SimpleNamespace(solution=SimpleNamespace(judged_replay=None, success=success))
    assert [check.kind for check in _of_replays(m, replays)] == [kind, kind]

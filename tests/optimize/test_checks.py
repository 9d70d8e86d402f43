"""Tests of a plan's checks: values and verdicts by closed forms, the worst first, and unknown values fail."""

import dataclasses
import functools
import math

import numpy as np
import pytest

import drake_diff as dd
from drake_diff.optimize.checks import Checks, check

EFFORT = dd.QuadraticCost(R=[[1.0]])
FIELDS = ["what", "where", "plant", "feedback", "value", "tolerance", "unit", "verdict"]


@functools.cache
def moved():
    """Solve for a block that moves by 1 m in 1 s."""
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    problem = dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=10, horizon=1.0, running_cost=EFFORT)
    return dd.solve(problem)


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.2])
def test_what_is_unknown_or_too_large_fails(value):
    c = check("goal", "hinge_q", value, 0.1, "rad")
    assert [f.name for f in dataclasses.fields(c)] == FIELDS
    assert (c.plant, c.feedback, c.verdict, c.passes) == ("plan", None, "fail", False)
    assert c.ratio >= 2
    assert str(c).startswith("hinge_q ends ")
    assert str(check("goal", "hinge_q", 0.1, 0.1, "rad")) == "pass: goal, hinge_q: 0.1 rad, tolerance 0.1"


def test_checks_come_worst_first_and_print_as_a_table():
    rows = [
        check("goal", "a", 0.01, 1.0),
        check("bound", "b at 1 s", 3.0, 1.0, "m"),
        check("bound", "c at 2 s", 9.0, 1.0),
    ]
    rows.append(check("motion", "it is not installed", math.inf, 0.0, verdict="undecided"))
    found = Checks(rows)
    assert [c.where for c in found] == ["c at 2 s", "b at 1 s", "it is not installed", "a"]
    assert [c.where for c in found.failing] == ["c at 2 s", "b at 1 s", "it is not installed"]
    head, *lines = str(found).splitlines()
    assert head.split()[:4] == ["verdict", "what", "where", "plant"]
    assert len(lines) == 4
    assert "b is 3 m beyond its bound at 1 s, tolerance 1 m" in [str(c) for c in found]


def test_every_check_of_a_plan_that_holds_passes():
    assert moved().success
    assert moved().checks.failing == []
    assert {c.plant for c in moved().checks} == {"plan", "between the nodes", "continuous time"}


@pytest.mark.parametrize(
    ("row", "column", "what"), [(0, 0, "start"), (10, 1, "goal"), (5, 0, "defect"), (5, 1, "integration")]
)
def test_a_moved_state_fails_the_check_that_it_is_about(row, column, what):
    xs = np.array(moved().xs)
    xs[row, column] += 0.05
    failing = dataclasses.replace(moved(), xs=xs).plan_checks.failing
    values = {c.what: c.value for c in failing}
    assert values.get(what) == pytest.approx(0.05, rel=0.7)
    assert {"start": row == 0, "goal": row == 10}.items() <= {
        "start": "start" in values,
        "goal": "goal" in values,
    }.items()


def test_a_state_that_is_no_number_passes_nothing_that_it_is_about():
    xs = np.array(moved().xs)
    xs[-1, 0] = math.nan
    failing = {c.what: c.value for c in dataclasses.replace(moved(), xs=xs).checks.failing}
    assert failing["goal"] == failing["defect"] == failing["cost"] == math.inf


def test_checks_of_phases_have_the_links_and_the_chain():
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    way = {"num_steps": 5, "horizon": 0.5, "running_cost": EFFORT}
    parts = [dd.Problem(block, x0=[0, 0], **way), dd.Problem(block, x0=[0.5, 0], x_goal=[1, 0], **way)]
    solution = dd.solve(dd.optimize.PhasedProblem(parts))
    assert solution.success
    assert solution.checks.failing == []
    assert {"link", "chain"} <= {c.what for c in solution.checks}
    xs = np.array(solution.phases[1].xs)
    xs[0, 0] += 0.01
    apart = dataclasses.replace(solution, phases=(solution.phases[0], dataclasses.replace(solution.phases[1], xs=xs)))
    (link,) = [c for c in apart.link_checks.failing if c.what == "link"]
    assert link.value == pytest.approx(0.01, rel=1e-6)

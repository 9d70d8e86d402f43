"""The tasks' formulas by hand are the plants that the referee simulates, and peers' plans are judged as ours are."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))

import task_peers
import tasks

BY_HAND = [name for name in tasks.TASKS if tasks.drawn(name, 0, 0).peer]


@pytest.mark.parametrize("name", BY_HAND)
def test_formulas_by_hand_are_the_plant(name):
    case, random = tasks.drawn(name, 3, 0), np.random.default_rng(0)
    system, port_in, _ = case.build(0.0)
    context, problem = system.CreateDefaultContext(), case.problem
    for _ in range(5):
        x, u = random.uniform(-1, 1, problem.nx), random.uniform(-1, 1, problem.nu)
        context.SetContinuousState(x)
        system.get_input_port(port_in).FixValue(context, u)
        rates = system.EvalTimeDerivatives(context).CopyToVector()
        assert case.peer(x, u, math) == pytest.approx(rates, rel=1e-9, abs=1e-9)


@pytest.fixture(scope="module")
def answer():
    """A peer's plan of a cart-pole's swing-up."""
    import task_peer_casadi

    case = tasks.drawn("cart_pole_least_effort", 0, 0)
    return case, task_peer_casadi.solve(task_peers.asked(case))


def test_a_peer_finds_the_optimum_in_closed_form():
    """A block in least time: 2 sqrt(m d / F), and a little more, as the switch lies between two knots."""
    import task_peer_casadi

    case = tasks.drawn("block_least_time", 0, 0)
    assert task_peer_casadi.solve(task_peers.asked(case))["cost"] == pytest.approx(case.optimum, rel=5e-3)


def test_a_peer_gets_the_task_and_its_plan_is_judged(answer):
    case, found = answer
    assert found["solved"]
    assert task_peers.judged(found, case) == ""


def test_a_peers_plan_that_no_plant_follows_is_refused(answer):
    """A straight line to the goal without effort."""
    case, found = answer
    line = np.linspace(case.problem.x0, case.problem.x_goal, len(found["xs"]))
    assert "off" in task_peers.judged(found | {"xs": line.tolist(), "us": np.zeros((len(line), 1)).tolist()}, case)


def test_a_peers_input_beyond_its_limit_is_refused(answer):
    case, found = answer
    top = case.problem.bounds.u_upper[0]
    more = [[value if abs(value) < 0.9 * np.max(np.abs(found["us"])) else 1.1 * top] for (value,) in found["us"]]
    assert "input beyond its bound" in task_peers.judged(found | {"us": more}, case)

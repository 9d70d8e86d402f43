"""The referee of MPC in real time: its plant is the plant, its blows are blows, and it sees what it should."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.models import ROOT

import drake_diff as dd

sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))
realtime = pytest.importorskip("mpc_realtime")
contact = pytest.importorskip("mpc_contact")


@pytest.fixture(scope="module")
def crane():
    return realtime.crane(np.random.default_rng(0))


def test_its_plant_takes_the_models_steps(crane):
    model = crane.problem.model.at_time_step(realtime.FINE)
    plant = realtime.Plant(crane)
    plant.start(np.array(crane.problem.x0))
    plant.go_on([3.0], 10)
    plant.go_on([-2.0], 25)
    wanted = dd.rollout(model, crane.problem.x0, np.repeat([[3.0], [-2.0]], [10, 15], axis=0)).xs
    np.testing.assert_allclose(np.array(plant.xs), wanted, atol=1e-12)


def test_a_blow_changes_speeds_as_its_impulse_says(crane):
    """0.1 N s on a bob of 0.3 kg that hangs from a free cart: the bob alone is hit, and flies off at 1/3 m/s."""
    plant = realtime.Plant(crane)
    plant.start(np.zeros(4))
    plant.push(np.array([0.1, 0, 0]))
    cart, turning = plant.x[2:]
    assert cart == pytest.approx(0.0, abs=1e-12)
    assert 0.5 * turning == pytest.approx(1 / 3, abs=1e-12)


def test_it_sees_a_limit_that_is_passed_and_a_goal_that_is_missed(crane):
    xs = np.tile([0.0, 0.0, 0.0, 0.0], (5, 1))
    sway, rail = crane.asks
    xs[2, 1], xs[3, 0] = -0.5, 9.0
    assert sway.excess(xs).max() > 0.2
    assert rail.excess(xs).max() > 5
    excess, _, ended = realtime._judged(crane, xs)
    assert excess["sway"] == sway.excess(xs).max()
    assert ended == pytest.approx(abs(crane.problem.x_goal[0]))
    kept, _, _ = realtime._judged(crane, np.zeros((5, 4)))
    assert set(kept.values()) == {0.0}


def test_a_controller_that_does_nothing_does_not_pass(crane, monkeypatch):
    """The MPC's answers replaced by zeros: the load arrives nowhere."""
    problem = crane.problem
    plan = np.tile(problem.x0, (151, 1)), np.zeros((150, 1))

    class Idle:
        status = "ok"

        def __init__(self, *_, **__):
            pass

        def __call__(self, x, t):
            return np.zeros(1)

    monkeypatch.setattr("drake_diff.loop.MPC", Idle)
    run = realtime.drive(replace(crane, duration=0.4), problem, plan, 0, "cpu")
    assert not run.arrived


@pytest.fixture(scope="module")
def solo():
    return contact.Plant(contact.SOLO), contact.rest_of(contact.SOLO, contact.FINE)


def test_a_quadrupeds_plant_takes_the_models_steps(solo):
    plant, rest = solo
    model = contact.model_of(contact.SOLO, contact.FINE)
    us = np.repeat(0.3 * np.random.default_rng(0).standard_normal((2, model.nu)), [10, 15], axis=0)
    plant.start(rest)
    plant.go_on(us[0], 10)
    plant.go_on(us[-1], 25)
    np.testing.assert_allclose(plant.x, dd.rollout(model, rest, us).xs[-1], atol=1e-12)


def test_a_blow_gives_the_robot_its_momentum(solo):
    """p of the whole in free motion: the mass matrix's rows of the base are the momentum."""
    plant, rest = solo
    plant.start(rest)
    plant.push(np.array([1.0, 0.5, 0.0]))
    momentum = plant.plant.CalcSpatialMomentumInWorldAboutPoint(plant.context, np.zeros(3)).translational()
    assert momentum == pytest.approx([1.0, 0.5, 0.0], abs=1e-9)


def test_what_fell_or_still_moves_is_no_recovery(solo):
    rest = solo[1]
    turned, low, fast = np.array(rest), np.array(rest), np.array(rest)
    turned[:4], low[6], fast[22] = [0.9, 0.43, 0, 0], rest[6] - 0.1, 1.0
    for x, is_one in ((rest, True), (turned, False), (low, False), (fast, False)):
        assert contact.recovered(contact.Run(xs=[x]), rest) == is_one
    assert not contact.recovered(contact.Run(xs=[rest], lost=True), rest)


def test_a_missed_tick_holds_the_old_input(solo, monkeypatch):
    """A clock by which each answer takes 30 ms: no answer is ever used, and all are counted."""
    plant, rest = solo
    times = iter(0.03 * np.arange(1000))
    monkeypatch.setattr(contact.time, "thread_time", lambda: next(times))
    run = contact.drive(plant, lambda x, t: np.full(12, 2.0), rest, 5)
    assert run.missed == 5
    idle = dd.rollout(contact.model_of(contact.SOLO, contact.FINE), rest, np.zeros((100, 12))).xs[-1]
    np.testing.assert_allclose(run.xs[-1], idle, atol=1e-12)

"""The humanoid of the benchmark: where its soles are, and what its referee refuses."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.legged import LEGGED, legged_model, rest

import drake_diff as dd

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
H = 0.02


@pytest.fixture(scope="module")
def standing():
    from biped_tasks import ROBOT

    return rest(ROBOT, legged_model(ROBOT, H), np.array(LEGGED[ROBOT].high), np.random.default_rng(3))


def test_it_stands_on_its_soles_over_their_middle(standing):
    from biped_tasks import ROBOT, _soles

    model = legged_model(ROBOT, H)
    soles = _soles(standing[: model.nq])
    assert np.all(np.abs(soles[:, :, 2]) < 0.004)  # 1.25 mm of an even share; it leans by what is drawn
    middle, mass = np.mean(soles, axis=(0, 1)), model.plant.CreateDefaultContext()
    model.plant.SetPositions(mass, standing[: model.nq])
    over = model.plant.CalcCenterOfMassPositionInWorld(mass)
    assert np.all(np.abs(over[:2] - middle[:2]) < 0.05)  # 2 cm are drawn, and it gives way a little


@pytest.mark.slow
def test_the_referee_follows_a_plan_step_by_step_and_refuses_one_that_is_not_drakes(standing):
    from biped_tasks import ROBOT, _kinematics
    from contact_plans import referee
    from contact_task import Task
    from legged_tasks import build

    model = legged_model(ROBOT, H)
    assert _kinematics()[0].num_positions() == model.nq
    problem = dd.Problem(model, x0=standing, num_steps=4, running_cost=dd.QuadraticCost(R=np.eye(model.nu)))
    us = np.zeros((4, model.nu))
    xs = np.array(dd.rollout(model, standing, us).xs)
    asks = (("nothing", lambda xs, us: 0.0, 1.0),)
    task = Task("falls", problem, "", asks=asks, build=lambda h: build(ROBOT, H, h), falls=True)
    plan = SimpleNamespace(xs=xs, us=us)
    assert referee(task, plan)[0] == []
    other = np.array(xs)
    other[2, 10] += 1e-4
    assert "from Drake's" in referee(task, SimpleNamespace(xs=other, us=us))[0][0]
    elsewhere = replace(task, problem=replace(problem, x0=standing + 1e-9))
    assert "does not start" in referee(elsewhere, plan)[0][0]

"""The referee of `tests/benchmarks/trust_solve.py`: true plans are true, and each kind of false one is not."""

import math
from pathlib import Path

import numpy as np
import pytest
from helpers.table import each_row, slow_after
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.framework import InputPortIndex
from pydrake.systems.primitives import LinearSystem

NONE = np.full(2, np.inf)


@pytest.fixture
def judge(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "benchmarks"))
    from referee import judge

    return judge


def block(step):
    """1 kg on a rail."""
    plant = MultibodyPlant(step)
    plant.SetUseSampledOutputPorts(False)
    body = plant.AddRigidBody("block", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    rail = plant.AddJoint(PrismaticJoint("rail", plant.world_frame(), body.body_frame(), [1, 0, 0]))
    plant.AddJointActuator("push", rail)
    plant.Finalize()
    return plant, plant.get_actuation_input_port().get_index(), plant.get_state_output_port().get_index()


def falling(_):
    """x'' = 9 x + u: what is pushed a little off is lost."""
    return LinearSystem([[0, 1], [9, 0]], [[0], [1]], np.eye(2), np.zeros((2, 1))), InputPortIndex(0), 0


def plan(**changes):
    """u = 6 - 12 t moves 1 m from rest to rest in 1 s, by x = 3 t^2 - 2 t^3."""
    return {
        "build": block, "T": 1.0, "nq": 1,
        "u": lambda t: np.array([6 - 12 * t]),
        "x": lambda t: np.array([3 * t**2 - 2 * t**3, 6 * t - 6 * t**2]),
        "goal": np.array([1.0, 0.0]),
        "x_lower": -NONE, "x_upper": NONE, "u_lower": np.array([-6.0]), "u_upper": np.array([6.0]),
    } | changes  # fmt: skip


@each_row("step", [0.0, 0.001])
def test_the_exact_move_is_true(judge, step):
    why, miss = judge(plan(), step, 0.01)
    assert why == ""
    assert miss < (1e-6 if step == 0 else 0.005)


@pytest.mark.parametrize("step", slow_after(1, [0.0, 0.001]))
@each_row(
    "changes, miss",
    [
        ({"goal": np.array([1.05, 0.0])}, 0.05),
        ({"goal": np.array([math.nan, 0.1])}, 0.1 / 1.5),
        ({"x_upper": np.array([np.inf, 1.4])}, 0.1 / 1.5),
        ({"u_upper": np.array([5.9])}, np.inf),
        ({"u_lower": np.array([-5.9])}, np.inf),
        ({"u": lambda t: np.array([3.0 - 6 * t]), "u_lower": -np.full(1, 3.0), "u_upper": np.full(1, 3.0)}, 0.1),
    ],
)
def test_a_false_plan_is_not(judge, step, changes, miss):
    """The better of open loop and feedback counts; steps of 1 ms lead 3 mm elsewhere. At least 4 N are needed."""
    why, found = judge(plan(**changes), step, 0.01)
    assert why
    assert found == pytest.approx(miss, abs=0.012) or found > miss


@each_row("asked, miss", [(1.0, 0.0), (1.02, 0.02)])
def test_what_is_asked_besides_is_measured_in_the_plants_own_motion(judge, asked, miss):
    """Where it ends, and that it is halfway at half the time."""
    asks = (
        ("end [m]", lambda times, xs: abs(xs[-1, 0] - asked), 0.01),
        ("middle [m]", lambda times, xs: abs(np.interp(0.5, times, xs[:, 0]) - 0.5), 0.01),
    )
    why, _ = judge(plan(asks=asks), 0.0, 0.05)
    assert (why == "") == (miss == 0)
    assert miss == 0 or "end [m]: 0.02, 0.01 allowed" in why
    assert "middle" not in why


def test_feedback_makes_an_unstable_motion_true_and_a_limit_makes_it_false(judge):
    """x'' = 9 x + u, kept at 0 from 1 mm off: open loop it is 10 cm off after 1.8 s; 5 mN are too little to hold it."""
    rest = plan(
        build=falling, T=1.8, u=lambda t: np.zeros(1), goal=np.zeros(2), u_lower=-np.ones(1), u_upper=np.ones(1)
    )
    rest["x"] = lambda t: np.array([0.001 * (t == 0) + 0.0, 0.0])
    why, miss = judge(rest | {"x_upper": NONE}, 0.0, 0.05)
    assert why == ""
    assert miss < 0.05
    why, _ = judge(rest | {"u_lower": np.full(1, -0.005), "u_upper": np.full(1, 0.005)}, 0.0, 0.05)
    assert why

"""Check base inertial parameters: two rods against the textbook, and Drake's motion when they stay the same."""

import numpy as np
import pytest
from helpers.robots import example_robot, state_in_range
from helpers.table import slow_after
from pydrake.multibody.tree import MultibodyForces, SpatialInertia, UnitInertia

from drake_diff.exceptions import ModelError, UnknownNameError
from drake_diff.identification import base_parameters
from drake_diff.identification.excite import NAMES
from drake_diff.identification.tree import ten_numbers, tree_for_identification


@pytest.mark.slow
def test_two_rods_have_the_textbooks_sums(load):
    """Rods of 1 kg and 0.8 m, 0.7 kg and 0.5 m: I1 + l1^2 m2, m1 c1 + l1 m2, I2, m2 c2, with no lateral moments."""
    found = {next(iter(b.parts)): b for b in base_parameters(load("double_pendulum.urdf"))}
    assert {name: dict(b.parts) for name, b in found.items()} == {
        "upper.inertia_yy": {"upper.inertia_yy": 1.0, "lower.mass": pytest.approx(0.64)},
        "upper.moment_x": {"upper.moment_x": 1.0},
        "upper.moment_z": {"upper.moment_z": 1.0, "lower.mass": pytest.approx(-0.8)},
        "lower.inertia_yy": {"lower.inertia_yy": 1.0},
        "lower.moment_x": {"lower.moment_x": 1.0},
        "lower.moment_z": {"lower.moment_z": 1.0},
    }
    assert found["upper.inertia_yy"].value == pytest.approx(0.8**2 / 3 + 0.64 * 0.7)
    assert found["upper.moment_z"].value == pytest.approx(-0.4 - 0.8 * 0.7)
    assert str(found["upper.moment_z"]) == "upper.moment_z - 0.8 lower.mass = -0.96 kg m"
    (yy, *_) = base_parameters(load("double_pendulum.urdf"), ["lower"])
    # With a known upper link, the lower link's mass is observable alone.
    assert dict(yy.parts) == {"lower.inertia_yy": 1.0}


@pytest.mark.parametrize(
    ("name", "count"), slow_after(1, [("ur5_robot.urdf", 36), ("solo12.urdf", None), ("so100.urdf", None)])
)
def test_numbers_that_leave_the_sums_leave_the_motion(name, count):
    """A UR5 has 36 base parameters, as published for its kind. Equal ones give equal torques in Drake."""
    model, random = example_robot(name), np.random.default_rng(0)
    found = base_parameters(model)
    if count is not None:
        assert len(found) == count
    tree = tree_for_identification(model)
    bodies = [body for body, link in tree.bodies.items() if tree.on[body][0] >= 0 and link.mass > 0]
    columns = [f"{body}.{name}" for body in bodies for name in NAMES]
    sums = np.array([[b.parts.get(column, 0.0) for column in columns] for b in found])
    _, s, V = np.linalg.svd(sums)
    change = V[len(s) :].T @ random.standard_normal(len(columns) - len(s))
    own = np.concatenate([ten(tree.bodies[body]) for body in bodies])
    np.testing.assert_allclose(sums @ own, [b.value for b in found], atol=1e-9)
    change *= 0.1 * min(tree.bodies[body].mass for body in bodies) / np.abs(change).max()
    plant = model.plant

    def torque(x, a, numbers):
        context = plant.CreateDefaultContext()
        for body, (m, *rest) in zip(bodies, numbers.reshape(-1, 10), strict=True):
            moment, inertia = np.array(rest[:3]), np.array(rest[3:])
            value = SpatialInertia(m, moment / m, UnitInertia(*(inertia / m)), skip_validity_check=True)
            plant.GetBodyByName(body).SetSpatialInertiaInBodyFrame(context, value)
        plant.SetPositionsAndVelocities(context, x)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        return plant.CalcInverseDynamics(context, a, forces)

    x, a = state_in_range(model, random), random.standard_normal(model.nv)
    before = torque(x, a, own)
    after = torque(x, a, own + change)
    other = torque(x, a, own + np.abs(change).max() * random.uniform(-1, 1, len(own)))
    # The base parameters are accurate to 1e-7 of an effect.
    assert np.abs(after - before).max() < 1e-5 * np.abs(other - before).max()


def test_what_makes_no_sense_is_refused(load):
    with pytest.raises(UnknownNameError, match="lowest"):
        base_parameters(load("double_pendulum.urdf"), ["lowest"])
    with pytest.raises(ModelError, match="controllers"):
        base_parameters(example_robot("finger_edu.urdf", gains=(1.0, 0.1)))


def ten(link):
    return ten_numbers(link.mass, link.center_of_mass, link.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])

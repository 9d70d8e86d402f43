"""Rollouts and plans in continuous time: closed forms, and another integration of the same law."""

import numpy as np
import pytest
from helpers.models import MODELS, Plant, contact_properties
from helpers.robots import example_robot, state_in_contact

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError
from drake_diff.motion.continuous import ContinuousMotion

ENERGY = 1e-7  # [J] of a few: steps of 1e-9 each, some hundred of them in contact


def ball_on_rails(*, stiffness=1e4, dissipation=0.0, friction=0.0, gravity=0.0, time_step=0.01, motors=()):
    """1 kg, radius 0.1 m, on rails along x and z above the ground; `stiffness` is that of the pair."""
    plant = Plant(time_step, "lagged", gravity=gravity)
    properties = contact_properties(2 * stiffness, dissipation, friction)
    plant.ball("ball", 1.0, 0.1, properties, "x", "z")
    plant.ground(properties)
    for axis in motors:
        plant.plant.AddJointActuator(f"thrust_{axis}", plant.plant.GetJointByName(f"ball_{axis}"), 50.0)
    return plant.model()


def test_an_elastic_bounce_between_two_ends_is_where_its_closed_form_is():
    """Half a period pi / omega in contact, V / omega deep, and no energy is lost: contact took it and gave it back."""
    stiffness, speed = 1e4, 2.0
    model, omega = ball_on_rails(stiffness=stiffness), np.sqrt(1e4)
    motion = dd.rollout(model, [0, 1.005, 0, -speed], num_steps=100, method="continuous")
    t, touch = motion.times, 0.905 / speed
    after = 0.1 + speed * (t - touch - np.pi / omega)
    away = (t < touch) | (t > touch + np.pi / omega)
    expected = np.where(t < touch, 1.005 - speed * t, after)
    assert np.max(np.abs(motion.xs[away, 1] - expected[away])) < 1e-7
    assert np.max(motion.penetration) == pytest.approx(speed / omega, rel=1e-2)
    assert np.max(np.abs(motion.energy_error)) < ENERGY
    stored = np.where(away, 0.0, 2.0 * np.sin(omega * (t - touch)) ** 2)  # [J] of the 2 J that it comes with
    assert np.max(np.abs(motion.contact_work + stored)) < 1e-6
    assert [i for i, c in enumerate(motion.contacts) if c] == [45, 46, 47]


def test_a_slide_stops_where_coulomb_says_and_friction_took_its_energy():
    mu, g, v0 = 0.5, 9.81, 1.0
    model = ball_on_rails(dissipation=10, friction=mu, gravity=g)
    motion = dd.rollout(model, [0, 0.1 - g / 1e4, v0, 0], num_steps=60, method="continuous")
    assert motion.xs[-1, 0] == pytest.approx(v0**2 / (2 * mu * g), rel=2e-3)
    assert motion.contact_work[-1] == pytest.approx(-(v0**2) / 2, rel=1e-3)
    assert np.max(np.abs(motion.energy_error)) < ENERGY
    force = motion.contacts[10][0].force
    assert force == pytest.approx([-mu * g, 0, g], rel=1e-3)
    assert (motion.contacts[10][0].body_a, motion.contacts[10][0].slip_speed) == ("ball", pytest.approx(0.46, rel=0.01))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["bolt.urdf", "solo12.urdf"])
def test_the_work_on_a_robot_in_contact_accounts_for_its_energy(name, seed):
    """Energies are Drake's, the motion and the powers are not; another integration is where it is."""
    model, random = example_robot(name, feet=True, friction=0.6), np.random.default_rng(seed)
    x0 = state_in_contact(model, random)
    us = 0.3 * random.standard_normal((8, model.nu))
    motion = dd.rollout(model, x0, us, method="continuous")
    assert any(motion.contacts)
    exchanged = motion.energy_exchanged
    assert np.max(np.abs(motion.energy_error)) < 1e-6 * exchanged
    assert np.max(np.abs(ContinuousMotion(model).states(x0, us) - motion.xs)) < 1e-5


def test_a_policy_drives_the_motion_in_continuous_time():
    model = ball_on_rails(dissipation=0.5, gravity=9.81, motors=("z",))
    x0, gain = [0, 0.3, 0.2, 0], np.array([[0, 3.0, 0, 1.0]])
    closed = dd.rollout(model, x0, policy=lambda x, t: -gain @ x, num_steps=60, method="continuous")
    again = dd.rollout(model, x0, closed.us, method="continuous")
    assert np.allclose(closed.us, -closed.xs[:-1] @ gain.T)
    assert np.array_equal(closed.xs, again.xs)
    assert closed.work[-1] < -0.1
    assert np.max(np.abs(closed.energy_error)) < ENERGY


def test_stiffer_contact_is_another_motion_and_other_parameters_are_refused():
    model, x0 = ball_on_rails(), [0, 0.2, 0, -2.0]
    soft, stiff = (
        dd.rollout(model, x0, num_steps=20, method="continuous", parameters={"ball.stiffness": k}).xs[-1, 1]
        for k in (1e4, 1e6)
    )
    pair = [1e4 * 2e4 / 3e4, 1e6 * 2e4 / 1.02e6]
    expected = [0.1 + 2 * (0.2 - 0.05 - np.pi / np.sqrt(k)) for k in pair]
    assert [soft, stiff] == pytest.approx(expected, abs=1e-7)
    with pytest.raises(ModelError, match=r"takes no ball\.mass: of parameters it takes contact's"):
        dd.rollout(model, x0, num_steps=5, method="continuous", parameters={"ball.mass": 2.0})
    with pytest.raises(InputError, match="method"):
        dd.rollout(model, x0, num_steps=5, method="rk3")
    controlled = dd.load_model(MODELS / "acrobot.xml", time_step=0.01)
    assert controlled.nx == dd.rollout(controlled, controlled.default_state, [[0.1]], method="continuous").xs.shape[1]

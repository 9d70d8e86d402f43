"""Quantities measured along rollouts equal their closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.models import MODELS, Plant, contact_properties
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, SimulationError
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.model.step import advance, set_state
from drake_diff.motion.rollout import Meter
from drake_diff.optimize.replay import energy_check


@pytest.fixture
def oscillator(tmp_path):
    """Load the mass on its spring, without damping and with a rest length of 0."""
    text = (MODELS / "mass_spring_damper.sdf").read_text()
    text = text.replace("<damping>1.5", "<damping>0").replace("<spring_reference>0.1", "<spring_reference>0")
    (tmp_path / "oscillator.sdf").write_text(text)
    return dd.load_model(tmp_path / "oscillator.sdf", time_step=0.01)


def test_symplectic_euler_conserves_a_modified_energy(oscillator):
    """The conserved energy is v^2 + w^2 x^2 - h w^2 x v with w = 5."""
    motion = dd.rollout(oscillator, [0.2, 0.0], np.zeros((5000, 1)))
    x, v = motion.xs.T
    modified = v**2 + 25 * x**2 - 0.01 * 25 * x * v
    assert np.abs(modified / modified[0] - 1).max() < 1e-11


def test_a_motion_of_no_steps_is_a_state(oscillator):
    """A closed loop that ends before its first step has this motion. Its energy is k x^2 / 2 with k = 25 N/m per kg."""
    meter = Meter(oscillator)
    set_state(oscillator.double, np.array([0.2, 0.0]))
    meter.measure_state(np.array([0.2, 0.0]))
    motion = meter.result(np.array([[0.2, 0.0]]), np.zeros((0, 1)))
    assert motion.energy == pytest.approx(25 * oscillator.double.plant.CalcTotalMass(meter.context) * 0.02, rel=1e-12)
    assert [len(motion.efforts), len(motion.contacts), *motion.work, *motion.penetration] == [0, 0, 0.0, 0.0]


@pytest.mark.parametrize("h", [0.02, 0.005])
def test_the_oscillators_frequency_and_power_of_its_jacobian(oscillator, h):
    """A^N = (sin(N a) A - sin((N - 1) a) I) / sin a with cos a = 1 - h^2 w^2 / 2."""
    model = dd.load_model(oscillator.source, time_step=h)
    A = dd.differentiate_step(model, [0.2, 0.0], [0.0]).A
    count, angle = 100, math.acos(1 - (5 * h) ** 2 / 2)
    expected = (math.sin(count * angle) * A - math.sin((count - 1) * angle) * np.eye(2)) / math.sin(angle)
    g = [dd.differentiate_rollout(model, [0.2, 0.0], np.zeros((count, 1)), lambda x, i=i: x[i]).by_x0 for i in (0, 1)]
    assert np.array(g) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_free_fall_drifts_as_symplectic_euler_must(load):
    """For a thrown body E_N - E_0 = -m g^2 h T / 2, which is a drift without oscillation."""
    model = load("projectile.sdf", time_step=0.01)
    motion = dd.rollout(model, model.default_state, num_steps=100)
    assert motion.energy_drift == pytest.approx(-0.5 * 9.81**2 * 0.01, rel=1e-9)
    assert motion.energy_oscillation < 1e-12


@pytest.mark.solve
@pytest.mark.parametrize("approximation", ["lagged", "similar", "sap"])
def test_what_slides_to_a_stop_loses_mu_m_g_d_to_contact_and_no_energy_is_unexplained(load, approximation):
    """Friction, mu = 0.4, dissipates m v^2 / 2 = mu m g d of a block of 2 kg on four spheres that starts at 1 m/s."""
    model = load("sliding_block.sdf", time_step=0.001, contact_approximation=approximation)
    x = np.array(model.default_state)
    x[6], x[10] = 0.05 - 2 * 9.81 / 4 / 1e4, 1.0
    motion = dd.rollout(model, x, num_steps=600)
    way = motion.xs[-1, 4] - motion.xs[0, 4]
    assert abs(motion.xs[-1, 10]) < 1e-3
    assert motion.contact_work[-1] == pytest.approx(-1.0, abs=2e-4)  # regularized friction lets it creep at 1e-4 m/s
    assert motion.contact_work[-1] == pytest.approx(-0.4 * 2 * 9.81 * way, rel=0.01)  # Euler's error is v h / 2
    assert abs(motion.energy_drift) < 1e-4
    assert energy_check(motion).passes
    # Without the work of contact, a joule is missing, and the check reports it.
    unexplained = replace(motion, contact_work=np.zeros(601))
    assert (energy_check(unexplained).where, energy_check(unexplained).verdict) == ("lost", "fail")
    doubled = replace(motion, contact_work=2 * motion.contact_work)
    assert (energy_check(doubled).where, energy_check(doubled).verdict) == ("gained", "fail")


def test_what_a_joint_limit_takes_is_the_limits_work(load):
    """A cart hits its limit at 2 m/s. The lost energy is the work of the limit, up to the error of time stepping."""
    model = load("cart_pole.urdf")
    motion = dd.rollout(model, [1.8, np.pi, 2.0, 0.0], np.zeros((100, 1)))
    assert np.all(motion.contact_work == 0)
    assert motion.limit_work[-1] < -1.0
    lost = motion.energy[0] - motion.energy[-1]
    assert -motion.limit_work[-1] == pytest.approx(lost, abs=0.1 * motion.energy_exchanged)
    assert energy_check(motion).passes
    untold = replace(motion, limit_work=np.zeros(101))
    assert np.abs(untold.energy_error).max() > 10 * np.abs(motion.energy_error).max()


def test_a_policy_gives_what_its_inputs_give(load):
    model = load("cart_pole.urdf")
    closed = dd.rollout(model, [0, 0.3, 0, 0], policy=lambda x, t: [-2 * x[0] + np.sin(t)], num_steps=30)
    assert closed.us[5, 0] == pytest.approx(-2 * closed.xs[5, 0] + math.sin(0.05), rel=1e-14)
    assert np.array_equal(dd.rollout(model, [0, 0.3, 0, 0], closed.us).xs, closed.xs)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_step_under_an_input_that_is_not_finite_is_refused(load, value):
    """A solver may try such an input, and Drake would end the whole process."""
    with pytest.raises(SimulationError, match="an input is not finite"):
        advance(load("cart_pole.urdf").double, np.zeros(4), np.array([value]))


def test_efforts_are_what_the_limits_leave(load):
    motion = dd.rollout(load("cart_pole.urdf"), np.zeros(4), [[50.0], [-3.0]])
    assert motion.us.ravel().tolist() == [50.0, -3.0]
    assert motion.efforts.ravel().tolist() == [20.0, -3.0]


def test_a_saturated_input_has_no_derivative(load):
    d = dd.differentiate_step(load("cart_pole.urdf"), np.zeros(4), [50.0])
    assert np.array_equal(d.B, np.zeros((4, 1)))


def test_a_ball_comes_to_rest_on_the_ground_which_carries_it(load):
    model = load("sphere_on_ground.sdf", time_step=0.005)
    x0 = model.default_state
    x0[6] = 0.12
    motion = dd.rollout(model, x0, num_steps=600)
    assert motion.penetration[0] == 0.0
    assert motion.penetration[-1] == pytest.approx(9.81 / 1e4, rel=1e-6)
    assert 9.81 / 1e4 < motion.penetration.max() < 0.01
    contact = motion.contacts[-1][0]
    assert {contact.body_a, contact.body_b} == {"ground", "ball"}
    up = contact.force if contact.body_a == "ball" else -contact.force
    assert up == pytest.approx([0, 0, 9.81], abs=1e-4)
    assert contact.depth == pytest.approx(9.81 / 1e4, rel=1e-4)
    assert motion.contacts[0] == ()


def test_a_joint_beyond_its_limit_and_a_drifting_quaternion_show(load):
    motion = dd.rollout(load("cart_pole.urdf"), [2.25, 0, 0, 0], [[0.0]])
    assert motion.constraint_violation[0] == pytest.approx(0.25, abs=1e-14)
    model = load("projectile.sdf")
    x = model.default_state
    x[7] = 10.0
    spun = dd.rollout(model, x, num_steps=1)
    assert spun.constraint_violation[1] == pytest.approx(math.hypot(1, 0.05) - 1, rel=1e-9)  # q+ = q + h w q / 2


def test_the_violation_of_a_plants_constraints_is_not_called_zero():
    plant = Plant(0.01)
    bodies = [plant.ball(name, 1.0, 0.1, contact_properties(1e4), "x", "z") for name in "ab"]
    plant.plant.AddDistanceConstraint(bodies[0], [0, 0, 0], bodies[1], [0, 0, 0], 1.0)
    model = plant.model()
    motion = dd.rollout(model, [0, 0, 1, 0, 0, 0, 0, 0], num_steps=2)
    assert np.all(np.isinf(motion.constraint_violation))
    with pytest.raises(ModelError, match="constraints have no continuous form"):
        EquationsOfMotion(model)


@each_row(
    "arguments, options, words",
    [
        (([0.0],), {"us": [[0.0]]}, "x0: expected shape"),
        (([0.0, math.nan],), {"us": [[0.0]]}, "finite number"),
        (([0.0, 0.0],), {"us": [0.0]}, r"us: expected shape \(N, 1\)"),
        (([0.0, 0.0],), {"us": np.zeros((0, 1))}, "at least one step"),
        (([0.0, 0.0],), {"us": [[0.0]], "policy": lambda x, t: [0.0]}, "one of them"),
        (([0.0, 0.0],), {"policy": lambda x, t: [0.0], "num_steps": 0}, "num_steps"),
        (
            ([0.0, 0.0],),
            {"policy": lambda x, t: [0.0, 1.0], "num_steps": 1},
            r"policy .* its list: expected shape \(1,\)",
        ),
        (([0.0, 0.0],), {"us": [[0.0]], "num_steps": 3}, "num_steps"),
    ],
)
def test_bad_input_is_named(load, arguments, options, words):
    with pytest.raises(InputError, match=words):
        dd.rollout(load("pendulum.urdf"), *arguments, **options)

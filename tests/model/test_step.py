"""Tests of one step against closed forms, to 1e-12 if it is smooth and to 1e-7 if SAP solves for contact."""

import math

import numpy as np
import pytest
from helpers.models import MODELS, Plant, contact_properties, random_state
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError, SimulationError

G = 9.81
APPROXIMATIONS = ("sap", "similar", "lagged")


@pytest.mark.parametrize(("h", "count"), [(0.01, 100), (0.004, 37)])
def test_projectile_follows_symplectic_euler(load, h, count):
    """p_N = p0 + v0 N h - g h^2 N (N + 1) / 2."""
    model = load("projectile.sdf", time_step=h)
    p0, v0 = np.array([0.3, -1.0, 1.0]), np.array([2.0, 1.0, 5.0])
    x0 = np.concatenate([[1, 0, 0, 0], p0, np.zeros(3), v0])
    end = dd.rollout(model, x0, num_steps=count).xs[-1]
    fall = np.array([0, 0, G]) * h**2 * count * (count + 1) / 2
    assert end[4:7] == pytest.approx(p0 + v0 * count * h - fall, rel=1e-9)
    assert end[10:] == pytest.approx(v0 - [0, 0, G * count * h], rel=1e-9)


def pendulum_step(q, w, u, h, l=0.5, b=0.1, m=1.0):  # noqa: E741
    """Return the next state, A, B and det A of a pendulum with implicit damping and explicit gravity and input."""
    inertia = m * l**2
    s = 1 / (1 + h * b / inertia)
    w_next = s * (w + h * (-(G / l) * math.sin(q) + u / inertia))
    A = [[1 - h**2 * s * (G / l) * math.cos(q), h * s], [-h * s * (G / l) * math.cos(q), s]]
    return [q + h * w_next, w_next], A, [[h**2 * s / inertia], [h * s / inertia]], s


@each_row("approximation", APPROXIMATIONS)
@each_row("h, q, w, u", [(0.01, 0.7, -1.2, 0.3), (0.003, -2.5, 4.0, -1.7), (0.05, 3.1, 0.0, 0.0)])
def test_pendulum_step_and_jacobian(load, approximation, h, q, w, u):
    model = load("pendulum.urdf", time_step=h, contact_approximation=approximation)
    x_next, A, B, s = pendulum_step(q, w, u, h)
    assert dd.step(model, [q, w], [u]) == pytest.approx(x_next, rel=1e-12)
    d = dd.differentiate_step(model, [q, w], [u])
    assert pytest.approx(np.array(A), rel=1e-12) == d.A
    assert pytest.approx(np.array(B), rel=1e-12) == d.B
    assert np.linalg.det(d.A) == pytest.approx(s, rel=1e-12)


def test_double_pendulum_step_jacobian_and_energy(load):
    """The step solves M (v+ - v) / h = u - bias - G and q+ = q + h v+.

    c = m2 l1 l2 / 2, bias = (-c sin q2 (2 w1 w2 + w2^2), c sin q2 w1^2), G1 = (m1 / 2 + m2) g l1 sin q1 + G2,
    G2 = m2 g l2 sin(q1 + q2) / 2.
    """
    model = load("double_pendulum.urdf", time_step=0.005)
    x, u = [0.4, -0.9, 1.3, -0.6], [0.25, -0.15]
    d = dd.differentiate_step(model, x, u)
    expected = [0.40628355157782, -0.902092759011, 1.25671031556302, -0.41855180220094]
    assert d.x_next == pytest.approx(expected, abs=1e-13)
    lower = [
        [-0.0604564179632879, -0.0182224978032518, 0.994554043826923, -0.00144431914674947],
        [0.0215128929057214, -0.0149505999112984, 0.0380103812989330, 1.00359904677631],
    ]
    assert d.A[2:] == pytest.approx(np.array(lower), abs=1e-13)
    inputs = [[0.00940727957631641, -0.02344166059779], [-0.02344166059779, 0.144127714073045]]
    assert d.B[2:] == pytest.approx(np.array(inputs), abs=1e-13)
    assert np.linalg.det(d.A) == pytest.approx(0.9981883894737102, rel=1e-12)
    motion = dd.rollout(model, x, [u])
    assert motion.kinetic_energy[0] == pytest.approx(0.6523114432910162, rel=1e-12)
    assert motion.potential_energy[0] == pytest.approx(-10.18077388024687, rel=1e-12)


ALL = ("pendulum.urdf", "cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml", "mass_spring_damper.sdf")


@each_row("name", ALL)
def test_upper_half_of_the_jacobian_follows_from_the_lower(load, name):
    """If dq/dt = v, then A_top = [I 0] + h A_bottom, B_top = h B_bottom, det A = det dv+/dv."""
    model, random = load(name), np.random.default_rng(1)
    h, n = model.time_step, model.nv
    for _ in range(5):
        d = dd.differentiate_step(model, random_state(model, random), random.standard_normal(model.nu))
        assert d.A[:n] == pytest.approx(np.eye(n, 2 * n) + h * d.A[n:], abs=1e-14)
        assert d.B[:n] == pytest.approx(h * d.B[n:], abs=1e-14)
        assert np.linalg.det(d.A) == pytest.approx(np.linalg.det(d.A[n:, n:]), rel=1e-12)


def ball_on_ground(h, k, approximation, relaxation_time=None, mass=1.0):
    """Return a model of a ball on a vertical rail. Both sides have stiffness 2k, so the pair has stiffness k."""
    plant = Plant(h, approximation)
    plant.ball("ball", mass, 0.1, contact_properties(2 * k, relaxation_time=relaxation_time), "z")
    plant.ground(contact_properties(2 * k, relaxation_time=relaxation_time and 0.0))
    return plant.model()


CONTACTS = [(0.003, -0.2), (0.003, 0.4), (0.0005, -1.0)]


@each_row("h, k", [(0.005, 5000.0), (0.002, 20000.0)])
@each_row("approximation", ["lagged", "similar"])
@each_row("depth, v", CONTACTS)
def test_point_contact_step_without_dissipation(h, k, approximation, depth, v):
    """v+ = (v - g h + h k x / m) / (1 + h^2 k / m) if the contact force is positive, else free fall."""
    model = ball_on_ground(h, k, approximation)
    pressed = (v - G * h + h * k * depth) / (1 + h**2 * k)
    touches = k * depth - h * k * pressed > 0
    d = dd.differentiate_step(model, [0.1 - depth, v])
    assert d.x_next[1] == pytest.approx(pressed if touches else v - G * h, rel=1e-7)
    expected = [-h * k / (1 + h**2 * k), 1 / (1 + h**2 * k)] if touches else [0, 1]
    assert d.A[1] == pytest.approx(expected, rel=1e-6, abs=1e-12)


@each_row("h, k, tau", [(0.005, 5000.0, 0.02), (0.005, 5000.0, 0.0), (0.002, 8000.0, 0.007)])
@each_row("depth, v", CONTACTS)
def test_sap_contact_step(h, k, tau, depth, v):
    """SAP has the regularization R = 1 / (h k (h + tau)) and the bias x / (h + tau)."""
    model = ball_on_ground(h, k, "sap", relaxation_time=tau)
    bias, regularization = depth / (h + tau), 1 / (h * k * (h + tau))
    pressed = (v - G * h + bias / regularization) / (1 + 1 / regularization)
    touches = bias > pressed
    d = dd.differentiate_step(model, [0.1 - depth, v])
    assert d.x_next[1] == pytest.approx(pressed if touches else v - G * h, rel=1e-7)
    slope = 1 / (1 + 1 / regularization)
    expected = [-slope * h * k, slope] if touches else [0, 1]
    assert d.A[1] == pytest.approx(expected, rel=1e-6, abs=1e-12)


@pytest.mark.slow
@each_row("approximation", APPROXIMATIONS)
@each_row("k_ball, k_ground", [(1e4, 1e4), (2000.0, 6000.0)])
def test_static_penetration_is_weight_over_stiffness(approximation, k_ball, k_ground):
    """The penetration is m g / k after 8 s of settling. Stiffnesses combine as springs in series."""
    plant = Plant(0.01, approximation)
    plant.ball("ball", 1.0, 0.1, contact_properties(k_ball, dissipation=20.0, relaxation_time=0.1), "z")
    plant.ground(contact_properties(k_ground, dissipation=20.0, relaxation_time=0.1))
    motion = dd.rollout(plant.model(), [0.1, 0.0], num_steps=800)
    k = k_ball * k_ground / (k_ball + k_ground)
    assert motion.penetration[-1] == pytest.approx(G / k, abs=1e-8)


@each_row(
    "x, u, words",
    [
        ([0.1], [0.0], r"x: expected shape \(2,\), got shape \(1,\)"),
        ([0.1, 0.0], [0.0, 1.0], r"u: expected shape \(1,\), got shape \(2,\)"),
        ([0.1, math.nan], [0.0], r"x\[1\]: expected a finite number, got nan"),
        ([0.1, 0.0], [math.inf], r"u\[0\]: expected a finite number, got inf"),
        ([0.1, 0.0], None, r"u: expected shape"),
        (["a", 0.0], [0.0], "x: expected an array of numbers"),
    ],
)
def test_bad_input_is_named(load, x, u, words):
    with pytest.raises(InputError, match=words):
        dd.step(load("pendulum.urdf"), x, u)


def test_a_state_that_is_not_finite_is_an_error_not_the_end_of_the_process(load):
    """Drake's own step raises SystemExit for this state."""
    from drake_diff.model.step import advance

    with pytest.raises(SimulationError, match="not finite"):
        advance(load("pendulum.urdf").double, np.array([np.nan, 0.0]), np.zeros(1))


def test_all_that_is_simulated_in_a_block_is_counted_and_nothing_beside_it():
    """A rollout of N steps counts N, and a step with its AutoDiffXd derivative counts two. Blocks may be nested."""
    model = dd.load_model(MODELS / "hopper.sdf", time_step=0.01)
    still = [0, 0.9, 0, 0.45, 0, 0, 0, 0]  # in the air
    with dd.model.count_steps() as around:
        dd.rollout(model, still, np.zeros((7, 2)))
        with dd.model.count_steps() as inside:
            dd.differentiate_step(model, still, [0, 0], method="autodiff")
        assert (inside.steps, around.steps) == (2, 9)
        dd.rollout(model, still, np.zeros((5, 2)), method="continuous")
    assert (inside.steps, around.steps) == (2, 14)
    dd.step(model, still, [0, 0])
    assert around.steps == 14

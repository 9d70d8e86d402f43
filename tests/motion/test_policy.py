"""Feedback policies: LQR and TVLQR, derivatives with respect to state and parameters, and invalid policies."""

import math

import numpy as np
import pytest
from helpers.models import Plant
from helpers.table import each_row
from pydrake.autodiffutils import InitializeAutoDiff
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.controllers import DiscreteTimeLinearQuadraticRegulator

import drake_diff as dd
from drake_diff.exceptions import GradientError, InputError, NonFiniteError, ShapeError
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.policy import LQR, PD, TVLQR, ParametricPolicy, _check, differentiate_policy, policy_parameters

# The weights of the discrete double integrator with h = 0.1.
Q, R = np.eye(2), np.array([[0.1]])
UPRIGHT = np.array([0.0, np.pi, 0.0, 0.0])  # state of the cart-pole


def network(x, t, p, hidden=16):
    """Evaluate a 4-16-1 network W2 tanh(W1 x + b1) + b2 with p = [W1; b1; W2; b2] (97,)."""
    size = len(x)
    w1, rest = p[: hidden * size].reshape(hidden, size), p[hidden * size :]
    return rest[hidden : 2 * hidden].reshape(1, hidden) @ np.tanh(w1 @ x + rest[:hidden]) + rest[2 * hidden :]


def closed_loop_loss(xs, us, weight=0.01):
    """Return a loss of the end, the trajectory and the inputs, on which every part of the gradient depends."""
    return (xs[-1] ** 2).sum() + 0.1 * (xs**2).sum() + weight * (us**2).sum()


def central_differences(f, p, size=1e-5):
    moved = size * np.maximum(1.0, np.abs(p))
    return np.array([(f(p + d) - f(p - d)) / (2 * d.sum()) for d in np.diag(moved)])


def check_gradients(model, policy, x0, num_steps, parameters=(), tolerance=1e-6):
    """Check `differentiate_rollout` through the closed loop against central differences of `rollout`.

    The error of central differences with step 1e-5 is 1e-6 of the largest entry: 1e-10 of truncation and 1e-11 of
    rounding, magnified by some thirty steps.
    """
    x0 = np.asarray(x0, dtype=float)
    policy_values = np.array(policy_parameters(policy))
    known = {p.name: p.value[0] for p in dd.list_parameters(model)}
    model_values = {name: known[name] for name in parameters}

    def loss_at(x=x0, p=policy_values, values=None):
        values = model_values if values is None else dict(zip(model_values, values, strict=True))
        moved = ParametricPolicy(policy, p) if len(p) else policy
        motion = dd.rollout(model, x, policy=moved, num_steps=num_steps, parameters=values)
        return float(closed_loop_loss(motion.xs, motion.us))

    g = dd.differentiate_rollout(
        model, x0, None, closed_loop_loss, policy=policy, num_steps=num_steps, parameters=tuple(model_values)
    )
    motion = dd.rollout(model, x0, policy=policy, num_steps=num_steps)
    assert np.array_equal(g.xs, motion.xs)
    assert np.array_equal(g.us, motion.us)
    assert g.loss == pytest.approx(loss_at(), rel=1e-12)
    pairs = [(g.by_policy, central_differences(lambda p: loss_at(p=p), policy_values))] if len(policy_values) else []
    if not tangent_space(model).quaternions:  # a displaced quaternion would not have unit norm
        pairs.append((g.by_x0, central_differences(lambda x: loss_at(x=x), x0)))
    if model_values:
        values = np.array(list(model_values.values()))
        pairs.append((g.by_parameters, central_differences(lambda v: loss_at(values=v), values)))
    for found, expected in pairs:
        assert np.abs(expected).max() > 1e-3  # zero would agree with a loop that is not closed
        assert found == pytest.approx(expected, rel=tolerance, abs=tolerance * np.abs(expected).max())


def riccati(A, B, Q, R, P, num_steps):
    """Compute K_0 and P_0 by completing the square in [x; u], not by the textbook formula."""
    for _ in range(num_steps):
        AB = np.hstack([A, B])
        H = AB.T @ P @ AB
        nx = len(A)
        H[:nx, :nx] += Q
        H[nx:, nx:] += R
        K = np.linalg.inv(H[nx:, nx:]) @ H[nx:, :nx]
        P = H[:nx, :nx] - K.T @ H[nx:, nx:] @ K
        P = (P + P.T) / 2  # avoids growth of rounding errors
    return K, P


# --- LQR --------------------------------------------------------------------------------------------------------------


def test_lqr_of_the_double_integrator_is_known(write_urdf):
    """P and K of the discrete algebraic Riccati equation are known to eight digits."""
    lqr = LQR(write_urdf(), [0, 0], [0], Q, R)
    assert lqr.cost_to_go == pytest.approx(np.array([[12.82704933, 2.58530726], [2.58530726, 4.31618637]]), abs=1e-8)
    assert lqr.gain == pytest.approx(np.array([[2.58530726, 3.31618637]]), abs=1e-8)
    assert lqr([1.0, 2.0], 0.0) == pytest.approx([-2.58530726 - 2 * 3.31618637], abs=1e-7)
    assert np.array_equal(lqr.parameters, lqr.gain.ravel())


def test_lqr_gain_is_the_limit_of_the_riccati_recursion_and_drakes_own(load):
    """The model is the upright cart-pole, with another mass and time step than the reference solution."""
    model, weight = load("cart_pole.urdf", time_step=0.02), np.diag([1.0, 10.0, 0.1, 0.5])
    lqr = LQR(model, UPRIGHT, [0.0], weight, 0.3 * np.eye(1))
    d = dd.differentiate_step(model, UPRIGHT, [0.0])
    K, P = riccati(d.A, d.B, weight, 0.3 * np.eye(1), weight, 3000)
    assert lqr.gain == pytest.approx(K, rel=1e-8)
    assert lqr.cost_to_go == pytest.approx(P, rel=1e-8)
    assert np.array_equal(lqr.gain, DiscreteTimeLinearQuadraticRegulator(d.A, d.B, weight, 0.3 * np.eye(1))[0])


def test_lqr_spends_its_cost_to_go(write_urdf):
    """The sum of d'Qd + u'Ru along the closed loop is d0' P d0."""
    model = write_urdf(mass=2.0)
    lqr = LQR(model, [0.5, 0.0], [0.0], Q, R)  # every state at rest is a fixed point
    motion = dd.rollout(model, [1.5, -0.3], policy=lqr, num_steps=400)
    d = motion.xs - [0.5, 0.0]
    assert (d**2).sum() + 0.1 * (motion.us**2).sum() == pytest.approx(d[0] @ lqr.cost_to_go @ d[0], rel=1e-10)


def test_lqr_refuses_what_is_no_fixed_point(load, write_urdf):
    with pytest.raises(InputError, match="fixed point"):
        LQR(load("pendulum.urdf"), [0.3, 0.0], [0.0], Q, R)
    with pytest.raises(InputError, match="fixed point"):
        LQR(write_urdf(), [0.0, 1e-3], [0.0], Q, R)
    held = LQR(load("pendulum.urdf"), [0.3, 0.0], [9.81 * 0.5 * math.sin(0.3)], Q, R)  # the static torque
    assert held([0.3, 0.0], 0.0) == pytest.approx([9.81 * 0.5 * math.sin(0.3)])


def test_lqr_refuses_weights_it_cannot_use(write_urdf):
    model = write_urdf()
    for weights in [(Q, [[0.0]]), (Q, [[-1.0]]), (-Q, R), ([[1, 2], [0, 1]], R)]:
        with pytest.raises(InputError, match=r"positive|symmetric"):
            LQR(model, [0, 0], [0], *weights)
    with pytest.raises(ShapeError, match="x_ref"):
        LQR(model, [0, 0, 0], [0], Q, R)
    with pytest.raises(InputError, match="Q that weights all unstable directions"):  # Drake would end the process
        LQR(model, [0, 0], [0], np.zeros((2, 2)), R)
    model = floating_arm()
    with pytest.raises(InputError, match="stabilize"):
        LQR(model, model.default_state, [0.0], np.eye(14), np.eye(1))


# --- TVLQR ------------------------------------------------------------------------------------------------------------


def test_tvlqr_of_the_double_integrator_is_known(write_urdf):
    """P0, K0 and the optimal cost are known for N = 20, Qf = 10 I and x0 = (1, 0)."""
    model, count = write_urdf(), 20
    tvlqr = TVLQR(model, np.zeros((count + 1, 2)), np.zeros((count, 1)), Q, R, 10 * Q)
    assert tvlqr.gains.shape == (count, 1, 2)
    assert tvlqr.cost_to_go.shape == (count + 1, 2, 2)
    P0 = np.array([[12.94848128, 2.61821518], [2.61821518, 4.32509127]])
    assert tvlqr.cost_to_go[0] == pytest.approx(P0, abs=1e-8)
    assert tvlqr.gains[0] == pytest.approx(np.array([[2.61821518, 3.32509127]]), abs=1e-8)
    assert np.array_equal(tvlqr.cost_to_go[-1], 10 * Q)
    motion = dd.rollout(model, [1.0, 0.0], policy=tvlqr, num_steps=count)
    cost = (motion.xs[:-1] ** 2).sum() + 0.1 * (motion.us**2).sum() + 10 * motion.xs[-1] @ motion.xs[-1]
    assert cost == pytest.approx(12.948481280713864, rel=1e-12)


def test_tvlqr_follows_a_trajectory_that_open_loop_loses(load):
    """The pendulum is pushed over the top. The effect of a wrong start vanishes, and step k uses its own gain."""
    model, count = load("pendulum.urdf", time_step=0.02), 150
    us = 5.0 * np.ones((count, 1))
    xs = dd.rollout(model, [0.0, 0.0], us).xs
    tvlqr = TVLQR(model, xs, us, np.diag([100.0, 1.0]), R)
    start = xs[0] + [0.2, -0.3]
    closed = dd.rollout(model, start, policy=tvlqr, num_steps=count)
    assert np.abs(closed.xs[-1] - xs[-1]).max() < 1e-4
    assert np.abs(dd.rollout(model, start, us).xs[-1] - xs[-1]).max() > 0.1
    for k in (0, 7, count - 1):
        assert tvlqr(start, k * 0.02) == pytest.approx(us[k] - tvlqr.gains[k] @ (start - xs[k]), rel=1e-14)
    assert np.array_equal(tvlqr(start, 99.0), tvlqr(start, (count - 1) * 0.02))  # the last gain acts afterwards
    assert np.array_equal(tvlqr(start, -1.0), tvlqr(start, 0.0))


def floating_arm():
    """Build a free ball with an actuated bob on a hinge, without gravity."""
    plant = Plant(0.02, gravity=0.0)
    ball = plant.plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(2.0, 0.3))
    bob = plant.plant.AddRigidBody("bob", SpatialInertia(0.5, [0.0, 0.0, -0.4], UnitInertia(0.17, 0.17, 0.01)))
    hinge = plant.plant.AddJoint(RevoluteJoint("hinge", ball.body_frame(), bob.body_frame(), [0, 1, 0]))
    plant.plant.AddJointActuator("motor", hinge)
    return plant.model()


def test_tvlqr_of_a_floating_base_lives_in_the_tangent_space():
    """The gains equal those of Jacobians from differences of plus, step and minus: 14 columns for 15 coordinates."""
    model, random, count = floating_arm(), np.random.default_rng(3), 6
    space = tangent_space(model)
    assert (model.nx, space.size) == (15, 14)
    x0 = space.plus(model.default_state, 0.5 * random.standard_normal(14))
    us = random.standard_normal((count, 1))
    xs = dd.rollout(model, x0, us).xs
    tvlqr = TVLQR(model, xs, us, np.eye(14), np.eye(1))
    P = np.eye(14)
    for k in reversed(range(count)):
        A = tangent_differences(lambda d, k=k: space.minus(dd.step(model, space.plus(xs[k], d), us[k]), xs[k + 1]), 14)
        B = tangent_differences(lambda e, k=k: space.minus(dd.step(model, xs[k], us[k] + e), xs[k + 1]), 1)
        K, P = riccati(A, B, np.eye(14), np.eye(1), P, 1)
        assert tvlqr.gains[k] == pytest.approx(K, abs=1e-7)
        assert tvlqr.cost_to_go[k] == pytest.approx(P, abs=1e-6)
    opposite = np.concatenate([-xs[2][:4], xs[2][4:]])  # the same orientation
    assert tvlqr(opposite, 2 * 0.02) == pytest.approx(us[2], abs=1e-12)


def tangent_differences(f, size):
    return np.column_stack([(f(d) - f(-d)) / 2e-5 for d in 1e-5 * np.eye(size)])


def test_tvlqr_refuses_arrays_that_do_not_fit(write_urdf):
    model = write_urdf()
    with pytest.raises(ShapeError, match="xs"):
        TVLQR(model, np.zeros((5, 2)), np.zeros((5, 1)), Q, R)
    with pytest.raises(ShapeError, match="us"):
        TVLQR(model, np.zeros((6, 2)), np.zeros((5, 2)), Q, R)
    with pytest.raises(InputError, match="at least one step"):
        TVLQR(model, np.zeros((1, 2)), np.zeros((0, 1)), Q, R)
    with pytest.raises(InputError, match="Qf"):
        TVLQR(model, np.zeros((6, 2)), np.zeros((5, 1)), Q, R, -Q)


# --- PD ---------------------------------------------------------------------------------------------------------------


def test_one_closed_loop_step_of_the_pendulum_under_pd_has_its_closed_form(load):
    """For u = kp e_q + kd e_w, the derivatives are A + B K with K = (-kp, -kd), and d x+ / d(kp, kd) = B (e_q, e_w)."""
    model, x, ref = load("pendulum.urdf"), np.array([0.7, -1.2]), np.array([1.0, 0.2])
    kp, kd, h, inertia = 3.0, 0.4, 0.01, 0.25
    s = 1 / (1 + h * 0.1 / inertia)
    u, by_x, by_p = differentiate_policy(PD(model, kp, kd, ref), x, 0.0, 1)
    assert u == pytest.approx([kp * 0.3 + kd * 1.4], rel=1e-14)
    d = dd.differentiate_step(model, x, u)
    B = np.array([[h * h * s / inertia], [h * s / inertia]])
    A = np.array([[1 - h * h * s * 19.62 * math.cos(0.7), h * s], [-h * s * 19.62 * math.cos(0.7), s]])
    assert d.A + d.B @ by_x == pytest.approx(A + B @ [[-kp, -kd]], rel=1e-10)
    assert d.B @ by_p == pytest.approx(B @ [[0.3, 1.4]], rel=1e-10)


def test_pd_of_a_floating_robot_reads_the_joint_behind_the_quaternion():
    """The joint has position 7 and velocity 6, which are entries 7 and 14 of the 15 coordinates of x."""
    x = np.arange(15.0)
    assert PD(floating_arm(), 3.0, 0.5)(x, 0.0) == pytest.approx([-3.0 * 7 - 0.5 * 14], rel=1e-14)


def test_pd_refuses_gains_and_references_that_do_not_fit(load):
    model = load("pendulum.urdf")
    for bad in ({"kp": [1.0, 2.0]}, {"kd": [[1.0]]}, {"x_ref": [0.0]}):
        with pytest.raises(ShapeError):
            PD(model, **{"kp": 1.0, "kd": 1.0} | bad)
    with pytest.raises(NonFiniteError):
        PD(model, float("nan"), 1.0)
    with pytest.raises(InputError, match="actuators"):
        PD(load("projectile.sdf"), 1.0, 1.0)


# --- gradients through the closed loop --------------------------------------------------------------------------------


def pendulum_gains(model):
    us = 2.0 * np.ones((10, 1))
    return TVLQR(model, dd.rollout(model, [0.0, 0.0], us).xs, us, Q, R)


def random_network(model):
    return ParametricPolicy(network, 0.5 * np.random.default_rng(5).standard_normal(97))


@pytest.mark.solve
@each_row(
    "file, policy_of, x0, steps, parameters",
    [
        ("pendulum", lambda m: PD(m, 3.0, 0.4, [1.0, 0.0]), [0.1, 0.5], 30, ("pole.mass", "hinge.damping")),
        ("cart_pole", lambda m: LQR(m, UPRIGHT, [0.0], np.eye(4), np.eye(1)), UPRIGHT + 0.05, 30, ("cart.mass",)),
        ("pendulum", pendulum_gains, [0.3, -0.2], 10, ("pole.mass",)),
        ("cart_pole", random_network, [0.1, 0.4, -0.2, 0.3], 30, ("pole.mass",)),
        ("pendulum", lambda m: lambda x, t: [np.sin(3 * t) - 2 * x[0]], [0.3, -0.2], 20, ("pole.mass",)),
    ],
)
def test_the_gradient_through_a_policy_is_that_of_rollouts(load, file, policy_of, x0, steps, parameters):
    """The last policy has no parameters, so only the initial state and the model's parameters are checked."""
    model = load(f"{file}.urdf", time_step=0.01 if file == "pendulum" else 0.02)
    check_gradients(model, policy_of(model), x0, steps, parameters)


def test_the_gradient_by_gains_of_a_floating_robot_is_that_of_rollouts():
    model, random = floating_arm(), np.random.default_rng(6)
    x0 = tangent_space(model).plus(model.default_state, 0.3 * random.standard_normal(14))
    tvlqr = TVLQR(model, np.tile(model.default_state, (6, 1)), np.zeros((5, 1)), np.eye(14), np.eye(1))
    check_gradients(model, tvlqr, x0, 5, tolerance=1e-5)


# --- the derivative of a policy ---------------------------------------------------------------------------------------


def test_a_function_with_parameters_is_differentiated_by_both():
    policy = ParametricPolicy(lambda x, t, p: np.array([p[0] * x[0] ** 2, np.exp(p[1] * t)]), [3.0, 0.5])
    u, by_x, by_p = differentiate_policy(policy, np.array([0.2, 9.0]), 2.0, 2)
    assert u == pytest.approx([0.12, math.e])
    assert by_x == pytest.approx(np.array([[1.2, 0.0], [0.0, 0.0]]))
    assert by_p == pytest.approx(np.array([[0.04, 0.0], [0.0, 2 * math.e]]))
    assert np.array_equal(policy(np.array([0.2, 9.0]), 2.0, [1.0, 0.0]), [0.2**2, 1.0])


def into_floats(x, t):
    u = np.zeros(1)
    u[0] = x[0]
    return u


@each_row(
    "policy",
    [
        lambda x, t: [float(x[0])],
        lambda x, t: [math.tanh(x[0])],
        lambda x, t: np.asarray(x[:1], dtype=float),
        lambda x, t: np.expm1(x[:1]),
        lambda x, t: np.hypot(x[:1], 1.0),
        lambda x, t: np.interp(x[:1], [0, 1], [0, 1]),
        lambda x, t: [x[0].value() if hasattr(x[0], "value") else x[0]],
        into_floats,
        ParametricPolicy(lambda x, t, p: [getattr(p[0], "value", lambda: p[0])()], [1.0]),
    ],
)
def test_lost_derivatives_are_refused(policy):
    with pytest.raises(GradientError, match="lost its derivatives"):
        differentiate_policy(policy, np.array([0.3, 0.4]), 0.0, 1)


RANDOM = np.random.default_rng(7)


@each_row(
    "policy, error, message",
    [
        (lambda x, t: x[:1] + RANDOM.standard_normal(1), GradientError, "without random numbers"),
        (lambda x, t: np.sqrt(x[:1]), GradientError, "not finite"),
        (lambda x, t: -x, ShapeError, r"^policy <lambda> .*: expected shape \(1,\)"),
        (lambda x, t: x[0], ShapeError, r"^policy <lambda> .*: expected shape \(1,\)"),
        (lambda x, t: x[:1].reshape(1, 1), ShapeError, r"^policy <lambda> .*: expected shape \(1,\)"),
        (lambda x, t: [np.nan], NonFiniteError, "policy"),
    ],
)
def test_what_is_no_policy_is_refused(policy, error, message):
    with pytest.raises(error, match=message):
        differentiate_policy(policy, np.zeros(2), 0.0, 1)


def test_parameters_must_be_a_flat_vector_of_numbers():
    with pytest.raises(ShapeError):
        ParametricPolicy(network, np.zeros((2, 3)))
    with pytest.raises(NonFiniteError):
        ParametricPolicy(network, [1.0, np.inf])
    parameters = np.ones(3)
    policy = ParametricPolicy(network, parameters)
    parameters[0] = 5.0  # the policy has a copy
    assert np.array_equal(policy_parameters(policy), np.ones(3))


def test_a_policy_cannot_change_the_state_it_is_given():
    def meddling(x, t):
        u = -x[:1]
        x[0] = 7.0
        return u

    x = np.array([0.3, 0.4])
    assert np.array_equal(differentiate_policy(meddling, x, 0.0, 1)[1], [[-1.0, 0.0]])
    assert x[0] == 0.3


@pytest.mark.solve
def test_a_long_tvlqr_is_differentiated_by_the_gains_that_act(write_urdf):
    """With 5000 steps, only two of the 10000 parameters carry derivatives at a time."""
    model, count = write_urdf(), 5000
    xs, us = np.zeros((count + 1, 2)), np.zeros((count, 1))
    tvlqr = TVLQR(model, xs, us, Q, R)
    _, by_x, by_p = differentiate_policy(ParametricPolicy(tvlqr, tvlqr.parameters), np.array([1.0, 2.0]), 400.0, 1)
    assert by_x == pytest.approx(-tvlqr.gains[4000], rel=1e-14)
    assert np.array_equal(np.flatnonzero(by_p), [8000, 8001])
    assert np.array_equal(by_p[0, 8000:8002], [-1.0, -2.0])


@each_row("u", [0.0, 1e-3, 1e4])
def test_another_value_is_told_from_rounding_at_every_size_of_the_input(u):
    """The tolerance is 1e-9 times the larger of 1 and the input. Rounding of a sum in another order is far below."""
    allowed = 1e-9 * max(1.0, u)
    _check(InitializeAutoDiff([u + 0.5 * allowed]), np.zeros((1, 1)), np.array([u]))
    with pytest.raises(GradientError, match="with floats at the same x and t"):
        _check(InitializeAutoDiff([u + 2 * allowed]), np.zeros((1, 1)), np.array([u]))

"""Linearizations of many steps in one call equal closed forms and AutoDiffXd, or name the method used instead."""

import warnings
from dataclasses import replace
from importlib.metadata import files
from itertools import islice

import numpy as np
import pytest
from helpers.engines import ROBOTS, G, free_state
from helpers.models import MODELS, random_state, robot, robot_file
from helpers.plants import POINT, floating, in_the_air, limited_pendulum, springs_and_motors
from helpers.robots import ROBOTS as ROBOTS_STAND
from helpers.robots import example_robot, state_in_contact, state_in_range
from helpers.table import each_row
from pydrake.multibody.tree import RpyFloatingJoint

import drake_diff as dd
from drake_diff._base.values import Refusal
from drake_diff.derivatives import analytic
from drake_diff.derivatives.analytic import analytic_of, build_analytic, certified
from drake_diff.derivatives.joint_impulses import NEAR_RIGID
from drake_diff.derivatives.refine_step import refine_steps
from drake_diff.derivatives.smooth_step import SmoothStep
from drake_diff.exceptions import GradientError, InputError, ModelError, ModelWarning, SimulationError, UnknownNameError
from drake_diff.mechanics.tree import ForwardDynamics
from drake_diff.model.inputs import BodyForce
from drake_diff.model.parameters import applied, select

pytestmark = pytest.mark.solve

NAMES = sorted(path.name for path in MODELS.iterdir())
SAME = 1e-9  # relative to the largest entry, as in the gate: rounding of two orders of operations


def equal(model, xs, us, method="auto", expected=("analytic",), **known):
    """Return the result of `linearize`, and check each step against AutoDiffXd."""
    A, B, methods = dd.linearize(model, xs, us, method, **known)
    assert A.shape == (len(us), model.nx, model.nx)
    assert B.shape == (len(us), model.nx, model.nu)
    for k, u in enumerate(us):
        d = dd.differentiate_step(model, xs[k], u, method="autodiff")
        ours, theirs = np.hstack([A[k], B[k]]), np.hstack([d.A, d.B])
        assert np.abs(ours - theirs).max() <= SAME * np.abs(theirs).max(), k
    assert set(methods) == set(expected)
    return A, B, methods


# ---- closed forms --------------------------------------------------------------------------------------------------


def test_the_damped_pendulum(load):
    """The motion is theta'' = (u - m g l sin theta - d theta') / (m l^2), with implicit damping, at three states."""
    theta, h, gl = np.array([0.7, -2.0, 3.0]), 0.01, G / 0.5
    s, c = 1 / (1 + h * 0.1 / 0.25), np.cos(theta)
    xs = np.column_stack([theta, [-1.2, 0.0, 2.0]])
    A, B, methods = dd.linearize(load("pendulum.urdf"), xs, [[0.3], [0.0], [-0.1]])
    one = np.ones(3)
    expected = np.array([[1 - h * h * s * gl * c, h * s * one], [-h * s * gl * c, s * one]]).transpose(2, 0, 1)
    np.testing.assert_allclose(A, expected, rtol=1e-12)  # numbers of the URDF, 12 digits as Drake reads them
    np.testing.assert_allclose(B[:, :, 0], np.outer(one, [h * h * s / 0.25, h * s / 0.25]), rtol=1e-12)
    assert methods == ("analytic",) * 3


def test_a_thrown_body(load):
    """Over N = 100 steps, the derivative of the position with respect to the velocity is N h."""
    model, x = load("projectile.sdf"), np.array([1.0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 2, 1, 5])
    xs = dd.rollout(model, x, num_steps=100).xs
    A, B, methods = dd.linearize(model, xs, np.zeros((100, 0)))
    np.testing.assert_allclose(np.linalg.multi_dot(A[::-1])[4:7, 10:13], np.eye(3), atol=1e-12)
    assert B.shape == (100, 13, 0)
    assert set(methods) == {"analytic"}


# ---- AutoDiffXd ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@each_row("name", NAMES)
def test_every_model_of_this_repository(load, name):
    model, random = load(name), np.random.default_rng(5)
    xs = np.array([in_the_air(model, random_state(model, random, 0.7)) for _ in range(4)])
    us = random.standard_normal((4, model.nu))
    free = equal(model, xs, us)
    known = np.array([dd.step(model, x, u) for x, u in zip(xs, us, strict=True)])
    assert all(np.array_equal(a, b) for a, b in zip(free, equal(model, xs, us, x_next=known), strict=True))


@each_row("name", ROBOTS)
def test_real_robots(tmp_path, name):
    model, random = robot(name, tmp_path), np.random.default_rng(5)
    xs = np.array([free_state(model, random) for _ in range(3)])
    equal(model, xs, 0.3 * random.standard_normal((3, model.nu)))


@each_row("name", ["ur5_robot.urdf", "panda.urdf", "xarm7.urdf", "finger_edu.urdf"])
def test_a_single_smooth_step_of_a_fixed_robot(name, monkeypatch):
    """The derivative equals AutoDiffXd's without the batched code. Its arrays are read-only, and x_next is Drake's."""
    model, random = example_robot(name, 0.005), np.random.default_rng(5)
    analytic_of(model)
    monkeypatch.setattr(SmoothStep, "__call__", None)
    for _ in range(3):
        x, u = free_state(model, random), 0.3 * random.standard_normal(model.nu)
        d, other = (dd.differentiate_step(model, x, u, method=by) for by in ("auto", "autodiff"))
        assert (d.method, other.method, d.C.shape) == ("analytic", "autodiff", (model.nx, 0))
        for mine, its in ((d.A, other.A), (d.B, other.B)):
            np.testing.assert_allclose(mine, its, rtol=0, atol=1e-9 * np.abs(other.A).max())
            assert not mine.flags.writeable
        assert np.array_equal(d.x_next, dd.step(model, x, u))
        assert not d.x_next.flags.writeable


def test_one_smooth_step_is_known_only_where_it_leads_where_it_is_said_to():
    model = springs_and_motors(limit=3.0)
    smooth, (x, u) = analytic_of(model), (np.array(POINT[0]), np.array([0.4, -0.3, 2.0]))
    x_next = dd.step(model, x, u)
    A, B, _ = equal(model, x[None], u[None])
    np.testing.assert_allclose(smooth.single(x, u, x_next), np.hstack([A[0], B[0]]), rtol=0, atol=1e-12)
    for i in range(model.nx):
        assert smooth.single(x, u, x_next + 1e-8 * np.eye(model.nx)[i]) is None
    assert smooth.single(x, u, x_next * np.nan) is None
    assert smooth.single(x, np.array([0.4, 3.1, 2.0]), dd.step(model, x, [0.4, 3.1, 2.0])) is None  # clipped
    free = floating(None, 0)
    x = random_state(free, np.random.default_rng(0))
    assert analytic_of(free).single(x, np.zeros(1), dd.step(free, x, [0.0])) is None  # a free body


@pytest.mark.parametrize("seed", range(3))
def test_a_free_body_with_a_sprung_arm_turned_by_a_quaternion_of_any_norm(seed):
    model, random = floating(None, seed), np.random.default_rng(seed)
    x = random_state(model, random)
    x[:4] *= 1.1
    equal(model, x[None], random.standard_normal((1, 1)))
    x_next, d = dd.step(model, x, [0.2]), dd.differentiate_step(model, x, [0.2], method="analytic")
    assert d.method == "analytic"
    assert np.array_equal(d.x_next, x_next)  # from Drake's step
    by_differences = dd.differentiate_step(model, x, [0.2], method="finite_difference")
    np.testing.assert_allclose(d.A, by_differences.A, atol=1e-7)  # central differences with step 1e-5


@each_row("kp", [(0.0, 0.0, 0.0), (20.0, 5.0, 8.0), (0.0, 30.0, 0.0), (3000.0, 900.0, 400.0)])
def test_springs_damping_gears_and_pd_control(kp):
    model = springs_and_motors(kp=kp, gear=-12.0)
    equal(model, np.array([POINT[0], np.zeros(6)]), np.array([POINT[1], [1.0, 2.0, 3.0]]))


def test_inputs_at_their_effort_limits_have_no_effect():
    model = springs_and_motors(limit=3.0)
    _, B, _ = equal(model, np.array([POINT[0]] * 2), np.array([[30.0, -0.3, -0.2], [0.4, 3.1, -9.0]]))
    assert not B[0, :, 0].any()
    assert not B[1, :, 1:].any()
    assert np.all(np.abs(B[0, :, 1:]).max(axis=0) > 0)


ROTORS = [BodyForce(f"rotor_{i}", "body", p, moment_ratio=0.02 * (-1) ** i) for i, p in enumerate(np.eye(3))]
JETS = [
    BodyForce("jet", "upper", (0.1, -0.2, 0.3), (1, 2, -2), moment_ratio=0.7),
    BodyForce("fan", "lower", (0, 0.1, 0), (0, 0, -3), moment_ratio=-0.2),
]
FLYING = {"quadrotor.urdf": ROTORS, "double_pendulum.urdf": JETS, "sphere_on_ground.sdf": [BodyForce("up", "ball")]}


def test_a_hovering_bodys_thrust_has_its_closed_form():
    """A thrust f along the body's z axis, turned by a small angle about y, accelerates the body by f / m along x."""
    model = dd.load_model(MODELS / "quadrotor.urdf", time_step=0.01, body_forces=[BodyForce("lift", "body")])
    mass, x = float(model.plant.CalcTotalMass(model.double.context)), model.default_state
    A, B, _ = equal(model, x[None], [[mass * G]])
    assert A[0, 10, 2] == pytest.approx(0.01 * 2 * G, rel=1e-9)  # d vx / d qy, as the angle is 2 qy
    assert B[0, 12, 0] == pytest.approx(0.01 / mass, rel=1e-9)


@each_row("name", list(FLYING))
def test_steps_under_body_forces_are_linearized_at_once(name):
    model, random = dd.load_model(MODELS / name, time_step=0.01, body_forces=FLYING[name]), np.random.default_rng(3)
    xs = np.array([random_state(model, random) for _ in range(4)])
    if name.startswith("sphere"):
        xs[:, 6] = 3.0  # above the ground
    us = random.uniform(-20, 20, (4, model.nu))
    equal(model, xs, us)
    equal(model, xs[:1], us[:1], method="implicit", expected=("implicit",))


def test_a_body_force_in_contact_or_at_a_joint_limit_is_left_to_autodiff():
    """No force acts in the first steps, so that a comparison with AutoDiffXd at these steps alone finds no error."""
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.01, body_forces=FLYING["sphere_on_ground.sdf"])
    x = model.default_state
    x[6] = 0.0999
    equal(model, np.array([x] * 6), np.array([[0.0]] * 4 + [[5.0]] * 2), expected=("autodiff",))


@pytest.mark.parametrize("which", [0, 1])
def test_a_body_force_with_a_wrong_column_or_slope_is_caught(which):
    model = dd.load_model(MODELS / "quadrotor.urdf", time_step=0.01, body_forces=ROTORS)
    analytic = build_analytic(model)

    def doctored(q):
        found = analytic.body_forces(q)
        found[which] = found[which] * (1 + 1e-6)
        return found

    assert certified(model, analytic) is analytic
    assert isinstance(certified(model, replace(analytic, body_forces=doctored)), Refusal)


# ---- steps that are not smooth, and the methods used for them --------------------------------------------------------


def _a_fall(load, **options):
    model = load("sphere_on_ground.sdf", time_step=0.005, **options)
    x = model.default_state
    x[6] = 0.12
    motion = dd.rollout(model, x, num_steps=30)
    return model, motion.xs, [bool(contacts) for contacts in motion.contacts]


@pytest.mark.parametrize("approximation", ["sap", "similar", "lagged"])
def test_steps_with_contact_are_taken_in_the_same_call(load, approximation):
    model, xs, touches = _a_fall(load, contact_approximation=approximation)
    assert 0 < sum(touches) < 30
    equal(model, xs, np.zeros((30, 0)))
    equal(model, xs, np.zeros((30, 0)), x_next=xs[1:])  # without Drake's steps


def test_steps_with_other_contact_are_taken_by_others_and_named(load):
    model, xs, touches = _a_fall(load, contact_model="hydroelastic_with_fallback")
    us = np.zeros((30, 0))
    _, _, methods = equal(model, xs, us, expected=("analytic", "autodiff"))
    assert [m != "analytic" for m in methods] == touches
    assert equal(model, xs, us, expected=set(methods), x_next=xs[1:])[2] == methods  # without Drake's steps
    assert dd.differentiate_step(model, xs[0], method="analytic").reason == "asked for"
    with pytest.raises(GradientError, match="the contact model is hydroelastic_with_fallback, not point"):
        dd.differentiate_step(model, xs[-1], method="analytic")


def test_a_joint_limit_that_acts_is_in_the_derivative():
    model = limited_pendulum()
    xs, us = np.array([[0.3, 0.2], [0.999, 2.0]]), np.array([[0.1], [0.1]])
    A, _, _ = equal(model, xs, us)
    assert A[1, 1, 1] < 0.1 < A[0, 1, 1]
    free = np.array([dd.step(model, xs[0], us[0]), xs[1] + 0.01])  # the second is not the end of the step
    equal(model, xs, us, x_next=free)


def test_a_limits_impulse_has_its_closed_form():
    """At a distance d from a limit, v' = (v* + v_hat / b) / (1 + 1 / b) for one joint, with v_hat = d / 2h."""
    model, x, h = limited_pendulum(), np.array([0.999, 2.0]), 0.01
    A, B, (method,) = dd.linearize(model, x[None], np.array([[0.1]]))
    free = dd.linearize(model, np.array([[0.3, 2.0]]), np.array([[0.1]]))
    assert method == "analytic"
    stiff = 1 / NEAR_RIGID
    by_q = np.cos(x[0]) / np.cos(0.3) * free[0][0, 1, 0] - stiff / (2 * h)
    np.testing.assert_allclose(A[0, 1], [by_q / (1 + stiff), free[0][0, 1, 1] / (1 + stiff)], rtol=1e-9)
    np.testing.assert_allclose(B[0, 1], free[1][0, 1] / (1 + stiff), rtol=1e-9)


def test_a_controller_at_its_limit_is_no_smooth_step():
    """PD control with gains that keep the joints near their references, and inputs below and above 30 N or 30 N m."""
    model = springs_and_motors(limit=30.0, kp=(20.0, 5.0, 8.0))
    xs, us = np.array([POINT[0]] * 2), np.array([POINT[1], [0.4, 900.0, -900.0]])
    _, _, methods = equal(model, xs, us, expected=("analytic", "implicit"))
    assert methods[0] == "analytic"
    hardly_ever_free = springs_and_motors(limit=1e-3, kp=(20.0, 5.0, 8.0))
    assert "controllers reach their limits at all but 0" in analytic_of(hardly_ever_free).reason


def test_x_next_that_is_wrong_is_found(load):
    model = load("double_pendulum.urdf")
    xs, us = np.array([[0.4, -0.9, 1.3, -0.6]]), np.array([[0.25, -0.15]])
    wrong = dd.step(model, xs[0], us[0])[None] + [[0, 0, 1e-8, 0]]
    _, _, methods = equal(model, xs, us, x_next=wrong, expected=("analytic",))  # derivatives of the step itself
    assert methods == ("analytic",)


# ---- the gate ------------------------------------------------------------------------------------------------------


def test_a_doctored_inertia_is_caught(load):
    model = load("acrobot.xml")
    analytic = build_analytic(model)
    assert certified(model, analytic) is analytic
    tables = analytic.dynamics.tree.tables
    wrong = replace(analytic.dynamics.tree, tables=tables._replace(mass=tables.mass * (1 + 1e-6)))
    doctored = replace(analytic, dynamics=replace(analytic.dynamics, tree=wrong))
    assert "of the forces in Drake's equation" in certified(model, doctored).reason


@pytest.mark.parametrize("part", [0, 1, 2])
def test_a_derivative_that_is_not_its_steps_is_caught(load, part):
    """The parts are the derivatives with respect to q, v and the forces."""
    model = load("acrobot.xml")
    analytic = build_analytic(model)

    class Doctored(ForwardDynamics):
        def accelerate(self, q, v, force):
            found = super().accelerate(q, v, force)
            found[part][:, 0, 1] += 1e-6
            return found

    doctored = replace(analytic, dynamics=Doctored(analytic.dynamics.tree, analytic.dynamics.armature))
    assert "its Jacobian differs from AutoDiffXd's" in certified(model, doctored).reason


def test_other_parameters_are_never_answered_by_the_models_own(load):
    """Pinocchio's model is built from the defaults."""
    model, x, u = load("double_pendulum.urdf"), np.array([0.4, -0.9, 1.3, -0.6]), np.array([0.25, -0.15])
    own = dd.differentiate_step(model, x, u)
    assert own.method == "analytic"
    name = next(p.name for p in dd.list_parameters(model) if p.name.endswith(".mass"))
    vector = select(model, {name: 2 * next(p.value for p in dd.list_parameters(model) if p.name == name)})
    with applied(vector) as heavier:
        assert isinstance(analytic_of(heavier), Refusal)
        A, _, methods = dd.linearize(heavier, x[None], u[None])
        exact = dd.differentiate_step(model, x, u, parameters=vector.to_dict(), method="autodiff")
    assert "analytic" not in methods
    assert np.abs(A[0] - exact.A).max() <= SAME * np.abs(exact.A).max()
    assert np.abs(A[0] - own.A).max() > 1e-4
    assert dd.differentiate_step(model, x, u).method == "analytic"


def test_derivatives_by_parameters_keep_their_source(load):
    d = dd.differentiate_step(load("pendulum.urdf"), [0.7, -1.2], [0.3], parameters=("hinge.damping",))
    assert d.method in ("implicit", "autodiff")
    assert "not analytic: derivatives with respect to parameters other than those of contact are requested" in d.reason
    assert d.C.shape == (2, 1)


def test_a_model_that_pinocchio_is_not_given_says_why():
    model = floating(RpyFloatingJoint, 0)
    assert "joint free is of type rpy_floating" in analytic_of(model).reason
    d = dd.differentiate_step(model, np.full(model.nx, 0.1), [0.3])
    assert d.method in ("implicit", "autodiff")
    assert "not analytic: " in d.reason
    locked = springs_and_motors()
    for twin in (locked.double, locked.autodiff):
        twin.plant.GetJointByName("hinge1").Lock(twin.context)
    assert analytic_of(locked) == Refusal("a joint is locked")


def example_robots():
    """Yield the robots of example-robot-data that Drake reads and steps, each with a state within limits and inputs."""
    random = np.random.default_rng(0)
    for file in sorted(str(f) for f in files("example-robot-data") if str(f).endswith((".urdf", ".sdf"))):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ModelWarning)
                model = dd.load_model(robot_file(file.rsplit("/", 1)[1]), time_step=0.002)
            x = state_in_range(model, random)
            dd.step(model, x, np.zeros(model.nu))
        except (ModelError, SimulationError):
            continue
        yield model, x, random.standard_normal(model.nu)


def same_where_autodiff_works(model, x, u):
    """Check `auto` against AutoDiffXd or, if AutoDiffXd fails, its reason. Return whether AutoDiffXd works."""
    found = dd.differentiate_step(model, x, u)
    try:
        exact = dd.differentiate_step(model, x, u, method="autodiff")
    except (ModelError, SimulationError):
        assert found.method == "analytic" or "not " in found.reason
        return False
    for ours, theirs in ((found.A, exact.A), (found.B, exact.B)):
        # Some of these robots have masses of 1e-6 kg and of 10 kg, which magnify rounding.
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8 * np.abs(exact.A).max(), err_msg=model.name)
    return True


@each_row("name", ["icub.urdf", "icub_reduced.urdf"])
def test_an_inertia_that_no_body_has_is_taken_as_drake_takes_it(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        model = dd.load_model(robot_file(name), time_step=0.002)
    x = state_in_range(model, np.random.default_rng(0))
    assert same_where_autodiff_works(model, x, np.zeros(0))
    equal(model, x[None], np.zeros((1, 0)))


@pytest.mark.slow
def test_auto_serves_wherever_autodiff_does_and_every_step_is_had_to_rounding():
    served = []
    for model, x, u in islice(example_robots(), 0, None, 3):
        served.append(same_where_autodiff_works(model, x, u))
        solved = refine_steps(model, select(model, ()), x[None], u[None])
        assert not solved.refused, f"{model.name}: {solved.refused}"
    assert served.count(True) >= 10


@each_row("name", ["solo12.urdf", "go2.urdf", "bolt.urdf"])
def test_floating_robots_are_autodiffs(name):
    """In flight, in contact and at joint limits, the derivatives equal AutoDiffXd's. A wrong inertia is detected."""
    model, random = example_robot(name, 0.01, feet=True), np.random.default_rng(4)
    xs = np.array([state_in_contact(model, random), state_in_range(model, random)])
    xs[1, :4] *= 1.1  # not of unit norm
    xs[1, model.nq - 1] = model.position_limits[0][-1] + 1e-3
    equal(model, xs, 0.1 * random.standard_normal((2, model.nu)))
    smooth = analytic_of(model)
    tables = smooth.dynamics.tree.tables
    wrong = replace(smooth.dynamics.tree, tables=tables._replace(inertia=1.001 * tables.inertia))
    doctored = replace(smooth, dynamics=replace(smooth.dynamics, tree=wrong))
    assert "of the forces in Drake's equation" in certified(model, doctored).reason


@each_row(
    "xs, us, wanted",
    [
        (np.zeros((4, 2)), np.zeros((2, 1)), r"xs: expected shape \(2 or 3, 2\)"),
        (np.zeros((2, 3)), np.zeros((2, 1)), r"xs: expected shape \(N, 2\)"),
        (np.full((2, 2), np.nan), np.zeros((2, 1)), "a finite number"),
        (np.zeros((2, 2)), np.zeros((2, 2)), r"us: expected shape \(N, 1\)"),
    ],
)
def test_bad_input_is_named(load, xs, us, wanted):
    with pytest.raises(InputError, match=wanted):
        dd.linearize(load("pendulum.urdf"), xs, us)
    with pytest.raises(UnknownNameError, match="analytic"):
        dd.linearize(load("pendulum.urdf"), np.zeros((2, 2)), np.zeros((2, 1)), "guess")


# ---- joint limits and couplers --------------------------------------------------------------------------------------


@each_row("name", ["solo12.urdf", "go2.urdf", "ur5_robot.urdf", "bolt.urdf"])
@pytest.mark.parametrize("time_step", [0.005, 0.02, 0.05])
def test_robots_at_their_limits_are_linearized_at_once(name, time_step):
    """Three joints are at or beyond their limits. Robots with feet also stand on the ground."""
    model, random = example_robot(name, time_step, feet=ROBOTS_STAND[name]), np.random.default_rng(3)
    lower, upper = model.position_limits
    limited = np.flatnonzero(np.isfinite(lower) & np.isfinite(upper))
    for _ in range(3):
        x = state_in_contact(model, random) if ROBOTS_STAND[name] else state_in_range(model, random)
        for k in random.choice(limited, 3):
            x[k] = random.choice([lower[k] - 1e-3, lower[k] + 2e-3, upper[k] + 1e-3, upper[k] - 2e-3])
        us = random.uniform(-0.1, 0.1, (1, model.nu))
        equal(model, x[None], us)
        by_differences = dd.differentiate_step(model, x, us[0], method="finite_difference").A
        A, _, _ = dd.linearize(model, x[None], us)
        assert np.abs(A[0] - by_differences).max() <= 1e-6 * np.abs(A[0]).max()  # differences over 3e-7


def test_joints_that_are_coupled_are_linearized_at_once():
    """A coupler constraint makes the second finger of a Panda follow the first, far from its limit and close to it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        model = dd.load_model(robot_file("panda.urdf"), time_step=0.01, base="weld", actuators="all", contact=False)
    random = np.random.default_rng(2)
    assert model.num_constraints == 1
    for finger in (0.03, 1e-4):
        x = np.concatenate([state_in_range(model, random)[:7], [finger, finger], 0.1 * random.standard_normal(9)])
        equal(model, x[None], 0.1 * random.standard_normal((1, model.nu)))


def test_a_wrong_derivative_at_a_limit_is_refused_on_the_model(monkeypatch):
    right = analytic.contact_jacobians

    def wrong(*arguments):
        jacobians, *rest = right(*arguments)
        return 1.001 * jacobians, *rest

    monkeypatch.setattr(analytic, "contact_jacobians", wrong)
    model = limited_pendulum()
    found = dd.differentiate_step(model, [0.999, 2.0], [0.1])
    assert found.method == "autodiff"
    assert "its Jacobian with impulses differs from AutoDiffXd's" in found.reason
    with pytest.raises(GradientError, match="its Jacobian with impulses differs from AutoDiffXd's"):
        dd.differentiate_step(model, [0.999, 2.0], [0.1], method="analytic")

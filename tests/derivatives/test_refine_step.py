"""Steps solved to rounding agree with closed forms and AutoDiffXd. Equations other than Drake's are refused."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.models import Plant, add_slide, contact_properties, robot_file
from helpers.plants import block, constrained, limited_pendulum, pair, springs_and_motors
from helpers.robots import FOOT, ROBOTS, example_robot, state_in_contact
from helpers.table import each_row
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex, PdControllerGains, SpatialInertia
from scipy.optimize import bisect

import drake_diff as dd
from drake_diff._base.values import Refusal
from drake_diff.derivatives import joint_impulses, sources
from drake_diff.derivatives import refine_step as refining
from drake_diff.derivatives.contact import laws
from drake_diff.derivatives.joint_impulses import couplers_of
from drake_diff.derivatives.refine_step import refine_steps
from drake_diff.exceptions import GradientError
from drake_diff.model import contact_modes
from drake_diff.model.parameters import applied, select

H = 0.005
NEAR_RIGID = 0.01 / (4 * np.pi**2)  # Drake's near-rigid constant for limits, controllers and couplers


def refined(model, x, u=(), parameters=()):
    found = refine_steps(model, select(model, parameters), *(np.array([row], dtype=float) for row in (x, u)))
    assert not found.refused, found.refused
    return found.x_next[0]


def why_not(model, x, u=()):
    found = refine_steps(model, select(model, ()), *(np.array([row], dtype=float) for row in (x, u)))
    return str(found.refused[0])


def slope(f, at, step):
    """Return the central difference of a function of one number."""
    return (f(at + step) - f(at - step)) / (2 * step)


def ball(approximation="lagged", *, stiffness=1e6, time_step=H, axes="xz", pushed=False, **material):
    """Build a ball of 1 kg and 0.1 m on slides over ground of the same material. `stiffness` is that of the pair."""
    made, time = Plant(time_step, approximation), material.get("relaxation_time")
    properties = contact_properties(2 * stiffness, material.get("dissipation", 0.0), 0.5, time)
    made.ball("ball", 1.0, 0.1, properties, *axes)
    if pushed:
        made.plant.AddJointActuator("push", made.plant.GetJointByName("ball_x"))
    made.ground(properties)
    return made.model()


# ---- closed forms ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("approximation", ["lagged", "similar"])
@each_row("overlap, speed", [(3e-3, -0.2), (3e-3, 0.4), (5e-4, -1.0)])
def test_a_ball_that_presses_on_the_ground(approximation, overlap, speed):
    """A spring that is implicit in v' gives v' = (v - g h + h k x / m) / (1 + h^2 k / m) and its slopes."""
    model, k = ball(approximation, stiffness=5e3, axes="z"), 5e3

    def end(z, v):
        return refined(model, [z, v])[1]

    exact = (speed - 9.81 * H + H * k * overlap) / (1 + H * H * k)
    z = 0.1 - overlap
    assert end(z, speed) == pytest.approx(exact, rel=1e-13)
    # Differences over 1e-5 m and m/s have an error of rounding / 1e-5. Within them the step is linear.
    assert slope(lambda v: end(z, v), speed, 1e-5) == pytest.approx(1 / (1 + H * H * k), abs=1e-10)
    assert slope(lambda z: end(z, speed), z, 1e-5) == pytest.approx(-H * k / (1 + H * H * k), abs=1e-9)


def test_a_compliant_ball_of_sap():
    """v' = (v - g h + v_hat / (m R)) / (1 + 1 / (m R)) with R = 1 / (h k (h + tau)) and v_hat = x / (h + tau)."""
    made, properties = Plant(H, "sap"), contact_properties(1e4, 0.0, 0.5, 0.01)
    made.plant.set_sap_near_rigid_threshold(0.0)
    made.ball("ball", 1.0, 0.1, properties, "z")
    made.ground(properties)
    model, k, soft = made.model(), 5e3, H + 0.02
    R = 1 / (H * k * soft)
    exact = (-0.2 - 9.81 * H + 3e-3 / soft / R) / (1 + 1 / R)
    assert refined(model, [0.097, -0.2])[1] == pytest.approx(exact, rel=1e-13)


@each_row("v0, push", [(1.0, 0.0), (0.0, 4.9), (0.0, 6.0), (1e-4, 2.0)])
def test_a_ball_that_slides_or_creeps(v0, push):
    """Lagged friction gives v' = v0 + h u / m - mu g h v' / sqrt(v'^2 + e^2), at a stiffness of 1e6 N/m."""
    model = ball(stiffness=1e6, pushed=True)

    def state(v):
        return [0.0, 0.1 - 9.81 / 1e6, v, 0.0]

    e, mu, g, h = 1e-4, 0.5, 9.81, H
    w = bisect(lambda v: v - v0 - h * push + mu * g * h * v / np.hypot(v, e), -1.0, 2.0, xtol=1e-16)
    stiff = 1 + mu * g * h * e * e / np.hypot(w, e) ** 3
    assert refined(model, state(v0), [push])[2] == pytest.approx(w, rel=1e-10, abs=1e-13)
    step = 1e-7
    by_v, by_u = (
        slope(lambda v: refined(model, state(v), [push])[2], v0, step),
        slope(lambda u: refined(model, state(v0), [u])[2], push, step),
    )
    # Rounding / step is 1e-9 at most. The curvature of friction over 1e-7 m/s, relative to e, adds a fraction of 1e-6.
    assert by_v == pytest.approx(1 / stiff, rel=2e-6, abs=3e-9)
    assert by_u == pytest.approx(h / stiff, rel=2e-6, abs=3e-9)


def test_a_push_that_drakes_solver_does_not_notice():
    """A resting ball creeps by h u / (m D) with D = 1 + mu g h / e. A force of 5e-6 N is less than 1e-6 of m g."""
    h = 1e-3
    model, x = ball(stiffness=1e6, time_step=h, pushed=True), [0.0, 0.1 - 9.81e-6, 0.0, 0.0]
    exact = h / (1 + 0.5 * 9.81 * h / 1e-4)
    assert slope(lambda u: dd.step(model, x, [u])[2], 0.0, 5e-6) == 0.0
    assert slope(lambda u: refined(model, x, [u])[2], 0.0, 5e-6) == pytest.approx(exact, rel=1e-9)
    d = dd.differentiate_step(model, x, [0.0], method="finite_difference")
    assert d.reason == "asked for; of the step solved to rounding"
    assert d.B[2, 0] == pytest.approx(exact, abs=1e-10)  # rounding of 1e-17 / 3e-7


def slide(*, limits=None, gains=None, effort=np.inf, damping=0.0, mass=2.0):
    made = Plant(H, gravity=0.0)
    body = made.plant.AddRigidBody("block", SpatialInertia.SolidSphereWithMass(mass, 0.1))
    joint = add_slide(made.plant, "rail", made.plant.world_frame(), body, "x")
    joint.set_default_damping_vector([damping])
    if limits is not None:
        joint.set_position_limits([limits[0]], [limits[1]])
    motor = made.plant.AddJointActuator("motor", joint, effort)
    motor.set_default_rotor_inertia(1e-3)
    motor.set_default_gear_ratio(10.0)  # a reflected inertia of 0.1 kg
    if gains is not None:
        motor.set_controller_gains(PdControllerGains(p=gains[0], d=gains[1]))
    return made.model()


@each_row(
    "q, v, u, held",
    [
        (0.99, 1.0, 0, 0),
        (0.995, 1.0, 0, 1),
        (1.001, 3.0, 40, 1),
        (-1, -0.3, 0, 1),
        (-0.9999, -0.5, -9, 1),
        (0.5, 1, 3, 0),
    ],
)
def test_a_joint_at_its_limit(q, v, u, held):
    """A (v' - v*) = g if g = (v_hat - v') / R is positive at the lower limit. The upper limit is mirrored."""
    model, A = slide(limits=(-1.0, 1.0), damping=3.0), 2.1 + 3.0 * H
    free = v + H * (u - 3.0 * v) / A
    R, exact = NEAR_RIGID / A, free
    for side, distance in ((1, q + 1.0), (-1, 1.0 - q)):
        pushed = (A * side * free - distance / (2 * H) / R) / (A + 1 / R)
        if -distance / (2 * H) > pushed:
            exact = side * pushed
    assert refined(model, [q, v], [u])[1] == pytest.approx(exact, rel=1e-13, abs=1e-15)
    assert (exact != free) == bool(held)


@each_row("gains", [(300.0, 20.0), (1e9, 1e6)])
@each_row("u", [0.0, 1e4])
def test_a_pd_controller_within_its_effort_at_its_limit_and_too_stiff_for_the_step(gains, u):
    model, A, limit = slide(gains=gains, effort=1e3), 2.1, 1e3
    q, v = 0.02, 0.3
    lowered = min(1.0, 1 / (H * (H * gains[0] + gains[1])) / (NEAR_RIGID / A))
    kp, kd = lowered * gains[0], lowered * gains[1]
    exact = (A * v + H * (u - kp * q)) / (A + H * (H * kp + kd))
    effort = u - kp * (q + H * exact) - kd * exact
    if abs(effort) > limit:
        exact = v + H * np.sign(effort) * limit / A
    assert refined(model, [q, v], [u])[1] == pytest.approx(exact, rel=1e-12)
    assert (lowered < 1) == (gains[0] == 1e9)


@each_row("u", [0.0, 3.0])
def test_two_blocks_whose_rails_are_coupled(u):
    """For q_0 = 2 q_1, A (v' - v*) = (1, -2) g with g = (-d / 2h - (v_0' - 2 v_1')) / R, R = b (1 + 4)."""
    model, h, j = block(blocks=2, couple=True), 0.1, np.array([1.0, -2.0])
    q, v = np.array([0.3, 0.05]), np.array([0.2, -0.1])
    free = v + h * np.array([u, 0.0])
    exact = free + j * (-(j @ q) / (2 * h) - j @ free) / (NEAR_RIGID * 5 + 5)
    assert refined(model, [*q, *v], [u])[2:] == pytest.approx(exact, rel=1e-12)
    found = couplers_of(model)
    np.testing.assert_allclose(found.direction, [[1, -2]], rtol=1e-12)


@pytest.mark.parametrize("time_step", [0.005, 0.05])
def test_couplers_of_light_fingers_of_a_robot_that_falls(time_step):
    """12 fingers are 1 or -1 times their leaders. The momentum of the fall is 1e7 times the fingers' impulses."""
    model = dd.load_model(robot_file("talos_full_v2.urdf"), time_step=time_step)
    found = couplers_of(model)
    assert not isinstance(found, Refusal), found
    assert found.direction.shape == (12, model.nv)
    ratios = np.sort(np.abs(found.direction), axis=1)
    np.testing.assert_allclose(ratios[:, -2:], 1.0, rtol=1e-9)
    assert not ratios[:, :-2].any()
    np.testing.assert_allclose(found.offset, 0.0, atol=1e-9)


# ---- AutoDiffXd ------------------------------------------------------------------------------------------------------


def on_four_feet(approximation, random, stiffness=1e5, **options):
    """Load Solo12 with four feet on the ground, and define random states in which it sinks, slides and turns."""
    model = example_robot("solo12.urdf", 0.002, approximation=approximation, feet=True, stiffness=stiffness, **options)
    x = model.default_state
    x[:7] = [1, 0, 0, 0, 0, 0, 0]
    x[7 : model.nq] = np.tile([0.0, 0.7, -1.4], 4)
    plant = model.plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, x[: model.nq])
    feet = [i for i in range(1, plant.num_bodies()) if "FOOT" in plant.get_body(BodyIndex(i)).name()]
    height = min(plant.EvalBodyPoseInWorld(context, plant.get_body(BodyIndex(i))).translation()[2] for i in feet)
    x[6] = FOOT - height - 1e-3

    def state():
        moved = x + 1e-3 * np.r_[np.zeros(7), random.standard_normal(12), np.zeros(18)]
        moved[model.nq :] = 0.1 * random.standard_normal(18)
        return moved

    return model, state


@pytest.mark.solve
@pytest.mark.parametrize("approximation", ["lagged", "similar", "sap"])
def test_the_differences_on_four_feet_are_autodiffs(approximation):
    random = np.random.default_rng(3)
    model, state = on_four_feet(approximation, random)
    x, u = state(), random.standard_normal(12)
    exact = dd.differentiate_step(model, x, u, method="autodiff")
    touching = sum(mode != "separated" for mode in contact_modes(model, x, u).values())
    assert touching == 4
    step, columns = 1e-7, [8, 12, 19, 21, 22, 24, 30]
    ends = np.array([x + side * step * np.eye(model.nx)[j] for j in columns for side in (1, -1)])
    found = refine_steps(model, select(model, ()), ends, np.tile(u, (len(ends), 1)))
    assert not found.refused
    ours = ((found.x_next[::2] - found.x_next[1::2]) / (2 * step)).T
    drakes = ((found.drake[::2] - found.drake[1::2]) / (2 * step)).T
    size = np.abs(exact.A[:, columns]).max(axis=0)
    errors = [(np.abs(d - exact.A[:, columns]) / size).max() for d in (ours, drakes)]
    # AutoDiffXd's derivative is taken where Drake's solver stopped, up to 1e-6 of the momentum from the solution.
    assert errors[0] < 1e-4
    assert np.all(found.left <= 1e-6)


@pytest.mark.slow
def test_a_box_in_point_contact_which_autodiff_does_not_have():
    made = Plant(H, "lagged")
    body = made.plant.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(1.3, 0.3, 0.2, 0.1))
    made.shape(body, Box(0.3, 0.2, 0.1), contact_properties(1e5, 0.3, friction=0.5))
    made.ground(contact_properties(1e5, friction=0.5))
    model = made.model()
    x = model.default_state
    x[:4] = np.array([1, 0.05, 0.03, 0.2]) / np.linalg.norm([1, 0.05, 0.03, 0.2])
    x[6], x[10:13] = 0.06, [0.5, 0.1, -0.1]
    assert np.abs(refined(model, x) - dd.step(model, x)).max() < 1e-6
    assert len(dd.rollout(model, x, num_steps=1).contacts[0]) == 1
    d = dd.differentiate_step(model, x, method="finite_difference")
    assert d.reason.endswith("of the step solved to rounding")
    found = dd.differentiate_step(model, x)
    assert found.method == "analytic"
    assert np.abs(found.A - d.A).max() <= 1e-5 * np.abs(d.A).max()  # two derivatives of a stiff step


def test_parts_of_one_body_that_overlap_take_no_part():
    """Of three overlapping spheres, two are fixed to the world. The contact between these two has no effect."""
    made, properties = Plant(H, "sap"), contact_properties(2e4, 0.0, 0.5, 0.01)
    made.ball("ball", 1.0, 0.1, properties, "z")
    post = made.plant.AddRigidBody("post", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    made.plant.WeldFrames(made.plant.world_frame(), post.body_frame(), RigidTransform([0, 0.5, 0]))
    made.shape(post, Sphere(0.1), properties)
    made.shape(made.plant.world_body(), Sphere(0.1), properties, RigidTransform([0, 0.45, 0]))
    made.ground(properties)
    model = made.model()
    assert np.abs(refined(model, [0.099, -0.1]) - dd.step(model, [0.099, -0.1])).max() < 1e-6


def test_a_link_far_lighter_than_what_carries_it():
    """The terms of the momentum are 1e6 times their sum, so that rounding is larger by the same factor."""
    made = Plant(H, "sap")
    heavy = made.plant.AddRigidBody("heavy", SpatialInertia.SolidSphereWithMass(100.0, 0.1))
    light = made.plant.AddRigidBody("light", SpatialInertia.SolidSphereWithMass(1e-6, 0.1))
    first = add_slide(made.plant, "first", made.plant.world_frame(), heavy, "x")
    second = add_slide(made.plant, "second", heavy.body_frame(), light, "x")
    for joint in (first, second):
        joint.set_position_limits([0.0], [0.0])
    model, random = made.model(), np.random.default_rng(0)
    for _ in range(20):
        x = np.r_[0.02 * random.standard_normal(2), random.standard_normal(2)]
        assert np.abs(refined(model, x) - dd.step(model, x)).max() < 1e-3


def test_differences_say_where_the_step_is_not_had_to_rounding():
    model, x = pair(Box(0.2, 0.2, 0.2), Box(1, 1, 0.2), hydroelastic=True, height=0.095)
    x[:4] = np.array([1, 0.02, 0.03, 0.1]) / np.linalg.norm([1, 0.02, 0.03, 0.1])
    d = dd.differentiate_step(model, x, method="finite_difference")
    assert d.reason == "asked for; of Drake's own step, hydroelastic contact acts"


# ---- many at once, and parameters ------------------------------------------------------------------------------------


def test_a_step_is_the_same_alone_and_among_others_and_free_steps_are_drakes():
    random = np.random.default_rng(4)
    model, state = on_four_feet("lagged", random)
    xs = np.array([state() for _ in range(6)])
    xs[2, 6] += 0.5
    us = 0.1 * random.standard_normal((6, 12))
    many = refine_steps(model, select(model, ()), xs, us)
    for k in range(6):
        assert np.array_equal(many.x_next[k], refined(model, xs[k], us[k]))
    np.testing.assert_allclose(many.x_next[2], many.drake[2], rtol=0, atol=1e-14)  # the same sum in two orders
    assert np.abs(many.x_next - many.drake).max() > 1e-10


def test_parameters_of_each_step():
    """Batched values of friction, mass and time step act as single ones. Applied parameters are restored at the end."""
    model = dd.load_model("models/sphere_on_ground.sdf", time_step=H, contact_approximation="lagged")
    x = model.default_state
    x[6], x[10:] = 0.0999, [0.3, 0.0, -0.1]
    names = ("ball.friction", "ball.mass", "model.time_step")
    vector = select(model, names)
    values = vector.values * (1 + 0.1 * np.random.default_rng(5).uniform(-1, 1, (5, 3)))
    values[:3, 2] = H
    with applied(vector) as same:
        before = refine_steps(same, vector, x[None], np.zeros((1, 0))).x_next[0]
        many = refine_steps(same, vector, np.tile(x, (5, 1)), np.zeros((5, 0)), values)
        assert np.array_equal(refine_steps(same, vector, x[None], np.zeros((1, 0))).x_next[0], before)
    assert not many.refused
    for k in range(5):
        given = dict(zip(names, values[k], strict=True))
        np.testing.assert_array_equal(many.drake[k], dd.step(model, x, parameters=given))
        np.testing.assert_allclose(many.x_next[k], many.drake[k], atol=1e-6)  # Drake's tolerance for 1 kg and 1 m/s
    assert np.abs(many.x_next - before).max(axis=1).min() > 1e-6


# ---- parity ----------------------------------------------------------------------------------------------------------


def test_parity_knows_the_solvers_tolerance_and_no_more(monkeypatch):
    """An AutoDiffXd step may differ from the double step by 1e-8 m/s (solver tolerance), not by 1e-4 m/s or in q."""
    model = ball(stiffness=1e4, dissipation=2.0)
    x, u, right = np.array([0.0, 0.0985, 1.0, -0.3]), np.zeros(0), sources.advance

    def beside(by):
        def step(twin, x, u):
            end = right(twin, x, u)
            return end + by if twin is model.autodiff else end

        monkeypatch.setattr(sources, "advance", step)
        return dd.differentiate_step(model, x, u, method="autodiff")

    exact = beside(np.zeros(4))
    v = 1e-8 * np.array([0, 0, 1.0, -0.5])
    np.testing.assert_array_equal(beside(v + np.r_[H * v[2:], 0, 0]).A, exact.A)
    for wrong in (1e4 * (v + np.r_[H * v[2:], 0, 0]), v + np.array([1e-7, 0, 0, 0])):
        with pytest.raises(GradientError, match="the AutoDiffXd step differs from the double step"):
            beside(wrong)


# ---- refusals --------------------------------------------------------------------------------------------------------


@each_row("wrong", ["friction", "stiffness", "dissipation", "time"])
def test_another_material_is_refused(monkeypatch, wrong):
    """An error of 1e-4 in a value leaves a residual of 20 to 1,000 times the tolerance of Drake's solver."""
    approximation = "sap" if wrong == "time" else "lagged"
    model = ball(approximation, stiffness=1e4, relaxation_time=0.02, dissipation=2.0)
    x, right = [0.0, 0.0985, 1.0, -0.3], refining.combine
    refined(model, x)

    def other(sides):
        material = right(sides)
        return replace(material, **{wrong: getattr(material, wrong) * (1 + 1e-4)})

    monkeypatch.setattr(refining, "combine", other)
    assert "Drake's solver stops at 1e-06: the equation is not Drake's" in why_not(model, x)


def test_other_constants_of_drake_are_refused(monkeypatch):
    limited, controlled = limited_pendulum(), slide(gains=(1e9, 1e6))
    creeping = ball("sap", stiffness=1e4, relaxation_time=0.02)
    cases = [(limited, [1.01, 0.0], [0.0]), (controlled, [0.02, 0.3], [0.0]), (creeping, [0.0, 0.0985, 1e-3, -0.3], [])]
    for case in cases:
        refined(*case)
    monkeypatch.setattr(joint_impulses, "NEAR_RIGID", 1.01 * NEAR_RIGID)
    monkeypatch.setattr(laws, "SIGMA", 1.01e-3)
    for case in cases:
        assert "the equation is not Drake's" in why_not(*case)


def test_a_stiction_tolerance_that_is_not_the_usual_one_is_refused():
    made = Plant(H, "lagged")
    made.plant.set_stiction_tolerance(2e-4)
    properties = contact_properties(2e4, 0.0, 0.5)
    made.ball("ball", 1.0, 0.1, properties, "x", "z")
    made.ground(properties)
    assert "the equation is not Drake's" in why_not(made.model(), [0.0, 0.0985, 1e-3, 0.0])


@each_row("kind", ["distance", "ball", "weld"])
def test_a_constraint_that_is_no_coupler_is_refused(kind):
    assert "acts that is not a coupler" in why_not(constrained(kind), [0.3, 0.05, 0.2, -0.1], [0.4])


def test_what_is_not_known_is_named():
    model, x = pair(Box(0.2, 0.2, 0.2), Box(1, 1, 0.2), hydroelastic=True, height=0.095)
    assert why_not(model, x) == "hydroelastic contact acts"
    locked = springs_and_motors()
    locked.plant.GetJointByName("hinge0").Lock(locked.double.context)
    assert why_not(locked, np.zeros(6), np.zeros(3)) == "a joint is locked"


# ---- many robots -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "approximation", [*(pytest.param(name, marks=pytest.mark.slow) for name in ("lagged", "similar")), "sap"]
)
def test_robots_in_contact_are_never_refused_and_planted_materials_nearly_always(approximation, monkeypatch):
    """At 288 random states, Drake's steps are within its tolerance, and an error of 1 % in the stiffness is detected.

    It cannot be detected if a foot leaves the ground in the step, or presses with less than 1e-6 of the momentum.
    """
    random, right = np.random.default_rng(7), refining.combine
    noticed, states, worst = 0, 0, 0.0
    for name in (name for name, floating in ROBOTS.items() if floating):
        for time_step, stiffness in ((5e-4, 1e6), (1e-3, 1e4), (2e-3, 1e5), (5e-3, 1e3)):
            options = {"approximation": approximation, "feet": True, "stiffness": stiffness}
            model = example_robot(name, time_step, **options)
            xs = np.array([state_in_contact(model, random, depth=10 ** random.uniform(-4, -2)) for _ in range(12)])
            us = random.standard_normal((12, model.nu))
            found = refine_steps(model, select(model, ()), xs, us)
            assert not found.refused
            worst = max(worst, np.abs(found.x_next - found.drake).max())
            assert found.left.max() <= 1e-6
            with monkeypatch.context() as planted:
                planted.setattr(
                    refining, "combine", lambda sides: replace(m := right(sides), stiffness=1.01 * m.stiffness)
                )
                noticed += len(refine_steps(model, select(model, ()), xs, us).refused)
            states += 12
    assert states == 288
    assert 1e-7 < worst < 1e-3  # the error of Drake's solver
    assert noticed >= 0.7 * states

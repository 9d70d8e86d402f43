"""The implicit step Jacobian equals AutoDiffXd's if a step is smooth. Otherwise another method is used."""

import re
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers.models import MODELS, Plant, add_slide, contact_properties, random_state, robot_file
from helpers.plants import POINT, constrained, floating, in_the_air, limited_pendulum, springs_and_motors
from helpers.table import each_row
from pydrake.common.value import Value
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import (
    PdControllerGains,
    QuaternionFloatingJoint,
    RpyFloatingJoint,
    SpatialInertia,
    UniversalJoint,
)
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

import drake_diff as dd
from drake_diff.certificates.certify import certify_inside
from drake_diff.derivatives import sources
from drake_diff.derivatives.smooth_step import SmoothStep
from drake_diff.exceptions import ModelError, ModelWarning, SimulationError

pytestmark = pytest.mark.solve

NAMES = sorted(path.name for path in MODELS.iterdir())
BESIDE = 0.1  # [rad] or [m] distance from joint limits: a step of 10 ms at 1 rad/s covers a tenth of it
SAME = 1e-10  # two exact derivatives of one smooth step differ by rounding


def exact_parameters(model):
    """Return the names of the parameters whose derivatives are not differences."""
    return tuple(p.name for p in dd.list_parameters(model) if p.derivative_source != "finite_difference")


def agree(a, b):
    """Check that two StepDerivatives are equal to rounding, with next states that are equal to the last bit."""
    assert np.array_equal(a.x_next, b.x_next)
    for name in ("A", "B", "C"):
        ours, theirs = getattr(a, name), getattr(b, name)
        tolerance = SAME * max(1.0, np.abs(theirs).max(initial=0.0))
        assert np.abs(ours - theirs).max(initial=0.0) <= tolerance, name


def same_by_both(model, x, u=(), parameters=None, expected="implicit"):
    """Return the implicit derivatives at (x, u), and check them against autodiff and the automatic choice."""
    parameters = exact_parameters(model) if parameters is None else parameters
    found = {
        method: dd.differentiate_step(model, x, u, parameters=parameters, method=method)
        for method in ("implicit", "autodiff", "auto", "auto")
    }
    assert found["implicit"].method == expected, found["implicit"].reason
    assert found["autodiff"].method == "autodiff"
    agree(found["implicit"], found["autodiff"])
    agree(found["auto"], found["autodiff"])
    return found["implicit"]


@pytest.mark.slow
@each_row("name", NAMES)
@each_row("seed", range(3))
def test_every_model_of_this_repository(load, name, seed):
    model, random = load(name), np.random.default_rng(seed)
    x = in_the_air(model, random_state(model, random, 0.7))
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    x[: model.nq] = np.clip(x[: model.nq], lower + BESIDE, upper - BESIDE)
    u = random.standard_normal(model.nu)
    if np.any(np.isfinite(lower)):  # no joint reaches its limit within the step, not even links of 0.1 kg
        x[model.nq :], u = 0.1 * x[model.nq :], 0.01 * u
    d = same_by_both(model, x, u)
    assert d.reason == "asked for"
    assert d.C.shape[1] >= 10


@pytest.mark.parametrize("approximation", ["sap", "similar", "lagged"])
def test_every_contact_approximation(load, approximation):
    model = load("double_pendulum.urdf", contact_approximation=approximation, time_step=0.05)
    same_by_both(model, [0.4, -0.9, 1.3, -0.6], [0.25, -0.15])


@each_row(
    "name, base",
    [("panda.urdf", "panda_link0"), ("ur5_robot.urdf", None), ("solo12.urdf", None), ("solo12.urdf", "base_link")],
)
def test_real_robots(tmp_path, name, base):
    """The Panda has neither the coupler constraint of its fingers nor their boxes, which are in contact."""
    text = Path(robot_file(name)).read_text()
    path = tmp_path / name
    path.write_text(re.sub(r"(?s)<mimic.*?/>|<(collision|visual).*?</\1>", "", text))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        model = dd.load_model(path, time_step=0.005, weld_base=base)
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    random = np.random.default_rng(0)
    for _ in range(3):
        x = random_state(model, random, 0.4)
        limited = np.isfinite(lower) & np.isfinite(upper)
        low, high = lower[limited], upper[limited]
        x[: model.nq][limited] = (low + high) / 2 + 0.05 * (high - low) * random.standard_normal(len(low))
        same_by_both(model, x, 0.3 * random.standard_normal(model.nu))


def test_a_real_robot_with_coupled_fingers_is_handed_over():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        model = dd.load_model(robot_file("panda.urdf"), time_step=0.005, weld_base="panda_link0")
    d = dd.differentiate_step(model, model.default_state, np.zeros(model.nu))
    assert d.method != "implicit"
    assert dd.step(model, model.default_state, np.zeros(model.nu)) == pytest.approx(d.x_next, abs=0)


@each_row("seed", range(3))
@each_row("joint_type", [None, QuaternionFloatingJoint, RpyFloatingJoint, UniversalJoint])
def test_floating_bases_and_joints_of_many_degrees(joint_type, seed):
    model, random = floating(joint_type, seed), np.random.default_rng(seed)
    same_by_both(model, random_state(model, random, 0.5), random.standard_normal(1))


def test_a_quaternion_that_is_not_of_unit_norm():
    """Drake's coordinates are used without normalization, and A has a column for each of them."""
    model, random = floating(None, 0), np.random.default_rng(0)
    x = random_state(model, random)
    x[:4] *= 1.1
    same_by_both(model, x, [0.2])


@each_row("damping", [0.0, 0.2, 50.0])
@each_row("gear", [1.0, -12.0])
def test_springs_damping_and_reflected_inertia(damping, gear):
    same_by_both(springs_and_motors(damping=damping, gear=gear), *POINT)


@pytest.mark.parametrize("kp", [(20.0, 5.0, 8.0), (0.0, 30.0, 0.0), (3000.0, 900.0, 400.0)])
def test_pd_control_of_some_or_all_joints(kp):
    d = same_by_both(springs_and_motors(kp=kp), *POINT)
    assert not np.allclose(d.A, dd.differentiate_step(springs_and_motors(), *POINT).A, atol=1e-3)


@each_row("kp", [(0.0, 0.0, 0.0), (20.0, 5.0, 8.0), (0.0, 300.0, 200.0)])
@each_row("u", [[30.0, -0.3, -0.2], [0.4, 900.0, -900.0], [-30.0, -900.0, 900.0]])
def test_efforts_at_their_limits(kp, u):
    """A saturated input has no effect, and its controller adds neither stiffness nor damping."""
    model = springs_and_motors(limit=3.0, kp=kp)
    d = same_by_both(model, POINT[0], u)
    saturated = np.abs(dd.rollout(model, POINT[0], [u]).efforts[0]) >= 3.0 - 1e-9
    assert saturated.any()
    assert np.all(np.abs(d.B).max(axis=0)[saturated] == 0)
    assert np.all(np.abs(d.B).max(axis=0)[~saturated] > 0)


@pytest.mark.parametrize("method", ["analytic", "implicit", "autodiff"])
def test_exactly_at_its_limit_an_input_has_the_derivative_of_the_inside(method):
    """Planned inputs often are at their bounds. With a derivative of 0 there, no optimizer would change them."""
    model = springs_and_motors(limit=3.0)
    at, inside = (
        dd.differentiate_step(model, POINT[0], [a, 0.4, b], method=method).B for a, b in ((3, -3), (2.999, -2.999))
    )
    np.testing.assert_allclose(at, inside, rtol=1e-12, atol=1e-14)  # the step is affine in u


def outside(u, limit):
    """Return which inputs are saturated, with a fault: an input exactly at its limit has the derivative 0."""
    return np.abs(u) >= limit


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_derivative_of_the_outside_exactly_at_a_limit_is_found(monkeypatch, scale):
    """The certificate takes differences next to the limit, and compares the derivatives there and at the limit."""
    model = springs_and_motors(limit=3.0 * scale)
    x, u = np.array(POINT[0]), np.array([3.0, 0.4, -3.0]) * scale
    found = certify_inside(model, x, u)
    assert found.verdict == "agree"
    assert "certified beside the limit of its effort" in found.told
    assert certify_inside(model, x, u / 2).told == dd.certify(model, x, u / 2, thorough=True).told
    force = SmoothStep.force_of
    monkeypatch.setattr(
        SmoothStep, "force_of", lambda self, q, v, us: (force(self, q, v, us)[0], outside(us, self.limit))
    )
    wrong = certify_inside(model, x, u)
    assert dd.differentiate_step(model, x, u).method == "analytic"
    assert wrong.verdict == "disagree"
    assert "at which the derivative differs" in wrong.told
    assert {entry.column for entry in wrong.entries if entry.verdict == "disagree"} == {
        model.input_names[0],
        model.input_names[2],
    }


@pytest.mark.parametrize(("q", "w"), [(1.01, 0.0), (0.999, 3.0), (-1.02, -1.0)])
def test_a_joint_at_its_limit_is_handed_over(q, w):
    model = limited_pendulum()
    d = same_by_both(model, [q, w], [0.1], expected="autodiff")
    assert d.reason.startswith("not implicit: ")
    assert "joint limit" in d.reason
    free = dd.differentiate_step(limited_pendulum(-9, 9), [q, w], [0.1])
    assert not np.allclose(d.A, free.A, atol=1e-3)  # the limit has an effect


def test_a_chosen_model_is_implicit_in_the_air_and_handed_over_on_the_ground(load):
    model = load("sphere_on_ground.sdf")
    x = model.default_state
    x[12] = -0.1
    for height, expected in ((0.5, "implicit"), (0.0985, "autodiff"), (0.5, "implicit"), (0.0985, "autodiff")):
        x[6] = height
        d = same_by_both(model, x, (), expected=expected)
        assert d.reason.startswith("asked for" if expected == "implicit" else "not implicit: ")


@each_row("kind", ["coupler", "distance", "ball", "weld"])
def test_constraints_are_handed_over(kind):
    model = constrained(kind)
    d = same_by_both(model, [0.3, 0.05, 0.2, -0.1], [0.4], parameters=("one.mass",), expected="autodiff")
    assert d.reason == "not implicit: constraints act at every step"
    found = dd.differentiate_step(model, [0.3, 0.05, 0.2, -0.1], [0.4])
    if kind == "coupler" and found.method == "analytic":  # its impulse is known with Pinocchio
        exact = dd.differentiate_step(model, [0.3, 0.05, 0.2, -0.1], [0.4], method="autodiff")
        assert np.abs(found.A - exact.A).max() <= 1e-11 * np.abs(exact.A).max()
    else:
        assert "constraint" in found.reason


def test_a_locked_joint_is_handed_over():
    model = springs_and_motors()
    for twin in (model.double, model.autodiff):
        twin.plant.GetJointByName("hinge1").Lock(twin.context)
    x = np.array(POINT[0])
    x[5] = 0.0
    d = dd.differentiate_step(model, x, POINT[1], method="implicit")
    assert (d.method, d.reason) == ("autodiff", "not implicit: a joint is locked")
    agree(d, dd.differentiate_step(model, x, POINT[1], method="autodiff"))
    assert d.x_next[5] == 0


@pytest.mark.parametrize("port", ["generalized", "spatial"])
def test_a_diagram_that_applies_forces_is_handed_over(port):
    made = Plant(0.01)
    body = made.plant.AddRigidBody("block", SpatialInertia.SolidSphereWithMass(2.0, 0.1))
    made.plant.AddJointActuator("push", add_slide(made.plant, "slide", made.plant.world_frame(), body, "x"))
    made.plant.Finalize()
    if port == "generalized":
        source = made.builder.AddSystem(ConstantVectorSource([7.0]))
        made.builder.Connect(source.get_output_port(), made.plant.get_applied_generalized_force_input_port())
    else:
        force = ExternallyAppliedSpatialForce()
        force.body_index, force.F_Bq_W = body.index(), SpatialForce([0, 0, 0], [7.0, 0, 0])
        source = made.builder.AddSystem(ConstantValueSource(Value[list[ExternallyAppliedSpatialForce]]([force])))
        made.builder.Connect(source.get_output_port(), made.plant.get_applied_spatial_force_input_port())
    model = dd.model_from_diagram(made.builder.Build())
    assert dd.step(model, [0.0, 1.0], [3.0])[1] == pytest.approx(1 + 0.01 * 10.0 / 2, rel=1e-12)
    # Drake cannot convert a constant spatial force to AutoDiffXd, and reports it during the step.
    d = dd.differentiate_step(model, [0.0, 1.0], [3.0], method="implicit" if port == "generalized" else "auto")
    assert d.method == ("autodiff" if port == "generalized" else "finite_difference")
    assert "the diagram feeds applied" in d.reason
    assert ("not autodiff: " in d.reason) == (port == "spatial")
    assert d.B[1, 0] == pytest.approx(0.01 / 2, rel=1e-9)
    by_mass = dd.differentiate_step(model, [0.0, 1.0], [3.0], parameters=("block.mass",))
    assert by_mass.C[1, 0] == pytest.approx(-0.01 * 10.0 / 4, rel=1e-9)
    names = {p.name for p in dd.list_parameters(model)}
    assert ("model.gravity" in names) == (port == "spatial")  # drake_diff cannot add forces to a connected port


def test_pd_targets_that_the_diagram_feeds_are_handed_over():
    made = Plant(0.01)
    body = made.plant.AddRigidBody("block", SpatialInertia.SolidSphereWithMass(2.0, 0.1))
    slide = add_slide(made.plant, "slide", made.plant.world_frame(), body, "x")
    made.plant.AddJointActuator("push", slide).set_controller_gains(PdControllerGains(p=50.0, d=5.0))
    made.plant.Finalize()
    source = made.builder.AddSystem(ConstantVectorSource([0.4, 0.0]))
    port = made.plant.get_desired_state_input_port(slide.model_instance())
    made.builder.Connect(source.get_output_port(), port)
    model = dd.model_from_diagram(made.builder.Build())
    d = same_by_both(model, [0.1, 1.0], [3.0], expected="autodiff")
    assert d.reason == "not implicit: the diagram feeds PD targets"
    h, m = 0.01, 2.0  # m v+ = m v + h (u - p (q + h v+ - 0.4) - d v+)
    v = (m + h * (3.0 - 50.0 * (0.1 - 0.4))) / (m + h * 5 + h**2 * 50)
    assert d.x_next[1] == pytest.approx(v, rel=1e-7)  # solved by SAP


def box_over(ground):
    """Build a tilted box that does not touch the shape below it, although its bounding volume overlaps this shape."""
    made = Plant(0.01)
    body = made.plant.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(1.3, 0.3, 0.2, 0.1))
    made.shape(body, Box(0.3, 0.2, 0.1), contact_properties(1e4, friction=0.5))
    if ground == "box":
        pose = RigidTransform([0.24, 0.19, 0.0])  # two corners are close to each other
        world = made.plant.world_body()
        made.shape(world, Box(0.2, 0.2, 0.2), contact_properties(1e4, friction=0.5), pose)
    else:
        made.ground(contact_properties(1e4, friction=0.5))
    model = made.model()
    x = model.default_state
    x[:4] = np.array([0.9, 0.1, 0.05, 0.4]) / np.linalg.norm([0.9, 0.1, 0.05, 0.4])
    x[6] = 0.0 if ground == "box" else 0.13
    x[7:] = 0.4, -0.3, 0.2, 0.1, -0.2, 0.05
    return model, x


@pytest.mark.parametrize("ground", ["half space", "box"])
def test_a_box_in_the_air_that_autodiff_refuses_on_a_broad_phase_hit(ground):
    model, x = box_over(ground)
    assert dd.rollout(model, x, num_steps=1).contacts == ((),)
    try:
        dd.differentiate_step(model, x, method="autodiff")
        refused = False
    except (SimulationError, ModelError):
        refused = True
    names = exact_parameters(model)
    d = dd.differentiate_step(model, x, parameters=names, method="implicit")
    by_differences = dd.differentiate_step(model, x, parameters=names, method="finite_difference")
    chosen = dd.differentiate_step(model, x, parameters=names)
    assert d.method == "implicit"
    if refused:
        assert chosen.method == "implicit"
        assert "AutoDiffXd refuses the whole step" in chosen.reason
    for other in (by_differences, chosen):
        assert pytest.approx(other.A, abs=1e-8) == d.A  # central differences with step 1e-5
        assert pytest.approx(other.C, abs=1e-8) == d.C
    dd.certify(model, x, parameters=names, method="implicit").require()
    assert refused or ground == "half space"  # Drake 1.51 refuses a half space, Drake 1.58 does not


def test_the_automatic_choice_says_what_it_took_and_why(load):
    model = load("double_pendulum.urdf")
    point, names = ([0.4, -0.9, 1.3, -0.6], [0.25, -0.15]), ["lower.mass"]
    d = dd.differentiate_step(model, *point, parameters=names)
    assert d.method == "implicit"
    assert "equal to autodiff, as certified on this model" in d.reason
    again = dd.differentiate_step(model, [0.1, 0.2, 0.3, 0.4], [0.0, 1.0], parameters=names)
    assert (again.method, again.reason) == (d.method, d.reason)  # chosen once per model


@pytest.mark.parametrize("slow", ["implicit", "autodiff"])
def test_a_delay_changes_nothing_about_the_choice(load, monkeypatch, slow):
    """Run records contain the choice. If it depended on timing, it would differ between machines."""
    models = [load("double_pendulum.urdf") for _ in range(2)]
    point = [0.4, -0.9, 1.3, -0.6], [0.25, -0.15]
    names = tuple(p.name for p in dd.list_parameters(models[0]) if p.name.endswith(".mass"))

    def chosen(model):
        d, by_parameters = dd.differentiate_step(model, *point), dd.differentiate_step(model, *point, parameters=names)
        many = dd.linearize(model, [point[0]] * 3, [point[1]] * 3)[2]
        return d.method, d.reason, by_parameters.method, by_parameters.reason, many

    expected = chosen(models[0])
    place, name = (sources.Implicit, "differentiate") if slow == "implicit" else (sources, "_by_autodiff")
    prompt, delays = getattr(place, name), []

    def late(*args):
        delays.append(time.sleep(0.02))
        return prompt(*args)

    monkeypatch.setattr(place, name, late)
    assert chosen(models[1]) == expected
    assert delays  # the delayed function was called


def test_a_choice_made_without_parameters_holds_with_them(load):
    """Gravity and springs act as additional applied forces next to Drake's own."""
    model = load("mass_spring_damper.sdf")
    dd.differentiate_step(model, [0.3, -0.4], [1.0])
    names = ("slide.spring_stiffness", "slide.spring_rest_length", "model.gravity")
    same_by_both(model, [0.35, -0.4], [1.0], parameters=names)
    values = {"slide.spring_stiffness": 80.0, "slide.spring_rest_length": -0.2, "model.gravity": [3.0, 0.0, -9.0]}
    d = same_by_both(model, [0.35, -0.4], [1.0], parameters=values)
    s = 1 / (1 + 0.01 * 1.5 / 2)
    by_stiffness, by_rest = -s * 0.01 * (0.35 + 0.2) / 2, s * 0.01 * 80.0 / 2
    assert d.C[1] == pytest.approx([by_stiffness, by_rest, s * 0.01, 0, 0], rel=1e-9, abs=1e-14)


@each_row("seed", range(4))
def test_values_given_by_mapping_are_differentiated_where_they_are(seed):
    model, random = springs_and_motors(kp=(0.0, 20.0, 0.0), gear=3.0), np.random.default_rng(seed)
    values = {}
    for p in dd.list_parameters(model):
        factor = random.uniform(0.8, 1.25)  # the same for all entries, so that an inertia stays physical
        values[p.name] = factor * p.value if np.any(p.value) else p.value + 0.1 * (p.name[-4:] != "rtia")
    given = dd.differentiate_step(model, *POINT, parameters=values, method="implicit")
    assert given.method == "implicit"
    by_autodiff = dd.differentiate_step(model, *POINT, parameters=values, method="autodiff")
    agree(given, by_autodiff)  # both use the same differences for some parameters
    own = dd.differentiate_step(model, *POINT, method="implicit")
    assert not np.allclose(own.x_next, given.x_next)
    agree(own, dd.differentiate_step(model, *POINT, method="autodiff"))


def test_rollouts_by_both_methods_are_the_same(load):
    model = load("acrobot.xml")
    us = 0.3 * np.random.default_rng(0).standard_normal((60, model.nu))
    names = exact_parameters(model)
    a, b = (
        dd.differentiate_rollout(
            model, [0.4, -0.9, 1.3, -0.6], us, lambda x: (x**2).sum(), parameters=names, method=method
        )
        for method in ("implicit", "autodiff")
    )
    assert (a.methods, b.methods) == (("implicit",), ("autodiff",))
    for name in ("by_x0", "by_us", "by_parameters"):
        # The motion magnifies the rounding of its 60 steps as it magnifies the gradient.
        assert getattr(a, name) == pytest.approx(getattr(b, name), rel=1e-8, abs=1e-8)

"""The inverse dynamics of trees equals closed forms, and Drake's AutoDiffXd entry by entry."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.models import Plant, robot_file
from helpers.plants import pd_pendulum, random_tree
from helpers.robots import example_robot, state_in_range
from helpers.table import each_row
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.multibody.tree import (
    LinearSpringDamper,
    MultibodyForces_,
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
)

import drake_diff as dd
from drake_diff.derivatives.step import derivatives_along
from drake_diff.exceptions import ModelWarning
from drake_diff.mechanics.description import coordinates_of
from drake_diff.mechanics.tree import ForwardDynamics, tree_for, tree_of
from drake_diff.model.parameters import applied, select


def at(model, q, v, a):
    """Compute the tree's inverse dynamics at states (N, n)."""
    tree = tree_of(model)
    q, v, a = (np.atleast_2d(z).astype(float) for z in (q, v, a))
    return tree(q, v, a)


def by_drake(model, x, a):
    """Compute tau, d tau / d [q; v] by AutoDiffXd, and M with Drake."""
    twin = model.autodiff
    twin.plant.SetPositionsAndVelocities(twin.context, InitializeAutoDiff(x).ravel())
    forces = MultibodyForces_[AutoDiffXd](twin.plant)
    twin.plant.CalcForceElementsContribution(twin.context, forces)
    tau = twin.plant.CalcInverseDynamics(twin.context, np.array([AutoDiffXd(z) for z in a]), forces).reshape(-1, 1)
    model.plant.SetPositionsAndVelocities(model.double.context, x)
    return ExtractValue(tau).ravel(), ExtractGradient(tau), model.plant.CalcMassMatrix(model.double.context)


@pytest.mark.solve
@each_row("seed", range(12))
def test_a_random_tree_is_drakes_entry_by_entry(seed):
    model, random = random_tree(seed), np.random.default_rng(100 + seed)
    n = model.nv
    x, a = random.standard_normal((4, 2 * n)), 3 * random.standard_normal((4, n))
    ours = at(model, x[:, :n], x[:, n:], a)
    for k in range(4):
        tau, gradient, mass = by_drake(model, x[k], a[k])
        # Sums of some hundred products of numbers up to 100.
        assert ours.tau[k] == pytest.approx(tau, abs=1e-11)
        assert ours.by_q[k] == pytest.approx(gradient[:, :n], abs=1e-11)
        assert ours.by_v[k] == pytest.approx(gradient[:, n:], abs=1e-11)
        assert ours.mass[k] == pytest.approx(mass, abs=1e-12)


@pytest.mark.parametrize(("q", "w", "a"), [(0.7, -1.2, 3.0), (-2.0, 4.0, 0.0)])
def test_a_pendulum_is_its_closed_form(load, q, w, a):
    """tau = m l^2 a + b w + m g l sin q."""
    d = at(load("pendulum.urdf"), [q], [w], [a])
    assert d.tau[0] == pytest.approx([0.25 * a + 0.1 * w + 9.81 * 0.5 * np.sin(q)], rel=1e-12)
    assert d.by_q[0, 0] == pytest.approx([9.81 * 0.5 * np.cos(q)], rel=1e-12)
    assert d.by_v[0, 0] == pytest.approx([0.1], rel=1e-12)
    assert d.mass[0, 0] == pytest.approx([0.25], rel=1e-12)


def test_a_double_pendulum_of_rods_has_its_mass_matrix_and_bias(load):
    """For uniform rods with m1 = 1, m2 = 0.7, l1 = 0.8, l2 = 0.5:

    M11 = m1 l1^2 / 3 + m2 (l1^2 + l2^2 / 3 + l1 l2 cos q2), M12 = m2 (l2^2 / 3 + l1 l2 cos(q2) / 2), M22 = m2 l2^2 / 3.
    """
    q, w = np.array([0.4, -0.9]), np.array([1.3, -0.6])
    d = at(load("double_pendulum.urdf"), q, w, [0.0, 0.0])
    assert d.mass[0] == pytest.approx(
        np.array([[0.89371745778245, 0.14535872889123], [0.14535872889123, 0.05833333333333]]), rel=1e-12
    )
    c, half = 0.5 * 0.7 * 0.8 * 0.5, 0.5 * 0.7 * 9.81 * 0.5 * np.sin(q.sum())
    bias = [-c * np.sin(q[1]) * (2 * w[0] * w[1] + w[1] ** 2), c * np.sin(q[1]) * w[0] ** 2]
    weight = [(0.5 + 0.7) * 9.81 * 0.8 * np.sin(q[0]) + half, half]
    assert d.tau[0] == pytest.approx(np.add(bias, weight), rel=1e-12)


def floating():
    made = Plant(0.01)
    made.plant.AddRigidBody("free", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    return made.model()


def with_a_linear_spring():
    made = Plant(0.01)
    inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    body = made.plant.AddRigidBody("bob", inertia)
    made.plant.AddJoint(PrismaticJoint("slide", made.plant.world_frame(), body.body_frame(), [0, 0, 1]))
    made.plant.AddForceElement(
        LinearSpringDamper(made.plant.world_body(), np.zeros(3), body, np.array([0.1, 0, 0]), 0.3, 10.0, 0.1)
    )
    return made.model()


def without_gravity():
    made = Plant(0.01)
    body = made.plant.AddRigidBody("bob", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    made.plant.AddJoint(RevoluteJoint("hinge", made.plant.world_frame(), body.body_frame(), [0, 1, 0]))
    made.plant.set_gravity_enabled(body.model_instance(), False)
    return made.model()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (floating, "quaternion_floating"),
        (with_a_linear_spring, "LinearSpringDamper"),
        (without_gravity, "gravity is off"),
    ],
)
def test_what_is_no_such_tree_is_told_and_taken_by_autodiff(make, words):
    model = make()
    assert words in tree_of(model).reason
    assert tree_for(model) is None
    x = model.default_state + 0.01
    if model.nq != model.nv:
        x[:4] = [1, 0, 0, 0]
    a, b = (dd.differentiate_step(model, x, method=m) for m in ("implicit", "autodiff"))
    assert a.method == "implicit"
    assert pytest.approx(b.A, abs=1e-10) == a.A


def test_a_tree_that_is_not_drakes_is_not_used(monkeypatch):
    """The cross-check with Drake must refuse inertias that are 0.1 % too large."""
    real = tree_of

    def wrong(model):
        tree = real(model)
        tables = tree.compiled.tables
        return replace(tree, compiled=replace(tree.compiled, tables=tables._replace(inertia=1.001 * tables.inertia)))

    monkeypatch.setattr("drake_diff.mechanics.tree.tree_of", wrong)
    model = random_tree(5)
    assert tree_for(model) is None
    x = 0.1 * np.ones(model.nx)
    u = 0.1 * np.ones(model.nu)
    a, b = (dd.differentiate_step(model, x, u, method=m) for m in ("implicit", "autodiff"))
    assert pytest.approx(b.A, abs=1e-10) == a.A


def are_autodiffs(model, x0, us, tolerance=1e-10):
    """Check the derivatives of a motion's steps against AutoDiffXd. Return the methods of ours."""
    ours, drakes = (derivatives_along(model, x0, us, method=method) for method in ("implicit", "autodiff"))
    for a, b in zip(ours, drakes, strict=True):
        assert np.array_equal(a.x_next, b.x_next)
        for found, wanted in ((a.A, b.A), (a.B, b.B)):
            assert found == pytest.approx(wanted, abs=tolerance)
    return {d.method for d in ours}


@pytest.mark.solve
@each_row("name", ["cart_pole.urdf", "acrobot.xml", "mass_spring_damper.sdf", "double_pendulum.urdf", "PD control"])
def test_a_whole_rollout_in_one_call_is_the_one_by_autodiff(load, name):
    """The inputs of the PD controller are clipped."""
    model, random = pd_pendulum() if name == "PD control" else load(name), np.random.default_rng(0)
    x0, us = 0.3 * random.standard_normal(model.nx), random.standard_normal((30, model.nu))
    assert are_autodiffs(model, x0, us) == {"implicit"}


def test_in_a_rollout_through_a_joint_limit_the_steps_at_it_are_autodiffs():
    """The UR5 falls until a joint reaches its limit."""
    with pytest.warns(ModelWarning):
        model = dd.load_model(robot_file("ur5_robot.urdf"), time_step=0.01)
    x0 = model.default_state
    upper = model.plant.GetPositionUpperLimits()
    x0[2], x0[model.nq + 2] = upper[2] - 0.02, 3.0  # moves into its limit
    assert are_autodiffs(model, x0, np.zeros((20, model.nu)), 1e-8) == {"implicit", "autodiff"}


def test_a_clipped_input_has_no_derivative(write_urdf):
    """The block's effort limit is 2 N. Beyond it, the force is 2 N and its derivative 0."""
    model = write_urdf(mass=1.5, limit=2.0)
    found = derivatives_along(model, np.zeros(2), np.array([[1.9], [2.1], [-3.0]]), method="implicit")
    assert [d.B[1, 0] for d in found] == pytest.approx([0.1 / 1.5, 0.0, 0.0], abs=1e-15)


@pytest.mark.parametrize("name", ["model.gravity", "hinge.damping"])
def test_a_tree_is_not_made_of_another_models_parameters(load, name):
    """The first steps are taken with other parameters, the next with the model's own."""
    model, value = load("pendulum.urdf"), {"model.gravity": [0, 0, -1.0], "hinge.damping": 3.0}[name]
    x0, us = np.array([0.7, -1.2]), np.zeros((5, 1))
    for parameters in ({name: value}, {}):
        with applied(select(model, parameters)) as set_model:
            assert are_autodiffs(set_model, x0, us)


@each_row("name", ["go2.urdf", "simple_humanoid.urdf"])
def test_a_floating_robot_is_drakes_entry_by_entry(name):
    """The derivative with respect to a quaternion of any norm follows from that with respect to small rotations."""
    model, random = example_robot(name), np.random.default_rng(1)
    n, (tree, coordinates) = model.nv, (tree_of(model, free=True), coordinates_of(model))
    x, a = state_in_range(model, random), random.standard_normal(n)
    x[:4] *= 1.3
    q, v = x[: model.nq], x[model.nq :]
    ours = tree(q[None], v[None], a[None])
    tau, gradient, mass = by_drake(model, x, a)
    by_q = ours.by_q[0] @ coordinates.motion(q)
    for found, wanted in ((ours.tau[0], tau), (by_q, gradient[:, : model.nq]), (ours.by_v[0], gradient[:, model.nq :])):
        assert found == pytest.approx(wanted, abs=1e-11 * max(1.0, np.abs(wanted).max()))
    assert ours.mass[0] == pytest.approx(mass, abs=1e-11)


@each_row("name", ["panda.urdf", "go2.urdf"])
def test_accelerations_and_their_derivatives_solve_inverse_dynamics(name):
    """M a + bias = force, da/dforce = M^-1, and d a = -M^-1 d tau at a. Second derivatives equal differences."""
    model, random = example_robot(name), np.random.default_rng(4)
    tree, n = tree_of(model, free=True), model.nv
    x, force, armature = state_in_range(model, random)[None], random.standard_normal((1, n)), random.uniform(0, 1, n)
    q, v = x[:, : model.nq], x[:, model.nq :]
    forward = ForwardDynamics(tree.compiled, armature)
    by_q, by_v, inverse, a = (z[0] for z in forward.accelerate(q, v, force))
    moved = tree.compiled(q, v, a[None])
    np.testing.assert_allclose(moved.tau[0] + armature * a, force[0], atol=1e-9)
    np.testing.assert_allclose(inverse @ (moved.mass[0] + np.diag(armature)), np.eye(n), atol=1e-9)
    np.testing.assert_allclose(by_q, -inverse @ moved.by_q[0], atol=1e-9 * np.abs(by_q).max())
    np.testing.assert_allclose(by_v, -inverse @ moved.by_v[0], atol=1e-9 * np.abs(by_v).max())
    assert np.isnan(ForwardDynamics(tree.compiled, -1e3 * np.ones(n)).accelerate(q, v, force)[2]).all()
    if model.nq == n:
        along, h = random.standard_normal((1, n)), 1e-5
        bent = forward.bend(q, v, a[None], along)
        for k, move in enumerate(h * np.eye(n)):
            ends = [tree.compiled(q + s * move, v, a[None]) for s in (1, -1)]
            for found, name in zip(bent[:3], ("by_q", "by_v", "mass"), strict=True):
                slope = (along[0] @ getattr(ends[0], name)[0] - along[0] @ getattr(ends[1], name)[0]) / (2 * h)
                np.testing.assert_allclose(found[0][:, k], slope, atol=1e-5 * max(1.0, np.abs(slope).max()))
            faster = [tree.compiled(q, v + s * move, a[None]).by_v[0] for s in (1, -1)]
            slope = along[0] @ (faster[0] - faster[1]) / (2 * h)
            np.testing.assert_allclose(bent[3][0][:, k], slope, atol=1e-5 * max(1.0, np.abs(slope).max()))

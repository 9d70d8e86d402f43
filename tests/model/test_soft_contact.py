"""Tests of the contact force at a distance: its law, its momentum and energy balance, and its derivative."""

import math

import numpy as np
import pytest
from helpers.models import Plant, contact_properties
from helpers.table import each_row
from pydrake.geometry import Box, Capsule, Cylinder, Ellipsoid
from pydrake.math import RollPitchYaw
from pydrake.multibody.tree import SpatialInertia

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.model.contact import separations
from drake_diff.model.step import set_state

pytestmark = pytest.mark.solve

SOFT = dd.model.SoftContact(0.05, 200.0)


@each_row("phi", [-3.0, -0.05, 0.0, 0.02, 0.4])
def test_the_force_is_the_slope_of_the_energy(phi):
    """At zero distance the force is sigma k log 2. The central differences have an error of d^2 c'' / 6 < 1e-6."""
    d = 1e-5
    slope = (SOFT.energy(phi - d) - SOFT.energy(phi + d)) / (2 * d)
    assert slope == pytest.approx(SOFT.normal_force(phi), rel=1e-6)
    assert SOFT.normal_force(0.0) == pytest.approx(0.05 * 200 * math.log(2), rel=1e-14)


def test_the_limits_are_a_spring_and_nothing():
    """exp(-60) is below the rounding of 1. The energy at zero distance is sigma^2 k pi^2 / 12."""
    assert SOFT.normal_force(-3.0) == pytest.approx(200 * 3.0, rel=1e-14)
    assert SOFT.normal_force(3.0) == pytest.approx(0.05 * 200 * math.exp(-60), rel=1e-14)
    assert SOFT.normal_force(1e4) == 0.0
    assert SOFT.energy(0.0) == pytest.approx(0.05**2 * 200 * math.pi**2 / 12, rel=1e-13)


def test_one_step_of_two_spheres_is_the_closed_form(load):
    """Semi-implicit Euler gives m v' = m v + h (u - c), (m + h d) v' = m v + h c, with c before the step."""
    soft, h = dd.model.softened(load("two_spheres.sdf", time_step=0.02), SOFT), 0.02
    c = 0.05 * 200 * math.log1p(math.exp(-0.1 / 0.05))
    v = np.array([0.5 + h * (3 - c) / 1, (0.5 * 0.2 + h * c) / (0.5 + h * 0.5)])
    wanted = np.concatenate([np.array([0, 0.3]) + h * v, v])
    assert dd.step(soft, [0, 0.3, 0.5, 0.2], [3.0]) == pytest.approx(wanted, rel=1e-12)


def test_energy_is_kept_and_momentum_exchanged_at_a_distance():
    """Two equal balls swap their velocities. The symplectic error is of the order (h omega)^2 = h^2 2 k / m = 1e-4."""
    plant = Plant(0.001)
    for name in ("a", "b"):
        plant.ball(name, 1.0, 0.1, contact_properties(1e4), "x")
    soft = dd.model.softened(plant.model(), dd.model.SoftContact(0.05, 50.0))
    r = dd.rollout(soft, [0, 1.2, 0.5, 0], num_steps=4000)
    assert r.xs[-1][2:] == pytest.approx([0, 0.5], abs=1e-4)
    assert r.xs[:, 2:].sum(axis=1) == pytest.approx(np.full(4001, 0.5), rel=1e-12)
    assert not any(r.contacts)  # Drake's own contact never acts
    assert np.abs(r.energy_error).max() < 1e-3 * 0.125


@pytest.mark.parametrize("x", [[0, 0.5, 1, 0.2], [0, 0.25, 1, 0.2], [0, 0.19, 1, 0.2]])
def test_steps_are_certified_apart_and_touching(load, x):
    soft = dd.model.softened(load("two_spheres.sdf", time_step=0.02), SOFT)
    dd.certify(soft, x, [1.0]).require()
    dd.certify(soft.at_time_step(0.01), x, [1.0]).require()


def test_steps_are_certified_where_normals_and_arms_turn(load):
    """The models are a sphere near a turning box, and a tumbling block with eight spheres above the ground."""
    box = dd.model.softened(load("box_push.sdf"), SOFT)
    dd.certify(box, [0, 0, 0.3, -0.25, -0.1, 0.1, 0.2, 0.3, 0.4, 0.5], [1, 2]).require()
    block = dd.model.softened(load("sliding_block.sdf"), SOFT)
    q = np.array([0.9, 0.1, 0.2, 0.3])
    dd.certify(block, [*(q / np.linalg.norm(q)), 0, 0, 0.3, 0.1, 0.2, 0.3, 0.4, 0.5, -0.6]).require()


def test_a_force_without_its_derivative_is_refused(load, monkeypatch):
    """The certificate disagrees if the same law returns no AutoDiffXd derivatives."""
    soft = dd.model.softened(load("two_spheres.sdf", time_step=0.02), SOFT)
    honest = dd.model.SoftContact.normal_force
    monkeypatch.setattr(
        dd.model.SoftContact, "normal_force", lambda s, phi: honest(s, getattr(phi, "value", lambda: phi)())
    )
    assert dd.certify(soft, [0, 0.3, 1, 0.2], [1.0]).verdict == "disagree"


def test_a_floating_ball_leaves_the_ground_along_its_height(load):
    """With q = (quaternion, x, y, z), the distance is z - 0.1, its gradient is along z, and the mobility is 1/m."""
    twin = load("sphere_on_ground.sdf").double
    set_state(twin, [1, 0, 0, 0, 0.3, -0.2, 0.5, *np.zeros(6)])
    (pair,) = separations(twin)
    assert pair.distance == pytest.approx(0.4, abs=1e-14)
    assert pair.gradient == pytest.approx(np.eye(7)[6], abs=1e-12)
    assert pair.mobility == pytest.approx(1 / 1.0, rel=1e-12)  # its mass is 1 kg


def test_what_cannot_be_softened_is_refused(load):
    with pytest.raises(InputError, match="at least one collision pair"):
        dd.model.softened(load("pendulum.urdf"), SOFT)
    with pytest.raises(InputError, match="a SoftContact"):
        dd.model.softened(load("two_spheres.sdf"), 0.1)
    for wrong in ((0.0, 1.0), (0.1, -1.0), (math.nan, 1.0)):
        with pytest.raises(InputError, match="above 0"):
            dd.model.SoftContact(*wrong)


def lowest(shape, R):
    """Return the least height of a shape rotated by R, from 10^5 points on its surface or from its corners."""
    rng = np.random.default_rng(0)
    n = rng.normal(size=(100_000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    if isinstance(shape, Box):
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return float(np.min((corners * shape.size() / 2) @ R[2]))
    if isinstance(shape, Ellipsoid):
        return float(np.min((n * [shape.a(), shape.b(), shape.c()]) @ R[2]))
    ends = np.sign(n[:, 2:]) * [0, 0, shape.length() / 2]
    if isinstance(shape, Capsule):
        return float(np.min((ends + shape.radius() * n) @ R[2]))
    rim = n[:, :2] / np.linalg.norm(n[:, :2], axis=1, keepdims=True)
    return float(np.min((ends + np.column_stack([shape.radius() * rim, 0 * rim[:, 0]])) @ R[2]))


SHAPES = [Box(0.1, 0.2, 0.3), Ellipsoid(0.1, 0.2, 0.3), Capsule(0.1, 0.3), Cylinder(0.1, 0.3)]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
@pytest.mark.parametrize("ground_first", [True, False])
def test_a_shape_is_as_far_from_the_ground_as_its_lowest_point(shape, ground_first):
    """The gradient equals central differences, which have an error of d^2 = 1e-10 and rounding of 1e-11."""
    plant, properties = Plant(0.01), contact_properties(1e4)
    body = plant.plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    if ground_first:
        plant.ground(properties)
    plant.shape(body, shape, properties)
    if not ground_first:
        plant.ground(properties)
    model = plant.model()
    turn = RollPitchYaw(0.3, -0.5, 0.8)
    q = np.concatenate([turn.ToQuaternion().wxyz(), [0.2, -0.1, 0.7]])

    def distance(q):
        set_state(model.double, np.concatenate([q, np.zeros(6)]))
        (separation,) = separations(model.double)
        return separation

    found = distance(q)
    # 1e-4 of the 0.3 m, because 10^5 points on a surface are a degree apart
    assert found.distance == pytest.approx(0.7 + lowest(shape, turn.ToRotationMatrix().matrix()), abs=1e-4)
    d = 1e-5
    slope = [(distance(q + d * e).distance - distance(q - d * e).distance) / (2 * d) for e in np.eye(7)]
    np.testing.assert_allclose(tangent(found.gradient, q), tangent(np.array(slope), q), atol=1e-8)


def tangent(gradient, q):
    """Return the gradient without the part that changes the quaternion's norm, which no motion changes."""
    along = np.concatenate([q[:4], np.zeros(3)])
    return gradient - along * (gradient @ along)


def test_the_inputs_of_servos_stay_commanded_positions(load):
    model = load("two_fingers.sdf", inputs="position", gains=(200.0, 5.0))
    soft = dd.model.softened(model, SOFT)
    x, u = model.default_state, np.full(model.nu, 0.01)
    assert soft.inputs.units == model.inputs.units
    far = dd.model.softened(model, dd.model.SoftContact(1e-6, 1e-6))  # a negligible force
    np.testing.assert_allclose(dd.step(far, x, u), dd.step(model, x, u), atol=1e-6)
    assert np.abs(dd.step(model, x, u) - dd.step(model, x, 0 * u)).max() > 1e-4

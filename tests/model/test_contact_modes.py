"""Tests of contact modes, which are computed from Drake's forces, and of mode changes near a step."""

import numpy as np
import pytest
from helpers.models import Plant, contact_properties
from helpers.table import each_row
from pydrake.geometry import AddCompliantHydroelasticProperties, AddRigidHydroelasticProperties, Box
from pydrake.multibody.tree import SpatialInertia

import drake_diff as dd
from drake_diff.model import contact_modes

G, K, MU, H = 9.81, 1e4, 0.5, 0.01
REST = 0.1 - G / K  # [m] height of a ball of 1 kg at rest on a ground, both of stiffness 2 K
PAIR = ("ball/ball", "world/ground")


def pushed_ball(approximation, mu=MU):
    """Return a model of a ball that slides along x and z above the ground, with a force input along x."""
    plant = Plant(H, approximation)
    plant.ball("ball", 1.0, 0.1, contact_properties(2 * K, 0.0, mu, 0.0), "x", "z")
    plant.ground(contact_properties(2 * K, 0.0, mu, 0.0))
    plant.plant.AddJointActuator("push", plant.plant.GetJointByName("ball_x"))
    return plant.model()


@each_row("approximation", ["sap", "similar", "lagged"])
@each_row("mu", [0.3, 0.5])
def test_a_push_below_the_friction_limit_sticks_and_one_above_slides(approximation, mu):
    """The friction limit is mu m g."""
    model, x = pushed_ball(approximation, mu), [0.0, REST, 0.0, 0.0]
    assert contact_modes(model, x, [0.5 * mu * G]) == {PAIR: "sticking"}
    assert contact_modes(model, x, [-0.5 * mu * G]) == {PAIR: "sticking"}
    assert contact_modes(model, x, [1.3 * mu * G]) == {PAIR: "sliding"}


@pytest.mark.parametrize("approximation", ["sap", "similar", "lagged"])
def test_a_ball_in_the_air_is_separated_and_so_is_one_that_leaves(approximation):
    model = pushed_ball(approximation)
    assert contact_modes(model, [0.0, 0.2, 0.0, 0.0], [0.0]) == {PAIR: "separated"}
    # The ball overlaps by 1e-5 m and leaves at 1 m/s, so it separates within the step.
    assert contact_modes(model, [0.0, 0.1 - 1e-5, 0.0, 1.0], [0.0]) == {PAIR: "separated"}


def test_every_candidate_pair_is_listed():
    plant = Plant(H)
    for i, name in enumerate("abc"):
        plant.ball(name, 1.0, 0.1, contact_properties(2 * K, 0.0, MU, 0.0), "xyz"[i])
    model = plant.model()
    modes = contact_modes(model, [0.0] * 3 + [0.0] * 3)  # all three at the origin
    assert list(modes) == [("a/a", "b/b"), ("a/a", "c/c"), ("b/b", "c/c")]
    far = contact_modes(model, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    assert set(far.values()) == {"separated"}


@pytest.mark.parametrize(("push", "mode"), [(0.0, "sticking"), (3.0 * MU * G, "sliding")])
def test_a_hydroelastic_patch_has_a_mode_too(push, mode):
    plant = Plant(H, "sap", "hydroelastic")
    body = plant.plant.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(1.0, 0.2, 0.2, 0.2))
    soft, hard = contact_properties(K, 0.0, MU, 0.0), contact_properties(K, 0.0, MU, 0.0)
    AddCompliantHydroelasticProperties(0.1, 1e6, soft)
    AddRigidHydroelasticProperties(0.1, hard)
    plant.shape(body, Box(0.2, 0.2, 0.2), soft)
    plant.ground(hard)
    plant.plant.mutable_gravity_field().set_gravity_vector([push, 0, -G])  # pushed by tilting gravity
    model = plant.model()
    x = model.default_state
    x[6] = 0.1 - 1e-5
    for _ in range(40):
        x = dd.step(model, x)
    assert contact_modes(model, x) == {("box/box_shape", "world/ground"): mode}


def test_a_change_of_mode_beside_the_step_is_named_with_the_entries_it_touches():
    """The ball starts 5e-5 m above the ground, and touches it if it is displaced down by 1e-4 m."""
    model = pushed_ball("lagged")
    certificate = dd.certify(model, [0.0, 0.1 + 5e-5, 0.0, 0.0], [0.0], thorough=True)
    changes = certificate.mode_changes
    assert [(c.pair, c.before, c.after, c.column) for c in changes] == [(PAIR, "separated", "sticking", "ball_z_x")]
    assert changes[0].displacement == -1e-4
    assert set(changes[0].rows) == {"ball_z_x", "ball_z_v"}
    assert "contact changes nearby" in str(certificate)
    assert "affects d(ball_z_x, ball_z_v)/dball_z_x" in str(changes[0])


@pytest.mark.slow
def test_at_the_edge_of_friction_the_push_changes_the_mode():
    """With SAP, the mode changes within 1e-4 N at the friction limit mu m g, and does not change 0.3 N below it."""
    model, x = pushed_ball("sap"), [0.0, REST, 0.0, 0.0]
    limit = next(u for u in np.arange(4.0, 6.0, 1e-4) if contact_modes(model, x, [u])[PAIR] == "sliding")
    assert limit == pytest.approx(MU * G, rel=0.02)  # SAP's regularization
    columns = {c.column for c in dd.certify(model, x, [limit], thorough=True).mode_changes}
    assert "push" in columns
    assert not dd.certify(model, x, [limit - 0.3], thorough=True).mode_changes


@pytest.mark.solve
@each_row("z, vx, vz", [(0.3, 1.0, -1.0), (REST, 1.0, 0.0), (0.097, 0.5, -0.5), (0.0985, 0, 0.3)])
@each_row("approximation", ["sap", "similar", "lagged"])
def test_no_good_contact_state_is_flagged(z, vx, vz, approximation):
    model, x = pushed_ball(approximation), [0.0, z, vx, vz]
    dd.certify(model, x, [0.3]).require()
    assert not [f for f in dd.audit(model, x, [0.3]) if f.severity == "error"]

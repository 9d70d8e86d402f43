"""Models whose gradient is wrong, refused, or not there, each flagged for the right reason; and good ones."""

import numpy as np
import pytest
from helpers.models import Plant, contact_properties
from helpers.plants import offset_pendulum, pair, pd_pendulum
from helpers.table import each_row
from pydrake.geometry import AddCompliantHydroelasticProperties, Box, Capsule, Cylinder, HalfSpace, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import LeafSystem

import drake_diff as dd
from drake_diff.exceptions import GradientError

MU, G = 0.5, 9.81
REST = 0.1 - G / 1e4  # [m] of the ball below


def shapes(upper, lower, height, *, hydroelastic=False, tilt=0.0):
    """A free body of shape `upper` at `height` over a fixed `lower`, and the state."""
    plant = Plant(0.01, "sap", "hydroelastic_with_fallback" if hydroelastic else "point")
    body = plant.plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    properties = [contact_properties(1e4, 0.0, MU, 0.01) for _ in range(2)]
    if hydroelastic:
        for p in properties:
            AddCompliantHydroelasticProperties(0.02, 1e7, p)
    plant.shape(body, upper, properties[0])
    pose = RigidTransform(RotationMatrix.MakeXRotation(tilt), [0, 0, 0])
    plant.shape(plant.plant.world_body(), lower, properties[1], pose)
    model = plant.model()
    x = model.default_state
    x[6] = height
    return model, x


def ball(axes="xz", approximation="sap"):
    plant = Plant(0.01, approximation)
    plant.ball("ball", 1.0, 0.1, contact_properties(2e4, 0.0, MU, 0.0), *axes)
    plant.ground(contact_properties(2e4, 0.0, MU, 0.0))
    if "x" in axes:
        plant.plant.AddJointActuator("push", plant.plant.GetJointByName("ball_x"))
    return plant.model()


def audited(code, model, x=None, u=None, severity="error"):
    """Whether the audit names the reason, at this severity."""
    return any(f.code == code and f.severity == severity for f in dd.audit(model, x, u))


def certified(model, x, u=None, **options):
    try:
        return dd.certify(model, x, u, **options)
    except GradientError as error:
        return error


def drive_limit(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="arm"><link name="arm"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/><inertia ixx="0.1" '
        'iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="hinge" type="revolute">'
        '<parent link="world"/><child link="arm"/><axis xyz="0 1 0"/><limit effort="2" lower="-1" upper="1"/></joint>'
        "<transmission><type>transmission_interface/SimpleTransmission</type><joint name='hinge'><hardwareInterface>"
        "EffortJointInterface</hardwareInterface></joint><actuator name='motor'/></transmission></robot>"
    )
    return dd.load_model(path, time_step=0.01)


class Ticker(LeafSystem):
    """A system without an AutoDiffXd form."""


def with_a_system_of_doubles():
    plant = Plant(0.01)
    plant.ball("ball", 1.0, 0.1, contact_properties(1e4), "z")
    plant.builder.AddNamedSystem("ticker", Ticker())
    return plant.model()


def bounce_is_not_converged(tmp_path):
    path = tmp_path / "bouncer.sdf"
    path.write_text(
        '<sdf version="1.9"><model name="m"><link name="ball"><inertial><mass>1</mass><inertia><ixx>1</ixx><iyy>1</iyy>'
        "<izz>1</izz></inertia></inertial><collision name='skin'><geometry><sphere><radius>0.1</radius></sphere>"
        "</geometry></collision></link><joint name='slide' type='prismatic'><parent>world</parent><child>ball</child>"
        "<axis><xyz>0 0 1</xyz><limit><effort>0</effort></limit></axis></joint></model></sdf>"
    )
    model = dd.load_model(path, time_step=0.005, ground=MU, contact_approximation="lagged")
    found = dd.certify_rollout(model, [0.6, 0.0], None, lambda x: x[1], num_steps=100, refine=True)
    return found.verdict == "not_converged" and "not converged: do not optimize with this" in str(found)


def verdict(found):
    return getattr(found, "verdict", "refused")


def touch_is_discontinuous():
    found = certified(ball(), [0.0, 0.1 - 1e-12, 0.0, -1.0], [0.0])
    return verdict(found) == "discontinuous" and any(c.before != c.after for c in found.mode_changes)


def friction_edge_is_a_mode_change():
    model, x = ball(), [0.0, REST, 0.0, 0.0]
    edge = next(u for u in np.arange(4.5, 5.5, 2e-5) if "sliding" in dd.contact_modes(model, x, [u]).values())
    found = certified(model, x, [edge])
    changes = [(c.before, c.after, c.column) for c in found.mode_changes]
    return ("sliding", "sticking", "push") in changes


ZOO = {
    "PD gains that scalar conversion drops": lambda _: audited("pd_gains", pd_pendulum(), severity="info"),
    "an identity frame whose derivative is dropped": lambda _: audited(
        "identity_frame", offset_pendulum(), severity="info"
    ),
    "a sphere on a cylinder's axis": lambda _: audited(
        "cylinder_axis", *pair(Sphere(0.1), Cylinder(0.2, 0.2), hydroelastic=False, height=0.0995)
    ),
    "a sphere over an untilted hydroelastic cap": lambda _: audited(
        "aligned_faces", *shapes(Sphere(0.1), Cylinder(0.2, 0.2), 0.195, hydroelastic=True)
    ),
    "aligned hydroelastic cylinders": lambda _: audited(
        "aligned_faces", *shapes(Cylinder(0.1, 0.2), Cylinder(0.2, 0.2), 0.195, hydroelastic=True)
    ),
    "flat hydroelastic faces": lambda _: audited(
        "aligned_faces", *shapes(Box(0.2, 0.2, 0.2), Box(1, 1, 0.2), 0.1995, hydroelastic=True)
    ),
    "a box on the ground in point contact": lambda _: audited(
        "pair_refused", *shapes(Box(0.2, 0.2, 0.2), HalfSpace(), 0.0995)
    ),
    "a box 20 cm over a tilted half space": lambda _: audited(
        "pair_refused", *shapes(Box(0.2, 0.2, 0.2), HalfSpace(), 0.35, tilt=0.2)
    ),
    "a capsule on the ground": lambda _: audited("pair_refused", *shapes(Capsule(0.1, 0.3), HalfSpace(), 0.2)),
    "a box on a box": lambda _: audited("pair_refused", *shapes(Box(0.2, 0.2, 0.2), Box(1, 1, 0.2), 0.199)),
    "an effort beyond its limit": lambda tmp: audited("saturated_effort", drive_limit(tmp), [0.1, 0.0], [5.0]),
    "a joint at its limit": lambda tmp: audited("joint_limit", drive_limit(tmp), [1.0, 0.0], [0.0], "warning"),
    "a system without an AutoDiffXd form": lambda _: audited("autodiff_refused", with_a_system_of_doubles()),
    "a ball exactly at touchdown": lambda _: touch_is_discontinuous(),
    "a ball at the edge of friction": lambda _: friction_edge_is_a_mode_change(),
    "a whole bounce": bounce_is_not_converged,
    "a sphere as big a surprise as its default stiffness": lambda tmp: audited(
        "default_decides", dd.load_model(_plain_ball(tmp), time_step=0.01, ground=MU), severity="warning"
    ),
}


def _plain_ball(tmp_path):
    path = tmp_path / "plain.urdf"
    path.write_text(
        '<robot name="plain"><link name="ball"><inertial><mass value="1"/><inertia ixx="0.004" iyy="0.004" '
        'izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry><sphere radius="0.1"/></geometry>'
        "</collision></link></robot>"
    )
    return path


@pytest.mark.slow
@each_row("name", ZOO)
def test_every_animal_is_flagged_for_the_right_reason(name, tmp_path):
    assert ZOO[name](tmp_path)


GOOD = {
    "pendulum.urdf": ([0.7, -1.2], [0.3]),
    "cart_pole.urdf": ([0.1, 0.7, -0.3, 1.1], [2.0]),
    "double_pendulum.urdf": ([0.4, -0.9, 1.3, -0.6], [0.25, -0.15]),
    "acrobot.xml": ([0.4, -0.9, 1.3, -0.6], [0.2]),
    "mass_spring_damper.sdf": ([0.35, -0.4], [1.0]),
}


@each_row("name", GOOD)
@each_row("scale", [0.5, 1.0, 1.4])
def test_no_good_state_is_flagged(load, name, scale):
    """15 states by hand; `test_certification.py` has 160 sampled ones, contact among them."""
    x, u = GOOD[name]
    model = load(name)
    point = scale * np.array(x), np.array(u)
    dd.certify(model, *point).require()
    assert not [f for f in dd.audit(model, *point) if f.severity == "error"]


@each_row("z, vx, vz", [(0.3, 1.0, -1.0), (REST, 1.0, 0.0), (0.097, 0.5, -0.5), (0.0985, 0, 0.3)])
@each_row("approximation", ["sap", "similar", "lagged"])
def test_no_good_contact_state_is_flagged(z, vx, vz, approximation):
    model = ball(approximation=approximation)
    dd.certify(model, [0.0, z, vx, vz], [0.3]).require()
    assert not [f for f in dd.audit(model, [0.0, z, vx, vz], [0.3]) if f.severity == "error"]

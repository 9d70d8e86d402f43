"""drake_diff as an engine of the suite of gradients: free motions and compliant contact, by method="continuous".

    python gradients_suite.py --engine gradients_suite_drake:engine

The slopes with respect to masses, lengths and gravity are not given, as this method differentiates the state, the
inputs and contact parameters. Rigid impacts and ideal Coulomb friction are not supported.
"""

import logging
import sys
import warnings

import numpy as np
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.framework import DiagramBuilder

import drake_diff as dd

X, Y, Z = np.eye(3)
STICTION = 1e-3  # [m/s]


class Plant:
    """A plant under construction whose time step is the duration of a case."""

    def __init__(self, duration, gravity):
        self.builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=duration,
            contact_model="point",
            stiction_tolerance=STICTION,
            discrete_contact_approximation="lagged",
            use_sampled_output_ports=False,
        )
        self.plant, _ = AddMultibodyPlant(config, self.builder)
        self.plant.mutable_gravity_field().set_gravity_vector([0, 0, -gravity])

    def joint(self, kind, name, axis, inertia, parent=None, at=(0, 0, 0), *, damping=0.0, spring=None, driven=False):
        """Add a body with a joint to the world, or to `parent` at a point of it. A spring is (rest, stiffness)."""
        plant = self.plant
        body, base = plant.AddRigidBody(name, inertia), parent or plant.world_body()
        frame = plant.AddFrame(FixedOffsetFrame(f"{name}_base", base.body_frame(), RigidTransform(at)))
        joint = plant.AddJoint(kind(f"{name}_joint", frame, body.body_frame(), axis, damping=damping))
        if spring:
            plant.AddForceElement((PrismaticSpring if kind is PrismaticJoint else RevoluteSpring)(joint, *spring))
        if driven:
            plant.AddJointActuator(f"{name}_motor", joint)
        return body

    def ground(self, ball, p):
        """Add the contact of a ball with the ground. Each side is twice as stiff as the pair."""
        properties = ProximityProperties()
        mu = p.get("mu", 0.0)
        AddContactMaterial(p.get("c", 0.0), 2 * p["k"], CoulombFriction(mu, mu), properties)
        plant, still = self.plant, RigidTransform()
        plant.RegisterCollisionGeometry(ball, still, Sphere(p["r"]), "ball", properties)
        plant.RegisterCollisionGeometry(plant.world_body(), still, HalfSpace(), "ground", properties)

    def model(self):
        self.plant.Finalize()
        return dd.model_from_diagram(self.builder.Build())


NOTHING = SpatialInertia.Zero()


def point(mass, at=(0, 0, 0)):
    x, y, z = at
    about = UnitInertia(y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z)
    return SpatialInertia(mass, np.array(at, dtype=float), about)


def projectile(p, T):
    made = Plant(T, p["g"])
    slide = made.joint(PrismaticJoint, "slide", X, NOTHING, damping=p["b"])
    made.joint(PrismaticJoint, "ball", Z, point(p["m"]), slide, damping=p["b"])
    return made


def pendulum(p, T):
    made = Plant(T, p["g"])
    made.joint(RevoluteJoint, "rod", -Y, point(p["m"], [0, 0, -p["l"]]), damping=p["b"], driven=True)
    return made


def pd_joint(p, T):
    """The gains are those of a spring and a damper, so the slope with respect to the target is not given."""
    made = Plant(T, p["g"])
    gains = {"damping": p["kd"], "spring": (p["target"], p["kp"])}
    made.joint(RevoluteJoint, "rod", -Y, point(p["m"], [0, 0, -p["l"]]), **gains)
    return made


def double_pendulum(p, T):
    made, end = Plant(T, p["g"]), [0, 0, -p["l1"]]
    one = made.joint(RevoluteJoint, "one", -Y, point(p["m1"], end), driven=True)
    made.joint(RevoluteJoint, "two", -Y, point(p["m2"], [0, 0, -p["l2"]]), one, end, driven=True)
    return made


def cart_pole(p, T):
    made = Plant(T, p["g"])
    cart = made.joint(PrismaticJoint, "cart", X, point(p["M"]), driven=True)
    made.joint(RevoluteJoint, "pole", -Y, point(p["m"], [0, 0, -p["l"]]), cart)
    return made


def rigid_body(p, T):
    """Three hinges, as drake_diff has no joint with roll, pitch and yaw; see `to_hinges` and `from_hinges`."""
    made, inertia = Plant(T, 0.0), UnitInertia(p["I_x"], p["I_y"], p["I_z"])
    yaw = made.joint(RevoluteJoint, "yaw", Z, NOTHING)
    pitch = made.joint(RevoluteJoint, "pitch", Y, NOTHING, yaw)
    made.joint(RevoluteJoint, "roll", X, SpatialInertia(1.0, np.zeros(3), inertia), pitch)
    return made


def to_hinges(x):
    """Return yaw, pitch, roll and their rates from roll, pitch, yaw and the angular velocity."""
    a, b, c, wx, wy, wz = x
    roll = (np.cos(c) * wx + np.sin(c) * wy) / np.cos(b)
    return np.array([c, b, a, wz + np.sin(b) * roll, np.cos(c) * wy - np.sin(c) * wx, roll])


def from_hinges(x):
    c, b, a, yaw, pitch, roll = x
    wx = np.cos(b) * np.cos(c) * roll - np.sin(c) * pitch
    return np.array([a, b, c, wx, np.cos(b) * np.sin(c) * roll + np.cos(c) * pitch, yaw - np.sin(b) * roll])


def spring_damper(p, T):
    made = Plant(T, 0.0)
    one = made.joint(PrismaticJoint, "one", X, point(p["m1"]), damping=p["c1"], spring=(0.0, p["k1"]))
    made.joint(PrismaticJoint, "two", X, point(p["m2"]), one, damping=p["c2"], spring=(0.0, p["k2"]), driven=True)
    return made


def falling_ball(p, T):
    made = Plant(T, p["g"])
    made.ground(made.joint(PrismaticJoint, "ball", Z, point(p["m"])), p)
    return made


def resting_contact(p, T):
    if p["vs"] != STICTION:  # the motion in continuous time has this one in any model
        raise NotImplementedError
    made = Plant(T, p["g"])
    slide = made.joint(PrismaticJoint, "slide", X, NOTHING, driven=True)
    made.ground(made.joint(PrismaticJoint, "ball", Z, point(p["m"]), slide, driven=True), p)
    return made


FAMILIES = {
    made.__name__: made
    for made in (projectile, pendulum, pd_joint, double_pendulum, cart_pole, rigid_body, spring_damper, resting_contact)
} | {"spring_contact": falling_ball, "damped_contact": falling_ball}
QUANTITIES = {"k": ("stiffness", 2.0), "c": ("dissipation", 1.0), "mu": ("friction", 1.0)}  # with each side's share
SIDES = ("ball", "world")


def engine(case):
    """Return the final state (n,) and the slopes (n, m) of a case, NaN for those that are not given."""
    if case["family"] not in FAMILIES:
        raise NotImplementedError
    logging.getLogger("drake").setLevel(logging.ERROR)  # no message about each half space
    model = FAMILIES[case["family"]](case["state"] | case["inputs"] | case["constants"], case["duration"]).model()
    x0, inputs, n = np.array(list(case["state"].values())), list(case["inputs"].values()), len(case["state"])
    us = np.array([inputs]) if model.nu else np.zeros((1, 0))
    into, out = (to_hinges, from_hinges) if case["family"] == "rigid_body" else (np.array, np.array)
    start = into(x0[:, None] + 1e-30j * np.eye(n))  # the derivative by complex steps
    touches = case["family"].endswith("contact")
    chosen = {key: each for key, each in QUANTITIES.items() if touches and key in case["constants"]}
    names = [f"{side}.{quantity}" for quantity, _ in chosen.values() for side in SIDES]
    value, slopes = np.empty(n), np.full((n, n + len(inputs) + len(case["constants"])), np.nan)
    at = {key: n + len(inputs) + j for j, key in enumerate(case["constants"])}
    options = {"method": "continuous", "parameters": names}
    for i in range(n):
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always", dd.exceptions.GradientWarning)
            found = dd.differentiate_rollout(model, start[:, 0].real, us, lambda x, i=i: out(x)[i], **options)
        for each in warned:  # the slope is compared all the same
            print(f"{case['name']}: {list(case['state'])[i]}: {each.message}", file=sys.stderr)
        value[i], slopes[i, :n] = found.loss, found.by_x0 @ start.imag / 1e-30
        if model.nu:
            slopes[i, n : n + model.nu] = found.by_us[0]
        by = dict(zip(found.parameter_names, found.by_parameters, strict=True))
        for key, (quantity, share) in chosen.items():
            slopes[i, at[key]] = share * sum(by[f"{side}.{quantity}"] for side in SIDES)
    return value, slopes

"""drake_diff as an engine of the suite of gradients: free motions and compliant contact, by method="continuous".

    python gradients_suite.py --engine gradients_suite_drake:engine

The slopes with respect to masses, lengths and gravity are not given, as this method differentiates the state, the
inputs and contact parameters. Rigid impacts and ideal Coulomb friction are not supported.
"""

import logging
import warnings

import numpy as np
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import (
    BallRpyJoint,
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


class Plant:
    """A plant under construction whose time step is the duration of a case."""

    def __init__(self, duration, gravity, stiction=1e-3):
        self.builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=duration,
            contact_model="point",
            stiction_tolerance=stiction,
            discrete_contact_approximation="lagged",
            use_sampled_output_ports=False,
        )
        self.plant, _ = AddMultibodyPlant(config, self.builder)
        self.plant.mutable_gravity_field().set_gravity_vector([0, 0, -gravity])

    def joint(self, kind, name, axis, inertia, parent=None, at=(0, 0, 0), *, damping=0.0, spring=None, driven=False):
        """Add a body with a joint to the world, or to `parent` at a point of it. A spring is (rest, stiffness)."""
        plant = self.plant
        body, base = plant.AddRigidBody(name, inertia), parent or plant.world_body()
        joint = plant.AddJoint(kind(f"{name}_joint", self.frame(base, at), body.body_frame(), axis, damping=damping))
        if spring:
            plant.AddForceElement((PrismaticSpring if kind is PrismaticJoint else RevoluteSpring)(joint, *spring))
        if driven:
            plant.AddJointActuator(f"{name}_motor", joint)
        return body

    def frame(self, body, at):
        offset = FixedOffsetFrame(f"{body.name()}_{self.plant.num_frames()}", body.body_frame(), RigidTransform(at))
        return self.plant.AddFrame(offset)

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
    return SpatialInertia.PointMass(mass, at)


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
    made, inertia = Plant(T, 0.0), UnitInertia(p["Ix"], p["Iy"], p["Iz"])
    body = made.plant.AddRigidBody("body", SpatialInertia(1.0, np.zeros(3), inertia))
    made.plant.AddJoint(BallRpyJoint("joint", made.plant.world_frame(), body.body_frame()))
    return made


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
    made = Plant(T, p["g"], p["vs"])
    slide = made.joint(PrismaticJoint, "slide", X, NOTHING, driven=True)
    made.ground(made.joint(PrismaticJoint, "ball", Z, point(p["m"]), slide, driven=True), p)
    return made


FAMILIES = {
    "projectile": projectile,
    "pendulum": pendulum,
    "pd_joint": pd_joint,
    "double_pendulum": double_pendulum,
    "cart_pole": cart_pole,
    "rigid_body": rigid_body,
    "spring_damper": spring_damper,
    "spring_contact": falling_ball,
    "damped_contact": falling_ball,
    "resting_contact": resting_contact,
}
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
    touches = case["family"].endswith("contact")
    chosen = {key: each for key, each in QUANTITIES.items() if touches and key in case["constants"]}
    names = [f"{side}.{quantity}" for quantity, _ in chosen.values() for side in SIDES]
    value, slopes = np.empty(n), np.full((n, n + len(inputs) + len(case["constants"])), np.nan)
    at = {key: n + len(inputs) + j for j, key in enumerate(case["constants"])}
    for i in range(n):
        with warnings.catch_warnings():
            warnings.simplefilter("error", dd.exceptions.GradientWarning)  # no slope, which the suite's cases have
            found = dd.differentiate_rollout(model, x0, us, lambda x, i=i: x[i], method="continuous", parameters=names)
        value[i], slopes[i, :n] = found.loss, found.by_x0
        if model.nu:
            slopes[i, n : n + model.nu] = found.by_us[0]
        by = dict(zip(found.parameter_names, found.by_parameters, strict=True))
        for key, (quantity, share) in chosen.items():
            slopes[i, at[key]] = share * sum(by[f"{side}.{quantity}"] for side in SIDES)
    return value, slopes

"""Small plants: blocks, pendulums, trees, floating bodies and bodies on the ground."""

import math

import numpy as np
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddRigidHydroelasticProperties,
    Box,
    CollisionFilterDeclaration,
    Convex,
    GeometrySet,
    HalfSpace,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PdControllerGains,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    RotationalInertia,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)
from pydrake.systems.framework import DiagramBuilder

import drake_diff as dd
from helpers.models import Plant, add_slide, contact_properties


def block(*, mass=1.0, time_step=0.1, effort=math.inf, blocks=1, actuated=1, couple=False):
    """Return blocks side by side on rails, with x_k along their rails; the first `actuated` of them are pushed."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=time_step, use_sampled_output_ports=False, discrete_contact_approximation="sap"
    )
    plant, _ = AddMultibodyPlant(config, builder)
    rails = []
    for i in range(blocks):
        body = plant.AddRigidBody(f"block_{i}", SpatialInertia.SolidBoxWithMass(mass, 0.1, 0.1, 0.1))
        rails.append(plant.AddJoint(PrismaticJoint(f"rail_{i}", plant.world_frame(), body.body_frame(), [1, 0, 0])))
    for i in range(actuated):
        plant.AddJointActuator(f"push_{i}", rails[i], effort)
    if couple:
        plant.AddCouplerConstraint(rails[0], rails[1], 2.0)
    plant.Finalize()
    return dd.model_from_diagram(builder.Build())


def pd_pendulum():
    plant = Plant(0.01)
    body = plant.plant.AddRigidBody("pole", SpatialInertia(1.0, [0, 0, -0.5], UnitInertia(0.25, 0.25, 0.0)))
    joint = RevoluteJoint("hinge", plant.plant.world_frame(), body.body_frame(), [0, 1, 0])
    actuator = plant.plant.AddJointActuator("motor", plant.plant.AddJoint(joint))
    actuator.set_controller_gains(PdControllerGains(p=20.0, d=3.0))
    return plant.model()


def offset_pendulum():
    """Return two hinges. The second's frame on its parent is a FixedOffsetFrame whose pose is the identity."""
    plant = Plant(0.01)
    inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    upper = plant.plant.AddRigidBody("upper", inertia)
    lower = plant.plant.AddRigidBody("lower", SpatialInertia(1.0, [0, 0, -0.3], UnitInertia(0.09, 0.09, 0.0)))
    plant.plant.AddJoint(RevoluteJoint("first", plant.plant.world_frame(), upper.body_frame(), [0, 1, 0]))
    frame = plant.plant.AddFrame(FixedOffsetFrame("offset", upper.body_frame(), RigidTransform()))
    plant.plant.AddJoint(RevoluteJoint("second", frame, lower.body_frame(), [0, 1, 0]))
    return plant.model()


def pair(upper, lower, *, hydroelastic, height):
    """Return a free body of shape `upper` at `height` above a fixed one, whose top is z = 0, and its state."""
    plant = Plant(0.01, "sap", "hydroelastic_with_fallback" if hydroelastic else "point")
    body = plant.plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    properties = [contact_properties(1e4, friction=0.5) for _ in range(2)]
    if hydroelastic:
        for p in properties:
            AddCompliantHydroelasticProperties(0.02, 1e7, p)
    plant.shape(body, upper, properties[0])
    plant.shape(plant.plant.world_body(), lower, properties[1], RigidTransform([0, 0, -0.1]))
    model = plant.model()
    x = model.default_state
    x[6], x[12] = height, -0.1
    return model, x


def limited_pendulum(lower=-1.0, upper=1.0):
    made = Plant(0.01)
    inertia = SpatialInertia.SolidCapsuleWithMass(1.0, 0.05, 0.4, [0, 0, 1]).Shift([0, 0, 0.3])
    pole = made.plant.AddRigidBody("pole", inertia)
    hinge = made.plant.AddJoint(RevoluteJoint("hinge", made.plant.world_frame(), pole.body_frame(), [0, 1, 0]))
    hinge.set_position_limits([lower], [upper])
    made.plant.AddJointActuator("motor", hinge)
    return made.model()


def constrained(kind):
    made = Plant(0.01)
    plant = made.plant
    bodies = [plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1)) for name in ("one", "two")]
    rails = [add_slide(plant, b.name(), plant.world_frame(), b, "x") for b in bodies]
    if kind == "coupler":
        plant.AddCouplerConstraint(rails[0], rails[1], 2.0)
    elif kind == "distance":
        plant.AddDistanceConstraint(bodies[0], [0, 0, 0], bodies[1], [0, 0.5, 0], 0.6)
    elif kind == "ball":
        plant.AddBallConstraint(bodies[0], [0, 0, 0], bodies[1], [0.3, 0, 0])
    elif kind == "weld":
        plant.AddWeldConstraint(bodies[0], RigidTransform(), bodies[1], RigidTransform([0.3, 0, 0]))
    plant.AddJointActuator("push", rails[0])
    return made.model()


def springs_and_motors(*, limit=np.inf, kp=(0.0, 0.0, 0.0), gear=1.0, damping=0.2):
    """Return a sprung cart, a sprung pole on it and a pole on that, all driven, with PD control if a gain is given."""
    made = Plant(0.01)
    plant = made.plant
    cart = plant.AddRigidBody("cart", SpatialInertia.SolidSphereWithMass(1.5, 0.1))
    joints = [add_slide(plant, "rail", plant.world_frame(), cart, "x")]
    plant.AddForceElement(PrismaticSpring(joints[0], 0.2, 30.0))
    parent = cart
    for i in range(2):
        inertia = SpatialInertia.SolidCapsuleWithMass(0.8, 0.05, 0.4, [0, 0, 1]).Shift([0, 0, 0.3])
        pole = plant.AddRigidBody(f"pole{i}", inertia)
        frame = plant.AddFrame(FixedOffsetFrame(f"m{i}", parent.body_frame(), RigidTransform([0, 0, -0.6 * i])))
        joints.append(plant.AddJoint(RevoluteJoint(f"hinge{i}", frame, pole.body_frame(), [0, 1, 0])))
        plant.AddForceElement(RevoluteSpring(joints[-1], 0.3 * i, 4.0 + i))
        parent = pole
    for i, joint in enumerate(joints):
        joint.set_default_damping_vector([damping * (i + 1)])
        joint.set_default_positions([0.1 * i])
        motor = plant.AddJointActuator(f"motor{i}", joint, limit)
        motor.set_default_gear_ratio(gear)
        motor.set_default_rotor_inertia(0.01)
        if kp[i]:
            motor.set_controller_gains(PdControllerGains(p=kp[i], d=0.1 * kp[i]))
    return made.model()


POINT = [0.3, 0.5, -0.4, 0.2, -0.7, 1.1], [0.4, -0.3, 0.2]


def floating(joint_type, seed):
    """Return a free body with a sprung arm, which pushes the base."""
    made, random = Plant(0.01), np.random.default_rng(seed)
    plant = made.plant
    inertia = RotationalInertia(0.2, 0.3, 0.25, 0.01, -0.02, 0.015)
    base = plant.AddRigidBody("base", SpatialInertia.MakeFromCentralInertia(2.0, np.array([0.1, 0, 0.05]), inertia))
    arm = plant.AddRigidBody("arm", SpatialInertia.MakeFromCentralInertia(0.7, np.array([0, 0, -0.3]), inertia))
    if joint_type is not None:
        plant.AddJoint(joint_type("free", plant.world_frame(), base.body_frame()))
    pose = RigidTransform(random.standard_normal(3))
    frame = plant.AddFrame(FixedOffsetFrame("mount", base.body_frame(), pose))
    hinge = plant.AddJoint(RevoluteJoint("hinge", frame, arm.body_frame(), [0.0, 0.6, 0.8], 0.3))
    plant.AddForceElement(RevoluteSpring(hinge, 0.4, 5.0))
    plant.AddJointActuator("motor", hinge)
    return made.model()


def in_the_air(model, x):
    """Move free bodies 1 m up, and sliding bodies metres away from every body that they could touch."""
    if model.state_names[0].endswith("_qw"):
        x[6] = 1.0
    apart = {
        "two_spheres": {"slide_x": 3.0},
        "box_push": {"bx_x": 3.0},
        "hopper": {"z_x": 3.0},
        "finger_box": {"z_x": 3.0, "finger_z_x": 1.0},
        "two_fingers": {"z_x": 3.0, "left_z_x": 1.0, "right_z_x": 2.0},
    }
    for name, place in apart.get(model.name, {}).items():
        x[model.state_names.index(name)] = place
    return x


def random_tree(seed, joints=6):
    """Return a branching tree of hinges and slides with offset frames, welds, springs, damping and geared rotors."""
    random, made = np.random.default_rng(seed), Plant(0.01)
    plant = made.plant

    def body(name):
        com = random.uniform(-0.3, 0.3, 3)
        unit = UnitInertia.SolidEllipsoid(*random.uniform(0.1, 0.4, 3)).ShiftFromCenterOfMass(com)
        return plant.AddRigidBody(name, SpatialInertia(random.uniform(0.5, 3.0), com, unit))

    def frame(parent, name):
        pose = RigidTransform(RollPitchYaw(random.uniform(-2, 2, 3)), random.uniform(-0.5, 0.5, 3))
        return plant.AddFrame(FixedOffsetFrame(name, parent.body_frame(), pose))

    bodies = [plant.world_body()]
    for i in range(joints):
        parent, child = bodies[random.integers(len(bodies))], body(f"b{i}")
        axis, damping = random.standard_normal(3), random.uniform(0, 1)
        kind = RevoluteJoint if random.random() < 0.6 else PrismaticJoint
        on_parent, on_child = frame(parent, f"p{i}"), frame(child, f"c{i}")
        joint = plant.AddJoint(kind(f"j{i}", on_parent, on_child, axis / np.linalg.norm(axis), damping=damping))
        spring = RevoluteSpring if kind is RevoluteJoint else PrismaticSpring
        if random.random() < 0.5:
            plant.AddForceElement(spring(joint, random.uniform(-1, 1), random.uniform(1, 20)))
        if random.random() < 0.5:
            actuator = plant.AddJointActuator(f"m{i}", joint)
            actuator.set_default_rotor_inertia(random.uniform(0.01, 0.1))
            actuator.set_default_gear_ratio(random.uniform(1, 5))
        bodies.append(child)
        if random.random() < 0.4:
            welded = body(f"w{i}")
            plant.AddJoint(WeldJoint(f"weld{i}", frame(child, f"q{i}"), frame(welded, f"r{i}"), RigidTransform()))
            bodies.append(welded)
    return made.model()


def craft():
    """Return a hull that floats without gravity and is turned by three reaction wheels."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(time_step=0.05, use_sampled_output_ports=False, discrete_contact_approximation="sap")
    plant, _ = AddMultibodyPlant(config, builder)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
    hull = plant.AddRigidBody("hull", SpatialInertia.SolidBoxWithMass(10, 0.3, 0.4, 0.5))
    for i, axis in enumerate(np.eye(3)):
        wheel = plant.AddRigidBody(f"wheel_{i}", SpatialInertia.SolidSphereWithMass(1, 0.2))
        joint = plant.AddJoint(RevoluteJoint(f"axle_{i}", hull.body_frame(), wheel.body_frame(), axis))
        plant.AddJointActuator(f"motor_{i}", joint)
    plant.Finalize()
    return dd.model_from_diagram(builder.Build())


def tilted(model, angle=1.5):
    x0 = np.array(model.default_state)
    x0[:4] = [np.cos(angle / 2), *(np.sin(angle / 2) * np.array([1, 2, 3]) / np.sqrt(14))]
    return x0


def box_on_the_ground(kind="spheres", *, pusher=False):
    """Return a box of 2 kg on the ground, on four corner spheres or with hydroelastic contact."""
    plant = Plant(0.01, contact_model="point" if kind == "spheres" else "hydroelastic")
    ground, skin = contact_properties(2e4), contact_properties(2e4)
    if kind == "hydroelastic":
        AddRigidHydroelasticProperties(ground)
        AddCompliantHydroelasticProperties(0.05, 1e6, skin)
    plant.plant.RegisterCollisionGeometry(plant.plant.world_body(), RigidTransform(), HalfSpace(), "ground", ground)
    box = plant.plant.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(2, 0.2, 0.2, 0.2))
    rail = add_slide(plant.plant, "rail", plant.plant.world_frame(), box, "z")
    if pusher:
        plant.plant.AddJointActuator("press", rail)
    if kind == "spheres":
        for i, (a, b) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
            pose = RigidTransform([0.09 * a, 0.09 * b, -0.09])
            plant.plant.RegisterCollisionGeometry(box, pose, Sphere(0.01), f"corner_{i}", skin)
        body = GeometrySet(plant.plant.GetCollisionGeometriesForBody(box))
        plant.scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeWithin(body))
    else:
        plant.plant.RegisterCollisionGeometry(box, RigidTransform(), Box(0.2, 0.2, 0.2), "skin", skin)
    return plant.model()


def block_on_rails(time_step=0.01, friction=0.5, gravity=(0, 0, -9.81)):
    """Return a ball on an x and a z rail, which slides like a block, and its state at rest."""
    plant = Plant(time_step, "lagged")
    plant.ball("ball", 1.0, 0.1, contact_properties(2e4, 10, friction), "x", "z")
    plant.ground(contact_properties(2e4, 10, friction))
    plant.plant.mutable_gravity_field().set_gravity_vector(gravity)
    return plant.model(), np.array([0, 0.1 + gravity[2] / 1e4, 0, 0])


def tetrahedron_on_ground(tmp_path):
    (tmp_path / "t.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    plant = Plant(0.01)
    body = plant.plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.shape(body, Convex(str(tmp_path / "t.obj")), contact_properties(1e4))
    plant.ground(contact_properties(1e4))
    return plant.model()

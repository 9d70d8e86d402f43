"""Robots of example-robot-data with a motor in each joint and, as an option, feet and a ground.

Their meshes are skipped, so a foot is a sphere at the end of each chain.
"""

import warnings

import numpy as np
from pydrake.geometry import HalfSpace, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import BodyIndex, JointActuatorIndex, JointIndex, PdControllerGains
from pydrake.systems.framework import DiagramBuilder

import drake_diff as dd
from drake_diff.exceptions import ModelWarning
from drake_diff.model.load_file import read_into

from .models import contact_properties, robot_file

# Name of the file, and whether the robot has a floating base.
ROBOTS = {
    "solo12.urdf": True,
    "a1.urdf": True,
    "go2.urdf": True,
    "laikago.urdf": True,
    "bolt.urdf": True,
    "simple_humanoid.urdf": True,
    "ur5_robot.urdf": False,
    "panda.urdf": False,
    "z1.urdf": False,
    "kinova.urdf": False,
    "xarm7.urdf": False,
    "finger_edu.urdf": False,
    "so100.urdf": False,
    "allegro_left_hand.urdf": False,
}
FOOT = 0.02  # [m] radius of each foot


def example_robot(
    name,
    time_step=0.002,
    *,
    approximation="lagged",
    feet=False,
    stiffness=2e4,
    dissipation=0.5,
    friction=0.6,
    gains=None,
    leg=None,
):
    """Load the robot of a file; `gains` (kp, kd) gives every motor a PD controller inside the plant.

    With `leg`, the joint positions of one leg, the default state stands on its feet. Controllers hold that posture.
    """
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=time_step,
        contact_model="point",
        discrete_contact_approximation=approximation,
        use_sampled_output_ports=False,
    )
    plant, _ = AddMultibodyPlant(config, builder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        read_into(plant, robot_file(name))
    driven = {plant.get_joint_actuator(JointActuatorIndex(i)).joint().name() for i in range(plant.num_actuators())}
    joints = [plant.get_joint(JointIndex(i)) for i in range(plant.num_joints())]
    for joint in joints:
        if joint.num_velocities() == 1 and joint.name() not in driven:
            plant.AddJointActuator(f"motor_{joint.name()}", joint)
    if gains is not None:
        for i in range(plant.num_actuators()):
            plant.get_mutable_joint_actuator(JointActuatorIndex(i)).set_controller_gains(
                PdControllerGains(p=float(gains[0]), d=float(gains[1]))
            )
    parents = {joint.parent_body().name() for joint in joints}
    bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    base = next((b for b in bodies if b.name() not in {j.child_body().name() for j in joints}), None)
    if base is not None and not ROBOTS[name]:
        plant.WeldFrames(plant.world_frame(), base.body_frame())
    if feet:
        properties = contact_properties(2 * stiffness, dissipation, friction, 0.01)
        for body in bodies:
            if body.name() not in parents:
                plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(FOOT), f"{body.name()}_foot", properties)
        plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", properties)
    plant.Finalize()
    if leg is not None:
        _stand(plant, leg)
    return dd.model_from_diagram(builder.Build())


def _stand(plant, leg):
    """Set the default posture to that of `leg`, with the lowest foot on the ground."""
    jointed = [plant.get_joint(JointIndex(i)) for i in range(plant.num_joints())]
    for i, joint in enumerate(joint for joint in jointed if joint.num_velocities() == 1):
        joint.set_default_positions([leg[i % len(leg)]])
    (base,) = (plant.get_body(b) for b in plant.GetFloatingBaseBodies())
    plant.SetDefaultFloatingBaseBodyPose(base, RigidTransform())
    context = plant.CreateDefaultContext()
    bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    lowest = min(
        plant.EvalBodyPoseInWorld(context, body).translation()[2]
        for body in bodies
        if plant.GetCollisionGeometriesForBody(body)
    )
    plant.SetDefaultFloatingBaseBodyPose(base, RigidTransform([0, 0, FOOT - lowest]))


def state_in_range(model, random, speed=0.5):
    """Return a state: joints in the middle half of their range (+-1 rad without limits), base 1 m up, about upright."""
    plant = model.plant
    q = model.default_state[: model.nq].copy()
    for i in range(plant.num_joints()):
        joint = plant.get_joint(JointIndex(i))
        if joint.num_positions() != 1:
            continue
        lower, upper = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        if not (np.isfinite(lower) and np.isfinite(upper) and upper > lower):
            lower, upper = -1.0, 1.0
        q[joint.position_start()] = (lower + upper) / 2 + (upper - lower) / 4 * random.uniform(-1, 1)
    x = np.concatenate([q, speed * random.standard_normal(model.nv)])
    for body in (plant.get_body(b) for b in plant.GetFloatingBaseBodies()):
        start = body.floating_positions_start()
        turn = np.array([1.0, *(0.1 * random.standard_normal(3))])
        x[start : start + 4] = turn / np.linalg.norm(turn)
        x[start + 4 : start + 7] = [0.0, 0.0, 1.0]
    return x


def state_in_contact(model, random, depth=1e-3, speed=0.2):
    """Return a state in which the lowest foot of a floating robot is `depth` [m] in the ground."""
    plant = model.plant
    x = state_in_range(model, random, speed)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, x[: model.nq])
    heights = [
        plant.EvalBodyPoseInWorld(context, plant.get_body(BodyIndex(i))).translation()[2]
        for i in range(1, plant.num_bodies())
        if plant.GetCollisionGeometriesForBody(plant.get_body(BodyIndex(i)))
    ]
    (base,) = plant.GetFloatingBaseBodies()
    x[plant.get_body(base).floating_positions_start() + 6] -= min(heights) - FOOT + depth
    return x


def arm_beside_table(folder, link, table, *, at, scale=1.0, **options):
    """Load two links of a shape on hinges about y and z, and a table near them that is welded to the world."""
    inertial = "<inertial><mass>1</mass></inertial>"
    shape = "<collision name='c'><pose>{0} 0 0 0 1.5707963267948966 0</pose><geometry>{1}</geometry></collision>"
    links, joints, middle = "", "", 0.15 * scale
    for name, parent, axis, x in (("upper", "world", "0 1 0", 0.0), ("lower", "upper", "0 0 1", 0.32 * scale)):
        links += f"<link name='{name}'><pose>{x} 0 0 0 0 0</pose>{inertial}{shape.format(middle, link)}</link>"
        joints += f"<joint name='at {name}' type='revolute'><parent>{parent}</parent><child>{name}</child>"
        joints += f"<axis><xyz>{axis}</xyz></axis></joint>"
    top = f"<link name='top'><pose>{' '.join(map(str, at))} 0 0 0</pose>{inertial}<collision name='c'><geometry>{table}"
    top += "</geometry></collision></link><joint name='t' type='fixed'><parent>world</parent><child>top</child></joint>"
    path = folder / "scene.sdf"
    path.write_text(f"<sdf version='1.9'><model name='m'>{links}{joints}{top}</model></sdf>")
    return dd.load_model(path, time_step=0.02, contact=False, **options)

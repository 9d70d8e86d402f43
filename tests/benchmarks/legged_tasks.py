"""Tasks of legged robots: stand up, lower, lift a foot, jump in place and forward, trot, recover from a push.

Each start is random: the feet near those of a posture, the position and rotation of the base, and the velocity of a
push. A PD controller brings the robot to rest. A task gives the standing feet of each phase and the final pose.
"""

from collections.abc import Sequence
from functools import cache, partial

import numpy as np
from contact_task import Task, Tasks
from helpers.legged import FRICTION, LEGGED, legged_model, rest, robot_on_feet
from pydrake.geometry import HalfSpace, ProximityProperties
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import JacobianWrtVariable, JointActuatorIndex, JointIndex
from pydrake.systems.framework import DiagramBuilder

import drake_diff as dd

TIME_STEP, OF_JUMPS = 0.02, 0.01  # [s]; in a jump at 1 m/s a foot moves by a third of its size in 10 ms
PUSH, SPIN = 0.35, 0.5  # [m/s], [rad/s] largest push of Solo12; PUSH scales with the root of a robot's height
HEIGHTS = {"solo12": 0.23, "go2": 0.31, "anymal": 0.45, "cheetah": 0.27}  # [m] of the standing robot's base
AT_PLACE, AT_REST, LEVEL, SPINS = 0.05, 0.3, 0.1, 1.0  # [m], [m/s], [rad], [rad/s] of the base at the end
SWING = 0.15  # height of a lifted foot, relative to the base's height
IN_AIR = 0.01  # [m] minimum height of each swinging foot in the middle of its swing
OPTIONS = {"method": "ilqr", "tolerance": 1e-4, "max_iterations": 100}

Phases = Sequence[tuple[float, Sequence[str]]]  # [s], and the standing feet


def stand_up(robot, random, h=TIME_STEP):
    high, low = LEGGED[robot].high, LEGGED[robot].low
    return _task(robot, random, h, "stand", low, high, [(0.6, ALL)], "stands up from a crouch")


def lower(robot, random, h=TIME_STEP):
    high, low = LEGGED[robot].high, LEGGED[robot].low
    return _task(robot, random, h, "lower", high, low, [(0.6, ALL)], "lowers its body")


def lift(robot, random, h=TIME_STEP):
    high = LEGGED[robot].high
    phases = [(0.5, ALL), (0.5, (1, 2, 3)), (0.3, ALL)]
    return _task(robot, random, h, "lift", high, high, phases, "shifts its weight and lifts a foot for half a second")


def jump(robot, random, h=OF_JUMPS):
    high = LEGGED[robot].high
    return _task(robot, random, h, "jump", high, high, [(0.4, ALL), (0.16, ()), (0.5, ALL)], "jumps and lands")


def forward(robot, random, h=OF_JUMPS):
    high = LEGGED[robot].high
    phases = [(0.4, ALL), (0.16, ()), (0.5, ALL)]
    way = 0.5 * HEIGHTS[robot]
    return _task(robot, random, h, "forward", high, high, phases, f"jumps {way:.2f} m forward and lands", way=way)


def trot(robot, random, h=None):
    h = h or (OF_JUMPS if robot == "anymal" else TIME_STEP)
    high, way = LEGGED[robot].high, 0.6 * HEIGHTS[robot]
    one, other = (0, 3), (1, 2)
    phases = [(0.1, ALL), (0.16, one), (0.04, ALL), (0.16, other), (0.04, ALL), (0.16, one), (0.4, ALL)]
    return _task(robot, random, h, "trot", high, high, phases, f"trots three steps, {way:.2f} m forward", way=way)


def push(robot, random, h=TIME_STEP):
    high = LEGGED[robot].high
    return _task(robot, random, h, "push", high, high, [(1.0, ALL)], "comes to rest after a push", pushed=True)


ALL = (0, 1, 2, 3)
KINDS = {"stand": stand_up, "lower": lower, "lift": lift, "jump": jump, "forward": forward, "trot": trot, "push": push}
ROBOTS = [robot for robot, facts in LEGGED.items() if facts.is_installed and not facts.is_flat]
TASKS: Tasks = {f"{robot}_{kind}": partial(make, robot) for robot in ROBOTS for kind, make in KINDS.items()}


def _task(robot, random, h, kind, first, last, phases, text, *, way=0.0, pushed=False):
    model, facts = legged_model(robot, h), LEGGED[robot]
    nq = model.nq
    x0 = rest(robot, model, np.array(first), random)
    end = np.array(_posture(robot, h, last))
    end[4:6] = x0[4] + way, x0[5]
    if pushed:
        x0[nq:] = _pushed(robot, model, x0, random)
    steps = [(round(seconds / h), [facts.feet[i] for i in feet]) for seconds, feet in phases]
    problem, guess, asks = scheduled_problem(model, facts, x0, end, steps, SWING * HEIGHTS[robot])
    plant = _kinematics(robot)
    knot = 0
    for count, standing in steps:
        middle, swinging = knot + count // 2, [foot for foot in facts.feet if foot not in standing]
        asks += [
            (f"{foot} short of its clearance [m]", partial(_low, plant, facts, foot, middle), 0.0) for foot in swinging
        ]
        knot += count
    return Task(
        name=f"{robot}_{kind}",
        problem=problem,
        goal_text=text,
        options={**OPTIONS, "initial_guess": guess},
        asks=tuple(asks),
        build=partial(build, robot, h),
    )


def scheduled_problem(model, facts, x0, end, steps, swing):
    """Return (problem, guess, the referee's measures of the base) of a robot that comes to rest at `end`."""
    schedule = dd.optimize.ContactSchedule(steps, feet=facts.feet)
    guess = schedule.guess(model, x0, end, swing=swing)
    goals = [
        schedule,
        dd.FrameGoal(facts.base, position=end[4:7], tolerance=AT_PLACE),
        dd.FrameVelocityGoal(facts.base, tolerance=AT_REST, angular_velocity=(0.0, 0.0, 0.0), angular_tolerance=SPINS),
        dd.KeepLevel(facts.base, tolerance=LEVEL, knots=-1),
    ]
    follow = schedule.follow(model, guess)
    asks = [
        ("base from its place [m]", partial(off_place, end[4:7]), AT_PLACE),
        ("base from level [rad]", tilt, LEVEL),
        ("speed of the base [m/s]", partial(speed, model.nq), AT_REST),
    ]
    return dd.Problem(model, x0=x0, num_steps=schedule.num_steps, goals=goals, **follow), guess, asks


@cache
def _posture(robot, h, joints):
    """Return the posture (nq,) of the robot at rest with its joints near `joints`."""
    model = legged_model(robot, h)
    return tuple(rest(robot, model, np.array(joints))[: model.nq])


def _pushed(robot, model, x0, random):
    """Return the velocities (nv,) of a pushed base, and of joints that keep the feet at rest."""
    plant, facts = model.plant, LEGGED[robot]
    part = np.sqrt(HEIGHTS[robot] / HEIGHTS["solo12"])
    v = np.zeros(model.nv)
    v[:3] = SPIN * random.uniform(-1, 1, 3)
    v[3:5] = PUSH * part * random.uniform(-1, 1, 2)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, x0[: model.nq])
    rows = []
    for foot in facts.feet:
        frame = plant.GetBodyByName(foot).body_frame()
        kind, world = JacobianWrtVariable.kV, plant.world_frame()
        rows.append(plant.CalcJacobianTranslationalVelocity(context, kind, frame, np.zeros(3), world, world))
    by_v = np.vstack(rows)
    v[6:] = -np.linalg.lstsq(by_v[:, 6:], by_v[:, :6] @ v[:6], rcond=None)[0]
    return v


# The measurements of the referee, with Drake alone.


def build(robot, h, time_step):
    """Return Drake's (plant, diagram) of the robot with feet for steps of h. A `time_step` of 0 is continuous time."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=time_step,
        contact_model="point",
        discrete_contact_approximation="sap",
        sap_near_rigid_threshold=0.1,
        use_sampled_output_ports=False,
    )
    plant, _ = AddMultibodyPlant(config, builder)
    Parser(plant).AddModels(str(robot_on_feet(robot, h)))
    driven = {plant.get_joint_actuator(JointActuatorIndex(i)).joint().name() for i in range(plant.num_actuators())}
    for i in range(plant.num_joints()):
        joint = plant.get_joint(JointIndex(i))
        if joint.num_velocities() == 1 and joint.name() not in driven:
            plant.AddJointActuator(joint.name(), joint)
    ground = ProximityProperties()
    ground.AddProperty("material", "coulomb_friction", CoulombFriction(FRICTION, FRICTION))
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", ground)
    plant.Finalize()
    return plant, builder.Build()


@cache
def _kinematics(robot):
    """Return a plant and a context that are only used for kinematics."""
    plant, _ = build(robot, TIME_STEP, TIME_STEP)
    return plant, plant.CreateDefaultContext()


def off_place(place, xs, us):
    return float(np.linalg.norm(xs[-1, 4:7] - place))


def tilt(xs, us):
    _, x, y, _ = xs[-1, :4] / np.linalg.norm(xs[-1, :4])
    return float(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1)))


def speed(nq, xs, us):
    return float(np.linalg.norm(xs[-1, nq + 3 : nq + 6]))


def _low(twin, facts, foot, knot, xs, us):
    plant, context = twin
    plant.SetPositions(context, xs[knot, : plant.num_positions()])
    height = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(foot)).translation()[2] - facts.radius
    return float(max(IN_AIR - height, 0.0))

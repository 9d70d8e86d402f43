"""Claims of `converged` on 20 tasks with random starts and goals, by every method, each judged by `referee.py`."""

import tempfile
import warnings
import xml.etree.ElementTree as ET
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pydrake.math as pm
from helpers.models import MODELS, robot_file
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, DiscreteContactApproximation, MultibodyPlant
from pydrake.symbolic import Variable
from pydrake.systems.framework import DiagramBuilder, InputPortIndex
from pydrake.systems.primitives import SymbolicVectorSystem
from referee import judge
from solving import solve_with
from trust import Figure

import drake_diff as dd
from drake_diff.exceptions import ModelWarning

COUNT = 1000
NAMED = 0.05  # of a state's range: what a claim allows itself, and says so
CLOSE = 0.01  # told apart: how many of the claims are that good
ENOUGH = 0.8  # of all: a checker that says yes to nothing is worth nothing
BLOCK = """<robot name="block"><link name="world"/><link name="block"><inertial><mass value="{mass}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="world"/><child link="block"/><axis xyz="1 0 0"/>
<limit effort="{effort}" lower="-100" upper="100"/><dynamics damping="{damping}"/></joint>
<transmission name="push"><type>transmission_interface/SimpleTransmission</type><joint name="slide"/>
<actuator name="push"/></transmission></robot>"""
FREE = np.nan
FOLDER = tempfile.TemporaryDirectory()


def effort(nu, weight=1.0):
    return dd.QuadraticCost(R=weight * np.eye(nu))


# ------------------------------------------------------------------------------ plants, for the referee


def plant_of(path):
    """The plant in a file without contact, as the referee builds it."""

    def build(step):
        plant = MultibodyPlant(step)
        plant.SetUseSampledOutputPorts(False)
        Parser(plant).AddModels(str(path))
        plant.Finalize()
        return plant, plant.get_actuation_input_port().get_index(), plant.get_state_output_port().get_index()

    return build


def touching(path):
    """The same with contact, in a diagram."""

    def build(step):
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, step)
        if step:
            plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
        plant.SetUseSampledOutputPorts(False)
        Parser(plant).AddModels(str(path))
        plant.Finalize()
        builder.ExportInput(plant.get_actuation_input_port())
        builder.ExportOutput(plant.get_state_output_port())
        return builder.Build(), InputPortIndex(0), 0

    return build


def formula(f, nx, nu):
    """x' = f(x, u) as a system of Drake's expressions."""

    def build(_):
        x, u = ([Variable(f"{name}{i}") for i in range(n)] for name, n in (("x", nx), ("u", nu)))
        return SymbolicVectorSystem(state=x, input=u, dynamics=f(x, u, pm), output=x), InputPortIndex(0), 0

    return build


def block_file(mass, effort, damping):
    path = Path(FOLDER.name) / f"block_{mass:.6f}_{effort:.6f}_{damping:.6f}.urdf"
    path.write_text(BLOCK.format(mass=mass, effort=effort, damping=damping))
    return path


def arm_file(name):
    """A robot of example-robot-data without shapes, welded to the world, with a motor in each joint."""
    path = Path(FOLDER.name) / name
    if path.exists():
        return path
    root = ET.parse(robot_file(name)).getroot()
    for parent in root.iter("link"):
        for kind in ("visual", "collision"):
            for shape in parent.findall(kind):
                parent.remove(shape)
    for old in root.findall("transmission"):
        root.remove(old)
    joints = root.findall("joint")
    for joint in joints:
        if joint.get("type") == "prismatic":  # of a gripper
            joint.set("type", "fixed")
        elif joint.get("type") in ("revolute", "continuous"):
            motor = ET.SubElement(root, "transmission", name=f"{joint.get('name')}_motor")
            ET.SubElement(motor, "type").text = "transmission_interface/SimpleTransmission"
            ET.SubElement(motor, "joint", name=joint.get("name"))
            ET.SubElement(motor, "actuator", name=joint.get("name"))
    children = {joint.find("child").get("link") for joint in joints}
    base = next(link.get("name") for link in root.findall("link") if link.get("name") not in children)
    if base != "world":
        ET.SubElement(root, "link", name="world")
        weld = ET.SubElement(root, "joint", name="to_the_world", type="fixed")
        ET.SubElement(weld, "parent", link="world")
        ET.SubElement(weld, "child", link=base)
    path.write_bytes(ET.tostring(root))
    return path


# ------------------------------------------------------------------------------ tasks: (problem, options, build)


def any_scheme(random):
    return str(random.choice(["hermite_simpson", "hermite_simpson", "trapezoid", "drake"]))


def block_in_least_time(random):
    mass, force, way = random.uniform(0.5, 2), random.uniform(0.5, 3), random.uniform(0.1, 3)
    path, count = block_file(mass, force, 0.0), int(random.integers(8, 30))
    model = dd.load_model(path, time_step=2 * np.sqrt(way * mass / force) / count)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[way, 0], num_steps=count, horizon=(0.05, 30), running_cost=1.0)
    return problem, {"method": "collocation", "scheme": any_scheme(random)}, plant_of(path)


def block_with_a_top_speed(random):
    mass, force, way = random.uniform(0.5, 2), random.uniform(0.5, 3), random.uniform(0.1, 3)
    path, count = block_file(mass, force, 0.1), int(random.integers(10, 40))
    top = random.uniform(0.3, 0.9) * np.sqrt(way * force / mass)
    model = dd.load_model(path, time_step=2 * np.sqrt(way * mass / force) / count)
    bounds = dd.Bounds(x_lower=[FREE, -top], x_upper=[FREE, top])
    problem = dd.Problem(
        model, x0=[0, 0], x_goal=[way, 0], num_steps=count, horizon=(0.05, 60), running_cost=1.0, bounds=bounds
    )
    return problem, {"method": "collocation", "scheme": any_scheme(random)}, plant_of(path)


def plain_block_in_least_time(random):
    force, drag, way, top = (
        random.uniform(0.5, 3),
        random.uniform(0, 0.5),
        random.uniform(0.05, 3),
        random.uniform(0.4, 2),
    )

    def f(x, u, _=None):
        return [x[1], u[0] - drag * x[1]]

    dynamics = dd.Dynamics(lambda x, u: f(x, u), 2, 1, u_lower=[-force], u_upper=[force], x_upper=[np.inf, top])
    problem = dd.Problem(
        dynamics,
        x0=[0, 0],
        x_goal=[way, 0],
        num_steps=int(random.integers(6, 30)),
        horizon=(0.05, 30),
        running_cost=1.0,
    )
    return problem, {"scheme": any_scheme(random)}, formula(f, 2, 1)


def block_at_its_limit(random):
    """6 d / T^2 is the largest input without a limit, 4 d / T^2 the least limit that will do."""
    mass, way, time = random.uniform(0.5, 2), random.uniform(0.1, 3), random.uniform(0.5, 2)
    force, count = random.uniform(4.1, 6) * way * mass / time**2, int(random.integers(8, 40))
    path = block_file(mass, force, 0.0)
    model = dd.load_model(path, time_step=time / count)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[way, 0], num_steps=count, running_cost=effort(1))
    method = str(random.choice(["collocation", "ilqr", "shooting"]))
    more = {"scheme": any_scheme(random)} if method == "collocation" else {}
    return problem, {"method": method, **more}, plant_of(path)


def block_below_a_ceiling(random):
    """Bryson and Denham: the ceiling is active below a quarter."""
    ceiling, count, h = random.uniform(0.08, 0.24), int(random.integers(8, 40)), 1.0
    path = block_file(1.0, 100.0, 0.0)
    model = dd.load_model(path, time_step=h / count)
    bounds = dd.Bounds(x_upper=[ceiling, FREE])
    problem = dd.Problem(model, x0=[0, 1], x_goal=[0, -1], num_steps=count, running_cost=effort(1), bounds=bounds)
    return problem, {"method": "collocation", "scheme": any_scheme(random)}, plant_of(path)


def block_under_a_constraint(random):
    top, count = random.uniform(1.05, 1.45), int(random.integers(8, 40))
    path = block_file(1.0, 100.0, 0.0)
    slow = dd.Constraint(lambda x: x[1], upper=top, name="slow")
    model = dd.load_model(path, time_step=1 / count)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=count, running_cost=effort(1), constraints=slow)
    return problem, {"method": "auto"}, plant_of(path)


def swing(name, x0, goal, limit, h, count, **options):
    model = dd.load_model(MODELS / name, time_step=h)
    bounds = dd.Bounds(u_lower=[-limit] * model.nu, u_upper=[limit] * model.nu)
    problem = dd.Problem(model, x0=x0, x_goal=goal, num_steps=count, running_cost=effort(model.nu), bounds=bounds)
    return problem, options, plant_of(MODELS / name)


def pendulum_swings_up(random):
    start = random.uniform(-1, 1, 2) * [1, 2]
    return swing("pendulum.urdf", start, [np.pi, 0], random.uniform(3, 6), 0.05, 40, method="auto")


def pendulum_in_least_time(random):
    problem, _, build = swing("pendulum.urdf", random.uniform(-1, 1, 2), [np.pi, 0], random.uniform(4, 7), 0.05, 30)
    problem = dd.Problem(
        problem.model,
        x0=problem.x0,
        x_goal=[np.pi, 0],
        num_steps=30,
        horizon=(0.2, 5),
        running_cost=1.0,
        bounds=problem.bounds,
    )
    return problem, {"scheme": any_scheme(random)}, build


def pendulum_by_steps(random):
    start = random.uniform(-1, 1, 2) * [1, 2]
    method = str(random.choice(["shooting", "ilqr"]))
    return swing(
        "pendulum.urdf", start, [np.pi, 0], random.uniform(4, 8), random.choice([0.02, 0.05]), 40, method=method
    )


def cart_pole_swings_up(random):
    """The cart has 4 m of track; it is given less."""
    path = MODELS / "cart_pole.urdf"
    model = dd.load_model(path, time_step=0.04)
    track, top = random.uniform(0.7, 1.5), random.uniform(12, 20)
    bounds = dd.Bounds(x_lower=[-track, *[FREE] * 3], x_upper=[track, *[FREE] * 3], u_lower=[-top], u_upper=[top])
    start = random.uniform(-1, 1, 4) * [0.5, 0.5, 0.5, 0.5]
    goal = [random.uniform(-0.6, 0.6), np.pi, 0, 0]
    problem = dd.Problem(model, x0=start, x_goal=goal, num_steps=50, running_cost=effort(1), bounds=bounds)
    return problem, {"method": "collocation", "scheme": any_scheme(random)}, plant_of(path)


def cart_pole_by_steps(random):
    path = MODELS / "cart_pole.urdf"
    model = dd.load_model(path, time_step=0.02)
    start, goal = random.uniform(-0.5, 0.5, 4), [random.uniform(-0.5, 0.5), np.pi, 0, 0]
    problem = dd.Problem(model, x0=start, x_goal=goal, num_steps=100, running_cost=effort(1))
    return problem, {"method": "ilqr"}, plant_of(path)


def double_pendulum_moves(random):
    start, goal = (np.concatenate([random.uniform(-1.5, 1.5, 2), np.zeros(2)]) for _ in range(2))
    return swing("double_pendulum.urdf", start, goal, random.uniform(15, 30), 0.02, 50, method="auto")


def double_pendulum_in_segments(random):
    start, goal = (np.concatenate([random.uniform(-1, 1, 2), np.zeros(2)]) for _ in range(2))
    options = {"method": "shooting"}
    return swing("double_pendulum.urdf", start, goal, 40.0, 0.02, 30, **options)


def acrobot_balances(random):
    start = np.array([np.pi, 0, 0, 0]) + random.uniform(-0.3, 0.3, 4)
    return swing("acrobot.xml", start, [np.pi, 0, 0, 0], 25.0, 0.04, 40, method="auto")


@cache
def loaded(path, time_step):
    """Once: the equations of an arm in symbols take seconds."""
    return dd.load_model(path, time_step=time_step)


def reach(name, random, count, time, fraction, horizon=None):
    """From a place in the middle half of its joints' range to another one, with a part of its speeds."""
    path = arm_file(name)
    model = loaded(path, time / count)
    plant = model.plant
    lower, upper = (
        np.clip(side, -2.5, 2.5) for side in (plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits())
    )
    middle, half, still = (lower + upper) / 2, (upper - lower) / 2, np.zeros(model.nv)
    start = middle + half * random.uniform(-0.4, 0.4, model.nq)
    goal = middle + half * random.uniform(-0.4, 0.4, model.nq)
    fastest = 1.5 * np.abs(goal - start) / time  # of the least effort of free joints
    top = np.maximum(np.where(fastest > 0.2, fraction * fastest, 10.0), 0.1)
    bounds = dd.Bounds(x_lower=[*[FREE] * model.nq, *-top], x_upper=[*[FREE] * model.nq, *top])
    cost = 1.0 if horizon else effort(model.nu, 1e-3)
    problem = dd.Problem(
        model,
        x0=[*start, *still],
        x_goal=[*goal, *still],
        num_steps=count,
        running_cost=cost,
        bounds=bounds,
        horizon=horizon,
    )
    options = {"method": "collocation", "max_iterations": 100}
    return problem, options | {"refine": True, "error_tolerance": 1e-4, "max_num_steps": 4 * count}, plant_of(path)


def panda_reaches(random):
    return reach("panda.urdf", random, 20, 1.0, random.uniform(0.85, 1.2))


def ur_reaches(random):
    return reach(
        str(random.choice(["ur3_robot.urdf", "ur5_robot.urdf", "ur10_robot.urdf"])),
        random,
        20,
        1.0,
        random.uniform(0.85, 1.2),
    )


def finger_in_least_time(random):
    return reach("finger_edu.urdf", random, 25, 0.6, 0.9, horizon=(0.05, 5))


def quadrotor_flies(random):
    m, r, inertia = 0.486, 0.25, 0.00383

    def f(x, u, math=np):
        push = (u[0] + u[1]) / m
        return [x[3], x[4], x[5], -push * math.sin(x[2]), push * math.cos(x[2]) - 9.81, r * (u[0] - u[1]) / inertia]

    top, hover = random.uniform(3.2, 6), m * 9.81 / 2
    dynamics = dd.Dynamics(lambda x, u: f(x, u), 6, 2, u_lower=[0.5, 0.5], u_upper=[top, top])
    goal = [*random.uniform(-1, 1, 2), 0, 0, 0, 0]
    count, quick = 25, random.random() < 0.5
    cost = 1.0 if quick else (lambda x, u: (u[0] - hover) ** 2 + (u[1] - hover) ** 2)
    guess = np.linspace(np.zeros(6), goal, count + 1), np.full((count + 1, 2), hover)
    horizon = (0.2, 4) if quick else 1.2
    problem = dd.Problem(dynamics, x0=np.zeros(6), x_goal=goal, num_steps=count, horizon=horizon, running_cost=cost)
    return problem, {"initial_guess": guess, "max_iterations": 300, "scheme": any_scheme(random)}, formula(f, 6, 2)


def oscillator_stays_above(random):
    def f(x, u, _=None):
        return [(1 - x[1] * x[1]) * x[0] - x[1] + u[0], x[0]]

    floor = -random.uniform(0.1, 0.4)
    dynamics = dd.Dynamics(lambda x, u: f(x, u), 2, 1, u_lower=[-1], u_upper=[1], x_lower=[floor, -np.inf])
    start = [0, random.uniform(0.5, 1)]
    count = int(random.integers(15, 60))
    problem = dd.Problem(
        dynamics, x0=start, num_steps=count, horizon=5.0, running_cost=dd.QuadraticCost(np.eye(2), [[1]])
    )
    return problem, {"scheme": any_scheme(random)}, formula(f, 2, 1)


def ball_is_pushed(random):
    path = MODELS / "two_spheres.sdf"
    model = dd.load_model(path, time_step=float(random.choice([0.01, 0.02])))
    gap, goal = random.uniform(-0.001, 0.003), random.uniform(0.4, 1.0)
    problem = dd.Problem(
        model,
        x0=[0, 0.2 + gap, 0, 0],
        num_steps=40,
        running_cost=effort(1, 1e-3),
        x_goal=[FREE, 0.2 + goal, FREE, FREE],
    )
    return problem, {"method": "auto", "max_iterations": 100}, touching(path)


TASKS = [
    block_in_least_time, block_with_a_top_speed, plain_block_in_least_time, block_at_its_limit, block_below_a_ceiling,
    block_under_a_constraint, pendulum_swings_up, pendulum_in_least_time, pendulum_by_steps, cart_pole_swings_up,
    cart_pole_by_steps, double_pendulum_moves, double_pendulum_in_segments, acrobot_balances, panda_reaches,
    ur_reaches, finger_in_least_time, quadrotor_flies, oscillator_stays_above, ball_is_pushed,
]  # fmt: skip


def plan_of(solution, build):
    """What the referee gets: functions of time out of the solution's own arrays, as it documents them."""
    problem, times, xs, us = solution.problem, solution.times, solution.xs, solution.us
    ends, middle, b = solution.inputs_at_knots, solution.us_mid, problem.bounds
    top = np.array(b.x_upper)
    for constraint in problem.constraints:  # of speeds, all of them
        top[1] = min(top[1], constraint.upper[0])

    def u(t):
        k = min(max(int(np.searchsorted(times, t, side="right")) - 1, 0), len(us) - 1)
        if len(ends) == len(us):
            return us[k]
        s = (t - times[k]) / (times[k + 1] - times[k])
        mid = (ends[k] + ends[k + 1]) / 2 if middle is None else middle[k]
        return ends[k] * (1 - s) * (1 - 2 * s) + mid * 4 * s * (1 - s) + ends[k + 1] * s * (2 * s - 1)

    if solution.scheme == "step":
        at, dense = times, xs
    else:
        at = np.linspace(0, times[-1], 10 * len(us) + 1)
        dense = solution.transcribed.at(at)[0]
    return {
        "build": build,
        "T": float(times[-1]),
        "u": u,
        "x": lambda t: np.array([np.interp(t, at, column) for column in dense.T]),
        "goal": np.full(problem.nx, np.nan) if problem.x_goal is None else np.array(problem.x_goal),
        "nq": problem.model.nq if problem.has_model else 0,
        "x_lower": b.x_lower, "x_upper": top, "u_lower": b.u_lower, "u_upper": b.u_upper,
    }  # fmt: skip


def case(seed, number):
    """(task, solution, why it is false if it claims to be true, its worst miss as a part of the range)."""
    task = TASKS[number % len(TASKS)]
    problem, options, build = task(np.random.default_rng([seed, number]))
    solution = solve_with(problem, **options)
    if not solution.success:
        return task, solution, "", 0.0
    plan, h = plan_of(solution, build), solution.time_step
    steps = (0.0,) if solution.scheme != "step" else (h, h / 2, h / 8)
    found = [judge(plan, step, NAMED) for step in steps]
    return task, solution, next((why for why, _ in found if why), ""), max(miss for _, miss in found)


def measure(seed, count, told=print):
    """The figures of `count` cases, and a line for each false claim and each task."""
    warnings.simplefilter("ignore", ModelWarning)
    claims, false, close, said, wrong = 0, 0, 0, Counter(), Counter()
    for number in range(count):
        task, solution, why, miss = case(seed, number)
        how = f"{solution.method} {solution.scheme}"
        said[how, solution.success] += 1
        claims, close = claims + solution.success, close + (solution.success and miss <= CLOSE)
        if why:
            false, wrong[how] = false + 1, wrong[how] + 1
            told(f"  FALSE, case {number}, {task.__name__}, {how}: {why}")
    for how in sorted({how for how, _ in said}):
        told(f"  {how}: {said[how, True]} of {said[how, True] + said[how, False]} converged, {wrong[how]} false")
    told(f"  within {CLOSE:.0%} of their ranges: {close} of {claims}")
    return [
        Figure("claims of converged that are false", false, max(claims, 1), 0.0, False),
        Figure("cases that end converged", claims, count, ENOUGH, True),
    ]

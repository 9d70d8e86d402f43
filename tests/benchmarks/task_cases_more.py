"""Tasks from textbooks, and of rockets and vehicles, some with an optimum in closed form; see `task_cases.py`."""

from functools import cache, partial
from pathlib import Path

import numpy as np
import task_formulas as by_hand
from scipy.optimize import brentq
from task_cases import (
    ANY,
    FREE,
    Case,
    arm_file,
    bounded,
    effort,
    hand_misses,
    keep_off,
    kinematics,
    near_rest,
    places,
    plain,
    posture,
    skeleton_enters,
)
from task_plants import FOLDER, loaded, plant_of

import drake_diff as dd


def with_optimum(case, optimum, asks=()):
    return Case(case.problem, case.build, asks, case.peer, optimum=optimum)


# ------------------------------------------------------------------------------ textbooks


def bryson_denham(random):
    """Move a block below a ceiling l. The least effort is 4 + 12 (1 - 4 l)^2 for l in [1/6, 1/4], 8 / (9 l) below."""
    ceiling = random.uniform(0.06, 0.24)
    limits = ([-ANY, -ANY], [ceiling, ANY]), ([-ANY], [ANY])
    least = 8 / (9 * ceiling) if ceiling <= 1 / 6 else 4 + 12 * (1 - 4 * ceiling) ** 2
    f = partial(by_hand.block, mass=1.0, damping=0.0)
    case = plain(f, 2, 1, limits=limits, x0=[0, 1], goal=[0, -1], count=40, horizon=1.0, cost=effort(1))
    return with_optimum(case, least)


def brachistochrone(random):
    """Find the brachistochrone. The cycloid r (a - sin a), r (1 - cos a) takes the time a sqrt(r / g)."""
    wide, deep = random.uniform(0.5, 3), random.uniform(0.5, 3)
    a = brentq(lambda a: wide * (1 - np.cos(a)) - deep * (a - np.sin(a)), 1e-3, 2 * np.pi - 1e-6)
    limits = ([-ANY] * 3, [ANY] * 3), ([0], [np.pi])
    goal, f = [wide, deep, FREE], by_hand.sliding_bead
    case = plain(f, 3, 1, limits=limits, x0=np.zeros(3), goal=goal, count=40, horizon=(0.05, 10), cost=1.0)
    return with_optimum(case, float(a * np.sqrt(deep / (1 - np.cos(a)) / by_hand.GRAVITY)))


def hanging_chain(random):
    """Find the chain of given length with the least moment between two heights 1 m apart, which is a catenary."""
    left, right = random.uniform(1, 3), random.uniform(1, 3)
    length = np.hypot(1, right - left) * random.uniform(1.1, 2.0)
    # y = c cosh((s - b) / c) + d: the length gives c, the difference of heights b
    c = brentq(lambda c: 2 * c * np.sinh(1 / (2 * c)) - np.sqrt(length**2 - (right - left) ** 2), 0.05, 50)
    b = 0.5 - c * np.arcsinh((right - left) / (2 * c * np.sinh(1 / (2 * c))))
    d = left - c * np.cosh(b / c)
    s = np.linspace(0, 1, 20001)
    height, along = c * np.cosh((s - b) / c) + d, np.cosh((s - b) / c)
    limits = ([-ANY] * 3, [ANY] * 3), ([-20], [20])
    case = plain(by_hand.chain, 3, 1, limits=limits, x0=[left, 0, 0], goal=[right, FREE, length], count=40,
                 horizon=1.0, cost=None, final_cost=lambda x: x[1])  # fmt: skip
    return with_optimum(case, float(np.trapezoid(height * along, s)))


def goddard_rocket(random):
    """Maximize the height of a rocket with limited fuel. The optimum is 1.01283 radii."""
    start = [1.0, 0.0, 1.0]
    limits = ([1, 0, 0.6], [ANY, ANY, 1]), ([0], [3.5])
    horizon = (0.05, random.uniform(0.3, 1.0))
    case = plain(by_hand.goddard, 3, 1, limits=limits, x0=start, goal=[FREE, FREE, 0.6], count=60, horizon=horizon,
                 cost=None, final_cost=lambda x: -x[0])  # fmt: skip
    return with_optimum(case, -1.01283)


def orbit_transfer(random):
    """Maximize the radius of a circular orbit from radius 1 in a given time. In time 3.32, it is 1.5252."""
    time = random.uniform(2.5, 4.5)
    limits = ([0.5, -ANY, -ANY, 0.1], [5, ANY, ANY, 1]), ([-2 * np.pi], [2 * np.pi])
    circle = dd.Constraint(lambda x: x[2] ** 2 * x[0], lower=1, upper=1, knots=-1, name="a circle")

    def apart(_, xs):
        return float(abs(xs[-1, 2] ** 2 * xs[-1, 0] - 1))

    case = plain(by_hand.sailing_orbit, 4, 1, limits=limits, x0=[1, 0, 1, 1], goal=[FREE, 0, FREE, FREE], count=50,
                 horizon=time, cost=None, final_cost=lambda x: -x[0], constraints=[circle])  # fmt: skip
    return Case(case.problem, case.build, (("off a circle", apart, 0.02),), case.peer)


def van_der_pol(random):
    top, low = random.uniform(0.85, 1.0), random.uniform(0.25, 0.4)
    limits = ([-low, -ANY], [ANY, ANY]), ([-top], [top])
    cost = dd.QuadraticCost(Q=np.eye(2), R=[[1.0]])
    return plain(by_hand.van_der_pol, 2, 1, limits=limits, x0=[0, 1], goal=None, count=60, horizon=10.0, cost=cost)


def hang_glider(random):
    """Maximize the range with an updraft. From a height of 1000 m to 900 m, it is 1248 m in 98.4 s."""
    start = [0, 1000, 13.227567500, -1.2875005200]
    limits = ([0, 0, 0, -ANY], [ANY, ANY, ANY, ANY]), ([0], [1.4])
    case = plain(by_hand.hang_glider, 4, 1, limits=limits, x0=start, goal=[FREE, 900, *start[2:]], count=100,
                 horizon=(10, random.uniform(120, 200)), cost=None, final_cost=lambda x: -x[0])  # fmt: skip
    return with_optimum(case, -1248.03)


# ------------------------------------------------------------------------------ rockets and vehicles


def soft_landing(random):
    """Land on the Moon with the least fuel and an engine that is always on."""
    start = [
        random.uniform(-300, 300),
        random.uniform(600, 1000),
        random.uniform(-20, 20),
        -random.uniform(20, 50),
        1000,
    ]
    limits = ([-ANY, 0, -ANY, -ANY, 500], [ANY, ANY, ANY, ANY, 1000]), ([500, -0.7], [6000, 0.7])
    return plain(by_hand.lander, 5, 2, limits=limits, x0=start, goal=[0, 0, 0, 0, FREE], count=50, horizon=(10, 120),
                 cost=None, final_cost=lambda x: -x[4] / 1000)  # fmt: skip


def ball_and_beam(random):
    start = [random.uniform(0.2, 0.4) * random.choice([-1, 1]), 0, 0, 0]
    limits = ([-0.5, -0.35, -ANY, -ANY], [0.5, 0.35, ANY, ANY]), ([-5], [5])
    goal = np.zeros(4)
    return plain(by_hand.ball_on_beam, 4, 1, limits=limits, x0=start, goal=goal, count=40, horizon=(0.3, 10), cost=1.0)


def trailer_backs_up(random):
    """Back a trailer into a bay without jackknifing."""
    f = partial(by_hand.trailer, length=random.uniform(0.8, 1.2))
    start = [random.uniform(1.5, 3), random.uniform(-0.6, 0.6), *[random.uniform(-0.3, 0.3)] * 2]
    limits = ([-ANY] * 4, [ANY] * 4), ([-1, -1], [1, 1])
    folded = dd.Constraint(lambda x: x[2] - x[3], lower=-0.9, upper=0.9, name="fold")

    def folds(_, xs):
        return float(np.max(np.abs(xs[:, 2] - xs[:, 3])) - 0.9)

    case = plain(f, 4, 2, limits=limits, x0=start, goal=np.zeros(4), count=40, horizon=(0.5, 30), cost=1.0,
                 constraints=[folded])  # fmt: skip
    return Case(case.problem, case.build, (("it folds [rad]", folds, 0.02),), case.peer)


def hovercraft_turns(random):
    start = [*random.uniform(-2, 2, 2), random.uniform(-np.pi, np.pi), 0, 0, 0]
    limits = ([-ANY] * 6, [ANY] * 6), ([0, 0], [1, 1])
    goal = np.zeros(6)
    return plain(by_hand.hovercraft, 6, 2, limits=limits, x0=start, goal=goal, count=50, horizon=(0.5, 30), cost=1.0)


def slung_load(random):
    goal = [*random.uniform(-2, 2, 2), *[0] * 6]
    limits = ([-ANY] * 8, [ANY] * 8), ([0, 0], [random.uniform(5, 8)] * 2)
    hover = 0.7 * by_hand.GRAVITY / 2
    cost = dd.QuadraticCost(R=np.eye(2), u_ref=[hover, hover])
    return plain(by_hand.slung_load, 8, 2, limits=limits, x0=np.zeros(8), goal=goal, count=50, horizon=3.0, cost=cost)


def slung_load_in_least_time(random):
    goal = [*random.uniform(-2, 2, 2), *[0] * 6]
    limits = ([-ANY] * 8, [ANY] * 8), ([0, 0], [random.uniform(5, 8)] * 2)
    return plain(
        by_hand.slung_load, 8, 2, limits=limits, x0=np.zeros(8), goal=goal, count=50, horizon=(0.3, 8), cost=1.0
    )


def quadrotor_through_a_slalom(random):
    disks = [(1.0, -0.3, 0.6), (2.5, 0.5, 0.6), (4.0, random.uniform(-0.5, -0.1), 0.6)]
    kept, asks = keep_off(disks)
    limits = ([-ANY] * 6, [ANY] * 6), ([0.0, 0.0], [random.uniform(4, 7)] * 2)
    case = plain(by_hand.planar, 6, 2, limits=limits, x0=np.zeros(6), goal=[5, 0, 0, 0, 0, 0], count=60,
                 horizon=(0.5, 8), cost=1.0, constraints=kept)  # fmt: skip
    return Case(case.problem, case.build, asks, case.peer, disks=tuple(disks))


# ------------------------------------------------------------------------------ robots from files


LINK = """<link name="{name}"><inertial><origin xyz="0 0 {z}"/><mass value="{mass}"/>
<inertia ixx="{i}" iyy="{i}" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>
<axis xyz="{axis}"/>{limit}</joint>"""
MOTOR = """<transmission name="t"><type>transmission_interface/SimpleTransmission</type><joint name="{joint}">
<hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="motor"/></transmission>"""


def rod(name, mass, length):
    return LINK.format(name=name, z=-length / 2, mass=mass, i=mass * length**2 / 12)


@cache
def written(name, *parts):
    path = Path(FOLDER.name) / f"{name}.urdf"
    path.write_text(f'<robot name="{name}">{"".join(parts)}</robot>')
    return path


def cart_with_two_poles(random):
    """Swing up a double pendulum on a cart."""
    path = written(
        "cart_with_two_poles",
        LINK.format(name="cart", z=0, mass=1, i=1e-4) + rod("first", 0.2, 0.5) + rod("second", 0.2, 0.5),
        JOINT.format(name="slide", kind="prismatic", parent="world", child="cart", at="0 0 0", axis="1 0 0",
                     limit='<limit lower="-3" upper="3" effort="40" velocity="1e3"/>'),
        JOINT.format(name="lower", kind="continuous", parent="cart", child="first", at="0 0 0", axis="0 1 0", limit=""),
        JOINT.format(name="upper", kind="continuous", parent="first", child="second", at="0 0 -0.5", axis="0 1 0",
                     limit=""),
        MOTOR.format(joint="slide"),
    )  # fmt: skip
    model = dd.load_model(path, time_step=0.03)
    problem = dd.Problem(
        model,
        x0=near_rest(random, 3, 0.1),
        x_goal=[0, np.pi, 0, 0, 0, 0],
        num_steps=80,
        running_cost=effort(1),
        bounds=bounded(model, random.uniform(20, 35)),
    )
    return Case(problem, plant_of(path), file=path)


def furuta_pendulum(random):
    """Swing up a pole on a rotating arm."""
    arm = LINK.format(name="arm", z=0, mass=0.3, i=2e-3).replace('izz="1e-4"', 'izz="2e-3"')
    path = written(
        "furuta",
        arm + rod("pole", 0.1, 0.3),
        JOINT.format(name="turn", kind="continuous", parent="world", child="arm", at="0 0 0", axis="0 0 1", limit=""),
        JOINT.format(name="swing", kind="continuous", parent="arm", child="pole", at="0.2 0 0", axis="1 0 0", limit=""),
        MOTOR.format(joint="turn"),
    )
    model = dd.load_model(path, time_step=0.02)
    problem = dd.Problem(
        model,
        x0=near_rest(random, 2, 0.2),
        x_goal=[0, np.pi, 0, 0],
        num_steps=75,
        running_cost=effort(1),
        bounds=bounded(model, random.uniform(0.2, 0.5)),
    )
    return Case(problem, plant_of(path), file=path)


def ur5_between_two_balls(random):
    path, hand, count, radius = arm_file("ur5_robot.urdf"), "wrist_3_link", 40, 0.06
    model = loaded(path, 2.0 / count)
    while True:
        start, goal = posture(model, random)
        way = [start + s * (goal - start) for s in (0.35, 0.7)]
        balls = [places(path, q, [hand])[0] + random.uniform(-0.05, 0.05, 3) for q in way]
        far = [np.linalg.norm(places(path, q) - ball, axis=1).min() for q in (start, goal) for ball in balls]
        if min(far) > radius + 0.15:
            break
    target = places(path, goal, [hand])[0]
    goals = [dd.FrameGoal(hand, position=target), *(dd.SphereObstacle(ball, radius) for ball in balls)]
    still = np.zeros(6)
    problem = dd.Problem(model, x0=[*start, *still], x_goal=[*[FREE] * 6, *still], goals=goals, num_steps=count,
                         running_cost=effort(6, 1e-3))  # fmt: skip
    asks = [("hand [m]", hand_misses(path, hand, target), 0.01)]
    asks += [("enters a ball [m]", skeleton_enters(path, 6, ball, radius), 1e-3) for ball in balls]
    return Case(problem, plant_of(path), tuple(asks))


def ur5_carries_a_tray(random):
    """Move the hand to a position, with one of its axes within 0.1 rad of the vertical."""
    path, hand, count = arm_file("ur5_robot.urdf"), "wrist_3_link", 40
    model, q = loaded(path, 2.5 / count), np.array([0, -1.2, 1.6, -0.4, 1.57, 0])
    q[:3] += [random.uniform(-0.5, 0.5), *random.uniform(-0.1, 0.1, 2)]
    plant, context = kinematics(path)

    def upright(q):
        plant.SetPositions(context, q)
        return plant.GetFrameByName(hand).CalcPoseInWorld(context).rotation().matrix()

    axis = upright(q).T @ [0, 0, 1.0]
    target = places(path, q, [hand])[0] + random.uniform(-0.2, 0.2, 3)
    still = np.zeros(6)
    goals = [dd.FrameGoal(hand, position=target), dd.KeepLevel(hand, axis=axis, tolerance=0.1)]
    problem = dd.Problem(model, x0=[*q, *still], x_goal=[*[FREE] * 6, *still], goals=goals, num_steps=count,
                         running_cost=effort(6, 1e-3))  # fmt: skip

    def leans(_, xs):
        return max(float(np.arccos(np.clip((upright(x[:6]) @ axis)[2], -1, 1))) for x in xs[:: max(1, len(xs) // 200)])

    asks = (("hand [m]", hand_misses(path, hand, target), 0.01), ("leans [rad]", leans, 0.12))
    return Case(problem, plant_of(path), asks)


MORE = {
    "swing-ups": [cart_with_two_poles, furuta_pendulum],
    "cranes and carts": [ball_and_beam],
    "arms": [ur5_between_two_balls, ur5_carries_a_tray],
    "cars and quadrotors": [
        trailer_backs_up, hovercraft_turns, slung_load, slung_load_in_least_time, quadrotor_through_a_slalom,
        soft_landing,
    ],
    "textbooks": [
        bryson_denham, brachistochrone, hanging_chain, goddard_rocket, orbit_transfer, van_der_pol, hang_glider,
    ],
}  # fmt: skip

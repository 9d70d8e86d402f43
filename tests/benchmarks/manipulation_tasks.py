"""Tasks of `contact_plans.py` with random starts: an object is pushed, grasped or tipped, or a hopper hops.

A goal is a position with a tolerance: 5 mm for a ball and a box, 0.05 rad for a spinner. The final speed has a cost but
no goal. Contact is softer than in the models. Otherwise the force of the first step in contact jumps so far that it
stops the object at once, and the least cost is at the jump. The guess is a line to the goal. For the spinner, a finger
moves to its end and along with it. Two fingers move to a box's sides and up with it. They are geared, and the cost of
their effort is relative to a grip, because a finger that approaches slowly and keeps pressing meets few jumps.
"""

import re
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from contact_task import Task, Tasks

import drake_diff as dd

MODELS = Path(dd.__file__).parent / "models"
OPTIONS = {"method": "ilqr", "continuation": "relaxed", "max_iterations": 150}
AT_PLACE, AT_ANGLE = 0.005, 0.05  # [m], [rad]
AT_HEIGHT, HELD = 0.01, 0.2  # [m] tolerance, and its duration at the end [s]
AT_GOAL = 1e-3  # tolerance of a hop's goal, in the units of the state
ROUGHLY = 1e-2  # tolerance of a solve: the cost has a kink where a push begins or ends; the last 0.01 % take long
MORE_ROUGHLY = 3e-2  # tolerance of a grasp, in which the last 0.1 % take long
TIPPED_ROUGHLY = 0.1  # tolerance of a box that tips and lands, in which the last 1 % takes long
DISSIPATION = 5  # [s/m]
WEIGHT, CARRIED, GRIP = 9.81 * 0.203, 9.81 * 0.101, 2.5  # [N] weight of a box, of a finger and its slide; grip force
CUBE, HIGH, PUSH, PRESS = 0.05, 0.03, 1.0, 0.5  # [m] half of the low box, height of the push above its centre; [N]
BOX, TIP, GIVES = (
    (0.05, 0.1),
    0.02,
    2000,
)  # [m] half of the tall box, radius of a fingertip; [N/m] stiffness of two corners on the ground
LINK, PIVOT, BESIDE, OUT = 0.15, (0.25, 0.2), 0.04, 0.07  # [m] link; pivot; tip to the spinner's axis and to the pivot


def softer(path: Path, time_step: float, stiffness: float, relaxation: float, **others: str) -> dd.Model:
    """Load the model with a contact stiffness [N/m], a relaxation time in steps, and other values of elements."""
    text = path.read_text()
    elements = {
        "drake:point_contact_stiffness": f"{stiffness:g}",
        "drake:relaxation_time": f"{relaxation * time_step:g}",
        "drake:hunt_crossley_dissipation": f"{DISSIPATION:g}",
        **others,
    }
    for name, value in elements.items():
        text, count = re.subn(f"<{name}>[^<]*<", f"<{name}>{value}<", text)
        assert count, name
    changed = Path(tempfile.mkdtemp()) / path.name
    changed.write_text(text)
    return dd.load_model(changed, time_step=time_step)


def off(wanted: dict[int, float], xs: np.ndarray, us: np.ndarray, knot: int = -1) -> float:
    """Return the largest difference between entries of a state and their wanted values."""
    return max(abs(float(xs[knot][i]) - value) for i, value in wanted.items())


def spinner(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """Return the task of turning a spinner to an angle in 1 s with a finger, in a direction that its tip can reach."""
    model = softer(Path(__file__).parent / "finger_spinner.sdf", time_step, 1000, 0.5)
    x0 = np.array([random.uniform(-0.3, 0.1), random.uniform(0.2, 0.6), random.uniform(-0.1, 0.1), 0, 0, 0])
    angle, count = x0[2] - random.uniform(0.6, 1.2), round(1 / time_step)
    problem = dd.Problem(
        model,
        x0=x0,
        num_steps=count,
        goals=dd.JointGoal({"spin": angle}, tolerance=AT_ANGLE),
        running_cost=dd.QuadraticCost(Q=np.diag([0, 0, 0, 1e-3, 1e-3, 0]), R=np.eye(2)),
        final_cost=dd.QuadraticCost(Q=np.diag([0, 0, 0, 0, 0, 0.01])),
    )
    guess = beside(x0, angle, count, time_step), np.zeros((count, 2))
    options = {**OPTIONS, "tolerance": ROUGHLY, "initial_guess": guess}
    asks = (("spinner from its angle [rad]", partial(off, {2: angle}), AT_ANGLE),)
    return Task("spinner", problem, f"the spinner at {angle:.2f} rad", options, asks)


def beside(x0: np.ndarray, angle: float, count: int, time_step: float) -> np.ndarray:
    """Return states (N+1, 6): the finger moves to the spinner in 40 % of the time, then with it within its reach."""
    part = np.linspace(0, 1, count + 1)
    spin = np.interp(part, [0, 0.4, 1], [x0[2], x0[2], angle])
    tip = np.array(PIVOT)[:, None] - OUT * np.array([np.cos(spin), np.sin(spin)])
    tip -= BESIDE * np.array([-np.sin(spin), np.cos(spin)])
    elbow = np.arccos(np.clip(np.sum(tip**2, axis=0) / (2 * LINK**2) - 1, -1, 1))
    there = np.array([np.arctan2(tip[1], tip[0]) - elbow / 2, elbow]).T
    way = np.minimum(part / 0.4, 1)[:, None]
    q = np.column_stack([(1 - way) * x0[:2] + way * there, spin])
    return with_speeds(q, time_step)


def ball(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """Return the task of moving a ball with rolling resistance to a goal with a pusher that starts apart from it."""
    model = softer(MODELS / "two_spheres.sdf", time_step, 1000, 2.5, damping="5")
    gap, way = random.uniform(0.1, 0.4), random.uniform(0.3, 0.6)
    place = 0.2 + gap + way
    problem = dd.Problem(
        model,
        x0=[0, 0.2 + gap, 0, 0],
        num_steps=round(1.5 / time_step),
        goals=dd.JointGoal({"slide": place}, tolerance=AT_PLACE),
        running_cost=dd.QuadraticCost(R=[[0.01]]),
        final_cost=dd.QuadraticCost(Q=np.diag([0, 0, 0, 0.1])),
    )
    asks = (("ball from its place [m]", partial(off, {1: place}), AT_PLACE),)
    return Task("ball", problem, f"the ball at {place:.2f} m", {**OPTIONS, "tolerance": ROUGHLY}, asks)


def box(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """Return the task of pushing a box to a goal in the plane with a finger that starts apart, off its centre."""
    model = softer(MODELS / "box_push.sdf", time_step, 500, 0.25)
    x0 = np.zeros(10)
    x0[3:5] = -random.uniform(0.25, 0.45), random.uniform(-0.08, 0.08)
    place = random.uniform(0.15, 0.3), random.uniform(-0.04, 0.04)
    problem = dd.Problem(
        model,
        x0=x0,
        num_steps=round(1.5 / time_step),
        goals=dd.JointGoal({"bx": place[0], "by": place[1]}, tolerance=AT_PLACE),
        running_cost=dd.QuadraticCost(R=0.1 * np.eye(2)),
        final_cost=dd.QuadraticCost(Q=np.diag([0, 0, 0, 0, 0, 0.1, 0.1, 0.01, 0, 0])),
    )
    asks = (("box from its place [m]", partial(off, dict(enumerate(place))), AT_PLACE),)
    text = f"the box at ({place[0]:.2f}, {place[1]:.2f}) m"
    return Task("box", problem, text, {**OPTIONS, "tolerance": ROUGHLY}, asks)


def monoped(random: np.random.Generator, time_step: float = 0.01) -> Task:
    """Return the task of hopping forward from standing to standing, with a clearance of the foot on the way."""
    model = dd.load_model(MODELS / "hopper.sdf", time_step=time_step)
    height, way = random.uniform(0.45, 0.55), random.uniform(0.3, 0.6)
    leg = height - 0.05 + 12 / 2e4
    x0 = [0, height, 0, leg, 0, 0, 0, 0]
    goal = np.array([way, height, np.nan, np.nan, 0, 0, 0, 0])
    count = round(1 / time_step)
    above = {round(0.6 * count): {"z": height + 0.05, "leg": leg}}
    cost = dd.QuadraticCost(R=1e-3 * np.eye(2), u_ref=[0, 10])
    problem = dd.Problem(model, x0=x0, x_goal=goal, num_steps=count, running_cost=cost, waypoints=above)
    asks = (
        ("hopper from its goal", partial(off, {i: v for i, v in enumerate(goal) if np.isfinite(v)}), AT_GOAL),
        ("hopper from its clearance [m]", partial(off, {1: height + 0.05, 3: leg}, knot=round(0.6 * count)), AT_GOAL),
    )
    return Task("monoped", problem, f"{way:.2f} m on, at rest", {**OPTIONS, "tolerance": 1e-6}, asks)


def grasp(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """Return the task of lifting a box by friction alone, with two fingers that start apart and grip its sides."""
    model = dd.load_model(MODELS / "two_fingers.sdf", time_step=time_step)
    count, (half, tall) = round(2 / time_step), BOX
    x0 = np.zeros(14)
    x0[:2] = random.uniform(-0.03, 0.03), tall - WEIGHT / GIVES
    for entry, side in ((3, -1), (5, 1)):
        x0[entry] = x0[0] + side * (half + TIP + random.uniform(0.02, 0.1))
        x0[entry + 1] = tall + random.uniform(-0.02, 0.03)
    height = x0[1] + random.uniform(0.05, 0.1)
    held = dd.optimize.Dwell(dd.JointGoal({"z": height}, tolerance=AT_HEIGHT), HELD)
    problem = dd.Problem(
        model,
        x0=x0,
        num_steps=count,
        goals=[held, dd.JointGoal({"turn": 0}, tolerance=AT_ANGLE)],
        running_cost=dd.QuadraticCost(
            Q=np.diag([0.0, 0, 1, *np.zeros(11)]), R=0.01 * np.eye(4), u_ref=[GRIP, CARRIED, -GRIP, CARRIED]
        ),
        final_cost=dd.QuadraticCost(Q=np.diag([0] * 7 + [0.1] * 7)),
    )
    options = {**OPTIONS, "tolerance": MORE_ROUGHLY, "initial_guess": gripped(x0, height, count, time_step)}
    rest = range(count - round(HELD / time_step), count + 1)
    asks = (
        ("box from its height [m]", lambda xs, us: max(off({1: height}, xs, us, k) for k in rest), AT_HEIGHT),
        ("box from upright [rad]", partial(off, {2: 0.0}), AT_ANGLE),
        ("fingertips from the middles of its sides, up or down [m]", beyond_faces, tall - TIP),
    )
    return Task("grasp", problem, f"the box at {height:.2f} m, held by its sides", options, asks)


def beyond_faces(xs: np.ndarray, us: np.ndarray) -> float:
    """Return the largest distance [m] of a fingertip from the middle of the box's side, along it, in the air."""
    up = xs[xs[:, 1] > BOX[1] + AT_HEIGHT]
    c, s = np.cos(up[:, 2]), np.sin(up[:, 2])
    along = [(up[:, i] - up[:, 0]) * s + (up[:, i + 1] - up[:, 1]) * c for i in (3, 5)]
    return float(np.max(np.abs(along), initial=0.0))


def gripped(x0: np.ndarray, height: float, count: int, time_step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (xs (N+1, 14), us (N, 4)): the fingers reach the box in 40 % of the time, then lift it and stay."""
    part = np.linspace(0, 1, count + 1)
    z = np.interp(part, [0, 0.4, 0.9, 1], [x0[1], x0[1], height, height])
    way, columns = np.minimum(part / 0.4, 1), [np.full(count + 1, x0[0]), z, np.zeros(count + 1)]
    for entry, side in ((3, -1), (5, 1)):
        columns.append((1 - way) * x0[entry] + way * (x0[0] + side * (BOX[0] + TIP)))
        columns.append((1 - way) * x0[entry + 1] + way * z)
    return with_speeds(np.column_stack(columns), time_step), np.tile([GRIP, CARRIED, -GRIP, CARRIED], (count, 1))


def flip(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """Return the task of tipping a box by 90 degrees over its far edge, to rest, with a finger that starts apart."""
    model = dd.load_model(MODELS / "finger_box.sdf", time_step=time_step)
    count = round(2 / time_step)
    x0 = np.zeros(10)
    x0[:2] = random.uniform(-0.03, 0.03), CUBE - WEIGHT / GIVES
    x0[3:5] = x0[0] - CUBE - TIP - random.uniform(0.03, 0.12), random.uniform(0.04, 0.1)
    problem = dd.Problem(
        model,
        x0=x0,
        num_steps=count,
        goals=[dd.optimize.Dwell(dd.JointGoal({"turn": np.pi / 2}, tolerance=AT_ANGLE), HELD)],
        running_cost=dd.QuadraticCost(
            Q=np.diag([0] * 5 + [0.1] * 3 + [0] * 2), R=0.01 * np.eye(2), u_ref=[PUSH, CARRIED - PRESS]
        ),
        final_cost=dd.QuadraticCost(Q=np.diag([0] * 5 + [0.1] * 5)),
    )
    guess = tipped(x0, count, time_step), np.tile([PUSH, CARRIED - PRESS], (count, 1))
    rest = range(count - round(HELD / time_step), count + 1)
    asks = (
        ("box from a quarter turn [rad]", lambda xs, us: max(off({2: np.pi / 2}, xs, us, k) for k in rest), AT_ANGLE),
    )
    options = {**OPTIONS, "tolerance": TIPPED_ROUGHLY, "initial_guess": guess}
    return Task("flip", problem, "the box on its side", options, asks)


def tipped(x0: np.ndarray, count: int, time_step: float) -> np.ndarray:
    """Return states (N+1, 10): the finger reaches the box in 40 % of the time, and turns it about its edge."""
    part = np.linspace(0, 1, count + 1)
    turn = np.interp(part, [0, 0.4, 0.8, 1], [0, 0, np.pi / 2, np.pi / 2])
    c, s = np.cos(turn), np.sin(turn)

    def turned(x: float, z: float) -> np.ndarray:
        return np.column_stack([x * c + z * s, z * c - x * s])

    box = x0[:2] + np.array([CUBE, -CUBE]) + turned(-CUBE, CUBE)
    way = np.minimum(part / 0.4, 1)[:, None]
    tip = (1 - way) * x0[3:5] + way * (box + turned(-CUBE - TIP, HIGH))
    return with_speeds(np.column_stack([box, turn, tip]), time_step)


def with_speeds(q: np.ndarray, time_step: float) -> np.ndarray:
    """Return the states (N+1, nx) of a motion that begins at rest."""
    return np.hstack([q, np.vstack([np.zeros(q.shape[1]), np.diff(q, axis=0) / time_step])])


TASKS: Tasks = {"grasp": grasp, "flip": flip, "spinner": spinner, "ball": ball, "box": box, "monoped": monoped}

"""Tasks of `contact_plans.py` in which something is pushed, and a hop: from a random start.

A goal is a place with a tolerance: 5 mm for a ball and a box, 0.05 rad for a spinner. Speed at the end costs and is not
asked. Contact is softer than the models' own: of that, the force of a step that begins to touch jumps so far that it
stops what it hits at once, and the least cost lies at the jump. The guess is a line to the goal, and the spinner's a
finger that goes to the end of the spinner and along with it.
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
AT_GOAL = 1e-3  # of a hop's goal, in the units of states
ROUGHLY = 1e-2  # of a solve: where a push begins or lets go the cost has a corner, and the last 0.01 % take long
DISSIPATION = 5  # [s/m]
LINK, PIVOT, BESIDE, OUT = 0.15, (0.25, 0.2), 0.04, 0.07  # [m] of the finger and the spinner, between axes; from pivot


def softer(path: Path, time_step: float, stiffness: float, relaxation: float, **others: str) -> dd.Model:
    """The model of that file with contact of a stiffness [N/m] that relaxes in so many steps, and other elements."""
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
    """How far the worst of some entries of a state is from what is wanted."""
    return max(abs(float(xs[knot][i]) - value) for i, value in wanted.items())


def spinner(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """A finger turns a spinner to an angle in a second, to the side to which its tip can reach the spinner's end."""
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
    """(N+1, 6) the finger goes to the spinner in 40 % of the time, then along with it as far as it reaches."""
    part = np.linspace(0, 1, count + 1)
    spin = np.interp(part, [0, 0.4, 1], [x0[2], x0[2], angle])
    tip = np.array(PIVOT)[:, None] - OUT * np.array([np.cos(spin), np.sin(spin)])
    tip -= BESIDE * np.array([-np.sin(spin), np.cos(spin)])
    elbow = np.arccos(np.clip(np.sum(tip**2, axis=0) / (2 * LINK**2) - 1, -1, 1))
    there = np.array([np.arctan2(tip[1], tip[0]) - elbow / 2, elbow]).T
    way = np.minimum(part / 0.4, 1)[:, None]
    q = np.column_stack([(1 - way) * x0[:2] + way * there, spin])
    v = np.vstack([np.zeros(3), np.diff(q, axis=0) / time_step])
    return np.hstack([q, v])


def ball(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """A pusher that starts apart from a ball, which rolls on with resistance, brings it to a place."""
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
    """A finger that starts apart from a box, and not behind its middle, brings it to a place in the plane."""
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
    """A hopper that stands hops on, a foot's clearance on the way, and stands again."""
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


TASKS: Tasks = {"spinner": spinner, "ball": ball, "box": box, "monoped": monoped}

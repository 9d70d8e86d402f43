"""Tasks of `contact_plans.py` in which something is pushed: from a random start; the guess is a line to the goal.

The two models that push have contact without rebound by a long relaxation time (0.1 s), whose force jumps at touching,
so that the least cost lies at a jump. Here it is 5 ms.
"""

import tempfile
from pathlib import Path

import numpy as np
from contact_task import Task, Tasks

import drake_diff as dd

MODELS = Path(dd.__file__).parent / "models"
OPTIONS = {"method": "ilqr", "continuation": "relaxed", "max_iterations": 150, "tolerance": 1e-6}


def smoother(name: str, time_step: float) -> dd.Model:
    """The model of that file with a relaxation time of 5 ms."""
    text = (MODELS / name).read_text().replace("relaxation_time>0.1<", "relaxation_time>0.005<")
    path = Path(tempfile.mkdtemp()) / name
    path.write_text(text)
    return dd.load_model(path, time_step=time_step)


def goal_of(model: dd.Model, **wanted: float) -> np.ndarray:
    """(nx,) by the names of states, NaN elsewhere."""
    goal = np.full(model.nx, np.nan)
    for name, value in wanted.items():
        goal[model.state_names.index(name)] = value
    return goal


def spinner(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """A finger flicks a spinner to an angle, where it is to be after a second."""
    model = dd.load_model(Path(__file__).parent / "finger_spinner.sdf", time_step=time_step)
    x0 = [random.uniform(-0.3, 0.1), random.uniform(0.2, 0.6), random.uniform(-0.1, 0.1), 0, 0, 0]
    angle = x0[2] + random.uniform(0.6, 1.2)
    cost = dd.QuadraticCost(Q=np.diag([0, 0, 0, 1e-3, 1e-3, 0]), R=0.1 * np.eye(2))
    goal = goal_of(model, spin_q=angle)
    problem = dd.Problem(model, x0=x0, x_goal=goal, num_steps=round(1 / time_step), running_cost=cost)
    return Task("spinner", problem, f"the spinner at {angle:.2f} rad", OPTIONS)


def ball(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """A pusher that starts apart from a ball brings it to a place; its speed costs."""
    model = smoother("two_spheres.sdf", time_step)
    gap, way = random.uniform(0.1, 0.4), random.uniform(0.3, 0.6)
    place = 0.2 + gap + way
    slow = dd.QuadraticCost(Q=np.diag([0, 0, 0, 1e-2]))
    problem = dd.Problem(
        model,
        x0=[0, 0.2 + gap, 0, 0],
        x_goal=[np.nan, place, np.nan, np.nan],
        num_steps=round(1.2 / time_step),
        running_cost=dd.QuadraticCost(R=[[1e-3]]),
        final_cost=slow,
    )
    return Task("ball", problem, f"the ball at {place:.2f} m", OPTIONS)


def box(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """A finger brings a box to a place and turns it; speeds at the end cost."""
    model = smoother("box_push.sdf", time_step)
    x0 = np.zeros(10)
    x0[3:5] = -random.uniform(0.25, 0.45), random.uniform(-0.08, 0.08)
    place = random.uniform(0.15, 0.3), random.uniform(-0.04, 0.04)
    goal = np.full(10, np.nan)
    goal[:2] = place
    slow = dd.QuadraticCost(Q=np.diag([0, 0, 0, 0, 0, 1, 1, 0.1, 0, 0.0]))
    cost = dd.QuadraticCost(R=1e-2 * np.eye(2))
    count = round(1.5 / time_step)
    problem = dd.Problem(model, x0=x0, x_goal=goal, num_steps=count, running_cost=cost, final_cost=slow)
    return Task("box", problem, f"the box at ({place[0]:.2f}, {place[1]:.2f}) m", OPTIONS)


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
    return Task("monoped", problem, f"{way:.2f} m on, at rest", OPTIONS)


TASKS: Tasks = {"spinner": spinner, "ball": ball, "box": box, "monoped": monoped}

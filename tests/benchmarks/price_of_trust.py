"""The price of trust: the processor time of `dd.solve` over that of its own search, and what each check of it costs.

    python tests/benchmarks/price_of_trust.py [--only NAME,...] [--repeat 1] [--seed 0] [--out FILE.json]

Both are taken in the same run, by clocks around the functions that `dd.solve` calls; what is nested counts for the
inner one. A problem is solved once before, so that neither has to build what a model keeps. What is printed is the
table of docs/trust.md.
"""

import argparse
import json
import logging
import os
import sys
import time
import warnings
import xml.etree.ElementTree as ET
from collections import Counter
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")  # read when NumPy is imported: small matrices are slower on threads

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np  # noqa: E402
import task_cases  # noqa: E402
from helpers.models import MODELS, robot_file  # noqa: E402
from helpers.robots import FOOT  # noqa: E402
from pydrake.multibody.tree import BodyIndex  # noqa: E402
from trust_solve import FOLDER, arm_file, block_file, effort  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff.exceptions import ModelWarning  # noqa: E402
from drake_diff.motion.rollout import roll_states  # noqa: E402
from drake_diff.optimize import judge, run, solution  # noqa: E402

LEG = 0.0, 0.8, -1.6  # [rad] of hip, thigh and knee
SEARCH, CERTIFICATES, REPLAYS = "search", "certificates", "replays"
CLOCKS = {  # of what `dd.solve` calls
    SEARCH: [
        (run, name)
        for name in ("solve_continuation", "solve_through_jumps", "solve_ilqr", "solve_shooting", "solve_collocation")
    ]
    + [(run.Transcription, name) for name in ("__init__", "solve", "finer")],
    CERTIFICATES: [(run.Run, "_look_at"), (run, "certify_equations")],
    REPLAYS: [(solution, "replays"), (solution.Solution, "replay")],
    "reach": [(run, "why_blind"), (run, "out_of_reach")],
    "slope": [(run, "doubt_of_the_slope")],
    "measures": [(run, "judged"), (judge, "complaints_about"), (judge, "_followed")],
}


class Clock:
    """Seconds of this process by part, what is nested counted once."""

    def __init__(self):
        self.seconds, self.inside, self.since = Counter(), ["the rest"], 0.0

    def turn(self):
        now = time.process_time()
        self.seconds[self.inside[-1]] += now - self.since
        self.since = now

    def around(self, part, f):
        def timed(*args, **kwargs):
            self.turn()
            self.inside.append(part)
            try:
                return f(*args, **kwargs)
            finally:
                self.turn()
                self.inside.pop()

        return timed


@contextmanager
def clocks():
    """A Clock around what CLOCKS names."""
    clock, before = Clock(), []
    for part, places in CLOCKS.items():
        for owner, name in places:
            f = vars(owner)[name]
            before.append((owner, name, f))
            if isinstance(f, cached_property):
                timed = cached_property(clock.around(part, f.func))
                timed.__set_name__(owner, name)
            else:
                timed = clock.around(part, f)
            setattr(owner, name, timed)
    clock.since = time.process_time()
    try:
        yield clock
    finally:
        clock.turn()
        for owner, name, f in reversed(before):
            setattr(owner, name, f)


# ------------------------------------------------------------------------------ tasks: (problem, options)


def block(random):
    """Kelly's block, 30 intervals."""
    model = dd.load_model(block_file(1.0, 20.0, 0.0), time_step=1 / 30)
    way = random.uniform(0.8, 1.2)
    return dd.Problem(model, x0=[0, 0], x_goal=[way, 0], num_steps=30, running_cost=effort(1)), {}


def cart_pole(random):
    """Kelly's cart-pole, 50 intervals."""
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.04)
    bounds = dd.Bounds(x_lower=[-2, *[-np.inf] * 3], x_upper=[2, *[np.inf] * 3], u_lower=[-20], u_upper=[20])
    goal = [random.uniform(0.8, 1.2), np.pi, 0, 0]
    problem = dd.Problem(model, x0=np.zeros(4), x_goal=goal, num_steps=50, running_cost=effort(1), bounds=bounds)
    return problem, {"method": "collocation"}


def cart_pole_by_steps(random):
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.02)
    goal = [random.uniform(-0.2, 0.2), np.pi, 0, 0]
    problem = dd.Problem(model, x0=np.zeros(4), x_goal=goal, num_steps=100, running_cost=effort(1))
    return problem, {"method": "ilqr"}


def acrobot(random):
    return task_cases.acrobot_swing_up(random).problem, {}


def crane(random):
    return task_cases.crane_least_time(random).problem, {}


def two_rods_by_shooting(random):
    model = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.02)
    goal = [random.uniform(0.8, 1.2), 0.5, 0, 0]
    problem = dd.Problem(model, x0=np.zeros(4), x_goal=goal, num_steps=50, running_cost=effort(2, 0.1))
    return problem, {"method": "shooting"}


def quadrotor(random):
    return task_cases.quadrotor_to_a_place(random).problem, {}


def panda(random):
    return task_cases.panda_hand_goal(random).problem, {"method": "collocation"}


def ur5(random):
    model = dd.load_model(arm_file("ur5_robot.urdf"), time_step=0.02)
    start, goal = np.array([0, -1, 1, 0, 0, 0.0]), np.array([1, -0.5, 0.5, 0.5, 0.5, 0.5])
    weights = np.diag([100.0] * 6 + [10.0] * 6)
    problem = dd.Problem(
        model,
        x0=[*(start + random.uniform(-0.1, 0.1, 6)), *np.zeros(6)],
        num_steps=50,
        running_cost=effort(6, 1e-4),
        final_cost=dd.QuadraticCost(Q=weights, x_ref=[*goal, *np.zeros(6)]),
    )
    return problem, {"method": "ilqr"}


def on_balls(name):
    """A file of example-robot-data whose only shapes are a ball at the end of each chain."""
    root = ET.parse(robot_file(name)).getroot()
    parents = {joint.find("parent").get("link") for joint in root.iter("joint") if joint.find("parent") is not None}
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
        if link.get("name") not in parents:
            ball = ET.SubElement(ET.SubElement(link, "collision"), "geometry")
            ET.SubElement(ball, "sphere", radius=str(FOOT))
    path = Path(FOLDER.name) / name
    path.write_bytes(ET.tostring(root))
    return path


def standing(name, h, kp, kd, lift, random):
    """A quadruped of example-robot-data on balls lifts its trunk by `lift` [m] in 0.5 s."""
    law = {"ground": True, "contact": "ground", "near_rigid": 0.1, "relaxation_time": 0.02}
    model = dd.load_model(on_balls(name), time_step=h, base="free", actuators="all", **law)
    nq, x = model.nq, model.default_state.copy()
    x[:nq], x[nq:] = 0.0, 0.0
    x[0], x[6], x[7:nq] = 1.0, 1.0, np.tile(LEG, 4)
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, x[:nq])
    bodies = [model.plant.get_body(BodyIndex(i)) for i in range(1, model.plant.num_bodies())]
    feet = [body for body in bodies if model.plant.GetCollisionGeometriesForBody(body)]
    x[6] -= min(body.EvalPoseInWorld(context).translation()[2] for body in feet) - FOOT + 1e-3
    finer, held = model.at_time_step(0.005), x.copy()
    driven = [int(np.flatnonzero(column)[0]) for column in model.actuation.T]

    def u(x):
        return np.array([kp * (held[d + 1] - x[d + 1]) - kd * x[nq + d] for d in driven])

    for _ in range(200):
        x = dd.step(finer, x, u(x))
    us, goal = np.tile(u(x), (round(0.5 / h), 1)), x.copy()
    goal[nq:] = 0
    goal[6] += lift * random.uniform(0.9, 1.1)
    Q = np.diag([*[10.0] * 6, 100.0, *[1.0] * (nq - 7), *[0.01] * model.nv])
    running = dd.QuadraticCost(Q=Q, R=np.eye(model.nu) / kp**2, x_ref=goal, u_ref=us[0])
    problem = dd.Problem(
        model, x0=x, num_steps=len(us), running_cost=running, final_cost=dd.QuadraticCost(Q=Q, x_ref=goal)
    )
    return problem, {"method": "ilqr", "initial_guess": (roll_states(model, x, us), us), "max_iterations": 60}


def go2_stands(random):
    return standing("go2.urdf", 0.01, 60.0, 2.0, 0.005, random)


def solo12_stands(random):
    return standing("solo12.urdf", 0.01, 5.0, 0.1, 0.003, random)


def push(random):
    model = dd.load_model(MODELS / "two_spheres.sdf", time_step=0.01)
    goal = [np.nan, 0.2 + random.uniform(0.5, 0.8), np.nan, np.nan]
    problem = dd.Problem(model, x0=[0, 0.201, 0, 0], num_steps=40, running_cost=effort(1, 1e-3), x_goal=goal)
    return problem, {"max_iterations": 100}


def bounce(random):
    """A hopper in the air lands, and is to be at rest on its foot."""
    model = dd.load_model(MODELS / "hopper.sdf", time_step=0.01)
    x0, us = model.default_state.copy(), np.zeros((40, model.nu))
    x0[1] = 0.05  # the foot's radius
    cost = dd.QuadraticCost(Q=np.eye(model.nx), x_ref=x0.copy())
    x0[1] += random.uniform(0.01, 0.03)
    problem = dd.Problem(model, x0=x0, num_steps=40, running_cost=effort(model.nu, 1e-2), final_cost=cost)
    return problem, {"method": "ilqr", "initial_guess": (roll_states(model, x0, us), us)}


TASKS = (
    block, cart_pole, cart_pole_by_steps, acrobot, crane, two_rods_by_shooting, quadrotor, panda, ur5, go2_stands,
    solo12_stands, push, bounce,
)  # fmt: skip


# ------------------------------------------------------------------------------ what they cost


def measured(task, seed, repeat):
    """A row of the table: how the solve ended, and the seconds of each part, of the fastest of `repeat` solves."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        problem, options = task(np.random.default_rng(seed))
        dd.solve(problem, **options)
        rows = []
        for _ in range(repeat):
            with clocks() as clock:
                found = dd.solve(problem, **options)
            rows.append(clock.seconds)
    seconds = min(rows, key=lambda row: sum(row.values()))
    return {
        "task": task.__name__,
        "method": found.method,
        "status": found.status.value,
        "cost": found.cost,
        "certificates": len(found.certificates),
        "replays": len(found.replays) if "replays" in vars(found) else 0,
        "seconds": dict(seconds),
        "price": sum(seconds.values()) / max(seconds[SEARCH], 1e-9),
    }


def told(rows):
    parts = [part for part in (*CLOCKS, "the rest") if part != SEARCH]
    yield "| Task | Method | Ends | Search [s] | " + " | ".join(parts) + " | Solve over search |"
    yield "|---|---|---|---|" + "---|" * (len(parts) + 1)
    for row in rows:
        seconds, name = row["seconds"], row["task"].replace("_", " ")
        shares = " | ".join(f"{seconds.get(part, 0.0) / seconds[SEARCH]:.2f}" for part in parts)
        yield f"| {name} | {row['method']} | {row['status']} | {seconds[SEARCH]:.2f} | {shares} | {row['price']:.2f} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default=",".join(task.__name__ for task in TASKS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    logging.getLogger("drake").setLevel(logging.ERROR)
    known, rows = {task.__name__: task for task in TASKS}, []
    for name in options.only.split(","):
        if name not in known:
            parser.error(f"unknown task {name!r}, expected some of {', '.join(known)}")
        rows.append(measured(known[name], options.seed, options.repeat))
        print(list(told(rows))[-1], file=sys.stderr, flush=True)
    print("\n".join(told(rows)))
    if options.out:
        options.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()

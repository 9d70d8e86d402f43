"""Real-time MPC under pushes and within limits: a crane, a Panda past a ball and a quadrotor through gates.

    pip install -e '.[test]'
    python tests/benchmarks/mpc_realtime.py [--only crane,panda,quadrotor] [--count 20] [--seed 0] [--markdown FILE]

Each run is a seeded random problem, planned by `dd.solve` and controlled by `dd.loop.MPC` with default options at its
control period, while three seeded random pushes hit a body. The plant is pydrake's alone, in steps of 1 ms. It keeps
the old input during the processor time of the controller's thread (with `--clock wall`, during its wall time). An
answer that takes longer than the period counts as missed. At every step of 1 ms, the referee checks the limits of the
task with its own formulas. The problem uses only a part of these limits, so that there is room for a push. A violation
by the push itself, such as a jump of a speed, counts too.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import _one_thread  # noqa: F401 (before NumPy)

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np
from helpers.models import MODELS, strike
from pages import marked, write_section
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from task_cases import ARM, HOVER, MOMENT_RATIO, MOST, PANDA, QUADROTOR, ball_distance, flying, places

import drake_diff as dd
from drake_diff.model import BodyForce

FINE = 1e-3  # [s] the referee's step
PUSHES = 3
DRAWS = 5  # runs with the same problem and different pushes
FREE = np.inf
HOME = np.array([0, -0.785, 0, -2.356, 0, 1.571, 0.785])


@dataclass(frozen=True)
class Ask:
    """A requirement: the `excess` of states (S, nx) over a limit, its `unit`, and the largest `allowed` excess."""

    name: str
    excess: Callable[[np.ndarray], np.ndarray]
    unit: str
    allowed: float


@dataclass(frozen=True)
class Task:
    """A problem, its horizon [steps] and duration [s], and the referee's requirements; `bare` lacks the limits."""

    problem: dd.Problem
    bare: dd.Problem
    horizon: int
    duration: float
    plant: Callable[[float], Any]  # returns a system with an input port and the state as an output port
    body: str
    push: tuple[np.ndarray, np.ndarray]  # [N s] the largest impulse, and the smallest part of it
    asks: tuple[Ask, ...]
    passes: tuple[tuple[float, Ask], ...]  # at times [s]
    ends: Ask


def crane(random):
    """Return the task of a cart on rails: carry a load on a 0.5 m rod from rest to rest, at 50 Hz, with little sway."""
    path, way, sway, rail = MODELS / "cart_pole.urdf", random.uniform(0.7, 1.2), random.uniform(0.18, 0.25), 0.25
    model = dd.load_model(path, time_step=0.02)

    def limits(angle, room):
        lower, upper = [-way - room, -angle, -FREE, -FREE], [way + room, angle, FREE, FREE]
        return dd.Bounds(x_lower=lower, x_upper=upper, u_lower=[-15], u_upper=[15])

    def problem(bounds):
        cost = dd.QuadraticCost(R=[[1.0]])
        x0, goal = [-way, 0, 0, 0], [way, 0, 0, 0]
        return dd.Problem(model, x0=x0, x_goal=goal, num_steps=150, running_cost=cost, bounds=bounds)

    asks = (
        Ask("sway", lambda xs: np.abs(xs[:, 1]) - sway, "rad", 0.0),
        Ask("rail", lambda xs: np.abs(xs[:, 0]) - way - rail, "m", 0.0),
    )
    return Task(
        problem(limits(0.7 * sway, 0.5 * rail)), problem(limits(FREE, FREE)), 75, 9.0, lambda h: plain(path, h), "pole",
        (np.array([0.1, 0, 0]), np.array([0.3, 0, 0])), asks, (),
        Ask("goal", lambda xs: np.abs(xs[:, 0] - way), "m", 0.05),
    )  # fmt: skip


def panda(random):
    """Return the task of an arm of seven joints: move the hand across its front to a goal, past a ball, at 50 Hz."""
    model = dd.example_model("panda", time_step=0.02)
    start, goal = HOME + random.uniform(-0.1, 0.1, 7), HOME + random.uniform(-0.1, 0.1, 7)
    start[0], goal[0] = -random.uniform(0.65, 0.85), random.uniform(0.65, 0.85)
    center = places(PANDA, (start + goal) / 2, ["panda_hand"])[0] + random.uniform(-0.03, 0.03, 3)
    target, radius = places(PANDA, goal, ["panda_hand"])[0], 0.07
    end, speeds = [*[np.nan] * 7, *np.zeros(7)], np.array([2.175] * 4 + [2.61] * 3)
    cost = dd.QuadraticCost(Q=np.diag([0.0] * 7 + [1.0] * 7), R=1e-3 * np.eye(7))

    def problem(*goals):
        goals = [dd.FrameGoal("panda_hand", position=target), *goals]
        return dd.Problem(
            model, x0=[*start, *np.zeros(7)], x_goal=end, num_steps=75, goals=goals, running_cost=cost,
            bounds=dd.Bounds(x_lower=[np.nan] * 7 + list(-0.75 * speeds), x_upper=[np.nan] * 7 + list(0.75 * speeds)),
        )  # fmt: skip

    depth, hand = ball_distance(radius, center), hand_at(PANDA, "panda_hand")
    lower, upper = model.position_limits
    asks = (
        Ask("enters the ball", lambda xs: np.array([depth(None, xs[::10])]), "m", 0.0),
        Ask("joint", lambda xs: np.max(np.maximum(lower - xs[:, :7], xs[:, :7] - upper), axis=1), "rad", 0.0),
        Ask("speed", lambda xs: np.max(np.abs(xs[:, 7:]) - speeds, axis=1), "rad/s", 0.0),
    )
    return Task(
        problem(dd.SphereObstacle(center, radius, margin=0.02)), problem(), 15, 2.5, lambda h: plain(PANDA, h),
        "panda_hand", (np.full(3, 0.3), np.zeros(3)), asks, (),
        Ask("hand", lambda xs: np.linalg.norm(hand(xs) - target, axis=1), "m", 0.01),
    )  # fmt: skip


def quadrotor(random):
    """Return the task of four rotors of 5 N: carry a body through two gates to a goal, at 50 Hz, with little tilt."""
    points = [(ARM * x, ARM * y, 0.0) for x, y in [(1, 0), (0, 1), (-1, 0), (0, -1)]]
    forces = [
        BodyForce(f"rotor_{i + 1}", "body", point, moment_ratio=MOMENT_RATIO * (-1) ** i, upper=MOST)
        for i, point in enumerate(points)
    ]
    model = dd.load_model(QUADROTOR, time_step=0.02, body_forces=forces)
    start, end, tilt = model.default_state, np.full(model.nx, np.nan), random.uniform(0.7, 0.9)
    start[6], end[model.nq :] = 1.0, 0.0
    gates = {
        50: np.array([1.5, random.uniform(0.3, 0.8), random.uniform(1, 1.5)]),
        100: np.array([3.0, random.uniform(-0.8, -0.3), 1.0]),
    }
    place, opening = np.array([4.5, 0, 1]), 0.15
    weights = np.diag([0.0] * model.nq + [0.1] * 3 + [0.02] * 3)

    def problem(*goals):
        goals = [
            *(dd.FrameGoal("body", position=gate, tolerance=opening, knots=[k]) for k, gate in gates.items()),
            dd.FrameGoal("body", position=place, rotation=np.eye(3), tolerance=0.05, rotation_tolerance=0.05),
            *goals,
        ]
        cost = dd.QuadraticCost(Q=weights, R=0.1 * np.eye(4), u_ref=np.full(4, HOVER))
        return dd.Problem(model, x0=start, x_goal=end, num_steps=150, goals=goals, running_cost=cost)

    def tilted(xs):
        up = 1 - 2 * (xs[:, 1] ** 2 + xs[:, 2] ** 2) / np.sum(xs[:, :4] ** 2, axis=1)
        return np.arccos(np.clip(up, -1, 1)) - tilt

    def off(where):
        return lambda xs: np.linalg.norm(xs[:, 4:7] - where, axis=1)

    return Task(
        problem(dd.KeepLevel("body", tolerance=0.8 * tilt)), problem(), 25, 5.0, lambda h: flying(h)[0], "body",
        (np.full(3, 0.3), np.zeros(3)), (Ask("tilt", tilted, "rad", 0.0),),
        tuple((0.02 * k, Ask(f"gate at {0.02 * k:g} s", off(g), "m", opening)) for k, g in gates.items()),
        Ask("place", off(place), "m", 0.05),
    )  # fmt: skip


TASKS = {"crane": crane, "panda": panda, "quadrotor": quadrotor}


def plain(path, step):
    plant = MultibodyPlant(step)
    plant.SetUseSampledOutputPorts(False)
    Parser(plant).AddModels(str(path))
    plant.Finalize()
    return plant


def hand_at(path, frame):
    plant = plain(path, 0.0)
    context = plant.CreateDefaultContext()

    def at(xs):
        found = []
        for x in xs:
            plant.SetPositions(context, x[: plant.num_positions()])
            found.append(plant.GetFrameByName(frame).CalcPoseInWorld(context).translation())
        return np.array(found)

    return at


class Plant:
    """The referee's plant: pydrake's Simulator in steps of FINE, with pushes M dv = J' p."""

    def __init__(self, task):
        self.system = task.plant(FINE)
        self.simulator = Simulator(self.system)
        root = self.simulator.get_mutable_context()
        names = [self.system] if isinstance(self.system, MultibodyPlant) else self.system.GetSystems()
        self.plant = next(s for s in names if isinstance(s, MultibodyPlant))
        self.context = root if self.plant is self.system else self.plant.GetMyMutableContextFromRoot(root)
        own = isinstance(self.system, MultibodyPlant)
        self.port = self.system.get_actuation_input_port() if own else self.system.get_input_port(0)
        self.input = self.port.FixValue(root, np.zeros(self.port.size()))
        self.body = self.plant.GetBodyByName(task.body)
        self.xs = []

    @property
    def x(self):
        return self.plant.GetPositionsAndVelocities(self.context)

    def start(self, x):
        self.plant.SetPositionsAndVelocities(self.context, x)
        self.simulator.Initialize()
        self.xs = [self.x]

    def go_on(self, u, to):
        """Simulate with input u until the step `to`."""
        self.input.GetMutableData().set_value(u)
        for k in range(len(self.xs), to + 1):
            self.simulator.AdvanceTo(k * FINE - FINE / 2)  # takes the step that begins before
            self.xs.append(self.x)

    def push(self, impulse):
        strike(self.plant, self.context, self.body, impulse)


@dataclass(frozen=True)
class Run:
    """The result of one run, with latencies [s] by the thread's clock and the wall clock; `taken` are those judged."""

    seed: int
    excess: dict[str, float]
    kept: bool
    passed: bool
    ended: float
    arrived: bool
    taken: np.ndarray
    cpu: np.ndarray
    wall: np.ndarray
    period: float
    statuses: list[str]


def blows(task, seed):
    random = np.random.default_rng([seed, 1])
    most, least = task.push
    whole = task.problem.num_steps * task.problem.model.time_step
    found = []
    for at in random.uniform(0.05 * whole, 0.85 * whole, PUSHES):
        direction = random.uniform(-1, 1, 3)
        found.append((round(at / FINE), most * (np.sign(direction) * least + (1 - least) * direction)))
    return found


def drive(task, problem, plan, seed, clock):
    mpc = dd.loop.MPC(problem, horizon=task.horizon, plan=plan)
    h, plant, pushes = problem.model.time_step, Plant(task), blows(task, seed)
    per_tick = round(h / FINE)
    plant.start(np.array(problem.x0))
    u, statuses, cpu, wall = np.array(plan[1][0]), [], [], []
    lost = False
    for k in range(round(task.duration / h)):
        now = k * per_tick
        for at, impulse in pushes:
            if now <= at < now + per_tick:
                plant.push(impulse)
        x = plant.x
        begin = time.thread_time(), time.perf_counter()
        new = mpc(x, k * h)
        cpu.append(time.thread_time() - begin[0])
        wall.append(time.perf_counter() - begin[1])
        statuses.append(mpc.status)
        taken = (cpu if clock == "cpu" else wall)[-1]
        late = min(int(np.ceil(taken / FINE)), per_tick)
        try:
            plant.go_on(u, now + late)
            if taken <= h:
                u = new
            plant.go_on(u, now + per_tick)
        except RuntimeError:  # Drake's step fails because the plant is out of control
            lost = True
            break
    xs = np.array(plant.xs)
    if lost:
        excess, missed = ({ask.name: np.inf for ask in asks} for asks in (task.asks, [a for _, a in task.passes]))
        ended = np.inf
    else:
        excess, missed, ended = _judged(task, xs)
    return Run(
        seed=seed,
        excess=excess | missed,
        kept=all(excess[ask.name] <= ask.allowed for ask in task.asks),
        passed=all(missed[ask.name] <= ask.allowed for _, ask in task.passes),
        ended=ended,
        arrived=ended <= task.ends.allowed,
        taken=np.array(cpu if clock == "cpu" else wall),
        cpu=np.array(cpu),
        wall=np.array(wall),
        period=h,
        statuses=statuses,
    )


def _judged(task, xs):
    """Return (excess over each limit, distance from each gate, distance from the goal)."""
    excess = {ask.name: float(max(0.0, np.max(ask.excess(xs)))) for ask in task.asks}
    missed = {ask.name: float(ask.excess(xs[[round(at / FINE)]])[0]) for at, ask in task.passes}
    return excess, missed, float(task.ends.excess(xs[-1:])[0])


@cache
def planned(name, draw, bare):
    """Return (task, problem, plan) of the `draw`-th problem. The plan is None if the solve failed."""
    task = TASKS[name](np.random.default_rng([draw, 0]))
    problem = task.bare if bare else task.problem
    solution = dd.solve(problem)
    if not solution.success:
        return task, problem, None
    return task, problem, tuple(np.array(part) for part in solution.plan.sample(1))


def measure(name, seed, count, clock, *, bare=False):
    """Return (runs, number of runs whose problem was not solved)."""
    found, unsolved = [], 0
    for i in range(count):
        draw = seed * 1000 + i // DRAWS
        task, problem, plan = planned(name, draw, bare)
        if plan is None:
            unsolved += 1
            continue
        found.append(drive(task, problem, plan, seed * 1000 + i, clock))
    return found, unsolved


HEAD = """Three tasks under three random blows in each run, controlled by `dd.loop.MPC` with default options. The plant
is pydrake's in steps of 1 ms, with the old input while the controller computes; the referee judges the task's limits
at each step. `python tests/benchmarks/mpc_realtime.py --markdown docs/measured.md`, seed {seed}, {count} runs each,
at commit {commit}, {date}. The problem plans with a part of the limits (sway and tilt 70 and 80 %, speeds 75 %, 2 cm
beside the ball). Latencies are {clock}, on a machine with other work.

| Task | Ticks in time | Latency [ms]: median, 99 %, largest | Limits kept | Gates passed | Goal reached | "ok" |
|---|---|---|---|---|---|---|
"""


def row(name, runs, unsolved):
    """Return the task's row of the page."""
    period, taken = runs[0].period, np.concatenate([r.taken for r in runs])
    ok, count = sum(s == "ok" for r in runs for s in r.statuses), len(runs)
    told = ", ".join(f"{v:.1f}" for v in 1e3 * np.percentile(taken, [50, 99, 100]))
    passed = f"{sum(r.passed for r in runs)} of {count}" if name == "quadrotor" else "-"
    unplanned = f", {unsolved} not planned" if unsolved else ""
    return (
        f"| {name}, {1 / period:g} Hz | {int(np.sum(taken <= period))} of {len(taken)} | {told} | "
        f"{sum(r.kept for r in runs)} of {count}{unplanned} | {passed} | {sum(r.arrived for r in runs)} of {count} | "
        f"{100 * ok / len(taken):.1f} % |"
    )


DETAILS = """| Task | Largest excess over a limit, or distance from a gate | Largest miss of the goal [m] | \
Ticks with a violated limit, with the last plan continued | Wall clock [ms]: median, 99 %, largest; in time | \
Without limits in the problem |
|---|---|---|---|---|---|
"""


def details(name, runs, bare):
    """Return the task's row of the second table."""
    followed = sum("followed further" in s for r in runs for s in r.statuses)
    gives = sum("gives way" in s for r in runs for s in r.statuses)
    wall = np.concatenate([r.wall for r in runs])
    times = ", ".join(f"{v:.1f}" for v in 1e3 * np.percentile(wall, [50, 99, 100]))
    without = f"{sum(r.kept for r in bare)} of {len(bare)} runs keep them: {_excess(bare)}" if bare else "-"
    return (
        f"| {name} | {_excess(runs)} | {max(r.ended for r in runs):.3g} | {gives}, {followed} | "
        f"{times}; {int(np.sum(wall <= runs[0].period))} of {len(wall)} | {without} |"
    )


def _excess(runs):
    return ", ".join(f"{k} {max(r.excess[k] for r in runs):.3g}" for k in runs[0].excess)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default=",".join(TASKS))
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clock", choices=("cpu", "wall"), default="cpu")
    parser.add_argument("--bare", type=int, default=DRAWS, help="runs of a problem without the limits")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    held, rows, more = True, [], []
    for name in options.only.split(","):
        runs, unsolved = measure(name, options.seed, options.count, options.clock)
        if not runs:
            print(f"{name}: no problem of {unsolved} was planned")
            held = False
            continue
        bare = measure(name, options.seed, options.bare, options.clock, bare=True)[0] if options.bare else []
        rows.append(row(name, runs, unsolved))
        more.append(details(name, runs, bare))
        print(rows[-1], more[-1], sep="\n", flush=True)
        held &= all(r.kept and r.passed and r.arrived and np.all(r.taken <= r.period) for r in runs)
    if options.markdown:
        clocks = {"cpu": "those of the controller's thread", "wall": "those of the wall's clock"}
        head = HEAD.format(seed=options.seed, count=options.count, clock=clocks[options.clock], **marked())
        write_section(options.markdown, "mpc_realtime", head + "\n".join(rows) + "\n\n" + DETAILS + "\n".join(more))
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())

"""MPC of models that touch, in real time on one core: quadrupeds that stand and trot, and a push, under blows.

    pip install -e '.[test]'
    python tests/benchmarks/mpc_contact.py [--only stand,trot,push] [--count 20] [--seed 0] [--markdown FILE]

The robots are those of example-robot-data with feet, a ground and a PD controller in each motor, as quadrupeds have.
`dd.loop.MPC` plans with steps of 20 ms and is asked at 50 Hz. What it drives is no plan's model: Drake's Simulator in
steps of 1 ms, under the old input while the controller's thread computes. An answer that takes longer than the period
is missed: the old input is held for the whole tick. A blow is an impulse at the trunk's centre of mass, given as the
speed that the whole robot would have by it. Beside it, the same blows meet the PD controllers alone; in a trot they
follow its joints' reference.

A ball on two motors pushes a box 0.4 m ahead, from where they touch and from where they do not, and the box is struck.
Beside it, the inputs of the plan alone.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np  # noqa: E402
from helpers.models import MODELS, strike  # noqa: E402
from helpers.robots import FOOT, example_robot  # noqa: E402
from pages import write_page  # noqa: E402
from pydrake.multibody.parsing import Parser  # noqa: E402
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant  # noqa: E402
from pydrake.multibody.tree import BodyIndex  # noqa: E402
from pydrake.systems.analysis import Simulator  # noqa: E402
from pydrake.systems.framework import DiagramBuilder  # noqa: E402
from rates import success_rate  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff.loop.mpc import FOLLOWED  # noqa: E402

FINE, TICK, HORIZON, LONG = 1e-3, 0.02, 10, 30  # [s], [s], knots of a quadruped, and of what is pushed
SPEEDS = (0.3, 0.6, 0.9, 1.2, 1.5)  # [m/s] of the blows
AFTER = 2.0  # [s] in which a robot has to be as it was
SOME = (0.0, 0.3, 0.6)  # [m/s] of those in a trot
STRUCK = (0.0, 0.2, 0.4)  # [m/s] of the box, back towards the ball
GAIT, SPEED, LIFT, TROTS = 0.4, 0.2, 0.05, 3.0  # [s], [m/s], [m], [s]
ON_THE_WAY, LIFTED = 0.6, 0.01  # of the reference, and [m] each foot: what a trot has to come, and to lift
TILTED, LOWER, MOVES = 0.2, 0.04, 0.5  # [rad], [m], [m/s or rad/s]: what is no recovery
LEG = (0.0, 0.8, -1.6)


@dataclass(frozen=True)
class Quadruped:
    """A file of example-robot-data: gains of its motors, their limit [N m], the links of a leg [m], and its trunk."""

    file: str
    gains: tuple[float, float]
    effort: float
    link: float
    trunk: str
    base: str = ""


SOLO = Quadruped("solo12.urdf", (5.0, 0.2), 2.7, 0.16, "base_link")
GO2 = Quadruped("go2.urdf", (60.0, 2.0), 23.7, 0.213, "base")
ROBOTS = {"solo12": SOLO, "go2": GO2}


@cache
def model_of(robot, step):
    return example_robot(robot.file, step, feet=True, gains=robot.gains, leg=LEG)


@cache
def rest_of(robot, step):
    """The state in which its controllers hold it."""
    model = model_of(robot, step)
    x = dd.rollout(model, model.default_state, np.zeros((round(2 / step), model.nu))).xs[-1]
    return np.r_[x[: model.nq], np.zeros(model.nv)]


def weights(model, robot):
    """(nx,) of the states, and (nu, nu) of the torques, in the unit of their limits."""
    states = [*[100.0] * 4, 50, 50, 400, *[2.0] * 12, *[1.0] * 3, *[4.0] * 3, *[0.02] * 12]
    return np.diag(states), 7.3 * np.eye(model.nu) / robot.effort**2


def bounds(model, robot):
    most = np.full(model.nu, robot.effort)
    return dd.Bounds(u_lower=-most, u_upper=most)


@cache
def standing(robot):
    """MPC that keeps the robot where it rests; horizons end in the cost-to-go there."""
    model, x = model_of(robot, TICK), rest_of(robot, TICK)
    steps = round((AFTER + 0.5) / TICK) + 2 * HORIZON
    Q, R = weights(model, robot)
    cost = dd.QuadraticCost(Q=Q, R=R, x_ref=x, u_ref=np.zeros(model.nu))
    problem = dd.Problem(
        model, x0=x, num_steps=steps, running_cost=cost, final_cost=dd.QuadraticCost(Q=Q, x_ref=x),
        bounds=bounds(model, robot),
    )  # fmt: skip
    plan = np.tile(x, (steps + 1, 1)), np.zeros((steps, model.nu))
    return dd.loop.MPC(problem, horizon=HORIZON, plan=plan), plan


def trot_reference(robot, times):
    """Joints' sinusoids: diagonal feet swing in turn; (xs (n, nx), torques (n, nu) beside the controllers')."""
    model, rest, nq, reach = model_of(robot, TICK), rest_of(robot, TICK), 19, 2 * robot.link * np.cos(LEG[1])

    def joints(t):
        ramp, found = min(max(t, 0.0) / GAIT, 1.0), []
        for diagonal in (0.0, 0.5, 0.5, 0.0):
            part, long = (t / GAIT + diagonal) % 1, SPEED * GAIT / 2 * ramp
            swing = 2 * part - 1
            x = long * (0.5 - 2 * part) if part < 0.5 else long * (swing - np.sin(2 * np.pi * swing) / 2 / np.pi - 0.5)
            z = reach - LIFT * ramp * (0.0 if part < 0.5 else np.sin(np.pi * swing) ** 2)
            knee = -2 * np.arccos(min(np.hypot(x, z) / (2 * robot.link), 1.0))
            found += [0.0, np.arctan2(-x, z) - knee / 2, knee]
        return np.array(found)

    q = np.array([joints(t) for t in times])
    v = np.array([(joints(t + 1e-4) - joints(t - 1e-4)) / 2e-4 for t in times])
    kp, kd = robot.gains
    xs, stance, ahead = np.tile(rest, (len(times), 1)), np.tile(LEG, 4), SPEED * np.minimum(times / GAIT, 1.0)
    xs[:, 7:nq] += q - stance
    xs[:, nq + 3], xs[:, nq + 6 :] = ahead, v
    xs[:, 4] += np.concatenate([[0.0], np.cumsum(TICK * ahead[:-1])])
    assert model.nq == nq
    return xs, kp * (q - stance) + kd * v


@cache
def trotting(robot):
    """(MPC, reference)."""
    model, steps = model_of(robot, TICK), round(TROTS / TICK) + HORIZON
    times = TICK * np.arange(steps + 1)
    xs, us = trot_reference(robot, times)
    Q, R = weights(model, robot)
    Q[4, 4], Q[22, 22] = 200, 20
    Q[range(7, 19), range(7, 19)], Q[range(25, 37), range(25, 37)] = 10, 0.1
    problem = dd.Problem(
        model, x0=xs[0], num_steps=steps, bounds=bounds(model, robot),
        running_cost=dd.optimize.TrackingCost((times, xs, us), Q=Q, R=R),
        final_cost=dd.QuadraticCost(Q=Q, x_ref=xs[-1]),
    )  # fmt: skip
    return dd.loop.MPC(problem, horizon=HORIZON, plan=(xs, us[:-1])), (xs, us)


class Plant:
    """The referee's: Drake's Simulator in steps of FINE."""

    def __init__(self, robot):
        model = model_of(robot, FINE)
        self.simulator = Simulator(model.diagram)
        root = self.simulator.get_mutable_context()
        self.plant: MultibodyPlant = model.plant
        self.context = self.plant.GetMyMutableContextFromRoot(root)
        for instance, target in model.pd_targets.items():
            self.plant.get_desired_state_input_port(instance).FixValue(self.context, target)
        self.input = self.plant.get_actuation_input_port().FixValue(self.context, np.zeros(model.nu))
        self.trunk = self.plant.GetBodyByName(robot.trunk)
        named = [self.plant.get_body(BodyIndex(i)) for i in range(1, self.plant.num_bodies())]
        self.feet = [body for body in named if self.plant.GetCollisionGeometriesForBody(body)]
        self.mass, self.steps = self.plant.CalcTotalMass(self.context), 0

    @property
    def x(self):
        return self.plant.GetPositionsAndVelocities(self.context)

    def start(self, x):
        self.simulator.get_mutable_context().SetTime(0.0)
        self.plant.SetPositionsAndVelocities(self.context, x)
        self.simulator.Initialize()
        self.steps = 0

    def heights(self):
        """[m] of the feet over the ground."""
        return [body.EvalPoseInWorld(self.context).translation()[2] - FOOT for body in self.feet]

    def go_on(self, u, to):
        """Until the step `to` under u."""
        self.input.GetMutableData().set_value(u)
        if to > self.steps:
            self.simulator.AdvanceTo((to - 0.5) * FINE)  # the steps that begin before
            self.steps = to

    def push(self, impulse):
        strike(self.plant, self.context, self.trunk, impulse)


@dataclass(eq=False)
class Run:
    """What came of one run: the referee's states (ticks + 1, nx), what each answer took [s], and what it said."""

    xs: list[np.ndarray] = field(default_factory=list)
    taken: list[float] = field(default_factory=list)
    statuses: list[str] = field(default_factory=list)
    lost: bool = False
    heights: list[list[float]] = field(default_factory=list)  # [m] of the feet over the ground

    @property
    def missed(self):
        return sum(taken > TICK for taken in self.taken)


def drive(plant, controller, x, ticks, blow=None, first=None):
    """The plant from x under a controller at 50 Hz; `blow` is (tick, impulse)."""
    run, u = Run(), np.zeros(plant.plant.num_actuators()) if first is None else first
    plant.start(x)
    run.xs.append(plant.x)
    per_tick = round(TICK / FINE)
    for k in range(ticks):
        if blow is not None and k == blow[0]:
            plant.push(blow[1])
        begin = time.thread_time()
        new = controller(plant.x, k * TICK)
        taken = time.thread_time() - begin
        run.taken.append(taken)
        run.statuses.append(getattr(controller, "status", "ok"))
        try:
            plant.go_on(u, k * per_tick + min(int(np.ceil(taken / FINE)), per_tick))
            if taken <= TICK:
                u = new
            plant.go_on(u, (k + 1) * per_tick)
        except RuntimeError:  # Drake takes no step more
            run.lost = True
            break
        run.xs.append(plant.x)
        run.heights.append(plant.heights())
    return run


class Table:
    """A plant in a plane as pydrake alone reads and steps it."""

    def __init__(self, text):
        builder = DiagramBuilder()
        self.plant, _ = AddMultibodyPlantSceneGraph(builder, FINE)
        self.plant.SetUseSampledOutputPorts(False)
        Parser(self.plant).AddModelsFromString(text, "sdf")
        self.plant.Finalize()
        self.simulator = Simulator(builder.Build())
        self.context = self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        port = self.plant.get_actuation_input_port()
        self.input, self.steps = port.FixValue(self.context, np.zeros(port.size())), 0

    x, start, go_on = Plant.x, Plant.start, Plant.go_on

    def heights(self):
        """There are no feet."""
        return []

    def push(self, change):
        """By a jump of the speeds."""
        self.plant.SetVelocities(self.context, self.plant.GetVelocities(self.context) + change)


@dataclass(frozen=True)
class Pushed:
    """What is pushed: its file, first states that touch and that do not, a reference, weights, a blow and a verdict."""

    text: str
    starts: dict[str, np.ndarray]
    xs: np.ndarray
    weights: tuple[np.ndarray, np.ndarray]
    blow: Callable[[np.random.Generator, float], np.ndarray]
    ends: Callable[[np.ndarray], bool]
    effort: float


def box_push():
    """The ball behind the box takes it 0.4 m ahead in 2 s, and stops; blows within 45 degrees of straight back."""
    times = TICK * np.arange(round(3.5 / TICK) + HORIZON + 1)
    part = np.clip(times / 2, 0, 1)
    way = 0.4 * (3 * part**2 - 2 * part**3)
    speed = np.where(part < 1, 0.4 * 6 * part * (1 - part) / 2, 0.0)
    xs = np.zeros((len(times), 10))
    xs[:, 0], xs[:, 3], xs[:, 5], xs[:, 8] = way, way - 0.2, speed, speed
    apart = np.array([0, 0, 0, -0.3, 0.0, 0, 0, 0, 0, 0.0])

    def ends(x):
        return np.hypot(x[0] - 0.4, x[1]) <= 0.03 and abs(x[2]) <= 0.2 and np.max(np.abs(x[5:8])) <= 0.05

    def blow(random, size):
        angle = np.pi + random.uniform(-np.pi / 4, np.pi / 4)
        return np.array([size * np.cos(angle), size * np.sin(angle), 3 * size * random.uniform(-1, 1), 0, 0])

    states = np.diag([200.0, 200, 50, 20, 2, 1, 1, 1, 0.5, 0.5])
    return Pushed(
        (MODELS / "box_push.sdf").read_text(), {"touching": xs[0], "apart": apart}, xs, (states, 1e-3 * np.eye(2)),
        blow, ends, 20.0,
    )  # fmt: skip


@cache
def model_of_text(text):
    folder = Path(mkdtemp())
    (folder / "task.sdf").write_text(text)
    return dd.load_model(folder / "task.sdf", time_step=TICK)


def pushes(name, make, sizes, unit):
    """Rows of a push from where it touches and where it does not."""

    def rows(seed, count):
        task, found_rows = make(), []
        model, table = model_of_text(task.text), Table(task.text)
        steps, most = len(task.xs) - 1, np.full(2, task.effort)
        Q, R = task.weights
        times = TICK * np.arange(steps + 1)
        for where, x0 in task.starts.items():
            problem = dd.Problem(
                model, x0=x0, num_steps=steps, bounds=dd.Bounds(u_lower=-most, u_upper=most),
                running_cost=dd.optimize.TrackingCost((times, task.xs), Q=Q, R=R),
                final_cost=dd.QuadraticCost(Q=Q, x_ref=task.xs[-1]),
            )  # fmt: skip
            guess = np.tile(x0, (steps + 1, 1)), np.zeros((steps, 2))
            if where == "touching":
                guess = np.vstack([x0, task.xs[1:]]), np.zeros((steps, 2))
            mpc = dd.loop.MPC(problem, horizon=LONG, plan=guess)
            planned, ticks = mpc.plan[1], steps - HORIZON
            for size in sizes:
                runs, alone = [], 0
                for i in range(count):
                    random = np.random.default_rng([seed, i, 5])
                    blow = int(random.integers(30, 90)), task.blow(random, size)
                    mpc.start(x0)
                    runs.append(drive(table, mpc, x0, ticks, blow))
                    alone += bool(task.ends(drive(table, Played(planned), x0, ticks, blow).xs[-1]))
                good = sum(not r.lost and bool(task.ends(r.xs[-1])) for r in runs)
                found_rows.append(told(f"{name}, {where}, blow of {size:g} {unit}", runs, good, alone))
        return found_rows

    return rows


def tilt(x):
    """[rad] of the base's z axis from upright."""
    return float(np.arccos(np.clip(1 - 2 * (x[1] ** 2 + x[2] ** 2) / np.sum(x[:4] ** 2), -1, 1)))


def recovered(run, rest):
    x, nq = run.xs[-1], 19
    if run.lost or not np.all(np.isfinite(x)):
        return False
    return tilt(x) <= TILTED and abs(x[6] - rest[6]) <= LOWER and np.max(np.abs(x[nq:])) <= MOVES


def blow_of(seed, speed, mass):
    angle = np.random.default_rng([seed, 7]).uniform(0, 2 * np.pi)
    return mass * speed * np.array([np.cos(angle), np.sin(angle), 0.0])


class Idle:
    """The PD controllers alone."""

    def __init__(self, nu):
        self.nu = nu

    def __call__(self, x, t):
        return np.zeros(self.nu)


def percentiles(taken):
    return ", ".join(f"{v:.1f}" for v in 1e3 * np.percentile(taken, [50, 95, 100]))


def rate(found, of):
    r = success_rate(found, of)
    return f"{found} of {of} ({100 * r.lower:.0f} to {100 * r.upper:.0f} %)"


def trotted(run, rest, xs):
    """Whether it is upright and as high as it was, has come most of its way, and has lifted each foot."""
    x = run.xs[-1]
    if run.lost or not np.all(np.isfinite(x)) or np.any(np.max(run.heights, axis=0) < LIFTED):
        return False
    way = (x[4] - rest[4]) / (xs[len(run.xs) - 1, 4] - xs[0, 4])
    return tilt(x) <= TILTED and abs(x[6] - rest[6]) <= LOWER and way >= ON_THE_WAY


class Played:
    """Inputs us (N, nu) as they are."""

    def __init__(self, us):
        self.us = us

    def __call__(self, x, t):
        return self.us[min(round(t / TICK), len(self.us) - 1)]


def told(task, found, good, alone):
    """A row of the page."""
    taken, missed = np.concatenate([r.taken for r in found]), sum(r.missed for r in found)
    followed = sum(FOLLOWED in s for r in found for s in r.statuses)
    row = (
        f"| {task} | {rate(good, len(found))} | {rate(alone, len(found))} | {percentiles(taken)} | "
        f"{missed} of {len(taken)} | {100 * followed / len(taken):.1f} % |"
    )
    print(row, flush=True)
    return row


def trot(seed, count):
    """Rows of the robots that trot."""
    rows = []
    for name, robot in ROBOTS.items():
        plant, (mpc, (xs, us)), rest = Plant(robot), trotting(robot), rest_of(robot, FINE)
        for speed in SOME:
            found, alone = [], 0
            for i in range(count):
                tick = int(np.random.default_rng([seed, i, 3]).integers(50, 75))
                blow = tick, blow_of(1000 * seed + i, speed, plant.mass)
                mpc.start(xs[0])
                found.append(drive(plant, mpc, rest, round(TROTS / TICK), blow))
                alone += trotted(drive(plant, Played(us), rest, round(TROTS / TICK), blow), rest, xs)
            good = sum(trotted(r, rest, xs) for r in found)
            rows.append(told(f"{name} trots, blow of {speed:g} m/s", found, good, alone))
    return rows


def stand(seed, count):
    """Rows of the robots that stand."""
    rows = []
    for name, robot in ROBOTS.items():
        plant, (mpc, plan) = Plant(robot), standing(robot)
        rest, ticks = rest_of(robot, FINE), round((AFTER + 0.2) / TICK)
        for speed in SPEEDS:
            found, alone = [], 0
            for i in range(count):
                blow = 10, blow_of(1000 * seed + i, speed, plant.mass)
                mpc.start(plan[0][0])
                found.append(drive(plant, mpc, rest, ticks, blow))
                alone += recovered(drive(plant, Idle(len(plan[1][0])), rest, ticks, blow), rest)
            up = sum(recovered(r, rest) for r in found)
            rows.append(told(f"{name} stands, blow of {speed:g} m/s ({plant.mass * speed:.3g} N s)", found, up, alone))
    return rows


HEAD = """
## Models that touch

Written by `python tests/benchmarks/mpc_contact.py --markdown docs/mpc_realtime.md`, seed {seed}, {count} runs a row.
Latencies are those of the controller's thread, on a machine that other work kept busy.

{told}

| Task | Recovered (95 % Wilson) | PD alone | Latency [ms]: median, 95 %, worst | Missed ticks | Followed further |
|---|---|---|---|---|---|
"""
TASKS: dict[str, Callable] = {
    "stand": stand,
    "trot": trot,
    "push": pushes("box pushed", box_push, STRUCK, "m/s"),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default=",".join(TASKS))
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    rows = []
    for name in options.only.split(","):
        rows += TASKS[name](options.seed, options.count)
    if options.markdown:
        told = "\n\n".join(__doc__.strip().split("\n\n")[2:])
        page = options.markdown.read_text().split(HEAD.split("\n")[1])[0].rstrip("\n") + "\n"
        page += HEAD.format(seed=options.seed, count=options.count, told=told)
        write_page(options.markdown, page + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()

"""MPC of models that touch, in real time on one core: a standing quadruped under blows, and a trot.

    pip install -e '.[test]'
    python tests/benchmarks/mpc_contact.py [--only stand,trot] [--count 20] [--seed 0] [--markdown FILE]

The robots are those of example-robot-data with feet, a ground and a PD controller in each motor, as quadrupeds have.
`dd.loop.MPC` plans with steps of 20 ms and is asked at 50 Hz. What it drives is no plan's model: Drake's Simulator in
steps of 1 ms, under the old input while the controller's thread computes. An answer that takes longer than the period
is missed: the old input is held for the whole tick. A blow is an impulse at the trunk's centre of mass, given as the
speed that the whole robot would have by it. Beside it, the same blows meet the PD controllers alone.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np  # noqa: E402
from helpers.robots import example_robot  # noqa: E402
from pydrake.multibody.plant import MultibodyPlant  # noqa: E402
from pydrake.multibody.tree import JacobianWrtVariable  # noqa: E402
from pydrake.systems.analysis import Simulator  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff._base.statistics import success_rate  # noqa: E402
from drake_diff.loop.mpc import FOLLOWED  # noqa: E402

FINE, TICK, HORIZON = 1e-3, 0.02, 10  # [s], [s], knots
SPEEDS = (0.3, 0.6, 0.9, 1.2, 1.5)  # [m/s] of the blows
AFTER = 2.0  # [s] in which a robot has to be as it was
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
        self.mass, self.steps = self.plant.CalcTotalMass(self.context), 0

    @property
    def x(self):
        return self.plant.GetPositionsAndVelocities(self.context)

    def start(self, x):
        self.simulator.get_mutable_context().SetTime(0.0)
        self.plant.SetPositionsAndVelocities(self.context, x)
        self.simulator.Initialize()
        self.steps = 0

    def go_on(self, u, to):
        """Until the step `to` under u."""
        self.input.GetMutableData().set_value(u)
        if to > self.steps:
            self.simulator.AdvanceTo((to - 0.5) * FINE)  # the steps that begin before
            self.steps = to

    def push(self, impulse):
        plant, context, world = self.plant, self.context, self.plant.world_frame()
        at = self.trunk.CalcCenterOfMassInBodyFrame(context)
        J = plant.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, self.trunk.body_frame(), at, world, world
        )
        change = np.linalg.solve(plant.CalcMassMatrix(context), J.T @ impulse)
        plant.SetVelocities(context, plant.GetVelocities(context) + change)


@dataclass(eq=False)
class Run:
    """What came of one run: the referee's states (ticks + 1, nx), what each answer took [s], and what it said."""

    xs: list[np.ndarray] = field(default_factory=list)
    taken: list[float] = field(default_factory=list)
    statuses: list[str] = field(default_factory=list)
    lost: bool = False

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
    return run


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


def stand(seed, count):
    """(rows, held) of the robots under blows."""
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
            taken, missed = np.concatenate([r.taken for r in found]), sum(r.missed for r in found)
            followed = sum(FOLLOWED in s for r in found for s in r.statuses)
            up = sum(recovered(r, rest) for r in found)
            rows.append(
                f"| {name} stands, blow of {speed:g} m/s ({plant.mass * speed:.3g} N s) | {rate(up, count)} | "
                f"{rate(alone, count)} | {percentiles(taken)} | {missed} of {len(taken)} | "
                f"{100 * followed / len(taken):.1f} % |"
            )
            print(rows[-1], flush=True)
    return rows


HEAD = """
## Models that touch

Written by `python tests/benchmarks/mpc_contact.py --markdown docs/mpc_realtime.md`, seed {seed}, {count} runs a row.
{told}

| Task | Recovered (95 % Wilson) | PD alone | Latency [ms]: median, 95 %, worst | Missed ticks | Followed further |
|---|---|---|---|---|---|
"""
TASKS: dict[str, Callable] = {"stand": stand}


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
        told = " ".join(__doc__.split("\n\n")[-1].split())
        page = options.markdown.read_text().split(HEAD.split("\n")[1])[0].rstrip("\n") + "\n"
        page += HEAD.format(seed=options.seed, count=options.count, told=told)
        options.markdown.write_text(page + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()

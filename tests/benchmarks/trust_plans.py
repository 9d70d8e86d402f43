"""Check claims of `converged` on random slides, pendulums, cart-poles, wheels and satellites with a referee.

    python tests/benchmarks/trust.py --only plans --seed 0 --count 200
    python tests/benchmarks/trust_plans.py 0 3000 --out plans.jsonl [--seconds 170]     # continues a stopped run
    python tests/benchmarks/trust_plans.py 17 18                                         # one case

Each seed draws a system (a URDF file or `Dynamics`), masses, lengths, limits, a horizon, units of 1e-6 to 1e6, hard or
soft goals or both, and a method. The referee uses a separate plant of pydrake or the formula, stepped or integrated by
SciPy, in open loop and under a separate TVLQR about `xs` and `us`. It shares no code with drake_diff.
"""

import argparse
import json
import math
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import _one_thread  # noqa: F401 (before NumPy)
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from rates import success_rate
from scipy.integrate import solve_ivp

import drake_diff as dd

COUNT, EVERY_BLOCK = 200, 25  # number of cases; one of 25 seeds has a narrow force or cost
PART = 0.01  # tolerance of a replay, relative to a state's travel and to the cost
WIDE = 0.05  # the same for a state along a motion under the referee's feedback, whose weights differ
EFFORTS = (0.1, 0.01, 1.0, 1e30)  # weights of an input in the referee's regulators; 1e30 is no feedback
FREE = np.nan
FOLDER = tempfile.TemporaryDirectory()
JOINT = """<link name="{name}"><inertial><origin xyz="0 0 {com!r}"/><mass value="{mass!r}"/><inertia ixx="{inertia!r}"
iyy="{inertia!r}" izz="{inertia!r}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{name}_joint" type="{kind}"><origin xyz="0 0 {offset!r}"/><parent link="{parent}"/><child link="{name}"/>
<axis xyz="{axis}"/><limit effort="{effort!r}" lower="-1e30" upper="1e30" velocity="1e30"/>
<dynamics damping="{damping!r}"/></joint>"""
MOTOR = """<transmission name="{name}_motor"><type>transmission_interface/SimpleTransmission</type>
<joint name="{name}_joint"/><actuator name="{name}_motor"/></transmission>"""


@dataclass
class Task:
    """A random problem, with data for the referee."""

    row: str
    system: Any  # the path of a file, or a function (x, u) -> rates
    goal: np.ndarray  # (nx,), NaN where free
    natural: np.ndarray  # (nx,) typical size of each state
    duration: float
    num_steps: int
    limits: np.ndarray  # (nu,)
    x0: np.ndarray
    gravity: float = 0.0
    kind: str = "hard"  # "hard", "soft" or "both" goals, or "free horizon"
    method: str = "auto"
    feasible: bool | None = None  # from a closed form
    speed: float = np.inf  # limit of the first velocity
    waypoint: float = FREE  # of the first coordinate, at the middle knot
    weights: dict[str, np.ndarray] = field(default_factory=dict)  # of the cost: Q, R, F
    peak: Any = None  # part of the running cost, as a function of the first coordinate
    narrow: float = np.inf  # [s] in which a force or cost acts

    @property
    def has_model(self) -> bool:
        return isinstance(self.system, Path)

    def rate(self, x, u):
        off = x - np.nan_to_num(self.goal)
        rate = 1.0 if self.kind == "free horizon" else off @ self.weights["Q"] @ off + u @ self.weights["R"] @ u
        return rate if self.peak is None else rate + self.peak(x[0])

    def final(self, x):
        off = x - np.nan_to_num(self.goal)
        return off @ self.weights["F"] @ off

    def problem(self):
        nq, top = len(self.x0) // 2, np.full(len(self.x0), np.inf)
        top[nq] = self.speed
        more: dict[str, Any] = {}
        if self.has_model:
            step = self.duration / self.num_steps
            system = dd.load_model(self.system, time_step=step, gravity=[0, 0, -self.gravity])
        else:
            system, more["horizon"] = dd.Dynamics(self.system, 2 * nq, len(self.limits)), self.duration
        limits = {"u_lower": -self.limits, "u_upper": self.limits}
        if self.speed < np.inf:
            limits |= {"x_lower": -top, "x_upper": top}
        if not np.isnan(self.waypoint):
            more["waypoints"] = {self.num_steps // 2: [self.waypoint, *[FREE] * (2 * nq - 1)]}
        if self.kind == "free horizon":
            more |= {"horizon": (0.05 * self.duration, 20 * self.duration), "running_cost": 1.0}
        else:
            reference = np.nan_to_num(self.goal)
            more["running_cost"] = dd.QuadraticCost(self.weights["Q"], self.weights["R"], reference)
            if self.peak is not None:
                more["running_cost"] = self.rate
            if np.any(self.weights["F"]):
                more["final_cost"] = dd.QuadraticCost(self.weights["F"], None, reference)
        if self.kind != "soft":
            more["x_goal"] = self.goal
        return dd.Problem(system, x0=self.x0, num_steps=self.num_steps, bounds=dd.Bounds(**limits), **more)


# ------------------------------------------------------------------------------ systems, in random units


def file_of(name, links, motors):
    """Write a URDF of `links` in a chain, of which those in `motors` are driven, and return the path."""
    parents = ["world", *(link["name"] for link in links)]
    usual = {"com": 0.0, "offset": 0.0, "damping": 0.0, "kind": "continuous", "axis": "0 1 0", "effort": 1e30}
    text = "".join(
        JOINT.format(**_plain(usual | link), parent=parent) for link, parent in zip(links, parents, strict=False)
    )
    path = Path(FOLDER.name) / f"{name}.urdf"
    motors = "".join(MOTOR.format(name=motor) for motor in motors)
    path.write_text(f'<robot name="robot"><link name="world"/>{text}{motors}</robot>')
    return path


def _plain(link):
    return {key: value if isinstance(value, str) else float(value) for key, value in link.items()}


def rod(name, m, l, **more):  # noqa: E741
    """Return a uniform rod that hangs from its joint."""
    return {"name": name, "mass": m, "com": -l / 2, "inertia": m * l * l / 12, **more}


def slide(random, name, L, M, S):
    m, way, duration = random.uniform(0.5, 2) * M, random.uniform(0.1, 3) * L, random.uniform(0.5, 3) * S
    strength = 10 ** random.choice([random.uniform(-0.7, -0.02), random.uniform(0.02, 1)])
    force, count = strength * 4 * m * way / duration**2, 2 * int(random.integers(5, 20))
    links = [{"name": "block", "mass": m, "inertia": m * L * L, "kind": "prismatic", "axis": "1 0 0"}]
    system = file_of(name, links, ["block"]) if random.random() < 0.6 else lambda x, u: [x[1], u[0] / m]
    goal, natural, limits = np.array([way, 0]), np.array([way, way / duration]), np.array([force])
    task = Task("infeasible in other units", system, goal, natural, duration, count, limits, np.zeros(2))
    if random.random() < 0.2:
        task.speed = random.uniform(0.5, 1.5) * 2 * way / duration
    elif random.random() < 0.2:
        task.waypoint = random.uniform(0.3, 0.7) * way
    else:
        task.feasible = bool(strength >= 1)  # F T^2 / 4 m is the longest distance from rest to rest
    return task


def pendulum(random, name, L, M, S):
    m, l, g = random.uniform(0.3, 3) * M, random.uniform(0.2, 2) * L, 9.81 * L / S**2  # noqa: E741
    beat, damping = math.sqrt(l / g), random.uniform(0, 0.1)
    duration, count = random.uniform(3, 10) * beat, int(random.integers(15, 60))
    torque, inertia = random.uniform(0.3, 3) * m * g * l, m * l * l
    resists = damping * inertia / beat
    if random.random() < 0.6:
        links = [{"name": "arm", "mass": m, "com": -l, "inertia": 1e-3 * inertia, "damping": resists}]
        system = file_of(name, links, ["arm"])
    else:
        system = lambda x, u: [x[1], (u[0] - m * g * l * np.sin(x[0]) - resists * x[1]) / inertia]  # noqa: E731
    start = random.uniform(-1, 1) * (random.random() < 0.5)
    goal, natural = np.array([random.choice([np.pi, random.uniform(-2, 2)]), 0]), np.array([1, 1 / beat])
    task = Task("open loop", system, goal, natural, duration, count, np.array([torque]), np.array([start, 0.0]), g)
    if random.random() < 0.15:
        task.speed = random.uniform(1, 3) / beat
    return task


def cart_pole(random, name, L, M, S):
    """Return a task of a cart-pole, either that of the README within a tenth or a random one."""
    readme = random.random() < 0.4
    heavy, light, l = np.array([M, 0.3 * M, 0.5 * L]) * random.uniform(*(0.9, 1.1) if readme else (0.4, 2.5), 3)  # noqa: E741
    g = 9.81 * L / S**2
    if random.random() < 0.7:
        cart = {"name": "cart", "mass": heavy, "inertia": heavy * L * L, "kind": "prismatic", "axis": "1 0 0"}
        pole = {"name": "pole", "mass": light, "com": -l, "inertia": 1e-4 * light * l * l}
        system = file_of(name, [cart, pole], ["cart"])
    else:

        def system(x, u):
            s, c, w, push = np.sin(x[1]), np.cos(x[1]), x[3], u[0]
            below = heavy + light * s * s
            ahead = (push + light * s * (l * w * w + g * c)) / below
            return [x[2], w, ahead, -(ahead * c + g * s) / l]

    duration, count = random.uniform(1.6, 2.4) * S, int(random.choice([100, 50, 40, 25]))
    goal, weight = np.array([random.uniform(0.3, 1) * L, np.pi, 0, 0]), (heavy + light) * g
    natural = np.array([L, 1, L / S, 1 / S])
    limit = np.array([random.uniform(1, 4) * weight])
    return Task("README" if readme else "own step", system, goal, natural, duration, count, limit, np.zeros(4), g)


def double_pendulum(random, name, L, M, S):
    m1, m2 = random.uniform(0.3, 2, 2) * M
    l1, l2 = random.uniform(0.3, 1, 2) * L
    g, both = 9.81 * L / S**2, m1 * l1 / 2 + m2 * (l1 + l2 / 2)
    path = file_of(name, [rod("upper", m1, l1), rod("lower", m2, l2, offset=-l1)], ["upper", "lower"])
    duration, count = random.uniform(0.8, 2) * S, int(random.integers(20, 60))
    goal = np.array([*random.choice([[np.pi, 0], [*random.uniform(-2, 2, 2)]]), 0, 0])
    limits = random.uniform(1.2, 3) * g * np.array([both, m2 * l2])
    return Task("soft costs", path, goal, np.array([1, 1, 1 / S, 1 / S]), duration, count, limits, np.zeros(4), g)


def wheel(random, name, L, M, S):
    m, l, g = random.uniform(0.3, 1.5) * M, random.uniform(0.2, 0.6) * L, 9.81 * L / S**2  # noqa: E741
    spin = 10 ** random.uniform(-4.5, -2) * m * l * l
    links = [rod("pole", m, l), {"name": "wheel", "mass": 0.01 * m, "inertia": spin, "offset": -l}]
    count = int(random.choice([40, 60, 80]))
    duration, limit = count * random.choice([0.04, 0.05]) * S, random.uniform(0.3, 1.2) * m * g * l / 2
    natural = np.array([1, 1, 1 / S, 1 / S])
    goal = np.array([np.pi, FREE, 0, random.choice([FREE, FREE, 0])])
    path = file_of(name, links, ["wheel"])
    return Task("reaction wheel", path, goal, natural, duration, count, np.array([limit]), np.zeros(4), g)


def satellite(random, name, L, M, S):
    """Return a task of a body with modified Rodrigues parameters, or with three hinges through one point."""
    inertia, duration = random.uniform(0.5, 2, 3) * M * L * L, random.uniform(2, 5) * S
    inertia[2] = min(inertia[2], 0.9 * (inertia[0] + inertia[1]))
    limits, count = random.uniform(2, 8, 3) * inertia / duration**2, int(random.integers(10, 30))
    goal = np.array([*random.uniform(-0.4, 0.4, 3), 0, 0, 0])

    def rates(x, u):
        s, w = np.array(x[:3]), np.array(x[3:])
        turn = 0.25 * ((1 - s @ s) * w + 2 * np.cross(s, w) + 2 * s * (s @ w))
        return [*turn, *((np.array(u) - np.cross(w, inertia * w)) / inertia)]

    system = rates
    if random.random() < 0.5:
        axes, sizes = ("1 0 0", "0 1 0", "0 0 1"), inertia.mean() * np.array([0.02, 0.02, 1])
        links = [{"name": f"ring{i}", "mass": M, "inertia": sizes[i], "axis": axes[i]} for i in range(3)]
        system = file_of(name, links, ["ring0", "ring1", "ring2"])
    natural = np.array([1, 1, 1, *[1 / duration] * 3])
    return Task("satellite", system, goal, natural, duration, count, limits, np.zeros(6))


def block(random, name, L, M, S):
    """Return a task of a slide with a force or a cost that acts over 10^-3.5 to 10^-2 of its path."""
    m, way, duration = random.uniform(0.5, 2) * M, random.uniform(0.1, 3) * L, random.uniform(0.5, 3) * S
    width, at, is_cost = 10 ** random.uniform(-3.5, -2) * way, random.uniform(0.2, 0.8) * way, random.random() < 0.5
    limits, speed = random.uniform(1.5, 4, 1) * 4 * m * way / duration**2, 1.5 * way / duration
    bump = lambda q: np.exp(-(((q - at) / width) ** 2)) / (width * np.sqrt(np.pi))  # noqa: E731
    work = 0.0 if is_cost else random.uniform(-0.5, 0.5) * m * speed**2
    goal, natural = np.array([way, 0]), np.array([way, way / duration])
    system, count = lambda x, u: [x[1], (u[0] + work * bump(x[0])) / m], int(random.integers(10, 40))
    task = Task("narrow force or cost", system, goal, natural, duration, count, limits, np.zeros(2))
    if is_cost:
        height = random.uniform(0.05, 1) * 12 * 0.1 * (m * way / duration**2 / limits[0]) ** 2 * speed
        task.peak = lambda q: height * bump(q)
    task.narrow = width / speed
    return task


SYSTEMS = (slide, slide, pendulum, pendulum, cart_pole, double_pendulum, wheel, satellite)


def drawn(seed):
    """Return the task of a seed."""
    random, units = np.random.default_rng([37, seed]), np.ones(3)
    make = block if seed % EVERY_BLOCK == EVERY_BLOCK - 1 else SYSTEMS[seed % len(SYSTEMS)]
    if random.random() < (0.7 if make is slide else 0.3):
        units[random.integers(3)] = 10 ** random.uniform(-6, 6)
        if random.random() < 0.3:
            units = 10 ** random.uniform(-3, 3, 3)
    task = make(random, f"case_{seed}", *units)
    kinds = ["hard", "hard", "soft", "both"] if make is not double_pendulum else ["hard", "soft", "soft", "both"]
    kinds += ["free horizon"] * int(make in (slide, pendulum) and np.isnan(task.waypoint))
    task.kind = str(random.choice(kinds))
    if make is block:
        task.kind = "hard"
    if task.kind in ("soft", "both", "free horizon"):
        task.feasible = None
    task.method = str(random.choice(["auto", "auto", "collocation", "shooting", "ilqr"]))
    if task.kind == "free horizon" or not task.has_model:
        task.method = str(random.choice(["auto", "collocation"]))
    scale = 10 ** random.uniform(-6, 6) if random.random() < 0.3 else 1.0
    near = np.where(np.isnan(task.goal), 0, scale / task.natural**2)
    soft = np.diag(near) * 10 ** random.uniform(-2, 1) * (task.kind == "soft") / task.duration
    end = np.diag(near) * 10 ** random.uniform(0, 3) * (task.kind in ("soft", "both"))
    task.weights = {"Q": soft, "R": np.diag(0.1 * scale / task.limits**2) / task.duration, "F": end}
    return task


# ------------------------------------------------------------------------------ the referee


class Referee:
    """Independent steps and rates of a task's system, and the motions of a solution's arrays with them."""

    def __init__(self, task: Task, solution: Any):
        self.task, self.xs, self.us = task, np.array(solution.xs), np.array(solution.us)
        self.times = np.linspace(0, float(solution.horizon), len(self.us) + 1)
        if solution.mesh is not None:
            self.times = float(solution.horizon) * np.array(solution.mesh)
        self.ends = self.us if solution.u_final is None else np.vstack([self.us, solution.u_final])
        self.middle = None if solution.us_mid is None else np.array(solution.us_mid)
        self.cost, self.cost_error = solution.cost, getattr(solution, "cost_error", 0.0)
        self.slopes: dict[tuple, list] = {}
        travel = np.maximum(np.ptp(self.xs, axis=0), np.abs(np.nan_to_num(task.goal - task.x0)))
        self.scale = np.maximum(travel, 1e-3 * task.natural)
        self.plants: dict[float, tuple] = {}

    def plant(self, step):
        if step not in self.plants:
            plant = MultibodyPlant(step)
            if step:
                plant.SetUseSampledOutputPorts(False)
            Parser(plant).AddModels(str(self.task.system))
            plant.mutable_gravity_field().set_gravity_vector([0, 0, -self.task.gravity])
            plant.Finalize()
            self.plants[step] = plant, plant.CreateDefaultContext()
        return self.plants[step]

    def set(self, step, x, u):
        plant, context = self.plant(step)
        if not np.all(np.isfinite(x)):
            raise FloatingPointError("a state is not finite")
        plant.SetPositionsAndVelocities(context, x)
        plant.get_actuation_input_port().FixValue(context, u)
        return plant, context

    def step(self, h, x, u):
        plant, context = self.set(h, x, u)
        return np.array(plant.EvalUniquePeriodicDiscreteUpdate(context).value())

    def rates(self, x, u):
        if not self.task.has_model:
            return np.array(self.task.system(x, u), dtype=float)
        plant, context = self.set(0.0, x, u)
        return plant.EvalTimeDerivatives(context).CopyToVector()

    def input(self, k, s):
        """Return the input (nu,) at the fraction `s` of interval k."""
        if len(self.ends) == len(self.us):
            return self.us[k]
        first, last = self.ends[k], self.ends[k + 1]
        mid = (first + last) / 2 if self.middle is None else self.middle[k]
        return first * (1 - s) * (1 - 2 * s) + mid * 4 * s * (1 - s) + last * s * (2 * s - 1)

    def state(self, k, s):
        """Return the plan's state (nx,) at the fraction `s` of interval k, by the cubic from states and rates."""
        h, x, y = self.times[k + 1] - self.times[k], self.xs[k], self.xs[k + 1]
        f, g = self.rates(x, self.input(k, 0.0)), self.rates(y, self.input(k, 1.0))
        return (1 + 2 * s) * (1 - s) ** 2 * x + s * s * (3 - 2 * s) * y + h * s * (1 - s) * ((1 - s) * f - s * g)

    def along(self, k, x):
        """Integrate the state and the cost (nx + 1,) accurately over interval k under the plan's input."""
        h = self.times[k + 1] - self.times[k]

        def slopes(s, z):
            u = self.input(k, s)
            return h * np.append(self.rates(z[:-1], u), self.task.rate(z[:-1], u))

        least = 1e-12 * np.append(self.scale, max(abs(self.cost), 1e-300))
        step = self.task.narrow / 3 / h
        done = solve_ivp(slopes, (0, 1), np.append(x, 0.0), method="DOP853", rtol=1e-10, atol=least, max_step=step)
        return done.y[:, -1]

    def open_loop(self, plant):
        """Return xs (N+1, nx) and the cost of the plant "steps" or "continuous" under the inputs alone."""
        x, cost, xs = self.xs[0], 0.0, [self.xs[0]]
        for k, u in enumerate(self.us):
            if plant == "steps":
                h = self.task.duration / self.task.num_steps
                cost += h * self.task.rate(x, u)
                x = self.step(h, x, u)
            else:
                z = self.along(k, x)
                x, cost = z[:-1], cost + z[-1]
            xs.append(x)
        return np.array(xs), cost + self.task.final(x)

    def pieces(self, plant, parts):
        """Return (plan's state, map (x, change of the input) -> next x, length [s]) of `parts` pieces per interval."""
        made = []
        for k in range(len(self.us)):
            for j in range(parts):
                h, s = (self.times[k + 1] - self.times[k]) / parts, j / parts
                if plant == "steps":
                    ahead = partial(self._stepped, self.task.duration / self.task.num_steps / parts, self.us[k])
                    start = (1 - s) * self.xs[k] + s * self.xs[k + 1]
                else:
                    ahead = partial(self._integrated, k, s, h)
                    start = self.state(k, s)
                made.append((start, ahead, h))
        return made

    def _within(self, u):
        return np.clip(u, -self.task.limits, self.task.limits)

    def _stepped(self, h, u, x, change):
        return self.step(h, x, self._within(u + change))

    def _integrated(self, k, s, h, x, change):
        whole = self.times[k + 1] - self.times[k]
        count = max(2, math.ceil(3 * h / self.task.narrow))
        for i in range(count):  # fourth-order Runge-Kutta
            d = h / count
            first, mid, last = (self._within(self.input(k, s + (i * d + c) / whole) + change) for c in (0, d / 2, d))
            a = self.rates(x, first)
            b = self.rates(x + d / 2 * a, mid)
            c = self.rates(x + d / 2 * b, mid)
            x = x + d / 6 * (a + 2 * b + 2 * c + self.rates(x + d * c, last))
        return x

    def under_feedback(self, plant, parts, effort):
        """Return states (N parts + 1, nx) under TVLQR about the plan with input weight `effort`, and the plan's."""
        pieces, n = self.pieces(plant, parts), len(self.scale)
        range_u = np.minimum(np.maximum(np.ptp(self.us, axis=0), 1e-3 * self.task.limits), self.task.limits)
        if (plant, parts) not in self.slopes:
            small, slopes = 1e-6 * np.concatenate([self.scale, range_u]), []
            for start, ahead, _ in pieces:
                up = [ahead(start + e[:n], e[n:]) - ahead(start - e[:n], -e[n:]) for e in np.diag(small)]
                slopes.append(np.array(up).T / (2 * small))
            self.slopes[plant, parts] = slopes
        gains, Q = [], np.diag(1 / self.scale**2)
        P, R = 100 * Q, effort * np.diag(1 / range_u**2)
        for J, piece in zip(self.slopes[plant, parts][::-1], pieces[::-1], strict=True):
            A, B, h = J[:, :n], J[:, n:], piece[2] / self.times[-1]
            gains.append(np.linalg.solve(h * R + B.T @ P @ B, B.T @ P @ A))
            P = h * Q + A.T @ P @ (A - B @ gains[-1])
            P = (P + P.T) / 2
        x, xs = self.xs[0], [self.xs[0]]
        for K, (start, ahead, _) in zip(gains[::-1], pieces, strict=True):
            x = ahead(x, -K @ (x - start))
            xs.append(x)
        return np.array(xs), np.array([piece[0] for piece in pieces] + [self.xs[-1]])

    def complaints(self, xs, plan, goal_part, part):
        """Return messages on the deviations of a motion from the plan and from the task."""
        told = []
        if not np.all(np.isfinite(xs)):
            return ["it diverges"]
        off = np.abs(xs - plan).max(axis=0) / self.scale
        if off.max() > part:
            told.append(f"state {off.argmax()} is {off.max():.2g} of its travel from the plan")
        miss = np.nan_to_num(np.abs(xs[-1] - self.task.goal)) / self.scale
        if self.task.kind != "soft" and miss.max() > goal_part:
            i = miss.argmax()
            told.append(f"state {i} ends {abs(xs[-1, i] - self.task.goal[i]):.3g} ({miss[i]:.2g} of its travel) off")
        first = len(self.scale) // 2
        if np.abs(xs[1:, first]).max() > self.task.speed + part * self.scale[first]:
            told.append(f"the speed is {np.abs(xs[:, first]).max():.3g}, {self.task.speed:.3g} allowed")
        middle = xs[len(xs) // 2, 0]
        if len(self.us) == self.task.num_steps and abs(middle - self.task.waypoint) > part * self.scale[0]:
            told.append(f"it passes its waypoint {abs(middle - self.task.waypoint):.3g} off")
        return told

    def cost_complaints(self, cost):
        """Return a message if a motion's cost is not the reported cost; 1e-6 of the cost without motion is allowed."""
        task = self.task
        nothing = task.duration * task.rate(task.x0, 0 * task.limits) + task.final(task.x0)
        room = max(PART * max(abs(cost), abs(self.cost)), np.nan_to_num(self.cost_error), 1e-6 * nothing)
        return [] if abs(cost - self.cost) <= room else [f"the cost is {cost:.5g}, {self.cost:.5g} reported"]

    def judge_open(self, plant):
        """Return the complaints about the motion in open loop."""
        try:
            with np.errstate(all="ignore"):
                xs, cost = self.open_loop(plant)
        except (RuntimeError, FloatingPointError, ValueError) as error:
            return [f"no motion: {str(error)[:60]}"]
        return self.complaints(xs, self.xs, PART, PART) + self.cost_complaints(cost)

    def judge_feedback(self, plant, parts, goal_part, part=WIDE, efforts=EFFORTS):
        """Return the complaints about the first regulator, or [] if one of the regulators has no complaints."""
        best = None
        for effort in efforts:
            try:
                with np.errstate(all="ignore"):
                    found = self.complaints(*self.under_feedback(plant, parts, effort), goal_part, part)
            except (RuntimeError, FloatingPointError, ValueError, np.linalg.LinAlgError) as error:
                found = [f"no motion: {str(error)[:60]}"]
            if not found:
                return []
            best = best or found
        return best

    def always(self):
        """Return the complaints about the arrays."""
        told = []
        if not (np.all(np.isfinite(self.xs)) and np.all(np.isfinite(self.us)) and np.isfinite(self.cost)):
            return ["a number is not finite"]
        parts = [self.input(k, s) for k in range(len(self.us)) for s in (0, 0.25, 0.5, 0.75, 1)]
        if (over := (np.abs(parts) / self.task.limits).max()) > 1 + PART:
            told.append(f"an input is {over:.5g} of its limit")
        if (np.abs(self.xs[0] - self.task.x0) > 1e-6 * self.scale).any():
            told.append("it does not start at x0")
        return told


def claims(task, solution):
    """Return (plant, feedback) in which a solution must hold, by its claim or, without a claim, by its method."""
    steps = task.has_model and task.kind != "free horizon" and task.method != "collocation"
    if hasattr(solution, "plant"):
        return solution.plant, solution.feedback
    open_loop = "on the plant open loop" in solution.message or (not task.has_model and "open loop" in solution.message)
    if steps and task.method in ("auto", "shooting"):
        return "steps", None
    return ("steps" if steps else "continuous"), None if open_loop else "TVLQR"


def refute(task, solution):
    """Return the complaints about a solution, its plant and its feedback, and for steps the complaints at h/8."""
    referee = Referee(task, solution)
    plant, feedback = claims(task, solution)
    wanted = task.has_model and task.kind != "free horizon" and task.method != "collocation"
    found = [f"arrays: {c}" for c in referee.always()]
    if task.feasible is False:
        found.append("a closed form says that the task cannot be done")
    if wanted and plant != "steps":
        found.append(f"the plan of {task.method} is {plant}")
    if found and "finite" in found[0]:
        return {"complaints": found, "plant": plant, "feedback": feedback, "h/8": []}
    if feedback is None:
        found += [f"{plant}, open loop: {c}" for c in referee.judge_open(plant)]
    else:
        parts = 1 if plant == "steps" else 4
        found += [f"{plant}, {feedback}: {c}" for c in referee.judge_feedback(plant, parts, PART)]
    elsewhere = []
    if plant == "steps" and not found:
        elsewhere = referee.judge_feedback("steps", 8, WIDE, 5 * WIDE)
    return {"complaints": found, "plant": plant, "feedback": feedback, "h/8": elsewhere}


def judged(seed):
    """Solve the task of a seed, and return a row with the task, the status, and the complaints of the referee."""
    task, begin = drawn(seed), time.perf_counter()
    line = {"seed": seed, "row": task.row, "kind": task.kind, "method": task.method, "feasible": task.feasible}
    line["system"] = "model" if task.has_model else "Dynamics"
    try:
        solution = dd.solve(task.problem(), method=task.method, max_iterations=300)
    except (dd.exceptions.DrakeDiffError, ValueError, RuntimeError) as error:
        status = {"status": type(error).__name__, "message": str(error)[:200]}
        return line | status | {"solve": time.perf_counter() - begin}
    line |= {"status": solution.status.value, "message": solution.message[:300], "solve": time.perf_counter() - begin}
    if line["status"] in ("converged", "converged_not_verified"):
        line |= refute(task, solution)
    return line | {"seconds": time.perf_counter() - begin}


def counts(lines, key):
    """Return the counts for each value of `key`."""
    table = {}
    for line in lines:
        row = table.setdefault(line[key], Counter())
        row["cases"] += 1
        row["success"] += line["status"] == "converged"
        row["false"] += line["status"] == "converged" and bool(line["complaints"])
        row["not at h/8"] += line["status"] == "converged" and bool(line["h/8"])
        row["rejected"] += line["status"] == "converged_not_verified" and not line["complaints"] + line["h/8"]
        row["no answer"] += line["feasible"] is True and line["status"] != "converged"
    return dict(sorted(table.items()))


def show(lines):
    """Print the table by row, kind, system and method."""
    columns = ("cases", "success", "false", "not at h/8", "rejected", "no answer")
    print(f"{'':27s}" + "".join(f"{name:>12s}" for name in columns) + "   false, 95 % interval")
    for key in ("row", "kind", "system", "method"):
        for name, n in counts(lines, key).items():
            rate = success_rate(n["false"], max(n["success"], 1))
            interval = f"   {100 * rate.lower:.2f} to {100 * rate.upper:.2f} %"
            print(f"{name:27s}" + "".join(f"{n[column]:12d}" for column in columns) + interval, flush=True)


def measure(seed: int, count: int) -> list[Any]:
    from trust import Figure

    lines = [judged(count * seed + k) for k in range(count)]
    show(lines)
    for line in lines:
        if line["status"] == "converged" and line["complaints"]:
            print(f"  FALSE, seed {line['seed']}, {line['row']}, {line['method']}: {'; '.join(line['complaints'])}")
    total = sum((row for row in counts(lines, "row").values()), Counter())
    right = total["success"] - total["false"] + total["rejected"]
    return [
        Figure("successes that the referee refutes", total["false"], max(total["success"], 1), 0.0, False),
        Figure("plans that it confirms, not verified", total["rejected"], max(right, 1), 0.03, False),
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--out", type=Path, help="JSON lines, those there are kept")
    parser.add_argument("--seconds", type=float, default=math.inf, help="stop after that many")
    given = parser.parse_args()
    there = given.out.read_text().splitlines() if given.out and given.out.exists() else []
    lines, end = {line["seed"]: line for line in map(json.loads, there)}, time.perf_counter() + given.seconds
    for seed in range(given.first, given.last):
        if seed in lines or time.perf_counter() > end:
            continue
        line = lines[seed] = judged(seed)
        if given.out:
            with given.out.open("a") as file:
                file.write(json.dumps(line) + "\n")
        verdict = line["message"]
        if "complaints" in line:
            elsewhere = [f"h/8: {c}" for c in line["h/8"]]
            verdict = "; ".join(line["complaints"] + elsewhere) or "confirmed"
        words = ", ".join(line[key] for key in ("row", "kind", "method", "system", "status"))
        print(f"{seed} {words}: {verdict}", flush=True)
    show([line for seed, line in lines.items() if given.first <= seed < given.last])


if __name__ == "__main__":
    sys.exit(main())

"""Time whole solves of the examples that Crocoddyl and acados ship, and of three reaches, in turns with the peer.

    python tests/benchmarks/peers_examples.py --crocoddyl PYTHON [--acados PYTHON] [--only NAME,...] [--out FILE.json]

PYTHON is that of an environment with the peer, see `task_peer_crocoddyl.py` and `task_peer_acados.py`. The statements
are written here; only their numbers are those of the examples. All processes share one core. A time is the processor
time of the solves after the first of the same shape, the least of `--rounds`. A peer's time is that of building and
solving, for acados that of solving compiled code. Ours is that of `dd.solve` with `restarts=0` (whole), of its search
alone (transcription and solver), and of `dd.solve` with default restarts. Costs are those of the inputs, simulated in
the steps of our problem. "Own cost apart" is the relative difference of the peer's own cost from this: rounding if both
state the same discrete task.
"""

import argparse
import json
import os
import sys
import time
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import _one_thread  # noqa: F401 (before NumPy)
import numpy as np
from scipy.optimize import fsolve

sys.path.insert(0, str(Path(__file__).parents[1]))

import task_formulas
from cases import chain_urdf
from helpers.legged import LEGGED, legged_model, rest
from helpers.models import robot_file
from legged_tasks import OPTIONS, scheduled_problem
from solving import solve_with
from task_peers import Peer, finite, search_seconds
from task_plants import FOLDER, arm_file

import drake_diff as dd
from drake_diff.exceptions import ModelWarning, SimulationError

FAR = "1e6"  # limits of joints in files, as the peers have none
SAME = "the same discrete task"
Task = dict[str, Any]


@dataclass(frozen=True)
class Example:
    """Our problem and the peer's task. `apart` names the differences of the two statements."""

    peer: str
    problem: dd.Problem
    task: Task
    apart: str = SAME
    options: Task = field(default_factory=dict)


# ------------------------------------------------------------------------------ robots, with Crocoddyl


def unlimited(path: Path, motors: tuple[str, ...] = ()) -> Path:
    """Write a robot without damping and limits of joints, and with motors in the named joints alone, if any."""
    root = ET.parse(path).getroot()
    for joint in root.findall("joint"):
        for old in (*joint.findall("dynamics"), *joint.findall("limit")):
            joint.remove(old)
        if joint.get("type") in ("revolute", "continuous"):
            joint.set("type", "revolute")
            ET.SubElement(joint, "limit", lower=f"-{FAR}", upper=FAR, effort=FAR, velocity=FAR)
    for motor in root.findall("transmission"):
        if motors and motor.find("joint").get("name") not in motors:
            root.remove(motor)
    path = Path(FOLDER.name) / f"unlimited_{path.name}"
    path.write_bytes(ET.tostring(root))
    return path


def upright(weights: list[float], effort: float, x: Any, u: Any = (0.0,)) -> Any:
    """Return the cost of a double pendulum's distance from the upright posture, and of its input."""
    s, c = np.sin(x[:2]), np.cos(x[:2])
    residuals = [s[0], s[1], 1 - c[0], 1 - c[1], x[2], x[3]]
    return sum(w * r * r for w, r in zip(weights, residuals, strict=True)) + effort * u[0] ** 2


def costs_of(model: dd.Model, terms: Task, knots: Any) -> tuple[Any, list[dd.FrameGoal]]:
    """Return our cost of weighted squares, without a half, as `task_peer_crocoddyl.cost_of` does, and soft goals."""
    wanted = {"position": terms.get("target"), "rotation": np.eye(3)}
    soft = [name for name in wanted if name in terms]
    goals = [dd.FrameGoal(terms["frame"], **{name: wanted[name]}, weight=terms[name], knots=knots) for name in soft]
    if "upright" in terms:
        return partial(upright, terms["upright"], terms.get("u", 0.0)), goals
    Q, R = None, terms["u"] * np.eye(model.nu) if "u" in terms else None
    if "x" in terms:  # not for the first entry of a quaternion
        Q = np.diag([*np.zeros(model.nq - model.nv), *np.broadcast_to(terms["x"], 2 * model.nv)])
    return None if Q is None and R is None else dd.QuadraticCost(Q=Q, R=R, x_ref=terms.get("x_ref")), goals


def euler(
    model: dd.Model, path: Path, x0: Any, count: int, costs: tuple[Task, Task], *,
    x_goal: Any = None, limits: Any = None, thrusters: Any = (), apart: str = SAME,
) -> Example:  # fmt: skip
    """Return an example in Crocoddyl's Euler steps, which are Drake's steps of a robot on a fixed base."""
    running_cost, goals = costs_of(model, costs[0], None)
    final_cost, more = (None, []) if x_goal is not None else costs_of(model, costs[1], -1)
    free, least, most = np.full(model.nx, np.inf), *(limits or (-np.inf, np.inf))
    bounds = dd.Bounds(-free, free, np.full(model.nu, least), np.full(model.nu, most))
    ends = {"x0": x0, "x_goal": x_goal, "num_steps": count}
    final = {"final_cost": final_cost, "goals": [*goals, *more], "bounds": bounds}
    problem = dd.Problem(model, **ends, running_cost=running_cost, **final)
    driven = [actuator.joint for actuator in model.contract.actuators]
    task = {"kind": "costs", "file": str(path), "x0": list(map(float, x0)), "count": count, "driven": driven}
    task |= {"running": costs[0], "final": costs[1], "limits": limits, "thrusters": thrusters}
    return Example("Crocoddyl", problem, task | {"horizon": [count * model.time_step]}, apart)


def kinova() -> Example:
    path = unlimited(arm_file("kinova.urdf"))
    x0 = [1.5707, 2.618, -1.5707, 3.1415, 2.618, 0.0, *[0.0] * 6]
    hand = {"frame": "j2s6s200_end_effector", "target": [0.6, 0.2, 0.5]}
    running = {**hand, "position": 0.5, "rotation": 0.5, "x": 0.05, "x_ref": x0, "u": 0.05}
    costs = running, {**hand, "position": 500.0, "rotation": 500.0}
    apart = "the residual of a rotation is 2 sin(angle / 2), for Crocoddyl the angle"
    return euler(dd.load_model(path, time_step=0.01), path, x0, 100, costs, apart=apart)


def double_pendulum() -> Example:
    path = unlimited(arm_file("double_pendulum.urdf"), ("joint1",))
    along, at_end = ([scale * weight for weight in (1.0, 1.0, 1.0, 1.0, 0.1, 0.1)] for scale in (0.5e-3, 50.0))
    costs = {"u": 0.5e-2, "upright": along}, {"upright": at_end}
    return euler(dd.load_model(path, time_step=0.01), path, [3.14, 0.0, 0.0, 0.0], 100, costs)


def quadrotor(limits: tuple[float, float] | None) -> Example:
    path, r, turn = robot_file("quadrotor_base.urdf"), 0.1525, 1e-6 / 6.6e-5
    thrusters = [([r, 0, 0], -turn), ([0, r, 0], turn), ([-r, 0, 0], -turn), ([0, -r, 0], turn)]
    force = partial(dd.model.BodyForce, body="base_link", lower=-np.inf)
    forces = [force(f"rotor{i}", point=point, moment_ratio=ratio) for i, (point, ratio) in enumerate(thrusters)]
    model = dd.load_model(path, time_step=0.03, body_forces=forces, contact=False)
    pose = {"frame": "base_link", "target": [1, 0, 1]}
    running = {**pose, "position": 5e-3, "rotation": 5.5e-3, "x": [*[0.0] * 6, *[5e-4] * 6], "u": 5e-7}
    costs = running, {**pose, "position": 1.5, "rotation": 1.5}
    apart = "Drake's step turns by the velocity in the world, Crocoddyl's by that in the body"
    x0 = [1.0, *[0.0] * 12]
    return euler(model, path, x0, 33, costs, thrusters=thrusters, limits=limits, apart=apart)


def joints(path: Path, x0: list[float], goal: list[float], weights: tuple[Any, Any]) -> Example:
    """Return a reach to joint positions with soft goals: weights of (q, v, u), along the motion and at its end."""
    path = unlimited(path)
    model = dd.load_model(path, time_step=0.01)
    running, final = ({"x": np.repeat(w[:2], model.nv).tolist(), "x_ref": goal} for w in weights)
    return euler(model, path, x0, 100, (running | {"u": weights[0][2]}, final))


def panda() -> Example:
    x0, goal = [1.0, 0.2, -0.5, -1.2, 0.4, 2.2, -0.3], [0.0, -0.78, 0.0, -2.36, 0.0, 1.57, 0.78]
    weights = (0.1, 0.01, 1e-3), (1000.0, 10.0)
    return joints(arm_file("panda.urdf"), [*x0, *[0.0] * 7], [*goal, *[0.0] * 7], weights)


def chain20() -> Example:
    path = Path(FOLDER.name) / "chain20.urdf"
    path.write_text(chain_urdf(20))
    goal = [*(0.3 * np.sin(np.arange(20.0))), *np.zeros(20)]
    return joints(path, [0.0] * 40, goal, ((0.1, 0.01, 1e-2), (1e3, 10.0)))


def ur5() -> Example:
    path = unlimited(arm_file("ur5_robot.urdf"))
    x0, goal = ([*q, *[0.0] * 6] for q in ([0.0, -1.2, 1.0, 0.0, 0.0, 0.0], [1.0, -0.6, 0.4, 0.3, 0.5, 0.2]))
    costs = {"x": [*[0.0] * 6, *[0.1] * 6], "x_ref": goal, "u": 1e-3}, {"x": 1e5, "x_ref": goal}
    apart = "a hard goal, for Crocoddyl a cost of 1e5 times the square, which is part of its own cost alone"
    return euler(dd.load_model(path, time_step=0.02), path, x0, 50, costs, x_goal=goal, apart=apart)


def unicycle() -> Example:
    def drive(x: Any, u: Any) -> Any:
        return [x[0] + 0.1 * u[0] * np.cos(x[2]), x[1] + 0.1 * u[0] * np.sin(x[2]), x[2] + 0.1 * u[1]]

    final = dd.QuadraticCost(Q=50.0 * np.eye(3))
    costs = {"running_cost": dd.QuadraticCost(Q=final.Q, R=0.5 * np.eye(2)), "final_cost": final}
    task = {"x0": [-1.0, -1.0, 1.0], "count": 20}
    problem = dd.Problem(dd.optimize.DiscreteMap(drive, nx=3, nu=2), x0=task["x0"], num_steps=20, **costs)
    return Example("Crocoddyl", problem, {"kind": "unicycle", "horizon": [2.0], **task})


def trot() -> Example:
    facts, h = LEGGED["anymal"], 0.01
    model = legged_model("anymal", h)
    angles = np.array([[side * 0.1, front * 0.7, -front] for front in (1, -1) for side in (-1, 1)])  # LF, RF, LH, RH
    x0 = rest("anymal", model, angles.ravel())
    end = x0[: model.nq].copy()
    end[4] += 0.1125  # the first two feet move by 0.075 m, the others by 0.15 m
    (lf, rf, lh, rh), every = facts.feet, facts.feet
    steps = [(4, every), (25, (lf, rh)), (4, every), (25, (rf, lh)), (20, every)]
    problem, guess, _ = scheduled_problem(model, facts, x0, end, steps, 0.06)
    standing = [0, 0, 0.4792, 0, 0, 0, 1, *angles[[0, 2, 1, 3]].ravel().tolist(), *[0] * 18]
    task = {"kind": "trot", "file": str(facts.path()), "x0": standing, "feet": facts.feet}
    apart = "compliant contact, a guess for the feet, rest at the end: 78 steps; Crocoddyl: rigid contact, 55 steps"
    task |= {"gait": [0.15, 0.1, h, 25, 2], "horizon": [55 * h]}
    return Example("Crocoddyl", problem, task, apart, {**OPTIONS, "initial_guess": guess})


# ------------------------------------------------------------------------------ formulas, with acados


def runge_kutta(rates: Callable[..., Any], step: float, substeps: int) -> Callable[..., Any]:
    """Return the map of a step with a held input."""

    def f(x: Any, u: Any) -> Any:
        x, h = np.asarray(x), step / substeps
        for _ in range(substeps):
            k1 = np.array(rates(x, u, np))
            k2 = np.array(rates(x + h / 2 * k1, u, np))
            k3 = np.array(rates(x + h / 2 * k2, u, np))
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + np.array(rates(x + h * k3, u, np)))
        return x

    return f


def with_acados(
    rates: partial, substeps: int, x0: Any, x_ref: Any, weights: tuple[Any, float, Any], step: float, count: int,
    **limits: Any,
) -> Example:  # fmt: skip
    """Return an example in Runge-Kutta steps. `weights` are those of x, u, and x at the end."""
    nx, nu = len(x0), len(limits["u_lower"])
    moves = dd.optimize.DiscreteMap(runge_kutta(rates, step, substeps), nx=nx, nu=nu, **limits)
    Q, R, Q_final = np.diag(weights[0]), weights[1] * np.eye(nu), np.diag(weights[2])
    running, final = dd.QuadraticCost(Q=step * Q, R=step * R, x_ref=x_ref), dd.QuadraticCost(Q=Q_final, x_ref=x_ref)
    problem = dd.Problem(moves, x0=x0, num_steps=count, running_cost=running, final_cost=final)
    task = {"formula": rates.func.__name__, "constants": rates.keywords, "substeps": substeps, "disks": []}
    task |= {"nx": nx, "nu": nu, "count": count, "start_horizon": step * count, "horizon": [step * count] * 2}
    task |= {"x0": list(x0), "x_goal": [None] * nx, "x_ref": list(x_ref)}
    task |= {"Q": weights[0], "R": R.tolist(), "Q_final": weights[2]}
    task |= {name: finite(getattr(problem.bounds, name)) for name in ("x_lower", "x_upper", "u_lower", "u_upper")}
    return Example("acados", problem, task)


def cart() -> Example:
    rates, weights = partial(task_formulas.cart_pole, l=0.8, m1=1.0, m2=0.1), [1e3, 1e3, 1e-2, 1e-2]
    goal, limits = [0.0, np.pi, 0.0, 0.0], {"u_lower": [-80.0], "u_upper": [80.0]}
    return with_acados(rates, 1, [0.0] * 4, goal, (weights, 1e-2, weights), 0.05, 20, **limits)


def masses() -> Example:
    """Return the chain of three masses, which begins 1 s after the last was pulled from rest."""
    rates, end = partial(task_formulas.three_masses), [0.033 * 2 * 6, 0.0, 0.0]
    middle = fsolve(lambda p: rates([*p, *end, 0, 0, 0], np.zeros(3), np)[6:], [end[0] / 2, 0.0, -0.3])
    x_ref, x0 = [*middle.tolist(), *end, 0.0, 0.0, 0.0], runge_kutta(rates, 1.0, 10)
    weights, wall = [1.0] * 3 + [2.0] * 3 + [1.0] * 3, [-np.inf, -0.05, -np.inf] * 2 + [-np.inf] * 3
    limits = {"x_lower": wall, "u_lower": [-1.0] * 3, "u_upper": [1.0] * 3}
    return with_acados(rates, 2, x0(x_ref, [-1.0, 1.0, 1.0]), x_ref, (weights, 1e-2, weights), 0.2, 40, **limits)


EXAMPLES: dict[str, Callable[[], Example]] = {
    "quadrotor": partial(quadrotor, None), "quadrotor_limits": partial(quadrotor, (0.1, 5.0)), "unicycle": unicycle,
    "double_pendulum": double_pendulum, "kinova": kinova, "cart": cart, "masses": masses, "trot": trot, "ur5": ur5,
    "chain20": chain20, "panda": panda,
}  # fmt: skip


# ------------------------------------------------------------------------------ measurement


def processor_seconds() -> float:
    """Return the processor time [s] of this process and of its children that ended."""
    return time.process_time() + sum(os.times()[2:4])


def ours(example: Example, **options: Any) -> Task:
    problem, begun = example.problem, processor_seconds()
    with search_seconds() as spent:
        solution = solve_with(problem, **example.options, **options)
    answer = {"seconds": processor_seconds() - begun, "search": spent[0], "verified": solution.success}
    in_steps = solution.scheme in ("step", "map")
    paid = cost(problem, np.asarray(solution.us)) if in_steps else solution.cost
    answer |= {"cost": paid, "told": f"{solution.status.value}{'' if in_steps else ', in continuous time'}"}
    return answer | {"chain": [f"{link['method']}: {link['ended']}" for link in solution.options.get("chain", ())]}


def theirs(script: Peer, example: Example) -> Task:
    answer, problem = script.solve(example.task), example.problem
    us = np.array(answer.get("us", ()))[:-1]
    same = us.shape == (problem.num_steps, problem.nu) and np.all(np.isfinite(us))
    taken = {name: answer.get(name) for name in ("told", "solved", "build", "solve")}
    taken |= {"seconds": answer["build"] + answer["solve"], "its cost": answer.get("cost")}
    return taken | {"cost": cost(problem, us) if same else None}


def cost(problem: dd.Problem, us: np.ndarray) -> float:
    """Return the cost of the motion under inputs (N, nu), in the steps of the problem."""
    xs = [np.asarray(problem.x0, dtype=float)]
    if problem.has_model:
        try:
            return problem.objective(np.asarray(dd.rollout(problem.model, xs[0], us).xs), us)
        except SimulationError:  # the inputs of a search that diverged
            return np.inf
    for u in us:
        xs.append(problem.dynamics.values([[*xs[-1], *u]])[0])
    return problem.objective(np.array(xs), us)


def measured(name: str, pythons: dict[str, str | None], rounds: int) -> Task:
    """Return a row of the table. The first solve of each is not counted."""
    example = EXAMPLES[name]()
    python = pythons[example.peer]
    solves = {"first": partial(ours, example, restarts=0), "default": partial(ours, example)}
    script = Peer(example.peer, python) if python else None
    if script:
        solves = {"theirs": partial(theirs, script, example), **solves}
    turns = [{who: solve() for who, solve in solves.items()} for _ in range(rounds + 1)]
    if script:
        script.end()
    fastest = {who: min((turn[who] for turn in turns[1:]), key=itemgetter("seconds")) for who in solves}
    return {"name": name, "peer": example.peer, "apart": example.apart, **fastest}


def cells(row: Task) -> dict[str, str]:
    """Return the row by the names of the columns. Times are in milliseconds."""
    peer, both = row.get("theirs"), {"whole": row["first"], "default restarts": row["default"]}
    texts = {"example": row["name"], "peer": row["peer"], "its time": f"{1e3 * peer['seconds']:.3g}" if peer else "-"}
    texts |= {"search": f"{1e3 * row['first']['search']:.3g}"}
    texts |= {name: f"{1e3 * one['seconds']:.3g}" for name, one in both.items()}
    texts |= {f"{name} / its": f"{one['seconds'] / peer['seconds']:.3g}" if peer else "-" for name, one in both.items()}
    known = peer is not None and peer["cost"] is not None
    texts |= {"its cost": f"{peer['cost']:.6g}" if known else "-"}
    texts |= {f"cost, {name}": f"{one['cost']:.6g}" for name, one in both.items()}
    texts |= {"own cost apart": f"{abs(peer['its cost'] / peer['cost'] - 1):.0e}" if known else "-"}
    texts |= {"it": peer["told"] if peer else "not installed"}
    texts |= {f"{name}: we": one["told"] + ", verified" * one["verified"] for name, one in both.items()}
    return texts | {"statements": row["apart"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--crocoddyl", help="the Python of an environment with Crocoddyl")
    parser.add_argument("--acados", help="the Python of an environment with acados")
    parser.add_argument("--only", default=",".join(EXAMPLES), help="names of examples, separated by commas")
    parser.add_argument("--rounds", type=int, default=1, help="solves after the first")
    parser.add_argument("--out", type=Path, help="where the JSON goes")
    given = parser.parse_args()
    warnings.simplefilter("ignore", ModelWarning)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # the peers inherit it
    rows: list[Task] = []
    for name in given.only.split(","):
        rows.append(measured(name, {"Crocoddyl": given.crocoddyl, "acados": given.acados}, given.rounds))
        texts = cells(rows[-1])
        head = f"| {' | '.join(texts)} |\n{'|---' * len(texts)}|\n" if len(rows) == 1 else ""
        print(f"{head}| {' | '.join(texts.values())} |", flush=True)
        if given.out:
            given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

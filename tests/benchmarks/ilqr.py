"""Whole solves by iLQR at rest without effort, to where a full step promises less than the row's `stop` of cost.

    python tests/benchmarks/ilqr.py

A solve is repeated, and wall and processor time [ms] are medians. Robots have no joint damping, friction or limits.
"""

import math
import re
import statistics
import tempfile
import time
import warnings
from importlib.metadata import files
from pathlib import Path

import numpy as np
from cases import chain_urdf, written
from panda_arm import panda_arm

import drake_diff as dd
from drake_diff.exceptions import ModelWarning
from drake_diff.optimize.ilqr.ilqr import solve_ilqr
from drake_diff.optimize.program import Limits

REPEATS = 7
UR5 = next(f for f in files("example-robot-data") or () if f.name == "ur5_robot.urdf")


def tasks(folder: Path) -> list[dict]:
    """State cost q, v, u rates and final weights; hand-over to both sides as JSON. `cost` scales our tolerance."""
    reach = [0.0, -0.78, 0.0, -2.36, 0.0, 1.57, 0.78]
    start = [1.0, 0.2, -0.5, -1.2, 0.4, 2.2, -0.3]
    panda = {"name": "Panda reach", "urdf": str(_undamped(panda_arm(folder), folder)), "time_step": 0.01, "count": 100}
    panda |= {"running": (0.1, 0.01, 1e-3), "final": (1000.0, 10.0, 0.0)}
    panda |= {"base": "panda_link0", "cost": 1.042, "x0": start + [0.0] * 7, "x_goal": reach + [0.0] * 7}
    ur5 = panda | {"name": "UR5 reach", "urdf": str(_undamped(Path(UR5.locate()), folder)), "base": None}
    bent, wanted = [0.0, -0.6, 0.3, -0.2, 0.0, 0.0], [0.5, -1.2, 1.0, -0.8, 0.6, 0.3]
    ur5 |= {"cost": 1.4806, "x0": bent + [0.0] * 6, "x_goal": wanted + [0.0] * 6}
    limited = 'type="revolute"><limit lower="0" upper="0" effort="1e6" velocity="1e6"/>'
    text = chain_urdf(20).replace("<link", '<link name="world"/><link', 1).replace('type="continuous">', limited)
    chain = panda | {"name": "chain of 20", "urdf": str(_undamped(written(folder, "chain.urdf", text), folder))}
    bent = (0.2 * np.random.default_rng(0).standard_normal(20)).tolist()
    chain |= {"base": None, "cost": 0.0221, "x0": bent + [0.0] * 20, "x_goal": [0.0] * 40}
    return [task | {"stop": stop} for task in (panda, ur5, chain) for stop in (1e-9, 2e-14)]


def _undamped(urdf: Path, folder: Path) -> Path:
    """Crocoddyl's free dynamics leaves joint damping, friction and the stops at joint limits out."""
    text = re.sub(r"<dynamics[^>]*/>", "", urdf.read_text())
    text = re.sub(r"<(visual|collision)>.*?</\1>", "", text, flags=re.DOTALL)  # nothing is to touch
    text = re.sub(r'(lower|upper)="[^"]*"', lambda m: f'{m[1]}="{-100 if m[1] == "lower" else 100}"', text)
    path = folder / f"undamped_{urdf.name}"
    path.write_text(text)
    return path


def ours(task: dict, repeats: int = 0) -> dict:
    """The first solve, which certifies the model's derivatives, counts where it is the only one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        model = dd.load_model(task["urdf"], time_step=task["time_step"], weld_base=task.get("base"))

    def cost(q: float, v: float, u: float) -> dd.QuadraticCost:
        Q = np.diag([q] * model.nq + [v] * model.nv)
        return dd.QuadraticCost(Q=Q, R=u * np.eye(model.nu), x_ref=task["x_goal"])

    free = dd.Bounds(*(np.full(n, s * np.inf) for n in (model.nx, model.nu) for s in (-1, 1)))
    problem = dd.Problem(
        model,
        x0=task["x0"],
        num_steps=task["count"],
        running_cost=cost(*task["running"]),
        final_cost=cost(*task["final"]),
        bounds=free,
    )
    us = np.zeros((task["count"], model.nu))
    limits = Limits(max_iterations=500, time_limit=60.0, tolerance=math.sqrt(task["stop"] / (1 + task["cost"])))
    times, cpu = [], []
    for _ in range(1 + repeats):
        start = time.perf_counter(), time.process_time()
        xs = np.tile(problem.x0, (task["count"] + 1, 1))
        result, xs, found = solve_ilqr(problem, xs, us, limits=limits, report=None)
        times.append(time.perf_counter() - start[0])
        cpu.append(time.process_time() - start[1])
    return {
        "seconds": statistics.median(times[1:] or times),
        "cpu": statistics.median(cpu[1:] or cpu),
        "first": times[0],
        "cost": problem.objective(xs, found),
        "iterations": len(result.iterations) - 1,
        "ok": result.outcome.value == "solved",
    }


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        given = tasks(Path(name))
        found = {"drake_diff": [ours(task, REPEATS) for task in given]}
    print(f"{'problem':14s}{'stop':>8s}  {'solver':22s}{'ms':>9s}{'cpu ms':>9s}{'steps':>7s}{'cost':>16s}  converged")
    for i, task in enumerate(given):
        for solver, rows in found.items():
            row = rows[i]
            print(
                f"{task['name']:14s}{task['stop']:8.0e}  {solver:22s}{1e3 * row['seconds']:9.1f}{1e3 * row['cpu']:9.1f}"
                f"{row['iterations']:7d}{row['cost']:16.11g}  {'yes' if row['ok'] else 'no'}"
            )
    print(f"Our first solve, which certifies the derivatives, took {1e3 * found['drake_diff'][0]['first']:.0f} ms.")


if __name__ == "__main__":
    main()

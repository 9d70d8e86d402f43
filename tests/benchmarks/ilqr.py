"""Whole solves by iLQR beside Crocoddyl's FDDP in C++: the same steps, costs and guess, at rest without effort.

    python tests/benchmarks/ilqr.py [PYTHON_WITH_CROCODDYL]

Crocoddyl wants an environment of its own (see crocoddyl_peer.py); without one, our times stand alone.
"""

import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from step_derivatives import panda_arm

import drake_diff as dd
from drake_diff.ilqr import solve_ilqr
from drake_diff.nonlinear_program import Limits

MODELS = Path(__file__).parents[2] / "models"
REPEATS = 1
LIMITS = Limits(max_iterations=500, time_limit=60.0, tolerance=1e-7)


def tasks(folder: Path) -> list[dict]:
    """State cost q, v, u rates and final weights; hand-over to both sides as JSON."""
    reach = [0.0, -0.78, 0.0, -2.36, 0.0, 1.57, 0.78]
    start = [1.0, 0.2, -0.5, -1.2, 0.4, 2.2, -0.3]
    panda = {"name": "Panda reach", "urdf": str(_undamped(panda_arm(folder), folder)), "time_step": 0.01, "count": 100}
    weights = {"running": (0.1, 0.01, 1e-3), "final": (1000.0, 10.0, 0.0), "tolerance": 1e-9}
    panda |= {"base": "panda_link0", "x0": start + [0.0] * 7, "x_goal": reach + [0.0] * 7}
    return [panda | weights]


def _undamped(urdf: Path, folder: Path) -> Path:
    """Crocoddyl's free dynamics leaves joint damping, friction and the stops at joint limits out."""
    text = re.sub(r"<dynamics[^>]*/>", "", urdf.read_text())
    text = re.sub(r'(lower|upper)="[^"]*"', lambda m: f'{m[1]}="{-100 if m[1] == "lower" else 100}"', text)
    path = folder / f"undamped_{urdf.name}"
    path.write_text(text)
    return path


def ours(task: dict) -> dict:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dd.ModelWarning)
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
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        xs = np.tile(problem.x0, (task["count"] + 1, 1))
        result, xs, found = solve_ilqr(problem, xs, us, limits=LIMITS, report=None)
        times.append(time.perf_counter() - start)
    return {
        "seconds": statistics.median(times),
        "cost": problem.objective(xs, found),
        "iterations": len(result.iterations) - 1,
        "ok": result.outcome.value == "solved",
    }


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        given = tasks(Path(name))
        found = [ours(task) for task in given]
        peer: list[dict | None] = [None] * len(given)
        if len(sys.argv) > 1:
            script = Path(__file__).with_name("crocoddyl_peer.py")
            done = subprocess.run([sys.argv[1], script], input=json.dumps(given), capture_output=True, text=True)
            if done.returncode:
                sys.exit(f"crocoddyl failed: {done.stderr[-2000:]}")
            peer = json.loads(done.stdout)
    print(f"{'problem':18s}{'solver':12s}{'ms':>9s}{'ratio':>8s}{'iterations':>12s}{'cost':>14s}  converged")
    for task, a, b in zip(given, found, peer, strict=True):
        for solver, row in (("drake_diff", a), ("Crocoddyl", b)):
            if row is None:
                continue
            ratio = row["seconds"] / (b or a)["seconds"]
            print(
                f"{task['name']:18s}{solver:12s}{1e3 * row['seconds']:9.1f}{ratio:8.1f}{row['iterations']:12d}"
                f"{row['cost']:14.8g}  {'yes' if row['ok'] else 'no'}"
            )


if __name__ == "__main__":
    main()

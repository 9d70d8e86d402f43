"""A Panda's reach by iLQR, from rest with zero inputs, until a full step predicts a cost decrease below `stop`."""

import math
import re
import warnings
from pathlib import Path

import numpy as np
from panda_arm import panda_arm

import drake_diff as dd
from drake_diff.exceptions import ModelWarning
from drake_diff.optimize.ilqr.ilqr import solve_ilqr
from drake_diff.optimize.program import Limits


def panda_reach(folder: Path) -> dict:
    """Return the task, with running and final weights of q, v and u. `cost` scales the tolerance of `ours`."""
    goal = [0.0, -0.78, 0.0, -2.36, 0.0, 1.57, 0.78, *[0.0] * 7]
    start = [1.0, 0.2, -0.5, -1.2, 0.4, 2.2, -0.3, *[0.0] * 7]
    task = {"urdf": str(_undamped(panda_arm(folder), folder)), "time_step": 0.01, "count": 100}
    task |= {"running": (0.1, 0.01, 1e-3), "final": (1000.0, 10.0, 0.0), "base": "panda_link0"}
    return task | {"cost": 1.042, "stop": 1e-9, "x0": start, "x_goal": goal}


def _undamped(urdf: Path, folder: Path) -> Path:
    """Write the URDF without joint damping, joint limits and shapes, so that there is no contact."""
    text = re.sub(r"<dynamics[^>]*/>", "", urdf.read_text())
    text = re.sub(r"<(visual|collision)>.*?</\1>", "", text, flags=re.DOTALL)
    text = re.sub(r'(lower|upper)="[^"]*"', lambda m: f'{m[1]}="{-100 if m[1] == "lower" else 100}"', text)
    path = folder / f"undamped_{urdf.name}"
    path.write_text(text)
    return path


def ours(task: dict) -> dict:
    """Load the model and solve the task once."""
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
    xs = np.tile(problem.x0, (task["count"] + 1, 1))
    result, xs, found = solve_ilqr(problem, xs, us, limits=limits, report=None)
    return {
        "cost": problem.objective(xs, found),
        "iterations": len(result.iterations) - 1,
        "ok": result.outcome.value == "solved",
    }

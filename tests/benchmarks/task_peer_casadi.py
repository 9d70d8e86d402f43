"""Solve tasks (JSON lines) with CasADi and IPOPT, by a handwritten Hermite-Simpson scheme in one SX expression.

    python task_peer_casadi.py < tasks.json

IPOPT has its defaults, except for the tolerance, which is that of `dd.solve`, and a limit of 500 iterations. The output
contains processor time [s]: `build` to create the solver and `solve` to call it.
"""

import json
import sys
import time

import casadi as ca
import numpy as np
import task_formulas


class CasadiMath:
    sin, cos, tan, sqrt, exp = ca.sin, ca.cos, ca.tan, ca.sqrt, ca.exp


def limits(values, sign):
    """Return the limits, with None replaced by `sign` times infinity."""
    return np.array([sign * np.inf if value is None else value for value in values], dtype=float)


def solve(task: dict) -> dict:
    begun, f, constants = time.process_time(), getattr(task_formulas, task["formula"]), task["constants"]
    nx, nu, count, free = task["nx"], task["nu"], task["count"], task["horizon"][0] < task["horizon"][1]
    z, horizon = ca.SX.sym("z", nx + nu, 2 * count + 1), ca.SX.sym("T") if free else task["horizon"][0]
    h, columns = horizon / count, [z[:, k] for k in range(2 * count + 1)]
    rates = [ca.vertcat(*f(ca.vertsplit(c[:nx]), ca.vertsplit(c[nx:]), CasadiMath, **constants)) for c in columns]
    g, cost = [], task["time_weight"] * horizon
    for k in range(0, 2 * count, 2):
        (x, middle, end), (fx, fm, fe) = (c[:nx] for c in columns[k : k + 3]), rates[k : k + 3]
        g += [end - x - h / 6 * (fx + 4 * fm + fe), middle - (x + end) / 2 - h / 8 * (fx - fe)]
        if task["R"]:
            apart = [c[nx:] - ca.DM(task["u_ref"]) for c in columns[k : k + 3]]
            paid = [ca.bilin(ca.DM(task["R"]), a, a) for a in apart]
            cost += h / 6 * (paid[0] + 4 * paid[1] + paid[2])
    lowest, highest = [0.0] * sum(each.numel() for each in g), [0.0] * sum(each.numel() for each in g)
    for a, b, radius in task["disks"]:
        g += [(c[0] - a) ** 2 + (c[1] - b) ** 2 for c in columns]
        lowest, highest = lowest + [radius**2] * len(columns), highest + [np.inf] * len(columns)
    variables = ca.vertcat(ca.vec(z), *[horizon] * free)
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": task["tolerance"]}
    options["ipopt.max_iter"] = 500
    solver = ca.nlpsol("solver", "ipopt", {"x": variables, "f": cost, "g": ca.vertcat(*g)}, options)
    built = time.process_time()
    lower, upper = (
        np.tile(np.concatenate([limits(task[f"x_{side}"], sign), limits(task[f"u_{side}"], sign)]), (2 * count + 1, 1))
        for side, sign in (("lower", -1), ("upper", 1))
    )
    x0, goal = np.array(task["x0"]), task["x_goal"]
    given = [i for i in range(nx) if goal[i] is not None]
    lower[0, :nx] = upper[0, :nx] = x0
    for i in given:
        lower[-1, i] = upper[-1, i] = goal[i]
    line = np.linspace(x0, [x0[i] if goal[i] is None else goal[i] for i in range(nx)], 2 * count + 1)
    guess = np.hstack([line, np.tile(np.clip(np.zeros(nu), lower[0, nx:], upper[0, nx:]), (2 * count + 1, 1))])
    times = [[value] * free for value in (task["start_horizon"], *task["horizon"])]
    found = solver(
        x0=np.concatenate([guess.ravel(), times[0]]),
        lbx=np.concatenate([lower.ravel(), times[1]]),
        ubx=np.concatenate([upper.ravel(), times[2]]),
        lbg=lowest,
        ubg=highest,
    )
    ended, done = solver.stats(), time.process_time()
    values = np.array(found["x"]).ravel()
    nodes = values[: (nx + nu) * (2 * count + 1)].reshape(-1, nx + nu)
    end = float(values[-1]) if free else task["horizon"][0]
    return {
        "solved": bool(ended["success"]),
        "told": str(ended["return_status"]),
        "cost": float(found["f"]),
        "build": built - begun,
        "solve": done - built,
        "times": np.linspace(0, end, 2 * count + 1).tolist(),
        "xs": nodes[:, :nx].tolist(),
        "us": nodes[:, nx:].tolist(),
        "inputs": "parabolas",
    }


if __name__ == "__main__":
    for text in sys.stdin:
        print(json.dumps(solve(json.loads(text))), flush=True)

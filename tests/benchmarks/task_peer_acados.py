"""Solve tasks (JSON lines) with acados: multiple shooting, four-stage Runge-Kutta steps, SQP and HPIPM.

    python task_peer_acados.py < tasks.json

    pip install comma-deps-acados numpy scipy     # in a separate environment, with a C compiler

A free final time is a state. The Hessian is that of Gauss-Newton for costs of least squares, otherwise exact and
mirrored. A merit function shortens the steps. Tolerances are the default, 1e-6. A task of `peers_examples.py` has
weights `Q` and `Q_final` of states and no goal. It is solved with full steps, as acados' examples are, and compiled
once. The output contains processor time [s]: `build` to write, compile and load C, including child processes, and
`solve` for the solver alone.
"""

import contextlib
import ctypes
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import acados
import casadi as ca
import numpy as np
import task_formulas

os.environ["ACADOS_SOURCE_DIR"] = acados.DIR
os.environ["TERA_PATH"] = acados.TERA_PATH
os.environ["ACADOS_PYTHON_INTERFACE_PATH"] = acados.TEMPLATE_DIR
for library in (
    "blasfeo",
    "hpipm",
    "qpOASES_e",
    "acados",
):  # they depend on each other by names that the wheel lacks
    ctypes.CDLL(str(Path(acados.LIB_DIR) / f"lib{library}.so"), ctypes.RTLD_GLOBAL)
from acados.acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver  # noqa: E402

FAR, GOAL = 1e8, 1e3  # GOAL: weight of the linear and the squared distance from the goal
ENDED = {0: "solved", 1: "not a number", 2: "iteration limit", 3: "smallest step", 4: "failure of the QP solver"}

COMPILED: dict[str, "AcadosOcpSolver"] = {}  # solvers of the tasks that are solved again


class CasadiMath:
    sin, cos, tan, sqrt, exp = ca.sin, ca.cos, ca.tan, ca.sqrt, ca.exp


def spent() -> float:
    """Return the processor time [s] of this process and its children."""
    return sum(os.times()[:4])


def problem_of(task: dict, number: int) -> "AcadosOcp":
    nx, nu, count, free = task["nx"], task["nu"], task["count"], task["horizon"][0] < task["horizon"][1]
    x, u, xdot = ca.SX.sym("x", nx + free), ca.SX.sym("u", nu), ca.SX.sym("xdot", nx + free)
    rates = getattr(task_formulas, task["formula"])
    f = ca.vertcat(*rates(ca.vertsplit(x)[:nx], ca.vertsplit(u), CasadiMath, **task["constants"]))
    ocp, model = AcadosOcp(), AcadosModel()
    model.name, model.x, model.u, model.xdot = f"task{number}", x, u, xdot
    model.f_expl_expr = ca.vertcat(x[nx] * f, 0) if free else f
    model.f_impl_expr = xdot - model.f_expl_expr
    ocp.model, ocp.dims.N = model, count
    if free:
        ocp.cost.cost_type, ocp.cost.cost_type_e = "EXTERNAL", "EXTERNAL"
        model.cost_expr_ext_cost = ca.SX(0)
        model.cost_expr_ext_cost_e = task["time_weight"] * x[nx]
    elif "Q" in task:
        track(ocp.cost, task)
    else:
        ocp.cost.cost_type, ocp.cost.cost_type_e = "LINEAR_LS", "LINEAR_LS"
        ocp.cost.W, ocp.cost.yref = 2 * np.array(task["R"]), np.array(task["u_ref"], dtype=float)
        ocp.cost.Vx, ocp.cost.Vu = np.zeros((nu, nx)), np.eye(nu)
        ocp.cost.W_e, ocp.cost.yref_e, ocp.cost.Vx_e = np.zeros((0, 0)), np.zeros(0), np.zeros((0, nx))
    constraints = ocp.constraints
    for names, size in (("x", nx), ("u", nu)):
        low, high = (
            [s * FAR if v is None else v for v in task[f"{names}_{side}"]] for side, s in (("lower", -1), ("upper", 1))
        )
        at = [i for i in range(size) if low[i] > -FAR or high[i] < FAR]
        lower, upper = np.array([low[i] for i in at]), np.array([high[i] for i in at])
        if names == "x" and free:
            at, lower, upper = [*at, nx], np.append(lower, task["horizon"][0]), np.append(upper, task["horizon"][1])
        if at:
            setattr(constraints, f"lb{names}", lower)
            setattr(constraints, f"ub{names}", upper)
            setattr(constraints, f"idxb{names}", np.array(at))
    constraints.lbx_0 = constraints.ubx_0 = np.array(task["x0"], dtype=float)
    constraints.idxbx_0 = np.arange(nx)
    if free:
        constraints.lbx_0 = np.append(constraints.lbx_0, task["horizon"][0])
        constraints.ubx_0 = np.append(constraints.ubx_0, task["horizon"][1])
        constraints.idxbx_0 = np.arange(nx + 1)
    given = [i for i in range(nx) if task["x_goal"][i] is not None]
    set_options(ocp.solver_options, task)
    if not given:
        return ocp
    constraints.lbx_e = constraints.ubx_e = np.array([task["x_goal"][i] for i in given], dtype=float)
    constraints.idxbx_e = np.array(given)
    constraints.idxsbx_e = np.arange(len(given))  # slacks of the goal and disks, as the QPs have no elastic mode
    for kind in ("l", "u"):
        setattr(ocp.cost, f"z{kind}_e", np.full(len(given), GOAL))
        setattr(ocp.cost, f"Z{kind}_e", np.full(len(given), GOAL))
    if task["disks"]:
        model.con_h_expr = ca.vertcat(*[(x[0] - a) ** 2 + (x[1] - b) ** 2 for a, b, _ in task["disks"]])
        constraints.lh = np.array([radius**2 for *_, radius in task["disks"]])
        constraints.uh = np.full(len(task["disks"]), FAR)
        constraints.idxsh = np.arange(len(task["disks"]))
        ocp.cost.zl = ocp.cost.zu = ocp.cost.Zl = ocp.cost.Zu = np.full(len(task["disks"]), GOAL)
    return ocp


def track(cost: Any, task: dict) -> None:
    """Set the weighted squares of the distance from a state, along the motion and at its end."""
    nx, nu = task["nx"], task["nu"]
    cost.cost_type, cost.cost_type_e = "LINEAR_LS", "LINEAR_LS"
    cost.W, cost.W_e = 2 * np.diag([*task["Q"], *np.diag(task["R"])]), 2 * np.diag(task["Q_final"])
    cost.yref, cost.yref_e = np.append(task["x_ref"], np.zeros(nu)), np.array(task["x_ref"])
    cost.Vx, cost.Vu, cost.Vx_e = np.eye(nx + nu, nx), np.eye(nx + nu, nu, -nx), np.eye(nx)


def set_options(options: Any, task: dict) -> None:
    free = task["horizon"][0] < task["horizon"][1]
    options.tf = 1.0 if free else task["horizon"][0]
    options.qp_solver, options.nlp_solver_type = "PARTIAL_CONDENSING_HPIPM", "SQP"
    options.integrator_type, options.sim_method_num_stages, options.sim_method_num_steps = (
        "ERK",
        4,
        task.get("substeps", 1),
    )
    options.hessian_approx = "EXACT" if free else "GAUSS_NEWTON"
    options.regularize_method = "MIRROR" if free else "NO_REGULARIZE"
    options.globalization = "FIXED_STEP" if "Q" in task else "MERIT_BACKTRACKING"
    options.nlp_solver_max_iter, options.qp_solver_iter_max, options.print_level = 500, 200, 0
    if not (free or "Q" in task):
        options.hpipm_mode, options.levenberg_marquardt = "ROBUST", 1e-2


def solve(task: dict, number: int) -> dict:
    begun, nx, count, free = spent(), task["nx"], task["count"], task["horizon"][0] < task["horizon"][1]
    text = json.dumps(task)
    solver = COMPILED.get(text) or AcadosOcpSolver(problem_of(task, number), json_file=f"task{number}.json")
    solver.reset()
    if "Q" in task:
        COMPILED[text] = solver
    built, process = spent(), time.process_time()
    x0 = np.array(task["x0"], dtype=float)
    goal = np.array([x0[i] if v is None else v for i, v in enumerate(task["x_goal"])])
    lower, upper = (
        np.array([s * FAR if v is None else v for v in task[f"u_{side}"]]) for side, s in (("lower", -1), ("upper", 1))
    )
    for k in range(count + 1):
        solver.set(k, "x", np.append(x0 + k / count * (goal - x0), [task["start_horizon"]] * free))
        if k < count:
            solver.set(k, "u", np.clip(np.zeros(task["nu"]), lower, upper))
    status = solver.solve()
    done = time.process_time()
    xs = np.array([solver.get(k, "x") for k in range(count + 1)])
    us = [solver.get(k, "u").tolist() for k in range(count)]
    end = float(xs[-1, nx]) if free else task["horizon"][0]
    return {
        "solved": status == 0,
        "told": ENDED.get(status, f"status {status}"),
        "cost": float(solver.get_cost()),
        "build": built - begun,
        "solve": done - process,
        "times": np.linspace(0, end, count + 1).tolist(),
        "xs": np.where(np.isfinite(xs), xs, 1e30)[:, :nx].tolist(),
        "us": [*us, us[-1]],
        "inputs": "held",
    }


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # separate the output of compilers and templates from the answers
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for number, text in enumerate(sys.stdin):
            print(json.dumps(solve(json.loads(text), number)), file=answers, flush=True)

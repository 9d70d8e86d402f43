"""Crocoddyl's side of `ilqr.py`, for an environment of its own: problems as JSON on standard input, answers out.

    pip install crocoddyl==3.2.1 pin==4.0.0 libpinocchio==4.0.0

With pip's default pin 4.1.0 the same Crocoddyl gives wrong answers.
"""

import json
import statistics
import sys
import time

import crocoddyl
import numpy as np
import pinocchio

REPEATS = 5


def solve(task: dict) -> dict:
    """The problem of `ilqr.py`: Crocoddyl's Euler step is Drake's without damping, its costs have a half."""
    state = crocoddyl.StateMultibody(pinocchio.buildModelFromUrdf(task["urdf"]))
    actuation = crocoddyl.ActuationModelFull(state)

    def model(q_weight: float, v_weight: float, u_weight: float, dt: float):
        nq, nv = state.nq, state.nv
        weights = np.concatenate([np.full(nq, 2 * q_weight), np.full(nv, 2 * v_weight)])
        costs = crocoddyl.CostModelSum(state)
        goal = crocoddyl.ResidualModelState(state, np.array(task["x_goal"]))
        activation = crocoddyl.ActivationModelWeightedQuad(weights)
        costs.addCost("state", crocoddyl.CostModelResidual(state, activation, goal), 1.0)
        effort = crocoddyl.ResidualModelControl(state, state.nv)
        costs.addCost("effort", crocoddyl.CostModelResidual(state, effort), 2 * u_weight)
        free = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
        return crocoddyl.IntegratedActionModelEuler(free, dt)

    x0, count = np.array(task["x0"]), task["count"]
    running = model(*task["running"], task["time_step"])
    final = model(*task["final"], 0.0)
    times = []
    for _ in range(REPEATS):
        solver = crocoddyl.SolverFDDP(crocoddyl.ShootingProblem(x0, [running] * count, final))
        solver.th_stop = task["tolerance"]
        start = time.perf_counter()
        done = solver.solve([x0] * (count + 1), [np.zeros(state.nv)] * count, 500, False)
        times.append(time.perf_counter() - start)
    end = [float(v) for v in solver.xs[-1]]
    return {"seconds": statistics.median(times), "cost": solver.cost, "iterations": solver.iter, "ok": done, "end": end}


print(json.dumps([solve(task) for task in json.load(sys.stdin)]))

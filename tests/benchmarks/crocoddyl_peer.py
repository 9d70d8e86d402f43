"""Crocoddyl's side of `ilqr.py`, for an environment of its own: problems as JSON on standard input, answers out.

    python crocoddyl_peer.py [--threads 1] < problems.json

    pip install crocoddyl==3.2.1 pin==4.0.0 libpinocchio==4.0.0

With pip's default pin 4.1.0 the same Crocoddyl gives wrong answers.
"""

import argparse
import json
import statistics
import sys
import time

import crocoddyl
import numpy as np
import pinocchio

REPEATS = 7


def solve(task: dict, threads: int) -> dict:
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
    times, cpu = [], []
    for _ in range(REPEATS):
        problem = crocoddyl.ShootingProblem(x0, [running] * count, final)
        problem.nthreads = threads
        solver = crocoddyl.SolverFDDP(problem)
        solver.th_stop = task["stop"]
        start = time.perf_counter(), time.process_time()
        done = solver.solve([x0] * (count + 1), [np.zeros(state.nv)] * count, 500, False)
        times.append(time.perf_counter() - start[0])
        cpu.append(time.process_time() - start[1])
    end = [float(v) for v in solver.xs[-1]]
    spent = {"seconds": statistics.median(times), "cpu": statistics.median(cpu)}
    return spent | {"cost": solver.cost, "iterations": solver.iter, "ok": done, "end": end}


parser = argparse.ArgumentParser()
parser.add_argument("--threads", type=int, default=1)
threads = parser.parse_args().threads
print(json.dumps([solve(task, threads) for task in json.load(sys.stdin)]))

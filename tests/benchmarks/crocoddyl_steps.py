"""Crocoddyl's side of the suite: a model, then requests, a JSON line each on standard input; the answers out.

For the environment of `crocoddyl_peer.py`. A request names quantity, horizon and calls, and is answered by the seconds
that the calls took, on the wall and of the processor; with 0 calls by what the quantity is.
"""

import json
import sys
import time

import crocoddyl
import numpy as np
import pinocchio


class Side:
    def __init__(self, told: dict):
        state = crocoddyl.StateMultibody(pinocchio.buildModelFromXML(told["urdf"]))
        actuation = crocoddyl.ActuationModelFull(state)
        costs = crocoddyl.CostModelSum(state)
        free = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
        self.model = crocoddyl.IntegratedActionModelEuler(free, told["time_step"])
        self.data = self.model.createData()
        self.x, self.u, self.ends = (np.array(told[name]) for name in ("x", "u", "ends"))
        self.problems = {}

    def step(self, horizon: int):
        self.model.calc(self.data, self.x, self.u)
        return self.data.xnext

    def step_jacobian(self, horizon: int):
        self.model.calc(self.data, self.x, self.u)
        self.model.calcDiff(self.data, self.x, self.u)
        return self.data.Fx, self.data.Fu.reshape(len(self.ends), -1)  # a column comes as a vector

    def linearization(self, horizon: int):
        if horizon not in self.problems:
            self.problems[horizon] = crocoddyl.ShootingProblem(self.x, [self.model] * horizon, self.model)
            self.problems[horizon].nthreads = 1  # the others have one too
        problem, us = self.problems[horizon], [self.u] * horizon
        xs = problem.rollout(us)
        problem.calc(xs, us)
        problem.calcDiff(xs, us)
        return problem.runningDatas

    def rollout_gradient(self, horizon: int):
        by, found = self.ends, []
        for data in reversed(list(self.linearization(horizon))):
            found.append(data.Fu.reshape(len(by), -1).T @ by)
            by = data.Fx.T @ by
        return found[::-1]

    def answer(self, request: dict) -> dict:
        call, horizon = getattr(self, request["quantity"]), request["horizon"]
        if not request["calls"]:
            found = None if request["quantity"] == "linearization" else call(horizon)
            return {"answer": found}
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(request["calls"]):
            call(horizon)
        return {"seconds": [time.perf_counter() - wall, time.process_time() - cpu]}


def main() -> None:
    side = Side(json.loads(sys.stdin.readline()))
    print(json.dumps({}), flush=True)
    for line in sys.stdin:
        print(json.dumps(side.answer(json.loads(line)), default=lambda a: np.asarray(a).tolist()), flush=True)


main()

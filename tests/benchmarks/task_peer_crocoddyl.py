"""Solve tasks (JSON lines) for robots from files with Crocoddyl's SolverBoxFDDP.

    python task_peer_crocoddyl.py < tasks.json

    pip install crocoddyl==3.2.1 pin==4.0.0 libpinocchio==4.0.0     # in a separate environment

The problems minimize effort in a given time with limits of inputs. The goal is a final cost of 1e5 times the squared
distance. Only the referee checks limits of states. Seconds are processor time.
"""

import json
import sys
import time
import xml.etree.ElementTree as ET

import crocoddyl
import numpy as np
import pinocchio

GOAL = 1e5


def robot_of(path: str) -> pinocchio.Model:
    """Read a file, completed for Pinocchio: a link "world", limits of all joints, "revolute" for "continuous"."""
    root = ET.parse(path).getroot()
    if not any(link.get("name") == "world" for link in root.iter("link")):
        ET.SubElement(root, "link", name="world")
    for joint in root.findall("joint"):
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
        if joint.get("type") in ("revolute", "prismatic"):
            limit = joint.find("limit")
            limit = ET.SubElement(joint, "limit") if limit is None else limit
            for name, value in {"lower": "-1e6", "upper": "1e6", "effort": "1e6", "velocity": "1e6"}.items():
                limit.set(name, limit.get(name, value))
    return pinocchio.buildModelFromXML(ET.tostring(root, encoding="unicode"))


def solve(task: dict) -> dict:
    begun, nx, count = time.process_time(), task["nx"], task["count"]
    robot = robot_of(task["file"])
    state, step = crocoddyl.StateMultibody(robot), task["horizon"][0] / count
    actuation, nv = crocoddyl.ActuationModelFull(state), robot.nv  # a joint without a motor has effort limits of 0
    driven = [robot.joints[robot.getJointId(name)].idx_v for name in task["driven"]]
    effort = crocoddyl.CostModelSum(state, nv)
    paid, wanted_u, lower, upper = np.full(nv, 1e-9), np.zeros(nv), np.zeros(nv), np.zeros(nv)
    paid[driven], wanted_u[driven] = 2 * np.diag(np.array(task["R"])), task["u_ref"]
    lower[driven] = [-1e9 if v is None else v for v in task["u_lower"]]
    upper[driven] = [1e9 if v is None else v for v in task["u_upper"]]
    weights = crocoddyl.ActivationModelWeightedQuad(paid)
    residual = crocoddyl.ResidualModelControl(state, wanted_u)
    effort.addCost("effort", crocoddyl.CostModelResidual(state, weights, residual), 1.0)
    at_goal = crocoddyl.CostModelSum(state, nv)
    wanted = [i for i in range(nx) if task["x_goal"][i] is not None]
    goal = np.array([0.0 if value is None else value for value in task["x_goal"]])
    weights = crocoddyl.ActivationModelWeightedQuad(np.isin(np.arange(nx), wanted) * 2.0)
    residual = crocoddyl.ResidualModelState(state, goal, nv)
    at_goal.addCost("goal", crocoddyl.CostModelResidual(state, weights, residual), GOAL)

    def stage(costs, h):
        free = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
        model = (
            crocoddyl.IntegratedActionModelRK(free, crocoddyl.RKType.four, h)
            if h
            else crocoddyl.IntegratedActionModelEuler(free, 0.0)
        )
        model.u_lb, model.u_ub = lower, upper
        return model

    x0 = np.array(task["x0"])
    solver = crocoddyl.SolverBoxFDDP(crocoddyl.ShootingProblem(x0, [stage(effort, step)] * count, stage(at_goal, 0.0)))
    solver.problem.nthreads = 1
    built = time.process_time()
    line = list(np.linspace(x0, np.where(np.isin(np.arange(nx), wanted), goal, x0), count + 1))
    done = solver.solve(line, [np.zeros(nv)] * count, 500, False)
    ended = time.process_time()
    us = [np.array(u)[driven].tolist() for u in solver.us]
    return {
        "solved": bool(done),
        "told": f"{'converged' if done else 'not converged'} in {solver.iter} iterations",
        "cost": float(solver.cost),
        "build": built - begun,
        "solve": ended - built,
        "times": (step * np.arange(count + 1)).tolist(),
        "xs": [np.array(x).tolist() for x in solver.xs],
        "us": [*us, us[-1]],
        "inputs": "held",
    }


if __name__ == "__main__":
    for text in sys.stdin:
        print(json.dumps(solve(json.loads(text))), flush=True)

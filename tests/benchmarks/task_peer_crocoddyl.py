"""Solve tasks (JSON lines) for robots from files with Crocoddyl.

    python task_peer_crocoddyl.py < tasks.json

    pip install crocoddyl==3.2.1 pin==4.0.0 libpinocchio==4.0.0     # in a separate environment

A task of `task_peers.py` minimizes effort in a given time with limits of inputs, by SolverBoxFDDP and steps of
Runge-Kutta. The goal is a final cost of 1e5 times the squared distance. Only the referee checks limits of states. A
task of `peers_examples.py` is solved as Crocoddyl's examples are: by SolverFDDP, or SolverBoxFDDP if inputs have
limits, Euler steps and the default guess. Seconds are processor time.
"""

import json
import sys
import time
import xml.etree.ElementTree as ET

import crocoddyl
import numpy as np
import pinocchio
from crocoddyl.utils.pendulum import ActuationModelDoublePendulum, CostModelDoublePendulum
from crocoddyl.utils.quadruped import SimpleQuadrupedalGaitProblem

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
    kinds = {"unicycle": unicycle, "trot": trot, "costs": with_costs, "effort": least_effort}
    begun, kind = time.process_time(), task.get("kind", "effort")
    solver, guess, driven = kinds[kind](task)
    built = time.process_time()
    done = solver.solve(*guess, 500, False)
    ended = time.process_time()
    us = [np.array(u)[driven].tolist() for u in solver.us if len(u)]  # an impact has no input
    return {
        "solved": bool(done),
        "told": f"{'converged' if done else 'not converged'} in {solver.iter} iterations",
        "cost": float(solver.cost),
        "build": built - begun,
        "solve": ended - built,
        "times": np.linspace(0, task["horizon"][0], len(solver.xs)).tolist(),
        "xs": [np.array(x).tolist() for x in solver.xs],
        "us": [*us, us[-1]],
        "inputs": "held",
    }


def least_effort(task: dict) -> tuple:
    """Return (solver, guess, driven inputs) of a task of `task_peers.py`."""
    robot, count = robot_of(task["file"]), task["count"]
    driven, nv = inputs_of(robot, task), robot.nv
    paid, wanted_u, lower, upper = np.full(nv, 5e-10), np.zeros(nv), np.zeros(nv), np.zeros(nv)
    paid[driven], wanted_u[driven] = np.diag(np.array(task["R"])), task["u_ref"]
    lower[driven] = [-1e9 if v is None else v for v in task["u_lower"]]
    upper[driven] = [1e9 if v is None else v for v in task["u_upper"]]
    x0, given = np.array(task["x0"]), np.array([value is not None for value in task["x_goal"]])
    goal = np.array([0.0 if value is None else value for value in task["x_goal"]])
    final = {"x": GOAL * given, "x_ref": goal}
    actuation = crocoddyl.ActuationModelFull(crocoddyl.StateMultibody(robot))  # no motor: effort limits of 0
    problem = problem_of(actuation, x0, task, {"u": paid, "u_ref": wanted_u}, final, runge_kutta)
    for model in (*problem.runningModels, problem.terminalModel):
        model.u_lb, model.u_ub = lower, upper
    line = list(np.linspace(x0, np.where(given, goal, x0), count + 1))
    return crocoddyl.SolverBoxFDDP(problem), (line, [np.zeros(nv)] * count), driven


def with_costs(task: dict) -> tuple:
    """Return (solver, guess, driven inputs) of a task that lists its costs. Thrusters drive a file without joints."""
    if task["thrusters"]:
        robot = pinocchio.buildModelFromUrdf(task["file"], pinocchio.JointModelFreeFlyer())
        state, kinds = crocoddyl.StateMultibody(robot), (crocoddyl.ThrusterType.CCW, crocoddyl.ThrusterType.CW)
        poses = [(pinocchio.SE3(np.eye(3), np.array(point)), ratio) for point, ratio in task["thrusters"]]
        rotors = [crocoddyl.Thruster(pose, abs(ratio), kinds[ratio > 0]) for pose, ratio in poses]
        actuation = crocoddyl.ActuationModelFloatingBaseThrusters(state, rotors)
        x0 = state.zero()
    else:
        robot = robot_of(task["file"])
        state, x0 = crocoddyl.StateMultibody(robot), np.array(task["x0"])
        full = len(task["driven"]) == robot.nv
        actuation = crocoddyl.ActuationModelFull(state) if full else ActuationModelDoublePendulum(state, actLink=1)
    problem = problem_of(actuation, x0, task, task["running"], task["final"])
    order = inputs_of(robot, task) if actuation.nu == len(task["driven"]) > 1 else range(actuation.nu)
    if not task["limits"]:
        return crocoddyl.SolverFDDP(problem), ([], []), order
    for model in problem.runningModels:
        model.u_lb, model.u_ub = (np.full(actuation.nu, limit) for limit in task["limits"])
    return crocoddyl.SolverBoxFDDP(problem), ([], []), order


def inputs_of(robot: pinocchio.Model, task: dict) -> list[int]:
    return [robot.joints[robot.getJointId(name)].idx_v for name in task["driven"]]


def problem_of(actuation, x0, task, running, final, integrated=crocoddyl.IntegratedActionModelEuler):
    """Return the problem of a running and a final cost, see `cost_of`."""
    forward, costs = crocoddyl.DifferentialActionModelFreeFwdDynamics, (cost_of(actuation, c) for c in (running, final))
    stage, end = (forward(actuation.state, actuation, cost) for cost in costs)
    stages = [integrated(stage, task["horizon"][0] / task["count"])] * task["count"]
    problem = crocoddyl.ShootingProblem(x0, stages, crocoddyl.IntegratedActionModelEuler(end, 0.0))
    problem.nthreads = 1
    return problem


def runge_kutta(stage, step):
    return crocoddyl.IntegratedActionModelRK(stage, crocoddyl.RKType.four, step)


def cost_of(actuation, terms: dict) -> crocoddyl.CostModelSum:
    """Return the sum of weighted squares, without a half. `terms` has the weights of each residual."""
    state, nu = actuation.state, actuation.nu
    total, frame = crocoddyl.CostModelSum(state, nu), state.pinocchio.getFrameId(terms.get("frame", "universe"))
    makes = {
        "x": lambda: crocoddyl.ResidualModelState(state, np.array(terms.get("x_ref", state.zero())), nu),
        "u": lambda: crocoddyl.ResidualModelControl(state, np.array(terms.get("u_ref", np.zeros(nu)))),
        "position": lambda: crocoddyl.ResidualModelFrameTranslation(state, frame, np.array(terms["target"]), nu),
        "rotation": lambda: crocoddyl.ResidualModelFrameRotation(state, frame, np.eye(3), nu),
    }
    for name in makes.keys() & terms.keys():
        residual = makes[name]()
        activation = crocoddyl.ActivationModelWeightedQuad(np.broadcast_to(terms[name], residual.nr) * 2.0)
        total.addCost(name, crocoddyl.CostModelResidual(state, activation, residual), 1.0)
    if "upright" in terms:
        activation = crocoddyl.ActivationModelWeightedQuad(2.0 * np.array(terms["upright"]))
        total.addCost("upright", CostModelDoublePendulum(state, activation, nu), 1.0)
    return total


def unicycle(task: dict) -> tuple:
    """Return (solver, guess, inputs) of Crocoddyl's own unicycle."""
    model = crocoddyl.ActionModelUnicycle()
    problem = crocoddyl.ShootingProblem(np.array(task["x0"]), [model] * task["count"], model)
    return crocoddyl.SolverFDDP(problem), ([], []), range(2)


def trot(task: dict) -> tuple:
    """Return (solver, guess, driven inputs) of the trot of Crocoddyl's examples."""
    robot = pinocchio.buildModelFromUrdf(task["file"], pinocchio.JointModelFreeFlyer())
    x0 = np.array(task["x0"])
    robot.referenceConfigurations["standing"] = x0[: robot.nq]
    problem = SimpleQuadrupedalGaitProblem(robot, *task["feet"]).createTrottingProblem(x0, *task["gait"])
    guess = [x0] * (problem.T + 1), problem.quasiStatic([x0] * problem.T)
    return crocoddyl.SolverFDDP(problem), guess, range(robot.nv - 6)


if __name__ == "__main__":
    for text in sys.stdin:
        print(json.dumps(solve(json.loads(text))), flush=True)

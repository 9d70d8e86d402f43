"""A task of a robot on legs as Crocoddyl solves it, told when each foot stands; reads JSON, prints a line of JSON.

Needs crocoddyl and pinocchio alone. Feet that stand are rigid contacts, a foot that lands is an impact, and the cost is
that of Crocoddyl's own gaits: the swing of the feet, a regularized state and input, the place of the base at the end.
"""

import json
import sys
import time

import crocoddyl
import numpy as np
import pinocchio as pin


def to_pinocchio(task, model, x):
    """q, v of a state (nx,) in the order of Drake's positions."""
    names, count = task["positions"], len(task["positions"])
    q, v = pin.neutral(model), np.zeros(model.nv)
    q[:3], q[3:7] = x[4:7], [x[1], x[2], x[3], x[0]]
    R = pin.Quaternion(q[6], q[3], q[4], q[5]).toRotationMatrix()
    v[:3], v[3:6] = R.T @ x[count + 3 : count + 6], R.T @ x[count : count + 3]
    for joint, name in zip(model.joints[2:], model.names[2:], strict=True):
        i = names.index(f"{name}_q")
        q[joint.idx_q], v[joint.idx_v] = x[i], x[count + i - 1]
    return np.concatenate([q, v])


def costs_of(state, actuation, x_ref, feet, goal=None):
    """Regularization, feet that follow a way, and the end."""
    nu = actuation.nu
    costs = crocoddyl.CostModelSum(state, nu)
    weights = np.concatenate([[0.0] * 3, [500.0] * 3, [0.01] * (state.nv - 6), [10.0] * 6, [1.0] * (state.nv - 6)])
    keep = crocoddyl.ResidualModelState(state, x_ref, nu)
    keep_weights = crocoddyl.ActivationModelWeightedQuad(weights**2)
    costs.addCost("state", crocoddyl.CostModelResidual(state, keep_weights, keep), 1e1 if goal is None else 1e2)
    if nu:
        effort = crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelControl(state, nu))
        costs.addCost("effort", effort, 1e-1)
    for frame, place in feet:
        residual = crocoddyl.ResidualModelFrameTranslation(state, frame, place, nu)
        costs.addCost(f"foot{frame}", crocoddyl.CostModelResidual(state, residual), 1e6)
    if goal is not None:
        residual = crocoddyl.ResidualModelFrameTranslation(state, goal[0], goal[1], nu)
        costs.addCost("base", crocoddyl.CostModelResidual(state, residual), 1e6)
    return costs


def problem_of(task, model):
    state = crocoddyl.StateMultibody(model)
    actuation = crocoddyl.ActuationModelFloatingBase(state)
    data, h = model.createData(), task["time_step"]
    frames = {foot: model.getFrameId(foot) for foot in task["feet"]}

    def places(x):
        pin.framesForwardKinematics(model, data, x[: model.nq])
        return {foot: data.oMf[frame].translation.copy() for foot, frame in frames.items()}

    x0, end = (to_pinocchio(task, model, np.array(task[key])) for key in ("x0", "end"))
    x_ref = np.concatenate([end[: model.nq], np.zeros(model.nv)])
    first, last = places(x0), places(end)
    total = {foot: sum(foot not in standing for _, standing in task["phases"]) for foot in frames}
    done, before, models = dict.fromkeys(frames, 0), set(frames), []
    for number, (steps, standing) in enumerate(task["phases"]):
        landing = [foot for foot in standing if foot not in before]
        if landing:
            impulses = crocoddyl.ImpulseModelMultiple(state)
            for foot in standing:
                one = crocoddyl.ImpulseModel3D(state, frames[foot], pin.LOCAL_WORLD_ALIGNED)
                impulses.addImpulse(foot, one)
            lands = [
                (frames[foot], first[foot] + done[foot] / total[foot] * (last[foot] - first[foot])) for foot in landing
            ]
            none = type("None", (), {"nu": 0})
            costs = costs_of(state, none, x_ref, lands)
            models.append(crocoddyl.ActionModelImpulseFwdDynamics(state, impulses, costs))
        swinging = [foot for foot in frames if foot not in standing]
        for k in range(steps):
            contacts = crocoddyl.ContactModelMultiple(state, actuation.nu)
            for foot in standing:
                gains = np.array([0.0, 50.0])
                one = crocoddyl.ContactModel3D(
                    state, frames[foot], np.zeros(3), pin.LOCAL_WORLD_ALIGNED, actuation.nu, gains
                )
                contacts.addContact(foot, one)
            s, ways = (k + 1) / steps, []
            for foot in swinging if standing else ():
                part = (done[foot] + s) / total[foot]
                at = first[foot] + part * (last[foot] - first[foot])
                ways.append((frames[foot], at + np.array([0.0, 0.0, task["swing"] * 4 * s * (1 - s)])))
            final = number == len(task["phases"]) - 1 and k >= steps - 10
            goal = (model.getFrameId(task["base"]), end[:3]) if final else None
            costs = costs_of(state, actuation, x_ref, ways, goal)
            for foot in standing:
                cone = crocoddyl.FrictionCone(np.eye(3), task["friction"], 4, False)
                inside = crocoddyl.ActivationModelQuadraticBarrier(crocoddyl.ActivationBounds(cone.lb, cone.ub))
                friction = crocoddyl.ResidualModelContactFrictionCone(state, frames[foot], cone, actuation.nu)
                costs.addCost(f"cone{foot}", crocoddyl.CostModelResidual(state, inside, friction), 1e1)
            moves = crocoddyl.DifferentialActionModelContactFwdDynamics(state, actuation, contacts, costs, 0.0, True)
            models.append(crocoddyl.IntegratedActionModelEuler(moves, h))
        done = {foot: count + (foot in swinging) for foot, count in done.items()}
        before = set(standing)
    return crocoddyl.ShootingProblem(x0, models, models[-1]), end


def main():
    task = json.load(sys.stdin)
    model = pin.buildModelFromUrdf(task["file"], pin.JointModelFreeFlyer())
    problem, end = problem_of(task, model)
    problem.nthreads = 1
    solver = crocoddyl.SolverFDDP(problem)
    solver.th_stop = 1e-7
    xs = [problem.x0] * (problem.T + 1)
    begun = time.process_time()
    us = problem.quasiStatic([problem.x0] * problem.T)
    converged = solver.solve(xs, us, 100, False)
    seconds = time.process_time() - begun
    off = float(np.linalg.norm(np.array(solver.xs[-1][:3]) - end[:3]))
    solved = bool(solver.isFeasible and off <= task["at_place"])
    told = {"solved": solved, "converged": bool(converged), "cpu_s": seconds, "iterations": solver.iter, "off": off}
    print(json.dumps(told))


if __name__ == "__main__":
    main()

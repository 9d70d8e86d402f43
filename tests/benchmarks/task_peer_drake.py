"""Solve tasks (JSON lines) with Drake's DirectCollocation and IPOPT or SNOPT, as in Drake's examples.

    python task_peer_drake.py IPOPT|SNOPT < tasks.json

The plant is read from its file or is a SymbolicVectorSystem of the formulas. Solvers have their defaults, except for
the tolerance, which is that of `dd.solve`, and limits of 500 (major) iterations and one minute. The output contains
processor time [s]: `build` for the plant and the program, `solve` for the solver.
"""

import json
import sys
import time

import numpy as np
import pydrake.math as pm
import task_formulas
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.planning import DirectCollocation
from pydrake.solvers import IpoptSolver, SnoptSolver, SolverOptions
from pydrake.symbolic import Variable
from pydrake.systems.framework import InputPortSelection
from pydrake.systems.primitives import SymbolicVectorSystem
from pydrake.trajectories import PiecewisePolynomial

LONGEST = 60.0  # [s]


def system_of(task):
    """Return (system, input port)."""
    if task["file"]:
        plant = MultibodyPlant(0.0)
        Parser(plant).AddModels(task["file"])
        plant.Finalize()
        return plant, plant.get_actuation_input_port().get_index()
    x, u = ([Variable(f"{name}{i}") for i in range(task[n])] for name, n in (("x", "nx"), ("u", "nu")))
    rates = getattr(task_formulas, task["formula"])(x, u, pm, **task["constants"])
    return SymbolicVectorSystem(state=x, input=u, dynamics=rates, output=x), InputPortSelection.kUseFirstInputIfItExists


def program_of(task: dict) -> DirectCollocation:
    """Return the program of a task with a straight line as initial guess."""
    (system, port), nx, steps = system_of(task), task["nx"], [span / task["count"] for span in task["horizon"]]
    program = DirectCollocation(system, system.CreateDefaultContext(), task["count"] + 1, *steps, input_port_index=port)
    x, u, prog = program.state(), program.input(), program.prog()
    if steps[0] < steps[1]:
        program.AddEqualTimeIntervalsConstraints()
        program.AddFinalCost(task["time_weight"] * program.time())
    for values, names in ((x, "x"), (u, "u")):
        for value, low, high in zip(values, task[f"{names}_lower"], task[f"{names}_upper"], strict=True):
            if low is not None:
                program.AddConstraintToAllKnotPoints(value >= low)
            if high is not None:
                program.AddConstraintToAllKnotPoints(value <= high)
    for a, b, radius in task["disks"]:
        program.AddConstraintToAllKnotPoints((x[0] - a) ** 2 + (x[1] - b) ** 2 >= radius**2)
    if task["R"]:
        apart = u - np.array(task["u_ref"])
        program.AddRunningCost(apart @ np.array(task["R"]) @ apart)
    x0, goal = np.array(task["x0"]), task["x_goal"]
    prog.AddBoundingBoxConstraint(x0, x0, program.initial_state())
    for i in (i for i in range(nx) if goal[i] is not None):
        prog.AddBoundingBoxConstraint(goal[i], goal[i], program.final_state()[i])
    end = np.array([x0[i] if goal[i] is None else goal[i] for i in range(nx)])
    line = PiecewisePolynomial.FirstOrderHold([0, task["start_horizon"]], np.column_stack([x0, end]))
    program.SetInitialTrajectory(PiecewisePolynomial(), line)
    return program


def solve(task: dict, name: str) -> dict:
    begun, program = time.process_time(), program_of(task)
    options, solver = SolverOptions(), {"IPOPT": IpoptSolver, "SNOPT": SnoptSolver}[name]()
    ours = {
        "IPOPT": {"tol": task["tolerance"], "max_iter": 500, "max_cpu_time": LONGEST},
        "SNOPT": {
            "Major optimality tolerance": task["tolerance"],
            "Major feasibility tolerance": task["tolerance"],
            "Major iterations limit": 500,
            "Time limit": LONGEST,
        },
    }
    for option, value in ours[name].items():
        options.SetOption(solver.solver_id(), option, value)
    prog, built = program.prog(), time.process_time()
    result = solver.Solve(prog, prog.initial_guess(), options)
    done, details = time.process_time(), result.get_solver_details()
    words = details.ConvertStatusToString() if name == "IPOPT" else f"info {details.info}"
    return {
        "solved": bool(result.is_success()),
        "told": f"{result.get_solution_result().name}, {words}",
        "cost": float(result.get_optimal_cost()),
        "build": built - begun,
        "solve": done - built,
        "times": program.GetSampleTimes(result).tolist(),
        "xs": program.GetStateSamples(result).T.tolist(),
        "us": program.GetInputSamples(result).T.tolist(),
        "inputs": "lines",
    }


if __name__ == "__main__":
    for text in sys.stdin:
        print(json.dumps(solve(json.loads(text), sys.argv[1])), flush=True)

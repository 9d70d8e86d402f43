"""Plans with contact: each task is solved from starts drawn by a seed, verified, and checked by an independent referee.

    python tests/benchmarks/contact_plans.py --seed 0 --starts 5 --jobs 2
    python tests/benchmarks/contact_plans.py --tasks go2_stand,go2_trot --time-step 0.05 --starts 2

The referee uses Drake alone. It builds the plant, applies the plan's inputs, and measures the task's requirements. If a
robot without feedback falls because of rounding alone, each step of the plan is compared with Drake's step instead.
A plan that solve calls verified and that the referee rejects is false.
Times are processor seconds of one thread: of the whole solve with its verification, of an iteration of its search, and
of Drake's own simulation of the motion.
"""

import argparse
import contextlib
import importlib
import inspect
import json
import logging
import os
import sys
import time
import warnings
import zlib
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]

import numpy as np  # noqa: E402
from pydrake.systems.analysis import Simulator  # noqa: E402
from solving import solve_with  # noqa: E402

MODULES = ("legged_tasks", "biped_tasks", "manipulation_tasks", "arm_tasks")
REPEATS = 3  # runs of a simulation, of which the fastest counts
AGAIN = 1e-6  # allowed difference of the referee's step from the plan's, because sums have another order


def every_task():
    found = {}
    for name in MODULES:
        if (Path(__file__).parent / f"{name}.py").exists():
            found |= importlib.import_module(name).TASKS
    return found


def simulated(plant, diagram, x0, us, h):
    """Return (states (N+1, nx), seconds) of Drake's own simulation with inputs that are constant over each step."""
    best, xs = np.inf, None
    for _ in range(REPEATS):
        simulator = Simulator(diagram)
        context = simulator.get_mutable_context()
        own = plant.GetMyMutableContextFromRoot(context)
        plant.SetPositionsAndVelocities(own, x0)
        port = plant.get_actuation_input_port()
        value = port.FixValue(own, us[0])
        simulator.Initialize()
        begun, found = time.process_time(), [np.array(x0)]
        for k, u in enumerate(us):
            value.GetMutableData().set_value(u)
            simulator.AdvanceTo((k + 1) * h)
            found.append(plant.GetPositionsAndVelocities(own))
        best, xs = min(best, time.process_time() - begun), np.array(found)
    return xs, best


def off_by_step(plant, diagram, xs, us, h):
    """Return the largest difference of the plan's states from Drake's steps, relative to the larger of |x| and 1."""
    ends = [simulated(plant, diagram, x, u[None], h)[0][1] for x, u in zip(xs[:-1], us, strict=True)]
    return float(np.max(np.abs(np.array(ends) - xs[1:]) / np.maximum(np.abs(xs[1:]), 1.0)))


def referee(task, solution):
    """Return (violated requirements, seconds of Drake's simulation) of a plan, with Drake alone."""
    model = task.problem.model
    if task.build is not None:
        plant, diagram = task.build(model.time_step)
    else:
        plant, diagram = model.plant, model.diagram
    us = np.asarray(solution.us)
    xs, seconds = simulated(plant, diagram, np.asarray(task.problem.x0), us, model.time_step)
    found = [] if task.asks else ["the task has no asks: nothing of its goal is measured"]
    if task.falls:
        xs = np.asarray(solution.xs)
        off = off_by_step(plant, diagram, xs, us, model.time_step)
        if not off <= AGAIN:
            found.append(f"a step of the plan is {off:.3g} from Drake's")
        if not np.array_equal(xs[0], task.problem.x0):
            found.append("the plan does not start where the task does")
    for name, measure, allowed in task.asks:
        miss = measure(xs, us)
        if not miss <= allowed:
            found.append(f"{name}: {miss:.3g} of {allowed:g}")
    lower, upper = task.problem.bounds.u_lower, task.problem.bounds.u_upper
    beyond = float(np.max(np.maximum(us - upper, lower - us)))
    if beyond > AGAIN:
        found.append(f"an input is {beyond:.3g} beyond its limit")
    return found, seconds


def takes_step(make):
    """Return whether a task accepts a time step. The other tasks use their models' time steps."""
    return "h" in inspect.signature(make).parameters


def one(name, seed, start, time_step):
    """Return the row for one task from one start, with the task's own time step if `time_step` is 0."""
    warnings.simplefilter("ignore")
    logging.getLogger("drake").setLevel(logging.ERROR)
    import drake_diff as dd

    random = np.random.default_rng([seed, zlib.crc32(name.encode()), start])
    row = {"task": name, "start": start, "solved": False, "verified": False, "false": False}
    begun = time.process_time()
    try:
        task = every_task()[name](random, **({"h": time_step} if time_step else {}))
    except dd.exceptions.DrakeDiffError as error:
        return row | {"message": f"no guess: {error}", "guess_s": time.process_time() - begun}
    row["guess_s"] = time.process_time() - begun
    # A first solve of one iteration does the work that a process does once: compilation and certification of a source.
    with contextlib.suppress(dd.exceptions.DrakeDiffError):
        solve_with(task.problem, **{**task.options, "max_iterations": 1})
    ticks, begun = [], time.process_time()
    solution = solve_with(task.problem, **{**task.options, "callback": lambda _: ticks.append(time.process_time())})
    row["cpu_s"] = time.process_time() - begun
    row["iterations"] = max(len(solution.iterations) - 1, 0)
    row["status"], row["message"] = solution.status.value, solution.message
    row["verified"] = bool(solution.success)
    row["search_s"] = ticks[-1] - begun if ticks else float("nan")
    wrong, row["simulation_s"] = ["no inputs"], float("nan")
    if np.all(np.isfinite(solution.us)):
        try:
            wrong, row["simulation_s"] = referee(task, solution)
        except RuntimeError as error:  # Drake's step failed
            wrong = [str(error)[:100]]
    row["wrong"] = wrong
    row["solved"] = not wrong
    row["false"] = row["verified"] and bool(wrong)
    if len(ticks) > 1:
        row["iteration_s"] = (ticks[-1] - ticks[0]) / (len(ticks) - 1)
    return row


def told_of(rows):
    """Return the line of the table for a task."""

    def middle(key):
        values = [row[key] for row in rows if np.isfinite(row.get(key, np.nan))]
        return float(np.median(values)) if values else float("nan")

    count = len(rows)
    ratio = middle("iteration_s") / middle("simulation_s")
    numbers = [sum(row[key] for row in rows) for key in ("solved", "verified", "false")]
    seconds = [f"{middle(key):.2f} s" for key in ("guess_s", "cpu_s", "search_s")]
    found = [f"{numbers[0]} of {count}", f"{numbers[1]} of {count}", str(numbers[2])]
    rest = [f"{middle('iterations'):.0f}", f"{1e3 * middle('simulation_s'):.1f} ms", f"{ratio:.1f}"]
    return "| " + " | ".join([rows[0]["task"], *found, *seconds, *rest]) + " |"


COLUMNS = (
    "Task",
    "Referee",
    "Verified",
    "False",
    "Guess",
    "Solve",
    "of it to the end of the search",
    "Iterations",
    "Drake",
    "Iteration / Drake",
)
HEAD = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--tasks", default="", help="names or their beginnings, with commas; all where empty")
    parser.add_argument("--time-step", type=float, default=0.0, help="[s] of robots on legs; each task's own where 0")
    parser.add_argument("--jobs", type=int, default=1, help="processes, each with one start at a time")
    parser.add_argument("--json", default="", help="where all rows are written")
    parser.add_argument("--why", action="store_true", help="tells of each start that is not verified why")
    arguments = parser.parse_args()
    begin = tuple(filter(None, arguments.tasks.split(",")))
    h = arguments.time_step
    names = [
        name for name, make in every_task().items() if name.startswith(begin or "") and (not h or takes_step(make))
    ]
    if not names:
        parser.error(f"no task of that name{' that is told of any time step' * (h > 0)}: {', '.join(every_task())}")
    seed = arguments.seed
    asked = [(name, seed, start, h) for name in names for start in range(arguments.starts)]
    steps = f"steps of {1e3 * h:g} ms" if h else "Drake steps of the tasks' own length"
    print(f"seed {seed}, {arguments.starts} starts, {steps}\n{HEAD}", flush=True)
    rows, open_rows = [], {}
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        for row in pool.map(one, *zip(*asked, strict=True)):
            rows.append(row)
            open_rows.setdefault(row["task"], []).append(row)
            if arguments.why and not (row["verified"] and row["solved"]):
                print(
                    f"  {row['task']} {row['start']}: {row.get('message', '')[:300]} {row.get('wrong', '')}", flush=True
                )
            if len(open_rows[row["task"]]) == arguments.starts:
                print(told_of(open_rows[row["task"]]), flush=True)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(rows, indent=1))
    totals = [sum(row[key] for row in rows) for key in ("solved", "verified", "false")]
    print(f"\n{len(rows)} starts: the referee finds {totals[0]}, {totals[1]} verified, {totals[2]} false")


if __name__ == "__main__":
    main()

"""How many of the tasks that a practitioner asks `dd.solve(problem)` solves: defaults only, random starts, a referee.

    pip install -e '.[test]'
    python tests/benchmarks/tasks.py [--only PATTERN] [--count 20] [--seed 0] [--out tasks.json] [--markdown FILE]
    python tests/benchmarks/tasks.py --beside CasADi [--count 3]

The tasks are those of `task_cases.py`, each with --count random starts and constants by --seed, and 60 s of one core
for a solve. One that says converged in that time is judged by `referee.py`, which has pydrake alone. What is in --out
already is not run again, so that a run that was ended goes on; --markdown writes docs/tasks_solved.md from it. Seconds
are of processor time.

--beside CasADi times the solves in turns with the same transcription written by hand in CasADi (Hermite-Simpson in one
SX expression, IPOPT, the same tolerance, a straight line as guess), where a task is one of plain formulas.
"""

import argparse
import fnmatch
import json
import logging
import os
import statistics
import sys
import time
import warnings
import zlib
from pathlib import Path
from typing import Any

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")  # read when NumPy is imported: small matrices are slower on threads
sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import casadi as ca  # noqa: E402
import numpy as np  # noqa: E402
from referee import judge  # noqa: E402
from task_cases import FAMILIES, NOT_EXPRESSED, Case  # noqa: E402
from trust_solve import NAMED, plan_of  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff._base.statistics import success_rate  # noqa: E402
from drake_diff.exceptions import DrakeDiffError, ModelWarning  # noqa: E402

TIME_LIMIT, AIM = 60.0, 0.95
TASKS = {task.__name__: (family, task) for family, tasks in FAMILIES.items() for task in tasks}
Row = dict[str, Any]


def chosen(name: str, only: str) -> bool:
    return any(fnmatch.fnmatch(name, pattern) for pattern in only.split(","))


def drawn(name: str, seed: int, number: int) -> Case:
    """The case of a task: its number, and not that of the task in the list, decides."""
    return TASKS[name][1](np.random.default_rng([seed, zlib.crc32(name.encode()), number]))


def attempt(name: str, seed: int, number: int, wall_limit: float) -> Row:
    """One solve with defaults, and what the referee says of it."""
    case, begun, clock = drawn(name, seed, number), time.process_time(), time.perf_counter()
    try:
        solution = dd.solve(case.problem, time_limit=wall_limit)
    except DrakeDiffError as error:
        refused = f"refused: {error}"
        return {"claimed": False, "false": "", "miss": 0.0, "status": "refused", "message": refused, "seconds": 0.0}
    seconds, wall = time.process_time() - begun, time.perf_counter() - clock
    why, miss = "", 0.0
    if solution.success:
        plan, h = plan_of(solution, case.model_file(solution) if case.model_file else case.build), solution.time_step
        plan["asks"] = case.asks
        found = [judge(plan, step, NAMED) for step in ((0.0,) if solution.scheme != "step" else (h, h / 2, h / 8))]
        why, miss = next((why for why, _ in found if why), ""), max(miss for _, miss in found)
    chain = solution.options.get("chain", [])
    return {
        "claimed": solution.success,
        "late": seconds > TIME_LIMIT,
        "false": why,
        "miss": miss,
        "status": solution.status.value,
        "message": solution.message,
        "cost": solution.cost,
        "method": f"{solution.method} {solution.scheme}",
        "attempts": max(1, len(chain)),
        "intervals": [case.problem.num_steps, len(solution.us)],
        "seconds": round(seconds, 2),
        "wall": round(wall, 2),
    }


# ------------------------------------------------------------------------------ by hand, in CasADi


class CasadiMath:
    sin, cos, tan = ca.sin, ca.cos, ca.tan


def by_hand(case: Case) -> tuple[float, str, float]:
    """(seconds, how it ended, cost): the problem's formulas in one SX expression."""
    problem, f, begun = case.problem, case.peer, time.process_time()
    nx, nu, count, b = problem.nx, problem.nu, problem.num_steps, problem.bounds
    free = problem.horizon[0] < problem.horizon[1]
    z, horizon = ca.SX.sym("z", nx + nu, 2 * count + 1), ca.SX.sym("T") if free else problem.horizon[0]
    h, columns = horizon / count, [z[:, k] for k in range(2 * count + 1)]
    rates = [ca.vertcat(*f(ca.vertsplit(c[:nx]), ca.vertsplit(c[nx:]), CasadiMath)) for c in columns]
    g, cost = [], horizon if free else 0
    for k in range(0, 2 * count, 2):
        (x, middle, end), (fx, fm, fe) = (c[:nx] for c in columns[k : k + 3]), rates[k : k + 3]
        g += [end - x - h / 6 * (fx + 4 * fm + fe), middle - (x + end) / 2 - h / 8 * (fx - fe)]
        if not free:
            apart = [c[nx:] - problem.running_cost.u_ref for c in columns[k : k + 3]]
            cost += h / 6 * (ca.sumsqr(apart[0]) + 4 * ca.sumsqr(apart[1]) + ca.sumsqr(apart[2]))
    variables = ca.vertcat(ca.vec(z), *[horizon] * free)
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": 1e-8, "ipopt.max_iter": 500}
    solver = ca.nlpsol("solver", "ipopt", {"x": variables, "f": cost, "g": ca.vertcat(*g)}, options)
    lower, upper = (
        np.tile(np.concatenate(side), (2 * count + 1, 1)) for side in ((b.x_lower, b.u_lower), (b.x_upper, b.u_upper))
    )
    lower[0, :nx] = upper[0, :nx] = problem.x0
    lower[-1, :nx] = upper[-1, :nx] = problem.x_goal
    line = np.linspace(problem.x0, problem.x_goal, 2 * count + 1)
    guess = np.hstack([line, np.tile(np.clip(np.zeros(nu), b.u_lower, b.u_upper), (2 * count + 1, 1))])
    times = [[value] * free for value in (problem.start_horizon, *problem.horizon)]
    found = solver(
        x0=np.concatenate([guess.ravel(), times[0]]),
        lbx=np.concatenate([lower.ravel(), times[1]]),
        ubx=np.concatenate([upper.ravel(), times[2]]),
        lbg=0,
        ubg=0,
    )
    ended = solver.stats()
    told = "solved" if ended["success"] else ended["return_status"]
    return time.process_time() - begun, told, float(found["f"])


def beside(names: list[str], seed: int, count: int) -> list[str]:
    """A line each: how many each solved, and the median of the ratios of times, where both did."""
    lines, every = [], []
    for name in names:
        if drawn(name, seed, 0).peer is None:
            continue
        ours, theirs, ratios = 0, 0, []
        for number in range(count):
            case = drawn(name, seed, number)
            begun = time.process_time()
            solution = dd.solve(case.problem, time_limit=TIME_LIMIT)
            seconds = time.process_time() - begun
            hand, told, _ = by_hand(case)
            ours, theirs = ours + solution.success, theirs + (told == "solved")
            if solution.success and told == "solved":
                ratios.append(seconds / hand)
        every += ratios
        middle = f"{statistics.median(ratios):.2f}" if ratios else "-"
        lines.append(f"{name}: verified {ours} of {count}, by hand solved {theirs} of {count}; time ratio {middle}")
        print(lines[-1], flush=True)
    middle = f"{statistics.median(every):.2f} over {len(every)} solves of both" if every else "-"
    lines.append(f"time of dd.solve, verification included, over CasADi by hand: median {middle}")
    print(lines[-1])
    return lines


# ------------------------------------------------------------------------------ what is told


def is_solved(row: Row) -> bool:
    return row["claimed"] and not row["false"] and not row.get("late")


def told(rows: dict[str, Row], only: str) -> list[str]:
    """The figures, a line each."""
    expressed = {key: row for key, row in rows.items() if row["name"] in TASKS}
    solved = sum(is_solved(row) for row in expressed.values())
    false = sum(bool(row["false"]) for row in expressed.values())
    claims = sum(row["claimed"] for row in expressed.values())
    rate = success_rate(solved, max(len(expressed), 1))
    share = solved / max(len(expressed), 1)
    names = {row["name"] for row in expressed.values()}
    left = [name for name in NOT_EXPRESSED if chosen(name, only)]
    own = {name: [is_solved(row) for row in expressed.values() if row["name"] == name] for name in names}
    every = sum(all(found) for found in own.values())
    whole = sum(sum(found) / len(found) for found in own.values()) / max(len(names) + len(left), 1)
    seconds = sorted(row["seconds"] for row in expressed.values()) or [0.0]
    return [
        f"{len(names)} tasks that can be said, {len(expressed)} solves: {solved} solved, {100 * share:.1f} % "
        f"({100 * rate.lower:.1f} to {100 * rate.upper:.1f} %), asked {100 * AIM:g} %"
        + ("" if share >= AIM else ": MISSED"),
        f"false claims: {false} of {claims}, asked 0" + (": MISSED" if false else ""),
        f"tasks solved from every start: {every} of {len(names)}",
        f"with {len(left)} tasks that cannot be said, which count as not solved: {100 * whole:.1f} % of "
        f"{len(names) + len(left)}, each task counting alike",
        f"seconds of one core per solve: median {statistics.median(seconds):.2f}, "
        f"nine of ten within {seconds[int(0.9 * (len(seconds) - 1))]:.1f}, longest {seconds[-1]:.1f}",
    ]


def table(rows: dict[str, Row], only: str) -> list[str]:
    lines = ["| Task | Family | Solved | False | Attempts | Median [s] | Why not |", "|---|---|---|---|---|---|---|"]
    for name, (family, _) in TASKS.items():
        own = [row for row in rows.values() if row["name"] == name]
        if not own:
            continue
        good = sum(is_solved(row) for row in own)
        why = next((row["false"] or row["message"] for row in own if row["false"] or not row["claimed"]), "-")
        why = " ".join(why.replace("|", " ").replace("<", " ").split())[:150]
        attempts = max(row.get("attempts", 1) for row in own)
        seconds = statistics.median(row["seconds"] for row in own)
        lines.append(
            f"| {name.replace('_', ' ')} | {family} | {good} of {len(own)} | {sum(bool(r['false']) for r in own)} | "
            f"{attempts} | {seconds:.1f} | {why} |"
        )
    for name, (family, why) in NOT_EXPRESSED.items():
        if chosen(name, only):
            lines.append(f"| {name.replace('_', ' ')} | {family} | cannot be said | 0 | 0 | - | {why} |")
    return lines


def markdown(rows: dict[str, Row], seed: int, only: str) -> str:
    """docs/tasks_solved.md."""
    text = ["# What `dd.solve(problem)` solves, defaults only", ""]
    text += [
        "Tasks as a practitioner asks them, with random starts and constants, no method and no option but a limit on"
    ]
    text += [
        "time. A solve counts where it says converged within 60 s of one core and a referee that has pydrake alone"
    ]
    text += [
        f"agrees. Written by `python tests/benchmarks/tasks.py --markdown docs/tasks_solved.md`, seed {seed}. Times"
    ]
    text += [
        "depend on the machine. Tasks with fewer starts are slower ones in a run that was ended. Attempts are the most"
    ]
    text += ["first guesses and methods that a solve took.", ""]
    text += [*(f"- {line}" for line in told(rows, only)), "", *table(rows, only)]
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="*", help="patterns of names with commas between them, such as '*pendulum*'")
    parser.add_argument("--count", type=int, default=20, help="random starts of each task")
    parser.add_argument("--seed", type=int, default=0)
    help_wall = f"[s] of a solve on the wall, more than {TIME_LIMIT:g} where the machine is busy with other work"
    parser.add_argument("--wall", type=float, default=TIME_LIMIT, help=help_wall)
    parser.add_argument("--out", type=Path, help="a JSON file; what is in it already is not run again")
    parser.add_argument("--markdown", type=Path, help="write the table there")
    parser.add_argument("--beside", choices=["CasADi"], help="time the solves beside the same by hand instead")
    given = parser.parse_args()
    warnings.simplefilter("ignore", ModelWarning)
    logging.getLogger("drake").setLevel(logging.ERROR)
    names = [name for name in TASKS if chosen(name, given.only)]
    if given.beside:
        beside(names, given.seed, given.count)
        return
    rows: dict[str, Row] = {}
    if given.out and given.out.is_file():
        rows = json.loads(given.out.read_text())
    for number in range(given.count):
        for name in names:
            key = f"{name}, seed {given.seed}, {number}"
            if key in rows:
                continue
            rows[key] = row = {"name": name, **attempt(name, given.seed, number, given.wall)}
            word = "FALSE" if row["false"] else "yes" if row["claimed"] else "no"
            print(f"{word:5} {row['seconds']:6.1f} s  {key}  {(row['false'] or row['message'])[:300]}", flush=True)
            if given.out:
                given.out.write_text(json.dumps(rows, indent=1))
    shown = {key: row for key, row in rows.items() if chosen(row["name"], given.only)}
    print("\n".join(told(shown, given.only)))
    if given.markdown:
        given.markdown.write_text(markdown(shown, given.seed, given.only))


if __name__ == "__main__":
    main()

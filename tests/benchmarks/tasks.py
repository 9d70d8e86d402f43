"""Count the tasks of practitioners that `dd.solve(problem)` solves with defaults from random starts, with a referee.

    pip install -e '.[test]'
    python tests/benchmarks/tasks.py [--only PATTERN] [--count 20] [--seed 0] [--out tasks.json] [--markdown FILE]
    python tests/benchmarks/tasks.py --beside CasADi [--count 3] [--peers peers.json] [--python PYTHON]

Each task of `task_cases.py` has --count random starts and constants by --seed, and 60 s of one core for a solve. If a
solve converges in this time, `referee.py` judges the plan with pydrake alone. A cost is compared with the closed form
if it is known. Results that are already in --out are not run again, so that an interrupted run can be continued.
--markdown writes a section of docs/measured.md from --out and --peers. Seconds are processor time.

--beside times the solves in alternation with a peer of `task_peers.py`: CasADi by hand, Drake's DirectCollocation with
IPOPT or SNOPT, Crocoddyl and acados. The last two need --python of an environment that contains them.
"""

import argparse
import fnmatch
import json
import logging
import statistics
import sys
import time
import warnings
import zlib
from pathlib import Path
from typing import Any

import _one_thread  # noqa: F401 (before NumPy)

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np
from pages import marked, write_section
from rates import success_rate
from referee import judge, judge_phases
from task_cases import FAMILIES, NOT_EXPRESSED, Case
from task_cases_more import MORE
from task_phases import PHASES, PhasedCase
from task_plants import NAMED, plan_of

import drake_diff as dd
from drake_diff.exceptions import DrakeDiffError, ModelWarning

TIME_LIMIT, AIM = 60.0, 0.95
EVERY = {family: [*FAMILIES.get(family, []), *MORE.get(family, [])] for family in dict.fromkeys([*FAMILIES, *MORE])}
EVERY["phases"] = PHASES
TASKS = {task.__name__: (family, task) for family, tasks in EVERY.items() for task in tasks}
Row = dict[str, Any]


def chosen(name: str, only: str) -> bool:
    return any(fnmatch.fnmatch(name, pattern) for pattern in only.split(","))


def drawn(name: str, seed: int, number: int) -> Case | PhasedCase:
    """Return a case of a task, which depends on its number but not on the position of the task in the list."""
    return TASKS[name][1](np.random.default_rng([seed, zlib.crc32(name.encode()), number]))


def attempt(name: str, seed: int, number: int, wall_limit: float) -> Row:
    """Solve a case with defaults, and return a row with the verdict of the referee."""
    case, begun, clock = drawn(name, seed, number), time.process_time(), time.perf_counter()
    try:
        solution = dd.solve(case.problem, time_limit=wall_limit)
    except Exception as error:  # any error counts as not solved, and the run continues
        told = "refused" if isinstance(error, DrakeDiffError) else f"crashed with {type(error).__name__}"
        row = {"claimed": False, "false": "", "miss": 0.0, "status": told, "message": f"{told}: {error}"}
        return row | {"seconds": round(time.process_time() - begun, 2)}
    seconds, wall = time.process_time() - begun, time.perf_counter() - clock
    why, miss = "", 0.0
    in_phases = isinstance(case, PhasedCase)
    if solution.success and in_phases:
        closes = case.problem.periodic is not False
        why, miss = judge_phases(case.plans(solution), case.resets, closes, NAMED)
    elif solution.success:
        plan, h = plan_of(solution, case.model_file(solution) if case.model_file else case.build), solution.time_step
        plan["asks"] = case.asks
        if case.rate is not None:
            plan["rate"] = case.rate, h if solution.scheme == "step" else plan["T"] / 500
        found = [judge(plan, step, NAMED) for step in ((0.0,) if solution.scheme != "step" else (h, h / 2, h / 8))]
        why, miss = next((why for why, _ in found if why), ""), max(miss for _, miss in found)
    chain, parts = solution.options.get("chain", []), solution.phases if in_phases else (solution,)
    return {
        "claimed": solution.success,
        "late": seconds > TIME_LIMIT,
        "false": why,
        "miss": miss,
        "status": solution.status.value,
        "message": solution.message,
        "cost": solution.cost,
        "method": "; ".join(dict.fromkeys(f"{part.method} {part.scheme}" for part in parts)),
        "attempts": max(1, len(chain)),
        "intervals": [sum(part.problem.num_steps for part in parts), sum(len(part.us) for part in parts)],
        "optimum": case.optimum,
        "seconds": round(seconds, 2),
        "wall": round(wall, 2),
    }


# ------------------------------------------------------------------------------ tables


def is_solved(row: Row) -> bool:
    return row["claimed"] and not row["false"] and not row.get("late")


def told(rows: dict[str, Row], only: str) -> list[str]:
    """Return the figures, one per line."""
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
        f"{len(names)} tasks, {len(expressed)} solves: {solved} solved, {100 * share:.1f} % "
        f"({100 * rate.lower:.1f} to {100 * rate.upper:.1f} %), target {100 * AIM:g} %"
        + ("" if share >= AIM else ": MISSED"),
        f"false claims: {false} of {claims}, target 0" + (": MISSED" if false else ""),
        f"tasks solved from every start: {every} of {len(names)}",
        f"with {len(left)} tasks that a Problem cannot state, counted as not solved: {100 * whole:.1f} % of "
        f"{len(names) + len(left)}, with equal weight of each task",
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
            lines.append(f"| {name.replace('_', ' ')} | {family} | cannot be stated | 0 | 0 | - | {why} |")
    return lines


def families(rows: dict[str, Row]) -> list[str]:
    """Return a table of the families, with tasks and solves that count."""
    lines = ["| Family | Tasks | Solved |", "|---|---|---|"]
    for family in dict.fromkeys(family for family, _ in TASKS.values()):
        own = [row for row in rows.values() if row["name"] in TASKS and TASKS[row["name"]][0] == family]
        if own:
            good = sum(is_solved(row) for row in own)
            lines.append(f"| {family} | {len({row['name'] for row in own})} | {good} of {len(own)} |")
    return lines


def optima(rows: dict[str, Row]) -> list[str]:
    """Return a table of the differences between costs and known optima, for each task with solved cases."""
    lines = []
    for name in TASKS:
        own = [row for row in rows.values() if row["name"] == name and is_solved(row) and row.get("optimum")]
        apart = [100 * (row["cost"] / row["optimum"] - 1) for row in own]
        if apart:
            within = f"{min(apart):+.2g} to {max(apart):+.2g} %"
            lines.append(f"| {name.replace('_', ' ')} | {len(own)} | {within} |")
    head = ["| Task | Solves | Cost apart from the optimum |", "|---|---|---|"]
    return ["", "Costs against the optimum in closed form, where it is known:", "", *head, *lines] if lines else []


def ran(rows: list[Row]) -> str:
    """Return the commits and dates of the rows."""
    commits, days = (sorted({row[name] for row in rows if name in row}) for name in ("commit", "date"))
    span = " to ".join(dict.fromkeys([*days[:1], *days[-1:]]))
    return f"commit {', '.join(commits) or 'not known'}, {span or 'no date'}"


def markdown(rows: dict[str, Row], peers: list[Row], seed: int, only: str) -> str:
    """Return the section of docs/measured.md."""
    text = f"""Tasks with random starts and constants, solved by `dd.solve(problem)` with a time limit as the only
option. A solve counts if it converges within 60 s of one core and a referee of pydrake alone agrees.
`python tests/benchmarks/tasks.py --markdown docs/measured.md`, seed {seed}, at {ran(list(rows.values()))}. Tasks with
fewer starts belong to a run that was ended. Attempts are the most first guesses and methods that a solve took.

"""
    lines = [*(f"- {line}" for line in told(rows, only)), "", *families(rows), "", *table(rows, only), *optima(rows)]
    text += "\n".join(lines) + "\n"
    if peers:
        import task_peers

        text += f"""
Beside other solvers: the same tasks, constants, intervals and first guess, in turns on one core, at {ran(peers)}.
Ratios of processor time (median and quartiles, where both solve) below 1 favour `dd.solve`. Its time is the whole solve
or its search; a peer's is building and solving, or its solver. A false plan leaves limits by more than a thousandth of
their range or misses the goal. A cheaper plan costs at least 1 % less.

"""
        text += "\n".join(task_peers.told(peers)) + "\n"
    return text


def compared(given: argparse.Namespace, names: list[str]) -> None:
    """Time the solves in alternation with a peer's. Rows of other tasks and other peers stay in --peers."""
    import task_peers

    rows: list[Row] = []
    mark, old = marked(), json.loads(given.peers.read_text()) if given.peers and given.peers.is_file() else []
    kept = [row for row in old if row["peer"] != given.beside or row["name"] not in names]

    def draw(name: str, number: int) -> Case:
        return drawn(name, given.seed, number)

    for row in task_peers.beside(given.beside, given.python, draw, names, given.count, TIME_LIMIT):
        rows.append(row | mark)
        if given.peers:
            given.peers.write_text(json.dumps(kept + rows, indent=1))
    print("\n".join(task_peers.told(rows)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="*", help="patterns of names with commas between them, such as '*pendulum*'")
    parser.add_argument("--count", type=int, default=20, help="random starts of each task")
    parser.add_argument("--seed", type=int, default=0)
    help_wall = f"[s] of a solve on the wall, more than {TIME_LIMIT:g} where the machine is busy with other work"
    parser.add_argument("--wall", type=float, default=TIME_LIMIT, help=help_wall)
    parser.add_argument("--out", type=Path, help="a JSON file; what is in it already is not run again")
    parser.add_argument("--markdown", type=Path, help="write the section of that page")
    parser.add_argument("--beside", help="a peer of task_peers.PEERS to time the solves beside, instead")
    parser.add_argument("--python", default=sys.executable, help="of the peer's environment, with --beside")
    help_peers = "a JSON file of --beside, which adds to it; --markdown writes it into the page"
    parser.add_argument("--peers", type=Path, help=help_peers)
    given = parser.parse_args()
    warnings.simplefilter("ignore", ModelWarning)
    logging.getLogger("drake").setLevel(logging.ERROR)
    names = [name for name in TASKS if chosen(name, given.only)]
    if given.beside:
        compared(given, names)
        return
    rows: dict[str, Row] = {}
    if given.out and given.out.is_file():
        rows = json.loads(given.out.read_text())
    mark = marked()
    for number in range(given.count):
        for name in names:
            key = f"{name}, seed {given.seed}, {number}"
            if key in rows:
                continue
            rows[key] = row = {"name": name, **attempt(name, given.seed, number, given.wall), **mark}
            word = "FALSE" if row["false"] else "yes" if row["claimed"] else "no"
            print(f"{word:5} {row['seconds']:6.1f} s  {key}  {(row['false'] or row['message'])[:300]}", flush=True)
            if given.out:
                given.out.write_text(json.dumps(rows, indent=1))
    shown = {key: row for key, row in rows.items() if chosen(row["name"], given.only)}
    print("\n".join([*told(shown, given.only), *optima(shown)]))
    if given.markdown:
        peers = json.loads(given.peers.read_text()) if given.peers else []
        write_section(given.markdown, "tasks_solved", markdown(shown, peers, given.seed, given.only))


if __name__ == "__main__":
    main()

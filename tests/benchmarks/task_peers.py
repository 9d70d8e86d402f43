"""Compare `dd.solve` and a peer in alternating solves: solved tasks, plans that hold, and times.

A peer is a script `task_peer_*.py` that runs in the Python of its environment. It reads tasks and writes answers as
JSON lines. Both get the same task: constants, limits, intervals, tolerance, limits of 500 iterations and one minute,
and the straight line to the goal as initial guess. Seconds are processor time. For `dd.solve`, they are those of the
call, with its certificates and measures, and of the search alone. For a peer, they are those of building and solving.
"""

import json
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.trajectories import PiecewisePolynomial
from referee import judge
from task_cases import Case
from task_plants import NAMED

import drake_diff as dd
from drake_diff.optimize import run
from drake_diff.optimize.problem.cost import ConstantCost
from drake_diff.optimize.transcription.collocation import Transcription

HERE = Path(__file__).parent
PEERS = {  # name -> script and its arguments
    "CasADi": ("task_peer_casadi.py",),
    "Drake-IPOPT": ("task_peer_drake.py", "IPOPT"),
    "Drake-SNOPT": ("task_peer_drake.py", "SNOPT"),
    "Crocoddyl": ("task_peer_crocoddyl.py",),
    "acados": ("task_peer_acados.py",),
}
CHEAPER = 0.01  # relative difference of costs that indicates another optimum
TOLERANCE = 1e-8  # of dd.solve
SEARCHES = ("solve_ilqr", "solve_through_jumps", "solve_continuation", "solve_shooting")  # in the model's own steps
Row = dict[str, Any]


# ------------------------------------------------------------------------------ tasks for a peer


def finite(values: Any) -> list[float | None]:
    """Return the values, with None in place of values that are not finite."""
    return [float(v) if np.isfinite(v) else None for v in values]


def asked(case: Case) -> dict[str, Any] | str:
    """Return the task for a peer, or the reason why no peer gets it."""
    problem, b = case.problem, case.problem.bounds
    if (
        len(problem.constraints) != len(case.disks)
        or problem.goals
        or problem.waypoints
        or problem.optimizes_parameters
    ):
        return "goals of links, constraints or parameters"
    cost, free = problem.running_cost, bool(problem.horizon and problem.horizon[0] < problem.horizon[1])
    effort = isinstance(cost, dd.QuadraticCost) and cost.Q is None
    if not (effort or (free and isinstance(cost, ConstantCost))) or problem.final_cost is not None:
        return "another cost than time or effort"
    if problem.x_goal is None or not (case.peer or case.file):
        return "no formulas by hand"
    span = problem.horizon or (problem.start_horizon, problem.start_horizon)
    model = problem.model if problem.has_model else None
    return {
        "nx": problem.nx,
        "nu": problem.nu,
        "formula": case.peer and case.peer.func.__name__,
        "constants": dict(case.peer.keywords) if case.peer else {},
        "file": case.file and str(case.file),
        "driven": [a.joint for a in model.contract.actuators] if model else [],
        "damped": bool(
            model
            and any(model.plant.get_joint(i).default_damping_vector().any() for i in model.plant.GetJointIndices())
        ),
        "x0": np.asarray(problem.x0).tolist(),
        "x_goal": finite(problem.x_goal),
        "count": problem.num_steps,
        "horizon": [float(v) for v in span],
        "start_horizon": problem.start_horizon,
        "time_weight": 0.0 if effort else cost.rate,
        "R": np.asarray(cost.R).tolist() if effort else None,
        "u_ref": (np.zeros(problem.nu) if not effort or cost.u_ref is None else np.asarray(cost.u_ref)).tolist(),
        "disks": [list(map(float, disk)) for disk in case.disks],
        "tolerance": TOLERANCE,
        **{name: finite(getattr(b, name)) for name in ("x_lower", "x_upper", "u_lower", "u_upper")},
    }


def not_said(peer: str, task: dict[str, Any]) -> str:
    """Return the reason why a peer does not support the task, or ""."""
    if peer in ("CasADi", "acados") and not task["formula"]:
        return "no formulas by hand"
    if peer == "Crocoddyl":
        if not task["R"]:
            return "its horizon is given"
        if not (task["file"] or "").endswith(".urdf"):
            return "no URDF"
        if task["damped"]:
            return "it leaves the damping of joints out"
    return ""


# ------------------------------------------------------------------------------ runs


class Peer:
    """A script that runs until its input is closed."""

    def __init__(self, name: str, python: str):
        script, *arguments = PEERS[name]
        self.process = subprocess.Popen(
            [python, str(HERE / script), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def solve(self, task: dict[str, Any]) -> Row:
        """Return the script's answer. If the script ended, this is a failure, and a new script is needed."""
        try:
            self.process.stdin.write(json.dumps(task) + "\n")
            self.process.stdin.flush()
            text = self.process.stdout.readline()
        except BrokenPipeError:
            text = ""
        if text:
            return json.loads(text)
        return {"solved": False, "told": f"its process ended with {self.process.wait()}", "build": 0.0, "solve": 0.0}

    @property
    def ended(self) -> bool:
        return self.process.poll() is not None

    def end(self) -> None:
        self.process.stdin.close()
        self.process.wait()


@contextmanager
def search_seconds() -> Iterator[list[float]]:
    """Add up the processor time of transcription and search by all methods, without certificates and measures."""
    spent, inside = [0.0], [False]
    timed_calls = [(Transcription, "__init__"), (Transcription, "_solve_on"), *((run, name) for name in SEARCHES)]
    originals = [(owner, name, getattr(owner, name)) for owner, name in timed_calls]

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            if inside[0]:
                return function(*given, **named)
            begun, inside[0] = time.process_time(), True
            try:
                return function(*given, **named)
            finally:
                spent[0] += time.process_time() - begun
                inside[0] = False

        return call

    for owner, name, function in originals:
        setattr(owner, name, timed(function))
    try:
        yield spent
    finally:
        for owner, name, function in originals:
            setattr(owner, name, function)


def plan_from(answer: Row, case: Case) -> dict[str, Any]:
    """Return a peer's plan in the form for the referee."""
    problem, b = case.problem, case.problem.bounds
    times, xs, us = (np.array(answer[name]) for name in ("times", "xs", "us"))
    way = PiecewisePolynomial.CubicShapePreserving(times, xs.T)

    def u(t: float) -> np.ndarray:
        k = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2))
        if answer["inputs"] == "held":
            return us[k]
        if answer["inputs"] == "lines":
            return us[k] + (us[k + 1] - us[k]) * (t - times[k]) / (times[k + 1] - times[k])
        k = min(k - k % 2, len(times) - 3)
        s = (t - times[k]) / (times[k + 2] - times[k])
        return us[k] * (1 - s) * (1 - 2 * s) + us[k + 1] * 4 * s * (1 - s) + us[k + 2] * s * (2 * s - 1)

    return {
        "build": case.build,
        "T": float(times[-1]),
        "u": u,
        "x": lambda t: way.value(min(t, times[-1])).ravel(),
        "goal": np.array(problem.x_goal),
        "nq": problem.model.nq if problem.has_model else 0,
        "x_lower": b.x_lower, "x_upper": b.x_upper, "u_lower": b.u_lower, "u_upper": b.u_upper,
        "asks": case.asks,
    }  # fmt: skip


def judged(answer: Row, case: Case) -> str:
    """Return why a plan is wrong, or "" if it holds."""
    times = np.array(answer["times"])
    if not (np.all(np.isfinite(times)) and np.all(np.diff(times) > 0)):
        return "its times do not increase"
    try:
        return judge(plan_from(answer, case), 0.0, NAMED)[0]
    except RuntimeError as error:  # from Drake's integrator
        return f"cannot be simulated: {str(error)[:100]}"


def ours(case: Case, time_limit: float) -> Row:
    begun = time.process_time()
    with search_seconds() as spent:
        solution = dd.solve(case.problem, time_limit=time_limit)
    seconds = time.process_time() - begun
    return {"solved": solution.success, "seconds": seconds, "search": spent[0], "cost": solution.cost}


def beside(
    peer: str, python: str, draw: Callable[[str, int], Case], names: list[str], count: int, time_limit: float
) -> Iterator[Row]:
    """Yield a row for each pair of solves, and one with the reason for each task that the peer does not get."""
    script, warm = Peer(peer, python), False
    for name in names:
        for number in range(count):
            case = draw(name, number)
            task = asked(case)
            why = task if isinstance(task, str) else not_said(peer, task)
            if why:
                yield {"peer": peer, "name": name, "left out": why}
                break
            if not warm:  # the first call, which loads libraries, is not counted
                ours(case, time_limit)
                script.solve(task)
                warm = True
            mine, answer = ours(draw(name, number), time_limit), script.solve(task)
            if script.ended:
                script, warm = Peer(peer, python), False
            false = judged(answer, case) if answer["solved"] else ""
            theirs = {key: answer.get(key) for key in ("solved", "told", "cost", "build", "solve")} | {"false": false}
            yield {"peer": peer, "name": name, "number": number, "ours": mine, "theirs": theirs}
            word = f"FALSE: {false}" if false else answer["told"]
            ratio = mine["seconds"] / max(answer["build"] + answer["solve"], 1e-9)
            print(
                f"{peer} {name} {number}: ours {mine['solved']} {mine['seconds']:.3f} s, ratio {ratio:.2f}, {word}",
                flush=True,
            )
    script.end()


# ------------------------------------------------------------------------------ tables


def quartiles(values: list[float]) -> str:
    if not values:
        return "-"
    low, middle, high = np.percentile(values, [25, 50, 75])
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


def good(row: Row) -> bool:
    return bool(row["theirs"]["solved"] and not row["theirs"]["false"])


def ratios(rows: list[Row]) -> tuple[list[float], list[float], list[float]]:
    """Return the ratios of `dd.solve` and its search to the whole peer, and of its search to the peer's solver alone.

    Rows in which both report a solution are used, even if the peer's plan is wrong.
    """
    both = [row for row in rows if row["ours"]["solved"] and row["theirs"]["solved"]]
    whole = [row["theirs"]["build"] + row["theirs"]["solve"] for row in both]
    return (
        [row["ours"]["seconds"] / t for row, t in zip(both, whole, strict=True)],
        [row["ours"]["search"] / t for row, t in zip(both, whole, strict=True)],
        [row["ours"]["search"] / row["theirs"]["solve"] for row in both],
    )


def told(rows: list[Row]) -> list[str]:
    """Return Markdown tables of the peers, and of each peer's tasks with its failures and the tasks left out."""
    lines = [
        "| Peer | Tasks | Solves | We solved | It solved | It says solved, plan false | Time of `dd.solve` over its | "
        "Search alone over its | Search over its solver alone | Cheaper plan: ours, its |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    names = [name for name in PEERS if any(row["peer"] == name for row in rows)]
    for peer in names:
        own = [row for row in rows if row["peer"] == peer and "ours" in row]
        false = sum(bool(row["theirs"]["false"]) for row in own)
        tasks = len({row["name"] for row in own})
        both = [row for row in own if row["ours"]["solved"] and good(row)] if peer != "Crocoddyl" else []
        costs = [(row["ours"]["cost"], row["theirs"]["cost"]) for row in both]
        cheaper = [sum(a < b - CHEAPER * abs(b) for a, b in pairs) for pairs in (costs, [(b, a) for a, b in costs])]
        lines.append(
            f"| {peer} | {tasks} | {len(own)} | {sum(row['ours']['solved'] for row in own)} | {sum(map(good, own))} | "
            f"{false} | {' | '.join(map(quartiles, ratios(own)))} | "
            f"{f'{cheaper[0]}, {cheaper[1]}' if both else '-'} |"
        )
    lines += [
        "",
        "| Peer | Task | Solved: we, it | Time of `dd.solve` over its | Search alone over its | Its failures |",
        "|---|---|---|---|---|---|",
    ]
    for peer in names:
        own = [row for row in rows if row["peer"] == peer and "ours" in row]
        for name in dict.fromkeys(row["name"] for row in own):
            some = [row for row in own if row["name"] == name]
            bad = [row["theirs"] for row in some if not good(row)]
            why = "; ".join(dict.fromkeys(f"plan false: {b['false']}" if b["false"] else b["told"] for b in bad)) or "-"
            why = " ".join(why.replace("|", " ").replace("<", " ").split())[:160]
            whole, alone, _ = ratios(some)
            solved = f"{sum(row['ours']['solved'] for row in some)} and {sum(map(good, some))} of {len(some)}"
            cells = [peer, name.replace("_", " "), solved, quartiles(whole), quartiles(alone), why]
            lines.append(f"| {' | '.join(cells)} |")
        for row in rows:
            if row["peer"] == peer and "left out" in row:
                lines.append(f"| {peer} | {row['name'].replace('_', ' ')} | left out | - | - | {row['left out']} |")
    return lines

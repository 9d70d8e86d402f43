"""Whole solves: the problems of `collocation.py` and `ilqr.py`, as they stand there, in turns."""

import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import collocation
import ilqr
from suite import Missing, Row, row
from timing import Block, block, measure, timed

import drake_diff as dd
from drake_diff.exceptions import ModelWarning

SOLVES = {"kelly": "Kelly's cart-pole, 50", "panda_reach": "Panda reach"}  # the others take minutes
QUICK_SOLVES = ("kelly",)
BUDGET, QUICK_BUDGET = 20.0, 5.0  # [s]
FDDP = "Crocoddyl FDDP"


def solved(names: list[str], quick: bool) -> Iterator[Row | Missing]:
    """The rows of each whole solve, a key of SOLVES."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        for name in names:
            print(f"{name}, solve", file=sys.stderr, flush=True)
            if name == "panda_reach":
                yield from _reach(ilqr.tasks(Path(folder))[0], BUDGET)
            else:
                problem = collocation.problems(Path(folder))[SOLVES[name]]
                yield from _collocated(name, problem, QUICK_BUDGET if quick else BUDGET)


def _collocated(name: str, problem: dd.Problem, budget: float) -> Iterator[Row]:
    base = "Drake DirectCollocation, IPOPT"
    calls: dict[str, Callable[[], collocation.Row]] = {
        base: lambda: collocation.drakes(problem, "ipopt"),
        "Drake DirectCollocation, SNOPT": lambda: collocation.drakes(problem, "snopt"),
        "drake_diff, verified (dd.solve)": lambda: collocation.verified(problem, "hermite_simpson"),
        "drake_diff, Drake's scheme": lambda: collocation.ours(problem, "drake"),
        "drake_diff, Hermite-Simpson": lambda: collocation.ours(problem, "hermite_simpson"),
    }
    if name == "kelly":
        calls["CasADi by hand, Hermite-Simpson"] = collocation.kelly_by_hand
    firsts = {who: timed(call) for who, call in calls.items()}
    samples = measure({who: block(call) for who, call in calls.items()}, budget)
    about = {"model": name, "joints": problem.model.nv, "quantity": "solve", "horizon": problem.num_steps}
    for who, sample in samples.items():
        answer, first = firsts[who]
        yield row(about, who, _told(*answer[1:]), first, sample, (base, samples[base]), None)


def _reach(task: dict, budget: float) -> Iterator[Row | Missing]:
    who, python = "drake_diff iLQR", os.environ.get("CROCODDYL_PYTHON")
    firsts, blocks = {who: timed(lambda: ilqr.ours(task))}, {who: block(lambda: ilqr.ours(task))}
    notes = {who: "the model's loading included", FDDP: "on the wall"}
    if python:
        firsts[FDDP] = timed(lambda: _crocoddyl(python, task))
        blocks[FDDP] = _by_its_own_clock(python, task)
    else:
        yield Missing("panda_reach", "solve", FDDP, "no $CROCODDYL_PYTHON: see crocoddyl_peer.py")
    samples = measure(blocks, budget)
    about = {"model": "panda_reach", "joints": 7, "quantity": "solve", "horizon": task["count"]}
    for name, sample in samples.items():
        answer, first = firsts[name]
        told = _told("solved" if answer["ok"] else "not solved", answer["cost"], answer["iterations"])
        yield row(about, name, f"{told}, {notes[name]}", first, sample, (who, samples[who]), None)


def _by_its_own_clock(python: str, task: dict) -> Block:
    """The seconds that `crocoddyl_peer.py` measures, on the wall: its start and imports do not count."""

    def run(calls: int) -> tuple[float, float]:
        seconds = sum(_crocoddyl(python, task)["seconds"] for _ in range(calls))
        return seconds, seconds

    return run


def _crocoddyl(python: str, task: dict) -> dict:
    script = Path(__file__).with_name("crocoddyl_peer.py")
    done = subprocess.run([python, script], input=json.dumps([task]), capture_output=True, text=True, check=True)
    return json.loads(done.stdout)[0]


def _told(outcome: str, cost: float, iterations: int) -> str:
    return f"{outcome}, cost {cost:.6g}, {iterations} iterations"

"""Time whole solves of the problems of `collocation.py` and `ilqr.py` in alternation."""

import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import collocation
import ilqr
from suite import Missing, Row, row
from timing import block, measure, timed

import drake_diff as dd
from drake_diff.exceptions import ModelWarning

SOLVES = ("kelly", "panda_reach")
QUICK_SOLVES = ("kelly",)
BUDGET, QUICK_BUDGET = 20.0, 5.0  # [s]


def solved(names: list[str], quick: bool) -> Iterator[Row | Missing]:
    """Yield the rows of each whole solve in `names`, which are names of SOLVES."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        for name in names:
            print(f"{name}, solve", file=sys.stderr, flush=True)
            if name == "panda_reach":
                yield from _reach(ilqr.panda_reach(Path(folder)), BUDGET)
            else:
                yield from _collocated(name, collocation.kelly(), QUICK_BUDGET if quick else BUDGET)


def _collocated(name: str, problem: dd.Problem, budget: float) -> Iterator[Row]:
    base = "Drake DirectCollocation, SNOPT"
    calls: dict[str, Callable[[], collocation.Row]] = {
        base: lambda: collocation.drakes(problem),
        "drake_diff, verified (dd.solve)": lambda: collocation.verified(problem, "hermite_simpson"),
        "drake_diff, Drake's scheme": lambda: collocation.ours(problem, "drake"),
        "drake_diff, Hermite-Simpson": lambda: collocation.ours(problem, "hermite_simpson"),
    }
    calls["CasADi by hand, Hermite-Simpson"] = collocation.kelly_by_hand
    firsts = {who: timed(call) for who, call in calls.items()}
    samples = measure({who: block(call) for who, call in calls.items()}, budget)
    about = {"model": name, "joints": problem.model.nv, "quantity": "solve", "horizon": problem.num_steps}
    for who, sample in samples.items():
        answer, first = firsts[who]
        yield row(about, who, _told(*answer[1:]), first, sample, (base, samples[base]), None)


def _reach(task: dict, budget: float) -> Iterator[Row]:
    who = "drake_diff iLQR"
    answer, first = timed(lambda: ilqr.ours(task))
    sample = measure({who: block(lambda: ilqr.ours(task))}, budget)[who]
    about = {"model": "panda_reach", "joints": 7, "quantity": "solve", "horizon": task["count"]}
    told = _told("solved" if answer["ok"] else "not solved", answer["cost"], answer["iterations"])
    yield row(about, who, f"{told}, the model's loading included", first, sample, (who, sample), None)


def _told(outcome: str, cost: float, iterations: int) -> str:
    return f"{outcome}, cost {cost:.6g}, {iterations} iterations"

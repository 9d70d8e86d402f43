"""Time whole solves of the problem of `collocation.py` in alternation. See also `peers_examples.py`."""

import sys
from collections.abc import Callable, Iterator

import collocation
from suite import Missing, Row, row
from timing import block, measure, timed

SOLVES = ("kelly",)
BUDGET, QUICK_BUDGET = 20.0, 5.0  # [s]


def solved(names: list[str], quick: bool) -> Iterator[Row | Missing]:
    """Yield the rows of each whole solve in `names`, which are names of SOLVES."""
    if not names:
        return
    print("kelly, solve", file=sys.stderr, flush=True)
    base, problem = "Drake DirectCollocation, SNOPT", collocation.kelly()
    calls: dict[str, Callable[[], collocation.Row]] = {
        base: lambda: collocation.drakes(problem),
        "drake_diff, verified (dd.solve)": lambda: collocation.verified(problem, "hermite_simpson"),
        "drake_diff, Drake's scheme": lambda: collocation.ours(problem, "drake"),
        "drake_diff, Hermite-Simpson": lambda: collocation.ours(problem, "hermite_simpson"),
        "CasADi by hand, Hermite-Simpson": collocation.kelly_by_hand,
    }
    firsts = {who: timed(call) for who, call in calls.items()}
    samples = measure({who: block(call) for who, call in calls.items()}, QUICK_BUDGET if quick else BUDGET)
    about = {"model": "kelly", "joints": problem.model.nv, "quantity": "solve", "horizon": problem.num_steps}
    for who, sample in samples.items():
        (_, outcome, cost, iterations), first = firsts[who]
        how = f"{outcome}, cost {cost:.6g}, {iterations} iterations"
        yield row(about, who, how, first, sample, (base, samples[base]), None)

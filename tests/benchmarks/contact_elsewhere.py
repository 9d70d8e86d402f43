"""Where else a plan of `contact_plans.py` holds: the columns that stand beside its verdict.

`where_else(problem, solution)` follows the plan by its own feedback at h/2 and h/4, in continuous time and in MuJoCo.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rates import success_rate

from drake_diff.artifact import elsewhere
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.solution import Solution

PLANTS = "h/2", "h/4", "continuous", "mujoco"
HOLDS, FAILS, NOT_MEASURED = "holds", "does not hold", "not measured"


@dataclass(frozen=True)
class Where:
    """What became of a plan in each of PLANTS, the sentence of it all, and the processor's time that it took [s]."""

    found: dict[str, str]
    sentence: str
    cpu_s: float


def where_else(problem: Problem, solution: Solution) -> Where:
    """Follow the solution of `problem`, and say what became of it in each plant."""
    assert solution.problem is problem
    begun = time.process_time()
    told = elsewhere(solution).elsewhere
    assert told is not None
    rows = dict(zip(PLANTS, (*told["steps"][1:], *told["continuous time"], *told["mujoco"]), strict=True))
    found = {name: HOLDS if row.holds else FAILS if row.measured else NOT_MEASURED for name, row in rows.items()}
    return Where(found, told.sentence, time.process_time() - begun)


def counts(found: Sequence[Mapping[str, str]]) -> list[str]:
    """For each plant "n of m", of the plans that could be followed there, with the 95 % Wilson interval."""
    told = []
    for name in PLANTS:
        measured = [one[name] for one in found if one[name] != NOT_MEASURED]
        if measured:
            rate = success_rate(measured.count(HOLDS), len(measured))
            share = f"{100 * rate.lower:.0f} to {100 * rate.upper:.0f} %"
            told.append(f"{measured.count(HOLDS)} of {len(measured)} ({share})")
        else:
            told.append("-")
    return told

"""Which of several solutions of one problem are distinct optima, by their cost and their motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff.optimize.solution import Solution

SAME_COST = 1e-2  # of the larger one, or of 1: what searches that stop at one optimum on other meshes may differ by
SAME_MOTION = 5e-2  # of each state's range, the root of the mean square over the knots


@dataclass(frozen=True, eq=False)
class Optimum:
    """A verified solution, the first guess that led to it first, and how many did."""

    solution: Solution
    guess: str
    count: int

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        s = self.solution
        return {"cost": s.cost, "horizon": s.horizon, "guess": self.guess, "count": self.count}


def distinct(pairs: Sequence[tuple[Solution, str]]) -> list[Optimum]:
    """Those of the verified solutions and their guesses that are no other's motion, the cheapest first."""
    optima: list[Optimum] = []
    for solution, guess in pairs:
        if not solution.success:
            continue
        for i, other in enumerate(optima):
            if _are_same(solution, other.solution):
                cheapest = min((other.solution, solution), key=lambda s: s.cost)
                optima[i] = Optimum(cheapest, other.guess, other.count + 1)
                break
        else:
            optima.append(Optimum(solution, guess, 1))
    return sorted(optima, key=lambda optimum: optimum.solution.cost)


def _are_same(solution: Solution, other: Solution) -> bool:
    """Whether two solutions of one problem have one cost and one motion at its knots."""
    if abs(solution.cost - other.cost) > SAME_COST * max(1.0, abs(solution.cost), abs(other.cost)):
        return False
    first, second = (np.asarray(s.xs)[s.knots] for s in (solution, other))
    apart = np.abs(first - second) / solution.problem.ranges(np.vstack([first, second]))
    return bool(np.max(np.sqrt(np.mean(apart**2, axis=0))) <= SAME_MOTION)

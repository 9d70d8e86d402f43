"""Searches from a few random initial guesses, without verification, for motions that are cheaper than a plan."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.clock import noted_interrupts
from drake_diff.optimize.guess import another_guess
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits, Outcome, Report
from drake_diff.optimize.run import arrays_of
from drake_diff.optimize.solution import Solution, Status
from drake_diff.optimize.transcription.collocation import FOUND, Transcribed, Transcription

MOST_STARTS, FEWEST_STARTS = 12, 5  # if the first few all lead to the plan's cost, the others are not tried
# Of all starts together (none if fewer than the last), times the steps and the square of the states and inputs, so that
# they take about as long for robots as for small systems, and of one start, as longer ones rarely end cheaper.
MOST_ITERATIONS, MOST_OF_A_START, SIZED_ITERATIONS, FEWEST_ITERATIONS = 600, 100, 4_000_000, 20
CHEAPER = 0.01  # fraction of the cost: smaller differences may be due to the mesh or the steps
ENDED_BY_THE_USER = (Outcome.INTERRUPTED, Outcome.TIME_LIMIT)


@dataclass(frozen=True, eq=False)
class Starts:
    """Motions of different costs that are cheaper than a plan, as initial guesses, the cheapest first.

    `starts` and `iterations` count the effort. `ended` tells whether a signal or the time limit ended the search.
    """

    cheaper: tuple[Solution, ...]
    starts: int
    iterations: int
    ended: bool

    def __str__(self) -> str:
        tried = f"{self.starts} random first guesses in {self.iterations} iterations"
        costs = ", ".join(f"{_cost(motion):.4g}" for motion in self.cheaper)
        result = f"{tried} led to {f'cheaper motions, at cost {costs}' if costs else 'no cheaper motion'}"
        return f"{result}, before the user or the time limit ended the search" if self.ended else result


def search_cheaper(plan: Solution, scheme: str, seed: int, limits: Callable[[], Limits], report: Report) -> Starts:
    """Search by collocation in `scheme` from random guesses by `seed` for motions that cost less than a plan.

    The cost of a plan in steps is that of the collocation from it, as the errors of steps can exceed 1 % of a cost. The
    number of starts depends on iterations alone, so that the same seed gives the same result on all machines.
    """
    problem = plan.problem
    most = min(MOST_ITERATIONS, SIZED_ITERATIONS // (problem.num_steps * (problem.nx + problem.nu) ** 2))
    if most < FEWEST_ITERATIONS:
        return Starts((), 0, 0, False)
    transcription = Transcription(problem, scheme)
    motions: list[Solution] = []
    used, number, alike, ended = 0, 0, True, False

    def search(xs: Array, us: Array, horizon: float | None) -> Transcribed:
        few = replace(limits(), max_iterations=min(MOST_OF_A_START, most - used, limits().max_iterations))
        return transcription.solve([transcription.begin(0, (xs, us), horizon=horizon)], limits=few, report=None)

    with noted_interrupts() as interrupted:  # the plan is returned whatever ends the search
        if plan.transcribed is None:
            motion = search(plan.xs, np.vstack([plan.us, plan.us[-1:]]), None)
            used = len(motion.result.iterations)
            plan = _solution(problem, scheme, motion, "the plan") if motion.result.outcome in FOUND else plan
        first = _cost(plan)
        scale = max(abs(first), problem.least_cost(plan.xs[0], plan.time_step))
        while number < MOST_STARTS and used < most and not (number >= FEWEST_STARTS and alike) and not ended:
            number += 1
            xs, us, *horizon = another_guess(problem, seed, number)
            motion = search(xs, us, horizon[0] if horizon else None)
            used += len(motion.result.iterations)
            if motion.result.outcome in FOUND:
                motions.append(_solution(problem, scheme, motion, f"random {number} of seed {seed}"))
                report.say(f"random first guess {number}: cost {_cost(motions[-1]):.6g}")
            alike = alike and motion.result.outcome in FOUND and abs(_cost(motions[-1]) - first) <= CHEAPER * scale
            ended = motion.result.outcome in ENDED_BY_THE_USER or interrupted.is_set()
    cheaper: list[Solution] = []
    for candidate in sorted(motions, key=_cost):  # a plan of each cost
        last = _cost(cheaper[-1]) if cheaper else -np.inf
        if last + CHEAPER * scale < _cost(candidate) < first - CHEAPER * scale:
            cheaper.append(candidate)
    return Starts(tuple(cheaper), number, used, ended)


def _solution(problem: Problem, scheme: str, motion: Transcribed, name: str) -> Solution:
    """Return a motion for `problem` as a solution that is not verified."""
    phase = motion.phases[0]
    fields = {"scheme": scheme, "multipliers": motion.result.multipliers, **arrays_of(phase)}
    return Solution(problem, "collocation", "ipopt", Status.FAILED, name, phase.xs, phase.us[:-1], **fields)


def _cost(plan: Solution) -> float:
    """Return the cost by the scheme's quadrature, which the search minimizes, or in the model's own steps."""
    return plan.cost if plan.transcribed is None else plan.transcribed.quadrature

"""Minimize through contact, with the knots at which bodies begin to touch held where the search stalls at one.

Drake makes a contact only where two bodies overlap at the start of a step, so the step jumps where they just touch, and
the least cost often lies at a jump: there no gradient tells a minimum. Between the jumps, with every beginning of a
touch held at its knot by rows phi >= m before it and phi <= -m at it, phi the signed distance and m a margin, the
problem is smooth. A minimum that presses against such a row is compared with that of the sequence beyond the row, the
touch beginning a knot earlier or later, and the search goes on there where that is cheaper.
"""

import threading
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractValue

from drake_diff.arrays import Array
from drake_diff.autodiff import chain
from drake_diff.constraint import Constraint
from drake_diff.exceptions import GradientError, ModelError, SimulationError
from drake_diff.ilqr import solve_ilqr
from drake_diff.model import Model
from drake_diff.nonlinear_program import Iteration, Limits, NlpResult, Outcome, Report, interrupt_flag
from drake_diff.problem import Problem
from drake_diff.soft_contact import Separation, separations
from drake_diff.step import set_state

MARGIN = 1e-5  # [m] that a held pair keeps from just touching: differences of 1e-6 then see no jump
PRESSING = 1.01  # margins: nearer than that to just touching, a row is what holds the motion
PATIENCE, MORE_PATIENCE = 3, 10  # short steps in a row are a stall; and where nothing new can be held
HOLDING = 1e6  # the least penalty of held rows: a search that may cross them sees the jump again
BEYOND_ITERATIONS = 50  # for the minimum beyond a row, which the note then says was not found
MOST_SEQUENCES = 30  # that are tried: beyond them the result claims its own sequence alone

Found = tuple[NlpResult, Array, Array]  # as from `solve_ilqr`


@dataclass(frozen=True)
class Hold:
    """A pair of bodies, numbered as in `separations`, that is `apart` at `knot`, or overlaps there."""

    pair: int
    names: tuple[str, str]
    knot: int
    apart: bool

    def constraint(self, model: Model) -> Constraint:
        distance = _Distance(model, self.pair)
        sides = {"lower": MARGIN} if self.apart else {"upper": -MARGIN}
        return Constraint(distance, knots=[self.knot], name=str(self), **sides)

    def moved_beyond(self, model: Model, x: Array) -> Array:
        """`x` (nx,) with the pair a margin beyond just touching, by the least motion."""
        separation = _separation(model, x, self.pair)
        wanted = -MARGIN if self.apart else MARGIN
        x = np.array(x)
        x[: model.nq] += (wanted - separation.distance) * separation.opening
        return x

    def __str__(self) -> str:
        return f"{' and '.join(self.names)} {'apart' if self.apart else 'touching'} at knot {self.knot}"


class _Distance:
    """The signed distance [m] of a pair as a function of x, floats or AutoDiffXd."""

    def __init__(self, model: Model, pair: int):
        self.model, self.pair = model, pair

    def __call__(self, x: Any) -> Any:
        if x.dtype == float:
            return _separation(self.model, x, self.pair).distance
        found = _separation(self.model, ExtractValue(x.reshape(-1, 1)).ravel(), self.pair)
        return chain(found.distance, np.pad(found.gradient, (0, self.model.nv)), x)


def _separation(model: Model, x: Array, pair: int) -> Separation:
    set_state(model.double, x)
    return separations(model.double)[pair]


def beginnings(problem: Problem, xs: Array) -> tuple[Hold, ...]:
    """Two holds for each beginning of a touch along xs (N+1, nx): apart at the knot before it, touching at its own.

    What nothing moves (the given first state) or acts on (the last) is left out.
    """
    distances = []
    for x in xs[:-1]:
        set_state(problem.model.double, x)
        distances.append([s.distance for s in separations(problem.model.double)])
    phi, names = np.array(distances), [s.bodies for s in separations(problem.model.double)]
    found = list[Hold]()
    for before, pair in np.argwhere((phi[:-1] >= 0) & (phi[1:] < 0)):
        knots = ((int(before), True), (int(before) + 1, False))
        found += [
            Hold(int(pair), names[pair], k, apart) for k, apart in knots if k or not problem.initial_state_is_given
        ]
    return tuple(found)


def solve_through_jumps(
    problem: Problem, xs: Array, us: Array, *, limits: Limits, report: Report | None
) -> tuple[NlpResult, Array, Array]:
    """What `solve_ilqr` gives, from a search that holds beginnings of touches where it stalls at one.

    Where they press, the result's note says which, and what the sequences beyond them cost. `limits` are those of all
    sequences together. Raises as `solve_ilqr` does.
    """
    search = _Sequences(problem, limits, report)
    with interrupt_flag() as interrupted:
        result, xs, us = search.run(xs, us, interrupted)
    return replace(result, z=us.ravel(), iterations=tuple(search.rows)), xs, us


class _Sequences:
    def __init__(self, problem: Problem, limits: Limits, report: Report | None):
        self.problem, self.limits, self.report = problem, limits, report
        self.start, self.rows = time.monotonic(), list[Iteration]()
        self.costs = dict[tuple[Hold, ...], float]()  # of each sequence's minimum; infinite where none was found
        self.ended = False  # by Ctrl-C or the clock

    def run(self, xs: Array, us: Array, interrupted: threading.Event) -> Found:
        """Let the search go free until it stalls, then from sequence to cheaper sequence."""
        found, holds, stuck = self._minimize(xs, us, (), PATIENCE), tuple[Hold, ...](), False
        while found[0].outcome is Outcome.INACCURATE and not stuck and len(self.costs) < MOST_SEQUENCES:
            try:
                ahead = beginnings(self.problem, found[1])
            except ModelError as error:  # Drake knows no distance of some pair
                ahead = ()
                self._say(f"nothing can be held: {error}")
            stuck, holds = ahead == holds, ahead
            found = self._minimize(*found[1:], holds, MORE_PATIENCE if stuck else PATIENCE)
        if found[0].outcome is Outcome.SOLVED and holds:
            return self._improve(found, interrupted)
        return found

    def _improve(self, best: Found, interrupted: threading.Event) -> Found:
        """Cross what holds the motion while that is cheaper."""
        told, left = list[str](), self._pressing(best[1])
        while left and len(self.costs) < MOST_SEQUENCES and not self._is_over(interrupted):
            hold = left.pop()
            cost = self.problem.objective(*best[1:])
            other = self._beyond(hold, *best[1:])
            if self.ended:
                left.append(hold)
                break
            new = self.problem.objective(*other[1:]) if isinstance(other, tuple) else other
            if isinstance(other, tuple) and new < cost:
                best, told, left = other, [], self._pressing(other[1])
            else:
                told.append(f"{hold} (beyond: {f'cost {new:.6g}' if np.isfinite(new) else 'no minimum found'})")
        told += [f"{hold} (beyond: not tried)" for hold in left]
        if not told:
            return best
        cost = self.problem.objective(*best[1:])
        note = f"a minimum for its own sequence of contacts, cost {cost:.6g}, held by " + "; ".join(told)
        return replace(best[0], note=note), *best[1:]

    def _beyond(self, hold: Hold, xs: Array, us: Array) -> "Found | float":
        """The minimum of the sequence beyond `hold`; its cost alone where it is known, infinite where there is none."""
        beyond = np.array(xs)
        beyond[hold.knot] = hold.moved_beyond(self.problem.model, xs[hold.knot])
        holds = beginnings(self.problem, beyond)
        if holds in self.costs:
            return self.costs[holds]
        try:
            other = self._minimize(beyond, us, holds, PATIENCE, BEYOND_ITERATIONS)
        except (GradientError, SimulationError) as error:
            self._say(f"refused: {error}")
            self.costs[holds] = np.inf
        return other if np.isfinite(self.costs[holds]) else np.inf

    def _pressing(self, xs: Array) -> list[Hold]:
        """The beginnings of touches along xs that are as near to just touching as rows let them."""
        holds = beginnings(self.problem, xs)
        distances = [_separation(self.problem.model, xs[h.knot], h.pair).distance for h in holds]
        return [h for h, d in zip(holds, distances, strict=True) if abs(d) < PRESSING * MARGIN]

    def _is_over(self, interrupted: threading.Event) -> bool:
        over = time.monotonic() - self.start > self.limits.time_limit or len(self.rows) > self.limits.max_iterations
        return over or interrupted.is_set()

    def _minimize(self, xs: Array, us: Array, holds: tuple[Hold, ...], patience: int, most: float = np.inf) -> Found:
        """One search under `holds`, of `most` iterations, within what is left of the limits."""
        left = self.limits.time_limit - (time.monotonic() - self.start)
        more = int(min(most, max(self.limits.max_iterations - max(len(self.rows) - 1, 0), 1)))
        limits = replace(self.limits, time_limit=left, max_iterations=more)
        rows = [hold.constraint(self.problem.model) for hold in holds]
        held = replace(self.problem, constraints=(*self.problem.constraints, *rows))
        if holds:
            self._say("held: " + "; ".join(map(str, holds)))
        penalty = HOLDING if holds else 0.0
        result, xs, us = solve_ilqr(
            held, xs, us, limits=limits, report=self.report, patience=patience, least_penalty=penalty
        )
        self.ended = result.outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT)
        first = len(self.rows) - 1 if self.rows else 0
        self.rows += [replace(r, iteration=first + r.iteration) for r in result.iterations[bool(self.rows) :]]
        self.costs[holds] = self.problem.objective(xs, us) if result.outcome is Outcome.SOLVED else np.inf
        return result, xs, us

    def _say(self, text: str) -> None:
        if self.report:
            self.report.say(text)

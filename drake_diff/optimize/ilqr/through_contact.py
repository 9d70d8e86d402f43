"""Trajectory optimization through contact by iLQR on the true plant, whose step jumps.

It jumps where two bodies just touch, and the least cost often lies at such a jump, where no gradient tells a minimum.
So `solve_through_jumps` holds every beginning of a touch at its knot, by rows phi >= m before it and phi <= -m at it,
phi being the signed distance and m a margin: under these the problem is smooth. What comes out is a minimum for its own
sequence of contacts.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractValue

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import chain
from drake_diff._base.clock import now
from drake_diff.exceptions import ModelError
from drake_diff.model.contact import Separation, distances, separations
from drake_diff.model.model import Model
from drake_diff.model.step import set_state
from drake_diff.optimize.ilqr.ilqr import solve_ilqr
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iteration, Limits, NlpResult, Outcome, Report

MARGIN = 1e-5  # [m] that a held pair keeps from just touching: differences of 1e-6 then see no jump
PRESSING = 1.01  # margins: nearer than that to just touching, a row is what holds the motion
PATIENCE, MORE_PATIENCE = 3, 10  # short steps in a row are a stall; and where nothing new can be held
HOLDING = 1e6  # the least penalty of held rows: a search that may cross them sees the jump again
MOST_SEQUENCES = 30  # that are tried
JUST_TOUCHING = 2e-5  # [m], beyond MARGIN; what rests on something presses further into it

OF_SHAPES = ("offset", "radius")  # parameters that change where shapes are, or what they are
Minimum = tuple[NlpResult, Array, Array]  # as from `solve_ilqr`


def cost_of(problem: Problem, result: NlpResult, xs: Array, us: Array) -> float:
    """What xs (N+1, nx) under us (N, nu) cost with the parameters of `result`."""
    design = problem.design
    values = design.vector.values if result.parameters is None else result.parameters
    cost = problem.objective(xs, us, design.time_step(values))
    return cost + problem.cost_of_parameters(design.own(values))


def where_it_jumps(problem: Problem, xs: Array) -> str:
    """Where along xs (N+1, nx) two bodies are just touching, and what that means; empty if none are."""
    for k, x in enumerate(xs[:-1]):
        set_state(problem.model.double, x)
        try:
            gaps = distances(problem.model.double)
        except ModelError as error:  # Drake knows no distance of some pair
            return f", and Drake cannot tell which bodies just touch: {error}"
        for (a, b), distance in gaps.items():
            if abs(distance) < JUST_TOUCHING:
                return (
                    f", with {a} and {b} just touching at knot {k}: the step jumps there, and a minimum at a jump "
                    "cannot be verified by a gradient"
                )
    return ""


@dataclass(frozen=True)
class ContactHold:
    """A pair of bodies, numbered as in `separations`, that is `apart` at `knot`, or overlaps there."""

    pair: int
    names: tuple[str, str]
    knot: int
    apart: bool

    def constraint(self, model: Model) -> Constraint:
        """The row that holds it: the pair's signed distance [m], of floats or AutoDiffXd, at the margin or beyond."""

        def distance(x: Any) -> Any:
            if x.dtype == float:
                return _separation(model, x, self.pair).distance
            separation = _separation(model, ExtractValue(x.reshape(-1, 1)).ravel(), self.pair)
            return chain(separation.distance, np.pad(separation.gradient, (0, model.nv)), x)

        sides = {"lower": MARGIN} if self.apart else {"upper": -MARGIN}
        return Constraint(distance, knots=[self.knot], name=str(self), **sides)

    def __str__(self) -> str:
        return f"{' and '.join(self.names)} {'apart' if self.apart else 'touching'} at knot {self.knot}"


def moves_shapes(problem: Problem) -> bool:
    """Whether parameters change where the shapes are, or what they are: no touch can be held then."""
    return any(p.kind.quantity in OF_SHAPES for p in problem.parameters.parameters)


def solve_through_jumps(
    problem: Problem, xs: Array, us: Array, *, limits: Limits, report: Report | None, values: Array | None = None
) -> Minimum:
    """What `solve_ilqr` gives, from a search that holds beginnings of touches where it stalls at one.

    Where they press, the result's note says which. `limits` are those of all sequences together. Raises as `solve_ilqr`
    does.
    """
    deadline, rows = now() + limits.time_limit, list[Iteration]()
    holds, stuck = tuple[ContactHold, ...](), False
    for _ in range(MOST_SEQUENCES):
        if holds and report:
            report.say("held: " + "; ".join(map(str, holds)))
        constraints = (*problem.constraints, *(hold.constraint(problem.model) for hold in holds))
        left = max(limits.max_iterations - max(len(rows) - 1, 0), 1)
        result, xs, us = solve_ilqr(
            replace(problem, constraints=constraints),
            xs,
            us,
            limits=replace(limits, time_limit=deadline - now(), max_iterations=left),
            report=report,
            patience=MORE_PATIENCE if stuck else PATIENCE,
            least_penalty=HOLDING if holds else 0.0,
            values=values,
        )
        first = len(rows) - 1 if rows else 0
        rows += [replace(row, iteration=first + row.iteration) for row in result.iterations[bool(rows) :]]
        if result.outcome is not Outcome.INACCURATE or stuck:
            break
        ahead = _beginnings_or_none(problem, xs, report)
        stuck, holds, values = ahead == holds, ahead, result.parameters
    pressing = [
        str(h) for h in holds if abs(_separation(problem.model, xs[h.knot], h.pair).distance) < PRESSING * MARGIN
    ]
    if result.outcome is Outcome.SOLVED and pressing:
        result = replace(result, note=f"a minimum for its own sequence of contacts, held by {'; '.join(pressing)}")
    return replace(result, iterations=tuple(rows)), xs, us


def _beginnings_or_none(problem: Problem, xs: Array, report: Report | None) -> tuple["ContactHold", ...]:
    try:
        return beginnings(problem, xs)
    except ModelError as error:  # Drake knows no distance of some pair
        if report:
            report.say(f"no contact can be kept: {error}")
        return ()


def beginnings(problem: Problem, xs: Array) -> tuple[ContactHold, ...]:
    """Two holds for each beginning of a touch along xs (N+1, nx): apart at the knot before it, touching at its own.

    The first state is left out if it is given, as nothing moves it; so is the last, on which nothing acts.
    """
    distances = []
    for x in xs[:-1]:
        set_state(problem.model.double, x)
        distances.append([s.distance for s in separations(problem.model.double)])
    phi, names = np.array(distances), [s.bodies for s in separations(problem.model.double)]
    holds = list[ContactHold]()
    for before, pair in np.argwhere((phi[:-1] >= 0) & (phi[1:] < 0)):
        for k, apart in ((int(before), True), (int(before) + 1, False)):
            if k or not problem.initial_state_is_given:
                holds.append(ContactHold(int(pair), names[pair], k, apart))
    return tuple(holds)


def _separation(model: Model, x: Array, pair: int) -> Separation:
    set_state(model.double, x)
    return separations(model.double)[pair]


def miss_of(problem: Problem, xs: Array) -> float:
    return float(np.abs(problem.goal_error(xs[-1])).max())

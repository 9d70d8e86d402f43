"""Trajectory optimization through contact by iLQR on the true plant, whose step is discontinuous.

The step jumps where the distance between two bodies is zero, and the least cost often lies at such a jump, where a
gradient cannot verify a minimum. `solve_through_jumps` therefore fixes the knot at which each contact begins, by
constraints phi >= m at the knot before it and phi <= -m at the knot itself, where phi is the signed distance and m a
margin. Under these constraints the problem is smooth. The solution is a minimum for its own sequence of contacts.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractValue

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import chain
from drake_diff._base.clock import now
from drake_diff.exceptions import ModelError
from drake_diff.model.contact import distances, pair_distances, separation_at
from drake_diff.model.model import Model
from drake_diff.model.step import set_state
from drake_diff.optimize.ilqr.ilqr import solve_ilqr
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iteration, Limits, NlpResult, Outcome, Report

MARGIN = 1e-5  # [m], distance of a constrained pair from zero distance: differences of 1e-6 then cross no jump
PRESSING = 1.01  # margins: a constraint within this distance of zero is active
PATIENCE, MORE_PATIENCE = 3, 10  # short steps in a row that count as a stall, also without new constraints
HOLDING = 1e6  # least penalty of the contact constraints: a search that may violate them meets the jump again
MOST_SEQUENCES = 30  # the number of contact sequences to try
JUST_TOUCHING = 2e-5  # [m], larger than MARGIN. A body at rest on another penetrates it more

OF_SHAPES = ("offset", "radius")  # parameters that change the pose or the size of shapes
Minimum = tuple[NlpResult, Array, Array]  # as returned by `solve_ilqr`


def cost_of(problem: Problem, result: NlpResult, xs: Array, us: Array) -> float:
    """Return the cost of xs (N+1, nx) under us (N, nu) with the parameters of `result`."""
    design = problem.design
    values = design.vector.values if result.parameters is None else result.parameters
    cost = problem.objective(xs, us, design.time_step(values))
    return cost + problem.cost_of_parameters(design.own(values))


def where_it_jumps(problem: Problem, xs: Array) -> str:
    """Describe the first knot along xs (N+1, nx) where two bodies have zero distance, or return "" if there is none."""
    for k, x in enumerate(xs[:-1]):
        set_state(problem.model.double, x)
        try:
            gaps = distances(problem.model.double)
        except ModelError as error:  # Drake cannot compute the distance of some pair
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
    """A constraint that keeps a pair of bodies, indexed as in `separations`, `apart` or overlapping at `knot`."""

    pair: int
    names: tuple[str, str]
    knot: int
    apart: bool

    def constraint(self, model: Model) -> Constraint:
        """Return the constraint on the pair's signed distance [m], of floats or AutoDiffXd, bounded by the margin."""

        def distance(x: Any) -> Any:
            if x.dtype == float:
                return separation_at(model, x, self.pair).distance
            separation = separation_at(model, ExtractValue(x.reshape(-1, 1)).ravel(), self.pair)
            return chain(separation.distance, np.pad(separation.gradient, (0, model.nv)), x)

        sides = {"lower": MARGIN} if self.apart else {"upper": -MARGIN}
        return Constraint(distance, knots=[self.knot], name=str(self), **sides)

    def __str__(self) -> str:
        return f"{' and '.join(self.names)} {'apart' if self.apart else 'touching'} at knot {self.knot}"


def moves_shapes(problem: Problem) -> bool:
    """Return whether parameters change the pose or size of shapes. Contacts cannot be fixed then."""
    return any(p.kind.quantity in OF_SHAPES for p in problem.parameters.parameters)


def solve_through_jumps(
    problem: Problem, xs: Array, us: Array, *, limits: Limits, report: Report | None, values: Array | None = None
) -> Minimum:
    """Solve with `solve_ilqr`, and fix the knots at which contacts begin if the search stalls at a jump.

    If such constraints are active at the solution, the result's note lists them. `limits` apply to all sequences
    together. Raises the errors of `solve_ilqr`.
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
        str(h) for h in holds if abs(separation_at(problem.model, xs[h.knot], h.pair).distance) < PRESSING * MARGIN
    ]
    if result.outcome is Outcome.SOLVED and pressing:
        result = replace(result, note=f"a minimum for its own sequence of contacts, held by {'; '.join(pressing)}")
    return replace(result, iterations=tuple(rows)), xs, us


def _beginnings_or_none(problem: Problem, xs: Array, report: Report | None) -> tuple["ContactHold", ...]:
    try:
        return beginnings(problem, xs)
    except ModelError as error:  # Drake cannot compute the distance of some pair
        if report:
            report.say(f"no contact can be kept: {error}")
        return ()


def beginnings(problem: Problem, xs: Array) -> tuple[ContactHold, ...]:
    """Return two constraints for each new contact along xs (N+1, nx): apart at one knot, overlapping at the next.

    A given initial state is omitted, because nothing changes it, and so is the last state, on which no force acts.
    """
    rows = []
    for x in xs[:-1]:
        set_state(problem.model.double, x)
        rows.append(pair_distances(problem.model.double))
    phi, names = np.array([[distance for _, distance in row] for row in rows]), [pair for pair, _ in rows[0]]
    holds = list[ContactHold]()
    for before, pair in np.argwhere((phi[:-1] >= 0) & (phi[1:] < 0)):
        for k, apart in ((int(before), True), (int(before) + 1, False)):
            if k or not problem.initial_state_is_given:
                holds.append(ContactHold(int(pair), names[pair], k, apart))
    return tuple(holds)


def miss_of(problem: Problem, xs: Array) -> float:
    return float(np.abs(problem.goal_error(xs[-1])).max())

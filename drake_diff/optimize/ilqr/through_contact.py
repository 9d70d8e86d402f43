"""Trajectory optimization through contact by iLQR on the true plant, whose step jumps.

It jumps where two bodies just touch, and the least cost often lies at such a jump, where no gradient tells a minimum.
So `solve_through_jumps` holds every beginning of a touch at its knot, by rows phi >= m before it and phi <= -m at it,
phi being the signed distance and m a margin: under these the problem is smooth. A minimum that presses against a row is
compared with that of the sequence beyond it, where the touch begins a knot earlier or later.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractValue

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import chain
from drake_diff._base.clock import noted_interrupts, now
from drake_diff.exceptions import GradientError, ModelError, SimulationError
from drake_diff.model.contact import Separation, distances, separations
from drake_diff.model.model import Model
from drake_diff.model.step import advance, set_state
from drake_diff.motion.rollout import roll_states
from drake_diff.optimize.ilqr.ilqr import solve_ilqr
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.design import ShootingVariables, final_sensitivity
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE, Iteration, Limits, NlpResult, Outcome, Report

MARGIN = 1e-5  # [m] that a held pair keeps from just touching: differences of 1e-6 then see no jump
PRESSING = 1.01  # margins: nearer than that to just touching, a row is what holds the motion
PATIENCE, MORE_PATIENCE = 3, 10  # short steps in a row are a stall; and where nothing new can be held
HOLDING = 1e6  # the least penalty of held rows: a search that may cross them sees the jump again
BEYOND_ITERATIONS = 50  # for the minimum beyond a row, which the note then says was not found
MOST_SEQUENCES = 30  # that are tried: beyond them the result claims its own sequence alone
MOST_STEPS, SHORTENINGS = 20, 10  # of Newton's method towards the goal
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
            return f", and where bodies just touch is not known: {error}"
        for (a, b), distance in gaps.items():
            if abs(distance) < JUST_TOUCHING:
                return (
                    f", with {a} and {b} just touching at knot {k}: the step jumps there, and a minimum at a jump "
                    "has no gradient to tell it by"
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

    def moved_beyond(self, model: Model, x: Array) -> Array:
        """`x` (nx,) with the pair a margin beyond just touching, by the least motion."""
        separation = _separation(model, x, self.pair)
        wanted = -MARGIN if self.apart else MARGIN
        x = np.array(x)
        x[: model.nq] += (wanted - separation.distance) * separation.opening
        return x

    def __str__(self) -> str:
        return f"{' and '.join(self.names)} {'apart' if self.apart else 'touching'} at knot {self.knot}"


def moves_shapes(problem: Problem) -> bool:
    """Whether parameters change where the shapes are, or what they are: no touch can be held then."""
    return any(p.kind.quantity in OF_SHAPES for p in problem.parameters.parameters)


def solve_through_jumps(
    problem: Problem, xs: Array, us: Array, *, limits: Limits, report: Report | None, values: Array | None = None
) -> Minimum:
    """What `solve_ilqr` gives, from a search that holds beginnings of touches where it stalls at one.

    Where they press, the result's note says which, and what the sequences beyond them cost. `limits` are those of all
    sequences together. Raises as `solve_ilqr` does.
    """
    search = _Sequences(problem, limits, report, values)
    with noted_interrupts() as interrupted:
        result, xs, us = search.run(xs, us, interrupted)
    return replace(result, z=us.ravel(), iterations=tuple(search.rows)), xs, us


class _Sequences:
    def __init__(self, problem: Problem, limits: Limits, report: Report | None, values: Array | None):
        self.problem, self.limits, self.report = problem, limits, report
        self.values = values  # of the problem's design, as the last search left them
        self.deadline, self.rows = now() + limits.time_limit, list[Iteration]()
        self.costs = dict[tuple[ContactHold, ...], float]()  # of each sequence's minimum; infinite if none was found
        self.ended = False  # by Ctrl-C or the clock

    def run(self, xs: Array, us: Array, interrupted: threading.Event) -> Minimum:
        """Let the search go free until it stalls, then from sequence to cheaper sequence."""
        minimum, holds, stuck = self._minimize(xs, us, (), PATIENCE), tuple[ContactHold, ...](), False
        while minimum[0].outcome is Outcome.INACCURATE and not stuck and len(self.costs) < MOST_SEQUENCES:
            try:
                ahead = beginnings(self.problem, minimum[1])
            except ModelError as error:  # Drake knows no distance of some pair
                ahead = ()
                self._say(f"nothing can be held: {error}")
            stuck, holds = ahead == holds, ahead
            minimum = self._minimize(*minimum[1:], holds, MORE_PATIENCE if stuck else PATIENCE)
        if minimum[0].outcome is Outcome.SOLVED and holds:
            return self._improve(minimum, interrupted)
        return minimum

    def _improve(self, best: Minimum, interrupted: threading.Event) -> Minimum:
        """Cross what holds the motion while that is cheaper."""
        sentences, left = list[str](), self._pressing(best[1])
        while left and len(self.costs) < MOST_SEQUENCES and not interrupted.is_set():
            if now() > self.deadline or len(self.rows) > self.limits.max_iterations:
                break
            hold, self.values = left.pop(), best[0].parameters
            cost = cost_of(self.problem, *best)
            other = self._beyond(hold, *best[1:])
            if self.ended:
                left.append(hold)
                break
            new = cost_of(self.problem, *other) if isinstance(other, tuple) else other
            if isinstance(other, tuple) and new < cost:
                best, sentences, left = other, [], self._pressing(other[1])
            else:
                sentences.append(f"{hold} (beyond: {f'cost {new:.6g}' if np.isfinite(new) else 'no minimum found'})")
        sentences += [f"{hold} (beyond: not tried)" for hold in left]
        if not sentences:
            return best
        cost = cost_of(self.problem, *best)
        note = f"a minimum for its own sequence of contacts, cost {cost:.6g}, held by " + "; ".join(sentences)
        return replace(best[0], note=note), *best[1:]

    def _beyond(self, hold: ContactHold, xs: Array, us: Array) -> Minimum | float:
        """The minimum of the sequence beyond `hold`; its cost alone if it is known, infinite if there is none."""
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

    def _pressing(self, xs: Array) -> list[ContactHold]:
        """The beginnings of touches along xs that are as near to just touching as rows let them."""
        holds = beginnings(self.problem, xs)
        distances = [_separation(self.problem.model, xs[h.knot], h.pair).distance for h in holds]
        return [h for h, d in zip(holds, distances, strict=True) if abs(d) < PRESSING * MARGIN]

    def _minimize(
        self, xs: Array, us: Array, holds: tuple[ContactHold, ...], patience: int, most: float = np.inf
    ) -> Minimum:
        """One search under `holds`, of `most` iterations, within what is left of the limits."""
        more = int(min(most, max(self.limits.max_iterations - max(len(self.rows) - 1, 0), 1)))
        limits = replace(self.limits, time_limit=self.deadline - now(), max_iterations=more)
        rows = [hold.constraint(self.problem.model) for hold in holds]
        held = replace(self.problem, constraints=(*self.problem.constraints, *rows))
        if holds:
            self._say("held: " + "; ".join(map(str, holds)))
        penalty, report = HOLDING if holds else 0.0, self.report
        options: dict[str, Any] = {"patience": patience, "least_penalty": penalty, "values": self.values}
        minimum = solve_ilqr(held, xs, us, limits=limits, report=report, **options)
        result, xs, us = minimum
        self.ended = result.outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT)
        first = len(self.rows) - 1 if self.rows else 0
        self.rows += [replace(r, iteration=first + r.iteration) for r in result.iterations[bool(self.rows) :]]
        self.values = result.parameters
        self.costs[holds] = cost_of(self.problem, result, xs, us) if result.outcome is Outcome.SOLVED else np.inf
        return minimum

    def _say(self, text: str) -> None:
        if self.report:
            self.report.say(text)


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


def restore_goal(
    problem: Problem, xs: Array, us: Array, tolerance: float, is_over: Callable[[], bool] = lambda: False
) -> tuple[Array, Array, str]:
    """(xs (N+1, nx), us (N, nu), what was done) nearer to the hard goal of `problem`; the same us if none is nearer.

    xs is a rollout of us. Each step is the least change of the inputs from the first contact on, within their
    bounds, halved until the miss is smaller and bounds of states, waypoints and constraints hold as before. It ends
    early if `is_over` says so. What comes out is near the least cost, but is not shown to be a minimum.
    """
    first, done, twin = 0, "", problem.model.double
    for k, u in enumerate(us):
        advance(twin, xs[k], u)
        if twin.touches():
            first = k
            break
    for number in range(1, MOST_STEPS + 1):
        if is_over() or miss_of(problem, xs) <= tolerance:
            break
        try:
            nearer = _newton_step(problem, xs, us, first)
        except (GradientError, SimulationError) as error:
            return xs, us, f"{done}; then a Newton step towards the goal was refused: {error}"
        if nearer is None:
            break
        xs, us = nearer
        done = f"; then {number} Newton step{'s' * (number > 1)} on the inputs from knot {first} on, towards the goal"
    return xs, us, done


def _newton_step(problem: Problem, xs: Array, us: Array, first: int) -> tuple[Array, Array] | None:
    variables, bounds, wanted = ShootingVariables(problem), problem.bounds, ~np.isnan(problem.goal)
    last = final_sensitivity(variables, variables.pack(xs[0], us))[wanted]
    by_inputs = last[:, len(variables.free) :].reshape(len(last), *us.shape)[:, first:].reshape(len(last), -1)
    error = problem.goal_error(xs[-1])[wanted]
    allowed = max(_excess(problem, xs, us), FEASIBILITY_TOLERANCE)
    change = np.zeros_like(us)
    change[first:] = -np.linalg.lstsq(by_inputs, error)[0].reshape(-1, us.shape[1])
    for size in 0.5 ** np.arange(SHORTENINGS):
        moved = np.clip(us + size * change, bounds.u_lower, bounds.u_upper)
        rolled = roll_states(problem.model, xs[0], moved)
        nearer = np.linalg.norm(problem.goal_error(rolled[-1])) < np.linalg.norm(error)
        if nearer and _excess(problem, rolled, moved) <= allowed:
            return rolled, moved
    return None


def _excess(problem: Problem, xs: Array, us: Array) -> float:
    """By how much anything but the goal and the inputs is out of its bounds."""
    bounds = problem.bounds
    beyond = float(np.max(np.maximum(bounds.x_lower - xs, xs - bounds.x_upper)[1:], initial=0.0))
    return max(beyond, *(excess for excess, _ in problem.constraint_excess(xs, us).values()), 0.0)


def miss_of(problem: Problem, xs: Array) -> float:
    return float(np.abs(problem.goal_error(xs[-1])).max())

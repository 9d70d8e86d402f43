"""Take a motion that stopped short of its goal to it, by Newton steps on the inputs from the first contact on.

A search through contact is held up where a contact begins exactly at a knot: the step jumps there, and the least
effort would cross the jump. The inputs after it do not move it. What comes reaches the goal, near the least cost, but
is not shown to be a minimum.
"""

from collections.abc import Callable

import numpy as np

from drake_diff.arrays import Array
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.nonlinear_program import FEASIBILITY_TOLERANCE
from drake_diff.problem import Problem
from drake_diff.rollout import roll_states
from drake_diff.shooting import ShootingVariables, state_sensitivities
from drake_diff.step import advance

MOST_STEPS, SHORTENINGS = 20, 10


def restore_goal(
    problem: Problem, xs: Array, us: Array, tolerance: float, is_over: Callable[[], bool] = lambda: False
) -> tuple[Array, Array, str]:
    """(xs (N+1, nx), us (N, nu), what was done) nearer to the hard goal of `problem`; the same us where none is nearer.

    xs is a rollout of us. Each step is the least change of the inputs from the first contact on, within their
    bounds, halved until the miss is smaller and bounds of states, waypoints and constraints hold as before. It ends
    early where `is_over` says so.
    """
    first, done = _first_contact(problem, xs, us), ""
    for number in range(1, MOST_STEPS + 1):
        if is_over() or _miss(problem, xs) <= tolerance:
            break
        try:
            nearer = _step(problem, xs, us, first)
        except (GradientError, SimulationError) as error:
            return xs, us, f"{done}; then a Newton step towards the goal was refused: {error}"
        if nearer is None:
            break
        xs, us = nearer
        done = f"; then {number} Newton step{'s' * (number > 1)} on the inputs from knot {first} on, towards the goal"
    return xs, us, done


def _step(problem: Problem, xs: Array, us: Array, first: int) -> tuple[Array, Array] | None:
    variables, bounds, wanted = ShootingVariables(problem), problem.bounds, ~np.isnan(problem.goal)
    last = state_sensitivities(variables, variables.pack(xs[0], us))[-1][wanted]
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


def _miss(problem: Problem, xs: Array) -> float:
    return float(np.abs(problem.goal_error(xs[-1])).max())


def _first_contact(problem: Problem, xs: Array, us: Array) -> int:
    """The first step in which anything touches; 0 where nothing does."""
    twin = problem.model.double
    for k, u in enumerate(us):
        advance(twin, xs[k], u)
        if twin.touches():
            return k
    return 0

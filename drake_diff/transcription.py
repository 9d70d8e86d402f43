"""Optimal control of x' = f(x, u) by collocation: fixed or free final time, bounds, and a mesh that is refined.

    minimize    int_0^T L(x, u) dt + F(x(T)),    x' = f(x, u),    x(0) = x0, x(T) = x_goal where they are given.

`errors` of a result say that its motion is what the dynamics do, not that no better one exists: where the mesh is
too coarse for the best input, only a finer one tells.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from drake_diff.arrays import Array, array_with_gaps, finite_array, frozen, positive_float, positive_int
from drake_diff.bounds import Bounds
from drake_diff.constraint import Constraint
from drake_diff.cost import FinalCost, QuadraticCost
from drake_diff.dynamics import Dynamics, Pointwise
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.nonlinear_program import Limits, Outcome
from drake_diff.optimal_control import OptimalControl, PathConstraint, RunningRate
from drake_diff.transcribed import Transcribed
from drake_diff.transcription_scheme import SCHEMES, node_fractions

DEFAULT_LIMITS = Limits(max_iterations=3000, time_limit=np.inf, tolerance=1e-9)
MOST_PIECES = 4  # of one interval in one round of refinement
FOUND = (Outcome.SOLVED, Outcome.INACCURATE)


def transcribe_and_solve(
    dynamics: Dynamics,
    *,
    x0: Any,
    x_goal: Any = None,
    count: int,
    horizon: Any,
    running_cost: Any = None,
    final_cost: FinalCost | None = None,
    bounds: Bounds | None = None,
    constraints: Any = (),
    waypoints: Mapping[int, Any] | None = None,
    scheme: str = "hermite_simpson",
    guess: Any = None,
    limits: Limits = DEFAULT_LIMITS,
    report: Callable[[str], None] | None = None,
    refine: bool = False,
    error_tolerance: float = 1e-6,
    max_count: int = 1000,
) -> Transcribed:
    """Minimize the integral of `running_cost` plus `final_cost` on `count` equal intervals of `horizon` [s].

    `x0` and `x_goal` (nx,) are free where NaN. `horizon` is a number, or (lower, upper) for a free final time.
    `running_cost` is a function (x, u) -> scalar, a QuadraticCost, or a number [per s] (1.0: minimum time);
    `final_cost` a function of x. `bounds` go before the dynamics' own and hold at every node; between nodes see
    `violation_between_nodes`. `scheme` is "hermite_simpson" (order 4) or "trapezoid" (order 2). `guess` is (xs, us) or
    (xs, us, horizon) with shapes (count+1, nx), (count+1, nu), or a `Transcribed`; else a straight line at zero input.

    `constraints` are `Constraint`s, kept at their knots, where those are None at the midpoints too, and one of u also
    at knot `count`. `waypoints` maps knots 1 ... count-1 to states (nx,), NaN where free. Knots are those of the first
    mesh, whose places the refined ones keep.

    The solver is the IPOPT that CasADi carries: with exact Hessians where everything can be written as an expression,
    else with a limited-memory one; `derivatives` of the result says which and why.

    `refine` splits intervals whose `errors` or `cost_errors` are above `error_tolerance` and solves again from there,
    up to `max_count` intervals; `limits` hold for each round.

    Raises InputError and its kin before anything runs; how a solve ended is `outcome` and `message`.
    """
    mesh = np.linspace(0, 1, positive_int("count", count) + 1)
    task = _check_task(dynamics, x0, x_goal, horizon, running_cost, final_cost, bounds, scheme)
    task = dataclasses.replace(
        task, waypoints=_check_waypoints(task, mesh, waypoints), paths=_check_constraints(task, mesh, constraints)
    )
    error_tolerance = positive_float("error_tolerance", error_tolerance)
    max_count = positive_int("max_count", max_count)
    nodes, time = _first_nodes(task, mesh, guess)
    from drake_diff.knot_functions import knot_functions  # CasADi takes a while to load

    functions = knot_functions(task)
    motion = _solve(task, mesh, functions, nodes, time, limits, report)
    rounds = [(len(mesh) - 1, float(np.max(_worst(motion))))] if refine else []
    while rounds and motion.outcome in FOUND and rounds[-1][1] > error_tolerance:
        mesh = _split(motion, error_tolerance)
        if len(mesh) - 1 > max_count:
            told = f"; the error is still {rounds[-1][1]:.2g} with {rounds[-1][0]} intervals: raise max_count"
            motion = dataclasses.replace(motion, message=motion.message + told)
            break
        nodes = np.hstack(motion.at(motion.horizon * node_fractions(mesh, task.scheme)))
        motion = _solve(task, mesh, functions, nodes, motion.horizon, limits, report)
        rounds.append((len(mesh) - 1, float(np.max(_worst(motion)))))
    return dataclasses.replace(motion, refinements=tuple(rounds))


def _solve(
    task: OptimalControl, mesh: Array, functions: Any, nodes: Array, time: float, limits: Limits, report: Any
) -> Transcribed:
    from drake_diff.ipopt import NOT_FINITE, solve_ipopt
    from drake_diff.transcription_program import TranscribedProgram

    program = TranscribedProgram(task, mesh, functions)
    guess, why = program.pack(nodes, time), functions.why_not
    told = f"first derivatives, limited-memory Hessian: {why}" if why else "symbolic, exact Hessian"
    result = solve_ipopt(program, guess, limits, report, exact=not why)
    if not why and result.message == NOT_FINITE:
        again = solve_ipopt(program, guess, limits, report, exact=False)
        if again.message != NOT_FINITE:  # then it was the Hessian
            told, result = "symbolic, limited-memory Hessian: the exact one is not finite at an iterate", again
    found, horizon = program.unpack(result.z)
    found = frozen(found)
    return Transcribed(task, frozen(mesh), found, horizon, result.outcome, result.message, result.iterations, told)


def _worst(motion: Transcribed) -> Array:
    return np.maximum(motion.errors, motion.cost_errors)


def _split(motion: Transcribed, tolerance: float) -> Array:
    """The mesh with intervals above the tolerance in as many pieces as the scheme's order asks for, at most 4."""
    errors = _worst(motion)
    wanted = (errors / tolerance) ** (1 / (motion.task.scheme.order + 1))
    pieces = np.where(errors > tolerance, np.clip(np.ceil(wanted), 2, MOST_PIECES), 1).astype(int)
    ends = zip(motion.mesh[:-1], motion.mesh[1:], pieces, strict=True)
    return np.append(np.concatenate([a + (b - a) * np.arange(n) / n for a, b, n in ends]), 1.0)


def _check_task(
    dynamics: Dynamics, x0: Any, x_goal: Any, horizon: Any, running: Any, final: Any, bounds: Any, scheme: str
) -> OptimalControl:
    if not isinstance(dynamics, Dynamics):
        raise InputError("dynamics", got=type(dynamics).__name__, expected="Dynamics or plant_dynamics(model)")
    if scheme not in SCHEMES:
        raise UnknownNameError("scheme", got=scheme, known=SCHEMES)
    if not (bounds is None or isinstance(bounds, Bounds)):
        raise InputError("bounds", got=type(bounds).__name__, expected="Bounds")
    if isinstance(final, QuadraticCost):
        final.check_sizes("final_cost", dynamics.nx, dynamics.nu)
    elif final is not None:
        Pointwise("final_cost", lambda x, u: final(x), dynamics.nx, (), dynamics.probe())  # raises where it is none
    limits = dynamics.limits(bounds)
    free = np.full(dynamics.nx, np.nan)
    start = _check_end(dynamics, "x0", x0, None)
    goal = free if x_goal is None else _check_end(dynamics, "x_goal", x_goal, limits)
    if running is None and final is None and np.all(np.isnan(goal)):
        raise InputError("problem", got="no cost and no goal", expected="a cost, an x_goal, or both")
    rate = RunningRate(running, dynamics)
    return OptimalControl(dynamics, start, goal, _check_horizon(horizon), rate, final, limits, SCHEMES[scheme])


def _check_end(dynamics: Dynamics, subject: str, values: Any, limits: Bounds | None) -> Array:
    end = array_with_gaps(subject, values, (dynamics.nx,))
    if np.any(np.isinf(end)):
        raise InputError(subject, got=end, expected="finite numbers, NaN where free")
    if limits is not None:
        for i in np.flatnonzero((end < limits.x_lower) | (end > limits.x_upper))[:1]:
            expected = f"within [{limits.x_lower[i]:g}, {limits.x_upper[i]:g}]"
            raise InputError(f"{subject}, {dynamics.state_names[i]}", got=float(end[i]), expected=expected)
    return end


def _check_waypoints(
    task: OptimalControl, mesh: Array, given: Mapping[int, Any] | None
) -> tuple[tuple[float, Array], ...]:
    """The waypoints by their fraction of the horizon."""
    found, last = [], len(mesh) - 1
    for knot, wanted in (given or {}).items():
        if isinstance(knot, bool) or not isinstance(knot, (int, np.integer)) or not 0 < knot < last:
            expected = f"whole numbers from 1 to {last - 1} (the last state's is x_goal)"
            raise InputError("knots of waypoints", got=repr(knot), expected=expected)
        found.append((float(mesh[knot]), _check_end(task.dynamics, f"waypoint at knot {knot}", wanted, task.bounds)))
    return tuple(sorted(found, key=lambda at: at[0]))


def _check_constraints(task: OptimalControl, mesh: Array, given: Any) -> tuple[PathConstraint, ...]:
    constraints = given if isinstance(given, (tuple, list)) else (given,)
    first_is_given, found = bool(np.all(np.isfinite(task.x0))), []
    x, u = np.split(task.dynamics.probe()[0], [task.dynamics.nx])
    for c in constraints:
        if not isinstance(c, Constraint):
            raise InputError("constraints", got=type(c).__name__, expected="Constraints")
        knots = c.at_knots(len(mesh) - 1 + int(c.takes_input), first_is_given)
        fractions = None if c.knots is None else mesh[list(knots)]
        found.append(PathConstraint(c.resolved(x, u), fractions, knots[0]))
    return tuple(found)


def _check_horizon(horizon: Any) -> tuple[float, float]:
    if not isinstance(horizon, (tuple, list)):
        horizon = (horizon, horizon)
    if len(horizon) != 2:
        raise InputError("horizon", got=repr(horizon), expected="a number of seconds, or (lower, upper)")
    lower, upper = (positive_float("horizon [s]", value) for value in horizon)
    if lower > upper:
        raise InputError("horizon", got=repr(horizon), expected="lower at most upper")
    return lower, upper


def _first_nodes(task: OptimalControl, mesh: Array, guess: Any) -> tuple[Array, float]:
    """Nodes (K, nx + nu) within the input's bounds, and a horizon, from a guess at the knots."""
    f, where = task.dynamics, node_fractions(mesh, task.scheme)
    if isinstance(guess, Transcribed):
        xs, us = guess.at(guess.horizon * where)
        return np.hstack([xs, us]), float(np.clip(guess.horizon, *task.horizon))
    time = sum(task.horizon) / 2
    if guess is None:
        start = np.where(np.isnan(task.x0), np.where(np.isnan(task.x_goal), 0.0, task.x_goal), task.x0)
        end = np.where(np.isnan(task.x_goal), start, task.x_goal)
        knots = np.hstack([start + mesh[:, None] * (end - start), np.zeros((len(mesh), f.nu))])
    else:
        if not (isinstance(guess, (tuple, list)) and len(guess) in (2, 3)):
            raise InputError("guess", got=type(guess).__name__, expected="(xs, us), (xs, us, horizon) or a Transcribed")
        xs = finite_array("guess xs", guess[0], (len(mesh), f.nx))
        knots = np.hstack([xs, finite_array("guess us", guess[1], (len(mesh), f.nu))])
        time = float(np.clip(positive_float("guess horizon [s]", guess[2]), *task.horizon)) if guess[2:] else time
    nodes = np.array([np.interp(where, mesh, column) for column in knots.T]).T
    nodes[:, f.nx :] = np.clip(nodes[:, f.nx :], task.bounds.u_lower, task.bounds.u_upper)
    return nodes, time

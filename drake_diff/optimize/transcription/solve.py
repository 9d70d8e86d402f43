"""Optimal control of x' = f(x, u) by collocation: fixed or free final time, bounds, and a mesh that is refined.

    minimize    int_0^T L(x, u) dt + F(x(T)),    x' = f(x, u),    x(0) = x0, x(T) = x_goal where they are given.

`errors` of a result say that its motion is what the dynamics do, not that no better one exists: where the mesh is
too coarse for the best input, only a finer one tells.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float, positive_int
from drake_diff.exceptions import InputError
from drake_diff.optimize.problem.cost import FinalCost
from drake_diff.optimize.problem.dynamics import Dynamics
from drake_diff.optimize.problem.problem import Bounds, Problem
from drake_diff.optimize.program import Limits, Outcome, Report
from drake_diff.optimize.transcription.motion import Transcribed
from drake_diff.optimize.transcription.scheme import node_fractions
from drake_diff.optimize.transcription.task import OptimalControl, checked_task, task_of

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
    task = checked_task(
        dynamics,
        mesh,
        x0=x0,
        x_goal=x_goal,
        waypoints=waypoints,
        horizon=horizon,
        running_cost=running_cost,
        final_cost=final_cost,
        bounds=bounds,
        constraints=constraints,
        scheme=scheme,
    )
    error_tolerance = positive_float("error_tolerance", error_tolerance)
    max_count = positive_int("max_count", max_count)
    nodes, time = first_nodes(task, mesh, guess)
    functions, lines = knot_functions_of(task), Report(report)
    motion = solve_on_mesh(task, mesh, functions, nodes, time, limits, lines)
    rounds = [(len(mesh) - 1, float(np.max(_worst(motion))))] if refine else []
    while rounds and motion.outcome in FOUND and rounds[-1][1] > error_tolerance:
        mesh = _split(motion, error_tolerance)
        if len(mesh) - 1 > max_count:
            told = f"; the error is still {rounds[-1][1]:.2g} with {rounds[-1][0]} intervals: raise max_count"
            motion = dataclasses.replace(motion, message=motion.message + told)
            break
        nodes = np.hstack(motion.at(motion.horizon * node_fractions(mesh, task.scheme)))
        motion = solve_on_mesh(task, mesh, functions, nodes, motion.horizon, limits, lines)
        rounds.append((len(mesh) - 1, float(np.max(_worst(motion)))))
    return dataclasses.replace(motion, refinements=tuple(rounds))


class ProblemTranscription:
    """A `Problem` in a scheme, on its own `num_steps` equal intervals."""

    def __init__(self, problem: Problem, scheme: str):
        self.task, self.mesh = task_of(problem, scheme), np.linspace(0, 1, problem.num_steps + 1)
        self.functions = knot_functions_of(self.task)
        self.horizon = float(np.clip(problem.num_steps * problem.model.time_step, *self.task.horizon))

    def jacobian(self, knot: Array) -> Array:
        """(nx, nx + nu) of the rates at `knot` (nx + nu,), as the solver gets it."""
        return np.asarray(self.functions.dynamics.jacobian_of(knot))

    def solve(self, xs: Array, us: Array, *, limits: Limits, report: Report | None) -> Transcribed:
        """From the guess xs (N+1, nx), us (N+1, nu)."""
        nodes, _ = first_nodes(self.task, self.mesh, (xs, us))
        return solve_on_mesh(self.task, self.mesh, self.functions, nodes, self.horizon, limits, report)


def knot_functions_of(task: OptimalControl) -> Any:
    """The task's functions as CasADi's, which is loaded when it is first needed."""
    from drake_diff.optimize.transcription.expressions import knot_functions

    return knot_functions(task)


def solve_on_mesh(
    task: OptimalControl, mesh: Array, functions: Any, nodes: Array, time: float, limits: Limits, report: Report | None
) -> Transcribed:
    from drake_diff.optimize.transcription.ipopt import NOT_FINITE, solve_ipopt
    from drake_diff.optimize.transcription.program import TranscribedProgram

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


def first_nodes(task: OptimalControl, mesh: Array, guess: Any) -> tuple[Array, float]:
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

"""Optimal control of x' = f(x, u) by collocation: fixed or free final time, bounds, and a mesh that is refined.

    minimize    int_0^T L(x, u) dt + F(x(T)),    x' = f(x, u),    x(0) = x0, x(T) = x_goal where they are given.

`errors` of a result say that its motion is what the dynamics do, not that no better one exists: where the mesh is
too coarse for the best input, only a finer one tells.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from drake_diff.arrays import Array, array_with_gaps, finite_array, frozen, positive_float, positive_int
from drake_diff.bounds import Bounds
from drake_diff.cost import FinalCost, QuadraticCost
from drake_diff.dynamics import Dynamics, Pointwise, plant_dynamics
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.nonlinear_program import Limits, Outcome, solve_program
from drake_diff.problem import Problem
from drake_diff.transcribed import Collocated, Transcribed
from drake_diff.transcription_program import OptimalControl, RunningRate, TranscribedProgram
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
    scheme: str = "hermite_simpson",
    guess: Any = None,
    solver: str = "ipopt",
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

    `refine` splits intervals whose `errors` or `cost_errors` are above `error_tolerance` and solves again from there,
    up to `max_count` intervals; `limits` hold for each round.

    Raises InputError and its kin before anything runs; how a solve ended is `outcome` and `message`.
    """
    task = _check_task(dynamics, x0, x_goal, horizon, running_cost, final_cost, bounds, scheme)
    mesh = np.linspace(0, 1, positive_int("count", count) + 1)
    error_tolerance = positive_float("error_tolerance", error_tolerance)
    max_count = positive_int("max_count", max_count)
    nodes, time = _first_nodes(task, mesh, guess)
    motion = _solve(task, mesh, nodes, time, solver, limits, report)
    rounds = [(len(mesh) - 1, float(np.max(_worst(motion))))] if refine else []
    while rounds and motion.outcome in FOUND and rounds[-1][1] > error_tolerance:
        mesh = _split(motion, error_tolerance)
        if len(mesh) - 1 > max_count:
            told = f"; the error is still {rounds[-1][1]:.2g} with {rounds[-1][0]} intervals: raise max_count"
            motion = dataclasses.replace(motion, message=motion.message + told)
            break
        nodes = np.hstack(motion.at(motion.horizon * node_fractions(mesh, task.scheme)))
        motion = _solve(task, mesh, nodes, motion.horizon, solver, limits, report)
        rounds.append((len(mesh) - 1, float(np.max(_worst(motion)))))
    return dataclasses.replace(motion, refinements=tuple(rounds))


def optimal_control(problem: Problem, scheme: str) -> OptimalControl:
    """What `problem` asks of a collocation scheme; ModelError where its model has no continuous form."""
    whole = problem.num_steps * problem.model.time_step
    return _check_task(
        plant_dynamics(problem.model),
        np.where(problem.initial_state_mask, np.nan, problem.x0),
        problem.goal,
        problem.horizon or whole,
        problem.running_cost,
        problem.final_cost,
        problem.bounds,
        scheme,
    )


def transcribe_problem(
    problem: Problem, scheme: str, guess: Any, *, limits: Limits, report: Callable[[str], None] | None
) -> Transcribed:
    """Solve `problem` on its own `num_steps` equal intervals from `guess`: (xs (N+1, nx), us (N+1, nu))."""
    task, mesh = optimal_control(problem, scheme), np.linspace(0, 1, problem.num_steps + 1)
    nodes, _ = _first_nodes(task, mesh, guess)
    time = float(np.clip(problem.num_steps * problem.model.time_step, *task.horizon))
    return _solve(task, mesh, nodes, time, "ipopt", limits, report)


def transcribed_from(
    problem: Problem, scheme: str, xs: Array, us: Array, us_mid: Array | None, horizon: float
) -> Collocated:
    """The motion with knots xs (N+1, nx), us (N+1, nu) and midpoint inputs (N, nu), linear in between where None."""
    task, mesh = optimal_control(problem, scheme), np.linspace(0, 1, len(xs))
    knots = np.hstack([xs, us])
    if task.scheme.nodes == 1:
        return Collocated(task, mesh, knots, horizon)
    rates, h = task.dynamics.values(knots), horizon / (len(xs) - 1)
    x_mid = (xs[:-1] + xs[1:]) / 2 + h / 8 * (rates[:-1] - rates[1:])
    u_mid = (us[:-1] + us[1:]) / 2 if us_mid is None else us_mid
    nodes = np.empty((2 * len(xs) - 1, knots.shape[1]))
    nodes[::2], nodes[1::2] = knots, np.hstack([x_mid, u_mid])
    return Collocated(task, mesh, nodes, horizon)


def _solve(
    task: OptimalControl, mesh: Array, nodes: Array, time: float, solver: str, limits: Limits, report: Any
) -> Transcribed:
    program = TranscribedProgram(task, mesh)
    result = solve_program(program.program, program.pack(nodes, time), solver=solver, limits=limits, report=report)
    found, horizon = program.unpack(result.z)
    return Transcribed(task, frozen(mesh), frozen(found), horizon, result.outcome, result.message, result.iterations)


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

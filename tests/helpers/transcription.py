"""Plain dynamics for tests of transcription, a pushed block and a pendulum, and functions that solve them."""

import types

import numpy as np

import drake_diff as dd
from drake_diff.optimize.problem.dynamics import Dynamics
from helpers.solving import solve_with


def effort(x, u):
    return u[0] ** 2


def push(x, u):
    return np.array([x[1], u[0]])


BLOCK = Dynamics(push, 2, 1)


def own_derivatives(dynamics):
    """Return the same dynamics as an object without an expression."""
    return types.SimpleNamespace(values=dynamics.values, linearize=dynamics.linearize)


def unit_inputs(most=1.0):
    return dd.Bounds(u_lower=[-most], u_upper=[most])


def heavy_pendulum(damping, **bounds):
    return Dynamics(lambda x, u: np.array([x[1], -9.81 * np.sin(x[0]) - damping * x[1] + u[0]]), 2, 1, **bounds)


OPTIONS = (
    *("scheme", "initial_guess", "tolerance", "max_iterations", "time_limit", "progress", "callback"),
    *("refine", "error_tolerance", "max_num_steps", "other_guesses"),
)


def collocate(dynamics, **asked):
    """Solve the problem of `dynamics` with the fields and options `asked`, to a tolerance of 1e-9."""
    options = {"tolerance": 1e-9, "max_iterations": 3000, "refine": False} | {
        k: asked.pop(k) for k in OPTIONS if k in asked
    }
    return solve_with(dd.Problem(dynamics, **asked), method="collocation", **options)


def solved(dynamics, **asked):
    solution = collocate(dynamics, **asked)
    assert solution.status in (dd.Status.CONVERGED, dd.Status.CONVERGED_NOT_VERIFIED), solution.message
    assert solution.defect < 1e-8
    return solution


def move(num_steps=10, dynamics=BLOCK, **changes):
    rest = {"x0": [0, 0], "x_goal": [1, 0], "horizon": 1.0, "running_cost": effort}
    return solved(dynamics, num_steps=num_steps, **rest | changes)

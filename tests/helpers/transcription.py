"""Plain dynamics that are transcribed: a block that is pushed, a pendulum, and how they are solved."""

import types

import numpy as np

import drake_diff as dd
from drake_diff.optimize.problem.dynamics import Dynamics
from drake_diff.optimize.program import Outcome
from drake_diff.optimize.transcription.solve import transcribe_and_solve


def effort(x, u):
    return u[0] ** 2


def push(x, u):
    return np.array([x[1], u[0]])


BLOCK = Dynamics(push, 2, 1)


def own_derivatives(dynamics):
    """The same dynamics as an object, of which there is no expression."""
    return types.SimpleNamespace(values=dynamics.values, linearize=dynamics.linearize)


def unit_inputs(most=1.0):
    return dd.Bounds(u_lower=[-most], u_upper=[most])


def heavy_pendulum(damping, **bounds):
    return Dynamics(lambda x, u: np.array([x[1], -9.81 * np.sin(x[0]) - damping * x[1] + u[0]]), 2, 1, **bounds)


def solved(dynamics, **options):
    motion = transcribe_and_solve(dynamics, **options)
    assert motion.outcome in (Outcome.SOLVED, Outcome.INACCURATE), motion.message
    assert motion.defect < 1e-8
    return motion


def move(count=10, dynamics=BLOCK, **changes):
    return solved(
        dynamics, count=count, **{"x0": [0, 0], "x_goal": [1, 0], "horizon": 1.0, "running_cost": effort} | changes
    )

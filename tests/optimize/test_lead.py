"""Tests of integrating the dynamics along a collocated motion, against closed forms and many small steps."""

import numpy as np
import pytest

import drake_diff as dd
from drake_diff.motion.tableaus import AT, DENSE, STAGES
from drake_diff.optimize.transcription.collocation import collocated
from drake_diff.optimize.transcription.lead import Lead

EFFORT = dd.QuadraticCost(R=[[1.0]])
ACCURATE = 1e-3  # of a state's range: an oscillation takes at most 16 * 40 steps, with an error of up to 1e-6 each


def motion_of(f, nx, xs, us, horizon):
    """Return a collocated motion whose knots need not satisfy x' = f(x, u)."""
    problem = dd.Problem(
        dd.Dynamics(f, nx=nx, nu=us.shape[1]), x0=xs[0], num_steps=len(us) - 1, horizon=horizon, running_cost=EFFORT
    )
    return collocated(problem, "hermite_simpson", xs, us, None, horizon, np.linspace(0, 1, len(us)))


def oscillator(w, count=40, horizon=4.0):
    """Return x'' = -w^2 x + u under a ramp, from rest, and its solution x = (t - sin(w t) / w) / w^2."""
    t = np.linspace(0, horizon, count + 1)
    every = np.linspace(0, horizon, 10 * count + 1)
    xs, far = (np.column_stack([(s - np.sin(w * s) / w) / w**2, (1 - np.cos(w * s)) / w**2]) for s in (t, every))
    return motion_of(lambda x, u: [x[1], u[0] - w**2 * x[0]], 2, xs, t[:, None], horizon), far


@pytest.mark.parametrize("w", [1.0, 10.0, 60.0])
def test_it_is_that_of_closed_form_however_fast(w):
    """At w = 60 / s an interval of 0.1 s is a whole period. One step would be far off, and half of all are enough."""
    motion, far = oscillator(w)
    assert np.max(np.abs(motion.led("open loop") - far) / np.ptp(motion.xs, axis=0)) < ACCURATE


def test_a_knot_that_is_no_motion_shows():
    motion, _ = oscillator(1.0)
    motion.nodes.setflags(write=True)
    motion.nodes[2 * 20 :: 2, 1] += 0.1  # the speed from the middle on
    assert np.max(np.abs(motion.led("open loop")[::10] - motion.xs) / np.ptp(motion.xs, axis=0)) > 0.04  # 0.1 of 2.1


def test_what_bends_within_one_interval_is_followed_there():
    """A spring of 1e4 / s^2 beyond x = 0.5 turns the block back. By conservation of energy it keeps its speed."""

    def f(x, u):
        return [x[1], -1e4 * (x[0] - 0.5) if x[0] > 0.5 else 0.0 * x[0]]

    xs, us = np.column_stack([np.linspace(0, 1, 11), np.ones(11)]), np.zeros((11, 1))
    led = motion_of(f, 2, xs, us, 1.0).led("open loop")
    assert abs(led[-1, 1] + 1) < 1e-3  # the error at the corners in the smallest steps
    assert abs(np.max(led[:, 0]) - 0.51) < 1e-3  # v / w


def test_feedback_is_cut_off_at_the_inputs_bounds():
    bounds = dd.Bounds(u_lower=[-1.0], u_upper=[1.0])
    problem = dd.Problem(
        dd.Dynamics(lambda x, u: [u[0]], nx=1, nu=1),
        x0=[0],
        num_steps=4,
        horizon=4.0,
        bounds=bounds,
        running_cost=EFFORT,
    )
    motion = collocated(problem, "trapezoid", np.zeros((5, 1)), np.zeros((5, 1)), None, 4.0, np.linspace(0, 1, 5))
    led = Lead(motion, 10).from_state(np.array([3.0]), np.full((4, 1, 1), 10.0))
    assert np.allclose(led[:29, 0], 3 - np.arange(29) / 10, atol=1e-9)  # at full input until 0.1


def test_what_leaves_all_numbers_is_no_number_from_there_on():
    t = np.linspace(0, 2, 21)
    motion = motion_of(lambda x, u: [x[0] ** 2], 1, np.ones((21, 1)), np.zeros((21, 1)), 2.0)  # 1 / (1 - t)
    led = motion.led("open loop")[:, 0]
    before = t[:9]
    assert np.allclose(led[:90:10], 1 / (1 - before), rtol=1e-4)
    assert np.isnan(led[-1])


def test_within_a_step_the_weights_are_those_of_a_quartic():
    """x' = t^3 has x = t^4 / 4 at every part of a step. At its end the weights are those of the fifth order."""
    slopes, t = np.array([0.0, *AT]) ** 3, np.linspace(0, 1, 11)
    powers = t[:, None] ** np.arange(1, 5)
    assert np.allclose(powers @ DENSE.T @ slopes, t**4 / 4, atol=1e-12)  # rounding
    assert np.allclose(DENSE.sum(axis=1), [*STAGES[-1], 0.0], atol=1e-14)

"""TVLQR along motions of acrobot and cart-pole equals Drake's finite-horizon regulator of the discrete plant."""

import numpy as np
import pytest
from helpers.table import each_row
from pydrake.systems.controllers import (
    FiniteHorizonLinearQuadraticRegulator,
    FiniteHorizonLinearQuadraticRegulatorOptions,
)
from pydrake.trajectories import PiecewisePolynomial

import drake_diff as dd
from drake_diff.motion import TVLQR


def gains_of_drake(model, xs, us, Q, R, Qf):
    """Compute the gains (N, nu, nx) with Drake's linearization and Drake's recursion."""
    context, options = model.plant.CreateDefaultContext(), FiniteHorizonLinearQuadraticRegulatorOptions()
    port = model.plant.get_actuation_input_port()
    port.FixValue(context, np.zeros(1))
    h, times = model.time_step, model.time_step * np.arange(len(xs))
    options.Qf, options.input_port_index = Qf, port.get_index()
    options.x0 = PiecewisePolynomial.FirstOrderHold(times, xs.T)
    starts = [0, *(times[1:-1] - h / 2), times[-1]]  # no step is at a jump
    options.u0 = PiecewisePolynomial.ZeroOrderHold(starts, np.vstack([us, us[-1:]]).T)
    K = FiniteHorizonLinearQuadraticRegulator(model.plant, context, 0.0, times[-1], Q, R, options).K
    return np.array([K.value(t) for t in K.get_times()])


@pytest.mark.solve
@each_row("file, h, push", [("cart_pole.urdf", 0.02, 5.0), ("acrobot.xml", 0.05, 3.0)])
def test_our_gains_are_drakes_on_the_discrete_plant(load, file, h, push):
    """The gains agree to 1e-9 of the largest, due to rounding in two Riccati recursions over 80 steps."""
    model, weights = load(file, time_step=h), (np.diag([1.0, 10.0, 0.1, 0.5]), np.array([[0.3]]), 5 * np.eye(4))
    us = push * np.sin(0.2 * np.arange(80))[:, None]
    xs = dd.rollout(model, [0.0, 0.4, 0.0, 0.0], us).xs
    ours, drakes = TVLQR(model, xs, us, *weights).gains, gains_of_drake(model, xs, us, *weights)
    assert drakes.shape == ours.shape
    assert np.abs(drakes - ours).max() < 1e-9 * np.abs(ours).max()
    other = TVLQR(model, xs, us, 1.01 * weights[0], *weights[1:]).gains
    assert np.abs(drakes - other).max() > 1e-3 * np.abs(ours).max()

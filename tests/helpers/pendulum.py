"""Recordings of a pendulum from its equation of motion, which SciPy integrates."""

import numpy as np
from scipy.integrate import solve_ivp

import drake_diff as dd

MASS, LEVER, GRAVITY = 1.0, 0.5, 9.81  # of models/pendulum.urdf


def swing(*, damping=0.1, friction=0.0, times=None, start=(1.0, 0.0), noise=1e-3, seed=0, velocities=False):
    """Return a recording of the pendulum from its equation of motion."""

    def rates(t, y):
        moment = -MASS * GRAVITY * LEVER * np.sin(y[0]) - damping * y[1] - friction * np.tanh(y[1] / 1e-3)
        return [y[1], moment / (MASS * LEVER**2)]

    times = np.linspace(0, 2, 201) if times is None else times
    found = solve_ivp(rates, (0, times[-1]), start, rtol=1e-9, atol=1e-11, t_eval=times, method="LSODA")
    xs = found.y.T + noise * np.random.default_rng(seed).standard_normal((len(times), 2))
    if not velocities:
        xs[:, 1] = np.nan
    return dd.Recording("lab", "1", times, xs, np.zeros((len(times) - 1, 1)))

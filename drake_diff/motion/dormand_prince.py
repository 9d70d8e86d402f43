"""The Runge-Kutta pair of orders 5 and 4 that integrates motions in continuous time, and how its steps change length.

Dormand and Prince, "A family of embedded Runge-Kutta formulae", 1980.
"""

import numpy as np

SAFETY, LEAST, MOST = 0.9, 0.1, 5.0  # of the factor by which a step's length changes
STAGES = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
ERROR = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])  # fifth less fourth


def factor(error: float) -> float:
    """By what the length of a step changes whose error is that part of what is allowed."""
    return MOST if error == 0 else min(MOST, max(LEAST, SAFETY * error**-0.2))

"""The Runge-Kutta pair of orders 5 and 4 that integrates motions in continuous time, and how its steps change length.

Dormand and Prince, "A family of embedded Runge-Kutta formulae", 1980; within a step by Shampine, "Some practical
Runge-Kutta formulas", 1986.
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
AT = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)  # of a step: where each of STAGES is, the last being its end
ERROR = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])  # fifth less fourth
# The weights of the slopes are DENSE @ [t, t^2, t^3, t^4] at the part t of a step, with an error of order 5.
DENSE = np.array(
    [
        (1, -8048581381 / 2820520608, 8663915743 / 2820520608, -12715105075 / 11282082432),
        (0, 0, 0, 0),
        (0, 131558114200 / 32700410799, -68118460800 / 10900136933, 87487479700 / 32700410799),
        (0, -1754552775 / 470086768, 14199869525 / 1410260304, -10690763975 / 1880347072),
        (0, 127303824393 / 49829197408, -318862633887 / 49829197408, 701980252875 / 199316789632),
        (0, -282668133 / 205662961, 2019193451 / 616988883, -1453857185 / 822651844),
        (0, 40617522 / 29380423, -110615467 / 29380423, 69997945 / 29380423),
    ]
)


def factor(error: float) -> float:
    """By what the length of a step changes whose error is that part of what is allowed."""
    return MOST if error == 0 else min(MOST, max(LEAST, SAFETY * error**-0.2))

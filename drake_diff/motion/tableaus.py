"""The coefficients of the integrators of motions in continuous time, and their step-size control.

Dormand and Prince's pair of orders 5 and 4 ("A family of embedded Runge-Kutta formulae", 1980), with Shampine's dense
output ("Some practical Runge-Kutta formulas", 1986).

Rodas5P, a Rosenbrock method of orders 5 and 4 for stiff motions, L-stable (Steinebach, "Construction of
Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the Julia Differential Equations package", BIT 63,
2023). With W = 1 / (h gamma) - f', stage i solves

    W k_i = f(x + sum_j a_ij k_j) + sum_j c_ij k_j / h,

the step ends at x + sum_j a_8j k_j + k_8, and k_8 is its error.
"""

import numpy as np

SAFETY, LEAST, MOST = 0.9, 0.1, 5.0  # safety factor, minimum and maximum of the change of a step's length
STAGES = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
AT = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)  # the fraction of the step of each of STAGES; the last is the step's end
ERROR = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])  # order 5 minus order 4
# The weights of the slopes are DENSE @ [t, t^2, t^3, t^4] at the fraction t of a step, with an error of order 5.
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
    """Return the factor by which a step's length changes, for `error` relative to the tolerance."""
    return MOST if error == 0 else min(MOST, max(LEAST, SAFETY * error**-0.2))


ROSENBROCK_GAMMA = 0.21193756319429014
_LAST = [-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946]
ROSENBROCK_STAGES = tuple(
    np.array(row)
    for row in (
        [],
        [3.0],
        [2.849394379747939, 0.45842242204463923],
        [-6.954028509809101, 2.489845061869568, -10.358996098473584],
        [2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641],
        _LAST,
        [*_LAST, 1.0],
        [*_LAST, 1.0, 1.0],
    )
)
ROSENBROCK_COUPLINGS = tuple(
    np.array(row)
    for row in (
        [],
        [-14.155112264123755],
        [-17.97296035885952, -2.859693295451294],
        [147.12150275711716, -1.41221402718213, 71.68940251302358],
        [165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306],
        [24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471],
        [
            30.91273214028599,
            -3.1208243349937974,
            77.79954646070892,
            34.28646028294783,
            -19.097331116725623,
            -28.087943162872662,
        ],
        [
            37.80277123390563,
            -3.2571969029072276,
            112.26918849496327,
            66.9347231244047,
            -40.06618937091002,
            -54.66780262877968,
            -9.48861652309627,
        ],
    )
)

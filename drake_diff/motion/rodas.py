"""Rodas5P: a linearly implicit method of order 5, with a step of order 4 beside it, for stiff motion.

Steinebach, "Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the Julia differential
equations package", 2023. Of x' = f(x) with the slope J of f and h the step's length, its stages are

    (1 / (GAMMA h) - J) k_i = f(x + sum_(j<i) A_ij k_j) + sum_(j<i) C_ij k_j / h,

the last of them is the error, and the step's end is where that one was taken, moved by it.
"""

from collections.abc import Callable

import numpy as np

from drake_diff._base.arrays import Array

NUDGE = 1e-9  # of a state's entries, which the slopes of the rates are differences over: a millionth of v_s
GAMMA = 0.21193756319429014
_SIXTH = (-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946)
A = (
    np.zeros(0),
    np.array([3.0]),
    np.array([2.849394379747939, 0.45842242204463923]),
    np.array([-6.954028509809101, 2.489845061869568, -10.358996098473584]),
    np.array([2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641]),
    np.array(_SIXTH),
    np.array([*_SIXTH, 1.0]),
    np.array([*_SIXTH, 1.0, 1.0]),
)
C = (
    np.zeros(0),
    np.array([-14.155112264123755]),
    np.array([-17.97296035885952, -2.859693295451294]),
    np.array([147.12150275711716, -1.41221402718213, 71.68940251302358]),
    np.array([165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306]),
    np.array([24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471]),
    np.array(
        (
            30.91273214028599,
            -3.1208243349937974,
            77.79954646070892,
            34.28646028294783,
            -19.097331116725623,
            -28.087943162872662,
        )
    ),
    np.array(
        (
            37.80277123390563,
            -3.2571969029072276,
            112.26918849496327,
            66.9347231244047,
            -40.06618937091002,
            -54.66780262877968,
            -9.48861652309627,
        )
    ),
)


class ImplicitSteps:
    """Steps of any length from one state, which share the slopes of the rates there."""

    def __init__(self, rates: Callable[[Array], Array], x: Array):
        self.rates, self.x, self.first = rates, x, rates(x)
        self.slopes = np.empty((len(x), len(x)))
        for j, size in enumerate(np.maximum(1.0, np.abs(x)).tolist()):
            beside = x.copy()
            beside[j] += NUDGE * size
            self.slopes[:, j] = (rates(beside) - self.first) / (beside[j] - x[j])

    def take(self, h: float) -> tuple[Array, Array]:
        """The state after a step of `h` [s], and its error."""
        inverse = np.linalg.inv(np.eye(len(self.x)) / (GAMMA * h) - self.slopes)
        stages, at = np.empty((len(A), len(self.x))), self.x
        for i, (weights, couplings) in enumerate(zip(A, C, strict=True)):
            at = self.x + weights @ stages[:i]
            value = self.first if i == 0 else self.rates(at)
            stages[i] = inverse @ (value + couplings @ stages[:i] / h)
        return at + stages[-1], stages[-1]

"""Success rates with Wilson's 95 % interval. Benchmarks share no code with the package that they measure."""

import math
from typing import NamedTuple

NORMAL_95 = 1.959963984540054  # the two-sided 95 % quantile of the normal distribution


class Rate(NamedTuple):
    """Numbers of successes and trials, and Wilson's 95 % interval of the success probability."""

    successes: int
    trials: int
    lower: float
    upper: float

    @property
    def value(self) -> float:
        return self.successes / self.trials


def success_rate(successes: int, trials: int) -> Rate:
    """Use Wilson's interval (1927): (p + z^2/2n -+ z sqrt(p (1 - p)/n + z^2/4n^2)) / (1 + z^2/n), z = 1.96, p = k/n."""
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"expected 0 <= successes <= trials and 1 <= trials, got {successes} of {trials}")
    p, n, z = successes / trials, trials, NORMAL_95
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    # The ends are exactly 0 and 1. The formula would give 1e-17 by rounding.
    lower = (middle - half) / (1 + z * z / n) if successes else 0.0
    upper = (middle + half) / (1 + z * z / n) if successes < trials else 1.0
    return Rate(successes, trials, lower, upper)

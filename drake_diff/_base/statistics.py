"""Success rates with confidence intervals, and the largest perturbation level with enough successes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drake_diff.exceptions import InputError

NORMAL_95 = 1.959963984540054  # the two-sided 95 % quantile of the normal distribution
ENOUGH = 0.95  # required fraction of successful trials


class Rate(NamedTuple):
    """The number of successful trials, and Wilson's 95 % interval of the success probability."""

    successes: int
    trials: int
    lower: float
    upper: float

    @property
    def value(self) -> float:
        return self.successes / self.trials


def success_rate(successes: int, trials: int) -> Rate:
    """Return Wilson's interval (1927): (p + z^2/2n -+ z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n), z = 1.96, p = k/n."""
    if not 0 <= successes <= trials or trials < 1:
        raise InputError(
            "successes",
            got=f"{successes} of {trials}",
            expected="a number from 0 to the number of trials, which is at least 1",
        )
    p, n, z = successes / trials, trials, NORMAL_95
    middle, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    # The ends are exactly 0 and 1, where rounding would leave 1e-17.
    lower = (middle - half) / (1 + z * z / n) if successes else 0.0
    upper = (middle + half) / (1 + z * z / n) if successes < trials else 1.0
    return Rate(successes, trials, float(lower), float(upper))


def margin(levels: Sequence[float], rates: Sequence[Rate]) -> float:
    """Return the largest level up to which (inclusive) 95 % of the trials succeed, or 0 if the first level fails."""
    largest = 0.0
    for level, rate in sorted(zip(levels, rates, strict=True)):
        if rate.value < ENOUGH:
            break
        largest = level
    return largest

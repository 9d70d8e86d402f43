"""Plain stochastic gradient descent with an estimate of a given order, and whether it arrives."""

from dataclasses import dataclass

import numpy as np

from drake_diff.arrays import Array, frozen
from drake_diff.exceptions import GradientError, NonFiniteError, SimulationError
from drake_diff.gradient_estimate import GradientCase, calls, estimate, truth_of

CHECKPOINTS = 5  # after which part of the budget F is looked at; that is not counted


@dataclass(frozen=True, eq=False)
class Descent:
    """x - rate * gradient until the `evaluations` are spent.

    `losses` are F after so many `evaluations`, the first at the start, each with its standard error. Where f or its
    derivative refused what the search came to, `failure` says how and the last loss stands for all later ones.
    """

    order: str
    sigma: float
    seed: int
    evaluations: tuple[int, ...]
    losses: tuple[float, ...]
    errors: tuple[float, ...]
    x: Array
    succeeded: bool
    failure: str | None


def descend(
    case: GradientCase, order: str, sigma: float, seed: int, *, budget: int, batch: int, samples: int
) -> Descent:
    """Spend `budget` calls, `batch` samples a step; F is measured with `samples` samples, the same for all."""
    x, spent, step, failure = case.start, 0, 0, None
    cost = sum(calls(order, batch))
    at, visited = [0], [x]
    for part in range(1, CHECKPOINTS + 1):
        while failure is None and spent + cost <= budget * part // CHECKPOINTS:
            try:
                x = _stepped(case, order, x, sigma, batch, _seed(seed, step))
            except (GradientError, SimulationError, NonFiniteError) as error:
                failure = f"{type(error).__name__}: {error}"
            spent, step = spent + cost, step + 1
        at.append(budget * part // CHECKPOINTS)
        visited.append(x)
    measured = []
    for point in visited:
        try:
            measured.append(_measured(case, point, sigma, samples))
        except (GradientError, SimulationError, NonFiniteError) as error:
            failure = failure or f"{type(error).__name__}: {error}"
            measured.append(measured[-1])
    losses, errors = zip(*measured, strict=True)
    succeeded = failure is None and losses[-1] <= case.goal
    return Descent(order, sigma, seed, tuple(at), losses, errors, frozen(x), succeeded, failure)


def _stepped(case: GradientCase, order: str, x: Array, sigma: float, batch: int, seed: int) -> Array:
    after = x - case.rate * estimate(case, order, x, sigma, batch, seed)[0]
    if not np.isfinite(after).all():
        raise GradientError(f"a step from {x.tolist()} leads to {after.tolist()}")
    return frozen(after)


def _measured(case: GradientCase, x: Array, sigma: float, samples: int) -> tuple[float, float]:
    """F and its standard error."""
    truth = truth_of(case, x, sigma, samples)
    if not np.isfinite(truth.value):
        raise GradientError(f"F({x.tolist()}) is {truth.value}")
    return truth.value, truth.value_error


def _seed(seed: int, step: int) -> int:
    """A seed of its own for every step of every descent."""
    return int(np.random.SeedSequence((seed, step)).generate_state(1)[0])

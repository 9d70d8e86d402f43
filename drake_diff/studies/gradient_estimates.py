"""One task whose gradient is estimated, and what an estimate of each order is worth against the truth.

The orders are those of `smoothing`, and "point": the derivative at x itself, without noise, which is what an optimizer
uses that smooths nothing. The truth is the gradient of F(x) = E[f(x + w)], w normal of standard deviation sigma.

Plain stochastic gradient descent with an estimate of a given order, and whether it arrives.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float
from drake_diff.exceptions import GradientError, InputError, NonFiniteError, SimulationError, UnknownNameError
from drake_diff.motion.smoothing import CONFIDENCE, METHODS, Gaussian, smooth

ORDERS = ("point", *METHODS)
# (x, sigma) -> (F, dF/dx), where it is known.
ClosedForm = Callable[[Array, float], tuple[float, Array]]
REFERENCE_SEED = 2**32 - 1  # of no estimate: those have the seeds 0, 1, ...


@dataclass(frozen=True, eq=False)
class GradientCase:
    """A loss `f` of x (n,) with its `derivative` (n,), and the task of making F small by gradient descent.

    Gradients are compared at `start` (n,), where the descent begins too; it takes steps x - `rate` * gradient at the
    largest of `sigmas` (in the units of x) and has arrived where F at that sigma is at most `goal`.
    `closed_form`(x, sigma) gives F and its gradient where they are known. Raises InputError.
    """

    name: str
    about: str
    f: Callable[[Array], float]
    derivative: Callable[[Array], Array]
    start: Array
    sigmas: tuple[float, ...]
    rate: float
    goal: float
    closed_form: ClosedForm | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", finite_array(f"{self.name}.start", self.start, ("n",)))
        object.__setattr__(self, "sigmas", checked_sigmas(f"{self.name}.sigmas", self.sigmas))
        positive_float(f"{self.name}.rate", self.rate)
        if not np.isfinite(self.goal):
            raise InputError(f"{self.name}.goal", got=self.goal, expected="a finite number")


@dataclass(frozen=True, eq=False)
class Truth:
    """F and its gradient (n,) with their standard errors, 0 of a closed form, and where they come from."""

    value: float
    value_error: float
    gradient: Array
    error: Array  # (n,)
    source: str


@dataclass(frozen=True, eq=False)
class Estimate:
    """A gradient (n,) from one seed, the variance (n,) of it, and how often f and its derivative were called."""

    seed: int
    gradient: Array
    variance: Array
    functions: int
    derivatives: int
    cosine: float | None  # to the truth, None where either is 0


@dataclass(frozen=True, eq=False)
class Quality:
    """All estimates of one order at one sigma against the truth.

    `variance` (n,) is that of one estimate, the mean over all seeds; `trace` its sum. `bias` (n,) is the mean of the
    estimates minus the truth and `bias_error` (n,) its standard error, the truth's included; `biased` says whether an
    entry is off by more than 3 of them. `mean_squared_error` is what is expected where as many calls of f and its
    derivative are spent as there are samples, each counting one: |bias|^2 if `biased`, and the variance times the
    calls of an estimate by the samples.
    """

    order: str
    sigma: float
    estimates: tuple[Estimate, ...]
    variance: Array
    bias: Array
    bias_error: Array
    biased: bool
    cosine: float | None
    mean_squared_error: float

    @property
    def trace(self) -> float:
        return float(self.variance.sum())

    @property
    def bias_in_errors(self) -> float:
        """The largest |bias| in its standard errors: infinite where there is a bias and no error."""
        size = np.abs(self.bias)
        ratio = np.divide(size, self.bias_error, out=np.where(size > 0, np.inf, 0.0), where=self.bias_error > 0)
        return float(ratio.max())


def checked_sigmas(subject: str, sigmas: Sequence[float]) -> tuple[float, ...]:
    """Rising, above 0, at least one."""
    found = tuple(sorted(positive_float(subject, sigma) for sigma in sigmas))
    if not found:
        raise InputError(subject, got="none", expected="at least one number above 0")
    return found


def check_orders(orders: Sequence[str]) -> tuple[str, ...]:
    for order in orders:
        if order not in ORDERS:
            raise UnknownNameError("orders", got=order, known=ORDERS)
    if not orders:
        raise InputError("orders", got="none", expected="at least one of " + ", ".join(ORDERS))
    return tuple(order for order in ORDERS if order in orders)


def truth_of(case: GradientCase, x: Array, sigma: float, samples: int) -> Truth:
    """The closed form, or the mean of `samples` samples of zeroth order, which no jump biases."""
    if case.closed_form is not None:
        value, gradient = case.closed_form(x, sigma)
        return Truth(float(value), 0.0, frozen(gradient), frozen(np.zeros(len(x))), "closed form")
    found = smooth(case.f, x, noise=Gaussian(sigma), samples=samples, seed=REFERENCE_SEED, method="zeroth")
    errors = np.sqrt(found.value_variance[0]), np.sqrt(found.variance[0])
    source = f"{samples} samples of zeroth order"
    return Truth(float(found.value[0]), float(errors[0]), frozen(found.jacobian[0]), frozen(errors[1]), source)


def estimate(case: GradientCase, order: str, x: Array, sigma: float, samples: int, seed: int) -> tuple[Array, Array]:
    """The gradient (n,) at `x` and its variance (n,)."""
    if order == "point":
        return frozen(case.derivative(x.copy())), frozen(np.zeros(len(x)))
    derivative = None if order == "zeroth" else case.derivative
    found = smooth(case.f, x, derivative, noise=Gaussian(sigma), samples=samples, seed=seed, method=order)
    return frozen(found.jacobian[0]), frozen(found.variance[0])


def calls(order: str, samples: int) -> tuple[int, int]:
    """How often an estimate needs f and its derivative."""
    both = {"point": (0, 1), "first": (0, samples), "zeroth": (samples + 1, 0), "blend": (samples + 1, samples)}
    return both[order]


def quality(case: GradientCase, order: str, sigma: float, truth: Truth, samples: int, seeds: int) -> Quality:
    """What `seeds` estimates of `samples` samples are worth at the case's start; "point" needs one alone."""
    found = []
    for seed in range(1 if order == "point" else seeds):
        gradient, variance = estimate(case, order, case.start, sigma, samples, seed)
        found.append(Estimate(seed, gradient, variance, *calls(order, samples), cosine(gradient, truth.gradient)))
    variance = np.mean([e.variance for e in found], axis=0)
    bias = np.mean([e.gradient for e in found], axis=0) - truth.gradient
    bias[np.abs(bias) <= rounding(truth)] = 0.0
    error = np.sqrt(variance / len(found) + truth.error**2)
    biased = bool(np.any(np.abs(bias) > CONFIDENCE * error))
    cosines = [e.cosine for e in found if e.cosine is not None]
    spent = float(variance.sum()) * sum(calls(order, samples)) / samples
    return Quality(
        order=order,
        sigma=sigma,
        estimates=tuple(found),
        variance=frozen(variance),
        bias=frozen(bias),
        bias_error=frozen(error),
        biased=biased,
        cosine=float(np.mean(cosines)) if cosines else None,
        mean_squared_error=spent + (float(bias @ bias) if biased else 0.0),
    )


def rounding(truth: Truth) -> float:
    """Below this a difference to the truth is none: Drake's step and a closed form part by rounding."""
    return 1e-10 * (1 + float(np.abs(truth.gradient).max()))


def cosine(a: Array, b: Array) -> float | None:
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0 else None


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

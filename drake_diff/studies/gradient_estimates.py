"""One task whose gradient is estimated: what an estimate of each order is worth, and whether a descent with it arrives.

Estimated is the gradient of F(x) = E[f(x + w)], w normal with standard deviation sigma. The orders are those of
`smoothing`: "first" takes derivatives of f, "zeroth" its values, "blend" both. "point" is the derivative of f at x
itself, without noise: what an optimizer uses that does not smooth. Cost is counted in calls of f and of its
derivative, one each.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float
from drake_diff.exceptions import GradientError, InputError, NonFiniteError, SimulationError, UnknownNameError
from drake_diff.motion.smoothing import CONFIDENCE, METHODS, Gaussian, smooth

ORDERS = ("point", *METHODS)
ClosedForm = Callable[[Array, float], tuple[float, Array]]  # (x, sigma) -> (F, dF/dx)
REFERENCE_SEED = 2**32 - 1  # of the truth; estimates have the seeds 0, 1, ...
CHECKPOINTS = 5  # equal parts of a descent's budget after which F is measured; those calls are not counted


@dataclass(frozen=True, eq=False)
class GradientCase:
    """A loss and its derivative, and the task of making its smoothed value F small by gradient descent.

    Gradients are compared at `start`. The descent begins there too, at the largest of `sigmas`: it takes steps
    x - `rate` * gradient, and has arrived where F is at most `goal`.

    Args:
        name: A name for tables and plots.
        about: What the task is, in a few words.
        f: The loss at x (n,), a number.
        derivative: Its derivative at x, (n,).
        start: (n,) in the units of x.
        sigmas: Standard deviations of the noise, in the units of x; at least one.
        rate: The step size of the descent, in x^2 per unit of f.
        goal: The largest F at which a descent has arrived, in the units of f.
        closed_form: (x, sigma) -> F and its gradient (n,), where they are known. Without it the truth is sampled.

    Raises:
        InputError: If a number is not finite, or a sigma or the rate is not above 0.

    Example:
        >>> from drake_diff.studies import GradientCase
        >>> case = GradientCase(
        ...     "bowl", "a quadratic", lambda x: float(x @ x), lambda x: 2 * x, [1.0], (0.1, 0.3), rate=0.1, goal=0.2
        ... )
        >>> case
        GradientCase('bowl': a quadratic; 1 variable, sigmas (0.1, 0.3))
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

    def __repr__(self) -> str:
        variables = f"{len(self.start)} variable{'s' * (len(self.start) > 1)}"
        return f"GradientCase({self.name!r}: {self.about}; {variables}, sigmas {self.sigmas})"


@dataclass(frozen=True, eq=False)
class Truth:
    """F and its gradient (n,), their standard errors (0 for a closed form), and where they come from."""

    source: str
    value: float
    value_error: float
    gradient: Array
    standard_error: Array  # (n,), of the gradient


@dataclass(frozen=True, eq=False)
class Estimate:
    """A gradient (n,) from one seed, its variance (n,), and how often f and its derivative were called."""

    seed: int
    gradient: Array
    variance: Array
    functions: int
    derivatives: int
    cosine: float | None  # to the true gradient; None where either is 0


@dataclass(frozen=True, eq=False)
class Quality:
    """All estimates of one order at one sigma against the truth.

    `variance` (n,) is that of one estimate, averaged over the seeds. `bias` (n,) is the mean of the estimates less the
    truth; `bias_error` (n,) is its standard error, the truth's included, and `biased` says whether an entry is off by
    more than 3 of them. `mean_squared_error` is at equal cost, as many calls as there are samples:
    variance * calls / samples, plus |bias|^2 if `biased`.
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

    def __repr__(self) -> str:
        told = f"variance {self.trace:.3g}, bias {np.linalg.norm(self.bias):.3g}{', biased' * self.biased}"
        return f"Quality({self.order}, sigma {self.sigma:g}: {told})"

    @property
    def trace(self) -> float:
        """The sum of the variances of all entries."""
        return float(self.variance.sum())

    @property
    def bias_in_errors(self) -> float:
        """The largest |bias| in its standard errors: infinite where there is a bias and no error."""
        size = np.abs(self.bias)
        ratio = np.divide(size, self.bias_error, out=np.where(size > 0, np.inf, 0.0), where=self.bias_error > 0)
        return float(ratio.max())


@dataclass(frozen=True, eq=False)
class Descent:
    """One descent x - rate * gradient, until its budget of calls is spent.

    `losses` are F after so many `evaluations`, the first at the start, each with its `standard_errors`. Where
    f or its derivative refused the x that the descent came to, `failure` says why, and the last loss stands for all
    later ones.
    """

    order: str
    sigma: float
    seed: int
    evaluations: tuple[int, ...]
    losses: tuple[float, ...]
    standard_errors: tuple[float, ...]
    x: Array
    arrived: bool
    failure: str | None


def checked_sigmas(subject: str, sigmas: Sequence[float]) -> tuple[float, ...]:
    """`sigmas` in rising order; InputError unless all are above 0 and there is one."""
    found = tuple(sorted(positive_float(subject, sigma) for sigma in sigmas))
    if not found:
        raise InputError(subject, got="none", expected="at least one number above 0")
    return found


def check_orders(orders: Sequence[str]) -> tuple[str, ...]:
    """`orders` in the order of ORDERS; UnknownNameError or InputError."""
    for order in orders:
        if order not in ORDERS:
            raise UnknownNameError("orders", got=order, known=ORDERS)
    if not orders:
        raise InputError("orders", got="none", expected="at least one of " + ", ".join(ORDERS))
    return tuple(order for order in ORDERS if order in orders)


def truth_of(case: GradientCase, x: Array, sigma: float, samples: int) -> Truth:
    """The closed form, or the mean of `samples` samples of zeroth order, which a jump of f does not bias."""
    if case.closed_form is not None:
        value, gradient = case.closed_form(x, sigma)
        return Truth("closed form", float(value), 0.0, frozen(gradient), frozen(np.zeros(len(x))))
    found = smooth(case.f, x, noise=Gaussian(sigma), samples=samples, seed=REFERENCE_SEED, method="zeroth")
    source, value, error = f"{samples} samples of zeroth order", found.value[0], np.sqrt(found.value_variance[0])
    return Truth(source, float(value), float(error), frozen(found.jacobian[0]), frozen(np.sqrt(found.variance[0])))


def quality(case: GradientCase, order: str, sigma: float, truth: Truth, samples: int, seeds: int) -> Quality:
    """What `seeds` estimates of `samples` samples are worth at the case's start; "point" needs one alone."""
    found, cost = [], _calls(order, samples)
    for seed in range(1 if order == "point" else seeds):
        gradient, variance = _estimate(case, order, case.start, sigma, samples, seed)
        size = float(np.linalg.norm(gradient) * np.linalg.norm(truth.gradient))
        cosine = float(gradient @ truth.gradient) / size if size > 0 else None
        found.append(Estimate(seed, gradient, variance, *cost, cosine))
    variance = np.mean([e.variance for e in found], axis=0)
    bias = np.mean([e.gradient for e in found], axis=0) - truth.gradient
    rounding = 1e-10 * (1 + float(np.abs(truth.gradient).max()))  # Drake's step and a closed form differ by so much
    bias[np.abs(bias) <= rounding] = 0.0
    error = np.sqrt(variance / len(found) + truth.standard_error**2)
    biased = bool(np.any(np.abs(bias) > CONFIDENCE * error))
    cosines = [e.cosine for e in found if e.cosine is not None]
    return Quality(
        order=order,
        sigma=sigma,
        estimates=tuple(found),
        variance=frozen(variance),
        bias=frozen(bias),
        bias_error=frozen(error),
        biased=biased,
        cosine=float(np.mean(cosines)) if cosines else None,
        mean_squared_error=float(variance.sum()) * sum(cost) / samples + (float(bias @ bias) if biased else 0.0),
    )


def descend(
    case: GradientCase, order: str, sigma: float, seed: int, *, budget: int, batch: int, samples: int
) -> Descent:
    """Spend `budget` calls, `batch` samples a step; F is measured with `samples` samples, the same for all."""
    x, spent, step, failure = case.start, 0, 0, None
    cost = sum(_calls(order, batch))
    at, visited = [0], [x]
    for part in range(1, CHECKPOINTS + 1):
        while failure is None and spent + cost <= budget * part // CHECKPOINTS:
            # A seed of its own for every step of every descent.
            step_seed = int(np.random.SeedSequence((seed, step)).generate_state(1)[0])
            try:
                after = x - case.rate * _estimate(case, order, x, sigma, batch, step_seed)[0]
                if not np.isfinite(after).all():
                    raise GradientError(f"a step from {x.tolist()} leads to {after.tolist()}")
                x = frozen(after)
            except (GradientError, SimulationError, NonFiniteError) as error:
                failure = f"{type(error).__name__}: {error}"
            spent, step = spent + cost, step + 1
        at.append(budget * part // CHECKPOINTS)
        visited.append(x)
    measured: list[tuple[float, float]] = []
    for point in visited:
        try:
            truth = truth_of(case, point, sigma, samples)
            if not np.isfinite(truth.value):
                raise GradientError(f"F({point.tolist()}) is {truth.value}")
            measured.append((truth.value, truth.value_error))
        except (GradientError, SimulationError, NonFiniteError) as error:
            if not measured:
                raise  # not even F at the start is known
            failure = failure or f"{type(error).__name__}: {error}"
            measured.append(measured[-1])
    losses, errors = zip(*measured, strict=True)
    arrived = failure is None and losses[-1] <= case.goal
    return Descent(order, sigma, seed, tuple(at), losses, errors, frozen(x), arrived, failure)


def _estimate(case: GradientCase, order: str, x: Array, sigma: float, samples: int, seed: int) -> tuple[Array, Array]:
    """The gradient (n,) at `x` and its variance (n,)."""
    if order == "point":
        return frozen(case.derivative(x.copy())), frozen(np.zeros(len(x)))
    derivative = None if order == "zeroth" else case.derivative
    found = smooth(case.f, x, derivative, noise=Gaussian(sigma), samples=samples, seed=seed, method=order)
    return frozen(found.jacobian[0]), frozen((found.variance - found.bias_square)[0])  # the scatter alone


def _calls(order: str, samples: int) -> tuple[int, int]:
    """How often an estimate calls f and its derivative; zeroth order subtracts f at x itself, one call more."""
    both = {"point": (0, 1), "first": (0, samples), "zeroth": (samples + 1, 0), "blend": (samples + 1, samples + 1)}
    return both[order]

"""Randomized smoothing: F(x) = E[f(x + w)] and its Jacobian, from samples of f and of its derivative.

Suh et al. 2022, "Do differentiable simulators give better policy gradients?", with w of density p:
    first order   mean of df/dx(x + w)                         does not include jumps of f: its mean is then biased
    zeroth order  mean of (f(x + w) - f(x)) s(w)^T,            unbiased for any f, usually with larger variance;
                  s = -d log p / d w                           f(x) changes the variance but not the mean (E[s] = 0)
    blend         a * first + (1 - a) * rest, entry by entry:
                  rest  zeroth, or zeroth minus [(df/dx(x) w) s(w)^T - df/dx(x)], whose mean is 0: the estimator with
                        the smaller variance. Both are unbiased; the second is nearly exact if f is nearly linear
                  a     the weight that minimizes a bound on the squared error,
                        (variance of the blend) + a^2 (b^2 + e^2),  b = first - rest, e its standard error
The second term is the possible contribution of first order's bias. The samples estimate this bias as b with standard
error e and cannot show that it is 0, even if first order has no variance (as for a jump). So this term is part of the
blend's `variance`, and three of its standard errors cover the true value. With v0, v1 and c the variances of rest and
first and their covariance, a = (v0 - c) / (2 e^2 + b^2), which decreases like 1 / samples if there is a bias. (Suh et
al. choose a by a bound on a |b| for a given accuracy.) Few samples usually miss rare large values, so the variances of
a blend count the farthest sample three times. No estimate can detect a jump that no sample crosses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import (
    LARGEST_SEED,
    Array,
    array_with_gaps,
    count,
    finite_array,
    frozen,
    positive_float,
    positive_int,
)
from drake_diff._base.values import ShowsItsRepr
from drake_diff.derivatives.step import differentiate_step
from drake_diff.exceptions import GradientError, InputError, ShapeError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.step import advance, check_point
from drake_diff.model.tangent import tangent_space

Flags = NDArray[np.bool_]
METHODS = ("first", "zeroth", "blend")
# Number of standard errors for a significant difference: 0.3 % of the entries of an unbiased f exceed it.
CONFIDENCE = 3.0
ROUNDING = 1e-12
FARTHEST = 2.0  # additional copies of the farthest sample in the variances of a blend


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Independent normal noise.

    Args:
        sigma: The standard deviation in the units of x: a positive number, or (n,) nonnegative numbers that are not all
            0. A coordinate with sigma 0 has no noise.

    Raises:
        InputError: sigma is not of this form.

    Example:
        >>> from drake_diff.motion import Gaussian
        >>> float(Gaussian(2.0).score(1.0))
        0.25
    """

    sigma: ArrayLike

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma", _scale("Gaussian.sigma", self.sigma))

    def sample(self, random: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Return noise of `shape` (..., n)."""
        return np.asarray(np.asarray(self.sigma) * random.standard_normal(shape))

    def score(self, w: ArrayLike) -> Array:
        """Return -d log p / d w = w / sigma^2 (..., n) at `w` (..., n); 0 where sigma is 0."""
        return _ratio(w, np.square(np.asarray(self.sigma)))


@dataclass(frozen=True, eq=False)
class Barrier:
    """Independent noise of density c (w^2 + c)^(-3/2) / 2, `c` in the squared units of x.

    This is sqrt(c / 2) times Student's t of 2 degrees of freedom. It smooths max(u, 0) to the result of a log
    barrier, (u + sqrt(u^2 + c)) / 2 (Pang et al., arXiv 2206.10787). Its variance is infinite and its score is
    bounded. If f grows linearly, F and both orders exist, and both orders have a variance, but the estimate of F
    has none (`value_variance` then does not converge). If f grows like |x|^2, F does not exist.

    Args:
        c: In the squared units of x: a positive number, or (n,) nonnegative numbers that are not all 0. A coordinate
            with c = 0 has no noise.

    Raises:
        InputError: c is not of this form.

    Example:
        >>> from drake_diff.motion import Barrier
        >>> float(Barrier(2.0).score(1.0))
        1.0
    """

    c: ArrayLike

    def __post_init__(self) -> None:
        object.__setattr__(self, "c", _scale("Barrier.c", self.c))

    def sample(self, random: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Return noise of `shape` (..., n)."""
        return np.asarray(np.sqrt(np.asarray(self.c) / 2) * random.standard_t(2, shape))

    def score(self, w: ArrayLike) -> Array:
        """Return -d log p / d w = 3 w / (w^2 + c) (..., n) at `w` (..., n); 0 where c is 0."""
        w, c = np.asarray(w, dtype=float), np.asarray(self.c)
        return np.where(c > 0, _ratio(3 * w, w * w + c), 0.0)


Noise = Gaussian | Barrier


@dataclass(frozen=True, eq=False)
class Smoothed(ShowsItsRepr):
    """F(x) and dF/dx from `samples` samples, returned by `smooth`. All variances are those of means, not of samples.

    `value` (m,) has the variance `value_variance` (m,), and `jacobian` (m, n) has the variance `variance` (m, n). The
    Jacobian is `weight` (m, n) times `first` plus the rest of `zeroth` (corrected in a blend, see the module's
    docstring), each with its variance. `bias` (m, n), first order minus that rest, is the estimated bias of first
    order, `bias_error` its standard error, and `biased` is |bias| > 3 bias_error. True means a bias (or a wrong
    derivative) with 0.3 % error probability; False only means that the samples show no bias. A blend's `variance`
    includes `bias_square` (m, n), the possible contribution of the bias to the squared error; for other methods it is
    0. `first`, `first_variance`, `bias`, `bias_error` and `biased` are None if no derivative was given. A column
    without noise has no zeroth order. Its `zeroth` is the first order, with weight 1 and bias 0.

    Example:
        >>> from drake_diff.motion import Gaussian
        >>> from drake_diff.motion import smooth
        >>> smooth(lambda x: x**2, [0.0], lambda x: np.diag(2 * x), noise=Gaussian(0.1), samples=100)
        blend of first and zeroth order, 1 x 1, 100 samples of Gaussian(sigma = 0.1), seed 0
        standard errors up to ...; first order is biased in 0 of 1 entries, its weight is ...
    """

    value: Array
    value_variance: Array
    jacobian: Array
    variance: Array
    bias_square: Array
    weight: Array
    zeroth: Array
    zeroth_variance: Array
    method: str
    samples: int
    seed: int
    noise: Noise
    first: Array | None = None
    first_variance: Array | None = None
    bias: Array | None = None
    bias_error: Array | None = None
    biased: Flags | None = None

    def __repr__(self) -> str:
        rows, columns = self.jacobian.shape
        error = float(np.sqrt(np.max(self.variance)))
        head = f"{self.method} order" if self.method != "blend" else "blend of first and zeroth order"
        head += f", {rows} x {columns}, {self.samples} samples of {_words(self.noise)}, seed {self.seed}"
        if self.biased is None:
            return f"{head}\nstandard errors up to {error:.2g}; no derivative to compare with"
        low, high, biased = np.min(self.weight), np.max(self.weight), np.count_nonzero(self.biased)
        return (
            f"{head}\nstandard errors up to {error:.2g}; first order is biased in {biased} of {self.biased.size} "
            f"entries, its weight is {low:.2g} to {high:.2g}"
        )


def smooth(
    f: Callable[[Array], Any],
    x: ArrayLike,
    jacobian: Callable[[Array], Any] | None = None,
    *,
    noise: Noise,
    samples: int = 1000,
    seed: int = 0,
    method: str = "blend",
) -> Smoothed:
    """Estimate F(x) = E[f(x + w)] and dF/dx of any function f, with the variances of first and zeroth order.

    f is called `samples` + 1 times, and `jacobian` `samples` times, once more for a blend. Samples are not stored.

    Args:
        f: (n,) -> (m,), or a number (m = 1).
        x: (n,) the point.
        jacobian: The derivative of f, (n,) -> (m, n), or (n,) if m = 1. It is optional only for "zeroth" with noise on
            all coordinates. If it is given, all three orders are estimated.
        noise: A `Gaussian` or a `Barrier`.
        samples: The number of samples, at least 2.
        seed: The seed of the random numbers; results are bitwise reproducible.
        method: "first", "zeroth" or "blend", see the module's docstring.

    Returns:
        The value (m,) and Jacobian (m, n) of F, with their variances.

    Raises:
        UnknownNameError: The method does not exist.
        InputError: Shapes do not match, there are fewer than 2 samples, or `jacobian` is missing.
        GradientError: f, `jacobian` or their statistics are not finite.

    Example:
        >>> from drake_diff.motion import Gaussian
        >>> from drake_diff.motion import smooth
        >>> jump = smooth(np.sign, [0.0], lambda x: [0.0], noise=Gaussian(1.0), samples=4000)
        >>> float(jump.first[0, 0]), bool(jump.biased[0, 0]), bool(abs(jump.jacobian[0, 0] - 0.8) < 0.1)
        (0.0, True, True)
    """
    if method not in METHODS:
        raise UnknownNameError("method", got=method, known=METHODS)
    x = finite_array("x", x, ("n",))
    moved = _moved(noise, len(x))
    if jacobian is None and (method != "zeroth" or not moved.all()):
        why = 'a function (n,) -> (m, n): it is optional only for method="zeroth" with noise on all coordinates'
        raise InputError("jacobian", got=None, expected=why)
    if positive_int("samples", samples) < 2:
        raise InputError("samples", got=samples, expected="at least 2, as one sample has no variance")
    samples, seed = int(samples), count("seed", seed, 0, LARGEST_SEED)
    sums = _moments(f, x, jacobian, noise, moved, samples, seed, corrects=method == "blend")
    common: dict[str, Any] = {"method": method, "samples": samples, "seed": seed, "noise": noise}
    common |= {"value": frozen(sums["value"].mean), "value_variance": frozen(sums["value"].variance)}
    common |= {"zeroth": frozen(sums["zeroth"].mean), "zeroth_variance": frozen(sums["zeroth"].variance)}
    nothing = frozen(np.zeros_like(sums["zeroth"].mean))
    if jacobian is None:
        estimate: dict[str, Any] = {"jacobian": common["zeroth"], "variance": common["zeroth_variance"]}
        return Smoothed(**common, **estimate, bias_square=nothing, weight=nothing)
    first, bias = sums["first"], sums["bias"]
    if method == "blend":
        jacobian_, variance, bias_square, weight, bias = _blend(sums, moved)
    else:
        chosen = sums[method]
        jacobian_, variance, bias_square = chosen.mean, chosen.variance, nothing
        weight = np.full(nothing.shape, float(method == "first"))
        weight[:, ~moved] = 1.0
    bias_error = np.sqrt(bias.variance)
    biased = np.abs(bias.mean) > CONFIDENCE * bias_error + ROUNDING * np.abs(first.mean)
    biased.setflags(write=False)
    return Smoothed(
        **common,
        jacobian=frozen(jacobian_),
        variance=frozen(variance),
        bias_square=frozen(bias_square),
        weight=frozen(weight),
        first=frozen(first.mean),
        first_variance=frozen(first.variance),
        bias=frozen(bias.mean),
        bias_error=frozen(bias_error),
        biased=biased,
    )


def smooth_step(
    model: Model,
    x: ArrayLike,
    u: ArrayLike | None = None,
    *,
    noise: Noise,
    samples: int = 100,
    seed: int = 0,
    method: str = "blend",
) -> Smoothed:
    """Apply `smooth` to one step of a model over z = [x; u], with the Jacobians of `differentiate_step`.

    Args:
        model: A discrete model without quaternions, to which noise cannot be added.
        x: (nx,) the state.
        u: (nu,) the input [N or N m]; may be omitted if the model has no actuators.
        noise: In the units of z, which differ between entries, so that (nx + nu,) numbers are recommended. A
            coordinate with the number 0 is not smoothed, and its columns of `zeroth` are the first order.
        samples: The number of samples, at least 2.
        seed: The seed of the random numbers; results are bitwise reproducible.
        method: "first", "zeroth" or "blend".

    Returns:
        The value (nx,) and Jacobian (nx, nx + nu) of the smoothed step, with their variances.

    Raises:
        InputError: The model has a quaternion, or an argument is invalid for `smooth`.
        SimulationError: Drake cannot compute a step.
        GradientError: See `differentiate_step`.

    Example:
        >>> from drake_diff.motion import Gaussian
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> from drake_diff.motion import smooth_step
        >>> smooth_step(model, [0.1, 0.0], [0.0], noise=Gaussian([0.01, 0.01, 0]), samples=20).jacobian.shape
        (2, 3)
    """
    x, u = check_point(model, x, u)
    quaternions = tangent_space(model).quaternions
    if quaternions:
        names = ", ".join(model.state_names[quaternions[0] : quaternions[0] + 4])
        raise InputError("model", got=f"the quaternion ({names})", expected="a state without quaternions")
    nx = model.nx

    def f(z: Array) -> Any:
        return advance(model.double, z[:nx], z[nx:])

    def jacobian(z: Array) -> Array:
        step = differentiate_step(model, z[:nx], z[nx:])
        return np.hstack([step.A, step.B])

    free = method == "zeroth" and _moved(noise, nx + model.nu).all()
    z = np.concatenate([x, u])
    return smooth(f, z, None if free else jacobian, noise=noise, samples=samples, seed=seed, method=method)


def _scale(subject: str, scale: Any) -> float | Array:
    if not isinstance(scale, (list, tuple, np.ndarray)) or np.ndim(scale) == 0:
        return positive_float(subject, scale)
    array = finite_array(subject, scale, ("n",))
    if not (np.all(array >= 0) and np.any(array > 0)):
        raise InputError(subject, got=array, expected="numbers of at least 0, one of them above 0")
    return array


def _words(noise: Noise) -> str:
    name, scale = ("sigma", noise.sigma) if isinstance(noise, Gaussian) else ("c", noise.c)
    low, high = np.min(np.asarray(scale)), np.max(np.asarray(scale))
    return f"{type(noise).__name__}({name} = {low:g}" + (f" to {high:g})" if high > low else ")")


def _ratio(a: ArrayLike, b: ArrayLike) -> Array:
    """Return a / b, and 0 where b is 0."""
    a, b = np.broadcast_arrays(np.asarray(a, dtype=float), np.asarray(b, dtype=float))
    return np.divide(a, b, out=np.zeros(a.shape), where=b > 0)


def _moved(noise: Noise, size: int) -> Flags:
    """Return which coordinates have noise (size,)."""
    if not isinstance(noise, (Gaussian, Barrier)):
        raise InputError("noise", got=repr(noise)[:80], expected="a Gaussian or a Barrier")
    scale = np.asarray(noise.sigma if isinstance(noise, Gaussian) else noise.c)
    if scale.ndim and scale.shape != (size,):
        raise ShapeError(f"the scale of {type(noise).__name__}", got=scale.shape, expected=(size,))
    return np.array(np.broadcast_to(scale > 0, (size,)))


@dataclass(frozen=True, eq=False)
class Sums:
    """The mean of samples, the variance of the mean, and this variance with the farthest sample counted three times."""

    mean: Array
    variance: Array
    cautious: Array

    def where(self, chosen: Flags, other: Sums) -> Sums:
        """Return these sums with the entries that are not `chosen` replaced by those of `other`."""
        return Sums(*(np.where(chosen, getattr(self, name), getattr(other, name)) for name in vars(self)))


def _blend(sums: dict[str, Sums], moved: Flags) -> tuple[Array, Array, Array, Array, Sums]:
    """Return the blend, its variance, the part of the variance due to bias, the weight of first order, and the bias."""
    first, plain = sums["first"], sums["zeroth"].variance <= sums["corrected"].variance
    rest = sums["zeroth"].where(plain, sums["corrected"])
    bias = sums["bias"].where(plain, sums["corrected bias"])
    v0, v1, spread = rest.cautious, first.cautious, bias.cautious
    covariance = (v0 + v1 - spread) / 2
    possible = bias.mean**2 + spread  # the mean square of a bias estimated as b +- e
    loss = spread + possible
    weight = np.clip(np.divide(v0 - covariance, loss, out=np.ones_like(loss), where=loss > 0), 0.0, 1.0)
    weight[:, ~moved] = 1.0
    scatter = weight**2 * v1 + (1 - weight) ** 2 * v0 + 2 * weight * (1 - weight) * covariance
    bias_square = weight**2 * possible
    blend = weight * first.mean + (1 - weight) * rest.mean
    return blend, np.maximum(scatter, 0.0) + bias_square, bias_square, weight, bias


def _moments(
    f: Callable[[Array], Any],
    x: Array,
    jacobian: Callable[[Array], Any] | None,
    noise: Noise,
    moved: Flags,
    samples: int,
    seed: int,
    *,
    corrects: bool,
) -> dict[str, Sums]:
    """Compute sums of value (m,), zeroth, first, bias (m, n) and the corrected ones by Welford's algorithm."""
    centre = _evaluate("f", f, x.copy(), ("m",))
    rows, size = len(centre), len(x)
    if not (rows and size):
        raise InputError("x and f(x)", got=f"{size} and {rows} entries", expected="at least one entry each")
    slope = _evaluate("jacobian", jacobian, x.copy(), (rows, size)) if jacobian and corrects else None
    mean, squares, low, high = np.zeros(()), np.zeros(()), np.array(np.inf), np.array(-np.inf)
    for n, w in enumerate(noise.sample(np.random.default_rng(seed), (samples, size)), start=1):
        value, score = _evaluate("f", f, x + w, (rows,)), noise.score(w)
        first = None if jacobian is None else _evaluate("jacobian", jacobian, x + w, (rows, size))
        with np.errstate(over="ignore", invalid="ignore"):  # checked below
            zeroth = np.outer(value - centre, score)
            parts = [value, zeroth.ravel()]
            if first is not None:
                zeroth[:, ~moved] = first[:, ~moved]
                parts = [value, zeroth.ravel(), first.ravel(), (first - zeroth).ravel()]
                if slope is not None:
                    corrected = np.outer(value - centre - slope @ w, score) + slope
                    corrected[:, ~moved] = first[:, ~moved]
                    parts += [corrected.ravel(), (first - corrected).ravel()]
            sample = np.concatenate(parts)
            change = sample - mean
            mean = mean + change / n
            squares = squares + change * change * ((n - 1) / n)
            low, high = np.minimum(low, sample), np.maximum(high, sample)
    with np.errstate(over="ignore", invalid="ignore"):
        variance = squares / ((samples - 1) * samples)
        cautious = variance + FARTHEST * np.maximum(high - mean, mean - low) ** 2 / samples**2
    if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(cautious))):
        raise GradientError("the mean or the variance of the samples is not finite: f or its derivative is too large")
    statistics, names = (mean, variance, cautious), ("zeroth", "first", "bias", "corrected", "corrected bias")
    shaped = zip(*(flat[rows:].reshape(-1, rows, size) for flat in statistics), strict=True)
    sums = {name: Sums(*kind) for name, kind in zip(names, shaped, strict=False)}
    return sums | {"value": Sums(*(flat[:rows] for flat in statistics))}


def _evaluate(subject: str, function: Callable[[Array], Any], point: Array, shape: tuple[int | str, ...]) -> Array:
    """Evaluate `function` at `point` as numbers of `shape`; missing leading dimensions are 1."""
    given = point.copy()  # the function may modify its argument
    result = function(point)
    try:
        result = np.array(result, ndmin=len(shape))
        if result.dtype == object:
            raise TypeError("objects")
    except (TypeError, ValueError) as error:  # objects, or rows of unequal length
        raise InputError(f"{subject}(x)", got=repr(result)[:80], expected="an array of numbers") from error
    values = array_with_gaps(f"{subject}(x)", result, shape)
    if not np.isfinite(values).all():
        raise GradientError(f"{subject}({given.tolist()}) is {values.tolist()}: it must be finite for all samples")
    return values

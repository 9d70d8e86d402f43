"""Randomized smoothing: F(x) = E[f(x + w)] and its Jacobian, from samples of f and of its derivative.

Suh et al. 2022, "Do differentiable simulators give better policy gradients?", with w of density p:
    first order   mean of df/dx(x + w)                         misses what f jumps by: its mean is then biased
    zeroth order  mean of (f(x + w) - f(x)) s(w)^T,            unbiased for any f, of a larger variance as a rule;
                  s = -d log p / d w                           f(x) changes no mean, for E[s] = 0, but the variance
    blend         a * first + (1 - a) * rest, entry by entry:
                  rest  zeroth, or zeroth less (df/dx(x) w) s(w)^T - df/dx(x), which is 0 but for chance: the one that
                        varies less. Both are unbiased; the second is nearly exact where f is nearly linear
                  a     the weight that makes the squared error smallest that can be vouched for,
                        (variance of the blend) + a^2 (b^2 + e^2),  b = first - rest, e its standard error
The second term is what first order's bias may add: the samples say that it is b to within e, and never that it is 0,
however little first order itself varies (that of a jump does not vary at all). So it counts in the blend's `variance`,
and three of its standard errors cover the truth. With v0, v1 and c the variances of rest and first and their
covariance, a = (v0 - c) / (2 e^2 + b^2), which shrinks like 1 / samples where there is a bias. (Suh et al. choose a by
a bound on a |b| for an accuracy that is given.) Of few samples the rare and large ones are missing as a rule, so the
variances of a blend count the farthest sample three times. No estimate knows of a jump that no sample crosses.
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
# Standard errors beyond which a difference is no chance: 0.3 % of the entries of an unbiased f exceed it.
CONFIDENCE = 3.0
ROUNDING = 1e-12
FARTHEST = 2.0  # how often the farthest sample counts once more in what a blend vouches for


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Independent normal noise.

    Args:
        sigma: The standard deviation in the units of x: a number above 0, or (n,) numbers of at least 0 of which one
            is above 0. Noise does not move a coordinate of 0.

    Raises:
        InputError: sigma is none of these.

    Example:
        >>> from drake_diff.motion import Gaussian
        >>> float(Gaussian(2.0).score(1.0))
        0.25
    """

    sigma: ArrayLike

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma", _scale("Gaussian.sigma", self.sigma))

    def sample(self, random: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Noise of `shape` (..., n)."""
        return np.asarray(np.asarray(self.sigma) * random.standard_normal(shape))

    def score(self, w: ArrayLike) -> Array:
        """(..., n): -d log p / d w = w / sigma^2 at `w` (..., n); 0 where sigma is 0."""
        return _ratio(w, np.square(np.asarray(self.sigma)))


@dataclass(frozen=True, eq=False)
class Barrier:
    """Independent noise of density c (w^2 + c)^(-3/2) / 2, `c` in the squared units of x.

    This is sqrt(c / 2) times Student's t of 2 degrees of freedom. It smooths max(u, 0) to what a log barrier
    makes of it, (u + sqrt(u^2 + c)) / 2 (Pang et al., arXiv 2206.10787). Its variance is infinite and its score
    bounded: for an f that grows linearly F and both orders exist, and both orders have a variance, but F's own
    estimate has none (`value_variance` then does not settle); an f that grows like |x|^2 has no F.

    Args:
        c: In the squared units of x: a number above 0, or (n,) numbers of at least 0 of which one is above 0. Noise
            does not move a coordinate of 0.

    Raises:
        InputError: c is none of these.

    Example:
        >>> from drake_diff.motion import Barrier
        >>> float(Barrier(2.0).score(1.0))
        1.0
    """

    c: ArrayLike

    def __post_init__(self) -> None:
        object.__setattr__(self, "c", _scale("Barrier.c", self.c))

    def sample(self, random: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Noise of `shape` (..., n)."""
        return np.asarray(np.sqrt(np.asarray(self.c) / 2) * random.standard_t(2, shape))

    def score(self, w: ArrayLike) -> Array:
        """(..., n): -d log p / d w = 3 w / (w^2 + c) at `w` (..., n); 0 where c is 0."""
        w, c = np.asarray(w, dtype=float), np.asarray(self.c)
        return np.where(c > 0, _ratio(3 * w, w * w + c), 0.0)


Noise = Gaussian | Barrier


@dataclass(frozen=True, eq=False)
class Smoothed(ShowsItsRepr):
    """F(x) and dF/dx from `samples` samples; `smooth` makes one. All variances are of the means, not of one sample.

    `value` (m,) with `value_variance` (m,); `jacobian` (m, n) with `variance` (m, n) is what `method` chose:
    `weight` (m, n) of `first`, the rest of `zeroth` (a blend corrects it, see the top of this module), each with its
    variance. `bias` (m, n), first order less that rest, is the estimated bias of first order, `bias_error` its standard
    error, and `biased` whether |bias| > 3 bias_error: True is a bias (or a wrong derivative) to 0.3 %, but False only
    means that these samples do not show one. A blend's `variance` counts `bias_square` (m, n), what that bias may add
    to its squared error; the other orders count none, and it is 0. `first`, `first_variance`, `bias`, `bias_error` and
    `biased` are None where there was no derivative. A column that noise does not move has no zeroth order: first order
    stands in `zeroth` there, with weight 1 and bias 0.

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
    """F(x) = E[f(x + w)] and dF/dx of any function f, with what first and zeroth order are worth there.

    Calls f `samples` + 1 times and `jacobian` `samples` times, once more for a blend; keeps sums, not samples.

    Args:
        f: (n,) -> (m,), or a number (m = 1).
        x: (n,) where.
        jacobian: (n,) -> (m, n), or (n,) where m = 1, the derivative of f. Only "zeroth" does without, and only where
            noise moves all coordinates; where one is given all three orders are estimated.
        noise: A `Gaussian` or a `Barrier`.
        samples: How many, at least 2.
        seed: The same gives the same bytes.
        method: "first", "zeroth" or "blend", see the top of this module.

    Returns:
        The value (m,) and Jacobian (m, n) of F, with their variances.

    Raises:
        UnknownNameError: There is no such method.
        InputError: Shapes that do not fit, fewer than 2 samples, or a missing `jacobian`.
        GradientError: f, `jacobian` or what comes of them is not finite.

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
        why = 'a function (n,) -> (m, n): only method="zeroth" with noise on all coordinates needs none'
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
    """`smooth` of one step of a model over z = [x; u], by the Jacobians of `differentiate_step`.

    Args:
        model: A discrete model without quaternions, to which no noise can be added.
        x: (nx,) the state.
        u: (nu,) the input [N or N m]; may be left out where the model has no actuators.
        noise: In the units of z, which differ from entry to entry: (nx + nu,) numbers say more than one. A
            coordinate whose number is 0 is not smoothed; its columns of `zeroth` hold the first order.
        samples: How many, at least 2.
        seed: The same gives the same bytes.
        method: "first", "zeroth" or "blend".

    Returns:
        The value (nx,) and Jacobian (nx, nx + nu) of the smoothed step, with their variances.

    Raises:
        InputError: The model has a quaternion, or what `smooth` raises.
        SimulationError: Drake cannot take a step.
        GradientError: As by `differentiate_step`.

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
    """a / b, and 0 where b is 0."""
    a, b = np.broadcast_arrays(np.asarray(a, dtype=float), np.asarray(b, dtype=float))
    return np.divide(a, b, out=np.zeros(a.shape), where=b > 0)


def _moved(noise: Noise, size: int) -> Flags:
    """(size,): which coordinates the noise moves."""
    if not isinstance(noise, (Gaussian, Barrier)):
        raise InputError("noise", got=repr(noise)[:80], expected="a Gaussian or a Barrier")
    scale = np.asarray(noise.sigma if isinstance(noise, Gaussian) else noise.c)
    if scale.ndim and scale.shape != (size,):
        raise ShapeError(f"the numbers of {type(noise).__name__}", got=scale.shape, expected=(size,))
    return np.array(np.broadcast_to(scale > 0, (size,)))


@dataclass(frozen=True, eq=False)
class Sums:
    """The mean of samples, the variance of that mean, and the same if the farthest sample had come three times."""

    mean: Array
    variance: Array
    cautious: Array

    def where(self, chosen: Flags, other: Sums) -> Sums:
        """`other` in the entries that are not `chosen`."""
        return Sums(*(np.where(chosen, getattr(self, name), getattr(other, name)) for name in vars(self)))


def _blend(sums: dict[str, Sums], moved: Flags) -> tuple[Array, Array, Array, Array, Sums]:
    """The blend, its variance, what of that is for the bias, the weight of first order, and the bias."""
    first, plain = sums["first"], sums["zeroth"].variance <= sums["corrected"].variance
    rest = sums["zeroth"].where(plain, sums["corrected"])
    bias = sums["bias"].where(plain, sums["corrected bias"])
    v0, v1, spread = rest.cautious, first.cautious, bias.cautious
    covariance = (v0 + v1 - spread) / 2
    possible = bias.mean**2 + spread  # the mean square of a bias of which these samples say b +- e
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
    """Of value (m,), zeroth and, with a jacobian, first and bias (m, n), and those corrected; Welford's sums."""
    centre = _evaluate("f", f, x.copy(), ("m",))
    rows, size = len(centre), len(x)
    if not (rows and size):
        raise InputError("x and f(x)", got=f"{size} and {rows} entries", expected="at least one of each")
    slope = _evaluate("jacobian", jacobian, x.copy(), (rows, size)) if jacobian and corrects else None
    mean, squares, low, high = np.zeros(()), np.zeros(()), np.array(np.inf), np.array(-np.inf)
    for n, w in enumerate(noise.sample(np.random.default_rng(seed), (samples, size)), start=1):
        value, score = _evaluate("f", f, x + w, (rows,)), noise.score(w)
        first = None if jacobian is None else _evaluate("jacobian", jacobian, x + w, (rows, size))
        with np.errstate(over="ignore", invalid="ignore"):  # refused below
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
    """`function` at `point` as numbers of `shape`; missing leading dimensions are 1."""
    given = point.copy()  # the function may change what it is given
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

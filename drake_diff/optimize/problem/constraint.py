"""Constraints of a motion: bounds of states and inputs, and constraints lower <= function <= upper at chosen knots."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array, array_with_gaps, frozen
from drake_diff._base.autodiff import called, carrying, chain_rows, gradient_rows, named, user_function
from drake_diff.exceptions import GradientError, InputError, ShapeError
from drake_diff.model.assembly import single_coordinates
from drake_diff.model.model import Model

LOOKED_AT = 5  # number of states at which a constraint's slopes are computed
FORM = "a function of x, or of x and u, in ordinary arithmetic that returns a number or an array (m,)"


class ShowsArrays:
    """A base class whose repr shows the fields that are not None, and long arrays by their shapes."""

    def __repr__(self) -> str:
        given = {name: value for name, value in vars(self).items() if value is not None}
        return f"{type(self).__name__}({', '.join(f'{name}={short(value)}' for name, value in given.items())})"


class Described:
    """The base of frozen dataclasses of plain values that a record contains. `Kind(**values)` restores one."""

    def given(self) -> dict[str, Any]:
        """Return the values that differ from the defaults, as JSON types."""
        pairs = ((f, plain_value(getattr(self, f.name))) for f in fields(self))  # type: ignore[arg-type]  # dataclasses
        return {f.name: value for f, value in pairs if f.default is MISSING or value != plain_value(f.default)}

    def to_dict(self) -> dict[str, Any]:
        """Return the class name and the values that differ from the defaults, for a record."""
        return {type(self).__name__: self.given()}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in self.given().items())})"

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)


def plain_value(value: Any) -> Any:
    """Convert tuples and arrays to lists, so that JSON restores the same values."""
    if isinstance(value, Described):
        return value.to_dict()
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain_value(v) for v in value] if isinstance(value, (tuple, list)) else value


@dataclass(frozen=True, eq=False, repr=False)
class Bounds(ShowsArrays):
    """Lower and upper limits of the states and inputs of a `Problem`.

    Where a whole array is None, or one entry is NaN, the limit of the model (its positions, velocities and efforts)
    or of the `Dynamics` applies. An infinite entry means no limit.

    Args:
        x_lower: (nx,) least states, in the states' units.
        x_upper: (nx,) greatest states.
        u_lower: (nu,) least inputs, in the inputs' units.
        u_upper: (nu,) greatest inputs.

    Example:
        >>> dd.Bounds(u_lower=[-5.0], u_upper=[5.0])
        Bounds(u_lower=[-5.], u_upper=[5.])
    """

    x_lower: Any = None
    x_upper: Any = None
    u_lower: Any = None
    u_upper: Any = None


class StateFunction:
    """A function x (nx,) -> (m,) with exact derivatives at many states at once."""

    def values(self, xs: Array) -> Array:
        """Return the values (K, m) at states (K, nx)."""
        raise NotImplementedError

    def linearize(self, xs: Array) -> tuple[Array, Array]:
        """Return the values (K, m) and the derivatives (K, m, nx) at states (K, nx)."""
        raise NotImplementedError

    def __call__(self, x: Any) -> Any:
        """Return the values (m,) at one state of floats or AutoDiffXd."""
        if x.dtype == float:
            return self.values(x[None])[0]
        values, slopes = self.linearize(ExtractValue(x.reshape(-1, 1)).T)
        return chain_rows(values[0], slopes[0], x)


@dataclass(frozen=True, eq=False, repr=False)
class Constraint:
    """A path constraint of a `Problem`: lower <= function(x) <= upper, or lower <= function(x, u) <= upper.

    Args:
        function: takes x (nx,), and u (nu,) if it has a second argument, and returns one number or (m,) numbers. It
            uses ordinary arithmetic and NumPy functions that support AutoDiffXd.
        lower: a number or (m,) numbers, in the unit of the function's values; no limit if None.
        upper: the same; one of the two must be given.
        knots: the knots to which it applies, whole numbers 0 ... N, where negative ones count from the end. None means
            every knot except a given first state; collocation then also constrains its midpoints. A discrete method has
            no input at knot N, so that a function of u applies only up to N-1.
        name: the name in messages; by default the function's own name.

    Raises:
        InputError: no function, no limit, or limits that cross or do not fit.

    Example:
        >>> dd.Constraint(lambda x: x[1], upper=1.5, name="speed")
        Constraint speed at every knot: -inf <= f(x) <= 1.5
    """

    function: Callable[..., Any]
    lower: Any = None
    upper: Any = None
    knots: Any = None
    name: str = ""

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise InputError("Constraint.function", got=type(self.function).__name__, expected=FORM)
        if self.lower is None and self.upper is None:
            raise InputError("Constraint", got="no lower and no upper", expected="lower, upper, or both")
        object.__setattr__(self, "function", user_function(f"constraint {self.name}".strip(), self.function, None))
        lower, upper = -np.inf if self.lower is None else self.lower, np.inf if self.upper is None else self.upper
        lower = array_with_gaps("Constraint.lower", np.atleast_1d(lower), ("m",))
        upper = array_with_gaps("Constraint.upper", np.atleast_1d(upper), ("m",))
        try:
            lower, upper = np.broadcast_arrays(lower, upper)
        except ValueError as error:
            raise InputError("Constraint.upper", got=upper.shape, expected=f"shape {lower.shape}") from error
        bad = np.isnan(lower) | np.isnan(upper) | (lower > upper) | (lower == np.inf) | (upper == -np.inf)
        if bad.any():
            got = f"[{lower[bad][0]:g}, {upper[bad][0]:g}]"
            raise InputError(f"Constraint {self.label}", got=got, expected="a lower bound of at most the upper bound")
        object.__setattr__(self, "lower", frozen(lower))
        object.__setattr__(self, "upper", frozen(upper))

    def __repr__(self) -> str:
        lower, upper = (short(side[0] if len(side) == 1 else side) for side in (self.lower, self.upper))
        where = "every knot" if self.knots is None else f"knots {np.atleast_1d(self.knots).tolist()}"
        return f"Constraint {self.label} at {where}: {lower} <= f({'x, u' if self.takes_input else 'x'}) <= {upper}"

    @property
    def label(self) -> str:
        """The name of the constraint, by default the function's own name."""
        return self.name or str(getattr(self.function, "__qualname__", type(self.function).__name__))

    @cached_property
    def takes_input(self) -> bool:
        """Whether the function has an argument u."""
        return arguments_of(self.function) > 1

    @property
    def whole(self) -> bool:
        """Whether the constraint also applies between its knots, from the first to the last."""
        return self.knots is None

    def at_knots(self, count: int, first_is_given: bool) -> tuple[int, ...]:
        """Return the knots out of 0 ... `count` to which it applies, in order, or raise InputError for other knots."""
        last = count - 1 if self.takes_input else count
        if self.knots is None:
            return tuple(range(int(first_is_given and not self.takes_input), last + 1))
        given = np.atleast_1d(np.asarray(self.knots))
        wanted = f"whole numbers from {-last - 1} to {last}"
        if given.ndim != 1 or not np.issubdtype(given.dtype, np.integer) or not len(given):
            raise InputError(f"knots of constraint {self.label}", got=repr(self.knots), expected=wanted)
        if (given > last).any() or (given < -last - 1).any():
            raise InputError(f"knots of constraint {self.label}", got=given.tolist(), expected=wanted)
        return tuple(sorted({int(k) % (last + 1) for k in given}))

    def __call__(self, x: Any, u: Any) -> Array:
        """Return the function's values (m,) at x (nx,), u (nu,)."""
        return np.asarray(self._call(x, u), dtype=float)

    def differentiate(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return (values (m,), Jacobian (m, nx + nu)). Raises GradientError if the Jacobian is lost or not finite."""
        if hasattr(self.function, "linearize"):
            return self.along(x[None], u[None])[0], self.slopes(x[None], u[None])[0]
        z = InitializeAutoDiff(np.concatenate([x, u])).ravel()
        with np.errstate(all="ignore"):  # checked below
            result = self._call(z[: len(x)], z[len(x) :])
        plain, rows = carried(result, len(z), f"constraint {self.label}", f"{FORM}, without float()")
        if not (np.all(np.isfinite(plain)) and np.all(np.isfinite(rows))):
            raise GradientError(f"constraint {self.label} or its derivative is not finite at x = {x.tolist()}")
        return plain, rows

    def along(self, xs: Array, us: Array) -> Array:
        """Return the function's values (K, m) at xs (K, nx), us (K, nu)."""
        if hasattr(self.function, "linearize"):
            return np.asarray(self.function.values(xs))  # type: ignore[attr-defined]
        return np.array([self(x, u) for x, u in zip(xs, us, strict=True)])

    def slopes(self, xs: Array, us: Array) -> Array:
        """Return the Jacobians (K, m, nx + nu) at xs (K, nx), us (K, nu). Raises GradientError like `differentiate`."""
        if not hasattr(self.function, "linearize"):
            return np.array([self.differentiate(x, u)[1] for x, u in zip(xs, us, strict=True)])
        by_x = self.function.linearize(xs)[1]
        bad = ~np.all(np.isfinite(by_x), axis=(1, 2))
        if bad.any():
            raise GradientError(f"the derivative of constraint {self.label} is not finite at x = {xs[bad][0].tolist()}")
        return np.concatenate([by_x, np.zeros((*by_x.shape[:2], us.shape[1]))], axis=2)

    def scales(self, xs: Array, us: Array, spans: Array) -> Array:
        """Return the change (m,) of the values, by their slopes, if states and inputs change by `spans` (nx + nu,).

        The slopes are those at some of xs (K, nx), us (K, nu). A value without slopes has the magnitude of its bound.
        """
        scales = np.zeros(len(self.lower))
        for k in np.unique(np.linspace(0, len(us) - 1, LOOKED_AT).astype(int)):
            with suppress(GradientError):
                scales = np.maximum(scales, np.abs(self.differentiate(xs[k], us[k])[1]) @ spans)
        bounds = np.where(np.isfinite(self.lower), np.abs(self.lower), np.abs(self.upper))
        return np.where(scales > 0, scales, np.where(np.isfinite(bounds), bounds, 0.0))

    def excess(self, x: Array, u: Array) -> float:
        """Return the largest excess over a bound at x (nx,), u (nu,), or inf if a value is not a number."""
        values = self(x, u)
        worst = np.max(np.maximum(self.lower - values, values - self.upper), initial=0.0)
        return float("inf") if np.isnan(worst) else float(worst)

    def resolved(self, x: Array, u: Array) -> "Constraint":
        """Return the constraint with one bound per function value. Raises InputError if their counts do not fit."""
        with np.errstate(all="ignore"):
            values = self._call(x, u)
        size = len(self.lower)
        if size not in (1, len(values)):
            raise InputError(f"constraint {self.label}", got=f"{len(values)} values", expected=f"{size}, one per bound")
        lower, upper = (np.broadcast_to(side, values.shape) for side in (self.lower, self.upper))
        return replace(self, lower=lower, upper=upper)

    def _call(self, x: Any, u: Any) -> Any:
        f, arguments = self.function, (x, u) if self.takes_input else (x,)
        ask, subject = called if x.dtype == float else carrying, f"constraint {self.name}".strip()
        result = np.asarray(ask(subject, f, *arguments))
        if result.ndim > 1:
            raise ShapeError(f"{named(subject, f)}: its ndarray", got=result.shape, expected=("m",))
        return np.atleast_1d(result)


def several(subject: str, given: Any, kind: type | tuple[type, ...], expected: str) -> tuple[Any, ...]:
    """Return one or several values of a kind as a tuple. Raises InputError for other types."""
    every = tuple(given) if isinstance(given, (tuple, list)) else (given,)
    for value in every:
        if not isinstance(value, kind):
            raise InputError(subject, got=type(value).__name__, expected=expected)
    return every


def arguments_of(function: Any) -> int:
    """Return the number of arguments without a default, or 0 if the function has no signature."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # some built-in functions
        return 0
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in kinds and p.default is p.empty for p in parameters)


def carried(result: Array, width: int, subject: str, form: str) -> tuple[Array, Array]:
    """Return the values (m,) of `result` and its Jacobian (m, width). Raises GradientError if it has no derivatives."""
    if not any(isinstance(v, AutoDiffXd) for v in result):
        raise GradientError(f"{subject} lost its derivatives: write it as {form}")
    full = np.array([v if isinstance(v, AutoDiffXd) else AutoDiffXd(float(v)) for v in result])
    return ExtractValue(full.reshape(-1, 1)).ravel(), gradient_rows(full, width)


def short(values: Any) -> str:
    """Format an array on one line, by its numbers if they are few, and otherwise by its shape and range."""
    array = np.asarray(values)
    if array.size <= 8 or array.dtype.kind not in "fiu":
        return np.array2string(array, precision=4, separator=", ", max_line_width=1000).replace("\n", "")
    return f"<{array.shape} from {np.min(array):.4g} to {np.max(array):.4g}>"


def resolve_bounds(
    given: Bounds | None, defaults: Mapping[str, Array], state_names: Sequence[str], input_names: Sequence[str]
) -> Bounds:
    """Fill missing entries of `given` from `defaults` (by field name). Raises InputError if two limits cross."""
    if not (given is None or isinstance(given, Bounds)):
        raise InputError("bounds", got=type(given).__name__, expected="Bounds")
    resolved = {}
    for name, limits in defaults.items():
        value = getattr(given, name, None)
        checked = limits if value is None else array_with_gaps(name, value, limits.shape)
        resolved[name] = frozen(np.where(np.isnan(checked), limits, checked))
    for kind, names in (("x", state_names), ("u", input_names)):
        lower, upper = resolved[f"{kind}_lower"], resolved[f"{kind}_upper"]
        for i in np.flatnonzero((lower > upper) | (lower == np.inf) | (upper == -np.inf))[:1]:
            got = f"[{lower[i]:g}, {upper[i]:g}]"
            raise InputError(f"bounds of {names[i]}", got=got, expected="a lower bound of at most the upper bound")
    return Bounds(**resolved)


def plant_limits(model: Model) -> dict[str, Array]:
    """Return a model's own limits by the field names of `Bounds`.

    In models with closed loops, the limits of positions that no motor moves are omitted. A finger's link may rest on
    its limit, and Drake's force there is nearly rigid.
    """
    (q_lower, q_upper), (v_lower, v_upper) = model.position_limits, model.velocity_limits
    if model.file_facts.held_points:
        places, rates = single_coordinates(model)
        follows = np.ones(model.nq, dtype=bool)
        follows[places[np.any(model.actuation != 0, axis=1)[rates]]] = False
        q_lower, q_upper = np.where(follows, -np.inf, q_lower), np.where(follows, np.inf, q_upper)
    return {
        "x_lower": np.concatenate([q_lower, v_lower]),
        "x_upper": np.concatenate([q_upper, v_upper]),
        "u_lower": model.inputs.lower,
        "u_upper": model.inputs.upper,
    }


def check_inside(subject: str, values: Array, lower: Array, upper: Array, names: Sequence[str]) -> None:
    """Raise InputError if an entry of `values` (..., n), NaN where free, is beyond its limit (n,)."""
    rows = np.atleast_2d(values)
    for row, i in np.argwhere((rows < lower) | (rows > upper))[:1]:
        expected = f"within [{lower[i]:g}, {upper[i]:g}]"
        raise InputError(f"{subject}, {names[i]}", got=float(rows[row, i]), expected=expected)

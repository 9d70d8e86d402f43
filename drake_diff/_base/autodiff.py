"""AutoDiffXd in and out of NumPy, the chain rule for what we differentiate ourselves, and gradients by autograd.

A loss of a motion has as many variables as the motion has numbers. AutoDiffXd carries a derivative by each of them with
every number, so that its time grows with the square of the motion's length; autograd goes once forward and once back.
"""

import inspect
from collections.abc import Callable, Sequence
from functools import update_wrapper
from numbers import Real
from pathlib import Path
from typing import Any, NoReturn

import autograd.numpy
import numpy as np
from autograd import value_and_grad
from autograd.numpy.numpy_boxes import ArrayBox
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, InitializeAutoDiff

from drake_diff._base.arrays import FLOAT, NUMBERS, Array
from drake_diff._base.clock import TimeIsUpError
from drake_diff.exceptions import DrakeDiffError, GradientError, InputError, ShapeError

# AutoDiffXd carries a whole row of derivatives with every number; this many at a time keeps memory flat.
DIRECTIONS = 128
ORDINARY = "ordinary arithmetic and NumPy functions, without float()"
Shape = tuple[int | str, ...]


class UntraceableError(Exception):
    """A function does something that autograd cannot follow."""


def named(subject: str, function: Any) -> str:
    """What a user's function is, its name, and the file and line where it is known."""
    inner = inspect.unwrap(getattr(function, "func", function))  # of a partial, or of what was made of it
    code = getattr(inner, "__code__", None) or getattr(inner.__call__, "__code__", None)
    where = f" ({Path(code.co_filename).name}:{code.co_firstlineno})" if code else ""
    return f"{subject} {getattr(inner, '__name__', type(inner).__name__)}{where}"


def noted(subject: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a user's function returns that may end us by an error of its own, which gets a note with its name."""
    try:
        return function(*arguments)
    except Exception as error:
        error.add_note(f"raised by {named(subject, function)}")
        raise


def called(subject: str, function: Callable[..., Any], *arguments: Any, shape: Shape | None = None) -> Any:
    """What a user's function gives for plain numbers; any number or array of numbers where `shape` is None.

    InputError where it raises or gives no numbers, ShapeError where they are others, both with the function's name.
    """
    try:
        result = function(*arguments)
    except (DrakeDiffError, TimeIsUpError):
        raise
    except Exception as error:
        got = f"{type(error).__name__}: {error!s:.200}"
        raise InputError(named(subject, function), got=got, expected=_in_words(shape)) from error
    if type(result) is float or (type(result) is np.ndarray and result.dtype is FLOAT and result.shape == shape):
        return result  # as a rule
    try:
        array = np.asarray(result)
    except ValueError:  # rows of several lengths
        array = np.array(None)
    entries = array.flat if array.dtype.kind == "O" else ()
    if array.dtype.kind not in NUMBERS and not (entries and all(isinstance(e, (Real, AutoDiffXd)) for e in entries)):
        got = f"{type(result).__name__} {result!r:.80}"
        raise InputError(f"{named(subject, function)}: its result", got=got, expected=_in_words(shape))
    sizes = zip(array.shape, shape or (), strict=False)
    if shape is not None and (array.ndim != len(shape) or any(n != m and not isinstance(n, str) for m, n in sizes)):
        raise ShapeError(f"{named(subject, function)}: its {type(result).__name__}", got=array.shape, expected=shape)
    return result


def _in_words(shape: Shape | None) -> str:
    return "numbers" if shape is None else "one number" if shape == () else f"numbers of shape {list(shape)}"


def carrying(subject: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a user's function gives for AutoDiffXd; GradientError, with the function's name, where it raises."""
    try:
        return function(*arguments)
    except (DrakeDiffError, TimeIsUpError):
        raise
    except Exception as error:
        what = f"{named(subject, function)} lost its derivatives: {type(error).__name__}: {error!s:.200}"
        raise GradientError(f"{what}; write it with {ORDINARY}") from error


class UserFunction:
    """A user's function of arrays that is `called` with plain numbers and `carrying` with AutoDiffXd.

    Its first argument has `ndim` dimensions; whatever else is tried with it, symbols or many points, is as it was.
    """

    def __init__(self, subject: str, function: Any, shape: Shape | None, ndim: int):
        update_wrapper(self, function, updated=())
        self.subject, self.function, self.shape, self.ndim = subject, function, shape, ndim

    def __repr__(self) -> str:
        return repr(self.function)

    def __call__(self, *arguments: Any) -> Any:
        x = arguments[0]
        if isinstance(x, np.ndarray) and x.ndim == self.ndim:
            if x.dtype == FLOAT:
                return called(self.subject, self.function, *arguments, shape=self.shape)
            if x.size and isinstance(x.flat[0], AutoDiffXd):
                return carrying(self.subject, self.function, *arguments)
        return self.function(*arguments)


def user_function(subject: str, function: Any, shape: Shape | None = (), ndim: int = 1) -> Any:
    """A user's function as a `UserFunction`; what this package made, and what is no function, as it is."""
    ours = isinstance(function, UserFunction) or type(function).__module__.startswith("drake_diff.")
    if ours or not callable(function) or hasattr(function, "linearize"):
        return function
    return UserFunction(subject, function, shape, ndim)


def gradient_of(f: Callable[[Any], Any], z: Array) -> tuple[float, Array]:
    """(value, gradient (n,)) of the scalar `f` at `z` (n,) by AutoDiffXd.

    Raises GradientError where the result carries no derivative (float() was taken, or a constant returned) or
    is not finite.
    """
    gradient = np.zeros(len(z))
    value = 0.0
    for start in range(0, len(z), DIRECTIONS):
        active = slice(start, min(start + DIRECTIONS, len(z)))
        variables = np.array([AutoDiffXd(entry) for entry in z])
        variables[active] = InitializeAutoDiff(z[active]).ravel()
        with np.errstate(all="ignore"):  # what is not finite is refused below, whole
            result = np.asarray(carrying("function", f, variables)).ravel()
        if result.shape != (1,):
            raise InputError("loss", got=f"{len(result)} values", expected="one scalar")
        if not isinstance(result[0], AutoDiffXd):
            raise GradientError(
                "the loss lost its derivatives: it returned a plain number; write it with ordinary arithmetic and "
                "NumPy functions of xs and us, without float() or np.asarray(..., dtype=float)"
            )
        value, derivatives = result[0].value(), result[0].derivatives()
        gradient[active] = derivatives if len(derivatives) else 0.0
    if not (np.isfinite(value) and np.all(np.isfinite(gradient))):
        raise GradientError(f"the loss or its gradient is not finite, as that of a norm at zero: value {value}")
    return value, gradient


def gradient_rows(values: Any, width: int) -> Array:
    """(m, width): the derivatives of `values` (m,), which Drake leaves empty where they are all constants."""
    gradient = ExtractGradient(values.reshape(-1, 1))
    return np.asarray(gradient) if gradient.shape[1] else np.zeros((len(values), width))


def plain(values: Any) -> Array:
    """The values alone of an array of floats or AutoDiffXd, of any shape."""
    array = np.asarray(values)
    if array.dtype != object:
        return array.astype(float)
    return np.array([getattr(v, "value", lambda v=v: v)() for v in array.ravel()]).reshape(array.shape)


def _seed(z: Any) -> Array | None:
    """(n, m) the derivatives that `z` (n,) carries; None where they are the identity, as solvers seed it."""
    seeds = (entry.derivatives() for entry in z)  # one at a time: all of them are a matrix of n^2 numbers
    is_unit = (len(row) == len(z) and row[i] == 1.0 and np.count_nonzero(row) == 1 for i, row in enumerate(seeds))
    return None if all(is_unit) else np.asarray(ExtractGradient(z.reshape(-1, 1)))


def chain(value: float, gradient: Array, z: Any) -> AutoDiffXd:
    """The AutoDiffXd of a scalar of `z` (n,) whose value and gradient (n,) by z are known."""
    seed = _seed(z)
    return AutoDiffXd(value, gradient if seed is None else gradient @ seed)


def chain_rows(values: Array, jacobian: Array, z: Any) -> Any:
    """(m,) AutoDiffXd of a function of `z` (n,) whose values (m,) and Jacobian (m, n) by z are known.

    Solvers seed z with the identity, and the product with it is left out: for it BLAS starts threads, which on a busy
    machine costs more than all the rest.
    """
    seed = _seed(z)
    gradient = jacobian if seed is None else jacobian @ seed
    return InitializeAutoDiff(value=values.reshape(-1, 1), gradient=gradient).ravel()


class TracedArray(ArrayBox):  # type: ignore[misc]  # autograd has no types
    """autograd's array, on which functions of `numpy` act as those of `autograd.numpy` do.

    autograd passes on NumPy's elementwise functions; this adds the others, and refuses assignments, after which the
    result would be that of another function.
    """

    __slots__ = ()

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> Any:
        module = autograd.numpy.linalg if function.__module__ == "numpy.linalg" else autograd.numpy
        known = getattr(module, function.__name__, None)
        return NotImplemented if known is None else known(*args, **options)

    def dot(self, other: Any) -> Any:
        """As `numpy.dot`."""
        return autograd.numpy.dot(self, other)

    def copy(self) -> Any:
        """Itself, as nothing can be assigned to it."""
        return self

    def _refuse(self, *_: Any) -> NoReturn:
        raise UntraceableError("an assignment into a differentiated array")

    __setitem__ = __iadd__ = __isub__ = __imul__ = __itruediv__ = __ipow__ = __imatmul__ = _refuse


for _kind in [kind for kind, box in ArrayBox.type_mappings.items() if box is ArrayBox and kind is not ArrayBox]:
    TracedArray.register(_kind)


def traced_gradient(f: Callable[..., Any], arrays: Sequence[Array]) -> tuple[float, list[Array]]:
    """The scalar f(*arrays) and its gradient by each of the arrays.

    Raises UntraceableError, or what autograd, NumPy or `f` itself raises, where autograd cannot follow `f`.
    """

    def traced(*variables: Any) -> Any:
        result = f(*variables)
        if isinstance(result, np.ndarray):  # of one traced number
            result = result.item()
        if not isinstance(result, TracedArray):
            raise UntraceableError("the result does not depend on the differentiated arguments")
        return result

    value, gradients = value_and_grad(traced, argnum=tuple(range(len(arrays))))(*arrays)
    return float(value.item()), list(gradients)

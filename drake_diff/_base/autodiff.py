"""Conversion between AutoDiffXd and NumPy, the chain rule for known derivatives, and gradients by autograd.

A loss of a motion depends on every number of the motion. AutoDiffXd stores all the derivatives in each number, so its
time grows with the square of the motion's length. autograd needs only one forward and one reverse pass.
"""

import inspect
import sys
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

# AutoDiffXd stores a row of derivatives in every number; this block size keeps the memory constant.
DIRECTIONS = 128
ORDINARY = "ordinary arithmetic and NumPy functions, without float()"
Shape = tuple[int | str, ...]


class UntraceableError(Exception):
    """A function performs an operation that autograd cannot differentiate."""


def named(subject: str, function: Any) -> str:
    """Return `subject` and the name of a user's function, with its file and line if they are known."""
    inner = inspect.unwrap(getattr(function, "func", function))  # unwrap partials and wrappers
    code = getattr(inner, "__code__", None) or getattr(inner.__call__, "__code__", None)
    where = f" ({Path(code.co_filename).name}:{code.co_firstlineno})" if code else ""
    return f"{subject} {getattr(inner, '__name__', type(inner).__name__)}{where}"


def noted(subject: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a user's function and return its result; an exception that it raises gets a note with its name."""
    try:
        return function(*arguments)
    except Exception as error:
        error.add_note(f"raised by {named(subject, function)}")
        raise


def called(subject: str, function: Callable[..., Any], *arguments: Any, shape: Shape | None = None) -> Any:
    """Call a user's function with plain numbers and check its result; `shape` None allows a number or any array.

    Raises InputError if it raises or its result is not numeric, and ShapeError if the shape is wrong. Both name it.
    """
    try:
        result = function(*arguments)
    except (DrakeDiffError, TimeIsUpError):
        raise
    except Exception as error:
        got = f"{type(error).__name__}: {error!s:.200}"
        raise InputError(named(subject, function), got=got, expected=_in_words(shape)) from error
    if type(result) is float or (type(result) is np.ndarray and result.dtype is FLOAT and result.shape == shape):
        return result  # the usual case
    try:
        array = np.asarray(result)
    except ValueError:  # rows of different lengths
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
    """Call a user's function with AutoDiffXd arguments; raise GradientError with its name if it raises.

    A function that is written in JAX is differentiated by JAX.
    """
    try:
        return function(*arguments)
    except (DrakeDiffError, TimeIsUpError):
        raise
    except Exception as error:
        if returns_jax(subject, function, *map(plain, arguments)):
            return chained_by_jax(function, *arguments)
        what = f"{named(subject, function)} lost its derivatives: {type(error).__name__}: {error!s:.200}"
        raise GradientError(f"{what}; write it with {ORDINARY}") from error


def returns_jax(subject: str, function: Callable[..., Any], *arguments: Any) -> bool:
    """Return whether a function of arrays of numbers is written in JAX, or calls a user's function that is.

    Raises InputError for a result in single precision.
    """
    if "jax" not in sys.modules:
        return False
    before = UserFunction.calls_in_jax
    try:
        result = function(*arguments)
    except InputError:
        raise
    except Exception:  # the caller reports the error of its own call
        return False
    return _has_arrays_of_jax(subject, function, result) or UserFunction.calls_in_jax > before


def _has_arrays_of_jax(subject: str, function: Callable[..., Any], result: Any) -> bool:
    """Return whether a result is an array of JAX or a list with one; raise InputError for single precision."""
    if "jax" not in sys.modules:
        return False
    entries = result if isinstance(result, (list, tuple)) else [result]
    arrays = [entry for entry in entries if isinstance(entry, sys.modules["jax"].Array)]
    for array in arrays:
        if array.dtype.kind == "f" and array.dtype != FLOAT:
            expected = 'double precision: jax.config.update("jax_enable_x64", True)'
            raise InputError(named(subject, function), got=f"a JAX array of {array.dtype}", expected=expected)
    return bool(arrays)


def chained_by_jax(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of a function written in JAX with the derivatives that its arguments carry.

    It is not compiled, since compiled code would keep the globals and attributes that it read at first.
    """
    jax: Any = sys.modules["jax"]

    def twice(*arguments: Any) -> Any:
        result = jax.numpy.asarray(function(*arguments), dtype=float)
        return result, result

    positions = tuple(range(len(arguments)))
    jacobians, value = jax.jacrev(twice, argnums=positions, has_aux=True)(*map(plain, arguments))
    variables = np.concatenate([np.ravel(argument) for argument in arguments]) + AutoDiffXd(0.0)
    columns = [np.asarray(j).reshape(value.size, -1) for j in jacobians]
    rows = chain_rows(np.ravel(value), np.hstack(columns), variables)
    return rows.reshape(value.shape) if value.ndim else rows[0]


class UserFunction:
    """A user's function of arrays, called by `called` for plain numbers and by `carrying` for AutoDiffXd.

    Its first argument has `ndim` dimensions. Other arguments, such as symbols or batches, are passed on unchanged.
    """

    calls_in_jax = 0  # calls for plain numbers with a result of JAX, by which functions of such functions are known

    def __init__(self, subject: str, function: Any, shape: Shape | None, ndim: int):
        update_wrapper(self, function, updated=())
        self.subject, self.function, self.shape, self.ndim = subject, function, shape, ndim
        self._is_in_jax = False

    def __repr__(self) -> str:
        return repr(self.function)

    def __call__(self, *arguments: Any) -> Any:
        x = arguments[0]
        if isinstance(x, np.ndarray) and x.ndim == self.ndim:
            if x.dtype == FLOAT:
                result = called(self.subject, self.function, *arguments, shape=self.shape)
                if type(result) is not float and _has_arrays_of_jax(self.subject, self.function, result):
                    UserFunction.calls_in_jax += 1
                    self._is_in_jax = True
                return result
            if x.size and isinstance(x.flat[0], AutoDiffXd):
                if self._is_in_jax:  # known from a call for plain numbers
                    return chained_by_jax(self.function, *arguments)
                return carrying(self.subject, self.function, *arguments)
        return self.function(*arguments)


def user_function(subject: str, function: Any, shape: Shape | None = (), ndim: int = 1) -> Any:
    """Wrap a user's function in `UserFunction`; return functions of this package and other objects unchanged."""
    defined_in = getattr(function, "__module__", None) or "", type(function).__module__
    ours = isinstance(function, UserFunction) or any(module.startswith("drake_diff.") for module in defined_in)
    if ours or not callable(function) or hasattr(function, "linearize"):
        return function
    return UserFunction(subject, function, shape, ndim)


def gradient_of(f: Callable[[Any], Any], z: Array) -> tuple[float, Array]:
    """Return (value, gradient (n,)) of the scalar function `f` at `z` (n,) by AutoDiffXd.

    Raises GradientError if the result has no derivatives (because of float() or a constant result) or is not
    finite.
    """
    gradient = np.zeros(len(z))
    value = 0.0
    for start in range(0, len(z), DIRECTIONS):
        active = slice(start, min(start + DIRECTIONS, len(z)))
        variables = np.array([AutoDiffXd(entry) for entry in z])
        variables[active] = InitializeAutoDiff(z[active]).ravel()
        with np.errstate(all="ignore"):  # results that are not finite are refused below
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
        raise GradientError(f"the loss or its gradient is not finite, like the gradient of a norm at 0: loss {value}")
    return value, gradient


def gradient_rows(values: Any, width: int) -> Array:
    """Return the derivatives (m, width) of `values` (m,); Drake leaves them empty if all values are constant."""
    gradient = ExtractGradient(values.reshape(-1, 1))
    return np.asarray(gradient) if gradient.shape[1] else np.zeros((len(values), width))


def plain(values: Any) -> Array:
    """Return the values of an array of floats or AutoDiffXd of any shape, without derivatives."""
    array = np.asarray(values)
    if array.dtype != object:
        return array.astype(float)
    return np.array([getattr(v, "value", lambda v=v: v)() for v in array.ravel()]).reshape(array.shape)


def _seed(z: Any) -> Array | None:
    """Return the derivatives (n, m) in `z` (n,), or None if they are the identity, as solvers seed them."""
    seeds = (entry.derivatives() for entry in z)  # lazy, since all derivatives together are a matrix of n^2 numbers
    is_unit = (len(row) == len(z) and row[i] == 1.0 and np.count_nonzero(row) == 1 for i, row in enumerate(seeds))
    return None if all(is_unit) else np.asarray(ExtractGradient(z.reshape(-1, 1)))


def chain(value: float, gradient: Array, z: Any) -> AutoDiffXd:
    """Return the AutoDiffXd of a scalar function of `z` (n,) from its value and its gradient (n,) with respect to z."""
    seed = _seed(z)
    return AutoDiffXd(value, gradient if seed is None else gradient @ seed)


def chain_rows(values: Array, jacobian: Array, z: Any) -> Any:
    """Return AutoDiffXd (m,) of a function of `z` (n,) from its values (m,) and its Jacobian (m, n) in z.

    Solvers seed z with the identity. The product with the identity is skipped, because BLAS would start threads for it,
    which on a busy machine takes longer than the rest of the function.
    """
    seed = _seed(z)
    gradient = jacobian if seed is None else jacobian @ seed
    return InitializeAutoDiff(value=values.reshape(-1, 1), gradient=gradient).ravel()


class TracedArray(ArrayBox):  # type: ignore[misc]  # autograd has no types
    """An autograd array on which functions of `numpy` act like those of `autograd.numpy`.

    autograd already handles NumPy's elementwise functions. This class adds the other functions. It refuses assignments,
    because autograd would then differentiate a different function.
    """

    __slots__ = ()

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> Any:
        module = autograd.numpy.linalg if function.__module__ == "numpy.linalg" else autograd.numpy
        known = getattr(module, function.__name__, None)
        return NotImplemented if known is None else known(*args, **options)

    def dot(self, other: Any) -> Any:
        """Return the product, as `numpy.dot` does."""
        return autograd.numpy.dot(self, other)

    def copy(self) -> Any:
        """Return the array itself, since it is immutable."""
        return self

    def _refuse(self, *_: Any) -> NoReturn:
        raise UntraceableError("an assignment into a differentiated array")

    __setitem__ = __iadd__ = __isub__ = __imul__ = __itruediv__ = __ipow__ = __imatmul__ = _refuse


for _kind in [kind for kind, box in ArrayBox.type_mappings.items() if box is ArrayBox and kind is not ArrayBox]:
    TracedArray.register(_kind)


def traced_gradient(f: Callable[..., Any], arrays: Sequence[Array]) -> tuple[float, list[Array]]:
    """Return the scalar f(*arrays) and its gradients with respect to each array.

    Raises UntraceableError, or an error of autograd, NumPy or `f`, if autograd cannot differentiate `f`.
    """

    def traced(*variables: Any) -> Any:
        result = f(*variables)
        if isinstance(result, np.ndarray):  # a 0-d array with one traced number
            result = result.item()
        if not isinstance(result, TracedArray):
            raise UntraceableError("the result does not depend on the differentiated arguments")
        return result

    value, gradients = value_and_grad(traced, argnum=tuple(range(len(arrays))))(*arrays)
    return float(value.item()), list(gradients)

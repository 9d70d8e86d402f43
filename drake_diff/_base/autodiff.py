"""AutoDiffXd in and out of NumPy, the chain rule for what we differentiate ourselves, and gradients by autograd.

A loss of a motion has as many variables as the motion has numbers. AutoDiffXd carries a derivative by each of them with
every number, so that its time grows with the square of the motion's length; autograd goes once forward and once back.
"""

from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import autograd.numpy
import numpy as np
from autograd import value_and_grad
from autograd.numpy.numpy_boxes import ArrayBox
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, InitializeAutoDiff

from drake_diff._base.arrays import Array
from drake_diff.exceptions import GradientError, InputError

# AutoDiffXd carries a whole row of derivatives with every number; this many at a time keeps memory flat.
DIRECTIONS = 128


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
            try:
                result = np.asarray(f(variables)).ravel()
            except TypeError as error:
                if "AutoDiffXd" not in str(error):
                    raise
                raise GradientError(f"the loss lost its derivatives: {error}") from error
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
        raise GradientError(f"the loss or its gradient is not finite: value {value}")
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


class UntraceableError(Exception):
    """A function does something that autograd cannot follow."""


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
        raise UntraceableError("an assignment to what is differentiated")

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
            raise UntraceableError("the result does not depend on what is differentiated")
        return result

    value, gradients = value_and_grad(traced, argnum=tuple(range(len(arrays))))(*arrays)
    return float(value.item()), list(gradients)

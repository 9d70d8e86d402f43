"""The gradient of a scalar function of whole arrays by autograd, which NumPy's own functions are passed on to.

A loss of a motion has as many variables as the motion has numbers. AutoDiffXd carries a derivative by each of them with
every number, so that its time grows with the square of the motion's length; autograd goes once forward and once back.
"""

from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import autograd.numpy
import numpy as np
from autograd import value_and_grad
from autograd.numpy.numpy_boxes import ArrayBox

from drake_diff._base.arrays import Array


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

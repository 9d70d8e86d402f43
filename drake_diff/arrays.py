"""Arrays that come from users: shape and finiteness checked once, then read-only."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff.exceptions import InputError, NonFiniteError, ShapeError

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def frozen(values: ArrayLike) -> Array:
    """A read-only float copy of `values`."""
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array


def finite_array(subject: str, values: Any, shape: Sequence[int | str]) -> Array:
    """`values` as a read-only float array of `shape`, whose named dimensions ("N") may have any size.

    Raises ShapeError, NonFiniteError, or InputError where `values` holds no numbers.
    """
    array = _array(subject, values, shape)
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise NonFiniteError(subject, index=index, got=float(array[index]))
    return array


def array_with_gaps(subject: str, values: Any, shape: Sequence[int | str]) -> Array:
    """Like `finite_array`, where NaN and infinity have a meaning (a free goal entry, no bound)."""
    return _array(subject, values, shape)


def _array(subject: str, values: Any, shape: Sequence[int | str]) -> Array:
    try:
        if np.iscomplexobj(values):
            raise TypeError("complex")
        array = frozen(values)
    except (TypeError, ValueError) as error:
        raise InputError(subject, got=repr(values)[:80], expected="an array of numbers") from error
    matches = array.ndim == len(shape) and all(
        isinstance(want, str) or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not matches:
        raise ShapeError(subject, got=array.shape, expected=tuple(shape))
    return array


def positive_int(subject: str, value: Any) -> int:
    """`value` as an int of at least 1."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(subject, got=repr(value), expected="a whole number of at least 1")
    return int(value)


def positive_float(subject: str, value: Any) -> float:
    """`value` as a finite float above 0."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise InputError(subject, got=repr(value), expected="a number above 0")
    if not (np.isfinite(value) and value > 0):
        raise InputError(subject, got=repr(value), expected="a finite number above 0")
    return float(value)

"""Arrays and numbers that come from users, checked once; cross products of many vectors at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import accumulate, pairwise
from math import hypot, isfinite
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff.exceptions import InputError, NonFiniteError, ShapeError

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
FLOAT = np.dtype(float)
NUMBERS = "fiub"  # the kinds of NumPy's types that are: floats, integers, booleans
LARGEST, LARGEST_COUNT = float(np.finfo(float).max), 2**31 - 1  # what a double holds; an int of the solvers
MOST_STEPS = 10_000_000  # of a motion: each has a state and an input, at least
LARGEST_SEED = 2**64  # of NumPy's generators, which are also given the seeds of 32 bits that others make
SHORTEST, LONGEST = 1e-12, 1e6  # [s]


def frozen(values: ArrayLike) -> Array:
    """A read-only float copy of `values`."""
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array


def finite_array(subject: str, values: Any, shape: Sequence[int | str]) -> Array:
    """`values` as a read-only float array of `shape`, whose named dimensions ("N") may have any size.

    Raises ShapeError, NonFiniteError, or InputError where `values` holds no numbers.
    """
    array = array_with_gaps(subject, values, shape)
    if array.ndim == 1 and isfinite(hypot(*array.tolist())):
        return array  # in a fraction of the time of looking at each
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise NonFiniteError(subject, index=index, got=float(array[index]))
    return array


def array_with_gaps(subject: str, values: Any, shape: Sequence[int | str]) -> Array:
    """Like `finite_array`, where NaN and infinity have a meaning (a free goal entry, no bound)."""
    if type(values) is np.ndarray and values.dtype is FLOAT and values.shape == shape:
        return frozen(values)  # as a rule; what follows takes three times as long
    array = _of_numbers(subject, values)
    if array.ndim != len(shape) or any(
        not isinstance(n, str) and n != m for m, n in zip(array.shape, shape, strict=True)
    ):
        raise ShapeError(subject, got=array.shape, expected=tuple(shape))
    return array


def _of_numbers(subject: str, values: Any) -> Array:
    """`values` as a read-only float array, None being NaN; NumPy alone takes dates, texts and what a mask hides."""
    try:
        array = np.array(values)
        plain = array.dtype.kind in NUMBERS or (
            array.dtype.kind == "O" and all(entry is None or isinstance(entry, Real) for entry in array.flat)
        )
        if not plain or isinstance(values, np.ma.MaskedArray):
            raise TypeError("no numbers")
        return frozen(array)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(subject, got=f"{values!r:.80}", expected="an array of numbers") from error


def count(subject: str, value: Any, least: int, most: int = LARGEST_COUNT) -> int:
    """`value` as an int of at least `least` and at most `most`."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.timedelta64))
    if not whole or not least <= value <= most:
        limit = f" and at most {most}" if whole and value > most else ""
        raise InputError(subject, got=f"{value!r:.80}", expected=f"a whole number of at least {least}{limit}")
    return int(value)


def number_of_steps(value: Any) -> int:
    """`value`, the argument num_steps of a motion, as an int of at least 1."""
    return count("num_steps", value, 1, MOST_STEPS)


def positive_int(subject: str, value: Any) -> int:
    """`value` as an int of at least 1."""
    return count(subject, value, 1)


def positive_float(subject: str, value: Any) -> float:
    """`value` as a finite float above 0."""
    number = isinstance(value, (int, float, np.integer, np.floating))
    if not number or isinstance(value, (bool, np.timedelta64)):
        raise InputError(subject, got=f"{value!r:.80}", expected="a number above 0")
    if not 0 < value <= LARGEST:
        raise InputError(subject, got=f"{value!r:.80}", expected="a finite number above 0")
    return float(value)


def seconds(subject: str, value: Any) -> float:
    """`value` as a float that a time step or a horizon can be [s]: others under- or overflow when they are squared."""
    number = positive_float(subject, value)
    if not SHORTEST <= number <= LONGEST:
        raise InputError(subject, got=number, expected=f"a number from {SHORTEST:g} to {LONGEST:g}")
    return number


def fraction(subject: str, value: float) -> float:
    """`value` where it is at least 0 and less than 1."""
    if not 0 <= value < 1:
        raise InputError(subject, got=value, expected="a number from 0 to less than 1")
    return float(value)


def scale(subject: str, value: ArrayLike, size: int) -> Array:
    """`value`, a number or (size,), as a read-only (size,)."""
    if np.ndim(value) == 0:
        return frozen(np.full(size, finite_array(subject, value, ())))
    return finite_array(subject, value, (size,))


def own_array(array: Any) -> Any:
    """A copy that is contiguous and may be written: for other arrays what is compiled would be compiled once more."""
    return np.array(array, order="C")


_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
_SKEW = np.zeros((3, 9))  # w -> skew(w), flattened
for _row, _column, _entry, _sign in ((0, 1, 2, -1), (0, 2, 1, 1), (1, 2, 0, -1)):
    _SKEW[_entry, 3 * _row + _column] = _sign
    _SKEW[_entry, 3 * _column + _row] = -_sign


def slices_of(lengths: Iterable[int]) -> tuple[slice, ...]:
    """Where parts of these lengths stand, one after the other."""
    return tuple(slice(a, b) for a, b in pairwise(accumulate(lengths, initial=0)))


def skew(w: Array) -> Array:
    """(..., 3, 3) with skew(w) x = w x x, at w (..., 3)."""
    return np.asarray((w @ _SKEW).reshape(*w.shape[:-1], 3, 3))


def cross(a: Array, b: Array) -> Array:
    """a x b of vectors (..., 3), broadcast."""
    return np.asarray(a.take(_NEXT, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_NEXT, -1))

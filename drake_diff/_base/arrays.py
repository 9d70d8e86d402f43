"""Validation of arrays and numbers that users pass, and vectorized cross products."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate, pairwise
from math import hypot, isfinite
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff.exceptions import InputError, NonFiniteError, ShapeError

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Shape = tuple[int, ...]
Entries = Mapping[str, tuple[int | str, ...]]  # the last dimensions of named arrays
FLOAT = np.dtype(float)
NUMBERS = "fiub"  # NumPy's kinds of numeric types: floats, integers, booleans
LARGEST, LARGEST_COUNT = float(np.finfo(float).max), 2**31 - 1  # the largest double; the largest int of the solvers
MOST_STEPS = 10_000_000  # the maximum number of steps in a motion; each has at least a state and an input
LARGEST_SEED = 2**64  # the limit of NumPy's generators, which also accept the 32-bit seeds of other generators
SHORTEST, LONGEST = 1e-12, 1e6  # [s]


def frozen(values: ArrayLike) -> Array:
    """Return a read-only float copy of `values`."""
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array


def finite_array(subject: str, values: Any, shape: Sequence[int | str]) -> Array:
    """Return `values` as a read-only float array of `shape`, whose named dimensions ("N") may have any size.

    Raises ShapeError, NonFiniteError, or InputError if `values` is not numeric.
    """
    array = array_with_gaps(subject, values, shape)
    if array.ndim == 1 and isfinite(hypot(*array.tolist())):
        return array  # much faster than checking each entry
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise NonFiniteError(subject, index=index, got=float(array[index]))
    return array


def array_with_gaps(subject: str, values: Any, shape: Sequence[int | str]) -> Array:
    """Return the array like `finite_array`, but allow NaN and infinity (a free goal entry, no bound)."""
    if type(values) is np.ndarray and values.dtype is FLOAT and values.shape == shape:
        return frozen(values)  # the usual case; the general path below takes three times as long
    array = _of_numbers(subject, values)
    if array.ndim != len(shape) or any(
        not isinstance(n, str) and n != m for m, n in zip(array.shape, shape, strict=True)
    ):
        raise ShapeError(subject, got=array.shape, expected=tuple(shape))
    return array


def _of_numbers(subject: str, values: Any) -> Array:
    """Return `values` as a read-only float array with None as NaN; refuse dates, strings and masked arrays."""
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


def broadcast_shapes(entries: Entries, shapes: Sequence[Shape]) -> list[Shape]:
    """Return shapes with equal leading dimensions for named arrays, of which `entries` are the last dimensions.

    A dimension "N" has any size of at least 1. Raises ShapeError or InputError if a shape does not fit.
    """
    batches, ends = [], []
    for (name, entry), shape in zip(entries.items(), shapes, strict=False):  # inputs may be omitted
        split = max(0, len(shape) - len(entry))
        batches.append(shape[:split])
        ends.append(shape[split:])
        sizes = zip(ends[-1], entry, strict=False)
        if len(ends[-1]) < len(entry) or any(n < 1 if m == "N" else n != m for n, m in sizes):
            raise ShapeError(name, got=shape, expected=("...", *entry))
    try:
        batch = batches[0] if all(b == batches[0] for b in batches) else np.broadcast_shapes(*batches)
    except ValueError as error:
        got, expected = f"leading dimensions {batches}", "dimensions that can be broadcast"
        raise InputError(", ".join(entries), got=got, expected=expected) from error
    if 0 in batch:
        raise InputError(", ".join(entries), got=f"a batch of {batch}", expected="at least one entry in a batch")
    return [(*batch, *end) for end in ends]


def count(subject: str, value: Any, least: int, most: int = LARGEST_COUNT) -> int:
    """Return `value` as an int of at least `least` and at most `most`."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.timedelta64))
    if not whole or not least <= value <= most:
        limit = f" and at most {most}" if whole and value > most else ""
        raise InputError(subject, got=f"{value!r:.80}", expected=f"a whole number of at least {least}{limit}")
    return int(value)


def number_of_steps(value: Any) -> int:
    """Return `value`, the argument num_steps of a motion, as an int of at least 1."""
    return count("num_steps", value, 1, MOST_STEPS)


def positive_int(subject: str, value: Any) -> int:
    """Return `value` as an int of at least 1."""
    return count(subject, value, 1)


def positive_float(subject: str, value: Any) -> float:
    """Return `value` as a finite float above 0."""
    number = isinstance(value, (int, float, np.integer, np.floating))
    if not number or isinstance(value, (bool, np.timedelta64)):
        raise InputError(subject, got=f"{value!r:.80}", expected="a number above 0")
    if not 0 < value <= LARGEST:
        raise InputError(subject, got=f"{value!r:.80}", expected="a finite number above 0")
    return float(value)


def seconds(subject: str, value: Any) -> float:
    """Return a time step or horizon [s] as a float; outside the limits, its square could under- or overflow."""
    number = positive_float(subject, value)
    if not SHORTEST <= number <= LONGEST:
        raise InputError(subject, got=number, expected=f"a number from {SHORTEST:g} to {LONGEST:g}")
    return number


def fraction(subject: str, value: float) -> float:
    """Return `value` as a float if it is at least 0 and less than 1, or raise InputError."""
    if not 0 <= value < 1:
        raise InputError(subject, got=value, expected="a number from 0 to less than 1")
    return float(value)


def scale(subject: str, value: ArrayLike, size: int) -> Array:
    """Return `value`, a number or (size,), as a read-only array (size,)."""
    if np.ndim(value) == 0:
        return frozen(np.full(size, finite_array(subject, value, ())))
    return finite_array(subject, value, (size,))


def own_array(array: Any) -> Any:
    """Return a contiguous, writable copy; Numba would compile a function again for any other memory layout."""
    return np.array(array, order="C")


_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
_SKEW = np.zeros((3, 9))  # w -> skew(w), flattened
for _row, _column, _entry, _sign in ((0, 1, 2, -1), (0, 2, 1, 1), (1, 2, 0, -1)):
    _SKEW[_entry, 3 * _row + _column] = _sign
    _SKEW[_entry, 3 * _column + _row] = -_sign


def slices_of(lengths: Iterable[int]) -> tuple[slice, ...]:
    """Return the slices of consecutive parts with these lengths."""
    return tuple(slice(a, b) for a, b in pairwise(accumulate(lengths, initial=0)))


def skew(w: Array) -> Array:
    """Return skew(w) (..., 3, 3), with skew(w) x = w x x, for w (..., 3)."""
    return np.asarray((w @ _SKEW).reshape(*w.shape[:-1], 3, 3))


def cross(a: Array, b: Array) -> Array:
    """Return the cross products a x b of vectors (..., 3), with broadcasting."""
    return np.asarray(a.take(_NEXT, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_NEXT, -1))

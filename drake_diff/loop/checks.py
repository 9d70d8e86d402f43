"""Checks of the numbers that describe a loop."""

import numpy as np
from numpy.typing import ArrayLike

from drake_diff.arrays import Array, finite_array
from drake_diff.exceptions import InputError


def count(subject: str, value: int, least: int) -> int:
    """`value` where it is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise InputError(subject, got=value, expected=f"a whole number of at least {least}")
    return int(value)


def part(subject: str, value: float) -> float:
    """`value` where it is at least 0 and less than 1."""
    if not 0 <= value < 1:
        raise InputError(subject, got=value, expected="a number from 0 to less than 1")
    return float(value)


def scale(subject: str, value: ArrayLike, size: int) -> Array:
    """`value`, a number or (size,), as (size,)."""
    if np.ndim(value) == 0:
        return np.full(size, finite_array(subject, value, ()))
    return finite_array(subject, value, (size,))

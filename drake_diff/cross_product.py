"""The cross product, of many vectors at once."""

import numpy as np

from drake_diff.arrays import Array

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
_SKEW = np.zeros((3, 9))  # w -> skew(w), flattened
for _row, _column, _entry, _sign in ((0, 1, 2, -1), (0, 2, 1, 1), (1, 2, 0, -1)):
    _SKEW[_entry, 3 * _row + _column] = _sign
    _SKEW[_entry, 3 * _column + _row] = -_sign


def skew(w: Array) -> Array:
    """(..., 3, 3) with skew(w) x = w x x, at w (..., 3)."""
    return np.asarray((w @ _SKEW).reshape(*w.shape[:-1], 3, 3))


def cross(a: Array, b: Array) -> Array:
    """a x b of vectors (..., 3), broadcast."""
    return np.asarray(a.take(_NEXT, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_NEXT, -1))

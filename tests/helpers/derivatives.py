"""Derivatives of functions by AutoDiffXd, and wrong ones."""

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff


def scaled(matrix, entry, factor=1.01):
    """Return a copy with one entry multiplied by `factor`."""
    copy = np.array(matrix)
    copy[entry] *= factor
    return copy


def differentiate(function, x, u=None):
    """Return (values, Jacobian with respect to x, or to x and u)."""
    z = InitializeAutoDiff(x if u is None else np.concatenate([x, u])).ravel()
    result = function(z) if u is None else function(z[: len(x)], z[len(x) :])
    return ExtractValue(result).ravel(), ExtractGradient(result)

"""Checks of a fit by its intervals."""

import numpy as np


def assert_known(fit, name, truth, width=np.inf):
    """Check that the fit explains the recordings, and that the interval has the truth and is narrower than `width`."""
    low, high = fit.intervals[name]
    assert low < truth < high < low + width, (name, low, high)
    assert fit.explained, fit

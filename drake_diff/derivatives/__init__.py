"""Jacobians of steps, and the methods that compute them."""

from drake_diff._base import attach_stub as _attach_stub

__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)

# Methods to differentiate a step, defined in this module so that a help text can list them without importing Drake.
METHODS = ("auto", "analytic", "autodiff", "implicit", "finite_difference")

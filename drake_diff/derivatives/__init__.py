"""Jacobians of steps, and the way each was obtained."""

from drake_diff._base import attach_stub as _attach_stub

__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)

# Ways to differentiate a step; here, so that a help text can list them without Drake.
METHODS = ("auto", "analytic", "autodiff", "implicit", "finite_difference")

"""Planning from a robot file to a verified plan: load, repair, choose a goal, guess, solve, save, verify."""

from drake_diff._base import attach_stub as _attach_stub

__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)

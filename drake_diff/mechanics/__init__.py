"""Kinematics, dynamics and distances of a tree of bodies, and their derivatives, implemented without Drake."""

from drake_diff._base import attach_stub as _attach_stub

__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)

"""Legged robots: their feet, postures by inverse kinematics, contact forces, and motions."""

from drake_diff._base import attach_stub as _attach_stub

__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)

"""Trajectory optimization on Drake with gradients that are checked before they are used."""

import sys as _sys

from drake_diff import lazy as _lazy

__all__ = tuple(_lazy.PLACES)
_sys.modules[__name__].__class__ = _lazy.Package

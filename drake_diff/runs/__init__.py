"""Directories of runs: measure a solution, write it, read it, verify it, list it, show it; and records."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

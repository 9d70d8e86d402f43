"""Run directories and records: measure, save, load, verify, list and display solutions."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

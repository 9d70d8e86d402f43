"""Records: what a run, a comparison, robustness trials or a certification say of themselves, sealed by their hash."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

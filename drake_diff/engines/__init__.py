"""The same model in other simulators: one module per simulator, one protocol for all."""

from drake_diff._base import attach_stub as _attach_stub

__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)

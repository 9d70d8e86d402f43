"""A robot file or diagram as a discrete plant: its state, inputs, parameters, contract, and one step."""

from drake_diff._base.lazy import attach_stub as _attach_stub

__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)

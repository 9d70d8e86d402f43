"""From a problem to a solution: collocation, shooting and iLQR, each solution measured again."""

from drake_diff._base import attach_stub as _attach_stub

__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)

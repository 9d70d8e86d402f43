"""Certificates of derivatives, and audits of models for properties that prevent derivatives."""

from drake_diff._base import attach_stub as _attach_stub

__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)

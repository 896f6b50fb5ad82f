"""Monitoring of a running loop: residuals against a model, and live values for other processes."""

from vtbdrake.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)

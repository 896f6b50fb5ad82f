"""Section 6: the testbed as the controller of the real machine."""

from vtbdrake.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)

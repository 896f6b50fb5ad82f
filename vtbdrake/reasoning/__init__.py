"""Section 5: the running robot asks its own testbed."""

from vtbdrake.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)

"""Section 6: the testbed as the controller of the real machine."""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)

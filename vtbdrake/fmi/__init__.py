"""FMI 3.0: functional mock-up units as Drake systems, and testbeds as functional mock-up units."""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)

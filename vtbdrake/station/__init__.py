"""Stations: scenarios that a file of Drake's ``hardware_sim`` describes, with the protocol of their real drivers."""

from vtbdrake.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)

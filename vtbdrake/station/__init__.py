"""Stations: scenarios that a file of Drake's ``hardware_sim`` describes, with the protocol of their real drivers."""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)

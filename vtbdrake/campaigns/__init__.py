"""Campaigns: a table of scenarios and conditions, each cell rolled out, kept in a file and reported."""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)

"""The live pages: a running testbed, or a study, is watched and steered in a web browser."""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)

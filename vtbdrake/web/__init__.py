"""The live pages: a running testbed, or a study, is watched and steered in a web browser."""

from vtbdrake.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)

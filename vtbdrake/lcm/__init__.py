"""LCM: the bridge between a testbed and a real machine, the codecs of its messages, and a hub for tcpq."""

from vtbdrake.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)

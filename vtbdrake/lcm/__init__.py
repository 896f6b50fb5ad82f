"""LCM: the bridge between a testbed and a real machine, the codecs of its messages, and a hub for tcpq."""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)

"""Testbeds as environments for reinforcement learning, by the interface of Gymnasium."""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)

"""Drake's cart-pole, swung up by a plan of forces that is decided while it moves."""

from vtbdrake_diagrams.cart_pole.scenario import CartPoleScenario

__all__ = ["CartPoleScenario"]

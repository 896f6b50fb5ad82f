"""The surroundings of a robot that its sensors depend on: light and haze."""

from vtbdrake.components.environment.haze import Haze
from vtbdrake.components.environment.light import Light, LightConfig

__all__ = ["Haze", "Light", "LightConfig"]

"""Light: sunlight, and sunlight that the Earth reflects.

Brightness is relative: 1 is that of sunlight near the Earth, 1361 W/m^2 (Kopp and Lean, "A new, lower value of total
solar irradiance", 2011), on a white surface that faces it. A camera with exposure 1 and gain 1 shows such a surface at
full scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf, isfinite, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vtbdrake.components.environment.conditions import Conditions
from vtbdrake.state import parameter
from vtbdrake.state.declarations import NO_DICT

if TYPE_CHECKING:
    from pydrake.geometry import LightParameter

# Share of the sunlight that the Earth reflects (Stephens et al., "The albedo of Earth", 2015).
EARTH_ALBEDO = 0.29
# m, mean radius (IUGG).
EARTH_RADIUS = 6.371e6

# How far away the source of the earth-shine is in a renderer, in m. In VTK a point source casts no shadow.
_FAR = 1e5
# Entries of the port `light`.
LIGHT_SIZE = 15


def earth_shine(altitude: float) -> float:
    """Return the irradiance by sunlight that the Earth reflects, relative to the sun's, at ``altitude`` (m).

    It is the largest that there is: on a plate that faces the Earth, above its fully lit side. The Earth is a
    Lambertian sphere of uniform radiance, which such a plate sees under the view factor (R / (R + h))^2.
    """
    if not altitude >= 0.0:
        raise ValueError(f"an altitude above the Earth is not negative, in m, not {altitude!r}")
    return float(EARTH_ALBEDO * (EARTH_RADIUS / (EARTH_RADIUS + altitude)) ** 2)


@dataclass
class LightConfig:
    """The light of a scene."""

    # Direction in which the sunlight travels, in W; of any length. By default from straight above.
    direction: list[float] = field(default_factory=lambda: [0.0, 0.0, -1.0])
    # Brightness of a white surface that faces the sun.
    intensity: float = 1.0
    # Red, green and blue of the sunlight, between 0 and 1.
    color: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0])
    # Direction in which light from the Earth travels, in W; of any length.
    earth_direction: list[float] = field(default_factory=lambda: [0.0, 0.0, 1.0])
    # Brightness of a white surface that faces the Earth, see `earth_shine`.
    earth_shine: float = 0.0
    # Red, green and blue of what is seen where nothing is, between 0 and 1.
    background: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Whether bodies shade each other from the sun.
    shadows: bool = True

    def check(self) -> None:
        """Raise a ValueError if a value is impossible.

        Raises:
            ValueError: A value that no light can have.
        """
        for name in ("direction", "earth_direction"):
            value = getattr(self, name)
            if len(value) != 3 or not 0.0 < sqrt(sum(x * x for x in value)) < inf:
                raise ValueError(f"Light: {name} is a vector of three finite numbers, not zero, not {value!r}")
        for name in ("intensity", "earth_shine"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ValueError(f"Light: {name} is finite and not negative, not {getattr(self, name)!r}")
        for name in ("color", "background"):
            value = getattr(self, name)
            if len(value) != 3 or not all(0.0 <= x <= 1.0 for x in value):
                raise ValueError(f"Light: {name} is red, green and blue between 0 and 1, not {value!r}")


class Light(Conditions):
    """Sunlight and earth-shine, for cameras.

    .. pydrake_system::

        name: Light
        output_ports:
        - light

    ``light`` holds the fields of `LightConfig` in their order (15 entries). All are parameters: a rollout changes the
    light by writing them, and each camera that reads the port then sets its renderer anew, before its next image.
    """

    __slots__ = NO_DICT

    def __init__(self, config: LightConfig | None = None) -> None:
        config = config or LightConfig()
        config.check()
        values = [
            *config.direction,
            config.intensity,
            *config.color,
            *config.earth_direction,
            config.earth_shine,
            *config.background,
            float(config.shadows),
        ]
        variables = (
            parameter("direction", 0, shape=(3,)),
            parameter("intensity", 0, start=3, bounds=(0.0, inf)),
            parameter("color", 0, start=4, shape=(3,), bounds=(0.0, 1.0)),
            parameter("earth_direction", 0, start=7, shape=(3,)),
            parameter("earth_shine", 0, start=10, bounds=(0.0, inf)),
            parameter("background", 0, start=11, shape=(3,), bounds=(0.0, 1.0)),
            parameter("shadows", 0, start=14, bounds=(0.0, 1.0)),
        )
        super().__init__("light", values, variables)


def light_sources(light: Sequence[float]) -> list[LightParameter]:
    """Return the sources of light for a renderer, from the value of the port ``light`` of a `Light`."""
    from pydrake.geometry import LightParameter, Rgba

    direction, earth_direction = _unit(light[0:3]), _unit(light[7:10])
    sun = LightParameter(
        type="directional", frame="world", direction=direction, intensity=light[3], color=Rgba(*light[4:7])
    )
    earth = LightParameter(type="point", frame="world", position=-_FAR * earth_direction, intensity=light[10])
    return [sun, earth] if earth.intensity > 0.0 else [sun]


def _unit(vector: Sequence[float]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise ValueError("Light: the direction of light is zero; give a vector of any other length")
    return np.asarray(vector) / length

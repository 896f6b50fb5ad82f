"""Light: sunlight, and sunlight that the Earth reflects.

Brightness is relative: 1 is the brightness of sunlight near the Earth, 1361 W/m^2 (Kopp and Lean, "A new, lower value
of total solar irradiance", 2011), on a white surface that faces it. A camera with exposure 1 and gain 1 shows such a
surface at full scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, inf
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.environment.conditions import Conditions
from vtbdrake.state import NamedVector, Quantity

if TYPE_CHECKING:
    from pydrake.geometry import LightParameter

# Share of the sunlight that the Earth reflects (Stephens et al., "The albedo of Earth", 2015).
EARTH_ALBEDO = 0.29
# m, mean radius (IUGG).
EARTH_RADIUS = 6.371e6

# How far away the source of the earth-shine is in a renderer, in m. In VTK a point source casts no shadow.
_FAR = 1e5


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

    direction: list[float] = setting(
        default_factory=lambda: [0.0, 0.0, -1.0],
        doc="Direction in which the sunlight travels, in W; of any length. By default from straight above.",
    )
    intensity: float = setting(1.0, "Brightness of a white surface that faces the sun.", ge=0.0)
    color: list[float] = setting(
        default_factory=lambda: [1.0, 1.0, 1.0], doc="Red, green and blue of the sunlight.", ge=0.0, le=1.0
    )
    earth_direction: list[float] = setting(
        default_factory=lambda: [0.0, 0.0, 1.0],
        doc="Direction in which light from the Earth travels, in W; of any length.",
    )
    earth_shine: float = setting(0.0, "Brightness of a white surface that faces the Earth, see `earth_shine`.", ge=0.0)
    background: list[float] = setting(
        default_factory=lambda: [0.0, 0.0, 0.0],
        doc="Red, green and blue of what is seen where nothing is.",
        ge=0.0,
        le=1.0,
    )
    shadows: bool = setting(True, "Whether bodies shade each other from the sun.")

    def check(self, name: str = "LightConfig") -> None:
        """Raise a ValueError if no light can have such values.

        Args:
            name: The name of the configuration in messages.

        Raises:
            ValueError: A value that no light can have.
        """
        check_settings(self, name=name)
        for key in ("direction", "earth_direction"):
            value = getattr(self, key)
            if len(value) != 3 or not 0.0 < hypot(*value) < inf:
                raise ValueError(f"{name}.{key} must be three numbers, and not zero, not {value!r}")
        for key in ("color", "background"):
            if len(getattr(self, key)) != 3:
                raise ValueError(f"{name}.{key} must be red, green and blue, not {getattr(self, key)!r}")


class Light(Conditions):
    """Sunlight and earth-shine, for cameras.

    .. pydrake_system::

        name: Light
        output_ports:
        - light

    ``light`` holds the fields of `LightConfig` in their order (15 entries). All are parameters: a rollout changes the
    light by writing them, and each camera that reads the port then sets its renderer anew, before its next image.
    """

    def __init__(self, config: LightConfig | None = None) -> None:
        config = config or LightConfig()
        config.check()
        super().__init__("light", **_quantities(config))


def _quantities(config: LightConfig) -> dict[str, Quantity]:
    share = (0.0, 1.0)
    return {
        "direction": Quantity(config.direction),
        "intensity": Quantity(config.intensity, bounds=(0.0, inf)),
        "color": Quantity(config.color, bounds=share),
        "earth_direction": Quantity(config.earth_direction),
        "earth_shine": Quantity(config.earth_shine, bounds=(0.0, inf)),
        "background": Quantity(config.background, bounds=share),
        "shadows": Quantity(float(config.shadows), bounds=share),
    }


LIGHT = NamedVector(**_quantities(LightConfig()))
"""The port ``light`` of a `Light`."""


def light_sources(light: Sequence[float]) -> list[LightParameter]:
    """Return the sources of light for a renderer, from the value of the port ``light`` of a `Light`."""
    from pydrake.geometry import LightParameter, Rgba

    values = LIGHT.view(np.asarray(light))
    direction, earth_direction = _unit(values.direction), _unit(values.earth_direction)
    sun = LightParameter(
        type="directional", frame="world", direction=direction, intensity=values.intensity, color=Rgba(*values.color)
    )
    earth = LightParameter(type="point", frame="world", position=-_FAR * earth_direction, intensity=values.earth_shine)
    return [sun, earth] if earth.intensity > 0.0 else [sun]


def _unit(vector: Sequence[float]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise ValueError("Light: the direction of light is zero; give a vector of any other length")
    return np.asarray(vector) / length

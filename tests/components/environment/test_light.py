"""Light: the Earth's share of it against a numerical view factor, and the ranges of its parameters."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.components.environment import Light, LightConfig
from vtbdrake.components.environment.light import EARTH_ALBEDO, EARTH_RADIUS, earth_shine
from vtbdrake.state import collect
from vtbdrake.state.variables import VariableError

pytestmark = pytest.mark.one_python


@pytest.mark.parametrize("altitude", [0.0, 4e5, 3.6e7])
def test_earth_shine_is_the_integral_over_the_visible_sphere(altitude: float) -> None:
    # Irradiance of a plate by a uniform radiance L = albedo / pi within a cone: the integral of L cos(theta).
    half_angle = np.arcsin(EARTH_RADIUS / (EARTH_RADIUS + altitude))
    edges = np.linspace(0.0, half_angle, 20_001)
    theta, width = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    expected = EARTH_ALBEDO / np.pi * np.sum(np.cos(theta) * 2.0 * np.pi * np.sin(theta)) * width
    assert earth_shine(altitude) == pytest.approx(expected, rel=1e-6)


def test_altitude_below_ground_is_refused() -> None:
    with pytest.raises(ValueError, match=r"an altitude above the Earth is not negative, in m, not -1\.0"):
        earth_shine(-1.0)


@pytest.mark.parametrize(
    ("name", "allowed", "refused"),
    [
        ("intensity", 1e3, -0.1),
        ("color", [0.0, 0.5, 1.0], [0.0, 0.5, 1.1]),
        ("earth_shine", 0.0, -1e-9),
        ("background", [1.0, 1.0, 0.0], [0.0, -0.1, 0.0]),
        ("shadows", 1.0, 1.5),
        ("shadows", 0.0, -0.5),
    ],
)
def test_values_out_of_range_are_refused(name: str, allowed: object, refused: object) -> None:
    builder = DiagramBuilder()
    builder.AddNamedSystem("light", Light(LightConfig()))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    variable = collect(diagram)[f"light.{name}"]
    variable.set(context, allowed)
    assert np.array_equal(variable.get(context), allowed)
    with pytest.raises(VariableError, match=name):
        variable.set(context, refused)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"direction": [0.0, 0.0, 0.0]}, "LightConfig.direction must be three numbers, and not zero"),
        ({"earth_direction": [1.0, 0.0]}, "earth_direction must be three numbers"),
        ({"intensity": -1.0}, "intensity must be a finite number of at least 0, not -1.0"),
        ({"earth_shine": float("inf")}, "earth_shine must be a finite number"),
        ({"color": [1.0, 1.0, 1.1]}, r"color.2. must be a number from 0 to 1, not 1.1"),
    ],
)
def test_impossible_configs_are_refused(changes: dict[str, object], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Light(LightConfig(**changes))

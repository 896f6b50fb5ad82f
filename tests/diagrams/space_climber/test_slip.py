"""The climber on planes that are steeper than its friction, by both integrators."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake_diagrams.space_climber.scenario import LUNAR_GRAVITY
from vtbdrake_diagrams.space_climber.studies.slip import DURATION, PLANES, advance


@pytest.mark.parametrize("fine", [False, True])
def test_on_a_plane_steeper_than_friction_it_slides_as_a_block_does(fine: bool) -> None:
    """A block slides with g (sin - mu cos). Its steps move the robot by a tenth of that way."""
    slope, friction = PLANES["22 deg uphill, friction 0.35"]
    angle = np.radians(slope)
    acceleration = LUNAR_GRAVITY * (np.sin(angle) - friction * np.cos(angle))
    assert advance(slope, friction, fine=fine) == pytest.approx(-0.5 * acceleration * DURATION**2, rel=0.1)

"""A soft ground of several parts pushes a foot aside; a compliant foot on one rigid mesh obeys the law of the soil."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from vtbdrake_diagrams.space_climber.crater_scenario import CraterScenario
from vtbdrake_diagrams.space_climber.soil import LOAD, RADIUS, Soil, SoilCraterScenario
from vtbdrake_diagrams.space_climber.studies.soft_ground import grounds, pressed

RIGID_PRISMS, BOX, BOXES, PRISMS, MESH, PRISMS_UNDER_SOFT_FOOT, MESH_UNDER_SOFT_FOOT = grounds()


def test_soil_bears_the_load_at_the_sinkage() -> None:
    soil = Soil()
    z = soil.sinkage()

    def pressure_on_ring(distance: float) -> float:
        depth = np.sqrt(RADIUS**2 - distance**2) - (RADIUS - z)
        return 2.0 * np.pi * distance * (soil.cohesive / RADIUS + soil.frictional) * depth

    force = quad(pressure_on_ring, 0.0, np.sqrt(RADIUS**2 - (RADIUS - z) ** 2))[0]
    assert abs(force - LOAD) < 1e-6 * LOAD and abs(soil.force(z) - LOAD) < 1e-9
    assert 800.0 < soil.stiffness() < 1000.0


def test_soft_parts_push_the_foot_away_from_the_line_between_them() -> None:
    x, k = 0.01, Soil().stiffness()

    def excess(h: float) -> float:
        s = np.hypot(x, h)
        return k * (RADIUS - h) + k * (RADIUS - s) * h / s - LOAD

    h = brentq(excess, 0.0, RADIUS)
    s = np.hypot(x, h)
    result = pressed(BOXES, x)
    assert abs(result.sinkage - (RADIUS - h)) < 1e-5
    assert abs(result.sideways - k * (RADIUS - s) * x / s) < 1e-3 * LOAD
    assert result.sideways > 0.2 * LOAD
    assert pressed(PRISMS, x).sideways > 0.1 * LOAD
    assert abs(pressed(BOXES, 0.0).sinkage - 0.5 * Soil().sinkage()) < 1e-5  # Both parts bear the foot.


def test_one_part_does_not_push_and_rigid_prisms_hardly() -> None:
    for ground, depth in ((BOX, Soil().sinkage()), (MESH, Soil().sinkage()), (RIGID_PRISMS, 0.0)):
        result = pressed(ground, 0.01)
        assert abs(result.sideways) < 1e-6 * LOAD and abs(result.sinkage - depth) < 5e-5


def test_mesh_at_points_fills_valleys() -> None:
    assert pressed(MESH, 0.0, slope=np.radians(10.0)).sinkage < -0.05


@pytest.mark.slow
def test_compliant_foot_sinks_as_deep_and_is_pushed_by_several_parts_only() -> None:
    result = pressed(MESH_UNDER_SOFT_FOOT, 0.01)
    assert abs(result.sinkage - Soil().sinkage()) < 0.03 * Soil().sinkage()
    assert abs(result.sideways) < 1e-3 * LOAD
    assert pressed(PRISMS_UNDER_SOFT_FOOT, 0.01).sideways > 0.1 * LOAD
    assert pressed(MESH_UNDER_SOFT_FOOT, 0.0, slope=np.radians(10.0)).sinkage > 0.8 * Soil().sinkage()


def test_soil_bears_no_more_than_a_foot_that_is_half_in_it() -> None:
    with pytest.raises(ValueError, match="bears between 0 and"):
        Soil().sinkage(2.0 * LOAD)


def climbed(scenario: CraterScenario, duration: float) -> tuple[float, float]:
    """Return how far a robot has come along x, and how high it is, in m."""
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(duration)
    x, _, z = testbed.read(context, "sim.sys.climber.base.pose")[:3]
    return x, z


@pytest.mark.slow
def test_climber_walks_on_soil_and_sinks_in() -> None:
    soil = SoilCraterScenario(seed=0)
    rigid = soil.mental()
    assert not rigid.yields
    on_soil, on_rock, on_crater = (climbed(each, 4.0) for each in (soil, rigid, CraterScenario(seed=0).mental()))
    assert on_rock == on_crater
    # In the stride it stands on three to six feet, at half the load of a tripod or more.
    assert Soil().sinkage(0.3 * LOAD) < on_rock[1] - on_soil[1] < 0.02
    assert 0.5 < on_soil[0] < on_rock[0]

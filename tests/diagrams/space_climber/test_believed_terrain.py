"""The robot's belief after a scan, against terrain of known shape; the mental world against Drake's own queries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.common.scan import Scan
from vtbdrake.components.sensors.laser_scanner import raster
from vtbdrake.components.world_model import WorldModel
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.space_climber.believed_scenario import BelievedCraterScenario, believed_world
from vtbdrake_diagrams.space_climber.believed_terrain import FRICTION, BelievedTerrain, NoReturnError
from vtbdrake_diagrams.space_climber.crater_scenario import SCANNER_NOISE, X_BL, CraterScenario
from vtbdrake_diagrams.space_climber.ground_map import GroundMap, OffTheMapError
from vtbdrake_diagrams.space_climber.route import route
from vtbdrake_diagrams.space_climber.survey import rock
from vtbdrake_diagrams.space_climber.terrain import Crater

SLOPE = 0.3
ROCK = np.array([4.0, 1.0])
RADIUS = 0.3


def flat_survey(error: float = 0.25) -> GroundMap:
    """Return a survey of the plane z = 0.3 x that is too high by ``error``."""
    x = np.linspace(-4.0, 16.0, 21)
    heights = np.repeat(SLOPE * x[:, None] + error, 21, axis=1)
    return GroundMap.surveyed((-4.0, -10.0), 1.0, heights, deviation=0.3, range=8.0)


def scan_of_a_ball_on_a_slope(X_WL: RigidTransform, *, ball: bool = True) -> Scan:
    """Return the scan of the plane z = 0.3 x and half a ball that sticks out of it, by the equations of the ray."""
    directions_L = raster(100, 240, np.radians(120.0), np.radians(50.0))
    p, d = X_WL.translation(), directions_L @ X_WL.rotation().matrix().T
    normal = np.array([-SLOPE, 0.0, 1.0])
    with np.errstate(divide="ignore"):
        ranges = -(normal @ p) / (d @ normal)
    ranges[ranges <= 0.0] = np.inf
    if ball:
        to = np.array([*ROCK, SLOPE * ROCK[0]]) - p
        along = d @ to
        inside = RADIUS**2 - (to @ to - along**2)
        hit = np.where(inside > 0.0, along - np.sqrt(np.maximum(inside, 0.0)), np.inf)
        ranges = np.minimum(ranges, hit)
    kept = ranges < 20.0
    noise = SCANNER_NOISE * np.random.default_rng(0).standard_normal(kept.sum())
    return Scan(directions_L[kept], ranges[kept] + noise, np.zeros(kept.sum()), 0.0)


# On the slope's foot, leaning as the slope does.
X_WL = RigidTransform(RollPitchYaw(0.0, -np.arctan(SLOPE), 0.0), [0.0, 0.0, 0.2]) @ X_BL


def test_a_scan_shows_ground_and_rock() -> None:
    before = BelievedTerrain(flat_survey(), WorldModel())
    after = before.after_scan(scan_of_a_ball_on_a_slope(X_WL), X_WL)
    places = np.array([[2.0, 0.0], [4.0, -2.0], [5.0, 2.0], [4.0, 1.0]])
    np.testing.assert_allclose(after.ground.height(places), SLOPE * places[:, 0], atol=0.03)
    # What it does not see follows from the survey, shifted as its surroundings are.
    assert 0.02 < after.ground.height([[-1.0, 5.0]])[0] + 1.0 * SLOPE < 0.24
    (seen,) = after.rocks
    np.testing.assert_allclose(seen.p_WoOo_W, [*ROCK, SLOPE * ROCK[0]], atol=0.1)
    assert seen.number("width", unit="m") == pytest.approx(2 * RADIUS, abs=0.1)
    assert seen.number("height", unit="m") == pytest.approx(2 * RADIUS, abs=0.12)


def test_rocks_that_are_not_there_are_removed_and_those_out_of_sight_stay() -> None:
    invented = rock("survey-0", [3.0, 0.0, 0.9], diameter=0.5, deviation=0.3, source="survey")
    behind = rock("survey-1", [-3.0, 0.0, -0.9], diameter=0.5, deviation=0.3, source="survey")
    terrain = BelievedTerrain(flat_survey(), WorldModel([invented, behind]))
    for _ in range(2):
        terrain = terrain.after_scan(scan_of_a_ball_on_a_slope(X_WL, ball=False), X_WL)
    assert [each.identity for each in terrain.rocks if each.is_known] == ["survey-1"]


def test_a_scan_without_a_return_is_named() -> None:
    terrain = BelievedTerrain(flat_survey(), WorldModel())
    with pytest.raises(NoReturnError, match="no return within 14 m on the map"):
        terrain.after_scan(Scan.empty(), X_WL)


def test_slip_is_less_friction_of_the_patches_where_it_was_felt() -> None:
    steep = replace(flat_survey(), survey=2.0 * flat_survey().survey)
    terrain = BelievedTerrain(steep, WorldModel())
    path = [[3.0, 0.0], [3.2, 0.0]]
    at, beside = (7, 10), (7, 15)
    # On 0.6 with 0.2 of the way, mu = 0.6 / 0.8^(1/3.7) = 0.64: no less than believed. On 0.3 it is 0.32.
    assert terrain.after_slip(path, 0.2).friction[at] == FRICTION[0]
    after = BelievedTerrain(flat_survey(), WorldModel()).after_slip(path, 0.2)
    assert after.cautious_friction[at] == pytest.approx(0.37, abs=0.05)
    assert after.friction[beside] == FRICTION[0]
    assert BelievedTerrain(flat_survey(), WorldModel()).after_slip(path, 0.9).friction[at] == FRICTION[0]
    world = after.world_model(near=[3.0, 0.0], radius=2.0)
    patch = next(each for each in world.find("ground") if "friction" in each.attributes)
    testbed = believed_world(CraterScenario(), world, friction=0.54).build()
    (address,) = (a for a in testbed.variables() if a.endswith(f"{patch.identity}/south.friction"))
    ground, feet = testbed.read(testbed.default_context(), address), 0.54
    # As Drake combines them.
    assert 2.0 * ground * feet / (ground + feet) == pytest.approx(patch.number("friction", unit="1"))


def test_the_mental_world_has_the_believed_surface_and_rocks() -> None:
    crater = Crater(1)
    flat = flat_survey()
    vertices = flat.vertices() + np.array([20.0, 0.0])
    heights = crater.mesh_height(vertices).reshape(flat.survey.shape)
    ground = GroundMap.surveyed((16.0, -10.0), 1.0, heights, deviation=0.3, range=8.0)
    boulder = rock("rock", [25.0, 2.0, 0.0], diameter=0.6, deviation=0.1, source="scanner")
    terrain = BelievedTerrain(ground, WorldModel([boulder]))
    scenario = believed_world(CraterScenario(), terrain.world_model(near=[25.0, 0.0], radius=4.0), friction=0.5)
    testbed = scenario.build()
    context = testbed.default_context()
    scene_graph = testbed.scene_graph
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    inspector = query.inspector()
    rng = np.random.default_rng(0)
    for x, y in rng.uniform([23.0, -2.0], [27.0, 1.0], (20, 2)):
        z = scenario.ground_height(x, y)
        assert z == pytest.approx(float(ground.height([[x, y]])[0]), abs=0.05)
        near = [
            pair.distance
            for pair in query.ComputeSignedDistanceToPoint(np.array([x, y, z + 0.02]), 0.5)
            if "ground" in inspector.GetName(pair.id_G)
        ]
        assert 0.015 < min(near) <= 0.02 + 1e-6
    top = np.array([25.0, 2.0, float(ground.height([[25.0, 2.0]])[0]) + 0.5 * 0.85 * 0.6])
    distances = {inspector.GetName(p.id_G): p.distance for p in query.ComputeSignedDistanceToPoint(top, 0.2)}
    assert distances["rock/rock"] == pytest.approx(0.0, abs=1e-3)
    testbed.write(context, {"dps.impl.navigator.position": [25.0, 0.5], "dps.env.position": [0.0, 0.0, 0.21]})
    testbed.start_from_belief(context)
    pose = testbed.read(context, "sim.sys.climber.base.pose")
    np.testing.assert_allclose(pose[:3], [25.0, 0.5, scenario.ground_height(25.0, 0.5) + 0.21], atol=1e-9)


def test_a_world_without_ground_and_a_place_beside_the_map_are_named() -> None:
    with pytest.raises(ScenarioError, match="no patch of ground"):
        BelievedCraterScenario().build()
    with pytest.raises(OffTheMapError):
        BelievedTerrain(flat_survey(), WorldModel()).world_model(near=[-30.0, 0.0], radius=3.0)


def test_a_route_goes_around_rocks_and_steep_ground() -> None:
    flat = GroundMap.surveyed((-6.0, -34.0), 1.0, np.zeros((55, 69)), deviation=0.3, range=8.0)
    free = route(BelievedTerrain(flat, WorldModel()))
    assert free.cost_at([0.0, 0.0]) == pytest.approx(42.0, abs=0.6)
    assert free.cost_at([20.0, 0.0]) == pytest.approx(22.0, abs=0.6)
    wall = [rock(f"r{k}", [25.0, y, 0.0], diameter=1.0, deviation=0.1, source="") for k, y in enumerate(range(-3, 9))]
    around = route(BelievedTerrain(flat, WorldModel(wall)))
    path = around.path([20.0, 0.0], length=12.0)
    assert path[np.abs(path[:, 0] - 25.0) < 0.3, 1].max() < -3.5
    # A step of 45 deg for y > -2: a metre on it costs 20 m.
    steep = flat.survey.copy()
    steep[30:33, 32:] += np.array([1.0, 2.0, 3.0])[:, None]
    steep[33:, 32:] += 3.0
    over = route(BelievedTerrain(replace(flat, survey=steep), WorldModel()))
    assert over.cost_at([20.0, 10.0]) > free.cost_at([20.0, 10.0]) + 6.0
    assert over.heading([20.0, 0.0], ahead=5.0) < -0.2


def test_a_route_keeps_out_of_a_gully() -> None:
    """A V along x, 3 m wide and up to 1 m deep: its banks are steep, and at a vertex on its bottom they cancel."""
    flat = GroundMap.surveyed((-6.0, -34.0), 1.0, np.zeros((55, 69)), deviation=0.3, range=8.0)
    heights = flat.survey.copy()
    deep = np.clip((np.arange(-6.0, 49.0) - 14.0) / 6.0, 0.0, 1.0)
    heights[:, 32:37] -= deep[:, None] * np.maximum(0.0, 1.0 - np.abs(np.arange(-2, 3)) / 1.5)
    terrain = BelievedTerrain(replace(flat, survey=heights), WorldModel())
    np.testing.assert_allclose(terrain.steepness()[30, 33:35], 2.0 / 3.0)
    np.testing.assert_allclose(terrain.slopes()[:, 30, 34], 0.0, atol=1e-12)
    path = route(terrain).path([12.0, 0.0], length=22.0)
    assert np.abs(path[path[:, 0] > 22.0, 1]).min() > 1.4


def test_a_route_goes_around_where_the_robot_came_no_further() -> None:
    """Around the place it costs 8 m more per metre: the way aside is shorter, with half a robot between."""
    flat = GroundMap.surveyed((-6.0, -34.0), 1.0, np.zeros((55, 69)), deviation=0.3, range=8.0)
    felt = BelievedTerrain(flat, WorldModel()).after_block([22.0, 0.0])
    assert np.abs(route(BelievedTerrain(flat, WorldModel())).path([20.0, 0.0], length=5.0)[:, 1]).max() == 0.0
    path = route(felt).path([20.0, 0.0], length=5.0)
    assert np.hypot(*(path - [22.0, 0.0]).T).min() > 0.45
    # Twice the same place is no higher obstacle.
    assert route(felt.after_block([22.0, 0.0])).cost_at([22.0, 0.0]) == route(felt).cost_at([22.0, 0.0])

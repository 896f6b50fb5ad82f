"""Tests of the simulated forest: scans against analytic geometry, readings of the sensors, bad fields."""

import gc
import json
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.common.scan import Scan
from vtbdrake.components.ray_casting import Hits, RayCaster
from vtbdrake.components.sensors.laser_scanner import LaserScannerConfig, raster, raster_size
from vtbdrake.components.world_model import (
    AttributeValue,
    LocalFrame,
    WorldModel,
    WorldObject,
    position_estimate,
    save_geojson,
)
from vtbdrake.testbed import ScenarioError, VirtualTestbed
from vtbdrake_diagrams.forest.scenario import CarrierScenario, ForestScenario
from vtbdrake_diagrams.forest.world.geometry import add_ground, add_surface
from vtbdrake_diagrams.forest.world.ground import Ground
from vtbdrake_diagrams.forest.world.stand import Stand
from vtbdrake_diagrams.forest.world.vegetation import (
    BREAST_HEIGHT,
    Vegetation,
    branches,
    crowns,
    trunks,
    undergrowth,
)
from vtbdrake_diagrams.plain.scenario import PlainScenario

GROUND = Ground(seed=6)
AT_REST = SpatialVelocity(np.zeros(3), np.zeros(3))


def tree(x: float, y: float, diameter: float = 0.3, height: float = 20.0) -> WorldObject:
    attributes = {"trunk_diameter": AttributeValue(diameter, "m"), "height": AttributeValue(height, "m")}
    return WorldObject(f"tree at {x}", "tree", position_estimate([x, y, 0.0]), attributes=attributes)


def cast(directions: np.ndarray, p_WLo: np.ndarray, trees: WorldModel) -> Hits:
    """Cast rays at trunks on the ground."""
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)
    add_ground(plant, GROUND, length=40.0, width=40.0)
    add_surface(plant, "trunks", trunks(trees, GROUND, Vegetation(lean=0.0)), np.ones(4))
    plant.Finalize()
    caster = RayCaster(plant, scene_graph)
    return caster.cast(
        directions, np.zeros(len(directions)), X_WL=RigidTransform(p_WLo), V_WL=AT_REST, X_WB=[RigidTransform()],
        V_WB=[AT_REST], reach=30.0,
    )  # fmt: skip


def test_scan_of_a_trunk_is_that_of_a_cylinder() -> None:
    """Within the band of a trunk about breast height, where its cone has nearly the given radius."""
    p_WLo = np.array([10.0, 20.0, float(GROUND.height(10.0, 20.0)) + 1.5])
    foot = np.array([18.0, 20.0, float(GROUND.height(18.0, 20.0))])
    directions = raster(8, 4000, 0.1, 0.1)
    hits = cast(directions, p_WLo, WorldModel([tree(18.0, 20.0)]))
    points = p_WLo + hits.distances[:, np.newaxis] * directions
    band = np.abs(points[:, 2] - foot[2] - BREAST_HEIGHT) < 0.1
    assert band.sum() > 500
    # |p + t d - c| = r in the plane.
    d, p = directions[band][:, :2], p_WLo[:2] - foot[:2]
    a, b, c = (d**2).sum(axis=1), d @ p, p @ p - 0.15**2
    inside = b**2 > a * c
    analytic = ((-b - np.sqrt(np.maximum(b**2 - a * c, 0.0))) / a)[inside]
    np.testing.assert_allclose(hits.distances[band][inside], analytic, atol=0.01)
    assert np.mean(hits.distances[band][inside] - analytic) == pytest.approx(0.0, abs=1e-3)


def test_rays_beside_the_trunk_hit_the_ground() -> None:
    p_WLo = np.array([10.0, 20.0, float(GROUND.height(10.0, 20.0)) + 2.0])
    directions = raster(16, 1250, 2.0 * np.pi, np.radians(30.0))
    hits = cast(directions, p_WLo, WorldModel([tree(12.0, 35.0)]))
    seen = np.isfinite(hits.distances) & (directions[:, 2] < -0.15)
    points = p_WLo + hits.distances[seen][:, np.newaxis] * directions[seen]
    assert seen.sum() > 3000
    np.testing.assert_allclose(points[:, 2], GROUND.height(points[:, 0], points[:, 1]), atol=0.02)


def test_trunks_lean_about_their_feet() -> None:
    trees, vegetation = Stand(seed=1).trees(), Vegetation(seed=1, lean=0.02)
    feet = trees.positions()
    feet[:, 2] = GROUND.height(feet[:, 0], feet[:, 1])
    vertices = trunks(trees, GROUND, vegetation)[0].reshape(len(trees), -1, 3)
    base, top = vertices[:, :-1].mean(axis=1), vertices[:, -1]
    slopes = (top - base)[:, :2] / (top - base)[:, 2:]
    # The lines from base to top pass through the feet, with the given inclination.
    on_ground = base[:, :2] + slopes * (feet[:, 2] - base[:, 2])[:, np.newaxis]
    np.testing.assert_allclose(on_ground, feet[:, :2], atol=1e-9)
    assert slopes.std() == pytest.approx(0.02, rel=0.05) and abs(slopes.mean()) < 0.002
    np.testing.assert_allclose(top[:, 2] - feet[:, 2], [one.number("height", unit="m") for one in trees])


def test_vegetation_is_where_it_grows() -> None:
    stand, vegetation = Stand(seed=1, length=40.0, width=40.0, road_width=4.0), Vegetation(seed=1)
    trees = stand.trees()
    feet = trees.positions()[:, :2]
    roads = np.concatenate([route.points for route in stand.routes()])

    vertices, triangles = branches(trees, GROUND, vegetation)
    assert len(triangles) == 3 * 6 * len(trees) or abs(len(triangles) / len(trees) / 18.0 - 1.0) < 0.1
    nearest = np.linalg.norm(vertices[:, np.newaxis, :2] - feet, axis=2).min(axis=1)
    assert nearest.max() < 1.4

    vertices, _ = undergrowth(GROUND, vegetation, lower=np.zeros(2), upper=np.array([40.0, 40.0]), roads=(roads, 2.0))
    over = vertices[:, 2] - GROUND.height(vertices[:, 0], vertices[:, 1])
    assert over.min() > -0.3 and 0.5 < over.max() < 1.6
    assert np.linalg.norm(vertices[::50, np.newaxis, :2] - roads, axis=2).min() > 1.0

    vertices, _ = crowns(trees, GROUND, vegetation)
    assert (vertices[:, 2] - GROUND.height(vertices[:, 0], vertices[:, 1])).min() > 2.0


@pytest.fixture(scope="module")
def drive() -> tuple[VirtualTestbed, list[Scan], np.ndarray]:
    """Three seconds on the main road: all scans, and times, poses, and readings of IMU and odometry."""
    scenario = ForestScenario(seed=1, length=60.0, width=60.0, speed=1.0)
    testbed = scenario.build()
    simulator = testbed.simulator(testbed.default_context())
    scans, rows = [], []
    for k in range(1, 151):
        simulator.AdvanceTo(0.02 * k)
        context = simulator.get_context()
        read = [testbed.read(context, f"sim.{name}") for name in (
            "sys.carrier.base.pose", "sys.carrier.base.velocity", "sense.imu.imu", "sense.odometry.odometry",
        )]  # fmt: skip
        rows.append(np.concatenate([np.ravel(value) for value in read]))
        scan = testbed.diagram.GetSubsystemByName("sim.sense.scanner")
        value = scan.GetOutputPort("scan").Eval(scan.GetMyContextFromRoot(context))
        if not scans or scans[-1].stamp != value.stamp:
            scans.append(value)
    return testbed, scans, np.array(rows)


@pytest.mark.slow
def test_scanner_sees_ground_and_trunks(drive: tuple[VirtualTestbed, list[Scan], np.ndarray]) -> None:
    _, scans, rows = drive
    # An empty one first, then five per second; 16 beams.
    assert len(scans) in (15, 16)
    scan = scans[-1]
    assert 5_000 < len(scan.ranges) < 20_000
    assert len(np.unique(np.round(np.arcsin(scan.directions_L[:, 2]), 6))) == 16
    # The ground in front of the carrier is 2 m below the scanner.
    points = scan.points()
    near = (np.hypot(points[:, 0] - 8.0, points[:, 1]) < 1.5) & (points[:, 2] < -1.0)
    assert points[near, 2].mean() == pytest.approx(-2.0, abs=0.4)


def test_gyro_measures_the_turning(drive: tuple[VirtualTestbed, list[Scan], np.ndarray]) -> None:
    _, _, rows = drive
    roll, pitch, yaw = rows[:, 3:6].T
    rates = np.array(
        [
            RollPitchYaw(*rpy).ToRotationMatrix().matrix().T @ w
            for rpy, w in zip(rows[:, 3:6], rows[:, 6:9], strict=True)
        ]
    )
    measured = rows[:, 12:15]
    # The gyro shows means over a period, up to two periods late, with a bias of 5e-4 and a noise of 2e-3 rad/s.
    assert (measured[2:] - rates[1:-1]).mean(axis=0) == pytest.approx(np.full(3, 5e-4), abs=1e-3)
    assert np.abs(rates).max() > 0.05
    assert (measured[2:] - rates[1:-1]).std() < 0.02


def test_odometer_is_wrong_by_its_scale(drive: tuple[VirtualTestbed, list[Scan], np.ndarray]) -> None:
    _, _, rows = drive
    true = np.linalg.norm(rows[100:, 9:12], axis=1)
    assert rows[100:, -1].mean() / true.mean() == pytest.approx(1.01, abs=0.02)
    assert rows[100:, -1].std() == pytest.approx(0.02, rel=0.4)


def test_command_reaches_the_driver(drive: tuple[VirtualTestbed, list[Scan], np.ndarray]) -> None:
    testbed, _, _ = drive
    context = testbed.default_context()
    testbed.write(context, {"u.route": 1.0})
    testbed.simulator(context).AdvanceTo(0.03)  # The DPS passes it on in its next period.
    driver = testbed.diagram.GetSubsystemByName("sim.act.driver")
    assert driver.GetInputPort("route").Eval(driver.GetMyContextFromRoot(context)) == [1.0]


def test_carrier_stands_where_it_is_believed_to_be(drive: tuple[VirtualTestbed, list[Scan], np.ndarray]) -> None:
    testbed, _, _ = drive
    scenario = ForestScenario(seed=1, length=60.0, width=60.0)
    right = scenario.routes()[1]
    place, heading = right.position(50.0), right.heading(50.0)
    context = testbed.default_context()
    reckoning = "dps.env.dead_reckoning"
    testbed.write(
        context,
        {
            "dps.env.pose.position": place,
            "dps.env.pose.heading": heading,
            f"{reckoning}.roll": 0.05,
            f"{reckoning}.pitch": -0.02,
            f"{reckoning}.speed": 0.8,
            f"{reckoning}.turn_rate": 0.1,
        },
    )
    testbed.start_from_belief(context)
    read = {name: testbed.read(context, f"sim.{name}") for name in (
        "sys.carrier.base.pose", "sys.carrier.base.velocity", "act.driver.route", "act.driver.along",
        "act.wheels.curvature",
    )}  # fmt: skip
    x, y, height, *rpy = read["sys.carrier.base.pose"]
    w, v = read["sys.carrier.base.velocity"][:3], read["sys.carrier.base.velocity"][3:]
    # The pose is the present one, and all else one period old.
    assert [x, y] == pytest.approx(place - 0.02 * v[:2], abs=1e-4)
    assert rpy == pytest.approx([0.05, -0.02, heading - 0.02 * 0.1])
    assert height == pytest.approx(scenario.ground().height(x, y), abs=0.1)
    # By default, route 0 is advised, but the carrier is not on it.
    assert read["act.driver.route"] == 1.0
    assert read["act.driver.along"] == pytest.approx(50.0 - 0.8, abs=0.3)
    assert read["act.wheels.curvature"] == pytest.approx(0.125)
    assert w == pytest.approx([0.0, 0.0, 0.1])
    # The rear axle moves along x_B.
    R_WB = RollPitchYaw(*rpy).ToRotationMatrix().matrix()
    assert R_WB.T @ (v + np.cross(w, R_WB @ [-0.8, 0.0, 0.0])) == pytest.approx([0.8, 0.0, 0.0], abs=2e-2)


def test_there_is_no_belief_without_a_pose(drive: tuple[VirtualTestbed, list[Scan], np.ndarray]) -> None:
    testbed, _, _ = drive
    with pytest.raises(ValueError, match="the carrier is not localized"):
        testbed.start_from_belief(testbed.default_context())


@pytest.mark.parametrize("make", [ForestScenario, PlainScenario])
def test_detectors_have_the_angles_between_rays(make: type[CarrierScenario]) -> None:
    scanner, accuracy = make().scanner, make().scanner_accuracy()
    rays = raster(*raster_size(scanner), scanner.azimuth, scanner.elevation)
    elevations, azimuths = np.arcsin(rays[:, 2]), np.arctan2(rays[:, 1], rays[:, 0])
    assert np.diff(np.unique(elevations.round(9))) == pytest.approx(accuracy["elevation_step"])
    assert np.diff(np.unique(azimuths.round(9))) == pytest.approx(accuracy["azimuth_step"])


def test_unit_has_the_errors_of_its_map_and_mast() -> None:
    scenario = ForestScenario(seed=2, length=40.0, width=40.0, map="poor", scanner_forward=-0.5, scanner_height=3.0)
    world_map = scenario.global_map()
    unit, low = scenario.unit(world_map), replace(scenario, scanner_height=2.0).unit(world_map)
    # Neighbours of the poor map share their errors over 40 m; see `MAPS`.
    assert unit.tracker.correlation == unit.locator.correlation == 40.0
    assert unit.tracker.sensor == (-0.5, 0.0)
    # An error of the vertical displaces detections from a high mast.
    assert unit.tracker.scan_deviation == pytest.approx(1.5 * low.tracker.scan_deviation)
    assert low.tracker.scan_deviation > 0.0


def test_start_beyond_a_lap_counts_no_lap() -> None:
    scenario = ForestScenario(length=40.0, width=40.0)
    length = scenario.routes()[0].length
    testbed = replace(scenario, start=length + 5.0, laps=1).build()
    context = testbed.default_context()
    assert testbed.read(context, "sim.act.driver.along") == pytest.approx(5.0)
    testbed.simulator(context).AdvanceTo(0.05)
    assert testbed.read(context, "sim.act.driver.wanted_speed") == 1.0


def test_map_comes_from_a_survey_or_a_file(tmp_path: Path) -> None:
    scenario = ForestScenario(seed=2, map="exact")
    truth = {tuple(p) for p in scenario.truth().positions()[:, :2].tolist()}
    assert {tuple(p) for p in scenario.global_map().positions()[:, :2].tolist()} == truth
    path = tmp_path / "map.geojson"
    save_geojson(WorldModel([tree(3.0, 4.0)]), path, frame=LocalFrame(61.19, 25.11, 130.0))
    loaded = ForestScenario(map_file=str(path)).global_map()
    assert loaded.positions() == pytest.approx(np.array([[3.0, 4.0, 0.0]]), abs=1e-6)


def test_positions_in_a_file_are_not_taken_as_exact(tmp_path: Path) -> None:
    path = tmp_path / "map.geojson"
    save_geojson(WorldModel([tree(3.0, 4.0)]), path, frame=LocalFrame(61.19, 25.11, 130.0))
    data = json.loads(path.read_text())
    del data["features"][0]["properties"]["covariance"]
    path.write_text(json.dumps(data))
    (loaded,) = ForestScenario(map="remote", map_file=str(path)).global_map()
    assert np.diag(loaded.pose.covariance)[3:] == pytest.approx(np.full(3, 0.35**2))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"stand_kind": "jungle"}, "stand_kind must be one of natural, .*windthrown, not 'jungle'"),
        ({"map": "perfect"}, "map must be one of exact, accurate, remote, poor"),
        ({"route": 99}, "route must be the number of one of 6 routes, not 99"),
        ({"scanner_height": 0.5}, "from 1.3 to 6 m, not 0.5: over the carrier's roof"),
        ({"speed": 9.0}, "speed must be a number from 0 to 3 m/s"),
        ({"road_width": 1.0}, "the carrier is 1.5 m wide"),
        ({"length": 20.0}, "a stand with roads is at least 40 m long"),
        ({"bumps": 1.0}, "bumps must be a number from 0 to 0.08 m, not 1.0: a carrier must drive there"),
        ({"undergrowth": -1.0}, "undergrowth must be a number from 0 to 5000 1/ha, not -1.0"),
        ({"landmarks": "rocks"}, "needs rocks and a scanner: rock_cover must be above 0, not 0"),
        ({"rock_cover": 0.5}, "rock_cover must be a number from 0 to 0.3, not 0.5"),
        ({"carrier": "foot"}, "carrier must be one of"),
        ({"lean": 0.5}, "lean must be a number from 0 to 0.2 rad, not 0.5"),
        ({"laps": 0}, "laps must be a whole number of at least 1"),
        ({"scanner": LaserScannerConfig(frequency=0.0)}, "scanner.frequency must be a finite number above 0 Hz"),
        ({"scanner": LaserScannerConfig(frequency=1.0)}, "scanner.frequency must be at least 2 Hz, not 1"),
    ],
)
def test_impossible_fields_are_refused(fields: dict[str, object], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        ForestScenario(**fields).validate()


def test_testbed_is_freed() -> None:
    testbed = ForestScenario(length=40.0, width=40.0).build()
    testbed.simulator(testbed.default_context()).AdvanceTo(0.1)
    left = weakref.ref(testbed.diagram)
    del testbed
    gc.collect()
    assert left() is None


def test_forest_with_rocks_has_them_in_truth_map_and_landmarks() -> None:
    scenario = ForestScenario(seed=2, length=40.0, width=40.0, rock_cover=0.05, landmarks="both")
    truth, surveyed = scenario.truth(), scenario.global_map()
    rocks, trees = truth.find("rock"), truth.find("tree")
    assert len(rocks) > 20 and len(trees) > 20
    assert len(surveyed.find("rock")) == len(rocks) and len(surveyed.find("tree")) == len(trees)
    counts = {
        kinds: len(replace(scenario, landmarks=kinds).unit(surveyed).tracker.landmarks)
        for kinds in ("trees", "rocks", "both")
    }
    assert counts == {"trees": len(trees), "rocks": len(rocks), "both": len(trees) + len(rocks)}
    # The roads are free.
    gaps = [route.distances(np.array([rock.p_WoOo_W[:2] for rock in rocks])).min() for route in scenario.routes()]
    assert min(gaps) > 2.0

"""The crater: its surface against its formula, its mesh against the surface, and the robot in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.analysis import Simulator

import vtbdrake as vtb
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake.testbed import ScenarioError, VirtualTestbed
from vtbdrake_diagrams.space_climber import CraterScenario, SpaceClimberScenario
from vtbdrake_diagrams.space_climber.crater_scenario import X_BL, EndOfClimb
from vtbdrake_diagrams.space_climber.terrain import BEYOND, DEPTH, RIM_RADIUS, SECTOR, WALL_DEG, Crater

AROUND = np.linspace(-np.pi, np.pi, 721)
SEEDS = range(5)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_rim_is_the_highest_place_and_equally_high_all_around(seed: int) -> None:
    crater = Crater(seed)
    for r in (RIM_RADIUS, RIM_RADIUS + 1.0, RIM_RADIUS + BEYOND):
        np.testing.assert_allclose(crater.height(r * np.cos(AROUND), r * np.sin(AROUND)), DEPTH, atol=1e-12)
    r, azimuth = np.meshgrid(np.linspace(0.0, RIM_RADIUS - 0.5, 100), AROUND)
    inside = crater.height(r * np.cos(azimuth), r * np.sin(azimuth))
    assert inside.min() >= 0.0
    assert inside.max() < DEPTH


@pytest.mark.parametrize("seed", SEEDS)
def test_the_steepest_slope_of_the_wall_is_as_stated(seed: int) -> None:
    crater = Crater(seed, gullies=False)
    assert np.degrees(crater.wall_slope(AROUND)).min() >= WALL_DEG[0]
    assert np.degrees(crater.wall_slope(AROUND)).max() <= WALL_DEG[1]
    r = np.linspace(0.0, RIM_RADIUS, 20001)
    for azimuth in (-0.7, 0.0, 0.4, 2.0):
        rise = np.diff(crater.height(r * np.cos(azimuth), r * np.sin(azimuth))) / np.diff(r)
        assert np.arctan(rise.max()) == pytest.approx(float(crater.wall_slope(azimuth)), abs=1e-4)


def test_walls_take_all_slopes_alike() -> None:
    slopes = np.degrees([Crater(seed).wall_slope(AROUND[::60]) for seed in range(200)])
    counts, _ = np.histogram(slopes, bins=4, range=WALL_DEG)
    np.testing.assert_allclose(counts / counts.sum(), 0.25, atol=0.04)


def test_gullies_cut_the_wall_and_not_the_rim() -> None:
    crater = Crater(1)
    filled = replace(crater, gullies=False)
    for gully in crater.gully_lines:
        middle = np.mean([gully.upper, gully.lower], axis=0)
        assert filled.height(*middle) - crater.height(*middle) == pytest.approx(min(1.0, float(filled.height(*middle))))
        assert crater.height(*gully.upper) == pytest.approx(float(filled.height(*gully.upper)), abs=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_mesh_covers_the_ground_without_gaps(seed: int) -> None:
    vertices, triangles = Crater(seed).mesh
    a, b, c = (vertices[triangles[:, k], :2] for k in range(3))
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert areas.min() > 0.0
    edge = vertices[np.hypot(vertices[:, 0], vertices[:, 1]) > RIM_RADIUS + BEYOND - 1e-6]
    corners = len(edge)
    polygon = 0.5 * corners * (RIM_RADIUS + BEYOND) ** 2 * np.sin(2.0 * np.pi / corners)
    assert areas.sum() == pytest.approx(polygon, rel=1e-9)


def gradient(crater: Crater, x: np.ndarray, y: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """Return the gradient of the analytic surface by central differences, (..., 2)."""
    along_x = crater.height(x + h, y) - crater.height(x - h, y)
    along_y = crater.height(x, y + h) - crater.height(x, y - h)
    return np.stack([along_x, along_y], axis=-1) / (2.0 * h)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_mesh_has_the_slopes_of_the_surface(seed: int) -> None:
    """The gradient of a triangle lies among the surface's gradients at its corners, up to the way that they vary."""
    crater = Crater(seed, gullies=False)
    vertices, triangles = crater.mesh
    np.testing.assert_allclose(vertices[:, 2], crater.height(vertices[:, 0], vertices[:, 1]), atol=1e-12)
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    slopes = -normal[:, :2] / normal[:, 2:]
    at_corners = gradient(crater, corners[:, :, 0], corners[:, :, 1])
    middle = corners[:, :, :2].mean(axis=1)
    error = np.linalg.norm(slopes - gradient(crater, *middle.T), axis=1)
    varies = np.linalg.norm(np.ptp(at_corners, axis=1), axis=1)
    fine = (np.abs(np.arctan2(*middle.T[::-1])) < SECTOR - 0.1) & (np.hypot(*middle.T) < RIM_RADIUS)
    assert (error <= varies + 0.02)[fine].mean() > 0.99
    assert np.median(error[fine]) < 0.04


def test_waves_move_the_vertices_by_their_standard_deviation() -> None:
    smooth, wavy = Crater(2).mesh[0], Crater(2, waviness=0.03, waviness_seed=5).mesh[0]
    np.testing.assert_array_equal(smooth[:, :2], wavy[:, :2])
    assert np.std(wavy[:, 2] - smooth[:, 2]) == pytest.approx(0.03, rel=0.1)
    assert not np.array_equal(wavy, Crater(2, waviness=0.03, waviness_seed=6).mesh[0])


def test_a_seed_determines_the_crater() -> None:
    assert Crater(3).blocks == Crater(3).blocks
    assert Crater(3).blocks != Crater(4).blocks
    assert Crater(3, boulders=False).blocks == ()


@pytest.fixture(scope="module")
def mental() -> VirtualTestbed:
    return CraterScenario(seed=1).mental().build()


@pytest.mark.slow
def test_feet_stand_on_the_wall_of_the_mesh(mental: VirtualTestbed) -> None:
    """Drake finds the surface of the prisms where the mesh has it."""
    vertices, triangles = Crater(1).mesh
    context = mental.default_context()
    scene_graph = mental.scene_graph
    assert scene_graph is not None
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    inspector = query.inspector()
    plant = mental.plant
    assert plant is not None
    rng = np.random.default_rng(0)
    for triangle in rng.choice(triangles, 20):
        corners = vertices[triangle]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        point = rng.dirichlet([2.0, 2.0, 2.0]) @ corners + 0.01 * normal
        near = [
            found.distance
            for found in query.ComputeSignedDistanceToPoint(point, 0.5)
            if "ground" in inspector.GetName(found.id_G)
        ]
        assert min(near) == pytest.approx(0.01, abs=1e-6)


def test_a_copy_of_the_dps_fits_into_the_mental_testbed(mental: VirtualTestbed) -> None:
    real = CraterScenario(seed=1, boulders=False, gullies=False, friction=0.5).build()
    mine, theirs = (
        {a: v.shape for a, v in testbed.variables().items() if a.startswith(("dps.", "u."))}
        for testbed in (real, mental)
    )
    assert mine == theirs
    assert real.event_timings() == mental.event_timings()


def climb(scenario: SpaceClimberScenario, *, friction: float, slope_deg: float) -> float:
    """Return how far the robot gets uphill in 12 s, in m along the slope; it looks uphill."""
    scenario = replace(scenario, friction=friction, slope_deg=-slope_deg)
    quality = vtb.Quality(lambda x: 0.0, of=["sim.sys.climber.base.x"])
    record = ("sim.sys.climber.base.x",)
    runner = RolloutRunner(RolloutTask(scenario, 12.0, quality, sample_period=4.0, record=record))
    x = runner.run({}).record["sim.sys.climber.base.x"]
    return float((x[-1] - x[1]) / np.cos(np.radians(slope_deg)))


def test_the_mental_integrator_slips_where_friction_ends() -> None:
    """On a slope of 22 deg, a friction of tan(31 deg) carries the robot up, and one of tan(19 deg) does not."""
    fast = CraterScenario().mental()
    scenario = SpaceClimberScenario(
        simulator_config=fast.simulator_config, plant_config=fast.plant_config, period=fast.period, payload=False
    )
    assert climb(scenario, friction=0.6, slope_deg=22.0) > 1.2
    assert climb(scenario, friction=0.35, slope_deg=22.0) < 0.0


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ([RIM_RADIUS + 2.0, 0.0, DEPTH + 0.3, 0.0, 0.0, 0.0], "has passed the rim"),
        ([0.0, 0.0, 1.0, 0.0, 1.1, 0.0], "has tipped over"),
        ([0.0, 0.0, 1.0, -1.1, 0.0, 0.5], "has tipped over"),
    ],
)
def test_a_climb_ends_past_the_rim_or_tipped_over(mental: VirtualTestbed, pose: list[float], message: str) -> None:
    context = mental.default_context()
    mental.write(context, {"sim.sys.climber.base.pose": pose})
    status = mental.simulator(context).AdvanceTo(0.1)
    assert message in status.FormatMessage()
    assert context.get_time() < 0.1


@pytest.mark.parametrize(("patience", "end"), [(0.0, 15.7), (4.0, 6.8)])
def test_a_robot_that_stands_is_stuck_after_its_patience(patience: float, end: float) -> None:
    """The system alone, with a robot that walks 0.2 m/s for 5 s and then stands."""
    system = EndOfClimb(BodyIndex(0), period=0.4, patience=patience)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for k in range(40):
        pose = RigidTransform([0.2 * min(0.4 * k, 5.0), 0.0, 0.2])
        system.get_input_port().FixValue(context, Value[list[RigidTransform]]([pose]))
        status = simulator.AdvanceTo(0.4 * k + 0.1)
        if "stuck" in status.FormatMessage():
            break
    # At 2.8 s it has come 0.56 m; the next 0.5 m would be reached at 1.06 m, but it stands at 1 m.
    assert context.get_time() == pytest.approx(end)


def test_the_believed_elevation_is_that_of_the_map(mental: VirtualTestbed) -> None:
    context = mental.default_context()
    place = [25.0, -5.0]
    mental.write(context, {"dps.impl.navigator.position": place, "dps.env.position": [1.0, 1.0, 0.21]})
    mental.start_from_belief(context)
    pose = mental.read(context, "sim.sys.climber.base.pose")
    np.testing.assert_allclose(pose[:3], [*place, 0.21 + float(Crater(1).height(*place))], atol=1e-9)
    assert pose[2] > 0.5


@pytest.mark.slow
def test_the_scanner_sees_the_ground_in_front_of_the_robot() -> None:
    scenario = replace(CraterScenario(seed=1, boulders=False).mental(), scans=True)
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {"u.walk": 0.0})
    testbed.simulator(context).AdvanceTo(4.2)
    scanner = testbed.diagram.GetSubsystemByName("sim.sense.scanner")
    scan = scanner.GetOutputPort("scan").Eval(scanner.GetMyContextFromRoot(context))
    pose = testbed.read(context, "sim.sys.climber.base.pose")
    points = (RigidTransform(RollPitchYaw(pose[3:]), pose[:3]) @ X_BL @ scan.points().T).T
    away = np.hypot(points[:, 0], points[:, 1])
    assert (np.abs(np.arctan2(points[:, 1], points[:, 0] - 0.35)) < np.radians(70.0)).all()
    assert 5.0 < away.max() < 20.0
    over = points[:, 2] - scenario.crater.mesh_height(points[:, :2])
    assert np.abs(over[away < 6.0]).max() < 0.1
    assert np.std(over[away < 6.0]) < 0.03


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"slope_deg": 5.0}, "slope_deg must be 0"),
        ({"clearance": 0.3}, "clearance must be a number from 0 to 0.15 m"),
        ({"waviness": -0.01}, "waviness must be a number from 0 to 0.1 m"),
        ({"seed": -1}, "seed must be a whole number of at least 0"),
    ],
)
def test_a_crater_that_makes_no_sense_is_refused(fields: dict[str, float], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        CraterScenario(**fields).build()

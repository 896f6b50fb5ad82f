"""A laser scanner measures what analytic geometry says at the firing time of each ray."""

import gc
import weakref
from dataclasses import dataclass, replace
from math import exp, isclose, radians, sqrt

import numpy as np
import pytest
from pydrake.geometry import Box, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from vtbdrake.common.scan import Scan
from vtbdrake.components.environment import Haze
from vtbdrake.components.ray_casting import TOLERANCE, RayCaster
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.components.sensors.laser_scanner import (
    LaserScanner,
    LaserScannerConfig,
    connect_laser_scanner,
    raster,
    raster_size,
)
from vtbdrake.state import collect
from vtbdrake.state import snapshot as snapshots

CONFIG = LaserScannerConfig(frequency=5.0, rays_per_second=5_000.0, azimuth=0.6, elevation=0.4)
# Errors of sums of Embree's 32 bits and of the integration of the motion.
EXACT = 2e-5


@dataclass
class World:
    """A scanner on a floating body, and a target."""

    diagram: Diagram
    plant: MultibodyPlant
    scanner: LaserScanner
    haze: Haze

    def simulator(
        self,
        *,
        X_WT: RigidTransform,
        V_WT: SpatialVelocity | None = None,
        V_WB: SpatialVelocity | None = None,
        **parameters: float,
    ) -> Simulator:
        simulator = Simulator(self.diagram)
        context = simulator.get_mutable_context()
        self.write(context, **parameters)
        own = self.plant.GetMyMutableContextFromRoot(context)
        at_rest = SpatialVelocity.Zero()
        for name, X, V in (("base", RigidTransform(), V_WB or at_rest), ("target", X_WT, V_WT or at_rest)):
            self.plant.SetFloatingBaseBodyPoseInWorldFrame(own, self.plant.GetBodyByName(name), X)
            index = self.plant.GetBodyByName(name).floating_velocities_start_in_v()
            v = np.array(self.plant.GetVelocities(own))
            v[index : index + 6] = V.get_coeffs()
            self.plant.SetVelocities(own, v)
        return simulator

    def write(self, context: Context, **parameters: float) -> None:
        variables = collect(self.diagram)
        for name, value in parameters.items():
            variables[f"haze.{name}" if name in ("extinction", "backscatter") else f"scanner.{name}"].set(
                context, value
            )

    def scan(self, context: Context) -> Scan:
        return self.scanner.GetOutputPort("scan").Eval(self.scanner.GetMyContextFromRoot(context))

    def scans(self, until: float, **start: object) -> list[Scan]:
        """All scans of a simulation."""
        simulator, found = self.simulator(**start), []
        for k in range(round(until / self.scanner.slice_period) + 1):
            simulator.AdvanceTo((k + 0.5) * self.scanner.slice_period)
            scan = self.scan(simulator.get_context())
            if scan.stamp and (not found or scan is not found[-1]):
                found.append(scan)
        return found


def world(
    shape: Shape,
    *,
    config: LaserScannerConfig = CONFIG,
    errors: ErrorModel | None = None,
    slice_period: float = 0.02,
) -> World:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    inertia = SpatialInertia.SolidSphereWithMass(10.0, 1.0)
    base, target = (plant.AddRigidBody(name, inertia) for name in ("base", "target"))
    plant.RegisterVisualGeometry(target, RigidTransform(), shape, "shape", [1.0, 1.0, 1.0, 1.0])
    plant.Finalize()
    caster = RayCaster(plant, scene_graph)
    scanner = LaserScanner(plant, base.body_frame(), caster, config=config, errors=errors, slice_period=slice_period)
    builder.AddNamedSystem("scanner", scanner)
    haze = builder.AddNamedSystem("haze", Haze())
    connect_laser_scanner(builder, scanner, plant, haze=haze)
    return World(builder.Build(), plant, scanner, haze)


def wall() -> Box:
    """Whose front face is at x = -0.5 of its frame."""
    return Box(1.0, 40.0, 40.0)


def at(x: float) -> RigidTransform:
    return RigidTransform([x, 0.0, 0.0])


def test_beams_turn_together() -> None:
    """Column by column: the elevation changes from ray to ray, the azimuth from column to column."""
    (scan,) = world(wall(), config=replace(CONFIG, rows=4)).scans(0.2, X_WT=at(4.5))
    assert raster_size(replace(CONFIG, rows=4)) == (4, 250)
    x, y, z = scan.directions_L.reshape(250, 4, 3).T
    np.testing.assert_allclose(np.arcsin(z), np.tile([[0.15], [0.05], [-0.05], [-0.15]], 250), atol=1e-9)
    left = 0.6 * ((np.arange(250) + 0.5) / 250 - 0.5)
    np.testing.assert_allclose(np.arctan2(y, x), np.tile(left, (4, 1)), atol=1e-9)
    np.testing.assert_allclose(scan.points()[:, 0], 4.0, atol=EXACT)


def test_scan_is_the_raster_on_a_wall() -> None:
    (scan,) = world(wall()).scans(0.2, X_WT=at(4.5))
    # 1000 rays: 26 rows with 38 rays each.
    rows, columns = 26, 38
    assert raster_size(CONFIG) == (rows, columns)
    left = 0.6 * ((np.arange(columns) + 0.5) / columns - 0.5)
    up = 0.4 * (0.5 - (np.arange(rows) + 0.5) / rows)
    y, z = np.tan(left)[np.newaxis, :], (np.tan(up)[:, np.newaxis] / np.cos(left))
    expected = 4.0 * np.stack(np.broadcast_arrays(1.0, y, z), axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(scan.points(), expected, atol=EXACT)
    assert scan.stamp == pytest.approx(0.2, abs=1e-12)
    np.testing.assert_allclose(scan.times, -0.2 + 0.2 * (np.arange(988) + 0.5) / 988, atol=1e-12)


@pytest.mark.parametrize("slice_period", [0.005, 0.02, 0.1])
def test_each_ray_meets_an_approaching_wall_at_its_own_time(slice_period: float) -> None:
    scans = world(wall(), slice_period=slice_period).scans(
        0.6, X_WT=at(4.5), V_WT=SpatialVelocity([0, 0, 0], [-0.5, 0, 0])
    )
    assert [scan.stamp for scan in scans] == pytest.approx([0.2, 0.4, 0.6])
    for scan in scans:
        np.testing.assert_allclose(scan.points()[:, 0], 4.0 - 0.5 * (scan.stamp + scan.times), atol=EXACT)


def test_each_ray_meets_a_passing_sphere_at_its_own_time() -> None:
    v = np.array([-0.3, 0.8, 0.2])
    scan = world(Sphere(0.5)).scans(0.2, X_WT=at(3.0), V_WT=SpatialVelocity([0, 0, 0], v))[-1]
    centers = np.array([3.0, 0.0, 0.0]) + (scan.stamp + scan.times)[:, np.newaxis] * v
    along = np.einsum("ij,ij->i", centers, scan.directions_L)
    expected = along - np.sqrt(along**2 - np.einsum("ij,ij->i", centers, centers) + 0.25)
    # Grazing rays see facets: where the sphere is steep, small depths are large ranges.
    steep = (along - expected) / 0.5 > 0.5
    assert steep.sum() > 100
    np.testing.assert_allclose(scan.ranges[steep], expected[steep], atol=3 * TOLERANCE)


def test_turning_scanner_sweeps_along_a_wall() -> None:
    rate = 0.4
    scan = world(wall()).scans(0.2, X_WT=at(4.5), V_WB=SpatialVelocity([0, 0, rate], [0, 0, 0]))[-1]
    heading = np.arctan2(scan.directions_L[:, 1], scan.directions_L[:, 0]) + rate * (scan.stamp + scan.times)
    flat = np.hypot(scan.directions_L[:, 0], scan.directions_L[:, 1])
    np.testing.assert_allclose(scan.ranges, 4.0 / (flat * np.cos(heading)), atol=EXACT)


def test_points_in_the_world_are_where_the_moving_scanner_has_hit() -> None:
    motion = SpatialVelocity([0.1, -0.2, 0.4], [0.5, 0.3, -0.1])
    pose = np.array([0.5, 0.1, 0.2, 0.3, -0.2, 0.1])
    scanned = world(wall())
    simulator = scanned.simulator(X_WT=at(4.5), V_WB=motion, pose=pose)
    simulator.AdvanceTo(0.33)
    context = scanned.scanner.GetMyContextFromRoot(simulator.get_context())
    points = scanned.scanner.points_W(context)
    assert len(points) == 988
    # The scanner is beside the centre of its turning body, whose path is not straight.
    np.testing.assert_allclose(points[:, 0], 4.0, atol=5e-3)
    assert np.abs(scanned.scan(simulator.get_context()).points()[:, 0] - 4.0).max() > 0.3


def test_pose_turns_the_scanner_on_its_body() -> None:
    pose = np.array([0.5, 0.1, 0.2, 0.3, -0.2, 0.1])
    scan = world(wall()).scans(0.2, X_WT=at(4.5), pose=pose)[-1]
    X_BL = RigidTransform(RollPitchYaw(pose[3:]), pose[:3])
    np.testing.assert_allclose((X_BL @ scan.points().T)[0], 4.0, atol=EXACT)


@pytest.mark.parametrize("frequency", [0.7, 7.0, 30.0, 50.0])
def test_frequency_needs_not_divide_that_of_the_slices(frequency: float) -> None:
    scans = world(wall()).scans(3.2 / min(frequency, 10.0), X_WT=at(4.5), frequency=frequency)
    assert len(scans) >= 3
    np.testing.assert_allclose(np.diff([0.0, *(scan.stamp for scan in scans)]), 1.0 / frequency, atol=1e-9)
    for scan in scans:
        assert len(scan.ranges) == pytest.approx(5_000.0 / frequency, rel=0.05)
        assert -1.0 / frequency <= scan.times[0] <= scan.times[-1] <= 0.0


def test_new_frequency_takes_effect_with_the_next_scan() -> None:
    of = world(wall())
    simulator = of.simulator(X_WT=at(4.5))
    simulator.AdvanceTo(0.31)
    of.write(simulator.get_mutable_context(), frequency=10.0)
    stamps = []
    for until in (0.41, 0.51, 0.61):
        simulator.AdvanceTo(until)
        stamps.append(of.scan(simulator.get_context()).stamp)
    assert stamps == pytest.approx([0.4, 0.5, 0.6])


def test_beams_that_change_in_a_scan_take_effect_with_the_next() -> None:
    of = world(wall())
    simulator = of.simulator(X_WT=at(4.5))
    simulator.AdvanceTo(0.11)
    of.write(simulator.get_mutable_context(), rows=4.0)
    (before,) = world(wall()).scans(0.2, X_WT=at(4.5))
    (after,) = world(wall(), config=replace(CONFIG, rows=4)).scans(0.2, X_WT=at(4.5))
    for until, expected in ((0.21, before), (0.41, after)):
        simulator.AdvanceTo(until)
        directions = of.scan(simulator.get_context()).directions_L
        np.testing.assert_array_equal(directions, expected.directions_L)


def test_noise_is_that_of_the_error_model_and_repeatable() -> None:
    of = world(wall(), errors=ErrorModel(noise=0.02, bias=0.1, seed=3))
    scans = of.scans(1.0, X_WT=at(4.5))
    errors = np.concatenate([scan.ranges - 4.0 / scan.directions_L[:, 0] for scan in scans])
    # Four standard deviations of the estimates from 4940 samples.
    assert errors.mean() == pytest.approx(0.1, abs=4 * 0.02 / sqrt(len(errors)))
    assert errors.std() == pytest.approx(0.02, abs=4 * 0.02 / sqrt(2 * len(errors)))
    again, other = of.scans(1.0, X_WT=at(4.5)), of.scans(1.0, X_WT=at(4.5), seed=4)
    for first, second, third in zip(scans, again, other, strict=True):
        assert first.ranges.tobytes() == second.ranges.tobytes()
        assert not np.allclose(first.ranges, third.ranges, atol=1e-4)


def test_limits_are_those_of_the_measured_ranges() -> None:
    """A wall at 4 m, 0.4 deviations of the noise from the limits."""
    for limits in ({"max_range": 4.02}, {"min_range": 3.98}):
        config = replace(CONFIG, reflectivity=1.0, azimuth=0.02, elevation=0.02, **limits)
        scan = world(wall(), config=config, errors=ErrorModel(noise=0.05)).scans(0.2, X_WT=at(4.5))[-1]
        assert config.min_range <= scan.ranges.min() and scan.ranges.max() <= config.max_range
        # 66 % of normal errors are below 0.4 deviations.
        assert len(scan.ranges) == pytest.approx(0.655 * 988, rel=0.1)


def test_outliers_are_as_many_and_as_large_as_declared() -> None:
    of = world(wall(), errors=ErrorModel(outlier_probability=0.2, outlier_size=0.3))
    scans = of.scans(1.0, X_WT=at(4.5))
    errors = np.concatenate([scan.ranges - 4.0 / scan.directions_L[:, 0] for scan in scans])
    off = np.abs(errors) > 1e-3
    assert off.mean() == pytest.approx(0.2, abs=4 * sqrt(0.16 / len(errors)) + 0.001)
    assert errors[off].std() == pytest.approx(0.3, rel=4 / sqrt(2 * off.sum()))


def test_quantization_rounds_and_dropout_takes_rays_away() -> None:
    of = world(wall(), errors=ErrorModel(quantization=0.25, dropout=0.3))
    scans = of.scans(1.0, X_WT=at(4.5))
    ranges = np.concatenate([scan.ranges for scan in scans])
    assert set(ranges) == {4.0, 4.25}
    sent = 5 * 988
    assert len(ranges) / sent == pytest.approx(0.7, abs=4 * sqrt(0.21 / sent))


def test_wide_beam_errs_by_distance_and_incidence() -> None:
    """On a wall tilted by a, an angle d of the beam changes the range by r tan(a) d."""
    angle, narrow = radians(60.0), replace(CONFIG, azimuth=0.01, elevation=0.008)
    of = world(wall(), config=replace(narrow, divergence=0.004))
    tilted = RigidTransform(RollPitchYaw(0.0, 0.0, angle), [4.0 + 0.5 / np.cos(angle), 0.0, 0.0])
    scans = of.scans(1.0, X_WT=tilted)
    left = np.concatenate([np.arctan2(scan.directions_L[:, 1], scan.directions_L[:, 0]) for scan in scans])
    up = np.concatenate([np.arcsin(scan.directions_L[:, 2]) for scan in scans])
    nominal = 4.0 * np.cos(angle) / (np.cos(up) * np.cos(left - angle))
    errors = np.concatenate([scan.ranges for scan in scans]) - nominal
    assert errors.std() == pytest.approx(4.0 * np.tan(angle) * 0.001, rel=4 / sqrt(2 * len(errors)) + 0.01)


def test_grazing_rays_drop_out_the_sooner_the_farther() -> None:
    for distance in (3.0, 6.0):
        config = replace(CONFIG, max_range=7.0, reflectivity=0.8, azimuth=0.7, elevation=0.7)
        scan = world(Sphere(1.0), config=config).scans(0.2, X_WT=at(distance))[-1]
        # The rays that hit, with a cosine of at least r^2 / (0.8 max_range^2).
        fired = raster(*raster_size(config), 0.7, 0.7)
        along = distance * fired[:, 0]
        below = along**2 - distance**2 + 1.0
        ranges = along - np.sqrt(np.where(below > 0.0, below, np.nan))
        cosines = (along - ranges) / 1.0
        margin = cosines - ranges**2 / 39.2
        clear = np.abs(margin) > 0.01
        returned = np.zeros(len(fired), dtype=bool)
        returned[np.argmax(fired @ scan.directions_L.T, axis=0)] = True
        np.testing.assert_array_equal(returned[clear], margin[clear] > 0.0)
        assert (margin[clear] < 0.0).sum() > 3


@pytest.mark.parametrize(("distance", "seen"), [(6.9, True), (7.2, False)])
def test_white_wall_returns_up_to_the_largest_range(distance: float, seen: bool) -> None:
    config = replace(CONFIG, max_range=10.0, reflectivity=0.5, azimuth=0.02, elevation=0.02)
    scan = world(wall(), config=config).scans(0.2, X_WT=at(distance + 0.5))[-1]
    assert bool(len(scan.ranges)) == seen


def test_nothing_is_reported_below_the_least_range() -> None:
    scan = world(wall(), config=replace(CONFIG, min_range=4.05)).scans(0.2, X_WT=at(4.5))[-1]
    assert 0 < len(scan.ranges) < 988
    assert scan.ranges.min() >= 4.05


@pytest.mark.parametrize("beyond", [False, True])
def test_haze_shortens_the_range_by_beer_and_lambert(beyond: bool) -> None:
    extinction = 0.1
    config = replace(CONFIG, max_range=10.0, reflectivity=1.0, azimuth=0.02, elevation=0.02)
    # r = max_range exp(-b r), by bisection.
    low, high = 0.0, 10.0
    while not isclose(low, high, rel_tol=1e-12):
        middle = (low + high) / 2.0
        low, high = (middle, high) if middle < 10.0 * exp(-extinction * middle) else (low, middle)
    distance = low + (0.02 if beyond else -0.02)
    scan = world(wall(), config=config).scans(0.2, X_WT=at(distance + 0.5), extinction=extinction)[-1]
    assert bool(len(scan.ranges)) != beyond


def test_haze_returns_before_the_wall_as_often_as_the_model_says() -> None:
    of = world(wall(), config=replace(CONFIG, max_range=20.0, min_range=0.5, azimuth=0.02, elevation=0.02))
    scans = of.scans(1.0, X_WT=at(4.5), backscatter=0.1)
    ranges = np.concatenate([scan.ranges for scan in scans])
    # A Poisson process between 0.5 m and 4 m; all others reach the wall.
    share = 1.0 - exp(-0.1 * 3.5)
    assert (ranges < 3.999).mean() == pytest.approx(share, abs=4 * sqrt(share * (1 - share) / len(ranges)))
    assert ranges.max() < 4.001


def test_snapshot_in_the_middle_of_a_scan_continues_alike() -> None:
    moving = {"X_WT": at(4.5), "V_WT": SpatialVelocity([0, 0.1, 0], [-0.5, 0, 0])}
    of, other = (world(wall(), errors=ErrorModel(noise=0.01, seed=1)) for _ in range(2))
    simulator = of.simulator(**moving)
    simulator.AdvanceTo(0.13)
    taken = snapshots.take(of.diagram, simulator.get_context(), collect(of.diagram))
    copy = Simulator(other.diagram)
    snapshots.apply(
        snapshots.Snapshot.load(taken.to_bytes()), other.diagram, copy.get_mutable_context(), collect(other.diagram)
    )

    simulator.AdvanceTo(0.45)
    copy.Initialize(InitializeParams(suppress_initialization_events=True))
    copy.AdvanceTo(0.45)
    first, second = of.scan(simulator.get_context()), other.scan(copy.get_context())
    assert first.stamp == second.stamp == pytest.approx(0.4)
    np.testing.assert_allclose(first.ranges, second.ranges, atol=1e-6)
    assert first.times.tobytes() == second.times.tobytes()


def test_clones_of_a_context_run_side_by_side() -> None:
    of = world(wall())
    simulator = of.simulator(X_WT=at(4.5))
    simulator.AdvanceTo(0.13)
    clone = Simulator(of.diagram, simulator.get_context().Clone())
    clone.AdvanceTo(0.21)
    simulator.AdvanceTo(0.21)
    scans = of.scan(simulator.get_context()), of.scan(clone.get_context())
    assert scans[0].stamp > 0.0
    assert scans[0].ranges.tobytes() == scans[1].ranges.tobytes()


def test_context_at_a_later_time_begins_a_scan_there() -> None:
    of = world(wall())
    simulator = of.simulator(X_WT=at(4.5))
    simulator.AdvanceTo(0.31)
    simulator.get_mutable_context().SetTime(100.0)
    simulator.Initialize()
    simulator.AdvanceTo(100.21)
    assert of.scan(simulator.get_context()).stamp == pytest.approx(100.2)


def test_resumed_scanner_shows_the_given_scan_until_its_next() -> None:
    of = world(wall())
    simulator = of.simulator(X_WT=at(4.5))
    simulator.AdvanceTo(0.13)
    given = Scan(np.array([[1.0, 0.0, 0.0]]), np.array([7.0]), np.array([-0.01]), 0.1)
    of.scanner.resume(of.scanner.GetMyMutableContextFromRoot(simulator.get_mutable_context()), given)
    simulator.AdvanceTo(0.31)
    assert of.scan(simulator.get_context()) is given
    simulator.AdvanceTo(0.35)
    assert of.scan(simulator.get_context()).stamp == pytest.approx(0.34)


def test_before_the_first_scan_there_are_no_returns() -> None:
    of = world(wall())
    assert len(of.scan(of.diagram.CreateDefaultContext()).ranges) == 0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"frequency": 0.0}, "frequency must be a finite number above 0 Hz, not 0.0"),
        ({"frequency": 60.0}, "frequency must be at most 50 Hz, one scan per slice, not 60.0"),
        ({"azimuth": 0.0}, "azimuth must be a number above 0 and at most 6.28319 rad"),
        ({"elevation": -0.1}, "elevation must be a number from 0 to 3.14159 rad"),
        ({"min_range": -1.0}, "min_range must be a finite number above 0 m"),
        ({"max_range": 0.1}, "max_range must be above the min_range, 0.2 m, not 0.1"),
        ({"rays_per_second": 1.0}, "at least one ray per scan"),
        ({"divergence": -1.0}, "divergence must be a number from 0 to below 0.5 rad"),
    ],
)
def test_impossible_scanners_are_refused(changed: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        world(wall(), config=replace(CONFIG, **changed))


def test_errors_that_scans_do_not_have_are_refused() -> None:
    with pytest.raises(ValueError, match="scans have no latency"):
        world(wall(), errors=ErrorModel(latency=1))


def test_impossible_parameters_of_a_context_stop_the_simulation() -> None:
    of = world(wall())
    simulator = of.simulator(X_WT=at(4.5), frequency=0.0)
    with pytest.raises(ValueError, match="frequency must be"):
        simulator.AdvanceTo(0.1)


def test_dropped_scanner_is_freed() -> None:
    made = weakref.ref(world(wall()).scanner)
    gc.collect()
    assert made() is None

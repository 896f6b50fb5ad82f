"""The testbeds of the localization unit: a carrier with a laser scanner among landmarks, and that in a forest."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Diagram, System

from vtbdrake.common.arrays import Array
from vtbdrake.common.scan import Scan
from vtbdrake.common.settings import setting
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.dead_reckoning import HISTORY_LENGTH, DriftModel
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.pedestrian import PedestrianDriftModel
from vtbdrake.components.localization.rocks import RockDetectorConfig, detect_rocks
from vtbdrake.components.localization.stereo_trunks import StereoTrunkDetectorConfig
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.components.localization.trunks import TrunkDetectorConfig, detect_trunks
from vtbdrake.components.localization.unit import LocalizationUnit
from vtbdrake.components.sensors import ErrorModel, Imu
from vtbdrake.components.sensors.laser_scanner import LaserScannerConfig, raster_size
from vtbdrake.components.world_model import GeoJsonError, WorldModel, load_geojson
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.lcm.sensor_messages import image_array_map, scan_map
from vtbdrake.testbed import Interface, Scenario, ScenarioError, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.forest.dps import PERIOD, make_deployment, make_dps
from vtbdrake_diagrams.forest.perception import LandmarkSensor, Localizer, ScanLandmarks, detect_all
from vtbdrake_diagrams.forest.stereo import IMAGES, StereoConfig, StereoLandmarks, add_stereo
from vtbdrake_diagrams.forest.world.ground import Ground
from vtbdrake_diagrams.forest.world.routes import Route
from vtbdrake_diagrams.forest.world.stand import KINDS, MAPS, MapErrors, Stand
from vtbdrake_diagrams.forest.world.vegetation import Vegetation
from vtbdrake_diagrams.plain.rocks import RockField

if TYPE_CHECKING:
    from vtbdrake_diagrams.forest.world.driver import Driver

PERCEPTIONS = ("scanner", "stereo", "both")
LEAST_ROCK_HEIGHT = 0.1
"""The least height over the ground of a point of a rock, in m, see `RockDetectorConfig`."""
LANDMARKS = {"trees": ("tree",), "rocks": ("rock",), "both": ("tree", "rock")}
"""The landmarks of the unit in a forest, and their classes in truth and map."""
CARRIERS = ("machine", "hand", "back")
"""The carriers of the unit: a machine on wheels, or a worker on foot, in the hand or on the back."""

# The least standard deviation of ranges, in m, that a detector assumes, also of a scanner with exact ranges.
_LEAST_RANGE_NOISE = 0.005

# Standard deviation of the error of the vertical in rad, per axis, which displaces the detections of a high sensor. It
# lies between the errors of pitch that `drives` prints, for later than ten seconds after the start, for the forest and
# for the plain; the first seconds are worse. Constant errors, as of a misaligned scanner, are not simulated, and not
# contained.
_LEVELLING = 0.001
# Standard deviation in m, per axis, by which a whole scan of a walking worker is displaced: by the vertical, and by how
# the unit moves sideways within a scan, which dead reckoning does not know. Calibrated with forests 300,000 to 300,003
# of `on_foot`.
_SCAN_ON_FOOT = 0.015
# Standard deviation of the error that all steps of a worker have in common, as a share of their length; assumed.
_STEP_LENGTH = 0.08


def plant_config() -> MultibodyPlantConfig:
    """Return the configuration of the plant: discrete, as the wheels are updated with its time step."""
    return MultibodyPlantConfig(time_step=0.01, discrete_contact_approximation="sap", use_sampled_output_ports=False)


def scanner_config() -> LaserScannerConfig:
    """Return a scanner with 16 beams over 30 deg that turns five times per second and fires 20,000 rays per turn."""
    return LaserScannerConfig(
        frequency=5.0,
        rays_per_second=100_000.0,
        azimuth=2.0 * np.pi,
        elevation=np.radians(30.0),
        rows=16,
        min_range=0.5,
        max_range=50.0,
    )


@dataclass
class CarrierScenario(Scenario):
    """A carrier with scanner, IMU and wheel odometry drives on routes among landmarks, or a worker carries the unit.

    A worker on foot has no wheels: the speed comes from steps that the IMU shows (`Pedometer`). The driver, or the
    worker, follows the route that the DPS advises, which the command ``u.route`` sets. The true pose of the carrier, on
    foot of the unit, is ``sim.sys.carrier.base.pose``.
    """

    # The classes of the landmarks in truth and map.
    landmark_classes: ClassVar[tuple[str, ...]]

    plant_config: MultibodyPlantConfig = field(default_factory=plant_config)
    seed: int = setting(0, "Determines landmarks, ground, roads, clutter and map.", ge=0)
    # The area is from (0, 0) to (length, width).
    length: float = setting(100.0, unit="m")
    width: float = setting(100.0, unit="m")
    gravity: float = setting(9.81, "Acceleration of free fall.", unit="m/s^2", gt=0.0)
    relief: float = setting(0.8, "Standard deviation of the heights of hills, see `Ground`.", unit="m")
    bumps: float = setting(0.04, "Standard deviation of the heights of bumps.", unit="m")
    map: str = setting("accurate", "The quality of the global map of the DPS, see `MAPS`.", choices=tuple(MAPS))
    map_seed: int = setting(0, "Determines the errors of the map.", ge=0)
    map_file: str = setting("", "A GeoJSON file to take the global map from instead; empty for none.")
    revises_map: bool = setting(False, "Whether the DPS revises its map while it drives, see `Tracker`.")
    carrier: str = setting(
        "machine",
        "A machine on wheels, or a worker on foot with the unit in the hand or on the back.",
        choices=CARRIERS,
    )
    step_frequency: float = setting(
        1.85, "Steps per second of the worker at 1.2 m/s, which the unit does not know.", unit="Hz", ge=1.2, le=2.5
    )
    # The laser scanner, and the errors of its ranges in m.
    scanner: LaserScannerConfig = field(default_factory=scanner_config)
    scanner_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=0.02))
    scanner_height: float = setting(
        2.0, "Height of the scanner over the ground.", unit="m", ge=1.3, le=6.0, remedy="over the carrier's roof"
    )
    scanner_forward: float = setting(
        0.9,
        "Distance of the scanner in front of the middle of the machine; on foot, it is where the IMU is.",
        unit="m",
        ge=-1.25,
        le=1.25,
        remedy="on the carrier",
    )
    scanner_tilt_deg: float = setting(0.0, "Tilt of the scanner towards the ground.", unit="deg", ge=-45.0, le=45.0)
    # Errors of the IMU: noise, bias and drift hold for gyros (rad/s) and accelerometers (m/s^2) alike.
    imu_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=2e-3, bias=5e-4, drift=1e-5))
    # Errors of the measured speed of the wheels in m/s.
    odometry_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=0.02))
    odometry_scale: float = setting(1.01, "Measured over true speed of the wheels.", ge=0.5, le=2.0)
    speed: float = setting(1.0, "Speed of the drive.", unit="m/s", ge=0.0, le=3.0)
    route: int = setting(0, "The number of the first route, which is also advised at first.", ge=0)
    start: float = setting(0.0, "Distance along the route at which the drive begins.", unit="m", ge=0.0)
    laps: int = setting(100, "Number of laps after which the driver stops.", ge=1)
    localizer_latency: float = setting(
        0.1,
        "Time from the sample of a scan in the DPS to its pose.",
        unit="s",
        ge=PERIOD,
        remedy="the least is the period of the DPS",
    )

    def validate(self) -> None:
        super().validate()
        if not self.plant_config.time_step > 0.0:
            raise ScenarioError(
                f"{type(self).__name__}.plant_config.time_step must be a number above 0 s, not "
                f"{self.plant_config.time_step!r}: the wheels are stepped with a discrete plant"
            )
        try:
            self.check_perception()
            self.ground()
            routes = self.routes()
        except ValueError as error:
            raise ScenarioError(f"{type(self).__name__}: {error}") from None
        if not self.route < len(routes):
            raise ScenarioError(
                f"{type(self).__name__}.route must be the number of one of {len(routes)} routes, not {self.route}"
            )

    @property
    def classes(self) -> tuple[str, ...]:
        """The classes of the landmarks in truth and map."""
        return self.landmark_classes

    @property
    def is_on_foot(self) -> bool:
        """Return whether a worker carries the unit."""
        return self.carrier != "machine"

    def ground(self) -> Ground:
        """Return the ground."""
        return Ground(self.seed, relief=self.relief, bumps=self.bumps)

    @property
    def X_BL(self) -> RigidTransform:
        """The pose of the scanner L on the carrier B."""
        tilt = RollPitchYaw(0.0, np.radians(self.scanner_tilt_deg), 0.0)
        if self.is_on_foot:
            return RigidTransform(tilt, [0.0, 0.0, 0.0])
        return RigidTransform(tilt, [self.scanner_forward, 0.0, self.scanner_height])

    @abstractmethod
    def routes(self) -> tuple[Route, ...]:
        """Return the routes by number."""

    @abstractmethod
    def truth(self) -> WorldModel:
        """Return the true landmarks."""

    @abstractmethod
    def surveyed_map(self, errors: MapErrors) -> WorldModel:
        """Return the map of the landmarks by a survey with these errors, of the seed ``map_seed``."""

    @abstractmethod
    def add_landscape(self, plant: MultibodyPlant) -> None:
        """Add ground, landmarks and clutter to a plant that is not finalized."""

    def global_map(self) -> WorldModel:
        """Return the map that the DPS has: the one in ``map_file``, which has errors as ``map`` says, or a survey.

        Features of a file without a covariance get the deviation of ``map``.

        Raises:
            GeoJsonError: The file is no map, or one of another place.
        """
        if not self.map_file:
            return self.surveyed_map(MAPS[self.map])
        mapped = load_geojson(self.map_file, deviation=MAPS[self.map].position)
        places, area = mapped.positions()[:, :2], np.array([self.length, self.width])
        if len(places) and not ((places >= 0.0) & (places <= area)).all(axis=1).any():
            x, y = places.mean(axis=0).tolist()
            raise GeoJsonError(
                f"{self.map_file}: no object lies in the area from (0, 0) to ({self.length:g}, {self.width:g}) m, "
                f"their mean is ({x:.0f}, {y:.0f}) m: local_frame of the file must be where the origin of the area is"
            )
        return mapped

    def check_perception(self) -> None:
        """Check the configuration of the sensor that detects landmarks.

        Raises:
            ValueError: A value of the scanner is outside of its range, or a scan takes too long.
        """
        self.scanner.check(PERIOD)
        # A scan takes at most half of the history, as it may have to wait for the one before it.
        least = 2.0 / HISTORY_LENGTH
        if self.scanner.frequency < least:
            raise ValueError(
                f"scanner.frequency must be at least {least:g} Hz, not {self.scanner.frequency:g}: the DPS remembers "
                f"the motion of the last {HISTORY_LENGTH:g} s"
            )

    @property
    def perception_periods(self) -> tuple[float, ...]:
        """The period of each of the `sensors`, in s."""
        return (1.0 / self.scanner.frequency,)

    def perception_signals(self) -> list[Signal]:
        """Return the signals of the sensors that detect landmarks."""
        return [Signal("scan", model_value=Scan.empty(), max_age=5.0 / self.scanner.frequency)]

    def interface(self) -> Interface:
        routes = range(len(self.routes()))
        odometry = Signal("odometry", size=1, unit="m/s", lower=-5.0, upper=5.0, max_age=5 * PERIOD)
        return Interface(
            sense=[
                *self.perception_signals(),
                Signal("imu", size=6, unit="rad/s, m/s^2", lower=-50.0, upper=50.0, max_age=5 * PERIOD),
                *([] if self.is_on_foot else [odometry]),
            ],
            act=[Signal("route", size=1, values=routes, idle=float(self.route))],
            commands=[Signal("route", size=1, values=routes, default=float(self.route))],
        )

    @abstractmethod
    def detector(self) -> Callable[..., Landmarks]:
        """Return the function that detects landmarks in scans, see `LandmarkSensor`."""

    def sensors(self) -> tuple[LandmarkSensor, ...]:
        """Return the sensors that detect landmarks."""
        return (LandmarkSensor(self.detector(), field_of_view=self.scanner.azimuth),)

    def scanner_accuracy(self) -> dict[str, float]:
        """Return angles between rays (rad), noise of ranges (m) and z of the ground (m), as detectors name them."""
        rows, columns = raster_size(self.scanner)
        return {
            "azimuth_step": self.scanner.azimuth / columns,
            "elevation_step": self.scanner.elevation / rows,
            "range_noise": max(self.scanner_errors.noise, _LEAST_RANGE_NOISE),
            "ground_height": -self.scanner_height if self.is_on_foot else 0.0,
        }

    def unit(self, world_map: WorldModel) -> LocalizationUnit:
        """Return the localization unit for a map, which has the errors of ``map``."""
        of_classes = [map_landmarks(world_map, name) for name in self.classes]
        landmarks, correlation = Landmarks.joined(of_classes), MAPS[self.map].correlation
        x, y, z = self.X_BL.translation().tolist()
        tracker = Tracker(
            landmarks,
            sensor=(x, y),
            field_of_view=self.scanner.azimuth,
            scan_deviation=_SCAN_ON_FOOT if self.is_on_foot else _LEVELLING * z,
            correlation=correlation,
            revises=self.revises_map,
        )
        if self.is_on_foot:
            tracker = replace(tracker, odometry_deviation=_STEP_LENGTH)
        return LocalizationUnit(ConstellationMap(landmarks, correlation=correlation), tracker, drift=self.drift())

    def drift(self) -> DriftModel:
        """Return the drift of the dead reckoning."""
        return PedestrianDriftModel() if self.is_on_foot else DriftModel()

    def make_dps(self) -> Diagram:
        world_map = self.global_map()
        signals = {signal.name: signal.model_value for signal in self.perception_signals()}
        try:
            unit = self.unit(world_map)
        except ValueError as error:
            if self.map_file:
                raise GeoJsonError(f"{self.map_file}: {error}") from error
            raise
        localizer = Localizer(self.sensors(), unit)
        latency, drift = self.localizer_latency, self.drift()
        return make_dps(world_map, localizer, signals, latency=latency, drift=drift, on_foot=self.is_on_foot)

    def deployment(self) -> Deployment:
        return make_deployment((scan_map("SCAN", "scan"), 1.0 / self.scanner.frequency), on_foot=self.is_on_foot)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(self.plant_config)
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -self.gravity])
        self.add_landscape(plant)
        route = self.routes()[self.route]
        start = self.start % route.length
        place = {"position": route.position(start), "heading": route.heading(start)}
        if self.is_on_foot:
            self._add_worker(builder, **place)
        else:
            self._add_machine(builder, **place)
        self.add_perception(builder)

    def _add_machine(self, builder: VirtualTestbedBuilder, *, position: Array, heading: float) -> None:
        """Add the machine with its wheels, odometer and driver, and what is believed of them."""
        # Imported here: the DPS on the carrier runs without a plant.
        from vtbdrake_diagrams.forest.belief import declare_belief
        from vtbdrake_diagrams.forest.world.carrier import (
            Carrier,
            WheelOdometer,
            Wheels,
            add_carrier,
            standing_pose,
        )

        plant, carrier, ground = builder.plant, Carrier(), self.ground()
        base = add_carrier(plant, carrier, self.X_BL)
        X_WB = standing_pose(carrier, ground, position=position, heading=heading)
        plant.SetDefaultFloatingBaseBodyPose(base, X_WB)
        plant.Finalize()
        wheels = builder.add("act", "wheels", Wheels(plant, base, carrier, ground))
        size, start = plant.num_multibody_states(), base.floating_positions_start()
        driver = self._add_driver(builder, size=size, start=start, wheel_base=carrier.wheel_base)
        builder.connect(plant.get_state_output_port(), driver.GetInputPort("state"))
        self._connect_motion(builder, wheels, driver)
        self._add_imu(builder, base)
        odometer = WheelOdometer(period=PERIOD, scale=self.odometry_scale, errors=self.odometry_errors)
        builder.add("sense", "odometry", odometer)
        builder.connect(wheels.GetOutputPort("speed"), odometer.GetInputPort("speed"))
        builder.sim_sensor("odometry", odometer.get_output_port())
        # The samples of IMU and odometry are one period old.
        declare_belief(builder, carrier, ground, self.routes(), age=PERIOD)

    def _add_worker(self, builder: VirtualTestbedBuilder, *, position: Array, heading: float) -> None:
        """Add the worker who carries the unit along the route, and what is believed of both."""
        from vtbdrake_diagrams.forest.belief import declare_belief_on_foot
        from vtbdrake_diagrams.forest.world.worker import WALKER, Legs, Worker, add_worker

        plant, ground = builder.plant, self.ground()
        worker = Worker.carrying(self.carrier, height=self.scanner_height, step_frequency=self.step_frequency)
        base = add_worker(plant, worker, self.X_BL)
        plant.Finalize()
        legs = Legs(plant, base, worker, ground, position=position, heading=heading, seed=self.seed)
        plant.SetDefaultFloatingBaseBodyPose(base, legs.unit_pose(position, heading, 0.0, 0.0, time=0.0))
        builder.add("act", "legs", legs)
        driver = self._add_driver(builder, size=WALKER, start=0, wheel_base=0.0)
        builder.connect(legs.GetOutputPort("walker"), driver.GetInputPort("state"))
        self._connect_motion(builder, legs, driver)
        self._add_imu(builder, base)
        declare_belief_on_foot(builder, worker, ground, self.routes(), age=PERIOD)

    def _add_imu(self, builder: VirtualTestbedBuilder, base: RigidBody) -> None:
        builder.add_sensor("imu", Imu(builder.plant, base.body_frame(), period=PERIOD, errors=self.imu_errors))

    def _add_driver(self, builder: VirtualTestbedBuilder, *, size: int, start: int, wheel_base: float) -> Driver:
        """Add the driver and return it, see `Driver`; its port ``state`` is still to be connected."""
        from vtbdrake_diagrams.forest.world.driver import Driver

        routes = self.routes()
        driver = Driver(
            routes,
            size=size,
            start=start,
            wheel_base=wheel_base,
            period=PERIOD,
            speed=self.speed,
            laps=self.laps,
            route=self.route,
            along=self.start % routes[self.route].length,
        )
        builder.add("act", "driver", driver)
        builder.sim_actuator("route", driver.GetInputPort("route"))
        return driver

    @staticmethod
    def _connect_motion(builder: VirtualTestbedBuilder, motion: System, driver: Driver) -> None:
        """Connect wheels or legs with the plant and with their driver."""
        plant = builder.plant
        builder.connect(plant.get_state_output_port(), motion.GetInputPort("state"))
        builder.connect(driver.GetOutputPort("controls"), motion.GetInputPort("controls"))
        builder.connect(motion.GetOutputPort("spatial_force"), plant.get_applied_spatial_force_input_port())

    def add_perception(self, builder: VirtualTestbedBuilder) -> None:
        """Add the sensor that detects landmarks to the simulated world: the scanner."""
        from vtbdrake.components.ray_casting import RayCaster
        from vtbdrake.components.sensors.laser_scanner import LaserScanner, connect_laser_scanner

        plant = builder.plant
        caster = RayCaster(plant, builder.scene_graph)
        frame = plant.GetFrameByName("scanner")
        scanner = LaserScanner(plant, frame, caster, config=self.scanner, errors=self.scanner_errors)
        builder.add("sense", "scanner", scanner)
        connect_laser_scanner(builder.diagram_builder, scanner, plant)
        builder.sim_sensor("scan", scanner.GetOutputPort("scan"))


@dataclass
class ForestScenario(CarrierScenario):
    """A carrier in a forest stand with strip roads; the landmarks are trees.

    With ``perception="stereo"``, a pair of cameras takes the place of the scanner, and the trees have bark; with
    ``"both"``, the unit has scanner and cameras, and fuses what they see in one filter.
    """

    landmark_classes: ClassVar[tuple[str, ...]] = ("tree",)

    perception: str = setting("scanner", "The sensor that detects trees, or both.", choices=PERCEPTIONS)
    # The pair of cameras.
    stereo: StereoConfig = field(default_factory=StereoConfig)

    stand_kind: str = setting("natural", "The pattern of the trees, see `Stand`.", choices=KINDS)
    density: float = setting(800.0, "Trees per area, before the roads are cleared.", unit="1/ha")
    road_width: float = setting(4.0, "Width of the strip roads.", unit="m", ge=3.0, remedy="the carrier is 1.5 m wide")
    road_spacing: float = setting(28.0, "Distance between the strip roads.", unit="m")
    undergrowth: float = setting(300.0, "Bushes per area.", unit="1/ha")
    branches: float = setting(6.0, "Dead branches per tree.")
    lean: float = setting(0.01, "Standard deviation of the inclination of trunks.", unit="rad")
    rock_cover: float = setting(
        0.0, "The share of the ground that rocks cover, see `RockField`; 0: none.", ge=0.0, le=0.3
    )
    landmarks: str = setting(
        "trees", "The landmarks that the unit uses; rocks need a scanner with many rows.", choices=tuple(LANDMARKS)
    )

    def validate(self) -> None:
        super().validate()
        if self.landmarks != "trees" and not (self.rock_cover and self.has_scanner):
            raise ScenarioError(
                f"{type(self).__name__}.landmarks={self.landmarks!r} needs rocks and a scanner: rock_cover must be "
                f"above 0, not {self.rock_cover:g}, and perception not {self.perception!r}"
            )
        try:
            self.vegetation()
            self.rock_field()
        except ValueError as error:
            raise ScenarioError(f"{type(self).__name__}: {error}") from None

    def stand(self) -> Stand:
        """Return the stand."""
        return Stand(
            self.seed,
            length=self.length,
            width=self.width,
            density=self.density,
            kind=self.stand_kind,
            road_width=self.road_width,
            road_spacing=self.road_spacing,
        )

    def vegetation(self) -> Vegetation:
        """Return the clutter."""
        return Vegetation(self.seed, undergrowth=self.undergrowth, branches=self.branches, lean=self.lean)

    def rock_field(self) -> RockField | None:
        """Return the rocks, which leave the strip roads free; None without rocks."""
        if not self.rock_cover:
            return None
        return RockField(
            self.seed,
            length=self.length,
            width=self.width,
            abundance=self.rock_cover,
            track_width=self.road_width,
            track_spacing=self.road_spacing,
        )

    @property
    def classes(self) -> tuple[str, ...]:
        return LANDMARKS[self.landmarks]

    def routes(self) -> tuple[Route, ...]:
        return self.stand().routes()

    def truth(self) -> WorldModel:
        rocks = self.rock_field()
        return WorldModel([*self.stand().trees(), *(rocks.rocks() if rocks else ())])

    def surveyed_map(self, errors: MapErrors) -> WorldModel:
        rocks = self.rock_field()
        trees = self.stand().map(errors, seed=self.map_seed)
        if rocks is None:
            return trees
        surveyed = rocks.map(errors, seed=self.map_seed)
        return WorldModel([*trees, *(replace(rock, identity=f"rock-{rock.identity}") for rock in surveyed)])

    def add_landscape(self, plant: MultibodyPlant) -> None:
        from vtbdrake_diagrams.forest.world.geometry import add_forest
        from vtbdrake_diagrams.plain.geometry import add_rocks

        textured = self.has_stereo
        add_forest(plant, self.stand(), self.ground(), self.vegetation(), textured=textured)
        rocks = self.rock_field()
        if rocks is not None:
            add_rocks(plant, rocks.rocks(), self.ground())

    @property
    def has_scanner(self) -> bool:
        """Return whether the unit has the scanner."""
        return self.perception != "stereo"

    @property
    def has_stereo(self) -> bool:
        """Return whether the unit has the pair of cameras."""
        return self.perception != "scanner"

    def check_perception(self) -> None:
        if self.has_scanner:
            super().check_perception()
        if self.has_stereo:
            self.stereo.check()

    @property
    def perception_periods(self) -> tuple[float, ...]:
        of_cameras = (1.0 / self.stereo.fps,) if self.has_stereo else ()
        return (*(super().perception_periods if self.has_scanner else ()), *of_cameras)

    def perception_signals(self) -> list[Signal]:
        signals = super().perception_signals() if self.has_scanner else []
        if self.has_stereo:
            from pydrake.systems.sensors import ImageRgba8U

            image = ImageRgba8U(self.stereo.width, self.stereo.height)
            signals += [Signal(name, model_value=image, max_age=5.0 / self.stereo.fps) for name in IMAGES]
        return signals

    def detector(self) -> ScanLandmarks:
        detectors = [self.detector_of(name) for name in self.classes]
        if len(detectors) == 1:
            return detectors[0]
        return ScanLandmarks(detect_all, [(each.detect, each.settings) for each in detectors], self.X_BL)

    def detector_of(self, name: str) -> ScanLandmarks:
        """Return the detector of landmarks of one class in scans.

        Args:
            name: The class, ``tree`` or ``rock``.
        """
        accuracy = self.scanner_accuracy()
        if name == "rock":
            return ScanLandmarks(
                detect_rocks, RockDetectorConfig(**accuracy, least_height=LEAST_ROCK_HEIGHT), self.X_BL
            )
        return ScanLandmarks(detect_trunks, TrunkDetectorConfig(**accuracy), self.X_BL)

    def sensors(self) -> tuple[LandmarkSensor, ...]:
        scanner = super().sensors() if self.has_scanner else ()
        if not self.has_stereo:
            return scanner
        camera, X_BC = self.stereo.camera(), self.X_BL @ self.stereo.poses()[IMAGES[0]]
        detect = StereoLandmarks(camera, self.stereo.matcher(), StereoTrunkDetectorConfig(), X_BC)
        return (*scanner, LandmarkSensor(detect, IMAGES, field_of_view=camera.fov_x, is_scan=not scanner))

    def unit(self, world_map: WorldModel) -> LocalizationUnit:
        unit = super().unit(world_map)
        if self.has_scanner:
            return unit
        tracker = replace(unit.tracker, field_of_view=self.stereo.camera().fov_x)
        return replace(unit, tracker=tracker, begins_with_submap=True)

    def deployment(self) -> Deployment:
        maps: list[tuple[LcmMap, float]] = []
        if self.has_scanner:
            maps.append((scan_map("SCAN", "scan"), 1.0 / self.scanner.frequency))
        if self.has_stereo:
            maps.append((image_array_map("IMAGES", {name: name for name in IMAGES}), 1.0 / self.stereo.fps))
        return make_deployment(*maps, on_foot=self.is_on_foot)

    def add_perception(self, builder: VirtualTestbedBuilder) -> None:
        if self.has_scanner:
            super().add_perception(builder)
        if self.has_stereo:
            add_stereo(builder, builder.plant.GetFrameByName("scanner"), self.stereo)

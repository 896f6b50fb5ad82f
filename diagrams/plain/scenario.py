"""The testbed of the localization unit on a plain with rocks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.common.settings import setting
from vtbdrake.components.localization.rocks import RockDetectorConfig, detect_rocks
from vtbdrake.components.sensors.laser_scanner import LaserScannerConfig
from vtbdrake.components.world_model import WorldModel
from vtbdrake_diagrams.forest.perception import ScanLandmarks
from vtbdrake_diagrams.forest.scenario import LEAST_ROCK_HEIGHT, CarrierScenario
from vtbdrake_diagrams.forest.world.routes import Route
from vtbdrake_diagrams.forest.world.stand import MapErrors
from vtbdrake_diagrams.plain.rocks import RockField


def scanner_config() -> LaserScannerConfig:
    """Return a scanner for low landmarks: 64 beams over 33 deg, 65,536 rays per turn, five turns per second."""
    return LaserScannerConfig(
        frequency=5.0,
        rays_per_second=5.0 * 65_536.0,
        azimuth=2.0 * np.pi,
        elevation=np.radians(33.0),
        rows=64,
        min_range=0.5,
        max_range=100.0,
    )


@dataclass
class PlainScenario(CarrierScenario):
    """A carrier on a rock-strewn plain of Mars with cleared tracks; the landmarks are rocks."""

    landmark_classes: ClassVar[tuple[str, ...]] = ("rock",)

    gravity: float = 3.71
    relief: float = 0.5
    bumps: float = 0.02
    scanner: LaserScannerConfig = field(default_factory=scanner_config)
    abundance: float = setting(0.05, "The share of the ground that rocks cover, see `RockField`.")
    least_diameter: float = setting(0.3, "The diameter of the smallest rocks.", unit="m")
    track_width: float = setting(4.0, "Width of the tracks.", unit="m", ge=3.0, remedy="the carrier is 1.5 m wide")
    track_spacing: float = setting(28.0, "Distance between the tracks.", unit="m")

    def rock_field(self) -> RockField:
        """Return the rocks of the plain."""
        return RockField(
            self.seed,
            length=self.length,
            width=self.width,
            abundance=self.abundance,
            least_diameter=self.least_diameter,
            track_width=self.track_width,
            track_spacing=self.track_spacing,
        )

    def routes(self) -> tuple[Route, ...]:
        return self.rock_field().routes()

    def truth(self) -> WorldModel:
        return self.rock_field().rocks()

    def surveyed_map(self, errors: MapErrors) -> WorldModel:
        return self.rock_field().map(errors, seed=self.map_seed)

    def detector(self) -> ScanLandmarks:
        return ScanLandmarks(
            detect_rocks, RockDetectorConfig(**self.scanner_accuracy(), least_height=LEAST_ROCK_HEIGHT), self.X_BL
        )

    def add_landscape(self, plant: MultibodyPlant) -> None:
        from vtbdrake_diagrams.plain.geometry import add_plain

        add_plain(plant, self.rock_field(), self.ground())

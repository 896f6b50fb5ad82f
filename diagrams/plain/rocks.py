"""A planetary plain that is strewn with rocks, and maps of its rocks.

The share of the ground that is covered by rocks with a diameter of D or more is k exp(-q D), with the rock abundance k
and q = 1.79 + 0.152 / k per m (Golombek and Rapp, "Size-frequency distributions of rocks on Mars and Earth analog
sites", J. Geophys. Res. 102, 1997). Abundances near landing sites on Mars were 2 % (Phoenix), 3 % (InSight), 5 %
(Spirit) and 19 % (Pathfinder), after Golombek and others ("Rock size-frequency distributions of the InSight landing
site, Mars", Earth and Space Science 8, 2021). The shapes of the rocks are assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.meshes import Surface, copies, unit_sphere
from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.world_model import AttributeValue, WorldModel, WorldObject, position_estimate
from vtbdrake_diagrams.forest.world.ground import Ground
from vtbdrake_diagrams.forest.world.routes import Route, distances, strip_roads
from vtbdrake_diagrams.forest.world.stand import MapErrors, surveyed

# Streams of random numbers; the forest has others.
_ROCKS = 6
_MAP = 7

# Range of length over width.
_ELONGATION = (1.0, 1.2)
# Range of height over diameter, for the whole rock: only its upper half sticks out.
_FLATNESS = (0.8, 1.2)


@dataclass(frozen=True)
class RockField:
    """Rocks on a plain from (0, 0) to (length, width), which do not touch. The same seed gives the same rocks."""

    seed: int = setting(0, "Determines rocks, tracks and maps.", ge=0)
    length: float = setting(100.0, "Extent along x.", unit="m", gt=0)
    width: float = setting(100.0, "Extent along y.", unit="m", gt=0)
    abundance: float = setting(0.05, "Share k of the ground that rocks of all sizes cover.", ge=0.005, le=0.3)
    least_diameter: float = setting(
        0.3, "Diameter of the smallest rocks that are not left out.", unit="m", ge=0.1, below="largest_diameter"
    )
    largest_diameter: float = setting(2.0, "Diameter of the largest rocks.", unit="m", le=5)
    track_width: float = setting(0.0, "Width of the tracks, which have no rocks; 0: no tracks.", unit="m", ge=0, le=8)
    track_spacing: float = setting(28.0, "Distance of the tracks.", unit="m", gt=0)

    def __post_init__(self) -> None:
        check_settings(self)

    def density(self) -> float:
        """Return the number of rocks per m^2, before tracks are cleared."""
        return float(self._cumulative()[1][-1])

    def diameters(self, uniform: Array) -> Array:
        """Return the diameters (m), (n,), at which the distribution of rocks has the probabilities ``uniform`` (n,)."""
        diameters, number = self._cumulative()
        interpolated: Array = np.interp(uniform * number[-1], number, diameters)
        return interpolated

    def routes(self) -> tuple[Route, ...]:
        """Return the routes along the tracks; none without tracks."""
        if self.track_width == 0.0:
            return ()
        return strip_roads(self.length, self.width, spacing=self.track_spacing, seed=self.seed)

    def rocks(self) -> WorldModel:
        """Return the true rocks: exact poses, and ``length``, ``width`` and ``height`` of ellipsoids in m.

        Their middles lie at the height 0, so that the upper half of ``height`` sticks out of level ground.
        """
        rng = np.random.default_rng([self.seed, _ROCKS])
        area = self.length * self.width
        diameters = np.sort(self.diameters(rng.random(rng.poisson(self.density() * area))))[::-1]
        places = self._places(rng, diameters)
        count = len(places)
        stretch = np.sqrt(rng.uniform(*_ELONGATION, count))
        heights = diameters[:count] * rng.uniform(*_FLATNESS, count)
        yaws = rng.uniform(0.0, pi, count)
        free = distances(self.routes(), places)
        objects = []
        for k in np.flatnonzero(free > 0.5 * (self.track_width + diameters[:count] * stretch)).tolist():
            sizes = {"length": diameters[k] * stretch[k], "width": diameters[k] / stretch[k], "height": heights[k]}
            X_WO = RigidTransform(RollPitchYaw(0.0, 0.0, yaws[k]), [*places[k], 0.0])
            pose = PoseEstimate.of(X_WO, np.zeros((6, 6)), time=0.0)
            attributes = {name: AttributeValue(size, "m") for name, size in sizes.items()}
            objects.append(WorldObject(f"rock-{k}", "rock", pose, attributes=attributes, source=f"plain {self.seed}"))
        return WorldModel(objects)

    def map(self, errors: MapErrors, *, seed: int = 0) -> WorldModel:
        """Return a map of the rocks with errors, as `Stand.map` does: positions and ``width``, in random order.

        Args:
            errors: The errors of the map.
            seed: Determines the errors, together with the seed of the plain.
        """
        truth = tuple(self.rocks())
        places, widths = surveyed(
            np.random.default_rng([self.seed, _MAP, seed]),
            np.array([rock.p_WoOo_W[:2] for rock in truth]).reshape(-1, 2),
            np.array([rock.number("width", unit="m") for rock in truth]),
            errors=errors,
            area=(self.length, self.width),
            false_diameters=self.diameters,
        )
        deviation = [errors.position, errors.position, 0.0]
        return WorldModel(
            WorldObject(
                f"map-{k}",
                "rock",
                position_estimate([*place, 0.0], deviation=deviation),
                attributes={"width": AttributeValue(width, "m", errors.diameter * width)},
                source=f"map {seed} of plain {self.seed}",
            )
            for k, (place, width) in enumerate(zip(places, widths, strict=True))
        )

    def _cumulative(self) -> tuple[Array, Array]:
        """Return diameters in m, and the numbers of rocks per m^2 that are smaller, (n,) each.

        The covered share falls by pi D^2 / 4 per rock and m^2, so that the number density of the diameters is
        4 k q exp(-q D) / (pi D^2).
        """
        k = self.abundance
        q = 1.79 + 0.152 / k
        diameters = np.geomspace(self.least_diameter, self.largest_diameter, 1000)
        density = 4.0 * k * q * np.exp(-q * diameters) / (pi * diameters**2)
        steps = 0.5 * (density[1:] + density[:-1]) * np.diff(diameters)
        return diameters, np.concatenate([[0.0], np.cumsum(steps)])

    def _places(self, rng: np.random.Generator, diameters: Array) -> Array:
        """Return positions of rocks that do not touch, the largest first, (n, 2)."""
        places = np.empty((len(diameters), 2))
        radii = 0.5 * diameters * max(_ELONGATION)
        for k, radius in enumerate(radii):
            while True:
                place = rng.random(2) * [self.length, self.width]
                if not k or (np.sum((places[:k] - place) ** 2, axis=1) > (radii[:k] + radius) ** 2).all():
                    break
            places[k] = place
        return places


def rock_surface(rocks: WorldModel, ground: Ground) -> Surface:
    """Return all rocks as one surface, with their middles on the ground."""
    sizes = np.array([[rock.number(name, unit="m") for name in ("length", "width", "height")] for rock in rocks])
    rotations = np.array([rock.X_WO.rotation().matrix() for rock in rocks]).reshape(-1, 3, 3)
    p = rocks.positions()
    centres = np.column_stack([p[:, :2], ground.height(p[:, 0], p[:, 1])])
    return copies(unit_sphere(2), rotations * 0.5 * sizes.reshape(-1, 1, 3), centres)

"""Procedural stands of trees, and maps of them as surveys from the ground or from the air would give them.

Plots near Evo in Finland had 605 to 1,210 stems per hectare with diameters of 6 to 41 cm, whose standard deviation was
3.3 to 8.7 cm within a plot, and heights of 4 to 27 m (Liang and Hyyppä, "Automatic Stem Mapping by Merging Several
Terrestrial Laser Scans at the Feature and Decision Levels", Sensors 13, 2013). The defaults lie in these ranges. The
rest is assumed: the distribution of the diameters, the least distance of two trees, the curve of the heights, and the
kinds of errors that a map has.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, pi

import numpy as np
from numpy.typing import NDArray

from vtbdrake.components.world_model import Quantity, WorldModel, WorldObject, position_estimate

Array = NDArray[np.float64]

HECTARE = 1e4

# Streams of random numbers: trees and maps of one seed are independent.
_TREES, _MAP = 0, 1

# Coefficients of Näslund's curve h = 1.3 m + d² / (a + b d)² with d in cm, assumed: 20 m at 30 cm.
_NAESLUND = (1.2, 0.19)

# Random sequential placement of discs ends at a coverage of 0.547; the last per cent take ever more attempts.
_LARGEST_COVERAGE = 0.45

# Waves that add up to a field of correlated errors.
_WAVES = 400


@dataclass(frozen=True)
class MapErrors:
    """The errors of a map of trees.

    Attributes:
        position: Standard deviation of the positions in m, per axis.
        missing: The share of the trees that the map does not have.
        wrong: The share of the map's entries that are no trees, from 0 to below 1.
        diameter: Standard deviation of the diameters as a share of the diameter.
        correlation: Length L in m over which errors of position are correlated, as exp(-r² / (2 L²)) at the distance r;
            0 for independent errors.
    """

    position: float
    missing: float = 0.0
    wrong: float = 0.0
    diameter: float = 0.05
    correlation: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.missing <= 1.0 or not 0.0 <= self.wrong < 1.0:
            raise ValueError(f"missing and wrong are shares from 0 to 1, not {self.missing} and {self.wrong}")
        if min(self.position, self.diameter, self.correlation) < 0.0:
            raise ValueError("position, diameter and correlation of a map's errors are at least 0")


# The maps by which localization is judged. The diameters of the accurate map are assumed to be 5 % off.
ACCURATE = MapErrors(position=0.10)
REMOTE = MapErrors(position=0.35, missing=0.3, wrong=0.1, diameter=0.2)
POOR = MapErrors(position=0.7, missing=0.3, wrong=0.1, diameter=0.2, correlation=40.0)


@dataclass(frozen=True)
class Stand:
    """A rectangular stand on flat ground from (0, 0) to (length, width). The same seed gives the same stand.

    Diameters follow a Weibull distribution that is cut off at the least and the largest diameter. Positions are those
    of a hard-core process: trees are placed at random one after the other, and a place too close to an earlier tree is
    given up.

    Attributes:
        seed: Determines trees and maps.
        length: Extent along x in m.
        width: Extent along y in m.
        density: Trees per hectare.
        spacing: The least distance of two trees in m.
        diameter_scale: Scale of the Weibull distribution of trunk diameters in m.
        diameter_shape: Its shape; 1 is an exponential distribution, 3.6 nearly a normal one.
        least_diameter: The least trunk diameter in m.
        largest_diameter: The largest trunk diameter in m.
    """

    seed: int = 0
    length: float = 100.0
    width: float = 100.0
    density: float = 800.0
    spacing: float = 1.0
    diameter_scale: float = 0.2
    diameter_shape: float = 2.5
    least_diameter: float = 0.06
    largest_diameter: float = 0.41

    def __post_init__(self) -> None:
        if not min(self.length, self.width, self.density, self.diameter_scale, self.diameter_shape) > 0.0:
            raise ValueError("length, width, density, and scale and shape of the diameters of a stand are positive")
        if not 0.0 < self.least_diameter < self.largest_diameter:
            raise ValueError(
                f"diameters lie between {self.least_diameter} and {self.largest_diameter} m: no such range"
            )
        coverage = self.density / HECTARE * pi * self.spacing**2 / 4.0
        if self.spacing < 0.0 or coverage > _LARGEST_COVERAGE:
            largest = 2.0 * (_LARGEST_COVERAGE * HECTARE / self.density / pi) ** 0.5
            raise ValueError(
                f"{self.density:g} trees/ha find no place at random {self.spacing:g} m apart: "
                f"give at most {largest:.2f} m"
            )

    @property
    def count(self) -> int:
        """The number of trees."""
        return round(self.density * self.length * self.width / HECTARE)

    def diameters(self, uniform: Array) -> Array:
        """Return the diameters (m), (n,), at which the distribution has the probabilities ``uniform`` (n,)."""
        scale, shape = self.diameter_scale, self.diameter_shape
        # From the lower to the upper cut.
        low, high = (exp(-((limit / scale) ** shape)) for limit in (self.least_diameter, self.largest_diameter))
        quantiles: Array = scale * (-np.log(low - uniform * (low - high))) ** (1.0 / shape)
        return quantiles

    def trees(self) -> WorldModel:
        """Return the trees as they are: exact positions, trunk diameters and heights in m."""
        rng = np.random.default_rng([self.seed, _TREES])
        places = self._places(rng)
        diameters = self.diameters(rng.random(self.count))
        objects = (
            _tree(f"tree-{k}", place, diameter, source=f"stand {self.seed}")
            for k, (place, diameter) in enumerate(zip(places, diameters, strict=True))
        )
        return WorldModel(objects)

    def map(self, errors: MapErrors, *, seed: int = 0) -> WorldModel:
        """Return a map of the trees with errors; its identities tell nothing about which tree is meant.

        Its covariances are those of the errors of position, per tree: that errors of neighbours are correlated is
        nothing that a world model could say.

        Args:
            errors: What is wrong with it.
            seed: Determines the errors, together with the seed of the stand.
        """
        rng = np.random.default_rng([self.seed, _MAP, seed])
        truth = tuple(self.trees())
        kept = rng.permutation(self.count)[: self.count - round(errors.missing * self.count)]
        false = round(len(kept) * errors.wrong / (1.0 - errors.wrong))
        places = np.array([truth[k].p_WoOo_W[:2] for k in kept]).reshape(-1, 2)
        places += errors.position * _field(rng, places, errors.correlation)
        places = np.vstack([places, rng.random((false, 2)) * [self.length, self.width]])
        diameters = np.concatenate(
            [[truth[k].number("trunk_diameter", unit="m") for k in kept], self.diameters(rng.random(false))]
        )
        # An error of several deviations must not make a diameter negative.
        measured = diameters * np.maximum(1.0 + errors.diameter * rng.normal(size=len(diameters)), 0.1)
        order = rng.permutation(len(places))
        return WorldModel(
            _tree(f"map-{k}", places[row], measured[row], errors=errors, source=f"map {seed} of stand {self.seed}")
            for k, row in enumerate(order)
        )

    def _places(self, rng: np.random.Generator) -> Array:
        places = np.empty((self.count, 2))
        filled = 0
        while filled < self.count:
            place = rng.random(2) * [self.length, self.width]
            if not filled or np.min(np.sum((places[:filled] - place) ** 2, axis=1)) >= self.spacing**2:
                places[filled] = place
                filled += 1
        return places


def tree_height(diameter: float) -> float:
    """Return the height (m) of a tree with a trunk diameter in m, by Näslund's curve with assumed coefficients."""
    a, b = _NAESLUND
    centimetres = 100.0 * diameter
    return 1.3 + (centimetres / (a + b * centimetres)) ** 2


def _tree(identity: str, place: Array, diameter: float, *, errors: MapErrors | None = None, source: str) -> WorldObject:
    """Return a tree that stands at a place (2,); without errors, it is exactly there."""
    position, share = (errors.position, errors.diameter) if errors else (0.0, 0.0)
    return WorldObject(
        identity,
        "tree",
        position_estimate([*place, 0.0], deviation=[position, position, 0.0]),
        attributes={
            "trunk_diameter": Quantity(diameter, "m", share * diameter),
            "height": Quantity(tree_height(diameter), "m"),
        },
        source=source,
    )


def _field(rng: np.random.Generator, places: Array, correlation: float) -> Array:
    """Return a vector of unit variance per axis at each place, (n, 2), correlated over a length in m.

    A Gaussian correlation has a Gaussian spectrum: the field is a sum of waves with random vectors and phases.
    """
    if correlation == 0.0:
        return rng.normal(size=places.shape)
    columns = []
    for _ in range(2):
        vectors = rng.normal(size=(2, _WAVES)) / correlation
        phases = rng.uniform(0.0, 2.0 * pi, _WAVES)
        columns.append(np.sqrt(2.0 / _WAVES) * np.cos(places @ vectors + phases).sum(axis=1))
    return np.column_stack(columns)

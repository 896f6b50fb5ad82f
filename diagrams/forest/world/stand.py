"""Procedural stands of trees, and maps of them as surveys from the ground or from the air would give them.

Plots near Evo in Finland had 605 to 1,210 stems per hectare with diameters of 6 to 41 cm, whose standard deviation was
3.3 to 8.7 cm within a plot, and heights of 4 to 27 m (Liang and Hyyppä, "Automatic Stem Mapping by Merging Several
Terrestrial Laser Scans at the Feature and Decision Levels", Sensors 13, 2013). The defaults lie in these ranges. The
rest is assumed: the distribution of the diameters, the least distance of two trees, the sizes of clusters and the
distances of rows, the curve of the heights, and the kinds of errors that a map has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, inf, pi

import numpy as np
from numpy.typing import NDArray

from vtbdrake.arrays import Array
from vtbdrake.components.world_model import Quantity, WorldModel, WorldObject, position_estimate
from vtbdrake_diagrams.forest.world.routes import Route, distances, strip_roads

HECTARE = 1e4

# Streams of random numbers: trees, maps and storms of one seed are independent.
_TREES, _MAP, _STORM = 0, 1, 10

# Coefficients of Näslund's curve h = 1.3 m + d² / (a + b d)² with d in cm, assumed: 20 m at 30 cm.
_NAESLUND = (1.2, 0.19)

# Random sequential placement of discs ends at a coverage of 0.547; near it, the number of attempts grows.
_LARGEST_COVERAGE = 0.45

KINDS = ("natural", "clustered", "plantation", "windthrown")
"""The kinds of stands, see `Stand`."""

# A clustered stand has so many clusters per hectare, of this radius in m.
_CLUSTERS, _CLUSTER_RADIUS = 60.0, 6.0
# A storm leaves so many gaps per hectare, of this radius in m, which may overlap [assumed].
_GAPS, _GAP_RADIUS = 3.0, 25.0
# The distance of the rows of a plantation, and the standard deviation per axis with which trees are planted, in m.
_ROWS, _JITTER = 2.5, 0.15
# The number of attempts to place one tree.
_ATTEMPTS = 2_000

# The number of waves that add up to a field of correlated errors.
_WAVES = 400


@dataclass(frozen=True)
class MapErrors:
    """The errors of a map of trees.

    Attributes:
        position: Standard deviation of the positions in m, per axis.
        missing: The share of the trees that are missing on the map.
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
        if not all(0.0 <= value < inf for value in (self.position, self.diameter, self.correlation)):
            raise ValueError(
                "position, diameter and correlation of a map's errors are finite and at least 0, not "
                f"{self.position}, {self.diameter} and {self.correlation}"
            )


# The diameters of the accurate map are assumed to have a standard deviation of 5 %.
ACCURATE = MapErrors(position=0.10)
REMOTE = MapErrors(position=0.35, missing=0.3, wrong=0.1, diameter=0.2)
POOR = MapErrors(position=0.7, missing=0.3, wrong=0.1, diameter=0.2, correlation=40.0)
MAPS = {"exact": MapErrors(position=0.0, diameter=0.0), "accurate": ACCURATE, "remote": REMOTE, "poor": POOR}
"""The errors of maps by the names that scenarios use."""


@dataclass(frozen=True)
class Stand:
    """A rectangular stand on flat ground from (0, 0) to (length, width). The same seed gives the same stand.

    Diameters follow a Weibull distribution that is cut off at the least and the largest diameter. Positions are those
    of a hard-core process: trees are placed at random one after the other, and a place too close to an earlier tree is
    given up. In a ``natural`` stand all places are equally likely. In a ``clustered`` one, they lie in discs around
    points that are placed at random: a Matérn cluster process (Matérn, "Spatial Variation", 1960) with a hard core. In
    a ``plantation``, trees stand in rows along x, 2.5 m apart, nearly where they were planted. A ``windthrown`` stand
    was a natural one of the same seed, before a storm felled all trees in three round gaps per hectare, 50 m wide.

    Attributes:
        seed: Determines trees, roads and maps.
        length: Extent along x in m.
        width: Extent along y in m.
        density: Trees per hectare, before roads are cleared and storms.
        spacing: The least distance of two trees in m; a plantation has its own.
        diameter_scale: Scale of the Weibull distribution of trunk diameters in m.
        diameter_shape: Shape of this distribution; 1 is an exponential distribution, 3.6 nearly a normal one.
        least_diameter: The least trunk diameter in m.
        largest_diameter: The largest trunk diameter in m.
        kind: ``natural``, ``clustered``, ``plantation`` or ``windthrown``.
        road_width: Width of the strip roads in m, which are free of trees; 0 for a stand without roads.
        road_spacing: Distance of the strip roads in m, see `strip_roads`.
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
    kind: str = "natural"
    road_width: float = 0.0
    road_spacing: float = 28.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"a stand is {', '.join(KINDS)}, not {self.kind!r}")
        if not 0.0 <= self.road_width <= 8.0:
            raise ValueError(f"strip roads are at most 8 m wide (0: no roads), not {self.road_width:g} m")
        for name in ("length", "width", "density", "diameter_scale", "diameter_shape"):
            if not 0.0 < getattr(self, name) < inf:
                raise ValueError(f"{name} of a stand is positive and finite, not {getattr(self, name)!r}")
        if not 0.0 < self.least_diameter < self.largest_diameter:
            raise ValueError(
                f"diameters lie between {self.least_diameter} and {self.largest_diameter} m: no such range"
            )
        if self.kind == "plantation":
            return
        coverage = self.density / HECTARE * pi * self.spacing**2 / 4.0
        if not self.spacing >= 0.0:
            raise ValueError(f"trees are at least 0 m apart, not {self.spacing!r} m")
        if coverage > _LARGEST_COVERAGE:
            largest = 2.0 * (_LARGEST_COVERAGE * HECTARE / self.density / pi) ** 0.5
            raise ValueError(
                f"{self.density:g} trees/ha find no place at random {self.spacing:g} m apart: "
                f"give at most {largest:.2f} m"
            )

    @property
    def count(self) -> int:
        """The number of trees before roads are cleared and storms."""
        if self.kind == "plantation":
            rows, columns = self._rows
            return rows * columns
        return round(self.density * self.length * self.width / HECTARE)

    @property
    def _rows(self) -> tuple[int, int]:
        """The numbers of rows of a plantation, and of trees in each row."""
        rows = max(1, round(self.width / _ROWS))
        return rows, max(1, round(self.density * self.length * self.width / HECTARE / rows))

    def routes(self) -> tuple[Route, ...]:
        """Return the routes along the strip roads; none without roads."""
        if self.road_width == 0.0:
            return ()
        return strip_roads(self.length, self.width, spacing=self.road_spacing, seed=self.seed)

    def diameters(self, uniform: Array) -> Array:
        """Return the diameters (m), (n,), at which the distribution has the probabilities ``uniform`` (n,)."""
        scale, shape = self.diameter_scale, self.diameter_shape
        # The values of the survival function at the lower and at the upper limit.
        low, high = (exp(-((limit / scale) ** shape)) for limit in (self.least_diameter, self.largest_diameter))
        quantiles: Array = scale * (-np.log(low - uniform * (low - high))) ** (1.0 / shape)
        return quantiles

    def trees(self) -> WorldModel:
        """Return the true trees: exact positions, trunk diameters and heights in m."""
        rng = np.random.default_rng([self.seed, _TREES])
        places = self._planted(rng) if self.kind == "plantation" else self._places(rng)
        diameters = self.diameters(rng.random(self.count))
        is_free = distances(self.routes(), places) > 0.5 * (self.road_width + diameters)
        objects = (
            _tree(f"tree-{k}", places[k], diameters[k], source=f"stand {self.seed}")
            for k in np.flatnonzero(is_free & ~self._felled(places))
        )
        return WorldModel(objects)

    def map(self, errors: MapErrors, *, seed: int = 0) -> WorldModel:
        """Return a map of the trees with errors; its identities do not show which tree is meant.

        Its covariances are those of the errors of position, per tree: a world model cannot contain correlations.

        Args:
            errors: The errors of the map.
            seed: Determines the errors, together with the seed of the stand.
        """
        rng = np.random.default_rng([self.seed, _MAP, seed])
        truth = tuple(self.trees())
        places, diameters = surveyed(
            rng,
            np.array([tree.p_WoOo_W[:2] for tree in truth]).reshape(-1, 2),
            np.array([tree.number("trunk_diameter", unit="m") for tree in truth]),
            errors=errors,
            area=(self.length, self.width),
            false_diameters=self.diameters,
        )
        return WorldModel(
            _tree(f"map-{k}", place, diameter, errors=errors, source=f"map {seed} of stand {self.seed}")
            for k, (place, diameter) in enumerate(zip(places, diameters, strict=True))
        )

    def _places(self, rng: np.random.Generator) -> Array:
        """Return places of a hard-core process, (count, 2)."""
        size = np.array([self.length, self.width])
        clusters = round(_CLUSTERS * self.length * self.width / HECTARE) if self.kind == "clustered" else 0
        parents = rng.random((clusters, 2)) * size
        # Places by cells as wide as the spacing: trees that are too close lie in the same or in neighbouring cells.
        cells: dict[tuple[int, int], list[tuple[float, float]]] = {}
        places: list[tuple[float, float]] = []
        attempts = 0
        while len(places) < self.count:
            x, y = (self._beside(parents, rng) if clusters else rng.random(2) * size).tolist()
            if self._is_free(x, y, cells):
                places.append((x, y))
                cells.setdefault(self._cell(x, y), []).append((x, y))
                attempts = 0
            attempts += 1
            if attempts > _ATTEMPTS:
                raise ValueError(
                    f"{self.density:g} trees/ha find no place in clusters {self.spacing:g} m apart: reduce one of them"
                )
        return np.array(places)

    def _felled(self, places: Array) -> NDArray[np.bool_]:
        """Return which of the places (n, 2) lie in gaps that a storm has left, (n,)."""
        if self.kind != "windthrown":
            return np.zeros(len(places), dtype=bool)
        from scipy.spatial import cKDTree

        size = np.array([self.length, self.width])
        gaps = np.random.default_rng([self.seed, _STORM]).random((round(_GAPS * size.prod() / HECTARE), 2)) * size
        felled: NDArray[np.bool_] = cKDTree(gaps).query(places)[0] < _GAP_RADIUS
        return felled

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        return (int(x / self.spacing), int(y / self.spacing)) if self.spacing > 0.0 else (0, 0)

    def _is_free(self, x: float, y: float, cells: dict[tuple[int, int], list[tuple[float, float]]]) -> bool:
        """Return whether no tree is closer to a place than the spacing."""
        if self.spacing == 0.0:
            return True
        row, column = self._cell(x, y)
        return all(
            (x - other_x) ** 2 + (y - other_y) ** 2 >= self.spacing**2
            for i in (row - 1, row, row + 1)
            for j in (column - 1, column, column + 1)
            for other_x, other_y in cells.get((i, j), ())
        )

    def _beside(self, parents: Array, rng: np.random.Generator) -> Array:
        """Return a place (2,) of a cluster that lies in the stand."""
        while True:
            away, towards = _CLUSTER_RADIUS * np.sqrt(rng.random()), rng.uniform(0.0, 2.0 * pi)
            place: Array = parents[rng.integers(len(parents))] + away * np.array([np.cos(towards), np.sin(towards)])
            if (place >= 0.0).all() and (place <= [self.length, self.width]).all():
                return place

    def _planted(self, rng: np.random.Generator) -> Array:
        """Return the places of a plantation, row by row, (count, 2)."""
        rows, columns = self._rows
        x = self.length * (np.arange(columns) + 0.5) / columns
        y = self.width * (np.arange(rows) + 0.5) / rows
        grid = np.column_stack([np.tile(x, rows), np.repeat(y, columns)])
        return np.clip(grid + _JITTER * rng.normal(size=grid.shape), 0.0, [self.length, self.width])


def surveyed(
    rng: np.random.Generator,
    places: Array,
    diameters: Array,
    *,
    errors: MapErrors,
    area: tuple[float, float],
    false_diameters: Callable[[Array], Array],
) -> tuple[Array, Array]:
    """Return the surveyed positions (m, 2) and diameters (m,) of objects, with errors and in random order.

    Args:
        rng: The generator of the random numbers.
        places: The true positions (x, y) in m, shape (n, 2).
        diameters: The true diameters in m, shape (n,).
        errors: The errors of the survey.
        area: The extents in x and y in m, from 0 on, in which wrong entries are placed.
        false_diameters: Returns diameters of wrong entries in m for numbers that are uniform in [0, 1).
    """
    surveyed_rows = rng.permutation(len(places))[: len(places) - round(errors.missing * len(places))]
    false = round(len(surveyed_rows) * errors.wrong / (1.0 - errors.wrong))
    positions = places[surveyed_rows] + errors.position * _field(rng, places[surveyed_rows], errors.correlation)
    positions = np.vstack([positions, rng.random((false, 2)) * area])
    sizes = np.concatenate([diameters[surveyed_rows], false_diameters(rng.random(false))])
    # An error of several deviations must not make a diameter negative.
    measured = sizes * np.maximum(1.0 + errors.diameter * rng.normal(size=len(sizes)), 0.1)
    order = rng.permutation(len(positions))
    return positions[order], measured[order]


def tree_height(diameter: float) -> float:
    """Return the height (m) of a tree with a trunk diameter in m, by Näslund's curve with assumed coefficients."""
    a, b = _NAESLUND
    centimetres = 100.0 * diameter
    return 1.3 + (centimetres / (a + b * centimetres)) ** 2


def _tree(identity: str, place: Array, diameter: float, *, errors: MapErrors | None = None, source: str) -> WorldObject:
    """Return a tree at a place (2,), with the covariance of these errors; without errors, its position is exact."""
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

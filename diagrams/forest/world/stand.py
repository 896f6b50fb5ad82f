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
from math import exp, pi

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.world_model import AttributeValue, WorldModel, WorldObject, position_estimate
from vtbdrake_diagrams.forest.world.routes import Route, distances, strip_roads

HECTARE = 1e4

# Streams of random numbers: trees, maps and storms of one seed are independent.
_TREES = 0
_MAP = 1
_STORM = 10

# Coefficients of Näslund's curve h = 1.3 m + d² / (a + b d)² with d in cm, assumed: 20 m at 30 cm.
_NAESLUND = (1.2, 0.19)

# Random sequential placement of discs ends at a coverage of 0.547; near it, the number of attempts grows.
_LARGEST_COVERAGE = 0.45

KINDS = ("natural", "clustered", "plantation", "windthrown")
"""The kinds of stands, see `Stand`."""

# Clusters per hectare of a clustered stand.
_CLUSTERS = 60.0
# Radius of a cluster, in m.
_CLUSTER_RADIUS = 6.0
# Gaps per hectare that a storm leaves, which may overlap [assumed].
_GAPS = 3.0
# Radius of a gap, in m [assumed].
_GAP_RADIUS = 25.0
# Distance of the rows of a plantation, in m.
_ROWS = 2.5
# Standard deviation per axis with which trees are planted in a row, in m.
_JITTER = 0.15
# The number of attempts to place one tree.
_ATTEMPTS = 2_000

# The number of waves that add up to a field of correlated errors.
_WAVES = 400


@dataclass(frozen=True)
class MapErrors:
    """The errors of a map of trees.

    Errors of position have the correlation exp(-r² / (2 L²)) at the distance r, with the length L of ``correlation``.
    """

    position: float = setting(doc="Standard deviation of the positions, per axis.", unit="m", ge=0)
    missing: float = setting(0.0, "Share of the trees that are missing on the map.", ge=0, le=1)
    wrong: float = setting(0.0, "Share of the map's entries that are no trees.", ge=0, lt=1)
    diameter: float = setting(0.05, "Standard deviation of the diameters as a share of the diameter.", ge=0)
    correlation: float = setting(0.0, "Length L of the correlation; 0: errors are independent.", unit="m", ge=0)

    def __post_init__(self) -> None:
        check_settings(self)


# The diameters of the accurate map are assumed to have a standard deviation of 5 %.
ACCURATE = MapErrors(position=0.10)
REMOTE = MapErrors(position=0.35, missing=0.3, wrong=0.1, diameter=0.2)
POOR = MapErrors(position=0.7, missing=0.3, wrong=0.1, diameter=0.2, correlation=40.0)
MAPS = {"exact": MapErrors(position=0.0, diameter=0.0), "accurate": ACCURATE, "remote": REMOTE, "poor": POOR}
"""The errors of maps by the names that scenarios use."""


@dataclass(frozen=True)
class Stand:
    """A rectangular stand on flat ground from (0, 0) to (length, width). The same seed gives the same stand.

    Diameters follow a Weibull distribution (with the shape 1 it is exponential, with 3.6 nearly normal) that is cut off
    at the least and the largest diameter. Positions follow a hard-core process: trees are placed at random one
    after the other, and a place too close to an earlier tree is given up. In a ``natural`` stand all places are equally
    likely. In a ``clustered`` one, they lie in discs around points that are placed at random: a Matérn cluster process
    (Matérn, "Spatial Variation", 1960) with a hard core. In a ``plantation``, trees stand in rows along x, 2.5 m apart,
    nearly where they were planted. A ``windthrown`` stand was a natural one of the same seed, before a storm felled all
    trees in three round gaps per hectare, 50 m wide.
    """

    seed: int = setting(0, "Determines trees, roads and maps.", ge=0)
    length: float = setting(100.0, "Extent along x.", unit="m", gt=0)
    width: float = setting(100.0, "Extent along y.", unit="m", gt=0)
    density: float = setting(800.0, "Trees before roads are cleared and storms.", unit="1/ha", gt=0)
    spacing: float = setting(1.0, "Least distance of two trees; a plantation has its own.", unit="m", ge=0)
    diameter_scale: float = setting(0.2, "Scale of the distribution of trunk diameters.", unit="m", gt=0)
    diameter_shape: float = setting(2.5, "Shape of the distribution of trunk diameters.", gt=0)
    least_diameter: float = setting(0.06, "Least trunk diameter.", unit="m", gt=0, below="largest_diameter")
    largest_diameter: float = setting(0.41, "Largest trunk diameter.", unit="m", gt=0)
    kind: str = setting("natural", "How trees are distributed.", choices=KINDS)
    road_width: float = setting(
        0.0, "Width of the strip roads, which have no trees; 0: no roads.", unit="m", ge=0, le=8
    )
    road_spacing: float = setting(28.0, "Distance of the strip roads.", unit="m", gt=0)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.kind == "plantation":
            return
        coverage = self.density / HECTARE * pi * self.spacing**2 / 4.0
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
        source = f"stand {self.seed}"
        return WorldModel(_tree(f"tree-{k}", *tree, source=source) for k, *tree in zip(*self._grown(), strict=True))

    def map(self, errors: MapErrors, *, seed: int = 0) -> WorldModel:
        """Return a map of the trees with errors; its identities do not show which tree is meant.

        Its covariances describe the errors of position, per tree: a world model cannot contain correlations.

        Args:
            errors: The errors of the map.
            seed: Determines the errors, together with the seed of the stand.
        """
        rng = np.random.default_rng([self.seed, _MAP, seed])
        _, true_places, true_diameters = self._grown()
        places, diameters = surveyed(
            rng,
            true_places,
            true_diameters,
            errors=errors,
            area=(self.length, self.width),
            false_diameters=self.diameters,
        )
        return WorldModel(
            _tree(f"map-{k}", place, diameter, errors=errors, source=f"map {seed} of stand {self.seed}")
            for k, (place, diameter) in enumerate(zip(places, diameters, strict=True))
        )

    def _grown(self) -> tuple[NDArray[np.intp], Array, Array]:
        """Return the numbers (n,), the places (n, 2) and the trunk diameters (n,) of the true trees, in m."""
        rng = np.random.default_rng([self.seed, _TREES])
        places = self._planted(rng) if self.kind == "plantation" else self._places(rng)
        diameters = self.diameters(rng.random(self.count))
        is_free = distances(self.routes(), places) > 0.5 * (self.road_width + diameters)
        rows = np.flatnonzero(is_free & ~self._felled(places))
        return rows, places[rows], diameters[rows]

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
            "trunk_diameter": AttributeValue(diameter, "m", share * diameter),
            "height": AttributeValue(tree_height(diameter), "m"),
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

"""What is known of a crater from orbit: an elevation model and a list of boulders, both partly wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from vtbdrake.common.arrays import Array
from vtbdrake.components.world_model import AttributeValue, WorldModel, WorldObject, position_estimate
from vtbdrake_diagrams.space_climber.ground_map import GroundMap
from vtbdrake_diagrams.space_climber.terrain import ROCK_DISTANCE, SECTOR, Crater

CELL = 1.0
"""Distance of the heights in m."""

HEIGHT_ERROR = 0.3
"""Standard deviation of the heights in m."""

CORRELATION = 4.0
"""Length in m over which the errors of heights are alike: images from orbit are matched by patches of some cells. (An
independent error of 0.3 m in each cell would be a slope of 23 deg between neighbours, which any user would smooth.)"""

MISSING = 1.0 / 3.0
"""Share of the boulders that the list lacks."""

INVENTED = 0.1
"""How many boulders the list has that are not there, as a share of those that it has."""

LEAST_DIAMETER = 0.3
"""The smallest boulders that an image from orbit shows, in m."""

PLACE_ERROR = 0.3
"""Standard deviation of the boulders' places along x and y, in m."""

SIZE_ERROR = 0.1
"""Standard deviation of their diameters, in m."""

# Lower and upper corner of the grid, in m: the sector in front of the robot.
_LOWER = (-6.0, -34.0)
_UPPER = (48.0, 34.0)


@dataclass(frozen=True, eq=False)
class Survey:
    """What is known from orbit.

    Attributes:
        ground: The elevation model, with its error.
        rocks: The boulders, each with the deviations of its place and its size.
    """

    ground: GroundMap
    rocks: WorldModel


def survey(crater: Crater, *, seed: int) -> Survey:
    """Return a survey of a crater, with errors that ``seed`` determines."""
    rng = np.random.default_rng([crater.seed, seed, 7])
    shape = tuple(round((b - a) / CELL) + 1 for a, b in zip(_LOWER, _UPPER, strict=True))
    empty = GroundMap.surveyed(_LOWER, CELL, np.zeros(shape), deviation=HEIGHT_ERROR, range=2.0 * CORRELATION)
    heights = crater.mesh_height(empty.vertices()).reshape(shape) + HEIGHT_ERROR * _correlated(shape, rng)
    ground = GroundMap.surveyed(_LOWER, CELL, heights, deviation=HEIGHT_ERROR, range=2.0 * CORRELATION)
    return Survey(ground, WorldModel(_boulders(crater, ground, rng)))


def _correlated(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return a random field of standard deviation 1, whose correlation at the distance r is exp(-(r / length)^2)."""
    margin = round(4.0 * CORRELATION / CELL)
    white = rng.standard_normal([n + 2 * margin for n in shape])
    smooth: Array = gaussian_filter(white, 0.5 * CORRELATION / CELL, truncate=6.0)
    smooth /= smooth.std()
    return smooth[margin:-margin, margin:-margin]


def _boulders(crater: Crater, ground: GroundMap, rng: np.random.Generator) -> list[WorldObject]:
    """Return the boulders of the list: true ones, less those that are missing, and invented ones."""
    large = [(b.x, b.y, float(np.mean(b.size[:2]))) for b in crater.blocks if np.mean(b.size[:2]) >= LEAST_DIAMETER]
    rows = np.array(large).reshape(-1, 3)
    rows = rows[rng.uniform(size=len(rows)) >= MISSING]
    errors = np.array([PLACE_ERROR, PLACE_ERROR, SIZE_ERROR])
    rows = rows + errors * rng.standard_normal(rows.shape)
    count = rng.poisson(INVENTED * len(rows))
    r = np.sqrt(rng.uniform(ROCK_DISTANCE[0] ** 2, ROCK_DISTANCE[1] ** 2, count))
    azimuth = rng.uniform(-SECTOR, SECTOR, count)
    sizes = rng.choice(rows[:, 2], count) if len(rows) else np.zeros(0)
    invented = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), sizes])
    rows = np.vstack([rows, invented])
    rows = rows[ground.covers(rows[:, :2])]
    z = ground.height(rows[:, :2])
    return [
        rock(f"survey-{k}", [x, y, z_k], diameter=max(D, 0.5 * LEAST_DIAMETER), deviation=PLACE_ERROR, source="survey")
        for k, ((x, y, D), z_k) in enumerate(zip(rows.tolist(), z.tolist(), strict=True))
    ]


def rock(
    identity: str, place: list[float], *, diameter: float, deviation: float, source: str, share: float = 0.85
) -> WorldObject:
    """Return a rock as an object of a world model, half buried.

    Args:
        identity: Its identity.
        place: Its middle, which lies on the ground, in m.
        diameter: Its diameter in m.
        deviation: Standard deviation of its place, in m.
        source: Who saw it.
        share: The height of the whole rock by its diameter.
    """
    lengths = {"length": diameter, "width": diameter, "height": share * diameter}
    attributes = {name: AttributeValue(value, "m", SIZE_ERROR) for name, value in lengths.items()}
    return WorldObject(identity, "rock", position_estimate(place, deviation=deviation), attributes, source=source)

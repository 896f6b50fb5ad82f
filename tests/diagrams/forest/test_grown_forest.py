"""Global localization in a forest from another generator than the one it was developed with.

That of `vtbdrake_diagrams.forest.world.stand` draws places and diameters from distributions. Here a forest grows:
seedlings stand anywhere, and each year a tree grows by its vigour, divided by one plus the crowding around it, the sum
of d_j / (d_i r_ij) over its neighbours within 5 m (Hegyi's index). What hardly grows dies. Spacing, density and the
distribution of the diameters come out.
"""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake_diagrams.forest.studies.detections import Detector, Odometry, Wood, gathered
from vtbdrake_diagrams.forest.studies.trials import Case, Trial, judged
from vtbdrake_diagrams.forest.world.stand import MAPS, surveyed

pytestmark = pytest.mark.one_python

SIDE = 80.0
FALSE = 0.35


def exact(places: np.ndarray, diameters: np.ndarray) -> Landmarks:
    n = len(places)
    return Landmarks(places, np.zeros((n, 2, 2)), diameters, np.zeros(n))


def grown(seed: int, *, seedlings: float = 0.4, years: int = 70) -> Landmarks:
    """Return the trees of a square stand with exact places and diameters, from a number of seedlings per m^2."""
    rng = np.random.default_rng([seed, 77])
    places = rng.uniform(0.0, SIDE, (rng.poisson(seedlings * SIDE**2), 2))
    diameters, vigour = rng.uniform(0.005, 0.02, len(places)), rng.lognormal(np.log(0.0032), 0.3, len(places))
    for _ in range(years):
        one, two = cKDTree(places).query_pairs(5.0, output_type="ndarray").T
        nearness = 1.0 / np.maximum(np.hypot(*(places[one] - places[two]).T), 0.1)
        crowding = np.bincount(one, diameters[two] / diameters[one] * nearness, len(places))
        crowding += np.bincount(two, diameters[one] / diameters[two] * nearness, len(places))
        growth = vigour / (1.0 + crowding)
        diameters = diameters + growth
        lives = growth > 0.0004
        places, diameters, vigour = places[lives], diameters[lives], vigour[lives]
    return exact(places, diameters)


def trial(seed: int, map_name: str, *, place: str = "inside") -> Trial:
    """Locate a scan where a third of the landmarks are no trees, on a map of the stand, or of another (``outside``)."""
    rng, errors = np.random.default_rng([seed, 78]), MAPS[map_name]
    trees, mapped = grown(seed), grown(seed + 1000 if place == "outside" else seed)
    others = round(len(trees) * FALSE / (1.0 - FALSE))
    false = exact(rng.uniform(0.0, SIDE, (others, 2)), rng.choice(trees.diameters, others))
    wood = Wood(Landmarks.joined([trees, false]), np.arange(len(trees) + others) < len(trees))
    X_WH = np.array([*rng.uniform(15.0, SIDE - 15.0, 2), rng.uniform(-np.pi, np.pi)])
    local, _ = gathered(wood, X_WH[np.newaxis], Detector(false=FALSE), Odometry(), rng)
    places, diameters = surveyed(
        rng,
        mapped.positions,
        mapped.diameters,
        errors=errors,
        area=(SIDE, SIDE),
        false_diameters=lambda share: np.quantile(mapped.diameters, share),
    )
    covariances = np.tile(errors.position**2 * np.eye(2), (len(places), 1, 1))
    survey = Landmarks(places, covariances, diameters, errors.diameter * diameters)
    return judged(ConstellationMap(survey), local, X_WH, Case("grown", 0.0, map_name, place))


def test_grown_stand_is_like_those_of_published_plots() -> None:
    stands = [grown(seed) for seed in range(3)]
    assert all(600.0 < len(one) / SIDE**2 * 1e4 < 1210.0 for one in stands)
    for one in stands:
        assert 0.033 < one.diameters.std() < 0.087 and 0.03 < one.diameters.min() < one.diameters.max() < 0.7
        # Neighbours keep off each other: farther apart on average than if they were anywhere (Clark and Evans).
        nearest = cKDTree(one.positions).query(one.positions, k=2)[0][:, 1]
        assert nearest.mean() > 1.05 * 0.5 * SIDE / np.sqrt(len(one))


@pytest.mark.slow
@pytest.mark.parametrize("map_name", ["accurate", "remote"])
def test_places_in_a_grown_forest_are_recognized(map_name: str) -> None:
    found = [trial(seed, map_name) for seed in range(10)]
    assert sum(one.is_right for one in found) >= 9
    assert not any(one.is_sure and not one.is_right for one in found)
    # The mean of ten values of three degrees of freedom is below this in 97.5 % of cases.
    assert np.nanmean([one.nees for one in found]) < 4.7


@pytest.mark.slow
@pytest.mark.parametrize("map_name", ["accurate", "remote"])
def test_another_grown_forest_is_not_recognized(map_name: str) -> None:
    assert not any(trial(seed, map_name, place="outside").is_sure for seed in range(5))

"""Tests of stands and maps against the figures and distributions that they claim."""

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist
from scipy.stats import kstest, weibull_min

from vtbdrake.components.world_model import WorldModel, add_to_plant
from vtbdrake_diagrams.forest.world.stand import ACCURATE, POOR, REMOTE, MapErrors, Stand, tree_height

pytestmark = pytest.mark.one_python


def diameters(model: WorldModel) -> np.ndarray:
    return np.array([one.number("trunk_diameter", unit="m") for one in model])


def offsets(true: np.ndarray, world_map: WorldModel) -> np.ndarray:
    """Return the displacement of the nearest entry of the map from each tree, (n, 2)."""
    found = world_map.positions()[:, :2]
    nearest = np.argmin(np.sum((true[:, np.newaxis] - found) ** 2, axis=2), axis=1)
    return found[nearest] - true


def test_density_and_spacing() -> None:
    trees = Stand(length=50.0, width=80.0, density=1000.0, spacing=1.5).trees()
    places = trees.positions()
    assert len(trees) == 400
    assert (places >= 0.0).all() and (places <= [50.0, 80.0, 0.0]).all()
    assert pdist(places).min() >= 1.5


def test_diameters_follow_the_cut_distribution() -> None:
    stand = Stand(seed=1)
    found, weibull = diameters(stand.trees()), weibull_min(2.5, scale=0.2)
    low, high = weibull.cdf([0.06, 0.41])
    assert found.min() >= 0.06 and found.max() <= 0.41
    assert kstest(found, lambda d: (weibull.cdf(d) - low) / (high - low)).pvalue > 0.01


def test_defaults_lie_in_the_ranges_of_published_plots() -> None:
    for seed in range(3):
        trees = Stand(seed=seed).trees()
        heights = [one.number("height", unit="m") for one in trees]
        assert 605 <= len(trees) <= 1210
        assert 0.033 < diameters(trees).std() < 0.087
        assert min(heights) > 4.0 and max(heights) < 27.0


def test_trees_of_a_clustered_stand_have_more_neighbours() -> None:
    """By Ripley's K: natural stands have fewer neighbours within 3 m than chance, because of the spacing."""
    neighbours = {}
    for kind in ("natural", "clustered"):
        stand = Stand(seed=1, kind=kind)
        places = stand.trees().positions()
        assert len(places) == 800 and pdist(places).min() >= stand.spacing
        neighbours[kind] = 2.0 * (pdist(places) < 3.0).sum() / 800
    by_chance = 0.08 * np.pi * 9.0
    assert 0.7 * by_chance < neighbours["natural"] < by_chance
    assert neighbours["clustered"] > 1.3 * by_chance


def test_storm_fells_the_trees_of_round_gaps() -> None:
    before = {tuple(place) for place in Stand(seed=4, road_width=4.0).trees().positions()[:, :2].tolist()}
    after = {tuple(p) for p in Stand(seed=4, road_width=4.0, kind="windthrown").trees().positions()[:, :2].tolist()}
    assert after < before
    # All centres, to 0.5 m, of discs with a radius of 25 m that contain no tree.
    x, y = np.meshgrid(np.arange(0.0, 100.5, 0.5), np.arange(0.0, 100.5, 0.5))
    empty = np.column_stack([x.ravel(), y.ravel()])
    empty = empty[cKDTree(list(after)).query(empty)[0] > 24.5]
    assert (cKDTree(empty).query(list(before - after))[0] < 25.5).all()
    # Three discs overlap, and lie in part outside.
    assert 0.2 < 1.0 - len(after) / len(before) < 3.0 * np.pi * 0.25**2


def test_trees_of_a_plantation_stand_in_rows() -> None:
    stand = Stand(seed=2, length=60.0, width=50.0, kind="plantation", density=1000.0)
    places = stand.trees().positions()
    assert len(places) == stand.count == 300
    rows = places[:, 1] / 2.5 - 0.5
    assert set(np.round(rows).tolist()) == set(range(20))
    assert 2.5 * np.std(rows - np.round(rows)) == pytest.approx(0.15, rel=0.15)
    gaps = np.diff(np.sort(places[np.round(rows) == 7, 0]))
    assert gaps.mean() == pytest.approx(4.0, rel=0.05) and gaps.std() < 0.4


def test_strip_roads_are_free_of_trees() -> None:
    stand = Stand(seed=3, road_width=4.0)
    trees = stand.trees()
    for route in stand.routes():
        assert (route.distances(trees.positions()[:, :2]) - 0.5 * diameters(trees)).min() > 2.0
    # The other trees stand as in the stand without roads, and the map shows them.
    everything = {tuple(p) for p in Stand(seed=3).trees().positions().tolist()}
    assert {tuple(p) for p in trees.positions().tolist()} < everything
    assert len(stand.map(ACCURATE)) == len(trees) > 0.7 * 800


def test_seed_determines_the_stand() -> None:
    stand = Stand(seed=4, length=20.0)
    assert np.array_equal(stand.trees().positions(), stand.trees().positions())
    assert not np.array_equal(stand.trees().positions(), Stand(seed=5, length=20.0).trees().positions())
    assert not np.array_equal(stand.map(REMOTE).positions(), stand.map(REMOTE, seed=1).positions())


def test_accurate_map_is_complete() -> None:
    stand = Stand(seed=2, spacing=2.0)
    world_map, places = stand.map(ACCURATE), stand.trees().positions()[:, :2]
    assert len(world_map) == stand.count
    # Trees are 2 m apart, so that the nearest entry is the right one.
    assert offsets(places, world_map).std(axis=0) == pytest.approx([0.1, 0.1], rel=0.1)
    assert next(iter(world_map)).pose.covariance[3, 3] == pytest.approx(0.01)


def test_remote_map_lacks_trees_and_has_wrong_ones() -> None:
    stand = Stand(seed=3)
    mapped = stand.map(REMOTE)
    # 70 % of 800 trees are nine tenths of the entries.
    assert len(mapped) == round(800 * 0.7 / 0.9)
    true = stand.trees().positions()[:, :2]
    gaps = np.sqrt(((mapped.positions()[:, np.newaxis, :2] - true) ** 2).sum(axis=2)).min(axis=1)
    assert (gaps < 1.5).mean() > 0.9


def test_diameters_of_a_map_are_off() -> None:
    stand, errors = Stand(seed=6, spacing=2.0), MapErrors(position=0.0, diameter=0.2)
    trees = {tuple(one.p_WoOo_W): one.number("trunk_diameter", unit="m") for one in stand.trees()}
    ratios = [one.number("trunk_diameter", unit="m") / trees[tuple(one.p_WoOo_W)] for one in stand.map(errors)]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.03) and np.std(ratios) == pytest.approx(0.2, rel=0.1)


def test_errors_of_the_poor_map_are_correlated() -> None:
    """Over many complete maps: a tree, the next one, and one about 40 m away."""
    stand = Stand(seed=7, length=60.0, width=10.0, density=300.0, spacing=3.0)
    errors = MapErrors(position=0.3, correlation=POOR.correlation)
    places = stand.trees().positions()[:, :2]
    distances = np.linalg.norm(places - places[0], axis=1)
    near, far = np.argsort(distances)[1], np.argmin(np.abs(distances - 40.0))
    drawn = np.array([offsets(places, stand.map(errors, seed=seed))[[0, near, far]] for seed in range(200)])
    assert drawn.std(axis=0) == pytest.approx(np.full((3, 2), 0.3), rel=0.15)
    for k, other in ((1, near), (2, far)):
        correlation = np.corrcoef(drawn[:, 0].ravel(), drawn[:, k].ravel())[0, 1]
        assert correlation == pytest.approx(np.exp(-(distances[other] ** 2) / (2.0 * 40.0**2)), abs=0.1)


def test_stand_becomes_a_simulated_world() -> None:
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.001)
    assert add_to_plant(plant, Stand(length=20.0, width=20.0).trees()) == 2 * 32


def test_heights_are_plausible() -> None:
    assert tree_height(0.30) == pytest.approx(20.2, abs=0.1)
    assert tree_height(0.06) < 10.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Stand(density=1200.0, spacing=3.0),
            "1200 trees/ha find no place at random 3 m apart: give at most 2.19",
        ),
        (lambda: Stand(length=0.0), "length must be a finite number above 0 m, not 0.0"),
        (lambda: Stand(density=float("nan")), "density must be a finite number above 0 1/ha, not nan"),
        (lambda: Stand(spacing=-1.0), "spacing must be a finite number of at least 0 m, not -1.0"),
        (lambda: Stand(least_diameter=0.5), "least_diameter must be below the largest_diameter"),
        (lambda: Stand(kind="jungle"), "one of natural, clustered, plantation, windthrown, not 'jungle'"),
        (lambda: Stand(road_width=9.0), "road_width must be a number from 0 to 8 m, not 9.0"),
        (lambda: Stand(kind="clustered", density=1500.0, spacing=1.9, length=30.0).trees(), "no place in clusters"),
        (lambda: MapErrors(position=-0.1), "of at least 0 m, not -0.1"),
        (lambda: MapErrors(position=float("nan")), "finite"),
        (lambda: MapErrors(position=0.1, wrong=1.0), "wrong must be a number from 0 to below 1, not 1.0"),
    ],
)
def test_impossible_stands_are_refused(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()

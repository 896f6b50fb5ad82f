"""Tests of global localization: against exhaustive search, and that nothing wrong is claimed."""

from math import pi

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.pair_votes import LocalPairs
from vtbdrake.components.localization.planar import inverse, transform, wrap
from vtbdrake_diagrams.forest.studies.trials import Case, run
from vtbdrake_diagrams.forest.world.stand import ACCURATE, POOR, Stand

pytestmark = pytest.mark.one_python


def landmarks(places, *, deviation=0.05):
    """Return landmarks of unknown diameters."""
    places = np.asarray(places, dtype=float)
    n = len(places)
    return Landmarks(places, np.tile(deviation**2 * np.eye(2), (n, 1, 1)), np.full(n, 0.2), np.full(n, np.inf))


def scattered(rng, *, side, count, spacing):
    places = [rng.uniform(0.0, side, 2)]
    while len(places) < count:
        place = rng.uniform(0.0, side, 2)
        if np.min(np.hypot(*(np.array(places) - place).T)) > spacing:
            places.append(place)
    return np.array(places)


def seen(places_W, X_WH, rng, *, reach, deviation=0.05, missed=0.1, false=0):
    """Return the detections of the places around a pose, with errors, and false landmarks among them."""
    around = transform(inverse(X_WH), places_W)
    around = around[(np.hypot(*around.T) < reach) & (rng.random(len(around)) >= missed)]
    around = around + deviation * rng.normal(size=around.shape)
    return landmarks(np.vstack([around, rng.uniform(-0.7 * reach, 0.7 * reach, (false, 2))]), deviation=deviation)


def error(fix, X_WH):
    return np.append(fix.pose[:2] - X_WH[:2], wrap(fix.pose[2] - X_WH[2]))


def log_likelihoods(poses, local, places, variance, *, share):
    """The formula of the module, with sums over all landmarks of a map without diameters: poses (k, 3) -> (k,)."""
    low, high = places.min(axis=0), places.max(axis=0)
    around = (np.hypot(*(places[:, np.newaxis] - places).transpose(2, 0, 1)) <= 8.0).sum(axis=1)
    density = np.maximum(around / (pi * 8.0**2), len(places) / np.prod(high - low))
    total = np.zeros(len(poses))
    for x, y in local:
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        at = poses[:, :2] + np.column_stack([c * x - s * y, s * x + c * y])
        square = ((at[:, np.newaxis] - places) ** 2).sum(axis=2)
        normal = np.exp(-0.5 * square / variance) / (2.0 * pi * variance)
        total += np.log(1.0 - share + share * (normal / density).sum(axis=1))
    return total


def test_deviations_of_pairs_are_those_of_drawn_distances():
    """Map errors that are correlated over 5 m displace two landmarks 4 m apart in nearly the same way."""
    places, variances, variance, length = np.array([[0.0, 0.0], [4.0, 0.0]]), np.array([0.01, 0.02]), 0.09, 5.0
    diameters = {"diameters": np.full(2, 0.2), "diameter_variances": np.full(2, np.inf)}
    for correlation in (0.0, length):
        pairs = LocalPairs.of(places, variances, map_variance=variance, correlation=correlation, **diameters)
        rho = np.exp(-0.5 * (4.0 / correlation) ** 2) if correlation else 0.0
        rng = np.random.default_rng(0)
        here = np.sqrt(variances) * rng.normal(size=(200_000, 2))
        mapped = rng.multivariate_normal([0.0, 0.0], variance * np.array([[1.0, rho], [rho, 1.0]]), 200_000)
        np.testing.assert_allclose(pairs.deviations, np.std(np.diff(here - mapped)), rtol=0.01)


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", [0, 1])
def test_exhaustive_search_finds_the_same_pose(seed):
    rng = np.random.default_rng(seed)
    places = scattered(rng, side=24.0, count=30, spacing=2.0)
    X_WH = np.array([*rng.uniform(8.0, 16.0, 2), rng.uniform(-pi, pi)])
    local = seen(places, X_WH, rng, reach=10.0, deviation=0.1, false=6)
    mapped = places + 0.1 * rng.normal(size=places.shape)
    fix = ConstellationMap(landmarks(mapped, deviation=0.1)).locate(local)

    axis = np.arange(2.0, 23.0, 1.2)
    grid = np.stack(np.meshgrid(axis, axis, np.arange(-pi, pi, 0.12), indexing="ij"), axis=-1).reshape(-1, 3)
    rough = log_likelihoods(grid, local.positions, mapped, 0.6**2, share=0.4)
    variance = 2 * 0.1**2 + 0.02**2
    best = min(
        (
            minimize(
                lambda pose: -log_likelihoods(pose[np.newaxis], local.positions, mapped, variance, share=0.4)[0],
                grid[row],
                method="Nelder-Mead",
                options={"initial_simplex": grid[row] + np.vstack([np.zeros(3), np.diag([0.5, 0.5, 0.05])])},
            )
            for row in np.argsort(-rough)[:5]
        ),
        key=lambda result: result.fun,
    )
    assert fix.log_likelihood == pytest.approx(-best.fun, abs=0.1)
    assert np.abs(error(fix, best.x)) == pytest.approx([0.0, 0.0, 0.0], abs=5e-3)


def test_diameters_that_are_said_to_be_exact_are_used():
    rng = np.random.default_rng(2)
    places = scattered(rng, side=40.0, count=60, spacing=2.0)
    diameters = rng.uniform(0.1, 0.6, len(places))
    X_WH = np.array([20.0, 20.0, 0.7])
    local = transform(inverse(X_WH), places)
    near = np.hypot(*local.T) < 12.0
    covariances = np.tile(0.05**2 * np.eye(2), (len(places), 1, 1))
    mapped = Landmarks(places, covariances, diameters, np.zeros(len(places)))
    seen_here = Landmarks(local[near], covariances[near], diameters[near], np.zeros(near.sum()))
    fix = ConstellationMap(mapped).locate(seen_here)
    unknown = ConstellationMap(landmarks(places)).locate(landmarks(local[near]))
    assert fix.is_sure and np.abs(error(fix, X_WH)) == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    # Each diameter of 10 mm deviation among diameters of 0.1 to 0.6 m adds about ln(0.5 / (sqrt(2 pi) sqrt(2) 0.01)).
    gain = (fix.log_likelihood - unknown.log_likelihood) / near.sum()
    assert gain == pytest.approx(np.log(0.5 / (np.sqrt(4.0 * pi) * 0.01)), rel=0.2)


@pytest.mark.slow
def test_places_of_a_stand_are_recognized():
    for seed, name in enumerate(("accurate", "remote", "poor")):
        trial = run(Case("natural", 600.0, name, "inside"), seed=7000 + seed)
        assert trial.is_sure and trial.is_right


@pytest.mark.slow
def test_other_stands_are_not_recognized():
    """Many poses nearly match in a plantation; the log-likelihood of the best one leads by 8 to 21."""
    for kind, name, seed in (
        ("plantation", "accurate", 8000),
        ("plantation", "remote", 8003),
        ("plantation", "poor", 8001),
        ("natural", "remote", 8003),
    ):
        assert not run(Case(kind, 1000.0, name, "outside"), seed=seed).is_sure


def test_covariance_of_matches_without_doubt():
    """Equal errors of all landmarks: σ²/n at their mean, and σ²/Σr² in the heading."""
    rng = np.random.default_rng(3)
    places = scattered(rng, side=60.0, count=100, spacing=3.5)
    X_WH = np.array([30.0, 30.0, 1.0])
    local = seen(places, X_WH, rng, reach=15.0, missed=0.0)
    fix = ConstellationMap(landmarks(places, deviation=0.1)).locate(local)
    assert fix.is_sure and len(fix.pairs) == len(local)
    true = transform(X_WH, local.positions)
    np.testing.assert_array_less(np.hypot(*(places[fix.pairs[:, 1]] - true).T), 0.3)

    variance = 0.1**2 + 0.05**2 + 0.02**2
    arms = transform([0.0, 0.0, X_WH[2]], local.positions)
    J = np.array([[[1.0, 0.0, -y], [0.0, 1.0, x]] for x, y in arms]).reshape(-1, 3)
    np.testing.assert_allclose(fix.covariance, variance * np.linalg.inv(J.T @ J), rtol=0.05, atol=2e-6)


@pytest.mark.slow
def test_covariance_is_consistent_with_errors():
    nees = []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        places = scattered(rng, side=40.0, count=100, spacing=1.5)
        X_WH = np.array([*rng.uniform(15.0, 25.0, 2), rng.uniform(-pi, pi)])
        local = seen(places, X_WH, rng, reach=12.0, deviation=0.05, false=15)
        kept = places[rng.random(100) < 0.8]
        fix = ConstellationMap(landmarks(kept + 0.2 * rng.normal(size=kept.shape), deviation=0.2)).locate(local)
        if fix.is_sure:
            nees.append(error(fix, X_WH) @ np.linalg.solve(fix.covariance, error(fix, X_WH)))
    assert len(nees) >= 20
    # Mean of 20 chi-square variables of 3 degrees of freedom: 3 ± 0.55.
    assert 1.6 < np.mean(nees) < 4.6


def test_displacement_that_neighbours_share_stays_unknown():
    rng = np.random.default_rng(5)
    places = scattered(rng, side=60.0, count=200, spacing=2.0)
    X_WH = np.array([30.0, 30.0, -2.0])
    local = seen(places, X_WH, rng, reach=15.0, false=10)
    shift = np.array([0.8, -0.5])
    mapped = landmarks(places + shift, deviation=0.7)
    fix = ConstellationMap(mapped, correlation=40.0).locate(local)
    assert fix.is_sure
    np.testing.assert_allclose(error(fix, X_WH), [*shift, 0.0], atol=0.25)
    # The errors have the variance s² = 0.49 m². The Laplacian of a Gaussian field tells half of it at most: their
    # covariance is -2 s²/L², the variance of the Laplacian is 8 s²/L⁴.
    assert (np.diagonal(fix.covariance)[:2] > 0.245).all() and (np.diagonal(fix.covariance)[:2] < 0.5).all()
    # The map may be turned by half the curl of its errors, where each slope has the deviation s/L.
    assert fix.covariance[2, 2] == pytest.approx(0.5 * (0.7 / 40.0) ** 2, rel=0.2)


def test_places_on_ten_hectares_are_recognized():
    rng = np.random.default_rng(6)
    places = rng.uniform(0.0, 316.0, (10_000, 2))
    places = np.delete(places, cKDTree(places).query_pairs(1.0, output_type="ndarray")[:, 1], axis=0)
    kept = places[rng.random(len(places)) < 0.7]
    constellation = ConstellationMap(landmarks(kept + 0.2 * rng.normal(size=kept.shape), deviation=0.2))
    for _ in range(2):
        X_WH = np.array([*rng.uniform(50.0, 250.0, 2), rng.uniform(-pi, pi)])
        fix = constellation.locate(seen(places, X_WH, rng, reach=20.0, false=40))
        assert fix.is_sure and np.hypot(*error(fix, X_WH)[:2]) < 0.2


def test_large_coordinates_change_nothing():
    stand = Stand(seed=1, density=600.0, length=60.0, width=60.0)
    there = map_landmarks(stand.map(ACCURATE))
    local = seen(stand.trees().positions()[:, :2], [30.0, 40.0, 2.0], np.random.default_rng(1), reach=20.0)
    far = np.array([500_000.0, 5_600_000.0, 0.0])
    fix, far_fix = (ConstellationMap(one).locate(local) for one in (there, there.seen_from(far)))
    assert fix.is_sure and far_fix.is_sure
    np.testing.assert_allclose(far_fix.pose - far, fix.pose, atol=1e-6)
    np.testing.assert_allclose(far_fix.covariance, fix.covariance, rtol=1e-4, atol=1e-12)


def test_trees_in_a_square_lattice_are_not_sure():
    x, y = np.meshgrid(np.arange(0.0, 60.0, 3.0), np.arange(0.0, 60.0, 3.0))
    places = np.column_stack([x.ravel(), y.ravel()])
    local = seen(places, [31.0, 29.0, 0.3], np.random.default_rng(2), reach=15.0)
    assert not ConstellationMap(landmarks(places)).locate(local).is_sure


@pytest.mark.parametrize(
    ("seed", "missing"), [(86, None), (43, "count"), (2, "likelihood"), (666, "margin"), (183, "fit")]
)
def test_each_condition_of_the_test_of_uniqueness_counts(seed, missing):
    """Random cases: in the first one all conditions hold, in each of the others all but one."""
    rng = np.random.default_rng(seed)
    places = scattered(rng, side=60.0, count=120, spacing=2.0)
    of_map, of_local = rng.choice([0.1, 0.3, 0.6]), rng.choice([0.05, 0.3, 0.6])
    X_WH = np.array([30.0, 30.0, rng.uniform(-pi, pi)])
    reach, false, missed = rng.choice([11.0, 14.0]), int(rng.integers(0, 60)), rng.choice([0.1, 0.5])
    local = seen(places, X_WH, rng, reach=reach, deviation=of_local, false=false, missed=missed)
    mapped = landmarks(places + of_map * rng.normal(size=places.shape), deviation=of_map)
    fix = ConstellationMap(mapped).locate(local)
    variance = of_map**2 + of_local**2 + 0.02**2
    # The map is smaller than a hectare, but asks for the evidence of one.
    poses = 1e4 / (2.0 * pi * variance) * 2.0 * pi * 10.0 / np.sqrt(variance)
    holds = {
        "count": len(local) >= 16,
        "likelihood": fix.log_likelihood > np.log(poses) + np.log(1e6),
        "margin": fix.margin >= max(5.0, 0.5 * fix.log_likelihood),
        "fit": fix.fit >= 0.6,
    }
    assert [name for name, good in holds.items() if not good] == ([missing] if missing else [])
    assert fix.is_sure == (missing is None)


def test_too_few_landmarks_are_never_sure():
    stand = Stand(seed=1)
    constellation = ConstellationMap(map_landmarks(stand.map(ACCURATE)))
    few = seen(stand.trees().positions()[:, :2], [50.0, 50.0, 0.0], np.random.default_rng(0), reach=20.0)
    for count in (0, 1, 2, 3, 15):
        fix = constellation.locate(few.select(np.arange(count)))
        assert not fix.is_sure and np.isfinite(fix.pose).all() and np.linalg.eigvalsh(fix.covariance)[0] > 0.0
    together = landmarks(np.zeros((20, 2)))
    assert not constellation.locate(together).is_sure


def test_maps_and_parameters_are_checked():
    with pytest.raises(ValueError, match="at least 3 landmarks, not 2"):
        ConstellationMap(landmarks([[0.0, 0.0], [1.0, 1.0]]))
    with pytest.raises(ValueError, match="share lies between 0 and 1"):
        ConstellationMap(landmarks(np.eye(3, 2)), share=1.0)
    with pytest.raises(ValueError, match="correlation is finite and at least 0, .*, nan, 16 and 0.02"):
        ConstellationMap(landmarks(np.eye(3, 2)), correlation=np.nan)


@pytest.mark.slow_cases
@pytest.mark.parametrize("correlation", [0.0, 40.0])
def test_landmarks_that_fit_nowhere_are_not_sure(correlation):
    stand = Stand(seed=3, length=60.0, width=60.0)
    table = ConstellationMap(map_landmarks(stand.map(POOR)), correlation=correlation)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 30))
        places, diameters = rng.uniform(-15.0, 15.0, (n, 2)), rng.uniform(0.06, 0.4, n)
        local = Landmarks(places, np.tile(1e-4 * np.eye(2), (n, 1, 1)), diameters, np.full(n, 0.01))
        assert not table.locate(local).is_sure

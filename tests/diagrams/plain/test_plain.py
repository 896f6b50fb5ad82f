"""Tests of the plain: its rocks against the law of sizes, and the scenario."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.distance import pdist, squareform

from vtbdrake.components.localization.landmarks import map_landmarks
from vtbdrake.components.world_model import WorldModel
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.forest.world.ground import Ground
from vtbdrake_diagrams.forest.world.stand import ACCURATE, REMOTE
from vtbdrake_diagrams.plain.rocks import RockField, rock_surface
from vtbdrake_diagrams.plain.scenario import PlainScenario

pytestmark = pytest.mark.one_python


def diameters(rocks: WorldModel) -> np.ndarray:
    """The geometric means of length and width."""
    return np.array([(one.number("length", unit="m") * one.number("width", unit="m")) ** 0.5 for one in rocks])


@pytest.mark.slow_cases
@pytest.mark.parametrize("abundance", [0.03, 0.06])
def test_covered_area_follows_the_law(abundance: float) -> None:
    """F(D) = k exp(-q D); rocks above 1.5 m are too few to test."""
    found = np.concatenate([diameters(RockField(seed, length=200.0, abundance=abundance).rocks()) for seed in range(3)])
    q = 1.79 + 0.152 / abundance
    for low, high in ((0.3, 0.5), (0.5, 1.0)):
        covered = (np.pi / 4.0 * found[(found > low) & (found < high)] ** 2).sum() / 6e4
        expected = abundance * (np.exp(-q * low) - np.exp(-q * high))
        assert covered == pytest.approx(expected, rel=0.15)


def test_number_of_rocks_is_the_integral() -> None:
    k = 0.05
    q = 1.79 + 0.152 / k
    number, _ = quad(lambda d: 4.0 * k * q * np.exp(-q * d) / (np.pi * d**2), 0.3, 2.0)
    assert RockField().density() == pytest.approx(number, rel=1e-4)
    assert len(RockField().rocks()) == pytest.approx(number * 1e4, rel=0.12)


def test_rocks_do_not_touch_and_leave_tracks_free() -> None:
    plain = RockField(seed=2, track_width=4.0)
    rocks = plain.rocks()
    radii = np.array([0.5 * one.number("length", unit="m") for one in rocks])
    gaps = squareform(pdist(rocks.positions())) - radii - radii[:, np.newaxis] + 10.0 * np.eye(len(rocks))
    assert gaps.min() > 0.0
    for route in plain.routes():
        assert (route.distances(rocks.positions()[:, :2]) - radii).min() > 2.0 - 0.05
    assert np.array_equal(rocks.positions(), RockField(seed=2, track_width=4.0).rocks().positions())


def test_maps_have_errors() -> None:
    plain = RockField(seed=3)
    found, true = map_landmarks(plain.map(ACCURATE), "rock"), plain.rocks().positions()[:, :2]
    assert len(found) == len(true)
    gaps = np.linalg.norm(found.positions[:, np.newaxis] - true, axis=2).min(axis=1)
    # The mean of a Rayleigh distribution.
    assert gaps.mean() == pytest.approx(0.1 * np.sqrt(np.pi / 2.0), rel=0.1)
    assert len(plain.map(REMOTE)) == round(len(true) * 0.7 / 0.9)


def test_surface_of_the_rocks_has_their_sizes() -> None:
    rocks, ground = RockField(seed=4, length=30.0, width=30.0).rocks(), Ground(seed=4)
    vertices, _ = rock_surface(rocks, ground)
    per_rock = vertices.reshape(len(rocks), -1, 3)
    for one, points in zip(rocks, per_rock, strict=True):
        in_O = (points - points.mean(axis=0)) @ one.X_WO.rotation().matrix()
        sizes = [one.number(name, unit="m") for name in ("length", "width", "height")]
        assert np.ptp(in_O, axis=0) == pytest.approx(sizes, rel=0.03)
    middles = per_rock.mean(axis=1)
    np.testing.assert_allclose(middles[:, 2], ground.height(middles[:, 0], middles[:, 1]), atol=1e-9)


@pytest.mark.slow
def test_carrier_drives_on_mars() -> None:
    testbed = PlainScenario(length=60.0, width=60.0).build()
    context = testbed.default_context()
    before = testbed.read(context, "sim.sys.carrier.base.pose")
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(4.0)
    moved = testbed.read(context, "sim.sys.carrier.base.pose") - before
    assert np.hypot(*moved[:2]) == pytest.approx(3.0, abs=0.1)
    # At rest, the accelerometer would show 3.71 m/s^2.
    assert np.linalg.norm(testbed.read(context, "sim.sense.imu.imu")[3:]) == pytest.approx(3.71, abs=0.5)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"abundance": 0.5}, "abundance must be a number from 0.005 to 0.3, not 0.5"),
        ({"least_diameter": 3.0}, "least_diameter must be below the largest_diameter, 2 m, not 3.0"),
        ({"track_width": 1.0}, "the carrier is 1.5 m wide"),
    ],
)
def test_impossible_plains_are_refused(fields: dict[str, float], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        PlainScenario(**fields).validate()

"""Scans out of real clouds are located on the stems of their plots; a few landmarks, also of several scans, suffice."""

import numpy as np
import pytest

from tests.real import recordings
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.planar import rotation
from vtbdrake_diagrams.forest.reality import Detection, Plot, as_landmarks, detections, grid, grid_step
from vtbdrake_diagrams.forest.studies import cloud_poses
from vtbdrake_diagrams.forest.studies.cloud_poses import Chain, gathered, located, place_of, route, windows
from vtbdrake_diagrams.forest.studies.clouds import PARTIAL, Cloud, rings
from vtbdrake_diagrams.forest.studies.mismatches import mirrored

pytestmark = pytest.mark.one_python

STEMS = np.array([[2.0, 9.0, 0.3], [8.0, 1.0, 0.2], [5.0, 14.0, 0.4], [12.0, 6.0, 0.25], [-3.0, 4.0, 0.5]])


def scan_at(place: list[float]) -> Detection:
    """Return a scan that detects all of `STEMS`, without errors."""
    eye, none = np.array([*place, 2.0]), np.zeros(0)
    trunks = as_landmarks(STEMS[:, :2] - eye[:2], STEMS[:, 2], deviation=0.03)
    rows = np.arange(len(STEMS))
    return Detection(none, none, np.zeros((0, 2)), none, none, rows, rows, rows, trunks, trunks.widened(0.1), eye)


def test_route_passes_columns_in_turns() -> None:
    places = np.array([[0.0, 0.0], [0.0, 4.0], [4.0, 0.0], [4.0, 4.0], [8.0, 2.0]])
    order = route(places)
    assert order == [0, 1, 3, 2, 4]
    assert list(windows(order, 2)) == [[1, 0], [0, 1], [1, 3], [3, 2], [2, 4]]


def test_scans_on_the_way_agree_within_the_drift(monkeypatch) -> None:
    scans = [scan_at(place) for place in ([0.0, 0.0], [0.0, 4.0], [4.0, 4.0])]
    monkeypatch.setattr(cloud_poses, "WHEELS", 0.0)
    chain = Chain(Plot("plot", None, STEMS, STEMS, 0.02), scans, 0.0)  # type: ignore[arg-type]
    submaps = [gathered(chain, [0, 1, 2], np.random.default_rng(seed)) for seed in range(20)]
    # The last leg is along x: there, H has the axes of the cloud.
    errors = np.array([each.positions - (STEMS[:, :2] - [4.0, 4.0]) for each in submaps])
    assert all(len(each) == len(STEMS) for each in submaps)
    assert np.sqrt(np.mean(errors**2)) < 0.08
    squares = [
        error @ np.linalg.solve(C, error)
        for each, deltas in zip(submaps, errors, strict=True)
        for C, error in zip(each.covariances, deltas, strict=True)
    ]
    assert np.mean(squares) < 3.0
    monkeypatch.setattr(cloud_poses, "WHEELS", 1.0)
    assert len(gathered(chain, [0, 1, 2], np.random.default_rng(0))) > len(STEMS)  # Nothing agrees any more.


def test_outline_widens_as_the_detector_with_it() -> None:
    scan = scan_at([0.0, 0.0])
    np.testing.assert_allclose(scan.with_outline(0.05).covariances, scan.outlined.covariances)
    np.testing.assert_allclose(scan.with_outline(0.0).diameter_deviations, scan.trunks.diameter_deviations)
    more = scan.with_outline(0.1).covariances - scan.trunks.covariances
    np.testing.assert_allclose(more, 4.0 * (scan.outlined.covariances - scan.trunks.covariances))


def test_clouds_of_one_place_do_not_fit_each_other() -> None:
    assert place_of("ponderosa, from the air") == place_of("ponderosa, mobile") != place_of("ponderosa, TLS")


@pytest.mark.slow
def test_scans_out_of_a_cloud_are_located_and_never_wrong() -> None:
    pytest.importorskip("laspy")
    (path,) = recordings("spanner/TLS_Clip.laz")
    cloud = Cloud.read(path)
    full, partial = rings(cloud), rings(cloud, arc=PARTIAL, fewest=8)
    places = list(grid(cloud, grid_step(cloud)))
    scans = list(detections(cloud, full, partial, noise=0.02, places=places))
    chain = Chain(Plot("ponderosa, TLS", cloud, full, partial, 0.02), scans, 0.13)
    results = located(chain, chain.trunks)
    assert len(results) == 30 and sum(each.fix.is_sure for each in results) >= 13
    assert not any(each.is_wrong for each in results)
    assert all(each.refusal for each in results if not each.fix.is_sure)
    mirror = ConstellationMap(mirrored(chain.stems()), fewest=cloud_poses.FEWEST)
    assert not any(mirror.locate(chain.trunks(scan)).is_sure for scan in scans)
    # Against the place in the cloud, turned and moved by hand.
    expected = np.array([100.0, -50.0]) + np.array([scan.eye[:2] for scan in scans]) @ rotation(2.0).T
    sure = [k for k, each in enumerate(results) if each.fix.is_sure]
    assert np.abs([results[k].fix.pose[:2] - expected[k] for k in sure]).max() < 0.3

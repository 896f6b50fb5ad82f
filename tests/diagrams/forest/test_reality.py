"""Real scans of forests on real field maps, and the detector of trunks in real point clouds."""

import numpy as np
import pytest

from tests.real import recordings
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake_diagrams.forest.reality import (
    airborne,
    around,
    detections,
    disagreement,
    grid,
    halves,
    petawawa,
    rioja_map,
)
from vtbdrake_diagrams.forest.studies.clouds import PARTIAL, Cloud, rings
from vtbdrake_diagrams.forest.studies.recordings import rioja, stems

pytestmark = pytest.mark.one_python


@pytest.mark.slow
def test_scans_of_la_rioja_are_located_among_all_its_trees() -> None:
    (path,) = recordings("fortls_rioja/Rioja.data.RData")
    scans, inventories = rioja(path.parents[1])
    surveyed = rioja_map(inventories)
    assert len(surveyed) == 304
    parts = [ConstellationMap(half) for half in halves(surveyed)]
    whole, squared = ConstellationMap(surveyed), []
    for plot in range(1, 17):
        local = stems(scans, plot, deviation=0.1, diameter=0.03)
        fix = whole.locate(local)
        assert fix.is_sure and len(fix.pairs) >= 26
        first, second = (part.locate(local) for part in parts)
        assert first.is_sure and second.is_sure
        distance, nees = disagreement(first, second)
        assert distance < 0.2
        squared.append(nees)
    assert max(squared) < 7.8  # 95 % of chi-square with three degrees of freedom


def test_a_mobile_scan_is_located_on_its_field_plot() -> None:
    (path,) = recordings("treematching_prf/PRF025_Field.rda")
    local, inventory = petawawa(path.parents[1])
    fix = ConstellationMap(inventory).locate(local)
    assert fix.is_sure and len(fix.pairs) > 50
    # The stems and the plot are in the same coordinates, up to the errors of the satellite receiver and the compass.
    assert np.hypot(*fix.pose[:2]) < 3.0 and abs(fix.pose[2]) < 0.1


@pytest.mark.slow
def test_treetops_from_the_air_are_refused() -> None:
    (path,) = recordings("treematcher/Air_Positions.txt")
    local, tops = airborne(path.parents[1])
    assert not ConstellationMap(tops).locate(local).is_sure


@pytest.mark.slow
def test_trunks_are_found_among_branches() -> None:
    """A plantation of pines with whorls of dead branches: the reference are rings of the whole cloud."""
    pytest.importorskip("laspy")
    (path,) = recordings("treels/pine_plot.laz")
    cloud = Cloud.read(path)
    full, partial = rings(cloud), rings(cloud, arc=PARTIAL, fewest=8)
    assert len(full) == 15
    results = list(detections(cloud, full, partial, noise=0.02, places=grid(cloud, 2.0)))
    right = np.concatenate([each.right for each in results])
    assert len(right) >= 30 and right.mean() > 0.8
    assert sum(len(each.false) for each in results) <= 1
    assert np.median(np.vstack([each.errors for each in results])[:, 0]) < 0.05


@pytest.mark.slow
def test_pine_that_had_no_part_in_the_constants_is_found_from_all_sides() -> None:
    pytest.importorskip("laspy")
    (path,) = recordings("treels/pine.laz")
    cloud = Cloud.read(path)
    full = rings(cloud)
    assert len(full) == 1
    results = list(detections(cloud, full, full, noise=0.02, places=list(around(full[0]))[::4]))
    assert len(results) == 12
    assert all(each.right.tolist() == [True] and not each.false.size and not each.beside.size for each in results)
    assert np.abs(np.vstack([each.errors for each in results])).max() < 0.05

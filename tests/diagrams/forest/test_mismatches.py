"""Scans on maps that do not show their places are never sure; stems of real scans on the maps of their plots are."""

from collections.abc import Sequence

import numpy as np
import pytest

from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake_diagrams.forest.studies.mismatches import mirrored, pairs
from vtbdrake_diagrams.forest.studies.recordings import FOLDER, read_r, rioja, stems

pytestmark = pytest.mark.one_python

needs_rioja = pytest.mark.skipif(
    not (FOLDER / "fortls_rioja").is_dir(), reason=f"the recording fortls_rioja is not in {FOLDER}"
)


@pytest.mark.slow
def test_simulated_scans_are_not_sure_on_wrong_maps() -> None:
    matched = list(pairs(20, seed=3, recordings=False))
    assert {pair.kind for pair in matched} == {"mirrored", "other"}
    assert not any(pair.fix.is_sure for pair in matched)


@pytest.mark.slow
@needs_rioja
def test_stems_of_real_scans_are_not_sure_on_wrong_maps() -> None:
    matched = [pair for pair in pairs(40, seed=4) if pair.kind in ("recorded", "mixed")]
    assert len(matched) == 20
    assert not any(pair.fix.is_sure for pair in matched)


@needs_rioja
def test_a_mirrored_plot_of_forty_metres_is_not_its_own_image() -> None:
    """By chance, 12 of the 36 stems fit: as much evidence as suffices among the few poses of so small a map."""
    scans, inventories = rioja()
    local = stems(scans, 12, deviation=0.1, diameter=0.03)
    inventory = stems(inventories, 12, deviation=0.3, diameter=0.03)
    fix = ConstellationMap(mirrored(inventory)).locate(local)
    assert fix.log_likelihood > 19.0 and len(fix.pairs) == 12
    assert not fix.is_sure


@needs_rioja
@pytest.mark.slow_cases
@pytest.mark.parametrize("plots", [(1, 6, 11, 16), range(1, 17)], ids=len)
def test_real_scans_are_sure_on_the_maps_of_their_plots(plots: Sequence[int]) -> None:
    scans, inventories = rioja()
    headings = []
    for plot in plots:
        inventory = stems(inventories, plot, deviation=0.3, diameter=0.03)
        fix = ConstellationMap(inventory).locate(stems(scans, plot, deviation=0.1, diameter=0.03))
        assert fix.is_sure
        # The scanner stands near the middle of the plot, and nearly all of its stems are in the inventory.
        assert np.hypot(*fix.pose[:2]) < 3.0
        assert len(fix.pairs) > 25
        headings.append(fix.pose[2])
    # All plots were surveyed with the same deviation of the compass.
    assert np.std(headings) < np.radians(2.0)


@needs_rioja
def test_the_tables_of_r_are_read() -> None:
    """Against what the publishers say of them."""
    scans, inventories = rioja()
    assert (len(scans["x"]), len(inventories["x"])) == (604, 659)
    for table in (scans, inventories):
        np.testing.assert_allclose(np.hypot(table["x"], table["y"]), table["h.dist"], atol=0.6)
        assert set(table["id"]) == set(range(1, 17))
    assert inventories["h.dist"].max() < 20.5


def test_other_files_are_no_tables_of_r(tmp_path) -> None:
    path = tmp_path / "table.rda"
    path.write_bytes(b"x,y\n1,2\n")
    with pytest.raises(ValueError, match="begins with"):
        read_r(path)

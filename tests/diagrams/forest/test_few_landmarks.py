"""Scans of few landmarks: their poses are sure on their own map only, and then right."""

import numpy as np
import pytest

from vtbdrake.components.localization.landmarks import map_landmarks
from vtbdrake_diagrams.forest.studies.few_landmarks import FEW, RIGHT, Claim, claimed, claims, nearest, row
from vtbdrake_diagrams.forest.studies.mismatches import mirrored
from vtbdrake_diagrams.forest.studies.recordings import FOLDER
from vtbdrake_diagrams.forest.world.stand import ACCURATE, Stand

pytestmark = pytest.mark.one_python


def test_few_landmarks_are_sure_on_their_own_map_only() -> None:
    mapped = map_landmarks(Stand(seed=4, length=40.0, width=40.0).map(ACCURATE))
    place = np.array([20.0, 18.0])
    local = mapped.seen_from([*-place, 0.0])
    local = local.select(np.hypot(*local.positions.T).argsort()[:12])
    own, elsewhere = claimed(local, mapped, place), claimed(local, mirrored(mapped), None)
    assert own == Claim(12, True, True, True)
    assert elsewhere == Claim(12, False, False, False)
    assert claimed(local, mapped, place + np.array([1.1 * RIGHT, 0.0])) == Claim(12, True, True, False)
    assert row("12", [own, elsewhere, Claim(12, True, True, False)])[1:] == ("1 of 2", "1", "0 of 1")


def test_nearest_landmarks_are_left() -> None:
    mapped = map_landmarks(Stand(seed=5, length=40.0, width=40.0).map(ACCURATE))
    left = nearest(mapped, np.random.default_rng(0))
    assert FEW[0] <= len(left) <= FEW[1]
    reach = np.hypot(*left.positions.T).max()
    assert (np.hypot(*mapped.positions.T) <= reach).sum() == len(left)


@pytest.mark.slow
@pytest.mark.parametrize("recordings", [False, True])
def test_claims_of_few_landmarks_are_right(recordings) -> None:
    if recordings and not (FOLDER / "fortls_rioja").is_dir():
        pytest.skip(f"the recording fortls_rioja is not in {FOLDER}")
    results = list(claims(150, seed=7, recordings=recordings))
    sure = [each for each in results if each.is_sure]
    assert len(sure) >= 5
    assert all(each.is_right for each in sure)

"""The detector of markers on real photographs."""

import numpy as np
import pytest

from tests.real import recordings
from vtbdrake.components.perception.markers import MarkerDetectorConfig
from vtbdrake_diagrams.satellite.reality import outcome, photographs

pytestmark = pytest.mark.one_python


@pytest.mark.slow_cases
@pytest.mark.parametrize(("upscaling", "least"), [(1, (12, 15, 9)), (2, (12, 20, 10))])
def test_tags_of_real_photographs_are_found(upscaling, least):
    folder = recordings("apriltag/*_c.jpg")[0].parent
    outcomes = [outcome(picture, MarkerDetectorConfig(upscaling=upscaling)) for picture in photographs(folder)]
    assert all(np.isfinite(result.errors).sum() >= count for result, count in zip(outcomes, least, strict=True))
    assert not any(result.false for result in outcomes)
    assert np.nanmedian(np.concatenate([result.errors for result in outcomes])) < 0.45

"""The picture of docs/forest.md, without the photograph."""

import numpy as np

from vtbdrake.visualization.plots import Picture
from vtbdrake_diagrams.forest.pictures.picture import draw_errors, draw_surroundings, simulated
from vtbdrake_diagrams.forest.scenario import ForestScenario


def test_picture_shows_scan_and_pose_of_one_time() -> None:
    scenario = ForestScenario(seed=1, length=50.0, width=50.0, start=12.0)
    seen = simulated(scenario, np.array([0.7, 1.4, 1.75]))
    trunks = seen.landmarks_H[np.isfinite(seen.landmarks_H).all(axis=1)]
    away = np.linalg.norm(trunks[:, None, :2] - seen.points_H[:, :2], axis=2) - trunks[:, 2:] / 2.0
    assert len(trunks) > 20
    assert np.quantile(np.abs(away).min(axis=1), 0.9) < 0.02

    above, errors = Picture(6.0, 3.0).subplots(1, 2)
    draw_surroundings(above, scenario, seen)
    draw_errors(errors, seen)
    *_, carrier = above.lines
    np.testing.assert_allclose(np.ravel(carrier.get_data()), seen.truth[-1, :2], atol=0.4)
    first, last = errors.patches
    assert last.contains_point(errors.transData.transform(seen.positions[-1] - seen.truth[-1, :2]))
    assert first.height <= first.width < 0.5

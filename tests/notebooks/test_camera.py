"""The notebook `camera` runs, and is stored as it runs. One file each, so that notebooks run side by side."""

import pytest

from tests.notebooks.checks import check_runs, check_stored


def test_is_stored_with_text_and_plots() -> None:
    check_stored("camera")


@pytest.mark.slow
def test_runs_in_a_shorter_version() -> None:
    shorter = {
        "np.geomspace(0.1, 100.0, 13)": "np.geomspace(0.1, 10.0, 3)",
        "horizon=24.0": "horizon=4.0",
        "problem.sweep(5, ": "problem.sweep(2, ",
        "tried = lights": 'tried = {"beside, 70 deg": lights["beside, 70 deg"]}',
        "assert worst[1] < worst[0]": "assert worst[1] < worst[0] + 1.0",
    }
    check_runs("camera", shorter=shorter)

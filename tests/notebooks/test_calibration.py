"""The notebook `calibration` runs, and is stored as it runs. One file each, so that notebooks run side by side."""

import pytest

from tests.notebooks.checks import check_runs, check_stored


def test_is_stored_with_text_and_plots() -> None:
    check_stored("calibration")


@pytest.mark.slow
def test_runs_in_a_shorter_version() -> None:
    # Of one recording; tests/calibration/test_calibration.py compares the predictions of two.
    check_runs("calibration", shorter={"for log in held_out])": "for log in held_out[:1]])"})

"""The notebook `capture` runs, and is stored as it runs. One file each, so that notebooks run side by side."""

import pytest

from tests.notebooks.checks import check_runs, check_stored


def test_is_stored_with_text_and_plots() -> None:
    check_stored("capture")


@pytest.mark.slow
def test_runs_in_a_shorter_version() -> None:
    shorter = {
        "[0.5, 7.0, 12.0]": "[0.5, 1.0, 1.5]",
        "horizon=16.0": "horizon=8.5",
        "[0.5, 1.0, 2.0, 4.0, 16.0]": "[2.0]",
    }
    check_runs("capture", shorter=shorter)

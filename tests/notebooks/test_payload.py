"""The notebook `payload` runs, and is stored as it runs. One file each, so that notebooks run side by side."""

import pytest

from tests.notebooks.checks import check_runs, check_stored


def test_is_stored_with_text_and_plots() -> None:
    check_stored("payload")


@pytest.mark.slow
def test_runs_in_a_shorter_version() -> None:
    shorter = {
        "values=[0, 20, 30, 40, 60]": "values=[0, 60]",
        "resolution=2.0, coarse=10.0": "resolution=5.0, coarse=15.0",
    }
    check_runs("payload", shorter=shorter)

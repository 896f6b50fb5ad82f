"""The notebook `forest` runs, and is stored as it runs. One file each, so that notebooks run side by side."""

import pytest

from tests.notebooks.checks import check_runs, check_stored


def test_is_stored_with_text_and_plots() -> None:
    check_stored("forest")


@pytest.mark.slow
def test_runs_in_a_shorter_version() -> None:
    shorter = {
        "width=640, height=400": "width=160, height=100",
        "length=25.0": "length=2.0",
        "cycles=200": "cycles=60",
        "PARTED, END = 18.0, 25.0": "PARTED, END = 3.0, 5.0",
    }
    check_runs("forest", shorter=shorter)

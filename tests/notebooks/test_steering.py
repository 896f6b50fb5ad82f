"""The notebook `steering` runs, and is stored as it runs. One file each, so that notebooks run side by side."""

import pytest

from tests.notebooks.checks import check_runs, check_stored


def test_is_stored_with_text_and_plots() -> None:
    check_stored("steering")


@pytest.mark.slow
def test_runs_in_a_shorter_version() -> None:
    check_runs(
        "steering",
        shorter={'solver="bayesian", seed=1).run(rollouts=120': 'solver="bayesian", seed=1).run(rollouts=20'},
    )

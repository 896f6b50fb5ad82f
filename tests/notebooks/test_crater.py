"""The notebook `crater` runs, and is stored as it runs. One file each, so that notebooks run side by side."""

import pytest

from tests.notebooks.checks import check_runs, check_stored


def test_is_stored_with_text_and_plots() -> None:
    check_stored("crater")


@pytest.mark.slow
def test_runs_in_a_shorter_version() -> None:
    shorter = {
        "heading_reasoner(scenario)": "heading_reasoner(scenario, candidates=3, executor='serial')",
        "import explain, passes": "import COUNTERFACTUALS, explain, passes\n\n"
        "del COUNTERFACTUALS['boulders'], COUNTERFACTUALS['the gully']",
        "explain(scenario, failing)": "explain(scenario, failing, executor='serial')",
        "most=2, count=20": "most=1, count=4",
    }
    check_runs("crater", shorter=shorter)

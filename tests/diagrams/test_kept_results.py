"""Results of campaigns that are kept in files beside their studies."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from vtbdrake_diagrams.kept_results import KeptResultsError, read_results, write_results

RESULTS = {"times": np.array([1.5, np.nan]), "name": "a", "rows": [{"count": 2}]}


def test_results_come_back_as_plain_values(tmp_path: Path) -> None:
    file = tmp_path / "kept.json"
    write_results(file, RESULTS, command="make it")
    assert read_results(file) == {"times": [1.5, None], "name": "a", "rows": [{"count": 2}]}
    content = json.loads(file.read_text())
    assert content["command"] == "make it"
    assert content["date"].startswith("20")


def test_numbers_changed_by_hand_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "kept.json"
    write_results(file, RESULTS, command="make it")
    file.write_text(file.read_text().replace("1.5", "1.4"))
    with pytest.raises(KeptResultsError, match="do not have its digest: make it anew by 'make it'"):
        read_results(file)


def test_missing_file_names_its_remedy(tmp_path: Path) -> None:
    with pytest.raises(KeptResultsError, match="is missing: make it by the command"):
        read_results(tmp_path / "kept.json")


@pytest.mark.parametrize("study", ["mount", "scan_frequency"])
def test_results_of_the_studies_have_their_digest(study: str) -> None:
    folder = Path(__file__).resolve().parents[2] / "diagrams/satellite/studies"
    assert read_results(folder / f"{study}.json")

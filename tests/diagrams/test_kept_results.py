"""Results of campaigns that are kept in files beside their studies."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from vtbdrake_diagrams.kept_results import (
    KeptResultsError,
    Repetition,
    add_results,
    read_results,
    repeat,
    write_results,
)
from vtbdrake_diagrams.processes import in_processes

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


@pytest.mark.parametrize(
    "study",
    ["mount", "mount_search", "scan_frequency", "scanned_captures", "lighting", "trajectory", "planned_capture"],
)
def test_results_of_the_studies_have_their_digest(study: str) -> None:
    folder = Path(__file__).resolve().parents[2] / "diagrams/satellite/studies"
    assert read_results(folder / f"{study}.json")


SQUARES = {number: float(number**2) for number in range(1, 31)}


def square(number: int) -> float:
    return float(number) ** 2


def test_only_results_that_are_missing_are_made_and_all_are_kept(tmp_path: Path) -> None:
    file, results = tmp_path / "kept.json", {2: -4.0}
    add_results(file, results, range(1, 5), square, command="make it", workers=1)
    assert results == {1: 1.0, 2: -4.0, 3: 9.0, 4: 16.0}
    assert read_results(file) == {str(seed): value for seed, value in results.items()}


def near(before: float, now: float) -> bool:
    return abs(before - now) < 0.5


def test_a_tenth_is_made_again_and_is_the_same() -> None:
    repetition = repeat("squares", SQUARES, square, near, workers=1)
    assert (repetition.count, repetition.total, repetition.same) == (3, 30, True)
    assert str(repetition) == f"3 of 30 kept squares simulated again (drawn by seed {repetition.seed}): as kept"


def test_results_that_come_out_differently_are_named() -> None:
    wrong = {**SQUARES, 7: 50.0}
    assert repeat("squares", wrong, square, near, share=1.0, workers=1).different == ("7",)
    # One wrong result of 30 is among a tenth in one of ten draws.
    draws = [repeat("squares", wrong, square, near, seed=seed, workers=1) for seed in range(200)]
    assert 5 < sum(not draw.same for draw in draws) < 40
    assert "OTHERS than kept: 7" in str(next(draw for draw in draws if not draw.same))


def test_a_share_may_be_others_where_rounding_decides() -> None:
    def again(wrong: int) -> Repetition:
        kept = {**SQUARES, **{number: -1.0 for number in range(1, wrong + 1)}}
        return repeat("squares", kept, square, near, share=1.0, allowed=0.1, workers=1)

    assert again(3).same and not again(4).same
    assert str(again(3)).endswith("as kept but for at most 3: 1; 2; 3")
    assert str(again(0)).endswith("as kept")


def test_seed_draws_the_same_results_again() -> None:
    wrong = {number: -1.0 for number in SQUARES}
    first = repeat("squares", wrong, square, near, workers=1)
    assert repeat("squares", wrong, square, near, seed=first.seed, workers=1) == first
    others = {repeat("squares", wrong, square, near, workers=1).different for _ in range(5)}
    assert len(others) > 1


def test_processes_give_results_in_the_order_of_the_cases() -> None:
    assert list(in_processes(abs, [-3, 1, -2], workers=2)) == [(-3, 3), (1, 1), (-2, 2)]


def test_processes_have_one_thread_for_linear_algebra(monkeypatch: pytest.MonkeyPatch) -> None:
    """With several, the solver of a plan rounds in another order, and a plan may be another one."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    names = ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"]
    assert list(in_processes(os.getenv, names, workers=2)) == [(name, "1") for name in names]
    assert [os.getenv(name) for name in names] == [None, "7"]

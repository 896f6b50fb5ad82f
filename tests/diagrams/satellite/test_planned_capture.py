"""The study of planned approaches, from captures that are written down here, and from the kept ones."""

from __future__ import annotations

from dataclasses import replace

import pytest

from vtbdrake_diagrams.satellite.studies.planned_capture import (
    KINDS,
    Capture,
    PlannedCaptures,
    agree,
    capture,
    kept_captures,
    median,
)
from vtbdrake_diagrams.satellite.supervisor import Arrival, Reason

GOOD = Capture(
    seed=1,
    wheels=False,
    approach="resolved_rate",
    succeeded=True,
    reason=Reason.STOPPED,
    arrival=Arrival.RATES,
    grip=15.0,
    end=22.0,
    largest=20.0,
    at_grip=18.0,
    final=17.0,
    clearance=0.03,
    from_target=0.3,
    off=0.002,
    planning=None,
)


def captures(count: int) -> dict[tuple[int, bool, str], Capture]:
    """Return captures in which a plan halves the largest deviation and takes 10 s longer."""
    rows = {}
    for seed in range(count):
        for wheels, approach in KINDS:
            row = replace(GOOD, seed=seed, wheels=wheels, approach=approach, largest=20.0 + seed)
            if approach == "planned":
                row = replace(row, arrival=Arrival.ARRIVED, grip=25.0, largest=10.0 + 0.5 * seed, planning=2.0)
            rows[seed, wheels, approach] = row
    return rows


def test_table_counts_failures_refusals_and_better_starts() -> None:
    rows = captures(10)
    rows[3, True, "planned"] = replace(
        rows[3, True, "planned"], succeeded=False, grip=None, at_grip=None, largest=30.0, arrival=Arrival.REFUSED
    )
    study = PlannedCaptures(rows)
    assert (study.better("largest", wheels=False), study.better("largest", wheels=True)) == (10, 9)
    assert study.better("grip", wheels=False) == 0
    words = str(study)
    assert "9 of 10" in words
    assert "Of 20 plans 1 were refused and 0 dropped" in words
    assert "after 25 s instead of 15 (medians); 10 succeed" in study.sentence


def test_start_counts_only_with_all_four_captures() -> None:
    rows = captures(5)
    del rows[4, True, "planned"]
    assert PlannedCaptures(rows).seeds == [0, 1, 2, 3]


def test_interval_of_the_median_is_by_order_statistics() -> None:
    # Of 10 numbers, the 2nd and the 9th enclose the median with 97.9 %, the 3rd and the 8th with 89.1 %.
    assert median(range(1, 11)) == (5.5, 2.0, 9.0)


def test_captures_agree_within_two_samples_and_a_third_of_a_degree() -> None:
    assert agree(GOOD, replace(GOOD, grip=15.4, largest=20.2, planning=3.0))
    assert not agree(GOOD, replace(GOOD, grip=15.8))
    assert not agree(GOOD, replace(GOOD, final=17.4))
    assert not agree(GOOD, replace(GOOD, succeeded=False))
    assert not agree(GOOD, replace(GOOD, grip=None, at_grip=None))


@pytest.mark.slow
def test_kept_capture_comes_out_the_same() -> None:
    kept = kept_captures()
    case = min(kept)
    assert agree(kept[case], capture(case))

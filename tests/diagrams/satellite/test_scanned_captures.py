"""Captures that the laser scanner guides alone: from ones that are written down here, and from the kept ones."""

from __future__ import annotations

from dataclasses import replace
from math import nan

import pytest

from vtbdrake_diagrams.satellite.studies.scan_answer import guides_captures
from vtbdrake_diagrams.satellite.studies.scan_frequency import DESKEWED, RAW, TOLERANCE, Window
from vtbdrake_diagrams.satellite.studies.scanned_captures import (
    FIRST_SEED,
    FREQUENCIES,
    ScannedCapture,
    ScannedCaptures,
    ScannedCase,
    kept_captures,
    scanned_capture,
)
from vtbdrake_diagrams.satellite.supervisor import Reason

GOOD = ScannedCapture(succeeded=True, reason=Reason.STOPPED, grip=17.0, error=0.2 * TOLERANCE, end=25.0)
FAILED = ScannedCapture(succeeded=False, reason=Reason.LOST, grip=None, error=None, end=12.0)


def captures(outcomes: list[ScannedCapture], scans: str = DESKEWED, frequency: float = 2.0) -> ScannedCaptures:
    return ScannedCaptures({ScannedCase(scans, frequency, seed): each for seed, each in enumerate(outcomes)})


def test_nine_of_ten_suffice_and_eight_do_not() -> None:
    assert captures([GOOD] * 9 + [FAILED]).suffices(DESKEWED, 2.0)
    assert not captures([GOOD] * 8 + [FAILED] * 2).suffices(DESKEWED, 2.0)
    assert not captures([GOOD] * 10).suffices(RAW, 2.0)


def test_success_beyond_the_tolerance_does_not_count() -> None:
    off = replace(GOOD, error=0.021)
    study = captures([GOOD] * 8 + [off] * 2)
    assert not study.suffices(DESKEWED, 2.0)
    assert "10 of 10 " in str(study)
    assert "2 Hz 10 of 10 (17 s, 3.7 mm, at most 21.0)" in study.sentence


def test_reasons_of_failures_are_counted() -> None:
    row = str(captures([GOOD, FAILED, FAILED])).splitlines()[-1]
    assert "1 of 3" in row
    assert row.rstrip().endswith("lost 2")


def test_only_frequencies_that_surely_suffice_must_guide_captures() -> None:
    surely = Window((0.5, 1.0, 2.0), (2.0, 4.0, 16.0))
    others = captures([FAILED] * 10, frequency=4.0).captures
    both = ScannedCaptures({**captures([GOOD] * 10).captures, **others})
    assert guides_captures(surely, both)
    assert not guides_captures(replace(surely, upper=(4.0, 4.0, 16.0)), both)
    # Nothing that surely suffices, or no capture with it, shows nothing.
    assert not guides_captures(Window((0.5, 1.0, nan), (nan, 4.0, 16.0)), both)
    assert not guides_captures(surely, ScannedCaptures(others))


def test_captures_agree_within_two_samples_and_a_millimetre() -> None:
    assert GOOD.agrees(replace(GOOD, grip=17.4, error=GOOD.error + 5e-4))
    assert not GOOD.agrees(replace(GOOD, grip=17.6))
    assert not GOOD.agrees(replace(GOOD, error=GOOD.error + 2e-3))
    assert not GOOD.agrees(FAILED)
    assert FAILED.agrees(replace(FAILED, end=13.0))


def test_kept_captures_are_complete() -> None:
    kept = kept_captures()
    for scans in (DESKEWED, RAW):
        for frequency in FREQUENCIES:
            assert len(ScannedCaptures(kept).of(scans, frequency)) >= 20
    assert min(case.seed for case in kept) == FIRST_SEED


@pytest.mark.slow
@pytest.mark.one_python
def test_kept_capture_comes_out_again() -> None:
    case, capture = next((case, each) for case, each in kept_captures().items() if case.frequency == 2.0)
    assert capture.agrees(scanned_capture(case))

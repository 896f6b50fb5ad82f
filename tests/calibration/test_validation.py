"""Comparisons of curves whose differences are known in closed form."""

from __future__ import annotations

import re
from math import acos, pi, sqrt
from pathlib import Path

import numpy as np
import pytest
import scipy
from playwright.sync_api import Browser

from tests.chromium import needs_chromium, screenshot
from vtbdrake.calibration import Comparison, ToleranceConfig, compare
from vtbdrake.calibration.validation import ComparisonVerdict, delay, sprague_geers, whiteness
from vtbdrake.recording import Log, LogError, Series

pytestmark = pytest.mark.one_python

TIMES = np.linspace(0.0, 10.0, 2001)


def of(values: np.ndarray, times: np.ndarray = TIMES) -> dict[str, Series]:
    return {"q": Series(times, np.reshape(values, (len(times), -1)))}


def test_errors_of_magnitude_and_phase_of_sines() -> None:
    # Over whole periods, a sine with another amplitude and phase has M = a - 1 and P = phi / pi.
    times = 2.0 * pi * np.arange(1000) / 1000.0
    for amplitude, phi in ((1.0, 0.0), (1.3, 0.0), (1.0, 0.4), (0.7, -1.2)):
        magnitude, phase = sprague_geers(np.sin(times), amplitude * np.sin(times - phi))
        assert (magnitude, phase) == (pytest.approx(amplitude - 1.0, abs=1e-12), pytest.approx(abs(phi) / pi, abs=1e-7))
    assert np.isnan(sprague_geers(np.zeros(3), np.ones(3))).all()


@pytest.mark.parametrize("late", [0.0, 0.0137, 0.25, -0.4])
def test_delay_is_found_to_a_fraction_of_a_sample(late: float) -> None:
    def curve(t: np.ndarray) -> np.ndarray:
        return np.sin(2.0 * t) + 0.5 * np.sin(5.3 * t + 1.0) + np.exp(-((t - 5.0) ** 2))

    jittered = TIMES + np.random.default_rng(1).uniform(-1e-3, 1e-3, TIMES.size)
    assert delay(TIMES, curve(TIMES), curve(TIMES - late)) == pytest.approx(late, abs=5e-4)
    assert delay(jittered, curve(jittered), 3.0 * curve(jittered - late) + 7.0) == pytest.approx(late, abs=2e-3)
    assert np.isnan(delay(TIMES, curve(TIMES), np.ones(TIMES.size)))


def test_first_and_last_sample_count_for_the_delay() -> None:
    first = (TIMES[0] == TIMES).astype(float)
    last = (TIMES[-1] == TIMES).astype(float)
    assert delay(TIMES, first, np.roll(first, 3)) == pytest.approx(3.0 * TIMES[1], abs=1e-5)
    assert delay(TIMES, np.roll(last, -3), last) == pytest.approx(3.0 * TIMES[1], abs=1e-5)


def test_white_residuals_are_rejected_as_often_as_the_level_says() -> None:
    generator = np.random.default_rng(7)
    p_values = [whiteness(generator.normal(size=500)) for _ in range(400)]
    assert scipy.stats.kstest(p_values, "uniform").pvalue > 1e-3
    coloured = scipy.signal.lfilter([1.0], [1.0, -0.5], generator.normal(size=500))
    assert whiteness(coloured) < 1e-6 and np.isnan(whiteness(np.zeros(5))) and whiteness(np.ones(9)) == 1.0


def test_numbers_of_a_known_difference() -> None:
    reference = np.stack([np.sin(TIMES), np.cos(TIMES)], 1)
    bump = np.where(np.arange(TIMES.size) == 700, 0.5, 0.0)
    result = compare(of(reference), of(reference + np.stack([np.full(TIMES.size, 0.1), bump], 1)))
    first, second = result.signals["q[0]"], result.signals["q[1]"]
    assert first.rmse == pytest.approx(0.1) and first.normalized == pytest.approx(0.1 / np.ptp(reference[:, 0]))
    assert (second.largest, second.largest_at) == (pytest.approx(0.5), pytest.approx(TIMES[700]))
    assert second.rmse == pytest.approx(0.5 / sqrt(TIMES.size))
    r, s = reference[:, 0], reference[:, 0] + 0.1
    assert first.phase == pytest.approx(acos(r @ s / sqrt(r @ r * (s @ s))) / pi)
    assert result.verdict == ComparisonVerdict.NOT_JUDGED and first.samples == 2001 and np.isnan(first.coverage)


def test_simulation_is_taken_at_the_times_of_the_recording() -> None:
    times = np.sort(np.random.default_rng(3).uniform(-1.0, 12.0, 300))
    line = compare(of(2.0 * times, times), of(2.0 * TIMES))
    inside = (times >= 0.0) & (times <= 10.0)
    assert line.signals["q"].samples == inside.sum() and line.signals["q"].largest < 1e-12


def test_band_of_several_simulations_covers_what_it_says() -> None:
    generator = np.random.default_rng(5)
    simulations = [of(generator.normal(size=TIMES.size)) for _ in range(400)]
    result = compare(
        of(generator.normal(size=TIMES.size)), simulations, tolerances={"q": ToleranceConfig(coverage=0.9)}
    )
    # A binomial share of 2001 samples, with three standard deviations; the band's own quantiles err, too.
    assert result.signals["q"].coverage == pytest.approx(0.95, abs=0.02) and result.verdict == ComparisonVerdict.WITHIN
    narrow = compare(of(3.0 + TIMES), simulations, tolerances={"q": ToleranceConfig(coverage=0.9)})
    assert narrow.verdict == ComparisonVerdict.BEYOND and "coverage 0" in narrow.signals["q"].beyond[0]


def test_verdict_names_what_is_exceeded() -> None:
    tolerance = ToleranceConfig(rmse=0.2, largest=0.3, delay=0.01, magnitude=0.5, phase=0.5)

    def judged(simulated: np.ndarray) -> Comparison:
        return compare(Log("run.csv", of(np.sin(TIMES)), {}), of(simulated), tolerances={"q": tolerance})

    assert judged(np.sin(TIMES)).verdict == ComparisonVerdict.WITHIN
    late = judged(np.sin(TIMES - 0.05))
    assert late.verdict == ComparisonVerdict.BEYOND and [reason.split()[0] for reason in late.signals["q"].beyond] == [
        "delay"
    ]
    assert re.match(r"delay 0\.0(5|49)\d* > 0.01", late.signals["q"].beyond[0])
    still = judged(np.full(TIMES.size, 0.1))  # What cannot be computed is no success.
    assert [reason.split()[0] for reason in still.signals["q"].beyond] == ["rmse", "largest", "delay", "magnitude"]
    assert str(late).startswith("run.csv: beyond tolerances\n")
    course, _ = late.plot().axes  # One signal: its course, and the residuals beside it.
    assert [text.get_text() for text in course.get_legend().get_texts()] == ["recorded", "simulated"]


def test_page_names_its_recording_and_the_verdict(tmp_path: Path) -> None:
    recorded = Log("a<b.csv", of(np.sin(TIMES)), {})
    result = compare(recorded, of(np.sin(TIMES - 0.1)), tolerances={"q": ToleranceConfig(rmse=1e-3)})
    result.save_html(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "a&lt;b.csv: beyond tolerances" in text and "data:image/png;base64," in text


@pytest.mark.slow
@needs_chromium
def test_page_holds_verdict_numbers_and_plot(tmp_path: Path, browser: Browser) -> None:
    recorded = Log("a<b.csv", of(np.stack([np.sin(TIMES), TIMES], axis=1)), {})
    result = compare(
        recorded,
        of(np.stack([np.sin(TIMES - 0.1), TIMES], axis=1)),
        tolerances={"q": ToleranceConfig(rmse=1e-3)},
    )
    result.save_html(tmp_path / "page.html")
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto((tmp_path / "page.html").as_uri())
    assert page.locator("b").inner_text() == "a<b.csv: beyond tolerances"
    head, *rows = [row.locator("th, td").all_inner_texts() for row in page.locator("tr").all()]
    first, second = (dict(zip(head, row, strict=True)) for row in rows)
    assert first["signal"] == "q[0]" and second["signal"] == "q[1]"
    assert first["verdict"].startswith("beyond tolerances\nrmse 0.07") and second["verdict"] == "within tolerances"
    assert float(first["late by (ms)"]) == pytest.approx(100.0, rel=0.01)
    assert float(first["RMSE"]) == pytest.approx(0.1 / np.sqrt(2.0), rel=0.1) and float(second["RMSE"]) == 0.0
    width, right = page.locator("img").evaluate("e => [e.naturalWidth, e.getBoundingClientRect().right]")
    assert width > 400 and right <= 1280
    colours = screenshot(page).reshape(-1, 3)
    assert (np.abs(colours - [255, 127, 14]).max(axis=1) < 10).sum() > 200  # the simulation, in tab:orange
    page.close()


@pytest.mark.parametrize(
    ("reference", "simulation", "tolerances", "message"),
    [
        (of(TIMES), {"p": of(TIMES)["q"]}, {}, "the recording has q, the simulation p"),
        (of(TIMES), [], {}, "no simulation"),
        (of(TIMES), of(np.stack([TIMES, TIMES], 1)), {}, "1 entries in the recording, 2 in the simulation"),
        (of(TIMES), of(TIMES, TIMES + 20.0), {}, "recorded from 0 to 10 s and simulated from 20 to 30 s"),
        (of(TIMES), of(TIMES), {"w": ToleranceConfig()}, "a tolerance for 'w'"),
    ],
)
def test_what_cannot_be_compared_is_refused(reference, simulation, tolerances, message) -> None:
    with pytest.raises(LogError, match=message):
        compare(reference, simulation, tolerances=tolerances)


@pytest.mark.slow
def test_impossible_tolerance_is_refused() -> None:
    with pytest.raises(ValueError, match="ToleranceConfig.rmse must be a number of at least 0, not -1.0"):
        ToleranceConfig(rmse=-1.0)

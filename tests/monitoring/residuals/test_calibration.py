"""What nominal operation is taken to be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from vtbdrake.monitoring.residuals.alarms import Calibration, CalibrationError, calibrate

PLACES = {"sense.a": slice(0, 2), "act.b": slice(2, 3)}


def of(table: np.ndarray) -> Calibration:
    return calibrate(table, PLACES, horizon=10, period=1e-3)


def noise(windows: int) -> np.ndarray:
    return np.random.default_rng(3).normal([1.0, 0.0, -2.0], [0.1, 1.0, 3.0], (windows, 3))


def test_mean_and_deviation_of_plain_noise_are_found() -> None:
    found = of(noise(20_000))
    np.testing.assert_allclose([*found.mean["sense.a"], *found.mean["act.b"]], [1.0, 0.0, -2.0], atol=0.06)
    # The largest of 200 batches' deviations, each of which scatters by 7 %.
    ratios = np.array([*found.deviation["sense.a"], *found.deviation["act.b"]]) / [0.1, 1.0, 3.0]
    assert ((ratios > 1.05) & (ratios < 1.4)).all()
    assert (found.windows, found.horizon, found.period) == (20_000, 10, 1e-3)


def test_deviation_is_that_of_the_noisiest_time() -> None:
    table = noise(2000)
    table[500:600, 0] = 1.0 + 5.0 * (table[500:600, 0] - 1.0)
    assert of(table).deviation["sense.a"][0] == pytest.approx(table[500:600, 0].std(ddof=1))


def test_what_stays_for_a_while_takes_no_more_than_half_of_the_allowance() -> None:
    table = np.zeros((1000, 3))
    table[300:400] = 1.0
    found = of(table)
    assert found.mean["act.b"] == pytest.approx([0.1])
    assert found.deviation["act.b"] == pytest.approx([4 * 0.9])


def test_signal_that_comes_in_some_windows_only_is_judged_by_those() -> None:
    table = noise(2000)
    table[::2, 1] = np.nan
    table[400:600, 1] = np.nan
    shown = table[~np.isnan(table[:, 1]), 1]
    found = of(table)
    assert found.mean["sense.a"][1] == pytest.approx(shown.mean())
    assert 0.9 < found.deviation["sense.a"][1] < 1.5


def test_signal_that_never_came_has_no_deviation() -> None:
    table = noise(400)
    table[:, 2] = np.nan
    assert of(table).deviation["act.b"] == [0.0]


def test_short_run_is_refused() -> None:
    with pytest.raises(CalibrationError, match="at least 200 windows, not 150"):
        of(noise(150))


def test_file_gives_back_what_was_saved(tmp_path: Path) -> None:
    found = of(noise(300))
    found.save(tmp_path / "nominal.json")
    assert Calibration.load(tmp_path / "nominal.json") == found


@pytest.mark.parametrize("text", ["", "{", "[]", '{"mean": {}}', '{"other": 1}'])
def test_file_that_is_no_calibration_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "nominal.json").write_text(text)
    with pytest.raises(CalibrationError, match="not a calibration"):
        Calibration.load(tmp_path / "nominal.json")


@pytest.mark.parametrize("mean", [[], None, {"sense.level": [float("nan")]}, {"sense.level": ["a"]}])
def test_file_whose_numbers_are_none_is_refused(tmp_path: Path, mean: object) -> None:
    content = {"mean": mean, "deviation": {"sense.level": [1.0]}, "windows": 200, "horizon": 10, "period": 0.001}
    (tmp_path / "nominal.json").write_text(json.dumps(content))
    with pytest.raises(CalibrationError, match="not a calibration"):
        Calibration.load(tmp_path / "nominal.json")

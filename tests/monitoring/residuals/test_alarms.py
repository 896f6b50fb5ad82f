"""Alarms, calibration, and the cumulative sum test."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from drake import lcmt_iiwa_status

from tests.monitoring.residuals.line import Together
from tests.monitoring.residuals.pendulum import MASS, PAYLOAD, PERIOD, DrivenPendulum, machine
from vtbdrake.monitoring.residuals import ResidualConfig, ResidualMonitor
from vtbdrake.monitoring.residuals.alarms import (
    AlarmDetector,
    Cusum,
    NominalResiduals,
    NominalResidualsError,
    nominal_residuals,
    run_length,
    threshold_for,
)
from vtbdrake.monitoring.residuals.comparison import ResidualWindow

pytestmark = pytest.mark.one_python

NOISE = {"position": 1e-4, "velocity": 5e-3}
CONFIG = ResidualConfig(period=PERIOD, settle=0, tolerance={"act.torque": 1e-3})
SCENARIO = DrivenPendulum(sampled=True)


def start(
    *, mass: float = MASS, seed: int = 1, calibration: NominalResiduals | None = None, config: ResidualConfig = CONFIG
) -> tuple[Together, dict[str, ResidualMonitor]]:
    robot = machine(SCENARIO, values={PAYLOAD: mass}, noise=NOISE, seed=seed)
    together = Together(SCENARIO, robot, shadowing=SCENARIO)
    assert together.shadow is not None
    loops = {"twin": together.driver, "shadow": together.shadow}
    learn = calibration is None
    monitors = {
        mode: ResidualMonitor(loop, mode, config=config, calibration=calibration, learn=learn, worker=False)
        for mode, loop in loops.items()
    }
    return together, monitors


@cache
def nominal() -> NominalResiduals:
    together = Together(SCENARIO, machine(SCENARIO, values={PAYLOAD: MASS}, noise=NOISE, seed=1))
    monitor = ResidualMonitor(together.driver, "twin", config=CONFIG, learn=True, worker=False)
    together.run(4000)
    return monitor.calibrate()


def telling(field: str, change: Callable[[float], float]) -> Callable[[str, bytes], bytes]:
    """Return a function that changes a field of the machine's status messages."""

    def falsify(channel: str, data: bytes) -> bytes:
        message = lcmt_iiwa_status.decode(data)
        setattr(message, field, [change(value) for value in getattr(message, field)])
        return bytes(message.encode())

    return falsify


@pytest.mark.slow
def test_heavier_payload_raises_alarms() -> None:
    together, monitors = start(mass=1.05 * MASS, seed=2, calibration=nominal())
    together.run(500)
    for monitor in monitors.values():
        alarm = monitor.alarms[0]
        assert alarm.signal in ("sense.position", "sense.velocity")
        assert alarm.began < 10 * CONFIG.window
        assert alarm.statistic > alarm.threshold
        assert alarm.scale == nominal().deviation[alarm.signal][0]


def test_shadow_and_twin_agree() -> None:
    together, monitors = start(mass=1.05 * MASS, seed=2)
    together.run(300)
    twin, shadow = monitors["twin"].history, monitors["shadow"].history
    np.testing.assert_allclose([w.residual for w in shadow], [w.residual for w in twin], atol=1e-12)
    assert len(twin) == 29


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("field", "bias", "signal"),
    [("joint_position_measured", 0.1, "position"), ("joint_velocity_estimated", 0.5, "velocity")],
)
def test_sensor_jump_raises_its_alarm(field: str, bias: float, signal: str) -> None:
    together, monitors = start(calibration=nominal())
    together.run(305)
    assert not monitors["twin"].alarms
    together.line.falsify = telling(field, lambda value: value + bias)
    together.run(20)
    for monitor in monitors.values():
        assert monitor.alarms[0].signal == f"sense.{signal}"
        assert monitor.alarms[0].began == pytest.approx(310 * PERIOD, abs=2 * PERIOD)


@pytest.mark.parametrize("mode", ["twin", "shadow"])
def test_wrong_reported_actuation_raises_alarm(mode: str) -> None:
    together, monitors = start(calibration=nominal())
    together.run(100)
    # In the messages of an iiwa, a commanded torque has the opposite sign.
    together.line.falsify = telling("joint_torque_commanded", lambda torque: torque - 0.01)
    together.run(100)
    alarm = monitors[mode].alarms[0]
    assert (alarm.signal, alarm.entry) == ("act.torque", 0)
    # In the shadow the other loop acts: it commands less than is reported.
    assert alarm.residual == pytest.approx(0.01, abs=0.002)


@pytest.mark.slow
def test_missing_nominal_bias_raises_alarm() -> None:
    biased = replace(nominal(), mean=nominal().mean | {"act.torque": [0.01]})
    together, monitors = start(calibration=biased)
    together.line.falsify = telling("joint_torque_commanded", lambda torque: torque - 0.01)
    together.run(200)
    assert not monitors["twin"].alarms
    together.line.falsify = lambda channel, data: data
    together.run(200)
    assert monitors["twin"].alarms[0].signal == "act.torque"


@pytest.mark.slow
def test_alarm_ends_after_the_fault() -> None:
    together, monitors = start(calibration=nominal())
    monitor = monitors["twin"]
    together.run(100)
    together.line.falsify = telling("joint_torque_commanded", lambda torque: torque - 0.01)
    together.run(100)
    assert [alarm.signal for alarm in monitor.active()] == ["act.torque"]
    together.line.falsify = lambda channel, data: data
    together.run(1000)
    assert not monitor.active()
    (alarm,) = monitor.alarms
    # From twice the threshold to half of it, by the allowance in each window.
    decay = 1.5 * alarm.threshold / CONFIG.allowance * CONFIG.window
    assert alarm.ended == pytest.approx(200 * PERIOD + decay, abs=2 * CONFIG.window)
    assert f"until {alarm.ended:.3f} s" in str(alarm)


@pytest.mark.slow
def test_nominal_hour_raises_no_alarm() -> None:
    robot = machine(SCENARIO, noise=NOISE, seed=3)
    together = Together(SCENARIO, robot)
    monitor = ResidualMonitor(together.driver, "twin", config=CONFIG, calibration=nominal(), worker=False)
    together.run(round(3600.0 / PERIOD))
    assert not monitor.alarms
    assert len(monitor.history) == 3599
    assert monitor.skipped == monitor.failed == 0


def test_tolerance_alone_is_a_scale() -> None:
    tolerance = {"sense.position": 1e-3, "sense.velocity": 1e-3, "act.torque": 1e-3}
    together = Together(SCENARIO, machine(SCENARIO, values={PAYLOAD: 1.05 * MASS}))
    config = replace(CONFIG, tolerance=tolerance)
    monitor = ResidualMonitor(together.driver, "twin", config=config, worker=False)
    together.run(100)
    assert (monitor.alarms[0].signal, monitor.alarms[0].scale) == ("sense.velocity", 1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mean": {"sense.speed": [0.0]}}, "the calibration has a mean of sense.speed"),
        ({"horizon": 20}, "of windows of 20 periods"),
    ],
)
def test_calibration_of_other_windows_is_rejected(change: dict[str, object], message: str) -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    other = replace(nominal(), **change)
    with pytest.raises(NominalResidualsError, match=message):
        ResidualMonitor(together.driver, "twin", config=CONFIG, calibration=other, worker=False)


@pytest.mark.parametrize(
    ("tolerance", "message"),
    [
        ({"sense.speed": 1.0}, "no residual of 'sense.speed'; there are: sense.position, sense.velocity, act.torque"),
        ({"sense.position": [1.0, 2.0]}, "residual of sense.position has 1 entries"),
        ({"sense.position": 1.0}, "the residual of sense.velocity has no scale: calibrate it"),
    ],
)
def test_wrong_tolerance_is_rejected(tolerance: dict[str, object], message: str) -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    with pytest.raises(ValueError, match=message):
        config = replace(CONFIG, tolerance=tolerance)
        ResidualMonitor(together.driver, "twin", config=config, worker=False)


PLACES = {"sense.a": slice(0, 2), "act.b": slice(2, 3)}


def of(table: np.ndarray) -> NominalResiduals:
    return nominal_residuals(table, PLACES, horizon=10, period=1e-3)


def noise(windows: int) -> np.ndarray:
    return np.random.default_rng(3).normal([1.0, 0.0, -2.0], [0.1, 1.0, 3.0], (windows, 3))


def test_calibration_finds_mean_and_deviation() -> None:
    found = of(noise(20_000))
    np.testing.assert_allclose([*found.mean["sense.a"], *found.mean["act.b"]], [1.0, 0.0, -2.0], atol=0.06)
    # The largest of 200 batches' deviations, which scatter by 7 % each.
    ratios = np.array([*found.deviation["sense.a"], *found.deviation["act.b"]]) / [0.1, 1.0, 3.0]
    assert ((ratios > 1.05) & (ratios < 1.4)).all()
    assert (found.windows, found.horizon, found.period) == (20_000, 10, 1e-3)


def test_deviation_is_that_of_the_noisiest_time() -> None:
    table = noise(2000)
    table[500:600, 0] = 1.0 + 5.0 * (table[500:600, 0] - 1.0)
    noisiest = table[500:600, 0].std(ddof=1)
    assert noisiest <= of(table).deviation["sense.a"][0] < 1.5 * noisiest


def test_lasting_offset_widens_the_deviation() -> None:
    table = np.zeros((1000, 3))
    table[300:400] = 1.0
    found = of(table)
    assert found.mean["act.b"] == pytest.approx([0.1])
    assert found.deviation["act.b"] == pytest.approx([4 * 0.9])


def correlated(rho: float, windows: int) -> np.ndarray:
    random = np.random.default_rng(4)
    table = random.standard_normal((windows, 3))
    for before, row in pairwise(table):
        row *= (1.0 - rho**2) ** 0.5
        row += rho * before
    return table


@pytest.mark.slow_cases
@pytest.mark.parametrize(("rho", "windows"), [(0.8, 250), (0.9, 1000)])
def test_correlated_residuals_raise_no_alarm(rho: float, windows: int) -> None:
    table = correlated(rho, windows + 20_000)
    config = ResidualConfig(false_alarm_interval=3.6e6)
    detector = AlarmDetector(PLACES, config, of(table[:windows]))
    assert not [alarm for row in table[windows:] for alarm in detector.update(ResidualWindow(0.0, row))]


def test_deviation_counts_correlated_residuals_as_fewer() -> None:
    # For a correlation rho^k, sums of many values have (1 + rho) / (1 - rho) times the variance that independent ones
    # have. Sums of 64 show 0.93 of the ratio; two errors of the estimate and the noisiest batch come on top.
    ratio = (1.9 / 0.1) ** 0.5
    found = of(correlated(0.9, 2000)).deviation
    assert all(0.9 * ratio < value < 1.8 * ratio for value in (*found["sense.a"], *found["act.b"]))


def test_independent_residuals_keep_their_deviation() -> None:
    table = noise(500)
    found = of(table).deviation
    batches = table.reshape(5, 100, 3).std(axis=1, ddof=1).max(axis=0)
    np.testing.assert_allclose([*found["sense.a"], *found["act.b"]], batches)


def test_missing_windows_do_not_count() -> None:
    table = noise(2000)
    table[::2, 1] = np.nan
    table[400:600, 1] = np.nan
    shown = table[~np.isnan(table[:, 1]), 1]
    found = of(table)
    assert found.mean["sense.a"][1] == pytest.approx(shown.mean())
    assert 0.9 < found.deviation["sense.a"][1] < 1.5


def test_single_windows_of_a_batch_count() -> None:
    table = np.full((1000, 3), np.nan)
    table[50::100] = 0.0
    table[350] = 1.0
    found = of(table)
    assert found.mean["act.b"] == pytest.approx([0.1])
    assert found.deviation["act.b"] == pytest.approx([4 * 0.9])


def test_missing_signal_has_no_deviation() -> None:
    table = noise(400)
    table[:, 2] = np.nan
    assert of(table).deviation["act.b"] == [0.0]


def test_short_run_is_rejected() -> None:
    with pytest.raises(NominalResidualsError, match="at least 200 windows, not 150"):
        of(noise(150))


def test_calibration_file_round_trip(tmp_path: Path) -> None:
    found = of(noise(300))
    found.save(tmp_path / "nominal.json")
    assert NominalResiduals.load(tmp_path / "nominal.json") == found


@pytest.mark.parametrize("text", ["", "{", "[]", '{"mean": {}}', '{"other": 1}'])
def test_file_without_calibration_is_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "nominal.json").write_text(text)
    with pytest.raises(NominalResidualsError, match="not a calibration"):
        NominalResiduals.load(tmp_path / "nominal.json")


@pytest.mark.parametrize("mean", [[], None, {"sense.level": [float("nan")]}, {"sense.level": ["a"]}])
def test_calibration_without_numbers_is_rejected(tmp_path: Path, mean: object) -> None:
    content = {"mean": mean, "deviation": {"sense.level": [1.0]}, "windows": 200, "horizon": 10, "period": 0.001}
    (tmp_path / "nominal.json").write_text(json.dumps(content))
    with pytest.raises(NominalResidualsError, match="not a calibration"):
        NominalResiduals.load(tmp_path / "nominal.json")


def test_cusum_matches_its_definition() -> None:
    random = np.random.default_rng(1)
    values = random.normal(0.3, 1.0, 200)
    cusum = Cusum(1, threshold=1e9, allowance=0.5)
    upper = lower = highest = 0.0
    for z in values:
        upper, lower = max(0.0, upper + z - 0.5), max(0.0, lower - z - 0.5)
        assert cusum.update(np.array([z])) == pytest.approx(max(upper, lower))
        highest = max(highest, upper, lower)
    assert highest > 2.0


def test_cusum_ignores_missing_values() -> None:
    cusum = Cusum(3, threshold=10.0, allowance=0.5)
    cusum.update(np.array([2.0, -2.0, np.nan]))
    np.testing.assert_array_equal(cusum.update(np.array([np.nan, -2.0, np.nan])), [1.5, 3.0, 0.0])


def test_cusum_is_limited_to_twice_the_threshold() -> None:
    cusum = Cusum(2, threshold=10.0, allowance=0.5)
    np.testing.assert_array_equal(cusum.update(np.array([1e6, -1e6])), [20.0, 20.0])


@pytest.mark.parametrize(("threshold", "allowance"), [(3.0, 0.5), (4.0, 0.25)])
def test_run_length_matches_simulated_runs(threshold: float, allowance: float) -> None:
    random = np.random.default_rng(2)
    runs = 4000
    upper, lower, alive = np.zeros(runs), np.zeros(runs), np.ones(runs, dtype=bool)
    lengths = np.zeros(runs)
    while alive.any():
        z = random.standard_normal(runs)
        upper, lower = np.maximum(0.0, upper + z - allowance), np.maximum(0.0, lower - z - allowance)
        lengths += alive
        alive &= np.maximum(upper, lower) <= threshold
    # The mean of 4000 exponential lengths is known to 1.6 %; Siegmund's formula is good to a few percent.
    assert run_length(threshold, allowance) == pytest.approx(lengths.mean(), rel=0.1)


@pytest.mark.parametrize("length", [1.1 * run_length(0.0, 0.5), 10.0, 1e4, 1e12])
def test_threshold_inverts_run_length(length: float) -> None:
    assert run_length(threshold_for(length, 0.5), 0.5) == pytest.approx(length, rel=1e-6)


def test_short_run_length_needs_no_threshold() -> None:
    assert threshold_for(1.0, 0.5) == 0.0

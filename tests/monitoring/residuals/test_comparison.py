"""Comparison of prediction and measurement: a perfect model with exact sensors has no residuals."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest

from tests.monitoring.residuals.line import Together
from tests.monitoring.residuals.pendulum import MASS, PAYLOAD, PERIOD, DrivenPendulum, machine
from vtbdrake.control.runtime import Runtime
from vtbdrake.monitoring.residuals import ResidualConfig, ResidualMonitor
from vtbdrake.monitoring.residuals.comparison import ResidualGenerator, RowLayout
from vtbdrake.monitoring.residuals.monitor import Sampler
from vtbdrake.testbed.prediction import Predictor

CONFIG = ResidualConfig(period=PERIOD, settle=0)
EXACT = [
    DrivenPendulum(),
    DrivenPendulum(time_step=PERIOD / 2),
    DrivenPendulum(sampled=True),
    DrivenPendulum(time_step=0.0),
    DrivenPendulum(time_step=0.0, sampled=True),
]


def monitored(runtime: Runtime | None, mode: str, config: ResidualConfig = CONFIG) -> ResidualMonitor:
    assert runtime is not None
    return ResidualMonitor(runtime, mode, config=config, learn=True, worker=False)


def residuals(monitor: ResidualMonitor) -> np.ndarray:
    monitor.close()
    return np.array([window.residual for window in monitor.history])


def twin(scenario: DrivenPendulum, config: ResidualConfig = CONFIG, cycles: int = 205, **options: Any) -> np.ndarray:
    together = Together(scenario, machine(scenario, **options))
    while not together.line.sensed["position"].count:
        together.line.poll()
    monitor = monitored(together.driver, "twin", config)
    together.run(cycles)
    found = residuals(monitor)
    assert monitor.skipped == monitor.failed == 0
    return found


@pytest.mark.parametrize("scenario", EXACT, ids=str)
def test_perfect_twin_has_no_residuals(scenario: DrivenPendulum) -> None:
    found = twin(scenario)
    assert found.shape == (20, 3)
    np.testing.assert_allclose(found, 0.0, atol=1e-12)


@pytest.mark.slow_cases
@pytest.mark.parametrize("scenario", EXACT, ids=str)
def test_perfect_shadow_has_no_residuals(scenario: DrivenPendulum) -> None:
    together = Together(scenario, machine(scenario), shadowing=scenario)
    monitor = monitored(together.shadow, "shadow")
    together.run(205)
    assert residuals(monitor).shape == (20, 3)
    np.testing.assert_allclose(residuals(monitor), 0.0, atol=1e-12)
    assert together.line.machine.status().accepted["torque"] == 204  # by the other loop


@pytest.mark.slow_cases
@pytest.mark.parametrize("horizon", [1, 3, 50])
def test_any_horizon_is_aligned(horizon: int) -> None:
    found = twin(DrivenPendulum(sampled=True), replace(CONFIG, horizon=horizon))
    assert len(found) == 203 // horizon
    np.testing.assert_allclose(found, 0.0, atol=1e-12)


@pytest.mark.parametrize("options", [{"act_latency": 2 * PERIOD}, {"sense_latency": 2 * PERIOD}])
def test_declared_delay_is_aligned(options: dict[str, float]) -> None:
    found = twin(DrivenPendulum(), replace(CONFIG, delay=2), **options)
    np.testing.assert_allclose(found, 0.0, atol=1e-12)
    assert np.abs(twin(DrivenPendulum(), **options)[:, 1]).max() > 1e-3


def test_other_payload_matches_equation_of_motion() -> None:
    heavier = 1.05 * MASS
    scenario = DrivenPendulum()
    together = Together(scenario, machine(scenario, values={PAYLOAD: heavier}))
    monitor = monitored(together.driver, "twin", replace(CONFIG, horizon=2))
    read = together.driver.target.reader("dps.seen")
    seen = []
    for _ in range(201):
        together.run(1)
        seen.append(read(together.driver.context))
    together.run(1)
    # m l^2 q'' = u - m g l sin q - d v, with l = 0.5 m, d = 0.1 N m s/rad, and the mass of the arm itself.
    states = np.array(seen)
    q, v = states[:-1].T
    torque = np.array([2.0 * np.sin(1.5 * k * PERIOD) for k in range(200)]) - 0.5 * v
    acceleration = {
        load: (torque - (0.5 + load) * 9.81 * 0.5 * np.sin(q) - 0.1 * v) / ((0.5 + load) * 0.25)
        for load in (MASS, heavier)
    }
    more = (acceleration[heavier] - acceleration[MASS]).reshape(100, 2)
    expected = PERIOD * np.cumsum(more, axis=1).mean(axis=1)
    found = residuals(monitor)[:, 1]
    assert np.abs(expected).max() > 5e-3
    np.testing.assert_allclose(found, expected, atol=0.15 * np.abs(expected).max())


def test_lost_messages_cost_one_window() -> None:
    scenario = DrivenPendulum()
    together = Together(scenario, machine(scenario))
    monitor = monitored(together.driver, "twin")
    for k in range(30):
        together.run(10)
        if k == 12:
            # In the middle of a window, the loop misses a cycle.
            together.run(3)
            together.line.machine.advance()
            together.run(6)
    np.testing.assert_allclose(residuals(monitor), 0.0, atol=1e-12)
    assert monitor.skipped == 1


def test_prediction_begins_anew_after_gap() -> None:
    scenario = DrivenPendulum(sampled=True)
    together = Together(scenario, machine(scenario))
    monitor = monitored(together.driver, "twin", replace(CONFIG, settle=2))
    together.run(102)
    # Longer than a window, and shorter than AHEAD: in this simulation, which runs faster than real time, a sample
    # that is further ahead is rejected.
    for _ in range(13):
        together.line.machine.advance()
    together.run(104)
    found = residuals(monitor)
    # Ten windows before the gap less two that settle; the gap costs two, and after it two settle again.
    assert not together.line.sensed["position"].rejected
    assert monitor.skipped == 2
    assert len(monitor.history) == 8 + 7
    np.testing.assert_allclose(found, 0.0, atol=1e-12)


def rows_of(cycles: int) -> tuple[ResidualGenerator, RowLayout, np.ndarray]:
    """Return a comparison of a twin, and layout and rows of a heavier machine."""
    scenario = DrivenPendulum()
    runtime = Together(scenario, machine(scenario, values={PAYLOAD: 2.0 * MASS})).driver
    predictor = Predictor(scenario, period=PERIOD, values={})
    layout = RowLayout(predictor.interface, ("torque",), {"dps.seen[0]": 1, "dps.seen": 2})
    sampler = Sampler(runtime, layout, predictor.estimates, mode="twin", horizon=CONFIG.horizon)
    rows = layout.empty(cycles)
    for row in rows:
        assert sampler.fill(row[None], runtime.cycle()) == 1
    return ResidualGenerator(predictor, layout, CONFIG, mode="twin"), layout, rows


def test_rows_arrive_in_any_portions() -> None:
    comparison, layout, rows = rows_of(102)
    expected = np.array([window.residual for window in comparison.add(rows)])
    assert np.abs(expected).max() > 1e-2
    again, *_ = rows_of(1)
    found = []
    for row in rows:
        # The velocity comes by itself, and then both again.
        early, late = row.copy(), layout.empty(1)[0]
        velocity = layout.sense["velocity"]
        late[:2], late[velocity] = row[:2], row[velocity]
        early[velocity] = np.nan
        found += again.add(early[None]) + again.add(np.array([late, row]))
    assert again.skipped == 0
    np.testing.assert_array_equal([window.residual for window in found], expected)


def test_last_actuation_of_a_period_acts() -> None:
    comparison, layout, rows = rows_of(102)
    expected = np.array([window.residual for window in comparison.add(rows)])
    again, *_ = rows_of(1)
    first = rows.copy()
    first[:, layout.actuation["torque"]] += 5.0
    found = again.add(np.stack((first, rows), axis=1).reshape(-1, rows.shape[1]))
    np.testing.assert_array_equal([window.residual for window in found], expected)


def test_failed_prediction_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    step, steps = Predictor.step, count()

    def fail_once(predictor: Predictor, actuation: np.ndarray | None) -> np.ndarray:
        if next(steps) == 35:
            raise RuntimeError("the step size is too small")
        return step(predictor, actuation)

    monkeypatch.setattr(Predictor, "step", fail_once)
    scenario = DrivenPendulum()
    together = Together(scenario, machine(scenario))
    monitor = monitored(together.driver, "twin")
    together.run(110)
    np.testing.assert_allclose(residuals(monitor), 0.0, atol=1e-12)
    assert (monitor.failed, len(monitor.history)) == (1, 9)
    assert re.fullmatch(r"RuntimeError: the step size is too small \(test_comparison\.py, line \d+\)", monitor.error)

"""Alarms: what is found, when, and what is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from drake import lcmt_iiwa_status

from tests.monitoring.residuals.line import Together
from tests.monitoring.residuals.pendulum import MASS, PAYLOAD, PERIOD, DrivenPendulum, machine
from vtbdrake.monitoring.residuals import Calibration, CalibrationError, ResidualConfig, ResidualMonitor

NOISE = {"position": 1e-4, "velocity": 5e-3}
CONFIG = ResidualConfig(period=PERIOD, settle=0, tolerance={"act.torque": 1e-3})
SCENARIO = DrivenPendulum(sampled=True)


def start(
    *, mass: float = MASS, seed: int = 1, calibration: Calibration | None = None, config: ResidualConfig = CONFIG
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
def nominal() -> Calibration:
    together, monitors = start()
    together.run(4000)
    return monitors["twin"].calibrate()


def telling(field: str, change: Callable[[float], float]) -> Callable[[str, bytes], bytes]:
    """Changes an entry of what the machine tells."""

    def falsify(channel: str, data: bytes) -> bytes:
        message = lcmt_iiwa_status.decode(data)
        setattr(message, field, [change(value) for value in getattr(message, field)])
        return bytes(message.encode())

    return falsify


def test_payload_that_is_5_percent_heavier_is_found_in_shadow_and_twin() -> None:
    together, monitors = start(mass=1.05 * MASS, seed=2, calibration=nominal())
    together.run(500)
    for monitor in monitors.values():
        alarm = monitor.alarms[0]
        assert alarm.signal in ("sense.position", "sense.velocity")
        assert alarm.began < 10 * CONFIG.window
        assert alarm.statistic > alarm.threshold
        assert alarm.scale == nominal().deviation[alarm.signal][0]


def test_shadow_and_twin_of_one_machine_see_the_same() -> None:
    together, monitors = start(mass=1.05 * MASS, seed=2, calibration=nominal())
    together.run(300)
    twin, shadow = monitors["twin"].history, monitors["shadow"].history
    np.testing.assert_allclose([w.residual for w in shadow], [w.residual for w in twin], atol=1e-12)
    assert len(twin) == 29


@pytest.mark.parametrize(
    ("field", "bias", "signal"),
    [("joint_position_measured", 0.1, "position"), ("joint_velocity_estimated", 0.5, "velocity")],
)
def test_sensor_that_jumps_is_named_at_once(field: str, bias: float, signal: str) -> None:
    together, monitors = start(calibration=nominal())
    together.run(305)
    assert not monitors["twin"].alarms
    together.line.falsify = telling(field, lambda value: value + bias)
    together.run(20)
    for monitor in monitors.values():
        assert monitor.alarms[0].signal == f"sense.{signal}"
        assert monitor.alarms[0].began == pytest.approx(310 * PERIOD, abs=2 * PERIOD)


@pytest.mark.parametrize("mode", ["twin", "shadow"])
def test_wrong_report_of_the_command_is_found(mode: str) -> None:
    together, monitors = start(calibration=nominal())
    together.run(100)
    together.line.falsify = telling("joint_torque_commanded", lambda torque: torque + 0.01)
    together.run(100)
    alarm = monitors[mode].alarms[0]
    assert (alarm.signal, alarm.entry) == ("act.torque", 0)
    # In the shadow the other loop is what acts: it commands less than is told.
    assert alarm.residual == pytest.approx(0.01, abs=0.002)


def test_bias_that_is_nominal_is_no_alarm_and_its_absence_is() -> None:
    biased = replace(nominal(), mean=nominal().mean | {"act.torque": [0.01]})
    together, monitors = start(calibration=biased)
    together.line.falsify = telling("joint_torque_commanded", lambda torque: torque + 0.01)
    together.run(200)
    assert not monitors["twin"].alarms
    together.line.falsify = lambda channel, data: data
    together.run(200)
    assert monitors["twin"].alarms[0].signal == "act.torque"


def test_alarm_ends_when_the_fault_has_gone() -> None:
    together, monitors = start(calibration=nominal())
    monitor = monitors["twin"]
    together.run(100)
    together.line.falsify = telling("joint_torque_commanded", lambda torque: torque + 0.01)
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


def test_an_hour_of_nominal_operation_raises_no_alarm() -> None:
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
def test_calibration_of_something_else_is_refused(change: dict[str, object], message: str) -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    other = replace(nominal(), **change)
    with pytest.raises(CalibrationError, match=message):
        ResidualMonitor(together.driver, "twin", config=CONFIG, calibration=other, worker=False)


@pytest.mark.parametrize(
    ("tolerance", "message"),
    [
        ({"sense.speed": 1.0}, "no residual of 'sense.speed'; there are: sense.position, sense.velocity, act.torque"),
        ({"sense.position": [1.0, 2.0]}, "residual of sense.position has 1 entries"),
        ({"sense.position": 1.0}, "the residual of sense.velocity has no scale: calibrate it"),
    ],
)
def test_tolerance_that_does_not_fit_is_refused(tolerance: dict[str, object], message: str) -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    with pytest.raises(ValueError, match=message):
        config = replace(CONFIG, tolerance=tolerance)
        ResidualMonitor(together.driver, "twin", config=config, worker=False)

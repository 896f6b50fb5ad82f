"""Residuals beside a loop, computed by a worker process."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, System

from tests.control.scripted import ServoScenario
from tests.monitoring.residuals.line import Ear, Line, Together, loop
from tests.monitoring.residuals.pendulum import MASS, PAYLOAD, PERIOD, DrivenPendulum, Rhythm, machine
from vtbdrake.deployment import Deployment
from vtbdrake.monitoring.residuals import ResidualConfig, ResidualMonitor
from vtbdrake.monitoring.residuals.alarms import NominalResidualsError
from vtbdrake.state import Quantity
from vtbdrake.testbed import DpsAlone, VirtualTestbedBuilder

TOLERANCE = {"sense.position": 1e-4, "sense.velocity": 1e-3, "act.torque": 1e-3}
CONFIG = ResidualConfig(period=PERIOD, tolerance=TOLERANCE)
SCENARIO = DrivenPendulum()
PATIENCE = 60.0  # s


def wait_for_windows(monitor: ResidualMonitor, together: Together, count: int) -> None:
    """Run cycles until ``count`` windows have come back."""
    end = time.monotonic() + PATIENCE
    while len(monitor.history) < count:
        assert time.monotonic() < end, "no residuals come back"
        together.run(10)


def test_worker_process_gives_equal_results() -> None:
    together = Together(SCENARIO, machine(SCENARIO, values={PAYLOAD: 1.05 * MASS}))
    own = ResidualMonitor(together.driver, "twin", config=CONFIG, worker=False)
    with ResidualMonitor(together.driver, "twin", config=CONFIG) as other:
        assert other.running
        together.run(305)
    own.close()
    assert not other.running
    assert own.alarms
    assert list(other.alarms) == list(own.alarms)
    assert [w.time for w in other.history] == [w.time for w in own.history]
    np.testing.assert_array_equal([w.residual for w in other.history], [w.residual for w in own.history])


@pytest.mark.slow
def test_newest_residuals_are_available_while_running() -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    with ResidualMonitor(together.driver, "twin", config=CONFIG) as monitor:
        assert monitor.newest is None
        wait_for_windows(monitor, together, 10)
        assert monitor.newest is not None
        assert {name: value.shape for name, value in monitor.newest.items()} == dict.fromkeys(TOLERANCE, (1,))


def test_arrays_show_the_alarm_statistic() -> None:
    together = Together(SCENARIO, machine(SCENARIO, values={PAYLOAD: 1.05 * MASS}))
    with ResidualMonitor(together.driver, "twin", config=CONFIG, worker=False) as monitor:
        assert {name: value.shape for name, value in monitor.arrays().items()} == {
            "time": (0,),
            **dict.fromkeys(TOLERANCE, (0, 1)),
        }
        together.run(305)
    alarm, table = monitor.alarms[0], monitor.arrays()
    entry = monitor.places[alarm.signal].start + alarm.entry
    begin = int(np.argmax(table["statistic"][:, entry] > alarm.threshold))
    assert table["statistic"].shape == (len(monitor.history), 3)
    assert table["statistic"][begin, entry] == alarm.statistic
    assert (table["time"][begin], table[alarm.signal][begin, alarm.entry]) == (alarm.began, alarm.residual)


def test_killed_worker_process_is_harmless(caplog: pytest.LogCaptureFixture) -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    with ResidualMonitor(together.driver, "twin", config=CONFIG) as monitor:
        assert monitor.pid is not None
        together.run(100)
        os.kill(monitor.pid, signal.SIGKILL)
        os.waitid(os.P_PID, monitor.pid, os.WEXITED | os.WNOWAIT)
        together.run(200)
        assert together.driver.cycles == 300
        assert not monitor.running
        assert monitor.dropped > 0
        assert "residuals" in caplog.text
        assert "is lost" in caplog.text


@pytest.mark.slow
def test_stopped_worker_process_skips_windows() -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    with ResidualMonitor(together.driver, "twin", config=CONFIG) as monitor:
        assert monitor.pid is not None
        wait_for_windows(monitor, together, 10)
        os.kill(monitor.pid, signal.SIGSTOP)
        together.run(2000)
        os.kill(monitor.pid, signal.SIGCONT)
        before = monitor.history[-1].time
        wait_for_windows(monitor, together, len(monitor.history) + 10)
        assert 50 <= monitor.skipped <= together.driver.cycles // CONFIG.horizon - len(monitor.history)
        with pytest.raises(NominalResidualsError, match="skipped, because the worker process is too slow"):
            monitor.calibrate()
        assert np.diff([window.time for window in monitor.history]).max() > 50 * CONFIG.window
        assert monitor.history[-1].time > before
        assert not monitor.alarms


@pytest.mark.slow
def test_skipped_windows_are_reported_while_running() -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    with ResidualMonitor(together.driver, "twin", config=CONFIG) as monitor:
        together.driver.unwatch(monitor)
        together.driver.watch(lambda cycle: monitor(cycle) if cycle.number % 2 else None)
        end = time.monotonic() + PATIENCE
        while monitor.skipped < 20:
            assert time.monotonic() < end, "skipped windows are not reported"
            together.run(10)
        assert not monitor.history
        with pytest.raises(
            NominalResidualsError, match=r"not 0: run longer; \d+ windows were skipped, because samples"
        ):
            monitor.calibrate()


class FailingRhythm(Rhythm):
    """A `Rhythm` that raises from 3 s on."""

    def _update(self, context: Context, discrete: Any) -> None:
        if context.get_time() > 3.0:
            raise ZeroDivisionError("too late")
        super()._update(context, discrete)


class FailingPendulum(DrivenPendulum):
    """A `DrivenPendulum` whose DPS fails."""

    def make_dps(self) -> System:
        return FailingRhythm(PERIOD)


def test_failed_dps_has_no_residuals() -> None:
    scenario = FailingPendulum()
    driver = loop(DpsAlone(scenario), Line(scenario, machine(SCENARIO)), PERIOD)
    monitor = ResidualMonitor(driver, "twin", config=replace(CONFIG, settle=0), learn=True, worker=False)
    driver.run(cycles=300)
    assert monitor.history[-1].time <= 3.2
    assert monitor.skipped > 20
    with pytest.raises(NominalResidualsError, match="because the DPS raised ZeroDivisionError: too late"):
        monitor.calibrate()


class OwnClock(Line):
    """A machine whose every seventh sample comes too late for its cycle, and together with the next one."""

    def poll(self, timeout: float = 0.0) -> int:
        polls = getattr(self, "polls", 0)
        self.polls = polls + 1
        if polls % 7 == 5:
            return 0
        return super().poll() + (super().poll() if polls % 7 == 6 else 0)


@pytest.mark.slow
def test_machine_with_its_own_clock_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    driver = loop(DpsAlone(SCENARIO), OwnClock(SCENARIO, machine(SCENARIO)), PERIOD)
    monitor = ResidualMonitor(driver, "twin", config=CONFIG, worker=False)
    driver.run(cycles=1500)
    assert monitor.skipped > 50
    assert caplog.text.count("because samples are missing: the clock begins the cycles") == 1
    caplog.clear()
    whole = Together(SCENARIO, machine(SCENARIO))
    quiet = ResidualMonitor(whole.driver, "twin", config=CONFIG, worker=False)
    whole.run(1500)
    assert len(quiet.history) > 100 and not caplog.text


def test_simulated_sensors_are_not_compared() -> None:
    together = Together(SCENARIO, machine(SCENARIO), shadowing=SCENARIO)
    assert together.shadow is not None
    config = replace(CONFIG, settle=0)
    monitor = ResidualMonitor(together.shadow, "shadow", config=config, worker=False)
    together.run(105)
    together.shadow.switch(sense="sim")
    together.run(95)
    together.shadow.switch(sense="real")
    together.run(105)
    monitor.close()
    times = np.array([window.time for window in monitor.history]) / PERIOD
    np.testing.assert_allclose(times, [*range(11, 92, 10), *range(211, 302, 10)])
    np.testing.assert_allclose([window.residual for window in monitor.history], 0.0, atol=1e-12)


def test_idle_dps_is_not_compared() -> None:
    line = Line(SCENARIO, machine(SCENARIO))
    runtime = loop(DpsAlone(SCENARIO), line, PERIOD, begin=False)
    monitor = ResidualMonitor(runtime, "twin", config=CONFIG, worker=False)
    for _ in range(200):
        runtime.cycle()
    monitor.close()
    assert not monitor.history


class Moody(Rhythm):
    """A rhythm that raises while its parameter is 0."""

    def __init__(self) -> None:
        super().__init__(PERIOD)
        self._settings = self.declare_parameters(mood=Quantity(1.0))
        self.DeclareVectorOutputPort("wish", 1, self._wish)

    def _wish(self, context: Context, output: BasicVector) -> None:
        if not self._settings.view(context).mood:
            raise RuntimeError("not in the mood")
        output.SetFromVector(context.get_discrete_state(0).value())


@dataclass
class MoodyPendulum(DrivenPendulum):
    believes: bool = False

    def make_dps(self) -> System:
        builder = DiagramBuilder()
        rhythm = builder.AddNamedSystem("rhythm", Moody())
        for name in ("position", "velocity"):
            builder.ExportInput(rhythm.GetInputPort(name), name)
        builder.ExportOutput(rhythm.GetOutputPort("wish"), "torque")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        builder.believe("sim.sys.Pendulum.theta.position", of=["dps.rhythm.seen[0]"])
        builder.believe("sim.sys.Pendulum.theta.velocity", of=["dps.rhythm.seen[1]"])


def test_exceptions_of_the_dps_skip_windows(caplog: pytest.LogCaptureFixture) -> None:
    together = Together(SCENARIO, machine(SCENARIO), shadowing=MoodyPendulum())
    shadow = together.shadow
    assert shadow is not None
    monitor = ResidualMonitor(shadow, "shadow", config=CONFIG, worker=False)
    together.run(200)
    before = len(monitor.history)
    shadow.write({"dps.rhythm.mood": 0.0})
    together.run(20)
    shadow.write({"dps.rhythm.mood": 1.0})
    together.run(200)
    assert caplog.text.count("no residuals, because the DPS raised RuntimeError: not in the mood") == 1
    assert len(monitor.history) - before >= 18 and monitor.skipped >= 2
    assert "sense.position" not in [alarm.signal for alarm in monitor.alarms]


class HalfTimeless(Line):
    """A bridge on which only the position has a time of its own."""

    def poll(self, timeout: float = 0.0) -> int:
        count = super().poll(timeout)
        self.sensed["velocity"].sent = float("nan")
        return count


def test_signal_without_time_joins_newest_sample() -> None:
    def residuals(kind: type[Line]) -> np.ndarray:
        line = kind(SCENARIO, machine(SCENARIO, values={PAYLOAD: 1.05 * MASS}))
        driver = loop(DpsAlone(SCENARIO), line, PERIOD)
        monitor = ResidualMonitor(driver, "twin", config=CONFIG, worker=False)
        driver.run(cycles=300)
        assert monitor.arrays()["time"].size > 10
        return monitor.arrays()["sense.velocity"]

    np.testing.assert_array_equal(residuals(HalfTimeless), residuals(Line))


class LateVelocity(Line):
    """A bridge on which the velocity is as old as a period when it arrives."""

    def poll(self, timeout: float = 0.0) -> int:
        count = super().poll(timeout)
        self.sensed["velocity"].sent -= PERIOD
        return count


def test_belief_is_as_new_as_the_newest_sample() -> None:
    driver = loop(DpsAlone(SCENARIO), LateVelocity(SCENARIO, machine(SCENARIO)), PERIOD)
    monitor = ResidualMonitor(driver, "twin", config=CONFIG, worker=False)
    driver.run(cycles=300)
    assert len(monitor.history) > 15
    assert np.abs(monitor.arrays()["sense.position"]).max() < 1e-12


@pytest.mark.parametrize("worker", [True, False])
def test_world_with_other_signals_is_rejected(worker: bool) -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    with pytest.raises(ValueError, match=r"ServoScenario has other signals than sense.position"):
        ResidualMonitor(together.driver, "twin", config=replace(CONFIG, scenario=ServoScenario()), worker=worker)


@pytest.mark.parametrize("worker", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_scenario_without_belief_is_rejected(worker: bool) -> None:
    scenario = DrivenPendulum(believes=False)
    together = Together(scenario, machine(scenario))
    with pytest.raises(ValueError, match=r"DrivenPendulum does not declare .* from which a prediction starts"):
        ResidualMonitor(together.driver, "twin", config=CONFIG, worker=worker)


@pytest.mark.parametrize("worker", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_unknown_variable_is_rejected(worker: bool) -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    config = replace(CONFIG, values={"sim.sys.Pendulum.arm_com.mas": 1.0})
    with pytest.raises(ValueError, match="arm_com.mass"):
        ResidualMonitor(together.driver, "twin", config=config, worker=worker)


def test_shadow_needs_reported_actuation() -> None:
    ear = Ear(SCENARIO)
    ear.reported = {}
    shadow = loop(SCENARIO.build(mode="shadow"), ear, PERIOD)
    with pytest.raises(ValueError, match="does not report torque"):
        ResidualMonitor(shadow, "shadow", config=CONFIG, worker=False)


def test_unknown_mode_is_rejected() -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    with pytest.raises(ValueError, match="must be shadow or twin, not 'real'"):
        ResidualMonitor(together.driver, "real", config=CONFIG)


def test_other_period_is_rejected() -> None:
    together = Together(SCENARIO, machine(SCENARIO))
    with pytest.raises(ValueError, match=r"0.001 s, must be the period of the loop, 0.1 s"):
        ResidualMonitor(together.driver, "twin")


def test_belief_age_must_be_multiple_of_period() -> None:
    scenario = DrivenPendulum(sampled=True)
    together = Together(scenario, machine(scenario))
    together.driver.period = 0.04
    with pytest.raises(ValueError, match=r"0.1 s, must be a multiple of the period, 0.04 s"):
        ResidualMonitor(together.driver, "twin", config=replace(CONFIG, period=0.04), worker=False)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"period": 0.0}, "ResidualConfig.period must be a finite number above 0 s, not 0.0"),
        ({"horizon": 0}, "horizon must be a whole number of at least 1 periods"),
        ({"delay": 0.5}, "delay must be a whole number of at least 0 periods, not 0.5"),
        ({"false_alarm_interval": float("nan")}, "false_alarm_interval must be a finite number above 0 s, not nan"),
        ({"tolerance": {"sense.position": -1.0}}, "tolerance of sense.position"),
    ],
)
def test_impossible_config_is_rejected(fields: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ResidualConfig(**fields)  # type: ignore[arg-type]


def test_config_is_that_of_the_deployment() -> None:
    class Own(DrivenPendulum):
        def deployment(self) -> Deployment:
            return replace(super().deployment(), residuals=CONFIG)

    own = Own()
    monitor = ResidualMonitor(loop(DpsAlone(own), Ear(own), PERIOD), "twin", worker=False)
    monitor.close()
    assert monitor.config is CONFIG

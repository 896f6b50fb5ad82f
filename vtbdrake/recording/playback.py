"""Logs as inputs: a log feeds a DPS through its real ports, or drives the simulated world in place of a DPS."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import ConstantValueSource, PassThrough, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from vtbdrake.common.settings import setting
from vtbdrake.control.bridge import Bridge, BridgeError
from vtbdrake.control.clock import Clock, SimulatedClock
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.recording.log import Log, Series
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.testbed import DpsAlone, Interface, Scenario, ScenarioError, Signal
from vtbdrake.testbed.builder import VirtualTestbedBuilder

# Times are sums with rounding errors: what is due within this time is there, in s.
_ROUNDING = 1e-9
# A command is there this share of the period before its time, for the same reason.
_EARLY = 1e-3


class LogBridge(Bridge):
    """A machine that repeats the samples of a log at their own times, and listens to no command.

    With a `ScaledClock` the loop runs at any multiple of real time; with a `SimulatedClock` as fast as it computes, as
    in `feed`::

        clock = SimulatedClock()
        bridge = LogBridge(log, dps.interface, clock)
        bridge.open()
        with Runtime(dps, bridge, period=0.02, clock=clock) as runtime:
            runtime.take_over()
            runtime.run(until=lambda: bridge.finished)

    Args:
        log: The log. It may lack signals, which then never arrive, but not all.
        interface: The signals of the DPS.
        clock: The clock of the loop.
        start: The time of the log at which `open` begins, in s; by default the time of its first sample.

    Raises:
        LogError: A signal has another size than in the log, or the log has no signal of the DPS.
    """

    def __init__(self, log: Log, interface: Interface, clock: Clock, *, start: float | None = None) -> None:
        self.interface = interface
        self.real_time = not isinstance(clock, SimulatedClock)
        self.sensed = {signal.name: ReceivedSignal() for signal in interface.sense}
        self.commands = {}
        self._series = {
            signal.name: _fitting(log, log.sense[signal.name], signal)
            for signal in interface.sense
            if signal.name in log.sense
        }
        if not self._series:
            raise LogError(
                f"{log.source} feeds no sensor signal of the DPS ({', '.join(self.sensed)}), but "
                f"{', '.join(log.sense) or 'none at all'}"
            )
        self._clock = clock
        self._start = min(float(series.times[0]) for series in self._series.values()) if start is None else start
        self._origin: float | None = None
        self._next: dict[str, int] = {}

    def open(self) -> None:
        self._origin = self._clock.now()
        # Before ``start`` nothing has arrived.
        self._next = {name: int(np.searchsorted(series.times, self._start)) for name, series in self._series.items()}

    def poll(self, timeout: float = 0.0) -> int:
        if self._origin is None:
            raise BridgeError("a bridge is polled before it is open: call its open()")
        count = self._deliver()
        if not count and timeout > 0.0 and not self.finished:
            due = min(
                float(self._series[name].times[k]) for name, k in self._next.items() if k < len(self._series[name])
            )
            now = self._clock.now()
            self._clock.wait_until(min(max(self._origin + (due - self._start), now), now + timeout))
            count = self._deliver()
        return count

    def _deliver(self) -> int:
        """Deliver what is due, and return its number."""
        assert self._origin is not None
        elapsed, count = self._clock.now() - self._origin + _ROUNDING, 0
        for name, series in self._series.items():
            first = self._next[name]
            last = self._next[name] = int(np.searchsorted(series.times, self._start + elapsed, side="right"))
            for k in range(first, last):  # Each one is counted.
                time = float(series.times[k])
                self.sensed[name].accept(series.values[k], self._origin + (time - self._start), time)
            count += last - first
        return count

    @property
    def finished(self) -> bool:
        """Return whether all samples were delivered."""
        return all(k >= len(self._series[name]) for name, k in self._next.items())

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        return ()

    @property
    def connected(self) -> bool:
        return self._origin is not None

    def close(self) -> None:
        self._origin = None


def feed(
    log: Log,
    scenario: Scenario,
    path: str | os.PathLike[str],
    *,
    period: float | None = None,
    overwrite: bool = False,
) -> ControlLog:
    """Let the DPS of a scenario run on the sensor samples of a log, and record what it does.

    Its state and its commands are new: they are what this DPS computes, not what has acted on the machine. It takes
    over when all its sensor signals have come. So a log that lacks the state of a DPS can be replayed and viewed.

    Args:
        log: The log, which has the vector signals of the DPS.
        scenario: The scenario of the DPS, which is stepped alone, as fast as it computes.
        path: Path of the file that is written.
        period: The period of the loop, in s; None: as in the scenario's deployment.
        overwrite: Whether to replace an existing file.

    Raises:
        LogError: The log lacks sensor signals of the DPS, or has some of another size.
        ValueError: The DPS cannot be recorded: it has an abstract sensor signal, for example, which no `Log` has.
        OSError: The file cannot be written, or exists.
    """
    dps, clock = DpsAlone(scenario), SimulatedClock()
    bridge = LogBridge(log, dps.interface, clock)
    bridge.open()
    period = scenario.deployment().period if period is None else period
    with Runtime(dps, bridge, period=period, clock=clock) as runtime, Recorder(runtime, path, overwrite=overwrite):
        try:
            runtime.take_over(timeout=log.end - log.start)
        except SwitchRefusedError as error:
            raise LogError(f"{log.source} does not feed the DPS of {scenario.name()}: {error}") from error
        runtime.run(until=lambda: bridge.finished)
    return read_log(path)


def _fitting(log: Log, series: Series, signal: Signal) -> Series:
    """Return the series; a LogError if it is none of the signal."""
    size = series.values.shape[1]
    if signal.size != size:
        raise LogError(
            f"{log.source} has {size} entries of {signal.name}, but the signal "
            f"{'is no vector' if signal.size is None else f'has {signal.size}'}"
        )
    return series


@dataclass
class DrivenScenario(Scenario):
    """The world of a scenario that is driven by the recorded commands of a log in place of its DPS.

    A command acts from its time on until the next one; before the first, the first. The time of the log's ``start`` is
    the time 0 of the testbed. The testbed has the interface, the world and the integrator of the scenario; its DPS
    computes nothing, so that no variable of the real DPS is there.

    Attributes:
        scenario: The scenario whose world is driven.
        log: The log; it has all vector actuator signals.
        start: The time of the log in s that is the time 0; None: the time of its first command.
        period: Commands change at multiples of it (s), where integrators stop; None: the median period of the commands.
    """

    scenario: Scenario | None = None
    log: Log | None = None
    start: float | None = None
    period: float | None = setting(None, unit="s", gt=0)

    def __post_init__(self) -> None:
        if self.scenario is not None:
            self.simulator_config = self.scenario.simulator_config
            self.pedigree = self.scenario.pedigree

    def validate(self) -> None:
        super().validate()
        for signal in self._driving.interface().act:
            if signal.is_vector and signal.name not in self._recorded.act:
                raise LogError(
                    f"{self._recorded.source} has no commands of {signal.name}, but of "
                    f"{', '.join(self._recorded.act) or 'no actuator'}"
                )

    @property
    def _driving(self) -> Scenario:
        if not isinstance(self.scenario, Scenario):
            raise ScenarioError(f"DrivenScenario.scenario is a scenario, not {self.scenario!r}")
        return self.scenario

    @property
    def _recorded(self) -> Log:
        if not isinstance(self.log, Log):
            raise ScenarioError(f"DrivenScenario.log is a Log, see read_table and read_log, not {self.log!r}")
        return self.log

    def record(self) -> dict[str, Any]:
        """Return the identity of the scenario as plain data, with the digest of the log."""
        return super().record() | {"log": None if self.log is None else self._recorded.digest}

    def interface(self) -> Interface:
        return self._driving.interface()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        self._driving.add_world(builder)
        builder.belief_rules.clear()  # They read estimates of the DPS, which is not there.

    def make_dps(self) -> System:
        """Return a system with the ports of the DPS that plays the commands; it does not look at its inputs."""
        interface, builder = self.interface(), DiagramBuilder()
        for signal in (*interface.sense, *interface.commands):
            # A port needs a system, and this one is never evaluated.
            unused = (
                PassThrough(signal.size) if signal.is_vector else PassThrough(AbstractValue.Make(signal.model_value))
            )
            builder.ExportInput(builder.AddNamedSystem(signal.name, unused).get_input_port(), signal.name)
        for signal in interface.act:
            builder.ExportOutput(self._player(builder, signal), signal.name)
        return builder.Build()

    def _player(self, builder: DiagramBuilder, signal: Signal) -> OutputPort:
        if not signal.is_vector:
            constant = ConstantValueSource(AbstractValue.Make(signal.model_value))
            return builder.AddNamedSystem(signal.name, constant).get_output_port()
        series = _fitting(self._recorded, self._recorded.act[signal.name], signal)
        start = float(series.times[0]) if self.start is None else self.start
        # Rounded, so that commands change in the same instants as what has the round period.
        period = float(f"{series.uniformity.period:.9g}") if self.period is None else self.period
        if not period > 0.0:
            raise LogError(f"{self._recorded.source} has one command of {signal.name}: give its period")
        times = series.times - start - _EARLY * period
        # A hold needs a time after its last sample.
        commands = PiecewisePolynomial.ZeroOrderHold(
            np.append(times, times[-1] + period), np.vstack([series.values, series.values[-1:]]).T
        )
        source = builder.AddNamedSystem(f"log.{signal.name}", TrajectorySource(commands))
        hold = builder.AddNamedSystem(signal.name, ZeroOrderHold(period, signal.size))
        builder.Connect(source.get_output_port(), hold.get_input_port())
        return hold.get_output_port()

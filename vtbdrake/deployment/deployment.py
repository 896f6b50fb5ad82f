"""The deployment of a scenario's DPS on its machine, and the call that starts it."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from inspect import signature
from math import ceil, inf
from typing import Any, Self

from pydrake.systems.framework import Context

from vtbdrake.common.argument_checks import as_number, suggestion
from vtbdrake.common.interrupt import termination_interrupts
from vtbdrake.control.bridge import Bridge
from vtbdrake.control.guards import ACTING_LATENCY, Guards
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import Continuity, checked_continuity
from vtbdrake.lcm.protocol import Protocol, protocol_of
from vtbdrake.monitoring.residuals import ResidualConfig
from vtbdrake.state import Snapshot
from vtbdrake.testbed import DpsAlone, Interface, Scenario, VirtualTestbed

__all__ = ["Deployment", "DeploymentError", "Runtime", "deploy"]

_log = logging.getLogger(__name__)


class DeploymentError(ValueError):
    """A deployment is missing, unsafe, or does not fit the signals of its scenario."""


def _not_blocked(bridge: Bridge) -> str | None:
    return None


def _not_released(bridge: Bridge) -> bool:
    return False


@dataclass(frozen=True, kw_only=True)
class Deployment:
    """The description of a DPS on its machine: the messages, the guards, and the clock of its cycles.

    A scenario describes its own by overriding `Scenario.deployment`::

        def deployment(self) -> Deployment:
            return Deployment(
                protocol=Protocol(
                    sense=[iiwa_status({"position": "joint_position_measured"})],
                    act=[iiwa_command({"torque": "joint_torque"})],
                ),
                guards={"fallback": {"torque": Silence()}},
                continuity={"torque": ("torque_measured", 5.0)},
            )

    Attributes:
        protocol: The LCM channels and messages of the machine. None if it has none.
        period: The period of a cycle, in seconds.
        guards: Options of `Guards`, such as ``fallback``, ``max_missed``, ``leave_time`` and ``acting_latency``.
        continuity: Actuator signal -> (sensor signal, largest difference): where actuator commands start from, see
            `Runtime`. Required for each vector actuator signal of a protocol; None lets the commands of one jump when
            it is switched to real, where no sensor signal tells what the machine does. (A limited rate or acceleration
            needs one.)
        blocked_by: Returns why the machine behind a bridge must not be commanded, or None: while its messages say that
            it is not ready, or that its own stop is pressed. Where the protocol has ``robot_mode``, the mode that the
            machine reports blocks without it; where it has ``reported``, what the machine does with the commands is
            compared without it.
        hint: What to do where commands would not continue what is measured, see `Runtime`.
        released_by: Returns whether the machine behind a bridge confirms that it does without commands, see `Runtime`;
            `acts_idle` makes such a function for a machine that reports what acts. A machine that reports its mode
            confirms it by that, too.
        pace: The sensor signal whose messages begin the cycles. If empty, the clock does.
        patience: The number of periods without such a message after which the clock begins a cycle.
        check_age: False accepts sensor values of any age and delay, for a machine whose time stops between two
            messages.
        residuals: How measurements are compared with predictions.
    """

    protocol: Protocol | None = None
    period: float = 1e-3
    guards: Mapping[str, Any] = field(default_factory=dict)
    continuity: Continuity = field(default_factory=dict)
    blocked_by: Callable[[Bridge], str | None] = _not_blocked
    hint: str = ""
    released_by: Callable[[Bridge], bool] = _not_released
    pace: str = ""
    patience: float = 3.0
    check_age: bool = True
    residuals: ResidualConfig = field(default_factory=ResidualConfig)

    def __post_init__(self) -> None:
        if not 0.0 < as_number("the period of a loop", self.period) < inf:
            raise ValueError(f"the period of a loop is positive and finite, not {self.period} s")
        if not 0.0 < as_number("the patience of a loop", self.patience) < inf:
            raise ValueError(f"the patience of a loop is a positive and finite number of periods, not {self.patience}")

    @classmethod
    def of(cls, scenario: Scenario, **changes: Any) -> Self:
        """Return the checked deployment of ``scenario``; ``changes`` replace some of its fields.

        Args:
            scenario: The scenario.
            **changes: New values of fields of its deployment, by name.

        Raises:
            DeploymentError: The DPS cannot run safely like this.
        """
        deployment, name = scenario.deployment(), type(scenario).__name__
        if not isinstance(deployment, cls):
            raise DeploymentError(f"{name}.deployment() must return a vtbdrake.Deployment, not {deployment!r}")
        deployment = replace(deployment, **changes)
        try:
            deployment.check_interface(scenario.interface())
        except ValueError as error:
            raise DeploymentError(
                f"{name} cannot run on its machine: {error}; its method deployment() describes how it runs"
            ) from error
        return deployment

    def check_interface(self, interface: Interface) -> None:
        """Check that the DPS with this interface can run safely.

        Raises:
            ValueError: The deployment or its protocol does not fit the signals, an actuator signal has no continuity,
                or a silent machine would not be noticed.
        """
        if self.protocol is not None:
            self.protocol.check_interface(interface)
        names = [signal.name for signal in interface.sense]
        if self.pace and self.pace not in names:
            raise ValueError(f"a loop is paced by a sensor signal ({', '.join(names)}), not by {self.pace!r}")
        guards = self._guards(interface)
        if self.check_age and interface.sense and all(signal.max_age == inf for signal in interface.sense):
            raise ValueError(
                "no sensor signal has a max_age, so a silent machine would not be noticed: give one to the signals "
                f"that arrive regularly ({', '.join(signal.name for signal in interface.sense)})"
            )
        continued = checked_continuity(interface, self.continuity, period=self.period)
        for signal in interface.act:
            name = signal.name
            if guards.limiters[name].needs_start and name not in continued:
                raise ValueError(
                    f"the actuator signal {name} has a limited rate or acceleration, but no measurement to start from: "
                    f"give continuity={{{name!r}: (sensor signal, largest difference)}}"
                )
            if self.protocol is not None and signal.is_vector and name not in self.continuity:
                raise ValueError(
                    f"the first actuator command {name} may be anywhere within its limits: give "
                    f"continuity={{{name!r}: (sensor signal, largest difference)}} with the sensor signal that tells "
                    f"what the machine does, or {{{name!r}: None}} if it may jump"
                )

    def _guards(self, interface: Interface) -> Guards:
        options = dict(self.guards)
        settings = list(signature(Guards).parameters)[2:]
        for name in options:
            if name not in settings:
                raise ValueError(f"the guards have no setting {name!r}{suggestion(name, settings)}")
        if self.protocol is not None:
            # Between two reports, the newest one becomes older.
            latency = as_number("acting_latency", options.get("acting_latency", ACTING_LATENCY))
            options["acting_latency"] = latency + self._report_cycles(self.protocol)
        if not self.check_age:
            interface = replace(interface, sense=[replace(signal, max_age=inf) for signal in interface.sense])
            options.pop("max_delay", None)
        return Guards(interface, self.period, **options)

    def _report_cycles(self, protocol: Protocol) -> int:
        """Return by how many cycles the reports of what acts come more rarely than in every cycle."""
        carriers = set(protocol.reported.values())
        channels = [map.channel for map in protocol.sense if not carriers.isdisjoint(map.signals)]
        periods = [protocol.periods.get(channel, self.period) for channel in channels]
        return max(0, ceil(max(periods, default=0.0) / self.period - 1e-6) - 1)

    def in_lock_step(self, signal: str, *, wait: float = 60.0) -> Self:
        """Return this deployment for a machine in lock-step, which waits for an actuator command in each cycle.

        Args:
            signal: A sensor signal in the last message of the machine's cycle. Each of its messages begins a cycle of
                the loop, however late it is.
            wait: The time without a message after which a cycle begins anyway, in seconds.

        Raises:
            ValueError: The signal is not sent in every cycle: machine and loop would wait for each other.
        """
        protocol = self.protocol or Protocol(sense=[], act=[])
        for channel in (map.channel for map in protocol.sense if signal in map.signals):
            if round(protocol.periods.get(channel, self.period) / self.period) > 1:
                raise ValueError(
                    f"{signal} is sent every {protocol.periods[channel]:g} s only, but a machine in lock-step waits "
                    f"for a command every {self.period:g} s: name a signal that is sent in every cycle"
                )
        return replace(self, pace=signal, patience=wait / self.period, check_age=False)

    def runtime(
        self, target: DpsAlone | VirtualTestbed, bridge: Bridge, *, context: Context | None = None, **options: Any
    ) -> Runtime:
        """Return a loop that runs ``target`` in this way; ``options`` are further options of `Runtime`.

        Args:
            target: The DPS alone, or the whole testbed.
            bridge: The bridge to the machine, made for the signals of the target.
            context: The state of the target to continue from; by default its default context.
            options: Further options of `Runtime`, by name, such as ``clock`` and ``watchers``.
        """
        return Runtime(
            target,
            bridge,
            context=context,
            period=self.period,
            guards=self._guards(target.interface),
            continuity=self.continuity,
            hint=self.hint,
            blocked_by=lambda: self.blocked_by(bridge),
            released_by=lambda: self.released_by(bridge),
            pace=self.pace or None,
            patience=self.patience,
            **options,
        )


@contextmanager
def deploy(
    scenario: Scenario,
    url: str,
    *,
    target: DpsAlone | VirtualTestbed | None = None,
    context: Context | None = None,
    start: Snapshot | None = None,
    values: Mapping[str, Any] | None = None,
    deployment: Deployment | None = None,
    claim: bool = False,
    live: bool = False,
    record: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Iterator[Runtime]:
    """Connect the DPS of a scenario to its machine; see `Scenario.deploy`.

    Args:
        scenario: The scenario.
        url: The URL of the LCM bus.
        target: The diagram to run, for instance the whole testbed; by default a new DPS alone.
        context: The state of the target to continue from; by default its default context.
        start: A snapshot to continue from.
        values: Variables to set before the first cycle, by address.
        deployment: How the DPS runs on its machine; by default the scenario's deployment.
        claim: Whether to ask the hub for protected channels whose owner has fallen silent.
        live: Whether to serve ``vtbdrake get``, ``set``, ``watch`` and ``reset``.
        record: A new file in which the loop is recorded, for `vtbdrake.replay`; None for no record.
        options: Further options of `Runtime`, by name, such as ``clock`` and ``watchers``.
    """
    deployment = deployment or Deployment.of(scenario)
    interface = scenario.interface()
    deployment.check_interface(interface)
    protocol = deployment.protocol or protocol_of(scenario)  # An error if the scenario has none, either.
    _warn_of_unreported(interface, protocol)
    bridge = protocol.bridge(interface, url)
    target = target or DpsAlone(scenario)
    context = context or target.default_context()
    if start is not None:
        target.restore(context, start)
    target.write(context, values or {})
    recorder = None
    with (
        termination_interrupts(),
        deployment.runtime(target, bridge, context=context, **options) as runtime,
        ExitStack() as stack,
    ):
        if runtime.slow_parts.statistics:
            _log.info("waiting for the processes of the slow parts %s", ", ".join(runtime.slow_parts.statistics))
            runtime.slow_parts.wait_until_ready()
        bridge.open()
        stack.callback(bridge.close)
        if claim:
            bridge.claim()
        if live:
            from vtbdrake.monitoring.live.service import LiveService

            stack.enter_context(LiveService(runtime, url))
        if record is not None:
            from vtbdrake.recording.recorder import Recorder

            recorder = stack.enter_context(Recorder(runtime, record))
            recorder.wait_until_ready()
        try:
            yield runtime
        finally:
            runtime.leave("the deployment ended")
    if recorder is not None:
        if recorder.lost:
            from vtbdrake.recording.recorder import RecordingError

            raise RecordingError(f"{recorder.lost} of {runtime.cycles} cycles of the loop are not in the log {record}")
        _log.info("recorded to %s, without a loss", record)


def _warn_of_unreported(interface: Interface, protocol: Protocol) -> None:
    names = [signal.name for signal in interface.act if signal.name not in protocol.reported]
    if names:
        _log.warning(
            "the machine does not report what acts on %s: the loop will not notice that commands do not arrive for a "
            "while, or that the machine stops by itself, and the command that arrives then may be far from what acts. "
            "Let a message report it (Protocol(reported=...)), or say when the machine must not be commanded "
            "(Protocol(robot_mode=...), Deployment(blocked_by=...))",
            ", ".join(names),
        )

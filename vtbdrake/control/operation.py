"""How the DPS of a scenario is run on its machine: with which guards, from which measurements, at which pace."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import inf, isnan
from typing import Any

from pydrake.systems.framework import Context

from vtbdrake.control.bridge import Bridge
from vtbdrake.control.guard import Guards
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import SwitchRefusedError, check_continuity
from vtbdrake.testbed import DpsAlone, Interface, Scenario, VirtualTestbed

REPEAT = 1.0
"""Seconds after which one is told again what is waited for."""


class OperationError(ValueError):
    """A scenario that does not say how its DPS is run safely, or says it in a way that does not fit its signals."""


def _always(bridge: Bridge) -> str | None:
    return None


@dataclass(frozen=True, kw_only=True)
class Operation:
    """What `Runtime` needs to know beside the DPS and the bridge.

    A scenario has one if it has a method ``operation``::

        def operation(self) -> Operation:
            return Operation(
                guards={"fallback": {"torque": Brake(...)}},
                continuity={"torque": ("torque_measured", 5.0)},
            )

    Attributes:
        period: of a cycle, in seconds.
        guards: options of `Guards`, such as ``fallback`` and ``max_missed``.
        continuity: actuator signal -> (sensor signal, largest difference); see `Runtime`. Needed for each that has a
            limit of its rate or acceleration.
        ready: says why the machine on the other side of a bridge is not ready to be commanded, or None.
        pace: the sensor signal that begins a cycle; the clock, if empty.
        patience: periods without it after which the clock does.
        aging: False lets sensor values be of any age, where time stands still between two messages.
    """

    period: float = 1e-3
    guards: Mapping[str, Any] = field(default_factory=dict)
    continuity: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    ready: Callable[[Bridge], str | None] = _always
    pace: str = ""
    patience: float = 3.0
    aging: bool = True

    def check(self, interface: Interface) -> None:
        """
        Raises:
            ValueError: it does not fit the signals, leaves a limit without something measured to depart from, or would
                not notice that the machine has fallen silent.
        """
        guards = self._guards(interface)
        if self.aging and interface.sense and all(signal.max_age == inf for signal in interface.sense):
            raise ValueError(
                "no sensor signal has a max_age, so that nobody would notice a machine that falls silent: give one to "
                f"those that come regularly ({', '.join(signal.name for signal in interface.sense)})"
            )
        check_continuity(interface, self.continuity)
        for name in (signal.name for signal in interface.act):
            if guards.needs_start(name) and name not in self.continuity:
                raise ValueError(
                    f"the actuator signal {name} has a limit of its rate or acceleration, and nothing measured that "
                    f"its command could depart from: give continuity={{{name!r}: (sensor signal, largest difference)}}"
                )

    def _guards(self, interface: Interface) -> Guards:
        if not self.aging:
            interface = replace(interface, sense=[replace(signal, max_age=inf) for signal in interface.sense])
        return Guards(interface, self.period, **self.guards)

    def in_lock_step(self, signal: str, *, wait: float = 60.0) -> Operation:
        """The same with a machine in lock-step, which waits for the command before it goes on: every message of a
        sensor signal begins a cycle, however long it takes to come.

        Args:
            signal: in the last message of the machine's cycle, so that all the others are there.
            wait: seconds after which a cycle begins without it.
        """
        return replace(self, pace=signal, patience=wait / self.period, aging=False)

    def runtime(
        self, target: DpsAlone | VirtualTestbed, bridge: Bridge, *, context: Context | None = None, **options: Any
    ) -> Runtime:
        """Runs ``target`` so; ``options`` are further ones of `Runtime`."""
        return Runtime(
            target,
            bridge,
            context=context,
            period=self.period,
            guards=self._guards(target.interface),
            continuity=self.continuity,
            ready=lambda: self.ready(bridge),
            pace=self.pace or None,
            patience=self.patience,
            **options,
        )


def operation_of(scenario: Scenario, *, period: float | None = None, pace: str | None = None) -> Operation:
    """How the DPS of ``scenario`` is run on its machine; by defaults, if the scenario does not say.

    Args:
        period, pace: in place of the scenario's own.

    Raises:
        OperationError: it cannot be run safely so.
    """
    # The layer of scenarios knows nothing of loops: so the method is optional, and looked for here.
    method = getattr(scenario, "operation", None)
    operation = Operation() if method is None else method()
    name = type(scenario).__name__
    if not isinstance(operation, Operation):
        raise OperationError(f"{name}.operation() returns a vtbdrake.control.operation.Operation, not {operation!r}")
    if period is not None:
        operation = replace(operation, period=period)
    if pace is not None:
        operation = replace(operation, pace=pace)
    try:
        operation.check(scenario.interface())
    except ValueError as error:
        remedy = "" if method else "; a scenario says so by a method operation() that returns an Operation"
        raise OperationError(f"{name} cannot be run on its machine: {error}{remedy}") from error
    return operation


def take_over(runtime: Runtime, *, timeout: float, tell: Callable[[str], None] = lambda text: None) -> None:
    """Runs cycles until nothing speaks against it, and switches to real; `Runtime.run` goes on from there.

    Args:
        timeout: seconds after which it gives up.
        tell: is told what is waited for, at first and then every `REPEAT` seconds.

    Raises:
        SwitchRefusedError: something still speaks against it.
        ValueError: the timeout is no number of seconds.
    """
    if isnan(timeout):
        raise ValueError(f"take_over gives up after a number of seconds, not after timeout={timeout}")
    begin = runtime.clock.now()
    told = -REPEAT

    def taken() -> bool:
        nonlocal told
        preparation = runtime.prepare("real")
        waited = runtime.clock.now() - begin
        if not preparation.reasons:
            runtime.perform(preparation)
            return True
        if waited >= timeout:
            raise SwitchRefusedError(f"after {waited:.1f} s: {'; '.join(preparation.reasons)}")
        if waited >= told + REPEAT:
            told = waited
            tell("; ".join(preparation.reasons))
        return False

    runtime.run(until=taken)
    if runtime.pace is not None:
        # At once: a machine in lock-step waits for a command before it says anything new.
        runtime.cycle()

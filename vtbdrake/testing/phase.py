"""The phases of a DPS: simulated, in shadow mode beside another controller, and on its machine; one test for all."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from vtbdrake.common.argument_checks import as_addresses
from vtbdrake.control.bridge import Bridge
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine import MachineProcess
from vtbdrake.recording.recorder import Recorder
from vtbdrake.testbed import Interface, Scenario
from vtbdrake.testing.loop_rules import DPS_FAULTS
from vtbdrake.testing.trace import Trace, reader_of, units_of

PHASES = ("sim", "shadow", "machine")

PATIENCE = 60.0
"""Seconds of wall time for the machine to answer, and for a slow part to compute."""


class _NoMachine(Bridge):
    """A bridge to nothing: no sample arrives, and no command leaves."""

    real_time = False

    def __init__(self, interface: Interface) -> None:
        self.interface = interface
        self.sensed = {signal.name: ReceivedSignal() for signal in interface.sense}
        self.commands = {}

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    def poll(self, timeout: float = 0.0) -> int:
        return 0

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        return tuple(actuation)

    @property
    def connected(self) -> bool:
        return False


class Phase:
    """The loop of a scenario's DPS in one phase, from its defaults on, in lock-step; a context manager.

    * ``sim``: the whole testbed on a simulated clock, its switches on sim.
    * ``machine``: the DPS alone controls a machine in a process of its own, over a hub.
    * ``shadow``: it does so, too, and beside it the whole testbed listens to the same machine, with T_sense on real and
      T_act on sim. The loop under test is the testbed's: its DPS sees the machine, and commands the simulated
      world.

    The machine waits for each command, and the loop for each state and for the results of slow parts: the same happens
    every time, however busy the computer is.

    Args:
        scenario: The scenario.
        name: One of `PHASES`.
        record: A new file in which the loop under test is recorded; None: it is not.
        machine_options: Arguments of `MachineProcess`, such as ``perturb`` and ``seed``.

    Attributes:
        scenario: The scenario.
        name: The name of the phase.
        period: Period of a cycle, in seconds.
        log: The file in which the loop under test is recorded, or None.

    Raises:
        DeploymentError, ProtocolError: The scenario does not say how its DPS runs on its machine.
    """

    def __init__(
        self,
        scenario: Scenario,
        name: str,
        *,
        record: str | os.PathLike[str] | None = None,
        machine_options: Mapping[str, Any] | None = None,
    ) -> None:
        if name not in PHASES:
            raise ValueError(f"a phase is one of {', '.join(PHASES)}, not {name!r}")
        self.scenario = scenario
        self.name = name
        self.log = None if record is None else Path(record)
        self._machine_options = dict(machine_options or {})
        self._deployment = scenario.deployment() if name == "sim" else Deployment.of(scenario)
        self.period = self._deployment.period
        self._stack = ExitStack()
        self._started = False
        self._clock: SimulatedClock | None = None
        self._cycle: Cycle | None = None
        self._runtime: Runtime | None = None
        self._driver: Runtime | None = None  # what controls the machine, if it is not the loop under test

    def __repr__(self) -> str:
        return f"Phase({self.scenario!r}, {self.name!r})"

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._runtime = self._simulated(stack) if self.name == "sim" else self._on_machine(stack)
            self._runtime.watch(self._note)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the loop and its machine; the log is complete then. Again, it does nothing."""
        self._stack.close()

    @property
    def runtime(self) -> Runtime:
        """Return the loop under test; a `RuntimeError` before the phase has begun."""
        if self._runtime is None:
            raise RuntimeError(f"the phase {self.name} has not begun: use it in a block, with Phase(...) as phase")
        return self._runtime

    def read(self, address: str) -> Any:
        """Return the present value at an address of the loop under test, see `reader_of`."""
        return reader_of(self.runtime.target, address)(self.runtime.context)

    def write(self, values: Mapping[str, Any]) -> None:
        """Set variables of the DPS and commands u by address; before the first `run`, before the DPS takes over."""
        for runtime in filter(None, (self.runtime, self._driver)):
            runtime.write(values)

    def run(self, seconds: float, *, record: str | Sequence[str] = ()) -> Trace:
        """Run the loop, and return what was recorded at the end of every cycle, and before the first one.

        Args:
            seconds: Time of the DPS, in seconds.
            record: Addresses, see `reader_of`. All phases have ``sense.<signal>``, ``act.<signal>``, ``dps.*`` and
                ``u.*``; the simulated world ``sim.*`` is not on the machine.

        Raises:
            AssertionError: The DPS raised or commanded NaN, or the guards found another fault.
            SwitchRefusedError: The DPS could not take over the machine.
        """
        runtime = self.runtime
        addresses = as_addresses("what is recorded", record)
        readers = [reader_of(runtime.target, address) for address in addresses]
        if not self._started:
            self._start()
        times, rows = [], []

        def sample() -> None:
            times.append(runtime.time)
            rows.append([read(runtime.context) for read in readers])

        sample()
        for _ in range(round(seconds / self.period)):
            self._run_cycle()
            sample()
        columns = {address: np.array([row[i] for row in rows]) for i, address in enumerate(addresses)}
        return Trace(np.array(times), columns, units_of(runtime.target, addresses), log=self.log)

    def _note(self, cycle: Cycle) -> None:
        self._cycle = cycle

    def _run_cycle(self) -> None:
        if self._clock is not None:
            self._clock.advance(self.period)
        # First the loop that only listens: the machine goes on when the other one answers.
        for runtime in filter(None, (self.runtime, self._driver)):
            runtime.run(cycles=1)
            runtime.slow_parts.wait(PATIENCE)
            latched = [fault.reason for fault in runtime.guards.latched]
            assert not latched, f"in the phase {self.name}, the fallbacks took over: {'; '.join(latched)}"
        assert self._cycle is not None
        wrong = [fault.reason for fault in self._cycle.verdict.faults if fault.kind in DPS_FAULTS]
        assert not wrong, f"in the phase {self.name}: {'; '.join(wrong)}"

    def _start(self) -> None:
        if self.name == "shadow":
            self.runtime.run(cycles=1)
            self.runtime.switch("shadow")
        if self.name != "sim":
            (self._driver or self.runtime).take_over(timeout=PATIENCE)
        self._started = True

    def _simulated(self, stack: ExitStack) -> Runtime:
        interface, protocol = self.scenario.interface(), self._deployment.protocol
        bridge = _NoMachine(interface) if protocol is None else protocol.bridge(interface, "memq://")
        self._clock = SimulatedClock()
        clocked = replace(self._deployment, pace="")
        runtime = stack.enter_context(clocked.runtime(self.scenario.build(), bridge, clock=self._clock))
        runtime.slow_parts.wait_until_ready()
        bridge.open()
        stack.callback(bridge.close)
        if self.log is not None:
            stack.enter_context(Recorder(runtime, self.log)).wait_until_ready()
        return runtime

    def _on_machine(self, stack: ExitStack) -> Runtime:
        protocol = protocol_of(self.scenario)
        # The last message that the machine sends in every cycle.
        channels = [m for m in protocol.sense if protocol.periods.get(m.channel, 0.0) < 1.5 * self.period]
        signal = self._deployment.pace or channels[-1].signals[0]
        deployment = self._deployment.in_lock_step(signal, wait=PATIENCE)
        hub = stack.enter_context(Hub(port=0))
        options = {**self._machine_options, "lock_step": True}
        stack.enter_context(MachineProcess(self.scenario, hub.url, **options))
        target = None
        if self.name == "shadow":
            self._driver = stack.enter_context(self.scenario.deploy(hub.url, deployment=deployment))
            target = self.scenario.build()
        loop = self.scenario.deploy(hub.url, deployment=deployment, target=target, record=self.log)
        return stack.enter_context(loop)

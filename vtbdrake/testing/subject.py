"""The subject of checks: a scenario, and what the checks of it share."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.drake_workarounds.renderer_threads import release_renderers
from vtbdrake.rollout.repeatability import Sample, Trace, trace, within
from vtbdrake.rollout.runner import RolloutRunner
from vtbdrake.rollout.task import RolloutTask
from vtbdrake.state import Snapshot
from vtbdrake.testbed import DpsAlone, Scenario, Signal, VirtualTestbed
from vtbdrake.testbed.addressed import AddressedDiagram
from vtbdrake.testbed.parts import WorldAlone
from vtbdrake.testbed.scenario import check_is_scenario

# Pytest shows none of the frames of this module: what a check has found is its message.
__tracebackhide__ = True

_BUDGET = 0.2  # s of processor time for the simulation with which others are compared
_LONGEST = 2.0  # s that are simulated
_PERIOD = 0.05  # s between samples, where nothing has a period

Readers = Mapping[str, Callable[[Context], Any]]
"""Functions of a root context that read a value, by signal."""


class CheckFailedError(AssertionError):
    """A scenario does not have the property that a check asks for."""


class CheckSkippedError(Exception):
    """A check does not concern a scenario, or presupposes what another check has refuted."""


class Subject:
    """A scenario under test. What several checks need is made once, when the first of them asks for it.

    Args:
        scenario: The scenario.
        values: Address -> value, set before a simulation begins: a command that lets the robot move, say.
        horizon: Seconds that are simulated; None: as many as take a fifth of a second of processor time, up to 2 s.

    Attributes:
        scenario, values: As given.
    """

    def __init__(
        self, scenario: Scenario, *, values: Mapping[str, Any] | None = None, horizon: float | None = None
    ) -> None:
        check_is_scenario(scenario)
        self.scenario = scenario
        self.values = dict(values or {})
        self._horizon = horizon
        self._beside: dict[ThreadPoolExecutor, list[Generator[tuple[float, Sample]]]] = {
            ThreadPoolExecutor(1): [],
            ThreadPoolExecutor(1): [],
        }
        self._start: Snapshot | None = None
        self._runners: list[RolloutRunner] | None = None
        self._outcomes: dict[str, CheckFailedError | CheckSkippedError | None] = {}

    def outcome(self, check: Callable[[Subject], None]) -> CheckFailedError | CheckSkippedError | None:
        """Return the error of a check, or None if it passes; it runs once.

        Raises:
            ValueError: The testbed has no variable of an address in ``values``.
        """
        if isinstance(self.built, VirtualTestbed):
            for address in self.values:
                self.built.variables()[address]
        name = check.__name__
        if name not in self._outcomes:
            try:
                check(self)
                self._outcomes[name] = None
            except (CheckFailedError, CheckSkippedError) as error:
                self._outcomes[name] = error
            except FAILURES as error:  # An error of the scenario: none of our own functions raises.
                failure = CheckFailedError(f"an error of the scenario: {error_text(error)}")
                failure.__cause__ = error
                self._outcomes[name] = failure
        return self._outcomes[name]

    def presuppose(self, *checks: Callable[[Subject], None]) -> None:
        """Raise a CheckSkippedError if one of the checks fails: what presupposes it would fail for the same reason."""
        for check in checks:
            error = self.outcome(check)
            if isinstance(error, CheckFailedError):
                raise CheckSkippedError(f"it presupposes {check.__name__}, which fails")
            if error is not None:
                raise error

    @cached_property
    def built(self) -> VirtualTestbed | BaseException:
        """Return the testbed, or the error for which it cannot be built."""
        try:
            return self.scenario.build()
        except FAILURES as error:
            return error

    @property
    def testbed(self) -> VirtualTestbed:
        """Return the testbed that checks share; other checks may have simulated it already.

        Raises:
            CheckSkippedError: It cannot be built.
        """
        return self.presuppose_testbed()

    def presuppose_testbed(self) -> VirtualTestbed:
        """Raise a CheckSkippedError if the testbed cannot be built; return it otherwise."""
        if not isinstance(self.built, VirtualTestbed):
            # One of the two checks has failed, and says why.
            raise CheckSkippedError("it presupposes a testbed: check_builds or check_no_algebraic_loop fails")
        return self.built

    @cached_property
    def dps_alone(self) -> DpsAlone:
        """Return the DPS without the simulated world, which checks share."""
        return DpsAlone(self.scenario)

    @cached_property
    def world_alone(self) -> WorldAlone:
        """Return the simulated world without the DPS, which checks share."""
        return WorldAlone(self.scenario)

    def presuppose_simulation(self) -> None:
        """Raise a CheckSkippedError if the reference simulation fails."""
        if self.failure:
            raise CheckSkippedError("it presupposes check_simulates, which fails")  # and says why

    def started(self, testbed: VirtualTestbed) -> Context:
        """Return a new context of ``testbed`` with the values set."""
        context = testbed.default_context()
        testbed.write(context, self.values)
        return context

    @property
    def start(self) -> Snapshot:
        """Return s0 of the shared testbed, as it was before anything was simulated."""
        return self._take_start()

    def _take_start(self) -> Snapshot:
        """Return s0, which is taken at the first call: before anything is simulated."""
        if self._start is None:
            self._start = self.testbed.snapshot(self.started(self.testbed))
        return self._start

    @cached_property
    def period(self) -> float:
        """Return the time between samples, in seconds: the shortest period of an update in the testbed."""
        periods = [period for period, _ in self.testbed.event_timings()]
        return min(periods, default=_PERIOD)

    @cached_property
    def task(self) -> RolloutTask:
        """Return the task of rollouts of the scenario, which are as long as the reference."""
        horizon = self._horizon if self._horizon is not None else _LONGEST
        return RolloutTask(self.scenario, horizon, sample_period=min(self.period, horizon))

    def _make_runners(self) -> list[RolloutRunner]:
        """Return the three runners; at the first call they are made, and so are the simulations in other threads.

        That is before anything is simulated: what a simulation changes in the Diagram does not change their s0.
        """
        if self._runners is not None:
            return self._runners
        if self.testbed.visualized:
            raise CheckSkippedError("the testbed draws into a Meshcat, which no rollout may do")
        self._take_start()
        for thread, traces in self._beside.items():
            traces.append(thread.submit(lambda: trace(RolloutRunner(self.task, self.testbed), self.values)).result())
        self._runners = [RolloutRunner(self.task, self.testbed) for _ in range(3)]
        return self._runners

    def beside(self) -> Iterator[tuple[float, Sample]]:
        """Yield the samples of a simulation in one thread, while the same in another thread takes its steps in turn.

        Each begins in its thread, to which its renderer belongs.
        """
        self._make_runners()
        try:
            for _ in self.reference:
                samples = [thread.submit(next, traces[0], None).result() for thread, traces in self._beside.items()]
                if samples[-1] is not None:
                    yield samples[-1]
        finally:
            for thread, traces in self._beside.items():
                thread.submit(traces.clear).result()
                thread.submit(release_renderers).result()  # What is left is ended in this thread.
                thread.shutdown()

    def runner(self, number: int) -> RolloutRunner:
        """Return a runner of rollouts on the shared testbed, one of three that were made before anything was simulated.

        Number 0 runs the reference.
        """
        return self._make_runners()[number]

    @cached_property
    def reference(self) -> Trace:
        """Return the numbers of all systems at the sample times of a simulation from s0."""
        samples = trace(self.runner(0), self.values)
        return list(samples if self._horizon is not None else within(_BUDGET, samples))

    @property
    def failure(self) -> str:
        """Return the reason why the reference simulation fails; empty if it does not."""
        return next((text for text in self.reference[-1][1][""] if isinstance(text, str)), "")

    @property
    def instants(self) -> np.ndarray:
        """Return the simulator's times at the samples of the reference, in seconds.

        Raises:
            CheckSkippedError: The simulation fails.
        """
        self.presuppose_simulation()
        return self.task.instants(0.0, self.testbed.event_timings())[: len(self.reference)]

    def readers(self, testbed: VirtualTestbed) -> tuple[Readers, Readers]:
        """Return the readers of the sensor values that the DPS gets, and of its commands, by signal."""
        interface = testbed.interface
        return (
            {signal.name: _reader(testbed, f"T_sense.{signal.name}.value", signal) for signal in interface.sense},
            command_readers(testbed),
        )

    def signal_values(self, testbed: VirtualTestbed) -> Iterator[tuple[float, dict[str, Any], dict[str, Any]]]:
        """Simulate from s0, and yield time, sensor values and actuator commands, by signal, at every instant."""
        context = self.started(testbed)
        simulator = testbed.simulator(context)
        sense, act = self.readers(testbed)
        simulator.Initialize()
        for instant in self.instants.tolist():
            if instant > context.get_time():
                simulator.AdvanceTo(instant)
            yield (
                instant,
                {name: read(context) for name, read in sense.items()},
                {name: read(context) for name, read in act.items()},
            )


def command_readers(target: AddressedDiagram) -> Readers:
    """Return the readers of the commands of a DPS, in its testbed or alone, by signal."""
    return {signal.name: _reader(target, f"dps.{signal.name}", signal) for signal in target.interface.act}


def _reader(target: AddressedDiagram, address: str, signal: Signal) -> Callable[[Context], Any]:
    """Return a function of a context that reads a signal; of a vector signal an array of shape (size,)."""
    read = target.reader(address)
    # The address may name a variable, which is a number if it has one entry.
    return (lambda context: np.reshape(read(context), signal.size)) if signal.is_vector else read

"""A rule-based state machine of Hypothesis that does to a control loop what happens to one, in lock-step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

from vtbdrake.common.extras import extra_module
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine import InjectedFault, Machine
from vtbdrake.testbed import DpsAlone, Scenario, VirtualTestbed
from vtbdrake.testbed.parts import WorldAlone
from vtbdrake.testbed.testbed import MODES
from vtbdrake.testing.loop_rules import LoopRules, WatchedBridge
from vtbdrake.testing.strategies import commands, injected_faults

if TYPE_CHECKING:
    import hypothesis
    from hypothesis import stateful
    from hypothesis import strategies as st
else:
    hypothesis = extra_module("hypothesis", purpose="the state machine of a loop", extra="testing")
    stateful = extra_module("hypothesis.stateful", purpose="the state machine of a loop", extra="testing")
    st = extra_module("hypothesis.strategies", purpose="the state machine of a loop", extra="testing")

EXAMPLES = 20
"""Number of examples, unless the test case gets other settings."""

START = 30
"""Number of cycles before the first switch: the pace of the messages is known then."""


@dataclass(frozen=True, eq=False)
class _LoopCase:
    """What a state machine is made for.

    Attributes:
        scenario: The scenario.
        deployment: Its deployment, with cycles begun by the clock.
        alone: Whether the DPS runs alone.
        values: Values of variables by address that are set at first.
    """

    scenario: Scenario
    deployment: Deployment
    alone: bool
    values: Mapping[str, Any]

    @cached_property
    def target(self) -> VirtualTestbed | DpsAlone:
        """Return the target of the loop; all examples share it."""
        return DpsAlone(self.scenario) if self.alone else self.scenario.build()

    @cached_property
    def world(self) -> WorldAlone:
        """Return the world of the machine; all examples share it."""
        return WorldAlone(self.scenario)

    def machine(self, *, epoch: int = 0) -> Machine:
        """Return a new machine, whose time stamps begin at ``epoch`` in microseconds."""
        return Machine(self.scenario, world=self.world, epoch=epoch)


class _LoopMachine(stateful.RuleBasedStateMachine):
    """The loop, its machine and its clock, and the rules whose strategies do not depend on the scenario.

    Attributes:
        case: The scenario, and how its loop is run.
    """

    case: ClassVar[_LoopCase]

    def __init__(self) -> None:
        super().__init__()
        self.clock = SimulatedClock()
        self.bridge = WatchedBridge(self.case.machine(), self.clock)
        self.runtime: Runtime = self.case.deployment.runtime(self.case.target, self.bridge, clock=self.clock)
        self.loop_rules = LoopRules(self.runtime, self.bridge)
        self.runtime.write(self.case.values)

    def teardown(self) -> None:
        with self.runtime:
            self.runtime.leave("the test ended")

    def _restart(self) -> None:
        self.bridge.restart(self.case.machine(epoch=round(1e6 * self.clock.now())))

    def _run(self, cycles: int) -> None:
        for _ in range(cycles):
            self.clock.advance(self.case.deployment.period)
            self.runtime.run(cycles=1)

    @stateful.initialize()
    def start(self) -> None:
        self._run(START)
        self.switch("real")

    @stateful.rule(cycles=st.integers(1, 40))
    def run(self, cycles: int) -> None:
        self._run(cycles)

    def disturb(self, fault: InjectedFault, cycles: int) -> None:
        """Let messages be lost, late, repeated or corrupted for some cycles."""
        self.bridge.machine.begin(fault)
        self._run(cycles)
        self.bridge.machine.end_faults()

    @stateful.rule(periods=st.floats(0.0, 40.0))
    def hold_up(self, periods: float) -> None:
        self.clock.advance(periods * self.case.deployment.period)
        self.runtime.run(cycles=1)

    @stateful.rule(cycles=st.integers(1, 5))
    def hurry(self, cycles: int) -> None:
        """Run cycles at once, as by hand."""
        for _ in range(cycles):
            self.runtime.run(cycles=1)

    @stateful.rule(cut=st.booleans())
    def connect(self, cut: bool) -> None:
        self.bridge.cut = cut

    @stateful.precondition(lambda self: not self.bridge.dead)
    @stateful.rule()
    def kill(self) -> None:
        self.bridge.dead = True

    @stateful.precondition(lambda self: self.bridge.dead)
    @stateful.rule()
    def restart(self) -> None:
        self._restart()
        self._run(START)

    def switch(self, mode: str) -> None:
        before = self.runtime.active, set(self.runtime.watched)
        try:
            self.runtime.switch(mode)
        except SwitchRefusedError:
            assert (self.runtime.active, set(self.runtime.watched)) == before, "a refused switch was thrown"
        self.loop_rules.note_switch()

    @stateful.rule()
    def reset(self) -> None:
        try:
            self.runtime.reset()
        except SwitchRefusedError:
            return
        self.loop_rules.note_reset()

    @stateful.rule()
    def recover(self) -> None:
        if self.bridge.dead:
            self._restart()
        self.bridge.cut = False
        self.runtime.write(self.case.values)
        self._run(START)
        self.reset()
        self.switch("real")

    def command(self, values: dict[str, Any]) -> None:
        # Some commands may come from inside the testbed.
        variables = self.runtime.target.variables()
        self.runtime.write({address: value for address, value in values.items() if address in variables})

    @stateful.invariant()
    def rules_are_kept(self) -> None:
        assert not self.loop_rules.violations, "\n".join(self.loop_rules.violations)


def loop_state_machine(
    scenario: Scenario,
    *,
    alone: bool = False,
    values: Mapping[str, Any] | None = None,
) -> type[stateful.RuleBasedStateMachine]:
    """Return a state machine that does to the loop of a scenario what may happen to it, and checks that it keeps rules.

    In a test file::

        TestLoop = loop_state_machine(ArmScenario()).TestCase

    The machine of the loop is in the same process, and time is simulated: a failure repeats, and Hypothesis makes it
    short. Messages arrive, are lost, late, repeated or corrupted; the machine dies and comes back; the connection is
    cut; the loop is held up; switches are thrown; the guards are reset; commands u change. Checked is what
    `LoopRules` lists, and that nothing raises. What the scenario's slow parts compute is missing mostly: there is no
    time for it.

    Args:
        scenario: The scenario.
        alone: Whether the DPS runs alone, and not in the whole testbed.
        values: Values of variables by address that are set at first, so that the DPS can take over.

    Raises:
        ProtocolError: The deployment of the scenario has no protocol, so no machine.
        DeploymentError: The DPS cannot run safely.
    """
    # By the clock: where messages began the cycles, those that fail to come would stop it.
    deployment = Deployment.of(scenario, pace="")
    faults = injected_faults(protocol_of(scenario), period=deployment.period)
    modes = ["real"] if alone else list(MODES)

    class LoopMachine(_LoopMachine):
        """The rules whose strategies depend on the scenario, besides."""

        case = _LoopCase(scenario, deployment, alone, dict(values or {}))
        disturb = stateful.rule(fault=faults, cycles=st.integers(1, 20))(_LoopMachine.disturb)
        switch = stateful.rule(mode=st.sampled_from(modes))(_LoopMachine.switch)
        command = stateful.rule(values=commands(scenario.interface()))(_LoopMachine.command)

    # As Hypothesis has them for state machines, but with fewer examples: each has some hundred cycles.
    LoopMachine.TestCase.settings = hypothesis.settings(
        deadline=None, suppress_health_check=list(hypothesis.HealthCheck), max_examples=EXAMPLES
    )
    LoopMachine.__name__ = LoopMachine.__qualname__ = f"{type(scenario).__name__}Loop"
    return LoopMachine

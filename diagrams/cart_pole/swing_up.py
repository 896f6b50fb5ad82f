"""The swing-up: the plan of forces is decided again and again, by rollouts of the testbed itself."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.common.arrays import Array
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.reasoning import Budget, Decision, Reasoner
from vtbdrake.rollout import Executor
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.cart_pole.decision import reasoning
from vtbdrake_diagrams.cart_pole.dps import PERCEIVED
from vtbdrake_diagrams.cart_pole.scenario import CartPoleScenario

# The longest time in which processes start, or a decision is made, in seconds.
_PATIENCE = 60.0


def make_reasoner(
    scenario: CartPoleScenario, *, rollouts: int = 32, executor: str | Executor = "auto", **options: Any
) -> Reasoner:
    """Return a reasoner that decides the command ``u.plan`` of a cart-pole.

    Args:
        scenario: The scenario of the running cart-pole.
        rollouts: Budget of a decision.
        executor: Where the rollouts run, see `SearchConfig`.
        options: Further arguments of `Reasoner`, which replace the arguments of `reasoning`.
    """
    arguments = reasoning(scenario, "u.plan", Budget(rollouts=rollouts), executor=executor)
    return Reasoner(scenario=scenario, **{**arguments, **options})


@dataclass(frozen=True)
class Swing:
    """The course of a swing-up.

    Attributes:
        times: Times in s, shape (n,).
        states: [x, theta, x', theta'] at these times, shape (n, 4), in m and rad.
        decisions: The decision at each of them, if a reasoner outside the DPS decides.
    """

    times: Array
    states: Array
    decisions: tuple[Decision, ...] = ()

    @property
    def tilt(self) -> Array:
        """Return the angle between the pole and the upright, in [0, pi], in rad, shape (n,)."""
        return np.abs(np.angle(np.exp(1j * (self.states[:, 1] - np.pi))))


def swing_up(reasoner: Reasoner, scenario: CartPoleScenario, *, seconds: float = 6.0, every: float = 0.1) -> Swing:
    """Simulate a cart-pole that hangs at rest, and decide a new plan for it in regular intervals.

    The time that a decision takes is not simulated: the cart-pole waits.

    Args:
        reasoner: The reasoner, see `make_reasoner`.
        scenario: The cart-pole; it may differ from the reasoner's.
        seconds: Duration of the simulation in seconds.
        every: Time from one decision to the next, in seconds.
    """
    testbed = scenario.build()
    context = testbed.default_context()
    decisions = []

    def decide() -> None:
        decisions.append(reasoner.decide(testbed, context))
        if decisions[-1]:
            decisions[-1].apply(testbed, context)

    return replace(_simulated(testbed, context, seconds, every, decide), decisions=tuple(decisions))


def swing_up_onboard(scenario: CartPoleScenario, *, seconds: float = 6.0, every: float = 0.1) -> Swing:
    """Simulate a cart-pole that hangs at rest, and whose DPS decides the plan itself (``onboard=True``).

    A decision takes the time that the scenario declares, while the cart-pole moves on.

    Args:
        scenario: The cart-pole.
        seconds: Duration of the simulation in seconds.
        every: Time from one sample of the result to the next, in seconds.
    """
    testbed = scenario.build()
    return _simulated(testbed, testbed.default_context(), seconds, every, lambda: None)


def _simulated(
    testbed: VirtualTestbed, context: Context, seconds: float, every: float, pause: Callable[[], None]
) -> Swing:
    """Simulate, and call ``pause`` at each sample."""
    simulator = testbed.simulator(context)
    state = testbed.reader("plant.state")
    times = np.arange(round(seconds / every)) * every
    states = []
    for time in times.tolist():
        simulator.AdvanceTo(time)
        states.append(np.array(state(context)))
        pause()
    return Swing(times, np.array(states))


def swing_up_on_machine(
    scenario: CartPoleScenario, *, seconds: float = 6.0, record: str | os.PathLike[str] | None = None
) -> Swing:
    """Swing up the cart-pole of a machine in a process of its own, over LCM.

    The DPS decides the plan (``onboard=True``). The machine waits for each force, and the loop for each decision: the
    clock is the simulated world's, and the result does not depend on what else this computer does.

    Args:
        scenario: The cart-pole.
        seconds: Duration in seconds of the machine's world.
        record: A new file in which the loop is recorded, for `vtbdrake.replay`.
    """
    scenario = replace(scenario, lock_step=True)
    period, states = scenario.period, []
    with (
        Hub(port=0) as hub,
        MachineProcess(scenario, hub.url, lock_step=True),
        scenario.deploy(hub.url, record=record) as runtime,
    ):
        perceived = runtime.target.reader(PERCEIVED)

        def cycle_is_done() -> bool:
            states.append(np.array(perceived(runtime.context)))
            runtime.slow_parts.wait(_PATIENCE)
            return False

        runtime.slow_parts.wait(_PATIENCE)
        runtime.take_over()
        runtime.run(cycles=round(seconds / period), until=cycle_is_done)
    return Swing(period * np.arange(len(states)), np.array(states))

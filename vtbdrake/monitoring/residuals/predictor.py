"""What a machine will sense, predicted by the simulated world of its scenario."""

from __future__ import annotations

from collections.abc import Mapping
from math import isclose
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import InitializeParams

from vtbdrake.testbed import Scenario, WorldAlone
from vtbdrake.testbed.testbed import Belief

Array = NDArray[np.float64]


class Predictor:
    """A world that runs along with a machine, under the same commands, and is set to the belief again and again.

    What the belief does not cover (drives, samples in transit) goes on from window to window: it is state that follows
    from the commands. A discrete plant with sampled output ports goes on showing the state before, until its next step;
    where sensors look at that very instant, choose ``use_sampled_output_ports: false``.

    Args:
        scenario: of the machine.
        period: of a step, in seconds.
        values: of variables of the world, by address, that differ from the scenario's.

    Attributes:
        interface: the signals of the DPS.
        ages: by age of a belief, in periods, the addresses of the estimates that it is made of.

    Raises:
        ValueError: the scenario declares no belief, or one whose age is no whole number of periods; a signal is no
            vector; an address is unknown or a value impossible.
    """

    def __init__(self, scenario: Scenario, *, period: float, values: Mapping[str, Any]) -> None:
        self._world = world = WorldAlone(scenario)
        self.interface = world.interface
        self._period = period
        self._values = dict(values)
        if not world.beliefs:
            raise ValueError(
                f"{type(scenario).__name__} does not declare what of its DPS sets its simulated world: residuals need "
                "a belief to predict from (see `VirtualTestbedBuilder.believe`)"
            )
        for signal in [*world.interface.sense, *world.interface.act]:
            if not signal.is_vector:
                raise ValueError(f"residuals are of vector signals, but {signal.name} is abstract")
        self._beliefs: dict[int, list[Belief]] = {}
        for belief in world.beliefs:
            world.variables()[belief.target]
            self._beliefs.setdefault(_periods(belief, period), []).append(belief)
        self.ages = {
            age: tuple(dict.fromkeys(address for belief in beliefs for address in belief.of))
            for age, beliefs in self._beliefs.items()
        }
        self._sensors = [world.diagram.GetOutputPort(f"sense.{signal.name}") for signal in world.interface.sense]
        ends = np.cumsum([0, *(signal.size or 0 for signal in world.interface.act)]).tolist()
        self._actuators = {s.name: slice(*ends[k : k + 2]) for k, s in enumerate(world.interface.act)}
        self.forget()

    def forget(self) -> None:
        """Begins with a new context: everything as by default."""
        self._context = self._world.default_context()
        self._world.write(self._context, self._values)
        self._feed = self._world.feed(self._context)
        self._simulator = self._world.simulator(self._context)
        self._simulator.set_target_realtime_rate(0.0)
        self._simulator.Initialize()
        self.restart(0)

    def restart(self, period: int) -> None:
        """Goes on from what it is at another time, the begin of a period that is counted from 0."""
        # Multiples, as those of the machine: what is due at an instant would be missed by a rounding error before it.
        self._context.SetTime(period * self._period)
        # Without events: they belong to the beginning of a world.
        self._simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        self._now = period

    def believe(self, age: int, estimates: Mapping[str, Any]) -> None:
        """Sets what beliefs of this age are about.

        An estimate beyond the bounds of what it is about (a joint a little past its stop) is taken to the bound.
        """
        variables = self._world.variables()
        values = {}
        for belief in self._beliefs[age]:
            variable = variables[belief.target]
            value = np.reshape(belief.value_of([estimates[address] for address in belief.of]), variable.shape)
            values[belief.target] = np.clip(value, *variable.bounds)
        self._world.write(self._context, values)

    def step(self, command: Array | None) -> Array:
        """One period on; says what the sensors show then, all signals one after another.

        Args:
            command: of all actuator signals, one after another; None holds the last one.

        Raises:
            RuntimeError: the simulation failed.
        """
        if command is not None:
            for name, place in self._actuators.items():
                self._feed(name, command[place])
        self._simulator.AdvanceTo((self._now + 1) * self._period)
        self._now += 1
        return np.concatenate([port.Eval(self._context) for port in self._sensors])


def _periods(belief: Belief, period: float) -> int:
    age = round(belief.age / period)
    if not isclose(age * period, belief.age, rel_tol=1e-6, abs_tol=1e-9):
        raise ValueError(
            f"the belief about {belief.target} is {belief.age} s old, which is no whole number of periods of {period} s"
        )
    return age

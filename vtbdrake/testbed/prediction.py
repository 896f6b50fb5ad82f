"""Prediction of sensor values by simulating the world of a scenario from the DPS's belief."""

from __future__ import annotations

from collections.abc import Mapping
from math import isclose
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.analysis import InitializeParams

from vtbdrake.common.arrays import Array
from vtbdrake.testbed.parts import WorldAlone
from vtbdrake.testbed.testbed import BeliefRule

if TYPE_CHECKING:
    from vtbdrake.testbed.scenario import Scenario


class Predictor:
    """A simulated world that runs along with a machine, under the same actuator commands.

    `set_belief` sets it to the DPS's belief again and again. State that the belief does not cover (drives, samples in
    transit) goes on: it follows from the actuator commands.

    A discrete plant with sampled output ports shows its previous state until its next step; where sensors are sampled
    at that very instant, choose ``use_sampled_output_ports: false``.

    Args:
        scenario: The scenario of the machine. All its signals are vectors.
        period: Period of a step in seconds.
        values: Values of variables of the world, by address, that differ from the scenario's.

    Attributes:
        interface: The signals of the DPS.
        estimates: Age of a belief in periods -> the addresses of its estimates.

    Raises:
        ValueError: The scenario declares no belief, or one whose age is not a multiple of the period; a signal is
            abstract; an address is unknown; or a value is out of bounds.
    """

    def __init__(self, scenario: Scenario, *, period: float, values: Mapping[str, Any]) -> None:
        self._world = world = WorldAlone(scenario)
        self.interface = world.interface
        self._period = period
        self._values = dict(values)
        if not world.belief_rules:
            raise ValueError(
                f"{type(scenario).__name__} does not declare which estimates of its DPS set its simulated world, from "
                "which a prediction starts: declare them with VirtualTestbedBuilder.believe"
            )
        for signal in [*world.interface.sense, *world.interface.act]:
            if not signal.is_vector:
                raise ValueError(f"only vector signals are predicted, but {signal.name} is abstract")
        self._beliefs: dict[int, list[BeliefRule]] = {}
        for belief in world.belief_rules:
            for target in belief.targets:
                world.variables()[target]
            self._beliefs.setdefault(_age_in_periods(belief, period), []).append(belief)
        self.estimates = {
            age: tuple(dict.fromkeys(address for belief in beliefs for address in belief.of))
            for age, beliefs in self._beliefs.items()
        }
        self._sensors = [world.diagram.GetOutputPort(f"sense.{signal.name}") for signal in world.interface.sense]
        ends = np.cumsum([0, *(signal.size or 0 for signal in world.interface.act)]).tolist()
        self._actuators = {s.name: slice(*ends[k : k + 2]) for k, s in enumerate(world.interface.act)}
        self.reset()

    def reset(self) -> None:
        """Begin with a new default context."""
        self._context = self._world.default_context()
        self._world.write(self._context, self._values)
        self._feed = self._world.feed(self._context)
        self._simulator = self._world.simulator(self._context)
        self._simulator.Initialize()
        self.set_time(0)

    def set_time(self, step: int) -> None:
        """Go on from the present state at the beginning of step ``step``, counted from 0."""
        # A multiple of the period, as on the machine: a rounding error would miss the events of that instant.
        self._context.SetTime(step * self._period)
        # Initialization events belong to the beginning of a world.
        self._simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        self._now = step

    def set_belief(self, age: int, estimates: Mapping[str, Any]) -> None:
        """Set the variables of the world whose beliefs have one age.

        An estimate beyond the bounds of its variable (a joint a little past its stop) is clipped.

        Args:
            age: Age of the beliefs in periods, a key of `estimates`.
            estimates: Estimates by address.
        """
        variables = self._world.variables()
        values = {}
        for belief in self._beliefs[age]:
            believed = belief.values_of([estimates[address] for address in belief.of])
            for target, value in zip(belief.targets, believed, strict=True):
                variable = variables[target]
                values[target] = np.clip(np.reshape(value, variable.shape), *variable.bounds)
        self._world.write(self._context, values)

    def step(self, actuation: Array | None) -> Array:
        """Simulate one period and return the sensor values at its end, all signals concatenated.

        Args:
            actuation: Actuator commands, all signals concatenated; None holds the last ones.

        Raises:
            RuntimeError: The simulation failed.
        """
        if actuation is not None:
            for name, place in self._actuators.items():
                self._feed(name, actuation[place])
        self._simulator.AdvanceTo((self._now + 1) * self._period)
        self._now += 1
        return np.concatenate([port.Eval(self._context) for port in self._sensors])


def _age_in_periods(belief: BeliefRule, period: float) -> int:
    age = round(belief.age / period)
    if not isclose(age * period, belief.age, rel_tol=1e-6, abs_tol=1e-9):
        raise ValueError(
            f"the age of the belief about {belief.target}, {belief.age} s, must be a multiple of the period, {period} s"
        )
    return age

"""Samples of an instant are seen by the updates after it, whatever the kind of sensor and of update."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, LeafSystem, PortDataType

from tests.components.sensors.test_streams import KINDS, PERIOD, World, numbers, simulation

TICKS = 5
UPDATES = ("unrestricted", "discrete")


class Dps(LeafSystem):
    """Notes what it sees of all sensors at t = 0, T, 2 T, ..., by updates of one kind."""

    def __init__(self, sensors: dict[str, LeafSystem], update: str) -> None:
        super().__init__()
        self.fails = False
        self.seen: dict[str, list[np.ndarray]] = {name: [] for name in sensors}
        for name, sensor in sensors.items():
            port = sensor.get_output_port(0)
            if port.get_data_type() == PortDataType.kVectorValued:
                self.DeclareVectorInputPort(name, port.size())
            else:
                self.DeclareAbstractInputPort(name, port.Allocate())
        if update == "unrestricted":
            self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.0, self._note)
        else:
            self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._note)

    def _note(self, context: Context, state: Any) -> None:
        if self.fails:
            raise ArithmeticError
        for name, seen in self.seen.items():
            seen.append(numbers(self.GetInputPort(name).Eval(context)))


class Rig:
    """All kinds of sensors, between a DPS that is added before them and one that is added after them, of each kind."""

    def __init__(self) -> None:
        world = World()
        sensors = {make.__name__: make(world) for make in KINDS}
        self.readers = {}
        for order in ("before", "after"):
            if order == "after":
                for name, sensor in sensors.items():
                    world.builder.AddNamedSystem(name, sensor)
            for update in UPDATES:
                self.readers[order, update] = world.builder.AddNamedSystem(f"{order}_{update}", Dps(sensors, update))
        for reader in self.readers.values():
            for name, sensor in sensors.items():
                world.builder.Connect(sensor.get_output_port(0), reader.GetInputPort(name))
        self.sensors = sensors
        self.simulator: Simulator = simulation(world, list(sensors.values()))

    def shown(self, context: Context, name: str) -> np.ndarray:
        sensor = self.sensors[name]
        return numbers(sensor.get_output_port(0).Eval(sensor.GetMyContextFromRoot(context)))


@pytest.fixture(scope="module")
def recorded() -> tuple[Rig, dict[str, list[np.ndarray]]]:
    """A simulation, and what the sensors show between two instants: at first before t = 0."""
    rig = Rig()
    context = rig.simulator.get_context()
    rig.simulator.Initialize()
    shown = {name: [rig.shown(context, name)] for name in rig.sensors}
    for k in range(TICKS):
        rig.simulator.AdvanceTo((k + 0.5) * PERIOD)
        for name, values in shown.items():
            values.append(rig.shown(context, name))
    return rig, shown


@pytest.mark.parametrize("name", [make.__name__ for make in KINDS])
def test_updates_of_an_instant_see_the_sample_before(
    recorded: tuple[Rig, dict[str, list[np.ndarray]]], name: str
) -> None:
    rig, shown = recorded
    # Their noise is another one in every sample, so that old and new differ.
    assert all(not np.array_equal(old, new) for old, new in zip(shown[name][1:-1], shown[name][2:], strict=True))
    for reader in rig.readers.values():
        assert len(reader.seen[name]) == TICKS
        for seen, expected in zip(reader.seen[name], shown[name], strict=False):
            np.testing.assert_array_equal(seen, expected)


def test_what_is_seen_is_the_same_when_an_instant_is_repeated_after_an_error(
    recorded: tuple[Rig, dict[str, list[np.ndarray]]],
) -> None:
    rig, (_, shown) = Rig(), recorded
    rig.simulator.AdvanceTo(1.5 * PERIOD)
    reader = rig.readers["before", "discrete"]
    reader.fails = True
    with pytest.raises(ArithmeticError):
        rig.simulator.AdvanceTo(2.5 * PERIOD)
    reader.fails = False
    rig.simulator.Initialize(InitializeParams(suppress_initialization_events=True))
    rig.simulator.AdvanceTo(2.5 * PERIOD)
    for name in rig.sensors:
        np.testing.assert_array_equal(reader.seen[name][-1], shown[name][2])
        np.testing.assert_array_equal(rig.shown(rig.simulator.get_context(), name), shown[name][3])

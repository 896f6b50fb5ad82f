"""A signal that is one of an enumeration: other values are refused wherever they are set or received."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
import pytest
from drake import lcmt_scope

from tests.control.scripted import ScriptedBridge, ServoScenario
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.limits import Bounds
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.runtime import Runtime
from vtbdrake.lcm.lcm_bridge import ChannelReader
from vtbdrake.lcm.maps import vector_map
from vtbdrake.state.variables import VariableError
from vtbdrake.testbed import DpsAlone, Interface, Signal, SignalError, load_scenario


class Gear(IntEnum):
    REVERSE = -1
    IDLE = 0
    FIRST = 1


NAMES = r"-1 \(reverse\), 0 \(idle\), 1 \(first\)"


@dataclass
class GearScenario(ServoScenario):
    """The servo, whose two targets are gears."""

    def interface(self) -> Interface:
        return replace(super().interface(), commands=[Signal("target", size=2, values=Gear)])


def test_limits_are_those_of_the_values() -> None:
    signal = Signal("gear", size=1, values=Gear)
    assert (signal.lower, signal.upper) == (-1.0, 1.0)
    assert signal == pickle.loads(pickle.dumps(signal))
    assert Signal("gear", size=1, values=[3, 1.5], upper=4.0).upper == 4.0


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"values": []}, "finite numbers, at least one"),
        ({"values": 3}, "numbers, or an IntEnum, not 3"),
        ({"values": ["first"]}, "numbers, or an IntEnum"),
        ({"values": [0.0, np.nan]}, "finite numbers"),
        ({"values": Gear, "default": 0.5}, f"default 0.5 is not one of its values, {NAMES}"),
        ({"values": [1, 2], "idle": 1.5}, "idle 1.5 is not one of its values, 1, 2"),
    ],
)
def test_impossible_enumeration_is_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(SignalError, match=message):
        Signal("gear", size=1, **fields)


def test_command_needs_a_default_among_its_values() -> None:
    with pytest.raises(SignalError, match="command gear is one of 1, 2: give default=, which is 0 otherwise"):
        Interface(sense=[], act=[], commands=[Signal("gear", size=1, values=[1, 2])])


def test_choices_and_names_of_entries_are_those_of_the_command() -> None:
    signal = Signal("target", size=2, values=Gear, entry_names=["left", "right"])
    scenario = GearScenario()
    scenario.interface = lambda: replace(ServoScenario.interface(scenario), commands=[signal])  # type: ignore[method-assign]
    variable = DpsAlone(scenario).variables()["u.target"]
    assert variable.entry_names == ("left", "right")
    assert variable.choices == ((-1.0, "reverse"), (0.0, "idle"), (1.0, "first"))
    for names, message in (
        (["left"], "2 entries, but 1 entry_names"),
        ("ab", "are texts, not 'ab'"),
        ([1, 2], "texts"),
    ):
        with pytest.raises(SignalError, match=message):
            replace(signal, entry_names=names)


def test_abstract_signal_has_no_values() -> None:
    with pytest.raises(SignalError, match="only a vector has a values"):
        Signal("gear", model_value="text", values=Gear)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([0.0, 0.5], rf"u.target\[1\] is one of {NAMES}, not 0.5"),
        ([np.nextafter(1.0, 0.0), 0.0], rf"u.target\[0\] is one of {NAMES}, not 0.9999999999999999"),
        ([0.0, 2.0], r"u.target\[1\] must lie in \[-1, 1\]"),
    ],
)
@pytest.mark.parametrize("alone", [False, True])
def test_other_value_of_a_command_is_refused(alone: bool, value: list[float], message: str) -> None:
    scenario = GearScenario()
    target = DpsAlone(scenario) if alone else scenario.build()
    context, clock = target.default_context(), SimulatedClock()
    with pytest.raises(VariableError, match=message):
        target.write(context, {"u.target": value})
    target.write(context, {"u.target": [0.0, -1.0]})
    assert np.array_equal(target.read(context, "u.target"), [0.0, -1.0])
    runtime = Runtime(target, ScriptedBridge(target.interface, clock, lambda t: {}), period=0.001, clock=clock)
    with pytest.raises(VariableError, match=message):  # as the requests of live values do
        runtime.write({"u.target": value})


def test_entry_of_a_command_is_checked_too() -> None:
    target = DpsAlone(GearScenario())
    context = target.default_context()
    with pytest.raises(VariableError, match=rf"u.target\[1\] is one of {NAMES}, not 0.5"):
        target.write(context, {"u.target[1]": 0.5})


def test_other_value_in_a_message_is_rejected() -> None:
    signal = Signal("target", size=2, values=Gear)
    received = ReceivedSignal()
    reader = ChannelReader(
        vector_map("TARGET", lcmt_scope, {"target": "value"}), [signal], {"target": received}, 0.1, several_senders=True
    )
    for k, value in enumerate(([1.0, 0.0], [0.5, 0.0], [0.0, 2.0], [-1.0, 1.0]), start=1):
        message = lcmt_scope()
        message.utime, message.size, message.value = k, 2, value
        reader.receive("TARGET", message.encode())
    assert (received.count, received.value.tolist()) == (2, [-1.0, 1.0])
    assert received.rejected == {"values": 1, "limits": 1}


def test_values_are_part_of_the_bounds() -> None:
    assert Bounds(Signal("gear", size=1, values=Gear)) != Bounds(Signal("gear", size=1, lower=-1.0, upper=1.0))
    with pytest.raises(SignalError, match=f"signal gear is one of {NAMES}, not 0.5"):
        Signal("gear", size=1, values=Gear).check_value([0.5])


@pytest.mark.parametrize(
    ("scenario", "command", "count"),
    [
        ("manipulator:ManipulatorScenario", "motion", 5),
        ("satellite:SatelliteScenario", "capture", 3),
    ],
)
def test_commands_of_the_testbeds_are_enumerations(scenario: str, command: str, count: int) -> None:
    [signal] = [s for s in load_scenario(f"vtbdrake_diagrams.{scenario}").interface().commands if s.name == command]
    assert len(list(signal.values or ())) == count
    assert Bounds(signal).violation([0.5]) == "values" and Bounds(signal).violation(signal.default_vector()) == ""


def test_texts_are_no_values_of_a_signal():
    with pytest.raises(SignalError, match=r"signal force has 2 numbers, not \['1', '2'\]"):
        Signal("force", size=2).check_value(["1", "2"])

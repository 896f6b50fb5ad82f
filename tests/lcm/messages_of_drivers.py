"""Helpers of the tests of arm and gripper messages: bytes, and the values that Drake's receivers read in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.lcm import LcmSubscriberSystem

from vtbdrake.lcm.maps import LcmMap
from vtbdrake.testbed import Signal

Q, TAU = np.linspace(-1.0, 1.0, 7), np.arange(7.0) - 2.25


def weight(q: np.ndarray) -> np.ndarray:
    return 10.0 * np.cos(q)


def encode(map: LcmMap, values: Mapping[str, Any]) -> bytes:
    return map.encoder([Signal(name, size=len(values[name])) for name in map.signals])(values, 1_000_000)


def decode(map: LcmMap, data: bytes, size: int = 7) -> Mapping[str, Any]:
    return map.decoder([Signal(name, size=size) for name in map.signals])(data)[1]


def read_by_drake(receiver: System, message_type: Any, data: bytes, *ports: str) -> list[np.ndarray]:
    """Return the outputs of one of Drake's receivers after it has received a message."""
    builder, bus = DiagramBuilder(), DrakeLcm("memq://")
    subscriber = builder.AddSystem(LcmSubscriberSystem.Make("C", message_type, bus, use_cpp_serializer=True))
    builder.AddSystem(receiver)
    builder.Connect(subscriber.get_output_port(), receiver.get_input_port(0))
    simulator = Simulator(builder.Build())
    context = receiver.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    if receiver.num_input_ports() > 1:
        receiver.GetInputPort("position_measured").FixValue(context, np.zeros(7))
    bus.Publish("C", data)
    bus.HandleSubscriptions(0)
    simulator.AdvanceTo(0.1)
    return [receiver.GetOutputPort(port).Eval(context).tolist() for port in ports]

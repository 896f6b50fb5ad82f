"""A DPS commands a machine over UDP, and its fallback takes over when the machine falls silent."""

from __future__ import annotations

import socket
import threading
import time
from dataclasses import dataclass

import numpy as np
import pytest

import vtbdrake as vtb
from tests.diagrams.udp_end import UdpEnd
from vtbdrake.control import Zero
from vtbdrake.control.fault import FaultKind
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.udp_bridge import Address, UdpBridge

pytestmark = pytest.mark.one_python

PERIOD = 0.02


@dataclass
class CartPoleOverUdp(CartPoleScenario):
    """A cart-pole whose firmware speaks UDP."""

    def deployment(self) -> vtb.Deployment:
        return vtb.Deployment(period=PERIOD, guards={"fallback": {"force": Zero()}}, continuity={"force": None})


def addresses() -> tuple[Address, Address]:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second,
    ):
        first.bind(("127.0.0.1", 0))
        second.bind(("127.0.0.1", 0))
        return first.getsockname(), second.getsockname()


class Machine(threading.Thread):
    """Sends its state every few milliseconds, and keeps the commands that arrive."""

    def __init__(self, end: UdpEnd) -> None:
        super().__init__()
        self._end = end
        self.silent = threading.Event()
        self.forces: list[float] = []

    def run(self) -> None:
        self._end.open()
        while not self.silent.is_set():
            self._end.send({"joint_position": np.array([0.1, 0.2]), "joint_velocity": np.zeros(2)}, time.time())
            self.forces += [float(command["force"][0]) for command in self._end.receive(0.005)]
        self._end.close()


def test_dps_commands_a_machine_over_udp_until_it_falls_silent() -> None:
    scenario, (robot, firmware) = CartPoleOverUdp(), addresses()
    bridge = UdpBridge(scenario.interface(), robot, firmware)
    machine = Machine(UdpEnd(scenario.interface(), firmware, robot))
    dps = DpsAlone(scenario)
    context = dps.default_context()
    dps.write(context, {"u.plan": [0.0, *np.full(scenario.knots, 7.5)]})
    bridge.open()
    machine.start()
    try:
        with vtb.Deployment.of(scenario).runtime(dps, bridge, context=context) as runtime:
            runtime.take_over(timeout=60.0)
            runtime.run(seconds=60.0, until=lambda: 7.5 in machine.forces)
            assert np.array_equal(bridge.sensed["joint_position"].value, [0.1, 0.2])
            machine.silent.set()
            runtime.run(seconds=60.0, until=lambda: bool(runtime.guards.latched))
            assert runtime.guards.latched[0].kind in (FaultKind.STALE, FaultKind.MISSED)
    finally:
        machine.silent.set()
        machine.join()
        bridge.close()
    assert 7.5 in machine.forces and set(machine.forces) <= {0.0, 7.5}

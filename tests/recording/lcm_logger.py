"""A pendulum whose messages Drake's own LCM publishers fill, and LCM's own library logs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import lcm
from drake import lcmt_iiwa_command, lcmt_iiwa_status
from pydrake.lcm import DrakeLcm
from pydrake.manipulation import IiwaCommandSender, IiwaStatusSender
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.lcm import LcmPublisherSystem

from tests.calibration.pendulum import PendulumScenario
from vtbdrake.deployment import Deployment
from vtbdrake.lcm import Protocol, iiwa_command, iiwa_status
from vtbdrake.recording import Log

PERIOD = 0.004
BEGIN = 1_700_000_000_000_000
"""The time of the first event, in us since 1970."""


@dataclass
class LcmPendulum(PendulumScenario):
    """The pendulum, whose motor speaks as an iiwa."""

    def deployment(self) -> Deployment:
        protocol = Protocol(
            sense=[iiwa_status({"position": "joint_position_measured"})],
            act=[iiwa_command({"torque": "joint_torque"})],
        )
        return Deployment(protocol=protocol, period=PERIOD)


def _drake_publishers(bus: DrakeLcm) -> Diagram:
    """Return Drake's senders of the messages of an iiwa, whose ports are called CHANNEL.PORT."""
    builder = DiagramBuilder()
    for channel, sender, message in (
        ("IIWA_STATUS", IiwaStatusSender(1), lcmt_iiwa_status),
        ("IIWA_COMMAND", IiwaCommandSender(1), lcmt_iiwa_command),
    ):
        publisher = LcmPublisherSystem.Make(channel=channel, lcm_type=message, lcm=bus, use_cpp_serializer=True)
        builder.Connect(builder.AddSystem(sender).get_output_port(), builder.AddSystem(publisher).get_input_port())
        for i in range(sender.num_input_ports()):
            port = sender.get_input_port(i)
            builder.ExportInput(port, f"{channel}.{port.get_name()}")
    return builder.Build()


def write_log(path: Path, log: Log) -> Path:
    """Write a log of the pendulum as lcm-logger would, with messages on a channel that nobody maps in between."""
    bus = DrakeLcm("memq://")
    heard: list[tuple[str, bytes]] = []
    for channel in ("IIWA_STATUS", "IIWA_COMMAND"):
        bus.Subscribe(channel, partial(_hear, heard, channel))
    diagram = _drake_publishers(bus)
    context = diagram.CreateDefaultContext()
    events = lcm.EventLog(str(path), "w", overwrite=True)
    position, torque = log.sense["position"], log.act["torque"]
    for time, q, tau in zip(position.times, position.values, torque.values, strict=True):
        context.SetTime(time)
        for i in range(diagram.num_input_ports()):
            port = diagram.get_input_port(i)
            kind = port.get_name().partition(".")[2].partition("_")[0]
            port.FixValue(context, {"torque": tau, "time": [time]}.get(kind, q))
        diagram.ForcedPublish(context)
        bus.HandleSubscriptions(0)
        for channel, data in [*heard, ("CAMERA", b"picture")]:
            events.write_event(BEGIN + round(1e6 * time), channel, data)
        heard.clear()
    events.close()
    return path


def _hear(heard: list[tuple[str, bytes]], channel: str, data: bytes) -> None:
    heard.append((channel, data))

"""The loop as one builds it of Drake's own parts: LCM systems, and the simulator held back to real time."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from drake import lcmt_force_torque, lcmt_iiwa_command, lcmt_iiwa_status
from pydrake.common.value import Value
from pydrake.lcm import DrakeLcm
from pydrake.manipulation import IiwaCommandSender, IiwaControlMode, IiwaStatusReceiver
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem
from pydrake.systems.lcm import LcmInterfaceSystem, LcmPublisherSystem, LcmSubscriberSystem
from pydrake.systems.primitives import ConstantVectorSource, Gain

from vtbdrake.testbed import Scenario
from vtbdrake_diagrams.manipulator.arm import JOINTS
from vtbdrake_diagrams.manipulator.motions import Motion

FIRST_MESSAGE = 5.0  # s to wait for


class _Wrench(LeafSystem):
    """Takes a message apart.

    .. pydrake_system::

        name: _Wrench
        input_ports:
        - message
        output_ports:
        - wrench
    """

    def __init__(self) -> None:
        super().__init__()
        self._message = self.DeclareAbstractInputPort("message", Value(lcmt_force_torque()))
        self.DeclareVectorOutputPort("wrench", 6, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        m: Any = self._message.Eval(context)
        output.SetFromVector([m.tx, m.ty, m.tz, m.fx, m.fy, m.fz])


class DrakeLoop:
    """The DPS of the manipulator between an `LcmSubscriberSystem` for each channel and an `LcmPublisherSystem`.

    It commands the machine only in `run`: its first one initializes the simulator, which publishes a command. Earlier,
    that command would move the machine under another loop that is about to take over.
    """

    def __init__(self, scenario: Scenario, url: str, *, period: float) -> None:
        self._period = period
        builder = DiagramBuilder()
        bus = builder.AddSystem(LcmInterfaceSystem(DrakeLcm(url)))
        dps = builder.AddSystem(scenario.make_dps())
        status = builder.AddSystem(
            LcmSubscriberSystem.Make(
                "IIWA_STATUS",
                lcmt_iiwa_status,
                bus,
                use_cpp_serializer=True,
                wait_for_message_on_initialization_timeout=FIRST_MESSAGE,
            )
        )
        arm = builder.AddSystem(IiwaStatusReceiver(JOINTS))
        builder.Connect(status.get_output_port(), arm.get_input_port())
        wrench = builder.AddSystem(
            LcmSubscriberSystem.Make(
                "WRENCH", lcmt_force_torque, bus, wait_for_message_on_initialization_timeout=FIRST_MESSAGE
            )
        )
        vector = builder.AddSystem(_Wrench())
        builder.Connect(wrench.get_output_port(), vector.get_input_port())
        motion = builder.AddSystem(ConstantVectorSource([float(Motion.HOME)]))
        torque = builder.AddSystem(Gain(-1.0, JOINTS))  # An iiwa sends its measured torques with the opposite sign.
        builder.Connect(arm.GetOutputPort("torque_measured"), torque.get_input_port())
        for port, signal in (
            (arm.GetOutputPort("position_measured"), "joint_position"),
            (arm.GetOutputPort("velocity_estimated"), "joint_velocity"),
            (torque.get_output_port(), "joint_torque_measured"),
            (vector.get_output_port(), "wrench"),
            (motion.get_output_port(), "motion"),
        ):
            builder.Connect(port, dps.GetInputPort(signal))
        sender = builder.AddSystem(IiwaCommandSender(JOINTS, IiwaControlMode.kTorqueOnly))
        builder.Connect(dps.GetOutputPort("joint_torque"), sender.GetInputPort("torque"))
        command = builder.AddSystem(
            LcmPublisherSystem.Make(
                "IIWA_COMMAND", lcmt_iiwa_command, bus, use_cpp_serializer=True, publish_period=period
            )
        )
        builder.Connect(sender.get_output_port(), command.get_input_port())
        self._simulator = Simulator(builder.Build())
        self._simulator.set_target_realtime_rate(1.0)
        self._initialized = False

    def run(self, cycles: int, *, warm_up: int) -> np.ndarray:
        """Return the times from each deadline to the end of its cycle, in seconds, shape (cycles,).

        Late cycles are not left out: the loop catches up."""
        simulator = self._simulator
        if not self._initialized:
            simulator.Initialize()  # This waits for messages, and publishes.
            self._initialized = True
        ends: list[tuple[float, float]] = []

        def watch(context: Context) -> None:
            ends.append((context.get_time(), time.monotonic()))

        simulator.ResetStatistics()
        first = simulator.get_context().get_time()
        count = round(first / self._period)
        begin = time.monotonic()
        simulator.set_monitor(watch)
        simulator.AdvanceTo((count + warm_up + cycles) * self._period)
        simulator.clear_monitor()
        times, walls = np.array(ends).T
        # A step begins when the wall has come to its time, and its commands are there when it ends, a period further.
        lateness = (walls - begin) - (times - self._period - first)
        return lateness[-cycles:]

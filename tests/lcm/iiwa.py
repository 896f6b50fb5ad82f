"""A KUKA iiwa under torque or position control: a testbed whose world has Drake's simulated driver, and its deployment.

Its model has the names and the kinematics of Drake's iiwa 14, and plausible masses.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.manipulation import IiwaDriver
from pydrake.multibody.parsing import (
    LoadModelDirectivesFromString,
    ModelDirective,
    ModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import Context
from pydrake.systems.primitives import PassThrough

from vtbdrake.control.fallback import Brake, Fallback, Hold, gravity_compensation
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.station.hardware_sim import HardwareSimScenario
from vtbdrake.testbed import Interface, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.station import FILE

PERIOD = 0.005
"""The period in s in which Drake's driver publishes its status, and of the DPS."""
JOINTS = 7
HOME = np.array([0.0, 0.6, 0.0, -1.2, 0.0, 1.0, 0.0])
STIFFNESS = np.array([300.0, 300.0, 200.0, 200.0, 50.0, 40.0, 10.0])
DAMPING = np.array([30.0, 30.0, 20.0, 20.0, 3.0, 2.0, 0.3])
SPEED = 0.2
"""The speed in rad/s at which the reference follows its target."""
TORQUE_RATE, ACCELERATION = 500.0, 0.5
"""The limits of the commands, in N m/s and rad/s^2."""

TORQUE, POSITION = "torque_only", "position_only"

_FOLDER = Path(__file__).parent / "models"
_IIWA = FILE.with_name("models") / "iiwa14.urdf"
DIRECTIVES = f"""
directives:
- add_model:
    name: iiwa
    file: file://{_IIWA}
    default_joint_positions: {{ {", ".join(f"iiwa_joint_{k + 1}: [{q}]" for k, q in enumerate(HOME))} }}
- add_weld: {{ parent: world, child: "iiwa::iiwa_link_0" }}
- add_model: {{ name: hand, file: "file://{_FOLDER}/hand.urdf" }}
- add_weld: {{ parent: "iiwa::iiwa_link_7", child: "hand::hand" }}
"""


def directives() -> list[ModelDirective]:
    return list(LoadModelDirectivesFromString(DIRECTIVES).directives)


def arm_plant() -> MultibodyPlant:
    """Return a plant of the arm with its hand alone, as a DPS models them."""
    plant = MultibodyPlant(0.0)
    ProcessModelDirectives(ModelDirectives(directives=directives()), Parser(plant))
    plant.Finalize()
    return plant


class Impedance(AddressedSystem):
    """Torques on top of the gravity compensation of an arm, or positions, which follow a target.

    .. pydrake_system::

        name: Impedance
        input_ports:
        - (the sensor signals)
        - target
        output_ports:
        - joint_torque (or joint_position_command)

    The reference r moves to the target at `SPEED`; ``joint_torque`` is K (r - q) - D v, ``joint_position_command`` r.
    """

    def __init__(self, interface: Interface) -> None:
        super().__init__()
        (command,) = interface.act
        for signal in (*interface.sense, *interface.commands):
            self.DeclareVectorInputPort(signal.name, JOINTS)
        self._reference = self.declare_discrete_state(reference=Quantity(HOME, "rad"))
        self._torque = self.declare_discrete_state(torque=Quantity(np.zeros(JOINTS), "N m"))
        shown = self._torque if command.name == "joint_torque" else self._reference
        self.DeclareStateOutputPort(command.name, shown.index)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context: Context, discrete: Any) -> None:
        q, v, target = (
            self.GetInputPort(name).Eval(context) for name in ("joint_position", "joint_velocity", "target")
        )
        before = self._reference.view(context).reference
        reference = before + np.clip(target - before, -SPEED * PERIOD, SPEED * PERIOD)
        self._reference.mutable(discrete).reference = reference
        self._torque.mutable(discrete).torque = STIFFNESS * (reference - q) - DAMPING * v


@dataclass
class IiwaScenario(HardwareSimScenario):
    """The arm in torque mode, or in position mode."""

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: MultibodyPlantConfig(time_step=0.001))
    directives: list[ModelDirective] = field(default_factory=directives)
    mode: str = TORQUE

    def __post_init__(self) -> None:
        self.model_drivers = {"iiwa": IiwaDriver(control_mode=self.mode, hand_model_name="hand")}

    def interface(self) -> Interface:
        def sensor(name: str, unit: str) -> Signal:
            return Signal(name, size=JOINTS, unit=unit, max_age=0.05)

        sense = [
            sensor("joint_position", "rad"),
            sensor("joint_velocity", "rad/s"),
            sensor("joint_torque_measured", "N m"),
            sensor("joint_torque_commanded", "N m"),
            sensor("joint_torque_external", "N m"),
            sensor("joint_position_commanded", "rad"),
        ]
        if self.mode == TORQUE:
            effort = np.array([320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0])
            sense += [sensor("joint_torque_added", "N m")]
            act = Signal(
                "joint_torque", size=JOINTS, unit="N m", lower=-effort, upper=effort, rate=TORQUE_RATE, idle=0.0
            )
        else:
            act = Signal(
                "joint_position_command",
                size=JOINTS,
                unit="rad",
                lower=-2.9,
                upper=2.9,
                rate=1.0,
                acceleration=ACCELERATION,
                idle=HOME,
            )
        return Interface(sense=sense, act=[act], commands=[Signal("target", size=JOINTS, unit="rad", default=HOME)])

    def make_dps(self) -> Impedance:
        return Impedance(self.interface())

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        driver = self.add_drivers(builder, self.add_models(builder))["iiwa"]
        builder.sim_sensor("joint_position", driver.GetOutputPort("position_measured"))
        builder.sim_sensor("joint_velocity", driver.GetOutputPort("velocity_estimated"))
        for name in ("torque_measured", "torque_commanded", "torque_external", "position_commanded"):
            builder.sim_sensor(f"joint_{name}", driver.GetOutputPort(name))
        if self.mode == TORQUE:
            added = builder.add("act", "added", PassThrough(np.zeros(JOINTS)))
            builder.sim_actuator("joint_torque", added.get_input_port())
            builder.connect(added.get_output_port(), driver.GetInputPort("torque"))
            builder.sim_sensor("joint_torque_added", added.get_output_port())
        else:
            builder.sim_actuator("joint_position_command", driver.GetInputPort("position"))

    def deployment(self) -> Deployment:
        fields = {
            "joint_position": "joint_position_measured",
            "joint_velocity": "joint_velocity_estimated",
            "joint_torque_measured": "joint_torque_measured",
            "joint_torque_commanded": "joint_torque_commanded",
            "joint_torque_external": "joint_torque_external",
            "joint_position_commanded": "joint_position_commanded",
        }
        fallback: Fallback
        if self.mode == TORQUE:
            command, sensor, fallback = "joint_torque", "joint_torque_added", Brake("joint_velocity", gain=DAMPING)
            on_top = {"joint_torque_added": "joint_torque_measured", "joint_torque_reported": "joint_torque_commanded"}
            reported = {"joint_torque": "joint_torque_reported"}
            status = iiwa_status(fields, on_top=on_top, gravity=gravity_compensation(arm_plant()))
            act = iiwa_command(["joint_torque"])
        else:
            command, sensor, fallback = "joint_position_command", "joint_position_commanded", Hold()
            status, reported = iiwa_status(fields), {}
            act = iiwa_command({command: "joint_position"})
        return Deployment(
            protocol=Protocol(sense=[status], act=[act], reported=reported),
            period=PERIOD,
            guards={"fallback": {command: fallback}},
            continuity={command: sensor},  # as far as the rate allows in a period: 2.5 N m, 0.005 rad
        ).in_lock_step("joint_position")

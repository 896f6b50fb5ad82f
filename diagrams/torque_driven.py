"""Links on motors that take torques: the testbeds of recorded pendulums."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import PassThrough, ZeroOrderHold

from vtbdrake.common.settings import setting
from vtbdrake.components.actuators import JointDrives
from vtbdrake.components.sensors import ErrorModel, JointEncoders
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import RevoluteJoint


def _continuous() -> MultibodyPlantConfig:
    return MultibodyPlantConfig(time_step=0.0)


@dataclass
class TorqueDrivenScenario(Scenario):
    """A chain of links on motors, whose torques are the command u; a subclass adds the links.

    Attributes:
        size: Class attribute of a subclass: the number of motors.
    """

    size: ClassVar[int]

    plant_config: MultibodyPlantConfig = field(default_factory=_continuous)
    period: float = setting(0.002, "The sample period of sensors, DPS and drives.", unit="s", gt=0)
    torque_limit: float = setting(10.0, "The largest torque of a motor.", unit="N m", gt=0)
    viscous: float = setting(1e-3, "Viscous friction of each drive.", unit="N m s/rad", ge=0)
    coulomb: float = setting(0.1, "Coulomb friction of each drive.", unit="N m", ge=0)
    errors: ErrorModel = field(default_factory=ErrorModel)

    def interface(self) -> Interface:
        size, limit = self.size, self.torque_limit
        torque = {"size": size, "unit": "N m", "lower": -limit, "upper": limit}
        return Interface(
            sense=[Signal("joint_position", size=size, unit="rad", lower=-100.0, upper=100.0, max_age=5 * self.period)],
            act=[Signal("torque", idle=0.0, **torque)],
            commands=[Signal("torques", **torque)],
        )

    def make_dps(self) -> Diagram:
        """Return a DPS that commands the torques that the command u asks for."""
        builder = DiagramBuilder()
        sense = builder.AddNamedSystem("sense", PassThrough(self.size))
        impl = builder.AddNamedSystem("impl", ZeroOrderHold(self.period, self.size))
        builder.ExportInput(sense.get_input_port(), "joint_position")
        builder.ExportInput(impl.get_input_port(), "torques")
        builder.ExportOutput(impl.get_output_port(), "torque")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(self.plant_config)
        joints = self.add_links(plant)
        plant.Finalize()
        builder.add_sensor("joint_position", JointEncoders(plant, joints, period=self.period, errors=self.errors))
        drives = JointDrives(
            plant, joints, period=self.period, limit=self.torque_limit, viscous=self.viscous, coulomb=self.coulomb,
            coulomb_velocity=0.02,
        )  # fmt: skip
        builder.add("act", "drives", drives)
        builder.connect(plant.get_state_output_port(), drives.GetInputPort("state"))
        builder.connect(drives.get_output_port(), plant.get_actuation_input_port())
        builder.sim_actuator("torque", drives.GetInputPort("command"))

    @abstractmethod
    def add_links(self, plant: MultibodyPlant) -> list[RevoluteJoint]:
        """Add the links and their motors, and return the joints; all angles are 0 where the links hang down."""

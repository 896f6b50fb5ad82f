"""A driven pendulum with a known truth, simulated by Drake, under a disturbance that no log contains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.multibody.tree import RevoluteJoint, RotationalInertia, SpatialInertia
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import PassThrough, ZeroOrderHold

from vtbdrake.components.actuators import JointDrives
from vtbdrake.components.sensors import JointEncoders
from vtbdrake.recording import DrivenScenario, Log, read_table
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PERIOD = 0.004
ARM = "sim.sys.pendulum"
DRIVES = "sim.act.drives"
MASS = f"{ARM}.link.mass"
COULOMB = f"{DRIVES}.coulomb[0]"


@dataclass
class PendulumScenario(Scenario):
    """A link on one motor."""

    time_step: float = 0.0
    mass: float = 1.0
    coulomb_velocity: float = 0.05

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("position", size=1, unit="rad")],
            act=[Signal("torque", size=1, unit="N m", lower=-20.0, upper=20.0, idle=0.0)],
        )

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        sense = builder.AddNamedSystem("sense", PassThrough(1))
        impl = builder.AddNamedSystem("impl", ZeroOrderHold(PERIOD, 1))
        builder.ExportInput(sense.get_input_port(), "position")
        builder.Connect(sense.get_output_port(), impl.get_input_port())
        builder.ExportOutput(impl.get_output_port(), "torque")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=self.time_step, use_sampled_output_ports=False))
        instance = plant.AddModelInstance("pendulum")
        inertia = SpatialInertia.MakeFromCentralInertia(
            self.mass, [0.0, 0.0, -0.3], RotationalInertia(0.02, 0.02, 0.02)
        )
        link = plant.AddRigidBody("link", instance, inertia)
        joint = plant.AddJoint(RevoluteJoint("pivot", plant.world_frame(), link.body_frame(), [0.0, 1.0, 0.0]))
        plant.AddJointActuator("motor", joint, 20.0)
        plant.Finalize()
        builder.add_sensor("position", JointEncoders(plant, [joint], period=PERIOD))
        drives = JointDrives(
            plant,
            [joint],
            period=PERIOD,
            coulomb=0.1,
            coulomb_velocity=self.coulomb_velocity,
            viscous=0.01,
            max_delay=8,
        )
        builder.add("act", "drives", drives)
        builder.connect(plant.get_state_output_port(), drives.GetInputPort("state"))
        builder.connect(drives.get_output_port(), plant.get_actuation_input_port())
        builder.sim_actuator("torque", drives.GetInputPort("command"))


def recorded(
    truth: Mapping[str, ArrayLike],
    seed: int,
    *,
    seconds: float = 8.0,
    noise: float = 2e-4,
    disturbance: float = 0.0,
    scenario: PendulumScenario | None = None,
    noise_seed: int | None = None,
) -> Log:
    """Return noisy positions of the true pendulum, and the torques without the disturbance."""
    generator = np.random.default_rng(seed)
    times = PERIOD * np.arange(round(seconds / PERIOD))
    waves = [
        generator.uniform(0.5, 1.5)
        * np.sin(2.0 * np.pi * generator.uniform(0.1, 2.0) * times + generator.uniform(0.0, 6.0))
        for _ in range(4)
    ]
    torque = np.sum(waves, axis=0) * (1.0 - np.exp(-times / 0.1))
    decay, walk = np.exp(-PERIOD / 0.05), np.zeros(times.size)
    for k in range(1, times.size):
        walk[k] = decay * walk[k - 1] + np.sqrt(1.0 - decay**2) * generator.normal()
    acting = read_table({"time": times, "u": torque + disturbance * walk}, sense={}, act={"torque": "u"})
    testbed = DrivenScenario(scenario=scenario or PendulumScenario(), log=acting, period=PERIOD).build()
    context = testbed.default_context()
    testbed.write(context, truth)
    simulator, positions = testbed.simulator(context), []
    for time in times:
        simulator.AdvanceTo(time)
        positions.append(float(testbed.read(context, f"{ARM}.pivot.position")))
    if noise_seed is not None:
        generator = np.random.default_rng(noise_seed)
    measured = np.array(positions) + noise * generator.normal(size=times.size)
    return read_table({"time": times, "q": measured, "u": torque}, sense={"position": "q"}, act={"torque": "u"})

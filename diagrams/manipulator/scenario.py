"""The manipulator testbed: a seven-joint arm under torque control, in free space and against a compliant wall."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from drake import lcmt_force_torque, lcmt_scope
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Diagram

from vtbdrake.common.settings import setting
from vtbdrake.components.actuators import JointDrives
from vtbdrake.components.sensors import (
    ErrorModel,
    ForceTorqueSensor,
    JointEncoders,
    JointTachometers,
    JointTorqueSensors,
)
from vtbdrake.control.bridge import acts_idle
from vtbdrake.control.robot_mode import RobotMode
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.maps import VectorMap, vector_map
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.monitoring.residuals import ResidualConfig
from vtbdrake.testbed import (
    Interface,
    Scenario,
    ScenarioError,
    Signal,
    VirtualTestbedBuilder,
)
from vtbdrake.testbed.hand_command import HAND_SIZE, HandCommand
from vtbdrake_diagrams.manipulator import leading
from vtbdrake_diagrams.manipulator.arm import JOINT_NAMES, JOINTS, Arm
from vtbdrake_diagrams.manipulator.dps import gravity_torque, make_dps
from vtbdrake_diagrams.manipulator.dynamics import ArmDynamics
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.manipulator.safety import CONTINUITY, JUMP_TOLERANCE, arm_fallback

LARGEST_DELAY = 50
"""The largest latency of commands to the drives, in periods."""

KNOWN_TOOL = {"sim.sys.arm.tool.mass": "dps.tool.mass", "sim.sys.arm.tool.center_of_mass": "dps.tool.center"}
"""The DPS's variables about its tool, by the variable of the simulated world."""

HAND_REACH = 2.0
"""The largest coordinate of a position that a hand may command (m)."""

HAND_MAX_AGE = 0.1
"""The age at which the last pose of a hand that leads is given up (s)."""


MODE_PERIOD = 0.005
"""The time between two messages of the arm's mode (s)."""


def _hand_map() -> VectorMap:
    return vector_map("ARM_HAND", lcmt_scope, {"hand": "value"})


def _plant() -> MultibodyPlantConfig:
    # Unsampled: reaction forces follow from the state, so that copies of it continue with the same readings.
    return MultibodyPlantConfig(time_step=0.001, contact_model="point", use_sampled_output_ports=False)


@dataclass
class ManipulatorScenario(Scenario):
    """A torque-controlled arm; the command ``u.motion`` chooses what it does, the gains are ``dps.impl.*``."""

    # Discrete: reaction forces and contact of the same step.
    plant_config: MultibodyPlantConfig = field(default_factory=_plant)
    law: str = setting("cartesian_impedance", "The control law.", choices=tuple(LAWS))
    period: float = setting(0.001, "The sample period of sensors, DPS and drives.", unit="s", gt=0.0)
    compile: bool = setting(
        True, "Whether to compile the arithmetic of the DPS if there is a C compiler; the results are the same."
    )
    knows_tool: bool = setting(
        False, "Whether mass and centre of the tool in mental rollouts and predictions are dps.tool's."
    )
    led_by_hand: bool = setting(False, "Whether a hand may lead the tip, by the command u.hand, while u.motion is led.")
    wall: bool = setting(False, "Whether there is a wall; False is free space.")
    wall_distance: float = setting(
        0.825,
        "The distance of the wall's face from the world's origin along x; sim.env.wall.mount.pose moves it.",
        unit="m",
    )
    wall_stiffness: float = setting(10e3, "The stiffness of the wall's face.", unit="N/m", gt=0.0)
    wall_dissipation: float = setting(5.0, "The dissipation of the wall, after Hunt and Crossley.", unit="s/m", ge=0.0)
    wall_friction: float = setting(0.1, "The static and dynamic friction coefficient of ball and wall.", ge=0.0)
    # Errors of the sensors, exact by default; latency in periods.
    position_errors: ErrorModel = field(default_factory=ErrorModel)
    velocity_errors: ErrorModel = field(default_factory=ErrorModel)
    torque_errors: ErrorModel = field(default_factory=ErrorModel)
    wrench_errors: ErrorModel = field(default_factory=ErrorModel)

    def validate(self) -> None:
        super().validate()
        if not self.plant_config.time_step > 0.0:
            raise ScenarioError(
                "ManipulatorScenario.plant_config.time_step must be a number above 0 s, not "
                f"{self.plant_config.time_step!r}: the testbed is discrete"
            )

    def interface(self) -> Interface:
        arm = Arm()
        age = 10 * self.period
        margin = np.radians(5.0)  # joints run a little into their stops
        return Interface(
            sense=[
                Signal(
                    "joint_position",
                    size=JOINTS,
                    unit="rad",
                    lower=arm.lower - margin,
                    upper=arm.upper + margin,
                    rate=2.0 * arm.speeds,
                    max_age=age,
                ),
                Signal("joint_velocity", size=JOINTS, unit="rad/s", lower=-10.0, upper=10.0, rate=1e3, max_age=age),
                # Impacts are fast: for torque and wrench, the limits exclude only impossible values.
                Signal("joint_torque_measured", size=JOINTS, unit="N m", lower=-1e3, upper=1e3, rate=1e5, max_age=age),
                Signal("wrench", size=6, unit="N m, N", lower=-2e3, upper=2e3, rate=1e5, max_age=age),
            ],
            act=[
                Signal(
                    "joint_torque",
                    size=JOINTS,
                    unit="N m",
                    lower=-np.array(arm.torques),
                    upper=arm.torques,
                    rate=arm.torque_rates,
                    idle=0.0,
                )
            ],
            commands=self._commands(),
        )

    def _commands(self) -> list[Signal]:
        motions = [motion for motion in Motion if self.led_by_hand or motion != Motion.LED]
        motion = Signal("motion", size=1, values=motions, default=int(Motion.HOME))
        if not self.led_by_hand:
            return [motion]
        reach = np.array([1.0, 1.0, 1.0, 1.0, 1.0, *(3 * [HAND_REACH])])
        hand = Signal(
            "hand",
            size=HAND_SIZE,
            unit="1, 1, 1, 1, 1, m, m, m",
            lower=-reach,
            upper=reach,
            default=leading.REST,
            max_age=HAND_MAX_AGE,
        )
        return [motion, hand]

    def hand_command(self) -> HandCommand | None:
        """Return how a hand leads the tip: in a box in front of the arm, under the motion `led`."""
        if not self.led_by_hand:
            return None
        return HandCommand(
            command="hand",
            pose="dps.impl.tip_pose",
            begin={"motion": int(Motion.LED)},
            ready={"dps.impl.motion": int(Motion.LED)},
            stand=(-0.7, 0.0, 0.0),
            lower=(0.25, -0.5, 0.1),
            upper=(0.85, 0.5, 1.0),
        )

    def deployment(self) -> Deployment:
        """Return how the DPS runs on the arm: it answers each state at once; after a fault, the arm floats in place.

        The arm speaks the messages of an iiwa, with their signs, but does not compensate gravity: its command is the
        whole torque. It publishes the wrench at its flange, and 200 times per second on ARM_MODE whether it takes
        commands (see `RobotMode`): its own stop blocks them. ARM_MOTION chooses the motion, ARM_HAND leads the tip.
        """
        status = {
            "joint_position": "joint_position_measured",
            "joint_velocity": "joint_velocity_estimated",
            "joint_torque_measured": "joint_torque_measured",
            "joint_torque_reported": "joint_torque_commanded",
        }
        wrench = {"wrench": ("tx", "ty", "tz", "fx", "fy", "fz")}
        return Deployment(
            protocol=Protocol(
                sense=[
                    vector_map("ARM_MODE", lcmt_scope, {"arm_mode": "value"}),
                    iiwa_status(status),
                    vector_map("WRENCH", lcmt_force_torque, wrench, stamp="timestamp"),
                ],
                act=[iiwa_command(["joint_torque"])],
                commands=[
                    vector_map("ARM_MOTION", lcmt_scope, {"motion": "value"}),
                    *([_hand_map()] if self.led_by_hand else []),
                ],
                reported={"joint_torque": "joint_torque_reported"},
                robot_mode=RobotMode(carrier="arm_mode", max_cycles=max(10, round(5.0 * MODE_PERIOD / self.period))),
                periods={"ARM_MODE": max(MODE_PERIOD, self.period)},
            ),
            period=self.period,
            guards={"fallback": arm_fallback(), "jump_tolerance": JUMP_TOLERANCE},
            continuity=CONTINUITY,
            hint=f"set u.motion to {Motion.FOLLOW} (follow), by which the reference is where the arm is; "
            "home comes after it",
            released_by=acts_idle({"joint_torque": 0.0}),  # The arm has braked.
            pace="wrench",  # It is in the last message of the arm's cycle.
            residuals=ResidualConfig(
                scenario=self._without_chance(),
                period=self.period,
                tolerance={
                    "sense.joint_position": 1e-6,
                    "sense.joint_velocity": 1e-4,
                    "sense.joint_torque_measured": 0.02,
                    "sense.wrench": 0.02,
                    "act.joint_torque": 0.02,
                },
            ),
        )

    def _without_chance(self) -> ManipulatorScenario:
        """Return this scenario with sensors without random errors, as predictions need it."""
        names = ("position_errors", "velocity_errors", "torque_errors", "wrench_errors")
        return replace(self, **{name: getattr(self, name).without_chance() for name in names})

    def make_dps(self) -> Diagram:
        return make_dps(
            self.law,
            period=self.period,
            compile=self.compile,
            knows_tool=self.knows_tool,
            led_by_hand=self.led_by_hand,
        )

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        # Imported here: the DPS on the robot runs without a plant.
        from vtbdrake_diagrams.manipulator.world import Push, add_arm, add_wall, set_ball_material

        arm = Arm()
        plant, scene_graph = builder.add_plant(self.plant_config)
        instance = add_arm(plant, arm)
        if self.wall:
            add_wall(
                plant,
                distance=self.wall_distance,
                stiffness=self.wall_stiffness,
                dissipation=self.wall_dissipation,
                friction=self.wall_friction,
            )
        plant.Finalize()
        set_ball_material(plant, scene_graph, instance, self.wall_friction)

        joints = [plant.GetJointByName(name, instance) for name in JOINT_NAMES]
        flange = plant.GetJointByName("flange", instance)
        T = self.period
        builder.add_sensor("joint_position", JointEncoders(plant, joints, period=T, errors=self.position_errors))
        builder.add_sensor("joint_velocity", JointTachometers(plant, joints, period=T, errors=self.velocity_errors))
        weight = gravity_torque(ArmDynamics(arm))
        # What the arm measures before its first cycle is what a controller has to continue.
        builder.add_sensor(
            "joint_torque_measured",
            JointTorqueSensors(plant, joints, period=T, initial=weight, errors=self.torque_errors),
        )
        builder.add_sensor("wrench", ForceTorqueSensor(plant, flange, period=T, errors=self.wrench_errors))

        drives = JointDrives(
            plant,
            joints,
            period=T,
            limit=arm.torques,
            rate=arm.torque_rates,
            time_constant=arm.current_time_constant,
            viscous=arm.viscous_friction,
            coulomb=arm.coulomb_friction,
            max_delay=LARGEST_DELAY,
            initial=weight,
        )
        builder.add("act", "drives", drives)
        builder.connect(plant.get_state_output_port(), drives.GetInputPort("state"))
        builder.connect(drives.get_output_port(), plant.get_actuation_input_port(instance))
        builder.sim_actuator("joint_torque", drives.GetInputPort("command"))

        if self.knows_tool:
            for variable, address in KNOWN_TOOL.items():
                builder.believe(variable, of=[address])

        push = builder.add("env", "push", Push(plant, "tip"))
        builder.connect(push.get_output_port(), plant.get_applied_spatial_force_input_port())
        for value, errors in (("position", self.position_errors), ("velocity", self.velocity_errors)):
            targets = [f"sim.sys.arm.{name}.{value}" for name in JOINT_NAMES]
            builder.believe(targets, of=[f"dps.env.joint_{value}"], age=(1 + errors.latency) * T)

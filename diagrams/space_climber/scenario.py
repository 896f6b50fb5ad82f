"""The SpaceClimber testbed: a six-legged robot with an attachment at its front, walking on the moon."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Box, DefaultProximityProperties, SceneGraphConfig
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Diagram
from pydrake.systems.primitives import MatrixGain

from vtbdrake.common.settings import setting
from vtbdrake.components.sensors import ContactSensor, Imu, JointEncoders
from vtbdrake.state.systems import pose_later
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.space_climber.dps import make_dps
from vtbdrake_diagrams.space_climber.gait import GAITS
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import (
    DEFAULT_FRICTION,
    FOOT_LINKS,
    JOINT_NAMES,
    LEGS,
    LUNAR_GRAVITY,
    Morphology,
)
from vtbdrake_diagrams.space_climber.plant import add_climber, add_payload, set_foot_friction

JOINTS = len(JOINT_NAMES)

IMU_RANGE = np.repeat([35.0, 160.0], 3)
"""What a common MEMS IMU measures at most: 2000 deg/s and 16 g, in rad/s and m/s^2."""


def _cenic() -> SimulatorConfig:
    # Chosen by the convergence study that the benchmark `rollout_rtf` prints. The samples of the DPS end every step, so
    # that the largest step only has to be longer than their period.
    return SimulatorConfig(integration_scheme="cenic", max_step_size=0.025, accuracy=1e-3)


def _continuous() -> MultibodyPlantConfig:
    return MultibodyPlantConfig(time_step=0.0, contact_model="point", stiction_tolerance=1e-3)


@dataclass
class SpaceClimberScenario(Scenario):
    """A six-legged robot on a plane; the address ``sim.sys.payload.mass`` is the mass attached to its front."""

    simulator_config: SimulatorConfig = field(default_factory=_cenic)
    # Contact is between point feet and a plane. A continuous plant is for CENIC; its joints cannot be locked.
    plant_config: MultibodyPlantConfig = field(default_factory=_continuous)
    gravity: float = setting(LUNAR_GRAVITY, "Acceleration of free fall.", unit="m/s^2", gt=0.0)
    slope_deg: float = setting(
        0.0,
        "The ground falls in the direction of x, in which the robot looks, by this angle; uphill it is negative.",
        unit="deg",
        ge=-45.0,
        le=45.0,
    )
    friction: float = setting(DEFAULT_FRICTION, "Static and dynamic friction of feet and ground.", ge=0.0)
    gait: str = setting("tripod", "The gait.", choices=tuple(GAITS))
    period: float = setting(
        0.02, "Period of sensors and DPS; every sample ends a step of the integrator.", unit="s", gt=0.0
    )
    payload: bool = setting(True, "Whether the attachment is there.")
    joint_stops: bool = setting(
        False,
        "Whether the joints stop at the ends of their ranges, which the DPS's commands never exceed; half as fast.",
    )

    def interface(self) -> Interface:
        m = Morphology()
        return Interface(
            sense=[
                Signal("imu", size=6, unit="rad/s, m/s^2", lower=-IMU_RANGE, upper=IMU_RANGE, max_age=5 * self.period),
                Signal("joint_encoders", size=JOINTS, unit="rad", lower=-np.pi, upper=np.pi, max_age=5 * self.period),
                Signal("foot_contact", size=len(LEGS), lower=0.0, upper=1.0, max_age=5 * self.period),
            ],
            act=[
                Signal(
                    "joint_position",
                    size=JOINTS,
                    unit="rad",
                    lower=m.joint_lower,
                    upper=m.joint_upper,
                    rate=m.joint_speed,
                    idle=LegKinematics(m).inverse(m.stance).ravel(),
                )
            ],
            commands=[
                Signal("heading", size=1, unit="rad", lower=-np.pi, upper=np.pi),
                Signal("walk", size=1, lower=-1.0, upper=1.0, default=1.0),
            ],
        )

    def make_dps(self) -> Diagram:
        return make_dps(self.gait, period=self.period)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, scene_graph = builder.add_plant(self.plant_config, self._contact_defaults())
        climber = add_climber(plant, joint_stops=self.joint_stops)
        if self.payload:
            add_payload(plant, climber)
        X_WG = self._add_ground(plant)
        base = plant.GetBodyByName("base", climber)
        plant.SetDefaultFloatingBaseBodyPose(base, X_WG @ plant.GetDefaultFloatingBaseBodyPose(base))
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -self.gravity])
        plant.Finalize()
        set_foot_friction(plant, scene_graph, climber, self.friction)

        feet = [plant.GetBodyByName(name, climber) for name in FOOT_LINKS]
        joints = [plant.GetJointByName(name, climber) for name in JOINT_NAMES]
        imu_frame = plant.GetFrameByName("imu", climber)
        builder.add_sensor("imu", Imu(plant, imu_frame, period=self.period))
        builder.add_sensor("joint_encoders", JointEncoders(plant, joints, period=self.period), name="encoders")
        builder.add_sensor("foot_contact", ContactSensor(plant, feet, period=self.period))

        # The servos are the plant's own PD controllers; they are to reach the position and to rest there.
        rest = np.vstack([np.eye(JOINTS), np.zeros((JOINTS, JOINTS))])
        servos = builder.add("act", "servos", MatrixGain(rest))
        builder.connect(servos.get_output_port(), plant.get_desired_state_input_port(climber))
        builder.sim_actuator("joint_position", servos.get_input_port())
        self._declare_belief(builder)

    def _contact_defaults(self) -> SceneGraphConfig:
        """Return the contact properties of geometries that have none of their own."""
        return SceneGraphConfig(
            default_proximity_properties=DefaultProximityProperties(
                static_friction=self.friction, dynamic_friction=self.friction
            )
        )

    def _add_ground(self, plant: MultibodyPlant) -> RigidTransform:
        """Add what the robot walks on; return the pose of the plane on which it stands at first."""
        X_WG = RigidTransform(RotationMatrix.MakeYRotation(np.radians(self.slope_deg)))
        ground = Box(200.0, 200.0, 1.0)
        below = X_WG @ RigidTransform([0.0, 0.0, -0.5])
        friction = CoulombFriction(self.friction, self.friction)
        plant.RegisterCollisionGeometry(plant.world_body(), below, ground, "ground", friction)
        # A little lower than it is, or Meshcat's grid would shine through.
        shown = below @ RigidTransform([0.0, 0.0, -0.002])
        plant.RegisterVisualGeometry(plant.world_body(), shown, ground, "ground", np.array([0.55, 0.53, 0.5, 1.0]))
        return X_WG

    def _declare_belief(self, builder: VirtualTestbedBuilder) -> None:
        """Declare how the estimates set the state of the simulated robot.

        They are about the last instant but one: sensors and DPS take a period each. Until the present, the base moves
        on with the velocity that it is believed to have, and the joints follow their command.
        """
        self._believe_base(builder, ["dps.env.position"], lambda position: position)
        self._believe_joints(builder)

    def _believe_base(
        self, builder: VirtualTestbedBuilder, place: Sequence[str], position: Callable[..., ArrayLike]
    ) -> None:
        """Declare that the base is where it is perceived, turns as the gyro says, and advances as the gait does.

        Args:
            builder: The builder of the testbed.
            place: Addresses of the estimates of its position.
            position: Function of them that returns the position in m, shape (3,).
        """
        gait = GAITS[self.gait]

        def velocity(rpy: Sequence[float], imu: np.ndarray, level: float, stroke: float, period: float) -> np.ndarray:
            R_WB = RollPitchYaw(*rpy).ToRotationMatrix().matrix()
            v_WB = R_WB @ [level * gait.speed(stroke=stroke, period=period), 0.0, 0.0]
            return np.concatenate([R_WB @ imu[:3], v_WB])

        def motion(*of: Any, late: float) -> tuple[np.ndarray, np.ndarray]:
            (rpy, gait_of), where = (of[:3], of[3 : len(turning)]), of[len(turning) :]
            V_WB = velocity(rpy, *gait_of)
            return pose_later(np.concatenate([position(*where), rpy]), V_WB, late), V_WB

        T = self.period
        turning = ["dps.env.roll", "dps.env.pitch", "dps.env.yaw", "dps.sense.calibration.imu"]
        turning += [f"dps.impl.gait.{name}" for name in ("level", "stroke", "period")]
        targets = [f"sim.sys.climber.base.{name}" for name in ("pose", "velocity")]
        builder.believe(targets, of=[*turning, *place], by=motion, age=T, period=T)

    def _believe_joints(self, builder: VirtualTestbedBuilder) -> None:
        """Declare that the joints were where they were measured, and move as they are commanded."""
        encoders, next_command, command = (
            "dps.sense.calibration.joint_encoders",
            "dps.impl.gait.joint_position",
            "dps.act.joint_position",
        )
        targets = [f"sim.sys.climber.{name}.{value}" for value in ("position", "velocity") for name in JOINT_NAMES]
        of, T = [encoders, next_command, command, "dps.act.rate"], self.period
        builder.believe(targets, of=of, by=partial(_joints, period=T), age=T, period=T)


def _joints(
    measured: np.ndarray, next_command: np.ndarray, command: np.ndarray, rate: float, *, period: float, late: float
) -> np.ndarray:
    """Return the positions (rad) of all joints ``late`` seconds after they were measured, and their velocities (rad/s).

    A joint has moved towards its command, as fast as that moves, and no further. That moves from the present command to
    the next one, limited to a rate.
    """
    velocity = np.clip((next_command - command) / period, -rate, rate)
    reach = late * np.abs(velocity)
    return np.concatenate((measured + np.clip(command - measured, -reach, reach), velocity))
